"""Compare forces with finite differences of the energy. The finite-difference step depends on the noise."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import (
    AuditCheck,
    CalculatorError,
    Chart,
    CheckResult,
    Observed,
    Progress,
    Ways,
    finding,
)
from mdnum.audit.checks import invariance
from mdnum.audit.noise import NoiseFloor, digits, direction, displaced, measured, precision, settled, steps
from mdnum.audit.places import WrongPlaces, wrong_places
from mdnum.audit.subject import CalculatorSubject, no_rounding, rms
from mdnum.units import ENERGY, FORCE, LENGTH, Measured

_LADDER = 0.064 * 0.25 ** np.arange(9)  # Å, each a quarter of the one before: 0.064 Å to 1e-6 Å
_SUMS = {"NET_FORCE": "energy/length", "NET_TORQUE": "energy"}
_SIGNIFICANT = 10.0  # difference over estimated error from which forces and energy disagree
_SMALL = 1e-4  # of the root mean square force: below, a disagreement is one of tables or precision
#: Noise relative to the root mean square force: above the first value, forces cannot be tested; above the
#: second, the noise exceeds that of single precision.
_DROWNED, _LOUD = 0.1, 1e-3
_DIRECTIONS, _ATOMS = 3, 4
#: Number of atoms of the cluster that is used if rounding hides the forces in larger structures, and distance
#: (Å) to the walls of a non-repeating cell.
_CLUSTER, _BOX = 24, 75.0
_SAME = 0.01  # of the largest disagreement: below, one factor explains it
#: In units of kT: changes of the energy below the first value are attributed to precision; jumps, or
#: differences between two representations of a structure, above the second value are errors.
_SMALL_OFFSET, _LARGE_OFFSET = 1e-6, 1e-3
#: Changes of the difference between two energies of one structure that rounding explains, for double and for
#: single precision.
_ROUNDING, _ROUNDING_SINGLE = 1e-11, 1e-5
_NOTHING = 1e-12  # eV/Å: a force below is none, where no noise is louder
_STEP, _CENTRAL = 1e-3, 1e-3  # Å to either side, for the derivative of that difference, and its error

Displacement = Float[np.ndarray, "atoms 3"]


@dataclass(frozen=True)
class Slope:
    """Derivative of the energy along a direction, from finite differences and from forces."""

    direction: str  # in words
    difference: float  # by differences of the energy, eV/Å
    error: float  # of it, estimated from two steps and the noise, eV/Å
    force: float  # the same from the forces, eV/Å
    step: float  # Å, the one chosen
    # |difference - force| at each step of the ladder, without extrapolation, eV/Å
    gaps: Float[np.ndarray, "steps"]
    jump: float  # energy step between the two nearest points, eV; 0 where there is none

    @property
    def gap(self) -> float:
        """Absolute difference (eV/Å) between the finite difference of the energy and the force."""
        return abs(self.difference - self.force)

    @property
    def agrees(self) -> bool:
        """True if force and finite difference agree within the estimated error."""
        return self.gap <= _SIGNIFICANT * self.error


class ForcesCheck(AuditCheck):
    """Are the forces minus the gradient of `energy` or of `free_energy`?

    The slope of the energy is a finite difference D(h). The error of D(h) is estimated as |D(h) - D(h/4)|
    plus noise/h. Of nine steps h, the one with the smallest error is used. If a deviation is proportional to
    1/h, the finding is an energy jump, not a wrong force.
    """

    name, title, order, basic, calls = "forces", "Forces", 10, True, 500
    needed_to = ("run", "differentiate")

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Compare forces with central differences of the energy. Test the net force and torque."""
        rng = np.random.default_rng(self.seed)
        worker = subject.fresh()
        ways = Ways()
        with subject.meter.limited():
            atoms, noise = settled(worker, rng, brief=self.brief)
            summed = 0.0
            if not self.brief and not steps(worker, atoms).energy:
                summed = worker.known["order"][1].energy
            if 2 * summed / _LADDER[2] > _DROWNED * rms(worker.forces(atoms)):
                # rounding of a long sum grows with the number of atoms, and hides the force on one of them
                try:
                    with worker.trying():
                        fewer, other = _fewer(worker, atoms, rng)
                    if other.energy < 0.5 * noise.energy:
                        why = f"rounding hides them; {len(fewer)} were taken"
                        ways.skip(f"forces on {len(atoms)} atoms", why)
                        atoms, noise = fewer, other
                except CalculatorError:
                    pass  # it takes no cluster
            forces = worker.forces(atoms)
        scale = rms(forces)
        wanted = list(_directions(atoms, rng))
        found = ways.each(
            worker, wanted, lambda way: f"moving {way[0]}",
            lambda way: slope(worker, atoms, way[1], forces, noise, way[0]),
            progress, self.name, spread=True, required=True, most=1 if self.brief else None,
        )  # fmt: skip
        slopes, sums = list(found.values()), list(_sums(atoms, forces, noise))
        wrong_sums = [
            finding(
                code, "error" if row["found"] > _SMALL * scale else "warning",
                size=Measured(row["found"], unit, row["rounding explains"], float(scale)),
            )
            for row, (code, unit) in zip(sums, _SUMS.items(), strict=False)
            if row["found"] > row["rounding explains"]
        ]  # fmt: skip
        if wrong_sums or not all(one.agrees for one in slopes):
            # the forces at the structure itself, which all directions are compared with
            worker.again(atoms, forces=forces)
        # an atom whose force alone is wrong may have one that others get in its place
        wrong = not all(one.agrees or one.jump for one in slopes)
        places = wrong_places(subject, atoms, noise.allowed) if wrong else None
        # of directions in which one atom moves: to within what differences typically tell its force
        single = [one.error for one in slopes if not one.direction.startswith("all")]
        known = float(np.median(single)) if single else 0.0
        drowned = [] if self.brief else _drowned(worker, atoms, noise, known, scale)
        unclear = [
            one
            for place, one in found.items()
            # as much as a force of the drowned size does along a direction in which more atoms move
            if one.agrees and max(one.error, one.gap) > _DROWNED * scale * np.linalg.norm(wanted[place][1])
        ]
        first = min(found)
        observed = [*drowned, *_judged(slopes, scale, places), *wrong_sums]
        if not self.brief:
            if not any(one.severity == "error" for one in drowned):
                observed += precision(worker, atoms, noise)
            observed += _two_energies(worker, atoms, noise, wanted[first][1], found[first])
        numbers = {
            "directions": len(slopes), "disagree": sum(not one.agrees for one in slopes),
            "could_not_tell": len(unclear), "largest_difference": max(one.gap for one in slopes),
            "largest_error": max(one.error for one in slopes), "rms_force": scale,
            # the structure is displaced: in a perfect crystal, too, there would be a force
            "nothing_felt": scale <= max(noise.force, _NOTHING)
            and all(abs(one.difference) <= max(_SIGNIFICANT * one.error, _NOTHING) for one in slopes),
            "step": _worst(slopes).step, "noise_energy": noise.energy, "noise_force": noise.force,
        }  # fmt: skip
        clear = [one for one in slopes if not any(one is other for other in unclear)]
        gap, error = (max(getattr(one, name) for one in clear or slopes) for name in ("gap", "error"))
        values: dict[str, Any] = numbers | {
            "clear": len(clear or slopes), "clear_gap": gap, "clear_error": error,
            "clear_bound": max(gap, error), "unclear_direction": unclear[0].direction if unclear else "",
            "unclear_gap": max((max(one.error, one.gap) for one in unclear), default=0.0),
        }  # fmt: skip
        if unclear and not observed:  # otherwise that is why
            observed.append(finding("NOISE_FLOOR", "warning", "some", **values))
        says = ["forces_right", "forces_unclear"] if unclear else ["forces_right"]
        if numbers["disagree"]:
            says = ["forces_wrong"]
        elif known > _DROWNED * scale or not clear:
            says = ["forces_drowned"]
        return CheckResult(
            says=(says, values),
            findings=observed,
            tables={
                "Derivative of the energy along a direction": [_row(one) for one in slopes],
                "Sums that must vanish": sums,
            },
            charts=[_chart(slopes)],
            numbers=numbers,
            limits={"disagree": (0, ("FORCES_NOT_GRADIENT", "ENERGY_STEP"))},
            **vars(ways),
        )


def _fewer(subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator) -> tuple[Atoms, NoiseFloor]:
    """Return a nonperiodic cluster around the first atom, and its noise of energy and forces."""
    away = atoms.get_distances(0, range(len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    nearest = np.sort(np.argsort(np.linalg.norm(away, axis=1))[:_CLUSTER])
    there = Atoms(atoms.numbers[nearest], away[nearest])
    there.positions += 1.0 - there.positions.min(axis=0)
    there.set_cell([_BOX] * 3)
    return there, measured(subject, there, rng)


def _worst(slopes: list[Slope]) -> Slope:
    return max(slopes, key=lambda one: one.gap / max(one.error, 1e-300))


def _directions(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Displacement]]:
    """Yield random displacements of all atoms, and of a few single atoms along each axis."""
    for number in range(_DIRECTIONS):
        yield f"all atoms at random, {number + 1}", direction(len(atoms), rng)
    for who in sorted(rng.permutation(len(atoms))[:_ATOMS]):
        for axis in range(3):
            line = np.zeros((len(atoms), 3))
            line[who, axis] = 1.0
            yield f"atom {who} ({atoms.symbols[who]}) along {'xyz'[axis]}", line


def slope(
    subject: CalculatorSubject,
    atoms: Atoms,
    line: Displacement,
    forces: Displacement,
    noise: NoiseFloor,
    what: str = "",
) -> Slope:
    """Derivative of the energy along a line, from finite differences (with error) and from forces.

    Args:
        line: displacement of the atoms per Å of step; `what` is the name of the line.
        forces: forces of the calculator at `atoms`; `noise` is the noise of the energy at `atoms`.
    """
    plus, minus = (
        np.array([subject.energy(displaced(atoms, sign * step * line)) for step in _LADDER])
        for sign in (1, -1)
    )
    central = (plus - minus) / (2 * _LADDER)
    # the error of a central difference goes with the square of the step, which is a quarter each time
    better = (16 * central[1:] - central[:-1]) / 15
    spread = np.abs(np.diff(better))
    # the energies themselves show what they are rounded to
    energies = np.append(plus, minus)
    unsure = 2 * max(noise.energy, 0.5 * digits(energies).grain(energies)) / _LADDER[2:]
    error = spread + unsure + 1e-15 * np.abs(better[1:])
    force = -float(np.sum(forces * line))
    best, doubt = _best(better[1:] - force, error, unsure)
    # what a smooth energy has beside its slope goes with the third power of the step, a 64th each time
    off = np.abs(2 * _LADDER * (central - better[best + 1]))
    odd = np.append(False, off[1:] > 0.25 * off[:-1])
    rung = int(np.argmax(np.where(odd, off, 0.0)))
    if odd[rung] and no_rounding(off[rung], 0.0, (plus[rung], None), subject.kT):
        for sign, energies in ((1, plus), (-1, minus)):
            subject.again(displaced(atoms, sign * _LADDER[rung] * line), float(energies[rung]))
    # a difference that grows like 1/h down to the smallest h shows a step of the energy
    sizes = 2 * _LADDER[-4:] * (central - force)[-4:]
    steady = np.ptp(sizes) < 0.3 * abs(sizes[-1]) and abs(sizes[-1]) > noise.allowed.energy
    doubt += noise.force * float(np.sqrt(np.sum(line**2)))  # a force has its own rounding
    return Slope(
        what, float(better[best + 1]), doubt, force, float(_LADDER[best + 2]), np.abs(central - force),
        float(sizes[-1]) if steady else 0.0,
    )  # fmt: skip


def _best(
    gaps: Float[np.ndarray, "steps"], error: Float[np.ndarray, "steps"], rounding: Float[np.ndarray, "steps"]
) -> tuple[int, float]:
    """Find the most accurate finite difference that other steps confirm. Return its index and error.

    Two step lengths may contain the same energy jump by chance, and agree on a wrong slope. A wrong force
    causes equal deviations for all sufficiently accurate steps.

    Args:
        gaps: finite difference minus force for each step, from the longest step to the shortest.
        error: estimated error of each difference; rounding: the contribution of noise to this error.
    """
    best = int(np.argmin(error))
    wrong = abs(gaps[best])
    if wrong <= _SIGNIFICANT * error[best]:
        return best, float(error[best])
    shorter = np.arange(len(gaps)) > best
    clears = shorter & (_SIGNIFICANT * rounding < 0.5 * wrong) & (np.abs(gaps) < 0.5 * wrong)
    if clears.any():
        best = int(np.argmin(np.where(clears, error, np.inf)))
        return best, float(error[best])
    same = (np.abs(gaps - gaps[best]) < 0.2 * wrong) & (_SIGNIFICANT * error < wrong)
    return best, float(error[best] if same.sum() > 1 else max(error[best], wrong / _SIGNIFICANT))


def _sums(atoms: Atoms, forces: Displacement, noise: NoiseFloor) -> Iterator[dict[str, Any]]:
    """Net force of a structure, and its net torque if nonperiodic. Correct forces give zero."""
    size = float(np.sum(np.abs(forces)))
    allowed = noise.allowed.force * np.sqrt(len(atoms)) + 40 * np.finfo(float).eps * size
    net = float(np.linalg.norm(forces.sum(axis=0)))
    yield {"sum": f"net force ({FORCE})", "found": net, "rounding explains": float(allowed)}
    if not atoms.pbc.any() and len(atoms) > 1:
        arms = atoms.positions - atoms.positions.mean(axis=0)
        reach = float(np.max(np.linalg.norm(arms, axis=1)))
        torque, allowed = float(np.linalg.norm(np.cross(arms, forces).sum(axis=0))), allowed * max(reach, 1.0)
        yield {"sum": f"net torque ({ENERGY})", "found": torque, "rounding explains": float(allowed)}


def _drowned(
    worker: CalculatorSubject, atoms: Atoms, noise: NoiseFloor, known: float, scale: float
) -> list[Observed]:
    """Return a finding if the noise hides forces or energy changes."""
    stairs = steps(worker, atoms)  # which are another finding
    size = max(noise.force, 0.0 if stairs.energy else known)
    if size <= max(_DROWNED * scale, stairs.force):
        size = noise.typical
    if not scale or size <= max(_LOUD * scale, stairs.force):
        return []
    # forces that are known well are not tested where the energy is not
    severity = "error" if max(noise.force, noise.typical) > _DROWNED * scale else "warning"
    values: dict[str, Any] = {
        "force": noise.force, "energy": noise.energy, "scale": scale, "known": known
    }  # fmt: skip
    return [finding("NOISE_FLOOR", severity, **values)]


def _judged(slopes: list[Slope], scale: float, places: WrongPlaces | None) -> Iterator[Observed]:
    if jumps := [one for one in slopes if one.jump]:
        worst = max(jumps, key=lambda one: abs(one.jump))
        yield finding("ENERGY_STEP", "error", direction=worst.direction, nearest=_LADDER[-1], jump=worst.jump)
    if wrong := [one for one in slopes if not one.agrees and not one.jump]:
        worst = max(wrong, key=lambda one: one.gap)
        # the same factor everywhere, if one fits
        one, other = (
            np.array([getattr(slope, name) for slope in slopes]) for name in ("difference", "force")
        )
        factor = float(one @ other) / float(other @ other) if other.any() else 0.0
        scaled = np.abs(one - factor * other).max() < _SAME * np.abs(one - other).max()
        yield finding(
            "FORCES_NOT_GRADIENT", "error" if worst.gap > _SMALL * scale else "warning",
            f"place_{places.pattern}" if places else "scaled" if scaled and factor else None,
            **(places.values if places else {}), factor=1 / factor if factor else 0.0,
            direction=worst.direction, difference=-worst.difference, step=worst.step, error=worst.error,
            force=-worst.force, gap=worst.gap, share=worst.gap / scale if scale else float("inf"),
            wrong=len(wrong), directions=len(slopes),
        )  # fmt: skip


def _row(one: Slope) -> dict[str, Any]:
    return {
        "moved": one.direction, f"by differences ({FORCE})": one.difference, "error": one.error,
        f"by forces ({FORCE})": one.force, "difference": one.gap, f"step ({LENGTH})": one.step,
        "agree": one.agrees and not one.jump,
    }  # fmt: skip


def _chart(slopes: list[Slope]) -> Chart:
    """Chart of force error versus step. Correct forces give a minimum, wrong forces a plateau."""
    shown = slopes[:_DIRECTIONS]
    shown += [one for one in [_worst(slopes)] if one not in shown]
    lines = {one.direction: one.gaps[::-1].tolist() for one in shown}
    title = "Forces against differences of the energy, by step"
    labels = title, f"step ({LENGTH})", f"difference ({FORCE})"
    return Chart(*labels, _LADDER[::-1].tolist(), lines, log_y=True)


# -- calculators that know two energies: the one forces belong to, and the one that a run logs


def _two_energies(
    subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor, line: Displacement, along: Slope
) -> Iterator[Observed]:
    """Yield a finding if `energy` and `free_energy` differ by more than a constant.

    By ASE's definition, the forces are minus the gradient of `free_energy`. All other checks examine
    `free_energy`. If the two energies differ by a constant, the findings hold for both.
    """
    free, logged = subject.energies(atoms)
    if logged is None:
        return

    def change(there: Atoms) -> float:
        free, other = subject.energies(there)
        return 0.0 if other is None else other - free - offset

    offset, kT = logged - free, subject.kT
    # where it may not change
    rng = np.random.default_rng(0)
    kinds = (invariance.translated, invariance.imaged, invariance.permuted)
    changes: dict[str, float] = {}
    for same in (one for kind in kinds for one in islice(kind(atoms, rng), 1)):
        with suppress(CalculatorError), subject.trying():  # reported elsewhere
            changes[f"with {same.what}"] = change(same.atoms)
    forward, back = (change(displaced(atoms, step * line)) for step in (_STEP, -_STEP))
    slope_of_offset = (forward - back) / (2 * _STEP)
    moved = [change(displaced(atoms, sign * _LADDER[0] * line)) for sign in (1, -1)]
    worst = max([*changes.values(), *moved], key=abs)
    single = all(float(np.float32(energy)) == energy for energy in (free, logged))
    rounding = (_ROUNDING_SINGLE if single else _ROUNDING) * max(abs(free), abs(logged))
    if abs(worst) <= max(noise.allowed.energy, _SMALL_OFFSET * kT, rounding):
        return
    limit = max(_SIGNIFICANT * along.error, _CENTRAL * abs(slope_of_offset))
    other = abs(along.difference - along.force + slope_of_offset) <= limit
    belong = ("both" if other else "free") if along.agrees else "energy" if other else "neither"
    wrong = [f"{k}, by {abs(by):.3g} {ENERGY}" for k, by in changes.items() if abs(by) > _LARGE_OFFSET * kT]
    yield finding(
        "TWO_ENERGIES", "error" if wrong else "warning", belong, "wrong" if wrong else None,
        formula=atoms.get_chemical_formula(), offset=offset, change=worst, places="; ".join(wrong),
        kT=abs(worst) / kT if kT else None,
    )  # fmt: skip
