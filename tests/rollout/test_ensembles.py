"""Thermostats and barostats against ASE's, step by step, and against loops written from the papers."""

from __future__ import annotations

from typing import Any

import ase.build
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.md.nose_hoover_chain import MTKNPT, IsotropicMTKNPT, NoseHooverChainNVT
from ase.units import kB
from ensembles import kinds
from forks.harness import made as made_of
from rollout.harness import run
from rollout.test_resume import assert_goes_on
from scipy import stats
from scipy.linalg import expm

import mdnum
from mdnum.errors import InputError
from mdnum.forks.choices import parse, unavailable
from mdnum.md.barostats import exponential, growth
from mdnum.md.integrators import Integrator, quantity
from mdnum.md.thermostats import rescaled
from mdnum.numerics import PrecisionPolicy
from mdnum.references.calculator import MdnumCalculator
from mdnum.rollout.engine import Engine, first_state, unwrapped
from mdnum.store import RunFolder

ARGON = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235)
CUT = mdnum.Cut("quintic", 6.0)
KINDS = kinds(0.1, 0.3, 2.0)


def fluid(repeat: int = 3, seed: int = 1, tilt: float = 0.0):
    """108 argon atoms, some of them moving."""
    atoms = ase.build.bulk("Ar", "fcc", a=5.4, cubic=True).repeat(repeat)
    atoms.set_cell(atoms.cell.array @ (np.eye(3) + tilt * np.eye(3, k=1)), scale_atoms=True)
    random = np.random.default_rng(seed)
    atoms.positions += 0.1 * random.standard_normal(atoms.positions.shape)
    spread = np.sqrt(kB * 90 * atoms.get_masses())[:, None]
    atoms.set_momenta(spread * random.standard_normal((len(atoms), 3)))
    return atoms


def held(kind: str, atoms=None, timestep: float = 0.004, **options: Any) -> mdnum.Simulation:
    """The fluid under one of `KINDS`, from objects."""
    name, numbers = KINDS[kind]
    pressure = {"pressure": 0.01} if "pressure_relaxation" in numbers else {}
    # a total momentum, as ASE counts degrees of freedom
    given = {"temperature": 90.0, "seed": 3, "skin": 0.6, "dynamics": numbers, "remove_drift": False}
    given |= pressure | options
    atoms = fluid() if atoms is None else atoms
    return mdnum.simulation(atoms, ARGON, CUT, timestep=timestep, integrator=name, **given)


def rows(simulation: mdnum.Simulation, steps: int) -> dict[str, np.ndarray]:
    """Numbers of each step, with positions as if the box had no faces."""
    made: dict[str, list[Any]] = {}
    for segment in Engine(simulation, steps).segments():
        for row in range(segment.rows):
            matrix = np.asarray(segment.cell_of(row).matrix)
            x = unwrapped(matrix, segment.unsorted("x", row), segment.unsorted("images", row))
            values: dict[str, Any] = {"x": x, "v": segment.unsorted("v", row), "box": matrix}
            for name in ("potential", "kinetic", "heat", "work", "virial"):
                values[name] = float(segment.rows_of(name)[row])
            for name, value in values.items():
                made.setdefault(name, []).append(value)
    out = {name: np.array(values) for name, values in made.items()}
    return out | {"conserved": out["potential"] + out["kinetic"] - out["heat"] - out["work"]}


def by_ase(kind: str, simulation: mdnum.Simulation, atoms, steps: int):
    """The same in ASE, with the degrees of freedom that its box has and the same inertia of its chain."""
    units, own = simulation.units, simulation.integrator
    atoms.calc = MdnumCalculator(potential=ARGON, cutoff=CUT)
    given: dict[str, Any] = {"timestep": float(own.timestep), "temperature_K": 90.0}
    given["tdamp"] = 0.1 * units.time_factor
    if kind == "nose-hoover":
        dynamics: Any = NoseHooverChainNVT(atoms, **given)
    else:
        given |= {"pressure_au": 0.01 / units.pressure_factor, "pdamp": 0.3 * units.time_factor}
        dynamics = (MTKNPT if "full" in kind else IsotropicMTKNPT)(atoms, **given)
        own_box = 6 if "full" in kind else 1
        dynamics._barostat._cell_dof = own_box
        dynamics._barostat._R[0] = own_box * kB * 90.0 * given["pdamp"] ** 2
    for step in range(steps + 1):
        if step:
            dynamics.step()
        v = atoms.get_velocities()
        yield atoms.positions, v, atoms.cell.array, dynamics.get_conserved_energy()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("csvr", ("relabel", "rotate=y-zx")),
        ("cell-rescaling", ("relabel", "rotate=y-zx")),
        ("cell-rescaling full", ("relabel",)),
    ],
)
def test_noise_that_all_atoms_share_leaves_a_relabeled_or_rotated_run_the_same(kind, words):
    """Velocities and heat of ten steps, to rounding."""
    a = rows(held(kind), 10)
    largest = np.abs(a["v"]).max()
    assert np.ptp(a["heat"]) > 0.01
    for word in words:
        twin = made_of(word, held(kind))
        b = rows(twin.b.simulation, 10)
        assert np.abs(b["v"][0] - a["v"][0]).max() > largest
        back = twin.b.frame.vectors(b["v"].transpose(0, 2, 1)).transpose(0, 2, 1)
        assert np.abs(back - a["v"]).max() < 1e-11 * largest
        assert b["heat"] == pytest.approx(a["heat"], abs=1e-9)


@pytest.mark.parametrize("word", ["relabel", "rotate=y-zx"])
def test_noise_of_a_full_box_belongs_to_its_axes_and_that_of_csvr_to_nothing(word):
    assert unavailable(parse(word), held("csvr")) is None
    reason = unavailable(parse(word), held("cell-rescaling full"))
    assert ("belongs to axes" in reason) if reason else word == "relabel"


@pytest.mark.parametrize("kind", ["nose-hoover", "mtk", "mtk full"])
def test_each_step_is_that_of_ase(kind):
    atoms = fluid(tilt=0.05 * (kind == "mtk full"))
    simulation = held(kind, atoms)
    made, first = rows(simulation, 50), np.nan
    for step, (x, v, box, conserved) in enumerate(by_ase(kind, simulation, atoms, 50)):
        away = made["x"][step] - made["x"][0] @ np.linalg.solve(made["box"][0], made["box"][step])
        theirs = x - fluid(tilt=0.05 * (kind == "mtk full")).positions @ np.linalg.solve(made["box"][0], box)
        assert np.abs(away - theirs).max() < 1e-9, step
        assert np.abs(made["v"][step] - v).max() < 1e-11 and np.abs(made["box"][step] - box).max() < 1e-9
        ours = made["conserved"][step] - made["conserved"][0]
        first = conserved if step == 0 else first
        assert ours == pytest.approx(conserved - first, abs=1e-9), step
    if kind != "nose-hoover":
        assert np.abs(made["box"][-1] - made["box"][0]).max() > 0.01


def some(*kinds: str):
    """All of `KINDS`, those that are not named in nightly tests alone: each is a program to compile."""
    return [pytest.param(one, marks=[pytest.mark.nightly] * (one not in kinds)) for one in KINDS]


@pytest.mark.parametrize("kind", some("nose-hoover", "mtk full", "cell-rescaling full"))
def test_what_it_conserves_is_of_second_order(kind):
    """Once the crystal has melted; the total alone does what the bath makes it do."""
    errors = []
    for timestep in (0.004, 0.002):
        numbers = KINDS[kind][1] | ({"compressibility": 0.1} if "rescaling" in kind else {})
        made = rows(held(kind, timestep=timestep, dynamics=numbers), round(0.6 / timestep))
        late = made["conserved"][len(made["x"]) // 2 :]
        errors.append(np.std(late))
        assert np.ptp(made["potential"] + made["kinetic"]) > 1000 * errors[-1]
    # an Euler step of the box leaves a random part of first order, which is small while the box is slow
    least, most = (1.5, 12) if "rescaling" in kind else (3.3, 5)
    assert least < errors[0] / errors[1] < most


def test_a_rescaled_kinetic_energy_has_its_exact_distribution():
    """Of a step of any length: noncentral chi-square, as each degree of freedom is Ornstein-Uhlenbeck's."""
    keys, kT = jax.random.split(jax.random.key(1), 4000), 0.7
    many = jax.jit(jax.vmap(rescaled, (0, *[None] * 5)), static_argnums=2)
    for kinetic, time, freedom in ((2.0, 0.1, 9), (9.0, 1.0, 9), (0.2, 0.5, 1)):
        scale = many(keys, kinetic, freedom, kT, 0.8, time)
        kept = np.exp(-time / 0.8)
        unit = 0.5 * kT * (1 - kept)
        law = stats.ncx2(freedom, kept * kinetic / unit)
        assert stats.kstest(kinetic * np.asarray(scale) ** 2 / unit, law.cdf).pvalue > 0.01
    assert (np.asarray(many(keys, 0.0, 9, kT, 0.8, 0.1)) == 1).all()


@pytest.mark.parametrize("full", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_cell_rescaling_is_the_step_of_its_paper(full):
    """From the boxes it has recorded: its noise, its positions and velocities, and its work by densities."""
    simulation, steps = held("cell-rescaling full" if full else "cell-rescaling", timestep=0.005), 60
    made, units = rows(simulation, steps), simulation.units
    dt, kT = 0.005 * units.time_factor, kB * 90.0
    rate = 2.0 * units.pressure_factor / (0.3 * units.time_factor)  # compressibility over relaxation
    m, pressure = simulation.masses[:, None], 0.01 / units.pressure_factor
    at = [simulation.evaluate(x, box) for x, box in zip(made["x"], made["box"], strict=True)]
    heat = np.diff(made["heat"])
    noise, scores = [], []

    def pushed(step, v):
        """Root of the volume, its force, and the traceless excess, of a step with velocities at its end."""
        box = made["box"][step]
        root = np.sqrt(abs(np.linalg.det(box)))
        excess = (m * v).T @ v - root**2 * (at[step].stress + pressure * np.eye(3))
        part = np.trace(excess) / 3
        return root, 2 * part / root + kT / root, (excess - part * np.eye(3)) * full

    def odds(root, force, excess, step, strain, middle):
        """ln of the density of a move from one end."""
        mean, spread = rate / 4 * force * dt, np.sqrt(rate / 2 * kT * dt)
        own = rate / 3 / middle
        z = [(step - mean) / spread]
        if full:
            away = (strain - own * excess * dt) / np.sqrt(2 * own * kT * dt)
            z += [*(np.sqrt(2) * away[np.triu_indices(3, 1)]), *np.diag(away)]
        return -0.5 * np.sum(np.square(z)), z

    for step in range(steps):
        box, after = made["box"][step], made["box"][step + 1]
        by = np.linalg.solve(box, after)
        v = made["v"][step] * np.sqrt(1 + heat[step] / made["kinetic"][step])
        v = v + 0.5 * dt * at[step].forces / m
        w = v @ np.linalg.inv(by)
        x = (made["x"][step] + 0.5 * dt * v) @ by + 0.5 * dt * w
        assert np.abs(x - made["x"][step + 1]).max() < 1e-9
        assert np.abs(w + 0.5 * dt * at[step + 1].forces / m - made["v"][step + 1]).max() < 1e-11
        assert np.abs(by - by.T).max() < 1e-12
        (root, force, excess), (root2, force2, excess2) = pushed(step, v), pushed(step + 1, w)
        w_, u = np.linalg.eigh(by)
        strain = u @ np.diag(np.log(w_)) @ u.T
        strain = strain - np.trace(strain) / 3 * np.eye(3)
        forward, z = odds(root, force, excess, root2 - root, strain, root * root2)
        back, _ = odds(root2, force2, excess2, root - root2, -strain, root * root2)
        given = pressure * (root2**2 - root**2) - kT * np.log(root2 / root) + kT * (forward - back)
        assert made["work"][step] - made["work"][step + 1] == pytest.approx(given, abs=1e-9)
        noise.append(np.sum(np.square(z)))
        scores += z
    freedom = steps * (6 if full else 1)
    assert 0.001 < stats.chi2(freedom).cdf(np.sum(noise)) < 0.999
    assert abs(np.sum(scores)) < 4 * np.sqrt(len(scores))


def test_the_exponential_of_a_rate():
    random = np.random.default_rng(5)
    for size in (0.0, 1e-9, 0.01, 0.4):
        a = random.standard_normal((3, 3))
        a = size * (a + a.T) / np.linalg.norm(a + a.T)
        assert np.abs(exponential(jnp.asarray(a)) - expm(a)).max() < 4e-16
        assert float(growth(jnp.float64(size))) == pytest.approx(
            np.expm1(size) / size if size else 1.0, rel=3e-16
        )


def test_degrees_of_freedom_are_those_that_the_start_left(tmp_path):
    """A momentum that was taken out takes three, of the temperature and of the bath alike."""
    for remove_drift, freedom in ((True, 321), (False, 324)):
        simulation = held("nose-hoover", remove_drift=remove_drift)
        assert simulation.integrator.freedom(simulation.masses) == freedom
    made = run(simulation, out=tmp_path / "run", steps=5).summary
    assert made["degrees_of_freedom"] == freedom
    series = RunFolder.open(tmp_path / "run").read("series")
    assert series["temperature"] == pytest.approx(2 * series["kinetic"] / (freedom * kB), rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_box_stays_along_its_axes_where_it_keeps_its_angles(kind):
    simulation = held(kind)
    cell = first_state(simulation).state.cells[-1]
    assert cell.orthorhombic == ("full" not in kind)


@pytest.mark.parametrize("kind", some("cell-rescaling full"))
def test_a_run_that_was_stopped_goes_on_to_the_bit(kind, tmp_path, monkeypatch):
    simulation = held(kind, steps=120, save_every=10)
    whole = run(simulation, out=tmp_path / "whole"), RunFolder.open(tmp_path / "whole")
    assert_goes_on(whole, simulation, simulation, "v" if kind == "csvr" else "extra", tmp_path, monkeypatch)


NUMBERS: dict[str, Any] = {"relaxation": 0.1, "pressure_relaxation": 0.3}


@pytest.mark.parametrize(
    "given, word",
    [
        ({"pressure": None}, "pressure"),
        ({"dynamics": {"relaxation": 0.1}}, "pressure_relaxation"),
        ({"dynamics": NUMBERS | {"relaxation": -0.1}}, "dynamics.relaxation"),
        ({"dynamics": NUMBERS | {"box": "half"}}, "dynamics.box"),
        ({"dynamics": NUMBERS | {"chain": 0}}, "dynamics.chain"),
        ({"temperature": 0.0}, "dynamics.temperature"),
        ({"integrator": "mkt"}, "mtk"),
        ({"integrator": "csvr", "dynamics": KINDS["csvr"][1]}, "'pressure'"),
        ({"pbc": (True, True, False)}, "mtk .*c is not periodic"),
        ({"precision": PrecisionPolicy(state="lattice")}, "not mtk"),
    ],
)
def test_what_a_barostat_cannot_have_is_refused_by_name(given, word):
    atoms = fluid()
    given = {"integrator": "mtk", "pressure": 0.01, "temperature": 90.0, "dynamics": NUMBERS} | given
    atoms.pbc = given.pop("pbc", True)
    with pytest.raises(InputError, match=word):
        mdnum.simulation(atoms, ARGON, CUT, timestep=0.004, **given)


class Creeping(Integrator):
    """A box, and atoms that fly freely, stretched by less than a rounding of float32 in each step."""

    name = "creeping"
    stretch: Any = quantity("rate")

    def finish(self, v, extra, at, time):
        return v, extra

    def begin(self, x, v, extra, at):
        return x + self.timestep.astype(x.dtype) * v.astype(x.dtype), v, extra, jnp.zeros(())

    def deform(self, v, extra, at):
        return (1 + self.timestep * self.stretch) * jnp.eye(3), v, extra


@pytest.mark.nightly
def test_atoms_in_single_precision_follow_a_box_that_creeps():
    """On average: a strain below a rounding is lost where positions are rounded before it is added."""
    policy = PrecisionPolicy(state="float32")
    given: dict[str, Any] = {"timestep": 0.004, "seed": 3, "skin": 0.6, "precision": policy}
    simulation = mdnum.simulation(
        fluid(), ARGON, CUT, integrator=Creeping, dynamics={"stretch": 5e-6}, name="creeping", **given
    )
    made, dt = rows(simulation, 100), 0.004 * simulation.units.time_factor
    grown = (1 + 0.004 * 5e-6) ** np.arange(101)
    assert made["box"][-1] == pytest.approx(made["box"][0] * grown[-1], rel=1e-12)
    flown = simulation.velocities * dt * np.sum(grown[-1] / grown[:-1])
    strain = made["x"][-1] - flown - made["x"][0]
    followed = np.sum(strain * made["x"][0]) / np.sum(made["x"][0] ** 2)
    assert followed == pytest.approx(grown[-1] - 1, rel=0.2)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_in_single_precision_it_does_the_same(kind):
    single = held(kind, precision=PrecisionPolicy(state="float32", force="float32"))
    made, expected = rows(single, 60), rows(held(kind), 60)
    assert np.abs(made["x"] - expected["x"]).max() < 1e-4
    assert np.abs(made["box"] - expected["box"]).max() < 1e-5
    assert np.abs(made["heat"] - expected["heat"]).max() < 1e-5
    assert np.abs(made["work"] - expected["work"]).max() < 1e-5
