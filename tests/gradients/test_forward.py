"""Tangents against the reverse pass, whose code they share nothing with beyond the recorded run."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from gradient_problems import everything
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

from mdnum.errors import InputError
from mdnum.gradients.adjoint import reverse
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import gathered, gradient, resolve, with_values
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import RunTape
from mdnum.rollout.engine import Engine
from mdnum.systems import build

STEPS = 40
WORDS = ("sigma", "epsilon", "cutoff.radius", "timestep", "temperature", "scale")


@pytest.fixture(scope="module")
def hot():
    """Atoms so fast that pairs cross the cutoff, where the force jumps."""
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 3.0, "seed": 3}
    system = make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.0}, dynamics=dynamics)
    simulation = build(system)
    return RunTape(simulation, everything(simulation.atoms), STEPS, flips=True)


@pytest.fixture(scope="module")
def forward(hot):
    """Tangents along one recorded run, without and with what the flips add."""
    names = resolve(hot.simulation, WORDS)
    return {jumps: list(tangents(hot, names, saltation=jumps, states=True)) for jumps in (False, True)}


@pytest.fixture(scope="module")
def backward(hot):
    """Reverse passes in which every flip grazes and none does: one program, plain and event-aware."""
    return {jumps: reverse(hot, saltation=True, guard=0.0 if jumps else np.inf) for jumps in (False, True)}


def agree(ours, theirs):
    for name, value in theirs.items():
        scale = max(float(np.max(np.abs(value))), 1e-300)
        assert np.max(np.abs(ours[name] - value)) <= 1e-9 * scale, name


@pytest.mark.slow
@pytest.mark.parametrize("jumps", [False, True])
def test_tangents_agree_with_the_reverse_pass(hot, forward, backward, jumps):
    names = resolve(hot.simulation, WORDS)
    ours = gathered(hot.simulation, names, by_column(hot, forward[jumps][-1].total))
    theirs = {name: gradient(hot.simulation, backward[jumps][0], name) for name in names}
    agree(ours, theirs)
    # with flips, and only with them, the radius counts
    assert (theirs["cutoff.radius"] != 0) == jumps


@pytest.mark.slow
def test_what_flips_add_is_the_sum_of_their_weights(hot, forward, backward):
    names = resolve(hot.simulation, WORDS)
    (plain, _), (parts, found) = backward[False], backward[True]
    added, count = 0.0, 0
    for met, part in zip(reversed(found), forward[False], strict=True):
        assert part.dr is not None and part.dr_cut is not None
        added = added + np.where(met.grazing, 0, met.weight) @ (part.dr_cut - part.dr)
        count += len(met)
    assert count > 50
    by_name = [{name: gradient(hot.simulation, one, name) for name in names} for one in (parts, plain)]
    difference = {name: by_name[0][name] - by_name[1][name] for name in names}
    assert all(np.all(value != 0) for value in difference.values())
    agree(gathered(hot.simulation, names, np.asarray(added)), difference)


@pytest.mark.slow
def test_the_tangent_of_a_state_is_that_of_differences(hot, forward):
    """Of the last positions by sigma, against two runs that make the same decisions."""

    def last(shift: float) -> tuple[np.ndarray, int]:
        shifted = with_values(hot.simulation, {"potential.sigma": np.asarray(1.0 + shift)})
        segments = [
            (segment.unsorted("x", segment.rows - 1), segment.unsorted("images", segment.rows - 1))
            for segment in Engine(shifted, STEPS).segments()
        ]
        x, images = segments[-1]
        return x + images @ np.asarray(shifted.cell.matrix), len(segments)

    (above, lists), (below, as_many) = last(1e-7), last(-1e-7)
    assert lists == as_many > 1
    difference = (above - below) / 2e-7
    part = forward[False][-1]
    ours = np.empty_like(difference)
    ours[part.stretch.table.order] = part.x[part.stretch.rows - 1, 0].T
    assert ours == pytest.approx(difference, abs=1e-6 * np.abs(difference).max())


def test_bad_input_says_what_would_do(hot):
    problem = Problem(hot.simulation, hot.loss, STEPS)
    with pytest.raises(InputError, match="324 numbers"):
        Forward()(problem, ("x0",))
    with pytest.raises(InputError, match="without its flips"):
        next(tangents(RunTape(hot.simulation, hot.loss, STEPS), ("potential.sigma",), saltation=True))


@pytest.mark.slow
def test_a_mixture_in_a_bath_agrees_by_every_pair_type():
    dynamics = {"kind": "langevin", "timestep": 0.004, "temperature": 3.0, "friction": 2.0, "seed": 3}
    system = make(mixture(), KOB_ANDERSEN, {"kind": "hard", "radius": 2.0}, dynamics=dynamics)
    simulation = build(system)
    problem = Problem(simulation, everything(simulation.atoms), STEPS)
    names = (*WORDS, "friction")
    ours, theirs = Forward(saltation=True)(problem, names), EventAware()(problem, names)
    assert ours.value == theirs.value
    assert ours.gradient["potential.epsilon"].shape == (3,)
    assert ours.details["crossings"] == theirs.details["crossings"] > 50
    agree(ours.gradient, theirs.gradient)


@pytest.mark.slow
def test_the_pair_that_leaves_its_well_agrees_by_every_number():
    """Each coordinate of a free pair is a column; stretched, it starts at another distance."""
    simulation = build("pair/leaving-well")
    problem = Problem(simulation, FinalProjection(direction=jnp.asarray([[1.0, 0], [0, 0], [0, 0]])), 2000)
    names = ("x0", "v0", "scale", "sigma")
    ours, theirs = Forward(saltation=True)(problem, names), EventAware()(problem, names)
    for name, value in theirs.gradient.items():
        assert ours.gradient[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    assert np.linalg.norm(simulation.positions[1] - simulation.positions[0]) == pytest.approx(1.8)
    by_distance = float(np.sum(theirs.gradient["initial.positions"] * simulation.positions))
    assert float(ours.gradient["box.scale"]) == pytest.approx(by_distance, rel=1e-9)
