"""Code and commands of the pages do what they are there for: each is executed as it stands.

A page is executed from its first block to its last in one folder, with the files and objects that its text
takes as given. Quick pages are executed in the gate, all of them in the nightly. Blocks that cannot run here
are listed with the reason, and no other block is left out.
"""

from __future__ import annotations

import re
import shlex
import shutil
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from command_line import call

import mdnum

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
BLOCK = re.compile(r"^```(python|sh|toml)\n(.*?)^```", re.MULTILINE | re.DOTALL)
QUICK = {"constant-pressure", "folders", "json"}

#: Lines of shell that are not executed, by how they begin.
LEFT_OUT = {
    "python3 -m pip install -e": "the gate does",
    "python3 -m venv": "the gate does",
    "nice python scripts/campaigns/": "hours",
    "python scripts/campaigns/": "of a campaign of hours",
    "dask scheduler": "runs until it is stopped: tests/sweeps",
    "mdnum sweep mine.toml --over precision --on": "needs that scheduler: tests/sweeps",
    'mdnum audit "ase.calculators.lammpslib': "needs LAMMPS",
    "mdnum spread": "tests/test_other_verb.py, with the block of Python that defines it",
}

#: Blocks of Python that are not executed, by a line of theirs.
PARTIAL = {
    "class Pressed(mdnum.Integrator):": "a part of a class",
    "class TestNeighbors(NeighborListConformance):": "a test of another library: tests/references",
    "context.getState(positions=True)": "needs OpenMM",
    "multiprocessing.get_context(": "starts the file that it stands in: tests/test_pools.py",
    "mp_context=get_context(": "starts the file that it stands in: tests/test_pools.py",
    "backend=": "starts the file that it stands in: tests/trajectories",
    "jax_md.energy.graph_network_neighbor_list": "examples/graph_network.py",
    "foreign.known = lambda": "turns off the compiled loop for what follows it",
    "TEXTS = Texts(__file__)": "tests/test_other_verb.py",
}

GIVEN = """
import ase.build, jax, jax.numpy as jnp, numpy as np, mdnum
atoms = ase.build.bulk("Ar", "fcc", 5.26, cubic=True) * 4
atoms.rattle(0.01, seed=1)
argon, cut = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235), mdnum.Cut("switched", 8.5)
simulation = mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90)
"""

#: What the text of a page takes as given, beyond that.
ALSO = {
    "folders": """
import pandas as pd, pyarrow as pa, shutil
outcome = mdnum.flips("one.dcd", topology="system.psf", cutoffs=4)
shutil.copy(outcome.path / "flips.parquet", ".")
""",
    "json": 'mdnum.run("argon/crystal-108", steps=5, out="runs/liquid-864-1")',
    "gradients": """
atoms = ase.build.bulk("Ni", "fcc", 1.6, cubic=True) * 4
atoms.symbols[::5] = "P"
layers = [
    {"weight": np.full((1, 4), 0.1), "bias": np.linspace(-1, 0, 4)},
    {"weight": np.full((4, 3), 0.1), "bias": np.zeros(3)},
]
weight = layers[0]["weight"] * 1.1
""",
    "sweeps": """
from concurrent.futures import ThreadPoolExecutor
executor = ThreadPoolExecutor(1)
""",
    "trajectories": """
box, steps = 6.0 * np.eye(3), 3
class State:
    position = np.random.default_rng(0).uniform(0, 1, (20, 3))
class Neighbors:
    idx = np.stack(np.nonzero(~np.eye(20, dtype=bool)))
    did_buffer_overflow = False
    def update(self, position): return self
state, neighbors = State(), Neighbors()
def apply(state, neighbor): return state
""",
}


def files(folder: Path) -> None:
    """Files that pages name as the reader's own."""
    from MDAnalysisTests import datafiles

    for name, source in {
        "run.xtc": datafiles.XTC,
        "topol.gro": datafiles.GRO,
        "topol.tpr": datafiles.TPR,
        "one.dcd": datafiles.DCD,
        "other.dcd": datafiles.DCD2,
        "system.psf": datafiles.PSF,
    }.items():
        shutil.copy(source, folder / name)
    frame = "\n".join(f"{i} 1 {3.7 * (i % 6)} {3.7 * (i // 6)} 0" for i in range(36))
    box = "ITEM: BOX BOUNDS pp pp pp\n" + 3 * "0 22.2\n"
    head = f"ITEM: NUMBER OF ATOMS\n36\n{box}ITEM: ATOMS id type x y z\n"
    dump = "".join(f"ITEM: TIMESTEP\n{step}\n{head}{frame}\n" for step in range(105))
    (folder / "run.lammpstrj").write_text(dump)
    assert call("systems", "copy", "argon/crystal-108", ".") == 0
    (folder / "crystal-108.toml").rename(folder / "mine.toml")
    (folder / "mypotential.py").write_text(
        "from ase.calculators.lj import LennardJones\n\n\ndef calculator():\n"
        "    return LennardJones(sigma=3.405, epsilon=0.0103, rc=8.5, smooth=True)\n"
    )
    structure = mdnum.load("argon/liquid-864").atoms
    structure.write(folder / "argon.extxyz")
    structure[:64].write(folder / "mystructure.extxyz")
    (folder / "mylibrary").mkdir()
    (folder / "mylibrary" / "neighbors.py").write_text(
        "from ase.neighborlist import primitive_neighbor_list\n\n\ndef pairs(positions, cell, pbc, r_cut):\n"
        "    return primitive_neighbor_list('ijS', pbc, cell, positions, r_cut)\n"
    )


def commands(block: str) -> list[str]:
    """Lines of a block of shell that are executed, continued lines joined."""
    lines = [line for line in block.replace("\\\n", " ").splitlines() if line.strip()]
    kept = [line for line in lines if not any(line.startswith(start) for start in LEFT_OUT)]
    return [part.strip() for line in kept for part in line.split(" && ")]


def execute(page: str, module: ModuleType) -> dict[str, Any]:
    """Execute a page in the current folder, with the names of a module; exit codes of its commands."""
    namespace, ended = module.__dict__, {}
    exec(GIVEN + ALSO.get(Path(page).stem, ""), namespace)
    for language, block in BLOCK.findall((ROOT / page).read_text(encoding="utf-8")):
        if language == "toml":
            tomllib.loads(block)
        elif language == "python" and not any(line in block for line in PARTIAL):
            exec(compile(block, page, "exec"), namespace)
        elif language == "sh":
            for line in commands(block):
                program, *words = shlex.split(line)
                ended[line] = call(*words) if program == "mdnum" else "neither executed nor listed"
    return ended


@pytest.mark.parametrize(
    "page",
    [
        page if Path(page).stem in QUICK else pytest.param(page, marks=pytest.mark.nightly)
        for page in PAGES
        if BLOCK.search((ROOT / page).read_text(encoding="utf-8"))
    ],
)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    files(tmp_path)
    # a dataclass looks for the module that it is defined in
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)
    # 1: it has findings
    assert {line: code for line, code in execute(page, module).items() if code not in (0, 1)} == {}


def test_what_is_left_out_is_there():
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    assert [start for start in (*LEFT_OUT, *PARTIAL) if start not in text] == []
