"""A package outside mdnum adds a cutoff and a potential, each one class and no other edit."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from other_package import install

import mdnum
from mdnum.errors import InputError
from mdnum.md.cutoffs import CUTOFFS
from mdnum.references.energy_check import check_energy

CUTOFF = '''
from mdnum.md.cutoffs import Cutoff


class Tilted(Cutoff):
    """u(r) less the share r²/r_cut² of its value at the cutoff."""

    name = "tilted"
    smoothness = 0

    def cut(self, r2, u, w, at):
        share = at.energy / (at.r_cut * at.r_cut)
        return u - share * r2, w - share
'''
POTENTIAL = '''
from jaxtyping import Array, Float
from mdnum.md.potentials import PairPotential


class Power(PairPotential):
    """strength (length/r)^8 repulsion."""

    name = "power"
    length: Float[Array, "types"]
    strength: Float[Array, "types"]

    def evaluate(self, r2):
        inverse = self.length * self.length / r2
        energy = self.strength * inverse * inverse * inverse * inverse
        return energy, -4 * energy / r2
'''
CHOICE = '''
from dataclasses import dataclass
from mdnum.forks.choices.base import Choice
from mdnum.forks.worlds import twin


@dataclass(frozen=True)
class Slower(Choice):
    """A time step longer by a share."""

    share: str = "1e-6"

    @property
    def name(self):
        return f"slower={self.share}"

    def make(self, system):
        is_ball = hasattr(system, "balls")
        key = "integrator.timestep" if is_ball else "dynamics.timestep"
        own = system.spec.integrator if is_ball else system
        return twin(system, {key: own.timestep * (1 + float(self.share))}, self.name, self.name)
'''
METHOD = """
import numpy as np
from dataclasses import dataclass
from mdnum.gradients.problem import Method


@dataclass(frozen=True)
class OneSided(Method):
    name = "one-sided"
    description = "a difference to one side"
    kind = "values"

    def differentiate(self, problem, names, progress):
        value = problem.value()
        h, gradient = 1e-6, {}
        for name in names:
            (here,) = [float(x) for x in problem.simulation.model.potential.epsilon]
            gradient[name] = np.asarray((problem.value({name: here + h}) - value) / h)
        return self.result(value, gradient)
"""
GROUPS = {
    "mdnum.cutoffs": {"tilted": "strange_terms:Tilted"},
    "mdnum.potentials": {"power": "strange_terms:Power"},
    "mdnum.choices": {"slower": "strange_choice:Slower"},
    "mdnum.gradient_methods": {"one-sided": "strange_method:OneSided"},
}
MODULES = {"strange_terms": CUTOFF + POTENTIAL, "strange_choice": CHOICE, "strange_method": METHOD}


@pytest.fixture
def site(request, tmp_path, monkeypatch):
    """A folder on the search path with the package in it, or with other source of its cutoff."""
    terms = {"strange_terms": getattr(request, "param", MODULES["strange_terms"])}
    folder = install(tmp_path / "site", "strange-terms", MODULES | terms, GROUPS)
    monkeypatch.syspath_prepend(folder)
    yield folder
    for name in MODULES:
        sys.modules.pop(name, None)


def test_a_cutoff_runs_is_compared_and_certified(site, tmp_path):
    """Its flips with their jumps, the comparison with ASE's list, and a certificate in exact arithmetic."""
    overrides = {"cutoff.kind": "tilted", "dynamics.steps": 1500}
    run = mdnum.run("pair/at-cutoff", out=tmp_path / "run", overrides=overrides, report=False)
    assert run.summary["flips_left"] > 0
    assert run.summary["ase"]["ok"] is True
    u = 4 * (2.5**-12 - 2.5**-6)
    slope = -24 * (2 * 2.5**-12 - 2.5**-6) / 2.5
    simulation = mdnum.build("pair/at-cutoff", overrides)
    energy, force = simulation.jumps()
    assert energy[0] == 0
    assert force[0] == pytest.approx(-(slope - 2 * u / 2.5), rel=1e-14)
    compared = check_energy(simulation)
    assert compared.ok and compared.worst["energy_rel"] < 1e-12
    certified = mdnum.fork_certify(
        "pair/at-cutoff", overrides=overrides, steps=400, policies={"float64": {}}, out=tmp_path / "exact"
    )
    (row,) = certified.summary["policies"]
    assert row["horizon"] is None and row["reason_unavailable"] is None


def test_a_potential_of_two_constants(site, tmp_path):
    overrides = {"potential.kind": "power", "potential.length": 1.0, "potential.strength": 0.5}
    simulation = mdnum.build("pair/at-cutoff", overrides)
    assert simulation.potential.evaluate(np.float64(4.0))[0] == pytest.approx(0.5 / 2**8)
    assert check_energy(simulation).ok
    with pytest.raises(InputError, match="no value of strength"):
        mdnum.load("pair/at-cutoff", {"potential.kind": "power", "potential.length": 1.0})
    with pytest.raises(InputError, match=r"key sigma; .*length, strength"):
        mdnum.load("pair/at-cutoff", {**overrides, "potential.sigma": 1.0})
    with pytest.raises(InputError, match="power has no sigma"):
        mdnum.load("pair/at-cutoff", {**overrides, "cutoff.in_sigma": 2.5})


@pytest.mark.parametrize("name", ["pair/at-cutoff", "ball/drop"])
def test_a_choice_of_both_worlds(site, name):
    from mdnum.forks.choices.base import parse, shipped, twin_of

    system = mdnum.load(name)
    made = twin_of(parse("slower=1e-3"), system)
    ((before, after),) = made.changes.values()
    assert after == pytest.approx(1.001 * before, rel=1e-12)
    assert "slower=1e-6" in shipped("md") and "slower=1e-6" in shipped("ball")


def test_a_choice_that_reads_a_system_file_says_what_it_is_given(site, monkeypatch):
    from mdnum.forks.choices.base import parse, twin_of

    choice = parse("slower=1e-3")
    monkeypatch.setattr(type(choice), "make", lambda self, system: system.spec.dynamics)
    with pytest.raises(InputError, match=r"strange_choice.* Simulation.*extending\.md"):
        twin_of(choice, mdnum.load("pair/at-cutoff"))


def test_a_gradient_method(site):
    from mdnum.gradients import Problem, method
    from mdnum.gradients.losses import MeanPotential

    problem = Problem(mdnum.build("pair/at-cutoff", {"cutoff.kind": "quintic"}), MeanPotential(), 20)
    own = method("one-sided")(problem, ["potential.epsilon"]).gradient["potential.epsilon"]
    other = method("symmetric")(problem, ["potential.epsilon"]).gradient["potential.epsilon"]
    assert float(own) == pytest.approx(float(other), rel=1e-4)


@pytest.mark.parametrize(
    ("site", "message"),
    [
        (CUTOFF.replace(old, new), message)
        for old, new, message in (
            ("w - share", "w + share", "r_cut = 2 … slope at r = 1 … derivative … energy"),
            ("u - share * r2", "u - share * r2 + 1", "energy jumps … -1 … r_cut … smoothness … 0"),
            ("smoothness = 0", "smoothness = 1", "slope jumps … 0.125 … r_cut … smoothness … 1"),
            ("smoothness = 0", "smoothness = -1", "smoothness -1 … energy is continuous"),
            ("name = ", "nam = ", "has no name"),
        )
    ],
    indirect=["site"],
)
def test_a_cutoff_that_is_not_what_it_says_is_an_error_that_names_its_package(site, message):
    with pytest.raises(InputError, match="cutoff 'tilted' of package strange-terms") as caught:
        CUTOFFS.parse("tilted")
    assert all(part in str(caught.value) for part in message.split(" … "))
