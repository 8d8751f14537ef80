"""The program of a rollout as a function that JAX differentiates: its own steps, lists and decisions.

A chunk is a fixed number of steps with one list, as a scan, so that reverse mode has a bound on what it
keeps. What ends a list's life in a rollout ends the chunk early here: the rest of its steps do nothing. The
host makes the next list at the positions that this program has reached.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.gradients.losses import Frame, Surroundings
from mdnum.gradients.parameters import with_quantities
from mdnum.md.decide import Tables


class Inputs(NamedTuple):
    """Everything that a rollout can be differentiated by.

    Attributes:
        model: the quantities of the force.
        numbers: those of the integrator.
        x, v: wrapped positions and velocities of step 0, user's order, shape (3, atoms).
        scale: a common factor of the box and of all positions, 1.
    """

    model: Any
    numbers: Any
    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    scale: Float[Array, ""]


class Between(NamedTuple):
    """What one step hands to the next and a derivative goes through, user's order.

    Attributes:
        x: wrapped positions, shape (3, atoms).
        v: half-kicked velocities, shape (3, atoms).
        total: sums of the loss.
    """

    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    total: Any


class Fixed(NamedTuple):
    """What does not change along a run and is not differentiated.

    Attributes:
        force, integrator: of the rollout; their quantities are replaced by those of the inputs.
        masses: user's order. half_skin: length.
        loss: the loss. around: what it is told of the system.
        images: lattice vectors taken off the positions of step 0, shape (3, atoms).
    """

    force: Any
    integrator: Any
    masses: Float[Array, "atoms"]
    half_skin: Float[Array, ""]
    loss: Any
    around: Surroundings
    images: Int[Array, "3 atoms"]


class Place(NamedTuple):
    """Where a chunk begins, as far as that has no derivative.

    Attributes:
        step: the step whose forces come next.
        images: lattice vectors taken off so far, user's order, shape (3, atoms).
        home: wrapped positions at which the list was built, user's order, shape (3, atoms).
        built: step at which it was built.
        limit: steps that may be done.
        seen: which of the chunk's steps the loss looks at.
    """

    step: Int[Array, ""]
    images: Int[Array, "3 atoms"]
    home: Float[Array, "3 atoms"]
    built: Int[Array, ""]
    limit: Int[Array, ""]
    seen: Bool[Array, "chunk"]


class Passed(NamedTuple):
    """What a chunk tells beside its end.

    Attributes:
        rows: steps done. due: whether the list is used up. finite: whether all numbers were.
        images: lattice vectors taken off at the end, user's order.
        x, v, bits: of each step, in the list's order, as a rollout records them.
    """

    rows: Int[Array, ""]
    due: Bool[Array, ""]
    finite: Bool[Array, ""]
    images: Int[Array, "3 atoms"]
    x: Float[Array, "chunk 3 atoms"]
    v: Float[Array, "chunk 3 atoms"]
    bits: UInt8[Array, "chunk words atoms"]


@partial(jax.jit, static_argnames=("rule",))
def chunk(
    inputs: Inputs, between: Between, fixed: Fixed, place: Place, tables: Tables, rule: tuple[int, int, bool]
) -> tuple[Between, Passed]:
    """Some steps with one list; differentiable by its first two arguments.

    Args:
        rule: every, delay and check of the rebuild rule.
    """
    every, delay, check = rule
    order = tables.order
    dtype = between.x.dtype
    matrix = jnp.asarray(fixed.force.cell.matrix) * inputs.scale
    force = with_quantities(fixed.force, inputs.model)
    force = replace(force, cell=replace(force.cell, matrix=matrix))
    integrator = eqx.combine(inputs.numbers, eqx.filter(fixed.integrator, eqx.is_inexact_array, inverse=True))
    cell = force.cell.astype(dtype)
    masses = fixed.masses[order]
    mass_row = masses.astype(dtype)
    half = (0.5 * integrator.timestep).astype(dtype)
    home = place.home[:, order]
    scale = inputs.scale
    around = fixed.around._replace(
        matrix=fixed.around.matrix * scale,
        volume=fixed.around.volume * scale**3,
        timestep=integrator.timestep,
    )
    origin = Frame(
        jnp.zeros((), jnp.int64),
        inputs.x * scale.astype(dtype) + (matrix.T @ fixed.images.astype(matrix.dtype)).astype(dtype),
        inputs.v,
        jnp.full((), jnp.nan),
        jnp.full((), jnp.nan),
    )

    def unsorted(a):
        return jnp.zeros_like(a).at[:, order].set(a)

    def used_up(x, step):
        d = lax.stop_gradient(cell).minimum_image(*(lax.stop_gradient(x) - home))
        largest = jnp.sqrt(jnp.max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])).astype(jnp.float64)
        age = step - place.built
        allowed = (age >= delay) & (age % every == 0)
        return allowed & (largest > fixed.half_skin) if check else allowed

    def observe(total, step, x, v, images, potential, virial):
        whole = x + (matrix.T @ images.astype(matrix.dtype)).astype(dtype)
        frame = Frame(step, unsorted(whole), unsorted(v), potential, virial)
        return jax.tree.map(jnp.add, total, fixed.loss.observe(frame, origin, around))

    def act(carry, see):
        step, x, v, images, total, _, finite, rows = carry
        made = force(x, tables, decisions=True)
        acceleration = made.force.astype(dtype) / mass_row
        second = jnp.where(step == 0, jnp.zeros((), dtype), half)
        v = v + second * acceleration
        potential = jnp.sum(made.energy, dtype=jnp.float64)
        total = lax.cond(
            see, observe, lambda total, *_: total, total, step, x, v, images, potential, made.virial
        )
        assert made.decisions is not None
        row = (x, v, made.decisions.bits)
        after, kicked, _ = integrator.drift(x, v + half * acceleration, masses, step, order)
        wrapped, n = cell.wrap(*after)
        images = images + lax.stop_gradient(jnp.stack(n)).astype(jnp.int32)
        x = jnp.stack(wrapped)
        finite = finite & jnp.isfinite(potential) & jnp.isfinite(jnp.sum(jnp.square(v)))
        step = step + 1
        return (step, x, kicked, images, total, used_up(x, step), finite, rows + 1), row

    words, atoms = tables.index.shape[0], order.shape[0]

    def skip(carry, see):
        nothing = jnp.zeros((3, atoms), dtype)
        return carry, (nothing, nothing, jnp.zeros((words, atoms), jnp.uint8))

    def one(carry, see):
        *_, due, finite, rows = carry
        return lax.cond(~due & finite & (rows < place.limit), act, skip, carry, see)

    start = (
        place.step,
        between.x[:, order],
        between.v[:, order],
        place.images[:, order],
        between.total,
        jnp.zeros((), bool),
        jnp.ones((), bool),
        jnp.zeros((), jnp.int64),
    )
    (_, x, v, images, total, due, finite, rows), (xs, vs, bits) = lax.scan(one, start, place.seen)
    passed = Passed(rows, due, finite, unsorted(images), xs, vs, bits)
    return Between(unsorted(x), unsorted(v), total), lax.stop_gradient(passed)


@partial(jax.jit, static_argnames=("rule",))
def keep(inputs, between, fixed, place, tables, rule):
    """A chunk, its reverse function with everything that it keeps, and what it tells beside."""
    return jax.vjp(
        lambda inputs, between: chunk(inputs, between, fixed, place, tables, rule),
        inputs,
        between,
        has_aux=True,
    )


@jax.jit
def pull(back, onto_between: Between, onto_inputs: Inputs) -> tuple[Between, Inputs]:
    """Cotangents through the reverse function of a chunk; those of the inputs are added up."""
    by_inputs, by_between = back(onto_between)
    return by_between, jax.tree.map(jnp.add, onto_inputs, by_inputs)
