"""Gradient methods for a ball: fixed point, soft floor, or exact impact."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from mdnum.ball.problem import START, BallProblem
from mdnum.ball.rollout import BallRun
from mdnum.ball.step import BallVerlet, EventLocated, Impact, Motion, Moved, Penalty, Projection
from mdnum.ball.stopping import FixedCount
from mdnum.errors import InputError, NumericalError
from mdnum.gradients.ball import BallMethod, Use, used
from mdnum.gradients.problem import Gradient
from mdnum.numerics.saltation import carry, grazing

#: Condition number above which a derivative of the fixed point is meaningless in float64.
LIMIT = 1e12
#: Smallest number of steps during which the soft floor of an impact must act.
_RESOLVED = 10
#: Parameters of the solver of a projection, which do not affect its exact solution.
_SOLVER = ("k", "alpha", "tol", "enter")
#: Kind of derivative for a sharp and a soft spring.
_SPRING = (
    "the derivative of the steps: a spring's force does not jump at a contact, so its time moves no "
    "tangent (the saltation matrix is 1)"
)
#: |n · F-| below this share of |F-| counts as grazing.
_NARROW = 1e-6


def _moving(x: Any) -> Any:
    """Return zero, with the same derivative as x."""
    return x - lax.stop_gradient(x)


class FixedPointRule(eqx.Module):
    """Derivative of the fixed point of a contact, not of the iterations.

    For a ball in contact, y ← G(y) = y + gain max(0, -y) approaches 0 from below. At y = 0, dG/dy is
    discontinuous. The rule uses the derivative of G for y < 0. Implicit differentiation, (1 - dG/dy) dy =
    dG/dgain dgain, gives gain dy = -y dgain for each ball.
    """

    # added to 1 - dG/dy; moves the answer by about regularization / gain, relative
    regularization: float = eqx.field(static=True, default=0.0)
    # evaluate at the height where the iteration stopped instead, which is no fixed point
    at_iterate: bool = eqx.field(static=True, default=False)

    def attach(
        self, y: Float[Array, "balls"], gain: Float[Array, "balls"], contact: Bool[Array, "balls"]
    ) -> Float[Array, "balls"]:
        """Return the heights y, with the derivative of the fixed point.

        Args:
            y: heights where the iteration stopped.
            gain: alpha k of each ball.
            contact: the contact decisions.
        """
        ends = y if self.at_iterate else _Settled().attach(y, gain, contact)
        moved = lax.stop_gradient(-ends / (gain + self.regularization)) * _moving(gain)
        return lax.stop_gradient(y) + jnp.where(contact, moved, _moving(y))


class _Settled(eqx.Module):
    """Rule that lifts balls in contact up to the floor."""

    def attach(self, y, gain, contact):
        """Return 0 for balls in contact below the floor, and y for other balls."""
        return jnp.where(contact & (y < 0), jnp.zeros_like(y), y)


@dataclass(frozen=True)
class Implicit(BallMethod):
    """Gradient method: derivative of the fixed point of the contact.

    The loss uses the executed iterations. The derivative is that of the limit of the iterations. Due to the
    tolerance, `unrolled` gives a nonzero derivative with respect to the gain k.
    """

    regularization: float = 0.0  # added to 1 - dG/dy, for a gain too small to divide by
    # take the stopped iterate for the fixed point (an error of the order of the tolerance)
    at_iterate: bool = False

    name = "implicit"
    description = (
        "the derivative of the fixed point that the solver approaches, not of the iterations it took"
    )

    def differentiate(self, problem: BallProblem, names: tuple[str, ...], progress: Any) -> Gradient:
        """Compute the gradient of the loss by reverse-mode differentiation.

        Raises:
            InputError: the contact is not solved by iteration, or 1 - dG/dy is too ill conditioned.

        Error: rounding error times the condition number of 1 - dG/dy, plus the effect of regularization.
        """
        contact = problem.world.contact
        if not isinstance(contact, Projection):
            raise InputError(
                f"the contact {type(contact).__name__} is not solved by iteration, so the implicit gradient "
                "method has no fixed point to differentiate",
                remedy="Use the gradient method unrolled; for an impact contact, use event-aware.",
            )
        gain = float(contact.alpha) * float(contact.k)
        condition = max(1.0, gain + self.regularization) / min(1.0, gain + self.regularization)
        if condition > LIMIT:
            raise InputError(
                f"the condition number of the linear system is {condition:.3g}; expected at most {LIMIT:g}",
                remedy="Set a regularization; the derivative is then that of the regularized problem.",
            )
        rule = FixedPointRule(self.regularization, self.at_iterate)
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
            "regularization": self.regularization, "condition": condition,
            "at": "the stopped iterate" if self.at_iterate else "the fixed point",
        }  # fmt: skip
        return self.of(value, slopes, use, details)


def _with_contact(problem: BallProblem, contact: Any) -> BallProblem:
    return replace(problem, world=replace(problem.world, contact=contact))


class SoftImpact(eqx.Module):
    """Smooth model of an impact: a spring that is softer on the rebound.

    The stiffness is k on the way down and restitution² k on the way up. The ball leaves the floor at
    `restitution` times its impact speed.

    Source: latching spring of Walton and Braun (1986), here with smooth transitions.
    """

    restitution: Any  # speed after over speed before, in the limit of small widths
    k: Any  # stiffness per mass on the way in, 1/s²
    eps: Any  # width in height over which the spring sets in, m
    slow: Any  # in velocity, of the passage, m/s

    def acceleration(self, y, v, free, contact, r):
        """Return the acceleration due to control, gravity and spring. The contact decision is not used."""
        depth = self.eps * jax.nn.softplus(-y / self.eps)
        share = self.restitution**2
        return free + self.k * depth * (share + (1 - share) * jax.nn.sigmoid(-v / self.slow))

    def move(self, motion: Motion) -> Moved:
        """Integrate one time step of a ball with a contact spring. The contact decision is only recorded."""

        def pull(y, v, contact):
            return self.acceleration(y, v, motion.free, contact, motion.rounding)

        made = motion.integrator.push(pull, motion)
        return made._replace(record=made.record._replace(left=jnp.maximum(-made.y, 0)))


@dataclass(frozen=True)
class SoftFloor(BallMethod):
    """Gradient method: derivative of a program with a soft floor (`softened`)."""

    # width, m. Small: near the given program, with derivatives that peak at its contacts. Large: a tame
    # derivative, of something else. None for one that suits the problem: a tenth of the depth to which a
    # penalty gives way, and for an impact the narrowest floor that the step resolves
    eps: float | None = None

    name = "smoothed"
    kind = "other program"
    description = (
        "the derivative of another program, whose floor acts over a width eps; its loss is another too"
    )

    def differentiate(self, problem: BallProblem, names: tuple[str, ...], progress: Any) -> Gradient:
        """Compute the loss of the smooth program, and its gradient by reverse-mode differentiation.

        Raises:
            InputError: eps is not positive, or the smooth program does not have the parameter.

        Error: rounding error for the smooth program; also, with respect to the derivative of the given
        program (if there is one), a bias that decreases with eps.
        """
        eps = _suitable(problem) if self.eps is None else self.eps
        if not eps > 0:
            raise InputError(f"the contact width eps is {eps}", remedy="Choose an eps above 0.", where="eps")
        soft = softened(problem, eps)
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
        return self.of(value, slopes, use, details)


def softened(problem: BallProblem, eps: float) -> BallProblem:
    """Return the problem with a softplus instead of the hard floor, or a spring instead of impacts.

    Raises:
        InputError: the ball would cross the soft floor of width eps in too few steps.
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
            f"the ball crosses the smoothed contact of width {eps:g} m in {1 / rate:.3g} s, too fast for "
            f"a time step of {h:g} s",
            remedy=f"Choose an eps of at least {_RESOLVED * speed * h:.2g} m, or a shorter time step.",
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
    """Return the impact speed (m/s) of a ball. 1 if no ball falls."""
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
    """Gradient method: derivative of continuous motion, including the times of contacts.

    Contact is decided at the end of each time step. A ball that starts higher reaches the floor later. The
    derivative of the time steps omits the change of the contact time. A saltation matrix at every contact
    adds the change of the contact time to the derivative. If impacts are located within a step, the program's
    derivative is already complete. Contact by projection is differentiated like an impact. Without a damper,
    the result is the same as from the method `unrolled`.
    """

    name = "event-aware"
    kind = "flow"
    description = "the derivative of the motion, the times of its contacts moving along (saltation at each)"

    def differentiate(self, problem: BallProblem, names: tuple[str, ...], progress: Any) -> Gradient:
        """Compute the gradient of the loss by reverse-mode differentiation.

        Raises:
            NumericalError: a contact grazes the floor, so that its time has no derivative.

        Error: only rounding errors if impacts are located within a step; otherwise of the order of the time
        step, like the error of the simulation itself.
        """
        world = problem.world
        located = isinstance(world.integrator, EventLocated)
        smooth = isinstance(world.contact, Penalty) and world.contact.smooth
        run = problem.run(keep=not (located or smooth))
        if located or smooth:
            value, slopes = problem.value_and_grad(names)
            events = int(run.iterations.sum()) if located else 0
            # the time of an impact without speed has an infinite derivative
            flagged = 0 if np.all(np.isfinite(list(slopes.values()))) else 1
        else:
            contact: Any = world.contact
            kind = next(own for given, own in _SALTATING.items() if isinstance(contact, given))
            parts = {one.name: getattr(contact, one.name) for one in fields(contact)}
            value, slopes = _with_contact(problem, kind(**parts)).value_and_grad(names)
            events, flagged = _events(problem, run)
        if flagged:
            raise NumericalError(
                f"in {int(flagged)} contacts, the ball only grazes the floor; their times have no derivative",
                remedy="Change the start or time step to make the ball hit the floor, or smooth the contact.",
            )
        use = used(problem, names, slopes, run, own=located or smooth)
        for name in names:
            if slopes[name] != 0 and not use[name].depends:
                use[name] = Use(True, f"the time of a contact depends on {name}")
            elif name in _SOLVER and isinstance(world.contact, Projection):
                use[name] = Use(False, f"the impact that is solved for does not depend on {name}")
        spring = isinstance(world.contact, Penalty) and not float(world.contact.damping)
        made = self.of(value, slopes, use, {"events": events, "located": located})
        return replace(made, description=_SPRING) if spring else made


class _SaltatingReset:
    """Contact that resets velocities, but is differentiated like continuous motion."""

    def move(self, motion: Motion) -> Moved:
        """Compute one time step with a contact, differentiated as continuous motion."""
        made = super().move(motion)  # type: ignore[misc]
        height, v = motion.integrator.fly(motion.y, motion.v, motion.free, motion.rounding)
        arrived, nothing, bounce = lax.stop_gradient(v), jnp.zeros_like(v), self.restitution.astype(v.dtype)  # type: ignore[attr-defined]
        held, free = lax.stop_gradient(bounce), lax.stop_gradient(motion.free)
        reset = jnp.stack([_pair(nothing + 1, nothing), _pair(nothing, nothing - held)], axis=-2)
        before, after = _pair(arrived, free), _pair(-held * arrived, free)
        rate, along = _pair(nothing, -arrived * _moving(bounce)), _pair(_moving(height), _moving(v))
        kicked = carry(along, reset, before, after, _normal(arrived), reset_rate=rate)
        contact = made.record.contact
        falls, rests = contact & (arrived < 0), contact & (made.v == 0)
        moved = jnp.where(rests[:, None], 0.0, jnp.where(falls[:, None], kicked, along))
        y, v, left = (lax.stop_gradient(one) for one in (made.y, made.v, made.record.left))
        return made._replace(
            y=y + moved[:, 0].astype(y.dtype),
            v=v + moved[:, 1].astype(v.dtype),
            record=made.record._replace(left=left),
        )


class _SaltatingImpact(_SaltatingReset, Impact):
    pass


class _SaltatingProjection(_SaltatingReset, Projection):
    pass


class _SaltatingPenalty(Penalty):
    def move(self, motion: Motion) -> Moved:
        """Compute one time step of a ball with a damped spring. Add the saltation term."""
        contact = super().move(motion).record.contact
        y, v = lax.stop_gradient((motion.y, motion.v))
        jump = jnp.where(contact, -1.0, 1.0).astype(v.dtype) * lax.stop_gradient(self.damping) * v
        along, still = _pair(_moving(motion.y), _moving(motion.v)), jnp.zeros_like(v)
        kicked = carry(along, None, _pair(v, still), _pair(v, jump), _normal(v))
        moved = jnp.where((contact != motion.touching)[:, None], kicked, along)
        return super().move(motion._replace(y=y + moved[:, 0], v=v + moved[:, 1]))


_SALTATING = {Penalty: _SaltatingPenalty, Projection: _SaltatingProjection, Impact: _SaltatingImpact}


def _pair(y, v):
    return jnp.stack([y, v], axis=-1)


def _normal(v):
    return _pair(jnp.ones_like(v), jnp.zeros_like(v))


def _events(problem: BallProblem, run: BallRun) -> tuple[int, int]:
    """Return the number of contact events, and of grazing events."""
    world, contact = problem.world, run.contact
    free = jax.vmap(lambda step: world.free(step, contact.shape[1:]))(jnp.arange(run.steps))
    free, v = np.asarray(free, np.float64), run.v[:-1].astype(np.float64)
    if isinstance(world.contact, Penalty):
        start = world.start(problem.y0, problem.v0)
        hits = contact != np.vstack([np.asarray(start.touching), contact[:-1]])
        # without a damper nothing jumps, so there is nothing to graze
        counts = hits & (float(world.contact.damping) > 0)
    else:
        v = v + run.h * free
        hits = counts = contact & (v < 0)
    normal = np.broadcast_to([1.0, 0.0], (*v.shape, 2))
    grazes = counts & grazing(np.stack([v, free], axis=-1), normal, _NARROW)
    return int(hits.sum()), int(grazes.sum())
