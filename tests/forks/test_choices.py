"""Each choice changes what it names and nothing else, and what must hold holds bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.forks import fork
from mdnum.forks.choices import (
    BY_NAME,
    Choice,
    Images,
    Precision,
    Rotate,
    Screened,
    Ulps,
    names,
    parse,
    screen,
)
from mdnum.forks.choices.base import varied
from mdnum.forks.choices.frames import exact_images
from mdnum.forks.choices.lists import ShuffledBuilder
from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.verlet import BUILDERS
from mdnum.rollout.engine import first_state
from mdnum.systems.build import build
from mdnum.systems.load import System, load

# a program is compiled for almost every choice
pytestmark = pytest.mark.slow

CRYSTAL = "argon/crystal-108"


@pytest.fixture(scope="module")
def crystal() -> System:
    return load(CRYSTAL, world="md")


def screened(word: str, system: System, steps: int) -> Screened:
    (row,) = screen(system, steps, [parse(word)])
    return row


# --- names ------------------------------------------------------------------------------------------------


def test_every_shipped_choice_is_parsed_from_its_name():
    assert len(names()) == len(set(names())) > 30
    for name, choice in BY_NAME.items():
        assert isinstance(choice, Choice)
        assert choice.name == name and parse(name) == choice
        assert choice.about and "\n" not in choice.about


@pytest.mark.parametrize(
    "word",
    [
        "precision.force=float64",
        "precision.force=bfloat16",
        "format=sparse@fixed-point",
        "reduction=permuted:3",
        "skin=0.5",
        "skin=0.5@exact",
        "rebuild=every:25",
        "order=3@fixed-point",
        "builder=jax-md",
        "relabel=4",
        "rotate=zyx",
        "rotate=-x-yz@exact",
        "translate=0.5",
        "unwrapped=3",
        "noise=7",
        "start=17:0:-2",
        "ulps=potential.pairs.Ar-Ar.sigma:-3",
    ],
)
def test_arguments_are_read_and_written_alike(word: str):
    assert parse(word).name == word


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("reductoin", "Did you mean"),
        ("nonsense", "lists all"),
        ("precision.mass", "no role 'mass'; there are state, force, decision, accumulate"),
        ("precision=half", "known are float64, float32, float16, bfloat16"),
        ("precision.state=bfloat16", "bfloat16 cannot be the state of molecular dynamics: a step moves"),
        ("precision.decision=float16", "their grid would decide"),
        ("precision.accumulate=bfloat16", "small ones are lost"),
        ("format=coo", "no format 'coo'; there are dense, sparse, ordered-sparse"),
        ("reduction=karatsuba", "no reduction called"),
        ("order@karatsuba", "no reduction called"),
        ("ulps", "ulps=cutoff.radius"),
        ("ulps=cutoff.radius:x", "not a whole number"),
        ("ulps=cutoff.radius:0", "0 ulps"),
        ("start=3", "atom:axis:ulps"),
        ("start=3:5:1", "axis 5"),
        ("skin=-1", "expected a length of 0 or more"),
        ("skin=wide", "not a number"),
        ("rebuild=never", "no rule 'never'"),
        ("rebuild=every:0", "every 0 steps"),
        ("rotate=xyz", "another order of xyz"),
        ("rotate=xxy", "with or without signs"),
        ("rotate=-xy", "with or without signs"),
        ("builder=cuda", "no list builder"),
        ("translate=0", "other than 0"),
        ("noise=-1", "negative"),
        ("noise@exact", "no choice"),
    ],
)
def test_what_is_no_choice_is_refused_with_those_there_are(word: str, says: str):
    with pytest.raises(InputError, match=says):
        parse(word)


@pytest.mark.parametrize(
    ("name", "word", "says"),
    [
        (CRYSTAL, "noise", "no noise at constant energy"),
        ("silicon/tersoff-512", "reduction=exact", "one order"),
        ("silicon/tersoff-512", "order@exact", "one order"),
        ("silicon/tersoff-512", "precision", "float64 only"),
        (CRYSTAL, "precision=float64", "float64 already"),
        (CRYSTAL, "reduction=sequential", "already"),
        ("silicon/tersoff-512", "format", "a format of its own"),
        (CRYSTAL, "rebuild=half-skin", "already"),
        (CRYSTAL, "skin=0.3", "already"),
        (CRYSTAL, "builder=host", "already"),
        (CRYSTAL, "start=108:0:1", "no atom 108 among 108"),
        (CRYSTAL, "ulps=cutoff.in_sigma:+1", "there are potential.sigma, potential.epsilon, cutoff.radius"),
        ("silicon/tersoff-512", "energy-shift", "carries its own cutoff"),
        ("argon/langevin-500", "relabel", "belongs to labels"),
        ("argon/langevin-500", "rotate", "belongs to axes"),
        ("argon/tilted-500", "rotate=yzx", "not the same with axes yzx in place of xyz"),
    ],
)
def test_a_choice_that_does_not_apply_says_why(name: str, word: str, says: str):
    system, choice = load(name, world="md"), parse(word)
    reason = choice.why_not(system)
    assert reason is not None and says in reason
    with pytest.raises(InputError, match="does not apply to"):
        choice.make(system)


@pytest.mark.parametrize("word", ["translate=0.25", "translate=lattice", "unwrapped"])
def test_a_cluster_has_no_images(crystal: System, word: str):
    atoms = crystal.atoms.copy()
    atoms.pbc = False
    assert parse(word).why_not(replace(crystal, atoms=atoms)) == "no axis is periodic"


def test_a_skin_that_the_box_cannot_hold_is_refused_by_the_box(crystal: System):
    with pytest.raises(InputError, match="half the smallest perpendicular"):
        parse("skin=9").make(crystal)


# --- what a choice changes, before any step -----------------------------------------------------------------


def test_only_the_key_that_is_named_moves_and_by_the_ulps_asked_for(crystal: System):
    twin = Ulps("cutoff.radius", -3).make(crystal)
    a, b = twin.a.system.spec, twin.b.system.spec
    assert a.cutoff is not None and b.cutoff is not None
    assert a.cutoff.radius is not None
    assert b.cutoff.radius == a.cutoff.radius - 3 * np.spacing(a.cutoff.radius)
    assert a.model_copy(update={"cutoff": b.cutoff}) == b
    assert twin.b.decider.r_cut[0] == b.cutoff.radius
    assert "1.587401051968199" in twin.difference


def test_a_temperature_draws_the_velocities_of_both_runs(crystal: System):
    twin = Ulps("dynamics.temperature", 1 << 20).make(crystal)
    factor = twin.b.velocities / twin.a.velocities
    assert np.allclose(factor, 1 + 2.0**-32 * 0.02 / 0.02, rtol=1e-9) and (factor != 1).all()
    assert crystal.velocities is not None
    assert not np.array_equal(twin.a.velocities, crystal.velocities)
    assert np.array_equal(twin.a.positions, twin.b.positions)


@pytest.mark.parametrize("state", ["float64", "float32"])
def test_one_coordinate_of_the_start_moves_by_an_ulp_of_the_state(crystal: System, state: str):
    system = varied(crystal, {"precision.state": state})
    for word, ulps in (("start", 1), ("start=5:2:-4", -4)):
        twin = parse(word).make(system)
        a, b = (np.asarray(first_state(one).state.x) for one in (twin.a, twin.b))
        assert a.dtype == np.dtype(state)
        ((axis, atom),) = np.argwhere(a != b)
        assert b[axis, atom] - a[axis, atom] == ulps * np.spacing(a[axis, atom])
        if word == "start":
            assert a[axis, atom] > 0.9 * a.max()


def test_roles_and_sums_are_those_asked_for(crystal: System):
    twin = Precision(("force",)).make(crystal)
    assert twin.b.policy == replace(twin.a.policy, force="float32")
    assert twin.b.system.spec.precision.force == "float32"
    assert twin.difference == "force in float32, not float64"
    for word in ("exact", "permuted:3"):
        twin = parse(f"reduction={word}").make(crystal)
        assert twin.a.reduction != twin.b.reduction
        assert twin.b.system.spec.precision.reduction == ("exact" if word == "exact" else "sequential")
    twin = parse("order@fixed-point").make(crystal)
    assert twin.a.reduction == twin.b.reduction != build(crystal).reduction


def test_a_shift_changes_the_energy_and_no_force(crystal: System):
    twin = parse("energy-shift").make(crystal)
    a, b = (one.evaluate() for one in (twin.a, twin.b))
    assert np.array_equal(a.forces, b.forces) and abs(a.energy - b.energy) > 1
    switched = varied(crystal, {"cutoff.kind": "force-shifted"})
    assert parse("energy-shift").why_not(switched) == "a force-shifted cutoff changes the force too"


def test_lists_are_those_asked_for(crystal: System):
    assert parse("builder").make(crystal).b.builder == "jax-md"
    assert parse("skin=0.5").make(crystal).b.rule.skin == 0.5
    rule = parse("rebuild=every:25").make(crystal).b.rule
    assert (rule.every, rule.delay, rule.check) == (25, 0, False)
    blind = varied(crystal, {"neighbors.rebuild.check": False, "neighbors.rebuild.every": 7})
    rule = parse("rebuild=half-skin").make(blind).b.rule
    assert (rule.every, rule.check) == (1, True)


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
    twin = parse(word).make(crystal)
    assert twin.frame is not None and not twin.frame.is_same
    x = twin.frame.positions(twin.b.positions.T[None])[0].T
    v = twin.frame.vectors(twin.b.velocities.T[None])[0].T
    assert np.allclose(x, twin.a.positions, rtol=0, atol=1e-14)
    assert np.array_equal(v, twin.a.velocities)
    energies = [one.evaluate().energy for one in (twin.a, twin.b)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-13)


def test_a_box_is_turned_only_into_itself(crystal: System):
    atoms = crystal.atoms.copy()
    atoms.set_cell([5.0, 5.0, 7.0], scale_atoms=True)
    tall = replace(crystal, atoms=atoms)
    assert Rotate("yzx").why_not(tall) and Rotate("yxz").why_not(tall) is None
    assert "yxz" in Rotate().make(tall).difference
    # half turns where no two edges are the same, and every lattice is its own mirror image in a point
    atoms.set_cell([5.0, 6.0, 7.0], scale_atoms=True)
    assert "-x-yz" in Rotate().make(replace(crystal, atoms=atoms)).difference
    tilted = load("argon/tilted-500", world="md")
    assert Rotate("-x-yz").why_not(tilted) and "-x-y-z" in Rotate().make(tilted).difference


@pytest.mark.parametrize("images", [None, 1])
def test_images_are_exact_near_the_start(crystal: System, images: int | None):
    twin = Images(images).make(crystal)
    a, b = first_state(twin.a), first_state(twin.b)
    assert np.array_equal(np.asarray(a.state.x), np.asarray(b.state.x))
    assert not np.array_equal(np.asarray(a.state.images), np.asarray(b.state.images))
    own, _ = wrap_positions(twin.a.cell, crystal.atoms.positions)
    assert np.abs(np.asarray(a.state.x).T - own).max() < 1e-14


def test_what_has_no_exact_image_is_counted():
    cell = Cell.create(np.array([3.0, 0.0, 0.0, 1e-3 / 3, 3.1, 0, 0.7 / 3, 0.1 / 7, 2.9]).reshape(3, 3))
    x = np.random.default_rng(0).random((500, 3)) @ np.asarray(cell.matrix)
    wrapped, elsewhere, lost = exact_images(cell, x, np.ones((500, 3), np.int64))
    again, _ = wrap_positions(cell, elsewhere)
    assert lost == (again != wrapped).any(axis=1).sum()
    box = Cell.create([3.0, 3.1, 2.9])
    assert exact_images(box, x, np.ones((500, 3), np.int64))[2] == 0


def test_another_noise_is_another_key_and_the_same_start():
    system = load("argon/langevin-500", world="md")
    row = screened("noise", system, 20)
    # the noise of step 0 moves the atoms of step 1
    assert row.seed == 1 and "seed 12, not 11" in row.difference
    twin = parse("noise").make(system)
    assert np.array_equal(twin.a.velocities, twin.b.velocities)


# --- what it does to a run ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "word",
    [
        "translate=lattice",
        "unwrapped",
        "energy-shift",
        "order@exact",
        "order@fixed-point",
        "relabel@exact",
        "skin@exact",
        "format=ordered-sparse@exact",
        # a list and a program for every step
        pytest.param("rebuild=every:1@exact", marks=pytest.mark.slow),
        pytest.param("builder@exact", marks=pytest.mark.slow),
    ],
)
def test_what_must_hold_holds_to_the_last_bit(crystal: System, word: str):
    row = screened(word, crystal, 200)
    assert row.must_hold and row.held and not row.finding
    assert (row.seed, row.fork, row.split, row.steps) == (None, None, None, 200)


def test_the_same_choices_without_such_sums_do_not_hold(crystal: System):
    words = ("order", "relabel", "skin", "rotate", "format", "format=dense")
    rows = screen(crystal, 200, [parse(word) for word in words])
    assert {row.seed for row in rows} == {1}
    assert not any(row.must_hold or row.held or row.finding for row in rows)


def test_a_broken_promise_is_a_finding(crystal: System):
    class Promised:
        name, about, must_hold = "promised", "an ulp that claims to be none", True

        def why_not(self, system: System) -> str | None:
            return None

        def make(self, system: System):
            return parse("start").make(system)

    (row,) = screen(crystal, 20, [Promised()])
    assert row.finding and row.held is False and row.seed == 0


def test_a_screen_ranks_by_fork_and_then_by_seed_with_what_does_not_apply_last(crystal: System):
    told: list[tuple[int, int, str]] = []
    words = ["noise", "translate=lattice", "start", "ulps=potential.sigma:1099511627776", "order"]
    choices = [parse(word) for word in words]
    rows = screen(crystal, 400, choices, progress=lambda done, total, name: told.append((done, total, name)))
    assert told == [(k, 5, choice.name) for k, choice in enumerate(choices)]
    assert [row.choice for row in rows] == [choices[k].name for k in (3, 2, 4, 1, 0)]
    first, start, order, lattice, noise = rows
    # sigma by 2e-4 moves every force: a pair crosses the cutoff another time soon
    assert first.fork is not None and 1 <= first.fork < 100
    assert (start.seed, order.seed, lattice.seed) == (0, 1, None)
    assert noise.why_not is not None and noise.held is None and noise.steps == 0
    with pytest.raises(InputError, match="no choice to screen"):
        screen(crystal, 10, [])


def test_lists_of_another_order_are_not_those_of_the_leader(crystal: System):
    """B under A's decisions has B's order of pairs: with A's lists it would be A."""
    found = fork(parse("order").make(crystal), 30, repeats=0)
    assert np.nanmax(found.series["B|A"]) > 0
    held = fork(parse("order@exact").make(crystal), 30, repeats=0)
    assert np.nanmax(held.series["B|A"]) == 0 and found.dates.seed == 1


def test_a_choice_is_what_fork_takes(crystal: System):
    found = fork(parse("ulps=potential.epsilon:1099511627776").make(crystal), 150, repeats=0)
    assert found.dates.seed == 1 and found.twin.difference.startswith("potential.epsilon = ")
    assert np.nanmax(found.series["B"]) > 0
