"""How long does a run with a user-defined pair function take, relative to the built-in Lennard-Jones
potential?

Answer. With rational operations 1.0 to 1.2 times as long, with an exponential 1.4 to 1.6 times as long
(docs/speed.md). It takes five minutes.

The liquid of benchmark.py with 4,000 atoms, float64, hard cutoff, on one core: every potential makes as many
steps as the others in turn, from the same start. Ratios are medians over the turns, of processor time.
`--xla` leaves elementary functions to XLA's loop, as where there is no compiled one.
"""

from __future__ import annotations

from functools import partial

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, SKIN, liquid
from _output import parser, start, table
from _turns import in_turn, on_cores, ratios
from jax.numpy import exp
from jax.scipy.special import erfc

import mdnum
from mdnum.numerics import elementary
from mdnum.rollout import Engine
from mdnum.systems import Simulation


def morse(r, depth, alpha, r0):
    """One exponential."""
    e = exp(-alpha * (r - r0))
    return depth * (e * e - 2 * e)


FIRST, OWN = "built-in Lennard-Jones", mdnum.PairFunction
POTENTIALS = {
    FIRST: mdnum.LennardJones(sigma=1.0, epsilon=1.0),
    "the same, u(r2)": OWN(lambda r2, e, s: 4 * e * ((s * s / r2) ** 6 - (s * s / r2) ** 3), e=1.0, s=1.0),
    "the same, u(r)": OWN(lambda r, e, s: 4 * e * ((s / r) ** 12 - (s / r) ** 6), e=1.0, s=1.0),
    "built-in Morse": mdnum.Morse(depth=1.0, alpha=6.0, r0=1.12),
    "Morse, u(r)": OWN(morse, depth=1.0, alpha=6.0, r0=1.12),
    "Buckingham, u(r)": OWN(lambda r, a, b, c: a * exp(-b * r) - c / r**6, a=2.6e5, b=12.0, c=4.0),
    "Yukawa, u(r)": OWN(lambda r, a, kappa: a * exp(-kappa * r) / r, a=60.0, kappa=4.0),
    "damped charge, u(r)": OWN(lambda r, q, alpha: q * erfc(alpha * r) / r, q=4.0, alpha=1.2),
    "power n, u(r)": OWN(lambda r, n: r**-n, n=12.0),
}


def steps_of(simulation: Simulation, steps: int) -> None:
    """So many recorded steps."""
    for _ in Engine(simulation, steps, rows=False).segments():
        pass


def main() -> None:
    """Turns, and their table."""
    options = parser(__doc__)
    options.add_argument("--turns", type=int, default=9)
    options.add_argument("--steps", type=int, default=150)
    options.add_argument("--xla", action="store_true", help="leave elementary functions to XLA's loop")
    chosen = options.parse_args()
    on_cores(1)
    if chosen.xla:
        elementary.FUNCTIONS.clear()
    atoms = liquid(4000).atoms
    rest = {"timestep": 0.002, "temperature": 0.72, "units": "lj", "skin": SKIN}
    runs = {
        name: partial(steps_of, mdnum.simulation(atoms, u, mdnum.Cut("hard", R_CUT), **rest), chosen.steps)
        for name, u in POTENTIALS.items()
    }
    taken = in_turn(runs, chosen.turns, f"{len(atoms)} atoms")
    rows = [
        (name, f"{chosen.steps / np.median(spent[1:, 1]):.0f}",
         f"{np.median(ratios(taken, name, FIRST)[:, 1]):.2f}")
        for name, spent in taken.items()
    ]  # fmt: skip
    table(f"{len(atoms)} atoms", ("potential", "steps/s", "over Lennard-Jones"), rows)


if __name__ == "__main__":
    start(main)
