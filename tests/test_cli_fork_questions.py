"""The other questions of `mdnum fork`, from the command line to the answer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call

from mdnum.cli.fork_map import interval
from mdnum.errors import InputError
from mdnum.forks.exact import program
from mdnum.rollout.run import run
from mdnum.store import RunFolder


def test_an_interval_is_a_key_and_two_numbers():
    assert interval("potential.sigma=3.40:3.41") == ("potential.sigma", 3.40, 3.41)
    assert interval(" r_cut = 1e0 : 2.5") == ("r_cut", 1.0, 2.5)
    for text in ("sigma", "sigma=3", "sigma=a:b", "=1:2", "sigma=1:2:3"):
        with pytest.raises(InputError, match="KEY=LOW:HIGH"):
            interval(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("argon/crystal-108", "--certify", "--forecast", "1e-6"), "different questions"),
        (("argon/crystal-108", "--vary", "skin", "--along", "sigma=1:2"), "different questions"),
        (("argon/crystal-108", "--benign"), "--benign needs a choice"),
        (("argon/crystal-108", "--vary", "vmap"), "--processes"),
        (("argon/crystal-108", "--vary", "xla=fast"), "--processes"),
        (("argon/crystal-108", "--vary", "presicion"), "Did you mean precision"),
        (("argon/crystal-108", "--vary", "zzz"), "no choice 'zzz'. There are precision, reduction,"),
        (("silicon/tersoff-512", "--vary", "precision"), "`mdnum fork` lists them"),
        (("--certify",), "no system given"),
        (("argon/crystal-108", "--forecast", "-1"), "expected a length above 0"),
        (("argon/crystal-108", "--along", "sigma"), "KEY=LOW:HIGH"),
        (("argon/crystal-108", "--along", "sigma=2:1"), "nothing between 2.0 and 1.0"),
        (("argon/crystal-108", "--along", "sgima=1:2"), "Did you mean potential.sigma?"),
        (("argon/crystal-108", "--along", "timestep=-1:1"), "expected a value above 0"),
        (("argon/crystal-108", "--along", "r_cut=1.5:9"), "exceeds half the smallest perpendicular"),
        (("binary/kob-andersen-1000", "--along", "epsilon=1:2"), "could be any of"),
        (("argon/crystal-108", "--most", "3"), "--most needs a number"),
        (("argon/crystal-108", "--processes", "--certify"), "different questions"),
        (("silicon/tersoff-512", "--processes"), "many-body"),
        (("silicon/tersoff-512", "--certify", "--steps", "2"), "Lennard-Jones"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("fork", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


def test_what_is_missing_is_named_with_its_extra(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "installed", lambda: False)
    assert call("fork", "argon/crystal-108", "--certify", "--steps", "2", "--set", "cutoff.radius=1.5") == 2
    assert "mdnum[exact]" in capsys.readouterr().err


def test_a_forecast_names_the_flip_that_comes(tmp_path: Path, capsys):
    arguments = ("fork", "argon/crystal-108", "--forecast", "1e-6", "--steps", "60")
    assert call(*arguments, "--json", "-o", str(tmp_path / "a")) == 0
    answer = json.loads(capsys.readouterr().out)
    first = answer["first"][0]
    # the fork of two runs that far apart is at step 5, by this pair
    assert (first["step"], first["i"], first["j"]) == (5, 28, 64)
    assert call(*arguments, "--no-report", "-o", str(tmp_path / "b")) == 0
    assert "28–64 at step 5" in capsys.readouterr().out
    assert (tmp_path / "a/report.html").exists() and not (tmp_path / "b/report.html").exists()
    reach = RunFolder.open(tmp_path / "a").read("reach")
    # the first step at which the nearest decision is nearer than the displacement is the step foretold
    assert int(np.flatnonzero(reach["positive"] <= 1e-6)[0]) == 5
    assert (reach["i"][5], reach["j"][5]) == (28, 64)


def test_two_folders(tmp_path: Path, capsys):
    run("argon/crystal-108", out=tmp_path / "a", steps=40)
    run("argon/crystal-108", out=tmp_path / "b", steps=40, overrides={"precision.force": "float32"})
    assert call("fork", str(tmp_path / "a"), str(tmp_path / "b"), "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["steps"] == 40 and answer["seed"] == 0
    assert ["precision.force", "float64", "float32"] in answer["differences"]
    assert call("fork", str(tmp_path / "a"), str(tmp_path / "b")) == 0
    assert "precision.force" in capsys.readouterr().out
    assert call("fork", str(tmp_path / "a"), str(tmp_path / "nowhere")) == 2
    assert "no such folder" in capsys.readouterr().err
