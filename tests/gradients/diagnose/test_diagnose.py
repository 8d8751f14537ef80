"""What a difference between two methods means, and what a diagnosis says where a part cannot be had."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients.diagnose import agreement, compare, diagnose
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.losses import Custom, MeanSquaredDisplacement
from mdnum.gradients.problem import Gradient, Problem
from mdnum.systems import build

KINDS: dict[str, Any] = {
    "event-aware": "flow", "finite-differences": "values", "surrogate": "other program",
    "ensemble": "average",
}  # fmt: skip


def told(method: str, value: float, **details: Any) -> Gradient:
    return Gradient(method, "", 0.0, {"q": np.asarray(value)}, {}, details, KINDS.get(method, "steps"))


#: How much the gradient by the state grew.
EXACT, CHAOTIC = 1.0, 1e6


@pytest.mark.parametrize(
    ("first", "second", "growth", "jumps", "means"),
    [
        (told("unrolled", 1 + 1e-14), told("symmetric", 1.0), EXACT, True, "agree"),
        (told("unrolled", 1 + 1e-8), told("symmetric", 1.0), CHAOTIC, True, "rounding"),
        (told("unrolled", 1 + 1e-8), told("symmetric", 1.0), EXACT, True, "unexplained"),
        (told("symmetric", 0.9), told("event-aware", 1.0), EXACT, True, "missing saltation"),
        (told("symmetric", 0.9), told("event-aware", 1.0), EXACT, False, "unexplained"),
        (told("finite-differences", 0.9, error={"q": 0.05}), told("symmetric", 1.0), EXACT, True,
         "truncation and noise"),
        (told("finite-differences", 0.9, error={"q": 1e-3}), told("symmetric", 1.0), EXACT, True,
         "events between shifts"),
        (told("finite-differences", 0.9, error={"q": 1e-3}), told("symmetric", 1.0), EXACT, False,
         "unexplained"),
        (told("surrogate", 0.5), told("event-aware", 1.0), EXACT, True, "another program"),
        (told("ensemble", 0.5), told("event-aware", 1.0), EXACT, True, "an average"),
        (told("symmetric", np.nan), told("event-aware", 1.0), EXACT, True, "unexplained"),
    ],
)  # fmt: skip
def test_a_difference_has_a_meaning(first, second, growth, jumps, means):
    found = compare("q", first, second, 2.0**-53, growth, jumps=jumps)
    assert found.meaning == means


def test_two_zeros_agree():
    found = compare("q", told("unrolled", 0.0), told("symmetric", 0.0), 2.0**-53, 1.0, jumps=False)
    assert found.relative == 0.0 and found.meaning == "agree"


@pytest.mark.slow
def test_the_particle_that_leaves_its_well_is_an_eighth_off_without_its_flip(well):
    found = agreement(well[0], ("x0", "sigma"), ["symmetric", "event-aware", FiniteDifferences(levels=2)])
    assert found.reference == "event-aware"
    by_name = {one.name: one for one in found.comparisons if one.method == "symmetric"}
    assert by_name["initial.positions"].relative == pytest.approx(0.125, abs=5e-3)
    assert {one.meaning for one in by_name.values()} == {"missing saltation"}
    # a method that cannot have all parameters is asked for those it can
    shifted = found.gradient("finite-differences")
    assert shifted is not None and list(shifted.gradient) == ["potential.sigma"]


def test_what_does_not_apply_is_listed_with_the_reason(well):
    problem, _ = well
    given = Gradient("event-aware", "", 0.0, {"initial.positions": np.ones((2, 3))}, kind="flow")
    words = ["event-aware", "finite-differences"]
    found = agreement(problem, ("x0",), words, known={"event-aware": given})
    left = found.opinions[1]
    assert left.found is None and "each shift" in left.missing
    with pytest.raises(InputError, match="no method applies"):
        agreement(problem, ("x0",), ["finite-differences"])
    with pytest.raises(InputError, match="no method 'symetric'"):
        agreement(problem, ("x0",), ["symetric"])


def test_parts_that_cannot_be_had_say_why():
    simulation = build(
        make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.2}, precision={"force": "bfloat16"})
    )
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
    assert found.growth is not None and not found.growth.table["size"].any()
