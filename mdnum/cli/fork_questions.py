"""The other questions of `mdnum fork`: in exact arithmetic, ahead of time, of an ensemble, of two folders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mdnum.cli import output
from mdnum.cli.progress import ProgressBar
from mdnum.errors import InputError


def certify(system: str, steps: int | None, overrides: Mapping[str, str], *, as_json: bool) -> int:
    """When runs under each precision policy leave the history in exact arithmetic."""
    from mdnum.forks.exact import certify as certified
    from mdnum.systems import build

    with ProgressBar() as progress:
        found = certified(
            build(system, overrides), steps, progress=lambda at, last: progress(at, last, {"phase": "run"})
        )
    rows = [
        {
            "policy": row.name,
            "horizon": row.horizon,
            "margin": row.margin,
            "growth_rate": row.growth.rate,
            "failed": row.failed,
            "gain": row.gain,
        }
        for row in found.ranking
    ]
    if as_json:
        output.print_json({"question": "certify", "steps": found.steps, "says": found.says, "ranking": rows})
        return output.EXIT_FINE
    out = output.console()
    for sentence in found.says:
        out.print(sentence, style="bold", markup=False)
    table = [
        (
            row["policy"],
            f"beyond step {found.steps:,}" if row["horizon"] is None else f"step {row['horizon']:,}",
            row["growth_rate"],
            row["failed"],
        )
        for row in rows
    ]
    output.print_table("", ("precision", "leaves the exact history", "growth a step", ""), table)
    return output.EXIT_FINE


def foretell(
    system: str, size: float, steps: int | None, overrides: Mapping[str, str], *, as_json: bool
) -> int:
    """Which decisions a perturbation of the start would flip first, from one tangent run."""
    if not 0 < size < float("inf"):
        raise InputError(f"--forecast {size:g}; expected a length above 0")
    from mdnum.forks.forecast import forecast
    from mdnum.systems import build

    found = forecast(build(system, overrides), steps)
    first, nearest = found.first(size), found.nearest()
    until = found.linear_until(size)
    if as_json:
        output.print_json(
            {
                "question": "forecast",
                "steps": found.steps,
                "size": size,
                "first": first,
                "nearest": nearest,
                "linear_until": until,
            }
        )
        return output.EXIT_FINE
    out = output.console()
    if first:
        flip = first[0]
        which = f"pair {flip.i}–{flip.j} at step {flip.step:,}"
        head = f"A random displacement of {size:g} is expected to flip {which} first."
    else:
        head = f"A random displacement of {size:g} is expected to flip nothing in {found.steps:,} steps."
    out.print(head, style="bold", markup=False)
    out.print(f"  small enough for a forecast up to step {until:,}", markup=False)
    for title, flips in (("flips first", first), ("nearest to flipping", nearest)):
        table = [
            (
                flip.step,
                f"{flip.i}–{flip.j}",
                f"{flip.amplitude:.3e}",
                f"{flip.ulps:.3g}",
                f"{flip.margin:.3e}",
            )
            for flip in flips
        ]
        if table:
            output.print_table(title, ("step", "pair", "displacement", "ulps of the start", "margin"), table)
    return output.EXIT_FINE


def consistent(
    system: str, vary: str, steps: int | None, overrides: Mapping[str, str], *, as_json: bool
) -> int:
    """Whether a choice changes anything that would be measured: an ensemble-consistency test."""
    from mdnum.forks.benign import benign
    from mdnum.forks.choices import parse
    from mdnum.systems import load

    twin = parse(vary).make(load(system, overrides, world="md"))
    with ProgressBar() as progress:
        found = benign(twin, steps=steps, progress=progress)
    if as_json:
        output.print_json({"question": "benign", "vary": vary, **output.plain(found)})
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

    found = compare_folders(a, b)
    if as_json:
        output.print_json({"question": "folders", **output.plain(found)})
        return output.EXIT_FINE
    out = output.console()
    for number, reason in enumerate(found.reasons):
        out.print(reason, style="bold" if number == 0 else None, markup=False)
    output.print_table(
        "", ("", "step"), [("seed", _step(found.seed, found.steps)), ("fork", _step(found.fork, found.steps))]
    )
    if found.differences:
        output.print_table("differences", ("key", "A", "B"), found.differences)
    table = [
        (flip.run, f"{flip.i}–{flip.j}", "entered" if flip.entered else "left", flip.margin, flip.bound)
        for flip in found.decisions[:10]
    ]
    if table:
        output.print_table("decisions at the fork", ("only in", "pair", "", "margin", "bound"), table)
    return output.EXIT_FINE


def _step(step: int | None, steps: int) -> str:
    return f"none in {steps:,}" if step is None else f"{step:,}"
