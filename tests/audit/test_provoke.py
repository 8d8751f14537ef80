"""Caps on neighbors are provoked: how many are kept is found, whatever chooses them, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest
from audit import laws
from audit.laws import R_CUT, Capped, Pairwise, subject

from mdnum.audit.probes import Pair
from mdnum.audit.provoke import _gap, cluster, crowd

NEIGHBORS = 24
PAIR = Pair(("Ar", "Ar"), laws.Atoms("Ar"), laws.Atoms("Ar"), 0.0, False, "Ar-Ar")


def crowded(make):
    (found,) = crowd(subject(make), most=NEIGHBORS)
    return found


def test_nothing_is_dropped_by_what_drops_nothing():
    for single in (False, True):
        found = crowded(lambda single=single: Pairwise(laws.soft, single=single))
        assert (found.kept, found.order_from) == (None, None)
        assert found.neighbors == NEIGHBORS


@pytest.mark.parametrize("most", [5, 16])
def test_a_choice_of_the_nearest_is_found(most: int):
    found = crowded(lambda: Capped(most, "nearest"))
    assert found.kept == most
    # energies are equal at the tie; half a pair force moves over from one neighbor to the other, and turns
    # its direction on the center
    assert found.energy == 0.0
    half = 0.5 * laws.soft(found.distance)[1]
    atoms, _ = cluster(PAIR, R_CUT, NEIGHBORS)
    turned = np.linalg.norm(_gap(atoms) - atoms.positions[most] / found.distance)
    assert found.force == pytest.approx(half * max(turned, 1.0), rel=1e-6)
    assert found.order_from is None


class Rounded(Capped):
    """Hands over answers of five decimals."""

    def calculate(self, atoms=None, properties=None, system_changes=("positions",)):
        super().calculate(atoms, properties, system_changes)
        self.results = {name: np.round(value, 5) for name, value in self.results.items()}


def test_steps_of_rounding_are_no_choice_of_neighbors():
    found = crowded(lambda: Rounded(10**6, "nearest"))
    assert (found.kept, found.order_from, found.energy) == (None, None, 0.0)


@pytest.mark.slow
def test_a_choice_of_the_nearest_is_found_beyond_rounding():
    assert crowded(lambda: Rounded(5, "nearest")).kept == 5


def test_a_cap_by_the_order_of_the_atoms_is_found():
    found = crowded(lambda: Capped(12, "first"))
    assert found.order_from == 13
    assert found.order_energy > 1e-3


def test_a_crowd_has_no_ties_and_is_inside_the_cutoff():
    atoms, distances = cluster(PAIR, R_CUT, 160)
    from_center = np.linalg.norm(atoms.positions[1:] - atoms.positions[0], axis=1)
    assert np.allclose(from_center, distances)
    assert (np.diff(distances) > 1e-4).all()
    assert distances.max() < R_CUT
    apart = atoms.get_all_distances()
    assert apart[~np.eye(161, dtype=bool)].min() > 0.2 * R_CUT / 160 ** (1 / 3)
