"""What two trajectories alone allow to conclude about where they part, and what they do not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mdnum.report.flips.words import length, rule_words
from mdnum.report.fork.question import Question
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number

# frames after a flip in which a leap of the separation shows, and how much larger than any before it must be
_WINDOW, _LEAP = 10, 5.0
# rates that differ by less than this factor are alike
_ALIKE = 1.5
# r² from which on a line through the logarithm is one exponential
_FITS = 0.8


def headline(run: Question) -> str:
    """The verdict in one sentence."""
    summary = run.summary
    frames, what = many(summary["frames"], "frame"), rule_words(run, summary)
    if summary["seed"] is None and summary["first"] is None:
        return f"The two trajectories have the same positions in all of {frames}."
    first = summary["first"]
    if first is None:
        return f"Positions differ from frame {count(summary['seed'])} on, neighbor sets ({what}) never do."
    pairs = many(first["pairs"], "pair")
    text = f"Neighbor sets ({what}) differ from frame {count(first['frame'])} on, first by {pairs}"
    if first["ambiguous"] == first["pairs"]:
        return f"{text}, all within the files’ resolution: they may have differed earlier, or later."
    return f"{text}; atoms are {length(run, first['furthest'])} apart by then."


def concluded(run: Question) -> Iterator[str]:
    """What the frames show."""
    summary = run.summary
    first, seed = summary["first"], summary["seed"]
    if seed is not None:
        start = "the first frame" if seed == 0 else f"frame {count(seed)}"
        until = "" if seed == 0 else " and are the same bit for bit before"
        yield f"Positions differ from {start} on{until}."
    if first is None:
        if seed is not None:
            yield (
                f"The sets are the same in all {many(summary['frames'], 'frame')}, with atoms up to "
                f"{length(run, summary['last']['furthest'])} apart at the end: no flip seen here made them "
                "part."
            )
        return
    yield _order(run, first, seed)
    yield from _leap(run, first, seed)
    before, after = (summary["growth"][name] for name in ("before", "after"))
    if before is not None and before["r2"] >= _FITS and before["rate"] > 0:
        yield f"Before the sets differ the separation grows {_rate(run, before)}."
    if after is not None and after["r2"] >= _FITS and after["rate"] > 0:
        yield f"From then on it grows {_rate(run, after)}{_hurried(before, after)}."


def _order(run: Question, first: Any, seed: int | None) -> str:
    """Whether a difference of positions was there before one of sets."""
    if seed is None or seed == first["frame"]:
        if first["frame"] == 0:
            return "Sets differ at the first frame: the two do not start alike."
        return (
            "Positions and sets come to differ between the same two frames: which came first lies between "
            "them."
        )
    before = length(run, first["furthest_before"])
    return (
        f"At the frame before, no set differed and atoms were already up to {before} apart: the difference "
        "of the two did not begin with a flip that these frames show."
    )


def _leap(run: Question, first: Any, seed: int | None) -> Iterator[str]:
    """Whether the separation leaps when the sets come to differ, as it does nowhere before."""
    furthest, at = run.tables["apart"]["furthest"], int(first["frame"])
    # a difference that has just begun grows fast, whatever began it
    start = max((seed or 0) + _WINDOW, at // 2)
    if at + _WINDOW >= len(furthest) or start + _WINDOW > at or not furthest[start:].all():
        return
    grown = furthest[_WINDOW:] / np.maximum(furthest[:-_WINDOW], np.finfo(float).tiny)
    after, before = float(grown[at]), float(grown[start : at - _WINDOW + 1].max())
    if after > _LEAP * max(before, 1.0):
        yield (
            f"In the {_WINDOW} frames from there the separation grows {number(after, 2)}-fold, and in no "
            f"{_WINDOW} frames before by more than {number(before, 2)}: a leap such as a flip causes, where "
            "nothing else happened then."
        )
    elif after > 0:
        yield (
            f"In the {_WINDOW} frames from there the separation grows by a factor {number(after, 2)}, and in "
            f"some {_WINDOW} frames before by {number(before, 2)}: no leap that would speak for a cause."
        )


def _rate(run: Question, found: Any) -> str:
    unit = run.summary["time"] if run.summary["timed"] else "frames"
    return f"by a factor e in {number(1 / found['rate'])} {unit} ({count(found['frames'])} frames)"


def _hurried(before: Any, after: Any) -> str:
    if before is None or before["r2"] < _FITS or before["rate"] <= 0:
        return ""
    ratio = after["rate"] / before["rate"]
    if ratio > _ALIKE:
        return (
            f", {number(ratio, 2)} times as fast: as it would if the flip hurried it, and as it may by chance"
        )
    if ratio < 1 / _ALIKE:
        return ", slower than before: nothing here says that a flip hurried it"
    return ", as before: nothing here says that a flip hurried it"


def cannot(run: Question) -> Iterator[str]:
    """What two trajectories cannot say, whatever they hold."""
    if run.summary["first"] is not None:
        yield (
            "A flip that came first is no cause. Two trajectories part after a flip and through chaos alone "
            "in the same way; only a run that is handed the other's decisions tells the two apart."
        )
    yield (
        "Between two frames pairs may have flipped and flipped back in one run only; such a difference acts "
        "on the atoms and leaves no trace in the sets."
    )
    yield (
        "What was different about the two programs, and whether the neighbor list in either held all pairs, "
        "is not in their positions."
    )


def findings(run: Question) -> Iterator[Finding]:
    """What one should know before relying on the comparison."""
    summary = run.summary
    if summary["stopped"]:
        frames = many(summary["frames"], "frame")
        yield Finding(
            "STOPPED",
            "error",
            f"the comparison ends after {frames}",
            f"{summary['stopped']} Everything here is about the {frames} before.",
            "Check how that file was written.",
        )
    if summary["first"] is not None:
        yield Finding(
            "NO_CAUSE_FROM_FILES",
            "info",
            "a flip that came first is no cause",
            "To tell, the program has to run again with the other run's decisions.",
            "Two runs of mdnum: mdnum fork RUN_A RUN_B --replay. A system of mdnum: mdnum fork SYSTEM --vary "
            "CHOICE. Another program: make one run with a smooth cutoff, and see whether they still part.",
        )
    if not summary["same_species"]:
        yield Finding(
            "OTHER_SPECIES",
            "warning",
            "the two files name different species",
            "Atoms are compared by their numbers. If they are in another order in one of the files, nothing "
            "here means anything.",
            "Check that both files have their atoms in the same order.",
        )
    if summary["times_differ"]:
        yield Finding(
            "OTHER_TIMES",
            "warning",
            f"times differ at {many(summary['times_differ'], 'frame')}",
            "Frames are compared one by one in the order of the files, whatever their times.",
            "Choose frames of the same times with @START:STOP:STEP on either path.",
        )
    counts = [one for one in summary["in_file"] if one is not None]
    if len(set(counts)) > 1 and not summary["stopped"]:
        yield Finding(
            "OTHER_LENGTH",
            "info",
            f"one has {count(min(counts))} frames, the other {count(max(counts))}",
            "Those that both have are compared.",
        )
