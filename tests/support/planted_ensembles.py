"""The barostats of mdnum with dials that put in one error each, of the kinds that were found in other codes.

Each dial is a number that a compiled program takes, so that all errors, and none, are the same program.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mdnum.md.barostats import MTK, CellRescaling, Move, acted, exponential, unit
from mdnum.md.thermostats import rescaled

#: Both barostats: what the pressure is made of.
_PRESSURE = {"kinetic": 1.0, "virial": 1.0, "stale": 0.0}
#: Dials of each, where nothing is wrong.
MTK_DIALS = _PRESSURE | {"freedom": 0.0, "correction": 1.0, "slowing": 1.0, "push": 1.0, "chain": 1.0}
RESCALING_DIALS = _PRESSURE | {"noise": 1.0, "drift": 0.0, "slowing": 1.0, "thermostat": 1.0}

#: Errors by name: the barostat's dials that make them.
WRONG: dict[str, tuple[type, Mapping[str, float]]] = {}


def _pressure(dials: Any, at: Any, start: Any) -> Any:
    """The step that the barostat sees."""
    matrix = jnp.where(dials["stale"] > 0, start, at.cell.matrix)
    return at._replace(virial=dials["virial"] * at.virial, cell=replace(at.cell, matrix=matrix))


class DialedMTK(MTK):
    """Martyna, Tobias and Klein's, isotropic.

    Dials: kinetic 2, the kinetic energy counts twice in the pressure; virial 0, it is missing, -1, it has the
    sign of a stress; stale 1, the pressure has the volume of the start; freedom 3, the thermostat counts the
    center of mass, which is at rest; correction 0, without the kinetic energy that they add (Hoover,
    Melchionna); slowing 0, velocities do not shrink as the box grows; push 2, the box moves as if half as
    heavy, and its energy is that of the whole inertia; chain 0, the energy of its thermostat is not counted.
    """

    dials: Any = eqx.field(kw_only=True)
    start: Any = eqx.field(kw_only=True)

    def freedom(self, masses):
        return super().freedom(masses) + self.dials["freedom"]

    def excess(self, motion, at):
        return super().excess(self.dials["kinetic"] * motion, _pressure(self.dials, at, self.start))

    def _pushed(self, motion, extra, at, time):
        heat = 3 * motion / self.freedom(at.masses)
        less = (1 - self.dials["correction"]) * time * 3 * heat / self.inertia(at.masses)
        pushed: Any = super()._pushed(motion, extra, at, self.dials["push"] * time)
        return pushed._replace(rate=pushed.rate - less)

    def _kicked(self, v, extra, at, time):
        return jnp.where(
            self.dials["slowing"] > 0, super()._kicked(v, extra, at, time), v + time * at.acceleration
        )

    def exchanged(self, extra, at):
        _, of_box = self._own(extra, at.masses)
        heat, work = super().exchanged(extra, at)
        taken = extra.chain.energy(of_box, self.kT, self.pressure_relaxation)
        return heat + (1 - self.dials["chain"]) * taken, work


class DialedRescaling(CellRescaling):
    """Stochastic cell rescaling, isotropic.

    Dials: kinetic, virial and stale as above; noise 0, the volume relaxes without noise (Berendsen); drift 1,
    without the drift of kT that comes with the noise; slowing 0, velocities do not shrink as the box grows;
    thermostat 0, the kinetic energy relaxes without noise.
    """

    dials: Any = eqx.field(kw_only=True)
    start: Any = eqx.field(kw_only=True)

    def excess(self, motion, at):
        return super().excess(self.dials["kinetic"] * motion, _pressure(self.dials, at, self.start))

    def begin(self, x, v, extra, at):
        """As that of `CellRescaling`, for a number, with the dials."""
        kinetic, time = self.kinetic(v, at.masses), self.timestep
        for_atoms, for_volume, _ = jax.random.split(jax.random.fold_in(self.key, at.step), 3)
        freedom = self.freedom(at.masses)
        right = rescaled(for_atoms, kinetic, freedom, self.kT, self.relaxation, time)
        weak = jnp.sqrt(1 + (0.5 * freedom * self.kT / kinetic - 1) * time / self.relaxation)
        v = v * jnp.where(self.dials["thermostat"] > 0, right, weak)
        heat = self.kinetic(v, at.masses) - kinetic
        v = v + 0.5 * time * at.acceleration
        root, force, excess = self._forces(v, at)
        # of a logarithm of the volume, whose noise depends on it, there is another drift
        driven = force - self.dials["drift"] * 2 * self.kT / root
        spread = self.dials["noise"] * jnp.sqrt(2 * self._mobility * self.kT * time)
        step = self._mobility * time * driven + spread * jax.random.normal(for_volume)
        strain = 2 / 3 * jnp.log1p(step / root) * unit(excess)
        slowed = exponential(-strain)
        x = x + acted(v, 0.5 * time * (1 + slowed * slowed))
        v = jnp.where(self.dials["slowing"] > 0, acted(v, slowed), v)
        return x, v, Move(strain, root, step, force, excess, extra.work), heat


WRONG |= {
    "kinetic energy twice, MTK": (DialedMTK, {"kinetic": 2.0}),
    "kinetic energy twice, rescaling": (DialedRescaling, {"kinetic": 2.0}),
    "kinetic energy missing": (DialedRescaling, {"kinetic": 0.0}),
    "stale box, MTK": (DialedMTK, {"stale": 1.0}),
    "stale box, rescaling": (DialedRescaling, {"stale": 1.0}),
    "3 N for 3 N - 3": (DialedMTK, {"freedom": 3.0}),
    "without MTK's correction": (DialedMTK, {"correction": 0.0}),
    "velocities not scaled, MTK": (DialedMTK, {"slowing": 0.0}),
    "velocities not scaled, rescaling": (DialedRescaling, {"slowing": 0.0}),
    "half the inertia": (DialedMTK, {"push": 2.0}),
    "thermostat of the box not counted": (DialedMTK, {"chain": 0.0}),
    "volume without noise": (DialedRescaling, {"noise": 0.0}),
    "drift of the noise missing": (DialedRescaling, {"drift": 1.0}),
    "temperature without noise": (DialedRescaling, {"thermostat": 0.0}),
}
#: Those that need forces.
WRONG_VIRIAL: dict[str, tuple[type, Mapping[str, float]]] = {
    f"{what}, {name}": (kind, {"virial": virial})
    for what, virial in (("no virial", 0.0), ("sign of a stress", -1.0))
    for name, kind in (("MTK", DialedMTK), ("rescaling", DialedRescaling))
}
