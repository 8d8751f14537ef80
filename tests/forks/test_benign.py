"""Benign or not: a changed model is seen and named, another rounding is not."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import comb

import equinox as eqx
import jax
import numpy as np
import pytest
from forks.harness import pair

from mdnum.errors import InputError
from mdnum.forks import benign as rules
from mdnum.forks.benign import Calibration, Planted, Window, benign, calibrate, choose
from mdnum.forks.ensemble import (
    ensemble,
    feature_names,
    hats,
    measure,
    nodes_of,
    noise_size,
    pair_distances,
    planted,
    shorter,
    starts,
    stretches,
)
from mdnum.rollout.engine import first_state
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

# ensembles
pytestmark = pytest.mark.slow

HOT = """
about = "A small hot Lennard-Jones fluid, melting."
units = "lj"
[structure]
builder = "fcc"
symbol = "Ar"
lattice_constant = 1.6796
repeat = [3, 3, 3]
[potential]
kind = "lennard-jones"
sigma = 1.0
epsilon = 1.0
[cutoff]
kind = "shifted"
radius = 2.2
[neighbors]
skin = 0.3
[dynamics]
kind = "nve"
timestep = 0.004
temperature = 1.44
steps = 1000
"""


@pytest.fixture(scope="module")
def hot(tmp_path_factory) -> Simulation:
    path = tmp_path_factory.mktemp("hot") / "hot.toml"
    path.write_text(HOT)
    return build(str(path))


@pytest.fixture(scope="module")
def calibrated(hot) -> Calibration:
    # jax-md's lists mix dtypes, and their search compiles for seconds: see the slow test
    changes = [change for change in planted(hot) if change.simulation.builder == "host"]
    # as the tests themselves, or their programs would be compiled twice
    with jax.numpy_dtype_promotion("strict"):
        return calibrate(hot, members=30, held_out=15, tries=1, steps=400, changes=changes)


def slower(a: Simulation, factor: float) -> Simulation:
    timestep = a.integrator.timestep * factor
    return replace(a, integrator=eqx.tree_at(lambda one: one.timestep, a.integrator, timestep))


def binomial_tail(count: int, of: int, rate: float) -> float:
    """Chance of so many or more."""
    p = Fraction(rate)
    return float(sum(comb(of, k) * p**k * (1 - p) ** (of - k) for k in range(count, of + 1)))


def test_a_calibrated_window_tells_models_from_rounding(calibrated):
    table = {one.change: one for one in calibrated.window.table}
    assert len(table) == 4
    assert calibrated.window.step == 400
    for name in ("time step + 2.5 %", "cutoff - 4 %"):
        assert table[name].must_fail and min(table[name].scores) > 5
    for name in ("forces in float32", "pairs in another order"):
        assert not table[name].must_fail and max(table[name].scores) < 2
    # the limit is a quantile: more false positives than these would be a rare accident
    assert binomial_tail(calibrated.alone + 1, 15, 0.1) > 1e-3
    assert calibrated.triples == 5 and calibrated.held_out == 15
    assert binomial_tail(calibrated.false_positives, 5, 0.04) > 1e-3
    low, high = calibrated.rate_bounds
    assert low <= calibrated.rate <= high and low <= rules.ACCEPTED


def deeper(a: Simulation) -> Simulation:
    potential = eqx.tree_at(lambda one: one.epsilon, a.potential, a.potential.epsilon * 1.01)
    return replace(a, model=eqx.tree_at(lambda one: one.potential, a.model, potential))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda a: replace(a, policy=replace(a.policy, force="float32")), None),
        # the same forces, so the same trajectory
        (lambda a: a.with_cutoff("hard"), range(1, 2)),
        # another well is seen in many features
        (deeper, range(2, 6)),
        # a run that blows up
        (lambda a: slower(a, 30), range(1)),
    ],
)
def test_another_model_is_named_and_another_rounding_is_benign(hot, calibrated, change, named):
    found = benign(pair(hot, change(hot), "changed"), calibration=calibrated)
    assert found.passed == (named is None) and len(found.failing) in (named or range(1))
    assert found.scores.shape == (3, found.components) and 2 <= found.components <= 10
    assert np.isnan(found.scores).all() == (named == range(1) and not found.passed)
    assert all(abs(z) > found.limit for z in found.failing.values())
    if len(found.failing) == 1:
        assert found.failing["potential energy"] < -100


def test_what_cannot_be_judged_is_refused(hot):
    noisy = build("argon/langevin-500")
    other = eqx.tree_at(lambda one: one.key, noisy.integrator, jax.random.key(99))
    harmless = [change for change in planted(hot) if not change.must_fail]
    for message, call in (
        ("108 and 864 atoms", lambda: benign(pair(hot, build("argon/liquid-864"), "another system"))),
        ("different random noise", lambda: benign(pair(noisy, replace(noisy, integrator=other), "noise"))),
        ("members = 5: ", lambda: calibrate(hot, members=5)),
        ("steps = 0", lambda: calibrate(hot, steps=0)),
        ("tries = 0", lambda: calibrate(hot, tries=0)),
        ("deliberate change", lambda: calibrate(hot, steps=100, changes=harmless)),
    ):
        with pytest.raises(InputError, match=message):
            call()


def window(step: int, seen: float, rounding: float) -> Window:
    space = rules.Space.of(np.random.default_rng(0).standard_normal((30, 4)))
    table = (
        Planted("time step + 2.5 %", True, int(seen > 1), 1, (seen,)),
        Planted("forces in float32", False, 2 * int(rounding > 1), 2, (rounding, rounding)),
    )
    return Window(step, space, 2.0, table)


def test_the_latest_clear_window_is_chosen():
    early, good, late = window(100, 500.0, 7.0), window(300, 50.0, 0.5), window(500, 4.0, 0.5)
    faint, blind = window(600, 1.5, 0.5), window(1000, 0.7, 0.5)
    assert choose([early, good, late, faint, blind], "it") is late
    assert choose([early, faint, blind], "it") is faint
    with pytest.raises(InputError, match=r"^it: .*after 100, 1000 steps"):
        choose([early, blind], "it")


def test_members_differ_by_ten_ulps_of_single_precision_and_share_one_program(hot):
    from mdnum.rollout.epoch import run_epoch

    begin = starts(hot, 4, 0)
    x = np.asarray(first_state(hot).state.x)
    ulp = float(np.spacing(np.float32(x.max())))
    for one in begin:
        moved = np.sqrt(((np.asarray(one.state.x) - x) ** 2).sum(axis=0))
        assert np.sqrt((moved**2).mean()) > 10 * ulp
        assert moved.max() == pytest.approx(noise_size(hot), rel=1e-6)
    nodes = nodes_of(hot, begin[0])
    ensemble(hot, begin[:1], [150, 170], nodes)
    before = run_epoch._cache_size()  # type: ignore[attr-defined]
    rows = ensemble(hot, begin, [150, 170], nodes)
    assert run_epoch._cache_size() == before  # type: ignore[attr-defined]
    # stopping on the way changes nothing
    straight = ensemble(hot, begin, [170], nodes)
    assert np.array_equal(rows[1], straight[0])


def test_features_are_those_of_the_last_step(hot):
    nodes = nodes_of(hot, first_state(hot))
    (segment,) = stretches(hot, first_state(hot), [130])
    assert segment.last == 130
    found = dict(zip(feature_names(nodes), measure(hot, segment, nodes), strict=True))
    x = np.asarray(segment.state.x_before).T
    # every pair by itself, in every image
    matrix = np.asarray(hot.cell.matrix)
    box = matrix.diagonal()
    d = x[:, None] - x[None]
    d -= box * np.round(d / box)
    r = np.sqrt((d**2).sum(-1))
    i, j = np.triu_indices(len(x), 1)
    inside = r[i, j] < 2.2
    one = r[i, j][inside]
    shift = 4 * (2.2**-12 - 2.2**-6)
    assert found["potential energy"] == pytest.approx((4 * (one**-12 - one**-6) - shift).sum(), rel=1e-10)
    pull = 4 * (12 * one**-12 - 6 * one**-6)
    volume = np.prod(box)
    pressure = (2 * found["kinetic energy"] + pull.sum()) / (3 * volume)
    assert found["pressure"] == pytest.approx(pressure, rel=1e-10)
    force = np.zeros_like(x)
    np.add.at(force, i[inside], (pull / one**2)[:, None] * d[i, j][inside])
    np.add.at(force, j[inside], -(pull / one**2)[:, None] * d[i, j][inside])
    square = (force**2).sum(1)
    assert found["root mean square force"] == pytest.approx(np.sqrt(square.mean()), rel=1e-10)
    reach = float(nodes[-1])
    mine = np.sort(pair_distances(hot, x, reach))
    assert mine == pytest.approx(np.sort(r[i, j][r[i, j] < reach]), rel=1e-12)


def test_hats_count_every_pair_once_and_do_not_jump():
    nodes = np.linspace(1.0, 2.0, 6)
    r = np.array([0.5, 1.0, 1.05, 1.3, 1.6])
    expected = np.array([max(0.0, 1 - abs(max(q, 1.0) - n) / 0.2) for n in nodes[:-1] for q in r])
    assert hats(r, nodes) == pytest.approx(expected.reshape(5, -1).sum(1))
    assert hats(r, nodes).sum() == pytest.approx(5)
    # a pair that leaves goes to zero before it is gone
    assert hats(np.array([2.0 - 1e-9]), nodes).sum() == pytest.approx(0, abs=1e-7)
    assert hats(np.array([2.5]), nodes).sum() == 0


def test_components_are_those_of_the_correlation_matrix():
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((60, 3)) @ rng.standard_normal((3, 12)) + 0.1 * rng.standard_normal((60, 12))
    space = rules.Space.of(rows)
    sizes = np.sort(np.linalg.eigvalsh(np.corrcoef(rows.T)))[::-1]
    assert space.sigma**2 == pytest.approx(sizes[: len(space.sigma)], rel=1e-8)
    # eight explain 99.9 % of the variance
    explained = np.cumsum(sizes) / sizes.sum()
    assert len(space.sigma) == 8 and explained[6] < 0.999 <= explained[7]
    assert space.scores(rows).std(axis=0, ddof=1) == pytest.approx(np.ones(8))
    assert space.second(rows) == pytest.approx(np.sort(np.abs(space.scores(rows)))[:, -2])


def test_a_feature_without_spread_says_nothing():
    rows = np.random.default_rng(2).standard_normal((30, 5))
    # a distance that no pair has, and one whose scatter is rounding
    rows[:, 3] = 0.0
    rows[:, 4] = 5.0 + 1e-15 * rows[:, 0]
    space, without = rules.Space.of(rows), rules.Space.of(rows[:, :3])
    moved = np.array([[0.5, -1.0, 2.0, 1e-3, 5.001]])
    assert space.second(moved) == pytest.approx(without.second(moved[:, :3]), rel=1e-10)
    assert space.second(np.array([[50.0, 0.0, 0.0, 0.0, 5.0]])) > 10


def test_the_rule_fails_its_own_ensemble_as_rarely_as_it_says():
    rng = np.random.default_rng(3)
    failures = tries = 0
    for _ in range(40):
        # wide tails: a limit of two would fail far more often
        rows = rng.standard_t(4, (60 + 30, 15))
        space, limit = rules.Space.of(rows[:60]), rules.limit_of(rows[:60])
        assert limit >= rules.LIMIT
        medians = rules.triples(space.second(rows[60:]))
        failures += int((medians > limit).sum())
        tries += len(medians)
    assert tries == 400
    assert rules.bounds(failures, tries)[0] <= rules.ACCEPTED


def test_the_interval_of_a_rate_is_exact():
    for count, of in ((0, 10), (3, 30), (30, 30), (7, 9)):
        low, high = rules.bounds(count, of)
        if count:
            assert binomial_tail(count, of, low) == pytest.approx(0.025, rel=1e-6)
        if count < of:
            assert 1 - binomial_tail(count + 1, of, high) == pytest.approx(0.025, rel=1e-6)
        assert (low == 0) == (count == 0) and (high == 1) == (count == of)
    assert rules.two_of_three(0.1) == pytest.approx(binomial_tail(2, 3, 0.1))


def test_planted_changes_change_what_they_say(hot):
    changes = {change.name: change.simulation for change in planted(hot)}
    assert float(changes["time step + 2.5 %"].integrator.timestep) == pytest.approx(0.0041)
    cut = changes["cutoff - 4 %"]
    assert cut.r_cut == pytest.approx(2.112) and float(cut.model.r_cut[0]) == cut.decider.r_cut[0]
    assert changes["forces in float32"].policy.force == "float32"
    assert changes["lists by jax-md"].builder == "jax-md"
    assert shorter(hot, 1.0).r_cut == hot.r_cut
    # a potential that carries its own cutoff keeps it
    metal = build("silicon/stillinger-weber-512")
    assert [c.must_fail for c in planted(metal)] == [True, False, False]


@pytest.mark.slow
@pytest.mark.jax_md
@pytest.mark.nightly
def test_false_positives_and_power_over_many_tries(hot):
    found = calibrate(hot, members=60, held_out=120, tries=4)
    assert found.triples == 40
    assert rules.bounds(found.false_positives, 40)[0] <= rules.ACCEPTED
    assert rules.bounds(found.alone, 120)[0] <= rules.ALONE
    assert 250 <= found.window.step <= 650
    for one in found.window.table:
        assert one.failures == one.tries if one.must_fail else one.failures <= 2
