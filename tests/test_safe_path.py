"""Nothing that lies in the current folder is run unless somebody names it."""

from __future__ import annotations

import importlib
import pickle
import re
import sys
import warnings
from pathlib import Path

import pytest

import mdnum
from mdnum.audit.record import load_calculator
from mdnum.errors import InputError
from mdnum.references.conformance.peers import load as load_list
from mdnum.safe_path import python
from mdnum.systems import load as load_system

PACKAGE = Path(str(mdnum.__file__)).parent


@pytest.fixture(autouse=True)
def path_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])


def test_every_python_process_is_started_by_one_function():
    assert "-P" in python("-c", "pass")
    starts = [path.name for path in PACKAGE.rglob("*.py") if re.search(r"sys\.executable", path.read_text())]
    assert starts == ["safe_path.py"]


def test_a_module_beside_the_person_is_found_and_hides_no_package(strangers_folder: Path):
    (strangers_folder / "lists_beside.py").write_text(
        "def pairs(positions, cell, pbc, r_cut):\n    return [], []\n"
    )
    (strangers_folder / "potential_beside.py").write_text(
        "from ase.calculators.lj import LennardJones\n\n\nclass Mine(LennardJones):\n    pass\n"
    )
    assert load_list("lists_beside:pairs").name == "lists_beside:pairs"
    assert load_calculator("potential_beside:Mine").stem == "Mine"
    assert load_calculator("ase.calculators.lj:LennardJones(rc=2.5)").stem == "LennardJones"
    for name in ("vesin", "jax"):
        # as if it had not been imported yet
        found = importlib.machinery.PathFinder.find_spec(name, sys.path)
        assert found is not None and not str(found.origin).startswith(str(strangers_folder))


def test_a_calculator_in_a_file_finds_its_neighbors_and_they_hide_no_package(strangers_folder: Path):
    (strangers_folder / "well_beside.py").write_text("WELL = 0.25\n")
    (strangers_folder / "made.py").write_text(
        "import sys\nfor name in ('vesin', 'typer'):\n    sys.modules.pop(name, None)\n"
        "import typer, vesin\nfrom well_beside import WELL\n"
        "from ase.calculators.lj import LennardJones\ncalculator = LennardJones(epsilon=WELL)\n"
    )
    kept = {name: module for name, module in sys.modules.items() if name.split(".")[0] in ("vesin", "typer")}
    try:
        assert load_calculator("made.py").make().parameters["epsilon"] == 0.25
    finally:
        sys.modules.update(kept)


class _Runs:
    """What a pickle does when somebody loads it."""

    def __init__(self, ran: Path):
        self.ran = ran

    def __reduce__(self):
        return Path.touch, (self.ran,)


def test_no_structure_of_any_format_is_executed(tmp_path: Path):
    """Whatever a file calls itself, ASE's and MDAnalysis's readers run neither a pickle nor Python in it."""
    from mdnum.trajectories.readers import open_trajectory

    ran = tmp_path / "ran"
    payloads = [pickle.dumps(_Runs(ran)), f"open({str(ran)!r}, 'w').write('x')\n".encode()]
    pickle.loads(payloads[0])
    assert ran.exists(), "the payload works"
    ran.unlink()
    # those that hold objects, or are named as if they did; the others are text
    words = "pckl pkl py npy npz traj trj bundle db json gpw tpr dms xyz"
    (tmp_path / "argon.toml").write_text(
        'units = "lj"\n[structure]\nfile = "x"\n[potential]\nkind = "lennard-jones"\nsigma = 1.0\n'
        'epsilon = 1.0\n[cutoff]\nkind = "hard"\nradius = 2.5\n[dynamics]\nkind = "nve"\ntimestep = 0.004\n'
    )
    for word in words.split():
        for payload in payloads:
            file = tmp_path / f"given.{word}"
            file.write_bytes(payload)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with pytest.raises(InputError):
                    load_system(tmp_path / "argon.toml", {"structure.file": file.name})
                for format in (None, word):
                    with pytest.raises(InputError):
                        list(open_trajectory(file, format=format).frames())
            assert not ran.exists(), word
