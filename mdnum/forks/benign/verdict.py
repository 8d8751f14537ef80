"""Is a fork benign: do two programs whose runs part still give the same measurements?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.forks.benign.calibration import RUNS, Calibration, Planted, calibrate
from mdnum.forks.benign.ensemble import ensemble, starts
from mdnum.md.integrators import Langevin
from mdnum.program import Twin
from mdnum.systems.build import Simulation

#: Features that are named, at most.
_NAMED = 5
#: A feature is named where it matters so much, relative to the one that matters most.
_TELLING = 0.02
#: Noise of B's runs; no seed of a calibration's.
_SEED = 1_000_003


@dataclass(frozen=True)
class Benign:
    """Whether B's runs belong to A's ensemble.

    Attributes:
        passed: whether they do.
        window: step of the comparison.
        components: how many principal components were compared.
        limit: standard deviations beyond which one stands out.
        scores: components of B's runs, in standard deviations of A's ensemble, shape (runs, components);
            not a number for a run that blew up.
        failing: features that give B away, by name, with the median over B's runs of their distance from A's
            mean, in standard deviations of A's ensemble; the ones that matter most come first.
        calibration: what the rule said of each planted change.
        false_positive_rate: verdicts "fail" on A itself, expected from runs that were held out; not a number
            where none were. Its exact 95 % interval is in `false_positive_bounds`.
        false_positive_bounds: see there.
        false_positives: verdicts "fail" that were counted, and of how many.
    """

    passed: bool
    window: int
    components: int
    limit: float
    scores: Float[np.ndarray, "runs components"]
    failing: dict[str, float]
    calibration: tuple[Planted, ...]
    false_positive_rate: float
    false_positive_bounds: tuple[float, float]
    false_positives: tuple[int, int]


def benign(
    twin: Twin,
    *,
    members: int = 60,
    held_out: int = 30,
    tries: int = 3,
    steps: int | None = None,
    calibration: Calibration | None = None,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> Benign:
    """Compare three runs of B with an ensemble of A.

    B fails where two of the three have two or more principal components of their features beyond the limit.
    Where it passes, the choice made no difference larger than the smallest noise of a start does.

    Args:
        twin: the programs. B's frame does not matter: no feature knows the labels of atoms or the axes.
        members: runs of the ensemble.
        held_out: further runs of A, which the rate of false positives is taken from.
        tries: verdicts on each planted change.
        steps: step of the comparison; default calibrated.
        calibration: one that was made before for A, which `members`, `held_out`, `tries` and `steps` then
            do not touch.
        progress: called with runs done, runs in all, and figures.

    Raises:
        InputError: programs that cannot be compared, or no step at which planted changes are told apart.
    """
    check(twin)
    if calibration is None:
        calibration = calibrate(
            twin.a.simulation,
            start=twin.a.begin,
            members=members,
            held_out=held_out,
            tries=tries,
            steps=steps,
            progress=progress,
        )
    elif not _same_program(calibration.simulation, twin.a.simulation):
        raise InputError(
            f"the calibration is of {calibration.simulation.system.name} with other settings or positions",
            remedy="Calibrate with this comparison's own program",
        )
    window = calibration.window
    b = twin.b.simulation
    begin = starts(b, RUNS, _SEED, twin.b.begin)
    rows = ensemble(b, begin, [window.step], calibration.ruler)[0]
    whole = np.isfinite(rows).all(axis=1)
    scores = np.full((len(rows), len(window.space.sigma)), np.nan)
    scores[whole] = window.space.scores(rows[whole])
    beyond = np.abs(scores) > window.limit
    stands_out = ~whole | (beyond.sum(axis=1) >= 2)
    passed = bool(stands_out.sum() < 2)
    failing = {} if passed or not whole.any() else _failing(calibration, rows[whole], scores[whole])
    return Benign(
        passed,
        window.step,
        len(window.space.sigma),
        window.limit,
        scores,
        failing,
        window.table,
        calibration.rate,
        calibration.rate_bounds,
        (calibration.false_positives, calibration.triples),
    )


def check(twin: Twin) -> None:
    """Refuse programs that an ensemble of one cannot judge the other by.

    Raises:
        InputError: runs of different size, or with different noise.
    """
    twin.a.check(twin.b)
    keys = [_key(one.simulation) for one in (twin.a, twin.b)]
    if (keys[0] is None) != (keys[1] is None) or not np.array_equal(keys[0], keys[1]):  # type: ignore[arg-type]
        raise InputError(
            "the runs have different noise, so they part at the first step whatever else they do",
            where="dynamics.seed",
            remedy="Give both the same seed; runs of different seeds are compared by their averages",
        )


def _same_program(one: Simulation, other: Simulation) -> bool:
    return (
        one.system.spec == other.system.spec
        and one.policy == other.policy
        and np.array_equal(one.positions, other.positions)
        and np.array_equal(one.velocities, other.velocities)
    )


def _key(simulation: Simulation) -> np.ndarray | None:
    if not isinstance(simulation.integrator, Langevin):
        return None
    return np.asarray(jax.random.key_data(simulation.integrator.key))


def _failing(calibration: Calibration, rows: np.ndarray, scores: np.ndarray) -> dict[str, float]:
    """The features that the components beyond the limit are made of, by their share in them."""
    space, limit = calibration.window.space, calibration.window.limit
    z = np.median(space.standardized(rows), axis=0)
    middle = np.median(scores, axis=0)
    weight = np.where(np.abs(middle) > limit, middle / space.sigma, 0.0)
    share = (weight @ space.axes) * z
    names = calibration.ruler.names
    telling = [k for k in np.argsort(-share) if share[k] > _TELLING * share.max()]
    # none is where they are beyond the limit only together, as a sum of energies that is kept can be
    chosen = [k for k in telling if abs(z[k]) > limit] or telling
    return {names[k]: float(z[k]) for k in chosen[:_NAMED]}
