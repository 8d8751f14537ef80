"""Pair forces in sixteen bits: every operation rounded, as numpy with ml_dtypes has it, bit for bit."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
import small_systems
from devices import on_cpu
from rollout.harness import listed

from mdnum.md.cell import HostCell
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.exact import rounded, zero_bits
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

SHORT = {"bfloat16": np.dtype(ml_dtypes.bfloat16), "float16": np.dtype(np.float16)}
RADIUS, ONSET = 1.9, 1.5


def simulation(dtype: str, kind: str = "hard", wide: str = "float64") -> Simulation:
    """Forces in dtype; decisions and sums in the wide one."""
    cutoff = {"kind": kind, "radius": RADIUS, **({"onset": ONSET} if kind in ("switched", "quintic") else {})}
    system = small_systems.make(
        small_systems.crystal(3, 0.1),
        small_systems.LENNARD_JONES,
        cutoff,
        precision={"force": dtype, "decision": wide, "accumulate": wide},
    )
    return build(system)


def pair_terms(r2: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Energy and slope by r² of a Lennard-Jones pair, rounded after every operation in the dtype of r2."""
    c = r2.dtype.type
    one = c(1)

    def bare(x):
        inverse = one / x
        s2 = c(1) * c(1) * inverse
        s6 = s2 * s2 * s2
        energy = c(4) * c(1) * (s6 * (s6 - one))
        return energy, c(-12) * c(1) * (s6 * (s6 + s6 - one)) * inverse

    u, w = bare(r2)
    rc, ro = c(RADIUS), c(ONSET)
    if kind == "hard":
        return u, w
    if kind == "force-shifted":
        at, slope = bare(np.asarray([rc * rc]))
        slope = c(2) * rc * slope
        r = np.sqrt(r2)
        return u - at - (r - rc) * slope, w - slope / (r + r)
    b, a = rc * rc, ro * ro
    cube = (b - a) * (b - a) * (b - a)
    s = (b - r2) * (b - r2) * (b + (r2 + r2) - (a + a + a)) / cube
    ds = c(6) * (b - r2) * (a - r2) / cube
    beyond = r2 > a
    return np.where(beyond, u * s, u), np.where(beyond, w * s + u * ds, w)


@eqx.filter_jit
def _evaluated(force, x, tables):
    made = force(x, tables, decisions=True, tensor=True)
    return made, made.tensor


def evaluated(sim: Simulation):
    x, table, tables = listed(sim)
    return _evaluated(sim.force, x, tables), np.asarray(x).T, table


@pytest.mark.parametrize(
    ("dtype", "kind", "decision"),
    [
        # widened to float32, where XLA would leave out roundings
        ("bfloat16", "hard", "float32"),
        pytest.param("bfloat16", "switched", "float32", marks=pytest.mark.nightly),
        pytest.param("bfloat16", "force-shifted", "float64", marks=pytest.mark.nightly),
        pytest.param("float16", "switched", "float64", marks=pytest.mark.slow),
    ],
)
def test_forces_and_energies_are_those_of_numpy(dtype, kind, decision):
    sim = simulation(dtype, kind, decision)
    (found, virial), x, table = evaluated(sim)
    short, wide = SHORT[dtype], np.dtype(decision)
    atoms = len(x)
    force, energy = np.zeros((atoms, 3), wide), np.zeros(atoms, wide)
    ends = np.concatenate([x, np.zeros((1, 3))])
    inside = 0
    for slot in range(table.slots):
        j = table.index[slot]
        d = HostCell(sim.cell, wide).displacement(x, ends[j])
        r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        near = (j < atoms) & (r2 < wide.type(RADIUS) * wide.type(RADIUS))
        r2 = np.where(near, r2, 1).astype(short)
        u, w = (np.where(near, q, short.type(0)) for q in pair_terms(r2, kind))
        assert u.dtype == w.dtype == short
        pull = w + w
        for axis in range(3):
            force[:, axis] += (pull * d[axis].astype(short)).astype(wide)
        energy += u.astype(wide)
        inside += int(near.sum())
    assert np.array_equal(np.asarray(found.force).T, force)
    assert np.array_equal(np.asarray(found.energy), wide.type(0.5) * energy)
    # the decisions are those of a run whose forces have more bits
    (wide_found, wide_virial), *_ = evaluated(simulation("float64", kind, decision))
    assert np.array_equal(np.asarray(found.decisions.bits), np.asarray(wide_found.decisions.bits))
    error = np.abs(np.asarray(found.force) - np.asarray(wide_found.force)).max()
    unit = float(ml_dtypes.finfo(short).eps) / 2
    largest = np.abs(np.asarray(wide_found.force)).max()
    assert 0.1 * unit * largest < error < 100 * unit * largest and inside > 1000
    assert np.allclose(virial, wide_virial, rtol=0, atol=50 * unit * np.abs(np.asarray(wide_virial)).max())


@on_cpu
def test_without_fences_the_roundings_would_be_left_out():
    """The planted defect: the same expression in one fusion, which numpy does not reproduce."""
    x = jnp.asarray(np.random.default_rng(0).random(4000), jnp.bfloat16)

    def law(x):
        return (x * x * x - x * x) * x

    y = np.asarray(x)
    expected = (y * y * y - y * y) * y
    plain = np.asarray(jax.jit(lambda x: law(x).astype(jnp.float32))(x))
    exact = np.asarray(
        jax.jit(lambda x, zero: rounded(law, zero)(x).astype(jnp.float32))(x, zero_bits("float64"))
    )
    assert np.array_equal(exact, expected.astype(np.float32))
    assert not np.array_equal(plain, exact)


def test_what_is_rounded_has_the_derivative_of_what_is_not():
    zero = zero_bits("float64")

    def law(x):
        return jnp.where(x > 1, x * x * jnp.sqrt(x), x)

    x = jnp.asarray([0.5, 2.0, 4.0], jnp.bfloat16)
    slope = jax.vmap(jax.grad(lambda x: rounded(law, zero)(x)))(x)
    assert np.allclose(np.asarray(slope, np.float64), [1.0, 2.5 * 2.0**1.5, 20.0], rtol=2e-2)
    loop = rounded(lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * y, x), zero)
    with pytest.raises(TypeError, match=r"^(while|scan) .*operation"):
        loop(x)


def test_a_short_force_has_the_geometry_of_the_decision():
    assert PrecisionPolicy(force="bfloat16", decision="float32").geometry == np.float32
