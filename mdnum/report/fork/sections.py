"""What the page of a comparison says beside its figures, as text: a function per section."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.fork import findings
from mdnum.report.fork.run import ForkFolder
from mdnum.report.words import count, listed, many, number, plain


def decision(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(what, words) of the decision at the fork."""
    made, length = run.decision, run.units.length
    if made is None:
        return
    space = {"r2": "r²", "r": "r"}.get(str(made.get("space")), "")
    where = "differs from the start on" if made["run"] == "start" else f"flips in run {made['run']} alone"
    way = (
        ""
        if made["run"] == "start"
        else ", entering its cutoff"
        if made["entered"]
        else ", leaving its cutoff"
    )
    yield "Pair", f"{made['i']}–{made['j']} {where}{way}"
    also = made.get("also")
    when = f"{count(made['step'])}, {plain(made['step'] * run.summary['timestep'], 6)} {run.units.time}"
    yield "Step", when + (f"; {many(also, 'more pair')} at the same step" if also else "")
    cutoffs = made["cutoffs"]
    own = cutoffs["B" if made["run"] == "B" else "A"]
    yield "Distance", f"{number(made['distance'], 11)} {length}, cutoff {number(own, 11)} {length}"
    if cutoffs["A"] != cutoffs["B"]:
        off = number(cutoffs["B"] - cutoffs["A"], 3, signed=True)
        yield "Cutoff", f"not the same number in both runs: B’s is {off} {length} off A’s"
    slope = made["margin"] / made["margin_length"] if made["margin_length"] else 1.0
    for name, margin in (made.get("margins") or {made["run"]: made["margin"]}).items():
        bound = (made.get("bounds") or {}).get(name, made["bound"])
        doubtful = abs(margin) <= bound
        ratio = f"{number(abs(margin) / bound, 3)} times the bound" if bound else "no rounding"
        word = (
            "ambiguous: rounding alone could have decided otherwise"
            if doubtful
            else f"{ratio}, not ambiguous"
        )
        yield (
            f"Margin in {name}",
            f"{number(margin, 3, signed=True)} in {space} "
            f"({number(margin / slope, 3, signed=True)} {length}), "
            f"rounding bound {number(bound, 3)}: {word}",
        )
    before = made.get("separation_before")
    if made.get("protected") is not None:
        protects = (
            "the margin no longer protected it" if made["protected"] < 2 else "the margin still protected it"
        )
        yield (
            "Separation the step before",
            f"{number(before, 3)} {length}; the margin is {number(made['protected'], 3)} of it: {protects}",
        )
    else:
        yield "Separation the step before", "none: the same bits up to there"


def runs(run: ForkFolder) -> Iterator[dict[str, str]]:
    """A row per run: whose arithmetic, whose decisions, and when it splits from A and from B."""
    cells = run.summary.get("table") or ()
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for cell in cells:
        rows.setdefault((cell["arithmetic"], cell["decisions"]), {})[cell["from"]] = _cell(cell)
    if len(rows) < 3 or all(cell["split"] is None for cell in cells):
        return
    for (arithmetic, decisions), texts in rows.items():
        whose = "its own" if arithmetic == decisions else f"{decisions}’s"
        yield {"arithmetic": arithmetic, "decisions": whose, **{name: texts.get(name, "") for name in "AB"}}
    for decisions, text in repeated(run.summary):
        whose = "its own" if decisions == "B" else "A’s"
        yield {"arithmetic": "B, start perturbed", "decisions": whose, "A": text, "B": ""}


def repeated(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Between which steps repeats split under B's decisions, which are their own, and under A's."""
    found = summary.get("repeated") or ()
    for decisions, name in (("B", "free"), ("A", "handed")):
        seen = [one[name] for one in found if one[name] is not None]
        late = len(found) - len(seen)
        text = f"{count(min(seen))} to {count(max(seen))}" if seen else ""
        if late:
            text += f"{'; ' if seen else ''}{late} of {len(found)} not seen to"
        if found:
            yield decisions, text


def _cell(cell: Mapping[str, Any]) -> str:
    if cell["same"]:
        return f"is {cell['from']}"
    return f"> {count(cell['until'])}" if cell["split"] is None else count(cell["split"])


def shares(run: ForkFolder) -> list[dict[str, Any]]:
    """What decisions and arithmetic contributed: a row each, lines of text as seen from A and from B."""
    rows: dict[str, dict[str, list[str]]] = {}
    for share in run.summary.get("shares") or ():
        more = "> " if share["at_least"] else ""
        lines = [f"{more}{count(share['steps'])} {'step' if abs(share['steps']) == 1 else 'steps'}"]
        if share["nats"] is not None:
            lines.append(f"{more}{number(share['nats'], 3)} e-foldings")
        rows.setdefault(share["what"], {})[share["reference"]] = lines
    return [{"what": what, **{name: texts.get(name, ["–"]) for name in "AB"}} for what, texts in rows.items()]


def certain(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(what, words): how far the decisions are certain."""
    summary = run.summary
    for name, step in (summary.get("certified_horizon") or {}).items():
        doubtful, steps = summary["ambiguous"][name], summary["ambiguous_steps"][name]
        first = (summary.get("ambiguous_first") or {}).get(name)
        until = f"up to step {count(step)}" if step >= 0 else "not even at the start"
        text = f"{until}: no decision is ambiguous"
        if doubtful:
            after = "after it " if step >= 0 else ""
            text = f"{until}; {after}{many(doubtful, 'ambiguous decision')} at {many(steps, 'step')}"
        if first is not None:
            near = number(first["margin"], 2, signed=True)
            text += (
                f", first pair {first['i']}–{first['j']}: margin {near}, bound {number(first['bound'], 2)}"
            )
        if not summary["lists_complete"][name]:
            text += "; of listed pairs only: this rule of rebuilds may miss some"
        yield f"Certified, {name}", text
    until = summary.get("protected_until")
    if until is not None:
        text = "then a pair was closer to its cutoff than twice the separation of the runs"
        ended = until >= run.steps
        yield (
            "Protected",
            f"up to step {count(until)}, the last one"
            if ended
            else f"up to step {count(until)}; {text}"
            if until >= 0
            else f"not from the start; {text}",
        )
    if summary.get("shadow"):
        wide = summary["shadow"]
        other = "B" if wide == "A" else "A"
        yield (
            "Shadow horizon",
            f"step {count(summary['shadow_horizon'])}: up to there {other} decides as {wide}, "
            "which is as wide or wider in every role",
        )


def pinned(run: ForkFolder) -> str | None:
    """What became of B with a decision taken back, in a sentence."""
    found = run.summary.get("pinned")
    if found is None:
        return None
    if found["pairs"] is None:
        return f"No decision could be taken back: {found['reason']}."
    names = listed([f"{i}–{j}" for i, j in found["pairs"]])
    steps = (
        f"step {count(found['first'])}"
        if found["first"] == found["last"]
        else f"steps {count(found['first'])} to {count(found['last'])}"
    )
    then = (
        f"does not split from A by step {count(found['until'])}: they are {number(found['largest'], 2)} "
        f"{run.units.length} apart at most"
        if found["split"] is None
        else f"splits from A at step {count(found['split'])}"
    )
    free = "without, they do not split" if found["free"] is None else f"without, at {count(found['free'])}"
    return f"Told what A decided about {names} at {steps} and nothing else, B {then}; {free}."


def minimal(run: ForkFolder) -> dict[str, Any] | None:
    """The minimal cause: words, and a row for each pair."""
    found = run.summary.get("minimal")
    if found is None:
        return None
    tests = (
        f" {many(found['tests'], 'run')} of B told, {many(found['candidates'], 'pair')} that differ before "
        f"the split; together means up to step {count(found['horizon'])}."
        if found["tests"]
        else ""
    )
    rows = []
    for pair in found["pairs"] or ():
        spells = [_spell(first, end) for first, end in pair["differs"][:3]]
        more = len(pair["differs"]) - len(spells)
        rows.append(
            {
                "pair": f"{pair['i']}–{pair['j']}",
                "differs": ", ".join(spells) + (f", and {many(more, 'time')} more" if more else ""),
            }
        )
    text = findings.sentence(found["reason"])
    return {"none": found["pairs"] is None, "text": text + tests, "rows": rows}


def _spell(first: int, end: int | None) -> str:
    if end is None:
        return f"from {count(first)} on"
    return count(first) if end == first + 1 else f"{count(first)} to {count(end - 1)}"


def growth(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(which, words) of the fits."""
    names = {"B": "A and B, free", "B|A": "Under A’s decisions"}
    for name, fit in (run.summary.get("growth") or {}).items():
        if fit.get("rate") is None:
            yield names.get(str(name), str(name)), "too few rows between rounding and saturation for a fit"
            continue
        rate = fit["rate"]
        poor = fit["r_squared"] < findings.FITS
        text = ("No single exponential: " if poor else "") + (
            f"{number(rate, 3)} a step, {number(rate / run.summary['timestep'], 3)} per {run.units.time}, "
            f"fitted to steps {count(fit['first'])} to {count(fit['last'])}, r² {number(fit['r_squared'], 3)}"
        )
        if rate > 0 and not poor:
            text += f"; doubles in {number(np.log(2) / rate, 3)} steps"
        yield names.get(str(name), str(name)), text
    yield from _exponent(run)


def _exponent(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """The Lyapunov exponent, how the growth compares with it, and when an ulp has grown up."""
    found, reason = run.summary.get("lyapunov"), run.summary.get("lyapunov_reason")
    if found is None:
        if reason:
            yield "Lyapunov exponent", f"none: {reason}"
        return
    text = (
        f"{number(found['rate'], 3)} ± {number(found['error'], 1)} a step, {number(found['rate_time'], 3)} "
        f"per {run.units.time}: a tangent along {many(found['steps'], 'step')} of A"
    )
    if found.get("ratio") is not None:
        text += f"; the runs part {number(found['ratio'], 3)} times as fast"
    yield "Lyapunov exponent", text + (f"; {reason}" if reason else "")
    if found.get("ulp_split") is not None:
        yield (
            "An ulp of the start",
            f"{number(found['ulp'], 2)} {run.units.length} reaches the split tolerance about step "
            f"{count(found['ulp_split'])}",
        )
