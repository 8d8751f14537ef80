"""Reverse mode without a stored trajectory: a run in whole numbers is taken back, step by step.

The forward pass keeps its last state. The reverse pass undoes the steps, with lists that it builds itself,
and linearizes at the states that come by; they are those of the run, bit for bit, and the run's first state
must come out in the end. Roundings to whole numbers count as the identity.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.errors import NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.adjoint import reverse
from mdnum.gradients.base import Gradient, Problem, Progress, check, independent
from mdnum.gradients.losses import Loss
from mdnum.gradients.symmetric import in_phase, pairs_only, wanted
from mdnum.gradients.tape import Stretch, Tape, frame_of_start, pace_of, stretch_of, surroundings
from mdnum.md.latticestep import LatticeLangevin, forgotten_bits
from mdnum.rollout.backward import BackwardRun, Stretched
from mdnum.rollout.engine import FAILURES, Engine, Segment, State, first_state
from mdnum.systems.build import Simulation

# states of which the run remembers a fingerprint, so that a way back that goes astray is told where it did
_FINGERPRINTS = 256


class ReversibleTape(Tape):
    """A run on a lattice that has been made and is not kept, and its loss.

    Attributes:
        baths: what a thermostat's friction forgot, by step: the one thing that grows with the run.

    Args:
        simulation: the system as objects, on a lattice. loss: what is evaluated along the way.
        steps: last step. flips: whether the way back is to find the flips.
        progress: called with the step reached and the last step.

    Raises:
        InputError: the state is not in whole numbers. NumericalError: the run blew up.
    """

    def __init__(
        self,
        simulation: Simulation,
        loss: Loss,
        steps: int,
        *,
        flips: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ):
        self.simulation, self.loss, self.steps = simulation, loss, steps
        self.start = first_state(simulation)
        self.around = surroundings(simulation)
        self.pace = pace_of(loss, steps)
        self.origin = frame_of_start(self.start, simulation)
        self.flips = flips
        self.total: Any = None
        self.frames = 0
        self.held = 0
        self.baths: dict[int, np.ndarray] = {}
        self.stretches = 0
        self._every = max(1, steps // _FINGERPRINTS)
        self._prints: dict[int, bytes] = {}
        self._end: State = self.start.state
        start = self.start
        for segment in Engine(simulation, steps, start=start).segments():
            if segment.closes in FAILURES:
                raise NumericalError(
                    f"the run ended in a {segment.closes} at step {segment.last}",
                    remedy="Use a smaller time step, or a start without overlapping atoms",
                )
            self._look(segment)
            self._end = segment.state
            if progress is not None:
                progress(segment.last, steps)
        self.value = float(self.loss.value(self.total, self.frames))

    def _look(self, segment: Segment) -> None:
        """What is needed of some steps: the loss, fingerprints, and a bath that is then put aside."""
        steps = np.arange(segment.first, segment.last + 1)
        if self.total is None or self.loss.looks_at(steps, self.steps).any():
            self._observe(stretch_of(segment, self.start))
        x, v, images = (segment.rows_of(name) for name in ("x", "v", "images"))
        for row in np.flatnonzero(steps % self._every == 0):
            self._prints[int(steps[row])] = fingerprint(x[row], v[row], images[row], segment.table.order)
        state, scheme = segment.state, self.simulation.propagator
        if isinstance(scheme, LatticeLangevin) and int(state.step) % int(scheme.period) == 0:
            self.baths[int(state.step)] = np.array(state.bath)

    @property
    def replayed(self) -> int:
        """No stretch is made again going forward."""
        return 0

    def __len__(self) -> int:
        return self.stretches

    @property
    def nbytes(self) -> int:
        """Memory that grows with the run: what friction forgot."""
        return sum(bath.nbytes for bath in self.baths.values())

    def forward(self) -> Iterator[Stretch]:
        """A run that is not kept is run again."""
        return Tape(self.simulation, self.loss, self.steps, flips=self.flips).forward()

    def backward(self) -> Iterator[Stretch]:
        """The stretches, last first, made by taking the run back.

        Raises:
            NumericalError: what comes out is not the run that was made; says at which step.
        """
        # the initial bath is empty
        baths = {**self.baths, 0: np.zeros((3, self.simulation.atoms), np.int64)}
        way = BackwardRun(self.simulation, self._end, baths)
        self.stretches = 0
        for made in way.stretches():
            self._compare(made)
            self.stretches += 1
            yield self._stretch(made)
        self._arrive(way)

    def _compare(self, made: Stretched) -> None:
        """Hold the states that came out against the fingerprints of the run."""
        for row in range(made.rows - 1, -1, -1):
            step = made.first + row
            if step % self._every:
                continue
            record = made.record
            here = fingerprint(record.x[row], record.v[row], record.images[row], made.table.order)
            if here != self._prints[step]:
                self._astray(step, min(step + self._every, self.steps))

    def _astray(self, step: int, last: int) -> None:
        where = f"at step {step}" if last - step <= 1 else f"between steps {step} and {last}"
        raise NumericalError(
            f"taken back, the run is not the one that was made: the way back went astray {where}",
            remedy="The run may have missed pairs: use a list that is rebuilt in time (neighbors.rebuild)",
            where=self.simulation.system.name,
        )

    def _arrive(self, way: BackwardRun) -> None:
        """The first state, every bit of it."""
        state, back = self.start.state, way.back
        pairs = ((state.x, back.x), (state.v, back.v), (state.images, back.images))
        if not all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs):
            self._astray(0, min(self._every, self.steps))

    def _stretch(self, made: Stretched) -> Stretch:
        record = made.record
        return Stretch(
            made.first,
            made.rows,
            np.asarray(record.x),
            np.asarray(record.v),
            np.asarray(record.images),
            np.asarray(record.bits),
            np.zeros_like(record.bits[0]),
            made.x_before,
            np.asarray(record.potential),
            np.asarray(record.virial),
            made.table,
            None,
        )


def fingerprint(x, v, images, order) -> bytes:
    """A short name of a state, in the user's order of atoms; a zero has no sign."""
    digest = hashlib.blake2b(digest_size=8)
    for part in (x, v, images):
        part = np.asarray(part)
        out = np.empty_like(part)
        out[:, order] = part
        digest.update((out + out.dtype.type(0)).tobytes())
    return digest.digest()


@dataclass(frozen=True)
class Reversible:
    """The derivative of the steps that ran, of a run in whole numbers that is taken back."""

    @property
    def name(self) -> str:
        """Its word."""
        return "reversible"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return (
            "the derivative of the steps that ran in whole numbers, taken back bit for bit; their decisions "
            "held fixed"
        )

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Pair potentials on a lattice only."""
        if problem.simulation.lattice is None:
            return 'only steps in whole numbers can be taken back (precision.state = "lattice")'
        return pairs_only(problem.simulation)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters.

        Raises:
            NumericalError: taken back, the run is not the one that was made.
        """
        names = check(self, problem, names)
        simulation = problem.simulation
        tape = ReversibleTape(simulation, problem.loss, problem.steps, progress=in_phase(progress, "run"))
        parts, _ = reverse(tape, wanted=wanted(names), progress=in_phase(progress, "reverse pass"))
        gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
        notes = independent(problem, gradient, saltation=False)
        assert simulation.lattice is not None
        details = {
            "stretches": tape.stretches,
            "lattice": simulation.lattice.to_dict(float(simulation.integrator.timestep)),
            "returned to the start": True,
            "bytes that grow with the run": tape.nbytes,
            "bits forgotten by friction a step": forgotten_bits(simulation.integrator),
        }
        return Gradient(self.name, self.says, tape.value, gradient, notes, details)
