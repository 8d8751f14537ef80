"""`mdnum fork` of a ball: the same question, the same answers, and which of the options a ball has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mdnum.cli import fork_options, output
from mdnum.cli.fork_print import print_ranking, print_two_by_two
from mdnum.cli.progress import watched
from mdnum.errors import InputError


def is_ball(system: str) -> bool:
    """Whether a system's file is a ball's."""
    from mdnum.systems.find import world_of

    return world_of(system) == "ball"


def fork(
    system: str,
    vary: str | None,
    *,
    foreign: Mapping[str, bool],
    given: Mapping[str, bool],
    certify: bool,
    steps: int | None,
    split: float | None,
    repeats: int | None,
    counterfactual: bool,
    out: Path | None,
    overrides: Mapping[str, str],
    report: bool,
    as_json: bool,
) -> int:
    """Answer for a ball.

    Args:
        foreign: options of molecular dynamics, and whether they were given.
        given: all options, and whether they were given.
        certify: ask when runs leave the exact history instead.
    """
    for option, is_given in foreign.items():
        if is_given:
            from mdnum.workflow.fork_question import OF_A_BALL

            raise InputError(
                f"{option} is an option for molecular dynamics, and {system} is a ball",
                remedy=OF_A_BALL.get(option, "Leave it out"),
            )
    question = "--certify" if certify else "--vary all" if vary == "all" else "--vary"
    fork_options.check(f"{question} of a ball", given)
    if certify:
        return _certify(system, steps, overrides, as_json=as_json)
    from mdnum.workflow import fork as compare

    with watched() as progress:
        result = compare(
            system,
            vary,
            steps=steps,
            split=split,
            repeats=repeats,
            counterfactual=counterfactual,
            out=out,
            overrides=overrides,
            report=report,
            progress=progress,
        )
    return output.answer(result.folder, result.summary, print_rows, as_json=as_json)


def print_rows(summary: Mapping[str, Any]) -> None:
    """Dates, the decision at the fork and splits by run; or a ranking of choices."""
    if "ranking" in summary:
        print_ranking(summary)
        return
    out = output.console()
    for reason in summary.get("reasons") or ():
        out.print(f"  {reason}", markup=False)
    balls = summary["balls"]
    rows = [
        (
            "system",
            f"{summary['system']}, {balls:,} ball{'' if balls == 1 else 's'}, {summary['steps']:,} steps",
        ),
        ("differs in", summary["difference"]),
    ]
    for name, what in (
        ("seed", "first bit differs"),
        ("fork", "first decision differs"),
        ("split", f"heights further apart than {summary['tolerance']:.3g} m"),
    ):
        rows.append((name, _date(summary, name, what)))
    rows += list(_decision(summary.get("decision"), summary["counted"]))
    if summary.get("growth_rate") is not None:
        fits = f"r² {summary['r_squared']:.3f}" if summary.get("r_squared") is not None else ""
        rows.append(("growth", f"{summary['growth_rate']:.3g} a step, {fits}"))
    if summary.get("predicted_split") is not None:
        rows.append(("predicted split", f"about step {summary['predicted_split']:,}"))
    stops = summary["cross_stops"]
    also = f", {stops:,} numbers of {summary['counted']}" if stops else ""
    rows.append(("decisions that differ", f"{summary['cross_contacts']:,} contacts{also}"))
    output.print_table("", ("", ""), rows)
    print_two_by_two(summary)


def _date(summary: Mapping[str, Any], name: str, what: str) -> str:
    step = summary.get(name)
    if step is None:
        return f"none in {summary['steps']:,} steps ({what})"
    return f"step {step:,}, {summary[f'{name}_time']:.6g} s ({what})"


def _decision(made: Mapping[str, Any] | None, counted: str) -> Iterator[tuple[str, str]]:
    if made is None:
        return
    whose = "all balls" if made["ball"] is None else f"ball {made['ball']}"
    also = f", with {made['also']:,} more at this step" if made.get("also") else ""
    yield "decision", f"{_decided(made, counted)}, {whose}{also}"
    for name, margin in made["margins"].items():
        bound = made["bounds"][name]
        if margin is None:
            yield f"margin in {name}", "none on record"
            continue
        word = "ambiguous" if name in made["ambiguous_in"] else "not ambiguous"
        yield f"margin in {name}", f"{margin:.3g} in {made['space']}; rounding bound {bound:.3g}: {word}"
    if made.get("protected") is not None:
        yield (
            "apart the step before",
            f"{made['separation_before']:.3g} m; the margin is {made['protected']:.3g} of it",
        )


def _decided(made: Mapping[str, Any], counted: str) -> str:
    """What each run decided, in words."""
    a, b = (made["decided"][name] for name in "AB")
    if made["channel"] == "contact":
        return f"contact in {'A' if a else 'B'} only"
    return f"{a} {counted} in A, {b} in B"


def _certify(system: str, steps: int | None, overrides: Mapping[str, str], *, as_json: bool) -> int:
    """When runs in each precision leave the history in exact arithmetic."""
    from mdnum.workflow import fork_certify

    with watched() as progress:
        summary = fork_certify(system, steps=steps, overrides=overrides, progress=progress).summary
    if as_json:
        output.print_json(summary)
        return output.EXIT_FINE
    out = output.console()
    for sentence in summary["says"]:
        out.print(sentence, style="bold", markup=False)
    table = [
        (
            row["policy"],
            "" if row["why_not"] else _horizon(row, summary["steps"]),
            row["separation_end"],
            row["why_not"] or "",
        )
        for row in summary["ranking"]
    ]
    output.print_table("", ("precision", "leaves the exact history", "apart at the end, m", ""), table)
    return output.EXIT_FINE


def _horizon(row: Mapping[str, Any], steps: int) -> str:
    if row["horizon"] is None:
        return f"beyond step {steps:,}"
    return f"step {row['horizon']:,}, {row['channel']} of ball {row['ball']}"
