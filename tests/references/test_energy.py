"""`mdnum check energy` and `dynamics`: agreement to rounding, and planted faults that they must find."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from functools import partial
from itertools import product
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

import mdnum
from mdnum.md.energies import EnergyFunction
from mdnum.md.jaxmd import displacement
from mdnum.md.pairforce import ManyBodyForce
from mdnum.plain import plain
from mdnum.references import energy_check
from mdnum.references.adapted import evaluate
from mdnum.references.ase_models import ENERGY, independent, reference
from mdnum.references.energy_check import _growth, _sudden, check_dynamics, check_energy, neighborhoods
from mdnum.report.words import number
from mdnum.systems import build
from mdnum.systems.simulation import Simulation
from mdnum.verbs.check import dynamics_findings, energy_findings

HARD = {"kind": "hard", "radius": 2.5}
SHORT = {"kind": "hard", "radius": 2.2}
STEPS = 40
MORSE = {"kind": "morse", "depth": 1.3, "alpha": 5.0, "r0": 1.1}
SOFT = {"kind": "soft-sphere", "sigma": 2.6, "epsilon": 2.0, "alpha": 2.5}


def codes(report) -> list[tuple[str, str]]:
    findings = energy_findings(report) if hasattr(report, "frames") else dynamics_findings(report)
    return [(finding.code, finding.severity) for finding in findings]


MIXED = mixture(), make(mixture(), KOB_ANDERSEN, {"kind": "hard", "in_sigma": 2.2})
SINGLE = {"state": "float32", "force": "float32", "decision": "float32", "accumulate": "float32"}


FAST = [(LENNARD_JONES, "hard"), (LENNARD_JONES, "switched"), (MORSE, "quintic"), (SOFT, "cosine")]
CUTOFFS = ("hard", "shifted", "force-shifted", "switched", "quintic", "cosine")
REST = [one for one in product((LENNARD_JONES, MORSE, SOFT), CUTOFFS) if one not in FAST]


@pytest.mark.parametrize(
    ("potential", "cutoff"), [*FAST, *(pytest.param(*one, marks=pytest.mark.nightly) for one in REST)]
)
def test_pair_potentials_meet_the_reference(potential: dict, cutoff: str):
    atoms = crystal()
    report = check_energy(make(atoms, potential, {"kind": cutoff, "radius": 2.5}), {"initial": atoms})
    (frame,) = report.frames
    assert report.ok and report.worst["ok"]
    # measured 1e-16 to 2e-14; the promise is 1e-12 and 1e-10
    assert frame.energy_rel <= 1e-14 and frame.force_rel <= 1e-13 and frame.stress_rel <= 1e-13
    assert codes(report) == ([] if report.is_ase else [("NOT_ASE", "info")])
    json.dumps(plain(report))


def rattled(symbol: str, lattice: str, edge: float, repeat: int):
    atoms = bulk(symbol, lattice, a=edge, cubic=True) * ((repeat,) * 3)
    atoms.rattle(0.1, seed=1)
    return atoms


SILICON, COPPER = rattled("Si", "diamond", 5.43, 2), rattled("Cu", "fcc", 3.615, 4)


@pytest.mark.slow
@pytest.mark.jax_md
@pytest.mark.parametrize(
    ("atoms", "table", "reference"),
    [
        (COPPER, {"kind": "eam", "file": "cu.eam.alloy"}, "ASE EAM"),
        (SILICON, {"kind": "tersoff"}, "ASE Tersoff"),
        pytest.param(SILICON, {"kind": "stillinger-weber"}, "numpy", marks=pytest.mark.nightly),
    ],
)
def test_many_body_potentials_meet_the_reference(atoms, table: dict, reference: str):
    system = replace(
        make(atoms, table, units="metal"), path=Path(__file__).parents[2] / "systems" / "copper" / "x.toml"
    )
    report = check_energy(system, {"initial": atoms})
    assert report.ok and reference in report.reference
    assert report.frames[0].energy_rel <= 1e-12 and report.frames[0].force_rel <= 1e-11


def test_default_frames_are_the_first_and_a_later_one():
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 1.0, "seed": 3, "steps": STEPS}
    report = check_energy(make(crystal(rattle=0.0), LENNARD_JONES, SHORT, dynamics=dynamics))
    assert [frame.frame for frame in report.frames] == ["initial", f"step {STEPS}"]
    assert report.ok
    # a perfect crystal has no forces, hence a scale along pairs
    first, later = report.frames
    assert first.force_scale > 1.0 and first.energy != later.energy
    assert len(report.rows()) == 2


def test_free_atoms_have_no_stress():
    atoms = crystal(2)
    atoms.pbc = False
    (frame,) = check_energy(make(atoms, LENNARD_JONES, HARD), [atoms]).frames
    assert frame.ok and frame.stress_max is None and frame.frame == "frame 0"


@pytest.mark.parametrize(
    ("precision", "name", "energy", "force", "most"),
    [
        (SINGLE, "float32", (1e-9, 1e-5), 0.01, 5.0),
        pytest.param({"force": "float32"}, "float32", (1e-9, 1e-5), 0.01, 5.0, marks=pytest.mark.nightly),
        # rounded terms at places that are not
        ({"force": "bfloat16"}, "bfloat16", (1e-5, 1e-2), 0.05, 2.0),
    ],
)
def test_narrow_numbers_are_compared_in_units_of_their_rounding(
    precision: dict, name: str, energy, force, most
):
    atoms = crystal()
    report = check_energy(make(atoms, LENNARD_JONES, HARD, precision=precision), {"initial": atoms})
    (frame,) = report.frames
    assert report.ok and report.precision == name and frame.ambiguous == 0
    assert energy[0] < frame.energy_rel < energy[1]  # not float64 in disguise
    assert force < frame.force_roundings < most and frame.energy_roundings < most
    assert codes(report) == [("NARROW_PRECISION", "info")]


def faulty(simulation, **change):
    """A simulation whose results are changed on the way out."""

    class Faulty(Simulation):
        def evaluate(self, *asked):
            right = super().evaluate(*asked)
            return replace(right, **{name: alter(getattr(right, name)) for name, alter in change.items()})

    return Faulty(**{one.name: getattr(simulation, one.name) for one in fields(simulation)})


def _nudged(forces: np.ndarray) -> np.ndarray:
    forces = forces.copy()
    forces[7, 1] += 1e-8
    return forces


@pytest.mark.parametrize(
    "fault",
    [
        {"energy": lambda energy: energy * (1 + 1e-11)},
        {"forces": _nudged},
        {"stress": lambda stress: stress + 1e-8 * np.eye(3)},
        {"energy": lambda energy: float("nan")},
    ],
    ids=["energy", "force", "stress", "nan"],
)
def test_planted_faults_are_found(fault: dict):
    atoms = crystal()
    report = check_energy(faulty(build(make(atoms, LENNARD_JONES, HARD)), **fault), {"initial": atoms})
    assert not report.ok
    assert codes(report) == [("ASE_DISAGREES", "error")]


def test_wrong_constants_are_found_and_the_third_opinion_names_the_culprit():
    """ASE with another sigma: mdnum agrees with numpy, so it is not mdnum that is off."""
    atoms = crystal()
    system = make(atoms, LENNARD_JONES, HARD)
    other = reference(make(atoms, {**LENNARD_JONES, "sigma": 1.0 + 1e-7}, HARD))
    report = check_energy(system, {"initial": atoms}, judge=other)
    assert not report.ok
    assert report.frames[0].energy_rel > 1e-8 and report.frames[0].energy_third < 1e-14
    assert next(energy_findings(report)).values["energy_third"] < 1e-14


def test_a_pair_at_the_cutoff_is_named_as_the_reason():
    """ASE keeps a pair at r == r_cut, "r2 <" does not: the force differs, and the report says why."""
    atoms = crystal()[:2]
    atoms.positions = [[0.0, 0, 0], [2.5, 0, 0]]
    report = check_energy(make(atoms, LENNARD_JONES, HARD), {"initial": atoms})
    assert report.frames[0].force_max > 0.01 and not report.ok
    assert report.frames[0].ambiguous == 1
    assert next(energy_findings(report)).values["ambiguous"] == 1
    same = check_energy(make(atoms, LENNARD_JONES, {**HARD, "compare": "r2 <="}), {"initial": atoms})
    assert same.ok and same.frames[0].energy != 0.0


@pytest.mark.parametrize("judge", [reference, independent])
def test_a_hot_crystal_follows_ase(judge):
    system = make(crystal(), LENNARD_JONES, SHORT)
    report = check_dynamics(system, steps=STEPS, judge=judge(system))
    assert report.ok and len(report.position) == STEPS + 1
    assert report.position[-1] <= 1e-12 and report.velocity[-1] <= 1e-11  # measured 4e-15 and 4e-14
    assert report.is_ase == (judge is reference)
    assert codes(report) == ([] if report.is_ase else [("NOT_ASE", "info")])
    json.dumps(plain(report))
    assert report.rows()[-1]["step"] == STEPS


def test_langevin_is_checked_without_its_bath():
    bath = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 1.0, "seed": 3}
    assert check_dynamics(make(crystal(), LENNARD_JONES, SHORT, dynamics=bath), steps=STEPS).ok


def test_an_agreement_says_from_where_on_there_would_be_none():
    checked = mdnum.check("energy", make(crystal(), LENNARD_JONES, SHORT))
    worst = max(checked.report.frames, key=lambda frame: frame.force_max)
    assert checked.report.ok and number(1e-10 * worst.force_scale, 1) in checked.verdict.text


@pytest.mark.parametrize(("kind", "converted"), [("hard", True), ("shifted", False)])
def test_a_conversion_of_the_results_of_ase_is_stated(kind, converted):
    checked = mdnum.check("energy", make(crystal(), LENNARD_JONES, SHORT | {"kind": kind}))
    assert checked.report.ok and (checked.report.conversion in checked.verdict.text) is converted


def test_float32_trajectories_are_measured_as_such():
    report = check_dynamics(make(crystal(), LENNARD_JONES, SHORT, precision=SINGLE), steps=STEPS)
    assert report.ok and report.precision == "float32"
    assert 1e-8 < report.position[-1] < 1e-4


@pytest.mark.parametrize("change", [{"epsilon": 1.0 + 1e-5}, {"sigma": 1.0 + 1e-6}])
def test_wrong_forces_show(change: dict):
    judge = reference(make(crystal(), {**LENNARD_JONES, **change}, SHORT))
    report = check_dynamics(make(crystal(), LENNARD_JONES, SHORT), steps=STEPS, judge=judge)
    assert not report.ok and report.sudden is None
    assert codes(report) == [("DYNAMICS_DIFFER", "error")]


def test_growth_and_sudden_steps():
    chaotic = [1e-16 * np.exp(0.05 * step) for step in range(100)]
    assert _growth(chaotic) == pytest.approx(np.exp(0.05))
    assert _sudden(chaotic, floor=1e-13) is None
    forked = [*chaotic[:50], *(1e-7 * np.exp(0.05 * step) for step in range(50))]
    assert _sudden(forked, floor=1e-13) == 50


@pytest.mark.parametrize("kind", ["crystal", "mixture"])
def test_a_group_with_its_neighbors_has_the_numbers_of_the_whole(kind: str):
    # a group at a corner sees its neighbors through the faces of the box
    atoms, system = (crystal(), make(crystal(), LENNARD_JONES, SHORT)) if kind == "crystal" else MIXED
    whole = reference(system).make()
    forces, energies = (whole.get_property(name, atoms) for name in ("forces", "energies"))
    groups = list(neighborhoods(atoms, build(system).r_cut, places=5, count=9))
    # so many groups, each about another atom, and of no more atoms than it takes
    assert len(groups) == 5 == len({int(chosen[0]) for _, chosen in groups})
    for cluster, chosen in groups:
        assert len(set(chosen.tolist())) == 9 < len(cluster)
        seen = reference(system).make()
        np.testing.assert_allclose(seen.get_property("forces", cluster)[:9], forces[chosen], atol=1e-12)
        np.testing.assert_allclose(seen.get_property("energies", cluster)[:9], energies[chosen], atol=1e-12)


def test_a_sample_is_compared_at_other_places_in_each_frame(monkeypatch):
    """Without a stress, which nobody compares; and what is wrong everywhere is found in any sample."""
    atoms, system = MIXED
    monkeypatch.setattr(energy_check, "SAMPLED", 10)
    monkeypatch.setattr(energy_check, "neighborhoods", partial(neighborhoods, places=2, count=9))
    asked = []

    def evaluate(self, positions, cell, stress):
        asked.append(stress)
        return evaluated(self, positions, cell, stress)

    evaluated = Simulation.evaluate
    with monkeypatch.context() as patched:
        patched.setattr(Simulation, "evaluate", evaluate)
        report = check_energy(build(system), {"first": atoms, "last": atoms})
    assert "sum over species" in report.reference
    assert report.ok and asked == [False, False] and len(report.frames) == 4
    assert len({frame.frame.split()[-1] for frame in report.frames}) == 4
    # of two groups of nine in one frame there are eighteen at most
    assert report.sampled is not None and 18 < report.sampled <= 36
    off = faulty(build(system), energies=lambda energies: energies * (1 + 1e-9))
    assert not check_energy(off, {"initial": atoms}).ok


def own_energy(parameters, positions, neighbor, cell):
    """A Lennard-Jones energy that somebody wrote over a list of jax-md, of either format."""
    toward = jnp.vectorize(displacement(cell, (True, True, True)), signature="(k),(k)->(k)")
    n = positions.shape[0]
    if neighbor.format.name == "Dense":
        here, other = jnp.arange(n)[:, None], neighbor.idx
    else:
        here, other = neighbor.idx
    real = other < n
    d = toward(positions[jnp.where(real, here, 0)], positions[jnp.where(real, other, 1)])
    r2 = jnp.where(real, jnp.sum(d * d, axis=-1), 1.0)
    s6 = (parameters["size"] ** 2 / r2) ** 3
    inside = real & (r2 < 2.0**2)
    return 0.5 * jnp.sum(jnp.where(inside, 4 * parameters["depth"] * (s6 * s6 - s6), 0.0))


@pytest.mark.parametrize("form", ["dense", pytest.param("sparse", marks=pytest.mark.nightly)])
def test_an_energy_function_is_compared_on_ase_s_list(form: str, monkeypatch):
    constants = {"size": jnp.asarray(1.0), "depth": jnp.asarray(1.0)}
    function = EnergyFunction(constants, own_energy, 2.0, format=form, name="mine")
    pair = {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0}
    same = build(make(crystal(), pair, {"kind": "hard", "radius": 2.0}))
    simulation = mdnum.simulation(same.structure, function, units="lj", timestep=0.002, skin=0.3)
    report = check_energy(simulation)
    assert report.ok and not report.is_ase and report.reference == ENERGY
    assert max(frame.stress_max for frame in report.frames) < 1e-12
    assert codes(report) == [("NOT_ASE", "info")]
    # the judge is right, too
    energy, forces = (evaluate(reference(one).make(), same.structure) for one in (simulation, same))
    np.testing.assert_allclose(energy["forces"], forces["forces"], atol=1e-11)
    np.testing.assert_allclose(energy["stress"], forces["stress"], atol=1e-11)
    # a list without some of its pairs
    listed = ManyBodyForce.neighbors

    def short(self, positions, tables, bits):
        return listed(self, positions, tables, bits & jnp.uint8(0xFE))

    monkeypatch.setattr(ManyBodyForce, "neighbors", short)
    jax.clear_caches()
    assert not check_energy(simulation, {"first": simulation.structure}).ok
    jax.clear_caches()


def weak(r, strength):
    """Not what any name says."""
    return strength * jnp.exp(-r)


class Other(mdnum.PairPotential):
    """Called like one of mdnum's own, and another."""

    name = "lennard-jones"
    sigma: Any
    epsilon: Any

    def evaluate(self, r2):
        return self.epsilon / r2, -self.epsilon / (r2 * r2)


@pytest.mark.parametrize("name", ["morse", "tersoff", "eam", "stillinger-weber", "class", "energy"])
def test_a_potential_is_judged_by_what_it_is_and_not_by_its_name(name: str):
    function = FunctionType(weak.__code__, globals(), name)
    made: Any = mdnum.PairFunction(function, strength=0.3)
    made = Other(sigma=1.0, epsilon=0.3) if name == "class" else made
    if name == "energy":
        constants = {"size": jnp.asarray(1.0), "depth": jnp.asarray(1.0)}
        made = EnergyFunction(constants, own_energy, 2.0, name="tersoff")
    cut = None if name == "energy" else mdnum.Cut("shifted", 2.0)
    simulation = mdnum.simulation(crystal(), made, cut, units="lj", timestep=0.002, skin=0.3)
    report = check_energy(simulation, {"first": simulation.structure})
    assert report.ok and not report.is_ase


@pytest.mark.parametrize(
    ("name", "key"), [("tersoff", "A"), ("tersoff", "R"), ("stillinger-weber", "strength")]
)
def test_other_constants_of_many_bodies_are_the_judge_s_too(name: str, key: str):
    shipped = build(f"silicon/{name}-512", {"structure.repeat": [2, 2, 2]})
    path = f"potential.{key}"
    changed = mdnum.changed(shipped, {path: float(mdnum.parameters(shipped)[path].value) * 1.02})
    report = check_energy(changed, {"first": rattled("Si", "diamond", 5.431, 2)})
    assert report.ok and report.is_ase == (name == "tersoff")
