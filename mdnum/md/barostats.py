"""Constant pressure and temperature: the Martyna-Tobias-Klein barostat and stochastic cell rescaling.

An isotropic barostat (`box = "isotropic"`) changes only the volume of the box. A full barostat ("full")
changes the box without rotating it. A strain or its rate is a number (isotropic) or a symmetric matrix. The
pressure is (2 K + virial) / 3 V with the instantaneous kinetic energy K. The pressure tensor is Π / V with Π
= Σ m v ⊗ v + Σ r ⊗ F. Volumes are sampled with the weight exp(-(U + p V) / k_B T) dV. Full boxes h have the
measure dh / det(h)², where det(h) = V. At zero total momentum, the center of mass does not contribute. At
zero momentum, the mean volume of an ideal gas is N k_B T / p.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.cell import Cell, transformed
from mdnum.md.integrators import AtStep, Integrator, Masses, Number, Vector, quantity
from mdnum.md.pairforce import products, symmetric
from mdnum.md.thermostats import Chain, rescaled

Rate = Float[Array, "..."]  # a number, or a symmetric matrix (3, 3), float64
#: Number of terms of the series below, whose truncation error is less than a rounding error for arguments up
#: to 0.5.
_TERMS = 14


def growth(a: Rate) -> Rate:
    """Return (exp(a) - 1) / a = Σ aᵏ / (k + 1)!, for a number or matrix with norm up to 0.5.

    Matrices use their characteristic polynomial, differentiable even for equal eigenvalues.
    """
    if a.ndim == 0:
        total = jnp.zeros(())
        for k in reversed(range(_TERMS)):
            total = total * a / (k + 2) + 1
        return total
    square = a @ a
    first, second, third = invariants(a, square)
    p, q, r = 0.0, 0.0, 0.0  # the matrix p + q a + r a²
    for k in reversed(range(_TERMS)):
        p, q, r = r * third / (k + 2) + 1, (p - r * second) / (k + 2), (q + r * first) / (k + 2)
    return p * jnp.eye(3) + q * a + r * square


def invariants(a: Float[Array, "3 3"], square: Float[Array, "3 3"]) -> tuple[Number, Number, Number]:
    """Return the coefficients of a³ = first a² - second a + third for a (3, 3) matrix."""
    first = jnp.trace(a)
    second = 0.5 * (first**2 - jnp.trace(square))
    return first, second, a[0] @ jnp.cross(a[1], a[2])


def times(a: Rate, b: Rate) -> Rate:
    """Return the product of two strain rates, both numbers or both matrices."""
    return a @ b if a.ndim else a * b


def exponential(a: Rate) -> Rate:
    """Return exp(a) for norms of a up to 0.5. It is exactly one for a = 0."""
    return unit(a) + times(a, growth(a))


def unit(a: Rate) -> Rate:
    """Return 1, or the unit matrix if the strain rate is a matrix."""
    return jnp.eye(3) if a.ndim else jnp.ones(())


def trace(a: Rate) -> Number:
    """Return the trace. A number stands for a multiple of the unit matrix."""
    return jnp.trace(a) if a.ndim else 3 * a


def matrix(a: Rate) -> Float[Array, "3 3"]:
    """Return a strain rate as a matrix of shape (3, 3)."""
    return a if a.ndim else a * jnp.eye(3)


def acted(x: Vector, a: Rate, *, fused: bool = False) -> Vector:
    """Return the product of vectors (rows) and a strain rate, in float64.

    Args:
        fused: True to write the product as sums, which XLA fuses with other operations. Fusion is faster
            unless the vectors are expensive to compute, since each row of the result computes them again.
    """
    x = x.astype(jnp.float64)
    if a.ndim == 0:
        return x * a
    return a[0, :, None] * x[0] + a[1, :, None] * x[1] + a[2, :, None] * x[2] if fused else transformed(x, a)


class Barostat(Integrator):
    """Base class of barostats, with the options common to all barostats.

    Attributes:
        kT: energy. pressure: energy/length³. relaxation, pressure_relaxation: internal time.
    """

    kT: Float[Array, ""] = quantity("temperature")
    pressure: Float[Array, ""] = quantity("pressure")
    relaxation: Float[Array, ""] = quantity("time")
    pressure_relaxation: Float[Array, ""] = quantity("time")
    boxes: ClassVar[tuple[str, str]] = ("isotropic", "full")

    @property
    @abstractmethod
    def box(self) -> str:
        """Kind of box change, such as "isotropic" or "full"; an element of `boxes`."""

    @property
    def anisotropic(self):
        return self.box == "full"

    @property
    def keeps_angles(self):
        return self.box != "full"

    def check(self, cell):
        if self.box not in self.boxes:
            seen = f"box {self.box!r}; expected {' or '.join(map(repr, self.boxes))}"
            raise InputError(seen, where="dynamics.box")
        if not all(cell.pbc):
            axis = "abc"[cell.pbc.index(False)]
            message = f"{self.name} needs a box that is periodic along every axis, but {axis} is not periodic"
            raise InputError(message, where="dynamics.kind", remedy="Use nose-hoover, csvr or langevin")

    def motion(self, v: Vector, masses: Masses) -> Rate:
        """Return Σ m v ⊗ v (an energy). For an isotropic box, return a third of the trace."""
        if not self.anisotropic:
            return 2 * super().kinetic(v, masses) / 3
        v = v.astype(jnp.float64)
        return symmetric(products(v, masses * v))

    def excess(self, motion: Rate, at: AtStep) -> Rate:
        """Return Π - p V at the target pressure p. For an isotropic box, return the mean diagonal."""
        virial = at.tensor if self.anisotropic else at.virial / 3
        assert virial is not None
        return motion + 0.5 * (virial + virial.T) - self.pressure * volume(at.cell) * unit(motion)


def volume(cell: Cell) -> Number:
    """Return the volume of a box; for use inside jit."""
    a = cell.matrix
    if cell.orthorhombic:
        return jnp.abs(a[0, 0] * a[1, 1] * a[2, 2])
    return jnp.abs(a[0] @ jnp.cross(a[1], a[2]))


class BoxState(NamedTuple):
    """Extra state of `MTK`: strain rate, thermostat chains and initial volume."""

    rate: Rate  # of the box, one over time
    atoms: Chain  # thermostats of the atoms
    chain: Chain  # and of the box
    volume: Number  # of step 0


class MTK(Barostat):
    """Integrator for the isothermal-isobaric ensemble, deterministic and time-reversible.

    Martyna, Tobias, Klein, J. Chem. Phys. 101, 4177 (1994), with the operator splitting of Tuckerman et al.,
    J. Phys. A 39, 5629 (2006), eq. 38 ff. A step applies chains, kick of the box, kick of the atoms and
    drift, then the same operators in reverse order. The inertia of an isotropic box is (N_f + 3) k_B T τ_p²,
    that of a full box a third of this. An isotropic box has one degree of freedom, a full box six. The drift
    is exact for a constant strain rate a: x(t) = x exp(a t) + v t exp(a t / 2) sinh(a t / 2) / (a t / 2).

    Example:
        >>> mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90, pressure=0.0,
        ...                  integrator="mtk", dynamics={"relaxation": 0.2, "pressure_relaxation": 2.0})

    Attributes:
        chain: number of links of each chain. box: "isotropic" or "full".
    """

    name = "mtk"
    chain: int = eqx.field(static=True, default=3)
    box: str = eqx.field(static=True, default="isotropic")

    def init(self, x, v, masses):
        still = jnp.zeros((3, 3) if self.anisotropic else ())
        return BoxState(still, Chain.at_rest(self.chain), Chain.at_rest(self.chain), jnp.zeros(()))

    def kinetic(self, v, masses):
        if not self.anisotropic:
            return super().kinetic(v, masses)
        # the same sums as in `begin`, which XLA computes once
        return 0.5 * jnp.trace(self.motion(v, masses))

    def inertia(self, masses):
        """Inertia of the box, in units of energy times time²."""
        share = 3 if self.anisotropic else 1
        return (self.freedom(masses) + 3) / share * self.kT * self.pressure_relaxation**2

    def _held(self, v, motion, extra, masses, time):
        """Advance the thermostat chains of box and atoms. Scale the velocities and the kinetic tensor."""
        freedom, kT = self.freedom(masses), self.kT
        own, of_box = self._own(extra, masses)
        scale, atoms = extra.atoms.act(0.5 * trace(motion), freedom, kT, self.relaxation, time)
        slowed, chain = extra.chain.act(own, of_box, kT, self.pressure_relaxation, time)
        v = acted(v, scale).astype(v.dtype)
        return v, motion * scale**2, extra._replace(rate=extra.rate * slowed, atoms=atoms, chain=chain)

    def _own(self, extra, masses):
        """Return kinetic energy and degrees of freedom of the box."""
        return 0.5 * self.inertia(masses) * jnp.sum(jnp.square(extra.rate)), 6 if self.anisotropic else 1

    def _pushed(self, motion, extra, at, time):
        """Return the state after pressure and kinetic energy acted on the box for a time."""
        heat = trace(motion) / self.freedom(at.masses)
        push = self.excess(motion, at) + heat * unit(extra.rate)
        # of an isotropic box the three directions together
        share = 1 if self.anisotropic else 3
        return extra._replace(rate=extra.rate + time * share * push / self.inertia(at.masses))

    def _kicked(self, v, extra, at, time):
        """Return velocities after the forces and the strain rate have acted."""
        rate = extra.rate
        slow = -time * (rate + trace(rate) / self.freedom(at.masses) * unit(rate))
        kick = acted(at.acceleration, time * growth(slow), fused=True)
        return (acted(v, exponential(slow), fused=True) + kick).astype(v.dtype)

    def finish(self, v, extra, at, time):
        time = time.astype(jnp.float64)
        first = jnp.where(at.step == 0, volume(at.cell), extra.volume)
        extra = extra._replace(volume=first)
        v = self._kicked(v, extra, at, time)
        motion = self.motion(v, at.masses)
        v, _, extra = self._held(v, motion, self._pushed(motion, extra, at, time), at.masses, time)
        return v, extra

    def begin(self, x, v, extra, at):
        half = 0.5 * self.timestep
        v, motion, extra = self._held(v, self.motion(v, at.masses), extra, at.masses, half)
        extra = self._pushed(motion, extra, at, half)
        v = self._kicked(v, extra, at, half)
        # the box still has to grow, with all that is in it
        way = self.timestep * growth(-self.timestep * extra.rate)
        return x + acted(v, way, fused=True), v, extra, jnp.zeros(())

    def deform(self, v, extra, at):
        return matrix(exponential(self.timestep * extra.rate)), v, extra

    def exchanged(self, extra, at):
        freedom, kT = self.freedom(at.masses), self.kT
        own, of_box = self._own(extra, at.masses)
        heat = extra.atoms.energy(freedom, kT, self.relaxation)
        heat += extra.chain.energy(of_box, kT, self.pressure_relaxation)
        return -heat, -own - self.pressure * (volume(at.cell) - extra.volume)


class Move(NamedTuple):
    """Extra state of `CellRescaling`: the last box change and the work."""

    strain: Rate  # logarithm of the deformation
    # root: of the volume before; step: of that root; force: on it, and excess: along the other directions,
    # there
    root: Number
    step: Number
    force: Number
    excess: Rate
    work: Number  # energy given to the atoms so far


class CellRescaling(Barostat):
    """Integrator for the isothermal-isobaric ensemble: first-order stochastic cell rescaling with CSVR.

    In the middle of the drift, an Euler step changes the square root of the volume. The noise of the square
    root does not depend on the volume. Velocities are scaled inversely to the box (Bernetti, Bussi, J. Chem.
    Phys. 153, 114107, 2020, section II C). In a full box, the traceless strain also changes (del Tatto,
    Raiteri, Bernetti, Bussi, Applied Sciences 12, 1139, 2022). The noise of the strain uses the geometric
    mean of old and new volume. Step probabilities give an effective energy, the total energy minus heat and
    work. The effective energy is conserved within the time-step error.

    Example:
        >>> mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90, pressure=0.0,
        ...                  integrator="cell-rescaling", dynamics={
        ...                      "relaxation": 0.1, "pressure_relaxation": 1.0, "compressibility": 2.0})

    Attributes:
        compressibility: length³/energy; its ratio to pressure_relaxation determines how fast the box changes,
            but not the ensemble. key: random key. box: "isotropic" or "full".
    """

    name = "cell-rescaling"
    compressibility: Float[Array, ""] = quantity("compressibility")
    key: Array = quantity("seed")
    box: str = eqx.field(static=True, default="isotropic")

    def init(self, x, v, masses):
        none, no = jnp.zeros(()), jnp.zeros((3, 3) if self.anisotropic else ())
        return Move(no, jnp.ones(()), none, none, no, none)

    @property
    def noise_belongs_to(self):
        return ("axes",) if self.anisotropic else ()

    @property
    def _mobility(self):
        """Return the mobility of the square root of the volume, √V."""
        return self.compressibility / (4 * self.pressure_relaxation)

    def _forces(self, v, at):
        """Return √V, the force on √V, and the traceless excess pressure tensor.

        The force is k_B T d ln P / d√V for the probability density P ~ √V exp(-(U + K + p V) / k_B T).
        """
        root, excess = jnp.sqrt(volume(at.cell)), self.excess(self.motion(v, at.masses), at)
        part = trace(excess) / 3
        return root, (2 * part + self.kT) / root, excess - part * unit(excess)

    def _shear(self, root, after):
        """Return the mobility of a traceless strain. The mobility is symmetric in old and new √V."""
        return 4 / 3 * self._mobility / (root * after)

    def finish(self, v, extra, at, time):
        (root, force, excess), step = self._forces(v, at), extra.step
        # k_B T ln of the probability of the move over that of its reverse, and of the volumes
        spent = self.pressure * (root**2 - extra.root**2) - self.kT * jnp.log(root / extra.root)
        spent += 0.5 * step * (force + extra.force) + 0.5 * jnp.sum(extra.strain * (excess + extra.excess))
        spent += self.timestep / 4 * self._mobility * (force**2 - extra.force**2)
        squares = jnp.sum(jnp.square(excess)) - jnp.sum(jnp.square(extra.excess))
        spent += self.timestep / 4 * self._shear(root, extra.root) * squares
        work = extra.work - jnp.where(at.step == 0, 0.0, spent)
        return v + time * at.acceleration, extra._replace(work=work)

    def begin(self, x, v, extra, at):
        kinetic, time = self.kinetic(v, at.masses), self.timestep
        for_atoms, for_volume, for_shape = jax.random.split(jax.random.fold_in(self.key, at.step), 3)
        scale = rescaled(for_atoms, kinetic, self.freedom(at.masses), self.kT, self.relaxation, time)
        v = acted(v, scale).astype(v.dtype)
        heat = self.kinetic(v, at.masses) - kinetic
        v = v + (0.5 * time).astype(v.dtype) * at.acceleration
        root, force, excess = self._forces(v, at)
        spread = jnp.sqrt(2 * self._mobility * self.kT * time)
        step = self._mobility * time * force + spread * jax.random.normal(for_volume, (), jnp.float64)
        strain = 2 / 3 * jnp.log1p(step / root) * unit(excess)
        if self.anisotropic:
            mobility = self._shear(root, root + step)
            noise = jax.random.normal(for_shape, (3, 3), jnp.float64)
            noise = 0.5 * (noise + noise.T) - jnp.trace(noise) / 3 * jnp.eye(3)
            strain += mobility * time * excess + jnp.sqrt(2 * mobility * self.kT * time) * noise
        # half of the drift before the box grows, half after it, all before it as `deform` has it
        slowed = exponential(-strain)
        x = x + acted(v, 0.5 * time * (unit(strain) + times(slowed, slowed)))
        v = acted(v, slowed).astype(v.dtype)
        return x, v, Move(strain, root, step, force, excess, extra.work), heat

    def deform(self, v, extra, at):
        return matrix(exponential(extra.strain)), v, extra

    def exchanged(self, extra, at):
        return 0.0, extra.work
