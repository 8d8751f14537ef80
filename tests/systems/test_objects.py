"""Simulations of objects: as those of a file, with own potentials, and resumed by the same objects."""

from __future__ import annotations

import json
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk
from command_line import call

import mdnum
from mdnum import systems
from mdnum.errors import InputError
from mdnum.md.integrators import Langevin, VelocityVerlet
from mdnum.md.potentials import CutPotential
from mdnum.md.thermostats import CSVR, NoseHooverChain
from mdnum.store import RunFolder
from mdnum.systems import load, toml
from mdnum.systems.describe import by_pair, described, reduction_word

MORSE = {"depth": 0.3429, "alpha": 1.3588, "r0": 2.866}
CODE = """
import jax.numpy as jnp
open(__file__ + ".ran", "a").write("x")

def morse(r, depth, alpha, r0):
    e = jnp.exp(-alpha * (r - r0))
    return depth * (e * e - 2 * e)
"""
FILE = """
units = "metal"
[structure]
builder = "fcc"
symbol = "Cu"
lattice_constant = 3.615
repeat = [5, 5, 5]
[potential]
kind = "python"
function = "mine.py:morse"
parameters = { depth = 0.3429, alpha = 1.3588, r0 = 2.866 }
[cutoff]
kind = "switched"
radius = 6.0
[dynamics]
kind = "nve"
timestep = 0.004
temperature = 900
"""


def morse(r, depth, alpha, r0):
    e = jnp.exp(-alpha * (r - r0))
    return depth * (e * e - 2 * e)


class Own(mdnum.Integrator):
    """One of a user, with a number that may be negative."""

    name = "own"
    wind: jax.Array

    def finish(self, v, extra, at, time):
        return v + time * at.acceleration, extra

    def begin(self, x, v, extra, at):
        return x, v + self.wind, extra, jnp.zeros(())


def same(a, b):
    """Whether columns of tables are equal, also where they are not a number."""
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def copper(potential, **options):
    options = {"timestep": 0.004, "temperature": 900, "seed": 3, "name": "copper", **options}
    atoms = bulk("Cu", "fcc", a=3.615, cubic=True).repeat(5)
    return mdnum.simulation(atoms, potential, mdnum.Cut("switched", 6.0), **options)


def from_objects(made):
    """What a simulation from a file says of itself, handed to the constructor."""
    model, rule, draw = made.model, made.rule, made.draw
    given = {
        "units": made.units.name, "timestep": made.timestep, "temperature": draw.temperature,
        "seed": draw.seed, "remove_drift": draw.remove_drift, "drawn": draw.drawn, "steps": made.steps,
        "save_every": made.save_every, "skin": rule.skin, "rebuild": (rule.every, rule.delay, rule.check),
        "builder": made.builder, "precision": made.policy, "reduction": reduction_word(made.reduction),
        "name": made.name, "about": made.origin.about,
    }  # fmt: skip
    if made.integrator.name == "langevin":
        given["friction"] = made.integrator.number("friction", made.units)
    elif made.integrator.name != "nve":
        own, units = made.integrator, made.units
        numbers = {
            key: own.number(key, units) for key in own.numbers() if key not in ("timestep", "temperature")
        }
        words = {key: getattr(own, key) for key in ("box", "chain") if hasattr(own, key)}
        given |= {"integrator": own.name, "dynamics": numbers | words}
    if not isinstance(model, CutPotential):
        return mdnum.simulation(made.structure, model, **given)
    numbers = {name: by_pair(made, leaf) for name, leaf in model.potential.leaves.items()}
    onset = by_pair(made, model.r_onset) if model.cutoff.switches else None
    cut = mdnum.Cut(model.cutoff.name, by_pair(made, model.r_cut), onset, made.decider.compare)
    return mdnum.simulation(made.structure, type(model.potential)(**numbers), cut, **given)


def leaves(simulation):
    keys = ("model", "cell", "positions", "velocities", "masses", "species", "integrator")
    found = jax.tree.leaves(tuple(getattr(simulation, key) for key in keys))
    return [
        jax.random.key_data(one) if jnp.issubdtype(one.dtype, jax.dtypes.prng_key) else one for one in found
    ]


@pytest.mark.parametrize("name", systems.names("md"))
def test_a_shipped_system_from_objects_is_that_of_its_file(name):
    made = mdnum.build(name)
    again = from_objects(made)
    assert made.file is not None and again.file is None
    assert described(again) == described(made)
    mine, its = leaves(again), leaves(made)
    assert len(mine) == len(its) > 5
    assert all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(mine, its, strict=True))
    assert again.decider == made.decider and again.rule == made.rule and again.policy == made.policy
    assert eqx.tree_equal(again.fixed_point, made.fixed_point) and again.units == made.units


def test_objects_leave_the_tables_and_verdicts_of_a_file_and_no_file_is_made(tmp_path, monkeypatch):
    made = mdnum.build("argon/crystal-108")
    first = mdnum.run(made, steps=60, out=tmp_path / "file", report=False)
    monkeypatch.setattr(toml, "dump", lambda tables: pytest.fail("a system file is made"))
    second = mdnum.run(from_objects(made), steps=60, out=tmp_path / "objects")
    names = {path.name for path in second.folder.iterdir()}
    assert "simulation.json" in names and "system.toml" not in names and "report.html" in names
    a, b = RunFolder.open(first.folder), RunFolder.open(second.folder)
    for table in ("series", "flips"):
        left, right = a.read(table), b.read(table)
        assert len(left["step"]) > 30 and left.keys() == right.keys()
        assert all(same(left[key], right[key]) for key in left)
    assert [one.code for one in second.verdict.findings] == [one.code for one in first.verdict.findings]
    assert second.summary["ase"] == first.summary["ase"]


@pytest.mark.nightly
def test_an_own_morse_has_the_ledger_and_the_verdicts_of_the_one_here(tmp_path):
    runs, forks = [], []
    for name, potential in (("own", mdnum.PairFunction(morse, **MORSE)), ("here", mdnum.Morse(**MORSE))):
        simulation = copper(potential)
        runs.append(mdnum.run(simulation, steps=80, out=tmp_path / name, report=False))
        forks.append(
            mdnum.fork(simulation, "precision", steps=80, out=tmp_path / f"{name}-fork", report=False)
        )
    ledgers = [RunFolder.open(one.folder).read("flips", ["step", "i", "j", "entered"]) for one in runs]
    assert len(ledgers[0]["step"]) > 20
    assert all(np.array_equal(ledgers[0][key], ledgers[1][key]) for key in ledgers[0])
    codes = [[one.code for one in run.verdict.findings if one.code != "NOT_ASE"] for run in runs]
    assert codes[0] == codes[1]
    (judged,) = [one for one in runs[0].verdict.findings if one.code == "NOT_ASE"]
    assert "itself" in judged.text
    assert runs[0].summary["ase"]["ok"] and runs[0].summary["ase"]["energy_rel"] < 1e-14
    assert runs[0].summary["energy_budget_closes"]
    assert forks[0].summary["effect"] == forks[1].summary["effect"]
    assert forks[0].summary["fork"] == forks[1].summary["fork"]
    text = json.loads((runs[0].folder / "simulation.json").read_text())
    # as it was written: it can be executed again
    again: dict[str, Any] = {"jnp": jnp}
    exec(text["potential"]["code"]["source"], again)
    assert again["morse"](2.0, 0.3, 1.4, 2.5) == morse(2.0, 0.3, 1.4, 2.5)


def test_an_own_function_is_differentiated_by_its_parameters_and_the_cutoff():
    from mdnum.gradients.losses import MeanPotential

    def of_square(r2, depth, alpha, r0):
        return morse(jnp.sqrt(r2), depth, alpha, r0)

    names = ("potential.depth", "potential.alpha", "potential.r0", "cutoff.radius")
    problem = mdnum.Problem(copper(mdnum.PairFunction(of_square, **MORSE)), MeanPotential(), 20)
    found = mdnum.method("event-aware")(problem, names).gradient
    unrolled = mdnum.method("unrolled")(problem, names[:3]).gradient
    for name in names:
        value = {"cutoff.radius": 6.0}.get(name, MORSE.get(name.rpartition(".")[2]))
        h = 1e-5 * value
        ends = [problem.value({name: value + sign * h}) for sign in (1, -1)]
        assert float(found[name]) == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=2e-5)
        if name in unrolled:
            assert float(unrolled[name]) == pytest.approx(float(found[name]), rel=1e-8)


def test_a_run_of_objects_is_resumed_by_the_same_objects_alone(tmp_path):
    own = mdnum.PairFunction(morse, **MORSE)
    whole = mdnum.run(copper(own), steps=40, out=tmp_path / "whole", report=False, check=False)
    part = mdnum.run(copper(own), steps=20, out=tmp_path / "part", report=False, check=False)
    with pytest.raises(InputError, match=r"part: .*objects"):
        mdnum.run(None, resume=part.folder, steps=40)
    other = copper(mdnum.PairFunction(morse, **{**MORSE, "alpha": 1.36}))
    with pytest.raises(InputError, match=r"potential\.alpha was 1\.3588 and is 1\.36"):
        mdnum.run(other, resume=part.folder, steps=40)
    with pytest.raises(InputError, match=r"potential\.code"):
        same_name = eqx.tree_at(lambda one: one, own, mdnum.PairFunction(_another(), **MORSE))
        mdnum.run(copper(same_name), resume=part.folder, steps=40)
    mdnum.run(copper(own), resume=part.folder, steps=40, report=False, check=False)
    a, b = (RunFolder.open(one.folder).read("series") for one in (whole, part))
    assert all(same(a[key], b[key]) for key in a)


def _another():
    def morse(r, depth, alpha, r0):
        return depth * jnp.exp(-alpha * (r - r0))

    return morse


def test_a_changed_simulation_is_no_longer_that_of_its_file(tmp_path):
    made = mdnum.build("argon/crystal-108")
    switched = made.with_cutoff("quintic")
    assert made.file is not None and switched.file is None
    run = mdnum.run(switched, steps=10, out=tmp_path / "run", report=False)
    assert json.loads((run.folder / "simulation.json").read_text())["cutoff"]["kind"] == "quintic"
    fork = mdnum.fork(switched, "skin", steps=20, out=tmp_path / "fork", report=False)
    assert fork.summary["changes"] == {
        "neighbors.skin": [made.rule.skin, pytest.approx(1.5 * made.rule.skin)]
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"potential": lambda: mdnum.PairFunction(lambda x: x)}, r"'x'.*r, the"),
        ({"potential": lambda: mdnum.PairFunction(morse, depth=1.0)}, r"alpha.*depth, alpha, r0"),
        ({"cutoff": None}, r"cutoff=mdnum\.Cut"),
        ({"cutoff": mdnum.Cut("switched", {"Ni-Ni": 4.0})}, r"cutoff\.radius: .*Cu-Cu"),
        ({"cutoff": mdnum.Cut("switched", 9.5)}, r"9\.03"),
        ({"timestep": None}, "timestep"),
    ],
)
def test_what_does_not_fit_together_is_one_line(change, message):
    given = {
        "potential": lambda: mdnum.Morse(**MORSE),
        "cutoff": mdnum.Cut("switched", 6.0),
        "timestep": 0.002,
    }
    given |= change
    atoms = bulk("Cu", "fcc", a=3.615, cubic=True).repeat(5)
    with pytest.raises(InputError, match=message):
        mdnum.simulation(atoms, given["potential"](), given["cutoff"], timestep=given["timestep"])


def object_of(kind, timestep=0.2, **numbers):
    """An integrator object with plain numbers, in internal units."""
    numbers = {"timestep": timestep} | numbers
    numbers = {key: jnp.float64(one) if isinstance(one, float) else one for key, one in numbers.items()}
    # annotations that are checked allow no array in the place of a number when an object is made
    arrays = {key: numbers[key] for key in numbers if np.ndim(numbers[key])}
    numbers |= dict.fromkeys(arrays, jnp.float64(1.0))
    made = kind(**numbers, **({"key": jax.random.key(0)} if kind in (Langevin, CSVR) else {}))
    return eqx.tree_at(lambda one: [getattr(one, key) for key in arrays], made, list(arrays.values()))


@pytest.mark.parametrize(
    ("kind", "numbers", "message"),
    [
        (VelocityVerlet, {"timestep": -0.2}, r"timestep: .*-0\.00203\d* ps.*above 0"),
        (VelocityVerlet, {"timestep": np.nan}, r"timestep: .*nan.*finite"),
        (VelocityVerlet, {"timestep": jnp.float32(0.2)}, r"timestep: .*0\.2.*float64"),
        (Langevin, {"friction": -1.0, "kT": 0.01}, r"friction = -98\.2.*above 0"),
        (NoseHooverChain, {"kT": 0.0, "relaxation": 1.0}, r"temperature = 0.0.*above 0"),
        (NoseHooverChain, {"kT": jnp.ones(2), "relaxation": 1.0}, r"temperature: .*1\., 1.*finite number"),
        (NoseHooverChain, {"kT": 0.01, "relaxation": 1.0, "chain": 0}, r"chain = 0.*at least 1"),
        (CSVR, {"kT": 0.01, "relaxation": -1.0}, r"relaxation = -0\.0101.*above 0"),
        (Own, {"timestep": 0.0, "wind": 3.0}, r"timestep: .* 0 ps.*above 0"),
        (Own, {"wind": np.inf}, r"wind: .*inf.*finite"),
        (Own, {"wind": -3.0}, None),
        (CSVR, {"kT": 0.01, "relaxation": 1.0}, None),
    ],
)
def test_the_numbers_of_an_integrator_object_are_checked_as_those_of_a_file(kind, numbers, message):
    atoms = bulk("Cu", "fcc", a=3.615, cubic=True).repeat(5)
    given = (atoms, mdnum.Morse(**MORSE), mdnum.Cut("switched", 6.0))
    made = object_of(kind, **numbers)
    if message is None:
        assert isinstance(mdnum.simulation(*given, integrator=made).integrator, kind)
        with pytest.raises(InputError, match="pressure, timestep"):
            mdnum.simulation(*given, integrator=made, timestep=0.002, pressure=1.0)
    else:
        with pytest.raises(InputError, match=rf"dynamics\.{message}"):
            mdnum.simulation(*given, integrator=made)


def test_a_potential_of_many_bodies_follows_the_periodicity_of_the_atoms_and_the_precision():
    slab = bulk("Si", "diamond", a=5.43, cubic=True).repeat(3)
    slab.center(vacuum=6.0, axis=2)
    slab.pbc = (True, True, False)
    potential = mdnum.build("silicon/stillinger-weber-512").model
    made = mdnum.simulation(slab, potential, timestep=0.001)
    assert potential.pbc == (True, True, True) and made.model.pbc == made.pbc == (True, True, False)
    narrow = mdnum.PrecisionPolicy(force="float32")
    single = mdnum.simulation(slab, potential, timestep=0.001, precision=narrow)
    assert (made.force.dtype, single.force.dtype) == (np.float64, np.float32)


def test_code_that_a_file_names_is_executed_where_that_was_allowed_and_nowhere_else(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(CODE)
    path, ran = tmp_path / "my.toml", tmp_path / "mine.py.ran"
    path.write_text(FILE)
    loaded = load(path)
    assert loaded.program["potential"]["code"] and loaded.to_toml()
    for ask in (
        lambda: mdnum.run(path, steps=5, out=tmp_path / "run"),
        lambda: mdnum.fork(path, "precision", steps=5, out=tmp_path / "fork"),
        lambda: mdnum.build(path),
    ):
        with pytest.raises(InputError, match=r"potential\.function: .*mine\.py:morse.*--allow-code"):
            ask()
    assert not ran.exists() and not (tmp_path / "run").exists()
    done = mdnum.run(path, steps=5, out=tmp_path / "run", check=False, allow_code=True)
    assert ran.exists() and (done.folder / "mine.py").read_text() == CODE
    copied = done.folder / "mine.py.ran"
    from mdnum.verbs import frame

    frame.finish(done.folder)
    with pytest.raises(InputError, match=r"run/mine\.py:morse"):
        mdnum.run(None, resume=done.folder, steps=8)
    assert not copied.exists()
    again = mdnum.run(None, resume=done.folder, steps=8, check=False, allow_code=True, report=False)
    assert copied.exists() and again.summary["steps"] == 8
    # what was stored is compared without it, and followed again with it
    copied.unlink()
    same = mdnum.fork_folders(done.folder, done.folder, out=tmp_path / "same", report=False)
    assert not copied.exists() and same.summary["fork"] is None and same.summary["atoms"] == 500
    with pytest.raises(InputError, match=r"run/mine\.py:morse"):
        mdnum.fork_folders(done.folder, done.folder, replay=True, repeats=0, out=tmp_path / "replay")
    with pytest.raises(InputError, match=r"mine\.py:morse.*--allow-code"):
        mdnum.check("energy", path)
    assert not copied.exists()
    assert mdnum.check("energy", path, allow_code=True).report.ok
    for command in (("check", "energy"), ("fork", "compare")):
        assert call(*command, "--help") == 0 and "--allow-code" in capsys.readouterr().out
    with mdnum.allow_code():
        assert mdnum.build(path).potential.name == "morse"
    sys.modules.pop("mdnum_code_mine", None)
