"""Questions that a list refused, told in another way: what of the telling the refusal hangs on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.lists import completed

if TYPE_CHECKING:
    from mdnum.references.conformance.suite import Examiner

#: Refusals that are looked into; a list with more kinds of them has other worries.
_KINDS = 6


@dataclass(frozen=True)
class Refusal:
    """A kind of question that a list refuses.

    Attributes:
        words: the exception.
        case: the smallest question that met it, up to the step that was refused.
        uneven: how the same question was answered where no list has a reason to treat it differently.
        answers: how it was answered where a list may treat it differently: another unit of length, other
            images of the atoms.
    """

    words: str
    case: Case
    uneven: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()


def looked_into(examiner: Examiner, refused: dict[str, Case]) -> list[Refusal]:
    """Each kind of refusal, with what is answered of the same question told in another way.

    Args:
        examiner: asks the list; a new process, or a new object, for each question.
        refused: a refused case by the words of the exception.
    """
    found = []
    for words, case in list(refused.items())[:_KINDS]:
        uneven, answers = [], []
        for told, even, other in alike(case):
            if examiner.tested.limits.refusal(other) is not None:
                continue
            examiner.session.close()
            outcomes = examiner.session.ask(other)
            if len(outcomes) == other.steps and outcomes[-1].answer is not None:
                (uneven if even else answers).append(told)
        found.append(Refusal(words, case, tuple(uneven), tuple(answers)))
    return found


def alike(case: Case) -> Iterator[tuple[str, bool, Case]]:
    """(how it is told, whether that should make no difference, the question)."""
    yield "when it is asked anew", True, case
    if case.atoms > 1:
        yield "with its atoms in reverse order", True, case.only(np.arange(case.atoms)[::-1])
    if case.steps > 1:
        yield "of a list that is made anew at that step", False, replace(case, stills=case.stills[-1:])
    power = float(np.ldexp(1.0, 1 - int(np.frexp(case.r_cut)[1])))
    if power != 1.0:
        yield f"with all lengths multiplied by {power:.2g}", False, _scaled(case, power)
    at_home = tuple(_wrapped(one, np.array(case.pbc)) for one in case.stills)
    if any(not np.array_equal(a.positions, b.positions) for a, b in zip(at_home, case.stills, strict=True)):
        yield "with its atoms wrapped into the box", False, replace(case, stills=at_home, known=None)


def _scaled(case: Case, power: float) -> Case:
    """All lengths multiplied by a power of two, which rounds nothing."""
    stills = tuple(
        replace(
            one,
            positions=power * one.positions,
            cell=power * one.cell,
            skin=None if one.skin is None else power * one.skin,
        )
        for one in case.stills
    )
    return replace(case, stills=stills, r_cut=power * case.r_cut, skin=power * case.skin, known=None)


def _wrapped(still: Still, pbc: np.ndarray) -> Still:
    """The same atoms in the images that lie in the box."""
    if not pbc.any() or not len(still.positions):
        return still
    matrix = completed(still.cell, pbc)
    fractions = np.linalg.solve(matrix.T, still.positions.T).T
    home = still.positions - np.where(pbc, np.floor(fractions), 0.0) @ matrix
    # an atom a hair below a face is wrapped onto the one across, by rounding
    over = np.where(pbc, np.linalg.solve(matrix.T, home.T).T >= 1.0, False)
    return replace(still, positions=home - np.where(over, 1.0, 0.0) @ matrix)
