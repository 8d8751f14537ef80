"""The derivative of a ball's motion: with the time of each contact moving along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.ball.problem import START, BallProblem
from mdnum.ball.step import BallDecisions, BallRecord, BallState, EventLocated, Penalty, Projection
from mdnum.ball.world import World
from mdnum.errors import NumericalError
from mdnum.gradients.ball import BallMethod, Used, origin, scaled, start_of, used
from mdnum.gradients.problem import Gradient
from mdnum.numerics.saltation import carry, grazing

#: Parameters of how a projection is solved, not of what it stands for.
_SOLVER = ("k", "alpha", "tol", "enter")
#: Which derivative that is of a spring, sharp or soft.
_SPRING = (
    "the derivative of the steps: a spring's force does not jump at a contact, so its time moves no "
    "tangent (the saltation matrix is 1)"
)
#: |n · F-| below this share of |F-| counts as grazing.
_NARROW = 1e-6


@dataclass(frozen=True)
class ThroughContacts(BallMethod):
    """The derivative of the ball's motion, contacts included, rather than of the steps that imitate it.

    A step decides about contact at its end, so its derivative does not know that a ball which starts higher
    arrives later: for an impact reset at the end of the step the derivative by y0 is 0 however small the
    step. Here a tangent is carried along with the rollout and multiplied by the saltation matrix at every
    contact. Where the impact is located inside the step the program's own derivative is already this one.
    A projection is read as the impact that it stands for. The force of a spring without a damper does not
    jump, so nothing is added: of a spring this is the unrolled derivative, and says so.
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
        located = isinstance(world.integrator, EventLocated)
        smooth = isinstance(world.contact, Penalty) and world.contact.smooth
        if located or smooth:
            run = problem.run(keep=False)
            value, slopes, marks = scaled(problem, names)
            # the time of an impact without speed has an infinite derivative
            _refuse(0 if np.all(np.isfinite(list(slopes.values()))) else 1)
            events = int(run.iterations.sum()) if located else 0
        else:
            at, start = origin(problem, names), start_of(problem)
            value, slopes, events, flagged = _tangents(at, world, *start, problem.steps, problem.loss)
            _refuse(int(flagged))
            value, events = float(value), int(events)
            slopes, marks = {name: float(slopes[name]) for name in names}, None
        depends, why = used(problem, names, slopes, marks=marks)
        for name in names:
            if slopes[name] != 0 and not depends[name]:
                depends[name], why[name] = True, f"the time of a contact depends on {name}"
            elif name in _SOLVER and isinstance(world.contact, Projection):
                depends[name], why[name] = False, f"the impact that is solved for does not depend on {name}"
        details = {"events": events, "located": located}
        spring = isinstance(world.contact, Penalty) and not float(world.contact.damping)
        made = self.result(value, slopes, Used(depends, why), details)
        return replace(made, description=_SPRING) if spring else made


def _refuse(grazing: int) -> None:
    if grazing:
        raise NumericalError(
            f"contacts that graze the floor: {grazing}; their time has no derivative",
            remedy="Move the start or the step until the ball crosses the floor, or smooth the contact.",
        )


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

    def started(name):
        return jax.jvp(lambda given: begin(given)[0], (values,), (along(name),))[1]

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
    carried = (
        state,
        {name: started(name) for name in names},
        nothing,
        dict.fromkeys(names, nothing),
        count,
        count,
    )
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
        before, behind = _flows(state, jnp.zeros_like(state.v), sign * world.contact.damping * state.v)
        kicked = carry(jnp.stack(tangent[:2], axis=-1), None, before, behind, _normal(state.v))
        dy = jnp.where(flips, kicked[:, 0], tangent[0])
        dv = jnp.where(flips, kicked[:, 1], tangent[1])
        _, out = jax.jvp(_advance(world, rest, state, record.decisions), point, (seed, dy, dv, tangent[2]))
        return out[:3], out[3]
    flight = _advance(world, rest, state, _flight(world, state, record))
    (_, v, free, _, _), (dy, dv, da, _, _) = jax.jvp(flight, point, (seed, *tangent))
    bounce = world.contact.restitution.astype(v.dtype)
    nothing = jnp.zeros_like(v)
    reset = jnp.stack(
        [
            jnp.stack([nothing + 1, nothing], axis=-1),
            jnp.stack([nothing, nothing - bounce], axis=-1),
        ],
        axis=-2,
    )
    rate = (
        jnp.stack([nothing, -v * seed["restitution"].astype(v.dtype)], axis=-1)
        if "restitution" in seed
        else 0.0
    )
    out = carry(
        jnp.stack([dy, dv], axis=-1),
        reset,
        jnp.stack([v, free], axis=-1),
        jnp.stack([-bounce * v, free], axis=-1),
        _normal(v),
        reset_rate=rate,
    )
    falls = record.contact & (v < 0)
    rests = record.contact & (after.v == 0)
    dy = jnp.where(rests, nothing, jnp.where(falls, out[:, 0], dy))
    dv = jnp.where(rests, nothing, jnp.where(falls, out[:, 1], dv))
    return (dy, dv, da), jnp.zeros_like(record.left)


def _normal(v):
    return jnp.stack([jnp.ones_like(v), jnp.zeros_like(v)], axis=-1)


def _flows(state, before, jump):
    return (
        jnp.stack([state.v, before], axis=-1),
        jnp.stack([state.v, before + jump], axis=-1),
    )


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
    flow = jnp.stack([v, after.a.astype(v.dtype)], axis=-1)
    grazes = counts & grazing(flow, _normal(v), _NARROW)
    return jnp.sum(hits, dtype=jnp.int64), jnp.sum(grazes, dtype=jnp.int64)
