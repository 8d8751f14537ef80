"""Many-body energies from their papers, in extended precision and in no hurry; apart from mdnum and jax.

Forces are complex-step derivatives of these energies: x + i h with h = 1e-30 gives dE/dx to the last digit
without any derivative being written down. np.longdouble has 64 bits of mantissa on x86 and at least 53
elsewhere, so a deviation of 1e-13 from these numbers is not theirs.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from ase import Atoms
from ase.neighborlist import neighbor_list

L = np.longdouble


class Bonds:
    """Directed pairs within r_cut of an ASE structure, and pairs of bonds that share their first atom."""

    def __init__(self, atoms: Atoms, r_cut: float):
        self.i, self.j, self.shift = neighbor_list("ijS", atoms, float(r_cut), self_interaction=False)
        self.cell = atoms.cell.array.astype(L)
        self.atoms = len(atoms)
        start = np.searchsorted(self.i, np.arange(len(atoms) + 1))
        blocks = [
            np.stack(np.meshgrid(np.arange(a, b), np.arange(a, b), indexing="ij"), -1).reshape(-1, 2)
            for a, b in pairwise(start)
        ]
        both = np.concatenate(blocks)
        self.first, self.second = both[both[:, 0] != both[:, 1]].T

    def vectors(self, x):
        return x[self.j] - x[self.i] + self.shift.astype(L) @ self.cell

    def sum_by(self, index, values, size):
        out = np.zeros(size, values.dtype)
        np.add.at(out, index, values)
        return out


def norm(v):
    # not np.linalg.norm: it takes absolute values, and a complex step would be lost
    return np.sqrt((v * v).sum(axis=-1))


def stillinger_weber(atoms: Atoms):
    """Phys. Rev. B 31, 5262 (1985), eqs. 2.3 to 2.7."""
    eps, sigma, a, A, B = L("2.1683"), L("2.0951"), L("1.8"), L("7.049556277"), L("0.6022245584")
    lam, gamma = L("21"), L("1.2")
    bonds = Bonds(atoms, 1.8 * 2.0951)

    def energy(x):
        v = bonds.vectors(x)
        r = norm(v) / sigma
        end = np.exp(1 / (r - a))
        cosine = (v[bonds.first] * v[bonds.second]).sum(-1) / sigma**2
        cosine = cosine / (r[bonds.first] * r[bonds.second])
        taper = np.exp(gamma / (r - a))
        triples = taper[bonds.first] * taper[bonds.second] * (cosine + L(1) / 3) ** 2
        return eps * ((A * (B / r**4 - 1) * end).sum() + lam * triples.sum()) / 2

    return energy


def tersoff(atoms: Atoms):
    """Phys. Rev. B 38, 9902 (1988), eqs. 1 to 3; table I, Si(C). exp(-lambda3^3 (r_ij - r_ik)^3) inverted."""
    A, B, l1, l2, l3 = L("1830.8"), L("471.18"), L("2.4799"), L("1.7322"), L("1.7322")
    beta, n, c, d, h = L("1.0999e-6"), L("0.78734"), L("1.0039e5"), L("16.218"), L("-0.59826")
    R, S = L("2.7"), L("3.0")
    pi = L("3.14159265358979323846264338327950288")
    bonds = Bonds(atoms, 3.0)

    def energy(x):
        v = bonds.vectors(x)
        r = norm(v)
        taper = np.where(r.real < R, 1, (1 + np.cos(pi * (r - R) / (S - R))) / 2)
        ij, ik = bonds.first, bonds.second
        cosine = (v[ij] * v[ik]).sum(-1) / (r[ij] * r[ik])
        g = 1 + c**2 / d**2 - c**2 / (d**2 + (h - cosine) ** 2)
        terms = taper[ik] * g * np.exp(l3**3 * (r[ij] - r[ik]) ** 3)
        zeta = bonds.sum_by(ij, terms, len(r))
        lonely = zeta.real == 0
        b = np.where(lonely, 1, (1 + (beta * np.where(lonely, 1, zeta)) ** n) ** (-1 / (2 * n)))
        return (taper * (A * np.exp(-l1 * r) - b * B * np.exp(-l2 * r))).sum() / 2

    return energy


class NotAKnot:
    """Cubic spline on an even grid from its second derivatives, solved by elimination."""

    def __init__(self, values, step, start=0):
        y, self.h, self.start = np.asarray(values, L), L(step), L(start)
        rhs = 6 * (y[:-2] - 2 * y[1:-1] + y[2:]) / self.h**2
        m, n = np.zeros(len(y), L), len(y) - 1
        # an even grid decouples the second and the last but one: 6 m = rhs
        m[1], m[n - 1] = rhs[0] / 6, rhs[-1] / 6
        diagonal, right = np.full(n - 3, L(4)), rhs[1:-1].copy()
        right[0] -= m[1]
        right[-1] -= m[n - 1]
        for k in range(1, n - 3):
            diagonal[k] -= 1 / diagonal[k - 1]
            right[k] -= right[k - 1] / diagonal[k - 1]
        for k in range(n - 4, -1, -1):
            m[k + 2] = (right[k] - (m[k + 3] if k < n - 4 else 0)) / diagonal[k]
        m[0], m[n] = 2 * m[1] - m[2], 2 * m[n - 1] - m[n - 2]
        self.y, self.m = y, m

    def __call__(self, x):
        k = np.clip(((x.real - self.start) / self.h).astype(int), 0, len(self.y) - 2)
        b = (x - self.start) / self.h - k
        a = 1 - b
        bend = ((a**3 - a) * self.m[k] + (b**3 - b) * self.m[k + 1]) * self.h**2 / 6
        return a * self.y[k] + b * self.y[k + 1] + bend


def embedded_atom(atoms: Atoms, path):
    """Daw and Baskes, Phys. Rev. B 29, 6443 (1984), over the splines of a setfl table."""
    words = path.read_text().split("\n", 3)[3].split()
    n_rho, drho, n_r, dr, r_cut = int(words[2]), L(words[3]), int(words[4]), L(words[5]), float(words[6])
    numbers = np.array([L(word) for word in words[11:]])
    f, rho, rphi = np.split(numbers, [n_rho, n_rho + n_r])
    embed, density = NotAKnot(f, drho), NotAKnot(rho, dr)
    phi = NotAKnot(rphi[1:] / (dr * np.arange(1, n_r)), dr, start=dr)
    bonds = Bonds(atoms, r_cut)

    def energy(x):
        r = norm(bonds.vectors(x))
        return embed(bonds.sum_by(bonds.i, density(r), bonds.atoms)).sum() + phi(r).sum() / 2

    return energy


def energy_and_forces(energy, positions, which):
    """Energy, and forces on the atoms of `which`."""
    x = np.asarray(positions, L)
    forces = np.zeros((len(which), 3), L)
    step = L("1e-30")
    for row, atom in enumerate(which):
        for axis in range(3):
            moved = x.astype(np.clongdouble)
            moved[atom, axis] += 1j * step
            forces[row, axis] = -energy(moved).imag / step
    return energy(x), forces
