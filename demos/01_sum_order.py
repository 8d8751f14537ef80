"""The order of a float16 sum of five terms determines whether a solver stops."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from numpy.typing import DTypeLike

from mdnum.ball import BallRun, GlobalSum, Projection, SemiImplicitEuler, World, simulate
from mdnum.errors import InputError
from mdnum.numerics.reductions import BY_NAME
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Reduction
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: The tolerance, and five penetrations (m) whose exact sum it is: one just below it and four that are each
#: a quarter of its last place.
TOL = 2.0**-10
LARGE = TOL - 2.0**-21
SMALL = 2.0**-23
TERMS = np.array([LARGE, SMALL, SMALL, SMALL, SMALL], np.float16)


@dataclass(frozen=True)
class Addition:
    """One addition in the history of a sum."""

    term: str  # index of the term that was added
    addend: float  # what was added to the accumulator
    running: float  # the accumulator afterwards
    exact: Fraction  # the sum of the terms so far
    # binary digits of the exact result of this addition below the last place that was kept; 0 where the
    # addition was exact
    bits_lost: int
    absorbed: bool  # a nonzero addend left no trace


@dataclass(frozen=True)
class RunningSum:
    """A sum with its history."""

    dtype: str  # of the terms and of the accumulator
    rows: tuple[Addition, ...]  # one per addition
    result: float  # the last running sum
    exact: Fraction  # the sum of the terms

    @property
    def error(self) -> float:
        """Result minus exact sum, rounded to float64."""
        return float(Fraction(self.result) - self.exact)

    @property
    def bits_lost(self) -> int:
        """Number of bits lost in all additions."""
        return sum(row.bits_lost for row in self.rows)

    columns = ("term", "addend", "running sum", "exact sum", "bits lost")

    def table(self) -> tuple[tuple[Any, ...], ...]:
        """Return plain rows under `columns`, with exact sums rounded to float64."""
        return tuple(
            (row.term, row.addend, row.running, float(row.exact), row.bits_lost) for row in self.rows
        )


def running_sum_table(terms: Any, dtype: DTypeLike | None = None) -> RunningSum:
    """Return the history of a sum, term after term.

    The exact sum stands next to the running sum, because every float is a rational number. The last row has
    the bits that the sequential reduction gives inside jit, except that XLA on a CPU flushes subnormals of
    every dtype but float16 to zero, and the host keeps them.

    Args:
        terms: the numbers, shape (n,).
        dtype: terms are rounded to this dtype first; None keeps the dtype of the terms.

    Raises:
        InputError: there are no terms, or a number is not finite.
    """
    terms = np.asarray(terms)
    terms = terms.astype(np.dtype(dtype) if dtype is not None else terms.dtype)
    if terms.ndim != 1 or len(terms) == 0:
        raise InputError(
            f"the terms have shape {terms.shape}",
            remedy="Give a one-dimensional array with at least one term.",
        )
    if not np.isfinite(terms.astype(np.float64)).all():
        raise InputError("a term is not finite, so partial sums cannot be recorded")
    with np.errstate(all="ignore"):
        rows = tuple(_additions(terms))
    exact = sum((Fraction(float(t)) for t in terms), Fraction(0))
    return RunningSum(str(terms.dtype), rows, rows[-1].running, exact)


def _place(x: Any) -> int:
    """Return the exponent of the last place of a float: x is a multiple of 2^place."""
    info = ml_dtypes.finfo(x.dtype)
    exponent = math.frexp(float(x))[1] - 1 if x else info.minexp
    return max(exponent, int(info.minexp)) - info.nmant


def _lost(true: Fraction, kept: Fraction, place: int) -> int:
    numerator = abs(true.numerator)
    # the exponent of the lowest binary digit of a dyadic rational
    lowest = (numerator & -numerator).bit_length() - true.denominator.bit_length()
    return 0 if true == kept else max(1, place - lowest)


def _additions(terms: np.ndarray) -> Iterator[Addition]:
    total, exact = terms.dtype.type(0), Fraction(0)
    for k, term in enumerate(terms):
        new = total + term
        true = Fraction(float(total)) + Fraction(float(term))
        exact += Fraction(float(term))
        yield Addition(
            str(k),
            float(term),
            float(new),
            exact,
            _lost(true, Fraction(float(new)), _place(new)) if np.isfinite(new) else 0,
            bool(new == total and term != 0),
        )
        total = new


def solve(penetrations: np.ndarray, reduction: Reduction) -> BallRun:
    """Make one step of balls at rest below the floor in float16; only the solver makes decisions."""
    stop = GlobalSum(TOL, 25, reduction)
    world = World.create(
        Projection(k=0.5, alpha=0.5, stop=stop),
        SemiImplicitEuler(2.0**-7),
        gravity=0.0,
        policy=RolePrecision.all("float16"),
    )
    return simulate(world, world.start(-penetrations), 1, history=True)


def run() -> Demo:
    """Compute the sum in both orders, with every reduction, and with jnp.sum."""
    orders = {"large first": TERMS, "small first": TERMS[::-1]}
    histories = {name: running_sum_table(terms) for name, terms in orders.items()}
    runs = {name: solve(terms, BY_NAME["sequential"]) for name, terms in orders.items()}
    residual = {name: float(one.history[0, 0]) for name, one in runs.items() if one.history is not None}
    stopped = {name: int(one.iterations[0]) == 0 for name, one in runs.items()}
    hidden = {name: float(jnp.sum(jnp.asarray(terms))) for name, terms in orders.items()}
    sums = jax.jit(lambda terms: {name: reduction(terms) for name, reduction in BY_NAME.items()})(TERMS)
    others = {name: float(total) for name, total in sums.items()}
    large, small = histories["large first"], histories["small first"]
    seen = residual["large first"], residual["small first"]
    return Demo(
        title="The order of a sum decides whether a solver stops",
        question=(
            "The exact sum of five float16 penetrations equals the tolerance. Is the computed sum below it?"
        ),
        result=(
            f"If the largest term is added first, the sum is {seen[0]:.10f} and the solver stops; if "
            f"the smallest is added first, the sum is {seen[1]:.10f} and the solver continues."
        ),
        answer=(
            "If the largest term is added first, each small term is a quarter of an ulp of the "
            f"partial sum and is lost to rounding: {seen[0]:.13f} is below the tolerance, and the "
            "solver stops. If the small terms are added first, they add up to one ulp: "
            f"{seen[1]:.10f} is not below the tolerance, and the solver makes an iteration. jnp.sum "
            f"gives {hidden['large first']:.10f} in both orders, because it adds float16 numbers in "
            "float32."
        ),
        numbers={
            "large_first": seen[0],
            "large_first_stops": stopped["large first"],
            "small_first": seen[1],
            "small_first_stops": stopped["small first"],
            "tolerance": TOL,
            "jnp_sum": [hidden["large first"], hidden["small first"]],
            "bits_lost": [large.bits_lost, small.bits_lost],
            "iterations": [int(one.iterations[0]) for one in runs.values()],
        },
        checks=[
            Claim("large first is one last place below", seen[0], repr(LARGE), seen[0] == LARGE),
            Claim("large first stops", stopped["large first"], "True", stopped["large first"]),
            Claim("small first is the tolerance", seen[1], repr(TOL), seen[1] == TOL),
            Claim(
                "small first does not stop", not stopped["small first"], "True", not stopped["small first"]
            ),
            Claim(
                "the exact sum is the tolerance",
                float(large.exact),
                repr(TOL),
                large.exact == small.exact == Fraction(TOL),
            ),
            Claim(
                "the sums of the solver are those of the table",
                [large.result, small.result],
                "the same bits",
                (large.result, small.result) == seen,
            ),
            Claim(
                "jnp.sum gives the tolerance in both orders",
                list(hidden.values()),
                f"{TOL!r} twice",
                set(hidden.values()) == {TOL},
            ),
        ],
        tables=[
            table(f"{name}, addition by addition", history.columns, history.table())
            for name, history in histories.items()
        ]
        + [
            table(
                "every reduction, large first",
                ("reduction", "sum", "error (last places)", "stops"),
                tuple((name, total, (total - TOL) * 2.0**21, total < TOL) for name, total in others.items()),
            )
        ],
        plots=[_errors(histories)],
        in_md=(
            "The force on an atom is such a sum over its neighbors, in the order of the list. The same "
            "table can be made for this sum."
        ),
        data={
            "penetrations": TERMS.astype(float),
            "running": {name: [row.running for row in one.rows] for name, one in histories.items()},
            "reductions": others,
        },
    )


def _errors(histories: dict[str, RunningSum]) -> Plot:
    def missing(history: RunningSum) -> np.ndarray:
        return np.array([float((Fraction(row.running) - row.exact) * 2**21) for row in history.rows])

    count = np.arange(1, len(TERMS) + 1)
    return Plot(
        "accumulator-misses",
        title="Error of the running sum after each addition",
        x_label="additions",
        y_label="running sum - exact sum (last places of the tolerance)",
        series=(
            Series("large first", count, missing(histories["large first"]), "line+points", "bad"),
            Series("small first", count, missing(histories["small first"]), "line+points", "first"),
        ),
        caption="If the largest term is added first, every small term is lost. If the small terms are "
        "added first, no term is lost.",
    )
