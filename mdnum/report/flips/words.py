"""Numbers of a folder of flips as people read them: stretches of frames as times, rules with units."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.report.fork.question import Question
from mdnum.report.verdict import Finding
from mdnum.report.words import count, listed, many, number, plain

_ORDER = ("error", "warning", "info")
# a rule that stays on one line
_SHORT = 20
_SENTENCES = re.compile(r"(?<=\.) (?=[A-Z])")


def merged(found: Iterable[Finding]) -> Iterator[Finding]:
    """One finding for each code: what several rules have in common is said once."""
    by_code: dict[str, list[Finding]] = {}
    for one in found:
        by_code.setdefault(one.code, []).append(one)
    for several in by_code.values():
        worst = min(several, key=lambda one: _ORDER.index(one.severity))
        if len(several) == 1:
            yield worst
            continue
        # the text begins with the rule; the title is about that one alone
        rule = worst.text.partition(": ")[0]
        if len(rule) < _SHORT:
            rule = rule.replace(" ", "\N{NO-BREAK SPACE}")
        yield replace(worst, title=f"{worst.title} ({rule})", text=_together([one.text for one in several]))


def _together(texts: Sequence[str]) -> str:
    """Texts one behind the other, and sentences that all of them have once, at the end."""
    parts = [_SENTENCES.split(text) for text in texts]
    common = [one for one in parts[0] if all(one in other for other in parts)]
    own = [one for part in parts for one in part if one not in common]
    return " ".join([*own, *common])


def timed(run: Question) -> bool:
    """Whether the frames have times that go forward."""
    summary = run.summary
    return bool(summary["timed"] and summary["interval"])


def duration(run: Question, frames: float | None, digits: int = 3, beyond: str = "longer than seen") -> str:
    """A stretch of frames as time where the file has times, else in frames."""
    if frames is None:
        return beyond
    if timed(run):
        return of_time(run, number(frames * run.summary["interval"], digits))
    return f"{plain(frames, digits)} frame{'' if frames == 1 else 's'}"


def of_time(run: Question, text: str) -> str:
    """A number with the unit of time; steps are counted, units are not."""
    unit = run.summary["time"]
    return f"{text} {unit}{'s' if unit == 'step' and text not in ('1', '1.00', '1.0') else ''}"


def life(run: Question, found: Mapping[str, Any]) -> str:
    """The median of a lifetime; no shorter than the distance of two frames."""
    median = found["median"]
    if median is None:
        return "longer than the file can tell"
    return f"{'at most ' if median == 1 else ''}{duration(run, median)}"


def length(run: Question, value: float | None, digits: int = 3) -> str:
    """A length with its unit."""
    return f"{number(value, digits)} {run.summary['length']}".rstrip()


def frame(run: Question, at: int) -> str:
    """A frame of a comparison: its place among those compared, and its numbers in the files if others."""
    a, b = (int(run.tables["apart"][f"number_{one}"][at]) for one in "ab")
    if a == b == at:
        return f"frame {count(at)}"
    if a == b:
        return f"frame {count(at)} ({count(a)} in both files)"
    return f"frame {count(at)} ({count(a)} in A’s file, {count(b)} in B’s)"


def per_time(run: Question, per_frame: float | None, digits: int = 3) -> str:
    """A rate per frame as one per time, where the file has times."""
    if per_frame is None:
        return "–"
    if timed(run):
        return f"{number(per_frame / run.summary['interval'], digits)} per {run.summary['time']}"
    return f"{number(per_frame, digits)} per frame"


def size(run: Question) -> str:
    """Atoms, frames, and how far apart."""
    summary = run.summary
    text = f"{many(summary['atoms'], 'atom')}, {many(summary['frames'], 'frame')}"
    if timed(run):
        text += f" {of_time(run, plain(summary['interval']))} apart"
    return text


def rule_words(run: Question, one: Mapping[str, Any]) -> str:
    """A rule with its unit: r < 8.5 Å."""
    unit = run.summary["length"]
    return (
        f"{one['rule']} {unit}" if unit and "<" in one["rule"] and "most" not in one["rule"] else one["rule"]
    )


def axis(run: Question) -> tuple[str, float]:
    """(label, factor) of an axis of lags in frames."""
    if timed(run):
        return f"time ({run.summary['time']})", float(run.summary["interval"])
    return "frames", 1.0


def moment(run: Question, table: Mapping[str, Any]) -> tuple[str, Any]:
    """(label, values) of an axis along the trajectory."""
    if timed(run):
        return f"time ({run.summary['time']})", table["time"]
    return "frame", table["frame"]


def flips_of(one: Mapping[str, Any]) -> str:
    """1,234 flips, 600 entered and 634 left."""
    return f"{many(one['flips'], 'flip')}, {count(one['entered'])} entered and {count(one['left'])} left"


def box_words(run: Question, box: Any) -> str:
    """A box in words: lengths, angles where they are not right, and the axes along which it repeats."""
    matrix, axes = np.array(box["matrix"]), [name for name, yes in zip("abc", box["pbc"], strict=True) if yes]
    if not axes:
        return "no box that repeats"
    sizes = np.linalg.norm(matrix, axis=1)
    text = f"{' × '.join(plain(float(one), 9) for one in sizes)} {run.summary['length']}".rstrip()
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = matrix / sizes[:, None]
    angles = np.degrees(np.arccos(np.clip([unit[1] @ unit[2], unit[0] @ unit[2], unit[0] @ unit[1]], -1, 1)))
    if np.isfinite(angles).all() and np.abs(angles - 90).max() > 1e-9:
        text += f" at {', '.join(plain(float(one), 7) for one in angles)}°"
    return f"{text}, repeating along {listed(axes)}"
