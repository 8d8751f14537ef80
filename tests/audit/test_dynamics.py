"""A run's energy is accounted for: flips, integrator and the rest, each against what is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.lj import LennardJones
from ase.constraints import FixBondLengths
from audit import planted
from audit.planted import Good, codes, subject, values

from mdnum.audit.checks.dynamics import DynamicsCheck, fitting_timestep, prepared, rigid, run
from mdnum.audit.energy import Drift, account, crossings, drift, ratio, wandering

STEPS = 60


def dynamics(make, atoms: Atoms, steps: int = STEPS, order: int | None = 4):
    return DynamicsCheck(steps=steps)(subject(make, atoms, order))


def shaken(atoms: Atoms) -> Atoms:
    atoms.positions += np.random.default_rng(1).uniform(-0.15, 0.15, atoms.positions.shape)
    return atoms


def liquid() -> Atoms:
    """Eight atoms, warm enough to cross the cutoff many times."""
    return shaken(bulk("Ar", "sc", a=2.6).repeat((2, 2, 2)))


def wide() -> Atoms:
    """Twenty-seven atoms in a cell of more than two cutoffs."""
    return shaken(bulk("Ar", "sc", a=2.4).repeat((3, 3, 3)))


@pytest.fixture(scope="module")
def hard_run():
    """A run over a hard cutoff, and its crossings."""
    asked = subject(planted.HardEdge, liquid(), 0)
    start = prepared(asked, liquid(), None, 1.0, np.random.default_rng(2))
    found, _ = run(asked, start, 1.0, STEPS)
    return asked, found, crossings(found, asked.known["thresholds"])


def test_every_crossing_is_in_the_ledger(hard_run):
    """Their number is what the pairs inside, found by brute force, change by at every step."""
    _, found, crossed = hard_run
    inside = [len(Good().neighbors(found.at(one))[0]) // 2 for one in found.positions]
    balance = np.zeros(len(inside), int)
    for one in crossed:
        balance[one.step] += 1 if one.entered else -1
    assert len(crossed) > 20
    np.testing.assert_array_equal(np.diff(inside), balance[1:])


def test_jumps_are_those_of_the_potential(hard_run):
    """A pair that enters brings 0.01 eV; the rest of the step is work, to the tenth digit."""
    asked, found, crossed = hard_run
    steps = sorted({one.step for one in crossed})[:12]
    assert len(steps) == 12 and {one.sign for one in crossed if one.step in steps} == {-1, 1}
    for step in steps:
        here = [one for one in crossed if one.step == step]
        jumps, rest = account(asked.fresh(), found, step, here)
        np.testing.assert_allclose(jumps, [0.01 * one.sign for one in here], rtol=0, atol=1e-9)
        assert abs(rest) < 1e-8


def test_a_run_without_its_jumps_is_that_of_the_smooth_potential(hard_run):
    """Energy minus jumps is the energy of the same positions without the step, up to a constant."""
    _, found, crossed = hard_run
    brought = np.zeros(len(found.potential))
    for one in crossed:
        brought[one.step] += 0.01 * one.sign
    good = subject(Good, liquid())
    without = [good.energy(found.at(positions)) for positions in found.positions[::10]]
    difference = (found.potential - np.cumsum(brought))[::10] - without
    np.testing.assert_allclose(difference, difference[0], rtol=0, atol=1e-12)


def test_what_is_right_passes():
    part = dynamics(Good, liquid())
    assert not [one for one in part.findings if one.severity != "info"]
    numbers = part.numbers
    assert numbers["crossings"] > 20 and numbers["flips"] == 0.0
    assert abs(numbers["rest"]) < 1e-3 * max(abs(numbers["drift"]), numbers["drift_error"])


def test_shares_add_up_and_flips_are_blamed():
    part = dynamics(planted.HardEdge, liquid(), order=0)
    numbers = part.numbers
    total = numbers["integrator"] + numbers["flips"] + numbers["rest"]
    assert total == pytest.approx(numbers["drift"], rel=1e-9)
    assert numbers["largest_jump"] == pytest.approx(0.01, rel=1e-6)
    assert "FLIPS_CHANGE_ENERGY" in codes(part) and "NOT_CONSERVED" not in codes(part)
    assert numbers["flips_error"] > 100 * abs(numbers["rest"])


class Nearest(Good):
    """Each atom feels the nearest seven of its neighbors, and every second atom is felt more."""

    def answer(self, atoms):
        i, j, vectors = self.neighbors(atoms)
        distances = np.linalg.norm(vectors, axis=1)
        order = np.lexsort((distances, i))
        rank = np.empty(len(i), int)
        rank[order] = np.arange(len(i)) - np.searchsorted(i[order], i[order])
        weight = np.where(rank < 7, 0.5 + 0.25 * (j % 2), 0.0)
        u, slope = self.pair(distances)
        along = (weight * slope / distances)[:, None] * vectors
        forces = np.zeros((len(atoms), 3))
        np.add.at(forces, i, along)
        np.add.at(forces, j, -along)
        return float(np.sum(weight * u)), forces


def test_a_choice_of_the_nearest_is_found_in_a_run():
    """Its jumps are where the seventh and the eighth change places, which no pair threshold tells."""
    part = dynamics(Nearest, wide(), 24)
    told, numbers = values(part, "HIDDEN_JUMPS"), part.numbers
    assert told["variants"] == ["tie"] and told["k"] == 7
    assert numbers["hidden_jumps"] > 5 and "FLIPS_CHANGE_ENERGY" not in codes(part)
    shares = ("integrator", "flips", "elsewhere", "rest")
    rows = {row["drift"]: row["slope (meV/atom/ps)"] for row in part.tables["Drift, and where it is from"]}
    assert sum(rows[one] for one in shares) == pytest.approx(rows["total"], rel=1e-9)


def test_a_force_without_an_energy_is_found_and_is_no_jump():
    part = dynamics(planted.NoSwitchInForce, liquid(), 40)
    assert codes(part)["NOT_CONSERVED"] in ("error", "warning") and part.numbers["hidden_jumps"] == 0
    assert not {"STALE_DYNAMICS", "FLIPS_CHANGE_ENERGY"} & set(codes(part))


def test_an_old_list_is_blamed():
    assert codes(dynamics(planted.OldPairs, liquid(), 40))["STALE_DYNAMICS"] == "error"


def test_half_the_time_step_takes_three_quarters_of_the_integrators_error():
    """Two atoms on a spring: the energy swings by a share that goes with the square of the time step."""

    def spring(self, atoms):
        vector = atoms.positions[1] - atoms.positions[0]
        length = float(np.linalg.norm(vector))
        force = (length - 2.0) * vector / length
        return 0.5 * (length - 2.0) ** 2, np.array([force, -force])

    atoms = Atoms("Ar2", positions=[[0, 0, 0], [2.3, 0, 0]], cell=[20] * 3)
    asked = subject(planted.but(answer=spring), atoms)
    # reduced mass m/2, spring constant 1: the mode moves against both masses
    step, period = fitting_timestep(asked, atoms, np.random.default_rng(0))
    assert period == pytest.approx(2 * np.pi * np.sqrt(atoms.get_masses()[0] / 2), rel=1e-3)
    assert step == pytest.approx(period / 40, rel=1e-9)
    whole, half = (run(asked, atoms, step / part, 80 * part)[0] for part in (1, 2))
    assert np.ptp(half.total) == pytest.approx(np.ptp(whole.total) / 4, rel=0.02)


def test_a_run_that_flies_apart_is_told():
    atoms = bulk("Ar", "fcc", a=5.26, cubic=True)
    asked = subject(lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5), atoms, None)
    assert codes(DynamicsCheck(60.0, STEPS)(asked)) == {"BLEW_UP": "error"}


def test_atoms_that_feel_nothing_are_no_run():
    asked = subject(Good, Atoms("Ar", positions=[[0, 0, 0]], cell=[20] * 3), None)
    asked.kT = 0.0
    part = DynamicsCheck()(asked)
    assert part.skipped and not part.findings


def test_slope_and_its_error():
    """Of white noise on a slope: the slope is found within its error, and the error is that of theory."""
    rng = np.random.default_rng(0)
    time = np.arange(400.0)
    found = [drift(time, 0.02 * time + rng.standard_normal(400)) for _ in range(200)]
    slopes = np.array([one.slope for one in found])
    theory = 1 / np.sqrt(np.sum((time - time.mean()) ** 2))
    assert slopes.mean() == pytest.approx(0.02, abs=4 * theory / np.sqrt(200))
    assert np.mean([one.error for one in found]) == pytest.approx(theory, rel=0.1)
    assert slopes.std() == pytest.approx(theory, rel=0.15)


def test_a_walk_without_a_slope_is_not_told_to_have_one():
    """The sum of jumps of either sign wanders: a straight line's residue would make it a drift."""
    rng = np.random.default_rng(1)
    time = np.arange(400.0)
    walks = [rng.choice([-1.0, 1.0], 400) for _ in range(200)]
    assert np.mean([wandering(time, walk).significant for walk in walks]) < 0.05
    assert np.mean([drift(time, np.cumsum(walk)).significant for walk in walks]) > 0.3


def test_drift_ratio_is_energy_drifted_over_scatter_of_kinetic_energy():
    time = np.linspace(0.0, 10.0, 200)
    kinetic = np.sin(time)
    assert ratio(time, 0.03 * time, kinetic) == pytest.approx(0.3 / np.std(kinetic), rel=1e-9)
    assert Drift(2.0, 1.0).minus(Drift(1.0, 1.0)).error == pytest.approx(np.sqrt(2))


def test_rigid_molecules_keep_their_shape():
    """As ASE's own constraint holds them, bond by bond."""
    water = Atoms("OH2", positions=[[0, 0, 0], [0.96, 0, 0], [-0.24, 0.93, 0]], cell=[4] * 3, pbc=True)
    atoms = water.repeat((2, 1, 1))
    held = rigid(atoms)
    assert held is not None and held.get_removed_dof(atoms) == 6 and rigid(liquid()) is None
    bonds = np.stack([held.first, held.second], axis=2)
    assert bonds[:, 1].tolist() == [[3, 4], [3, 5], [4, 5]]
    rng = np.random.default_rng(0)
    momenta, moved = rng.standard_normal((6, 3)), atoms.positions + 0.02 * rng.standard_normal((6, 3))
    ours, theirs = atoms.copy(), atoms.copy()
    for one, constraint in ((ours, held), (theirs, FixBondLengths(bonds.reshape(-1, 2), tolerance=1e-13))):
        one.set_constraint(constraint)
        one.set_momenta(momenta)
        one.set_positions(moved)
    np.testing.assert_allclose(ours.positions, theirs.positions, rtol=0, atol=1e-11)
    np.testing.assert_allclose(ours.get_momenta(), theirs.get_momenta(), rtol=0, atol=1e-9)
