"""Find where two finished runs diverge, from their folders alone.

The first differing decision and the first differing bits are found. No run is repeated. To compare
positions, rebuild the programs with `twin_of`, and repeat the runs with `fork`.

Atoms, box, potential and contact model of both systems must agree. Runs may differ in any other parameter or
numerical choice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.worlds import ROLES, alike, program_of
from mdnum.program import Twin
from mdnum.store import RunFolder
from mdnum.store.files import SIMULATION_FILE
from mdnum.systems import load, opened
from mdnum.systems.toml import flat

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

Difference = tuple[str, Any, Any]

#: For each world: keys of a system file that do not affect the computation, and keys that make it a different
#: system.
_ELSEWHERE = {
    "md": ("about", "name", "record.save_every", "dynamics.steps", "fork", "gradient", "variants"),
    "ball": ("about", "name", "loss", "fork", "gradient", "variants"),
    "flips": (),
}
_SYSTEM = {"md": ("units", "potential.kind"), "ball": ("contact.kind", "integrator.kind"), "flips": ()}
#: Properties of positions from a loop or a file that may differ.
_GIVEN = ("format", "length", "time", "slice")
#: Quantities stored at every step; if a bit of one of them differs, the states differ.
_NUMBERS = ("potential", "kinetic", "displacement", "min_margin")
#: Entries of the provenance on which bits depend; the fingerprint is a hash of these and of the dtypes.
_ARITHMETIC = ("versions", "cpu", "devices", "jax_settings", "environment")
#: Keys that determine randomly drawn velocities.
_DRAWN = ("dynamics.temperature", "dynamics.seed", "dynamics.remove_drift", "structure.velocities")
#: Relative difference of boxes and masses up to which two systems count as the same; their last digits may
#: differ.
_SAME = 1e-6


@dataclass(frozen=True)
class StoredFlip:
    """A flip stored in the folder of only one of two runs."""

    # run, step: which run has it, "A" or "B", and when
    run: str
    step: int
    subject: tuple[int, ...]  # labels of the atoms of a pair, or of the ball
    terms: str  # whose decision it is, where a potential has several terms
    entered: bool  # whether the pair enters its cutoff, or the contact begins
    # margin, bound: as stored: of the decision, and on its rounding error
    margin: float
    bound: float
    distance: float  # of the pair, length; NaN of a ball
    ambiguous: bool  # whether rounding alone could have decided otherwise


@dataclass(frozen=True)
class FolderFork:
    """The point at which two runs diverge, read from their folders."""

    # world, a, b: "md" or "ball", and the folders
    world: str
    a: Path
    b: Path
    # what was different about the runs, as (key, in A, in B): system first, then the starts, then what bits
    # depend on
    differences: tuple[Difference, ...]
    causes: tuple[str, ...]  # what a fork may be put down to: keys of the system file, "start", "arithmetic"
    steps: int  # that both have
    # first_bit, fork: first steps at which a stored number and decision differ; None where none does
    first_bit: int | None
    fork: int | None
    channel: str  # of the decision at the fork; "" without one
    same_structure: bool  # whether both began from the same atoms, bit for bit
    iterations: tuple[int, int] | None = None  # of both solvers of a ball at the fork, where they differ
    # the flips that differ at the fork, the nearest to its threshold first
    decisions: tuple[StoredFlip, ...] = ()


def compare_folders(a: RunFolder | str | Path, b: RunFolder | str | Path) -> FolderFork:
    """Find the point at which two runs diverge, reading only their folders.

    Args:
        a, b: run folders, both of molecular dynamics or both of a ball; or folders of `mdnum flips` and
            `mdnum.Recorder`, in which steps are frames.

    Raises:
        InputError: one run is of molecular dynamics and one of a ball, or the systems differ, so that steps
            do not correspond (the message names the difference); or a folder holds the result of a fork.
        FolderError: a folder does not contain a run.
    """
    first = a if isinstance(a, RunFolder) else RunFolder.open(a)
    second = b if isinstance(b, RunFolder) else RunFolder.open(b)
    for folder in (first, second):
        folder.check_start()
        if folder.kind not in _ELSEWHERE:
            raise InputError(
                "the folder contains a result of `mdnum fork`; expected a run",
                where=str(folder.path),
                remedy="Give two output folders of `mdnum run`, `mdnum ball` or `mdnum flips`. To show a "
                "result of `mdnum fork`, use `mdnum report DIR`",
            )
    where = f"{first.path} and {second.path}"
    if first.kind != second.kind:
        kinds = f"the folders hold runs of different kinds, {first.kind} and {second.kind}"
        raise InputError(kinds, where=where, remedy="Give two folders of the same kind")
    with first.explained(), second.explained():
        return _compared(first, second, where)


def simulation_in(folder: Path, objects: Sequence[Simulation] = (), *, built: bool = True) -> Any:
    """Load the simulation or the ball system from a run folder.

    Args:
        objects: simulations, one of which produced the run; required if the run was made from objects.
        built: False to leave a system file unbuilt, so that code named in the file is not executed.

    Raises:
        InputError: none of the objects produced the run.
    """
    if not (folder / SIMULATION_FILE).is_file():
        return opened(load(folder)) if built else load(folder)
    if not objects:
        remedy = "Give it from Python, made by the same code: mdnum.fork_folders(a, b, objects=[...])"
        message = "was made from Python objects, and no file describes how to recreate them"
        raise InputError(message, where=str(folder), remedy=remedy)
    from mdnum.systems.build import again

    for one in objects[:-1]:
        with suppress(InputError):
            return again(folder, one)
    return again(folder, objects[-1])


def twin_of(found: FolderFork, objects: Sequence[Simulation] = ()) -> Twin:
    """Rebuild the programs of two molecular-dynamics runs from their folders.

    `simulation_in` describes `objects`. Repeated runs have the stored bits if versions and processor are the
    same.
    """
    difference = "; ".join(f"{key}: {one} and {other}" for key, one, other in found.differences[:3])
    a, b = alike(*(simulation_in(path, objects) for path in (found.a, found.b)))
    return Twin(program_of(a), program_of(b), difference or "nothing known")


def _compared(first: RunFolder, second: RunFolder, where: str) -> FolderFork:
    world, remedy = first.kind, "Compare two runs of the same system"
    elsewhere = _ELSEWHERE[world]
    keys = _different(flat(first.system), flat(second.system))
    programs = [row for row in keys if row[0] not in elsewhere and row[0].split(".")[0] not in elsewhere]
    noun = "balls" if world == "ball" else "atoms"
    counts = [folder.summary.get(noun) for folder in (first, second)]
    # a run that was killed has no summary; its structure is compared with the other's
    if None not in counts and counts[0] != counts[1]:
        raise InputError(f"the runs have {counts[0]} and {counts[1]} {noun}", where=where, remedy=remedy)
    for key, one, other in programs:
        if key in _SYSTEM[world] or (key.startswith("terms.") and key.endswith(".potential.kind")):
            raise InputError(
                f"the runs are of different systems: {key} is {one} in the first and {other} in the second",
                where=where,
                remedy="Give two runs of the same system; parameter values and numerical settings may differ",
            )
    if world == "flips":
        return _of_frames(first, second, where)
    starts = _starts(first, second, programs, where) if world == "md" else []
    found = (_md_dates if world == "md" else _ball_dates)(first, second)
    tables = (
        flat({key: folder.provenance[key] for key in _ARITHMETIC if key in folder.provenance})
        for folder in (first, second)
    )
    arithmetic = _different(*tables)
    # other starts need not show in a stored number at once
    first_bit = 0 if starts else found.pop("first_bit")
    flips = sorted(found.pop("decisions", ()), key=lambda flip: abs(flip.margin))
    return FolderFork(
        world=world, a=first.path, b=second.path, differences=(*programs, *starts, *arithmetic),
        causes=(*choices(programs), *["start"] * bool(starts), *["arithmetic"] * bool(arithmetic)),
        same_structure=not starts, decisions=tuple(flips), **{**found, "first_bit": first_bit},
    )  # fmt: skip


def _of_frames(first: RunFolder, second: RunFolder, where: str) -> FolderFork:
    """Find the first frame at which two trajectories or recorded loops differ in a decision."""
    summaries, names = (first.summary, second.summary), ("rule", "i", "j", "rank")
    rules, between = ([each[name] for each in summaries] for name in ("rules", "between"))
    names_of = [", ".join(one["rule"] for one in each) for each in rules]
    if names_of[0] != names_of[1] or between[0] != between[1]:
        seen = " and ".join(f"{one} {two or ''}".rstrip() for one, two in zip(names_of, between, strict=True))
        raise InputError(
            f"the two runs use different rules for neighbors: {seen}",
            where=where,
            remedy="Compare runs that use the same rule for neighbors",
        )
    differences = [(name, *(each[name] for each in summaries)) for name in _GIVEN]
    frames = [folder.read("frames", ["rule", "number"]) for folder in (first, second)]
    numbers = [each["number"][each["rule"] == 0] for each in frames]
    steps = min(map(len, numbers)) - 1
    if (other := np.flatnonzero(numbers[0][: steps + 1] != numbers[1][: steps + 1])).size:
        differences.append(("number of the frame", *(int(each[other[0]]) for each in numbers)))
    members = [folder.read("members", list(names)) for folder in (first, second)]
    same = all(np.array_equal(members[0][name], members[1][name]) for name in names)
    labels = (*names[1:], "rule")
    fork, flips = _alone(first, second, "flips", labels, steps, "frame") if same else (0, [])
    terms = [one["rule"] * (len(summaries[0]["rules"]) > 1) for one in summaries[0]["rules"]]
    flips = [replace(one, subject=one.subject[:-1], terms=terms[one.subject[-1]]) for one in flips]
    return FolderFork(
        "flips", first.path, second.path, tuple(row for row in differences if row[1] != row[2]), (), steps,
        None, fork, "" if fork is None else "pair", same,
        decisions=tuple(sorted(flips, key=lambda flip: abs(flip.margin))),
    )  # fmt: skip


def choices(programs: list[Difference]) -> list[str]:
    """Return the numerical choices in which two systems differ, given the differing keys.

    All dtypes count as one numerical choice. A cutoff and its parameters count as one choice."""
    keys = [key for key, _, _ in programs]
    out: dict[str, None] = {}
    for key, one, other in programs:
        table, _, name = key.rpartition(".")
        if table == "precision" and name in ROLES["md"]:
            out["precision"] = None
        elif not (table.endswith("cutoff") and f"{table}.kind" in keys and None in (one, other)):
            out[key] = None
    return list(out)


def _different(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Difference]:
    keys = dict.fromkeys([*one, *other])
    return [(key, one.get(key), other.get(key)) for key in keys if one.get(key) != other.get(key)]


def _alone(
    first: RunFolder, second: RunFolder, table: str, labels: tuple[str, ...], steps: int, clock: str = "step"
) -> tuple[int | None, list[StoredFlip]]:
    """Return the flips that only one table contains, at the first step with such flips."""
    known = [folder.table(table, rows=1).column_names for folder in (first, second)]
    names = (clock, *labels, "entered", *["terms"] * all("terms" in one for one in known))
    further = ("distance", "ambiguous") if table == "flips" else ()
    tables = [folder.read(table, [*names, "margin", "bound", *further]) for folder in (first, second)]
    rows = [
        {row: k for k, row in enumerate(zip(*(data[name].tolist() for name in names), strict=True))}
        for data in tables
    ]
    alone = {row for row in rows[0].keys() ^ rows[1].keys() if row[0] <= steps}
    if not alone:
        return None, []
    step = int(min(row[0] for row in alone))
    flips = []
    for run, known, data in zip("AB", rows, tables, strict=True):
        for row in sorted(known.keys() & {row for row in alone if row[0] == step}):
            k = known[row]
            margin, bound = float(data["margin"][k]), float(data["bound"][k])
            distance = float(data["distance"][k]) if "distance" in data else float("nan")
            ambiguous = bool(data["ambiguous"][k]) if "ambiguous" in data else abs(margin) <= bound
            subject, entered = tuple(map(int, row[1 : 1 + len(labels)])), bool(row[1 + len(labels)])
            term = str(data["terms"][k]) if "terms" in names else ""
            flips.append(StoredFlip(run, step, subject, term, entered, margin, bound, distance, ambiguous))
    return step, flips


def _md_dates(first: RunFolder, second: RunFolder) -> dict[str, Any]:
    series = [folder.read("series", ["step", "pairs", *_NUMBERS]) for folder in (first, second)]
    steps = min(len(table["step"]) for table in series) - 1
    if steps < 0:
        raise InputError("one of the runs has no recorded step", remedy="Resume that run, or run it again")
    differ = np.zeros(steps + 1, bool)
    for name in _NUMBERS:
        one, other = (table[name][: steps + 1] for table in series)
        differ |= ~((one == other) | (np.isnan(one) & np.isnan(other)))
    dates = {"steps": steps, "first_bit": int(differ.argmax()) if differ.any() else None}
    if series[0]["pairs"][0] != series[1]["pairs"][0]:
        return {**dates, "fork": 0, "channel": "pair"}
    fork, flips = _alone(first, second, "flips", ("i", "j"), steps)
    return {**dates, "fork": fork, "channel": "" if fork is None else "pair", "decisions": flips}


def _ball_dates(first: RunFolder, second: RunFolder) -> dict[str, Any]:
    tables = [folder.read("steps") for folder in (first, second)]
    steps = min(int(table["step"][-1]) for table in tables)
    heights = [folder.read("heights") for folder in (first, second)]
    kept = [{name: values[table["step"] <= steps] for name, values in table.items()} for table in heights]
    first_bit = None
    if len(kept[0]["step"]) == len(kept[1]["step"]):
        differ = (kept[0]["y"] != kept[1]["y"]) | (kept[0]["v"] != kept[1]["v"])
        first_bit = int(kept[0]["step"][differ].min()) if differ.any() else None
    contact, flips = _alone(first, second, "contacts", ("ball",), steps)
    counts = [table["iterations"][: steps + 1] for table in tables]
    off = np.flatnonzero(counts[0] != counts[1])
    stop = int(off[0]) if len(off) else None
    fork = min((step for step in (contact, stop) if step is not None), default=None)
    at_contact, at_stop = (fork is not None and fork == step for step in (contact, stop))
    return {
        "steps": steps,
        "first_bit": first_bit,
        "fork": fork,
        "channel": "contact" if at_contact else "stop" if at_stop else "",
        "decisions": flips if at_contact else [],
        "iterations": (int(counts[0][fork]), int(counts[1][fork])) if at_stop else None,
    }


def _starts(first: RunFolder, second: RunFolder, programs: list[Difference], where: str) -> list[Difference]:
    """List the differences between the atoms of two runs at step 0."""
    from ase import Atoms
    from ase.io import read

    paths = [folder.path / "structure.extxyz" for folder in (first, second)]
    if not all(path.exists() for path in paths):
        return []
    # a single frame each, which ase types as if it were several
    atoms = [each for each in map(read, paths) if isinstance(each, Atoms)]
    one, other = atoms
    different = next((text for is_same, text in _same_system(one, other) if not is_same), None)
    if different is not None:
        raise InputError(
            f"the two runs are of different systems: {different}",
            where=where,
            remedy="Compare two runs of the same system",
        )
    rows: list[Difference] = []
    for name, (a, b) in {
        "box": (one.cell.array, other.cell.array),
        "masses": (one.get_masses(), other.get_masses()),
    }.items():
        if not np.array_equal(a, b):
            rows.append((f"start: {name}", "", "other last digits"))
    if not np.array_equal(one.positions, other.positions):
        moved = other.positions - one.positions
        images = np.round(moved @ np.linalg.pinv(one.cell.array)) * one.pbc
        moved -= images @ one.cell.array
        rows.append(("start: positions", "", f"up to {np.linalg.norm(moved, axis=1).max():.3g} away"))
    momenta = [each.arrays.get("momenta") for each in atoms]
    switched = any(key == "structure.velocities" for key, _, _ in programs)
    if switched or any(each is None for each in momenta):
        # they are drawn when the run begins, from what the file says
        if any(key in _DRAWN for key, _, _ in programs) or any(each is not None for each in momenta):
            rows.append(("start: velocities", "", "drawn otherwise"))
    elif not np.array_equal(one.arrays["momenta"], other.arrays["momenta"]):
        rows.append(("start: velocities", "", "other"))
    return rows


def _same_system(one: Any, other: Any) -> Iterator[tuple[bool, str]]:
    """Compare two sets of atoms. For each property, yield whether it agrees, and a message."""
    yield len(one) == len(other), f"numbers of atoms differ, {len(one)} and {len(other)}"
    symbols = [each.get_chemical_symbols() for each in (one, other)]
    yield symbols[0] == symbols[1], "species or their order differ"
    yield np.allclose(one.get_masses(), other.get_masses(), rtol=_SAME), "masses differ"
    yield bool((one.pbc == other.pbc).all()), "periodic directions differ"
    size = float(np.abs(one.cell.array).max())
    yield bool(np.allclose(one.cell.array, other.cell.array, atol=_SAME * size, rtol=0)), "boxes differ"
