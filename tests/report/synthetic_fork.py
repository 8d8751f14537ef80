"""Fork folders without a simulation: two exponentials, written as a comparison would be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mdnum.store import RunFolder
from mdnum.store.files import write_text

TOML = """name = "argon/synthetic"
units = "lj"

[dynamics]
timestep = 0.01
"""
RATE, SEED, FORK, SIZE, TOLERANCE = 0.02, 5, 400, 1e-9, 0.1
STEPS = 1500
#: From here on the nearest pair is closer to its cutoff than the runs can have moved it.
NEAR = 390
SHARES = [
    {"what": "decisions", "reference": "A", "steps": 179, "at_least": True, "e_foldings": 3.58},
    {"what": "arithmetic", "reference": "B", "steps": -1, "at_least": False, "e_foldings": -0.02},
]
LYAPUNOV = {
    "rate": 0.019, "error": 0.0004, "rate_time": 1.9, "error_time": 0.04, "steps": 750, "chaotic": True,
    "ratio": 1.05, "ulp": 8.9e-16, "ulp_split": 1702,
}  # fmt: skip
MINIMAL = {
    "pairs": [
        {"i": 3, "j": 4, "differs": [[400, 407], [420, 421], [430, 460], [500, None]]},
        {"i": 3, "j": 9, "differs": [[410, None]]},
    ],
    "proven": True, "fork_alone": False, "candidates": 77, "tests": 23, "horizon": 1652,
    "code": "proven", "reason": "2 pairs are enough.",
}  # fmt: skip
PINNED = {
    "pin": "fork", "pairs": [[3, 4]], "first": FORK, "last": FORK + 6, "split": None, "free": 1321,
    "until": STEPS, "largest": 2e-9, "reason": None,
}  # fmt: skip


def two_by_two(split: int | None) -> list[dict[str, Any]]:
    """The table of a run under either decisions; A under B's was not run."""
    rows = (("A", "A", "A", None), ("B", "B", "A", split), ("B", "A", "A", None), ("A", "A", "B", split),
            ("B", "B", "B", None), ("B", "A", "B", split and split - 1))  # fmt: skip
    return [
        {"arithmetic": x, "decisions": y, "reference": z, "split": at, "until": STEPS} for x, y, z, at in rows
    ]


def make_fork(
    path: Path,
    *,
    summary: dict[str, Any] | None = None,
    imposed: bool = True,
    forks: bool = True,
    toml: str = TOML,
) -> RunFolder:
    """Writes a folder as `mdnum fork` would: free runs jump at the fork, those under A's decisions do not.

    Args:
        summary: entries that replace the honest ones.
        imposed: with a counterfactual.
        forks: with a fork; else the separation stays small.
    """
    step = np.arange(STEPS + 1)
    quiet = np.where(step < SEED, 0.0, SIZE)
    free = quiet.copy()
    if forks:
        free[FORK:] = np.minimum(SIZE * np.exp(RATE * (step[FORK:] - FORK)), 0.5)
    nothing = np.full(len(step), np.nan)
    after = forks & (step >= FORK)
    folder = RunFolder.create(path, world="fork")
    write_text(folder.path / "system.toml", toml)
    folder.append(
        "separation",
        {
            "step": step, "time": 0.01 * step, "free": free, "imposed": quiet if imposed else nothing,
            "back": nothing, "cross": np.where(after, 1 + (step - FORK) // 50, 0),
            "overridden": np.where(step % 200 == 0, after, False).astype(float) if imposed else nothing,
            "furthest": np.where((step % 200 == 0) & after, 1e-8, 0.0) if imposed else nothing,
            "energy_a": np.full(len(step), -5.0), "energy_b": -5.0 + free,
            "energy_imposed": -5.0 + quiet if imposed else nothing,
            "imposed_from_b": free if imposed else nothing, "back_from_a": nothing,
            "nearest_a": np.where(step < NEAR, 1e-6, 1e-9), "nearest_b": np.full(len(step), 1e-6),
            "ambiguous_a": np.zeros(len(step)), "ambiguous_b": np.where(step > 70, 2.0, 0.0),
            "repeat_1": 1.1 * free,
            "repeat_2": 0.9 * free,
        },
    )  # fmt: skip
    split = int(np.argmax(free > TOLERANCE)) if forks else None
    if forks:
        n = 7_000
        folder.append(
            "cross_flips",
            {
                "step": np.minimum(FORK + np.arange(n) // 8, STEPS),
                "i": np.arange(n) % 7, "j": 7 + np.arange(n) % 11,
                "differs": np.arange(n) % 2 == 0, "run": np.where(np.arange(n) % 3 == 0, "A", "B"),
                "entered": np.arange(n) % 2 == 1, "margin": np.linspace(-1e-9, 1e-3, n),
                "bound": np.full(n, 2e-15),
            },
        )  # fmt: skip
        rng = np.random.default_rng(0)
        place = np.concatenate([[[-0.75, 0, 0], [0.75, 0, 0]], rng.uniform(-1.8, 1.8, (30, 3))])
        moved = SIZE * rng.standard_normal(place.shape)
        vectors = {name: place[:, k] for k, name in enumerate("xyz")}
        vectors |= {f"d{name}": moved[:, k] for k, name in enumerate("xyz")}
        folder.append("neighborhood", {"atom": 3 + np.arange(len(place)), **vectors})
    folder.finalize()
    folder.write_provenance({"command": "mdnum fork argon/synthetic", "fingerprint": "0123456789abcdef"})
    fit = {
        "rate": RATE,
        "r_squared": 0.99,
        "first": FORK,
        "last": 1300,
        "intercept": np.log(SIZE) - RATE * FORK,
    }
    folder.write_summary(
        {
            "system": "argon/synthetic", "about": "Nothing but exponentials.",
            "choice": "reduction=exact", "choice_about": "force sums exact", "must_hold": False,
            "difference": "force sums exact, not sequential",
            "changes": {"precision.reduction": ["sequential", "exact"]}, "atoms": 108, "steps": STEPS,
            "steps_asked": STEPS, "timestep": 0.01, "units": "lj", "r_cut": 1.5, "first_bit": SEED,
            "first_bit_time": 0.01 * SEED, "fork": FORK if forks else None,
            "fork_time": 4.0 if forks else None,
            "split": split, "split_time": None if split is None else 0.01 * split, "tolerance": TOLERANCE,
            "decision": DECISION if forks else None, "effect": "cause" if forks else "no fork",
            "reasons": [{"code": "not_run", "split": 1321}, {"code": "within"}],
            "growth_rate": RATE if forks else None, "growth_rate_time": RATE / 0.01 if forks else None,
            "r_squared": 0.99 if forks else None, "growth": {"B": fit if forks else dict.fromkeys(fit)},
            "predicted_split": None, "predicted_by": None,
            "splits": {"B": split, "B|A": None} if imposed else {"B": split},
            "e_foldings": None, "count": None, "repeated": [],
            "imposed_until": STEPS if imposed else None, "imposed_largest": SIZE,
            "separation_end": float(free[-1]),
            "separation_largest": float(free.max()), "overridden": 6, "cross_flips": 7_000 if forks else 0,
            "cross_flips_kept": 7_000 if forks else 0,
            "table": two_by_two(split) if imposed else [], "shares": SHARES if split and imposed else [],
            "certified_horizon": {"A": STEPS, "B": 70}, "ambiguous": {"A": 0, "B": 2 * (STEPS - 70)},
            "ambiguous_steps": {"A": 0, "B": STEPS - 70},
            "ambiguous_first": {
                "A": None, "B": {"step": 71, "i": 5, "j": 8, "margin": 1.5e-7, "bound": 6e-6},
            },
            "lists_complete": {"A": True, "B": True}, "protected_until": NEAR - 1 if forks else STEPS,
            "shadow": "A", "shadow_horizon": FORK - 1 if forks else STEPS, "lyapunov": LYAPUNOV,
            "lyapunov_reason": None, "minimal": MINIMAL if forks else None,
            "pinned": PINNED if forks else None, "failed": {},
            "findings": [], "status": "complete", "seconds": 3.5,
        }
        | (summary or {})
    )  # fmt: skip
    return folder


DECISION: dict[str, Any] = {
    "channel": "pair", "step": FORK, "run": "B", "i": 3, "j": 4, "entered": True, "space": "r2",
    "margin": 3e-10, "bound": 2e-15, "ambiguous": False, "decided": {"A": 0, "B": 1},
    "protects": 2, "margins": {"A": -6e-10, "B": 3e-10},
    "bounds": {"A": 2e-15, "B": 2e-15}, "ambiguous_in": [], "cutoffs": {"A": 1.5, "B": 1.5},
    "distance": 1.4999999999, "margin_length": 1e-10, "separation_before": 1e-9,
    "protected": 0.1, "also": 0,
}  # fmt: skip


def make_screen(path: Path, summary: dict[str, Any] | None = None) -> RunFolder:
    """Writes the folder of a screening."""
    folder = RunFolder.create(path, world="screen")
    write_text(folder.path / "system.toml", TOML)
    folder.finalize()
    folder.write_summary(
        {
            "system": "argon/synthetic", "about": "Nothing.", "atoms": 108,
            "steps": 1000, "steps_asked": 1000, "timestep": 0.01, "units": "lj",
            "ranking": [
                ranked("precision.state", first_bit=0, fork=303, split=900), ranked("skin", first_bit=1),
                ranked("order@exact", must_hold=True), ranked("ulps=dynamics.temperature:+1", first_bit=0),
            ],
            "not_applicable": [{"choice": "noise", "reason": "constant energy has none"}],
            "findings": [], "status": "complete", "seconds": 60.0,
        }
        | (summary or {})
    )  # fmt: skip
    return folder


def ranked(choice: str, **entries: Any) -> dict[str, Any]:
    """A line of a ranking; by default of a choice that changes nothing."""
    return {
        "choice": choice, "difference": f"{choice} differs", "first_bit": None, "fork": None, "split": None,
        "must_hold": False, "held": None, "steps": 1000, "failed": "",
    } | entries  # fmt: skip
