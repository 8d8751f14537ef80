"""`mdnum grad` as a function: differentiate a loss through a rollout in several ways, compare, report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.workflow.fork_question import Log, Progress, finish, is_ball, loaded, opened, steps_of

if TYPE_CHECKING:
    from mdnum.gradients.base import Problem
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.load import System


#: What is left out where no replicas are asked for.
_STARTS = {
    "what": "standard error",
    "why": "other starts of the system, a run and a pass of tangents each",
    "how": "--replicas 8",
}
#: What is left out with --no-half-step.
_HALF = {
    "what": "half the time step",
    "why": "the gradient over the same time in twice as many steps: the digits that hold",
    "how": "leave out --no-half-step",
}


@dataclass(frozen=True)
class GradResult:
    """A finished comparison of gradients.

    Attributes:
        folder: the gradient folder.
        gradients: by method, in the order in which they were made; of a ball, those of
            `mdnum.ball.gradients`.
        summary: what summary.json says, findings included.
    """

    folder: Path
    gradients: dict[str, Any]
    summary: dict[str, Any]


def grad(
    system: System | BallSystem | str | Path,
    of: str | None = None,
    wrt: str | Sequence[str] = (),
    *,
    steps: int | None = None,
    methods: str | Sequence[str] | None = None,
    replicas: int = 0,
    also: str | Sequence[str] = (),
    half_step: bool = True,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> GradResult:
    """Differentiate a loss of a rollout by parameters of its system, in several ways, and compare them.

    Args:
        system: a loaded system, a shipped name or the path of a system file; of molecular dynamics or a
            ball.
        of: the loss, a word of `workflow.grad_words.LOSSES` with options behind a colon
            ("potential:every=10"); of a ball a kind of its [loss] table, default what its file says.
        wrt: parameters, full or short names, one by one or with commas; of a ball default what the
            [gradient] table of its file says.
        steps: last step; default the system's own, but no more than 500 of molecular dynamics.
        methods: words of `mdnum.gradients.registry.METHODS`, or "all"; default those that answer within
            about a minute. What they leave out is said in the summary.
        replicas: starts for the standard error of the gradient, at least 2; 0 leaves it out. Each is a run
            and a pass of tangents.
        also: further parts of the diagnosis, words of `workflow.grad_methods.ALSO`, or "all".
        half_step: make the run and its gradient at half the time step too, about as much work again as all
            else; without it nothing is called trusted, and digits are not known. A ball has none of it.
        out: the new gradient folder; default runs/grad-<name>-<n>.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Raises:
        InputError: no such loss, parameter or method, or none of the methods applies.
        NumericalError: the run blew up.
        FolderError: the folder cannot be used.
    """
    from mdnum.workflow.grad_words import words

    if replicas < 0 or replicas == 1:
        raise InputError(f"replicas = {replicas}; a standard error takes at least 2")
    wanted = words(wrt)
    chosen = None if methods is None else words(methods)
    further = words(also)
    if is_ball(system):
        if further:
            raise InputError(
                f"{', '.join(further)}: of molecular dynamics, and this system is a ball",
                remedy="Leave out --also",
            )
        if replicas:
            raise InputError(
                "replicas are starts of molecular dynamics, and this system is a ball",
                remedy="Use --methods randomized, an average over noise with its standard error",
            )
        from mdnum.workflow.grad_ball import grad_ball

        return grad_ball(
            system, of, wanted, steps=steps, methods=chosen, out=out, overrides=overrides, report=report,
            progress=progress,
        )  # fmt: skip
    asked = Asked(of, wanted, steps, chosen, replicas, further, half_step)
    return _molecules(loaded(system, overrides), asked, out, report, progress)


@dataclass(frozen=True)
class Asked:
    """What is to be differentiated, by what, and what is to be found out beside."""

    of: str | None
    wrt: tuple[str, ...]
    steps: int | None
    methods: tuple[str, ...] | None
    replicas: int
    also: tuple[str, ...]
    half_step: bool


def _molecules(
    system: System, asked: Asked, out: str | Path | None, report: bool, progress: Progress | None
) -> GradResult:
    from mdnum.gradients.diagnose.trust import no_half_step
    from mdnum.workflow import grad_methods, grad_record

    began = time.perf_counter()
    word, problem, names = _problem(system, asked)
    impossible = no_half_step(problem.simulation)
    plan = grad_methods.plan(problem, names, asked.methods, asked.replicas)
    also = grad_methods.further(asked.also)
    folder = opened(system, "grad", out, "grad")
    try:
        told = Log(folder, progress)
        found = grad_methods.run(plan, problem, names, told, asked.replicas, also, asked.half_step)
        grad_record.write(folder, found)
        folder.finalize()
        folder.write_summary(
            grad_record.summarize(problem, word, names, found)
            | {
                "left_out": [
                    *_shorter(system, asked.steps, problem.steps),
                    *([] if asked.replicas or found.trust is None else [_STARTS]),
                    *([] if asked.half_step or found.trust is None or impossible else [_HALF]),
                    *grad_methods.not_asked(also, found),
                    *plan.left_out,
                ],
                "seconds": time.perf_counter() - began,
            }
        )
    except BaseException:
        folder.close()
        raise
    opinions = () if found.agreement is None else found.agreement.opinions
    made = {one.method: one.found for one in opinions if one.found is not None}
    return GradResult(folder.path, made, finish(folder, report, progress))


def _problem(system: System, asked: Asked) -> tuple[str, Problem, tuple[str, ...]]:
    """The loss's word, the problem, and full names of the parameters: what cannot be is refused here."""
    from mdnum.gradients import parameters
    from mdnum.gradients.base import Problem
    from mdnum.systems import build
    from mdnum.workflow.grad_words import LOSSES, loss

    if asked.of is None:
        raise InputError(
            "no loss to differentiate",
            where=system.name,
            remedy=f"Add --of LOSS. There are {', '.join(LOSSES)}",
        )
    last = steps_of(system, asked.steps)
    simulation = build(system)
    word, made = loss(asked.of, simulation, last)
    if not asked.wrt:
        raise InputError(
            "no parameter to differentiate by",
            where=system.name,
            remedy=f"Add --wrt NAME,NAME. There are {', '.join(parameters.names(simulation))}",
        )
    return word, Problem(simulation, made, last), parameters.resolve(simulation, asked.wrt)


def _shorter(system: System, asked: int | None, steps: int) -> list[dict[str, str]]:
    """That fewer steps were made than the system has, where nobody asked for that."""
    own = system.spec.dynamics.steps
    if asked is not None or steps >= own:
        return []
    return [{"what": f"{own - steps:,} steps", "why": f"the system has {own:,}", "how": f"--steps {own}"}]
