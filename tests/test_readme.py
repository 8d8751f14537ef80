"""What the README promises is there: the two commands, a system file that loads, verbs that exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from mdnum import systems

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_two_commands_stand_there_word_for_word():
    lines = README.splitlines()
    assert "python3 -m pip install -e . && mdnum run argon/liquid-864" in lines
    assert "python3 -m pip install -e '.[test]' && pytest" in lines


def test_the_example_of_a_system_file_loads(tmp_path: Path):
    (text,) = _blocks("toml")
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


def test_every_verb_and_option_named_is_known():
    named = {tuple(match.split()) for match in re.findall(r"`mdnum ((?:[a-z]+ ?)+)", README)}
    assert ("check", "energy") in named
    for words in sorted(named):
        done = subprocess.run(
            [sys.executable, "-m", "mdnum", *words, "--help"], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, shlex.join(words)
    known = ""
    for verb in ("run", "fork", "grad", "flips", "ball", "audit", "conform"):
        done = subprocess.run(
            [sys.executable, "-m", "mdnum", verb, "--help"],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        known += done.stdout
    for option in re.findall(r"`-?(-[-a-z]+)", README):
        assert option in known


def test_every_file_linked_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if "://" not in target:
            assert (ROOT / target).is_file(), target
