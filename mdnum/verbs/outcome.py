"""Return value of every command."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mdnum.errors import FolderError, InputError, MdnumError, printable
from mdnum.report.finding import Finding, Verdict
from mdnum.report.section import Figure, Key, Page, Plot

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class Outcome:
    """Summary and verdict of a command, with methods for its tables and figures.

    An outcome can be pickled and returned by worker processes. Do not move the output folder: tables and
    figures are read on first use.

    Example:
        >>> outcome = mdnum.run("argon/crystal-108", steps=200)
        >>> outcome.verdict.headline, outcome.summary["flips_entered"]
        >>> outcome.table("flips").to_pandas()
        >>> outcome.plot("energy").figure.savefig("energy.png")
        >>> outcome = mdnum.read("runs/argon-crystal-108-1")
    """

    path: Path  # the folder
    kind: str  # of the folder: "md", "fork", "screen", "grad", ...
    verb: str  # of the command line that writes folders of this kind
    title: str  # of the page
    summary: Mapping[str, Any]  # content of summary.json: numbers, findings, headline and verdict
    verdict: Verdict
    keys: tuple[Key, ...] = ()  # the numbers above the page
    # what the verb computed, as Python has it; None in another process, in a copy and where a folder was read
    result: Any = field(default=None, compare=False)
    _page: Page | None = field(default=None, compare=False)
    _read: Any = field(default=None, compare=False)  # the function `mdnum.read`, which knows all verbs
    reused: bool = field(default=False, compare=False)  # read: the question had been answered
    _place: Path = field(init=False, compare=False)

    def __post_init__(self) -> None:
        # it is found from another working directory, too
        object.__setattr__(self, "_place", self.path.absolute())

    @property
    def folder(self) -> Path:
        """Path of the output folder; equal to the attribute `path`."""
        return self.path

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the result (errors, warnings and notes), errors first."""
        return self.verdict.findings

    @property
    def page(self) -> Page:
        """Content of report.html and of the terminal output. Raises FolderError if the folder is missing."""
        if self._page is None:
            object.__setattr__(self, "_page", self._read(self._place).page)
        return cast(Page, self._page)

    def table(self, name: str) -> pa.Table:
        """Return a table of the output folder. `.to_pandas()` converts the table to a data frame.

        Raises:
            FolderError: no table has this name (the message lists all tables), or the table is damaged.
        """
        from mdnum.store import RunFolder

        folder = RunFolder.open(self._place)
        with folder.explained():
            folder.check(f"{name}.parquet")
            parts = {file.stem.rpartition("-")[0] for file in self._place.glob("parts/*.parquet")}
            names = sorted(parts | {file.stem for file in self._place.glob("*.parquet")})
            if name not in names:
                has = f"Its tables: {', '.join(names)}" if names else "It has no tables"
                raise FolderError(f"the result has no table {name!r}", remedy=has, where=str(self.path))
            return folder.table(name)

    def plot(self, name: str) -> Axes:
        """Draw a figure of the page as a new pyplot figure. `name` is the name of a file in figures/.

        Returns:
            the matplotlib axes, or the first axes if there are several; `.figure.axes` lists all axes.

        Raises:
            InputError: no figure has this name (the message lists all figures).
        """
        from matplotlib import pyplot

        from mdnum.report import drawing

        parts = [part for section in self.page.sections for part in section.parts]
        figures = {part.name: part for part in parts if isinstance(part, Figure | Plot)}
        if name not in figures:
            has = f"Its figures: {', '.join(figures)}" if figures else "It has none"
            raise InputError(f"the page has no figure {name!r}", remedy=has, where=str(self.path))
        drawn = drawing.draw(figures[name])
        drawn.set_facecolor(drawing.LIGHT["paper"])
        made: Any = lambda **_: drawn  # noqa: E731
        return pyplot.figure(FigureClass=made).axes[0]

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "path": self._place, "result": None, "_page": None}

    def __repr__(self) -> str:
        shown = [key for key in self.keys if key.value != "–"][:6]
        numbers = [f"{key.label}: {key.value}" + f" ({key.note})" * bool(key.note) for key in shown]
        head = f"mdnum {self.verb}: {self.title}", f"{self.verdict.tone}: {self.verdict.headline}"
        lines = (" ".join(printable(line).split()) for line in (*head, *numbers))
        short = (line if len(line) <= 300 else f"{line[:300]}…" for line in lines)
        where = f"{'answered before, read from ' * self.reused}{self.path}"
        return "\n  ".join([*short, printable(where)])

    def _repr_html_(self) -> str:
        from mdnum.report.page import brief

        page = Page(self.title, keys=self.keys)
        with suppress(MdnumError, OSError):  # of a folder that is gone, what is known of it
            page = self.page
        return brief(page, self.verdict, self._place, self.verb)
