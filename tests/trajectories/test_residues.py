"""Contacts between residues, on files nobody here made, against all distances by MDAnalysis and numpy."""

from __future__ import annotations

import warnings

import MDAnalysis
import numpy as np
import pytest
from MDAnalysis.lib.distances import distance_array
from MDAnalysis.lib.mdamath import triclinic_vectors
from MDAnalysisTests import datafiles
from trajectories.files import universe_of

import mdnum
from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.rules import Nearest

warnings.filterwarnings("ignore", module="MDAnalysis")

PROTEIN = (datafiles.PSF, datafiles.DCD)
WATER = (datafiles.GRO, datafiles.XTC)


def smallest(universe, first, second):
    """{(residue, other): smallest distance} between two groups at the current frame, in float64."""
    box = universe.dimensions
    one, other = (group.positions.astype(np.float64) for group in (first, second))
    moved = other[None] - one[:, None]
    if box is None:
        distance = np.linalg.norm(moved, axis=2)
    else:
        cell = triclinic_vectors(box, dtype=np.float64)
        shifts = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])
        moved -= np.rint(moved @ np.linalg.inv(cell)) @ cell
        distance = np.min([np.linalg.norm(moved + shift @ cell, axis=2) for shift in shifts], axis=0)
        # the library's own, in float32
        np.testing.assert_allclose(distance, distance_array(first, second, box=box), atol=2e-4)
    found = {}
    a, b = first.resindices, second.resindices
    for k in np.unique(a):
        for m in np.unique(b):
            if k != m:
                pair = (min(k, m), max(k, m))
                here = distance[np.ix_(a == k, b == m)].min()
                found[pair] = min(here, found.get(pair, np.inf))
    return found


@pytest.mark.parametrize(
    ("files", "words", "other", "hydrogens", "radius", "frames"),
    [
        (PROTEIN, "resid 1:40", None, False, 4.5, [0, 8, 16, 40, 97]),
        (PROTEIN, "resid 1:25", None, True, 2.6, [0, 30, 60, 90]),
        # across the faces of a rhombic dodecahedron, and groups that share residues
        (WATER, "resid 100:104 215:300", "resid 102:106 or resid 280:400", False, 7.0, [0, 3, 9]),
    ],
)
def test_contacts_are_those_of_the_smallest_distances(files, words, other, hydrogens, radius, frames):
    universe = universe_of(*files)
    first = universe.select_atoms(words)
    second = first if other is None else universe.select_atoms(other)
    given = {} if other is None else {"other": second}
    results = (
        NeighborFlips(first, radius, by="residue", hydrogens=hydrogens, **given).run(frames=frames).results
    )
    heavy = "all" if hydrogens else "not name H* MW and not name 1H* 2H* 3H*"
    groups = [group.select_atoms(heavy) for group in (first, second)]
    if not hydrogens:
        left_out = len(first | second) - len(groups[0] | groups[1])
        assert sum(results.left_out.values()) == left_out > 0
    rows, inside, before = [], [], {}
    for count, number in enumerate(frames):
        universe.trajectory[number]
        now = smallest(universe, *groups)
        inside.append({pair for pair, r in now.items() if r < radius})
        for pair in sorted(inside[-1] ^ inside[max(count - 1, 0)]):
            rows.append((count, *pair, pair in inside[-1], now[pair], before[pair]))
        before = now
    flips = results.flips
    assert len(rows) > 10 and {row[3] for row in rows} == {True, False}
    assert list(zip(flips.frame, flips.i, flips.j, flips.entered, strict=True)) == [row[:4] for row in rows]
    np.testing.assert_allclose(flips.distance, [row[4] for row in rows], rtol=1e-9)
    np.testing.assert_allclose(flips.before, [row[5] for row in rows], rtol=1e-9)
    np.testing.assert_allclose(flips.margin, radius - flips.distance, atol=1e-12)
    assert results.pairs.tolist() == [len(one) for one in inside]
    times = {pair: sum(pair in one for one in inside) for one in inside for pair in one}
    table = results.occupancy.to_pandas()
    assert {(i, j): n for i, j, n in table[["i", "j", "inside"]].itertuples(index=False)} == times
    np.testing.assert_allclose(table.share, table.inside / len(frames))
    assert results.contacts.to_pandas()[["began", "ended"]].sum().tolist() == [
        table.formed.sum(),
        table.broken.sum(),
    ]
    names = results.residues.to_pandas().set_index("residue")
    assert (names.loc[table.i, "number"].to_numpy() == universe.residues.resids[table.i]).all()


@pytest.fixture
def pair(tmp_path):
    """Two residues whose hydrogens touch at once, whose virtual sites do later, and whose carbons do last."""
    names = ["CA", "HA", "MW", "CA", "HB1", "LP1"]
    universe = MDAnalysis.Universe.empty(6, 2, atom_resindex=[0, 0, 0, 1, 1, 1], trajectory=True)
    for name, values in (("names", names), ("resnames", ["ALA", "GLY"]), ("resids", [7, 9])):
        universe.add_TopologyAttr(name, values)
    gaps = np.array([9.0, 6.5, 5.5, 4.0, 5.0, 3.0, 7.0])
    x = np.zeros((len(gaps), 6, 3))
    x[:, :3, 0] = [0.0, 1.0, 0.5]
    x[:, 3:, 0] = gaps[:, None] + [0.0, -1.0, -0.5]
    universe.load_new(x.astype(np.float32))
    path = tmp_path / "pair.pdb"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe.atoms.write(path, frames="all")
    return path


@pytest.mark.parametrize(("hydrogens", "formed", "last"), [(False, [3, 5], [4, 6]), (True, [2], [6])])
def test_hydrogens_and_virtual_sites_are_left_out_unless_they_are_wanted(
    pair, hydrogens, formed, last, tmp_path
):
    found = mdnum.flips(pair, cutoffs=4.5, by="residue", hydrogens=hydrogens, out=tmp_path / "out")
    stays = found.table("contacts").to_pandas()
    assert (stays.begin.tolist(), stays.end.tolist()) == (formed, last)
    assert stays[["first", "second"]].drop_duplicates().to_numpy().tolist() == [["ALA 7", "GLY 9"]]
    times = found.table("frames").to_pandas().time
    assert stays.time.tolist() == times[formed].tolist()
    assert stays.time_end.tolist() == [
        times[end] if end < 7 else pytest.approx(np.nan, nan_ok=True) for end in last
    ]
    (printed,) = (one for one in found.page.sections if one.title == "Contacts between residues")
    assert printed.terminal
    assert "contacts.parquet" in printed.parts[0] and "occupancy.parquet" in printed.parts[0]
    assert found.summary["left_out"] == ({} if hydrogens else {"hydrogens": 2, "virtual sites": 2})
    assert ("2 hydrogens" in " ".join(found.verdict.evidence)) is not hydrogens
    assert ("2 hydrogens" in found.page.about) is not hydrogens
    flips = found.table("flips").to_pandas()
    assert flips[["residue_name_i", "residue_number_j"]].drop_duplicates().to_numpy().tolist() == [["ALA", 9]]
    total = found.table("occupancy").to_pandas()
    assert (total["first"][0], total["second"][0], total.inside[0]) == (
        "ALA 7",
        "GLY 9",
        sum(last) - sum(formed),
    )
    moments = found.table("moments").to_pandas().pivot(index="residue", columns="frame", values="contacts")
    expected = [any(a <= k < b for a, b in zip(formed, last, strict=True)) for k in range(7)]
    assert moments.to_numpy().tolist() == [expected, expected]
    matrix = found.plot("rule0-matrix")
    assert matrix.xaxis.get_major_formatter()(1.0) == "GLY 9" and matrix.collections
    assert found.plot("rule0-moments").yaxis.get_major_formatter()(0.0) == "ALA 7"


def test_what_has_no_residues_has_no_contacts_between_them(pair, tmp_path):
    bare = universe_of(*PROTEIN)
    for given, word in (
        ({"nearest": 3}, "nearest"),
        ({"cutoffs": 4.5, "between": ("name HA", "name CA")}, "all selected atoms"),
        ({"cutoffs": 4.5, "other": pair}, "by"),
    ):
        with pytest.raises(InputError, match=word):
            mdnum.flips(pair, by="residue", out=tmp_path / "no", **given)
    with pytest.raises(InputError, match="hydrogens"):
        mdnum.flips(pair, cutoffs=4.5, hydrogens=True, out=tmp_path / "no")
    with pytest.raises(InputError, match="residues"):
        mdnum.flips(np.zeros((2, 3, 3)) + np.eye(3), cutoffs=4.5, by="residue", out=tmp_path / "no")
    with pytest.raises(InputError, match="nearest"):
        NeighborFlips(bare, rule=Nearest(3), by="residue")
    with pytest.raises(InputError, match="atom"):
        NeighborFlips(bare, 4.5, by="molecule")
    assert not (tmp_path / "no").exists()


def test_processes_agree_on_contacts_to_the_last_bit():
    group = universe_of(*PROTEIN).select_atoms("resid 1:80")
    whole = NeighborFlips(group, 4.5, by="residue").run(stop=24)
    split = NeighborFlips(group, 4.5, by="residue").run(stop=24, n_parts=3)
    for name in ("flips", "initial", "last", "contacts", "occupancy"):
        assert getattr(whole.results, name).equals(getattr(split.results, name)), name
    assert len(whole.results.flips) > 100
