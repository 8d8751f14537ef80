"""A package outside mdnum adds a trajectory format: one class and an entry point, no other edit."""

from __future__ import annotations

import sys

import ase
import numpy as np
import pytest
from ase.io import write
from command_line import call
from other_package import install

import mdnum
from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.trajectories.readers import READERS, open_trajectory

READER = '''
from contextlib import contextmanager

import numpy as np

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.topology import AtomTable
from mdnum.trajectories.trajectory import Trajectory


class Dots(Trajectory):
    """A line for each frame: the edge of a cubic box, then all coordinates, in nm."""

    format = "dots"
    reader = "strange-dots"
    length = "nm"

    def __init__(self, path, topology, frames):
        super().__init__(path, topology, frames)
        atoms = len(self.first().split()) // 3
        self.has_atoms(atoms, AtomTable.plain(["Ar"] * atoms))

    @contextmanager
    def raw_frames(self):
        with open(self.path) as lines:
            yield self.in_order(lambda: next(lines, None))

    def decoded(self, number, raw):
        edge, *x = map(float, raw.split())
        return Frame(number, float(number), np.reshape(x, (-1, 3)), Box(np.eye(3) * edge, np.ones(3, bool)))
'''


@pytest.fixture
def site(request, tmp_path, monkeypatch):
    source = getattr(request, "param", READER)
    points = {"mdnum.trajectories": {"dots": "strange_dots:Dots"}}
    monkeypatch.syspath_prepend(install(tmp_path / "site", "strange-dots", {"strange_dots": source}, points))
    yield tmp_path
    sys.modules.pop("strange_dots", None)


def gas(frames: int = 12) -> list[ase.Atoms]:
    """Ten atoms that fly straight through a box that they leave."""
    rng = np.random.default_rng(3)
    x, v = rng.uniform(0, 3.0, (10, 3)), rng.normal(0, 0.2, (10, 3))
    return [ase.Atoms("Ar10", x + n * v, cell=[3.0, 3.0, 3.0], pbc=True) for n in range(frames)]


def dotted(path, frames):
    rows = (np.r_[one.cell[0, 0], one.positions.ravel()] for one in frames)
    path.write_text("".join(" ".join(map(repr, map(float, row))) + "\n" for row in rows))
    return path


def test_a_format_of_another_package_is_read_like_any(site, capsys):
    file = dotted(site / "run.dots", gas())
    write(site / "run.traj", gas())
    # nothing of it is imported for other files
    known = mdnum.flips(site / "run.traj", cutoffs=1.7, out=site / "known", report=False)
    assert "strange_dots" not in sys.modules and "dots" in list(READERS)
    assert call("flips", str(file), "--cutoff", "1.7", "-o", str(site / "f"), "--no-report") == 0
    mine, theirs = (RunFolder.open(one) for one in (site / "f", known.folder))
    assert {key: mine.summary[key] for key in ("format", "reader", "length", "atoms", "frames")} == {
        "format": "dots", "reader": "strange-dots", "length": "nm", "atoms": 10, "frames": 12,
    }  # fmt: skip
    flips, expected = mine.read("flips"), theirs.read("flips")
    assert len(flips["i"]) > 20 and max(flips["rank"]) > 0
    for name in ("frame", "i", "j", "rank", "entered", "distance", "margin"):
        np.testing.assert_array_equal(flips[name], expected[name], err_msg=name)
    # under another name, and a part of it
    file.rename(site / "run.txt")
    assert len(list(open_trajectory(f"{site}/run.txt@2:9:3", format="dots").frames())) == 3
    capsys.readouterr()


def test_a_frame_that_it_cannot_decode_ends_the_reading(site):
    file = dotted(site / "run.dots", gas())
    file.write_text(file.read_text()[:-40] + "x\n")
    found = mdnum.flips(file, cutoffs=1.7, out=site / "f", report=False).summary
    assert found["frames"] == 11 and "frame 11 cannot be read" in found["stopped"]


@pytest.mark.parametrize(
    ("site", "message"),
    [
        (READER.replace("def decoded", "def decode"), "strange-dots.*decoded"),
        (READER.replace("class Dots(Trajectory)", "class Dots"), "'dots' of package strange-dots"),
        (READER.replace("super().__init__", "raise KeyError"), "strange-dots cannot open"),
    ],
    indirect=["site"],
)
def test_a_reader_that_is_none_is_one_line(site, message):
    with pytest.raises(InputError, match=message):
        open_trajectory(dotted(site / "run.dots", gas(2)))
