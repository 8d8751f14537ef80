"""Breaks planted into pair functions, and how they end, found from their values alone."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms

import mdnum
from mdnum.audit.functions import examined
from mdnum.errors import InputError

RADIUS = 2.5


def wall(r):
    return 1 / r**6 - 1 / r**3


def broken(r):
    """A break of every order up to the third, of 1e-3 in the energy."""
    made = wall(r) + jnp.where(r > 1.3, 1e-3, 0) + jnp.where(r > 1.6, 0.02 * (r - 1.6), 0)
    return made + jnp.where(r > 1.9, 0.1 * (r - 1.9) ** 2, 0) + jnp.where(r > 2.2, 0.5 * (r - 2.2) ** 3, 0)


def unfit(r):
    """A pole, and no number beyond 2.1."""
    return 0.01 / (r - 1.43) + jnp.sqrt(2.1 - r) ** 3 + jnp.where(r > 2.1, 0, 0)


def kinked_at_its_end(r2):
    return jnp.where(r2 < RADIUS**2, (r2 - RADIUS**2) * 0.1, 0)


def closed(r):
    """Ends by itself, with its third derivative."""
    return jnp.where(r < 2.3, wall(r) * (1 - (r / 2.3) ** 2) ** 3, 0)


def found(function, kind="hard", symbols="Ar2", **parameters):
    atoms = Atoms(symbols, positions=[[0, 0, 0], [1.2, 0, 0]])
    own = mdnum.PairFunction(function, **parameters)
    made = mdnum.simulation(atoms, own, mdnum.Cut(kind, RADIUS), units="lj", timestep=0.002, skin=0.3)
    return examined(made)


def test_planted_breaks_are_found_with_their_order_size_and_distance():
    seen = found(broken)
    assert seen is not None and seen["smoothness"] == -1
    assert (seen["from"], seen["to"]) == (pytest.approx(1.08), RADIUS)
    rows = seen["places"]
    assert [row["order"] for row in rows] == [0, 1, 2, 3]
    np.testing.assert_allclose([row["distance"] for row in rows], [1.3, 1.6, 1.9, 2.2], atol=1e-6)
    # of the force, which is minus the slope
    np.testing.assert_allclose([row["jump"] for row in rows], [1e-3, -0.02, 0.2, 3.0], rtol=1e-3)
    assert rows[0]["pair"] == "Ar-Ar"


def test_a_pole_and_what_is_no_number_are_found():
    with pytest.raises(InputError, match=r"unfit: .*Ar-Ar.*nan.*2\.5"):
        found(unfit)
    seen = found(lambda r: jnp.where(r > 2.2, 0, unfit(r)))
    assert seen is not None
    rows = [(row["what"], row["distance"]) for row in seen["places"]]
    assert [what for what, _ in rows] == ["singular", "not finite", "not finite"]
    np.testing.assert_allclose([distance for _, distance in rows], [1.43, 2.1, 2.2], atol=1e-6)


@pytest.mark.parametrize(
    ("function", "kind", "order", "breaks"),
    [
        (kinked_at_its_end, "hard", 0, [1]), (closed, "hard", 3, [3]), (wall, "quintic", 2, []),
        *(
            pytest.param(wall, kind, order, [], marks=pytest.mark.nightly)
            for kind, order in {
                "hard": -1, "shifted": 0, "force-shifted": 1, "switched": 1, "cosine": 1
            }.items()
        ),
        pytest.param(lambda r: jnp.tanh(20 * (r - 1.7)), "switched", 1, [], marks=pytest.mark.nightly),
        pytest.param(lambda r: wall(r) + 1e-3 * jnp.sin(60 * r), "shifted", 0, [], marks=pytest.mark.nightly),
        pytest.param(lambda r: jnp.maximum(wall(r), -0.2), "shifted", 0, [1, 1], marks=pytest.mark.nightly),
    ],
)  # fmt: skip
def test_what_ends_is_as_smooth_as_it_is_and_nothing_else_is_seen(function, kind, order, breaks):
    seen = found(function, kind)
    assert seen is not None
    assert seen["smoothness"] == order and [row["order"] for row in seen["places"]] == breaks


def test_each_pair_of_species_is_examined_for_itself():
    def kinked(r, at):
        return wall(r) + jnp.abs(r - (at[0] + at[1]))

    seen = found(kinked, symbols="ArKr", at={"Ar": 0.75, "Kr": 1.0})
    assert seen is not None
    rows = [(row["pair"], row["distance"]) for row in seen["places"]]
    assert [pair for pair, _ in rows] == ["Ar-Ar", "Ar-Kr", "Kr-Kr"]
    np.testing.assert_allclose([distance for _, distance in rows], [1.5, 1.75, 2.0], atol=1e-6)


def test_an_end_of_its_own_where_the_cutoff_is_is_refused():
    """What a pair brings there would count as nothing."""
    with pytest.raises(InputError, match=r"ended: .*Ar-Ar.* -0\.05.* 0 .*2\.5"):

        def ended(r):
            return jnp.where(r < RADIUS, wall(r), 0)

        found(ended)


def test_a_force_that_is_not_the_slope_of_the_energy_is_found():
    seen = found(lambda r: wall(r) + 0.1 * wall(jax.lax.stop_gradient(r)), "shifted")
    assert seen is not None and [row["order"] for row in seen["places"]] == [-2]


def interpolated(r, table):
    return jnp.interp(r, jnp.asarray(PLACES), table)


PLACES = np.linspace(0.9, 2.8, 80)


def test_the_kinks_of_a_table_are_counted_and_its_force_is_the_slope():
    seen = found(interpolated, "shifted", table=wall(PLACES))
    assert seen is not None and [row["order"] for row in seen["places"]] == [1]
    (row,) = seen["places"]
    inside = PLACES[(seen["from"] < PLACES) & (RADIUS > PLACES)]
    assert row["kinks"] == len(inside)
    slopes = np.diff(wall(PLACES)) / np.diff(PLACES)
    first = np.flatnonzero(inside[0] == PLACES)[0]
    assert row["jump"] == pytest.approx(slopes[first - 1] - slopes[first], rel=1e-6)
    assert row["distance"] == pytest.approx(inside[0], abs=1e-9)
    np.testing.assert_allclose(row["between"], [inside[0], inside[-1]], atol=2e-3)


def branched(r):
    return wall(r) if r < 2 else 0 * r


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (lambda r: np.exp(-r), r"jax\.numpy"),
        (lambda r: math.exp(-r), r"jax\.numpy"),
        (branched, r"truth value.*jnp\.where"),
        (lambda r: jnp.sum(wall(r)), r"shape \(\).*each distance"),
    ],
)
def test_what_is_no_function_of_arrays_is_refused_in_a_line(function, word):
    with pytest.raises(InputError, match=word) as caught:
        found(function)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("single", [False, True])
def test_a_function_in_single_precision_is_named(single):
    narrow = jnp.float32 if single else jnp.float64
    seen = found(lambda r: wall(r.astype(narrow)).astype(r.dtype), "shifted")
    assert seen is not None and seen["single"] == single


def test_potentials_of_mdnum_are_not_examined():
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1.2, 0, 0]])
    cut = mdnum.Cut("hard", 2.5)
    assert (
        examined(mdnum.simulation(atoms, mdnum.LennardJones(1.0, 1.0), cut, units="lj", timestep=1)) is None
    )
