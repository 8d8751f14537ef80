"""Recording changes nothing, hard and shifted are one trajectory, and buffers do not grow with the steps."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from rollout.harness import go, liquid, tables_equal, write_system

from mdnum.rollout.engine import _MOST_ROWS, _RECORD_BYTES, Engine
from mdnum.rollout.epoch import EpochRecord
from mdnum.systems import load
from mdnum.systems.build import build

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
    state = {name: np.asarray(value) for name, value in segment.state._asdict().items()}
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
