"""What every public verb does with a keyword that it does not have, and with an array for a path."""

from __future__ import annotations

import inspect
import subprocess
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from command_line import call

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.store import files
from mdnum.verbs.frame import Keep, content

# other names of the package take no options of a verb
_NO_VERBS = {
    "systems", "load", "build", "simulation", "diagnose", "check", "allow_code", "MdnumCalculator", "method",
    "value_and_grad", "changed", "parameters", "read", "energy_function",
}  # fmt: skip
VERBS = sorted(
    name for name in mdnum.__all__ if name not in _NO_VERBS and inspect.isfunction(getattr(mdnum, name))
)


def test_no_verb_is_forgotten() -> None:
    assert {"run", "fork", "grad", "flips", "conform", "audit_calculator", "bounce"} <= set(VERBS)
    assert len(VERBS) >= 15


@pytest.mark.parametrize("name", VERBS)
def test_a_misspelled_keyword_is_rejected_with_the_nearest_right_one(
    name: str, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    verb = getattr(mdnum, name)
    positional = [None] * sum(
        one.default is one.empty and one.kind is one.POSITIONAL_OR_KEYWORD
        for one in inspect.signature(verb).parameters.values()
    )
    # an argument that cannot be used is not reached
    with pytest.raises(InputError, match=r"'reports'.*mean report\? ") as caught:
        verb(*positional, reports=False)
    assert isinstance(caught.value, TypeError)
    with pytest.raises(InputError, match=rf"^{name}\(\) has no keyword 'zzz'"):
        verb(*positional, zzz=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("verb", "word", "right"),
    [
        (mdnum.flips, "cutoff", "cutoffs"),
        (mdnum.flips, "topolgy", "topology"),
        (mdnum.run, "override", "overrides"),
        (mdnum.fork_folders, "repeat", "repeats"),
        (mdnum.grad, "replica", "replicas"),
    ],
)
def test_of_each_verb_its_own_keywords_are_known(verb, word: str, right: str) -> None:
    with pytest.raises(InputError, match=rf"\(\) has no keyword '{word}'\. .* {right}\?"):
        verb(*["nothing"] * (2 if verb is mdnum.fork_folders else 1), **{word: 5.0})


def test_right_keywords_pass(tmp_path) -> None:
    # told apart by what is wrong instead
    with pytest.raises(InputError, match="no such file"):
        mdnum.flips(
            "nothing.xtc", cutoffs=[5.0], **dict.fromkeys(Keep.__annotations__.keys() - {"allow_code"})
        )


# without the type checks of the tests, which would answer before mdnum does
ARRAYS = """
import numpy as np, mdnum
three = np.zeros((5, 40, 3))
for name, arguments in (
    ("flips", ("a.xtc", three)), ("run", (three,)), ("fork", (three,)), ("bounce", (three[0],)),
    ("grad", (three, "msd", "epsilon")),
    ("fork_folders", (three, "b")), ("audit_calculator", ("ase.calculators.emt:EMT", three[0])),
):
    try:
        getattr(mdnum, name)(*arguments)
    except mdnum.InputError as error:
        print(name, error)
"""


def test_an_array_for_a_path_is_refused_in_a_line(tmp_path) -> None:
    words = [sys.executable, "-W", "ignore", "-c", ARRAYS]
    (tmp_path / "a.xtc").write_bytes(b"no trajectory")
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 7
    for line in lines:
        assert " path " in line and len(line) < 250
        assert "of shape (5, 40, 3)" in line or "of shape (40, 3)" in line or "list given" in line


def test_arrays_go_where_the_message_says(tmp_path) -> None:
    x = np.random.default_rng(3).uniform(0, 9, (5, 40, 3)).astype(np.float32)
    found = mdnum.flips(x, cutoffs=3.0, out=tmp_path / "f", report=False)
    inside = [np.linalg.norm(one[:, None] - one, axis=2)[np.triu_indices(40, 1)] < 3.0 for one in x]
    assert len(found.table("flips")) == sum(np.count_nonzero(a != b) for a, b in pairwise(inside))
    assert found.summary["time"] == "frame" and found.summary["resolution"]["kind"] == "float32"


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ({"cutoffs": 5.0}, ["r < 5"]),
        ({"cutoffs": np.float32(5)}, ["r < 5"]),
        ({"cutoffs": (3, 5.0)}, ["r < 3", "r < 5"]),
        ({"nearest": 4}, ["4 nearest"]),
        ({"pairs": "O-H=2.5"}, ["O-H < 2.5"]),
        ({"pairs": {("O", "H"): 2.5}}, ["O-H < 2.5"]),
    ],
)
def test_one_rule_needs_no_sequence(asked, names) -> None:
    from mdnum.verbs.flips import rules

    assert all(said in one.name for one, said in zip(rules(**asked), names, strict=True)), rules(**asked)


@pytest.mark.parametrize("asked", [{"cutoffs": "3"}, {"nearest": ["4"]}])
def test_a_word_is_no_cutoff(asked) -> None:
    from mdnum.verbs.flips import rules

    with pytest.raises(InputError, match="not a number"):
        rules(**asked)


def test_a_folder_goes_by_the_content_of_what_is_asked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    loaded = mdnum.load("pair/at-cutoff")
    mdnum.systems.copy("pair/at-cutoff", tmp_path / "mine")
    mine = (tmp_path / "mine/at-cutoff.toml").rename(tmp_path / "mine/another.toml")
    same = [content("run", {"system": one, "steps": 5}) for one in ("pair/at-cutoff", loaded, mine)]
    same += [content("run", {"system": mine, "steps": 5, "out": "x", "report": False})]
    assert len(set(same)) == 1 and len(same[0]) == 16
    others = [
        content("run", {"system": mine, "steps": 6}), content("fork", {"system": mine, "steps": 5}),
        content("run", {"system": mine, "steps": 5, "keep": {"overrides": {"dynamics.seed": 7}}}),
        content("run", {"system": "argon/crystal-108", "steps": 5}),
    ]  # fmt: skip
    mine.write_text(mine.read_text().replace("timestep = ", "timestep = 1"))
    others += [content("run", {"system": mine, "steps": 5})]
    assert len({*same, *others}) == 6
    # a file by its bytes, whatever its name, and which of its frames
    for name, text in (("a.xyz", "1"), ("b.xyz", "1"), ("c.xyz", "2")):
        (tmp_path / name).write_text(text)
    a, b, c, frames = (
        content("flips", {"trajectory": word, "cutoffs": [3.0]})
        for word in ("a.xyz", tmp_path / "b.xyz", "c.xyz", "a.xyz@5:")
    )
    assert a == b and len({a, c, frames}) == 3
    with pytest.raises(InputError, match="to plain data"):
        content("conform", {"pairs": lambda: None})


def test_a_question_that_was_answered_is_read_and_one_that_was_stopped_is_refused(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    asked: Any = {"steps": 3, "out": "runs/a-{content}", "check": False, "report": False}
    once = mdnum.run("pair/at-cutoff", **asked)
    first, made = once.folder, (once.folder / "summary.json").stat().st_mtime_ns
    code = "import mdnum; print(mdnum.run('pair/at-cutoff', steps=3, out='runs/a-{content}', check=False))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not other.returncode and f"answered before, read from {first}" in other.stdout
    assert (first / "summary.json").stat().st_mtime_ns == made and (first / "report.html").exists()
    repeated = mdnum.run("pair/at-cutoff", **asked)
    assert repeated.reused and not once.reused and repeated.summary == once.summary
    words = ("run", "pair/at-cutoff", "--steps", "3", "--no-check", "--no-report", "-o", "runs/b-{content}")
    assert call(*words) == 0
    capsys.readouterr()
    assert call(*words) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("answered before, read from runs/b-")
    files.update(first, {}, finished=False)
    with pytest.raises(FolderError, match="already holds a run"):
        mdnum.run("pair/at-cutoff", **asked)
    again = mdnum.run("pair/at-cutoff", steps=4, out="runs/a-{content}", check=False, report=False)
    assert again.folder.parent == first.parent and again.folder != first
