"""What the tests of forks share: twins of simulations and of balls, and starts a little apart."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rollout.harness import CRYSTAL, moved

from mdnum.ball.problem import BallProblem
from mdnum.ball.program import BallProgram
from mdnum.forks import Fork, Twin, fork
from mdnum.forks.choices import parse, twin_of
from mdnum.rollout.program import MdProgram
from mdnum.systems.build import build
from mdnum.systems.load import System, load
from mdnum.systems.simulation import Simulation


@cache
def crystal(**overrides: Any) -> Simulation:
    """The cold crystal of 108 atoms; overrides with "__" for the dots of their keys."""
    return build(crystal_system(**overrides))


@cache
def crystal_system(**overrides: Any) -> System:
    return load(CRYSTAL, {key.replace("__", "."): value for key, value in overrides.items()}, world="md")


def pair(a: Simulation, b: Simulation, difference: str = "start", **frame: Any) -> Twin:
    return Twin(MdProgram(a), MdProgram(b, **frame), difference)


@cache
def followed(size: float, steps: int, **options: Any) -> Fork:
    """Two crystals a size apart, followed."""
    return fork(pair(crystal(), moved(crystal(), size)), steps, **options)


def made(word: str, system: Any) -> Twin:
    """The twin of a choice."""
    return twin_of(parse(word), system)


def balls(a: Any, b: Any, y_a: Any, y_b: Any = None, steps: int = 1000, **program: Any) -> Twin:
    """The twin of two worlds of a ball and their start heights."""
    y_b = y_a if y_b is None else y_b
    one, other = (
        BallProblem(world, np.asarray(y, np.float64), 0.0, steps) for world, y in ((a, y_a), (b, y_b))
    )
    return Twin(BallProgram(one), BallProgram(other, **program), "two programs")
