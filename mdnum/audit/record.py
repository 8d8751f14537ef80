"""Load a calculator by name, save an audit, and write a script that reproduces its findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from ase import Atoms
from ase.io.jsonio import decode, encode
from pydantic import Field

from mdnum.audit.base import CheckResult
from mdnum.audit.subject import LoadedCalculator
from mdnum.audit.thresholds import PairThreshold
from mdnum.errors import FolderError, InputError, in_a_line
from mdnum.plain import beside
from mdnum.references.load import place
from mdnum.store import RunFolder, expect, restoring
from mdnum.store.answers import NAME, restored
from mdnum.units import METAL, Units

_WAYS = (
    "Give package.module:Class(argument=value), the path of a Python file that makes a calculator, "
    "or a system such as argon/liquid-864 (`mdnum systems` lists them)"
)
_SCRIPT: str = beside(__file__)["script"]
STRUCTURES = "structures"  # where structures are kept that show a finding


def load_calculator(words: str) -> LoadedCalculator:
    """Find the named calculator. One object is created at once, so that errors appear immediately.

    A Python file is executed again for each calculator object. Two calculator objects thus share no arrays.

    Args:
        words: `package.module:Class(argument=value)` with literals as arguments; a Python file in which
            `calculator`, `calc` or `make()` is a calculator, or `file.py:name` or `file.py:Class(a=1)`; or
            the name or path of a system of mdnum.

    Raises:
        InputError: the name was not found, an argument is not a literal, or the constructor failed; the
            message shows the correct form.
    """
    text = words.strip()
    if not text:
        raise InputError("no calculator was given", remedy=_WAYS)
    spot = place(text)
    if spot is None:
        return _of_system(text)

    def make() -> Any:
        value = spot.find(("calculator", "calc", "make"), anew=True)
        if not _is_calculator(value) and callable(value):
            try:
                value = value()
            except Exception as error:  # whatever a constructor raises
                remedy = "Give the arguments it needs: Class(argument=value)"
                raise InputError(
                    f"the calculator could not be constructed: {in_a_line(error)}", where=text, remedy=remedy
                ) from error
        return value

    made = make()
    if not _is_calculator(made):
        raise InputError(
            f"the given object is of type {type(made).__name__}; expected an ASE calculator with "
            "the methods get_potential_energy and get_forces",
            where=text,
            remedy=_WAYS,
        )
    return LoadedCalculator(text, Path(spot.home).stem if spot.is_file else spot.name, make)


def _is_calculator(value: Any) -> bool:
    methods, is_class = ("get_potential_energy", "get_forces"), isinstance(value, type)
    # atoms pass the question on to their calculator
    return all(hasattr(value, one) for one in methods) and not (is_class or hasattr(value, "get_positions"))


def _of_system(text: str) -> LoadedCalculator:
    from mdnum import systems

    try:
        system = systems.load(text, None, world="md")
    except InputError as error:
        if "." in text and "/" not in text and not text.endswith(".toml"):
            module, _, last = text.rpartition(".")
            raise InputError(
                f"no system of mdnum has the name {text!r}",
                remedy=f"For a Python class, put a colon before the class name: {module}:{last}",
            ) from error
        raise InputError(
            f"the given name is neither a Python class nor a Python file, and {error.message}",
            where=error.where,
            remedy=f"{error.remedy}. {_WAYS}" if error.remedy else _WAYS,
        ) from error

    def make() -> Any:
        from mdnum.references.calculator import MdnumCalculator

        return MdnumCalculator(system)

    kT = system.draw.temperature * system.units.k_B or None
    stem = Path(text).stem.removesuffix(".toml")
    return LoadedCalculator(text, stem, make, system.atoms.copy(), kT, system.units)


@dataclass
class AuditState:
    """State of an audit, whether finished or not."""

    name: str  # of the calculator
    named: bool  # whether it was named in words, and is found again by them
    structure: str  # as ASE's JSON
    kT: float  # energy, in the calculator's unit
    units: Annotated[str, Field(pattern="^(metal|lj)$")]  # their name
    # that are wanted, in their order; temperature, timestep and steps: as they were asked for
    checks: list[str]
    temperature: float | None
    timestep: float | None
    steps: int | None
    results: list[CheckResult] = field(default_factory=list)  # of the checks that are done
    # by name: of checks that are not done, the brief form, or as far as a deadline let one be asked
    cut: dict[str, CheckResult] = field(default_factory=dict)
    during: str | None = None  # check that was not finished, None if all are done
    why: str = ""  # it was not: "stopped", or the time was up; empty for an audit that goes on, or was killed
    failed: list[str] = field(default_factory=list)  # files of structures on which the calculator failed
    thresholds: list[PairThreshold] | None = None  # None if no check has searched for them
    seconds: float = 0.0  # that the audit took

    @property
    def left(self) -> list[str]:
        """Names of the checks that are not yet finished."""
        done = {result.name for result in self.results}
        return [name for name in self.checks if name not in done]

    @property
    def shown(self) -> list[CheckResult]:
        """All results so far, including those of shortened and interrupted checks."""
        return [*self.results, *(self.cut[name] for name in self.left if name in self.cut)]

    @property
    def atoms(self) -> Atoms:
        """Structure on which the calculator is audited."""
        atoms: Any = decode(self.structure)
        expect(isinstance(atoms, Atoms) and len(atoms), "no structure")
        expect(np.isfinite(atoms.positions).all() and np.isfinite(atoms.cell.array).all(), "no coordinates")
        return atoms


def kept(folder: RunFolder) -> AuditState:
    """Load the audit stored in a folder.

    Raises:
        FolderError: answers.json does not contain an audit.
    """
    if not (folder.path / NAME).exists():
        raise FolderError("the folder contains no audit", remedy="Start a new audit", where=str(folder.path))
    state = restored(folder, AuditState)
    with restoring(folder.path / NAME):
        assert state.atoms
        expect(all(np.isfinite(one) for one in (state.temperature or 0, state.timestep or 0)), "no numbers")
        expect(state.checks and set(state.checks) >= {one.name for one in state.shown}, "no checks")
        expect(not any("/" in name for name in state.failed), "no names of files")
        for chart in (chart for result in state.shown for chart in result.charts):
            expect(all(len(line) == len(chart.x) for line in chart.lines.values()), "no lines")
    return state


def encoded(atoms: Atoms) -> str:
    """Encode a structure as JSON without rounding. Only text and numbers of its `info` are kept."""
    copy = atoms.copy()
    copy.info = {key: value for key, value in atoms.info.items() if isinstance(value, str | int | float)}
    copy.set_constraint()
    return encode(copy)


def script(words: str, pairs: Sequence[str], units: Units = METAL) -> str:
    """Return a script that shows an error of a calculator with ASE alone.

    Args:
        words: the calculator as the user named it.
        pairs: names of pairs of structures, without the endings "-before" and "-after".
    """
    return _SCRIPT.format(
        making="\n".join(_making(words)), pairs=list(pairs), folder=STRUCTURES, energy=units.energy,
        force=f"{units.energy}/{units.length}",
    )  # fmt: skip


def _making(words: str) -> list[str]:
    """Return lines that define make(), a function that creates the calculator."""
    spot = place(words)
    head = ["", "", "def make():"]
    if spot is None:
        return ["import mdnum", *head, f"    return mdnum.MdnumCalculator({words!r})"]
    if not spot.is_file:
        call = spot.call if "(" in spot.call else f"{spot.call}()"
        return [f"import {spot.home}", *head, f"    return {spot.home}.{call}"]
    name, parenthesis, arguments = spot.call.partition("(")
    found = f"made[{name!r}]{parenthesis}{arguments}" if name else (
        'made.get("calculator") or made.get("calc") or made["make"]()'
    )  # fmt: skip
    run = f"    made = runpy.run_path({str(Path(spot.home).resolve())!r})"
    return ["import runpy", *head, run, f"    return {found}"]
