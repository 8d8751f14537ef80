"""Other ways to write down the same structure: energy and forces must not differ between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from ase import Atoms
from jaxtyping import Float, Int

from mdnum.audit.pairs import molecules

#: Coordinates that should be 0 and are not quite: a denormal-like displacement that was seen to cost 5 eV,
#: one that is lost when it is added to a cell's length, and half an ulp of 1.
_TINY = (1e-52, 1e-17, 2.0**-53)
#: Atoms of which distances to all others are computed.
_MANY = 500


@dataclass(frozen=True)
class Same:
    """A structure that is the same as another, written down otherwise.

    Attributes:
        what: how it differs.
        code: of the finding when the calculator gives it another answer.
        atoms: the other way.
        copies: how many times the structure it holds.
        order: atom of the structure that each of its atoms is.
        turn: a rotation or reflection R, new positions being R x.
        rounding: Å by which writing it down moved an atom, at most.
        before: compare with this instead of the structure itself.
    """

    what: str
    code: str
    atoms: Atoms
    order: Int[np.ndarray, "same"]
    copies: int = 1
    turn: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    rounding: float = 0.0
    before: Atoms | None = None


def _same(code: str, base: Atoms, what: str, there: Atoms, factor: float = 1.0, **more) -> Same:
    """The atoms of a structure in its order, rounded like its coordinates."""
    return Same(what, code, there, np.arange(len(there)), **{"rounding": factor * ulp(there, base), **more})


def all_of(atoms: Atoms, given: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Every way that applies to a structure.

    Args:
        atoms: no distance of it on a threshold by design.
        given: the structure as it was given, where one may be.
        rng: draws shifts, orders and rotations.
    """
    yield from translated(atoms, rng)
    yield from imaged(atoms, rng)
    yield from on_a_face(atoms, rng)
    yield from permuted(atoms, rng)
    yield from by_an_ulp(atoms, given)
    yield from repeated(atoms)
    yield from narrow(atoms, rng)
    yield from skewed(atoms)
    yield from turned(atoms, rng)
    yield from without_periods(atoms)


def translated(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """All atoms moved together, by lattice vectors and by anything."""
    same = partial(_same, "TRANSLATION", atoms)
    if atoms.pbc.any():
        for count, words in ((1, "one lattice vector"), (-3, "three lattice vectors back")):
            by = count * atoms.cell.array[atoms.pbc].sum(axis=0)
            yield same(f"all atoms moved by {words} along each periodic axis", _moved(atoms, by))
        for _ in range(2):
            share = rng.uniform(0, 1, 3) * atoms.pbc
            there, what = (
                _moved(atoms, share @ atoms.cell),
                "all atoms moved by fractions of the lattice vectors",
            )
            yield same(what, there)
            yield _same("IMAGES", there, f"{what} and wrapped", _wrapped(there))
    free = ~atoms.pbc
    if free.any():
        axes = "the free axes" if atoms.pbc.any() else "x, y, z"
        for length in (7.3, -250.0):
            there = _moved(atoms, length * _outward(atoms, free))
            yield same(f"all atoms moved by {length:g} Å along {axes}", there)


def imaged(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Each atom in a box of its own choice: unwrapped trajectories look like this."""
    if not atoms.pbc.any():
        return
    same = partial(_same, "IMAGES", atoms)
    yield same("atoms wrapped into the cell", _wrapped(atoms))
    for most in (1, 3, 20):
        boxes = rng.integers(-most, most + 1, (len(atoms), 3)) * atoms.pbc
        there = _moved(atoms, boxes @ atoms.cell.array)
        yield same(f"each atom moved by lattice vectors of its own, up to {most} of them", there)


def on_a_face(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """One atom on the face of the cell, a hair outside, and on the opposite face."""
    if not atoms.pbc.any():
        return
    axes, cell = np.flatnonzero(atoms.pbc), atoms.cell.array
    corner = cell[axes].sum(axis=0)
    for who in dict.fromkeys((0, int(rng.integers(len(atoms))))):
        base = _moved(atoms, -atoms.positions[who])

        def placed(where: str, position: object, extra: float = 0.0, base: Atoms = base, who: int = who):
            there = base.copy()
            there.positions[who] = position
            return _same("FACES", atoms, f"atom {who} {where}", there, rounding=ulp(base, atoms) + extra)

        zero = np.zeros(3)
        yield placed("at 0", zero)
        yield placed("at L on every periodic axis", corner)
        for axis in axes:
            yield placed(f"at L along {'abc'[axis]}", cell[axis])
        yield placed("one ulp short of L", np.nextafter(corner, 0.0))
        for tiny in _TINY:
            yield placed(f"at {-tiny:.0e} Å", np.where(atoms.pbc, -tiny, zero), extra=tiny)
        yield placed("at -0", np.where(atoms.pbc, -0.0, zero))


def permuted(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Atoms in another order."""
    if len(atoms) < 2:
        return
    for _ in range(2):
        order = rng.permutation(len(atoms))
        yield Same("atoms in another order", "ORDER", atoms[order], order)
    order = np.arange(len(atoms))[::-1].copy()
    yield Same("atoms in reverse order", "ORDER", atoms[order], order)
    # with another species at the head of the list: some number species as they meet them
    for number in list(dict.fromkeys(atoms.numbers))[1:3]:
        order = np.argsort(atoms.numbers != number, kind="stable")
        yield Same(f"atoms of {Atoms([number]).symbols[0]} first", "ORDER", atoms[order], order)


def by_molecule(atoms: Atoms, rng: np.random.Generator) -> Same | None:
    """Whole molecules in another order, where the atoms come in molecules; None where they do not."""
    size = group(atoms)
    if size is None:
        return None
    order = (rng.permutation(len(atoms) // size)[:, None] * size + np.arange(size)).ravel()
    return Same(f"molecules of {size} atoms in another order", "ORDER", atoms[order], order)


def images_by_molecule(atoms: Atoms, rng: np.random.Generator) -> Same | None:
    """Whole molecules moved by lattice vectors of their own; None as for `by_molecule`."""
    size = group(atoms)
    if size is None or not atoms.pbc.any():
        return None
    boxes = rng.integers(-2, 3, (len(atoms) // size, 3)) * atoms.pbc
    there = _moved(atoms, np.repeat(boxes, size, axis=0) @ atoms.cell.array)
    return _same("IMAGES", atoms, f"molecules of {size} atoms moved by lattice vectors of their own", there)


def group(atoms: Atoms) -> int | None:
    """Atoms in a molecule, where the structure is molecules of several species, one after another; else None.

    That species repeat in groups is not enough: so they do in a crystal of salt. Atoms of a group must be
    bonded, by their covalent radii, and to no others.
    """
    numbers = atoms.numbers
    for size in range(2, len(atoms) // 2 + 1):
        if len(atoms) % size == 0 and np.array_equal(numbers[size:], numbers[:-size]):
            if len(set(numbers[:size])) == 1:
                return None
            expected = np.arange(len(atoms)).reshape(-1, size)
            found = sorted(molecules(atoms), key=lambda one: one[0])
            alike = len(found) == len(expected) and all(map(np.array_equal, found, expected))
            return size if alike else None
    return None


def by_an_ulp(atoms: Atoms, given: Atoms) -> Iterator[Same]:
    """The cell an ulp larger and smaller, atoms where they were."""
    if not atoms.pbc.any():
        return
    for what, base in (("", atoms), (", of the structure as it was given", given)):
        cell = base.cell.array
        rounding = 2 * float(np.spacing(np.max(np.abs(cell))))
        for toward, word in ((np.inf, "larger"), (0.0, "smaller")):
            # away from zero, whatever the sign, and zeros stay zeros
            there = _in_cell(base, np.where(cell == 0, cell, np.nextafter(cell, np.copysign(toward, cell))))
            yield _same("CELL_ULP", base, f"cell one ulp {word}{what}", there, rounding=rounding, before=base)


def repeated(atoms: Atoms) -> Iterator[Same]:
    """Supercells."""
    wanted = [tuple(2 if n == axis else 1 for n in range(3)) for axis in np.flatnonzero(atoms.pbc)]
    if len(wanted) > 1 and len(atoms) <= 64:
        wanted.append(tuple(2 if repeats else 1 for repeats in atoms.pbc))
    for counts in wanted:
        there = atoms.repeat(counts)
        copies = len(there) // len(atoms)
        order = np.tile(np.arange(len(atoms)), copies)
        what = f"{' x '.join(map(str, counts))} supercell"
        yield Same(what, "EXTENSIVE", there, order, copies=copies, rounding=ulp(there, atoms))


def narrow(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """A cell of four atoms as near to one another as in the structure, beside its supercell.

    A structure with room for two cutoffs never asks for a second image of a pair. Of one species alone: what
    a calculator makes of others in such a cell is another question.
    """
    if not atoms.pbc.all() or len(set(atoms.numbers)) > 1 or len(atoms) < 2:
        return
    between = atoms[:_MANY].get_all_distances(mic=True)
    nearest = float(between[~np.eye(len(between), dtype=bool)].min())
    if nearest == 0.0:
        return
    edge = nearest * np.sqrt(2.0)
    places = edge * np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    # wider by the most that two atoms may approach, so that none is nearer than in the structure
    places = 1.1 * places + 0.02 * nearest * rng.uniform(-1, 1, (4, 3))
    few = Atoms([atoms.symbols[0]] * 4, places, cell=[1.1 * edge] * 3, pbc=True)
    there, order = few.repeat(3), np.tile(np.arange(4), 27)
    what = f"a cell of four atoms, {1.1 * edge:.3g} Å wide, repeated three times along each axis"
    yield Same(what, "NARROW_CELL", there, order, copies=27, rounding=ulp(there, few), before=few)


def skewed(atoms: Atoms) -> Iterator[Same]:
    """The same lattice from other lattice vectors, a left-handed cell among them."""
    if not atoms.pbc.all():
        return
    for what, matrix in (
        ("b replaced by a + b", [[1, 0, 0], [1, 1, 0], [0, 0, 1]]),
        ("c replaced by c - a + b", [[1, 0, 0], [0, 1, 0], [-1, 1, 1]]),
        ("a, b, c replaced by b, c, a", [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        ("a and b exchanged", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    ):
        there = _in_cell(atoms, np.array(matrix) @ atoms.cell.array)
        yield _same("LATTICE", atoms, f"the same lattice, {what}", there)


def turned(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Structure and cell turned together, by anything, by axes, and mirrored."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    anyhow = q * np.sign(np.diag(r))
    anyhow *= np.sign(np.linalg.det(anyhow))
    cyclic = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for what, code, turn in (
        ("structure and cell rotated", "ROTATION", anyhow),
        ("x, y, z exchanged in a cycle", "ROTATION", cyclic),
        ("structure and cell mirrored", "MIRROR", np.diag([-1.0, 1.0, 1.0])),
    ):
        there = _in_cell(atoms, atoms.cell.array @ turn.T)
        there.positions = atoms.positions @ turn.T
        yield _same(code, atoms, what, there, factor=4, turn=turn)


def without_periods(atoms: Atoms) -> Iterator[Same]:
    """A cluster in cells that do not repeat: what is written in them must not matter."""
    base = _in_cell(atoms, np.zeros((3, 3)))
    base.pbc = False
    span = np.ptp(base.positions, axis=0).max() + 30.0
    for what, cell in (
        ("a large one", np.diag([span] * 3)),
        ("one shorter than the cluster", np.diag([2.0, 3.0, 4.0])),
        ("a skewed one", np.array([[5.0, 0.0, 0.0], [4.0, 3.0, 0.0], [1.0, 2.0, 6.0]])),
    ):
        what = f"without periods, in {what}"
        yield _same("DUMMY_CELL", base, what, _in_cell(base, cell), rounding=0.0, before=base)


def _moved(atoms: Atoms, by: np.ndarray) -> Atoms:
    there = atoms.copy()
    there.positions += by
    return there


def _wrapped(atoms: Atoms) -> Atoms:
    there = atoms.copy()
    there.wrap(eps=0)
    return there


def _in_cell(atoms: Atoms, cell: np.ndarray) -> Atoms:
    there = atoms.copy()
    there.set_cell(cell)
    return there


def _outward(atoms: Atoms, free: np.ndarray) -> np.ndarray:
    """A direction along the axes that do not repeat, of unit length, and across those that do."""
    if free.all():
        return np.array([1.0, -0.7, 0.4]) / np.linalg.norm([1.0, -0.7, 0.4])
    if not atoms.cell.array[~free].any():
        return np.eye(3)[free][0]
    # perpendicular to the lattice vectors that repeat
    _, _, basis = np.linalg.svd(atoms.cell.array[~free])
    return basis[-1]


def ulp(*structures: Atoms) -> float:
    """An ulp of the largest coordinate or cell entry of some structures, Å."""
    return float(
        np.spacing(
            max(
                np.max(np.abs(part), initial=0.0)
                for one in structures
                for part in (one.positions, one.cell.array)
            )
        )
    )
