"""Duplicate entries of a sparse tensor are summed in the order in which they are stored."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mdnum.numerics.reductions import Exact, FixedPoint, orders, scatter_add, segment_sum
from mdnum.numerics.sums import Sequential
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Contacts, the floor panels that they load, and the orders in which they may be stored.
CONTACTS, PANELS, ORDERS = 96, 6, 1000


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
