"""Model of the bouncing ball whose decisions can be recorded and imposed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mdnum.ball import limits, stopping
from mdnum.ball.step import (
    BallDecisions,
    BallRecord,
    Balls,
    BallState,
    Contact,
    EventLocated,
    Impact,
    Motion,
    Projection,
    Rounding,
    Scheme,
)
from mdnum.errors import InputError
from mdnum.numerics.events import Hysteresis, Threshold
from mdnum.numerics.exact import zero_bits
from mdnum.numerics.formats import stochastic_round
from mdnum.numerics.roles import RolePrecision
from mdnum.plain import beside

PARAMETERS: Mapping[str, Mapping[str, Any]] = beside(__file__)  # what is known of each parameter
_MOST_ITERATIONS = 2**31 - 1  # iterations are counted in 32 bits


class World(eqx.Module):
    """Model of balls above a floor at height 0, without heights and velocities.

    `World.create` checks all numbers and casts them to the dtypes in `policy`. Pass a `World` to jitted code
    as an argument. If a `World` is a constant, the compiler may remove operations with zeros.

    Attributes:
        contact: contact model of the floor.
        integrator: integration scheme.
        gravity: gravitational acceleration, m/s², downward positive.
        control: additional acceleration in each step, m/s², shape (steps,) or (steps, balls); or None.
        lift: height, m, above which a contact that began below 0 ends; None for no hysteresis.
        rounding: function that forces the rounding of intermediate results.
        policy: dtype by role.
    """

    contact: Contact
    integrator: Scheme
    gravity: Any
    control: Any
    lift: Any
    rounding: Rounding
    policy: RolePrecision = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        contact: Contact,
        integrator: Scheme,
        gravity: float = 9.81,
        control: Any = None,
        policy: RolePrecision | None = None,
        hysteresis: float | None = None,
    ) -> World:
        """Create a model. Numbers are checked and cast to the dtypes of `policy`.

        Args:
            contact, integrator: contact model and integration scheme with plain numbers as parameters.
            gravity: gravitational acceleration, m/s².
            control: additional acceleration, m/s², shape (steps,) or (steps, balls).
            policy: dtype by role; None for float64 in all roles.
            hysteresis: height, m, at which a contact ends; None for 0.

        Raises:
            InputError: a number is out of range, or the components are incompatible.
        """
        policy = RolePrecision() if policy is None else policy
        fence = Rounding(zero_bits(np.float64))
        world = cls(contact, integrator, gravity, control, hysteresis, fence, policy)
        _check(world)
        values = {name: world.value(name) for name in world.parameters}
        if control is not None:
            world = eqx.tree_at(lambda w: w.control, world, jnp.asarray(control, policy.dtype("arithmetic")))
        return world.with_values(values)

    # -- parameters ----------------------------------------------------------------------------------

    def _place(self, name: str) -> str | None:
        for path in PARAMETERS.get(name, {}).get("places", ()):
            node: Any = self
            for part in path.split("."):
                node = getattr(node, part, None)
            if node is not None:
                return path
        return None

    def has(self, name: str) -> bool:
        """Return True if this model has a parameter of a given name."""
        return self._place(name) is not None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of this bouncing-ball model."""
        return tuple(name for name in PARAMETERS if self.has(name))

    def _known(self, name: str) -> str:
        path = self._place(name)
        if path is None:
            raise InputError(
                f"the ball has no parameter {name!r}", remedy=f"Choose one of {', '.join(self.parameters)}"
            )
        return path

    def value(self, name: str) -> Any:
        """Return the value of a parameter.

        Raises:
            InputError: the model has no such parameter.
        """
        return attrgetter(self._known(name))(self)

    def with_values(self, values: Mapping[str, Any]) -> World:
        """Return the model with other values. The values are not checked, so jax tracers are allowed.

        Raises:
            InputError: the model has no such parameter.
        """
        world = self
        for name, value in values.items():
            path = self._known(name)
            decides = PARAMETERS[name].get("role") == "decision"
            cast = jnp.asarray(value).astype(np.float64 if decides else self.policy.dtype("arithmetic"))
            world = eqx.tree_at(attrgetter(path), world, cast)
        return world

    # -- decide ----------------------------------------------------------------------------------------

    def touches(self, height: Balls, before: Bool[Array, "balls"]) -> Bool[Array, "balls"]:
        """Return which balls touch the floor. With `lift`, contact lasts until height > lift."""
        height = height.astype(self.policy.dtype("decision"))
        enter = Threshold(jnp.zeros((), height.dtype), "<", "height")
        if self.lift is None:
            return jnp.asarray(enter.decide(height))
        leave = Threshold(self.lift.astype(height.dtype), "<=", "height")
        return jnp.asarray(Hysteresis(enter, leave).decide(height, before))

    # -- act -------------------------------------------------------------------------------------------

    def start(self, y: Any, v: Any = 0.0) -> BallState:
        """Create the state of all balls at step 0.

        Args:
            y: heights, m, a number or shape (balls,).
            v: velocities, m/s, a number or shape (balls,).
        """
        return _start(self, jnp.asarray(y), jnp.asarray(v))

    def advance(
        self, state: BallState, *, imposed: BallDecisions | None = None, history: bool = False
    ) -> tuple[BallState, BallRecord]:
        """Make one time step: find contacts, then compute heights and velocities.

        Args:
            imposed: decisions that replace all or some of the model's own (see `BallDecisions`).
            history: whether a solver records the residual of every decision.

        Returns:
            the next state, and the record of the step.
        """
        arithmetic = self.policy.dtype("arithmetic")
        moved = self.contact.move(
            Motion(
                y=state.y.astype(arithmetic),
                v=state.v.astype(arithmetic),
                carried=state.a.astype(arithmetic),
                free=self.free(state.step, state.y.shape),
                touching=state.touching,
                judge=self._judge(state, imposed),
                imposed=None if imposed is None else imposed.iterations,
                integrator=self.integrator,
                policy=self.policy,
                rounding=self.rounding,
                history=history,
            )
        )
        step = state.step + 1
        y, v = self._store(moved.y, step, 0), self._store(moved.v, step, 1)
        record = jax.tree.map(jax.lax.stop_gradient, moved.record)._replace(left=moved.record.left)
        return BallState(step, y, v, moved.a, moved.record.contact), record

    def _judge(
        self, state: BallState, imposed: BallDecisions | None
    ) -> Callable[[Balls], Bool[Array, "balls"]]:
        if imposed is None:
            return lambda height: self.touches(height, state.touching)
        contact = imposed.contact
        if contact.dtype == bool:
            return lambda _: contact
        return lambda height: jnp.where(contact < 0, self.touches(height, state.touching), contact > 0)

    def free(self, step: Int[Array, ""], shape: tuple[int, ...]) -> Balls:
        """Return the acceleration without contact (control minus gravity), m/s²."""
        free = -self.gravity
        if self.control is not None:
            # a control that ends before the run does stays at its last value
            free = self.rounding(self.control[jnp.minimum(step, self.control.shape[0] - 1)] - self.gravity)
        return jnp.broadcast_to(free, shape)

    def _store(self, x: Balls, step: Int[Array, ""], which: int) -> Balls:
        dtype = self.policy.dtype("state")
        if self.policy.rounding == "nearest" or x.dtype == dtype:
            return self.rounding(x.astype(dtype))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(self.policy.seed), step), which)
        return stochastic_round(x, self.policy.state, key).astype(dtype)


@eqx.filter_jit
def _start(world: World, y: Array, v: Array) -> BallState:
    dtype, arithmetic = world.policy.dtype("state"), world.policy.dtype("arithmetic")
    y = jnp.atleast_1d(y).astype(dtype)
    v = jnp.broadcast_to(v.astype(dtype), y.shape)
    step = jnp.zeros((), jnp.int32)
    touching = world.touches(y.astype(arithmetic), jnp.zeros(y.shape, bool))
    a = world.contact.acceleration(
        y.astype(arithmetic), v.astype(arithmetic), world.free(step, y.shape), touching, world.rounding
    )
    return BallState(step, y, v, a, touching)


def _check(world: World) -> None:
    """Raise an error if a number is out of range, or contact and scheme do not fit."""
    contact: Any = world.contact
    integrator: Any = world.integrator
    for name in world.parameters:
        if name != "eps" or contact.smooth:
            _in_range(name, world.value(name))
    if world.control is not None and not np.all(np.isfinite(np.asarray(world.control, np.float64))):
        raise InputError("the control acceleration has an infinite or NaN value; expected finite values")
    if isinstance(integrator, EventLocated):
        if not isinstance(contact, Impact):
            raise InputError(
                "the event-located integrator needs an impact contact",
                remedy="Use an impact contact; for penalty and projection contacts, use another integrator",
            )
        _count("max_impacts", integrator.max_impacts)
    if isinstance(contact, Projection):
        gain = float(contact.alpha) * float(contact.k)
        if gain >= 2:
            raise InputError(
                f"alpha * k = {gain:g}; the iteration of the contact solver converges only if alpha * k < 2",
                remedy="Choose alpha * k below 2; at alpha * k = 1, one iteration is enough",
            )
        _check_stop(contact.stop, world.policy, gain)
    if (stop := getattr(integrator, "stop", None)) is not None:
        _check_stop(stop, world.policy, 1.0)


def _check_stop(rule: Any, policy: RolePrecision, gain: float) -> None:
    """Raise an error if a stopping rule is invalid or cannot be met."""
    _count("max_iter", rule.max_iter)
    if isinstance(rule, stopping.FixedCount):
        return
    if isinstance(rule, stopping.HysteresisStop):
        _check_stop(rule.rule, policy, gain)
        if not float(rule.enter) >= float(rule.rule.tol):
            raise InputError(
                f"the stopping rule has enter = {rule.enter}, which is below tol = {rule.rule.tol}",
                remedy="Set enter to tol or more, because the solver stops when the residual falls below tol",
            )
        return
    tol = float(rule.tol)
    relative, summed = isinstance(rule, stopping.Relative), isinstance(rule, stopping.GlobalSum)
    kind = "relative" if relative else "sum" if summed else "term"
    usable = limits.smallest_tolerance(policy, gain, kind)
    role = max(usable, key=lambda one: usable[one])
    if not tol >= usable[role]:
        raise InputError(
            f"tol = {tol:g} cannot be reached, because precision.{role} is {getattr(policy, role)}",
            remedy=f"The smallest usable tolerance is {usable[role]:.3g}",
        )
    limit = limits.largest(policy.decision)
    if tol > limit:
        raise InputError(f"tol = {tol:g} exceeds {limit:g}, the largest number of type {policy.decision}")


def _count(name: str, value: int) -> None:
    if not 1 <= value <= _MOST_ITERATIONS:
        raise InputError(f"{name} = {value}; expected an integer from 1 to {_MOST_ITERATIONS}")


def _in_range(name: str, value: Any) -> None:
    row, x = PARAMETERS[name], float(value)
    strictly, most = "above" in row, row.get("most", math.inf)
    least = row.get("above", row.get("least", -math.inf))
    if math.isfinite(x) and least <= x <= most and not (strictly and x == least):
        return
    expected = f"finite number {'above' if strictly else 'of at least'} {least:g}"
    if most < math.inf:
        expected = f"number from {least:g} to {most:g}"
    raise InputError(f"{name} = {value}; expected a {expected if least > -math.inf else 'finite number'}")
