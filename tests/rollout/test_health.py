"""What a run says about its lists, against an audit and LAMMPS's rules written out."""

from __future__ import annotations

import ase.io
import numpy as np
import pytest
from oracles import all_pairs, margins
from rollout.harness import assert_ledger_is_complete, go, liquid, write_system

R_CUT = 2.0


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("hot"), liquid(), dynamics={"temperature": 2.0})


def trajectory(folder):
    """Wrapped and unwrapped positions of every step."""
    frames = ase.io.read(folder.path / "trajectory.traj", index=":")
    wrapped = np.array([atoms.positions for atoms in frames])
    cell = frames[0].cell.array
    # from frame to frame an atom goes the short way
    hops = np.diff(wrapped, axis=0)
    hops -= np.rint(hops @ np.linalg.inv(cell)) @ cell
    return wrapped, wrapped[0] + np.concatenate([np.zeros_like(wrapped[:1]), np.cumsum(hops, axis=0)]), cell


def audit(wrapped, cell, starts, r_list):
    """(missing pairs by step) of lists that hold the pairs within r_list at the start of their epoch."""
    missing = []
    listed = None
    for step, positions in enumerate(wrapped):
        i, j, d = all_pairs(positions, cell, (True,) * 3)
        if step in starts:
            listed = np.linalg.norm(d, axis=1) <= r_list
        inside, _ = margins(d, R_CUT)
        lost = inside & ~listed
        missing.append(set(zip(i[lost].tolist(), j[lost].tolist(), strict=True)))
    return missing


def lammps_schedule(unwrapped, skin, every, delay, check):
    """Steps at which LAMMPS's `neigh_modify every delay check` rebuilds, and which of those are dangerous."""
    built, reference, builds, dangerous = 0, unwrapped[0], [], []
    for step in range(1, len(unwrapped)):
        ago = step - built
        if ago < delay or ago % every:
            continue
        moved = np.max(np.sum((unwrapped[step] - reference) ** 2, axis=1))
        if check and moved <= (skin / 2) ** 2:
            continue
        builds.append(step)
        dangerous.append(check and ago == max(every, delay))
        built, reference = step, unwrapped[step]
    return builds, dangerous


# far beyond the skin, and where no atom has moved by the whole of it: two together have
@pytest.mark.parametrize(("every", "fewest"), [(20, 50), (3, 1)])
def test_a_blind_list_with_too_small_a_skin_loses_pairs_and_the_run_says_so(path, tmp_path, every, fewest):
    overrides = {"neighbors.skin": 0.05, "neighbors.rebuild.every": every, "neighbors.rebuild.check": False}
    result, folder = go(tmp_path, path, 120, overrides, save_every=1)
    wrapped, unwrapped, cell = trajectory(folder)
    epochs, summary, series = folder.read("epochs"), result.summary, folder.read("series")
    builds, dangerous = lammps_schedule(unwrapped, 0.05, every, 0, False)
    assert epochs["start"][1:].tolist() == builds == list(range(every, 121, every))
    assert epochs["reason"].tolist() == ["interval"] * len(builds) + ["end"]
    assert summary["dangerous_builds"] == sum(dangerous) == 0
    missing = audit(wrapped, cell, {0, *builds}, R_CUT + 0.05)
    counts = [len(pairs) for pairs in missing]
    assert sum(counts) >= fewest
    assert (series["displacement"].max() < 0.05) == (every == 3)
    assert summary["lost_pair_steps"] == sum(counts)
    assert summary["lost_pairs"] == len(set().union(*missing))
    assert summary["first_lost_step"] == next(step for step, count in enumerate(counts) if count)
    # epoch by epoch, too
    for row, start in enumerate(epochs["start"]):
        mine = missing[start : start + epochs["length"][row]]
        assert epochs["lost_pair_steps"][row] == sum(map(len, mine))
        assert epochs["lost_pairs"][row] == len(set().union(*mine))
        first = next((start + k for k, pairs in enumerate(mine) if pairs), -1)
        assert epochs["first_lost_step"][row] == first
    # what the program counted is what there was, less what it lost
    true = [int(margins(all_pairs(p, cell, (True,) * 3)[2], R_CUT)[0].sum()) for p in wrapped]
    assert series["pairs"].tolist() == [t - lost for t, lost in zip(true, counts, strict=True)]
    # what has just come inside has next to no energy in the shifted potential of the budget
    assert summary["energy_budget_closes"] == (every == 3)
    assert summary["count_mismatches"] > 0


@pytest.mark.parametrize(
    "every, delay, skin", [(1, 0, 0.05), (5, 0, 0.1), pytest.param(2, 6, 0.1, marks=pytest.mark.nightly)]
)
def test_lists_are_rebuilt_and_dangerous_builds_counted_as_lammps_does(path, tmp_path, every, delay, skin):
    overrides = {"neighbors.skin": skin, "neighbors.rebuild.every": every, "neighbors.rebuild.delay": delay}
    result, folder = go(tmp_path, path, 120, overrides, save_every=1)
    rule, summary = result.simulation.rule, result.summary
    assert (rule.every, rule.delay, rule.check, rule.skin) == (every, delay, True, skin)
    wrapped, unwrapped, cell = trajectory(folder)
    builds, dangerous = lammps_schedule(unwrapped, skin, every, delay, True)
    epochs = folder.read("epochs")
    assert epochs["start"].tolist() == [0, *builds]
    assert epochs["dangerous"].tolist() == [*dangerous, False]
    assert summary["rebuilds"] == len(builds) and summary["dangerous_builds"] == sum(dangerous)
    if not rule.safe:
        assert sum(dangerous) > 0
        return
    # the safe rule loses none at a skin at which a blind one does
    assert_ledger_is_complete(result, folder)
    assert (summary["lost_pairs"], summary["lost_pair_steps"], summary["first_lost_step"]) == (0, 0, -1)
    assert summary["count_mismatches"] == 0 and len(builds) > 10
    assert not any(audit(wrapped, cell, {0, *builds}, R_CUT + skin))


def test_the_epoch_table_accounts_for_every_step(path, tmp_path):
    result, folder = go(tmp_path, path, 120, save_every=1)
    skin = 0.3
    epochs, series = folder.read("epochs"), folder.read("series")
    assert epochs["epoch"].tolist() == list(range(len(epochs["epoch"])))
    assert epochs["start"][0] == 0
    assert np.array_equal(epochs["start"][1:], np.cumsum(epochs["length"])[:-1])
    assert epochs["length"].sum() == 121
    assert set(epochs["reason"][:-1]) == {"displacement"} and epochs["reason"][-1] == "end"
    assert len(epochs["epoch"]) == result.summary["rebuilds"] + 1 > 2
    wrapped, unwrapped, cell = trajectory(folder)
    for row, start in enumerate(epochs["start"]):
        steps = slice(start, start + epochs["length"][row])
        moved = np.linalg.norm(unwrapped[steps] - unwrapped[start], axis=2).max(axis=1)
        assert np.allclose(series["displacement"][steps], moved, rtol=0, atol=1e-12)
        assert (
            epochs["skin_consumed"][row] == pytest.approx(2 * moved.max() / skin, abs=1e-11)
            and moved.max() <= skin / 2
        )
        if row + 1 < len(epochs["start"]):
            # the next list begins at the first step that would have overdrawn this one's skin
            then = np.linalg.norm(unwrapped[steps.stop] - unwrapped[start], axis=1).max()
            assert epochs["start"][row + 1] == steps.stop and then > skin / 2
            assert epochs["margin"][row] == pytest.approx(skin / 2 - then, abs=1e-12)
        _, _, d = all_pairs(wrapped[start], cell, (True,) * 3)
        assert epochs["pairs_listed"][row] == np.sum(np.linalg.norm(d, axis=1) <= R_CUT + skin)
        assert epochs["occupancy"][row] <= epochs["capacity"][row]
    assert np.all(series["displacement"] <= skin / 2)
    assert np.all(epochs["build_ms"] > 0)
