"""Tangents against the reverse pass, whose code they share nothing with beyond the recorded run."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from gradient_problems import everything
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

from mdnum.errors import InputError
from mdnum.gradients.adjoint import reverse
from mdnum.gradients.base import Problem
from mdnum.gradients.directions import gathered
from mdnum.gradients.forward import Forward
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.parameters import gradient, resolve
from mdnum.gradients.symmetric import EventAware
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import Tape
from mdnum.systems import build

NAMES = ("sigma", "epsilon", "cutoff.radius", "timestep", "temperature", "friction", "scale")


@pytest.fixture(scope="module")
def hot():
    """A mixture in a bath, hard cutoff, hot enough that pairs cross it."""
    table = {"kind": "langevin", "timestep": 0.004, "temperature": 3.0, "friction": 2.0, "seed": 3}
    system = make(mixture(), KOB_ANDERSEN, {"kind": "hard", "radius": 2.0}, dynamics=table)
    simulation = build(system)
    return Problem(simulation, everything(simulation.atoms), 40)


def agree(ours, theirs):
    for name, value in theirs.items():
        scale = max(float(np.max(np.abs(value))), 1e-300)
        assert np.max(np.abs(ours[name] - value)) <= 1e-9 * scale, name


def test_tangents_that_jump_agree_with_the_event_aware_reverse_pass(hot):
    ours = Forward(saltation=True)(hot, NAMES)
    theirs = EventAware()(hot, NAMES)
    assert ours.value == theirs.value
    assert ours.details["crossings"] == theirs.details["crossings"] > 50
    agree(ours.gradient, theirs.gradient)


def test_what_flips_add_is_the_sum_of_their_weights(hot):
    tape = Tape(hot.simulation, hot.loss, hot.steps, flips=True)
    names = resolve(hot.simulation, NAMES)
    plain, _ = reverse(tape)
    parts, found = reverse(tape, saltation=True)
    added, total = 0.0, None
    for met, part in zip(reversed(found), tangents(tape, names), strict=True):
        assert part.dr is not None and part.dr_cut is not None
        weight = np.where(met.grazing, 0, met.weight)
        added, total = added + weight @ (part.dr_cut - part.dr), part.total
    by_name = {name: gradient(hot.simulation, plain, name) for name in names}
    agree(gathered(hot.simulation, names, by_column(tape, total)), by_name)
    difference = {name: gradient(hot.simulation, parts, name) - by_name[name] for name in names}
    assert all(np.all(value != 0) for value in difference.values())
    agree(gathered(hot.simulation, names, np.asarray(added)), difference)


def test_too_many_numbers_are_refused_with_their_count(hot):
    with pytest.raises(InputError, match="324 numbers"):
        Forward()(hot, ("x0",))


def test_the_pair_that_leaves_its_well_agrees_by_every_number():
    """Each coordinate of a free pair is a column; stretched, it starts at another distance."""
    simulation = build("pair/leaving-well")
    problem = Problem(simulation, FinalProjection(direction=jnp.asarray([[1.0, 0], [0, 0], [0, 0]])), 2000)
    names = ("x0", "v0", "scale", "sigma")
    ours, theirs = Forward(saltation=True)(problem, names), EventAware()(problem, names)
    for name, value in theirs.gradient.items():
        assert ours.gradient[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    apart = simulation.positions[1] - simulation.positions[0]
    # the pair moves as a whole too
    by_distance = float(np.sum(theirs.gradient["initial.positions"] * simulation.positions))
    assert np.linalg.norm(apart) == pytest.approx(1.8)
    assert float(ours.gradient["box.scale"]) == pytest.approx(by_distance, rel=1e-9)


def test_states_are_those_of_differences():
    """The tangent of a late state, against two runs started apart."""
    simulation = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))
    problem = Problem(simulation, everything(simulation.atoms), 30)

    def last(scale: float) -> np.ndarray:
        from mdnum.gradients.parameters import with_values
        from mdnum.rollout.engine import Engine

        shifted = with_values(simulation, {"potential.sigma": np.asarray(1.0 + scale)})
        *_, segment = Engine(shifted, 30).segments()
        images = segment.unsorted("images", segment.rows - 1)
        return segment.unsorted("x", segment.rows - 1) + images @ np.asarray(simulation.cell.matrix)

    step = 1e-5
    difference = (last(step) - last(-step)) / (2 * step)
    *_, part = tangents(Tape(simulation, problem.loss, 30), ("potential.sigma",), states=True)
    assert part.x is not None
    ours = np.empty_like(difference)
    ours[part.stretch.table.order] = part.x[-1, 0].T
    assert ours == pytest.approx(difference, rel=1e-6, abs=1e-6 * np.abs(difference).max())


def test_a_tape_without_flips_cannot_jump(hot):
    tape = Tape(hot.simulation, hot.loss, hot.steps)
    with pytest.raises(InputError, match="without its flips"):
        list(tangents(tape, ("potential.sigma",), saltation=True))
    assert replace(Forward(), most=0).why_not(hot, ("potential.sigma",)) is not None
