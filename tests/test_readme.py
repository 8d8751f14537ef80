"""What the README promises is there: the two commands, a system file that loads, verbs that exist."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from command_line import call

from mdnum import systems

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
# pages of docs/reference are made when the site is built, and tutorials are executed
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "how").glob("*.md")),
]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 160


def test_the_two_commands_stand_there_word_for_word():
    lines = README.splitlines()
    assert "python3 -m pip install -e . && mdnum run argon/liquid-864" in lines
    assert "python3 -m pip install -e '.[test]' && pytest" in lines


def test_the_example_of_a_system_file_loads(tmp_path: Path):
    text = next(block for block in _blocks("toml") if "[structure]" in block)
    tomllib.loads(text)
    lattice = 'builder = "fcc"\nsymbol = "Ar"\nlattice_constant = 5.26\nrepeat = [4, 4, 4]\n'
    runnable, replaced = re.subn(r'^file = "my-argon.*$', lattice, text, flags=re.MULTILINE)
    assert replaced == 1
    path = tmp_path / "readme.toml"
    path.write_text(runnable)
    system = systems.load(str(path))
    assert system.spec.cutoff is not None
    assert system.spec.cutoff.kind == "hard"
    assert len(system.atoms) == 256


@pytest.mark.parametrize("python", _blocks("python"))
def test_the_python_example_compiles(python: str):
    compile(python, "README.md", "exec")


def test_every_verb_and_option_named_is_known(capsys):
    measured = ("hostile-input", "lost-flips", "verdict-calibration")
    text = "\n".join(page.read_text() for page in PAGES if page.stem not in measured)
    verbs = {(verb,) for verb in ("run", "fork", "grad", "flips", "ball", "audit", "conform")}
    named = {tuple(words.split()) for words in re.findall(r"`mdnum ((?:[a-z]+ ?)+)", text)}
    assert ("check", "energy") in named
    known = ""
    for words in sorted(named | verbs):
        assert call(*words, "--help") == 0, shlex.join(words)
        known += capsys.readouterr().out
    for option in re.findall(r"`-?(-[-a-z]+)", text):
        assert option in known, option


def test_every_file_linked_is_there():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).is_file(), f"{page.name}: {target}"


@pytest.mark.nightly
@pytest.mark.parametrize(
    "line", re.findall(r"^mdnum .*$", (ROOT / "docs" / "start.md").read_text(encoding="utf-8"), re.MULTILINE)
)
def test_a_command_of_the_first_page_answers(line: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # 1: it has findings
    assert call(*shlex.split(line)[1:]) in (0, 1)
