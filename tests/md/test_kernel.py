"""The compiled loop over pairs against sums over all pairs in numpy, and against XLA's own loop."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from devices import on_cpu
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import all_pairs, cut_energy, margins
from scipy import special
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

import mdnum
from mdnum.gradients.adjoint import MODEL, pull_back
from mdnum.md import foreign, kernel
from mdnum.md.cell import wrap_positions
from mdnum.md.decide import Tables
from mdnum.systems import build

pytestmark = on_cpu

CUTOFFS = ("hard", "force-shifted", "switched", "quintic")


def evaluated(system, **options):
    """Positions and box, what the loop gives, and what XLA's loop gives, in the user's order."""
    simulation = build(system)
    wrapped, _ = wrap_positions(simulation.cell, system.atoms.positions)
    table = simulation.verlet_list().build(wrapped, simulation.cell)
    tables, x = simulation.tables(table), jnp.asarray(wrapped[table.order].T)
    assert simulation.force.in_one_loop(tables)
    given = [None if bits is None else jnp.asarray(bits(table)) for bits in options.pop("bits", (None, None))]
    loop = jax.jit(partial(simulation.force, decisions=True))
    blocks = jax.jit(partial(simulation.force.in_blocks, decisions=True))
    return (
        simulation,
        table,
        wrapped,
        loop(x, tables, given=given[0], where=given[1]),
        blocks(x, tables, *given),
    )


def tilted():
    atoms = crystal()
    atoms.set_cell(np.add(atoms.cell[:], [[0, 0, 0], [0.7, 0, 0], [0.3, -0.4, 0]]), scale_atoms=True)
    atoms.pbc = (True, True, False)
    return atoms


@pytest.mark.parametrize("kind", CUTOFFS)
@pytest.mark.parametrize("compare, shape", [("r2 <", crystal), ("r <=", tilted)])
def test_forces_are_those_of_all_pairs(kind, compare, shape):
    r_cut, r_onset, atoms = 2.3, 2.0, shape()
    switch = {"onset": r_onset} if kind in ("switched", "quintic") else {}
    cutoff = {"kind": kind, "radius": r_cut, "compare": compare, **switch}
    simulation, table, x, made, blocks = evaluated(make(atoms, LENNARD_JONES, cutoff))
    i, j, d = all_pairs(x, atoms.cell[:], atoms.pbc)
    inside, margin = margins(d, r_cut, compare)
    i, j, d = i[inside], j[inside], d[inside]
    r = np.linalg.norm(d, axis=1)

    def u(r):
        return 4 * (r**-12 - r**-6)

    def slope(r):
        return 24 * (r**-7 - 2 * r**-13)

    def energy(r):
        beyond = np.real(r) > (r_onset if switch else 0)
        return np.where(beyond, cut_energy(kind, r, r_cut, r_onset, u, slope), u(r))

    pull = (np.imag(energy(r + 1e-30j)) / 1e-30 / r)[:, None] * d
    force = np.zeros_like(x)
    np.add.at(force, i, pull)
    np.add.at(force, j, -pull)
    np.testing.assert_allclose(made.force.T, force[table.order], atol=1e-12 * np.abs(force).max())
    assert float(made.energy.sum()) == pytest.approx(float(energy(r).sum()), rel=1e-13)
    assert float(made.virial) == pytest.approx(-float((pull * d).sum()), rel=1e-12)
    assert simulation.decider.compare == compare
    assert {
        tuple(sorted(pair)) for pair in zip(*table.decided(np.asarray(made.decisions.bits)), strict=True)
    } == {(int(a), int(b)) for a, b in zip(i, j, strict=True)}
    assert float(made.decisions.nearest) == np.abs(margin).min()
    assert np.array_equal(made.decisions.bits, blocks.decisions.bits)


@given(seed=st.integers(0, 2**32 - 1), everywhere=st.booleans())
@settings(max_examples=8)
def test_it_acts_on_what_it_is_told(seed, everywhere):
    def told(table):
        return np.random.default_rng(seed).integers(0, 256, (table.slots // 8, len(table.order)), np.uint8)

    def listed(table):
        there = (table.index < len(table.order)).reshape(-1, 8, len(table.order))
        return np.packbits(there, axis=1, bitorder="little")[:, 0]

    bits = (lambda table: told(table) & listed(table), None if everywhere else lambda table: ~told(table))
    cutoff = {"kind": "hard", "radius": 2.3}
    _, _, _, made, blocks = evaluated(make(mixture(), KOB_ANDERSEN, cutoff), bits=bits)
    scale = float(np.abs(blocks.force).max())
    np.testing.assert_allclose(made.force, blocks.force, atol=1e-13 * scale)
    np.testing.assert_allclose(made.energy, blocks.energy, atol=1e-13 * float(np.abs(blocks.energy).max()))
    assert np.array_equal(made.decisions.bits, blocks.decisions.bits)


def test_blocks_of_atoms_share_the_work():
    # more than one block, the last of them short, and a list that is not full everywhere
    atoms = crystal(repeat=9)[: kernel._BLOCK + 500]
    simulation, table, _, made, blocks = evaluated(
        make(atoms, LENNARD_JONES, {"kind": "shifted", "radius": 2.0})
    )
    assert (table.index[-1] == len(atoms)).any()
    np.testing.assert_allclose(made.force, blocks.force, atol=1e-12 * float(np.abs(blocks.force).max()))
    assert np.array_equal(made.decisions.bits, blocks.decisions.bits)
    assert made.decisions.nearest == blocks.decisions.nearest
    tables = simulation.tables(table)
    x = jnp.asarray(wrap_positions(simulation.cell, atoms.positions)[0][table.order].T)
    again = jax.jit(lambda x: [simulation.force(x, tables, decisions=True) for _ in range(20)])(x)
    for one in again:
        # whichever thread took which block
        assert np.array_equal(one.force, made.force)
        assert np.array_equal(one.decisions.bits, made.decisions.bits)


def test_derivatives_and_batches_go_through_it():
    system = make(crystal(), LENNARD_JONES, {"kind": "force-shifted", "radius": 2.3})
    simulation = build(system)
    wrapped, _ = wrap_positions(simulation.cell, system.atoms.positions)
    table = simulation.verlet_list().build(wrapped, simulation.cell)
    tables, x = simulation.tables(table), jnp.asarray(wrapped[table.order].T)

    def energy(x):
        return simulation.force(x, tables, decisions=False).energy.sum()

    force = simulation.force(x, tables, decisions=False).force
    np.testing.assert_allclose(jax.grad(energy)(x), -force, atol=1e-12 * float(np.abs(force).max()))
    both = jax.vmap(lambda x: simulation.force(x, tables, decisions=False).force)(jnp.stack([x, x + 0.01]))
    assert np.array_equal(both[0], force)


@pytest.mark.parametrize("kind", [*CUTOFFS, "shifted", "cosine"])
def test_shipped_cutoffs_go_through_the_loop(kind):
    """A step and a step back: XLA's own loop has the same answers, and would take their place unnoticed."""
    switch = {"onset": 2.0} if kind in ("switched", "quintic", "cosine") else {}
    simulation = build(make(mixture(), KOB_ANDERSEN, {"kind": kind, "radius": 2.3, **switch}))
    wrapped, _ = wrap_positions(simulation.cell, simulation.positions)
    table = simulation.verlet_list().build(wrapped, simulation.cell)
    tables, x = simulation.tables(table), jnp.asarray(wrapped[table.order].T)

    def back(x, bits):
        none = jnp.zeros(())
        return pull_back(simulation.force, x, tables, bits, x, none, none, frozenset({MODEL}))

    bits = jnp.zeros((table.slots // 8, len(wrapped)), jnp.uint8)
    for function, inputs in ((partial(simulation.force, decisions=True), (x, tables)), (back, (x, bits))):
        assert "mdnum_pairs_" in str(jax.make_jaxpr(function)(*inputs))


def morse(r, depth, alpha, r0):
    e = jnp.exp(-alpha * (r - r0))
    return depth * (e * e - 2 * e)


def in_powers(r2, depth, alpha, r0):
    """Several quotients by powers of the distance, which become products with one inverse."""
    r = jnp.sqrt(r2)
    return depth * ((r0 / r) ** 7 - r0 / r2 + r0**3 / (r2 * r) + 1 / (r + r))


def network(r, depth, alpha, r0):
    layer = [jnp.tanh(alpha * r - k) for k in range(3)]
    return depth * jax.nn.softplus(sum(layer, r0)) * jnp.where(r < 2, jnp.maximum(2 - r, 0) ** 2, 0)


#: Energies of a pair at a distance, and the same in numpy.
OWN = {
    "morse": (morse, lambda r, d, a, r0: d * ((1 - np.exp(-a * (r - r0))) ** 2 - 1)),
    "buckingham": (
        lambda r, depth, alpha, r0: depth * jnp.exp(-alpha * r) - r0 / r**6,
        lambda r, d, a, r0: d * np.exp(-a * r) - r0 * r**-6.0,
    ),
    "yukawa": (
        lambda r, depth, alpha, r0: depth * jnp.exp(-alpha * r) / r,
        lambda r, d, a, r0: d * np.exp(-a * r) / r,
    ),
    "damped": (
        lambda r, depth, alpha, r0: depth * jax.scipy.special.erfc(alpha * r) / r,
        lambda r, d, a, r0: d * special.erfc(a * r) / r,
    ),
    "mie": (
        lambda r, depth, alpha, r0: depth * ((r0 / r) ** alpha - jnp.log(r) * jnp.cos(r)),
        lambda r, d, a, r0: d * ((r0 / r) ** a - np.log(r) * np.cos(r)),
    ),
    "powers": (
        in_powers,
        lambda r, d, a, r0: d * ((r0 / r) ** 7 - r0 / r**2 + (r0 / r) ** 3 + 1 / (2 * r)),
    ),
    "network": (
        network,
        lambda r, d, a, r0: (
            d * np.log1p(np.exp(r0 + sum(np.tanh(a * r - k) for k in range(3))))
            * np.where(np.real(r) < 2, (2 - r) ** 2, 0)
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_own_functions_go_through_the_loop(name):
    """Forces as complex steps in numpy, over all pairs; derivatives by parameters as XLA's loop has them."""
    function, reference = OWN[name]
    values = {"depth": 1.3, "alpha": 2.2, "r0": 1.1}
    atoms = crystal()
    simulation = mdnum.simulation(
        atoms, mdnum.PairFunction(function, **values), mdnum.Cut("hard", 2.3), timestep=0.002, skin=0.2
    )
    wrapped, _ = wrap_positions(simulation.cell, simulation.positions)
    table = simulation.verlet_list().build(wrapped, simulation.cell)
    tables, x = simulation.tables(table), jnp.asarray(wrapped[table.order].T)
    made = jax.jit(partial(simulation.force, decisions=False))(x, tables)
    i, j, d = all_pairs(wrapped, atoms.cell[:], atoms.pbc)
    inside, _ = margins(d, 2.3, simulation.decider.compare)
    i, j, d = i[inside], j[inside], d[inside]
    r = np.linalg.norm(d, axis=1)
    energy = partial(reference, d=values["depth"], a=values["alpha"], r0=values["r0"])
    h = 1e-5
    slope = sum(c * energy(r + k * h) for k, c in zip((-2, -1, 1, 2), (1, -8, 8, -1), strict=True)) / (12 * h)
    force = np.zeros_like(wrapped)
    np.add.at(force, i, (slope / r)[:, None] * d)
    np.add.at(force, j, -(slope / r)[:, None] * d)
    scale = np.abs(slope).max()
    np.testing.assert_allclose(made.force.T, force[table.order], atol=1e-9 * scale)
    assert float(made.energy.sum()) == pytest.approx(float(energy(r).sum()), rel=1e-13)

    bits = simulation.force.decide(x, tables).bits
    onto = jnp.asarray(np.random.default_rng(3).normal(size=x.shape))

    def forces(model, x):
        other = replace(simulation.force, model=model).in_blocks(x, tables, decisions=False)
        return jnp.sum(other.force * onto) + 0.7 * jnp.sum(other.energy) + 0.2 * other.virial

    back = partial(pull_back, simulation.force, wanted=frozenset({MODEL}))
    arguments = (x, tables, bits, onto, jnp.float64(0.7), jnp.float64(0.2))
    assert "mdnum_pairs_" in str(jax.make_jaxpr(back)(*arguments))
    seen = jax.jit(back)(*arguments)
    by_model, by_x = jax.jit(jax.grad(forces, argnums=(0, 1)))(simulation.force.model, x)
    np.testing.assert_allclose(seen.x, by_x, atol=1e-11 * np.abs(by_x).max())
    for key, value in by_model.potential.parameters.items():
        np.testing.assert_allclose(seen.model.potential.parameters[key], value, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("kind", CUTOFFS)
def test_quotients_of_shipped_formulas_stay_quotients(kind, monkeypatch):
    """Their bits are those of files that people have."""

    def source():
        sources = []
        monkeypatch.setattr(kernel, "_registered", lambda text: sources.append(text) or "mdnum_none")
        switch = {"onset": 2.0} if kind in ("switched", "quintic") else {}
        simulation = build(make(crystal(), LENNARD_JONES, {"kind": kind, "radius": 2.3, **switch}))
        wrapped, _ = wrap_positions(simulation.cell, simulation.positions)
        table = simulation.verlet_list().build(wrapped, simulation.cell)
        tables, x = simulation.tables(table), jnp.asarray(wrapped[table.order].T)
        jax.make_jaxpr(partial(simulation.force, decisions=True))(x, tables)
        return sources[0]

    seen = source()
    monkeypatch.setattr(kernel, "_divide_once", lambda *_: None)
    assert source() == seen


def test_what_has_no_vectors_is_left_to_xla_and_named(caplog, tmp_path):
    """The operation is named once in the log, and in every run's summary and findings."""

    def mine(r, strength):
        return strength * jnp.sinh(-r)

    for k in range(2):
        simulation = mdnum.simulation(
            crystal(),
            mdnum.PairFunction(mine, strength=1e-3),
            mdnum.Cut("shifted", 2.3),
            timestep=0.002,
            skin=0.2,
        )
        run = mdnum.run(simulation, steps=2, check=False, report=False, out=tmp_path / str(k))
        assert run.summary["not_compiled"] == "sinh"
        assert "NOT_COMPILED" in [finding.code for finding in run.verdict.findings]

    # another function of the same name
    def mine(r, strength):
        return strength / r

    cut = mdnum.Cut("shifted", 2.3)
    own = mdnum.PairFunction(mine, strength=1e-3)
    other = mdnum.simulation(crystal(), own, cut, timestep=0.002, skin=0.2)
    assert kernel.left_out(other.potential) is None and kernel.left_out(simulation.potential) == "sinh"
    named = [one for one in caplog.records if one.name == "mdnum.md.kernel"]
    assert len(named) == 1 and "sinh" in named[0].getMessage() and "mine" in named[0].getMessage()


@jax.custom_jvp
def own_rule(x):
    return x * x


own_rule.defjvp(lambda primals, tangents: (own_rule(*primals), 2 * primals[0] * tangents[0]))


@pytest.mark.parametrize(
    "term",
    [
        lambda r2, c: jnp.sinh(-r2),
        lambda r2, c: r2.astype(jnp.float32).astype(jnp.float64),
        lambda r2, c: jnp.where(r2.astype(jnp.int64) > 1, r2, 0.0),
        lambda r2, c: jnp.tanh(r2 * jnp.arange(3.0)) @ jnp.ones(3),
        # a program of its own
        lambda r2, c: jax.lax.cond(r2 > c, lambda x: x, lambda x: 2 * x, r2),
    ],
)
def test_what_is_not_known_is_told(term):
    """Anybody's cutoff comes here: what has no counterpart is left to XLA, and never an error."""
    tables = Tables(jnp.zeros((1, 8, 2), jnp.int32), None, jnp.arange(2))

    def summed(x, c):
        return kernel.over_pairs(lambda a, b, types: (term((b[0] - a[0]) ** 2, c),), x, tables)

    assert jax.jit(summed)(jnp.zeros((3, 2)), jnp.float64(1.5)) is None


@pytest.mark.parametrize(
    "term",
    [
        # a decision that is the same for all pairs, and decisions that are compared
        lambda r2, c: jnp.where(c > 1, r2, 2 * r2),
        lambda r2, c: jnp.where((r2 > c) == (r2 > 1), r2, 0.5),
        lambda r2, c: jnp.where((r2 > c) != (c > 1), r2, 0.5) + (r2 > 2).astype(jnp.float64) * r2,
        # functions with derivatives of their own
        lambda r2, c: own_rule(c) * own_rule(r2),
        lambda r2, c: jnp.floor(r2) + jnp.ceil(3 * r2) + jnp.clip(r2, 0.5, c) + jnp.sign(r2 - c),
    ],
)
def test_decisions_and_steps_are_those_of_jax(term):
    index = np.full((1, 8, 11), 11, np.int32)
    index[0, 0] = np.arange(11)
    tables = Tables(jnp.asarray(index), None, jnp.arange(11))

    def pair(own, other, types, c):
        return (jnp.where(other[0] == other[0], term(other[0], c), 0.0),)

    x, c = jnp.linspace(0.1, 4.0, 11), jnp.float64(1.5)
    made = jax.jit(lambda x, c: kernel.over_pairs(partial(pair, c=c), x[None], tables).sums[0])(x, c)
    assert np.array_equal(made, term(x, c))


def test_another_interface_is_not_met_with_guesses(tmp_path, monkeypatch):
    header = tmp_path / "xla" / "ffi" / "api" / "c_api.h"
    header.parent.mkdir(parents=True)
    header.write_text("#define XLA_FFI_API_MAJOR 0\n#define XLA_FFI_API_MINOR 9\n")
    assert foreign.known()
    foreign.known.cache_clear()
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    try:
        assert not foreign.known()
    finally:
        foreign.known.cache_clear()


@pytest.mark.parametrize("columns", [1, 3, 4, 5, 9])
@pytest.mark.parametrize("atoms", [1, 8, 37])
def test_sums_are_slot_after_slot_whatever_the_vectors(columns, atoms):
    rng = np.random.default_rng(atoms + columns)
    index = rng.integers(0, atoms + 1, (3, 8, atoms)).astype(np.int32)
    # eight slots of padding are passed over, but not where one atom has a neighbor in the last of them
    index[1, :, : atoms - 5] = atoms
    index[1, 7, 9:10] = 0
    values = rng.normal(size=(columns, atoms))
    tables = Tables(jnp.asarray(index), None, jnp.arange(atoms))

    def pair(own, other, types):
        # not a number where the slot is padding
        gap = sum(((b - a) * k for k, (a, b) in enumerate(zip(own, other, strict=True), 1)), 0.0)
        return jnp.where(gap == gap, gap, 0.0), 0.5 - gap

    made = jax.jit(lambda values: kernel.over_pairs(pair, values, tables, margins=">"))(jnp.asarray(values))
    padded = np.concatenate([values, np.full((columns, 1), np.nan)], axis=1)
    gaps = np.zeros((24, atoms))
    for k in range(columns):
        gaps = gaps + (padded[k, index.reshape(24, atoms)] - values[k]) * (k + 1)
    total = np.zeros(atoms)
    for gap in gaps:
        total = total + np.where(np.isnan(gap), 0.0, gap)
    assert np.array_equal(made.sums[0], total)
    bits = np.packbits((0.5 - gaps > 0).reshape(3, 8, atoms), axis=1, bitorder="little")[:, 0]
    assert np.array_equal(made.decisions.bits, bits)
    assert made.decisions.nearest == np.nanmin(np.abs(0.5 - gaps), initial=np.inf)
