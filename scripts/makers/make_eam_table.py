"""Tabulate an analytic embedded-atom potential of copper, as used by systems/copper.

Mishin, Mehl, Papaconstantopoulos, Voter and Kress, Phys. Rev. B 63, 224106 (2001): equations 2 to 6 and the
constants of table II. The form ends as (r_cut - r)^4, so that energy, force and two more derivatives vanish
at the cutoff. The script prints lattice constant, cohesive energy and elastic constants of the form and of
the table beside the paper's, which a wrong digit in any constant would spoil.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

R_CUT, H = 5.50679, 0.50037
E1, E2, R1, R2, ALPHA1, ALPHA2, DELTA = 2.01458e2, 6.59288e-3, 0.83591, 4.46867, 2.97758, 1.54927, 0.86225e-2
CORE = ((2.24, 4.0), (1.80, 40.0), (1.20, 1150.0))
A, R3, BETA1, R4, BETA2 = 3.80362, -2.19885, 0.17394, -2.61984e2, 5.35661e2
F0, F2, Q, Q1, Q2 = -2.28235, 1.35535, (-1.27775, -0.86074, 1.78804, 2.97571), 0.4, 0.3
PAPER = {"a (Å)": 3.615, "E (eV/atom)": -3.54, "C11 (GPa)": 169.9, "C12 (GPa)": 122.6, "C44 (GPa)": 76.2}


def ending(r):
    """psi: takes every function to zero at the cutoff."""
    x4 = (np.minimum(r - R_CUT, 0.0) / H) ** 4
    return x4 / (1 + x4)


def morse(r, r0, alpha):
    return np.exp(-2 * alpha * (r - r0)) - 2 * np.exp(-alpha * (r - r0))


def pair(r):
    """V(r), eV."""
    core = sum(s * np.maximum(rs - r, 0.0) ** 4 for rs, s in CORE)
    return (E1 * morse(r, R1, ALPHA1) + E2 * morse(r, R2, ALPHA2) + DELTA) * ending(r) - core


def density(r):
    """rho(r), 1 in sum at equilibrium. The second exponential underflows for every r; it is the paper's."""
    return (A * np.exp(-BETA1 * (r - R3) ** 2) + np.exp(-BETA2 * (r - R4))) * ending(r)


def embedding(rho):
    """F(rho), eV; F(0) = 5e-6 by the rounding of the constants."""
    x = np.asarray(rho) - 1
    below = F0 + 0.5 * F2 * x**2 + sum(q * x ** (n + 3) for n, q in enumerate(Q))
    above = (F0 + 0.5 * F2 * x**2 + Q[0] * x**3 + Q1 * x**4) / (1 + Q2 * np.maximum(x, 0.0) ** 3)
    return np.where(x < 0, below, above)


def properties(pair_fn: Callable, density_fn: Callable, embedding_fn: Callable) -> dict[str, float]:
    """Lattice constant, cohesive energy and elastic constants of the fcc crystal, static lattice."""
    n = np.array(np.meshgrid(*[np.arange(-7, 8)] * 3)).reshape(3, -1).T
    n = n[(n.sum(axis=1) % 2 == 0) & (n**2).any(axis=1)] / 2

    def energy(basis) -> float:
        r = np.linalg.norm(n @ basis, axis=1)
        r = r[r < R_CUT]
        return float(0.5 * pair_fn(r).sum() + embedding_fn(density_fn(r).sum()))

    best = minimize_scalar(
        lambda a: energy(a * np.eye(3)), bounds=(3.5, 3.7), method="bounded", options={"xatol": 1e-9}
    )
    a, step = float(best.x), 2e-4  # type: ignore[attr-defined]

    def curvature(strain) -> float:
        ends = sum(energy(a * (np.eye(3) + s * step * np.array(strain, float))) for s in (1, -1))
        return (ends - 2 * energy(a * np.eye(3))) / step**2 / (a**3 / 4) * 160.21766208

    c11, bulk = curvature(np.diag([1, 0, 0])), curvature(np.eye(3)) / 9
    c44 = curvature([[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]])
    return dict(zip(PAPER, (a, energy(a * np.eye(3)), c11, (3 * bulk - c11) / 2, c44), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    here = Path(__file__).resolve().parents[2] / "systems" / "copper" / "cu.eam.alloy"
    parser.add_argument("-o", "--output", type=Path, default=here)
    parser.add_argument("--points", type=int, default=1001, help="of each of the three tables")
    parser.add_argument("--largest-density", type=float, default=4.0, help="end of the embedding table")
    options = parser.parse_args()
    n = options.points
    dr, drho = R_CUT / (n - 1), options.largest_density / (n - 1)
    r, rho = dr * np.arange(n), drho * np.arange(n)
    # the last knot is the cutoff up to a rounding, and the form is zero there
    tables = [embedding(rho), np.append(density(r[:-1]), 0.0), np.append(r[:-1] * pair(r[:-1]), 0.0)]
    head = [
        "Cu, analytic form of Mishin, Mehl, Papaconstantopoulos, Voter and Kress, "
        "Phys. Rev. B 63, 224106 (2001)",
        "DYNAMO setfl table; metal units (eV, Angstrom)",
        f"made by scripts/makers/make_eam_table.py with {n} points; "
        "pair, density and two derivatives end at zero",
        "1 Cu",
        f"{n} {drho!r} {n} {dr!r} {R_CUT!r}",
        "29 63.546 3.615 fcc",
    ]
    lines = head + [repr(float(value)) for table in tables for value in table]
    options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")

    from scipy.interpolate import CubicSpline

    tabulated = properties(
        CubicSpline(r[1:], tables[2][1:] / r[1:]), CubicSpline(r, tables[1]), CubicSpline(rho, tables[0])
    )
    form = properties(pair, density, embedding)
    print(f"{options.output}: {options.output.stat().st_size / 1024:.0f} kB")
    print(f"{'':14}{'paper':>10}{'form':>12}{'table':>12}")
    for name, published in PAPER.items():
        print(f"{name:14}{published:10g}{form[name]:12.5f}{tabulated[name]:12.5f}")


if __name__ == "__main__":
    main()
