"""Questions about forks of molecular dynamics that are asked of a ball, and the other way around."""

from __future__ import annotations

import pytest

import mdnum
from mdnum.errors import InputError
from mdnum.systems import load

#: Heights that sums and products of few digits reach: plain rationals follow it.
SMALL = {
    "contact.k": 512, "integrator.timestep": 0.015625, "start.height": 0.40625, "flight.gravity": 9.75,
}  # fmt: skip
FEW = {"bfloat16": {"state": "bfloat16", "arithmetic": "bfloat16", "decision": "bfloat16"}, "float64": {}}


def test_a_ball_is_certified():
    found = mdnum.fork_certify("ball/drop", steps=80, policies=FEW, overrides=SMALL)
    assert found.folder is None and found.certificate.steps == 80
    horizons = {row["policy"]: row["horizon"] for row in found.summary["ranking"]}
    assert horizons["float64"] is None and horizons["bfloat16"] == found.certificate.ranking[1].horizon
    assert horizons["bfloat16"] > 0
    loaded = mdnum.fork_certify(load("ball/drop", SMALL), steps=80, policies=FEW)
    assert loaded.summary == found.summary


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: mdnum.fork_certify("ball/drop", out="here"), "out is an option of molecular dynamics"),
        (lambda: mdnum.fork_certify("ball/drop", report=True), "the ranking of a ball leaves no folder"),
        (lambda: mdnum.fork_processes("ball/drop"), "mdnum ball --demo determinism"),
        (lambda: mdnum.fork_processes(load("ball/drop")), "mdnum ball --demo determinism"),
        (lambda: mdnum.fork_forecast("ball/drop", 1e-6), "the margin that `mdnum ball` records"),
    ],
)
def test_what_a_ball_cannot_be_asked_says_what_can(ask, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words):
        ask()
    assert not list(tmp_path.iterdir())
