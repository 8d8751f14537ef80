"""ASE's dynamics observed: which pairs cross its cutoff, and does the energy step when they do?"""

import numpy as np
from ase.build import bulk
from ase.calculators.lj import LennardJones
from ase.md.velocitydistribution import MaxwellBoltzmannDistribution
from ase.md.verlet import VelocityVerlet
from ase.units import fs

import mdnum

R_CUT = 5.4

argon = bulk("Ar", "fcc", a=5.35, cubic=True).repeat(3)
argon.calc = LennardJones(sigma=3.405, epsilon=0.0103235, rc=R_CUT)
MaxwellBoltzmannDistribution(argon, temperature_K=60, rng=np.random.default_rng(0))
dynamics = VelocityVerlet(argon, timestep=4 * fs)

with mdnum.Recorder(R_CUT, atoms=argon, name="argon") as recorder:
    dynamics.attach(recorder, interval=1)
    dynamics.run(40)

outcome = recorder.outcome
print(outcome.verdict.headline)
print(outcome.table("flips").to_pandas()[["frame", "i", "j", "entered", "distance", "margin"]].head())
energy = outcome.summary["energy"]
print(f"the energy (eV) changes by {energy['slope']:.1e} ± {energy['error']:.1e} with each pair that enters")
