"""The ball in plain numpy and in exact rationals, one ball and one operation at a time; no code of mdnum."""

from __future__ import annotations

from fractions import Fraction

import ml_dtypes
import numpy as np

DTYPES = {
    "float64": np.float64,
    "float32": np.float32,
    "float16": np.float16,
    "bfloat16": ml_dtypes.bfloat16,
}


def fly(scheme, y, v, a, h):
    """One step of flight; every operation rounds in the type of its operands."""
    kind = type(y)
    half = kind(0.5) * h
    if scheme == "explicit-euler":
        return y + h * v, v + h * a
    if scheme == "semi-implicit-euler":
        v = v + h * a
        return y + h * v, v
    v = v + half * a
    return y + h * v, v + half * a


def penalty(scheme, y, v, h, g, k, c, steps):
    """Trajectory and contact decisions under k max(0, -y) - c v; numbers of one type, Fraction included."""
    kind = type(y)

    def pull(y, v, touching):
        drag = c * v if touching else kind(0)
        return -g + ((k * (-y) if touching else kind(0)) - drag)

    half = kind(0.5) * h
    carried = pull(y, v, y < 0)
    rows, decided = [(y, v)], []
    for _ in range(steps):
        if scheme == "velocity-verlet":
            middle = v + half * carried
            y = y + h * middle
            touching = y < 0
            carried = pull(y, middle, touching)
            v = middle + half * carried
        else:
            touching = y < 0
            y, v = fly(scheme, y, v, pull(y, v, touching), h)
        rows.append((y, v))
        decided.append(bool(touching))
    return rows, decided


def projection(scheme, ys, vs, h, g, alpha, k, e, tol, cap, steps, order=None):
    """A batch under one global sum, added in the given order; with iteration counts."""
    kind = type(ys[0])
    ys, vs = list(ys), list(vs)
    gain = alpha * k
    order = range(len(ys)) if order is None else order
    rows, decided, counts = [(tuple(ys), tuple(vs))], [], []
    for _ in range(steps):
        flown = [fly(scheme, y, v, -g, h) for y, v in zip(ys, vs, strict=True)]
        ys, vs = [y for y, _ in flown], [v for _, v in flown]
        touching = [y < 0 for y in ys]

        def left(ys=ys, touching=touching):
            return [-y if t and y < 0 else kind(0) for y, t in zip(ys, touching, strict=True)]

        count = 0
        while True:
            total = kind(0)
            depths = left(ys)
            for index in order:
                total = total + depths[index]
            if total < tol or count == cap:
                break
            ys = [y + gain * p for y, p in zip(ys, depths, strict=True)]
            count += 1
        ys = [kind(0) if t and y < 0 else y for y, t in zip(ys, touching, strict=True)]
        vs = [(-e * v if v < 0 else kind(0)) if t else v for v, t in zip(vs, touching, strict=True)]
        rows.append((tuple(ys), tuple(vs)))
        decided.append(touching)
        counts.append(count)
    return rows, decided, counts


def impact(scheme, y, v, h, g, e, rest, steps):
    """The naive time stepper: on the floor and reset at the end of the step that passed it."""
    kind = type(y)
    rows, decided = [(y, v)], []
    for _ in range(steps):
        y, v = fly(scheme, y, v, -g, h)
        touching = y < 0
        if touching:
            rebound = -e * v if v < 0 else kind(0)
            y, v = kind(0), kind(0) if rebound <= rest else rebound
        rows.append((y, v))
        decided.append(bool(touching))
    return rows, decided


def rational(*values):
    """Floats as the exact rationals that they are."""
    return tuple(Fraction(float(value)) for value in values)
