"""What a report reads of a comparison: a fork folder, loaded once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mdnum import units
from mdnum.errors import FolderError
from mdnum.store import RunFolder
from mdnum.units import Units

#: Rows of a table that are loaded.
ROWS_LOADED = 2_000_000


@dataclass(frozen=True)
class ForkFolder:
    """A fork folder on the host.

    Attributes:
        summary, system, provenance: as written.
        series: a row per step, arrays by column name; empty where choices were screened.
        flips: cross-run flips, likewise.
        around: the atoms at the fork, likewise; the deciding pair comes first.
    """

    path: Path
    summary: Mapping[str, Any]
    system: Mapping[str, Any]
    system_toml: str
    provenance: Mapping[str, Any]
    series: Mapping[str, np.ndarray]
    flips: Mapping[str, np.ndarray]
    around: Mapping[str, np.ndarray]

    @property
    def name(self) -> str:
        """The system's name."""
        return str(self.summary.get("system") or self.path.name)

    @property
    def screened(self) -> bool:
        """Whether all choices were screened, rather than one followed."""
        return "ranking" in self.summary

    @property
    def ranking(self) -> Sequence[Mapping[str, Any]]:
        """Choices that were screened, the earliest fork first."""
        return self.summary.get("ranking") or ()

    @cached_property
    def units(self) -> Units:
        """The unit system of all numbers in the folder."""
        return units.get(str(self.summary.get("units") or "lj"))

    @property
    def steps(self) -> int:
        """Steps that were followed."""
        return int(self.summary.get("steps") or 0)

    @property
    def word(self) -> str:
        """The verdict."""
        word = str(self.summary.get("verdict") or "")
        # as folders of older versions have it
        return "accelerated" if word == "hurried" else word

    @property
    def decision(self) -> Mapping[str, Any] | None:
        """The decision at the fork."""
        return self.summary.get("decision")

    @property
    def dates(self) -> dict[str, int]:
        """Seed, fork and split, those that there are."""
        return {
            name: int(self.summary[name])
            for name in ("seed", "fork", "split")
            if self.summary.get(name) is not None
        }

    @property
    def repeats(self) -> list[str]:
        """Columns of the repeats."""
        return [name for name in self.series if name.startswith("repeat_")]

    def has(self, name: str) -> bool:
        """Whether a column holds a number."""
        values = self.series.get(name)
        return values is not None and bool(np.isfinite(values).any())


def load(folder: RunFolder | str | Path) -> ForkFolder:
    """Loads a fork folder.

    Raises:
        FolderError: it holds no comparison.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    summary = folder.summary
    if summary.get("world") != "fork":
        raise FolderError(
            "holds no finished comparison", remedy="Run `mdnum fork` again", where=str(folder.path)
        )
    return ForkFolder(
        path=folder.path,
        summary=summary,
        system=folder.system,
        system_toml=folder.system_toml,
        provenance=folder.provenance,
        series=folder.read("separation"),
        flips=folder.read("cross_flips", rows=ROWS_LOADED),
        around=folder.read("neighborhood"),
    )
