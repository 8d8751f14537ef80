"""What a difference between two methods means, on gradients made up and on a run with one flip."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.gradients.diagnose.agreement import RoundingScale, agreement, compare
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.losses import Custom
from mdnum.gradients.problem import Gradient, Problem
from mdnum.systems import build

KINDS: dict[str, Any] = {
    "event-aware": "flow", "finite-differences": "values", "surrogate": "other program",
    "ensemble": "average",
}  # fmt: skip


def told(method: str, value: float, **details: Any) -> Gradient:
    return Gradient(method, "", 0.0, {"q": np.asarray(value)}, {}, details, KINDS.get(method, "steps"))


EXACT = RoundingScale(unit=2.0**-53)
CHAOTIC = RoundingScale(unit=2.0**-53, growth=1e6)


@pytest.mark.parametrize(
    ("first", "second", "scale", "jumps", "means"),
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
def test_a_difference_has_a_meaning(first, second, scale, jumps, means):
    found = compare("q", first, second, scale, jumps=jumps)
    assert found.meaning == means


def test_two_zeros_agree():
    found = compare("q", told("unrolled", 0.0), told("symmetric", 0.0), EXACT, jumps=False)
    assert found.relative == 0.0 and found.meaning == "agree"


@pytest.fixture(scope="module")
def problem():
    simulation = build("pair/leaving-well")
    axis = int(np.argmax(np.abs(simulation.positions[1] - simulation.positions[0])))
    loss = Custom(see=lambda frame, *_: frame.v[axis, 1] - frame.v[axis, 0], first=2000)
    return Problem(simulation, loss, 2000)


@pytest.mark.slow
def test_the_particle_that_leaves_its_well_is_an_eighth_off_without_its_flip(problem):
    found = agreement(problem, ("x0", "sigma"), ["symmetric", "event-aware", FiniteDifferences(levels=2)])
    assert found.reference == "event-aware"
    by_name = {one.name: one for one in found.comparisons if one.method == "symmetric"}
    assert by_name["initial.positions"].relative == pytest.approx(0.125, abs=5e-3)
    assert {one.meaning for one in by_name.values()} == {"missing saltation"}
    # a method that cannot have all parameters is asked for those it can
    shifted = found.gradient("finite-differences")
    assert shifted is not None and list(shifted.gradient) == ["potential.sigma"]


def test_what_does_not_apply_is_listed_with_the_reason(problem):
    given = Gradient("event-aware", "", 0.0, {"initial.positions": np.ones((2, 3))}, kind="flow")
    words = ["event-aware", "finite-differences"]
    found = agreement(problem, ("x0",), words, known={"event-aware": given})
    left = found.opinions[1]
    assert left.found is None and "each shift" in left.missing
    with pytest.raises(InputError, match="no method applies"):
        agreement(problem, ("x0",), ["finite-differences"])
    with pytest.raises(InputError, match="no method 'symetric'"):
        agreement(problem, ("x0",), ["symetric"])
