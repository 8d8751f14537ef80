"""Two residues are in contact if a pair of their atoms is within the cutoff.

Decisions are made for pairs of atoms. The stored distance of two residues is the smallest distance between
their atoms. Hydrogens and virtual sites are excluded by default, as their positions depend on constraints.
Customary contact cutoffs are defined for heavy atoms.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.md.ledger import Columns, FlipTable, Members
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.history import Contacts
from mdnum.trajectories.lattice import Placed, lattice_of
from mdnum.trajectories.rules import Rule
from mdnum.trajectories.search import image_distances
from mdnum.trajectories.topology import AtomTable
from mdnum.trajectories.tracker import Groups, Tracker

# sites that no atom is at, by the names of GROMACS, AMBER and CHARMM; the last two of water alone
_VIRTUAL = re.compile(r"MW\d*|EPW?\d*|LP[A-Z]?\d*|MCH3|MNH3|DUM\w*")
_OF_WATER, _WATER = frozenset({"M", "OM"}), re.compile(r"HOH|WAT|SOL|H2O|TIP\w*|TP\w*|OPC\w*")
#: Largest number of points in time of a map of contacts.
MOMENTS = 200
# pairs of residues whose atoms are examined together
_TOGETHER = 20_000


@dataclass(frozen=True)
class ByResidue:
    """Residues of a file, for an analysis by residue pairs."""

    of: Int[np.ndarray, "atoms"]  # residue of each atom of the file
    table: AtomTable  # of the residues, an entry each
    groups: Groups  # atoms on either side, without those that are left out
    left_out: dict[str, int]  # atoms by why

    @classmethod
    def make(cls, table: AtomTable, groups: Groups, hydrogens: bool, rules: Sequence[Rule]) -> ByResidue:
        """Build the residues of a file. If `hydrogens` is True, hydrogens and virtual sites are included.

        Raises:
            InputError: the file has no residues, no atom is left, or a rule is not defined for pairs of
                residues.
        """
        if len(table) and not any(table.residue_names):
            remedy = "Give a topology that has residues with -s TOPOLOGY"
            raise InputError("the file has no residues between which contacts can be found", remedy=remedy)
        if directed := [one.name for one in rules if one.directed]:
            remedy = "Use --cutoff, or --pairs for cutoffs by species"
            raise InputError(f"the rule {directed[0]} applies to atoms, not to residues", remedy=remedy)
        light, virtual = left_out(table)
        kept = np.ones(len(table), bool) if hydrogens else ~(light | virtual)
        every = np.arange(len(table)) if groups[0] is None else groups[0]
        sides = [None if side is None else side[kept[side]] for side in (every, groups[1])]
        if any(side is not None and not len(side) for side in sides):
            remedy = "Add --hydrogens, or select other atoms"
            raise InputError("all selected atoms are hydrogens or virtual sites", remedy=remedy)
        chosen = np.union1d(every, every if groups[1] is None else groups[1])
        counts = {"hydrogens": light[chosen], "virtual sites": virtual[chosen]}
        told = {} if hydrogens else {name: int(some.sum()) for name, some in counts.items() if some.any()}
        at = np.unique(table.residues, return_index=True)[1]
        names, blank = table.residue_names[at], np.full(len(at), "", object)
        ids, segments = table.residue_ids[at], table.segments[at]
        residues = AtomTable(blank, names, names, ids, np.arange(len(at)), segments)
        return cls(table.residues, residues, (sides[0], sides[1]), told)

    @property
    def names(self) -> ResidueNames:
        """Names, numbers and segments of the residues."""
        table = self.table
        return ResidueNames(table.residues, table.residue_names, table.residue_ids, table.segments)

    @property
    def sides(self) -> Groups:
        """Residue indices of the two groups between which contacts are counted."""
        first, second = (None if side is None else np.unique(self.of[side]) for side in self.groups)
        return first, second

    def tracker(self, rule: Rule, species: Sequence[str] | None, bound: float = 0.0) -> ResidueTracker:
        """Return a tracker of residue contacts, given a membership rule for atoms."""
        return ResidueTracker(rule, self, species, bound)


def left_out(table: AtomTable) -> tuple[Bool[np.ndarray, "atoms"], Bool[np.ndarray, "atoms"]]:
    """Return masks of hydrogens (by element) and of virtual sites (by name)."""
    water = {str(name) for name in np.unique(table.residue_names.astype(str)) if _WATER.fullmatch(str(name))}
    virtual = [
        _VIRTUAL.fullmatch(str(name)) is not None or (name in _OF_WATER and residue in water)
        for name, residue in zip(table.names, table.residue_names, strict=True)
    ]
    dummy = np.isin(table.species.astype(str), ["DUMMY", "EP"])
    return np.isin(table.species.astype(str), ["H", "D"]), np.array(virtual, bool) | dummy


class ResidueTracker:
    """Tracker of contacts between residues, used like `Tracker`.

    Pairs of atoms within one residue are ignored. `near` counts atom pairs whose distance equals the cutoff
    within rounding. The attribute `min_margin` is always inf.

    Args:
        rule: membership rule for atoms.
        residues: residues, and the atoms that can form contacts.
        species: species of each atom of the file; required by some rules.
        bound: error of a distance, in length units, due to the resolution of the file.

    Error: smallest distances have the rounding error of distances between atoms.
    """

    min_margin = np.inf

    def __init__(self, rule: Rule, residues: ByResidue, species: Sequence[str] | None, bound: float = 0.0):
        self.rule, self._residues = rule, residues
        self._atoms = Tracker(rule, *residues.groups, species, bound)
        self._count = len(residues.table)
        # pairs of residues as numbers, ascending, and how many pairs of atoms are inside in each
        self._pairs, self._inside = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._last: Frame | None = None
        first, second = residues.groups
        sides = (first, first if second is None else second)
        self._sides = [_by_residue(one, residues.of, self._count) for one in sides]
        kinds = np.zeros(len(residues.of), str) if species is None else np.asarray(species, str)
        self._species, self._radii = rule.table(kinds)

    @property
    def pairs(self) -> int:
        """Number of pairs of residues in contact at the last frame."""
        return len(self._pairs)

    @property
    def near(self) -> int:
        """Number of atom pairs whose distance equals the cutoff within rounding, at the last frame."""
        return self._atoms.near

    @property
    def bound(self) -> float:
        """Error bound of a distance at the last frame, in length units."""
        return self._atoms.bound

    def step(self, frame: Frame, bound: float | None = None) -> FlipTable:
        """Return the contacts that formed or broke since the previous frame; see `Tracker.step`."""
        flips, before = self._atoms.step(frame, bound), self._last
        i, j, sign = flips.i, flips.j, np.where(flips.entered, 1, -1)
        if before is None:
            members = self._atoms.members()
            i, j, sign = members.i, members.j, np.ones(len(members), np.int64)
        first, second = np.sort(self._residues.of[np.array([i, j])], axis=0)
        other = first != second
        codes = np.concatenate([self._pairs, (first * self._count + second)[other]])
        codes, where = np.unique(codes, return_inverse=True)
        old = np.bincount(where[: len(self._pairs)], self._inside, len(codes)).astype(np.int64)
        now = old + np.bincount(where[len(self._pairs) :], sign[other], len(codes)).astype(np.int64)
        self._pairs, self._inside, self._last = codes[now > 0], now[now > 0], frame
        changed = codes[(old > 0) != (now > 0)]
        if before is None or not len(changed):
            return FlipTable.none()
        i, j = np.divmod(changed, self._count)
        near, was = self._closest(frame, i, j), self._closest(before, i, j)
        margin, margin_before = near[1] - near[0], was[1] - was[0]
        off = self._atoms.bound + max(self._placed(one).rounding for one in (before, frame))
        return FlipTable(
            i=i, j=j, rank=np.zeros_like(i), entered=(now > 0)[(old > 0) != (now > 0)], distance=near[0],
            margin=margin, bound=np.full(len(i), off), decided_by="positions",
            ambiguous=(np.abs(margin) <= off) | (np.abs(margin_before) <= off),
            frame=np.full(len(i), self._atoms.frames - 1), before=was[0], margin_before=margin_before,
        )  # fmt: skip

    def members(self) -> Members:
        """Return residue pairs in contact at the last frame, and their smallest distances."""
        if self._last is None:
            return Members.none()
        i, j = np.divmod(self._pairs, self._count)
        return Members(i, j, np.zeros_like(i), self._closest(self._last, i, j)[0])

    def _closest(self, frame: Frame, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, for each residue pair, distance and threshold of its atom pair with largest margin."""
        placed, found = self._placed(frame), np.full((2, len(i)), np.inf)
        for begin in range(0, len(i), _TOGETHER):
            part = slice(begin, begin + _TOGETHER)
            # an atom may be on both sides
            ends = [(i[part], j[part])] + [(j[part], i[part])] * (self._residues.groups[1] is not None)
            rows = [(np.arange(len(a)), a, b) for a, b in ends]
            row, a, b = np.concatenate(rows, axis=1)
            (first, starts), (second, others) = self._sides
            long, wide = np.diff(starts)[a], np.diff(others)[b]
            which = np.repeat(np.arange(len(row)), long * wide)
            place = np.arange(len(which)) - np.repeat(np.cumsum(long * wide) - long * wide, long * wide)
            p = first[starts[a[which]] + place // wide[which]]
            q = second[others[b[which]] + place % wide[which]]
            p, q, row = np.minimum(p, q), np.maximum(p, q), row[which]
            distance = image_distances(placed, p, q, np.zeros_like(p))
            radius = self._radii[self._species[p], self._species[q]]
            # with one cutoff for all, the last of each row is the nearest
            order = np.lexsort((np.where(radius > 0, radius - distance, -np.inf), row))
            last = order[np.append(np.diff(row[order]) != 0, True)] if len(row) else order
            found[:, begin + row[last]] = distance[last], radius[last]
        return found[0], found[1]

    def _placed(self, frame: Frame) -> Placed:
        lattice = lattice_of(frame.box)
        x = np.ascontiguousarray(frame.positions, np.float64)
        return Placed(x, lattice, lattice.rounding(frame.furthest, self.rule.reach))


def _by_residue(atoms: np.ndarray | None, of: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the atoms sorted by residue, and where each residue starts."""
    atoms = np.arange(len(of)) if atoms is None else atoms
    order = atoms[np.argsort(of[atoms], kind="stable")]
    return order, np.searchsorted(of[order], np.arange(count + 1))


@dataclass(frozen=True)
class Occupancy(Columns):
    """Sparse matrix: the fraction of frames in which residues i and j are in contact."""

    i: Int[np.ndarray, "pairs"]  # the pair
    j: Int[np.ndarray, "pairs"]
    inside: Int[np.ndarray, "pairs"]  # frames in contact
    share: Float[np.ndarray, "pairs"]  # of all frames
    formed: Int[np.ndarray, "pairs"]  # times that a contact was seen to begin, and to end
    broken: Int[np.ndarray, "pairs"]

    @classmethod
    def of(cls, stays: Contacts, frames: int) -> Occupancy:
        """Add up the contacts of each residue pair over the frames."""
        new = np.append(True, (np.diff(stays.i) != 0) | (np.diff(stays.j) != 0))[: len(stays)]
        heads, where = np.flatnonzero(new), np.cumsum(new) - 1
        weights = (stays.length, stays.began, stays.ended)
        inside, *ends = (np.bincount(where, one, len(heads)).astype(np.int64) for one in weights)
        return cls(stays.i[heads], stays.j[heads], inside, inside / max(frames, 1), *ends)


@dataclass(frozen=True)
class ResidueNames(Columns):
    """Names, numbers and segments of residues, one entry per residue."""

    residue: Int[np.ndarray, "residues"]  # its number from 0, by which tables name it
    name: np.ndarray
    number: Int[np.ndarray, "residues"]  # as the file has it
    segment: np.ndarray


def contacts_over_time(
    stays: Contacts, residues: int, frames: int
) -> tuple[Int[np.ndarray, "moments"], Float[np.ndarray, "residues moments"]]:
    """Return the first frame of each interval, and each residue's mean number of contacts."""
    edges = np.unique(np.linspace(0, frames, min(frames, MOMENTS) + 1).astype(np.int64))
    found = np.zeros((residues, len(edges) - 1))
    for k, (low, high) in enumerate(pairwise(edges)):
        share = np.clip(np.minimum(stays.end, high) - np.maximum(stays.begin, low), 0, None) / (high - low)
        for end in (stays.i, stays.j):
            found[:, k] += np.bincount(end, share, residues)
    return edges[:-1], found
