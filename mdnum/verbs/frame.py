"""Functions common to all verbs (the commands of mdnum).

The module of a verb contains three functions. A function with the verb's name fills an output folder. `judge`
returns the folder's findings and a headline, `page` the sections of its page. The sentences are in a text
file named after the module. A module declares its verb in one line:

    KINDS = {"flips": Verb(judge, page)}

"flips" is the kind of output folder, declared in the text file under [kinds.flips]. `judge` and `page` read
only the folder. A page can thus be written again later.
"""

from __future__ import annotations

import functools
import inspect
import json
import logging
import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, cast

import numpy as np

from mdnum import units
from mdnum.errors import FolderError, InputError, printable
from mdnum.plain import plain
from mdnum.registry import meant
from mdnum.report.finding import Finding, Verdict, restore
from mdnum.report.section import Key, Page, Section
from mdnum.report.words import number
from mdnum.store import Layout, RunFolder
from mdnum.store import files as manifest
from mdnum.store.files import default_folder, digest, digest_of, read_text
from mdnum.systems import code
from mdnum.verbs import PARTIAL as PARTIAL
from mdnum.verbs import UNDECIDED as UNDECIDED
from mdnum.verbs import VERBS, declared, home, schema
from mdnum.verbs.outcome import Outcome
from mdnum.verbs.progress import Progress as Progress
from mdnum.verbs.progress import Wanted, reported
from mdnum.version import __version__

if TYPE_CHECKING:
    from mdnum.units import Units

V = TypeVar("V", bound=Callable[..., Any])
_LOGGER = logging.getLogger(__name__)

#: Approximate number of lines in log.txt for a phase that counts its steps.
STEPWISE = 50


@dataclass(frozen=True)
class View:
    """Read access to an output folder, for findings and pages."""

    folder: RunFolder  # on disk
    summary: dict[str, Any]  # as written, without what was judged
    _tables: dict[str, Mapping[str, np.ndarray]] = field(default_factory=dict, repr=False)
    pictures: dict[str, str] = field(default_factory=dict, repr=False)  # figures drawn before the page was

    @property
    def name(self) -> str:
        """Name of the system or other object that was examined."""
        return str(self.summary.get("system") or self.summary.get("name") or self.folder.path.name)

    @cached_property
    def system(self) -> Mapping[str, Any]:
        """Tables in the system file of the run. Empty if there is no system."""
        return self.folder.system

    @cached_property
    def units(self) -> Units:
        """Unit system of all numbers in the folder."""
        return units.get(str(self.summary.get("units") or self.system.get("units") or "lj"))

    @property
    def took(self) -> tuple[str, str]:
        """Table row with the duration of the computation."""
        return "Took", f"{number(self.summary['seconds'], 2)} s"

    def table(self, name: str) -> Mapping[str, np.ndarray]:
        """Return a table of the output folder, as arrays by column name."""
        if name not in self._tables:
            self._tables[name] = self.folder.read(name)
        return self._tables[name]

    def kept(self, codes: Mapping[str, Any]) -> list[Finding]:
        """Return the stored findings whose codes are not in `codes`."""
        found = self.summary.get("findings") or ()
        return [restore(each) for each in found if each.get("code") not in codes]

    def page(self, title: str, about: str, keys: Iterable[Key], sections: Iterable[Section]) -> Page:
        """Return the report page of the folder. Empty sections are omitted."""
        kept = [section for section in sections if section.parts]
        file = self.folder.system_file
        what = ("", "") if file is None else (file.name, read_text(file))
        return Page(title, about, list(keys), kept, *what, self.folder.provenance, self.pictures)


@dataclass(frozen=True)
class Verb:
    """Functions that judge and show one kind of output folder."""

    judge: Callable[[Any], Verdict]  # findings and headline, from the folder alone
    page: Callable[[Any, Verdict], Page]  # everything else that is shown
    view: type[View] = View  # how they read the folder
    unfinished: bool = False  # whether a folder without a summary can be judged (a run that was killed can)


class Interrupted(KeyboardInterrupt):
    """Raised if control-C was pressed after results were stored. `outcome` contains the results."""

    def __init__(self, outcome: Outcome):
        super().__init__(outcome)
        self.outcome = outcome


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after control-C. A second control-C raises KeyboardInterrupt.

    Python delivers signals only to the main thread. In other threads, the function returns False.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return
    before = signal.getsignal(signal.SIGINT)

    def ask(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        asked.set()

    signal.signal(signal.SIGINT, ask)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def end_on_sigterm(stack: ExitStack) -> None:
    """Treat SIGTERM like control-C until `stack` is closed, so that results are stored. Main thread only."""
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        stack.callback(signal.signal, signal.SIGTERM, before)


class Keep(TypedDict, total=False):
    """Keyword arguments common to all functions of `mdnum` that run a system."""

    # the new folder; default runs/<verb>-<name>-<n>; "{content}" in it becomes a digest of what is asked, and
    # a folder of that name which is finished is read
    out: str | Path | None
    # dotted keys of the system file to values, such as {"cutoff.kind": "switched"}
    overrides: Mapping[str, Any] | None
    report: bool  # write report.html; default True
    # called now and then with what is done, of how much, and a dictionary that names the phase; default a
    # bar, or a line now and then where stderr is no terminal; False for nothing
    progress: Wanted
    allow_code: bool  # whether Python that the system file names may be executed; default False


class UnknownKeyword(InputError, TypeError):
    """Raised if a public function gets an unknown keyword argument."""


def keywords_checked(verb: V, more: Iterable[str] = (), name: str = "") -> V:
    """Make a public function reject unknown keyword arguments.

    A misspelled keyword in `**keep` would otherwise raise an error only when the output folder is made. Until
    then, the function would use the default value of the misspelled option.

    Args:
        more: names of keywords that the verb passes on in addition to those of `Keep`.
        name: public name of the verb, if it differs from the function's name.

    Raises:
        UnknownKeyword: with the closest known keyword, and a list of all.
    """
    parameters = inspect.signature(verb).parameters.values()
    known = [one.name for one in parameters if one.kind is not one.VAR_KEYWORD]
    if len(known) < len(parameters):
        known += [*Keep.__annotations__, *more]

    @functools.wraps(verb)
    def checked(*args: Any, allow_code: bool = False, progress: Wanted = None, **kwargs: Any) -> Any:
        for word in kwargs:
            if word not in known:
                message = f"{name or verb.__name__}() has no keyword {word!r}"
                raise UnknownKeyword(message, remedy=f"{meant(word, known)}It takes {', '.join(known)}")
        with code.allow_code(allow_code), reported(progress) as report_to:
            if "{content}" in str(kwargs.get("out")):
                asked = inspect.signature(verb).bind_partial(*args, **kwargs)
                asked.apply_defaults()
                digits = content(name or verb.__name__, asked.arguments)
                out = kwargs["out"] = str(kwargs["out"]).replace("{content}", digits)
                made = manifest.load(Path(out))
                status = RunFolder.open(out).summary.get("status") if made and made.finished else "unfinished"
                if status not in ("stopped", "unfinished"):
                    _LOGGER.info("answered before, read from %s", printable(out))
                    report = kwargs.get("report", True) and not Path(out, "report.html").exists()
                    return replace(finish(out, report=report, write=False), reused=True)
            return verb(*args, progress=report_to, **kwargs)

    return cast(V, checked)


def content(verb: str, asked: Mapping[str, Any]) -> str:
    """Return a digest of the arguments of a verb: 16 hexadecimal digits, the same in every process.

    The digest covers the content of systems and files, the manifest of a run folder, and all other arguments.
    The version of mdnum is also included.

    Raises:
        InputError: an argument has no plain value, such as a function.
    """
    from mdnum.provenance import hashes
    from mdnum.systems import opened

    def value(one: Any) -> Any:
        if not isinstance(one, str | Path) or not str(one):
            return plain(one)
        place = Path(re.split("[@:]", str(one))[0])
        file = place / "manifest.json" if place.is_dir() else place
        return [str(one).removeprefix(str(place)), digest(file)] if file.is_file() else str(one)

    values = {**asked, **asked.get("keep", {}), **asked.get("asked", {})}
    for name in ("keep", "asked", "out", "report", "progress", "on", "workers"):
        values.pop(name, None)
    try:
        if values.get("system") is not None:
            system = opened(values["system"], values.pop("overrides", None))
            values["system"] = {**hashes(system), "file": None}
        held = {name: value(one) for name, one in values.items()}
        text = json.dumps([__version__, verb, held], sort_keys=True)
    except TypeError as error:
        raise InputError(
            f"no name for the result folder can be derived from the input: {error}",
            remedy="Give a name for the folder with --out",
        ) from error
    return digest_of(text.encode())[:16]


@dataclass
class Answer:
    """Output folder that is being filled."""

    folder: RunFolder  # that is filled
    log: Progress  # passes progress on and writes it to log.txt
    summary: dict[str, Any] = field(default_factory=dict)  # of summary.json, anything with plain values
    tables: dict[str, Any] = field(default_factory=dict)  # as `store` takes them
    result: Any = None  # for who asked from Python
    outcome: Outcome = field(init=False)  # judged and shown, once it is filled


@contextmanager
def answering(
    kind: str,
    name: str,
    system: Any = None,
    *,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
    allow_code: bool = False,
) -> Iterator[Answer]:
    """Context manager for a new output folder. On exit, the results are stored, judged and shown.

    Args:
        kind, name, system: as for `new_folder`.
        overrides, allow_code: already applied to the system.
        out, report, progress: see `Keep`; explicit arguments, so that misspelled names raise an error.

    Raises:
        InputError: overrides were given without a system. FolderError: the folder cannot be used.
    """
    if overrides and system is None:
        raise InputError("overrides were given without a system to change", remedy="Omit the overrides")
    began = perf_counter()
    with new_folder(kind, name, out, system=system) as folder:
        answer = Answer(folder, logged(folder, progress, STEPWISE))
        yield answer
        store(folder, {"seconds": perf_counter() - began, **answer.summary}, answer.tables)
    answer.outcome = finish(folder, report=report, result=answer.result, progress=progress)


def layout(kind: str) -> Layout:
    """Return the tables and columns of a kind of folder, from its verb's text file.

    Raises:
        InputError: no installed verb declares the kind.
    """
    name = home(kind)
    # a column of another package means what that package says, whatever mdnum calls so
    described = None if VERBS.package(name) == "mdnum" else {}
    return Layout(kind, **{"described": described, **declared(name)["kinds"][kind]})


@contextmanager
def new_folder(
    kind: str, name: str, out: str | Path | None = None, *, system: Any = None
) -> Iterator[RunFolder]:
    """Context manager for a new output folder with the system and its provenance.

    Args:
        kind: kind of the folder, which a verb declares.
        name: the folder is runs/<name>-<n> if out is None.
        system: the simulated system, with `write(path)`; None for a verb without a system.

    Raises:
        FolderError: the folder cannot be used.
    """
    from mdnum.provenance import collect, surroundings

    held = layout(kind)
    folder = RunFolder.create(default_folder(name) if out is None else out, held)
    try:
        if system is not None:
            system.write(folder.path)
        folder.write_provenance(collect(system) if system is not None else surroundings())
        yield folder
    finally:
        # of a folder that was filled nothing is open any more
        folder.close()


def finish(
    folder: RunFolder | str | Path,
    *,
    report: bool = True,
    result: Any = None,
    progress: Progress | None = None,
    view: View | None = None,
    write: bool = True,
) -> Outcome:
    """Judge a folder. Add the findings to summary.json, and write the report page.

    Args:
        result: result of the verb's computation, for a caller in Python.
        view: view of the folder, if the folder has already been read.
        write: False leaves the folder unchanged.

    Raises:
        FolderError: the folder holds no result, is damaged or cannot be written.
    """
    folder = folder if isinstance(folder, RunFolder) else RunFolder.open(folder)
    folder.read_as(layout(folder.kind))
    verb = VERBS[home(folder.kind)].KINDS[folder.kind]
    say(progress, "report" if report else "check")
    with folder.explained():
        summary = folder.summary if view is None else view.summary
        if not summary and not verb.unfinished:
            raise FolderError(
                f"the folder holds no result: `mdnum {folder.layout.command}` was stopped before it finished",
                remedy=folder.again, where=str(folder.path),
            )  # fmt: skip
        view = verb.view(folder, summary) if view is None else view
        verdict = verb.judge(view)
        judged = plain(verdict.judged(folder.kind, summary))
        judged["schema"] = schema(folder.kind)["$id"]
        if write:
            folder.write_summary(judged)
        page = verb.page(view, verdict)
        if report:
            from mdnum.report.page import write as write_page

            write_page(folder, page, verdict)
    if write:
        for finding in verdict.findings:
            level = logging.getLevelNamesMapping()[finding.severity.upper()]
            _LOGGER.log(level, "%s: %s", finding.code, printable(finding.title))
        where = printable(str(folder.path))
        _LOGGER.info("%s: %s (%s)", folder.layout.command, printable(verdict.headline), where)
    named = (folder.path, folder.kind, folder.layout.command, page.title)
    return Outcome(*named, judged, verdict, tuple(page.keys), result, page, read)


def read(folder: str | Path) -> Outcome:
    """Return the outcome stored in an output folder. Judge the results again, but write nothing.

    Example:
        >>> mdnum.read("runs/argon-crystal-108-1").table("flips")

    Raises:
        FolderError: the folder holds no result, or is damaged.
    """
    return finish(folder, report=False, write=False)


def say(progress: Progress | None, phase: str, step: int = 0, steps: int = 0, **counts: Any) -> None:
    """Call the progress function, if there is one."""
    if progress is not None:
        progress(step, steps, {"phase": phase, **counts})


def store(folder: RunFolder, summary: Mapping[str, Any], tables: Mapping[str, Any]) -> None:
    """Write all tables and then the summary of an output folder.

    Args:
        summary: a mapping of plain values, dataclasses and arrays included.
        tables: for each table, arrays of equal length by column name, or rows; tables of the kind without
            rows may be omitted.
    """
    for name, columns in tables.items():
        if not isinstance(columns, Mapping):
            columns = {key: [row[key] for row in columns] for key in columns[0]} if columns else {}
        if columns:
            folder.append(name, columns)
    folder.finalize()
    folder.write_summary(plain(summary))


def words(texts: Sequence[str] | str) -> tuple[str, ...]:
    """Return the distinct words of one or several texts, joined by commas."""
    texts = (texts,) if isinstance(texts, str) else texts
    return tuple(dict.fromkeys(word.strip() for text in texts for word in text.split(",") if word.strip()))


def refuse(given: Mapping[str, bool], whose: str, remedy: str) -> None:
    """Raise an error if options were given that would have no effect.

    Args:
        given: for each option, whether it was given.
        whose: use of these options: "of one comparison, and all choices were asked for".

    Raises:
        InputError: at least one of the options was given.
    """
    names = [name for name, present in given.items() if present]
    if names:
        what = "is an option" if len(names) == 1 else "are options"
        raise InputError(f"{' and '.join(names)} {what} {whose}", remedy=remedy)


def logged(folder: RunFolder, progress: Progress | None, lines: int = 10) -> Progress:
    """Return a progress function that also writes to log.txt.

    Args:
        lines: approximate number of lines for a phase that counts its steps.
    """
    last = ("", -1)

    def report(step: int, steps: int, info: dict[str, Any]) -> None:
        nonlocal last
        now = str(info.get("phase", "run")), lines * step // steps if steps else 0
        if now != last:
            size = f", separation {info['separation']:.6e}" if "separation" in info else ""
            counted = f": {step:,} of {steps:,} {info.get('unit', 'steps')}{size}" if steps else ""
            folder.log(now[0] + counted)
            last = now
        if progress is not None:
            progress(step, steps, info)

    return report
