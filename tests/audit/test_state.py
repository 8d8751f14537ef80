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
from audit.planted import chain, crystal, subject
from audit.test_invariance import codes

from mdnum.audit import state
from mdnum.audit.alone import alone
from mdnum.audit.noise import Noise
from mdnum.audit.state import State
from mdnum.audit.structures import water
from mdnum.audit.subject import CalculatorError, CalculatorSubject
from mdnum.audit.threshold import Threshold
from mdnum.audit.written import written


def at_cutoff(_) -> list[Threshold]:
    """The cutoff of the planted calculators, as a walk finds it."""
    r = planted.R_CUT
    return [Threshold(r, ("Ar", "Ar"), 4, (0, 0, 0), (0, 0, 0), r, r, True, 1e-9)]


@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [planted.Good, planted.HalfSkin])
def test_what_is_right_passes(make, atoms: Atoms):
    part = State(at_cutoff)(subject(make, atoms))
    assert not part.findings
    assert part.numbers["bit_identical"] and part.numbers["structures"] > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [EMT, lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)], ids=["emt", "lj"]
)
def test_ases_own_pass(make):
    atoms = bulk("Cu", cubic=True) if make is EMT else bulk("Ar", "fcc", a=5.26, cubic=True)
    assert not State(at_cutoff)(subject(make, atoms)).findings


@pytest.mark.parametrize("make", [planted.OldPairs, planted.FullSkin, planted.OldTail])
def test_memory_is_found(make):
    check = State(at_cutoff)
    assert codes(check(subject(make))).get("STALE_STATE") == "error"
    assert {"stale-before", "stale-after"} <= set(check.structures)


def test_half_the_skin_is_seen_by_two_atoms_head_on():
    """One atom alone may use up the whole skin; the sequence that finds it is the one meant for it."""
    part = State(at_cutoff)(subject(planted.FullSkin))
    rows = part.tables["One object, asked again and again, beside new ones"]
    wrong = {row["sequence"] for row in rows if not row["same"]}
    assert any("beyond the cutoff" in sequence for sequence in wrong)


@pytest.mark.parametrize("skin", [0.1, 0.17, 0.3, 0.47, 0.8, 1.3, 2.0])
def test_no_skin_slips_through(skin: float):
    """Whatever the skin is, one of the approaches is between it and twice as much."""

    class Skin(planted.FullSkin):
        pass

    Skin.skin = skin
    assert codes(State(at_cutoff)(subject(Skin, chain()))).get("STALE_STATE") == "error"


def test_a_buffer_that_shrinks_is_seen_when_neighbors_go():
    part = State(at_cutoff)(subject(planted.OldTail))
    rows = part.tables["One object, asked again and again, beside new ones"]
    assert any("fewer neighbors" in row["what happened"] for row in rows if not row["same"])


def test_another_order_of_sums_is_not_repeatable_and_no_memory():
    part = State(at_cutoff)(subject(planted.Restless))
    assert codes(part) == {"NOT_REPEATABLE": "warning"}


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
    assert code in codes(State(at_cutoff)(subject(make)))


@pytest.mark.parametrize("make", [TIP3P, TIP4P])
def test_who_knows_whole_molecules_alone_is_asked_about_molecules_alone(make):
    asked = CalculatorSubject("water", make, water(4))
    found = alone(asked, asked.atoms, Noise(1e-13, 1e-13))
    assert not list(found.findings()) and not found.takes_atoms
    assert [row["atoms"] for row in found.rows] == ["one H2O", "two H2O 60 Å apart"]


def test_writing_to_the_atoms_that_were_given_is_found():
    asked = subject(planted.WrapsGiven)
    (found,) = written(asked, crystal())
    assert found["code"] == "CHANGED_INPUT" and "other positions were in" in found["text"]
    assert not list(written(subject(planted.Good), crystal()))


def test_the_check_of_memory_asks_what_is_written():
    assert codes(State(at_cutoff)(subject(planted.WrapsGiven, chain()))) == {}
    assert codes(State(at_cutoff)(subject(planted.WrapsGiven)))["CHANGED_INPUT"] == "error"


def test_an_object_that_fails_where_a_new_one_answers():
    class Once(planted.Good):
        seen = 0

        def answer(self, atoms):
            self.seen = max(self.seen, len(atoms))
            if len(atoms) < self.seen - 3:
                raise IndexError("index 12 is out of bounds")
            return super().answer(atoms)

    found = [one for one in State(at_cutoff)(subject(Once)).findings if one["code"] == "STALE_STATE"]
    assert "while a new one answers" in found[0]["text"]


class Breaks(planted.Good):
    """Takes no structure without periods, and nothing any more after it was asked about one."""

    broken = False

    def answer(self, atoms):
        self.broken = self.broken or not atoms.pbc.any()
        if self.broken:
            raise RuntimeError("Lost atoms")
        return super().answer(atoms)


def test_an_object_that_stays_broken_is_no_memory():
    found = codes(State()(subject(Breaks)))
    assert found["BROKEN_BY_FAILURE"] == "info" and "STALE_STATE" not in found


def test_the_other_checks_go_on_with_a_new_object():
    asked = subject(Breaks)
    with pytest.raises(CalculatorError, match="Lost atoms"):
        asked.energy(chain())
    assert np.isfinite(asked.energy(crystal()))


def test_what_nobody_answers_is_no_memory():
    part = State(at_cutoff)(subject(planted.OnlyRectangles))
    assert "STALE_STATE" not in codes(part)
    assert any("sheared" in what for what, _ in part.skipped)


def test_sequences_go_through_what_they_say():
    rng = np.random.default_rng(0)
    sizes = [len(asked.atoms) for asked in state.sizes(crystal(), rng)]
    assert max(sizes) > len(crystal()) > min(sizes) and 2 in sizes
    moved = [asked.atoms.positions for asked in state.drift(crystal(), rng)]
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=2)
    np.testing.assert_allclose(steps, 0.04, rtol=1e-9)
    boxes = [asked.atoms for asked in state.wrapping(crystal(), rng)]
    assert np.ptp(boxes[1].get_scaled_positions(wrap=False)) > 1


def test_failing_on_an_atom_without_neighbors_is_found_where_the_cluster_has_one_too():
    """A bond order divides by the number of neighbors; the structure with a vacancy is answered."""

    class Bonds(planted.Good):
        def answer(self, atoms):
            i, _, _ = self.pairs(self.positions(atoms), self.shifts(atoms), atoms)
            if (np.bincount(i, minlength=len(atoms)) == 0).any():
                raise ZeroDivisionError("0.0 cannot be raised to a negative power")
            return super().answer(atoms)

    # the first twelve of them have holes between them
    atoms = crystal().repeat(2)[np.random.default_rng(1).permutation(64)]
    assert isinstance(atoms, Atoms)
    found = alone(subject(Bonds), atoms, Noise(1e-13, 1e-13))
    assert isinstance(found.refused[-1], tuple) and "cluster" in found.refused[-1][0]
    assert [one["code"] for one in found.findings()] == ["LONELY_FAILS"]
