"""What does a step at constant temperature or pressure cost beside one at constant energy?

Answer. Thermostats 2 to 3 %, barostats 6 to 10 %, those of a full box 42 to 51 % (docs/speed.md).
It takes five minutes.

The liquid of benchmark.py, float64, hard cutoff, on one core: every integrator makes as many steps as the
others in turn, from the same start. Flips are noted and not decoded. Ratios are medians over the turns, of
processor time.
"""

from __future__ import annotations

import argparse
import os
import time
from statistics import median
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
from _liquid import R_CUT, SKIN, TEMPERATURE, TIMESTEP, liquid
from _output import table

import mdnum
from mdnum.rollout import Engine

HELD: dict[str, Any] = {"relaxation": 100 * TIMESTEP}
BOX = HELD | {"pressure_relaxation": 1000 * TIMESTEP}
SOFT = BOX | {"compressibility": 0.06}
FULL = {"box": "full"}
#: Name of each, integrator, and its numbers beside temperature and pressure.
KINDS = {
    "constant energy": ("nve", {}),
    "Nosé-Hoover chain": ("nose-hoover", HELD),
    "CSVR": ("csvr", HELD),
    "MTK": ("mtk", BOX),
    "MTK, full box": ("mtk", BOX | FULL),
    "cell rescaling": ("cell-rescaling", SOFT),
    "cell rescaling, full box": ("cell-rescaling", SOFT | FULL),
}


def main() -> None:
    """Turns, and their tables."""
    ask = argparse.ArgumentParser(description="constant temperature and pressure beside constant energy")
    ask.add_argument("--turns", type=int, default=7)
    ask.add_argument("--sizes", nargs="+", type=int, default=[4_000, 32_000], metavar="N")
    ask.add_argument("--steps", type=int, default=600_000, metavar="N", help="of a turn, times atoms")
    ask.add_argument("--only", nargs="+", metavar="NAME", help="kinds, by a part of their name")
    asked = ask.parse_args()
    # one core, before XLA starts threads
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    kinds = {
        name: one for name, one in KINDS.items() if not asked.only or any(part in name for part in asked.only)
    }
    kinds = {"constant energy": KINDS["constant energy"]} | kinds
    for size in asked.sizes:
        atoms, made = liquid(size).atoms, {}
        steps = max(60, asked.steps // len(atoms))
        for name, (kind, numbers) in kinds.items():
            pressure: dict[str, Any] = {"pressure": 0.5} if "pressure_relaxation" in numbers else {}
            made[name] = mdnum.simulation(
                atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("hard", R_CUT), units="lj", skin=SKIN, seed=2,
                timestep=TIMESTEP, temperature=TEMPERATURE, integrator=kind, dynamics=numbers, **pressure,
            )  # fmt: skip
        spent: dict[str, list[float]] = {name: [] for name in made}
        lists = {}
        for turn in range(asked.turns + 1):
            for name, simulation in made.items():
                start = time.process_time()
                lists[name] = sum(one.opens for one in Engine(simulation, steps, rows=False).segments())
                # the first one compiles
                spent[name] += [time.process_time() - start] if turn else []
        first, rows = spent["constant energy"], []
        for name, times in spent.items():
            ratios = sorted(a / b for a, b in zip(times, first, strict=True))
            spread = f"{median(ratios):.3f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"
            rows.append([name, f"{steps / median(times):.0f}", spread, f"{lists[name]}"])
        table(f"{len(atoms)} atoms, {steps} steps", ["integrator", "steps/s", "over NVE", "lists"], rows)


if __name__ == "__main__":
    main()
