"""Neighbor searches, by the conformance suite and against one another."""

from __future__ import annotations

import functools

import jax
import numpy as np
import oracles
import pytest

from mdnum.errors import CapacityError, InputError
from mdnum.md import device_search, host_search
from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.host_search import neighbor_table
from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList, check_radius
from mdnum.references.conformance import ListLimits, NeighborListConformance


def pairs_of(index, order, atoms):
    """Directed pairs of a table in the user's labels, checked for form on the way."""
    assert index.dtype == np.int32
    assert sorted(order.tolist()) == list(range(atoms))
    listed = []
    for column in range(atoms):
        row = index[:, column]
        real = row[row < atoms]
        # packed at the front, padded with the number of atoms, each neighbor once and never itself
        assert np.all(row[: len(real)] < atoms) and np.all(row[len(real) :] == atoms)
        assert len(set(real.tolist())) == len(real)
        assert column not in real
        listed += [(int(order[column]), int(order[k])) for k in real]
    return listed


def listed(builder, positions, cell, pbc, r_cut):
    """The rows that a builder finds, for positions anywhere."""
    box = Cell.create(cell, pbc)
    wrapped, _ = wrap_positions(box, positions)
    atoms = len(positions)
    index, order, most = BUILDERS[builder].build(wrapped, box, r_cut, 8 * (atoms // 8 + 1))
    rows = pairs_of(index, order, atoms)
    assert most == max(np.bincount([i for i, _ in rows], minlength=atoms), default=0)
    return np.array(rows, int).reshape(-1, 2)


class TestHostSearch(NeighborListConformance):
    """Every pair, from both ends, whatever the box; a hair beyond the radius may be listed."""

    pairs = staticmethod(functools.partial(listed, "host"))
    full, unit, limits, cases = True, 2.0**-40, ListLimits(minimum_image=True, atoms=1), 150


@pytest.mark.parametrize(
    "atoms", [2, 40, *(pytest.param(n, marks=pytest.mark.nightly) for n in (1, 7, 25, 60))]
)
@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
def test_the_search_of_jax_md_finds_the_same(atoms):
    rng = np.random.default_rng(atoms)
    matrix = np.array([[9.0, 0, 0], [2.0, 8.0, 0], [-1.0, 1.5, 10.0]])
    for pbc in ((True, True, True), (True, False, True)):
        positions = rng.uniform(-0.5, 1.5, (atoms, 3)) @ matrix
        positions[-1] = positions[0]
        here, there = (listed(name, positions, matrix, pbc, 3.4) for name in ("host", "jax-md"))
        assert set(map(tuple, here)) == set(map(tuple, there)) and (len(here) or atoms == 1)


BOXES = {
    "box": (np.diag([12.0, 13.0, 14.0]), (True, True, True), 3.0, 600),
    "tilted": (np.array([[12.0, 0, 0], [3.0, 12.0, 0], [-2.0, 4.0, 15.0]]), (True, True, True), 3.0, 600),
    "slab": (np.diag([14.0, 13.0, 9.0]), (True, True, False), 3.1, 400),
    "tilted slab": (np.array([[12.0, 0, 0], [3.0, 12.0, 0], [-2.0, 4, 15]]), (True, True, False), 3.0, 300),
    "cluster": (np.diag([9.0, 8.0, 9.0]), (False, False, False), 2.0, 300),
    "one bin along an axis": (np.diag([7.0, 18.0, 18.0]), (True, True, True), 3.4, 300),
    "one bin": (np.diag([7.0, 7.0, 7.0]), (True, True, True), 3.4, 150),
    "dilute": (np.diag([100.0, 100.0, 100.0]), (True, True, True), 3.4, 50),
}


#: The others are parts of these.
TELLING = ("tilted slab", "cluster", "one bin", "dilute")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name not in TELLING)) for name in BOXES]
)
def test_a_search_on_a_device_makes_the_same_table(name, monkeypatch):
    matrix, pbc, r_list, atoms = BOXES[name]
    rng, cell = np.random.default_rng(atoms), Cell.create(matrix, pbc)
    positions = rng.uniform(-0.5, 1.5, (atoms, 3)) @ matrix
    # two in one place, and one that wrapping puts at the far face
    positions[-1], positions[5] = positions[0], -1e-17
    wrapped, _ = wrap_positions(cell, positions)
    # in several blocks, the last of which is not full
    monkeypatch.setattr(device_search, "_AT_A_TIME", 200_000)
    for slots in (112, 8):
        here, there = (BUILDERS[one].build(wrapped, cell, r_list, slots) for one in ("host", "device"))
        assert isinstance(there[0], jax.Array) and np.array_equal(here[1], there[1]) and here[2] == there[2]
        # what does not fit is left out in its own way
        assert here[2] > slots or np.array_equal(here[0], there[0])
    right = oracles.minimum_image_pairs(wrapped, matrix, cell.pbc, r_list)
    index, order = (np.asarray(part) for part in BUILDERS["device"].build(wrapped, cell, r_list, 112)[:2])
    assert {(i, j) for i, j in pairs_of(index, order, atoms) if i < j} == right


@pytest.mark.parametrize("pbc", [(True, True, True), (False, True, False)])
def test_threads_that_share_a_search_make_the_table_of_one(pbc, monkeypatch):
    rng, cell = np.random.default_rng(3), Cell.create([20.0, 18.0, 22.0], pbc)
    positions = rng.uniform(0, 1, (900, 3)) * [20.0, 18.0, 22.0]
    monkeypatch.setattr(host_search, "_SHARED", 100)
    made = []
    for cores in (1, 2, 3, 7):
        monkeypatch.setattr(host_search, "cores", lambda cores=cores: cores)
        index, order, most = neighbor_table(positions, cell, 4.0, 64)
        # not the memory that the next search is given
        made.append((index.copy(), order, most))
    for index, order, most in made[1:]:
        assert np.array_equal(index, made[0][0]) and np.array_equal(order, made[0][1]) and most == made[0][2]
    assert {pair for pair in pairs_of(*made[0][:2], 900) if pair[0] < pair[1]} == oracles.minimum_image_pairs(
        positions, np.diag([20.0, 18.0, 22.0]), cell.pbc, 4.0
    )


def test_a_thread_that_fails_is_heard_of(monkeypatch):
    fill = host_search._fill

    def failing(*given):
        if given[-1][0]:
            raise MemoryError("no room")
        return fill(*given)

    monkeypatch.setattr(host_search, "_SHARED", 100)
    monkeypatch.setattr(host_search, "cores", lambda: 2)
    monkeypatch.setattr(host_search, "_fill", failing)
    with pytest.raises(MemoryError, match="no room"):
        neighbor_table(np.random.default_rng(1).uniform(0, 20, (400, 3)), Cell.create([20.0] * 3), 3.0, 64)


@pytest.mark.parametrize(
    "bins", [5, 8, 12, *(pytest.param(bins, marks=pytest.mark.nightly) for bins in (6, 7, 10))]
)
def test_a_pair_at_the_radius_is_not_lost_between_bins(bins):
    """Bins of exactly half a radius put some pairs at the radius three bins apart by rounding."""
    rng = np.random.default_rng(bins)
    tried = 0
    for _ in range(1500):
        radius = rng.uniform(1, 3)
        edge = bins * radius / 2 * (1 + int(rng.integers(-3, 4)) * 2.0**-52)
        first = int(rng.integers(0, bins - 2)) * radius / 2 * (1 + int(rng.integers(-3, 4)) * 2.0**-53)
        second = first + radius
        if not (edge >= 2 * radius and second < edge and second - first <= radius):
            continue
        tried += 1
        positions = np.array([[first, 1.0, 1.0], [second, 1.0, 1.0]])
        _, _, most = neighbor_table(positions, Cell.create([edge] * 3), radius, 8)
        assert most == 1, (radius, edge, first, second)
    assert tried > 100


def test_the_order_of_the_table_follows_the_bins():
    rng = np.random.default_rng(8)
    cell = Cell.create([40.0, 40.0, 40.0])
    positions = rng.uniform(0, 40, (2000, 3))
    _, order, _ = neighbor_table(positions, cell, 4.0, 64)
    sorted_x = positions[order][:, 0]
    # slabs of bins along x come one after the other: no atom lies a bin behind one that came before
    assert np.max(np.maximum.accumulate(sorted_x) - sorted_x) < 3.2
    assert np.max(np.maximum.accumulate(positions[:, 0]) - positions[:, 0]) > 30


@pytest.mark.parametrize("room", [8, 16])
def test_a_table_that_is_too_narrow_says_how_wide_it_must_be(room):
    rng = np.random.default_rng(4)
    positions, cell = rng.uniform(0, 9, (80, 3)), Cell.create([9.0] * 3)
    index, _, most = neighbor_table(positions, cell, 4.0, room)
    full, _, again = neighbor_table(positions, cell, 4.0, 80)
    assert most == again > room
    assert index.shape == (room, 80)
    assert np.array_equal(index, full[:room])


def test_a_verlet_list_grows_until_its_pairs_fit():
    rng = np.random.default_rng(4)
    cell = Cell.create([9.0] * 3)
    positions = rng.uniform(0, 9, (80, 3))
    verlet = VerletList(BUILDERS["host"], RebuildRule(0.5), 3.0, slots=8)
    table = verlet.build(positions, cell)
    assert verlet.slots == table.slots > 8 and table.slots % 8 == 0
    assert 8 < table.occupancy <= table.slots
    right = oracles.minimum_image_pairs(positions, np.diag([9.0] * 3), cell.pbc, 3.5)
    rows = table.unsorted()
    assert {(i, int(j)) for i in range(80) for j in rows[i] if j < 80 and i < j} == right
    assert table.pairs == len(right)
    # the next build starts from the room that was needed
    assert verlet.build(positions, cell).slots == table.slots


def test_more_neighbors_than_atoms_are_an_error():
    class Broken:
        name = "broken"

        def build(self, positions, cell, r_list, slots):
            atoms = len(positions)
            return np.full((slots, atoms), atoms, np.int32), np.arange(atoms), 2 * slots

    with pytest.raises(CapacityError, match=r"16 neighbors.* 3 atoms"):
        VerletList(Broken(), RebuildRule(0.5), 1.0, slots=8).build(np.zeros((3, 3)), Cell.create([9.0] * 3))


def test_the_skin_that_is_consumed_counts_motion_and_strain():
    verlet = VerletList(BUILDERS["host"], RebuildRule(0.5), 3.0)
    cell = Cell.create([20.0] * 3)
    reference = np.array([[1.0, 1, 1], [19.9, 5, 5]])
    moved = reference + np.array([[0.1, 0, 0], [0.2, 0, 0]])
    wrapped, _ = wrap_positions(cell, moved)
    assert verlet.consumed(wrapped, cell, reference, cell) == pytest.approx(2 * 0.2 / 0.5)
    # the box alone: nobody moved within it, yet every listed distance shrank
    smaller = Cell.create([19.0] * 3)
    assert verlet.consumed(reference * 0.95, smaller, reference, cell) == pytest.approx(3.5 * 0.05 / 0.5)
    larger = Cell.create([21.0] * 3)
    assert verlet.consumed(reference * 1.05, larger, reference, cell) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("free", [0, 1, 2])
def test_a_strained_box_leaves_positions_along_a_free_axis(free):
    flags, edges = np.arange(3) != free, np.where(np.arange(3) == free, 0.0, 20.0)
    verlet, strained = VerletList(BUILDERS["host"], RebuildRule(0.5), 3.0), np.where(flags, 0.99, 1.0)
    before, after = (Cell.create(edges * by, flags) for by in (np.ones(3), strained))
    reference = np.array([[1.0, 2.0, 3.0], [9.0, 15.0, 17.0]])
    consumed = verlet.consumed(reference * strained, after, reference, before)
    # what the box has really lost, or a bound that needs no decomposition
    assert 3.5 * 0.01 / 0.5 <= consumed <= 4 / 3 * 3.5 * 0.01 / 0.5 * (1 + 1e-12)


@pytest.mark.parametrize(
    "rule, first, safe",
    [
        (RebuildRule(1.0), 1, True),
        (RebuildRule(1.0, every=5), 5, False),
        (RebuildRule(1.0, every=2, delay=7), 7, False),
        (RebuildRule(1.0, check=False), 1, False),
        (RebuildRule(1.0, delay=1), 1, True),
    ],
)
def test_which_rules_are_safe(rule, first, safe):
    assert rule.first_allowed == first
    assert rule.safe == safe


def test_a_radius_beyond_half_the_box_is_refused_with_what_would_fit():
    check_radius(Cell.create([7.0, 9.0, 9.0]), 3.0, 0.5)
    with pytest.raises(InputError, match=r"3\.51 exceeds .* 3\.5.*skin .* 0\.5"):
        check_radius(Cell.create([7.0, 9.0, 9.0]), 3.0, 0.51)
    with pytest.raises(InputError, match="Repeat the box"):
        check_radius(Cell.create([7.0, 9.0, 9.0]), 4.0, 0.1)
    # the width of a skewed box is less than its edges
    with pytest.raises(InputError):
        check_radius(Cell.create([[7.0, 0, 0], [5.0, 5.0, 0], [0, 0, 9.0]]), 3.0, 0.0)
    check_radius(Cell.create([1.0, 9.0, 9.0], (False, True, True)), 3.0, 0.5)


def test_a_table_takes_the_memory_of_one_that_nobody_holds():
    rng, box = np.random.default_rng(0), Cell.create(np.eye(3) * 9.0, True)

    def search():
        return neighbor_table(rng.uniform(0, 9, (300, 3)), box, 2.0, 64)[0]

    one, other = search(), search()
    kept = other.copy()
    assert one.ctypes.data % 64 == other.ctypes.data % 64 == 0
    # as a list does that is cut to its size, or a device that reads it in place
    part, place = one[:32], one.ctypes.data
    on_device = jax.device_put(other)
    del one, other
    third = search()
    assert not np.shares_memory(third, part) and np.array_equal(on_device, kept)
    del part
    assert search().ctypes.data == place
    assert np.array_equal(on_device, kept)
