"""Motions against the rule by which a list that is kept is rebuilt: the smallest that make it miss a pair.

A pair that was beyond r_cut + padding when the list was built is inside the cutoff once its two atoms have
come closer by the padding, and no motion that takes it there is smaller than the straight one. A rule that
asks whether two atoms could have used up the padding rebuilds before that, whichever way they went, however
they shared it and whatever the others did. So each motion here closes a pair by the padding and a hair: along
axes, diagonals and no axis; by both atoms or one; alone, among atoms at rest, among others that do the same
or in a common drift; at once, creeping, and back and forth.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case, script
from mdnum.references.conformance.catalog import gas

_R, _SKIN = 1.0, 0.3
#: What a pair starts beyond the padding and ends inside the cutoff by, in paddings.
HAIR = 2e-3
#: Of a ladder, in paddings: which of them a list has that shows no pairs of its skin is not known.
_RUNGS = np.geomspace(0.25, 3.0, 20)
_BEYOND = int((_RUNGS >= 1).sum())  # of a list that has the padding it is taken to have
#: What the atom of a pair that is named first does of the motion.
_SHARES = (0.5, 1.0, 0.0, 0.3, 0.7)


def motions(padding: float | None = None) -> Iterator[Case]:
    """Scripts of motions, the short ones first; `Case.motions` counts them.

    Args:
        padding: that the list was seen to have, or says that it has, in units of the skin that it is given;
            None where neither: what it is given is tried first, and a ladder of others.
    """
    room = _SKIN * (padding or 1.0)
    edge = max(6.0, 2.6 * (_R + room))
    ways = _ways()
    for share in _SHARES:
        words = f"the smallest motions of a pair, {share:.0%} by its first atom"
        yield _chain(words, (_meeting(room, way, share, edge, n) for n, way in enumerate(ways)), edge)
    some = [ways[n] for n in (0, 2, 5, 9, 13)]
    for share in (0.5, 1.0):
        paths = [_walk(room, way, share, edge, n, np.linspace(0, 1, 8)) for n, way in enumerate(some)]
        yield _script(f"pairs that creep together, {share:.0%} by the first atom", paths, edge)
    back = (0.0, 0.45, -0.45, 0.9, -0.9, 1.0)
    paths = [_walk(room, way, 0.5, edge, n, back) for n, way in enumerate(some)]
    yield _script("pairs that go back and forth, then together", paths, edge)
    for share in (0.5, 1.0):
        words = f"a pair among 40 atoms at rest, {share:.0%} by its first atom"
        yield _chain(words, (_among(room, way, share, edge, n) for n, way in enumerate(ways)), edge)
    yield _chain(
        "a pair comes together while all atoms drift",
        (_adrift(room, way, edge, n) for n, way in enumerate(ways)),
        edge,
    )
    for share in (0.5, 0.3):
        words = f"twelve pairs at once, {share:.0%} by their first atoms"
        yield _chain(words, (_dozen(room, way, share, n) for n, way in enumerate(ways[::2])), 12.0)
    yield _in_turn(room, ways)
    leaning = edge * np.array([[1.0, 0, 0], [0.45, 1.0, 0], [-0.35, 0.4, 1.0]])
    for cell, word in ((leaning, "a skewed box"), (np.diag([4 * edge, edge, edge]), "a long box")):
        along = [*ways, *(row / np.linalg.norm(row) for row in cell)]
        pairs = (_meeting(room, way, 0.5, edge, n) for n, way in enumerate(along))
        yield _chain(f"the smallest motions of a pair, {word}", pairs, cell)
    if padding is None or abs(padding - 1.0) < 0.02:
        for skin in (0.08, 1.0):
            pairs = (_meeting(skin, way, 0.5, edge, n) for n, way in enumerate(ways))
            yield _chain(f"the smallest motions of a pair, a skin of {skin}", pairs, edge, skin)
    for n in (0, 4, 9, 13) if padding is None else (9,):
        yield _ladder(room, ways[n], n)
        for share in (1.0, 0.5):
            yield _one_by_one(room, ways[n], share, n)


def _ways() -> list[ndarray]:
    """Unit vectors: axes, diagonals of faces and of the cube, and three of no kind."""
    found = [np.array(way, float) for way in itertools.product((-1, 0, 1), repeat=3) if way > (0, 0, 0)]
    found.sort(key=lambda way: (np.count_nonzero(way), tuple(-way)))
    found += list(np.random.default_rng(140).normal(size=(3, 3)))
    return [way / np.linalg.norm(way) for way in found]


def _apart(room: float) -> float:
    """Where a pair starts: beyond the list, by a hair."""
    return _R + (1 + HAIR) * room


def _closing(room: float) -> float:
    """What takes it inside the cutoff, by a hair."""
    return (1 + 2 * HAIR) * room


def _meeting(room: float, way: ndarray, share: float, edge: float, n: int) -> tuple[ndarray, ndarray]:
    """Two atoms somewhere, before and after they came together."""
    path = _walk(room, way, share, edge, n, (0.0, 1.0))
    return path[0], path[1]


def _walk(
    room: float, way: ndarray, share: float, edge: float, n: int, closed: Iterable[float]
) -> list[ndarray]:
    """Two atoms somewhere, closed by so many of the smallest motion."""
    middle = edge * np.random.default_rng(150 + n).uniform(0.2, 0.8, 3)
    start = np.array([middle - _apart(room) / 2 * way, middle + _apart(room) / 2 * way])
    moves = _closing(room) * np.array([share * way, (share - 1.0) * way])
    return [start + part * moves for part in closed]


def _among(room: float, way: ndarray, share: float, edge: float, n: int) -> tuple[ndarray, ndarray]:
    """Two atoms that come together, wherever they are in the file, and 40 at rest."""
    first, second = (n * 11) % 42, (n * 17 + 23) % 42
    second = (second + 1) % 42 if second == first else second
    start = gas(42, edge, 160 + n)
    pair = _walk(room, way, share, edge, n, (0.0, 1.0))
    start[[first, second]] = pair[0]
    end = start.copy()
    end[[first, second]] = pair[1]
    return start, end


def _adrift(room: float, way: ndarray, edge: float, n: int) -> tuple[ndarray, ndarray]:
    """The same among ten atoms, all of which drift: across the motion, along it, by much and by little."""
    start = gas(12, edge, 180 + n)
    pair = _walk(room, way, 0.5, edge, n, (0.0, 1.0))
    start[4:6] = pair[0]
    end = start.copy()
    end[4:6] = pair[1]
    across = np.cross(way, np.roll(way, 1) + np.array([0.3, -0.2, 0.1]))
    across /= np.linalg.norm(across)
    drift = (4 * across, 0.5 * way, 4 * way, 0.5 * across)[n % 4]
    return start, end + room * drift


def _dozen(room: float, way: ndarray, share: float, n: int) -> tuple[ndarray, ndarray]:
    """Twelve pairs in places of their own, all of which do the same."""
    places = _places(12, 12.0, n)
    start = np.vstack([places - _apart(room) / 2 * way, places + _apart(room) / 2 * way])
    moves = _closing(room) * np.vstack([np.tile(share * way, (12, 1)), np.tile((share - 1.0) * way, (12, 1))])
    return start, start + moves


def _in_turn(room: float, ways: list[ndarray]) -> Case:
    """25 pairs, whose 50 atoms go one after the other: who is not looked at is found."""
    count = 25
    places = _places(count, 15.0, 0)
    way = np.array([ways[n % len(ways)] for n in range(count)])
    start = np.vstack([places - _apart(room) / 2 * way, places + _apart(room) / 2 * way])
    # a pair that has come together is far from its next turn: the second atom comes from beyond again
    path = [start]
    for atom in range(2 * count):
        moved = path[-1].copy()
        pair, sign = atom % count, 1.0 if atom < count else -1.0
        if atom == count:
            # all anew, so that every rule rebuilds
            moved = start + np.array([2.0, 1.0, -1.5])
            path.append(moved)
            moved = moved.copy()
        moved[atom] += sign * _closing(room) * way[pair]
        path.append(moved)
    made = script("50 atoms, each of them comes to another in its turn", "rule", path, 15.0, _R, _SKIN)
    return replace(made, motions=2 * count)


def _ladder(room: float, way: ndarray, n: int) -> Case:
    """Pairs from near and far creep together: each comes inside when its own start is just used up."""
    places = _places(len(_RUNGS), 12.0, n)
    rungs = room * _RUNGS[:, None]
    path = []
    for closed in (0.0, *_RUNGS):
        half = (_R + (1 + HAIR) * rungs - (1 + 2 * HAIR) * room * closed) / 2 * way
        path.append(np.vstack([places - half, places + half]))
    made = script(f"pairs from near and far creep together, {_told(way)}", "rule", path, 12.0, _R, _SKIN)
    return replace(made, motions=_BEYOND)


def _one_by_one(room: float, way: ndarray, share: float, n: int) -> Case:
    """The same pair by pair, each back to its place before the next: by one atom of it, or by both."""
    places, count = _places(len(_RUNGS), 12.0, n + 1), len(_RUNGS)
    half = (_R + (1 + HAIR) * room * _RUNGS[:, None]) / 2 * way
    start = np.vstack([places - half, places + half])
    path = [start]
    for rung, far in enumerate(_RUNGS):
        moved = start.copy()
        turned = (rung + n) % 2
        first, second = (rung, rung + count) if turned else (rung + count, rung)
        toward = (1.0 if turned else -1.0) * (1 + 2 * HAIR) * room * far * way
        moved[first] += share * toward
        moved[second] -= (1 - share) * toward
        path.append(moved)
    name = f"pairs from near and far, one by one, {share:.0%} by an atom, {_told(way)}"
    return replace(script(name, "rule", path, 12.0, _R, _SKIN), motions=_BEYOND)


def _told(way: ndarray) -> str:
    return f"along ({', '.join(f'{part:.2g}' for part in way)})"


def _places(count: int, edge: float, n: int) -> ndarray:
    """Places of their own for pairs, in an order that is not that of space."""
    side = int(np.ceil(count ** (1 / 3)))
    grid = (np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / side
    return edge * np.random.default_rng(200 + n).permutation(grid)[:count]


def _chain(
    name: str, pairs: Iterable[tuple[ndarray, ndarray]], cell: float | ndarray, skin: float = _SKIN
) -> Case:
    """Motions one after the other: between them all atoms go elsewhere, which no rule overlooks."""
    return _script(name, [[start, end] for start, end in pairs], cell, skin)


def _script(name: str, paths: list[list[ndarray]], cell: float | ndarray, skin: float = _SKIN) -> Case:
    made = script(name, "rule", [still for path in paths for still in path], cell, _R, skin)
    return replace(made, motions=len(paths))
