"""A neighbor list that is right, and what people have got wrong in theirs: one word for each mechanism.

`search` is a cell list of its own kind, which shares no code with the oracle; `Kept` keeps one with a skin.
Both do as told by `defect`; with none they are right. Beside each word is the thread that reported it.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

#: What a list made anew gets wrong, and where that was reported.
SEARCH_DEFECTS = {
    "drops atoms outside": "jax-md 168, 171, 302",
    "shifts of wrapped positions": "torch-sim 423, nvalchemi-ops 18",
    "no images": "torch-sim 423",
    "wraps free axes": "torch-sim 575, nvalchemi-ops 104",
    "skips by bounding box": "openmm 714",
    "ghosts by coordinate": "lammps 2759, 3846",
    "half stencil": "lammps 2930, deepmd 1109",
    "half trimmed from full": "lammps 4487",
    "too many bins": "GPUMD 190",
    "wraps to the far face": "Atomistica 30",
    "two bins counted twice": "MDAnalysis 2345",
    "one side in float32": "MDAnalysis 2229, 3181",
    "images undercounted": "kUPS 127",
    "next cell only": "fairchem 268",
    "minimum image": "apax 121, jax-md (r_cut > L/2)",
    "no wrapping": "torch_nl 1, NeighbourLists.jl 6",
    "bins by edges": "jax-md 223",
    "last bin lost": "jax-md 291, 322",
    "stencil aliases": "PQ 274",
    "zero distance twice": "CellListMap 84",
    "tail not cut": "CellListMap 86",
    "silent overflow": "jax-md 165, 75",
    "32 neighbors": "torchmd-net 21, pyg 2933",
    "capacity of all for each": "NNPOps 80",
    "nearest only": "fairchem 428",
    "fixed slots": "deepmd 108",
    "rows beyond 4096": "deepmd 5616",
    "tile overflow": "nvalchemi-ops 160",
    # not reported anywhere that we know of
    "coincident atoms dropped": "",
    "keeps itself": "",
    "padding handed out": "",
    "real indices": "",
    "unequal lengths": "",
    "squared distances": "",
    "distances of neighbors": "",
    "vectors turned": "",
    "wraps in place": "",
    "grid in float32": "",
    "32-bit keys": "",
    "divides by a spread": "",
    "remembers by count": "",
    "box of the first call": "",
    "count of the last": "",
}

#: What a list that is kept gets wrong.
KEPT_DEFECTS = {
    "whole skin": "schnetpack 397",
    "stale tail": "nvalchemi-toolkit 54",
    "negative skin squared": "lammps 1701",
    "box not looked at": "timemachine 316, glp 3",
    "reference overwritten": "timemachine 497",
    "images counted once": "jax-md 399",
    "frozen ghosts": "librascal 143",
    "skin for another frequency": "LADDS 59",
    "every 20 steps": "openmm 4230",
    "delay of 10": "lammps 3485",
    "known by its size": "lammps 4239",
    "one step late": "hoomd-blue 563",
    "average motion": "AutoPas 917",
    "never again": "MCGPU 25",
    "overflow of the first": "jax-md 141, 161; so3lr 25",
    # not reported anywhere that we know of
    "nearest image of motion": "",
    "rebuilt from old positions": "",
    "counts of the first": "",
    "volume looked at": "",
    "motion in the box alone": "jax-md (fractional coordinates)",
    "strain by volume": "",
    "strain since the first box": "",
    "the caller's array": "",
    "skin of the first": "",
    "tail of a growing count lost": "",
}

_remembered: dict = {}


def search(positions, cell, pbc, r_cut, defect=""):
    """(i, j, shift, distance, vector) by name: every pair from both atoms."""
    given, pbc = positions, np.asarray(pbc)
    n = len(positions)
    if defect == "divides by a spread" and n:
        positions = positions + 0.0 / int(np.ptp(positions, axis=0).max())
    if n == 0:
        return _rows(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3), int), np.zeros((0, 3)))
    if defect == "box of the first call":
        cell = _remembered.setdefault("cell", np.array(cell))
    matrix = _complete(np.asarray(cell, float), pbc)
    if defect == "wraps free axes" and np.linalg.matrix_rank(cell) == 3:
        matrix = np.array(cell, float)
    inverse = np.linalg.inv(matrix)
    width = 1.0 / np.linalg.norm(inverse, axis=0)
    fraction = positions @ inverse
    if defect == "grid in float32":
        fraction = fraction.astype(np.float32).astype(float)
    wraps = pbc if defect != "wraps free axes" else np.ones(3, bool)
    home = np.where(wraps, np.floor(fraction), 0.0)
    if defect in ("drops atoms outside", "no wrapping", "no images"):
        home[:] = 0.0
    if defect == "wraps in place":
        given -= np.where(pbc, home, 0.0) @ matrix
        home[:] = 0.0
    fraction = fraction - home
    shown = np.where(pbc, 0.0, fraction.min(axis=0))
    size = np.linalg.norm(matrix, axis=1) if defect == "bins by edges" else width
    span = np.where(pbc, 1.0, np.maximum(np.ptp(fraction, axis=0), r_cut / width))
    bins = np.maximum(1, np.floor(span * size / r_cut * (1 - 1e-12))).astype(int)
    if defect == "too many bins":
        bins = np.maximum(1, np.ceil(span * width / r_cut)).astype(int)
    bins = np.minimum(bins, 512)
    place = np.floor((fraction - shown) / span * bins).astype(int)
    listed = np.ones(n, bool)
    if defect == "drops atoms outside":
        listed = ((fraction >= 0) & (fraction < 1) | ~pbc).all(axis=1)
    elif defect == "wraps to the far face":
        listed = ((place < bins) | ~pbc).all(axis=1)
    if defect == "last bin lost":
        listed &= ((place < bins - 1) | (bins < 4)).all(axis=1)
    place = np.clip(place, 0, bins - 1)
    reach = np.ceil(r_cut / (span * width / bins) - 1e-9).astype(int)
    if defect in ("too many bins", "bins by edges", "two bins counted twice", "next cell only"):
        reach = np.ones(3, int) if defect != "next cell only" else np.minimum(reach, bins)
    if defect == "images undercounted":
        reach = np.where(bins == 1, np.maximum(1, np.round(r_cut / width).astype(int)), reach)
    if defect == "no wrapping":
        reach = np.minimum(reach, bins)
    if defect in ("no images", "drops atoms outside", "no wrapping"):
        # a grid over all atoms wherever they are, or bins that make no sense outside
        place = np.where(listed[:, None], place, 0)
    i, j, lattice = _candidates(place, bins, reach, pbc, defect)
    keep = listed[i] & listed[j]
    i, j, lattice = i[keep], j[keep], lattice[keep]
    if defect == "no images":
        i, j = np.divmod(np.arange(n * n), n)
        lattice = np.zeros((n * n, 3), int)
    shift = (lattice + home[i] - home[j]).astype(int)
    box = np.where(pbc[:, None], matrix, 0.0)
    if defect == "wraps free axes":
        wrapped = positions - home @ matrix
        vector = wrapped[j] - wrapped[i] + lattice @ box
        shift = np.where(pbc, shift, 0)
    else:
        vector = positions[j] - positions[i] + shift @ box
    if defect in ("minimum image", "two bins counted twice"):
        vector = positions[j] - positions[i]
        shift = -np.where(pbc, np.rint(vector @ inverse), 0).astype(int)
        vector = vector + shift @ box
        if defect == "minimum image":
            _, first = np.unique(i * n + j, return_index=True)
            i, j, shift, vector = i[first], j[first], shift[first], vector[first]
    distance = np.sqrt((vector**2).sum(axis=1))
    inside = distance < r_cut
    if defect == "one side in float32":
        inside = np.where(i < j, inside, distance.astype(np.float32) < np.float32(r_cut))
    if defect == "skips by bounding box":
        inside &= ~((np.abs(vector[:, 0]) > 0.93 * r_cut) & (np.abs(vector[:, 1]) < 0.2 * r_cut))
    itself = (i == j) & (np.all(shift == 0, axis=1) if defect != "keeps itself" else False)
    if defect == "coincident atoms dropped":
        itself |= distance == 0
    inside &= ~itself
    i, j, shift, vector = i[inside], j[inside], shift[inside], vector[inside]
    if defect == "shifts of wrapped positions":
        shift = shift - (home[i] - home[j]).astype(int)
    return _spoiled(n, r_cut, place, i, j, shift, vector, defect)


def _candidates(place, bins, reach, pbc, defect):
    """Atoms in the bins around each atom, and the lattice vectors that bring those bins near."""
    steps = np.array(list(itertools.product(*(range(-r, r + 1) for r in reach))))
    if defect == "half stencil":
        steps = steps[[tuple(step) >= (0, 0, 0) for step in steps]]
    target = place[:, None, :] + steps[None]
    lattice = np.floor_divide(target, bins)
    target = target - lattice * bins
    ok = ((lattice == 0) | pbc).all(axis=2)
    if defect == "next cell only" or defect == "no wrapping":
        ok &= (np.abs(lattice) <= 1).all(axis=2)
    number = (target[..., 0] * bins[1] + target[..., 1]) * bins[2] + target[..., 2]
    number = np.where(ok, number, -1)
    if defect == "stencil aliases":
        # each neighboring bin once, whichever way it was come to
        for row, bins_around in enumerate(number):
            ok[row] &= np.isin(np.arange(number.shape[1]), np.unique(bins_around, return_index=True)[1])
    home = (place[:, 0] * bins[1] + place[:, 1]) * bins[2] + place[:, 2]
    order = np.argsort(home, kind="stable")
    first = np.searchsorted(home[order], number, "left")
    count = np.where(ok, np.searchsorted(home[order], number, "right") - first, 0)
    which = np.repeat(np.arange(count.size), count.ravel())
    within = np.arange(len(which)) - np.repeat(np.cumsum(count.ravel()) - count.ravel(), count.ravel())
    i = which // count.shape[1]
    j = order[first.ravel()[which] + within]
    return i, j, lattice.reshape(-1, 3)[which]


def _spoiled(n, r_cut, place, i, j, shift, vector, defect):
    """What goes wrong after the pairs were found."""
    distance = np.sqrt((vector**2).sum(axis=1))
    if defect == "ghosts by coordinate":
        # a pair through a face is kept by the side from which the ghost lies higher
        ghost = np.any(shift != 0, axis=1)
        higher = (vector[:, 2] > 0) | ((vector[:, 2] == 0) & (vector[:, 1] > 0))
        once = np.where(ghost, higher, i < j)
        i, j, shift, vector = (np.concatenate([part[once], other[once]]) for part, other in (
            (i, j), (j, i), (shift, -shift), (vector, -vector)))  # fmt: skip
    elif defect == "half trimmed from full":
        kept = np.all(shift == 0, axis=1) & (i < j)
        i, j, shift, vector = i[kept], j[kept], shift[kept], vector[kept]
    elif defect == "zero distance twice":
        more = np.flatnonzero(distance == 0)
        i, j, shift, vector = (np.concatenate([part, part[more]]) for part in (i, j, shift, vector))
    elif defect in ("32 neighbors", "fixed slots", "nearest only", "silent overflow", "tile overflow"):
        rank_by = distance if defect == "nearest only" else j
        room = {"32 neighbors": 32, "fixed slots": 100, "nearest only": 60, "tile overflow": 48}
        most = room.get(defect, int(1.25 * len(i) / max(n, 1)) + 4)
        group = i // 8 if defect == "tile overflow" else i
        most = most * 4 if defect == "tile overflow" else most
        order = np.lexsort((rank_by, group))
        starts = np.searchsorted(group[order], group[order], "left")
        kept = order[np.arange(len(order)) - starts < most]
        i, j, shift, vector = i[kept], j[kept], shift[kept], vector[kept]
    elif defect == "capacity of all for each":
        most = max(64, 16 * n)
        i, j, shift, vector = i[:most], j[:most], shift[:most], vector[:most]
    elif defect == "rows beyond 4096":
        kept = i < 4096
        i, j, shift, vector = i[kept], j[kept], shift[kept], vector[kept]
    elif defect == "32-bit keys":
        key = (i * n + j).astype(np.int32).astype(np.int64) * 1000 + (shift @ [100, 10, 1])
        _, kept = np.unique(key, return_index=True)
        i, j, shift, vector = i[kept], j[kept], shift[kept], vector[kept]
    elif defect == "remembers by count":
        i, j, shift, vector = _remembered.setdefault(n, (i, j, shift, vector))
    elif defect == "tail not cut":
        last = _remembered.get("tail")
        if last is not None and len(last[0]) > len(i):
            i, j, shift, vector = (
                np.concatenate([new, old[len(new) :]])
                for new, old in zip((i, j, shift, vector), last, strict=True)
            )
        _remembered["tail"] = (i, j, shift, vector)
    elif defect == "count of the last":
        # the buffer is cut where it was cut before, which shows where there are more rows than then
        most, _remembered["count"] = _remembered.get("count", len(i)), len(i)
        i, j, shift, vector = i[:most], j[:most], shift[:most], vector[:most]
    rows = _rows(i, j, shift, vector)
    if defect == "padding handed out":
        rows["i"], rows["j"] = np.append(i, n), np.append(j, n)
        del rows["shift"], rows["distance"], rows["vector"]
    elif defect == "real indices":
        rows["i"] = i.astype(float)
    elif defect == "unequal lengths":
        rows["j"] = j[: len(j) - len(j) // 9]
    elif defect == "squared distances":
        rows["distance"] = rows["distance"] ** 2
    elif defect == "distances of neighbors":
        rows["distance"] = np.roll(rows["distance"], 1)
    elif defect == "vectors turned":
        rows["vector"] = np.where((i < j)[:, None], vector, -vector)
    return rows


def _rows(i, j, shift, vector):
    return {"i": i, "j": j, "shift": shift, "distance": np.sqrt((vector**2).sum(axis=1)), "vector": vector}


def _complete(cell, pbc):
    """The cell with normals in place of what does not repeat."""
    made = np.where(pbc[:, None], cell, 0.0)
    for axis in np.flatnonzero(~pbc):
        for trial in np.eye(3)[np.roll(np.arange(3), -axis)]:
            others = [row for k, row in enumerate(made) if k != axis and row.any()]
            for row in np.linalg.qr(np.array(others).T)[0].T if others else ():
                trial = trial - (trial @ row) * row
            if np.linalg.norm(trial) > 0.3:
                made[axis] = trial / np.linalg.norm(trial)
                break
    return made


def planted(defect):
    """The search with a defect, as a function of its own."""

    def list_with_defect(positions, cell, pbc, r_cut):
        return search(positions, cell, pbc, r_cut, defect)

    _remembered.clear()
    return list_with_defect


@lru_cache(maxsize=4096)
def _right(positions: bytes, cell: bytes, pbc: bytes, reach: float):
    """The rows of `search` without a defect: lists that are kept are built in the same places."""
    places, box = (np.frombuffer(part).reshape(-1, 3) for part in (positions, cell))
    return search(places, box, np.frombuffer(pbc, bool), reach)


#: How much of a length is left after a deformation since the build (and since the first box).
_STRAIN_RULES = {
    "motion in the box alone": lambda by, first: 1.0,
    "strain by volume": lambda by, first: abs(np.linalg.det(by)) ** (1 / 3),
    "strain since the first box": lambda by, first: np.linalg.svd(first, compute_uv=False)[-1],
    # of a length r_cut in place of r_cut and the skin, which is three tenths of it
    "strain of the cutoff": lambda by, first: 1 - (1 - np.linalg.svd(by, compute_uv=False)[-1]) / 1.3,
}


class Kept:
    """A list with a skin: rebuilt when two atoms could have used it up, or the box has changed."""

    def __init__(self, defect=""):
        self.defect = defect
        self.rows = self.tail = self.due_at = None
        self.age = 0

    def allocate(self, positions, cell, pbc, r_cut, skin):
        known = self.rows is not None and len(positions) == len(self.reference)
        self.pbc, self.r_cut, self.padding = pbc, r_cut, skin
        if self.due_at is None or self.defect != "skin of the first":
            self.due_at = skin
        self.first, self.most, self.slots = (np.array(cell), np.array(positions)), None, None
        self.late = False
        if not (self.defect == "known by its size" and known):
            self._build(positions, cell)
        return self._pairs(positions, cell)

    def update(self, positions, cell):
        self.age += 1
        due = self._due(positions, cell)
        if self.defect == "one step late":
            due, self.late = self.late, due
        if due:
            at = self.previous if self.defect == "rebuilt from old positions" else positions
            self._build(at, cell)
        elif self.defect == "reference overwritten":
            self.reference = np.array(positions)
        self.previous = np.array(positions)
        return self._pairs(positions, cell)

    def _due(self, positions, cell):
        moved = positions - self.reference
        if self.defect == "nearest image of motion" and self.pbc.all():
            moved = moved - np.rint(moved @ np.linalg.inv(cell)) @ cell
        size = np.sqrt((moved**2).sum(axis=1))
        most = float(size.max(initial=0.0))
        if self.defect == "average motion":
            most = 2.0 * float(size.mean())
        room = self.due_at if self.defect == "whole skin" else self.due_at / 2
        corner = float(np.abs((cell - self.cell).sum(axis=0)).max())
        if self.defect == "negative skin squared":
            return most**2 > (0.5 * (self.padding - 2 * corner)) ** 2
        blind = {"every 20 steps": 20, "skin for another frequency": 6}
        if self.defect in blind:
            return self.age >= blind[self.defect] or corner > 0
        if self.defect == "delay of 10" and self.age < 10 and not corner:
            return False
        if self.defect == "never again":
            return False
        changed = not np.array_equal(cell, self.cell)
        if self.defect == "box not looked at":
            changed = False
        if self.defect == "volume looked at":
            changed = (
                abs(np.linalg.det(cell) / np.linalg.det(self.cell) - 1) > 1e-12 if self.pbc.all() else False
            )
        if self.defect in _STRAIN_RULES:
            return self._strained(positions, cell)
        return changed or most > room

    def _strained(self, positions, cell):
        """Whether motion in the box and a part of its strain have used up the skin."""
        full = [_complete(np.asarray(one, float), self.pbc) for one in (cell, self.cell, self.oldest)]
        since = [np.linalg.solve(one, full[0]) for one in full[1:]]
        moved = positions - self.reference @ since[0]
        # the nearest image of motion where it has not been wrapped: there is no other
        most = float(np.sqrt((moved**2).sum(axis=1)).max(initial=0.0))
        kept = _STRAIN_RULES[self.defect](*since)
        return 2 * most + (self.r_cut + self.padding) * max(0.0, 1 - kept) > self.padding

    def _build(self, positions, cell):
        self.age = 0
        self.cell, self.reference = np.array(cell), np.array(positions)
        self.oldest = getattr(self, "oldest", self.cell)
        if self.defect == "the caller's array":
            self.reference = positions
        self.previous = self.reference
        rows = _right(positions.tobytes(), cell.tobytes(), self.pbc.tobytes(), self.r_cut + self.padding)
        if self.defect == "images counted once":
            # as many images as the first box needed
            far = np.abs(rows["shift"]).max(axis=1, initial=0)
            self.most = int(far.max(initial=0)) if self.most is None else self.most
            rows = {name: part[far <= self.most] for name, part in rows.items()}
        if self.defect in ("overflow of the first", "counts of the first"):
            count = np.bincount(rows["i"], minlength=len(positions))
            if self.slots is None:
                self.slots = int(1.25 * count.max(initial=0)) + 2 if self.defect[0] == "o" else count
            order = np.argsort(rows["i"], kind="stable")
            rank = np.arange(len(order)) - np.searchsorted(rows["i"][order], rows["i"][order], "left")
            room = self.slots if np.ndim(self.slots) == 0 else np.asarray(self.slots)[rows["i"][order]] + 2
            rows = {name: part[order[rank < room]] for name, part in rows.items()}
        if self.defect == "tail of a growing count lost":
            last = len(rows["i"]) if self.tail is None else self.tail
            self.tail = len(rows["i"])
            rows = {name: part[:last] for name, part in rows.items()}
        if self.defect == "stale tail":
            if self.tail is not None and len(self.tail["i"]) > len(rows["i"]):
                rows = {
                    name: np.concatenate([part, self.tail[name][len(part) :]]) for name, part in rows.items()
                }
            self.tail = rows
        self.rows = rows
        self.ghosts = positions[rows["j"]] if self.defect != "stale tail" else None

    def _pairs(self, positions, cell):
        i, j, shift = self.rows["i"], self.rows["j"], self.rows["shift"]
        if self.defect == "frozen ghosts":
            # images are where they were at the build; what is listed is decided with them
            through = np.any(shift != 0, axis=1)
            at = np.where(through[:, None], self.ghosts, positions[j])
            apart = np.linalg.norm(at - positions[i] + shift @ np.where(self.pbc[:, None], cell, 0), axis=1)
            near = apart < self.r_cut
            return {"i": i[near], "j": j[near], "shift": shift[near]}
        return {"i": i, "j": j, "shift": shift}


def kept(defect):
    """A class of lists that are kept, with a defect."""

    class KeptWithDefect(Kept):
        def __init__(self):
            super().__init__(defect)

    return KeptWithDefect


def _length(moved):
    return np.sqrt((moved**2).sum(axis=-1))


def _drawn(count, share):
    return np.random.default_rng(count).random(count) < share


#: Rebuild tests of another shape than "an atom moved by half of the skin", of (moved, room): displacements
#: since the build, shape (atoms, 3), and half of the skin. Each lets pairs of its own kind through.
RULE_DEFECTS = {
    # each axis by itself
    "each axis by itself": lambda moved, room: np.abs(moved).max() > room,
    "fourth powers": lambda moved, room: ((moved**4).sum(axis=1) ** 0.25).max() > room,
    "each axis over all atoms": lambda moved, room: np.sqrt((moved**2).sum(axis=0)).max() > room,
    "the furthest along each axis, averaged": lambda moved, room: np.sqrt(
        (np.abs(moved).max(axis=0) ** 2).mean()
    ) > room / 1.5,
    # the norm of something else
    "motion in the xy plane": lambda moved, room: _length(moved[:, :2]).max() > room,
    "motion across the xy plane alone": lambda moved, room: np.maximum(
        np.abs(moved[:, 2]), np.abs(moved[:, 0] + moved[:, 1]) / 2**0.5
    ).max() > room,
    "root mean square": lambda moved, room: np.sqrt((moved**2).sum(axis=1).mean()) > room,
    "twice the mean": lambda moved, room: 2 * _length(moved).mean() > room,
    "twice the mean of a few": lambda moved, room: (
        2 * np.sort(_length(moved))[-10:].mean() > room if len(moved) > 9 else _length(moved).max() > room
    ),
    "the sum of all": lambda moved, room: (
        _length(moved.sum(axis=0)) > room if len(moved) > 20 else _length(moved).max() > room
    ),
    "beyond the mean of all": lambda moved, room: _length(moved).max() - _length(moved.mean(axis=0)) > room,
    "relative to the first atom": lambda moved, room: _length(moved - moved[:1]).max() > 2 * room,
    "half of the spread along each axis": lambda moved, room: np.ptp(moved, axis=0).max() > 2 * room,
    # a share of the atoms ignored
    "every second atom": lambda moved, room: _length(moved[::2]).max() > room,
    "every second atom, the odd ones": lambda moved, room: (
        len(moved) < 2 or _length(moved[1::2]).max() > room
    ),
    "motion along x": lambda moved, room: np.abs(moved[:, 0]).max() > room,
    "all but the first": lambda moved, room: len(moved) < 2 or _length(moved[1:]).max() > room,
    "the first alone": lambda moved, room: _length(moved[:1]).max() > room,
    "the first half": lambda moved, room: _length(moved[: (len(moved) + 1) // 2]).max() > room,
    "all but the last": lambda moved, room: len(moved) < 2 or _length(moved[:-1]).max() > room,
    "a sample of nine in ten": lambda moved, room: _length(
        moved[_drawn(len(moved), 0.9)] if len(moved) > 9 else moved
    ).max() > room,
    "the 95th percentile": lambda moved, room: (
        np.percentile(_length(moved), 95) if len(moved) > 19 else _length(moved).max()
    ) > room,
    "one in ten may go further": lambda moved, room: np.sort(_length(moved))[-1 - len(moved) // 10] > room,
    # two atoms, and how they share what there is
    "the larger of two, a third each": lambda moved, room: np.sort(_length(moved))[-1] > 1.2 * room,
    "geometric mean of two": lambda moved, room: (
        np.sqrt(np.prod(np.sort(_length(moved))[-2:])) > room if len(moved) > 1 else True
    ),
    "two percent late": lambda moved, room: _length(moved).max() > 1.02 * room,
}  # fmt: skip


def _largest(moved, place):
    """The length of the displacement at a place among the largest, from 1."""
    return np.sort(_length(moved))[-min(place, len(moved))]


def _in_halves(moved, halves):
    return sum(_length(half).max(initial=0.0) for half in halves(moved))


#: Rebuild tests that are right for few atoms, for two that move alike and for one that moves alone, and let a
#: pair through that shares the motion in another way among hundreds of atoms, or lies in a place of its own.
CROWD_RULE_DEFECTS = {
    # how two share it
    "one by two thirds of the skin, or two by a third": lambda moved, room: (
        _largest(moved, 1) > 1.4 * room or (len(moved) > 1 and _largest(moved, 2) > 0.7 * room)
    ),
    "one by nine tenths of the skin, or two by half": lambda moved, room: (
        _largest(moved, 1) > 1.8 * room or (len(moved) > 1 and _largest(moved, 2) > 0.95 * room)
    ),
    "the furthest and the mean of the others": lambda moved, room: (
        _largest(moved, 1) + np.sort(_length(moved))[:-1].mean() if len(moved) > 2 else _length(moved).sum()
    ) > 2 * room,
    "the furthest even atom and the furthest odd one": lambda moved, room: _in_halves(
        moved, lambda moved: (moved[::2], moved[1::2])
    ) > 2 * room,
    "the furthest of each half": lambda moved, room: _in_halves(
        moved, lambda moved: np.array_split(moved, 2)
    ) > 2 * room,
    # a share of the atoms ignored
    "one in a hundred may go further": lambda moved, room: _largest(moved, 1 + len(moved) // 100) > room,
    "two of hundreds may go further": lambda moved, room: _largest(moved, 3 if len(moved) > 99 else 1) > room,
    "one in five hundred may go further": lambda moved, room: (
        _largest(moved, 1 + len(moved) // 500) > room / 1.01 or _largest(moved, 1) > 2 * room
    ),
    "the 99th percentile": lambda moved, room: np.percentile(_length(moved), 99) > room,
    "the 99.9th percentile": lambda moved, room: np.percentile(_length(moved), 99.9) > room,
    "the median": lambda moved, room: (
        2 * np.median(_length(moved)) > room if len(moved) > 99 else _largest(moved, 1) > room
    ),
    "five times the root mean square": lambda moved, room: (
        5 * np.sqrt((moved**2).sum(axis=1).mean()) > room or (len(moved) < 50 and _largest(moved, 1) > room)
    ),
    "four standard deviations": lambda moved, room: (
        _length(moved).mean() + 4 * _length(moved).std() if len(moved) > 99 else _largest(moved, 1)
    ) > room,
    "what lies within ten standard deviations": lambda moved, room: _length(
        moved[_length(moved) <= _length(moved).mean() + 10 * _length(moved).std() + 1e-12]
    ).max() > room,
    "all but each tenth of a hundred and more": lambda moved, room: _length(
        moved[np.arange(len(moved)) % 10 != 7] if len(moved) > 99 else moved
    ).max() > room,
    "whole blocks of 64": lambda moved, room: _length(
        moved[: len(moved) // 64 * 64] if len(moved) > 63 else moved
    ).max() > room,
    "the first 256": lambda moved, room: _length(moved[:256]).max() > room,
    "three atoms at least": lambda moved, room: _largest(moved, 3 if len(moved) > 60 else 1) > 0.9 * room,
    "along x of hundreds": lambda moved, room: (
        np.abs(moved[:, 0]) if len(moved) > 99 else _length(moved)
    ).max() > room,
}  # fmt: skip

#: What is wrong with the rows (i, j, shift) that `update` returns of a list that is right when it is built:
#: each shows only where several images of a pair, or of an atom itself, are listed.
UPDATE_DEFECTS = {
    "own images twice": lambda i, j, shift: _mirrored(i, j, shift, j >= i),
    "own images once": lambda i, j, shift: _kept_rows(i, j, shift, (i != j) | (shift.sum(axis=1) > 0)),
    "no own images": lambda i, j, shift: _kept_rows(i, j, shift, i != j),
    "the nearest images alone": lambda i, j, shift: _kept_rows(
        i, j, shift, np.abs(shift - shift.min(axis=0, initial=0)).max(axis=1, initial=0) < 3
    ),
    "one image of a pair": lambda i, j, shift: _kept_rows(
        i, j, shift, np.isin(np.arange(len(i)), np.unique(i * 10_000 + j, return_index=True)[1])
    ),
    "images of one side": lambda i, j, shift: _mirrored(i, j, shift, (j > i) | (shift[:, 0] > 0)),
    "shifts that are not turned": lambda i, j, shift: tuple(
        np.concatenate([part[j >= i], other[j > i]]) for part, other in ((i, j), (j, i), (shift, shift))
    ),
}


def _kept_rows(i, j, shift, rows):
    return i[rows], j[rows], shift[rows]


def _mirrored(i, j, shift, rows):
    """Some rows, and the same from their other atoms."""
    i, j, shift = _kept_rows(i, j, shift, rows)
    return np.concatenate([i, j]), np.concatenate([j, i]), np.concatenate([shift, -shift])


def updated(defect, skinless=False):
    """A class of lists that are kept, right but for what `update` returns.

    Args:
        defect: a key of `UPDATE_DEFECTS`, or nothing.
        skinless: it lists what is inside the cutoff, and no pairs of its skin.
    """

    class KeptWithUpdate(Kept):
        fresh = True

        def allocate(self, *given):
            self.fresh = True
            return super().allocate(*given)

        def update(self, *given):
            self.fresh = False
            return super().update(*given)

        def _pairs(self, positions, cell):
            rows = super()._pairs(positions, cell)
            i, j, shift = rows["i"], rows["j"], rows["shift"]
            if skinless:
                box = np.where(self.pbc[:, None], cell, 0.0)
                near = _length(positions[j] - positions[i] + shift @ box) < self.r_cut
                i, j, shift = _kept_rows(i, j, shift, near)
            if defect and not self.fresh:
                i, j, shift = UPDATE_DEFECTS[defect](i, j, shift)
            return {"i": i, "j": j, "shift": shift}

    return KeptWithUpdate


#: Tests that lose nothing: what makes them fire differs.
RULES = {
    "an atom by half of the skin": lambda moved, room: _length(moved).max() > room,
    "the two furthest by the skin": lambda moved, room: np.sort(_length(moved))[-2:].sum() > 2 * room,
    "the sum of magnitudes": lambda moved, room: np.abs(moved).sum(axis=1).max() > room,
    "beside a common drift": lambda moved, room: _length(moved - moved.mean(axis=0)).max() > room,
    "always": lambda moved, room: True,
    "at any motion": lambda moved, room: bool(moved.any()),
}


def ruled(test, own=None, filtered=False, says=False):
    """A class of lists that are kept, rebuilt by a test of (moved, room).

    Args:
        own: a padding of its own in units of the cutoff, whatever skin it is given.
        filtered: it gives what is inside the cutoff, and nothing of its skin.
        says: it has an attribute `skin`.
    """

    class KeptByRule(Kept):
        def allocate(self, positions, cell, pbc, r_cut, skin):
            skin = skin if own is None else own * r_cut
            if says:
                self.skin = skin
            return super().allocate(positions, cell, pbc, r_cut, skin)

        def _due(self, positions, cell):
            if not len(positions):
                return True
            moved = positions - self.reference
            return not np.array_equal(cell, self.cell) or bool(test(moved, self.padding / 2))

        def _pairs(self, positions, cell):
            rows = super()._pairs(positions, cell)
            if not filtered:
                return rows
            box = np.where(self.pbc[:, None], cell, 0.0)
            apart = positions[rows["j"]] - positions[rows["i"]] + rows["shift"] @ box
            return {name: part[_length(apart) < self.r_cut] for name, part in rows.items()}

    return KeptByRule
