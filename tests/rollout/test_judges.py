"""Thermostats and barostats beside closed forms and Monte Carlo, and the errors that these find.

Judges and their figures: docs/constant-pressure.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import all_pairs_steps
import ensembles
import jax
import jax.numpy as jnp
import numpy as np
import planted_ensembles as planted
import pytest
from all_pairs_steps import lennard_jones, trajectory
from ase.build import bulk
from ensembles import settled
from planted_ensembles import DialedMTK, DialedRescaling

from mdnum.md.barostats import MTK, CellRescaling
from mdnum.md.thermostats import CSVR, NoseHooverChain

KT, ATOMS = 1.0, 32
#: The gas, and the liquid: cut off at 1.35 σ so that it fits into the box of 32 atoms.
GAS = {"pressure": 0.5, "timestep": 0.01, "relaxation": 0.1, "pressure_relaxation": 0.2}
R_CUT = 1.35
LIQUID = {"pressure": 3.0, "timestep": 0.004, "relaxation": 0.1, "pressure_relaxation": 0.4}
#: Of 400,000 sweeps of `ensembles.monte_carlo`: the liquid's volume, its variance and potential energy, with
#: standard errors; a nightly test makes them again.
MONTE_CARLO: dict[str, tuple[float, float]] = {}


def made(kind: type, numbers: dict[str, float], **own: Any) -> Any:
    """An integrator of numbers in reduced units, at the temperature of this file."""
    given = numbers | {"kT": KT} | own
    if issubclass(kind, CellRescaling):
        given["compressibility"] = {0.5: 2.0, 3.0: 0.1}.get(given["pressure"], 0.02)
    names = {field.name: field.name for field in kind.keys().values()}
    arrays = {name: jnp.float64(given[name]) for name in names if name not in ("key", "chain", "box")}
    if "key" in names:
        arrays["key"] = jax.random.key(7)
    return kind(**arrays, **{name: own[name] for name in ("dials", "start", "box") if name in own})


def dialed(kind: type, numbers: dict[str, float], edge: float, **wrong: float) -> Any:
    """A barostat with dials: those given are wrong, the others right."""
    dials = planted.MTK_DIALS if kind is DialedMTK else planted.RESCALING_DIALS
    values = {name: jnp.float64(value) for name, value in (dials | wrong).items()}
    return made(kind, numbers, dials=values, start=edge * jnp.eye(3))


def liquid(density: float = 0.7):
    return bulk("Ar", "fcc", a=(4 / density) ** (1 / 3), cubic=True) * (2, 2, 2)


def gas_judged(integrator: Any, steps: int = 6000) -> dict[str, bool]:
    """Which judges an ideal gas passes."""
    x = 4 * np.random.default_rng(0).random((ATOMS, 3))
    rows = trajectory(integrator, x, 4 * np.eye(3), kT=KT, steps=steps)
    kept = {name: settled(rows[name]) for name in ("volume", "kinetic", "pressure")}
    judgments = {
        **ensembles.ideal_volume(kept["volume"], KT, GAS["pressure"], ATOMS),
        **ensembles.kinetic_energy(kept["kinetic"], KT, 3 * ATOMS - 3),
        "pressure": ensembles.mean_pressure(kept["pressure"], GAS["pressure"]),
    }
    passed = {name: one.passes for name, one in judgments.items()}
    return passed | {"conserved": ensembles.conserves(rows["conserved"], rows["kinetic"])}
