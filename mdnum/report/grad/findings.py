"""Verdict and findings on a gradient, from its folder alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, verdict
from mdnum.report.grad.words import apart, by, digits_note, digits_of, size, slope, slope_unit
from mdnum.report.verdict import Finding
from mdnum.report.words import count, heading, listed, many, number, percent

#: Share of a derivative above which single flips decide it, and how many of them count as single.
_HEAVY, _SINGLE = 0.2, 3
#: Share of the weight of all flips above which what the guard leaves out matters.
_LEFT_OUT = 0.01
#: What takes a gradient further, by what limits it.
_FURTHER = {
    "rounding": "or run in wider formats: --set precision.state=float64 and the like",
    "standard error": "or average over more starts with --replicas",
    "ambiguous decision": "or see with mdnum fork what the other decision would do",
    "time step": "or take a smaller time step, and see whether the digits settle",
    "near miss": "or take a smaller time step, average over starts with --replicas, or take a cutoff without "
    "a jump: --set cutoff.kind=switched",
    "flips left out": "or ask event-aware, or take a cutoff without a jump: --set cutoff.kind=switched",
}
#: Relative difference from a closed form within which a derivative is that of the exact motion.
_CLOSE = 0.01


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of a gradient."""
    found = list(_findings(run))
    known = run.summary.get("exact") or trust_of(run) == "trusted"
    return verdict(_headline(run), _evidence(run), found, plain_tone="good" if known else "info")


def trust_of(run: Question) -> str:
    """The verdict on trust; "" where nobody asked. A folder from before half the time step was looked at says
    nothing of it."""
    trust = run.summary.get("trust")
    if not trust:
        return ""
    return trust.get("verdict") or ("limited" if trust["limited_by"] else "undecided")


def _headline(run: Question) -> str:
    summary = run.summary
    reference = by(run, summary["reference"])
    parts = []
    for one in summary["parameters"][:3]:
        short = one["name"].rpartition(".")[2]
        value = f"{slope(summary, reference, one['name'], 4)} {slope_unit(summary, one)}".rstrip()
        note = digits_note(summary, one["name"])
        parts.append(f"d {summary['loss']['word']} / d {short} = {value}{f' ({note})' if note else ''}")
    trust = summary.get("trust")
    end = {
        "trusted": "; trusted",
        "limited": trust and f"; not trusted{_beyond(trust)}: {trust['limited_by']}",
        "undecided": "; whether to trust it is undecided",
    }.get(trust_of(run), "")
    if trust and any("other starts" in one for one in trust.get("unknown") or ()):
        end += ", other starts not known"
    return f"After {many(run.steps, 'step')}, {listed(parts)}{end}."


def _beyond(trust: Mapping[str, Any]) -> str:
    return f" beyond step {count(trust['horizon'])}" if trust["horizon"] else ""


def _evidence(run: Question) -> Iterator[str]:
    summary = run.summary
    reference = by(run, summary["reference"])
    if reference is not None:
        yield f"By {reference['method']}: {reference['says'].rstrip('.')}."
    if trust := summary.get("trust"):
        yield trust["says"]
    elif growth := summary.get("growth"):
        yield growth["says"]
    added = (summary.get("flips") or {}).get("share", {})
    told = [
        f"{percent(round(abs(parts['pair enters'] + parts['pair leaves']), 6))} of that by {name}"
        for name, parts in added.items()
        if None not in parts.values() and digits_of(summary, name.partition("[")[0]) != 0
    ]
    if told:
        yield f"Flips on the way make {listed(told)}."


def _findings(run: Question) -> Iterator[Finding]:
    yield from _not_finite(run)
    yield from _no_dependence(run)
    yield from _unexplained(run)
    yield from _plain_at_a_jump(run)
    yield from _loss_jumps(run)
    yield from _short(run)
    yield from _few_flips(run)
    yield from _departs(run)
    yield from _grazing(run)
    yield from _off_the_motion(run)
    yield from _refused(run)


def _unexplained(run: Question) -> Iterator[Finding]:
    """Methods that should agree and do not."""
    for row in run.summary["comparisons"]:
        if row["means"] == "unexplained":
            yield Finding(
                "UNEXPLAINED",
                "warning",
                f"{row['method']} and {row['reference']} differ by {row['name']}",
                f"They are {apart(row)}. {row['says']}",
                "Compare them at a shorter horizon, where less has grown.",
            )


def _plain_at_a_jump(run: Question) -> Iterator[Finding]:
    """Only methods that hold decisions fixed, where flips count."""
    summary = run.summary
    aware = {"event-aware", "smoothed-differences", "ensemble", "closed form"}
    # averages over states know no motion, and a switched twin has no jump
    without = {"boundary", "reweighting", "surrogate"}
    asked = {one["method"] for one in summary["methods"]}
    # differences decide anew at each shift: between shifts that flip nothing they are those of the steps
    without |= {"finite-differences", "shadow-differences"}
    methods = [one["method"] for one in summary["methods"] if one["method"] not in without]
    if summary.get("force_jump") and methods and not aware & {*asked, summary["reference"]}:
        jump = f"{number(summary['force_jump'])} {run.units.energy}/{run.units.length}"
        held = f"{listed(methods)} hold{'s' * (len(methods) == 1)} decisions fixed"
        yield Finding(
            "MISSING_SALTATION",
            "warning",
            "what the flips add is missing",
            f"The force jumps by {jump} at the cutoff, and {held}: the error does not shrink with the time "
            "step, and the derivative by the cutoff comes out as 0.",
            "Add event-aware to --methods, or take a cutoff without a jump: --set cutoff.kind=switched.",
        )


def _loss_jumps(run: Question) -> Iterator[Finding]:
    """A loss that itself jumps at a flip, in frames that no average is over."""
    if not any(one["details"].get("loss jumps") for one in run.summary["methods"]):
        return
    word = run.summary["loss"]["word"]
    yield Finding(
        "LOSS_JUMPS",
        "warning",
        f"the {word} itself jumps when a pair crosses its cutoff",
        "It is looked at in single frames: what a flip does to the motion is part of the gradient, and that "
        "it changes the loss at once has no slope.",
        "Average over frames, compare with --methods smoothed-differences, or take a cutoff without a jump: "
        "--set cutoff.kind=switched.",
    )


def _short(run: Question) -> Iterator[Finding]:
    """A gradient that is not trusted as far as it was asked for."""
    trust = run.summary.get("trust")
    judged = trust_of(run)
    if trust and judged == "limited":
        yield Finding(
            "BEYOND_TRUST",
            "warning",
            f"not trusted{_beyond(trust)}: {trust['limited_by']}",
            trust["says"],
            f"Ask for a shorter horizon, {_FURTHER[trust['limited_by']]}.",
        )
    elif trust and judged == "undecided":
        yield Finding(
            "UNDECIDED",
            "warning",
            "whether to trust it is undecided",
            trust["says"],
            _remedy(run, trust),
        )


def _remedy(run: Question, trust: Mapping[str, Any]) -> str:
    """What to do about each thing that was not looked at."""
    if "limits" not in trust or "verdict" not in trust:
        return "Ask again: this folder is from before half the time step was looked at."
    unseen = {one["what"] for one in trust["limits"] if one["horizon"] is None}
    steps = []
    if any(one["what"] == "half the time step" for one in run.summary["left_out"]):
        steps.append("leave out --no-half-step")
    elif "time step" in unseen:
        nve = "take the thermostat off with --set dynamics.kind=nve"
        steps.append(nve + ", or average over starts with --replicas 8" * (not _replicas(run)))
    if "near miss" in unseen and by(run, "event-aware") is None:
        steps.append("add event-aware to --methods")
    elif "near miss" in unseen and "time step" not in unseen:
        steps.append("ask by fewer parameters in --wrt")
    if any("other starts" in one for one in trust["unknown"]) and not any("--replicas" in s for s in steps):
        steps.append("look at other starts with --replicas 8")
    if any("too many entries" in one for one in trust["unknown"]):
        steps.append("name parameters of few entries alone in --wrt")
    return f"{heading('; '.join(steps))}." if steps else ""


def _few_flips(run: Question) -> Iterator[Finding]:
    """Derivatives that hang on a flip or two."""
    table = run.tables["flip_contributions"]
    for name, total in (run.summary.get("flips") or {}).get("total", {}).items():
        added = table.get(f"contribution.{name}")
        if added is None or not len(added) or not total:
            continue
        heavy = np.argsort(-np.abs(added))[:_SINGLE]
        heavy = heavy[np.abs(added[heavy]) > _HEAVY * abs(total)]
        if not len(heavy):
            continue
        first = heavy[0]
        none = digits_of(run.summary, name.partition("[")[0]) == 0
        pair = f"{table['i'][first]}–{table['j'][first]} at step {count(int(table['step'][first]))}"
        speed = number(abs(float(table["radial_speed"][first])), 2)
        crosses = f"the pair {pair}, which crosses with a radial speed of {speed}"
        how = (
            f"{many(len(heavy), 'flip')} add{'s' * (len(heavy) == 1)} more than {percent(_HEAVY)} of it each"
        )
        share = percent(abs(float(added[first]) / total))
        yield Finding(
            "FEW_FLIPS",
            "info",
            f"few flips decide the derivative by {name}",
            (
                f"No digit of it holds; the heaviest is {crosses}."
                if none
                else f"{how}: first {crosses} and adds {share}."
            )
            + " One run then says little of another.",
            "" if _replicas(run) else "Average over starts with --replicas.",
        )


def _replicas(run: Question) -> bool:
    """Whether other starts were followed."""
    return any(name.startswith("error.") for name in run.tables["trust"])


def _departs(run: Question) -> Iterator[Finding]:
    """Methods that differentiate a forward pass of their own, and where it leaves the run."""
    for one in run.summary["methods"]:
        primal = one["details"].get("primal") or {}
        if primal.get("first state") is None:
            continue
        decided = primal.get("first decision")
        yield Finding(
            "ANOTHER_PRIMAL",
            "info" if decided is None else "warning",
            f"{one['method']} differentiates a forward pass of its own",
            f"{primal['says'][:1].upper()}{primal['says'][1:].rstrip('.')}.",
            "" if decided is None else "Use symmetric or event-aware, which linearize at the run itself.",
        )


def _grazing(run: Question) -> Iterator[Finding]:
    """What the guard left out."""
    found = by(run, "event-aware")
    details = {} if found is None else found["details"]
    left, applied = details.get("weight left out"), details.get("weight applied")
    if left and applied is not None and left > _LEFT_OUT * (left + applied):
        yield Finding(
            "GRAZING",
            "warning",
            f"{many(details['grazing'], 'flip')} that graze{'s' * (details['grazing'] == 1)} left out",
            f"They would have had {percent(left / (left + applied))} of the weight of all flips: slower than "
            f"the guard, {number(details['guard'], 2)}, a crossing has no time that a derivative could move.",
            "Look at them in flip_contributions.parquet; average over starts with --replicas.",
        )


def _not_finite(run: Question) -> Iterator[Finding]:
    where = (run.summary.get("not_finite") or {}).get("says") or ""
    for one in run.summary["methods"]:
        broken = [name for name, value in one["gradient"].items() if not _finite(value)]
        if broken:
            yield Finding(
                "NOT_FINITE",
                "error",
                f"{one['method']} is not finite by {listed(broken)}",
                where or "Somewhere on the way a number overflowed or was divided by zero.",
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
        # what the reference says first: it leaves nothing out
        ranked = sorted(run.summary["methods"], key=lambda one: one["method"] != run.summary["reference"])
        notes = [method["notes"].get(name) for method in ranked]
        yield Finding(
            "NO_DEPENDENCE",
            "warning",
            f"no method finds a dependence on {name}",
            f"By {name}: {next(filter(None, notes), 'exactly 0, nothing that ran used it')}.",
            "Look at another loss, or run longer.",
        )


def _off_the_motion(run: Question) -> Iterator[Finding]:
    """Methods that do not give the derivative of the exact motion, where that is known."""
    if not run.summary.get("exact"):
        return
    off = [row for row in run.summary["comparisons"] if row["relative"] is None or row["relative"] > _CLOSE]
    if not off:
        return
    aware = [row for row in off if row["method"] == "event-aware"]
    methods = list(dict.fromkeys(row["method"] for row in off))
    each = {
        method: ", ".join(f"{row['name']} {apart(row)}" for row in off if row["method"] == method)
        for method in methods
    }
    told = listed([f"{method} ({rows})" for method, rows in each.items()])
    impact = run.summary["contact_kind"] == "impact" and run.summary["integrator"] != "event-located"
    located = ", or locate the impacts: --set integrator.kind=event-located" if impact else ""
    yield Finding(
        "NOT_THE_MOTION",
        "warning" if aware else "info",
        f"{many(len(methods), 'method')} not within {100 * _CLOSE:g} % of the exact motion",
        f"{told[:1].upper()}{told[1:]}. "
        + ("Event-aware among them: the steps themselves do not follow the motion." if aware else
           "They are derivatives of something else, and say of what."),
        f"Use a smaller time step{located}." if aware else "",
    )  # fmt: skip


def _refused(run: Question) -> Iterator[Finding]:
    refused: list[Mapping[str, Any]] = run.summary["refused"]
    if refused:
        yield Finding(
            "DOES_NOT_APPLY",
            "info",
            f"{many(len(refused), 'method')} gave no gradient",
            " ".join(f"{one['method']}: {one['why'].rstrip('.')}." for one in refused),
        )
