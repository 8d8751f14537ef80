"""What each shipped choice changes between its two programs; all else is the same, bit for bit.

Nothing is run here: what the programs do with the difference is in test_choices.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from mdnum.forks.twin import Twin

from mdnum.forks.choices import BY_NAME, names, parse
from mdnum.forks.choices.base import varied
from mdnum.md.integrators import Langevin
from mdnum.precision import reductions
from mdnum.systems.build import Simulation
from mdnum.systems.load import System, load

CRYSTAL, BATH, MIXTURE = "argon/crystal-108", "argon/langevin-500", "binary/kob-andersen-1000"
TILTED = "argon/tilted-500"

#: Words for what differs, by name. Keys of the system file stand as they are.
CHANGES: Mapping[str, set[str]] = {
    "precision": {"precision.force", "precision.decision", "precision.accumulate", "policy", "decider"},
    "precision.state": {"precision.state", "policy", "decider"},
    "precision.force": {"precision.force", "policy"},
    "precision.decision": {"precision.decision", "policy", "decider"},
    "precision.accumulate": {"precision.accumulate", "policy"},
    "precision.force=bfloat16": {"precision.force", "policy"},
    **{f"reduction={word}": {"precision.reduction", "reduction"} for word in reductions.BY_NAME},
    "order": {"lists"},
    "format=dense": {"lists", "reduction"},
    "format=sparse": {"lists"},
    "format=ordered-sparse": {"lists", "reduction"},
    "builder": {"neighbors.builder", "lists"},
    "skin": {"neighbors.skin", "lists"},
    "rebuild=every:1": {"neighbors.rebuild.check", "lists"},
    "rebuild=every:10": {"neighbors.rebuild.check", "neighbors.rebuild.every", "lists"},
    "rebuild=half-skin": {"neighbors.rebuild.check", "neighbors.rebuild.every", "lists"},
    "relabel": {"positions", "velocities", "frame"},
    "rotate": {"positions", "velocities", "frame"},
    "translate=0.25": {"positions", "frame"},
    "translate=lattice": {"positions"},
    "unwrapped": {"positions"},
    "energy-shift": {"cutoff.kind", "cutoff"},
    "order@exact": {"lists"},
    "order@fixed-point": {"lists"},
    "format=ordered-sparse@exact": {"lists"},
    "builder@exact": {"neighbors.builder", "lists"},
    "skin@exact": {"neighbors.skin", "lists"},
    "rebuild=every:1@exact": {"neighbors.rebuild.check", "lists"},
    "relabel@exact": {"positions", "velocities", "frame"},
    "rotate@exact": {"positions", "velocities", "frame"},
    "ulps=cutoff.radius:+1": {"cutoff.radius", "radius", "decider"},
    "ulps=cutoff.in_sigma:+1": {"cutoff.in_sigma", "radius", "decider"},
    "ulps=dynamics.timestep:+1": {"dynamics.timestep", "timestep"},
    "ulps=dynamics.temperature:+1": {"dynamics.temperature", "velocities"},
    "ulps=potential.sigma:+1": {"potential.sigma", "potential"},
    "ulps=potential.epsilon:+1": {"potential.epsilon", "potential"},
    "start": {"positions"},
    "noise": {"key"},
}

SWITCHED = {"cutoff.kind": "switched", "cutoff.onset": 1.4}

#: Choices with arguments, on the systems that they are for.
MORE: tuple[tuple[str, str, dict[str, Any], set[str]], ...] = (
    ("precision=float64", CRYSTAL, {"precision.force": "float32"}, {"precision.force", "policy"}),
    ("precision=bfloat16", CRYSTAL, {}, {"precision.force", "policy"}),
    ("precision.force=float16", CRYSTAL, {}, {"precision.force", "policy"}),
    # a system file has no words for the number of a reduction
    ("reduction=permuted:3", CRYSTAL, {}, {"reduction"}),
    ("ulps=potential.pairs.Ni-P.epsilon:-3", MIXTURE, {}, {"potential.pairs.Ni-P.epsilon", "potential"}),
    ("ulps=cutoff.onset:+2", CRYSTAL, SWITCHED, {"cutoff.onset", "radius"}),
    ("ulps=dynamics.friction:+1", BATH, {}, {"dynamics.friction", "bath"}),
    ("ulps=neighbors.skin:+1", CRYSTAL, {}, {"neighbors.skin", "lists"}),
    ("noise=7", BATH, {}, {"key"}),
    ("builder=jax-md", CRYSTAL, {}, {"neighbors.builder", "lists"}),
    ("rebuild=every:25", CRYSTAL, {}, {"neighbors.rebuild.check", "neighbors.rebuild.every", "lists"}),
    ("skin=0.5@fixed-point", CRYSTAL, {}, {"neighbors.skin", "lists"}),
    ("relabel=4", CRYSTAL, {}, {"positions", "velocities", "frame"}),
    ("rotate=zyx", CRYSTAL, {}, {"positions", "velocities", "frame"}),
    ("rotate", TILTED, {}, {"positions", "velocities", "frame"}),
    ("translate=0.5@exact", CRYSTAL, {}, {"positions", "frame"}),
    ("unwrapped=3", CRYSTAL, {}, {"positions"}),
    ("start=17:0:-2", CRYSTAL, {}, {"positions"}),
)

#: A system that each applies to, where the crystal will not do, and what is set in it first.
ON: Mapping[str, tuple[str, dict[str, Any]]] = {
    "noise": (BATH, {}),
    "reduction=sequential": (CRYSTAL, {"precision.reduction": "pairwise"}),
    "rebuild=half-skin": (CRYSTAL, {"neighbors.rebuild.check": False, "neighbors.rebuild.every": 7}),
    "ulps=cutoff.in_sigma:+1": (CRYSTAL, {"cutoff.in_sigma": 1.6}),
}


@pytest.fixture(scope="module")
def crystal() -> System:
    return load(CRYSTAL, world="md")


def numbers(spec: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for key, value in spec.items():
        if isinstance(value, Mapping):
            yield from numbers(value, (*path, key))
        else:
            yield ".".join((*path, key)), value


def same(a: Any, b: Any) -> bool:
    """Whether two trees hold the same arrays, bit for bit."""
    one, other = (jax.tree.leaves(tree) for tree in (a, b))
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(one, other, strict=True)
    )


def aspects(simulation: Simulation) -> dict[str, Any]:
    """Everything that a run is made of."""
    model, integrator = simulation.model, simulation.integrator
    bath = isinstance(integrator, Langevin)
    key = jax.random.key_data(integrator.key) if bath else None
    return {
        "positions": simulation.positions,
        "velocities": simulation.velocities,
        "masses": simulation.masses,
        "species": simulation.species,
        "cell": simulation.cell,
        "potential": model.potential,
        "cutoff": model.cutoff,
        "radius": (model.r_cut, model.r_onset),
        "decider": simulation.decider,
        "lists": simulation.lists,
        "policy": simulation.policy,
        "reduction": simulation.reduction,
        "timestep": integrator.timestep,
        "bath": (integrator.friction, integrator.kT) if bath else None,
        "key": key,
    }


def changes(twin: Twin) -> set[str]:
    """What differs between the programs of a twin."""
    a, b = (dict(numbers(one.system.spec.model_dump())) for one in (twin.a, twin.b))
    found = {key for key in {*a, *b} if a.get(key) != b.get(key)}
    first, second = aspects(twin.a), aspects(twin.b)
    for name, value in first.items():
        other = second[name]
        plain = eqx.is_array_like(value) or isinstance(value, tuple | eqx.Module)
        if not (same(value, other) if plain else value == other):
            found.add(name)
    if twin.frame is not None and not twin.frame.is_same:
        found.add("frame")
    if twin.start_a is not None or twin.start_b is not None:
        found.add("start")
    return found


def test_no_choice_is_shipped_without_a_row():
    assert set(CHANGES) == set(names())


@pytest.mark.parametrize("name", names())
def test_a_choice_changes_what_it_names_and_nothing_else(crystal: System, name: str):
    file, given = ON.get(name, (CRYSTAL, {}))
    assert changes(made(name, crystal, file, given)) == CHANGES[name]


@pytest.mark.parametrize(("word", "file", "given", "expected"), MORE)
def test_an_argument_changes_what_it_names(crystal, word: str, file: str, given: dict, expected: set[str]):
    assert changes(made(word, crystal, file, given)) == expected


def made(word: str, crystal: System, file: str, given: dict[str, Any]) -> Twin:
    """The twin of a choice on a system with some keys set first."""
    system = crystal if file == CRYSTAL else load(file, world="md")
    system = varied(system, given) if given else system
    choice = parse(word)
    assert choice.why_not(system) is None
    twin = choice.make(system)
    assert twin.difference and twin.a.system.species == twin.b.system.species
    return twin


def test_what_must_hold_is_what_is_said_to():
    promised = {name for name, choice in BY_NAME.items() if choice.must_hold}
    assert promised == {
        "energy-shift",
        "translate=lattice",
        "unwrapped",
        "order@exact",
        "order@fixed-point",
        "format=ordered-sparse@exact",
        "builder@exact",
        "skin@exact",
        "rebuild=every:1@exact",
        "relabel@exact",
    }
