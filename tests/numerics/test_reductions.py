"""Every order of a sum, against the same sum written out, rounded after each addition."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from jax import lax

from mdnum.errors import InputError
from mdnum.numerics.exact import zero_bits
from mdnum.numerics.reductions import (
    BY_NAME,
    Blocked,
    FixedPoint,
    Pairwise,
    Permuted,
    Sequential,
    Sorted,
    parse,
)
from mdnum.numerics.sums import Halves, Twice

DTYPES = [np.float64, np.float32, np.float16, ml_dtypes.bfloat16]


def loop(terms):
    total = np.zeros(terms[0].shape, terms[0].dtype)
    for term in terms:
        total = total + term
    return total


def tree(values, width=2):
    """A tree written as a recursion over levels: neighbors add, a last group may be short."""
    if len(values) == 1:
        return values[0]
    level = []
    for start in range(0, len(values), width):
        total = values[start]
        for value in values[start + 1 : start + width]:
            total = total + value
        level.append(total)
    return tree(level, width)


def kahan(terms):
    total = lost = np.zeros(terms[0].shape, terms[0].dtype)
    for term in terms:
        y = term - lost
        t = total + y
        lost = (t - total) - y
        total = t
    return total


def neumaier(terms):
    total = lost = np.zeros(terms[0].shape, terms[0].dtype)
    for term in terms:
        t = total + term
        lost = lost + np.where(abs(total) >= abs(term), (total - t) + term, (term - t) + total)
        total = t
    return total + lost


def by_magnitude(terms, descending=False):
    columns = []
    for column in terms.reshape(len(terms), -1).T:
        order = sorted(column, key=lambda v: (abs(float(v)), float(v)), reverse=descending)
        columns.append(loop(np.array(order, terms.dtype)))
    return np.array(columns, terms.dtype).reshape(terms.shape[1:])


WRITTEN_OUT = [
    (Sequential(), loop),
    (Sequential("reversed"), lambda t: loop(t[::-1])),
    (Permuted(7), lambda t: loop(t[np.random.default_rng(7).permutation(len(t))])),
    (Pairwise(), lambda t: tree(list(t))),
    (Blocked(3), lambda t: tree(list(t), 3)),
    (Blocked(20), lambda t: tree(list(t), 20)),
    (parse("kahan"), kahan),
    (parse("neumaier"), neumaier),
    (Sorted(), by_magnitude),
    (Sorted("descending"), lambda t: by_magnitude(t, descending=True)),
]


def wild(count, dtype=np.float64, columns=50, spread=8):
    rng = np.random.default_rng(11)
    scale = 10.0 ** rng.integers(-spread, spread, (count, columns))
    return (rng.normal(size=(count, columns)) * scale).astype(dtype)


@jax.jit
def every_sum(terms):
    """All reductions in one program, which compiles sooner than ten."""
    return {name: reduction(terms) for name, reduction in BY_NAME.items()}


def spread_of(dtype):
    return 2 if np.dtype(dtype).itemsize == 2 else 8


@jax.jit
def all_written_out(terms, zero):
    return [reduction(terms, zero) for reduction, _ in WRITTEN_OUT]


@jax.jit
def all_without_a_zero(terms):
    """What the sum enters is fused with it."""
    return [reduction(terms).astype(jnp.float64) * 2 for reduction, _ in WRITTEN_OUT]


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_sum_of_an_array_has_the_bits_of_the_loop(dtype):
    terms = wild(43, dtype, spread=spread_of(dtype))
    seen = all_written_out(jnp.asarray(terms), zero_bits(dtype))
    for (reduction, written), total in zip(WRITTEN_OUT, seen, strict=True):
        expected = written(terms)
        assert expected.dtype == dtype
        assert np.array_equal(np.asarray(total), expected), reduction


@pytest.mark.parametrize("dtype", DTYPES[2:])
def test_sixteen_bit_sums_are_rounded_also_without_a_zero(dtype):
    terms = wild(43, dtype, spread=2)
    seen = all_without_a_zero(jnp.asarray(terms))
    for (reduction, written), total in zip(WRITTEN_OUT, seen, strict=True):
        assert np.array_equal(np.asarray(total), written(terms).astype(np.float64) * 2), reduction


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_rounding_is_skipped_between_a_product_a_sum_and_what_uses_it(dtype):
    # unfenced, XLA contracts such products into the sum, and widens a bfloat16 sum that it never rounded
    a, b, c, d = wild(4, dtype, columns=4000, spread=1)

    @jax.jit
    def run(a, b, c, d, zero):
        products = jnp.stack([a * b, c * d])
        pairs = jnp.stack([a, b])
        sums = [r(t, zero) for t in (products, pairs) for r in (Sequential(), Pairwise())]
        return [x.astype(jnp.float32) if dtype == ml_dtypes.bfloat16 else x for x in sums]

    seen = run(*(jnp.asarray(x) for x in (a, b, c, d)), zero_bits(dtype))
    for total, expected in zip(seen, [a * b + c * d] * 2 + [a + b] * 2, strict=True):
        assert np.array_equal(np.asarray(total).astype(np.float64), expected.astype(np.float64))


def test_orders_are_programs_of_their_own():
    terms = wild(88)
    seen = {name: np.asarray(total).tobytes() for name, total in every_sum(jnp.asarray(terms)).items()}
    orders = ["sequential", "reversed", "permuted", "pairwise", "blocked", "sorted"]
    assert len({seen[name] for name in orders}) == len(orders)
    permuted = {np.asarray(Permuted(seed)(jnp.asarray(terms))).tobytes() for seed in range(3)}
    assert len(permuted) == 3


@jax.jit
def every_stream(terms):
    """As the force loop does it: blocks of eight terms through a scan."""

    def step(totals, some):
        taken = {n: BY_NAME[n].within(totals[n], [some[k] for k in range(8)]) for n in BY_NAME}
        return {n: total for n, (total, _) in taken.items()}, {n: later for n, (_, later) in taken.items()}

    blocks = terms.reshape(-1, 8, *terms.shape[1:])
    totals, later = lax.scan(step, dict.fromkeys(BY_NAME, jnp.zeros(terms.shape[1:], terms.dtype)), blocks)
    return {n: BY_NAME[n].finish(totals[n], later[n]) for n in BY_NAME}


@pytest.mark.parametrize("slots,dtype", [(8, np.float32), (88, np.float64)])
def test_blocks_that_stream_give_the_sum_of_the_array(slots, dtype):
    terms = wild(slots, dtype)
    expected = {name: np.asarray(total) for name, total in every_sum(jnp.asarray(terms)).items()}
    # these two stream, with the bits that molecular dynamics had before other orders came
    expected["sequential"] = loop(terms)
    expected["pairwise"] = tree([tree(list(block)) for block in terms.reshape(-1, 8, terms.shape[1])])
    for name, streamed in every_stream(jnp.asarray(terms)).items():
        # slots beyond the range of fixed point are NaN on both sides
        assert np.array_equal(np.asarray(streamed), expected[name], equal_nan=name == "fixed-point"), name


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_derivative_is_that_of_a_sum(dtype):
    terms = jnp.asarray(wild(9, dtype, columns=4, spread=1))
    weights = jnp.asarray([1.0, 2.0, 0.5, -3.0], dtype)
    tangent = jnp.full((9, 4), 0.25, dtype)

    @jax.jit
    def derivatives(t):
        return {
            name: (jax.grad(lambda x, r=r: jnp.sum(weights * r(x)))(t), jax.jvp(r, (t,), (tangent,))[1])
            for name, r in BY_NAME.items()
        }

    for backward, forward in derivatives(terms).values():
        assert np.array_equal(np.asarray(backward), np.broadcast_to(np.asarray(weights), (9, 4)))
        assert np.array_equal(np.asarray(forward), np.full(4, 9 * 0.25, dtype))


@pytest.mark.parametrize("name", ["kahan", "exact", "fixed-point"])
def test_the_second_derivative_is_that_of_a_sum(name):
    curvature = jax.jit(jax.hessian(lambda t: BY_NAME[name](t * t)))(jnp.arange(1.0, 4.0))
    assert np.array_equal(np.asarray(curvature), 2 * np.eye(3))


def test_pairwise_keeps_more_of_many_equal_terms():
    terms = jnp.full((4096, 1), 0.1, np.float32)
    exact = 4096 * float(np.float32(0.1))
    rounded, balanced = (float(r(terms)[0]) for r in (Sequential(), Pairwise()))
    assert abs(balanced - exact) < 1e-3 < abs(rounded - exact)


def test_a_half_that_counts_stops_counting_in_half_precision():
    # 2048 + 1 rounds to 2048 in float16: the loop stands still, the others do not
    ones = jnp.ones(4096, jnp.float16)
    seen = {name: float(total) for name, total in every_sum(ones).items()}
    assert {name for name, total in seen.items() if total == 2048} == {
        "sequential", "reversed", "permuted", "sorted"
    }  # fmt: skip
    assert set(seen.values()) == {2048, 4096}


def test_a_sum_of_nothing_is_zero_and_of_one_term_that_term():
    for nothing in every_sum(jnp.zeros((0, 3), jnp.float16)).values():
        assert np.array_equal(np.asarray(nothing), np.zeros(3))
    for single in every_sum(jnp.asarray([1.5], jnp.float32)).values():
        assert float(single) == 1.5


def test_reductions_have_names_and_numbers():
    assert parse("blocked:8") == Blocked(8)
    assert parse("reversed") == Sequential("reversed")
    assert parse("permuted:3") == Permuted(3)
    assert parse("fixed-point:30") == FixedPoint(30)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kahn", "no reduction 'kahn'.*Did you mean kahan"),
        ("exact:3", "'exact' takes no argument"),
        ("permuted:x", "'x' is not a whole number"),
        ("blocked:1", "width 1 adds nothing"),
    ],
)
def test_a_reduction_that_is_none(text, message):
    with pytest.raises(InputError, match=message):
        parse(text)


@pytest.mark.parametrize("count", [1, 2, 7, 24])
def test_sums_of_two_ends_are_two_loops(count):
    """The orders of neighbor formats, against loops that round every result to float32."""
    terms = np.random.default_rng(count).normal(size=(count, 5)).astype(np.float32)

    half, halves = count // 2, np.float32(0.5) * terms
    ends = [loop(part) if len(part) else np.zeros(5, np.float32) for part in (terms[:half], terms[half:])]
    expected = {Halves(): ends[0] + ends[1], Twice(): loop([loop(halves), *halves])}
    for reduction, sums in expected.items():
        found = np.asarray(reduction(jnp.asarray(terms)))
        assert np.array_equal(found, sums)
        exact = [float(sum(Fraction(float(t)) for t in column)) for column in terms.T]
        assert (np.abs(found - np.array(exact)) <= reduction.bound(terms)).all()
