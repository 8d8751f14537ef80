"""`mdnum flips A B`: two trajectories of the same atoms, frame by frame, until their neighbor sets differ."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.trajectories.compare import Apart, Difference, apart, growth
from mdnum.trajectories.frame import checked, smallest_radius
from mdnum.trajectories.resolution import infer_from
from mdnum.trajectories.rules import Cutoff
from mdnum.trajectories.tracker import Tracker
from mdnum.workflow.flips_differing import Side, other_box, rows
from mdnum.workflow.flips_open import (
    FlipsResult,
    about,
    default_rules,
    leave,
    name_of,
    new_folder,
    sample_of,
    selected,
    source,
    told_resolution,
)
from mdnum.workflow.fork_question import Log, Progress, finish
from mdnum.workflow.interrupt import asked_to_stop

if TYPE_CHECKING:
    from mdnum.trajectories.frame import Frame
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.trajectory import Trajectory
    from mdnum.workflow.flips_record import Groups

#: Rows of the table of pairs that come to differ.
ROWS = 1_000
_FIRST = 8
# times that differ by less than this, relative, are the same
_SAME_TIME = 1e-6


@dataclass
class _Sets:
    """The neighbor sets of one rule in the two trajectories.

    Attributes:
        number: of the rule among those asked for.
        first: what was seen at the first frame whose sets differ.
        certain: first frame at which a pair differs that no resolution could have moved.
        rows: pairs told in the table of those that come to differ.
    """

    number: int
    rule: Rule
    sides: list[Side]
    difference: Difference = field(default_factory=Difference)
    first: dict[str, Any] | None = None
    certain: int | None = None
    rows: int = 0


@dataclass
class _Found:
    """What the frames showed, position by position.

    Attributes:
        sets: of every rule.
        seed: first frame whose positions differ at all.
        beyond: first frame at which an atom is further apart than the resolution of the two files explains.
        other_box: the boxes at the first frame at which they are not the same.
    """

    sets: list[_Sets]
    frames: int = 0
    seed: int | None = None
    beyond: int | None = None
    other_box: dict[str, Any] | None = None
    times_differ: int = 0
    last: Apart = field(default_factory=lambda: Apart(0.0, 0.0, 0))
    stopped: InputError | None = None
    interrupted: bool = False


def compare(
    paths: tuple[str | Path, str | Path],
    topology: str | Path | None,
    asked: tuple[Rule, ...],
    between: tuple[str, str] | None,
    *,
    format: str | None = None,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> FlipsResult:
    """Where two trajectories part; see `mdnum.workflow.flips.flips`.

    Raises:
        InputError: they are not of the same atoms.
    """
    a, b = (source(path, topology, format) for path in paths)
    if a.atoms != b.atoms:
        raise InputError(
            f"{a.name} has {a.atoms:,} atoms and {b.name} {b.atoms:,}",
            remedy="Compare trajectories of the same atoms",
        )
    asked = asked or default_rules(a)
    groups = selected(a, between)
    folder = new_folder(a, "flips-compare", out)
    try:
        return _look(folder, (a, b), asked, groups, between, report, progress)
    except BaseException:
        leave(folder)
        raise


def _look(
    folder: RunFolder,
    both: tuple[Trajectory, Trajectory],
    rules: Sequence[Rule],
    groups: Groups,
    between: tuple[str, str] | None,
    report: bool,
    progress: Progress | None,
) -> FlipsResult:
    began = time.perf_counter()
    resolutions = [infer_from(sample_of(one), one.bits, one.format) for one in both]
    species = [[str(word) for word in one.species] for one in both]
    sets = [
        _Sets(number, rule, [
            Side(one, Tracker(rule, groups[0], groups[1], words, 0.0), resolution)
            for one, words, resolution in zip(both, species, resolutions, strict=True)
        ])
        for number, rule in enumerate(rules)
    ]  # fmt: skip
    found = _follow(folder, sets, groups, Log(folder, progress))
    folder.finalize()
    folder.drop_checkpoint()
    a, b = both
    table = folder.read("apart", ["time", "furthest", "bound"])
    differing = folder.read("differing")
    told = [
        {
            "rule": one.rule.name,
            "first": one.first,
            "certain": one.certain,
            "first_pairs": _first_pairs(one, differing),
            "growth": _growth(found.frames, one, table),
        }
        for one in sets
    ]
    folder.write_summary(
        {
            **about(a, "flips-compare"),
            "other": name_of(b),
            "other_file": str(b.path),
            "other_format": b.format,
            "same_species": _alike(a, b),
            "between": None if between is None else list(between),
            # the first rule, and all of them
            **told[0],
            "rules": told,
            "frames": found.frames,
            "in_file": [one.count for one in both],
            # steps, units and numbers of frames are not compared with one another
            "times_differ": found.times_differ if a.time == b.time else 0,
            "times": [a.time, b.time],
            "timed": a.time != "frame",
            "resolution": told_resolution(resolutions[0], a),
            "other_resolution": told_resolution(resolutions[1], b),
            "seed": found.seed,
            "beyond": found.beyond,
            "other_box": found.other_box,
            "last": {"furthest": found.last.furthest, "typical": found.last.typical},
            "stopped": None if found.stopped is None else str(found.stopped),
            "interrupted": found.interrupted,
            "seconds": time.perf_counter() - began,
            "findings": [],
            "status": "stopped" if found.stopped is not None or found.interrupted else "complete",
        }
    )
    return FlipsResult(folder.path, finish(folder, report, progress))


def _alike(a: Trajectory, b: Trajectory) -> bool:
    """Whether the atoms of two files may be the same ones: of one species each, as far as the files say."""
    if not (a.table.named and b.table.named):
        return True
    first, second = ([str(one) for one in file.species] for file in (a, b))
    if first == second:
        return True
    # a dump numbers its types: each number stands for one species, and each species has one
    numbered = [all(one.isdigit() for one in words) for words in (first, second)]
    both = set(zip(first, second, strict=True))
    return numbered[0] != numbered[1] and len(both) == len(set(first)) == len(set(second))


def _follow(folder: RunFolder, sets: list[_Sets], groups: Groups, progress: Log) -> _Found:
    """Reads both once, in step; control-C ends it, and what was compared stays."""
    with asked_to_stop() as stop:
        return _followed(folder, sets, groups, progress, stop)


def _followed(
    folder: RunFolder, sets: list[_Sets], groups: Groups, progress: Log, stop: Callable[[], bool]
) -> _Found:
    atoms = None
    if groups[0] is not None:
        atoms = np.unique(np.concatenate([one for one in groups if one is not None]))
    found, sides = _Found(sets), sets[0].sides
    before = Apart(0.0, 0.0, 0)
    counts = [one.trajectory.count for one in sides]
    total = min((one for one in counts if one is not None), default=0)
    radius = smallest_radius([one.rule for one in sets])
    first, second = (
        checked(one.frames(), atoms, str(one.path), radius=radius, bits=one.bits)
        for one in (side.trajectory for side in sides)
    )
    pairs_of_frames = zip(first, second, strict=False)
    while True:
        if stop() and found.frames:
            found.interrupted = True
            break
        try:
            frames = next(pairs_of_frames, None)
            if frames is None:
                break
            # every rule first: a frame that one of them refuses is not looked at by another
            flips = [
                [side.step(frame) for side, frame in zip(one.sides, frames, strict=True)] for one in sets
            ]
        except InputError as error:
            if not found.frames:
                raise
            found.stopped = error
            break
        for one, new in zip(sets, flips, strict=True):
            if found.frames:
                one.difference.step(*new)
            else:
                one.difference = Difference.of(*(side.tracker.members() for side in one.sides))
        now = apart(frames[0], frames[1], atoms)
        if found.seed is None and now.furthest > 0:
            found.seed = found.frames
        allowed = sum(side.position_bound(now.periods) for side in sides)
        if found.beyond is None and now.furthest > allowed:
            found.beyond = found.frames
        if found.other_box is None and (boxes := other_box(frames, _boxes_bound(sides))) is not None:
            found.other_box = {"frame": found.frames, **boxes}
        scale = max(abs(frames[0].time), abs(frames[1].time))
        found.times_differ += abs(frames[0].time - frames[1].time) > _SAME_TIME * scale
        for one in sets:
            _sets_at(folder, one, found.frames, frames, now, before)
        _append(folder, found.frames, frames, now, allowed, sets[0])
        before, found.last = now, now
        found.frames += 1
        folder.checkpoint({"frames": found.frames})
        progress(found.frames, total, {"phase": "run", "unit": "frames"})
    if not found.frames:
        raise InputError("no frame is left of what was asked for", remedy="Ask for others")
    folder.checkpoint({"frames": found.frames}, force=True)
    return found


def _boxes_bound(sides: list[Side]) -> float:
    """How far lattice vectors may be apart; formats that round positions may round the box as much."""
    return sum(side.distance_bound for side in sides)


def _sets_at(
    folder: RunFolder, one: _Sets, at: int, frames: tuple[Frame, ...], now: Apart, before: Apart
) -> None:
    """What one rule's sets show at a frame, and the pairs that are new among those that differ."""
    difference = one.difference
    if one.certain is None and len(difference):
        # all that differ: one that came to differ within the resolution may be beyond it by now
        standing = rows(sorted(difference.only_a | difference.only_b), difference, one.sides, frames)
        undecided = int(np.count_nonzero(standing["ambiguous"]))
        if one.first is None:
            one.first = {
                "frame": at, "number": frames[0].index, "time": frames[0].time, "pairs": len(difference),
                "furthest": now.furthest, "typical": now.typical,
                "furthest_before": before.furthest if at else None,
                "typical_before": before.typical if at else None, "ambiguous": undecided,
            }  # fmt: skip
        if undecided < len(difference):
            one.certain = at
    if new := difference.new[: ROWS - one.rows]:
        told = rows(new, difference, one.sides, frames) | {"rule": np.full(len(new), one.number)}
        folder.append("differing", {"frame": np.full(len(new), at), **told})
        one.rows += len(new)


def _append(
    folder: RunFolder, at: int, frames: tuple[Frame, ...], now: Apart, bound: float, one: _Sets
) -> None:
    """The row of a frame; pairs are those of the first rule."""
    row = {
        "frame": at, "number_a": frames[0].index, "number_b": frames[1].index, "time": frames[0].time,
        "time_b": frames[1].time, "furthest": now.furthest, "bound": bound, "typical": now.typical,
        "atom": now.atom, "pairs_a": one.sides[0].tracker.pairs, "pairs_b": one.sides[1].tracker.pairs,
        "only_a": len(one.difference.only_a), "only_b": len(one.difference.only_b),
    }  # fmt: skip
    folder.append("apart", {name: [value] for name, value in row.items()})


def _first_pairs(one: _Sets, rows: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Pairs of the first frame whose sets differ, a few of them, as plain values."""
    if one.first is None:
        return []
    mine = np.flatnonzero((rows["frame"] == one.first["frame"]) & (rows["rule"] == one.number))[:_FIRST]
    return [{name: values[at].item() if hasattr(values[at], "item") else values[at]
             for name, values in rows.items()} for at in mine]  # fmt: skip


def _growth(frames: int, one: _Sets, table: dict[str, np.ndarray]) -> dict[str, Any]:
    """Rates at which the separation grows before the sets differ, and from then on."""
    rule = one.rule
    limit = 0.1 * (rule.radius if isinstance(rule, Cutoff) else float(table["furthest"].max(initial=0.0)))
    cut = frames if one.first is None else one.first["frame"]
    # up to its bound a separation may be made of rounding
    separation = np.where(table["furthest"] > table["bound"], table["furthest"], 0.0)
    parts = {}
    for name, part in (("before", slice(None, cut + 1)), ("after", slice(cut, None))):
        line = growth(table["time"][part], separation[part], limit)
        parts[name] = None if line is None else {"rate": line[0], "r2": line[1], "frames": line[2]}
    return parts
