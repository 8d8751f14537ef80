"""`mdnum audit` as a function: every check of a calculator, a verdict, and a report to attach to an issue."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.workflow.fork_question import Log, Progress, finish

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.base import Check, Part
    from mdnum.audit.load import Loaded
    from mdnum.audit.subject import CalculatorSubject
    from mdnum.units import Units

#: Checks in the order in which they are made.
CHECKS = ("smoothness", "invariance", "forces", "curl", "state", "dynamics")
_BOLTZMANN = 8.617333262e-5
"""eV/K (CODATA 2018, exact)."""


class AuditStopped(KeyboardInterrupt):
    """Somebody pressed control-C after a check was done: what had been found is in the folder.

    Args:
        result: the audit without the checks that were not done.
    """

    def __init__(self, result: AuditResult):
        super().__init__("stopped")
        self.result = result


@dataclass(frozen=True)
class AuditResult:
    """A finished audit.

    Attributes:
        folder: the audit folder.
        parts: what each check found, by its name.
        summary: what summary.json says, findings included.
    """

    folder: Path
    parts: Mapping[str, Part]
    summary: dict[str, Any]

    @property
    def findings(self) -> list[dict[str, str]]:
        """All findings, errors first."""
        return self.summary["findings"]


def audit(
    calculator: str | Callable[[], Any],
    structure: Atoms | str | Path | None = None,
    *,
    checks: str | Sequence[str] | None = None,
    temperature: float | None = None,
    timestep: float | None = None,
    steps: int | None = None,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> AuditResult:
    """Ask a calculator whether it is safe to run and to differentiate.

    Args:
        calculator: as the command line names one, or a function that makes a new ASE calculator.
        structure: ASE's atoms or a file that ASE reads; by default what comes with the calculator, or one
            that is built for it.
        checks: words of `CHECKS`; default all.
        temperature: K, of kT and of the run; default the system's own, or 300.
        timestep: of the run, fs (τ of a system in reduced units); default a fraction of the fastest
            vibration.
        steps: of the run; default as many as take half a minute, 400 at most.
        out: the new audit folder; default runs/audit-<name>-<n>.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Raises:
        InputError: no such calculator, structure or check.
        FolderError: the folder cannot be used.
        AuditStopped: a KeyboardInterrupt came after a check was done; what was found till then has been
            written, its page included, and is the exception's `result`.
    """
    from mdnum.audit.verdict import judge
    from mdnum.provenance import surroundings
    from mdnum.store import RunFolder
    from mdnum.store.atomic import write_text
    from mdnum.store.naming import default_folder
    from mdnum.workflow import audit_record

    began = time.perf_counter()
    wanted = _wanted(checks)
    loaded = _loaded(calculator)
    asked = _structure(structure, loaded)
    folder = RunFolder.create(default_folder(f"audit-{loaded.stem}") if out is None else out, world="audit")
    try:
        subject = _subject(loaded, asked, temperature, folder.path)
        folder.write_provenance(surroundings() | {"calculator": loaded.name})
        audit_record.write_structures(folder.path, {"structure": subject.atoms})
        told = Log(folder, progress)
        parts: list[Part] = []
        pairs: dict[str, Atoms] = {}
        during = None
        for check in _checks(wanted, subject, timestep, steps):
            told(0, 0, {"phase": check.name})
            try:
                part = _in_units(_ask(check, subject, told), subject.units)
            except KeyboardInterrupt:
                if not parts:
                    raise
                during = check.name
                break
            parts.append(part)
            pairs |= getattr(check, "structures", {})
            tables: Mapping[str, Any] = getattr(check, "recorded", {})
            for name, columns in tables.items():
                folder.append(name, columns)
        audit_record.write_parts(folder, parts)
        audit_record.write_structures(folder.path, pairs)
        if pairs:
            names = [name.removesuffix("-before") for name in pairs if name.endswith("-before")]
            write_text(folder.path / audit_record.SCRIPT, audit_record.script(loaded.name, names))
        folder.finalize()
        units = (subject.units.length, subject.units.energy)
        summary = audit_record.summarize(
            loaded.name, subject.atoms, subject.kT, units, parts, judge(loaded.name, parts)
        )
        summary |= {"structure": asked.info.get("origin"), "seconds": time.perf_counter() - began}
        if during is not None:
            audit_record.stop(summary, during, wanted)
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    found = {part.name: part for part in parts}
    result = AuditResult(folder.path, found, finish(folder, report, progress))
    if during is not None:
        raise AuditStopped(result)
    return result


def _wanted(checks: str | Sequence[str] | None) -> tuple[str, ...]:
    import difflib

    if checks is None:
        return CHECKS
    texts = (checks,) if isinstance(checks, str) else checks
    words = [word.strip() for text in texts for word in text.split(",") if word.strip()]
    for word in words:
        if word not in CHECKS:
            close = difflib.get_close_matches(word, CHECKS, n=1)
            hint = f"Did you mean {close[0]}? " if close else ""
            raise InputError(f"no check {word!r}", remedy=f"{hint}There are {', '.join(CHECKS)}")
    if not words:
        raise InputError("no check is named", remedy=f"There are {', '.join(CHECKS)}")
    return tuple(name for name in CHECKS if name in words)


def _loaded(calculator: str | Callable[[], Any]) -> Loaded:
    from mdnum.audit.load import Loaded, load_calculator

    if isinstance(calculator, str):
        return load_calculator(calculator)
    if not callable(calculator):
        raise InputError(
            f"that is a {type(calculator).__name__}, neither words nor a function that makes a calculator",
            remedy="Say lambda: LennardJones(), so that a new one can be made for each check",
        )
    name = getattr(calculator, "__name__", type(calculator).__name__)
    name = "calculator" if name == "<lambda>" else name
    return Loaded(name, name, calculator)


def _structure(structure: Atoms | str | Path | None, loaded: Loaded) -> Atoms:
    """Atoms; what they are is in their info under "origin", where it is known."""
    from ase import Atoms

    from mdnum.audit.structures import default_structure, read_structure

    if isinstance(structure, Atoms):
        found = structure
    else:
        found = default_structure(loaded) if structure is None else read_structure(structure)
    if not len(found):
        raise InputError("a structure without atoms", remedy="Give one with atoms: -s FILE")
    return found


def _subject(loaded: Loaded, atoms: Atoms, temperature: float | None, folder: Path) -> CalculatorSubject:
    from mdnum.audit.subject import CalculatorSubject

    kT = 300.0 * _BOLTZMANN if loaded.kT is None else loaded.kT
    if temperature is not None:
        kT = temperature * loaded.units.k_B
    return CalculatorSubject(
        loaded.name, loaded.make, atoms, kT=kT, folder=folder / "structures", units=loaded.units
    )


def _checks(
    wanted: Sequence[str], subject: CalculatorSubject, timestep: float | None, steps: int | None
) -> Iterator[Check]:
    """The checks asked for, in their order."""
    from mdnum.audit.curl import Curl
    from mdnum.audit.dynamics import Dynamics
    from mdnum.audit.forces import Forces
    from mdnum.audit.invariance import Invariance
    from mdnum.audit.smoothness import Smoothness
    from mdnum.audit.state import State
    from mdnum.audit.thresholds import find_thresholds

    made: dict[str, Callable[[], Check]] = {
        "smoothness": Smoothness,
        "invariance": Invariance,
        "forces": Forces,
        "curl": Curl,
        "state": lambda: State(find_thresholds),
        "dynamics": lambda: Dynamics(find_thresholds, _internal(timestep, subject), steps),
    }
    for name in wanted:
        if name in made:
            yield made[name]()


def _in_units(part: Part, units: Units) -> Part:
    """A part with the words of a unit system: checks say eV and Å, which are ε and σ in reduced units."""
    if units.energy == "eV":
        return part

    def told(value: Any) -> Any:
        if isinstance(value, str):
            return value.replace("eV", units.energy).replace("Å", units.length)
        if isinstance(value, Mapping):
            return {told(key): told(item) for key, item in value.items()}
        return [told(item) for item in value] if isinstance(value, list | tuple) else value

    curves = [
        replace(one, title=told(one.title), x_label=told(one.x_label), y_label=told(one.y_label))
        for one in part.curves
    ]
    return replace(
        part,
        says=told(part.says),
        findings=told(list(part.findings)),
        tables=told(part.tables),
        curves=curves,
        skipped=[(told(what), why) for what, why in part.skipped],
    )


def _internal(timestep: float | None, subject: CalculatorSubject) -> float | None:
    """A time step in length * sqrt(mass / energy), of one in fs, or in τ for reduced units."""
    if timestep is None:
        return None
    if not timestep > 0:
        raise InputError(f"a time step of {timestep:g}; expected one above 0", remedy="Correct --timestep")
    units = subject.units
    return timestep * units.time_factor / (1000.0 if units.time == "ps" else 1.0)


def _ask(check: Check, subject: CalculatorSubject, told: Log) -> Part:
    """A check's answer; of a calculator that fails where a check cannot go on, the failure as a finding."""
    from mdnum.audit.base import Part
    from mdnum.audit.subject import CalculatorError
    from mdnum.references.findings import finding

    began = time.perf_counter()
    try:
        return check(subject, told)
    except CalculatorError as error:
        saved = f" The structure is saved as {error.structure.name}." if error.structure else ""
        failed = finding(
            "CALCULATOR_FAILED",
            "error",
            "the calculator fails on a structure near the one it was asked about",
            f"During the check of {check.name} it {error.message}.{saved}",
            "Run it on that structure by itself to see where it fails.",
        )
        return Part(
            check.name,
            check.name.capitalize(),
            f"The calculator failed: it {error.message}.",
            findings=[failed],
            skipped=[(f"the rest of {check.name}", error.message)],
            seconds=time.perf_counter() - began,
        )
