"""Parameters by path: another number is what `--set` makes of it, without compiling anew."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import mdnum
from mdnum.errors import InputError
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import run_epoch
from mdnum.rollout.program import MdProgram
from mdnum.systems import describe
from mdnum.systems.build import build
from mdnum.systems.parameters import (
    changed,
    names,
    number,
    numbers,
    resolve,
    unit,
    with_number,
    with_values,
)


def named(simulation, word: str) -> str:
    return resolve(simulation, word, numbers(simulation))


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
    name = named(plain, key)
    here = number(plain, name)
    turned, fresh = with_number(plain, name, here * factor), build(system, {setting: here * factor})
    assert name == setting
    for ours, theirs in zip(leaves(turned), leaves(fresh), strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert here == pytest.approx(number(fresh, name) / factor, rel=1e-15)
    again = with_number(plain, name, here)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(leaves(again), leaves(plain), strict=True))


def test_a_temperature_is_that_of_drawn_velocities_and_of_a_thermostat():
    drawn = build("argon/crystal-108", {"structure.velocities": "drawn"})
    hot, fresh = (
        with_number(drawn, "dynamics.temperature", 0.03),
        build("argon/crystal-108", {"dynamics.temperature": 0.03}),
    )
    assert hot.velocities.tobytes() == fresh.velocities.tobytes() and hot.draw == fresh.draw
    # of a start that is no longer the draw's, as of a replica, the velocities are scaled
    other = with_values(drawn, {"initial.velocities": drawn.velocities[::-1]})
    scaled = with_number(other, "dynamics.temperature", 0.08).velocities
    assert np.allclose(scaled, 2 * other.velocities, rtol=1e-15, atol=0)
    # given velocities stay where a thermostat has a temperature, and there is none without one
    bath = build("argon/langevin-500")
    warm = changed(bath, {"dynamics.temperature": 100.0})
    assert np.array_equal(warm.velocities, bath.velocities)
    assert warm.integrator.number("temperature", bath.units) == pytest.approx(100.0, rel=1e-15)
    assert "dynamics.temperature" not in names(build("argon/crystal-108"))
    # a thermostat of one's own over atoms at rest is no draw's
    atoms, own = bath.structure.copy(), bath.integrator
    atoms.set_array("momenta", None)
    still = mdnum.simulation(atoms, mdnum.LennardJones(3.4, 0.01), mdnum.Cut("hard", 8.5), integrator=own)
    assert number(still, "dynamics.temperature") == pytest.approx(94.4, rel=1e-12)
    warm = with_number(still, "dynamics.temperature", 100.0)
    assert not warm.velocities.any() and number(warm, "dynamics.temperature") == pytest.approx(100, rel=1e-12)


def test_velocities_and_coordinates_are_in_the_units_of_the_file():
    plain = build("argon/liquid-864")
    factor = plain.units.time_factor
    assert number(plain, "velocity.5.z") == pytest.approx(plain.velocities[5, 2] * factor)
    assert with_number(plain, "velocity.5.z", 2.0).velocities[5, 2] == pytest.approx(2.0 / factor)
    assert np.array_equal(with_number(plain, "velocity.scale", 2.0).velocities, 2 * plain.velocities)
    moved = with_number(plain, "position.3.y", 1.5)
    assert moved.positions[3, 1] == 1.5 and np.sum(moved.positions != plain.positions) == 1


def test_no_number_costs_a_compilation():
    plain = build("argon/crystal-108")

    def run(simulation):
        list(Engine(simulation, 120).segments())

    run(plain)
    before = run_epoch._cache_size()
    for key, value in (("sigma", 1.01), ("epsilon", 1.01), ("timestep", 0.0041), ("r_cut", 1.51)):
        run(with_number(plain, named(plain, key), value))
    run(with_number(plain, "velocity.scale", 1.01))
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
        assert named(argon, word) == key and unit(argon, key) == what
    name = named(mixture, "Ni-P.epsilon")
    assert name == "potential.pairs.Ni-P.epsilon" and name in numbers(mixture)
    turned = with_number(mixture, name, 3.0)
    # of its pair of species alone
    changed = np.asarray(turned.potential.epsilon) != np.asarray(mixture.potential.epsilon)
    assert changed.sum() == 1


SWITCHED = {"cutoff.kind": "switched", "cutoff.onset": 7.5}


@pytest.mark.parametrize(
    ("system", "overrides", "word", "value", "message"),
    [
        ("argon/crystal-108", {}, "r_cut", 3.0, "exceeds half"),
        ("argon/crystal-108", {}, "skin", 5.0, "half the smallest"),
        ("argon/liquid-864", {}, "dynamics.temperature", 1.0, "parameter 'dynamics.temperature'"),
        ("argon/liquid-864", SWITCHED, "onset", 9.0, r"9\.0 is not below .*8\.5"),
        ("argon/liquid-864", SWITCHED, "radius", 7.0, r"7\.5 is not below .*7\.0"),
        ("argon/liquid-864", {}, "timestpe", 1.0, r"Did you mean timestep\?"),
        ("binary/kob-andersen-1000", {}, "epsilon", 1.0, r"any of potential\.pairs\.\S+epsilon, "),
    ],
)
def test_what_cannot_be_turned_is_refused(system, overrides, word, value, message):
    simulation = build(system, overrides)
    with pytest.raises(InputError, match=message):
        with_number(simulation, named(simulation, word), value)


# --- files and objects alike ---------------------------------------------------------------------------

NETWORK = """
import jax.numpy as jnp

def network(r, layers, depth):
    h = r[..., None] / 3
    for layer in layers:
        h = jnp.tanh(h @ layer["weight"] + layer["bias"])
    return depth * jnp.sum(h, -1)
"""
FILE = """
units = "lj"
[structure]
builder = "fcc"
symbol = "Ar"
lattice_constant = 1.6
repeat = [3, 3, 3]
[potential]
kind = "python"
function = "net.py:network"
[potential.parameters]
depth = 0.3
[[potential.parameters.layers]]
weight = [[0.4, -0.7, 1.1]]
bias = [0.1, 0.2, 0.3]
[[potential.parameters.layers]]
weight = [[0.4, 1.0], [0.2, 0.5], [-0.3, 0.7]]
bias = [0.0, 0.6]
[cutoff]
kind = "hard"
radius = 2.0
[dynamics]
kind = "nve"
timestep = 0.004
temperature = 1.0
steps = 20
"""


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    folder = tmp_path_factory.mktemp("network")
    (folder / "net.py").write_text(NETWORK)
    (folder / "net.toml").write_text(FILE)
    with mdnum.allow_code():
        yield build(folder / "net.toml")


def test_weights_in_a_file_are_parameters_by_path(network, tmp_path):
    found = mdnum.parameters(network)["potential.layers.1.weight"]
    assert (found.value.shape, found.by) == ((3, 2), "")
    other = changed(network, {"potential.layers.1.weight": np.ones((3, 2))})
    assert other.file is None and np.all(np.asarray(other.potential.shared["layers"][1]["weight"]) == 1.0)
    # as its folder has it
    network.write(tmp_path)
    again = build(tmp_path / "system.toml")
    assert all(np.array_equal(again.potential.shared["layers"][k][word], layer[word])
               for k, layer in enumerate(network.potential.shared["layers"]) for word in layer)  # fmt: skip
    # one of them, and a key of the file
    single = changed(network, {"potential.layers.0.bias.1": 5.0, "cutoff.radius": 1.9})
    assert np.asarray(single.potential.shared["layers"][0]["bias"]).tolist() == [0.1, 5.0, 0.3]
    assert single.r_cut == 1.9
    assert changed(network, {"structure.repeat": [3, 3, 4]}).atoms == 144
    # a map runs along one of them
    number = MdProgram(network).number("potential.layers.0.weight.0.2")
    assert (number.value, number.positive) == (1.1, False)
    moved = number.at(0.5).simulation.potential.shared["layers"][0]["weight"]
    assert np.asarray(moved).tolist() == [[0.4, -0.7, 0.5]]
    # the folder of a run has them, and a digest of what is large
    described = describe.described(other)["potential"]
    assert described["layers.1.weight"] == [[1.0, 1.0]] * 3 and described["layers.0.bias"] == [0.1, 0.2, 0.3]


def test_a_cutoff_that_is_made_to_switch_does_so_from_the_same_place(network):
    """Of a file the onset is a share of its radius where it gives none, and so it is of objects."""
    objects = replace(network, origin=replace(network.origin, system=None))
    for kinds, onset in ((("switched",), 1.8), (("switched", "hard"), 2.0), (("switched", "quintic"), 1.8)):
        for one in (network, objects):
            for kind in kinds:
                one = changed(one, {"cutoff.kind": kind})
            assert np.asarray(one.model.r_onset).tolist() == [pytest.approx(onset, rel=1e-15)], (
                kinds,
                one.file,
            )


def test_what_has_another_shape_or_no_meaning_is_refused(network):
    for values, message in (
        ({"potential.layers.0.bias": np.ones(2)}, r"layers\.0\.bias .* shape \(2,\).*shape \(3,\)"),
        ({"potential.layers.0.bias.7": 1.0}, r"potential\.layers\.0\.bias\.7"),
        ({"velocity.scale": np.nan}, "expected finite"),
        ({"initial.positions": network.positions[:-1]}, r"shape \(107, 3\)"),
    ):
        with pytest.raises(InputError, match=message):
            changed(network, values)
