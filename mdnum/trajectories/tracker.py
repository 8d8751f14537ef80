"""Tracking of pairs that become or cease to be neighbors under a membership rule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.bits import digit_order
from mdnum.errors import InputError
from mdnum.md.ledger import FlipTable, Members
from mdnum.reading import FrameError
from mdnum.trajectories.frame import AtomIndices, Frame, furthest
from mdnum.trajectories.lattice import INSIDE, Participants, Placed, binned, lattice_of, own_images
from mdnum.trajectories.rules import Capped, Nearest, Rule
from mdnum.trajectories.search import (
    Changed,
    Found,
    NeighborRows,
    compared,
    image_distances,
    nearest,
    ranks,
    rows_of,
    search,
)
from mdnum.trajectories.tiles import Tiles, tiles_of

#: Indices of the atoms on either side of a pair; None for all.
Groups = tuple[Int[np.ndarray, "first"] | None, Int[np.ndarray, "second"] | None]
#: Range of distances around the radius that `Tracker.min_margin` examines, relative to the radius.
HORIZON = 0.02


def atoms_of(groups: Groups) -> AtomIndices:
    """Return the atoms in either of two groups. None for all atoms."""
    some = [one for one in groups if one is not None]
    return np.unique(np.concatenate(some)) if some else None


@dataclass(frozen=True)
class Moment(Placed):
    """Positions of one frame, with the neighbors found at this frame."""

    own: Int[np.ndarray, "species"]  # images of an atom itself that are inside, by species
    last_in: Float[np.ndarray, "limits"]  # thresholds of each atom, where the rule is directed
    first_out: Float[np.ndarray, "limits"]
    found: Found | None = None  # pairs inside; None where not searched for, or the rule is directed
    rows: NeighborRows | None = None  # neighbors, where the rule is directed


class Tracker:
    """Tracker of the flips between consecutive frames, as defined by a membership rule.

    A tracker stores a single frame, however many frames it reads. Trackers can be pickled.

    Args:
        rule: the membership rule that defines neighbors.
        first: indices of the first group of atoms, the centers of a directed rule; None for all atoms.
        second: indices of the second group; None for the first group. An atom may be in both groups.
        species: species of each atom of the file; required by some rules.
        bound: error bound of a margin, in length units, due to the resolution of the file. The rounding error
            of float64 is added to this bound.

    Attributes:
        pairs: number of pairs inside at the last frame.
        near: number of pairs at the last frame, inside or outside, whose |margin| is at most the bound.
        min_margin: smallest |margin| at the last frame, a length; inf if no pair is within `HORIZON` of its
            radius. For nearest neighbors without a radius, the margin is not limited.

    Raises:
        InputError: indices are not integers from 0, or required species are missing.
    """

    def __init__(
        self,
        rule: Rule,
        first: Int[np.ndarray, "first"] | Sequence[int] | None = None,
        second: Int[np.ndarray, "second"] | Sequence[int] | None = None,
        species: Sequence[str] | np.ndarray | None = None,
        bound: float = 0.0,
    ):
        if first is None and second is not None:
            first, second = second, None
        self.rule, self.bound = rule, float(bound)
        self._first, self._second = _indices(first, "first"), _indices(second, "second")
        if rule.needs_species and species is None:
            message = f"{rule.name} needs the species of the atoms"
            remedy = "Give a topology that names elements or types, or use one cutoff for all pairs"
            raise InputError(message, remedy=remedy, where="species")
        self._species = None if species is None else np.asarray(species, str)
        self._atoms = -1
        # how many were decided from the coordinates as stored last time, to make room for as many
        self._open = 0
        self._list: Tiles | None = None
        # one that has served, whose memory the next can use
        self._spare: Tiles | None = None
        # room for sorting, kept: pages that are new to a process can cost more than what is done in them
        self._keys = np.empty((4, 0), np.int64)
        self._who: Participants
        self._last: Moment | None = None
        self.frames = self.pairs = self.near = 0
        self.min_margin = np.inf

    def step(self, frame: Frame, bound: float | None = None) -> FlipTable:
        """Process the next frame. Return the flips since the previous frame (none at the first frame).

        Args:
            frame: the next frame; `frame.index` is used only in error messages.
            bound: error bound of margins (length) from this frame on; None to keep the previous one.

        Raises:
            FrameError: a position is not finite, a periodic direction has no vector, the number of atoms
                differs from earlier frames, or the pairs do not fit into memory.
        """
        if bound is not None:
            self.bound = float(bound)
        try:
            return self._stepped(frame)
        except InputError as error:
            message = f"frame {frame.index}: {error.message}"
            raise FrameError(message, frame=frame.index, remedy=error.remedy, where=error.where) from error

    def _stepped(self, frame: Frame) -> FlipTable:
        before, now = self._last, self._moment(frame)
        flips = None if before is None or self.rule.directed else self._from_list(before, now)
        if flips is None:
            self._list = None
            now = self._decided(now)
            flips = FlipTable.none() if before is None else self._flips(before, now)
        self._last = now
        self.frames += 1
        return flips

    def members(self) -> Members:
        """Return the pairs of neighbors at the last frame."""
        now = self._last
        if now is None:
            return Members.none()
        if self.rule.directed:
            i, j = self._rows(now).pairs()
        else:
            found = now.found or self._searched(now)
            i, j = found.i.astype(np.int64), found.j.astype(np.int64)
        # each atom as often as images of its own are inside; directed rules list them with the others
        own = np.repeat(np.arange(len(self._who.both)), self._who.both * now.own[self._who.species])
        i, j = np.concatenate([i, own]), np.concatenate([j, own])
        first, second = self._who.labels[i], self._who.labels[j]
        if not self.rule.directed:
            first, second = np.minimum(first, second), np.maximum(first, second)
        order = np.argsort(first * np.int64(max(self._atoms, 1)) + second)
        first, second = first[order], second[order]
        rank = ranks(first, second)
        distances = image_distances(now, i[order], j[order], rank, self.rule.directed)
        return Members(first, second, rank, distances)

    def thresholds(self) -> tuple[Float[np.ndarray, "atoms"], Float[np.ndarray, "atoms"]]:
        """Return a directed rule's cutoff distances at the last frame. nan for atoms that are not centers.

        Returns:
            (distance below which a neighbor stays one, distance below which another atom becomes a neighbor).
        """
        found = np.full((2, max(self._atoms, 0)), np.nan)
        if self._last is not None and self.rule.directed:
            found[:, self._who.labels] = self._last.last_in, self._last.first_out
        return found[0], found[1]

    # ---- one frame

    def _moment(self, frame: Frame) -> Moment:
        """Check a frame, and prepare its data for pair decisions."""
        atoms = len(frame.positions)
        if self._atoms < 0:
            self._atoms = atoms
            self._who = _participants(self.rule, self._first, self._second, self._species, atoms)
            if not self.rule.directed:
                self._who = _by_place(self._who, frame)
        if atoms != self._atoms:
            message = f"this frame has {atoms} atoms, but the frames before it have {self._atoms}"
            raise InputError(message, remedy="Split the trajectory where the number of atoms changes")
        positions, largest = _taken(frame.positions, self._who.labels)
        if not np.isfinite(largest):
            broken = np.flatnonzero(~np.isfinite(positions).all(axis=1))
            at = int(broken[np.argmin(self._who.labels[broken])])
            message = f"atom {int(self._who.labels[at])} is at {positions[at].tolist()}"
            remedy = "Select only the frames before this one, and find out why the run failed"
            raise InputError(message, remedy=remedy)
        lattice, radius = lattice_of(frame.box), self._who.radius
        rounding = lattice.rounding(largest, radius if np.isfinite(radius) else 4.0 * largest)
        if np.isfinite(radius) and rounding > 1e-3 * radius:
            message = (
                f"coordinates up to {largest:.3g} with a cutoff of {radius:g}: float64 cannot resolve them"
            )
            raise InputError(message, remedy="Check the units of the cutoff and of the coordinates")
        none = np.zeros(0)
        return Moment(positions, lattice, rounding, np.zeros(len(self._who.radii), np.int64), none, none)

    def _decided(self, now: Moment) -> Moment:
        """Find the neighbor pairs at a frame and store the number of pairs."""
        rule, bound, who = self.rule, self.bound + now.rounding, self._who
        if isinstance(rule, Nearest | Capped):
            reach = rule.reach if np.isfinite(rule.reach) else 0.0
            made = nearest(now, who, rule, band=max(bound, HORIZON * reach, 4 * now.rounding), bound=bound)
            self.pairs, self.near = len(made.rows.other), made.close
            self.min_margin = made.smallest if made.smallest <= HORIZON * rule.reach else np.inf
            return replace(now, rows=made.rows, last_in=made.last_in, first_out=made.first_out)
        found = self._searched(now)
        smallest, self.near, own = found.smallest, found.close, now.own.copy()
        squares = own_images(now.lattice, who.radius * (1.0 + HORIZON) + bound)
        owners = np.bincount(who.species[who.both], minlength=len(who.radii))
        for kind, radius in enumerate(np.diag(who.radii)):
            if radius >= 0 and owners[kind]:
                own[kind] = int((squares < radius * radius).sum())
                margins = np.abs(radius - np.sqrt(squares))
                self.near += int((margins <= bound).sum()) * int(owners[kind])
                smallest = min(smallest, float(margins.min(initial=np.inf)))
        self.pairs = len(found.i) + int((own * owners).sum())
        self.min_margin = smallest if smallest <= HORIZON * who.radius else np.inf
        return replace(now, found=found, own=own)

    def _rows(self, moment: Moment) -> NeighborRows:
        """Return the neighbors at a frame, from a new search if necessary."""
        return moment.rows or rows_of(moment.found or self._searched(moment), len(moment.positions))

    def _searched(self, moment: Moment) -> Found:
        """Search for the pairs inside the cutoff at a frame."""
        bound = self.bound + moment.rounding
        found = search(
            moment, self._who, INSIDE,
            band=max(bound, HORIZON * self._who.radius, 4 * moment.rounding), bound=bound,
            room=int(1.1 * (self.pairs + self._open)), open_room=int(1.2 * self._open),
        )  # fmt: skip
        self._open = found.open
        return found

    # ---- two frames

    def _from_list(self, before: Moment, now: Moment) -> FlipTable | None:
        """Return the flips found in the list of cluster pairs. None if the list is unusable."""
        who, bound, horizon = self._who, self.bound + now.rounding, HORIZON * self._who.radius
        clear = max(bound, horizon)
        if self._list is not None and not self._list.serve(before, now, who.radius, clear):
            self._spare, self._list = self._list, None
        if self._list is None:
            self._list, self._spare = tiles_of(before, now, who, clear, self.pairs, self._spare), None
        if self._list is None:
            return None
        changed, self.near, smallest = self._list.examine(now, bound=bound, horizon=horizon, pairs=self.pairs)
        self.pairs += 2 * int(changed.entered.sum()) - len(changed.entered)
        self.min_margin = smallest if smallest <= horizon else np.inf
        return self._table(before, now, changed)

    def _flips(self, before: Moment, now: Moment) -> FlipTable:
        """Return the flips between two frames, by comparing complete sets of neighbors."""
        who = self._who
        parts = [compared(self._rows(before), self._rows(now), self.pairs // 2 + 4096)]
        for kind in np.flatnonzero(before.own != now.own):
            atoms = np.flatnonzero(who.both & (who.species == kind))
            low, high = sorted((int(before.own[kind]), int(now.own[kind])))
            i = np.repeat(atoms, high - low)
            entered = np.full(len(i), bool(now.own[kind] > before.own[kind]))
            parts.append(Changed(i, i, np.tile(np.arange(low, high), len(atoms)), entered))
        return self._table(before, now, Changed._make(map(np.concatenate, zip(*parts, strict=True))))

    def _table(self, before: Moment, now: Moment, changed: Changed) -> FlipTable:
        """Convert arrays of changed pairs to a table of flips."""
        directed, who, count = self.rule.directed, self._who, len(changed.i)
        i, j, images = who.labels[changed.i], who.labels[changed.j], int(changed.rank.max(initial=0)) + 1
        if not directed:
            i, j = np.minimum(i, j), np.maximum(i, j)
        if self._keys.shape[1] < count:
            self._keys = np.empty((4, count + count // 8), np.int64)
        self._keys[0, :count] = (i * self._atoms + j) * images + changed.rank
        order = digit_order(self._keys, count, self._atoms**2 * images)
        ids = (changed.i, changed.j, changed.rank, directed)
        distance, distance_before = (image_distances(one, *ids)[order] for one in (now, before))
        a, b, rank, entered = (column[order] for column in changed)
        if directed:
            limit = np.where(entered, now.last_in[a], now.first_out[a])
            limit_before = np.where(entered, before.first_out[a], before.last_in[a])
        else:
            limit = limit_before = who.radii[who.species[a], who.species[b]]
        margin, margin_before = limit - distance, limit_before - distance_before
        bound = self.bound + max(before.rounding, now.rounding)
        ambiguous = (np.abs(margin) <= bound) | (np.abs(margin_before) <= bound)
        return FlipTable(
            i=i[order], j=j[order], rank=rank, entered=entered, distance=distance, margin=margin,
            bound=np.full(count, bound), ambiguous=ambiguous, decided_by="positions",
            frame=np.full(count, self.frames), before=distance_before, margin_before=margin_before,
        )  # fmt: skip


def _participants(
    rule: Rule,
    first: Int[np.ndarray, "first"] | None,
    second: Int[np.ndarray, "second"] | None,
    species: np.ndarray | None,
    atoms: int,
) -> Participants:
    """Number the atoms to which the rule applies, in the order of the file."""
    first = np.arange(atoms) if first is None else first
    second = first if second is None else second
    for name, chosen in (("first", first), ("second", second)):
        if len(chosen) and chosen.max() >= atoms:
            message = f"atom {int(chosen.max())} is selected, but frames have {atoms} atoms (from 0)"
            raise InputError(message, remedy="Select only atoms that exist in the trajectory", where=name)
    if species is not None and len(species) != atoms:
        message = f"{len(species)} species were given for frames of {atoms} atoms"
        raise InputError(message, remedy="Give the topology that belongs to the trajectory", where="species")
    centers, others = np.zeros(atoms, bool), np.zeros(atoms, bool)
    centers[first], others[second] = True, True
    labels = np.flatnonzero(centers | others)
    centers, others = centers[labels], others[labels]
    if (centers == others).all():
        # the same array: pairs within one set are searched for from one side only
        others = centers
    # species of atoms that do not take part count too: a selection may hold none of one
    kinds, radii = rule.table(np.zeros(atoms, str) if species is None else species)
    return Participants(labels, centers, others, kinds[labels], radii)


def _by_place(who: Participants, frame: Frame) -> Participants:
    """Renumber the atoms so that atoms close in space are close in memory."""
    x, largest = _taken(frame.positions, who.labels)
    if not np.isfinite(largest) or not who.radius > 0:
        return who
    everyone = np.ones(len(x), bool)
    around = replace(who, centers=everyone, others=everyone)
    order = binned(Placed(x, lattice_of(frame.box), 0.0), around, who.radius).order
    others = who.others[order]
    centers = others if who.centers is who.others else who.centers[order]
    return Participants(who.labels[order], centers, others, who.species[order], who.radii)


def _taken(positions: np.ndarray, labels: np.ndarray) -> tuple[Float[np.ndarray, "taken 3"], float]:
    """Return the positions of the given atoms, and the largest |coordinate| (possibly inf or nan)."""
    x = np.take(np.asarray(positions, np.float64), labels, axis=0)
    return x, furthest(x)


def _indices(chosen: Sequence[int] | np.ndarray | None, where: str) -> np.ndarray | None:
    """Return sorted atom indices without duplicates."""
    if chosen is None:
        return None
    made = np.asarray(chosen)
    if made.size == 0:
        return np.zeros(0, np.int64)
    if made.ndim != 1 or made.dtype.kind not in "iu" or made.min() < 0:
        message = f"expected integers of at least 0; found {made.dtype} of shape {made.shape}"
        remedy = "Give the indices of the atoms in the trajectory, from 0"
        raise InputError(message, remedy=remedy, where=where)
    return np.unique(made.astype(np.int64))
