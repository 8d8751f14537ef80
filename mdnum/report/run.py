"""What a report reads: a run folder, loaded once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum import units
from mdnum.errors import FolderError
from mdnum.report import analysis
from mdnum.store import RunFolder
from mdnum.units import Units

#: Rows of the flip table that the page carries: those nearest to their threshold.
TABLE_ROWS = 5_000


@dataclass(frozen=True)
class Run:
    """A run folder's content on the host.

    Attributes:
        summary, system, provenance: as written.
        series, epochs: arrays by column name.
        flips: what the table of flips says, which may be larger than memory.
    """

    path: Path
    summary: Mapping[str, Any]
    system: Mapping[str, Any]
    system_toml: str
    provenance: Mapping[str, Any]
    series: Mapping[str, np.ndarray]
    epochs: Mapping[str, np.ndarray]
    flips: analysis.Scan

    @property
    def name(self) -> str:
        """The system's name."""
        return str(self.summary.get("system") or self.path.name)

    @property
    def steps(self) -> int:
        """Steps made."""
        return max(0, len(self.series["step"]) - 1)

    @cached_property
    def units(self) -> Units:
        """The unit system of all numbers in the folder."""
        return units.get(str(self.summary.get("units") or self.system.get("units") or "lj"))

    @property
    def cutoff(self) -> Mapping[str, Any]:
        """Kind, radius, comparison, jumps; empty where there is none."""
        return self.summary.get("cutoff") or {}

    @property
    def conservative(self) -> bool:
        """Whether the total energy should stay what it was."""
        return (self.system.get("dynamics") or {}).get("kind", "nve") == "nve"

    @property
    def flips_total(self) -> int:
        """All flips in the table."""
        return self.flips.total

    @property
    def stays(self) -> analysis.Stays:
        """Residence times of pairs on either side of the cutoff."""
        return self.flips.stays

    @property
    def margins(self) -> Float[np.ndarray, "flips"]:
        """|margin| of each flip in units of its rounding bound."""
        return self.flips.ratios

    @cached_property
    def busiest(self) -> analysis.PairCounts:
        """Pairs by the number of their flips, most first."""
        return self.flips.busiest

    @cached_property
    def expected_ambiguous(self) -> float:
        """Flips that one expects within their rounding bound."""
        return analysis.expected_ambiguous(self.margins)

    @cached_property
    def budget(self) -> dict[str, np.ndarray]:
        """Energy against time: its change, the ledger's jumps summed, and what is left between the two."""
        conserved = self.series["conserved"]
        change = conserved - conserved[0] if len(conserved) else conserved
        jumps = np.cumsum(self.series["energy_jump"])
        return {"change": change, "jumps": jumps, "residual": change - jumps}


def load(folder: RunFolder | str | Path) -> Run:
    """Loads a run folder, finished or not.

    Raises:
        FolderError: it holds no run, or no step of one.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder.open(folder)
    series = folder.read("series")
    if not len(series["step"]):
        raise FolderError("holds no step of a run", remedy=folder.again, where=str(folder.path))
    return Run(
        path=folder.path,
        summary=folder.summary,
        system=folder.system,
        system_toml=folder.system_toml,
        provenance=folder.provenance,
        series=series,
        epochs=folder.read("epochs"),
        flips=_flips(folder, len(series["step"])),
    )


_COLUMNS = ("step", "i", "j", "entered", "distance", "margin", "radial_speed", "energy_jump", "bound")


def _flips(folder: RunFolder, steps: int) -> analysis.Scan:
    seen = analysis.Scan(steps, TABLE_ROWS)
    for batch in folder.batches("flips", _COLUMNS):
        seen.take({name: batch[name].to_numpy() for name in _COLUMNS})
    if not seen.nearest:
        seen.take(folder.read("flips", _COLUMNS, rows=1))
    return seen
