"""Cutoffs: their slopes, what they claim at their thresholds, and the formulas of other codes."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import mpmath
import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.md.cutoffs import CUTOFFS, AtCutoff, Cutoff, Level, Undecided, check
from mdnum.md.potentials import CutPotential, LennardJones, Morse, SoftSphere, pair_type

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
    """The cut energy in arbitrary precision."""
    r, rc, ro = map(mpmath.mpf, (r, R_CUT, R_ONSET))
    if CUTOFFS.parse(kind).switches and r < ro:
        return bare(r)
    slope = functools.partial(mpmath.diff, bare)
    return oracles.cut_energy(kind, r, rc, ro, bare, slope, mpmath.cos, mpmath.pi)


def test_a_cutoff_without_an_independent_form_is_refused():
    """Which would otherwise be compared with the form of another one."""
    with pytest.raises(ValueError, match="'tilted'"):
        oracles.cut_energy("tilted", 1.5, 2.5, 2.0, bare, lambda r: 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_energy_and_slope_are_those_of_the_closed_form(kind):
    # forty distances here and below: an operation is compiled for each number of them
    r = np.concatenate([np.linspace(0.9, R_CUT, 37), [R_ONSET, R_ONSET + 1e-9, R_CUT - 1e-9]])
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
def test_constants_of_several_pair_types_do_not_mix(kind):
    sigma, epsilon = jnp.asarray([1.0, 0.8, 0.88]), jnp.asarray([1.0, 1.5, 0.5])
    r_cut = 2.5 * sigma
    cut = CutPotential(LennardJones(sigma, epsilon), CUTOFFS.parse(kind), r_cut, 0.9 * r_cut)
    types = np.tile([2, 0, 1, 1, 2], 8)
    r2 = jnp.linspace(1.1, 4.3, 40)
    energy, slope = cut.evaluate(r2, jnp.asarray(types), cut.at_cutoff())
    for t in range(3):
        alone = CutPotential(
            LennardJones(sigma[t : t + 1], epsilon[t : t + 1]),
            cut.cutoff,
            r_cut[t : t + 1],
            0.9 * r_cut[t : t + 1],
        )
        mine = types == t
        only = alone.evaluate(r2, jnp.zeros(40, jnp.int64), alone.at_cutoff())
        for mixed, own in zip((energy, slope), only, strict=True):
            assert np.array_equal(np.asarray(mixed)[mine], np.asarray(own)[mine])


@pytest.mark.parametrize("kind", KINDS)
def test_a_cutoff_is_what_it_says(kind):
    """Slope and energy, jumps and smoothness, and the shortcuts against what follows from the formula."""
    cutoff = CUTOFFS.parse(kind)
    check(cutoff)
    r = np.linspace(1.0, 2.0, 41)[:-1]
    at = AtCutoff(*map(np.float64, (2.0, 1.6, 0.25, -0.25)))
    given = (r, r**-2, -2 * r**-3, at)
    for own, derived in zip(cutoff.reference(*given), Cutoff.reference(cutoff, *given), strict=True):
        assert np.allclose(own, derived, rtol=1e-12, atol=1e-13)
    level = cutoff.continuous
    assert level.energy_jump(at) == 0 and level.force_jump(at) == cutoff.force_jump(at)
    assert np.allclose(
        Level(cutoff).cut(r**2, r**-2, -(r**-4), at)[0], level.cut(r**2, r**-2, -(r**-4), at)[0]
    )


def claims(kind, **other):
    return type("Other", (type(CUTOFFS.parse(kind)),), other)


class Ramp(Cutoff):
    """A switch that is smooth at r_cut only: share ((r_cut - r) / (r_cut - r_onset))^power."""

    name = "ramp"
    smoothness = 2
    switches = True
    power, share = 3, 1.0

    def cut(self, r2, u, w, at):
        xp = r2.__array_namespace__()
        r, width = xp.sqrt(r2), at.r_cut - at.r_onset
        left = (at.r_cut - r) / width
        s = self.share * left**self.power
        ds = -self.share * self.power * left ** (self.power - 1) / width / (r + r)
        inside = r > at.r_onset
        return xp.where(inside, u * s, u), xp.where(inside, w * s + u * ds, w)


@pytest.mark.parametrize(
    ("cutoff", "message"),
    [
        (claims("quintic", smoothness=5), "derivative 3 .* jumps .*onset.* smoothness .*5"),
        (claims("cosine", smoothness=3), "derivative 2 .* jumps .*onset.* smoothness .*3"),
        (claims("force-shifted", smoothness=2), "derivative 2 .* jumps .*at r_cut"),
        (claims("hard", smoothness=0), "energy jumps by .* at r_cut"),
        (claims("shifted", smoothness=-1), "smoothness .*-1 .*energy .*continuous"),
        (claims("quintic", smoothness=1), "smoothness .*1 .*derivative 2 .*continuous"),
        (claims("hard", energy_jump=lambda self, at: 0 * at.energy), "energy_jump is 0; expected 0.25"),
        (claims("hard", force_jump=lambda self, at: 0 * at.slope), "force_jump is -?0; expected 0.25"),
        (claims("hard", force_jump=lambda self, at: at.slope), "force_jump is -0.25; expected 0.25"),
        (type("Kinked", (Ramp,), {"smoothness": 1}), "slope jumps .*onset"),
        (type("Half", (Ramp,), {"share": 0.5}), "energy jumps .*onset"),
    ],
)
def test_a_cutoff_that_claims_what_it_is_not_is_refused(cutoff, message):
    with pytest.raises(ValueError, match=message):
        check(cutoff)


@pytest.mark.parametrize("made", [type("Kinked", (Ramp,), {"smoothness": 0}), Level(CUTOFFS.parse("hard"))])
def test_a_cutoff_that_says_how_rough_it_is_is_accepted(made):
    check(made)


@pytest.mark.parametrize("kind", KINDS)
def test_balls_hold_the_formula_in_either_writing(kind):
    flint = pytest.importorskip("flint")
    cutoff, at = CUTOFFS.parse(kind), AtCutoff(*map(flint.arb, (2.0, 1.6, 0.25, -0.25)))
    bare = (lambda r2: -2 / (r2 * r2), lambda r2: 1 / r2)
    own, derived = cutoff.enclose(*bare, at), Cutoff.enclose(cutoff, *bare, at)
    for r2 in (2.0, 2.5, 2.57, 3.3, 3.99):
        value = cutoff.cut(np.float64(r2), 1 / r2, -1 / r2**2, AtCutoff(2.0, 1.6, 0.25, -0.25))[1]
        assert own(flint.arb(r2)).overlaps(derived(flint.arb(r2)))
        assert float(own(flint.arb(r2)).mid()) == pytest.approx(2 * float(value), rel=1e-12, abs=1e-15)
    if cutoff.switches:
        wide = flint.arb(1.6**2, 1e-3)
        with pytest.raises(Undecided):
            own(wide)
        # the union of both sides
        assert derived(wide).contains(flint.arb(-2 / 1.6**4))


# --- the potentials that are cut ------------------------------------------------------------------------


def lennard_jones(r, sigma, epsilon):
    return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)


def morse(r, depth, alpha, r0):
    return depth * ((1 - mpmath.exp(-alpha * (r - r0))) ** 2 - 1)


def soft_sphere(r, sigma, epsilon, alpha):
    return epsilon / alpha * (1 - r / sigma) ** alpha if r < sigma else mpmath.mpf(0)


CASES = {
    "argon": (LennardJones, lennard_jones, {"sigma": 3.405, "epsilon": 0.0103235}, (2.9, 12.0)),
    "reduced": (LennardJones, lennard_jones, {"sigma": 1.0, "epsilon": 1.0}, (0.8, 4.0)),
    "copper": (Morse, morse, {"depth": 0.3429, "alpha": 1.3588, "r0": 2.866}, (1.8, 7.0)),
    "harmonic": (SoftSphere, soft_sphere, {"sigma": 1.3, "epsilon": 2.0, "alpha": 2.0}, (0.2, 2.0)),
    "hertz": (SoftSphere, soft_sphere, {"sigma": 1.3, "epsilon": 2.0, "alpha": 2.5}, (0.2, 2.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_energy_and_slope_are_those_of_the_definition(case):
    kind, definition, constants, (low, high) = CASES[case]
    potential = kind(**{name: jnp.asarray([value]) for name, value in constants.items()}).of(None)
    r = np.linspace(low, high, 60)
    energy, slope = potential.evaluate(jnp.asarray(r * r))
    with mpmath.workdps(40):
        exact = {name: mpmath.mpf(value) for name, value in constants.items()}
        for k in range(len(r)):
            at = mpmath.sqrt(mpmath.mpf(float(r[k] * r[k])))
            value = definition(at, **exact)
            derivative = mpmath.diff(lambda x: definition(x, **exact), at) / (2 * at)
            # what cancels in the definition sets the scale: the well, not the value near a zero
            scale = abs(value) + max(exact.values()) * 1e-2
            assert abs(float(energy[k]) - value) < 1e-14 * scale * 10
            assert abs(float(slope[k]) - derivative) < 3e-13 * (
                abs(derivative) + abs(value) + mpmath.mpf(10) ** -3
            )


def test_soft_spheres_that_do_not_touch_feel_nothing_not_even_their_derivatives():
    import jax

    soft = SoftSphere(jnp.asarray([1.0]), jnp.asarray([1.0]), jnp.asarray([2.5])).of(None)
    for r2 in (1.0, 1.0000001, 4.0):
        energy, slope = soft.evaluate(jnp.asarray([r2]))
        assert float(energy[0]) == float(slope[0]) == 0.0
        curvature = jax.grad(lambda x: soft.evaluate(x)[1])(jnp.asarray(r2))
        assert np.isfinite(float(curvature))


@given(species=st.integers(1, 9))
def test_pair_types_count_the_upper_triangle_row_by_row(species):
    rows, columns = np.triu_indices(species)
    assert np.array_equal(pair_type(rows, columns, species), np.arange(len(rows)))
    assert np.array_equal(pair_type(columns, rows, species), np.arange(len(rows)))
