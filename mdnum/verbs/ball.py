"""`mdnum ball`: simulation of bouncing balls, with variants, gradients, verdict and report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import headed
from mdnum.report import analysis
from mdnum.report.finding import Finding, Verdict, conclude
from mdnum.report.words import count, listed, number
from mdnum.verbs import Reply, assigned, frame
from mdnum.verbs.ball_page import TEXTS, BallView, decision, page
from mdnum.verbs.frame import Keep, Outcome, Progress, Verb

if TYPE_CHECKING:
    from mdnum.ball.problem import BallProblem
    from mdnum.ball.rollout import BallRun
    from mdnum.systems.build_ball import BallSimulation
    from mdnum.systems.load import BallSystem

#: Largest number of balls times steps for which every state, and the residuals of stop decisions, are stored.
_STATES, _RESIDUALS = 20_000_000, 5_000_000
#: Relative difference above which two derivatives count as different.
_DISAGREE = 0.01
#: Largest number of variants that a finding names individually.
_NAMED = 4


@frame.keywords_checked
def bounce(
    system: BallSystem | str | Path,
    *,
    steps: int | None = None,
    against: Sequence[str | Mapping[str, Any]] = (),
    **keep: Unpack[Keep],
) -> Outcome:
    """Simulate a bouncing ball and its variants, and write a report.

    Example:
        >>> mdnum.bounce("ball/drop", against=["precision.state=float32"])

    Args:
        system: a loaded system, a shipped name or the path of a system file.
        steps: number of steps, instead of the number in the system file.
        against: further variants to compare with: "key=value", or several keys in a mapping.
        keep: see `frame.Keep`.

    Returns:
        the run's folder, summary and page; `result` is the `BallRun`.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
    """
    from mdnum.systems.build_ball import build_ball
    from mdnum.verbs import ball_record

    simulation = build_ball(_loaded(system, keep.get("overrides"), against), steps=steps)
    with frame.answering("ball", simulation.system.name, simulation.system, **keep) as answer:
        answer.result, rate = _simulate(simulation.problem, answer.log)
        made, apart = _differentiated(simulation, answer.result, answer.log)
        answer.summary = ball_record.summarize(simulation, answer.result) | made | {"steps_per_second": rate}
        answer.tables = ball_record.tables(answer.result) | {"separations": apart}
    return answer.outcome


def command(system: str | None = None, *, demo: str | None = None, **given: Any) -> Outcome | Reply:
    """Execute `mdnum ball` for a system or demonstration. Without a name, list both.

    Raises:
        InputError: a demonstration was requested together with options of a ball.
    """
    from mdnum import systems
    from mdnum.verbs import demos

    if demo is not None:
        foreign = {"system": system, "--steps": given.get("steps"), "--set": given.get("overrides"),
                   "--against": given.get("against")}  # fmt: skip
        if first := next((name for name, value in foreign.items() if value), None):
            seen = f"a demonstration has its own balls, so it takes no {first}"
            raise InputError(seen, remedy="Omit one of them", where="--demo")
        return demos.demonstrate(demo, **given)
    if system is not None:
        return bounce(system, **given)
    balls = [systems.load(name, world="ball") for name in systems.names("ball")]
    rows = [{"name": one.name, "balls": one.balls, "about": one.spec.about} for one in balls]
    scripts = [{"name": name, "about": demos.about(name)} for name in demos.names()]
    lines = [(row["name"], row["balls"], row["about"].partition(". ")[0]) for row in rows]
    title = "\ndemonstrations: `mdnum ball --demo NAME`, or all"
    return Reply(headed("ball-list", {"systems": rows, "demos": scripts}), [
        ("systems: `mdnum ball NAME`", ("name", "balls", "about"), lines),
        (title, ("name", "about"), [(row["name"], row["about"]) for row in scripts]),
    ])  # fmt: skip


def _loaded(
    system: BallSystem | str | Path,
    overrides: Mapping[str, Any] | None,
    against: Sequence[str | Mapping[str, Any]],
) -> BallSystem:
    from mdnum.systems import load

    system = load(system, overrides, world="ball")
    for changes in against:
        one = (
            [assigned(changes, "--against precision.state=float32")] if isinstance(changes, str) else changes
        )
        system = system.against(dict(one))
    return system


def _simulate(problem: BallProblem, progress: Progress | None) -> tuple[BallRun, float | None]:
    """Simulate a ball. Return the run, and its steps per second (None for short runs)."""
    marks: list[tuple[float, int]] = []

    def rate() -> float | None:
        if len(marks) < 2 or marks[-1][0] == marks[0][0]:
            return None
        return (marks[-1][1] - marks[0][1]) / (marks[-1][0] - marks[0][0])

    def note(made: int, steps: int) -> None:
        marks.append((time.perf_counter(), made))
        speed = rate()
        frame.say(progress, "run", made, steps, **({} if speed is None else {"steps_per_second": speed}))

    frame.say(progress, "compile")
    world = problem.world
    rule = getattr(world.contact, "stop", None) or getattr(world.integrator, "stop", None)
    cap = 0 if rule is None else rule.max_iter
    run = problem.run(
        history=cap > 0 and problem.steps * (cap + 1) <= _RESIDUALS,
        keep=np.size(problem.y0) * problem.steps <= _STATES,
        progress=note,
    )
    return run, rate()


def _differentiated(
    simulation: BallSimulation, run: BallRun, progress: Progress | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the loss, derivatives, variants, and a table of height differences."""
    from mdnum.ball.rollout import first_difference
    from mdnum.verbs import ball_record

    problem, asked = simulation.problem, simulation.system.spec.gradient
    frame.say(progress, "gradient", run.steps)
    gradient = gradients(problem, asked)
    variants, apart = [], []
    for variant in simulation.variants:
        frame.say(progress, f"variant {variant.name}", run.steps)
        # without histories: the program is then the one that its gradient runs, and is compiled once
        other = variant.problem.run(keep=run.kept)
        found = first_difference(run, other)
        apart.append(ball_record.separations(variant.name, found))
        theirs = gradients(variant.problem, asked, first=True)
        described = ball_record.compared(variant, found, other, gradient, theirs)
        variants.append({**described, "loss": loss(variant.problem, theirs)})
    empty = {"variant": np.zeros(0, str), "step": np.zeros(0, int), "separation": np.zeros(0)}
    rows = {name: np.concatenate([one[name] for one in apart] or [none]) for name, none in empty.items()}
    made = {
        "loss": loss(problem, gradient),
        "gradient": gradient,
        "exact": ball_record.exact(simulation.system, run, gradient),
        "variants": variants,
    }
    return made, rows


def gradients(problem: BallProblem, asked: Any, first: bool = False) -> list[dict[str, Any]]:
    """Return the derivatives by each requested method, as plain values.

    Args:
        asked: the [gradient] table.
        first: only the first method.
    """
    from mdnum.gradients.ball import compare

    if not asked.of:
        return []
    made = compare(problem, asked.of, asked.methods[: 1 if first else None])
    empty = {"value": None, "gradient": {}, "depends": {}}
    found: list[dict[str, Any]] = [
        {
            "method": one.method, "says": one.description, "value": float(one.value),
            "gradient": {name: float(value) for name, value in one.gradient.items()},
            "depends": {name: bool(value) for name, value in one.depends.items()},
            "why": dict(one.notes), "details": dict(one.details), "refused": False,
        }
        for one in made
    ]  # fmt: skip
    # a method that does not apply says why; the others are still worth having
    found += [{"method": name, "says": why, **empty, "refused": True} for name, why in made.refused.items()]
    return found


def loss(problem: BallProblem, gradient: Sequence[Mapping[str, Any]]) -> float:
    """Return the loss. A gradient method may have computed the loss already."""
    same = ("unrolled", "frozen", "event-aware")
    known = [made["value"] for made in gradient if made["method"] in same and not made["refused"]]
    return known[0] if known else problem.value()


# --- judged -------------------------------------------------------------------------------------------


def judge(view: BallView) -> Verdict:
    """Return findings on a ball's run, and evidence that the run is correct."""
    summary = view.summary
    rules = (
        _finite, _ledger, _finite_gradient, _independent, _ambiguous, _cap, _disagree, _forks, _iterations,
        _resting, _remarks,
    )  # fmt: skip
    found = [finding for rule in rules for finding in rule(view)]
    sizes = {"balls": summary["balls"], "steps": summary["steps"]}
    return conclude(
        [*found, *view.kept(TEXTS.entries)],
        _evidence(view, {finding.code for finding in found}),
        headline=TEXTS("headline", contacts=summary["flips_entered"], **sizes),
        best="good",
    )


def _evidence(view: BallView, codes: set[str]) -> Iterator[str]:
    summary, exact = view.summary, view.exact
    flips = summary["flips_entered"] + summary["flips_left"]
    if "LEDGER_INCOMPLETE" not in codes:
        yield TEXTS("flips", flips=flips, steps=summary["steps"])
    solves = view.ended
    if solves and not view.located:
        ways = listed([f"{word} {count(n)}" for word, n in solves.items()])
        yield TEXTS("solves", solves=sum(solves.values()), ways=ways)
    if not summary["ambiguous"]:
        yield TEXTS("rounding")
        ratio = view.ratio
        if np.any(np.isfinite(ratio)):
            yield TEXTS("nearest_flip", ratio=float(ratio[np.isfinite(ratio)].min()))
        if summary["smallest_stop_margin"] is not None:
            yield TEXTS("nearest_stop", margin=summary["smallest_stop_margin"])
    if exact:
        yield TEXTS("exact", end=exact["height_error"], most=exact["height_error_largest"])
    for name, slope in (exact.get("gradient") or {}).items():
        met = [one["method"] for one in view.applied if not differs(one["gradient"].get(name), slope)]
        if met:
            yield TEXTS("met", names=name, methods=listed(met))


def differs(first: float | None, second: float | None) -> bool:
    """True if two derivatives differ by more than one percent, or if one is None."""
    if first is None or second is None:
        return first is not second
    return abs(first - second) > _DISAGREE * max(abs(first), abs(second))


def _finite(view: BallView) -> Iterator[Finding]:
    broken = view.summary["not_finite"]
    if broken is None and view.ended.get("not finite"):
        broken = view.first_step("not finite")
    if broken is not None:
        yield TEXTS.finding("NOT_FINITE", step=broken)


def _ledger(view: BallView) -> Iterator[Finding]:
    series, contacts = view.table("steps"), view.table("contacts")
    flips = int(series["entered"].sum(dtype=np.int64) + series["left"].sum(dtype=np.int64))
    by_ball = {**contacts, "i": contacts["ball"], "j": np.zeros_like(contacts["ball"])}
    sound = analysis.algebra_holds({**series, "pairs": series["contacts"]})
    if not sound.all():
        yield TEXTS.finding("LEDGER_INCOMPLETE", "balance", step=int(series["step"][np.argmin(sound)]))
    elif flips != len(contacts["ball"]):
        yield TEXTS.finding("LEDGER_INCOMPLETE", "rows", flips=flips, rows=len(contacts["ball"]))
    elif not analysis.scan(by_ball, len(series["step"])).alternates:
        yield TEXTS.finding("LEDGER_INCOMPLETE", "twice")


def _finite_gradient(view: BallView) -> Iterator[Finding]:
    found = [
        f"d/d{name} by {made['method']}"
        for made in view.applied
        for name, value in made["gradient"].items()
        if value is None or not np.isfinite(value)
    ]
    if found:
        yield TEXTS.finding("GRADIENT_NOT_FINITE", which=listed(found))


def _independent(view: BallView) -> Iterator[Finding]:
    def unused(made: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(name for name, depends in (made.get("depends") or {}).items() if not depends)

    own = {f"by {made['method']}": unused(made) for made in view.applied}
    theirs = {f"in variant {variant['name']}": unused(variant) for variant in view.summary["variants"]}
    places = {place: names for place, names in (own | theirs).items() if names}
    if places:
        groups: dict[tuple[str, ...], list[str]] = {}
        for place, names in places.items():
            groups.setdefault(names, []).append(place)
        told = "; ".join(f"along {listed(names)} {listed(where)}" for names, where in groups.items())
        implicit = "by implicit" in places
        variants = ["only_implicit" if len(places) == 1 else "implicit"] if implicit else []
        variants += ["variant"] * (not any(own.get(place) for place in own))
        names = listed(list(dict.fromkeys(name for names in places.values() for name in names)))
        finding = TEXTS.finding(
            "LOSS_INDEPENDENT", *variants, names=names, places=listed(list(places)), told=told,
        )  # fmt: skip
        yield finding
    zero: dict[str, list[str]] = {}
    for made in view.applied:
        for name, value in made["gradient"].items():
            if value == 0 and (made.get("depends") or {}).get(name, True):
                zero.setdefault(name, []).append(made["method"])
    for name, methods in zero.items():
        yield TEXTS.finding("ZERO_GRADIENT", name=name, methods=listed(methods))


def _ambiguous(view: BallView) -> Iterator[Finding]:
    if contacts := view.summary["ambiguous_contacts"]:
        yield TEXTS.finding("AMBIGUOUS_CONTACTS", contacts=contacts)
    if stops := view.summary["ambiguous_stops"]:
        yield TEXTS.finding("AMBIGUOUS_STOPS", stops=stops)


def _cap(view: BallView) -> Iterator[Finding]:
    solves = view.ended
    if capped := solves.get("cap", 0):
        yield TEXTS.finding(
            "SOLVER_CAP", capped=capped, solves=sum(solves.values()),
            step=view.first_step("cap"), cap=(view.system.get("stop") or {}).get("max_iter", 0),
        )  # fmt: skip


def _disagree(view: BallView) -> Iterator[Finding]:
    exact = view.exact.get("gradient") or {}
    rows = {
        name: {made["method"]: made["gradient"][name] for made in view.applied
               if made["gradient"].get(name) is not None}
        for name in view.parameters
    }  # fmt: skip

    def told(names: Sequence[str]) -> str:
        sides = {name: rows[name] | ({"closed form": exact[name]} if name in exact else {}) for name in names}
        return "; ".join(
            f"dloss/d{name}: " + ", ".join(f"{method} {number(value)}" for method, value in row.items())
            for name, row in sides.items()
        )

    apart = [
        name for name, row in rows.items() if any(differs(x, y) for x in row.values() for y in row.values())
    ]
    off = [
        name
        for name, row in rows.items()
        if row and name not in apart and name in exact and differs(next(iter(row.values())), exact[name])
    ]
    if apart:
        right = [
            f"{method} on {name}"
            for name in apart
            for method, value in rows[name].items()
            if name in exact and not differs(value, exact[name])
        ]
        known = any(name in exact for name in apart)
        yield TEXTS.finding(
            "METHODS_DISAGREE", *(["right"] if right else ["none"] if known else []),
            names=listed([f"dloss/d{name}" for name in apart]), told=told(apart),
            right=listed(right) if right else "",
        )  # fmt: skip
    if off:
        yield TEXTS.finding("OFF_CLOSED_FORM", names=listed(off), told=told(off))


def _forks(view: BallView) -> Iterator[Finding]:
    own = (view.applied or [{"gradient": {}}])[0]["gradient"]
    forked = [variant for variant in view.summary["variants"] if variant["fork"] is not None]

    def rounding(variant: Mapping[str, Any]) -> bool:
        changes = variant["changes"]
        return bool(changes) and all(str(key).startswith("precision.") for key in changes)

    def moved(variant: Mapping[str, Any]) -> bool:
        return any(differs(value, own[name]) for name, value in variant["gradient"].items() if name in own)

    for precise in (True, False):
        group = [variant for variant in forked if rounding(variant) == precise]
        if not group:
            continue
        told = " ".join(
            TEXTS("fork", name=one["name"], what=decision(one), step=one["fork"], margin=one["margin"],
                  there=one["margin_there"])
            for one in group[:_NAMED]
        )  # fmt: skip
        words = ["precision"] * precise + ["others"] * (len(group) > _NAMED)
        words += ["moved"] * (precise and any(map(moved, group)))
        values: dict[str, Any] = {"variants": len(group), "told": told, "others": len(group) - _NAMED}
        yield TEXTS.finding("FORKED", *words, **values)


def _iterations(view: BallView) -> Iterator[Finding]:
    found = [variant for variant in view.summary["variants"] if variant["iterations_differ"]]
    if found:
        told = listed(
            [TEXTS("differs_at", name=one["name"], steps=one["iterations_differ"]) for one in found]
        )
        counted = "impacts" if view.located else "iterations"
        yield TEXTS.finding("ITERATIONS_DIFFER", counted=counted, told=told)


def _remarks(view: BallView) -> Iterator[Finding]:
    """Yield findings on valid settings that are probably not intended."""
    from pydantic import ValidationError

    from mdnum.systems.ball import BallSpec, remarks

    try:
        spec = BallSpec.model_validate(view.system)
    except ValidationError:
        # the file is gone or was edited since, which is said where the folder is read
        return
    for code, values in remarks(spec):
        yield TEXTS.finding(code, **values)


def _resting(view: BallView) -> Iterator[Finding]:
    series = view.table("steps")
    if view.ended.get("rest"):
        step = view.first_step("rest")
        rest = view.exact.get("rest_time")
        words = ["exact"] * (rest is not None)
        time = float(view.time(np.array(step)))
        yield TEXTS.finding("RESTING", *words, step=step, time=time, rest=rest)
        return
    off = series["contacts"] < view.summary["balls"]
    last = int(np.flatnonzero(off)[-1]) + 1 if off.any() else 0
    if len(off) - last > max(10, 0.05 * view.summary["steps"]):
        since = int(series["step"][last])
        yield TEXTS.finding("RESTING", "floor", step=since)


KINDS = {"ball": Verb(judge, page, BallView)}
