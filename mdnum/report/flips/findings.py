"""Verdict and findings on the flips of a trajectory, from its folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.flips.words import duration, flips_of, length, rule_words
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, verdict
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number, percent

#: Share of flips that the file must leave undecided, that stays between frames must hide, or that must be
#: taken back at once, before it is worth a warning.
UNDECIDED, HIDDEN, CHATTER = 0.02, 0.10, 0.15
#: Share of contacts without a beginning or an end in the file above which a median is a guess.
CENSORED = 0.5
# fewer flips than this say nothing in shares
_FEW = 20


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a trajectory."""
    found = list(_findings(run))
    quiet = not any(one.severity != "info" for one in found)
    return verdict(_headline(run), _evidence(run), found, plain_tone="good" if quiet else "info")


def _headline(run: Question) -> str:
    summary = run.summary
    rules = summary["rules"]
    frames = many(summary["frames"], "frame")
    if summary["frames"] < 2:
        return f"One frame holds {many(rules[0]['pairs_first'], 'pair')} inside and cannot hold a flip."
    if not any(one["flips"] for one in rules):
        return f"No pair entered or left a threshold in {frames}."
    first = max(rules, key=lambda one: one["flips"]) if not rules[0]["flips"] else rules[0]
    text = f"{many(first['flips'], 'flip')} of {many(first['pairs_flipped'], 'pair')} in {frames}"
    text += f" ({rule_words(run, first)})"
    if hidden := _hidden(first):
        text += f"; about {percent(hidden)} more happened between the frames" if hidden > HIDDEN else ""
    if first["flips"] >= _FEW and first["ambiguous"] > UNDECIDED * first["flips"]:
        share = percent(first["ambiguous"] / first["flips"])
        text += f"; of {share} of them the file cannot tell whether they happened"
    return text + "."


def _hidden(one: Mapping[str, Any]) -> float | None:
    """Flips between frames for each flip in the file, by whichever estimate there is."""
    flux = (one["flux"] or {}).get("lost")
    lost = flux if flux is not None and flux > 0 else one["stride"]["lost"]
    return lost / (1 - lost) if lost and lost < 1 else None


def _evidence(run: Question) -> Iterator[str]:
    summary = run.summary
    yield summary["resolution"]["words"]
    for number_, one in enumerate(summary["rules"][:3]):
        rows = run.tables["frames"]["rule"] == number_
        pairs, entered, left = (run.tables["frames"][name][rows] for name in ("pairs", "entered", "left"))
        if summary["frames"] > 1 and (np.diff(pairs) == (entered - left)[1:]).all():
            yield (
                f"{rule_words(run, one)}: {flips_of(one)}; pairs inside = pairs at the start + entered − "
                "left at "
                "every frame."
            )
        life = one["lifetime"]
        if life["followed"]:
            told = duration(run, life["median"], beyond="longer than the file can tell")
            yield (
                f"The median contact that begins in the file lasts {told}; pairs inside leave after "
                f"{duration(run, life['mean_by_rate'])} on average, by their rate."
            )


def _findings(run: Question) -> Iterator[Finding]:
    yield from _stopped(run)
    for place, one in enumerate(run.summary["rules"]):
        yield from _algebra(run, place, one)
        yield from _undecided(run, one)
        yield from _between(run, one)
        yield from _velocities(run, one)
        yield from _chatter(run, one)
        yield from _censored(run, one)
        yield from _images(run, one)
    yield from _times(run)
    yield from _notes(run)


def _stopped(run: Question) -> Iterator[Finding]:
    if run.summary["stopped"]:
        yield Finding(
            "STOPPED",
            "error",
            f"the file could be used up to frame {count(int(run.tables['frames']['number'][-1]))} only",
            f"{run.summary['stopped']} Everything here is about the {many(run.summary['frames'], 'frame')} "
            "before it.",
            "Check how the file was written; a run that was killed leaves a last frame that is not whole.",
        )


def _algebra(run: Question, place: int, one: Mapping[str, Any]) -> Iterator[Finding]:
    table = run.tables["frames"]
    rows = table["rule"] == place
    net = (table["entered"][rows] - table["left"][rows])[1:]
    wrong = np.flatnonzero(np.diff(table["pairs"][rows]) != net)
    if len(wrong):
        yield Finding(
            "EVENT_ALGEBRA",
            "error",
            f"pairs and flips disagree from frame {count(int(wrong[0]) + 1)} on",
            f"{one['rule']}: pairs inside are not those before + entered − left at "
            "{many(len(wrong), 'frame')}.",
            "The ledger cannot be used. Please report it.",
        )


def _undecided(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    if not one["ambiguous"]:
        return
    share = one["ambiguous"] / one["flips"]
    grave = one["flips"] >= _FEW and share > UNDECIDED
    yield Finding(
        "UNDECIDABLE",
        "warning" if grave else "info",
        f"{many(one['ambiguous'], 'flip')} of {count(one['flips'])} within the file's resolution",
        f"{run.summary['resolution']['words']} With {rule_words(run, one)}, {percent(share)} of the flips "
        "have a "
        "distance so close to the threshold, before or after, that the positions before they were written "
        "may "
        f"have been on the other side; so have {number(one['near_mean'], 2)} pairs at an average frame, "
        "flips or "
        "not.",
        "Write positions with more digits, or count only flips with ambiguous = False." if grave else "",
    )


def _between(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    found = one["stride"]
    if one["flips"] < _FEW or not found["says"]:
        return
    if found["lost"] is None:
        yield Finding(
            "BETWEEN_FRAMES",
            "warning" if found["at_least"] > HIDDEN else "info",
            "how many flips happened between the frames cannot be told",
            f"{rule_words(run, one)}: {found['says']}. Frames half as far apart would bring "
            f"{percent(found['at_least'])} of all flips to light, and those between them more.",
            "Write frames more often before speaking of rates: count what the file shows as a lower bound.",
        )
    elif found["lost"] > HIDDEN:
        yield Finding(
            "BETWEEN_FRAMES",
            "warning",
            f"about {percent(found['lost'])} of the flips happened and reverted between frames",
            f"{rule_words(run, one)}: {found['says']}.",
            "Write frames more often, or count what the file shows as a lower bound.",
        )


def _velocities(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    flux = one["flux"]
    if flux is None or flux["lost"] is None or flux["crossed"] < _FEW or flux["lost"] <= HIDDEN:
        return
    unit = run.summary["time"]
    yield Finding(
        "FLUX",
        "warning",
        f"velocities say that {percent(flux['lost'])} of the crossings are not in the file",
        f"{rule_words(run, one)}: pairs cross {number(flux['rate'])} times per {unit} (± "
        "{number(flux['error'], 2)}, "
        f"from the velocities of {many(flux['frames'], 'frame')}), and the file shows "
        "{number(flux['seen'])}. Most "
        "of the difference are pairs that cross and turn back before the next frame.",
        "Write frames more often, or count what the file shows as a lower bound.",
    )


def _chatter(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    found = one["chatter"]
    if one["flips"] < _FEW or found["share"] < CHATTER:
        return
    yield Finding(
        "CHATTER",
        "info",
        f"{percent(found['share'])} of the flips are taken back within {many(found['window'], 'frame')}",
        f"{rule_words(run, one)}: {count(found['undone'])} of {many(one['flips'], 'flip')} are undone by the "
        "same "
        f"pair. A contact that is allowed gaps of {many(found['window'], 'frame')} has a median life of "
        f"{duration(run, one['intermittent']['median'])}, one that is not of "
        f"{duration(run, one['lifetime']['median'])}.",
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
        f"{count(seen['goes_on'])} were seen to begin and go on, {count(seen['throughout'])} last from the "
        "first "
        f"frame to the last; {count(seen['seen'])} were seen whole. A mean over those alone would be too "
        "short; "
        "lifetimes here count the others for as long as they were seen, except those that were there at the "
        "start, whose age nobody knows.",
        "",
    )


def _images(run: Question, one: Mapping[str, Any]) -> Iterator[Finding]:
    if one["images"]:
        yield Finding(
            "IMAGES",
            "info",
            f"{many(one['images'], 'pair')} {'is' if one['images'] == 1 else 'are'} inside through further "
            "images",
            f"{rule_words(run, one)}: the box is narrower than twice the reach of the rule, so that an atom "
            "meets "
            "several images of another, or its own. Each counts (rank 0, 1, ...); codes that look at the "
            "nearest "
            "image alone count fewer.",
            "",
        )


def _times(run: Question) -> Iterator[Finding]:
    summary = run.summary
    if summary["backward"]:
        yield Finding(
            "TIME_GOES_BACK",
            "warning",
            f"time stands still or goes back at {many(summary['backward'], 'frame')}",
            "Two files may have been put one behind the other. Flips between such frames compare states that "
            "do "
            "not follow one another, and times are those of the frames' numbers.",
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
    for note in run.summary["notes"]:
        yield Finding("READING", "info", "how the file was read", note, "")
    resolution = run.summary["resolution"]
    if resolution["kind"] in ("grid", "fractions"):
        what = length(run, resolution["step"]) if resolution["kind"] == "grid" else number(resolution["step"])
        yield Finding(
            "GRID",
            "info",
            f"positions lie on a grid of {what}",
            f"{resolution['words']} A flip that it made or hid is marked as undecidable where it can be one.",
            "",
        )
