"""`mdnum ball` as a function: bounce a ball, compare variants and gradients, judge, show."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Figure, Key, Mark, Page, Plot, Role, Section, Series, Table, pairs
from mdnum.report.svg import FIRST, MUTED, SECOND
from mdnum.report.words import count, listed, many, number
from mdnum.workflow import frame
from mdnum.workflow.frame import Outcome, Progress, Verb, View

if TYPE_CHECKING:
    from mdnum.ball.problem import Problem
    from mdnum.ball.rollout import BallRun
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.build_ball import BallSimulation

TEXTS = Texts(__file__)
#: Balls times steps of which every state is kept, and residuals of stop decisions kept.
_STATES, _RESIDUALS = 20_000_000, 5_000_000
#: Relative difference from which on two derivatives disagree.
_DISAGREE = 0.01
#: Variants that a finding names one by one; rows of a table that the page carries.
_NAMED, _ROWS = 4, 5_000
_REASONS = ("", "none", "tolerance", "cap", "fixed", "not finite", "rest")


def bounce(
    system: BallSystem | str | Path,
    *,
    out: str | Path | None = None,
    steps: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    against: Sequence[str | Mapping[str, Any]] = (),
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Run a ball's system and its variants, record every contact and stop decision, and write a report.

    Args:
        system: a loaded system, a shipped name or the path of a system file.
        out: the new run folder; default runs/<name>-<n>.
        steps: instead of the system's.
        overrides: dotted keys to values, such as {"contact.k": 2e4}.
        against: further variants to compare with: "key=value", or several keys in a mapping.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Returns:
        the run's folder, summary and page; `result` is the `BallRun`.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
    """
    from mdnum.systems.build_ball import build_ball
    from mdnum.workflow import ball_record

    simulation = build_ball(_loaded(system, overrides, against), steps=steps)
    with frame.new_folder("ball", simulation.system.name, out, system=simulation.system) as folder:
        began = time.perf_counter()
        run, rate = _simulate(simulation.problem, progress)
        made, apart = _differentiated(simulation, run, progress)
        summary = ball_record.summarize(simulation, run) | made
        summary |= {"steps_per_second": rate, "seconds": time.perf_counter() - began}
        frame.store(folder, summary, ball_record.tables(run) | {"separations": apart})
    return frame.finish(folder, report=report, result=run, progress=progress)


def _loaded(
    system: BallSystem | str | Path,
    overrides: Mapping[str, Any] | None,
    against: Sequence[str | Mapping[str, Any]],
) -> BallSystem:
    from mdnum.systems import BallSystem, System, load

    if isinstance(system, System):
        raise InputError("this system is molecular dynamics", where=system.name, remedy="Use mdnum.run")
    if isinstance(system, BallSystem):
        if overrides:
            raise InputError(
                "overrides change a system while it is loaded",
                remedy="Load it with the overrides, or give its name",
                where=system.name,
            )
    else:
        system = load(system, overrides, world="ball")
    for changes in against:
        system = system.against(_changes(changes) if isinstance(changes, str) else changes)
    return system


def _changes(text: str) -> dict[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(
            f"--against {text!r} is not of the form key=value",
            remedy="Write for example --against precision.state=float32",
        )
    return {key.strip(): value.strip()}


def _simulate(problem: Problem, progress: Progress | None) -> tuple[BallRun, float | None]:
    """The run, and steps per second after the part that holds the compilation (None for a short one)."""
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
    """Loss, derivatives, closed form and variants; and the separations from the variants."""
    from mdnum.ball.rollout import first_difference
    from mdnum.workflow import ball_record

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


def gradients(problem: Problem, asked: Any, first: bool = False) -> list[dict[str, Any]]:
    """Each derivative that was asked for, as a plain mapping.

    Args:
        problem: of what.
        asked: the [gradient] table.
        first: only the first method.
    """
    from mdnum.gradients.ball import compare

    if not asked.of:
        return []
    made = compare(problem, asked.of, asked.methods[: 1 if first else None])
    found: list[dict[str, Any]] = [
        {
            "method": one.method,
            "says": one.description,
            "value": float(one.value),
            "gradient": {name: float(value) for name, value in one.gradient.items()},
            "depends": {name: bool(value) for name, value in one.depends.items()},
            "why": dict(one.notes),
            "details": dict(one.details),
            "refused": False,
        }
        for one in made
    ]
    # a method that does not apply says why; the others are still worth having
    for name, why in made.refused.items():
        found.append(
            {"method": name, "says": why, "value": None, "gradient": {}, "depends": {}, "refused": True}
        )
    return found


def loss(problem: Problem, gradient: Sequence[Mapping[str, Any]]) -> float:
    """The loss, taken from a derivative of the program itself where there is one: it is compiled already."""
    same = ("unrolled", "frozen", "event-aware")
    known = [made["value"] for made in gradient if made["method"] in same and not made["refused"]]
    return known[0] if known else problem.value()


# --- judged -------------------------------------------------------------------------------------------


def judge(view: View) -> Verdict:
    """Findings, and what is right, from the folder alone."""
    summary = view.summary
    rules = (
        _finite, _ledger, _finite_gradient, _independent, _ambiguous, _cap, _disagree, _forks, _iterations,
        _resting,
    )  # fmt: skip
    found = [finding for rule in rules for finding in rule(view)]
    sizes = {"balls": summary["balls"], "steps": summary["steps"]}
    return conclude(
        [*found, *view.kept(TEXTS.entries)],
        _evidence(view, {finding.code for finding in found}),
        headline=TEXTS("headline", contacts=summary["flips_entered"], **sizes),
        best="good",
    )


def _evidence(view: View, codes: set[str]) -> Iterator[str]:
    summary, exact = view.summary, view.summary["exact"] or {}
    flips = summary["flips_entered"] + summary["flips_left"]
    if "LEDGER_INCOMPLETE" not in codes:
        yield TEXTS("flips", flips=flips, steps=summary["steps"])
    ended = _ended(view)
    if ended and not _located(view):
        ways = listed([f"{word} {count(n)}" for word, n in ended.items()])
        yield TEXTS("solves", solves=sum(ended.values()), ways=ways)
    if not summary["ambiguous"]:
        yield TEXTS("rounding")
        ratio = _ratio(view)
        if np.any(np.isfinite(ratio)):
            yield TEXTS("nearest_flip", ratio=float(ratio[np.isfinite(ratio)].min()))
        if summary["smallest_stop_margin"] is not None:
            yield TEXTS("nearest_stop", margin=summary["smallest_stop_margin"])
    if exact:
        yield TEXTS("exact", end=exact["height_error"], most=exact["height_error_largest"])
    for name, slope in (exact.get("gradient") or {}).items():
        met = [one["method"] for one in _applied(view) if not differs(one["gradient"].get(name), slope)]
        if met:
            yield TEXTS("met", names=name, methods=listed(met))


def differs(first: float | None, second: float | None) -> bool:
    """Whether two derivatives differ by more than one percent of the larger; missing ones differ."""
    if first is None or second is None:
        return first is not second
    return abs(first - second) > _DISAGREE * max(abs(first), abs(second))


def _finite(view: View) -> Iterator[Finding]:
    broken = view.summary["not_finite"]
    if broken is None and _ended(view).get("not finite"):
        broken = _first(view, "not finite")
    if broken is not None:
        yield TEXTS.finding("NOT_FINITE", step=broken)


def _ledger(view: View) -> Iterator[Finding]:
    series, contacts = view.table("steps"), view.table("contacts")
    change = series["entered"].astype(np.int64) - series["left"].astype(np.int64)
    wrong = series["contacts"] != series["contacts"][0] + np.cumsum(change) - change[0]
    flips = int(series["entered"].sum(dtype=np.int64) + series["left"].sum(dtype=np.int64))
    order = np.lexsort((contacts["step"], contacts["ball"]))
    ball, entered = contacts["ball"][order], contacts["entered"][order].astype(bool)
    section = "Contacts"
    if wrong.any():
        step = int(series["step"][np.argmax(wrong)])
        yield TEXTS.finding("LEDGER_INCOMPLETE", "balance", step=step, section=section)
    elif flips != len(ball):
        yield TEXTS.finding("LEDGER_INCOMPLETE", "rows", flips=flips, rows=len(ball), section=section)
    elif np.any((ball[1:] == ball[:-1]) & (entered[1:] == entered[:-1])):
        yield TEXTS.finding("LEDGER_INCOMPLETE", "twice", section=section)


def _finite_gradient(view: View) -> Iterator[Finding]:
    found = [
        f"d/d{name} by {made['method']}"
        for made in _applied(view)
        for name, value in made["gradient"].items()
        if value is None or not np.isfinite(value)
    ]
    if found:
        yield TEXTS.finding("GRADIENT_NOT_FINITE", which=listed(found), section="Gradient")


def _independent(view: View) -> Iterator[Finding]:
    def unused(made: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(name for name, depends in (made.get("depends") or {}).items() if not depends)

    own = {f"by {made['method']}": unused(made) for made in _applied(view)}
    theirs = {f"in variant {variant['name']}": unused(variant) for variant in view.summary["variants"]}
    places = {place: names for place, names in (own | theirs).items() if names}
    if places:
        groups: dict[tuple[str, ...], list[str]] = {}
        for place, names in places.items():
            groups.setdefault(names, []).append(place)
        told = "; ".join(f"along {listed(names)} {listed(where)}" for names, where in groups.items())
        variants = ["implicit"] * ("by implicit" in places)
        variants += ["variant"] * (not any(own.get(place) for place in own))
        names = listed(list(dict.fromkeys(name for names in places.values() for name in names)))
        finding = TEXTS.finding(
            "LOSS_INDEPENDENT", *variants, names=names, places=listed(list(places)), told=told,
            section="Gradient",
        )  # fmt: skip
        yield finding
    zero: dict[str, list[str]] = {}
    for made in _applied(view):
        for name, value in made["gradient"].items():
            if value == 0 and (made.get("depends") or {}).get(name, True):
                zero.setdefault(name, []).append(made["method"])
    for name, methods in zero.items():
        yield TEXTS.finding("ZERO_GRADIENT", name=name, methods=listed(methods), section="Gradient")


def _ambiguous(view: View) -> Iterator[Finding]:
    section = "Margins of decisions"
    if contacts := view.summary["ambiguous_contacts"]:
        yield TEXTS.finding("AMBIGUOUS_CONTACTS", contacts=contacts, section=section)
    if stops := view.summary["ambiguous_stops"]:
        yield TEXTS.finding("AMBIGUOUS_STOPS", stops=stops, section=section)


def _cap(view: View) -> Iterator[Finding]:
    ended = _ended(view)
    if capped := ended.get("cap", 0):
        values: dict[str, Any] = {"capped": capped, "solves": sum(ended.values()), "step": _first(view, "cap")}
        values["cap"] = (view.system.get("stop") or {}).get("max_iter", 0)
        yield TEXTS.finding("SOLVER_CAP", section="Iterations per step", **values)


def _disagree(view: View) -> Iterator[Finding]:
    exact = (view.summary["exact"] or {}).get("gradient") or {}
    rows = {
        name: {made["method"]: made["gradient"][name] for made in _applied(view)
               if made["gradient"].get(name) is not None}
        for name in _parameters(view)
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
            "METHODS_DISAGREE", *(["right"] if right else ["none"] if known else []), section="Gradient",
            names=listed([f"dloss/d{name}" for name in apart]), told=told(apart),
            right=listed(right) if right else "",
        )  # fmt: skip
    if off:
        section = "Against the closed form"
        yield TEXTS.finding("OFF_CLOSED_FORM", names=listed(off), told=told(off), section=section)


def _forks(view: View) -> Iterator[Finding]:
    own = (_applied(view) or [{"gradient": {}}])[0]["gradient"]
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
            TEXTS("fork", name=one["name"], what=_decision(one), step=one["fork"], margin=one["margin"],
                  there=one["margin_there"])
            for one in group[:_NAMED]
        )  # fmt: skip
        words = ["precision"] * precise + ["others"] * (len(group) > _NAMED)
        words += ["moved"] * (precise and any(map(moved, group)))
        values: dict[str, Any] = {"variants": len(group), "told": told, "others": len(group) - _NAMED}
        yield TEXTS.finding("FORKED", *words, section="Variants", **values)


def _iterations(view: View) -> Iterator[Finding]:
    found = [variant for variant in view.summary["variants"] if variant["iterations_differ"]]
    if found:
        told = listed(
            [TEXTS("differs_at", name=one["name"], steps=one["iterations_differ"]) for one in found]
        )
        counted = "impacts" if _located(view) else "iterations"
        yield TEXTS.finding("ITERATIONS_DIFFER", counted=counted, told=told, section="Variants")


def _resting(view: View) -> Iterator[Finding]:
    series, section = view.table("steps"), "Heights and contacts"
    if _ended(view).get("rest"):
        step = _first(view, "rest")
        rest = (view.summary["exact"] or {}).get("rest_time")
        words = ["exact"] * (rest is not None)
        time = float(_time(view, np.array(step)))
        yield TEXTS.finding("RESTING", *words, step=step, time=time, rest=rest, section=section)
        return
    off = series["contacts"] < view.summary["balls"]
    last = int(np.flatnonzero(off)[-1]) + 1 if off.any() else 0
    if len(off) - last > max(10, 0.05 * view.summary["steps"]):
        since = int(series["step"][last])
        yield TEXTS.finding("RESTING", "floor", step=since, section=section)


def _applied(view: View) -> list[Mapping[str, Any]]:
    """Derivatives by method, without those that do not apply."""
    return [made for made in view.summary["gradient"] if not made["refused"]]


def _parameters(view: View) -> list[str]:
    return list(dict.fromkeys(name for made in _applied(view) for name in made["gradient"]))


def _ended(view: View) -> dict[str, int]:
    return {word: n for word, n in view.summary["ended"].items() if n and word != "none"}


def _located(view: View) -> bool:
    """Whether impacts are located inside a step: what is counted are impacts, not iterations."""
    return view.summary["integrator"] == "event-located"


def _first(view: View, reason: str) -> int:
    series = view.table("steps")
    return int(series["step"][np.argmax(series["reason"].astype(str) == reason)])


def _time(view: View, step: np.ndarray) -> np.ndarray:
    return np.interp(step, view.table("steps")["step"], view.table("steps")["time"])


def _ratio(view: View) -> np.ndarray:
    """|margin| of each contact flip in units of its rounding bound."""
    contacts = view.table("contacts")
    margin, bound = np.abs(contacts["margin"]), contacts["bound"]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(bound > 0, margin / bound, np.where(margin > 0, np.inf, 0.0))


def _decision(variant: Mapping[str, Any]) -> str:
    return variant["channel"] + ("" if variant["ball"] is None else f", ball {variant['ball']}")


# --- shown --------------------------------------------------------------------------------------------


def page(view: View, verdict: Verdict) -> Page:
    """Heights, solver, margins, derivatives, closed form, variants, and every decision."""
    summary = view.summary
    about = TEXTS(
        "about", balls=summary["balls"], steps=summary["steps"], contact=summary["contact_kind"],
        integrator=summary["integrator"].replace("-", " "),
    )  # fmt: skip
    described = [str(view.system["about"])] if view.system.get("about") else []
    sections = [
        Section("Heights and contacts", [*described, *_plots(view, _heights, _nearest)]),
        Section("Impacts per step" if _located(view) else "Iterations per step", _plots(view, _solver_plot)),
        Section("Margins of decisions", _plots(view, _stops, _flips)),
        Section("Gradient", list(_gradient(view)), terminal=True),
        Section("Against the closed form", list(_exact(view)), terminal=True),
        Section("Variants", list(_variants(view)), terminal=True),
        Section("Contacts", list(_contacts(view))),
        Section("Stop decisions", list(_stop_decisions(view))),
    ]
    return Page(
        view.name, about, list(_keys(view)), [section for section in sections if section.parts],
        view.system_toml, view.folder.provenance,
    )  # fmt: skip


def _keys(view: View) -> Iterator[Key]:
    summary, first = view.summary, view.summary["first_contact"]
    when = "none begins" if first is None else f"first at step {count(first)}"
    yield Key("Contacts", count(summary["flips_entered"]), when)
    total = count(summary["iterations_total"])
    if _located(view):
        yield Key("Impacts", total, "located inside steps")
    else:
        most = f"{count(summary['iterations_max'])} at most in a step"
        yield Key("Iterations", total, most if _ended(view) else "nothing is solved")
    yield Key("Ambiguous", count(summary["ambiguous"]), "decisions within rounding")
    yield Key("Loss", number(summary["loss"], 6), summary["loss_kind"])
    error = (summary["exact"] or {}).get("height_error_largest")
    yield Key("Off closed form", number(error, 2), "there is none" if error is None else "m, at most")
    if summary["steps_per_second"] is not None:
        yield Key("Speed", number(summary["steps_per_second"]), "steps per second")


def _plots(view: View, *declared: Callable[[View], Plot | None]) -> list[Any]:
    return [plot for plot in (each(view) for each in declared) if plot is not None]


def _groups(
    x: np.ndarray, y: np.ndarray, *groups: tuple[np.ndarray, str, Role], mark: Mark = "points"
) -> tuple[Series, ...]:
    """A set of points for each group that has any finite ones."""
    return tuple(
        Series(label, x[mine], y[mine], mark, role)
        for mine, label, role in groups
        if np.any(mine & np.isfinite(y))
    )


def _heights(view: View) -> Plot | None:
    rows, series, contacts = view.table("heights"), view.table("steps"), view.table("contacts")
    balls = np.unique(rows["ball"]).astype(int).tolist()
    roles: tuple[Role, ...] = ("first", "second", "third")
    few = len(balls) <= len(roles)
    lines = []
    for n, ball in enumerate(balls):
        mine = rows["ball"] == ball
        label = f"ball {ball}" if few else "balls" if n == 0 else ""
        lines.append(Series(label, _time(view, rows["step"][mine]), rows["y"][mine], "line", roles[n * few]))
    if not balls:
        if not np.isfinite(series["mean_height"]).any():
            return None
        lines.append(Series("mean over the balls", series["time"], series["mean_height"]))
    entered = contacts["entered"].astype(bool) & (np.isin(contacts["ball"], balls) | (not balls))
    at = _time(view, contacts["step"][entered])
    # on the floor, where they are decided
    marks = [Series("contact begins", at, np.zeros(len(at)), "points", "bad")] if len(at) else []
    return Plot(
        "heights", "Heights against time", "time (s)", "height (m)", (*lines, *marks),
        caption=f"Heights of {many(len(balls), 'ball')}; a mark on the floor for each contact that begins.",
        horizontals=((0.0, "floor"),),
    )  # fmt: skip


def _nearest(view: View) -> Plot | None:
    series = view.table("steps")
    margin = series["min_margin"]
    if not np.isfinite(margin).any():
        return None
    doubtful = (series["ambiguous"] > 0, "a decision within rounding", "bad")
    return Plot(
        "nearest", "Margin of the nearest contact decision", "time (s)", "|height| decided on (m)",
        (Series("nearest height", series["time"], margin), *_groups(series["time"], margin, doubtful)),
        y_scale="log",
        caption="The height nearest to the floor that a step decided on: the nearer, the less it takes to "
        "decide otherwise.",
    )  # fmt: skip


def _solver_plot(view: View) -> Plot | None:
    series = view.table("steps")
    reason, iterations = series["reason"].astype(str), series["iterations"].astype(float)
    shown = _groups(
        series["time"], iterations, (reason == "tolerance", "ended by tolerance", "first"),
        (reason == "fixed", "a fixed count", "muted"), (reason == "cap", "gave up at the cap", "bad"),
        (reason == "not finite", "not finite", "bad"), (reason == "rest", "held at rest", "third"),
        ((reason == "none") & (iterations > 0), "impacts", "second"),
    )  # fmt: skip
    what = "impacts" if _located(view) else "iterations"
    title = f"{what.capitalize()} per step, by what ended them"
    return Plot("iterations", title, "time (s)", f"{what} per step", shown) if shown else None


def _stops(view: View) -> Plot | None:
    rows = view.table("solver")
    stopped, capped = rows["stopped"].astype(bool), rows["reason"].astype(str) == "cap"
    shown = _groups(
        _time(view, rows["step"]), rows["margin"].astype(float), (stopped, "stopped", "first"),
        (~stopped & ~capped, "continued", "second"), (~stopped & capped, "gave up", "bad"),
    )  # fmt: skip
    if not shown:
        return None
    return Plot(
        "stops", "Margins of stop decisions", "time (s)", "tolerance − residual", shown, y_scale="symlog",
        caption="Above zero the residual was below its tolerance and the solver stopped, below zero it "
        "continued. The scale is logarithmic to both sides of zero.",
        horizontals=((0.0, "tolerance"),),
    )  # fmt: skip


def _flips(view: View) -> Plot | None:
    ratio, contacts = _ratio(view), view.table("contacts")
    entered = contacts["entered"].astype(bool)
    shown = _groups(
        _time(view, contacts["step"]), ratio, (entered, "contact begins", "first"),
        (~entered, "contact ends", "second"),
    )  # fmt: skip
    if not shown:
        return None
    return Plot(
        "margins", "Margins of contact flips in units of rounding", "time (s)", "|margin| / rounding bound",
        shown, y_scale="log", horizontals=((1.0, "below: decided by rounding"),),
        caption="How far from the floor the height was when a contact began or ended, over the bound on its "
        "rounding error.",
    )  # fmt: skip


def _gradient(view: View) -> Iterator[Any]:
    names, exact = _parameters(view), view.summary["exact"] or {}
    if not names:
        yield TEXTS("no_gradient")
        return
    known = exact.get("gradient") or {}
    yield Figure(
        "gradient", "A panel for each parameter; the line is the closed form's derivative where it is known. "
        "An open circle: the loss does not depend on the parameter.",
        "; ".join(f"dloss/d{name} by {one['method']}: {number(one['gradient'].get(name))}"
                  for name in names for one in _applied(view)),
        lambda figure: _dots(view, figure), 0.5 + (0.55 + 0.25 * len(_applied(view))) * len(names),
    )  # fmt: skip

    def cell(made: Mapping[str, Any], name: str) -> Any:
        if not (made.get("depends") or {}).get(name, True):
            return "0 (does not depend)"
        error = made.get("details", {}).get("standard_error", {}).get(name)
        text = number(made["gradient"].get(name), 6)
        return text if error is None else f"{text} ± {number(error, 2)}"

    rows = [(one["method"], number(one["value"], 6), *(cell(one, name) for name in names), one["says"])
            for one in _applied(view)]  # fmt: skip
    if known:
        slopes = [number(known.get(name), 6) for name in names]
        rows.append(("closed form", "–", *slopes, "The derivative of the exact motion."))
    rows += [(one["method"], "–", *["does not apply"] * len(names), one["says"])
             for one in view.summary["gradient"] if one["refused"]]  # fmt: skip
    yield Table(("method", "loss", *(f"dloss/d{name}" for name in names), "which derivative it is"), rows)


def _dots(view: View, figure: Any) -> None:
    from mdnum.report import drawing

    made, names = _applied(view), _parameters(view)
    exact = (view.summary["exact"] or {}).get("gradient") or {}
    place = np.arange(len(made))[::-1]
    for axes, name in zip(figure.subplots(len(names), 1, squeeze=False)[:, 0], names, strict=True):
        values = np.array([np.nan if (x := one["gradient"].get(name)) is None else x for one in made], float)
        known = float(exact.get(name, np.nan))
        size = np.abs([x for x in (*values, known) if np.isfinite(x) and x])
        if len(size) > 1 and size.max() > 300 * size.min():
            axes.set_xscale("symlog", linthresh=size.min())
        axes.axvline(0, color=MUTED, lw=0.6)
        if np.isfinite(known):
            axes.axvline(known, color=SECOND, lw=1.2, label="closed form")
        for at, value, one in zip(place, values, made, strict=True):
            used = (one.get("depends") or {}).get(name, True)
            axes.plot(value, at, "o", color=FIRST if used else MUTED, mfc=None if used else "none", ms=6)
        axes.set_yticks(place, [one["method"] for one in made])
        axes.set_ylim(-0.6, len(made) - 0.4)
        axes.set_xlabel(f"dloss/d{name}")
        if name == names[0]:
            drawing.legend(axes)


def _exact(view: View) -> Iterator[Any]:
    exact = view.summary["exact"]
    if not exact:
        return
    labels = {
        "balls": "balls compared", "height_error": "height off at the end (m)",
        "height_error_largest": "height off at most (m)",
        "height_error_before_contact": "height off before the first contact (m)",
        "first_contact_time": "first contact (s)", "first_contact_step": "first contact of the run, step",
        "rest_time": "comes to rest (s)",
    }  # fmt: skip
    motion = ("motion", TEXTS(f"motion_{exact['model']}"))
    rows = [(label, number(exact[key], 6) if isinstance(exact[key], float) else exact[key])
            for key, label in labels.items() if key in exact]  # fmt: skip
    off = [
        (f"dloss/d{name} off by {method}", number(error, 2, signed=True))
        for method, errors in (exact.get("gradient_error") or {}).items()
        for name, error in errors.items()
    ]
    yield pairs([motion, *rows, *off])


def _variants(view: View) -> Iterator[Any]:
    variants, rows = view.summary["variants"], view.table("separations")
    if not variants:
        return
    roles: tuple[Role, ...] = ("first", "second", "third", "bad", "muted")
    if np.any(rows["separation"] > 0):
        names = list(dict.fromkeys(rows["variant"].astype(str).tolist()))
        lines = []
        for n, name in enumerate(names):
            mine = rows["variant"].astype(str) == name
            x, y = _time(view, rows["step"][mine]), rows["separation"][mine]
            lines.append(Series(name, x, y, "line", roles[n % len(roles)], n >= len(roles)))
        forks = [(float(_time(view, np.array(one["fork"]))), f"{one['name']} forks")
                 for one in variants if one["fork"] is not None]  # fmt: skip
        yield Plot(
            "separation", "Separation of the variants", "time (s)", "largest |difference| of heights (m)",
            tuple(lines), y_scale="log", verticals=tuple(forks),
            caption="Largest difference of heights between the run and each variant.",
        )  # fmt: skip
    slopes = list(variants[0]["gradient"])
    cells = [
        (
            one["name"], one["seed"], one["fork"], "none differs" if one["fork"] is None else _decision(one),
            one["margin"], one["margin_there"], one["separation_end"], one["iterations_differ"],
            number(one["loss"], 6),
            *("0 (does not depend)" if not one["depends"].get(name, True)
              else number(one["gradient"].get(name), 6) for name in slopes),
        )
        for one in variants
    ]  # fmt: skip
    heads = (
        "variant", "seed", "fork", "decision", "margin here", "margin there", "separation at the end (m)",
        "steps with other iterations", "loss", *(f"dloss/d{name}" for name in slopes),
    )  # fmt: skip
    yield Table(heads, cells)
    yield TEXTS("variants")


def _contacts(view: View) -> Iterator[Any]:
    """The contact flips nearest to the threshold, in the order of steps."""
    rows, ratio = view.table("contacts"), _ratio(view)
    if not len(ratio):
        yield TEXTS("no_contacts")
        return
    chosen = np.sort(np.argsort(ratio, kind="stable")[:_ROWS])
    columns: list[tuple[np.ndarray, int | None]] = [
        (rows[name][chosen].astype(int), None) for name in ("step", "ball", "entered")
    ]
    columns += [(rows[name][chosen].astype(float), 4) for name in ("height", "margin", "velocity")]
    columns.append((ratio[chosen].astype(float), 3))
    yield TEXTS("contacts", shown=len(chosen), rows=len(ratio))
    yield Browse(
        name="contacts",
        row_id="contact-rows",
        label="Search contacts",
        placeholder="ball 3, step:100..200, entered",
        columns=(
            Column(0, "step", kind="count"),
            Column(1, "ball", kind="count"),
            Column(2, "decision", kind="word", words=("left", "entered"), colors=("out", "in")),
            Column(3, "height", "m"),
            Column(4, "margin", "m"),
            Column(5, "velocity", "m/s"),
            Column(6, "margin", "÷ bound", digits=2, missing="∞"),
        ),
        rows=plain_rows(columns),
        words={"entered": (2, 1), "in": (2, 1), "left": (2, 0), "out": (2, 0)},
        ranges={"step": 0, "ball": 1},
        subjects=(1,),
        nouns=("ball",),
        ambiguous=6,
    )


def _stop_decisions(view: View) -> Iterator[Any]:
    """The stop decisions nearest to their tolerance, in the order of steps."""
    rows = view.table("solver")
    if not len(rows["step"]):
        return
    near = np.abs(rows["margin"].astype(float))
    chosen = np.sort(np.argsort(near, kind="stable")[:_ROWS])
    codes = np.array([_REASONS.index(word) for word in rows["reason"].astype(str)[chosen].tolist()], int)
    columns: list[tuple[np.ndarray, int | None]] = [
        (rows[name][chosen].astype(int), None) for name in ("step", "ball", "iteration")
    ]
    columns += [(rows[name][chosen].astype(float), 5) for name in ("residual", "margin")]
    columns += [(rows["stopped"][chosen].astype(int), None), (codes, None)]
    each = bool(np.any(rows["ball"] >= 0))
    shown = [
        Column(0, "step", kind="count"), Column(1, "ball", kind="count"),
        Column(2, "iteration", kind="count"),
        Column(3, "residual", digits=4), Column(4, "margin", "tolerance − residual", digits=3),
        Column(5, "decision", kind="word", words=("continued", "stopped"), colors=("out", "in")),
        Column(6, "ended by", kind="word", words=("", *_REASONS[1:])),
    ]  # fmt: skip
    yield TEXTS("stops", shown=len(chosen), rows=len(near))
    yield Browse(
        name="stops",
        row_id="stop-rows",
        label="Search stop decisions",
        placeholder="step:100..200, iteration:5.., stopped, cap",
        columns=tuple(column for column in shown if each or column.at != 1),
        rows=plain_rows(columns),
        words={"stopped": (5, 1), "continued": (5, 0), "tolerance": (6, 2), "cap": (6, 3), "fixed": (6, 4),
               "rest": (6, 6)},
        ranges={"step": 0, "ball": 1, "iteration": 2},
    )  # fmt: skip


VERBS = {"ball": Verb(judge, page)}
