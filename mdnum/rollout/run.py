"""Simulation runs that write a run folder and can be resumed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np
from ase import Atoms
from ase.calculators.singlepoint import SinglePointCalculator
from ase.stress import full_3x3_to_voigt_6_stress

from mdnum import provenance, ranges
from mdnum.errors import FolderError, InputError, NumericalError
from mdnum.md import foreign
from mdnum.md.ledger import FlipTable
from mdnum.plain import result
from mdnum.rollout.engine import FAILURES, NARROW, Engine, Segment, Start, resume_point
from mdnum.rollout.flips import PairRecorder
from mdnum.rollout.pressure import PressureParts
from mdnum.rollout.summary import (
    EnergyBudget,
    ListHealth,
    RunTally,
    closest_pair,
    log_line,
    series_columns,
    summarize,
)
from mdnum.store import Layout, RunFolder
from mdnum.store.files import default_folder
from mdnum.systems.build import again, build
from mdnum.systems.evaluate import evaluate_listed
from mdnum.systems.load import System
from mdnum.systems.simulation import Simulation

Progress = Callable[[int, int, dict[str, Any]], None]
Shown = Callable[[Simulation, np.ndarray], None]

# the budget is checked this often; each check evaluates the whole system once more, which takes a large one
# as long as several steps: there the steps in between are at least as many as these
_BUDGET_CHECKS, _LARGE, _STEPS_OF_A_LARGE = 20, 10_000, 100
_LOG_LINES = 50
_LOG_HEADER = "    step       time      potential        kinetic          total  temperature     pairs  flips"
_SHORTER = "Use a shorter dynamics.timestep, relax the structure or lower the temperature"
# about the life of two lists: where frames are nearer, steps would be made twice for them too often
_FRAMES_APART = 25
# latest segments whose median is the speed of a run
_PACES = 99


@result
class RunResult:
    """Result of a run: folder, summary, simulation, and first and last frame."""

    folder: Path  # the run folder
    summary: dict[str, Any]  # the content of summary.json
    simulation: Simulation  # the system as objects
    frames: tuple[np.ndarray, np.ndarray]  # first and last positions, shape (atoms, 3) each, wrapped, length
    ended: Simulation  # the system in the box of the last of them


@dataclass
class _Progress:
    """Counts and sums of a run up to the current step, for checkpoints."""

    tally: RunTally
    health: ListHealth
    budget: EnergyBudget
    pressure: PressureParts
    first: np.ndarray | None = None
    last: Any = None  # shape (3, atoms), on the device until somebody asks

    def to_dict(self) -> dict[str, Any]:
        parts = {name: getattr(self, name).to_dict() for name in ("health", "budget")}
        return {"tally": asdict(self.tally), **parts, "pressure": self.pressure.samples}


@dataclass
class Rollout:
    """A simulation run in progress, which writes its results to a run folder.

    Attributes:
        simulation: the system as objects.
        folder: folder of the run.
        steps: last step.
        save_every: number of steps between trajectory frames; 0 for no frames.
        progress: called with step, steps and a dictionary of figures.
        began: time.perf_counter() at the start, for the measurement of the time to the first step.
        shown: called with the simulation in its box, and the first and the last positions, as soon as they
            are available.
        ended: the simulation in its box at the last step.
    """

    simulation: Simulation
    folder: RunFolder
    steps: int
    save_every: int
    progress: Progress | None = None
    began: float = field(default_factory=time.perf_counter)
    shown: Shown | None = None

    def __post_init__(self):
        self.ended = self.simulation
        self.recorder = PairRecorder(self.simulation)
        parts = ListHealth(self.simulation), EnergyBudget(self.simulation), PressureParts(self.simulation)
        self.done = _Progress(RunTally(), *parts)
        self.start: Start | None = None
        self._earlier_seconds = 0.0

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue the run from the state of a checkpoint."""
        self.start = Start.from_arrays(saved, self.simulation)
        done = saved["done"]
        self.done = _Progress(
            RunTally.from_dict(done["tally"]),
            ListHealth.from_dict(self.simulation, done["health"]),
            EnergyBudget.from_dict(self.simulation, done["budget"]),
            PressureParts(self.simulation, done.get("pressure", [])),
            saved.get("first"),
            saved["last"].T if "last" in saved else None,
        )
        self._earlier_seconds = self.done.tally.seconds
        self.recorder = PairRecorder(self.simulation, saved.get("held"))

    def run(self) -> dict[str, Any]:
        """Run to the last step, write all files, and return the summary. The report page is not written.

        Raises:
            NumericalError: a number is no longer finite; all results up to the previous step are kept.
            FolderError: the folder cannot be written.
        """
        engine = Engine(self.simulation, self.steps, start=self.start, rows=self._needs_rows())
        least = _STEPS_OF_A_LARGE if self.simulation.atoms > _LARGE else 1
        interval = max(least, self.steps // _BUDGET_CHECKS)
        blown: Segment | None = None
        if self.start is None:
            # from here on a run that is stopped can be resumed
            self.folder.checkpoint(self._to_dict(engine.start), force=True)
        self._say("compile", int(engine.start.state.step))
        first = engine.start.reference if self.done.first is None else self.done.first
        self._show(self.simulation, first)
        before: float | None = None
        paces: deque[float] = deque(maxlen=_PACES)
        for segment in engine.segments():
            if segment.closes in FAILURES:
                blown = segment
            # the last row of a run that blew up is not finite
            kept = replace(segment, rows=segment.rows - 1) if segment.closes == "blow-up" else segment
            if kept.rows:
                self._take(kept, interval)
            now = time.perf_counter()
            if before is None:
                self.done.tally.start_up_seconds = self.done.tally.start_up_seconds or now - self.began
            elif segment.rows and before < now:
                # the first segments hold compilations, and a later one may: the median is that of steps
                paces.append(segment.rows / (now - before))
                self.done.tally.steps_per_second = median(paces)
            before = now
            self.done.tally.seconds = self._earlier_seconds + now - self.began
            self._say("run", segment.last)
            if blown is None:
                self._checkpoint(segment, force=segment.closes == "end")
        status = "complete" if blown is None else "failed"
        summary = summarize(self.simulation, self.done, self.steps, status)
        if blown is not None:
            return self._fail(blown, summary)
        self.ended = self.simulation.in_row(segment.cell_of(segment.rows - 1))
        self._show(self.ended, segment.last_positions.T)
        # after the checkpoint: a run that is continued goes on with this list, and drops the row
        if (row := self.done.health.last_row()) is not None:
            self.folder.append("epochs", row)
        self.folder.finalize()
        self.folder.write_summary(summary)
        return summary

    def _show(self, here: Simulation, positions: Any) -> None:
        if self.shown is not None:
            self.shown(here, np.asarray(positions, np.float64))

    def _needs_rows(self) -> bool:
        """True if storing time steps is faster than recomputing them."""
        simulation = self.simulation
        policy = simulation.policy
        # in single precision most steps have a margin within its bound, and a bad list misses pairs
        narrow = {policy.dtype("state"), policy.dtype("decision")} != {np.dtype(np.float64)}
        often = 0 < self.save_every < _FRAMES_APART or narrow or not simulation.rule.safe
        # XLA may round a kick otherwise where an energy function of many bodies is compiled beside it
        slow = jax.default_backend() == "cpu" and not foreign.known()
        return often or slow or not simulation.pairwise

    def _take(self, segment: Segment, interval: int) -> None:
        done = self.done
        pairs = self.recorder.counts(segment)
        ambiguous = self.recorder.ambiguous(segment)
        ledger = self.recorder.flips(segment)
        by_box = self.recorder.caused_by_box(ledger) if segment.cells else None
        rows = series_columns(self.simulation, segment, pairs, ambiguous, ledger, by_box)
        self.folder.append("series", rows)
        if len(ledger):
            self.folder.append("flips", {**ledger.columns(), **self.simulation.first_atoms(ledger.i)})
        for row in done.health.take(segment, self.recorder.missed):
            self.folder.append("epochs", row)
        done.tally.take(segment, rows, ledger, self.recorder.bounds(segment))
        if done.first is None:
            done.first = segment.unsorted("x", 0)
        done.last = segment.last_positions
        self._save_frames(segment)
        self._close_budget(segment, ledger, interval)
        self._log(segment, pairs, ledger)

    def _close_budget(self, segment: Segment, ledger: FlipTable, interval: int) -> None:
        budget = self.done.budget
        if budget.start is None:
            self._examine(segment, 0, segment.start.v)
        budget.jumps += float(np.sum(ledger.energy_jump))
        due = segment.first // interval != (segment.last + 1) // interval or segment.closes == "end"
        if due and segment.last:
            # a step after which nothing is finite has the velocities of its row
            v = segment.state.v if segment.closes != "blow-up" else segment.unsorted("v", segment.rows - 1)
            self._examine(segment, segment.rows - 1, v)
            self.done.pressure.take(segment)

    def _examine(self, segment: Segment, row: int, v: Any) -> None:
        step, x, cell = segment.first + row, segment.unsorted("x", row), segment.cell_of(row)
        numbers = self.done.budget.check(step, x, float(segment.rows_of("potential")[row]), cell)
        flat = {name: np.reshape(one, (1, -1)) for name, one in {"x": x, "v": v, **numbers}.items()}
        self.folder.append("ranges", {"step": np.array([step]), **ranges.columns(flat)})

    def _save_frames(self, segment: Segment) -> None:
        if not self.save_every:
            return
        rows = [row for row in range(segment.rows) if (segment.first + row) % self.save_every == 0]
        tables = self.simulation.tables(segment.table) if rows else None
        for row in rows:
            self.folder.append_frame(self._frame(segment, row, tables))

    def _frame(self, segment: Segment, row: int, tables: Any) -> Atoms:
        step, simulation = segment.first + row, self.simulation.in_row(segment.cell_of(row))
        atoms: Atoms = simulation.structure.copy()
        if simulation is not self.simulation:
            atoms.set_cell(simulation.cell.matrix)
        atoms.set_positions(segment.unsorted("x", row).astype(np.float64))
        atoms.set_velocities(segment.unsorted("v", row).astype(np.float64))
        # ASE's trajectories drop arrays that they do not know
        atoms.info["images"] = segment.unsorted("images", row)
        atoms.info["step"] = step
        atoms.info["time"] = step * simulation.timestep
        # the loop records no forces: they are worked out again, with its list and hence its decisions
        made = evaluate_listed(simulation.force, segment.rows_of("x")[row], tables, True)
        forces = np.empty((len(atoms), 3))
        forces[segment.table.order] = np.asarray(made.force).T
        known = {"energy": float(segment.rows_of("potential")[row]), "forces": forces}
        if atoms.cell.rank == 3 and atoms.pbc.any():
            known["stress"] = full_3x3_to_voigt_6_stress(-np.asarray(made.tensor) / simulation.cell.volume)
        atoms.calc = SinglePointCalculator(atoms, **known)
        return atoms

    def _checkpoint(self, segment: Segment, *, force: bool) -> None:
        if not (force or self.folder.checkpoint_due()):
            return
        state = self._to_dict(resume_point(segment))
        # what it holds takes longer to list than all the rest, and this one goes on
        held = copy(self.recorder).held if segment.due else None
        self.folder.checkpoint_beside(lambda: state if held is None else {**state, "held": held()})

    def _to_dict(self, point: Start) -> dict[str, Any]:
        """Return the data from which the run can be resumed."""
        last = None if self.done.last is None else np.asarray(self.done.last).T
        frames = {"first": self.done.first, "last": last}
        return {
            **point.to_arrays(),
            **{name: values for name, values in frames.items() if values is not None},
            "done": self.done.to_dict(),
            "steps": self.steps,
            "save_every": self.save_every,
        }

    def _log(self, segment: Segment, pairs: np.ndarray, ledger: FlipTable) -> None:
        so_far = np.cumsum(np.bincount(ledger.step - segment.first, minlength=segment.rows))
        flips = self.done.tally.entered + self.done.tally.left - len(ledger)
        every = max(1, self.steps // _LOG_LINES)
        for row in range(segment.rows):
            step = segment.first + row
            if step == 0:
                self.folder.log(_LOG_HEADER)
            if step % every == 0 or step == self.steps:
                self.folder.log(
                    log_line(self.simulation, segment, row, int(pairs[row]), flips + int(so_far[row]))
                )

    def _say(self, phase: str, step: int) -> None:
        if self.progress is None:
            return
        tally = self.done.tally
        info = {
            "phase": phase,
            "steps_per_second": tally.steps_per_second,
            "flips": tally.entered + tally.left,
            "rebuilds": self.done.health.rebuilds,
            "folder": self.folder.path,
        }
        self.progress(step, self.steps, info)

    def _fail(self, blown: Segment, summary: dict[str, Any]) -> dict[str, Any]:
        step, positions = blown.last, np.asarray(self.done.last, np.float64).T
        point, remedy = resume_point(blown), _SHORTER
        if blown.closes == "runaway":
            kept, what = step, f"an atom moved by more than the box in the step after {step}"
        elif blown.closes == NARROW:
            kept, what = step, f"the box is too narrow at step {step + 1}"
            try:
                point.check_box(self.simulation, 0)
            except InputError as error:
                what, remedy = f"{what}: {error.message}", error.remedy
        else:
            kept, what = step - 1, f"the energy or a velocity stopped being a finite number at step {step}"
            last = blown.unsorted("x", blown.rows - 1).astype(np.float64)
            positions = last if np.all(np.isfinite(last)) else positions
        sound = np.all(np.isfinite(blown.rows_of("cell")))
        cell = blown.cell_of(blown.rows - 1) if sound else blown.start.cells[-1]
        if blown.closes != NARROW:
            what += closest_pair(self.simulation.in_row(cell), positions)
        self.folder.checkpoint(self._to_dict(point), force=True)
        self.folder.finalize()
        summary |= {"error": what, "remedy": remedy, "reason": blown.closes, "verdict": f"Stopped: {what}."}
        self.folder.write_summary(summary)
        raise NumericalError(
            what,
            where=self.simulation.name,
            remedy=f"The results up to step {kept} are stored in {self.folder.path}. {remedy}",
            folder=self.folder.path,
        )


def run(
    system: Simulation | System | str | Path | None,
    layout: Layout,
    *,
    out: str | Path | None = None,
    steps: int | None = None,
    save_every: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    progress: Progress | None = None,
    shown: Shown | None = None,
) -> RunResult:
    """Simulate a system, and record every pair that crosses the cutoff.

    Args:
        system: a simulation, a system, a shipped name or the path of a system file; None when resuming,
            except for a simulation that was made from objects.
        layout: layout of the new run folder, declared by the caller.
        out: the new run folder; default runs/<name>-<n>.
        steps: last step; by default the system's.
        save_every: number of steps between trajectory frames; by default the system's.
        overrides: dotted keys to values, as for `mdnum.systems.load`.
        resume: folder of a run to continue; the result is the same, bit for bit, as without the interruption.
        progress: called occasionally with step, steps and a dictionary of figures.
        shown: called with the simulation in its box, and the first and the last positions, shape (atoms, 3),
            wrapped, length, as soon as they are available; not called if the run in the folder is already
            complete.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
        NumericalError: the run blew up; the results before this step are in the folder.
    """
    began = time.perf_counter()
    if resume is not None:
        given = system if isinstance(system, Simulation) else None
        if system is not given or save_every is not None or overrides:
            raise InputError(
                "a resumed run uses the system, settings and save_every of its folder",
                remedy="Give only the folder and, to extend the run, a number of steps",
                where=str(resume),
            )
        finished = _finished(Path(resume), steps, given)
        if finished is not None:
            return finished
        rollout = _resumed(Path(resume), layout, given, steps, progress, began)
    elif system is None:
        raise InputError("no system was given", remedy="Give a system, or the folder of a run to resume")
    else:
        simulation = build(system, overrides)
        rollout = _fresh(simulation, layout, out, steps, save_every, progress, began)
    rollout.shown = shown
    try:
        summary = rollout.run()
    except BaseException:
        rollout.folder.close()
        raise
    done = rollout.done
    assert done.first is not None and done.last is not None
    frames = (np.asarray(done.first, np.float64), np.asarray(done.last, np.float64).T)
    return RunResult(rollout.folder.path, summary, rollout.simulation, frames, rollout.ended)


def _fresh(simulation: Simulation, layout: Layout, out, steps, save_every, progress, began) -> Rollout:
    last = simulation.steps if steps is None else steps
    every = simulation.save_every if save_every is None else save_every
    if last < 0 or every < 0:
        raise InputError("the number of steps or save_every is negative; expected 0 or more")
    folder = RunFolder.create(Path(out) if out is not None else default_folder(simulation.name), layout)
    simulation.write(folder.path)
    folder.write_provenance(provenance.collect(simulation))
    return Rollout(simulation, folder, last, every, progress, began)


def _finished(path: Path, steps: int | None, given: Simulation | None) -> RunResult | None:
    """Return the result in a folder if its run is complete, else None."""
    folder = RunFolder.open(path)
    summary = folder.summary
    if summary.get("status") != "complete" or not folder.has_checkpoint():
        return None
    saved = folder.load_checkpoint()
    with folder.explained():
        wanted = int(saved["steps"]) if steps is None else steps
        if summary["steps"] != wanted:
            return None
        folder.check_start()
        frames = (np.asarray(saved["first"], np.float64), np.asarray(saved["last"], np.float64))
        simulation = again(path, given)
        cells = Start.from_arrays(saved, simulation).state.cells
        return RunResult(path, summary, simulation, frames, simulation.in_row(cells[:2][-1]))


def _resumed(
    path: Path, layout: Layout, given: Simulation | None, steps: int | None, progress, began
) -> Rollout:
    folder = RunFolder.open(path)
    if folder.summary.get("status") == "failed":
        raise FolderError(
            f"the run failed and cannot be resumed: {folder.summary.get('error', 'see its report')}",
            where=str(path),
            remedy=f"Start a new run. {folder.summary.get('remedy', _SHORTER)}",
        )
    # a run that is refused stays as it is: resuming drops what was written after its checkpoint
    with folder.explained():
        state = folder.load_checkpoint()
        if steps is not None and steps < int(np.asarray(state["state_step"])) - 1:
            raise FolderError(f"the run is already beyond the requested step {steps}", where=str(path))
        folder.check_start()
        simulation = again(path, given)
        last = int(state["steps"]) if steps is None else steps
        rollout = Rollout(simulation, folder, last, int(state["save_every"]), progress, began)
        rollout.restore(state)
        if simulation.integrator.moves_cell and rollout.start is not None:
            rollout.start.check_box(simulation)
    try:
        folder.resume(layout)
    except BaseException:
        folder.close()
        raise
    return rollout
