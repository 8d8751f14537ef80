"""What several files compare with: a system without jumps, a reverse pass through it, and one flip."""

from __future__ import annotations

import numpy as np
import pytest
from gradient_problems import everything
from small_systems import LENNARD_JONES, crystal, make

from mdnum.gradients import Problem
from mdnum.gradients.losses import Custom
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


@pytest.fixture(scope="session")
def well():
    """The final relative speed of the pair that leaves its well, and the axis that it leaves along."""
    simulation = build("pair/leaving-well")
    axis = int(np.argmax(np.abs(simulation.positions[1] - simulation.positions[0])))
    loss = Custom(see=lambda frame, *_: frame.v[axis, 1] - frame.v[axis, 0], first=2000)
    return Problem(simulation, loss, 2000), axis
