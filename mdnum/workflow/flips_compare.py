"""`mdnum flips A B`: two trajectories of the same atoms, frame by frame, until their neighbor sets differ."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.trajectories.checked import checked
from mdnum.trajectories.compare import Apart, Difference, apart, growth
from mdnum.trajectories.far import smallest_radius
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

if TYPE_CHECKING:
    from mdnum.trajectories.frame import Frame
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.source import Trajectory
    from mdnum.workflow.flips_record import Groups

#: Rows of the table of pairs that come to differ.
ROWS = 1_000
_FIRST = 8
# times that differ by less than this, relative, are the same
_SAME_TIME = 1e-6


@dataclass
class _Found:
    """What the frames showed, position by position.

    Attributes:
        seed: first frame whose positions differ at all.
        beyond: first frame at which an atom is further apart than the resolution of the two files explains.
        first: what was seen at the first frame whose sets differ.
        certain: first frame at which a pair differs that no resolution could have moved.
        other_box: the boxes at the first frame at which they are not the same.
    """

    frames: int = 0
    seed: int | None = None
    beyond: int | None = None
    first: dict[str, Any] | None = None
    certain: int | None = None
    other_box: dict[str, Any] | None = None
    rows: int = 0
    times_differ: int = 0
    last: Apart = field(default_factory=lambda: Apart(0.0, 0.0, 0))
    stopped: InputError | None = None


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
        InputError: they are not of the same atoms, or there is more than one rule.
    """
    a, b = (source(path, topology, format) for path in paths)
    if a.atoms != b.atoms:
        raise InputError(
            f"{a.name} has {a.atoms:,} atoms and {b.name} {b.atoms:,}",
            remedy="Compare trajectories of the same atoms",
        )
    rule, *more = asked or default_rules(a)
    if more:
        raise InputError(
            f"{len(asked)} rules; two trajectories are compared by one",
            remedy="Keep one of them, and ask again for the others",
        )
    groups = selected(a, between)
    folder = new_folder(a, "flips-compare", out)
    try:
        return _look(folder, (a, b), rule, groups, between, report, progress)
    except BaseException:
        leave(folder)
        raise


def _look(
    folder: RunFolder,
    both: tuple[Trajectory, Trajectory],
    rule: Rule,
    groups: Groups,
    between: tuple[str, str] | None,
    report: bool,
    progress: Progress | None,
) -> FlipsResult:
    began = time.perf_counter()
    sides = [
        Side(
            one,
            Tracker(rule, groups[0], groups[1], [str(word) for word in one.species], 0.0),
            infer_from(sample_of(one), one.bits, one.format),
        )
        for one in both
    ]
    found = _follow(folder, sides, groups, Log(folder, progress))
    folder.finalize()
    (folder.path / "checkpoint.npz").unlink(missing_ok=True)
    a, b = both
    table = folder.read("apart", ["time", "furthest", "bound"])
    differing = folder.read("differing", rows=_FIRST)
    folder.write_summary(
        {
            **about(a, "flips-compare"),
            "other": name_of(b),
            "other_file": str(b.path),
            "other_format": b.format,
            "same_species": bool(np.array_equal(a.species.astype(str), b.species.astype(str))),
            "between": None if between is None else list(between),
            "rule": rule.name,
            "frames": found.frames,
            "in_file": [one.count for one in both],
            "times_differ": found.times_differ,
            "timed": a.time != "frame",
            "resolution": told_resolution(sides[0].resolution, a),
            "other_resolution": told_resolution(sides[1].resolution, b),
            "seed": found.seed,
            "beyond": found.beyond,
            "other_box": found.other_box,
            "first": found.first,
            "certain": found.certain,
            "first_pairs": _first_pairs(found, differing),
            "growth": _growth(found, table, rule),
            "last": {"furthest": found.last.furthest, "typical": found.last.typical},
            "stopped": None if found.stopped is None else str(found.stopped),
            "seconds": time.perf_counter() - began,
            "findings": [],
            "status": "complete" if found.stopped is None else "stopped",
        }
    )
    return FlipsResult(folder.path, finish(folder, report, progress))


def _follow(folder: RunFolder, sides: list[Side], groups: Groups, progress: Log) -> _Found:
    """Reads both once, in step."""
    atoms = None
    if groups[0] is not None:
        atoms = np.unique(np.concatenate([one for one in groups if one is not None]))
    found, difference = _Found(), Difference()
    before = Apart(0.0, 0.0, 0)
    counts = [one.trajectory.count for one in sides]
    total = min((one for one in counts if one is not None), default=0)
    radius = smallest_radius([sides[0].tracker.rule])
    first, second = (
        checked(one.frames(), atoms, str(one.path), radius=radius, bits=one.bits)
        for one in (side.trajectory for side in sides)
    )
    pairs_of_frames = zip(first, second, strict=False)
    while True:
        try:
            frames = next(pairs_of_frames, None)
            if frames is None:
                break
            flips = [side.step(frame) for side, frame in zip(sides, frames, strict=True)]
        except InputError as error:
            if not found.frames:
                raise
            found.stopped = error
            break
        if found.frames:
            difference.step(*flips)
        else:
            difference = Difference.of(*(side.tracker.members() for side in sides))
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
        if found.certain is None and len(difference):
            # all that differ: one that came to differ within the resolution may be beyond it by now
            standing = rows(sorted(difference.only_a | difference.only_b), difference, sides, frames)
            undecided = int(np.count_nonzero(standing["ambiguous"]))
            if found.first is None:
                found.first = _first(found, frames, difference, now, before, undecided)
            if undecided < len(difference):
                found.certain = found.frames
        if new := difference.new[: ROWS - found.rows]:
            told = rows(new, difference, sides, frames)
            folder.append("differing", {"frame": np.full(len(new), found.frames), **told})
            found.rows += len(new)
        _append(folder, found.frames, frames, now, allowed, difference, sides)
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


def _first(
    found: _Found,
    frames: tuple[Frame, ...],
    difference: Difference,
    now: Apart,
    before: Apart,
    undecided: int,
) -> dict[str, Any]:
    """What summary.json says of the first frame whose sets differ."""
    return {
        "frame": found.frames, "number": frames[0].index, "time": frames[0].time,
        "pairs": len(difference), "furthest": now.furthest, "typical": now.typical,
        "furthest_before": before.furthest if found.frames else None,
        "typical_before": before.typical if found.frames else None,
        "ambiguous": undecided,
    }  # fmt: skip


def _append(
    folder: RunFolder,
    at: int,
    frames: tuple[Frame, ...],
    now: Apart,
    bound: float,
    difference: Difference,
    sides: list[Side],
) -> None:
    row = {
        "frame": at, "number_a": frames[0].index, "number_b": frames[1].index, "time": frames[0].time,
        "time_b": frames[1].time, "furthest": now.furthest, "bound": bound, "typical": now.typical,
        "atom": now.atom, "pairs_a": sides[0].tracker.pairs, "pairs_b": sides[1].tracker.pairs,
        "only_a": len(difference.only_a), "only_b": len(difference.only_b),
    }  # fmt: skip
    folder.append("apart", {name: [value] for name, value in row.items()})


def _first_pairs(found: _Found, rows: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """The pairs of the first frame whose sets differ, as plain values."""
    if found.first is None:
        return []
    mine = np.flatnonzero(rows["frame"] == found.first["frame"])
    return [{name: values[at].item() if hasattr(values[at], "item") else values[at]
             for name, values in rows.items()} for at in mine]  # fmt: skip


def _growth(found: _Found, table: dict[str, np.ndarray], rule: Rule) -> dict[str, Any]:
    """Rates at which the separation grows before the sets differ, and from then on."""
    limit = 0.1 * (rule.radius if isinstance(rule, Cutoff) else float(table["furthest"].max(initial=0.0)))
    cut = found.frames if found.first is None else found.first["frame"]
    # up to its bound a separation may be made of rounding
    separation = np.where(table["furthest"] > table["bound"], table["furthest"], 0.0)
    parts = {}
    for name, part in (("before", slice(None, cut + 1)), ("after", slice(cut, None))):
        line = growth(table["time"][part], separation[part], limit)
        parts[name] = None if line is None else {"rate": line[0], "r2": line[1], "frames": line[2]}
    return parts
