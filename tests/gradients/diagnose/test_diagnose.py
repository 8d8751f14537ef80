"""What a diagnosis says where a part cannot be had; a whole one stands in test_flips."""

from __future__ import annotations

import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.gradients.diagnose import diagnose
from mdnum.gradients.losses import Custom, MeanSquaredDisplacement
from mdnum.systems import build

HARD = {"kind": "hard", "radius": 2.2}


def test_parts_that_cannot_be_had_say_why():
    simulation = build(make(crystal(), LENNARD_JONES, HARD, precision={"force": "bfloat16"}))
    problem = Problem(simulation, MeanSquaredDisplacement(), 2)
    found = diagnose(problem, ("v0",), parts=("trust", "flips", "growth"))
    assert found.trust is None and found.flips is None and found.growth is None
    assert set(found.failed) == {"trust", "flips", "growth"}
    assert "rounded after every operation" in found.failed["trust"]
    with pytest.raises(InputError, match="no part 'grwth'"):
        diagnose(problem, ("v0",), parts=("grwth",))


@pytest.mark.slow
def test_what_nothing_depends_on_is_noted():
    loss = Custom(see=lambda frame, *_: 0 * frame.v[0, 0], first=5)
    found = diagnose(Problem(build("pair/leaving-well"), loss, 5), ("sigma",), parts=("growth",))
    assert "depends" in found.notes["potential.sigma"]
    assert found.growth is not None and not found.growth.size.any()
