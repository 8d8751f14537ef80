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


def told(method: str, value: float, error: float | None = None) -> Gradient:
    details = {} if error is None else {"error": {"q": error}}
    return Gradient(method, "", 0.0, {"q": np.asarray(value)}, {}, details, KINDS.get(method, "steps"))


AWARE, PLAIN = told("event-aware", 1.0), told("symmetric", 1.0)


@pytest.mark.parametrize(
    ("first", "second", "growth", "jumps", "means"),
    [
        (told("unrolled", 1 + 1e-14), PLAIN, 1.0, True, "agree"),
        (told("unrolled", 0.0), told("symmetric", 0.0), 1.0, False, "agree"),
        # of a gradient by the state that grew a million times
        (told("unrolled", 1 + 1e-8), PLAIN, 1e6, True, "rounding"),
        (told("unrolled", 1 + 1e-8), PLAIN, 1.0, True, "unexplained"),
        (told("symmetric", 0.9), AWARE, 1.0, True, "missing saltation"),
        (told("symmetric", 0.9), AWARE, 1.0, False, "unexplained"),
        (told("symmetric", np.nan), AWARE, 1.0, True, "unexplained"),
        (told("finite-differences", 0.9, 0.05), PLAIN, 1.0, True, "truncation and noise"),
        (told("finite-differences", 0.9, 1e-3), PLAIN, 1.0, True, "events between shifts"),
        (told("finite-differences", 0.9, 1e-3), PLAIN, 1.0, False, "unexplained"),
        (told("surrogate", 0.5), AWARE, 1.0, True, "another program"),
        (told("ensemble", 0.5), AWARE, 1.0, True, "an average"),
    ],
)
def test_a_difference_has_a_meaning(first, second, growth, jumps, means):
    assert compare("q", first, second, 2.0**-53, growth, jumps=jumps).meaning == means


def test_what_does_not_apply_is_listed_with_the_reason_and_asked_for_what_it_has(well):
    problem, _ = well
    values = {"initial.positions": np.ones((2, 3)), "potential.sigma": np.ones(())}
    known = {"event-aware": Gradient("event-aware", "", 0.0, values, kind="flow")}
    words = ["event-aware", "finite-differences"]
    found = agreement(problem, ("x0",), words, known=known)
    left = found.opinions[1]
    assert left.found is None and "each shift" in left.missing and found.reference == "event-aware"
    # a method that cannot have all parameters is asked for those it can
    method = FiniteDifferences(relative=1e-6, levels=1)
    shifted = agreement(problem, ("x0", "sigma"), ["event-aware", method], known=known).gradient(method.name)
    assert shifted is not None and list(shifted.gradient) == ["potential.sigma"]
    with pytest.raises(InputError, match="is applicable"):
        agreement(problem, ("x0",), ["finite-differences"])
    with pytest.raises(InputError, match="method 'symetric'"):
        agreement(problem, ("x0",), ["symetric"])


def test_parts_that_cannot_be_had_say_why():
    simulation = build(
        make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.2}, precision={"force": "bfloat16"})
    )
    problem = Problem(simulation, MeanSquaredDisplacement(), 2)
    found = diagnose(problem, ("v0",), parts=("trust", "flips", "growth"))
    assert found.trust is None and found.flips is None and found.growth is None
    assert set(found.failed) == {"trust", "flips", "growth"}
    assert all(found.failed.values())
    with pytest.raises(InputError, match="part of a diagnosis 'grwth'"):
        diagnose(problem, ("v0",), parts=("grwth",))


@pytest.mark.slow
def test_what_nothing_depends_on_is_noted():
    loss = Custom(see=lambda frame, *_: 0 * frame.v[0, 0], first=5)
    found = diagnose(Problem(build("pair/leaving-well"), loss, 5), ("sigma",), parts=("growth",))
    assert "not depend" in found.notes["potential.sigma"]
    assert found.growth is not None and not found.growth.table["size"].any()
