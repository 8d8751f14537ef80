"""The derivative of another program: one whose contact is smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.ball.contacts import Motion, Moved, Penalty
from mdnum.ball.gradients.base import Gradient, used
from mdnum.ball.gradients.unrolled import scaled
from mdnum.ball.integrators import EventLocated, Push, VelocityVerlet
from mdnum.ball.problem import START, Problem
from mdnum.ball.state import Record
from mdnum.errors import InputError

#: Steps that the soft floor of an impact must act for.
_RESOLVED = 10


class SoftImpact(eqx.Module):
    """An impact without a decision: a soft spring that pushes harder on the way in than on the way out.

    The spring has stiffness k while the ball falls and restitution² k while it rises, with smooth passages
    between the two and at the floor, so that the ball leaves with restitution times its speed.

    Attributes:
        restitution: speed after over speed before, in the limit of small widths.
        k: stiffness per mass on the way in, 1/s².
        eps: width in height over which the spring sets in, m.
        slow: width in velocity over which the way in passes into the way out, m/s.

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

        push = Push(motion.judge, pull, motion.policy, motion.told, motion.history)
        made = motion.integrator.push(push, motion.y, motion.v, motion.carried, motion.rounding)
        left = jnp.maximum(-made.y, 0)
        return Moved(made.y, made.v, made.a, Record(made.height, made.contact, left, made.solve))


@dataclass(frozen=True)
class Smoothed:
    """The derivative of a program with a soft floor: softplus contact, softened restitution.

    Attributes:
        eps: width, m. Small: near the given program, with derivatives that peak at its contacts. Large: a
            tame derivative, of something else. None for one that suits the problem: a tenth of the depth to
            which a penalty gives way, and for an impact the narrowest floor that the step resolves.
    """

    eps: float | None = None

    name = "smoothed"
    says = "The derivative of another program, whose floor acts over a width eps; its loss is another too."

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
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
        # the soft floor's own stiffness and width are not what these names mean in the given program
        theirs = [name for name in names if name in START or problem.world.has(name)]
        own = (
            ()
            if isinstance(problem.world.contact, Penalty)
            else ("k", "eps", "alpha", "tol", "enter", "rest_speed")
        )
        here = [name for name in theirs if name not in own]
        problem.values(names)
        value, slopes, marks = scaled(soft, here)
        depends, why = used(soft, here, slopes, marks=marks)
        for name in names:
            if name not in here:
                slopes[name], depends[name] = 0.0, False
                why[name] = f"the smooth program has no {name}"
        hard = problem.value()
        details = {"eps": eps, "loss_of_the_given_program": hard, "bias_of_the_loss": value - hard}
        return Gradient(self.name, self.says, value, slopes, depends, why, details)


def softened(problem: Problem, eps: float) -> Problem:
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
        VelocityVerlet(world.integrator.h) if isinstance(world.integrator, EventLocated) else world.integrator
    )
    return replace(problem, world=replace(world, contact=soft, integrator=scheme))


def _speed(problem: Problem) -> float:
    """With which a ball of this problem arrives at the floor, m/s; 1 where none falls."""
    height = max(float(np.max(np.asarray(problem.y0, np.float64))), 0.0)
    square = float(np.max(np.asarray(problem.v0, np.float64) ** 2))
    return float(np.sqrt(square + 2 * abs(float(problem.world.gravity)) * height)) or 1.0


def _suitable(problem: Problem) -> float:
    contact = problem.world.contact
    if isinstance(contact, Penalty):
        return 0.1 * _speed(problem) / float(np.sqrt(float(contact.k)))
    return _RESOLVED * _speed(problem) * float(problem.world.integrator.h)
