"""How do cutoff, tail correction, skin, time step and thermostat change the density of a liquid?

Answer. Relative to a cutoff at 2.5 σ, a cutoff at 2.2 σ reduces the density by 7 %, a cutoff at 3.0 σ
increases it by 4 %, and the tail correction increases it by 9 %. The effects of skin, time step and
thermostat are below the resolution of a run of 40 τ, about 1 % (docs/constant-pressure.md). It takes minutes.

A Lennard-Jones liquid of 256 atoms at T = 0.8 ε/k_B and a quarter of its critical pressure (0.032 ε/σ³) under
stochastic cell rescaling, cut off at 2.5 σ, skin 0.3 σ, time step 0.004 τ; each row changes one of these.

    density  atoms per σ³, with its standard error from averages over blocks
    change   of the density against the first row, per cent, with its standard error
    lost     pairs that a neighbor list lost

How to read it. A change of less than two errors is not resolved. "tail" adds to the pressure of the barostat
what pairs beyond the cutoff would take off it at the density 0.80, were atoms spread evenly there; where the
run has that density, it is that of the full potential. The skin decides how often lists are built and must
change nothing.
"""

from __future__ import annotations

import tempfile
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table
from ensemble_averages import begin

import mdnum
from mdnum.store import RunFolder

BASE: dict[str, Any] = {
    "kind": "hard", "r_cut": 2.5, "skin": 0.3, "timestep": 0.004, "pressure": 0.032, "relaxation": 0.2,
    "integrator": "cell-rescaling",
}  # fmt: skip
#: Rows of the table: what is changed, and to what.
ROWS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "another seed": {"seed": 9},
    "cutoff 2.2 σ": {"r_cut": 2.2},
    "cutoff 3.0 σ": {"r_cut": 3.0},
    "switched from 2.25 σ": {"kind": "switched"},
    "tail": {"tail": True},
    "skin 0.1 σ": {"skin": 0.1},
    "skin 0.6 σ": {"skin": 0.6},
    "time step 0.002 τ": {"timestep": 0.002},
    "time step 0.008 τ": {"timestep": 0.008},
    "thermostat ten times slower": {"relaxation": 2.0},
    "Martyna, Tobias and Klein": {"integrator": "mtk"},
}


def tail_pressure(density: float, r_cut: float) -> float:
    """What pairs beyond a cutoff add to the pressure at an even density: 16 π/3 ρ² (2/3 r⁻⁹ - r⁻³)."""
    return 16 * np.pi / 3 * density**2 * (2 / 3 * r_cut**-9 - r_cut**-3)


def density(time: float, given: dict[str, Any]) -> tuple[float, float, int]:
    """Mean density over a run without its first fifth, its standard error, and pairs lost."""
    # at rest: velocities are drawn from the seed
    atoms = begin(0.73, 0.8).copy()
    atoms.set_array("momenta", None)
    pressure = given["pressure"] - given.get("tail", 0) * tail_pressure(0.8, given["r_cut"])
    numbers = {"relaxation": given["relaxation"], "pressure_relaxation": 1.0, "pressure": pressure}
    if given["integrator"] == "cell-rescaling":
        numbers["compressibility"] = 0.13
    made = mdnum.simulation(
        atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut(given["kind"], given["r_cut"]), units="lj",
        integrator=given["integrator"], temperature=0.8, timestep=given["timestep"], skin=given["skin"],
        seed=given.get("seed", 1), dynamics=numbers, steps=round(time / given["timestep"]),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as place:
        outcome = mdnum.run(made, out=f"{place}/run", check=False, report=False)
        volume = RunFolder.open(outcome.folder).read("series")["volume"]
    series = len(atoms) / volume[len(volume) // 5 :]
    blocks = np.array([part.mean() for part in np.array_split(series, 10)])
    return float(series.mean()), float(blocks.std(ddof=1) / 10**0.5), outcome.summary["lost_pairs"]


def main() -> None:
    """Run and print the table."""
    made = parser(__doc__)
    made.add_argument("--time", type=float, default=40.0, help="of each run, τ (default %(default)s)")
    made.add_argument("--only", nargs="*", metavar="WORD", help="rows with one of these words, and the first")
    arguments = made.parse_args()
    rows, first = [], None
    for name, change in ROWS.items():
        if first is not None and arguments.only and not any(word in name for word in arguments.only):
            continue
        mean, error, lost = density(arguments.time, BASE | change)
        first = first or (mean, error)
        both = 100 * np.hypot(error, first[1]) / mean
        against = f"{100 * (mean / first[0] - 1):+.2f} ± {both:.2f}" if rows else ""
        rows.append((name, f"{mean:.4f} ± {error:.4f}", against, lost))
        say(f"{name}: {mean:.4f} ± {error:.4f}")
    table("density", ("changed", "density", "change %", "lost"), rows)


if __name__ == "__main__":
    start(main)
