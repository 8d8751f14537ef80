"""Ids say which atom is which: its type may change, and its row too."""

from __future__ import annotations

import re
from pathlib import Path

import ase.io
import numpy as np
import pytest
from ase import Atoms

import mdnum
from mdnum.reading import FrameError
from mdnum.store import RunFolder
from mdnum.trajectories.readers import open_trajectory

DUMP = Path(__file__).with_name("data") / "exchanged_types.lammpstrj"


def flips(path, out, **options):
    return mdnum.flips(path, out=out, report=False, **options).summary


def codes(summary) -> list[str]:
    return [one["code"] for one in summary["findings"]]


def test_types_that_change_matter_to_rules_of_species_alone(tmp_path):
    # the same file with the types of its first frame throughout
    first, *blocks = re.split(r"(?=ITEM: TIMESTEP)", DUMP.read_text())[1:]
    types = dict(line.split()[:2] for line in first.splitlines()[9:])
    rows = [
        re.sub(r"(?m)^(\d+) \d (?=\S+ \S+ \S+$)", lambda m: f"{m[1]} {types[m[1]]} ", one) for one in blocks
    ]
    (tmp_path / "same.lammpstrj").write_text("".join([first, *rows]))
    for rule in ({"cutoffs": [5.0]}, {"nearest": [4]}):
        name = next(iter(rule))
        found = flips(DUMP, tmp_path / name, **rule)
        same = flips(tmp_path / "same.lammpstrj", tmp_path / f"{name}-same", **rule)
        assert found["frames"] == same["frames"] == 8 and found["status"] == "complete"
        assert found["rules"][0]["flips"] == same["rules"][0]["flips"] > 0
        assert found["retyped"] == [1, 10] and same["retyped"] is None
        assert ("TYPES_CHANGE" in codes(found), "TYPES_CHANGE" in codes(same)) == (True, False)
    found = flips(DUMP, tmp_path / "pairs", pairs=["1-2=5"])
    assert found["frames"] == 1
    assert "frame 1: atom 10 is 2" in found["stopped"]
    assert "--cutoff" in found["stopped"]
    assert found["retyped"] is None and "TYPES_CHANGE" not in codes(found)


@pytest.mark.parametrize("kind", ["lammpstrj", "extxyz"])
def test_rows_in_any_order_and_elements_that_change(tmp_path, kind):
    """Three files of one run: rows in one order, in any order, and with elements exchanged as well."""
    rng, side = np.random.default_rng(5), 9.0
    symbols, ids = np.array(["O", "H"] * 10), np.arange(20) + 1
    run = rng.uniform(0, side, (20, 3)) + np.cumsum(rng.normal(0, 0.3, (6, 20, 3)), axis=0)
    counts = []
    for name, shuffled, exchanged in (("a", False, False), ("b", True, False), ("c", True, True)):
        images = []
        for k, x in enumerate(run):
            order = rng.permutation(20) if shuffled else np.arange(20)
            words = symbols.copy()
            if exchanged and k >= 3:
                words[[4, 7]] = words[[7, 4]]
            atoms = Atoms(list(words[order]), x[order], cell=[side] * 3, pbc=True)
            atoms.set_array("id", ids[order])
            images.append(atoms)
        path = tmp_path / f"{name}.{kind}"
        if kind == "lammpstrj":
            text = ""
            for k, atoms in enumerate(images):
                text += f"ITEM: TIMESTEP\n{k}\nITEM: NUMBER OF ATOMS\n20\nITEM: BOX BOUNDS pp pp pp\n"
                text += f"0 {side}\n" * 3 + "ITEM: ATOMS id element x y z\n"
                rows = zip(atoms.arrays["id"], atoms.symbols, atoms.positions, strict=True)
                text += "".join(
                    f"{at} {word} {' '.join(f'{v:.8f}' for v in row)}\n" for at, word, row in rows
                )
            path.write_text(text)
        else:
            ase.io.write(path, images)
        found = flips(path, tmp_path / f"out-{name}", cutoffs=[4.0])
        assert found["frames"] == 6 and found["retyped"] == ([3, 4] if exchanged else None)
        assert open_trajectory(path).species.tolist() == symbols.tolist()
        counts.append(RunFolder.open(tmp_path / f"out-{name}").read("frames")["entered"].tolist())
        kept = flips(path, tmp_path / f"pairs-{name}", pairs=["O-H=4"])
        assert kept["frames"] == (3 if exchanged else 6)
        if exchanged:
            assert "frame 3: atom 4 is H" in kept["stopped"]
    assert counts[0] == counts[1] == counts[2] and sum(counts[0]) > 0


def test_where_reading_stops_nothing_is_followed_as_one_atom(tmp_path):
    """Elements change and there are no ids."""
    x = np.random.default_rng(0).uniform(1, 8, (3, 4, 3))
    images = [Atoms("ArNeArNe" if k < 2 else "NeArArNe", x[k], cell=[9] * 3, pbc=True) for k in range(3)]
    ase.io.write(tmp_path / "run.extxyz", images)
    found = flips(tmp_path / "run.extxyz", tmp_path / "out", cutoffs=[4.0])
    assert found["frames"] == 2 and "frame 2: atom 0 is Ne" in found["stopped"]
    assert found["retyped"] is None and codes(found).count("TYPES_CHANGE") == 0


def test_an_id_that_is_gone_ends_the_file(tmp_path):
    images = [Atoms("Ar4", np.random.default_rng(k).uniform(1, 8, (4, 3)), cell=[9] * 3) for k in range(3)]
    for k, atoms in enumerate(images):
        atoms.set_array("id", np.array([1, 2, 3, 4 + 3 * (k == 2)]))
    ase.io.write(tmp_path / "run.extxyz", images)
    with pytest.raises(FrameError, match=r"frame 2 lacks atom 4 .*4 atoms, .*4"):
        list(open_trajectory(tmp_path / "run.extxyz").frames())
    # a column of that name that numbers molecules says nothing of the kind
    for atoms in images:
        atoms.set_array("id", np.array([1, 1, 2, 2]))
    ase.io.write(tmp_path / "run.extxyz", images)
    assert len(list(open_trajectory(tmp_path / "run.extxyz").frames())) == 3


@pytest.mark.parametrize("suffix", ["traj", "extxyz"])
def test_elements_of_a_file_are_not_spelled_out_for_each_atom(tmp_path, suffix, monkeypatch):
    """That would take time with the square of the number of atoms."""
    spelled = 0
    symbols = Atoms.get_chemical_symbols

    def counted(self):
        nonlocal spelled
        spelled += 1
        return symbols(self)

    rng = np.random.default_rng(1)
    images = [Atoms("ArKr" * 100, rng.uniform(0, 20, (200, 3)), cell=[20] * 3, pbc=True) for _ in range(3)]
    ase.io.write(tmp_path / f"many.{suffix}", images)
    monkeypatch.setattr(Atoms, "get_chemical_symbols", counted)
    trajectory = open_trajectory(tmp_path / f"many.{suffix}")
    assert trajectory.table.species.tolist() == ["Ar", "Kr"] * 100
    assert [frame.labels.tolist() for frame in trajectory.frames()] == [["Ar", "Kr"] * 100] * 3
    assert spelled <= 10
