"""`mdnum audit`: tests whether an ASE calculator is safe to use.

The checks of `mdnum.audit.checks.CHECKS` run in order. Each result is saved. An interrupted audit can be
continued with the remaining checks. A check returns codes and values of findings. audit.toml contains the
texts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum import units
from mdnum.audit import base, conclusion
from mdnum.audit.causes import heads
from mdnum.audit.checks import CHECKS
from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.registry import expect_known
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Code, Key, Page, Plot, Section, curves, pairs, points_of, records
from mdnum.report.words import heading, listed, many
from mdnum.store import RunFolder
from mdnum.store.answers import Answers, take
from mdnum.store.files import read_text, remove, subfolder, write_text
from mdnum.verbs import frame
from mdnum.verbs.frame import Outcome, Progress, Verb, View, Wanted

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.base import AuditCheck, CheckResult, Observed
    from mdnum.audit.record import AuditState
    from mdnum.audit.subject import CalculatorSubject, LoadedCalculator
    from mdnum.deadline import Deadline

TEXTS = Texts(__file__, units.METAL)
_SCRIPT = "reproduce.py"


@partial(frame.keywords_checked, name="audit_calculator")
def audit(
    calculator: str | Callable[[], Any] | None = None,
    structure: Atoms | str | Path | None = None,
    *,
    checks: str | Sequence[str] | None = None,
    temperature: float | None = None,
    timestep: float | None = None,
    steps: int | None = None,
    time: float | None = None,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    report: bool = True,
    progress: Wanted = None,
) -> Outcome:
    """Test whether a calculator is safe to run and to differentiate.

    The calculator is called about 6,000 times for one element, and at most 12,000 times. Calls that are
    needed for a verdict come first. An interrupted audit keeps the results of completed checks.

    Example:
        >>> mdnum.audit_calculator(ase.calculators.emt.EMT(), "copper.xyz").verdict

    Args:
        calculator: a name as on the command line, or a function that makes a new ASE calculator; may be
            omitted when resuming an audit of a named calculator. The Python code that the name refers to is
            run.
        structure: an ASE `Atoms` object or a file that ASE can read; by default the calculator's own
            structure, or one that is built for it.
        checks: names of `CHECKS`; default all.
        temperature: temperature of the run and in kT, K; by default that of the system, or 300 K.
        timestep: time step of the run, fs (τ for a system in reduced units); by default a fraction of the
            period of the fastest vibration.
        steps: number of steps of the run; default 200.
        time: time limit in minutes, after which the calculator is not called again; unfinished checks are
            listed and can be resumed.
        out: the new audit folder; default runs/audit-<name>-<n>.
        resume: folder of an audit that was killed, stopped or out of time: its results are kept, and the
            remaining checks are run with the original options.
        report: write report.html.
        progress: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose `result` contains the findings of each check by its name.

    Raises:
        InputError: no such calculator, structure or check; an option that a resumed audit already has.
        FolderError: the folder cannot be used.
        frame.Interrupted: control-C was pressed after a check was done; the results so far, including the
            report, have been written and are the exception's `outcome`.
    """
    from mdnum.audit.record import AuditState, encoded, kept
    from mdnum.deadline import Deadline

    deadline = Deadline(time)
    if resume is not None:
        given = {"structure": structure, "checks": checks, "temperature": temperature, "timestep": timestep,
                 "steps": steps, "out": out}  # fmt: skip
        if names := [name for name, value in given.items() if value is not None]:
            raise InputError(
                f"the option {names[0]} was given, but a resumed audit uses its stored options",
                remedy=f"Omit {', '.join(names)}, or start a new audit",
            )
        with closing(take(resume, frame.layout("audit"))) as folder:
            state = kept(folder)
            loaded = _same(calculator, state, folder.path)
            folder.restart()
            for file in (folder.path / "structures").glob("failed-*.extxyz"):
                if re.fullmatch(r"failed-\d+\.extxyz", file.name) and file.name not in state.failed:
                    remove(file)
            return _ask_all(folder, loaded, state, deadline, report, progress)
    if calculator is None:
        raise InputError("no calculator was given", remedy="Give a calculator, or resume an audit")
    loaded = _loaded(calculator)
    _internal(timestep, loaded.units)
    wanted = _wanted(checks)
    given = None if structure is None and loaded.atoms is None else _structure(structure, loaded, deadline)
    kT = 300.0 * units.METAL.k_B if loaded.kT is None else loaded.kT
    kT = kT if temperature is None else temperature * loaded.units.k_B
    # before the first question, which may never be answered
    with ExitStack() as stack:
        frame.end_on_sigterm(stack)
        folder = stack.enter_context(frame.new_folder("audit", f"audit-{loaded.stem}", out))
        # a quarter of the time, so that most is left for what it is asked
        atoms = _structure(None, loaded, Deadline(time and time / 4)) if given is None else given
        state = AuditState(
            loaded.name, isinstance(calculator, str), encoded(atoms), kT, loaded.units.name, wanted,
            temperature, timestep, steps,
        )  # fmt: skip
        _write_structures(folder, {"structure": atoms})
        return _ask_all(folder, loaded, state, deadline, report, progress)


def _ask_all(
    folder: RunFolder,
    loaded: LoadedCalculator,
    state: AuditState,
    deadline: Deadline,
    report: bool,
    progress: Progress | None,
) -> Outcome:
    """Run the remaining checks, save each result, and write the report."""
    from mdnum.audit.subject import CalculatorSubject
    from mdnum.audit.thresholds import find_thresholds
    from mdnum.deadline import interrupting

    quantities = {name: getattr(loaded.units, name) for name in ("length", "energy", "mass")}
    folder.told = {"system": loaded.name, "units": {**quantities, "decision": loaded.units.length}}
    answers = Answers(folder, state)
    answers.save()
    subject = CalculatorSubject(
        loaded.name, loaded.make, state.atoms, kT=state.kT, folder=folder.path / "structures",
        units=loaded.units,
    )  # fmt: skip
    subject.meter.deadline = deadline
    if state.thresholds is not None:
        subject.known["thresholds"] = state.thresholds
    timestep = _internal(state.timestep, loaded.units)
    log = frame.logged(folder, progress)
    state.during, state.why = next(iter(state.left), None), ""
    # what leads to an answer first, in brief, and only then any check in full
    first = [name for name in state.left if CHECKS[name].basic and name not in state.cut]
    rounds = [(name, True) for name in first if len(state.left) > 1]
    for name, brief in [*rounds, *((name, False) for name in state.left)]:
        check = CHECKS[name](timestep, state.steps)
        check.brief = brief
        log(0, 0, {"phase": name})
        state.during = name
        try:
            others = [one for one in state.shown if one.name != name]
            with interrupting(deadline):
                result = answer_of(check, subject, log, others)
        except KeyboardInterrupt:
            if not state.shown:
                raise
            state.why = "stopped"
            break
        except base.TimeUp:
            state.why = base.TIME_UP
            break
        _keep_evidence(folder, loaded, check)
        cut = any(reason == base.TIME_UP for _, reason in result.skipped)
        if not result.asked and name in state.cut:  # its calls were used up: the brief form is what is known
            result = replace(state.cut[name], skipped=result.skipped)
        if brief or cut:
            # asked again, and not as far: what was known stays known
            again = state.cut.get(name, result)
            state.cut[name] = max(again, result, key=lambda one: one.asked)
        else:
            state.results.append(result)
            state.cut.pop(name, None)
        if cut:
            state.why = base.TIME_UP
            break
        if name == "smoothness":
            state.thresholds = find_thresholds(subject)
        state.failed = sorted(path.name for path in (folder.path / "structures").glob("failed-*.extxyz"))
        state.during = next(iter(state.left), None)
        answers.save()
        summary = plain(_summary(state))
        folder.write_summary(_judge(AuditView(folder, summary, given=state)).judged(folder.kind, summary))
    answers.save()
    frame.store(folder, _summary(state), _tables(state))
    outcome = frame.finish(
        folder, report=report, result={one.name: one for one in state.shown}, progress=progress
    )
    if state.why == "stopped":
        raise frame.Interrupted(outcome)
    return outcome


def answer_of(
    check: AuditCheck, subject: CalculatorSubject, log: frame.Progress, before: Iterable[CheckResult]
) -> CheckResult:
    """Run a check and return its result. If the calculator fails, the result is a finding.

    Different results for the same input are reported once per audit.
    """
    named: dict[str, Any] = {"name": check.name, "title": check.title}
    rest = f"the rest of {check.name}"
    try:
        result = check(subject, log)
    except base.CallsUp as up:
        says = ["calls_up"], {"calls": check.calls}
        result = base.CheckResult(says, skipped=[(rest, up.why)], asked=0, **named)
    except base.CalculatorError as error:
        values = {"check": check.name, "why": error.message}
        values["file"] = error.structure.name if error.structure else ""
        failed = base.finding("CALCULATOR_FAILED", "error", "saved" if error.structure else None, **values)
        result = base.CheckResult((["failed"], values), [failed], skipped=[(rest, error.message)], **named)
    result = _named(result, subject.units)
    if any(one.code == "NOT_REPEATABLE" for each in (*before, result) for one in each.findings):
        return result
    return replace(result, findings=[*subject.repeats.findings(subject.kT), *result.findings])


def _keep_evidence(folder: RunFolder, loaded: LoadedCalculator, check: AuditCheck) -> None:
    """Write structures in full precision, and a script that needs no mdnum."""
    from mdnum.audit.record import STRUCTURES, script

    _write_structures(folder, check.structures)
    saved = sorted((folder.path / STRUCTURES).glob("*-before.extxyz"))
    if saved:
        names = [path.name.removesuffix("-before.extxyz") for path in saved]
        write_text(folder.path / _SCRIPT, script(loaded.name, names, loaded.units))


def _write_structures(folder: RunFolder, structures: Mapping[str, Atoms]) -> None:
    from mdnum.audit.subject import exact_extxyz

    for name, atoms in structures.items():
        write_text(subfolder(folder.path, "structures") / f"{name}.extxyz", exact_extxyz(atoms))


def _wanted(checks: str | Sequence[str] | None) -> list[str]:
    if checks is None:
        return conclusion.in_order(list(CHECKS))
    names = frame.words(checks)
    expect_known("check", names, CHECKS)
    if not names:
        raise InputError("no check of the calculator was selected", remedy=f"Choose from {', '.join(CHECKS)}")
    return conclusion.in_order(list(names))


def _loaded(calculator: str | Callable[[], Any]) -> LoadedCalculator:
    from mdnum.audit.record import load_calculator
    from mdnum.audit.subject import LoadedCalculator

    if isinstance(calculator, str):
        return load_calculator(calculator)
    if not callable(calculator):
        raise InputError(
            f"the calculator was given as an object of type {type(calculator).__name__}; expected a name, "
            "or a function that returns a new calculator",
            remedy="Give a function, for example `lambda: LennardJones()`",
        )
    name = getattr(calculator, "__name__", type(calculator).__name__)
    name = "calculator" if name == "<lambda>" else name
    return LoadedCalculator(name, name, calculator)


def _same(calculator: str | Callable[[], Any] | None, state: AuditState, path: Path) -> LoadedCalculator:
    """Return the calculator of an audit to resume. Raise an error if another calculator is given."""
    if calculator is None and not state.named:
        raise InputError(
            "the calculator of the stored audit was a Python object, which is not stored in the folder",
            remedy="Give the same calculator again",
            where=str(path),
        )
    if isinstance(calculator, str) and state.named and calculator != state.name:
        raise InputError(
            f"the folder contains an audit of {state.name}, not of {calculator}", remedy="Give no calculator"
        )
    return _loaded(state.name if calculator is None else calculator)


def _structure(structure: Atoms | str | Path | None, loaded: LoadedCalculator, deadline: Deadline) -> Atoms:
    from ase import Atoms

    from mdnum.audit.building import default_structure
    from mdnum.audit.structures import read_structure

    if isinstance(structure, Atoms):
        found = structure
    else:
        found = default_structure(loaded, deadline) if structure is None else read_structure(structure)
    if not len(found):
        raise InputError("the structure has no atoms", remedy="Use -s FILE to give a structure with atoms")
    return found


def _internal(timestep: float | None, given: units.Units) -> float | None:
    """Convert a time step from fs (or τ) to length * sqrt(mass / energy)."""
    if timestep is None:
        return None
    if not timestep > 0:
        raise InputError(
            f"the time step is {timestep:g}; expected a value above 0", remedy="Correct --timestep"
        )
    return timestep * given.time_factor / (1000.0 if given.time == "ps" else 1.0)


# -- what is in the folder -------------------------------------------------------------------------


def _summary(state: AuditState) -> dict[str, Any]:
    """Return the content of an audit's summary.json, except for the verdict."""
    atoms, given = state.atoms, units.get(state.units)
    texts, said = Texts(__file__, given), conclusion.answers(state.shown, state.checks)
    why = state.why or "not finished"
    left = [name for name in state.left if state.during and name not in {one.name for one in state.shown}]
    whys = dict.fromkeys(left, why) | {name: "not selected" for name in CHECKS if name not in state.checks}
    rest = [{"what": f"the check of {name}", "why": why, "part": name} for name, why in whys.items()]
    rest += [{"what": what, "why": why, "part": one.name} for one in state.shown for what, why in one.skipped]
    early = frame.UNDECIDED if conclusion.to_come(state.shown, state.checks) else frame.PARTIAL
    status = {"stopped": "stopped", base.TIME_UP: early}.get(state.why, "unfinished")
    status = {frame.PARTIAL: "complete"}.get(early, early) if state.during is None else status
    return {
        "system": state.name, "calculator": state.name, "atoms": len(atoms),
        "formula": atoms.get_chemical_formula(), "periodic": atoms.pbc.tolist(),
        "structure": atoms.info.get("origin"), "kT": state.kT, "units": state.units,
        "safe_to_run": said["run"], "safe_to_differentiate": said["differentiate"],
        "parts": [
            {
                "name": one.name, "title": one.title, "tables": one.tables,
                "says": " ".join(texts(name, **one.says[1]) for name in one.says[0]),
                "numbers": one.numbers, "asked": one.asked, "possible": one.possible,
                "seconds": one.seconds,
            }
            for one in state.shown
        ],
        "left_out": rest,
        "causes": [
            {"code": head.code, "below": [one.code for one in below]}
            for head, below in _by_cause([one for each in state.shown for one in each.findings])
        ],
        "status": status, "seconds": state.seconds,
    }  # fmt: skip


def _tables(state: AuditState) -> dict[str, dict[str, np.ndarray]]:
    """Return the tables of an audit: the points of figures and the data of checks."""
    lines = [
        (result.name, f"{result.name}-{place}", label, chart.x, values)
        for result in state.shown
        for place, chart in enumerate(result.charts, 1)
        for label, values in chart.lines.items()
    ]
    tables = {"curves": points_of(lines)} if lines else {}
    for result in state.shown:
        for name, columns in result.recorded.items():
            if next(iter(columns.values()), ()):
                tables[name] = {column: np.array(values) for column, values in columns.items()}
    return tables


def _named(value: Any, given: units.Units) -> Any:
    """Return the results of a check, with the names of units."""
    if isinstance(value, units.Measured):
        return value.to("", vars(given))
    if isinstance(value, str):
        return value.replace(units.ENERGY, given.energy).replace(units.LENGTH, given.length)
    if isinstance(value, Mapping):
        return {_named(key, given): _named(item, given) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_named(item, given) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{name: _named(item, given) for name, item in vars(value).items()})
    return value


# -- what it means ---------------------------------------------------------------------------------


def _by_cause(found: Sequence[Observed]) -> list[tuple[Observed, list[Observed]]]:
    """Return each main finding with the findings that it may explain."""
    above = heads([(one.code, one.severity) for one in found])
    return [
        (one, [other for k, other in enumerate(found) if k != place and above[k] == place])
        for place, one in enumerate(found)
        if above[place] == place
    ]


def _finding(one: Observed, section: str, cause: str, texts: Texts = TEXTS) -> Finding:
    """Return a finding with sentences from audit.toml or from the check's package."""
    if one.code not in TEXTS.entries:
        given = {name: str(one.values.get(name, "")) for name in ("title", "text", "remedy")}
        return Finding(one.code, one.severity, **given, values=one.values, section=section, cause=cause)
    made = texts.finding(
        one.code, *one.variants, severity=one.severity, section=section, cause=cause, **one.values
    )
    # ways of writing a structure down have one text for all
    return made if made.text else replace(made, text=texts("invariance_finding", **one.values))


@dataclass(frozen=True)
class AuditView(View):
    """Read access to the folder of an audit."""

    given: AuditState | None = None  # what it has found, where that is known; it is read otherwise

    @cached_property
    def state(self) -> AuditState:
        """State of the audit, including the results of its checks."""
        from mdnum.audit.record import kept

        return kept(self.folder) if self.given is None else self.given


def _judge(view: AuditView) -> Verdict:
    """Return the verdict: is the calculator safe to run, and safe to differentiate? Errors come first."""
    state = view.state
    given, titles, more = units.get(state.units), {}, conclusion.concluded(state.shown)
    texts, observed = Texts(__file__, given), []
    for result in state.shown:
        # what a check has said by itself goes before what several say together
        told = [replace(one, variants=[*one.variants, more.get(one.code, "")]) for one in result.findings]
        titles |= {id(one): result.title for one in told}
        observed += told
    found = []
    groups = _by_cause(observed)
    for head, below in groups:
        found.append(_finding(head, titles[id(head)], "", texts))
        found += [_finding(one, titles[id(one)], head.code, texts) for one in below]
    headline = _headline(state, [one for one in found if not one.cause])
    if state.during is not None:
        name = {"stopped": "stopped", base.TIME_UP: "time_up"}.get(state.why, "unfinished")
        headline = TEXTS(name, check=state.during, headline=headline)
    return conclude(found, headline=headline, best="good", judged=True)


def _headline(state: AuditState, found: Sequence[Finding]) -> str:
    """Return an audit's headline: both conclusions (run, differentiate), missing checks, worst finding."""
    shown, early = state.shown, conclusion.to_come(state.shown, state.checks)
    said, begun = conclusion.answers(shown, state.checks), {one.name for one in shown}
    name = TEXTS("on", name=state.name, formula=state.atoms.get_chemical_formula())
    if early and conclusion.nothing_felt(shown):
        return TEXTS("nothing_felt", name=name)
    slugs = {question: answer.replace(" ", "_") for question, answer in said.items()}
    asked = [TEXTS(f"{question}_{slug}") for question, slug in slugs.items() if slug != "not_tested"]
    nothing = early and begun and not asked
    rest = [
        TEXTS("rest_of_check", asked=one.asked, possible=one.possible, check=one.name)
        for one in shown
        if nothing or conclusion.largely_unasked(one)
    ]
    rest += [TEXTS("check_left", check=name) for name in state.checks if name not in begun]
    if nothing:
        return TEXTS("nothing_yet", name=name, ways=", ".join(rest))
    if len(set(slugs.values())) == 1:
        head = TEXTS(f"same_{slugs['run']}", name=name)
    elif len(asked) == 1:
        head = TEXTS("one", name=name, answer=asked[0])
    else:
        head = TEXTS("both", name=name, run=asked[0], differentiate=asked[1])
    if rest:
        beside = "as far as tested" in said.values()
        head = TEXTS("with_rest_beside" if beside else "with_rest", head=head, rest=", ".join(rest))
    severe = sorted(
        (one for one in found if one.severity != "info"),
        # where one question has two answers, no other finding of its severity is worth as much
        key=lambda one: (one.severity != "error", one.code != "NOT_REPEATABLE"),
    )
    titles = list(dict.fromkeys(one.title for one in severe))
    if len(titles) > 3:
        titles[2:] = [TEXTS("more_findings", n=len(titles) - 2)]
    if titles:
        head = TEXTS("found", head=head, titles="; ".join(titles))
        if "with care" in said.values():
            remedy = next((one.remedy for one in severe if one.severity == "warning" and one.remedy), "")
            head = TEXTS("what_to_do", head=head, remedy=remedy).rstrip()
    elif shown:
        head = TEXTS("found_no_errors" if found else "found_nothing", head=head, checks=len(shown))
    else:
        head = TEXTS("nothing_asked", head=head)
    refused = sum(why not in (base.TIME_UP, base.CALLS_UP) for one in shown for _, why in one.skipped)
    unselected = conclusion.in_order([one for one in CHECKS if one not in state.checks])
    values = {"elements": listed(list(dict.fromkeys(state.atoms.symbols)))}
    values |= {"checks": listed(unselected)} if unselected else {}
    head += " " + TEXTS("unasked_checks" if unselected else "unasked", **values)
    return head + (" " + TEXTS("refused", n=refused) if refused else "")


# -- how it is shown -------------------------------------------------------------------------------


def _page(view: AuditView, verdict: Verdict) -> Page:
    state, summary = view.state, view.summary
    given = units.get(state.units)
    found = [f"{one['title']} ({_ways(one)}): {one['says']}" for one in summary["parts"]]
    sections = [Section("What each check found", found, terminal=True)]
    left = [(heading(one["what"]), one["why"]) for one in summary["left_out"] if one["why"]]
    if left:
        sections.append(Section("Tests left out", [replace(pairs(left), shown=6)], terminal=True))
    if state.during is not None:
        sections[-1] = replace(
            sections[-1], parts=[*sections[-1].parts, TEXTS("how_to_go_on", folder=str(view.folder.path))]
        )
    if (script := view.folder.path / _SCRIPT).exists():
        code = Code("A script that repeats this without mdnum", read_text(script))
        sections.append(Section("Reproduce", [code]))
    for result in state.shown:
        parts = [_plot(result, place) for place in range(len(result.charts))]
        parts += [_marked(rows, title) for title, rows in result.tables.items() if rows]
        sections.append(Section(result.title, parts))
    sections.append(Section("What was tested", [pairs(_subject(summary, given))]))
    about = f"{state.name}, {summary['formula']}, {many(summary['atoms'], 'atom')}"
    if state.atoms.info.get("guessed"):
        about += f". {TEXTS('guessed', formula=summary['formula'])}"
    return view.page(f"Audit of {state.name}", about, _keys(summary, verdict, given), sections)


def _ways(part: Mapping[str, Any]) -> str:
    return TEXTS("ways_asked" if part["asked"] == part["possible"] else "ways_of", **part)


def _marked(rows: Sequence[Mapping[str, Any]], title: str) -> Any:
    """Format a table of tests. Failed tests come first."""
    order = sorted(rows, key=lambda row: not any(value is False for value in row.values()))
    bad = frozenset(n for n, row in enumerate(order) if any(value is False for value in row.values()))
    return replace(records(order, title, shown=8), bad=bad)


def _plot(result: CheckResult, place: int) -> Plot:
    chart = result.charts[place]
    lines = {label: np.array(line, float) for label, line in chart.lines.items()}
    mark = "line+points" if len(chart.x) < 40 else "line"
    log_x = chart.log_y and "step" in chart.x_label and all(x > 0 for x in chart.x)
    return Plot(
        f"{result.name}-{place + 1}", chart.title, chart.x_label, chart.y_label,
        curves(np.array(chart.x), lines, mark, log=False),
        x_scale="log" if log_x else "linear", y_scale="log" if chart.log_y else "linear",
        verticals=tuple((value, word) for word, value in chart.marks.items()),
    )  # fmt: skip


def _keys(summary: Mapping[str, Any], verdict: Verdict, given: units.Units) -> list[Key]:
    severe = [one.severity for one in verdict.findings if not one.cause and one.severity != "info"]
    parts = {part["name"]: part["numbers"] for part in summary["parts"]}
    ways, forces = parts.get("invariance", {}), parts.get("forces", {})
    return TEXTS.keys(**{
        **summary, **vars(given), "severe": len(severe), "errors": severe.count("error"),
        "dynamics": {"drift": None, **parts.get("dynamics", {})},
        "ways": ways if "told_apart" in ways else None,
        "forces": {"largest_difference": None, **forces},
        "differences": f"{given.energy}/{given.length}" if "largest_difference" in forces else None,
    })  # fmt: skip


def _subject(summary: Mapping[str, Any], given: units.Units) -> list[tuple[str, str]]:
    axes = [axis for axis, yes in zip("abc", summary["periodic"], strict=True) if yes]
    periodic = f"periodic along {', '.join(axes)}" if axes else "not periodic"
    origin = summary.get("structure") or None
    return TEXTS.rows("subject", **{**summary, **vars(given), "periodic": periodic, "structure": origin})


KINDS = {"audit": Verb(_judge, _page, AuditView)}
