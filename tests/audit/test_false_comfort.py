"""Calculators that once passed: rounded, random, ordered by appearance, of two energies, of long memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from audit import laws, planted
from audit.planted import crystal, subject
from audit.test_invariance import codes
from audit.test_state import at_cutoff

import mdnum
from mdnum.audit.crowd_words import reach, units_of
from mdnum.audit.forces import Forces
from mdnum.audit.invariance import Invariance
from mdnum.audit.load import Loaded
from mdnum.audit.smoothness import Smoothness
from mdnum.audit.state import State
from mdnum.audit.structures import default_structure
from mdnum.audit.thresholds import PairWalk, walk_pairs
from mdnum.audit.verdict import judge


def text(part, code: str) -> str:
    (found,) = [one["text"] for one in part.findings if one["code"] == code]
    return found


@pytest.mark.parametrize(
    ("make", "severity"),
    [
        (planted.HalfPrecision, "error"),
        (planted.HalfInOtherUnits, "error"),
        (planted.BrainFloat, "error"),
        (planted.Decimals, "error"),
        # no force comes from it
        (planted.HalfEnergy, "warning"),
    ],
)
def test_answers_that_go_in_steps_are_found_whatever_they_look_like(make, severity: str):
    assert codes(Forces()(subject(make))) == {"QUANTIZED": severity}


def test_decimals_that_no_force_feels_are_a_warning():
    class Fine(planted.Decimals):
        places = 7

    part = Forces()(subject(Fine))
    assert codes(part) == {"QUANTIZED": "warning"}
    assert "in steps of 1e-07 eV/Å" in text(part, "QUANTIZED")


def test_forces_that_do_not_change_do_not_go_in_steps():
    """Half of the atoms in a field of their own feel a constant force, to the last bit."""

    class Field(planted.Good):
        def extra(self, atoms, energy, forces):
            height = atoms.positions[:2, 2].sum()
            forces = forces.copy()
            forces[:2, 2] -= 0.5
            return energy + 0.5 * float(height), forces

    def pairs(self, positions, shifts, atoms):
        i, j, vectors = planted.Good.pairs(self, positions, shifts, atoms)
        keep = (i > 1) & (j > 1)
        return i[keep], j[keep], vectors[keep]

    Field.pairs = pairs
    asked = subject(Field, Atoms("Ar6", positions=crystal().positions[:6]))
    assert "QUANTIZED" not in codes(Forces()(asked))


def test_an_energy_in_single_precision_is_told_and_one_that_loses_kT_is_warned_of():
    class Offset(planted.Good):
        offset = 100.0

        def extra(self, atoms, energy, forces):
            return float(np.float32(energy - self.offset)), forces

    assert codes(Forces()(subject(Offset))) == {"LOW_PRECISION": "info"}
    # which leaves nothing to test the forces with
    Offset.offset = 1e5
    found = codes(Forces()(subject(Offset)))
    assert set(found.values()) == {"warning"} and not {"FORCES_NOT_GRADIENT", "ENERGY_STEP"} & set(found)


def seeded(kind: type[planted.Good], share: float, seed: int = 7) -> type[Any]:
    return type(kind.__name__, (kind,), {"share": share, "rng": np.random.default_rng(seed)})


def test_a_pair_that_is_left_out_now_and_then_is_the_first_thing_said():
    parts = []
    for check in (Forces(), State(at_cutoff)):
        parts.append(check(subject(seeded(planted.Drops, 0.3))))
    assert codes(parts[0])["NOISE_FLOOR"] == codes(parts[1])["NOT_REPEATABLE"] == "error"
    assert "STALE_STATE" not in codes(parts[1])
    assert "noise hides whether the forces" in parts[0].says
    assert "the same question has another answer each time" in judge("x", parts).headline.partition(";")[0]


@pytest.mark.parametrize("seed", range(3))
def test_one_call_in_fifty_is_chance_and_no_memory(seed: int):
    found = codes(State(at_cutoff)(subject(seeded(planted.Drops, 0.02, seed))))
    assert found["NOT_REPEATABLE"] == "error" and "STALE_STATE" not in found


@pytest.mark.parametrize("kind", [planted.Drops, planted.Hits])
@pytest.mark.parametrize("check", ["forces", "invariance"])
@pytest.mark.parametrize("seed", range(2))
def test_one_call_in_fifty_is_found_by_whatever_asks(kind, check: str, seed: int, tmp_path):
    make = seeded(kind, 0.02, seed)
    asked = mdnum.audit_calculator(make, crystal(), checks=check, out=tmp_path / "out", report=False)
    found = {one["code"]: one["severity"] for one in asked.findings}
    assert found["NOT_REPEATABLE"] == "error"
    assert asked.summary["headline"].endswith("as it is: the same question has another answer each time.")
    if kind is planted.Hits:
        assert make.hits > 1


@pytest.mark.parametrize("make", [planted.Good, planted.HardEdge, planted.Single, planted.OldPairs])
def test_what_is_asked_again_is_little_and_has_one_answer(make):
    asked = subject(make)
    for check in (Invariance(), Forces()):
        check(asked)
    assert not asked.ledger.chance.differ and not asked.ledger.findings(asked.kT)
    assert asked.ledger.chance.times <= (
        0 if make in (planted.Good, planted.Single) else 0.1 * asked.meter.calls
    )


def test_a_direction_that_cannot_tell_is_no_comfort():
    """A rough energy, always the same for the same positions, beside forces that are smooth."""

    class Rough(planted.Good):
        def extra(self, atoms, energy, forces):
            return energy + 1e-3 * np.sin(1e9 * float(atoms.positions[3, 0])), forces

    part = Forces()(subject(Rough))
    # atom 3 is moved along x, and with all others in three ways; chance may let one of them tell
    assert codes(part) == {"NOISE_FLOOR": "warning"}
    assert part.numbers["could_not_tell"] > 1
    assert f"{part.numbers['could_not_tell']} of 15 directions could not tell" in part.says
    assert float(part.says.partition("to within ")[2].split()[0]) < 0.1 * part.numbers["rms_force"]


def test_parameters_by_order_of_appearance_are_no_molecules():
    """An alternating crystal: species repeat in groups of two, and nothing is bonded to anything."""
    atoms = crystal()
    atoms.numbers[:] = [18, 36] * 4
    found = codes(Invariance()(subject(planted.ByAppearance, atoms)))
    assert found["ORDER"] == "error" and "TOPOLOGY_BY_ORDER" not in found
    # nor is a salt, all of whose atoms are bonded to one another
    salt = bulk("NaCl", "rocksalt", a=4.4, cubic=True)
    assert codes(Invariance()(subject(planted.ByAppearance, salt)))["ORDER"] == "error"


def test_a_species_that_comes_second_comes_first_once():
    """Where one atom in many is of another species, orders at random keep the first as it is."""
    atoms = bulk("Ar", "fcc", a=3.9, cubic=True).repeat((2, 2, 1))
    atoms.numbers[7] = 36
    assert codes(Invariance()(subject(planted.ByAppearance, atoms)))["ORDER"] == "error"


def test_a_topology_by_order_that_refuses_no_order_is_warned_of():
    """Bonds between each third atom and the two after it, whatever they are and wherever."""

    class Bonds(planted.Good):
        def answer(self, atoms):
            head = np.repeat(np.arange(0, len(atoms), 3), 2)
            tail = head + np.tile([1, 2], len(atoms) // 3)
            vectors = atoms.positions[tail] - atoms.positions[head]
            if atoms.pbc.any():
                inverse = np.linalg.inv(atoms.cell.array)
                vectors -= np.rint(vectors @ inverse) @ atoms.cell.array
            forces = np.zeros((len(atoms), 3))
            np.add.at(forces, head, vectors)
            np.add.at(forces, tail, -vectors)
            return 0.5 * float(np.sum(vectors**2)), forces

    water = Atoms("OH2", [(0, 0, 0), (0.96, 0, 0), (-0.24, 0.93, 0)], cell=[4.0] * 3, pbc=True)
    found = codes(Invariance()(subject(Bonds, water.repeat(2))))
    assert found["TOPOLOGY_BY_ORDER"] == "warning" and "ORDER" not in found


def dispersion(end: float, charge: float = 0.0):
    """Damped, and cut at a distance; beside charges that never end."""

    def law(r: float) -> tuple[float, float]:
        energy, force = (charge / r, charge / r**2) if charge else (0.0, 0.0)
        if r < end:
            energy, force = energy - 60 / (r**6 + 1e3), force - 360 * r**5 / (r**6 + 1e3) ** 2
        return energy, force

    return law


def walked(law) -> tuple[PairWalk, list[str]]:
    asked = laws.pair_subject(law)
    (walk,) = walk_pairs(asked).walks
    found = reach(walk, units_of(asked), asked.kT)
    return walk, [one["text"] for one in found if one["code"] == "NO_CUTOFF"]


@pytest.mark.parametrize(("end", "charge"), [(20.0, 1.44), (31.75, 0.0), (44.4, 0.0)])
def test_a_cutoff_is_found_where_the_scan_has_long_ended(end: float, charge: float):
    walk, said = walked(dispersion(end, charge))
    (found,) = walk.thresholds
    assert (found.radius, found.order, found.dies) == (end, 0, not charge)
    assert found.jumps[0] == pytest.approx(60 / (end**6 + 1e3), rel=1e-6)
    assert walk.cutoff == (None if charge else end)
    assert bool(said) == bool(charge)


def test_a_sentence_claims_what_was_searched():
    walk, (said,) = walked(laws.endless)
    further = walk.further
    assert further is not None and not walk.thresholds
    # 4 ε (σ/r)⁶ is left at the farthest, for the power of the distance is 6
    left = 4 * laws.EPSILON * (laws.SIGMA / further.reached) ** 6
    assert further.left == pytest.approx(left, rel=1e-2)
    assert left < 1e-7 * laws.KT
    assert f"{further.reached:.4g} Å" in said and "no cutoff" not in said
    # what is lost in rounding has no end there
    walk, (said,) = walked(lambda r: (float(np.exp(-r)) - 1e3, float(np.exp(-r))))
    assert walk.cutoff is None or walk.cutoff < 30
    assert "no cutoff" not in said


def test_two_energies_that_differ_by_a_constant_are_one():
    assert codes(Forces()(subject(planted.TwoEnergies))) == {}


@pytest.mark.parametrize(
    ("make", "severity", "belong"),
    [
        (planted.Entropy, "warning", "the derivative of free_energy"),
        (planted.OrderedEnergy, "error", "the derivative of free_energy"),
        (planted.SwappedEnergies, "warning", "the derivative of energy"),
    ],
)
def test_two_energies_are_both_read(make, severity: str, belong: str):
    part = Forces()(subject(make))
    assert codes(part)["TWO_ENERGIES"] == severity
    assert belong in text(part, "TWO_ENERGIES")
    assert ("FORCES_NOT_GRADIENT" in codes(part)) == (make is planted.SwappedEnergies)


def test_an_energy_that_alone_is_cut_is_seen():
    asked = subject(planted.CutEnergy)
    assert not codes(Smoothness(neighbors=8, routes=1)(asked))
    part = Forces()(asked)
    assert codes(part) == {"TWO_ENERGIES": "error"}
    assert "between Ar-Ar at 3.4 Å, by 0.01 eV" in text(part, "TWO_ENERGIES")


@pytest.mark.parametrize(
    "make",
    [planted.Keeps, planted.KeepsClose, planted.KeepsCell, planted.KeepsByRounding, planted.KeepsByAse],
)
def test_an_answer_that_is_kept_within_a_tolerance_is_found(make):
    found = codes(State(at_cutoff)(subject(make)))
    assert found == {"KEPT_ANSWER": "error"}


def test_the_tolerance_is_told():
    for power in (-8, -4):
        make = type("Keeps", (planted.Keeps,), {"tolerance": 3 * 10.0**power})
        part = State(at_cutoff)(subject(make))
        assert part.numbers["kept_within"] == pytest.approx(10.0**power)
        assert codes(part)["KEPT_ANSWER"] == ("warning" if power == -8 else "error")


def test_positions_in_single_precision_are_no_kept_answer():
    """Far from the origin a coordinate of single precision has steps of 4e-6 Å."""

    class Single(planted.Single):
        def positions(self, atoms):
            return super().positions(atoms).astype(np.float32).astype(float)

    atoms = Atoms("Ar8", crystal().positions + 50.0)
    assert "KEPT_ANSWER" not in codes(State(at_cutoff)(subject(Single, atoms)))


@pytest.mark.parametrize("make", [planted.Attached, planted.ThroughAtoms])
def test_who_answers_through_atoms_alone_is_asked_through_atoms(make):
    atoms = default_structure(Loaded("x", "x", make))
    assert set(atoms.symbols) == {"Ar"}
    for check in (Invariance(), Forces(), State(at_cutoff)):
        part = check(subject(make))
        assert not part.findings and not part.skipped
