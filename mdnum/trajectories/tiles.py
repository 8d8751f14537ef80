"""Cutoff decisions on all nearby pairs in each frame, in float32 for sixteen pairs at a time.

Atoms are sorted into clusters of sixteen by bisecting space. A tile consists of two clusters and the lattice
vector between them. A tile stores sixteen decisions of each atom of the first cluster as bits. At each frame,
pairs of nearby clusters are compared with the cutoff in float32. Only decisions that changed since the
previous frame are processed further. If float32 cannot decide or a margin is needed, the exact squared
distance is computed (`search.exact_square`).

Tiles are valid while all atoms of a cluster stay inside an enlarged bounding box. Coordinates are unwrapped,
so that wrapping in the file does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8, UInt16

from mdnum.compiled import njit
from mdnum.trajectories.lattice import Participants, Placed, wrap
from mdnum.trajectories.search import Changed, exact_square
from mdnum.vectors import SIXTEEN, lowest_bit, near_atom, near_box

#: Number of atoms of a cluster.
CLUSTER = SIXTEEN
#: Displacement for which tiles remain valid, in root mean square displacements per frame.
FRAMES, FEWEST = 60.0, 5.0
#: Largest margin around the box of a cluster, and largest such displacement, as shares of the radius.
LARGEST, FURTHEST = 0.3, 0.5
# lattice vectors between two atoms that were wrapped, as integers; the one in the middle is none
_VECTORS = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
_NONE = 13
_UNIT = 2.0**-24


class Tiled(NamedTuple):
    """Tiles of pairs with the same cutoff radius, and all their decisions at the last frame."""

    first: Int[np.ndarray, "tiles"]  # clusters
    second: Int[np.ndarray, "tiles"]
    vector: UInt8[np.ndarray, "tiles"]  # row of `_VECTORS` that is added to the second
    rows: UInt16[np.ndarray, "tiles"]  # bits of the rows that hold a pair inside
    inside: UInt16[np.ndarray, "tiles 16"]  # bits of the pairs inside, by row


class _Numbers(NamedTuple):
    """Data from which exact squared distances are computed at one frame."""

    positions: Float[np.ndarray, "atoms 3"]
    home: Int[np.ndarray, "atoms 3"]  # lattice vectors that have been taken off each atom
    vectors: Float[np.ndarray, "3 3"]
    order: Int[np.ndarray, "slots"]  # atom of each slot of the clusters; -1 for none


class _Limits(NamedTuple):
    """Thresholds of distances and squared distances for pairs with the same cutoff radius."""

    radius: float
    square: float  # of the radius
    reach: np.float32  # squared distance from an atom to a box beyond which no pair is examined
    low: np.float32  # squared distances from here
    high: np.float32  # to here are computed exactly
    bound: float  # margins up to this are counted
    record: bool  # whether what differs is written down


@dataclass
class Tiles:
    """Current tiles, with the unwrapped coordinates of the atoms."""

    order: Int[np.ndarray, "slots"]
    kinds: list[tuple[float, Tiled]]  # (radius, tiles) of each two kinds of atoms that can be neighbors
    home: Int[np.ndarray, "atoms 3"]
    center: Float[np.ndarray, "3"]  # of all atoms, length
    vectors: Float[np.ndarray, "3 3"]  # when they were found
    around: Float32[np.ndarray, "clusters 6"]  # box that each cluster has to stay in: lowest, highest
    clear: float  # every pair within this of its radius is in a tile, length
    columns: Float32[np.ndarray, "clusters 3 16"]  # followed coordinates less the center, at the last frame
    boxes: Float32[np.ndarray, "clusters 6"]  # around each cluster then
    flips: Changed  # room for them; images further than the nearest do not occur

    def serve(self, before: Placed, now: Placed, radius: float, clear: float) -> bool:
        """Update tiles to a new frame. True if the tiles have all pairs closer than radius + `clear`."""
        if clear + 2.0 * self.doubt(now, radius) > self.clear:
            return False
        change = now.lattice.vectors - before.lattice.vectors
        most, second, _ = self._follow(before, now, change)
        # a component of a sum of lattice vectors, each at most once, can have come so far
        drift = float(np.abs(now.lattice.vectors - self.vectors).sum(axis=0).max())
        return (
            clear + 2.0 * self.doubt(now, radius) <= self.clear
            and _one_image(before, now, radius, most + second + float(np.abs(change).sum()))
            and bool(_stays(self.boxes, self.around, np.float32(0.5 * drift * (1 + 4 * _UNIT))))
        )

    def _follow(self, before: Placed, now: Placed, change: np.ndarray) -> tuple[float, float, float]:
        """Update coordinates and boxes; return (largest, second largest, root mean square) displacement."""
        lattice = now.lattice
        most, second, total = _follow(
            before.positions, now.positions, self.order, self.home, lattice.vectors, change, lattice.inverse,
            lattice.periodic, self.center, self.columns,
        )  # fmt: skip
        _box(self.columns, self.boxes)
        return math.sqrt(most), math.sqrt(second), math.sqrt(total / max(len(now.positions), 1))

    def doubt(self, now: Placed, radius: float) -> float:
        """Return the float32 error bound of a distance near the cutoff radius (length)."""
        largest = float(np.abs(self.boxes).max(initial=0.0))
        vectors = float(np.abs(now.lattice.vectors).sum())
        # rounding of two coordinates and a shift, of a difference with each, and of the square
        return 2.0 * _UNIT * (3.0 * largest + 2.0 * vectors + 4.0 * radius) + 8.0 * now.rounding

    def examine(
        self, now: Placed, *, bound: float, horizon: float, pairs: int, record: bool = True
    ) -> tuple[Changed, int, float]:
        """Decide which pairs are inside the cutoff at the present frame.

        Args:
            bound: pairs whose distance deviates from their radius by at most this length are counted.
            horizon: the smallest |margin| is determined up to this length.
            pairs: approximate number of pairs inside.
            record: True to return the pairs that flipped.

        Returns:
            (pairs that flipped, number of pairs within the bound, smallest |margin|).
        """
        numbers = _Numbers(now.positions, self.home, now.lattice.vectors, self.order)
        shifts = (_VECTORS @ now.lattice.vectors).astype(np.float32)
        largest = max((radius for radius, _ in self.kinds), default=0.0)
        doubt, count, close, smallest = self.doubt(now, largest), 0, 0, np.inf
        # about eight pairs are this close, if as many are inside as outside
        seen = max(bound, min(horizon, 1.4 * largest / max(pairs, 1))) if record else 0.0
        while True:
            close, smallest = 0, np.inf
            width = seen + doubt
            for radius, tiled in self.kinds:
                square = radius * radius
                away = width * (2.0 * radius + width) + 8 * _UNIT * square
                limits = _Limits(
                    radius, square, np.float32((radius + seen + 2.0 * doubt) ** 2 * (1 + 8 * _UNIT)),
                    np.float32(square - away), np.float32(square + away), bound, record,
                )  # fmt: skip
                at = 0
                while True:
                    at, count, near, least = _examine(
                        tiled, at, self.columns, self.boxes, shifts, numbers, limits, self.flips, count
                    )
                    close, smallest = close + near, min(smallest, least)
                    if at == len(tiled.first):
                        break
                    larger = Changed.room(2 * len(self.flips.i))
                    for old, new in zip(self.flips, larger, strict=True):
                        new[:count] = old[:count]
                    self.flips = larger
            if not record or smallest <= seen or seen >= max(bound, horizon):
                break
            seen = max(bound, min(horizon, 16.0 * seen))
        self.flips.rank[:count] = 0
        return Changed(*(column[:count].copy() for column in self.flips)), int(close), float(smallest)


def _one_image(before: Placed, now: Placed, radius: float, moved: float) -> bool:
    """Return True if no pair has two images inside the cutoff, even if atoms approach by `moved`."""
    return bool((before.lattice.periodic == now.lattice.periodic).all()) and (
        now.lattice.narrowest >= 2.000002 * (radius + 8.0 * now.rounding) + moved
    )


def tiles_of(
    before: Placed, now: Placed, who: Participants, clear: float, pairs: int, spare: Tiles | None = None
) -> Tiles | None:
    """Build tiles for two successive frames, with the decisions of the first.

    None if atoms move too far, or the box is too narrow. `pairs` is the approximate number of pairs inside
    the cutoff. The memory of the old tiles `spare` is reused.
    """
    radius, lattice, x = who.radius, before.lattice, before.positions
    if not _one_image(before, now, radius, 0.0):
        return None
    followed, home, _ = wrap(x, lattice, np.ones(3, np.int64), np.ones(3))
    center = 0.5 * (followed.min(axis=0) + followed.max(axis=0)) if len(x) else np.zeros(3)
    # runs of clusters of one kind of atoms each
    runs = np.cumsum([0, *(-(-len(some) // CLUSTER) for some in who.kinds)])
    clusters = int(runs[-1])
    order = np.full(CLUSTER * clusters, -1, np.int32)
    for run, some in zip(runs.tolist(), who.kinds, strict=False):
        sorted_here = order[CLUSTER * run : CLUSTER * run + len(some)]
        sorted_here[:] = some
        _halved(followed, sorted_here)
    columns, boxes = _aligned(clusters), np.empty((2, clusters, 6), np.float32)
    made = Tiles(
        order, [], home, center, lattice.vectors, boxes[0], clear, columns, boxes[0],
        Changed.room(4096) if spare is None else spare.flips,
    )  # fmt: skip
    made._follow(before, before, np.zeros((3, 3)))
    old_columns, old_home = columns.copy(), made.home.copy()
    made.boxes = boxes[1]
    change = now.lattice.vectors - lattice.vectors
    most, second, typical = made._follow(before, now, change)
    drift = float(np.abs(change).sum(axis=0).max())
    free = now.lattice.narrowest - radius - clear - 2.0 * (most + drift)
    one_image = _one_image(before, now, radius, most + second + float(np.abs(change).sum()))
    if typical > FURTHEST * radius or not one_image or free < 0:
        return None
    # where that would not be for long they are found anew at each frame
    margin = max(FRAMES * typical, 8.0 * most, 0.02 * radius) if FEWEST * typical < LARGEST * radius else 0.0
    margin = min(margin, LARGEST * radius, 0.2 * free) + 0.5 * drift
    around = np.concatenate(
        [np.minimum(*boxes[:, :, :3]) - margin, np.maximum(*boxes[:, :, 3:]) + margin], axis=1
    )
    # to float32 downward and upward
    size = 4.0 * _UNIT * np.abs(around).max(initial=0.0)
    made.around = (around + size * np.repeat([-1.0, 1.0], 3)).astype(np.float32)
    made.clear = clear + 4.0 * made.doubt(now, radius)
    nodes = _nodes(made.around, runs)
    shifts = (_VECTORS @ lattice.vectors).astype(np.float32)
    codes = np.flatnonzero(((_VECTORS == 0) | lattice.periodic).all(axis=1))
    members = [int(some[0]) for some in who.kinds]
    for a, one in enumerate(members):
        for b, other in enumerate(members[a:], a):
            meets = (who.centers[one] and who.others[other]) or (who.others[one] and who.centers[other])
            limit = float(who.radii[who.species[one], who.species[other]])
            if meets and limit >= 0:
                tiled = _tiled(nodes, runs, a, b, codes, shifts, np.float32(limit + made.clear + size))
                made.kinds.append((limit, tiled))
    new_columns, new_home, new_boxes = made.columns, made.home, made.boxes
    made.columns, made.home, made.boxes = old_columns, old_home, boxes[0]
    made.examine(before, bound=0.0, horizon=0.0, pairs=pairs, record=False)
    made.columns, made.home, made.boxes = new_columns, new_home, new_boxes
    if not margin:
        made.clear = -np.inf
    return made


def _aligned(clusters: int) -> Float32[np.ndarray, "clusters 3 16"]:
    """Return an array of coordinates in which no vector spans two cache lines."""
    room = np.empty(3 * CLUSTER * clusters + CLUSTER, np.float32)
    first = -room.ctypes.data % 64 // 4
    return room[first : first + 3 * CLUSTER * clusters].reshape(clusters, 3, CLUSTER)


def _tiled(
    nodes: Float32[np.ndarray, "nodes 6"],
    runs: Int[np.ndarray, "edges"],
    a: int,
    b: int,
    codes: Int[np.ndarray, "codes"],
    shifts: Float32[np.ndarray, "27 3"],
    reach: np.float32,
) -> Tiled:
    """Return the tiles of two kinds of atoms. The boxes of both clusters are closer than `reach`."""
    room = 32 * int(runs[a + 1] - runs[a]) + 64
    while True:
        made = np.empty((3, room), np.int32)
        count = int(_tiles(nodes, runs, a, b, codes, shifts, reach, made))
        if count <= room:
            break
        room = count
    first, second, vector = made[:, :count]
    rows, inside = np.zeros(count, np.uint16), np.zeros((count, CLUSTER), np.uint16)
    return Tiled(first.copy(), second.copy(), vector.astype(np.uint8), rows, inside)


@njit
def _halved(x, order):
    """Sort atoms into compact groups of sixteen by repeated bisection along the longest edge.

    An atom in the wrong half costs computing time, but causes no error.
    """
    count, scratch = order.shape[0], np.empty(order.shape[0], np.int32)
    stack, edges = np.empty((64, 2), np.int64), np.empty((64, 6))
    low, high, top = np.full(3, np.inf), np.full(3, -np.inf), 1
    for q in range(count):
        for c in range(3):
            low[c], high[c] = min(low[c], x[order[q], c]), max(high[c], x[order[q], c])
    stack[0], edges[0, :3], edges[0, 3:] = (0, (count + CLUSTER - 1) // CLUSTER), low, high
    while top > 0:
        top -= 1
        first, last = stack[top, 0], stack[top, 1]
        if last - first < 2:
            continue
        middle = (first + last + 1) // 2
        low[:], high[:] = edges[top, :3], edges[top, 3:]
        axis = np.argmax(high - low)
        place, begin, end = CLUSTER * middle, CLUSTER * first, min(CLUSTER * last, count)
        left, right, pivot = low[axis], high[axis], low[axis]
        for _ in range(12):
            # as if atoms were spread evenly
            pivot = left + (right - left) * ((place - begin) / (end - begin))
            small, large = begin, 0
            for q in range(begin, end):
                a = np.uint32(order[q])
                is_small = x[a, axis] < pivot
                order[small], scratch[large] = a, a
                small += int(is_small)
                large += 1 - int(is_small)
            order[small:end] = scratch[:large]
            if small <= place:
                begin, left = small, pivot
            else:
                end, right = small, pivot
            if small == place or end - begin < 3:
                break
        for side in range(2):
            stack[top] = (first, middle) if side == 0 else (middle, last)
            edges[top, :3], edges[top, 3:] = low, high
            edges[top, 3 * (1 - side) + axis] = pivot
            top += 1


@njit
def _nodes(boxes, runs):
    """Return a tree of bounding boxes for each range of clusters: the range, its halves, and so on.

    The first half of the clusters of node n is node n + 1. The second half is node n + 2 c, where c is the
    number of clusters in the first half.
    """
    nodes, spans = np.empty((2 * runs[-1], 6), np.float32), np.empty((2 * runs[-1], 2), np.int64)
    stack = [(0, 0, 0)]
    for run in range(runs.shape[0] - 1):
        stack.append((2 * runs[run], runs[run], runs[run + 1]))
        while len(stack) > 1:
            node, first, last = stack.pop()
            spans[node] = first, last
            if last - first > 1:
                middle = (first + last + 1) // 2
                stack.append((node + 1, first, middle))
                stack.append((node + 2 * (middle - first), middle, last))
        for node in range(2 * runs[run + 1] - 2, 2 * runs[run] - 1, -1):
            first, last = spans[node]
            if last - first == 1:
                nodes[node] = boxes[first]
            else:
                other = node + 2 * ((first + last + 1) // 2 - first)
                for c in range(3):
                    nodes[node, c] = min(nodes[node + 1, c], nodes[other, c])
                    nodes[node, 3 + c] = max(nodes[node + 1, 3 + c], nodes[other, 3 + c])
    return nodes


@njit
def _tiles(nodes, runs, a, b, codes, shifts, reach, made):
    """Write the tiles of two ranges of clusters until the buffer is full. Return the number of tiles."""
    count, square, same = 0, reach * reach, a == b
    stack = np.empty((256, 6), np.int64)
    for code in codes:
        stack[0] = 2 * runs[a], runs[a], runs[a + 1], 2 * runs[b], runs[b], runs[b + 1]
        s0, s1, s2, top = shifts[code, 0], shifts[code, 1], shifts[code, 2], 1
        while top > 0:
            top -= 1
            n, first, last, m, begin, end = stack[top]
            # of one kind each two clusters meet once, and a cluster and its own image through one of two
            if same and (
                first >= end or (last - first == 1 and first == begin and end - begin == 1 and code < _NONE)
            ):
                continue
            g0 = max(nodes[m, 0] + s0 - nodes[n, 3], nodes[n, 0] - nodes[m, 3] - s0, np.float32(0.0))
            g1 = max(nodes[m, 1] + s1 - nodes[n, 4], nodes[n, 1] - nodes[m, 4] - s1, np.float32(0.0))
            g2 = max(nodes[m, 2] + s2 - nodes[n, 5], nodes[n, 2] - nodes[m, 5] - s2, np.float32(0.0))
            if g0 * g0 + g1 * g1 + g2 * g2 > square:
                continue
            if last - first == 1 and end - begin == 1:
                if count < made.shape[1]:
                    made[0, count], made[1, count], made[2, count] = first, begin, code
                count += 1
            elif last - first >= end - begin:
                middle = (first + last + 1) // 2
                stack[top] = n + 1, first, middle, m, begin, end
                stack[top + 1] = n + 2 * (middle - first), middle, last, m, begin, end
                top += 2
            else:
                middle = (begin + end + 1) // 2
                stack[top] = n, first, last, m + 1, begin, middle
                stack[top + 1] = n, first, last, m + 2 * (middle - begin), middle, end
                top += 2
    return count


@njit
def _follow(before, now, order, home, vectors, change, inverse, periodic, center, columns):
    """Write unwrapped coordinates. Return the two largest squared displacements and the sum of squares.

    The numbers of lattice vectors removed from each atom are stored in `home`.
    """
    most, second, total = 0.0, 0.0, 0.0
    for at in range(order.shape[0]):
        cluster, lane = np.uint64(at) // np.uint64(CLUSTER), np.uint64(at) % np.uint64(CLUSTER)
        if order[at] < 0:
            columns[cluster, 0, lane] = columns[cluster, 1, lane] = columns[cluster, 2, lane] = np.nan
            continue
        # unsigned: no test for indices from the end
        i = np.uint32(order[at])
        h0, h1, h2 = home[i, 0], home[i, 1], home[i, 2]
        y0 = now[i, 0] - before[i, 0] - (h0 * change[0, 0] + h1 * change[1, 0] + h2 * change[2, 0])
        y1 = now[i, 1] - before[i, 1] - (h0 * change[0, 1] + h1 * change[1, 1] + h2 * change[2, 1])
        y2 = now[i, 2] - before[i, 2] - (h0 * change[0, 2] + h1 * change[1, 2] + h2 * change[2, 2])
        square = y0 * y0 + y1 * y1 + y2 * y2
        if square > second:
            # rarely: most atoms move less than the fastest two, and are not asked whether they were wrapped
            for k in range(3):
                if periodic[k]:
                    n = np.rint(y0 * inverse[0, k] + y1 * inverse[1, k] + y2 * inverse[2, k])
                    if n != 0.0:
                        y0 -= n * vectors[k, 0]
                        y1 -= n * vectors[k, 1]
                        y2 -= n * vectors[k, 2]
                        home[i, k] += np.int64(n)
            h0, h1, h2 = home[i, 0], home[i, 1], home[i, 2]
            square = y0 * y0 + y1 * y1 + y2 * y2
            if square > most:
                most, second = square, most
            elif square > second:
                second = square
        total += square
        for c in range(3):
            columns[cluster, c, lane] = (
                now[i, c] - (h0 * vectors[0, c] + h1 * vectors[1, c] + h2 * vectors[2, c]) - center[c]
            )
    return most, second, total


@njit
def _stays(boxes, around, drift):
    """Return True if each cluster stays inside its enlarged box, at least `drift` from every face."""
    out = 0
    for k in range(boxes.shape[0]):
        for c in range(3):
            out += int(boxes[k, c] < around[k, c] + drift) + int(boxes[k, 3 + c] > around[k, 3 + c] - drift)
    return out == 0


@njit
def _box(columns, boxes):
    """Compute the bounding box of each cluster, ignoring empty slots."""
    for k in range(columns.shape[0]):
        for c in range(3):
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for lane in range(CLUSTER):
                value = columns[k, c, lane]
                low, high = (value if value < low else low), (value if value > high else high)
            boxes[k, c], boxes[k, 3 + c] = low, high


@njit
def _examine(tiled, begin, columns, boxes, shifts, numbers, limits, flips, count):
    """Decide pairs from tile `begin`. Return (next tile, flips, uncertain pairs, least |margin|)."""
    close, smallest, room = 0, np.inf, flips.i.shape[0]
    first, second, vector, rows, inside = tiled.first, tiled.second, tiled.vector, tiled.rows, tiled.inside
    order, low, high, scratch = numbers.order, limits.low, limits.high, np.empty(4 * CLUSTER, np.float32)
    columns_at, boxes_at = np.uintp(columns.ctypes.data), np.uintp(boxes.ctypes.data)
    shifts_at, scratch_at = np.uintp(shifts.ctypes.data), np.uintp(scratch.ctypes.data)
    at = begin
    while at < first.shape[0]:
        if count + CLUSTER * CLUSTER > room:
            break
        tile = np.uintp(at)
        i, j, code = np.uintp(first[tile]), np.uintp(second[tile]), np.uintp(vector[tile])
        j_at = columns_at + np.uintp(192) * j
        left = np.uintp(rows[tile]) | near_box(
            columns_at + np.uintp(192) * i, shifts_at + np.uintp(12) * code, boxes_at + np.uintp(24) * j,
            limits.reach, scratch_at,
        )  # fmt: skip
        # of a cluster with itself each pair is met once
        alone, held = i == j and code == np.uintp(_NONE), np.uintp(0)
        while left != np.uintp(0):
            row = lowest_bit(left)
            atom, left = order[np.uintp(CLUSTER) * i + row], left & (left - np.uintp(1))
            bits = near_atom(scratch_at + np.uintp(4) * row, j_at, low, high)
            if alone:
                bits &= ((np.uintp(0xFFFE) << row) & np.uintp(0xFFFF)) * np.uintp(0x10001)
            now = bits & np.uintp(0xFFFF)
            doubtful = now ^ (bits >> np.uintp(16))
            if doubtful != np.uintp(0):
                slot = np.uintp(CLUSTER) * j
                now, near, least = _settled(now, doubtful, atom, slot, code, numbers, limits)
                close += near
                smallest = min(smallest, least)
            held |= np.uintp(now != np.uintp(0)) << row
            changed = now ^ np.uintp(inside[tile, row])
            if changed != np.uintp(0):
                inside[tile, row] = now
                while limits.record and changed != np.uintp(0):
                    lane = lowest_bit(changed)
                    changed &= changed - np.uintp(1)
                    place = np.uintp(count)
                    flips.i[place] = atom
                    flips.j[place] = order[np.uintp(CLUSTER) * j + lane]
                    flips.entered[place] = (now >> lane) & np.uintp(1)
                    count += 1
        rows[tile] = held
        at += 1
    # the scratch is in use up to here
    scratch[0] = 0.0
    return at, count, close, smallest


@njit(inline="never")
def _settled(inside, doubtful, i, slot, code, numbers, limits):
    """Decide an atom's doubtful pairs; return (decisions as bits, uncertain pairs, least |margin|)."""
    close, smallest, vectors, order = 0, np.inf, numbers.vectors, numbers.order
    n0, n1, n2 = np.intp(code // 9) - 1, np.intp(code // 3 % 3) - 1, np.intp(code % 3) - 1
    while doubtful != np.uintp(0):
        lane = lowest_bit(doubtful)
        doubtful &= doubtful - np.uintp(1)
        real = exact_square(numbers.positions, numbers.home, i, order[slot + lane], n0, n1, n2, vectors)
        margin = abs(limits.radius - np.sqrt(real))
        smallest = min(smallest, margin)
        close += int(margin <= limits.bound)
        if real < limits.square:
            inside |= np.uintp(1) << lane
        else:
            inside &= ~(np.uintp(1) << lane)
    return inside, close, smallest
