"""What one rule's flips cannot tell: findings on resolution, stride, chatter, censoring and images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.flips.words import duration, life, rule_words, timed
from mdnum.report.fork.question import Question
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number, percent

#: Share of flips that the file leaves undecided, or hides or makes up, above which it is worth a warning.
UNDECIDED = 0.02
#: The same for flips between frames, and for those that are taken back at once.
HIDDEN, CHATTER = 0.10, 0.15
#: Share of contacts without a beginning or an end in the file above which that is said.
CENSORED = 0.5
#: Fewer flips than this say nothing in shares.
FEW = 20

# shares of flips hidden and made up that are not worth a number
_HARDLY = 1e-3
_ESTIMATED = (
    " How many that happened are not at their frame (hidden), and how many did not happen where they stand "
    "(made up), is estimated from how atoms move in the file at this stride."
)
_BOUND = "Write frames more often, or take what the file shows as a lower bound."


def findings(run: Question, place: int) -> Iterator[Finding]:
    """All findings on one rule."""
    one = run.summary["rules"][place]
    yield from _algebra(run, place, one)
    if one["flips"]:
        yield from _undecided(run, one)
        yield from _between(run, one)
        yield from _velocities(run, one)
        yield from _chatter(run, one)
    yield from _censored(run, one)
    yield from _images(run, one)


def far_apart(one: Mapping[str, Any]) -> bool:
    """Whether half of the contacts that begin are over by the next frame."""
    return one["flips"] >= FEW and one["lifetime"]["median"] == 1


def _algebra(run: Question, place: int, one: Mapping[str, Any]) -> Iterator[Finding]:
    table = run.tables["frames"]
    rows = table["rule"] == place
    net = (table["entered"][rows] - table["left"][rows])[1:]
    wrong = np.flatnonzero(np.diff(table["pairs"][rows]) != net)
    if len(wrong):
        where = many(len(wrong), "frame")
        yield Finding(
            "EVENT_ALGEBRA",
            "error",
            f"pairs and flips disagree from frame {count(int(wrong[0]) + 1)} on",
            f"{one['rule']}: pairs inside are not those before + entered − left at {where}.",
            "The ledger cannot be used. Please report it.",
        )


def _undecided(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    grid = one["grid"] or {"missed": 0.0, "invented": 0.0}
    if not one["ambiguous"] and max(grid["missed"], grid["invented"]) <= UNDECIDED:
        return
    told = ""
    if one["grid"] is not None and max(grid["missed"], grid["invented"]) < _HARDLY:
        told = "; fewer than 1 in 1,000 are hidden or made up"
    elif one["grid"] is not None:
        told = (
            f"; about {percent(grid['missed'])} of the flips that happened are hidden, and "
            f"{percent(grid['invented'])} of those in the file made up"
        )
    share = one["ambiguous"] / one["flips"]
    grave = one["flips"] >= FEW and max(share, grid["missed"], grid["invented"]) > UNDECIDED
    near = number(one["near_mean"], 2)
    yield Finding(
        "UNDECIDABLE",
        "warning" if grave else "info",
        f"{many(one['ambiguous'], 'flip')} of {count(one['flips'])} within the file's resolution",
        f"{rule_words(run, one)}: {percent(share)} of the flips cannot be told, nor {near} pairs at an "
        f"average frame, whether they flip or not{told}. Their distance, before or after, is so close to "
        "the threshold that the positions may have been on its other side before they were written."
        + (_ESTIMATED if told else ""),
        "Write positions with more digits, or count only flips with ambiguous = False." if grave else "",
    )


def _between(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    found = one["stride"]
    if far_apart(one):
        again = one["stays_over"]
        apart = f"frames are {duration(run, 1)} apart; " if timed(run) else ""
        yield Finding(
            "FRAMES_FAR_APART",
            "warning",
            "most contacts that begin are over by the next frame",
            f"{rule_words(run, one)}: {apart}of the pairs inside at a frame {percent(again)} are inside at "
            "the next; of those that begin, at most half. Lifetimes are "
            "upper bounds, and pairs came and went between the frames unseen.",
            _BOUND,
        )
    elif one["flips"] >= FEW and found["says"] and found["lost"] is None:
        yield Finding(
            "BETWEEN_FRAMES",
            "warning" if found["doubled"] > HIDDEN else "info",
            "how many flips happened between the frames cannot be told",
            f"{rule_words(run, one)}: {found['says']}.",
            _BOUND,
        )
    elif one["flips"] >= FEW and found["lost"] is not None and found["lost"] > HIDDEN:
        yield Finding(
            "BETWEEN_FRAMES",
            "warning",
            f"about {percent(found['lost'])} of the flips happened and reverted between frames",
            f"{rule_words(run, one)}: {found['says']}: {percent(found['low'])} to {percent(found['high'])}.",
            _BOUND,
        )


def by_velocities(one: Mapping[str, Any]) -> float | None:
    """Share of the crossings that velocities show to be missing in the file.

    Returns:
        0 where what is missing may be so by chance; None where there are too few crossings to tell.
    """
    flux = one["flux"]
    if flux is None or flux["lost"] is None or flux["crossed"] < FEW:
        return None
    # a rate from a handful of frames scatters: what it may be by chance is no finding
    return flux["lost"] if flux["rate"] - flux["seen"] > 2.0 * flux["error"] else 0.0


def _velocities(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    flux, lost = one["flux"], by_velocities(one)
    if not lost or lost <= HIDDEN:
        return
    rate = f"{number(flux['rate'])} ± {number(flux['error'], 2)} times per {run.summary['time']}"
    yield Finding(
        "FLUX",
        "warning",
        f"velocities say that {percent(lost)} of the crossings are not in the file",
        f"{rule_words(run, one)}: by the velocities of {many(flux['frames'], 'frame')} pairs cross {rate}, "
        f"and the file shows {number(flux['seen'])}. The difference are pairs that cross and turn back "
        "before the next frame.",
        _BOUND,
    )


def _chatter(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    found = one["chatter"]
    if one["flips"] < FEW or found["share"] < CHATTER or far_apart(one):
        return
    window = many(found["window"], "frame")
    yield Finding(
        "CHATTER",
        "info",
        f"{percent(found['share'])} of the flips are taken back within {window}",
        f"{rule_words(run, one)}: {count(found['undone'])} of {many(one['flips'], 'flip')} are undone by the "
        f"same pair. The median contact lasts {life(run, one['lifetime'])}; if gaps up to {window} are "
        f"overlooked, {life(run, one['intermittent'])}.",
        "Say which of the two is meant; in a solid, move the cutoff between two shells.",
    )


def _censored(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    seen = one["contacts"]
    total = sum(seen.values())
    cut = total - seen["seen"]
    if not total or cut <= CENSORED * total or run.summary["frames"] < 2:
        return
    yield Finding(
        "CENSORED",
        "info",
        f"{percent(cut / total)} of the contacts begin before the file or go on after it",
        f"{rule_words(run, one)}: {count(seen['older'])} were there at the first frame and ended, "
        f"{count(seen['goes_on'])} were seen to begin and go on, {count(seen['throughout'])} last "
        "throughout; "
        f"{count(seen['seen'])} were seen whole. A mean over those alone would be too short. Lifetimes here "
        "count the others for as long as they were seen, except those that were there at the start, whose "
        "age nobody knows.",
    )


def _images(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    if one["images"]:
        yield Finding(
            "IMAGES",
            "info",
            f"{many(one['images'], 'pair')} through further images of an atom",
            f"{rule_words(run, one)}: the box is narrower than twice the reach of the rule. An atom meets "
            "several images of another there, or its own. Each counts (rank 0, 1, ...); codes that look at "
            "the nearest image alone count fewer.",
        )
