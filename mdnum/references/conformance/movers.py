"""Scripts of motion that have caught stale lists: what moves, how far at a step, and what the box does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case, script
from mdnum.references.conformance.catalog import gas

_R, _SKIN, _L = 1.0, 0.3, 6.0


def movers() -> Iterator[Case]:
    """Scripts for a list that is kept, the short ones first."""
    yield from _pairs()
    yield from _many()
    yield from _wrapping()
    yield from _strain()
    yield from _reuse()


def sequences() -> Iterator[Case]:
    """Scripts for a list that starts from nothing each time: what it keeps to itself must not matter."""
    for case in _reuse():
        yield replace(case, skin=0.0)


def _pairs() -> Iterator[Case]:
    middle = np.array([3.0, 3.0, 3.0])
    apart = _R + 1.01 * _SKIN
    for share, steps in ((0.9, 1), (0.6, 1), (0.51, 1), (0.9, 9), (0.6, 20)):
        path = [_two(middle, apart - 2 * share * _SKIN * k / steps) for k in range(steps + 1)]
        how = "in one step" if steps == 1 else f"in {steps} steps"
        yield script(f"two atoms head-on, each by {share} skins {how}", "motion", path, _L, _R, _SKIN)
    path = [_two(middle, apart - 0.02 * _SKIN * k) for k in range(120)]
    yield script("two atoms creep together, 120 steps", "motion", path, _L, _R, _SKIN)
    path = [np.array([middle, middle + np.array([apart - 1.1 * _SKIN * k / 10, 0, 0])]) for k in range(11)]
    yield script("one atom comes to another at rest", "motion", path, _L, _R, _SKIN)
    others = gas(12, _L, 80)
    others = others[np.linalg.norm(others - middle, axis=1) > 2.0]
    path = [np.vstack([_two(middle, apart - 0.09 * _SKIN * k), others]) for k in range(14)]
    yield script("two atoms head-on among others at rest", "motion", path, _L, _R, _SKIN)
    path = [np.array([middle, middle + np.array([0.9 + 0.01 * k, 0, 0])]) for k in range(40)]
    yield script("two atoms part slowly", "motion", path, _L, _R, _SKIN)
    at = middle + np.array([apart, 0, 0])
    path = (
        [np.array([middle, at])] * 3
        + [np.array([middle, middle + np.array([0.5, 0, 0])])]
        + [np.array([middle, at])] * 3
    )
    yield script("an atom jumps in and out", "motion", path, _L, _R, _SKIN)


def _two(middle: ndarray, apart: float) -> ndarray:
    half = np.array([apart / 2, 0.0, 0.0])
    return np.array([middle - half, middle + half])


def _many() -> Iterator[Case]:
    start = gas(40, _L, 81)
    yield script("nothing moves", "motion", [start] * 5, _L, _R, _SKIN)
    drift = np.array([0.011, 0.007, -0.005])
    yield script("all atoms drift slowly", "motion", [start + k * drift for k in range(120)], _L, _R, _SKIN)
    speeds = np.random.default_rng(82).normal(size=start.shape)
    speeds /= np.linalg.norm(speeds, axis=1)[:, None]
    for step, steps in ((0.01, 110), (0.03, 60), (0.1, 20), (0.4, 8), (2.5, 5)):
        path = [start + k * step * speeds for k in range(steps)]
        yield script(f"a gas, {step} r_cut at a step", "motion", path, _L, _R, _SKIN)
    fast = []
    for k in range(12):
        moved = start.copy()
        moved[0] = start[0] + 0.8 * k * np.array([1.0, 0.6, 0.3])
        fast.append(moved)
    yield script("one fast atom among atoms at rest", "motion", fast, _L, _R, _SKIN)
    free = gas(30, 4.0, 83)
    yield script(
        "a free cluster flies apart and comes back",
        "motion",
        [free * (1 + 0.1 * abs(5 - k)) for k in range(11)],
        np.zeros((3, 3)),
        _R,
        _SKIN,
        False,
    )
    order = np.random.default_rng(84).permutation(len(start))
    yield script("atoms change places", "motion", [start, start[order], start], _L, _R, _SKIN)
    dense, sparse = 3.0 + 0.25 * gas(40, _L, 85, -1.0, 1.0), gas(40, _L, 86)
    yield script(
        "dense, sparse, dense, sparse", "motion", [sparse, dense, sparse, dense, sparse], _L, _R, _SKIN
    )
    jitter = np.random.default_rng(87).normal(scale=0.12, size=(60, *start.shape))
    yield script(
        "a jitter of a third of the skin", "motion", [start + noise for noise in jitter], _L, _R, _SKIN
    )


def _wrapping() -> Iterator[Case]:
    start = gas(30, _L, 90)
    speeds = np.random.default_rng(91).normal(scale=0.05, size=start.shape)
    whole = [start + k * speeds for k in range(50)]
    yield script("atoms leave the box", "wrapping", whole, _L, _R, _SKIN)
    yield script("atoms are wrapped as they leave", "wrapping", [np.mod(x, _L) for x in whole], _L, _R, _SKIN)
    twice = [np.mod(x, _L) if k % 2 else x for k, x in enumerate(whole)]
    yield script("atoms are wrapped at every other step", "wrapping", twice, _L, _R, _SKIN)
    rng = np.random.default_rng(92)
    tossed = [start + _L * rng.integers(-2, 3, start.shape) for _ in range(6)]
    yield script("other images of the same atoms", "wrapping", tossed, _L, _R, _SKIN)
    pair = [np.array([[0.05, 3, 3], [5.2, 3, 3]]) + np.array([k * 0.01 - 0.1, 0, 0]) for k in range(20)]
    yield script(
        "a pair goes through a face, wrapped", "wrapping", [np.mod(x, _L) for x in pair], _L, _R, _SKIN
    )
    meet = [
        np.array([[0.02 + 0.01 * k, 3, 3], [_L - 1.4 + 0.01 * k * (1 + k / 10), 3, 3]]) for k in range(30)
    ]
    yield script(
        "an atom follows another through a face", "wrapping", [np.mod(x, _L) for x in meet], _L, _R, _SKIN
    )
    skewed = np.array([[5.0, 0, 0], [2.0, 5.0, 0], [-1.5, 1.0, 5.0]])
    slanted = gas(30, skewed, 93)
    moved = [slanted + k * speeds[:30] for k in range(40)]
    home = [x - np.floor(np.linalg.solve(skewed.T, x.T).T) @ skewed for x in moved]
    yield script("a skewed box, atoms are wrapped", "wrapping", home, skewed, _R, _SKIN)


def _strain() -> Iterator[Case]:
    apart = _R + _SKIN + 0.01
    edge = 4.0
    across = np.array([[apart / 2, 2, 2], [edge - apart / 2, 2, 2]])
    for total, steps in ((0.35, 1), (0.6, 1), (1.0, 1), (0.35, 10), (0.35, 100)):
        path = [(across, np.diag([edge - total * k / steps, edge, edge])) for k in range(steps + 1)]
        how = "at once" if steps == 1 else f"in {steps} steps"
        yield script(f"the box shrinks by {total} {how}, the atoms rest", "strain", path, edge, _R, _SKIN)
    close = np.array([[0.5, 2, 2], [edge - 0.5 - 1e-9, 2, 2]])
    path = [(close, np.diag([edge, edge, edge])), (close, np.diag([edge - 2e-9, edge, edge]))]
    yield script("the box shrinks by 2e-9, no skin", "strain", path, edge, _R, 0.0)
    start = gas(40, _L, 100)
    for scale, word in ((0.97, "shrinks"), (1.03, "grows")):
        factors = scale ** np.arange(9)
        path = [(start * f, np.eye(3) * _L * f) for f in factors]
        yield script(f"the box {word} and takes the atoms along", "strain", path, _L, _R, _SKIN)
    factors = 0.995 ** np.arange(40)
    path = [(start * f, np.eye(3) * _L * f) for f in factors]
    yield script("the box shrinks slowly and takes the atoms along", "strain", path, _L, _R, _SKIN)
    for size in (0.02, 0.2):
        shears = [np.array([[1.0, 0, 0], [size * k, 1, 0], [0, 0, 1]]) for k in range(9)]
        path = [(start @ shear, _L * shear) for shear in shears]
        yield script(f"the box is sheared by {size} at a step", "strain", path, _L, _R, _SKIN)
    over = np.array([[1.0, 0.3, 2], [2.4, edge - 0.3, 2], [3.0, 2, 2]])
    for steps in (1, 12):
        tilts = [np.array([[edge, 0, 0], [1.4 * k / steps, edge, 0], [0, 0, edge]]) for k in range(steps + 1)]
        how = "at once" if steps == 1 else f"in {steps} steps"
        name = f"the box is sheared {how}, the atoms rest, the volume stays"
        yield script(name, "strain", [(over, tilt) for tilt in tilts], edge, _R, _SKIN)
    swapped = [(across, np.diag([edge - w, edge * edge / (edge - w), edge])) for w in np.linspace(0, 0.5, 6)]
    yield script("one edge shrinks, one grows, the atoms rest", "strain", swapped, edge, _R, _SKIN)
    angles = np.linspace(0.0, 1.2, 7)
    turns = [np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1.0]]) for a in angles]
    yield script("box and atoms turn", "strain", [(start @ turn, _L * turn) for turn in turns], _L, _R, _SKIN)
    mixed = [(start * (1 - 0.004 * k) + 0.01 * k, np.eye(3) * _L * (1 - 0.004 * k)) for k in range(12)]
    yield script("the box shrinks while the atoms drift", "strain", mixed, _L, _R, _SKIN)
    few = gas(5, 2.3, 101)
    path = [(few * f, np.eye(3) * 2.3 * f) for f in (1.0, 0.9, 0.75, 0.6, 0.5, 0.8)]
    yield script("the box shrinks below two cutoffs", "strain", path, 2.3, _R, _SKIN)


def _reuse() -> Iterator[Case]:
    start, other = gas(40, _L, 110), gas(40, _L, 111)
    dense = 3.0 + 0.2 * gas(40, _L, 112, -1.0, 1.0)
    yield script("fewer atoms each time", "reuse", [start[:n] for n in (40, 23, 9, 2, 1, 0)], _L, _R, _SKIN)
    yield script("more atoms each time", "reuse", [start[:n] for n in (1, 2, 9, 23, 40)], _L, _R, _SKIN)
    yield script(
        "an atom is removed and added", "reuse", [start, start[1:], start, start[:-1]], _L, _R, _SKIN
    )
    yield _anew(script("as many other atoms", "reuse", [start, other, start], _L, _R, _SKIN))
    yield _anew(
        script("many neighbors, then few, then many", "reuse", [dense, start, dense, start], _L, _R, _SKIN)
    )
    boxes = [(start, np.eye(3) * _L), (start, np.eye(3) * 9.0), (start * 0.6, np.eye(3) * 3.6)]
    yield _anew(script("other boxes", "reuse", boxes, _L, _R, _SKIN))
    yield _other_skins()
    yield _anew(script("the same atoms three times", "reuse", [start] * 3, _L, _R, _SKIN))


def _other_skins() -> Case:
    """A list that starts anew with a thinner skin, and with a thicker one; each time two atoms come in."""
    middle, path, skins = np.array([3.0, 3.0, 3.0]), [], []
    for skin in (0.6, 0.1, 0.6):
        apart = _R + 1.01 * skin
        path += [_two(middle, apart), _two(middle, apart - 0.6 * skin), _two(middle, apart - 1.8 * skin)]
        skins += [skin, None, None]
    case = script("started anew with another skin", "reuse", path, _L, _R, max(filter(None, skins)))
    stills = [
        replace(one, fresh=skin is not None, skin=skin) for one, skin in zip(case.stills, skins, strict=True)
    ]
    return replace(case, stills=tuple(stills))


def _anew(case: Case) -> Case:
    """A script in which every still is another question to the same list."""
    return replace(case, stills=tuple(replace(one, fresh=True) for one in case.stills))
