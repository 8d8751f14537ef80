"""Small systems for tests of rollouts, and what is read back from their folders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import ase.io
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ase import Atoms
from ase.build import bulk
from oracles import recomputed_flips

from mdnum.md.cell import wrap_positions
from mdnum.numerics.reductions import Exact
from mdnum.numerics.sums import Reduction
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import decided_pairs
from mdnum.rollout.run import RunResult
from mdnum.rollout.run import run as roll_out
from mdnum.store import RunFolder
from mdnum.systems.load import System, load
from mdnum.systems.simulation import Simulation
from mdnum.verbs.frame import layout

CRYSTAL = "argon/crystal-108"


def run(system: Any, **options: Any) -> RunResult:
    """A rollout into a folder of `mdnum run`, without its comparisons and page."""
    return roll_out(system, layout("md"), **options)


# tables of a system file; a test changes what it is about
BASE: dict[str, dict[str, Any]] = {
    "potential": {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0},
    "cutoff": {"kind": "hard", "radius": 2.0, "compare": "r2 <"},
    "neighbors": {"skin": 0.3},
    "dynamics": {"kind": "nve", "timestep": 0.004, "temperature": 1.0, "steps": 100, "seed": 3},
}


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, str):
        return f'"{value}"'
    return repr(value.item() if isinstance(value, np.generic) else value)


def write_system(folder: Path, atoms: Atoms, units: str = "lj", **tables: Mapping[str, Any]) -> Path:
    """A system file around atoms, bit for bit; tables update BASE key by key (None drops a table)."""
    folder.mkdir(parents=True, exist_ok=True)
    ase.io.write(folder / "atoms.traj", atoms)
    lines = [f'units = "{units}"', "[structure]", 'file = "atoms.traj"']
    for name in BASE | tables:
        table = tables.get(name, {})
        if table is None:
            continue
        base = BASE.get(name, {})
        kept = {} if "kind" in table and table["kind"] != base.get("kind") and name == "potential" else base
        lines += [f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in {**kept, **table}.items())]
    path = folder / "system.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def liquid(
    cells: int = 3, density: float = 0.85, rattle: float = 0.1, seed: int = 1, tilt: bool = False
) -> Atoms:
    """A crystal shaken hard: 4 cells³ atoms of a dense LJ fluid."""
    edge = (4 / density) ** (1 / 3)
    atoms = bulk("Ar", "fcc", a=edge, cubic=True) * (cells, cells, cells)
    if tilt:
        shear = np.array([[1, 0, 0], [0.11, 1, 0], [-0.07, 0.13, 1]])
        atoms.set_cell(atoms.cell.array @ shear, scale_atoms=True)
    atoms.positions += np.random.default_rng(seed).normal(0, rattle, atoms.positions.shape)
    return atoms


def shaken(system: System, seed: int, temperature: float = 1.0, rattle: float = 0.05) -> System:
    """The system with other positions and velocities (masses 1, units lj): the same compiled program."""
    rng = np.random.default_rng(seed)
    atoms = system.atoms.copy()
    atoms.positions += rng.normal(0, rattle, atoms.positions.shape)
    velocities = rng.normal(0, np.sqrt(temperature), atoms.positions.shape)
    atoms.set_velocities(velocities - velocities.mean(axis=0))
    return replace(system, atoms=atoms)


def moved(simulation: Simulation, size: float) -> Simulation:
    """Every atom displaced at random by about `size`."""
    noise = np.random.default_rng(0).standard_normal(simulation.positions.shape)
    return replace(simulation, positions=simulation.positions + size * noise)


def history(simulation: Simulation, last: int, **options: Any) -> tuple[np.ndarray, list[set[int]]]:
    """Of every step the positions in the user's order, and the keys of the pairs inside."""
    x, pairs = [], []
    for segment in Engine(simulation, last, **options).segments():
        for row in range(segment.rows):
            x.append(segment.unsorted("x", row))
            pairs.append(set(decided_pairs(simulation, segment, row).tolist()))
    return np.array(x, np.float64), pairs


def nearest(simulation: Simulation, d: np.ndarray) -> np.ndarray:
    """Displacements less lattice vectors, in a box along the axes."""
    box = np.diag(np.asarray(simulation.cell.matrix))
    return d - box * np.round(d / box)


def furthest(simulation: Simulation, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distance of the atom that is furthest from where it is in other positions, of shape (..., atoms, 3)."""
    return np.linalg.norm(nearest(simulation, one - other), axis=-1).max(axis=-1)


def listed(simulation: Simulation, skin: float | None = None, positions: np.ndarray | None = None):
    """Wrapped positions in the order of a list, shape (3, atoms), the list, and its tables."""
    given = simulation.positions if positions is None else positions
    wrapped, _ = wrap_positions(simulation.cell, given)
    table = simulation.verlet_list(skin).build(wrapped, simulation.cell)
    return jnp.asarray(wrapped[table.order].T), table, simulation.tables(table)


@eqx.filter_jit
def evaluated(force, x, tables, **options):
    """The force and the decisions over a list."""
    return force(x, tables, decisions=True, **options)


@dataclass(frozen=True, eq=False)
class Tap(Reduction):
    """The exact sum, which keeps the terms of every sum that a compiled program makes, in their order."""

    seen: list[np.ndarray] = field(default_factory=list)

    def sum_of(self, terms, add):
        jax.debug.callback(lambda t: self.seen.append(np.array(t)), terms, ordered=True)
        return Exact()(terms)


def terms_of(simulation: Simulation, x, tables) -> list[np.ndarray]:
    """The terms of every sum of a force: three components, the energy and the virial."""
    tap = Tap()
    jax.block_until_ready(evaluated(replace(simulation, reduction=tap).force, x, tables))
    jax.effects_barrier()
    return tap.seen


def go(
    folder: Path, system: System | Path | str, steps: int, overrides: Mapping[str, Any] | None = None, **more
):
    """A run into folder/run, its result and what it wrote."""
    system = system if isinstance(system, System) else load(system, overrides)
    result: RunResult = run(system, out=folder / "run", steps=steps, **more)
    return result, RunFolder.open(result.folder)


def frames_of(folder: RunFolder) -> list[np.ndarray]:
    """Positions of every saved frame."""
    return [atoms.positions for atoms in ase.io.read(folder.path / "trajectory.traj", index=":")]


def radii(simulation) -> Any:
    """The cutoff as a function of two atoms' indices, from the system file's own tables."""
    from mdnum.md.potentials import pair_type
    from mdnum.systems import pairs

    spec = simulation.origin.system.spec
    if spec.cutoff is None:
        return simulation.r_cut
    symbols = simulation.origin.system.atoms.get_chemical_symbols()
    species = simulation.origin.system.species
    table, _ = pairs.cutoff_radii(spec, species)
    index = np.array([species.index(symbol) for symbol in symbols])
    return lambda i, j: table[pair_type(index[i], index[j], len(species))]


def assert_ledger_is_complete(result: RunResult, folder: RunFolder) -> int:
    """flips.parquet and the counts in series.parquet equal a recomputation from the frames; returns flips."""
    simulation = result.simulation
    spec = simulation.origin.system.spec
    compare = "r <" if spec.cutoff is None else spec.cutoff.compare
    read: Any = ase.io.read(folder.path / "trajectory.traj", index=":")
    frames, cell = [atoms.positions for atoms in read], np.array([atoms.cell.array for atoms in read])
    series, flips = folder.read("series"), folder.read("flips")
    assert len(frames) == len(series["step"])
    rows, counts = recomputed_flips(
        frames, cell, simulation.origin.system.atoms.pbc, radii(simulation), compare
    )
    found = list(zip(*(flips[name].tolist() for name in ("step", "i", "j", "entered")), strict=True))
    assert found == [row[:4] for row in rows]
    assert series["pairs"].tolist() == counts
    scale = simulation.r_cut**2
    assert np.allclose(flips["margin"], [row[4] for row in rows], rtol=0, atol=1e-12 * scale)
    assert np.allclose(flips["distance"], [row[5] for row in rows], rtol=1e-12)
    assert np.array_equal(flips["margin"] >= 0, flips["entered"]) or np.any(flips["margin"] == 0)
    return len(rows)


def tables_equal(a: RunFolder, b: RunFolder, name: str, but: tuple[str, ...] = ()) -> None:
    """Two tables hold the same bits, columns named in but aside."""
    left, right = a.read(name), b.read(name)
    assert left.keys() == right.keys()
    for column in left.keys() - set(but):
        x, y = left[column], right[column]
        same = np.array_equal(x, y) if x.dtype == object else x.tobytes() == y.tobytes()
        assert same, f"{name}.{column} differs"
