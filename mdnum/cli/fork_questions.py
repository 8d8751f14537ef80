"""Questions of `mdnum fork` of an ensemble, and of two finished runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import output
from mdnum.cli.fork_print import print_rows
from mdnum.cli.progress import ProgressBar, watched
from mdnum.plain import plain


def consistent(
    system: str, vary: str, steps: int | None, overrides: Mapping[str, str], *, as_json: bool
) -> int:
    """Whether a choice changes anything that would be measured: an ensemble-consistency test."""
    from mdnum.forks.benign import benign
    from mdnum.forks.choices import parse, twin_of
    from mdnum.systems import load

    twin = twin_of(parse(vary), load(system, overrides, world="md"))
    with ProgressBar() as progress:
        found = benign(twin, steps=steps, progress=progress)
    if as_json:
        output.print_json({"question": "benign", "vary": vary, **plain(found)})
        return output.EXIT_FINE if found.passed else output.EXIT_FINDINGS
    out = output.console()
    out.print(found.says, style="bold", markup=False)
    rows = [
        ("step of the comparison", f"{found.window:,}"),
        ("principal components", found.components),
        ("fails on A itself", f"{found.false_positives[0]} of {found.false_positives[1]}"),
    ]
    output.print_table("", ("", ""), rows)
    if found.failing:
        output.print_table(
            "gives it away", ("feature", "standard deviations"), list(found.failing.items())[:8]
        )
    return output.EXIT_FINE if found.passed else output.EXIT_FINDINGS


def folders(a: Path, b: Path, *, as_json: bool) -> int:
    """Where two finished runs part, by what they stored."""
    from mdnum.forks.folders import compare_folders
    from mdnum.workflow.fork_words import folder_reasons

    found = compare_folders(a, b)
    reasons = list(folder_reasons(found))
    output.print_notes(a, b)
    if as_json:
        output.print_json({"question": "folders", **plain(found), "reasons": reasons})
        return output.EXIT_FINE
    out = output.console()
    # what was different comes first: no date means anything without it
    if found.differences:
        output.print_table("differences", ("key", "A", "B"), found.differences)
    for number, reason in enumerate(reasons):
        out.print(reason, style="bold" if number == 0 else None, markup=False)
    output.print_table(
        "", ("", "step"), [("seed", _step(found.seed, found.steps)), ("fork", _step(found.fork, found.steps))]
    )
    verbs = ("entered", "left") if found.world == "md" else ("begins", "ends")
    noun = "pair" if found.world == "md" else "ball"
    table = [
        (flip.run, "–".join(map(str, flip.subject)), verbs[not flip.entered], flip.margin, flip.bound)
        for flip in found.decisions[:10]
    ]
    if table:
        output.print_table("decisions at the fork", ("only in", noun, "", "margin", "bound"), table)
    if found.iterations is not None:
        output.print_table("iterations at the fork", ("A", "B"), [found.iterations])
    return output.EXIT_FINE


def replay(a: Path, b: Path, pair: dict[str, Any], *, as_json: bool) -> int:
    """Two finished runs followed again, into a fork folder."""
    from mdnum.workflow import fork_folders

    with watched() as progress:
        result = fork_folders(a, b, progress=progress, **pair)
    if not as_json:
        output.print_table("differences", ("key", "A", "B"), result.summary["differences"])
        output.console().print(f"replay: {result.summary['replayed']}", markup=False)
    return output.answer(result.folder, result.summary, print_rows, as_json=as_json)


def _step(step: int | None, steps: int) -> str:
    return f"none in {steps:,}" if step is None else f"{step:,}"
