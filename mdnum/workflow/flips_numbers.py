"""What a folder's ledger says, worked out pair by pair: contacts, lifetimes, rates, chatter, strides.

The ledger is in the order of frames and may be larger than memory. It is gone through in parts, each with all
flips of some of the pairs, and everything counted here adds up over parts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.store import RunFolder
from mdnum.store.tables import TableStream
from mdnum.trajectories.contacts import Contacts, contacts, mended
from mdnum.trajectories.history import History
from mdnum.trajectories.lifetimes import Durations, again, mean_by_rate, residence, survival
from mdnum.trajectories.rates import Busiest, Chatter, Tally, by_group, mean_stay
from mdnum.trajectories.stride import Strides, between_frames, doublings

#: Rows of the ledger held at once.
_PART_ROWS = 1_500_000
#: Stays from which the share that is there again is taken: all of them in most files.
_AGAIN_STAYS = 200_000
_BUSIEST = 500
_POINTS = 160
_CLASSES = 60
# an odd number, so that the parts of a crystal's regular labels are alike
_SPREAD = 1_000_003

Progress = Callable[[int, int, dict[str, Any]], None]


@dataclass(frozen=True)
class Labels:
    """Classes of atoms: species, and residues by name and one by one.

    Attributes:
        species, residue_names: (index of each atom, names); None for residues where the file has none.
        residues: (index of each atom, words).
    """

    species: tuple[Int[np.ndarray, "atoms"], Sequence[str]]
    residue_names: tuple[Int[np.ndarray, "atoms"], Sequence[str]] | None
    residues: tuple[Int[np.ndarray, "atoms"], Sequence[str]] | None


@dataclass
class Counted:
    """Everything that adds up over parts of the pairs."""

    durations: Durations
    intermittent: Durations
    species: Tally
    names: Tally | None
    residues: tuple[np.ndarray, np.ndarray] | None
    chatter: Chatter
    strides: Strides
    busiest: Busiest
    pairs: int
    images: int
    again: tuple[np.ndarray, np.ndarray, int]


def labels(table: Any) -> Labels:
    """The classes in a `mdnum.trajectories.source.AtomTable`."""

    def coded(words: np.ndarray) -> tuple[np.ndarray, list[str]]:
        names, index = np.unique(words.astype(str), return_inverse=True)
        return index.reshape(-1), [str(one) for one in names]

    species = coded(table.species)
    if not any(table.residue_names):
        return Labels(species, None, None)
    first = np.unique(table.residues, return_index=True)[1]
    words = [f"{table.residue_names[at]} {table.residue_ids[at]}" for at in first]
    # residues are numbered from 0 without gaps in a topology
    return Labels(species, coded(table.residue_names), (table.residues, words))


def atom_words(table: Any, atoms: np.ndarray) -> list[str]:
    """What atoms are called: "GLY 12 CA", or their names where there are no residues."""
    found = []
    for at in atoms:
        residue = f"{table.residue_names[at]} {table.residue_ids[at]} " if table.residue_names[at] else ""
        found.append(f"{residue}{table.names[at]}")
    return found


def histories(folder: RunFolder, rule: int, frames: int) -> Iterator[tuple[int, int, History]]:
    """(part, parts, history of some of the pairs) until every pair of a rule had its turn."""
    streams = {name: TableStream(folder.path, name, folder.world) for name in ("members", "flips")}
    rows = sum(stream.flushed for stream in streams.values())
    parts = max(1, -(-rows // _PART_ROWS))
    for part in range(parts):
        first = _columns(streams["members"], ("i", "j", "rank"), rule, part, parts)
        flips = _columns(
            streams["flips"], ("frame", "entered", "i", "j", "rank", "ambiguous"), rule, part, parts
        )
        pair = [flips[name] for name in ("i", "j", "rank")]
        yield (
            part, parts,
            History.of_columns(
                flips["frame"], flips["entered"], pair, list(first.values()), frames, flips["ambiguous"]
            ),
        )  # fmt: skip


def _columns(
    stream: TableStream, names: Sequence[str], rule: int, part: int, parts: int
) -> dict[str, np.ndarray]:
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for batch in stream.batches(["rule", *names]):
        rows = {name: batch[name].to_numpy() for name in ("rule", *names)}
        mine = rows["rule"] == rule
        if parts > 1:
            mine &= (rows["i"].astype(np.int64) * _SPREAD + rows["j"]) % parts == part
        for name in names:
            found[name].append(rows[name][mine])
    empty = {"entered": np.zeros(0, bool), "ambiguous": np.zeros(0, bool)}
    return {
        name: np.concatenate(some) if some else empty.get(name, np.zeros(0, np.int64))
        for name, some in found.items()
    }


def count(
    folder: RunFolder, rule: int, frames: int, named: Labels, directed: bool, window: int, progress: Progress
) -> Counted:
    """Goes through the ledger of one rule, writing its contacts.

    Args:
        window: frames within which a flip that is taken back is chatter, and up to which a stay outside is
            overlooked in an intermittent contact.
    """
    total: Counted | None = None
    for part, parts, history in histories(folder, rule, frames):
        stays = contacts(history)
        values = {name: getattr(stays, name) for name in stays.__dataclass_fields__}
        folder.append("contacts", {"rule": np.full(len(stays), rule), **values})
        total = _added(total, _of_part(history, stays, named, directed, window))
        progress(part + 1, parts, {"phase": "counting contacts", "unit": "parts"})
    assert total is not None, "there is at least one part"
    return total


def _of_part(history: History, stays: Contacts, named: Labels, directed: bool, window: int) -> Counted:
    frames = history.frames
    names, residues = named.residue_names, named.residues
    some = _some(stays)
    lags = points(frames)
    return Counted(
        Durations.of(stays, frames),
        Durations.of(mended(stays, window), frames),
        Tally.of(stays, *named.species, frames, directed),
        None if names is None else Tally.of(stays, *names, frames, directed),
        None if residues is None else by_group(history, residues[0], len(residues[1])),
        Chatter.of(history, window),
        Strides.of_history(history, doublings(frames)),
        Busiest.of(history, stays, _BUSIEST),
        int(np.count_nonzero(history.flips)),
        int(np.count_nonzero((history.rank > 0) | (history.i == history.j))),
        (*again(some, lags, frames), len(some)),
    )


def _some(stays: Contacts) -> Contacts:
    """All stays of some of the pairs: enough for an average, however many there are."""
    if len(stays) <= _AGAIN_STAYS:
        return stays
    among = -(-len(stays) // _AGAIN_STAYS)
    mine = (stays.i.astype(np.int64) * 7 + stays.j * 13) % among == 0
    return Contacts(**{name: getattr(stays, name)[mine] for name in stays.__dataclass_fields__})


def _added(one: Counted | None, other: Counted) -> Counted:
    if one is None:
        return other
    both = [one.again, other.again]
    # one part of the pairs is a sample of all of them, and enough
    kept = both[0] if both[0][2] >= _AGAIN_STAYS // 2 else tuple(a + b for a, b in zip(*both, strict=True))
    return Counted(
        one.durations + other.durations,
        one.intermittent + other.intermittent,
        one.species + other.species,
        None if one.names is None or other.names is None else one.names + other.names,
        None
        if one.residues is None or other.residues is None
        else (one.residues[0] + other.residues[0], one.residues[1] + other.residues[1]),
        one.chatter + other.chatter,
        one.strides + other.strides,
        one.busiest.joined(other.busiest, _BUSIEST),
        one.pairs + other.pairs,
        one.images + other.images,
        kept,  # type: ignore[arg-type]
    )


def points(frames: int) -> Int[np.ndarray, "lags"]:
    """Lags at which curves are told, in frames: all of them as far as there are few, then further apart."""
    if frames < 2:
        return np.zeros(1, np.int64)
    return np.unique(np.concatenate([[0], np.round(np.geomspace(1, frames - 1, _POINTS))]).astype(np.int64))


def curves(found: Counted, pairs: Int[np.ndarray, "frames"], interval: float) -> dict[str, np.ndarray]:
    """Columns of the table of lifetimes.

    Args:
        pairs: inside at each frame.
        interval: time between frames; nan where it is not known.
    """
    lags = points(len(pairs))
    left, mended_left = survival(found.durations), survival(found.intermittent)
    both, once, _ = found.again

    def at(steps: Any, values: np.ndarray, start: float, until: int) -> np.ndarray:
        place = np.searchsorted(steps, lags, side="right") - 1
        known = np.where(place >= 0, np.concatenate([values, [start]])[place], start)
        return np.where(lags <= until, known, np.nan)

    risk = np.cumsum(_followed(found.durations)[::-1])[::-1]
    return {
        "frames": lags,
        "time": lags * interval,
        "at_risk": risk[np.minimum(lags, len(risk) - 1)],
        "survival": at(left.frames, left.share, 1.0, left.longest),
        "error": at(left.frames, left.error, 0.0, left.longest),
        "intermittent": at(mended_left.frames, mended_left.share, 1.0, mended_left.longest),
        "residence": residence(found.durations, pairs)[lags],
        "again": np.divide(both, once, out=np.full(len(lags), np.nan), where=once > 0),
    }


def _followed(durations: Durations) -> np.ndarray:
    """Stays that were seen to begin, by the frames for which they were followed."""
    followed = durations.seen.copy()
    followed[:-1] += durations.goes_on[1:]
    return followed


def told(found: Counted) -> dict[str, Any]:
    """Plain values of what was counted, lengths of time in frames."""
    return {
        "pairs_flipped": found.pairs,
        "images": found.images,
        "contacts": {
            "seen": int(found.durations.seen.sum()),
            "goes_on": int(found.durations.goes_on.sum()),
            "older": int(found.durations.older.sum()),
            "throughout": int(found.durations.throughout.sum()),
        },
        # of the pairs inside at a frame that were looked at again, those still inside at the next
        "stays_over": 1 - found.durations.leaves / max(found.durations.exposure, 1),
        "lifetime": _lifetime(found.durations),
        "intermittent": _lifetime(found.intermittent),
        "by_species": classes(found.species),
        "by_residue_name": [] if found.names is None else classes(found.names),
        "chatter": {
            "window": found.chatter.window,
            "undone": found.chatter.undone,
            "share": found.chatter.undone / found.chatter.flips if found.chatter.flips else 0.0,
            "inside": found.chatter.inside.tolist(),
            "outside": found.chatter.outside.tolist(),
        },
        "stride": {
            "stride": found.strides.stride.tolist(),
            "flips": found.strides.flips.tolist(),
            "of": found.strides.of.tolist(),
            "doubtful": found.strides.doubtful.tolist(),
            **_between(found.strides),
        },
    }


def _lifetime(durations: Durations) -> dict[str, Any]:
    left, (mean, error) = survival(durations), mean_by_rate(durations)
    return {
        "followed": int(durations.seen.sum() + durations.goes_on.sum()),
        "median": left.at(0.5),
        "quarter_gone": left.at(0.75),
        "three_quarters_gone": left.at(0.25),
        "mean": left.mean if len(left.share) else None,
        # with some left at the end the area is that of a curve cut short
        "mean_is_whole": bool(len(left.share) and left.share[-1] == 0.0),
        "longest": left.longest,
        "mean_by_rate": mean,
        "mean_by_rate_error": error,
        "leaves": durations.leaves,
    }


def classes(tally: Tally) -> list[dict[str, Any]]:
    """Rows by pair of classes that were ever inside, those with most flips first."""
    stay = mean_stay(tally)
    rows = [
        {
            "first": tally.names[a], "second": tally.names[b], "entered": int(tally.entered[a, b]),
            "left": int(tally.left[a, b]), "inside": int(tally.inside[a, b]), "stay": float(stay[a, b]),
        }
        for a, b in zip(*np.nonzero(tally.inside), strict=True)
    ]  # fmt: skip
    return sorted(rows, key=lambda row: (-row["entered"] - row["left"], -row["inside"]))[:_CLASSES]


def _between(found: Strides) -> dict[str, Any]:
    said = between_frames(found)
    if said is None:
        return {"lost": None, "low": None, "high": None, "doubled": None, "says": ""}
    return dataclasses.asdict(said)
