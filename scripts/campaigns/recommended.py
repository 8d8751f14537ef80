"""Do the settings that `mdnum sweep` recommends hold in independent runs that are ten times longer?

Answer. For copper at 600 K and a Lennard-Jones liquid at three states, yes; for the ball, except during a
contact. Copper: at the recommended 8 fs in float32 the temperature differs by -11.0 K with an error of 1.2
(tolerance 25) and the energy by less than 0.001 eV an atom (0.004); at 16 fs, the next value, the
temperature differs by -47.6 K with an error of 0.9. Liquids, dense, near-critical and hot: at the
recommended cutoffs of 2.8, 2.5 and 2.8 and a time step of 0.016, energies differ by 0.095, 0.146 and 0.083
(tolerances 0.15, 0.18 and 0.13), pressures by less than 0.09 (0.2 or 0.3) and temperatures by less than half
of their tolerances, all with errors below 0.02; at the next smaller cutoffs energies differ by 0.218, 0.307
and 0.204, and at the next time step, 0.032, every run fails. Ball: at the recommended 1.6 ms in float32,
heights of four balls after ten times the steps differ by up to 0.008 m (tolerance 0.01), and energies of
three by less than 0.005 (tolerance 0.01). The fourth run ends during a contact, where the energy of
semi-implicit Euler is 0.08 too large, so a tolerance tested at one final time does not hold at all final
times. At 3.2 ms, the next value, the differences of 0.32 m and 0.011 exceed the tolerances. It takes a minute
for the ball, a quarter of an hour for a liquid, and half an hour for copper on a busy machine.

    python scripts/campaigns/recommended.py --in FOLDER --system ball

Each system is swept by one command: a Lennard-Jones liquid of 256 atoms at three state points (no tail
corrections), 256 atoms of copper at 600 K, and a ball dropped from 0.6 m. The tolerances were chosen before
anything was run. Then the converged ends, the recommended values, and one value beyond each recommendation
are run with other seeds (the ball: from other heights) and ten times the steps. The error of a mean over the
last four fifths of a run is the scatter of the seeds. A difference from the converged end is within the
tolerance, or not, if it is so with two errors on either side; for the ball it is the largest of all heights.
The command continues what `--in` holds.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table
from ase.build import bulk
from ase.io import read, write

import mdnum
from mdnum.errors import MdnumError
from mdnum.systems import build_ball

LONGER, SEEDS = 10, 4
#: Density and temperature of the liquid, in units of sigma and epsilon.
STATES = {"dense": (0.84, 0.9), "near-critical": (0.5, 1.5), "hot": (0.7, 2.5)}
LIQUID = """
units = "lj"
structure = {{ file = "structure.extxyz", velocities = "drawn" }}
potential = {{ kind = "lennard-jones", sigma = 1.0, epsilon = 1.0 }}
cutoff = {{ kind = "switched", radius = 3.1 }}
neighbors = {{ skin = 0.2 }}
dynamics = {{ kind = "langevin", steps = 8000, timestep = 0.004, temperature = {temperature}, friction = 2 }}
"""
#: Values that a newcomer changes in a shipped system.
CHANGES: dict[str, dict[str, Any]] = {
    "copper": {
        "dynamics.kind": "langevin", "dynamics.friction": 5.0, "dynamics.temperature": 600.0,
        "dynamics.steps": 4000, "structure.repeat": [4, 4, 4], "structure.rattle": 0.08,
    },
    "ball": {"start.height": 0.6, "integrator.timestep": 0.0001, "integrator.steps": 20_000},
}  # fmt: skip
_LIQUID = ["cutoff.radius=2.2,2.5,2.8,3.1", "dynamics.timestep=0.004,0.008,0.016,0.032"]
#: What is varied, and how far each measure may be from the converged end, in the unit of the measure.
SWEEPS: dict[str, tuple[list[str], dict[str, float]]] = {
    "ball": (["integrator.timestep=0.0001,0.0002,0.0004,0.0008,0.0016,0.0032,0.0064", "precision"],
             {"final_height": 0.01, "energy_kept": 0.01}),
    "copper": (["dynamics.timestep=0.002,0.004,0.008,0.016", "precision"],
               {"energy": 0.004, "temperature": 25.0}),
    "dense": (_LIQUID, {"energy": 0.15, "pressure": 0.3, "temperature": 0.036}),
    "near-critical": (_LIQUID, {"energy": 0.18, "pressure": 0.2, "temperature": 0.045}),
    "hot": (_LIQUID, {"energy": 0.13, "pressure": 0.3, "temperature": 0.1}),
}  # fmt: skip


def system(name: str, folder: Path) -> str:
    """The name or the path of a system file; a liquid is melted and cooled for it."""
    if name not in STATES:
        return {"copper": "copper/eam-500", "ball": "ball/drop"}[name]
    (density, temperature), file = STATES[name], folder / "system.toml"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        atoms = bulk("Ar", "fcc", (4 / density) ** (1 / 3), cubic=True).repeat(4)
        for heat, steps in ((4.0, 1000), (temperature, 4000)):
            write(folder / "structure.extxyz", atoms)
            (folder / "melting.toml").write_text(LIQUID.format(temperature=heat))
            out = folder / f"melting-{heat}"
            shutil.rmtree(out, ignore_errors=True)
            mdnum.run(folder / "melting.toml", steps=steps, save_every=steps, out=out, report=False)
            atoms = read(out / "trajectory.traj")
        write(folder / "structure.extxyz", atoms)
        file.write_text(LIQUID.format(temperature=temperature))
    return str(file)


def swept(name: str, folder: Path) -> dict[str, Any]:
    """The summary of the command of a newcomer; where it was given before, the stored one."""
    (over, tolerance), out = SWEEPS[name], folder / "sweep"
    words = ["sweep", system(name, folder), *(word for one in over for word in ("--over", one))]
    words += ["--seeds", str(SEEDS), "--measure", ",".join(tolerance)]
    words += ["--tolerance", ",".join(f"{key}={value}" for key, value in tolerance.items())]
    words += [word for one in CHANGES.get(name, {}).items() for word in ("--set", "{}={}".format(*one))]
    say("mdnum " + " ".join(words))
    if not (out / "summary.json").exists():
        shutil.rmtree(out, ignore_errors=True)
        own = ["--workers", "1", "--out", str(out), "--points-in", str(folder / "points")]
        # points that fail, at a time step that is too long, are results, too: the exit code is then 1
        subprocess.run([sys.executable, "-m", "mdnum", *words, *own], check=False)
    return json.loads((out / "summary.json").read_text())


def settings(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The converged end, the recommendation, and one value beyond it of each choice."""
    advice = {row["choice"]: row for row in summary["advice"]}
    best = {key: row["best"] for key, row in advice.items()}
    rows = {"converged": {key: row["end"] for key, row in advice.items()}, "recommended": best}
    for key, row in advice.items():
        values = [one["value"] for one in row["settings"]]
        for beyond in values[values.index(row["best"]) + 1 :][:1]:
            rows[f"{key} = {beyond}"] = {**best, key: beyond}
    return rows


def long_run(name: str, choices: dict[str, Any], number: int, folder: Path) -> dict[str, float | None]:
    """Each measure of one run that no sweep has seen; None where the run fails."""
    kept = folder / f"long-{'-'.join(map(str, choices.values()))}-{number}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    changes, out, part = dict(CHANGES.get(name, {})), folder / "long-run", "dynamics"
    roles: tuple[str, ...] = ("state", "force")
    if name == "ball":
        part, roles = "integrator", ("state", "arithmetic", "decision")
    own = getattr(mdnum.load(file := system(name, folder), changes).spec, part)
    for key, value in choices.items():
        changes |= {f"precision.{role}": value for role in roles} if key == "precision" else {key: value}
    steps = round(LONGER * own.steps * own.timestep / changes.get(f"{part}.timestep", own.timestep))
    found: dict[str, float | None] = dict.fromkeys(SWEEPS[name][1])
    try:
        if name == "ball":
            changes["start.height"] = 0.55 + 0.02 * number
            run = build_ball("ball/drop", changes, steps).problem.run()
            first, last = run.energy[[0, -1], 0]
            found = {"final_height": float(run.y[-1, 0]), "energy_kept": float(last / first)}
        else:
            shutil.rmtree(out, ignore_errors=True)
            changes["dynamics.seed"] = 100 + number
            made = mdnum.run(file, overrides=changes, steps=steps, out=out, check=False, report=False)
            rows = made.table("series").to_pandas()[steps // 5 :].mean()
            found = {"energy": rows.potential / made.summary["atoms"], "temperature": rows.temperature,
                     "pressure": rows.pressure}  # fmt: skip
    except MdnumError as error:
        say(f"{name} {choices}: {error}")
    kept.write_text(json.dumps(found))
    return found


def compared(name: str, one: np.ndarray, end: np.ndarray, tolerance: float) -> tuple[float, float, str]:
    """The difference of a measure from the converged end, its error, and whether it is within."""
    away, error = (
        float(one.mean() - end.mean()),
        float(np.hypot(one.std(ddof=1), end.std(ddof=1))) / SEEDS**0.5,
    )
    if name == "ball":
        away, error = float(np.max(np.abs(one - end))), 0.0
    if not np.isfinite(away):
        return away, error, "no: failed"
    decided = abs(abs(away) - tolerance) > 2 * error
    return away, error, ("yes" if abs(away) < tolerance else "no") if decided else "undecided"


def main() -> None:
    """Sweep, run what is recommended, and compare."""
    made = parser(__doc__)
    made.add_argument("--in", dest="folder", type=Path, default=Path("recommended"), metavar="FOLDER")
    made.add_argument("--system", choices=list(SWEEPS), action="append", help="only this one; repeatable")
    asked = made.parse_args()
    for name in asked.system or SWEEPS:
        folder = asked.folder.absolute() / name
        summary, tolerances = swept(name, folder), SWEEPS[name][1]
        rows = summary["differences"]
        seen = {
            key: max(row["detectable"] or 0.0 for row in rows if row["measure"] == key) for key in tolerances
        }
        values, lines = {}, []
        for setting, choices in settings(summary).items():
            runs = [long_run(name, choices, k, folder) for k in range(SEEDS)]
            values[setting] = {key: np.array([run[key] for run in runs], float) for key in tolerances}
            for key, tolerance in tolerances.items() if setting != "converged" else ():
                found = compared(name, values[setting][key], values["converged"][key], tolerance)
                lines.append((setting, key, *found[:2], tolerance, seen[key], found[2]))
        columns = ["setting", "measure", "difference", "error", "tolerance", "could have seen", "within"]
        table(f"{name}: {settings(summary)}", columns, lines, words=2)


if __name__ == "__main__":
    start(main)
