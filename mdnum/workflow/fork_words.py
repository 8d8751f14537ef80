"""Sentences of forks: what two folders, a ranking of precisions and a map along a number amount to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mdnum.forks.boundaries import BoundaryMap
from mdnum.forks.exact.certify import Certificate, PolicyHorizon
from mdnum.forks.folders import Difference, FolderFork, StoredFlip
from mdnum.precision.policy import WIDE

#: Of the provenance, what bits depend on.
_ARITHMETIC = ("versions", "cpu", "devices", "jax_settings", "environment")
#: A share of what double precision gains that counts as nothing, and bits of error that do.
_NOTHING, _NO_BITS = 0.05, 1.0


def folder_reasons(found: FolderFork) -> Iterator[str]:
    """What can be concluded from two folders, and what cannot."""
    if found.world == "ball":
        yield from _ball_folders(found)
        return
    choices = [cause for cause in found.causes if cause not in ("start", "arithmetic")]
    starts = [row for row in found.differences if row[0].startswith("start: ")]
    arithmetic = [row for row in found.differences if row[0].partition(".")[0] in _ARITHMETIC]
    yield from _attributed(choices, starts, arithmetic)
    yield from _dated(found.steps, found.seed, found.fork, found.decisions)


def _attributed(choices: list[str], starts: list[Difference], arithmetic: list[Difference]) -> Iterator[str]:
    """What parting may be put down to."""
    things = [*choices]
    if starts:
        things.append("the start")
    if arithmetic:
        things.append("versions, flags or machine")
    if len(things) > 1:
        listed = ", ".join(things[:6]) + (", ..." if len(things) > 6 else "")
        yield f"the runs differ in {len(things)} things ({listed}): a fork cannot be put down to one choice"
    elif choices:
        yield f"the runs differ in one choice, {choices[0]}"
    elif starts:
        yield "the programs are the same and the starts are not"
    elif arithmetic:
        yield f"the system is the same; what bits depend on differs in {len(arithmetic)} points"
    else:
        yield "nothing on record differs: runs like these should agree bit for bit"
    if starts:
        what = " and ".join(key.removeprefix("start: ") for key, _, _ in starts)
        yield f"they begin otherwise ({what}), so the seed is step 0"


def _dated(
    steps: int, seed: int | None, fork: int | None, decisions: tuple[StoredFlip, ...]
) -> Iterator[str]:
    """Where they part."""
    if seed is None:
        yield f"no stored number differs in {steps} steps"
    else:
        yield f"the first stored number that differs is that of step {seed}"
    if fork is None:
        yield f"no decision differs in {steps} steps"
    elif not decisions:
        yield "the pairs inside differ at the start already"
    else:
        flip = decisions[0]
        i, j = flip.subject
        verb = "entered" if flip.entered else "left"
        yield (
            f"at step {fork} pair {i}-{j} {verb} in {flip.run} only, "
            f"{abs(flip.margin):.2g} from the threshold (rounding bound {flip.bound:.1g})"
        )
        yield (
            "when they split, and whether this was the cause, is told by following both again: "
            "`mdnum fork RUN_A RUN_B --replay`"
        )


def _ball_folders(found: FolderFork) -> Iterator[str]:
    steps, seed, fork, channel = found.steps, found.seed, found.fork, found.channel
    different = [row for row in found.differences if row[0].partition(".")[0] not in _ARITHMETIC]
    if seed is None and fork is None:
        yield f"No stored number differs in {steps:,} steps."
    elif fork is None:
        yield f"Bits differ from step {seed:,} on, but no decision does in {steps:,} steps."
    else:
        what = "a contact differs" if channel == "contact" else "the iterations of a solver differ"
        yield f"The runs fork at step {fork:,}: {what}."
    if len(different) > 1:
        yield (
            f"They differ in {len(different)} keys of their system files: a fork cannot be put down to one."
        )
    elif not different:
        yield "Their system files say the same: versions, flags or the machine are another."
    yield "Whether the decision was the cause is asked of the system: mdnum fork SYSTEM --vary CHOICE."


def md_ranking(found: Certificate) -> tuple[str, ...]:
    """What a ranking of molecular dynamics means."""
    rows, last, per_bit = found.ranking, found.steps, found.steps_per_bit
    base = next((row for row in rows if row.is_all("float32")), None)
    wide = next((row for row in rows if row.is_all("float64")), None)
    at_most = "" if wide is not None and wide.horizon is not None else "at most "
    sentences = []
    for row in rows:
        kept = (
            f"keeps every decision of the exact history up to step {last}"
            if row.horizon is None
            else f"leaves the exact history at step {row.horizon}"
        )
        sentence = f"{row.name} {kept}"
        if row.failed:
            sentence += f" (its run ended in a {row.failed})"
        other = not (row.is_all("float32") or row.is_all("float64"))
        if other and row.roles["force"] not in WIDE and base is not None and base.horizon is not None:
            sentence += ": " + _lost(row, base.horizon)
        elif other and base is not None and base.horizon is not None:
            sentence += ": " + _gained(row, base.horizon, last, at_most)
        sentences.append(sentence + ".")
    if np.isfinite(per_bit):
        sentences.append(f"One more bit in every number is worth about {per_bit:.0f} steps here.")
    return tuple(sentences)


def _lost(row: PolicyHorizon, base: int) -> str:
    """What sixteen bits cost, against single precision throughout."""
    if row.horizon is None or row.horizon >= base:
        return f"{row.roles['force']} pair forces cost nothing here that single precision does not"
    lost = (
        f"{row.roles['force']} pair forces cost {base - row.horizon} of the {base} steps of single precision"
    )
    return lost if np.isnan(row.closer) else f"{lost}; its positions are {-row.closer:.1f} bits further off"


def _gained(row: PolicyHorizon, base: int, last: int, at_most: str) -> str:
    bits = _bits_closer(row.closer)
    if row.horizon is None:
        return f"the promotion gains {last - base} steps or more, and {bits}"
    if row.horizon <= base:
        nothing = "no step" if row.closer >= _NO_BITS else "nothing"
        earlier = f"{base - row.horizon} steps earlier than" if row.horizon < base else "at the same step as"
        return f"the promotion gains {nothing}: it leaves {earlier} single precision, and {bits}"
    share = f"{row.horizon - base:+d} steps"
    if np.isfinite(row.gain):
        share += f", {at_most}{row.gain:.0%} of what double precision throughout gains"
    # a horizon hangs on one pair; what is not closer to the exact run was lucky, not better
    if row.closer < _NO_BITS:
        if row.gain < _NOTHING:
            return f"the promotion gains nothing ({share}; {bits})"
        return f"one decision came out right, and that is all the promotion gains ({share}; {bits})"
    return f"the promotion gains {share}; {bits}"


def _bits_closer(closer: float) -> str:
    """By how much positions are closer to the exact ones, or further off, in words."""
    if np.isnan(closer):
        return "how close its positions are to the exact ones is not known"
    if abs(closer) < 0.05:
        return "its positions are as far from the exact ones"
    where = "closer to" if closer > 0 else "further from"
    return f"its positions are {abs(closer):.1f} bits {where} the exact ones"


def ball_ranking(found: Certificate) -> list[str]:
    """What a ranking of a ball means."""
    rows, steps = found.ranking, found.steps
    ran = [row for row in rows if row.reason_unavailable is None]
    kept = [row.name for row in ran if row.horizon is None]
    left = [f"{row.name} at step {row.horizon:,}" for row in ran if row.horizon is not None]
    said = []
    if kept:
        said.append(f"Decide as exact arithmetic does in all {steps:,} steps: {', '.join(kept)}.")
    if left:
        said.append(f"Leave the exact history: {', '.join(left)}.")
    by_name = {row.name: row for row in ran}
    whole, decision = by_name.get("float32"), by_name.get("decision in float32")
    if whole is not None and decision is not None and whole.horizon is not None and decision.horizon is None:
        said.append("Decisions alone in float32 cost nothing: what they compare was in float64.")
    return said


def map_words(found: BoundaryMap) -> str:
    """A map in one sentence, with what it cannot know."""
    text = (
        f"{_many(len(found.boundaries), 'boundary', 'boundaries')} and "
        f"{_many(found.histories, 'history', 'histories')} of {found.steps} steps between "
        f"{found.number.key} = {found.low!r} and {found.high!r}"
    )
    if found.unresolved:
        more = _many(len(found.unresolved), "more stretch holds", "more stretches hold")
        text += f"; {more} boundaries that were not searched for"
    if found.complete:
        return text + "; every float was run"
    return text + f"; pairs of boundaries closer than {found.resolution:.2g} may be missed"


def _many(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"
