"""`mdnum audit` as a function: every check of a calculator, a verdict, and a report to attach to an issue."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.workflow.fork_question import Log, Progress, finish

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.base import Check, Part
    from mdnum.audit.load import Loaded
    from mdnum.audit.subject import CalculatorSubject
    from mdnum.units import Units
    from mdnum.workflow.audit_record import AuditRecord

#: Checks in the order in which they are made: what tells most by a call first, and thresholds before those
#: that may ask at them.
CHECKS = ("invariance", "smoothness", "forces", "curl", "state", "dynamics")


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
    calculator: str | Callable[[], Any] | None = None,
    structure: Atoms | str | Path | None = None,
    *,
    checks: str | Sequence[str] | None = None,
    temperature: float | None = None,
    timestep: float | None = None,
    steps: int | None = None,
    time: float | None = None,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> AuditResult:
    """Ask a calculator whether it is safe to run and to differentiate.

    How much is asked is counted in calls of the calculator and does not depend on how fast it answers: some
    6,000 calls for one element. Whatever ends an audit, the checks that were done are in its folder.

    Args:
        calculator: as the command line names one, or a function that makes a new ASE calculator; may be left
            out where an audit of one that was named in words is resumed. The Python that it names is run.
        structure: ASE's atoms or a file that ASE reads; by default what comes with the calculator, or one
            that is built for it.
        checks: words of `CHECKS`; default all.
        temperature: K, of kT and of the run; default the system's own, or 300.
        timestep: of the run, fs (τ of a system in reduced units); default a fraction of the fastest
            vibration.
        steps: of the run; default 200.
        time: minutes, after which nothing more is asked; what was not asked by then is told, and can be
            resumed.
        out: the new audit folder; default runs/audit-<name>-<n>.
        resume: the folder of an audit that was killed, stopped or short of time: the checks that it holds are
            kept, the others are made as it was asked for.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Raises:
        InputError: no such calculator, structure or check; something that a resumed audit has already.
        FolderError: the folder cannot be used.
        AuditStopped: a KeyboardInterrupt came after a check was done; what was found till then has been
            written, its page included, and is the exception's `result`.
    """
    from mdnum.audit.base import TIME_UP, TimeUp
    from mdnum.deadline import Deadline
    from mdnum.workflow import audit_record

    deadline = Deadline(time)
    if resume is None:
        if calculator is None:
            raise InputError("no calculator is named", remedy="Name one, or resume an audit")
        loaded = _loaded(calculator)
        _internal(timestep, loaded.units)
        question = {
            "checks": list(_wanted(checks)), "temperature": temperature, "timestep": timestep, "steps": steps,
        }  # fmt: skip
        record = audit_record.begin(
            loaded, out, _structure(structure, loaded), question, words=isinstance(calculator, str)
        )
    else:
        given = {
            "structure": structure, "checks": checks, "temperature": temperature, "timestep": timestep,
            "steps": steps, "out": out,
        }  # fmt: skip
        if words := [word for word, value in given.items() if value is not None]:
            raise InputError(
                f"an audit is resumed as it was asked for, and {words[0]} is given",
                remedy=f"Leave out {', '.join(words)}, or begin another audit",
            )
        record = audit_record.open_again(resume, calculator, _loaded)
    folder, during, why = record.folder, None, ""
    try:
        subject = _subject(record)
        subject.meter.deadline = deadline
        told = Log(folder, progress)
        for check in _checks(record, subject):
            told(0, 0, {"phase": check.name})
            try:
                part = _in_units(
                    _repeatable(_ask(check, subject, told), subject, record.parts), subject.units
                )
            except KeyboardInterrupt:
                if not record.parts:
                    raise
                during, why = check.name, "stopped"
                break
            except TimeUp:
                during, why = check.name, TIME_UP
                if record.cut is not None and record.cut.name == check.name:
                    record.add(record.cut, check, subject, whole=False)
                break
            cut = any(reason == TIME_UP for _, reason in part.skipped)
            record.add(part, check, subject, whole=not cut)
            if cut:
                during, why = check.name, TIME_UP
                break
        folder.finalize()
        record.write(during, why)
    except BaseException:
        folder.close()
        raise
    found = {part.name: part for part in record.parts}
    result = AuditResult(folder.path, found, finish(folder, report, progress))
    if why == "stopped":
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


def _subject(record: AuditRecord) -> CalculatorSubject:
    from mdnum.audit.subject import CalculatorSubject

    loaded, folder = record.loaded, record.folder.path / "structures"
    return CalculatorSubject(
        loaded.name, loaded.make, record.atoms, kT=record.kT, folder=folder, units=loaded.units
    )


def _checks(record: AuditRecord, subject: CalculatorSubject) -> list[Check]:
    """The checks that are asked for and not done, in their order."""
    from mdnum.audit.curl import Curl
    from mdnum.audit.dynamics import Dynamics
    from mdnum.audit.forces import Forces
    from mdnum.audit.invariance import Invariance
    from mdnum.audit.smoothness import Smoothness
    from mdnum.audit.state import State

    steps, timestep = record.question["steps"], _internal(record.question["timestep"], subject.units)
    made: dict[str, Callable[[], Check]] = {
        "smoothness": Smoothness,
        "invariance": Invariance,
        "forces": Forces,
        "curl": Curl,
        "state": lambda: State(record.thresholds),
        "dynamics": lambda: Dynamics(record.thresholds, timestep, steps),
    }
    return [made[name]() for name in record.left]


#: A unit of a system with dimensions where text has one: not in the name of a file.
_UNIT = re.compile(r"(?<![\w./])(m?)eV(?![A-Za-z0-9_]|\.\w)|Å(?![A-Za-z0-9_])")


def _in_units(part: Part, units: Units) -> Part:
    """A part with the words of a unit system: checks say eV and Å, which are ε and σ in reduced units."""
    if units.energy == "eV":
        return part

    def unit(found: re.Match[str]) -> str:
        return units.length if found[0] == "Å" else f"{found[1]}{units.energy}"

    def told(value: Any) -> Any:
        if isinstance(value, str):
            return _UNIT.sub(unit, value)
        if isinstance(value, Mapping):
            return {told(key): told(item) for key, item in value.items()}
        return [told(item) for item in value] if isinstance(value, list | tuple) else value

    curves = [
        replace(
            one,
            title=told(one.title),
            x_label=told(one.x_label),
            y_label=told(one.y_label),
            lines=told(one.lines),
            marks=told(one.marks),
        )
        for one in part.curves
    ]
    return replace(
        part,
        says=told(part.says),
        findings=told(list(part.findings)),
        tables=told(part.tables),
        curves=curves,
        skipped=[(told(what), told(why)) for what, why in part.skipped],
    )


def _internal(timestep: float | None, units: Units) -> float | None:
    """A time step in length * sqrt(mass / energy), of one in fs, or in τ for reduced units."""
    if timestep is None:
        return None
    if not timestep > 0:
        raise InputError(f"a time step of {timestep:g}; expected one above 0", remedy="Correct --timestep")
    return timestep * units.time_factor / (1000.0 if units.time == "ps" else 1.0)


def _repeatable(part: Part, subject: CalculatorSubject, before: Sequence[Part]) -> Part:
    """A part with the finding that one question has had two answers, where no part has it yet."""
    told = {one["code"] for each in (*before, part) for one in each.findings}
    if "NOT_REPEATABLE" in told:
        return part
    return replace(part, findings=[*subject.ledger.findings(subject.kT), *part.findings])


def _ask(check: Check, subject: CalculatorSubject, told: Log) -> Part:
    """A check's answer; of a calculator that fails where a check cannot go on, the failure as a finding."""
    from mdnum.audit.base import Part
    from mdnum.audit.subject import CalculatorError
    from mdnum.references.findings import finding

    began = perf_counter()
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
            seconds=perf_counter() - began,
        )
