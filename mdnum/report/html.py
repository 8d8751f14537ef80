"""report.html: one file that reads without mdnum, without a network, on paper and on a phone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report import figures, findings, page
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.page import picture
from mdnum.report.rules import CHATTER_STEPS, residual
from mdnum.report.run import Run, load
from mdnum.report.verdict import Verdict
from mdnum.report.words import count, many, number, plain
from mdnum.store import RunFolder
from mdnum.store.atomic import write_text

_BUSIEST = 10


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts findings and verdict into summary.json.

    Everything is read from the folder; a run that was killed is reported up to its last checkpoint.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no run in the folder, or it cannot be written.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = findings.judge(run)
    findings.store(folder, run, verdict)
    pictures = {
        name: picture(folder.path, name, title, lambda width, name=name: figures.draw(name, run, width))
        for name, title in _titles(run).items()
    }
    path = folder.path / "report.html"
    write_text(path, render(run, verdict, pictures))
    return path


def render(run: Run, verdict: Verdict, pictures: Mapping[str, str]) -> str:
    """The page's text.

    Args:
        pictures: markup by the names of `figures.FIGURES`; one that is missing is left out.
    """
    browsed = _browsed(run)
    return page.render(
        "report.html.j2",
        run=run,
        verdict=verdict,
        pictures=pictures,
        units=run.units,
        summary=run.summary,
        figures=list(_key_figures(run)),
        what=list(_what_was_run(run)),
        flips=findings.summarize(run),
        sharpness=findings.sharpness(run),
        chatter_steps=CHATTER_STEPS,
        busiest=_busiest(run),
        lists=_lists(run),
        ase=list(_ase(run)),
        browsed=browsed,
        scripted=bool(browsed.rows),
        provenance=list(page.flat(run.provenance)),
    )


def _titles(run: Run) -> dict[str, str]:
    titles = {"energy": "Energy and its budget against time", "flips": "Flips per step against time"}
    # without a bound (whole numbers are compared) there is no unit to measure margins in
    if np.isfinite(run.margins).any():
        titles["margins"] = "Histogram of margins in units of the rounding bound"
    if run.stays.total > 1:
        titles["residence"] = "Histogram of the steps between two flips of a pair"
    if len(run.epochs["epoch"]):
        titles["lists"] = "Skin consumed and steps per neighbor list"
    return titles


def _key_figures(run: Run) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the verdict."""
    summary = run.summary
    entered, left = (int(run.series[name].sum(dtype=np.int64)) for name in ("entered", "left"))
    atoms = summary.get("atoms")
    rate = (
        f"{number(run.flips_total / run.steps / atoms, 2)} per atom and step" if atoms and run.steps else ""
    )
    yield "Flips", count(entered + left), rate or f"{count(entered)} in, {count(left)} out"
    lost = int(run.epochs["lost_pairs"].sum())
    yield "Lost pairs", count(lost), f"in {many(len(run.epochs['epoch']), 'list')}"
    ambiguous = int(run.series["ambiguous"].sum(dtype=np.int64))
    yield "Ambiguous", count(ambiguous), "decisions within rounding"
    closes = summary.get("energy_budget_closes")
    words = "" if closes is None else "; budget closes" if closes else "; budget is open"
    yield "Budget residual", number(residual(run), 2), run.units.energy + words
    energy = (summary.get("ase") or {}).get("energy_rel")
    yield "Against ASE", number(energy, 2), "not compared" if energy is None else "relative energy difference"
    speed = summary.get("steps_per_second")
    yield "Speed", number(speed), "steps per second"


def _what_was_run(run: Run) -> Iterator[tuple[str, str]]:
    """(what, words) for the table of the run; what the system file leaves out is left out."""
    units, system, summary = run.units, run.system, run.summary
    if system.get("about"):
        yield "System", str(system["about"])
    atoms = summary.get("atoms")
    time = run.series["time"]
    yield (
        "Size",
        ", ".join(
            part
            for part in (
                many(atoms, "atom") if atoms else "",
                many(run.steps, "step"),
                f"{plain(float(time[-1] - time[0]))} {units.time}",
            )
            if part
        ),
    )
    if potential := system.get("potential"):
        yield "Potential", page.in_words(potential)
    if cutoff := system.get("cutoff"):
        yield "Cutoff", page.in_words(cutoff, {"radius": units.length, "onset": units.length})
    jumps = run.cutoff
    if jumps.get("energy_jump") is not None:
        force = jumps.get("force_jump")
        yield (
            "At the cutoff",
            f"energy jump {number(jumps['energy_jump'])} {units.energy}, force jump {number(force)} "
            f"{units.energy}/{units.length}",
        )
    if neighbors := system.get("neighbors"):
        yield "Neighbor lists", page.in_words(neighbors, {"skin": units.length})
    if dynamics := system.get("dynamics"):
        # how many steps were made is said above; the file says how many were planned
        made = {key: value for key, value in dynamics.items() if key != "steps"}
        yield "Dynamics", page.in_words(made, {"timestep": units.time, "temperature": units.temperature})
    mean = float(np.mean(run.series["temperature"]))
    yield "Temperature", f"{number(mean, 4)} {units.temperature} (mean over the run)"
    if precision := system.get("precision"):
        yield "Precision", page.in_words(precision)


def _busiest(run: Run) -> list[dict[str, Any]]:
    pairs = run.busiest
    total = run.steps or 1
    return [
        {"pair": f"{i}–{j}", "flips": int(n), "every": total / n}
        for i, j, n in zip(
            *(column[:_BUSIEST].tolist() for column in (pairs.i, pairs.j, pairs.flips)), strict=True
        )
    ]


def _lists(run: Run) -> dict[str, Any] | None:
    epochs = run.epochs
    if not len(epochs["epoch"]):
        return None
    # the last list was cut off by the end of the run: its length says nothing
    whole = epochs["reason"] != "end"
    length = epochs["length"][whole] if whole.any() else epochs["length"]
    skin = epochs["skin_consumed"]
    reasons, counts = np.unique(epochs["reason"].astype(str), return_counts=True)
    return {
        "count": len(skin),
        "length_median": float(np.median(length)),
        "length_min": int(length.min()),
        "length_max": int(length.max()),
        "skinned": bool(np.isfinite(skin).all()),
        "skin_median": float(np.median(skin)),
        "skin_max": float(skin.max()),
        "pairs_listed": float(np.mean(epochs["pairs_listed"])),
        "occupancy": float(np.max(epochs["occupancy"] / np.maximum(epochs["capacity"], 1))),
        "capacities": len(np.unique(epochs["capacity"])),
        "dangerous": int(epochs["dangerous"].sum()),
        "lost_pairs": int(epochs["lost_pairs"].sum()),
        "lost_pair_steps": int(epochs["lost_pair_steps"].sum()),
        "build_ms": float(np.median(epochs["build_ms"])),
        "reasons": ", ".join(f"{reason} {count(int(n))}" for reason, n in zip(reasons, counts, strict=True)),
    }


def _ase(run: Run) -> Iterator[tuple[str, str, str]]:
    """(quantity, difference, scale) against ASE; nothing where it was not compared."""
    ase, units = run.summary.get("ase") or {}, run.units
    if ase.get("energy_rel") is not None:
        yield "energy", number(ase["energy_rel"]), "relative"
    if ase.get("force_max") is not None:
        scale = ase.get("force_scale")
        share = f"; {number(ase['force_max'] / scale, 2)} of the force scale" if scale else ""
        yield "forces", number(ase["force_max"]), f"{units.energy}/{units.length}, largest component{share}"
    if ase.get("stress_max") is not None:
        yield "stress", number(ase["stress_max"]), f"{units.energy}/{units.length}³, largest component"


def _browsed(run: Run) -> Browse:
    """The flips nearest to the threshold, in the order of steps."""
    flips = run.flips.nearest
    columns: list[tuple[np.ndarray, int | None]] = [(flips[name], None) for name in ("step", "i", "j")]
    columns.append((flips["entered"].astype(int), None))
    for name, digits in (("distance", 9), ("margin", 4), ("radial_speed", 4), ("energy_jump", 4)):
        columns.append((flips[name], digits))
    columns.append((flips["ratio"], 3))
    units = run.units
    return Browse(
        name="flips",
        row_id="flip-rows",
        label="Search flips",
        placeholder="atom 17, pair 17-203, step:100..200, entered, ambiguous",
        columns=(
            Column(0, "step", kind="count"),
            Column(1, "pair", kind="pair"),
            Column(3, "decision", kind="word", words=("left", "entered"), colors=("out", "in")),
            Column(4, "distance", units.length, kind="fixed", digits=6),
            Column(5, "margin", str(run.cutoff.get("compare", "r2 <"))),
            Column(6, "radial speed", f"{units.length}/{units.time}"),
            Column(7, "energy jump", units.energy),
            Column(8, "margin", "÷ bound", digits=2, missing="∞"),
        ),
        rows=plain_rows(columns),
        words={"entered": (3, 1), "in": (3, 1), "left": (3, 0), "out": (3, 0)},
        ranges={"step": 0},
        subjects=(1, 2),
        nouns=("atom", "pair"),
        ambiguous=8,
    )
