"""A fork folder in the terminal: dates, the deciding pair, splits by run; or a ranking of choices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import output

#: Runs of a comparison, in words: arithmetic, and whose decisions it acts on.
_RUNS = {"B": ("B", "its own"), "B|A": ("B", "A's"), "A|B": ("A", "B's")}


def print_fork(summary: Mapping[str, Any], folder: Path) -> None:
    """Print what a fork folder says: one pair of runs, or the ranking of a screening."""
    out = output.console()
    if headline := summary.get("headline"):
        out.print(headline, style="bold", markup=False)
    if "ranking" in summary:
        _print_ranking(summary)
    else:
        _print_pair(summary)
    output.print_findings(summary.get("findings", ()))
    report = folder / "report.html"
    out.print(f"wrote {report if report.exists() else folder}", markup=False)


def _print_pair(summary: Mapping[str, Any]) -> None:
    out = output.console()
    for reason in summary.get("reasons") or ():
        out.print(f"  {reason}", markup=False)
    rows = [
        ("system", f"{summary['system']}, {summary['atoms']:,} atoms, {summary['steps']:,} steps"),
        ("differs in", summary["difference"]),
    ]
    for name, what in (
        ("seed", "first bit differs"),
        ("fork", "first decision differs"),
        ("split", f"further apart than {summary['tolerance']:.3g}"),
    ):
        rows.append((name, _date(summary, name, what)))
    rows += list(_decision(summary.get("decision")))
    rate = summary.get("growth_rate")
    if rate is not None:
        fits = f"r² {summary['r_squared']:.3f}" if summary.get("r_squared") is not None else ""
        rows.append(
            ("growth", f"{rate:.3g} a step, {summary['growth_rate_time']:.3g} a unit of time, {fits}")
        )
    if summary.get("predicted_split") is not None:
        rows.append(("predicted split", f"about step {summary['predicted_split']:,}"))
    rows.append(("flips in one run only", f"{summary['cross_flips']:,}"))
    output.print_table("", ("", ""), rows)
    splits = summary.get("splits") or {}
    if len(splits) > 1:
        lines = [(*_RUNS[name], _split(splits[name])) for name in splits]
        lines += [("B, start perturbed", "its own", f"{split:,}") for split in summary.get("repeats") or ()]
        output.print_table("splits from the first run", ("arithmetic", "decisions", "step"), lines)


def _date(summary: Mapping[str, Any], name: str, what: str) -> str:
    step = summary.get(name)
    if step is None:
        return f"none in {summary['steps']:,} steps ({what})"
    return f"step {step:,}, time {summary[f'{name}_time']:.6g} ({what})"


def _split(step: int | None) -> str:
    return "none" if step is None else f"{step:,}"


def _decision(made: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    if made is None:
        return []
    where = {"A": " in A only", "B": " in B only"}.get(str(made["run"]), " differs at the start")
    way = "" if made["run"] == "start" else "entered" if made["entered"] else "left"
    also = f", with {made['also']:,} more at this step" if made.get("also") else ""
    space = {"r2": "r²", "r": "r"}.get(str(made.get("space")), "")
    rows = [("deciding pair", f"{made['i']}–{made['j']} {way}{where}{also}".replace("  ", " "))]
    for name, margin in (made.get("margins") or {made["run"]: made["margin"]}).items():
        bound = (made.get("bounds") or {}).get(name, made["bound"])
        word = "ambiguous" if abs(margin) <= bound else "not ambiguous"
        rows.append((f"margin in {name}", f"{margin:.3g} in {space}; rounding bound {bound:.3g}: {word}"))
    if made.get("protected") is not None:
        rows.append(
            (
                "apart the step before",
                f"{made['separation_before']:.3g}; the margin is {made['protected']:.3g} of it",
            )
        )
    return rows


def _print_ranking(summary: Mapping[str, Any]) -> None:
    rows = [
        (
            one["choice"],
            *(_split(one.get(name)) for name in ("seed", "fork", "split")),
            "must hold" if one.get("must_hold") else "",
            one.get("failed") or one.get("difference") or "",
        )
        for one in summary["ranking"]
    ]
    output.print_table("choices by fork", ("choice", "seed", "fork", "split", "", "difference"), rows)
    if left := summary.get("not_applicable"):
        output.print_table("do not apply", ("choice", "why"), [(one["choice"], one["why"]) for one in left])
