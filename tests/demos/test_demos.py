"""Every demonstration, run once: its checks hold, and its numbers are those of plain loops."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ml_dtypes
import mpmath
import numpy as np
import pytest
from mpmath import mpf

from mdnum.errors import InputError
from mdnum.numerics.reductions import Exact, orders
from mdnum.verbs import demos
from mdnum.verbs.demos import Demo

G, H, E = 9.81, 0.01, 0.8
#: These take seconds each; of two the records of tests/goldens have the numbers as well.
SLOW = {
    "determinism", "euler-choice", "fork", "hysteresis", "implicit", "per-instance", "smoothing-width",
    "stiffness", "tf32-in-solver",
}  # fmt: skip
NIGHTLY = {"saltation", "stopping-precision"}


@cache
def script(name: str) -> SimpleNamespace:
    """Everything that a demonstration's file defines."""
    return SimpleNamespace(**demos.load(name).__globals__)


def sum_order(demo: Demo):
    large, small, tol = 2.0**-10 - 2.0**-21, 2.0**-23, 2.0**-10

    def loop(terms):
        total, rows = np.float16(0), []
        for term in terms:
            total = np.float16(total + np.float16(term))
            rows.append(float(total))
        return rows

    sums = [loop([large] + 4 * [small]), loop(4 * [small] + [large])]
    assert [demo.numbers["large_first"], demo.numbers["small_first"]] == [rows[-1] for rows in sums]
    assert f"{sums[0][-1]:.13f}" == "0.0009760856628" and sums[1][-1] == tol
    assert demo.numbers["iterations"] == [0, 1]
    assert [[row[2] for row in table.rows] for table in demo.tables[:2]] == sums
    assert [[row[4] for row in table.rows] for table in demo.tables[:2]] == [[0, 2, 2, 2, 2], [0] * 5]
    assert demo.numbers["jnp_sum"] == [tol, tol]
    right = {name for name, total in demo.data["reductions"].items() if total == tol}
    assert {"kahan", "neumaier", "exact", "fixed-point", "sorted", "reversed"} <= right
    assert "sequential" not in right


def stopping_precision(demo: Demo):
    kinds = {"bfloat16": ml_dtypes.bfloat16, "float16": np.float16}
    own, wide = script("stopping-precision"), np.float32

    def first_step(depths, tol, state, sums):
        """Iterations of a step and the sum it started from, rounded after every operation."""
        y, it, start = [-state(d) for d in depths], 0, None
        while True:
            total = sums(0)
            for one in y:
                total = sums(total + sums(-one))
            start = total if start is None else start
            if total < sums(tol) or it == 25:
                return it, float(start)
            y, it = [state(one + state(state(0.25) * -one)) for one in y], it + 1

    known = {"bfloat16": [-8.198e-8, 0.0, -8.196e-8], "float16": [-8.324e-8, 0.0, -1.192e-7]}
    fragile = {"bfloat16": 1.0930185823099237e-07, "float16": 1.1098907748419151e-07}
    for dtype, low in kinds.items():
        tol, depths = own.boundary_batch(dtype)
        assert sum(Fraction(float(d)) for d in depths) == Fraction(tol)
        for row, (state, sums) in zip(
            demo.data[dtype].values(), ((wide, wide), (low, low), (low, wide)), strict=True
        ):
            count, start = first_step(depths, tol, state, sums)
            assert row["iterations"] == [count, 0, 0, 0] and row["penetration_before"][0] == start
            y = np.array([state(-d) for d in depths])
            y = np.array([state(one + state(state(0.25) * -one)) for one in y]) if count else y
            np.testing.assert_allclose(row["loss"], np.mean(y.astype(wide) ** 2), rtol=2e-7)
            # what is left below the floor is set to 0 at the end of a step
            assert row["largest_move"] == [float(depths[0]), 0.0, 0.0, 0.0] and row["first_contact"] == 1
        np.testing.assert_allclose(demo.numbers["grad_k"][dtype], known[dtype], rtol=1e-3)
        # 2 p1 dp1/dk over nine balls, p1 = 3/4 p0, dp1/dk = -p0/2
        exact = sum(Fraction(float(d)) ** 2 for d in depths) * Fraction(-3, 4) / 9
        np.testing.assert_allclose(demo.numbers["grad_k_exact"][dtype], float(exact), rtol=1e-15)
        assert demo.numbers["loss"][dtype][1] == fragile[dtype]
        assert demo.numbers["depends_on_k"][dtype] == [True, False, True]
        # the exact sum is the tolerance, and the tolerance is a number of the narrow dtype
        mended = own.problem(dtype, own.policies(dtype)[f"{dtype}, fragile sum"], Exact()).run()
        assert mended.iterations.tolist() == [1, 0, 0, 0]
    assert demo.numbers["grad_k"]["float16"][2] == -(2.0**-23)
    assert 0.42 < demo.numbers["error_unscaled"] < 0.44 and demo.numbers["error_scaled"] < 1e-3
    for dtype, options in (("float16", {"tol": 6e-5}), ("bfloat16", {"small": 7})):
        with pytest.raises(InputError, match=f"is no {dtype}"):
            own.boundary_batch(dtype, **options)


def reset(y: float, steps: int) -> tuple[np.ndarray, int]:
    """The ball with a velocity reset, an operation at a time; heights and the step of the first contact."""
    v, a, rows, first = 0.0, -G, [y], -1
    for step in range(1, steps + 1):
        v = v + H * a
        y = y + H * v
        if y < 0:
            first = step if first < 0 else first
            y, v = 0.0, -E * min(v, 0.0)
        rows.append(y)
    return np.array(rows), first


def fork(demo: Demo):
    low = demo.numbers["y0"]
    (lower, first), (upper, second) = reset(low, 200), reset(np.nextafter(low, 2.0), 200)
    assert [first, second] == demo.numbers["first_contact"] == [45, 46]
    assert np.abs(lower - upper).tolist() == demo.data["separation"].tolist()
    assert demo.numbers["separation_before"] == np.abs(lower - upper)[:45].max() < 1e-15
    assert demo.numbers["separation_after"] == np.abs(lower - upper).max() > 0.1
    # without rounding the height after n steps is y0 - g h² n (n + 1) / 2
    exact = Fraction(G) * Fraction(H) ** 2 * 45 * 46 / 2
    assert abs(Fraction(low) - exact) < 45 * Fraction(np.spacing(1.0))


def euler(y: float, k: float, steps: int, *, old: bool) -> tuple[float, int, float]:
    """A ball on a spring: height at the end, step of the first contact, largest E / E(0).

    Moves with the old or with the new velocity.
    """
    v, first, most, start = 0.0, -1, 0.0, G * y
    for step in range(steps):
        a = -G - (k * y if y < 0 else 0.0)
        first = step + 1 if y < 0 and first < 0 else first
        before, v = v, v + H * a
        y = y + H * (before if old else v)
        most = max(most, G * y + v * v / 2 + (k * y * y / 2 if y < 0 else 0.0))
    return y, first, most / start


def stiffness(demo: Demo):
    numbers = demo.numbers
    for name, old in (("energy_semi_implicit", False), ("energy_explicit", True)):
        for z, seen in numbers[name].items():
            # chaos: the bits of the loop and of the program are not the same for long
            assert seen == pytest.approx(euler(1.0, (float(z) / H) ** 2, 600, old=old)[2], rel=0.05)
    assert [round(e, 1) for e in numbers["energy_explicit"].values()] == [1.7, 22.7, 272.1]
    assert numbers["limit"] == 2 and 0.1 < numbers["first_unbounded_gradient"] < 0.5
    assert numbers["gradient_overflows_at_step"] < 40_000
    region = demo.plots[0].region
    assert region is not None and region.value.shape == (len(region.y), len(region.x))
    # below a tenth of the limit everything is bounded, above the limit nothing is
    last = region.value[-1]
    assert set(last[region.x < 0.15]) == {0} and set(last[region.x > 2.1]) == {2}
    assert np.mean(last[(region.x > 0.4) & (region.x < 1.3)] == 1) > 0.8


def iteration_boundary(demo: Demo):
    def project(k: float) -> tuple[int, float, float]:
        """Iterations, what is left and its derivative by k, in the order of the product alpha k first."""
        p, it, slope, gain = 0.45, 0, 0.0, 0.5 * k
        while p >= 1e-4:
            slope = slope * (1 - gain) - 0.5 * p
            p, it = p - gain * p, it + 1
        return it, p, slope

    numbers = demo.numbers
    assert numbers["k_above"] == 0.5035674359581247 == np.nextafter(numbers["k_below"], 1)
    sides = [project(numbers[key]) for key in ("k_below", "k_above")]
    assert numbers["iterations"] == [it for it, _, _ in sides] == [30, 29]
    assert numbers["loss"] == [p for _, p, _ in sides]
    np.testing.assert_allclose(numbers["gradient"], [slope for _, _, slope in sides], rtol=1e-12)
    assert 40 <= numbers["evaluations"] <= 52
    assert len(demo.tables[0].rows) == numbers["boundaries"] >= 3
    for row in demo.tables[0].rows:
        assert [project(k)[0] for k in (float(row[0]), np.nextafter(float(row[0]), 1))] == list(row[1:3])
    # the derivatives do not add up to the change of the loss
    assert numbers["mean_gradient"] < -1.4e-3 and abs(numbers["secant"]) < 0.7e-3


def hysteresis(demo: Demo):
    own = script("hysteresis")

    def shaken(lift: float) -> int:
        noise = own.SHAKE * np.random.default_rng(0).normal(size=(own.STEPS, own.BALLS))
        y, v = np.full(own.BALLS, -9.81 / own.STIFFNESS), np.zeros(own.BALLS)
        touching, flips = y < 0, 0
        for step in range(own.STEPS):
            now = np.where(touching, y <= lift, y < 0)
            flips += int(np.sum(now != touching))
            touching = now
            push = np.where(now, own.STIFFNESS * -y - own.DAMPING * v, 0.0)
            v = v + own.H * ((noise[step] - 9.81) + push)
            y = y + own.H * v
        return flips

    def pressed(reverse: bool, gap: float) -> np.ndarray:
        """Iterations of each step, with the sum made in float16 term by term."""
        f16, f32 = np.float16, np.float32
        noise = own.WAVER * np.random.default_rng(1).normal(size=(own.PRESSED_STEPS, own.PRESSED))
        free = noise.astype(f32) - f32(own.G)
        tol, enter, counts = f16(own.TOL), f16(gap * own.TOL), []
        for step in range(own.PRESSED_STEPS):
            y, it = f32(own.PRESSED_H) * (f32(own.PRESSED_H) * free[step]), 0
            while True:
                depth = np.maximum(-y, f32(0)).astype(f16)
                total = f16(0)
                for one in depth[::-1] if reverse else depth:
                    total = f16(total + one)
                if total < (enter if it == 0 else tol) or it == 50:
                    break
                y, it = y + f32(0.25) * np.maximum(-y, f32(0)), it + 1
            counts.append(it)
        return np.array(counts)

    for lift in (0.0, 0.01):
        assert demo.data["contact_flips"][str(lift)] == shaken(lift)
    plain = [pressed(reverse, 1.0) for reverse in (False, True)]
    started = plain[0] > 0
    assert demo.numbers["stop_flips_without"] == int(np.sum(started[1:] != started[:-1]))
    assert demo.numbers["orders_disagree_without"] == int(np.sum(plain[0] != plain[1])) > 0
    assert not pressed(False, 1.05).any()
    assert demo.numbers["stop_flips_with"] == demo.numbers["orders_disagree_with"] == 0


def per_instance(demo: Demo):
    own = script("per-instance")

    def shared(depths, measure) -> int:
        p, it = list(depths), 0
        while measure(p) >= own.TOL:
            p, it = [0.75 * one for one in p], it + 1
        return it

    before, after = (demo.numbers[f"iterations_{when}"] for when in ("before", "after"))
    for name, measure in (("global sum", sum), ("maximum", max)):
        assert before[name] == [shared(own.BATCH, measure)] * 5
        assert after[name] == [shared((*own.BATCH, own.STRANGER), measure)] * 5
    alone = [shared((depth,), sum) for depth in own.BATCH]
    assert before["per instance"] == after["per instance"] == alone and len(set(alone)) > 2
    assert list(demo.numbers["coupling"].values()) == [1.0, 0.0, 0.0, 0.0]
    counts = [before["global sum"][0], after["global sum"][0]]
    expected = [-np.mean(own.BATCH) * n * 0.75 ** (n - 1) * 0.5 for n in counts]
    np.testing.assert_allclose(demo.numbers["grad_k"]["global sum"], expected, rtol=1e-12)


def implicit(demo: Demo):
    numbers = demo.numbers
    np.testing.assert_allclose(numbers["grad_k_unrolled"][:3], [-7.5e-2, -1.6e-3, -2.5e-5], rtol=0.015)
    assert numbers["iterations"][:3] == [14, 30, 46]
    for tol, n, slope in zip(
        numbers["tolerances"], numbers["iterations"], numbers["grad_k_unrolled"], strict=True
    ):
        assert n == int(np.ceil(np.log(tol / 0.45) / np.log(0.75)))
        np.testing.assert_allclose(slope, -0.45 * n * 0.75 ** (n - 1) / 2, rtol=1e-12)
    assert numbers["grad_k_implicit"] == [0.0] * 6 and numbers["depends_on_k"] is False
    rows = np.array(demo.tables[1].rows, float)
    # the tape holds at least the height of each ball before each iteration
    assert np.all(np.diff(rows[:, 1]) / np.diff(rows[:, 0]) / 1000 >= 8)
    assert np.ptp(rows[:, 2]) == np.ptp(rows[:, 3]) == 0
    (found,) = script("implicit").accuracy([1e-13], [1e-3], condition=100.0, unknowns=30, seed=3)
    random = np.random.default_rng(3)
    basis, _ = np.linalg.qr(random.normal(size=(30, 30)))
    values = np.geomspace(0.01, 1.0, 30)
    parts = basis.T @ random.normal(size=30)
    # A c divided by A + 1e-3 loses 1e-3 / (a + 1e-3) of each eigenvector
    expected = np.linalg.norm(parts * 1e-3 / (values + 1e-3)) / np.linalg.norm(parts)
    np.testing.assert_allclose(found.error, expected, rtol=1e-9)


def tf32_in_solver(demo: Demo):
    own = script("tf32-in-solver")

    def ten_bits(x):
        bits = x.view(np.uint32).astype(np.uint64)
        return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~np.uint64(0x1FFF)).astype(np.uint32).view(np.float32)

    def conjugate_gradients(matrix, b, rounded):
        a, b = matrix.astype(np.float32), b.astype(np.float32)
        x, r, p, rr = np.zeros_like(b), b, b, np.dot(b, b)
        limit, count = np.float32(own.TOL) ** 2 * rr, 0
        while rr > limit and count < own.CAP:
            q = (ten_bits(a) @ ten_bits(p)) if rounded else a @ p
            step = rr / np.dot(p, q)
            x, r = x + step * p, r - step * q
            rr, old, count = np.dot(r, r), rr, count + 1
            p = r + (rr / old) * p
        return count, np.linalg.norm(b - matrix @ x.astype(float)) / np.linalg.norm(b)

    numbers = demo.numbers
    # sums of 50 products in another order: counts wander, orders of magnitude do not
    for name, rounded in (("float32", False), ("tf32", True)):
        count, true = conjugate_gradients(*own.system(own.HARD), rounded)
        assert numbers[f"iterations_{name}"] == pytest.approx(count, rel=0.15)
        assert numbers[f"true_residual_{name}"] == pytest.approx(true, rel=1.0)
        easy = conjugate_gradients(*own.system(own.EASY), rounded)[0]
        assert numbers["iterations_at_condition_100"][name] == pytest.approx(easy, abs=4)
    assert 0.05 < numbers["true_residual_tf32"] < 0.2 and 5e-5 < numbers["true_residual_float32"] < 5e-4
    inner, first = numbers["column_inner_iterations"], numbers["first_contact_that_differs"]
    assert inner["tf32"] > 1.1 * inner["float32"] and inner["bfloat16"] > 1.5 * inner["float32"]
    assert first["float64"] is first["float32"] is None and first["bfloat16"] < first["tf32"]


def quantized_state(demo: Demo):
    own = script("quantized-state")

    def grid(x, bits, span):
        scale = 2 * span / 2**bits
        return np.clip(np.rint(x / scale), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * scale

    def contacts(bits=0, k=own.K, shaken=None):
        y, v, rows = own.heights(), np.zeros(own.BALLS), []
        for u in own.control() if shaken is None else shaken:
            touching = y < 0
            v = v + H * (-9.81 + u + np.where(touching, -k * y, 0.0))
            y = y + H * v
            if bits:
                y, v = grid(y, bits, own.SPAN["y"]), grid(v, bits, own.SPAN["v"])
            rows.append(touching)
        return np.array(rows)

    reference, found = contacts(), demo.data["horizons"]
    for bits in (8, 16):
        # the forces are added in another order: a ball may flip a few steps earlier or later
        expected = own.horizon(contacts(bits), reference)
        assert found["state"][own.BITS.index(bits)] == pytest.approx(expected, rel=0.1, abs=5)
    at, span = own.BITS.index(12), own.SPAN
    coarse = own.horizon(contacts(k=float(grid(own.K, 12, span["parameter"]))), reference)
    assert found["parameter"][at] == pytest.approx(coarse, rel=0.1)
    coarse = own.horizon(contacts(shaken=grid(own.control(), 12, span["input"])), reference)
    assert found["input"][at] == pytest.approx(coarse, rel=0.1)
    assert 50 < demo.numbers["steps_per_bit"] < 250
    assert found["state"] == sorted(found["state"]) and found["state"][0] < 200 < 1000 < found["state"][-1]
    assert demo.numbers["lattice_returns"] is True


def coalesce(demo: Demo):
    own = script("coalesce")
    panel, load = own.contacts()
    seen = set()
    for order in orders(len(load), own.ORDERS, seed=1):
        totals = np.zeros(own.PANELS, np.float32)
        for k in order:
            totals[panel[k]] += load[k]
        seen.add(totals.tobytes())
    assert demo.numbers["distinct_scatter_add"] == demo.numbers["distinct_sorted_by_index"] == len(seen) > 100
    for name in ("distinct_sorted_by_value", "distinct_exact", "distinct_fixed_point"):
        assert demo.numbers[name] == 1
    exact = [np.float32(math.fsum(load[panel == k].astype(float))) for k in range(own.PANELS)]
    assert np.array_equal(own.assembled(panel, load)["exact sum"][0], exact)


def saltation(demo: Demo):
    def exact(y0: float) -> float:
        """Derivative of the height at 2 s: each impact's time and speed, and their derivatives, in turn."""
        speed = math.sqrt(2 * G * y0)
        by_speed = G / speed
        time, by_time = speed / G, by_speed / G
        while time + 2 * E * speed / G <= 2.0:
            speed, by_speed = E * speed, E * by_speed
            time, by_time = time + 2 * speed / G, by_time + 2 * by_speed / G
        speed, by_speed, tau = E * speed, E * by_speed, 2.0 - time
        return by_speed * tau - (speed - G * tau) * by_time

    def corrected(count: int) -> float:
        """The same by steps of semi-implicit Euler from 1 m, with the saltation matrix written out."""
        h = 2.0 / count
        y, v, dy, dv = 1.0, 0.0, 1.0, 0.0
        for _ in range(count):
            v = v - h * G
            y, dy = y + h * v, dy + h * dv
            if y < 0:
                y, dy, dv = 0.0, -E * dy, -(1 + E) * G / v * dy - E * dv
                v = -E * v
        return dy

    numbers = demo.numbers
    assert numbers["exact"] == pytest.approx(exact(1.0), rel=1e-13)
    assert round(numbers["exact"], 5) == 0.42661
    assert set(numbers["by_steps"].values()) == {0.0}
    for h, count, error in (("0.01", 200, 0.39), ("0.001", 2000, 0.0099), ("0.0001", 20_000, 0.0014)):
        known = abs(corrected(count) - exact(1.0))
        assert numbers["saltation_error"][h] == pytest.approx(known, rel=1e-6)
        assert float(f"{known:.2g}") == error
    assert numbers["time_of_impact_error"] < 2e-14


def euler_choice(demo: Demo):
    numbers, shift = demo.numbers, 1e-6
    for name, old in (("explicit", True), ("semi_implicit", False)):
        ends = [euler(y, k, 200, old=old)[0] for y, k in (
            (1 + shift, 100), (1 - shift, 100), (1, 100 + shift), (1, 100 - shift))]  # fmt: skip
        by_y0, by_k = (ends[0] - ends[1]) / (2 * shift), (ends[2] - ends[3]) / (2 * shift)
        assert numbers[f"dy_dy0_{name}"] == pytest.approx(by_y0, rel=1e-7)
        assert numbers[f"dy_dk_{name}"] == pytest.approx(by_k, rel=1e-5)
        assert numbers[f"first_contact_{name}"] == euler(1, 100, 200, old=old)[1]
    found = [numbers[f"dy_dy0_{name}"] for name in ("explicit", "semi_implicit", "exact")]
    assert [round(x, 2) for x in found] == [3.73, -2.97, -2.69]


def zeno(demo: Demo):
    def to_rest(y0, e):
        """Time of an impact far beyond what double precision resolves, added up flight by flight."""
        g = mpf(G)
        speed = mpmath.sqrt(2 * g * y0)
        time = speed / g
        for _ in range(2000):
            speed = e * speed
            time += 2 * speed / g
        return time

    def chatter(h: float) -> tuple[int, float]:
        """Contacts and last speeds of a ball put back on the floor at the end of the step."""
        y, v, contacts, speeds = 1.0, 0.0, 0, []
        for _ in range(round(8 / h)):
            v = v - h * G
            y = y + h * v
            if y < 0:
                y, v, contacts = 0.0, -E * min(v, 0.0), contacts + 1
            speeds.append(abs(v))
        return contacts, max(speeds[-100:])

    numbers = demo.numbers
    with mpmath.workdps(50):
        exact = to_rest(mpf(1), mpf(E))
        assert abs(numbers["rest_time"] - exact) < 4e-15
        # stopped at 1e-12 m/s the last flights are missing: 2 v / (g (1 - e)) at most
        assert 0 < exact - numbers["rest_time_located"] < 2e-12 / (G * (1 - E))
        by = {"y0": mpmath.diff(lambda y: to_rest(y, mpf(E)), 1)}
        by["restitution"] = mpmath.diff(lambda e: to_rest(mpf(1), e), mpf(E))
    for name, slope in by.items():
        assert numbers[f"rest_by_{name}"] == pytest.approx(float(slope), rel=1e-13)
        assert numbers[f"rest_by_{name}_located"] == pytest.approx(float(slope), rel=1e-6)
    for h in ("0.01", "0.001"):
        contacts, speed = chatter(float(h))
        assert numbers["contacts_in_fixed_steps"][h] == contacts
        assert numbers["speed_left_in_fixed_steps"][h] == pytest.approx(speed, rel=1e-9)
    # the speed with which a ball chatters: v = e (h g - v)
    assert numbers["speed_left_in_fixed_steps"]["0.01"] == pytest.approx(E / (1 + E) * 0.01 * G, rel=1e-9)


def smoothing_width(demo: Demo):
    k, starts = 3000.0, np.linspace(0.9, 1.1, 1001)

    def heights(eps: float, y: np.ndarray) -> np.ndarray:
        v = np.zeros_like(y)
        for _ in range(200):
            depth = eps * np.logaddexp(0, -y / eps) if eps else np.maximum(-y, 0)
            v = v + H * (k * depth - G)
            y = y + H * v
        return y

    # the exact motion from 1 m by fine steps
    y, v, h = 1.0, 0.0, 1e-5
    for _ in range(200_000):
        v = v + h * (k * max(-y, 0.0) - G)
        y = y + h * v
    data, shown = demo.data, {series.label: series.y for series in demo.plots[1].series}
    for eps in (0.003, 0.01, 0.03, 0.1):
        loss = (heights(eps, starts) - y) ** 2
        # the target of the loop is off by its own step
        shift = starts[np.argmin(loss)] - 1
        assert data["minimizer_shift"][f"{eps:g}"] == pytest.approx(shift, abs=4e-4)
        minima = int(np.sum((loss[1:-1] < loss[:-2]) & (loss[1:-1] <= loss[2:])))
        assert abs(data["minima"][f"{eps:g}"] - minima) <= 0.1 * minima
        if f"width {eps:g} m" in shown:
            slope = (heights(eps, starts + 1e-7) - heights(eps, starts - 1e-7)) / 2e-7
            np.testing.assert_allclose(shown[f"width {eps:g} m"], slope, rtol=1e-5, atol=1e-5)
    assert demo.numbers["minima_hard"] == data["minima"]["0"] > 20 and data["minima"]["0.03"] == 1
    assert data["gradient_error"]["0.03"] < 0.01 < 10 < data["gradient_error"]["0"]
    assert abs(data["minimizer_shift"]["0.1"]) == pytest.approx(0.032, abs=1e-3)


def determinism(demo: Demo):
    numbers, start = demo.numbers, script("determinism").START
    assert (numbers["fingerprints"], numbers["processes"]) == (1, 3)
    # rounded operation by operation, as Python does it
    assert numbers["first_contact"] == reset(start, 60)[1] == 48
    assert reset(float(np.nextafter(start, 2.0)), 60)[1] == 49
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    if platform.machine() == "x86_64" and " fma " in flags:
        # with a fused multiply-add the plain program takes the other branch
        assert numbers["plain_first_contacts"] == [49, 48]
        assert numbers["plain_fingerprints"] == 2 and numbers["plain_is_off"] > 0.1


ORACLES: dict[str, Callable[[Demo], Any]] = {
    one.__name__.replace("_", "-"): one
    for one in (
        sum_order, stopping_precision, fork, stiffness, iteration_boundary, hysteresis, per_instance,
        implicit, tf32_in_solver, quantized_state, coalesce, saltation, euler_choice, zeno, smoothing_width,
        determinism,
    )
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=[pytest.mark.slow] * (name in SLOW) + [pytest.mark.nightly] * (name in NIGHTLY)
        )
        for name in ORACLES
    ],
)
@pytest.mark.usefixtures("strangers_folder")
def test_a_demonstration_shows_what_a_plain_loop_shows(name: str):
    demo = demos.load(name)()
    assert [(claim.what, claim.seen) for claim in demo.checks if not claim.ok] == []
    assert demo.ok and demo.checks and demo.title and demo.answer and demo.in_md and demo.plots
    ORACLES[name](demo)


def test_every_demonstration_is_tested():
    assert demos.names() == list(ORACLES)
    assert all(len(demos.about(name)) > 20 for name in ORACLES)
    with pytest.raises(InputError, match="Did you mean zeno"):
        demos.load("zenno")
