"""Thermostats and barostats beside closed forms and Monte Carlo, and the errors that these find.

Judges and their figures: docs/constant-pressure.md.
"""

from __future__ import annotations

from typing import Any

import ensembles
import jax
import jax.numpy as jnp
import numpy as np
import planted_ensembles as planted
import pytest
from all_pairs_steps import lennard_jones, trajectory
from ase.build import bulk
from ensembles import settled
from planted_ensembles import DialedMTK, DialedRescaling
from scipy.optimize import minimize_scalar

import mdnum
from mdnum.md.barostats import MTK, CellRescaling
from mdnum.md.thermostats import CSVR, NoseHooverChain
from mdnum.rollout.engine import Engine

KT, ATOMS = 1.0, 32
#: The gas, and the liquid: cut off at 1.35 σ so that it fits into the box of 32 atoms.
GAS = {"pressure": 0.5, "timestep": 0.01, "relaxation": 0.1, "pressure_relaxation": 0.2}
R_CUT, PRESSURES = 1.35, (3.0, 3.5)
LENNARD_JONES = lennard_jones(R_CUT)
LIQUID = {"pressure": 3.0, "timestep": 0.004, "relaxation": 0.1, "pressure_relaxation": 0.4}
#: What `ensembles.monte_carlo` finds for the liquid, with standard errors (a nightly test makes it again).
MONTE_CARLO = {"volume": (45.533, 0.029), "variance": (4.728, 0.060), "potential": (-23.355, 0.042)}
#: Likewise for a crystal at T = 0.2 and p = 1 whose box moves in all its six ways.
CRYSTAL = {"volume": (32.5732, 0.0021), "variance": (0.1530, 0.0010), "potential": (-76.363, 0.006)}


def made(kind: type, numbers: dict[str, float], **own: Any) -> Any:
    """An integrator of numbers in reduced units, at the temperature of this file."""
    given = {"kT": KT, **numbers, **own}
    if issubclass(kind, CellRescaling):
        given["compressibility"] = {0.5: 2.0, 3.0: 0.1}.get(given["pressure"], 0.02)
    names = {field.name: field.name for field in kind.keys().values()}
    arrays = {name: jnp.float64(given[name]) for name in names if name not in ("key", "chain", "box")}
    if "key" in names:
        arrays["key"] = jax.random.key(7)
    return kind(**arrays, **{name: own[name] for name in ("dials", "start", "box") if name in own})


def dialed(kind: type, numbers: dict[str, float], edge: float, kT: float = KT, **wrong: float) -> Any:
    """A barostat with dials: those given are wrong, the others right."""
    dials = planted.MTK_DIALS if kind is DialedMTK else planted.RESCALING_DIALS
    values = {name: jnp.float64(value) for name, value in (dials | wrong).items()}
    return made(kind, numbers, kT=kT, dials=values, start=edge * jnp.eye(3))


def crystal(density: float = 0.7):
    return bulk("Ar", "fcc", a=(4 / density) ** (1 / 3), cubic=True) * (2, 2, 2)


def gas_judged(integrator: Any, steps: int = 6000) -> dict[str, bool]:
    """Which judges an ideal gas passes."""
    x = 4 * np.random.default_rng(0).random((ATOMS, 3))
    rows = trajectory(integrator, x, 4 * np.eye(3), kT=KT, steps=steps)
    kept = {name: settled(rows[name]) for name in ("volume", "kinetic", "pressure")}
    judgments = {
        **ensembles.ideal_volume(kept["volume"], KT, GAS["pressure"], ATOMS),
        **ensembles.kinetic_energy(kept["kinetic"], KT, 3 * ATOMS - 3),
        "pressure": ensembles.mean_pressure(kept["pressure"], GAS["pressure"]),
    }
    passed = {name: one.passes for name, one in judgments.items()}
    return passed | {"conserved": ensembles.conserves(rows["conserved"], rows["kinetic"])}


def liquid_run(
    integrator: Any, steps: int = 2400, density: float = 0.7, kT: float = KT
) -> dict[str, np.ndarray]:
    """Of atoms that begin on a lattice."""
    atoms = crystal(density)
    forces = LENNARD_JONES
    return trajectory(integrator, atoms.positions, atoms.cell.array, forces=forces, kT=kT, steps=steps)


def liquid_judged(rows: dict[str, np.ndarray], expected: dict[str, tuple[float, float]], kT: float, p: float):
    """Which judges a system passes whose averages are known."""
    kept = {name: settled(rows[name]) for name in ("volume", "potential", "kinetic", "pressure")}
    judgments = {
        "volume": ensembles.average(kept["volume"], *expected["volume"]),
        "fluctuation": ensembles.variance(kept["volume"], *expected["variance"]),
        "potential": ensembles.average(kept["potential"], *expected["potential"]),
        **ensembles.kinetic_energy(kept["kinetic"], kT, 3 * ATOMS - 3),
        "pressure": ensembles.mean_pressure(kept["pressure"], p),
    }
    passed = {name: one.passes for name, one in judgments.items()}
    return passed | {"conserved": ensembles.conserves(rows["conserved"], rows["kinetic"])}


KINDS = [DialedMTK, DialedRescaling]
#: With forces each is compiled for seconds.
WITH_FORCES = [DialedMTK, pytest.param(DialedRescaling, marks=pytest.mark.nightly)]


@pytest.mark.parametrize("kind", KINDS)
def test_an_ideal_gas_passes(kind):
    judged = gas_judged(dialed(kind, GAS, 4.0))
    assert all(judged.values()), judged


@pytest.mark.parametrize("name", planted.WRONG)
def test_an_ideal_gas_finds(name):
    kind, wrong = planted.WRONG[name]
    judged = gas_judged(dialed(kind, GAS, 4.0, **wrong))
    assert not all(judged.values())


@pytest.mark.parametrize("kind", WITH_FORCES)
def test_a_liquid_is_that_of_monte_carlo(kind):
    rows = liquid_run(dialed(kind, LIQUID, 3.57))
    judged = liquid_judged(rows, MONTE_CARLO, KT, LIQUID["pressure"])
    assert all(judged.values()), judged
    # at another pressure, without knowing any average
    higher = liquid_run(dialed(kind, LIQUID | {"pressure": PRESSURES[1]}, 3.57))
    volumes = [settled(one["volume"]) for one in (rows, higher)]
    ratio = ensembles.two_pressures(volumes, PRESSURES, KT)
    kappa = ensembles.compressibility(volumes, PRESSURES, KT)
    assert ratio.passes and ratio.error < 0.12, ratio
    assert kappa.passes and kappa.error < 0.2 * kappa.expected, kappa
    if kind is DialedRescaling:
        quiet = [
            settled(liquid_run(dialed(kind, LIQUID | {"pressure": p}, 3.57, noise=0.0))["volume"])
            for p in PRESSURES
        ]
        assert ensembles.two_pressures(quiet, PRESSURES, KT).value < 2 * ratio.expected
        assert not ensembles.compressibility(quiet, PRESSURES, KT).passes


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=[pytest.mark.nightly] * ("rescaling" in one)) for one in planted.WRONG_VIRIAL],
)
def test_a_liquid_finds(name):
    kind, wrong = planted.WRONG_VIRIAL[name]
    with np.errstate(all="ignore"):
        rows = liquid_run(dialed(kind, LIQUID, 3.57, **wrong))
        judged = liquid_judged(rows, MONTE_CARLO, KT, LIQUID["pressure"])
    assert not (judged["volume"] and judged["potential"])


def of_rest(p: float) -> tuple[float, float]:
    """U + p V of the crystal at rest, with twelve neighbors of each atom inside, and its volume."""
    shift = 4 * (R_CUT**-12 - R_CUT**-6)

    def enthalpy(r: float) -> float:
        return ATOMS * (6 * (4 * (r**-12 - r**-6) - shift) + p * r**3 / 2**0.5)

    found = minimize_scalar(enthalpy, bounds=(0.9, 1.3), options={"xatol": 1e-12})
    return enthalpy(found.x), ATOMS * found.x**3 / 2**0.5


@pytest.mark.parametrize("kind", WITH_FORCES)
def test_a_cold_crystal_holds_half_a_kT_a_mode(kind):
    """Of 3 N - 3 vibrations and the volume; and it comes back from half a percent of either side."""
    kT, p = 0.002, 1.0
    least, volume = of_rest(p)
    # a stiff box oscillates 3 sqrt(V / (kappa N_f kT)) times as fast as the inertia of MTK is meant for
    cold = LIQUID | {"pressure": p, "pressure_relaxation": 6.0 if kind is DialedMTK else 0.2}
    for strain in (-0.005, 0.005):
        rows = liquid_run(dialed(kind, cold, 3.57, kT=kT), 2400, ATOMS / volume / (1 + strain), kT)
        start = (1 + strain) * volume
        assert all(ensembles.comes_back(one, volume) for one in rows["volume"]), start
    enthalpy = settled(rows["potential"] + p * rows["volume"], 0.4)
    judged = ensembles.harmonic(enthalpy, least, kT, 3 * ATOMS - 3 + 1)
    assert judged.passes and judged.error < 0.03 * (judged.expected - least), judged
    wrong = {"virial": -1.0}
    with np.errstate(all="ignore"):
        away = liquid_run(dialed(kind, cold, 3.57, kT=kT, **wrong), 2400, ATOMS / volume / 1.005, kT)
    assert not any(ensembles.comes_back(one, volume) for one in away["volume"])


def test_what_mtk_conserves_is_of_second_order():
    # in a crystal: no pair crosses the cutoff, where the force jumps
    spread, kT, numbers = {}, 0.1, LIQUID | {"pressure": 1.0}
    for name, wrong in (("right", {}), ("push", {"push": 1.1}), ("slowing", {"slowing": 0.0})):
        runs = []
        for timestep in (0.004, 0.002):
            integrator = dialed(DialedMTK, numbers | {"timestep": timestep}, 3.57, kT, **wrong)
            rows = liquid_run(integrator, density=1.0, kT=kT)
            runs.append(rows["conserved"][:, : int(4 / timestep)])
        spread[name] = np.mean([ensembles.order(pair, (2, 1)) for pair in zip(*runs, strict=True)])
    assert spread["right"] == pytest.approx(2, abs=0.3)
    assert max(spread["push"], spread["slowing"]) < 1


@pytest.mark.nightly
def test_monte_carlo_still_gives_its_numbers():
    atoms, rng = crystal(), np.random.default_rng(1)
    kept = ensembles.monte_carlo(
        atoms.positions, atoms.cell.array, KT, LIQUID["pressure"], R_CUT, 400_000, False, rng
    )
    assert_of_record(kept, MONTE_CARLO)
    # an ideal gas, and the ratio of two pressures
    x = 4 * np.random.default_rng(0).random((ATOMS, 3))
    gas = [ensembles.monte_carlo(x, 4 * np.eye(3), KT, p, 1e-3, 40_000, False, rng)[:, 1] for p in (0.5, 0.6)]
    assert all(one.passes for one in ensembles.ideal_volume(gas[0], KT, 0.5, ATOMS).values())
    assert ensembles.two_pressures(gas, (0.5, 0.6), KT).passes
    full = crystal(1.0)
    kept = ensembles.monte_carlo(full.positions, full.cell.array, 0.2, 1.0, R_CUT, 400_000, True, rng)
    assert_of_record(kept, CRYSTAL)


def assert_of_record(kept: np.ndarray, record: dict[str, tuple[float, float]]) -> None:
    """A sample beside what is recorded of one, which the judges above use."""
    judged = {
        "volume": ensembles.average(kept[:, 1], *record["volume"]),
        "variance": ensembles.variance(kept[:, 1], *record["variance"]),
        "potential": ensembles.average(kept[:, 0], *record["potential"]),
    }
    assert all(one.passes for one in judged.values()), judged


@pytest.mark.nightly
@pytest.mark.parametrize("kind", [MTK, CellRescaling])
def test_a_crystal_in_a_full_box_is_that_of_monte_carlo(kind):
    """Volume, energy and shape; and the box is not turned."""
    kT, numbers = 0.2, LIQUID | {"pressure": 1.0, "pressure_relaxation": 0.8}
    rows = liquid_run(made(kind, numbers, kT=kT, box="full"), 8000, 1.0, kT)
    judged = liquid_judged(rows, CRYSTAL, kT, 1.0)
    assert all(judged.values()), judged
    atoms = crystal(1.0)
    kept = ensembles.monte_carlo(
        atoms.positions, atoms.cell.array, kT, 1.0, R_CUT, 100_000, True, np.random.default_rng(3)
    )
    a, b, c, cy, cx, bx = kept[:, 2:].T
    none = np.zeros_like(a)
    boxes = np.stack([np.stack([a, none, none]), np.stack([bx, b, none]), np.stack([cx, cy, c])])
    expected, error = ensembles.mean(ensembles.shape(boxes.transpose(2, 0, 1)))
    shape = ensembles.average(settled(ensembles.shape(rows["box"])), expected, error)
    assert shape.passes and shape.error < 0.1 * expected, shape


@pytest.mark.nightly
@pytest.mark.parametrize("kind", [NoseHooverChain, CSVR, MTK, CellRescaling])
def test_the_integrators_themselves_pass(kind):
    """As those with dials, which tell no error: with mdnum's lists and loop."""
    name, npt = kind.name, issubclass(kind, MTK | CellRescaling)
    dynamics: dict[str, Any] = {"relaxation": 0.1}
    if npt:
        dynamics |= {"pressure": 3.0, "pressure_relaxation": 0.4}
    if kind is CellRescaling:
        dynamics["compressibility"] = 0.1
    atoms, runs = crystal(), []
    atoms.set_masses(np.ones(len(atoms)))
    for seed in range(8):
        simulation = mdnum.simulation(
            atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("shifted", R_CUT), units="lj", timestep=0.004,
            integrator=name, temperature=KT, dynamics=dynamics, seed=seed, skin=0.2,
        )  # fmt: skip
        runs.append(series(simulation, 8000))
    rows = {column: np.array([one[column] for one in runs]) for column in runs[0]}
    if npt:
        judged = liquid_judged(rows, MONTE_CARLO, KT, 3.0)
    else:
        kept = ensembles.kinetic_energy(settled(rows["kinetic"]), KT, 3 * ATOMS - 3)
        judged = {one: judgment.passes for one, judgment in kept.items()}
        judged["conserved"] = ensembles.conserves(rows["conserved"], rows["kinetic"])
    assert all(judged.values()), judged


def series(simulation: mdnum.Simulation, steps: int) -> dict[str, np.ndarray]:
    """What `trajectory` gives, of mdnum's own loop."""
    parts: list[dict[str, np.ndarray]] = []
    names = ("potential", "kinetic", "virial", "heat", "work")
    for segment in Engine(simulation, steps, record=False).segments():
        volume = [cell.volume for cell in segment.cells] or [simulation.cell.volume] * segment.rows
        own = {name: segment.rows_of(name).copy() for name in names}
        parts.append(own | {"volume": np.array(volume)})
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    rows["conserved"] = rows["potential"] + rows["kinetic"] - rows["heat"] - rows["work"]
    rows["pressure"] = (2 * rows["kinetic"] + rows["virial"]) / (3 * rows["volume"])
    return rows


def test_judges_of_arrays_that_are_known():
    """Of independent draws they pass; of those of a neighboring ensemble they do not."""
    rng = np.random.default_rng(5)
    right = 2.0 * rng.gamma(ATOMS, size=40_000)
    assert all(one.passes for one in ensembles.ideal_volume(right, 1.0, 0.5, ATOMS).values())
    assert not ensembles.ideal_volume(right, 1.0, 0.5, ATOMS + 1)["volume"].passes
    narrow = right.mean() + 0.95 * (right - right.mean())
    assert not ensembles.ideal_volume(narrow, 1.0, 0.5, ATOMS)["fluctuation"].passes
    # values that stay alike have fewer that count: as many blocks are as many values
    slow = np.repeat(rng.standard_normal(160), 1000)
    assert ensembles.mean(slow)[1] == pytest.approx(160**-0.5, rel=0.5)
    assert not ensembles.Judgment(1.0, 1.0, float("nan")).passes
