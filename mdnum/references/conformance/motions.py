"""Sequences of the smallest motions that require a rebuild of a neighbor list.

Two atoms start just beyond r_cut + padding. After they approach by the padding, they are inside the cutoff.
The smallest such motion is along the line between the atoms. A rebuild criterion must detect every approach
of two atoms by the padding. Each sequence brings a pair closer by slightly more than the padding. Sequences
differ in direction (axis, diagonal, random), in the division of the motion between the two atoms, and in time
(one step, slowly, back and forth). There are no other atoms, or they rest, move slightly or drift together.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case, gas, grid, matrix, sequence

#: (name, path, cell, and further arguments of `sequence` if they differ from the defaults).
Script = Iterator[tuple[Any, ...]]

_R, _SKIN, _L = 1.0, 0.3, 6.0
_MIDDLE = np.array([3.0, 3.0, 3.0])
HAIR = 2e-3  # what a pair starts beyond the padding and ends inside the cutoff by, in paddings
#: Tested values of an unknown padding, in multiples of the given skin, for a list that does not show pairs in
#: its skin.
_RUNGS = np.geomspace(0.25, 3.0, 20)
_BEYOND = int((_RUNGS >= 1).sum())  # of a list that has the padding it is taken to have
_SHARES = (0.5, 1.0, 0.0, 0.3, 0.7)  # what the atom of a pair that is named first does of the motion
#: Number of atoms, and displacement of the other atoms, in paddings.
_AMONG = ((42, 0.0), (300, 0.0), (300, 0.01), (300, 0.04), (1_200, 0.01))
_GOLDEN = 0.6180339887498949  # its multiples, modulo 1, are spread evenly


def movers() -> Iterator[Case]:
    """Yield motion sequences for an updatable neighbor list, short sequences first."""
    areas = {_pairs: "motion", _many: "motion", _wrapping: "wrapping", _strain: "strain"}
    for scripts, area in areas.items():
        yield from (sequence(name, area, path, *rest) for name, path, *rest in scripts())
    yield from _narrow()
    yield from _reuse()


def sequences() -> Iterator[Case]:
    """Yield sequences for a neighbor list that is built at each call and must not keep a state."""
    for case in _reuse():
        yield replace(case, skin=0.0)


def _two(apart: float) -> ndarray:
    half = np.array([apart / 2, 0.0, 0.0])
    return np.array([_MIDDLE - half, _MIDDLE + half])


def _beside(apart: float) -> ndarray:
    """Return two atoms at a given distance along x. The first is at `_MIDDLE`."""
    return np.array([_MIDDLE, _MIDDLE + np.array([apart, 0, 0])])


def _how(steps: int) -> str:
    return "at once" if steps == 1 else f"in {steps} steps"


def _pairs() -> Script:
    apart = _R + 1.01 * _SKIN
    for share, steps in ((0.9, 1), (0.6, 1), (0.51, 1), (0.9, 9), (0.6, 20)):
        how = "in one step" if steps == 1 else _how(steps)
        path = [_two(apart - 2 * share * _SKIN * k / steps) for k in range(steps + 1)]
        yield f"two atoms head-on, each by {share} skins {how}", path, _L
    yield "two atoms creep together, 120 steps", [_two(apart - 0.02 * _SKIN * k) for k in range(120)], _L
    path = [_beside(apart - 1.1 * _SKIN * k / 10) for k in range(11)]
    yield "one atom comes to another at rest", path, _L
    others = gas(12, _L, 80)
    others = others[np.linalg.norm(others - _MIDDLE, axis=1) > 2.0]
    path = [np.vstack([_two(apart - 0.09 * _SKIN * k), others]) for k in range(14)]
    yield "two atoms head-on among others at rest", path, _L
    yield "two atoms part slowly", [_beside(0.9 + 0.01 * k) for k in range(40)], _L
    out = [_beside(apart)] * 3
    yield "an atom jumps in and out", [*out, _beside(0.5), *out], _L


def _many() -> Script:
    start = gas(40, _L, 81)
    yield "nothing moves", [start] * 5, _L
    drift = np.array([0.011, 0.007, -0.005])
    yield "all atoms drift slowly", [start + k * drift for k in range(120)], _L
    speeds = np.random.default_rng(82).normal(size=start.shape)
    speeds /= np.linalg.norm(speeds, axis=1)[:, None]
    for step, steps in ((0.01, 110), (0.03, 60), (0.1, 20), (0.4, 8), (2.5, 5)):
        yield f"a gas, {step} r_cut at a step", [start + k * step * speeds for k in range(steps)], _L
    fast = [np.vstack([start[0] + 0.8 * k * np.array([1.0, 0.6, 0.3]), start[1:]]) for k in range(12)]
    yield "one fast atom among atoms at rest", fast, _L
    path = [gas(30, 4.0, 83) * (1 + 0.1 * abs(5 - k)) for k in range(11)]
    yield "a free cluster flies apart and comes back", path, np.zeros((3, 3)), _R, _SKIN, False
    order = np.random.default_rng(84).permutation(len(start))
    yield "atoms change places", [start, start[order], start], _L
    dense, sparse = 3.0 + 0.25 * gas(40, _L, 85, -1.0, 1.0), gas(40, _L, 86)
    yield "dense, sparse, dense, sparse", [sparse, dense, sparse, dense, sparse], _L
    jitter = np.random.default_rng(87).normal(scale=0.12, size=(60, *start.shape))
    yield "a jitter of a third of the skin", [start + noise for noise in jitter], _L


def _wrapping() -> Script:
    start = gas(30, _L, 90)
    speeds = np.random.default_rng(91).normal(scale=0.05, size=start.shape)
    whole = [start + k * speeds for k in range(50)]
    yield "atoms leave the box", whole, _L
    yield "atoms are wrapped as they leave", [np.mod(x, _L) for x in whole], _L
    twice = [np.mod(x, _L) if k % 2 else x for k, x in enumerate(whole)]
    yield "atoms are wrapped at every other step", twice, _L
    rng = np.random.default_rng(92)
    tossed = [start + _L * rng.integers(-2, 3, start.shape) for _ in range(6)]
    yield "other images of the same atoms", tossed, _L
    pair = [np.array([[0.05, 3, 3], [5.2, 3, 3]]) + np.array([k * 0.01 - 0.1, 0, 0]) for k in range(20)]
    yield "a pair goes through a face, wrapped", [np.mod(x, _L) for x in pair], _L
    places = ((0.02 + 0.01 * k, _L - 1.4 + 0.01 * k * (1 + k / 10)) for k in range(30))
    meet = [np.mod([[one, 3, 3], [other, 3, 3]], _L) for one, other in places]
    yield "an atom follows another through a face", meet, _L
    skewed = np.array([[5.0, 0, 0], [2.0, 5.0, 0], [-1.5, 1.0, 5.0]])
    moved = [gas(30, skewed, 93) + k * speeds for k in range(40)]
    home = [x - np.floor(np.linalg.solve(skewed.T, x.T).T) @ skewed for x in moved]
    yield "a skewed box, atoms are wrapped", home, skewed


def _strain() -> Script:
    apart = _R + _SKIN + 0.01
    edge = 4.0
    across = np.array([[apart / 2, 2, 2], [edge - apart / 2, 2, 2]])
    for total, steps in ((0.35, 1), (0.6, 1), (1.0, 1), (0.35, 10), (0.35, 100)):
        path = [(across, [edge - total * k / steps, edge, edge]) for k in range(steps + 1)]
        yield f"the box shrinks by {total} {_how(steps)}, the atoms rest", path, edge
    close = np.array([[0.5, 2, 2], [edge - 0.5 - 1e-9, 2, 2]])
    path = [(close, edge), (close, [edge - 2e-9, edge, edge])]
    yield "the box shrinks by 2e-9, no skin", path, edge, _R, 0.0
    start = gas(40, _L, 100)
    for factor, steps, words in ((0.97, 9, "shrinks"), (1.03, 9, "grows"), (0.995, 40, "shrinks slowly")):
        path = [(start * f, _L * f) for f in factor ** np.arange(steps)]
        yield f"the box {words} and takes the atoms along", path, _L
    for size in (0.02, 0.2):
        shears = [np.array([[1.0, 0, 0], [size * k, 1, 0], [0, 0, 1]]) for k in range(9)]
        yield f"the box is sheared by {size} at a step", [(start @ shear, _L * shear) for shear in shears], _L
    over = np.array([[1.0, 0.3, 2], [2.4, edge - 0.3, 2], [3.0, 2, 2]])
    for steps in (1, 12):
        tilts = [np.array([[edge, 0, 0], [1.4 * k / steps, edge, 0], [0, 0, edge]]) for k in range(steps + 1)]
        name = f"the box is sheared {_how(steps)}, the atoms rest, the volume stays"
        yield name, [(over, tilt) for tilt in tilts], edge
    swapped = [(across, [edge - w, edge * edge / (edge - w), edge]) for w in np.linspace(0, 0.5, 6)]
    yield "one edge shrinks, one grows, the atoms rest", swapped, edge
    angles = np.linspace(0.0, 1.2, 7)
    turns = [np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1.0]]) for a in angles]
    yield "box and atoms turn", [(start @ turn, _L * turn) for turn in turns], _L
    mixed = [(start * (1 - 0.004 * k) + 0.01 * k, _L * (1 - 0.004 * k)) for k in range(12)]
    yield "the box shrinks while the atoms drift", mixed, _L
    # atoms move where the box is largest, so that a list which has served so far is made anew there
    there = [(start * f, _L * f) for f in (1.0, 1.25, 1.5)]
    back = [((start + gas(40, 0.8, 102)) * f, _L * f) for f in (1.5, 1.35, 1.2, 1.05, 1.0)]
    yield "the box grows, the atoms move, the box shrinks back", there + back, _L
    few = gas(5, 2.3, 101)
    path = [(few * f, 2.3 * f) for f in (1.0, 0.9, 0.75, 0.6, 0.5, 0.8)]
    yield "the box shrinks below two cutoffs", path, 2.3


def _narrow() -> Iterator[Case]:
    """Yield narrow boxes with several images of a pair, or of one atom, within the cutoff."""
    skewed = np.array([[0.9, 0, 0], [0.5, 0.8, 0], [-0.4, 0.3, 0.85]])
    for word, count, cell, pbc in (
        ("an atom alone, edges of 0.8 cutoffs", 1, 0.8, True),
        ("edges of 0.9 cutoffs", 2, 0.9, True),
        ("edges of 0.6 cutoffs", 2, 0.6, True),
        ("one edge of 0.7 cutoffs", 5, [0.7, 3.0, 3.0], True),
        ("a small skewed box", 3, skewed, True),
        ("a small slab", 3, skewed, (True, True, False)),
        ("a thin wire", 3, [3.0, 3.0, 0.45], (False, False, True)),
    ):
        cell = matrix(cell)
        start, speeds = gas(count, cell, 104), 0.016 * np.random.default_rng(105).normal(size=(count, 3))
        # some steps within the skin, and some that use it up
        path = [start + k * speeds for k in (0, 1, 2, 12, 13, 40)]
        yield sequence(f"atoms move, {word}", "motion", path, cell, pbc=pbc)
        home = [np.where(pbc, -np.floor(np.linalg.solve(cell.T, x.T).T), 0.0) @ cell for x in path]
        moved = [x + shift for x, shift in zip(path, home, strict=True)]
        yield sequence(f"atoms move and are wrapped, {word}", "wrapping", moved, cell, pbc=pbc)
        scaled = [(start * f, cell * f) for f in (1.0, 0.999, 0.96, 0.8, 1.1, 1.1)]
        yield sequence(f"the box breathes, {word}", "strain", scaled, cell, pbc=pbc)


def _reuse() -> Iterator[Case]:
    start, other = gas(40, _L, 110), gas(40, _L, 111)
    dense = 3.0 + 0.2 * gas(40, _L, 112, -1.0, 1.0)
    yield sequence("fewer atoms each time", "reuse", [start[:n] for n in (40, 23, 9, 2, 1, 0)], _L)
    yield sequence("more atoms each time", "reuse", [start[:n] for n in (1, 2, 9, 23, 40)], _L)
    yield sequence("an atom is removed and added", "reuse", [start, start[1:], start, start[:-1]], _L)
    yield _anew("as many other atoms", [start, other, start])
    yield _anew("many neighbors, then few, then many", [dense, start, dense, start])
    yield _anew("other boxes", [(start, _L), (start, 9.0), (start * 0.6, 3.6)])
    # each time two atoms come in, with a thinner skin and with a thicker one
    path = [_two(_R + (1.01 - closed) * skin) for skin in (0.6, 0.1, 0.6) for closed in (0.0, 0.6, 1.8)]
    yield _anew("started anew with another skin", path, (0.6, None, None, 0.1, None, None, 0.6, None, None))
    yield _anew("the same atoms three times", [start] * 3)


def _anew(name: str, path: list[Any], skins: Sequence[float | None] | None = None) -> Case:
    """Return a test case with a new neighbor list at every step, or at steps with a skin in `skins`."""
    case = sequence(name, "reuse", path, _L, _R, max(filter(None, skins)) if skins else _SKIN)
    starts = zip(case.stills, skins or [None] * len(path), strict=True)
    stills = (replace(still, fresh=skin is not None or not skins, skin=skin) for still, skin in starts)
    return replace(case, stills=tuple(stills))


def motions(padding: float | None = None) -> Iterator[Case]:
    """Yield sequences of small motions that require a rebuild, short sequences first.

    Args:
        padding: measured or declared padding of the list, in units of the given skin; if None, the given skin
            is tried first, then a series of other values.
    """
    room = _SKIN * (padding or 1.0)
    edge = max(6.0, 2.6 * (_R + room))
    ways = _ways()
    numbered = list(enumerate(ways))
    for share in _SHARES:
        words = f"the smallest motions of a pair, {share:.0%} by its first atom"
        yield _sequence(words, (_walk(room, way, share, edge, n) for n, way in numbered), edge)
    for along, words in ((False, "along all axes"), (True, "along one direction")):
        paths = (_squeezed(room, way, edge, n, along) for n, way in numbered)
        yield _sequence(f"the smallest strains, a box that shrinks {words} with its atoms", paths, edge)
    some = [(n, ways[k]) for n, k in enumerate((0, 2, 5, 9, 13))]
    for share in (0.5, 1.0):
        paths = (_walk(room, way, share, edge, n, np.linspace(0, 1, 8)) for n, way in some)
        yield _sequence(f"pairs that creep together, {share:.0%} by the first atom", paths, edge)
    back = (0.0, 0.45, -0.45, 0.9, -0.9, 1.0)
    paths = (_walk(room, way, 0.5, edge, n, back) for n, way in some)
    yield _sequence("pairs that go back and forth, then together", paths, edge)
    for k, (count, little) in enumerate(_AMONG):
        wide = edge * max(1.0, (count / 42) ** (1 / 3))
        which = numbered if count < 1_000 else numbered[4:12:4]
        paths = (_among(room, way, wide, len(ways) * k + n, count, little) for n, way in which)
        how = f"that move by {little} paddings" if little else "at rest"
        yield _sequence(f"a pair shares the motion in all proportions, {count} atoms {how}", paths, wide)
    paths = (_adrift(room, way, edge, n) for n, way in numbered)
    yield _sequence("a pair comes together while all atoms drift", paths, edge)
    for share in (0.5, 0.3):
        words = f"twelve pairs at once, {share:.0%} by their first atoms"
        yield _sequence(words, (_dozen(room, way, share, n) for n, way in enumerate(ways[::2])), 12.0)
    yield _in_turn(room, ways)
    for cell, word in ((np.eye(3) * 0.9, "edges of 0.9"), (np.diag([0.7, edge, edge]), "one edge of 0.7")):
        paths = (_walk(room, way, _SHARES[n % 5], edge, n) for n, way in numbered)
        yield _sequence(f"the smallest motions of a pair, {word} cutoffs", paths, cell)
    leaning = edge * np.array([[1.0, 0, 0], [0.45, 1.0, 0], [-0.35, 0.4, 1.0]])
    for cell, word in ((leaning, "a skewed box"), (np.diag([4 * edge, edge, edge]), "a long box")):
        along = [*ways, *(row / np.linalg.norm(row) for row in cell)]
        paths = (_walk(room, way, 0.5, edge, n) for n, way in enumerate(along))
        yield _sequence(f"the smallest motions of a pair, {word}", paths, cell)
    if padding is None or abs(padding - 1.0) < 0.02:
        for skin in (0.08, 1.0):
            paths = (_walk(skin, way, 0.5, edge, n) for n, way in numbered)
            yield _sequence(f"the smallest motions of a pair, a skin of {skin}", paths, edge, skin)
    for n in (0, 4, 9, 13) if padding is None else (9,):
        yield _ladder(room, ways[n], n)
        for share in (1.0, 0.5):
            yield _one_by_one(room, ways[n], share, n)


def _ways() -> list[ndarray]:
    """Return unit vectors along axes, face and body diagonals, and random directions."""
    ways = [np.array(way, float) for way in itertools.product((-1, 0, 1), repeat=3) if way > (0, 0, 0)]
    ways.sort(key=lambda way: (np.count_nonzero(way), tuple(-way)))
    ways += list(np.random.default_rng(140).normal(size=(3, 3)))
    return [way / np.linalg.norm(way) for way in ways]


def _closing(room: float) -> float:
    """Return how far two atoms approach, from beyond r_cut + padding to inside the cutoff."""
    return (1 + 2 * HAIR) * room


def _around(middle: ndarray, room: float | ndarray, way: ndarray) -> ndarray:
    """Return positions of pairs just beyond r_cut + padding: first atoms, then their partners."""
    half = (_R + (1 + HAIR) * room) / 2 * way
    return np.vstack([middle - half, middle + half])


def _walk(
    room: float, way: ndarray, share: float, edge: float, n: int, closed: Iterable[float] = (0.0, 1.0)
) -> list[ndarray]:
    """Return a path of two approaching atoms. The first atom makes the fraction `share` of the motion."""
    start = _around(edge * np.random.default_rng(150 + n).uniform(0.2, 0.8, 3), room, way)
    moves = _closing(room) * np.array([share * way, (share - 1.0) * way])
    return [start + part * moves for part in closed]


def _squeezed(room: float, way: ndarray, edge: float, n: int, along: bool) -> list[tuple[ndarray, ndarray]]:
    """Return a path on which only strain of the box brings two atoms together.

    The box shrinks along the line between the atoms, or along all axes.
    """
    (start, _), cell = _walk(room, way, 0.5, edge, n), edge * np.eye(3)
    loss = _closing(room) / (_R + (1 + HAIR) * room)
    strain = np.eye(3) - loss * (np.outer(way, way) if along else np.eye(3))
    return [(start, cell), (start @ strain, cell @ strain)]


def _among(room: float, way: ndarray, edge: float, n: int, count: int, little: float) -> list[ndarray]:
    """Return a path on which two of many atoms approach. The other atoms rest or move slightly.

    The number `n` determines how the motion is divided between the two atoms. All atoms are used equally
    often as the atom that moves most. The partner of this atom is random.
    """
    rng = np.random.default_rng(170 + n)
    most = int(count * (1.0 - (n + 1) * _GOLDEN % 1.0))
    other = (most + int(rng.integers(1, count))) % count
    share = min(1.0, 0.5 + 0.52 * (n * _GOLDEN % 1.0))  # now and then one atom does it all
    start, end = _with(gas(count, edge, 190 + n), [most, other], _walk(room, way, share, edge, n))
    others = rng.normal(size=start.shape)
    others *= little * room / np.linalg.norm(others, axis=1)[:, None]
    others[[most, other]] = 0.0
    return [start, end + others]


def _adrift(room: float, way: ndarray, edge: float, n: int) -> list[ndarray]:
    """Return a path of two approaching atoms among ten others. All twelve atoms drift together."""
    start, end = _with(gas(12, edge, 180 + n), [4, 5], _walk(room, way, 0.5, edge, n))
    across = np.cross(way, np.roll(way, 1) + np.array([0.3, -0.2, 0.1]))
    across /= np.linalg.norm(across)
    return [start, end + room * (4 * across, 0.5 * way, 4 * way, 0.5 * across)[n % 4]]


def _with(others: ndarray, atoms: list[int], path: list[ndarray]) -> list[ndarray]:
    """Return a path of some atoms among other atoms at rest."""
    stills = [others.copy() for _ in path]
    for still, place in zip(stills, path, strict=True):
        still[atoms] = place
    return stills


def _dozen(room: float, way: ndarray, share: float, n: int) -> list[ndarray]:
    """Return a path on which twelve pairs make the same motion at different positions."""
    start = _around(_places(12, 12.0, n), room, way)
    moves = _closing(room) * np.repeat([share * way, (share - 1.0) * way], 12, axis=0)
    return [start, start + moves]


def _in_turn(room: float, ways: list[ndarray]) -> Case:
    """Return a test case in which 50 atoms move in turn, to find atoms that a neighbor list ignores."""
    count = 25
    way = np.array([ways[n % len(ways)] for n in range(count)])
    start = _around(_places(count, 15.0, 0), room, way)
    # a pair that has come together is far from its next turn: the second atom comes from beyond again
    path = [start]
    for atom in range(2 * count):
        if atom == count:
            # all anew, so that every rule rebuilds
            path.append(start + np.array([2.0, 1.0, -1.5]))
        moved = path[-1].copy()
        moved[atom] += (1.0 if atom < count else -1.0) * _closing(room) * way[atom % count]
        path.append(moved)
    case = sequence("50 atoms, each of them comes to another in its turn", "rule", path, 15.0)
    return replace(case, motions=2 * count)


def _ladder(room: float, way: ndarray, n: int) -> Case:
    """Return a test case in which pairs approach until each is inside the cutoff."""
    start = _around(_places(len(_RUNGS), 12.0, n), room * _RUNGS[:, None], way)
    inward = np.repeat([0.5 * way, -0.5 * way], len(_RUNGS), axis=0)
    path = [start + _closing(room) * closed * inward for closed in (0.0, *_RUNGS)]
    case = sequence(f"pairs from near and far creep together, {_direction(way)}", "rule", path, 12.0)
    return replace(case, motions=_BEYOND)


def _one_by_one(room: float, way: ndarray, share: float, n: int) -> Case:
    """Return a test case in which one pair after another approaches and returns."""
    count = len(_RUNGS)
    start = _around(_places(count, 12.0, n + 1), room * _RUNGS[:, None], way)
    path = [start]
    for rung, far in enumerate(_RUNGS):
        moved = start.copy()
        turned = (rung + n) % 2
        first, second = (rung, rung + count) if turned else (rung + count, rung)
        toward = (1.0 if turned else -1.0) * _closing(room) * far * way
        moved[first] += share * toward
        moved[second] -= (1 - share) * toward
        path.append(moved)
    name = f"pairs from near and far, one by one, {share:.0%} by an atom, {_direction(way)}"
    return replace(sequence(name, "rule", path, 12.0), motions=_BEYOND)


def _direction(way: ndarray) -> str:
    return f"along ({', '.join(f'{part:.2g}' for part in way)})"


def _places(count: int, edge: float, n: int) -> ndarray:
    """Return well-separated positions for pairs of atoms, in random order."""
    side = int(np.ceil(count ** (1 / 3)))
    return edge * np.random.default_rng(200 + n).permutation((grid(side) + 0.5) / side)[:count]


def _sequence(name: str, paths: Iterable[list[Any]], cell: float | ndarray, skin: float = _SKIN) -> Case:
    """Return a test case of successive motions. Large moves between these motions force a rebuild."""
    paths = list(paths)
    case = sequence(name, "rule", [still for path in paths for still in path], cell, _R, skin)
    return replace(case, motions=len(paths))
