"""The largest Lyapunov exponent of a run: how fast a perturbation grows while it is small.

The tangent is carried along the run and shortened again and again (Benettin, Galgani, Giorgilli and Strelcyn
1980), so its growth never saturates, as the separation of two runs does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.events.forks import Growth
from mdnum.forks.tangent import tangents
from mdnum.systems.build import Simulation

#: Share of a run in which the tangent turns to the direction that grows fastest.
_TRANSIENT = 0.2
#: Blocks that the error is estimated from.
_BLOCKS = 8
#: A rate counts where it is so many times its error.
_SIGNIFICANT = 4.0


@dataclass(frozen=True)
class Lyapunov:
    """Growth of a tangent along a run.

    Attributes:
        steps, timestep: of the run; the time step in the units of the system's file.
        rate: the exponent, per step. error: its standard error, from blocks of the run.
        size: log of the length of the tangent at each step, relative to its start, shape (steps + 1,).
        furthest: displacement of the furthest atom at each step per displacement of the furthest atom at the
            start, as its log, shape (steps + 1,).
        transient: steps left out at the start.
        chaotic: whether the rate is above what linear growth (a perturbation of speeds, or of a frequency)
            would give in so many steps, and above four times its error.
    """

    steps: int
    timestep: float
    rate: float
    error: float
    size: Float[np.ndarray, "rows"]
    furthest: Float[np.ndarray, "rows"]
    transient: int
    chaotic: bool

    @property
    def rate_time(self) -> float:
        """The exponent per unit of time of the system's file."""
        return self.rate / self.timestep

    @property
    def error_time(self) -> float:
        """Its standard error."""
        return self.error / self.timestep

    def ratio(self, seen: Growth) -> float:
        """Growth rate of two runs over the exponent; NaN where they were not seen to grow.

        Near 1 the runs parted as the motion parts them. Well above it, their flips did it.
        """
        return seen.rate / self.rate if self.chaotic else float("nan")

    def steps_to(self, start: float, end: float) -> float | None:
        """The step at which a displacement of the start has grown from one size to another.

        From the run itself as far as it goes, beyond it at the rate. None where it does not get there: where
        the run is not chaotic.

        Args:
            start: largest displacement of an atom at the start, length; an ulp, for example.
            end: largest displacement asked for, length.
        """
        wanted = float(np.log(end / start))
        beyond = self.furthest >= wanted
        if beyond.any():
            return float(beyond.argmax())
        if not self.chaotic:
            return None
        return self.steps + (wanted - float(self.furthest[-1])) / self.rate


def lyapunov(simulation: Simulation, steps: int | None = None, *, seed: int = 0) -> Lyapunov:
    """The largest Lyapunov exponent along a run.

    Args:
        simulation: the system as objects, with a pair potential.
        steps: last step; default the system's own.
        seed: of the perturbation that is followed: random displacements.

    Raises:
        InputError: a many-body potential, or too few steps for an error.

    Error: statistical, see Lyapunov.error; and flips of a hard cutoff do not act on a tangent, so growth that
        is made by flips alone is not in it.
    """
    last = simulation.system.spec.dynamics.steps if steps is None else steps
    if last < 10 * _BLOCKS:
        raise InputError(
            f"steps = {last} are too few for a growth rate", remedy=f"Give at least {10 * _BLOCKS}"
        )
    dx = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    dx -= dx.mean(axis=0)
    step = float(simulation.integrator.timestep)
    parts = list(tangents(simulation, last, dx, np.zeros_like(dx), clock=30 * step, reach=False))
    size = np.concatenate([part.size for part in parts])
    furthest = np.concatenate([part.furthest for part in parts])
    first = int(_TRANSIENT * last)
    edges = np.linspace(first, len(size) - 1, _BLOCKS + 1).astype(int)
    slopes = np.diff(size[edges]) / np.diff(edges)
    rate = float((size[-1] - size[first]) / (len(size) - 1 - first))
    error = float(slopes.std(ddof=1) / np.sqrt(_BLOCKS))
    # what grows in proportion to the steps gains log(end / first) over this stretch
    linear = float(np.log((len(size) - 1) / max(first, 1))) / (len(size) - 1 - first)
    return Lyapunov(
        last,
        step / simulation.units.time_factor,
        rate,
        error,
        size,
        furthest - float(np.log(np.sqrt((dx**2).sum(axis=1)).max())),
        first,
        rate > 2 * linear and rate > _SIGNIFICANT * error,
    )
