"""`mdnum run` as a function: roll out, compare with the reference, judge, report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError, NumericalError
from mdnum.store import RunFolder

if TYPE_CHECKING:
    from mdnum.rollout.run import Progress, RunResult
    from mdnum.systems.load import System


def run(
    system: System | str | Path | None,
    *,
    out: str | Path | None = None,
    steps: int | None = None,
    save_every: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    check: bool = True,
    report: bool = True,
    progress: Progress | None = None,
) -> RunResult:
    """Simulate a system, record every flip, compare the first and last frame with ASE, and write a report.

    Args:
        system: a loaded system, a shipped name or the path of a system file; None when resuming.
        out: the new run folder; default runs/<name>-<n>.
        steps: last step; default the system's.
        save_every: a trajectory frame every so many steps; default the system's.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        resume: continue the run in this folder, bit for bit.
        check: compare with ASE (or with plain numpy where ASE has no such potential).
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Returns:
        the run's folder and its summary, findings and verdict included.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
        NumericalError: the run blew up; what came before is in the folder, with its report.
    """
    from mdnum.rollout.run import run as roll_out
    from mdnum.systems import BallSystem

    if isinstance(system, BallSystem):
        raise InputError("this system is a ball", where=system.name, remedy="Use mdnum.bounce")
    if resume is not None and Path(resume).is_dir() and (folder := RunFolder.open(resume)).world != "md":
        ball = folder.world == "ball"
        raise InputError(
            "is a run of the ball, which takes seconds and leaves nothing to resume"
            if ball
            else f"is the folder of `mdnum {folder.verb}`, and no run",
            where=str(resume),
            remedy=f"Run it again with `mdnum ball {resume}`"
            if ball
            else f"`mdnum report {resume}` shows it"
            if folder.summary
            else folder.again,
        )
    try:
        result = roll_out(
            system,
            out=out,
            steps=steps,
            save_every=save_every,
            overrides=overrides,
            resume=resume,
            progress=progress,
        )
    except NumericalError as error:
        if error.folder is not None:
            _judge(RunFolder.open(error.folder), report)
        raise

    def say(phase: str) -> None:
        if progress is not None:
            progress(result.summary["steps"], result.summary["steps_asked"], {"phase": phase})

    folder = RunFolder.open(result.folder)
    if check:
        say("check")
        _compare(folder, result)
        _beside_float64(folder, result)
    if report:
        say("report")
    _judge(folder, report)
    return replace(result, summary=folder.summary)


def _compare(folder: RunFolder, result: RunResult) -> None:
    """Puts the comparison of the first and the last frame into the summary."""
    from ase import Atoms

    from mdnum.references.energy import check_energy

    template: Atoms = result.simulation.system.atoms
    frames = {}
    for name, positions in zip(("initial", "last"), result.frames, strict=True):
        frames[name] = template.copy()
        frames[name].set_positions(positions)
    compared = check_energy(result.simulation, frames)
    summary = folder.summary
    summary["ase"] = compared.worst
    summary["findings"] = [*summary["findings"], *compared.findings]
    folder.write_summary(summary)


#: Steps of a run in whole numbers that are made in float64 too.
_BESIDE = 2000


def _beside_float64(folder: RunFolder, result: RunResult) -> None:
    """Puts how well a run in whole numbers keeps its energy into the summary, and the same in float64."""
    import numpy as np

    from mdnum.md.integrators import Langevin
    from mdnum.rollout.engine import FAILURES, Engine

    simulation, summary = result.simulation, folder.summary
    if simulation.lattice is None or isinstance(simulation.integrator, Langevin):
        return
    steps = min(int(summary["steps"]), _BESIDE)
    there = []
    for segment in Engine(simulation.smooth, steps).segments():
        if segment.closes in FAILURES:
            return
        there.append(segment.rows_of("potential") + segment.rows_of("kinetic"))
    ours = np.asarray(folder.read("series")["total"])[: steps + 1]
    for key, energy in (("energy_std", ours), ("energy_std_float64", np.concatenate(there))):
        summary["lattice"][key] = float(np.std(energy)) / simulation.atoms
    summary["lattice"]["energy_steps"] = steps
    folder.write_summary(summary)


def _judge(folder: RunFolder, report: bool) -> None:
    """Puts findings and verdict into the summary, and writes the report where it is wanted."""
    if report:
        from mdnum.report.html import write_report

        write_report(folder)
    else:
        from mdnum.report import findings
        from mdnum.report.run import load

        seen = load(folder)
        findings.store(folder, seen, findings.judge(seen))
