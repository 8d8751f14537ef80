"""Tables of the pairs inside the cutoff and of the flips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Bool, Float, Int


class Columns:
    """Base class of tables. A table is a dataclass with columns of equal length. The first field is an array.

    A field that is not an array is one text for all rows, or None if unknown.
    """

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, rows: Any) -> Any:
        chosen = {k: v[rows] if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}
        return type(self)(**chosen)

    def equals(self, other: Columns) -> bool:
        """Return True if two tables have bitwise identical columns."""
        return all(map(np.array_equal, vars(self).values(), vars(other).values()))

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame of the known columns."""
        from pandas import DataFrame

        return DataFrame({name: column for name, column in vars(self).items() if column is not None})

    @classmethod
    def none(cls) -> Any:
        """Return a table without rows."""
        kinds = {"Int": np.int64, "Bool": bool, "Float": np.float64}
        types = [(one.name, kinds.get(str(one.type).partition("[")[0])) for one in fields(cast(Any, cls))]
        return cls(**{name: np.zeros(0, kind) for name, kind in types if kind})

    @classmethod
    def concatenate(cls, parts: Sequence[Any]) -> Any:
        """Concatenate the rows of tables. Only columns known in all tables are kept."""
        columns = {name: [vars(one)[name] for one in parts] for name in vars(parts[0])}
        others = {k: [v for v in one if not isinstance(v, np.ndarray)] for k, one in columns.items()}
        return cls(**{k: others[k][0] if others[k] else np.concatenate(one) for k, one in columns.items()})


@dataclass(frozen=True)
class Members(Columns):
    """Pairs inside the cutoff in one frame, sorted by (i, j, rank)."""

    i: Int[
        np.ndarray, "pairs"
    ]  # first atom, an index into the file's atoms; i <= j where a rule is symmetric
    j: Int[np.ndarray, "pairs"]  # second atom; i == j for an atom and an image of itself
    # 0 for the nearest image of j, 1 for the next, and so on, which wrapping an atom does not change
    rank: Int[np.ndarray, "pairs"]
    distance: Float[np.ndarray, "pairs"]  # length


@dataclass(frozen=True, kw_only=True)
class FlipTable(Columns):
    """Table with one row per flip, sorted by (step or frame, i, j, rank).

    In a run of mdnum, a flip is a change of the decision used for a pair's force. In a trajectory, flips are
    computed from the positions in each frame.
    """

    i: Int[np.ndarray, "flips"]  # the pair, as in `Members`
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]  # always 0 in a run: it decides on the nearest image alone
    entered: Bool[np.ndarray, "flips"]  # whether the pair is inside from now on
    distance: Float[np.ndarray, "flips"]  # now, length
    # signed distance to the threshold now, positive inside: in the quantity's space in a run (r or r²), else
    # a length; and how far it can be off by rounding, and by the resolution of a file
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]
    ambiguous: Bool[np.ndarray, "flips"]  # a margin is within the bound: it may have been decided otherwise
    decided_by: Literal["program", "positions"] = "positions"
    # None where it is not known: the step of a run; the position among the frames examined, which is not the
    # number in the file and never 0; distance (length) and margin at the frame before, nan for a pair that
    # was nowhere near; radial speed (length per the user's time); what the flip adds to the energy, and to
    # the force between the two; and, in a run whose box moves, what its last deformation did to the distance
    step: Int[np.ndarray, "flips"] | Any = None
    frame: Int[np.ndarray, "flips"] | Any = None
    before: Float[np.ndarray, "flips"] | Any = None
    margin_before: Float[np.ndarray, "flips"] | Any = None
    radial_speed: Float[np.ndarray, "flips"] | Any = None
    energy_jump: Float[np.ndarray, "flips"] | Any = None
    force_jump: Float[np.ndarray, "flips"] | Any = None
    by_box: Float[np.ndarray, "flips"] | Any = None

    def columns(self, rule: int = 0) -> dict[str, Any]:
        """Return the known columns, named as in flips.parquet, and a column of rule indices."""
        known = {name: column for name, column in vars(self).items() if column is not None}
        return {"rule": np.broadcast_to(np.int32(rule), len(self)), **known}
