"""Which decisions a perturbation will flip first, foretold by one linearized run.

Along the run each decision has a margin m and a tangent dm/da, a being the amplitude of the perturbation:
to first order it flips at a = -m / (dm/da). The least of these at each step answers for all amplitudes at
once, as long as the perturbed run stays close to the run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.forks.histories import history, look
from mdnum.forks.tangent import tangents
from mdnum.systems.build import Simulation

#: Beyond this displacement, as a share of the cutoff, a forecast is not to be relied on. Measured on argon's
#: crystal: every first flip was foretold up to 0.006, one of two at 0.02, none of six late ones at 0.04.
LINEAR = 5e-3


@dataclass(frozen=True)
class Foretold:
    """A decision that a perturbation is expected to flip.

    Attributes:
        step, i, j: of the decision, i < j.
        amplitude: at which it flips, with its sign.
        margin: of the unperturbed run, in the quantity's space.
        ulps: that amplitude, in ulps of the largest start coordinate.
    """

    step: int
    i: int
    j: int
    amplitude: float
    margin: float
    ulps: float


@dataclass(frozen=True)
class Forecast:
    """What perturbations of the start along one direction will flip, to first order.

    Attributes:
        simulation, steps: the run.
        dx, dv: the direction: change of positions (length) and velocities per amplitude, shape (atoms, 3).
        reach: amplitude at which the nearest decisions of each step flip, for positive and negative
            amplitudes, shape (2, steps + 1, KEPT).
        pairs: of those decisions, shape (2, steps + 1, KEPT, 2); margins: theirs, as `reach`.
        furthest: displacement of the furthest atom per amplitude at each step, shape (steps + 1,).
        ulp: spacing of the floats at the largest start coordinate, length.

    Error: second order in the displacement. It goes wrong where a displacement reaches `LINEAR` of the
        cutoff, where a pair only grazes the cutoff, and at amplitudes of a few ulps, where rounding
        perturbs as much. Pairs that a list does not hold are not looked at.
    """

    simulation: Simulation
    steps: int
    dx: Float[np.ndarray, "atoms 3"]
    dv: Float[np.ndarray, "atoms 3"]
    reach: Float[np.ndarray, "signs rows kept"]
    pairs: Int[np.ndarray, "signs rows kept ends"]
    margins: Float[np.ndarray, "signs rows kept"]
    furthest: Float[np.ndarray, "rows"]
    ulp: float

    def first(self, amplitude: float, count: int = 3) -> tuple[Foretold, ...]:
        """The decisions that a perturbation flips first, by step, each pair once.

        Args:
            amplitude: of the perturbation; its sign matters.
            count: how many at most.
        """
        sign = 0 if amplitude >= 0 else 1
        rows, places = np.nonzero(self.reach[sign] <= abs(amplitude))
        found: list[Foretold] = []
        seen = set()
        for row, place in zip(rows.tolist(), places.tolist(), strict=True):
            pair = tuple(self.pairs[sign, row, place].tolist())
            if pair not in seen:
                seen.add(pair)
                found.append(self._foretold(sign, row, place))
            if len(found) == count:
                break
        return tuple(found)

    def nearest(self, count: int = 10) -> tuple[Foretold, ...]:
        """The decisions that the smallest amplitudes of either sign flip, each pair once."""
        order = np.argsort(self.reach, axis=None)
        found: list[Foretold] = []
        seen = set()
        for flat in order:
            sign, row, place = np.unravel_index(flat, self.reach.shape)
            pair = tuple(self.pairs[sign, row, place].tolist())
            if len(found) == count or not np.isfinite(self.reach[sign, row, place]):
                break
            if pair not in seen:
                seen.add(pair)
                found.append(self._foretold(int(sign), int(row), int(place)))
        return tuple(found)

    def linear_until(self, amplitude: float) -> int:
        """The last step at which a perturbation is expected to be small enough for a forecast."""
        beyond = abs(amplitude) * self.furthest > LINEAR * self.simulation.r_cut
        return int(beyond.argmax()) - 1 if beyond.any() else self.steps

    def _foretold(self, sign: int, row: int, place: int) -> Foretold:
        i, j = (int(end) for end in self.pairs[sign, row, place])
        amplitude = float(self.reach[sign, row, place]) * (1 if sign == 0 else -1)
        largest = float(np.sqrt((self.dx**2).sum(axis=1)).max()) or 1.0
        margins = float(self.margins[sign, row, place])
        return Foretold(row, i, j, amplitude, margins, abs(amplitude) * largest / self.ulp)


def forecast(
    simulation: Simulation,
    steps: int | None = None,
    dx: Float[np.ndarray, "atoms 3"] | None = None,
    dv: Float[np.ndarray, "atoms 3"] | None = None,
    *,
    seed: int = 0,
) -> Forecast:
    """Foretell flips along a direction in the start.

    Args:
        simulation: the system as objects, with a pair potential.
        steps: last step; default the system's own.
        dx, dv: the direction; default random displacements, the furthest by 1, so that an amplitude is the
            largest displacement.
        seed: of a random direction.

    Raises:
        InputError: a many-body potential, a direction that is zero or of the wrong shape.
    """
    last = simulation.system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    shape = simulation.positions.shape
    if dx is None and dv is None:
        dx = direction(simulation, seed)
    change = [np.zeros(shape) if part is None else np.asarray(part, np.float64) for part in (dx, dv)]
    if any(part.shape != shape for part in change):
        raise InputError(f"a direction has the shape of the start, {shape}")
    dx, dv = change
    parts = list(tangents(simulation, last, dx, dv, clock=_clock(simulation)))
    largest = np.abs(np.asarray(simulation.positions)).max()
    dtype = simulation.policy.dtype("state")
    return Forecast(
        simulation,
        last,
        dx,
        dv,
        np.concatenate([part.reach for part in parts], axis=1),
        np.concatenate([part.pairs for part in parts], axis=1),
        np.concatenate([part.margins for part in parts], axis=1),
        np.exp(np.concatenate([part.furthest for part in parts])),
        float(np.spacing(np.asarray(largest, dtype))),
    )


def direction(simulation: Simulation, seed: int) -> Float[np.ndarray, "atoms 3"]:
    """Random displacements, the furthest atom by 1."""
    noise = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    return noise / np.sqrt((noise**2).sum(axis=1)).max()


def _clock(simulation: Simulation) -> float:
    return 30 * float(simulation.integrator.timestep)


# --- beside runs --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A forecast beside the run it was about.

    Attributes:
        seed: of the direction. amplitude: of the perturbation, with its sign.
        foretold: what was expected first; empty for no flip.
        step: of the first decision that the perturbed run made otherwise; None for none.
        pairs: that it decided otherwise there.
        displacement: expected of the furthest atom at that step (at the last, where there is none), length.
    """

    seed: int
    amplitude: float
    foretold: tuple[Foretold, ...]
    step: int | None
    pairs: tuple[tuple[int, int], ...]
    displacement: float

    def hit(self, within: int = 1) -> bool:
        """Whether step and pair are among the first so many foretold; none foretold and none seen counts."""
        if self.step is None or not self.foretold:
            return self.step is None and not self.foretold
        return any((one.step, (one.i, one.j)) in self._seen for one in self.foretold[:within])

    @property
    def _seen(self) -> set[tuple[int, tuple[int, int]]]:
        return {(self.step, pair) for pair in self.pairs if self.step is not None}


@dataclass(frozen=True)
class Trial:
    """Forecasts beside runs.

    Attributes:
        cases: all of them.
    """

    cases: tuple[Case, ...]

    def rate(self, within: int = 1) -> float:
        """Share of cases whose step and pair were among the first so many foretold."""
        return float(np.mean([case.hit(within) for case in self.cases])) if self.cases else float("nan")


def trial(simulation: Simulation, steps: int, amplitudes: list[float], *, seeds: range = range(4)) -> Trial:
    """Make the runs that forecasts are about: one forecast for each direction, a run for each amplitude.

    Args:
        simulation: the system as objects.
        steps: last step.
        amplitudes: of the perturbations, with their signs.
        seeds: of the directions.
    """
    plain = history(simulation, steps)
    cases = []
    for seed in seeds:
        told = forecast(simulation, steps, seed=seed)
        for amplitude in amplitudes:
            moved = replace(simulation, positions=simulation.positions + amplitude * told.dx)
            step = plain.first_difference(history(moved, steps))
            pairs: tuple[tuple[int, int], ...] = ()
            if step is not None:
                ours, theirs = (look(one, steps, step).pairs for one in (simulation, moved))
                keys = np.setxor1d(ours, theirs, assume_unique=True)
                pairs = tuple((int(key) // simulation.atoms, int(key) % simulation.atoms) for key in keys)
            size = abs(amplitude) * float(told.furthest[steps if step is None else step])
            cases.append(Case(seed, amplitude, told.first(amplitude), step, pairs, size))
    return Trial(tuple(cases))
