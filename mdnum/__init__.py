"""Molecular dynamics with a cutoff: crossings of the cutoff, runs that diverge, and gradients.

Create a simulation from Python objects or from a system file:

    >>> argon = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235)
    >>> sim = mdnum.simulation(atoms, argon, mdnum.Cut("switched", 8.5), timestep=0.002)
    >>> sim = mdnum.build("argon/liquid-864")
    >>> sim = mdnum.changed(sim, {"cutoff.radius": 8.0})

A function takes a simulation or a system file, and writes its results to a folder:

    run                 simulate, record every flip, compare with ASE
    fork, fork_...      compare two runs that differ in one choice; maps, certificates, forecasts
    grad                differentiate a loss of a run in several ways, and judge the derivatives
    sweep               which choices affect which results, and the cheapest sufficient setting
    check               compare energies, pairs or a trajectory with other codes
    flips               contacts and flips of any program's trajectory
    audit_calculator    test whether an ASE calculator is smooth, invariant and conservative
    conform             test whether a neighbor list finds every pair
    bounce, demonstrate runs and demonstrations of a bouncing ball

The package provides `Simulation` and its `parameters`, pair potentials (`LennardJones`, `Morse`,
`SoftSphere`, and `PairFunction` for user functions), `energy_function` for other energy functions, cutoffs
(`Cut`), sums of potentials (`Term`), integrators (`VelocityVerlet`, `Langevin`, and `KickDrift` and
`Integrator` for new ones), `PrecisionPolicy`, gradients (`Problem`, `value_and_grad`, `method`) and
`MdnumCalculator` for ASE.

Names are imported on first use (PEP 562), because the import of jax and jax_md takes seconds.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use
from mdnum.version import __version__ as __version__

# a library prints nothing of its log; who wants it adds a handler
logging.getLogger(__name__).addHandler(logging.NullHandler())

if TYPE_CHECKING:
    # submodules that docs/python.md names, first
    from mdnum import ball as ball
    from mdnum import cli as cli
    from mdnum import errors as errors
    from mdnum import forks as forks
    from mdnum import gradients as gradients
    from mdnum import md as md
    from mdnum import numerics as numerics
    from mdnum import references as references
    from mdnum import report as report
    from mdnum import rollout as rollout
    from mdnum import store as store
    from mdnum import systems as systems
    from mdnum import trajectories as trajectories
    from mdnum import units as units
    from mdnum.doctor import diagnose as diagnose
    from mdnum.errors import CapacityError as CapacityError
    from mdnum.errors import FolderError as FolderError
    from mdnum.errors import InputError as InputError
    from mdnum.errors import MdnumError as MdnumError
    from mdnum.errors import NumericalError as NumericalError
    from mdnum.gradients import Problem as Problem
    from mdnum.gradients import method as method
    from mdnum.gradients import value_and_grad as value_and_grad
    from mdnum.md.energies import energy_function as energy_function
    from mdnum.md.integrators import Integrator as Integrator
    from mdnum.md.integrators import KickDrift as KickDrift
    from mdnum.md.integrators import Langevin as Langevin
    from mdnum.md.integrators import VelocityVerlet as VelocityVerlet
    from mdnum.md.potentials import LennardJones as LennardJones
    from mdnum.md.potentials import Morse as Morse
    from mdnum.md.potentials import PairFunction as PairFunction
    from mdnum.md.potentials import PairPotential as PairPotential
    from mdnum.md.potentials import SoftSphere as SoftSphere
    from mdnum.numerics.roles import PrecisionPolicy as PrecisionPolicy
    from mdnum.references import MdnumCalculator as MdnumCalculator
    from mdnum.systems import build as build
    from mdnum.systems import load as load
    from mdnum.systems.code import allow_code as allow_code
    from mdnum.systems.construct import Cut as Cut
    from mdnum.systems.construct import Term as Term
    from mdnum.systems.construct import simulation as simulation
    from mdnum.systems.parameters import changed as changed
    from mdnum.systems.parameters import parameters as parameters
    from mdnum.systems.simulation import Simulation as Simulation
    from mdnum.verbs.audit import audit as _audit
    from mdnum.verbs.ball import bounce as bounce
    from mdnum.verbs.check import check as check
    from mdnum.verbs.conform import conform as conform
    from mdnum.verbs.demos import demonstrate as demonstrate
    from mdnum.verbs.flips import flips as flips
    from mdnum.verbs.flips import flips_each as flips_each
    from mdnum.verbs.fork import fork as fork
    from mdnum.verbs.fork import fork_benign as fork_benign
    from mdnum.verbs.fork import fork_folders as fork_folders
    from mdnum.verbs.fork import fork_screen as fork_screen
    from mdnum.verbs.fork_certify import fork_certify as fork_certify
    from mdnum.verbs.fork_certify import fork_processes as fork_processes
    from mdnum.verbs.fork_map import fork_forecast as fork_forecast
    from mdnum.verbs.fork_map import fork_map as fork_map
    from mdnum.verbs.frame import read as read
    from mdnum.verbs.grad import grad as grad
    from mdnum.verbs.outcome import Outcome as Outcome
    from mdnum.verbs.recorder import Recorder as Recorder
    from mdnum.verbs.run import run as run
    from mdnum.verbs.sweep import sweep as sweep

    audit_calculator = _audit

__getattr__, __dir__, __all__ = on_first_use(__name__, audit_calculator="mdnum.verbs.audit:audit")
__all__ += ["__version__"]
