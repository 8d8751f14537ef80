"""Whole numbers: decisions, forces and steps against exact fractions and against one another."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.md.decide import CONVENTIONS
from mdnum.md.fixed_point import REACH_BITS, FixedPointDecider, power_of_two
from mdnum.rollout.engine import Engine
from mdnum.systems import build

HARD = {"kind": "hard", "radius": 1.5}
FIXED_POINT = {"state": "lattice"}


def small(**tables):
    """32 atoms in a box 3.6 wide."""
    return build(make(crystal(repeat=2), LENNARD_JONES, HARD, **{"precision": FIXED_POINT, **tables}))


@pytest.fixture(scope="module")
def liquid():
    return small()


def run(simulation, steps: int):
    """Positions, velocities, energies and pairs inside of every step, in the user's order."""
    rows, energies, pairs = [], [], []
    for segment in Engine(simulation, steps).segments():
        for row in range(segment.rows):
            rows.append([segment.unsorted(name, row) for name in ("x", "v", "images")])
            i, j = segment.table.decided(segment.rows_of("bits")[row])
            pairs.append(frozenset(zip(i.tolist(), j.tolist(), strict=True)))
        energies.append([segment.rows_of(name) for name in ("potential", "kinetic", "virial")])
    return rows, np.concatenate(energies, axis=1), pairs


@pytest.mark.parametrize("compare", CONVENTIONS)
@pytest.mark.parametrize("radius", (1.5, 1.1, 2.0**0.5))
def test_the_limit_is_that_of_exact_fractions(compare, radius):
    decider = FixedPointDecider((radius,), compare, spacing=2.0**-29)
    (limit,) = decider.limits
    unit = Fraction(decider.spacing)

    def inside(n: int) -> bool:
        """Of an exact squared distance, by the convention as it is written."""
        square = n * unit**2
        held = Fraction(radius * radius) if compare.startswith("r2") else Fraction(radius) ** 2
        return square <= held if compare.endswith("=") else square < held

    assert inside(limit - 1) and not inside(limit)


def test_a_margin_has_the_sign_of_its_decision_where_doubles_round():
    decider = FixedPointDecider((1.5,), "r2 <", spacing=power_of_two(1.7 / 2**REACH_BITS))
    edge = round(1.5 / decider.spacing)
    for step in (-1, 0, 1):
        d = (np.array([(edge + step) * decider.spacing]), np.zeros(1), np.zeros(1))
        margin = decider.host_margin(d, np.zeros(1, np.int64))
        assert (margin > 0) == (step < 0)


def test_forces_sum_to_nothing_and_agree_with_floats(liquid):
    forces = liquid.evaluate().forces
    counted = forces / liquid.fixed_point.force
    assert np.array_equal(counted, np.round(counted)) and np.abs(counted).max() > 2**30
    # exact in integers of any size
    assert [sum(int(q) for q in column) for column in counted.T] == [0, 0, 0]
    floats = liquid.smooth.evaluate(liquid.fixed_point.positions(liquid.positions))
    assert np.allclose(forces, floats.forces, rtol=0, atol=1e-9)
    assert liquid.evaluate().energy == pytest.approx(floats.energy, rel=1e-11)


def test_places_and_momenta_stay_whole_and_momentum_is_conserved(liquid):
    rows, _, _ = run(liquid, 120)
    scheme, masses = liquid.propagator, jnp.asarray(liquid.masses)
    start = None
    for x, v, _ in rows[::20]:
        places = x / liquid.fixed_point.spacing
        assert np.array_equal(places, np.round(places))
        momentum = np.asarray(scheme.momentum(jnp.asarray(v.T), masses))
        assert np.array_equal(scheme.velocity(jnp.asarray(momentum), masses), v.T)
        total = [sum(int(p) for p in row) for row in momentum]
        start = total if start is None else start
        assert total == start
    # the unit that a person is told: momenta are whole multiples of it, and have no larger one in common
    told = liquid.fixed_point.to_dict(float(liquid.integrator.timestep))["momentum"]
    counted = liquid.masses[:, None] * rows[-1][1] / told
    whole = np.rint(counted)
    assert np.abs(counted - whole).max() < 1e-3 and math.gcd(*map(int, whole.flat)) == 1


def relabelled(simulation, labels):
    """The same atoms under other numbers."""
    return replace(
        simulation,
        structure=simulation.structure[labels],
        positions=simulation.positions[labels],
        velocities=simulation.velocities[labels],
        masses=simulation.masses[labels],
        species=simulation.species[labels],
    )


def same(a, b, labels=None):
    """Whether two runs agree in every bit of state and energy, and in every decision."""
    labels = np.arange(len(a[0][0][0])) if labels is None else labels
    for ours, theirs in zip(a[0], b[0], strict=True):
        for p, q in zip(ours, theirs, strict=True):
            assert np.array_equal(p[labels], q)
    assert np.array_equal(a[1], b[1])
    for ours, theirs in zip(a[2], b[2], strict=True):
        assert ours == {tuple(sorted((int(labels[i]), int(labels[j])))) for i, j in theirs}


def test_labels_do_not_matter(liquid):
    labels = np.random.default_rng(5).permutation(liquid.atoms)
    same(run(liquid, 120), run(relabelled(liquid, labels), 120), labels)


def test_a_pair_too_close_to_count_stops_the_run(liquid):
    close = np.array(liquid.positions)
    close[1] = close[0] + np.array([0.3, 0.0, 0.0])
    segments = list(Engine(replace(liquid, positions=close), 120).segments())
    assert segments[-1].closes == "blow-up" and segments[-1].last == 0


@pytest.mark.nightly
def test_neither_lists_nor_the_order_of_sums_matter(liquid):
    plain = run(liquid, 400)
    for changed in (
        small(neighbors={"skin": 0.1}),
        small(neighbors={"skin": 0.2, "builder": "jax-md"}),
        small(precision={**FIXED_POINT, "reduction": "permuted"}),
    ):
        # the units are chosen by the radius of the list; the same for all of these
        assert changed.fixed_point == liquid.fixed_point
        same(plain, run(changed, 400))


def test_an_atom_at_the_far_face_is_at_the_near_one(liquid):
    length = float(liquid.cell.matrix[0, 0])
    x = jnp.asarray([length, 0.0, length - liquid.fixed_point.spacing, -liquid.fixed_point.spacing])
    (wrapped, _, _), _ = liquid.cell.astype(np.float64).wrap(x, x, x)
    assert wrapped.tolist() == [
        0.0,
        0.0,
        length - liquid.fixed_point.spacing,
        length - liquid.fixed_point.spacing,
    ]


def test_what_a_fixed_point_state_cannot_be_is_refused():
    with pytest.raises(InputError, match="orthorhombic"):
        build("argon/tilted-500", {"precision.state": "lattice"})
    with pytest.raises(InputError, match="Omit the keys `force"):
        build("argon/crystal-108", {"precision.state": "lattice", "precision.force": "float32"})
    table = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 1e-6}
    with pytest.raises(InputError, match="friction"):
        small(dynamics=table)
