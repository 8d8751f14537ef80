"""A package outside mdnum adds a verb: a module and its text file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import call, printed
from jsonschema import Draft202012Validator
from other_package import install

from mdnum.errors import FolderError, InputError
from mdnum.report.section import Table
from mdnum.safe_path import environment
from mdnum.store import RunFolder, files
from mdnum.store.columns import meaning
from mdnum.verbs import frame, schema

MODULE = '''
"""`mdnum spread`: how far numbers lie apart."""

import numpy as np

from mdnum.report.finding import Texts, conclude
from mdnum.report.section import Section, table_of
from mdnum.store.files import write_text
from mdnum.verbs import frame

TEXTS = Texts(__file__)


@frame.keywords_checked
def spread(path, *, above=1.0, sorted=True, **keep):
    values = np.loadtxt(path, ndmin=1)
    with frame.answering("spread", "spread", **keep) as answer:
        values = np.sort(values) if sorted else values
        answer.result, answer.summary = values, {"name": str(path), "above": above, "status": "complete"}
        answer.tables["values"] = {"number": np.arange(len(values)), "value": values, "mark": "mine"}
        write_text(answer.folder.path / "notes.txt", "of mine")
    return answer.outcome


def judge(view):
    values, above = view.table("values")["value"], view.summary["above"]
    far = float(np.ptp(values))
    found = [TEXTS.finding("FAR_APART", far=far)] if far > above else []
    return conclude(found, headline=TEXTS("headline", n=len(values), far=far), best="good")


def page(view, verdict):
    rows = [{"number": n, "value": x} for n, x in enumerate(view.table("values")["value"])]
    table = table_of(rows, {"number": "number", "value": "value"})
    return view.page("Spread", "", [], [Section("Values", [table], terminal=True)])


KINDS = {"spread": frame.Verb(judge, page)}
'''
TEXT = """
[command]
help = "Say how far numbers lie apart."
calls = "spread"
shares = ["of a folder"]

[command.arguments]
path = { type = "path", metavar = "FILE", help = "A number in each line." }

[command.options]
above = { type = "float", metavar = "X", help = "Warn above this." }
no_sorted = { type = "flag", help = "Keep their order." }

[kinds.spread]
command = "spread"
further = "notes*.txt"
tables.values = "number:int64 value mark:word weight?"

[kinds.spread.described.values]
number = ["", "place in the file"]
value = "energy"
weight = ["kcal/mol/length", "weight"]

[sentences]
headline = "{n:# number} within {far:3}."

[FAR_APART]
severity = "warning"
title = "numbers are {far:3} apart"
text = "Something is far out."
"""


@pytest.fixture
def site(request, tmp_path, monkeypatch):
    """The package on the search path, in an empty folder with three numbers; or one that is broken."""
    module, text = getattr(request, "param", (MODULE, TEXT))
    folder = install(
        tmp_path / "site",
        "strange-spread",
        {"strange_spread": module},
        {"mdnum.verbs": {"spread": "strange_spread"}},
    )
    if text is not None:
        (folder / "strange_spread.toml").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.chdir(tmp_path)
    Path("numbers.txt").write_text("3.5\n1.25\n2\n")
    yield folder
    sys.modules.pop("strange_spread", None)


def test_its_command_runs_and_its_folder_is_judged_shown_and_read(site, capsys):
    assert call("--help") == 0
    assert "Verbs of other packages\n  spread   Say how" in capsys.readouterr().out
    assert call("spread", "--help") == 0 and "--no-sorted" in capsys.readouterr().out
    assert "strange_spread" not in sys.modules
    assert call("spread", "numbers.txt", "--no-sorted", "-o", "out") == 1
    lines = printed(capsys)
    assert lines[0].startswith("3 numbers within 2.25.")
    assert "1 1.25" in lines and lines[-1] == "wrote out/report.html"
    # its columns mean what it says, whatever mdnum calls so
    fields = {field.name: field.metadata for field in pq.read_schema("out/values.parquet")}
    assert fields["number"] == {b"description": b"place in the file"} and not fields["mark"]
    assert fields["value"] == {b"description": meaning("any", "energy")[1].encode()}
    assert fields["weight"] == {b"description": b"weight"}
    # from Python, and written again from its folder
    folder = RunFolder.open("out")
    assert (folder.kind, folder.layout.command) == ("spread", "spread")
    table = folder.read("values")
    assert table["value"].tolist() == [3.5, 1.25, 2.0] and set(table["mark"]) == {"mine"}
    assert list(table) == ["number", "value", "mark"] and folder.damaged() == {}
    page = Path("out/report.html").read_text(encoding="utf-8")
    assert "numbers are 2.25 apart" in page and "1.25" in page
    assert call("report", "out") == 0 and Path("out/report.html").read_text(encoding="utf-8") == page
    Path("out/notes.txt").write_text("of somebody else")
    assert list(RunFolder.open("out").damaged()) == ["notes.txt"]
    import strange_spread  # pyright: ignore[reportMissingImports]

    outcome = strange_spread.spread("numbers.txt", above=9.0)
    assert outcome.folder.name == "spread-1" and not outcome.verdict.findings
    assert isinstance(outcome.page.sections[0].parts[0], Table)
    capsys.readouterr()
    assert call("spread", "numbers.txt", "--above", "9", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == schema("spread")["$id"] == "mdnum/answer/1"
    assert Draft202012Validator(schema("spread")).is_valid(document)
    assert not Draft202012Validator(schema("spread")).is_valid({**document, "status": "good"})


SCHEMA = {"$id": "spread/2", "properties": {"above": {"type": "number"}}}
OWN = TEXT.replace("[sentences]", '[schemas]\nspread = "own.json"\n\n[sentences]')


@pytest.mark.parametrize("site", [(MODULE, OWN)], indirect=True)
def test_its_documents_are_those_of_its_own_schema(site, capsys):
    (site / "own.json").write_text(json.dumps(SCHEMA))
    assert call("spread", "numbers.txt", "--above", "9", "--json", "-o", "out") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["schema"], document["kind"]) == ("spread/2", "spread")
    assert schema("spread") == SCHEMA and Draft202012Validator(SCHEMA).is_valid(document)


DOCUMENTED = (
    (Path(__file__).parents[1] / "docs/extending.md").read_text(encoding="utf-8").split("## A verb")[1]
)
BLOCKS = [DOCUMENTED.split(f"```{language}\n")[1].split("```")[0] for language in ("python", "toml")]


@pytest.mark.parametrize("site", [BLOCKS], indirect=True)
def test_the_documented_verb_works(site, capsys):
    assert call("spread", "numbers.txt", "--above", "2", "-o", "out") == 1
    assert printed(capsys)[-1] == "wrote out/report.html"
    assert RunFolder.open("out").read("values")["value"].tolist() == [3.5, 1.25, 2.0]
    assert call("spread", "numbers.txt", "--above", "3", "--no-report", "--json") == 0
    assert json.loads(capsys.readouterr().out)["above"] == 3.0


RESUMED = """
from contextlib import closing
from dataclasses import dataclass

from mdnum.report.finding import conclude
from mdnum.store.answers import Answers, restored, take
from mdnum.verbs import frame


@dataclass
class State:
    numbers: list[float]
    seconds: float = 0.0


def spread(path=None, *, resume=None, stop=False, **keep):
    if resume is None:
        state = State([float(line) for line in open(path)])
        with frame.new_folder("spread", "spread", keep.get("out")) as folder:
            Answers(folder, state).save()
            keep["progress"](1, 2, {"phase": "run", "folder": folder.path})
            raise KeyboardInterrupt
    with closing(take(resume, frame.layout("spread"))) as folder:
        state = restored(folder, State)
        folder.restart()
        values = {"number": [0], "value": state.numbers[:1]}
        frame.store(folder, {"seconds": state.seconds}, {"values": values})
        return frame.finish(folder, report=False)


def judge(view):
    return conclude([], headline=f"{view.table('values')['value'][0]} comes first.")


KINDS = {"spread": frame.Verb(judge, lambda view, verdict: view.page("Spread", "", [], []))}
"""
RESUMABLE = """
[command]
help = "Say which number comes first."
calls = "spread"
shares = ["of a folder"]
resumes = "spread"
missing = ["no file", "Name one"]
arguments.path = { type = "path", metavar = "FILE", optional = true, new = true, help = "Numbers." }
options.resume = { type = "folder", metavar = "DIR", help = "Go on with that." }

[kinds.spread]
command = "spread"
resumes_from = "answers.json"
tables.values = "number:int64 value"
"""


@pytest.mark.parametrize("site", [(RESUMED, RESUMABLE)], indirect=True)
def test_a_verb_that_was_stopped_is_resumed(site, capsys):
    assert call("spread", "numbers.txt") == 130
    assert "Continue it with `mdnum spread --resume runs/spread-1`" in capsys.readouterr().err
    assert call("run", "--resume", "runs/spread-1") == 2
    assert "is a folder of `mdnum spread`" in capsys.readouterr().err
    for words, said in (
        (("numbers.txt", "--resume", "runs/spread-1"), "FILE is an option of"),
        ((), "no file"),
    ):
        assert call("spread", *words) == 2 and said in capsys.readouterr().err
    assert call("spread", "--resume", "runs/spread-1") == 0
    assert printed(capsys)[0] == "3.5 comes first."
    assert RunFolder.open("runs/spread-1").read("values")["value"].tolist() == [3.5]


def test_its_folder_is_one_clear_line_without_the_package(site, capsys):
    assert call("spread", "numbers.txt", "-o", "out") == 1
    capsys.readouterr()
    # another process, which has not the package on its path
    python = [sys.executable, "-P"]
    done = subprocess.run([*python, "-m", "mdnum", "report", "out"], env=environment(), stderr=-1, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "writes folders of kind 'spread'" in done.stderr
    code = "from mdnum.store import RunFolder; print(RunFolder.open('out').read('values')['value'].tolist())"
    read = subprocess.run([*python, "-c", code], env=environment(), stdout=-1, text=True)
    assert read.stdout.strip() == "[1.25, 2.0, 3.5]"


@pytest.mark.parametrize(
    ("site", "said"),
    [
        ((MODULE, None), "has no text file"),
        ((MODULE.replace("def spread", "def sprade"), TEXT), "no function spread"),
        ((MODULE.replace('KINDS = {"spread"', 'KINDS = {"other"'), TEXT), "KINDS of strange_spread"),
        ((MODULE.replace('KINDS = {"spread"', 'KINDS = {"grad"'), TEXT.replace("kinds.spread", "kinds.grad")),
         "folders of kind 'grad'"),
        ((MODULE, TEXT.replace("mark:word", "mark:colour")), "columns of table 'values'"),
        (("raise ImportError('nothing')", TEXT), "ImportError: nothing"),
    ],
    indirect=["site"],
)  # fmt: skip
def test_a_verb_that_is_not_what_it_declares_names_its_package(site, capsys, said):
    assert call("spread", "numbers.txt", "--json") == 2
    error = json.loads(capsys.readouterr().out)["error"]["message"]
    assert "strange-spread" in error and said in error
    # and the others are there
    assert call("--help") == 0 and "Simulate a system" in capsys.readouterr().out


def test_a_folder_of_before_is_one_clear_line_and_its_tables_can_be_read(site, capsys):
    assert call("spread", "numbers.txt", "-o", "out") == 1
    made = files.load(Path("out"))
    assert made is not None
    made.layout = None
    files.save(Path("out"), made)
    capsys.readouterr()
    assert call("report", "out") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "an earlier version" in error
    assert RunFolder.open("out").read("values")["value"].tolist() == [1.25, 2.0, 3.5]
    with pytest.raises(FolderError, match="no table 'series'"):
        RunFolder.open("out").read("series")


def test_a_kind_that_nobody_declares_is_refused_before_a_folder_is_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(InputError, match=r"installed package .* kind 'nothing'"),
        frame.answering("nothing", "x"),
    ):
        pass
    assert not list(tmp_path.iterdir())
