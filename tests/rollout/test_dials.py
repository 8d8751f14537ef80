"""Turning a number is what `--set` does, without compiling."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.rollout.dials import dial, names, unit
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import run_epoch
from mdnum.systems.build import build


def leaves(simulation) -> list[np.ndarray]:
    """All numbers that decide a trajectory."""
    parts = (simulation.model, simulation.integrator)
    arrays = [
        np.asarray(leaf)
        for leaf in jax.tree.leaves(parts)
        if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    ]
    return [*arrays, np.asarray(simulation.decider.r_cut), simulation.positions, simulation.velocities]


@pytest.mark.parametrize(
    ("system", "key", "setting", "factor"),
    [
        ("argon/crystal-108", "sigma", "potential.sigma", 1.01),
        ("argon/crystal-108", "potential.epsilon", "potential.epsilon", 0.97),
        ("argon/crystal-108", "r_cut", "cutoff.radius", 0.99),
        ("argon/liquid-864", "timestep", "dynamics.timestep", 1.1),
        ("argon/langevin-500", "temperature", "dynamics.temperature", 1.3),
        ("argon/langevin-500", "friction", "dynamics.friction", 0.7),
    ],
)
def test_a_number_turned_is_the_number_set(system, key, setting, factor):
    plain = build(system)
    one = dial(plain, key)
    value = one.value * factor
    turned, fresh = one.turn(plain, value), build(system, {setting: value})
    assert one.key == setting
    for ours, theirs in zip(leaves(turned), leaves(fresh), strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert one.value == pytest.approx(dial(fresh, key).value / factor, rel=1e-15)
    again = one.turn(plain, one.value)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(leaves(again), leaves(plain), strict=True))


def test_velocities_and_coordinates_are_in_the_units_of_the_file():
    plain = build("argon/liquid-864")
    factor = plain.units.time_factor
    one = dial(plain, "velocity.5.z")
    assert one.value == pytest.approx(plain.velocities[5, 2] * factor)
    assert one.turn(plain, 2.0).velocities[5, 2] == pytest.approx(2.0 / factor)
    assert np.array_equal(dial(plain, "velocity.scale").turn(plain, 2.0).velocities, 2 * plain.velocities)
    moved = dial(plain, "position.3.y").turn(plain, 1.5)
    assert moved.positions[3, 1] == 1.5 and np.sum(moved.positions != plain.positions) == 1


def test_pairs_of_species_have_numbers_of_their_own():
    plain = build("binary/kob-andersen-1000")
    kinds = [name for name in names(plain) if name.endswith("sigma")]
    assert len(kinds) in (0, 3)
    for name in (name for name in names(plain) if name.endswith("epsilon")):
        turned = dial(plain, name).turn(plain, 3.0)
        changed = np.asarray(turned.potential.epsilon) != np.asarray(plain.potential.epsilon)
        assert changed.sum() == 1


def test_no_number_costs_a_compilation():
    plain = build("argon/crystal-108")

    def run(simulation):
        list(Engine(simulation, 120).segments())

    run(plain)
    before = run_epoch._cache_size()
    for key, value in (("sigma", 1.01), ("epsilon", 1.01), ("timestep", 0.0041), ("r_cut", 1.51)):
        run(dial(plain, key).turn(plain, value))
    run(dial(plain, "velocity.scale").turn(plain, 1.01))
    assert run_epoch._cache_size() == before


def test_a_radius_that_does_not_fit_is_refused():
    plain = build("argon/crystal-108")
    with pytest.raises(InputError, match="exceeds half"):
        dial(plain, "r_cut").turn(plain, 3.0)
    with pytest.raises(InputError, match="can be turned"):
        dial(plain, "dynamics.temperature")


def test_the_last_word_will_do_where_only_one_number_ends_so():
    argon, mixture = build("argon/liquid-864"), build("binary/kob-andersen-1000")
    for word, key, what in (
        ("sigma", "potential.sigma", "Å"),
        ("dt", "dynamics.timestep", "ps"),
        ("r_cut", "cutoff.radius", "Å"),
        ("skin", "neighbors.skin", "Å"),
        ("velocity.3.x", "velocity.3.x", "Å/ps"),
        ("epsilon", "potential.epsilon", "eV"),
    ):
        assert dial(argon, word).key == key and unit(argon, key) == what
    assert dial(mixture, "Ni-P.epsilon").key == "potential.pairs.Ni-P.epsilon"
    with pytest.raises(InputError, match=r"could be any of potential\.pairs\.\S+epsilon, "):
        dial(mixture, "epsilon")
    with pytest.raises(InputError, match=r"Did you mean dynamics\.timestep\?"):
        dial(argon, "timestpe")


def test_a_skin_turned_is_the_skin_set():
    plain = build("argon/crystal-108")
    one = dial(plain, "skin")
    turned, fresh = one.turn(plain, 0.2), build("argon/crystal-108", {"neighbors.skin": 0.2})
    assert one.value == plain.rule.skin != 0.2 and turned.rule == fresh.rule
    with pytest.raises(InputError, match="half the smallest"):
        one.turn(plain, 5.0)


def test_an_onset_stays_below_its_cutoff():
    plain = build("argon/liquid-864", {"cutoff.kind": "switched", "cutoff.onset": 7.5})
    with pytest.raises(InputError, match="not below the cutoff radius"):
        dial(plain, "onset").turn(plain, 9.0)
    with pytest.raises(InputError, match="not above its onset"):
        dial(plain, "radius").turn(plain, 7.0)
