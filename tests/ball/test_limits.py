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

#: alpha and k whose product is a share that an iteration takes.
GAINS = [(0.5, 0.5), (0.25, 0.5), (1.0, 0.75), (1.0, 1.0), (0.5, 0.0625), (1.25, 1.0)]


def stuck_float16(alpha: float, k: float) -> float:
    """The largest penetration that numpy's float16 iterates for ever, by trying the smallest ones."""
    gain = np.float16(np.float16(alpha) * np.float16(k))
    grain = float(np.finfo(np.float16).smallest_subnormal)
    worst = 0.0
    for grains in range(1, 200):
        p = np.float16(grains * grain)
        for _ in range(2000):
            shrunk = np.float16(p - np.float16(gain * p))
            if shrunk == p or shrunk <= 0:
                break
            p = shrunk
        if p > 0 and np.float16(p - np.float16(gain * p)) == p:
            worst = max(worst, float(p))
    return worst


@pytest.mark.parametrize(("alpha", "k"), GAINS)
def test_float16_by_brute_force(alpha, k):
    worst = stuck_float16(alpha, k)
    least = limits.smallest_tolerance(RolePrecision.all("float16"), alpha * k)["arithmetic"]
    # residual < tol: the next number above the worst that stays is the smallest that all pass
    assert least == float(neighbor(np.float16(worst), 1, np.float16))


@pytest.mark.parametrize(
    ("name", "alpha", "k"),
    [
        ("float16", 0.25, 0.5),
        ("bfloat16", 0.5, 0.5),
        pytest.param("float16", 0.5, 0.5, marks=pytest.mark.nightly),
        pytest.param("float32", 0.5, 0.5, marks=pytest.mark.nightly),
    ],
)
def test_the_solver_meets_it_from_every_penetration_and_not_the_number_below(name, alpha, k):
    policy = RolePrecision.all(name)
    usable = limits.smallest_tolerance(policy, alpha * k)
    least = usable["arithmetic"]
    assert least == max(usable.values())
    dtype = limits.DTYPES[name]
    # every number from the smallest up to a few times the tolerance, or a fine net of them
    ordinals = np.unique(np.linspace(0, int(2e3), 2000).astype(int))
    starts = np.array([float(neighbor(least, -int(n), dtype)) for n in ordinals])
    starts = np.concatenate([starts[starts > 0], least * np.linspace(1, 8, 200)])
    rule = ball.PerInstance(least, 400)
    world = ball.World.create(
        ball.Projection(k, alpha, rule), ball.SemiImplicitEuler(2.0**-6), 0.0, policy=policy
    )
    run = ball.simulate(world, world.start(-starts), 1)
    assert run.ended() == {"tolerance": len(starts)}
    below = float(neighbor(least, -1, dtype))
    short = ball.simulate(world.with_values({"tol": below}), world.start(-starts), 1)
    assert short.ended().get("cap", 0) > 0


SYSTEM = """
world = "ball"
[contact]
kind = "projection"
k = 0.5
alpha = 0.5
[stop]
rule = "per-instance"
tol = 1e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
"""


def test_files_and_worlds_ask_for_the_same(tmp_path):
    """What a system file is allowed is what the world that it describes is allowed, in every role."""
    path = tmp_path / "projection.toml"
    path.write_text(SYSTEM)
    for name in ("float16", "bfloat16"):
        for roles in (("arithmetic",), ("decision",), ("state", "arithmetic", "decision")):
            low = {f"precision.{role}": name for role in roles}
            precision = load(path, low, world="ball").spec.precision
            least = max(limits.smallest_tolerance(precision, 0.25).values())
            build_ball(path, low | {"stop.tol": least})
            with pytest.raises(InputError, match="smallest usable tolerance"):
                load(path, low | {"stop.tol": 0.9 * least})
            world = build_ball(path, low | {"stop.tol": least}).problem.world
            with pytest.raises(InputError, match="smallest usable tolerance"):
                ball.World.create(
                    ball.Projection(0.5, 0.5, ball.PerInstance(0.9 * least)), ball.SemiImplicitEuler(0.001),
                    policy=world.policy,
                )  # fmt: skip


def test_a_share_is_no_height():
    """A relative tolerance may be smaller than any height of the arithmetic."""
    low = RolePrecision("float16", "float16", "float64", "float64", "float64")
    rule = ball.Relative(1e-9, 5)
    world = ball.World.create(ball.Projection(0.5, 0.5, rule), ball.SemiImplicitEuler(0.01), policy=low)
    assert isinstance(world.contact, ball.Projection) and float(world.contact.stop.tol) < 2e-9
