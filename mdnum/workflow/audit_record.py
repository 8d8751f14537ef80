"""What an audit folder holds: curves and runs as tables, structures, a script, and summary.json."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.audit.causes import grouped
from mdnum.errors import FolderError, InputError
from mdnum.references.findings import plain
from mdnum.store import RunFolder, expect, manifest, restoring
from mdnum.store.atomic import subfolder, write_text
from mdnum.units import METAL

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.base import Check, Part, Subject
    from mdnum.audit.load import Loaded
    from mdnum.audit.subject import CalculatorSubject
    from mdnum.audit.threshold import Threshold
    from mdnum.audit.verdict import Judgment
    from mdnum.units import Units

#: Where structures are kept that show a finding.
STRUCTURES = "structures"
#: Shows the findings again without mdnum.
SCRIPT = "reproduce.py"
_BOLTZMANN = 8.617333262e-5
"""eV/K (CODATA 2018, exact)."""


@dataclass
class AuditRecord:
    """An audit folder as it fills up, check by check: what a killed audit leaves behind and goes on from.

    Attributes:
        folder: open for writing.
        loaded: the calculator.
        words: whether it was named in words, and is found again by them.
        atoms: the structure.
        question: checks, temperature, timestep and steps that were asked for.
        parts: of the checks that are done.
        pairs: names of structures that show a finding, without "-before" and "-after".
        cut: of the check that a deadline cut short, which is asked again: as far as it had been asked.
        found: thresholds, as far as a check has looked for them; None if none has.
        seconds: that the audit took before it was resumed.
    """

    folder: RunFolder
    loaded: Loaded
    words: bool
    atoms: Atoms
    question: dict[str, Any]
    parts: list[Part] = field(default_factory=list)
    pairs: list[str] = field(default_factory=list)
    cut: Part | None = None
    found: list[Threshold] | None = None
    seconds: float = 0.0
    began: float = field(default_factory=time.perf_counter)

    @property
    def left(self) -> list[str]:
        """Checks that are not done."""
        done = {part.name for part in self.parts}
        return [name for name in self.question["checks"] if name not in done]

    def thresholds(self, subject: Subject) -> list[Threshold]:
        """Where a calculator's interactions change, looked for once in an audit, resumed or not."""
        from mdnum.audit.thresholds import find_thresholds

        if self.found is None:
            self.found = find_thresholds(subject)
        return self.found

    def add(self, part: Part, check: Check, subject: CalculatorSubject, whole: bool) -> None:
        """Puts what a check found into the folder.

        Args:
            whole: whether it was asked to its end; otherwise a resumed audit asks it again.
        """
        if part.name == "smoothness" and whole:
            self.thresholds(subject)
        if whole:
            self.cut = None
        else:
            # asked again, and not as far: what was known stays known
            earlier = self.cut if self.cut is not None and self.cut.name == part.name else part
            part = self.cut = max(earlier, part, key=lambda one: one.asked)
            self.keep()
        self.parts.append(part)
        write_parts(self.folder, [part])
        tables: Mapping[str, Any] = getattr(check, "recorded", {})
        for name, columns in tables.items():
            self.folder.append(name, columns)
        structures: Mapping[str, Atoms] = getattr(check, "structures", {})
        write_structures(self.folder.path, structures)
        self.pairs += [name.removesuffix("-before") for name in structures if name.endswith("-before")]
        if self.pairs:
            text = script(self.loaded.name, self.pairs, self.loaded.units)
            write_text(self.folder.path / SCRIPT, text)
        if whole:
            self.keep()
            self.write(next(iter(self.left), None), "")

    def keep(self) -> None:
        """Makes this the point from which a killed audit is resumed."""
        shown = self.folder.path / STRUCTURES
        self.folder.checkpoint(
            {
                "audit": self.loaded.name if self.words else None,
                "atoms": _told(self.atoms),
                "question": self.question,
                "parts": [plain(part) for part in self.parts],
                "pairs": self.pairs,
                "cut": None if self.cut is None else plain(self.cut),
                "files": sorted(path.name for path in shown.glob("failed-*.extxyz")),
                "thresholds": None if self.found is None else [plain(one) for one in self.found],
                "seconds": self._took,
            },
            force=True,
        )

    def write(self, during: str | None, why: str) -> None:
        """Writes summary.json of what is known.

        Args:
            during: the check that comes next or was not finished; None where all are done.
            why: "stopped", the words for a deadline, or nothing for an audit that goes on.
        """
        from mdnum.audit.verdict import judge

        wanted = self.question["checks"]
        name, units = self.loaded.name, self.loaded.units
        judgment = judge(name, self.parts, wanted)
        summary = summarize(name, self.atoms, self.kT, (units.length, units.energy), self.parts, judgment)
        origin = self.atoms.info.get("origin")
        if origin is not None and units.length != "Å":
            origin = str(origin).replace(" Å", f" {units.length}")
        summary |= {"structure": origin, "seconds": self._took}
        if during is not None:
            stop(summary, during, wanted, why)
        self.folder.write_summary(summary)

    @property
    def _took(self) -> float:
        return self.seconds + time.perf_counter() - self.began

    @property
    def kT(self) -> float:
        """Of the temperature asked for, the system's own or 300 K, energy."""
        temperature = self.question["temperature"]
        if temperature is not None:
            return temperature * self.loaded.units.k_B
        return 300.0 * _BOLTZMANN if self.loaded.kT is None else self.loaded.kT


def begin(
    loaded: Loaded, out: str | Path | None, atoms: Atoms, question: dict[str, Any], words: bool
) -> AuditRecord:
    """A new audit folder.

    Raises:
        FolderError: it cannot be used.
    """
    from mdnum.provenance import surroundings
    from mdnum.store.naming import default_folder

    folder = RunFolder.create(default_folder(f"audit-{loaded.stem}") if out is None else out, world="audit")
    record = AuditRecord(folder, loaded, words, atoms, question)
    try:
        folder.write_provenance(surroundings() | {"calculator": loaded.name})
        write_structures(folder.path, {"structure": atoms})
        record.keep()
    except BaseException:
        folder.close()
        raise
    return record


def open_again(path: str | Path, calculator: Any, load: Callable[[Any], Loaded]) -> AuditRecord:
    """The folder of an audit that was not finished, with all that was after its last whole check dropped.

    Args:
        path: of the folder.
        calculator: if given; otherwise by the words that the folder has.
        load: makes it.

    Raises:
        FolderError: it holds no audit, or another process writes it.
        InputError: the calculator was no words and is not given, or is another.
    """
    folder = RunFolder.open(path)
    state = folder.load_checkpoint() if folder.world == "audit" or folder.has_checkpoint() else {}
    if "audit" not in state:
        # a run, and an examination of lists, are resumed by the verb that made them; the rest is done anew
        goes_on = manifest.resumable(folder.path)
        remedy = f"Resume it with `mdnum {folder.verb} --resume {path}`" if goes_on else "Begin a new audit"
        raise FolderError("holds no audit", remedy=remedy, where=str(path))
    folder.world = "audit"
    _told_by(folder, state)
    words = state["audit"]
    if calculator is None and words is None:
        raise InputError("the calculator of this audit has no name", remedy="Give it again", where=str(path))
    if isinstance(calculator, str) and words is not None and calculator != words:
        raise InputError(
            f"that is an audit of {words}, not of {calculator}", remedy="Leave out the calculator"
        )
    loaded = load(words if calculator is None else calculator)
    state = folder.resume()
    try:
        told = _told_by(folder, state)
        for file in (folder.path / STRUCTURES).glob("failed-*.extxyz"):
            if re.fullmatch(r"failed-\d+\.extxyz", file.name) and file.name not in state["files"]:
                manifest.remove(file)
        return AuditRecord(folder, loaded, words is not None, **told)
    except BaseException:
        folder.close()
        raise


def _told_by(folder: RunFolder, state: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a record that a checkpoint keeps, each of the kind that it was.

    Raises:
        FolderError: the checkpoint holds something else.
    """
    from ase import Atoms
    from ase.io.jsonio import decode

    from mdnum.workflow.audit import CHECKS

    with restoring(folder.path / "checkpoint.npz"):
        expect(isinstance(state["audit"], str | None), "no name of a calculator")
        atoms: Any = decode(state["atoms"])
        expect(isinstance(atoms, Atoms) and len(atoms), "no structure")
        expect(np.isfinite(atoms.positions).all() and np.isfinite(atoms.cell.array).all(), "no coordinates")
        question = {name: state["question"][name] for name in ("checks", "temperature", "timestep", "steps")}
        expect(isinstance(question["checks"], list) and question["checks"], "no checks")
        expect(set(question["checks"]) <= set(CHECKS), "a check that there is not")
        for name in ("temperature", "timestep", "steps"):
            expect(question[name] is None or _number(question[name]), f"{name} is no number")
        expect(type(question["steps"]) in (int, type(None)), "steps are no whole number")
        expect(_number(state["seconds"]) and isinstance(state["parts"], list), "no parts")
        for name in ("pairs", "files"):
            expect(isinstance(state[name], list), f"no {name}")
            expect(all(isinstance(one, str) and "/" not in one for one in state[name]), f"no {name}")
        cut, found = state["cut"], state["thresholds"]
        return {
            "atoms": atoms,
            "question": question,
            "parts": [_restored(one, question["checks"]) for one in state["parts"]],
            "pairs": list(state["pairs"]),
            "cut": None if cut is None else _restored(cut, question["checks"]),
            "found": None if found is None else [_threshold(one) for one in found],
            "seconds": state["seconds"],
        }


def _told(atoms: Atoms) -> str:
    """A structure as JSON, to the last bit; of its info what text can say."""
    from ase.io.jsonio import encode

    copy = atoms.copy()
    copy.info = {key: value for key, value in atoms.info.items() if isinstance(value, str | int | float)}
    copy.set_constraint()
    return encode(copy)


def _number(value: object) -> bool:
    return type(value) in (int, float) and bool(np.isfinite(value))  # pyright: ignore[reportCallIssue, reportArgumentType]


def _threshold(told: Mapping[str, Any]) -> Threshold:
    """A threshold that `plain` made plain."""
    from mdnum.audit.threshold import Threshold

    values: dict[str, Any] = {k: tuple(one) if isinstance(one, list) else one for k, one in told.items()}
    found = Threshold(**values)
    expect(len(found.species) == 2 and all(isinstance(one, str) for one in found.species), "no species")
    expect(type(found.order) is int and type(found.dies) is bool, "no order")
    numbers = (*found.jumps, *found.doubt, found.radius, found.inside, found.outside, found.located)
    expect(len(numbers) == 10 and all(type(one) in (int, float) for one in (*numbers, found.third)), "jumps")
    return found


def _restored(told: Mapping[str, Any], wanted: Sequence[str]) -> Part:
    """A part that `plain` made plain."""
    from mdnum.audit.base import Curve, Part

    curves = []
    for one in told["curves"]:
        curve = Curve(
            **{
                **one,
                "x": np.array(one["x"], np.float64),
                "lines": {name: np.array(line, np.float64) for name, line in one["lines"].items()},
            }
        )
        expect(curve.x.ndim == 1 and all(y.shape == curve.x.shape for y in curve.lines.values()), "no curve")
        texts = (curve.title, curve.x_label, curve.y_label, *curve.marks)
        expect(all(isinstance(text, str) for text in texts) and type(curve.log_y) is bool, "no curve")
        expect(all(type(mark) in (int, float) for mark in curve.marks.values()), "no marks")
        curves.append(curve)
    part = Part(**{**told, "curves": curves, "skipped": [(what, why) for what, why in told["skipped"]]})
    texts = (part.title, part.says, *(word for both in part.skipped for word in both))
    expect(part.name in wanted and all(isinstance(text, str) for text in texts), "no part of this audit")
    for one in part.findings:
        expect({"code", "severity", "title", "text", "remedy"} <= set(one), "no finding")
        expect(one["severity"] in ("info", "warning", "error"), "no finding")
        expect(all(isinstance(word, str) for word in one.values()), "no finding")
    rows = [row for table in part.tables.values() for row in table]
    expect(isinstance(part.numbers, Mapping) and all(isinstance(row, Mapping) for row in rows), "no tables")
    expect(_number(part.seconds) and type(part.asked) is int and type(part.possible) is int, "no counts")
    return part


def write_parts(folder: RunFolder, parts: Sequence[Part]) -> None:
    """Puts the curves of all parts into the folder."""
    for part in parts:
        for number, curve in enumerate(part.curves):
            for line, values in curve.lines.items():
                count = len(curve.x)
                folder.append(
                    "curves",
                    {
                        "part": np.full(count, part.name),
                        "curve": np.full(count, curve_name(part.name, number)),
                        "line": np.full(count, line),
                        "x": np.asarray(curve.x, np.float64),
                        "y": np.asarray(values, np.float64),
                    },
                )


def write_structures(folder: Path, structures: Mapping[str, Atoms]) -> None:
    """Puts structures into the folder to the last bit."""
    from mdnum.audit.subject import exact_extxyz

    if structures:
        subfolder(folder, STRUCTURES)
    for name, atoms in structures.items():
        write_text(folder / STRUCTURES / f"{name}.extxyz", exact_extxyz(atoms))


def curve_name(part: str, number: int) -> str:
    """The name of a curve in curves.parquet, and of its figure."""
    return f"{part}-{number + 1}"


def summary_of(part: Part) -> dict[str, Any]:
    """A part as summary.json tells it: all but the points of its curves."""
    return {
        "name": part.name,
        "title": part.title,
        "says": part.says,
        "findings": plain(list(part.findings)),
        "tables": plain(dict(part.tables)),
        "numbers": plain(dict(part.numbers)),
        "skipped": [{"what": what, "why": why} for what, why in part.skipped],
        "curves": [
            {
                "name": curve_name(part.name, number),
                "title": curve.title,
                "x_label": curve.x_label,
                "y_label": curve.y_label,
                "lines": list(curve.lines),
                "marks": plain(dict(curve.marks)),
                "log_y": curve.log_y,
            }
            for number, curve in enumerate(part.curves)
        ],
        "seconds": part.seconds,
        "asked": part.asked,
        "possible": part.possible,
    }


def summarize(
    name: str, atoms: Atoms, kT: float, units: tuple[str, str], parts: Sequence[Part], judgment: Judgment
) -> dict[str, Any]:
    """The content of summary.json, without what the report adds."""
    found = [plain(dict(one)) for part in parts for one in part.findings]
    groups = grouped(found, [(one["code"], one["severity"]) for one in found])
    return {
        "world": "audit",
        "question": "audit",
        "system": name,
        "calculator": name,
        "atoms": len(atoms),
        "formula": atoms.get_chemical_formula(),
        "periodic": [bool(one) for one in atoms.pbc],
        "kT": kT,
        "units": {"length": units[0], "energy": units[1]},
        "safe_to_run": judgment.run,
        "safe_to_differentiate": judgment.differentiate,
        "headline": judgment.headline,
        "evidence": list(judgment.evidence),
        "parts": [summary_of(part) for part in parts],
        "left_out": [
            {"what": what, "why": why, "part": part.name} for part in parts for what, why in part.skipped
        ],
        "findings": found,
        "causes": [{"code": head["code"], "below": [one["code"] for one in below]} for head, below in groups],
        "status": "complete",
    }


def stop(summary: dict[str, Any], during: str, wanted: Sequence[str], why: str) -> None:
    """Makes a summary that of an audit which is not finished.

    Args:
        summary: of the checks that were done; changed in place.
        during: the check that was not finished.
        wanted: all checks, in their order.
        why: it was not; empty for an audit that goes on, or was killed.
    """
    summary["status"] = "stopped" if why == "stopped" else "unfinished"
    begun = {"stopped": f"Stopped during {during}", "": f"Not finished: {during} comes next"}
    summary["headline"] = f"{begun.get(why, f'{why} during {during}'.capitalize())}. {summary['headline']}"
    done = {part["name"] for part in summary["parts"]}
    missing = [name for name in wanted[wanted.index(during) :] if name not in done]
    rest = [{"what": f"the check of {name}", "why": why or "not finished", "part": name} for name in missing]
    summary["left_out"] = rest + summary["left_out"]


def script(words: str, pairs: Sequence[str], units: Units = METAL) -> str:
    """A program that shows, with ASE alone, that structures which are the same have different answers.

    Args:
        words: the calculator as it was named.
        pairs: names of structures without "-before" and "-after".
        units: of the calculator.
    """
    energy, force = units.energy, f"{units.energy}/{units.length}"
    lines = [
        '"""Two ways of writing down one structure, and what the calculator says to each; run it here."""',
        "",
        "import numpy as np",
        "from ase.io import read",
        "",
        *_making(words),
        "",
        "",
        f"for name in {list(pairs)!r}:",
        "    found = []",
        '    for when in ("before", "after"):',
        f'        atoms = read(f"{STRUCTURES}/{{name}}-{{when}}.extxyz")',
        "        atoms.calc = make()",
        "        found.append((float(atoms.get_potential_energy()), atoms.get_forces()))",
        "    (first, forces), (second, others) = found",
        "    second /= len(others) // len(forces)",
        f'    print(f"{{name}}: {{first!r}} and {{second!r}} {energy}, '
        f'differ by {{second - first:.3g}} {energy}")',
        "    # the largest force has no direction and no order",
        "    largest, other = (np.linalg.norm(one, axis=1).max() for one in (forces, others))",
        f'    print(f"    largest force {{largest!r}} and {{other!r}} {force}, "',
        f'          f"differ by {{other - largest:.3g}} {force}")',
        "",
    ]
    return "\n".join(lines)


def _making(words: str) -> list[str]:
    """Lines that define make()."""
    head, separator, after = words.partition(".py:")
    if words.endswith(".py") or separator:
        path = Path(words if not separator else f"{head}.py").resolve()
        found = f"made[{after.partition('(')[0]!r}]" if after else ""
        call = f"    return {found}{after[after.find('('):] if '(' in after else ''}" if after else (
            '    return made.get("calculator") or made.get("calc") or made["make"]()'
        )  # fmt: skip
        return ["import runpy", "", "", "def make():", f"    made = runpy.run_path({str(path)!r})", call]
    if ":" in words:
        module, _, call = words.partition(":")
        call = call.strip() if "(" in call else f"{call.strip()}()"
        return [f"import {module.strip()}", "", "", "def make():", f"    return {module.strip()}.{call}"]
    return ["import mdnum", "", "", "def make():", f"    return mdnum.MdnumCalculator({words!r})"]
