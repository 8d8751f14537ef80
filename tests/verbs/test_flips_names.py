"""Names of atoms, residues and segments in flips.parquet, by the format that has them or has not."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import mdnum
from mdnum.trajectories import topology
from mdnum.trajectories.readers import open_trajectory
from mdnum.trajectories.selection import select

MDAnalysis = pytest.importorskip("MDAnalysis")
ase_io = pytest.importorskip("ase.io")

#: an odd order: two waters, an ion and a glycine, which has the number of the first water again
ATOMS = [
    ("OW", "SOL", 7, "W", "O"), ("HW1", "SOL", 7, "W", "H"), ("HW2", "SOL", 7, "W", "H"),
    ("NA", "NA", 3, "I", "Na"), ("OW", "SOL", 8, "W", "O"), ("HW1", "SOL", 8, "W", "H"),
    ("HW2", "SOL", 8, "W", "H"), ("N", "GLY", 7, "P", "N"), ("CA", "GLY", 7, "P", "C"),
]  # fmt: skip
NAMES, RESIDUES, NUMBERS, SEGMENTS, ELEMENTS = zip(*ATOMS, strict=True)
PARTS = {"atom_name": NAMES, "residue_name": RESIDUES, "residue_number": NUMBERS, "segment": SEGMENTS}
FRAMES = np.random.default_rng(3).uniform(0, 8, (6, len(ATOMS), 3)).round(3)
WORD = pa.dictionary(pa.int32(), pa.string())


def universe():
    first = [0, 3, 4, 7]
    of = np.repeat(range(4), [3, 1, 3, 2])
    made = MDAnalysis.Universe.empty(
        len(ATOMS),
        n_residues=4,
        atom_resindex=of,
        n_segments=3,
        residue_segindex=[0, 1, 0, 2],
        trajectory=True,
    )  # fmt: skip
    for name, values in {
        "names": NAMES, "elements": ELEMENTS, "types": ELEMENTS, "chainIDs": SEGMENTS, "segids": list("WIP"),
        "resnames": [RESIDUES[k] for k in first], "resids": [NUMBERS[k] for k in first],
    }.items():  # fmt: skip
        made.add_TopologyAttr(name, list(values))
    made.dimensions = [8, 8, 8, 90, 90, 90]
    return made


def pdb(path):
    made = universe()
    with MDAnalysis.Writer(str(path), len(ATOMS), multiframe=True) as writer:
        for frame in FRAMES:
            made.atoms.positions = frame
            writer.write(made)


def gro(path):
    lines = []
    for frame in FRAMES:
        rows = zip(ATOMS, frame / 10, strict=True)
        lines += ["t= 0.0", str(len(ATOMS))]
        lines += [
            f"{n:5d}{r:<5s}{a:>5s}{k:5d}" + "".join(f"{x:8.3f}" for x in p)
            for k, ((a, r, n, *_), p) in enumerate(rows)
        ]
        lines += ["   0.80000   0.80000   0.80000"]
    path.write_text("\n".join(lines) + "\n")


def extxyz(path, **arrays):
    from ase import Atoms

    images = [Atoms(ELEMENTS, frame, cell=[8] * 3, pbc=True) for frame in FRAMES]
    for atoms in images:
        for name, values in arrays.items():
            atoms.new_array(name, np.array(values))
    ase_io.write(path, images, format="extxyz")


def ase_names(path):
    # as ASE itself writes what it read from a PDB file
    extxyz(path, atomtypes=NAMES, residuenames=RESIDUES, residuenumbers=NUMBERS)


def other_names(path):
    extxyz(path, name=NAMES, resname=RESIDUES, resid=NUMBERS, segid=SEGMENTS)


def numbers_alone(path):
    extxyz(path, resid=NUMBERS)


def bare(path):
    extxyz(path)


def xtc(path):
    made = universe()
    with MDAnalysis.Writer(str(path), len(ATOMS)) as writer:
        for frame in FRAMES:
            made.atoms.positions = frame
            writer.write(made)


FILES = {
    "pdb": (pdb, "a.pdb", "atom_name residue_name residue_number segment"),
    "gro": (gro, "a.gro", "atom_name residue_name residue_number"),
    "extxyz of ASE": (ase_names, "a.extxyz", "atom_name residue_name residue_number"),
    "extxyz of others": (other_names, "a.extxyz", "atom_name residue_name residue_number segment"),
    "extxyz with numbers": (numbers_alone, "a.extxyz", "atom_name residue_number"),
    "extxyz": (bare, "a.extxyz", "atom_name"),
    "xtc": (xtc, "a.xtc", ""),
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("rule", [{"cutoffs": 3.5}, {"nearest": 2}])
def test_every_row_names_its_atoms_as_far_as_the_file_does(kind, rule, tmp_path):
    write, name, known = FILES[kind]
    write(tmp_path / name)
    outcome = mdnum.flips(tmp_path / name, **rule, out=tmp_path / "out", report=False)
    table = pq.read_table(outcome.folder / "flips.parquet")
    assert len(table) > 10
    expected = {f"{part}_{end}" for part in known.split() for end in "ij"}
    assert {one for one in table.column_names if one.rstrip("ij").rstrip("_") in PARTS} == expected
    # the species where a file has no names
    parts = PARTS | ({} if "residue_name" in known else {"atom_name": ELEMENTS})
    for part in known.split():
        for end in "ij":
            column = table[f"{part}_{end}"]
            assert column.type == (pa.int64() if part == "residue_number" else WORD)
            assert column.to_pylist() == [parts[part][at] for at in table[end].to_pylist()]


def test_names_of_a_topology_go_with_the_frames_of_another_file(tmp_path):
    pdb(tmp_path / "top.pdb")
    xtc(tmp_path / "a.xtc")
    outcome = mdnum.flips(
        tmp_path / "a.xtc", topology=tmp_path / "top.pdb", cutoffs=3.5, out=tmp_path / "out", report=False
    )
    rows = pq.read_table(outcome.folder / "flips.parquet")
    assert rows["segment_j"].to_pylist() == [SEGMENTS[at] for at in rows["j"].to_pylist()]
    assert len(rows) > 10


def test_a_table_without_a_flip_has_the_same_columns(tmp_path):
    ase_names(tmp_path / "a.extxyz")
    kept = {}
    for radius in (1e-3, 3.5):
        folder = mdnum.flips(
            tmp_path / "a.extxyz", cutoffs=radius, out=tmp_path / f"{radius}", report=False
        ).folder
        kept[radius] = pq.read_schema(folder / "flips.parquet")
        assert (pq.read_metadata(folder / "flips.parquet").num_rows > 0) == (radius > 1)
    assert kept[1e-3].equals(kept[3.5]) and "residue_name_i" in kept[3.5].names


def test_atoms_by_id_keep_their_names_in_any_order(tmp_path):
    from ase import Atoms

    rng, images = np.random.default_rng(1), []
    for frame in FRAMES:
        order = rng.permutation(len(ATOMS))
        atoms = Atoms([ELEMENTS[k] for k in order], frame[order], cell=[8] * 3, pbc=True)
        atoms.new_array("id", order + 1)
        atoms.new_array("resname", np.array([RESIDUES[k] for k in order]))
        images.append(atoms)
    ase_io.write(tmp_path / "a.extxyz", images)
    folder = mdnum.flips(tmp_path / "a.extxyz", cutoffs=3.5, out=tmp_path / "out", report=False).folder
    rows = pq.read_table(folder / "flips.parquet")
    assert rows["residue_name_i"].to_pylist() == [RESIDUES[at] for at in rows["i"].to_pylist()]


def test_segments_of_extended_xyz_can_be_selected(tmp_path):
    other_names(tmp_path / "a.extxyz")
    opened = open_trajectory(tmp_path / "a.extxyz")
    assert select(opened, "segid W").tolist() == [0, 1, 2, 4, 5, 6]
    assert select(opened, "segid W and resid 8").tolist() == [4, 5, 6]


def test_columns_that_are_no_names_are_left_alone(tmp_path):
    extxyz(tmp_path / "a.extxyz", resid=np.linspace(0, 1, len(ATOMS)), name=FRAMES[0])
    opened = open_trajectory(tmp_path / "a.extxyz")
    assert opened.table.columns.keys() == {"atom_name"}
    assert opened.table.columns["atom_name"].tolist() == list(ELEMENTS)


def test_the_segment_that_mdanalysis_makes_up_is_none(tmp_path):
    gro(tmp_path / "a.gro")
    assert set(MDAnalysis.Universe(str(tmp_path / "a.gro")).atoms.segids) == {topology._NO_SEGMENT}
    assert not any(open_trajectory(tmp_path / "a.gro").table.segments)
