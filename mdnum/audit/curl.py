"""Work around small closed loops: a force that has an energy does none."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import TIME_UP, Part, Progress, Subject, TimeUp, meter_of
from mdnum.audit.noise import FEW, Noise, displaced, of_all_kinds, settled
from mdnum.references.findings import finding

#: Å; the loop with the smaller error counts.
_RADII = (0.03, 0.003, 0.0003)
#: Points on a loop: equally spaced ones integrate a smooth periodic function to all orders below this.
_POINTS = 12
#: Work over its error from which it is there.
_SIGNIFICANT = 10.0
#: Antisymmetric over symmetric part of the derivative of the forces: below, it is precision.
_SMALL = 1e-4


@dataclass(frozen=True)
class Loop:
    """A force carried around a circle in the space of all coordinates.

    Attributes:
        what: the plane in words.
        radius: Å, of the displacement of all atoms together.
        work: eV.
        curl: work over area: v·Ju - u·Jv with J the derivative of the forces, eV/Å².
        error: of the curl, eV/Å².
        stiffness: size of the symmetric part of J in the plane, eV/Å².
    """

    what: str
    radius: float
    work: float
    curl: float
    error: float
    stiffness: float

    @property
    def conservative(self) -> bool:
        """Whether no work is done as far as can be told."""
        return abs(self.curl) <= _SIGNIFICANT * self.error

    @property
    def share(self) -> float:
        """Antisymmetric over symmetric part."""
        return abs(self.curl) / self.stiffness if self.stiffness else (float("inf") if self.curl else 0.0)


@dataclass
class Curl:
    """The circulation of the forces in planes of all kinds; it needs no energy.

    Args:
        seed: of the planes.
    """

    name: str = "curl"
    seed: int = 0

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        began = time.perf_counter()
        rng = np.random.default_rng(self.seed)
        worker = subject.fresh()
        atoms, noise = settled(worker, rng, at_least=FEW)
        wanted = list(planes(worker, atoms, rng))
        found: dict[int, Loop] = {}
        skipped: list[tuple[str, str]] = []
        for place in of_all_kinds(len(wanted)):
            what, u, v = wanted[place]
            if progress is not None:
                progress(len(found), len(wanted), {"phase": "curl", "unit": "loops"})
            try:
                with meter_of(worker).limited():
                    tried = [around(worker, atoms, u, v, radius, noise, what) for radius in _RADII]
            except TimeUp:
                skipped.append((f"a loop of {what}", TIME_UP))
            else:
                found[place] = agreed(tried)
        if not found:
            raise TimeUp
        loops = [found[place] for place in sorted(found)]
        wrong = [one for one in loops if not one.conservative]
        return Part(
            name=self.name,
            title="Curl",
            says=_says(loops, wrong),
            findings=[_finding(wrong, len(loops))] if wrong else [],
            tables={"Work around closed loops": [_row(one) for one in loops]},
            numbers={
                "loops": len(loops),
                "with_work": len(wrong),
                "largest_curl": max(abs(one.curl) for one in loops),
                "largest_share": max((one.share for one in wrong), default=0.0),
                "largest_error": max(one.error for one in loops),
            },
            skipped=skipped,
            seconds=time.perf_counter() - began,
            asked=len(loops),
            possible=len(wanted),
        )


def agreed(tried: Sequence[Loop]) -> Loop:
    """The loop with the smallest error, which is raised where a loop of another radius says otherwise.

    A curl is the same on every small circle; what a jump of the forces does to the work around one is not.

    Args:
        tried: the same plane at several radii.
    """
    best = min(tried, key=lambda one: one.error)
    others = [one.curl for one in tried if _SIGNIFICANT * one.error < abs(best.curl)]
    spread = max((abs(one - best.curl) for one in others), default=0.0)
    return replace(best, error=max(best.error, spread))


Plane = tuple[str, Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]


def planes(subject: Subject, atoms: Atoms, rng: np.random.Generator) -> Iterator[Plane]:
    """Two orthonormal displacements each: of all atoms, of one atom, of an atom and one that it feels."""
    count = len(atoms)
    if count > 1:
        for number in range(3):
            u, v = np.linalg.qr(rng.standard_normal((3 * count, 2)))[0].T
            yield f"all atoms at random, {number + 1}", u.reshape(count, 3), v.reshape(count, 3)
    few = rng.permutation(count)[:2]
    for first, second in ((0, 1), (1, 2)):
        for who in few:
            u, v = np.zeros((2, count, 3))
            u[who, first] = v[who, second] = 1.0
            yield f"atom {who} ({atoms.symbols[who]}) in {'xyz'[first]}{'xyz'[second]}", u, v
    if count < 2:
        return
    who = int(rng.integers(count))
    step = np.zeros((count, 3))
    step[who] = (0.01, 0.007, -0.004)
    answer = np.linalg.norm(subject.forces(displaced(atoms, step)) - subject.forces(atoms), axis=1)
    answer[who] = -1.0
    for other in np.argsort(-answer)[:2]:
        for first, second in ((0, 1), (2, 0)):
            u, v = np.zeros((2, count, 3))
            u[who, first] = v[other, second] = 1.0
            what = f"atom {who} along {'xyz'[first]} and atom {other} along {'xyz'[second]}"
            yield what, u, v


def around(
    subject: Subject,
    atoms: Atoms,
    u: Float[np.ndarray, "atoms 3"],
    v: Float[np.ndarray, "atoms 3"],
    radius: float,
    noise: Noise,
    what: str = "",
) -> Loop:
    """The work of the forces around x + radius (u cos t + v sin t).

    Args:
        subject: the calculator.
        atoms: the center.
        u: one unit vector of the plane.
        v: the other, orthogonal to u.
        radius: Å.
        noise: of the forces there.
        what: the plane in words.

    Error:
        what a part of the points gives otherwise, and the noise of the forces.
    """
    angles = 2 * np.pi * np.arange(_POINTS) / _POINTS
    forces = [
        subject.forces(displaced(atoms, radius * (np.cos(angle) * u + np.sin(angle) * v))) for angle in angles
    ]
    along_u = np.array([float(np.sum(force * u)) for force in forces])
    along_v = np.array([float(np.sum(force * v)) for force in forces])
    tangential = -np.sin(angles) * along_u + np.cos(angles) * along_v
    work = 2 * np.pi * radius * float(np.mean(tangential))
    # what a half or a third of the points say: a jump of the forces on the loop sets them apart
    parts = [np.mean(tangential[first::every]) for every in (2, 3) for first in range(every)]
    unsure = 2 * np.pi * radius * float(np.max(np.abs(np.array(parts) - np.mean(tangential))))
    # the first harmonics are the derivative of the forces in the plane
    uu = 2 * float(np.mean(along_u * np.cos(angles))) / radius
    vv = 2 * float(np.mean(along_v * np.sin(angles))) / radius
    uv = float(np.mean(along_u * np.sin(angles) + along_v * np.cos(angles))) / radius
    area = np.pi * radius**2
    rounding = noise.force + np.finfo(float).eps * float(np.max(np.abs([along_u, along_v])))
    error = unsure + 2 * np.pi * radius * rounding / np.sqrt(_POINTS)
    return Loop(what, radius, work, work / area, error / area, float(np.sqrt((uu**2 + vv**2) / 2 + uv**2)))


def _finding(wrong: list[Loop], count: int) -> dict[str, str]:
    worst = max(wrong, key=lambda one: one.share)
    return finding(
        "CURL",
        "error" if worst.share > _SMALL else "warning",
        "the forces do work around a closed loop",
        f"Around a circle of {worst.radius:g} Å ({worst.what}) the forces do {worst.work:.3g} eV of work: "
        f"their derivative has an antisymmetric part of {worst.curl:.3g} ± {worst.error:.1g} eV/Å², "
        f"{worst.share:.1g} of its symmetric part. {len(wrong)} of {count} loops do work. No energy has "
        "these forces: a run gains or loses energy however small its time step.",
        "Derive the forces from the energy. Where they are predicted, do not use them for NVE; where they "
        "are derived, look for a stopped gradient or a neighbor that only one of two atoms counts.",
    )


def _row(one: Loop) -> dict[str, Any]:
    return {
        "plane": one.what,
        "radius (Å)": one.radius,
        "work (eV)": one.work,
        "curl (eV/Å²)": one.curl,
        "error": one.error,
        "stiffness (eV/Å²)": one.stiffness,
        "no work": one.conservative,
    }


def _says(loops: list[Loop], wrong: list[Loop]) -> str:
    if wrong:
        worst = max(wrong, key=lambda one: one.share)
        return (
            f"Around {len(wrong)} of {len(loops)} small loops the forces do work: the antisymmetric part of "
            f"their derivative is up to {worst.share:.2g} of the symmetric one. No energy has these forces."
        )
    limit = max(loops, key=lambda one: (abs(one.curl) + one.error) / max(one.stiffness, 1e-300))
    return (
        f"Around {len(loops)} small loops the forces do no work that could be told from rounding: their "
        "curl is "
        f"below {abs(limit.curl) + limit.error:.1g} eV/Å², where the stiffness is {limit.stiffness:.2g} "
        "eV/Å²."
    )
