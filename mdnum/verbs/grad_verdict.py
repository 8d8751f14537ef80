"""Verdict of `mdnum grad`: findings (errors, warnings and notes) on a gradient."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.finding import Finding, Verdict, conclude
from mdnum.report.words import listed, percent
from mdnum.verbs import grad_page
from mdnum.verbs.frame import View
from mdnum.verbs.grad_page import TEXTS, by, closeness, digits_note, digits_of, magnitude, slope
from mdnum.verbs.run import function_findings

#: Share of a derivative above which it is regarded as dominated by single flips, and the largest number of
#: such flips.
_HEAVY, _SINGLE = 0.2, 3
#: Share of the weight of all flips above which flips that the guard excludes are reported.
_LEFT_OUT = 0.01
#: Relative difference from a closed form within which a derivative counts as that of the exact motion.
_CLOSE = 0.01


def judge(view: View) -> Verdict:
    """Return the verdict on a gradient: findings, evidence and headline."""
    trust = view.summary.get("trust") or {}
    found = [*_of_methods(view), *_of_trust(view), *_of_flips(view), *_of_the_motion(view)]
    found += function_findings(view.summary.get("function"), view.units)
    known = view.summary.get("exact") or trust.get("verdict") == "trusted"
    # the headline has the verdict on trust already
    worst = [one for one in found if one.severity == "error" or one.code not in ("BEYOND_TRUST", "UNDECIDED")]
    judged = not any(one.severity in ("warning", "error") for one in worst)
    return conclude(
        found, _evidence(view), headline=_headline(view), best="good" if known else "info", judged=judged
    )


def _headline(view: View) -> str:
    summary, trust = view.summary, view.summary.get("trust") or {}
    reference = by(summary, summary["reference"])
    parts, judgments = [], grad_page.judgments(summary)
    for one in summary["parameters"][:3]:
        value = f"{slope(summary, reference, one['name'], 4)} {grad_page.slope_unit(summary, one)}".rstrip()
        names = next((names for names in judgments if one["name"] in names), ())
        verdict = TEXTS("note_{verdict}".format_map(judgments[names]), **judgments[names]) if names else ""
        note = ", ".join(filter(None, (verdict, digits_note(summary, one["name"]))))
        short = one["name"].partition(".")[2] or one["name"]
        parts.append(f"d {summary['loss']['word']} / d {short} = {value}{f' ({note})' if note else ''}")
    # verdicts that differ stand behind their derivatives
    name = "unasked" if len(judgments) > 1 else trust.get("verdict") or "unasked"
    if name == "limited" and not trust["horizon"]:
        name = "limited_anywhere"
    starts = TEXTS("starts_unknown") if "other starts" in trust.get("unknown", ()) else ""
    return TEXTS(
        f"headline_{name}", steps=summary["steps"], slopes=listed(parts), horizon=trust.get("horizon"),
        limit=trust.get("limited_by"), starts=starts,
    )  # fmt: skip


def _evidence(view: View) -> Iterator[str]:
    summary = view.summary
    reference = by(summary, summary["reference"])
    if reference is not None:
        yield TEXTS("by_method", method=reference["method"], description=reference["description"].rstrip("."))
    yield from list(grad_page.trust_sentences(summary)) or grad_page.growth_sentences(view)
    for name, parts in ((summary.get("flips") or {}).get("share") or {}).items():
        if None not in parts.values() and digits_of(summary, name.partition("[")[0]) != 0:
            share = percent(round(abs(parts["pair enters"] + parts["pair leaves"]), 6))
            yield TEXTS("flips_share", share=share, name=name)


def _of_methods(view: View) -> Iterator[Finding]:
    """Yield findings on gradients that are infinite, NaN, zero, unexplained, misleading or unavailable."""
    summary, methods, section = view.summary, view.summary["methods"], "By method"
    where = summary.get("detective") or {}
    variants = []
    if where.get("found"):
        variants = ["found" if where["forward"] else "forward", *["pair"] * (where["j"] >= 0)]
    inputs = ", ".join(f"{value:.4g}" for value in where.get("inputs") or ())
    no_number: set[tuple[str, str]] = set()
    for one in methods:
        sizes = {name: magnitude(value, math.nan) for name, value in one["gradient"].items()}
        broken = [name for name, size in sizes.items() if not math.isfinite(size)]
        no_number |= {(one["method"], name) for name in broken}
        if broken:
            values: dict[str, Any] = {**where, "inputs": inputs, "names": listed(broken)}
            yield TEXTS.finding("NOT_FINITE", *variants, method=one["method"], **values)
    # what the reference has first: it leaves nothing out
    ranked = sorted(methods, key=lambda one: one["method"] != summary["reference"])
    for name in (one["name"] for one in summary["parameters"]):
        if not any(magnitude(one["gradient"].get(name), math.nan) for one in methods):
            notes = filter(None, (one["notes"].get(name) for one in ranked))
            yield TEXTS.finding("NO_DEPENDENCE", name=name, note=next(notes, TEXTS("no_note")))
    for row in summary["comparisons"]:
        both = {(row[which], row["name"]) for which in ("method", "reference")}
        # what is no number has been reported
        if row["meaning"] == "unexplained" and not both & no_number:
            yield TEXTS.finding(
                "UNEXPLAINED", section=section, method=row["method"], reference=row["reference"],
                name=row["name"], closeness=closeness(row), explained=row["values"].get("explained"),
            )  # fmt: skip
    # only methods that hold decisions fixed, where flips count
    held = [one["method"] for one in methods if one["kind"] == "steps"]
    aware = any(
        one["kind"] == "flow" or one["method"] in ("event-aware", "smoothed-differences", "ensemble")
        for one in methods
    )
    if summary.get("force_jump") and held and not aware:
        unit = f"{view.units.energy}/{view.units.length}"
        yield TEXTS.finding("MISSING_SALTATION", section=section, jump=summary["force_jump"],
                            methods=listed(held), unit=unit, held=len(held))  # fmt: skip
    if any(one["details"].get("loss jumps") for one in methods):
        yield TEXTS.finding("LOSS_JUMPS", loss=summary["loss"]["word"])
    for one in methods:
        primal = one["details"].get("primal") or {}
        state, decision = primal.get("first state"), primal.get("first decision")
        if state is not None:
            decided = ["decided"] * (decision is not None)
            yield TEXTS.finding("ANOTHER_PRIMAL", *decided, method=one["method"], state=state,
                                decision=decision)  # fmt: skip
    if refused := summary["refused"]:
        each = " ".join(f"{one['method']}: {one['why'].rstrip('.')}." for one in refused)
        yield TEXTS.finding("DOES_NOT_APPLY", methods=len(refused), each=each)


def _of_trust(view: View) -> Iterator[Finding]:
    """Yield findings on derivatives that cannot be trusted for all requested steps."""
    for names, one in grad_page.judgments(view.summary).items():
        whose = TEXTS("whose", names=listed(names)) if names else ""
        values: dict[str, Any] = {"names": list(names), "whose": whose, "section": "How far it is trusted"}
        if one["verdict"] == "limited":
            limit = one["limited_by"]
            variants = [limit.replace(" ", "_"), *["anywhere"] * (not one["horizon"])]
            seen = next(row for row in one["limits"] if row["what"] == limit)
            yield TEXTS.finding(
                "BEYOND_TRUST", *variants, horizon=one["horizon"], limit=limit,
                seen=grad_page.limit_sentence(view.summary, seen), **values,
            )  # fmt: skip
        elif one["verdict"] == "undecided":
            variants = list(_unknown(view, one))
            yield TEXTS.finding("UNDECIDED", *variants, unknown=listed(one["unknown"]), **values)


def _unknown(view: View, trust: Mapping[str, Any]) -> Iterator[str]:
    """Yield names of sentences on possible further tests of the derivative."""
    unseen = {one["what"] for one in trust["limits"] if one["horizon"] is None}
    aware = by(view.summary, "event-aware") is not None
    if any(one["what"] == "half the time step" for one in view.summary["left_out"]):
        yield "half"
    elif "time step" in unseen:
        yield "noise"
    elif "near miss" in unseen:
        yield "near" if aware else "aware"
    if {"time step", "near miss"} <= unseen and not aware:
        yield "aware"
    if "other starts" in trust["unknown"] and not _averaged(view):
        yield "starts"
    if "parameters of many entries" in trust["unknown"]:
        yield "entries"


def _averaged(view: View) -> bool:
    """True if the gradient was averaged over several starts (initial states)."""
    return any(name.startswith("error.") for name in view.table("trust"))


def _of_flips(view: View) -> Iterator[Finding]:
    """Yield findings on derivatives dominated by one or two flips, and on grazing flips."""
    section, totals = "Flips on the way", (view.summary.get("flips") or {}).get("total") or {}
    table = view.table("flip_contributions") if totals else {}
    for name, total in totals.items():
        added = table.get(f"contribution.{name}", np.zeros(0))
        heavy = np.argsort(-np.abs(added))[:_SINGLE]
        heavy = heavy[np.abs(added[heavy]) > _HEAVY * abs(math.nan if total is None else total)]
        if total and len(heavy):
            k = heavy[0]
            none = ["none"] * (digits_of(view.summary, name.partition("[")[0]) == 0)
            yield TEXTS.finding(
                "FEW_FLIPS", *none, *["averaged"] * _averaged(view), section=section, name=name,
                count=len(heavy), heavy=_HEAVY, i=int(table["i"][k]), j=int(table["j"][k]),
                step=int(table["step"][k]), speed=abs(float(table["radial_speed"][k])),
                share=abs(float(added[k]) / total),
            )  # fmt: skip
    details = (by(view.summary, "event-aware") or {"details": {}})["details"]
    left, applied = details.get("weight left out"), details.get("weight applied")
    by_name = (view.summary.get("trust") or {}).get("by") or {}
    met = [(name, x["values"]) for name, y in by_name.items() for x in y["limits"] if x["code"] == "grazing"]
    shares = {name: values["share"] for name, values in met}
    # where a parameter was not judged, only the weights are known
    judged = by_name and all(one["limits"] for one in by_name.values())
    if left and applied is not None and (shares or (not judged and left > _LEFT_OUT * (left + applied))):
        each = listed([TEXTS("grazing_share", name=name, share=one) for name, one in shares.items()] or [""])
        yield TEXTS.finding("GRAZING", *["by"] * bool(met), section=section, each=each, shares=shares,
                            grazing=details["grazing"], guard=details["guard"],
                            share=left / (left + applied))  # fmt: skip


def _of_the_motion(view: View) -> Iterator[Finding]:
    """Yield a finding on methods that disagree with a known exact derivative."""
    rows = view.summary["comparisons"] if view.summary.get("exact") else ()
    off = [row for row in rows if row["relative"] is None or row["relative"] > _CLOSE]
    methods: dict[str, list[str]] = {}
    for row in off:
        methods.setdefault(row["method"], []).append(f"{row['name']} {closeness(row)}")
    if methods:
        aware = "event-aware" in methods
        impact = view.summary["contact_kind"] == "impact" and view.summary["integrator"] != "event-located"
        each = listed([f"{method} ({', '.join(named)})" for method, named in methods.items()])
        yield TEXTS.finding(
            "NOT_THE_MOTION", *["impact"] * (impact and aware), *["aware"] * aware, section="By method",
            methods=len(methods), close=_CLOSE, each=each,
        )  # fmt: skip
