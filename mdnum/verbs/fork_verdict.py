"""Findings and verdict on two runs that diverge, from the output folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.numerics.verdicts import REPEATS
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.words import listed, pair_name
from mdnum.units import Measured

if TYPE_CHECKING:
    from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("fork.py"))

#: Titles of sections to which findings refer.
DECISION, TWO_BY_TWO, WHAT = (
    "The decision at the fork",
    "Whose decisions, whose arithmetic",
    "What was compared",
)
RANKING = "Ranking"


def subject(s: Mapping[str, Any]) -> str:
    """Return a phrase for a decision: a pair's flip, a ball's contact or a solver's stop."""
    d = s.get("decision")
    if d is None:
        return ""
    shared = d["channel"] == "stop" and d["ball"] is None
    kind = f"{d['channel']}{'_all' * shared}{'_term' * bool(d.get('terms'))}"
    return TEXTS(f"subject_{kind}", **d)


def of_pair(flip: Mapping[str, Any]) -> str:
    """Return the label of a flip: its ball, or its pair and energy term."""
    i, *j = flip["subject"]
    return pair_name({"i": i, "j": j[0], "terms": flip["terms"]}) if j else str(i)


def judge(view: View) -> Verdict:
    """Return the verdict on a pair of runs: findings, evidence and headline."""
    found = [*_findings(view), *view.kept(TEXTS.entries)]
    name, values = _headline(view)
    best = "info" if view.summary.get("fork") is not None else "good"
    return conclude(found, _evidence(view), headline=TEXTS(name, **values), best=best, judged=True)


def _headline(view: View) -> tuple[str, dict[str, Any]]:
    """Return the key of the headline's text, and the values to fill in."""
    s = view.summary
    failed, word, fork, split = (s.get(name) for name in ("failed", "effect", "fork", "split"))
    values = {name: s.get(name) for name in ("steps", "first_bit", "fork", "split", "predicted_split")}
    if failed:
        run, ended = next(iter(failed.items()))
        values |= {"run": run, "word": ended, "other": "B" if run == "A" else "A",
                   "a": failed.get("A"), "b": failed.get("B")}  # fmt: skip
        return "ended_both" if len(failed) > 1 else "ended" if s["decision"] else "ended_fork", values
    imposed = (s.get("splits") or {}).get("B|A")
    values |= {"imposed": imposed, "until": s.get("imposed_until"), "subject": subject(s)}
    values["compared"] = TEXTS("compared_not" if imposed is None else "compared", **values)
    values["agreeing"] = agreeing(view)
    if word == "same":
        return "same_but_decided" if s["decision"] else "same", values
    if fork is None:
        return "no_fork" if split is None else "no_fork_split", values
    if word == "bystander" and split < fork:
        return "bystander_before", values
    by = s.get("predicted_by")
    if word == "open" and (split is not None or by):
        return "open_split" if split is not None else f"open_{by}", values
    return str(word), values


def agreeing(view: View) -> str:
    """Return a phrase on how many repeated runs diverge later if decisions are imposed."""
    said: list[str] = []
    for name in ("count", "count_other"):
        if count := view.summary.get(name):
            kind = "_other" if said else "" if count["threshold"] else "_any"
            known = count.get("displacement")
            displaced = TEXTS("displaced", displacement=known, unit=view.units.length) if known else ""
            said.append(TEXTS(f"agreeing{kind}", **count, displaced=displaced))
    return ", and ".join(said)


def _evidence(view: View) -> Iterator[str]:
    summary, decision, unit = view.summary, view.summary["decision"], view.units.length
    sizes = summary.get("displacements") or ()
    for reason in summary.get("reasons") or ():
        code = reason["code"]
        size = sizes[code == "other"] if sizes and code in ("counted", "counted_any", "other") else None
        separation: Any = Measured(reason.get("separation"), unit, summary["tolerance"])
        yield TEXTS(f"reason_{code}", **{**reason, "separation": separation}, displacement=size, unit=unit)
        if size and code != "other":
            yield TEXTS("repeats_displaced", displacement=size, unit=unit)
    if decision is None:
        return
    values = {**decision, "subject": subject(summary), "unit": view.units.length}
    values |= {"runs": " and ".join(f"run {name}" for name in decision["ambiguous_in"])}
    yield TEXTS(decided(decision), **values, **sides(decision), counted=summary.get("counted"))
    yield TEXTS("rounding" if decision["ambiguous_in"] else "no_rounding", **values)
    if decision.get("protected") is not None:
        yield TEXTS("separated", **values)


def decided(decision: Mapping[str, Any]) -> str:
    """Return the key of the sentence on a decision that differs between runs."""
    name = "at_start" if decision["run"] == "start" else decision["channel"]
    return f"decided_{name}{'_term' * bool(decision.get('terms'))}"


def sides(decision: Mapping[str, Any]) -> dict[str, Any]:
    """Return what runs A and B decided, and the run in which the decision is true."""
    yes = "A" if decision["decided"]["A"] > decision["decided"]["B"] else "B"
    return {"yes": yes, "no": "B" if yes == "A" else "A", "a": decision["decided"]["A"],
            "b": decision["decided"]["B"]}  # fmt: skip


def _findings(view: View) -> Iterator[Finding]:
    s, decision, unit = view.summary, view.summary["decision"], view.units.length
    steps, failed, count = s["steps"], s.get("failed") or {}, s.get("count")
    if s.get("must_hold") and s.get("first_bit") is not None:
        yield must_hold(s)
    for name, word in failed.items():
        yield TEXTS.finding("RUN_FAILED", run=name, word=word, steps=steps, asked=s["steps_asked"])
    if s.get("reproduced") is False:
        yield TEXTS.finding("NOT_REPRODUCED", stored=s["stored"]["fork"], fork=s.get("fork"), section=WHAT)
    if decision and decision["ambiguous_in"]:
        sizes = [
            TEXTS("of_bound", run=run, margin=abs(margin), bound=decision["bounds"][run])
            for run, margin in decision["margins"].items()
            if run in decision["ambiguous_in"]
        ]
        yield TEXTS.finding("AMBIGUOUS_FORK", section=DECISION, subject=subject(s), sizes=listed(sizes))
    if s["effect"] == "open" and s["split"] is None and not failed:
        split = s["predicted_split"]
        yield TEXTS.finding(
            "HORIZON_SHORT", *["predicted"] * bool(split), steps=steps, unit=unit, split=split,
            separation=s.get("separation_end"), tolerance=s["tolerance"],
        )  # fmt: skip
    until = s.get("imposed_until")
    if until is not None and until < steps and not failed:
        word = (s.get("failed_imposed") or {}).get("B|A")
        yield TEXTS.finding("GUARD", *["failed"] * bool(word), until=until, word=word)
    if s["effect"] == "undecided" and count:
        more = max(REPEATS, 2 * (count["most"] - 1))
        of, need = count["needed"] or (None, None)
        variants = ["none"] * (count["pairs"] < 2) + ["more"] * (more > count["most"] - 1)
        variants += ["needed"] * (need is not None)
        # more repeats would not change what the other displacement says
        variants = ["disagree"] if s.get("count_other") else variants
        values = {"agreeing": agreeing(view), "more": more, "of": of, "need": need}
        yield TEXTS.finding("UNDECIDED", *variants, section=TWO_BY_TWO, **values)


def must_hold(row: Mapping[str, Any]) -> Finding:
    """Return the finding on a numerical choice that changed bits although it should not."""
    values: dict[str, Any] = {name: row.get(name) for name in ("choice", "difference", "first_bit", "fork")}
    return TEXTS.finding("MUST_HOLD_FORKED", *["fork"] * (row.get("fork") is not None), **values)


def judge_screen(view: View) -> Verdict:
    """Return the verdict on all choices."""
    rows, found = view.summary["ranking"], []
    broken = [row for row in rows if row["must_hold"] and row["first_bit"] is not None]
    forked = [row for row in rows if row["fork"] is not None]
    found += [must_hold(row) for row in broken]
    found += [TEXTS.finding("CHOICE_FAILED", section=RANKING, **row) for row in rows if row["failed"]]
    values = {"choices": len(rows), "forked": len(forked), "steps": view.summary["steps"]}
    if broken:
        headline = TEXTS("screen_broken", names=", ".join(row["choice"] for row in broken))
    elif not forked:
        headline = TEXTS("screen_none", **values)
    else:
        headline = TEXTS("screen_forks", first=forked[0]["choice"], step=forked[0]["fork"], **values)
    return conclude(found, headline=headline, best="info" if forked else "good", judged=True)


def judge_compare(view: View) -> Verdict:
    """Return the verdict on the runs of two folders: the step of divergence and its causes."""
    summary = view.summary
    causes = summary["causes"]
    values = {name: summary[name] for name in ("steps", "first_bit", "fork")}
    kind = "same" if summary["fork"] is None and summary["first_bit"] is None else "bits"
    of = "_frames" * (summary["world"] == "flips")
    headline = TEXTS(f"folders_{'fork' if summary['fork'] is not None else kind}{of}", **values)
    if of:
        names = [name for name, *_ in summary["differences"]]
        evidence = [TEXTS("folders_given", names=", ".join(names))] * bool(names)
        evidence += [TEXTS("folders_start_frames")] * (not summary["same_structure"])
    else:
        names = ", ".join(causes[:6])
        evidence = [TEXTS(f"folders_{min(len(causes), 2)}_causes", n=len(causes), names=names)]
        evidence += [TEXTS("folders_start")] * ("start" in causes)
    if summary["decisions"]:
        flip = summary["decisions"][0]
        which = of_pair(flip)
        yes = "entered" if flip["entered"] else "left"
        evidence.append(TEXTS(f"folders_{summary['channel']}_{yes}{of}", **values, which=which, **flip))
    elif summary["iterations"]:
        a, b = summary["iterations"]
        evidence.append(TEXTS("folders_stop", **values, a=a, b=b))
    if summary["fork"] is not None:
        evidence.append(TEXTS(f"folders_further_{summary['world']}"))
    return conclude([], evidence, headline=headline, best="good" if kind == "same" else "info")


def judge_benign(view: View) -> Verdict:
    """Return the verdict on whether repeats of runs A and B are consistent."""
    summary = view.summary
    values = {"difference": summary["difference"], "step": summary["window"]}
    if summary["passed"]:
        return conclude([], [], headline=TEXTS("benign", **values), best="good")
    first = ", ".join(f"{name} ({z:+.3g} σ)" for name, z in summary["failing"].items())
    finding = TEXTS.finding("NOT_BENIGN", *["blew_up"] * (not first), names=first, **values)
    return conclude([finding], [], headline=TEXTS("not_benign", **values), judged=True)
