"""A short run at constant energy: how much of its energy drifts away, and to what it is due."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import Part, Progress, Subject, meter_of
from mdnum.audit.crossings import crossings
from mdnum.audit.dynamics_words import part
from mdnum.audit.energy_ledger import Result, balance, by_means, crossing_rows, energy_rows
from mdnum.audit.jumps import SMOOTH
from mdnum.audit.noise import FEW, Noise, along_a_line, roomy
from mdnum.audit.nve import Run, at, fitting_timestep, prepared, run
from mdnum.audit.rigid import rigid
from mdnum.audit.subject import CalculatorError, only_trying
from mdnum.audit.threshold import Threshold
from mdnum.references.findings import finding

#: Of a run where nobody says how many. A step takes some six calls: two in the run of half the time step,
#: warming up, work on the way.
_STEPS = 200
_COMPARED = 12


@dataclass
class Dynamics:
    """Drift of the energy with a block error, separated into integrator, flips and the rest.

    The energy of every step is accounted for: ΔU plus the work that the forces do on the straight way
    between two steps vanishes for a force that has this energy, whatever the integrator does. At a threshold
    it is the jump of a flip; anywhere else it is a force that is not the energy's derivative, or an answer
    that depends on what was asked before. What is left of the drift is the integrator's, and must fall to a
    quarter with half the time step, which a second run tests.

    Args:
        thresholds: finds where flips happen; see `mdnum.audit.thresholds.find_thresholds`.
        timestep: internal time; a fraction of the fastest vibration if None.
        steps: of the run; 200 if None.
        seed: of the velocities.
    """

    thresholds: Callable[[Subject], Sequence[Threshold]] | None = None
    timestep: float | None = None
    steps: int | None = None
    seed: int = 0
    name: str = "dynamics"
    recorded: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        with meter_of(subject).limited():
            return self._asked(subject, progress)

    def _asked(self, subject: Subject, progress: Progress | None) -> Part:
        began = time.perf_counter()
        told = progress or (lambda done, total, info: None)
        rng = np.random.default_rng(self.seed)
        limits, unknown = self._limits(subject)
        atoms = roomy(subject.atoms, FEW)
        held = rigid(atoms) if _only_molecules(subject) else None
        worker = subject.fresh()
        fitting, period = fitting_timestep(worker, atoms, rng)
        start = prepared(worker, atoms, held, period, rng)
        step = self.timestep if self.timestep is not None else fitting
        if not np.isfinite(step):
            return _nothing_moves(self.name, began)
        count = self.steps or _STEPS
        total = 3 * count + count // 4

        def each(before: int) -> Callable[[int], None]:
            return lambda at_step: told(before + at_step, total, {"phase": "dynamics", "unit": "steps"})

        # from where it was given, a structure relaxes; that is no drift
        _, start = run(worker, start, step, count // 4, each(0))
        whole, _ = run(subject.fresh(), start, step, count, each(count // 4))
        if whole.blown_up:
            return _blew_up(self.name, whole, step, subject, began)
        half, _ = run(subject.fresh(), start, step / 2, 2 * count, each(count + count // 4))
        probe = subject.fresh()
        noise = along_a_line(probe, at(start, start.positions), rng)
        told(0, 0, {"phase": "accounting for the energy"})
        ledger = balance(probe, whole, start, limits, rng, noise.energy)
        # the other run's flips count only where they bring energy
        finer = crossings(half, start, limits) if any(one.order == 0 for one in limits) else []
        stale = _stale(subject, whole, start, noise)
        result = Result(
            subject, whole, half, ledger, by_means(finer, ledger, len(half.potential)), limits, stale, noise
        )
        self.recorded = {"energies": energy_rows(result), "crossings": crossing_rows(result)}
        return part(result, self.name, period, time.perf_counter() - began, unknown)

    def _limits(self, subject: Subject) -> tuple[list[Threshold], str]:
        """Thresholds, or why none are known."""
        if self.thresholds is None:
            return [], "no thresholds were looked for"
        try:
            # one at which no more than a third derivative jumps leaves no trace in a run
            found = [one for one in self.thresholds(subject) if one.order < SMOOTH or one.dies]
        except CalculatorError as error:
            return [], f"looking for thresholds, the calculator {error.message}"
        return found, "" if found else "no threshold was found"


def _only_molecules(subject: Subject) -> bool:
    """Whether the calculator takes whole molecules alone, whose inner distances it does not know."""
    if rigid(subject.atoms) is None:
        return False
    try:
        with only_trying(subject):
            subject.fresh().energy(
                Atoms(str(subject.atoms.symbols[0]), [(0, 0, 0)], cell=[50.0] * 3, pbc=True)
            )
    except CalculatorError:
        return True
    return False


def _stale(subject: Subject, whole: Run, like: Atoms, noise: Noise) -> tuple[float, float]:
    """Largest difference of the run's energies from those of objects that saw nothing else, and its limit."""
    places = np.unique(np.linspace(0, len(whole.potential) - 1, _COMPARED).astype(int))
    found = [
        abs(subject.fresh().energy(at(like, whole.positions[place])) - whole.potential[place])
        for place in places
    ]
    return float(max(found)), 40 * max(
        noise.energy, np.finfo(float).eps * float(np.max(np.abs(whole.potential)))
    )


def _nothing_moves(name: str, began: float) -> Part:
    why = "no force and no thermal motion: there is nothing to integrate"
    return Part(
        name,
        "Dynamics",
        why.capitalize() + ".",
        skipped=[("a run", why)],
        seconds=time.perf_counter() - began,
    )


def _blew_up(name: str, whole: Run, step: float, subject: Subject, began: float) -> Part:
    units = getattr(subject, "units", None)
    factor, unit = (units.time_factor, units.time) if units is not None else (98.22694788464064, "ps")
    after = len(whole.potential) - 1
    return Part(
        name,
        "Dynamics",
        f"The run flew apart after {after} steps.",
        findings=[
            finding(
                "BLEW_UP",
                "error",
                "a run at constant energy flies apart",
                f"After {after} steps of {step / factor:.3g} {unit} the kinetic energy had grown a "
                "thousandfold.",
                "Look at the other findings first; then try a shorter time step (--timestep) and a "
                "structure that "
                "is relaxed.",
            )
        ],
        numbers={"steps": after, "blew_up": True, "drift": None},
        seconds=time.perf_counter() - began,
    )
