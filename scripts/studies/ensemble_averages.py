"""Do averages at constant temperature and pressure agree with those of LAMMPS and ASE?

Answer. Yes: density, energy, pressure and temperature of 14 runs agree within their errors
(docs/constant-pressure.md). It takes many minutes.

256 Lennard-Jones atoms, cut at 2.5 σ and shifted there, under every such integrator of each code: a liquid
at T = 0.8 ε/k_B and the density 0.73 σ⁻³; the same at a quarter of the critical pressure (0.032 ε/σ³) in a
cube; and a crystal at T = 0.3 and that pressure in a box of any shape. The start is the same; lists,
integrators and random numbers are not.

    density      atoms per σ³
    energy       potential energy an atom, ε
    pressure     kinetic part and virial, ε/σ³
    temperature  of 3 N - 3 degrees of freedom, ε/k_B
    off          largest difference from the mean of the other rows of its ensemble, in standard errors

How to read it. Behind each average stands its standard error, from averages over blocks. An "off" of two is
chance; four is not. ASE's chains count 3 N degrees of freedom although the momenta have 3 N - 3, so its
temperature is set lower by that ratio.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table
from ase import Atoms, units
from ase.build import bulk
from ase.calculators.calculator import Calculator, all_changes
from ase.md import nose_hoover_chain
from ase.md.bussi import Bussi
from ase.stress import full_3x3_to_voigt_6_stress
from numba import njit

import mdnum
from mdnum.rollout import Engine
from mdnum.systems import Simulation

PRESSURE, R_CUT, TIMESTEP = 0.032, 2.5, 0.004
RELAXATION, PRESSURE_RELAXATION, COMPRESSIBILITY = 0.4, 2.0, 0.13
NVT, NPT, FULL = "liquid, NVT", "liquid, NPT", "crystal, NPT full box"
#: Density of the start and temperature.
STATES = {NVT: (0.73, 0.8), NPT: (0.73, 0.8), FULL: (1.0, 0.3)}
COLUMNS = ("density", "energy", "pressure", "temperature")
Series = dict[str, np.ndarray]


@cache
def begin(density: float, temperature: float) -> Atoms:
    """256 atoms with velocities, by Langevin dynamics of mdnum; a liquid is melted before."""
    atoms = bulk("Ar", "fcc", a=(4 / density) ** (1 / 3), cubic=True).repeat(4)
    atoms.set_masses(np.ones(len(atoms)))
    made = _simulation(atoms, None, temperature=temperature, friction=1.0, seed=1)
    stages = ((2 * temperature, 2000),) * (density < 0.8) + ((temperature, 4000),)
    for kelvin, steps in stages:
        made = replace(made, integrator=made.integrator.with_number("temperature", kelvin, made.units))
        *_, last = Engine(made, steps).segments()
        x, v = np.asarray(last.state.x_before).T, last.unsorted("v", last.rows - 1)
        made = replace(made, positions=x, velocities=v)
    atoms.set_positions(made.positions)
    atoms.set_velocities(made.velocities - made.velocities.mean(axis=0))
    return atoms


def _simulation(atoms: Atoms, kind: Any, **options: Any) -> Simulation:
    return mdnum.simulation(
        atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("shifted", R_CUT), units="lj", timestep=TIMESTEP,
        integrator=kind, skin=0.3, **options,
    )  # fmt: skip


def of_mdnum(atoms: Atoms, temperature: float, steps: int, kind: str, **own: Any) -> Series:
    """A run by the integrator of this name."""
    numbers = {"relaxation": RELAXATION, **own}
    made = _simulation(atoms, kind, temperature=temperature, steps=steps, seed=5, dynamics=numbers)
    n, columns = made.atoms, ("potential", "kinetic", "virial", "volume")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    for segment in Engine(made, steps, record=False).segments():
        for name in columns[:3]:
            parts[name].append(segment.rows_of(name).copy())
        volumes = [cell.volume for cell in segment.cells] or [made.cell.volume] * segment.rows
        parts["volume"].append(np.array(volumes))
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    volume, kinetic = whole["volume"], whole["kinetic"]
    return {
        "density": n / volume,
        "energy": whole["potential"] / n,
        "pressure": (2 * kinetic + whole["virial"]) / (3 * volume),
        "temperature": 2 * kinetic / (3 * n - 3),
    }


def of_lammps(atoms: Atoms, temperature: float, steps: int, fixes: str) -> Series:
    """A run of LAMMPS with these fixes; a row every fourth step."""
    from _peers import lammps_of

    fixes = fixes.replace("TEMP", f"temp {temperature} {temperature} {RELAXATION}").replace(
        "PRESS", f"{PRESSURE} {PRESSURE} {PRESSURE_RELAXATION}"
    )
    held = lammps_of(
        _simulation(atoms, None),
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


@njit(cache=True, fastmath=True)
def _all_pairs(s: np.ndarray, box: np.ndarray, r_cut: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Energy, forces and the sum of r ⊗ F of all pairs within the cutoff, of scaled positions."""
    energy, forces, tensor, d = 0.0, np.zeros_like(s), np.zeros((3, 3)), np.zeros(3)
    shift = 4 * (r_cut**-12 - r_cut**-6)
    for i in range(len(s)):
        for j in range(i):
            a, b, c = s[i, 0] - s[j, 0], s[i, 1] - s[j, 1], s[i, 2] - s[j, 2]
            a, b, c = a - np.rint(a), b - np.rint(b), c - np.rint(c)
            r2 = 0.0
            for k in range(3):
                d[k] = a * box[0, k] + b * box[1, k] + c * box[2, k]
                r2 += d[k] * d[k]
            if r2 < r_cut * r_cut:
                six = 1 / (r2 * r2 * r2)
                energy += 4 * (six * six - six) - shift
                pull = 24 * (2 * six * six - six) / r2
                for k in range(3):
                    forces[i, k] += pull * d[k]
                    forces[j, k] -= pull * d[k]
                    for m in range(3):
                        tensor[k, m] += pull * d[k] * d[m]
    return energy, forces, tensor


class AllPairs(Calculator):
    """The liquid in ASE, without a list: ASE's own Lennard-Jones takes hundreds of times as long."""

    implemented_properties = ["energy", "free_energy", "forces", "stress"]  # noqa: RUF012

    def calculate(self, atoms: Any = None, properties: Any = (), system_changes: Any = all_changes) -> None:
        """All of them at once."""
        super().calculate(atoms, properties, system_changes)
        scaled = np.linalg.solve(atoms.cell.array.T, atoms.positions.T).T
        energy, forces, tensor = _all_pairs(scaled, atoms.cell.array, R_CUT)
        stress = full_3x3_to_voigt_6_stress(-tensor / atoms.get_volume())
        self.results = {"energy": energy, "free_energy": energy, "forces": forces, "stress": stress}


def of_ase(atoms: Atoms, temperature: float, steps: int, kind: str) -> Series:
    """A run of ASE, whose time with these numbers is that of reduced units; a row every fourth step."""
    atoms, n, rows = atoms.copy(), len(atoms), []
    atoms.calc = AllPairs()
    if kind == "Bussi":
        rng = np.random.default_rng(1)
        moved = Bussi(atoms, TIMESTEP, temperature_K=temperature / units.kB, taut=RELAXATION, rng=rng)
    else:
        # of 3 N degrees of freedom
        kelvin = temperature / units.kB * (3 * n - 3) / (3 * n)
        given = {"temperature_K": kelvin, "tdamp": RELAXATION}
        if kind != "NoseHooverChainNVT":
            given |= {"pressure_au": PRESSURE, "pdamp": PRESSURE_RELAXATION}
        moved = getattr(nose_hoover_chain, kind)(atoms, TIMESTEP, **given)

    def see() -> None:
        pressure = -np.trace(atoms.get_stress(voigt=False, include_ideal_gas=True)) / 3
        kinetic = atoms.get_kinetic_energy()
        rows.append(
            (n / atoms.get_volume(), atoms.get_potential_energy() / n, pressure, 2 * kinetic / (3 * n - 3))
        )

    moved.attach(see, interval=4)
    moved.run(steps)
    return dict(zip(COLUMNS, np.array(rows).T, strict=True))


#: Every run of the table by ensemble, code and integrator.
RUNS: dict[tuple[str, str, str], Callable[..., Series]] = {
    (NVT, "LAMMPS", "fix nvt"): partial(of_lammps, fixes="fix 1 all nvt TEMP"),
    (NVT, "LAMMPS", "fix temp/csvr"): partial(
        of_lammps, fixes=f"fix 1 all nve; fix 2 all temp/csvr 0.8 0.8 {RELAXATION} 54321"
    ),
    (NVT, "ASE", "NoseHooverChainNVT"): partial(of_ase, kind="NoseHooverChainNVT"),
    (NVT, "ASE", "Bussi"): partial(of_ase, kind="Bussi"),
    (NVT, "mdnum", "nose-hoover"): partial(of_mdnum, kind="nose-hoover"),
    (NVT, "mdnum", "csvr"): partial(of_mdnum, kind="csvr"),
    (NPT, "LAMMPS", "fix npt iso"): partial(of_lammps, fixes="fix 1 all npt TEMP iso PRESS"),
    (NPT, "ASE", "IsotropicMTKNPT"): partial(of_ase, kind="IsotropicMTKNPT"),
    (FULL, "LAMMPS", "fix npt tri"): partial(
        of_lammps, fixes="change_box all triclinic; fix 1 all npt TEMP tri PRESS"
    ),
    (FULL, "ASE", "MTKNPT"): partial(of_ase, kind="MTKNPT"),
}
for _ensemble, _box in ((NPT, "isotropic"), (FULL, "full")):
    _given = {"pressure": PRESSURE, "pressure_relaxation": PRESSURE_RELAXATION, "box": _box}
    RUNS[_ensemble, "mdnum", "mtk"] = partial(of_mdnum, kind="mtk", **_given)
    RUNS[_ensemble, "mdnum", "cell-rescaling"] = partial(
        of_mdnum, kind="cell-rescaling", compressibility=COMPRESSIBILITY, **_given
    )


def mean(a: np.ndarray, blocks: int = 16) -> tuple[float, float]:
    """The average without the first tenth, and its standard error of blocks."""
    kept = a[len(a) // 10 :]
    parts = np.array([part.mean() for part in np.array_split(kept, blocks)])
    return float(kept.mean()), float(parts.std(ddof=1) / np.sqrt(blocks))


def main() -> None:
    """Run and print the table."""
    made = parser(__doc__)
    made.add_argument("--steps", type=int, default=100_000, help="of LAMMPS and mdnum (default %(default)s)")
    made.add_argument("--ase-steps", type=int, default=50_000, help="of ASE (default %(default)s)")
    made.add_argument("--only", nargs="*", metavar="WORD", help="rows with one of these words")
    arguments = made.parse_args()
    seen: dict[tuple[str, str, str], dict[str, tuple[float, float]]] = {}
    for key, run in sorted(RUNS.items(), key=lambda one: list(STATES).index(one[0][0])):
        if arguments.only and not any(word in " ".join(key) for word in arguments.only):
            continue
        began = time.process_time()
        steps = arguments.ase_steps if key[1] == "ASE" else arguments.steps
        series = run(begin(*STATES[key[0]]), STATES[key[0]][1], steps)
        seen[key] = {name: mean(series[name]) for name in COLUMNS}
        say(f"{', '.join(key)}: {time.process_time() - began:.0f} s")
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
