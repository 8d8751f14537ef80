"""A package outside mdnum adds a cutoff and a potential, each one class and no other edit."""

from __future__ import annotations

import json
import os
import subprocess
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
GROUPS = {
    "mdnum.cutoffs": {"tilted": "strange_terms:Tilted"},
    "mdnum.potentials": {"power": "strange_terms:Power"},
}


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on the search path with the package in it."""
    folder = install(tmp_path / "site", "strange-terms", {"strange_terms": CUTOFF + POTENTIAL}, GROUPS)
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("strange_terms", None)


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
    compared = check_energy(simulation.system)
    assert compared.ok and compared.worst["energy_rel"] < 1e-12
    certified = mdnum.fork_certify("pair/at-cutoff", overrides=overrides, steps=400, out=tmp_path / "exact")
    assert certified is not None


def test_a_cutoff_is_found_by_the_command_line(site, tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mdnum",
            "systems",
            "check",
            "pair/at-cutoff",
            "--set",
            "cutoff.kind=tilted",
            "--json",
        ],
        env={**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)


def test_a_potential_of_two_constants(site, tmp_path):
    overrides = {"potential.kind": "power", "potential.length": 1.0, "potential.strength": 0.5}
    simulation = mdnum.build("pair/at-cutoff", overrides)
    assert simulation.potential.evaluate(np.float64(4.0))[0] == pytest.approx(0.5 / 2**8)
    assert check_energy(simulation.system).ok
    with pytest.raises(InputError, match="strength missing"):
        mdnum.load("pair/at-cutoff", {"potential.kind": "power", "potential.length": 1.0})
    with pytest.raises(InputError, match="unknown sigma; it has length, strength"):
        mdnum.load("pair/at-cutoff", {**overrides, "potential.sigma": 1.0})
    with pytest.raises(InputError, match="needs a potential with a sigma; power has none"):
        mdnum.load("pair/at-cutoff", {**overrides, "cutoff.in_sigma": 2.5})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("w - share", "w + share", "its slope is not the derivative of its energy at r = 1, r_cut = 2"),
        ("u - share * r2", "u - share * r2 + 1", "its energy at r_cut is 1, and its smoothness is 0"),
        ("smoothness = 0", "smoothness = 1", "its slope at r_cut is"),
        ("name = ", "nam = ", "it has no name"),
    ],
)
def test_a_cutoff_that_is_not_what_it_says_is_an_error_that_names_its_package(
    tmp_path, monkeypatch, old, new, message
):
    assert old in CUTOFF
    folder = install(tmp_path, "strange-terms", {"strange_terms": CUTOFF.replace(old, new)}, GROUPS)
    monkeypatch.syspath_prepend(folder)
    try:
        with pytest.raises(InputError, match="cutoff 'tilted' of package strange-terms") as caught:
            CUTOFFS.parse("tilted")
        assert message in str(caught.value)
    finally:
        sys.modules.pop("strange_terms", None)
