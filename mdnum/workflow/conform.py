"""`mdnum conform` as a function: a neighbor list through the conformance suite, into a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.store.naming import default_folder
from mdnum.workflow.fork_question import Log, Progress, finish

if TYPE_CHECKING:
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
    pairs: str | Callable[..., Any] | PairList,
    *,
    cases: int | None = None,
    seed: int = 0,
    large: bool = True,
    full: bool | None = None,
    precision: str | None = None,
    superset: bool | None = None,
    limits: tuple[str, ...] = (),
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ConformResult:
    """Put a neighbor list through the conformance suite.

    Args:
        pairs: a name (`references.conformance.known`), `package.module:function`, `file.py:function`, or a
            function of (positions, cell, pbc, r_cut) that returns (i, j), (i, j, shift), (i, j, shift,
            distance) or a mapping; or a class with `allocate` and `update`. What has a name is called in a
            process of its own, so that a crash is a finding.
        cases: random cases beside those with a name; 500 by default.
        seed: of the random ones.
        large: ask about 5,000 and 100,000 atoms, too.
        full: every pair is listed from both of its atoms (True) or once (False); found out by default.
        precision: of its arithmetic, "float64" or "float32"; found out by default.
        superset: pairs beyond the cutoff may be listed.
        limits: what it does not claim to do, words of `LIMITS`: such cases are not asked.
        out: the new folder; default runs/conform-<name>-<n>.
        report: write report.html.
        progress: called now and then with cases done, cases and a dictionary of words.

    Raises:
        InputError: there is no such list, or it cannot be called, or what it returns is no list of pairs.
        FolderError: the folder cannot be used.
    """
    from mdnum.provenance import surroundings
    from mdnum.references.conformance.suite import CASES, Examiner, examine

    tested = _declared(_loaded(pairs), full, precision, superset, limits)
    examiner = Examiner(tested, reuse=True, apart=True)
    try:
        if (why := examiner.unusable()) is not None:
            raise InputError(why, where=tested.name, remedy=_CONTRACT[tested.kept])
        path = default_folder(f"conform-{_slug(tested.name)}") if out is None else out
        folder = RunFolder.create(path, world="conform")
    except BaseException:
        examiner.session.close()
        raise
    try:
        folder.write_provenance(surroundings() | {"list": tested.name, "list_version": tested.version})
        note = Log(folder, progress)
        found = examine(
            tested,
            cases=CASES if cases is None else cases,
            seed=seed,
            large=large,
            apart=True,
            progress=note,
            examiner=examiner,
        )
        scripts = _write(folder, found)
        folder.finalize()
        folder.write_summary(_summary(found, scripts, seed))
    except BaseException:
        folder.close()
        raise
    return ConformResult(folder.path, found, finish(folder, report, progress))


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


def _write(folder: RunFolder, found: Report) -> list[str]:
    """Puts areas and failures into tables, and a script for each failure beside them; their names."""
    from mdnum.references.conformance.reproduction import script
    from mdnum.store.atomic import write_text

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
    scripts = []
    for number, failed in enumerate(found.failed, 1):
        scripts.append(f"reproduce-{number}-{failed.code.lower().replace('_', '-')}.py")
        write_text(folder.path / scripts[-1], script(found.tested, failed, found.how, found.superset))
    if found.failed:
        rows = [_failure(failed, name) for failed, name in zip(found.failed, scripts, strict=True)]
        folder.append("failures", {key: np.array([row[key] for row in rows]) for key in rows[0]})
    return scripts


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
        "asked": found.asked,
        "wrong": found.wrong,
        "conforms": found.conforms,
        "areas": [
            {"area": area, "about": _about(area), "why": _most(tally.why), "codes": tally.codes}
            | {name: getattr(tally, name) for name in ("asked", "passed", "failed", "refused", "skipped")}
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
