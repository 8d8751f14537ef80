"""`mdnum sweep`: sensitivity of results to numerical choices, and the cheapest sufficient settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.provenance import cores
from mdnum.sweeps.analysis import analyzed, recommended
from mdnum.sweeps.design import Design
from mdnum.sweeps.engines import TRIES, computed
from mdnum.sweeps.measures import USUAL
from mdnum.sweeps.plan import Plan, Planned, Question, Setting, planned
from mdnum.sweeps.points import Workspace, gone
from mdnum.verbs import frame
from mdnum.verbs.frame import Keep, Outcome, Verb
from mdnum.verbs.sweep_page import judge, page
from mdnum.verbs.sweep_worker import Task, enough, work

if TYPE_CHECKING:
    from mdnum.systems import System
    from mdnum.systems.simulation import Simulation

#: Number of points of one setting per task of a worker.
_TOGETHER = 8
#: Seconds between checks of points that another sweep is computing.
_LOOK = 1.0


@frame.keywords_checked
def sweep(
    system: Simulation | System | str | Path,
    over: Mapping[str, Sequence[Any]] | Sequence[str] | str,
    *,
    seeds: int | Sequence[int] = 4,
    measure: Sequence[str] | str = USUAL["md"],
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
    """Find the numerical choices that change results, and the cheapest accurate setting.

    Each point (one setting and one seed) is stored on disk. A repeated sweep computes only the missing
    points.

    Example:
        >>> mdnum.sweep("argon/liquid-864", {"dynamics.timestep": [0.001, 0.002, 0.004]}, seeds=8)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file.
        over: values by key of the system file, or texts as on the command line: "cutoff.radius=7:9:0.5",
            "dynamics.timestep=0.001,0.002", "precision".
        seeds: the number of random seeds, or the values of `dynamics.seed`; each gives different initial
            velocities and noise. A ball, which has no random numbers, is run once.
        measure: names of `mdnum.sweeps.measures.MEASURES`; default those for molecular dynamics or balls.
        steps: number of steps of a run at the time step of the system, by default that of the system; all
            runs cover the same simulated time.
        design: "one-at-a-time" around the values of the system, "factorial", or "space-filling" between the
            ends of each choice.
        samples: number of samples of a space-filling design, a power of two.
        tolerance: largest difference from the converged result, by measure in its unit, or one number
            relative to the magnitude of each measure; without it, no value is recommended.
        converged: the end of an axis that is regarded as converged, by key: "largest", "smallest" or a value;
            default the largest cutoff, the smallest time step, the largest system, double precision.
        on: executor of the points: tcp://host:port of a dask scheduler, a TOML file that describes an
            executor of executorlib, such as SLURM jobs, or any `concurrent.futures.Executor`; default local
            processes.
        workers: number of processes; default one per core.
        points_in: folder of the points, which several sweeps may share; default "sweep-points" next to the
            new folder.
        save_every: number of steps between frames, if a measure needs frames; default 200 frames per run.
        keep_runs: keep the run folder of each point.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome with the tables points, estimates, differences and settings.

    Raises:
        InputError: a choice, a measure or an executor does not exist, or the system cannot be run.
        FolderError: a folder cannot be used.
    """
    question = Question(seeds, measure, steps, design, samples, tolerance, converged, save_every)
    plan = planned(system, over, question, keep.get("overrides"))
    with frame.answering("sweep", f"sweep-{plan.loaded.name}", plan.loaded, **keep) as answer:
        root = Path(points_in) if points_in is not None else answer.folder.path.parent / "sweep-points"
        place = Workspace(root)
        place.swept()
        counts = _compute(place, plan, answer.log, on, workers, keep_runs)
        answer.tables, answer.summary = analyzed(place, plan)
        if joint := recommended(plan, answer.summary["advice"]):
            # what was found by varying one choice at a time is run together
            plan = planned(system, over, replace(question, joint=joint), keep.get("overrides"))
            more = _compute(place, plan, answer.log, on, workers, keep_runs)
            counts["found"] = more["found"] - counts["computed"]
            counts |= {name: counts[name] + more[name] for name in ("computed", "given_up")}
            answer.tables, answer.summary = analyzed(place, plan)
        answer.summary |= {**counts, "points_in": str(root), "workers": workers or cores()}
    return answer.outcome


def command(system: str, *, over: Sequence[str] = (), dry_run: bool = False, **given: Any) -> Any:
    """Execute `mdnum sweep`: convert the texts of command-line options, then call `sweep`."""
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
    """Return the plan of a sweep: points, missing points, time and disk space."""
    from mdnum.verbs import Reply

    where = given.pop("points_in", None) or Path(given.get("out") or "runs/x").parent / "sweep-points"
    workers = given.get("workers") or cores()
    question = Question(**{key: value for key, value in given.items() if key in Question.__annotations__})
    plan = planned(system, over, question, given.get("overrides"))
    place = Workspace(Path(where)) if Path(where).is_dir() else None
    stored = [place.result(one.address) if place else None for one in plan.points]
    missing = sum(not enough(one, plan.wanted) for one in stored)
    known = [one["seconds"] for one in stored if one and one["status"] == "complete"]
    # a run without one to go by: two million atom-steps a second on one core, and what it takes to begin
    each = float(np.median(known)) if known else plan.atoms * plan.steps / 2e6 + 2.0
    bytes_each = 120 * plan.steps + 2e4
    document = {
        "points": len(plan.points), "missing": missing, "seconds": missing * each / workers,
        "bytes": missing * bytes_each, "points_in": str(where),
    }  # fmt: skip
    rows = [("points", document["points"]), ("to be computed", missing),
            ("about", f"{document['seconds'] / 60:.1f} min by {workers} workers"
             + ("" if known else ", from a guess of two million atom-steps a second")),
            ("disk", f"{document['bytes'] / 1e6:.0f} MB in {where}")]  # fmt: skip
    return Reply({"kind": "sweep-plan", **document}, [("a sweep", ("", ""), rows)])


# --- computing ------------------------------------------------------------------------------------------


def _compute(
    place: Workspace, plan: Plan, log: Any, on: Any, workers: int | None, keep: bool
) -> dict[str, Any]:
    """Compute missing points. Wait for points that other sweeps compute. Return point counts."""
    wanted = {one.address: one for one in plan.points if not one.wrong}
    missing = [a for a in wanted if not enough(place.result(a), plan.wanted)]
    missed = place.nearest(wanted[missing[0]].state) if missing else None
    total, done, begun = len(missing), 0, monotonic()
    counts = {"computed": 0, "found": len(wanted) - total, "given_up": 0, "changed": missed or []}
    system = plan.system
    if not isinstance(system, str | Path):
        import cloudpickle

        system = cloudpickle.dumps(system)
    settings: dict[Setting, list[Planned]] = {}
    for address in missing:
        settings.setdefault(wanted[address].setting, []).append(wanted[address])
    # how many an engine of somebody else has is not known: it is given points one by one
    count, groups, rest = workers or (cores() if on is None else total), list[Sequence[Planned]](), total
    for many in settings.values():
        while many:
            # the last ones by themselves, so that workers end together
            several = max(1, min(_TOGETHER, rest // (4 * count)))
            groups.append(many[:several])
            rest, many = rest - len(groups[-1]), many[several:]

    def task(some: Sequence[Planned]) -> Task:
        each = tuple({"address": o.address, "state": o.state, "settings": o.settings} for o in some)
        return Task(
            str(place.root.absolute()), each, str(system) if isinstance(system, Path) else system,
            plan.overrides, plan.wanted, keep,
        )  # fmt: skip

    left_before = {claim for claim, _ in place.claims() if gone(claim)}

    def lost(one: Task, why: str) -> bool:
        # whose claim a process holds that died since was at work on it; others were only waiting
        claims = {claim for point in one.points for claim, _ in place.claims(point["address"])}
        dead = {claim for claim in claims - left_before if gone(claim)}
        left_before.update(dead)
        return bool(dead)

    def say() -> None:
        rate = done / (monotonic() - begun) if done else 0.0
        log(done, total, {"phase": "points", "unit": "points", "points_per_second": rate})

    busy: list[str] = []
    left = groups
    while left:
        say()
        again: list[list[Planned]] = []
        for one, told in computed(work, [task(some) for some in left], on=on, workers=workers, lost=lost):
            if isinstance(told, MdnumError):
                raise told
            if isinstance(told, BaseException):
                again += _after_a_loss(place, one, wanted, told, counts)
                done += sum(place.result(p["address"]) is not None for p in one.points)
                continue
            for each in told:
                if each["status"] == "full":
                    raise InputError(each["why"], remedy="Free some disk space, then repeat the command")
                counts["computed"] += each["status"] == "computed"
                done += each["status"] != "busy"
                busy += [each["address"]] * (each["status"] == "busy")
            say()
        left = again
        while busy:
            # what another sweep computes; of one that is gone it is computed here
            busy = [a for a in busy if not enough(place.result(a), plan.wanted)]
            free = [a for a in busy if all(gone(claim) for claim, _ in place.claims(a))]
            if free:
                left += [[wanted[a]] for a in free]
                busy = [a for a in busy if a not in free]
                break
            sleep(_LOOK)
    return counts


def _after_a_loss(
    place: Workspace, one: Task, wanted: Mapping[str, Planned], error: BaseException, counts: dict[str, Any]
) -> list[list[Planned]]:
    """After repeated crashes, mark the current point as failed. Return the points left."""
    from mdnum.sweeps.points import write_result

    again = []
    for point in one.points:
        address = point["address"]
        if enough(place.result(address), one.measures):
            continue
        if any(gone(claim) for claim, _ in place.claims(address)):
            with place.claimed(address) as mine:
                if mine and not enough(place.result(address), one.measures):
                    why = (
                        f"its process ended {TRIES} times without a result ({type(error).__name__}): memory?"
                    )
                    with place.filling(address, point["state"]) as folder:
                        write_result(folder, {"status": "failed", "why": why, "measures": {}, "summary": {},
                                              "seconds": 0.0, "again": True})  # fmt: skip
                    counts["given_up"] += 1
        else:
            again.append([wanted[address]])
    return again


KINDS = {"sweep": Verb(judge, page)}
