"""Verdict and findings on a gradient, from its folder alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, verdict
from mdnum.report.grad.words import by, size, slope, slope_unit
from mdnum.report.verdict import Finding
from mdnum.report.words import listed, many

#: Error estimates of a difference within which a method agrees with the reference.
_ERRORS = 3


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a gradient."""
    found = list(_findings(run))
    quiet = not any(one.severity != "info" for one in found)
    return verdict(_headline(run), _evidence(run), found, plain_tone="good" if quiet else "info")


def _headline(run: Question) -> str:
    summary = run.summary
    reference = by(run, summary["reference"])
    parts = []
    for one in summary["parameters"][:3]:
        short = one["name"].rpartition(".")[2]
        value = f"{slope(reference, one['name'], 4)} {slope_unit(summary, one)}".rstrip()
        parts.append(f"d {summary['loss']['word']} / d {short} = {value}")
    return f"After {many(run.steps, 'step')}, {listed(parts)}."


def _evidence(run: Question) -> Iterator[str]:
    summary = run.summary
    reference = by(run, summary["reference"])
    if reference is not None:
        yield f"By {reference['method']}: {reference['says']}."


def _findings(run: Question) -> Iterator[Finding]:
    yield from _not_finite(run)
    yield from _no_dependence(run)
    yield from _refused(run)


def _not_finite(run: Question) -> Iterator[Finding]:
    for one in run.summary["methods"]:
        broken = [name for name, value in one["gradient"].items() if not _finite(value)]
        if broken:
            yield Finding(
                "NOT_FINITE",
                "error",
                f"{one['method']} is not finite by {listed(broken)}",
                "Somewhere on the way a number overflowed or was divided by zero.",
            )


def _finite(value: Any) -> bool:
    magnitude = size(value)
    return magnitude is not None and math.isfinite(magnitude)


def _no_dependence(run: Question) -> Iterator[Finding]:
    """Parameters by which no method finds anything."""
    for one in run.summary["parameters"]:
        name = one["name"]
        sizes = [size(method["gradient"].get(name)) for method in run.summary["methods"]]
        if any(sizes) or None in sizes:
            continue
        notes = [method["notes"].get(name) for method in run.summary["methods"]]
        yield Finding(
            "NO_DEPENDENCE",
            "warning",
            f"the loss does not depend on {name}",
            f"Every method gives exactly 0: {next(filter(None, notes), 'nothing that ran used it')}.",
            "Look at another loss, or run longer.",
        )


def _refused(run: Question) -> Iterator[Finding]:
    refused: list[Mapping[str, Any]] = run.summary["refused"]
    if refused:
        yield Finding(
            "DOES_NOT_APPLY",
            "info",
            f"{many(len(refused), 'method')} gave no gradient",
            " ".join(f"{one['method']}: {one['why'].rstrip('.')}." for one in refused),
        )
