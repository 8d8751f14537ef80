"""Verdict and findings on the flips of a trajectory, from its folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.flips import limits
from mdnum.report.flips.words import duration, flips_of, length, life, merged, rule_words
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, verdict
from mdnum.report.verdict import Finding
from mdnum.report.words import count, listed, many, number, percent

#: Rules that the verdict tells about one by one.
_TOLD = 3


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a trajectory."""
    found = [*_stopped(run), *_interrupted(run)]
    by_rule = [one for place in range(len(run.summary["rules"])) for one in limits.findings(run, place)]
    found += [*merged(by_rule), *_leaps(run), *_times(run), *_notes(run)]
    quiet = not any(one.severity != "info" for one in found)
    return verdict(_headline(run), _evidence(run), found, plain_tone="good" if quiet else "info")


def _headline(run: Question) -> str:
    summary = run.summary
    rules = summary["rules"]
    frames = many(summary["frames"], "frame")
    if summary["frames"] < 2:
        pairs = f"{many(rules[0]['pairs_first'], 'pair')} inside ({rule_words(run, rules[0])})"
        return f"One frame holds {pairs} and cannot hold a flip."
    if not any(one["flips"] for one in rules):
        return f"No pair entered or left a threshold in {frames}."
    first = next(one for one in rules if one["flips"])
    text = f"{many(first['flips'], 'flip')} of {many(first['pairs_flipped'], 'pair')} in {frames}"
    text += f" ({rule_words(run, first)})"
    if first["flips"] >= limits.FEW:
        if hidden := _hidden(first):
            text += f"; {hidden}"
        if first["ambiguous"] > limits.UNDECIDED * first["flips"]:
            share = percent(first["ambiguous"] / first["flips"])
            text += f"; for {share} of them the file cannot tell whether they happened"
    return text + "."


def _hidden(one: Mapping[str, Any]) -> str:
    """How many more there were, by whichever estimate there is; empty where that is few or not known."""
    flux = limits.by_velocities(one)
    lost = flux or one["stride"]["lost"]
    if not lost or lost >= 1 or lost <= limits.HIDDEN:
        return ""
    times = 1 / (1 - lost)
    more = f"{number(times, 2)} times as many" if times >= 2 else f"about {percent(times - 1)} more"
    return f"by the velocities, {more} happened" if flux else f"{more} happened, between the frames"


def _evidence(run: Question) -> Iterator[str]:
    summary = run.summary
    yield summary["resolution"]["words"]
    for place, one in enumerate(summary["rules"][:_TOLD]):
        rows = run.tables["frames"]["rule"] == place
        pairs, entered, left = (run.tables["frames"][name][rows] for name in ("pairs", "entered", "left"))
        what = rule_words(run, one)
        if summary["frames"] > 1 and (np.diff(pairs) == (entered - left)[1:]).all():
            yield (
                f"{what}: {flips_of(one)}; pairs inside = pairs at the start + entered − left at every frame."
            )
        if one["lifetime"]["followed"] and one["lifetime"]["leaves"]:
            rate = duration(run, one["lifetime"]["mean_by_rate"])
            yield (
                f"{what}: the median contact that begins in the file lasts {life(run, one['lifetime'])}; the "
                f"mean over all, by the rate at which they end, is {rate}."
            )


def _stopped(run: Question) -> Iterator[Finding]:
    if run.summary["stopped"]:
        last = count(int(run.tables["frames"]["number"][-1]))
        frames = many(run.summary["frames"], "frame")
        yield Finding(
            "STOPPED",
            "error",
            f"the file could be used up to frame {last} only",
            f"{run.summary['stopped']} Everything here is about the {frames} before it.",
            "Check how the file was written; a run that was killed leaves a last frame that is not whole."
            if run.summary["cut_short"]
            else "Look at that frame of the file, and at what wrote it.",
        )


def _interrupted(run: Question) -> Iterator[Finding]:
    if run.summary.get("interrupted"):
        yield Finding(
            "INTERRUPTED",
            "warning",
            f"stopped by hand after frame {count(int(run.tables['frames']['number'][-1]))}",
            f"Everything here is about the {many(run.summary['frames'], 'frame')} up to it.",
            "Look at the rest with a slice of the frames behind the path, or at all of them again.",
        )


def _leaps(run: Question) -> Iterator[Finding]:
    """Atoms that stand where they cannot have come from."""
    found = run.summary.get("leaps")
    if not found:
        return
    others = "" if found["frames"] == 1 else f" So is an atom at {many(found['frames'] - 1, 'other frame')}."
    yield Finding(
        "LEAP",
        "warning",
        f"an atom leaps at frame {count(found['frame'])}",
        f"Atom {found['atom']} is {length(run, found['distance'])} from where it was a frame before, many "
        f"times the size of the system.{others} Bytes that are damaged look like this. It counts as a place, "
        "and makes what the file's digits leave undecided larger for all pairs of that frame.",
        "Look at that frame of the file; leave it out with @START:STOP, or the atom with --between.",
    )


def _times(run: Question) -> Iterator[Finding]:
    summary = run.summary
    if summary["frames"] < 2:
        return
    if not summary["has_times"]:
        yield Finding(
            "NO_TIMES",
            "info",
            "the file has no times",
            "All of its frames have the same one, or none: lifetimes and rates are in frames.",
        )
    elif summary["backward"]:
        yield Finding(
            "TIME_GOES_BACK",
            "warning",
            f"time stands still or goes back at {many(summary['backward'], 'frame')}",
            "Two files may have been put one behind the other. Flips between such frames compare states "
            "that do not follow one another; lifetimes and rates are in frames.",
            "Leave the repeated frames out with @START:STOP.",
        )
    elif not summary["even"]:
        yield Finding(
            "UNEVEN_FRAMES",
            "warning",
            "frames are not evenly apart in time",
            "Lifetimes and rates count frames; as times they are those of frames at their mean distance, "
            f"{duration(run, 1)}.",
            "Choose evenly spaced frames with @START:STOP:STEP.",
        )


def _notes(run: Question) -> Iterator[Finding]:
    summary = run.summary
    said = list(summary["notes"])
    box = summary.get("box")
    if box is not None and not all(box["pbc"]):
        axes = [name for name, yes in zip("abc", box["pbc"], strict=True) if yes]
        said.append(
            f"The box repeats along {listed(axes)} only." if axes
            else "The file has no box that repeats: no pair is looked for through a boundary."
        )  # fmt: skip
    if summary["velocities_odd"]:
        said.append(
            "Atoms are displaced further between the first two frames than their velocities say: the "
            "velocities are in another unit or of another moment, and were not used."
        )
    if said:
        yield Finding("READING", "info", "how the file was read", " ".join(said))
    closest = [one["min_margin"] for one in summary["rules"] if one["min_margin"] == 0]
    if closest:
        yield Finding(
            "TIE",
            "info",
            "a pair stands exactly at a threshold",
            f"Its distance is {length(run, 0.0)} from it. Whether it is inside is a convention: here it is "
            "outside, other codes differ.",
        )
