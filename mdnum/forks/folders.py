"""Two finished runs: where they part, from what they stored, and what was different about them.

Nothing is run. Seed and fork are read from the tables of both folders; when the positions are wanted, the
runs are in the folders too (`twin`), and `mdnum.forks.fork` follows them again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mdnum.errors import InputError
from mdnum.forks import folder_differences
from mdnum.forks.folder_differences import Difference
from mdnum.forks.stored import check_runs
from mdnum.forks.twin import Twin
from mdnum.store import RunFolder
from mdnum.systems.build import build
from mdnum.systems.load import load

#: Stored at every step; that one of them differs in a bit means that the state does.
_NUMBERS = ("potential", "kinetic", "displacement", "min_margin")


@dataclass(frozen=True)
class StoredFlip:
    """A row of flips.parquet at which two runs differ.

    Attributes:
        run: "A" or "B": which run has the row; the other has not.
        step, i, j, entered, distance, margin, bound, ambiguous: as stored.
    """

    run: str
    step: int
    i: int
    j: int
    entered: bool
    distance: float
    margin: float
    bound: float
    ambiguous: bool


@dataclass(frozen=True)
class FolderFork:
    """What two run folders say about one another.

    Attributes:
        a, b: the folders.
        differences: what was different about the runs, as (key, in A, in B): system first, then the starts,
            then what bits depend on.
        steps: steps that both have.
        seed: first step at which a stored number differs; None where none does.
        fork: first step at which a stored decision differs; None where none does.
        decisions: the rows that differ at the fork.
        same_structure: whether both began from the same atoms, bit for bit.
        reasons: what can be concluded, and what cannot, in words.
    """

    a: Path
    b: Path
    differences: tuple[Difference, ...]
    steps: int
    seed: int | None
    fork: int | None
    decisions: tuple[StoredFlip, ...]
    same_structure: bool
    reasons: tuple[str, ...]


def compare_folders(a: RunFolder | str | Path, b: RunFolder | str | Path) -> FolderFork:
    """Where two finished runs part.

    Args:
        a, b: run folders of molecular dynamics, finished or not.

    Raises:
        InputError: the runs are of different systems, so that no step of theirs corresponds; names what is
            different. Or a folder is that of a fork.
        FolderError: a folder holds no run.
    """
    first, second = (folder if isinstance(folder, RunFolder) else RunFolder.open(folder) for folder in (a, b))
    check_runs(first, second)
    with first.explained(), second.explained():
        return _compared(first, second)


def _compared(first: RunFolder, second: RunFolder) -> FolderFork:
    programs = folder_differences.of_programs(first, second)
    folder_differences.refuse_other_systems(first, second, programs)
    starts = folder_differences.of_starts(first, second, programs)
    arithmetic = folder_differences.of_arithmetic(first, second)
    series = [folder.read("series", ["step", "pairs", *_NUMBERS]) for folder in (first, second)]
    steps = min(len(table["step"]) for table in series) - 1
    if steps < 0:
        raise InputError("a run has no step to compare", remedy="Resume it, or run again")
    # other starts need not show in a stored number at once
    seed = 0 if starts else _first_difference(series, steps)
    fork, decisions = _fork(first, second, series, steps)
    return FolderFork(
        first.path,
        second.path,
        (*programs, *starts, *arithmetic),
        steps,
        seed,
        fork,
        decisions,
        not starts,
        (
            *_attributed(folder_differences.choices(programs), starts, arithmetic),
            *_dated(steps, seed, fork, decisions),
        ),
    )


def twin(a: str | Path, b: str | Path) -> Twin:
    """The runs of two folders, to be followed again.

    A replay has the bits of the stored run where versions and processor are the same.
    """
    return twin_of(compare_folders(a, b))


def twin_of(found: FolderFork) -> Twin:
    """The runs of two folders that have been compared, to be followed again."""
    words = "; ".join(f"{key}: {one} and {other}" for key, one, other in found.differences[:3])
    return Twin(build(load(found.a, world="md")), build(load(found.b, world="md")), words or "nothing known")


def _first_difference(series: list[dict[str, np.ndarray]], steps: int) -> int | None:
    differ = np.zeros(steps + 1, bool)
    for name in _NUMBERS:
        one, other = (table[name][: steps + 1] for table in series)
        differ |= ~((one == other) | (np.isnan(one) & np.isnan(other)))
    return int(differ.argmax()) if differ.any() else None


def _fork(
    first: RunFolder, second: RunFolder, series: list[dict[str, np.ndarray]], steps: int
) -> tuple[int | None, tuple[StoredFlip, ...]]:
    columns = ["step", "i", "j", "entered", "distance", "margin", "bound", "ambiguous"]
    tables = [folder.read("flips", columns) for folder in (first, second)]
    rows = [
        {
            (int(step), int(i), int(j), bool(entered)): k
            for k, (step, i, j, entered) in enumerate(
                zip(*(table[name].tolist() for name in columns[:4]), strict=True)
            )
            if step <= steps
        }
        for table in tables
    ]
    only = [set(rows[0]) - set(rows[1]), set(rows[1]) - set(rows[0])]
    found = [row[0] for missing in only for row in missing]
    counts = series[0]["pairs"][: steps + 1] != series[1]["pairs"][: steps + 1]
    if counts[0]:
        return 0, ()
    if not found:
        return None, ()
    step = min(found)
    flips = [
        StoredFlip(
            run,
            *row,
            *(table[name][known[row]].item() for name in ("distance", "margin", "bound", "ambiguous")),
        )
        for run, missing, known, table in zip("AB", only, rows, tables, strict=True)
        for row in sorted(missing)
        if row[0] == step
    ]
    return step, tuple(sorted(flips, key=lambda flip: abs(flip.margin)))


def _attributed(choices: list[str], starts: list[Difference], arithmetic: list[Difference]) -> Iterator[str]:
    """What parting may be put down to."""
    things = [*choices]
    if starts:
        things.append("the start")
    if arithmetic:
        things.append("versions, flags or machine")
    if len(things) > 1:
        listed = ", ".join(things[:6]) + (", ..." if len(things) > 6 else "")
        yield f"the runs differ in {len(things)} things ({listed}): a fork cannot be put down to one choice"
    elif choices:
        yield f"the runs differ in one choice, {choices[0]}"
    elif starts:
        yield "the programs are the same and the starts are not"
    elif arithmetic:
        yield f"the system is the same; what bits depend on differs in {len(arithmetic)} points"
    else:
        yield "nothing on record differs: runs like these should agree bit for bit"
    if starts:
        what = " and ".join(key.removeprefix("start: ") for key, _, _ in starts)
        yield f"they begin otherwise ({what}), so the seed is step 0"


def _dated(
    steps: int, seed: int | None, fork: int | None, decisions: tuple[StoredFlip, ...]
) -> Iterator[str]:
    """Where they part."""
    if seed is None:
        yield f"no stored number differs in {steps} steps"
    else:
        yield f"the first stored number that differs is that of step {seed}"
    if fork is None:
        yield f"no decision differs in {steps} steps"
    elif not decisions:
        yield "the pairs inside differ at the start already"
    else:
        flip = decisions[0]
        verb = "entered" if flip.entered else "left"
        yield (
            f"at step {fork} pair {flip.i}-{flip.j} {verb} in {flip.run} only, "
            f"{abs(flip.margin):.2g} from the threshold (rounding bound {flip.bound:.1g})"
        )
        yield (
            "when they split, and whether this was the cause, is told by following both again: "
            "`mdnum fork RUN_A RUN_B --replay`"
        )
