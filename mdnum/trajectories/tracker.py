"""Which neighbors an atom gained and lost, frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.candidates import INSIDE
from mdnum.trajectories.changes import compared, image_distances
from mdnum.trajectories.columns import Changed, Ledger, Thresholds
from mdnum.trajectories.exchanged import exchanged
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.lattice import Lattice, lattice_of, own_images
from mdnum.trajectories.looking import look
from mdnum.trajectories.nearest import chosen
from mdnum.trajectories.pairs import Found, Rows, pairs_of, ranks, rows_of, search
from mdnum.trajectories.participants import Participants, by_place, indices, participants, taken
from mdnum.trajectories.rules import Capped, Nearest, Rule
from mdnum.trajectories.superset import Superset, displaced, listed, skin_for
from mdnum.trajectories.table import Flips, Members

#: `Tracker.min_margin` looks this share of the radius away from it
HORIZON = 0.02


@dataclass(frozen=True)
class Moment:
    """One frame as it was decided.

    Attributes:
        positions: of the atoms that take part, length.
        lattice: of its box.
        rounding: how far a distance can be off through float64, length.
        found: pairs inside; None where they have not been searched for, or the rule is directed.
        rows: neighbors, where the rule is directed.
        own: images of an atom itself that are inside, by species.
        last_in, first_out: thresholds of each atom, where the rule is directed.
    """

    positions: Float[np.ndarray, "atoms 3"]
    lattice: Lattice
    rounding: float
    found: Found | None
    rows: Rows | None
    own: Int[np.ndarray, "species"]
    last_in: Float[np.ndarray, "limits"]
    first_out: Float[np.ndarray, "limits"]


class Tracker:
    """Flips of a membership rule between consecutive frames.

    Remembers one frame, so memory does not grow with the number of frames; can be pickled.

    Args:
        rule: who is a neighbor.
        first: atoms of the file on one side; None for all. A directed rule looks for neighbors of these.
        second: atoms on the other side; None for the same atoms as first. An atom may be on both.
        species: of each atom of the file; needed by rules that ask for it.
        bound: how far a margin can be off through the resolution of the file, length. What float64 rounds
            is added to it.

    Attributes:
        pairs: inside at the last frame.
        near: pairs at the last frame with a |margin| of at most the bound, inside or not.
        min_margin: smallest |margin| at the last frame, length; inf where no pair is within `HORIZON` of its
            radius. The nearest few of an atom without a radius have no such limit.

    Raises:
        InputError: indices that are not whole numbers from 0 or come twice; no species where they are needed.
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
        self.rule = rule
        self.bound = float(bound)
        self._first, self._second = indices(first, "first"), indices(second, "second")
        if rule.needs_species and species is None:
            raise InputError(
                f"{rule.name} needs to know which species the atoms are of",
                remedy="Give a topology that names elements or types, or use one cutoff for all",
                where="species",
            )
        self._species = None if species is None else np.asarray(species, str)
        self._atoms = -1
        # how many there were last time, to make room for as many
        self._open = 0
        self._list: Superset | None = None
        # one that has served, whose memory the next can use
        self._spare: Superset | None = None
        self._who: Participants
        self._box: Box | None = None
        self._last: Moment | None = None
        self.frames = 0
        self.pairs = 0
        self.near = 0
        self.min_margin = np.inf

    def step(self, frame: Frame, bound: float | None = None) -> Flips:
        """What changed since the frame before; nothing at the first.

        Args:
            frame: the next one; its own index is not looked at.
            bound: of this frame and from here on, length; None for the one before.
        Raises:
            InputError: a position that is not finite; a direction that repeats without a vector; another
                number of atoms than before.
        """
        if bound is not None:
            self.bound = float(bound)
        before, now = self._last, self._moment(frame)
        flips = None if before is None or self.rule.directed else self._from_list(before, now)
        if flips is None:
            self._list = None
            now = self._decided(now)
            flips = Flips.none() if before is None else self._flips(before, now)
        self._last = now
        self.frames += 1
        return flips

    def members(self) -> Members:
        """The pairs inside at the last frame."""
        none = np.zeros(0, np.int64)
        if self._last is None:
            return Members(none, none, none, np.zeros(0))
        now = self._last
        i, j = self._inside(now)
        own = self._own_members(now)
        i, j = np.concatenate([i, own]), np.concatenate([j, own])
        first, second = self._who.labels[i], self._who.labels[j]
        if not self.rule.directed:
            first, second = np.minimum(first, second), np.maximum(first, second)
        order = np.argsort(first * np.int64(max(self._atoms, 1)) + second)
        first, second = first[order], second[order]
        rank = ranks(first, second)
        return Members(first, second, rank, self._distances(now, i[order], j[order], rank))

    def thresholds(self) -> tuple[Float[np.ndarray, "atoms"], Float[np.ndarray, "atoms"]]:
        """Of a directed rule, by atom of the file at the last frame, length; nan for atoms that do not look.

        Returns:
            (distance under which a neighbor stays one, distance under which another would become one).
        """
        found = np.full((2, max(self._atoms, 0)), np.nan)
        if self._last is not None and self.rule.directed:
            found[:, self._who.labels] = self._last.last_in, self._last.first_out
        return found[0], found[1]

    # ---- one frame

    def _moment(self, frame: Frame) -> Moment:
        """A frame that can be decided on."""
        positions, largest = self._checked(frame)
        lattice = self._lattice_of(frame)
        radius = self._who.radius
        rounding = lattice.rounding(largest, radius if np.isfinite(radius) else 4.0 * largest)
        if np.isfinite(radius) and rounding > 1e-3 * radius:
            raise InputError(
                f"coordinates up to {largest:.3g} with a cutoff of {radius:g}: float64 cannot tell distances",
                remedy="Check the unit, and that the file's coordinates are not broken",
                where=f"frame {frame.index}",
            )
        none = np.zeros(0)
        return Moment(
            positions, lattice, rounding, None, None, np.zeros(len(self._who.radii), np.int64), none, none
        )

    def _lattice_of(self, frame: Frame) -> Lattice:
        box, last = frame.box, self._box
        if last is None or not (
            np.array_equal(box.matrix, last.matrix) and np.array_equal(box.pbc, last.pbc)
        ):
            # a copy: readers reuse their arrays
            self._box = Box(np.array(box.matrix, np.float64), np.array(box.pbc, bool))
            self._lattice = lattice_of(self._box)
        return self._lattice

    def _decided(self, now: Moment) -> Moment:
        """The same with its neighbors searched for, and their numbers noted."""
        positions, lattice, rounding = now.positions, now.lattice, now.rounding
        rule, bound = self.rule, self.bound + now.rounding
        if isinstance(rule, Nearest | Capped):
            made = chosen(
                positions, lattice, self._who.sides, rule,
                band=max(bound, HORIZON * rule.reach if np.isfinite(rule.reach) else 0.0, 4 * rounding),
                bound=bound, guard=rounding,
            )  # fmt: skip
            self.pairs, self.near = len(made.rows.other), made.rows.close
            horizon = HORIZON * rule.reach
            self.min_margin = made.rows.smallest if made.rows.smallest <= horizon else np.inf
            return replace(now, rows=made.rows, last_in=made.last_in, first_out=made.first_out)
        found = self._searched(now)
        own, close, smallest = self._own(lattice, bound)
        smallest = min(found.smallest, smallest)
        self.pairs = len(found.i) + int((own * self._who.own).sum())
        self.near = found.close + close
        self.min_margin = smallest if smallest <= HORIZON * self._who.radius else np.inf
        return replace(now, found=found, own=own)

    def _rows(self, moment: Moment) -> Rows:
        """The neighbors at a moment; searched for where they are not known."""
        if moment.rows is not None:
            return moment.rows
        return rows_of(moment.found or self._searched(moment), len(moment.positions))

    def _inside(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """(i, j) of the pairs inside at a moment, in no order."""
        if self.rule.directed:
            return pairs_of(self._rows(moment))
        found = moment.found or self._searched(moment)
        return found.i.astype(np.int64), found.j.astype(np.int64)

    def _searched(self, moment: Moment) -> Found:
        """The pairs inside at a moment, found afresh."""
        bound, guard = self.bound + moment.rounding, moment.rounding
        found = search(
            moment.positions, moment.lattice, self._who.sides, self._who.radii, INSIDE,
            band=max(bound, HORIZON * self._who.radius, 4 * guard), bound=bound, guard=guard,
            room=int(1.1 * (self.pairs + self._open)), open_room=int(1.2 * self._open),
        )  # fmt: skip
        self._open = found.open
        return found

    def _own(self, lattice: Lattice, bound: float) -> tuple[np.ndarray, int, float]:
        """Images of an atom itself that are inside, by species; how many are close; the smallest |margin|."""
        inside = np.zeros(len(self._who.radii), np.int64)
        close, smallest = 0, np.inf
        reach = float(self._who.radii.max(initial=0.0)) * (1.0 + HORIZON) + bound
        squares = own_images(lattice, reach)
        for kind, radius in enumerate(np.diag(self._who.radii)):
            if radius < 0 or not self._who.own[kind]:
                continue
            inside[kind] = int((squares < radius * radius).sum())
            margins = np.abs(radius - np.sqrt(squares))
            close += int((margins <= bound).sum()) * int(self._who.own[kind])
            smallest = min(smallest, float(margins.min(initial=np.inf)))
        return inside, close, smallest

    def _own_members(self, moment: Moment) -> np.ndarray:
        """Each atom as often as images of its own are inside (directed rules list them with the others)."""
        times = np.where(self._who.both, moment.own[self._who.sides.species], 0)
        return np.repeat(np.arange(len(times)), times)

    # ---- two frames

    def _from_list(self, before: Moment, now: Moment) -> Flips | None:
        """The flips as a list tells them; None where none would be worth its making."""
        radius, horizon = self._who.radius, HORIZON * self._who.radius
        bound = self.bound + now.rounding
        clear = max(bound, horizon)
        held = self._list
        # what rounding adds to every distance
        slack = 8.0 * max(before.rounding, now.rounding)
        if held is not None:
            came = displaced(before.positions, before.lattice, now.positions, now.lattice, held.home,
                             radius + 2.0 * held.skin)  # fmt: skip
            held.last, held.gone = came, held.gone + came + slack
            if not held.serves(held.gone, now.lattice, radius, clear):
                self._spare, held = held, None
        if held is None:
            held = self._listed(before, now, clear, slack)
        self._list = held
        if held is None:
            return None
        seen = look(held, now.positions, now.lattice, self._who.sides, self._who.radii,
                    bound=bound, horizon=horizon, guard=slack)  # fmt: skip
        self.pairs += 2 * int(seen.entered.sum()) - len(seen.entered)
        self.near, self.min_margin = seen.close, seen.smallest if seen.smallest <= horizon else np.inf
        return self._table(before, now, seen.i, seen.j, np.zeros(len(seen.i), np.int64), seen.entered)

    def _listed(self, before: Moment, now: Moment, clear: float, slack: float) -> Superset | None:
        """A list made at the frame before that serves now and will for a while; None where there is none."""
        radius = self._who.radius
        home = np.zeros((len(now.positions), 3), np.int64)
        pace = displaced(before.positions, before.lattice, now.positions, now.lattice, home, 1.5 * radius)
        skin = skin_for(pace, radius, clear, before.lattice, self.pairs)
        if not skin > 0:
            return None
        made = listed(
            before.positions, before.lattice, self._who.sides, self._who.radii, skin,
            guard=before.rounding, pairs=self.pairs, spare=self._spare,
        )  # fmt: skip
        self._spare = None
        came = displaced(before.positions, before.lattice, now.positions, now.lattice, made.home,
                         radius + 2.0 * skin)  # fmt: skip
        made.last, made.gone = came, came + slack
        return made if made.serves(made.gone, now.lattice, radius, clear) else None

    def _flips(self, before: Moment, now: Moment) -> Flips:
        if not self.rule.directed and self._one_image(before, now):
            i, j, entered = exchanged(
                before.found or self._searched(before), now.found or self._searched(now),
                (before.positions, before.lattice), (now.positions, now.lattice),
                self._who.sides.species, self._who.radii,
            )  # fmt: skip
            return self._table(before, now, i, j, np.zeros(len(i), np.int64), entered)
        i, j, rank, entered = compared(self._rows(before), self._rows(now), self.pairs // 2 + 4096)
        if (before.own != now.own).any():
            parts = [(i, j, rank, entered)]
            for kind in np.flatnonzero(before.own != now.own):
                atoms = np.flatnonzero(self._who.both & (self._who.sides.species == kind))
                low, high = sorted((int(before.own[kind]), int(now.own[kind])))
                a = np.repeat(atoms, high - low)
                yes = np.full(len(a), bool(now.own[kind] > before.own[kind]))
                parts.append((a, a, np.tile(np.arange(low, high), len(atoms)), yes))
            i, j, rank, entered = (np.concatenate([part[k] for part in parts]) for k in range(4))
        return self._table(before, now, i, j, rank, entered)

    def _one_image(self, *moments: Moment) -> bool:
        """Whether no pair has two images inside, nor one that rounding could miss."""
        reach = self._who.radius + 8.0 * max(one.rounding for one in moments)
        return all(one.lattice.narrowest >= 2.000002 * reach for one in moments)

    def _table(self, before: Moment, now: Moment, i, j, rank, entered) -> Flips:
        """The flips as columns, from indices among the atoms that take part."""
        changed = Changed(
            i, j, rank, entered, self._distances(now, i, j, rank), self._distances(before, i, j, rank)
        )
        thresholds = Thresholds(
            self.rule.directed, self._who.sides.species, self._who.radii,
            now.last_in, now.first_out, before.last_in, before.first_out,
        )  # fmt: skip
        bound = self.bound + max(before.rounding, now.rounding)
        return self._ledger.flips(self.frames, changed, thresholds, bound)

    def _distances(self, moment: Moment, i, j, rank) -> np.ndarray:
        if self.rule.directed:
            # both of a ± pair are neighbors of an atom
            rank = np.where(i == j, rank // 2, rank)
        return image_distances(moment.positions, moment.lattice, i, j, rank)

    # ---- input

    def _checked(self, frame: Frame) -> tuple[np.ndarray, float]:
        """Positions of the atoms that take part, and the largest coordinate."""
        atoms = len(frame.positions)
        if self._atoms < 0:
            self._atoms = atoms
            self._who = participants(self.rule, self._first, self._second, self._species, atoms)
            if not self.rule.directed:
                self._who = by_place(self._who, frame.positions, frame.box)
            self._ledger = Ledger(self._who.labels, atoms)
        if atoms != self._atoms:
            raise InputError(
                f"{atoms} atoms, {self._atoms} in the frames before",
                remedy="Split the trajectory where the number of atoms changes",
                where=f"frame {frame.index}",
            )
        positions = np.empty((len(self._who.labels), 3))
        largest = taken(np.require(frame.positions, np.float64, ["C", "W"]), self._who.labels, positions)
        if not np.isfinite(largest):
            broken = np.flatnonzero(~np.isfinite(positions).all(axis=1))
            at = int(broken[np.argmin(self._who.labels[broken])])
            raise InputError(
                f"atom {int(self._who.labels[at])} is at {positions[at].tolist()}",
                remedy="Stop before this frame (a slice of the file), and find out why the run broke",
                where=f"frame {frame.index}",
            )
        return positions, largest
