"""Which time step is too long, and does mdnum warn about it?

Answer. Among 55 cases, one warning is missed and one is false (docs/time-steps.md). It takes minutes.

Every shipped system of atoms runs for the same time at its own time step and at 1/2 to 16 times that. A
step is too long where halving it changes what an experiment would see: the mean potential energy or the
temperature of the run's second half, by more than three standard errors and by more than 3 % of k_B T an
atom, or where the run does not survive. The table says:

    step         time step over the system's own
    period       steps in the fastest vibration of the first and the last configuration
    fluctuation  standard deviation of the conserved energy, less the flips' jumps, over the kinetic
                 energy's, in the second half
    halving      largest change of the two means when the step is halved, in k_B T an atom, and its
                 standard error
    changes      whether that makes the step too long
    said         what `mdnum run` says of it

How to read it. "changes" without "said" is a missed warning, "said" without "changes" a false one.
Near the limit chance decides what halving changes, and the table shows by how much.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table

import mdnum
from mdnum.errors import NumericalError
from mdnum.store import RunFolder
from mdnum.systems import names as shipped

FACTORS = (0.5, 1, 2, 4, 8, 16)
_BLOCKS = 8
_ERRORS, _SHARE = 3.0, 0.03


@dataclass(frozen=True)
class Row:
    """One system at one time step."""

    name: str
    factor: float
    means: np.ndarray  # potential energy an atom and 3/2 k_B T, energy
    errors: np.ndarray
    thermal: float  # k_B T
    period: float | None  # steps
    fluctuation: float | None
    said: bool
    failed: bool = False


def study(name: str, factor: float, time: float, folder: Path) -> Row:
    """Run a system at one time step."""
    system = mdnum.load(name)
    dynamics, units = system.spec.dynamics, system.units
    step = factor * dynamics.timestep
    try:
        done = mdnum.run(
            name, out=folder / f"{name.replace('/', '-')}-{factor:g}", steps=round(time / step), save_every=0,
            overrides={"dynamics.timestep": step}, report=False,
        )  # fmt: skip
        path, summary = done.folder, done.summary
    except NumericalError as error:
        nothing = np.full(2, np.nan)
        return Row(name, factor, nothing, nothing, np.nan, None, None, error.folder is not None, failed=True)
    series = RunFolder.open(path).read("series")
    half = len(series["step"]) // 2
    thermal = units.k_B * float(series["temperature"][half:].mean())
    kinetic = 1.5 * units.k_B * series["temperature"][half:]
    both = np.array([series["potential"][half:] / summary["atoms"], kinetic])
    blocks = np.array([part.mean(axis=1) for part in np.array_split(both, _BLOCKS, axis=1)])
    step_said = summary["time_step"]
    codes = {one["code"] for one in summary["findings"]}
    return Row(
        name, factor, blocks.mean(axis=0), blocks.std(axis=0, ddof=1) / _BLOCKS**0.5, thermal,
        step_said["per_period"], step_said["fluctuation"], "TIME_STEP" in codes,
    )  # fmt: skip


def compared(row: Row, half: Row) -> tuple[float, float, bool]:
    """(largest change in units of k_B T, its error, whether the step is too long)."""
    if row.failed or half.failed:
        return np.nan, np.nan, row.failed
    change = np.abs(row.means - half.means) / half.thermal
    error = np.hypot(row.errors, half.errors) / half.thermal
    which = int(np.argmax(change / error))
    changes = (change > _ERRORS * error) & (change > _SHARE)
    return float(change[which]), float(error[which]), bool(changes.any())


def main() -> None:
    """Run the study."""
    options = parser(__doc__)
    options.add_argument("systems", nargs="*", help="names or paths (default: every shipped one)")
    options.add_argument("--steps", type=int, default=4_000, help="steps at the system's own time step")
    asked = options.parse_args()
    names = asked.systems or shipped("md")
    rows, missed, false = [], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            time = asked.steps * mdnum.load(name).spec.dynamics.timestep
            made = [study(name, factor, time, Path(folder)) for factor in FACTORS]
            for half, row in pairwise(made):
                change, error, changes = compared(row, half)
                missed, false = missed + (changes and not row.said), false + (row.said and not changes)
                word = "failed" if row.failed else "too long" if row.said else "fine"
                rows.append((name, row.factor, row.period, row.fluctuation, change, error, changes, word))
                say(f"{name} at {row.factor:g}: {word}")
    table("Time steps", ("system", "step", "period", "fluctuation", "halving", "±", "changes", "said"), rows)
    say(f"{missed} missed, {false} false, of {len(rows)}")


if __name__ == "__main__":
    start(main)
