"""Are energies, forces and stresses right, and does every library mean the same by "inside the cutoff"?

Answer. Yes. 18 systems and cutoffs agree with ASE or numpy: energies to 3e-14 of their size, forces and
stresses to 1e-13. All searches installed here (ASE, vesin, scipy, pymatgen, MDAnalysis, jax-md) find the
same pairs; where they stop counting differs by ulps of r_cut, and by 1e-8 for MDAnalysis, which works in
float32. It takes 50 s.

First, every shipped system with its own cutoff, and one of them with every kind of cutoff, against
ASE (or, where ASE has no such potential, against plain numpy on ASE's neighbor list; the table says
which). Structures are also compared after a random displacement of every atom, because a perfect
crystal has no forces. Columns: relative difference of the energy, largest differences of a force
and of a stress component over the size of what was summed up, and the relative difference of the
energy to a third evaluation in plain numpy.

Then the pairs that every installed neighbor search finds in one system, against brute force in
rational arithmetic, and the distance at which each one stops counting.

How to read it. In float64 energies of pair potentials agree to 1e-12 and forces to 1e-10 of their
scale; anything larger is a defect or a convention that was not converted. "missing" and "extra"
pairs beyond rounding are defects of that search; "stops counting" in ulps of r_cut is its
convention: -1 is an exact r < r_cut, 0 an exact r <= r_cut, a relative number of 1e-8 means
float32.
"""

from __future__ import annotations

import _shared  # noqa: F401  what scripts share is found by it
from _output import parser, say, start, table

from mdnum.md.cutoffs import CUTOFFS
from mdnum.references import check_energy, check_pairs
from mdnum.systems import load, names


def compared(name: str, kind: str | None) -> tuple[object, ...]:
    """A row: the worse of two frames of a system, as it is and displaced.

    Args:
        kind: of its cutoff; None for the system's own.
    """
    system = load(name, {"cutoff.kind": kind} if kind else None)
    displaced = system.atoms.copy()
    displaced.rattle(stdev=0.01 * system.r_cut, seed=1)
    report = check_energy(system, {"as it is": system.atoms, "displaced": displaced})
    worst: list[str | None] = []
    for quantity in ("energy_rel", "force_rel", "stress_rel", "energy_third"):
        values = [getattr(frame, quantity) for frame in report.frames]
        largest = max((value for value in values if value is not None), default=None)
        worst.append(None if largest is None else f"{largest:.1e}")
    cutoff = system.spec.cutoff
    return name, cutoff.kind if cutoff is not None else "its own", report.reference, *worst, report.ok


def main() -> None:
    """Parse, compare and print."""
    options = parser(__doc__)
    options.add_argument("systems", nargs="*", metavar="SYSTEM", help="default: all that are shipped")
    options.add_argument(
        "--every-kind", nargs="*", default=["argon/liquid-864"], metavar="SYSTEM",
        help="systems to compare with every kind of cutoff (default argon/liquid-864); "
        "without a name: all, which takes minutes",
    )  # fmt: skip
    options.add_argument(
        "--pairs", default="argon/crystal-500", metavar="SYSTEM",
        help="system whose pairs are compared (default argon/crystal-500)",
    )  # fmt: skip
    chosen = options.parse_args()
    wanted = chosen.systems or names("md")
    rows = []
    for name in wanted:
        own = load(name).spec.cutoff
        others = () if own is None or name not in (chosen.every_kind or wanted) else set(CUTOFFS) - {own.kind}
        for kind in (None, *sorted(others)):
            say(f"{name} {kind or ''}")
            rows.append(compared(name, kind))
    columns = ("system", "cutoff", "reference", "energy", "force", "stress", "numpy energy", "agrees")
    table("against ASE, relative", columns, rows, words=3)
    say(f"pairs of {chosen.pairs}")
    system = load(chosen.pairs)
    report = check_pairs(system)
    columns = ("search", "version", "pairs", "missing", "extra", "borderline", "stops counting", "verdict")
    limit = f"{report.compare} {report.r_cut:.6g} {system.units.length}"
    title = f"\n{system.name}: {report.pairs:,} pairs with {limit}"
    table(title, columns, ([row[column] for column in columns] for row in report.rows()))


if __name__ == "__main__":
    start(main)
