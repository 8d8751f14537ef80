"""Gradient folders without a simulation: an exponential, and flips of which one outweighs the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mdnum.store import RunFolder

TOML = """name = "argon/synthetic"
units = "lj"

[dynamics]
timestep = 0.01
"""
STEPS, RATE = 500, 0.01
NAMES = ("potential.epsilon", "cutoff.radius", "initial.velocities")
#: A quarter of the derivative by the cutoff comes from the first of them.
WEIGHTS = np.array([0.5, -0.3, 0.2, 0.1, *np.full(96, 1.5 / 96)])


def summary(**changes: Any) -> dict[str, Any]:
    """The summary of three methods, of which one misses what the flips add."""
    many = {"shape": [100, 3], "norm": 3.0, "largest": -1.0, "at": [7, 2]}

    def method(word: str, epsilon: float, radius: float, **more: Any) -> dict[str, Any]:
        gradient = {NAMES[0]: epsilon, NAMES[1]: radius, NAMES[2]: many}
        kept = {"says": f"what {word} gives", "value": 1.5, "error": {}, "notes": {}, "details": {}}
        return {"method": word, "gradient": gradient, "seconds": 1.0, **kept, **more}

    def row(word: str, name: str, relative: float, means: str, says: str) -> dict[str, Any]:
        base = {"name": name, "method": word, "reference": "event-aware", "size": 4.0}
        return {**base, "difference": 4 * relative, "relative": relative, "means": means, "says": says}

    weighed = {"crossings": 100, "grazing": 0, "guard": 1e-3, "weight applied": 2.6, "weight left out": 0.0}
    values = (1.0, 2.5, {**many, "norm": 17.0})
    return {
        "world": "grad",
        "question": "grad",
        "system": "argon/synthetic",
        "about": "Nothing was simulated.",
        "atoms": 100,
        "steps": STEPS,
        "timestep": 0.01,
        "units": "lj",
        "loss": {"word": "msd", "about": "mean squared displacement at the last step", "unit": "σ²"},
        "value": 1.5,
        "parameters": [
            {"name": name, "unit": unit, "value": value}
            for name, unit, value in zip(NAMES, ("ε", "σ", "√(ε/m)"), values, strict=True)
        ],
        "energy_jump": 0.02,
        "force_jump": 0.04,
        "reference": "event-aware",
        "methods": [
            method("symmetric", 3.6, 0.0, notes={NAMES[1]: "exactly 0"}),
            method("event-aware", 4.0, 2.0, details=weighed),
            method("finite-differences", 3.9, 1.9, error={NAMES[0]: 0.2, NAMES[1]: 0.1}),
        ],
        "comparisons": [
            row("symmetric", NAMES[0], 0.1, "missing saltation", "decisions are held fixed"),
            row("symmetric", NAMES[1], 1.0, "missing saltation", "decisions are held fixed"),
            row("finite-differences", NAMES[0], 0.025, "truncation and noise", "within 0.2"),
        ],
        "growth": {
            "clock": 0.3, "timestep": 0.01, "rate": RATE, "error": 1e-4,
            "word": "forward bounded, gradient not", "says": "It grew 1.5e2-fold.",
        },
        "flips": {
            "flips": len(WEIGHTS),
            "grazing": 0,
            "smooth": {NAMES[0]: 3.6, NAMES[1]: 0.0},
            "total": {NAMES[0]: 4.0, NAMES[1]: 2.0},
            "share": {
                NAMES[0]: {"smooth": 0.9, "pair enters": 0.04, "pair leaves": 0.06},
                NAMES[1]: {"smooth": 0.0, "pair enters": 0.4, "pair leaves": 0.6},
            },
            "skipped": {},
            "says": "Of 100 flips.",
        },
        "trust": None,
        "spectrum": None,
        "scaling": None,
        "edges": {},
        "not_finite": None,
        "refused": [],
        "left_out": [{"what": "unrolled", "why": "it takes its time", "how": "--methods unrolled"}],
        "findings": [],
        "status": "complete",
        "seconds": 12.0,
        **changes,
    }  # fmt: skip


def write(path: Path, **changes: Any) -> RunFolder:
    """A finished gradient folder.

    Args:
        path: of the folder.
        changes: entries of the summary instead of those of `summary`.
    """
    folder = RunFolder.create(path, world="grad")
    folder.write_system(TOML)
    folder.write_provenance({"command": "mdnum grad"})
    horizon = np.arange(STEPS + 1)
    size = np.exp(RATE * horizon)
    folder.append(
        "growth",
        {
            "horizon": horizon, "step": STEPS - horizon, "onto_positions": size, "onto_velocities": size,
            "size": size, "speed": np.ones(STEPS + 1), f"gradient.{NAMES[0]}": 4 * size / size[-1] - 1,
            f"gradient.{NAMES[1]}": np.where(horizon > 0, 2 * size / size[-1], 0.0),
            f"gradient.{NAMES[2]}": size,
        },
    )  # fmt: skip
    flips = np.arange(len(WEIGHTS))
    folder.append(
        "flip_contributions",
        {
            "step": 1 + 3 * flips, "i": flips, "j": flips + 1, "entered": flips % 2 == 0,
            "margin": np.full(len(flips), 1e-3), "bound": np.full(len(flips), 1e-12),
            "ambiguous": np.zeros(len(flips), bool), "radial_speed": np.where(flips % 2, 0.5, -0.5),
            "weight": WEIGHTS, "grazing": np.zeros(len(flips), bool),
            f"contribution.{NAMES[0]}": 0.2 * WEIGHTS, f"contribution.{NAMES[1]}": WEIGHTS,
        },
    )  # fmt: skip
    folder.finalize()
    folder.write_summary(summary(**changes))
    return folder
