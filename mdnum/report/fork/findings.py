"""A verdict in words on a pair of runs, with the criteria it was tested by; from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mdnum.events.chance import REPEATS
from mdnum.report.fork.run import ForkFolder, load
from mdnum.report.verdict import Finding, restore
from mdnum.report.words import count, listed, many, number, typeset
from mdnum.store import RunFolder

#: Codes that are decided anew each time.
CODES = frozenset({
    "MUST_HOLD_FORKED", "RUN_FAILED", "AMBIGUOUS_FORK", "HORIZON_SHORT", "GUARD", "UNDECIDED",
})  # fmt: skip
#: r² from which a separation counts as one exponential.
FITS = 0.8


@dataclass(frozen=True)
class Verdict:
    """What to think of a comparison.

    Attributes:
        tone: "good" where the choice changes nothing that was decided, "info" for a fork that is understood,
            "warning" or "error" for the worst finding.
        headline: one sentence.
        evidence: what it rests on, a sentence each.
        findings: errors first.
    """

    tone: Literal["good", "info", "warning", "error"]
    headline: str
    evidence: tuple[str, ...]
    findings: tuple[Finding, ...]

    def store(self, folder: RunFolder, summary: Mapping[str, Any]) -> None:
        """Writes headline and findings into a folder's summary.json, beside what summary holds."""
        findings = [asdict(finding) for finding in self.findings]
        folder.write_summary({**summary, "findings": findings, "headline": self.headline})


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a fork folder and writes headline and findings into its summary.json."""
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = judge(run)
    verdict.store(folder, run.summary)
    return verdict


def judge(run: ForkFolder) -> Verdict:
    """Headline, evidence and findings of a comparison.

    Findings that others left in summary.json are kept.
    """
    found = list(_screened(run) if run.screened else _findings(run))
    found += [restore(kept) for kept in run.summary.get("findings") or () if kept.get("code") not in CODES]
    order = ("error", "warning", "info")
    found.sort(key=lambda finding: order.index(finding.severity))
    worst = found[0].severity if found else "info"
    forks = any(one.get("fork") is not None for one in run.ranking) if run.screened else "fork" in run.dates
    tone = worst if worst != "info" else "info" if forks else "good"
    headline = _ranked(run) if run.screened else _headline(run)
    return Verdict(tone, headline, () if run.screened else tuple(_evidence(run)), tuple(found))


# --- one choice ---------------------------------------------------------------------------------------


def _headline(run: ForkFolder) -> str:
    summary, dates = run.summary, run.dates
    steps = many(run.steps, "step")
    if run.summary.get("failed"):
        return _ended(run)
    if run.word == "same":
        return f"The same trajectory: no bit differs in {steps}."
    if run.word == "no fork":
        if "split" in dates:
            return f"The runs split at step {count(dates['split'])} without a single decision that differs."
        return f"No fork: bits differ from step {count(dates['seed'])} on, but no decision does in {steps}."
    fork, split = count(dates.get("fork")), count(dates.get("split"))
    if run.word == "cause":
        return (
            f"The flip at step {fork} is the cause: free, the runs split at step {split}; "
            f"under A’s decisions they stay together{followed(run)}."
        )
    if run.word == "accelerated":
        return f"The flips accelerated the split: {compared(run)}."
    if run.word == "undecided":
        return f"What the flips did to the split is undecided: {compared(run)}."
    if run.word == "bystander":
        return f"The flip at step {fork} is a bystander: {bystander(run)}."
    if "split" in dates:
        return f"The runs fork at step {fork} and split at step {split}; what the flips did to it is open."
    guess = summary.get("predicted_split")
    what = "the Lyapunov exponent" if summary.get("predicted_by") == "exponent" else "the growth so far"
    tail = f"; {what} puts it at about step {count(guess)}" if guess is not None else ""
    return f"The runs fork at step {fork} and have not split in {steps}{tail}."


def followed(run: ForkFolder) -> str:
    """Up to which step the runs stay together under A's decisions."""
    until = run.summary.get("handed_until")
    return "" if until is None else f" up to step {count(until)}"


def compared(run: ForkFolder) -> str:
    """When the runs split, free and under A's decisions, and in how many repeats that is later."""
    summary, split = run.summary, run.dates["split"]
    other = (summary.get("splits") or {}).get("B|A")
    text = f"free, the runs split at step {count(split)}, and under A’s decisions "
    if other is None:
        text += "later than they were followed"
    elif other == split:
        text += "at the same step"
    else:
        text += f"{many(abs(other - split), 'step')} {'later' if other > split else 'earlier'}"
    return f"{text}; {agreeing(run)}" if summary.get("count") else text


def agreeing(run: ForkFolder) -> str:
    """How many of the pair and its repeats split later without the flips."""
    found = run.summary["count"]
    later = (
        "later"
        if not found["threshold"]
        else f"more than one e-folding ({number(found['threshold'], 2)} steps) later"
    )
    return f"{count(found['later'])} of {many(found['pairs'], 'such pair')} split {later} without the flips"


def bystander(run: ForkFolder) -> str:
    """By which criterion flips had no part in a split."""
    split = run.dates["split"]
    if split < run.dates.get("fork", 0):
        return f"the runs had split at step {count(split)}, before any decision differed"
    return compared(run)


def _ended(run: ForkFolder) -> str:
    """A comparison in which a run blew up."""
    failed, fork = run.summary["failed"], run.dates.get("fork")
    if len(failed) > 1:
        words = listed([f"{name} in a {word}" for name, word in failed.items()])
        return f"Both runs ended at step {count(run.steps)}, {words}."
    ((name, word),) = failed.items()
    other = "B" if name == "A" else "A"
    ended = f"Run {name} ended in a {word} at step {count(run.steps)} and run {other} did not"
    if run.decision is None or fork is None:
        return f"{ended}: that is the fork."
    return f"{ended}; they fork at step {count(fork)}."


def _evidence(run: ForkFolder) -> Iterator[str]:
    length = run.units.length
    reasons = [str(reason) for reason in run.summary.get("reasons") or ()]
    told = "; ".join(reasons).replace("; and ", ", and ").replace("the first run's", "A’s")
    if told:
        yield sentence(typeset(told))
    made = run.decision
    if made is not None:
        yield decided(made, length)
    rate = run.summary.get("growth_rate")
    if rate is not None and (run.summary.get("r_squared") or 0.0) >= FITS:
        fits = number(run.summary.get("r_squared"), 3)
        yield (
            f"The separation grows by {number(rate, 2)} of itself a step, "
            f"{number(run.summary.get('growth_rate_time'), 2)} per {run.units.time} (r² {fits})."
        )


def decided(made: Mapping[str, Any], length: str) -> str:
    """The decision at the fork, in a sentence or two."""
    pair = f"{made['i']}–{made['j']}"
    if made["run"] == "start":
        what = f"Pair {pair} is decided differently from the start on"
    else:
        way = "enters its cutoff" if made["entered"] else "leaves its cutoff"
        what = f"Pair {pair} {way} in run {made['run']} alone at step {count(made['step'])}"
    text = f"{what}, {number(abs(made['margin_length']), 2)} {length} from it; {_doubt(made)}."
    if made.get("protected") is not None:
        text += (
            f" The step before, the runs were {number(made['separation_before'], 2)} {length} apart: "
            f"the margin is {number(made['protected'], 2)} of that."
        )
    return text


def _doubt(made: Mapping[str, Any]) -> str:
    """In which run rounding alone could have decided otherwise."""
    names = made.get("ambiguous_in")
    if names is None:
        names = [made["run"]] if made["ambiguous"] else []
    if not names:
        return "in neither run could rounding alone have decided otherwise"
    where = "either run" if len(names) > 1 else f"run {names[0]}"
    return f"in {where} it was ambiguous: rounding alone could have decided otherwise"


def _findings(run: ForkFolder) -> Iterator[Finding]:
    summary, dates = run.summary, run.dates
    if summary.get("must_hold") and "seed" in dates:
        yield _broken(summary, "Report it with this folder.")
    for name, word in (summary.get("failed") or {}).items():
        yield Finding(
            "RUN_FAILED",
            "warning",
            f"run {name} ended in a {word} at step {count(run.steps)}",
            f"The comparison ends there, {count(summary.get('steps_asked'))} steps were asked for.",
            "Use a smaller time step, or look at the decisions before it.",
        )
    made = run.decision
    doubtful = [] if made is None else made.get("ambiguous_in") or (["A"] if made["ambiguous"] else [])
    if made is not None and doubtful:
        sizes = [
            f"{number(abs(made['margins'][name]), 2)} of {number(made['bounds'][name], 2)} in {name}"
            for name in doubtful
            if name in (made.get("margins") or {})
        ]
        yield Finding(
            "AMBIGUOUS_FORK",
            "info",
            f"the decision at the fork is ambiguous: pair {made['i']}–{made['j']}",
            "Its margin is within the rounding bound of the computed quantity"
            f"{': ' + listed(sizes) if sizes else ''}.",
        )
    if "fork" in dates and "split" not in dates and not summary.get("failed"):
        guess = summary.get("predicted_split")
        text = (
            f"After {many(run.steps, 'step')} the runs are {number(summary.get('separation_end'), 3)} "
            f"{run.units.length} apart, the tolerance is {number(summary.get('tolerance'), 3)}."
        )
        more = f"Follow more than {count(guess)} steps." if guess else "Follow more steps."
        yield Finding("HORIZON_SHORT", "info", "the horizon is too short for a split", text, more)
    until = summary.get("handed_until")
    if until is not None and until < run.steps and not summary.get("failed"):
        word = (summary.get("failed_told") or {}).get("B|A")
        yield Finding(
            "GUARD",
            "info",
            f"the run under A’s decisions was ended at step {count(until)}",
            f"It was on its way to a {word}."
            if word
            else "A decision that it was told was no longer near its threshold in its own positions: "
            "nothing that rounding could have changed.",
        )
    yield from unclear(run)


def unclear(run: ForkFolder) -> Iterator[Finding]:
    """A verdict that the repeats leave open."""
    found = run.summary.get("count")
    if run.word != "undecided" or not found:
        return
    need = found["needed"]
    clear = "no number of them could be" if need is None else f"{count(need[1])} of {count(need[0])} would be"
    more = max(REPEATS, 2 * (found["most"] - 1))
    yield Finding(
        "UNDECIDED",
        "info",
        "the repeats do not tell what the flips did" if found["pairs"] > 1 else "no repeats were run",
        f"{agreeing(run)}, which is not clear: {clear}.",
        f"Allow more: --repeats {more}." if more > found["most"] - 1 else "",
    )


def chance(run: ForkFolder) -> str | None:
    """What repeats were compared; None where none were."""
    found = run.summary.get("count")
    if not found or found["pairs"] < 2:
        return None
    return (
        f"{many(found['pairs'] - 1, 'repeat')}, free and under A’s decisions; with the pair {agreeing(run)}"
    )


def _broken(one: Mapping[str, Any], remedy: str) -> Finding:
    """A choice that cannot change a bit by design, and did."""
    fork = one.get("fork")
    what = (
        f"forks at step {count(fork)}" if fork is not None else f"differs from step {count(one['seed'])} on"
    )
    return Finding(
        "MUST_HOLD_FORKED",
        "error",
        f"{one['choice']} must not change a bit, and {what}",
        f"This choice ({one.get('difference')}) is one that arithmetic cannot notice by design: "
        "a promise is broken.",
        remedy,
    )


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else text + "."


# --- all choices --------------------------------------------------------------------------------------


def _ranked(run: ForkFolder) -> str:
    rows = run.ranking
    forked = [one for one in rows if one.get("fork") is not None]
    bad = [one for one in rows if one.get("must_hold") and one.get("seed") is not None]
    if bad:
        names = listed([str(one["choice"]) for one in bad])
        return f"{names} must not change a bit, and {'does' if len(bad) == 1 else 'do'}."
    if not forked:
        return f"None of {many(len(rows), 'choice')} forks in {many(run.steps, 'step')}."
    first = forked[0]
    return (
        f"{len(forked)} of {many(len(rows), 'choice')} fork in {many(run.steps, 'step')}; "
        f"{first['choice']} first, at step {count(first['fork'])}."
    )


def _screened(run: ForkFolder) -> Iterator[Finding]:
    for one in run.ranking:
        if one.get("must_hold") and one.get("seed") is not None:
            yield _broken(one, f"Follow it alone: --vary {one['choice']}.")
        if one.get("failed"):
            yield Finding(
                "RUN_FAILED",
                "warning",
                f"{one['choice']}: {one['failed']}",
                f"At step {count(one.get('steps'))}, which is where its comparison ends.",
            )
