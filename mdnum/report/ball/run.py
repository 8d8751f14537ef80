"""What a report reads of a bouncing ball: a run folder, loaded once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import FolderError
from mdnum.store import RunFolder

#: Rows of a table that are loaded; counts per step come from the steps and cover all of them.
ROWS_LOADED = 2_000_000

#: Columns that the report names; a table that was not written is empty.
_COLUMNS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "contacts": ("step", "ball", "entered", "height", "margin", "velocity", "bound", "ambiguous"),
        "solver": ("step", "ball", "iteration", "residual", "margin", "stopped", "reason"),
        "heights": ("step", "ball", "y", "v"),
        "separations": ("variant", "step", "separation"),
    }
)


@dataclass(frozen=True)
class BallFolder:
    """A ball's run folder on the host.

    Attributes:
        summary, system, provenance: as written.
        series: a row per step, arrays by column name.
        contacts, solver, heights: likewise; the first `ROWS_LOADED` of them.
        separations: largest difference of heights from each variant, by step; empty where not written.
        rows: all rows of each table.
    """

    path: Path
    summary: Mapping[str, Any]
    system: Mapping[str, Any]
    system_toml: str
    provenance: Mapping[str, Any]
    series: Mapping[str, np.ndarray]
    contacts: Mapping[str, np.ndarray]
    solver: Mapping[str, np.ndarray]
    heights: Mapping[str, np.ndarray]
    separations: Mapping[str, np.ndarray]
    rows: Mapping[str, int]

    @property
    def name(self) -> str:
        """The system's name."""
        return str(self.summary.get("system") or self.path.name)

    @property
    def steps(self) -> int:
        """Steps made."""
        return int(self.series["step"][-1])

    @property
    def balls(self) -> int:
        """Balls in the batch."""
        return int(self.summary.get("balls") or 1)

    @property
    def located(self) -> bool:
        """Whether impacts are located inside a step: what is counted are impacts, not iterations."""
        return self.summary.get("integrator") == "event-located"

    @property
    def gradient(self) -> Sequence[Mapping[str, Any]]:
        """Derivatives by method, those that were refused left out."""
        return [made for made in self.summary.get("gradient") or () if not made.get("refused")]

    @property
    def refused(self) -> Sequence[Mapping[str, Any]]:
        """Methods that do not apply to this problem, with the reason in `says`."""
        return [made for made in self.summary.get("gradient") or () if made.get("refused")]

    @property
    def parameters(self) -> list[str]:
        """Parameters that there is a derivative for, in the order asked."""
        return list(dict.fromkeys(name for made in self.gradient for name in made.get("gradient") or {}))

    @property
    def variants(self) -> Sequence[Mapping[str, Any]]:
        """The comparisons with variants."""
        return self.summary.get("variants") or ()

    @property
    def exact(self) -> Mapping[str, Any]:
        """Errors against the closed form; empty where there is none."""
        return self.summary.get("exact") or {}

    @property
    def ended(self) -> dict[str, int]:
        """How many solves ended for which reason; none where nothing is solved."""
        ended = self.summary.get("ended")
        if ended is None:
            words, counts = np.unique(self.series["reason"].astype(str), return_counts=True)
            ended = dict(zip(words.tolist(), counts.tolist(), strict=True))
        return {str(word).replace("_", " "): int(n) for word, n in ended.items() if n and word != "none"}

    @cached_property
    def margins(self) -> Float[np.ndarray, "flips"]:
        """|margin| of each contact flip in units of its rounding bound."""
        margin, bound = np.abs(self.contacts["margin"]), self.contacts["bound"]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = margin / bound
        return np.where(bound > 0, ratio, np.where(margin > 0, np.inf, 0.0))

    def time(self, step: np.ndarray) -> Float[np.ndarray, "..."]:
        """Time of steps, s."""
        return np.interp(step, self.series["step"], self.series["time"])


def load(folder: RunFolder | str | Path) -> BallFolder:
    """Loads a ball's run folder.

    Raises:
        FolderError: it holds no run of a ball, or no step of one.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    series = folder.read("steps")
    if not len(series.get("step", ())):
        raise FolderError("holds no step of a ball’s run", remedy="Run again", where=str(folder.path))
    return BallFolder(
        path=folder.path,
        summary=folder.summary,
        system=folder.system,
        system_toml=folder.system_toml,
        provenance=folder.provenance,
        series=series,
        contacts=_table(folder, "contacts"),
        solver=_table(folder, "solver"),
        heights=_table(folder, "heights"),
        separations=_table(folder, "separations"),
        rows={name: folder.rows(name) for name in _COLUMNS},
    )


def _table(folder: RunFolder, name: str) -> dict[str, np.ndarray]:
    columns = folder.read(name, rows=ROWS_LOADED) if folder.rows(name) else {}
    return {column: columns.get(column, np.zeros(0)) for column in _COLUMNS[name]} | columns
