"""What an object remembers is found; what every object does is not blamed on memory."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.calculators.tip3p import TIP3P
from ase.calculators.tip4p import TIP4P
from audit import planted
from audit.planted import Good, but, chain, codes, crystal, subject, values

from mdnum.audit.checks.forces import ForcesCheck
from mdnum.audit.checks.invariance import InvarianceCheck
from mdnum.audit.checks.state import Alone, StateCheck, all_sequences
from mdnum.audit.noise import NoiseFloor
from mdnum.audit.structures import default_structure, water
from mdnum.audit.subject import CalculatorError, LoadedCalculator

ROWS = "One object, asked again and again, beside new ones"


def state(make, atoms: Atoms | None = None, order: int | None = 4):
    return StateCheck()(subject(make, atoms, order))


@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [Good, planted.HalfSkin])
def test_what_is_right_passes(make, atoms: Atoms):
    result = state(make, atoms)
    assert not result.findings and result.says[0] == ["state_none", "state_repeated"]
    assert result.numbers["bit_identical"] and result.numbers["structures"] > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [EMT, lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)], ids=["emt", "lj"]
)
def test_ases_own_pass(make):
    atoms = bulk("Cu", cubic=True) if make is EMT else bulk("Ar", "fcc", a=5.26, cubic=True)
    assert not state(make, atoms).findings


@pytest.mark.parametrize(
    ("make", "where", "what"),
    [
        (planted.OldPairs, "", ""),
        # one atom alone may use up the whole skin; the sequence that finds it is the one meant for it
        (planted.FullSkin, "beyond the cutoff", ""),
        (planted.OldTail, "", "fewer neighbors"),
    ],
)
def test_memory_is_found(make, where: str, what: str):
    check = StateCheck()
    result = check(subject(make))
    assert codes(result).get("STALE_STATE") == "error"
    assert {"stale-before", "stale-after"} <= set(check.structures)
    wrong = [row for row in result.tables[ROWS] if not row["same"]]
    assert any(where in row["sequence"] and what in row["what happened"] for row in wrong)


@pytest.mark.parametrize("skin", [0.1, 0.3, 0.47, 1.3, 2.0])
def test_no_skin_slips_through(skin: float):
    """Whatever the skin is, one of the approaches is between it and twice as much."""
    assert codes(state(but(planted.FullSkin, skin=skin), chain())).get("STALE_STATE") == "error"


def test_another_order_of_sums_is_not_bit_identical_and_no_memory():
    assert codes(state(planted.Restless)) == {"NOT_BIT_IDENTICAL": "warning"}


@pytest.mark.parametrize("seed", range(3))
def test_one_call_in_fifty_is_chance_and_no_memory(seed: int):
    found = codes(state(but(planted.Drops, share=0.02, rng=np.random.default_rng(seed))))
    assert found["NOT_REPEATABLE"] == "error" and "STALE_STATE" not in found


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (planted.MeanNeighbor, "LONELY_NOT_FINITE"),
        (planted.EmptyList, "LONELY_FAILS"),
        (planted.Background, "LONELY_ENERGY"),
        (planted.Whirl, "LONELY_FORCE"),
    ],
)
def test_atoms_alone(make, code: str):
    assert code in codes(state(make))


@pytest.mark.parametrize("make", [TIP3P, TIP4P])
def test_who_knows_whole_molecules_alone_is_asked_about_molecules_alone(make):
    found = Alone(subject(make), water(4), NoiseFloor(1e-13, 1e-13))
    assert not list(found.findings()) and not found.takes_atoms
    assert [row["atoms"] for row in found.rows] == ["one H2O", "two H2O 60 Å apart"]


def test_failing_on_an_atom_without_neighbors_is_found_where_the_cluster_has_one_too():
    """A bond order divides by the number of neighbors; the structure with a vacancy is answered."""

    class Bonds(Good):
        def answer(self, atoms):
            i, _, _ = self.pairs(self.positions(atoms), self.shifts(atoms), atoms)
            if (np.bincount(i, minlength=len(atoms)) == 0).any():
                raise ZeroDivisionError("0.0 cannot be raised to a negative power")
            return super().answer(atoms)

    # the first twelve of them have holes between them
    atoms = crystal().repeat(2)[np.random.default_rng(1).permutation(64)]
    assert isinstance(atoms, Atoms)
    found = Alone(subject(Bonds), atoms, NoiseFloor(1e-13, 1e-13))
    assert "cluster" in found.refused[-1][0] and codes(found.findings()) == {"LONELY_FAILS": "warning"}


def test_writing_to_the_atoms_that_were_given_is_found():
    result = state(planted.WrapsGiven)
    assert codes(result)["CHANGED_INPUT"] == "error"
    assert values(result, "CHANGED_INPUT")["changed"] == "positions"
    assert codes(state(planted.WrapsGiven, chain())) == {}


def test_an_object_that_fails_where_a_new_one_answers():
    class Once(Good):
        seen = 0

        def answer(self, atoms):
            self.seen = max(self.seen, len(atoms))
            if len(atoms) < self.seen - 3:
                raise IndexError("index 12 is out of bounds")
            return super().answer(atoms)

    assert values(state(Once), "STALE_STATE")["variants"] == ["refused"]


class Breaks(Good):
    """Takes no structure without periods, and nothing any more after it was asked about one."""

    broken = False

    def answer(self, atoms):
        self.broken = self.broken or not atoms.pbc.any()
        if self.broken:
            raise RuntimeError("Lost atoms")
        return super().answer(atoms)


def test_an_object_that_remains_broken_is_no_memory():
    found = codes(state(Breaks, order=None))
    assert found["BROKEN_BY_FAILURE"] == "info" and "STALE_STATE" not in found
    # the other checks continue with a new object
    asked = subject(Breaks)
    with pytest.raises(CalculatorError, match="Lost atoms"):
        asked.energy(chain())
    assert np.isfinite(asked.energy(crystal()))


def test_what_nobody_answers_is_no_memory():
    result = state(planted.OnlyRectangles)
    assert "STALE_STATE" not in codes(result) and any("sheared" in what for what, _ in result.skipped)


def test_sequences_do_what_they_say():
    rng = np.random.default_rng(0)
    found = all_sequences(crystal(), rng)
    sizes = [len(asked.atoms) for asked in found["sizes"]]
    assert max(sizes) > len(crystal()) > min(sizes) and 2 in sizes
    moved = [asked.atoms.positions for asked in found["a slow drift"]]
    np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0), axis=2), 0.04, rtol=1e-9)
    boxes = [asked.atoms for asked in found["wrapping"]]
    assert np.ptp(boxes[1].get_scaled_positions(wrap=False)) > 1


@pytest.mark.parametrize(
    "make",
    [planted.Keeps, planted.KeepsClose, planted.KeepsCell, planted.KeepsByRounding, planted.KeepsByAse],
)
def test_an_answer_that_is_kept_within_a_tolerance_is_found(make):
    assert codes(state(make)) == {"KEPT_ANSWER": "error"}


@pytest.mark.parametrize(("power", "severity"), [(-8, "warning"), (-4, "error")])
def test_the_tolerance_is_measured(power: int, severity: str):
    result = state(but(planted.Keeps, tolerance=3 * 10.0**power))
    assert result.numbers["kept_within"] == pytest.approx(10.0**power)
    assert codes(result)["KEPT_ANSWER"] == severity


def test_positions_in_single_precision_are_no_kept_answer():
    """Far from the origin a coordinate of single precision has steps of 4e-6 Å."""

    def positions(self, atoms):
        return Good.positions(self, atoms).astype(np.float32).astype(float)

    atoms = Atoms("Ar8", crystal().positions + 50.0)
    assert "KEPT_ANSWER" not in codes(state(but(planted.Single, positions=positions), atoms))


@pytest.mark.parametrize("make", [planted.Attached, planted.ThroughAtoms])
def test_who_answers_through_atoms_alone_is_asked_through_atoms(make):
    assert set(default_structure(LoadedCalculator("x", "x", make)).symbols) == {"Ar"}
    for check in (InvarianceCheck(), ForcesCheck(), StateCheck()):
        result = check(subject(make))
        assert not result.findings and not result.skipped
