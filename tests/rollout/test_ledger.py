"""The ledger is complete: equal to all pairs of all frames, in many configurations, boxes and lists."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import ase.io
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from devices import on_cpu
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import COMPARISONS, all_pairs, broken_alternations, margins
from rollout.harness import (
    assert_ledger_is_complete,
    frames_of,
    go,
    liquid,
    shaken,
    tables_equal,
    write_system,
)
from small_systems import make, mixture

from mdnum.md import decide, foreign
from mdnum.md.neighbors import VerletList
from mdnum.numerics import Ledger
from mdnum.rollout.engine import _MOST_ROWS, _RECORD_BYTES, Engine
from mdnum.rollout.epoch import EpochRecord
from mdnum.rollout.flips import PairRecorder
from mdnum.rollout.summary import EnergyBudget
from mdnum.systems import load
from mdnum.systems.build import build


@pytest.fixture(scope="module")
def fluid(tmp_path_factory):
    """108 atoms of a hot dense fluid, hard cutoff."""
    return load(write_system(tmp_path_factory.mktemp("fluid"), liquid()))


def ledger_of(folder) -> Ledger:
    rows = folder.read("flips")
    subject = np.stack([rows["i"], rows["j"]], axis=1)
    names = ("entered", "margin", "bound", "energy_jump")
    return Ledger("pair", rows["step"], subject, *(rows[name] for name in names))


def lennard_jones(r2):
    return 4 * (r2**-6 - r2**-3)


@settings(max_examples=5)
@given(seed=st.integers(0, 10**9), temperature=st.floats(0.01, 4.0), rattle=st.floats(0, 0.05))
def test_random_configurations(fluid, tmp_path_factory, seed, temperature, rattle):
    system = shaken(fluid, seed, temperature, rattle)
    result, folder = go(tmp_path_factory.mktemp("r"), system, 70, save_every=1)
    assert_ledger_is_complete(result, folder)
    series, ledger = folder.read("series"), ledger_of(folder)
    entered, left = ledger.counts(70)
    assert np.array_equal(series["pairs"], series["pairs"][0] + np.cumsum(entered - left))
    entered, left = ledger.counts(70)
    assert np.array_equal(series["entered"], entered) and np.array_equal(series["left"], left)
    assert np.allclose(series["energy_jump"], ledger.jumps(70), rtol=0, atol=1e-15)
    assert broken_alternations(ledger) == 0
    assert result.summary["lost_pairs"] == result.summary["count_mismatches"] == 0


def test_every_column_of_a_flip(fluid, tmp_path):
    result, folder = go(tmp_path, shaken(fluid, 5, 2.0), 70, save_every=1)
    frames = ase.io.read(folder.path / "trajectory.traj", index=":")
    flips = folder.read("flips")
    assert len(flips["step"]) > 100
    assert np.all(flips["i"] < flips["j"]) and np.all(flips["step"] >= 1)
    jump = lennard_jones(4.0)
    slope = 4 * (-12 * 2.0**-13 + 6 * 2.0**-7)
    sign = np.where(flips["entered"], 1, -1)
    assert np.allclose(flips["energy_jump"], sign * jump, rtol=1e-13)
    assert np.allclose(flips["force_jump"], sign * -slope, rtol=1e-12)
    bound = result.simulation.decider.bounds[0]
    assert np.all(flips["bound"] == bound)
    assert np.array_equal(flips["ambiguous"], np.abs(flips["margin"]) <= bound)
    for k in range(0, len(flips["step"]), 7):
        atoms = frames[flips["step"][k]]
        i, j = flips["i"][k], flips["j"][k]
        d = atoms.get_distance(i, j, mic=True, vector=True)
        v = atoms.get_velocities()[j] - atoms.get_velocities()[i]
        assert flips["distance"][k] == pytest.approx(np.linalg.norm(d), rel=1e-12)
        assert flips["radial_speed"][k] == pytest.approx(v @ d / np.linalg.norm(d), rel=1e-10, abs=1e-12)
    # a pair that comes in usually moves inward
    assert np.mean(np.sign(flips["radial_speed"]) == -sign) > 0.95


def test_the_series_are_those_of_the_frames(fluid, tmp_path):
    _, folder = go(tmp_path, shaken(fluid, 6, 1.5), 70, save_every=1)

    frames, series = ase.io.read(folder.path / "trajectory.traj", index=":"), folder.read("series")
    cell = fluid.atoms.cell.array
    for step in (0, 1, 13, 70):
        atoms = frames[step]
        assert atoms.info["step"] == step
        _, _, d = all_pairs(atoms.positions, cell, (True,) * 3)
        inside, margin = margins(d, 2.0)
        r2 = (d[inside] ** 2).sum(axis=1)
        kinetic = 0.5 * (atoms.get_velocities() ** 2).sum()
        assert series["potential"][step] == pytest.approx(lennard_jones(r2).sum(), rel=1e-12)
        # the same bits: what the loop summed, and no other evaluation
        assert atoms.get_potential_energy() == series["potential"][step]
        assert series["kinetic"][step] == pytest.approx(kinetic, rel=1e-13)
        assert series["temperature"][step] == pytest.approx(2 * kinetic / (3 * 108 - 3), rel=1e-13)
        virial = (24 * (2 * r2**-6 - r2**-3)).sum()
        pressure = (2 * kinetic + virial) / (3 * fluid.atoms.get_volume())
        assert series["pressure"][step] == pytest.approx(pressure, rel=1e-10)
        # the closest call among the listed pairs is the closest of all
        assert series["min_margin"][step] == pytest.approx(np.abs(margin).min(), rel=1e-9)
    total = series["potential"] + series["kinetic"]
    assert np.array_equal(series["total"], total) and np.array_equal(series["conserved"], total)
    assert np.allclose(series["time"], 0.004 * series["step"])


def test_a_budget_notices_a_flip_that_was_not_told(fluid, tmp_path):
    result, folder = go(tmp_path, shaken(fluid, 7, 1.5), 70, save_every=1)
    series, flips, frames = folder.read("series"), folder.read("flips"), frames_of(folder)
    assert result.summary["energy_budget_closes"] and abs(result.summary["energy_budget_residual"]) < 1e-9
    told, silent = EnergyBudget(result.simulation), EnergyBudget(result.simulation)
    for budget, drop in ((told, 0), (silent, 1)):
        budget.check(0, frames[0], float(series["potential"][0]))
        budget.jumps = float(flips["energy_jump"][drop:].sum())
        budget.check(70, frames[70], float(series["potential"][70]))
        restored = EnergyBudget.from_dict(result.simulation, budget.to_dict())
        assert restored.residual == budget.residual and restored.closes == budget.closes
    assert told.closes and not silent.closes
    assert abs(silent.residual) == pytest.approx(abs(lennard_jones(4.0)), rel=1e-6)


def test_a_budget_notices_the_smallest_jump_of_a_mixture():
    """Jumps ten times apart: a budget with an allowed error of a tenth of the largest hides all others."""
    depths = {"Ni-Ni": 1.0, "Ni-P": 0.1, "P-P": 0.01}
    pairs = {pair: {"sigma": 1.0, "epsilon": depth} for pair, depth in depths.items()}
    potential = {"kind": "lennard-jones", "pairs": pairs}
    simulation = build(make(mixture(), potential, {"kind": "hard", "radius": 2.0}))
    smallest = 0.01 * abs(lennard_jones(4.0))
    assert EnergyBudget(simulation).tolerance == pytest.approx(0.1 * smallest, rel=1e-12)
    for share, closes in ((1.0, False), (-1.0, False), (0.11, False), (0.09, True)):
        assert EnergyBudget(simulation, residual=share * smallest).closes == closes


def test_a_capacity_that_grows_loses_no_step(fluid, tmp_path, monkeypatch):
    system = shaken(fluid, 9, 2.0)
    _, plain = go(tmp_path / "plain", system, 70, save_every=1)
    monkeypatch.setattr(VerletList, "_guess", lambda self, atoms, cell, r_list: 8)
    monkeypatch.setattr(VerletList, "slack", 1.0)
    result, grown = go(tmp_path / "grown", system, 70, save_every=1)
    assert_ledger_is_complete(result, grown)
    assert np.all(grown.read("epochs")["capacity"] > 8)
    tables_equal(plain, grown, "flips")


@pytest.mark.parametrize("skin", [0.0, 0.001, 0.1])
def test_the_ledger_is_complete_at_any_skin(tmp_path, skin):
    """Also of pairs that leave beyond it in one step."""
    result, folder = go(
        tmp_path, write_system(tmp_path, liquid()), 70, {"neighbors.skin": skin}, save_every=1
    )
    assert assert_ledger_is_complete(result, folder) > 50
    assert result.summary["rebuilds"] > 3


def cloud() -> Atoms:
    """Atoms far apart in no box at all, flying toward their center: their lists fill up on the way."""
    rng = np.random.default_rng(12)
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 2.2
    positions = grid + rng.normal(0, 0.05, grid.shape) + [5e3, -40.0, 0.0]
    atoms = Atoms("Ar64", positions=positions, masses=np.ones(64))
    atoms.set_velocities(-1.2 * (positions - positions.mean(axis=0)))
    return atoms


@pytest.mark.nightly
def test_a_free_cloud_that_collapses_makes_its_list_grow_on_the_way(tmp_path):
    path = write_system(tmp_path, cloud(), dynamics={"timestep": 0.004})
    result, folder = go(tmp_path, path, 127, save_every=1)
    assert assert_ledger_is_complete(result, folder) > 200
    capacity = folder.read("epochs")["capacity"]
    assert capacity[0] == 8 < capacity[-1] and np.all(np.diff(capacity) >= 0)
    assert np.array_equal(folder.read("epochs")["occupancy"] <= capacity, np.full(len(capacity), True))
    assert np.isnan(folder.read("series")["pressure"]).all()
    assert result.summary["energy_budget_closes"]


@pytest.mark.parametrize(
    "tilt, pbc",
    [
        (True, (True, True, False)),
        pytest.param(True, (True, True, True), marks=pytest.mark.nightly),
        pytest.param(False, (True, False, False), marks=pytest.mark.nightly),
        pytest.param(True, (False, False, True), marks=pytest.mark.nightly),
        pytest.param(False, (False, False, False), marks=pytest.mark.nightly),
    ],
)
def test_boxes_of_every_kind(tmp_path, tilt, pbc):
    atoms = liquid(tilt=tilt)
    atoms.pbc = pbc
    result, folder = go(tmp_path, write_system(tmp_path, atoms, cutoff={"radius": 1.9}), 100, save_every=1)
    assert assert_ledger_is_complete(result, folder) > 300
    summary = result.summary
    assert summary["lost_pairs"] == summary["count_mismatches"] == 0
    assert summary["energy_budget_closes"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(1, 6))])
def test_random_mixtures(tmp_path, seed):
    """Two species with cutoffs of their own, any box, any kind of cutoff, any convention."""
    rng = np.random.default_rng(seed)
    atoms = liquid(tilt=bool(seed % 2), seed=seed, rattle=0.06)
    atoms.symbols[rng.random(len(atoms)) < 0.3] = "Ne"
    pairs = {
        "Ar-Ar": {"sigma": 1.0, "epsilon": 1.0},
        "Ar-Ne": {"sigma": 0.9, "epsilon": 1.2},
        "Ne-Ne": {"sigma": 0.85, "epsilon": 0.6},
    }
    radii = {"Ar-Ne": 1.7, "Ne-Ne": 1.55}
    kind = ("hard", "shifted", "force-shifted", "switched", "quintic", "cosine")[seed]
    path = write_system(
        tmp_path,
        atoms,
        potential={"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0, "pairs": pairs},
        cutoff={"kind": kind, "radius": 1.9, "compare": COMPARISONS[-1 - seed % 4], "pairs": radii},
        neighbors={"skin": float(rng.uniform(0.1, 0.3))},
        dynamics={"timestep": 0.002, "temperature": float(rng.uniform(0.2, 3))},
    )
    result, folder = go(tmp_path, path, 120, save_every=1)
    assert assert_ledger_is_complete(result, folder) > 100
    assert result.summary["energy_budget_closes"]


# --- recording changes nothing, and its buffers do not grow with the steps ------------------------------


STEPS = 120


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("fluid"), liquid())


def rows_and_end(simulation, last, record):
    """The numbers of every step and the bits of the last state."""
    numbers = {name: [] for name in ("potential", "kinetic", "virial", "heat", "moved")}
    closed = []
    for segment in Engine(simulation, last, record=record).segments():
        for name, values in numbers.items():
            values.append(np.array(segment.rows_of(name)))
        closed.append((segment.last, segment.closes))
    state = {str(k): np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(segment.state))}
    return {name: np.concatenate(values) for name, values in numbers.items()}, state, closed


def test_a_run_that_is_recorded_has_the_bits_of_one_that_is_not(path):
    simulation = build(load(path))
    seen, blind, again = (rows_and_end(simulation, STEPS, record) for record in (True, False, True))
    assert len(seen[0]["potential"]) == STEPS + 1 and len(seen[2]) > 2
    for other in (blind, again):
        for numbers, theirs in zip(seen[:2], other[:2], strict=True):
            assert {name: numbers[name].tobytes() for name in numbers} == {
                name: theirs[name].tobytes() for name in theirs
            }
        assert seen[2] == other[2]


def test_hard_and_shifted_are_the_same_trajectory_with_other_energies(path, tmp_path):
    hard, one = go(tmp_path / "hard", path, STEPS)
    shifted, other = go(tmp_path / "shifted", path, STEPS, {"cutoff.kind": "shifted"})
    tables_equal(one, other, "flips", but=("energy_jump",))
    tables_equal(one, other, "epochs", but=("build_ms",))
    apart = ("potential", "total", "conserved", "energy_jump")
    tables_equal(one, other, "series", but=apart)
    a, b = one.load_checkpoint(), other.load_checkpoint()
    for name in ("state_x", "state_v", "state_images"):
        assert a[name].tobytes() == b[name].tobytes()
    x, y = one.read("series"), other.read("series")
    jump = 4 * (2.0**-12 - 2.0**-6)
    assert np.allclose(x["potential"] - y["potential"], x["pairs"] * jump, rtol=0, atol=1e-10)
    assert np.any(x["energy_jump"] != 0) and not np.any(y["energy_jump"])
    assert not np.any(other.read("flips")["energy_jump"])
    assert (
        hard.summary["cutoff"]["energy_jump"] == pytest.approx(jump)
        and shifted.summary["cutoff"]["energy_jump"] == 0
    )
    # which is why a hard run's energy jumps while the shifted one keeps it
    assert np.std(x["total"]) > 5 * np.std(y["total"])


def record_bytes(engine, words):
    record = jax.eval_shape(lambda: engine.take(0, words))
    assert isinstance(record, EpochRecord)
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(record))


def test_record_buffers_do_not_grow_with_the_steps(path):
    simulation = build(load(path))
    sizes = [record_bytes(Engine(simulation, last), 6) for last in (1_000, 100_000, 10**9)]
    assert len(set(sizes)) == 1
    assert sizes[0] <= _RECORD_BYTES
    segments = list(Engine(simulation, STEPS).segments())
    assert all(segment.record.x.shape[0] <= _MOST_ROWS for segment in segments)
    assert sum(segment.rows for segment in segments) == STEPS + 1
    # a large system gets fewer rows, not more memory; and a short run little room
    engine, short = Engine(simulation, 10**6), Engine(simulation, 3)
    # where room is cheap runs of all lengths have the same, so that they are one program
    assert short._room(6) == Engine(simulation, 100)._room(6)
    assert record_bytes(short, 6) < 5e6
    for one, atoms in ((engine, 200_000), (short, 50_000)):
        one.simulation = SimpleNamespace(atoms=atoms, policy=simulation.policy)
    assert record_bytes(engine, 11) <= _RECORD_BYTES * 1.1
    assert 4 <= short._room(6) <= 8


def test_no_steps_at_all_is_one_evaluation(path, tmp_path):
    result, folder = go(tmp_path, path, 0)
    series = folder.read("series")
    assert series["step"].tolist() == [0]
    assert len(folder.read("flips")["step"]) == 0
    assert result.summary["status"] == "complete" and result.summary["energy_budget_closes"]


def recorded(simulation, rows, steps=60, most=None):
    """Ledger, pairs inside and last positions of a run, and the room that a step has had in the end."""
    engine, recorder = Engine(simulation, steps, rows=rows), PairRecorder(simulation)
    if most:
        engine._room_for_changes(most)
    parts, counts = [], []
    for segment in engine.segments():
        counts.append(recorder.counts(segment))
        parts.append(recorder.flips(segment))
        last = segment.unsorted("x", segment.rows - 1)
    columns = [part.columns() for part in parts]
    arrays = columns[0].keys() - {"decided_by"}
    ledger = {name: np.concatenate([one[name] for one in columns]) for name in arrays}
    return ledger, np.concatenate(counts), last, engine.program.most


@pytest.mark.parametrize(
    ("name", "on"),
    [
        ("argon/langevin-500", "host"),
        *(
            pytest.param(*one, marks=pytest.mark.nightly)
            for one in (
                ("fluid", "device"),
                ("fluid", "host"),
                ("argon/langevin-500", "device"),
                ("binary/kob-andersen-1000", "host"),
                ("binary/kob-andersen-1000", "device"),
            )
        ),
    ],
)
def test_changes_noted_in_the_loop_are_those_of_its_rows(fluid, monkeypatch, name, on):
    system = shaken(fluid, 3, 2.5) if name == "fluid" else load(name)
    if on == "device":
        # as where there is no CPU: XLA finds the changes, and its own loop makes the forces
        monkeypatch.setattr(foreign, "known", lambda: False)
    simulation = build(system)
    # and the lists, of which those of the host are the same
    lean = replace(simulation, builder="device") if on == "device" else simulation
    jax.clear_caches()
    try:
        with_rows = recorded(simulation, True)
        few, plenty = (recorded(lean, False, most=most) for most in (2, None))
    finally:
        jax.clear_caches()
    assert len(with_rows[0]["i"]) > 30
    in_order = np.lexsort([with_rows[0][name] for name in ("j", "i", "step")])
    assert np.array_equal(in_order, np.arange(len(in_order)))
    for one in (few, plenty):
        for name, values in with_rows[0].items():
            np.testing.assert_array_equal(one[0][name], values)
        assert np.array_equal(one[1], with_rows[1]) and np.array_equal(one[2], with_rows[2])
    # steps with more changes than there was room for were made again
    assert few[3] > 2


@pytest.mark.parametrize("words, atoms", [(1, 5), (3, 13), (16, 64), (40, 103)])
@pytest.mark.parametrize("on", [pytest.param("host", marks=on_cpu), "device"])
def test_changes_are_noted_to_the_last_byte(monkeypatch, on, words, atoms):
    monkeypatch.setattr(foreign, "known", lambda: on == "host")
    rng = np.random.default_rng(words)
    before, bits = rng.integers(0, 256, (2, words, atoms), np.uint8)
    index = rng.integers(0, atoms + 1, (words, 8, atoms)).astype(np.int32)
    # a neighbor of padding has no numbers, and is decided never
    both = np.packbits(index < atoms, axis=1, bitorder="little")[:, 0]
    before, bits = before & both, bits & both
    x, v = rng.normal(size=(2, 3, atoms))
    word, first, slot = np.nonzero(np.unpackbits((before ^ bits)[..., None], axis=2, bitorder="little"))
    second, now = index[word, slot, first], (bits[word, first] >> slot) & 1
    seen = second > first
    pairs = np.stack([np.full(len(first), 7), first, second, now], axis=1)[seen]
    ends = np.concatenate([x[:, pairs[:, 1]], x[:, pairs[:, 2]], v[:, pairs[:, 1]], v[:, pairs[:, 2]]]).T

    def noted(before, bits, index, x, v):
        tables = decide.Tables(index, None, jnp.arange(atoms))
        # for all of them and no more
        empty = decide.Changes.empty(len(pairs), x.dtype)
        made, held = empty.noted(before, bits, tables, x, v, jnp.int64(7), len(pairs))
        return *made, held, before

    *made, held, untouched = [np.asarray(part) for part in jax.jit(noted)(before, bits, index, x, v)]
    assert np.array_equal(held, bits) and np.array_equal(untouched, before)
    assert made[2].tolist() == [len(pairs), len(first), np.bitwise_count(bits).sum()]
    here, there = (np.lexsort(found.T) for found in (made[0][: len(pairs)], pairs))
    assert np.array_equal(made[0][here], pairs[there]) and np.array_equal(made[1][here], ends[there])


def test_more_flips_than_were_expected_are_all_in_the_ledger(fluid):
    hot = shaken(fluid, 3, 60.0)
    simulation = build(hot)
    most = 0
    for lean, kept in zip(
        Engine(simulation, 40, rows=False).segments(), Engine(simulation, 40).segments(), strict=True
    ):
        one, other = (PairRecorder(simulation).flips(segment) for segment in (lean, kept))
        assert one.equals(other)
        assert len(set(zip(one.step, one.i, one.j, strict=True))) == len(one)
        most = max(most, len(one) / lean.rows)
    # more than there is room for at first
    assert most > max(64, simulation.atoms // 4)


def test_rows_are_made_again_where_somebody_asks(fluid):
    simulation = build(shaken(fluid, 3, 2.0))
    steps = zip(Engine(simulation, 60, rows=False).segments(), Engine(simulation, 60).segments(), strict=True)
    for lean, kept in steps:
        assert lean.record.x.size == 0 and lean.rows == kept.rows
        for name in ("x", "v", "images", "bits", "potential"):
            assert np.array_equal(lean.rows_of(name), kept.rows_of(name))
        assert np.array_equal(lean.unsorted("v", 1), kept.unsorted("v", 1))
