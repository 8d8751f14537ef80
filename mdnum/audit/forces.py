"""Forces against differences of the energy, with a step that the calculator's own noise decides."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import TIME_UP, Curve, Part, Progress, Subject, TimeUp, again, meter_of
from mdnum.audit.digits import precision
from mdnum.audit.ledger import no_rounding
from mdnum.audit.noise import FEW, Noise, Steps, direction, displaced, of_all_kinds, settled, steps
from mdnum.audit.two_energies import two_energies
from mdnum.references.findings import finding

#: Å; each step of the ladder is a quarter of the one before: 0.064 Å down to 1e-6 Å.
_LADDER = 0.064 * 0.25 ** np.arange(9)
#: Difference over estimated error from which forces and energy disagree.
_SIGNIFICANT = 10.0
#: Of the root mean square force: below, a disagreement is one of tables or precision.
_SMALL = 1e-4
#: Of the root mean square force: noise above a tenth of it leaves nothing to be said of forces, and above the
#: other is more than single precision explains.
_DROWNED, _LOUD = 0.1, 1e-3
_DIRECTIONS, _ATOMS = 3, 4


@dataclass(frozen=True)
class Slope:
    """The derivative of the energy along a direction, by differences and from the forces.

    Attributes:
        what: the direction in words.
        difference: by differences of the energy, eV/Å.
        error: of it, estimated from two steps and the noise, eV/Å.
        force: the same from the forces, eV/Å.
        step: Å, the one chosen.
        steps: all of them, Å.
        apart: |difference - force| at each, without extrapolation, eV/Å.
        jump: energy step between the two nearest points, eV; 0 where there is none.
    """

    what: str
    difference: float
    error: float
    force: float
    step: float
    steps: Float[np.ndarray, "steps"]
    apart: Float[np.ndarray, "steps"]
    jump: float

    @property
    def agrees(self) -> bool:
        """Whether force and difference are the same as far as the difference is known."""
        return abs(self.difference - self.force) <= _SIGNIFICANT * self.error


@dataclass
class Forces:
    """Forces against central differences, extrapolated, and sums that must vanish.

    The error of a difference is |D(h) - D(h/4)| after extrapolation plus the measured noise over the step; of
    a ladder of steps the one with the smallest error is taken. A difference that grows like 1/h is a step of
    the energy, not a wrong force, and is told as such.

    Args:
        seed: of directions.
    """

    name: str = "forces"
    seed: int = 0

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        began = time.perf_counter()
        rng = np.random.default_rng(self.seed)
        worker = subject.fresh()
        atoms, noise = settled(worker, rng, at_least=FEW)
        forces = worker.forces(atoms)
        scale = float(np.sqrt(np.mean(forces**2)))
        found: dict[int, Slope] = {}
        skipped: list[tuple[str, str]] = []
        wanted = list(directions(atoms, rng))
        for place in of_all_kinds(len(wanted)):
            what, line = wanted[place]
            if progress is not None:
                progress(len(found), len(wanted), {"phase": "forces", "unit": "directions"})
            try:
                with meter_of(worker).limited():
                    found[place] = slope(worker, atoms, line, forces, noise, what)
            except TimeUp:
                skipped.append((f"moving {what}", TIME_UP))
        if not found:
            raise TimeUp
        slopes = [found[place] for place in sorted(found)]
        sums = list(_sums(atoms, forces, noise))
        if not all(one.agrees for one in slopes) or any(_judged_sums(sums, scale)):
            # the forces at the structure itself, which all directions are held against
            again(worker, atoms, forces=forces)
        drowned = _drowned(slopes, noise, scale, steps(worker, atoms))
        unclear = [
            found[place]
            for place in sorted(found)
            # as much as a force of the drowned size does along a direction in which more atoms move
            if found[place].agrees
            and _tells(found[place]) > _DROWNED * scale * float(np.linalg.norm(wanted[place][1]))
        ]
        first = min(found)
        told = [
            *drowned,
            *_judged(slopes, scale),
            *_judged_sums(sums, scale),
            *([] if any(one["severity"] == "error" for one in drowned) else precision(worker, atoms, noise)),
            *two_energies(
                worker,
                atoms,
                noise,
                wanted[first][1],
                found[first].difference - found[first].force,
                found[first].error,
            ),
        ]
        if unclear and not told:  # otherwise that is why
            told.append(_untold(unclear, len(slopes), scale))
        worst = max(slopes, key=lambda one: abs(one.difference - one.force) / one.error)
        return Part(
            name=self.name,
            title="Forces",
            says=_says(slopes, unclear, scale, _known(slopes) > _DROWNED * scale),
            findings=told,
            tables={
                "Derivative of the energy along a direction": [_row(one) for one in slopes],
                "Sums that must vanish": sums,
            },
            curves=[_curve(slopes)],
            numbers={
                "directions": len(slopes),
                "disagree": sum(not one.agrees for one in slopes),
                "could_not_tell": len(unclear),
                "largest_difference": max(abs(one.difference - one.force) for one in slopes),
                "largest_error": max(one.error for one in slopes),
                "rms_force": scale,
                "step": worst.step,
                "noise_energy": noise.energy,
                "noise_force": noise.force,
            },
            skipped=skipped,
            seconds=time.perf_counter() - began,
            asked=len(slopes),
            possible=len(wanted),
        )


def directions(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Float[np.ndarray, "atoms 3"]]]:
    """Displacements of all atoms at random, and of a few atoms along each axis; the furthest moves by 1."""
    for number in range(_DIRECTIONS):
        yield f"all atoms at random, {number + 1}", direction(len(atoms), rng)
    for who in sorted(rng.permutation(len(atoms))[:_ATOMS]):
        for axis in range(3):
            line = np.zeros((len(atoms), 3))
            line[who, axis] = 1.0
            yield f"atom {who} ({atoms.symbols[who]}) along {'xyz'[axis]}", line


def slope(
    subject: Subject,
    atoms: Atoms,
    line: Float[np.ndarray, "atoms 3"],
    forces: Float[np.ndarray, "atoms 3"],
    noise: Noise,
    what: str = "",
) -> Slope:
    """The derivative of the energy along a line by differences, with its error, beside the forces' word.

    Args:
        subject: the calculator.
        atoms: where.
        line: displacement per Å of step.
        forces: what the calculator says at `atoms`.
        noise: of the energy there.
        what: the direction in words.
    """
    plus = np.array([subject.energy(displaced(atoms, step * line)) for step in _LADDER])
    minus = np.array([subject.energy(displaced(atoms, -step * line)) for step in _LADDER])
    central = (plus - minus) / (2 * _LADDER)
    # the error of a central difference goes with the square of the step, which is a quarter each time
    better = (16 * central[1:] - central[:-1]) / 15
    spread = np.abs(np.diff(better))
    rounding = 2 * noise.energy / _LADDER[2:]
    error = spread + rounding + 1e-15 * np.abs(better[1:])
    force = -float(np.sum(forces * line))
    best, doubt = _best(better[1:] - force, error, rounding)
    # what a smooth energy has beside its slope goes with the third power of the step, a 64th each time
    off = np.abs(2 * _LADDER * (central - better[best + 1]))
    odd = np.append(False, off[1:] > 0.25 * off[:-1])
    rung = int(np.argmax(np.where(odd, off, 0.0)))
    if odd[rung] and no_rounding(off[rung], plus[rung], 0.0, None, subject.kT):
        for sign, energies in ((1, plus), (-1, minus)):
            again(subject, displaced(atoms, sign * _LADDER[rung] * line), float(energies[rung]))
    return Slope(
        what,
        float(better[best + 1]),
        # a force has its own rounding
        doubt + noise.force * float(np.sqrt(np.sum(line**2))),
        force,
        float(_LADDER[best + 2]),
        _LADDER,
        np.abs(central - force),
        _jump(central - force, noise),
    )


def _best(
    apart: Float[np.ndarray, "steps"], error: Float[np.ndarray, "steps"], rounding: Float[np.ndarray, "steps"]
) -> tuple[int, float]:
    """(the step that counts, the error there): the smallest error's, unless others do not bear it out.

    Where the energy jumps at flips, two steps may hold the same jumps by chance, and agree on a wrong slope.
    A wrong force is as wrong at every step that can tell, and at the shorter ones above all.

    Args:
        apart: difference minus force at each step, the longest first.
        error: of the differences, estimated.
        rounding: the part of it that noise explains.
    """
    best = int(np.argmin(error))
    wrong = abs(apart[best])
    if wrong <= _SIGNIFICANT * error[best]:
        return best, float(error[best])
    shorter = np.arange(len(apart)) > best
    clears = shorter & (_SIGNIFICANT * rounding < 0.5 * wrong) & (np.abs(apart) < 0.5 * wrong)
    if clears.any():
        best = int(np.argmin(np.where(clears, error, np.inf)))
        return best, float(error[best])
    same = (np.abs(apart - apart[best]) < 0.2 * wrong) & (_SIGNIFICANT * error < wrong)
    return best, float(error[best] if same.sum() > 1 else max(error[best], wrong / _SIGNIFICANT))


def _jump(apart: Float[np.ndarray, "steps"], noise: Noise) -> float:
    """The step of the energy that differences show when they grow like 1/h down to the smallest h."""
    sizes = 2 * _LADDER[-4:] * apart[-4:]
    steady = np.ptp(sizes) < 0.3 * abs(sizes[-1])
    return float(sizes[-1]) if steady and abs(sizes[-1]) > 30 * noise.energy else 0.0


def _sums(atoms: Atoms, forces: Float[np.ndarray, "atoms 3"], noise: Noise) -> Iterator[dict[str, Any]]:
    """Net force, and net torque where nothing repeats: by symmetry of space both are zero."""
    size = float(np.sum(np.abs(forces)))
    allowed = 40 * (noise.force * np.sqrt(len(atoms)) + np.finfo(float).eps * size)
    yield {
        "sum": "net force (eV/Å)",
        "found": float(np.linalg.norm(forces.sum(axis=0))),
        "rounding explains": float(allowed),
    }
    if not atoms.pbc.any() and len(atoms) > 1:
        arms = atoms.positions - atoms.positions.mean(axis=0)
        reach = float(np.max(np.linalg.norm(arms, axis=1)))
        yield {
            "sum": "net torque (eV)",
            "found": float(np.linalg.norm(np.cross(arms, forces).sum(axis=0))),
            "rounding explains": float(allowed * max(reach, 1.0)),
        }


def _known(slopes: list[Slope]) -> float:
    """To within what differences of the energy typically tell the force on one atom, eV/Å."""
    # of directions in which one atom moves
    single = [one.error for one in slopes if not one.what.startswith("all")]
    return float(np.median(single)) if single else 0.0


def _drowned(slopes: list[Slope], noise: Noise, scale: float, stairs: Steps) -> list[dict[str, str]]:
    """A finding where forces, or what differences can tell of them, are lost in noise that is no rounding.

    Args:
        slopes: of the energy.
        noise: of the answers.
        scale: root mean square of the forces, eV/Å.
        stairs: the steps in which answers go, which are another finding.
    """
    known = _known(slopes)
    size = max(noise.force, 0.0 if stairs.energy else known)
    if size <= max(_DROWNED * scale, stairs.force):
        size = noise.typical
    if not scale or size <= max(_LOUD * scale, stairs.force):
        return []
    return [
        finding(
            "NOISE_FLOOR",
            # forces that are known well are not tested where the energy is not
            "error" if max(noise.force, noise.typical) > _DROWNED * scale else "warning",
            "answers scatter by a large part of the forces",
            f"Along a line of less than a thousandth of an Å forces scatter by up to {noise.force:.2g} eV/Å "
            f"and the energy by {noise.energy:.2g} eV, at a root mean square force of {scale:.2g} eV/Å; "
            f"differences of the energy tell the force on an atom to within {known:.2g} eV/Å. What is "
            "smaller than that, no check here has seen.",
            "Look first at whether the same question has the same answer twice; then at terms that are drawn "
            "at random, solved for with a loose tolerance, or summed in a narrow format.",
        )
    ]


def _tells(one: Slope) -> float:
    """To within what a direction tells that force and difference agree, eV/Å."""
    return max(one.error, abs(one.difference - one.force))


def _untold(unclear: list[Slope], directions: int, scale: float) -> dict[str, str]:
    """A finding where nothing else says why a direction could not tell."""
    return finding(
        "NOISE_FLOOR",
        "warning",
        "differences of the energy cannot tell some of the forces",
        f"{len(unclear)} of {directions} directions could not tell: moving {unclear[0].what}, differences of "
        f"the energy tell the slope to within {max(map(_tells, unclear)):.2g} eV/Å, at a root mean square "
        f"force of {scale:.2g} eV/Å. A wrong force there, no check here has seen.",
        "Look for steps of the energy that come and go, and whether the same question has the same answer "
        "twice.",
    )


def _judged(slopes: list[Slope], scale: float) -> Iterator[dict[str, str]]:
    steps = [one for one in slopes if one.jump]
    if steps:
        worst = max(steps, key=lambda one: abs(one.jump))
        yield finding(
            "ENERGY_STEP",
            "error",
            "the energy steps within a millionth of an Å of the structure",
            f"Moving {worst.what}, energies at +-{_LADDER[-1]:.0e} Å differ by {worst.jump:.3g} eV more than "
            "the force explains, and so at every larger distance.",
            "Shift or switch the potential to zero at its cutoff.",
        )
    wrong = [one for one in slopes if not one.agrees and not one.jump]
    if wrong:
        worst = max(wrong, key=lambda one: abs(one.difference - one.force))
        apart = abs(worst.difference - worst.force)
        yield finding(
            "FORCES_NOT_GRADIENT",
            "error" if apart > _SMALL * scale else "warning",
            "forces are not the derivative of the energy",
            f"Moving {worst.what}, the energy falls by {-worst.difference:.8g} eV/Å (differences at "
            f"{worst.step:.1g} Å, error {worst.error:.1g}), the forces say {-worst.force:.8g}: {apart:.2g} "
            "eV/Å "
            f"apart, {apart / scale if scale else float('inf'):.1g} of the root mean square force. "
            f"{len(wrong)} of {len(slopes)} directions disagree.",
            "Compare the force with the derivative term by term; look for a shift, a switch or a weight "
            "that is "
            "in the energy and not in the force, and for forces that are predicted rather than derived.",
        )


def _judged_sums(sums: list[dict[str, Any]], scale: float) -> Iterator[dict[str, str]]:
    for row, code in zip(sums, ("NET_FORCE", "NET_TORQUE"), strict=False):
        if row["found"] <= row["rounding explains"]:
            continue
        yield finding(
            code,
            "error" if row["found"] > _SMALL * scale else "warning",
            f"there is a {row['sum'].split(' (')[0]}",
            f"It is {row['found']:.3g}, where rounding explains {row['rounding explains']:.1g}: "
            + (
                "the structure pushes itself along." if code == "NET_FORCE" else "the structure turns itself."
            ),
            "Look for pairs that only one of the two atoms counts, and for forces that are predicted.",
        )


def _row(one: Slope) -> dict[str, Any]:
    return {
        "moved": one.what,
        "by differences": one.difference,
        "error": one.error,
        "by forces": one.force,
        "apart": abs(one.difference - one.force),
        "step (Å)": one.step,
        "agree": one.agrees and not one.jump,
    }


def _says(slopes: list[Slope], unclear: list[Slope], scale: float, drowned: bool) -> str:
    wrong = sum(not one.agrees for one in slopes)
    if wrong:
        return (
            f"Along {wrong} of {len(slopes)} directions the forces are not the derivative of the energy: up "
            "to "
            f"{max(abs(one.difference - one.force) for one in slopes):.2g} eV/Å apart, at a root mean square "
            f"force of {scale:.3g} eV/Å."
        )
    clear = [one for one in slopes if not any(one is other for other in unclear)]
    if drowned or not clear:
        return (
            f"Along {len(slopes)} directions noise hides whether the forces are the derivative of the "
            f"energy: the differences can tell to within {max(one.error for one in slopes):.1g} eV/Å, at a "
            f"root mean square force of {scale:.3g} eV/Å."
        )
    tail = f" {len(unclear)} of {len(slopes)} directions could not tell." if unclear else ""
    return (
        f"Along {len(clear)} directions the forces are the derivative of the energy to within "
        f"{max(abs(one.difference - one.force) for one in clear):.1g} eV/Å, which is what the differences "
        f"can tell (their largest error is {max(one.error for one in clear):.1g} eV/Å).{tail}"
    )


def _curve(slopes: list[Slope]) -> Curve:
    """Difference of forces and differences by step: a valley where all is well, a plateau where it is not."""
    shown = slopes[:_DIRECTIONS]
    worst = max(slopes, key=lambda one: abs(one.difference - one.force) / one.error)
    if worst not in shown:
        shown = [*shown, worst]
    order = np.argsort(_LADDER)
    return Curve(
        "Forces against differences of the energy, by step",
        "step (Å)",
        "apart (eV/Å)",
        _LADDER[order],
        {one.what: one.apart[order] for one in shown},
        log_y=True,
    )
