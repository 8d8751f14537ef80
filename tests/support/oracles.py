"""Answers that are right by construction, for any test to compare with: slow, short, apart from mdnum."""

from __future__ import annotations

from collections import Counter
from fractions import Fraction
from itertools import product

import numpy as np

COMPARISONS = ("r2 <", "r2 <=", "r <", "r <=")


def exact_r2(positions, cell, i, j, shift=(0, 0, 0)) -> Fraction:
    """Squared distance of the stored numbers in rational arithmetic."""
    total = Fraction(0)
    for axis in range(3):
        d = Fraction(float(positions[j][axis])) - Fraction(float(positions[i][axis]))
        d += sum(int(s) * Fraction(float(row[axis])) for s, row in zip(shift, cell, strict=True))
        total += d * d
    return total


def exact_inside(positions, cell, i, j, shift, r_cut, compare="r2 <") -> bool:
    """The decision of real arithmetic: the space (r or r2) does not matter, the comparison does."""
    assert compare in COMPARISONS
    squared, threshold = exact_r2(positions, cell, i, j, shift), Fraction(float(r_cut)) ** 2
    return squared <= threshold if compare.endswith("<=") else squared < threshold


def image_pairs(positions, cell, pbc, r_cut, compare="r2 <") -> Counter:
    """{(i, j): number of images inside}, i <= j, every lattice vector in range tried, decided exactly.

    Cubic in patience: for at most some tens of atoms.
    """
    positions, cell = np.asarray(positions, float), np.asarray(cell, float)
    cell = np.where(np.asarray(pbc, bool)[:, None], cell, 0.0)
    inverse = np.linalg.pinv(cell)
    spread = np.abs((positions[:, None] - positions[None]) @ inverse).max(axis=(0, 1), initial=0.0)
    reach = r_cut * np.linalg.norm(inverse, axis=0) + spread + 1.0
    spans = [range(-int(n), int(n) + 1) if p else range(1) for n, p in zip(reach, pbc, strict=True)]
    found: Counter = Counter()
    for shift in product(*spans):
        d = positions[None, :, :] - positions[:, None, :] + np.asarray(shift, float) @ cell
        for i, j in np.argwhere(np.sqrt((d * d).sum(axis=-1)) <= r_cut * (1 + 1e-6)):
            if (i < j or (i == j and shift > (0, 0, 0))) and exact_inside(
                positions, cell, i, j, shift, r_cut, compare
            ):
                found[int(i), int(j)] += 1
    return found


def minimum_image_pairs(positions, cell, pbc, r_cut, compare="r2 <") -> set:
    """{(i, j)}, i < j, by float64 minimum image: for cells wider than twice the cutoff.

    The decision is the float64 one, in the space that compare names (r2 is d·d against r_cut*r_cut).
    """
    positions, cell = np.asarray(positions, float), np.asarray(cell, float)
    pbc = np.asarray(pbc, bool)
    full = np.where(np.linalg.norm(cell, axis=1)[:, None] > 0, cell, np.eye(3))
    i, j = np.triu_indices(len(positions), 1)
    d = positions[j] - positions[i]
    shift = np.where(pbc, -np.rint(np.linalg.solve(full.T, d.T).T), 0.0)
    d = d + shift @ np.where(pbc[:, None], cell, 0.0)
    r2 = (d * d).sum(axis=1)
    inside = {
        "r2 <": r2 < r_cut * r_cut,
        "r2 <=": r2 <= r_cut * r_cut,
        "r <": np.sqrt(r2) < r_cut,
        "r <=": np.sqrt(r2) <= r_cut,
    }[compare]
    return set(zip(i[inside].tolist(), j[inside].tolist(), strict=True))


def all_pairs(positions, cell, pbc):
    """(i, j, displacement) of every pair i < j, by float64 minimum image over fractional coordinates."""
    positions, cell = np.asarray(positions, float), np.asarray(cell, float)
    i, j = np.triu_indices(len(positions), 1)
    d = positions[j] - positions[i]
    periodic = [k for k in range(3) if pbc[k]]
    if periodic:
        # the dual of the periodic vectors alone: a free vector has no part in the choice of the image
        rows = cell[periodic]
        fractional = np.rint(d @ np.linalg.pinv(rows))
        d = d - fractional @ rows
    return i, j, d


def margins(d, r_cut, compare="r2 <"):
    """(inside, threshold - quantity) of displacements d; r_cut may be one radius or one for each."""
    assert compare in COMPARISONS
    r2 = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
    quantity = r2 if compare.startswith("r2") else np.sqrt(r2)
    threshold = np.asarray(r_cut, float) * np.asarray(r_cut, float) if compare.startswith("r2") else r_cut
    margin = threshold - quantity
    return margin >= 0 if compare.endswith("<=") else margin > 0, margin


def recomputed_flips(frames, cell, pbc, r_cut, compare="r2 <"):
    """The ledger of a trajectory, from its frames alone: rows (step, i, j, entered, margin, distance).

    Args:
        frames: positions at step 0, 1, 2, ..., each of shape (atoms, 3).
        cell: lattice vectors as rows, shape (3, 3), or those of each frame.
        r_cut: one radius, or a function of index arrays (i, j) that gives one for each pair.
    """
    rows, before, counts = [], None, []
    for step, positions in enumerate(frames):
        i, j, d = all_pairs(positions, cell[step] if np.ndim(cell) == 3 else cell, pbc)
        radius = r_cut(i, j) if callable(r_cut) else r_cut
        inside, margin = margins(d, radius, compare)
        counts.append(int(inside.sum()))
        if before is not None:
            for k in np.flatnonzero(inside != before):
                distance = float(np.linalg.norm(d[k]))
                rows.append((step, int(i[k]), int(j[k]), bool(inside[k]), float(margin[k]), distance))
        before = inside
    return rows, counts


def broken_alternations(ledger) -> int:
    """Rows that repeat the direction of the same subject's flip before: 0 for a complete ledger.

    A decision that turned yes can only turn no next, so a missed flip of a subject that flips again
    leaves two equal directions in a row.
    """
    if not len(ledger):
        return 0
    keys = tuple(ledger.subject[:, k] for k in range(ledger.subject.shape[1]))
    order = np.lexsort((ledger.step, *keys))
    subject, entered = ledger.subject[order], ledger.entered[order]
    same = np.all(subject[1:] == subject[:-1], axis=1)
    return int(np.sum(same & (entered[1:] == entered[:-1])))


def cut_energy(kind, r, rc, ro, u, slope, cos=np.cos, pi=np.pi):
    """A pair energy u(r) that ends at rc, from the definition of each cutoff in the literature.

    For any kind of number: complex, so that its derivative comes from a complex step, or of many digits. Of
    those that switch it holds past the onset ro.
    """
    if kind in ("hard", "shifted", "force-shifted"):
        return u(r) - (kind != "hard") * u(rc) - (kind == "force-shifted") * (r - rc) * slope(rc)
    if kind == "switched":
        # HOOMD-blue's xplor; jax_md.energy.multiplicative_isotropic_cutoff; ase LennardJones(smooth=True)
        return u(r) * (rc**2 - r**2) ** 2 * (rc**2 + 2 * r**2 - 3 * ro**2) / (rc**2 - ro**2) ** 3
    t = (r - ro) / (rc - ro)
    switches = {"quintic": 1 - 10 * t**3 + 15 * t**4 - 6 * t**5, "cosine": (1 + cos(pi * t)) / 2}
    if kind not in switches:
        raise ValueError(f"no independent form of the cutoff {kind!r}: add one here")
    return u(r) * switches[kind]
