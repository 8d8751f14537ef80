"""What questions that leave a folder of their own kind share: a system, the folder, and its page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.store.naming import default_folder
from mdnum.workflow.frame import Log as Log

if TYPE_CHECKING:
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.load import System

Progress = Callable[[int, int, dict[str, Any]], None]

#: Steps of a question that makes hundreds of runs, or follows them by hand, unless more are asked for.
FEW_STEPS = 500
#: What a ball offers in place of a question about molecular dynamics.
OF_A_BALL = {
    "--processes": "Whether a ball's bits depend on the program around it is shown by "
    "`mdnum ball --demo determinism`",
    "--forecast": "How far each contact is from another step is the margin that `mdnum ball` records",
    "--benign": "A ball has no ensemble to be consistent with; --vary says how far the heights part",
    "--minimal": "A ball's decisions are taken back one at a time: --vary contact=STEP:BALL",
    "--pin": "A ball's decisions are taken back one at a time: --vary contact=STEP:BALL",
    "--no-back": "A ball is run under either run's decisions always; --no-counterfactual leaves both out",
    "--no-lyapunov": "A ball has no tangent run to leave out",
}


def is_ball(system: Any) -> bool:
    """Whether a system, or what is there under a name, is a ball."""
    from mdnum.systems import BallSystem, System
    from mdnum.systems.find import world_of

    if isinstance(system, System | BallSystem):
        return isinstance(system, BallSystem)
    return world_of(system) == "ball"


def loaded(
    system: System | BallSystem | str | Path,
    overrides: Mapping[str, Any] | None,
    instead: str = "Use mdnum.bounce",
) -> System:
    """The system of molecular dynamics that is meant.

    Args:
        system: a loaded system, a shipped name or the path of a system file.
        overrides: dotted keys to values.
        instead: what somebody with a ball can do.

    Raises:
        InputError: there is none, it is a ball, or it is loaded already and there are overrides.
    """
    from mdnum.systems import BallSystem, System, load

    if isinstance(system, BallSystem) or is_ball(system):
        name = system if isinstance(system, str | Path) else system.name
        raise InputError("this system is a ball", where=str(name), remedy=instead)
    if not isinstance(system, System):
        return load(system, overrides, world="md")
    if overrides:
        raise InputError(
            "overrides change a system while it is loaded",
            remedy="Load it with the overrides, or give its name",
            where=system.name,
        )
    return system


def steps_of(system: System, steps: int | None) -> int:
    """The last step: the one asked for, else the system's own, but no more than a few hundred."""
    last = min(FEW_STEPS, system.spec.dynamics.steps) if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    return last


def opened(
    system: System | BallSystem, question: str, out: str | Path | None, verb: str = "fork"
) -> RunFolder:
    """An empty folder that is to answer a question, with the system and its provenance.

    Args:
        question: a key of `store.TABLES`.
        verb: of the command line, which the folder is named after.
    """
    from mdnum.provenance import collect

    path = default_folder(f"{verb}-{system.name}") if out is None else out
    folder = RunFolder.create(path, world=question)
    try:
        system.write(folder.path)
        folder.write_provenance(collect(system))
    except BaseException:
        folder.close()
        raise
    return folder


def basics(system: System, question: str, steps: int) -> dict[str, Any]:
    """The entries of summary.json that all questions have."""
    return {
        "world": "fork",
        "question": question,
        "system": system.name,
        "about": system.spec.about,
        "atoms": len(system.atoms),
        "steps": steps,
        "timestep": float(system.spec.dynamics.timestep),
        "units": system.units.name,
        "findings": [],
        "status": "complete",
    }


def finish(folder: RunFolder, report: bool, progress: Progress | None) -> dict[str, Any]:
    """Headline, findings and, where it is wanted, the page; the summary with them."""
    from mdnum import report as pages

    if progress is not None:
        progress(0, 0, {"phase": "report" if report else "check"})
    if report:
        pages.write(folder)
    else:
        pages.judge(folder)
    return folder.summary
