"""Test cases for neighbor lists: past failures, clusters, lattices, and random cases.

For the tests of a library: `@given(cases())` draws test cases with all kinds of boxes and positions. Cutoffs
of the test cases are at and between neighbor shells. `boxes()` draws only (cell, pbc, description).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies as st
from numpy import ndarray

from mdnum.plain import beside
from mdnum.references.conformance.case import Case, Pbc, Still, gas, grid, once
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.motions import motions, movers, sequences
from mdnum.references.oracle import PairSet, completed, widths

#: (name, positions, cell, pbc, r_cut); the last entries may be omitted as in `once`.
Named = Iterator[tuple[Any, ...]]

SMALL_EDGE, LARGE_EDGE = 17, 47  # atoms along an edge of the lattices: some 5,000 atoms, and 100,000

BREADTH = 5  # cases of each area that are asked before the others: a verdict rests on these at least
_CHUNK = 500  # random cases that are drawn together, which takes a second or two

_WRITTEN = beside(__file__)
_TURN = np.array([[2.0, -2.0, 1.0], [1.0, 2.0, 2.0], [2.0, 1.0, -2.0]]) / 3.0


def catalog() -> Iterator[Case]:
    """Yield every named test case with one call."""
    computed = {"boxes": _boxes(), "axes": _axes(), "outside": _outside(), "ties": _ties()}
    for area in ("few", "boxes", "axes", "images", "outside", "ties", "coincident"):
        yield from (once(name, area, *rest) for name, *rest in computed.get(area, ()))
        for row in _WRITTEN.get(area, ()):
            given: dict[str, Any] = {word: row[word] for word in row if word != "gas"}
            if "gas" in row:
                count, *more = row["gas"]
                given["positions"] = gas(count, row["cell"], *more)
            yield once(area=area, **given)


def crowds() -> Iterator[Case]:
    """Yield test cases with very many neighbors per atom."""
    return (once(name, "crowded", *rest) for name, *rest in _crowds())


def _boxes() -> Named:
    for edge in (2.1, 2.5, 3.0, 3.9, 4.0, 4.1, 7.3):
        yield f"cube of {edge} cutoffs", gas(24, edge, 2), edge
    for share in (2.0 - 1e-9, 2.0 + 1e-9, 3.0 - 1e-9, 3.0 + 1e-9, 3.0, 4.0 - 1e-12):
        # the number of cells along an axis changes here, and rounding may take it from one to the other
        name = f"a box a hair from {round(share)} cells"
        yield name, gas(30, [share, 4.5, 3.5], 3), [share, 4.5, 3.5]
    for edge in (0.1, 0.3, 0.7):
        yield "edges that no double holds", gas(20, 3 * edge, 4), 3 * edge, True, edge * 1.2
    turned = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]]) @ _TURN
    yield "turned", gas(30, turned, 9), turned
    clump = gas(12, 1.5, 15)
    yield "huge", np.vstack([clump, clump + 49.2, clump + 99.0]), 100.0
    ulp = float(np.nextafter(4.0, 5.0))
    places = np.array([[0.0, 1, 1], [3.75, 1, 1], [2.0, 0, 0], [2.0, 3.5, 0], [0, 0, 2], [0, 0.5, 2]])
    below = float(np.nextafter(4.0, 0.0))
    for edge, name in ((4.0, "exactly 4"), (ulp, "4 and an ulp"), (below, "an ulp below 4")):
        yield f"pairs through faces, edges {name}", places, edge


def _axes() -> Named:
    yield "pairs a hair inside the cutoff, across walls of cells, free", _across_walls()
    for pbc in ((True, True, False), (True, False, False), (False, True, True), (False, False, True)):
        word = "".join(letter for letter, repeats in zip("xyz", pbc, strict=True) if repeats)
        edges = np.array([4.0, 4.5, 5.0])
        yield f"repeats along {word}", gas(24, edges, 20), np.diag(edges), pbc
        beyond = gas(24, edges, 21, -0.6, 1.6)
        beyond = np.where(pbc, np.mod(beyond, edges), beyond)
        yield f"repeats along {word}, atoms past the free faces", beyond, np.diag(edges), pbc
        zero = np.diag(np.where(pbc, edges, 0.0))
        yield f"repeats along {word}, no vectors along the rest", gas(24, edges, 22), zero, pbc


def _outside() -> Named:
    hair = "pairs a hair inside the cutoff, across walls of cells, edges {!r}"
    # early: it shows whether positions are rounded to float32
    yield hair.format(4.0), _across_walls(), [4.0, 200.0, 200.0]
    inside = gas(24, 4.0, 40)
    shifts = np.random.default_rng(41).integers(-3, 4, inside.shape)
    yield "lattice vectors added", inside + 4.0 * shifts, 4.0
    yield "all of one box over", inside + np.array([4.0, 0, 0]), 4.0
    yield "all of one box back", inside - [0, 4.0, 4.0], 4.0
    yield "a thousand boxes over", inside + 4000.0 * np.sign(shifts), 4.0
    yield "one atom a million boxes over", [[1.0, 1, 1], [1.5 + 4e6, 1, 1], [1, 1.6, 1 - 8e6]], 4.0
    skewed = np.array([[4.0, 0, 0], [1.9, 4.0, 0], [-1.7, 1.5, 4.0]])
    yield "skewed, lattice vectors added", gas(24, skewed, 42) + shifts @ skewed, skewed
    tilted = gas(8, skewed, 43) + 1000.0 * np.where([True, True, False], shifts[:8], 0) @ skewed
    yield "skewed slab, a thousand boxes over", tilted, skewed, (True, True, False)
    beyond = np.where([True, False, True], 4.0 * shifts, 0.0)
    yield "slab, lattice vectors added", inside + beyond, 4.0, (True, False, True)
    below, above, least = np.nextafter(4.0, 0.0), np.nextafter(4.0, 9.0), -np.spacing(4.0)
    for place, word in (
        (0.0, "0"), (4.0, "L"), (-0.0, "-0"), (-1e-52, "-1e-52"), (-1e-17, "-1e-17"), (-1e-9, "-1e-9"),
        (below, "an ulp below L"), (above, "an ulp above L"), (-4.0, "-L"), (8.0, "2 L"),
        (least, "minus an ulp of L"),
    ):  # fmt: skip
        near = np.array([[0.5, 2, 2], [3.5, 2, 2], [2, 0.5, 2], [2, 3.5, 2], [2, 2, 0.5], [2, 2, 3.5]])
        on = np.array([[place, 2, 2], [2, place, 2], [2, 2, place], [place, place, place]])
        yield f"atoms at {word}", np.vstack([on, near, [[0.4, 0.4, 0.4]]]), 4.0
    yield hair.format(stretched := 4.0 * (1 + 1e-9)), _across_walls(), [stretched, 200.0, 200.0]
    yield hair.format(stretched := 4.0 * (1 + 1e-6)), _across_walls(), [stretched, 200.0, 200.0]
    face = [[0.0, 1, 1], [3 * (1.0 / 3.0) * 2.1, 1, 1], [2.1 - 0.5, 1, 1]]
    yield "a face that no double holds", face, 2.1
    for edge in (2.1, 3.3, 4.7):
        yield "a grid on the walls of the cells", grid(3) / 3 * edge, edge, True, edge / 3 * 1.1


def _across_walls() -> ndarray:
    """Return pairs of atoms along x, slightly less than r_cut apart, near multiples of r_cut.

    After rounding to float32, the atoms of a pair may be two grid cells apart.
    """
    hairs = (1e-6, 5.5e-8, 1e-9, 3e-12, 2e-16)
    pairs = []
    for wall in range(1, 5):
        for n, below in enumerate(hairs):
            for k, hair in enumerate(hairs):
                first = np.array([wall - below, 6.0 * (5 * wall - 4 + n), 6.0 * (1 + k)])
                pairs += [first, first - [1.0 - hair, 0.0, 0.0]]
    return np.array(pairs)


def _ties() -> Named:
    whole = grid(4).astype(float)
    yield "whole numbers, first shell at the cutoff", whole, 4.0, True, 1.0
    yield "second shell at the cutoff, which is no double", whole, 4.0, True, float(np.sqrt(2.0))
    for ulps in (-2, -1, 0, 1, 2):
        r_cut = 2.5 + ulps * float(np.spacing(2.5))
        corner = [[1.0, 1, 1], [3.5, 1, 1], [1, 3.5, 1]]
        yield f"pairs {-ulps:+d} ulp from the cutoff", corner, 8.0, True, r_cut
    yield "30 atoms on a sphere of the cutoff", np.vstack([np.zeros((1, 3)), _sphere(30)]) + 4.0, 9.0


def _crowds() -> Named:
    for count in (20, 33, 41, 66, 130, 260):
        cluster = 5.0 + 0.45 * gas(count, 1.0, 70 + count, -1.0, 1.0)
        yield f"{count} atoms in one clump", cluster, 12.0, True, 1.6
    for count in (150, 520):
        around = np.vstack([np.zeros((1, 3)), 0.97 * _sphere(count)])
        yield f"{count} neighbors on one atom", around + 4.0, 9.0
    thin = gas(300, 24.0, 71)
    clump = 12.0 + 0.3 * gas(60, 1.0, 72, -1.0, 1.0)
    yield "a clump in a thin gas", np.vstack([thin, clump]), 24.0
    yield "a clump in a thin gas, first in the file", np.vstack([clump, thin]), 24.0
    yield "a clump and emptiness, free", np.vstack([clump, thin[:5] * 40.0])
    yield "a crystal with 86 neighbors", grid(6) + 0.3, 6.0, True, 2.85
    small = gas(3, 0.9, 73)
    yield "three atoms with hundreds of images", small, 0.9, True, 3.5


def vast() -> Iterator[Case]:
    """Yield test cases whose box is too large for a simple grid of cells.

    Each test case with a very large cell volume runs in a separate process.
    """
    apart = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [700.0, 2500.0, 2400.0], [700.5, 2500.0, 2400.0]])
    yield once("two pairs thousands of cutoffs apart, free", "axes", apart)
    yield once("two pairs thousands of cutoffs apart, along a wire", "axes", apart, 3.0, (False, False, True))
    yield once("a box of thousands of cutoffs", "boxes", apart + 1.0, 4000.0)


def lattice(edge: int, seed: int = 0) -> Case:
    """Return atoms on a cubic lattice with vacancies, in random order and random periodic images.

    The neighbors of each atom are on the 26 sites around it. Expected neighbors follow from site indices,
    without rounding.

    Args:
        edge: number of sites along an edge.
        seed: random seed for vacancies, order and images.
    """
    rng = np.random.default_rng(seed)
    places = grid(edge)
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


def _sphere(count: int) -> ndarray:
    """Return directions spread evenly over a sphere (Fibonacci sphere)."""
    k = np.arange(count) + 0.5
    height, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)


# --- cases drawn at random ---

#: Kinds of boxes and of positions of atoms, used in the names of cases.
SHAPES = ("cube", "orthorhombic", "skewed", "strongly skewed", "turned", "left-handed")
SIZES = ("ordinary", "wide", "thin", "two cutoffs", "narrow", "long", "huge")
PLACES = (
    "inside", "outside", "far outside", "on walls", "clustered", "coincident", "on a grid", "at the cutoff"
)  # fmt: skip
#: Lengths of all edges, and of a single randomly drawn edge, in cutoffs.
_EDGES = {"wide": (6.0, 15.0), "narrow": (0.6, 2.0), "huge": (20.0, 45.0)}
_ONE_EDGE = {"thin": (0.5, 2.2), "long": (30.0, 120.0)}

_FEW_IMAGES = 400  # lattice vectors that the oracle may have to try for a pair


@st.composite
def boxes(draw: Any, r_cut: float = 1.0) -> tuple[ndarray, Pbc, str]:
    """Draw a random box as (cell, pbc, description), with lattice vectors as rows.

    Args:
        r_cut: cutoff (length) to which the size of the box is relative.
    """
    shape, size = draw(st.sampled_from(SHAPES)), draw(st.sampled_from(SIZES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    pbc = draw(st.one_of(st.just((True, True, True)), st.tuples(st.booleans(), st.booleans(), st.booleans())))
    edges = _edges(size, rng)
    if shape == "cube":
        edges = np.full(3, edges[rng.integers(3)])
    cell = np.diag(edges)
    if "skewed" in shape or shape in ("turned", "left-handed"):
        most = 2.5 if shape == "strongly skewed" else 0.6
        tilt = rng.uniform(-most, most, 3)
        # each vector leans by so many lengths of the vectors before it
        cell[1, 0], cell[2, 0], cell[2, 1] = tilt * [edges[0], edges[0], edges[1]]
    if shape == "turned":
        cell = cell @ _rotation(rng)
    if shape == "left-handed":
        cell = cell[[1, 0, 2]]
    cell = r_cut * cell
    empty = draw(st.sampled_from(("kept", "none", "dummy")))
    free = ~np.array(pbc)
    if empty == "none":
        cell[free] = 0.0
    elif empty == "dummy" and free.all():
        cell = np.eye(3)
    return cell, pbc, f"{shape}, {size}"


def _edges(size: str, rng: np.random.Generator) -> ndarray:
    """Return random edge lengths of a box in units of the cutoff."""
    edges = rng.uniform(2.05, 6.0, 3)
    axis = rng.integers(3)
    if size == "two cutoffs":
        # where numbers of cells and of images change
        return rng.integers(2, 6, 3) * (1.0 + rng.choice([-1e-9, -1e-15, 0.0, 1e-15, 1e-9], 3))
    if size in _ONE_EDGE:
        edges[axis] = rng.uniform(*_ONE_EDGE[size])
    return rng.uniform(*_EDGES[size], 3) if size in _EDGES else edges


@st.composite
def cases(draw: Any, most: int = 40) -> Case:
    """Draw a random test case with one call and at most `most` atoms."""
    scale = draw(st.sampled_from((1.0, 1.0, 1.0, 2.5, 6.0, 0.1, 3.405)))
    cell, pbc, words = draw(boxes(scale))
    place = draw(st.sampled_from(PLACES))
    count = draw(st.sampled_from((1, 2, 3, 4, 6, 9, 14, 22, 40)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    vectors = _images(cell, pbc, scale)
    count = min(count, most, max(1, round((200_000 / vectors) ** 0.5)))
    if vectors > _FEW_IMAGES:
        # too many for brute force: the same box, each side at least as wide as the cutoff
        cell, pbc, words = np.eye(3) * scale * rng.uniform(1.0, 4.0), (True, True, True), "cube, ordinary"
    positions, r_cut = _positions(place, count, cell, np.array(pbc), scale, rng)
    return once(f"{words}, atoms {place}", "random", positions, cell, pbc, r_cut)


def _images(cell: ndarray, pbc: Pbc, r_cut: float) -> int:
    """Return the number of periodic images to search along each direction."""
    if not any(pbc):
        return 1
    width = widths(completed(cell, np.array(pbc)))
    return int(np.prod(np.where(pbc, 2 * (np.floor(1.1 * r_cut / width) + 1) + 1, 1)))


def _positions(
    place: str, count: int, cell: ndarray, pbc: ndarray, r_cut: float, rng: np.random.Generator
) -> tuple[ndarray, float]:
    """Return positions and a cutoff. If `place` is "at the cutoff", the cutoff equals a pair distance."""
    full = completed(cell, pbc)
    # free axes have vectors of length 1, which would be no room
    room = np.where(pbc, 1.0, np.maximum(1.0, 3.0 * r_cut / np.linalg.norm(full, axis=1)))
    fractions = rng.uniform(0.0, 1.0, (count, 3)) * room
    if place == "on walls":
        fractions = room * rng.integers(0, 5, (count, 3)) / 4.0
    if place == "on a grid":
        edge = max(1, round(count ** (1 / 3)))
        fractions = room * rng.integers(0, edge + 1, (count, 3)) / edge
    positions = fractions @ full
    if place == "clustered":
        positions = positions[:1] + r_cut * rng.uniform(-0.7, 0.7, (count, 3))
    if place == "coincident":
        positions[count // 2 :] = positions[: count - count // 2]
    if place in ("outside", "far outside", "coincident"):
        many = 1000 if place == "far outside" else 2
        positions = positions + np.where(pbc, rng.integers(-many, many + 1, (count, 3)), 0) @ full
    if place == "outside":
        positions = positions - np.where(pbc, 0.0, rng.uniform(-5, 5, 3)) @ full
    if place == "at the cutoff" and count > 1:
        # a pair whose distance, as float64 computes it, is the cutoff or a few ulps off
        step = positions[1] - positions[0]
        length = float(np.linalg.norm(step))
        target = r_cut * rng.uniform(0.9, 1.0)
        if length > 0:
            positions[1] = positions[0] + step * (target / length)
            r_cut = float(np.linalg.norm(positions[1] - positions[0]))
            r_cut += int(rng.integers(-3, 4)) * float(np.spacing(r_cut))
    return positions, r_cut


def _rotation(rng: np.random.Generator) -> ndarray:
    """Return a uniformly distributed random rotation matrix."""
    turned, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    turned = turned * np.sign(np.diag(upper))
    return turned if np.linalg.det(turned) > 0 else turned[[1, 0, 2]]


def plan(
    tested: PairList,
    count: int,
    seed: int,
    padding: float | None = None,
    *,
    far: bool = False,
    large: bool = False,
) -> list[tuple[int, Iterable[Case]]]:
    """Return groups of test cases as tuples (number of cases, cases).

    Up to `BREADTH` named test cases of each area precede random and large test cases.

    Args:
        count: number of random cases.
        seed: seed of the random cases.
        padding: padding of an updatable list, in skins, if known; see `motions`.
        far: include cases in which a cell grid over the whole volume exceeds the memory and ends the process.
        large: include cases with 5,000 and 100,000 atoms.
    """
    named = [*movers(), *motions(padding)] if tested.kept else []
    named += as_kept(tested, catalog())
    named += [] if tested.kept else sequences()
    named += as_kept(tested, crowds())
    met: Counter[str] = Counter()
    first, rest = list[Case](), list[Case]()
    for case in named:
        (first if met[case.area] < BREADTH else rest).append(case)
        met[case.area] += 1
    count = max(1, round(count * tested.affords)) if count else 0
    chunks = ((min(_CHUNK, count - n), seed + n) for n in range(0, count, _CHUNK))
    random = (case for chunk in chunks for case in as_kept(tested, drawn(*chunk)))
    last = list(as_kept(tested, vast())) if far else []
    parts = [(len(first), first), (len(rest), rest), (count, random), (len(last), last)]
    return [*parts, (2, lattices())] if large else parts


def questions(
    tested: PairList, count: int, seed: int, padding: float | None = None, far: bool = False
) -> list[Case]:
    """Return all test cases of `plan` except those with thousands of atoms."""
    return [case for _, part in plan(tested, count, seed, padding, far=far) for case in part]


def lattices() -> Iterator[Case]:
    """Yield test cases of lattices with 5,000 and 100,000 atoms."""
    return map(lattice, (SMALL_EDGE, LARGE_EDGE))


def as_kept(tested: PairList, asked: Iterable[Case]) -> Iterator[Case]:
    """Yield the test cases, with a skin of 0.3 r_cut for updatable lists."""
    for case in asked:
        yield replace(case, skin=0.3 * case.r_cut) if tested.kept else case


def drawn(count: int, seed: int) -> list[Case]:
    """Return test cases drawn by hypothesis. The same seed always gives the same test cases."""
    collected: list[Case] = []
    checks: Any = list(hypothesis.HealthCheck)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=checks,
        derandomize=False,
    )
    @hypothesis.given(cases())
    def draw(case: Case) -> None:
        collected.append(case)

    draw()
    return collected[:count]


def alike(case: Case) -> Iterator[tuple[str, bool, Case]]:
    """Yield variants of a test case: (description, whether neighbors stay the same, variant)."""
    yield "when it is asked anew", True, case
    if case.atoms > 1:
        yield "with its atoms in reverse order", True, case.only(np.arange(case.atoms)[::-1])
    if case.steps > 1:
        yield "of a list that is made anew at that step", False, replace(case, stills=case.stills[-1:])
    power = float(np.ldexp(1.0, 1 - int(np.frexp(case.r_cut)[1])))
    if power != 1.0:  # of two, which rounds nothing
        scaled = case.changed(lambda x: power * x, lambda cell: power * cell, r_cut=power * case.r_cut)
        stills = tuple(
            replace(still, skin=None if still.skin is None else power * still.skin) for still in scaled.stills
        )
        scaled = replace(scaled, stills=stills, skin=power * case.skin)
        yield f"with all lengths multiplied by {power:.2g}", False, scaled
    wrapped = replace(
        case, stills=tuple(_wrapped(still, np.array(case.pbc)) for still in case.stills), known=None
    )
    if not wrapped.equals(case):
        yield "with its atoms wrapped into the box", False, wrapped


def _wrapped(still: Still, pbc: ndarray) -> Still:
    """Return the atoms at one call, wrapped into the box."""
    if not pbc.any() or not len(still.positions):
        return still
    matrix = completed(still.cell, pbc)
    fractions = np.linalg.solve(matrix.T, still.positions.T).T
    home = still.positions - np.where(pbc, np.floor(fractions), 0.0) @ matrix
    # an atom a hair below a face is wrapped onto the one across, by rounding
    over = np.where(pbc, np.linalg.solve(matrix.T, home.T).T >= 1.0, False)
    return replace(still, positions=home - np.where(over, 1.0, 0.0) @ matrix)
