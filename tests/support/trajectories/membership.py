"""Made-up membership over frames, the ledger that belongs to it, and what plain loops say about it."""

from __future__ import annotations

import numpy as np

from mdnum.md.ledger import FlipTable, Members


def ledger(inside: np.ndarray, names: list[tuple[int, int, int]]) -> tuple[FlipTable, Members]:
    """Flips in the order of frames, and the pairs at the first frame, of decisions by pair and frame.

    Args:
        names: (i, j, rank) of each row, sorted.
    """
    rows = [
        (frame, *names[pair], bool(inside[pair, frame]))
        for frame in range(1, inside.shape[1])
        for pair in range(len(names))
        if inside[pair, frame] != inside[pair, frame - 1]
    ]
    whole = np.array([row[:4] for row in rows], np.int64).reshape(-1, 4)
    nothing = np.full(len(rows), np.nan)
    entered = np.array([row[4] for row in rows], bool)
    flips = FlipTable(
        **dict(zip(("frame", "i", "j", "rank"), whole.T, strict=True)),
        entered=entered, decided_by="positions",
        **dict.fromkeys(("distance", "before", "margin", "margin_before", "bound"), nothing),
        ambiguous=np.zeros(len(rows), bool),
    )  # fmt: skip
    start = np.array([name for name, row in zip(names, inside, strict=True) if row[0]], np.int64)
    start = start.reshape(-1, 3)
    return flips, Members(*start.T, np.zeros(len(start)))


def random_membership(
    seed: int, pairs: int = 30, frames: int = 25, atoms: int = 8
) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """Decisions that stick for a while; one pair is never inside and one always; images and (i, i) too."""
    rng = np.random.default_rng(seed)
    inside = np.empty((pairs, frames), bool)
    inside[:, 0] = rng.random(pairs) < 0.5
    for frame in range(1, frames):
        flip = rng.random(pairs) < rng.choice([0.05, 0.3, 0.6], pairs)
        inside[:, frame] = inside[:, frame - 1] ^ flip
    inside[0], inside[1] = True, False
    every = [(i, j, rank) for i in range(atoms) for j in range(i, atoms) for rank in range(2)]
    chosen = sorted(rng.choice(len(every), pairs, replace=False).tolist())
    return inside, [every[at] for at in chosen]


def stays(inside: np.ndarray) -> list[tuple[int, int, int, bool, bool]]:
    """(pair, begin, end, began, ended) of every run of True, by walking along each row."""
    found = []
    for pair, row in enumerate(inside):
        begin = None
        for frame, now in enumerate(row):
            if now and begin is None:
                begin = frame
            if not now and begin is not None:
                found.append((pair, begin, frame, begin > 0, True))
                begin = None
        if begin is not None:
            found.append((pair, begin, len(row), begin > 0, False))
    return found
