"""The exact program against rationals and another library, at two precisions, and against real runs."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import combinations, pairwise

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import small_systems
from ase import Atoms
from oracles import cut_energy

import mdnum
from mdnum.errors import InputError
from mdnum.forks.exact.program import ExactProgram, unsupported
from mdnum.forks.tape import DecisionTape, first_difference, taped
from mdnum.rollout.engine import first_state
from mdnum.rollout.program import MdProgram
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

pytest.importorskip("flint", reason="exact runs need python-flint")


def liquid(kind: str = "hard", cells: int = 2, radius: float = 1.55, **tables) -> Simulation:
    """32 atoms (by default) at density 0.84, hot enough to melt."""
    cutoff = {"kind": kind, "radius": radius}
    if kind in ("switched", "quintic", "cosine"):
        cutoff["onset"] = 1.3
    cutoff |= tables.pop("cutoff", {})
    tables.setdefault("dynamics", {"kind": "nve", "timestep": 0.004, "temperature": 2.9, "seed": 3})
    atoms = small_systems.crystal(cells, 0.02, 1.68)
    return build(
        small_systems.make(
            atoms, small_systems.LENNARD_JONES, cutoff, **({"neighbors": {"skin": 0.1}} | tables)
        )
    )


def leapfrog(simulation: Simulation, steps: int, number, pull, short=lambda q: q):
    """Positions and pairs inside of every step in any kind of number, one pair at a time.

    Args:
        pull: of r², the factor of a pair's displacement in its force; None outside the cutoff.
        short: rounds a coordinate.
    """
    begin = first_state(simulation)
    x, v = (
        [[number(float(c)) for c in row] for row in np.asarray(part).T]
        for part in (begin.state.x, begin.state.v)
    )
    box = [number(float(simulation.cell.matrix[k, k])) for k in range(3)]
    dt = number(float(simulation.integrator.timestep))
    for step in range(steps + 1):
        force, inside = [[number(0)] * 3 for _ in x], set()
        for i, j in combinations(range(len(x)), 2):
            d = [b - a for a, b in zip(x[i], x[j], strict=True)]
            d = [c - round(float(c / side)) * side for c, side in zip(d, box, strict=True)]
            factor = pull(sum(c * c for c in d))
            if factor is not None:
                inside.add((i, j))
                force[i] = [f + factor * c for f, c in zip(force[i], d, strict=True)]
                force[j] = [f - factor * c for f, c in zip(force[j], d, strict=True)]
        yield x, inside
        kick = dt / 2 if step == 0 else dt
        v = [[a + kick * b for a, b in zip(*rows, strict=True)] for rows in zip(v, force, strict=True)]
        x = [[short(a + dt * b) for a, b in zip(*rows, strict=True)] for rows in zip(x, v, strict=True)]


def test_twenty_steps_of_rationals():
    """A hard cutoff in Fractions, rounded to four hundred bits between steps."""
    simulation = liquid()
    threshold = Fraction(simulation.decider.thresholds[0].value)

    def short(q):
        return Fraction(round(q * 2**400), 2**400)

    def pull(r2):
        s6 = 1 / r2**3
        return 2 * short(-12 * s6 * (2 * s6 - 1) / r2) if r2 < threshold else None

    inside = [pairs for _, pairs in leapfrog(simulation, 20, Fraction, pull, short)]
    flips = [
        (step, *pair, pair in after)
        for step, (before, after) in enumerate(pairwise(inside), 1)
        for pair in sorted(before ^ after)
    ]
    tape = ExactProgram(simulation).run(20).tape
    assert [(step, *divmod(key, tape.atoms), entered) for step, key, entered in tape.rows(20)] == flips
    assert tape.flips > 5


@pytest.mark.parametrize("kind", ["force-shifted", "switched", "quintic", "cosine"])
def test_positions_against_another_library(kind: str):
    """The same steps in mpmath at 60 digits, forces as numerical derivatives of the energy's definition."""
    simulation, steps = liquid(kind), 3
    exact = ExactProgram(simulation).run(steps, bits=256)
    mpmath.mp.dps = 60
    rc, ro = mpmath.mpf(1.55), mpmath.mpf(1.3)

    def bare(r):
        return 4 * (r**-12 - r**-6)

    def energy(r):
        if kind != "force-shifted" and r <= ro:
            return bare(r)
        return cut_energy(kind, r, rc, ro, bare, lambda at: mpmath.diff(bare, at), mpmath.cos, mpmath.pi)

    def pull(r2):
        r = mpmath.sqrt(r2)
        return mpmath.diff(energy, r) / r if r < rc else None

    *_, (x, _) = leapfrog(simulation, steps, mpmath.mpf, pull)
    found = np.array([[float(c) for c in row] for row in x])
    np.testing.assert_allclose(exact.x[steps], found, rtol=1e-15, atol=1e-15)


def damped(r, strength, alpha):
    """Operations of which ball arithmetic has an enclosure."""
    return strength * (jax.scipy.special.erfc(alpha * r) / r + jnp.maximum(jnp.exp(-r) - r**-2.5, -1.0))


def test_a_formula_of_ones_own_against_another_library():
    cut = mdnum.Cut("switched", 1.55, onset=1.3)
    potential = mdnum.PairFunction(damped, strength=0.7, alpha=1.1)
    atoms = small_systems.crystal(2, 0.02, 1.68)
    atoms.set_masses(np.ones(len(atoms)))
    simulation = mdnum.simulation(
        atoms, potential, cut, timestep=0.004, temperature=2.9, skin=0.1, units="lj"
    )
    exact, steps = ExactProgram(simulation).run(2, bits=256), 2
    mpmath.mp.dps = 60
    alpha, strength, rc, ro = map(mpmath.mpf, (1.1, 0.7, 1.55, 1.3))

    def bare(r):
        return strength * (mpmath.erfc(alpha * r) / r + max(mpmath.exp(-r) - r ** mpmath.mpf(-2.5), -1))

    def energy(r):
        return bare(r) if r <= ro else cut_energy("switched", r, rc, ro, bare, None, mpmath.cos, mpmath.pi)

    def pull(r2):
        r = mpmath.sqrt(r2)
        return mpmath.diff(energy, r) / r if r < rc else None

    *_, (x, _) = leapfrog(simulation, steps, mpmath.mpf, pull)
    found = np.array([[float(c) for c in row] for row in x])
    np.testing.assert_allclose(exact.x[steps], found, rtol=1e-15, atol=1e-15)


def test_two_precisions_agree_and_a_small_one_is_raised():
    simulation = liquid()
    low, high = ExactProgram(simulation).run(80), ExactProgram(simulation).run(80, bits=600)
    assert first_difference(low.tape, high.tape) is None
    np.testing.assert_array_equal(low.x, high.x)
    raised = ExactProgram(simulation).run(80, bits=24)
    assert raised.restarts > 0 and raised.bits > 24
    assert first_difference(raised.tape, high.tape) is None
    # a ball holds the other's center, and grows
    assert np.all(np.diff(low.radius[1:]) > -1) and high.radius[-1] < low.radius[-1] - 300
    assert low.margin.min() > 0


@pytest.mark.parametrize("seed", range(10))
def test_a_planted_wrong_decision_is_found(seed: int):
    rng = np.random.default_rng(seed)
    atoms = 20
    step = np.sort(rng.integers(1, 500, 80))
    key = rng.choice(atoms * atoms, 80, replace=False)
    entered = rng.random(80) < 0.5
    first = np.sort(key[~entered])
    tape = DecisionTape(atoms, 500, first, step, key, entered)
    row = int(rng.integers(80))
    # one decision that comes a step late, one that never comes, one that is not there
    late = replace(tape, step=np.where(np.arange(80) == row, step + 1, step))
    kept = np.arange(80) != row
    never = replace(tape, step=step[kept], key=key[kept], entered=entered[kept])
    extra_key = int(np.setdiff1d(np.arange(atoms * atoms), key)[seed])
    place = int(np.searchsorted(step, 250))
    extra = replace(
        tape,
        step=np.insert(step, place, 250),
        key=np.insert(key, place, extra_key),
        entered=np.insert(entered, place, True),
    )
    for other in (late, never):
        found = first_difference(tape, other)
        assert found is not None and (found.step, found.subject) == (step[row], divmod(key[row], atoms))
        assert (found.a, found.b) == (entered[row], not entered[row])
    found = first_difference(tape, extra)
    assert found is not None and (found.step, found.subject) == (250, divmod(extra_key, atoms))
    assert (found.a, found.b) == (0, 1)
    assert first_difference(tape, tape) is None
    # a tape that ended before is not different
    assert first_difference(replace(extra, steps=249), replace(tape, steps=249)) is None
    with pytest.raises(ValueError, match="20 and 21 atoms"):
        first_difference(tape, replace(tape, atoms=21))
    start = first_difference(tape, replace(tape, first=first[1:]))
    assert start is not None and start.step == 0 and start.subject == divmod(first[0], atoms)


def test_a_pair_exactly_at_the_cutoff_is_decided_by_the_convention():
    """At rest and beyond reach of each other: the distance is the cutoff, exactly, at every step."""
    counts = {}
    for compare in ("r2 <", "r2 <=", "r <", "r <="):
        atoms = Atoms("Ar2", [[1, 1, 1], [2.5, 1, 1]], cell=[8, 8, 8], pbc=True)
        atoms.set_masses([1.0, 1.0])
        atoms.set_velocities(np.zeros((2, 3)))
        dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 0.0}
        simulation = build(
            small_systems.make(
                atoms,
                small_systems.LENNARD_JONES,
                {"kind": "hard", "radius": 1.5, "compare": compare},
                dynamics=dynamics,
            )
        )
        exact = ExactProgram(simulation).run(0)
        counts[compare] = len(exact.tape.first)
        assert exact.close == 1 and exact.margin[0] == 0.0
    assert counts == {"r2 <": 0, "r2 <=": 1, "r <": 0, "r <=": 1}


def test_species_masses_and_a_tilted_box():
    """Pair types, unequal masses and lattice vectors off the axes, against the real run."""
    atoms = small_systems.mixture()
    matrix = np.array(atoms.cell)
    matrix[1, 0], matrix[2, 1] = 0.7, -0.4
    atoms.set_cell(matrix, scale_atoms=True)
    atoms.set_masses(np.linspace(0.8, 1.3, len(atoms)))
    simulation = build(small_systems.make(atoms, small_systems.KOB_ANDERSEN, {"kind": "hard", "radius": 1.6}))
    exact, tape = ExactProgram(simulation).run(12), taped(MdProgram(simulation), 12, lambda segment: None)
    assert first_difference(exact.tape, tape) is None and exact.tape.flips > 5
    np.testing.assert_array_equal(exact.tape.inside(12), tape.inside(12))


def test_what_cannot_be_certified_is_error():
    potential = mdnum.PairFunction(lambda r, a: a * jnp.sinh(-r), a=1.0)
    simulation = mdnum.simulation(
        small_systems.crystal(), potential, mdnum.Cut("hard", 1.6), timestep=0.004, skin=0.1, units="lj"
    )
    with pytest.raises(InputError, match="sinh") as caught:
        ExactProgram(simulation)
    assert caught.value.where == "potential.kind"
    morse = {"kind": "morse", "depth": 1.0, "alpha": 5.0, "r0": 1.1}
    cutoff = {"kind": "hard", "radius": 1.6}
    assert unsupported(build(small_systems.make(small_systems.crystal(), morse, cutoff))) is None
    langevin = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 1.0, "seed": 1}
    error = unsupported(liquid(dynamics=langevin))
    assert error is not None and error.where == "dynamics.kind"
    error = unsupported(build("argon/liquid-864"))
    assert error is not None and "864 atoms" in str(error)
    assert unsupported(liquid()) is None
    with pytest.raises(InputError, match="steps = -1"):
        ExactProgram(liquid()).run(-1)
