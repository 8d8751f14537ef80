"""A comparison into its folder and onto its page, of either world: true to the runs that were followed."""

from __future__ import annotations

import importlib
import json
import tomllib
from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import call, printed

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.forks import Twin, choices
from mdnum.forks.linearized import Lyapunov
from mdnum.forks.pair import Screened
from mdnum.forks.worlds import program_of
from mdnum.numerics.verdicts import Delay, Growth
from mdnum.provenance import hashes
from mdnum.report.finding import Texts
from mdnum.report.section import Plot, Table
from mdnum.report.words import number
from mdnum.rollout.engine import Engine
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.load import copy
from mdnum.verbs import fork_verdict, frame
from mdnum.verbs.fork_page import page
from mdnum.verbs.frame import View

#: `mdnum.verbs.fork` is the function.
MODULE = importlib.import_module("mdnum.verbs.fork")
STEPS = 400
#: Of the pair, everywhere: one program.
PAIR_STEPS = 400
#: Free runs only.
BARE: dict[str, Any] = {"counterfactual": False, "repeats": 0}
BALLS = """
about = "Three balls."
world = "ball"
[start]
height = [0.3, 0.301, 0.52]
[contact]
kind = "projection"
k = 0.5
[stop]
rule = "sum"
tol = 1e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 120
[fork]
vary = "contact=earlier"
split = 0.002
"""


def use(monkeypatch, make, **looks):
    """A choice that makes a twin of its own."""

    class StandIn(choices.Choice):
        name = "stand-in"  # pyright: ignore
        must_hold = looks.get("must_hold", False)

        def make(self, system):
            return make(system)

    monkeypatch.setattr(choices, "parse", lambda *text: StandIn())


def codes(outcome) -> list[str]:
    return [finding.code for finding in outcome.verdict.findings]


@pytest.fixture(scope="module")
def crystal(tmp_path_factory):
    """float32 against float64 on the crystal, up to a little after the fork."""
    out = tmp_path_factory.mktemp("forks") / "crystal"
    seed = {"dynamics.seed": 4}
    return mdnum.fork("argon/crystal-108", steps=STEPS, out=out, overrides=seed, minimal=True, pin="fork")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("systems") / "three.toml"
    path.write_text(BALLS)
    return path


@pytest.fixture(scope="module")
def balls(file, tmp_path_factory):
    """What the system file asks for itself: its first contact a step earlier."""
    return mdnum.fork(file, out=tmp_path_factory.mktemp("forks") / "three")


def test_the_summary_and_the_tables_agree(crystal):
    """What the record of a frozen comparison leaves out: times, reasons, ambiguous pairs, sums of flips."""
    made, summary, folder = crystal.result, crystal.summary, RunFolder.open(crystal.folder)
    assert summary["fork_time"] == pytest.approx(0.004 * made.dates.fork) and summary["split_time"] is None
    assert [one["code"] for one in summary["reasons"]] == [code for code, _ in made.verdict.reasons]
    assert summary["growth_rate_time"] == pytest.approx(summary["growth_rate"] / 0.004)
    assert summary["changes"]["precision.force"] == ["float64", "float32"]
    assert summary["shares"] == [] and summary["minimal"]["pairs"] is None
    # float32 decides: its own rounding is what makes it fork, and A is its shadow
    assert summary["certified_horizon"]["A"] == STEPS and summary["ambiguous"]["A"] == 0
    assert (
        summary["certified_horizon"]["B"] < made.dates.fork and summary["protected_until"] < made.dates.fork
    )
    assert (summary["shadow"], summary["shadow_horizon"]) == ("A", made.dates.fork - 1)
    exponent = summary["lyapunov"]
    assert exponent["steps"] == 400 and exponent["rate_time"] == pytest.approx(exponent["rate"] / 0.004)
    table, series = folder.read("separation"), made.series
    np.testing.assert_allclose(table["time"], 0.004 * np.arange(STEPS + 1))
    for column, name in (("free", "B"), ("imposed", "B|A"), ("back", "A|B"), ("energy_b", "energy B")):
        np.testing.assert_array_equal(table[column], series[name])
    doubts, first = folder.read("ambiguous_pairs"), summary["ambiguous_first"]
    assert first["A"] is None and first["B"] == {name: doubts[name][0] for name in doubts if name != "run"}
    assert set(doubts["run"]) == {"B"} and len(doubts["step"]) == summary["ambiguous"]["B"] > 0
    assert (np.abs(doubts["margin"]) <= doubts["bound"]).all()
    np.testing.assert_array_equal(np.bincount(doubts["step"], minlength=STEPS + 1), table["ambiguous_b"])
    # the pairs that differ are the flips that opened a difference less those that closed one
    flips = folder.read("cross_flips")
    change = np.where(flips["differs"], 1, -1)
    held = np.array([change[flips["step"] <= step].sum() for step in table["step"]])
    np.testing.assert_array_equal(held, table["cross"])


def positions(simulation, step):
    """Positions at a step, from the engine alone."""
    for segment in Engine(simulation, STEPS).segments():
        if segment.last >= step:
            return segment.unsorted("x", step - segment.first).astype(np.float64)
    raise AssertionError("the run ended early")


def nearest(cell, vectors):
    """Shortest images, by trying all 27."""
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) @ cell
    images = vectors[..., None, :] + shifts
    return np.take_along_axis(images, (images**2).sum(-1).argmin(-1)[..., None, None], -2)[..., 0, :]


def test_the_atoms_at_the_fork_are_those_of_the_runs(crystal):
    made, around = crystal.summary["decision"], RunFolder.open(crystal.folder).read("neighborhood")
    a, b = crystal.result.twin.a.simulation, crystal.result.twin.b.simulation
    i, j = made["i"], made["j"]
    assert around["atom"][:2].tolist() == [i, j]
    x_a, x_b = positions(a, made["step"]), positions(b, made["step"])
    cell = np.asarray(a.cell.matrix)
    middle = x_a[i] + nearest(cell, x_a[j] - x_a[i]) / 2
    place = np.stack([around[name] for name in "xyz"], axis=1)
    moved = np.stack([around[f"d{name}"] for name in "xyz"], axis=1)
    np.testing.assert_allclose(place, nearest(cell, x_a[around["atom"]] - middle), atol=1e-12)
    np.testing.assert_allclose(moved, nearest(cell, x_b[around["atom"]] - x_a[around["atom"]]), atol=1e-12)
    # all that are near, and none that is not
    distance = np.sqrt((nearest(cell, x_a - middle) ** 2).sum(axis=1))
    assert set(around["atom"].tolist()) == set(np.flatnonzero(distance <= 1.25 * a.r_cut).tolist())
    # the flip is a matter of float32's rounding: its margin is within B's bound, and not in A's
    gap = np.linalg.norm(place[1] - place[0])
    assert made["distance"] == pytest.approx(gap, abs=1e-9)
    assert made["margins"]["A"] == pytest.approx(made["cutoffs"]["A"] ** 2 - gap**2, abs=1e-12)
    assert made["margins"]["A"] * made["margins"]["B"] < 0, "the runs decide differently"
    assert made["ambiguous_in"] == ["B"] and not made["ambiguous"]


def test_a_folder_is_a_system_that_loads_again_and_a_page_that_is_written_again(crystal, balls):
    for outcome, size in ((crystal, "atoms"), (balls, "balls")):
        again = load(outcome.folder)
        assert again.name == outcome.summary["system"]
        count = len(again.atoms) if size == "atoms" else again.balls
        assert count == outcome.summary[size] and (outcome.folder / "log.txt").exists()
        assert RunFolder.open(outcome.folder).provenance["system"] == again.name
        text = (outcome.folder / "report.html").read_text(encoding="utf-8")
        assert outcome.verdict.headline in text.replace("&#39;", "'")
        frame.finish(outcome.folder)
        assert (outcome.folder / "report.html").read_text(encoding="utf-8") == text
        assert json.loads((outcome.folder / "summary.json").read_text()) == outcome.summary
    assert tomllib.loads((balls.folder / "system.toml").read_text())["fork"]["vary"] == "contact=earlier"


def test_a_choice_that_changes_nothing_is_said_to(tmp_path):
    found = mdnum.fork(
        "pair/at-cutoff", "translate=lattice", steps=PAIR_STEPS, out=tmp_path / "x", report=False, **BARE
    )
    assert found.summary["effect"] == "same" and found.summary["must_hold"] and found.verdict.tone == "good"
    assert codes(found) == [] and found.summary["decision"] is None
    assert found.summary["lyapunov"] is None and found.summary["lyapunov_reason"]
    assert not (found.folder / "neighborhood.parquet").exists()
    assert not (found.folder / "report.html").exists()


@pytest.mark.parametrize("world", ["md", "ball"])
def test_a_promise_that_is_broken_is_an_error(tmp_path, monkeypatch, file, world):
    name, changed, steps = {
        "md": ("pair/at-cutoff", {"cutoff.radius": 2.4}, PAIR_STEPS),
        "ball": (file, {"start.height": [0.3, 0.301, 0.53]}, 60),
    }[world]  # fmt: skip
    other = load(name, changed)
    use(
        monkeypatch,
        lambda system: Twin(program_of(system), program_of(other, steps), "planted"),
        must_hold=True,
    )
    found = mdnum.fork(name, "stand-in", steps=steps, out=tmp_path / "here", report=False, **BARE)
    assert codes(found)[0] == "MUST_HOLD_FORKED" and found.verdict.tone == "error"
    assert found.summary["first_bit"] is not None and found.summary["imposed_until"] is None


def test_a_run_that_blows_up_on_one_side_is_reported(tmp_path, monkeypatch):
    wild = load("argon/crystal-108", {"dynamics.timestep": 10.0})
    use(monkeypatch, lambda system: Twin(program_of(system), program_of(wild), "a wild step"))
    found = mdnum.fork("argon/crystal-108", "stand-in", steps=60, out=tmp_path / "x", report=False, **BARE)
    assert found.summary["status"] == "failed" and list(found.summary["failed"]) == ["B"]
    assert codes(found) == ["RUN_FAILED"]
    # the comparison ends where B does, not where the stretch of A's steps does
    last = found.summary["steps"]
    assert last < 5 and len(found.result.series["B"]) == last + 1 and found.summary["fork"] <= last
    assert np.isfinite(found.result.series["energy A"]).all()
    assert all(flip.step <= last for flip in found.result.flips)


@pytest.mark.parametrize("name", ["argon/crystal-108", "ball/drop"])
def test_screening_ranks_what_was_screened(tmp_path, monkeypatch, name):
    rows = [
        Screened("early", "one", 0, 3, 90, False, None, 100),
        Screened("late", "two", 1, 70, None, True, None, 100, "blow-up of B"),
        Screened("never", "three", None, None, None, True, None, 100),
        Screened("noise", "no noise", None, None, None, False, "no noise"),
    ]
    seen = []

    def screen(system, steps, progress, on, workers):
        assert (on, workers) == (None, None)
        progress(0, 4, "early")
        return rows

    monkeypatch.setattr("mdnum.forks.pair.screen", screen)
    found = mdnum.fork(name, "all", steps=100, out=tmp_path / "x", progress=lambda *given: seen.append(given))
    assert found.result == rows
    assert [row["choice"] for row in found.summary["ranking"]] == ["early", "late", "never"]
    assert found.summary["not_applicable"] == [{"choice": "noise", "reason": "no noise"}]
    assert codes(found) == ["MUST_HOLD_FORKED", "CHOICE_FAILED"] and found.verdict.tone == "error"
    assert seen[0] == (0, 4, {"phase": "early (1 of 4)"})
    assert {key.label: key.value for key in found.page.keys} == {
        "Choices": "3", "Fork": "2", "Split": "1", "No bit differs": "1", "Must hold": "1 of 2",
    }  # fmt: skip
    table = part(found.page, "Ranking", Table)
    assert [row[:5] for row in table.rows] == [
        ("early", 0, 3, 90, ""), ("late", 1, 70, None, "broken"), ("never", None, None, None, "holds"),
    ]  # fmt: skip
    assert table.bad == {1} and (found.folder / "figures/ranking.svg").exists()
    early, _, never = found.summary["ranking"]
    for ranking, tone in (([never], "good"), ([early, never], "info")):
        assert fork_verdict.judge_screen(told(found, ranking=ranking)).tone == tone


@pytest.mark.parametrize(
    ("system", "vary", "options", "words"),
    [
        ("argon/crystal-108", "noise", {}, "noise"),
        ("argon/crystal-108", "precision", {"steps": 0}, "steps = 0"),
        ("argon/crystal-108", "precision", {"split": -1.0}, "split = -1"),
        ("argon/crystal-108", "precision", {"repeats": -1}, "repeats = -1"),
        ("argon/crystal-108", "precision", {"overrides": {"cutoff.knd": 1}}, "knd"),
        ("argon/crystal-108", "precision", {"pin": "3-108"}, "pair 3-108"),
        ("argon/crystal-108", "precision", {"repeats": 2}, "repeats = 2"),
        # what would be left undone, and was without a word
        ("argon/crystal-108", "precision", {"repeats": 4, "counterfactual": False}, "repeats = 4"),
        ("argon/crystal-108", "precision", {"back": True, "counterfactual": False}, "option `back`"),
        ("silicon/tersoff-512", "precision", {"repeats": 4}, "many-body"),
        ("ball/drop", "start", {"repeats": 4, "counterfactual": False}, "repeats = 4"),
        ("ball/drop", "all", {"split": 0.1, "repeats": 4}, "split and repeats"),
        ("argon/crystal-108", "all", {"minimal": True}, "minimal is an option"),
    ],
)
def test_what_is_refused_leaves_no_folder(tmp_path, system, vary, options, words):
    with pytest.raises(InputError, match=words):
        mdnum.fork(system, vary, out=tmp_path / "here", **options)
    assert not (tmp_path / "here").exists()


def test_overrides_of_a_loaded_system_and_used_folders_are_refused(tmp_path, file):
    for system in (load("pair/at-cutoff"), load(file)):
        with pytest.raises(InputError, match="of a loaded system"):
            mdnum.fork(system, "precision", overrides={"dynamics.steps": 3})
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(FolderError, match="already holds"):
        mdnum.fork("pair/at-cutoff", "precision", steps=3, out=tmp_path)
    unfinished = RunFolder.create(tmp_path / "unfinished", frame.layout("fork"))
    unfinished.finalize()
    with pytest.raises(FolderError, match="holds no result"):
        frame.finish(unfinished)


def test_a_run_that_stops_leaves_the_folder_free(tmp_path):
    def stop(step, steps, info):
        if info["phase"] == "run":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mdnum.fork("pair/at-cutoff", "start", steps=PAIR_STEPS, out=tmp_path / "here", progress=stop, **BARE)
    RunFolder.create(tmp_path / "here", frame.layout("md")).close()


def test_a_question_stands_in_the_file_and_is_no_part_of_the_system(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        MODULE,
        "followed",
        lambda system, twin, told, asked, *_, **__: seen.append((told["choice"], asked.steps, asked.split)),
    )
    path = copy("pair/at-cutoff", tmp_path)
    path.write_text(path.read_text() + '\n[fork]\nvary = "reduction=exact"\nsteps = 70\nsplit = 0.01\n')
    mdnum.fork(path)
    mdnum.fork(path, "order", steps=30)
    mdnum.fork(path, overrides={"fork.vary": "start"})
    mdnum.fork("pair/at-cutoff", "order")
    assert seen == [
        ("reduction=exact", 70, 0.01), ("order", 30, 0.01), ("start", 70, 0.01), ("order", None, None),
    ]  # fmt: skip
    plain, asking = load("pair/at-cutoff"), load(path)
    assert hashes(plain)["program"] == hashes(asking)["program"]
    assert "[fork]" in asking.to_toml() and "[fork]" not in plain.to_toml()
    for setting, words in (({"fork.vari": "order"}, "Did you mean vary"), ({"fork.steps": 0}, "steps")):
        with pytest.raises(InputError, match=words):
            load(path, setting)


@pytest.fixture
def summary_of(monkeypatch, tmp_path):
    """The summary of a pair that was followed, as `mdnum.fork` writes it, with an exponent of this rate."""

    def summary(made, rate=None, chaotic=True, number=count()):
        if rate is not None:
            size = rate * np.arange(401.0)
            exponent = Lyapunov(400, 0.004, rate, 1e-5, size, size, 80, chaotic)
            monkeypatch.setattr("mdnum.forks.linearized.lyapunov", lambda *given: exponent)
        monkeypatch.setattr("mdnum.forks.fork", lambda *given, **options: made)
        options: dict[str, Any] = {"overrides": {"dynamics.seed": 4}, "report": False}
        out, asked = tmp_path / f"{next(number)}", rate is not None
        return mdnum.fork("argon/crystal-108", out=out, lyapunov=asked, **options).summary

    return summary


@pytest.mark.parametrize(("rate", "chaotic"), [(0.02, True), (1e-4, False), (0.006, False)])
def test_an_exponent_that_is_none_says_why(crystal, summary_of, rate, chaotic):
    found = summary_of(crystal.result, rate, chaotic)
    assert (found["lyapunov_reason"] is None) == chaotic
    ratio = crystal.result.growth["B"].rate / rate
    assert found["lyapunov"]["ratio"] == (pytest.approx(ratio) if chaotic else None)
    # an ulp of a coordinate between 4 and 8 has grown to the tolerance: from the size of the tangent
    ulp, split = found["lyapunov"]["ulp"], found["lyapunov"]["ulp_split"]
    assert ulp in (2.0**-50, 2.0**-51)
    expected = np.log(crystal.result.tolerance / ulp) / rate
    assert split == pytest.approx(expected, abs=1) if chaotic else split is None


def test_a_prediction_says_what_it_comes_from(crystal, summary_of):
    steps = np.arange(STEPS + 1.0)
    steady, power = 1e-12 * np.exp(0.02 * steps), 1e-9 * steps**2
    for free, split, rate, by in (
        (steady, None, 0.5, "growth"),
        (steady, 9, None, None),
        # a power law is no exponential: the exponent alone can tell
        (power, None, None, None),
        (power, None, 0.0036, "exponent"),
    ):
        made = replace(
            crystal.result,
            dates=replace(crystal.result.dates, split=split),
            series={**crystal.result.series, "B": free},
            tolerance=0.1,
        )
        found = summary_of(made, rate)
        assert found["predicted_by"] == by and (found["predicted_split"] is None) == (by is None)
    # repeats that did not split are kept, and a fit that is none has no line
    delays = (Delay(12, 40, 99, 99), Delay(None, 30, 99, 99))
    made = replace(
        crystal.result, repeats=(delays, delays[1:]), growth={"B": Growth(float("nan"), float("nan"), -1, -1)}
    )
    found = summary_of(made)
    assert found["repeated"] == [{"free": 12, "imposed": 40}, {"free": None, "imposed": 30}]
    assert found["repeated_other"] == [{"free": None, "imposed": 30}]
    assert found["growth"]["B"]["intercept"] is None


NARROW = {"precision.force": "float32"}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    for name, overrides in (("a", {}), ("b", NARROW)):
        mdnum.run(
            "argon/crystal-108", steps=STEPS, out=root / name, overrides=overrides, check=False, report=False
        )
    return root


def test_a_replay_meets_the_stored_runs(runs, capsys):
    asked = {"repeats": 0, "back": False, "lyapunov": False}
    found = mdnum.fork_folders(runs / "a", runs / "b", replay=True, split=1e-9, out=runs / "fork", **asked)
    summary = found.summary
    assert summary["stored"]["fork"] == summary["fork"] and summary["reproduced"]
    # what the two folders cannot say
    assert summary["split"] is not None and summary["effect"] in ("no fork", "cause", "open", "bystander")
    assert {key for key, _, _ in summary["differences"]} >= set(NARROW)
    assert (runs / "fork" / "report.html").stat().st_size > 10_000
    RunFolder.open(runs / "fork").write_summary({**summary, "reproduced": False})
    assert "NOT_REPRODUCED" in codes(frame.finish(runs / "fork", report=False))
    with pytest.raises(InputError, match=r"repeats .*back .*lyapunov"):
        mdnum.fork_folders(runs / "a", runs / "b", **asked)
    assert call("fork", "compare", str(runs / "a"), str(runs / "b"), "-o", str(runs / "seen")) == 0
    lines = printed(capsys)
    assert any(line.startswith("precision.force float64 float32") for line in lines)
    assert call("fork", "compare", str(runs / "a"), str(runs / "nowhere")) == 2
    assert "does not exist" in capsys.readouterr().err


def test_two_finished_runs_of_a_ball(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--no-report", "--steps", "480", "--set", "gradient.of=[]", "--set", "variants={}")
    for name, more in (("a", ()), ("b", ("--set", "start.height=1.01")), ("c", ())):
        assert call("ball", "ball/drop", *small, *more, "-o", name) == 0
    found = mdnum.fork_folders("a", "b").summary
    assert found["differences"] == [["start.height", 1.0, 1.01]] and found["first_bit"] == 0
    a, b = (RunFolder.open(name).read("contacts") for name in "ab")
    # the lower ball touches first
    assert found["fork"] == a["step"][0] < b["step"][0] and found["channel"] == "contact"
    (flip,) = found["decisions"]
    assert (flip["run"], flip["subject"], flip["entered"]) == ("A", [0], True)
    assert flip["margin"] == a["margin"][0]
    same = mdnum.fork_folders("a", "c", report=False)
    assert same.summary["first_bit"] is same.summary["fork"] is None and same.verdict.tone == "good"
    with pytest.raises(InputError, match="cannot be simulated again"):
        mdnum.fork_folders("a", "b", replay=True)


@pytest.mark.parametrize("passed", [True, False])
def test_an_ensemble_that_differs_is_a_finding(tmp_path, monkeypatch, passed):
    answer = SimpleNamespace(window=40)
    plain = {
        "passed": passed, "window": 40, "components": 2, "limit": 2.1, "scores": [[0.1, 3.0]] * 3,
        "failing": {} if passed else {"pressure": 8.0}, "false_positives": [1, 30],
    }  # fmt: skip
    monkeypatch.setattr("mdnum.forks.benign.benign", lambda twin, **_: answer)
    monkeypatch.setattr(MODULE, "plain", lambda found: plain)
    asked = ("fork", "benign", "pair/at-cutoff", "start", "-o", str(tmp_path / "x"))
    assert call(*asked) == (0 if passed else 1)
    summary = RunFolder.open(tmp_path / "x").summary
    assert [one["code"] for one in summary["findings"]] == ([] if passed else ["NOT_BENIGN"])
    assert summary["steps"] == 40 and (tmp_path / "x" / "report.html").exists()


# -- judged and shown ----------------------------------------------------------------------------------

#: Entries of a pair whose one flip was the cause, two exponentials and what was asked of them.
FIT = {"rate": 0.02, "r_squared": 0.99, "first": 200, "last": 380, "intercept": float(np.log(1e-9)) - 4.0}
MINIMAL = {
    "pairs": [
        {"i": 3, "j": 4, "differs": [[400, 407], [420, 421], [430, 460], [500, None]]},
        {"i": 3, "j": 9, "differs": [[410, None]]},
    ],
    "proven": True, "fork_alone": False, "candidates": 77, "tests": 23, "horizon": 1652,
    "code": "proven", "reason": "2 pairs are enough.",
}  # fmt: skip
PINNED = {
    "pin": "fork", "pairs": [[3, 4]], "first": 200, "last": 206, "split": None, "free": 390, "until": 400,
    "largest": 2e-9, "reason": None,
}  # fmt: skip
LYAPUNOV = {
    "rate": 0.019, "error": 0.0004, "rate_time": 1.9, "error_time": 0.04, "steps": 750, "chaotic": True,
    "ratio": 1.05, "ulp": 8.9e-16, "ulp_split": 1702,
}  # fmt: skip
TABLE = [
    {"arithmetic": x, "decisions": y, "reference": z, "split": at, "until": 400}
    for (x, y, z), at in {"AAA": None, "BBA": 390, "BAA": None, "AAB": 390, "BBB": None, "BAB": 389}.items()
]
SHARES = [
    {"what": "decisions", "reference": "A", "steps": 179, "at_least": True, "e_foldings": 3.58},
    {"what": "arithmetic", "reference": "B", "steps": -1, "at_least": False, "e_foldings": -0.02},
]
CAUSE = {
    "effect": "cause", "split": 390, "split_time": 1.56, "splits": {"B": 390, "B|A": None},
    "predicted_split": None, "predicted_by": None, "e_foldings": None, "r_squared": 0.99,
    "growth": {"B": FIT}, "table": TABLE, "shares": SHARES, "minimal": MINIMAL, "pinned": PINNED,
    "lyapunov": LYAPUNOV, "lyapunov_reason": None, "must_hold": False, "findings": [],
}  # fmt: skip
COUNT = {
    "pairs": 16, "later": 9, "not_later": 7, "most": 16, "threshold": 43.2, "needed": [16, 12],
    "displacement": 1e-6,
}  # fmt: skip
NONE = {"first_bit": None, "fork": None, "split": None, "decision": None}


def told(outcome, **entries) -> View:
    """The folder of an outcome, said to hold something else."""
    return View(RunFolder.open(outcome.folder), {**outcome.summary, "findings": [], **entries})


def cause(crystal, **entries) -> View:
    """The crystal's folder, its flip the cause, and no matter of rounding."""
    decision = {**crystal.summary["decision"], "ambiguous_in": []}
    return told(crystal, **{**CAUSE, "decision": decision, **entries})


def part(page, title, kind) -> Any:
    """The first part of a kind in a section."""
    (section,) = (one for one in page.sections if title in one.title)
    return next(one for one in section.parts if isinstance(one, kind))


def shown(view):
    return page(view, fork_verdict.judge(view))


def test_the_page_has_a_figure_and_a_table_for_everything_there_is(crystal):
    view = cause(crystal)
    s, own = view.summary, shown(view)
    titles = [one.title for one in own.sections]
    (certainty,) = (title for title in titles if "certain" in title)
    assert titles == [
        "Separation", fork_verdict.DECISION, fork_verdict.TWO_BY_TWO, "One decision overridden",
        "Minimal cause", certainty, "Growth", "After the fork", "Decisions that differ", fork_verdict.WHAT,
    ]  # fmt: skip
    figures = {one.name for section in own.sections for one in section.parts if hasattr(one, "alt")}
    assert figures == {"atoms", "cross", "energy", "furthest", "overridden", "protection", "separation"}
    keys = {key.label: key.value for key in own.keys}
    assert (keys["Fork"], keys["Split"], keys["First bit"]) == (f"step {s['fork']}", "step 390", "step 1")
    assert keys["The flips were worth"] == "> 3.58" and keys["Decisions that differ"] == str(s["cross_flips"])
    assert part(own, fork_verdict.TWO_BY_TWO, Table).rows == [
        ("A", "its own", "is A", "390"), ("B", "its own", "390", "is B"), ("B", "A’s", "> 400", "389"),
    ]  # fmt: skip
    pairs = part(own, "Minimal cause", Table)
    (pair, times), other = pairs.rows
    assert pair == "3–4" and times.startswith("400 to 406, 420, 430 to 459, and 1 ")
    assert other == ("3–9", "from 410 on")
    certain = dict(part(own, certainty, Table).rows)
    assert f"step {s['certified_horizon']['B']} " in certain["Certified, B"]
    assert f"{s['ambiguous']['B']} ambiguous decision" in certain["Certified, B"]
    assert f"step {s['protected_until']}" in certain["Protected"]
    growth = dict(part(own, "Growth", Table).rows)
    assert "doubles in 34.7 steps" in growth["A and B, free"]
    assert "1.05 times this rate" in growth["Lyapunov exponent"] and "1,702" in growth["An ulp of the start"]
    # repeats are ranges
    repeated = [{"free": 380, "imposed": 399}, {"free": 370, "imposed": None}]
    other = {"repeated_other": repeated[:1], "count_other": COUNT | {"pairs": 6, "displacement": 1e-8}}
    sizes = {"displacements": [1e-6, 1e-8]}
    own = shown(cause(crystal, repeated=repeated, count=COUNT, **other, **sizes))
    rows = part(own, fork_verdict.TWO_BY_TWO, Table).rows[-4:]
    assert rows[0][2] == "370 to 380" and rows[1][2].startswith("399 to 399; 1 of 2 unknown")
    assert [row[2] for row in rows[2:]] == ["380 to 380", "399 to 399"]
    assert [row[0] for row in rows[1:3]] == [
        fork_verdict.TEXTS("start_displaced", displacement=size, unit="σ") for size in (1e-6, 1e-8)
    ]
    assert "21 repeats" in dict(part(own, fork_verdict.WHAT, Table).rows)["Chance"]
    # of nothing that was not asked for
    bare = shown(cause(crystal, decision=None, table=[], minimal=None, pinned=None, imposed_until=None))
    assert [one.title for one in bare.sections[1:3]] == [certainty, "Growth"]


def test_the_figure_shows_the_separations_and_the_dates(crystal):
    view, folder = cause(crystal), RunFolder.open(crystal.folder).read("separation")
    plot = part(shown(view), "Separation", Plot)
    by_label = {series.label: series for series in plot.series}
    for label, column in (("A and B, free", "free"), ("A and B under A’s decisions", "imposed")):
        # zeros before the first differing bit have no logarithm
        expected = np.where(folder[column] > 0, folder[column], np.nan)
        np.testing.assert_array_equal(by_label[label].y, expected)
    assert [round(at) for at, _ in plot.verticals] == [1, view.summary["fork"], 390]
    assert plot.horizontals[0][0] == view.summary["tolerance"] and plot.y_scale == "log"
    fit = by_label["growth, fitted"]
    assert np.diff(np.log(fit.y)).sum() / (fit.x[-1] - fit.x[0]) == pytest.approx(0.02)
    assert fit.y[0] == pytest.approx(1e-9)
    # a point below the line is where protection ends
    plot = part(shown(view), "certain", Plot)
    assert plot.verticals[0] == (float(view.summary["protected_until"]), "protected")
    near, moved = plot.series
    assert (near.y < np.nan_to_num(moved.y)).argmax() == view.summary["protected_until"] + 1
    # a poor fit is not drawn, and a split that is expected is
    poor = shown(cause(crystal, growth={"B": FIT | {"r_squared": 0.3}}))
    assert "growth, fitted" not in [series.label for series in part(poor, "Separation", Plot).series]
    plot = part(shown(cause(crystal, split=None, predicted_split=600)), "Separation", Plot)
    assert (600.0, "split expected") in plot.verticals
    assert max(series.x.max() for series in plot.series) == 600


@pytest.mark.parametrize(
    ("entries", "tone", "name"),
    [
        ({}, "info", "cause"),
        ({"effect": "accelerated", "splits": {"B|A": 395}, "count": COUNT}, "info", "accelerated"),
        ({"effect": "bystander", "count": COUNT}, "info", "bystander"),
        ({"effect": "bystander", "split": 2}, "info", "bystander_before"),
        ({"effect": "undecided"}, "info", "undecided"),
        ({"effect": "open", "split": None}, "info", "open"),
        ({"effect": "open", "split": None, "predicted_split": 9000, "predicted_by": "growth"}, "info",
         "open_growth"),
        ({"effect": "open"}, "info", "open_split"),
        ({"effect": "no fork", "fork": None, "split": None, "decision": None}, "good", "no_fork"),
        ({"effect": "no fork", "fork": None, "decision": None}, "good", "no_fork_split"),
        ({"effect": "same", **NONE}, "good", "same"),
        ({"effect": "same", "first_bit": None, "split": None}, "info", "same_but_decided"),
        ({"failed": {"B": "blow-up"}, "status": "failed"}, "warning", "ended"),
        ({"failed": {"A": "runaway"}, "decision": None}, "warning", "ended_fork"),
        ({"failed": {"A": "runaway", "B": "blow-up"}}, "warning", "ended_both"),
        ({"must_hold": True}, "error", "cause"),
    ],
)  # fmt: skip
def test_every_verdict_has_its_sentence(crystal, monkeypatch, entries, tone, name):
    view, said, texts = cause(crystal, **entries), {}, fork_verdict.TEXTS

    class Noted(Texts):
        entries, units = texts.entries, texts.units

        def __call__(self, name, /, **values):
            return said.setdefault(name, texts(name, **values))

    monkeypatch.setattr(fork_verdict, "TEXTS", Noted.__new__(Noted))
    verdict = fork_verdict.judge(view)
    assert verdict.headline == said[name] and verdict.tone == tone
    pair = "{i}–{j}".format(**crystal.summary["decision"])
    assert "–" not in verdict.headline.replace(pair, "") and not verdict.headline.endswith("..")


def test_where_no_decision_differs_a_split_has_its_size(crystal):
    reasons = [{"code": "no_fork", "steps": 400, "separation": 2e-8}]
    none = dict.fromkeys(("fork", "split", "decision"))
    view = cause(crystal, effect="no fork", reasons=reasons, tolerance=0.03, **none)
    text = fork_verdict.judge(view).text
    assert all(number(size, digits) in text for size, digits in ((2e-8, 2), (0.03, 1)))


def test_findings_are_those_that_apply(crystal):
    def findings(**entries):
        return fork_verdict.judge(cause(crystal, **entries)).findings

    def codes(**entries):
        return {finding.code: finding.severity for finding in findings(**entries)}

    assert codes() == {}
    assert codes(decision=crystal.summary["decision"]) == {"AMBIGUOUS_FORK": "info"}
    assert codes(split=None, effect="open") == {"HORIZON_SHORT": "info"}
    assert codes(imposed_until=300) == {"GUARD": "info"}
    assert codes(imposed_until=300, failed_imposed={"B|A": "runaway"}) == {"GUARD": "info"}
    assert codes(must_hold=True) == {"MUST_HOLD_FORKED": "error"}
    kept = {"code": "OF_OTHERS", "severity": "warning", "title": "look", "text": "there"}
    stale = {"code": "GUARD", "severity": "info", "title": "no longer", "text": "so"}
    assert codes(findings=[kept, stale]) == {"OF_OTHERS": "warning"}
    # what the repeats leave open names what would do
    (more,) = findings(effect="undecided", count=COUNT)
    assert (more.code, more.values["more"], more.values["need"]) == ("UNDECIDED", 30, 12)
    one = COUNT | {"pairs": 1, "later": 1, "not_later": 0, "most": 1, "needed": None}
    (none,) = findings(effect="undecided", count=one)
    assert none.values["more"] == 15 and none.values["need"] is None
    # clear at one displacement, and not so at the other one: more repeats would not change it
    (against,) = findings(effect="undecided", count=COUNT | {"later": 12, "not_later": 4}, count_other=COUNT)
    assert against.code == "UNDECIDED" and not against.remedy and against.title != more.title


def test_a_verdict_names_the_displacements_of_its_repeats(tmp_path):
    """In the summary, the headline and the page, from a command as anyone gives it."""
    asked: dict[str, Any] = {"steps": 80, "split": 1e-3, "repeats": 4, "back": False, "lyapunov": False}
    found = mdnum.fork("argon/crystal-108", "precision.force=bfloat16", **asked, out=tmp_path / "fork")
    s = json.loads((found.folder / "summary.json").read_text(encoding="utf-8"))
    # so coarse a choice separates the runs by more than the most that repeats are displaced by
    assert s["displacements"] == pytest.approx([1e-3 * s["tolerance"], 1e-5 * s["tolerance"]])
    assert [s[name]["displacement"] for name in ("count", "count_other")] == s["displacements"]
    assert [len(s[name]) for name in ("repeated", "repeated_other")] == [4, 4]
    shown = (found.folder / "report.html").read_text(encoding="utf-8")
    for size in s["displacements"]:
        displaced = fork_verdict.TEXTS("displaced", displacement=size, unit="σ")
        assert displaced in found.verdict.headline and displaced in shown


def test_a_decision_that_was_overridden_is_said_and_why_another_could_not_be(crystal):
    for entries, sentence in (
        ({}, "pinned_kept"), ({"last": 400, "split": 333}, "pinned_splits"),
        ({"pairs": None, "reason": "the runs do not fork"}, "pinned_none"),
    ):  # fmt: skip
        pinned = PINNED | entries
        said = part(shown(cause(crystal, pinned=pinned)), "One decision overridden", str)
        assert said == fork_verdict.TEXTS(sentence, **{**pinned, "pairs": "3–4", "unit": "σ"})
