"""Pair terms that add: against sums over all pairs in numpy, which have no code of mdnum."""

from __future__ import annotations

from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk

import mdnum
from mdnum import Cut, InputError, LennardJones, PairFunction, PrecisionPolicy, Term
from mdnum.md import pairforce
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.store import RunFolder

SIGMA = {"Ar-Ar": 3.4, "Ar-Kr": 3.5, "Kr-Kr": 3.6}
DEPTH = {"Ar-Ar": 0.0104, "Ar-Kr": 0.012, "Kr-Kr": 0.014}
#: Radii by pair of species: of a core, and of two tails, one that shares its decisions.
CORE = {"Ar-Ar": 7.0, "Ar-Kr": 7.4, "Kr-Kr": 6.6}
TAIL = {"Ar-Ar": 9.2, "Ar-Kr": 8.0, "Kr-Kr": 9.6}


def repulsion(r2, sigma, epsilon):
    """The first half of Lennard-Jones."""
    s6 = (sigma * sigma / r2) ** 3
    return 4 * epsilon * s6 * s6


def attraction(r2, sigma, epsilon):
    """The second half of Lennard-Jones."""
    return -4 * epsilon * (sigma * sigma / r2) ** 3


def yukawa(r, strength, kappa):
    """A screened charge; of its exponential the loop over a list in LLVM knows nothing."""
    return strength * jnp.exp(-kappa * r) / r


def inverse(r, strength):
    """A charge."""
    return strength / r


# --- the same by hand -------------------------------------------------------------------------------------


def by_hand_lj(r, sigma, epsilon):
    s6 = (sigma / r) ** 6
    return 4 * epsilon * (s6 * s6 - s6), -24 * epsilon * (2 * s6 * s6 - s6) / r


def by_hand_yukawa(r, strength, kappa):
    u = strength * np.exp(-kappa * r) / r
    return u, -u * (kappa + 1 / r)


def by_hand_inverse(r, strength):
    return strength / r, -strength / r**2


def by_hand(atoms, terms, x=None):
    """Energy, forces, virial tensor and decisions of `terms`: (u and u', kind, radii, weights) each.

    The decision of term t on pair (i, j), i < j, is inside[t][i, j].
    """
    x, length = atoms.positions if x is None else x, np.diag(atoms.cell.array)
    symbols, n = np.array(atoms.get_chemical_symbols()), len(atoms)
    energy, forces, virial = 0.0, np.zeros((n, 3)), np.zeros((3, 3))
    inside = [np.zeros((n, n), bool) for _ in terms]
    i, j = np.triu_indices(n, 1)
    d = x[j] - x[i]
    d = d - length * np.rint(d / length)
    square = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
    of_pair = np.array(["-".join(sorted(both)) for both in zip(symbols[i], symbols[j], strict=True)])
    for (function, kind, radii, weights), own in zip(terms, inside, strict=True):
        for pair, cut in radii.items():
            at = np.flatnonzero((of_pair == pair) & (square < cut * cut))
            own[i[at], j[at]] = True
            r = np.sqrt(square[at])
            (u, du), (end, _) = function(r, pair), function(cut, pair)
            w = 1.0 if weights is None else weights[i[at]] * weights[j[at]]
            energy += np.sum(w * (u - end if kind == "shifted" else u))
            pull = (w * du / r)[:, None] * d[at]
            np.add.at(forces, i[at], pull)
            np.add.at(forces, j[at], -pull)
            virial -= d[at].T @ pull
    return energy, forces, virial, inside


def mixture():
    atoms = bulk("Ar", "fcc", a=5.5, cubic=True).repeat(4)
    rng = np.random.default_rng(4)
    atoms.symbols[rng.choice(len(atoms), 90, replace=False)] = "Kr"
    atoms.positions += rng.normal(0, 0.15, atoms.positions.shape)
    return atoms


def mixed_terms(weights):
    """Of mdnum and by hand: three terms, of which two have one decision and one has weights."""
    ours = {
        "core": Term(LennardJones(sigma=SIGMA, epsilon=DEPTH), Cut("hard", CORE)),
        "tail": Term(PairFunction(inverse, strength=0.05), Cut("hard", TAIL), weight=weights),
        "screen": Term(PairFunction(yukawa, strength=0.3, kappa=0.4), Cut("shifted", TAIL)),
    }
    hand = [
        (lambda r, pair: by_hand_lj(r, SIGMA[pair], DEPTH[pair]), "hard", CORE, None),
        (lambda r, pair: by_hand_inverse(r, 0.05), "hard", TAIL, weights),
        (lambda r, pair: by_hand_yukawa(r, 0.3, 0.4), "shifted", TAIL, None),
    ]
    return ours, hand


WEIGHTS = np.random.default_rng(8).normal(0, 1, 256)


def made(*names, weights=WEIGHTS, **options):
    """A simulation of some of the terms, with the same by hand."""
    ours, hand = mixed_terms(weights)
    options = {"timestep": 0.004, "temperature": 150, "seed": 2, "skin": 0.6, **options}
    chosen = {name: ours[name] for name in names}
    return mdnum.simulation(mixture(), chosen, **options), [
        one for name, one in zip(ours, hand, strict=True) if name in names
    ]


def check(simulation, hand):
    """An evaluation by both."""
    energy, forces, virial, _ = by_hand(simulation.structure, hand)
    found = simulation.evaluate()
    scale = np.abs(forces).max()
    np.testing.assert_allclose(found.energy, energy, rtol=1e-12)
    np.testing.assert_allclose(found.forces, forces, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(
        found.stress, -virial / simulation.cell.volume, rtol=0, atol=1e-12 * np.abs(found.stress).max()
    )
    np.testing.assert_allclose(found.energies.sum(), energy, rtol=1e-12)


@pytest.mark.parametrize(
    "names", [("core",), ("tail", "screen"), ("core", "tail"), ("core", "screen"), ("core", "tail", "screen")]
)
def test_energy_forces_and_stress_are_those_of_all_pairs(names):
    check(*made(*names))


def test_a_forgotten_weight_is_seen():
    simulation, hand = made("core", "tail")
    jax.clear_caches()
    with (
        patch.object(pairforce, "factors", lambda model, products: []),
        pytest.raises(AssertionError, match="Not equal to tolerance"),
    ):
        check(simulation, hand)
    jax.clear_caches()


def test_terms_of_half_the_precision():
    simulation, hand = made("core", "tail", precision=PrecisionPolicy("float32", "float32"))
    energy, forces, *_ = by_hand(simulation.structure, hand)
    found = simulation.evaluate()
    assert abs(found.energy - energy) < 1e-5 * abs(energy) + 1e-4
    np.testing.assert_allclose(found.forces, forces, atol=1e-5 * np.abs(forces).max())


# --- flips ------------------------------------------------------------------------------------------------


def recorded(simulation, steps, rows):
    """The columns of flips of a run, and its positions at every step where they leave the loop."""
    recorder, parts, x = PairRecorder(simulation), [], []
    for segment in Engine(simulation, steps, rows=rows).segments():
        ledger = recorder.flips(segment)
        parts.append({**ledger.columns(), **simulation.first_atoms(ledger.i)})
        if rows:
            x += [segment.unsorted("x", row) for row in range(segment.rows)]
    names = [name for name in parts[0] if name != "decided_by"]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}, x


def flips_by_hand(simulation, hand, x, named):
    """{(step, i, j, terms, entered): energy jump} from decisions of all pairs; terms of one radius as one."""
    found, before, symbols = {}, None, simulation.structure.get_chemical_symbols()
    for step, positions in enumerate(x):
        *_, inside = by_hand(simulation.structure, hand, positions)
        for terms, own in named.items() if before is not None else ():
            for i, j in np.argwhere(inside[own[0]] != before[own[0]]).tolist():
                entered, pair = bool(inside[own[0]][i, j]), "-".join(sorted((symbols[i], symbols[j])))
                jump = 0.0
                for function, kind, radii, weights in (hand[t] for t in own):
                    w = 1.0 if weights is None else weights[i] * weights[j]
                    jump += 0.0 if kind == "shifted" else w * function(radii[pair], pair)[0]
                found[step, i, j, terms, entered] = jump if entered else -jump
        before = inside
    return found


def compare_flips(table, expected):
    keys = zip(*(table[name].tolist() for name in ("step", "i", "j", "terms", "entered")), strict=True)
    found = dict(zip(keys, table["energy_jump"].tolist(), strict=True))
    assert found.keys() == expected.keys()
    np.testing.assert_allclose([found[key] for key in expected], list(expected.values()), rtol=1e-10)


@pytest.fixture(scope="module")
def three_terms():
    simulation, hand = made("core", "tail", "screen")
    table, x = recorded(simulation, 24, rows=True)
    return simulation, table, flips_by_hand(simulation, hand, x, {"core": [0], "tail + screen": [1, 2]})


def test_flips_are_those_of_all_pairs(three_terms):
    simulation, table, expected = three_terms
    assert len(expected) > 100 and {key[3] for key in expected} == {"core", "tail + screen"}
    compare_flips(table, expected)
    # and where the loop notes changes alone
    changes, _ = recorded(simulation, 24, rows=False)
    for name, column in table.items():
        np.testing.assert_array_equal(changes[name], column)


@pytest.mark.nightly
def test_changes_that_no_host_notes_have_their_terms():
    """In single precision jax notes what changed, on a CPU too."""
    simulation, _ = made(
        "core", "tail", precision=PrecisionPolicy("float32", "float32", "float32", "float32")
    )
    (rows, _), (changes, _) = (recorded(simulation, 24, rows=rows) for rows in (True, False))
    assert set(rows["terms"].tolist()) == {"core", "tail"}
    for name, column in rows.items():
        np.testing.assert_array_equal(changes[name], column)


def test_a_flip_of_another_term_is_seen(three_terms):
    _, table, expected = three_terms
    other = np.where(table["terms"] == "core", "tail + screen", "core")
    with pytest.raises(AssertionError):
        compare_flips({**table, "terms": other}, expected)


@pytest.mark.nightly
def test_a_run_closes_its_budget_and_agrees_with_an_independent_sum(tmp_path):
    simulation, _ = made("core", "tail", "screen")
    summary = mdnum.run(simulation, steps=60, out=tmp_path / "run").summary
    assert summary["ase"]["ok"] and summary["energy_budget_closes"] and summary["algebra_residual"] == 0
    assert abs(summary["energy_budget_residual"]) < 1e-12
    assert summary["cutoff"]["kind"] == "hard + hard + shifted"
    assert set(RunFolder(tmp_path / "run").read("flips")["terms"].tolist()) == {"core", "tail + screen"}


# --- one term, and the halves of one ----------------------------------------------------------------------


def argon(potential, cutoff=None, **options):
    atoms = bulk("Ar", "fcc", a=5.4, cubic=True).repeat(4)
    return mdnum.simulation(atoms, potential, cutoff, timestep=0.004, temperature=140, **options)


LJ = LennardJones(sigma=3.405, epsilon=0.0103235)


@pytest.mark.parametrize("kind", ["hard", "switched", "force-shifted"])
def test_one_term_is_the_plain_potential_to_the_bit(kind):
    plain, term = argon(LJ, Cut(kind, 8.5)), argon({"only": Term(LJ, Cut(kind, 8.5))})
    a, b = (recorded(one, 60, rows=True) for one in (plain, term))
    np.testing.assert_array_equal(a[1], b[1])
    assert a[0].keys() == b[0].keys() and len(a[0]["step"])
    for name in a[0]:
        np.testing.assert_array_equal(a[0][name], b[0][name])


@pytest.mark.parametrize("kind", ["hard", "switched"])
def test_the_halves_of_lennard_jones_are_lennard_jones(kind):
    halves = {
        name: Term(PairFunction(half, sigma=3.405, epsilon=0.0103235), Cut(kind, 8.5))
        for name, half in (("repulsive", repulsion), ("attractive", attraction))
    }
    plain, sums = argon(LJ, Cut(kind, 8.5)), argon(halves)
    np.testing.assert_allclose(sums.jumps(), plain.jumps(), rtol=1e-12)
    a, b = (recorded(one, 60, rows=True) for one in (plain, sums))
    np.testing.assert_allclose(b[1], a[1], rtol=0, atol=1e-10)
    for name in ("step", "i", "j", "entered"):
        np.testing.assert_array_equal(a[0][name], b[0][name])


# --- what terms cannot have -------------------------------------------------------------------------------


def test_what_terms_cannot_have_is_refused():
    pair = {"a": Term(LJ, Cut("hard", 8.5)), "b": Term(LJ, Cut("hard", 7.5))}
    for policy in (PrecisionPolicy("lattice"), PrecisionPolicy(force="bfloat16")):
        with pytest.raises(InputError, match=r"lattice|bfloat16"):
            argon(pair, precision=policy)
    with pytest.raises(InputError, match="'r <'"):
        argon({**pair, "c": Term(LJ, Cut("hard", 7.0, compare="r <"))})
    with pytest.raises(InputError, match="no term"):
        argon({})
    with pytest.raises(InputError, match=r"a\.b"):
        argon({"a.b": pair["a"]})
    with pytest.raises(InputError, match=r"terms\.a\.weight.*256"):
        argon({"a": Term(LJ, Cut("hard", 8.5), weight=np.ones(3))})
    with pytest.raises(InputError, match=r"terms\.a\.weight.*Ar"):
        argon({"a": Term(LJ, Cut("hard", 8.5), weight={"Kr": 1.0})})
    with pytest.raises(InputError, match="carries its own cutoff"):
        argon(pair, Cut("hard", 8.5))
