"""The bouncing ball in exact arithmetic, for time steps that consist of sums and products."""

from __future__ import annotations

import decimal
import math
from decimal import Decimal
from typing import Any, SupportsFloat

import numpy as np

from mdnum.ball.rollout import BallRun
from mdnum.ball.step import (
    BallState,
    BallVerlet,
    ExplicitEuler,
    Impact,
    Penalty,
    Projection,
    SemiImplicitEuler,
)
from mdnum.ball.stopping import FixedCount, GlobalSum, HysteresisStop, Maximum, PerInstance, Relative
from mdnum.ball.world import World
from mdnum.errors import InputError, expect_at_least
from mdnum.numerics.events import Ledger

# a float is a decimal of finitely many digits, and so are sums and products of decimals: all are kept
_RANGE: dict[str, Any] = {"Emin": decimal.MIN_EMIN, "Emax": decimal.MAX_EMAX}
_EXACT = decimal.Context(decimal.MAX_PREC, traps=[decimal.Inexact, decimal.InvalidOperation], **_RANGE)
# more digits than a number halfway between two floats has, the last of which says whether anything was cut:
# the rounding to 53 bits is then the correct one
_LONG = decimal.Context(800, decimal.ROUND_05UP, **_RANGE)

ZERO, HALF = Decimal(0), Decimal("0.5")

Balls = list[Decimal]


def exactly(value: SupportsFloat) -> Decimal:
    """Convert a float of at most 64 bits to an exact decimal number.

    Raises:
        ValueError: the float is not finite.
    """
    value = float(value)
    if not math.isfinite(value):
        raise ValueError(f"{value} is not a number")
    return Decimal(value)


def nearest(value: Decimal) -> float:
    """Round a decimal number to the nearest float; zero has a positive sign."""
    return float(_LONG.plus(value)) + 0.0


def ball_history(world: World, start: BallState, steps: int) -> BallRun:
    """Compute the run of a ball in exact arithmetic.

    Quantities that do not affect decisions, such as residuals, are not recorded.

    Error: recorded values are rounded to double precision; the calculation itself is exact.

    Raises:
        InputError: steps is below 1, or a time step does not consist of sums and products.
    """
    expect_at_least(1, steps=steps)
    with decimal.localcontext(_EXACT):
        program = _ExactBall(world, start)
        first = [[nearest(c) for c in row] for row in (program.y, program.v)]
        y, v, height, contact, counts = zip(*(program.step(index) for index in range(steps)), strict=True)
    iterations = np.array(counts, np.int64)
    unknown = np.full(iterations.shape, np.nan)
    none, real = np.zeros(0, np.int64), np.zeros(0)
    flips = Ledger("contact", none, none[:, None], real > 0, real, real, real)
    return BallRun(
        world=world, steps=steps, balls=len(program.y), y=np.array([first[0], *y]),
        v=np.array([first[1], *v]), height=np.array(height), contact=np.array(contact, bool),
        iterations=iterations if program.each else iterations[:, 0],
        reason=np.zeros(iterations.shape, np.int8), residual=unknown, margin=unknown, before=unknown,
        history=None, contacts=flips,
    )  # fmt: skip


class _ExactBall:
    """State of the balls in exact numbers, with a method for one time step."""

    def __init__(self, world: World, start: BallState):
        contact, scheme = world.contact, world.integrator
        served = isinstance(contact, Penalty | Projection | Impact) and isinstance(
            scheme, ExplicitEuler | SemiImplicitEuler | BallVerlet
        )
        if not served or getattr(contact, "smooth", False):
            raise InputError(
                f"the contact {type(contact).__name__} with the integrator {type(scheme).__name__} is not "
                "supported in exact arithmetic",
                remedy="Use explicit Euler, semi-implicit Euler or velocity Verlet, and a contact "
                "without smoothing",
            )
        self.world, self.contact_model, self.scheme = world, contact, scheme
        self.value = {name: exactly(world.value(name)) for name in world.parameters}
        self.h = self.value["h"]
        self.half = HALF * self.h
        self.y = [exactly(c) for c in np.asarray(start.y)]
        self.v = [exactly(c) for c in np.asarray(start.v)]
        self.each = isinstance(contact, Projection) and isinstance(_ExactRule(world).rule, PerInstance)
        self.touching = self._judge(self.y, [False] * len(self.y))
        self.carried = self._pull(self.y, self.v, self._free(0), self.touching)

    def _free(self, step: int) -> Balls:
        gravity, control = self.value["gravity"], self.world.control
        if control is None:
            return [-gravity] * len(self.y)
        row = np.asarray(control)[min(step, len(control) - 1)]
        return [exactly(c) - gravity for c in np.broadcast_to(row, len(self.y))]

    def _judge(self, heights: Balls, before: list[bool]) -> list[bool]:
        lift = self.value.get("lift")
        if lift is None:
            return [y < 0 for y in heights]
        return [y <= lift if was else y < 0 for y, was in zip(heights, before, strict=True)]

    def _pull(self, ys: Balls, vs: Balls, free: Balls, touching: list[bool]) -> Balls:
        if not isinstance(self.contact_model, Penalty):
            return free
        k, damping = self.value["k"], self.value["damping"]
        return [
            a + k * -y - damping * v if touches else a
            for y, v, a, touches in zip(ys, vs, free, touching, strict=True)
        ]

    def _fly(self, ys: Balls, vs: Balls, a: Balls) -> tuple[Balls, Balls]:
        h = self.h
        if isinstance(self.scheme, ExplicitEuler):
            return _plus(ys, h, vs), _plus(vs, h, a)
        if isinstance(self.scheme, SemiImplicitEuler):
            vs = _plus(vs, h, a)
            return _plus(ys, h, vs), vs
        vs = _plus(vs, self.half, a)
        return _plus(ys, h, vs), _plus(vs, self.half, a)

    def step(self, index: int):
        """Make a time step; return heights, velocities, tested heights, contacts and iteration counts."""
        free, counts = self._free(index), [0] * len(self.y)
        if isinstance(self.contact_model, Penalty):
            heights = self._push(free)
        else:
            ys, vs = self._fly(self.y, self.v, free)
            heights = ys
            self.touching = self._judge(heights, self.touching)
            reset = self._project if isinstance(self.contact_model, Projection) else self._bounce
            self.y, self.v, counts = reset(ys, vs)
        plain = ([nearest(c) for c in row] for row in (self.y, self.v, heights))
        return *plain, list(self.touching), counts

    def _push(self, free: Balls) -> Balls:
        if isinstance(self.scheme, BallVerlet):
            vs = _plus(self.v, self.half, self.carried)
            self.y = heights = _plus(self.y, self.h, vs)
            self.touching = self._judge(heights, self.touching)
            self.carried = self._pull(heights, vs, free, self.touching)
            self.v = _plus(vs, self.half, self.carried)
            return heights
        heights = self.y
        self.touching = self._judge(heights, self.touching)
        self.y, self.v = self._fly(self.y, self.v, self._pull(self.y, self.v, free, self.touching))
        return heights

    def _bounce(self, ys: Balls, vs: Balls):
        e, rest = self.value["restitution"], self.value["rest_speed"]
        for ball, touches in enumerate(self.touching):
            if touches:
                rebound = -(e * vs[ball]) if vs[ball] < 0 else ZERO
                ys[ball], vs[ball] = ZERO, ZERO if rebound <= rest else rebound
        return ys, vs, [0] * len(ys)

    def _project(self, ys: Balls, vs: Balls):
        ys = list(ys)
        gain, touching = self.value["alpha"] * self.value["k"], self.touching

        def depths() -> Balls:
            return [-y if t and y < 0 else ZERO for y, t in zip(ys, touching, strict=True)]

        rule = _ExactRule(self.world)
        residual = first = rule.measure(depths())
        counts = [0] * len(residual)
        while True:
            on = [
                not rule.stops(r, f, count) and count < rule.max_iter
                for r, f, count in zip(residual, first, counts, strict=True)
            ]
            if not any(on):
                break
            moves = on if len(on) == len(ys) else on * len(ys)
            ys = [y + gain * p if go else y for y, p, go in zip(ys, depths(), moves, strict=True)]
            counts = [count + go for count, go in zip(counts, on, strict=True)]
            now = rule.measure(depths())
            residual = [new if go else old for new, old, go in zip(now, residual, on, strict=True)]
        e = self.value["restitution"]
        for ball, touches in enumerate(touching):
            if touches:
                ys[ball] = ZERO if ys[ball] < 0 else ys[ball]
                vs[ball] = -(e * vs[ball]) if vs[ball] < 0 else ZERO
        return ys, vs, counts if len(counts) == len(ys) else counts * len(ys)


class _ExactRule:
    """Stopping rule of a solver, in exact numbers."""

    def __init__(self, world: World):
        rule: Any = world.contact.stop  # type: ignore[attr-defined]
        self.enter = None
        if isinstance(rule, HysteresisStop):
            self.enter, rule = _held(world, rule.enter), rule.rule
        if type(rule) not in (GlobalSum, PerInstance, Maximum, Relative, FixedCount):
            raise InputError(f"the stopping rule {type(rule).__name__} is not supported in exact arithmetic")
        self.rule, self.max_iter = rule, rule.max_iter
        self.tol = None if isinstance(rule, FixedCount) else _held(world, rule.tol)

    def measure(self, depths: Balls) -> Balls:
        """Return the residual of the whole batch or of each ball."""
        if isinstance(self.rule, PerInstance):
            return depths
        if isinstance(self.rule, GlobalSum):
            total = ZERO
            for depth in depths:
                total = total + depth
            return [total]
        largest = depths[0]
        for depth in depths[1:]:
            largest = depth if largest < depth else largest
        return [largest]

    def stops(self, residual: Decimal, first: Decimal, iteration: int) -> bool:
        """Return True if the residual is below the threshold."""
        if self.enter is not None and iteration == 0:
            return residual < self.enter
        if self.tol is None:
            return iteration >= self.max_iter
        if isinstance(self.rule, Relative):
            return residual < (exactly(float(np.finfo(np.float32).tiny)) if first == 0 else self.tol * first)
        return residual < self.tol


def _held(world: World, value: Any) -> Decimal:
    """Return the threshold of a decision, rounded to the dtype of decisions."""
    return exactly(float(np.asarray(value).astype(world.policy.dtype("decision"))))


def _plus(values: Balls, factor: Decimal, rates: Balls) -> Balls:
    return [value + factor * rate for value, rate in zip(values, rates, strict=True)]
