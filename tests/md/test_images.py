"""Forces, virial tensor and decisions in tilted boxes, against all images of all pairs in long double."""

from __future__ import annotations

from itertools import product
from unittest import mock

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from devices import on_cpu
from small_systems import KOB_ANDERSEN, make, mixture

from mdnum.md import kernel
from mdnum.md.cell import Cell
from mdnum.md.neighbors import PairTable
from mdnum.systems import build

pytestmark = on_cpu

ATOMS, R_CUT = 24, 1.7
SHIFTS = np.array(list(product((-1, 0, 1), repeat=3)))


def tilted(rng, shortest: float):
    """Lattice vectors in any direction and of any tilt, with a given smallest width."""
    while True:
        matrix = np.diag(rng.uniform(1, 1.5, 3)) + np.tril(rng.uniform(-1, 1, (3, 3)), -1)
        matrix = (matrix @ np.linalg.qr(rng.normal(size=(3, 3)))[0])[rng.permutation(3)]
        matrix *= shortest / Cell.create(matrix).widths.min()
        if abs(np.linalg.det(matrix)) < 5 * shortest**3:
            return matrix


def placed(rng, matrix):
    """Atoms in a box, none closer than 0.8 to another or to an image of one."""
    x = rng.random((1, 3)) @ matrix
    while len(x) < ATOMS:
        one = rng.random(3) @ matrix
        if (np.linalg.norm(x[:, None] - one + SHIFTS @ matrix, axis=2) > 0.8).all():
            x = np.concatenate([x, one[None]])
    return x


class AllPairs:
    """A binary mixture whose list has every pair, so that one program serves every box."""

    def __init__(self):
        atoms = mixture()[:ATOMS]
        self.simulation = build(make(atoms, KOB_ANDERSEN, {"kind": "force-shifted", "radius": R_CUT}))
        self.second = np.array(atoms.get_chemical_symbols()) == "P"

        @eqx.filter_jit
        def evaluated(force, x, tables, given, where):
            assert not force.cell.orthorhombic and force.in_one_loop(tables)
            return force(x, tables, given=given, where=where, decisions=True, tensor=True)

        self.evaluated = evaluated

    def listed(self, x):
        """Neighbors of each atom, without images the nearest first: vectors of pairs of which none is far."""
        apart = np.linalg.norm(x - x[:, None], axis=2) + 1000 * np.eye(len(x))
        found = np.argsort(apart, axis=1).T.astype(np.int32)
        found[-1] = ATOMS
        return PairTable(found, np.arange(ATOMS), R_CUT, ATOMS - 1, 0.0)

    def packed(self, table, pairs):
        """Decisions of a matrix of pairs as the loop takes them."""
        of_slots = np.pad(pairs, ((0, 0), (0, 1)))[np.arange(ATOMS), table.index]
        return jnp.asarray(np.packbits(of_slots.reshape(-1, 8, ATOMS), axis=1, bitorder="little")[:, 0])

    def deviations(self, matrix, x, told=None, at=None) -> dict[str, float]:
        """Largest differences from the reference, relative to the largest value; wrong decisions, counted.

        Args:
            told, at: matrices of decisions that are imposed, and of the pairs at which they are.
        """
        force = eqx.tree_at(
            lambda one: one.cell, self.simulation.force, Cell.create(matrix).astype(np.float64)
        )
        table = self.listed(x)
        bits = [None if one is None else self.packed(table, one) for one in (told, at)]
        made = self.evaluated(force, jnp.asarray(x.T), self.simulation.tables(table), *bits)
        pull, energy, tensor, margin = self.reference(matrix, x, told, at)

        def away(a, b):
            return float(np.abs(np.asarray(a, np.longdouble) - b).max() / np.abs(b).max())

        wrong = np.bitwise_count(
            np.asarray(made.decisions.bits) ^ np.asarray(self.packed(table, margin > 0))
        ).sum()
        assert np.abs(margin).min() > 1e-12
        nearest = float(made.decisions.nearest) - float(np.abs(margin).min())
        return {
            "force": away(made.force.T, pull), "energy": away(made.energy, energy),
            "tensor": away(made.tensor, tensor), "virial": away(made.virial, np.trace(tensor)),
            "nearest": abs(nearest), "decisions": float(wrong),
        }  # fmt: skip

    @staticmethod
    def distances2(matrix, x):
        """Displacements to the nearest of 27 images, and their squares: of two places in the box no other
        image can be nearer than half the smallest width."""
        x, shifts = x.astype(np.longdouble), SHIFTS.astype(np.longdouble) @ matrix.astype(np.longdouble)
        d = x - x[:, None] + shifts[:, None, None]
        which = np.argmin((d * d).sum(-1), axis=0)
        d = np.take_along_axis(d, which[None, ..., None], axis=0)[0]
        return d, (d * d).sum(-1)

    def reference(self, matrix, x, told, at):
        """Force, energy, tensor and margin, from displacements to the nearest images."""
        d, r2 = self.distances2(matrix, x)
        itself = np.eye(ATOMS, dtype=bool)
        r2 = r2 + 100 * itself
        margin = np.longdouble(R_CUT * R_CUT) - r2
        inside = margin > 0
        if told is not None:
            inside = told if at is None else np.where(at, told, inside)
        constants = [KOB_ANDERSEN["pairs"][pair] for pair in ("Ni-Ni", "P-Ni", "P-P")]
        kind = self.second[:, None].astype(int) + self.second
        sigma, epsilon = (
            np.array([one[name] for one in constants], np.longdouble)[kind] for name in ("sigma", "epsilon")
        )

        def u(r):
            return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)

        def slope(r):
            return 24 * epsilon * ((sigma / r) ** 6 - 2 * (sigma / r) ** 12) / r

        r, edge = np.sqrt(r2), np.longdouble(R_CUT)
        energy = np.where(inside, u(r) - u(edge) - (r - edge) * slope(edge), 0)
        pull = np.where(inside, (slope(r) - slope(edge)) / r, 0)[..., None] * d
        tensor = -0.5 * np.einsum("ija,ijb->ab", d, pull)
        return pull.sum(1), 0.5 * energy.sum(1), tensor, np.where(itself, -100, margin)


def cases(seed: int, count: int):
    """Boxes hardly wider than twice the cutoff and wider ones, atoms, and decisions to impose on pairs."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        matrix = tilted(rng, 2 * R_CUT * (1 + 1e-9 if k % 2 else rng.uniform(1, 1.4)))
        both = [np.triu(rng.random((ATOMS, ATOMS)) < share, 1) for share in (0.5, 0.2)]
        yield matrix, placed(rng, matrix), *(one | one.T for one in both)


def worst(system: AllPairs, rows) -> dict[str, float]:
    """The largest deviation of each kind."""
    found = [system.deviations(*row) for row in rows]
    return {name: max(one[name] for one in found) for name in found[0]}


def test_in_tilted_boxes_forces_are_those_of_the_nearest_images():
    system = AllPairs()
    found = worst(system, (row[:2] for row in cases(3, 30)))
    assert found["decisions"] == 0 and max(found.values()) < 2e-13, found


@pytest.mark.nightly
@pytest.mark.parametrize("everywhere", [True, False])
def test_imposed_decisions_act_at_the_nearest_images(everywhere):
    rows = []
    for matrix, x, told, at in cases(5, 30):
        # a list has no pair beyond half the smallest width
        near = AllPairs.distances2(matrix, x)[1] < (Cell.create(matrix).widths.min() / 2) ** 2
        rows.append((matrix, x, told & near, None if everywhere else at & near))
    found = worst(AllPairs(), rows)
    assert found["decisions"] == 0 and max(found.values()) < 2e-13, found


def without_lattice_vectors(*arguments, made=kernel.over_pairs, **options):
    """A loop whose tensor has no part of lattice vectors."""
    sums = made(*arguments, **options)
    return sums._replace(totals=0 * sums.totals)


def nearby2(of):
    """The square of half the smallest width by another rule, from the squares of inverse widths."""
    return Cell, "nearby2", property(lambda cell: of((cell.inverse**2).sum(axis=0)))


PLANTED = {
    "half of the first width": nearby2(lambda squares: 0.25 / squares[0]),
    "half of the largest width": nearby2(lambda squares: 0.25 / squares.min()),
    "a whole width": nearby2(lambda squares: 1 / squares.max()),
    "no lattice vectors in the tensor": (kernel, "over_pairs", without_lattice_vectors),
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("name", PLANTED)
def test_planted_errors_are_found(name):
    with mock.patch.object(*PLANTED[name]):
        found = worst(AllPairs(), (row[:2] for row in cases(3, 30)))
    wrong = {key for key, value in found.items() if value > 1e-3}
    assert wrong == ({"tensor", "virial"} if "tensor" in name else wrong | {"force", "decisions"})


def test_below_half_the_smallest_width_the_nearest_image_changes_no_bit():
    rng, count = np.random.default_rng(0), 20_000
    matrices = rng.uniform(-1, 1, (count, 3, 3)) * np.tri(3, k=-1) + np.eye(3) * rng.uniform(
        1, 1.5, (count, 3, 1)
    )
    matrices = matrices @ np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    inverses = np.linalg.inv(matrices)
    squares = (inverses**2).sum(axis=1)
    across = np.take_along_axis(inverses, squares.argmax(axis=1)[:, None, None], axis=2)[..., 0]

    def below(limit, across):
        """Displacements along the smallest width, hardly shorter than a limit."""
        d = across * np.sqrt(limit / (across**2).sum(axis=-1))[..., None]
        for _ in range(9):
            r2 = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]
            d = np.where((r2 >= limit)[..., None], np.nextafter(d, 0), d)
        return d

    d = below(0.25 / squares.max(axis=1), across)
    shares = d[:, 0] * across[:, 0] + d[:, 1] * across[:, 1] + d[:, 2] * across[:, 2]
    # where rounding alone takes half a width beyond a half: a bound without its margin changes bits there
    hard = np.flatnonzero(shares > 0.5)
    assert len(hard) > 3
    for k in (*hard, *range(50)):
        cell = Cell.create(matrices[k])
        near = below(float(cell.nearby2), across[k])
        assert np.ravel(cell.minimum_image(*near[:, None])).tobytes() == near.tobytes()
        if k in hard:
            assert np.ravel(cell.minimum_image(*d[k][:, None])).tobytes() != d[k].tobytes()
