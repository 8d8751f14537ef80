"""Atomic structures: reading, building, validating, and writing them without rounding."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64

from mdnum.errors import InputError
from mdnum.reading import CHECK_STRUCTURE, ase_images, ignored_velocities, reading
from mdnum.registry import meant
from mdnum.systems import schema

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.md.cell import Cell
    from mdnum.units import Units

#: Distances below this (Å) are errors in any structure in metal units without a pair sigma.
_SMALLEST_DISTANCE = 0.3
#: Largest number of atoms of a crystal built by mdnum; the positions alone take half a gigabyte.
_MOST_ATOMS = 20_000_000
#: Number of atoms in the cubic cell of a crystal, by its name.
ATOMS_IN_CELL = {"fcc": 4, "bcc": 2, "sc": 1, "diamond": 8}
#: Largest coordinate or cell vector in cutoff radii; its ulp is then 2e-8 of the cutoff.
_FARTHEST = 1e8
#: Distances of Lennard-Jones atoms below this many σ (240,000 ε) are errors.
_SMALLEST_IN_SIGMA = 0.4


@dataclass(frozen=True)
class Draw:
    """Settings for random velocities at step 0, used instead of the structure's velocities."""

    temperature: float  # Maxwell-Boltzmann's, and a thermostat's, in the unit of the simulation
    seed: int = 0  # of the draw and of a thermostat's noise
    remove_drift: bool = True  # whether the velocity of the center of mass is taken out
    drawn: bool = True  # whether they were drawn; else they are the structure's

    def velocities(
        self, masses: Float64[np.ndarray, " atoms"], units: Units, own: Float64[np.ndarray, "atoms 3"] | None
    ) -> Float64[np.ndarray, "atoms 3"]:
        """Return the velocities of step 0, in units of length per internal time.

        Args:
            own: velocities of the structure, or None to draw velocities.
        """
        velocities = own
        if velocities is None:
            noise = np.random.default_rng(self.seed).standard_normal((len(masses), 3))
            velocities = noise * np.sqrt(units.k_B * self.temperature / masses)[:, None]
        if self.remove_drift and len(masses) > 1:
            velocities = velocities - masses @ velocities / masses.sum()
        return np.asarray(velocities, np.float64)


def make(structure: schema.FileStructure | schema.BuilderStructure, units: str, folder: Path) -> Atoms:
    """Create the atoms of a [structure] table, in float64.

    Args:
        structure: the structure table.
        units: "metal" or "lj"; in "lj" every mass is 1 unless given.
        folder: folder of structure.file.

    Returns:
        atoms with positions, cell, pbc, masses if they differ from ASE's, and momenta if the file has them.

    Raises:
        InputError: the file is missing or unreadable, a symbol is unknown, or there are constraints.
    """
    from ase import Atoms

    if isinstance(structure, schema.FileStructure):
        source = _read(folder / structure.file, structure.index)
    else:
        source = _build(structure)
    atoms = Atoms(
        numbers=source.numbers,
        positions=np.asarray(source.positions, dtype=np.float64),
        cell=np.asarray(source.cell, dtype=np.float64),
        pbc=source.pbc if structure.pbc is None else structure.pbc,
    )
    _set_masses(atoms, source, structure, units)
    if structure.velocities == "file" and source.has("momenta"):
        # momenta and not velocities: dividing by the mass once keeps what is written and read the same bits
        atoms.set_momenta(np.asarray(source.get_momenta(), dtype=np.float64))
    return atoms


def species_of(atoms: Atoms) -> tuple[tuple[str, ...], Int64[np.ndarray, " atoms"]]:
    """Return the sorted chemical symbols, and the symbol index of each atom."""
    from ase.data import chemical_symbols

    numbers, place = np.unique(atoms.numbers, return_inverse=True)
    symbols = [chemical_symbols[number] for number in numbers]
    order = sorted(range(len(symbols)), key=symbols.__getitem__)
    return tuple(symbols[k] for k in order), np.argsort(order)[place]


def ignored(structure: schema.FileStructure | schema.BuilderStructure, folder: Path) -> list[str]:
    """Return the names of columns that look like velocities but are not read."""
    if isinstance(structure, schema.BuilderStructure):
        return []
    return ignored_velocities(_read(folder / structure.file, structure.index).arrays)


def _read(path: Path, index: int) -> Atoms:
    from ase import Atoms

    if not path.is_file():
        raise InputError("structure file not found", where=str(path), remedy="Correct the key structure.file")
    if path.suffix == ".extxyz" and index in (0, -1) and (ours := _from_extxyz(path)) is not None:
        return ours
    with reading(path, by="ASE", remedy=CHECK_STRUCTURE):
        found = next(ase_images(path.resolve(), index), None)
    if not isinstance(found, Atoms) or len(found) == 0:
        raise InputError(
            "the structure contains no atoms",
            where=str(path),
            remedy="Correct the key structure.file or structure.index",
        )
    if found.constraints:
        raise InputError(
            "the structure has constraints (fixed atoms), which mdnum does not support",
            where=str(path),
            remedy="Remove the constraints from the structure",
        )
    return found


def _build(structure: schema.BuilderStructure) -> Atoms:
    from ase.build import bulk
    from ase.data import atomic_numbers

    if structure.symbol not in atomic_numbers:
        remedy = meant(structure.symbol, atomic_numbers).rstrip() or "Use one such as Ar"
        raise InputError(f"structure.symbol = {structure.symbol!r} is not a chemical symbol", remedy=remedy)
    cells = math.prod(structure.repeat)
    if cells > _MOST_ATOMS // ATOMS_IN_CELL[structure.builder]:
        raise InputError(
            f"structure.repeat = {list(structure.repeat)} gives "
            f"{cells * ATOMS_IN_CELL[structure.builder]:.3g} atoms; expected at most {_MOST_ATOMS:,}",
            remedy="Reduce the numbers in structure.repeat",
        )
    atoms = bulk(structure.symbol, structure.builder, a=structure.lattice_constant, cubic=True)
    atoms = atoms.repeat(structure.repeat)
    xy, xz, yz = structure.tilt
    if any(structure.tilt):
        shear = np.array([[1.0, 0.0, 0.0], [xy, 1.0, 0.0], [xz, yz, 1.0]])
        atoms.set_cell(np.asarray(atoms.cell) @ shear, scale_atoms=False)
        atoms.positions = atoms.positions @ shear
    if structure.rattle > 0:
        atoms.rattle(structure.rattle, seed=structure.seed)
    atoms.pbc = True
    return atoms


def _set_masses(
    atoms: Atoms, source: Atoms, structure: schema.FileStructure | schema.BuilderStructure, units: str
) -> None:
    given = structure.masses or {}
    present = sorted(set(atoms.get_chemical_symbols()))
    unknown = [name for name in given if name not in present]
    if unknown:
        raise InputError(
            f"the table [structure.masses] lists a mass for {', '.join(unknown)}, but the species in the "
            f"structure are {', '.join(present)}",
            remedy="Correct the names of species in [structure.masses]",
        )
    if source.has("masses"):
        masses = np.asarray(source.get_masses(), dtype=np.float64)
    elif units == "lj":
        masses = np.ones(len(atoms))
    elif given:
        masses = atoms.get_masses()
    else:
        return
    for name, mass in given.items():
        masses[atoms.symbols == name] = mass
    if not (np.isfinite(masses).all() and (masses > 0).all()):
        bad = int(np.argmin(np.where(np.isfinite(masses), masses, -1.0)))
        raise InputError(
            f"atom {bad} ({atoms.symbols[bad]}) has the mass {masses[bad]:g}; expected a mass above 0",
            remedy="Correct the structure's column masses, or give the table [structure.masses]",
        )
    atoms.set_array("masses", masses, float, ())


def check(atoms: Atoms, r_cut: float, skin: float, smallest: float, length: str) -> None:
    """Raise an error if a structure cannot be simulated.

    Args:
        r_cut: longest interaction radius (length).
        skin: skin of the Verlet list (length).
        smallest: distance below which two atoms must be a mistake (length).
        length: name of the unit of length, for messages.

    Raises:
        InputError: a number is not finite, a cell vector is missing, the box is too small for r_cut + skin,
            or atoms overlap.
    """
    from mdnum.md.cell import Cell

    _check_finite(atoms)
    _check_size(atoms, r_cut, length)
    # ASE, which the run is compared with, wants vectors of free axes to span a volume too
    Cell.create(atoms.cell, atoms.pbc | atoms.cell.array.any(axis=1))
    cell = Cell.create(atoms.cell, atoms.pbc)
    _check_width(cell, r_cut, skin, length)
    _check_overlap(atoms, cell, smallest, length)


def _check_finite(atoms: Atoms) -> None:
    names = ["positions", "momenta"] if atoms.has("momenta") else ["positions"]
    for name in names:
        bad = ~np.isfinite(atoms.arrays[name]).all(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            values = ", ".join(f"{value:g}" for value in atoms.arrays[name][first])
            count = int(bad.sum())
            raise InputError(
                f"atom {first} ({atoms.symbols[first]}) has {name} ({values})"
                + (f", and the same is true of {count - 1} other atoms" if count > 1 else ""),
                remedy="Write the structure file again with a finite number for every coordinate",
            )


def _check_size(atoms: Atoms, r_cut: float, length: str) -> None:
    """Raise an error if coordinates are so large that distances become inaccurate."""
    farthest = _FARTHEST * r_cut
    places = np.abs(atoms.positions).max(axis=1)
    if (places > farthest).any():
        worst = int(np.argmax(places))
        raise InputError(
            f"atom {worst} ({atoms.symbols[worst]}) has a coordinate of {places[worst]:g} {length}; "
            f"expected at most {farthest:.3g} {length} ({_FARTHEST:g} times the cutoff radius). The rounding "
            f"error of the coordinate is {np.spacing(places[worst]):.2g} {length}",
            remedy="Correct the coordinates or the length unit of the structure, or the key structure.rattle",
        )
    sides = np.abs(np.asarray(atoms.cell)).max(axis=1)
    if np.isfinite(sides).all() and (sides > farthest).any():
        axis = int(np.argmax(sides))
        raise InputError(
            f"the cell vector {'abc'[axis]} is {sides[axis]:g} {length} long; expected at most "
            f"{farthest:.3g} {length} ({_FARTHEST:g} times the cutoff radius)",
            remedy="Correct the cell of the structure, or set structure.pbc to false along this vector",
        )


def _check_width(cell: Cell, r_cut: float, skin: float, length: str) -> None:
    half = float(cell.widths.min()) / 2
    if r_cut + skin <= half:
        return
    axis = "abc"[int(np.argmin(cell.widths))]
    allowed = (
        f"a skin up to {half - r_cut:.4g} {length}" if r_cut < half else f"a cutoff below {half:.4g} {length}"
    )
    raise InputError(
        f"r_cut + skin = {r_cut:g} + {skin:g} = {r_cut + skin:.6g} {length}; expected at most "
        f"{half:.6g} {length}, half the smallest perpendicular width of the box (along {axis}). Beyond this "
        "distance, an atom interacts with two images of the same neighbor",
        remedy=f"Choose {allowed}, or repeat the structure {repeats(cell, r_cut + skin)}",
    )


def repeats(cell: Cell, r_list: float) -> str:
    """Return how often the box must be repeated along a, b and c for the minimum-image convention."""
    return " x ".join(str(max(1, math.ceil(2 * r_list / width))) for width in cell.widths)


def smallest_distance(kind: str, units: str, sigmas: Sequence[float] = ()) -> float:
    """Return the smallest allowed distance of two atoms (a length)."""
    if kind == "soft-sphere":
        # soft spheres may overlap; only coinciding centers, where the force has no direction, are wrong
        return 1e-9
    if kind == "lennard-jones":
        return _SMALLEST_IN_SIGMA * min(sigmas)
    return _SMALLEST_DISTANCE if units == "metal" else 1e-3


def _check_overlap(atoms: Atoms, cell: Cell, smallest: float, length: str) -> None:
    from mdnum.md.cell import wrap_positions
    from mdnum.md.host_search import neighbor_table

    if len(atoms) < 2:
        return
    wrapped, _ = wrap_positions(cell, atoms.positions)
    if not neighbor_table(wrapped, cell, smallest, 1)[2]:
        return
    distance, other, pairs = _nearest(atoms, smallest)
    if not pairs:
        return
    worst = int(np.argmin(distance))
    a, b = sorted((worst, int(other[worst])))
    more = f" ({pairs} such pairs)" if pairs > 1 else ""
    raise InputError(
        f"atoms {a} ({atoms.symbols[a]}) and {b} ({atoms.symbols[b]}) overlap: their distance is "
        f"{distance[worst]:.4g} {length}; expected at least {smallest:.4g} {length}{more}",
        remedy="Correct the positions, the cell or the length unit",
    )


def _nearest(
    atoms: Atoms, within: float
) -> tuple[Float64[np.ndarray, " atoms"], Int64[np.ndarray, " atoms"], int]:
    """Find each atom's nearest neighbor within a distance, and count the pairs within it."""
    from scipy.spatial import KDTree

    count = len(atoms)
    places, origin = with_images(atoms, within)
    everything, own = KDTree(places, balanced_tree=False), KDTree(places[:count], balanced_tree=False)
    found = everything.query(places[:count], k=2, distance_upper_bound=np.nextafter(within, np.inf))
    near, who = (np.asarray(part) for part in found)
    rows = np.arange(count)
    column = np.where(origin[np.minimum(who[:, 0], len(origin) - 1)] == rows, 1, 0)
    pairs = (int(own.count_neighbors(everything, within)) - count) // 2
    return near[rows, column], origin[np.minimum(who[rows, column], len(origin) - 1)], pairs


def nearest_distance(atoms: Atoms, within: float) -> float:
    """Return the smallest distance of two atoms. It is at most `within`."""
    from scipy.spatial import KDTree

    places, _ = with_images(atoms, within)
    near, _ = KDTree(places).query(places[: len(atoms)], k=2)
    return float(np.min(np.asarray(near)[:, 1], initial=within))


def with_images(
    atoms: Atoms, reach: float
) -> tuple[Float64[np.ndarray, "places 3"], Int64[np.ndarray, " places"]]:
    """Return positions of atoms and nearby images, and their atom indices."""
    from mdnum.md.cell import complete

    cell = complete(atoms.cell.array, atoms.pbc)
    inverse = np.linalg.inv(cell)
    x = atoms.positions
    fractional = x @ inverse
    x = x - np.where(atoms.pbc, np.floor(fractional), 0.0) @ cell
    fractional = x @ inverse
    # twice, and a little more for the rounding
    margin = 2.001 * reach * np.linalg.norm(inverse, axis=0)
    origin = np.arange(len(x))
    for axis in np.flatnonzero(atoms.pbc):
        low, high = fractional[:, axis] < margin[axis], fractional[:, axis] >= 1 - margin[axis]
        shift = np.eye(3)[axis]
        fractional = np.concatenate([fractional, fractional[low] + shift, fractional[high] - shift])
        x = np.concatenate([x, x[low] + cell[axis], x[high] - cell[axis]])
        origin = np.concatenate([origin, origin[low], origin[high]])
    return x, origin


#: Comment line that `to_extxyz` writes for a system.
_HEAD = re.compile(
    r'(\d+)\n(?:Lattice="([^"]*)" )?Properties=species:S:1:pos:R:3(:momenta:R:3)?(:masses:R:1)? '
    r'pbc="([TF]) ([TF]) ([TF])"\n'
)
_LONGEST_HEAD = 1000


def _from_extxyz(path: Path) -> Atoms | None:
    """Read atoms from a file that `to_extxyz` wrote. None for other formats."""
    from ase import Atoms
    from pyarrow import ArrowInvalid, csv

    from mdnum.store.tables import as_numpy

    try:
        with path.open(encoding="ascii", newline="") as file:
            head = _HEAD.fullmatch(file.readline(_LONGEST_HEAD) + file.readline(_LONGEST_HEAD))
        if head is None:
            return None
        count, lattice, momenta, masses, *faces = head.groups()
        kinds = ["string"] + ["double"] * (3 + 3 * bool(momenta) + bool(masses))
        names = [str(column) for column in range(len(kinds))]
        table = csv.read_csv(
            path,
            csv.ReadOptions(column_names=names, skip_rows=2),
            csv.ParseOptions(delimiter=" ", quote_char=False, ignore_empty_lines=False),
            csv.ConvertOptions(column_types=dict(zip(names, kinds, strict=True)), null_values=[]),
        )
        # of a hundred thousand atoms there are few kinds
        symbols = table["0"].combine_chunks().dictionary_encode()
        numbers = Atoms(as_numpy(symbols.dictionary)).numbers[as_numpy(symbols.indices)]
        cell = None if lattice is None else np.array(lattice.split(" "), np.float64).reshape(3, 3)
    except (ValueError, KeyError, ArrowInvalid):
        return None
    if table.num_rows != int(count):
        return None
    columns = np.stack([as_numpy(table[name]) for name in names[1:]], axis=1)
    atoms = Atoms(numbers=numbers, positions=columns[:, :3], cell=cell, pbc=[face == "T" for face in faces])
    if momenta:
        atoms.set_array("momenta", columns[:, 3:6], float, (3,))
    if masses:
        atoms.set_array("masses", columns[:, -1], float, ())
    return atoms


def to_extxyz(atoms: Atoms, names: Sequence[str] = ("momenta", "masses")) -> str:
    """Return extended XYZ text that keeps every bit of each float64.

    Args:
        atoms: any atoms.
        names: names of arrays to write in addition to symbols and positions, if the atoms have them.
    """
    import pyarrow as pa
    from ase.data import chemical_symbols
    from pyarrow import csv

    from mdnum.store.tables import as_arrow

    held = {name: atoms.arrays[name] for name in names if name in atoms.arrays}
    arrays = {"pos": atoms.positions} | {
        name: np.asarray(array, np.float64).reshape(len(atoms), -1) for name, array in held.items()
    }
    words = ["species:S:1", *(f"{name}:R:{array.shape[1]}" for name, array in arrays.items())]
    cell = np.asarray(atoms.cell)
    comment = [f'Lattice="{" ".join(map(repr, cell.ravel().tolist()))}"'] if cell.any() else []
    comment.append(f"Properties={':'.join(words)}")
    comment.append(f'pbc="{" ".join("T" if flag else "F" for flag in atoms.pbc)}"')
    kinds, which = np.unique(atoms.numbers, return_inverse=True)
    named = as_arrow([chemical_symbols[kind] for kind in kinds], pa.string())
    columns = [named.take(as_arrow(which, pa.int64()))]
    columns += [as_arrow(values, pa.float64()) for values in np.hstack(list(arrays.values())).T]
    sink = pa.BufferOutputStream()
    table = pa.table(columns, names=[str(at) for at in range(len(columns))])
    csv.write_csv(table, sink, csv.WriteOptions(include_header=False, delimiter=" ", quoting_style="none"))
    return f"{len(atoms)}\n{' '.join(comment)}\n{sink.getvalue().to_pybytes().decode()}"
