"""Named cases at one moment that neighbor lists have failed, crowds, and lattices known in closed form."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case, matrix, once
from mdnum.references.oracle import PairSet

#: Atoms along an edge of the lattices: some 5,000 atoms, and 100,000.
SMALL_EDGE, LARGE_EDGE = 17, 47

_TURN = np.array([[2.0, -2.0, 1.0], [1.0, 2.0, 2.0], [2.0, 1.0, -2.0]]) / 3.0


def gas(count: int, cell, seed: int, low: float = 0.0, high: float = 1.0) -> ndarray:
    """Coordinates drawn evenly from a range of fractions of a cell."""
    return np.random.default_rng(seed).uniform(low, high, (count, 3)) @ matrix(cell)


def catalog() -> Iterator[Case]:
    """Every named case, small ones first."""
    for area in (_few, _boxes, _axes, _images, _outside, _ties, _coincident):
        yield from area()


def _few() -> Iterator[Case]:
    yield once("no atoms, periodic", "few", np.zeros((0, 3)), 5.0)
    yield once("no atoms, free", "few", np.zeros((0, 3)))
    yield once("one atom, periodic", "few", [[1.0, 2.0, 3.0]], 5.0)
    yield once("one atom, free", "few", [[1.0, 2.0, 3.0]])
    yield once("one atom at the origin", "few", [[0.0, 0.0, 0.0]], 5.0)
    yield once("two atoms, free, inside", "few", [[0.0, 0, 0], [0.5, 0.5, 0.5]])
    yield once("two atoms, free, outside", "few", [[0.0, 0, 0], [0.8, 0.8, 0.8]])
    yield once("two atoms through each face", "few", [[0.1, 0.1, 0.1], [4.7, 4.8, 4.9]], 5.0)
    yield once("two atoms, no neighbors", "few", [[1.0, 1, 1], [3.5, 3.5, 3.5]], 5.0)
    yield once("two atoms, free, far from the origin", "few", [[1e3, -1e3, 1e3], [1e3, -1e3, 1e3 + 0.75]])
    yield once("three free atoms in a line", "few", [[0.0, 0, 0], [0.75, 0, 0], [1.5, 0, 0]])
    yield once("free atoms in one plane", "few", gas(12, [3.0, 3.0, 0.0], 1))


def _boxes() -> Iterator[Case]:
    for edge in (2.1, 2.5, 3.0, 3.9, 4.0, 4.1, 7.3):
        yield once(f"cube of {edge} cutoffs", "boxes", gas(24, edge, 2), edge)
    for share in (2.0 - 1e-9, 2.0 + 1e-9, 3.0 - 1e-9, 3.0 + 1e-9, 3.0, 4.0 - 1e-12):
        # the number of cells along an axis changes here, and rounding may take it from one to the other
        name = f"a box a hair from {round(share)} cells"
        yield once(name, "boxes", gas(30, [share, 4.5, 3.5], 3), [share, 4.5, 3.5])
    for edge in (0.1, 0.3, 0.7):
        yield once("edges that no double holds", "boxes", gas(20, 3 * edge, 4), 3 * edge, r_cut=edge * 1.2)
    skewed = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]])
    yield once("skewed", "boxes", gas(30, skewed, 5), skewed)
    strong = np.array([[4.0, 0, 0], [9.5, 4.0, 0], [-13.0, 7.0, 4.0]])
    yield once("skewed by more than two edges", "boxes", gas(30, strong, 6), strong)
    flat = np.array([[8.0, 0, 0], [7.6, 2.4, 0], [0, 0, 5.0]])
    yield once("edges are long, widths are not", "boxes", gas(30, flat, 7), flat)
    hexagonal = np.array([[4.0, 0, 0], [-2.0, 2.0 * np.sqrt(3), 0], [0, 0, 5.0]])
    yield once("hexagonal", "boxes", gas(30, hexagonal, 8), hexagonal)
    yield once("turned", "boxes", gas(30, skewed @ _TURN, 9), skewed @ _TURN)
    yield once("left-handed", "boxes", gas(30, skewed[[1, 0, 2]], 10), skewed[[1, 0, 2]])
    yield once("vectors that point backward", "boxes", gas(30, -skewed, 11), -skewed)
    yield once("upper triangular", "boxes", gas(30, skewed.T, 12), skewed.T)
    yield once("thin slab", "boxes", gas(40, [12.0, 12.0, 2.2], 13), [12.0, 12.0, 2.2])
    yield once("needle", "boxes", gas(60, [60.0, 2.3, 2.3], 14), [60.0, 2.3, 2.3])
    clump = gas(12, 1.5, 15)
    yield once("huge", "boxes", np.vstack([clump, clump + 49.2, clump + 99.0]), 100.0)
    yield once("tiny numbers", "boxes", gas(24, 4e-9, 16), 4e-9, r_cut=1e-9)
    yield once("large numbers", "boxes", gas(24, 4e9, 17), 4e9, r_cut=1e9)
    ulp = float(np.nextafter(4.0, 5.0))
    places = np.array([[0.0, 1, 1], [3.75, 1, 1], [2.0, 0, 0], [2.0, 3.5, 0], [0, 0, 2], [0, 0.5, 2]])
    for edge, name in (
        (4.0, "exactly 4"),
        (ulp, "4 and an ulp"),
        (float(np.nextafter(4.0, 0.0)), "an ulp below 4"),
    ):
        yield once(f"pairs through faces, edges {name}", "boxes", places, edge)


def _axes() -> Iterator[Case]:
    for pbc in ((True, True, False), (True, False, False), (False, True, True), (False, False, True)):
        word = "".join(letter for letter, repeats in zip("xyz", pbc, strict=True) if repeats)
        edges = np.array([4.0, 4.5, 5.0])
        yield once(f"repeats along {word}", "axes", gas(24, edges, 20), np.diag(edges), pbc)
        beyond = gas(24, edges, 21, -0.6, 1.6)
        beyond = np.where(pbc, np.mod(beyond, edges), beyond)
        yield once(f"repeats along {word}, atoms past the free faces", "axes", beyond, np.diag(edges), pbc)
        zero = np.diag(np.where(pbc, edges, 0.0))
        yield once(f"repeats along {word}, no vectors along the rest", "axes", gas(24, edges, 22), zero, pbc)
    edges = np.array([4.0, 4.5, 5.0])
    pair = np.array([[0.2, 2.0, 2.0], [3.9, 2.0, 2.0]])
    yield once("not neighbors through a face that does not repeat", "axes", pair, 4.0, (False, True, True))
    molecule = np.array([[0.0, 0, 0], [0.9, 0.2, 0.1], [1.7, -0.3, 0.4], [-0.8, 0.1, 0.5], [2.4, 0.2, 0.2]])
    yield once("free, in a dummy box of 1", "axes", molecule, 1.0, False)
    yield once("free, in a dummy box of 100", "axes", molecule, 100.0, False)
    yield once("free, in a box that would hold it", "axes", molecule + 3.0, 8.0, False)
    yield once("free, negative coordinates, in a dummy box", "axes", molecule - 7.5, 1.0, False)
    tilted = np.array([[4.0, 0, 0], [1.5, 4.0, 0], [1.0, -1.2, 5.0]])
    yield once("skewed slab", "axes", gas(24, tilted, 23), tilted, (True, True, False))
    yield once(
        "slab with a tilted free axis", "axes", gas(24, tilted, 24, -0.7, 1.7), tilted, (True, False, True)
    )


def _images() -> Iterator[Case]:
    yield once("own images along one axis", "images", [[0.1, 0.2, 0.3]], [0.7, 5.0, 5.0])
    yield once("own images along all axes", "images", [[0.1, 0.2, 0.3]], 0.8)
    yield once("two atoms, edges of 1.5 cutoffs", "images", [[0.1, 0.1, 0.1], [0.8, 0.9, 0.7]], 1.5)
    yield once("two atoms, edges of 0.6 cutoffs", "images", [[0.1, 0.1, 0.1], [0.3, 0.4, 0.5]], 0.6)
    yield once("one axis below two cutoffs", "images", gas(10, [1.7, 4.0, 4.0], 30), [1.7, 4.0, 4.0])
    yield once("one axis just below one cutoff", "images", gas(6, [0.96, 4.0, 4.0], 31), [0.96, 4.0, 4.0])
    pair = [[0.0, 0, 0], [0.9, 0, 0]]
    yield once("one cell, both neighbors the same atom", "images", pair, [1.8, 5, 5])
    for edge in (0.45, 0.7, 0.95, 1.9):
        walls = np.array([[0.02, 0.03, 0.02], [0.98, 0.97, 0.96]]) * edge
        yield once(f"two atoms at opposite walls, edges of {edge} cutoffs", "images", walls, edge)
    skewed = np.array([[1.4, 0, 0], [1.1, 1.2, 0], [-0.9, 0.8, 1.3]])
    yield once("small and skewed", "images", gas(4, skewed, 32), skewed)
    yield once("small and skewed, slab", "images", gas(4, skewed, 33), skewed, (True, True, False))
    cubic = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0.0]])
    yield once("four shells of a primitive cell", "images", [[0.0, 0, 0]], cubic, r_cut=3.05)
    yield once("many images along a needle", "images", gas(3, [0.3, 9.0, 9.0], 34), [0.3, 9.0, 9.0])
    yield once("many images, far outside", "images", gas(4, 1.3, 35, -9.0, 9.0), 1.3)


def _outside() -> Iterator[Case]:
    inside = gas(24, 4.0, 40)
    shifts = np.random.default_rng(41).integers(-3, 4, inside.shape)
    yield once("lattice vectors added", "outside", inside + 4.0 * shifts, 4.0)
    yield once("all of one box over", "outside", inside + np.array([4.0, 0, 0]), 4.0)
    yield once("all of one box back", "outside", inside - [0, 4.0, 4.0], 4.0)
    yield once("a thousand boxes over", "outside", inside + 4000.0 * np.sign(shifts), 4.0)
    yield once(
        "one atom a million boxes over", "outside", [[1.0, 1, 1], [1.5 + 4e6, 1, 1], [1, 1.6, 1 - 8e6]], 4.0
    )
    skewed = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]])
    yield once("skewed, lattice vectors added", "outside", gas(24, skewed, 42) + shifts @ skewed, skewed)
    tilted = gas(8, skewed, 43) + 1000.0 * np.where([True, True, False], shifts[:8], 0) @ skewed
    yield once("skewed slab, a thousand boxes over", "outside", tilted, skewed, (True, True, False))
    beyond = np.where([True, False, True], 4.0 * shifts, 0.0)
    yield once("slab, lattice vectors added", "outside", inside + beyond, 4.0, (True, False, True))
    for place, word in (
        (0.0, "0"),
        (4.0, "L"),
        (-0.0, "-0"),
        (-1e-52, "-1e-52"),
        (-1e-17, "-1e-17"),
        (-1e-9, "-1e-9"),
        (float(np.nextafter(4.0, 0.0)), "an ulp below L"),
        (float(np.nextafter(4.0, 9.0)), "an ulp above L"),
        (-4.0, "-L"),
        (8.0, "2 L"),
        (float(-np.spacing(4.0)), "minus an ulp of L"),
    ):
        near = np.array([[0.5, 2, 2], [3.5, 2, 2], [2, 0.5, 2], [2, 3.5, 2], [2, 2, 0.5], [2, 2, 3.5]])
        on = np.array([[place, 2, 2], [2, place, 2], [2, 2, place], [place, place, place]])
        yield once(f"atoms at {word}", "outside", np.vstack([on, near, [[0.4, 0.4, 0.4]]]), 4.0)
    for edge in (4.0, 4.0 * (1 + 1e-9), 4.0 * (1 + 1e-6)):
        name = f"pairs a hair inside the cutoff, across walls of cells, edges {edge!r}"
        yield once(name, "outside", _across_walls(edge), [edge, 200.0, 200.0])
    face = [[0.0, 1, 1], [3 * (1.0 / 3.0) * 2.1, 1, 1], [2.1 - 0.5, 1, 1]]
    yield once("a face that no double holds", "outside", face, 2.1)
    for edge in (2.1, 3.3, 4.7):
        yield once(
            "a grid on the walls of the cells", "outside", _grid(3) / 3 * edge, edge, r_cut=edge / 3 * 1.1
        )


def _across_walls(edge: float) -> ndarray:
    """Pairs along x whose atoms lie just below a multiple of the cutoff, and a cutoff less a hair below that.

    A search that puts one of them into the next cell, as float32 does, has two cells between them.
    """
    hairs = (1e-6, 5.5e-8, 1e-9, 3e-12, 2e-16)
    pairs = []
    for wall in range(1, 5):
        for n, below in enumerate(hairs):
            for k, hair in enumerate(hairs):
                first = np.array([wall - below, 6.0 * (5 * wall - 4 + n), 6.0 * (1 + k)])
                pairs += [first, first - [1.0 - hair, 0.0, 0.0]]
    return np.array(pairs)


def _ties() -> Iterator[Case]:
    grid = _grid(4).astype(float)
    yield once("whole numbers, first shell at the cutoff", "ties", grid, 4.0, r_cut=1.0)
    yield once(
        "whole numbers, 3-4-5", "ties", [[0.0, 0, 0], [3, 4, 0], [3, 4, 12], [0, 4, 3], [-5, 0, 0]], r_cut=5.0
    )
    through = [[0.0, 0, 0], [13, 12, 0], [4, 3, 0], [0, 0, 11]]
    yield once("whole numbers, 3-4-5 through faces", "ties", through, 16.0, r_cut=5.0)
    yield once("second shell at the cutoff, which is no double", "ties", grid, 4.0, r_cut=float(np.sqrt(2.0)))
    for ulps in (-2, -1, 0, 1, 2):
        r_cut = 2.5 + ulps * float(np.spacing(2.5))
        corner = [[1.0, 1, 1], [3.5, 1, 1], [1, 3.5, 1]]
        yield once(f"pairs {-ulps:+d} ulp from the cutoff", "ties", corner, 8.0, r_cut=r_cut)
    rng = np.random.default_rng(50)
    direction = rng.normal(size=(30, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    yield once(
        "30 atoms on a sphere of the cutoff", "ties", np.vstack([np.zeros((1, 3)), direction]) + 4.0, 9.0
    )
    yield once("an image of itself at the cutoff", "ties", [[0.3, 0.3, 0.3]], [2.0, 7.0, 7.0], r_cut=2.0)
    yield once("half of the box at the cutoff", "ties", [[0.0, 0, 0], [2.0, 0, 0]], 4.0, r_cut=2.0)


def _coincident() -> Iterator[Case]:
    yield once("two atoms in one place", "coincident", [[1.0, 1, 1], [1.0, 1, 1]], 5.0)
    yield once("two atoms in one place, free", "coincident", [[1.0, 1, 1], [1.0, 1, 1]])
    yield once("two atoms at the origin", "coincident", [[0.0, 0, 0], [0.0, 0, 0]], 5.0)
    yield once("in one place through the box", "coincident", [[0.0, 1, 1], [5.0, 1, 1], [0, 6, 1]], 5.0)
    yield once("in one place, five boxes apart", "coincident", [[0.5, 1, 1], [25.5, -24, 1]], 5.0)
    yield once("five atoms in one place", "coincident", np.tile([[2.0, 2.0, 2.0]], (5, 1)), 5.0)
    yield once("apart by 1e-300", "coincident", [[0.0, 0, 0], [1e-300, 0, 0], [0, 1e-200, 0]], 5.0)
    yield once("apart by an ulp", "coincident", [[1.0, 1, 1], [float(np.nextafter(1.0, 2.0)), 1, 1]], 5.0)
    yield once("pairs of coincident atoms", "coincident", np.repeat(gas(6, 4.0, 60), 2, axis=0), 4.0)


def crowds() -> Iterator[Case]:
    """Clusters with more neighbors than lists like to give an atom, alone and in a thin gas."""
    for count in (20, 33, 41, 66, 130, 260):
        cluster = 5.0 + 0.45 * gas(count, 1.0, 70 + count, -1.0, 1.0)
        yield once(f"{count} atoms in one clump", "crowded", cluster, 12.0, r_cut=1.6)
    for count in (150, 520):
        around = np.vstack([np.zeros((1, 3)), 0.97 * _sphere(count)])
        yield once(f"{count} neighbors on one atom", "crowded", around + 4.0, 9.0)
    thin = gas(300, 24.0, 71)
    clump = 12.0 + 0.3 * gas(60, 1.0, 72, -1.0, 1.0)
    yield once("a clump in a thin gas", "crowded", np.vstack([thin, clump]), 24.0)
    yield once("a clump in a thin gas, first in the file", "crowded", np.vstack([clump, thin]), 24.0)
    yield once("a clump and emptiness, free", "crowded", np.vstack([clump, thin[:5] * 40.0]))
    yield once("a crystal with 86 neighbors", "crowded", _grid(6) + 0.3, 6.0, r_cut=2.85)
    small = gas(3, 0.9, 73)
    yield once("three atoms with hundreds of images", "crowded", small, 0.9, r_cut=3.5)


def vast() -> Iterator[Case]:
    """Few atoms in so much space that a grid of cells over it has no room in memory, or in 32 bits.

    For lists in a process of their own: those that make such a grid end it.
    """
    apart = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [700.0, 2500.0, 2400.0], [700.5, 2500.0, 2400.0]])
    yield once("two pairs thousands of cutoffs apart, free", "axes", apart)
    yield once("two pairs thousands of cutoffs apart, along a wire", "axes", apart, 3.0, (False, False, True))
    yield once("a box of thousands of cutoffs", "boxes", apart + 1.0, 4000.0)


def lattice(edge: int, seed: int = 0) -> Case:
    """A cubic lattice of whole numbers with gaps, its atoms in any order and in any image of the box.

    Neighbors are the 26 around a place, known by counting modulo the edge: no search and no rounding.

    Args:
        edge: places along an edge.
        seed: of gaps, order and images.
    """
    rng = np.random.default_rng(seed)
    places = _grid(edge)
    kept = rng.permutation(len(places))[: len(places) - len(places) // 50]
    places = places[kept]
    images = rng.integers(-1, 2, places.shape)
    positions = (places + images * edge).astype(np.float64)
    at = np.full((edge,) * 3, -1)
    at[tuple(places.T)] = np.arange(len(places))
    parts = []
    for x, y, z in np.ndindex(3, 3, 3):
        step = np.array([x, y, z]) - 1
        if tuple(step) <= (0, 0, 0):
            continue
        target = places + step
        j = at[tuple(np.mod(target, edge).T)]
        occupied = j >= 0
        i, j = np.flatnonzero(occupied), j[occupied]
        # x_j + shift L = place of i + step, in the images that the atoms are given in
        shift = np.floor_divide(target[i], edge) + images[i] - images[j]
        parts.append((i, j, shift, np.full(len(i), np.sqrt(float(step @ step)))))
    i, j, shift, distance = (np.concatenate([part[n] for part in parts]) for n in range(4))
    turn = i > j
    i, j, shift = np.where(turn, j, i), np.where(turn, i, j), np.where(turn[:, None], -shift, shift)
    yes = np.ones(len(i), bool)
    known = PairSet(i, j, shift, distance, yes, ~yes)
    name = f"{len(places):,} atoms on a lattice with gaps"
    return once(name, "large", positions, float(edge), r_cut=1.875, known=known)


def _grid(count: int) -> ndarray:
    """Integer places, count along each edge."""
    return np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _sphere(count: int) -> ndarray:
    """Directions spread evenly over a sphere (Fibonacci's)."""
    k = np.arange(count) + 0.5
    height, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
