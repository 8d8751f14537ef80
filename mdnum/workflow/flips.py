"""`mdnum flips` as a function: anybody's trajectory to a ledger of flips, what it says, and a report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.workflow.flips_open import (
    FlipsResult,
    about,
    cut_short,
    default_rules,
    leave,
    new_folder,
    refuse_topology_first,
    sample_of,
    selected,
    source,
    told_resolution,
)
from mdnum.workflow.flips_words import rules
from mdnum.workflow.fork_question import Log, Progress, finish

if TYPE_CHECKING:
    from mdnum.trajectories.frame import Frame
    from mdnum.trajectories.resolution import Resolution
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.trajectory import Trajectory
    from mdnum.workflow.flips_record import Followed, Groups, Pass

#: Frames within which a flip that is taken back is chatter, unless another number is asked for.
WINDOW = 5
# displacement between frames over what velocities say, above which they cannot belong to the positions
_TOO_FAR = 1.1


def flips(
    trajectory: str | Path,
    other: str | Path | None = None,
    *,
    topology: str | Path | None = None,
    cutoffs: Sequence[float] = (),
    pairs: Sequence[str | Mapping[tuple[str, str], float]] = (),
    nearest: Sequence[int] = (),
    most: int | None = None,
    between: tuple[str, str] | None = None,
    window: int = WINDOW,
    format: str | None = None,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> FlipsResult:
    """Finds which pairs entered or left a threshold between the frames of a file, and what follows.

    Args:
        trajectory: a file that MDAnalysis or ASE reads, or the folder of an mdnum run; a slice of its frames
            may stand behind an @ ("run.xtc@100:", "run.xtc@::10").
        other: another one of the same atoms: where do the two part?
        topology: what the atoms are, where the trajectory does not say.
        cutoffs: lengths in the file's unit, a rule each; default the cutoff of the mdnum run that the file
            belongs to.
        pairs: cutoffs by pair of species, a rule each: "O-H=2.5,O-O=3.5".
        nearest: numbers of neighbors, a rule each: the k nearest of every atom.
        most: neighbors an atom can have inside a cutoff; the nearest are kept.
        between: two selections in MDAnalysis's language; only pairs with an atom in each are looked at.
        window: frames within which a flip that is taken back is chatter, and up to which a stay outside is
            overlooked in an intermittent contact.
        format: of the files, where their names do not tell.
        out: the new folder; default runs/flips-<name>-<n>.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Raises:
        InputError: a file or an option cannot be used. A frame in the middle that cannot be read is no
            exception: what came before is kept, and the summary names the frame.
        FolderError: the folder cannot be used.
    """
    if window < 1:
        raise InputError(f"window = {window}; expected at least 1 frame")
    asked = rules(cutoffs, pairs, nearest, most)
    if other is not None:
        refuse_topology_first(trajectory, other, topology)
        from mdnum.workflow.flips_compare import compare

        return compare(
            (trajectory, other), topology, asked, between, format=format, out=out, report=report,
            progress=progress,
        )  # fmt: skip
    opened = source(trajectory, topology, format)
    asked = asked or default_rules(opened)
    groups = selected(opened, between)
    folder = new_folder(opened, "flips", out)
    try:
        return _look(folder, opened, asked, groups, between, window, report, progress)
    except BaseException:
        leave(folder)
        raise


def _look(
    folder: RunFolder,
    trajectory: Trajectory,
    asked: tuple[Rule, ...],
    groups: Groups,
    between: tuple[str, str] | None,
    window: int,
    report: bool,
    progress: Progress | None,
) -> FlipsResult:
    from mdnum.trajectories.resolution import infer_from
    from mdnum.workflow import flips_numbers, flips_record
    from mdnum.workflow.flips_differing import plain_box

    log = Log(folder, progress)
    sample = sample_of(trajectory)
    resolution = infer_from(sample, trajectory.bits, trajectory.format)
    found = flips_record.follow(folder, trajectory, asked, groups, resolution.bound, log)
    began = time.perf_counter()
    for rows in flips_record.neighbor_rows(found):
        folder.append("neighbors", rows)
    frames = _frames(folder)
    steps = _steps(frames, trajectory.time != "frame")
    labels = flips_numbers.labels(trajectory.table)
    told = []
    for number, one in enumerate(found.rules):
        counted = flips_numbers.count(
            folder, number, found.frames, labels, one.rule.directed, window, log
        )  # fmt: skip
        mine = frames["rule"] == number
        pairs = frames["pairs"][mine]
        columns = flips_numbers.curves(counted, pairs, steps["interval"])
        folder.append("lifetimes", {"rule": np.full(len(pairs_of(columns)), number), **columns})
        busiest = {name: getattr(counted.busiest, name) for name in counted.busiest.__dataclass_fields__}
        words = {
            name: flips_numbers.atom_words(trajectory.table, busiest[of])
            for name, of in (("first", "i"), ("second", "j"))
        }
        folder.append("busiest", {"rule": np.full(len(words["first"]), number), **busiest, **words})
        _append_residues(folder, number, counted, labels)
        rows = {name: values[mine] for name, values in frames.items()}
        told.append(
            _rule(one, rows, steps, found)
            | {"grid": _grid(sample, resolution, one, groups)}
            | flips_numbers.told(counted)
        )
        for name, coded in (("by_species", labels.species), ("by_residue_name", labels.residue_names)):
            if coded is not None:
                told[-1][name] = [_as_asked(row, coded, groups) for row in told[-1][name]]
    folder.finalize()
    folder.drop_checkpoint()
    folder.write_summary(
        {
            **about(trajectory, "flips"),
            "between": None if between is None else list(between),
            "box": plain_box(sample[0].box),
            "frames": found.frames,
            **steps,
            "window": window,
            "resolution": told_resolution(resolution, trajectory),
            "rules": told,
            "velocities_odd": bool(found.moved > _TOO_FAR),
            "leaps": _leaps(found),
            "stopped": None if found.stopped is None else str(found.stopped),
            "cut_short": cut_short(found.stopped, trajectory),
            "interrupted": found.interrupted,
            "seconds": {"frames": found.seconds, "statistics": time.perf_counter() - began},
            "findings": [],
            "status": "stopped" if found.stopped is not None or found.interrupted else "complete",
        }
    )
    return FlipsResult(folder.path, finish(folder, report, progress))


def pairs_of(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Any column: they are equally long."""
    return next(iter(columns.values()))


def _frames(folder: RunFolder) -> dict[str, np.ndarray]:
    names = ("rule", "time", "pairs", "near", "entered", "left", "ambiguous", "min_margin")
    return folder.read("frames", [*names, "fewest", "neighbors", "most"])


def _steps(frames: Mapping[str, np.ndarray], timed: bool) -> dict[str, Any]:
    """Times of the frames: how far apart, evenly or not."""
    times = frames["time"][frames["rule"] == 0]
    steps = np.diff(times)
    interval = float((times[-1] - times[0]) / len(steps)) if len(steps) else float("nan")
    even = bool(np.all(np.abs(steps - interval) <= 1e-3 * abs(interval))) if len(steps) else True
    backward = int(np.count_nonzero(steps <= 0))
    return {
        # frames are counted where their times do not go forward
        "timed": timed and not backward,
        "has_times": timed and not (len(steps) and (steps == 0).all()),
        "first_time": float(times[0]),
        "last_time": float(times[-1]),
        "interval": interval,
        "even": even,
        "backward": backward,
    }


def _as_asked(row: dict[str, Any], coded: tuple[np.ndarray, Sequence[str]], groups: Groups) -> dict[str, Any]:
    """A pair of classes in the order of the two selections, where only one order fits them."""
    if groups[0] is None or groups[1] is None:
        return row
    first, second = ({coded[1][at] for at in np.unique(coded[0][group])} for group in groups)
    a, b = row["first"], row["second"]
    if (a in first and b in second) or not (b in first and a in second):
        return row
    return row | {"first": b, "second": a}


def _leaps(found: Pass) -> dict[str, Any] | None:
    """Atoms that are further from one frame to the next than can be; None where none is."""
    if not found.leaps:
        return None
    frame, atom, distance = found.leaps[0]
    return {"frames": len(found.leaps), "frame": frame, "atom": atom, "distance": distance}


def _rule(
    one: Followed, rows: Mapping[str, np.ndarray], steps: Mapping[str, Any], found: Pass
) -> dict[str, Any]:
    """Counts of one rule, and what velocities say about the frames' distance in time."""
    entered, left = int(rows["entered"].sum()), int(rows["left"].sum())
    frames = len(rows["pairs"])
    margins = rows["min_margin"]
    return {
        "rule": one.rule.name,
        "directed": one.rule.directed,
        "pairs_first": int(rows["pairs"][0]),
        "pairs_last": int(rows["pairs"][-1]),
        "pairs_mean": float(rows["pairs"].mean()),
        "entered": entered,
        "left": left,
        "flips": entered + left,
        "flips_per_frame": (entered + left) / (frames - 1) if frames > 1 else 0.0,
        "ambiguous": int(rows["ambiguous"].sum()),
        "near_mean": float(rows["near"].mean()),
        "min_margin": float(np.nanmin(np.abs(margins))) if np.isfinite(margins).any() else None,
        "neighbors": {
            "fewest": int(rows["fewest"].min()),
            "mean": float(rows["neighbors"].mean()),
            "most": int(rows["most"].max()),
        },
        "flux": _flux(one, entered + left, steps, found),
    }


def _grid(
    sample: Sequence[Frame], resolution: Resolution, one: Followed, groups: Groups
) -> dict[str, Any] | None:
    """What writing positions with so few digits did to the flips, estimated; None where it cannot be."""
    from mdnum.trajectories.grid_effect import grid_effect

    if not one.reach > 0:
        return None
    found = grid_effect(resolution, sample, one.reach, *groups, ranked=one.ranked)
    if found is None:
        return None
    return {
        "missed": found.missed,
        "invented": found.invented,
        "ratio": found.ratio,
        "move": found.move,
        "words": found.words(),
    }


def _flux(one: Followed, flips: int, steps: Mapping[str, Any], found: Pass) -> dict[str, Any] | None:
    """Crossings by the velocities, which a run would show that looked at every instant, against the flips."""
    duration = steps["last_time"] - steps["first_time"]
    if not one.flux or not steps["timed"] or not duration > 0 or found.moved > _TOO_FAR:
        return None
    crossed, moments = sum(flips for flips, _ in one.flux), sum(moment for _, moment in one.flux)
    rate = crossed / moments
    seen = flips / duration
    return {
        "rate": rate,
        "error": rate / max(crossed, 1) ** 0.5,
        "seen": seen,
        "crossed": crossed,
        "frames": len(one.flux),
        "moved": found.moved,
        "lost": 1.0 - seen / rate if rate > 0 else None,
    }


def _append_residues(folder: RunFolder, number: int, counted: Any, labels: Any) -> None:
    if counted.residues is None:
        return
    between, within = counted.residues
    busy = np.flatnonzero(between + within)
    busy = busy[np.argsort(-(between + within)[busy], kind="stable")]
    words = [labels.residues[1][at] for at in busy]
    folder.append(
        "residues",
        {
            "rule": np.full(len(busy), number),
            "residue": words,
            "between": between[busy],
            "within": within[busy],
        },
    )
