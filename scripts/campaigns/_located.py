"""Lennard-Jones atoms whose pairs cross a hard cutoff when they do: a reference for gradients.

Velocity Verlet within a substep moves atoms along parabolas, so the first time at which any pair is at its
cutoff is a root of a polynomial. The substep ends there, the pair enters or leaves, and the rest follows with
the other force. Losses of such a run are smooth functions of the parameters, with no jump where a crossing
comes a step earlier, so that central differences over tiny shifts have many digits. It shares no code with
mdnum and no approximation but the substep.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

#: What `losses` returns, in this order.
LOSSES = ("msd", "vacf", "temperature", "potential", "last potential")
#: How far beyond the cutoff pairs are listed for one step, as a share of it.
_SKIN = 0.08


@njit(cache=True)
def _listed(x, box, far, out):
    """Pairs nearer than `far`; their number."""
    count = 0
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            r2 = 0.0
            for c in range(3):
                d = x[j, c] - x[i, c]
                d -= box[c] * np.round(d / box[c])
                r2 += d * d
            if r2 < far * far:
                out[count, 0], out[count, 1] = i, j
                count += 1
    return count


@njit(cache=True)
def _forces(x, box, pairs, inside, sigma, epsilon, shift, a, masses):
    """Accelerations into `a`; the potential energy."""
    a[:] = 0.0
    energy = 0.0
    d = np.zeros(3)
    for p in range(len(pairs)):
        i, j = pairs[p]
        if not inside[i, j]:
            continue
        r2 = 0.0
        for c in range(3):
            d[c] = x[j, c] - x[i, c]
            d[c] -= box[c] * np.round(d[c] / box[c])
            r2 += d[c] * d[c]
        s6 = (sigma * sigma / r2) ** 3
        energy += 4 * epsilon * (s6 * s6 - s6) - shift
        f = 24 * epsilon * (2 * s6 * s6 - s6) / r2
        for c in range(3):
            a[i, c] -= f * d[c] / masses[i]
            a[j, c] += f * d[c] / masses[j]
    return energy


@njit(cache=True)
def _root(d, w, b, r2, low, high, was):
    """Where |d + w t + b t²/2|² passes r², between times of which only the later one is on the other side."""
    for _ in range(80):
        t = 0.5 * (low + high)
        g = 0.0
        for c in range(3):
            y = d[c] + t * (w[c] + 0.5 * t * b[c])
            g += y * y
        if (g < r2) == was:
            low = t
        else:
            high = t
    return high


@njit(cache=True)
def _first(x, v, a, box, pairs, inside, radius, rest):
    """The first crossing within `rest`: its time and pair; -1 where there is none."""
    best, found = rest, -1
    r2 = radius * radius
    d, w, b = np.zeros(3), np.zeros(3), np.zeros(3)
    for p in range(len(pairs)):
        i, j = pairs[p]
        now, speed2, then, along, end = 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            d[c] = x[j, c] - x[i, c]
            d[c] -= box[c] * np.round(d[c] / box[c])
            w[c], b[c] = v[j, c] - v[i, c], a[j, c] - a[i, c]
            y, u = d[c] + best * (w[c] + 0.5 * best * b[c]), w[c] + best * b[c]
            now, speed2, then = now + d[c] * d[c], speed2 + w[c] * w[c], then + y * y
            along, end = along + d[c] * w[c], end + y * u
        if abs(np.sqrt(now) - radius) > 2 * best * np.sqrt(speed2) + 1e-3 * radius:
            continue
        was = inside[i, j]
        if (then < r2) != was:
            best, found = _root(d, w, b, r2, 0.0, best, was), p
        elif along * end < 0 and (end > 0) != was:
            # it turns in between: the nearest point of a pair outside, the farthest of one inside
            low, high = 0.0, best
            for _ in range(80):
                t = 0.5 * (low + high)
                slope, there = 0.0, 0.0
                for c in range(3):
                    y = d[c] + t * (w[c] + 0.5 * t * b[c])
                    slope, there = slope + y * (w[c] + t * b[c]), there + y * y
                if (slope < 0) == (along < 0):
                    low = t
                else:
                    high = t
            if (there < r2) != was:
                best, found = _root(d, w, b, r2, 0.0, high, was), p
    return best, found


@njit(cache=True)
def losses(x, v, masses, box, sigma, epsilon, radius, shifted, timestep, steps, substeps):
    """Losses of a run: msd, vacf and kinetic energy of an atom, mean potential energy of an atom over the
    steps (what jumps counts by the time, not by the steps, that a pair is inside), and at the last step.

    Args:
        x, v: positions and velocities, shape (atoms, 3). box: edges, shape (3,). shifted: whether the energy
            is zero at the cutoff. timestep: in units in which force is mass times length over its square.
    """
    x, v = x.copy(), v.copy()
    atoms = len(x)
    x0, v0 = x.copy(), v.copy()
    s6 = (sigma / radius) ** 6
    edge = 4 * epsilon * (s6 * s6 - s6)
    shift = edge if shifted else 0.0
    jump = edge - shift
    inside = np.zeros((atoms, atoms), np.bool_)
    room = np.zeros((atoms * (atoms - 1) // 2, 2), np.int64)
    pairs = room[: _listed(x, box, radius, room)]
    for p in range(len(pairs)):
        inside[pairs[p, 0], pairs[p, 1]] = True
    a, left = np.zeros_like(x), np.zeros_like(x)
    kinetic, potential, energy = 0.0, 0.0, 0.0
    for step in range(steps + 1):
        pairs = room[: _listed(x, box, radius * (1 + _SKIN), room)]
        energy = _forces(x, box, pairs, inside, sigma, epsilon, shift, a, masses)
        potential += energy
        for i in range(atoms):
            for c in range(3):
                kinetic += 0.5 * masses[i] * v[i, c] * v[i, c]
        if step == steps:
            break
        for part in range(substeps):
            rest = timestep / substeps
            while True:
                t, p = _first(x, v, a, box, pairs, inside, radius, rest)
                x += t * (v + 0.5 * t * a)
                _forces(x, box, pairs, inside, sigma, epsilon, shift, left, masses)
                v += 0.5 * t * (a + left)
                rest -= t
                if p < 0:
                    a[:] = left
                    break
                i, j = pairs[p]
                inside[i, j] = not inside[i, j]
                _forces(x, box, pairs, inside, sigma, epsilon, shift, a, masses)
                # of the steps after it the share that belongs to its time
                now = step + (part + 1) / substeps - rest / timestep
                potential += (jump if inside[i, j] else -jump) * (np.ceil(now) - now - 0.5)
    frames = (steps + 1) * atoms
    msd, vacf = np.sum((x - x0) ** 2) / atoms, np.sum(v * v0) / atoms
    return np.array([msd, vacf, kinetic / frames, potential / frames, energy / atoms])


def reference(simulation: Any, values: dict[str, float], steps: int, substeps: int) -> np.ndarray:
    """Losses of a simulation of one kind of atoms in a box with right angles, with these parameters."""
    return losses(
        simulation.positions, simulation.velocities, simulation.masses,
        np.diag(np.asarray(simulation.cell.matrix)).copy(), values["potential.sigma"],
        values["potential.epsilon"], values["cutoff.radius"], simulation.cutoff.name == "shifted",
        float(simulation.integrator.timestep), steps, substeps,
    )  # fmt: skip
