"""Does the order in which an atom's forces are summed matter, and which sums have no order?

Answer. It does: of the melted crystal, runs with another order or sum fork within 1,000 to 1,080 steps and
split 160 to 200 steps later, the exact sum included. Shuffled neighbors change no bit of neumaier, sorted,
exact and fixed-point sums. It takes 100 s.

The pair terms are the same; only the way they are added differs. Every reduction that ships is run
beside the system's own and, to see whether it minds an order, beside itself with the neighbors of
each atom shuffled. The table says:

    error    largest difference of a force from the correctly rounded sums at the start, in ulps of
             the largest force
    seed     first step with another bit than the system's own reduction
    fork     first step with another decision
    split    first step with an atom further apart than the tolerance
    end      separation from the system's own run at the last step
    shuffled first of 100 steps with another bit when neighbors are shuffled, - where all bits hold

The crystal of argon/crystal-108 is melted by drawing its velocities at a temperature of 6: in the cold
crystal a difference in the last bit stays one.

How to read it. A smaller error is not a later fork: any difference is enough, and it grows at the
system's own rate. Sums with no step under "shuffled" gave the same run whatever the neighbor list did:
exact and fixed-point ones by design, sorted ones unless two terms are of one size, compensated ones as
long as their error rounds away. They buy determinism, not accuracy of the trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table

from mdnum.forks import Fork, fork
from mdnum.forks.choices import parse, twin_of, twin_or_reason
from mdnum.numerics import reductions
from mdnum.systems import Simulation, System, load


@dataclass(frozen=True)
class Row:
    """One reduction; found is None for the system's own."""

    word: str
    error: float
    found: Fork | None
    shuffled: int | None


def force_error(simulation: Simulation, exact: np.ndarray) -> float:
    """Largest difference of a force component from correctly rounded sums, ulps of the largest."""
    forces = simulation.evaluate().forces
    return float(np.abs(forces - exact).max() / np.spacing(np.abs(exact).max()))


def study(system: System, word: str, steps: int) -> Row:
    """Compare one reduction with the system's own, and with itself in another order."""
    exact = twin_of(parse("order@exact"), system).a.simulation.evaluate().forces
    shuffled = fork(twin_of(parse(f"order@{word}"), system), min(steps, 100), counterfactual=False)
    own = shuffled.twin.a.simulation
    twin = twin_or_reason(parse(f"reduction={word}"), system)
    found = None if isinstance(twin, str) else fork(twin, steps, counterfactual=False)
    return Row(word, force_error(own, exact), found, shuffled.dates.first_bit)


def draw(rows: list[Row], system: System, path: Path) -> None:
    """Separation from the system's own run, on a log axis."""
    drawn = figure(8.0, 4.6)
    axes = drawn.subplots()
    shown = [row for row in rows if row.found is not None]
    for k, row in enumerate(shown):
        assert row.found is not None
        y = row.found.series["B"]
        axes.semilogy(
            row.found.series["step"], np.where(y > 0, y, np.nan), "-" if k < len(COLORS) else "--",
            lw=1.0, color=COLORS[k % len(COLORS)], label=row.word,
        )  # fmt: skip
    axes.set_title(f"{system.name}: separation from {system.spec.precision.reduction} sums")
    axes.set_xlabel("step")
    axes.set_ylabel(system.units.length)
    drawn.legend(loc="outside lower center", ncols=5)
    save(drawn, path)


def main() -> None:
    """Parse, run every reduction, print and draw."""
    made = parser(__doc__, __file__)
    made.add_argument("system", nargs="?", help="a system (default argon/crystal-108, melted)")
    made.add_argument("--steps", type=int, default=3000, help="steps at most (default 3000)")
    made.add_argument(
        "--reductions", nargs="+", default=list(reductions.BY_NAME), metavar="NAME",
        help="orders of the sum, such as exact or permuted:3 (default all)",
    )  # fmt: skip
    chosen = made.parse_args()
    melted = None if chosen.system else {"dynamics.temperature": 6.0}
    system = load(chosen.system or "argon/crystal-108", melted, world="md")
    rows = []
    for word in chosen.reductions:
        say(f"{system.name}: {word} sums")
        rows.append(study(system, word, chosen.steps))
    table(
        f"{system.name}, {len(system.atoms)} atoms, {chosen.steps} steps, beside "
        f"{system.spec.precision.reduction} sums",
        ("sum", "error", "seed", "fork", "split", f"end ({system.units.length})", "shuffled"),
        (
            (
                row.word, f"{row.error:.2g}",
                *((one.dates.first_bit, one.dates.fork, one.dates.split, f"{one.series['B'][-1]:.2g}")
                  if (one := row.found) is not None else (None,) * 4),
                row.shuffled,
            )
            for row in rows
        ),
    )  # fmt: skip
    draw(rows, system, chosen.output)


if __name__ == "__main__":
    start(main)
