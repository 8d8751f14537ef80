"""Horizons against all pairs of all steps, computed anew from the stored positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from forks.harness import crystal, pair
from rollout.harness import history

from mdnum.forks import Fork, fork
from mdnum.forks.certified import certified, protection, wider
from mdnum.systems.simulation import Simulation

STEPS = 180


@pytest.fixture(scope="module")
def found() -> Fork:
    """The crystal, and with decisions in float32, warm enough that a pair is decided otherwise so soon."""
    return fork(pair(warm(), warm(precision__decision="float32")), STEPS, counterfactual=False)


def warm(**overrides: str | float) -> Simulation:
    return crystal(dynamics__temperature=0.3, **overrides)


def every_pair(simulation: Simulation):
    """Of each step: positions, and which of all pairs i < j the program had inside."""
    return zip(range(STEPS + 1), *history(simulation, STEPS), strict=True)


def squared(simulation: Simulation, x: np.ndarray, dtype: str) -> tuple[np.ndarray, np.ndarray]:
    """Keys of all pairs, and r² of the nearest image in a dtype, an operation at a time."""
    edges = np.diag(np.asarray(simulation.cell.matrix)).astype(dtype)
    i, j = np.triu_indices(simulation.atoms, 1)
    d = x.astype(dtype)[j] - x.astype(dtype)[i]
    d = d - np.rint(d / edges).astype(dtype) * edges
    return i * simulation.atoms + j, d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]


def test_ambiguous_decisions_are_those_within_the_bound_and_no_other_is_wrong(found):
    b = found.twin.b.simulation
    threshold, bound, exact = b.decider.thresholds[0].value, b.decider.bounds[0], b.r_cut**2
    listed = set(zip(found.doubts["B"].step.tolist(), found.doubts["B"].i.tolist(),
                     found.doubts["B"].j.tolist(), strict=True))  # fmt: skip
    wanted, wrong = set(), set()
    for step, x, inside in every_pair(b):
        keys, in_float32 = squared(b, x, "float32")
        close = keys[np.abs(np.float64(threshold) - in_float32.astype(np.float64)) <= bound]
        wanted |= {(step, *divmod(int(key), b.atoms)) for key in close}
        # float64 is as good as exact beside float32
        true = set(keys[squared(b, x, "float64")[1] < exact].tolist())
        wrong |= {(step, *divmod(int(key), b.atoms)) for key in true ^ inside}
    assert listed == wanted and len(wrong) > 0
    assert wrong < listed, "rounding decided something that was called certain"
    horizon = certified(found).horizon
    assert horizon["B"].step == min(step for step, _, _ in wanted) - 1
    assert horizon["B"].decisions == len(wanted)
    assert horizon["B"].steps == len({step for step, _, _ in wanted})
    assert horizon["B"].complete
    assert horizon["A"].step == STEPS and horizon["A"].decisions == 0 == len(found.doubts["A"].step)


def test_the_nearest_pair_protects_until_the_runs_could_have_moved_it(found):
    a = found.twin.a.simulation
    away, needed = protection(found)
    nearest = np.array(
        [np.abs(np.sqrt(squared(a, x, "float64")[1]) - a.r_cut).min() for _, x, _ in every_pair(a)]
    )
    # a lower bound, and a sharp one
    assert (away <= nearest * (1 + 1e-6)).all()
    np.testing.assert_allclose(away, nearest, rtol=1e-3)
    until = certified(found).protected
    assert (away[: until + 1] > needed[: until + 1]).all() and away[until + 1] <= needed[until + 1]
    assert np.all(needed >= 2 * found.series["B"])
    # as long as A and B are certain and protected they cannot fork, and here they fork soon after
    dates = certified(found)
    sure = min(dates.protected, *(horizon.step for horizon in dates.horizon.values()))
    assert found.dates.fork is not None and sure < found.dates.fork


def test_two_runs_of_one_program_are_protected_by_their_bounds_alone(found):
    a = found.twin.a.simulation
    same = fork(pair(a, a), STEPS, counterfactual=False)
    dates = certified(same)
    assert dates.protected == STEPS and dates.shadow is None and dates.shadow_step is None

    # what decides inside its energy function is not certified
    class ManyBody(Simulation):
        imposable = False

    other = ManyBody(**{name: getattr(a, name) for name in a.__dataclass_fields__})
    dates = certified(replace(same, twin=pair(other, other)))
    assert dates.horizon == {} and dates.protected is None and dates.shadow is None


def test_the_wider_program_is_the_shadow(found):
    assert wider(found.twin) == "A"
    a, b = found.twin.a.simulation, found.twin.b.simulation
    assert wider(pair(b, a)) == "B"
    assert certified(found).shadow_step == found.dates.fork - 1
    # one role each, nothing, another start, another step
    later = warm(precision__force="float32", dynamics__timestep=0.002)
    assert wider(pair(b, warm(precision__force="float32"))) is None
    for other in (a, replace(b, positions=b.positions + 1e-9), later):
        assert wider(pair(a, other)) is None
