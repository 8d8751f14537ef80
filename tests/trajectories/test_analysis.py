"""NeighborFlips on files nobody here made, against brute force; the same bits on any number of processes."""

from __future__ import annotations

import itertools
import warnings

import MDAnalysis
import numpy as np
import oracles
import pytest
from MDAnalysis.lib.mdamath import triclinic_vectors
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


def brute(universe, first, second, radius, frames):
    """(rows (frame, i, j, rank, entered, distance) of all flips, pairs inside at the last frame)."""
    atoms, rows, before = np.union1d(first, second), [], None
    for count, number in enumerate(frames):
        ts = universe.trajectory[number]
        free = ts.dimensions is None
        matrix = np.zeros((3, 3)) if free else triclinic_vectors(ts.dimensions, dtype=np.float64)
        i, j, d = oracles.all_pairs(ts.positions[atoms].astype(float), matrix, [not free] * 3)
        # of two far from one another, another image may be nearer than the one that rounding names
        images = np.array(list(itertools.product((-1, 0, 1), repeat=3))) @ matrix
        i, j, r = atoms[i], atoms[j], np.linalg.norm(d[:, None] + images, axis=2).min(axis=1)
        of_both = (np.isin(i, first) & np.isin(j, second)) | (np.isin(j, first) & np.isin(i, second))
        now = of_both & (r < radius)
        flipped = np.flatnonzero(now != (now if before is None else before))
        rows += [(count, i[k], j[k], 0, now[k], r[k]) for k in flipped]
        before = now
    return rows, list(zip(i[before], j[before], strict=True))


def same_rows(flips, rows):
    found = list(zip(flips.frame, flips.i, flips.j, flips.rank, flips.entered, strict=True))
    assert found == [row[:5] for row in rows]
    np.testing.assert_allclose(flips.distance, [row[5] for row in rows], rtol=1e-12, atol=1e-12)


def equal(one, other):
    """To the last bit."""
    for name in ("flips", "initial", "last"):
        assert getattr(one, name).equals(getattr(other, name)), name
    for name in ("pairs", "near", "min_margin"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


WATER = (datafiles.GRO, datafiles.XTC)


@pytest.mark.parametrize(
    ("files", "words", "most", "other", "radius", "frames"),
    [
        (WATER, "name OW", 60, None, 5.0, [0, 3, 6, 9]),
        ((datafiles.GRO, datafiles.TRR), "name OW", 50, None, 8.0, [0, 3, 6, 9]),
        ((datafiles.PRMncdf, datafiles.NCDF), "name O", 80, None, 6.5, [0, 3, 6, 9]),
        # without a box
        ((datafiles.PSF, datafiles.DCD), "name CA", 100, None, 7.0, [0, 3, 6, 9, 12]),
        # two groups that overlap
        (WATER, "index 0:299", 300, "name CA and index 0:700", 4.5, [0, 4, 5, 9]),
    ],
)
def test_every_flip_is_one_and_every_one_is_a_flip(files, words, most, other, radius, frames):
    universe = universe_of(*files)
    group = universe.select_atoms(words)[:most]
    second = group if other is None else universe.select_atoms(other)
    assert other is None or len(np.intersect1d(group.indices, second.indices)) > 5
    found = NeighborFlips(group, radius, other=None if other is None else second).run(frames=frames)
    rows, last = brute(universe, group.indices, second.indices, radius, frames)
    assert len(rows) > 10
    same_rows(found.results.flips, rows)
    assert list(zip(found.results.last.i, found.results.last.j, strict=True)) == last
    steps = found.results.rules[0].entered() - found.results.rules[0].left()
    np.testing.assert_array_equal(np.diff(found.results.pairs), steps[1:])
    assert len(found.results.initial) == found.results.pairs[0]
    np.testing.assert_array_equal(found.frames, frames)
    np.testing.assert_array_equal(found.times, [universe.trajectory[k].time for k in frames])


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


@pytest.mark.parametrize("backend", ["multiprocessing", pytest.param("dask", marks=pytest.mark.nightly)])
def test_other_processes_find_the_same_to_the_last_bit(backend):
    def group():
        made = MDAnalysis.Universe(datafiles.PSF, datafiles.DCD)
        # narrower than the molecule: images meet one another, in other processes too
        made.trajectory.add_transformations(set_dimensions([28, 30, 32, 90, 90, 90]), wrap(made.atoms))
        return made.select_atoms("name CA")

    assert backend in NeighborFlips.get_supported_backends()
    asked = {"start": 1, "stop": 10, "step": 2}
    serial = NeighborFlips(group(), 6.0).run(**asked)
    spread = NeighborFlips(group(), 6.0).run(backend=backend, n_workers=2, **asked)
    equal(serial.results.rules[0], spread.results.rules[0])
    assert len(spread.results.flips)
    assert serial.frames.tolist() == spread.frames.tolist() == [1, 3, 5, 7, 9]
    plain = universe_of(datafiles.PSF, datafiles.DCD).select_atoms("name CA")
    assert (serial.results.pairs > NeighborFlips(plain, 6.0).run(**asked).results.pairs).all()


def stretched(ts):
    ts.positions = ts.positions * (1 + 0.05 * ts.frame)
    return ts


def test_a_transformation_that_no_other_process_can_have_is_refused():
    universe = MDAnalysis.Universe(datafiles.PSF, datafiles.DCD)
    universe.trajectory.add_transformations(stretched)
    # what the file's digits leave undecided is lost where distances change
    analysis = NeighborFlips(universe.select_atoms("name CA"), 8.0, bound=0.0)
    with pytest.raises(InputError, match=r"the transformation 'stretched' .* backend='multiprocessing'"):
        analysis.run(stop=4, backend="multiprocessing", n_workers=2)
    assert (np.diff(analysis.run(stop=4).results.pairs) < 0).all()


def test_several_files_as_one_and_frames_in_memory():
    chained = MDAnalysis.Universe(datafiles.PSF, [datafiles.DCD, datafiles.DCD2])
    group = chained.select_atoms("name CA")[:60]
    first = len(universe_of(datafiles.PSF, datafiles.DCD).trajectory)
    asked = {"start": first - 4, "stop": first + 4}
    whole = NeighborFlips(group, 9.0).run(**asked)
    equal(whole.results.rules[0], NeighborFlips(group, 9.0).run(n_parts=3, **asked).results.rules[0])
    # the flips between two files are of the last frame of one and the first of the other
    rows, _ = brute(chained, group.indices, group.indices, 9.0, range(*asked.values()))
    assert any(row[0] == 4 for row in rows)
    same_rows(whole.results.flips, rows)
    chained.transfer_to_memory(**asked)
    equal(whole.results.rules[0], NeighborFlips(chained.atoms[group.indices], 9.0).run().results.rules[0])


def test_what_the_file_cannot_tell_is_marked(water):
    group = water.select_atoms("name OW")[:2000]
    results = NeighborFlips(group, 3.5).run().results
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


# ---- frames that are none, and what cannot be asked


def moving(frames=6, atoms=20, box=30.0):
    """A Universe in memory whose frames may be spoiled."""
    random = np.random.default_rng(0)
    x = random.uniform(0, box, (atoms, 3)) + np.cumsum(random.normal(size=(frames, atoms, 3)), axis=0)
    universe = MDAnalysis.Universe.empty(atoms, trajectory=True)
    boxes = np.array([[box, box, box, 90, 90, 90]] * frames)
    universe.load_new(x.astype(np.float32), order="fac", dimensions=boxes)
    return universe


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize(
    ("array", "where", "value", "message"),
    [
        *(("get_array", (2, slice(3, 9)), value, "atom 3.* 5 others") for value in (np.nan, np.inf, 0.0)),
        ("get_array", 2, 0.0, "all coordinates are 0"),
        ("dimensions_array", 2, 0, "has no box"),
        ("dimensions_array", (2, slice(3, None)), [10, 10, 150], ""),
    ],
)
def test_a_spoiled_frame_is_named_and_what_was_before_is_kept(parts, array, where, value, message):
    universe = moving()
    spoiled = getattr(universe.trajectory, array)
    (spoiled() if callable(spoiled) else spoiled)[where] = value
    analysis = NeighborFlips(universe, 8.0)
    with pytest.raises(FrameError, match=f"frame 2.*{message}") as caught:
        analysis.run(n_parts=parts)
    good = NeighborFlips(moving(), 8.0).run(stop=2)
    assert caught.value.frame == 2 and len(good.results.flips)
    equal(analysis.results.rules[0], good.results.rules[0])
    assert analysis.frames.tolist() == [0, 1] == good.frames.tolist()


def test_an_atom_that_is_not_looked_at_spoils_nothing_and_widens_no_bound():
    spoiled, far, near = moving(), moving(), moving()
    spoiled.trajectory.get_array()[2, 3:9] = np.nan
    far.trajectory.get_array()[:, 3] += 1e6
    bounds = [NeighborFlips(one.atoms[10:], 8.0).run().results.bound for one in (spoiled, far, near)]
    assert (bounds[0] == bounds[2]).all() and (bounds[1] == bounds[2]).all() and (bounds[0] < 1e-4).all()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"r_cut": "x"}, "r_cut = 'x'; expected a length"),
        ({"r_cut": "8.5"}, "r_cut = '8.5'; expected a length"),
        ({"r_cut": [4.0, None]}, "r_cut = None; expected a length"),
        ({"r_cut": {("C", "N"): "x"}}, "a length in Å, or lengths"),
        ({"r_cut": -1.0}, "a radius of -1.0"),
        ({"r_cut": {("C", "Xx"): 2.5}}, "'Xx'"),
        ({"r_cut": None}, "no cutoff"),
        ({"bound": -1}, "bound = -1; expected"),
        ({"bound": np.nan}, "bound = nan; expected"),
        ({"atoms": lambda water: water.select_atoms("name NOBODY")}, "atoms is empty"),
        ({"other": lambda water: water.select_atoms("name NOBODY")}, "other is empty"),
        (
            {"atoms": lambda water: water.select_atoms("around 3 protein", updating=True)},
            "changes from frame",
        ),
        ({"other": lambda water: moving().atoms}, "different universes"),
        ({"atoms": lambda water: water.trajectory}, "Universe or an AtomGroup"),
    ],
)
def test_what_cannot_be_asked_is_refused_before_anything_is_read(water, asked, message):
    asked = {name: value(water) if callable(value) else value for name, value in asked.items()}
    with pytest.raises(InputError, match=message):
        NeighborFlips(asked.pop("atoms", water.atoms[:40]), **{"r_cut": 4.0, **asked})


@pytest.mark.parametrize("value", [np.array(3.0), np.float32(3.0), np.array([3.0]), 3])
def test_a_number_may_come_as_an_array(water, value):
    assert NeighborFlips(water.atoms[:40], value).rules == [CutoffRule(3.0)]


def test_frames_that_go_backward_are_refused():
    for asked, after, before in (
        ({"frames": [5, 3]}, 3, 5), ({"frames": [1, 3, 3]}, 3, 3), ({"step": -1}, 4, 5),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"frame {after} after frame {before}"):
            NeighborFlips(moving(), 4.0).run(**asked)
    NeighborFlips(moving(), 4.0).run(frames=[1, 3])
    assert len(NeighborFlips(moving(), 4.0).run(frames=np.arange(6) > 2).frames) == 3
