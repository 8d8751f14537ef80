"""Whether the cotangents of a reverse pass fit a narrow type, and the scale that makes them.

Cotangents of a chaotic run span many powers of two between the last step and the first. A loss scale moves
all of them together: it helps where they are small everywhere, and cannot help where they span more than the
format does. The pass is watched in the type that it runs in and held against the narrow one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import Trace
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.passes import passed
from mdnum.gradients.diagnose.places import Scaling
from mdnum.gradients.tape import Stretch
from mdnum.precision import formats

#: Binary exponents that are told apart; what lies beyond is counted at the ends.
_LOWEST, _HIGHEST = -200, 200
#: Share of the numbers of a step that may be lost where one scale is said to fit.
LOST = 0.01


class ScalingWatch:
    """Counts what would overflow and underflow while a reverse pass goes on.

    Args:
        steps: last step.
        format: one of precision.formats.
    """

    def __init__(self, steps: int, format: str = "float16"):
        self.format = formats.get(format)
        self.steps, self.numbers = steps, 0
        self.largest, self.smallest = np.zeros(steps + 1), np.full(steps + 1, np.inf)
        self.overflow, self.underflow, self.subnormal = (np.zeros(steps + 1, np.int64) for _ in range(3))
        # how many numbers of each step have each binary exponent
        self.exponents = np.zeros((steps + 1, _HIGHEST - _LOWEST + 1), np.int32)

    def __call__(self, stretch: Stretch, trace: Trace) -> None:
        """One stretch of the reverse pass."""
        for row in range(stretch.rows):
            both = (np.asarray(part[row], np.float64).ravel() for part in (trace.x, trace.v))
            self.put(stretch.first + row, np.concatenate(list(both)))

    def put(self, step: int, values: Float[np.ndarray, "numbers"]) -> None:
        """The cotangents of one step."""
        form, size = self.format, np.abs(values)
        self.numbers = len(values)
        there = size[np.isfinite(size) & (size > 0)]
        # half a unit in the last place beyond the largest rounds to infinity
        too_large = form.largest * (1 + 2.0 ** -(form.significand + 1))
        self.overflow[step] = np.count_nonzero(~(size <= too_large))
        self.underflow[step] = np.count_nonzero(there <= form.smallest_subnormal / 2)
        self.subnormal[step] = np.count_nonzero(there < form.smallest_normal) - self.underflow[step]
        if len(there):
            self.largest[step], self.smallest[step] = there.max(), there.min()
            place = np.clip(np.frexp(there)[1], _LOWEST, _HIGHEST) - _LOWEST
            self.exponents[step] = np.bincount(place, minlength=_HIGHEST - _LOWEST + 1)
        if not np.isfinite(size).all():
            self.largest[step] = np.inf

    def result(self) -> Scaling:
        """The counts, with and without the best scale."""
        form = self.format
        largest = float(self.largest.max())
        there = self.exponents.sum(axis=1, dtype=np.int64)
        usable = 0 < largest < np.inf
        # the more is multiplied the less is lost, so the best scale is the largest that overflows nowhere
        power = int(np.floor(np.log2(form.largest / largest))) if usable else 0
        lost = self._lost(power)
        beyond = np.zeros(self.steps + 1, np.int64) if usable else self.overflow.copy()
        kept = 1 - lost.sum() / max(there.sum(), 1)
        scale = 2.0**power if usable and kept > 0.5 else float("nan")
        worst = float(np.max(lost / np.maximum(there, 1)))
        fits = bool(usable and worst <= LOST)
        back = slice(None, None, -1)
        return Scaling(
            form.name,
            np.arange(self.steps + 1),
            self.overflow[back].copy(),
            self.underflow[back].copy(),
            self.subnormal[back].copy(),
            self.numbers,
            self.largest[back].copy(),
            self.smallest[back].copy(),
            scale,
            beyond[back].copy(),
            lost[back].copy(),
            fits,
            self._sentence(power, usable, fits, worst, there),
        )

    def _lost(self, power: int) -> Int[np.ndarray, "rows"]:
        """How many numbers of each step are lost when all are multiplied by a power of two."""
        # |x| < 2^e of frexp; half the smallest number is a power of two, so the counts are exact
        below = int(np.log2(self.format.smallest_subnormal)) - 1
        end = int(np.clip(below - power - _LOWEST + 1, 0, self.exponents.shape[1]))
        return self.exponents[:, :end].sum(axis=1, dtype=np.int64)

    def _sentence(
        self, power: int, usable: bool, fits: bool, worst: float, there: Int[np.ndarray, "rows"]
    ) -> str:
        name = self.format.name
        if not usable:
            what = "All cotangents are zero" if not there.any() else "Some cotangents are not finite"
            return f"{what}: there is nothing to scale."
        steps = int(np.count_nonzero(self.overflow))
        lost = int(np.count_nonzero(self.underflow))
        plain = f"In {name} without a scale, numbers overflow at {steps} steps and vanish at {lost}"
        if fits:
            return f"{plain}; with the loss multiplied by 2^{power} all steps keep 99 % of theirs or more."
        return (
            f"{plain}; no one scale serves all steps: with 2^{power}, the largest that overflows nowhere, a "
            f"step loses up to {100 * worst:.3g} % of its numbers. Scale stretch by stretch, or use a wider "
            "type."
        )


def scaling(
    problem: Problem,
    names: Sequence[str],
    format: str = "float16",
    *,
    saltation: bool = True,
    budget: int = 2**29,
    progress: Progress | None = None,
) -> Scaling:
    """Overflow and underflow of the cotangents of positions and velocities by step, and a scale.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        format: the narrow type.
        saltation: whether flips count.
        budget: bytes of the recorded run that are kept.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter or format, or no pair potential. NumericalError: the run blew up.

    Error: counts with a scale are exact but for numbers on the edge of a power of two.
    """
    full = parameters.resolve(problem.simulation, names)
    watch = ScalingWatch(problem.steps, format)
    passed(problem, full, saltation=saltation, budget=budget, watches=[watch], progress=progress)
    return watch.result()
