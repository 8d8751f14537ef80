"""Gradients through thermostats and barostats: against differences, and flips against an ODE with events."""

from __future__ import annotations

import re
from typing import Any

import ase
import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk
from ensembles import kinds
from gradient_problems import everything
from moving_box import Piston, Sheared, Strained
from rollout.harness import liquid
from scipy.integrate import solve_ivp
from small_systems import make

import mdnum
from mdnum.errors import InputError
from mdnum.gradients import Problem, method, parameters
from mdnum.gradients.diagnose import spectrum
from mdnum.gradients.losses import Custom, MeanDensity, MeanTemperature, MeanVolume
from mdnum.gradients.recorded import EventAware, Symmetric
from mdnum.systems import build
from mdnum.systems.simulation import Simulation

KINDS: dict[str, tuple[Any, dict[str, Any]]] = kinds(0.2, 0.5, 0.05, pressure=5.0) | {
    "strained": (Strained, {"stretch": -0.25, "shear": 0.4}),
    "sheared": (Sheared, {"pressure": 8.0, "stiffness": 0.02}),
}


def held(kind: str, atoms=None, *, cutoff: str = "quintic", r_cut: float = 2.0, **options: Any) -> Simulation:
    """A dense fluid under one of `KINDS`."""
    name, numbers = KINDS[kind]
    given = {"timestep": 0.004, "temperature": 1.0, "seed": 3, "skin": 0.3} | options
    return mdnum.simulation(
        liquid() if atoms is None else atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut(cutoff, r_cut),
        units="lj", integrator=name, dynamics=numbers, name=kind, **given,
    )  # fmt: skip


def difference(problem: Problem, name: str, along: np.ndarray | float, step: float) -> float:
    """The slope of the loss, of runs that are moved along a direction."""
    here = parameters.value(problem.simulation, name)
    high, low = (problem.value({name: here + sign * step * along}) for sign in (1, -1))
    return (high - low) / (2 * step)


def agrees(problem: Problem, names, words, relative: float) -> None:
    """Gradients of all methods are those of differences; of a start along a random direction."""
    found = [method(word)(problem, names).gradient for word in words]
    way = np.random.default_rng(5).standard_normal((problem.simulation.atoms, 3))
    for name in names:
        if name.startswith("initial."):
            exact, along = difference(problem, name, way, 1e-6), way
        else:
            along = float(parameters.value(problem.simulation, name)) or 1.0
            exact, along = difference(problem, name, along, 1e-5) / along, 1.0
        for word, one in zip(words, found, strict=True):
            assert float(np.sum(along * one[name])) == pytest.approx(exact, rel=relative), (name, word)


def numbers_of(simulation: Simulation) -> tuple[str, ...]:
    known = [name for name in parameters.names(simulation) if name.startswith("dynamics.")]
    return (*known, "potential.sigma", "box.scale", "initial.positions", "initial.velocities")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("sheared", ("symmetric",)),
        *(pytest.param(kind, ("symmetric", "unrolled"), marks=pytest.mark.nightly) for kind in KINDS),
    ],
)
def test_derivatives_are_those_of_differences(kind, words):
    """By all numbers of the integrator and by the start, over lists that are rebuilt as the box moves."""
    simulation = held(kind)
    agrees(Problem(simulation, everything(simulation.atoms), 40), numbers_of(simulation), words, 1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["csvr", "mtk full"])
def test_another_potential_and_a_tilted_box(kind):
    """Of a many-body energy, by its own strain."""
    atoms = bulk("Si", "diamond", a=5.43, cubic=True).repeat(2)
    atoms.set_cell(atoms.cell.array @ (np.eye(3) + 0.1 * np.eye(3, k=1)), scale_atoms=True)
    name, numbers = KINDS[kind]
    if "pressure" in numbers:
        numbers = numbers | {"pressure": 0.02, "relaxation": 0.1, "pressure_relaxation": 0.2}
    dynamics = {"kind": name, "timestep": 0.001, "temperature": 600.0, "seed": 3} | numbers
    silicon = {"kind": "stillinger-weber"}
    simulation = build(make(atoms, silicon, None, "metal", dynamics=dynamics, neighbors={"skin": 0.4}))
    names = ("dynamics.temperature", "box.scale", "initial.positions", "initial.velocities")
    agrees(Problem(simulation, everything(len(atoms)), 20), names, ("symmetric", "unrolled"), 1e-6)


@pytest.mark.parametrize(
    ("kind", "loss", "sign", "word"),
    [
        ("sheared", MeanVolume(), 1, "unrolled"),
        pytest.param("cell-rescaling", MeanDensity(), -1, "symmetric", marks=pytest.mark.nightly),
    ],
)
def test_a_volume_follows_the_potential(kind, loss, sign, word):
    """A larger atom and a lower pressure make the box larger."""
    problem = Problem(held(kind), loss, 40)
    names = ("potential.sigma", "dynamics.pressure")
    found = method(word)(problem, names).gradient
    assert sign * found["potential.sigma"] > 0 > sign * found["dynamics.pressure"]
    agrees(problem, names, (word,), 1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize("loss", [MeanVolume(), MeanDensity()])
def test_a_box_that_does_not_move_is_only_scaled(loss):
    simulation = held("csvr")
    still = Symmetric()(Problem(simulation, loss, 5), ("potential.sigma", "box.scale")).gradient
    volume = float(np.linalg.det(simulation.cell.matrix))
    expected = -3 * 108 / volume if isinstance(loss, MeanDensity) else 3 * volume
    assert still["potential.sigma"] == 0
    assert still["box.scale"] == pytest.approx(expected, rel=1e-9)


# --- flips: a pair that leaves its well in a box under a piston ---------------------------------------

EDGE, TIME, WAY = 8.0, 1.6, np.array([2.0, 1.0, 2.0]) / 3
START = {
    "r0": 1.8, "v0": 1.2, "r_cut": 2.5, "sigma": 1.0, "epsilon": 1.0, "pressure": 5e-4, "inertia": 4.0,
}  # fmt: skip
NAMES = dict(
    zip(
        START,
        ("initial.positions", "initial.velocities", "cutoff.radius", "potential.sigma", "potential.epsilon",
         "dynamics.pressure", "dynamics.inertia"),
        strict=True,
    )
)  # fmt: skip


def exact(edge: float = EDGE, **changes: float) -> float:
    """Relative velocity and a hundredth of the volume at the end, from the equations of motion.

    Distance r, relative velocity u, strain e and its rate of two atoms of mass one; the crossing is located.
    """
    q = START | changes

    def slope(inside):
        def of(t, y):
            r, u, e, rate = y
            six = (q["sigma"] / r) ** 6
            pull = 24 * q["epsilon"] * (2 * six**2 - six) / r if inside else 0.0
            excess = 3 * u * u / 4 + pull * r - 3 * edge**3 * np.exp(3 * e) * q["pressure"]
            return [u + rate * r, 2 * pull - 1.5 * rate * u, rate, excess / q["inertia"]]

        return of

    def leaves(t, y):
        return y[0] - q["r_cut"]

    leaves.terminal = True  # type: ignore[attr-defined]
    options: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    begin = [q["r0"], q["v0"], 0.0, 0.0]
    inside = solve_ivp(slope(True), (0, TIME), begin, events=leaves, **options)
    assert inside.status == 1
    _, u, e, _ = solve_ivp(slope(False), (inside.t[-1], TIME), inside.y[:, -1], **options).y[:, -1]
    return float(u + 0.01 * edge**3 * np.exp(3 * e))


def leaving(steps: int) -> Problem:
    """The same pair across a face of the box."""
    x = np.array([4.0 + EDGE / 2, 4.5, 4.0]) + np.outer([-0.5, 0.5], WAY * START["r0"])
    atoms = ase.Atoms("Ar2", x, cell=[EDGE] * 3, pbc=True, masses=[1.0, 1.0])
    atoms.wrap()
    atoms.set_momenta(np.outer([-0.5, 0.5], WAY * START["v0"]))
    numbers = {name: START[name] for name in ("pressure", "inertia")}
    simulation = mdnum.simulation(
        atoms, mdnum.LennardJones(START["sigma"], START["epsilon"]), mdnum.Cut("hard", START["r_cut"]),
        units="lj", integrator=Piston, dynamics=numbers, timestep=TIME / steps, skin=0.3,
    )  # fmt: skip

    def see(frame, origin, around):
        return jnp.asarray(WAY) @ (frame.v[:, 1] - frame.v[:, 0]) + 0.01 * around.volume

    return Problem(simulation, Custom(see=see, first=steps), steps)


def test_a_flip_acts_on_the_box_through_the_virial():
    """Of first order in the time step; what the steps alone give is 2 to 13 % off."""
    steps = 1600
    problem = leaving(steps)
    assert problem.value() == pytest.approx(exact(), abs=1e-3)
    wanted = (*NAMES.values(), "box.scale")
    # a guard that nothing passes leaves out the flip
    aware, plain = (EventAware(guard)(problem, wanted).gradient for guard in (1e-3, 1e3))
    slopes = {
        name: (exact(**{key: START[key] * (1 + 1e-4)}) - exact(**{key: START[key] * (1 - 1e-4)}))
        / (2e-4 * START[key])
        for key, name in NAMES.items()
    }
    scaled = [exact(EDGE * (1 + h), r0=START["r0"] * (1 + h)) for h in (1e-4, -1e-4)]
    slopes["box.scale"] = (scaled[0] - scaled[1]) / 2e-4
    for name, slope in slopes.items():
        ours, steps_alone = (
            float(WAY @ (one[name][1] - one[name][0])) / 2 if one[name].ndim else float(one[name])
            for one in (aware, plain)
        )
        assert ours == pytest.approx(slope, rel=1e-3), name
        assert abs(steps_alone - slope) > 10 * abs(ours - slope), name


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["mtk", "cell-rescaling full"])
def test_the_flow_of_a_melt_has_the_slope_of_wide_differences(kind):
    """Replica by replica, over many flips: what the flips add is some standard errors of the difference."""
    from mdnum.gradients.differences import Ensemble, Replicas, SmoothedDifferences

    atoms = bulk("Ar", "sc", a=0.8442 ** (-1 / 3), cubic=True).repeat(5)
    atoms.set_masses([1.0] * len(atoms))
    problem = Problem(held(kind, atoms, cutoff="hard", r_cut=2.0), MeanTemperature(first=80), 80)
    starts, names = Replicas(5), ("potential.sigma", "cutoff.radius")
    wide = SmoothedDifferences(0.002, 2, starts)(problem, names)
    plain, aware = (Ensemble(one, starts, halvings=0)(problem, names) for one in (Symmetric(), EventAware()))
    apart = {}
    for name in names:
        each = [np.array(one.details["each"][name]) for one in (plain, aware, wide)]
        off = [(one - each[2]).mean() for one in each[:2]]
        noise = (each[1] - each[2]).std(ddof=1) / np.sqrt(5)
        apart[name] = abs(off[0]) / noise
        assert abs(off[1]) < 2.5 * noise, name
    # five starts do not resolve it by every number under a barostat's noise
    assert max(apart.values()) > 4, apart


# --- what is refused ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["csvr", pytest.param("mtk", marks=pytest.mark.nightly)])
def test_what_is_not_served_is_refused_by_name(kind):
    names = ["potential.sigma"]
    problem = Problem(held(kind, cutoff="hard"), everything(108), 10)
    for word in ("forward", "surrogate", "boundary", "reweighting"):
        with pytest.raises(InputError, match=rf"{kind} .*symmetric, event-aware .*unrolled"):
            method(word)(problem, names)
    with pytest.raises(InputError, match=f"{kind} is another"):
        spectrum(problem)
    with pytest.raises(InputError, match=kind):
        whole = mdnum.PrecisionPolicy(state="lattice")
        method("reversible")(Problem(held(kind, precision=whole), everything(108), 10), names)


@pytest.mark.nightly
def test_a_page_says_which_methods_answered(tmp_path):
    made = mdnum.grad(
        held("mtk", cutoff="hard"), "volume", "epsilon", steps=6, out=tmp_path / "grad",
        methods=["event-aware", "symmetric", "forward"],
    )  # fmt: skip
    assert {one["method"] for one in made.summary["methods"]} == {"event-aware", "symmetric"}
    (refused,) = made.summary["refused"]
    assert refused["method"] == "forward" and "mtk is another" in refused["why"]
    assert {"trust", "flips"} <= set(made.summary["failed"])
    text = re.sub(r"\s+", " ", (made.folder / "report.html").read_text())
    assert refused["why"] in text
