"""When a list that was built in another box has used up its skin: against all pairs, with planted rules."""

from __future__ import annotations

from functools import cache
from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList

R_CUT, SKIN, ATOMS, EDGE, STEPS = 1.5, 0.3, 40, 4.5, 40
SHIFTS = np.array(list(product((-1, 0, 1), repeat=3)))


def deformations(kind: str):
    """What the box is multiplied by at each step."""
    for step in range(STEPS):
        way, by = (1.0 if step < STEPS // 2 else -1.0), np.zeros((3, 3))
        if kind == "shrinks and grows":
            by = -0.006 * way * np.eye(3)
        elif kind == "grows and shrinks":
            by = 0.012 * way * np.eye(3)
        elif kind == "is sheared":
            by[0, 1], by[2, 0] = 0.02 * way, -0.01 * way
        elif kind == "one edge for another":
            by = 0.01 * way * np.diag([1.0, -1.0, 0.0])
        elif kind == "turns":
            by[0, 1], by[1, 0] = 0.03, -0.03
        yield np.linalg.qr(np.eye(3) + by)[0] if kind == "turns" else np.eye(3) + by


KINDS = ("shrinks and grows", "grows and shrinks", "is sheared", "one edge for another", "turns", "is still")


def nearest(d, matrix):
    return d - np.rint(np.linalg.solve(matrix.T, d.T).T) @ matrix


def length(d) -> float:
    return float(np.linalg.norm(d, axis=1).max())


def shortest(now, then) -> float:
    """The smallest stretch of a deformation of one matrix of lattice vectors to another."""
    return float(np.linalg.svd(np.linalg.solve(then, now), compute_uv=False)[-1])


def carried(x, now, home, then):
    return nearest(x - home @ np.linalg.solve(then, now), now)


LISTED = VerletList(BUILDERS["host"], RebuildRule(SKIN), R_CUT)


#: What is used up of the skin, length: of positions and box now, at the build, and the first box.
RULES = {
    "": lambda x, now, home, then, first: (
        SKIN * LISTED.consumed(x, Cell.create(now), home, Cell.create(then))
    ),
    "motion in the box alone": lambda x, now, home, then, first: 2 * length(carried(x, now, home, then)),
    "motion without the box": lambda x, now, home, then, first: 2 * length(nearest(x - home, now)),
    "strain by volume": lambda x, now, home, then, first: (
        2 * length(carried(x, now, home, then))
        + (R_CUT + SKIN) * max(0, 1 - abs(np.linalg.det(now) / np.linalg.det(then)) ** (1 / 3))
    ),
    "strain since the first box": lambda x, now, home, then, first: (
        2 * length(carried(x, now, home, then)) + (R_CUT + SKIN) * max(0, 1 - shortest(now, first))
    ),
}  # fmt: skip


def distances(x, matrix):
    """Of every pair, of the nearest of the images around."""
    i, j = np.triu_indices(len(x), 1)
    d = (x[j] - x[i])[:, None] + SHIFTS @ matrix
    return np.sqrt(np.einsum("pik,pik->pi", d, d).min(axis=1))


def states(kind: str, rests: bool, seed: int):
    """Wrapped positions and boxes; atoms rest where they are, or are taken along, and all move a little."""
    rng = np.random.default_rng(seed)
    matrix = EDGE * np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3))
    x, speeds = rng.uniform(0, 1, (ATOMS, 3)) @ matrix, 0.002 * rng.standard_normal((ATOMS, 3))
    for by in deformations(kind):
        cell = Cell.create(matrix)
        yield wrap_positions(cell, x)[0], cell
        x = (x if rests else x @ by) + speeds
        matrix = matrix @ by


@cache
def paths():
    """Of every path its positions, boxes and distances."""
    return [
        [(x, np.asarray(cell.matrix), distances(x, cell.matrix)) for x, cell in states(kind, rests, seed)]
        for seed, (kind, rests) in enumerate(product(KINDS, (False, True)))
    ]


def followed(rule: str) -> tuple[int, int]:
    """Pairs that a list lacks which is made anew by a rule, and how often it is."""
    used, lost, builds = RULES[rule], 0, 0
    for path in paths():
        built = None
        for x, now, distance in path:
            if built is None or used(x, now, *built[:2], path[0][1]) > SKIN:
                built, builds = (x, now, distance < R_CUT + SKIN), builds + 1
            lost += np.count_nonzero((distance < R_CUT) & ~built[2])
    return lost, builds


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_that_forgets_a_part_of_the_strain_loses_pairs(rule):
    lost, builds = followed(rule)
    assert bool(lost) == bool(rule) and builds < 0.5 * STEPS * 2 * len(KINDS)


def test_the_rule_of_lists_is_the_bound_or_a_little_above_it_and_that_of_the_loop():
    for seed, (kind, rests) in enumerate(product(KINDS, (False, True))):
        (home, then), *later = states(kind, rests, seed)
        for x, cell in later[4::12]:
            used, moved = (
                SKIN * LISTED.consumed(x, cell, home, then),
                carried(x, cell.matrix, home, then.matrix),
            )
            least = 2 * length(moved) + (R_CUT + SKIN) * max(0, 1 - shortest(cell.matrix, then.matrix))
            assert least - 1e-12 <= used
            assert used == pytest.approx(least) or kind not in ("shrinks and grows", "grows and shrinks")
            spent = cell.astype(np.float64).spent(
                jnp.asarray(x.T), then.astype(np.float64), jnp.asarray(home.T), R_CUT + SKIN
            )
            assert 2 * float(spent) == pytest.approx(used, rel=1e-9, abs=1e-12)


def test_a_box_is_narrow_where_half_of_a_width_is_below_the_radius():
    tilted = np.array([[4.0, 0, 0], [3.0, 4.0, 0], [0, 0, 9.0]])
    width = 4.0 * 4.0 / 5.0  # area over the longer edge
    for pbc, smallest in ((True, width), ((False, True, True), 5.0), (False, np.inf)):
        cell = Cell.create(tilted, pbc)
        assert float(np.min(cell.widths)) == pytest.approx(smallest)
        for share, narrow in ((0.499, False), (0.501, True)):
            assert cell.is_narrow(share * min(smallest, 1e3)) == (narrow and np.isfinite(smallest))
