"""Check the work around small closed loops. The work is zero if the forces are the gradient of an energy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import AuditCheck, CheckResult, Progress, Ways, finding
from mdnum.audit.noise import NoiseFloor, displaced, settled
from mdnum.audit.subject import CalculatorSubject
from mdnum.units import ENERGY, FORCE, LENGTH, Measured

_RADII = (0.03, 0.003, 0.0003)  # Å; the loop with the smaller error counts
_POINTS = 12  # on a loop: equally spaced, they integrate a smooth periodic function to all orders below
_SIGNIFICANT = 10.0  # work over its error from which it is significant
_SMALL = 1e-4  # antisymmetric over symmetric part of the derivative of the forces: below, it is precision

Displacement = Float[np.ndarray, "atoms 3"]


@dataclass(frozen=True)
class Loop:
    """Work of the forces around a circle in the space of all coordinates."""

    plane: str  # in words
    radius: float  # Å, of the displacement of all atoms together
    work: float  # eV
    curl: float  # work over area: v·Ju - u·Jv with J the derivative of the forces, eV/Å²
    error: float  # of the curl, eV/Å²
    stiffness: float  # size of the symmetric part of J in the plane, eV/Å²

    @property
    def conservative(self) -> bool:
        """True if the curl of the forces is zero within its error."""
        return abs(self.curl) <= _SIGNIFICANT * self.error

    @property
    def share(self) -> float:
        """Ratio of the antisymmetric to the symmetric part of the forces' derivative matrix."""
        return abs(self.curl) / self.stiffness if self.stiffness else (float("inf") if self.curl else 0.0)


class CurlCheck(AuditCheck):
    """Do the forces do work around closed loops?"""

    name, title, order, basic, calls = "curl", "Curl", 20, True, 500
    needed_to = ("differentiate",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Compute the work of the forces around circles in several planes."""
        rng = np.random.default_rng(self.seed)
        worker = subject.fresh()
        radii, ways = _RADII[:1] if self.brief else _RADII, Ways()
        with subject.meter.limited():
            atoms, noise = settled(worker, rng, brief=self.brief)
            wanted = list(_planes(worker, atoms, rng))

        def asked(plane: tuple[str, Displacement, Displacement]) -> Loop:
            name, u, v = plane
            return agreed([around(worker, atoms, u, v, radius, noise, name) for radius in radii])

        found = ways.each(
            worker, wanted, lambda plane: f"a loop of {plane[0]}", asked, progress, self.name, spread=True,
            required=True, most=1 if self.brief else None,
        )  # fmt: skip
        loops = list(found.values())
        wrong = [one for one in loops if not one.conservative]
        worst = max(wrong, key=lambda one: one.share, default=None)
        # antisymmetric over symmetric part that may be there and is not seen
        unseen = [(abs(one.curl) + one.error) / max(one.stiffness, 1e-300) for one in loops]
        limit = loops[int(np.argmax(unseen))]
        numbers = {
            "loops": len(loops), "with_work": len(wrong),
            "largest_curl": max(abs(one.curl) for one in loops),
            "largest_share": max((one.share for one in wrong), default=0.0),
            "largest_error": max(one.error for one in loops),
            "unseen_share": float(np.median(unseen)),
        }  # fmt: skip
        values: dict[str, Any] = {**vars(worst), "share": worst.share} if worst else {}
        values |= {
            "loops": len(loops), "wrong": len(wrong),
            "limit": Measured(abs(limit.curl) + limit.error, "energy/length²", scale=limit.stiffness),
        }  # fmt: skip
        severity = "error" if worst and worst.share > _SMALL else "warning"
        return CheckResult(
            says=(["curl_found" if worst else "curl_none"], values),
            findings=[finding("CURL", severity, **values)] if worst else [],
            tables={"Work around closed loops": [_row(one) for one in loops]},
            numbers=numbers,
            limits={"with_work": (0, ("CURL",))},
            **vars(ways),
        )


def agreed(tried: Sequence[Loop]) -> Loop:
    """Return the loop with the smallest error. Enlarge the error if loops of other radii disagree.

    The curl is the same for every small circle. The work at a jump of the forces depends on the radius.
    """
    best = min(tried, key=lambda one: one.error)
    others = [one.curl for one in tried if _SIGNIFICANT * one.error < abs(best.curl)]
    spread = max((abs(one - best.curl) for one in others), default=0.0)
    return replace(best, error=max(best.error, spread))


def _planes(
    subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator
) -> Iterator[tuple[str, Displacement, Displacement]]:
    """Yield planes of two orthonormal displacements of all atoms, of one atom or of a pair."""
    count = len(atoms)
    if count > 1:
        for number in range(3):
            u, v = np.linalg.qr(rng.standard_normal((3 * count, 2)))[0].T
            yield f"all atoms at random, {number + 1}", u.reshape(count, 3), v.reshape(count, 3)

    def of(who: int, first: int, other: int, second: int) -> tuple[Displacement, Displacement]:
        u, v = np.zeros((2, count, 3))
        u[who, first] = v[other, second] = 1.0
        return u, v

    few = rng.permutation(count)[:2]
    for first, second in ((0, 1), (1, 2)):
        for who in few:
            plane = f"atom {who} ({atoms.symbols[who]}) in {'xyz'[first]}{'xyz'[second]}"
            yield plane, *of(who, first, who, second)
    if count < 2:
        return
    who = int(rng.integers(count))
    step = np.zeros((count, 3))
    step[who] = (0.01, 0.007, -0.004)
    answer = np.linalg.norm(subject.forces(displaced(atoms, step)) - subject.forces(atoms), axis=1)
    answer[who] = -1.0
    for other in np.argsort(-answer)[:2]:
        for first, second in ((0, 1), (2, 0)):
            plane = f"atom {who} along {'xyz'[first]} and atom {other} along {'xyz'[second]}"
            yield plane, *of(who, first, other, second)


def around(
    subject: CalculatorSubject,
    atoms: Atoms,
    u: Displacement,
    v: Displacement,
    radius: float,
    noise: NoiseFloor,
    plane: str = "",
) -> Loop:
    """Compute the work on the circle x + radius (u cos t + v sin t). u and v are orthonormal.

    Error: from the force noise, and from the work with half or a third of the points.
    """
    angles = 2 * np.pi * np.arange(_POINTS) / _POINTS
    forces = [
        subject.forces(displaced(atoms, radius * (np.cos(angle) * u + np.sin(angle) * v))) for angle in angles
    ]
    along_u = np.array([float(np.sum(force * u)) for force in forces])
    along_v = np.array([float(np.sum(force * v)) for force in forces])
    tangential = -np.sin(angles) * along_u + np.cos(angles) * along_v
    work = 2 * np.pi * radius * float(np.mean(tangential))
    # what a half or a third of the points give: a jump of the forces on the loop sets them apart
    parts = [np.mean(tangential[first::every]) for every in (2, 3) for first in range(every)]
    unsure = 2 * np.pi * radius * float(np.max(np.abs(np.array(parts) - np.mean(tangential))))
    # the first harmonics are the derivative of the forces in the plane
    uu = 2 * float(np.mean(along_u * np.cos(angles))) / radius
    vv = 2 * float(np.mean(along_v * np.sin(angles))) / radius
    uv = float(np.mean(along_u * np.sin(angles) + along_v * np.cos(angles))) / radius
    area = np.pi * radius**2
    rounding = noise.force + np.finfo(float).eps * float(np.max(np.abs([along_u, along_v])))
    error = unsure + 2 * np.pi * radius * rounding / np.sqrt(_POINTS)
    return Loop(plane, radius, work, work / area, error / area, float(np.sqrt((uu**2 + vv**2) / 2 + uv**2)))


def _row(one: Loop) -> dict[str, Any]:
    return {
        "plane": one.plane, f"radius ({LENGTH})": one.radius, f"work ({ENERGY})": one.work,
        f"curl ({FORCE}²)": one.curl, "error": one.error, f"stiffness ({FORCE}²)": one.stiffness,
        "no work": one.conservative,
    }  # fmt: skip
