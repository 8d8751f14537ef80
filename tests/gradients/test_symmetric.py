"""The reverse pass against finite differences of the same run, and against itself with less memory."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from gradient_problems import everything
from small_systems import KOB_ANDERSEN as BINARY
from small_systems import LENNARD_JONES, crystal, make, mixture

from mdnum.errors import InputError
from mdnum.gradients.differences import FiniteDifferences, richardson
from mdnum.gradients.losses import Custom, FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import Symmetric
from mdnum.gradients.tape import RunTape
from mdnum.systems import build

STEPS = 40
SCALARS = ("timestep", "temperature", "scale")


@pytest.fixture(scope="module")
def switched():
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    return Problem(simulation, everything(simulation.atoms), STEPS)


def test_derivatives_are_those_of_differences(switched):
    names = ("sigma", "epsilon", "r_onset", *SCALARS)
    ours = Symmetric()(switched, (*names, "r_cut"))
    theirs = FiniteDifferences(relative=1e-5, levels=3)(switched, names)
    assert ours.value == theirs.value
    # every radius is compiled for
    radius = float(switched.simulation.model.r_cut[0])
    by_radius = richardson(lambda q: switched.value({"cutoff.radius": q}), radius, 2e-6, 1).table[0][1]
    assert float(ours.gradient["cutoff.radius"]) == pytest.approx(by_radius, rel=1e-6)
    for name, value in theirs.gradient.items():
        error = theirs.details["error"][name]
        assert error < 1e-5 * abs(value), name
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=1e-6), name


def test_the_start_has_the_derivatives_of_differences(switched):
    ours = Symmetric()(switched, ("x0", "v0"))
    simulation = switched.simulation
    rng = np.random.default_rng(1)
    for name in ("initial.positions", "initial.velocities"):
        way = rng.standard_normal((simulation.atoms, 3))
        here = getattr(simulation, name.partition(".")[2])

        def shifted(q: float, name: str = name, here=here, way=way) -> float:
            return switched.value({name: here + q * way})

        found = richardson(shifted, 0.0, 1e-4, 4)
        assert float(np.sum(ours.gradient[name] * way)) == pytest.approx(found.value, rel=1e-7)


def test_each_pair_type_has_its_own_derivative():
    simulation = build(make(mixture(), BINARY, {"kind": "shifted", "radius": 2.0}))
    problem = Problem(simulation, everything(simulation.atoms), 12)
    ours = Symmetric()(problem, ("sigma", "epsilon", "r_cut"))
    for name in ("potential.sigma", "potential.epsilon"):
        leaf = name.partition(".")[2]
        here = np.asarray(getattr(simulation.model.potential, leaf))
        assert ours.gradient[name].shape == here.shape == (3,)
        for kind in range(3):

            def shifted(q: float, kind: int = kind, name: str = name, here=here) -> float:
                return problem.value({name: here + q * (np.arange(3) == kind)})

            found = richardson(shifted, 0.0, 1e-6, 3)
            assert float(ours.gradient[name][kind]) == pytest.approx(found.value, rel=1e-5), (name, kind)


def test_made_again_the_run_has_the_bits_it_had(switched):
    kept = Symmetric()(switched, ("x0", "sigma"))
    again = Symmetric(budget=0)(switched, ("x0", "sigma"))
    assert again.details["run again"] == kept.details["stretches"] > 1
    assert again.value == kept.value
    for name in kept.gradient:
        assert np.array_equal(again.gradient[name], kept.gradient[name])


def test_the_tape_is_the_run_of_the_rollout(switched):
    """States and decisions that the reverse pass linearizes at, against the run without any gradient."""
    from mdnum.rollout.engine import Engine

    tape = RunTape(switched.simulation, switched.loss, STEPS, budget=0)
    steps = {}
    for segment in Engine(switched.simulation, STEPS).segments():
        for row in range(segment.rows):
            steps[segment.first + row] = segment.unsorted("x", row)
    seen = 0
    for stretch in tape.backward():
        for row in range(stretch.rows):
            x = np.empty_like(steps[0])
            x[stretch.table.order] = stretch.x[row].T
            assert np.array_equal(x, steps[stretch.first + row])
            seen += 1
    assert seen == STEPS + 1


@pytest.mark.slow
def test_langevin_derivatives_are_those_of_differences():
    table = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 2.0, "seed": 3}
    system = make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}, dynamics=table)
    simulation = build(system)
    problem = Problem(simulation, everything(simulation.atoms), STEPS)
    names = ("sigma", "friction", *SCALARS)
    ours = Symmetric()(problem, names)
    theirs = FiniteDifferences(relative=1e-5, levels=3)(problem, names)
    for name, value in theirs.gradient.items():
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=2e-6), name


def test_bad_input_says_what_there_is(switched):
    for word, text in (("sigmo", "Did you mean sigma"), ("seed", "no"), ("skin", "which list")):
        with pytest.raises(InputError) as error:
            Symmetric()(switched, (word,))
        assert text in str(error.value)
    with pytest.raises(InputError, match="scalar"):
        problem = replace(switched, loss=Custom(see=lambda frame, *_: frame.x))
        Symmetric()(problem, ("sigma",))
    with pytest.raises(InputError, match="looks at no step"):
        Problem(switched.simulation, everything(switched.simulation.atoms), 3)


def test_forces_in_sixteen_bits_are_refused():
    simulation = build("argon/crystal-108", {"precision.force": "bfloat16"})
    with pytest.raises(InputError, match="bfloat16 are rounded"):
        Symmetric()(Problem(simulation, FinalProjection(), 10), ("sigma",))


def test_a_parameter_that_nothing_depends_on_is_said_to_be_one(switched):
    loss = FinalProjection(direction=jnp.zeros(3))
    found = Symmetric()(replace(switched, loss=loss), ("sigma",))
    assert float(found.gradient["potential.sigma"]) == 0.0
    assert "depends" in found.notes["potential.sigma"]
