"""Which decisions a perturbation will flip first, predicted by one linearized run.

Along the run each decision has a margin m and a tangent dm/da, a being the amplitude of the perturbation:
to first order it flips at a = -m / (dm/da). The least of these at each step answers for all amplitudes at
once, as long as the perturbed run stays close to the run and makes the same decisions. Where the force jumps
at the cutoff, the first flip kicks the two atoms, and what was linearized is another run from there on: the
forecast ends with it. Where the force is continuous there, a flip changes nothing to first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.forks.tangent import tangents
from mdnum.systems.build import Simulation

#: Beyond this displacement, as a share of the cutoff, a forecast is not to be relied on. Measured on argon's
#: crystal: every first flip was predicted up to 0.006, one of two at 0.02, none of six late ones at 0.04.
LINEAR = 5e-3
#: How far off the amplitude of a flip may be, as a share of it, for each cutoff of displacement. Measured on
#: a crystal, cold, warm and with a continuous force, and a liquid: 196 at most in 304 decisions, 15 in seven
#: of eight; it is large where a pair moves across its axis and hardly along it.
_SECOND_ORDER = 200.0
#: Rounding perturbs a run by no more than so many ulps of its start.
_ULPS = 8.0


@dataclass(frozen=True)
class PredictedFlip:
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


class ForecastRange(NamedTuple):
    """How far a forecast is good for one amplitude.

    Attributes:
        step: the last one; -1 for none.
        ends: why there: "end" of the run; "flip", the first one kicks its atoms; "close", whether a decision
            of the next step flips is within the error; "size", the displacement is too large from then on;
            "list", a pair that was not examined could come inside.
    """

    step: int
    ends: str


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
        listed: pairs that were examined, those of the list, at each step, shape (steps + 1,).
        room: how much nearer to the cutoff than in the run a pair would have to be that was not examined,
            length, shape (steps + 1,).

    Error: second order in the displacement, and some ulps; a decision that may flip or not within it is not
        predicted. `good_until` says how far a forecast goes.
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
    listed: Int[np.ndarray, "rows"]
    room: Float[np.ndarray, "rows"]

    @property
    def kicks(self) -> bool:
        """Whether a flip changes the force by a jump, and with it all that follows."""
        return self.simulation.cutoff.smoothness < 1

    def good_until(self, amplitude: float) -> ForecastRange:
        """Up to which step what is predicted of a perturbation holds, and why not beyond."""
        last = ForecastRange(self.steps, "end")
        for step, ends in ((self.linear_until(amplitude), "size"), (self._listed_until(amplitude), "list")):
            last = min(last, ForecastRange(step, ends), key=lambda one: one.step)
        if self.kicks:
            nearest, error = self._nearest(amplitude), self._error(amplitude)
            near = np.flatnonzero(nearest[: last.step + 1] <= abs(amplitude) * (1 + error[: last.step + 1]))
            if len(near):
                step = int(near[0])
                sure = nearest[step] <= abs(amplitude) * (1 - error[step])
                return ForecastRange(step, "flip") if sure else ForecastRange(step - 1, "close")
        return last

    def first(self, amplitude: float, count: int = 3) -> tuple[PredictedFlip, ...]:
        """The decisions that a perturbation flips first, by step, each pair once; no further than it is good.

        At most `KEPT` of a step; where there are as many, there may be more.

        Args:
            amplitude: of the perturbation; its sign matters.
            count: how many at most.
        """
        sign = 0 if amplitude >= 0 else 1
        sure = self.reach[sign] <= abs(amplitude) * (1 - self._error(amplitude))[:, None]
        rows, places = np.nonzero(sure[: self.good_until(amplitude).step + 1])
        found: list[PredictedFlip] = []
        seen = set()
        for row, place in zip(rows.tolist(), places.tolist(), strict=True):
            pair = tuple(self.pairs[sign, row, place].tolist())
            if pair not in seen:
                seen.add(pair)
                found.append(self._flip(sign, row, place))
            if len(found) == count:
                break
        return tuple(found)

    def nearest(self, count: int = 10) -> tuple[PredictedFlip, ...]:
        """The decisions that the smallest amplitudes of either sign flip, each pair once.

        Each at an amplitude at which its forecast is good until then: where flips kick, one that comes after
        another one is predicted for no amplitude.
        """
        # where flips kick, only what flips sooner or at less than all before it can be the first
        least = np.minimum.accumulate(self.reach.min(axis=2), axis=1)
        first = self.reach <= least[:, :, None] if self.kicks else np.isfinite(self.reach)
        flats = np.flatnonzero(first & np.isfinite(self.reach))
        found: list[PredictedFlip] = []
        seen = set()
        for flat in flats[np.argsort(self.reach.reshape(-1)[flats], kind="stable")]:
            if len(found) == count:
                break
            sign, row, place = (int(k) for k in np.unravel_index(flat, self.reach.shape))
            pair = tuple(self.pairs[sign, row, place].tolist())
            amplitude = float(self.reach[sign, row, place]) * (1 if sign == 0 else -1)
            # its own flip is within the error of its own amplitude, and ends the range a step before
            if pair not in seen and self.good_until(amplitude).step >= row - 1:
                seen.add(pair)
                found.append(self._flip(sign, row, place))
        return tuple(found)

    def linear_until(self, amplitude: float) -> int:
        """The last step at which a perturbation is expected to be small enough for a forecast."""
        beyond = abs(amplitude) * self.furthest > LINEAR * self.simulation.r_cut
        return int(beyond.argmax()) - 1 if beyond.any() else self.steps

    def _listed_until(self, amplitude: float) -> int:
        beyond = 2 * abs(amplitude) * self.furthest > self.room
        return int(beyond.argmax()) - 1 if beyond.any() else self.steps

    def _nearest(self, amplitude: float) -> Float[np.ndarray, "rows"]:
        return self.reach[0 if amplitude >= 0 else 1].min(axis=1)

    def _error(self, amplitude: float) -> Float[np.ndarray, "rows"]:
        """How far off the amplitude of a flip may be, as a share of this one."""
        size = abs(amplitude)
        with np.errstate(divide="ignore", over="ignore"):
            return _SECOND_ORDER * size * self.furthest / self.simulation.r_cut + _ULPS * self.ulp / size

    def _flip(self, sign: int, row: int, place: int) -> PredictedFlip:
        i, j = (int(end) for end in self.pairs[sign, row, place])
        amplitude = float(self.reach[sign, row, place]) * (1 if sign == 0 else -1)
        largest = float(np.sqrt((self.dx**2).sum(axis=1)).max()) or 1.0
        margins = float(self.margins[sign, row, place])
        return PredictedFlip(row, i, j, amplitude, margins, abs(amplitude) * largest / self.ulp)


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
    skin = simulation.rule.skin
    listed = [
        np.full(len(part.size), np.sum(part.segment.table.index < simulation.atoms) // 2) for part in parts
    ]
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
        np.concatenate(listed),
        np.concatenate([skin - 2 * part.moved for part in parts]),
    )


def direction(simulation: Simulation, seed: int) -> Float[np.ndarray, "atoms 3"]:
    """Random displacements, the furthest atom by 1."""
    noise = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    return noise / np.sqrt((noise**2).sum(axis=1)).max()


def _clock(simulation: Simulation) -> float:
    return 30 * float(simulation.integrator.timestep)
