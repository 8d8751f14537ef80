"""NeighborFlips on files nobody here made, against brute force; the same bits on any number of processes."""

from __future__ import annotations

import itertools
import warnings

import MDAnalysis
import numpy as np
import pytest
from MDAnalysis.transformations import set_dimensions, wrap
from MDAnalysisTests import datafiles
from trajectories.files import universe_of

from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.frame import FrameError
from mdnum.trajectories.rules import Capped, CutoffRule, Nearest

warnings.filterwarnings("ignore", module="MDAnalysis")


@pytest.fixture
def water():
    """AdK in water: xtc, rhombic dodecahedron."""
    return universe_of(datafiles.GRO, datafiles.XTC)


def images(matrix):
    """Lattice vectors up to two boxes away: of boxes as skewed as these no more can matter."""
    return np.array(list(itertools.product(range(-2, 3), repeat=3))) @ matrix


def brute(universe, first, second, radius, frames, matrix_of):
    """Rows (frame, i, j, rank, entered, distance) by trying every pair and every image."""
    rows, before = [], None
    for count, number in enumerate(frames):
        ts = universe.trajectory[number]
        x, matrix, now = ts.positions.astype(np.float64), matrix_of(ts), {}
        shifts = np.zeros((1, 3)) if matrix is None else images(matrix)
        for i in first:
            d = x[second][:, None] - x[i] + shifts
            ordered = np.sort(np.sqrt((d**2).sum(axis=-1)), axis=1)
            for j, r in zip(second.tolist(), ordered, strict=True):
                if i != j:
                    now[min(i, j), max(i, j)] = r
        if before is not None:
            for i, j in sorted(now):
                was, many = ((one[i, j] < radius).sum() for one in (before, now))
                for rank in range(min(was, many), max(was, many)):
                    rows.append((count, i, j, rank, many > was, now[i, j][rank]))
        before = now
    return rows, [pair for pair in sorted(before) for _ in range((before[pair] < radius).sum())]


def same_rows(flips, rows):
    found = list(zip(flips.frame, flips.i, flips.j, flips.rank, flips.entered, strict=True))
    assert found == [row[:5] for row in rows]
    np.testing.assert_allclose(flips.distance, [row[5] for row in rows], rtol=1e-12, atol=1e-12)


def triclinic(ts):
    from MDAnalysis.lib.mdamath import triclinic_vectors

    return None if ts.dimensions is None else triclinic_vectors(ts.dimensions, dtype=np.float64)


CASES = {
    "xtc": (datafiles.GRO, datafiles.XTC, "name OW", 60, 5.0),
    "trr": (datafiles.GRO, datafiles.TRR, "name OW", 50, 8.0),
    "netcdf": (datafiles.PRMncdf, datafiles.NCDF, "name O", 80, 6.5),
    "dcd without a box": (datafiles.PSF, datafiles.DCD, "name CA", 100, 7.0),
}


@pytest.mark.parametrize("kind", CASES)
def test_every_flip_is_one_and_every_one_is_a_flip(kind):
    topology, path, words, most, radius = CASES[kind]
    universe = universe_of(topology, path)
    group = universe.select_atoms(words)[:most]
    frames = range(0, min(len(universe.trajectory), 15), 3)
    found = NeighborFlips(group, r_cut=radius).run(stop=15, step=3)
    rows, last = brute(universe, group.indices, group.indices, radius, frames, triclinic)
    assert len(rows) > 10
    same_rows(found.results.flips, rows)
    np.testing.assert_array_equal(found.frames, list(frames))
    assert list(zip(found.results.last.i, found.results.last.j, strict=True)) == last
    steps = found.results.rules[0].entered() - found.results.rules[0].left()
    np.testing.assert_array_equal(np.diff(found.results.pairs), steps[1:])
    assert len(found.results.initial) == found.results.pairs[0]
    np.testing.assert_array_equal(found.times, [universe.trajectory[k].time for k in frames])


def test_a_charmm_box_is_not_turned_away_from_its_atoms():
    universe = MDAnalysis.Universe(datafiles.PSF_TRICLINIC, datafiles.DCD_TRICLINIC)
    group = universe.select_atoms("name OH2")
    from MDAnalysis.lib.formats.libdcd import DCDFile

    with DCDFile(datafiles.DCD_TRICLINIC) as file:
        cells = [frame.unitcell.copy() for frame in file]

    def symmetric(ts):
        xx, xy, yy, xz, yz, zz = cells[ts.frame]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    # far enough for pairs across the boundary, some of them by two ways
    found = NeighborFlips(group, r_cut=12.0).run(stop=3)
    rows, _ = brute(universe, group.indices, group.indices, 12.0, range(3), symmetric)
    same_rows(found.results.flips, rows)
    other, _ = brute(universe, group.indices, group.indices, 12.0, range(3), triclinic)
    assert [row[:5] for row in rows] != [row[:5] for row in other]


def test_two_groups_may_overlap(water):
    first, second = water.atoms[:300], water.select_atoms("name CA")[:40]
    found = NeighborFlips(first, 4.5, other=second).run(frames=[0, 4, 5, 9])
    rows, _ = brute(water, first.indices, second.indices, 4.5, [0, 4, 5, 9], triclinic)
    assert len(np.intersect1d(first.indices, second.indices)) > 5 and len(rows) > 10
    same_rows(found.results.flips, rows)
    np.testing.assert_array_equal(found.frames, [0, 4, 5, 9])


def test_several_rules_at_once_are_each_what_they_are_alone(water):
    group = water.select_atoms("name OW")[:400]
    rules = [Nearest(4), Capped(6.0, 3)]
    found = NeighborFlips(group, [5.0, {("O", "O"): 4.0}], rule=rules).run(stop=4)
    assert [one.rule.name for one in found.results.rules][2:] == [rule.name for rule in rules]
    alone = NeighborFlips(group, rule=Nearest(4)).run(stop=4)
    equal(found.results.rules[2], alone.results.rules[0])
    assert (found.results.rules[2].pairs == 4 * 400).all()
    by_species = NeighborFlips(group, 4.0).run(stop=4)
    equal(found.results.rules[1], by_species.results.rules[0])
    assert "flips" not in found.results and alone.results.flips is alone.results.rules[0].flips


def equal(one, other):
    """To the last bit."""
    for name in ("flips", "initial", "last"):
        for column, values in vars(getattr(one, name)).items():
            np.testing.assert_array_equal(values, getattr(getattr(other, name), column), err_msg=column)
    for name in ("pairs", "near", "min_margin"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("parts", [3, 10])
def test_a_split_between_two_frames_loses_nothing(water, parts):
    group = water.select_atoms("name OW")[:600]
    whole = NeighborFlips(group, [4.0], rule=Nearest(3)).run()
    split = NeighborFlips(group, [4.0], rule=Nearest(3)).run(n_parts=parts)
    for one, other in zip(whole.results.rules, split.results.rules, strict=True):
        assert len(one.flips) > 100
        equal(one, other)
    np.testing.assert_array_equal(whole.results.bound, split.results.bound)
    np.testing.assert_array_equal(whole.times, split.times)


@pytest.mark.parametrize("backend", ["multiprocessing", pytest.param("dask", marks=pytest.mark.slow)])
def test_other_processes_find_the_same_to_the_last_bit(water, backend):
    group = water.select_atoms("name OW")[:1000]
    assert backend in NeighborFlips.get_supported_backends()
    asked = {"start": 1, "stop": 10, "step": 2}
    serial = NeighborFlips(group, 3.5).run(**asked)
    spread = NeighborFlips(group, 3.5).run(backend=backend, n_workers=2, **asked)
    equal(serial.results.rules[0], spread.results.rules[0])
    np.testing.assert_array_equal(serial.frames, spread.frames)
    assert serial.frames.tolist() == [1, 3, 5, 7, 9]


def test_what_the_file_cannot_tell_is_marked(water):
    group = water.select_atoms("name OW")[:2000]
    found = NeighborFlips(group, 3.5).run()
    results = found.results
    assert (results.resolution.kind, results.resolution.step) == ("grid", pytest.approx(0.01))
    assert results.bound == pytest.approx(np.sqrt(3) * 0.01, rel=0.01)
    flips = results.flips
    near = (np.abs(flips.margin) <= flips.bound) | (np.abs(flips.margin_before) <= flips.bound)
    np.testing.assert_array_equal(flips.ambiguous, near)
    assert 0 < results.rules[0].ambiguous < 0.1
    wide = NeighborFlips(group, 3.5, bound=0.5).run(stop=3)
    assert (wide.results.bound == 0.5).all() and wide.results.rules[0].ambiguous > 0.3


def test_no_frame_and_one_frame(water):
    group = water.select_atoms("name OW")[:100]
    none = NeighborFlips(group, 5.0).run(stop=0)
    assert len(none.results.flips) == len(none.results.pairs) == len(none.frames) == 0
    assert len(none.results.initial) == 0 and np.isnan(none.results.rules[0].ambiguous)
    one = NeighborFlips(group, 5.0).run(frames=[7])
    assert len(one.results.flips) == 0 and one.results.pairs.tolist() == [len(one.results.last)]
    assert one.frames.tolist() == [7]


def moving(frames=6, atoms=20, box=30.0):
    """A Universe in memory whose frames may be spoiled."""
    random = np.random.default_rng(0)
    x = random.uniform(0, box, (atoms, 3)) + np.cumsum(random.normal(size=(frames, atoms, 3)), axis=0)
    universe = MDAnalysis.Universe.empty(atoms, trajectory=True)
    boxes = np.array([[box, box, box, 90, 90, 90]] * frames)
    universe.load_new(x.astype(np.float32), order="fac", dimensions=boxes)
    return universe


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_spoiled_frame_is_named_and_what_was_before_is_kept(parts, value):
    universe = moving()
    universe.trajectory.get_array()[2, 3:9] = value
    analysis = NeighborFlips(universe, 8.0)
    with pytest.raises(FrameError, match=r"frame 2: atom 3") as caught:
        analysis.run(n_parts=parts)
    assert caught.value.frame == 2 and "5 others" in str(caught.value)
    good = NeighborFlips(moving(), 8.0).run(stop=2)
    assert len(good.results.flips)
    equal(analysis.results.rules[0], good.results.rules[0])
    assert analysis.frames.tolist() == [0, 1] == good.frames.tolist()
    # an atom that is not looked at spoils nothing
    NeighborFlips(universe.atoms[10:], 8.0).run()


def test_an_atom_that_is_far_away_and_not_looked_at_widens_no_bound():
    far, near = moving(), moving()
    far.trajectory.get_array()[:, 3] += 1e6
    bounds = [NeighborFlips(one.atoms[10:], 8.0).run().results.bound for one in (far, near)]
    np.testing.assert_array_equal(*bounds)
    assert (bounds[0] < 1e-4).all()


def zeros(trajectory):
    trajectory.get_array()[3] = 0.0


def no_box(trajectory):
    trajectory.dimensions_array[3] = 0


def odd_box(trajectory):
    trajectory.dimensions_array[3, 3:] = [10, 10, 150]


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (zeros, "frame 3: all coordinates are 0"),
        (no_box, "frame 3 has no box, and the first one looked at has a box"),
        (odd_box, "frame 3"),
    ],
)
def test_a_frame_that_is_none_is_named(spoil, said, parts):
    universe = moving()
    spoil(universe.trajectory)
    with pytest.raises(FrameError, match=said):
        NeighborFlips(universe, 8.0).run(n_parts=parts)


def test_groups_that_cannot_be_looked_at(water):
    nobody = water.select_atoms("name NOBODY")
    changing = water.select_atoms("around 3 protein", updating=True)
    for group, other, said in (
        (nobody, None, "atoms is empty"),
        (water.atoms[:3], nobody, "other is empty"),
        (changing, None, "changes from frame to frame"),
        (water.atoms[:3], moving().atoms, "two universes"),
        (water.trajectory, None, "Universe or an AtomGroup"),
    ):
        with pytest.raises(InputError, match=said):
            NeighborFlips(group, 5.0, other=other)
    with pytest.raises(InputError, match="no cutoff"):
        NeighborFlips(water)
    with pytest.raises(InputError, match="'Xx'"):
        NeighborFlips(water.atoms[:9], {("Xx", "O"): 2.0}).run(stop=1)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"r_cut": "x"}, "r_cut = 'x'; expected a length"),
        ({"r_cut": "8.5"}, "r_cut = '8.5'; expected a length"),
        ({"r_cut": [4.0, None]}, "r_cut = None; expected a length"),
        ({"r_cut": {("C", "N"): "x"}}, "expected a length in Å, or lengths by pair"),
        ({"r_cut": -1.0}, "a radius of -1.0"),
        ({"r_cut": {("C", "Xx"): 2.5}}, "'Xx'"),
        ({"r_cut": 4.0, "bound": -1}, "bound = -1; expected"),
        ({"r_cut": 4.0, "bound": np.nan}, "bound = nan; expected"),
    ],
)
def test_what_cannot_be_asked_is_refused_before_anything_is_read(water, asked, said):
    with pytest.raises(InputError, match=said):
        NeighborFlips(water.atoms[:40], **asked)


def test_a_number_may_come_as_an_array(water):
    group = water.atoms[:40]
    for value in (np.array(3.0), np.float32(3.0), np.array([3.0]), 3):
        assert NeighborFlips(group, value).rules == [CutoffRule(3.0)]


def test_frames_that_go_backward_are_refused():
    for asked in ({"frames": [5, 3]}, {"frames": [1, 3, 3]}, {"step": -1}):
        with pytest.raises(InputError, match="go backward or stand still"):
            NeighborFlips(moving(), 4.0).run(**asked)
    NeighborFlips(moving(), 4.0).run(frames=[1, 3])
    assert len(NeighborFlips(moving(), 4.0).run(frames=np.arange(6) > 2).frames) == 3


def stretched(ts):
    ts.positions = ts.positions * (1 + 0.05 * ts.frame)
    return ts


@pytest.mark.parametrize("backend", ["multiprocessing", pytest.param("dask", marks=pytest.mark.slow)])
def test_transformations_are_made_in_other_processes_too(backend):
    def universe():
        made = MDAnalysis.Universe(datafiles.PSF, datafiles.DCD)
        # narrower than the molecule: images meet one another
        made.trajectory.add_transformations(set_dimensions([28, 30, 32, 90, 90, 90]), wrap(made.atoms))
        return made.select_atoms("name CA")

    serial = NeighborFlips(universe(), 6.0).run(stop=4)
    spread = NeighborFlips(universe(), 6.0).run(stop=4, backend=backend, n_workers=2)
    equal(serial.results.rules[0], spread.results.rules[0])
    plain = MDAnalysis.Universe(datafiles.PSF, datafiles.DCD).select_atoms("name CA")
    assert (serial.results.pairs > NeighborFlips(plain, 6.0).run(stop=4).results.pairs).all()


def test_a_transformation_that_no_other_process_can_have_is_refused():
    universe = MDAnalysis.Universe(datafiles.PSF, datafiles.DCD)
    universe.trajectory.add_transformations(stretched)
    analysis = NeighborFlips(universe.select_atoms("name CA"), 8.0)
    with pytest.raises(InputError, match=r"the transformation 'stretched' .* backend='multiprocessing'"):
        analysis.run(stop=4, backend="multiprocessing", n_workers=2)
    pairs = analysis.run(stop=4).results.pairs
    assert (np.diff(pairs) < 0).all()


def test_several_files_as_one_and_frames_in_memory():
    chained = MDAnalysis.Universe(datafiles.PSF, [datafiles.DCD, datafiles.DCD2])
    group = chained.select_atoms("name CA")[:60]
    first = len(MDAnalysis.Universe(datafiles.PSF, datafiles.DCD).trajectory)
    asked = {"start": first - 4, "stop": first + 4}
    whole = NeighborFlips(group, 9.0).run(**asked)
    equal(whole.results.rules[0], NeighborFlips(group, 9.0).run(n_parts=3, **asked).results.rules[0])
    # the flips between two files are of the last frame of one and the first of the other
    rows, _ = brute(chained, group.indices, group.indices, 9.0, range(*asked.values()), triclinic)
    assert any(row[0] == 4 for row in rows)
    same_rows(whole.results.flips, rows)
    chained.transfer_to_memory(**asked)
    equal(whole.results.rules[0], NeighborFlips(chained.atoms[group.indices], 9.0).run().results.rules[0])
