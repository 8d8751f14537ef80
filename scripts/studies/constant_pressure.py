"""Are averages at constant temperature and pressure those of LAMMPS and ASE?

Answer. TO BE WRITTEN

One Lennard-Jones liquid of 256 atoms, cut at 2.5 σ and shifted there, at T = 0.8 ε/k_B and a quarter of the critical
pressure (0.032 ε/σ³), is run by every integrator of every code that has one: at constant volume at the density
0.73 σ⁻³, and at constant pressure. The start is the same; lists, integrators and random numbers are not.

    density      atoms per σ³
    energy       potential energy an atom, ε
    pressure     kinetic part and virial, ε/σ³
    temperature  of 3 N - 3 degrees of freedom, ε/k_B
    off          largest difference from the mean of all rows of its ensemble, in standard errors

How to read it. Behind each average stands its standard error, from averages over blocks. An "off" of two is chance; four
is not. ASE's chains count 3 N degrees of freedom although the momenta have 3 N - 3, so its temperature is set lower by
that ratio.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table
from ase import Atoms, units
from ase.build import bulk

import mdnum
from mdnum.md.integrators import INTEGRATORS
from mdnum.rollout import Engine
from mdnum.systems import Simulation

T, PRESSURE, DENSITY, R_CUT, TIMESTEP = 0.8, 0.032, 0.73, 2.5, 0.004
RELAXATION, PRESSURE_RELAXATION, COMPRESSIBILITY = 0.4, 2.0, 0.13
COLUMNS = ("density", "energy", "pressure", "temperature")
_FULL_CELL = {"box": "full"}
Series = dict[str, np.ndarray]


@cache
def melted() -> Atoms:
    """The liquid, of 256 atoms, with velocities."""
    atoms = bulk("Ar", "fcc", a=(4 / DENSITY) ** (1 / 3), cubic=True).repeat(4)
    atoms.set_masses(np.ones(len(atoms)))
    made = _simulation(atoms, None, temperature=1.6, friction=1.0, seed=1)
    for temperature, steps in ((1.6, 2000), (T, 4000)):
        made = replace(made, integrator=made.integrator.with_number("temperature", temperature, made.units))
        *_, last = Engine(made, steps).segments()
        made = replace(
            made, positions=np.asarray(last.state.x_before).T, velocities=last.unsorted("v", last.rows - 1)
        )
    atoms.set_positions(made.positions)
    atoms.set_velocities(made.velocities - made.velocities.mean(axis=0))
    return atoms


def _simulation(atoms: Atoms, kind: Any, **options: Any) -> Simulation:
    return mdnum.simulation(
        atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("shifted", R_CUT), units="lj", timestep=TIMESTEP,
        integrator=kind, skin=0.3, **options,
    )  # fmt: skip


def of_mdnum(kind: str, steps: int, **own: Any) -> Series:
    """A run by the integrator of this name; its thermostat's time, and the barostat's, as everywhere here."""
    dynamics: dict[str, Any] = {"relaxation": RELAXATION, **own}
    if INTEGRATORS[kind].moves_cell:
        dynamics |= {"pressure": PRESSURE, "pressure_relaxation": PRESSURE_RELAXATION}
    made = _simulation(melted(), INTEGRATORS[kind], temperature=T, dynamics=dynamics, steps=steps, seed=5)
    atoms, columns = made.atoms, ("potential", "kinetic", "virial", "volume")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    for segment in Engine(made, steps, record=False).segments():
        for name in columns[:3]:
            parts[name].append(segment.rows_of(name).copy())
        volumes = [cell.volume for cell in segment.cells] or [made.cell.volume] * segment.rows
        parts["volume"].append(np.array(volumes))
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    volume, kinetic = whole["volume"], whole["kinetic"]
    return {
        "density": atoms / volume,
        "energy": whole["potential"] / atoms,
        "pressure": (2 * kinetic + whole["virial"]) / (3 * volume),
        "temperature": 2 * kinetic / (3 * atoms - 3),
    }


def of_lammps(fixes: str, steps: int) -> Series:
    """A run of LAMMPS with these fixes; a row every fourth step."""
    from _peers import lammps_of

    made = _simulation(melted(), None)
    held = lammps_of(
        made,
        "pair_modify shift yes",
        *fixes.split("; "),
        "variable d equal density",
        "variable e equal pe",
        "variable p equal press",
        "variable t equal temp",
        "fix series all vector 4 v_d v_e v_p v_t",
        "thermo_modify norm yes",
    )
    held.command(f"run {steps}")
    count = (steps // 4) + 1
    return {
        name: np.array([held.extract_fix("series", 0, 2, row, column) for row in range(count)])
        for column, name in enumerate(COLUMNS)
    }


def of_ase(make: Callable[..., Any], steps: int, **options: Any) -> Series:
    """A run of ASE with its own Lennard-Jones, whose time is that of reduced units; a row every fifth step."""
    from ase.calculators.lj import LennardJones

    atoms = melted().copy()
    atoms.calc = LennardJones(sigma=1.0, epsilon=1.0, rc=R_CUT, ro=0.0, smooth=False)
    moved, n, rows = make(atoms, TIMESTEP, **options), len(atoms), []

    def see() -> None:
        pressure = -np.trace(atoms.get_stress(voigt=False, include_ideal_gas=True)) / 3
        kinetic = atoms.get_kinetic_energy()
        rows.append(
            (n / atoms.get_volume(), atoms.get_potential_energy() / n, pressure, 2 * kinetic / (3 * n - 3))
        )

    moved.attach(see, interval=5)
    moved.run(steps)
    return dict(zip(COLUMNS, np.array(rows).T, strict=True))


def rows(ase_steps: int, steps: int) -> dict[tuple[str, str, str], Callable[[], Series]]:
    """Every run of the table by ensemble, code and integrator."""
    from ase.md.bussi import Bussi
    from ase.md.nose_hoover_chain import MTKNPT, IsotropicMTKNPT, NoseHooverChainNVT

    n = len(melted())
    times = {"tdamp": RELAXATION}
    # of 3 N degrees of freedom
    kelvin = {"temperature_K": T / units.kB * (3 * n - 3) / (3 * n)}
    press = {"pressure_au": PRESSURE, "pdamp": PRESSURE_RELAXATION, **times, **kelvin}
    bussi = {"temperature_K": T / units.kB, "taut": RELAXATION, "rng": np.random.default_rng(1)}
    both, damp = f"temp {T} {T} {RELAXATION}", f"{PRESSURE} {PRESSURE} {PRESSURE_RELAXATION}"
    csvr = f"fix 2 all temp/csvr {T} {T} {RELAXATION} 54321"
    compressed = {"compressibility": COMPRESSIBILITY}
    nvt, npt = "constant volume", "constant pressure"
    return {
        (nvt, "LAMMPS", "fix nvt"): lambda: of_lammps(f"fix 1 all nvt {both}", steps),
        (nvt, "LAMMPS", "fix temp/csvr"): lambda: of_lammps(f"fix 1 all nve; {csvr}", steps),
        (nvt, "ASE", "NoseHooverChainNVT"): lambda: of_ase(
            NoseHooverChainNVT, ase_steps, **times, **kelvin
        ),
        (nvt, "ASE", "Bussi"): lambda: of_ase(Bussi, ase_steps, **bussi),
        (nvt, "mdnum", "nose-hoover"): lambda: of_mdnum("nose-hoover", steps),
        (nvt, "mdnum", "csvr"): lambda: of_mdnum("csvr", steps),
        (npt, "LAMMPS", "fix npt iso"): lambda: of_lammps(f"fix 1 all npt {both} iso {damp}", steps),
        (npt, "LAMMPS", "fix npt tri"): lambda: of_lammps(
            f"change_box all triclinic; fix 1 all npt {both} tri {damp}", steps
        ),
        (npt, "ASE", "IsotropicMTKNPT"): lambda: of_ase(IsotropicMTKNPT, ase_steps, **press),
        (npt, "mdnum", "mtk"): lambda: of_mdnum("mtk", steps),
        (npt, "mdnum", "cell-rescaling"): lambda: of_mdnum("cell-rescaling", steps, **compressed),
    }


def mean(a: np.ndarray, blocks: int = 16) -> tuple[float, float]:
    """The average without the first tenth, and its standard error of blocks."""
    kept = a[len(a) // 10 :]
    parts = np.array([part.mean() for part in np.array_split(kept, blocks)])
    return float(kept.mean()), float(parts.std(ddof=1) / np.sqrt(blocks))


def main() -> None:
    """Run and print the table."""
    made = parser(__file__, __doc__)
    made.add_argument("--steps", type=int, default=400_000, help="of LAMMPS and mdnum (default %(default)s)")
    made.add_argument("--ase-steps", type=int, default=20_000, help="of ASE (default %(default)s)")
    made.add_argument("--only", nargs="*", metavar="WORD", help="rows with one of these words")
    arguments = made.parse_args()
    seen: dict[tuple[str, str, str], dict[str, tuple[float, float]]] = {}
    for key, run in rows(arguments.ase_steps, arguments.steps).items():
        if arguments.only and not any(word in " ".join(key) for word in arguments.only):
            continue
        begin = time.process_time()
        series = run()
        seen[key] = {name: mean(series[name]) for name in COLUMNS}
        say(f"{', '.join(key)}: {time.process_time() - begin:.0f} s")
    table("averages", ("ensemble", "code", "integrator", *COLUMNS, "off"), printed(seen), words=3)


def printed(seen: dict[tuple[str, str, str], dict[str, tuple[float, float]]]) -> list[tuple[Any, ...]]:
    """The cells of the table: averages, errors, and how far each row is from the others of its ensemble."""
    lines = []
    for (ensemble, code, integrator), own in seen.items():
        others = [one for (name, *_), one in seen.items() if name == ensemble and one is not own]
        off = [0.0]
        for name in COLUMNS:
            weights = [1 / max(one[name][1], 1e-12) ** 2 for one in others]
            if weights and own[name][1] > 1e-9:
                center = np.average([one[name][0] for one in others], weights=weights)
                off.append(abs(own[name][0] - center) / np.hypot(own[name][1], sum(weights) ** -0.5))
        cells = [f"{value:.4f} ± {error:.4f}" for value, error in own.values()]
        lines.append((ensemble, code, integrator, *cells, f"{max(off):.1f}"))
    return lines


if __name__ == "__main__":
    start(main)
