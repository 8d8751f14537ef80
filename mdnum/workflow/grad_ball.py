"""`mdnum grad` of a ball: the same comparison, by the ball's own methods and against its closed form."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from mdnum.errors import InputError
from mdnum.workflow.fork_question import Log, Progress, finish, opened
from mdnum.workflow.grad import GradResult

if TYPE_CHECKING:
    from mdnum.systems.ball_system import BallSystem

_UNITS = {
    "k": "1/s²", "damping": "1/s", "eps": "m", "tol": "m", "gravity": "m/s²", "h": "s", "y0": "m",
    "v0": "m/s",
}  # fmt: skip


def grad_ball(
    system: Any,
    of: str | None = None,
    wrt: Sequence[str] = (),
    *,
    steps: int | None = None,
    methods: Sequence[str] | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> GradResult:
    """Differentiate the loss of a ball in every way that applies, and compare with the closed form.

    Args:
        system: a loaded ball, a shipped name or the path of a system file.
        of: kind of the loss; default the file's.
        wrt: parameters; default those of the file's [gradient] table.
        steps, methods, out, overrides, report, progress: as for `mdnum.workflow.grad`.

    Raises:
        InputError: no such loss, parameter or method, or none of the methods applies.
        FolderError: the folder cannot be used.
    """
    from mdnum.ball.gradients import BY_NAME, method
    from mdnum.systems.build_ball import build_ball
    from mdnum.workflow import ball_record
    from mdnum.workflow.ball import gradients

    began = time.perf_counter()
    loaded = _loaded(system, of, wrt, overrides)
    loaded = loaded if steps is None else loaded.for_steps(steps)
    spec = loaded.spec
    chosen = tuple(BY_NAME) if methods is None or "all" in methods else tuple(methods)
    for word in chosen:
        method(word)
    problem = build_ball(loaded).problem
    folder = opened(loaded, "grad", out, "grad")
    try:
        told = Log(folder, progress)
        told(0, 0, {"phase": "run"})
        run = problem.run()
        asked = spec.gradient.model_copy(update={"methods": chosen})
        told(0, 0, {"phase": "gradient"})
        found = gradients(problem, asked)
        applied = [one for one in found if not one["refused"]]
        if not applied:
            reasons = "; ".join(f"{one['method']}: {one['says']}" for one in found)
            raise InputError(f"no method applies: {reasons}", where=loaded.name)
        summary = _summary(loaded, applied, ball_record.exact(loaded, run, applied))
        folder.finalize()
        folder.write_summary(
            summary
            | {
                "contacts": int(run.contacts.step.size),
                "refused": [{"method": one["method"], "why": one["says"]} for one in found if one["refused"]],
                "left_out": [],
                "seconds": time.perf_counter() - began,
            }
        )
    except BaseException:
        folder.close()
        raise
    return GradResult(folder.path, {one["method"]: one for one in applied}, finish(folder, report, progress))


def _loaded(
    system: Any, of: str | None, wrt: Sequence[str], overrides: Mapping[str, Any] | None
) -> BallSystem:
    """The ball with the loss and the parameters that were asked for in its own tables."""
    from mdnum.systems import BallSystem, ball, ball_checks, load

    kinds = get_args(ball.Loss.model_fields["kind"].annotation)
    if of is not None and of not in kinds:
        raise InputError(f"no loss {of!r} of a ball", remedy=f"There are {', '.join(kinds)}")
    changes: dict[str, Any] = {} if of is None else {"loss.kind": of}
    changes |= {"gradient.of": list(wrt)} if wrt else {}
    plain = system if isinstance(system, BallSystem) else load(system, overrides, world="ball")
    known = (*ball_checks.PARAMETERS[plain.spec.contact.kind], *ball_checks.ALWAYS)
    unknown = [name for name in wrt if name not in known]
    if unknown or not (wrt or plain.spec.gradient.of):
        seen = f"no parameter {unknown[0]!r}" if unknown else "no parameter to differentiate by"
        raise InputError(seen, where=plain.name, remedy=f"Add --wrt NAME,NAME. There are {', '.join(known)}")
    if not isinstance(system, BallSystem):
        return load(system, {**(overrides or {}), **changes}, world="ball")
    if overrides:
        raise InputError(
            "overrides change a system while it is loaded",
            remedy="Load it with the overrides, or give its name",
            where=system.name,
        )
    if not changes:
        return system
    varied = system.against(changes, "asked").variants[-1]
    return replace(system, spec=varied.spec)


def _summary(
    system: BallSystem, found: Sequence[Mapping[str, Any]], exact: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The content of summary.json, without what was refused, headline and findings."""
    spec = system.spec
    made = {one["method"]: one["gradient"] for one in found}
    right = (exact or {}).get("gradient") or {}
    if right:
        reference, base = "closed form", right
    else:
        reference = "event-aware" if "event-aware" in made else found[0]["method"]
        base = made[reference]
    power = "²" if spec.loss.kind == "residual-penetration" or spec.loss.target is not None else ""
    return {
        "world": "grad",
        "question": "grad",
        "system": system.name,
        "about": spec.about,
        "balls": system.balls,
        "contact_kind": spec.contact.kind,
        "integrator": spec.integrator.kind,
        "steps": spec.integrator.steps,
        "timestep": spec.integrator.timestep,
        "units": "ball",
        "loss": {"word": spec.loss.kind, "about": spec.loss.kind.replace("-", " "), "unit": f"m{power}"},
        "value": found[0]["value"],
        "parameters": [
            {"name": name, "unit": _UNITS.get(name, ""), "value": None} for name in spec.gradient.of
        ],
        "reference": reference,
        "exact": dict(right),
        "growth": None,
        "flips": None,
        "trust": None,
        "spectrum": None,
        "scaling": None,
        "edges": {},
        "not_finite": None,
        "methods": [
            {
                "method": one["method"],
                "says": one["says"],
                "value": one["value"],
                "gradient": one["gradient"],
                "error": dict(one["details"].get("standard_error", {})),
                "notes": {
                    name: why
                    for name, why in one["why"].items()
                    if not one["depends"].get(name, True) or one["gradient"].get(name) == 0
                },
                "details": one["details"],
            }
            for one in found
        ],
        "comparisons": [
            {
                "name": name,
                "method": method,
                "reference": reference,
                "size": abs(base[name]),
                "difference": value - base[name],
                "relative": _relative(value, base[name]),
                "means": "",
                "says": "",
            }
            for method, gradient in made.items()
            for name, value in gradient.items()
            if name in base and method != reference
        ],
        "findings": [],
        "status": "complete",
    }


def _relative(value: float, right: float) -> float:
    """The difference over what is right, as the page says; infinite where only that is 0."""
    if value == right:
        return 0.0
    return abs(value - right) / abs(right) if right else float("inf")
