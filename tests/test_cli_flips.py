"""`mdnum flips`, from the command line: files nobody here made, what is printed, and what is refused."""

from __future__ import annotations

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
