"""Duplicate entries of a sparse tensor are summed in the order in which they are stored."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.numerics.reductions import Exact, FixedPoint
from mdnum.numerics.sums import Reduction, Sequential
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Contacts, the floor panels that they load, and the orders in which they may be stored.
CONTACTS, PANELS, ORDERS = 96, 6, 1000


def segment_sum(
    values: Float[Array, "entries ..."],
    index: Int[np.ndarray, "entries"],
    segments: int,
    reduction: Reduction = Sequential(),
) -> Float[Array, "segments ..."]:
    """Sum each segment in the order of a reduction, rounding after every addition.

    Args:
        values: the entries.
        index: segment of each entry, known (not traced), not necessarily sorted.
        segments: number of segments.
        reduction: applied to each segment's entries in storage order.

    Raises:
        InputError: an index outside 0 ... segments - 1.
    """
    index = np.asarray(index)
    if len(index) and not (index.min() >= 0 and index.max() < segments):
        raise InputError(f"a segment index is outside the range 0 to {segments - 1}")
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index, minlength=segments)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1]
    place = np.arange(len(index)) - np.repeat(starts, counts)
    shape = (int(counts.max(initial=0)), segments, *values.shape[1:])
    # shorter segments end in minus zeros, which change no sum and no sign
    side_by_side = jnp.full(shape, -0.0, values.dtype).at[place, index[order]].set(values[order])
    return reduction(side_by_side)


def scatter_add(
    values: Float[Array, "entries ..."], index: Int[Array, "entries"], segments: int
) -> Float[Array, "segments ..."]:
    """Sum each segment by XLA's scatter: in storage order on a CPU, in any order on a device."""
    return jnp.zeros((segments, *values.shape[1:]), values.dtype).at[index].add(values)


def orders(entries: int, count: int, seed: int = 0) -> list[Int[np.ndarray, "entries"]]:
    """Return storage orders to test: as given, reversed, and random orders up to `count` in total."""
    rng = np.random.default_rng(seed)
    given = np.arange(entries)
    return [given, given[::-1], *(rng.permutation(entries) for _ in range(count - 2))][:count]


def contacts() -> tuple[np.ndarray, np.ndarray]:
    """Return a load (N, float32) for each contact, and its panel; several loads share a panel."""
    rng = np.random.default_rng(5)
    return rng.permutation(np.arange(CONTACTS) % PANELS), rng.lognormal(0, 1.5, CONTACTS).astype(np.float32)


def assembled(panel: np.ndarray, load: np.ndarray) -> dict[str, np.ndarray]:
    """Return the load of every panel, shape (orders, panels), for each method of summation."""
    storage = np.array(orders(CONTACTS, ORDERS, seed=1))
    # sorted by panel, stably: duplicates stay as they were stored
    within = np.array([order[np.argsort(panel[order], kind="stable")] for order in storage])
    segment = np.sort(panel)
    by_value = np.lexsort((load, panel))
    stored = jnp.asarray(load[within].T)

    def by(reduction, values=stored):
        return np.asarray(jax.jit(lambda v: segment_sum(v, segment, PANELS, reduction))(values)).T

    scattered = jax.jit(jax.vmap(lambda v, i: scatter_add(v, i, PANELS)))
    return {
        "scatter-add, storage order": np.asarray(
            scattered(jnp.asarray(load[storage]), jnp.asarray(panel[storage]))
        ),
        "coalesced, sorted by index": by(Sequential()),
        "coalesced, sorted by index and value": by(
            Sequential(), jnp.asarray(np.broadcast_to(load[by_value], (ORDERS, CONTACTS)).T)
        ),
        "exact sum": by(Exact()),
        "fixed point": by(FixedPoint(24)),
    }


def run() -> Demo:
    """Sum one sparse vector in a thousand storage orders, with a decision about each panel."""
    panel, load = contacts()
    sums = assembled(panel, load)
    exact = sums["exact sum"][0]
    # a panel yields at its load: with the limit there, the last bit decides
    yields = {name: int((found < exact).any(axis=1).sum()) for name, found in sums.items()}
    distinct = {name: len({row.tobytes() for row in found}) for name, found in sums.items()}
    ulps = {
        name: float(np.abs((found.astype(float) - exact) / np.spacing(exact)).max())
        for name, found in sums.items()
    }
    loose, by_index = distinct["scatter-add, storage order"], distinct["coalesced, sorted by index"]
    held = sums["scatter-add, storage order"]
    rows = tuple((name, distinct[name], ulps[name], yields[name]) for name in sums)
    return Demo(
        title="Coalescing is a reduction",
        question=(
            f"{CONTACTS} contacts load {PANELS} panels. In how many ways can the same entries be added, "
            f"and does the decision about any panel change?"
        ),
        result=(
            f"{ORDERS} storage orders of the same sparse entries give {loose} different sums; summed "
            f"exactly, they give one sum."
        ),
        answer=(
            f"In {ORDERS} storage orders a scattered addition gives {loose} different vectors, and in "
            f"{yields['scatter-add, storage order']} of them the computed load of a panel at exactly "
            f"its limit is below the limit. Sorting by index alone changes nothing ({by_index}), "
            f"because duplicates stay in storage order. If duplicates are also sorted by value, summed "
            f"exactly, or summed in fixed point, there is 1 result; the last two methods are also correct."
        ),
        numbers={
            "distinct_scatter_add": loose,
            "distinct_sorted_by_index": by_index,
            "distinct_sorted_by_value": distinct["coalesced, sorted by index and value"],
            "distinct_exact": distinct["exact sum"],
            "distinct_fixed_point": distinct["fixed point"],
            "orders": ORDERS,
            "decisions_that_flip": yields["scatter-add, storage order"],
            "largest_error_ulps": ulps["scatter-add, storage order"],
        },
        checks=[
            Claim("the storage order determines the bits", loose, "more than 100 of 1000", loose > 100),
            Claim("a sort by index does not help", by_index, f"{loose}, as scattered", by_index == loose),
            *(
                Claim(f"{name}: one answer", distinct[name], "1", distinct[name] == 1)
                for name in ("coalesced, sorted by index and value", "exact sum", "fixed point")
            ),
            Claim(
                "and with the bits a decision",
                yields["scatter-add, storage order"],
                f"some of {ORDERS}, not all",
                0 < yields["scatter-add, storage order"] < ORDERS,
            ),
        ],
        tables=[
            table(
                f"{ORDERS} storage orders of the same entries",
                (
                    "way of adding",
                    "distinct results",
                    "largest error (ulps)",
                    "orders with a panel too low",
                ),
                rows,
            )
        ],
        plots=[_spread(held[:, 0], exact[0])],
        in_md=(
            "A list with both (i, j) and (j, i), forces scattered to atoms, and atomic additions on "
            "a device are also sums of duplicates, in an order that the program does not specify."
        ),
        data={"panel": panel, "load": load, "distinct": distinct, "below_limit": yields},
    )


def _spread(found: np.ndarray, exact: np.float32) -> Plot:
    ulps = np.rint((found.astype(float) - exact) / np.spacing(exact)).astype(int)
    values = np.arange(ulps.min() - 1, ulps.max() + 2)
    counts = np.array([(ulps == value).sum() for value in values])
    return Plot(
        "load-first",
        title="Load of the first panel over all storage orders",
        x_label="computed - exact (ulps)",
        y_label="storage orders",
        series=(Series("scatter-add", values, counts, "steps", "bad"),),
        caption="Left of zero the computed load is below the limit, although the exact load equals the "
        "limit.",
        verticals=((0.0, "exact"),),
    )
