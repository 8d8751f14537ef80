"""Which calculators are safe to run and to differentiate, and what is wrong with the others?

Answer. Of ASE's own, Lennard-Jones with a cutoff of 6 Å is safe to run, and its force jumps there; with
smooth=True its answers carry fewer digits than a double, and the energy of EMT jumps at its cutoff: with
care. None is unsafe. It takes 160 s.

Audits calculators one after the other (by default three of ASE's own, each with a structure that is built for
it) and puts them side by side: two answers, the codes of what was found, and the numbers behind them. Any
calculator can be named as for `mdnum audit`.

How to read it. Jump: of the energy at a threshold of two atoms, the largest. Forces: the largest difference
from differences of the energy, over the root mean square force. Curl: work around a small loop, as a share of
the stiffness; "-" where it cannot be told from rounding. Drift: of a short run at constant energy, and in the
figure how much of it is due to flips and to forces that are no gradient. A calculator without findings has a
line in the figure that stays at zero but for the swing of the integrator.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import figure, parser, save, say, start, table

import mdnum
from mdnum.store import RunFolder

OWN = (
    "ase.calculators.lj:LennardJones(sigma=3.405, epsilon=0.0103, rc=6)",
    "ase.calculators.lj:LennardJones(sigma=3.405, epsilon=0.0103, rc=6, smooth=True)",
    "ase.calculators.emt:EMT",
)


def main() -> None:
    """Audit, compare, draw."""
    options = parser(__file__, __doc__)
    options.add_argument(
        "calculators",
        nargs="*",
        default=OWN,
        metavar="CALCULATOR",
        help="as for `mdnum audit` (default three of ASE's own)",
    )
    options.add_argument(
        "--structure", metavar="FILE", help="one for all (default one that is built for each)"
    )
    options.add_argument("--checks", help="words of `mdnum audit --checks` (default all)")
    options.add_argument("--steps", type=int, help="of the run at constant energy")
    options.add_argument("--folders", type=Path, metavar="DIR", help="keep the audits there")
    asked = options.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        base = asked.folders or Path(scratch)
        made = []
        for number, name in enumerate(asked.calculators):
            say(f"auditing {name}")
            result = mdnum.audit_calculator(
                name,
                asked.structure,
                checks=asked.checks,
                steps=asked.steps,
                out=base / f"{number + 1}",
                report=asked.folders is not None,
            )
            made.append((_short(name), result.summary, RunFolder.open(result.folder).read("energies")))
    _table(made)
    _figure(made, asked.output)


def _short(name: str) -> str:
    """The class and its arguments, without the module."""
    return name.rpartition(":")[2] if ":" in name.partition("(")[0] else Path(name).stem


def _table(made: list) -> None:
    rows = []
    for name, summary, _ in made:
        numbers = {part["name"]: part["numbers"] for part in summary["parts"]}
        forces, curl, dynamics = (numbers.get(part, {}) for part in ("forces", "curl", "dynamics"))
        codes = sorted({one["code"] for one in summary["findings"] if one["severity"] != "info"})
        scale = forces.get("rms_force")
        rows.append(
            (
                name, summary["formula"], summary["safe_to_run"], summary["safe_to_differentiate"],
                ", ".join(codes) or "-", forces["largest_difference"] / scale if scale else None,
                curl.get("largest_share") or None, dynamics.get("drift"), dynamics.get("drift_error"),
            )
        )  # fmt: skip
    columns = ("calculator", "structure", "run", "differentiate", "findings", "forces", "curl", "drift", "±")
    table("Calculators, asked the same questions", columns, rows, words=5)


def _figure(made: list, path: Path) -> None:
    shown = [(name, summary, energies) for name, summary, energies in made if len(energies["time"])]
    drawn = figure(8.0, 1.0 + 1.5 * max(1, len(shown)))
    panels = drawn.subplots(max(1, len(shown)), squeeze=False)[:, 0]
    for axes, (name, summary, energies) in zip(panels, shown, strict=False):
        mine = energies["run"] == "run"
        scale = 1e3 / summary["atoms"]
        step = energies["step"][mine]
        total = energies["total"][mine]
        axes.plot(step, (total - total[0]) * scale, label="energy")
        axes.plot(step, np.cumsum(energies["jumps"][mine]) * scale, label="jumps of flips")
        rest = np.nan_to_num(energies["rest"][mine])
        axes.plot(step, np.cumsum(rest) * scale, label="forces that are no gradient", ls="--")
        axes.set_title(name)
        axes.set_ylabel("meV/atom")
    panels[-1].set_xlabel("step of a run at constant energy")
    if shown:
        panels[0].legend(ncol=3, fontsize=7)
    save(drawn, path)


if __name__ == "__main__":
    start(main)
