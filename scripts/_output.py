"""What the studies share: how they are started, what they print, and how their figures look."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from mdnum.errors import MdnumError

# Okabe and Ito's palette: told apart by people who do not see all colors
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

# matplotlib types its names one by one
_STYLE: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLORS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.dpi": 160,
}


def parser(about: str | None, script: str | None = None) -> argparse.ArgumentParser:
    """A command line with the script's docstring as its help, and -o for the figure of one that draws.

    Args:
        about: the script's docstring.
        script: its __file__ where it draws a figure, which is called after it by default.
    """
    made = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if script is not None:
        default = Path(f"{Path(script).stem}.png")
        made.add_argument(
            "-o", "--output", type=Path, default=default, metavar="FILE",
            help=f"the figure, PNG, SVG or PDF (default {default})",
        )  # fmt: skip
    return made


def start(main: Callable[[], None]) -> None:
    """Run a script; an error that mdnum raised on purpose is one line and an exit code."""
    try:
        main()
    except MdnumError as error:
        say(str(error))
        sys.exit(error.exit_code)


def say(text: str) -> None:
    """A line of progress, on stderr."""
    print(text, file=sys.stderr, flush=True)


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]], *, words: int = 1) -> None:
    """A table on stdout; the first columns are words, the others are numbers and stand right.

    Args:
        words: how many columns are words.
    """
    made = Table(title=title, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index < words else "right")
    for row in rows:
        made.add_row(*(_cell(value) for value in row))
    # a table folded to 80 columns is hard to read in a log
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 160
    Console(highlight=False, markup=False, width=width).print(made)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def figure(width: float = 8.0, height: float = 5.0) -> Figure:
    """An empty figure in the style of the studies."""
    mpl.rcParams.update(_STYLE)
    return Figure(figsize=(width, height), layout="constrained")


def save(drawn: Figure, path: Path) -> None:
    """Write a figure and say where."""
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path)
    say(f"figure: {path}")
