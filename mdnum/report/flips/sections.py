"""Tables of a trajectory's page: what each rule found, by species and residue, and the busiest pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.flips import limits
from mdnum.report.flips.words import duration, length, per_time, rule_words
from mdnum.report.flips.words import life as life_of
from mdnum.report.fork.question import Question
from mdnum.report.words import count, many, number, percent

#: Rows of a table that is not searched.
_ROWS = 15


def rule(run: Question, place: int) -> dict[str, Any]:
    """What the page says of one rule."""
    one = run.summary["rules"][place]
    return {
        "name": f"rule{place}",
        "words": rule_words(run, one),
        "rows": list(_numbers(run, one)),
        "lifetimes": list(_lifetimes(run, one)),
        "between": list(_between(run, one)),
        "species": _classes(run, one["by_species"]),
        "residue_names": _classes(run, one["by_residue_name"]),
        "residues": _residues(run, place),
    }


def _numbers(run: Question, one: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    around = one["neighbors"]
    yield (
        "Pairs inside",
        f"{count(one['pairs_first'])} at the first frame, {count(one['pairs_last'])} at the last, "
        f"{number(one['pairs_mean'], 5)} on average",
    )
    yield (
        "Flips",
        f"{count(one['flips'])}: {count(one['entered'])} entered, {count(one['left'])} left; "
        f"{number(one['flips_per_frame'], 4)} from frame to frame, by {many(one['pairs_flipped'], 'pair')}",
    )
    yield (
        "Undecidable",
        f"{many(one['ambiguous'], 'flip')}; {number(one['near_mean'], 3)} pairs within the file's resolution "
        "of their threshold at an average frame",
    )
    if one["min_margin"] is not None:
        yield "Closest decision", f"{length(run, one['min_margin'])} from its threshold"
    yield (
        "Neighbors of an atom",
        f"{count(around['fewest'])} to {count(around['most'])}, {number(around['mean'], 4)} on average",
    )
    chatter = one["chatter"]
    yield (
        "Chatter",
        f"{many(chatter['undone'], 'flip')} taken back within {many(chatter['window'], 'frame')} "
        f"({percent(chatter['share'])})",
    )


def _lifetimes(run: Question, one: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    seen, life, loose = one["contacts"], one["lifetime"], one["intermittent"]
    yield (
        "Contacts",
        f"{count(seen['seen'])} seen whole; {count(seen['goes_on'])} go on after the last frame (censored on "
        f"the right); {count(seen['older'])} were there at the first frame (censored on the left); "
        f"{count(seen['throughout'])} throughout",
    )
    if not life["followed"]:
        return
    yield "Median life", life_of(run, life)
    if life["quarter_gone"] is not None:
        yield (
            "Quartiles",
            f"{duration(run, life['quarter_gone'])} and {duration(run, life['three_quarters_gone'])}",
        )
    if life["mean"] is not None:
        told = duration(run, life["mean"])
        if not life["mean_is_whole"]:
            told = f"at least {told}: some last longer than they can be followed"
        yield "Mean life (product-limit)", told
    if life["leaves"]:
        error = duration(run, life["mean_by_rate_error"], 2)
        yield (
            "Mean life (by rate)",
            f"{duration(run, life['mean_by_rate'])} ± {error}: time inside over "
            f"{many(life['leaves'], 'leave')} (the error is that of independent ones)",
        )
    yield (
        "Intermittent contacts",
        f"gaps up to {many(one['chatter']['window'], 'frame')} overlooked: median {life_of(run, loose)}"
        + (f", by rate {duration(run, loose['mean_by_rate'])}" if loose["leaves"] else ""),
    )


def _between(run: Question, one: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    found, flux = one["stride"], one["flux"]
    if found["says"]:
        if found["lost"] is None:
            told = "no number can be given"
        else:
            low, high = percent(found["low"]), percent(found["high"])
            share = f"about {percent(found['lost'])} ({low} to {high})" if found["lost"] else f"below {high}"
            told = f"{share} of all flips"
        yield "Lost between frames, by leaving frames out", f"{told} ({found['says']})"
    if flux is not None and flux["crossed"]:
        unit = run.summary["time"]
        lost = limits.by_velocities(one)
        told = "too few to tell whether some are missing" if lost is None else "no more than by chance"
        if lost:
            told = f"{percent(lost)} not in the file"
        elif lost == 0 and flux["rate"] <= flux["seen"]:
            told = "none is missing"
        yield (
            "Lost between frames, by velocities",
            f"{number(flux['rate'])} ± {number(flux['error'], 2)} crossings per {unit}, "
            f"{number(flux['seen'])} in "
            f"the file: {told}",
        )


def _classes(run: Question, rows: list[Mapping[str, Any]]) -> list[dict[str, str]]:
    frames = max(run.summary["frames"] - 1, 1)
    return [
        {
            "pair": f"{one['first']}–{one['second']}",
            "inside": number(one["inside"] / run.summary["frames"], 4),
            "flips": count(one["entered"] + one["left"]),
            "rate": per_time(run, (one["entered"] + one["left"]) / frames),
            "stay": duration(run, one["stay"], beyond="–"),
        }
        for one in rows[:_ROWS]
    ]


def _residues(run: Question, place: int) -> list[tuple[str, str, str]]:
    table = run.tables["residues"]
    rows = np.flatnonzero(table["rule"] == place)[:_ROWS]
    return [
        (str(table["residue"][at]), count(int(table["between"][at])), count(int(table["within"][at])))
        for at in rows
    ]


def pairs(run: Question) -> Browse | None:
    """The pairs that flipped most often; None where none did."""
    table = run.tables["busiest"]
    if not len(table["i"]):
        return None
    words = [f"{a} – {b}" for a, b in zip(table["first"], table["second"], strict=True)]
    several = len(run.summary["rules"]) > 1
    share = table["inside"] / run.summary["frames"]
    ranks = np.concatenate([np.arange(1, n + 1) for n in np.unique(table["rule"], return_counts=True)[1]])
    columns: list[tuple[np.ndarray, int | None]] = [(ranks, None)]
    columns += [(table[name].astype(int), None) for name in ("i", "j", "rank", "flips", "inside")]
    columns += [(share, 3), (table["rule"].astype(int), None), (np.array(words, dtype=object), None)]
    names = tuple(one["rule"] for one in run.summary["rules"])
    return Browse(
        name="pairs",
        row_id="pair-rows",
        label="Search pairs",
        placeholder="3-17, atom 5",
        columns=(
            Column(0, "", kind="count"),
            *((Column(7, "rule", kind="word", words=names),) if several else ()),
            Column(1, "pair", kind="pair"),
            *((Column(3, "image", kind="count"),) if table["rank"].any() else ()),
            Column(8, "of", kind="text"),
            Column(4, "flips", kind="count"),
            Column(5, "frames inside", kind="count"),
            Column(6, "share of frames"),
        ),
        rows=plain_rows(columns),
        subjects=(1, 2),
        nouns=("atom", "pair"),
    )
