"""Where two finished runs of a ball part, by what their folders stored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.stored import check_runs
from mdnum.store import RunFolder

#: Of a system file: what says nothing about a step.
_WORDS = ("name", "about", "variants", "gradient", "loss", "fork")


@dataclass(frozen=True)
class StoredFlip:
    """A contact that begins or ends in one run alone.

    Attributes:
        run: "A" or "B".
        ball: whose.
        entered: whether it begins.
        margin, bound: minus the height (m), and the bound on its rounding error.
    """

    run: str
    ball: int
    entered: bool
    margin: float
    bound: float


@dataclass(frozen=True)
class BallFolderFork:
    """What two folders say about where their runs part.

    Attributes:
        a, b: the folders.
        differences: (key of the system file, in A, in B) of what differs.
        steps: steps that both made.
        seed: first step at which a stored height or velocity differs; None where none does.
        fork: first step at which a contact or the iterations of a solver differ; None where none do.
        channel: "contact" or "stop"; "" without a fork.
        iterations: of both solvers at the fork.
        decisions: contacts at the fork that begin or end in one run alone.
        reasons: what can be concluded, and what cannot, in words.
    """

    a: Path
    b: Path
    differences: tuple[tuple[str, Any, Any], ...]
    steps: int
    seed: int | None
    fork: int | None
    channel: str
    iterations: tuple[int, int] | None
    decisions: tuple[StoredFlip, ...]
    reasons: tuple[str, ...]


def compare_folders(a: RunFolder | str | Path, b: RunFolder | str | Path) -> BallFolderFork:
    """Where two finished runs of a ball part.

    Args:
        a, b: run folders of `mdnum ball`.

    Raises:
        InputError: not both runs of a ball, or of balls whose steps do not correspond.
        FolderError: a folder holds no run.
    """
    first, second = (folder if isinstance(folder, RunFolder) else RunFolder.open(folder) for folder in (a, b))
    where = f"{first.path} and {second.path}"
    check_runs(first, second)
    with first.explained(), second.explained():
        return _compared(first, second, where)


def _compared(first: RunFolder, second: RunFolder, where: str) -> BallFolderFork:
    if not first.world == second.world == "ball":
        raise InputError("one of these is no run of a ball", where=where, remedy="Compare runs of one world")
    different = _different(*(dict(_flat(folder.system)) for folder in (first, second)))
    balls = [folder.summary.get("balls") for folder in (first, second)]
    if balls[0] != balls[1]:
        raise InputError(f"the runs have {balls[0]} and {balls[1]} balls", where=where,
                         remedy="Compare runs of as many balls")  # fmt: skip
    for key, one, other in different:
        # every number and every choice of a program is a difference and may be varied
        if key in ("contact.kind", "integrator.kind"):
            raise InputError(
                f"the runs are of different systems: {key} is {one} in the first and {other} in the second",
                where=where,
                remedy="A fork is between two programs of one model; compare runs that differ in numerics",
            )
    tables = [folder.read("steps") for folder in (first, second)]
    steps = min(int(table["step"][-1]) for table in tables)
    seed = _seed(first, second, steps)
    contact, flips = _contacts(first, second, steps)
    counts = [table["iterations"][: steps + 1] for table in tables]
    off = np.flatnonzero(counts[0] != counts[1])
    stop = int(off[0]) if len(off) else None
    fork = min((step for step in (contact, stop) if step is not None), default=None)
    channel = "" if fork is None else "contact" if fork == contact else "stop"
    made = (int(counts[0][fork]), int(counts[1][fork])) if fork is not None and fork == stop else None
    reasons = tuple(_reasons(different, steps, seed, fork, channel))
    at_fork = tuple(flips) if channel == "contact" else ()
    return BallFolderFork(
        first.path, second.path, tuple(different), steps, seed, fork, channel, made, at_fork, reasons
    )


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if not prefix and key in _WORDS:
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + str(key), value


def _different(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    keys = dict.fromkeys((*first, *second))
    return [(key, first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)]


def _seed(first: RunFolder, second: RunFolder, steps: int) -> int | None:
    """The first step at which a stored number differs."""
    tables = [folder.read("heights") for folder in (first, second)]
    kept = [{name: values[table["step"] <= steps] for name, values in table.items()} for table in tables]
    if len(kept[0]["step"]) != len(kept[1]["step"]):
        return None
    apart = (kept[0]["y"] != kept[1]["y"]) | (kept[0]["v"] != kept[1]["v"])
    return int(kept[0]["step"][apart].min()) if apart.any() else None


def _contacts(first: RunFolder, second: RunFolder, steps: int) -> tuple[int | None, list[StoredFlip]]:
    """The first step at which a contact flips in one run alone, and those flips."""
    tables = [folder.read("contacts") for folder in (first, second)]
    rows = [
        set(zip(*(table[name].tolist() for name in ("step", "ball", "entered")), strict=True))
        for table in tables
    ]
    alone = {row for row in rows[0] ^ rows[1] if row[0] <= steps}
    if not alone:
        return None, []
    at = min(row[0] for row in alone)
    found = []
    for name, table in zip("AB", tables, strict=True):
        for k in np.flatnonzero(table["step"] == at).tolist():
            row = (at, int(table["ball"][k]), bool(table["entered"][k]))
            if row in alone:
                found.append(StoredFlip(name, *row[1:], float(table["margin"][k]), float(table["bound"][k])))
    return int(at), found


def _reasons(
    different: list[tuple[str, Any, Any]], steps: int, seed: int | None, fork: int | None, channel: str
) -> Iterator[str]:
    if seed is None and fork is None:
        yield f"No stored number differs in {steps:,} steps."
    elif fork is None:
        yield f"Bits differ from step {seed:,} on, but no decision does in {steps:,} steps."
    else:
        what = "a contact differs" if channel == "contact" else "the iterations of a solver differ"
        yield f"The runs fork at step {fork:,}: {what}."
    if len(different) > 1:
        yield (
            f"They differ in {len(different)} keys of their system files: a fork cannot be put down to one."
        )
    elif not different:
        yield "Their system files say the same: versions, flags or the machine are another."
    yield "Whether the decision was the cause is asked of the system: mdnum fork SYSTEM --vary CHOICE."
