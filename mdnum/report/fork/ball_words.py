"""What the page of two rollouts of a ball says: its verdict in words, its findings, and its tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mdnum.report.fork import findings
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.run import ForkFolder
from mdnum.report.verdict import Finding, restore
from mdnum.report.words import count, listed, many, number, plain, typeset

#: Codes that are decided anew each time.
CODES = frozenset({
    "MUST_HOLD_FORKED", "RUN_FAILED", "AMBIGUOUS_FORK", "HORIZON_SHORT", "GUARD", "UNDECIDED",
})  # fmt: skip
_ORDER = ("error", "warning", "info")


def judge(run: ForkFolder) -> Verdict:
    """Headline, evidence and findings of two rollouts; findings that others left are kept."""
    found = list(_findings(run))
    found += [restore(kept) for kept in run.summary.get("findings") or () if kept.get("code") not in CODES]
    found.sort(key=lambda finding: _ORDER.index(finding.severity))
    worst = found[0].severity if found else "info"
    tone: Any = worst if worst != "info" else "info" if "fork" in run.dates else "good"
    return Verdict(tone, headline(run), tuple(_evidence(run)), tuple(found))


def headline(run: ForkFolder) -> str:
    """The verdict in one sentence."""
    summary, dates, steps = run.summary, run.dates, many(run.steps, "step")
    made = run.decision
    if failed := summary.get("failed"):
        if len(failed) > 1:
            return f"Both runs ended in a blow-up after step {count(run.steps)}."
        ((name, word),) = failed.items()
        ended = f"Run {name} ended in a {word} after step {count(run.steps)} and the other run did not"
        return (
            f"{ended}; they fork at step {count(dates['fork'])}." if made else f"{ended}: that is the fork."
        )
    if run.word == "same" and made is not None:
        return (
            f"No bit of a height or a velocity differs in {steps}, though a decision does at step "
            f"{count(made['step'])}: {decided(run)}."
        )
    if run.word == "same":
        return f"The same trajectory: no bit differs in {steps}."
    if made is None:
        if "split" in dates:
            return f"The runs split at step {count(dates['split'])} without a single decision that differs."
        return f"No fork: bits differ from step {count(dates['seed'])} on, but no decision does in {steps}."
    what, at, split = _what_forks(made), count(made["step"]), count(dates.get("split"))
    if run.word == "cause":
        return (
            f"The {what} at step {at} is the cause: free, the runs split at step {split}; "
            f"under A’s decisions they stay together{findings.followed(run)}."
        )
    if run.word == "accelerated":
        return f"The decisions accelerated the split: {findings.compared(run)}."
    if run.word == "undecided":
        return f"What the decisions did to the split is undecided: {findings.compared(run)}."
    if run.word == "bystander":
        return f"The {what} at step {at} is a bystander: {findings.bystander(run)}."
    if "split" in dates:
        return f"The runs fork at step {at} and split at step {split}; what the decisions did to it is open."
    return f"The runs fork at step {at} and have not split after {steps}."


def _what_forks(made: Mapping[str, Any]) -> str:
    whose = "" if made["ball"] is None else f" of ball {count(made['ball'])}"
    return f"contact{whose}" if made["channel"] == "contact" else f"stop of the solver{whose}"


def _evidence(run: ForkFolder) -> Iterator[str]:
    reasons = [str(reason) for reason in run.summary.get("reasons") or ()]
    told = "; ".join(reasons).replace("; and ", ", and ").replace("the first run's", "A’s")
    if told:
        yield f"{typeset(told[:1].upper() + told[1:])}."
    made = run.decision
    if made is None:
        return
    where = made["ambiguous_in"]
    doubt = (
        f"in {'either run' if len(where) > 1 else f'run {where[0]}'} rounding alone could have decided "
        "otherwise"
        if where
        else "in neither run could rounding alone have decided otherwise"
    )
    yield f"At step {count(made['step'])} {decided(run)}; {doubt}."
    if made.get("protected") is not None:
        yield (
            f"The step before, the heights were {number(made['separation_before'], 2)} m apart: the margin "
            f"is {number(made['protected'], 2)} of that."
        )


def decided(run: ForkFolder) -> str:
    """What each run decided at the fork."""
    made = run.decision or {}
    a, b = (made["decided"][name] for name in "AB")
    if made["channel"] == "contact":
        return (
            f"ball {count(made['ball'])} is in contact in {'A' if a else 'B'} and not in {'B' if a else 'A'}"
        )
    whose = "the solver" if made["ball"] is None else f"the solver of ball {count(made['ball'])}"
    if run.summary.get("counted") == "impacts":
        return f"ball {count(made['ball'])} has {many(a, 'impact')} inside the step in A and {count(b)} in B"
    return f"{whose} makes {many(a, 'iteration')} in A and {count(b)} in B"


def _findings(run: ForkFolder) -> Iterator[Finding]:
    summary, dates, made = run.summary, run.dates, run.decision
    if summary.get("must_hold") and "seed" in dates:
        what = (
            f"forks at step {count(dates['fork'])}"
            if "fork" in dates
            else f"differs from step {count(dates['seed'])} on"
        )
        yield Finding(
            "MUST_HOLD_FORKED",
            "error",
            f"{summary['choice']} must not change a bit, and {what}",
            f"This choice ({summary.get('difference')}) is one that arithmetic cannot notice by design: a "
            "promise is broken.",
            "Report it with this folder.",
        )
    for name, word in (summary.get("failed") or {}).items():
        yield Finding(
            "RUN_FAILED",
            "warning",
            f"run {name} ended in a {word} after step {count(run.steps)}",
            f"The comparison ends there, {count(summary.get('steps_asked'))} steps were asked for.",
            "Use a smaller time step, or another precision.",
        )
    if made is not None and made["ambiguous_in"]:
        sizes = [
            f"{number(abs(made['margins'][name]), 2)} of {number(made['bounds'][name], 2)} in {name}"
            for name in made["ambiguous_in"]
        ]
        yield Finding(
            "AMBIGUOUS_FORK",
            "info",
            f"the decision at the fork is ambiguous: the {_what_forks(made)}",
            f"Its margin is within the rounding bound of what was compared: {listed(sizes)}.",
        )
    if run.word == "open" and "split" not in dates and not summary.get("failed"):
        guess = summary.get("predicted_split")
        yield Finding(
            "HORIZON_SHORT",
            "info",
            "the horizon is too short for a split",
            f"After {many(run.steps, 'step')} the heights are {number(summary.get('separation_end'), 3)} m "
            f"apart, the tolerance is {number(summary.get('tolerance'), 3)} m.",
            f"Follow more than {count(guess)} steps." if guess else "Follow more steps, or set --split.",
        )
    until = summary.get("handed_until")
    if until is not None and until < run.steps and not summary.get("failed"):
        yield Finding(
            "GUARD",
            "info",
            f"the run under A’s decisions was ended at step {count(until)}",
            "A contact that it was told was no longer near the floor in its own heights: nothing that "
            "rounding could have changed.",
        )
    yield from findings.unclear(run)


# --- tables -------------------------------------------------------------------------------------------


def key_figures(run: ForkFolder) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the figure."""
    summary = run.summary
    for name, what in (
        ("seed", "bits differ"),
        ("fork", "a decision differs"),
        ("split", "beyond tolerance"),
    ):
        at = summary.get(name)
        small = f"{what}, {plain(summary.get(f'{name}_time'), 6)} s" if at is not None else "not by the end"
        yield name.capitalize(), "–" if at is None else f"step {count(at)}", small
    yield "Apart at the end", number(summary.get("separation_end"), 3), "m"
    handed = summary.get("handed_largest")
    yield "Under A’s decisions", number(handed, 3), "m at most" if handed is not None else "was not run"
    stops = summary.get("cross_stops")
    yield (
        "Decisions that differ",
        count(summary.get("cross_flips")),
        f"{count(stops)} of them numbers of {summary.get('counted')}",
    )


def decision(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(what, words) of the decision at the fork."""
    made = run.decision
    if made is None:
        return
    text = decided(run)
    yield "Decision", text[:1].upper() + text[1:]
    when = f"{count(made['step'])}, {plain(made['step'] * run.summary['timestep'], 6)} s"
    also = made.get("also")
    yield "Step", when + (f"; {many(also, 'more decision')} at the same step" if also else "")
    for name, margin in made["margins"].items():
        bound = made["bounds"][name]
        if margin is None:
            yield f"Margin in {name}", "none on record: this run made no decision there"
            continue
        word = (
            "ambiguous: rounding alone could have decided otherwise"
            if name in made["ambiguous_in"]
            else f"{number(abs(margin) / bound, 3)} times the bound, not ambiguous"
            if bound
            else "nothing was rounded"
        )
        what = "minus the height" if made["channel"] == "contact" else "tolerance minus residual"
        yield (
            f"Margin in {name}",
            f"{number(margin, 3, signed=True)} ({what}), rounding bound {number(bound, 3)}: {word}",
        )
    if made.get("protected") is None:
        yield "Separation the step before", "none: the same bits up to there"
    else:
        protects = "no longer" if made["protected"] < 1 else "still"
        yield (
            "Separation the step before",
            f"{number(made['separation_before'], 3)} m; the margin is {number(made['protected'], 3)} of it: "
            f"it {protects} protected the decision",
        )


def what(run: ForkFolder) -> Iterator[tuple[str, str]]:
    """(what, words) for the table of the comparison."""
    summary = run.summary
    if summary.get("about"):
        yield "System", str(summary["about"])
    size = f"{many(summary.get('balls'), 'ball')}, {many(run.steps, 'step')}"
    size += f" of {plain(summary.get('timestep'))} s"
    yield "Size", f"{size}, {summary.get('contact_kind')} contact, {summary.get('integrator')}"
    if run.screened:
        return
    about = summary.get("choice_about")
    yield "Choice", f"{summary.get('choice')}{f': {about}' if about else ''}"
    yield "A and B differ in", str(summary.get("difference"))
    if summary.get("must_hold"):
        yield "Must hold", "by design this choice cannot change a bit; a difference is a finding"
    yield "Split", f"when heights are further apart than {number(summary.get('tolerance'), 3)} m"
    if summary.get("handed_until") is None:
        yield "Counterfactual", "none was run: nothing is said about the cause"
    if (chance := findings.chance(run)) is not None:
        yield "Chance", chance
    yield "Took", f"{number(summary.get('seconds'), 2)} s"


def changes(run: ForkFolder) -> list[tuple[str, str]]:
    """Keys of the system file that differ, with both values."""
    given = run.summary.get("changes") or {}
    return [(key, f"{_value(a)} in A, {_value(b)} in B") for key, (a, b) in given.items()]


def _value(value: Any) -> str:
    return repr(value) if isinstance(value, float) else "none" if value is None else str(value)
