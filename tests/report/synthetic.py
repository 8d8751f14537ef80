"""Run folders without a rollout: pairs that oscillate about the cutoff, an energy that pays for each flip."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mdnum.store import RunFolder
from mdnum.store.files import write_text

TOML = """about = "Liquid argon (Rahman 1964), 864 atoms at 94.4 K, hard cutoff."
units = "metal"
potential = {kind = "lennard-jones", sigma = 3.405, epsilon = 0.0103235}
cutoff = {kind = "hard", radius = 8.5125, compare = "r2 <"}
neighbors = {skin = 1.0, builder = "auto", rebuild = {every = 1, delay = 0, check = true}}
dynamics = {kind = "nve", timestep = 0.002, temperature = 94.4, steps = 2000, seed = 7}
precision = {state = "float64", force = "float64", decision = "float64", accumulate = "float64"}
"""

#: Cutoff, skin, time step, and the energy of a pair at the cutoff.
RADIUS, SKIN, DT, JUMP = 8.5125, 1.0, 0.002, -1.681e-4


def make_run(
    path: Path,
    *,
    steps: int = 400,
    atoms: int = 864,
    candidates: int = 4000,
    drop_flip: bool = False,
    finish: bool = True,
    summary: dict[str, Any] | None = None,
    toml: str = TOML,
) -> RunFolder:
    """Writes a folder as a rollout would.

    Args:
        steps, atoms: size of the run.
        candidates: pairs whose distance oscillates about the cutoff (about 0.045 flips each and step).
        drop_flip: leave one flip out of the ledger, as a faulty recorder would.
        finish: end as a complete run; else leave it as a killed one.
        summary: entries that replace the honest ones.
    """
    rng = np.random.default_rng(1)
    pairs = _distinct_pairs(rng, atoms, candidates)
    count = len(pairs)
    frequency = rng.gamma(3.0, 0.018, count)
    amplitude = rng.gamma(2.0, 0.35, count) + 0.02
    phase = rng.uniform(0, 2 * np.pi, count)
    center = RADIUS + rng.normal(0, 0.45, count)

    folder = RunFolder.create(path)
    write_text(folder.path / "system.toml", toml)
    base = int(27.3 * atoms) - count // 2
    before, energy, start, moved, first_list = None, 0.0, 0, 0.0, 0
    rows: list[dict[str, Any]] = []
    epochs: list[dict[str, Any]] = []
    written = 0
    integrator = np.cumsum(rng.normal(0, 2e-7, steps + 1)) + 2e-5 * np.sin(np.arange(steps + 1) * 0.05)
    for step in range(steps + 1):
        angle = frequency * step + phase
        distance = center + amplitude * np.sin(angle)
        margin = RADIUS**2 - distance**2
        inside = margin > 0
        flipped = np.flatnonzero(inside != before) if before is not None else np.zeros(0, int)
        before = inside
        if drop_flip and step == steps // 2 and len(flipped):
            energy += JUMP * (1 if inside[flipped[0]] else -1)
            flipped = flipped[1:]
        entered = inside[flipped]
        jumps = np.where(entered, JUMP, -JUMP)
        energy += jumps.sum()
        bound = 4.5 * np.finfo(float).eps * distance[flipped] ** 2
        folder.append("flips", {
            "step": np.full(len(flipped), step), "i": pairs[flipped, 0], "j": pairs[flipped, 1],
            "entered": entered, "distance": distance[flipped], "margin": margin[flipped],
            "radial_speed": (amplitude * frequency * np.cos(angle))[flipped] / DT, "energy_jump": jumps,
            "force_jump": np.where(entered, 1.18e-4, -1.18e-4), "bound": bound,
            "ambiguous": np.abs(margin[flipped]) <= bound,
        })  # fmt: skip
        potential = -62.1 + energy + 0.9 * np.sin(step * 0.031) + 0.4 * np.sin(step * 0.173)
        total = -51.5312 + energy + integrator[step]
        moved += rng.gamma(40.0, 0.0011)
        rows.append({
            "step": step, "time": step * DT, "potential": potential, "kinetic": total - potential,
            "total": total, "temperature": (total - potential) / (1.5 * atoms * 8.617e-5),
            "pressure": 0.012 + 0.01 * rng.normal(), "pairs": base + int(inside.sum()),
            "entered": int(entered.sum()), "left": int((~entered).sum()), "displacement": moved,
            "energy_jump": jumps.sum(), "ambiguous": 0, "conserved": total,
            "min_margin": float(np.min(np.abs(margin), initial=RADIUS**2)),
        })  # fmt: skip
        if 2 * moved > SKIN * 0.96 or step == steps:
            epochs.append({
                "epoch": len(epochs), "start": start, "length": step - start, "displacement": moved,
                "skin_consumed": 2 * moved / SKIN, "capacity": 112, "occupancy": int(rng.integers(88, 104)),
                "pairs_listed": int(2 * base * 1.39) + int(rng.integers(400)),
                "reason": "end" if step == steps else "displacement", "dangerous": False, "lost_pairs": 0,
                "lost_pair_steps": 0, "first_lost_step": -1, "build_ms": float(rng.gamma(30.0, 0.2)),
                "margin": -float(rng.exponential(0.01)),
            })  # fmt: skip
            start, moved = step, 0.0
        if step in (steps // 2, steps) and (finish or step < steps):
            _flush(folder, rows[written:], epochs[first_list:])
            written, first_list = len(rows), len(epochs)
            folder.checkpoint({"step": step}, force=True)
    if not finish:
        folder.close()
        return RunFolder.open(path)
    folder.finalize()
    drift = (rows[-1]["total"] - rows[0]["total"]) / (atoms * steps * DT)
    folder.write_summary({
        "system": "argon/liquid-864", "units": "metal", "atoms": atoms, "steps": steps, "time": steps * DT,
        "flips_entered": sum(row["entered"] for row in rows), "flips_left": sum(row["left"] for row in rows),
        "rebuilds": len(epochs) - 1, "dangerous_builds": 0, "lost_pairs": 0, "lost_pair_steps": 0,
        "first_lost_step": -1, "ambiguous": 0, "energy_drift": drift, "energy_budget_checks": 21,
        "energy_budget_residual": 2.6e-14 + (abs(JUMP) if drop_flip else 0),
        "energy_budget_tolerance": abs(JUMP) / 10, "energy_budget_closes": not drop_flip,
        "pairs_first": rows[0]["pairs"], "pairs_last": rows[-1]["pairs"], "steps_per_second": 412.7,
        "cutoff": {"kind": "hard", "radius": RADIUS, "compare": "r2 <", "energy_jump": JUMP,
                   "force_jump": 1.18e-4, "smoothness": -1},
        "ase": {"energy_rel": 3.4e-15, "force_max": 2.2e-16, "stress_max": 1.1e-17, "force_scale": 0.0281,
                "ok": True},
        "status": "complete",
        **(summary or {}),
    })  # fmt: skip
    folder.write_provenance({
        "command": "mdnum run argon/liquid-864", "mdnum": "0.1.0",
        "packages": {"jax": "0.10.1", "jax-md": "0.2.29"}, "fingerprint": "9f1c52d0a7b3e4c8",
    })  # fmt: skip
    return folder


def _flush(folder: RunFolder, rows: list[dict[str, Any]], epochs: list[dict[str, Any]]) -> None:
    for name, part in (("series", rows), ("epochs", epochs)):
        if part:
            folder.append(name, {key: np.array([row[key] for row in part]) for key in part[0]})


def _distinct_pairs(rng: np.random.Generator, atoms: int, count: int) -> np.ndarray:
    drawn = rng.integers(0, atoms, (2 * count + 50, 2))
    drawn = np.sort(drawn[drawn[:, 0] != drawn[:, 1]], axis=1)
    distinct = np.unique(drawn, axis=0)
    return rng.permutation(distinct)[:count]
