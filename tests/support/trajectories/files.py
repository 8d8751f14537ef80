"""Small files of every format that is text, and what comes of reading them up to where they go wrong."""

from __future__ import annotations

import functools
import tracemalloc
from pathlib import Path

import ase.io
import MDAnalysis
import numpy as np
from ase import Atoms
from MDAnalysisTests import datafiles

from mdnum.errors import InputError
from mdnum.trajectories.frame import FrameCheck
from mdnum.trajectories.readers import open_trajectory

SIDE = 9.0

#: Universes of files, each parsed once; whoever takes one changes none of its atoms.
universe_of = functools.cache(MDAnalysis.Universe)


@functools.cache
def water():
    """AdK in water, 47,681 atoms, as mdnum reads it."""
    return open_trajectory(datafiles.XTC, datafiles.GRO)


def arrays_held() -> int:
    """Bytes of the arrays made since tracemalloc was started: not what else a process begins to remember."""
    arrays = tracemalloc.DomainFilter(True, np.lib.tracemalloc_domain)
    return sum(trace.size for trace in tracemalloc.take_snapshot().filter_traces([arrays]).traces)


def images(frames: int = 5, names: str = "Ar9") -> list[Atoms]:
    """Atoms anywhere about the corner of a box."""
    random = np.random.default_rng(0)
    atoms = len(Atoms(names))
    return [Atoms(names, random.normal(size=(atoms, 3)), cell=[SIDE] * 3, pbc=True) for _ in range(frames)]


def text_of(kind: str, frames: list[Atoms], word="{:.5f}".format, side: str = f"{SIDE / 10:10.5f}") -> str:
    """Frames as text, numbers as `word` writes them; of gro the last number of a frame is a side of its box.

    gro and pdb are in columns: their coordinates have the digits that they always have.
    """
    text = ""
    for number, atoms in enumerate(frames):
        names, x = atoms.get_chemical_symbols(), atoms.positions
        places = [" ".join(map(word, row)) for row in x]
        rows = list(zip(range(1, len(atoms) + 1), names, places, strict=True))
        if kind == "gro":
            text += f"frame {number}\n{len(atoms):5d}\n"
            for (at, name, _), row in zip(rows, x / 10, strict=True):
                text += f"    1SOL  {name:>5s}{at:5d}" + "".join(f"{one:8.3f}" for one in row) + "\n"
            text += 3 * side + "\n"
        elif kind == "pdb":
            text += f"MODEL {number + 1:8d}\nCRYST1{3 * f'{SIDE:9.3f}'}{3 * '  90.00'} P 1           1\n"
            for (at, name, _), row in zip(rows, x, strict=True):
                place = "".join(f"{one:8.3f}" for one in row)
                text += f"ATOM  {at:5d}  {name:<3s} WAT A   1    {place}  1.00  0.00\n"
            text += "ENDMDL\n"
        elif kind == "lammpstrj":
            text += f"ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{len(atoms)}\n"
            text += "ITEM: BOX BOUNDS pp pp pp\n" + 3 * f"0 {SIDE:g}\n" + "ITEM: ATOMS id element x y z\n"
            text += "".join(f"{at} {name} {place}\n" for at, name, place in rows)
        else:
            box = f'Lattice="{SIDE} 0 0 0 {SIDE} 0 0 0 {SIDE}" Properties=species:S:1:pos:R:3'
            text += f"{len(atoms)}\n{box if kind == 'extxyz' else ''}\n"
            text += "".join(f"{name} {place}\n" for _, name, place in rows)
    return text


def written(folder: Path, kind: str, frames: list[Atoms]) -> Path:
    """A file of this kind."""
    path = folder / f"run.{kind}"
    if kind in ("traj", "extxyz"):
        ase.io.write(path, frames)
    else:
        path.write_text(text_of(kind, frames))
    return path


def read(trajectory) -> tuple[list, InputError | None]:
    """(frames before it went wrong, the error)."""
    frames = []
    try:
        for frame in trajectory.frames():
            frames.append(frame)
    except InputError as error:
        return frames, error
    return frames, None


def checked(frames, atoms=None, where=None) -> map:
    """Frames that have been checked."""
    return map(FrameCheck(atoms, where), frames)
