"""Terminal output of commands: one-line errors, a JSON document, tables, and progress bars."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from mdnum.errors import InputError, MdnumError, json_escape, printable
from mdnum.plain import headed, plain
from mdnum.verbs import PARTIAL, UNDECIDED, Reply, assigned
from mdnum.verbs.progress import ProgressBar

if TYPE_CHECKING:
    from rich.console import Console

    from mdnum.report.finding import Finding
    from mdnum.report.section import Table
    from mdnum.verbs.outcome import Outcome

EXIT_FINE = 0
EXIT_FINDINGS = 1
EXIT_USAGE = 2
EXIT_UNDECIDED = 3  # time was up before a verdict
EXIT_STOPPED = 130  # what a shell reports for a process ended by control-C

_PIPE_WIDTH, _PROSE_WIDTH = 200, 100
_MAIN = threading.main_thread()
# records that are easier to read side by side than as rows
_FEW, _MANY = 3, 6
_MOST_ROWS = 12

# how a person should read a severity; the exit code is 1 for the last two
_STYLE = {"info": "dim", "ok": "green", "warning": "yellow", "error": "bold red", "unsafe": "bold red"}

JSON_OPTION = typer.Option(False, "--json", help="Print one JSON document instead of text.")


class Stopped(MdnumError):
    """Error raised if the user stops the command with control-C."""

    exit_code = EXIT_STOPPED


def parse_overrides(settings: Sequence[str] | None) -> dict[str, str]:
    """Parse the `--set key=value` options into a mapping from keys to values.

    Raises:
        InputError: an option has no "=", or a key is given twice.
    """
    overrides: dict[str, str] = {}
    for setting in settings or ():
        key, value = assigned(setting, "--set cutoff.kind=switched")
        if key in overrides:
            raise InputError(f"the key {key!r} is given twice with --set", remedy="Give each key only once")
        overrides[key] = value
    return overrides


def print_json(document: Mapping[str, Any]) -> int:
    """Print a JSON document to stdout. Return the exit code of success."""
    say(printable(json.dumps(plain(document), indent=2, ensure_ascii=False, allow_nan=False), json_escape))
    return EXIT_FINE


def print_reply(reply: Reply, as_json: bool) -> int:
    """Print the reply of a command without a run folder. Return the exit code."""
    if as_json:
        print_json(reply.document)
    for one in () if as_json else reply.shown:
        if isinstance(one, str):
            say(one)
        elif isinstance(one, tuple):
            (print_records if len(one) == 2 else print_table)(*one)
        else:
            print_findings([one])
    code = exit_code([one for one in reply.shown if hasattr(one, "severity")], reply.status)
    return EXIT_STOPPED if reply.status == "stopped" else code


def say(text: str, *, err: bool = False) -> None:
    """Print a line of text in which control characters are escaped."""
    # typer's own echo writes UTF-8 to a stream that is ascii
    print(printable(text), file=sys.stderr if err else sys.stdout, flush=True)


def print_error(error: MdnumError, *, as_json: bool) -> None:
    """Print an error as one line on stderr, and as JSON if requested."""
    say("mdnum: " + " ".join(str(error).split()), err=True)
    if as_json:
        told = {name: getattr(error, name) for name in ("message", "where", "remedy", "exit_code")}
        print_json(headed("error", {"error": {"type": type(error).__name__, **told}}))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stderr, each line with the prefix "mdnum:"."""
    for line in lines:
        say("mdnum: " + " ".join(line.split()), err=True)


def console(width: int = _PIPE_WIDTH) -> Console:
    """Return rich's console for stdout. The console escapes control characters."""
    from rich.console import Console
    from rich.segment import Segment

    class Printable(Console):
        def render(self, renderable: Any, options: Any = None) -> Iterable[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable(text), style, control)

    # no highlighting: a number is not more important for being a number; wide where nobody's window is
    # known, because a table folded to 80 columns is hard to read in a log and harder to grep
    return Printable(highlight=False, width=None if sys.stdout.isatty() else width)


def print_prose(text: str, indent: int = 2, style: str = "") -> None:
    """Print a paragraph, wrapped to a readable width. Long words are not broken."""
    from textwrap import fill

    from rich.text import Text

    out, space = console(_PROSE_WIDTH), " " * indent
    lines = fill(
        text, out.width, initial_indent=space, subsequent_indent=space, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
    out.print(Text(lines, style=style), soft_wrap=True)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table with colored severities. Without column names, the table has no header."""
    from rich.table import Table
    from rich.text import Text

    out = console()
    if title:
        out.print(Text(title, style="bold"))
    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(columns))
    for column in columns:
        # not a string, in which a unit in brackets would be markup
        table.add_column(Text(column), overflow="fold")
    for row in rows:
        table.add_row(*(Text(show(cell), style=_STYLE.get(str(cell), "")) for cell in row))
    out.print(table)


def print_records(title: str, records: Sequence[Mapping[str, Any]]) -> None:
    """Print a table of records. If few records have many fields, the table is transposed."""
    columns = list(dict.fromkeys(key for record in records for key in record))
    rows = [[record.get(column) for column in columns] for record in records]
    if len(rows) > _FEW or len(columns) <= _MANY:
        print_table(title, columns, rows)
    else:
        head, *rest = zip(columns, *rows, strict=True)
        print_table(title, [show(cell) for cell in head], rest)


def show(cell: Any) -> str:
    """Format a value for a table cell: short floats, a dash for None, yes or no for booleans."""
    if cell is None:
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.6g}"
    return str(cell)


def print_findings(findings: Iterable[Finding]) -> None:
    """Print each finding: its title and code, the observation, and the remedy."""
    from rich.text import Text

    for finding in findings:
        line = Text(finding.severity, style=_STYLE.get(finding.severity, ""))
        line.append(f": {finding.title}", style="bold")
        # the reference has an entry for each code
        line.append(f" [{finding.code}]", style="dim")
        console().print(line)
        for text in filter(None, (finding.text, finding.remedy)):
            print_prose(text)


def exit_code(findings: Iterable[Finding], status: str = "complete") -> int:
    """Return the exit code: 1 if a finding is a warning or an error.

    Args:
        findings: findings of the command; findings of severity "info" do not count.
        status: status in summary.json; see `frame.UNDECIDED`.
    """
    if any(finding.severity in ("warning", "error") for finding in findings):
        return EXIT_FINDINGS
    fine = {"complete": EXIT_FINE, PARTIAL: EXIT_FINE, UNDECIDED: EXIT_UNDECIDED}
    return fine.get(status, EXIT_FINDINGS)


def print_outcome(outcome: Outcome, *, as_json: bool) -> int:
    """Print the result of a command, as JSON or as a summary. Return the exit code."""
    code = exit_code(outcome.verdict.findings, outcome.summary.get("status", "complete"))
    if as_json:
        print_json({**outcome.summary, "folder": outcome.folder})
        return code
    out = console()
    print_prose(outcome.verdict.headline, 0, "bold")
    if outcome.page.about:
        print_prose(outcome.page.about)
    if outcome.page.keys:
        rows = [(key.label, f"{key.value}  {key.note}".rstrip()) for key in outcome.page.keys]
        print_table("", ("", ""), rows)
    for section in outcome.page.sections:
        if section.terminal:
            out.print(section.title, style="bold", markup=False)
            for part in section.parts:
                if isinstance(part, str):
                    print_prose(part)
                elif type(part).__name__ == "Table":
                    _print_part(part)
    for head in (finding for finding in outcome.verdict.findings if not finding.cause):
        print_findings([head])
        below = dict.fromkeys(one.title for one in outcome.verdict.findings if one.cause == head.code)
        if below:
            print_prose(f"What may follow from it: {'; '.join(below)}.")
    report = outcome.folder / "report.html"
    verb = "answered before, read from" if outcome.reused else "wrote"
    out.print(f"{verb} {report if report.exists() else outcome.folder}", markup=False)
    return code


def _print_part(table: Table) -> None:
    from mdnum.report.section import cell

    shown = min(table.shown, _MOST_ROWS)
    rows = [[cell(value) for value in row] for row in table.rows[:shown]]
    print_table(table.title, table.columns, rows)
    if len(table.rows) > shown:
        console().print(f"  and {len(table.rows) - shown} more, which report.html shows", markup=False)


# -- progress, and control-C


class CommandBar(ProgressBar):
    """Progress bar that makes control-C raise KeyboardInterrupt after the first progress report."""

    def __call__(self, step: int, steps: int, info: dict[str, Any]) -> None:
        """Show the progress that a run reports."""
        if signal.getsignal(signal.SIGINT) == signal.SIG_DFL and threading.current_thread() is _MAIN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        super().__call__(step, steps, info)


@contextmanager
def watched(remedy: Callable[[], str | None]) -> Iterator[ProgressBar]:
    """Show a progress bar during a command. Control-C raises `Stopped`.

    Args:
        remedy: called after control-C to get the remedy for the error message.

    Raises:
        Stopped: the user pressed control-C.
    """
    try:
        with CommandBar() as progress:
            yield progress
    except BaseException as error:
        if not is_interrupt(error):
            raise
        raise Stopped("stopped", remedy=remedy()) from None


def is_interrupt(error: BaseException | None) -> bool:
    """Return True if an error comes from control-C, even in compiled code."""
    while error is not None and not isinstance(error, KeyboardInterrupt | MdnumError):
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return isinstance(error, KeyboardInterrupt)
