"""One rule per thing that can be wrong with a run, or that one should know about it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from mdnum.report import analysis
from mdnum.report.run import Run
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many, number, percent
from mdnum.rollout.summary import Line

#: A flip taken back within so many steps is chatter.
CHATTER_STEPS = 10
#: Share of flips that must be chatter before it is worth a warning; free flight through the cutoff gives
#: a few percent at usual time steps.
CHATTER_SHARE = 0.15
#: Drift over the run, per atom and in units of k_B T, from which on it is worth a warning.
DRIFT_SHARE = 0.01

_GRADIENT = (
    "A gradient taken through the rollout differentiates the branch that ran and misses what each flip "
    "adds, an error that a shorter time step does not shrink."
)
_RECORDER = "A flip was not recorded: the ledger cannot be used. Please report it."
_LISTS_FIRST = "Lost pairs have no place in the ledger: mend the neighbor lists first."


Rule = Callable[[Run], Iterator[Finding]]


def _status(run: Run) -> Iterator[Finding]:
    status = run.summary.get("status")
    planned = run.summary.get("steps_asked") or (run.system.get("dynamics") or {}).get("steps")
    of = f" of {count(planned)}" if planned and planned > run.steps else ""
    if status == "failed":
        title = f"the run failed at step {_step(run, -1)}{of}"
        text = run.summary.get("error") or "It stopped at the first number that was not finite."
        remedy = "Shorten dynamics.timestep, or relax the structure first."
        yield Finding("RUN_FAILED", "error", title, str(text), remedy)
    elif status != "complete":
        title = f"the run ended early, after {many(run.steps, 'step')}{of}"
        text = "It was stopped or killed; what is here is complete up to its last checkpoint."
        yield Finding("NOT_FINISHED", "info", title, text, "Continue with mdnum run --resume.")


def _lost_pairs(run: Run) -> Iterator[Finding]:
    lost = total(run, "lost_pairs")
    if not lost:
        return
    firsts = run.epochs["first_lost_step"]
    firsts = firsts[firsts >= 0]
    since = f", from step {count(int(firsts.min()))} on" if len(firsts) else ""
    rebuild = (run.system.get("neighbors") or {}).get("rebuild") or {}
    if rebuild.get("check") is False:
        remedy = (
            "Set neighbors.rebuild.check = true (the list is rebuilt blindly every "
            f"{rebuild.get('every', 1)} steps), or raise neighbors.skin."
        )
    else:
        remedy = "Raise neighbors.skin, or shorten dynamics.timestep."
    text = (
        f"{many(lost, 'pair')} inside the cutoff {'was' if lost == 1 else 'were'} missing from the list in "
        f"use, for {many(total(run, 'lost_pair_steps'), 'pair-step')}. Their forces are missing, and so are "
        "their flips."
    )
    yield Finding("LOST_PAIRS", "error", f"the neighbor list lost {many(lost, 'pair')}{since}", text, remedy)


def _dangerous_builds(run: Run) -> Iterator[Finding]:
    dangerous = total(run, "dangerous_builds", "dangerous")
    if not dangerous:
        return
    overdrawn = float(np.max(-run.epochs["margin"][run.epochs["dangerous"]], initial=0.0))
    audit = (
        "Pairs were lost."
        if total(run, "lost_pairs")
        else "The audit at each rebuild found no lost pair, so these forces are right."
    )
    text = (
        f"{count(dangerous)} of {count(len(run.epochs['epoch']))} lists may have been in use for too long "
        "(LAMMPS’s meaning of the word): at the first step at which a rebuild was allowed, an atom had moved "
        f"by up to {number(overdrawn)} {run.units.length} more than half the skin. {audit}"
    )
    remedy = "Rebuild earlier (every and delay in neighbors.rebuild) or raise neighbors.skin."
    yield Finding("DANGEROUS_BUILDS", "warning", many(dangerous, "dangerous build"), text, remedy)


def _mismatch(run: Run) -> Iterator[Finding]:
    mismatches = run.summary.get("count_mismatches")
    # a list that is known to have lost pairs disagrees with the next one for that reason
    if not mismatches or total(run, "lost_pairs"):
        return
    text = (
        f"At {many(mismatches, 'rebuild')} the old list and the new one counted different pairs inside the "
        "cutoff at the same positions, though no pair is known to be lost."
    )
    remedy = "Try the other neighbors.builder, run mdnum doctor, and please report it."
    yield Finding("LISTS_DISAGREE", "error", "successive neighbor lists disagree", text, remedy)


def _algebra(run: Run) -> Iterator[Finding]:
    wrong = np.flatnonzero(~analysis.algebra_holds(run.series))
    if len(wrong):
        title = f"pairs and flips disagree from step {_step(run, wrong[0])} on"
        text = f"Pairs inside are not pairs at the start + entered − left at {many(len(wrong), 'step')}."
        yield Finding("EVENT_ALGEBRA", "error", title, text, _remedy(run, _RECORDER))


def _ledger(run: Run) -> Iterator[Finding]:
    title = "the table of flips is not complete"
    counted = int(run.series["entered"].sum(dtype=np.int64) + run.series["left"].sum(dtype=np.int64))
    if counted != run.flips_total:
        text = f"The steps count {many(counted, 'flip')}; the table has {count(run.flips_total)}."
        yield Finding("LEDGER_INCOMPLETE", "error", title, text, "Run again in a new folder.")
        return
    wrong = np.flatnonzero(~run.flips.matches(run.series))
    if len(wrong):
        where = _step(run, wrong[0])
        text = f"Steps and table count different flips at {many(len(wrong), 'step')}, first at {where}."
        yield Finding("LEDGER_INCOMPLETE", "error", title, text, "Run again in a new folder.")
        return
    if not run.flips.alternates:
        text = "A pair enters or leaves twice in a row; between the two there was a flip the other way."
        yield Finding("LEDGER_INCOMPLETE", "error", title, text, _remedy(run, _RECORDER))


def _budget(run: Run) -> Iterator[Finding]:
    if run.summary.get("energy_budget_closes") is not False:
        return
    energy = run.units.energy
    tolerance = run.summary.get("energy_budget_tolerance")
    text = (
        "The energy less the ledger’s jumps is not that of the same positions without jumps: it is off by "
        f"{number(residual(run))} {energy}"
        + (f" where {number(tolerance)} is allowed." if tolerance else ".")
    )
    if jump(run):
        text += f" One flip is {number(abs(jump(run)))} {energy}."
    moves = np.abs(np.diff(run.budget["residual"]))
    if jump(run) and len(moves):
        worst = int(np.argmax(moves))
        text += f" The largest jump that no flip explains is {number(float(moves[worst]))} {energy}"
        text += f" at step {_step(run, worst + 1)}."
    remedy = "A flip is missing from the ledger, or an energy is wrong. Run mdnum doctor; please report it."
    yield Finding("BUDGET_OPEN", "error", "the energy budget does not close", text, _remedy(run, remedy))


def _tie(run: Run) -> Iterator[Finding]:
    margin = abs(float(run.series["min_margin"][0]))
    if margin and not run.series["ambiguous"][0]:
        return
    text = (
        f"At step 0 the closest pair is {number(margin)} from the threshold, within rounding. Whether it "
        "counts is a convention (cutoff.compare), and other codes have others."
    )
    remedy = "Move cutoff.radius between two neighbor shells."
    yield Finding("TIE_AT_CUTOFF", "warning", "pairs start exactly at the cutoff", text, remedy)


def _ambiguous(run: Run) -> Iterator[Finding]:
    ambiguous = run.summary.get("ambiguous") or int(run.series["ambiguous"].sum(dtype=np.int64))
    if not ambiguous:
        return
    text = (
        f"{many(ambiguous, 'decision')} came out as {'it' if ambiguous == 1 else 'they'} did by rounding: "
        "another order of summation, compiler or machine may decide otherwise, and follow another trajectory "
        f"from there. Atoms that cross the cutoff freely would give "
        f"{number(run.expected_ambiguous, 2)}."
    )
    remedy = "Move cutoff.radius between two neighbor shells."
    title = f"{many(ambiguous, 'decision')} within rounding of the cutoff"
    yield Finding("AMBIGUOUS_DECISIONS", "warning", title, text, remedy)


def _chatter(run: Run) -> Iterator[Finding]:
    flips = run.flips_total
    undone = run.stays.undone_within(CHATTER_STEPS)
    # a handful of flips says nothing about the cutoff
    if flips < 20 or undone < CHATTER_SHARE * flips:
        return
    smooth = not jump(run) and not run.cutoff.get("force_jump")
    busiest = run.busiest
    text = (
        f"{count(undone)} of {many(flips, 'flip')} are taken back by the same pair within {CHATTER_STEPS} "
        f"steps; pair {busiest.i[0]}–{busiest.j[0]} alone flips {count(int(busiest.flips[0]))} times. Atoms "
        "rest at the cutoff, as a crystal’s shell does."
    )
    if smooth:
        text += " The cutoff is smooth, so that this costs nothing."
    remedy = "Move cutoff.radius between two neighbor shells" + (
        "." if smooth else ", or use a switched cutoff."
    )
    title = f"{percent(undone / flips)} of the flips are chatter"
    yield Finding("CHATTER", "info" if smooth else "warning", title, text, remedy)


def _cutoff(run: Run) -> Iterator[Finding]:
    kind, force = run.cutoff.get("kind"), float(run.cutoff.get("force_jump") or 0.0)
    if not kind or not (jump(run) or force):
        return
    energy = run.units.energy
    force_text = f"{number(abs(force))} {energy}/{run.units.length}"
    if jump(run):
        text = (
            f"The {kind} cutoff ends where the pair energy is {number(jump(run))} {energy} and the force "
            f"{force_text}: each flip changes the total energy by that much. {_GRADIENT}"
        )
        remedy = 'For conserved energy or for gradients use cutoff.kind = "switched" or "quintic".'
        yield Finding("HARD_CUTOFF", "info", "every flip kicks the energy", text, remedy)
        return
    text = f"The {kind} cutoff ends at zero energy, but the force jumps there by {force_text}."
    if kind == "shifted":
        text += " Forces, trajectory and flips are bit for bit those of a hard cutoff."
    remedy = 'For gradients use cutoff.kind = "switched" or "quintic".'
    yield Finding("FORCE_JUMP", "info", "every flip kicks the force", f"{text} {_GRADIENT}", remedy)


def _drift(run: Run) -> Iterator[Finding]:
    atoms, units = run.summary.get("atoms"), run.units
    thermal = units.k_B * float(np.mean(run.series["temperature"]))
    time = float(run.series["time"][-1] - run.series["time"][0])
    if not atoms or run.steps < 2 or not np.isfinite(run.budget["residual"]).all():
        return
    # jumps do not count: what they add follows the number of pairs, up and down
    stated = run.summary.get("energy_drift_without_jumps")
    if stated is None:
        fitted = Line()
        fitted.add(run.series["time"], run.budget["residual"])
        stated = None if fitted.slope is None else fitted.slope / atoms
    if stated is None:
        return
    drift = float(stated)
    moved = abs(drift) * time
    if not thermal > 0 or moved < DRIFT_SHARE * thermal:
        return
    without = ", jumps of the flips not counted" if jump(run) else ""
    text = (
        f"{number(drift, signed=True)} {units.energy} per atom and {units.time} make {number(moved)} "
        f"{units.energy} per atom in {number(time)} {units.time}{without}."
    )
    title = f"the energy drifts by {percent(moved / thermal)} of k_B T over the run"
    remedy = "Shorten dynamics.timestep" + (
        ", or use a cutoff whose force ends smoothly." if run.cutoff.get("force_jump") else "."
    )
    yield Finding("DRIFT", "warning", title, text, remedy)


def _wander(run: Run) -> Iterator[Finding]:
    """What the flips do to an energy that should be constant."""
    atoms, units = run.summary.get("atoms"), run.units
    thermal = units.k_B * float(np.mean(run.series["temperature"]))
    conserves = (run.system.get("dynamics") or {}).get("kind", "nve") == "nve"
    if not jump(run) or not atoms or not conserves or not thermal > 0:
        return
    moved = np.cumsum(run.series["energy_jump"], dtype=np.float64)
    low, high = min(float(moved.min()), 0.0), max(float(moved.max()), 0.0)
    share = (high - low) / (atoms * thermal)
    if share < DRIFT_SHARE:
        return
    text = (
        f"The jumps of the ledger add up to between {number(low, signed=True)} and "
        f"{number(high, signed=True)} {units.energy} on the way: {percent(share)} of k_B T per atom. "
        "The run is not at one energy, and not at one temperature."
    )
    remedy = 'Use cutoff.kind = "switched" or "quintic", or move cutoff.radius between two neighbor shells.'
    span = f"{number(low, 2, signed=True)} to {number(high, 2, signed=True)} {units.energy}"
    yield Finding("WANDER", "warning", f"flips move the total energy by {span}", text, remedy)


def _ase(run: Run) -> Iterator[Finding]:
    ase = run.summary.get("ase") or {}
    if ase.get("ok") is False:
        scale = ase.get("force_scale")
        text = (
            f"Relative energy difference {number(ase.get('energy_rel'))}, largest force difference "
            f"{number(ase.get('force_max'))} {run.units.energy}/{run.units.length}"
            + (f" at a force scale of {number(scale)}." if scale else ".")
        )
        remedy = "Look at mdnum check energy for this system, and at mdnum doctor for this installation."
        yield Finding("ASE_DISAGREES", "error", "energies or forces disagree with ASE", text, remedy)
    elif ase.get("ok") is None:
        text = str(ase.get("note") or "The comparison was switched off, or ASE has no such potential.")
        yield Finding("ASE_NOT_COMPARED", "info", "not compared with ASE", text, "Run mdnum check energy.")


#: Rules in the order in which their findings are told, and the codes they decide anew each time.
RULES: tuple[Rule, ...] = (
    _status, _lost_pairs, _mismatch, _algebra, _ledger, _budget, _ase, _dangerous_builds, _tie, _ambiguous,
    _chatter, _drift, _wander, _cutoff,
)  # fmt: skip
CODES = frozenset({
    "RUN_FAILED", "NOT_FINISHED", "LOST_PAIRS", "LISTS_DISAGREE", "DANGEROUS_BUILDS", "EVENT_ALGEBRA",
    "LEDGER_INCOMPLETE", "BUDGET_OPEN", "TIE_AT_CUTOFF", "AMBIGUOUS_DECISIONS", "CHATTER", "HARD_CUTOFF",
    "FORCE_JUMP", "DRIFT", "WANDER", "ASE_DISAGREES", "ASE_NOT_COMPARED",
})  # fmt: skip


def residual(run: Run) -> float:
    """How far the budget is from closing, as the run stated it or else |E(t) - E(0) - sum of jumps|."""
    stated = run.summary.get("energy_budget_residual")
    return float(np.max(np.abs(run.budget["residual"]))) if stated is None else abs(float(stated))


def jump(run: Run) -> float:
    """Energy of a pair at the cutoff, 0 where it ends at zero."""
    return float(run.cutoff.get("energy_jump") or 0.0)


def total(run: Run, key: str, column: str | None = None) -> int:
    """A count from the summary, or from the epochs where a killed run has no summary."""
    return int(run.summary.get(key) or run.epochs[column or key].sum())


def _step(run: Run, row: int) -> str:
    return count(int(run.series["step"][row]))


def _remedy(run: Run, otherwise: str) -> str:
    return _LISTS_FIRST if total(run, "lost_pairs") else otherwise
