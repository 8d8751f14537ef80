"""An integrator of one's own: a Nosé-Hoover thermostat, whose friction is carried from step to step."""

import ase.build
import jax.numpy as jnp

import mdnum
from mdnum.md.integrators import quantity


class NoseHoover(mdnum.Integrator):
    """A friction follows the kinetic energy, half a step before and half a step after the forces."""

    name = "one-link"
    kT: object = quantity("temperature")  # energy here; `temperature` to whoever makes one
    tau: object = quantity("time")  # in which the friction follows

    def init(self, x, v, masses):
        return jnp.zeros(2)  # the friction, and its integral over time

    def pull(self, v, masses):
        return (2 * self.kinetic(v, masses) / (self.freedom(masses) * self.kT) - 1) / self.tau**2

    def begin(self, x, v, extra, at):
        half = 0.5 * self.timestep
        friction, integral = extra
        friction = friction + half * self.pull(v, at.masses)
        v = v * jnp.exp(-half * friction) + half * at.acceleration
        return x + self.timestep * v, v, jnp.stack([friction, integral + half * friction]), jnp.zeros(())

    def finish(self, v, extra, at, time):
        friction, integral = extra
        v = (v + time * at.acceleration) * jnp.exp(-time * friction)
        return v, jnp.stack([friction + time * self.pull(v, at.masses), integral + time * friction])

    def exchanged(self, extra, at):
        friction, integral = extra  # heat, and work, which a box would do
        return -self.freedom(at.masses) * self.kT * (0.5 * (self.tau * friction) ** 2 + integral), 0.0


atoms = ase.build.bulk("Ar", "fcc", a=5.4, cubic=True).repeat(4)
simulation = mdnum.simulation(
    atoms, mdnum.LennardJones(3.405, 0.0103235), mdnum.Cut("switched", 8.5), timestep=0.004, temperature=60,
    integrator=NoseHoover, dynamics={"tau": 0.2}, name="argon-one-link",
)  # fmt: skip
run = mdnum.run(simulation, steps=500)
print("conserved energy drifts by", run.summary["energy_drift"], "eV per ps and atom")
