"""`mdnum flips`, from the command line: what is refused, and the ledger that the library gives as well."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import call

datafiles = pytest.importorskip("MDAnalysisTests.datafiles")
GRO, XTC, PSF, DCD = (str(getattr(datafiles, name)) for name in ("GRO", "XTC", "PSF", "DCD"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nope.xtc", "--cutoff", "4"), "no such file"),
        ((DCD, "-s", PSF), "Add --cutoff R in Å"),
        ((GRO, XTC, "--cutoff", "4"), f"Write mdnum flips {XTC} -s {GRO}"),
        ((DCD, "-s", PSF, "--cutoff", "-1"), "expected a positive length"),
        ((DCD, "-s", PSF, "--most", "3"), "Add --cutoff R"),
        ((DCD, "-s", PSF, "--pairs", "O-H"), "'O-H' … form A-B=LENGTH"),
        ((DCD, "-s", PSF, "--cutoff", "4", "--between", "name CA", "name ("), "is not a valid selection"),
        ((f"{DCD}@x:", "-s", PSF, "--cutoff", "4"), "'x:' is not a range"),
        ((DCD, "-s", PSF, "--cutoff", "4", "--format", "foo"), "--format 'foo' is not a format"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("flips", *arguments) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in message.split(" … ")) and error.count("\n") == 1
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("frames", "suffix"), [(15, "xyz"), (2, "extxyz"), (2, "pdb"), (1, "xyz"), (1, "pdb")]
)
def test_a_file_of_several_frames_is_a_trajectory_to_compare(frames, suffix, capsys, tmp_path):
    import ase.io
    import MDAnalysis

    rng = np.random.default_rng(0)
    images = [ase.Atoms("Ar8", rng.uniform(0, 9, (8, 3)), cell=[9] * 3, pbc=True) for _ in range(frames)]
    first, second = str(tmp_path / f"a.{suffix}"), str(tmp_path / "b.xtc")
    ase.io.write(first, images, format={"pdb": "proteindatabank"}.get(suffix, suffix))
    universe = MDAnalysis.Universe.empty(8, trajectory=True)
    universe.dimensions = [9, 9, 9, 90, 90, 90]
    with MDAnalysis.Writer(second, 8) as writer:
        for atoms in images:
            universe.atoms.positions = atoms.positions
            writer.write(universe)
    code = call("flips", first, second, "--cutoff", "4", "-o", str(tmp_path / "f"), "--no-report")
    assert (code == 2) == (frames == 1)
    assert ("looks like the topology" in capsys.readouterr().err) == (frames == 1)


def test_the_library_gives_the_ledger_that_the_verb_writes(capsys, tmp_path):
    import MDAnalysis

    from mdnum.store import RunFolder
    from mdnum.trajectories import NeighborFlips

    groups = ("name CA and resname VAL LEU", "name CA and resname GLY ALA")
    words = ("-s", PSF, "--cutoff", "8", "--between", *groups, "-o", str(tmp_path / "f"))
    call("flips", DCD, *words, "--no-report", "--json")
    rows = json.loads(capsys.readouterr().out)["rules"][0]["by_residue_name"]
    # in the order of the selections, whatever that of the letters
    assert [{row[name] for row in rows} for name in ("first", "second")] == [{"VAL", "LEU"}, {"GLY", "ALA"}]
    first, second = map(MDAnalysis.Universe(PSF, DCD).select_atoms, groups)
    found = NeighborFlips(first, r_cut=8.0, other=second).run()
    written = RunFolder.open(tmp_path / "f").read("flips")
    assert len(written["frame"]) == len(found.results.flips) > 200
    for name in ("frame", "i", "j", "rank", "entered", "distance", "margin", "before"):
        np.testing.assert_array_equal(written[name], getattr(found.results.flips, name))
