"""The cases that a list is asked: named ones, sequences of motion, crowds, and those drawn by hypothesis.

For a library's own tests: `@given(cases())` gives cases of boxes of every kind, atoms in every place and
cutoffs on and off the shells; `boxes()` gives (cell, pbc, words) alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies as st
from numpy import ndarray

from mdnum.references.conformance.case import Case, Pbc, once
from mdnum.references.conformance.catalog import LARGE_EDGE, SMALL_EDGE, catalog, crowds, lattice, vast
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.motions import motions, movers, sequences
from mdnum.references.oracle import completed, widths

#: Kinds of boxes, and of places of atoms, that a case is named after.
SHAPES = ("cube", "orthorhombic", "skewed", "strongly skewed", "turned", "left-handed")
SIZES = ("ordinary", "wide", "thin", "two cutoffs", "narrow", "long", "huge")
PLACES = (
    "inside",
    "outside",
    "far outside",
    "on walls",
    "clustered",
    "coincident",
    "on a grid",
    "at the cutoff",
)

_FEW_IMAGES = 400  # lattice vectors that the oracle may have to try for a pair


@st.composite
def boxes(draw: Any, r_cut: float = 1.0) -> tuple[ndarray, Pbc, str]:
    """(cell, pbc, words): lattice vectors as rows, which of them repeat, and what is special.

    Args:
        r_cut: cutoff that sizes are relative to, length.
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
    """Lengths of the edges in units of the cutoff."""
    edges = rng.uniform(2.05, 6.0, 3)
    axis = rng.integers(3)
    if size == "wide":
        edges = rng.uniform(6.0, 15.0, 3)
    elif size == "thin":
        edges[axis] = rng.uniform(0.5, 2.2)
    elif size == "two cutoffs":
        # where numbers of cells and of images change
        edges = rng.integers(2, 6, 3) * (1.0 + rng.choice([-1e-9, -1e-15, 0.0, 1e-15, 1e-9], 3))
    elif size == "narrow":
        edges = rng.uniform(0.6, 2.0, 3)
    elif size == "long":
        edges[axis] = rng.uniform(30.0, 120.0)
    elif size == "huge":
        edges = rng.uniform(20.0, 45.0, 3)
    return edges


@st.composite
def cases(draw: Any, most: int = 40) -> Case:
    """A question at one moment.

    Args:
        most: largest number of atoms.
    """
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
    """Lattice vectors within reach of a pair."""
    if not any(pbc):
        return 1
    width = widths(completed(cell, np.array(pbc)))
    return int(np.prod(np.where(pbc, 2 * (np.floor(1.1 * r_cut / width) + 1) + 1, 1)))


def _positions(
    place: str, count: int, cell: ndarray, pbc: ndarray, r_cut: float, rng: np.random.Generator
) -> tuple[ndarray, float]:
    """Coordinates, and the cutoff: moved onto a distance where that is what is asked about."""
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
    """A rotation drawn evenly."""
    turned, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    turned = turned * np.sign(np.diag(upper))
    return turned if np.linalg.det(turned) > 0 else turned[[1, 0, 2]]


def questions(
    tested: PairList, count: int, seed: int, padding: float | None = None, far: bool = False
) -> list[Case]:
    """The cases that a list is asked, in order, but for those of thousands of atoms (`large`).

    Args:
        count: random cases.
        seed: of the random cases.
        padding: of a list that is kept, in skins, where it is known; see `motions`.
        far: those, too, that end a process which makes a grid of cells over all space.
    """
    asked = [*movers(), *motions(padding)] if tested.kept else []
    asked += as_kept(tested, catalog())
    asked += [] if tested.kept else sequences()
    asked += as_kept(tested, crowds())
    asked += as_kept(tested, drawn(max(1, round(count * tested.affords)), seed) if count else ())
    return asked + list(as_kept(tested, vast())) if far else asked


def large() -> Iterator[Case]:
    """5,000 and 100,000 atoms."""
    return map(lattice, (SMALL_EDGE, LARGE_EDGE))


def as_kept(tested: PairList, asked: Iterable[Case]) -> Iterator[Case]:
    """Questions at one moment, with a skin for a list that is kept."""
    for case in asked:
        yield replace(case, skin=0.3 * case.r_cut) if tested.kept else case


def drawn(count: int, seed: int) -> list[Case]:
    """Cases that hypothesis draws, the same for the same seed."""
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
