"""`mdnum run`: simulate a system, and compare it with ASE."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mdnum.errors import InputError, NumericalError
from mdnum.plain import plain
from mdnum.provenance import cores
from mdnum.report import analysis
from mdnum.report.finding import Finding, Verdict, conclude
from mdnum.report.words import number, pair_name
from mdnum.safe_path import environment, python
from mdnum.store import RunFolder
from mdnum.verbs.check import temperature_findings
from mdnum.verbs.frame import Outcome, Verb, Wanted, finish, keywords_checked, layout, say
from mdnum.verbs.run_page import CHATTER_STEPS, TEXTS, RunView, draw_first, page

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.references.energy_check import EnergyReport
    from mdnum.rollout.run import RunResult
    from mdnum.systems.load import System
    from mdnum.systems.simulation import Simulation
    from mdnum.units import Units

#: Share of chatter among flips above which a warning is given; free flight through the cutoff gives a few
#: percent at usual time steps.
CHATTER_SHARE = 0.15
#: Drift over the run, per atom and in units of k_B T, above which a warning is given.
DRIFT_SHARE = 0.01
#: Number of standard errors by which a drift must differ from zero.
ERRORS = 2.0
#: Fluctuation of the conserved energy relative to that of the kinetic energy above which the time step is too
#: long (averages begin to change there: docs/time-steps.md), and steps per period of the fastest vibration
#: (GROMACS reference manual, "Removing fastest degrees of freedom").
FLUCTUATION, STEPS_PER_PERIOD = 0.05, 5.0
#: Jump of the energy at the cutoff, or of the force times its radius, that is negligible, in k_B T.
NO_JUMP = 1e-9
#: Statements that compile and cache the functions that the loop calls.
COMPILE = "from mdnum.md import decide, kernel; kernel._driver(), decide._noting()"
#: Number of steps of a fixed-point run that are also made in float64.
_BESIDE = 2000


@keywords_checked
def run(
    system: Simulation | System | str | Path | None,
    *,
    out: str | Path | None = None,
    steps: int | None = None,
    save_every: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    check: bool = True,
    report: bool = True,
    progress: Wanted = None,
    allow_code: bool = False,
) -> Outcome:
    """Simulate a system, record all flips and write a report. Compare the first and last frame with ASE.

    Example:
        >>> mdnum.run("argon/liquid-864", steps=500).folder

    Args:
        system: a simulation, a system, a shipped name or the path of a system file; None when resuming.
        out: the new run folder; default runs/<name>-<n>.
        steps: last step; by default the system's.
        save_every: number of steps between trajectory frames; by default the system's.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        resume: continue the run in this folder, bit for bit.
        check: compare with ASE (or plain numpy, if ASE has no calculator for the potential).
        report: write report.html.
        progress: see `mdnum.verbs.frame.Keep`.
        allow_code: execute the Python code that a system file names.

    Returns:
        folder, summary and page; its result is a `mdnum.rollout.run.RunResult`.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
        NumericalError: the run blew up; the results before this step are in the folder, with a report.
    """
    _compile_beside()
    from mdnum.md.kernel import left_out
    from mdnum.rollout.run import run as roll_out
    from mdnum.systems import BallSystem

    if isinstance(system, BallSystem):
        raise InputError("the system is a ball", where=system.name, remedy="Use mdnum.bounce")
    if resume is not None and Path(resume).is_dir() and (folder := RunFolder.open(resume)).kind != "md":
        remedy = f"`mdnum report {resume}` shows it" if folder.summary else folder.again
        seen = f"this is a folder of `mdnum {folder.layout.command}`, not of a run"
        raise InputError(seen, where=str(resume), remedy=remedy)
    frames: SimpleQueue[tuple[Simulation, np.ndarray] | None] = SimpleQueue()
    compared: list[Future[_Beside]] = []
    with ThreadPoolExecutor(1) as thread:

        def shown(simulation: Simulation, positions: np.ndarray) -> None:
            frames.put((simulation, positions))
            if not compared:
                compared.append(thread.submit(_beside_the_loop, simulation, frames, check, report))

        try:
            result = roll_out(
                system, layout("md"), out=out, steps=steps, save_every=save_every, overrides=overrides,
                resume=resume, progress=progress, shown=shown,
            )  # fmt: skip
        except BaseException as error:
            frames.put(None)
            if isinstance(error, NumericalError) and error.folder is not None:
                finish(error.folder, report=report)
            raise
        if not compared:
            # it had ended before
            for here, positions in zip((result.simulation, result.ended), result.frames, strict=True):
                shown(here, positions)
        folder = RunFolder.open(result.folder)
        view = RunView(folder, folder.summary)
        if check:
            say(progress, "check", result.summary["steps"], result.summary["steps_asked"])
        # after the comparison
        drawn = thread.submit(draw_first, view) if report else None
        energies = compared[0].result()
        with folder.explained():
            # which are followed pair by pair beside both
            _ = view.flips.alternates
            if drawn is not None:
                drawn.result()
            if check:
                _keep(view, *energies)
                _beside_float64(view, result)
            view.summary["time_step"] = view.time_step
            if operation := left_out(result.simulation.potential):
                view.summary["not_compiled"] = operation
    return finish(folder, report=report, result=result, progress=progress, view=view)


def _compile_beside() -> None:
    """If the compilation cache is empty, compile the simulation's functions in a second process.

    After an installation, the first command otherwise spends most of its time on compilation. A single
    process compiles on one processor only.
    """
    kept = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    with contextlib.suppress(OSError):
        if kept and not os.listdir(kept) and cores() > 1:
            subprocess.Popen(
                python("-c", COMPILE), env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )


class _Beside(NamedTuple):
    """Results that are computed in parallel with the simulation loop."""

    compared: EnergyReport | None = None  # the first and the last frame with ASE
    period: float | None = None  # the fastest in them
    function: dict[str, Any] | None = None  # what a person's pair function was found to be


def _beside_the_loop(
    simulation: Simulation,
    frames: SimpleQueue[tuple[Simulation, np.ndarray] | None],
    check: bool,
    report: bool,
) -> _Beside:
    """Compare the first and last frame with ASE during the simulation."""
    if report:
        import mdnum.report.drawing  # noqa: F401 it takes as long
    if not check:
        return _Beside()
    from mdnum.audit.functions import examined
    from mdnum.references.energy_check import SAMPLED, check_energy
    from mdnum.rollout.adequacy import fastest_period

    periods: list[float | None] = []

    def shown() -> Iterator[tuple[Simulation, np.ndarray]]:
        while (frame := frames.get()) is not None:
            yield frame

    def named() -> Iterator[tuple[str, Atoms]]:
        given = shown()
        if simulation.atoms > SAMPLED:
            # what a large system takes of memory would come on top of the loop's
            both = list(islice(given, 2))
            # of a run that was stopped nobody asks
            given = iter(both if len(both) == 2 else ())
        for name, (here, positions) in zip(("initial", "last"), given, strict=False):
            periods.append(fastest_period(here, positions))
            atoms = here.structure.copy()
            if here is not simulation:
                atoms.set_cell(here.cell.matrix)
            atoms.set_positions(positions)
            yield name, atoms

    compared = check_energy(simulation, named())
    period = min((one for one in periods if one is not None), default=None)
    return _Beside(compared, period, examined(simulation))


def _keep(run: RunView, compared: EnergyReport | None, period: float | None, function: Any) -> None:
    """Add the results of parallel computations to summary.json."""
    from mdnum.verbs.check import energy_findings

    assert compared is not None
    run.summary["fastest_period"] = period
    if function is not None:
        run.summary["cutoff"] = {**run.cutoff, "smoothness": function["smoothness"], "function": function}
    run.summary["ase"] = plain(compared.worst)
    run.summary["findings"] += map(plain, energy_findings(compared))
    run.folder.write_summary(run.summary)


def _beside_float64(run: RunView, result: RunResult) -> None:
    """Add the energy fluctuations of a fixed-point run and of a float64 run to the summary."""
    from mdnum.rollout.engine import FAILURES, Engine

    simulation, summary = result.simulation, run.summary
    if simulation.fixed_point is None or simulation.integrator.random is not None:
        return
    steps = min(int(summary["steps"]), _BESIDE)
    float64 = []
    for segment in Engine(simulation.smooth, steps).segments():
        if segment.closes in FAILURES:
            return
        float64.append(segment.rows_of("potential") + segment.rows_of("kinetic"))
    ours = run.series["total"][: steps + 1]
    for key, energy in (("energy_std", ours), ("energy_std_float64", np.concatenate(float64))):
        summary["fixed_point"][key] = float(np.std(energy)) / simulation.atoms
    summary["fixed_point"]["energy_steps"] = steps
    run.folder.write_summary(summary)


# -- what is wrong with a run, or should be known about it -------------------------------------------


def judge(run: RunView) -> Verdict:
    """Return the verdict on a run. The most serious cause comes first."""
    found = [
        *_status(run), *_time_step(run), *_lists(run), *_ledger(run), *_energy(run), *_ase(run),
        *_decisions(run), *_drift(run), *_cutoff(run),
        *function_findings(run.cutoff.get("function"), run.units), *_potential(run), *_start(run),
        *_loop(run),
    ]  # fmt: skip
    found += run.kept(TEXTS.entries)
    severities = {finding.severity for finding in found}
    complete = run.summary.get("status") == "complete"
    failed = run.summary.get("status") == "failed"
    name = (
        "failed" if failed
        else "errors" if "error" in severities
        else "partial" if not complete
        else "complete" if "warning" in severities
        else "notes" if severities
        else "clean"
    )  # fmt: skip
    return conclude(found, _evidence(run), headline=TEXTS(name), best="good")


def _status(run: RunView) -> Iterator[Finding]:
    status = run.summary.get("status")
    planned = run.summary.get("steps_asked") or (run.system.get("dynamics") or {}).get("steps")
    of = f" of {planned:,}" if planned and planned > run.steps else ""
    if status == "failed":
        error = run.summary.get("error") or "The run stopped at the first number that was not finite."
        box = ["box"] * (run.summary.get("reason") == "narrow box")
        yield TEXTS.finding(
            "RUN_FAILED",
            *box,
            step=run.step(-1),
            of=of,
            error=str(error),
            remedy=run.summary.get("remedy", ""),
        )
    elif status != "complete":
        yield TEXTS.finding("NOT_FINISHED", steps=run.steps, of=of)


def _time_step(run: RunView) -> Iterator[Finding]:
    found = run.time_step
    moved, steps = found["fluctuation"], found["per_period"]
    variants = ["period"] * (steps is not None) + ["energy"] * (moved is not None)
    if (moved or 0.0) >= FLUCTUATION or (steps or np.inf) <= STEPS_PER_PERIOD:
        yield TEXTS.finding("TIME_STEP", *variants, share=moved, steps=steps)


def _lists(run: RunView) -> Iterator[Finding]:
    lost, dangerous = run.total("lost_pairs"), run.total("dangerous_builds", "dangerous")
    if lost:
        firsts = run.epochs["first_lost_step"]
        since = int(firsts[firsts >= 0].min()) if np.any(firsts >= 0) else None
        rebuild = (run.system.get("neighbors") or {}).get("rebuild") or {}
        variants = ["since"] * (since is not None) + ["blind"] * (rebuild.get("check") is False)
        yield TEXTS.finding(
            "LOST_PAIRS", *variants, lost=lost, pair_steps=run.total("lost_pair_steps"), since=since,
            every=rebuild.get("every", 1),
        )  # fmt: skip
    # a list that is known to have lost pairs disagrees with the next one for that reason
    elif mismatches := run.summary.get("count_mismatches"):
        yield TEXTS.finding("LISTS_DISAGREE", mismatches=mismatches)
    if dangerous:
        overdrawn = float(np.max(-run.epochs["margin"][run.epochs["dangerous"]], initial=0.0))
        yield TEXTS.finding(
            "DANGEROUS_BUILDS", "lost" if lost else "sound", dangerous=dangerous,
            lists=len(run.epochs["epoch"]), overdrawn=overdrawn, unit=run.units.length,
        )  # fmt: skip


def _ledger(run: RunView) -> Iterator[Finding]:
    lost = ["lost"] * bool(run.total("lost_pairs"))
    wrong = np.flatnonzero(~analysis.algebra_holds(run.series))
    if len(wrong):
        yield TEXTS.finding("EVENT_ALGEBRA", *lost, step=run.step(wrong[0]), steps=len(wrong))
    counted = int(run.series["entered"].sum(dtype=np.int64) + run.series["left"].sum(dtype=np.int64))
    wrong = np.flatnonzero(~run.flips.matches(run.series))
    values: dict[str, Any] = {"counted": counted, "listed": run.flips.total}
    if counted != run.flips.total:
        yield TEXTS.finding("LEDGER_INCOMPLETE", **values)
    elif len(wrong):
        values |= {"steps": len(wrong), "step": run.step(wrong[0])}
        yield TEXTS.finding("LEDGER_INCOMPLETE", "steps", **values)
    elif not run.flips.alternates:
        yield TEXTS.finding("LEDGER_INCOMPLETE", *lost, "twice", **values)


def _energy(run: RunView) -> Iterator[Finding]:
    if run.summary.get("energy_budget_closes") is not False:
        return
    moves = np.abs(np.diff(run.budget["residual"]))
    variants = ["lost"] * bool(run.total("lost_pairs")) + ["jump"] * bool(run.jump and len(moves))
    worst = int(np.argmax(moves)) if len(moves) else 0
    yield TEXTS.finding(
        "BUDGET_OPEN", *variants, residual=run.residual, unit=run.units.energy, jump=abs(run.jump),
        largest=float(moves[worst]) if len(moves) else None, step=run.step(worst + 1) if len(moves) else None,
    )  # fmt: skip


def _ase(run: RunView) -> Iterator[Finding]:
    ase = run.ase
    if ase.get("ok") is False:
        yield TEXTS.finding(
            "ASE_DISAGREES", energy=ase.get("energy_rel"), force=ase.get("force_max"),
            scale=ase.get("force_scale"), unit=f"{run.units.energy}/{run.units.length}",
        )  # fmt: skip
    elif ase.get("ok") is None:
        note = ase.get("note")
        yield TEXTS.finding("ASE_NOT_COMPARED", *["note"] * bool(note), note=str(note))


def _decisions(run: RunView) -> Iterator[Finding]:
    margin, key, own = abs(float(run.series["min_margin"][0])), run.cutoff_key, run.own_end
    if not margin or run.series["ambiguous"][0]:
        yield TEXTS.finding("TIE_AT_CUTOFF", *own, margin=margin, key=key)
    ambiguous = run.summary.get("ambiguous") or int(run.series["ambiguous"].sum(dtype=np.int64))
    if ambiguous:
        expected = run.expected_ambiguous
        yield TEXTS.finding("AMBIGUOUS_DECISIONS", *own, ambiguous=ambiguous, expected=expected, key=key)
    undone = run.flips.stays.undone_within(CHATTER_STEPS)
    # a handful of flips says nothing about the cutoff
    if run.flips.total >= 20 and undone >= CHATTER_SHARE * run.flips.total:
        (busiest,) = run.flips.busiest.rows(1)
        smooth = not run.jump and not run.cutoff.get("force_jump")
        yield TEXTS.finding(
            "CHATTER", *own, *["smooth"] * smooth, key=key, undone=undone,
            flips=run.flips.total, share=undone / run.flips.total, within=CHATTER_STEPS,
            pair=pair_name(busiest), times=busiest["flips"],
        )  # fmt: skip


def _start(run: RunView) -> Iterator[Finding]:
    requested = float((run.system.get("dynamics") or {}).get("temperature") or 0.0)
    if run.summary.get("atoms") and len(run.series["step"]) and run.series["step"][0] == 0:
        start = float(run.series["temperature"][0])
        yield from temperature_findings(start, requested, run.summary["atoms"], run.units.temperature)


def _drift(run: RunView) -> Iterator[Finding]:
    atoms, units, thermal = run.summary.get("atoms"), run.units, run.thermal
    if not atoms or not thermal > 0:
        return
    time, left = run.series["time"], run.budget["residual"]
    # jumps do not count: what they add follows the number of pairs, up and down
    drift = run.summary.get("energy_drift_without_jumps")
    if drift is None and np.isfinite(left).all():
        from mdnum.rollout.summary import LineFit

        fitted = LineFit()
        fitted.add(time, left)
        drift = None if fitted.slope is None else fitted.slope / atoms
    if drift is not None and run.steps > 1 and np.isfinite(left).all():
        span, error = float(time[-1] - time[0]), run.time_step["drift_error"]
        moved = abs(float(drift)) * span
        if moved >= max(DRIFT_SHARE, ERRORS * (error or 0.0)) * thermal:
            variants = ["jump"] * bool(run.cutoff.get("force_jump")) + ["error"] * (error is not None)
            yield TEXTS.finding(
                "DRIFT", *variants, drift=float(drift), moved=moved, share=moved / thermal, time=span,
                energy=units.energy, time_unit=units.time, error=error,
            )  # fmt: skip
    if run.jump and run.conservative:
        moves = np.cumsum(run.series["energy_jump"], dtype=np.float64)
        low, high = min(float(moves.min()), 0.0), max(float(moves.max()), 0.0)
        share = (high - low) / (atoms * thermal)
        if share >= DRIFT_SHARE:
            values = {"low": low, "high": high, "share": share, "unit": units.energy}
            yield TEXTS.finding("WANDER", *run.own_end, key=run.cutoff_key, **values)


def _cutoff(run: RunView) -> Iterator[Finding]:
    kind, force = run.cutoff.get("kind"), abs(float(run.cutoff.get("force_jump") or 0.0))
    jump, length = abs(run.jump), float(run.cutoff.get("radius") or 1.0)
    values = {"kind": kind, "force": force, "energy": run.units.energy, "length": run.units.length}
    own, pairs = run.own_end, run.cutoff.get("largest") or [""] * 2
    own += ["types"] * bool(pairs[0])
    # rounding where a potential ends is no jump
    if kind and jump > NO_JUMP * run.thermal:
        share = jump / run.thermal if run.thermal > 0 else None
        own += ["share"] * bool(share)
        yield TEXTS.finding("HARD_CUTOFF", *own, pair=pairs[0], jump=run.jump, share=share, **values)
    elif kind and force * length > NO_JUMP * run.thermal:
        yield TEXTS.finding("FORCE_JUMP", *own, *["shifted"] * (kind == "shifted"), "gradient", pair=pairs[1],
                            **values)  # fmt: skip


def _loop(run: RunView) -> Iterator[Finding]:
    if operation := run.summary.get("not_compiled"):
        yield TEXTS.finding("NOT_COMPILED", operation=operation)


def function_findings(function: Mapping[str, Any] | None, units: Units) -> Iterator[Finding]:
    """Yield findings on a user's pair function that is not finite or not smooth."""
    function = function or {}
    if function.get("single"):
        yield TEXTS.finding("SINGLE_INSIDE", "pair")
    places, energy, length = function.get("places", ()), units.energy, units.length
    codes = {"FUNCTION_SLOPE": (-2,), "FUNCTION_NOT_FINITE": (-1,), "FUNCTION_BREAKS": (0, 1, 2, 3)}
    for code, orders in codes.items():
        found = sorted((row for row in places if row["order"] in orders), key=lambda row: row["order"])
        if found:
            worst, *rest = found
            order = worst["order"]
            ends = zip(("first", "last"), worst.get("between", ()), strict=False)
            yield TEXTS.finding(
                code, *["others"] * bool(rest), *["smooth"] * (order > 1), *["linear"] * ("kinks" in worst),
                unit=energy + ("", f"/{length}", f"/{length}²", f"/{length}³")[max(order, 0)],
                places=len(found), **worst, **dict(ends), length=length,
                others=", ".join(f"{row['pair']} {number(row['distance'], 6)} {length}" for row in rest),
            )  # fmt: skip


def _potential(run: RunView) -> Iterator[Finding]:
    """Yield findings from trial calls of a user's energy function."""
    units: dict[str, Any] = {"energy_unit": run.units.energy, "length_unit": run.units.length}
    for code, values in ((run.system.get("potential") or {}).get("notes") or {}).items():
        # of a range that has an end
        yield TEXTS.finding(code, *["reach"] * bool(values.get("reach")), **values, **units)


def _evidence(run: RunView) -> Iterator[str]:
    summary, units = run.summary, run.units
    if analysis.algebra_holds(run.series).all():
        yield TEXTS("flips_accounted", flips=run.flips.total, steps=len(run.series["step"]))
    if not any(_time_step(run)):
        said = {name: value for name, value in run.time_step.items() if value is not None}
        if "fluctuation" in said:
            yield TEXTS("step_conserves" if "drift" in said else "step_conserves_only", **said)
        if "per_period" in said:
            yield TEXTS("step_resolves", **said)
        if not said:
            yield TEXTS("step_unknown")
    if len(run.epochs["epoch"]) and not run.total("lost_pairs"):
        lists, used = len(run.epochs["epoch"]), float(np.max(run.epochs["skin_consumed"]))
        yield TEXTS("lists_sound" if np.isfinite(used) else "lists_fresh", lists=lists, used=used)
    if summary.get("energy_budget_closes"):
        yield TEXTS(
            "budget_closes" if run.jump else "budget_closes_smooth", residual=run.residual,
            checks=int(summary.get("energy_budget_checks") or 0),
        )  # fmt: skip
    ase = run.ase
    if ase.get("ok") and ase.get("energy_rel") is not None:
        yield TEXTS(
            "ase_agrees_sampled" if "sampled" in ase else "ase_agrees", sampled=ase.get("sampled"),
            atoms=summary.get("atoms"), reference=ase.get("reference") or "ASE", energy=ase["energy_rel"],
            force=ase.get("force_max"), unit=f"{units.energy}/{units.length}",
        )  # fmt: skip
    if beyond := summary.get("beyond_cutoff"):
        mean = float(np.mean(run.series["potential"])) / summary["atoms"]
        share = abs(beyond["energy"] / mean) if mean else None
        said = {**beyond, "share": share, "unit": units.energy, "pressure_unit": units.pressure}
        yield TEXTS("beyond_cutoff" if share else "beyond_cutoff_alone", **said)


KINDS = {"md": Verb(judge, page, RunView, unfinished=True)}
