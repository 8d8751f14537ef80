"""Turning a number is what `--set` does, without compiling."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import run_epoch
from mdnum.systems.build import build
from mdnum.systems.parameters import dial, names, unit


def leaves(simulation) -> list[np.ndarray]:
    """All numbers that decide a trajectory."""
    parts = (simulation.model, simulation.integrator)
    arrays = [
        np.asarray(leaf)
        for leaf in jax.tree.leaves(parts)
        if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    ]
    rule = np.array([simulation.rule.skin, simulation.rule.every])
    return [*arrays, np.asarray(simulation.decider.r_cut), rule, simulation.positions, simulation.velocities]


@pytest.mark.parametrize(
    ("system", "key", "setting", "factor"),
    [
        ("argon/crystal-108", "sigma", "potential.sigma", 1.01),
        ("argon/crystal-108", "potential.epsilon", "potential.epsilon", 0.97),
        ("argon/crystal-108", "r_cut", "cutoff.radius", 0.99),
        ("argon/crystal-108", "skin", "neighbors.skin", 0.7),
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
    one = dial(mixture, "Ni-P.epsilon")
    assert one.key == "potential.pairs.Ni-P.epsilon" and one.key in names(mixture)
    turned = one.turn(mixture, 3.0)
    # of its pair of species alone
    changed = np.asarray(turned.potential.epsilon) != np.asarray(mixture.potential.epsilon)
    assert changed.sum() == 1


SWITCHED = {"cutoff.kind": "switched", "cutoff.onset": 7.5}


@pytest.mark.parametrize(
    ("system", "overrides", "word", "value", "message"),
    [
        ("argon/crystal-108", {}, "r_cut", 3.0, "exceeds half"),
        ("argon/crystal-108", {}, "skin", 5.0, "half the smallest"),
        ("argon/crystal-108", {}, "dynamics.temperature", 1.0, "can be turned"),
        ("argon/liquid-864", SWITCHED, "onset", 9.0, r"9\.0 is not below .*8\.5"),
        ("argon/liquid-864", SWITCHED, "radius", 7.0, "not above its onset"),
        ("argon/liquid-864", {}, "timestpe", 1.0, r"Did you mean dynamics\.timestep\?"),
        ("binary/kob-andersen-1000", {}, "epsilon", 1.0, r"any of potential\.pairs\.\S+epsilon, "),
    ],
)
def test_what_cannot_be_turned_is_refused(system, overrides, word, value, message):
    simulation = build(system, overrides)
    with pytest.raises(InputError, match=message):
        dial(simulation, word).turn(simulation, value)
