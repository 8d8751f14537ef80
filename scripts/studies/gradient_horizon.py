"""How far can a gradient through a liquid be trusted, and what ends it?

Answer. In a Lennard-Jones liquid of 256 atoms float32 agrees with float64 for 400 to 480 steps, and other
starts disagree after some 350: average over starts. It takes some minutes.

The derivative of the mean squared displacement by sigma is followed with the horizon, from one run and one
tangent pass for each precision. A run in float32 is compared with one in float64, a run in float64 with
another that starts a rounding away. The table says, for each cutoff:

    growth      rate at which the gradient by the state grows, per step, from one reverse pass
    exponent    largest finite-time Lyapunov exponent, per step, from singular values
    float32     the last horizon at which float32 and float64 agree within the tolerance
    float64     the same for two runs in float64 that start a rounding away from one another
    ratio       of the distance between the two horizons, and log(2^29) / growth: 1 where rounding errors
                grow as the gradient says
    scatter     the last horizon at which the standard error over other starts is below the mean
    flips       step of the first pair that float32 and float64 decide differently

How to read it. Rounding is not what ends a gradient in float64: other starts disagree long before. A wider
format puts the rounding horizon off by a fixed number of steps, whatever the cutoff. A gradient beyond
`scatter` is a property of this one start and of nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import liquid
from _output import COLORS, figure, parser, save, say, start, table

from mdnum.gradients import Problem
from mdnum.gradients.diagnose import GradientGrowth, Spectrum, Trust, growth, spectrum, trust
from mdnum.gradients.losses import MeanSquaredDisplacement
from mdnum.systems import Simulation, build

CUTOFFS = ("hard", "quintic")
NARROW: dict[str, str] = dict.fromkeys(("state", "force", "decision", "accumulate"), "float32")
PRECISIONS: tuple[dict[str, str], ...] = ({}, NARROW)
#: Doublings between the roundings of the two formats.
BETWEEN = 29 * np.log(2)


@dataclass(frozen=True)
class Found:
    """What is drawn of one cutoff."""

    growth: GradientGrowth
    spectrum: Spectrum
    narrow: Trust
    wide: Trust

    @property
    def rounding(self) -> tuple[int | None, int | None]:
        """Rounding horizons of float32 and float64; None where they were not reached."""
        narrow, wide = (one.limits[0] for one in (self.narrow, self.wide))
        return narrow.horizon if narrow.reached else None, wide.horizon if wide.reached else None

    @property
    def ratio(self) -> float | None:
        """Steps between the two horizons over what the growth of the gradient predicts."""
        narrow, wide = self.rounding
        if narrow is None or wide is None:
            return None
        return (wide - narrow) * self.growth.rate / BETWEEN


def made(atoms: int, cutoff: str, precision: dict[str, str]) -> Simulation:
    """The liquid with another end of its potential, in another precision."""
    system = liquid(atoms)
    radius: dict[str, object] = {"kind": cutoff, "radius": 2.5}
    if cutoff != "hard":
        radius["onset"] = 2.0
    spec = type(system.spec).model_validate(
        system.spec.model_dump(exclude_unset=True) | {"cutoff": radius, "precision": precision}
    )
    return build(replace(system, spec=spec))


def follow(atoms: int, steps: int, points: int, replicas: int, tolerance: float, cutoff: str) -> Found:
    """Growth, spectrum and both trust horizons of one cutoff."""
    wide, narrow = (
        Problem(made(atoms, cutoff, precision), MeanSquaredDisplacement(), steps) for precision in PRECISIONS
    )
    say(f"{cutoff}: growth")
    grown = growth(wide, ["sigma"])
    say(f"{cutoff}: singular values")
    singular = spectrum(wide, values=2, extra=2, rounds=2)
    say(f"{cutoff}: float32 against float64")
    first = trust(narrow, ["sigma"], tolerance=tolerance, points=points)
    say(f"{cutoff}: float64 and {replicas} starts")
    second = trust(wide, ["sigma"], tolerance=tolerance, points=points, replicas=replicas)
    return Found(grown, singular, first, second)


def draw(found: dict[str, Found], tolerance: float, path: Path) -> None:
    """The differences with the horizon, and the gradient beside the run."""
    drawn = figure(10.0, 4.4)
    left, right = drawn.subplots(1, 2)
    for (cutoff, one), color in zip(found.items(), COLORS, strict=False):
        for trusted, word, style in ((one.narrow, "float32", "-"), (one.wide, "float64", "--")):
            y = trusted.table["relative.potential.sigma"]
            left.semilogy(
                trusted.table["horizon"],
                np.where(y > 0, y, np.nan),
                style,
                lw=1.2,
                color=color,
                label=f"{cutoff}, {word}",
            )
        scatter = one.wide.table.get("error.potential.sigma")
        if scatter is not None:
            left.semilogy(
                one.wide.table["horizon"], scatter, ":", lw=1.2, color=color, label=f"{cutoff}, other starts"
            )
        grown = one.growth.table
        right.semilogy(grown["horizon"], grown["size"], lw=1.2, color=color, label=f"{cutoff}: gradient")
        right.semilogy(
            grown["horizon"], grown["speed"], ":", lw=1.2, color=color, label=f"{cutoff}: rms speed"
        )
    left.axhline(tolerance, lw=0.8, color="black")
    left.set_title("relative difference of two gradients (line: tolerance)")
    right.set_title("gradient by the state, and the run's speed")
    for axes in (left, right):
        axes.set_xlabel("horizon, steps")
        axes.legend(fontsize=7)
    save(drawn, path)


def main() -> None:
    """Parse, follow, print, draw."""
    line = parser(__doc__, __file__)
    line.add_argument("--cutoffs", nargs="+", default=list(CUTOFFS), choices=CUTOFFS, help="of these")
    line.add_argument("--atoms", type=int, default=256, help="about so many (default 256)")
    line.add_argument("--steps", type=int, default=2400, help="the longest horizon (default 2400)")
    line.add_argument("--points", type=int, default=60, help="horizons that are compared (default 60)")
    line.add_argument("--replicas", type=int, default=4, help="starts for the standard error (default 4)")
    line.add_argument("--tolerance", type=float, default=1e-2, help="relative difference (default 0.01)")
    asked = line.parse_args()
    found = {
        cutoff: follow(asked.atoms, asked.steps, asked.points, asked.replicas, asked.tolerance, cutoff)
        for cutoff in asked.cutoffs
    }
    rows = []
    for cutoff, one in found.items():
        narrow, wide = one.rounding
        scatter = next((limit.horizon for limit in one.wide.limits if limit.what == "standard error"), None)
        flips = one.narrow.limits[0].values["first"]
        exponent = float(one.spectrum.exponents[0])
        rows.append((cutoff, one.growth.rate, exponent, narrow, wide, one.ratio, scatter, flips))
    columns = ("cutoff", "growth", "exponent", "float32", "float64", "ratio", "scatter", "flips")
    table(f"trust in d msd / d sigma over {asked.steps} steps", columns, rows)
    draw(found, asked.tolerance, asked.output)


if __name__ == "__main__":
    start(main)
