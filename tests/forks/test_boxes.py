"""Forks of runs whose boxes move: separation relative to the box, and the strain between boxes beside it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rollout.test_constant_pressure import pressed

import mdnum
from mdnum.forks.choices.start import Rotate, Translate
from mdnum.md.cell import Cell
from mdnum.rollout.compared import separations, strains
from mdnum.rollout.engine import Engine
from mdnum.rollout.program import MdProgram
from mdnum.store import RunFolder

STEPS = 40


def rows(simulation, steps: int = STEPS):
    """Positions relative to the box, and boxes, of every step."""
    found = [
        (
            segment.unsorted("x", row) @ np.linalg.inv(segment.cell_of(row).matrix),
            np.asarray(segment.cell_of(row).matrix),
        )
        for segment in Engine(simulation, steps).segments()
        for row in range(segment.rows)
    ]
    return [np.array(part) for part in zip(*found, strict=True)]


def compared(a, b, steps: int = STEPS, **options: Any):
    """Separation, strain and whether a bit differs at every step, as lockstep has them."""
    options = {"forward": True, "back": False, "guard": None} | options
    parts = [
        (part.separation["B"], part.separation["B|A"], part.strain["B"], part.bits)
        for part in MdProgram(a).lockstep(MdProgram(b), steps, **options)
    ]
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def expected(a, b):
    """The same in numpy: differences of relative positions, as lengths in the box of A."""
    (f, m), (g, n) = rows(a), rows(b)
    apart = g - f
    apart = (apart - np.rint(apart)) @ m
    strain = np.abs(np.linalg.svd(np.linalg.solve(m, n), compute_uv=False) - 1).max(axis=1)
    return np.sqrt((apart**2).sum(axis=2).max(axis=1)), strain


def test_boxes_that_differ_alone_are_no_motion_of_atoms():
    a = pressed(cutoff="switched")
    small = np.eye(3) + 1e-6 * np.array([[1, 0.5, 0], [0, -0.3, 0], [0.2, 0, 0]])
    b = replace(a, positions=a.positions @ small).with_cell(Cell.create(a.cell.matrix @ small))
    free, imposed, strain, bits = compared(a, b)
    apart, between = expected(a, b)
    assert bits.all() and strain[0] == pytest.approx(between[0], rel=1e-6) and 1e-6 < strain[0] < 2e-6
    # where it was counted as motion, it was the strain times the distance from the origin
    assert free[0] < 1e-14 and np.linalg.norm(a.positions @ (small - np.eye(3)), axis=1).max() > 3e-6
    assert np.allclose(free, apart, rtol=1e-6, atol=1e-14) and np.allclose(strain, between, rtol=1e-4)
    assert np.allclose(imposed, free, rtol=0.2, atol=1e-13) and 1e-10 < free[-1] < 1e-5


def test_perturbed_positions_and_boxes_that_follow():
    """B under A's decisions has the box of its own dynamics."""
    a = pressed(cutoff="switched")
    b = replace(a, positions=a.positions + 1e-7 * np.random.default_rng(1).standard_normal((108, 3)))
    free, imposed, strain, bits = compared(a, b)
    apart, between = expected(a, b)
    assert np.allclose(free, apart, rtol=1e-6) and np.allclose(strain, between, rtol=1e-3, atol=1e-15)
    assert bits.all() and strain[0] == 0 and 0 < strain[-1] < 1e-6
    assert np.allclose(imposed, free, rtol=1e-2)
    free, imposed, strain, bits = compared(a, a)
    assert not free.any() and not imposed.any() and not strain.any() and not bits.any()


@pytest.mark.nightly
@pytest.mark.parametrize("choice", [Rotate(axes="yzx"), Rotate(axes="-x-yz"), Translate()])
def test_other_axes_and_another_origin_are_the_same_boxes(choice):
    a = pressed("mtk", "full", cutoff="switched")
    twin = choice.make(a)
    parts = list(twin.a.lockstep(twin.b, STEPS, forward=False, back=False, guard=None))
    free, strain = (
        np.concatenate([getattr(part, name)["B"] for part in parts]) for name in ("separation", "strain")
    )
    assert free.max() < 1e-11 and strain.max() < 1e-12 and np.isfinite(free).all()


@pytest.mark.nightly
@pytest.mark.parametrize("choice", ["precision", "skin"])
def test_a_fork_says_both_separations_and_strains(choice, tmp_path):
    made = mdnum.fork(
        pressed(cutoff="switched"),
        choice,
        steps=60,
        repeats=0,
        lyapunov=False,
        report=False,
        out=tmp_path / "fork",
    )
    summary, table = made.summary, RunFolder.open(tmp_path / "fork").read("separation")
    boxes = summary["boxes"]
    assert boxes["end"] == table["strain"][-1] and boxes["largest"] == table["strain"].max()
    for date in ("first_bit", "fork", "split"):
        at = summary[date]
        assert boxes[date] == (
            None if at is None else {"strain": table["strain"][at], "separation": table["free"][at]}
        )
    # another skin need not change a bit in so few steps
    assert (boxes["largest"] > 0) == (table["strain_imposed"] > 0).any() == (summary["first_bit"] is not None)


def test_a_strain_is_the_largest_change_of_a_length():
    cell, by = Cell.create([4.0, 5.0, 6.0]), np.diag([1.01, 0.97, 1.0])
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    others = [Cell.create(cell.matrix @ one) for one in (np.eye(3), by, turned)]
    assert np.allclose(strains([cell] * 3, others), [0.0, 0.03, 0.0], atol=1e-15)
    x = np.random.default_rng(1).uniform(0, 4, (3, 3, 20))
    carried = np.stack(
        [np.linalg.solve(cell.matrix, other.matrix).T @ one for one, other in zip(x, others, strict=True)]
    )
    assert separations([cell] * 3, x, carried, others).max() < 1e-14
