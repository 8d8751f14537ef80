"""Choices that were screened: when each changes a bit, forks and splits."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mdnum.report.axes import PAGE_WIDTH, drawn
from mdnum.report.fork.run import ForkFolder
from mdnum.report.svg import BAD, FIRST, HALO, INK, MUTED, SECOND


def ranking(run: ForkFolder, width: float = PAGE_WIDTH) -> Figure:
    """A line per choice: where the first bit, the first decision and the runs part."""
    wide = width >= PAGE_WIDTH
    # `drawn` lowers a figure on a phone, where names take two lines
    height = 0.75 + 0.24 * len(run.ranking) if wide else (1.0 + 0.29 * len(run.ranking)) / 0.85
    return drawn(partial(_ranking, run), height, width)


def _ranking(run: ForkFolder, figure: Figure) -> None:
    axes = figure.subplots()
    wide = figure.get_figwidth() >= PAGE_WIDTH
    place = np.arange(len(run.ranking))[::-1]
    marks: tuple[tuple[str, str, str, str, dict[str, Any]], ...] = (
        ("seed", "first bit", "o", MUTED, {"mfc": "none", "mew": 1.1}),
        ("fork", "first decision", "o", FIRST, {"mew": 0}),
        ("split", "split", "X", SECOND, {"mew": 0}),
    )
    for at, one in zip(place, run.ranking, strict=True):
        known = [one[name] for name, *_ in marks if one.get(name) is not None]
        if len(known) > 1:
            axes.plot([min(known), max(known)], [at, at], color=MUTED, lw=0.8, zorder=1.5)
        if one.get("fork") is None:
            word = "no bit differs" if one.get("seed") is None else "no fork"
            label = axes.annotate(
                word, (one.get("seed") or 0, at), (8, 0), textcoords="offset points", fontsize=8, color=MUTED,
                va="center",
            )  # fmt: skip
            label.set_gid(HALO)
    for name, label, marker, color, style in marks:
        rows = [
            (one[name], at, one)
            for at, one in zip(place, run.ranking, strict=True)
            if one.get(name) is not None
        ]
        if not rows:
            continue
        for bad in (False, True):
            mine = [(x, y) for x, y, one in rows if (bool(one.get("must_hold")) and name != "split") == bad]
            if mine:
                x, y = zip(*mine, strict=True)
                axes.plot(
                    x, y, marker, color=BAD if bad else color, ms=6 if name != "split" else 6.5, ls="",
                    label=f"{label} that must not differ" if bad else label, zorder=3, **style,
                )  # fmt: skip
    axes.set_xscale("symlog", linthresh=10, linscale=0.6)
    axes.set_xlim(-1.5, 1.5 * max(run.steps, 10))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    names = [str(one["choice"]) for one in run.ranking]
    axes.set_yticks(
        place, names if wide else [_broken(name) for name in names], fontsize=8.5 if wide else 7.5
    )
    axes.set_ylim(-0.7, len(run.ranking) - 0.3)
    axes.set_xlabel("step", color=INK)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            handles, labels, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=len(labels) if wide else 1,
            frameon=False, handlelength=1.3, borderaxespad=0.1, fontsize=8.5,
        )  # fmt: skip


def _broken(name: str) -> str:
    """A long name in two lines."""
    head, equals, tail = name.partition("=")
    return f"{head}=\n{tail}" if equals and len(name) > 18 else name
