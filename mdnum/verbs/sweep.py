"""`mdnum sweep`: which choices move which results, which do not, and the cheapest setting that is enough."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.plain import plain
from mdnum.provenance import cores, hashes
from mdnum.sweeps.advice import advise
from mdnum.sweeps.design import Axis, Design, Point, checked, label, parse, points, with_base
from mdnum.sweeps.engines import computed
from mdnum.sweeps.measures import USUAL, chosen
from mdnum.sweeps.points import Workspace, address_of, gone, state_point
from mdnum.sweeps.statistics import SeedMean, corrected, differences, effects, estimates
from mdnum.systems.toml import flat
from mdnum.verbs import frame
from mdnum.verbs.frame import Keep, Outcome, Verb
from mdnum.verbs.sweep_page import FREE, judge, page
from mdnum.verbs.sweep_worker import Task, enough, resolved, work

if TYPE_CHECKING:
    from mdnum.systems import System
    from mdnum.systems.simulation import Simulation

#: Seeds where none are asked for, and frames of a run that positions are measured from.
SEEDS, _FRAMES = 4, 200
#: What is asked where nothing else is.
_USUAL: Mapping[str, Any] = {
    "seeds": SEEDS, "measure": USUAL, "steps": None, "design": "one-at-a-time", "samples": 16,
    "tolerance": None, "converged": None, "save_every": None,
}  # fmt: skip
#: Points of one setting that a worker is given at a time.
_TOGETHER = 8
#: Seconds between looks at points that another sweep computes.
_LOOK = 1.0


@dataclass(frozen=True)
class _Planned:
    """A point with where it is stored."""

    point: Point
    settings: Mapping[str, Any]  # keys of the system file
    state: Mapping[str, Any]
    address: str
    wrong: str = ""  # why it cannot be run


@frame.keywords_checked
def sweep(
    system: Simulation | System | str | Path,
    over: Mapping[str, Sequence[Any]] | Sequence[str] | str,
    *,
    seeds: int | Sequence[int] = SEEDS,
    measure: Sequence[str] | str = USUAL,
    steps: int | None = None,
    design: Design = "one-at-a-time",
    samples: int = 16,
    tolerance: Mapping[str, float] | float | None = None,
    converged: Mapping[str, str] | None = None,
    on: str | Executor | None = None,
    workers: int | None = None,
    points_in: str | Path | None = None,
    save_every: int | None = None,
    keep_runs: bool = False,
    **keep: Unpack[Keep],
) -> Outcome:
    """Which choices move which results, by how many errors; and the cheapest setting that is enough.

    Points are stored by what they are made of: of the same sweep with more values, seeds or measures only
    what is new is computed, and one that was stopped goes on when it is asked again.

    Example:
        >>> mdnum.sweep("argon/liquid-864", {"dynamics.timestep": [0.001, 0.002, 0.004]}, seeds=8)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file.
        over: values by key of the system file, or texts as on the command line: "cutoff.radius=7:9:0.5",
            "dynamics.timestep=0.001,0.002", "precision".
        seeds: how many, or which, `dynamics.seed` has: each draws velocities and noise anew.
        measure: names of `mdnum.sweeps.measures.MEASURES`.
        steps: of a run at the system's own time step, default the system's: all runs take the same time.
        design: "one-at-a-time" around the system's own values, "factorial", or "space-filling" between the
            ends of each choice.
        samples: of a space-filling design, a power of two.
        tolerance: how far a result may be from the converged one: by measure in its unit, or one number as a
            share of each measure's size. Without it nothing is recommended.
        converged: the end of an axis that counts as converged, by key: "largest", "smallest" or a value;
            default the largest cutoff, the smallest time step, the largest system, double precision.
        on: where to compute: tcp://host:port of a dask scheduler, or any `concurrent.futures.Executor`;
            default processes of this machine.
        workers: processes; default one for each core.
        points_in: folder of the points, which sweeps may share; default "sweep-points" beside the new folder.
        save_every: steps between frames, where a measure needs frames; default 200 frames a run.
        keep_runs: keep the run folder of each point.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        its tables are points, estimates, differences and settings.

    Raises:
        InputError: a choice, a measure or an engine that there is not, or a system that cannot be run.
        FolderError: a folder cannot be used.
    """
    asked = {
        "seeds": seeds, "measure": measure, "steps": steps, "design": design, "samples": samples,
        "tolerance": tolerance, "converged": converged, "save_every": save_every,
    }  # fmt: skip
    plan = _plan(system, over, asked, keep.get("overrides"))
    system_name = plan["name"]
    with frame.answering("sweep", f"sweep-{system_name}", plan["loaded"], **keep) as answer:
        root = Path(points_in) if points_in is not None else answer.folder.path.parent / "sweep-points"
        place = Workspace(root)
        place.swept()
        counts = _compute(place, plan, answer.log, on, workers, keep_runs, bool(keep.get("allow_code")))
        answer.tables, answer.summary = _analyzed(place, plan)
        answer.summary |= {**counts, "points_in": str(root), "workers": workers or cores()}
    return answer.outcome


def command(system: str, *, over: Sequence[str] = (), dry_run: bool = False, **given: Any) -> Any:
    """`mdnum sweep`: options as texts."""
    for name in ("tolerance", "converged"):
        if texts := given.pop(name, None):
            given[name] = _assignments(name, frame.words(texts))
    if (text := given.pop("seeds", None)) is not None:
        given["seeds"] = text
    if texts := given.pop("measure", None):
        given["measure"] = frame.words(texts)
    if dry_run:
        return _told(system, over, given)
    return sweep(system, over, **given)


def _assignments(name: str, texts: Sequence[str]) -> Any:
    from mdnum.verbs import assigned

    if name == "tolerance" and len(texts) == 1 and "=" not in texts[0]:
        return float(texts[0])
    made = dict(assigned(text, f"--{name} energy=0.01") for text in texts)
    return {key: float(value) for key, value in made.items()} if name == "tolerance" else made


def _told(system: str, over: Sequence[str], given: dict[str, Any]) -> Any:
    """What a sweep would compute: points, those that are there, time and disk."""
    from mdnum.verbs import Reply

    where = given.pop("points_in", None) or Path(given.get("out") or "runs/x").parent / "sweep-points"
    workers = given.get("workers") or cores()
    plan = _plan(system, over, {**_USUAL, **given}, given.get("overrides"))
    place = Workspace(Path(where)) if Path(where).is_dir() else None
    stored = [place.result(one.address) if place else None for one in plan["planned"]]
    missing = sum(not enough(one, plan["measures"]) for one in stored)
    known = [one["seconds"] for one in stored if one and one["status"] == "complete"]
    # a run without one to go by: two million atom-steps a second on one core, and what it takes to begin
    each = float(np.median(known)) if known else plan["atoms"] * plan["last"] / 2e6 + 2.0
    bytes_each = 120 * plan["last"] + 2e4
    document = {
        "points": len(plan["planned"]), "missing": missing, "seconds": missing * each / workers,
        "bytes": missing * bytes_each, "points_in": str(where),
    }  # fmt: skip
    rows = [("points", document["points"]), ("to be computed", missing),
            ("about", f"{document['seconds'] / 60:.1f} min by {workers} workers"
             + ("" if known else ", from a guess of two million atom-steps a second")),
            ("disk", f"{document['bytes'] / 1e6:.0f} MB in {where}")]  # fmt: skip
    return Reply({"kind": "sweep-plan", **document}, [("a sweep", ("", ""), rows)])


# --- the plan -------------------------------------------------------------------------------------------


def _plan(system: Any, over: Any, asked: Mapping[str, Any], overrides: Any) -> dict[str, Any]:
    """Everything that is decided before anything is computed.

    Args:
        asked: what `_USUAL` names.
    """
    from mdnum.systems import BallSystem, System, load
    from mdnum.systems.build import build
    from mdnum.systems.parameters import names, number, resolve
    from mdnum.systems.simulation import Simulation

    seeds, steps, design = asked["seeds"], asked["steps"], asked["design"]
    overrides = dict(overrides or {})
    measures = chosen(frame.words(asked["measure"]))
    texts = [over] if isinstance(over, str) else over
    if isinstance(texts, Mapping):
        axes = [checked(Axis(key, tuple(plain(list(values))))) for key, values in texts.items()]
    else:
        axes = [parse(text) for text in texts]
    if not axes:
        raise InputError("no choice is varied", remedy="Give --over KEY=VALUE,VALUE,…")
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    if not numbers:
        raise InputError("no seeds", remedy="Give 1 or more")
    if isinstance(system, System):
        # one that was loaded takes no overrides any more, its simulation does
        system, overrides = build(system, overrides), {}
    filed = not isinstance(system, Simulation)
    made: Any = load(system, overrides) if filed else system
    if isinstance(made, BallSystem):
        raise InputError("sweeps of a ball are not supported", where=made.name)
    own = flat(made.spec.model_dump(mode="json") if filed else made.program)

    def usual(axis: Axis) -> Any:
        if axis.key == "precision":
            return "float64"
        if own.get(axis.key) is not None:
            return own[axis.key]
        if not filed:
            return number(made, resolve(made, axis.key, names(made)))
        # a key that the file leaves to its default, or one that does not exist, as loading it says
        load(system, {**overrides, **axis.settings(axis.values[0])})
        return axis.values[0]

    base = {axis.key: usual(axis) for axis in axes}
    axes = [with_base(axis, base[axis.key]) for axis in axes] if design != "space-filling" else axes
    last = (made.spec.dynamics.steps if filed else made.steps) if steps is None else steps
    framed = any(one.needs == "frames" for one in measures)
    every = (asked["save_every"] or max(1, last // _FRAMES)) if framed else 0
    pace = float(own["dynamics.timestep"])
    planned = []
    for point in points(axes, base, numbers, design, asked["samples"]):
        settings: dict[str, Any] = {"dynamics.seed": point.seed}
        for axis in axes:
            value = point.choices[axis.key]
            if value != base[axis.key] or design == "space-filling":
                settings |= axis.settings(value)
        # of the same time, whatever the step: results would differ by how long they were waited for
        share = pace / float(settings.get("dynamics.timestep", pace))
        frames = max(1, round(every * share)) if every else 0
        run = {"steps": round(last * share), "save_every": frames}
        planned.append(_placed(made, system, overrides, point, settings, run))
    return {
        "loaded": made, "name": made.name, "system": system, "overrides": overrides, "axes": axes,
        "base": base, "seeds": numbers, "measures": [one.name for one in measures], "objects": measures,
        "design": design, "planned": planned, "last": last, "units": made.units.name,
        "atoms": len(made.atoms) if filed else made.atoms,
        "tolerance": asked["tolerance"], "converged": asked["converged"] or {},
    }  # fmt: skip


def _placed(made: Any, system: Any, overrides: Any, point: Point, settings: Any, asked: Any) -> _Planned:
    """A point with its address; one that cannot be made says why."""
    from mdnum.systems import load
    from mdnum.systems.simulation import Simulation

    try:
        if isinstance(made, Simulation):
            one: Any = resolved(made, settings)
        else:
            one = load(system, {**overrides, **settings})
    except MdnumError as error:
        return _Planned(point, settings, {}, "", str(error))
    program = json.loads(json.dumps(one.program))
    # what is asked of a run counts as asked, whatever its file says
    program.get("dynamics", {}).pop("steps", None)
    program.pop("record", None)
    state = state_point(program, hashes(one)["structure"], asked)
    return _Planned(point, settings, state, address_of(state))


# --- computing ------------------------------------------------------------------------------------------


def _compute(
    place: Workspace, plan: Mapping[str, Any], log: Any, on: Any, workers: int | None, keep: bool, code: bool
) -> dict[str, Any]:
    """Computes the points that are not there, and waits for those that another sweep computes."""
    wanted = {one.address: one for one in plan["planned"] if not one.wrong}
    missing = [a for a in wanted if not enough(place.result(a), plan["measures"])]
    missed = place.nearest(wanted[missing[0]].state) if missing and len(missing) < len(wanted) else None
    total, done, begun = len(missing), 0, monotonic()
    counts = {"computed": 0, "found": len(wanted) - total, "given_up": 0, "changed": missed or []}
    system = plan["system"]
    if not isinstance(system, str | Path):
        import cloudpickle

        system = cloudpickle.dumps(system)
    settings: dict[str, list[_Planned]] = {}
    for address in missing:
        one = wanted[address]
        settings.setdefault(json.dumps(dict(one.point.choices), sort_keys=True), []).append(one)
    several = max(1, min(_TOGETHER, -(-total // (2 * (workers or cores())))))
    groups = [many[k : k + several] for many in settings.values() for k in range(0, len(many), several)]

    def task(some: Sequence[_Planned]) -> Task:
        each = tuple({"address": o.address, "state": o.state, "settings": o.settings} for o in some)
        return Task(
            str(place.root.absolute()), each, str(system) if isinstance(system, Path) else system,
            plan["overrides"], tuple(plan["measures"]), keep, code,
        )  # fmt: skip

    def lost(one: Task, why: str) -> bool:
        # whose claim a dead process holds was at work on it; others were only waiting
        return any(gone(claim) for point in one.points for claim, _ in place.claims(point["address"]))

    def say() -> None:
        rate = done / (monotonic() - begun) if done else 0.0
        log(done, total, {"phase": "points", "unit": "points", "points_per_second": rate})

    busy: list[str] = []
    left = groups
    while left:
        say()
        again: list[list[_Planned]] = []
        for one, told in computed(work, [task(some) for some in left], on=on, workers=workers, lost=lost):
            if isinstance(told, BaseException):
                again += _after_a_loss(place, one, wanted, told, counts)
                done += sum(place.result(p["address"]) is not None for p in one.points)
                continue
            for each in told:
                if each["status"] == "full":
                    raise InputError(each["why"], remedy="Make room and give the command again: it goes on")
                counts["computed"] += each["status"] == "computed"
                done += each["status"] != "busy"
                busy += [each["address"]] * (each["status"] == "busy")
            say()
        left = again
        while busy:
            # what another sweep computes; of one that is gone it is computed here
            busy = [a for a in busy if not enough(place.result(a), plan["measures"])]
            free = [a for a in busy if all(gone(claim) for claim, _ in place.claims(a))]
            if free:
                left += [[wanted[a]] for a in free]
                busy = [a for a in busy if a not in free]
                break
            sleep(_LOOK)
    return counts


def _after_a_loss(
    place: Workspace, one: Task, wanted: Mapping[str, _Planned], error: BaseException, counts: dict[str, Any]
) -> list[list[_Planned]]:
    """Points of a task whose process died twice: the one that it was at work on is given up, others go on."""
    from mdnum.sweeps.points import write_result

    again = []
    for point in one.points:
        address = point["address"]
        if enough(place.result(address), one.measures):
            continue
        if any(gone(claim) for claim, _ in place.claims(address)):
            with place.claimed(address) as mine:
                if mine and place.result(address) is None:
                    why = f"its process ended twice without an answer ({type(error).__name__}): memory?"
                    with place.filling(address, point["state"]) as folder:
                        write_result(folder, {"status": "failed", "why": why, "measures": {}, "summary": {},
                                              "seconds": 0.0})  # fmt: skip
                    counts["given_up"] += 1
        else:
            again.append([wanted[address]])
    return again


# --- the answer -----------------------------------------------------------------------------------------


def _analyzed(place: Workspace, plan: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tables and summary from the points of a workspace."""
    axes, base, objects = plan["axes"], plan["base"], plan["objects"]
    rows, values, failures, speeds = [], {}, {}, {}
    for k, one in enumerate(plan["planned"]):
        setting = tuple(label(one.point.choices[axis.key]) for axis in axes)
        result = None if one.wrong else place.result(one.address)
        result = result or {"status": "failed", "why": one.wrong or "was not computed", "measures": {}}
        if result["status"] == "failed":
            failures.setdefault(result["why"], []).append(setting)
        elif "steps_per_second" in result["summary"]:
            told = result["summary"]
            speeds.setdefault(setting, []).append((told["steps_per_second"] or np.nan, told["lost_pairs"]))
        for measure in objects:
            found = result["measures"].get(measure.name, {"value": None, "why": result.get("why", "")})
            rows.append({
                "point": k, "setting": ", ".join(setting), "seed": one.point.seed, "address": one.address,
                "measure": measure.name, "value": found["value"], "error": found.get("error"),
                "effective": found.get("effective"), "status": result["status"],
                "why": found.get("why", result.get("why", "")),
            })  # fmt: skip
            if found["value"] is not None:
                each = [
                    np.nan if found[name] is None else found[name] for name in ("value", "error", "effective")
                ]
                values.setdefault(measure.name, {}).setdefault(setting, []).append(each)
    means = {
        (name, setting): one for name, found in values.items() for setting, one in estimates(found).items()
    }
    origin = tuple(label(base[axis.key]) for axis in axes)
    compared = {
        (one.name, axis.key, label(value)): (means[one.name, setting], means[one.name, origin])
        for one in objects
        for axis, value, setting in _lines(axes, base)
        if (one.name, setting) in means and (one.name, origin) in means
    }
    found = corrected(_ends(plan, values)) if plan["design"] == "space-filling" else differences(compared)
    table = [
        {"measure": m, "choice": key, "setting": value, **asdict(one), "sigmas": one.sigmas,
         "moves": {True: "yes", False: "no", None: "undecided"}[one.moves]}
        for (m, key, value), one in found.items()
    ]  # fmt: skip
    tolerances, physical = _tolerances(plan, means, origin), {one.name for one in objects if one.physical}
    clear = [row for row in table if row["moves"] == "yes" and row["measure"] in physical]
    moving = {(row["choice"], row["setting"]) for row in clear}
    advices = _advices(plan, means, tolerances, origin, speeds, moving)
    tables = {
        "points": _columns(rows, ("seed",)),
        "estimates": [
            {"measure": m, "setting": ", ".join(at), **asdict(one)} for (m, at), one in means.items()
        ],
        "differences": table,
    }  # fmt: skip
    summary = {
        "system": plan["name"], "steps": plan["last"],
        **{name: plan[name] for name in ("units", "atoms", "design", "seeds")},
        "axes": [{"key": axis.key, "values": list(axis.values), "base": base[axis.key]} for axis in axes],
        "measures": [
            {"name": m.name, "unit": m.unit, "title": m.title, "physical": m.physical} for m in objects
        ],
        "settings": len({row["setting"] for row in rows}), "points": len(plan["planned"]),
        "failed": [{"why": why, "points": len(where), "settings": sorted({", ".join(w) for w in where})}
                   for why, where in failures.items()],
        "estimates": [
            {"measure": m, "setting": list(at), **_finite(asdict(one))} for (m, at), one in means.items()
        ],
        "differences": [_finite(row) for row in table],
        "tolerances": tolerances, "advice": advices,
        "speeds": [
            _finite({"setting": list(at), "steps_per_second": float(np.median(np.array(each)[:, 0])),
                     "lost_pairs": int(np.array(each)[:, 1].sum())})
            for at, each in speeds.items()
        ],
    }  # fmt: skip
    return tables, summary


def _columns(rows: Sequence[Mapping[str, Any]], whole: Sequence[str]) -> dict[str, Any]:
    """Rows as columns, numbers that are missing as NaN."""
    made: dict[str, Any] = {}
    for name in rows[0] if rows else ():
        each = [row[name] for row in rows]
        if any(isinstance(one, str) for one in each):
            made[name] = np.array([one or "" for one in each], dtype=str)
        elif name in (*whole, "point"):
            made[name] = np.array([-1 if one is None else one for one in each], np.int64)
        else:
            made[name] = np.array([np.nan if one is None else one for one in each], float)
    return made


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def _lines(axes: Sequence[Axis], base: Mapping[str, Any]) -> Iterator[tuple[Axis, Any, tuple[str, ...]]]:
    """Every value of each axis but the base's, with the labels of its setting, others at their base."""
    for axis in axes:
        for value in axis.values:
            if value != base[axis.key]:
                here = {**base, axis.key: value}
                yield axis, value, tuple(label(here[each.key]) for each in axes)


def _ends(plan: Mapping[str, Any], values: Mapping[str, Any]) -> dict[tuple[str, ...], Any]:
    """What each measure changes from end to end of each axis of a design that fills the space between."""
    axes, made = plan["axes"], {}
    at = {tuple(label(one.point.choices[a.key]) for a in axes): one.point.choices for one in plan["planned"]}

    def place(axis: Axis, value: Any) -> float:
        if axis.ordered:
            low, high = min(axis.values), max(axis.values)
            return (value - low) / (high - low) if high > low else 0.0
        return axis.values.index(value) / max(len(axis.values) - 1, 1)

    for name, found in values.items():
        rows = [
            ([place(axis, at[setting][axis.key]) for axis in axes], each[0])
            for setting, many in found.items()
            for each in many
        ]
        told = effects(np.array([row for row, _ in rows]), np.array([value for _, value in rows]))
        made |= {(name, axis.key, "end to end"): one for axis, one in zip(axes, told, strict=True)}
    return made


def _tolerances(plan: Mapping[str, Any], means: Any, origin: Any) -> dict[str, float]:
    """By measure in its unit."""
    given = plan["tolerance"]
    if given is None:
        return {}
    if isinstance(given, Mapping):
        if unknown := [name for name in given if name not in plan["measures"]]:
            raise InputError(
                f"a tolerance of {unknown[0]}, which is not measured", remedy="Add it to --measure"
            )
        return {name: float(value) for name, value in given.items()}
    sizes = {
        one.name: abs(means[one.name, origin].value)
        for one in plan["objects"]
        if one.physical and (one.name, origin) in means
    }
    return {name: float(given) * size for name, size in sizes.items() if size > 0}


def _advices(
    plan: Mapping[str, Any],
    means: Any,
    tolerances: Any,
    origin: Any,
    speeds: Any,
    moving: set[tuple[str, str]],
) -> list[dict[str, Any]]:
    """What to use along each axis, in plain values; of what changes no result the fastest."""
    told = []
    for k, axis in enumerate(plan["axes"]):
        places = {label(value): (*origin[:k], label(value), *origin[k + 1 :]) for value in axis.values}
        if axis.key in FREE:
            rows = []
            for value in axis.values:
                rates, lost = np.array(speeds.get(places[label(value)], [(np.nan, 0)])).T
                sound = not lost.any() and (axis.key, label(value)) not in moving and np.isfinite(rates).all()
                rows.append({"value": value, "inside": sound, "worst": None if sound else "lost",
                             "more": None, "speed": float(np.median(rates))})  # fmt: skip
            best = max((one for one in rows if one["inside"]), key=lambda one: one["speed"], default=None)
            own = {"end": None, "best": best and best["value"], "undecided": None, "converged": None}
            told.append({"choice": axis.key, **own, "settings": rows})
            continue
        found: dict[str, dict[Any, SeedMean]] = {name: {} for name in tolerances}
        for value in axis.values:
            for name in tolerances:
                if (one := means.get((name, places[label(value)]))) is not None:
                    found[name][str(value)] = one
        advice = advise(axis.key, axis.values, found, tolerances, plan["converged"])
        if advice is not None:
            told.append({
                "choice": axis.key, "end": advice.end, "best": advice.best, "undecided": advice.undecided,
                "converged": advice.converged,
                "settings": [
                    {"value": one.value, "inside": one.inside, "worst": one.worst,
                     "more": one.more if np.isfinite(one.more) else None}
                    for one in advice.settings
                ],
            })  # fmt: skip
    return told


KINDS = {"sweep": Verb(judge, page)}
