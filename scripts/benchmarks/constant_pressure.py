"""What does a step at constant temperature or pressure cost beside one at constant energy?

Answer. Thermostats 2 to 3 %, barostats 6 to 10 %, those of a full box 42 to 51 % (docs/speed.md).
It takes five minutes.

The liquid of benchmark.py, float64, hard cutoff, on one core: every integrator makes as many steps as the
others in turn, from the same start. Flips are noted and not decoded. Ratios are medians over the turns, of
processor time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, SKIN, TEMPERATURE, TIMESTEP, liquid
from _output import parser, start, table
from _turns import in_turn, on_cores, ratios

import mdnum
from mdnum.rollout import Engine

HELD: dict[str, Any] = {"relaxation": 100 * TIMESTEP}
BOX = HELD | {"pressure_relaxation": 1000 * TIMESTEP}
SOFT = BOX | {"compressibility": 0.06}
FULL = {"box": "full"}
FIRST = "constant energy"
#: Name of each, integrator, and its numbers beside temperature and pressure.
KINDS = {
    FIRST: ("nve", {}),
    "Nosé-Hoover chain": ("nose-hoover", HELD),
    "CSVR": ("csvr", HELD),
    "MTK": ("mtk", BOX),
    "MTK, full box": ("mtk", BOX | FULL),
    "cell rescaling": ("cell-rescaling", SOFT),
    "cell rescaling, full box": ("cell-rescaling", SOFT | FULL),
}


def run_of(atoms: Any, kind: str, numbers: dict[str, Any], steps: int) -> Callable[[], int]:
    """A run, and the lists that it builds."""
    pressure: dict[str, Any] = {"pressure": 0.5} if "pressure_relaxation" in numbers else {}
    simulation = mdnum.simulation(
        atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("hard", R_CUT), units="lj", skin=SKIN, seed=2,
        timestep=TIMESTEP, temperature=TEMPERATURE, integrator=kind, dynamics=numbers, **pressure,
    )  # fmt: skip
    return lambda: sum(one.opens for one in Engine(simulation, steps, rows=False).segments())


def main() -> None:
    """Turns, and their tables."""
    options = parser(__doc__)
    options.add_argument("--turns", type=int, default=7)
    options.add_argument("--sizes", nargs="+", type=int, default=[4_000, 32_000], metavar="N")
    options.add_argument("--steps", type=int, default=600_000, metavar="N", help="of a turn, times atoms")
    options.add_argument("--only", nargs="+", metavar="NAME", help="kinds, by a part of their name")
    chosen = options.parse_args()
    on_cores(1)
    kinds = {
        name: one for name, one in KINDS.items()
        if name == FIRST or not chosen.only or any(part in name for part in chosen.only)
    }  # fmt: skip
    for size in chosen.sizes:
        atoms = liquid(size).atoms
        steps = max(60, chosen.steps // len(atoms))
        runs = {name: run_of(atoms, kind, numbers, steps) for name, (kind, numbers) in kinds.items()}
        taken = in_turn(runs, chosen.turns, f"{len(atoms)} atoms")
        rows = []
        for name, spent in taken.items():
            own = ratios(taken, name, FIRST)[:, 1]
            spread = f"{np.median(own):.3f} ({own.min():.2f} to {own.max():.2f})"
            rows.append((name, f"{steps / np.median(spent[1:, 1]):.0f}", spread, runs[name]()))
        table(f"{len(atoms)} atoms, {steps} steps", ("integrator", "steps/s", "over NVE", "lists"), rows)


if __name__ == "__main__":
    start(main)
