"""Check numerically how smooth a user's pair function is inside the cutoff.

A run records the flips at the cutoff. A run records no flip at a discontinuity of the pair function itself,
for example between two pieces. Derivatives of the run do not include this discontinuity.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations_with_replacement, pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.audit.curve import SMOOTH, Curve, Jump, bisect, find_jumps
from mdnum.md.potentials import CutPotential, LennardJones, Morse, PairPotential, SoftSphere
from mdnum.numerics.jaxprs import narrows
from mdnum.systems.simulation import Simulation
from mdnum.systems.structures import nearest_distance

#: Number of intervals of a scan; two discontinuities in one interval may be taken for one.
_INTERVALS = 240
#: Range of a scan: factor on the shortest initial distance, and extension beyond the cutoff relative to it,
#: so that a discontinuity at the cutoff itself is found.
_CLOSER, _BEYOND = 0.9, 0.02
#: Derivatives at the cutoff below this share of their median over the outer half count as rounding errors;
#: the first value is for the energy.
_NOTHING = (1e-12, 1e-9)
#: Number of peaks of the force that are examined, and number of ninefold magnifications of each; at a pole,
#: the ratio to the surrounding median at each level, and the final ratio to the median of the whole range.
_PEAKS, _ZOOMS, _SHARP, _LARGE = 8, 8, 3.0, 1e3
#: Share by which a force differs from the derivative of the energy at half of all distances.
_WRONG = 1e-4
#: Number of wrong intervals above which a table is assumed, the width of narrow intervals, and the relative
#: change of a constant force.
_FEW, _NARROW, _STRAIGHT = 3, 1e-3, 1e-9
_ORDERS = ("energy", "force", "curvature", "third derivative")


def examined(simulation: Simulation) -> dict[str, Any] | None:
    """Find discontinuities of a user's pair functions inside the cutoff.

    Returns:
        None if all potentials belong to mdnum, else plain values: `from` and `to`, length; `smoothness`, the
        number of derivatives of the cut energy that do not jump at the cutoff (-1: the energy jumps; 3: or
        more); `places`, a row each: `term`, `pair`, `distance`, the `order` of the lowest derivative of the
        energy that jumps (0: the energy, 1: the force), its name `what` and its `jump`, beyond minus before.
        Where the function is "singular" or "not finite" the order is -1; it is -2 where the "force" is not
        minus the derivative of the energy, as with a wrong `custom_jvp`. If the energy is piecewise linear,
        the row of the largest kink stands for all `kinks` `between` two distances; kinks within 1/1920 of the
        range count as one. `single`: whether a function rounds to float32 internally.

    Error:
        a force step of 1e-6 of the force scale and a curvature step of 1e-4 of its scale are found, if no
        other discontinuity is within 1/240 of the range.
    """
    if not simulation.pairwise:
        return None
    terms = {
        name: term for name, term in simulation.model.terms.items()
        if not isinstance(term.potential, LennardJones | Morse | SoftSphere)
    }  # fmt: skip
    if not terms:
        return None
    low = _CLOSER * nearest_distance(simulation.structure, simulation.r_cut)
    places, order = [], SMOOTH
    for name, term in terms.items():
        own, shared = term.potential.typed.split()
        walk, ends = _walked(shared), _ends(term.cutoff, shared)
        for kind, pair in enumerate(combinations_with_replacement(simulation.symbols, 2)):
            single = jax.tree.map(lambda leaf, kind=kind: leaf[kind], own)
            r_cut = float(term.r_cut[kind])
            last = ends(single, term.r_cut[kind], term.r_onset[kind], np.linspace(0.5, 1, 101) * r_cut)
            order = min(order, _order(np.asarray(last)))
            at = {"term": name, "pair": "-".join(pair)}
            places += [at | row for row in _breaks(partial(walk, single), low, r_cut)]
    single = any(narrows(jax.make_jaxpr(one.potential.typed.evaluate)(one.r_cut)) for one in terms.values())
    return {"from": low, "to": simulation.r_cut, "smoothness": order, "places": places, "single": single}


def _walked(shared: PairPotential) -> Callable[..., tuple[float, float]]:
    """Return a function that computes the energy and force of a pair from its parameters and distance."""

    @jax.jit
    def evaluate(own, r):
        def energy(r):
            return eqx.combine(own, shared).evaluate(r * r)[0]

        u, slope = jax.jvp(energy, (r,), (jnp.ones_like(r),))
        return u, -slope

    return lambda own, r: tuple(float(value) for value in evaluate(own, np.float64(r)))  # type: ignore[return-value]


def _ends(cutoff: Any, shared: PairPotential) -> Callable[..., Any]:
    """Return a function for the truncated energy and its first derivatives at given distances."""

    @jax.jit
    def evaluate(own, r_cut, r_onset, r):
        whole = CutPotential(eqx.combine(own, shared), cutoff, r_cut[None], r_onset[None])
        at = jax.tree.map(lambda leaf: jnp.reshape(leaf, ()), whole.at_cutoff())

        def energy(r):
            return cutoff.cut(r * r, *whole.potential.evaluate(r * r), at)[0]

        made = [energy]
        for _ in range(SMOOTH):
            made.append(lambda r, f=made[-1]: jax.jvp(f, (r,), (jnp.ones_like(r),))[1])
        return jnp.stack([f(r * (1 - 2.0**-44)) for f in made])

    return evaluate


def _order(derivatives: np.ndarray) -> int:
    """Return the order of the highest continuous energy derivative at the cutoff. -1 if the energy jumps."""
    for order, row in enumerate(derivatives):
        usual = float(np.median(np.abs(row[np.isfinite(row)]))) if np.isfinite(row).any() else 0.0
        if not abs(row[-1]) <= _NOTHING[min(order, 1)] * usual:
            return order - 1
    return SMOOTH


def _breaks(at: Callable[[float], tuple[float, float]], low: float, r_cut: float) -> list[dict[str, Any]]:
    """Return defects of a pair function between two distances, as table rows."""
    step = (r_cut - low) / _INTERVALS
    curve, high = Curve(at), r_cut * (1 + _BEYOND)
    grid = np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)
    values = curve.many(grid)
    good = np.logical_and(*np.isfinite(values))
    nothing, rows = {"order": -1, "what": "singular", "jump": None}, []
    for k in np.flatnonzero(good[1:] != good[:-1]):
        ends = bisect(lambda r: bool(np.isfinite(curve(r)).all()), grid[k], grid[k + 1])
        rows.append({"distance": float(ends[int(good[k])]), **nothing, "what": "not finite"})
    poles = [{"distance": one, **nothing} for one in _poles(curve, grid, np.abs(values[1]))]
    rows += [one for one in poles if all(abs(one["distance"] - row["distance"]) > step for row in rows)]
    inside, straight = values[:, grid <= r_cut], False
    share = _share(np.lib.stride_tricks.sliding_window_view(inside, 4, axis=1), step), grid[1:]
    if np.sum(share[0] > _WRONG) > _FEW:
        # few of narrow intervals have a kink of a table
        close, width = np.linspace(low, r_cut, 8 * _INTERVALS + 1), _NARROW * step
        four = curve.many((close[:, None] + width * np.arange(-1, 3)).ravel()).reshape(2, -1, 4)
        share = min(share, (_share(four, width), close), key=lambda one: np.nanmedian(one[0]))
        force = four[1, :, 1]
        straight = np.mean(np.ptp(four[1], axis=1) < _STRAIGHT * np.abs(force)) > 0.5
    # between two of them, or one and an end
    ends = [low - 4 * step, *sorted(row["distance"] for row in rows), high + 4 * step]
    for left, right in pairwise(ends):
        start, end = left + 4 * step, right - 4 * step
        if end - start > 20 * step and np.isfinite(curve(0.5 * (start + end))).all():
            found, _ = find_jumps(curve, start, end, step, _FEW if straight else 24)
            rows += [_row(jump) for jump in found]
    if straight:
        jumps = np.diff(force)
        kinks = np.flatnonzero(np.abs(jumps) > _STRAIGHT * np.abs(force[1:]))
        rows = [row for row in rows if row["order"] < 1]
        for k in kinks[np.argsort(-np.abs(jumps[kinks]))][:1]:
            half = float(force[k] + force[k + 1]) / 2
            place, _ = bisect(lambda r, half=half: bool(curve(r)[1] > half), *close[k : k + 2].tolist())
            rows.append({"distance": place, "order": 1, "what": _ORDERS[1], "jump": float(jumps[k])})
            rows[-1] |= {"kinks": len(kinks), "between": close[kinks[[0, -1]] + [0, 1]].tolist()}
    if np.nanmedian(share[0]) > _WRONG:
        worst = float(share[1][np.nanargmax(share[0])])
        rows.append({"distance": worst, "order": -2, "what": "force", "jump": None})
    # beyond its cutoff a function may do as it likes
    return sorted(
        (row for row in rows if row["distance"] <= r_cut * (1 + 1e-12)), key=lambda row: row["distance"]
    )


def _share(four: np.ndarray, width: float) -> np.ndarray:
    """Relative difference between the energy change and the work of the interpolated force."""
    u, f = np.moveaxis(four, -1, 1)
    with np.errstate(invalid="ignore"):
        change, work = u[2] - u[1], (13 * (f[1] + f[2]) - f[0] - f[3]) * width / 24
        return np.abs(change + work) / (np.abs(change) + np.abs(work) + 1e-300)


def _poles(curve: Curve, grid: np.ndarray, force: np.ndarray) -> list[float]:
    """Return distances at which the force grows whenever the points are more closely spaced."""
    inner = force[1:-1]
    peaks = 1 + np.flatnonzero((inner >= force[:-2]) & (inner >= force[2:]) & (inner > 0))
    found, usual = [], np.median(force[np.isfinite(force)])
    for k in peaks[np.argsort(-force[peaks])][:_PEAKS]:
        left, right = grid[k - 1], grid[k + 1]
        for _ in range(_ZOOMS):
            places = np.linspace(left, right, 19)
            seen = np.nan_to_num(np.abs(curve.many(places)[1]), nan=np.inf)
            best = int(np.argmax(seen[1:-1])) + 1
            if not seen[best] > _SHARP * np.median(seen):
                break
            left, right = places[best - 1], places[best + 1]
        else:
            if seen[best] > _LARGE * usual:
                found.append(float(places[best]))
    return found


def _row(jump: Jump) -> dict[str, Any]:
    sizes = jump.energy, jump.force, jump.curvature, jump.third
    return {
        "distance": jump.at,
        "order": jump.order,
        "what": _ORDERS[jump.order],
        "jump": sizes[jump.order],
    }
