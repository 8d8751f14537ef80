"""Cutoffs: their slopes, what they claim at their thresholds, and the formulas of other codes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from mdnum.md.cutoffs import CUTOFFS, AtCutoff
from mdnum.md.potentials import CutPotential, LennardJones

SIGMA, EPSILON, R_CUT, R_ONSET = 1.1, 0.7, 2.6, 2.2
KINDS = sorted(CUTOFFS)


def model(kind):
    one = [jnp.asarray([value]) for value in (SIGMA, EPSILON, R_CUT, R_ONSET)]
    return CutPotential(LennardJones(*one[:2]), CUTOFFS.parse(kind), *one[2:])


def evaluate(kind, r2):
    cut = model(kind)
    return cut.evaluate(jnp.asarray(r2, jnp.float64), None, cut.at_cutoff())


def bare(r):
    s6 = (mpmath.mpf(SIGMA) / r) ** 6
    return 4 * mpmath.mpf(EPSILON) * (s6 * s6 - s6)


def closed_form(kind, r):
    """The cut energy in arbitrary precision, written from the definition of each cutoff in the literature."""
    r, rc, ro = mpmath.mpf(r), mpmath.mpf(R_CUT), mpmath.mpf(R_ONSET)
    if kind == "hard":
        return bare(r)
    if kind == "shifted":
        return bare(r) - bare(rc)
    if kind == "force-shifted":
        return bare(r) - bare(rc) - (r - rc) * mpmath.diff(bare, rc)
    if r < ro:
        return bare(r)
    if kind == "switched":
        # HOOMD-blue's xplor; jax_md.energy.multiplicative_isotropic_cutoff; ase LennardJones(smooth=True)
        return bare(r) * (rc**2 - r**2) ** 2 * (rc**2 + 2 * r**2 - 3 * ro**2) / (rc**2 - ro**2) ** 3
    t = (r - ro) / (rc - ro)
    if kind == "quintic":
        return bare(r) * (1 - 10 * t**3 + 15 * t**4 - 6 * t**5)
    return bare(r) * (1 + mpmath.cos(mpmath.pi * t)) / 2


@pytest.mark.parametrize("kind", KINDS)
def test_energy_and_slope_are_those_of_the_closed_form(kind):
    r = np.concatenate([np.linspace(0.9, R_CUT, 23), [R_ONSET, R_ONSET + 1e-9, R_CUT - 1e-9]])
    energy, slope = evaluate(kind, r * r)
    with mpmath.workdps(40):
        for k, distance in enumerate(r):
            # the decided quantity is r², so its root is the distance that was evaluated
            exact_r = mpmath.sqrt(mpmath.mpf(float(distance * distance)))
            value = closed_form(kind, exact_r)
            side = -1 if distance >= R_CUT - 1e-6 else (1 if abs(distance - R_ONSET) < 1e-6 else 0)
            derivative = mpmath.diff(lambda x: closed_form(kind, x), exact_r, direction=side)
            scale = abs(bare(exact_r)) + EPSILON
            assert abs(mpmath.mpf(float(energy[k])) - value) < 1e-14 * scale * 10, distance
            # du/d(r²) = u' / 2r
            assert abs(mpmath.mpf(float(slope[k])) * 2 * exact_r - derivative) < 1e-12 * (
                abs(derivative) + EPSILON
            )


@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_is_the_derivative_of_the_energy_as_coded(kind):
    r2 = jnp.linspace(0.9**2, R_CUT**2 * 0.9999, 200)
    gradient = jax.vmap(jax.grad(lambda x: evaluate(kind, x)[0]))(r2)
    _, slope = evaluate(kind, r2)
    assert np.allclose(slope, gradient, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_jumps_are_the_limits_from_inside(kind):
    energy, slope = evaluate(kind, [(R_CUT * (1 - 1e-15)) ** 2])
    energy_jump, force_jump = model(kind).jumps()
    assert energy_jump.shape == force_jump.shape == (1,)
    assert energy_jump[0] == pytest.approx(float(energy[0]), abs=1e-13)
    assert force_jump[0] == pytest.approx(float(-2 * R_CUT * slope[0]), abs=1e-12)
    if CUTOFFS.parse(kind).smoothness >= 0:
        assert energy_jump[0] == 0
    else:
        assert energy_jump[0] == pytest.approx(float(bare(R_CUT)), rel=1e-14)
    if CUTOFFS.parse(kind).smoothness >= 1:
        assert force_jump[0] == 0
    else:
        # attractive at the cutoff: a pair that enters brings a pull
        assert force_jump[0] == pytest.approx(float(-mpmath.diff(bare, R_CUT)), rel=1e-12)
        assert force_jump[0] < 0


def one_sided(kind, order, at, side):
    with mpmath.workdps(60):
        if side > 0 and at == R_CUT:
            return mpmath.mpf(0)
        h = mpmath.mpf(10) ** -20
        # a one-sided difference: the formula of the side, evaluated on that side only
        points = [
            closed_form(kind, mpmath.mpf(at) + side * h * (k + mpmath.mpf(10) ** -8))
            for k in range(order + 1)
        ]
        total = sum((-1) ** (order - k) * mpmath.binomial(order, k) * points[k] for k in range(order + 1))
        return total / (side * h) ** order


@pytest.mark.parametrize("kind", KINDS)
def test_the_smoothness_claimed_is_the_one_there_is(kind):
    cutoff = CUTOFFS.parse(kind)
    places = [R_CUT] + ([R_ONSET] if cutoff.switches else [])
    orders = []
    for place in places:
        order = -1
        while order < 6:
            left, right = (one_sided(kind, order + 1, place, side) for side in (-1, 1))
            if abs(left - right) > 1e-6 * (abs(left) + abs(right) + EPSILON):
                break
            order += 1
        orders.append(order)
    assert min(orders) == cutoff.smoothness, orders


@pytest.mark.parametrize("kind", KINDS)
def test_below_the_onset_a_switched_potential_is_untouched(kind):
    cutoff = CUTOFFS.parse(kind)
    r2 = np.linspace(0.9, R_ONSET, 50) ** 2 * (1 - 1e-15)
    energy, slope = evaluate(kind, r2)
    plain, plain_slope = evaluate("hard", r2)
    if cutoff.switches:
        assert np.array_equal(energy, plain) and np.array_equal(slope, plain_slope)
    elif kind in ("hard", "shifted"):
        assert np.array_equal(slope, plain_slope)


def test_hard_and_shifted_have_the_same_forces_bit_for_bit_and_energies_apart_by_a_constant():
    r2 = np.linspace(0.9, R_CUT, 300) ** 2
    (hard, hard_slope), (shifted, shifted_slope) = evaluate("hard", r2), evaluate("shifted", r2)
    assert np.array_equal(hard_slope, shifted_slope)
    assert np.allclose(
        hard - shifted, float(model("hard").jumps()[0][0]), rtol=0, atol=1e-15 * np.abs(hard).max()
    )


@pytest.mark.jax_md
def test_the_switch_is_that_of_jax_md():
    from mdnum.md import jaxmd

    energy = jaxmd.upstream().energy
    r = jnp.linspace(0.95, R_CUT * 0.9999, 100)
    sigma, epsilon, onset, cutoff = (jaxmd.scalar(v) for v in (SIGMA, EPSILON, R_ONSET, R_CUT))
    theirs = energy.multiplicative_isotropic_cutoff(energy.lennard_jones, onset, cutoff)(
        r, sigma=sigma, epsilon=epsilon
    )
    ours, _ = evaluate("switched", r * r)
    assert np.allclose(ours, theirs, rtol=1e-12, atol=1e-14)


def test_the_switch_is_that_of_ase():
    from ase import Atoms
    from ase.calculators.lj import LennardJones as Theirs

    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1, 0, 0]])
    atoms.calc = Theirs(sigma=SIGMA, epsilon=EPSILON, rc=R_CUT, ro=R_ONSET, smooth=True)
    for r in np.linspace(1.0, R_CUT * 0.999, 20):
        atoms.positions[1, 0] = r
        energy, slope = (float(q) for q in evaluate("switched", r * r))
        assert energy == pytest.approx(atoms.get_potential_energy(), rel=1e-12, abs=1e-14)
        assert -2 * r * slope == pytest.approx(atoms.get_forces()[1, 0], rel=1e-11, abs=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_constants_of_several_pair_types_do_not_mix(kind):
    sigma, epsilon = jnp.asarray([1.0, 0.8, 0.88]), jnp.asarray([1.0, 1.5, 0.5])
    r_cut = 2.5 * sigma
    cut = CutPotential(LennardJones(sigma, epsilon), CUTOFFS.parse(kind), r_cut, 0.9 * r_cut)
    types = jnp.asarray([2, 0, 1, 1, 2])
    r2 = jnp.asarray([1.2, 1.4, 1.1, 3.6, 4.3])
    energy, slope = cut.evaluate(r2, types, cut.at_cutoff())
    for k, t in enumerate([2, 0, 1, 1, 2]):
        alone = CutPotential(
            LennardJones(sigma[t : t + 1], epsilon[t : t + 1]),
            cut.cutoff,
            r_cut[t : t + 1],
            0.9 * r_cut[t : t + 1],
        )
        u, w = alone.evaluate(r2[k], None, alone.at_cutoff())
        assert float(energy[k]) == float(u) and float(slope[k]) == float(w)


def test_the_constants_at_the_cutoff_are_the_bare_potential_there():
    at = model("hard").at_cutoff()
    assert isinstance(at, AtCutoff)
    assert float(at.energy[0]) == pytest.approx(float(bare(R_CUT)), rel=1e-14)
    assert float(at.slope[0]) == pytest.approx(float(mpmath.diff(bare, R_CUT)), rel=1e-12)
    assert (float(at.r_cut[0]), float(at.r_onset[0])) == (R_CUT, R_ONSET)
