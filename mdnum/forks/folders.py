"""Two finished runs: where they part, from what they stored, and what was different about them.

Nothing is run. Seed and fork are read from the tables of both folders; when the positions are wanted, the
runs are in the folders too (`twin`), and `mdnum.forks.fork` follows them again.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.twin import Twin
from mdnum.store import RunFolder
from mdnum.systems.build import build
from mdnum.systems.load import load

#: Stored at every step; that one of them differs in a bit means that the state does.
_NUMBERS = ("potential", "kinetic", "displacement", "min_margin")
#: Of a system file, what does not decide what is computed.
_WORDS = ("about", "name", "record.save_every")
#: Of the provenance, what bits depend on.
_ARITHMETIC = ("versions", "cpu", "devices", "jax_settings", "environment", "fingerprint")


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
        differences: what was different about the runs, as (key, in A, in B): system first, then what bits
            depend on.
        steps: steps that both have.
        seed: first step at which a stored number differs; None where none does.
        fork: first step at which a stored decision differs; None where none does.
        decisions: the rows that differ at the fork.
        same_structure: whether both began from the same atoms, bit for bit.
        reasons: what can be concluded, and what cannot, in words.
    """

    a: Path
    b: Path
    differences: tuple[tuple[str, Any, Any], ...]
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
        InputError: the runs are not of one structure and potential, so that no step of theirs corresponds;
            names the first field that differs.
        FolderError: a folder holds no run.
    """
    first, second = (folder if isinstance(folder, RunFolder) else RunFolder.open(folder) for folder in (a, b))
    systems = [_flat(tomllib.loads(folder.system_toml)) for folder in (first, second)]
    hashes = [folder.provenance.get("hashes", {}).get("structure") for folder in (first, second)]
    different = _different(*systems)
    _refuse(first, second, different)
    series = [folder.read("series", ["step", "pairs", *_NUMBERS]) for folder in (first, second)]
    steps = min(len(table["step"]) for table in series) - 1
    if steps < 0:
        raise InputError("a run has no step to compare", remedy="Resume it, or run again")
    seed = _first_difference(series, steps)
    fork, decisions = _fork(first, second, series, steps)
    arithmetic = _different(*(_flat(_arithmetic(folder.provenance)) for folder in (first, second)))
    same = hashes[0] is not None and hashes[0] == hashes[1]
    return FolderFork(
        first.path,
        second.path,
        tuple(different + arithmetic),
        steps,
        seed,
        fork,
        decisions,
        same,
        tuple(_reasons(different, arithmetic, same, steps, seed, fork, decisions)),
    )


def twin(a: str | Path, b: str | Path) -> Twin:
    """The runs of two folders, to be followed again.

    A replay has the bits of the stored run where versions and processor are the same.
    """
    found = compare_folders(a, b)
    words = "; ".join(f"{key}: {one} and {other}" for key, one, other in found.differences[:3])
    return Twin(build(load(found.a, world="md")), build(load(found.b, world="md")), words or "nothing known")


def _flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            out |= _flat(value, f"{name}.")
        else:
            out[name] = value
    return out


def _arithmetic(provenance: Mapping[str, Any]) -> dict[str, Any]:
    return {key: provenance[key] for key in _ARITHMETIC if key in provenance}


def _different(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    keys = [key for key in dict.fromkeys([*one, *other]) if key not in _WORDS]
    return [(key, one.get(key), other.get(key)) for key in keys if one.get(key) != other.get(key)]


def _refuse(first: RunFolder, second: RunFolder, different: list[tuple[str, Any, Any]]) -> None:
    atoms = [folder.summary.get("atoms") for folder in (first, second)]
    if atoms[0] != atoms[1]:
        raise InputError(
            f"the runs have {atoms[0]} and {atoms[1]} atoms",
            where=f"{first.path} and {second.path}",
            remedy="Compare runs of one structure",
        )
    for key, one, other in different:
        if key == "units" or key.startswith("potential.") or key == "cutoff.kind":
            raise InputError(
                f"the runs are of different systems: {key} is {one} in the first and {other} in the second",
                where=f"{first.path} and {second.path}",
                remedy="A fork is between two programs of one model; compare runs that differ in numerics",
            )


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


def _reasons(different, arithmetic, same, steps, seed, fork, decisions) -> list[str]:
    out = []
    choices = [key for key, _, _ in different if not key.startswith("structure.")]
    if len(choices) > 1:
        listed = ", ".join(choices[:6])
        out.append(f"the runs differ in {len(choices)} choices ({listed}): which of them did it is not told")
    elif choices:
        out.append(f"the runs differ in one choice, {choices[0]}")
    elif arithmetic:
        out.append(f"the system is the same; what bits depend on differs in {len(arithmetic)} points")
    else:
        out.append("nothing on record differs: runs like these should agree bit for bit")
    if not same:
        out.append("they did not begin from the same atoms, bit for bit")
    if seed is None:
        out.append(f"no stored number differs in {steps} steps")
    else:
        out.append(f"the first stored number that differs is that of step {seed}")
    if fork is None:
        out.append(f"no decision differs in {steps} steps")
    elif not decisions:
        out.append("the pairs inside differ at the start already")
    else:
        flip = decisions[0]
        verb = "entered" if flip.entered else "left"
        out.append(
            f"at step {fork} pair {flip.i}-{flip.j} {verb} in {flip.run} only, "
            f"{abs(flip.margin):.2g} from the threshold (rounding bound {flip.bound:.1g})"
        )
        out.append("whether this caused what followed takes a counterfactual: follow the two runs again")
    return out
