"""report.html of a ball's run: one file, from the folder alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report import page
from mdnum.report.ball import figures, findings
from mdnum.report.ball.run import ROWS_LOADED, BallFolder, load
from mdnum.report.ball.values import value_text
from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.verdict import Verdict
from mdnum.report.words import count, many, number, plain
from mdnum.store import RunFolder

#: Rows of a table that the page carries.
TABLE_ROWS = 5_000
_REASONS = ("", "none", "tolerance", "cap", "fixed", "not finite", "rest")


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts findings and verdict into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no run of a ball in the folder, or it cannot be written.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    run = load(folder)
    verdict = findings.judge(run)
    verdict.store(folder, run.summary)
    return page.publish(
        folder.path,
        figures.figures(run),
        lambda pictures, notes: render(run, verdict, pictures, notes),
    )


def render(
    run: BallFolder, verdict: Verdict, pictures: Mapping[str, str], notes: Mapping[str, list[str]]
) -> str:
    """The page's text.

    Args:
        pictures: markup by the names that `figures.figures` gives; one that is missing is left out.
        notes: what each of them cannot show.
    """
    contacts, solver = _contacts(run), _solver(run)
    return page.render(
        "ball/run.html.j2",
        run=run,
        verdict=verdict,
        pictures=pictures,
        notes=notes,
        summary=run.summary,
        figures=list(_key_figures(run)),
        what=list(_what_was_run(run)),
        gradient=list(_gradient(run)),
        exact=list(_exact(run)),
        variants=list(_variants(run)),
        contacts=contacts,
        solver=solver,
        scripted=bool(contacts.rows or solver.rows),
        rows_loaded=ROWS_LOADED,
        provenance=list(page.flat(run.provenance)),
    )


def _key_figures(run: BallFolder) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the verdict."""
    summary = run.summary
    first = summary.get("first_contact")
    when = "none" if first is None or first < 0 else f"first at step {count(first)}"
    entered = summary.get("flips_entered")
    if entered == 0 and first is not None and first >= 0:
        when = "in contact at the start"
    yield "Contacts", count(run.series["entered"].sum() if entered is None else entered), when
    total = summary.get("iterations_total")
    if run.located:
        yield "Impacts", count(total), "located inside steps"
    else:
        most = summary.get("iterations_max")
        solves = sum(run.ended.values())
        yield (
            "Iterations",
            count(total),
            f"{count(most)} at most in a step" if solves else "nothing is solved",
        )
    doubtful = summary.get("ambiguous")
    yield (
        "Ambiguous",
        count(run.series["ambiguous"].sum() if doubtful is None else doubtful),
        "within rounding",
    )
    if run.gradient and run.parameters:
        made, name = run.gradient[0], run.parameters[0]
        if not (made.get("depends") or {}).get(name, True):
            yield f"dloss/d{name}", "0", f"{made['method']}: does not depend"
        else:
            yield f"dloss/d{name}", number(made["gradient"].get(name)), str(made["method"])
    else:
        yield "Loss", number(summary.get("loss"), 4), "no derivative was asked for"
    error = run.exact.get("height_error_largest", run.exact.get("height_error"))
    yield "Against closed form", number(error, 2), "m, largest" if error is not None else "there is none"
    speed = summary.get("steps_per_second")
    if speed is None:
        yield "Took", f"{number(summary.get('seconds'), 2)} s", "compilation, variants and all"
    else:
        yield "Speed", number(speed), "steps per second"


def _what_was_run(run: BallFolder) -> Iterator[tuple[str, str]]:
    """(what, words) for the table of the run; what the system file leaves out is left out."""
    system = run.system
    if system.get("about"):
        yield "System", str(system["about"])
    yield (
        "Size",
        f"{many(run.balls, 'ball')}, {many(run.steps, 'step')}, {plain(float(run.series['time'][-1]))} s",
    )
    units = {
        "height": "m", "velocity": "m/s", "gravity": "m/s²", "timestep": "s", "rest_speed": "m/s",
        "hysteresis": "m", "spread": "m", "tol": "m",
    }  # fmt: skip
    if (system.get("contact") or {}).get("kind") == "penalty":
        units |= {"k": "1/s²", "damping": "1/s", "eps": "m"}
    for key, name in (
        ("start", "Start"), ("flight", "Flight"), ("contact", "Contact"), ("stop", "Stopping rule"),
        ("integrator", "Integrator"), ("precision", "Precision"), ("loss", "Loss"), ("gradient", "Gradient"),
    ):  # fmt: skip
        table = system.get(key)
        if not isinstance(table, Mapping) or not table:
            continue
        # how many steps were made is said above
        words = {item: _told(value) for item, value in table.items() if not _idle(item, value)}
        if "rule" in words:
            words = {"kind": words.pop("rule"), **words}
        yield name, page.in_words(words, units)


def _idle(key: str, value: Any) -> bool:
    """Whether a value says nothing, or what is said elsewhere."""
    return key in ("steps", "balls") or (key.startswith("spread") and not value)


def _told(value: Any) -> Any:
    if isinstance(value, Mapping) and "kind" in value:
        return page.in_words({key: _told(item) for key, item in value.items()})
    if isinstance(value, list):
        return ", ".join(str(_told(item)) for item in value)
    return value_text(value, 12) if isinstance(value, float) else value


def _gradient(run: BallFolder) -> Iterator[dict[str, Any]]:
    """A row per method, those that were refused last, and one for the closed form."""
    exact = run.exact.get("gradient") or {}
    off = run.exact.get("gradient_error") or {}
    for made in run.gradient:
        depends = made.get("depends") or {}
        cells = []
        for name in run.parameters:
            used = depends.get(name, True)
            error = (off.get(made["method"]) or {}).get(name)
            small = "does not depend" if not used else ""
            if used and error is not None:
                small = f"off by {number(error, 2, signed=True)}" if error else "exactly the closed form’s"
            cells.append((value_text(made["gradient"].get(name), 6), small))
        yield {"method": made["method"], "says": made["says"], "value": value_text(made.get("value"), 6),
               "cells": cells}  # fmt: skip
    if exact:
        cells = [(value_text(exact.get(name), 6), "") for name in run.parameters]
        yield {
            "method": "closed form",
            "says": "The derivative of the exact motion.",
            "value": "–",
            "cells": cells,
        }
    for made in run.refused:
        yield {"method": made["method"], "says": made["says"], "value": "–", "cells": None}


_EXACT = {
    "model": ("Motion", ""), "balls": ("Balls compared", ""),
    "height_error": ("Height off, at the end", " m"),
    "height_error_largest": ("Height off, at most", " m"),
    "height_error_before_contact": ("Height off, before the first contact", " m"),
    "first_contact_time": ("First contact", " s"), "first_contact_step": ("First contact of the run", ""),
    "rest_time": ("Comes to rest", " s"),
}  # fmt: skip
_MODELS = {
    "ExactImpact": "parabolas and impacts with restitution",
    "ExactPenalty": "parabolas and a spring floor",
}


def _exact(run: BallFolder) -> Iterator[tuple[str, str]]:
    """(what, words) of the comparison with the closed form."""
    for key, value in run.exact.items():
        if key in ("gradient", "gradient_error") or value is None:
            continue
        name, unit = _EXACT.get(key, (key.replace("_", " ").capitalize(), ""))
        if key == "model":
            text = _MODELS.get(str(value), str(value))
        elif key == "first_contact_step":
            step = int(value)
            text = (
                f"step {count(step)}, {number(float(run.time(np.array(step))), 6)} s" if step >= 0 else "none"
            )
        elif isinstance(value, float):
            text = f"{number(value, 6 if 'time' in key else 3)}{unit}"
        else:
            text = f"{value_text(value)}{unit}"
        yield name, text


def _variants(run: BallFolder) -> Iterator[dict[str, Any]]:
    """A row per variant, as text."""
    for one in run.variants:
        fork, ball = one.get("fork"), one.get("ball")
        where = f"{one.get('channel') or ''}{f', ball {ball}' if ball is not None and run.balls > 1 else ''}"
        margins = [number(one[key], 2) for key in ("margin", "margin_there") if one.get(key) is not None]
        depends = one.get("depends") or {}
        gradient = [
            (name, number(value), "does not depend" if not depends.get(name, True) else "")
            for name, value in (one.get("gradient") or {}).items()
        ]
        yield {
            "name": one.get("name"),
            "changes": _changes(one.get("changes") or {}),
            "seed": "never" if one.get("seed") is None else count(one["seed"]),
            "fork": "never" if fork is None else count(fork),
            "where": where,
            "margins": margins,
            "separation": number(one.get("separation_end"), 2),
            "iterations": count(one.get("iterations_differ")),
            "loss": number(one.get("loss"), 4),
            "gradient": gradient,
        }


def _changes(changes: Mapping[str, Any]) -> str:
    """Keys and values; keys of one table that are set alike are told together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for key, value in changes.items():
        table, _, name = str(key).rpartition(".")
        groups.setdefault((table, value_text(value, 17)), []).append(name)
    return "; ".join(
        f"{table}{'.' if table else ''}{', '.join(names)} = {text}" for (table, text), names in groups.items()
    )


def _contacts(run: BallFolder) -> Browse:
    """The contact flips nearest to the threshold, in the order of steps."""
    table = run.contacts
    chosen = np.sort(np.argsort(run.margins, kind="stable")[:TABLE_ROWS])
    columns: list[tuple[np.ndarray, int | None]] = [
        (table[name][chosen].astype(int), None) for name in ("step", "ball", "entered")
    ]
    columns += [(table[name][chosen].astype(float), 4) for name in ("height", "margin", "velocity")]
    columns.append((run.margins[chosen].astype(float), 3))
    return Browse(
        name="contacts",
        row_id="contact-rows",
        label="Search contacts",
        placeholder="ball 3, step:100..200, entered, ambiguous"
        if run.balls > 1
        else "step:100..200, entered",
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


def _solver(run: BallFolder) -> Browse:
    """The stop decisions nearest to their tolerance, in the order of steps."""
    table = run.solver
    near = np.abs(table["margin"].astype(float))
    chosen = np.sort(np.argsort(near, kind="stable")[:TABLE_ROWS])
    reason = table["reason"].astype(str)[chosen]
    codes = np.array([_REASONS.index(word) if word in _REASONS else 0 for word in reason.tolist()], int)
    columns: list[tuple[np.ndarray, int | None]] = [
        (table[name][chosen].astype(int), None) for name in ("step", "ball", "iteration")
    ]
    columns += [(table[name][chosen].astype(float), 5) for name in ("residual", "margin")]
    columns += [(table["stopped"][chosen].astype(int), None), (codes, None)]
    each = bool(np.any(table["ball"] >= 0))
    shown = [
        Column(0, "step", kind="count"), Column(1, "ball", kind="count"),
        Column(2, "iteration", kind="count"),
        Column(3, "residual", digits=4), Column(4, "margin", "tolerance − residual", digits=3),
        Column(5, "decision", kind="word", words=("went on", "stopped"), colors=("out", "in")),
        Column(6, "ended by", kind="word", words=("", *_REASONS[1:])),
    ]  # fmt: skip
    return Browse(
        name="stops",
        row_id="stop-rows",
        label="Search stop decisions",
        placeholder=f"{'ball:3, ' if each else ''}step:100..200, iteration:5.., stopped, cap",
        columns=tuple(column for column in shown if each or column.at != 1),
        rows=plain_rows(columns),
        words={"stopped": (5, 1), "on": (5, 0), "tolerance": (6, 2), "cap": (6, 3), "fixed": (6, 4),
               "rest": (6, 6)},
        ranges={"step": 0, "ball": 1, "iteration": 2},
    )  # fmt: skip
