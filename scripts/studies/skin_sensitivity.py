"""How much skin does a neighbor list need, and what does rebuilding it blindly cost?

Answer. In argon/liquid-864 no pair is lost with any skin as long as displacements are checked, and 1 Å is
the fastest of three. Rebuilt blindly every 80 steps, the list loses 665 pairs with 0.33 Å, 2 with 1 Å and
none with 1.5 Å; no build was "dangerous". It takes 25 s.

A Verlet list holds pairs out to r_cut + skin. Rebuilt when some atom has moved by half the skin
("check"), it never misses a pair; rebuilt blindly every k steps, it may. The same start is run with
every skin under every rule, each step whose skin was overdrawn is audited against a fresh search,
and the table says:

    rebuilds     lists built after the first
    dangerous    rebuilds that fired at the first step allowed, LAMMPS's warning sign
    skin used    largest share of the skin that motion had used up; above 1, pairs can be lost
    lost pairs   different pairs that were inside the cutoff and not in the list
    pair-steps   the same, counted at every step they were missing
    first lost   the step of the first one
    steps/s      recorded rollout after compilation, without decoding and audit

How to read it. Choose the fastest of the rows that lost nothing. "dangerous" warns where nothing
was lost and can be silent where something was: believe the lost pairs. A blind rule is safe only
while every atom of the run stays slower than skin / (2 k timestep), which a hotter or a longer run
will not.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table
from _record import record

from mdnum.errors import InputError
from mdnum.rollout import Engine
from mdnum.systems import Simulation, System, build, load


@dataclass(frozen=True)
class Row:
    """One run; every = 0 for the rule that checks displacements."""

    skin: float
    every: int
    rebuilds: int
    dangerous: int
    used: float
    lost: int
    lost_steps: int
    first_lost: int
    rate: float

    @property
    def rule(self) -> str:
        """The rule in words."""
        return f"blind, every {self.every}" if self.every else "check"


def speed(simulation: Simulation, steps: int) -> float:
    """Steps per second of a recorded rollout whose program has been compiled."""
    began = time.perf_counter()
    for _ in Engine(simulation, steps).segments():
        pass
    return (steps + 1) / (time.perf_counter() - began)


def study(system: System, skin: float, every: int, steps: int) -> Row:
    """Run one skin under one rule."""
    overrides = {
        "neighbors.skin": skin,
        "neighbors.rebuild.check": every == 0,
        "neighbors.rebuild.every": max(every, 1),
        "neighbors.rebuild.delay": 0,
    }
    simulation = build(load(system.path or system.name, overrides))
    made = record(simulation, steps)
    health = made.health
    return Row(
        skin,
        every,
        health.rebuilds,
        health.dangerous,
        2 * float(np.max(made.displacement)) / skin,
        len(health.lost),
        health.lost_pair_steps,
        health.first_lost_step,
        speed(simulation, steps),
    )


def draw(rows: list[Row], steps: int, unit: str, path: Path) -> None:
    """Lost pair-steps and speed against the skin, a line per rule."""
    drawn = figure(9.0, 4.0)
    lost, rate = drawn.subplots(1, 2)
    rules = list(dict.fromkeys((row.every, row.rule) for row in rows))
    for (every, rule), color in zip(rules, COLORS * len(rules), strict=False):
        mine = sorted((row for row in rows if row.every == every), key=lambda row: row.skin)
        skins = [row.skin for row in mine]
        lost.plot(skins, [row.lost_steps / steps for row in mine], "o-", ms=4, color=color, label=rule)
        rate.plot(skins, [row.rate for row in mine], "-", lw=0.8, color=color)
        for row in mine:
            face = color if row.lost == 0 else "white"
            rate.plot(row.skin, row.rate, "o", ms=5, color=color, mfc=face)
    lost.set_ylim(bottom=0)
    lost.set_title("lost pairs per step")
    rate.set_title("steps per second (hollow: pairs were lost)")
    rate.set_ylim(bottom=0)
    for axes in (lost, rate):
        axes.set_xlabel(f"skin ({unit})")
    drawn.legend(loc="outside lower center", ncols=len(rules))
    save(drawn, path)


def main() -> None:
    """Parse, run every skin under every rule, print and draw."""
    made = parser(__file__, __doc__)
    made.add_argument("system", nargs="?", default="argon/liquid-864")
    made.add_argument("--steps", type=int, default=400, help="steps of each run (default 400)")
    made.add_argument(
        "--skins", nargs="+", type=float, metavar="X",
        help="skins in the system's unit (default a third of, once and one and a half times its own)",
    )  # fmt: skip
    made.add_argument(
        "--every", nargs="+", type=int, default=[0, 40, 80], metavar="K",
        help="rebuild blindly every so many steps; 0 checks displacements (default 0 40 80)",
    )  # fmt: skip
    chosen = made.parse_args()
    system = load(chosen.system)
    skins = chosen.skins or [round(factor * system.spec.skin, 6) for factor in (1 / 3, 1.0, 1.5)]
    if min(skins) <= 0:
        raise InputError("a skin must be longer than 0 to be used up", where="--skins")
    if chosen.steps < 1 or min(chosen.every) < 0:
        raise InputError("steps start at 1 and intervals at 0")
    rows = []
    for skin in skins:
        for every in chosen.every:
            say(f"{system.name}: skin {skin:g} {system.units.length}, every {every or 'check'}")
            rows.append(study(system, skin, every, chosen.steps))
    unit = system.units.length
    table(
        f"{system.name}, {len(system.atoms)} atoms, r_cut {system.r_cut:.4g} {unit}, {chosen.steps} steps of "
        f"{system.spec.dynamics.timestep:g} {system.units.time}",
        (
            f"skin ({unit})", "rule", "rebuilds", "dangerous", "skin used", "lost pairs", "pair-steps",
            "first lost", "steps/s",
        ),
        (
            (
                f"{row.skin:g}", row.rule, row.rebuilds, row.dangerous, f"{row.used:.2f}", row.lost,
                row.lost_steps, row.first_lost if row.lost else None, f"{row.rate:,.0f}",
            )
            for row in rows
        ),
    )  # fmt: skip
    draw(rows, chosen.steps, unit, chosen.output)


if __name__ == "__main__":
    start(main)
