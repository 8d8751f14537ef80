"""An option that a question of `mdnum fork` does not use is refused, for each of the questions."""

from __future__ import annotations

import pytest
from command_line import call

from mdnum.cli.fork_options import TAKES

_ALL = {
    "--steps": ("--steps", "10"), "--split": ("--split", "0.1"), "--repeats": ("--repeats", "7"),
    "--set": ("--set", "dynamics.seed=3"), "--no-counterfactual": ("--no-counterfactual",),
    "--no-back": ("--no-back",), "--no-lyapunov": ("--no-lyapunov",), "--minimal": ("--minimal",),
    "--pin": ("--pin", "fork"), "--most": ("--most", "3"), "--benign": ("--benign",), "-o": ("-o", "x"),
    "--no-report": ("--no-report",), "--replay": ("--replay",),
}  # fmt: skip
_MD = "argon/crystal-108"
_ASKED = {
    "RUN_A RUN_B": ("a", "b"),
    "RUN_A RUN_B --replay": ("a", "b", "--replay"),
    "--vary": (_MD, "--vary", "skin"),
    "--vary all": (_MD, "--vary", "all"),
    "--vary CHOICE --benign": (_MD, "--vary", "skin", "--benign"),
    "--along": (_MD, "--along", "sigma=1:2"),
    "--processes": (_MD, "--processes"),
    "--certify": (_MD, "--certify"),
    "--forecast": (_MD, "--forecast", "1e-6"),
    "--vary of a ball": ("ball/drop", "--vary", "start"),
    "--vary all of a ball": ("ball/drop", "--vary", "all"),
    "--certify of a ball": ("ball/drop", "--certify"),
}


def test_every_question_is_here():
    assert set(_ASKED) == set(TAKES)
    assert all(option in _ALL for takes in TAKES.values() for option in takes)


@pytest.mark.parametrize("question", _ASKED)
def test_an_option_that_a_question_does_not_use_is_refused(question, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for option, words in _ALL.items():
        # these make another question of it
        another = (question, option) in (("--vary", "--benign"), ("RUN_A RUN_B", "--replay"))
        if option in TAKES[question] or another:
            continue
        assert call("fork", *_ASKED[question], *words) == 2, option
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and option.lstrip("-") in error, error
    assert not list(tmp_path.iterdir())


def test_the_options_that_are_taken_are_named(capsys):
    assert call("fork", _MD, "--certify", "--split", "3", "--no-counterfactual") == 2
    error = capsys.readouterr().err
    assert "--split and --no-counterfactual would change nothing of mdnum fork --certify" in error
    assert "takes --steps, --set, -o, --no-report, --json" in error
