"""Noise and number of digits of a calculator's energies and forces."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from ase import Atoms
from jaxtyping import Float, Int
from scipy.special import stdtrit

from mdnum.audit.base import CalculatorError, Observed, finding
from mdnum.audit.subject import CalculatorSubject, Forces, differences, largest, no_rounding, rms

#: Spacing (Å) of the points of the line along which noise is measured: the fourth difference of a smooth
#: function is below 1e-16 eV for any chemistry, but even in single precision neighboring points are distinct.
_SPACING = 1e-5
_POINTS, _FEW_POINTS = 25, 9
#: Effective number of values, as a share of the points, on which the estimated standard deviation is based:
#: neighboring differences share points, so that its square scatters like that of fewer values.
_INDEPENDENT = 0.28
#: Smallest tolerance as a multiple of the noise, because the largest of about a hundred forces is compared
#: and another order of summation scatters more than neighboring points; and the probability that a difference
#: exceeds the tolerance by chance.
_ALLOWED, _BY_CHANCE = 40.0, 1e-6
RATTLE = 0.03  # Å by which atoms are moved, so that no distance sits on a threshold by design
_TRIES, _DRAWS = 5, 8  # structures of which the quietest is taken, and random moves of the size of rounding
FEW = 8  # atoms below which symmetry may hide the noise
#: Spacings (Å) of the points of the line along which discontinuities caused by rounding are searched; wider
#: ones are used if no value changes.
_STEP_SPACINGS = (1e-4, 1.6e-3, 2.5e-2)
_STEP_POINTS = 17
#: Number of points at which a value must be unchanged for it to count as stepwise, and share of the force
#: components above which the forces count as stepwise.
_STAYS, _STAIRS = 3, 0.1
#: Second differences that are multiples of one number, within this share of it, belong to a stepwise value;
#: those of a smooth value change little from one to the next.
_ALIKE = 1e-3
#: Noise of the energy that rounding explains, for double and for single precision.
_QUIET, _QUIET_SINGLE = 1e-11, 1e-6
_QUIETER = 1e-3  # a line so much quieter than another has no threshold on it; rounding differs by less
#: Number of orders of atoms that are compared with the given order; spacing (Å) and number of the points at
#: which two orders are compared, far enough apart for different rounding errors.
_ORDERS, _ORDER_SPACING, _ORDER_POINTS = 3, 1e-3, 9
#: Difference between two orders: a scatter from point to point above the first value excludes a smooth
#: function. Relative to the energy and to the forces times distances in the structure, rounding of a sum is
#: below the second value.
_AT_RANDOM, _SUMMED = 0.05, 1e-5
_MOST_DECIMALS = 9  # that are taken for rounding, at most: a double of more is too near to its own
_FEWEST = 4  # different answers, 0 aside, from which is judged
_NOISY = 1e5  # noise, in units of the rounding of a double, above which fewer digits are reported
_SMALL = 1e-4  # of the root mean square force: half a step above is one that a run and a derivative feel
_SMALL_ENERGY = 1e-2  # of kT: what an energy in single precision may be rounded to
_HALF = 11
_FORMATS = ((8, "bfloat16"), (_HALF, "half precision"), (24, "single precision"))  # bits of a significand


@dataclass(frozen=True)
class NoiseFloor:
    """Noise level of energies and forces. Smaller differences do not indicate an error."""

    energy: float  # standard deviation, eV
    force: float  # standard deviation of a component, of the atom that scatters most, eV/Å
    typical: float = 0.0  # the same of the median component
    freedom: float = math.inf  # independent values that the standard deviations were estimated from

    def louder(self, other: NoiseFloor) -> NoiseFloor:
        """Combine two noise levels: the larger noise and the smaller number of degrees of freedom."""
        return NoiseFloor(
            max(self.energy, other.energy), max(self.force, other.force), max(self.typical, other.typical),
            min(self.freedom, other.freedom),
        )  # fmt: skip

    @property
    def allowed(self) -> NoiseFloor:
        """Largest differences of energies and forces that noise can explain.

        The limit uses Student's t distribution, because the noise is estimated from few values.
        """
        student = math.sqrt(2) * float(-stdtrit(min(self.freedom, 1e9), _BY_CHANCE / 2))
        return replace(self, **{
            name: max(_ALLOWED, student) * getattr(self, name) for name in ("energy", "force", "typical")
        })  # fmt: skip


def along_a_line(
    subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator, points: int = _POINTS
) -> NoiseFloor:
    """Estimate the noise from high-order differences at equally spaced points.

    Source:
        J. J. Moré and S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33, 1292 (2011).
    """
    line = direction(len(atoms), rng)
    places = [displaced(atoms, (at - points // 2) * _SPACING * line) for at in range(points)]
    answers = [subject.both(place) for place in places]
    energies, forces = np.array([energy for energy, _ in answers]), [force for _, force in answers]
    columns = np.array(forces).reshape(points, -1)
    energy = float(scatter(energies[:, None])[0])
    scatters = scatter(columns)
    force = float(np.max(scatters))
    if no_rounding(energy, force, (energies[0], columns), subject.kT):
        # by chance, or by a threshold: the point that sticks out is asked again
        for at in {_odd_one(energies), _odd_one(columns[:, np.argmax(scatters)])}:
            subject.again(places[at], *answers[at])
    # values that round to the same number at every point still carry the rounding of one operation
    floor, typical = np.finfo(float).eps, float(np.median(scatters))
    return NoiseFloor(
        max(energy, floor * largest(energies)), max(force, floor * largest(columns)), typical,
        _INDEPENDENT * points,
    )  # fmt: skip


@dataclass(frozen=True)
class Staircase:
    """Size of the discrete steps of energies and forces along a line of structures."""

    energy: float  # the size of a step, eV; 0 where there are none
    force: float  # of a force component, eV/Å
    share: float  # of force components that go in steps, of those that change at all
    length: float  # of the line, Å
    energies: Float[np.ndarray, "points"]  # at its points, eV
    forces: Float[np.ndarray, "points components"]  # at its points, eV/Å


def steps(subject: CalculatorSubject, atoms: Atoms) -> Staircase:
    """Detect energies and forces that change only in discrete steps as an atom moves.

    A smooth energy or force changes if an atom moves by 1e-4 Å, even in single precision. Points with
    unchanged energy and forces are ignored, because they may be cached.
    """
    key = ("steps", atoms.positions.tobytes(), atoms.cell.array.tobytes())
    if key in subject.known:
        return subject.known[key]
    line = direction(len(atoms), np.random.default_rng(len(atoms)))
    for spacing in _STEP_SPACINGS:
        there = [displaced(atoms, k * spacing * line) for k in range(_STEP_POINTS)]
        answers = [subject.both(one) for one in there]
        energies = np.array([energy for energy, _ in answers])
        forces = np.array([force.ravel() for _, force in answers])
        moved = (np.diff(energies) != 0) | (np.diff(forces, axis=0) != 0).any(axis=1)
        changes = np.diff(forces, axis=0)[moved]
        alive, felt = np.any(changes != 0, axis=0), np.any(forces != 0, axis=0)
        if (np.ptp(energies) > 0 and 2 * np.sum(alive) >= np.sum(felt)) or not felt.any():
            break
    stairs = alive & (np.sum(changes == 0, axis=0) >= _STAYS)
    share = float(np.sum(stairs) / np.sum(alive)) if alive.any() else 0.0
    sizes = np.abs(changes[:, stairs])
    force = float(np.median(sizes[sizes > 0])) if share > _STAIRS else 0.0
    climbs = np.abs(np.diff(energies)[moved])
    stays = np.sum(climbs == 0) >= _STAYS and climbs.any()
    energy = float(np.median(climbs[climbs > 0])) if stays else 0.0
    if not np.ptp(energies):
        # as large as the change that the forces predict, at least
        along = forces @ line.ravel()
        work = spacing * np.cumsum(0.5 * (along[1:] + along[:-1]))
        energy = float(np.ptp(np.append(work, 0.0)))
    length = (_STEP_POINTS - 1) * spacing
    subject.known[key] = Staircase(energy, force, share, length, energies, forces)
    return subject.known[key]


def rounding(subject: CalculatorSubject, atoms: Atoms) -> NoiseFloor:
    """Return the noise due to discrete steps and to limited digits."""
    stairs = steps(subject, atoms)
    energies = stairs.energies
    grain = max(stairs.energy, digits(energies).grain(energies), _quantum(energies))
    return NoiseFloor(0.5 * grain, 0.5 * stairs.force)


def _quantum(values: Float[np.ndarray, "points"]) -> float:
    """Return a common divisor of second differences that exceed rounding errors. 0 if there is none."""
    sizes = np.abs(np.diff(values, n=2))
    sizes = sizes[sizes > np.spacing(largest(values)) / _ALIKE]
    for part in (1, 2, 3) if sizes.size else ():
        ratio = part * sizes / sizes.min()
        if np.abs(ratio - np.rint(ratio)).max() < _ALIKE and len(set(np.rint(ratio))) > 1:
            return float(sizes.min()) / part
    return 0.0


def scatter(values: Float[np.ndarray, "points columns"]) -> Float[np.ndarray, "columns"]:
    """Standard deviation of the noise in each column, from differences of orders 4, 5 and 6."""
    found = []
    for order in (4, 5, 6):
        weight = math.factorial(order) ** 2 / math.factorial(2 * order)
        found.append(np.sqrt(weight * np.mean(np.diff(values, n=order, axis=0) ** 2, axis=0)))
    return np.median(found, axis=0)


def order_change(
    subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor, rng: np.random.Generator
) -> tuple[float, NoiseFloor]:
    """Reorder the atoms. Return the largest energy change (eV) and its noise.

    The noise is 0 if rounding does not explain the energy change. The noise is also 0 if the changes are
    within the given `noise`. Along a line, a rounding error varies randomly. An error due to missing terms
    varies smoothly.
    """
    count, none = len(atoms), NoiseFloor(0.0, 0.0)
    if count < 2:
        return 0.0, none
    orders = [np.arange(count)[::-1], *(rng.permutation(count) for _ in range(_ORDERS - 1))]
    there = subject.fresh()
    base = there.both(atoms)
    try:
        with subject.trying():
            answers = [in_order(there, atoms, order) for order in orders]
    except CalculatorError:
        return 0.0, none  # reported elsewhere
    energy, force = np.array([differences(base, answer) for answer in answers]).max(axis=0)
    allowed, total = noise.allowed, count * largest(base[1])
    quiet = energy <= min(allowed.energy, _NOISY * np.spacing(abs(base[0]))) and force <= allowed.force
    size = total * float(np.ptp(atoms.positions, axis=0).max()) + abs(base[0])
    if quiet or energy > _SUMMED * size or force > _SUMMED * total:
        return energy, none
    line = _ORDER_SPACING * direction(count, rng)
    rows = []
    for at in range(_ORDER_POINTS):
        moved = displaced(atoms, at * line)
        one, other = there.both(moved), in_order(there, moved, orders[0])
        rows.append([other[0] - one[0], *(other[1] - one[1]).ravel()])
    values = np.array(rows)
    drawn, sizes = scatter(values), np.sqrt(np.mean(values**2, axis=0))
    worst = 1 + int(np.argmax(sizes[1:]))
    # whatever is above the noise has to be drawn anew
    smooth = drawn < _AT_RANDOM * sizes
    if (energy > allowed.energy and smooth[0]) or (force > allowed.force and smooth[worst]):
        return energy, none
    return energy, NoiseFloor(float(sizes[0]), float(sizes[worst]), freedom=_ORDER_POINTS)


def measured(subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator) -> NoiseFloor:
    """Return the larger noise from two tests: structures along a line, and reordered atoms."""
    noise = along_a_line(subject, atoms, rng)
    return noise.louder(order_change(subject, atoms, noise, rng)[1])


def in_order(
    subject: CalculatorSubject, atoms: Atoms, order: Int[np.ndarray, "atoms"]
) -> tuple[float, Forces]:
    """Compute energy and forces of reordered atoms. Forces are returned in the original order."""
    there = atoms[order]
    assert isinstance(there, Atoms)
    energy, forces = subject.both(there)
    back = np.empty_like(forces)
    back[order] = forces
    return energy, back


def _odd_one(values: Float[np.ndarray, "points"]) -> int:
    """Return the index of the point whose removal most improves the fit of a parabola."""
    at = np.arange(len(values)) - len(values) // 2
    # of values that are all large, what they have in common has no digits to spare
    values = values - np.median(values)
    left = []
    for k in range(len(values)):
        rest, others = np.delete(at, k), np.delete(values, k)
        left.append(np.sum((others - np.polyval(np.polyfit(rest, others, 2), rest)) ** 2))
    return int(np.argmin(left))


def under_jitter(
    subject: CalculatorSubject, atoms: Atoms, size: float, rng: np.random.Generator
) -> NoiseFloor:
    """Largest change of energy and force component for random displacements of up to `size` Å.

    The coordinates of a periodic image are rounded by up to one unit in the last place.
    """
    base, worst = subject.both(atoms), NoiseFloor(0.0, 0.0)
    for _ in range(_DRAWS):
        there = displaced(atoms, size * rng.uniform(-1, 1, (len(atoms), 3)))
        moved = subject.both(there)
        change, force = differences(base, moved)
        # either answer may be the one that sticks out
        if no_rounding(change, force, base, subject.kT) and not subject.again(there, *moved):
            subject.again(atoms, *base)
        worst = worst.louder(NoiseFloor(change, force, freedom=_DRAWS))
    return worst


def settled(
    subject: CalculatorSubject, rng: np.random.Generator, at_least: int = FEW, brief: bool = False
) -> tuple[Atoms, NoiseFloor]:
    """Displace atoms slightly, away from distance thresholds. Return the structure and its noise.

    In a perfect crystal, a whole neighbor shell can lie exactly at a cutoff. An energy jump there would
    count as noise. Of several random displacements, the one with the least noise is therefore used.

    Args:
        at_least: minimum number of atoms; a smaller periodic cell is repeated.
        brief: use the first random displacement, and skip the test of other atom orders.
    """
    given = roomy(subject.atoms, at_least)
    # several checks ask with the same seed: the answer to the first is known
    key = ("settled", len(given), brief, str(rng.bit_generator.state))
    if key in subject.known:
        there, noise, rng.bit_generator.state = subject.known[key]
        return there.copy(), noise
    tried: list[tuple[Atoms, NoiseFloor]] = []
    for _ in range(1 if brief else _TRIES):
        there = displaced(given, RATTLE * rng.uniform(-1, 1, (len(given), 3)))
        noise = along_a_line(subject, there, rng, _FEW_POINTS if brief else _POINTS)
        if not tried or noise.energy < _QUIETER * tried[-1][1].energy:
            tried.append((there, noise))
        # quiet enough to be rounding; where it is not, a threshold on the line looks like noise as well
        energy = subject.energy(there)
        single = float(np.float32(energy)) == energy
        if noise.energy < (_QUIET_SINGLE if single else _QUIET) * max(1.0, abs(energy)):
            break
    there, noise = tried[-1]
    if len(there) < FEW and there.pbc.any():
        # of few atoms, terms that cancel by symmetry leave no trace
        many = roomy(there, FEW)
        many.positions += RATTLE * rng.uniform(-1, 1, many.positions.shape)
        with contextlib.suppress(CalculatorError):
            noise = noise.louder(along_a_line(subject, many, rng))
    # what goes in steps may not move at all on so short a line
    noise = noise.louder(rounding(subject, there))
    if not brief:
        # another order of the same sum is rounded otherwise, which no line shows
        subject.known["order"] = order_change(subject, there, noise, rng)
        noise = noise.louder(subject.known["order"][1])
    subject.known[key] = there.copy(), noise, rng.bit_generator.state
    return there, noise


def roomy(atoms: Atoms, at_least: int) -> Atoms:
    """Repeat a structure along its periodic axes until it has enough atoms."""
    if len(atoms) >= at_least or not len(atoms) or not atoms.pbc.any():
        return atoms
    times = math.ceil((at_least / len(atoms)) ** (1 / int(atoms.pbc.sum())))
    return atoms.repeat(np.where(atoms.pbc, times, 1))


def direction(atoms: int, rng: np.random.Generator) -> Float[np.ndarray, "atoms 3"]:
    """Return random displacements of all atoms. The longest has length 1."""
    drawn = rng.standard_normal((atoms, 3))
    return drawn / np.max(np.linalg.norm(drawn, axis=1))


def displaced(atoms: Atoms, by: Float[np.ndarray, "*atoms 3"]) -> Atoms:
    """Return a copy of a structure with displaced atoms (Å)."""
    there = atoms.copy()
    there.positions += by
    return there


@dataclass(frozen=True)
class Digits:
    """Number of decimal places and of significand bits in a set of numbers."""

    decimals: int | None  # they are rounded to; None where to none
    bits: int  # of their significands, at most; 53 for a double that is used in full

    @property
    def quantum(self) -> float:
        """Spacing of numbers with a fixed number of decimals. 0 for unrounded numbers."""
        return 0.0 if self.decimals is None else 10.0**-self.decimals

    def grain(self, values: np.ndarray) -> float:
        """Return the spacing of rounded numbers near the largest absolute value of `values`."""
        return max(self.quantum, 2.0**-self.bits * largest(values))

    @property
    def format(self) -> str | None:
        """Narrowest floating-point format that can hold the numbers. None if there is none."""
        return next((name for most, name in _FORMATS if self.bits <= most), None)


def digits(values: np.ndarray) -> Digits:
    """Return the decimal places and bits of the values. Few distinct values count as unrounded."""
    found = np.unique(np.asarray(values, dtype=np.float64))
    found = found[np.isfinite(found) & (found != 0.0)]
    if len(found) < _FEWEST:
        return Digits(None, 53)
    whole = np.abs(np.ldexp(np.frexp(found)[0], 53)).astype(np.int64)
    bits = 53 - int(np.log2((whole & -whole).astype(np.float64)).min())
    for decimals in range(_MOST_DECIMALS + 1):
        if all(float(f"{value:.{decimals}f}") == value for value in found):
            return Digits(decimals, bits)
    return Digits(None, bits)


def precision(subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor) -> Iterator[Observed]:
    """Yield a finding if energies or forces have fewer digits than a double.

    Discrete steps are also measured along a line of structures, because digits may not reveal them. For
    example, forces rounded before a unit conversion use all digits.
    """
    stairs = steps(subject, atoms)
    size, typical = largest(stairs.energies), rms(stairs.forces)
    if not size or not typical:
        return
    read = {"energy": digits(stairs.energies), "forces": digits(stairs.forces)}
    sizes = {
        word: one.quantum or step
        for (word, one), step in zip(read.items(), (stairs.energy, stairs.force), strict=True)
    }
    # few bits show where a value has no room for steps on the line
    coarse = [
        word
        for word, one in read.items()
        if one.bits <= _HALF or (sizes[word] and not (one.bits <= 24 and not one.quantum))
    ]
    if coarse:
        yield _quantized(coarse, sizes, read, stairs, typical)
        return
    share, eps = noise.force / typical, np.finfo(np.float64).eps
    ulps = noise.energy / np.spacing(size)
    both = Digits(None, max(one.bits for one in read.values())).format
    narrow = {"answers": both, "energies": read["energy"].format, "forces": read["forces"].format}
    whose = next((word for word, name in narrow.items() if name), None)
    loud, smooth = share > _NOISY * eps, not narrow["energies"] and ulps <= _NOISY
    change, floor = subject.known.get("order", (0.0, NoiseFloor(0.0, 0.0)))
    summed = floor.energy > 0
    if whose is None and not loud and not (ulps > _NOISY and summed):
        return
    severity = "warning" if noise.energy > _SMALL_ENERGY * subject.kT > 0 else "info"
    if loud and smooth:  # forces alone have lost what the energy they belong to still has
        severity = "error" if share > _SMALL else "warning"
    yield finding(
        "LOW_PRECISION", severity,
        ("order_format" if whose in ("answers", "energies") else "order") if summed else None,
        "format" if whose else "forces" if smooth and not summed else None,
        tests=("rounding",), change=change, whose=whose, format=narrow[whose] if whose else None,
        energy=noise.energy, ulps=float(ulps), digits=round(max(-np.log10(max(share, eps)), 0)),
    )  # fmt: skip


def _quantized(
    coarse: list[str], sizes: dict[str, float], read: dict[str, Digits], stairs: Staircase, typical: float
) -> Observed:
    bound, variants, values = 0.0, [], {}
    for word in coarse:
        one = read[word]
        how = "decimals" if one.quantum else "format" if one.format else None
        variants += [f"{word}_{how}" if how else None, f"{word}_step" if sizes[word] else None]
        values |= {
            f"{word}_decimals": one.decimals, f"{word}_format": one.format, f"{word}_step": sizes[word],
        }  # fmt: skip
    if "forces" in coarse:
        bound = 0.5 * sizes["forces"] or 2.0 ** -read["forces"].bits * typical
        values["forces_share"] = sizes["forces"] / typical
    return finding(
        "QUANTIZED", "error" if bound > _SMALL * typical else "warning", *variants, **values,
        length=stairs.length, points=len(stairs.energies), different=len(np.unique(stairs.energies)),
        share=stairs.share,
    )  # fmt: skip
