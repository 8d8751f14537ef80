"""What a verb returns: plain data that crosses processes, and a folder that gives the rest back."""

from __future__ import annotations

import functools
import logging
import multiprocessing
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from html import escape
from pathlib import Path
from typing import Any

import ase.io
import numpy as np
import pytest
from ase import Atoms
from matplotlib import pyplot

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.report.page import write
from mdnum.report.section import Figure, Plot
from mdnum.store import RunFolder
from mdnum.verbs.frame import Interrupted
from mdnum.verbs.outcome import Outcome

LENNARD_JONES = "ase.calculators.lj:LennardJones(sigma=3.405, epsilon=0.0103, rc=8.5)"
#: A verb with its arguments for some kinds of folders, each in a second or so.
ASKED: dict[str, tuple[Any, tuple[Any, ...], dict[str, Any]]] = {
    "md": (mdnum.run, ("argon/crystal-108",), {"steps": 60, "check": False}),
    "fork": (mdnum.fork, ("pair/at-cutoff", "start"), {"steps": 60, "repeats": 0}),
    "grad": (mdnum.grad, ("ball/drop", "final-height", "y0"), {"steps": 100}),
    "flips": (mdnum.flips, ("gas.extxyz",), {"cutoffs": [3.0]}),
    "audit": (mdnum.audit_calculator, (LENNARD_JONES,), {"checks": ["alone"]}),
    "ball": (mdnum.bounce, ("ball/drop",), {"steps": 600}),
    "demos": (mdnum.demonstrate, ("sum-order",), {}),
}
FIGURES = {"md", "fork", "flips", "ball", "demos"}
#: What compiles longest; the other kinds are in every run.
NIGHTLY = {"fork", "grad"}


@pytest.fixture(scope="module")
def returned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Outcome]]:
    """What a worker of a pool returns, by kind of folder; it is given paths relative to its folder."""
    here = tmp_path_factory.mktemp("pool")
    x = np.random.default_rng(5).uniform(0, 9, (8, 30, 3))
    ase.io.write(here / "gas.extxyz", [Atoms("Ar30", positions=one, cell=[9] * 3, pbc=True) for one in x])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.setenv("MPLBACKEND", "agg")
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:

            @functools.cache
            def of(kind: str) -> Outcome:
                verb, words, options = ASKED[kind]
                return pool.submit(verb, *words, out=kind, **options).result(timeout=300)

            # the worker starts where its paths lead from
            of("demos")
            patch.undo()
            yield of


@pytest.fixture(
    params=[
        pytest.param(kind, marks=pytest.mark.nightly) if kind in NIGHTLY else kind for kind in sorted(ASKED)
    ]
)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def outcome(kind: str, returned: Callable[[str], Outcome]) -> Outcome:
    return returned(kind)


@pytest.fixture(autouse=True)
def without_windows() -> Iterator[None]:
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")


def figures(outcome: Outcome) -> list[Figure | Plot]:
    parts = [part for section in outcome.page.sections for part in section.parts]
    return [part for part in parts if isinstance(part, Figure | Plot)]


def test_it_comes_back_from_a_pool_as_plain_data(kind, outcome):
    assert outcome.kind == kind and outcome.path == outcome.folder and outcome.path.is_absolute()
    assert outcome.result is None and outcome.findings == outcome.verdict.findings
    assert outcome.summary["headline"] == outcome.verdict.headline
    assert outcome.summary == RunFolder.open(outcome.path).summary
    again = pickle.loads(pickle.dumps(outcome))
    assert repr(again) == repr(outcome) and again.summary == outcome.summary and again.keys == outcome.keys
    assert len(pickle.dumps(outcome)) < 200_000


@pytest.mark.nightly
def test_a_headline_names_every_parameter_of_a_gradient(returned):
    headline, steps = returned("grad").verdict.headline, returned("grad").summary["steps"]
    assert f"After {steps} steps" in headline and "d final-height / d y0 = " in headline


@pytest.mark.parametrize(
    "kind", ["ball", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("fork", "grad"))]
)
def test_a_result_is_shown_in_a_line_or_two(kind, tmp_path):
    verb, words, options = ASKED[kind]
    result = verb(*words, out=tmp_path / kind, report=False, **options).result
    assert repr(result).startswith(f"{type(result).__name__}(") and len(repr(result)) < 700
    assert kind != "ball" or f"steps={result.steps}, balls=1" in repr(result)


def test_a_folder_that_is_there_is_read_and_left_as_it_is(outcome):
    before = {file: file.stat().st_mtime_ns for file in outcome.path.rglob("*")}
    read = mdnum.read(outcome.path)
    assert read == outcome and read.result is None
    assert {file: file.stat().st_mtime_ns for file in outcome.path.rglob("*")} == before


def test_its_page_is_the_one_that_the_verb_wrote(outcome):
    report = outcome.path / "report.html"
    written = report.read_text(encoding="utf-8")
    report.unlink()
    write(RunFolder.open(outcome.path), pickle.loads(pickle.dumps(outcome)).page, outcome.verdict)
    assert report.read_text(encoding="utf-8") == written


def test_every_table_is_an_arrow_table(outcome):
    folder = RunFolder.open(outcome.path)
    files = list(outcome.path.glob("*.parquet"))
    assert files or outcome.kind in ("screen", "compare", "benign")
    for file in files:
        table = outcome.table(file.stem)
        assert table.num_rows == folder.rows(file.stem) and table.column_names
    with pytest.raises(FolderError, match="has no table 'nothing'") as caught:
        outcome.table("nothing")
    assert all(file.stem in str(caught.value) for file in files)


def test_every_figure_of_its_page_can_be_drawn(outcome):
    drawn = [outcome.plot(one.name) for one in figures(outcome)]
    assert bool(drawn) == (outcome.kind in FIGURES)
    for axes in drawn:
        assert pyplot.fignum_exists(axes.figure.number) and axes.figure.axes[0] is axes
        assert axes.figure.get_facecolor() == (1, 1, 1, 1), "it is read on a dark page, too"
        axes.figure.canvas.draw()
    with pytest.raises(InputError, match="no figure 'nothing'") as caught:
        outcome.plot("nothing")
    assert all(one.name in str(caught.value) for one in figures(outcome))


def test_what_is_shown_of_it_fits_a_screen(outcome):
    text = repr(outcome)
    assert 2 <= text.count("\n") <= 8 and len(text) < 2_000 and str(outcome.path) in text
    assert f"mdnum {outcome.verb}: " in text and outcome.verdict.headline[:25] in text
    # a number stands with its unit
    assert all(" ".join(key.note.split()) in text for key in outcome.keys[:6] if key.value != "–")
    html = outcome._repr_html_()
    shown = (outcome.verdict.headline, *(one.text for one in outcome.findings if not one.cause))
    assert all(str(escape(one)).replace("&#x27;", "&#39;") in html for one in shown)
    assert all(key.label in html for key in outcome.keys)
    assert html.count("<svg") == bool(figures(outcome)) and len(html) < 400_000
    # it stays inside of its cell
    assert html.startswith('<div class="mdnum-outcome">') and "<script" not in html and "http" not in html
    style = html[html.index("<style>") : html.index("</style>")]
    assert all(".mdnum-outcome" in rule for rule in style.split("}")[:-1] if "{" in rule)


def test_without_its_folder_it_still_says_what_was_found(returned, tmp_path):
    ball = returned("ball")
    moved = pickle.loads(pickle.dumps(ball).replace(b"ball", b"bowl"))
    assert not moved.path.exists()
    html = moved._repr_html_()
    assert moved.verdict.headline[:30] in html and moved.keys[0].label in html and "<svg" not in html
    for read in (lambda: moved.page, lambda: moved.table("steps"), lambda: moved.plot("heights")):
        with pytest.raises(FolderError, match="does not exist"):
            read()


def copied(outcome: Outcome, to: Path) -> Outcome:
    """It, with a copy of its folder."""
    for file in outcome.path.glob("*.*"):
        (to / file.name).write_bytes(file.read_bytes())
    return mdnum.read(to)


@pytest.mark.parametrize("damage", ["cut", "bits", "gone", "other"])
def test_a_damaged_table_is_one_line(returned, tmp_path, damage):
    outcome = copied(returned("ball"), tmp_path)
    file = tmp_path / "contacts.parquet"
    data = file.read_bytes()
    if damage == "gone":
        file.unlink()
    else:
        middle = len(data) // 2
        flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        file.write_bytes({"cut": data[:middle], "bits": flipped, "other": b"PAR1"}[damage])
    with pytest.raises(FolderError, match=r"contacts\.parquet: .*(damaged|missing)") as caught:
        outcome.table("contacts")
    assert "\n" not in str(caught.value)
    assert outcome.table("steps").num_rows == 601


def test_another_working_directory_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = mdnum.bounce("ball/drop", steps=20, out="here", report=False)
    assert outcome.path == Path("here") and outcome.result is not None
    (tmp_path / "below").mkdir()
    monkeypatch.chdir("below")
    assert outcome.table("steps").num_rows == 21
    assert pickle.loads(pickle.dumps(outcome)).page.title == "ball/drop"
    with pytest.raises(FolderError):
        mdnum.read(outcome.path)


def test_text_from_files_is_escaped_wherever_it_is_shown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hostile = "<img src=x onerror=alert(1)>\x1b[31m\u202e"
    text = (mdnum.systems.load("ball/drop").path).read_text(encoding="utf-8")
    (tmp_path / f"{hostile}.toml").write_text(text, encoding="utf-8")
    outcome = mdnum.bounce(f"{hostile}.toml", steps=600, out=f"{hostile} here", report=False)
    assert hostile in outcome.title
    html = outcome._repr_html_()
    assert "<img" not in html and "&lt;img src=x" in html
    for shown in (html, repr(outcome)):
        assert "\x1b" not in shown and "\u202e" not in shown


def test_an_interrupted_verb_is_raised_through_a_pool(returned):
    again = pickle.loads(pickle.dumps(Interrupted(returned("ball"))))
    assert again.outcome.verdict.headline == returned("ball").verdict.headline


def test_a_verb_is_logged_and_nothing_is_printed(tmp_path, caplog, capsys):
    with caplog.at_level(logging.DEBUG, logger="mdnum"):
        outcome = mdnum.bounce("ball/drop", steps=600, out=tmp_path / "x", report=False)
    told = [
        (record.name.partition(".")[0], record.levelname, record.getMessage()) for record in caplog.records
    ]
    assert {name for name, _, _ in told} == {"mdnum"}
    info = [message for _, level, message in told if level == "INFO"]
    assert "begins in" in info[0] and outcome.verdict.headline in info[-1]
    assert all(str(outcome.path) in message for message in (info[0], info[-1]))
    warned = [message for _, level, message in told if level == "WARNING"]
    assert (
        warned == [f"{one.code}: {one.title}" for one in outcome.findings if one.severity == "warning"] != []
    )
    lines = (outcome.path / "log.txt").read_text().splitlines()
    assert [message for _, level, message in told if level == "DEBUG"] == [f"x: {line}" for line in lines]
    assert capsys.readouterr() == ("", "")
