"""A sum, addition by addition: what was added, what the accumulator held, what was lost.

On the host and exact: every float is a rational number, so the true sum of the terms so far stands next to
the running sum. The arithmetic is that of the reduction in the dtype of the terms; the last row has the
bits that the reduction gives inside jit, with two exceptions. XLA on a CPU flushes subnormals of every
dtype but float16 to zero, the host keeps them. And the orders that stream in the force loop of molecular
dynamics (sequential, pairwise) add there products that XLA contracts into the sum, one rounding less per
term, so that their last digits may differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import jax
import ml_dtypes
import numpy as np
from jaxtyping import Float
from numpy.typing import DTypeLike

from mdnum.errors import InputError
from mdnum.numerics.sums import Permuted, Reduction, Sequential, Sorted, Whole


@dataclass(frozen=True)
class Addition:
    """One addition.

    Attributes:
        term: index of the term that was added.
        addend: what was added to the accumulator.
        running: the accumulator afterwards.
        exact: the sum of the terms so far.
        bits_lost: binary digits of the exact result of this addition below the last place that was kept;
            0 where the addition was exact.
        absorbed: a nonzero addend left no trace.
    """

    term: str
    addend: float
    running: float
    exact: Fraction
    bits_lost: int
    absorbed: bool


@dataclass(frozen=True)
class RunningSum:
    """A sum with its history.

    Attributes:
        dtype: of the terms and of the accumulator.
        reduction: the order.
        rows: one per addition.
        result: what the reduction gives.
        exact: the sum of the terms.
    """

    dtype: str
    reduction: Any
    rows: tuple[Addition, ...]
    result: float
    exact: Fraction

    @property
    def error(self) -> float:
        """Result minus exact sum, to float64."""
        return float(Fraction(self.result) - self.exact)

    @property
    def bits_lost(self) -> int:
        """Over all additions."""
        return sum(row.bits_lost for row in self.rows)

    columns = ("term", "addend", "running sum", "exact sum", "bits lost")

    def table(self) -> tuple[tuple[Any, ...], ...]:
        """Plain rows under `columns`, floats as the shortest decimals that give the same float64."""
        return tuple(
            (row.term, row.addend, row.running, float(row.exact), row.bits_lost) for row in self.rows
        )

    def text(self) -> str:
        """The table for a terminal."""
        cells = [
            self.columns,
            *([f"{c:.13g}" if isinstance(c, float) else str(c) for c in row] for row in self.table()),
        ]
        widths = [max(len(row[k]) for row in cells) for k in range(len(self.columns))]
        return "\n".join("  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells)


def running_sum_table(
    terms: Any, reduction: Reduction = Sequential(), dtype: DTypeLike | None = None
) -> RunningSum:
    """The history of a sum in the order of a reduction.

    Args:
        terms: the numbers, shape (n,).
        reduction: a loop: sequential, reversed, permuted or sorted.
        dtype: terms are rounded to it first; that of the terms where None.

    Raises:
        InputError: no terms, a number that is not finite, or a reduction that is no loop.
    """
    terms = np.asarray(terms)
    terms = terms.astype(np.dtype(dtype) if dtype is not None else terms.dtype)
    if terms.ndim != 1 or len(terms) == 0:
        raise InputError(f"terms of shape {terms.shape}", remedy="Give one axis with at least one term.")
    if not np.isfinite(terms.astype(np.float64)).all():
        raise InputError("a term is not finite, so the sum has no history")
    with np.errstate(all="ignore"):
        rows = tuple(_loop(terms, _order(reduction, terms)))
    exact = sum((Fraction(float(t)) for t in terms), Fraction(0))
    return RunningSum(str(terms.dtype), reduction, rows, rows[-1].running, exact)


def _place(x: Any) -> int:
    """Exponent of the last place of a float: x is a multiple of 2^place."""
    info = ml_dtypes.finfo(x.dtype)
    exponent = math.frexp(float(x))[1] - 1 if x else info.minexp
    return max(exponent, int(info.minexp)) - info.nmant


def _lowest(value: Fraction) -> int:
    """Exponent of the lowest binary digit of a dyadic rational."""
    numerator, denominator = abs(value.numerator), value.denominator
    return (numerator & -numerator).bit_length() - denominator.bit_length()


def _lost(true: Fraction, kept: Fraction, place: int) -> int:
    return 0 if true == kept else max(1, place - _lowest(true))


def _loop(terms: np.ndarray, order: Sequence[int]) -> Iterator[Addition]:
    total, exact = terms.dtype.type(0), Fraction(0)
    for k in order:
        new = total + terms[k]
        true = Fraction(float(total)) + Fraction(float(terms[k]))
        exact += Fraction(float(terms[k]))
        yield Addition(
            str(k),
            float(terms[k]),
            float(new),
            exact,
            _lost(true, Fraction(float(new)), _place(new)) if np.isfinite(new) else 0,
            bool(new == total and terms[k] != 0),
        )
        total = new


def _order(reduction: Any, terms: np.ndarray) -> Sequence[int]:
    match reduction:
        case Sequential():
            return range(len(terms))[:: -1 if reduction.order == "reversed" else 1]
        case Permuted():
            return np.random.default_rng(reduction.seed).permutation(len(terms)).tolist()
        case Sorted():
            wide = terms.astype(np.float64)
            order = np.lexsort((wide, np.abs(wide))).tolist()
            return order if reduction.order == "ascending" else order[::-1]
    raise InputError(
        f"{reduction} is no loop over the terms", remedy="Give sequential, reversed, permuted or sorted"
    )


@dataclass(frozen=True, eq=False)
class Tap(Whole):
    """A reduction that keeps the terms it was given, for a look at a sum inside a compiled program.

    Put it where a reduction goes (in the force of molecular dynamics, say), run once, and read `seen`: one
    array of shape (n, ...) for every sum that was made, in the order in which the program makes them. Not
    for long runs: everything is kept.

    Attributes:
        inner: the order of the sum.
        seen: the terms of every sum.
    """

    inner: Reduction
    seen: list[Float[np.ndarray, "n ..."]] = field(default_factory=list)

    def sum_of(self, terms, add):
        """As the inner reduction; the terms are handed to the host on the way."""
        jax.debug.callback(lambda t: self.seen.append(np.array(t)), terms, ordered=True)
        return self.inner(terms)

    def bound(self, terms):
        """As the inner reduction."""
        return self.inner.bound(terms)
