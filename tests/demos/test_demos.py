"""Every demonstration, run once: its checks hold, its numbers are known, and what is its own code is right.

What a demonstration runs on `mdnum.ball` has the bits of numpy (`tests/ball`), so that its numbers are
recorded here, as plain loops gave them; three demonstrations are in `tests/goldens`, too.
"""

from __future__ import annotations

import itertools
import math
import platform
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball import Penalty, Reason, World
from mdnum.errors import InputError
from mdnum.numerics.reductions import Exact
from mdnum.verbs import demos
from mdnum.verbs.demos import Demo

G, H, E = 9.81, 0.01, 0.8


@cache
def script(name: str) -> SimpleNamespace:
    """Everything that a demonstration's file defines."""
    return SimpleNamespace(**vars(demos.load(name)))


#: By name: a mark of those that take their time, the relative tolerance of the numbers, and the numbers.
KNOWN: dict[str, tuple[str, float, dict[str, Any]]] = {
    "sum-order": ("", 0.0, {
        "large_first": 2.0**-10 - 2.0**-21, "small_first": 2.0**-10, "iterations": [0, 1],
    }),
    "stopping-precision": ("nightly", 1e-3, {
        "grad_k": {"bfloat16": [-8.198e-8, 0.0, -8.196e-8], "float16": [-8.324e-8, 0.0, -(2.0**-23)]},
        "error_unscaled": 0.4321, "depends_on_k": {"bfloat16": [1, 0, 1], "float16": [1, 0, 1]},
    }),
    "fork": ("slow", 1e-6, {"first_contact": [45, 46], "separation_after": 0.12548952}),
    # chaos: the bits of another processor's energy are not the same for long
    "stiffness": ("nightly", 0.05, {
        "energy_semi_implicit": {"1.97": 8.403, "2.02": 12.888}, "limit": 2.0, "limit_measured": 2.0,
        "energy_explicit": {"0.03": 1.6994, "0.32": 22.717, "1.0": 272.09},
    }),
    "iteration-boundary": ("", 1e-9, {
        "k_below": 0.5035674359581246, "iterations": [30, 29], "evaluations": 46, "boundaries": 3,
        "loss": [7.482162820209395e-05, 1e-4], "gradient": [-0.0015, -0.0019379423234195596],
        # the derivatives do not add up to the change of the loss
        "mean_gradient": -0.001704695763630632, "secant": -0.00019456988920803247,
    }),
    "hysteresis": ("nightly", 0.0, {
        "contact_flips_without": 529, "contact_flips_with": 12, "stop_flips_without": 190,
        "stop_flips_with": 0, "orders_disagree_without": 5, "orders_disagree_with": 0,
    }),
    "per-instance": ("nightly", 1e-12, {
        "iterations_before": {"global sum": [7] * 5, "maximum": [4] * 5, "per instance": [4, 2, 0, 0, 3]},
        "iterations_after": {"global sum": [8] * 5, "maximum": [4] * 5, "per instance": [4, 2, 0, 0, 3]},
        "grad_k": {"global sum": [-0.00084717773437500, -0.00072615234375]},
    }),
    "implicit": ("nightly", 1e-9, {
        "grad_k_unrolled": [-0.45 * n * 0.75 ** (n - 1) / 2 for n in range(14, 95, 16)],
        "iterations": [14, 30, 46, 62, 78, 94], "grad_k_implicit": [0.0] * 6, "depends_on_k": False,
    }),
    # sums of 50 products in another order: counts wander, orders of magnitude do not
    "tf32-in-solver": ("nightly", 0.15, {
        "iterations_float32": 242, "iterations_tf32": 347, "iterations_bfloat16": 400,
        "iterations_at_condition_100": {"float32": 47, "tf32": 52, "bfloat16": 55},
        "column_inner_iterations": {"float32": 8344, "tf32": 9648, "bfloat16": 15726},
    }),
    # a ball may flip a few steps earlier or later
    "quantized-state": ("", 0.1, {
        "state_horizons": {8: 50.5, 12: 111.5, 16: 239.0, 20: 814.0, 24: 1274.0, 28: 1708.0},
        "input_horizon_16_bits": 1519.5, "parameter_horizon_16_bits": 1748.0, "lattice_returns": True,
    }),
    "coalesce": ("", 0.0, {f"distinct_{kind}": 1 for kind in ("sorted_by_value", "exact", "fixed_point")}),
    "saltation": ("nightly", 0.03, {
        "exact": 0.42661, "discretize_then_differentiate": dict.fromkeys(("0.01", "0.001", "0.0001"), 0.0),
        "differentiate_then_discretize": {"0.01": 0.81792, "0.001": 0.416687, "0.0001": 0.427983},
        "apart_without_impact": 0.0,
        "saltation_error": {"0.01": 0.39, "0.001": 9.9e-3, "0.0001": 1.4e-3},
    }),
    "euler-choice": ("nightly", 1e-5, {
        "dy_dy0_explicit": 3.7304193, "dy_dy0_semi_implicit": -2.96736885, "dy_dy0_exact": -2.69467177,
        "dy_dk_explicit": -0.00869065082, "dy_dk_semi_implicit": 0.0174131148,
        "first_contact_explicit": 47, "first_contact_semi_implicit": 46,
        "order_of_height": {
            "explicit Euler": 0.990509, "semi-implicit Euler": 1.008769, "velocity Verlet": 1.996696,
            "implicit midpoint": 2.043383,
        },
        # the force has a kink at the floor: its slope jumps there, so that derivatives are of order 1
        "order_of_derivative": {
            "explicit Euler": 1.071676, "semi-implicit Euler": 1.022325, "velocity Verlet": 1.028794,
            "implicit midpoint": 1.055851,
        },
    }),
    "zeno": ("", 1e-6, {
        "rest_time": 4.063712768871579, "rest_time_located": 4.063712768871, "rest_by_y0": 2.0318563844,
        "rest_by_y0_located": 2.0318563870, "rest_by_restitution": 22.576182,
        "rest_by_restitution_located": 22.576187, "contacts_in_fixed_steps": {"0.01": 473, "0.001": 4046},
        # the speed with which a ball chatters: v = e (h g - v)
        "speed_left_in_fixed_steps": {h: E / (1 + E) * float(h) * G for h in ("0.01", "0.001")},
    }),
    "smoothing-width": ("nightly", 0.1, {
        "minima_hard": 64, "one_minimum_from": 0.02, "gradient_error_hard": 78.6, "order_of_bias": 2.0,
        "minimizer_shift_at_0.1": 0.0318,
    }),
    "determinism": ("nightly", 0.0, {"fingerprints": 1, "processes": 3, "first_contact": 48}),
    # a drift of 10 for 0.4 time units over rows of atoms that are 1.11 apart turns the phase 3.6 times
    "complex-order": ("nightly", 2e-3, {
        "crossings": 4, "steps": [14, 42, 70, 98],
        "gradient_at_zero": ["0", "nan", "nan"], "turns": 4 / 1.11, "psi6": 0.97257,
        "error_conjugate": 1.0837, "smallest_margin": 0.02782,
    }),
    "two-residuals": ("", 1e-12, {
        "left": [9.96e-4, 7.53e-4], "grad_k": [0.0, -5.02e-4], "iterations": [0, 1], "jump": 2.43e-4,
        "contact_lasts": [2, 1], "next_contact": [2610, 2611],
    }),
    # x = p^(1/3); iterations of x - x^3 fall as 1 / sqrt(2 n), and their derivative grows as 2 n / 5
    "singular-fixed-point": ("", 1e-2, {
        "derivative": [p ** (-2 / 3) / 3 for p in (1e-3, 8e-6, 1e-9, 1e-12)], "half": 0.5,
        "at_zero": {"1e-06": 1e6, "0.0012": 1 / 0.0012, "0.01": 100.0}, "left_after_iterations": 2000**-0.5,
        "slope_of_iterations": 400.0, "refused": [False] * 4 + [True],
    }),
    "visibility": ("", 1e-2, {
        "best": (2 * G + (G / 4) ** 2) ** 0.5, "derivative": 10 / (G * (25 - 2 * G) ** 0.5),
        "derivative_by_crossings": 10 / (G * (25 - 2 * G) ** 0.5), "slope_counted": [0.0, 0.0],
        "events": [274, 745], "margins": [0.00040825, -0.00105185],
        "optimum_moves": {"0.03": 0.01192, "0.1": 0.06192, "0.3": 0.14192},
    }),
    # standard errors are m / sqrt(3 n), and half of all decisions near the tolerance differ
    "sampling": ("", 0.05, {
        "samples_needed": 30_603, "rounding_exceeds_sampling_at": 4096,
        "flips_by_order": [2, 6, 18, 59, 0], "flips_by_key": [536, 482, 507, 447, 0],
        "sampling": [1.01e-3 / (3 * n) ** 0.5 for n in (16, 64, 256, 1024, 4096)],
    }),
    "five-errors": ("", 1e-2, {
        "precision": 2.0**-24, "rounding": 1.9967e-5, "discretization": 1.9003e-5, "stability": 0.05,
        "condition": 2.34795, "error": 9.6425e-7, "unstable_error": 3.1327,
        "condition_near_the_floor": 67.105,
    }),
}  # fmt: skip


def alike(seen: Any, known: Any, rel: float) -> bool:
    if isinstance(known, dict):
        return all(alike(seen[key], one, rel) for key, one in known.items())
    if isinstance(known, list) and isinstance(known[0], str):
        return seen == known
    return seen == pytest.approx(known, rel=rel, abs=1e-3 * rel * np.max(np.abs(known)))


# --- what is a demonstration's own --------------------------------------------------------------------


def sum_order(demo: Demo):
    right = {name for name, total in demo.data["reductions"].items() if total == 2.0**-10}
    assert {"kahan", "neumaier", "exact", "fixed-point", "sorted", "reversed"} <= right
    assert "sequential" not in right


def stopping_precision(demo: Demo):
    own = script("stopping-precision")
    for dtype in ("bfloat16", "float16"):
        tol, depths = own.boundary_batch(dtype)
        assert sum(Fraction(float(d)) for d in depths) == Fraction(tol)
        # the exact sum is the tolerance, and the tolerance is a number of the narrow dtype
        mended = own.problem(dtype, own.policies(dtype)[f"{dtype}, fragile sum"], Exact()).run()
        assert mended.iterations.tolist() == [1, 0, 0, 0]
    for dtype, options in (("float16", {"tol": 6e-5}), ("bfloat16", {"small": 7})):
        with pytest.raises(InputError, match=f"is no {dtype}"):
            own.boundary_batch(dtype, **options)


def fork(demo: Demo):
    # without rounding the height after n steps is y0 - g h² n (n + 1) / 2
    exact = Fraction(G) * Fraction(H) ** 2 * 45 * 46 / 2
    assert abs(Fraction(demo.numbers["y0"]) - exact) < 45 * Fraction(np.spacing(1.0))


def stiffness(demo: Demo):
    assert 0.1 < demo.numbers["first_unbounded_gradient"] < 0.5
    assert demo.numbers["gradient_overflows_at_step"] < 40_000
    region = demo.plots[0].region
    assert region is not None and region.value.shape == (len(region.y), len(region.x))
    # below a tenth of the limit everything is bounded, above the limit nothing is
    last = region.value[-1]
    assert set(last[region.x < 0.15]) == {0} and set(last[region.x > 2.1]) == {2}
    assert np.mean(last[(region.x > 0.4) & (region.x < 1.3)] == 1) > 0.8


def implicit(demo: Demo):
    rows = np.array(demo.tables[1].rows, float)
    # the tape holds at least the height of each ball before each iteration
    assert np.all(np.diff(rows[:, 1]) / np.diff(rows[:, 0]) / 1000 >= 8)
    assert np.ptp(rows[:, 2]) == np.ptp(rows[:, 3]) == 0
    (found,) = script("implicit").accuracy([1e-13], [1e-3], condition=100.0, unknowns=30, seed=3)
    random = np.random.default_rng(3)
    basis, _ = np.linalg.qr(random.normal(size=(30, 30)))
    values, parts = np.geomspace(0.01, 1.0, 30), basis.T @ random.normal(size=30)
    # A c divided by A + 1e-3 loses 1e-3 / (a + 1e-3) of each eigenvector
    expected = np.linalg.norm(parts * 1e-3 / (values + 1e-3)) / np.linalg.norm(parts)
    np.testing.assert_allclose(found.error, expected, rtol=1e-9)


def tf32_in_solver(demo: Demo):
    numbers, first = demo.numbers, demo.numbers["first_contact_that_differs"]
    assert 0.05 < numbers["true_residual_tf32"] < 0.2 and 5e-5 < numbers["true_residual_float32"] < 5e-4
    assert first["float64"] is first["float32"] is None and first["bfloat16"] < first["tf32"]


def coalesce(demo: Demo):
    own = script("coalesce")
    panel, load = own.contacts()
    seen = set()
    for order in own.orders(len(load), own.ORDERS, seed=1):
        totals = np.zeros(own.PANELS, np.float32)
        for k in order:
            totals[panel[k]] += load[k]
        seen.add(totals.tobytes())
    assert demo.numbers["distinct_scatter_add"] == demo.numbers["distinct_sorted_by_index"] == len(seen) > 100
    exact = [np.float32(math.fsum(load[panel == k].astype(float))) for k in range(own.PANELS)]
    assert np.array_equal(own.assembled(panel, load)["exact sum"][0], exact)


def smoothing_width(demo: Demo):
    starts, data = np.linspace(0.9, 1.1, 1001), demo.data

    def heights(eps: float, y: np.ndarray) -> np.ndarray:
        v = np.zeros_like(y)
        for _ in range(200):
            v = v + H * (3000.0 * eps * np.logaddexp(0, -y / eps) - G)
            y = y + H * v
        return y

    for series in demo.plots[1].series:
        eps = next((eps for eps in (0.003, 0.01, 0.03, 0.1) if series.label == f"width {eps:g} m"), None)
        if eps is not None:
            slope = (heights(eps, starts + 1e-7) - heights(eps, starts - 1e-7)) / 2e-7
            np.testing.assert_allclose(series.y, slope, rtol=1e-5, atol=1e-5)
    assert data["minima"]["0.03"] == 1 and data["gradient_error"]["0.03"] < 0.01


def determinism(demo: Demo):
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    if platform.machine() == "x86_64" and " fma " in flags:
        # with a fused multiply-add the plain program takes the other branch
        assert demo.numbers["plain_first_contacts"] == [49, 48]
        assert demo.numbers["plain_fingerprints"] == 2 and demo.numbers["plain_is_off"] > 0.1


OWN: dict[str, Callable[[Demo], Any]] = {
    one.__name__.replace("_", "-"): one
    for one in (
        sum_order, stopping_precision, fork, stiffness, implicit, tf32_in_solver, coalesce, smoothing_width,
        determinism,
    )
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[getattr(pytest.mark, mark)] if mark else [])
        for name, (mark, *_) in KNOWN.items()
    ],
)
@pytest.mark.usefixtures("strangers_folder")
def test_a_demonstration_shows_what_is_known(name: str):
    demo = demos.load(name).run()
    assert [(claim.what, claim.seen) for claim in demo.checks if not claim.ok] == []
    assert demo.ok and demo.checks and demo.title and demo.answer and demo.in_md and demo.plots
    _, rel, known = KNOWN[name]
    assert [key for key, one in known.items() if not alike(demo.numbers[key], one, rel)] == []
    OWN.get(name, bool)(demo)


def test_every_demonstration_is_tested():
    assert demos.names() == list(KNOWN)
    assert all(len(demos.about(name)) > 20 for name in KNOWN)
    with pytest.raises(InputError, match="Did you mean zeno"):
        demos.load("zenno")


# --- step matrices, integers for a state, a column of balls -------------------------------------------


@eqx.filter_jit
def step_jacobian(x, world: World, half: bool):
    """Of a step from (sqrt(k) y, v), for velocity Verlet with the v of the half step, to a step later."""
    contact: Any = world.contact
    h, unit = world.integrator.h, jnp.sqrt(contact.k)

    def step(x):
        y, v = x[:1] / unit, x[1:]
        state = world.start(y, v)
        a = contact.acceleration(y, v, state.a * 0 - G, jnp.ones(1, bool), world.rounding)
        after = world.advance(state._replace(y=y, v=v - h / 2 * a if half else v, a=a))[0]
        return jnp.concatenate([after.y * unit, after.v + h / 2 * after.a if half else after.v])

    return jax.jacfwd(step)(x)


@pytest.mark.parametrize(("z", "zeta"), [(1.3, 0.0), (0.7, 0.2), (2.5, 0.6)])
def test_the_matrix_is_the_jacobian_of_a_step_in_contact(z: float, zeta: float):
    own, h = script("stiffness"), 0.125
    k = (z / h) ** 2
    for scheme, build in own.SCHEMES.items():
        world = World.create(Penalty(k, 2 * zeta * np.sqrt(k)), build(h), G)
        # deep in contact, so that the step ends there too
        jacobian = step_jacobian(np.array([-3.0, 0.1]), world, scheme == "velocity-verlet")
        np.testing.assert_allclose(jacobian, own.step_matrix(scheme, z, zeta), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.7, 1.0, 3.0])
def test_the_limit_is_where_an_eigenvalue_leaves_the_unit_circle(zeta: float):
    own = script("stiffness")
    for scheme in own.SCHEMES:
        known = own.limit(scheme, zeta)
        z = np.linspace(1e-3, min(known, 50.0) * (1 - 1e-9), 500)
        assert known == 0 or np.all(own.spectral_radius(scheme, z, zeta) <= 1 + 1e-9)
        if np.isfinite(known):
            beyond = np.linspace(known + 1e-6, 3 * known + 1, 500)
            assert np.all(own.spectral_radius(scheme, beyond, zeta) > 1)
    assert [own.limit(scheme) for scheme in own.SCHEMES] == [0, 2, 2, np.inf]
    # at z = 1 three contact steps are minus the identity, whatever the phase, as in the exact motion
    assert own.bounce_growth("semi-implicit-euler", 1.0) < 1e-6
    assert own.bounce_growth("semi-implicit-euler", 0.9) > 1.0
    assert own.bounce_growth("semi-implicit-euler", 0.1, zeta=3.0) == np.inf


def test_the_jumps_at_the_branch_cut_make_a_phase_continuous_either_way():
    # over pi, back, over it again, and twice over 0, which is no cut
    angle = np.array([3.0, 3.2, 3.1, 3.5, 6.0, 6.6, 6.1, np.pi + 1e-9, np.pi - 1e-9])
    ledger = script("complex-order").cuts(np.exp(1j * angle), 1e-8)
    assert ledger.step.tolist() == [1, 2, 3, 8] and ledger.entered.tolist() == [False, True, False, True]
    assert ledger.ambiguous.tolist() == [False, False, False, True]
    np.testing.assert_allclose(ledger.margin, np.sin(angle[ledger.step]), atol=1e-15)
    np.testing.assert_allclose(np.angle(np.exp(1j * angle)) + ledger.jumps(8).cumsum(), angle, atol=1e-12)


@pytest.mark.parametrize("bits", [12, 32])
def test_the_integer_ball_has_the_bits_of_pythons_integers_and_returns(bits: int):
    control, step, k = 2.0 * np.sin(np.arange(700) * 0.1), 0.01, 1234.5
    ball = script("quantized-state").LatticeBall.create(k, step, control, bits=bits)
    start = ball.start([0.3, 0.7, 1.1], -0.5)
    end, contact = ball.run(start)
    h, push = round(step * 2**24), round(step * k * 2**24)
    for n in range(3):
        y, v = int(start.y[n]), int(start.v[n])
        for u, touches in zip(control, np.asarray(contact)[:, n], strict=True):
            assert touches == (y < 0)
            v += int(np.rint((u - G) * step * 2**bits)) - ((y * push >> 24) if y < 0 else 0)
            y += v * h >> 24
        assert (int(end.y[n]), int(end.v[n])) == (y, v)
    assert np.asarray(contact).any(axis=0).all()
    back = ball.rewind(end)
    assert np.array_equal(back.y, start.y) and np.array_equal(back.v, start.v)
    with pytest.raises(InputError, match="overflow"):
        script("quantized-state").LatticeBall.create(k, step, control, bits=40)


def exact_step(q, v, k, h=0.01):
    """The minimum of a step by trying every set of contacts: the one that agrees with itself."""
    n = len(q)
    jacobian = np.eye(n) - np.eye(n, k=-1)
    free = q + h * v - h * h * G
    for flags in itertools.product([0.0, 1.0], repeat=n):
        new = np.linalg.solve(np.eye(n) + h * h * k * jacobian.T @ np.diag(flags) @ jacobian, free)
        if np.array_equal(jacobian @ new < 0, np.array(flags) > 0):
            return new, (new - q) / h, np.array(flags) > 0
    raise AssertionError("no set of contacts agrees with itself")


def test_a_step_of_the_column_is_the_minimum_found_by_trying_all_sets_of_contacts():
    own = script("tf32-in-solver")
    column = own.Column.create(6, "float64", k=1e6, tol=1e-13, inner_tol=1e-13)
    q, v = np.cumsum(np.random.default_rng(3).uniform(0, 2e-3, 6)), np.zeros(6)
    run = own.simulate_column(column, column.start(q), 25)
    for step in range(25):
        q, v, contact = exact_step(q, v, 1e6)
        assert np.abs(run.q[step + 1] - q).max() < 1e-11
        assert np.array_equal(run.record.contact[step], contact)
    assert run.record.contact.any() and not run.record.contact.all()
    assert run.ended() == {"tolerance": 25}
    # another start: where two columns diverge
    other = own.simulate_column(column, column.start(np.linspace(1.9e-3, 1.4e-2, 6)), 25)
    step, ball, gap, there = run.first_difference(other)
    differ = run.record.contact != other.record.contact
    assert not differ[: step - 1].any() and differ[step - 1, ball]
    assert (gap < 0) != (there < 0) and run.first_difference(run) is None


@pytest.mark.parametrize(
    ("factor", "tol", "reason"),
    [(1, 1e-12, Reason.TOLERANCE), (1, 0.0, Reason.CAP), (np.nan, 1e-12, Reason.NOT_FINITE)],
)
def test_conjugate_gradients_know_how_they_ended(factor, tol, reason):
    rng = np.random.default_rng(1)
    root, b = rng.normal(size=(30, 30)), jnp.asarray(rng.normal(size=30))
    matrix = jnp.asarray(root @ root.T + 30 * np.eye(30))
    solve = script("tf32-in-solver").conjugate_gradients
    found = solve(lambda v: factor * (matrix @ v), b, tol, 60, true_product=lambda x: matrix @ x)
    assert Reason(int(found.reason)) == reason
    if reason == Reason.TOLERANCE:
        true = np.linalg.norm(np.asarray(b - matrix @ found.x)) / np.linalg.norm(b)
        assert float(found.true_history[int(found.iterations)]) == pytest.approx(true, rel=1e-6)
        assert float(found.history[int(found.iterations)]) == float(found.residual) <= 1e-12
