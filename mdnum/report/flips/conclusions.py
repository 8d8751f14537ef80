"""What two trajectories alone allow to conclude about where they part, and what they do not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mdnum.report.flips.words import frame, length, of_time, rule_words
from mdnum.report.fork.question import Question
from mdnum.report.words import count, listed, many, number

# frames after a flip in which a leap of the separation shows, and how much larger than any before it must be
_WINDOW, _LEAP = 10, 5.0
# rates that differ by less than this factor are alike
_ALIKE = 1.5
# r² from which on a line through the logarithm is one exponential
_FITS = 0.8


def views(run: Question) -> list[Question]:
    """The comparison as each rule sees it, the first one first."""
    summary, table = run.summary, run.tables["differing"]
    seen = []
    for place, one in enumerate(summary["rules"]):
        mine = table["rule"] == place
        tables = {**run.tables, "differing": {name: values[mine] for name, values in table.items()}}
        seen.append(Question(run.path, {**summary, **one}, run.system_toml, run.provenance, tables))
    return seen


def shown(run: Question) -> bool:
    """Whether anything that differs is beyond what the resolution of the two files explains."""
    summary = run.summary
    certain = any(one["certain"] is not None for one in summary["rules"])
    return certain or any(summary[name] is not None for name in ("beyond", "other_box"))


def headline(run: Question) -> str:
    """The verdict in one sentence, and where there are several rules one on the others."""
    first, *others = views(run)
    text = _headline(first)
    same = run.summary["seed"] is None and not any(one["first"] for one in run.summary["rules"])
    if same or not others:
        return text
    # rules of which the same is to be said are told together
    told: dict[str, list[str]] = {}
    for one in others:
        told.setdefault(_in_short(one), []).append(rule_words(one, one.summary))
    return f"{text} {_capital(listed([f'those of {listed(who)} {what}' for what, who in told.items()]))}."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _in_short(run: Question) -> str:
    """When the sets of a rule differ, for a sentence about it."""
    first, certain = run.summary["first"], run.summary["certain"]
    if first is None:
        return "never do"
    sure = (
        ""
        if certain == first["frame"]
        else ", within the files’ resolution" + ("" if certain is None else f" before {frame(run, certain)}")
    )
    return f"differ from {frame(run, first['frame'])} on{sure}"


def _headline(run: Question) -> str:
    summary = run.summary
    frames, what = many(summary["frames"], "frame"), rule_words(run, summary)
    seed, first, beyond, boxes = (summary[name] for name in ("seed", "first", "beyond", "other_box"))
    other = "" if boxes is None else ", but not the same box"
    if seed is None and first is None:
        return f"The two trajectories have the same positions in all of {frames}{other}."
    if not shown(run):
        atoms = f"at most {length(run, _largest(run)[0])} apart, as their files’ resolution explains"
        text = f"Nothing here shows that the two differ: atoms are {atoms}, in all of {frames}"
        if first is None:
            return f"{text}, and neighbor sets ({what}) are the same."
        pairs = many(first["pairs"], "pair")
        at = frame(run, first["frame"])
        return f"{text}; neighbor sets ({what}) differ from {at} on, by {pairs}, all within that resolution."
    if first is None and beyond is None:
        return (
            f"Neighbor sets ({what}) are the same in all of {frames}, and positions up to the files’ "
            f"resolution{other}."
        )
    if first is None:
        return f"Positions differ from {frame(run, beyond)} on, neighbor sets ({what}) never do."
    pairs = many(first["pairs"], "pair")
    text = f"Neighbor sets ({what}) differ from {frame(run, first['frame'])} on, first by {pairs}"
    if first["ambiguous"] == first["pairs"]:
        certain = summary["certain"]
        sure = "never" if certain is None else f"from {frame(run, certain)} on"
        return f"{text}, all within the files’ resolution; beyond it {sure}."
    if _by_boxes(run, first):
        return f"{text}, at the same positions in boxes that differ."
    return f"{text}; atoms are {length(run, first['furthest'])} apart by then."


def _by_boxes(run: Question, first: Any) -> bool:
    """Whether the boxes differ when the sets come to differ, and positions do not beyond the resolution."""
    boxes, beyond = run.summary["other_box"], run.summary["beyond"]
    same = beyond is None or beyond > first["frame"]
    return boxes is not None and boxes["frame"] <= first["frame"] and same


def _largest(run: Question) -> tuple[float, float]:
    """(largest distance between an atom in A and in B at any frame, what resolution explains then)."""
    table = run.tables["apart"]
    at = int(np.argmax(table["furthest"]))
    return float(table["furthest"][at]), float(table["bound"][at])


def concluded(run: Question) -> Iterator[str]:
    """What the frames show: positions, the sets of the first rule, and in short those of the others."""
    first, *others = views(run)
    yield from _positions(run)
    yield from _sets(first)
    for one in others:
        found, what = one.summary["first"], rule_words(one, one.summary)
        if found is None:
            yield f"{what}: the sets are the same in all {many(one.summary['frames'], 'frame')}."
        else:
            pairs = many(found["pairs"], "pair")
            yield f"{what}: sets differ from {frame(one, found['frame'])} on, first by {pairs}. " + _certain(
                one, found
            )


def _sets(run: Question) -> Iterator[str]:
    """What the frames show of one rule's sets."""
    summary = run.summary
    first, seed, beyond = summary["first"], summary["seed"], summary["beyond"]
    if first is None:
        if beyond is not None:
            yield (
                f"The sets are the same in all {many(summary['frames'], 'frame')}, with atoms up to "
                f"{length(run, summary['last']['furthest'])} apart at the end: no flip seen here made them "
                "part."
            )
        return
    yield _certain(run, first)
    yield _order(run, first)
    yield from _leap(run, first, seed)
    before, after = (summary["growth"][name] for name in ("before", "after"))
    if before is not None and before["r2"] >= _FITS and before["rate"] > 0:
        yield f"Before the sets differ the separation grows {_rate(run, before)}."
    if after is not None and after["r2"] >= _FITS and after["rate"] > 0:
        yield f"From then on it grows {_rate(run, after)}{_accelerated(before, after)}."


def _positions(run: Question) -> Iterator[str]:
    """From when on positions differ, and from when on by more than the files' last digits."""
    seed, beyond = run.summary["seed"], run.summary["beyond"]
    if seed is None:
        if run.summary["first"] is not None:
            yield "Positions are the same at all frames."
        return
    text = f"Positions differ from {'the first frame' if seed == 0 else frame(run, seed)} on"
    if seed:
        text += " and are the same bit for bit before"
    if beyond is None:
        furthest, explained = _largest(run)
        yield (
            f"{text}, by up to {length(run, furthest)}; the resolution of the two files explains up to "
            f"{length(run, explained)}."
        )
    elif beyond == seed:
        yield f"{text}, at once by more than the resolution of the two files explains."
    else:
        yield f"{text}; by more than the resolution of the two files explains from {frame(run, beyond)} on."


def _certain(run: Question, first: Any) -> str:
    """Since when the sets differ whatever the files have rounded."""
    certain, sure = run.summary["certain"], first["pairs"] - first["ambiguous"]
    if sure:
        return (
            f"Of the {many(first['pairs'], 'pair')} that differ first, {count(sure)} "
            f"{'is' if sure == 1 else 'are'} further from the threshold, in A and in B, than the files’ "
            "resolution explains."
        )
    if certain is None:
        return (
            "Every pair that differs is within the files’ resolution of the threshold, at every frame: "
            "whether the sets differ cannot be told."
        )
    return (
        "The pairs that differ first are within the files’ resolution of the threshold; beyond it a pair "
        f"differs first at {frame(run, certain)}."
    )


def _order(run: Question, first: Any) -> str:
    """Whether a difference of positions was there before one of sets."""
    beyond, certain = run.summary["beyond"], run.summary["certain"]
    if beyond is not None and beyond < first["frame"]:
        before = length(run, first["furthest_before"])
        return (
            f"At the frame before, no set differed and atoms were already up to {before} apart: the "
            "difference of the two did not begin with a flip that these frames show."
        )
    if _by_boxes(run, first):
        return (
            "Positions are the same then, up to the files’ resolution: the sets differ because the boxes do."
        )
    if not shown(run):
        return "Two ways of writing one and the same run would look like this."
    if first["frame"] == 0 and 0 in (beyond, certain):
        return "Sets differ at the first frame: the two do not start alike."
    if first["frame"] in (beyond, certain):
        return (
            "Positions and sets come to differ between the same two frames: which came first lies between "
            "them."
        )
    return (
        "Nothing that differs then is beyond the files’ resolution: which came first, a flip or another "
        "difference, they cannot tell."
    )


def _leap(run: Question, first: Any, seed: int | None) -> Iterator[str]:
    """Whether the separation leaps when the sets come to differ, as it does nowhere before."""
    furthest, at = run.tables["apart"]["furthest"], int(first["frame"])
    # a difference that has just begun grows fast, whatever began it
    start = max((seed or 0) + _WINDOW, at // 2)
    if at + _WINDOW >= len(furthest) or start + _WINDOW > at:
        return
    # what resolution explains does not grow
    if not (furthest > run.tables["apart"]["bound"])[start:].all():
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
    told = number(1 / found["rate"])
    told = of_time(run, told) if run.summary["timed"] else f"{told} frames"
    return f"by a factor e in {told} ({count(found['frames'])} frames)"


def _accelerated(before: Any, after: Any) -> str:
    if before is None or before["r2"] < _FITS or before["rate"] <= 0:
        return ""
    ratio = after["rate"] / before["rate"]
    if ratio > _ALIKE:
        fast = f"{number(ratio, 2)} times as fast"
        return f", {fast}: as it would if the flip accelerated it, and as it may by chance"
    if ratio < 1 / _ALIKE:
        return ", slower than before: nothing here says that a flip accelerated it"
    return ", as before: nothing here says that a flip accelerated it"


def cannot(run: Question) -> Iterator[str]:
    """What two trajectories cannot say, whatever they hold."""
    if any(one["first"] is not None for one in run.summary["rules"]) and shown(run):
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
