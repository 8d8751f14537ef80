"""Pair forces over a list, against all pairs in plain numpy; and the decision on record is the one used."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from ase import Atoms
from oracles import COMPARISONS, all_pairs
from rollout.harness import evaluated, liquid, listed, nearest, write_system
from small_systems import LENNARD_JONES, make

from mdnum.errors import InputError
from mdnum.md.cutoffs import CUTOFFS
from mdnum.md.decide import PairDecider
from mdnum.md.pairforce import MdState, PairDynamics
from mdnum.numerics import count_set, set_bits
from mdnum.numerics.exact import zero_bits
from mdnum.rollout.engine import Engine, first_state
from mdnum.systems import load
from mdnum.systems.build import build

PAIRS = {
    "Ar-Ar": {"sigma": 1.0, "epsilon": 1.0},
    "Ar-Ne": {"sigma": 0.9, "epsilon": 1.2},
    "Ne-Ne": {"sigma": 0.85, "epsilon": 0.6},
}
RADII = {"Ar-Ar": 1.9, "Ar-Ne": 1.7, "Ne-Ne": 1.55}
ONSET = 0.8  # of each radius


def cut_energy(kind, r, sigma, epsilon, rc):
    """u(r) of a cut Lennard-Jones pair, also for complex r: its derivative comes from a complex step."""

    def u(x):
        return 4 * epsilon * ((sigma / x) ** 12 - (sigma / x) ** 6)

    def slope(x):
        return -24 * epsilon * (2 * sigma**12 / x**13 - sigma**6 / x**7)

    ro = ONSET * rc
    cut = oracles.cut_energy(kind, r, rc, ro, u, slope)
    return np.where(r.real > ro, cut, u(r)) if CUTOFFS.parse(kind).switches else cut


def reference(kind, atoms):
    """Energy, forces, energy of each atom and sum of r ⊗ F over pairs."""
    i, j, d = all_pairs(atoms.positions, atoms.cell.array, atoms.pbc)
    symbols = np.array(atoms.get_chemical_symbols())
    keys = ["-".join(sorted(pair)) for pair in zip(symbols[i], symbols[j], strict=True)]
    sigma, epsilon = (np.array([PAIRS[key][name] for key in keys]) for name in ("sigma", "epsilon"))
    rc = np.array([RADII[key] for key in keys])
    r = np.linalg.norm(d, axis=1)
    near = r < rc
    i, j, d, r = i[near], j[near], d[near], r[near]
    constants = (sigma[near], epsilon[near], rc[near])
    energy = cut_energy(kind, r.astype(complex), *constants).real
    slope = cut_energy(kind, r + 1e-30j, *constants).imag / 1e-30
    pull = (slope / r)[:, None] * d
    forces, energies = np.zeros_like(atoms.positions), np.zeros(len(atoms))
    np.add.at(forces, i, pull)
    np.add.at(forces, j, -pull)
    np.add.at(energies, i, energy / 2)
    np.add.at(energies, j, energy / 2)
    return (
        energy.sum(),
        forces,
        energies,
        -np.einsum("pa,pb->ab", d, pull),
        set(zip(i.tolist(), j.tolist(), strict=True)),
    )


def compare(simulation, kind, atoms):
    found = simulation.evaluate()
    energy, forces, energies, virial, pairs = reference(kind, atoms)
    scale = np.abs(forces).max()
    assert found.energy == pytest.approx(energy, rel=1e-13)
    assert np.max(np.abs(found.forces - forces)) < 1e-12 * scale
    assert np.max(np.abs(found.forces.sum(axis=0))) < 1e-12 * np.abs(forces).sum()
    assert np.max(np.abs(found.energies - energies)) < 1e-12 * np.abs(energies).max()
    # stress is minus the virial by volume, in ASE's sign
    assert np.allclose(found.stress * atoms.get_volume(), -virial, rtol=0, atol=1e-12 * np.abs(virial).max())
    assert set(zip(found.i.tolist(), found.j.tolist(), strict=True)) == pairs
    i, j, d = all_pairs(atoms.positions, atoms.cell.array, atoms.pbc)
    distance = dict(zip(zip(i.tolist(), j.tolist(), strict=True), np.linalg.norm(d, axis=1), strict=True))
    assert np.allclose(found.distance, [distance[k] for k in zip(found.i, found.j, strict=True)], rtol=1e-13)


def mixture(tilt, pbc=True, seed=3):
    atoms = liquid(tilt=tilt, rattle=0.05, seed=seed)
    atoms.symbols[np.random.default_rng(seed).random(len(atoms)) < 0.35] = "Ne"
    # a few atoms out of the box: nothing may depend on it
    atoms.pbc = pbc
    shifts = np.random.default_rng(seed).integers(-2, 3, (len(atoms), 3)) * np.broadcast_to(pbc, 3)
    atoms.positions += shifts @ atoms.cell.array
    return atoms


def tables(kind):
    onset = {"onset": ONSET * 1.9} if CUTOFFS.parse(kind).switches else {}
    return {
        "potential": {"kind": "lennard-jones", "pairs": PAIRS, "sigma": 1.0, "epsilon": 1.0},
        "cutoff": {"kind": kind, "radius": 1.9, "pairs": RADII, **onset},
    }


ALWAYS, SLAB, NEVER = (True, True, True), (True, False, True), (False, False, False)
#: Formulas are in test_cutoffs: here a program is compiled for each kind and box.
CASES = [
    ("quintic", ALWAYS, "host", ()),
    ("hard", NEVER, "host", pytest.mark.slow),
    *((kind, ALWAYS, "host", pytest.mark.nightly) for kind in CUTOFFS if kind != "quintic"),
    *(("quintic", pbc, "host", pytest.mark.nightly) for pbc in (SLAB, NEVER)),
    ("switched", SLAB, "jax-md", (pytest.mark.slow, pytest.mark.jax_md)),
]


@pytest.mark.filterwarnings("ignore:scatter inputs")
@pytest.mark.parametrize(
    ("kind", "pbc", "builder"), [pytest.param(*case, marks=marks) for *case, marks in CASES]
)
def test_a_mixture_in_a_tilted_box(tmp_path, kind, pbc, builder):
    assert {kind for kind, *_ in CASES} == set(CUTOFFS)
    atoms = mixture(tilt=True, pbc=pbc)
    path = write_system(tmp_path, atoms, **tables(kind), neighbors={"builder": builder})
    compare(build(load(path)), kind, atoms)


def test_stress_is_the_derivative_of_the_energy_by_strain(tmp_path):
    atoms = mixture(tilt=True)
    simulation = build(load(write_system(tmp_path, atoms, **tables("quintic"))))
    stress = simulation.evaluate().stress
    for a, b in ((0, 0), (1, 1), (0, 1), (2, 0)):
        energies = []
        for h in (1e-5, -1e-5):
            strain = np.eye(3)
            strain[a, b] += h / 2
            strain[b, a] += h / 2
            energies.append(simulation.evaluate(atoms.positions @ strain, atoms.cell.array @ strain).energy)
        slope = (energies[0] - energies[1]) / 2e-5 / atoms.get_volume()
        assert slope == pytest.approx(stress[a, b], rel=1e-6, abs=1e-6)
    assert np.array_equal(stress, stress.T)


def forces_over(simulation, positions, skin=0.2):
    """One evaluation over a list with a skin: forces, decisions, and the list."""
    x, table, tables = listed(simulation, skin, positions)
    return evaluated(simulation.force, x, tables), table


def counted(simulation, positions):
    """How many pairs the energy holds: hard less shifted is u(r_cut) for each of them."""
    hard, _ = forces_over(simulation, positions)
    shifted, _ = forces_over(simulation.with_cutoff("shifted"), positions)
    assert np.array_equal(hard.force, shifted.force)
    assert np.array_equal(hard.decisions.bits, shifted.decisions.bits)
    jump = float(simulation.jumps()[0][0])
    number = float(jnp.sum(hard.energy) - jnp.sum(shifted.energy)) / jump
    assert number == pytest.approx(round(number), abs=1e-6)
    return round(number), int(count_set(np.asarray(hard.decisions.bits))) // 2


def shell(shift=0.0):
    """An fcc crystal of 108 atoms with its 324 second neighbors at 1.75, all of it exact in binary."""
    from ase.build import bulk

    atoms = bulk("Ar", "fcc", a=1.75, cubic=True) * (3, 3, 3)
    atoms.positions += shift
    return atoms


@pytest.mark.parametrize(
    "compare",
    [
        pytest.param(c, marks={"r <": pytest.mark.nightly, "r <=": pytest.mark.slow}.get(c, ()))
        for c in COMPARISONS
    ],
)
def test_at_the_cutoff_the_convention_decides_and_the_energy_follows(tmp_path, compare):
    path = write_system(
        tmp_path, shell(), cutoff={"radius": 1.75, "compare": compare}, neighbors={"skin": 0.2}
    )
    simulation = build(load(path))
    in_energy, recorded = counted(simulation, simulation.positions)
    assert in_energy == recorded == (648 + 324 if compare.endswith("<=") else 648)


def test_the_energy_follows_the_recorded_decision_where_another_precision_would_differ(tmp_path):
    """Distances that float32 cannot tell from the cutoff: the float64 forces obey the float32 decision."""
    rng = np.random.default_rng(6)
    atoms = shell(shift=0.3)
    atoms.positions += rng.normal(0, 3e-8, atoms.positions.shape)
    path = write_system(tmp_path, atoms, cutoff={"radius": 1.75}, neighbors={"skin": 0.2})
    results = {}
    for decision in ("float64", "float32"):
        simulation = build(load(path, {"precision.decision": decision}))
        results[decision] = counted(simulation, simulation.positions)
        assert results[decision][0] == results[decision][1]
    assert results["float64"] != results["float32"]
    _, _, d = all_pairs(atoms.positions, atoms.cell.array, (True,) * 3)
    assert results["float64"][0] == int(((d**2).sum(axis=1) < 1.75**2).sum())


def test_listed_pairs_beyond_the_cutoff_add_nothing_not_even_when_the_list_is_padded(tmp_path):
    atoms = liquid(rattle=0.05)
    simulation = build(load(write_system(tmp_path, atoms)))
    narrow, _ = forces_over(simulation, simulation.positions, skin=0.0)
    wide, table = forces_over(simulation, simulation.positions, skin=0.5)
    assert table.pairs > int(count_set(np.asarray(narrow.decisions.bits))) // 2
    assert float(jnp.sum(wide.energy)) == pytest.approx(float(jnp.sum(narrow.energy)), rel=1e-14)
    slots, columns = set_bits(np.asarray(wide.decisions.bits))
    # padding is never decided to be inside
    assert np.all(table.index[slots, columns] < len(atoms))
    # the nearest margin is that of all listed pairs
    _, _, d = all_pairs(atoms.positions, atoms.cell.array, (True,) * 3)
    nearest = np.abs(4.0 - (d**2).sum(axis=1)).min()
    assert float(wide.decisions.nearest) == pytest.approx(nearest, rel=1e-9)


def test_two_atoms_on_one_spot_are_seen_and_not_hidden_by_padding(tmp_path):
    from ase import Atoms

    atoms = Atoms("Ar3", positions=[[1, 1, 1], [2.5, 1, 1], [6, 6, 6.0]], cell=[9.0] * 3, pbc=True)
    simulation = build(load(write_system(tmp_path, atoms)))
    finite, _ = forces_over(simulation, simulation.positions)
    assert np.all(np.isfinite(finite.force)) and float(jnp.sum(finite.energy)) < 0
    on_top = np.array([[1, 1, 1], [1, 1, 1], [6, 6, 6.0]])
    singular, _ = forces_over(simulation, on_top)
    assert not np.isfinite(float(jnp.sum(singular.energy)))
    assert float(singular.decisions.nearest) == 4.0


# --- a step, as forks and gradients make it -------------------------------------------------------------


@pytest.fixture(scope="module")
def stepper():
    """The crystal, its dynamics over a list, and where it starts."""
    simulation = build("argon/crystal-108")
    start = first_state(simulation)
    table = simulation.verlet_list().build(start.reference, simulation.cell)
    masses = jnp.asarray(simulation.masses[table.order])
    dynamics = PairDynamics(simulation.force, simulation.integrator, masses, simulation.tables(table))
    state = MdState(jnp.zeros((), jnp.int64), start.state.x[:, table.order], start.state.v[:, table.order])
    return simulation, dynamics, state


def test_told_its_own_decisions_a_step_is_that_of_the_rollout(stepper):
    simulation, dynamics, state = stepper
    advance = jax.jit(lambda s: dynamics.step(s, dynamics.decide(s)))
    for _ in range(40):
        state = advance(state)
    (segment,) = list(Engine(simulation, 40).segments())
    # two compiled programs of one arithmetic: the contraction of a*b + c may differ in the last bit
    assert np.allclose(np.asarray(state.x), segment.rows_of("x")[40], rtol=0, atol=1e-13)
    decided = np.asarray(dynamics.decide(state))
    assert np.array_equal(decided, segment.rows_of("bits")[40])
    # margins have the sign of the decision
    inside = np.asarray(dynamics.margins(state)).reshape(-1, 8, state.x.shape[1]) > 0
    assert np.array_equal(np.packbits(inside, axis=1, bitorder="little")[:, 0], decided)


def test_a_flipped_decision_takes_its_term_out_of_both_sums(stepper):
    simulation, dynamics, state = stepper
    own = evaluated(dynamics.force, state.x, dynamics.tables)
    same = evaluated(dynamics.force, state.x, dynamics.tables, given=own.decisions.bits)
    assert np.array_equal(np.asarray(own.force), np.asarray(same.force))
    bits, index = np.array(own.decisions.bits), np.asarray(dynamics.tables.index).reshape(-1, 108)
    slot = next(k for k in range(index.shape[0]) if (bits[k // 8, 0] >> (k % 8)) & 1)
    other = int(index[slot, 0])
    back = int(np.flatnonzero(index[:, other] == 0)[0])
    for k, atom in ((slot, 0), (back, other)):
        bits[k // 8, atom] ^= np.uint8(1 << (k % 8))
    told = evaluated(dynamics.force, state.x, dynamics.tables, given=jnp.asarray(bits))
    d = nearest(simulation, np.asarray(state.x)[:, other] - np.asarray(state.x)[:, 0])
    r2 = float(d @ d)
    pull = d * 24 * (r2**-4 - 2 * r2**-7)
    change = np.asarray(told.force) - np.asarray(own.force)
    assert np.sum(told.energy) - np.sum(own.energy) == pytest.approx(-4 * (r2**-6 - r2**-3), abs=1e-11)
    assert np.allclose(change[:, 0], -pull, rtol=0, atol=1e-11)
    assert np.allclose(change[:, other], pull, rtol=0, atol=1e-11)
    assert not np.delete(change, [0, other], axis=1).any()
    # what it would have decided itself is still told
    assert np.array_equal(np.asarray(told.decisions.bits), np.asarray(own.decisions.bits))


# --- the decision in jit and on the host: one arithmetic, one answer ------------------------------------


def displacements(dtype, count=20_000, r_cut=2.5):
    """Random vectors, half of them within a few ulps of the cutoff."""
    rng = np.random.default_rng(9)
    d = rng.normal(size=(count, 3))
    length = r_cut * (1 + np.finfo(dtype).eps * rng.integers(-4, 5, count))
    length[::2] = rng.uniform(0.5, 4.0, len(length[::2]))
    return (d / np.linalg.norm(d, axis=1)[:, None] * length[:, None]).astype(dtype).T


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("compare", COMPARISONS)
def test_jit_and_host_compute_one_quantity_and_one_decision(dtype, compare):
    decider = PairDecider((2.5,), compare, np.dtype(dtype).name)
    dx, dy, dz = displacements(dtype)
    on_host = decider.host_quantity(dx, dy, dz)
    assert on_host.dtype == dtype

    @jax.jit
    def in_jit(x, y, z, zero):
        quantity = decider.quantity(x, y, z, zero)
        return quantity, decider.inside(quantity, decider.values()[0])

    quantity, inside = in_jit(*map(jnp.asarray, (dx, dy, dz)), zero_bits(dtype))
    assert np.array_equal(np.asarray(quantity), on_host)
    threshold = decider.thresholds[0]
    assert np.array_equal(np.asarray(inside), threshold.decide(on_host.astype(np.float64)))
    margin = threshold.margin(on_host.astype(np.float64))
    assert np.array_equal(margin >= 0 if compare.endswith("<=") else margin > 0, np.asarray(inside))
    assert threshold.space == decider.space == compare.split()[0]
    # the sample sits on both sides
    assert 0.2 < np.mean(np.asarray(inside)) < 0.8


def test_thresholds_are_the_numbers_the_program_compares_with():
    radius = 2.1 / 1.3
    assert PairDecider((radius,), "r2 <").thresholds[0].value == radius * radius
    assert PairDecider((radius,), "r <").thresholds[0].value == radius
    narrow = np.float32(radius)
    assert PairDecider((radius,), "r2 <", "float32").thresholds[0].value == float(narrow * narrow)
    several = PairDecider((2.5, 2.0, 2.2), "r2 <=")
    assert [t.value for t in several.thresholds] == [6.25, 4.0, 2.2 * 2.2]
    assert np.array_equal(several.values(), [6.25, 4.0, 2.2 * 2.2])


def test_an_unknown_convention_is_refused():
    with pytest.raises(InputError, match="r3 <"):
        PairDecider((1.0,), "r3 <")


@pytest.mark.parametrize(
    "precision", [{}, dict.fromkeys(("state", "force", "decision"), "float32"), {"state": "lattice"}]
)
def test_a_list_of_no_pair_has_no_nearest_one(precision):
    """The slots that fill a table up are near to no threshold, with forces and without."""
    atoms = Atoms("Ar3", [[0, 0, 0], [5, 0, 0], [0, 6, 0]], cell=[20] * 3, pbc=True)
    simulation = build(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 2.2}, precision=precision))
    table = simulation.verlet_list().build(simulation.positions, simulation.cell)
    x = jnp.asarray(simulation.positions[table.order].T, simulation.policy.dtype("state"))
    tables, force = simulation.tables(table), simulation.force
    made = force(x, tables, decisions=True).decisions
    assert np.isinf(made.nearest) and np.isinf(force.decide(x, tables).nearest)
