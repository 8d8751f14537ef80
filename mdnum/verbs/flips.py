"""`mdnum flips`: a table of all flips (pairs entering or leaving a cutoff) in a trajectory."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError, MdnumError, expect_at_least, expect_path
from mdnum.plain import headed
from mdnum.store import RunFolder
from mdnum.store.files import default_folder
from mdnum.store.tables import TableStream, as_numpy
from mdnum.verbs import Reply
from mdnum.verbs.flips_page import judge, page
from mdnum.verbs.flips_shared import FlipsView, HeldRows, about, as_python, ending, selected, stem
from mdnum.verbs.frame import Answer, Keep, Outcome, Progress, Verb, answering, keywords_checked, refuse, say

if TYPE_CHECKING:
    from mdnum.trajectories.follow import Followed, Pass
    from mdnum.trajectories.history import History
    from mdnum.trajectories.lost import FrameMotion
    from mdnum.trajectories.residues import ByResidue
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.statistics import Classes, Statistics
    from mdnum.trajectories.topology import AtomTable
    from mdnum.trajectories.tracker import Groups
    from mdnum.trajectories.trajectory import Trajectory

#: Default number of frames within which a reversed flip counts as chatter.
WINDOW = 5
# seconds in units of time, and how far apart in seconds no simulation of atoms has its frames
_SECONDS = {"fs": 1e-15, "ps": 1e-12, "ns": 1e-9, "μs": 1e-6, "s": 1.0}
_SHORTEST, _LONGEST = 1e-19, 1e-2
# rows of the ledger that are worked on at once, and such parts that are held, at 22 bytes a row
_PART_ROWS, _PARTS_HELD = 1_500_000, 10
# places at which frames are missing that are named
_GAPS = 6
# an odd number, so that the parts of a crystal's regular labels are alike
_SPREAD = 1_000_003
# files that hold positions and nothing on what the atoms are
_BARE = frozenset({"xtc", "trr", "dcd", "nc", "ncdf", "netcdf", "trj", "mdcrd", "crdbox", "trz", "h5md"})
_Pairs = str | Mapping[tuple[str, str], float] | Mapping[str, float]
# and files that say what the atoms are and hold one frame, if any
_STRUCTURES = frozenset({"psf", "prmtop", "parm7", "top", "tpr", "itp", "data", "mol2"})
_PAIRS = 'Write pairs of species with a length each, for example --pairs "O-H=2.5,O-O=3.5"'


@keywords_checked
def flips(
    trajectory: Any,
    other: str | Path | None = None,
    *,
    cell: Any = None,
    box: Any = None,
    pbc: Any = None,
    fractional: bool | None = None,
    species: Any = None,
    velocities: Any = None,
    timestep: float | None = None,
    length: str | None = None,
    time: str | None = None,
    topology: str | Path | None = None,
    cutoffs: float | Sequence[float] = (),
    pairs: _Pairs | Sequence[_Pairs] = (),
    nearest: int | Sequence[int] = (),
    most: int | None = None,
    between: tuple[str, str] | None = None,
    by: str = "atom",
    hydrogens: bool = False,
    window: int = WINDOW,
    format: str | None = None,
    drop_repeats: bool = False,
    **keep: Unpack[Keep],
) -> Outcome:
    """Find all pairs that cross a cutoff between frames of a trajectory.

    Example:
        >>> mdnum.flips("run.dcd", topology="start.pdb", cutoffs=[8.5])
        >>> mdnum.flips(positions, cell=box_lengths, cutoffs=2.5)
        >>> mdnum.flips(states.position, box=box, fractional=True, cutoffs=2.5)

    Args:
        trajectory: a file that MDAnalysis or ASE can read, or the folder of an mdnum run; to select frames,
            append @ and a slice ("run.xtc@100:", "run.xtc@::10"). Or an array (frames, atoms, 3) of lengths,
            or a list of ASE `Atoms`; `Recorder` accepts neighbor lists and energies too.
        other: another file of the same atoms, to find where the two trajectories diverge.
        cell, box, velocities: for an array: lengths, or lattice vectors as rows (cell) or columns (box), one
            for all frames or one per frame; velocities (frames, atoms, 3) require a timestep.
        pbc, fractional, species, timestep, length, time: for an array, as for `Recorder`; `timestep` is the
            time between consecutive frames.
        topology: file that identifies the atoms, if the trajectory does not.
        cutoffs: one or more lengths in the file's unit, one rule each; by default the cutoff of the mdnum run
            that the file belongs to. A single rule needs no sequence here, in `pairs` or in `nearest`.
        pairs: cutoffs by pair of species, one rule each: "O-H=2.5,O-O=3.5" or {"O-H": 2.5, "O-O": 3.5}.
        nearest: numbers of neighbors, one rule each: the k nearest neighbors of every atom.
        most: maximum number of neighbors of an atom inside a cutoff; the nearest are kept.
        between: two selections in MDAnalysis syntax; only pairs with one atom in each are examined.
        by: "atom" for pairs of atoms, "residue" for pairs of residues; two residues are inside if their
            nearest two atoms are.
        hydrogens: whether hydrogens and virtual sites count in contacts between residues.
        window: number of frames. A flip reversed within this number is chatter; a shorter or equal absence
            does not end an intermittent contact.
        format: format of the files, if their names do not reveal it.
        drop_repeats: omit every frame that repeats an earlier frame or its time; other frames keep their
            numbers. Such frames are reported in any case.
        keep: see `frame.Keep`; without overrides.

    Raises:
        InputError: a file or an option cannot be used. An unreadable frame in the middle of a file raises no
            exception: the results before it are kept, and the summary names the frame.
        FolderError: the folder cannot be used.
    """
    from mdnum.trajectories.arrays import ArrayFrames
    from mdnum.trajectories.readers import open_trajectory

    expect_at_least(1, window=window)
    if by not in ("atom", "residue"):
        raise InputError(f"by = {by!r}; expected either atom or residue")
    if by == "atom":
        refuse({"hydrogens": hydrogens}, "of contacts between residues", "Add --by residue, or leave it out")
    files = {"other": other is not None, "topology": topology is not None, "format": format is not None}
    arrays: dict[str, Any] = {
        "cell": cell, "box": box, "pbc": pbc, "fractional": fractional, "species": species,
        "velocities": velocities, "timestep": timestep, "length": length, "time": time,
    }  # fmt: skip
    arrays = {name: one for name, one in arrays.items() if one is not None}
    if in_memory := hasattr(trajectory, "shape") or type(trajectory) in (list, tuple):
        refuse(files, "of files", "Leave it out for arrays")
    else:
        refuse(dict.fromkeys(arrays, True), "of arrays", "Leave it out: a file contains its own values")
    open_one = partial(open_trajectory, topology=topology, format=format)
    with as_python(in_memory):
        asked = rules(cutoffs, pairs, nearest, most)
        if other is not None:
            from mdnum.verbs.flips_compare import compare

            refuse({"by": by != "atom"}, "of one trajectory", "Leave it out, or examine each separately")
            _refuse_topology_first(trajectory, other, topology)
            a, b = map(open_one, (trajectory, other))
            a.drop_repeats = b.drop_repeats = drop_repeats
            return compare(a, b, asked or _default_rules(a), between, **keep)
        reach = max((one.reach for one in asked), default=0.0)
        opened = ArrayFrames.of(trajectory, reach, **arrays) if in_memory else open_one(trajectory)
        opened.drop_repeats = drop_repeats
        asked, light = asked or _default_rules(opened), hydrogens if by == "residue" else None
        with examining(opened, asked, between, window, hydrogens=light, **keep) as one:
            of = opened.count or 0
            one.interrupted = one.rows.drain(one.answer.folder, one.passes, one.found, of, one.answer.log)
    return one.answer.outcome


@partial(keywords_checked, more=[*inspect.signature(flips).parameters][2:-1])
def flips_each(
    trajectories: Sequence[str | Path],
    *,
    out: str | Path = "runs",
    on: str | Executor | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> list[Outcome | MdnumError]:
    """Find the flips in each of several trajectories, such as replicas.

    Example:
        >>> mdnum.flips_each(["a.xtc", "b.xtc"], topology="a.gro", cutoffs=[4.0], workers=2)

    Args:
        trajectories: files, as for `flips`.
        out: folder in which a new folder is created for each trajectory.
        on, workers: where to compute, as for `mdnum.sweep`; by default in this process.
        progress: see `mdnum.verbs.frame.Keep`.
        options: options of `flips`, which apply to every trajectory.

    Returns:
        an outcome for each trajectory, or the error if the trajectory cannot be used, in the order of the
        trajectories; if interrupted, up to the outcome of the interrupted one.

    Raises:
        InputError: no such engine, or an engine that fails repeatedly.
    """
    from mdnum.sweeps import engines

    if isinstance(trajectories, str | Path):
        raise InputError("found one path; expected a list", where=str(trajectories), remedy="Give [path]")
    if options.get("topology") is not None:
        options["topology"] = Path(options["topology"]).absolute()
    tasks = [(Path(one).absolute(), Path(out).absolute(), options) for one in trajectories]
    made = list[Outcome | MdnumError]()
    with engines.requested(on, workers) as engine:
        results = engines.in_order(_examined, tasks, engine, keep=True)
        for done, (file, *_) in enumerate(tasks):
            say(progress, f"{file.name} ({done + 1} of {len(tasks)})", done, len(tasks), unit="files")
            made.append(one := next(results))
            if isinstance(one, Outcome) and one.summary["interrupted"]:
                break
    return made


def _examined(task: tuple[Path, Path, Mapping[str, Any]]) -> Outcome | MdnumError:
    file, out, options = task
    folder = None
    try:
        folder = default_folder(f"flips-{file.name.partition('@')[0].partition('.')[0]}", out)
        return replace(flips(file, out=folder, progress=False, **options), result=None)
    except MdnumError as error:
        if folder is not None:
            with suppress(OSError):  # it has files
                folder.rmdir()
        return error


def command(
    trajectory: str, other: str | None = None, more: Sequence[str] | None = None, *, each: bool = False,
    on: str | None = None, workers: int | None = None, **given: Any,
) -> Outcome | Reply:  # fmt: skip
    """Execute `mdnum flips`.

    Raises:
        InputError: more than two trajectories, or an option of several, without `--each`.
    """
    if each:
        given |= {name: one for name, one in {"on": on, "workers": workers}.items() if one is not None}
        return _replied([one for one in (trajectory, other, *(more or ())) if one is not None], **given)
    remedy = "Add --each to examine each trajectory separately"
    refuse({"on": on is not None, "workers": workers is not None}, "of --each", remedy)
    if more:
        raise InputError("more than two trajectories cannot be compared", where=more[0], remedy=remedy)
    return flips(trajectory, other, **given)


def _replied(trajectories: Sequence[str], **given: Any) -> Reply:
    rows, fine, stopped = [], True, False
    for file, one in zip(trajectories, flips_each(trajectories, **given), strict=False):
        if isinstance(one, Outcome):
            found = [finding.code for finding in one.findings if finding.severity in ("warning", "error")]
            stopped = one.summary["interrupted"]
            told = {"folder": one.path, "frames": one.summary["frames"], "headline": one.verdict.headline,
                    "flips": [rule["flips"] for rule in one.summary["rules"]], "error": None}  # fmt: skip
        else:
            found, told = [], dict.fromkeys(("folder", "frames", "headline", "flips")) | {"error": str(one)}
        rows.append({"file": file, **told, "findings": found})
        fine = fine and not found and isinstance(one, Outcome)
    lines = [
        (row["file"], row["error"] or row["headline"], ", ".join(row["findings"]), row["folder"])
        for row in rows
    ]
    shown = [("", ("file", "result", "warnings and errors", "folder"), lines)]
    status = "stopped" if stopped else "complete" if fine else "failed"
    return Reply(headed("flips-each", {"files": rows}), shown, status)


@dataclass
class FrameExamination:
    """Examination of a trajectory, frame by frame."""

    answer: Answer  # its folder takes what follows from the tables, when all frames were examined
    rows: HeldRows  # to be handed over to the folder by then
    passes: Iterator[Pass]  # a step for each frame but the first, which was examined
    found: Pass  # what was found so far
    interrupted: bool = False  # whether there were more


@contextmanager
def examining(
    opened: Trajectory, asked: tuple[Rule, ...], between: tuple[str, str] | None, window: int,
    live: bool = False, hydrogens: bool | None = None, **keep: Unpack[Keep],
) -> Iterator[FrameExamination]:  # fmt: skip
    """Context manager: make an output folder and examine frames (see `flips`).

    Args:
        live: whether frames come from a running program. Frame numbers are then time steps, with no decisions
            in between, and rows are kept in part files because the program may be killed.
        hydrogens: whether hydrogens count in contacts between residues; None for pairs of atoms.
    """
    from mdnum.trajectories.follow import follow
    from mdnum.trajectories.lost import FrameMotion
    from mdnum.trajectories.residues import ByResidue
    from mdnum.trajectories.resolution import grid_effect, infer
    from mdnum.trajectories.tracker import atoms_of
    from mdnum.trajectories.unwrapping import told as told_of_motion

    groups, residues = selected(opened, between), None
    if hydrogens is not None:
        residues = ByResidue.make(opened.table, groups, hydrogens, asked)
        groups = residues.groups
    sample, seen = opened.sample(), atoms_of(groups)
    moving = opened.atoms if seen is None else len(seen)
    resolution = infer(sample, opened.bits, opened.format)
    rows = HeldRows(opened)
    passes = follow(opened, asked, groups, resolution, rows.add, residues)
    # no folder for a file whose first frame cannot be used
    found, began = next(passes), time.perf_counter()
    with answering("flips", f"flips-{stem(opened)}", **keep) as answer:
        folder, log = answer.folder, answer.log
        folder.in_parts, atoms = live, (residues or opened).table.columns
        for end in "ij":
            folder.look_up("flips", end, {f"{name}_{end}": values for name, values in atoms.items()})
        yield (one := FrameExamination(answer, rows, passes, found))
        read = time.perf_counter()
        frames = folder.read("frames")
        steps = _steps(frames, opened)
        timed = steps["timed"] and found.odd is None
        motion = FrameMotion.of(sample, resolution, *groups, timed=timed)
        told: list[dict[str, Any]] = [
            _rule_told(
                folder, number, rule, found, frames, steps, opened, residues or groups, window, motion, log
            )
            | {
                "grid": None
                if residues
                else grid_effect(resolution, sample, rule.reach, *groups, ranked=rule.ranked)
            }
            for number, rule in enumerate(found.rules)
        ]
        if live and (np.diff(frames["number"][frames["rule"] == 0]) == 1).all():
            told = [each | {"stride": {**each["stride"], "between": None}} for each in told]
        answer.result, answer.summary = found, {
            **about(opened, "flips", between),
            **({"by": "residue", "left_out": residues.left_out} if residues else {}),
            "box": sample[0].box.plain(),
            "frames": found.frames,
            **steps,
            "window": window,
            "resolution": resolution,
            "rules": told,
            "flight": found.odd,
            "leaps": {"frames": len(found.leaps), **found.leaps[0]} if found.leaps else None,
            "alternative_box": _with_other_box(opened, sample[0], found, residues or groups),
            "repeats": opened.repeats.plain(),
            "unwrapping": told_of_motion(folder.read("motion"), moving, steps["timed"]),
            "retyped": opened.check.retyped,
            "cut_short": _cut_short(found.stopped, opened),
            **ending(found.stopped, one.interrupted, opened.in_memory),
            "seconds": time.perf_counter() - began, "seconds_of_frames": read - began,
            **answer.summary,
        }  # fmt: skip


KINDS = {"flips": Verb(judge, page, FlipsView)}


# ---- what is asked for


def rules(
    cutoffs: float | Sequence[float] = (),
    pairs: _Pairs | Sequence[_Pairs] = (),
    nearest: int | Sequence[int] = (),
    most: int | None = None,
) -> tuple[Rule, ...]:
    """Return the rules that define neighbors.

    Raises:
        InputError: a value is not a valid rule, a rule is repeated, or `most` is given without a cutoff.
    """
    from mdnum.trajectories.rules import Capped, CutoffRule, Nearest, SpeciesCutoffs

    if most is not None and not cutoffs:
        raise InputError(
            "the option --most selects the nearest neighbors inside a cutoff, but no cutoff was given",
            remedy="Add --cutoff R, or write --nearest K for the K nearest neighbors without a cutoff",
        )
    radii, species, counts = map(_listed, (cutoffs, pairs, nearest))
    if wrong := [one for one in (*radii, *counts) if not isinstance(one, Real)]:
        raise InputError(f"{wrong[0]!r} is not a number", remedy="Write cutoffs=5.0 or cutoffs=[4.0, 5.0]")
    found: list[Rule] = [CutoffRule(r) if most is None else Capped(r, most) for r in map(float, radii)]
    found += [SpeciesCutoffs(_species_cutoffs(one)) for one in species]
    found += [Nearest(k) for k in counts]
    names = [one.name for one in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"the rule {twice[0]!r} is given twice", remedy="Keep one of them")
    return tuple(found)


def _listed(given: Any) -> tuple[Any, ...]:
    """Return a tuple of the given values. A single value becomes a tuple of one."""
    return (given,) if isinstance(given, str | Real | Mapping) else tuple(given)


def _species_cutoffs(words: _Pairs) -> Mapping[Any, float]:
    """Parse cutoffs by pair of species, given as "O-H=2.5,O-O=3.5" or as {"O-H": 2.5}."""
    if isinstance(words, Mapping):
        if all(isinstance(pair, tuple) and len(pair) == 2 for pair in words):
            return words
        words = ",".join(f"{pair}={radius}" for pair, radius in words.items())
    found: dict[tuple[str, str], float] = {}
    for part in words.split(","):
        pair, equals, value = part.partition("=")
        first, dash, second = (one.strip() for one in pair.partition("-"))
        try:
            length = float(value)
        except ValueError:
            length = math.nan
        if not (equals and dash and first and second) or "-" in second or not length > 0:
            raise InputError(
                f"{part.strip()!r} in --pairs {words!r} does not have the form A-B=LENGTH", remedy=_PAIRS
            )
        if {(first, second), (second, first)} & set(found):
            raise InputError(f"--pairs {words!r} gives {first}-{second} twice", remedy="Keep one of them")
        found[first, second] = length
    return found


def _default_rules(trajectory: Trajectory) -> tuple[Rule, ...]:
    """Return the cutoff of the mdnum run that wrote the trajectory."""
    radius = None
    # no run of mdnum's
    with suppress(OSError, MdnumError, AttributeError):
        radius = RunFolder(trajectory.path.parent).system.get("cutoff", {}).get("radius")
    if not isinstance(radius, int | float):
        unit = f" in {trajectory.length}" if trajectory.length else ""
        message = "no rule selects the pairs to examine"
        remedy = f'Add --cutoff R{unit}, --pairs "O-H=2.5,O-O=3.5" or --nearest K'
        raise InputError(message, remedy=remedy, where=str(trajectory.path))
    return rules([float(radius)])


def _refuse_topology_first(first: str | Path, second: str | Path, topology: str | Path | None) -> None:
    """Raise an error if the topology is given before the trajectory."""
    from mdnum.trajectories.readers import IN_MEMORY, open_trajectory

    for one in (first, second):
        expect_path(one, IN_MEMORY)
    names = [str(one).rpartition("@")[0] or str(one) for one in (first, second)]
    kinds = [Path(one).suffix.lower().lstrip(".") for one in names]
    if topology is None and kinds[0] not in _BARE and kinds[1] in _BARE:
        # a structure that several frames have is a trajectory
        with suppress(InputError):
            if kinds[0] not in _STRUCTURES and len(open_trajectory(names[0]).sample()) > 1:
                return
        raise InputError(
            f"two trajectories were expected, but {Path(names[0]).name} looks like the topology of "
            f"{Path(names[1]).name}",
            remedy=f"Write mdnum flips {second} -s {first}",
        )


# ---- the ledger, and what is counted from it


def _with_other_box(
    trajectory: Trajectory, frame: Any, found: Pass, of: Groups | ByResidue
) -> dict[str, Any] | None:
    """Count the neighbor pairs of a frame in another plausible box. None if there is no such box."""
    from mdnum.trajectories.tracker import Tracker

    if (other := trajectory.other_box(frame.index)) is None:
        return None
    species = list(map(str, trajectory.species))
    trackers: list[Any] = [
        Tracker(one.rule, *of, species) if isinstance(of, tuple) else of.tracker(one.rule, species)
        for one in found.rules
    ]
    for one in trackers:
        one.step(replace(frame, box=other[1]))
    pairs = [one.pairs for one in trackers]
    return {"code": other[0], "frame": frame.index, "box": other[1].plain(), "pairs": pairs}


def _cut_short(error: InputError | None, trajectory: Trajectory) -> bool:
    """True if reading stopped at an incomplete last frame."""
    from mdnum.reading import UnreadableFrame

    if not isinstance(error, UnreadableFrame):
        return False
    if "the file ends" in error.message:
        return True
    return trajectory.in_file is not None and error.frame >= trajectory.in_file - 1


def _steps(frames: Mapping[str, np.ndarray], trajectory: Trajectory) -> dict[str, Any]:
    """Summarize the times of the frames: interval, uniformity, missing frames, and implausible values."""
    timed = trajectory.time != "frame"
    times = frames["time"][frames["rule"] == 0]
    steps = np.diff(times)
    interval = float((times[-1] - times[0]) / len(steps)) if len(steps) else math.nan
    numbers = frames["number"][frames["rule"] == 0]
    backward = int(np.count_nonzero(steps <= 0))
    seconds = abs(interval) * _SECONDS.get(trajectory.time, math.nan)
    absurd, swapped = bool(seconds > _LONGEST or 0 < seconds < _SHORTEST), interval * trajectory.swapped
    return {
        # frames are counted where their times do not go forward
        "timed": timed and not backward and not absurd,
        "absurd": absurd,
        "swapped": swapped if absurd and _SHORTEST < swapped * _SECONDS["ps"] < _LONGEST else None,
        "has_times": timed and not (len(steps) and (steps == 0).all()),
        "first_time": float(times[0]),
        "last_time": float(times[-1]),
        "interval": interval,
        "even": bool(np.all(np.abs(steps - interval) <= 1e-3 * abs(interval))) if len(steps) else True,
        "backward": backward,
        "missing": _missing(numbers, times) if timed and not backward else None,
    }


def _missing(numbers: np.ndarray, times: np.ndarray) -> dict[str, Any] | None:
    """Find missing frames from gaps in time. None if times are not regular."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    ratio = steps / usual if usual > 0 else np.ones_like(steps)
    whole = np.rint(ratio)
    if not len(steps) or (np.abs(ratio - whole) > 0.01).any() or 4 * (whole > 1).sum() > len(steps):
        return None
    places = [
        {"after": int(numbers[k]), "lost": int(whole[k]) - 1, "time": float(times[k])}
        for k in np.flatnonzero(whole > 1)
    ]
    total = sum(one["lost"] for one in places)
    return (
        {"frames": total, "usual": usual, "gaps": len(places), "places": places[:_GAPS]} if places else None
    )


def histories(folder: RunFolder, rule: int, frames: int) -> Iterator[tuple[int, int, History]]:
    """Yield the flips of one rule, sorted by atom pair, as (block, number of blocks, flips).

    The table of flips is sorted by frame and may be larger than memory. Each block contains all flips of some
    atom pairs. The table is read once for each group of blocks that fits into memory.
    """
    from mdnum.trajectories.history import History

    streams = {name: TableStream(folder.path, name, folder.layout) for name in ("members", "flips")}
    parts = max(1, -(-sum(stream.flushed for stream in streams.values()) // _PART_ROWS))

    def columns(name: str, wanted: range, kinds: list[str]) -> Iterator[dict[str, np.ndarray]]:
        """Yield the columns of a table, block by block."""
        found: list[list[dict[str, np.ndarray]]] = [[] for _ in wanted]
        names, stream = ["rule", *kinds], streams[name]
        for batch in chain([stream.read(names, rows=0)], stream.batches(names)):
            rows = {name: as_numpy(batch[name]) for name in names}
            of = (rows["i"].astype(np.int64) * _SPREAD + rows["j"]) % parts
            of[rows["rule"] != rule] = -1
            for part, held in zip(wanted, found, strict=True):
                mine = np.flatnonzero(of == part)
                held.append({kind: rows[kind][mine] for kind in kinds})
        for held in found:
            yield {kind: np.concatenate([rows[kind] for rows in held]) for kind in kinds}

    pair = ["i", "j", "rank"]
    for begin in range(0, parts, _PARTS_HELD):
        wanted = range(begin, min(begin + _PARTS_HELD, parts))
        flips = columns("flips", wanted, ["frame", "entered", *pair, "ambiguous"])
        for part, rows, first in zip(wanted, flips, columns("members", wanted, pair), strict=True):
            yield part, parts, History.of(rows, first, frames)


def _rule_told(
    folder: RunFolder,
    number: int,
    one: Followed,
    found: Pass,
    frames: Mapping[str, np.ndarray],
    steps: Mapping[str, Any],
    trajectory: Trajectory,
    of: Groups | ByResidue,
    window: int,
    motion: FrameMotion | None,
    log: Progress,
) -> dict[str, Any]:
    """Return statistics of the flips of one neighbor rule. Write tables to the output folder."""
    from mdnum.trajectories.residues import Occupancy, contacts_over_time
    from mdnum.trajectories.statistics import Labels, Statistics

    assert one.neighbors is not None
    residues = None if isinstance(of, tuple) else of
    table, groups = (trajectory.table, of) if isinstance(of, tuple) else (of.table, of.sides)
    labels, total, moments = Labels.of(table), None, None
    named = np.empty(0, object)
    if residues is not None:
        # the species of a residue is its name
        labels = replace(labels, residue_names=None)
        named = np.array(_words(table, np.arange(len(table))), object)

    def append(table: str, columns: Mapping[str, Any]) -> None:
        length = len(next(iter(columns.values())))
        folder.append(table, {"rule": np.full(length, number), **columns})

    for part, parts, history in histories(folder, number, found.frames):
        total, stays = Statistics.of(history, labels, one.rule.directed, window, total)
        if residues is None:
            append("contacts", vars(stays))
        else:
            times = np.append(frames["time"][frames["rule"] == number], np.nan)
            when = {"time": times[stays.begin], "time_end": np.where(stays.ended, times[stays.end], np.nan)}
            append("contacts", {**vars(stays), **when, "first": named[stays.i], "second": named[stays.j]})
            pairs = Occupancy.of(stays, found.frames)
            append("occupancy", {**vars(pairs), "first": named[pairs.i], "second": named[pairs.j]})
            begin, now = contacts_over_time(stays, len(table), found.frames)
            moments = now if moments is None else moments + now
        log(part + 1, parts, {"phase": "counting contacts", "unit": "parts"})
    assert total is not None, "there is at least one part"
    rows = {name: values[frames["rule"] == number] for name, values in frames.items()}
    seen = np.flatnonzero(one.neighbors.seen)
    append("neighbors", {"neighbors": seen, "counted": one.neighbors.seen[seen]})
    append("lifetimes", total.curves(rows["pairs"], steps["interval"]))
    busiest = vars(total.busiest)
    first, second = (_words(table, busiest[end]) for end in "ij")
    append("busiest", {**busiest, "first": first, "second": second})
    if moments is not None and moments.any():
        ever = np.flatnonzero(moments.any(axis=1))
        columns = {"residue": np.array(_words(table, ever), object), "index": ever}
        columns = {name: np.repeat(values, len(begin)) for name, values in columns.items()}
        when = {"frame": np.tile(begin, len(ever)), "time": np.tile(rows["time"][begin], len(ever))}
        append("moments", {**columns, **when, "contacts": moments[ever].ravel()})
    if total.residues is not None and labels.residues is not None:
        between, within = total.residues.between, total.residues.within
        busy = np.flatnonzero(between + within)
        busy = busy[np.argsort(-(between + within)[busy], kind="stable")]
        names = [labels.residues.names[at] for at in busy]
        append("residues", {"residue": names, "between": between[busy], "within": within[busy]})
    entered, left = int(rows["entered"].sum()), int(rows["left"].sum())
    inside, margins, count = rows["pairs"], rows["min_margin"], found.frames
    told = {
        "rule": one.rule.name,
        "directed": one.rule.directed,
        "pairs_first": int(inside[0]), "pairs_last": int(inside[-1]), "pairs_mean": float(inside.mean()),
        "pairs_least": int(inside.min()), "pairs_most": int(inside.max()),
        "entered": entered, "left": left, "flips": entered + left,
        "flips_per_frame": (entered + left) / (count - 1) if count > 1 else None,
        "ambiguous": int(rows["ambiguous"].sum()),
        "near_mean": float(rows["near"].mean()),
        "min_margin": float(np.nanmin(np.abs(margins))) if np.isfinite(margins).any() else None,
        "neighbors": {
            "fewest": int(rows["fewest"].min()), "mean": float(rows["neighbors"].mean()),
            "most": int(rows["most"].max()),
        },
        "flux": (flux := _flux(one, entered + left, steps, found)),
        **_counted(total, motion, flux, one.reach if residues is None else None),
    }  # fmt: skip
    for name, coded in (("by_species", labels.species), ("by_residue_name", labels.residue_names)):
        if coded is not None:
            told[name] = [_as_asked(row, coded, groups) for row in told[name]]
    return told


def _counted(
    total: Statistics, motion: FrameMotion | None, flux: Mapping[str, Any] | None, reach: float | None
) -> dict[str, Any]:
    """Return contact statistics with times in frames. With `reach`, also estimate missed flips."""
    from mdnum.trajectories.lost import lost_flips
    from mdnum.trajectories.statistics import Lifetime

    durations, chatter = total.durations, total.chatter
    # how well it is estimated was measured of pairs of atoms alone
    between = None if reach is None else lost_flips(total.strides, motion, flux, reach)
    return {
        "pairs_flipped": total.pairs,
        "images": total.images,
        "contacts": {name: int(lengths.sum()) for name, lengths in vars(durations).items()},
        # of the pairs inside at a frame that were examined again, those still inside at the next
        "stays_over": 1 - durations.leaves / max(durations.exposure, 1),
        "lifetime": Lifetime.of(durations),
        "intermittent": Lifetime.of(total.intermittent),
        "by_species": total.by_species.rows(),
        "by_residue_name": [] if total.by_residue_name is None else total.by_residue_name.rows(),
        "chatter": {
            "window": chatter.window, "undone": chatter.undone,
            "share": chatter.undone / chatter.flips if chatter.flips else 0.0,
            "inside": chatter.inside, "outside": chatter.outside,
        },
        "stride": {**vars(total.strides), "between": between and asdict(between), "motion": motion},
    }  # fmt: skip


def _words(table: AtomTable, atoms: np.ndarray) -> list[str]:
    """Return names of atoms, such as "GLY 12 CA" or "CA", or of residues ("GLY 12").

    If there are several segments, a name begins with its segment: "A GLY 12".
    """
    several = len(set(table.segments.tolist())) > 1
    columns = (table.segments, table.residue_names, table.residue_ids, table.names)
    rows = (tuple(one[at] for one in columns) for at in atoms)
    return [
        f"{segment if several else ''} {residue} {number} {name}".strip() if residue else str(name)
        for segment, residue, number, name in rows
    ]


def _as_asked(row: dict[str, Any], classes: Classes, groups: Groups) -> dict[str, Any]:
    """Put the two atom classes of a table row in the order of the two selections."""
    if groups[0] is None or groups[1] is None:
        return row
    first, second = ({classes.names[at] for at in np.unique(classes.of[group])} for group in groups)
    a, b = row["first"], row["second"]
    if (a in first and b in second) or not (b in first and a in second):
        return row
    return row | {"first": b, "second": a}


def _flux(one: Followed, flips: int, steps: Mapping[str, Any], found: Pass) -> dict[str, Any] | None:
    """Compare the observed flip rate with the crossing rate that velocities predict."""
    duration = steps["last_time"] - steps["first_time"]
    if not one.flux or not steps["timed"] or not duration > 0 or found.odd is not None:
        return None
    crossed, moments = sum(flips for flips, _ in one.flux), sum(moment for _, moment in one.flux)
    rate, seen = crossed / moments, flips / duration
    return {
        "rate": rate, "error": rate / max(crossed, 1) ** 0.5, "seen": seen, "crossed": crossed,
        "frames": len(one.flux), "lost": 1.0 - seen / rate if rate > 0 else None,
    }  # fmt: skip
