"""Simulations with fixed-point numbers: positions, momenta and pair forces are integers times a unit.

All units are powers of two. Integer multiples of a unit are therefore exact doubles. Sums of integers do not
depend on the order of summation. Squared distances in pair decisions have no rounding error. A step that adds
an integer is reversed by subtracting this integer.

A pair force is computed in float64 from the exact distance. The operations round equally with every compiler.
The force is then rounded to its unit. The forces on both atoms are exactly opposite. The total momentum is
therefore constant. Forces do not depend on atom labels or on the neighbor list.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.decide import (
    Decisions,
    PairDecider,
    SlotJudge,
    displacements,
    halves_of,
    packed,
)
from mdnum.md.integrators import ByAtom, Integrator, Langevin, VelocityVerlet
from mdnum.md.pairforce import VOIGT, Forces, Guarded, PairForce, imposed, symmetric
from mdnum.md.potentials import CutPotential, of_type
from mdnum.numerics import Threshold
from mdnum.numerics.exact import fence, normal_quantile, reproducible, squared_norm, zero_bits

#: Distances in a list are below 2^30 spacings, so that the sum of three squares fits a 64-bit integer.
REACH_BITS = 30
# beyond all their squares, and with one of them subtracted still a 64-bit integer
_NOWHERE = 2**62
# steps of a thermal momentum, of a force of the scale of energy over the cutoff, and of that scale itself in
# a system of at least so many atoms
_MOMENTUM_BITS, _FORCE_BITS, _ENERGY_BITS = 44, 36, 48
_FEWEST = 1024


def power_of_two(x: float) -> float:
    """Return the smallest power of two that is at least x."""
    mantissa, exponent = math.frexp(x)
    return math.ldexp(1.0, exponent - 1 if mantissa == 0.5 else exponent)


@dataclass(frozen=True)
class FixedPointUnits:
    """Units of positions, forces and energies in a simulation with fixed-point numbers."""

    spacing: float  # of positions, length, the same along all axes
    force: float  # of pair forces, energy/length
    energy: float  # of pair energies, virials and kinetic energies
    # largest relative change of an edge of the box that made it a whole number of spacings
    stretch: float = 0.0

    @classmethod
    def create(
        cls,
        cell: Cell,
        r_list: float,
        model: CutPotential,
        momentum: Float[np.ndarray, "atoms"],
        kT: float,
        timestep: float,
    ) -> FixedPointUnits:
        """Choose the units for a box, a neighbor list radius and a potential.

        The position spacing is the smallest power of two for which squared distances of listed pairs are
        exact. The unit of force is the smallest for which all sums of momenta and forces are exact. The unit
        of momentum is the unit of force times half a time step.

        Args:
            r_list: radius of the neighbor lists, length.
            momentum: for each atom, the larger of its initial momentum and a thermal momentum, mass
                length/time.
            kT: temperature as an energy. timestep: internal time.

        Raises:
            InputError: the box is not orthorhombic, or so large that coordinates are not exact.
        """
        spacing = power_of_two(1.001 * r_list / 2**REACH_BITS)
        scale = max(_depth(model), kT)
        force = scale / float(np.max(model.r_cut)) / 2**_FORCE_BITS
        force = max(force, 2 / timestep * float(np.max(momentum)) / 2**_MOMENTUM_BITS)
        energy = scale * max(len(momentum), _FEWEST) / 2**_ENERGY_BITS
        made = cls(spacing, power_of_two(force), power_of_two(energy))
        edges = np.diag(np.asarray(cell.matrix, np.float64))
        rounded = np.diag(np.asarray(made.cell(cell).matrix))
        whole = edges != 0
        stretch = float(np.max(np.abs(rounded[whole] / edges[whole] - 1), initial=0.0))
        return cls(made.spacing, made.force, made.energy, stretch)

    def cell(self, cell: Cell) -> Cell:
        """Return the box with edges rounded to integer multiples of the position spacing.

        Raises:
            InputError: the box is not orthorhombic, or too large.
        """
        if not cell.orthorhombic:
            raise InputError(
                "fixed-point positions are supported only in an orthorhombic box with edges along x, y and z",
                where="precision.state",
                remedy='Set state = "float64" for other boxes',
            )
        matrix = np.round(np.asarray(cell.matrix, np.float64) / self.spacing)
        if np.max(np.abs(matrix)) >= 2**50:
            raise InputError(
                "the box is too large for the resolution of fixed-point positions", where="precision.state"
            )
        made = Cell.create(matrix * self.spacing, cell.pbc)
        # an atom at the far face is at the near one: L times its inverse must not round below 1
        inverse, edges = np.array(made.inverse), np.diag(matrix * self.spacing)
        for k in range(3):
            if made.pbc[k] and edges[k] * inverse[k, k] < 1:
                inverse[k, k] = np.nextafter(inverse[k, k], np.inf)
        return eqx.tree_at(lambda one: one.inverse, made, inverse)

    def positions(self, x: Float[np.ndarray, "atoms 3"]) -> Float[np.ndarray, "atoms 3"]:
        """Return positions rounded to integer multiples of the position spacing."""
        return np.round(np.asarray(x, np.float64) / self.spacing) * self.spacing

    def total(self, terms: Float[Any, "*shape"]) -> Float[Any, ""]:
        """Round energies to the unit of energy, and return their sum. The order of terms has no effect."""
        return jnp.sum(jnp.round(terms * (1 / self.energy))) * self.energy

    def to_dict(self, timestep: float) -> dict[str, float]:
        """Return the fixed-point units by name, as multiples of the system's units."""
        return {
            "spacing": self.spacing,
            "force": self.force,
            "momentum": self.force * timestep / 2,
            "energy": self.energy,
            "box_change": self.stretch,
        }


def _depth(model: CutPotential) -> float:
    """Return an energy scale of a pair potential: its depth, or its value near 0.6 r_cut."""
    r_cut = np.asarray(model.r_cut, np.float64)
    r = r_cut * np.linspace(0.2, 1.0, 400)[:, None]
    energy = np.asarray(model.potential.evaluate(jnp.asarray(r * r))[0])
    depth = float(np.max(-np.where(np.isfinite(energy), energy, 0.0)))
    if depth > 0:
        return depth
    height = float(np.max(np.abs(energy[len(r) // 2])))
    return height if height > 0 else float(np.max(np.abs(energy[np.isfinite(energy)]), initial=1.0))


@dataclass(frozen=True)
class FixedPointDecider(PairDecider):
    """The rule that decides whether a pair is inside the cutoff, by comparison of two integers.

    The squared distance is an integer in units of the squared position spacing. A comparison has the form
    `r2 < limit` with an integer limit. The threshold for margins is half a unit below the limit. Margins are
    therefore never zero and have no rounding error.
    """

    spacing: float = 1.0  # of positions, length

    @property
    def space(self) -> str:
        """Name of the compared quantity: always "r2", the squared distance."""
        return "r2"

    @property
    def limits(self) -> tuple[int, ...]:
        """Smallest r² outside the cutoff by pair type, in units of the squared position spacing."""
        unit = Fraction(self.spacing) ** 2
        square = self.compare.startswith("r2")
        exact = [(Fraction(r * r) if square else Fraction(r) ** 2) / unit for r in self.r_cut]
        return tuple(math.floor(q) + 1 if self.compare.endswith("<=") else math.ceil(q) for q in exact)

    @property
    def thresholds(self) -> tuple[Threshold, ...]:
        """Thresholds of r² by pair type, as doubles. Thresholds are half a unit below `limits`."""
        unit = self.spacing * self.spacing
        return tuple(Threshold((limit - 0.5) * unit, "<", "r2") for limit in self.limits)

    @cached_property
    def bounds(self) -> tuple[float, ...]:
        """Error bounds of margins by pair type: all zero, because margins are exact."""
        return (0.0,) * len(self.r_cut)

    def inside(self, quantity, value):
        return quantity < value

    def host_squares(self, dx, dy, dz) -> Int[np.ndarray, "..."]:
        """Return squared distances as integers, in units of the squared position spacing."""
        edge = float(2**REACH_BITS)
        parts = (np.round(np.asarray(c, np.float64) / self.spacing) for c in (dx, dy, dz))
        whole = [np.clip(c, -edge, edge).astype(np.int64) for c in parts]
        return whole[0] * whole[0] + whole[1] * whole[1] + whole[2] * whole[2]

    def host_quantity(self, dx, dy, dz) -> Float[np.ndarray, "..."]:
        """Return squared distances on the host (length²). Each is rounded only once."""
        return self.host_squares(dx, dy, dz).astype(np.float64) * (self.spacing * self.spacing)

    def host_margin(self, displacement, kind) -> Float[np.ndarray, "..."]:
        """Return margins of squared distances on the host. Each is rounded only once."""
        left = np.asarray(self.limits, np.int64)[kind] - self.host_squares(*displacement)
        return (left - 0.5) * (self.spacing * self.spacing)


# --- steps in fixed-point numbers, forward and back --------------------------------------------------

# a velocity in float64 gives back its integer momentum up to here
_LARGEST = 2.0**50
# friction is a multiple of 2^-24; the remainders may take the bits of a 64-bit integer that are left
_SHIFT = 24
_ROOM = 62 - _SHIFT


class FixedPointStep(Integrator):
    """Base class of integrators in fixed-point numbers, whose kicks and drifts add integers."""

    units: FixedPointUnits = eqx.field(static=True, kw_only=True)  # the units
    # unit of momentum: that of force times half a time step
    impulse: Float[Array, ""] = eqx.field(kw_only=True)
    # spacings that an atom of unit mass moves in a step for each unit of momentum
    stride: Float[Array, ""] = eqx.field(kw_only=True)
    zero: Int[Array, ""] = eqx.field(kw_only=True)  # an integer zero that XLA must not know

    def momentum(self, v: Float[Array, "3 atoms"], masses: Float[Array, "atoms"]) -> Float[Array, "3 atoms"]:
        """Convert velocities to integer momenta, without error for velocities of a fixed-point simulation."""
        return jnp.round(v * (masses / self.impulse))

    def velocity(self, p: Float[Array, "3 atoms"], masses: Float[Array, "atoms"]) -> Float[Array, "3 atoms"]:
        """Return velocities from integer momenta. NaN if a momentum is too large."""
        return jnp.where(jnp.abs(p) < _LARGEST, p * (self.impulse / masses), jnp.nan)

    def kick(self, v, time, acceleration, masses):
        """Return velocities after an acceleration for a given time. Momenta are rounded to integers."""
        push = jnp.round(time * acceleration * (masses / self.impulse))
        return self.velocity(self.momentum(v, masses) + push, masses)

    def finish(self, v, extra, at, time):
        return self.kick(v, time, at.acceleration, at.masses), extra

    def begin(self, x, v, extra, at):
        v = self.kick(v, 0.5 * self.timestep, at.acceleration, at.masses)
        return self.drift(x, v, extra, at.masses, at.step, at.order)

    @abstractmethod
    def drift(self, x, v, extra, masses, step, order):
        """Advance positions, velocities and extra state after the kick in `begin`."""

    @abstractmethod
    def undrift(self, x, v, extra, masses, step, order):
        """Return positions, velocities and extra state before the drift of a step."""

    def kinetic(self, v, masses):
        """Return the kinetic energy, which does not depend on the order of the atoms."""
        return self.units.total(0.5 * (masses * squared_norm(v[0], v[1], v[2], self.zero)))

    def glide(self, x, p, masses, share: float, direction: int):
        """Move atoms for a `share` of a time step. Move them backward if direction is -1."""
        moved = jnp.round(p * (share * self.stride / masses))
        return x + direction * self.units.spacing * moved


class FixedPointVerlet(FixedPointStep):
    """Velocity Verlet integrator at constant energy, in fixed-point numbers."""

    name = "nve"

    def drift(self, x, v, extra, masses, step, order):
        p = self.momentum(v, masses)
        return self.glide(x, p, masses, 1.0, 1), v, extra, jnp.zeros((), jnp.float64)

    def undrift(self, x, v, extra, masses, step, order):
        return self.glide(x, self.momentum(v, masses), masses, 1.0, -1), v, extra


class FixedPointLangevin(FixedPointStep):
    """Fixed-point Langevin integrator (BAOAB); the extra state stores momentum bits removed by friction."""

    name = "langevin"
    keeps_momentum = False
    key: Array = eqx.field(kw_only=True)  # as Langevin's
    # numerator of the factor that friction leaves of a momentum in a step, over 2^24
    kept: Int[Array, ""] = eqx.field(kw_only=True)
    # size of the noise of an atom of unit mass, in units of momentum
    spread: Float[Array, ""] = eqx.field(kw_only=True)
    pause: Int[Array, ""] = eqx.field(kw_only=True)  # steps after which the bath is put aside

    def noise(self, step, masses, order) -> Float[Array, "3 atoms"]:
        """Return the momentum added by noise at a step, in integer units."""
        low = np.nextafter(-1.0, 0.0)
        shape = (3, masses.shape[0])
        # the numbers that jax.random.normal makes its deviates of
        u = jax.random.uniform(jax.random.fold_in(self.key, step), shape, jnp.float64, low, 1.0)[:, order]
        return jnp.round(normal_quantile(u, self.zero) * (self.spread * jnp.sqrt(masses)))

    def init(self, x, v, masses):
        return ByAtom(jnp.zeros(x.shape, jnp.int64))

    def drift(self, x, v, extra, masses, step, order):
        p = self.momentum(v, masses)
        x = self.glide(x, p, masses, 0.5, 1)
        bath = jnp.where(step % self.pause == 0, 0, extra.value)
        whole = p.astype(jnp.int64)
        filled = (bath << _SHIFT) | (whole & ((1 << _SHIFT) - 1))
        bath = filled // self.kept
        whole = (whole >> _SHIFT) * self.kept + (filled - bath * self.kept)
        after = whole.astype(jnp.float64) + self.noise(step, masses, order)
        kicked = self.velocity(after, masses)
        heat = self.kinetic(kicked, masses) - self.kinetic(v, masses)
        return self.glide(x, after, masses, 0.5, 1), kicked, ByAtom(bath), heat

    def undrift(self, x, v, extra, masses, step, order):
        p = self.momentum(v, masses)
        x = self.glide(x, p, masses, 0.5, -1)
        whole = (p - self.noise(step, masses, order)).astype(jnp.int64)
        high = jnp.floor_divide(whole, self.kept)
        filled = extra.value * self.kept + (whole - high * self.kept)
        before = (high << _SHIFT) | (filled & ((1 << _SHIFT) - 1))
        before, bath = before.astype(jnp.float64), ByAtom(filled >> _SHIFT)
        return self.glide(x, before, masses, 0.5, -1), self.velocity(before, masses), bath


def fixed_point_steps(integrator: Integrator, units: FixedPointUnits) -> FixedPointStep:
    """Return the fixed-point version of an integrator (velocity Verlet or Langevin).

    Raises:
        InputError: the friction is too small or too large for the time step, or the integrator has no
            fixed-point version.
    """
    if type(integrator) not in (VelocityVerlet, Langevin):
        raise InputError(
            f"fixed-point arithmetic supports the integrators nve and langevin, not {integrator.name}",
            where="precision.state",
            remedy='Use nve or langevin, or set state = "float64"',
        )
    timestep = float(integrator.timestep)
    impulse = units.force * (0.5 * timestep)
    common = {
        "units": units,
        "impulse": jnp.asarray(impulse, jnp.float64),
        "stride": jnp.asarray(timestep * impulse / units.spacing, jnp.float64),
        "zero": zero_bits(np.float64),
    }
    if isinstance(integrator, Langevin):
        loss = float(integrator.friction) * timestep
        kept = round(math.exp(-loss) * 2**_SHIFT)
        period = _period(kept)
        if period < 1:
            raise InputError(
                f"friction x timestep = {loss:.3g}; expected a product between 1e-7 and 10 in fixed-point "
                "arithmetic",
                where="dynamics.friction",
            )
        decay = kept / 2**_SHIFT
        spread = math.sqrt(float(integrator.kT) * (1 - decay * decay)) / impulse
        return FixedPointLangevin(
            integrator.timestep,
            key=integrator.key,
            kept=jnp.asarray(kept, jnp.int64),
            spread=jnp.asarray(spread, jnp.float64),
            pause=jnp.asarray(period, jnp.int64),
            **common,
        )
    return FixedPointVerlet(integrator.timestep, **common)


def _period(kept: int) -> int:
    """Return the number of steps after which a factor of 2^24 / `kept` per step may overflow integers."""
    if not 0 < kept < 2**_SHIFT:
        return 0
    growth = 2**_SHIFT / kept
    # b' <= (b + 1) growth, from 0: b_k <= growth^(k+1) / (growth - 1)
    return int((_ROOM + math.log2(growth - 1)) / math.log2(growth)) - 2


def forgotten_bits(integrator: Integrator) -> float:
    """Return the bits of a momentum that friction removes per step. 0 without a thermostat."""
    if isinstance(integrator, Langevin):
        return float(integrator.friction) * float(integrator.timestep) / math.log(2)
    return 0.0


# --- pair forces of integer distances: decided exactly, rounded pair by pair, summed without rounding ---

# added to a double below 2^51 it leaves the nearest integer in the low bits
_ROUND = 1.5 * 2**52
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


@jax.custom_jvp
def counted(x: Float[Array, "*shape"], zero: jax.Array) -> jax.Array:
    """Round numbers below 2^51 to integers by one addition. The result includes `_ROUND_BITS`."""
    return lax.bitcast_convert_type(fence(x, zero) + _ROUND, jnp.int64)


@counted.defjvp
def _counted_jvp(primals, tangents):
    # a derivative of 0 would be taken for an answer
    raise InputError(
        "a time step in fixed-point arithmetic has no derivative, because it rounds numbers to integers",
        where="precision.state",
        remedy="Use --methods reversible or symmetric, which differentiate the step without rounding",
    )


class FixedPointJudge(SlotJudge):
    """Pair decisions from integers in fixed-point units. The interface is that of `SlotJudge`."""

    def __init__(
        self, decider: FixedPointDecider, limits, cell: Cell, zero, positions, units: FixedPointUnits
    ):
        inverse = 1 / units.spacing
        self.decider, self.zero, self.units = decider, zero, units
        # powers of two, so nothing is rounded but positions that were no multiples of the spacing
        self.cell = Cell(cell.matrix * inverse, cell.inverse * units.spacing, cell.pbc, cell.orthorhombic)
        self.components = tuple(jnp.round(positions.astype(jnp.float64) * inverse))
        self.atoms = positions.shape[1]
        self.value = limits

    def start(self) -> jax.Array:
        """Return the start value for each atom's smallest |margin|, in squared position spacings."""
        return jnp.full(self.atoms, jnp.iinfo(jnp.int64).max, jnp.int64)

    def group(self, j, types):
        """Return displacements, r², decisions and limits of neighbors j, in position spacings."""
        d = displacements(self.components, self.cell, j)
        edge = float(2**REACH_BITS)
        # what is further away than any listed pair is outside; its square might not fit
        squares = []
        for c in d:
            whole = lax.bitcast_convert_type(jnp.clip(c, -edge, edge) + _ROUND, jnp.int64)
            # the low half is the integer: a product of two halves is one that every processor has
            whole = whole.astype(jnp.int32).astype(jnp.int64)
            squares.append(whole * whole)
        r2 = squares[0] + squares[1] + squares[2]
        limit = jnp.where(j < self.atoms, of_type(self.value, types), -_NOWHERE)
        return d, r2, r2 < limit, limit

    def tally(self, nearest, quantity, inside, threshold):
        """Return the decisions on a group of neighbors as bits, and each atom's smallest |margin|."""
        bits = jnp.zeros(self.atoms, jnp.uint8)
        left = threshold - quantity
        away = jnp.maximum(left, 1 - left)
        for k in range(inside.shape[0]):
            bits = bits | (inside[k].astype(jnp.uint8) << jnp.uint8(k))
            nearest = jnp.minimum(nearest, away[k])
        return bits, nearest

    def finish(self, nearest, halves) -> Decisions:
        """Return the decisions for the whole list, with two groups of slots per byte."""
        unit = self.units.spacing * self.units.spacing
        closest = jnp.min(nearest, initial=jnp.iinfo(jnp.int64).max)
        margin = jnp.where(closest < _NOWHERE, (closest.astype(jnp.float64) - 0.5) * unit, jnp.inf)
        return Decisions(packed(halves), margin)


class FixedPointForce(PairForce):
    """Forces and decisions of a pair potential with a cutoff, in fixed-point numbers."""

    units: FixedPointUnits = eqx.field(static=True, kw_only=True)  # the units
    # squared distance below which a pair leaves the range of exact sums
    closest: Float[Array, ""] = eqx.field(kw_only=True)

    @classmethod
    def on(
        cls, units: FixedPointUnits, model: CutPotential, cell: Cell, decider, policy, reduction
    ) -> FixedPointForce:
        """Create the force object in float64. `reduction` has no effect, since sums are exact."""
        return cls(
            model.astype(np.float64),
            cell.astype(np.float64),
            zero_bits(np.float64),
            jnp.asarray(decider.limits, jnp.int64),
            decider.convention,
            policy,
            reduction,
            units=units,
            closest=jnp.asarray(_closest(model, units), jnp.float64),
        )

    @property
    def law(self) -> Guarded:
        """The potential with its cutoff. Every compiler gives the same bits."""
        return Guarded(self.model, self.zero, reproducible)

    def judge(self, positions: Float[Array, "3 atoms"]) -> FixedPointJudge:
        """Return the pair decisions at the given positions, as a `FixedPointJudge`."""
        assert isinstance(self.decider, FixedPointDecider)
        return FixedPointJudge(self.decider, self.thresholds, self.cell, self.zero, positions, self.units)

    def decide(self, positions, tables):
        """Return the decisions on all pairs of a neighbor list, from integer distances."""
        return self.judge(positions).decide(tables)

    def __call__(self, positions, tables, *, decisions, tensor=False, given=None, where=None):
        """Return forces, rounded per pair to integer multiples of the unit of force.

        The energy is NaN if a pair force exceeds the range of exact sums.
        """
        judge, units = self.judge(positions), self.units
        law, zero = self.law, self.zero
        at = law.at_cutoff()
        unit = units.spacing * units.spacing
        steps = units.spacing / units.force
        # what a pair outside is evaluated at
        far = jnp.max(self.model.r_cut) ** 2

        def block(carry, listed):
            totals, nearest, close = carry
            (j, types), told, pinned = listed
            d, quantity, inside, threshold = judge.group(j, types)
            bits = None
            if decisions:
                bits, nearest = judge.tally(nearest, quantity, inside, threshold)
            if told is not None:
                inside = imposed(inside, told, pinned)
            # the argument is masked, not only the result: a padded slot may be at distance zero
            r2 = jnp.where(inside, quantity.astype(jnp.float64) * unit, far)
            energy, slope = law.evaluate(r2, types, at)
            energy, slope = jnp.where(inside, energy, 0), jnp.where(inside, slope, 0)
            pull = slope + slope
            # worked out once: each component's loop would work it out again
            force, d = lax.optimization_barrier((pull * steps, d))
            scale = 1 / units.energy
            terms = [*(force * c for c in d), energy * scale, pull * r2 * scale]
            terms += [pull * unit * scale * d[a] * d[b] for a, b in VOIGT] if tensor else []
            added = []
            for total, term in zip(totals, terms, strict=True):
                whole = counted(term, zero)
                for k in range(whole.shape[0]):
                    total = total + whole[k]
                added.append(total)
            for k in range(r2.shape[0]):
                close = jnp.minimum(close, r2[k])
            return (tuple(added), nearest, close), bits

        atoms = judge.atoms
        start = ((jnp.zeros(atoms, jnp.int64),) * (11 if tensor else 5), judge.start(), jnp.full(atoms, far))
        told, pinned = (None if bits is None else halves_of(bits) for bits in (given, where))
        (totals, nearest, close), halves = lax.scan(block, start, (tables.groups(), told, pinned))
        slots = tables.index.shape[0] * tables.index.shape[1]
        # of 64-bit integers the sum wraps round, and this takes off what wrapped
        excess = jnp.asarray((slots * _ROUND_BITS + 2**63) % 2**64 - 2**63, jnp.int64)
        fx, fy, fz, energy, *virial = (total - excess for total in totals)
        fx, fy, fz, energy = (total.astype(jnp.float64) for total in (fx, fy, fz, energy))
        # both ends of a pair count, and a pressure may be large: summed as integers to the end
        virial = [jnp.sum(one).astype(jnp.float64) * (-0.5 * units.energy) for one in virial]
        exact = jnp.min(close) > self.closest
        return Forces(
            jnp.stack([fx, fy, fz]) * units.force,
            jnp.where(exact, energy, jnp.nan) * (0.5 * units.energy),
            virial[0],
            judge.finish(nearest, halves) if decisions else None,
            symmetric(virial[1:]) if tensor else None,
        )


def _closest(model: CutPotential, units: FixedPointUnits) -> float:
    """Return the smallest r² at which energy, force and virial of a pair are below 2^50 units."""
    r_cut, atom = np.asarray(model.r_cut, np.float64), model.at_cutoff()
    r = r_cut * np.geomspace(1, 1e-3, 4000)[:, None]
    energy, slope = (
        np.asarray(part) for part in model.evaluate(jnp.asarray(r * r), jnp.arange(len(r_cut)), atom)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        force = 2 * np.abs(slope) * r
        counts = [np.abs(energy) / units.energy, force / units.force, force * r / units.energy]
    beyond = ~np.all(np.stack(counts) < 2.0**50, axis=0)
    return float(np.max(np.where(beyond, r * r, 0.0)))
