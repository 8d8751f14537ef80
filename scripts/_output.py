"""What scripts share: how they are started, and what they print."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from mdnum.errors import MdnumError


def parser(about: str | None) -> argparse.ArgumentParser:
    """A command line with the script's docstring as its help."""
    return argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)


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
