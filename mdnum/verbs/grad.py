"""`mdnum grad`: derivatives of a loss with respect to parameters."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, get_args

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.registry import expect_known
from mdnum.store.files import write_bytes
from mdnum.verbs import frame, grad_page, grad_verdict
from mdnum.verbs.fork_pair import FEW_STEPS, basics, last_step
from mdnum.verbs.frame import Answer, Keep, Outcome, Progress, Verb, words
from mdnum.verbs.grad_page import TEXTS

if TYPE_CHECKING:
    from mdnum.gradients import Gradient, Method, Problem
    from mdnum.gradients.diagnose import GradientDiagnosis
    from mdnum.systems import BallSystem, System
    from mdnum.systems.simulation import Simulation

ALL = "all"
#: Default methods, and the largest number of atoms times steps for which differences are among them.
_QUICK, AFFORDABLE = ("event-aware", "symmetric", "finite-differences"), 6_000_000
#: Parts of a diagnosis that are always computed, and those computed on request.
_PARTS, EDGES = ("agreement", "growth", "flips", "trust"), "edges"
ALSO = ("spectrum", EDGES, "scaling")
#: Parts of a diagnosis with a table, and its name; parts in the summary, and the keys that the summary omits.
_TABLES = {"growth": "growth", "flips": "flip_contributions", "trust": "trust", "scaling": "scaling"}
_BRIEF, _ROWS = ("growth", "flips", "spectrum", "scaling", "detective"), ("table", "turns", "columns")
#: Largest number of entries of a derivative that summary.json lists; the file with longer derivatives.
_FEW, ARRAYS = 6, "gradients.npz"
_BALL_UNITS = {
    "k": "1/s²", "damping": "1/s", "eps": "m", "tol": "m", "gravity": "m/s²", "h": "s", "y0": "m",
    "v0": "m/s",
}  # fmt: skip


@frame.keywords_checked
def grad(
    system: Simulation | System | BallSystem | str | Path,
    of: str | None = None,
    wrt: str | Sequence[str] = (),
    *,
    steps: int | None = None,
    methods: str | Sequence[str] | None = None,
    replicas: int = 0,
    also: str | Sequence[str] = (),
    half_step: bool = True,
    **keep: Unpack[Keep],
) -> Outcome:
    """Differentiate a loss with respect to parameters by several methods.

    Example:
        >>> mdnum.grad("argon/crystal-108", "mean-potential", ["sigma", "cutoff.radius"], steps=200)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file; of molecular dynamics or
            a ball.
        of: the loss, a name of `gradients.losses.LOSSES` with options after a colon ("potential:every=10");
            for a ball a kind of its [loss] table, by default that of its file.
        wrt: parameters, full or short names, as a sequence or separated by commas; for a ball the default is
            the [gradient] table of its file.
        steps: last step; by default the system's own, but at most 500 for molecular dynamics.
        methods: names of `gradients.METHODS`, for a ball of `gradients.ball.BALL_METHODS`, or "all"; by
            default those that finish within about a minute, for a ball all. Omitted methods are listed in the
            summary.
        replicas: number of starts for the standard error of the gradient, at least 2; 0 for none. Each
            requires a run and a tangent pass.
        also: names of further parts of the diagnosis, from `ALSO`, or "all".
        half_step: repeat the run and its gradient at half the time step, which about doubles the work;
            without it no gradient has the verdict "trusted", and its digits are unknown. Not for a ball.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        folder, summary and page; its result is a `GradientDiagnosis`, for a ball `BallGradients`.

    Raises:
        InputError: a loss, parameter or method does not exist, or none of the methods is applicable.
        NumericalError: the run blew up.
        FolderError: the folder cannot be used.
    """
    from mdnum.systems.build import build
    from mdnum.systems.load import world_of

    if replicas < 0 or replicas == 1:
        raise InputError(f"replicas = {replicas}; a standard error needs at least 2 replicas")
    names, further = words(wrt), words(also)
    asked = None if methods is None else words(methods)
    expect_known("part of a diagnosis", further, (*ALSO, ALL))
    further = ALSO if ALL in further else further
    if world_of(system) == "ball":
        whose = "of molecular dynamics: this system is a ball"
        frame.refuse({"--also": bool(further)}, whose, "Leave it out")
        remedy = "Use --methods randomized, an average over noise with its standard error"
        frame.refuse({"--replicas": bool(replicas)}, whose, remedy)
        ball = _ball_system(system, of, names, steps, keep.get("overrides"))
        chosen = _ball_methods(asked)
        with frame.answering("grad", f"grad-{ball.name}", ball, **keep) as answer:
            _differentiated(ball, chosen, answer)
        return answer.outcome

    md = build(system, keep.get("overrides"))  # type: ignore[arg-type]
    problem, names = _problem(md, of, names, steps)
    chosen, left = plan(problem, names, asked, replicas)
    with frame.answering("grad", f"grad-{md.name}", md, **keep) as answer:
        found = _diagnosed(problem, names, chosen, left, further, replicas, half_step, answer.log)
        answer.result, answer.summary = found, _summary(problem, names, found)
        skipped = _not_run(steps, problem, found, replicas, further, half_step)
        answer.summary["left_out"] = [*skipped, *left]
        tables = {name: getattr(found, part).table for part, name in _TABLES.items() if getattr(found, part)}
        answer.tables = {name: table for name, table in tables.items() if len(next(iter(table.values())))}
        _keep_arrays(answer)
    return answer.outcome


# -- molecular dynamics ------------------------------------------------------------------------------


def _problem(
    simulation: Simulation, of: str | None, names: Sequence[str], steps: int | None
) -> tuple[Problem, tuple[str, ...]]:
    """Return the problem and the full parameter names. Raise an error for invalid names."""
    from mdnum.gradients import Problem, parameters
    from mdnum.gradients.losses import LOSSES, NOT_REAL, parse

    if of is None:
        remedy = f"Add --of LOSS. Choose from {', '.join(LOSSES)}"
        raise InputError("no loss function to differentiate was given", where=simulation.name, remedy=remedy)
    last = last_step(simulation, steps, FEW_STEPS)
    loss = parse(of, simulation, last)
    if not names:
        remedy = f"Add --wrt NAME,NAME. The parameters are {', '.join(parameters.names(simulation))}"
        raise InputError("no parameter was given for the derivative", where=simulation.name, remedy=remedy)
    if (problem := Problem(simulation, loss, last)).parts:
        raise loss.wrong(*NOT_REAL)
    return problem, parameters.resolve(simulation, names)


def plan(
    problem: Problem, names: Sequence[str], asked: Sequence[str] | None, replicas: int = 0
) -> tuple[list[Method], list[dict[str, str]]]:
    """Return the gradient methods to run. Return each omitted method with a reason and an option to run it.

    Args:
        asked: names of methods; None for the fast ones.
        replicas: number of starts for averages; 0 for each method's own number, and for no averages if asked
            is None.

    Raises:
        InputError: there is no method of this name.
    """
    from mdnum.gradients import METHODS, method

    if asked is not None:
        chosen = {one.name: one for one in map(method, METHODS if ALL in asked else asked)}
        return [_over(one, replicas) for one in chosen.values()], []
    quick = (*_QUICK, "ensemble") if replicas else _QUICK
    apply: list[Method] = []
    left: list[dict[str, str]] = []
    for name in METHODS:
        one = method(name)
        # by some of the parameters is enough
        reasons = [one.reason_unavailable(problem, [parameter]) for parameter in names]
        why = _too_long(one, problem, reasons.count(None)) if name in quick else one.description
        if None not in reasons:
            left.append({"what": name, "why": reasons[0] or "", "how": ""})
        elif why:
            left.append({"what": name, "why": why, "how": f"--methods {name}"})
        else:
            apply.append(_over(one, replicas, horizons=False))
    return apply, left


def _too_long(method: Method, problem: Problem, names: int) -> str:
    """Return why a gradient method is too slow to run by default, or ""."""
    runs = getattr(method, "runs", 0) * names + 1
    if runs * problem.simulation.atoms * problem.steps <= AFFORDABLE or runs == 1:
        return ""
    return f"about {runs} more runs of {problem.steps:,} steps"


def _over(method: Any, replicas: int, horizons: bool = True) -> Method:
    """Set the number of initial states of a gradient method that averages over initial states."""
    if not replicas or not hasattr(method, "replicas"):
        return method
    changed = replace(method, replicas=replace(method.replicas, count=replicas))
    return replace(changed, halvings=0) if hasattr(changed, "halvings") and not horizons else changed


def _diagnosed(
    problem: Problem, names: Sequence[str], chosen: list[Method], left: Sequence[Mapping[str, str]],
    further: Sequence[str], replicas: int, half_step: bool, log: Progress,
) -> GradientDiagnosis:  # fmt: skip
    from mdnum.gradients import parameters
    from mdnum.gradients.diagnose import diagnose

    where = problem.simulation.name
    if not chosen:
        reasons = "; ".join(f"{one['what']}: {one['why']}" for one in left)
        raise InputError(
            f"none of the gradient methods is applicable: {reasons}",
            where=where,
            remedy="Choose another method with --methods",
        )
    scalars = [name for name in names if not np.ndim(parameters.value(problem.simulation, name))]

    def tell(done: int, steps: int, phase: str) -> None:
        unit = "runs" if phase.endswith(("differences", "replicas")) else "steps"
        log(done, steps, {"phase": phase, "unit": unit})

    def look(parts: Sequence[str], edges: Sequence[str] = ()) -> GradientDiagnosis:
        return diagnose(
            problem, names, parts=parts, methods=chosen, edges_of=edges, replicas=replicas,
            half_step=half_step, progress=tell,
        )  # fmt: skip

    parts = (*_PARTS, *(word for word in further if word != EDGES))
    found = look(parts, scalars if EDGES in further else ())
    if found.agreement is None:
        raise InputError(found.failed["agreement"], where=where)
    reference = found.agreement.gradient(found.agreement.reference)
    assert reference is not None
    if found.growth is not None and not all(np.isfinite(one).all() for one in reference.gradient.values()):
        return replace(found, detective=look(("detective",)).detective)
    return found


def _brief(part: Any) -> Any:
    """Return one result of a gradient diagnosis as plain values, without tables."""
    return part and plain({name: value for name, value in vars(part).items() if name not in _ROWS})


def _summary(problem: Problem, names: Sequence[str], found: GradientDiagnosis) -> dict[str, Any]:
    from mdnum.audit.functions import examined
    from mdnum.gradients import parameters
    from mdnum.gradients.diagnose.trust import NOT_FINITE, UNDECIDED
    from mdnum.systems.schema import pair_names

    agreement, simulation, loss = found.agreement, problem.simulation, problem.loss
    assert agreement is not None
    energy, force = simulation.jumps()
    trust = _brief(found.trust)
    if found.trust is not None:
        half, turns = found.trust.half, found.trust.turns
        reference = agreement.gradient(agreement.reference)
        gradient = {} if reference is None else reference.gradient
        broken = [name for name, one in gradient.items() if not np.isfinite(one).all()]
        # trust is of tangents, which may be finite where the reverse pass is not
        for one in [*([trust] if broken else []), *(trust["by"][name] for name in broken)]:
            one |= {"verdict": UNDECIDED, "unknown": [*one["unknown"], NOT_FINITE]}
        trust["half"] = {name: brief(one[0] if len(one) == 1 else one) for name, one in half.items()}
        trust["near"] = None if turns is None else {
            "turns": len(turns), "within": int(turns.within.sum()),
            "heaviest": turns.heaviest(found.trust.columns, simulation.terms_of),
        }  # fmt: skip
    return basics(simulation, problem.steps) | {
        "loss": {
            "word": loss.name, "about": loss.label, "unit": loss.unit.format_map(vars(simulation.units)),
        },
        "value": found.value,
        "parameters": [
            {
                "name": name, "unit": parameters.unit(simulation, name),
                "value": brief(parameters.value(simulation, name)),
                "entries": pair_names(simulation.symbols)
                if parameters.by(simulation, name) == "pair type"
                else None,
            }
            for name in names
        ],
        "energy_jump": np.max(np.abs(energy)), "force_jump": np.max(np.abs(force)),
        "reference": agreement.reference,
        "methods": [_method(one.found) | {"seconds": one.seconds} for one in agreement.opinions if one.found],
        "comparisons": plain(agreement.comparisons),
        **{name: _brief(getattr(found, name)) for name in _BRIEF},
        "function": examined(simulation), "failed": dict(found.failed),
        "trust": trust, "edges": plain(found.edges),
        "refused": [{"method": one.method, "why": one.missing} for one in agreement.opinions if one.missing],
    }  # fmt: skip


def _not_run(
    asked: int | None, problem: Problem, found: GradientDiagnosis, replicas: int,
    further: Sequence[str], half_step: bool,
) -> list[dict[str, str]]:  # fmt: skip
    """Return the results that were not computed, each with a reason and an option to compute it."""
    from mdnum.gradients.diagnose.trust import no_half_step

    own, rows = problem.simulation.steps, []
    if asked is None and problem.steps < own:
        rows += [(f"{own - problem.steps:,} steps", f"the system has {own:,}", f"--steps {own}")]
    if found.trust is not None and not replicas:
        rows += [("standard error", TEXTS("left_starts"), "--replicas 8")]
    if found.trust is not None and not half_step and not no_half_step(problem.simulation):
        rows += [("half the time step", TEXTS("left_half"), "leave out --no-half-step")]
    rows += [(part, TEXTS(f"left_{part}"), f"--also {part}") for part in ALSO if part not in further]
    rows += [(part, why, "") for part, why in found.failed.items()]
    return [dict(zip(("what", "why", "how"), row, strict=True)) for row in rows]


def _keep_arrays(answer: Answer) -> None:
    """Write derivatives with many entries to a file in the output folder."""
    agreement = answer.result.agreement
    large: dict[str, Any] = {
        f"{one.method}/{name}": np.asarray(value)
        for one in (agreement.opinions if agreement else ()) if one.found is not None
        for name, value in one.found.gradient.items() if np.ndim(value) > 1 or np.size(value) > _FEW
    }  # fmt: skip
    if large:
        sink = io.BytesIO()
        np.savez_compressed(sink, **large)  # type: ignore[arg-type]
        write_bytes(answer.folder.path / ARRAYS, sink.getbuffer())


# -- of either world ---------------------------------------------------------------------------------


def _method(found: Gradient) -> dict[str, Any]:
    """Return the result of one gradient method as plain values."""
    details = plain(found.details)
    error = details.pop("error", details.get("standard_error", {}))
    # by what is used, zero is a number like any other
    notes = {
        name: note
        for name, note in found.notes.items()
        if not found.depends.get(name, False) or not np.any(found.gradient.get(name, 0))
    }
    return {
        "method": found.method, "description": found.description, "kind": found.kind, "value": found.value,
        "gradient": {name: brief(value) for name, value in found.gradient.items()}, "error": error,
        "notes": notes, "details": details,
    }  # fmt: skip


def brief(value: Any) -> Any:
    """Return an array as a number or a short list. For a large array, return its norm and largest entry."""
    array = np.asarray(value, np.float64)
    if array.ndim == 0:
        return float(array)
    if array.ndim == 1 and array.size <= _FEW:
        return array.tolist()
    at = np.unravel_index(int(np.argmax(np.abs(array))), array.shape)
    return {
        "shape": list(array.shape), "norm": float(np.linalg.norm(array)), "largest": float(array[at]),
        "at": [int(place) for place in at],
    }  # fmt: skip


# -- a ball ------------------------------------------------------------------------------------------


def _ball_methods(asked: Sequence[str] | None) -> list[str]:
    from mdnum.gradients.ball import BALL_METHODS

    chosen = list(BALL_METHODS) if asked is None or ALL in asked else list(asked)
    for name in chosen:
        BALL_METHODS[name]
    return chosen


def _ball_system(
    system: Any, of: str | None, names: Sequence[str], steps: int | None, overrides: Mapping[str, Any] | None
) -> BallSystem:
    """Return a bouncing-ball system with the requested loss, parameters and number of steps."""
    from mdnum.systems import BallSystem, ball, load

    kinds = get_args(ball.LossTable.model_fields["kind"].annotation)
    expect_known("loss of a ball", filter(None, [of]), kinds)
    changes: dict[str, Any] = {} if of is None else {"loss.kind": of}
    changes |= {"gradient.of": list(names)} if names else {}
    made = load(system, overrides, world="ball")
    known = ball.parameters(made.spec.contact.kind)
    unknown = [name for name in names if name not in known]
    if unknown or not (names or made.spec.gradient.of):
        seen = f"no parameter {unknown[0]!r}" if unknown else "no parameter was given for the derivative"
        raise InputError(
            seen, where=made.name, remedy=f"Add --wrt NAME,NAME. The parameters are {', '.join(known)}"
        )
    if not isinstance(system, BallSystem):
        made = load(system, {**(overrides or {}), **changes}, world="ball")
    elif changes:
        made = replace(system, spec=system.against(changes, "asked").variants["asked"])
    return made if steps is None else made.for_steps(steps)


def _differentiated(system: BallSystem, methods: list[str], answer: Answer) -> None:
    from mdnum.gradients.ball import compare
    from mdnum.systems.build_ball import build_ball
    from mdnum.verbs.ball_record import exact

    spec, problem = system.spec, build_ball(system).problem
    frame.say(answer.log, "run")
    run = problem.run()
    frame.say(answer.log, "gradient")
    answer.result = found = compare(problem, spec.gradient.of, methods)
    rows = [_method(one) for one in found]
    if not rows:
        reasons = "; ".join(f"{name}: {why}" for name, why in found.refused.items())
        raise InputError(f"no gradient method is applicable: {reasons}", where=system.name)
    right = (exact(system, run, rows) or {}).get("gradient") or {}
    made = {one["method"]: one["gradient"] for one in rows}
    reference = "closed form" if right else "event-aware" if "event-aware" in made else rows[0]["method"]
    base = right or made[reference]
    power = "²" if spec.loss.kind == "residual-penetration" or spec.loss.target is not None else ""
    answer.summary = basics(system, None) | {
        "loss": {"word": spec.loss.kind, "about": spec.loss.kind.replace("-", " "), "unit": f"m{power}"},
        "value": rows[0]["value"],
        "parameters": [
            {"name": name, "unit": _BALL_UNITS.get(name, ""), "value": None} for name in spec.gradient.of
        ],
        "reference": reference, "exact": dict(right), "methods": rows,
        "comparisons": [
            {
                "name": name, "method": method, "reference": reference, "size": abs(base[name]),
                "difference": value - base[name], "relative": relative(value, base[name]), "meaning": "",
            }
            for method, gradient in made.items() if method != reference
            for name, value in gradient.items() if name in base
        ],
        "contacts": int(run.contacts.step.size),
        "refused": [{"method": name, "why": why} for name, why in found.refused.items()],
        "left_out": [],
    }  # fmt: skip


def relative(value: float, right: float) -> float:
    """Return |value - right| / |right|. Infinity if only `right` is 0."""
    if value == right:
        return 0.0
    return abs(value - right) / abs(right) if right else float("inf")


KINDS = {"grad": Verb(grad_verdict.judge, grad_page.page)}
