"""Runs reversed: the states that come by are those of the run, and the gradient is theirs."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gradient_problems import everything
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError, NumericalError
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.losses import FinalProjection
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import Reversible, Symmetric
from mdnum.gradients.tape import ReversibleTape
from mdnum.rollout.engine import Engine
from mdnum.systems import build

HARD = {"kind": "hard", "radius": 1.5}
SMOOTH = {"kind": "quintic", "radius": 1.55, "onset": 1.3}
# friction so strong that the bath is put aside several times
BATH = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 250.0, "seed": 3}
STEPS = 120


def small(cutoff=HARD, potential=LENNARD_JONES, **tables):
    """32 atoms in a box 3.6 wide, in fixed-point numbers."""
    return build(make(crystal(repeat=2), potential, cutoff, precision={"state": "lattice"}, **tables))


def recorded(simulation, steps: int):
    """What a forward run recorded at every step, in the user's order, with the pairs inside."""
    found = {}
    for segment in Engine(simulation, steps).segments():
        for row in range(segment.rows):
            i, j = segment.table.decided(segment.rows_of("bits")[row])
            found[segment.first + row] = (
                *(segment.unsorted(name, row) for name in ("x", "v", "images")),
                *(segment.rows_of(name)[row] for name in ("potential", "virial", "kinetic", "heat")),
                sorted(zip(i.tolist(), j.tolist(), strict=True)),
            )
    return found


def way_back(simulation, steps: int) -> ReversibleTape:
    """The way back against the run: states, energies and decisions, bit for bit."""
    tape = ReversibleTape(simulation, everything(simulation.atoms), steps)
    rows, seen = recorded(simulation, steps), 0
    for stretch in tape.backward():
        order = stretch.table.order
        for row in range(stretch.rows):
            *state, potential, virial, _, _, inside = rows[stretch.first + row]
            for back, ahead in zip((stretch.x, stretch.v, stretch.images), state, strict=True):
                assert np.array_equal(back[row], ahead.T[:, order])
            assert stretch.potential[row] == potential and stretch.virial[row] == virial
            i, j = stretch.table.decided(stretch.bits[row])
            assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == inside
            seen += 1
    assert seen == steps + 1
    return tape


def test_the_way_back_is_the_run():
    # a hard cutoff, so that decisions change on the way
    assert way_back(small(), STEPS).nbytes == 0


@pytest.mark.slow
def test_friction_is_undone_from_what_it_put_aside():
    tape = way_back(small(dynamics=BATH), STEPS)
    # by the rate at which friction forgets, rounded up to whole numbers of 64 bits
    bits = STEPS * BATH["friction"] * BATH["timestep"] / np.log(2)
    assert bits / 64 <= len(tape.baths) <= bits / 30 and len(tape.baths) >= 4


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    simulation = small(SMOOTH)
    asked = Problem(simulation, everything(simulation.atoms), 40)
    names = ("sigma", "epsilon", "timestep", "temperature")
    ours = Reversible()(asked, (*names, "x0", "v0"))
    # steps far wider than the spacing, so that its roundings average out
    theirs = FiniteDifferences(relative=1e-3, levels=3)(asked, names)
    assert ours.value == theirs.value and ours.details["returned to the start"]
    for name, value in theirs.gradient.items():
        assert float(ours.gradient[name]) == pytest.approx(float(value), rel=1e-4), name
    # left alone they must not fall between two whole numbers
    (alone,) = FiniteDifferences()(asked, ("epsilon",)).gradient.values()
    assert float(alone) == pytest.approx(float(ours.gradient["potential.epsilon"]), rel=1e-3)
    floats = Symmetric()(replace(asked, simulation=asked.simulation.smooth), (*names, "x0", "v0"))
    for name, value in floats.gradient.items():
        assert np.allclose(ours.gradient[name], value, rtol=0, atol=1e-6 * np.abs(value).max()), name


@pytest.mark.slow
def test_a_run_that_missed_pairs_is_not_found_back():
    # lists that are used far beyond their skin; the way back uses none of them so
    blind = {"skin": 0.02, "rebuild": {"every": 50, "delay": 50, "check": False}}
    simulation = small(neighbors=blind, dynamics={"kind": "nve", "timestep": 0.004, "temperature": 3.0})
    with pytest.raises(NumericalError, match=r"deviate (at step|between steps) \d+"):
        Reversible()(Problem(simulation, FinalProjection(), STEPS), ("sigma",))


def test_floats_cannot_be_taken_back():
    problem = Problem(build("argon/crystal-108"), FinalProjection(), 10)
    with pytest.raises(InputError, match="lattice"):
        Reversible()(problem, ("sigma",))


@pytest.mark.nightly
@pytest.mark.parametrize("bath", (False, True))
def test_a_hundred_thousand_steps_back_to_the_start(bath):
    """Lists of the way back are built independently; `backward` raises where a bit of the start is wrong."""
    gentle = {**BATH, "friction": 1.0}
    simulation = small(**({"dynamics": gentle} if bath else {}))
    assert simulation.fixed_point is not None
    # with friction a step takes three times as long, and nothing more is to be seen
    steps = 5_000 if bath else 100_000
    tape = ReversibleTape(simulation, FinalProjection(), steps)
    rows = 0
    for stretch in tape.backward():
        rows += stretch.rows
        first = stretch
    assert rows == steps + 1 and first.first == 0
    x = simulation.fixed_point.positions(simulation.positions)
    matrix = np.asarray(simulation.cell.matrix)
    back = (first.x[0] + (matrix.T @ first.images[0])).T[np.argsort(first.table.order)]
    assert np.array_equal(back, x)
    # far from where it began in between, and no more kept than what friction forgets
    assert tape.nbytes <= (simulation.atoms * 3 * 8 * 30 if bath else 0)


def digest() -> str:
    """Of everything that two runs recorded."""
    found = hashlib.sha256()
    morse = {"kind": "morse", "depth": 1.0, "alpha": 5.0, "r0": 1.1}
    for simulation in (
        small({"kind": "force-shifted", "radius": 1.5}),
        small({"kind": "cosine", "radius": 1.5, "onset": 1.2}, morse, dynamics={**BATH, "friction": 5.0}),
    ):
        for *numbers, inside in recorded(simulation, 300).values():
            found.update(b"".join(np.asarray(one).tobytes() for one in numbers) + repr(inside).encode())
    return found.hexdigest()


CHILD = (
    'import sys; sys.path[:0] = ["tests/support", "tests/gradients"]; '
    "import test_reversible as t; print(t.digest())"
)


@pytest.mark.nightly
def test_instruction_sets_and_optimization_do_not_matter():
    """The same bits of states, decisions and energies from programs that a compiler makes differently."""
    seen = {}
    # with fused multiply-add, without it, and without a compiler's rearrangements
    for flags in ("", "--xla_cpu_max_isa=SSE4_2", "--xla_backend_optimization_level=0"):
        environment = {**os.environ, "XLA_FLAGS": flags}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        made = subprocess.run(
            [sys.executable, "-c", CHILD], env=environment, capture_output=True, text=True, check=True
        )
        seen[flags] = made.stdout.strip()
    assert len(set(seen.values())) == 1, seen
    assert len(seen[""]) == 64
