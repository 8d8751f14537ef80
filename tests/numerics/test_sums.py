"""Every order of a sum: against the same sum written out, exact rationals and math.fsum."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from rollout.harness import evaluated, liquid, listed, terms_of, write_system

from mdnum.errors import InputError
from mdnum.numerics.exact import zero_bits
from mdnum.numerics.reductions import BY_NAME, Exact, FixedPoint, parse
from mdnum.numerics.sums import (
    Blocked,
    Halves,
    Pairwise,
    Permuted,
    Sequential,
    Sorted,
    Twice,
)
from mdnum.systems import load
from mdnum.systems.build import build

DTYPES = [np.float64, np.float32, np.float16, ml_dtypes.bfloat16]
#: A program for each dtype: the widest and the one that XLA widens, and every night those between them.
ENDS = [
    np.float64,
    *(pytest.param(dtype, marks=pytest.mark.nightly) for dtype in (np.float32, np.float16)),
    ml_dtypes.bfloat16,
]


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
    # the orders of neighbor formats
    (Halves(), lambda t: loop(t[: len(t) // 2]) + loop(t[len(t) // 2 :])),
    (Twice(), lambda t: loop([loop(t * t.dtype.type(0.5)), *(t * t.dtype.type(0.5))])),
]


def wild(count, dtype=np.float64, columns=16, spread=8):
    rng = np.random.default_rng(11)
    scale = 10.0 ** rng.integers(-spread, spread, (count, columns))
    return (rng.normal(size=(count, columns)) * scale).astype(dtype)


# no more than 24 terms: the bounds of bfloat16 end there
FEW = {**BY_NAME, "fixed-point": FixedPoint(20), "blocked": Blocked(8), "halves": Halves(), "twice": Twice()}


@jax.jit
def every_sum(terms):
    """All reductions in one program, which compiles sooner than ten; most tests sum 24 rows of 16."""
    return {name: reduction(terms) for name, reduction in FEW.items()}


def spread_of(dtype):
    return 2 if np.dtype(dtype).itemsize == 2 else 8


@jax.jit
def all_written_out(terms, zero):
    return [reduction(terms, zero) for reduction, _ in WRITTEN_OUT]


@jax.jit
def all_without_a_zero(terms):
    """What the sum enters is fused with it."""
    return [reduction(terms).astype(jnp.float64) * 2 for reduction, _ in WRITTEN_OUT]


def test_no_term_goes_through_more_additions_than_the_bound_is_made_for():
    """An addition that counts: a sum is as deep as its deeper addend, and one more."""
    cases = [
        (reduction, terms)
        for reduction in (Sequential(), Blocked(3), Halves(), Twice())
        for terms in (1, 2, 3, 8, 9)
    ]

    @jax.jit
    def depths():
        return [
            reduction.sum_of(jnp.zeros(terms), lambda a, b: jnp.maximum(a, b) + 1)
            for reduction, terms in cases
        ]

    for (reduction, terms), found in zip(cases, depths(), strict=True):
        # the first term of a loop is added to zero, which rounds nothing
        assert int(found) - (not isinstance(reduction, Blocked)) == reduction.depth(terms), (reduction, terms)


@pytest.mark.parametrize("dtype", ENDS)
def test_a_sum_of_an_array_has_the_bits_of_the_loop(dtype):
    # not a multiple of a width: the last node of each tree is short
    terms = wild(43, dtype, spread=spread_of(dtype))
    seen = all_written_out(jnp.asarray(terms), zero_bits(dtype))
    for (reduction, written), total in zip(WRITTEN_OUT, seen, strict=True):
        expected = written(terms)
        assert expected.dtype == dtype
        assert np.array_equal(np.asarray(total), expected), reduction


@pytest.mark.parametrize("dtype", ENDS[2:])
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


def test_orders_are_programs_of_their_own_with_the_derivatives_of_a_sum():
    terms = wild(24)
    seen = {name: np.asarray(total).tobytes() for name, total in every_sum(jnp.asarray(terms)).items()}
    orders = ["sequential", "reversed", "permuted", "pairwise", "blocked", "sorted"]
    assert len({seen[name] for name in orders}) == len(orders)
    curvature = jax.jit(jax.hessian(lambda t: BY_NAME["kahan"](t * t)))(jnp.arange(1.0, 4.0))
    assert np.array_equal(np.asarray(curvature), 2 * np.eye(3))


@jax.jit
def every_stream(terms):
    """As the force loop does it: blocks of eight terms through a scan."""

    def step(totals, some):
        taken = {n: FEW[n].within(totals[n], [some[k] for k in range(8)]) for n in FEW}
        return {n: total for n, (total, _) in taken.items()}, {n: later for n, (_, later) in taken.items()}

    blocks = terms.reshape(-1, 8, *terms.shape[1:])
    totals, later = lax.scan(step, dict.fromkeys(FEW, jnp.zeros(terms.shape[1:], terms.dtype)), blocks)
    return {n: FEW[n].finish(totals[n], later[n]) for n in FEW}


@pytest.mark.parametrize(
    "slots,dtype",
    [
        (24, np.float64),
        *(pytest.param(*case, marks=pytest.mark.nightly) for case in [(8, np.float32), (88, np.float64)]),
    ],
)
def test_blocks_that_stream_give_the_sum_of_the_array(slots, dtype):
    terms = wild(slots, dtype)
    expected = {name: np.asarray(total) for name, total in every_sum(jnp.asarray(terms)).items()}
    # these two stream, with the bits that molecular dynamics had before other orders came
    expected["sequential"] = loop(terms)
    expected["pairwise"] = tree([tree(list(block)) for block in terms.reshape(-1, 8, terms.shape[1])])
    for name, streamed in every_stream(jnp.asarray(terms)).items():
        # slots beyond the range of fixed point are NaN on both sides
        assert np.array_equal(np.asarray(streamed), expected[name], equal_nan=name == "fixed-point"), name


@pytest.mark.parametrize("dtype", ENDS)
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


def test_a_sum_of_nothing_is_zero_and_of_one_term_that_term():
    for nothing in every_sum(jnp.zeros((0, 3), jnp.float16)).values():
        assert np.array_equal(np.asarray(nothing), np.zeros(3))
    for single in every_sum(jnp.asarray([1.5], jnp.float32)).values():
        assert float(single) == 1.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kahn", "'kahn'.*mean kahan"),
        ("exact:3", "'exact' takes no argument"),
        ("permuted:x", "'x' .*integer"),
        ("blocked:1", "cannot have width 1"),
    ],
)
def test_a_reduction_that_is_none(text, message):
    with pytest.raises(InputError, match=message):
        parse(text)
    assert (parse("blocked:8"), parse("fixed-point:30")) == (Blocked(8), FixedPoint(30))


# --- sums of integers -----------------------------------------------------------------------------------

EXACT = jax.jit(Exact())
PATTERN = {8: np.int64, 4: np.int32, 2: np.int16}


def nearest(value: Fraction, dtype):
    """The float nearest to a rational, ties to even: tried among the neighbors of a first guess."""
    largest = Fraction(float(ml_dtypes.finfo(dtype).max))
    spacing = largest - Fraction(float(np.nextafter(ml_dtypes.finfo(dtype).max, dtype(0))))
    if abs(value) >= largest + spacing / 2:
        return dtype(np.inf if value > 0 else -np.inf)
    guess = dtype(max(-float(largest), min(float(largest), float(value))))
    around = [guess, np.nextafter(guess, dtype(np.inf)), np.nextafter(guess, dtype(-np.inf))]
    around = [g for g in around if np.isfinite(g)]
    gaps = [abs(Fraction(float(g)) - value) for g in around]
    best = [g for g, gap in zip(around, gaps, strict=True) if gap == min(gaps)]
    integer = PATTERN[np.dtype(dtype).itemsize]
    return min(best, key=lambda g: int(np.asarray(g).view(integer)) & 1)


def any_bits(dtype, count):
    """Arrays of arbitrary finite bit patterns, subnormals and extremes included."""
    integer = PATTERN[np.dtype(dtype).itemsize]
    info = np.iinfo(integer)

    def finite(patterns):
        x = np.array(patterns, integer).view(dtype)
        return np.where(np.isfinite(x), x, dtype(1))

    return st.lists(st.integers(int(info.min), int(info.max)), min_size=count, max_size=count).map(finite)


@pytest.mark.parametrize("dtype", DTYPES)
@given(data=st.data())
@settings(max_examples=60)
@np.errstate(all="ignore")
def test_the_exact_sum_is_the_rational_sum_rounded_once(dtype, data):
    terms = data.draw(any_bits(dtype, 6))
    if data.draw(st.booleans()):  # nearly cancelling, so that the rounding is decided far down
        terms[3:5] = -terms[:2]
    exact = sum((Fraction(float(t)) for t in terms), Fraction(0))
    seen = np.asarray(EXACT(jnp.asarray(terms)))
    expected = nearest(exact, dtype)
    assert seen.view(PATTERN[seen.dtype.itemsize]) == np.abs(expected).view(PATTERN[seen.dtype.itemsize]) or (
        seen.tobytes() == np.asarray(expected).tobytes()
    )
    assert float(seen) == float(expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_ties_go_to_even_and_a_bit_far_below_breaks_them(dtype):
    info = ml_dtypes.finfo(dtype)
    one, half_ulp, tiny = dtype(1), dtype(float(info.eps) / 2), info.smallest_subnormal
    for terms, expected in [
        ([one, half_ulp], 1.0),
        ([one, half_ulp, tiny], 1.0 + float(info.eps)),
        ([one, half_ulp, -tiny], 1.0),
        ([one + dtype(info.eps), half_ulp], 1.0 + 2 * float(info.eps)),
        ([tiny, tiny, tiny], 3 * float(tiny)),
        ([info.max, info.max, -info.max], float(info.max)),
        ([info.max, info.max], math.inf),
        ([-info.max, -info.max], -math.inf),
    ]:
        padded = np.zeros(6, dtype)
        padded[: len(terms)] = terms
        assert float(np.asarray(EXACT(jnp.asarray(padded)))) == expected


def test_columns_are_summed_apart_and_infinities_are_kept():
    rng = np.random.default_rng(2)
    terms = rng.normal(size=(100, 3, 5)) * 10.0 ** rng.integers(-200, 200, (100, 3, 5))
    seen = np.asarray(EXACT(jnp.asarray(terms)))
    assert seen.shape == (3, 5)
    expected = [[math.fsum(terms[:, i, j]) for j in range(5)] for i in range(3)]
    assert np.array_equal(seen, expected)
    assert np.array_equal(np.asarray(EXACT(jnp.asarray(rng.permutation(terms)))), expected)
    special = np.array([[1.0, np.inf, np.inf, np.nan], [2.0, 1.0, -np.inf, 0.0]])
    assert np.array_equal(
        np.asarray(EXACT(jnp.asarray(special))), [3.0, np.inf, np.nan, np.nan], equal_nan=True
    )


def test_a_fixed_point_sum_is_a_sum_of_rounded_integers():
    rng = np.random.default_rng(4)
    terms = rng.normal(size=(50, 6))
    expected = [sum(round(Fraction(v) * 2**20) for v in column) / 2**20 for column in terms.T]
    assert np.array_equal(np.asarray(FixedPoint(20)(jnp.asarray(terms))), expected)
    # a coarse unit loses the small terms altogether
    assert float(FixedPoint(0)(jnp.asarray([0.4] * 10))) == 0.0
    # out of range is said, never wrapped
    assert np.isnan(float(FixedPoint(40)(jnp.asarray([2.0**21, 1.0]) * 2)))
    assert float(FixedPoint(40)(jnp.asarray([2.0**21, 1.0]))) == 2.0**21 + 1
    with pytest.raises(InputError, match="bits = 2000"):
        FixedPoint(2000)


@pytest.mark.parametrize("dtype", ENDS)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=10)
def test_every_sum_is_within_its_bound_and_some_do_not_depend_on_the_order_of_arrival(dtype, seed):
    rng = np.random.default_rng(seed)
    terms = (rng.normal(size=(24, 16)) * 2.0 ** rng.integers(-6, 7, (24, 16))).astype(dtype)
    exact = [sum(Fraction(float(v)) for v in column) for column in terms.T]
    shuffled = every_sum(jnp.asarray(rng.permutation(terms)))
    for name, total in every_sum(jnp.asarray(terms)).items():
        if name in ("exact", "fixed-point", "sorted"):
            assert np.asarray(total).tobytes() == np.asarray(shuffled[name]).tobytes(), name
        pairs = zip(np.asarray(total), exact, strict=True)
        error = np.array([float(abs(Fraction(float(s)) - e)) for s, e in pairs])
        bound = FEW[name].bound(terms)
        assert np.isfinite(bound).all()
        assert (error <= bound).all(), name


# --- sums inside the force loop of molecular dynamics ---------------------------------------------------


#: Each compiles the force again: the gate has a few in float64 and the others in float32.
WIDE = ("sequential", "pairwise", "blocked", "kahan", "exact")
NAMES = [
    ("float64", WIDE),
    ("float32", tuple(name for name in BY_NAME if name not in WIDE)),
    pytest.param("float32", WIDE, marks=pytest.mark.nightly),
]
SAME_IN_EVERY_ORDER = ("sorted", "exact", "fixed-point")


def forces(sim, x, tables):
    """Force components and (twice) energies, shape (4, atoms)."""
    result = evaluated(sim.force, x, tables)
    return np.concatenate([np.asarray(result.force), 2 * np.asarray(result.energy)[None]])


def permuted(tables, seed):
    """The same list with its slots in another order."""
    shape = tables.index.shape
    flat = np.asarray(tables.index).reshape(-1, shape[-1])
    order = np.random.default_rng(seed).permutation(len(flat))
    return tables._replace(index=jnp.asarray(flat[order].reshape(shape)))


# a force is compiled for every reduction
@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "names"), NAMES)
def test_every_order_is_within_its_bound_and_some_do_not_depend_on_the_order_of_neighbors(
    dtype, names, tmp_path
):
    sim = build(load(write_system(tmp_path, liquid(), precision={"force": dtype, "accumulate": dtype})))
    x, _, tables = listed(sim)
    terms = terms_of(sim, x, tables)
    assert len(terms) == 5
    exact = [[sum(Fraction(float(v)) for v in column) for column in of.T] for of in terms]
    for name in names:
        one = replace(sim, reduction=BY_NAME[name])
        seen = forces(one, x, tables)
        for sums, of, true in zip(seen, terms, exact, strict=False):
            assert of.dtype == sums.dtype == dtype
            error = [abs(float(Fraction(float(s)) - e)) for s, e in zip(sums, true, strict=True)]
            assert (np.array(error) <= BY_NAME[name].bound(of)).all(), name
        same = [np.array_equal(forces(one, x, permuted(tables, seed)), seen) for seed in range(3)]
        # compensated sums mostly agree too, but nothing says that they must
        assert name in ("kahan", "neumaier") or same == [name in SAME_IN_EVERY_ORDER] * 3, name
