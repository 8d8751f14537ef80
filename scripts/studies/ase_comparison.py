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

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import figure, parser, save, say, start, table

from mdnum.md.cutoffs import CUTOFFS
from mdnum.references import check_energy, check_pairs
from mdnum.systems import System, load, names

KINDS = tuple(CUTOFFS)


@dataclass(frozen=True)
class Row:
    """The worse of two frames of a system: relative differences."""

    system: str
    cutoff: str
    reference: str
    energy: float
    force: float
    stress: float | None
    third: float | None
    ok: bool


def subjects(chosen: list[str], every_kind: list[str]) -> Iterator[tuple[str, str]]:
    """Names of systems with kinds of cutoff; "" is the system's own."""
    for name in chosen:
        system = load(name)
        own = system.spec.cutoff
        yield name, ""
        if own is not None and name in every_kind:
            yield from ((name, kind) for kind in KINDS if kind != own.kind)


def compare(name: str, kind: str) -> Row:
    """Energies, forces and stresses of one system, as it is and displaced."""
    system = load(name, {"cutoff.kind": kind} if kind else None)
    displaced = system.atoms.copy()
    displaced.rattle(stdev=0.01 * system.r_cut, seed=1)
    made = check_energy(system, {"as it is": system.atoms, "displaced": displaced})
    stress = [frame.stress_rel for frame in made.frames if frame.stress_rel is not None]
    third = [frame.energy_third for frame in made.frames if frame.energy_third is not None]
    cutoff = system.spec.cutoff
    return Row(
        name,
        cutoff.kind if cutoff is not None else "its own",
        made.reference,
        max(frame.energy_rel for frame in made.frames),
        max(frame.force_rel for frame in made.frames),
        max(stress, default=None),
        max(third, default=None),
        made.ok,
    )


def draw(rows: list[Row], path: Path) -> None:
    """Relative differences on a logarithmic axis, with the tolerances."""
    drawn = figure(9.0, 1.5 + 0.24 * len(rows))
    axes = drawn.subplots()
    floor = 2.0**-54
    at = np.arange(len(rows))[::-1]
    for name, marker, values in (
        ("energy", "o", [row.energy for row in rows]),
        ("force", "s", [row.force for row in rows]),
        ("stress", "^", [np.nan if row.stress is None else row.stress for row in rows]),
    ):
        # equal to the last bit has no logarithm: drawn at half an ulp
        axes.plot(np.maximum(values, floor), at, marker, ms=5, label=name)
    axes.axvline(1e-12, color="#999999", lw=1, ls="--", label="tolerance of pair energies")
    axes.axvline(1e-10, color="#333333", lw=1, ls="--", label="tolerance of forces")
    axes.set_xscale("log")
    axes.set_yticks(at, [f"{row.system}, {row.cutoff}" for row in rows])
    axes.set_xlabel("relative difference (at the left edge: none)")
    drawn.legend(loc="outside lower center", ncols=5)
    save(drawn, path)


def print_pairs(system: System) -> None:
    """The pair sets of every search as a table."""
    made = check_pairs(system)
    columns = ("search", "version", "pairs", "missing", "extra", "borderline", "stops counting", "verdict")
    table(
        f"\n{system.name}: {made.pairs:,} pairs with {made.compare} {made.r_cut:.6g} {system.units.length}",
        columns,
        ([row[column] for column in columns] for row in made.rows()),
    )


def main() -> None:
    """Parse, compare, print and draw."""
    made = parser(__file__, __doc__)
    made.add_argument("systems", nargs="*", metavar="SYSTEM", help="default: all that are shipped")
    made.add_argument(
        "--every-kind", nargs="*", default=["argon/liquid-864"], metavar="SYSTEM",
        help="systems to compare with every kind of cutoff (default argon/liquid-864); "
        "without a name: all, which takes minutes",
    )  # fmt: skip
    made.add_argument(
        "--pairs", default="argon/crystal-500", metavar="SYSTEM",
        help="system whose pairs are compared (default argon/crystal-500)",
    )  # fmt: skip
    chosen = made.parse_args()
    wanted = chosen.systems or names("md")
    rows = []
    for name, kind in subjects(wanted, chosen.every_kind or wanted):
        say(f"{name} {kind}")
        rows.append(compare(name, kind))
    table(
        "against ASE, relative",
        ("system", "cutoff", "reference", "energy", "force", "stress", "numpy energy", "agrees"),
        (
            (
                row.system, row.cutoff, row.reference, f"{row.energy:.1e}", f"{row.force:.1e}",
                None if row.stress is None else f"{row.stress:.1e}",
                None if row.third is None else f"{row.third:.1e}", row.ok,
            )
            for row in rows
        ),
        words=3,
    )  # fmt: skip
    say(f"pairs of {chosen.pairs}")
    print_pairs(load(chosen.pairs))
    draw(rows, chosen.output)


if __name__ == "__main__":
    start(main)
