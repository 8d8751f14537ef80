"""Figures on the flips of a trajectory, a set for each rule."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.flips.words import axis, moment, rule_words
from mdnum.report.fork.question import Question
from mdnum.report.words import many

#: Rules that get figures of their own; the others have their rows in the tables.
SHOWN = 4
# frames from which on flips are drawn as means over stretches
_DENSE = 400


def plots(run: Question) -> dict[str, Plot]:
    """Figures by name, "<rule>-<what>"."""
    found = {}
    for number in range(min(len(run.summary["rules"]), SHOWN)):
        for name, plot in _of_rule(run, number):
            if plot is not None:
                found[f"rule{number}-{name}"] = plot
    return found


def _of_rule(run: Question, number: int) -> Iterator[tuple[str, Plot | None]]:
    tables = {
        name: {key: values[run.tables[name]["rule"] == number] for key, values in run.tables[name].items()}
        for name in ("frames", "lifetimes", "neighbors")
    }
    yield "pairs", _pairs(run, number, tables["frames"])
    yield "flips", _flips(run, number, tables["frames"])
    yield "lifetimes", _lifetimes(run, tables["lifetimes"])
    yield "neighbors", _neighbors(run, tables["frames"])
    yield "distribution", _distribution(tables["neighbors"])
    yield "stride", _stride(run, number)
    yield "chatter", _chatter(run, number)


def _pairs(run: Question, number: int, table: dict[str, np.ndarray]) -> Plot | None:
    if len(table["pairs"]) < 2:
        return None
    label, x = moment(run, table)
    pairs = table["pairs"].astype(float)
    what = rule_words(run, run.summary["rules"][number])
    return Plot(f"Pairs inside, {what}", label, "pairs inside", (Series("pairs inside", x, pairs),))


def _flips(run: Question, number: int, table: dict[str, np.ndarray]) -> Plot | None:
    if not run.summary["rules"][number]["flips"]:
        return None
    label, x = moment(run, table)
    columns = [x[1:], *(table[name][1:].astype(float) for name in ("entered", "left", "ambiguous"))]
    width = -(-len(columns[0]) // _DENSE)
    if width > 1:
        whole = len(columns[0]) // width * width
        columns = [values[:whole].reshape(-1, width).mean(1) for values in columns]
    x, entered, left, ambiguous = columns
    series = [Series("entered", x, entered), Series("left", x, left, role="second")]
    if ambiguous.any():
        series.append(Series("undecidable", x, ambiguous, role="bad"))
    over = f", mean over {width}" if width > 1 else ""
    return Plot("Flips from frame to frame", label, f"flips per frame{over}", tuple(series))


def _lifetimes(run: Question, table: dict[str, np.ndarray]) -> Plot | None:
    if len(table["frames"]) < 3 or not run.summary["frames"] > 2:
        return None
    label, factor = axis(run)
    x = table["frames"] * factor
    rows = x > 0
    window = run.summary["window"]
    lines = (
        ("lifetime (seen to begin)", "survival", "first", False),
        (f"the same, gaps up to {many(window, 'frame')} overlooked", "intermittent", "first", True),
        ("still inside, of those found inside", "residence", "second", False),
        ("inside again or still", "again", "second", True),
    )
    series = tuple(
        Series(words, x[rows], table[name][rows], role=role, dashed=dashed)  # type: ignore[arg-type]
        for words, name, role, dashed in lines
        if np.isfinite(table[name][rows]).any()
    )
    if not series:
        return None
    return Plot("How long contacts last", label, "share", series, x_scale="log")


def _neighbors(run: Question, table: dict[str, np.ndarray]) -> Plot | None:
    if len(table["pairs"]) < 2 or np.all(table["fewest"] == table["most"]):
        return None
    label, x = moment(run, table)
    series = tuple(
        Series(words, x, table[name].astype(float), role=role)  # type: ignore[arg-type]
        for words, name, role in (
            ("most", "most", "second"), ("mean", "neighbors", "first"), ("fewest", "fewest", "third"),
        )
    )  # fmt: skip
    return Plot("Neighbors of an atom", label, "neighbors", series)


def _distribution(table: dict[str, np.ndarray]) -> Plot | None:
    if len(table["neighbors"]) < 2:
        return None
    numbers = np.arange(table["neighbors"].min(), table["neighbors"].max() + 1)
    share = np.zeros(len(numbers))
    share[table["neighbors"] - numbers[0]] = table["counted"] / table["counted"].sum()
    points = "line+points" if len(numbers) < 60 else "line"
    return Plot(
        "Atoms by their number of neighbors", "neighbors", "share of atoms and frames",
        (Series("", numbers, share, mark=points),),
    )  # fmt: skip


def _stride(run: Question, number: int) -> Plot | None:
    found = run.summary["rules"][number]["stride"]
    of = np.array(found["of"], float)
    if len(of) < 3 or not of.all():
        return None
    stride, left = np.array(found["stride"]), np.array(found["flips"]) / of
    return Plot(
        "Flips that are left when frames are left out", "every so manieth frame", "share of the flips",
        (Series("", stride, left, mark="line+points"),), x_scale="log",
    )  # fmt: skip


def _chatter(run: Question, number: int) -> Plot | None:
    found = run.summary["rules"][number]["chatter"]
    if not found["undone"]:
        return None
    frames = np.arange(1, found["window"] + 1)
    series = tuple(
        Series(words, frames, np.array(found[name][1:], float), mark="line+points", role=role)  # type: ignore[arg-type]
        for words, name, role in (
            ("left again", "inside", "first"), ("entered again", "outside", "second"),
        )
    )  # fmt: skip
    return Plot("Flips that the same pair takes back", "after so many frames", "flips", series)


def captions(run: Question) -> dict[str, str]:
    """What stands below each figure, by its name."""
    words = {
        "pairs": "Counted at each frame.",
        "flips": "A flip is a pair that is inside at a frame and was outside at the one before, or the "
        "reverse; "
        "what happened in between is not in the file.",
        "lifetimes": "Solid, first: share of contacts seen to begin that last longer (product-limit "
        "estimate, "
        "which counts those that go on after the last frame for as long as they were seen). Second: of pairs "
        "found inside at any frame, the share still inside, or inside again, so much later.",
        "neighbors": "Fewest, mean and most over the atoms, at each frame.",
        "distribution": "Over all atoms and frames.",
        "stride": "A flip is lost when the pair flips back before the next frame that is kept. Where the "
        "line still rises at stride 1, more happened between the frames of the file.",
        "chatter": "A pair near its threshold flips back and forth.",
    }
    shown = range(min(len(run.summary["rules"]), SHOWN))
    return {f"rule{number}-{name}": text for number in shown for name, text in words.items()}
