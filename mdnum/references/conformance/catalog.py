"""Questions at one moment that have tripped neighbor lists: a name for each, and no chance in any."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mdnum.references.conformance.case import Case, one

_TURN = np.array([[2.0, -2.0, 1.0], [1.0, 2.0, 2.0], [2.0, 1.0, -2.0]]) / 3.0


def gas(count: int, cell, seed: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Coordinates drawn evenly from a range of fractions of a cell."""
    matrix = np.asarray(cell, np.float64)
    matrix = np.diag(matrix * np.ones(3)) if matrix.ndim < 2 else matrix
    return np.random.default_rng(seed).uniform(low, high, (count, 3)) @ matrix


def catalog() -> Iterator[Case]:
    """Every named case, small ones first."""
    yield from _few()
    yield from _boxes()
    yield from _axes()
    yield from _images()
    yield from _outside()
    yield from _ties()
    yield from _coincident()


def _few() -> Iterator[Case]:
    yield one("no atoms, periodic", "few", np.zeros((0, 3)), 5.0)
    yield one("no atoms, free", "few", np.zeros((0, 3)))
    yield one("one atom, periodic", "few", [[1.0, 2.0, 3.0]], 5.0)
    yield one("one atom, free", "few", [[1.0, 2.0, 3.0]])
    yield one("one atom at the origin", "few", [[0.0, 0.0, 0.0]], 5.0)
    yield one("two atoms, free, inside", "few", [[0.0, 0, 0], [0.5, 0.5, 0.5]])
    yield one("two atoms, free, outside", "few", [[0.0, 0, 0], [0.8, 0.8, 0.8]])
    yield one("two atoms through each face", "few", [[0.1, 0.1, 0.1], [4.7, 4.8, 4.9]], 5.0)
    yield one("two atoms, no neighbors", "few", [[1.0, 1, 1], [3.5, 3.5, 3.5]], 5.0)
    yield one("two atoms, free, far from the origin", "few", [[1e3, -1e3, 1e3], [1e3, -1e3, 1e3 + 0.75]])
    yield one("three free atoms in a line", "few", [[0.0, 0, 0], [0.75, 0, 0], [1.5, 0, 0]])
    yield one("free atoms in one plane", "few", gas(12, [3.0, 3.0, 0.0], 1))


def _boxes() -> Iterator[Case]:
    for edge in (2.1, 2.5, 3.0, 3.9, 4.0, 4.1, 7.3):
        yield one(f"cube of {edge} cutoffs", "boxes", gas(24, edge, 2), edge)
    for share in (2.0 - 1e-9, 2.0 + 1e-9, 3.0 - 1e-9, 3.0 + 1e-9, 3.0, 4.0 - 1e-12):
        # the number of cells along an axis changes here, and rounding may take it from one to the other
        name = f"a box a hair from {round(share)} cells"
        yield one(name, "boxes", gas(30, [share, 4.5, 3.5], 3), np.diag([share, 4.5, 3.5]))
    for edge in (0.1, 0.3, 0.7):
        yield one("edges that no double holds", "boxes", gas(20, 3 * edge, 4), 3 * edge, r_cut=edge * 1.2)
    skewed = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]])
    yield one("skewed", "boxes", gas(30, skewed, 5), skewed)
    strong = np.array([[4.0, 0, 0], [9.5, 4.0, 0], [-13.0, 7.0, 4.0]])
    yield one("skewed by more than two edges", "boxes", gas(30, strong, 6), strong)
    flat = np.array([[8.0, 0, 0], [7.6, 2.4, 0], [0, 0, 5.0]])
    yield one("edges are long, widths are not", "boxes", gas(30, flat, 7), flat)
    hexagonal = np.array([[4.0, 0, 0], [-2.0, 2.0 * np.sqrt(3), 0], [0, 0, 5.0]])
    yield one("hexagonal", "boxes", gas(30, hexagonal, 8), hexagonal)
    yield one("turned", "boxes", gas(30, skewed @ _TURN, 9), skewed @ _TURN)
    yield one("left-handed", "boxes", gas(30, skewed[[1, 0, 2]], 10), skewed[[1, 0, 2]])
    yield one("vectors that point backward", "boxes", gas(30, -skewed, 11), -skewed)
    yield one("upper triangular", "boxes", gas(30, skewed.T, 12), skewed.T)
    yield one("thin slab", "boxes", gas(40, [12.0, 12.0, 2.2], 13), np.diag([12.0, 12.0, 2.2]))
    yield one("needle", "boxes", gas(60, [60.0, 2.3, 2.3], 14), np.diag([60.0, 2.3, 2.3]))
    clump = gas(12, 1.5, 15)
    yield one("huge", "boxes", np.vstack([clump, clump + 49.2, clump + 99.0]), 100.0)
    yield one("tiny numbers", "boxes", gas(24, 4e-9, 16), 4e-9, r_cut=1e-9)
    yield one("large numbers", "boxes", gas(24, 4e9, 17), 4e9, r_cut=1e9)
    ulp = float(np.nextafter(4.0, 5.0))
    places = np.array([[0.0, 1, 1], [3.75, 1, 1], [2.0, 0, 0], [2.0, 3.5, 0], [0, 0, 2], [0, 0.5, 2]])
    for edge, name in (
        (4.0, "exactly 4"),
        (ulp, "4 and an ulp"),
        (float(np.nextafter(4.0, 0.0)), "an ulp below 4"),
    ):
        yield one(f"pairs through faces, edges {name}", "boxes", places, edge)


def _axes() -> Iterator[Case]:
    for pbc in ((True, True, False), (True, False, False), (False, True, True), (False, False, True)):
        word = "".join(letter for letter, repeats in zip("xyz", pbc, strict=True) if repeats)
        edges = np.array([4.0, 4.5, 5.0])
        yield one(f"repeats along {word}", "axes", gas(24, edges, 20), np.diag(edges), pbc)
        beyond = gas(24, edges, 21, -0.6, 1.6)
        beyond = np.where(pbc, np.mod(beyond, edges), beyond)
        yield one(f"repeats along {word}, atoms past the free faces", "axes", beyond, np.diag(edges), pbc)
        zero = np.diag(np.where(pbc, edges, 0.0))
        yield one(f"repeats along {word}, no vectors along the rest", "axes", gas(24, edges, 22), zero, pbc)
    edges = np.array([4.0, 4.5, 5.0])
    pair = np.array([[0.2, 2.0, 2.0], [3.9, 2.0, 2.0]])
    yield one("not neighbors through a face that does not repeat", "axes", pair, 4.0, (False, True, True))
    molecule = np.array([[0.0, 0, 0], [0.9, 0.2, 0.1], [1.7, -0.3, 0.4], [-0.8, 0.1, 0.5], [2.4, 0.2, 0.2]])
    yield one("free, in a dummy box of 1", "axes", molecule, 1.0, False)
    yield one("free, in a dummy box of 100", "axes", molecule, 100.0, False)
    yield one("free, in a box that would hold it", "axes", molecule + 3.0, 8.0, False)
    yield one("free, negative coordinates, in a dummy box", "axes", molecule - 7.5, 1.0, False)
    tilted = np.array([[4.0, 0, 0], [1.5, 4.0, 0], [1.0, -1.2, 5.0]])
    yield one("skewed slab", "axes", gas(24, tilted, 23), tilted, (True, True, False))
    yield one(
        "slab with a tilted free axis", "axes", gas(24, tilted, 24, -0.7, 1.7), tilted, (True, False, True)
    )


def _images() -> Iterator[Case]:
    yield one("own images along one axis", "images", [[0.1, 0.2, 0.3]], np.diag([0.7, 5.0, 5.0]))
    yield one("own images along all axes", "images", [[0.1, 0.2, 0.3]], 0.8)
    yield one("two atoms, edges of 1.5 cutoffs", "images", [[0.1, 0.1, 0.1], [0.8, 0.9, 0.7]], 1.5)
    yield one("two atoms, edges of 0.6 cutoffs", "images", [[0.1, 0.1, 0.1], [0.3, 0.4, 0.5]], 0.6)
    yield one("one axis below two cutoffs", "images", gas(10, [1.7, 4.0, 4.0], 30), np.diag([1.7, 4.0, 4.0]))
    yield one(
        "one axis just below one cutoff", "images", gas(6, [0.96, 4.0, 4.0], 31), np.diag([0.96, 4.0, 4.0])
    )
    pair = [[0.0, 0, 0], [0.9, 0, 0]]
    yield one("one cell, both neighbors the same atom", "images", pair, np.diag([1.8, 5, 5]))
    for edge in (0.45, 0.7, 0.95, 1.9):
        walls = np.array([[0.02, 0.03, 0.02], [0.98, 0.97, 0.96]]) * edge
        yield one(f"two atoms at opposite walls, edges of {edge} cutoffs", "images", walls, edge)
    skewed = np.array([[1.4, 0, 0], [1.1, 1.2, 0], [-0.9, 0.8, 1.3]])
    yield one("small and skewed", "images", gas(4, skewed, 32), skewed)
    yield one("small and skewed, slab", "images", gas(4, skewed, 33), skewed, (True, True, False))
    cubic = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0.0]])
    yield one("four shells of a primitive cell", "images", [[0.0, 0, 0]], cubic, r_cut=3.05)
    yield one("many images along a needle", "images", gas(3, [0.3, 9.0, 9.0], 34), np.diag([0.3, 9.0, 9.0]))
    yield one("many images, far outside", "images", gas(4, 1.3, 35, -9.0, 9.0), 1.3)


def _outside() -> Iterator[Case]:
    inside = gas(24, 4.0, 40)
    shifts = np.random.default_rng(41).integers(-3, 4, inside.shape)
    yield one("lattice vectors added", "outside", inside + 4.0 * shifts, 4.0)
    yield one("all of one box over", "outside", inside + np.array([4.0, 0, 0]), 4.0)
    yield one("all of one box back", "outside", inside - [0, 4.0, 4.0], 4.0)
    yield one("a thousand boxes over", "outside", inside + 4000.0 * np.sign(shifts), 4.0)
    yield one(
        "one atom a million boxes over", "outside", [[1.0, 1, 1], [1.5 + 4e6, 1, 1], [1, 1.6, 1 - 8e6]], 4.0
    )
    skewed = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]])
    yield one("skewed, lattice vectors added", "outside", gas(24, skewed, 42) + shifts @ skewed, skewed)
    tilted = gas(8, skewed, 43) + 1000.0 * np.where([True, True, False], shifts[:8], 0) @ skewed
    yield one("skewed slab, a thousand boxes over", "outside", tilted, skewed, (True, True, False))
    beyond = np.where([True, False, True], 4.0 * shifts, 0.0)
    yield one("slab, lattice vectors added", "outside", inside + beyond, 4.0, (True, False, True))
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
        yield one(f"atoms at {word}", "outside", np.vstack([on, near, [[0.4, 0.4, 0.4]]]), 4.0)
    for edge in (4.0, 4.0 * (1 + 1e-9), 4.0 * (1 + 1e-6)):
        name = f"pairs a hair inside the cutoff, across walls of cells, edges {edge!r}"
        yield one(name, "outside", _across_walls(edge), [edge, 200.0, 200.0])
    third = 1.0 / 3.0
    yield one(
        "a face that no double holds",
        "outside",
        [[0.0, 1, 1], [3 * third * 2.1, 1, 1], [2.1 - 0.5, 1, 1]],
        2.1,
    )
    for edge in (2.1, 3.3, 4.7):
        grid = np.stack(np.meshgrid(*[np.arange(3) / 3 * edge] * 3, indexing="ij"), -1).reshape(-1, 3)
        yield one("a grid on the walls of the cells", "outside", grid, edge, r_cut=edge / 3 * 1.1)


def _across_walls(edge: float) -> np.ndarray:
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
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    yield one("whole numbers, first shell at the cutoff", "ties", grid, 4.0, r_cut=1.0)
    yield one(
        "whole numbers, 3-4-5", "ties", [[0.0, 0, 0], [3, 4, 0], [3, 4, 12], [0, 4, 3], [-5, 0, 0]], r_cut=5.0
    )
    through = [[0.0, 0, 0], [13, 12, 0], [4, 3, 0], [0, 0, 11]]
    yield one("whole numbers, 3-4-5 through faces", "ties", through, 16.0, r_cut=5.0)
    yield one("second shell at the cutoff, which is no double", "ties", grid, 4.0, r_cut=float(np.sqrt(2.0)))
    for ulps in (-2, -1, 0, 1, 2):
        r_cut = 2.5 + ulps * float(np.spacing(2.5))
        corner = [[1.0, 1, 1], [3.5, 1, 1], [1, 3.5, 1]]
        yield one(f"pairs {-ulps:+d} ulp from the cutoff", "ties", corner, 8.0, r_cut=r_cut)
    rng = np.random.default_rng(50)
    direction = rng.normal(size=(30, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    yield one(
        "30 atoms on a sphere of the cutoff", "ties", np.vstack([np.zeros((1, 3)), direction]) + 4.0, 9.0
    )
    yield one(
        "an image of itself at the cutoff", "ties", [[0.3, 0.3, 0.3]], np.diag([2.0, 7.0, 7.0]), r_cut=2.0
    )
    yield one("half of the box at the cutoff", "ties", [[0.0, 0, 0], [2.0, 0, 0]], 4.0, r_cut=2.0)


def _coincident() -> Iterator[Case]:
    yield one("two atoms in one place", "coincident", [[1.0, 1, 1], [1.0, 1, 1]], 5.0)
    yield one("two atoms in one place, free", "coincident", [[1.0, 1, 1], [1.0, 1, 1]])
    yield one("two atoms at the origin", "coincident", [[0.0, 0, 0], [0.0, 0, 0]], 5.0)
    yield one("in one place through the box", "coincident", [[0.0, 1, 1], [5.0, 1, 1], [0, 6, 1]], 5.0)
    yield one("in one place, five boxes apart", "coincident", [[0.5, 1, 1], [25.5, -24, 1]], 5.0)
    yield one("five atoms in one place", "coincident", np.tile([[2.0, 2.0, 2.0]], (5, 1)), 5.0)
    yield one("apart by 1e-300", "coincident", [[0.0, 0, 0], [1e-300, 0, 0], [0, 1e-200, 0]], 5.0)
    yield one("apart by an ulp", "coincident", [[1.0, 1, 1], [float(np.nextafter(1.0, 2.0)), 1, 1]], 5.0)
    yield one("pairs of coincident atoms", "coincident", np.repeat(gas(6, 4.0, 60), 2, axis=0), 4.0)
