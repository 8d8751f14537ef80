"""`mdnum flips`, from the command line: files nobody here made, what is printed, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call, printed

datafiles = pytest.importorskip("MDAnalysisTests.datafiles")
GRO, XTC, PSF, DCD = (str(getattr(datafiles, name)) for name in ("GRO", "XTC", "PSF", "DCD"))
TRICLINIC = (str(datafiles.PSF_TRICLINIC), str(datafiles.DCD_TRICLINIC))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nope.xtc", "--cutoff", "4"), "no such file"),
        ((DCD, "-s", PSF), "Add --cutoff R in Å"),
        ((GRO, XTC, "--cutoff", "4"), f"Write mdnum flips {XTC} -s {GRO}"),
        ((DCD, "-s", PSF, "--cutoff", "-1"), "expected a positive length"),
        ((DCD, "-s", PSF, "--most", "3"), "Add --cutoff R"),
        ((DCD, "-s", PSF, "--pairs", "O-H"), "is not of the form A-B=LENGTH"),
        ((DCD, "-s", PSF, "--cutoff", "4", "--between", "name CA", "name ("), "is no selection"),
        ((f"{DCD}@x:", "-s", PSF, "--cutoff", "4"), "'x:' names no frames"),
        ((DCD, "-s", PSF, "--cutoff", "4", "--format", "foo"), "--format 'foo' is known to neither"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("flips", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_water_around_a_protein(capsys, tmp_path, monkeypatch):
    """AdK in water, ten frames 100 ps apart on xtc's grid: what the file cannot tell is said."""
    monkeypatch.chdir(tmp_path)
    words = ("--cutoff", "4", "--between", "protein and name CA", "name OW", "--no-report")
    assert call("flips", f"{XTC}@:4", "-s", GRO, *words) == 1
    lines = printed(capsys)
    assert "47,681 atoms, 4 frames 100 ps apart" in lines[1]
    assert lines[-1] == "wrote runs/flips-adk_oplsaa-1"
    assert call("flips", f"{XTC}@:4", "-s", GRO, *words, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["folder"] == "runs/flips-adk_oplsaa-2" and told["frames"] == 4
    assert told["resolution"]["step"] == 0.01
    assert {"FRAMES_FAR_APART", "CENSORED"} & {one["code"] for one in told["findings"]}
    import MDAnalysis
    from MDAnalysis.lib.distances import capped_distance

    universe = MDAnalysis.Universe(GRO, XTC)
    ca, water = universe.select_atoms("protein and name CA"), universe.select_atoms("name OW")
    counts = []
    for _ in universe.trajectory[:4]:
        _, distance = capped_distance(
            ca.positions, water.positions, 4.1, box=universe.dimensions, return_distances=True
        )
        # float32 there: pairs within its reach of the cutoff are neither in nor out
        assert np.abs(distance - 4).min() > 1e-6
        counts.append(int((distance < 4).sum()))
    one = told["rules"][0]
    assert (one["pairs_first"], one["pairs_last"]) == (counts[0], counts[-1])
    assert one["pairs_mean"] == pytest.approx(np.mean(counts))
    # in the order of the selections, whatever that of the letters
    names = {(row["first"], row["second"]) for row in one["by_residue_name"]}
    assert "VAL" in {name for name, _ in names} and {name for _, name in names} == {"SOL"}


def test_a_triclinic_box_that_varies(capsys, tmp_path):
    words = ("--cutoff", "5", "--between", "name OH2", "name OH2", "-o", str(tmp_path / "f"), "--json")
    assert call("flips", TRICLINIC[1], "-s", TRICLINIC[0], *words) in (0, 1)
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 10 and told["rules"][0]["flips"] > 0
    page = (tmp_path / "f" / "report.html").read_text(encoding="utf-8")
    assert "r &lt; 5 Å" in page
    assert call("report", str(tmp_path / "f")) == 0
    assert (tmp_path / "f" / "report.html").read_text(encoding="utf-8") == page


def test_two_files_of_one_system(capsys, tmp_path):
    out = ("-o", str(tmp_path / "f"), "--no-report")
    words = ("-s", PSF, "--cutoff", "8", "--between", "name CA", "name CA")
    assert call("flips", f"{DCD}@:6", f"{DCD}@1:7", *words, *out) == 1
    lines = printed(capsys)
    assert lines[0].startswith("Neighbor sets (r < 8 Å) differ from frame 0 (0 in A’s file, 1 in B’s) on")
    assert any("the first pairs to differ, frame 0 (0 in A’s file" in line for line in lines)
    assert any("a flip that came first is no cause" in line for line in lines)


@pytest.mark.slow
def test_a_file_that_breaks_off_is_kept_as_far_as_it_goes(capsys, tmp_path):
    whole = Path(XTC).read_bytes()
    (tmp_path / "cut.xtc").write_bytes(whole[: len(whole) // 2])
    words = ("--nearest", "4", "--between", "name OW", "name OW", "-o", str(tmp_path / "f"), "--json")
    assert call("flips", str(tmp_path / "cut.xtc"), "-s", GRO, *words, "--no-report") == 1
    told = json.loads(capsys.readouterr().out)
    # MDAnalysis counts the frames that begin, the last of which does not end
    if told["status"] == "stopped":
        assert told["findings"][0]["code"] == "STOPPED" and f"frame {told['frames']}" in told["stopped"]
    assert 3 <= told["frames"] <= 5 and (tmp_path / "f" / "flips.parquet").exists()


def test_the_library_gives_the_ledger_that_the_verb_writes(capsys, tmp_path):
    import MDAnalysis

    from mdnum.store import RunFolder
    from mdnum.trajectories import NeighborFlips

    words = ("-s", PSF, "--cutoff", "8", "--between", "name CA", "name CA", "-o", str(tmp_path / "f"))
    call("flips", DCD, *words, "--no-report")
    capsys.readouterr()
    universe = MDAnalysis.Universe(PSF, DCD)
    found = NeighborFlips(universe.select_atoms("name CA"), r_cut=8.0).run()
    written = RunFolder.open(tmp_path / "f").read("flips")
    assert len(written["frame"]) == len(found.results.flips) > 4_000
    for name in ("frame", "i", "j", "rank", "entered", "distance", "margin", "before"):
        np.testing.assert_array_equal(written[name], getattr(found.results.flips, name))
