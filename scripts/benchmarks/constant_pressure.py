"""How long does a step at constant temperature or pressure take, relative to a step at constant energy?

Answer. Thermostats add at most 3 %, barostats of isotropic boxes at most 14 %, and barostats of fully
flexible boxes 13 to 35 % (docs/speed.md). It takes five minutes.

The liquid of benchmark.py, float64, hard cutoff, on one core: every integrator makes as many steps as the
others in turn, from the same start. Flips are noted and not decoded. Ratios are medians over the turns, of
processor time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, SKIN, TEMPERATURE, TIMESTEP, liquid
from _output import parser, start, table
from _turns import Claim, claim, finish, in_turn, on_cores, ratios

import mdnum
from mdnum.rollout import Engine

HELD: dict[str, Any] = {"relaxation": 100 * TIMESTEP}
BOX = HELD | {"pressure_relaxation": 1000 * TIMESTEP}
SOFT = BOX | {"compressibility": 0.06}
FULL = {"box": "full"}
FIRST = "constant energy"
#: Times the processor time of a step at constant energy.
MOST = 1.15
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
    """Turns, and their table."""
    options = parser(__doc__)
    options.add_argument("--turns", type=int, default=7)
    options.add_argument("--sizes", nargs="+", type=int, default=[4_000, 32_000], metavar="N")
    options.add_argument("--steps", type=int, default=600_000, metavar="N", help="of a turn, times atoms")
    options.add_argument("--only", nargs="+", metavar="NAME", help="kinds, by a part of their name")
    options.add_argument("--json", action="store_true", help="print one JSON document instead of a table")
    chosen = options.parse_args()
    on_cores(1)
    kinds = {
        name: one for name, one in KINDS.items()
        if name == FIRST or not chosen.only or any(part in name for part in chosen.only)
    }  # fmt: skip
    rows = []
    for size in chosen.sizes:
        atoms = liquid(size).atoms
        steps = max(60, chosen.steps // len(atoms))
        runs = {name: run_of(atoms, kind, numbers, steps) for name, (kind, numbers) in kinds.items()}
        taken = in_turn(runs, chosen.turns, f"{len(atoms)} atoms")
        for name, spent in taken.items():
            own = ratios(taken, name, FIRST)[:, 1]
            rows.append(
                {
                    "integrator": name, "atoms": len(atoms), "steps": steps, "lists": runs[name](),
                    "steps_per_second": steps / np.median(spent[1:, 1]),
                    "over_nve": np.median(own), "least": own.min(), "most": own.max(),
                }
            )  # fmt: skip
    finish(chosen, {"rows": rows}, show, claims)


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    for row in result["rows"]:
        if row["integrator"] != FIRST:
            yield claim(f"{row['integrator']} over NVE, N = {row['atoms']:,}", row["over_nve"], "<=", MOST)


def show(result: dict[str, Any]) -> None:
    """The rows as a table."""
    table(
        "processor time of a step",
        ("integrator", "N", "steps/s", "over NVE", "lists"),
        (
            (
                row["integrator"], f"{row['atoms']:,}", f"{row['steps_per_second']:.0f}",
                f"{row['over_nve']:.3f} ({row['least']:.2f} to {row['most']:.2f})", row["lists"],
            )
            for row in result["rows"]
        ),
    )  # fmt: skip


if __name__ == "__main__":
    start(main)
