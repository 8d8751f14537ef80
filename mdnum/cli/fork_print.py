"""A fork folder in the terminal: dates, the deciding pair, splits by run; or a ranking of choices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mdnum.cli import output


def print_rows(summary: Mapping[str, Any]) -> None:
    """What a fork folder says below its headline: one pair of runs, or the ranking of a screening."""
    if "ranking" in summary:
        print_ranking(summary)
    else:
        _print_pair(summary)


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
        by = {"exponent": ", at the Lyapunov exponent", "growth": ", as they part so far"}
        how = by.get(str(summary.get("predicted_by")), "")
        rows.append(("predicted split", f"about step {summary['predicted_split']:,}{how}"))
    rows += list(_exponent(summary))
    rows.append(("flips in one run only", f"{summary['cross_flips']:,}"))
    rows += list(_pinned(summary.get("pinned")))
    rows += list(_certain(summary))
    output.print_table("", ("", ""), rows)
    print_two_by_two(summary)
    _print_minimal(summary.get("minimal"))


def _exponent(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The Lyapunov exponent beside the growth, or why there is none."""
    found, reason = summary.get("lyapunov"), summary.get("lyapunov_reason")
    if found is None:
        if reason and reason != "not asked for":
            yield "Lyapunov exponent", f"none: {reason}"
        return
    text = (
        f"{found['rate']:.3g} ± {found['error']:.1g} a step, {found['rate_time']:.3g} a unit of time, "
        f"from {found['steps']:,} steps of A"
    )
    if found.get("ratio") is not None:
        text += f"; the runs part {found['ratio']:.3g} times as fast"
    yield "Lyapunov exponent", text
    if reason:
        yield "", reason
    if found.get("ulp_split") is not None:
        yield "an ulp of the start", f"({found['ulp']:.2g}) splits them about step {found['ulp_split']:,}"


def _certain(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """How far the decisions are certain."""
    for name, step in (summary.get("certified_horizon") or {}).items():
        doubtful, steps = summary["ambiguous"][name], summary["ambiguous_steps"][name]
        until = f"up to step {step:,}" if step >= 0 else "not even at the start"
        text = f"{until}: no decision is ambiguous"
        if doubtful:
            after = " after it" if step >= 0 else ""
            text = f"{until}; {_many(doubtful, 'ambiguous decision')} at {_many(steps, 'step')}{after}"
        if not summary["lists_complete"][name]:
            text += "; of listed pairs only, a rule of rebuilds that is not safe may miss some"
        yield f"certified in {name}", text
    until = summary.get("protected_until")
    if until is not None:
        text = "every pair is further from its cutoff than twice the separation"
        yield "protected", f"up to step {until:,}: {text}" if until >= 0 else "not even at the start"
    if summary.get("shadow"):
        wide = summary["shadow"]
        other = "B" if wide == "A" else "A"
        step = summary["shadow_horizon"]
        yield "shadow horizon", f"step {step:,}: {other} decides as the wider program, {wide}, up to there"


def print_two_by_two(summary: Mapping[str, Any]) -> None:
    """Splits by arithmetic and decisions, from either run, and what each of the two contributed."""
    from mdnum.report.fork.sections import repeated

    cells = summary.get("table") or ()
    runs = {(cell["arithmetic"], cell["decisions"]) for cell in cells}
    if len(runs) < 3 or all(cell["split"] is None for cell in cells):
        return
    by_run: dict[tuple[str, str], dict[str, str]] = {}
    for cell in cells:
        by_run.setdefault((cell["arithmetic"], cell["decisions"]), {})[cell["from"]] = _cell(cell)
    lines = [
        (
            arithmetic,
            "its own" if arithmetic == decisions else f"{decisions}'s",
            *(texts.get(k, "") for k in "AB"),
        )
        for (arithmetic, decisions), texts in by_run.items()
    ]
    lines += [
        ("B, start perturbed", "its own" if decisions == "B" else f"{decisions}'s", text, "")
        for decisions, text in repeated(summary)
    ]
    output.print_table(
        "splits, either arithmetic under either decisions",
        ("arithmetic", "decisions", "from A", "from B"),
        lines,
    )
    worth: dict[str, dict[str, str]] = {}
    for share in summary.get("shares") or ():
        worth.setdefault(share["what"], {})[share["reference"]] = share_words(share)
    if worth:
        output.print_table(
            "without the difference in ... the runs split so much later",
            ("", "from A", "from B"),
            [(what, *(texts.get(k, "") for k in "AB")) for what, texts in worth.items()],
        )


def _cell(cell: Mapping[str, Any]) -> str:
    if cell["same"]:
        return f"is {cell['from']}"
    return f"> {cell['until']:,}" if cell["split"] is None else f"{cell['split']:,}"


def share_words(share: Mapping[str, Any]) -> str:
    """Steps and e-foldings of a share; a lower bound has its sign."""
    more = "> " if share["at_least"] else ""
    text = f"{more}{share['steps']:,} steps"
    return text if share["nats"] is None else f"{text}, {more}{share['nats']:.3g} e-foldings"


def _pinned(found: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    """What became of B with a decision taken back."""
    if found is None:
        return
    if found["pairs"] is None:
        yield "taken back", f"nothing: {found['reason']}"
        return
    names = ", ".join(f"{i}–{j}" for i, j in found["pairs"])
    steps = (
        f"step {found['first']:,}"
        if found["first"] == found["last"]
        else (f"steps {found['first']:,} to {found['last']:,}")
    )
    then = (
        f"no split by step {found['until']:,}, {found['largest']:.2g} apart at most"
        if found["split"] is None
        else f"splits at step {found['split']:,}"
    )
    yield "taken back", f"{names} as A decided it at {steps}: {then} (free: {_split(found['free'])})"


def _print_minimal(found: Mapping[str, Any] | None) -> None:
    """The fewest pairs whose decisions, taken back up to a horizon, keep the runs together."""
    if found is None:
        return
    runs = (
        f" ({_many(found['tests'], 'run')}, {_many(found['candidates'], 'candidate')})"
        if found["tests"]
        else ""
    )
    if found["pairs"] is None:
        output.console().print(f"minimal cause: none; {found['reason']}{runs}", markup=False)
        return
    lines = []
    for pair in found["pairs"]:
        spell = _spell(*pair["differs"][0]) if pair["differs"] else ""
        more = len(pair["differs"]) - 1
        again = f", and {_many(more, 'time')} more" if more > 0 else ""
        lines.append((f"{pair['i']}–{pair['j']}", spell + again))
    output.print_table(f"minimal cause: {found['reason']}{runs}", ("pair", "decided differently"), lines)


def _date(summary: Mapping[str, Any], name: str, what: str) -> str:
    step = summary.get(name)
    if step is None:
        return f"none in {summary['steps']:,} steps ({what})"
    return f"step {step:,}, time {summary[f'{name}_time']:.6g} ({what})"


def _spell(first: int, end: int | None) -> str:
    if end is None:
        return f"from step {first:,} on"
    return f"step {first:,}" if end == first + 1 else f"steps {first:,} to {end - 1:,}"


def _many(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


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


def print_ranking(summary: Mapping[str, Any]) -> None:
    """Print the choices of a screening, the earliest fork first."""
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
