"""Verdict and findings on a neighbor list, from its folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, verdict
from mdnum.report.verdict import Finding
from mdnum.report.words import count, listed, many, number, typeset

#: (severity, title, remedy) by the code of a failure.
_CODES: Mapping[str, tuple[str, str, str]] = {
    "CRASHED": (
        "error", "the process ends",
        "Check what it divides by and allocates; a program that calls it loses its run.",
    ),
    "MISSING": (
        "error", "pairs inside the cutoff are missing",
        "Do not run with it on such input: energies are wrong without a word.",
    ),
    "EXTRA": (
        "error", "pairs beyond the cutoff are listed",
        "Test the distance in whatever sums over it, or do not use it on such input.",
    ),
    "DUPLICATE": (
        "error", "pairs are listed more than once", "A sum over it counts such pairs twice.",
    ),
    "SELF": ("error", "atoms are listed as their own neighbors", "Leave out i = j without a shift."),
    "RANGE": (
        "error", "atoms are named that do not exist",
        "Cut padding off before the list is handed on; what reads it reads other memory.",
    ),
    "ONE_SIDED": (
        "error", "pairs are listed from one of their atoms only",
        "Decide each pair once and list it both ways: forces on the two atoms differ else.",
    ),
    "SHIFTS": (
        "error", "the images are wrong",
        "Say whether shifts are for positions as given or wrapped, and return those for positions as given.",
    ),
    "DISTANCES": ("error", "distances are wrong", "Compute |x_j - x_i + shift @ cell|."),
    "VECTORS": ("error", "vectors are wrong", "Compute x_j - x_i + shift @ cell."),
    "MALFORMED": (
        "error", "what is returned is no list of pairs",
        "Return (i, j), (i, j, shift), ... or a mapping with i and j, whole numbers of equal length.",
    ),
    "CHANGED_INPUT": ("warning", "the input is written to", "Copy before wrapping in place."),
    "NO_ANSWER": (
        "warning",
        "no answer comes in time",
        "Look at what its time and memory grow with: empty space, a long cutoff, a unit of length.",
    ),
    "RAISED": (
        "warning", "an exception, for input that has an answer",
        "Answer it, or say in a ValueError what cannot be done.",
    ),
}  # fmt: skip


#: What became of a case in which nothing came back, by the code of it.
_SILENT = {
    "CRASHED": "ends the process",
    "NO_ANSWER": "gives no answer in time",
    "RAISED": "raises an exception by accident",
}


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of an examination."""
    summary = run.summary
    findings = list(_findings(run))
    left = int(summary.get("left", 0))
    all_of_them = "all of " if not left else ""
    answered, failed = _answered(summary), int(summary["wrong"])
    none = failed and all(silent(row) == row["failed"] for row in summary["areas"])
    if left and not summary["asked"]:
        said = "was asked nothing"
    elif not answered:
        said = "answered no question"
    elif not failed:
        said = f"gave the right pairs in {all_of_them}{many(answered, 'case')}"
    elif none:
        right = sum(row["passed"] for row in summary["areas"])
        counts = [(words, _cases(summary, code)) for code, words in _SILENT.items()]
        told = [f"{words} in {count(cases)}" for words, cases in counts if cases]
        said = f"{listed(told)} of {many(summary['asked'], 'case')}; "
        said += f"in the {count(right)} that it answered, the pairs are right" if right else "none is right"
    else:
        said = f"failed {count(failed)} of {many(summary['asked'], 'case')}"
    headline = f"{run.name} {said}."
    if left:
        asked = int(summary["questions"]) - left
        headline = f"As far as asked ({count(asked)} of {many(summary['questions'], 'case')}), {headline}"
    return verdict(headline, _evidence(run), findings, plain_tone="good", judged=True)


def silent(row: Mapping[str, Any]) -> int:
    """Failed cases of an area in which nothing came back that could be wrong."""
    return sum(number for code, number in row["codes"].items() if code in _SILENT)


def _cases(summary: Mapping[str, Any], code: str) -> int:
    """Cases whose worst failure has a code."""
    return sum(row["codes"].get(code, 0) for row in summary["areas"])


def _answered(summary: Mapping[str, Any]) -> int:
    """Cases that it did anything else in than raise an exception, on purpose or not."""
    raised = sum(row["refused"] + row["codes"].get("RAISED", 0) for row in summary["areas"])
    return summary["asked"] - raised


def _evidence(run: Question) -> Iterator[str]:
    summary = run.summary
    wrong = [row for row in summary["areas"] if row["failed"]]
    if wrong:
        worst = sorted(wrong, key=lambda row: -row["failed"])[:4]
        parts = [f"{row['area']} ({count(row['failed'])} of {count(row['asked'])})" for row in worst]
        yield f"Where it fails: {listed(parts)}."
    scripts = len(summary["failures"])
    if scripts:
        least = min(row["atoms"] for row in summary["failures"])
        yield (
            f"{many(scripts, 'script')} beside this page reproduce{'s' * (scripts == 1)} the failures "
            f"without mdnum, the smallest with {many(least, 'atom')}."
        )
    yield from _rule(summary)
    if summary.get("status") == "stopped":
        yield f"It was stopped; `mdnum conform --resume {run.path.name}` goes on with it."
    refused = sum(row["refused"] for row in summary["areas"])
    skipped = sum(row["skipped"] for row in summary["areas"])
    told = [f"it refused {many(refused, 'case')}"] * bool(refused)
    if skipped:
        was, them = ("was", "it") if skipped == 1 else ("were", "them")
        told.append(f"{many(skipped, 'case')} {was} not asked, because it does not claim to do {them}")
    if told:
        words = "; ".join(told)
        yield f"{words[:1].upper()}{words[1:]}."


def _rule(summary: Mapping[str, Any]) -> Iterator[str]:
    """What was asked of the rule by which a list that is kept is rebuilt."""
    asked = summary.get("rule") or {}
    if not asked.get("motions"):
        return
    tried = many(asked["motions"], "motion") + " against its rebuild rule"
    tried = f"{tried} ({many(asked['calls'], 'call')})"
    failed = sum(row["failed"] for row in summary["areas"] if row["area"] == "rule")
    if failed:
        yield f"{tried}: it lets pairs through."
        return
    padding = summary.get("padding")
    if padding is None:
        reach = "it shows no pairs of its skin, so starts from 0.25 to 3 skins beyond the cutoff were tried"
    else:
        how = "as it says" if summary.get("padding_said") else "as its pairs show"
        reach = f"its list reaches {number(padding, 3)} of the skin beyond the cutoff, {how}"
    yield (
        f"{tried}, each the smallest that takes a pair from 0.2 % of the skin beyond the list to 0.2 % of it "
        f"inside the cutoff, lost no pair; {reach}."
    )


def conventions(run: Question) -> Iterator[tuple[str, str]]:
    """What kind of list it is: (what, words)."""
    summary = run.summary
    more = ", with pairs of its skin" if summary["superset"] and summary["kept"] else ""
    more = more or (", with pairs beyond the cutoff" if summary["superset"] else "")
    both = "every pair from both of its atoms" if summary["full"] else "every pair once"
    yield "Lists", f"{both}{more}"
    if summary["shifts"]:
        yield "Shifts", "added to atom j" if summary["shift_sign"] > 0 else "added to atom i"
    else:
        yield "Shifts", "none given: images are counted, and not told apart"
    yield "Decides in", summary["precision"]
    ties = summary["ties"]
    if ties["counted"] or ties["not_counted"]:
        yield "At exactly the cutoff", _ties(ties)
    if summary["keeps_order"] is not None:
        yield "Asked again", "same rows, same order" if summary["keeps_order"] else "other order of rows"


def _ties(ties: Mapping[str, int]) -> str:
    if not ties["not_counted"]:
        return "counts as inside (r ≤ r_cut)"
    if not ties["counted"]:
        return "does not count (r < r_cut)"
    return f"{count(ties['counted'])} pairs count, {count(ties['not_counted'])} do not"


def _findings(run: Question) -> Iterator[Finding]:
    summary = run.summary
    by_code: dict[str, list[Mapping[str, Any]]] = {}
    for row in summary["failures"]:
        by_code.setdefault(row["code"], []).append(row)
    below = _below(by_code)
    for code, rows in by_code.items():
        if code in below:
            continue
        severity, title, remedy = _CODES[code]
        # one that fails by itself says more than a smaller one that does not
        first = min(rows, key=lambda row: (not row["alone"], row["atoms"], row["steps"]))
        if code == "CRASHED" and any("exit" in row["text"].lower() for row in rows):
            remedy = "Raise an exception instead: a program that calls it ends with it and loses its run."
        text = f"In {many(_cases(summary, code), 'case')}, {_about(summary, code)}. {_sentence(first)} "
        text += f"Reproduced by {first['script']}."
        if code == "ONE_SIDED" and all(row["text"].startswith("within rounding") for row in rows):
            severity, title = "warning", "pairs within rounding of the cutoff are listed from one atom only"
        if code in summary.get("known", {}):
            text += f" {summary['known'][code]}"
        if not first["alone"]:
            text += " It fails only after other questions, so the script alone may not show it."
        for other in [other for other, cause in below.items() if cause == code]:
            text += (
                f" After such questions, and not by themselves, {many(_cases(summary, other), 'case')} fail "
            )
            text += (
                f"otherwise: {_CODES[other][1]} ({_about(summary, other)}; {by_code[other][0]['script']})."
            )
        yield Finding(code, severity, title, text, remedy)  # type: ignore[arg-type]
    yield from _conduct(run)


def _below(by_code: Mapping[str, list[Mapping[str, Any]]]) -> dict[str, str]:
    """Codes that are met only after other questions, by the code of what failed by itself and is as bad."""
    causes = [code for code, rows in by_code.items() if any(row["alone"] for row in rows)]
    found = {}
    for code, rows in by_code.items():
        as_bad = [
            cause for cause in causes if _CODES[cause][0] == "error" or _CODES[cause][0] == _CODES[code][0]
        ]
        if as_bad and not any(row["alone"] for row in rows):
            found[code] = as_bad[0]
    return found


def _quoted(words: str) -> str:
    """What an exception said, to stand before a comma or a stop."""
    return words.rstrip(". ")


def _hangs_on(refusal: Mapping[str, Any], quoted: str) -> str:
    """A sentence on what is answered of a question that was refused; nothing where nothing is."""
    if not refusal["answers"]:
        return ""
    why = _quoted(refusal["why"])
    told = f"Asked about {refusal['case']}" if why in quoted else f"{why} ({refusal['case']})"
    return f" {told}: the same is answered {listed(refusal['answers'])}."


def _about(summary: Mapping[str, Any], code: str) -> str:
    """The areas with cases whose worst failure has a code."""
    areas = [row["area"] for row in summary["areas"] if row["codes"].get(code)]
    asked = [row for row in summary["areas"] if row["asked"]]
    if len(areas) == len(asked) > 2:
        return "in every area"
    return f"about {listed(areas)}"


def _sentence(row: Mapping[str, Any]) -> str:
    where = f"{many(row['atoms'], 'atom')}" + (f", step {row['step']}" if row["steps"] > 1 else "")
    return f"{where[:1].upper()}{where[1:]} ({row['case']}): {typeset(_quoted(row['text']))}."


def _conduct(run: Question) -> Iterator[Finding]:
    """What is nobody's mistake and good to know."""
    summary = run.summary
    ties = summary["ties"]
    if ties["counted"] and ties["not_counted"]:
        yield Finding(
            "TIES",
            "info",
            "pairs at exactly the cutoff are decided one way and the other",
            f"Whole numbers, whose distances need no rounding: {_ties(ties)}.",
            "Compare squares of distances, or distances, in one place.",
        )
    if "float32" in summary["found_out"]:
        yield Finding(
            "SINGLE_PRECISION",
            "info",
            "decisions are those of single precision",
            f"Its decisions are those of float32 and not those of float64, first in: {summary['single']}. "
            "It was judged by the rounding of float32 from there on.",
            "Expect other pairs near the cutoff than in a code that works in float64.",
        )
    if summary["keeps_order"] is False:
        yield Finding(
            "ORDER",
            "info",
            "the same question has its rows in another order each time",
            "Sums over the list then differ in their last bits from call to call.",
            "Sort the rows where runs have to repeat bit for bit.",
        )
    if summary.get("aliased") is not None:
        yield Finding(
            "ALIASED",
            "info",
            "an answer changes when the list is asked again",
            "The arrays that it returns are its own buffers, and the next call writes to them: first seen "
            f"when it was asked {summary['aliased']}. Answers were copied before that, and judged as they "
            "were.",
            "Copy them if they are to be kept, to compare two steps or for a thread of its own.",
        )
    for one in summary.get("refusals", ()):
        if one["uneven"]:
            yield Finding(
                "UNEVEN_REFUSALS",
                "warning",
                "a question is refused and the same question is answered",
                f"{_quoted(one['why'])} ({one['case']}); but it answers the same {listed(one['uneven'])}.",
                "Refuse by what is asked, and not by the order of atoms or by what was asked before.",
            )
    refused = [(row, one) for row in summary["areas"] for one in row["why"] if row["refused"]]
    refused = [(row, one) for row, one in refused if ": " in one["why"]]
    total = sum(area["refused"] for area in summary["areas"])
    often = ""
    if refused:
        row, one = max(refused, key=lambda each: each[1]["cases"])
        often = f"Most often: {_quoted(one['why'])}, about {row['area']}."
    if not _answered(summary):
        yield Finding(
            "NOTHING_ANSWERED",
            "error",
            "no question was answered",
            f"Nothing is known about it. {often}".strip(),
            "Ask it about fewer things with --limits, or look at what it raises."
            if summary["asked"] or not summary.get("left")
            else "Give it more time, or go on with --resume.",
        )
    elif refused:
        many_of_them = total > 0.2 * summary["asked"]
        yield Finding(
            "REFUSES",
            "warning" if many_of_them else "info",
            f"{many(total, 'case')} refused",
            f"It raises an exception of its own there, so nothing is computed with wrong pairs. {often}"
            + "".join(_hangs_on(one, often) for one in summary.get("refusals", ())),
            "Declare what it does not do with --limits, and the rest is asked." if many_of_them else "",
        )
