"""The reverse pass of forces: what a cotangent on the forces does to positions and parameters.

A conservative force is a gradient, so its Jacobian is symmetric and the transpose of the Jacobian times a
vector is the Jacobian times that vector. Of a pair potential that is a tangent evaluation, pair by pair,
gathered as the forces are: nothing is scattered. Of any other energy it is one tangent through one gradient
of the energy. No tape is kept, and the decisions are those that the run acted on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, UInt8

from mdnum.errors import InputError
from mdnum.gradients.parameters import quantities, with_quantities
from mdnum.md.decide import PairDecider, Tables, displacements, halves_of, unpacked
from mdnum.md.manybody import EnergyFunction as EnergyFunction
from mdnum.md.manybody import ManyBody
from mdnum.md.neighbors import check_radius
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.md.potentials import CutPotential, of_type
from mdnum.numerics import PrecisionPolicy
from mdnum.systems.build import Simulation


class ForceCotangents(NamedTuple):
    """What comes back through one evaluation of forces.

    Attributes:
        x: on the positions, shape (3, atoms).
        model: on the parameters, a pytree of arrays like theirs; zeros where it was not asked for.
        scale: on a common factor of all distances (the box and everything in it), at 1.
        force: the forces themselves, shape (3, atoms), energy/length.
    """

    x: Float[Array, "3 atoms"]
    model: Any
    scale: Float[Array, ""]
    force: Float[Array, "3 atoms"]


#: What a reverse pass can be asked for beyond positions: the parameters of the potential, a common factor of
#: all distances, the forces themselves (for the derivatives by the integrator's numbers).
MODEL, SCALE, FORCE = "model", "scale", "force"


def pull_back(
    force: PairForce | ManyBodyForce,
    x: Float[Array, "3 atoms"],
    tables: Tables,
    bits: UInt8[Array, "words atoms"],
    onto_force: Float[Array, "3 atoms"],
    onto_energy: Float[Array, ""],
    onto_virial: Float[Array, ""],
    wanted: frozenset[str] = frozenset(),
) -> ForceCotangents:
    """The transpose of one evaluation of forces, energy and virial at given decisions.

    Args:
        force: of a pair potential or of any other energy.
        x: sorted, wrapped positions, length, shape (3, atoms).
        tables: the list.
        bits: the decisions that were acted on, packed.
        onto_force: cotangent of the forces, shape (3, atoms).
        onto_energy, onto_virial: cotangents of the potential energy and of the virial.
        wanted: of MODEL, SCALE and FORCE; what is not wanted comes back as zeros.

    Error: a rounding error for each pair, in the dtype of the force; sums slot by slot.
    """
    if isinstance(force, PairForce):
        return _of_pairs(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted)
    return _of_energy(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted)


def _of_pairs(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted) -> ForceCotangents:
    dtype = force.policy.dtype("force")
    cell = force.cell.astype(dtype)
    components = tuple(x.astype(dtype))
    w = tuple(onto_force.astype(dtype))
    energy, virial = onto_energy.astype(dtype), onto_virial.astype(dtype)
    model, cut = force.model, force.model.cutoff
    at, back_to_model = jax.vjp(lambda model: model.at_cutoff(), model)
    types_of = model.pair_types
    by_parameter = (model.potential, at) if MODEL in wanted else ()
    nothing = jnp.zeros(x.shape[1], dtype)

    def block(carry, listed):
        (j, types), told = listed
        inside = unpacked(told)
        d = displacements(components, cell, j)
        dw = tuple(c.at[j].get(mode="promise_in_bounds") - c for c in w)
        # the argument is masked, not only the result: a padded slot may be at distance zero
        r2 = jnp.where(inside, d[0] * d[0] + d[1] * d[1] + d[2] * d[2], jnp.ones((), dtype))
        along = jnp.where(inside, d[0] * dw[0] + d[1] * dw[1] + d[2] * dw[2], 0)
        (_, slope), (_, bend) = jax.jvp(lambda q: model.evaluate(q, types, at), (r2,), (jnp.ones_like(r2),))
        slope, bend = jnp.where(inside, slope, 0), jnp.where(inside, bend, 0)
        # derivative by r² of what this slot adds to energy and virial
        shared = energy * (0.5 * slope) - virial * (bend * r2 + slope)
        pull, twist = slope + slope, 4 * (bend * along - shared)
        terms = {"x": [pull * dw[c] + twist * d[c] for c in range(3)]}
        if FORCE in wanted:
            terms["force"] = [pull * d[c] for c in range(3)]
        if SCALE in wanted:
            terms["scale"] = [2 * r2 * (shared - bend * along)]
        if MODEL in wanted:
            # each slot has parameters of its own, so that no sum over slots stands inside the loop
            own = jax.tree.map(
                lambda leaf: jnp.broadcast_to(of_type(leaf, types), r2.shape), (model.potential, at)
            )

            def ended(own, r2=r2):
                potential, end = own
                u, s = potential.evaluate(r2)
                return cut.cut(r2, u, s, end)

            _, back = jax.vjp(ended, own)
            onto_u = jnp.where(inside, 0.5 * energy, 0)
            leaves = jax.tree.leaves(back((onto_u, -jnp.where(inside, along + virial * r2, 0)))[0])
            terms["model"] = [
                leaf if types is None else jnp.where(types == kind, leaf, 0)
                for leaf in leaves
                for kind in range(types_of)
            ]
        return {name: _added(carry[name], terms[name]) for name in carry}, None

    start = {"x": (nothing,) * 3}
    if FORCE in wanted:
        start["force"] = (nothing,) * 3
    if SCALE in wanted:
        start["scale"] = (nothing,)
    if MODEL in wanted:
        start["model"] = (nothing,) * (types_of * len(jax.tree.leaves(by_parameter)))
    sums, _ = lax.scan(block, start, (tables.groups(), halves_of(bits)))
    zero = jnp.zeros((), dtype)
    onto_model = jax.tree.map(jnp.zeros_like, model)
    if MODEL in wanted:
        flat = jnp.stack([jnp.sum(total) for total in sums["model"]]).reshape(-1, types_of)
        onto_potential, onto_at = jax.tree.unflatten(jax.tree.structure(by_parameter), list(flat))
        (onto_model,) = back_to_model(onto_at)
        direct = jax.tree.map(jnp.add, onto_model.potential, onto_potential)
        onto_model = CutPotential(direct, cut, onto_model.r_cut, onto_model.r_onset)
    return ForceCotangents(
        jnp.stack(sums["x"]).astype(x.dtype),
        onto_model,
        jnp.sum(sums["scale"][0]) if SCALE in wanted else zero,
        jnp.stack(sums["force"]).astype(x.dtype) if FORCE in wanted else jnp.zeros_like(x),
    )


def _added(totals: tuple[Array, ...], terms: list[Array]) -> tuple[Array, ...]:
    """Sums of four slots each, slot after slot: the compiler vectorizes over atoms, the order is fixed."""
    out = []
    for total, term in zip(totals, terms, strict=True):
        for k in range(term.shape[0]):
            total = total + term[k]
        out.append(total)
    return tuple(out)


def _of_energy(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted) -> ForceCotangents:
    values = quantities(force)
    neighbor = force.neighbors(lax.stop_gradient(x), tables, bits)
    matrix = jnp.asarray(force.cell.matrix)
    w, virial = onto_force.T.astype(jnp.float64), onto_virial.astype(jnp.float64)

    def energy(x, values, scale):
        other: Any = with_quantities(force, values)
        return other.potential.energy(x * scale, neighbor, matrix * scale)

    at = (x.T.astype(jnp.float64), values, jnp.ones((), jnp.float64))
    still = jax.tree.map(jnp.zeros_like, values)
    if MODEL in wanted:
        slope = jax.grad(energy, argnums=(0, 1, 2))
        (by_x, by_model, by_scale), (bend_x, bend_model, bend_scale) = jax.jvp(slope, at, (w, still, virial))
        model = jax.tree.map(lambda bend, one: onto_energy * one - bend, bend_model, by_model)
    else:
        slope = jax.grad(lambda x, scale: energy(x, values, scale), argnums=(0, 1))
        (by_x, by_scale), (bend_x, bend_scale) = jax.jvp(slope, (at[0], at[2]), (w, virial))
        model = still
    # forces on atoms that are measured in units of the box shrink with the square of its scale
    scale = 2 * jnp.sum(w * by_x) - bend_scale + (onto_energy - virial) * by_scale
    return ForceCotangents(
        (onto_energy * by_x - bend_x).T.astype(x.dtype),
        model,
        scale if SCALE in wanted else jnp.zeros_like(scale),
        -by_x.T.astype(x.dtype) if FORCE in wanted else jnp.zeros_like(x),
    )


def with_potential(simulation: Simulation, potential: ManyBody) -> Simulation:
    """The system with another potential: any energy over a neighbor list, such as one of jax-md's.

    Args:
        simulation: the system as objects; in float64.
        potential: an `EnergyFunction`, or one of `mdnum.md.manybody`.

    Raises:
        InputError: its radius and the skin do not fit the box, or the system is not in float64 throughout.
    """
    if simulation.policy != PrecisionPolicy():
        raise InputError(
            "many-body potentials are evaluated in float64 only", remedy="Remove the [precision] table"
        )
    radius = float(potential.r_cut)  # type: ignore[attr-defined]
    check_radius(simulation.cell, radius, simulation.rule.skin)
    decider = PairDecider((radius,), "r <", "float64", simulation.decider.reach)
    return replace(simulation, model=potential, decider=decider)
