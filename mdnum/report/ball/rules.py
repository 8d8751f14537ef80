"""One rule per thing that can be wrong with a run of the ball, or that one should know about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.ball.run import BallFolder
from mdnum.report.verdict import Finding
from mdnum.report.words import count, listed, many, number

#: Relative difference from which on two derivatives are told to disagree.
DISAGREE = 0.01
#: Variants that a finding tells one by one.
_TOLD = 4

Rule = Callable[[BallFolder], Iterator[Finding]]


def differs(first: float | None, second: float | None) -> bool:
    """Whether two derivatives differ by more than `DISAGREE` of the larger; missing ones differ."""
    if first is None or second is None:
        return first is not second
    return abs(first - second) > DISAGREE * max(abs(first), abs(second))


def accounted(run: BallFolder) -> str | None:
    """What is wrong between the steps' counts and the table of contacts, None if nothing is."""
    series, contacts = run.series, run.contacts
    change = series["entered"].astype(np.int64) - series["left"].astype(np.int64)
    wrong = series["contacts"] != series["contacts"][0] + np.cumsum(change) - change[0]
    if wrong.any():
        return f"Balls in contact are not those at the start + entered − left at {_step(run, wrong)}."
    flips = int(series["entered"].sum(dtype=np.int64) + series["left"].sum(dtype=np.int64))
    if flips != run.rows["contacts"]:
        return f"The steps count {many(flips, 'flip')}; the table has {count(run.rows['contacts'])}."
    order = np.lexsort((contacts["step"], contacts["ball"]))
    ball, entered = contacts["ball"][order], contacts["entered"][order].astype(bool)
    if len(ball) == flips and np.any((ball[1:] == ball[:-1]) & (entered[1:] == entered[:-1])):
        return "A ball begins or ends its contact twice in a row."
    return None


def _status(run: BallFolder) -> Iterator[Finding]:
    status, broken = run.summary.get("status"), run.summary.get("not_finite")
    if broken is None and run.ended.get("not finite"):
        broken = _first(run, "not finite")
    if broken is not None or status == "failed":
        at = f" at step {count(broken)}" if broken is not None else ""
        text = run.summary.get("error") or "Everything after it is without meaning, the gradient too."
        remedy = "Shorten integrator.timestep, or soften the contact: see h √k in the stability map."
        yield Finding("NOT_FINITE", "error", f"the state stops being finite{at}", str(text), remedy)
    elif status != "complete":
        text = "It was stopped or killed; what is here is complete as far as it goes."
        title = f"the run ended early, after {many(run.steps, 'step')}"
        yield Finding("NOT_FINISHED", "info", title, text, "Run again.")


def _ledger(run: BallFolder) -> Iterator[Finding]:
    if wrong := accounted(run):
        remedy = "A flip was not recorded: the ledger cannot be used. Please report it."
        yield Finding("LEDGER_INCOMPLETE", "error", "contacts and flips disagree", wrong, remedy)


def _cap(run: BallFolder) -> Iterator[Finding]:
    capped = run.ended.get("cap", 0)
    if not capped:
        return
    stop = run.system.get("stop") or {}
    text = (
        f"{count(capped)} of {many(sum(run.ended.values()), 'solve')} ended at the cap of iterations"
        + (f" ({stop['max_iter']})" if "max_iter" in stop else "")
        + f", first at step {count(_first(run, 'cap'))}: the residual was not below its tolerance, and the "
        "step went on with what there was. The cap, not the tolerance, is part of this program."
    )
    remedy = "Raise stop.max_iter, loosen stop.tol, or choose alpha · k nearer to 1."
    yield Finding("SOLVER_CAP", "warning", f"the solver gave up {_times(capped)}", text, remedy)


def _ambiguous(run: BallFolder) -> Iterator[Finding]:
    summary = run.summary
    contacts = summary.get("ambiguous_contacts")
    if contacts is None:
        contacts = int(np.count_nonzero(run.contacts["ambiguous"]))
    stops = summary.get("ambiguous_stops")
    if stops is None:
        stops = max(0, int(summary.get("ambiguous") or run.series["ambiguous"].sum()) - contacts)
    if contacts:
        text = (
            f"{many(contacts, 'contact decision')} came out as {_they(contacts)} did by rounding: the "
            "height was within the bound of its rounding error. Another order of operations, compiler or "
            "machine may decide otherwise, and follow another program from there."
        )
        title = f"{many(contacts, 'contact decision')} within rounding"
        yield Finding(
            "AMBIGUOUS_CONTACTS", "warning", title, text, "Move the start or the time step a little."
        )
    if stops:
        text = (
            f"{many(stops, 'stop decision')} came out as {_they(stops)} did by the rounding of the "
            "residual’s sum. Another order of its terms, or a wider accumulator, may iterate once more or "
            "once less: another program, with another gradient."
        )
        remedy = (
            "Accumulate the residual in a wider format (precision.decision), sum it exactly "
            "(precision.reduction), stop per ball, or move stop.tol off the sum."
        )
        title = f"{many(stops, 'stop decision')} within rounding of the tolerance"
        yield Finding("AMBIGUOUS_STOPS", "warning", title, text, remedy)


def _independent(run: BallFolder) -> Iterator[Finding]:
    own = {f"by {made['method']}": _unused(made) for made in run.gradient}
    theirs = {f"in variant {variant['name']}": _unused(variant) for variant in run.variants}
    unused = {place: names for place, names in (own | theirs).items() if names}
    if unused:
        groups: dict[tuple[str, ...], list[str]] = {}
        for place, names in unused.items():
            groups.setdefault(tuple(names), []).append(place)
        told = "; ".join(f"along {listed(names)} {listed(places)}" for names, places in groups.items())
        text = f"The derivative is exactly zero {told}. That is not a minimum: "
        parts = []
        if any(place != "by implicit" for place in unused):
            parts.append(
                "no operation that ran carries the parameter to the loss, because the branch in which it "
                "acts was not taken, as when a loop stops before its first iteration, or because a clamp or "
                "a reset overwrites what it gave"
            )
        if "by implicit" in unused:
            parts.append("the fixed point of which the implicit derivative is taken does not depend on it")
        words = listed(list(dict.fromkeys(name for names in unused.values() for name in names)))
        title = f"the loss does not depend on {words}"
        if not any(unused.get(place) for place in own):
            title += f" {listed(list(unused))}"
        remedy = "Do not train on it; look at the decision that skipped or overwrote it, and at its margin."
        yield Finding("LOSS_INDEPENDENT", "warning", title, text + "; ".join(parts) + ".", remedy)
    zero = [
        (made["method"], name)
        for made in run.gradient
        for name, value in made["gradient"].items()
        if value == 0 and (made.get("depends") or {}).get(name, True)
    ]
    for name in dict.fromkeys(name for _, name in zero):
        methods = listed([method for method, other in zero if other == name])
        text = (
            f"The derivative along {name} is exactly zero by {methods}, though {name} was used: a clamp, a "
            "reset or a fixed point ends its influence on the loss (or it is below the smallest number)."
        )
        yield Finding("ZERO_GRADIENT", "info", f"the derivative along {name} is exactly zero", text)


def _not_finite_gradient(run: BallFolder) -> Iterator[Finding]:
    found = [
        f"d/d{name} by {made['method']}"
        for made in run.gradient
        for name, value in made["gradient"].items()
        if value is None or not math.isfinite(value)
    ]
    if found:
        text = (
            f"Not finite: {listed(found)}. A forward run can look fine where its derivative overflows: each "
            "contact multiplies it."
        )
        remedy = "Shorten integrator.timestep (h √k decides), the rollout, or widen precision.arithmetic."
        yield Finding("GRADIENT_NOT_FINITE", "error", "a derivative is not finite", text, remedy)


def _disagree(run: BallFolder) -> Iterator[Finding]:
    exact = run.exact.get("gradient") or {}
    values = {
        name: {made["method"]: made["gradient"][name] for made in run.gradient if name in made["gradient"]}
        for name in run.parameters
    }
    known = {
        name: {method: value for method, value in row.items() if value is not None}
        for name, row in values.items()
    }
    apart = [name for name, row in known.items() if _any_differs(list(row.values()))]
    off = [
        name
        for name, row in known.items()
        if name not in apart and row and name in exact and differs(next(iter(row.values())), exact[name])
    ]
    if apart:
        told = "; ".join(_told(name, known[name], exact) for name in apart)
        why = " ".join(
            _sentence(f"{made['method']}: {made['says']}") for made in run.gradient if made["says"]
        )
        text = f"{told}. They answer different questions. {why}"
        if any(name in exact for name in apart):
            right = [
                f"{method} on {name}"
                for name in apart
                for method, value in known[name].items()
                if name in exact and not differs(value, exact[name])
            ]
            text += (
                f" The closed form sides with {listed(right)}." if right else " None is the closed form’s."
            )
        remedy = "Choose the derivative of the question that is asked; unrolled is what training would use."
        title = f"methods disagree on {listed([f'dloss/d{name}' for name in apart])}"
        yield Finding("METHODS_DISAGREE", "warning", title, text, remedy)
    if off:
        told = "; ".join(_told(name, known[name], exact) for name in off)
        text = (
            f"{told}. The derivative of the discrete program is not that of the motion: which steps find the "
            "ball in contact is held fixed, and each contact multiplies what that leaves out."
        )
        remedy = "Shorten integrator.timestep, or locate the impacts (integrator event-located)."
        several = "s" if len(off) > 1 else ""
        title = (
            f"the derivative{several} along {listed(off)} {'are' if several else 'is'} not the closed form’s"
        )
        yield Finding("OFF_CLOSED_FORM", "warning", title, text, remedy)


def _forks(run: BallFolder) -> Iterator[Finding]:
    forked = [variant for variant in run.variants if variant.get("fork") is not None]
    precise = [variant for variant in forked if _of_rounding(variant)]
    other = [variant for variant in forked if variant not in precise]
    for group, what in ((precise, "precision alone changes"), (other, "")):
        if not group:
            continue
        title = f"{many(len(group), 'variant')} {'takes' if len(group) == 1 else 'take'} other decisions" + (
            f" where {what}" if what else ""
        )
        moved = [variant for variant in group if _moved(run, variant)]
        text = " ".join(_fork_text(run, variant) for variant in group[:_TOLD])
        if len(group) > _TOLD:
            text += f" {len(group) - _TOLD} more are in the table of variants."
        if moved and what:
            text += " The gradient of one says nothing about the program of the other."
        severity = "warning" if moved and what else "info"
        yield Finding("FORKED", severity, title, text)


def _iterations(run: BallFolder) -> Iterator[Finding]:
    found = [variant for variant in run.variants if variant.get("iterations_differ")]
    if not found:
        return
    told = listed([f"{variant['name']} at {many(variant['iterations_differ'], 'step')}" for variant in found])
    text = (
        f"Another number of {_counted(run)} was made by {told}. The derivative is that of the "
        f"{_counted(run)} that ran, so it jumps where their number does."
    )
    title = f"{_counted(run)} differ between variants"
    yield Finding("ITERATIONS_DIFFER", "info", title, text)


def _resting(run: BallFolder) -> Iterator[Finding]:
    rests = run.ended.get("rest", 0)
    series = run.series
    if rests:
        first = _first(run, "rest")
        when = run.exact.get("rest_time")
        text = (
            f"From step {count(first)} on ({number(float(run.time(np.array(first))))} s) impacts are slower "
            "than the rest speed and the ball is held on the floor: infinitely many bounces in a finite time "
            f"end in a decision{f'; the closed form comes to rest at {number(when, 4)} s' if when else ''}."
        )
        yield Finding("RESTING", "info", f"the ball comes to rest at step {count(first)}", text)
        return
    off = series["contacts"] < run.balls
    last = int(np.flatnonzero(off)[-1]) + 1 if off.any() else 0
    if len(series["step"]) - last > max(10, 0.05 * run.steps) and last < len(series["step"]):
        since = int(series["step"][last])
        text = f"From step {count(since)} to the end every ball is in contact; no decision is left to make."
        yield Finding("RESTING", "info", f"at rest on the floor from step {count(since)} on", text)


RULES: tuple[Rule, ...] = (
    _status, _ledger, _not_finite_gradient, _independent, _ambiguous, _cap, _disagree, _forks, _iterations,
    _resting,
)  # fmt: skip
#: Codes that are decided anew each time.
CODES = frozenset({
    "NOT_FINITE", "NOT_FINISHED", "LEDGER_INCOMPLETE", "SOLVER_CAP", "AMBIGUOUS_CONTACTS", "AMBIGUOUS_STOPS",
    "LOSS_INDEPENDENT", "ZERO_GRADIENT", "GRADIENT_NOT_FINITE", "METHODS_DISAGREE", "OFF_CLOSED_FORM",
    "FORKED", "ITERATIONS_DIFFER", "RESTING",
})  # fmt: skip


def _unused(made: Mapping[str, Any]) -> list[str]:
    return [name for name, depends in (made.get("depends") or {}).items() if not depends]


def _any_differs(values: list[float]) -> bool:
    return any(differs(values[0], other) for other in values[1:])


def _told(name: str, row: Mapping[str, float], exact: Mapping[str, float]) -> str:
    row = {**row, "closed form": exact[name]} if name in exact else row
    return f"dloss/d{name}: " + ", ".join(f"{method} {number(value)}" for method, value in row.items())


def _fork_text(run: BallFolder, variant: Mapping[str, Any]) -> str:
    channel = {"contact": "contact", "stop": "stop"}.get(str(variant.get("channel")), "")
    ball = variant.get("ball")
    of = f" of ball {ball}" if ball is not None and ball >= 0 and run.balls > 1 else ""
    margins = [variant.get(key) for key in ("margin", "margin_there")]
    told = " against ".join(number(value, 2) for value in margins if value is not None)
    text = f"{variant['name']}: the {channel} decision{of} at step {count(variant['fork'])} differs first"
    if told:
        text += f" (margin {told})"
    seed = variant.get("seed")
    if seed is not None:
        text += f"; the bits part at step {count(seed)}"
    if variant.get("separation_end") is not None:
        text += f", the heights are {number(variant['separation_end'], 2)} m apart at the end"
    return text + "."


def _of_rounding(variant: Mapping[str, Any]) -> bool:
    """Whether a variant changes nothing but how numbers are rounded."""
    changes = variant.get("changes") or {}
    return bool(changes) and all(str(key).startswith("precision.") for key in changes)


def _moved(run: BallFolder, variant: Mapping[str, Any]) -> bool:
    """Whether a variant's gradient is another one."""
    own = run.gradient[0]["gradient"] if run.gradient else {}
    return any(
        differs(value, own[name]) for name, value in (variant.get("gradient") or {}).items() if name in own
    )


def _first(run: BallFolder, reason: str) -> int:
    rows = np.flatnonzero(run.series["reason"].astype(str) == reason)
    return int(run.series["step"][rows[0]]) if len(rows) else 0


def _step(run: BallFolder, wrong: np.ndarray) -> str:
    return f"step {count(int(run.series['step'][int(np.argmax(wrong))]))}"


def _counted(run: BallFolder) -> str:
    return "impacts" if run.located else "iterations"


def _times(n: int) -> str:
    return "once" if n == 1 else "twice" if n == 2 else f"{count(n)} times"


def _they(n: int) -> str:
    return "it" if n == 1 else "they"


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else text + "."
