"""Derivatives of the steps: against differences, JAX's own reverse mode and imaginary steps in numpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from gradient_problems import everything
from small_systems import KOB_ANDERSEN, LENNARD_JONES, make, mixture

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.differences import FiniteDifferences, richardson
from mdnum.gradients.losses import Custom, FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward, Symmetric
from mdnum.gradients.tape import KEPT, RunTape
from mdnum.gradients.unrolled import Unrolled, departure, marks
from mdnum.md.energies import EnergyFunction
from mdnum.md.jaxmd import neighbor_vectors
from mdnum.rollout.engine import Engine
from mdnum.systems import build

SCALARS = ("timestep", "temperature", "scale")


def alike(found, expected, within: float = 1e-9) -> None:
    """Derivatives by the same parameters."""
    for name, one in expected.items():
        assert np.max(np.abs(found[name] - one)) <= within * np.max(np.abs(one)), name


def test_derivatives_are_those_of_differences(switched, by_hand):
    names = ("sigma", "epsilon", "r_onset", *SCALARS)
    ours, theirs = by_hand, FiniteDifferences(relative=1e-5, levels=3)(switched, names)
    assert ours.value == theirs.value
    # every radius is compiled for
    radius = float(switched.simulation.model.r_cut[0])
    by_radius = richardson(lambda q: switched.value({"cutoff.radius": q}), radius, 2e-6, 1).table[0][1]
    assert float(ours.gradient["cutoff.radius"]) == pytest.approx(by_radius, rel=1e-6)
    for name, value in theirs.gradient.items():
        error = theirs.details["error"][name]
        assert error < 1e-5 * abs(value), name
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=1e-6), name


def test_the_start_has_the_derivatives_of_differences(switched, by_hand):
    simulation = switched.simulation
    rng = np.random.default_rng(1)
    for name in ("initial.positions", "initial.velocities"):
        way = rng.standard_normal((simulation.atoms, 3))
        here = getattr(simulation, name.partition(".")[2])

        def shifted(q: float, name: str = name, here=here, way=way) -> float:
            return switched.value({name: here + q * way})

        found = richardson(shifted, 0.0, 1e-4, 4)
        assert float(np.sum(by_hand.gradient[name] * way)) == pytest.approx(found.value, rel=1e-7)


@pytest.mark.slow
def test_pair_types_in_a_bath_have_their_own_derivatives():
    dynamics = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 2.0, "seed": 3}
    cutoff = {"kind": "quintic", "radius": 2.0, "onset": 1.7}
    simulation = build(make(mixture(), KOB_ANDERSEN, cutoff, dynamics=dynamics))
    problem = Problem(simulation, everything(simulation.atoms), 12)
    ours = Symmetric()(problem, ("sigma", "epsilon", "friction", *SCALARS))
    theirs = FiniteDifferences(relative=1e-5, levels=3)(problem, ("friction", *SCALARS))
    for name, value in theirs.gradient.items():
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=2e-6), name
    for name in ("potential.sigma", "potential.epsilon"):
        here = np.asarray(getattr(simulation.model.potential, name.partition(".")[2]))
        assert ours.gradient[name].shape == here.shape == (3,)
        for kind in range(3):

            def shifted(q: float, kind: int = kind, name: str = name, here=here) -> float:
                return problem.value({name: here + q * (np.arange(3) == kind)})

            found = richardson(shifted, 0.0, 1e-6, 3)
            assert float(ours.gradient[name][kind]) == pytest.approx(found.value, rel=1e-5), (name, kind)


def test_made_again_the_run_has_the_bits_it_had(switched, by_hand):
    again = Symmetric(budget=0)(switched, tuple(by_hand.gradient))
    assert again.details["run again"] == by_hand.details["stretches"] > 1
    assert again.value == by_hand.value
    for name, one in by_hand.gradient.items():
        assert np.array_equal(again.gradient[name], one)


def test_bad_input_says_what_there_is(switched, silicon):
    simulation, method = switched.simulation, Symmetric()
    narrow = build("argon/crystal-108", {"precision.force": "bfloat16"})
    vector = Custom(see=lambda frame, *_: frame.x)
    for ask, text in (
        (lambda: method(switched, ("sigmo",)), "Did you mean sigma"),
        (lambda: method(switched, ("seed",)), "no"),
        (lambda: method(switched, ("skin",)), "which list"),
        (lambda: Problem(simulation, vector, switched.steps), "scalar"),
        (lambda: Problem(simulation, switched.loss, 3), "at any step"),
        (lambda: method(Problem(narrow, FinalProjection(), 10), ("sigma",)), "bfloat16 are rounded"),
        (lambda: EventAware()(silicon, ("x0",)), "pair potentials"),
    ):
        with pytest.raises(InputError, match=text):
            ask()


def test_a_parameter_that_nothing_depends_on_is_said_to_be_one(switched):
    loss = jax.tree.map(jnp.zeros_like, switched.loss)
    found = Symmetric()(replace(switched, loss=loss), ("sigma", "timestep", "scale"))
    assert float(found.gradient["potential.sigma"]) == 0.0
    assert "not depend" in found.notes["potential.sigma"]


# --- JAX's own reverse mode, which shares no derivative code with it --------------------------------


@pytest.mark.parametrize("budget", [KEPT, pytest.param(20_000, marks=pytest.mark.nightly), 0])
def test_whatever_is_kept_the_gradient_is_one(switched, by_hand, budget):
    found = Unrolled(budget)(switched, tuple(by_hand.gradient))
    assert found.value == by_hand.value
    alike(found.gradient, by_hand.gradient)
    # what was linearized is the run, to the last bit
    primal = found.details["primal"]
    assert primal["first state"] is primal["first decision"] is None
    assert primal["steps compared"] == switched.steps and primal["value of the run"] == found.value
    # every chunk is run once ahead and once for its derivative; with fewer states others are run again
    chunks, run = found.details["chunks"], found.details["chunks run"]
    assert run == 2 * chunks if budget == KEPT else run > 2 * chunks


def test_a_departure_is_found_where_it_was_planted(switched):
    run, other = {}, {}
    for segment in Engine(switched.simulation, switched.steps).segments():
        x, bits = np.array(segment.record.x), np.array(segment.record.bits)
        given = (segment.first, range(segment.rows))
        run.update(marks(*given, x, segment.record.v, bits, segment.table))
        # one bit of one coordinate at step 17, one decision at step 23
        if segment.first <= 17 < segment.first + segment.rows:
            row = 17 - segment.first
            x[row, 1, 50] = np.nextafter(x[row, 1, 50], np.inf)
        if segment.first <= 23 < segment.first + segment.rows:
            # of a pair, seen from its first atom
            bits[23 - segment.first, :, 0] ^= 1
        other.update(marks(*given, x, segment.record.v, bits, segment.table))
    assert list(departure(run, other).values()) == [40, 17, 23]
    assert list(departure(run, run).values()) == [40, None, None]


@pytest.fixture(scope="module")
def silicon():
    atoms = bulk("Si", cubic=True) * (2, 2, 2)
    atoms.rattle(0.05, seed=1)
    dynamics = {"kind": "nve", "timestep": 0.001, "temperature": 600.0, "seed": 1}
    system = make(
        atoms, {"kind": "stillinger-weber"}, units="metal", dynamics=dynamics, neighbors={"skin": 0.2}
    )
    simulation = build(system)
    return Problem(simulation, everything(simulation.atoms), 12)


@pytest.mark.nightly
def test_silicon_has_the_derivatives_of_differences_and_of_jax(silicon):
    found = Symmetric()(silicon, parameters.names(silicon.simulation))
    scalars = [name for name in found.gradient if not name.startswith("initial.")]
    for method, some in ((Unrolled(), parameters.names(silicon.simulation)), (Forward(), scalars)):
        other = method(silicon, some).gradient
        alike(other, {name: found.gradient[name] for name in some})
    # constants are compiled in, so that each value is another program
    for name in ("potential.sigma", "box.scale"):
        here = float(parameters.value(silicon.simulation, name))
        low, high = (silicon.value({name: here * (1 + q)}) for q in (-1e-5, 1e-5))
        assert float(found.gradient[name]) == pytest.approx((high - low) / (2e-5 * here), rel=1e-5), name


ONSET, RADIUS = 1.8, 2.2


def lennard_jones(parameters, positions, neighbor, cell):
    """A switched Lennard-Jones energy, written by somebody who knows nothing of this package."""
    d = neighbor_vectors(positions, neighbor.idx, cell, (True, True, True))
    real = neighbor.idx < positions.shape[0]
    r = jnp.sqrt(jnp.where(real, jnp.sum(d * d, axis=-1), 1.0))
    s6 = (parameters["size"] / r) ** 6
    t = jnp.clip((r - ONSET) / (RADIUS - ONSET), 0.0, 1.0)
    smooth = 1 - 10 * t**3 + 15 * t**4 - 6 * t**5
    inside = real & (r < RADIUS)
    return 0.5 * jnp.sum(jnp.where(inside, 4 * parameters["depths"][0] * (s6 * s6 - s6) * smooth, 0.0))


@pytest.mark.slow
def test_any_energy_has_the_derivatives_of_the_closed_forms_and_tangents_that_agree(switched, by_hand):
    """The same energy as a function instead of the package's own pair potential."""
    constants = {"size": jnp.asarray(1.0), "depths": jnp.asarray([1.0])}
    assert float(switched.simulation.model.r_cut[0]) == RADIUS
    function = switched.simulation.with_model(EnergyFunction(constants, lennard_jones, RADIUS))
    of_function = replace(switched, simulation=function)
    words, shared = ("size", "potential.parameters.depths"), ("timestep", "temperature", "scale", "x0", "v0")
    ours = Symmetric()(of_function, (*words, *shared))
    assert ours.value == pytest.approx(by_hand.value, rel=1e-9)
    # in the order that was asked for; two programs, that have grown apart by rounding for 40 steps
    theirs = [one for name, one in by_hand.gradient.items() if not name.startswith("cutoff.")]
    alike(ours.gradient, dict(zip(ours.gradient, theirs, strict=True)))
    assert ours.gradient["potential.parameters.depths"].shape == (1,)
    tangents = Forward()(of_function, (*words, *shared[:3])).gradient
    alike(tangents, {name: ours.gradient[name] for name in tangents})


# --- answers that no code of the package enters -----------------------------------------------------


def verlet(problem: Problem, **shifts: Any) -> complex:
    """The loss of velocity Verlet in numpy, with numbers shifted: by an imaginary step nothing cancels."""
    simulation = problem.simulation
    names = ("sigma", "epsilon", "timestep", "scale", "temperature")
    sigma, epsilon, h, stretch, heat = (1 + shifts.get(name, 0) for name in names)
    h = h * float(simulation.integrator.timestep)
    x = simulation.positions * stretch + shifts.get("x0", 0)
    v = simulation.velocities * heat**0.5 + shifts.get("v0", 0)
    itself = np.eye(len(x), dtype=bool)

    def forces(x):
        d = x[None] - x[:, None]
        r2 = np.sum(d * d, axis=-1) + itself
        s6 = (sigma * sigma / r2) ** 3
        inside = (np.sqrt(r2.real) < float(simulation.r_cut)) & ~itself
        pull = np.where(inside, 24 * epsilon * (s6 - 2 * s6 * s6) / r2, 0)
        return np.sum(pull[..., None] * d, axis=1)

    for _ in range(problem.steps):
        v = v + h / 2 * forces(x)
        x = x + h * v
        v = v + h / 2 * forces(x)
    return np.sum(np.asarray(problem.loss.direction).T * x) / len(x)


@pytest.mark.slow
def test_four_atoms_have_the_derivatives_of_an_imaginary_step():
    """A hard cutoff that pairs cross on the way: the derivative of the steps, decisions held."""
    places = np.array([[0, 0, 0], [1.1, 0.1, 0], [0.4, 1.2, 0.2], [0.3, 0.3, 1.9]])
    atoms = Atoms("Ar4", positions=places, pbc=False)
    atoms.set_masses([1.0] * 4)
    dynamics = {"kind": "nve", "timestep": 0.01, "temperature": 1.5, "seed": 3}
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.0}, dynamics=dynamics))
    way = jnp.asarray(np.random.default_rng(5).standard_normal((3, 4)))
    problem = Problem(simulation, FinalProjection(direction=way), 60)
    tape = RunTape(simulation, problem.loss, problem.steps, flips=True)
    assert sum(len(stretch.ledger) for stretch in tape.backward()) > 1
    assert problem.value() == pytest.approx(verlet(problem).real, rel=1e-11)
    steps = dict.fromkeys(("sigma", "epsilon", "timestep", "temperature", "scale"), 1e-30j)
    steps |= {"x0": 1e-30j * np.eye(4, 3, 1), "v0": 1e-30j * np.eye(4, 3, -2)}
    expected = {name: verlet(problem, **{name: step}).imag / 1e-30 for name, step in steps.items()}
    expected["timestep"] /= 0.01
    expected["temperature"] /= 1.5
    for method in (Symmetric(), Forward(), Unrolled()):
        found = method(problem, tuple(steps)).gradient
        for (name, value), one in zip(expected.items(), found.values(), strict=True):
            along = np.sum(one * np.imag(steps[name]) * 1e30)
            assert float(along) == pytest.approx(value, rel=1e-10), (method.name, name)
