"""LAMMPS as a judge of pair functions: the formula in its words, and what it makes of that."""

from __future__ import annotations

import math
import os
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk

import mdnum
from mdnum.references import lepton
from mdnum.references.adapted import evaluate
from mdnum.references.energy_check import check_energy
from mdnum.verbs.check import energy_findings

# where it has to be, a skip would be a failure
NEEDED = os.environ.get("MDNUM_TEST_PEERS") == "on"
needs_lammps = pytest.mark.skipif(not (NEEDED or lepton.installed()), reason="LAMMPS is not installed")


def read(text: str, r: float) -> float:
    """An expression as lepton reads it: a definition counts in what stands before it."""
    known = {name: getattr(math, name) for name in (
        "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "erf",
        "erfc", "floor", "ceil", "atan2",
    )}  # fmt: skip
    known |= {
        "abs": abs, "min": min, "max": max, "square": lambda x: x * x, "step": lambda x: float(x >= 0),
        "delta": lambda x: float(x == 0), "select": lambda x, y, z: z if x == 0 else y, "r": r,
    }  # fmt: skip
    result, *definitions = text.split("; ")
    for one in reversed(definitions):
        name, _, formula = one.partition(" = ")
        known[name] = eval(formula.replace("^", "**"), {}, known)
    return known[result]


def mixed(r, species, rho, c):
    z1, z2 = species
    damped = jax.scipy.special.erfc(0.3 * r) / r
    return 900 * jnp.exp(-r / rho) - c / r**6 + 1e-3 * z1 * z2 * damped


FUNCTIONS = [
    lambda r: jnp.where(r < 2, r**3 - 3, jnp.maximum(jnp.tanh(r), 0.98)) + jnp.abs(r - 3) ** 2.5,
    lambda r: jnp.log1p(r) * jnp.expm1(-r) / jnp.sqrt(r) + jax.nn.sigmoid(r - 2) + jnp.clip(r, 1.5, 2.5),
    lambda r: jnp.sin(r) + jnp.cosh(r / 3) * jax.lax.rsqrt(r) + jnp.cbrt(r) - jnp.exp2(-r) + jnp.sign(r - 2),
    lambda r: jnp.where((r > 1.5) & ~(r >= 2.6), jax.nn.softplus(r), jnp.minimum(r, 3)) + jnp.arctan2(r, 2.0),
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_an_expression_is_the_function(function):
    text = lepton.expression(function)
    assert re.fullmatch(r"[\w .,;=+*/^()-]+", text)
    for r in (1.2, 1.9, 2.0, 2.55, 3.4):
        assert read(text, r) == pytest.approx(float(function(jnp.float64(r))), rel=1e-12)


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda r: jnp.sum(jnp.tanh(r[..., None] * jnp.arange(1.0, 4.0)), -1), "iota of an array"),
        (jax.scipy.special.gammaln, "lgamma"),
        (lambda r: jnp.interp(r, jnp.linspace(0, 3, 9), jnp.ones(9)), "iota of an array"),
    ],
)
def test_an_operation_without_a_word_is_named(function, named):
    with pytest.raises(lepton.Untranslated, match=named):
        lepton.expression(function)


def salt(kind: str = "switched", function=mixed, **parameters):
    atoms = bulk("NaCl", "rocksalt", a=5.64).repeat(6)
    atoms.positions += np.random.default_rng(3).normal(size=atoms.positions.shape) * 0.1
    given = parameters or {"rho": {"Na-Na": 0.3, "Na-Cl": 0.32, "Cl-Cl": 0.35}, "c": 20.0}
    cut = mdnum.Cut(kind, {"Na-Na": 5.0, "Na-Cl": 6.0, "Cl-Cl": 6.5})
    return mdnum.simulation(atoms, mdnum.PairFunction(function, **given), cut, timestep=0.002, skin=0.5)


@needs_lammps
@pytest.mark.parametrize(
    "kind",
    ["switched", *(
        pytest.param(one, marks=pytest.mark.nightly)
        for one in ("hard", "shifted", "force-shifted", "quintic", "cosine")
    )],
)  # fmt: skip
def test_lammps_agrees_in_a_tilted_box_of_two_species(kind):
    made = salt(kind)
    theirs, mine = evaluate(lepton.Lepton(made), made.structure), made.evaluate()
    assert theirs["energy"] == pytest.approx(float(mine.energy), rel=1e-12)
    for name in ("forces", "stress", "energies"):
        ours = np.asarray(getattr(mine, name))
        np.testing.assert_allclose(theirs[name], ours, rtol=0, atol=1e-12 * np.abs(ours).max())


@needs_lammps
def test_lammps_sees_a_wrong_derivative_that_the_function_itself_does_not():
    made = salt(function=lambda r, c: c * jnp.exp(-r) + 0.01 * jax.lax.stop_gradient(jnp.exp(-r)), c=1.0)
    frames = {"start": made.structure}
    alone, both = (check_energy(made, frames, lammps=lammps) for lammps in (False, True))
    assert alone.ok and not both.ok and both.third == "LAMMPS"
    frame: Any = both.frames[0]
    assert frame.energy_third < 1e-12 and frame.force_third > 1e-4
    assert [one.code for one in energy_findings(both)] == ["ASE_DISAGREES", "NOT_ASE"]


@pytest.mark.nightly
def test_what_cannot_be_written_in_words_of_lammps_says_so(monkeypatch):
    monkeypatch.setattr(lepton, "installed", lambda: True)
    made = salt(function=lambda r, c: c * jax.scipy.special.gammaln(r), c=1e-3)
    report = check_energy(made, {"start": made.structure}, lammps=True)
    assert report.ok and report.untranslated == "lgamma" and report.frames[0].energy_third is None
    (found,) = energy_findings(report)
    assert found.values["operation"] == "lgamma"
