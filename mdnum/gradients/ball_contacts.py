"""Derivatives of a ball with contacts in view: of a solver's fixed point, of a soft floor, of the motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from mdnum.ball.problem import START, BallProblem
from mdnum.ball.step import (
    BallDecisions,
    BallRecord,
    BallState,
    BallVerlet,
    EventLocated,
    Motion,
    Moved,
    Penalty,
    Projection,
)
from mdnum.ball.stopping import FixedCount
from mdnum.ball.world import World
from mdnum.errors import InputError, NumericalError
from mdnum.gradients.ball import BallMethod, Use, used
from mdnum.gradients.problem import Gradient
from mdnum.numerics.saltation import carry, grazing

#: Beyond this condition number the linear solve means nothing in float64.
LIMIT = 1e12
#: Steps that the soft floor of an impact must act for.
_RESOLVED = 10
#: Parameters of how a projection is solved, not of what it stands for.
_SOLVER = ("k", "alpha", "tol", "enter")
#: Which derivative that is of a spring, sharp or soft.
_SPRING = (
    "the derivative of the steps: a spring's force does not jump at a contact, so its time moves no "
    "tangent (the saltation matrix is 1)"
)
#: |n · F-| below this share of |F-| counts as grazing.
_NARROW = 1e-6


def solve(
    matvec: Callable[[Any], Any],
    right: Float[Array, "unknowns"],
    tolerance: float | Float[Array, ""] = 1e-12,
    regularization: float | Float[Array, ""] = 0.0,
    max_iter: int = 200,
) -> Float[Array, "unknowns"]:
    """x of (A + regularization) x = right by conjugate gradients, differentiable both ways.

    Args:
        matvec: A, symmetric and positive definite.
        tolerance: of the residual, relative to the right-hand side.
        regularization: added to the diagonal of A; moves the answer by about regularization / smallest
            eigenvalue, relative.

    Error: at most tolerance times the condition number, relative.
    """

    def matrix(x):
        return matvec(x) + jnp.asarray(regularization, x.dtype) * x

    def conjugate(matvec, b):
        return cg(matvec, b, tol=tolerance, maxiter=max_iter)[0]  # type: ignore[arg-type]

    return jax.lax.custom_linear_solve(matrix, right, conjugate, symmetric=True)


def fixed_point_tangent(
    update: Callable[..., Float[Array, "unknowns"]],
    x: Float[Array, "unknowns"],
    parameters: tuple[Any, ...],
    tangents: tuple[Any, ...],
    **options: Any,
) -> Float[Array, "unknowns"]:
    """dx of x = update(x, *parameters), by the implicit function theorem: (1 - dG/dx) dx = dG/dp dp.

    Args:
        update: G; 1 - dG/dx symmetric and positive definite at x.
        x: a fixed point. At a point that is only near one, the answer is off by about that distance.
        options: of `solve`.
    """
    _, right = jax.jvp(lambda *given: update(x, *given), parameters, tangents)

    def matvec(dx):
        return dx - jax.jvp(lambda at: update(at, *parameters), (x,), (dx,))[1]

    return solve(matvec, right, **options)


class FixedPointRule(eqx.Module):
    """Gives a projection's result the derivative of the fixed point it stands for.

    For a ball in contact the fixed point of y ← y + gain max(0, -y) that is reached from below is y = 0. It
    lies on the kink of max(0, -y), where dG/dy has two values: the one from below is used, because the ball
    comes from there (a choice of branch, as the active set of a complementarity problem).

    Attributes:
        tolerance, regularization, max_iter: of the linear solve.
        at_iterate: evaluate at the height where the iteration stopped instead, which is no fixed point.
    """

    tolerance: float = eqx.field(static=True, default=1e-12)
    regularization: float = eqx.field(static=True, default=0.0)
    max_iter: int = eqx.field(static=True, default=200)
    at_iterate: bool = eqx.field(static=True, default=False)

    def attach(
        self, y: Float[Array, "balls"], gain: Float[Array, "balls"], contact: Bool[Array, "balls"]
    ) -> Float[Array, "balls"]:
        """y, unchanged, with the other derivative.

        Args:
            y: heights where the iteration stopped.
            gain: alpha k, by ball.
            contact: the contact decision.
        """

        @jax.custom_jvp
        def given(y, gain, contact):
            return y

        @given.defjvp
        def rule(primals, tangents):
            y, gain, contact = primals
            ends = y if self.at_iterate else jnp.where(contact & (y < 0), jnp.zeros_like(y), y)

            def update(y, gain):
                # the branch below the floor for every ball in contact; the others stay where they are
                return jnp.where(contact, y - gain * y, jnp.zeros_like(y))

            options = {key: getattr(self, key) for key in ("tolerance", "regularization", "max_iter")}
            moved = fixed_point_tangent(update, ends, (gain,), (tangents[1],), **options)
            return y, jnp.where(contact, moved, tangents[0])

        return given(y, gain, contact)


class _Settled(eqx.Module):
    """Puts every ball in contact where its iteration was heading."""

    def attach(self, y, gain, contact):
        """The fixed point."""
        return jnp.where(contact & (y < 0), jnp.zeros_like(y), y)


@dataclass(frozen=True)
class Implicit(BallMethod):
    """The derivative of the projection's fixed point, by the implicit function theorem.

    The loss is that of the iterations that ran; its derivative is that of where they were heading: the floor,
    whatever the gain. What the unrolled one gives by k is an artefact of the tolerance.

    Attributes:
        tolerance, regularization, max_iter: of the linear solve.
        at_iterate: take the stopped iterate for the fixed point (an error of the order of the tolerance).
    """

    tolerance: float = 1e-12
    regularization: float = 0.0
    max_iter: int = 200
    at_iterate: bool = False

    name = "implicit"
    description = (
        "the derivative of the fixed point that the solver approaches, not of the iterations it took; a "
        "linear solve with a tolerance of its own"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode through the linear solve.

        Raises:
            InputError: nothing is iterated here, or the linear system is too ill conditioned.

        Error: tolerance times the condition number of 1 - dG/dy, and what regularization moves.
        """
        contact = problem.world.contact
        if not isinstance(contact, Projection):
            raise InputError(
                f"{type(contact).__name__} has no iterated projection to take the fixed point of",
                remedy="Use the unrolled derivative, or event-aware for an impact.",
            )
        gain = float(contact.alpha) * float(contact.k)
        condition = max(1.0, gain + self.regularization) / min(1.0, gain + self.regularization)
        if condition > LIMIT:
            raise InputError(
                f"1 - dG/dy has the condition number {condition:.3g}; expected at most {LIMIT:g}",
                remedy="Regularize the solve, and read the derivative as that of a regularized problem.",
            )
        rule = FixedPointRule(self.tolerance, self.regularization, self.max_iter, self.at_iterate)
        attached = _with_contact(problem, replace(contact, derivative=rule))
        value, slopes = attached.value_and_grad(names)
        # what the run would be if every solve ended at its fixed point
        ideal = _with_contact(problem, replace(contact, stop=FixedCount(0), derivative=_Settled()))
        asked = problem if self.at_iterate else ideal
        use = used(asked, names, slopes, own=False)
        for name in names:
            if not self.at_iterate and not use[name].depends:
                use[name] = Use(False, f"the fixed point does not depend on {name}")
        details = {
            "tolerance": self.tolerance, "regularization": self.regularization, "condition": condition,
            "at": "the stopped iterate" if self.at_iterate else "the fixed point",
        }  # fmt: skip
        return self.result(value, slopes, use, details)


def _with_contact(problem: BallProblem, contact: Any) -> BallProblem:
    return replace(problem, world=replace(problem.world, contact=contact))


class SoftImpact(eqx.Module):
    """An impact without a decision: a soft spring that pushes harder on the way in than on the way out.

    The spring has stiffness k while the ball falls and restitution² k while it rises, with smooth passages
    between the two and at the floor, so that the ball leaves with restitution times its speed.

    Attributes:
        restitution: speed after over speed before, in the limit of small widths.
        k: stiffness per mass on the way in, 1/s².
        eps: width in height over which the spring sets in, m. slow: in velocity, of the passage, m/s.

    Source: the latching spring of Walton and Braun (1986), smoothed.
    """

    restitution: Any
    k: Any
    eps: Any
    slow: Any

    def acceleration(self, y, v, free, contact, r):
        """Gravity, control and the spring; the decision is not used."""
        depth = self.eps * jax.nn.softplus(-y / self.eps)
        share = self.restitution**2
        return free + self.k * depth * (share + (1 - share) * jax.nn.sigmoid(-v / self.slow))

    def move(self, motion: Motion) -> Moved:
        """One step of the scheme under this force; the contact decision is only recorded."""

        def pull(y, v, contact):
            return self.acceleration(y, v, motion.free, contact, motion.rounding)

        made = motion.integrator.push(pull, motion)
        return made._replace(record=made.record._replace(left=jnp.maximum(-made.y, 0)))


@dataclass(frozen=True)
class SoftFloor(BallMethod):
    """The derivative of a program with a soft floor: softplus contact, softened restitution.

    Attributes:
        eps: width, m. Small: near the given program, with derivatives that peak at its contacts. Large: a
            tame derivative, of something else. None for one that suits the problem: a tenth of the depth to
            which a penalty gives way, and for an impact the narrowest floor that the step resolves.
    """

    eps: float | None = None

    name = "smoothed"
    kind = "other program"
    description = (
        "the derivative of another program, whose floor acts over a width eps; its loss is another too"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode, of the smooth program; the value is its loss.

        Raises:
            InputError: eps is not positive, or a parameter that the smooth program does not have.

        Error: rounding; as a derivative of the given program a bias that shrinks with eps only where that
        program has a derivative.
        """
        eps = _suitable(problem) if self.eps is None else self.eps
        if not eps > 0:
            raise InputError(f"eps is {eps}", remedy="Choose a width above 0.", where="eps")
        soft = softened(problem, eps)
        problem.values(names)
        # the soft floor's own stiffness and width are not what these names mean in the given program
        own = () if isinstance(problem.world.contact, Penalty) else (*_SOLVER, "eps", "rest_speed")
        here = [name for name in names if (name in START or problem.world.has(name)) and name not in own]
        value, slopes = soft.value_and_grad(here)
        use = used(soft, here, slopes)
        for name in names:
            if name not in here:
                slopes[name], use[name] = 0.0, Use(False, f"the smooth program has no {name}")
        hard = problem.value()
        details = {"eps": eps, "loss_of_the_given_program": hard, "bias_of_the_loss": value - hard}
        return self.result(value, slopes, use, details)


def softened(problem: BallProblem, eps: float) -> BallProblem:
    """The problem with a soft floor: a softplus penalty, or a spring that an impact sinks into by about eps.

    Raises:
        InputError: the ball would pass so narrow a floor in a few steps.
    """
    world = problem.world
    contact, dtype = world.contact, world.policy.dtype("arithmetic")
    width = jnp.asarray(eps, dtype)
    if isinstance(contact, Penalty):
        return replace(problem, world=replace(world, contact=replace(contact, eps=width, smooth=True)))
    speed = _speed(problem)
    # a spring of this stiffness stops a ball of this speed within eps
    rate, h = speed / eps, float(world.integrator.h)
    if h * rate * _RESOLVED > 1.001:
        raise InputError(
            f"a floor of width {eps:g} m acts for {1 / rate:.3g} s; a step of {h:g} s does not resolve it",
            remedy=f"Choose eps of at least {_RESOLVED * speed * h:.2g} or a shorter step.",
            where="eps",
        )
    soft = SoftImpact(
        contact.restitution,  # type: ignore[attr-defined]
        *(jnp.asarray(value, dtype) for value in (rate**2, eps / 4, speed / 20)),
    )
    scheme = (
        BallVerlet(world.integrator.h) if isinstance(world.integrator, EventLocated) else world.integrator
    )
    return replace(problem, world=replace(world, contact=soft, integrator=scheme))


def _speed(problem: BallProblem) -> float:
    """With which a ball of this problem arrives at the floor, m/s; 1 where none falls."""
    height = max(float(np.max(np.asarray(problem.y0, np.float64))), 0.0)
    square = float(np.max(np.asarray(problem.v0, np.float64) ** 2))
    return float(np.sqrt(square + 2 * abs(float(problem.world.gravity)) * height)) or 1.0


def _suitable(problem: BallProblem) -> float:
    contact = problem.world.contact
    if isinstance(contact, Penalty):
        return 0.1 * _speed(problem) / float(np.sqrt(float(contact.k)))
    return _RESOLVED * _speed(problem) * float(problem.world.integrator.h)


@dataclass(frozen=True)
class ThroughContacts(BallMethod):
    """The derivative of the ball's motion, contacts included, rather than of the steps that imitate it.

    A step decides about contact at its end, so its derivative does not know that a ball which starts higher
    arrives later. Here a tangent is carried along with the rollout and multiplied by the saltation matrix at
    every contact. Where the impact is located inside the step the program's own derivative is already this
    one. A projection is read as the impact that it stands for. The force of a spring without a damper does
    not jump: of a spring this is the unrolled derivative, and says so.
    """

    name = "event-aware"
    kind = "flow"
    description = "the derivative of the motion, the times of its contacts moving along (saltation at each)"

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The derivative, by tangents that are carried with the rollout.

        Raises:
            NumericalError: a contact grazes the floor, so that its time has no derivative.

        Error: none beyond rounding where impacts are located inside the step; else of the order of the step,
        as the rollout itself.
        """
        world = problem.world
        run = problem.run(keep=False)
        located = isinstance(world.integrator, EventLocated)
        smooth = isinstance(world.contact, Penalty) and world.contact.smooth
        if located or smooth:
            value, slopes = problem.value_and_grad(names)
            events = int(run.iterations.sum()) if located else 0
            # the time of an impact without speed has an infinite derivative
            flagged = 0 if np.all(np.isfinite(list(slopes.values()))) else 1
        else:
            at = problem.origin(names)
            value, slopes, events, flagged = _tangents(at, world, *problem.start_arrays, *problem.bare)
            value, events = float(value), int(events)
            slopes = {name: float(slopes[name]) for name in names}
        if flagged:
            raise NumericalError(
                f"contacts that graze the floor: {int(flagged)}; their time has no derivative",
                remedy="Move the start or the step until the ball crosses the floor, or smooth the contact.",
            )
        use = used(problem, names, slopes, run, own=located or smooth)
        for name in names:
            if slopes[name] != 0 and not use[name].depends:
                use[name] = Use(True, f"the time of a contact depends on {name}")
            elif name in _SOLVER and isinstance(world.contact, Projection):
                use[name] = Use(False, f"the impact that is solved for does not depend on {name}")
        spring = isinstance(world.contact, Penalty) and not float(world.contact.damping)
        made = self.result(value, slopes, use, {"events": events, "located": located})
        return replace(made, description=_SPRING) if spring else made


@eqx.filter_jit
def _tangents(values, world, y0, v0, steps, loss):
    """Loss, its derivatives, the number of contacts and of those that graze."""
    dtype = world.policy.dtype("loss")
    names = list(values)
    rest = {name: value for name, value in values.items() if name not in START}

    def begin(values):
        y, v = (
            old + values[name].astype(old.dtype) if name in values else old
            for name, old in zip(START, (y0, v0), strict=True)
        )
        state = world.with_values({name: values[name] for name in rest}).start(y, v)
        return (state.y, state.v, state.a), state

    def along(name):
        return {key: jnp.full_like(value, key == name) for key, value in values.items()}

    def step(carried, _):
        state, tangents, total, rates, events, flagged = carried
        after, record = world.advance(state)
        moved = {
            name: _carry(world, rest, values, along(name), state, after, record, tangents[name])
            for name in names
        }

        def adds(y, v, left):
            return loss.step(after._replace(y=y, v=v), record._replace(left=left), dtype)

        rates = {
            name: rates[name]
            + jax.jvp(adds, (after.y, after.v, record.left), (*moved[name][0][:2], moved[name][1]))[1]
            for name in names
        }
        hit, grazes = _events(world, state, after, record)
        total = total + loss.step(after, record, dtype)
        new = {name: moved[name][0] for name in names}
        return (after, new, total, rates, events + hit, flagged + grazes), None

    state = begin(values)[1]
    nothing = jnp.zeros((), dtype)
    count = jnp.zeros((), jnp.int64)
    started = {name: jax.jvp(lambda given: begin(given)[0], (values,), (along(name),))[1] for name in names}
    carried = (state, started, nothing, dict.fromkeys(names, nothing), count, count)
    (state, tangents, total, rates, events, flagged), _ = jax.lax.scan(step, carried, None, length=steps)

    def ends(y, v, total):
        return loss.end(state._replace(y=y, v=v), steps, total)

    slopes = {
        name: jax.jvp(ends, (state.y, state.v, total), (*tangents[name][:2], rates[name]))[1]
        for name in names
    }
    return ends(state.y, state.v, total), slopes, events, flagged


def _advance(world: World, rest: dict, state: BallState, told: BallDecisions):
    """One told step as a function of what carries derivatives."""

    def run(values, y, v, a):
        given = world.with_values({name: values[name] for name in rest})
        after, record = given.advance(state._replace(y=y, v=v, a=a), imposed=told)
        return after.y, after.v, after.a, record.left, record.height

    return run


def _flight(world: World, state: BallState, record: BallRecord) -> BallDecisions:
    return BallDecisions(jnp.zeros_like(record.contact), jnp.zeros_like(record.solve.iterations))


def _carry(world, rest, values, seed, state, after, record, tangent):
    """A tangent over one step, with the saltation term of its contacts."""
    point = (values, state.y, state.v, state.a)
    if isinstance(world.contact, Penalty):
        # a spring that starts at 0 moves no tangent, a damper does: the force jumps by -damping v
        sign = jnp.where(record.contact, -1.0, 1.0).astype(state.v.dtype)
        flips = record.contact != state.touching
        still, jump = jnp.zeros_like(state.v), sign * world.contact.damping * state.v
        before, behind = _pair(state.v, still), _pair(state.v, still + jump)
        kicked = carry(_pair(*tangent[:2]), None, before, behind, _normal(state.v))
        dy = jnp.where(flips, kicked[:, 0], tangent[0])
        dv = jnp.where(flips, kicked[:, 1], tangent[1])
        _, out = jax.jvp(_advance(world, rest, state, record.decisions), point, (seed, dy, dv, tangent[2]))
        return out[:3], out[3]
    flight = _advance(world, rest, state, _flight(world, state, record))
    (_, v, free, _, _), (dy, dv, da, _, _) = jax.jvp(flight, point, (seed, *tangent))
    bounce = world.contact.restitution.astype(v.dtype)
    nothing = jnp.zeros_like(v)
    reset = jnp.stack([_pair(nothing + 1, nothing), _pair(nothing, nothing - bounce)], axis=-2)
    rate = _pair(nothing, -v * seed["restitution"].astype(v.dtype)) if "restitution" in seed else 0.0
    out = carry(_pair(dy, dv), reset, _pair(v, free), _pair(-bounce * v, free), _normal(v), reset_rate=rate)
    falls = record.contact & (v < 0)
    rests = record.contact & (after.v == 0)
    dy = jnp.where(rests, nothing, jnp.where(falls, out[:, 0], dy))
    dv = jnp.where(rests, nothing, jnp.where(falls, out[:, 1], dv))
    return (dy, dv, da), jnp.zeros_like(record.left)


def _pair(y, v):
    return jnp.stack([y, v], axis=-1)


def _normal(v):
    return _pair(jnp.ones_like(v), jnp.zeros_like(v))


def _events(world, state, after, record):
    """How many contacts this step has, and how many of them graze."""
    if isinstance(world.contact, Penalty):
        hits, v = record.contact != state.touching, state.v
        # without a damper nothing jumps, so there is nothing to graze
        counts = hits & (world.contact.damping > 0)
    else:
        (_, v, *_) = _advance(world, {}, state, _flight(world, state, record))({}, state.y, state.v, state.a)
        hits = record.contact & (v < 0)
        counts = hits
    grazes = counts & grazing(_pair(v, after.a.astype(v.dtype)), _normal(v), _NARROW)
    return jnp.sum(hits, dtype=jnp.int64), jnp.sum(grazes, dtype=jnp.int64)
