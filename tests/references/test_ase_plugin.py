"""What ASE itself finds of mdnum: the calculator by its name, run folders as a format; what that imports."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import ase.io
import numpy as np
import pytest
from ase.build import bulk

import mdnum
from mdnum.errors import FolderError

# the plugin system came with 3.29
NEW = tuple(map(int, version("ase").split(".")[:2])) >= (3, 29)


def test_ase_reads_a_run_folder(tmp_path):
    outcome = mdnum.run("argon/crystal-108", steps=20, save_every=5, out=tmp_path / "run", report=False)
    frames = ase.io.read(outcome.path, ":", format="mdnum")
    kept = ase.io.read(outcome.path / "trajectory.traj", ":")
    assert len(frames) == len(kept) == 5
    for one, other in zip(frames, kept, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
        assert one.get_potential_energy() == other.get_potential_energy()
    assert ase.io.read(outcome.path, 2, format="mdnum") == kept[2]
    assert (ase.io.read(outcome.path, format="mdnum").positions == kept[-1].positions).all()
    without = mdnum.run("argon/crystal-108", steps=5, save_every=0, out=tmp_path / "none", report=False)
    with pytest.raises(FolderError, match="no frames"):
        ase.io.read(without.path, format="mdnum")


@pytest.mark.skipif(not NEW, reason="ASE has no plugins before 3.29")
def test_ase_lists_the_calculator_and_the_format_once_each():
    from ase._4.plugins import plugins

    assert [one.package for one in plugins if one.name == "mdnum"] == ["mdnum", "mdnum"]
    (made,) = (one for one in plugins.calculators if one.name == "mdnum")
    atoms = bulk("Ar", "fcc", a=5.3, cubic=True).repeat(4)
    argon = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235)
    atoms.calc = made()(potential=argon, cutoff=mdnum.Cut("switched", 7.0, onset=6.0))
    assert made() is mdnum.MdnumCalculator and atoms.get_potential_energy() < 0
    (format,) = (one for one in plugins.io_formats if one.name == "mdnum")
    assert format.can_read and not format.can_write


def test_listing_plugins_and_formats_imports_nothing_that_takes_long():
    program = (
        "import sys, ase.io.formats\n"
        "assert 'mdnum' in ase.io.formats.ioformats\n"
        "try:\n    from ase._4.plugins import plugins\nexcept ImportError:\n    pass\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "assert 'mdnum' in loaded\n"
        "print(*{'jax', 'jax_md', 'equinox', 'MDAnalysis', 'pydantic', 'pyarrow'} & loaded)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
