"""A package outside mdnum adds an integrator with a state of its own: a Nosé-Hoover chain of one link."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import nose_hoover
import numpy as np
import pytest
from gradient_problems import everything
from nose_hoover import NoseHoover, PerAtom
from other_package import install
from rollout.harness import go, liquid, run, write_system
from rollout.test_resume import CHILD, assert_goes_on, assert_same
from small_systems import LENNARD_JONES, crystal, make

import mdnum
from mdnum.errors import InputError
from mdnum.gradients import Problem, method, parameters
from mdnum.gradients.diagnose.growth import spectrum
from mdnum.md.integrators import KickDrift, VelocityVerlet, quantity
from mdnum.rollout.engine import Engine, first_state
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

QUINTIC = {"kind": "quintic", "radius": 2.0}
CHAIN = {"dynamics.kind": "one-link", "dynamics.temperature": 1.0, "dynamics.relaxation": 0.3}


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on the search path with the package in it."""
    source = Path(nose_hoover.__file__).read_text(encoding="utf-8")
    points = {"mdnum.integrators": {"one-link": "strange_steps:NoseHoover", "broken": "strange_steps:Link"}}
    folder = install(tmp_path / "site", "strange-steps", {"strange_steps": source}, points)
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("strange_steps", None)


def held(kind: type = NoseHoover, timestep: float = 0.004, cutoff=QUINTIC, **tables: Any) -> Simulation:
    """A crystal of 108 atoms with an integrator from objects."""
    dynamics = {"kind": "nve", "timestep": timestep, "temperature": 1.0, "seed": 3}
    simulation = build(make(crystal(), LENNARD_JONES, cutoff, dynamics=dynamics, **tables))
    own = kind(jnp.float64(timestep), jnp.float64(1.0), jnp.float64(0.3))
    return replace(simulation, integrator=own)


def columns(simulation: Simulation, steps: int) -> dict[str, np.ndarray]:
    """Numbers of each step."""
    rows = []
    for segment in Engine(simulation, steps).segments():
        rows.append({name: segment.rows_of(name).copy() for name in ("potential", "kinetic", "heat")})
    whole = {name: np.concatenate([one[name] for one in rows]) for name in rows[0]}
    return whole | {"total": whole["potential"] + whole["kinetic"]}


def test_what_it_conserves_is_bounded_and_of_second_order():
    errors = []
    for timestep in (0.008, 0.004):
        made = columns(held(timestep=timestep), round(4 / timestep))
        conserved = made["total"] - made["heat"]
        errors.append(np.abs(conserved - conserved[0]).max())
        assert np.ptp(made["total"]) > 100 * errors[-1]
        half = len(conserved) // 2
        assert abs(conserved[half:].mean() - conserved[:half].mean()) < errors[-1]
        assert 2 * made["kinetic"][half:].mean() / (3 * 108 - 3) == pytest.approx(1, abs=0.06)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)


def test_the_thermostat_of_the_documents_is_the_same():
    text = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    (source,) = (part.partition("```")[0] for part in text.split("```python") if "class Thermostat" in part)
    known: dict[str, Any] = {}
    exec(source, known)
    ours, theirs = (columns(held(kind), 100) for kind in (NoseHoover, known["Thermostat"]))
    for name in ours:
        assert np.abs(ours[name] - theirs[name]).max() < 1e-9, name


def test_a_state_of_each_atom_is_sorted_with_the_atoms():
    """Against a loop in numpy, over several lists, each in another order."""
    simulation, steps = held(PerAtom, neighbors={"skin": 0.1}), 60
    *_, segment = Engine(simulation, steps - 1).segments()
    assert segment.epoch >= 3 and not np.array_equal(segment.table.order, np.arange(108))
    dt, kT, tau = 0.004, 1.0, 0.3
    x, v = simulation.positions.copy(), simulation.velocities.copy()
    friction = v**2 / kT / tau

    def rub(time):
        nonlocal v, friction
        friction = friction + 0.5 * time * (v**2 - kT) / (kT * tau**2)
        v = v * np.exp(-friction * time)
        friction = friction + 0.5 * time * (v**2 - kT) / (kT * tau**2)

    for step in range(steps):
        force = simulation.evaluate(x, stress=False).forces
        if step:
            v = v + dt / 2 * force
            rub(dt / 2)
        rub(dt / 2)
        v = v + dt / 2 * force
        x = x + dt * v
    state = segment.state
    away = np.asarray(state.x).T + np.asarray(state.images).T @ np.asarray(simulation.cell.matrix) - x
    assert np.abs(away).max() < 1e-10
    assert np.abs(np.asarray(state.extra.friction.value).T - friction).max() < 1e-10
    assert int(state.extra.calls) == 2 * steps


def test_from_a_file_it_is_that_from_objects(site):
    """In units whose time is not that inside mdnum: the bits of both are the same."""
    atoms, argon = crystal(lattice_constant=5.4), {"kind": "lennard-jones", "sigma": 3.4, "epsilon": 0.0104}
    dynamics = {"timestep": 0.002, "temperature": 40.0, "seed": 3}
    made, plain = (
        build(make(atoms, argon, {"kind": "hard", "radius": 7.0}, "metal", dynamics={**dynamics, **kind}))
        for kind in ({"kind": "one-link", "relaxation": 0.2}, {"kind": "nve"})
    )
    units = made.units
    own = NoseHoover(
        plain.integrator.timestep,
        jnp.float64(units.k_B * 40.0),
        jnp.float64(0.2 * units.time_factor),
    )
    ours, theirs = (columns(one, 100) for one in (replace(plain, integrator=own), made))
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert parameters.names(made).count("dynamics.relaxation") == 1
    assert parameters.unit(made, "dynamics.relaxation") == "ps"
    assert float(parameters.value(made, "dynamics.relaxation")) == pytest.approx(0.2, rel=1e-14)
    other = parameters.with_values(made, {"dynamics.temperature": 80.0})
    kT = [one.integrator.number("temperature", units) for one in (made, other)]
    assert kT == pytest.approx([40.0, 80.0], rel=1e-14)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dynamics.relaxation": None}, "relaxation are missing"),
        ({"dynamics.temperature": None}, "temperature are missing"),
        ({"dynamics.friction": 1.0}, "unknown key friction"),
        ({"dynamics.kind": "nose-hover"}, "unknown dynamics kind 'nose-hover'"),
        ({"dynamics.kind": "broken"}, "package strange-steps"),
    ],
)
def test_a_file_that_does_not_fit_it_is_refused(site, tmp_path, changes, message):
    asked = {"kind": "one-link", "timestep": 0.004, "temperature": 1.0, "relaxation": 0.3}
    asked |= {key.partition(".")[2]: value for key, value in changes.items()}
    lines = [f"{key} = {value!r}" for key, value in asked.items() if value is not None]
    path = write_system(tmp_path / "system", liquid())
    head = path.read_text(encoding="utf-8").partition("[dynamics]")[0]
    path.write_text("\n".join([head, "[dynamics]", *lines]), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        build(load(path))
    assert message in str(caught.value)


def test_a_run_that_was_stopped_goes_on_with_its_state(site, tmp_path, monkeypatch):
    """To the bit; a state that is begun anew is another run."""
    system = load(write_system(tmp_path / "system", liquid()), CHAIN)
    whole = go(tmp_path / "whole", system, 120, save_every=10)
    assert whole[0].summary["dynamics"] == "one-link"
    series = whole[1].read("series")
    conserved, total = (np.asarray(series[name]) for name in ("conserved", "total"))
    jumps = np.cumsum(np.asarray(series["energy_jump"]))
    assert np.ptp(total - jumps) > 20 * np.ptp(conserved - jumps)
    assert_goes_on(whole, system, None, "extra", tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_with_its_state(site, tmp_path):
    path = write_system(tmp_path / "system", liquid(), dynamics={"kind": "one-link", "relaxation": 0.3})
    whole = go(tmp_path / "whole", load(path), 120, save_every=10)
    code = CHILD.format(stop=60, path=str(path), out=str(tmp_path / "run"), steps=120)
    here = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{Path(__file__).with_name('support')}"}
    killed = subprocess.run([sys.executable, "-c", code], env=here, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert_same(whole, (run(None, resume=tmp_path / "run"), RunFolder.open(tmp_path / "run")))


def test_it_is_forked_with_a_counterfactual(site, tmp_path):
    """A's decisions, imposed on A's own arithmetic, change no bit; single precision diverges."""
    system = load(write_system(tmp_path / "system", liquid()), CHAIN)
    made = mdnum.fork(system, "precision", steps=400, repeats=0, report=False, out=tmp_path / "fork")
    assert made.summary["first_bit"] is not None
    assert "one-link is another" in made.summary["lyapunov_reason"]
    from mdnum.rollout.program import MdProgram

    program = MdProgram(build(system))
    for rows in program.lockstep(program, 100, forward=True, back=False, guard=None):
        assert not np.any(rows.separation["B"]) and not np.any(rows.separation["B|A"])


NAMES = ("potential.sigma", "dynamics.timestep", "dynamics.temperature", "dynamics.relaxation", "box.scale")


@pytest.mark.parametrize("kind", [NoseHoover, pytest.param(PerAtom, marks=pytest.mark.nightly)])
def test_its_state_is_differentiated_through(kind):
    """Against central differences of the run; what the state is begun with counts too."""
    problem = Problem(held(kind, timestep=0.01), everything(108), 40)
    starts = ("initial.velocities", "initial.positions")
    made, other = (method(word)(problem, (*NAMES, *starts)) for word in ("symmetric", "unrolled"))
    for name in (*NAMES, *starts):
        size = np.abs(made.gradient[name]).max()
        assert np.abs(made.gradient[name] - other.gradient[name]).max() < 1e-9 * size, name
    for name in NAMES:
        value = float(parameters.value(problem.simulation, name))
        step = 1e-5 * value
        high, low = (problem.value({name: np.asarray(value + sign * step)}) for sign in (1, -1))
        assert float(made.gradient[name]) == pytest.approx((high - low) / (2 * step), rel=1e-6), name
    way = np.random.default_rng(5).standard_normal((108, 3))
    for name in starts:
        start = parameters.value(problem.simulation, name)
        high, low = (problem.value({name: start + sign * 1e-6 * way}) for sign in (1, -1))
        slope = float(np.sum(way * made.gradient[name]))
        assert slope == pytest.approx((high - low) / 2e-6, rel=1e-6), name


def test_a_page_says_why_methods_are_missing(tmp_path):
    made = mdnum.grad(held(), "potential", "epsilon", steps=3, out=tmp_path / "grad")
    missing = {one["what"]: one["why"] for one in made.summary["left_out"] if not one["how"]}
    assert all("one-link" in missing[name] for name in ("forward", "boundary", "trust", "flips"))
    answered = {one["method"] for one in made.summary["methods"]}
    assert {"symmetric", "event-aware", "finite-differences"} <= answered
    text = " ".join((made.folder / "report.html").read_text().split())
    # of all that have the same reason in one line: methods, and parts of the diagnosis
    assert text.count(missing["forward"]) == 2
    assert "forward, surrogate, " in text and "flips, trust" in text


class Squeezed(KickDrift):
    """A kick and a drift, of which the drift scales velocities by their size."""

    name = "squeezed"

    def drift(self, x, v, masses, step, order):
        v = v * (1 - 1e-4 * jnp.sum(v * v))
        return x + self.timestep * v, v, jnp.zeros(())


class Slower(VelocityVerlet):
    """A linear drift of its own."""

    name = "slower"

    def drift(self, x, v, masses, step, order):
        v = 0.999 * v
        return x + self.timestep * v, v, jnp.zeros(())


def test_every_other_method_refuses_it_by_name():
    names = ["potential.sigma"]
    problem = Problem(held(cutoff={"kind": "hard", "radius": 2.0}), everything(108), 10)
    squeezed = replace(problem.simulation, integrator=Squeezed(jnp.float64(0.004)))
    for other in (problem, replace(problem, simulation=squeezed)):
        name = other.simulation.integrator.name
        for word in ("forward", "surrogate", "boundary", "reweighting"):
            with pytest.raises(InputError, match=rf"{name} .*unrolled"):
                method(word)(other, names)
        with pytest.raises(InputError, match=f"{name} is another"):
            spectrum(other)
    whole: Any = {"precision": {"state": "lattice"}}
    with pytest.raises(InputError, match=r"nve .*langevin, .*one-link"):
        method("reversible")(Problem(held(**whole), everything(108), 10), names)
    with pytest.raises(InputError, match="not one-link"):
        first_state(held(**whole))
    nve = build(make(crystal(), LENNARD_JONES, QUINTIC, **whole))
    with pytest.raises(InputError, match="not slower"):
        first_state(replace(nve, integrator=Slower(jnp.float64(0.004))))


@pytest.mark.nightly
def test_a_linear_drift_of_its_own_is_differentiated_by_all():
    simulation = replace(held(), integrator=Slower(jnp.float64(0.004)))
    problem = Problem(simulation, everything(108), 30)
    gradients = [
        method(word)(problem, NAMES[:2]).gradient
        for word in ("symmetric", "event-aware", "forward", "unrolled")
    ]
    for name in NAMES[:2]:
        first, *others = (float(gradient[name]) for gradient in gradients)
        assert others == pytest.approx([first] * 3, rel=1e-9)


@pytest.mark.parametrize("name", ["kick", "finish", "begin", "init", "deform"])
@pytest.mark.parametrize("base", [KickDrift, VelocityVerlet])
def test_a_kick_that_derivatives_would_not_see_is_refused_when_its_class_is_made(base, name):
    with pytest.raises(TypeError, match=f"Planted overrides {name}"):
        type("Planted", (base,), {name: lambda self, *given: given, "__annotations__": {}})
    mixin = type("Mixin", (), {name: lambda self, *given: given})
    with pytest.raises(TypeError, match=f"Planted overrides {name}"):
        type("Planted", (mixin, base), {})


class Shaken(VelocityVerlet):
    """Constant energy, with a key that somebody's noise would use."""

    name = "shaken"
    generator: Any = quantity("seed")


def test_whatever_has_a_seed_has_noise():
    from mdnum.forks.choices import parse, twin_of, unavailable
    from mdnum.gradients.diagnose.trust import no_half_step

    still = build(make(crystal(), LENNARD_JONES, QUINTIC))
    noisy = replace(still, integrator=Shaken(still.integrator.timestep, jax.random.key(still.draw.seed)))
    for word in ("relabel", "rotate"):
        assert unavailable(parse(word), still) is None and "noise" in str(unavailable(parse(word), noisy))
    assert unavailable(parse("noise"), still) and no_half_step(noisy) and not no_half_step(still)
    twin = twin_of(parse("noise"), noisy)
    keys = [one.simulation.integrator.generator for one in (twin.a, twin.b)]
    assert not np.array_equal(*map(jax.random.key_data, keys))
