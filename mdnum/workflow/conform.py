"""`mdnum conform` as a function: a neighbor list through the conformance suite, into a folder."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import FolderError, InputError
from mdnum.store import RunFolder, expect, manifest, restoring
from mdnum.store.atomic import read_text, write_text
from mdnum.store.naming import default_folder
from mdnum.workflow.fork_question import Log, Progress, finish

if TYPE_CHECKING:
    from mdnum.references.conformance.answers import Answers
    from mdnum.references.conformance.lists import PairList
    from mdnum.references.conformance.suite import Report

#: Roundoff by the word for it.
PRECISIONS = {"float64": 2.0**-53, "float32": 2.0**-24}
#: Words of `limits`, and the limit that each of them is.
LIMITS = {
    "minimum-image": "minimum_image",
    "orthorhombic": "orthorhombic",
    "along-axes": "along_axes",
    "all-axes": "all_axes",
    "periodic": "periodic",
    "free": "free",
    "wrapped": "wrapped",
    "fixed-cell": "fixed_cell",
    "right-handed": "right_handed",
    "lower-triangular": "lower",
    "whole-cell": "whole_cell",
}
#: Random cases that can be asked for: they are drawn before the first is asked, some 300 a second.
MOST_CASES = 100_000
#: What a function, and a list that is kept, are to do.
_RETURNS = "(i, j), (i, j, shift), (i, j, shift, distance) or a mapping with i and j: an entry for each pair"
_CONTRACT = {
    False: f"Give a function of (positions, cell, pbc, r_cut) that returns {_RETURNS}",
    True: f"Let allocate and update return {_RETURNS}",
}


@dataclass(frozen=True)
class ConformResult:
    """A finished examination.

    Attributes:
        folder: the conform folder.
        report: what was asked, what failed, and the conventions that were found out.
        summary: what summary.json says, findings included.
    """

    folder: Path
    report: Report
    summary: dict[str, Any]


def conform(
    pairs: str | Callable[..., Any] | PairList | None = None,
    *,
    cases: int | None = None,
    seed: int = 0,
    large: bool = True,
    full: bool | None = None,
    precision: str | None = None,
    superset: bool | None = None,
    limits: tuple[str, ...] = (),
    time: float | None = None,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ConformResult:
    """Put a neighbor list through the conformance suite.

    The folder is filled as answers come: one that was stopped, however, is gone on with by `resume`.

    Args:
        pairs: a name (`references.conformance.known`), `package.module:function`, `file.py:function`, or a
            function of (positions, cell, pbc, r_cut) that returns (i, j), (i, j, shift), (i, j, shift,
            distance) or a mapping; or a class with `allocate` and `update`. What has a name is called in a
            process of its own, so that a crash is a finding. With `resume`, the list that was examined, where
            it had no name; else none.
        cases: random cases beside those with a name, `MOST_CASES` at most; 500 by default.
        seed: of the random ones.
        large: ask about 5,000 and 100,000 atoms, too.
        full: every pair is listed from both of its atoms (True) or once (False); found out by default.
        precision: of its arithmetic, "float64" or "float32"; found out by default.
        superset: pairs beyond the cutoff may be listed.
        limits: what it does not claim to do, words of `LIMITS`: such cases are not asked.
        time: minutes, after which no case is begun and no failure shrunk.
        out: the new folder; default runs/conform-<name>-<n>.
        resume: a folder to go on with instead, with the options that it was begun with.
        report: write report.html.
        progress: called now and then with cases done, cases and a dictionary of words.

    Raises:
        InputError: there is no such list, or it cannot be called, or what it returns is no list of pairs; or
            it is not the one that a folder was begun with.
        FolderError: the folder cannot be used.
    """
    from mdnum.deadline import Deadline
    from mdnum.provenance import surroundings
    from mdnum.references.conformance.suite import CASES, Examiner, examine

    deadline = Deadline(time)
    # what it holds is read by the one process that goes on from it
    folder = None if resume is None else _taken(Path(resume))
    examiner = None
    try:
        kept = None if folder is None else _kept(folder.path)
        if kept is None:
            options = {"cases": CASES if cases is None else cases, "seed": seed, "large": large, "full": full,
                       "precision": precision, "superset": superset, "limits": list(limits)}  # fmt: skip
            _refuse_many(options["cases"])
        else:
            options = kept.options
            pairs = pairs or kept.words
        if not pairs:
            raise InputError("no list is given", remedy="Give a name, package.module:function or a function")
        tested = _declared(
            _loaded(pairs),
            options["full"],
            options["precision"],
            options["superset"],
            tuple(options["limits"]),
        )
        if kept is not None and [tested.name, tested.version] != kept.tested:
            was, now = (
                " ".join(filter(None, words)) for words in (kept.tested, (tested.name, tested.version))
            )
            raise InputError(
                f"was begun with {was}, not {now}", where=str(resume), remedy="Begin in a new folder"
            )
        examiner = Examiner(tested, reuse=True, apart=True)
        if (why := examiner.unusable()) is not None:
            raise InputError(why, where=tested.name, remedy=_CONTRACT[tested.kept])
        if folder is not None:
            folder.write_anew(("areas", "failures"))
        else:
            path = default_folder(f"conform-{_slug(tested.name)}") if out is None else out
            folder = RunFolder.create(path, world="conform")
            folder.write_provenance(surroundings() | {"list": tested.name, "list_version": tested.version})
        keeper = _Keeper(folder, examiner.report, tested, options, kept)
        found = examine(
            tested,
            cases=options["cases"],
            seed=options["seed"],
            large=options["large"],
            apart=True,
            progress=Log(folder, progress),
            examiner=examiner,
            deadline=deadline,
            answers=keeper.answers,
        )
        keeper.write(ended=True)
    except BaseException:
        if examiner is not None:
            examiner.session.close()
        if folder is not None:
            folder.close()
        raise
    return ConformResult(folder.path, found, finish(folder, report, progress))


@dataclass(frozen=True)
class _Kept:
    """What a folder holds to go on from.

    Attributes:
        words: that name the list; None where it had none.
        tested: name and version of the list.
        options: that it was begun with.
        seconds: that were spent.
        answers: that it gave.
    """

    words: str | None
    tested: list[str | None]
    options: dict[str, Any]
    seconds: float
    answers: Answers


def _taken(path: Path) -> RunFolder:
    """A folder that only this process goes on with.

    Raises:
        FolderError: nothing that can be gone on from, or another process writes it.
    """
    folder = RunFolder.open(path)
    if not (path / "answers.json").is_file():
        raise FolderError(
            "holds no examination to go on with", where=str(path), remedy="Begin in a new folder"
        )
    folder.world = "conform"
    folder.take()
    return folder


def _kept(path: Path) -> _Kept:
    """What a folder holds to go on from, each of its values of the kind that it was.

    Raises:
        FolderError: it holds something else.
    """
    from mdnum.references.conformance.answers import Answers

    file = path / "answers.json"
    text = read_text(file)
    with restoring(file):
        told = json.loads(text)
        expect(isinstance(told, dict), "no answers")
        words, tested, options, seconds = (told[name] for name in ("list", "tested", "options", "seconds"))
        expect(words is None or (isinstance(words, str) and words), "no name of a list")
        expect(isinstance(tested, list) and len(tested) == 2, "no name and version of a list")
        expect(isinstance(tested[0], str) and isinstance(tested[1], str | None), "no name and version")
        expect(type(seconds) in (int, float) and 0 <= seconds < np.inf, "no seconds")
        names = ("cases", "seed", "large", "full", "precision", "superset", "limits")
        options = {name: options[name] for name in names}
        for name in ("cases", "seed"):
            expect(type(options[name]) is int, f"options.{name} is {options[name]!r}")
        for name, kind in (("large", bool), ("full", bool | None), ("superset", bool | None)):
            expect(isinstance(options[name], kind), f"options.{name} is {options[name]!r}")
        expect(options["precision"] in (None, *PRECISIONS), f"precision is {options['precision']!r}")
        expect(isinstance(options["limits"], list) and set(options["limits"]) <= set(LIMITS), "limits")
        answers = Answers(told, str(file))
    try:
        _refuse_many(options["cases"])
    except InputError as error:
        raise FolderError(error.message, where=str(file), remedy="Begin in a new folder") from error
    return _Kept(words, tested, options, float(seconds), answers)


def _refuse_many(cases: int) -> None:
    if not 0 <= cases <= MOST_CASES:
        raise InputError(f"{cases:,} random cases", remedy=f"Ask for 0 to {MOST_CASES:,}")


class _Keeper:
    """Fills a folder while answers come: a kill, however hard, leaves what was found till then.

    Args:
        kept: what the folder held, of one that is gone on with.
    """

    def __init__(self, folder: RunFolder, found: Report, tested: PairList, options: Any, kept: _Kept | None):
        from mdnum.references.conformance.answers import Answers

        self._folder, self._found, self._seed = folder, found, options["seed"]
        self._head = {
            "list": tested.word,
            "tested": [tested.name, tested.version],
            "options": options,
        }
        self._before = 0.0 if kept is None else kept.seconds
        self._began, self._due, self._due_in_words = monotonic(), 0.0, 0.0
        self.answers = Answers() if kept is None else kept.answers
        self.answers.saved = self._put
        self._write_answers()

    def _put(self, urgent: bool) -> None:
        """One more answer; what fails is on disk at once, the rest within a second."""
        now = monotonic()
        if urgent or now >= self._due:
            self._write_answers()
            # most of the time is for asking
            self._due = monotonic() + max(1.0, 20 * (monotonic() - now))
        if now >= self._due_in_words:
            self.write(ended=False)
            self._due_in_words = monotonic() + max(10.0, 20 * (monotonic() - now))

    def write(self, ended: bool) -> None:
        """Scripts, summary and, at the end, tables."""
        found = self._found
        found.seconds = self._before + monotonic() - self._began
        scripts = _write_scripts(self._folder, found)
        if ended:
            self._write_answers()
            _write_tables(self._folder, found, scripts)
            self._folder.finalize()
        status = "stopped" if not ended or found.left or not found.whole else "complete"
        self._folder.write_summary(_summary(found, scripts, self._seed) | {"status": status})

    def _write_answers(self) -> None:
        seconds = self._before + monotonic() - self._began
        text = json.dumps(self._head | {"seconds": seconds} | self.answers.plain(), allow_nan=False)
        write_text(self._folder.path / "answers.json", text)


def _loaded(pairs: Any) -> PairList:
    from mdnum.references.conformance.lists import PairList
    from mdnum.references.conformance.loading import from_object, load

    if isinstance(pairs, PairList):
        return pairs
    return load(pairs) if isinstance(pairs, str) else from_object(pairs)


def _declared(
    tested: PairList, full: bool | None, precision: str | None, superset: bool | None, limits: tuple[str, ...]
) -> PairList:
    """A list with what its user says about it."""
    from dataclasses import replace

    if precision is not None and precision not in PRECISIONS:
        raise InputError(f"precision = {precision!r}", remedy=f"Give one of {', '.join(PRECISIONS)}")
    unknown = [word for word in limits if word not in LIMITS]
    if unknown:
        raise InputError(f"no limit is called {unknown[0]!r}", remedy=f"Give some of {', '.join(LIMITS)}")
    tested = tested.with_options(full=full, superset=superset, unit=PRECISIONS.get(precision or ""))
    declared: Any = {LIMITS[word]: True for word in limits}
    return replace(tested, limits=replace(tested.limits, **declared))


def _slug(name: str) -> str:
    """A name that a folder can have."""
    return name.replace(":", "-")


def _script(code: str) -> str:
    """The end of the name of a failure's script."""
    return f"{code.lower().replace('_', '-')}.py"


def _write_scripts(folder: RunFolder, found: Report) -> list[str]:
    """Writes a script for each failure, and removes those of mdnum that stand for none; their names."""
    from mdnum.references.conformance.judge import CODES
    from mdnum.references.conformance.reproduction import script

    scripts = []
    for number, failed in enumerate(found.failed, 1):
        scripts.append(f"reproduce-{number}-{_script(failed.code)}")
        lines = script(found.tested, failed, found.how, found.superset, found.reach(failed.case))
        path = folder.path / scripts[-1]
        # what a link leads to is not looked at
        same = path.is_file() and not path.is_symlink()
        if not (same and manifest.digest(path) == manifest.digest_of(lines.encode())):
            write_text(path, lines)
    made = manifest.load(folder.path)
    mine = re.compile(rf"reproduce-\d+-({'|'.join(re.escape(_script(code)) for code in CODES)})")
    for name in made.files if made is not None else ():
        if mine.fullmatch(name) and name not in scripts:
            manifest.remove(folder.path / name)
    return scripts


def _write_tables(folder: RunFolder, found: Report, scripts: list[str]) -> None:
    """Puts areas and failures into tables."""
    names = ("asked", "passed", "failed", "refused", "skipped")
    folder.append(
        "areas",
        {
            "area": np.array(list(found.areas)),
            **{
                name: np.array([getattr(tally, name) for tally in found.areas.values()], int)
                for name in names
            },
        },
    )
    if found.failed:
        rows = [_failure(failed, name) for failed, name in zip(found.failed, scripts, strict=True)]
        folder.append("failures", {key: np.array([row[key] for row in rows]) for key in rows[0]})


def _failure(failed: Any, script: str) -> dict[str, Any]:
    """A failure as a row."""
    return {
        "code": failed.code,
        "area": failed.case.area,
        "case": failed.asked.name,
        "atoms": failed.case.atoms,
        "steps": failed.case.steps,
        "step": failed.worst.step,
        "text": failed.worst.text,
        "script": script,
    }


def _summary(found: Report, scripts: list[str], seed: int) -> dict[str, Any]:
    """The content of summary.json, without headline and findings."""
    tested = found.tested
    names = ("asked", "passed", "failed", "silent", "refused", "skipped")
    return {
        "world": "conform",
        "question": "conform",
        "system": tested.name,
        "about": tested.about,
        "package": tested.package,
        "version": tested.version,
        "kept": tested.kept,
        "full": found.how.full,
        "shift_sign": found.how.sign,
        "precision": "float64" if found.how.unit == PRECISIONS["float64"] else "float32",
        "superset": found.superset,
        "found_out": found.found_out,
        "single": None if found.single is None else found.single.name,
        "ties": {"counted": found.ties[0], "not_counted": found.ties[1]},
        "keeps_order": found.keeps_order,
        "shifts": found.shifts,
        "aliased": found.aliased,
        "known": dict(tested.known),
        "refusals": [
            {
                "why": one.words,
                "case": one.case.name,
                "atoms": one.case.atoms,
                "uneven": list(one.uneven),
                "answers": list(one.answers),
            }
            for one in found.refusals
        ],
        "questions": found.questions,
        "left": found.left,
        "padding": found.padding,
        "padding_said": found.said,
        "rule": {"motions": found.motions, "calls": found.calls},
        "asked": found.asked,
        "wrong": found.wrong,
        "silent": sum(tally.silent for tally in found.areas.values()),
        "conforms": found.conforms,
        "areas": [
            {"area": area, "about": _about(area), "why": _most(tally.why), "codes": tally.codes}
            | {name: getattr(tally, name) for name in names}
            for area, tally in found.areas.items()
        ],
        "failures": [
            _failure(failed, name) | {"alone": failed.alone}
            for failed, name in zip(found.failed, scripts, strict=True)
        ],
        "large": None if found.large is None else {"atoms": found.large[0], "seconds": found.large[1]},
        "seed": seed,
        "seconds": found.seconds,
        "findings": [],
        "status": "complete",
    }


def _about(area: str) -> str:
    from mdnum.references.conformance.case import AREAS

    return AREAS[area]


def _most(why: Mapping[str, int]) -> list[dict[str, Any]]:
    """Reasons of not answering, the most frequent first."""
    return [{"why": text, "cases": count} for text, count in sorted(why.items(), key=lambda one: -one[1])]
