"""Does a gradient of a liquid with a hard cutoff need what the flips add?

Answer. Yes: without it the gradient is off by many standard errors, and by the cutoff radius it is exactly
0; with it, gradients agree with differences within about two. It takes minutes.

The same loss is differentiated in three ways, over replicas that differ in their velocities: by the steps
that ran (plain), with what moving the time of every flip adds (event-aware), and by differences of runs at
shifted parameters, over steps so wide that many flips change the step at which they happen. Two starts:

    melt        a perfect crystal with thermal velocities; the loss is the temperature it has reached
    liquid      the same after it has melted; the loss is the velocity autocorrelation

and for each parameter the table says:

    differences     the mean over replicas, and its standard error
    plain, aware    the same of the two gradients
    off             gradient minus differences, replica by replica: mean and standard error
    moved           share of the flips that the widest step chosen moves to another step of time

A second table is about averages over given states: the slope of the mean potential energy by the cutoff,
where differentiating the energy of each state gives exactly 0, against differences of the energies of the
same states at two radii.

How to read it. "off" within about two of its standard errors is agreement. Plain gradients are off by many,
and exactly 0 by the radius, whatever the time step: they hold fixed which pairs interact. What is left of the
event-aware ones is the noise of differences, a few crossings too slow to count, and what a time step leaves
of a crossing. A melt tells the radius best, since pairs leave it for good; in the liquid its mean effect is
less than its noise, and neither gradient can be told from differences. Slopes of averages agree where their
ratio is 1 within a hundredth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table
from ase import Atoms
from ase.build import bulk

from mdnum.gradients import Problem
from mdnum.gradients.averages import BoundaryTerm, distances, frames
from mdnum.gradients.differences import Ensemble, Replicas, SmoothedDifferences, settled
from mdnum.gradients.losses import MeanPotential, MeanTemperature, VelocityAutocorrelation
from mdnum.gradients.recorded import EventAware, Symmetric
from mdnum.gradients.tape import RunTape
from mdnum.systems import System, SystemSpec, build

DENSITY, TEMPERATURE, TIMESTEP = 0.8442, 1.0, 0.004
NAMES = ("potential.sigma", "potential.epsilon", "cutoff.radius")
STARTS = ("melt", "liquid")


@dataclass(frozen=True)
class Row:
    """One parameter of one problem: means with their standard errors."""

    start: str
    atoms: int
    name: str
    differences: tuple[float, float]
    plain: tuple[float, float]
    aware: tuple[float, float]
    plain_off: tuple[float, float]
    aware_off: tuple[float, float]
    moved: float

    @property
    def pairs(self) -> tuple[tuple[float, float], ...]:
        """All of them in the order of the table."""
        return self.differences, self.plain, self.aware, self.plain_off, self.aware_off


def crystal(atoms: int) -> Atoms:
    """A cube of about so many atoms at the density of the liquid: simple cubic where that fits, else fcc."""
    edge = round(atoms ** (1 / 3))
    if edge**3 == atoms:
        made = bulk("Ar", "sc", a=DENSITY ** (-1 / 3), cubic=True).repeat(edge)
    else:
        cells = max(3, round((atoms / 4) ** (1 / 3)))
        made = bulk("Ar", "fcc", a=(4 / DENSITY) ** (1 / 3), cubic=True).repeat(cells)
    made.set_array("masses", np.ones(len(made)))
    return made


def system(atoms: Atoms, radius: float, dynamics: str = "nve") -> System:
    """Lennard-Jones atoms with a hard cutoff."""
    table = {"kind": dynamics, "timestep": TIMESTEP, "temperature": TEMPERATURE, "seed": 1}
    if dynamics == "langevin":
        table |= {"friction": 1.0}
    skin = min(0.3, 0.98 * (float(np.min(atoms.cell.lengths())) / 2 - radius))
    spec = SystemSpec.model_validate(
        {
            "units": "lj",
            "structure": {"file": "made in memory"},
            "potential": {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0},
            "cutoff": {"kind": "hard", "radius": radius},
            "neighbors": {"skin": skin},
            "dynamics": table,
        }
    )
    return System(f"hard-{len(atoms)}", spec, None, atoms)


def problem_of(word: str, atoms: int, radius: float, steps: int) -> tuple[Problem, int]:
    """What is differentiated, and the steps that every replica runs with its velocities before its start."""
    simulation = build(system(crystal(atoms), radius))
    if word == "melt":
        return Problem(simulation, MeanTemperature(first=steps), steps), 0
    return Problem(settled(simulation, 500), VelocityAutocorrelation(), steps), 100


def compare(word: str, problem: Problem, starts: Replicas, names: Sequence[str]) -> list[Row]:
    """All three ways, replica by replica."""
    found = {
        method.name: Ensemble(method, starts, halvings=0)(problem, names)
        for method in (Symmetric(), EventAware())
    }
    wide = SmoothedDifferences(replicas=starts)(problem, names)
    rows = []
    for name in names:
        values = {key: np.array(one.details["each"][name]) for key, one in found.items()}
        true = np.array(wide.details["each"][name])
        rows.append(
            Row(
                word,
                problem.simulation.atoms,
                name.partition(".")[2],
                mean(true),
                mean(values["symmetric"]),
                mean(values["event-aware"]),
                mean(values["symmetric"] - true),
                mean(values["event-aware"] - true),
                wide.details["moved"][name],
            )
        )
    return rows


def mean(values: np.ndarray) -> tuple[float, float]:
    """Mean over replicas and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


@dataclass(frozen=True)
class Slope:
    """d(potential energy)/d(r_cut) of the whole box at the states of a run."""

    radius: float
    boundary: float
    error: float
    differences: float

    @property
    def ratio(self) -> float:
        """Of the two."""
        return self.boundary / self.differences


def slopes(radii: Sequence[float], steps: int) -> list[Slope]:
    """The boundary term against differences, each at the states of a thermostatted run of 108 atoms."""
    found = []
    for radius in radii:
        simulation = build(system(crystal(108), radius, "langevin"))
        problem = Problem(simulation, MeanPotential(first=500, every=4), 500 + steps)
        ours = BoundaryTerm()(problem, ("r_cut",))
        seen = frames(RunTape(simulation, problem.loss, problem.steps), ())
        h = 0.02 * radius
        # what the energy gains from radius - h to radius + h, at each of the states
        gained = [
            sum(4 * ((radius + d) ** -12 - (radius + d) ** -6).sum() for d in distances(simulation, x, h))
            for x in seen.x
        ]
        found.append(
            Slope(
                radius,
                float(ours.gradient["cutoff.radius"]) * simulation.atoms,
                ours.details["error"]["cutoff.radius"] * simulation.atoms,
                float(np.mean(gained)) / (2 * h),
            )
        )
    return found


def draw(rows: list[Row], found: list[Slope], path: Path) -> None:
    """What is missing of each gradient, in units of the difference; and the slopes of averages."""
    drawn = figure(9.0, 4.4)
    left, right = drawn.subplots(1, 2, width_ratios=(2, 1))
    places = np.arange(len(rows))
    for shift, word, color in ((-0.15, "plain", COLORS[1]), (0.15, "aware", COLORS[0])):
        off = [getattr(row, f"{word}_off") for row in rows]
        # by the size of what the flips add, so that 1 is all of it
        whole = [max(abs(row.plain_off[0]), row.plain_off[1]) for row in rows]
        y = [one[0] / size for one, size in zip(off, whole, strict=True)]
        bars = [2 * one[1] / size for one, size in zip(off, whole, strict=True)]
        label = "plain" if word == "plain" else "event-aware"
        left.errorbar(places + shift, y, bars, fmt="o", ms=4, capsize=3, color=color, label=label)
    left.axhline(0, color="black", lw=0.8)
    left.set_ylim(-2.2, 2.2)
    left.set_xticks(places, [f"{row.name}\n{row.start}\n{row.atoms}" for row in rows], fontsize=7)
    left.set_title("gradient minus differences, as a share of what plain misses (bars: 2 s.e.)")
    left.legend()
    radii = [one.radius for one in found]
    right.plot(
        radii, [one.differences for one in found], "s", ms=8, mfc="none", color=COLORS[6], label="differences"
    )
    right.errorbar(
        radii, [one.boundary for one in found], [one.error for one in found], fmt="o", ms=4, capsize=3,
        color=COLORS[0], label="boundary term",
    )  # fmt: skip
    right.plot(radii, np.zeros(len(radii)), "x", color=COLORS[1], label="AD: exactly 0")
    right.set_title("d⟨E⟩/d r_cut, 108 atoms")
    right.set_xlabel("r_cut (σ)")
    right.legend()
    save(drawn, path)


def main() -> None:
    """Parse, differentiate, print and draw."""
    made = parser(__doc__, __file__)
    made.add_argument("--atoms", nargs="+", type=int, default=[125, 500], metavar="N")
    made.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS), metavar="START")
    made.add_argument("--radius", type=float, default=1.6, help="hard cutoff, sigma (default 1.6)")
    made.add_argument("--steps", type=int, default=80, help="steps of each run (default 80)")
    made.add_argument("--replicas", type=int, default=16, help="(default 16)")
    made.add_argument(
        "--radii", nargs="+", type=float, default=[1.5, 1.8, 2.2], metavar="R",
        help="radii of the slopes of averages (default 1.5 1.8 2.2)",
    )  # fmt: skip
    made.add_argument(
        "--states", type=int, default=6000, help="steps of the runs for averages (default 6000)"
    )
    chosen = made.parse_args()
    rows: list[Row] = []
    for word in chosen.starts:
        for atoms in chosen.atoms:
            say(f"{word}, {atoms} atoms: {chosen.replicas} replicas")
            problem, settle = problem_of(word, atoms, chosen.radius, chosen.steps)
            rows += compare(word, problem, Replicas(chosen.replicas, settle=settle), NAMES)
    table(
        f"Lennard-Jones, hard cutoff at {chosen.radius:g}, {chosen.steps} steps, {chosen.replicas} replicas",
        ("start", "atoms", "by", "differences", "plain", "aware", "plain off", "aware off", "moved"),
        (
            (
                row.start, row.atoms, row.name,
                *(f"{one:.4g} ± {error:.2g}" for one, error in row.pairs),
                f"{row.moved:.0%}",
            )
            for row in rows
        ),
    )  # fmt: skip
    say("slopes of averages")
    found = slopes(chosen.radii, chosen.states)
    table(
        "d(mean potential energy)/d(r_cut) of 108 atoms at the states of a run",
        ("r_cut", "AD", "boundary", "error", "differences", "ratio"),
        (
            (
                f"{one.radius:g}", "0", f"{one.boundary:.1f}", f"{one.error:.1f}", f"{one.differences:.1f}",
                f"{one.ratio:.4f}",
            )
            for one in found
        ),
        words=0,
    )  # fmt: skip
    draw(rows, found, chosen.output)


if __name__ == "__main__":
    start(main)
