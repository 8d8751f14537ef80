"""A small correct calculator, and the same with one mistake each that the audit is there to find."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from ase import Atoms
from ase.build import bulk
from ase.calculators.calculator import Calculator, all_changes
from audit.laws import Exact

from mdnum.audit.base import CheckResult, Observed
from mdnum.audit.checks import CHECKS
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.thresholds import PairThreshold

R_CUT = 3.4
KT = 0.01


def crystal() -> Atoms:
    """Eight atoms in a cell of little more than one cutoff: images of all kinds are needed."""
    return bulk("Ar", "fcc", a=3.9, cubic=True).repeat((2, 1, 1))


def chain() -> Atoms:
    """Six atoms of two species, with nothing periodic and nothing symmetric."""
    rng = np.random.default_rng(3)
    positions = np.cumsum(np.full((6, 3), 1.4), axis=0) + rng.uniform(-0.3, 0.3, (6, 3))
    return Atoms("ArKrArArKrAr", positions=positions)


def subject(make: Callable[[], Any], atoms: Atoms | None = None, order: int | None = 4) -> CalculatorSubject:
    """The subject of an audit, with its cutoff as a walk finds it, of an order; None where it has none."""
    found = CalculatorSubject("planted", make, crystal() if atoms is None else atoms, kT=KT)
    end = (R_CUT, ("Ar", "Ar"), order or 0, (0.0,) * 3, R_CUT, R_CUT, True, 1e-9)
    found.known["thresholds"] = [] if order is None else [PairThreshold(*end)]
    return found


def asked(
    name: str, make: Callable[[], Any], atoms: Atoms | None = None, order: int | None = 4
) -> CheckResult:
    """What a check finds of a calculator."""
    return CHECKS[name]()(subject(make, atoms, order))


def codes(result: CheckResult | Iterable[Observed]) -> dict[str, str]:
    """Severities by code."""
    return {one.code: one.severity for one in getattr(result, "findings", result)}


def values(result: CheckResult, code: str) -> dict[str, Any]:
    """Values of the one finding of a code, and its variants."""
    (found,) = [one for one in result.findings if one.code == code]
    return {**found.values, "variants": found.variants}


class Good(Exact):
    """A smooth pair potential, by brute force over images: (1 - x²)⁴ (a - b x²), x = r / r_cut.

    Overridden one by one below; every step of it is right here.
    """

    implemented_properties = ["energy", "free_energy", "forces"]  # noqa: RUF012

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        there = self.atoms
        assert isinstance(there, Atoms)
        energy, forces = self.answer(there)
        self.results = {"energy": energy, "free_energy": energy, "forces": forces}

    def answer(self, atoms: Atoms) -> tuple[float, np.ndarray]:
        i, j, vectors = self.neighbors(atoms)
        distances = np.linalg.norm(vectors, axis=1)
        u, slope = self.pair(distances)
        weight = self.weight(atoms, i, j)
        forces = np.zeros((len(atoms), 3))
        # each directed pair once: j's half of the force on i
        np.add.at(forces, i, (weight * slope / distances)[:, None] * vectors)
        return self.extra(atoms, 0.5 * float(np.sum(weight * u)), forces)

    def neighbors(self, atoms: Atoms) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.pairs(self.positions(atoms), self.shifts(atoms), atoms)

    def positions(self, atoms: Atoms) -> np.ndarray:
        """As the search wants them: wrapped along periodic axes."""
        found = atoms.positions.copy()
        if atoms.pbc.any():
            rows = atoms.cell.array[atoms.pbc]
            found -= np.floor(found @ np.linalg.pinv(rows)) @ rows
        return found

    def shifts(self, atoms: Atoms) -> np.ndarray:
        """All lattice vectors that can matter to wrapped positions."""
        rows = atoms.cell.array[atoms.pbc]
        widths = 1 / np.linalg.norm(np.linalg.pinv(rows), axis=0) if len(rows) else ()
        return _lattice(rows, [int(R_CUT / width) + 1 for width in widths])

    def pairs(self, positions, shifts, atoms) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        i, j, _, vectors = near(positions, shifts, R_CUT)
        return i, j, vectors

    def pair(self, distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energy of a pair, and its derivative by the distance."""
        x2 = (distances / R_CUT) ** 2
        window, well = (1 - x2) ** 4, 0.9 - 1.6 * x2
        slope = (-8 * (1 - x2) ** 3 * well - 3.2 * window) * distances / R_CUT**2
        return window * well, slope

    def weight(self, atoms: Atoms, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return np.ones(len(i))

    def extra(self, atoms: Atoms, energy: float, forces: np.ndarray) -> tuple[float, np.ndarray]:
        return energy, forces


def _lattice(rows: np.ndarray, counts: list[int]) -> np.ndarray:
    steps = np.array(list(itertools.product(*(range(-n, n + 1) for n in counts))))
    return steps @ rows if len(rows) else np.zeros((1, 3))


def near(positions: np.ndarray, shifts: np.ndarray, reach: float) -> tuple[np.ndarray, ...]:
    """(i, j, number of the shift, vector) of all directed pairs within reach."""
    vectors = positions[None, :, None] + shifts[None, None] - positions[:, None, None]
    squares = np.sum(vectors**2, axis=3)
    i, j, image = np.nonzero((squares < reach**2) & (squares > 1e-12))
    return i, j, image, vectors[i, j, image]


def inside(i: np.ndarray, j: np.ndarray, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    squares = np.sum(vectors**2, axis=1)
    keep = (squares < R_CUT**2) & (squares > 1e-12)
    return i[keep], j[keep], vectors[keep]


def but(_base: type[Good] = Good, **methods: Any) -> type[Any]:
    """The same with some methods of its own."""
    return type("Planted", (_base,), methods)


def keeping(mask: Callable[..., np.ndarray], **more: Any) -> type[Any]:
    """Keeps some of its pairs alone: mask(calculator, atoms, i, j, vectors)."""

    def pairs(self, positions, shifts, atoms):
        i, j, vectors = Good.pairs(self, positions, shifts, atoms)
        keep = mask(self, atoms, i, j, vectors)
        return i[keep], j[keep], vectors[keep]

    return but(pairs=pairs, **more)


def adding(extra: Callable[[Atoms, float, np.ndarray], tuple[float, np.ndarray]]) -> type[Any]:
    """Changes energy and forces when they are done."""
    return but(extra=lambda self, atoms, energy, forces: extra(atoms, energy, forces))


def through(energy: Callable[[float], Any] = float, forces: Callable[..., Any] = np.array) -> type[Any]:
    """Energy, or forces, through another format."""
    return adding(lambda atoms, e, f: (energy(e), forces(f)))


# -- how a structure is written down ---------------------------------------------------------------

#: Looks for neighbors one cell away and does not wrap: unwrapped coordinates lose theirs.
OneImage = but(positions=lambda self, atoms: atoms.positions)


def _in_a_cell(self, atoms, i, j, vectors):
    # the same wrap in two steps, as codes do that work with fractions: -tiny becomes exactly 1
    shares = atoms.cell.scaled_positions(atoms.positions)
    lost = np.any(shares - np.floor(shares) >= 1.0, axis=1)
    return ~lost[i] & ~lost[j]


#: Puts atoms into cells of a grid by their wrapped fraction; one that rounds to 1 is in none.
FaceDropped = keeping(_in_a_cell)
#: Keeps six neighbors of each atom, those that come first.
FirstSix = keeping(lambda self, atoms, i, j, vectors: np.arange(len(i)) - np.searchsorted(i, i) < 6)
#: Only the first of two atoms feels a pair.
OneSided = keeping(lambda self, atoms, i, j, vectors: (i < j) | ((i == j) & (vectors[:, 0] > 0)))


class NearestImage(Good):
    """One image of each pair, whatever the cell."""

    def pairs(self, positions, shifts, atoms):
        i, j = np.nonzero(~np.eye(len(positions), dtype=bool))
        vectors = positions[j] - positions[i]
        return inside(i, j, vectors - np.rint(vectors @ np.linalg.inv(atoms.cell.array)) @ atoms.cell.array)


class ByLengths(Good):
    """Counts images by the lengths of lattice vectors, which skewed cells exceed."""

    def shifts(self, atoms):
        rows = atoms.cell.array[atoms.pbc]
        return _lattice(rows, [int(np.ceil(R_CUT / np.linalg.norm(row))) for row in rows])


#: Knows where up is.
Tilted = adding(lambda atoms, e, f: (e * (1 + 1e-3 * atoms.cell.array[0, 2] ** 2), f))
#: Tells left from right: the triple product of the first four atoms.
Handed = adding(
    lambda atoms, e, f: (
        e + 1e-3 * float(np.linalg.det(atoms.positions[1:4] - atoms.positions[0])) * (not atoms.pbc.any()), f
    )
)  # fmt: skip


class WrapsAlways(Good):
    """Wraps along axes that do not repeat."""

    def positions(self, atoms):
        if atoms.pbc.any() or not atoms.cell.array.any():
            return super().positions(atoms)
        rows = atoms.cell.array
        return atoms.positions - np.floor(atoms.positions @ np.linalg.inv(rows)) @ rows


class ByAppearance(Good):
    """Numbers species as it meets them, and takes their parameters by that number."""

    def weight(self, atoms, i, j):
        met = list(dict.fromkeys(atoms.numbers))
        size = np.array([1.0 + 0.05 * met.index(number) for number in atoms.numbers])
        return size[i] * size[j]


class OnlyRectangles(Good):
    """Refuses what it cannot do, which is no mistake."""

    def answer(self, atoms):
        if atoms.pbc.any() and np.abs(atoms.cell.array - np.diag(np.diag(atoms.cell.array))).max() > 1e-9:
            raise NotImplementedError("rectangular cells only")
        return super().answer(atoms)


# -- energies and forces ---------------------------------------------------------------------------

#: A cutoff that cuts.
HardEdge = but(pair=lambda self, r: (Good.pair(self, r)[0] + 0.01, Good.pair(self, r)[1]))
#: The derivative of the window is left out of the force.
NoSwitchInForce = but(
    pair=lambda self, r: (Good.pair(self, r)[0], (1 - (r / R_CUT) ** 2) ** 4 * -3.2 * r / R_CUT**2)
)
#: Adds a force that goes round the center of the structure.
Whirl = adding(
    lambda atoms, e, f: (
        e, f + 1e-3 * np.cross([0.0, 0.0, 1.0], atoms.positions - atoms.positions.mean(axis=0))
    )
)  # fmt: skip
#: A term of the whole: the energy of parts is not the sum.
Background = adding(lambda atoms, e, f: (e + 0.1 * len(atoms) ** 2 * (not atoms.pbc.any()), f))
#: Works in single precision.
Single = through(lambda e: float(np.float32(e)), lambda f: f.astype(np.float32).astype(float))
#: Hands its forces over in a narrow format; the same before a factor, after which every bit is used.
HalfPrecision = through(forces=lambda f: f.astype(np.float16).astype(float))
HalfInOtherUnits = through(forces=lambda f: (f / 0.0433641153107705).astype(np.float16) * 0.0433641153107705)
#: Keeps eight bits.
BrainFloat = through(forces=lambda f: np.ldexp(np.round(256 * np.frexp(f)[0]) / 256, np.frexp(f)[1]))
#: An energy in a narrow format, the forces in full.
HalfEnergy = through(lambda e: float(np.float16(e)))


def decimals(places: int) -> type[Any]:
    """Hands over forces as a text of few digits."""
    return through(forces=lambda f: np.round(f, places))


class TwoEnergies(Good):
    """Knows an energy beside the one its forces belong to."""

    def other(self, atoms: Atoms, energy: float) -> float:
        """A constant for each atom."""
        return energy - 3.5 * len(atoms)

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        assert isinstance(self.atoms, Atoms)
        self.results["energy"] = self.other(self.atoms, self.results["free_energy"])


#: They differ by what changes smoothly with the positions, as with smeared electrons.
Entropy = but(TwoEnergies, other=lambda self, atoms, energy: 1.01 * energy)
#: The energy alone is cut where the free energy is smooth.
CutEnergy = but(TwoEnergies, other=lambda self, atoms, e: e + 0.005 * len(self.neighbors(atoms)[0]))
#: The energy alone depends on the order of the atoms.
OrderedEnergy = but(
    TwoEnergies, other=lambda self, atoms, e: e + 0.01 * np.linalg.norm(np.diff(atoms.positions[:2], axis=0))
)


class SwappedEnergies(TwoEnergies):
    """What forces belong to is handed over as energy, and something else as free energy."""

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        energy = self.results["free_energy"]
        self.results |= {"energy": energy, "free_energy": 0.98 * energy}


# -- memory and chance -----------------------------------------------------------------------------


class OldPairs(Good):
    """Keeps the list of pairs while the number of atoms stays the same."""

    kept: Any = None

    def pairs(self, positions, shifts, atoms):
        if self.kept is None or self.kept[0] != len(atoms):
            self.kept = len(atoms), len(shifts), *near(positions, shifts, 1.1 * R_CUT)[:3]
        _, count, i, j, image = self.kept
        return inside(i, j, positions[j] + shifts[image * (count == len(shifts))] - positions[i])


class FullSkin(Good):
    """A skin list without images of its own, rebuilt when an atom has moved by all of the skin, not half."""

    skin, share = 0.4, 1.0
    kept: Any = None

    def positions(self, atoms):
        return atoms.positions

    def pairs(self, positions, shifts, atoms):
        key = (len(atoms), atoms.cell.array.tobytes(), atoms.pbc.tobytes(), atoms.numbers.tobytes())
        if self.kept is None or self.kept[0] != key or (
            np.max(np.linalg.norm(positions - self.kept[1], axis=1)) > self.share * self.skin
        ):  # fmt: skip
            # images are counted from the wrapped atoms, and belong to them as they are
            wrapped, rows = Good.positions(self, atoms), atoms.cell.array[atoms.pbc]
            offset, shifts = wrapped - positions, _lattice(rows, [3] * len(rows))
            i, j, image, _ = near(wrapped, shifts, R_CUT + self.skin)
            self.kept = key, positions.copy(), i, j, shifts[image] + offset[j] - offset[i]
        i, j, moved = self.kept[2:]
        return inside(i, j, positions[j] + moved - positions[i])


#: The same with the criterion as it should be.
HalfSkin = but(FullSkin, share=0.5)


class OldTail(Good):
    """Writes its pairs into a buffer that only grows, and reads as many rows as the fullest atom ever had."""

    buffer: Any = None

    def pairs(self, positions, shifts, atoms):
        i, j, vectors = super().pairs(positions, shifts, atoms)
        if self.buffer is None or len(self.buffer[0]) < len(i):
            self.buffer = i.copy(), vectors.copy()
            return i, j, vectors
        old_i, old_vectors = self.buffer
        old_i[: len(i)], old_vectors[: len(i)] = i, vectors
        keep = old_i < len(positions)
        return old_i[keep].copy(), old_i[keep].copy(), old_vectors[keep].copy()


#: Sums in another order each time.
Restless = keeping(
    lambda self, atoms, i, j, vectors: self.rng.permutation(len(i)), rng=np.random.default_rng(11)
)


def _alone(self, atoms: Atoms) -> bool:
    return bool((np.bincount(self.neighbors(atoms)[0], minlength=len(atoms)) == 0).any())


#: Divides by the number of neighbors; takes the nearest of no neighbors, and fails.
MeanNeighbor = but(extra=lambda self, atoms, e, f: (np.nan if _alone(self, atoms) else e, f))
EmptyList = but(extra=lambda self, atoms, e, f: (e / (not _alone(self, atoms)), f))


class WrapsGiven(Good):
    """Wraps the atoms that it was handed instead of a copy."""

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        assert isinstance(atoms, Atoms)
        atoms.wrap()


def drops(share: float, seed: int = 7) -> type[Any]:
    """Leaves a pair out now and then, whichever."""

    def mask(self, atoms, i, j, vectors):
        if not len(i) or self.rng.random() >= share:
            return np.ones(len(i), bool)
        return np.arange(len(i)) != self.rng.integers(len(i))

    return keeping(mask, rng=np.random.default_rng(seed))


def hits(share: float, seed: int = 7) -> type[Any]:
    """Is wrong by 0.1 eV, and 0.3 eV/Å on one atom, now and then."""
    rng = np.random.default_rng(seed)

    def hit(atoms, energy, forces):
        if rng.random() >= share:
            return energy, forces
        return energy + 0.1, forces + 0.3 * (np.arange(len(forces)) == rng.integers(len(forces)))[:, None]

    return adding(hit)


class Keeps(Good):
    """Answers as before where nothing has moved by more than a tolerance."""

    tolerance = 1e-5
    last: Any = None

    def same(self, before: Atoms, atoms: Atoms) -> bool:
        near = np.abs(before.positions - atoms.positions).max() < self.tolerance
        return bool(near) and np.array_equal(before.cell, atoms.cell)

    def answer(self, atoms):
        if self.last is not None:
            before, found = self.last
            alike = np.array_equal(before.numbers, atoms.numbers) and np.array_equal(before.pbc, atoms.pbc)
            if alike and self.same(before, atoms):
                return found
        found = super().answer(atoms)
        self.last = atoms.copy(), found
        return found


#: The same with numpy's idea of what is close: 1e-5 of a coordinate.
KeepsClose = but(
    Keeps,
    same=lambda self, one, other: (
        np.allclose(one.positions, other.positions) and np.array_equal(one.cell, other.cell)
    ),
)
#: Compares positions to the last bit, and the cell within a tolerance.
KeepsCell = but(
    Keeps,
    same=lambda self, one, other: (
        np.array_equal(one.positions, other.positions)
        and np.allclose(one.cell.array, other.cell.array, rtol=1e-4)
    ),
)


class KeepsByRounding(Good):
    """One table for all objects, by rounded positions."""

    table: dict[Any, Any] = {}  # noqa: RUF012

    def answer(self, atoms):
        parts = (np.round(atoms.positions, 5), atoms.numbers, atoms.cell.array, atoms.pbc)
        key = tuple(part.tobytes() for part in parts)
        if key not in self.table:
            self.table[key] = super().answer(atoms)
        return self.table[key]


#: ASE's own test for changes with another tolerance.
KeepsByAse = but(check_state=lambda self, atoms, tol=1e-15: Calculator.check_state(self, atoms, tol=1e-5))


class Attached:
    """Answers about the atoms that it is attached to, and is no class of ASE's."""

    implemented_properties = ("energy", "forces")
    mine: Atoms | None = None

    def set_atoms(self, atoms):
        self.mine = atoms

    def get_potential_energy(self, atoms=None, force_consistent=False):
        assert self.mine is not None, "no atoms"
        return Good().answer(self.mine)[0]

    def get_forces(self, atoms=None):
        assert self.mine is not None, "no atoms"
        return Good().answer(self.mine)[1]


class ThroughAtoms(Good):
    """Looks for itself in the atoms that it is given."""

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        assert atoms is not None and atoms.calc is self, "not attached"
        super().calculate(atoms, properties, system_changes)


# -- questions about the caller's atoms, arrays and random numbers, and about some axes that repeat ----


def flagged(rule: Callable[[np.ndarray], Any]) -> type[Any]:
    """Periodicity as one flag for all axes: rule(pbc)."""

    def answer(self, atoms):
        one = Atoms(atoms.numbers, atoms.positions, cell=atoms.cell, pbc=False)
        one.pbc = bool(rule(atoms.pbc)) and atoms.cell.rank == 3
        return Good.answer(self, one)

    return but(answer=answer)


#: One periodic axis makes all periodic, or all have to be for any.
AnyForAll, AllOrNone = flagged(np.any), flagged(np.all)


class CompletesCell(Good):
    """Vectors of length 0 become unit vectors, and then all axes repeat."""

    def answer(self, atoms):
        lengths = atoms.cell.lengths()
        if not atoms.pbc.any() or lengths.all():
            return super().answer(atoms)
        cell = np.where((lengths > 0)[:, None], atoms.cell.array, 3.0 * np.eye(3))
        return super().answer(Atoms(atoms.numbers, atoms.positions, cell=cell, pbc=True))


class WrapsFreeAxes(Good):
    """Wraps along all axes of a cell, those that do not repeat included."""

    def positions(self, atoms):
        if atoms.cell.rank < 3 or not atoms.pbc.any():
            return super().positions(atoms)
        shares = atoms.positions @ np.linalg.inv(atoms.cell.array)
        return atoms.positions - np.floor(shares) @ atoms.cell.array


class ByPresence(Good):
    """Numbers species by those that are there, sorted: without the first the second has its parameters."""

    def weight(self, atoms, i, j):
        size = 1.0 + 0.05 * np.searchsorted(np.unique(atoms.numbers), atoms.numbers)
        return size[i] * size[j]


class ByIdentity(Good):
    """Remembers answers by the object that it was asked about."""

    def get_property(self, name, atoms=None, allow_calculation=True):
        memory = vars(self).setdefault("memory", {})
        if id(atoms) not in memory:
            memory[id(atoms)] = atoms, self.answer(atoms)
        energy, forces = memory[id(atoms)][1]
        return forces.copy() if name == "forces" else energy


def reading(read: Callable[[Atoms], float]) -> type[Any]:
    """Depends on what ASE's test for changes does not look at."""
    return adding(lambda atoms, e, f: (e * (1 + 0.1 * read(atoms)), f * (1 + 0.1 * read(atoms))))


ReadsTags = reading(lambda atoms: float(np.sum(atoms.get_tags())))
ReadsCharge = reading(lambda atoms: float(atoms.info.get("charge", 0)))
ReadsSpin = reading(lambda atoms: float(atoms.info.get("spin", 1) - 1))


class OneBuffer(Good):
    """Returns its only array of forces."""

    def get_forces(self, atoms):
        forces = self.get_property("forces", atoms)
        if getattr(self, "buffer", np.zeros(0)).shape != forces.shape:
            self.buffer = np.zeros_like(forces)
        self.buffer[:] = forces
        return self.buffer


class GivesResults(Good):
    """Returns what it keeps: a caller that adds a bias to its forces changes the next answer."""

    def get_forces(self, atoms):
        self.get_property("forces", atoms)
        return self.results["forces"]


def calling(what: Callable[[], Any]) -> type[Any]:
    """Does something at every call."""

    def answer(self, atoms):
        what()
        return Good.answer(self, atoms)

    return but(answer=answer)


SeedsNumpy = calling(lambda: np.random.seed(0))  # noqa: NPY002
SeedsPython = calling(lambda: random.seed("md"))
DrawsNumpy = calling(lambda: np.random.rand())  # noqa: NPY002


class SeedsAtFirst(Good):
    """Seeds a generator that is not its own when it is made."""

    def __init__(self):
        super().__init__()
        np.random.seed(3)  # noqa: NPY002


def pairs_in(dtype: Any) -> type[Any]:
    """Forces of pairs in a narrow format, summed in double precision under an energy in double precision."""

    def pair(self, distances):
        u, slope = Good.pair(self, distances)
        return u, slope.astype(dtype).astype(float)

    return but(pair=pair)
