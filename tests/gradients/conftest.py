"""A system without jumps, and one reverse pass through it, that several files compare with."""

from __future__ import annotations

import pytest
from gradient_problems import everything
from small_systems import LENNARD_JONES, crystal, make

from mdnum.gradients import Problem
from mdnum.gradients.recorded import Symmetric
from mdnum.systems import build


@pytest.fixture(scope="session")
def smooth():
    return build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.2, "onset": 1.8}))


@pytest.fixture(scope="session")
def switched(smooth):
    return Problem(smooth, everything(smooth.atoms), 40)


@pytest.fixture(scope="session")
def by_hand(switched):
    """Its derivatives by everything: of some parameters alone the pass would be another program."""
    names = ("sigma", "epsilon", "r_cut", "r_onset", "timestep", "temperature", "scale", "x0", "v0")
    return Symmetric()(switched, names)
