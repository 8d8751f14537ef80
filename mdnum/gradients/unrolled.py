"""Reverse mode by JAX itself, through the program's own steps: plain, with states kept, with few of them.

This is what `jax.grad` of a rollout gives. Decisions are made by the program that is differentiated, and
where it rounds otherwise than the run did, that is reported.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mdnum.errors import InputError
from mdnum.gradients import memory, parameters
from mdnum.gradients.base import Gradient, Problem, Progress, check, independent
from mdnum.gradients.checkpoints import keep_everything, keep_few, keep_states
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.primal import Fingerprints
from mdnum.gradients.program import Passed
from mdnum.gradients.steps import Leg, Steps
from mdnum.gradients.tape import Tape


@dataclass(frozen=True)
class _Reverse:
    """What the three ways share.

    Attributes:
        chunk: steps that are linearized together; None: up to 16, as memory has it.
        room: bytes that it may take; None: what is free.
        compare: whether to make the run as well and report where this program departs from it.
    """

    chunk: int | None = None
    room: int | None = None
    compare: bool = True

    @property
    @abstractmethod
    def name(self) -> str:
        """Its word."""

    @property
    @abstractmethod
    def how(self) -> str:
        """What it keeps."""

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return f"the derivative of the steps that ran, by JAX, in its own forward pass; {self.how}"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Not for forces that are rounded after every operation, and not beyond the memory there is."""
        if problem.simulation.lattice is not None:
            return "a state in whole numbers has no derivative; the method reversible serves it"
        if problem.simulation.policy.dtype("force").itemsize < 4:
            return f"forces in {problem.simulation.policy.force} are rounded after every operation"
        return memory.why_not(Steps(problem, self.chunk), self.name, self.room)

    @abstractmethod
    def _differentiate(self, program: Steps, watch, told) -> tuple[float, Cotangents, dict[str, Any]]:
        """The loss, its derivatives, and what is worth telling."""

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; where its primal departs is in the details."""
        names = check(self, problem, names)
        simulation = problem.simulation
        program = Steps(problem, self.chunk)
        own = Fingerprints(problem.steps)

        def watch(leg: Leg, passed: Passed, tables) -> None:
            if self.compare:
                own.add(leg.first, leg.rows, passed.x, passed.v, passed.bits, tables)

        def told(step: int, steps: int, phase: str) -> None:
            if progress is not None:
                progress(step, steps, phase)

        value, parts, details = self._differentiate(program, watch, told)
        details = {"steps linearized together": program.chunk, **details}
        gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
        notes = independent(problem, gradient, saltation=False)
        if self.compare:
            run = Fingerprints(problem.steps)
            tape = Tape(
                simulation,
                problem.loss,
                problem.steps,
                budget=0,
                each=lambda stretch: run.add_stretch(stretch, simulation.tables(stretch.table)),
            )
            departure = run.departure(own)
            details["primal"] = {
                **departure.to_dict(),
                "value of the run": tape.value,
                "says": str(departure),
            }
        return Gradient(self.name, self.says, value, gradient, notes, details)


@dataclass(frozen=True)
class Unrolled(_Reverse):
    """Plain reverse mode: what every operation of every step needs on the way back is kept."""

    @property
    def name(self) -> str:
        """Its word."""
        return "unrolled"

    @property
    def how(self) -> str:
        """What it keeps."""
        return "every intermediate result is kept"

    def _differentiate(self, program: Steps, watch, told):
        held, limit = 0, memory.free() if self.room is None else self.room

        def room(kept: int, steps: int) -> None:
            nonlocal held
            held = kept
            if kept > limit:
                # its lists are shorter than chunks, which the estimate before the run cannot know
                raise InputError(
                    f"{steps} of {program.problem.steps} steps take {memory.in_words(kept)}, and there were "
                    f"{memory.in_words(limit)}",
                    remedy="Use the method symmetric, epochs or recursive, or fewer steps",
                )

        value, parts = keep_everything(program, watch, told, room)
        return value, parts, {"bytes kept": held}


@dataclass(frozen=True)
class Epochs(_Reverse):
    """Reverse mode with `jax.checkpoint` at the epochs: states are kept, and steps are made twice."""

    @property
    def name(self) -> str:
        """Its word."""
        return "epochs"

    @property
    def how(self) -> str:
        """What it keeps."""
        return "the state at each epoch and every few steps is kept, and the steps between are made again"

    def _differentiate(self, program: Steps, watch, told):
        value, parts = keep_states(program, watch, told)
        return value, parts, {}


@dataclass(frozen=True)
class Recursive(_Reverse):
    """Reverse mode with a number of states that grows with the logarithm of the steps.

    Attributes:
        snapshots: states that are kept; None: about the logarithm of the number of chunks.
    """

    snapshots: int | None = None

    @property
    def name(self) -> str:
        """Its word."""
        return "recursive"

    @property
    def how(self) -> str:
        """What it keeps."""
        return "a few states are kept, in number the logarithm of the steps, and the rest is run again"

    def _differentiate(self, program: Steps, watch, told):
        value, parts, made = keep_few(program, watch, told, self.snapshots)
        return value, parts, {"chunks run": made}
