"""Tests of an ensemble: whether plain arrays of a run are those of the ensemble that its integrator promises.

Each returns a `Judgment`: what was measured, what is expected, and the standard error of their difference,
which counts correlation by block averages (Flyvbjerg and Petersen 1989). None of them knows mdnum. Where an
expectation is not exact, it comes from `monte_carlo`, which samples the same ensemble by another method.

Ensembles. With the velocity of the center of mass at zero the momenta have 3 N - 3 degrees of freedom, and
the volume has the weight V^(N-1) exp(-p V / kT) times the configurational integral at fixed scaled positions;
with a thermostat that moves the center of mass they are 3 N and V^N. The volume of an ideal gas is then
distributed as Gamma(N) or Gamma(N + 1) in units of kT/p.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit

#: Largest difference in standard errors: with 16 blocks one honest value in 6,000 is further off (Student).
SIGMAS = 5.0


def kinds(
    relaxation: float, pressure_relaxation: float, compressibility: float, **numbers: float
) -> dict[str, tuple[str, dict[str, Any]]]:
    """Each thermostat and barostat: its name and its keys, with further numbers of the barostats."""
    tau: dict[str, Any] = {"relaxation": relaxation}
    box = tau | {"pressure_relaxation": pressure_relaxation} | numbers
    soft, full = box | {"compressibility": compressibility}, {"box": "full"}
    return {
        "nose-hoover": ("nose-hoover", tau),
        "csvr": ("csvr", tau),
        "mtk": ("mtk", box),
        "mtk full": ("mtk", box | full),
        "cell-rescaling": ("cell-rescaling", soft),
        "cell-rescaling full": ("cell-rescaling", soft | full),
    }


class Judgment(NamedTuple):
    """A number of a run beside the one that it should be."""

    value: float
    expected: float
    error: float  # standard error of value - expected

    @property
    def off(self) -> float:
        """The difference in standard errors."""
        return (self.value - self.expected) / self.error if self.error > 0 else float("nan")

    @property
    def passes(self) -> bool:
        """Whether the difference is one that chance makes; never where there is no number."""
        return bool(abs(self.off) < SIGMAS)


def settled(a: Any, share: float = 0.2) -> np.ndarray:
    """A series without its first part, in which a run forgets its start; of several runs, joined."""
    a = np.asarray(a, np.float64)
    return a[..., int(share * a.shape[-1]) :].ravel()


def mean(a: Any, blocks: int = 16) -> tuple[float, float]:
    """The average of a series and its standard error, the larger of those from two block lengths.

    The error is right where a block is longer than the correlation time, and too small where it is shorter.
    """
    a = np.asarray(a, np.float64)
    errors = []
    for parts in (blocks, blocks // 2):
        means = a[: len(a) // parts * parts].reshape(parts, -1).mean(axis=1)
        errors.append(means.std(ddof=1) / np.sqrt(parts))
    return float(a.mean()), float(max(errors))


def average(a: Any, expected: float, expected_error: float = 0.0) -> Judgment:
    """The average of a series beside a number that is known, with an error of its own or exactly."""
    value, error = mean(a)
    return Judgment(value, expected, float(np.hypot(error, expected_error)))


def variance(a: Any, expected: float, expected_error: float = 0.0) -> Judgment:
    """The variance of a series likewise."""
    a = np.asarray(a, np.float64)
    return average((a - a.mean()) ** 2, expected, expected_error)


def ideal_volume(volume: Any, kT: float, pressure: float, gamma: int) -> dict[str, Judgment]:
    """Mean and fluctuation of an ideal gas's volume.

    Args:
        gamma: N where the center of mass is at rest, N + 1 where a thermostat moves it.
    """
    one = kT / pressure
    return {
        "volume": average(volume, gamma * one),
        "fluctuation": variance(volume, gamma * one**2),
    }


def kinetic_energy(kinetic: Any, kT: float, freedom: int) -> dict[str, Judgment]:
    """Equipartition, and the variance of the canonical ensemble, a Gamma distribution."""
    return {
        "equipartition": average(kinetic, 0.5 * freedom * kT),
        "canonical": variance(kinetic, 0.5 * freedom * kT**2),
    }


def mean_pressure(pressure: Any, expected: float) -> Judgment:
    """The internal pressure (2 K + virial) / (3 V) averages to that of the barostat, exactly."""
    return average(pressure, expected)


def harmonic(energy: Any, least: float, kT: float, modes: int) -> Judgment:
    """Half a kT of each mode, in what a crystal holds near its minimum: U + p V where the box is one of them.

    Args:
        least: U + p V of the crystal at rest.
        modes: 3 N - 3, one more for a volume that moves, six for a box.
    """
    return average(energy, least + 0.5 * modes * kT)


def shape(box: Any) -> np.ndarray:
    """How far boxes are from a cube: squares of h hᵀ / V^(2/3) - 1, summed; no rotation changes it."""
    box = np.asarray(box, np.float64)
    metric = box @ np.swapaxes(box, -1, -2) / np.abs(np.linalg.det(box))[..., None, None] ** (2 / 3)
    return np.sum((metric - np.eye(3)) ** 2, axis=(-1, -2))


def compressibility(volumes: Sequence[Any], pressures: Sequence[float], kT: float) -> Judgment:
    """The variance of the volume over kT <V>, at two similar pressures, beside -d ln V / dp between them."""
    (first, one), (second, other) = (mean(volume) for volume in volumes)
    kappa = np.log(first / second) / (pressures[1] - pressures[0])
    error = np.hypot(one / first, other / second) / abs(pressures[1] - pressures[0])
    own = [variance(volume, 0.0) for volume in volumes]
    at = (kT * first, kT * second)
    value = 0.5 * sum(each.value / scale for each, scale in zip(own, at, strict=True))
    spread = 0.5 * np.hypot(*(each.error / scale for each, scale in zip(own, at, strict=True)))
    return Judgment(value, float(kappa), float(np.hypot(error, spread)))


def two_pressures(volumes: Sequence[Any], pressures: Sequence[float], kT: float) -> Judgment:
    """The slope of ln P(V | p2) / P(V | p1) by V, which is -(p2 - p1) / kT whatever the potential.

    By maximum likelihood (of Shirts 2013, as physical_validation does): the chance that a volume is of the
    second run is a logistic function of it. The error is a jackknife's over blocks of both runs.
    """
    blocks = 10
    parts = [np.array_split(np.asarray(volume, np.float64), blocks) for volume in volumes]
    center = float(np.mean(np.concatenate([one for both in parts for one in both])))

    def slope(left_out: int | None) -> float:
        kept = [np.concatenate([p for k, p in enumerate(both) if k != left_out]) - center for both in parts]
        v = np.concatenate(kept)
        second = np.repeat([0.0, 1.0], [len(one) for one in kept])
        at = np.zeros(2)
        basis = np.stack([np.ones_like(v), v])
        for _ in range(50):
            chance = 1 / (1 + np.exp(-at @ basis))
            hessian = (basis * (chance * (1 - chance))) @ basis.T
            step = np.linalg.solve(hessian, basis @ (second - chance))
            at = at + step
            if np.abs(step).max() < 1e-10 * (1 + np.abs(at).max()):
                break
        return float(at[1])

    jackknife = np.array([slope(k) for k in range(blocks)])
    error = float(np.sqrt((blocks - 1) / blocks * np.sum((jackknife - jackknife.mean()) ** 2)))
    return Judgment(slope(None), -(pressures[1] - pressures[0]) / kT, error)


def conserves(conserved: Any, kinetic: Any, most: float = 0.1) -> bool:
    """Whether the range of the conserved energy over a run is below a tenth of the kinetic energy's."""
    spread = np.ptp(np.asarray(conserved), axis=-1).mean()
    return bool(spread < most * np.ptp(np.asarray(kinetic), axis=-1).mean())


def order(conserved: Sequence[Any], timesteps: Sequence[float]) -> float:
    """The power of the time step by which a conserved energy fluctuates, of runs over the same time.

    Two for a second-order splitting; near zero where what should be conserved is not.
    """
    spread = [float(np.std(np.asarray(one, np.float64))) for one in conserved]
    return float(np.log(spread[0] / spread[1]) / np.log(timesteps[0] / timesteps[1]))


def comes_back(volume: Any, equilibrium: float) -> bool:
    """Whether a crystal that starts compressed or stretched moves toward its volume and not away."""
    volume = np.asarray(volume, np.float64)
    start = volume[0] - equilibrium
    return bool(abs(volume[len(volume) // 2 :].mean() - equilibrium) < 0.5 * abs(start))


@njit(cache=True)
def _pair(r2: float, r_cut: float, shift: float) -> float:
    if r2 >= r_cut * r_cut:
        return 0.0
    six = 1 / (r2 * r2 * r2)
    return 4 * (six * six - six) - shift


@njit(cache=True)
def _between(x, j, at, box, r_cut, shift):
    s0, s1, s2 = at[0] - x[j, 0], at[1] - x[j, 1], at[2] - x[j, 2]
    s0, s1, s2 = s0 - np.rint(s0), s1 - np.rint(s1), s2 - np.rint(s2)
    r2 = 0.0
    for k in range(3):
        d = s0 * box[0, k] + s1 * box[1, k] + s2 * box[2, k]
        r2 += d * d
    return _pair(r2, r_cut, shift)


@njit(cache=True)
def _energy(x: np.ndarray, box: np.ndarray, r_cut: float, shift: float) -> float:
    """Of all pairs, scaled positions in any box, whose vectors are its rows; nearest images."""
    total = 0.0
    for i in range(len(x)):
        for j in range(i):
            total += _between(x, j, x[i], box, r_cut, shift)
    return total


@njit(cache=True)
def monte_carlo(x, box, kT, pressure, r_cut, sweeps, full, rng):
    """Metropolis sampling at constant pressure of a Lennard-Jones system, shifted at its cutoff.

    The center of mass is at rest as in the dynamics: the weight of a volume is V^(N-1) exp(-p V / kT), and of
    a full cell h, of shape and volume, det(h)^(N-1) det(h)^-2 dh without rotations: lower triangular, which a
    rotation of h adds a²b of its diagonal (a, b, c) to.

    Args:
        x: positions, shape (N, 3). box: lattice vectors as rows, lower triangular.
        full: whether the shape changes, too. Else the box is scaled.
        sweeps: moves of all atoms, each with one of the box, after a quarter as many that are not returned,
            in which the largest moves follow the acceptance.
        rng: a generator of numpy.

    Returns:
        potential energy, volume and the six entries of the box after each sweep, shape (sweeps, 8).
    """
    n = len(x)
    s = x @ np.linalg.inv(box)
    box = box.copy()
    sixth = 1 / r_cut**6
    shift = 4 * (sixth * sixth - sixth)
    energy = _energy(s, box, r_cut, shift)
    reach, stretch = 0.1, 0.02
    kept = np.empty((sweeps, 8))
    moved, tried, bent, bends = 0, 0, 0, 0
    warm = sweeps // 4
    for sweep in range(-warm, sweeps):
        for _ in range(n):
            i = rng.integers(0, n)
            to = s[i] + reach * (2 * rng.random(3) - 1) / box[0, 0]
            change = 0.0
            for j in range(n):
                if j != i:
                    change += _between(s, j, to, box, r_cut, shift)
                    change -= _between(s, j, s[i], box, r_cut, shift)
            tried += 1
            if change <= 0 or rng.random() < np.exp(-change / kT):
                s[i] = to
                energy += change
                moved += 1
        volume = box[0, 0] * box[1, 1] * box[2, 2]
        trial = box.copy()
        if full:
            for a in range(3):
                for b in range(a + 1):
                    trial[a, b] += stretch * (2 * rng.random() - 1)
            weight = (n - 3) * np.log(trial[0, 0] * trial[1, 1] * trial[2, 2] / volume)
            weight += 2 * np.log(trial[0, 0] / box[0, 0]) + np.log(trial[1, 1] / box[1, 1])
        else:
            # uniform in ln V, which adds a factor V
            growth = stretch * (2 * rng.random() - 1)
            trial *= np.exp(growth / 3)
            weight = n * growth
        larger = trial[0, 0] * trial[1, 1] * trial[2, 2]
        other = _energy(s, trial, r_cut, shift)
        bends += 1
        if np.log(rng.random()) < weight - (other - energy + pressure * (larger - volume)) / kT:
            box, energy = trial, other
            bent += 1
        if sweep < 0 and tried >= 50 * n:
            reach *= 1.1 if moved > 0.4 * tried else 0.9
            stretch *= 1.1 if bent > 0.4 * bends else 0.9
            moved, tried, bent, bends = 0, 0, 0, 0
        if sweep >= 0:
            kept[sweep, 0] = energy
            kept[sweep, 1] = box[0, 0] * box[1, 1] * box[2, 2]
            kept[sweep, 2:] = np.array([box[0, 0], box[1, 1], box[2, 2], box[2, 1], box[2, 0], box[1, 0]])
    return kept
