"""Each choice of molecular dynamics changes what it names and nothing else, and what must hold holds."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_systems
from forks.harness import CRYSTAL, crystal_system, made
from forks.harness import made as twin_of
from rollout.harness import evaluated, listed, terms_of

from mdnum.errors import InputError
from mdnum.forks import Twin, fork
from mdnum.forks.choices import CHOICES, Choice, parse, shipped, unavailable
from mdnum.forks.choices.arithmetic import FORMATS
from mdnum.forks.choices.start import exact_images
from mdnum.forks.pair import screen
from mdnum.forks.reordered import ReorderedSimulation, ShuffledBuilder
from mdnum.forks.worlds import varied
from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.integrators import Langevin
from mdnum.md.jaxmd import as_neighbor_list, displacement, upstream
from mdnum.md.neighbors import BUILDERS
from mdnum.numerics import reductions
from mdnum.numerics.sums import Halves, Sequential, Twice
from mdnum.rollout.engine import first_state
from mdnum.systems.build import build
from mdnum.systems.load import System, load
from mdnum.systems.simulation import Simulation
from mdnum.systems.toml import flat

BATH, MIXTURE, TILTED = "argon/langevin-500", "binary/kob-andersen-1000", "argon/tilted-500"
SHIPPED = shipped("md")


@pytest.fixture(scope="module")
def crystal() -> System:
    return crystal_system()


# --- names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", ["md", "ball"])
def test_every_shipped_choice_is_parsed_from_its_name(world: str):
    assert len(shipped(world)) > 30
    for name, choice in shipped(world).items():
        assert isinstance(choice, Choice)
        assert choice.name == name and parse(name) == choice
        assert choice.describe(world) and "\n" not in choice.describe(world)
    # arguments are read and written alike
    for word in ("order=3@fixed-point", "rotate=-x-yz@exact", "start=3:height:-1", "iterations=-1:57:2"):
        assert parse(word).name == word


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("skn", "Did you mean skin"),
        ("nonsense", "lists all"),
        ("vmap", "fork processes"),
        ("precision.mass", "'mass'.* state, force, decision, accumulate"),
        ("precision=half", "expected one of float64, float32, float16, bfloat16"),
        ("format=coo", "'coo'.* dense, sparse, ordered-sparse"),
        ("reduction=karatsuba", "reduction 'karatsuba'"),
        ("order@karatsuba", "reduction 'karatsuba'"),
        ("order=", "unknown numerical choice"),
        ("ulps", "ulps=cutoff.radius"),
        ("ulps=cutoff.radius:x", "not a whole number"),
        ("ulps=cutoff.radius:0", "0 change nothing"),
        ("start=3:5:1", "coordinate 5"),
        ("start=0:mass", "not a whole number"),
        ("start=1:2:3:4", "which:what:ulps"),
        ("skin=-1", "skin = -1.*0 or more"),
        ("skin=wide", "not a number"),
        ("rebuild=never", "rule 'never'"),
        ("rebuild=every:0", "every 0 steps"),
        ("rotate=xyz", "another order of xyz"),
        ("rotate=xxy", "with or without signs"),
        ("rotate=-xy", "with or without signs"),
        ("builder=cuda", "no list builder"),
        ("translate=0", "other than 0"),
        ("noise=-1", "negative"),
        ("relabel=-1", "negative"),
        ("noise@exact", "unknown numerical choice"),
        ("stop=never", "no rule"),
        ("max_iter=0", "0 change nothing"),
        ("iterations=1:2:3:4", "not a whole number"),
        ("contact=x", "whole"),
        ("contact=earlier:0", "count from 1"),
    ],
)
def test_what_is_no_choice_is_refused_with_those_there_are(word: str, message: str):
    with pytest.raises(InputError, match=message):
        parse(word)


@pytest.mark.parametrize(
    ("name", "word", "reason"),
    [
        (CRYSTAL, "noise", "no noise"),
        (CRYSTAL, "contact=earlier", "a choice of a ball"),
        (CRYSTAL, "precision.arithmetic", "no role arithmetic"),
        (CRYSTAL, "precision.state=bfloat16", "a step moves"),
        (CRYSTAL, "precision.decision=float16", "their grid would decide"),
        (CRYSTAL, "precision.accumulate=bfloat16", "small ones are lost"),
        ("silicon/tersoff-512", "reduction=exact", "one order"),
        ("silicon/tersoff-512", "order@exact", "one order"),
        (CRYSTAL, "precision=float64", "float64 already"),
        (CRYSTAL, "reduction=sequential", "already"),
        ("silicon/tersoff-512", "format", "a format of its own"),
        (CRYSTAL, "rebuild=half-skin", "already"),
        (CRYSTAL, "skin=0.3", "already"),
        (CRYSTAL, "skin=9", "half the smallest perpendicular"),
        (CRYSTAL, "builder=host", "already"),
        (CRYSTAL, "start=108:0:1", "no atom 108 among 108"),
        (CRYSTAL, "start=1:height:1", "no coordinate height"),
        (CRYSTAL, "order@alone", "for balls"),
        (CRYSTAL, "ulps=cutoff.in_sigma:+1", "it has no number cutoff.in_sigma"),
        (CRYSTAL, "ulps=cutoff.raduis:+1", "there are potential.sigma, potential.epsilon, cutoff.radius"),
        ("silicon/tersoff-512", "energy-shift", "own cutoff"),
        (BATH, "relabel", "belongs to labels"),
        (BATH, "rotate", "belongs to axes"),
        (TILTED, "rotate=yzx", "axes yzx"),
    ],
)
def test_a_choice_that_does_not_apply_has_a_reason(name: str, word: str, reason: str):
    system, choice = load(name, world="md"), parse(word)
    assert reason in (unavailable(choice, system) or "")
    with pytest.raises(InputError, match="does not apply to"):
        made(word, system)


# --- a choice of another package ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Promised(Choice):
    """An ulp that claims to change nothing."""

    must_hold = True

    @property
    def name(self) -> str:
        return "promised"

    def make(self, system: Any) -> Twin:
        return parse("start").make(system)


def test_a_package_outside_adds_a_choice_and_its_broken_promise_is_a_finding(crystal: System, monkeypatch):
    point = metadata.EntryPoint("promised", f"{__name__}:Promised", CHOICES.group)
    monkeypatch.setattr(type(CHOICES), "_added", lambda self: {"promised": point})
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda self: Promised)
    assert parse("promised") == Promised() == shipped("ball")["promised"]
    (row,) = screen(crystal, 20, [parse("promised")])
    assert row.must_hold and row.held is False and row.first_bit == 0


# --- what a choice changes, before any step -----------------------------------------------------------------

#: What differs, by the name of the choice. Keys of the system file are in it as they are.
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
    "format=ordered-sparse@exact": {"lists"},
    "ulps=cutoff.radius:+1": {"cutoff.radius", "radius", "decider"},
    "ulps=cutoff.in_sigma:+1": {"cutoff.in_sigma", "radius", "decider"},
    "ulps=dynamics.timestep:+1": {"dynamics.timestep", "timestep"},
    "ulps=dynamics.temperature:+1": {"dynamics.temperature", "velocities"},
    "ulps=potential.sigma:+1": {"potential.sigma", "potential"},
    "ulps=potential.epsilon:+1": {"potential.epsilon", "potential"},
    "start": {"positions"},
    "noise": {"key"},
}
MUST_HOLD = {
    "energy-shift", "translate=lattice", "unwrapped", "order@exact", "order@fixed-point",
    "format=ordered-sparse@exact", "builder@exact", "skin@exact", "rebuild=every:1@exact", "relabel@exact",
}  # fmt: skip
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
    names = (
        "positions", "velocities", "masses", "species", "cell", "decider", "lists", "policy", "reduction",
    )  # fmt: skip
    return {
        **{name: getattr(simulation, name) for name in names},
        "potential": model.potential,
        "cutoff": model.cutoff,
        "radius": (model.r_cut, model.r_onset),
        "timestep": integrator.timestep,
        "bath": (integrator.friction, integrator.kT) if bath else None,
        "key": jax.random.key_data(integrator.key) if bath else None,
    }


def changes(twin: Twin) -> set[str]:
    """What differs between the programs of a twin."""
    a, b = twin.a.simulation, twin.b.simulation
    tables = [flat(one.origin.system.spec.model_dump()) for one in (a, b)]
    found = {key for key in {*tables[0], *tables[1]} if tables[0].get(key) != tables[1].get(key)}
    second = aspects(b)
    for name, value in aspects(a).items():
        plain = eqx.is_array_like(value) or isinstance(value, tuple | eqx.Module)
        if not (same(value, second[name]) if plain else value == second[name]):
            found.add(name)
    if twin.b.frame is not None and not twin.b.frame.is_same:
        found.add("frame")
    assert twin.a.begin is None and twin.b.begin is None
    return found


@pytest.mark.parametrize(
    ("word", "file", "given", "expected"),
    [
        *(
            pytest.param(
                word,
                *ON.get(word, (CRYSTAL, {})),
                CHANGES.get(word) or CHANGES.get(word.partition("@")[0]),
                id=word,
            )
            for word in SHIPPED
        ),
        *(pytest.param(*row, id=f"{row[0]}, {row[1]}") for row in MORE),
    ],
)
def test_a_choice_changes_what_it_names_and_nothing_else(word, file, given, expected):
    system = load(file, world="md")
    twin = made(word, varied(system, given) if given else system)
    assert twin.difference and changes(twin) == expected and parse(word).name == word
    assert parse(word).must_hold == (word in MUST_HOLD or word in {"skin=0.5@fixed-point", "unwrapped=3"})


def test_a_temperature_draws_the_velocities_of_both_runs(crystal: System):
    twin = made(f"ulps=dynamics.temperature:{1 << 20}", crystal)
    a, b = twin.a.simulation, twin.b.simulation
    factor = b.velocities / a.velocities
    assert np.allclose(factor, 1 + 2.0**-32 * 0.02 / 0.02, rtol=1e-9) and (factor != 1).all()
    assert not np.array_equal(a.velocities, crystal.atoms.get_velocities())


@pytest.mark.parametrize("state", ["float64", "float32"])
def test_one_coordinate_of_the_start_moves_by_an_ulp_of_the_state(crystal: System, state: str):
    system = varied(crystal, {"precision.state": state})
    for word, ulps in (("start", 1), ("start=5:2:-4", -4)):
        twin = made(word, system)
        a, b = (np.asarray(first_state(one.simulation).state.x) for one in (twin.a, twin.b))
        assert a.dtype == np.dtype(state)
        ((axis, atom),) = np.argwhere(a != b)
        assert b[axis, atom] - a[axis, atom] == ulps * np.spacing(a[axis, atom])
        if word == "start":
            assert a[axis, atom] > 0.9 * a.max()


def test_a_shuffled_list_holds_the_same_pairs_in_another_order(crystal: System):
    simulation = build(crystal)
    x, _ = wrap_positions(simulation.cell, simulation.positions)
    plain = BUILDERS["host"].build(x, simulation.cell, 1.9, 64)
    mixed = ShuffledBuilder(BUILDERS["host"], 5).build(x, simulation.cell, 1.9, 64)
    assert np.array_equal(np.sort(plain[0], axis=0), np.sort(mixed[0], axis=0))
    assert not np.array_equal(plain[0], mixed[0])
    assert np.array_equal(plain[1], mixed[1]) and plain[2] == mixed[2]
    # each atom in its own way, and padding stays at the end
    assert ((mixed[0][:-1] == 108) <= (mixed[0][1:] == 108)).all()


@pytest.mark.parametrize("word", ["relabel", "rotate", "rotate=yxz", "rotate=z-yx", "translate=0.25"])
def test_a_frame_takes_the_second_start_back_to_the_first(crystal: System, word: str):
    twin = made(word, crystal)
    a, b, frame = twin.a.simulation, twin.b.simulation, twin.b.frame
    assert frame is not None and not frame.is_same
    assert np.allclose(frame.positions(b.positions.T[None])[0].T, a.positions, rtol=0, atol=1e-14)
    assert np.array_equal(frame.vectors(b.velocities.T[None])[0].T, a.velocities)
    assert b.evaluate().energy == pytest.approx(a.evaluate().energy, rel=1e-13)


def test_a_box_is_turned_only_into_itself(crystal: System):
    atoms = crystal.atoms.copy()
    atoms.set_cell([5.0, 5.0, 7.0], scale_atoms=True)
    tall = replace(crystal, atoms=atoms)
    assert unavailable(parse("rotate=yzx"), tall) and unavailable(parse("rotate=yxz"), tall) is None
    assert "yxz" in made("rotate", tall).difference
    # half turns where no two edges are the same, and every lattice is its own mirror image in a point
    atoms.set_cell([5.0, 6.0, 7.0], scale_atoms=True)
    assert "-x-yz" in made("rotate", replace(crystal, atoms=atoms)).difference
    tilted = load(TILTED, world="md")
    assert unavailable(parse("rotate=-x-yz"), tilted) and "-x-y-z" in made("rotate", tilted).difference


@pytest.mark.parametrize("word", ["translate=lattice", "unwrapped"])
def test_images_are_exact_near_the_start(crystal: System, word: str):
    twin = made(word, crystal)
    a, b = (first_state(one.simulation) for one in (twin.a, twin.b))
    assert np.array_equal(np.asarray(a.state.x), np.asarray(b.state.x))
    assert not np.array_equal(np.asarray(a.state.images), np.asarray(b.state.images))
    own, _ = wrap_positions(twin.a.simulation.cell, crystal.atoms.positions)
    assert np.abs(np.asarray(a.state.x).T - own).max() < 1e-14
    # a cluster has none
    atoms = crystal.atoms.copy()
    atoms.pbc = False
    for other in (word, "translate=0.25"):
        assert unavailable(parse(other), replace(crystal, atoms=atoms)) is not None


def test_what_has_no_exact_image_is_counted():
    cell = Cell.create(np.array([3.0, 0.0, 0.0, 1e-3 / 3, 3.1, 0, 0.7 / 3, 0.1 / 7, 2.9]).reshape(3, 3))
    x = np.random.default_rng(0).random((500, 3)) @ np.asarray(cell.matrix)
    _, elsewhere, lost = exact_images(cell, x, np.ones((500, 3), np.int64))
    wrapped, _, _ = exact_images(cell, x, np.ones((500, 3), np.int64))
    again, _ = wrap_positions(cell, elsewhere)
    assert lost == (again != wrapped).any(axis=1).sum()
    assert exact_images(Cell.create([3.0, 3.1, 2.9]), x, np.ones((500, 3), np.int64))[2] == 0


# --- what it does to a run ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "word",
    [
        "translate=lattice",
        *(
            # of each kind one: a sum, lists, labels; others of the same kinds at night
            pytest.param(word, marks=mark)
            for mark, words in (
                (pytest.mark.slow, ("order@exact", "energy-shift", "order@fixed-point", "relabel@exact")),
                (
                    pytest.mark.nightly,
                    (
                        "skin@exact", "unwrapped", "format=ordered-sparse@exact", "rebuild=every:1@exact",
                        "builder@exact",
                    ),
                ),
            )
            for word in words
        ),
    ],
)  # fmt: skip
def test_what_must_hold_holds_to_the_last_bit(crystal: System, word: str):
    (row,) = screen(crystal, 200, [parse(word)])
    assert row.must_hold and row.held and (row.first_bit, row.fork, row.steps) == (None, None, 200)


@pytest.mark.slow
def test_the_same_choices_without_such_sums_do_not_hold(crystal: System):
    words = ("order", "relabel", "skin", "rotate", "format", "format=dense")
    rows = screen(crystal, 200, [parse(word) for word in words])
    assert {row.first_bit for row in rows} == {1}
    assert not any(row.must_hold or row.held for row in rows)


def test_a_screen_ranks_by_fork_and_then_by_seed_with_what_does_not_apply_last(crystal: System):
    calls: list[tuple[int, int, str]] = []
    words = ["noise", "translate=lattice", "start", "ulps=potential.sigma:1099511627776"]
    choices = [parse(word) for word in words]
    rows = screen(crystal, 100, choices, progress=lambda done, total, name: calls.append((done, total, name)))
    assert calls == [(k, 4, choice.name) for k, choice in enumerate(choices)]
    assert [row.choice for row in rows] == [choices[k].name for k in (3, 2, 1, 0)]
    first, start, lattice, noise = rows
    # sigma by 2e-4 moves every force: a pair crosses the cutoff another time soon
    assert first.fork is not None and 1 <= first.fork < 100
    assert (start.first_bit, lattice.first_bit) == (0, None)
    assert noise.reason_unavailable is not None and noise.held is None and noise.steps == 0
    with pytest.raises(InputError, match="no numerical choice"):
        screen(crystal, 10, [])


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_screen_by_workers_is_the_same(workers: int):
    """In the gate threads, which unpack the system as processes do."""
    ball, choices = load("ball/drop"), [parse(word, "ball") for word in ("noise", "contact=later", "start")]
    with ThreadPoolExecutor(1) as pool:
        rows = screen(ball, 40, choices, on=pool if workers == 1 else None, workers=workers)
    assert rows == screen(ball, 40, choices) and len(rows) == 3 and rows[0].first_bit is not None


@pytest.mark.parametrize(
    ("word", "first_bit"), [("order", 1), pytest.param("order@exact", None, marks=pytest.mark.nightly)]
)
def test_lists_of_another_order_are_not_those_of_the_leader(crystal: System, word: str, first_bit):
    """B under A's decisions has B's order of pairs: with A's lists it would be A."""
    found = fork(made(word, crystal), 30, repeats=0)
    assert found.dates.first_bit == first_bit and (np.nanmax(found.series["B|A"]) > 0) == (word == "order")


# --- jax-md's neighbor formats are orders of each atom's terms ------------------------------------------


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """A liquid's worth of disorder, 108 atoms."""
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 1.0, "seed": 3}
    cutoff = {"kind": "hard", "radius": 2.0}
    system = small_systems.make(
        small_systems.crystal(3, 0.1), small_systems.LENNARD_JONES, cutoff, dynamics=dynamics
    )
    return build(system)


@pytest.fixture(scope="module")
def rows(simulation: Simulation) -> np.ndarray:
    """Neighbors within the list radius, one row per atom, sorted, padded at the end."""
    return np.sort(listed(simulation)[1].unsorted(), axis=1)


def forces_of_jax_md(simulation: Simulation, rows: np.ndarray, format: Any):
    """A function from a list's indices to jax-md's forces, minus the gradient of its energy; and the list."""
    jax_md = upstream()
    metric = jax_md.space.canonicalize_displacement_or_metric(
        displacement(np.asarray(simulation.cell.matrix))
    )
    energy = jax_md.smap.pair_neighbor_list(lennard_jones, metric)
    x = jnp.asarray(wrap_positions(simulation.cell, simulation.positions)[0])
    held: Any = as_neighbor_list(rows, np.asarray(x), format)

    @jax.jit
    def forces(idx):
        return -jax.grad(lambda at: energy(at, replace(held, idx=idx)))(x)

    return forces, np.asarray(held.idx)


def lennard_jones(dr, **_):
    """With a hard cutoff; distance 0 is padding."""
    inside = (dr > 0) & (dr < 2.0)
    s6 = (1 / jnp.where(inside, dr, 1.0)) ** 6
    return jnp.where(inside, 4 * (s6 * s6 - s6), 0.0)


def in_order(terms, start=None) -> np.ndarray:
    total = np.zeros(3) if start is None else start
    for term in terms:
        total = total + term
    return total


def in_windows(terms: list[np.ndarray], slots: int, width: int = 32) -> np.ndarray:
    """How XLA on a CPU adds along an axis: whole windows, the axis in the middle of them."""
    windows = -(-slots // width)
    before = (windows * width - slots) // 2
    padded = [np.zeros(3)] * before + terms
    return in_order([in_order(padded[width * w : width * (w + 1)]) for w in range(windows)])


def modeled(rows: np.ndarray, terms: dict[tuple[int, int], np.ndarray], format: str) -> np.ndarray:
    """The forces if a format were nothing but an order of the terms."""
    atoms = len(rows)
    force = np.empty((atoms, 3))
    named_by = [np.flatnonzero((rows == i).any(axis=1)).tolist() for i in range(atoms)]
    zero = np.zeros(3)
    for i, naming in enumerate(named_by):
        own = [j for j in rows[i].tolist() if j < atoms]
        if format == "ordered-sparse":
            later, earlier = [j for j in naming if j > i], [j for j in own if j < i]
            force[i] = in_order(terms[i, j] for j in later) + in_order(terms[i, j] for j in earlier)
        elif format == "sparse":
            force[i] = in_order(0.5 * terms[i, j] for j in own) + in_order(0.5 * terms[i, j] for j in naming)
        else:
            # padding may stand between the neighbors of a row, and windows count it
            row = [0.5 * terms[i, j] if j < atoms else zero for j in rows[i].tolist()]
            force[i] = in_order((0.5 * terms[i, j] for j in naming), in_windows(row, rows.shape[1]))
    return force


@pytest.mark.slow
@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
def test_the_forces_of_each_format_of_jax_md_are_sums_in_one_order(simulation, rows):
    once, pairs = forces_of_jax_md(simulation, rows, "ordered-sparse")
    # the terms, by the program's own arithmetic: each pair alone in the list
    atoms, terms = len(rows), {}
    for k in np.flatnonzero(pairs[0] < atoms).tolist():
        alone = np.full_like(pairs, atoms)
        alone[:, k] = pairs[:, k]
        force = np.asarray(once(jnp.asarray(alone)))
        i, j = pairs[:, k].tolist()
        assert np.array_equal(force[i], -force[j])
        terms[i, j], terms[j, i] = force[i], force[j]
    assert rows.shape[1] > 32
    mixed = np.stack([np.random.default_rng(i).permutation(row) for i, row in enumerate(rows)])
    seen = {}
    for kind, order in (("sorted", rows), ("mixed", mixed)):
        for format in FORMATS:
            forces, idx = forces_of_jax_md(simulation, order, format)
            seen[kind, format] = np.asarray(forces(jnp.asarray(idx)))
            # a list on the host is packed to the front; a dense one stays as it is
            assert np.array_equal(seen[kind, format], modeled(order, terms, format)), (kind, format)
    different = {force.tobytes() for force in seen.values()}
    assert len(different) == 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "format", [pytest.param(one, marks=[pytest.mark.nightly] * (one == "dense")) for one in FORMATS]
)
def test_the_choice_adds_in_the_order_of_the_format(simulation, rows, format):
    made = ReorderedSimulation.of(simulation, format)
    assert made.reduction == {"dense": Twice(), "sparse": Sequential(), "ordered-sparse": Halves()}[format]
    x, table, tables = listed(made)
    seen, atoms = terms_of(made, x, tables), len(table.order)
    terms = {}
    for slot, column in zip(*np.nonzero(table.index < atoms), strict=True):
        pair = int(table.order[column]), int(table.order[table.index[slot, column]])
        terms[pair] = np.array([seen[axis][slot, column] for axis in range(3)])
    assert all(np.array_equal(term, -terms[j, i]) for (i, j), term in terms.items())
    real = [[j for j in row if j < atoms] for row in rows.tolist()]
    if format == "ordered-sparse":
        expected = modeled(rows, terms, format)
    elif format == "sparse":
        # in sorted rows both halves of the sum are one order
        plain = np.array([in_order(terms[i, j] for j in row) for i, row in enumerate(real)])
        assert np.array_equal(modeled(rows, terms, "sparse"), plain)
        # backwards, because forwards the loop streams, and XLA then contracts a product and a sum into one
        made = replace(made, reduction=Sequential("reversed"))
        expected = np.array([in_order(terms[i, j] for j in row[::-1]) for i, row in enumerate(real)])
    else:
        halves = [[0.5 * terms[i, j] for j in row] for i, row in enumerate(real)]
        expected = np.array([in_order(row, in_order(row)) for row in halves])
    force = np.empty((atoms, 3))
    force[table.order] = np.asarray(evaluated(made.force, x, tables).force).T
    assert np.array_equal(force, expected)


def test_a_list_in_another_format_holds_the_same_pairs(simulation):
    plain = listed(simulation)[1]
    for word in FORMATS:
        twin = twin_of(f"format={word}", simulation)
        table = listed(twin.b.simulation)[1]
        held, before = (np.sort(one.unsorted(), axis=1)[:, : plain.occupancy] for one in (table, plain))
        assert np.array_equal(held, before)
        assert table.pairs == plain.pairs and table.slots % 8 == 0
        assert twin.a.simulation.lists != twin.b.simulation.lists
        # by label, padding last in each half
        labels = np.append(table.order, len(table.order))[table.index]
        for half in np.split(labels, 2 if word == "ordered-sparse" else 1):
            assert (np.diff(half, axis=0) >= 0).all()
    pairwise = varied(simulation, {"precision.reduction": "pairwise"})
    assert unavailable(parse("format=sparse"), pairwise)
