"""A verdict in words on a run of the ball, with its findings and evidence; from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mdnum.report.ball.rules import CODES, RULES, accounted, differs
from mdnum.report.ball.run import BallFolder, load
from mdnum.report.verdict import Verdict, conclude, restore
from mdnum.report.words import count, listed, many, number
from mdnum.store import RunFolder


def judge(run: BallFolder) -> Verdict:
    """All findings of a run, and the verdict.

    Findings that others left in summary.json are kept; those of `rules` are decided anew.
    """
    found = [finding for rule in RULES for finding in rule(run)]
    found += [restore(kept) for kept in run.summary.get("findings") or () if kept.get("code") not in CODES]
    return conclude(found, _evidence(run), run.summary.get("status") == "complete")


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a run and writes findings and verdict into its summary.json."""
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = judge(run)
    verdict.store(folder, run.summary)
    return verdict


def _evidence(run: BallFolder) -> Iterator[str]:
    if accounted(run) is None:
        flips = run.rows["contacts"]
        what = (
            f"All {many(flips, 'contact flip')} are accounted for"
            if flips > 1
            else "The one contact flip is accounted for"
            if flips
            else "No contact began or ended"
        )
        yield (
            f"{what}: balls in contact = those at the start + entered − left at every one of "
            f"{many(run.steps, 'step')}."
        )
    ended = run.ended
    solves = sum(ended.values())
    if solves and not run.located:
        if len(ended) == 1:
            (word,) = ended
            yield f"{'All ' if solves > 1 else ''}{many(solves, 'solve')} ended by {_WAYS.get(word, word)}."
        else:
            ways = listed([f"{count(n)} by {_WAYS.get(word, word)}" for word, n in ended.items()])
            yield f"Of {many(solves, 'solve')} ended {ways}."
    if not np.any(run.series["ambiguous"]) and not run.summary.get("ambiguous"):
        yield f"No decision lay within rounding{_nearest(run)}."
    exact = run.exact
    if exact.get("height_error") is not None:
        yield (
            f"Against the closed form the height is off by {number(exact['height_error'], 2)} m at the end"
            + (
                f" and by {number(exact['height_error_largest'], 2)} m at most."
                if exact.get("height_error_largest") is not None
                else "."
            )
        )
    met = [
        (made["method"], name, exact["gradient"][name])
        for made in run.gradient
        for name in exact.get("gradient") or {}
        if name in made["gradient"] and not differs(made["gradient"][name], exact["gradient"][name])
    ]
    if met:
        methods = list(dict.fromkeys(method for method, *_ in met))
        names = list(dict.fromkeys(name for _, name, _ in met))
        yield (
            f"The derivative along {listed(names)} meets the closed form’s: {listed(methods)}."
            if len(methods) > 1 or len(names) > 1
            else f"The {methods[0]} derivative along {names[0]} is the closed form’s, {number(met[0][2])}."
        )


_WAYS = {
    "tolerance": "tolerance", "cap": "the cap", "fixed": "a fixed count", "rest": "rest",
    "not finite": "a number that is not finite",
}  # fmt: skip


def _nearest(run: BallFolder) -> str:
    parts = []
    ratio = run.margins[np.isfinite(run.margins)]
    if len(ratio):
        parts.append(f"the nearest contact flip was {number(float(ratio.min()), 2)} rounding bounds away")
    stop = run.summary.get("smallest_stop_margin")
    if stop is not None:
        parts.append(f"the nearest stop decision {number(stop, 2)} from its tolerance")
    return f"; {listed(parts)}" if parts else ""
