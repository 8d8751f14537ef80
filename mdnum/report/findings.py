"""A verdict in words on a run, with the findings and the evidence it rests on; from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report import analysis
from mdnum.report.rules import CHATTER_STEPS, CODES, RULES, jump, residual, total
from mdnum.report.run import Run, load
from mdnum.report.verdict import Verdict, conclude, restore
from mdnum.report.words import many, number
from mdnum.store import RunFolder


def judge(run: Run) -> Verdict:
    """All findings of a run, and the verdict.

    Findings that others left in summary.json (a check, say) are kept; those of `rules` are decided anew.
    """
    found = [finding for rule in RULES for finding in rule(run)]
    found += [restore(kept) for kept in run.summary.get("findings") or () if kept.get("code") not in CODES]
    return conclude(found, _evidence(run), run.summary.get("status") == "complete")


def record(folder: RunFolder | str | Path) -> Verdict:
    """Judges a run and writes findings and verdict into its summary.json."""
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = judge(run)
    store(folder, run, verdict)
    return verdict


def store(folder: RunFolder, run: Run, verdict: Verdict) -> None:
    """Writes findings and verdict into summary.json, beside what is there."""
    verdict.store(folder, run.summary)


def sharpness(run: Run) -> tuple[float, float] | None:
    """(energy of one flip, largest step of the budget's residual): how plainly a missing flip would show.

    Returns:
        None where flips cost no energy or no step was made.
    """
    if not jump(run) or run.steps < 1:
        return None
    return abs(jump(run)), float(np.max(np.abs(np.diff(run.budget["residual"]))))


def summarize(run: Run) -> dict[str, Any]:
    """Numbers on flips that the report shows beside its figures."""
    lengths = run.stays
    ratio = run.margins
    finite = ratio[np.isfinite(ratio)]
    undone = lengths.undone_within(CHATTER_STEPS)
    return {
        "total": run.flips_total,
        "per_step": run.flips_total / run.steps if run.steps else 0.0,
        "undone": undone,
        "undone_share": undone / run.flips_total if run.flips_total else 0.0,
        "inside_median": analysis.median(lengths.inside),
        "outside_median": analysis.median(lengths.outside),
        "pairs": len(run.busiest.i),
        "ratio_min": float(finite.min()) if len(finite) else None,
        "ratio_median": float(np.median(finite)) if len(finite) else None,
        "expected_ambiguous": run.expected_ambiguous,
    }


def _evidence(run: Run) -> Iterator[str]:
    if analysis.algebra_holds(run.series).all():
        flips = run.flips_total
        subject = (
            f"All {many(flips, 'flip')} are accounted for"
            if flips > 1
            else "The one flip is accounted for"
            if flips
            else "No pair flipped"
        )
        yield (
            f"{subject}: pairs inside = pairs at the start + entered − left at every one of "
            f"{many(len(run.series['step']), 'step')}."
        )
    lives = len(run.epochs["epoch"])
    if lives and not total(run, "lost_pairs"):
        within = "the one life" if lives == 1 else f"the {many(lives, 'life', 'lives')}"
        yield f"No pair was lost in {within} of the neighbor list."
    if run.summary.get("energy_budget_closes"):
        checks = run.summary.get("energy_budget_checks")
        where = f" at {many(checks, 'step')}" if checks else ""
        off = f"to {number(residual(run), 2)} {run.units.energy}" if residual(run) else "exactly"
        what = (
            "less the ledger’s jumps, the energy is that of the same positions without jumps"
            if jump(run)
            else "the energy is that of the same positions, evaluated anew"
        )
        yield f"The energy budget closes: {what}, {off}{where}."
    ase = run.summary.get("ase") or {}
    if ase.get("ok") and ase.get("energy_rel") is not None:
        energy = f"to {number(ase['energy_rel'], 2)} (relative)" if ase["energy_rel"] else "exactly"
        forces = f"to {number(ase.get('force_max'), 2)} {run.units.energy}/{run.units.length}"
        yield f"Energies agree with {ase.get('reference') or 'ASE'} {energy}, forces {forces}."
