"""An integrator's steps with forces from all pairs, without mdnum's lists and loop, for statistics.

Sixteen runs side by side are one compiled program, so that averages and their errors take a second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mdnum.md.cell import Cell
from mdnum.md.integrators import Integrator, one_step
from mdnum.md.pairforce import Forces


def ideal(x: Any, cell: Cell) -> Forces:
    """No forces at all."""
    none = jnp.zeros(())
    return Forces(jnp.zeros_like(x), jnp.zeros(x.shape[1]), none, None, jnp.zeros((3, 3)))


def lennard_jones(r_cut: float) -> Callable[[Any, Cell], Forces]:
    """Cut off and shifted, nearest images in a box of any shape."""
    shift = 4 * (r_cut**-12 - r_cut**-6)

    def forces(x: Any, cell: Cell) -> Forces:
        s = cell.inverse.T @ (x[:, :, None] - x[:, None, :]).reshape(3, -1)
        d = (cell.matrix.T @ (s - jnp.round(s))).reshape(3, x.shape[1], -1)
        r2 = jnp.sum(d * d, axis=0)
        inside = (r2 < r_cut**2) & ~jnp.eye(x.shape[1], dtype=bool)
        six = jnp.where(inside, 1 / jnp.where(inside, r2, 1.0) ** 3, 0.0)
        energy = 2 * jnp.sum(jnp.where(inside, six * six - six - shift / 4, 0.0), axis=1)
        pull = 24 * (2 * six * six - six) / jnp.where(inside, r2, 1.0)
        tensor = 0.5 * jnp.einsum("aij,bij,ij->ab", d, d, pull)
        return Forces(jnp.sum(pull * d, axis=2), energy, jnp.trace(tensor), None, tensor)

    return forces


#: Runs side by side from other velocities and noise: a step of sixteen costs little more than one, and the
#: blocks of an average are independent.
REPLICAS = 16


@eqx.filter_jit
def _steps(integrator: Integrator, forces, cell: Cell, x, velocities, steps: int):
    masses, order = jnp.ones(x.shape[1]), jnp.arange(x.shape[1])

    def run(v, replica):
        own = integrator
        if own.random is not None:
            own = eqx.tree_at(lambda one: one.random, own, jax.random.fold_in(own.random, replica))

        def one(carry, _):
            step, cell, x, v, extra, heat = carry
            made = forces(x, cell)
            end = one_step(own, cell, masses, order, step, x, v, extra, made)
            given, work = own.exchanged(end.extra, end.at)
            kinetic, potential = own.kinetic(end.v, masses), jnp.sum(made.energy)
            conserved = kinetic + potential - heat - given - work
            row = kinetic, potential, made.virial, conserved, cell.matrix
            return (step + 1, end.cell, end.x, end.kicked, end.ahead, heat + end.heat), row

        start = (jnp.int64(0), cell, x, v, own.init(x, v, masses), jnp.zeros(()))
        return lax.scan(one, start, None, steps)[1]

    return jax.vmap(run)(velocities, jnp.arange(len(velocities)))


def trajectory(
    integrator: Integrator, positions, box, *, kT: float, steps: int, forces=ideal, seed: int = 0
) -> dict[str, np.ndarray]:
    """What every step of `REPLICAS` runs records, of atoms of mass 1 whose momenta are drawn and add to zero.

    Args:
        positions: shape (N, 3). box: lattice vectors as rows.

    Returns:
        kinetic, potential, virial, conserved, volume and pressure, shape (replicas, steps); box, with (3, 3).
    """
    rng = np.random.default_rng(seed)
    v = np.sqrt(kT) * rng.standard_normal((REPLICAS, *np.shape(positions)))
    v -= v.mean(axis=1, keepdims=True)
    cell = replace(Cell.create(box).astype(jnp.float64), orthorhombic=False)
    integrator = replace(integrator, constraints=3)
    start = jnp.asarray(np.asarray(positions).T), jnp.asarray(v.transpose(0, 2, 1))
    columns = _steps(integrator, forces, cell, *start, steps)
    names = ("kinetic", "potential", "virial", "conserved", "box")
    made = {name: np.asarray(column) for name, column in zip(names, columns, strict=True)}
    made["volume"] = np.abs(np.linalg.det(made["box"]))
    made["pressure"] = (2 * made["kinetic"] + made["virial"]) / (3 * made["volume"])
    return made
