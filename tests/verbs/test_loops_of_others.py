"""Loops of programs that an environment of the nightly has: OpenMM recorded state by state."""

from __future__ import annotations

import os

import numpy as np
import pytest

import mdnum
from mdnum.errors import InputError

NEEDED = os.environ.get("MDNUM_TEST_PEERS") == "on"


def states(steps: int):
    """A crystal of argon in OpenMM, a state for each step; positions in nm, velocities in nm/ps."""
    openmm = __import__("openmm") if NEEDED else pytest.importorskip("openmm")
    corners = np.stack(np.meshgrid(*[np.arange(4)] * 3), -1).reshape(-1, 1, 3)
    sites = np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    x = 0.5406 * (corners + sites).reshape(-1, 3)
    system, force = openmm.System(), openmm.NonbondedForce()
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.85)
    for _ in x:
        system.addParticle(39.948)
        force.addParticle(0, 0.3405, 0.996)
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(4 * 0.5406 * np.eye(3)).tolist())
    integrator = openmm.VerletIntegrator(0.004)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    context.setVelocitiesToTemperature(90, 1)
    for _ in range(steps):
        yield context.getState(positions=True, velocities=True, energy=True)
        integrator.step(1)


@pytest.mark.nightly
def test_openmm_is_recorded_and_its_energy_steps_with_flips(tmp_path):
    from openmm import unit

    with mdnum.Recorder(0.85, length="nm", timestep=0.004, out=tmp_path / "r", report=False) as one:
        kept = []
        for step, state in enumerate(states(40)):
            x, cell = state.getPositions(asNumpy=True), state.getPeriodicBoxVectors(asNumpy=True)
            v = state.getVelocities(asNumpy=True)
            numbers = [each.value_in_unit_system(unit.md_unit_system) for each in (x, cell, v)]
            energy = (state.getPotentialEnergy() + state.getKineticEnergy()).value_in_unit(
                unit.kilojoule_per_mole
            )
            one.see(step, *numbers[:2], velocities=numbers[2], energy=energy)
            kept.append(numbers)
        for x, energy in (
            (state.getPositions(asNumpy=True), 1.0),
            (numbers[0], 1.0 * unit.kilojoule_per_mole),
        ):
            with pytest.raises(InputError, match="nm"):
                one.see(99, x, numbers[1], energy=energy)
    done, side = one.outcome, kept[0][1][0, 0]
    inside = []
    for x, *_ in kept:
        d = x[:, None] - x
        r = np.sqrt(((d - side * np.rint(d / side)) ** 2).sum(-1))
        inside.append(int((r < 0.85).sum() - len(x)) // 2)
    assert done.table("frames")["pairs"].to_pylist() == inside and len(set(inside)) > 10
    # u(r_cut) without a shift, by reaction field for no charge
    jump = 4 * 0.996 * ((0.3405 / 0.85) ** 12 - (0.3405 / 0.85) ** 6)
    energy = done.summary["energy"]
    assert abs(energy["slope"] - jump) < 5 * energy["error"] + 1e-3 * abs(jump)
    assert "VELOCITIES_ODD" not in {each.code for each in done.findings}
