"""Derivatives of the steps: against differences, JAX's own reverse mode, fifty digits and normal modes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from gradient_problems import everything
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.differences import FiniteDifferences, richardson
from mdnum.gradients.losses import Custom, FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward, Symmetric
from mdnum.gradients.tape import KEPT, RunTape
from mdnum.gradients.unrolled import Unrolled, departure, marks
from mdnum.md.jaxmd import neighbor_vectors
from mdnum.md.manybody import EnergyFunction
from mdnum.rollout.engine import Engine
from mdnum.systems import build
from mdnum.systems.build import with_potential

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
def test_each_pair_type_has_its_own_derivative():
    simulation = build(make(mixture(), KOB_ANDERSEN, {"kind": "shifted", "radius": 2.0}))
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


def test_made_again_the_run_has_the_bits_it_had(switched, by_hand):
    again = Symmetric(budget=0)(switched, tuple(by_hand.gradient))
    assert again.details["run again"] == by_hand.details["stretches"] > 1
    assert again.value == by_hand.value
    for name, one in by_hand.gradient.items():
        assert np.array_equal(again.gradient[name], one)


def test_the_tape_is_the_run_of_the_rollout(switched):
    """States and decisions that the reverse pass linearizes at, against the run without any gradient."""
    tape = RunTape(switched.simulation, switched.loss, switched.steps, budget=0)
    steps = {}
    for segment in Engine(switched.simulation, switched.steps).segments():
        for row in range(segment.rows):
            steps[segment.first + row] = segment.unsorted("x", row)
    seen = 0
    for stretch in tape.backward():
        for row in range(stretch.rows):
            x = np.empty_like(steps[0])
            x[stretch.table.order] = stretch.x[row].T
            assert np.array_equal(x, steps[stretch.first + row])
            seen += 1
    assert seen == switched.steps + 1


@pytest.mark.slow
def test_langevin_derivatives_are_those_of_differences():
    table = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 2.0, "seed": 3}
    system = make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}, dynamics=table)
    simulation = build(system)
    problem = Problem(simulation, everything(simulation.atoms), 40)
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
    loss = jax.tree.map(jnp.zeros_like, switched.loss)
    found = Symmetric()(replace(switched, loss=loss), ("sigma", "timestep", "scale"))
    assert float(found.gradient["potential.sigma"]) == 0.0
    assert "depends" in found.notes["potential.sigma"]


# --- JAX's own reverse mode, which shares no derivative code with it --------------------------------


@pytest.mark.parametrize("budget", [KEPT, pytest.param(20_000, marks=pytest.mark.slow), 0])
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


def test_flips_of_any_energy_are_refused(silicon):
    with pytest.raises(InputError, match="pair potentials"):
        EventAware()(silicon, ("x0",))


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


@pytest.fixture(scope="module")
def both():
    """One system with the package's own pair potential, and with the same energy as a function."""
    pairs = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": RADIUS, "onset": ONSET}))
    constants = {"size": jnp.asarray(1.0), "depths": jnp.asarray([1.0])}
    function = with_potential(pairs, EnergyFunction(constants, lennard_jones, RADIUS))
    return [Problem(one, everything(one.atoms), 40) for one in (pairs, function)]


@pytest.mark.slow
def test_any_energy_has_the_derivatives_of_the_closed_forms(both):
    of_pairs, of_function = both
    assert "potential.parameters.size" in parameters.names(of_function.simulation)
    shared = ("timestep", "temperature", "scale", "x0", "v0")
    theirs = Symmetric()(of_pairs, ("sigma", "epsilon", *shared))
    ours = Symmetric()(of_function, ("size", "potential.parameters.depths", *shared))
    assert ours.value == pytest.approx(theirs.value, rel=1e-9)
    expected = dict(theirs.gradient)
    expected["potential.parameters.size"] = expected.pop("potential.sigma")
    expected["potential.parameters.depths"] = expected.pop("potential.epsilon").reshape(1)
    assert expected.keys() == ours.gradient.keys()
    # two programs, that have grown apart by rounding for 40 steps
    alike(ours.gradient, expected)


@pytest.mark.slow
def test_tangents_of_any_energy_agree_with_its_reverse_pass(both):
    simulation = both[1].simulation
    by_numbers = [name for name in parameters.names(simulation) if not name.startswith("initial.")]
    ours, theirs = Forward()(both[1], by_numbers), Symmetric()(both[1], by_numbers)
    alike(ours.gradient, theirs.gradient)


# --- answers that no code of the package enters -----------------------------------------------------


def in_fifty_digits(problem: Problem, changes: dict[str, mp.mpf]) -> mp.mpf:
    """The loss of velocity Verlet in mpmath, with some numbers shifted."""
    simulation = problem.simulation
    sigma, epsilon, h = (1 + changes.get(k, mp.mpf(0)) for k in ("sigma", "epsilon", "timestep"))
    h = h * mp.mpf(float(simulation.integrator.timestep))
    stretch = 1 + changes.get("scale", mp.mpf(0))
    heat = mp.sqrt(1 + changes.get("temperature", mp.mpf(0)))
    x = [[mp.mpf(float(c)) * stretch for c in row] for row in simulation.positions]
    v = [[mp.mpf(float(c)) * heat for c in row] for row in simulation.velocities]
    x[0][1] += changes.get("x0", mp.mpf(0))
    v[2][0] += changes.get("v0", mp.mpf(0))
    cut = mp.mpf(float(simulation.r_cut))
    atoms = range(len(x))

    def forces():
        out = [[mp.mpf(0)] * 3 for _ in atoms]
        for i in atoms:
            for j in range(i + 1, len(x)):
                d = [b - a for a, b in zip(x[i], x[j], strict=True)]
                r2 = mp.fsum(c * c for c in d)
                if mp.sqrt(r2) >= cut:
                    continue
                s6 = (sigma * sigma / r2) ** 3
                pull = 24 * epsilon * (s6 - 2 * s6 * s6) / r2
                for k in range(3):
                    out[i][k] += pull * d[k]
                    out[j][k] -= pull * d[k]
        return out

    f = forces()
    for _ in range(problem.steps):
        for i in atoms:
            for k in range(3):
                v[i][k] += h / 2 * f[i][k]
                x[i][k] += h * v[i][k]
        f = forces()
        for i in atoms:
            for k in range(3):
                v[i][k] += h / 2 * f[i][k]
    way = np.asarray(problem.loss.direction)
    return mp.fsum(mp.mpf(float(way[k, i])) * x[i][k] for i in atoms for k in range(3)) / len(x)


@pytest.mark.slow
def test_four_atoms_have_the_derivatives_of_fifty_digits():
    """A hard cutoff that pairs cross on the way: the derivative of the steps, decisions held."""
    places = np.array([[0, 0, 0], [1.1, 0.1, 0], [0.4, 1.2, 0.2], [0.3, 0.3, 1.9]])
    atoms = Atoms("Ar4", positions=places, pbc=False)
    atoms.set_masses([1.0] * 4)
    dynamics = {"kind": "nve", "timestep": 0.01, "temperature": 1.5, "seed": 3}
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.0}, dynamics=dynamics))
    way = jnp.asarray(np.random.default_rng(5).standard_normal((3, 4)))
    problem = Problem(simulation, FinalProjection(direction=way), 60)
    names = ("sigma", "epsilon", "timestep", "temperature", "scale")
    tape = RunTape(simulation, problem.loss, problem.steps, flips=True)
    assert sum(len(stretch.ledger) for stretch in tape.backward()) > 1
    mp.mp.dps = 50
    assert problem.value() == pytest.approx(float(in_fifty_digits(problem, {})), rel=1e-11)
    step = mp.mpf(10) ** -18
    expected = {}
    for name in (*names, "x0", "v0"):
        high, low = (in_fifty_digits(problem, {name: q}) for q in (step, -step))
        expected[name] = float((high - low) / (2 * step))
    expected["timestep"] /= 0.01
    expected["temperature"] /= 1.5
    for method in (Symmetric(), Forward(), Unrolled(), Unrolled(budget=0)):
        found = method(problem, (*names, "x0", "v0"))
        seen = dict(zip((*names, "x0", "v0"), found.gradient.values(), strict=True))
        seen["x0"], seen["v0"] = seen["x0"][0, 1], seen["v0"][2, 0]
        for name, value in expected.items():
            assert float(seen[name]) == pytest.approx(value, rel=1e-10), (method.name, name)


@pytest.mark.slow
def test_a_harmonic_ring_has_the_derivatives_of_its_normal_modes():
    """Soft spheres in touch are springs: velocity Verlet turns each mode by a known angle a step."""
    count, spacing, sigma, epsilon, h, steps = 6, 0.8, 1.0, 3.0, 0.02, 150
    rng = np.random.default_rng(4)
    u0 = 0.02 * rng.standard_normal(count)
    places = np.zeros((count, 3))
    places[:, 0] = spacing * np.arange(count) + u0
    atoms = Atoms(f"Ar{count}", positions=places, cell=[spacing * count, 9, 9], pbc=[True, False, False])
    atoms.set_masses([1.0] * count)
    v0 = 0.02 * rng.standard_normal(count)
    atoms.set_velocities(np.stack([v0, 0 * v0, 0 * v0], axis=1))
    potential = {"kind": "soft-sphere", "sigma": sigma, "epsilon": epsilon, "alpha": 2.0}
    system = make(
        atoms,
        potential,
        {"kind": "hard", "radius": sigma},
        dynamics={"kind": "nve", "timestep": h, "temperature": 1.0, "seed": 1, "remove_drift": False},
    )
    simulation = build(system)
    moving = simulation.velocities[:, 0]
    way = rng.standard_normal(count)
    direction = np.zeros((3, count))
    direction[0] = way
    problem = Problem(simulation, FinalProjection(direction=jnp.asarray(direction)), steps)

    # second differences around the ring
    ring = 2 * np.eye(count) - np.roll(np.eye(count), 1, axis=0) - np.roll(np.eye(count), -1, axis=0)
    stiffness, modes = np.linalg.eigh(ring)

    def turned(epsilon, h):
        """Factors of position and velocity of each mode after all steps."""
        w2 = epsilon / sigma**2 * stiffness[1:]
        angle = np.arccos(1 - w2 * h * h / 2 + 0j)
        speed = np.sqrt(w2 * (1 - w2 * h * h / 4) + 0j)
        a = np.concatenate([[1.0], np.cos(steps * angle)])
        b = np.concatenate([[steps * h], np.sin(steps * angle) / speed])
        return modes * a @ modes.T, modes * b @ modes.T

    def loss(epsilon, h):
        a, b = turned(epsilon, h)
        rest = spacing * np.arange(count)
        return way @ (rest + a @ u0 + b @ moving) / count

    # no difference is taken: the step is imaginary
    tiny = 1e-30
    a, b = (part.real for part in turned(epsilon, h))
    by_x, by_v = np.zeros((count, 3)), np.zeros((count, 3))
    by_x[:, 0], by_v[:, 0] = a @ way / count, b @ way / count
    expected = {
        "epsilon": np.asarray(loss(epsilon + 1j * tiny, h).imag / tiny),
        "timestep": np.asarray(loss(epsilon, h + 1j * tiny).imag / tiny),
        "x0": by_x,
        "v0": by_v,
    }
    assert problem.value() == pytest.approx(float(loss(epsilon, h).real), rel=1e-11)
    for method in (Symmetric(), Forward()):
        found = method(problem, tuple(expected))
        for name, value in zip(found.gradient, expected.values(), strict=True):
            # across the ring there are forces in one direction alone
            seen = found.gradient[name][:, 0] if value.ndim else found.gradient[name]
            mine = value[:, 0] if value.ndim else value
            assert np.max(np.abs(seen - mine)) <= 1e-9 * np.max(np.abs(mine)), (method.name, name)
