"""What is found about two runs of either world, and the answer in a sentence; from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.numerics.verdicts import REPEATS
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.words import listed

if TYPE_CHECKING:
    from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("fork.py"))

#: Titles of sections that findings name.
DECISION, TWO_BY_TWO, WHAT = (
    "The decision at the fork",
    "Whose decisions, whose arithmetic",
    "What was compared",
)
RANKING = "Ranking"


def subject(s: Mapping[str, Any]) -> str:
    """What differs at the fork: the flip of a pair, the contact of a ball, the stop of a solver."""
    d = s.get("decision")
    if d is None:
        return ""
    shared = d["channel"] == "stop" and d["ball"] is None
    return TEXTS("subject_stop_all" if shared else f"subject_{d['channel']}", **d)


def judge(view: View) -> Verdict:
    """The verdict on a pair of runs."""
    found = [*_findings(view), *view.kept(TEXTS.entries)]
    name, values = _headline(view)
    best = "info" if view.summary.get("fork") is not None else "good"
    return conclude(found, _evidence(view), headline=TEXTS(name, **values), best=best, judged=True)


def _headline(view: View) -> tuple[str, dict[str, Any]]:
    """The sentence that answers, by name, and its values."""
    summary = view.summary
    failed, word, fork, split = (summary.get(name) for name in ("failed", "effect", "fork", "split"))
    values = {name: summary.get(name) for name in ("steps", "first_bit", "fork", "split", "predicted_split")}
    if failed:
        values |= {"a": failed.get("A"), "b": failed.get("B"), "word": next(iter(failed.values()))}
        values |= {"run": "A" if "A" in failed else "B", "other": "B" if "A" in failed else "A"}
        return "ended_both" if len(failed) > 1 else "ended" if summary["decision"] else "ended_fork", values
    values |= {"until": summary.get("imposed_until"), "subject": subject(summary)}
    values |= {"compared": _compared(summary), "agreeing": agreeing(summary)}
    if word == "same":
        return "same_but_decided" if summary["decision"] else "same", values
    if fork is None:
        return "no_fork" if split is None else "no_fork_split", values
    if word == "bystander" and split < fork:
        return "bystander_before", values
    if word != "open":
        return str(word), values
    by = summary.get("predicted_by")
    return "open_split" if split is not None else f"open_{by}" if by else "open", values


def _compared(summary: Mapping[str, Any]) -> str:
    """When the runs split, free and under A's decisions."""
    imposed = (summary.get("splits") or {}).get("B|A")
    values = {"split": summary.get("split"), "imposed": imposed, "until": summary.get("imposed_until")}
    return TEXTS("compared_not" if imposed is None else "compared", **values)


def agreeing(summary: Mapping[str, Any]) -> str:
    """How many of the pair and its repeats split later without the flips."""
    count = summary.get("count")
    return "" if not count else TEXTS("agreeing" if count["threshold"] else "agreeing_any", **count)


def _evidence(view: View) -> Iterator[str]:
    summary, decision = view.summary, view.summary["decision"]
    for reason in summary.get("reasons") or ():
        yield TEXTS(f"reason_{reason['code']}", **reason, unit=view.units.length)
    if decision is None:
        return
    values = {**decision, "subject": subject(summary), "unit": view.units.length}
    values |= {"runs": " and ".join(decision["ambiguous_in"])}
    name = "at_start" if decision["run"] == "start" else decision["channel"]
    yield TEXTS(f"decided_{name}", **values, **sides(decision), counted=summary.get("counted"))
    yield TEXTS("rounding" if decision["ambiguous_in"] else "no_rounding", **values)
    if decision.get("protected") is not None:
        yield TEXTS("separated", **values)


def sides(decision: Mapping[str, Any]) -> dict[str, Any]:
    """Which run decided yes and which no, and what each of them decided."""
    yes = "A" if decision["decided"]["A"] > decision["decided"]["B"] else "B"
    return {"yes": yes, "no": "B" if yes == "A" else "A", "a": decision["decided"]["A"],
            "b": decision["decided"]["B"]}  # fmt: skip


def _findings(view: View) -> Iterator[Finding]:
    summary, decision = view.summary, view.summary["decision"]
    steps, failed = summary["steps"], summary.get("failed") or {}
    if summary.get("must_hold") and summary.get("first_bit") is not None:
        yield must_hold(summary)
    for name, word in failed.items():
        yield TEXTS.finding("RUN_FAILED", run=name, word=word, steps=steps, asked=summary["steps_asked"])
    if summary.get("reproduced") is False:
        stored = summary["stored"]["fork"]
        yield TEXTS.finding("NOT_REPRODUCED", stored=stored, fork=summary.get("fork"), section=WHAT)
    if decision and decision["ambiguous_in"]:
        margins = decision["margins"].items()
        sizes = [TEXTS("of_bound", run=run, margin=abs(x), bound=decision["bounds"][run])
                 for run, x in margins if run in decision["ambiguous_in"]]  # fmt: skip
        yield TEXTS.finding("AMBIGUOUS_FORK", section=DECISION, subject=subject(summary), sizes=listed(sizes))
    values: dict[str, Any] = {"steps": steps, "unit": view.units.length, "split": summary["predicted_split"]}
    values |= {"separation": summary.get("separation_end"), "tolerance": summary["tolerance"]}
    if summary["effect"] == "open" and summary["split"] is None and not failed:
        yield TEXTS.finding("HORIZON_SHORT", *["predicted"] * bool(values["split"]), **values)
    until = summary.get("imposed_until")
    if until is not None and until < steps and not failed:
        word = (summary.get("failed_imposed") or {}).get("B|A")
        yield TEXTS.finding("GUARD", *["failed"] * bool(word), until=until, word=word)
    count = summary.get("count")
    if summary["effect"] == "undecided" and count:
        more = max(REPEATS, 2 * (count["most"] - 1))
        of, need = count["needed"] or (None, None)
        variants = ["none"] * (count["pairs"] < 2) + ["more"] * (more > count["most"] - 1)
        variants += ["needed"] * (count["needed"] is not None)
        yield TEXTS.finding(
            "UNDECIDED", *variants, section=TWO_BY_TWO, agreeing=agreeing(summary), more=more, of=of,
            need=need,
        )  # fmt: skip


def must_hold(row: Mapping[str, Any]) -> Finding:
    """A choice that cannot change a bit by design, and did."""
    values: dict[str, Any] = {name: row.get(name) for name in ("choice", "difference", "first_bit", "fork")}
    return TEXTS.finding("MUST_HOLD_FORKED", *["fork"] * (row.get("fork") is not None), **values)


def judge_screen(view: View) -> Verdict:
    """The verdict on all choices: which forks first, and whether what must hold did."""
    rows, found = view.summary["ranking"], []
    for row in rows:
        if row["must_hold"] and row["first_bit"] is not None:
            found.append(must_hold(row))
        if row["failed"]:
            found.append(TEXTS.finding("CHOICE_FAILED", section=RANKING, **row))
    forked = [row for row in rows if row["fork"] is not None]
    broken = [row["choice"] for row in rows if row["must_hold"] and row["first_bit"] is not None]
    values = {"choices": len(rows), "forked": len(forked), "steps": view.summary["steps"]}
    if broken:
        headline = TEXTS("screen_broken", names=", ".join(broken))
    elif not forked:
        headline = TEXTS("screen_none", **values)
    else:
        headline = TEXTS("screen_forks", first=forked[0]["choice"], step=forked[0]["fork"], **values)
    return conclude(found, headline=headline, best="info" if forked else "good", judged=True)


def judge_compare(view: View) -> Verdict:
    """What two folders say about where their runs diverge, and what it may be put down to."""
    summary = view.summary
    causes = summary["causes"]
    values = {name: summary[name] for name in ("steps", "first_bit", "fork")}
    kind = "same" if summary["fork"] is None and summary["first_bit"] is None else "bits"
    headline = TEXTS(f"folders_{'fork' if summary['fork'] is not None else kind}", **values)
    evidence = [TEXTS(f"folders_{min(len(causes), 2)}_causes", n=len(causes), names=", ".join(causes[:6]))]
    if "start" in causes:
        evidence.append(TEXTS("folders_start"))
    if summary["decisions"]:
        flip = summary["decisions"][0]
        which = "–".join(str(label) for label in flip["subject"])
        yes = "entered" if flip["entered"] else "left"
        evidence.append(TEXTS(f"folders_{summary['channel']}_{yes}", **values, which=which, **flip))
    elif summary["iterations"]:
        a, b = summary["iterations"]
        evidence.append(TEXTS("folders_stop", **values, a=a, b=b))
    if summary["fork"] is not None:
        evidence.append(TEXTS(f"folders_further_{summary['world']}"))
    return conclude([], evidence, headline=headline, best="good" if kind == "same" else "info")


def judge_benign(view: View) -> Verdict:
    """Whether B's runs belong to A's ensemble."""
    summary = view.summary
    values = {"difference": summary["difference"], "step": summary["window"]}
    if summary["passed"]:
        return conclude([], [], headline=TEXTS("benign", **values), best="good")
    first = ", ".join(f"{name} ({z:+.3g} σ)" for name, z in summary["failing"].items())
    finding = TEXTS.finding("NOT_BENIGN", *["blew_up"] * (not first), names=first, **values)
    return conclude([finding], [], headline=TEXTS("not_benign", **values), judged=True)
