"""Numbers of a folder of flips as people read them: stretches of frames as times, rules with units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mdnum.report.fork.question import Question
from mdnum.report.words import count, many, number, plain


def duration(run: Question, frames: float | None, digits: int = 3, beyond: str = "longer than seen") -> str:
    """A stretch of frames as time where the file has times, else in frames."""
    if frames is None:
        return beyond
    interval = run.summary["interval"]
    if run.summary["timed"] and interval:
        return f"{number(frames * interval, digits)} {run.summary['time']}"
    return f"{number(frames, digits)} frame{'' if frames == 1 else 's'}"


def length(run: Question, value: float | None, digits: int = 3) -> str:
    """A length with its unit."""
    return f"{number(value, digits)} {run.summary['length']}".rstrip()


def per_time(run: Question, per_frame: float | None, digits: int = 3) -> str:
    """A rate per frame as one per time, where the file has times."""
    if per_frame is None:
        return "–"
    interval = run.summary["interval"]
    if run.summary["timed"] and interval:
        return f"{number(per_frame / interval, digits)} per {run.summary['time']}"
    return f"{number(per_frame, digits)} per frame"


def size(run: Question) -> str:
    """Atoms, frames, and how far apart."""
    summary = run.summary
    text = f"{many(summary['atoms'], 'atom')}, {many(summary['frames'], 'frame')}"
    if summary["timed"] and summary["frames"] > 1:
        text += f" {plain(summary['interval'])} {summary['time']} apart"
    return text


def rule_words(run: Question, one: Mapping[str, Any]) -> str:
    """A rule with its unit: r < 8.5 Å."""
    unit = run.summary["length"]
    return (
        f"{one['rule']} {unit}" if unit and "<" in one["rule"] and "most" not in one["rule"] else one["rule"]
    )


def axis(run: Question) -> tuple[str, float]:
    """(label, factor) of an axis of lags in frames."""
    summary = run.summary
    if summary["timed"] and summary["interval"]:
        return f"time ({summary['time']})", float(summary["interval"])
    return "frames", 1.0


def moment(run: Question, table: Mapping[str, Any]) -> tuple[str, Any]:
    """(label, values) of an axis along the trajectory."""
    if run.summary["timed"] and not run.summary["backward"]:
        return f"time ({run.summary['time']})", table["time"]
    return "frame", table["frame"]


def flips_of(one: Mapping[str, Any]) -> str:
    """1,234 flips, 600 entered and 634 left."""
    return f"{many(one['flips'], 'flip')}, {count(one['entered'])} entered and {count(one['left'])} left"
