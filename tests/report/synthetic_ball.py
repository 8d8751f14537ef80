"""Run folders of a ball without mdnum's ball: a projection in plain numpy, written as a run would be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mdnum.store import RunFolder

TOML = """name = "ball/synthetic"
about = "Three balls on a floor that a solver pushes them out of."
world = "ball"

[start]
height = [1.0, 0.7, 0.4]
velocity = 0.0

[flight]
gravity = 9.81

[flight.control]
kind = "none"

[contact]
kind = "projection"
k = 0.5
alpha = 0.5
restitution = 0.8

[stop]
rule = "sum"
tol = 1e-6
max_iter = 40

[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 150

[precision]
state = "float64"
decision = "float64"
reduction = "sequential"

[gradient]
of = ["k", "y0"]
methods = ["unrolled", "implicit"]

[variants.float32]
"precision.state" = "float32"
"precision.decision" = "float32"
"""

H, GRAVITY, GAIN, ALPHA, BOUNCE, TOL = 0.01, 9.81, 0.5, 0.5, 0.8, 1e-6


def make_ball(
    path: Path,
    *,
    steps: int = 150,
    max_iter: int = 60,
    summary: dict[str, Any] | None = None,
    toml: str = TOML,
    drop_flip: bool = False,
    tables: bool = True,
) -> RunFolder:
    """Writes a folder as `mdnum ball` would.

    Args:
        max_iter: the cap; below 40 it is met.
        summary: entries that replace the honest ones.
        drop_flip: leave one contact flip out of the table.
        tables: write heights, stop decisions and separations too.
    """
    y, v = np.array([1.0, 0.7, 0.4]), np.zeros(3)
    touching = np.zeros(3, bool)
    rows: dict[str, list[Any]] = {name: [] for name in _STEPS}
    contacts: dict[str, list[Any]] = {name: [] for name in _CONTACTS}
    solver: dict[str, list[Any]] = {name: [] for name in _SOLVER}
    heights: dict[str, list[Any]] = {name: [] for name in ("step", "ball", "y", "v")}
    ended = {"tolerance": 0, "cap": 0}
    _add(rows, 0, 0.0, 0, 0, 0, 0, "none", np.nan, np.nan, np.nan, 0, y.mean(), _energy(y, v))
    _heights(heights, 0, y, v)
    for step in range(1, steps + 1):
        v = v - GRAVITY * H
        speed, free = v.copy(), y + H * v
        inside = free < 0
        flipped = np.flatnonzero(inside != touching)
        for ball in flipped:
            bound = 4e-16 * max(abs(free[ball]), 0.1)
            _add(contacts, step, ball, inside[ball], free[ball], -free[ball], speed[ball], bound, False)
        touching = inside
        deep, count = np.maximum(-free, 0.0), 0
        while True:
            residual = deep.sum()
            stop = residual < TOL
            last = stop or count == max_iter
            if inside.any():
                reason = "" if not last else "tolerance" if stop else "cap"
                _add(solver, step, -1, count, residual, TOL - residual, stop, reason)
            if last:
                break
            deep, count = deep - ALPHA * GAIN * deep, count + 1
        word = "none" if not inside.any() else "tolerance" if stop else "cap"
        if word in ended:
            ended[word] += 1
        y = np.maximum(np.where(inside, -deep, free), 0.0)
        v = np.where(inside, -BOUNCE * np.minimum(v, 0.0), v)
        entered = int(inside[flipped].sum())
        near = float(np.abs(free).min())
        _add(
            rows, step, step * H, int(inside.sum()), entered, len(flipped) - entered, count, word, residual,
            TOL - residual, near, 0, y.mean(), _energy(y, v),
        )  # fmt: skip
        _heights(heights, step, y, v)
    if drop_flip:
        contacts = {name: values[1:] for name, values in contacts.items()}
    folder = RunFolder.create(path, world="ball")
    folder.write_system(toml)
    folder.append("steps", {name: np.array(values) for name, values in rows.items()})
    if contacts["step"]:
        folder.append("contacts", {name: np.array(values) for name, values in contacts.items()})
    if tables:
        folder.append("solver", {name: np.array(values) for name, values in solver.items()})
        folder.append("heights", {name: np.array(values) for name, values in heights.items()})
    folder.finalize()
    entered = int(np.sum(rows["entered"]))
    folder.write_summary(
        {
            "world": "ball",
            "system": "ball/synthetic",
            "balls": 3,
            "steps": steps,
            "time": steps * H,
            "contact_kind": "projection",
            "integrator": "semi-implicit-euler",
            "flips_entered": entered,
            "flips_left": int(np.sum(rows["left"])),
            "first_contact": int(np.argmax(np.array(rows["contacts"]) > 0)),
            "iterations_total": int(np.sum(rows["iterations"])),
            "iterations_max": int(np.max(rows["iterations"])),
            "ended": {word: n for word, n in ended.items() if n},
            "ambiguous": 0,
            "ambiguous_contacts": 0,
            "ambiguous_stops": 0,
            "smallest_stop_margin": 1.25e-8,
            "not_finite": None,
            "loss": 0.123,
            "gradient": [
                made("unrolled", "Through the iterations that ran.", {"k": -2.5e-5, "y0": 0.75}),
                made("implicit", "Of the fixed point.", {"k": -2.51e-5, "y0": 0.75}),
            ],
            "variants": [],
            "exact": None,
            "steps_per_second": None,
            "seconds": 1.5,
            "status": "complete",
        }
        | (summary or {})
    )
    folder.write_provenance({"command": "mdnum ball ball/synthetic", "fingerprint": "0123456789abcdef"})
    return folder


def made(
    method: str, says: str, gradient: dict[str, float | None], depends: dict[str, bool] | None = None
) -> dict[str, Any]:
    """A derivative as summary.json has it."""
    depends = dict.fromkeys(gradient, True) | (depends or {})
    return {"method": method, "says": says, "value": 0.123, "gradient": gradient, "depends": depends,
            "refused": False}  # fmt: skip


def variant(name: str, **entries: Any) -> dict[str, Any]:
    """A comparison as summary.json has it; by default one that changed nothing."""
    return {
        "name": name,
        "changes": {"precision.state": "float32"},
        "seed": None,
        "fork": None,
        "channel": None,
        "ball": None,
        "margin": None,
        "margin_there": None,
        "separation_end": 0.0,
        "iterations_differ": 0,
        "contacts_differ": 0,
        "loss": 0.123,
        "gradient": {"k": -2.5e-5, "y0": 0.75},
        "depends": {"k": True, "y0": True},
    } | entries


_STEPS = (
    "step", "time", "contacts", "entered", "left", "iterations", "reason", "residual", "stop_margin",
    "min_margin", "ambiguous", "mean_height", "energy",
)  # fmt: skip
_CONTACTS = ("step", "ball", "entered", "height", "margin", "velocity", "bound", "ambiguous")
_SOLVER = ("step", "ball", "iteration", "residual", "margin", "stopped", "reason")


def _add(columns: dict[str, list[Any]], *row: Any) -> None:
    for values, value in zip(columns.values(), row, strict=True):
        values.append(value)


def _heights(columns: dict[str, list[Any]], step: int, y: np.ndarray, v: np.ndarray) -> None:
    for ball in range(len(y)):
        _add(columns, step, ball, y[ball], v[ball])


def _energy(y: np.ndarray, v: np.ndarray) -> float:
    return float(np.mean(GRAVITY * y + 0.5 * v * v))
