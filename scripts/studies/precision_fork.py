"""Which role of a number, made narrower, changes a run, when, and was it through a flip?

Answer. In argon/crystal-108 every role but the sums does, and each split is caused by flips: forces or
state in float32 fork at step 303, decisions at step 2,672, all but the state at step 1,863. Sums in float32
cause no fork within 5,000 steps. It takes 30 s.

A run's positions and velocities (state), pair terms (force), compared distances (decision) and sums
(accumulate) are float64. Here one role at a time is float32, and then all but the state. Each run is
followed beside the float64 one, with a third that has the narrow arithmetic and is told the float64
run's decisions; the table says:

    seed     first step with another bit
    fork     first step with another decision
    split    first step with an atom further apart than the tolerance
    told     the same for the run that is told the decisions
    growth   rate at which the separation grew, per step, before the split
    verdict  whether the flips caused the split, accelerated it, or came along (bystander); undecided:
             the repeats do not tell; open: no split within the steps

How to read it. All roles seed within a step or so, since one rounding is enough; they differ in the
size of the error, and so in how soon a pair near its cutoff is decided otherwise. Where "told" is as
early as "split", the flips did nothing. Where "told" has no split, the flips alone did it: a cutoff
that switches off smoothly mends that, a wider float only puts it off.
"""

from __future__ import annotations

from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table

from mdnum.forks import Fork, fork
from mdnum.forks.choices import Choice, parse, twin_of
from mdnum.systems import System, load

ROLES = ("accumulate", "decision", "force", "state", "all but state")


def choice_of(role: str) -> Choice:
    """The choice of a role by its word here."""
    return parse("precision" if role == "all but state" else f"precision.{role}")


def draw(found: dict[str, Fork], system: System, path: Path) -> None:
    """Separation of each run, told nothing and told the decisions, on a log axis."""
    drawn = figure(8.0, 4.6)
    axes = drawn.subplots()
    for (role, one), color in zip(found.items(), COLORS * len(found), strict=False):
        for name, style, width in (("B", "-", 1.2), ("B|A", ":", 1.2)):
            if name in one.series:
                label = role if name == "B" else None
                # what is zero has no place on a log axis
                y = np.where(one.series[name] > 0, one.series[name], np.nan)
                axes.semilogy(one.series["step"], y, style, lw=width, color=color, label=label)
        if one.dates.fork is not None:
            y = one.series["B"][one.dates.fork]
            axes.plot(one.dates.fork, y, "o", ms=5, color=color, mfc="white")
    tolerance = next(iter(found.values())).tolerance
    axes.axhline(tolerance, lw=0.8, color="black")
    axes.set_title("separation from float64 (dotted: told its decisions; circle: fork; line: split)")
    axes.set_xlabel("step")
    axes.set_ylabel(system.units.length)
    axes.legend()
    save(drawn, path)


def main() -> None:
    """Parse, follow every role, print and draw."""
    made = parser(__file__, __doc__)
    made.add_argument("system", nargs="?", default="argon/crystal-108")
    made.add_argument("--steps", type=int, default=5000, help="steps at most (default 5000)")
    made.add_argument(
        "--roles", nargs="+", choices=ROLES, default=list(ROLES), metavar="ROLE",
        help="roles made float32 (default all of them, one at a time, and all but the state)",
    )  # fmt: skip
    made.add_argument("--repeats", type=int, help="repeats at most that tell a delay (default 15)")
    chosen = made.parse_args()
    system = load(chosen.system, world="md")
    found = {}
    for role in chosen.roles:
        say(f"{system.name}: {role} in float32")
        found[role] = fork(twin_of(choice_of(role), system), chosen.steps, repeats=chosen.repeats, back=False)
    tolerance = next(iter(found.values())).tolerance
    table(
        f"{system.name}, {len(system.atoms)} atoms, {chosen.steps} steps, split at {tolerance:.3g} "
        f"{system.units.length}",
        ("float32", "seed", "fork", "split", "told", "growth", "verdict"),
        (
            (
                role, one.dates.first_bit, one.dates.fork, one.dates.split, one.splits.get("B|A"),
                f"{one.growth['B'].rate:.2g}", one.verdict.word,
            )
            for role, one in found.items()
        ),
    )  # fmt: skip
    draw(found, system, chosen.output)


if __name__ == "__main__":
    start(main)
