"""The smallest usable tolerance against every small penetration there is."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum import ball
from mdnum.ball import limits
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.rounding import neighbor
from mdnum.systems import build_ball, load

NIGHTLY = pytest.mark.nightly


@pytest.mark.parametrize("gain", [0.25, 0.125, 0.75, 1.0, 0.03125, 1.25])
def test_float16_by_brute_force(gain):
    """The largest penetration that numpy's float16 iterates for ever, by trying the smallest ones."""
    p = np.arange(1, 200).astype(np.float16) * np.finfo(np.float16).smallest_subnormal
    for _ in range(2000):
        shrunk = p - np.float16(gain) * p
        p = np.where(shrunk > 0, shrunk, p * (shrunk == p)).astype(np.float16)
    least = limits.smallest_tolerance(RolePrecision.all("float16"), gain)["arithmetic"]
    # residual < tol: the next number above the worst that stays is the smallest that all pass
    assert least == float(neighbor(p.max(), 1, np.float16))


@pytest.mark.parametrize(
    ("name", "alpha"),
    [
        ("float16", 0.25), ("bfloat16", 0.5),
        pytest.param("float16", 0.5, marks=NIGHTLY), pytest.param("float32", 0.5, marks=NIGHTLY),
    ],
)  # fmt: skip
def test_the_solver_meets_it_from_every_penetration_and_not_the_number_below(name, alpha):
    policy, dtype = RolePrecision.all(name), limits.DTYPES[name]
    usable = limits.smallest_tolerance(policy, alpha * 0.5)
    least = usable["arithmetic"]
    assert least == max(usable.values())
    # every number from the smallest up to a few times the tolerance, or a fine net of them
    starts = np.array([float(neighbor(least, -n, dtype)) for n in range(2000)])
    starts = np.concatenate([starts[starts > 0], least * np.linspace(1, 8, 200)])
    contact = ball.Projection(0.5, alpha, ball.PerInstance(least, 400))
    world = ball.World.create(contact, ball.SemiImplicitEuler(2.0**-6), 0.0, policy=policy)
    run = ball.simulate(world, world.start(-starts), 1)
    assert run.ended() == {"tolerance": len(starts)}
    below = world.with_values({"tol": float(neighbor(least, -1, dtype))})
    assert ball.simulate(below, world.start(-starts), 1).ended().get("cap", 0) > 0


@pytest.mark.parametrize("name", ["float16", "bfloat16"])
@pytest.mark.parametrize("roles", [("arithmetic",), ("decision",), ("state", "arithmetic", "decision")])
def test_files_and_worlds_ask_for_the_same(name, roles):
    """What a system file is allowed is what the world that it describes is allowed, in every role."""
    path, low = "ball/batch-on-the-boundary", {f"precision.{role}": name for role in roles}
    low |= {"start": "{height=1.0}", "stop.rule": "per-instance", "stop.tol": 1e-3}
    least = max(limits.smallest_tolerance(load(path, low, world="ball").spec.precision, 0.25).values())
    world = build_ball(path, low | {"stop.tol": least}).problem.world
    with pytest.raises(InputError, match="smallest usable tolerance"):
        load(path, low | {"stop.tol": 0.9 * least})
    contact = ball.Projection(0.5, 0.5, ball.PerInstance(0.9 * least))
    with pytest.raises(InputError, match="smallest usable tolerance"):
        ball.World.create(contact, ball.SemiImplicitEuler(0.001), policy=world.policy)


def test_a_share_is_no_height():
    """A relative tolerance may be smaller than any height of the arithmetic."""
    low = RolePrecision("float16", "float16", "float64", "float64", "float64")
    contact = ball.Projection(0.5, 0.5, ball.Relative(1e-9, 5))
    world = ball.World.create(contact, ball.SemiImplicitEuler(0.01), policy=low)
    assert float(world.value("tol")) < 2e-9
