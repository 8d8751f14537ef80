"""A comparison into its folder, of either world: what is written agrees with what was followed."""

from __future__ import annotations

import importlib
import json
import tomllib
from dataclasses import replace
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
from mdnum.numerics.verdicts import Dates, Delay, Growth
from mdnum.provenance import hashes
from mdnum.rollout.engine import Engine
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.load import copy
from mdnum.verbs import fork_pair, frame

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


def test_the_summary_says_what_was_followed(crystal):
    made, summary = crystal.result, crystal.summary
    assert made.dates.fork is not None and made.dates.split is None
    assert summary["status"] == "complete"
    # what is varied unless anything else is asked for
    assert (summary["system"], summary["choice"]) == ("argon/crystal-108", "precision")
    assert (summary["first_bit"], summary["fork"], summary["split"]) == (1, made.dates.fork, None)
    assert summary["fork_time"] == pytest.approx(0.004 * made.dates.fork) and summary["split_time"] is None
    assert summary["effect"] == "open"
    assert [one["code"] for one in summary["reasons"]] == [code for code, _ in made.verdict.reasons]
    assert summary["growth_rate_time"] == pytest.approx(summary["growth_rate"] / 0.004)
    assert summary["changes"]["precision.force"] == ["float64", "float32"]
    assert summary["cross_flips"] == made.flips_total > 0
    assert set(summary["splits"]) == {"B", "B|A", "A|B"} and summary["repeated"] == []
    assert [(cell["arithmetic"], cell["decisions"], cell["reference"]) for cell in summary["table"]] == [
        ("A", "A", "A"), ("B", "B", "A"), ("B", "A", "A"), ("A", "B", "A"),
        ("A", "A", "B"), ("B", "B", "B"), ("B", "A", "B"), ("A", "B", "B"),
    ]  # fmt: skip
    assert summary["shares"] == [] and summary["minimal"]["pairs"] is None
    # float32 decides: its own rounding is what makes it fork, and A is its shadow
    assert summary["certified_horizon"]["A"] == STEPS and summary["ambiguous"]["A"] == 0
    assert summary["certified_horizon"]["B"] < made.dates.fork and summary["ambiguous"]["B"] > 0
    assert summary["protected_until"] < made.dates.fork
    assert (summary["shadow"], summary["shadow_horizon"]) == ("A", made.dates.fork - 1)
    assert summary["pinned"]["pairs"] == [list(made.decision.subject)]
    assert summary["pinned"]["first"] == made.dates.fork and summary["pinned"]["split"] is None
    exponent = summary["lyapunov"]
    assert exponent["steps"] == 400 and exponent["rate_time"] == pytest.approx(exponent["rate"] / 0.004)
    assert "HORIZON_SHORT" in codes(crystal)
    assert json.loads((crystal.folder / "summary.json").read_text()) == summary


def test_the_tables_hold_the_series(crystal):
    folder = RunFolder.open(crystal.folder)
    table, series = folder.read("separation"), crystal.result.series
    np.testing.assert_allclose(table["time"], 0.004 * np.arange(STEPS + 1))
    for column, name in (("step", "step"), ("free", "B"), ("imposed", "B|A"), ("back", "A|B"),
                         ("energy_b", "energy B"), ("overridden", "overridden"), ("nearest_a", "nearest A"),
                         ("back_from_a", "A|B from A"), ("ambiguous_b", "ambiguous B")):  # fmt: skip
        np.testing.assert_array_equal(table[column], series[name])
    doubts, first = folder.read("ambiguous_pairs"), crystal.summary["ambiguous_first"]
    assert first["A"] is None and first["B"] == {name: doubts[name][0] for name in doubts if name != "run"}
    assert set(doubts["run"]) == {"B"} and len(doubts["step"]) == crystal.summary["ambiguous"]["B"]
    assert (np.abs(doubts["margin"]) <= doubts["bound"]).all()
    np.testing.assert_array_equal(np.bincount(doubts["step"], minlength=STEPS + 1), table["ambiguous_b"])
    flips = folder.read("cross_flips")
    assert len(flips["step"]) == crystal.result.flips_total and flips["step"][0] == crystal.summary["fork"]
    # the pairs that differ are the flips that opened a difference less those that closed one
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


def test_a_ball_has_the_same_summary(crystal, balls):
    made, summary = balls.result, balls.summary
    assert (summary["system"], summary["balls"], summary["choice"]) == ("three", 3, "contact=earlier")
    assert summary["steps"] == 120 and summary["timestep"] == 0.01 and summary["tolerance"] == 0.002
    assert (summary["first_bit"], summary["fork"]) == (made.dates.first_bit, made.dates.fork)
    assert summary["effect"] == "cause" and summary["status"] == "complete"
    decision = summary["decision"]
    assert (decision["channel"], decision["step"]) == ("contact", summary["fork"])
    assert (decision["run"], decision["decided"]) == ("B", {"A": 0, "B": 1})
    # the ball was above the floor in both runs: the margin is minus one height
    assert decision["margins"]["A"] == decision["margins"]["B"] < 0
    assert not decision["ambiguous"] and decision["bounds"]["A"] > 0
    assert summary["splits"] == {"B": made.dates.split, "B|A": None, "A|B": None}
    assert summary["imposed_largest"] == 0.0 and len(summary["table"]) == 8
    assert summary["cross_flips"] == summary["cross_contacts"] + summary["cross_stops"] > 0
    alone = {"atoms", "r_cut", "shadow", "shadow_horizon", "protected_until", "certified_horizon", "pinned",
             "ambiguous", "ambiguous_steps", "ambiguous_first", "lists_complete", "lyapunov", "minimal",
             "lyapunov_reason"}  # fmt: skip
    assert set(crystal.summary) - set(summary) == alone
    assert set(summary) - set(crystal.summary) == {
        "balls", "contact_kind", "integrator", "counted", "cross_contacts", "cross_stops",
    }  # fmt: skip


def test_the_tables_of_a_ball_are_those_of_its_runs(balls):
    folder, made = RunFolder.open(balls.folder), balls.result
    table = folder.read("separation")
    for column, name in (("free", "B"), ("imposed", "B|A"), ("back", "A|B"), ("energy_b", "energy B")):
        np.testing.assert_array_equal(table[column], made.series[name])
    rows = folder.read("cross_flips")
    a, b = made.runs["A"], made.runs["B"]
    contact = rows["channel"].astype(str) == "contact"
    expected = {(int(row) + 1, int(ball)) for row, ball in np.argwhere(a.contact != b.contact)}
    found = set(zip(rows["step"][contact].tolist(), rows["ball"][contact].tolist(), strict=True))
    assert found == expected and len(found) == contact.sum()
    stops = np.flatnonzero(a.iterations != b.iterations)
    np.testing.assert_array_equal(rows["step"][~contact], stops + 1)
    np.testing.assert_array_equal(rows["a"][~contact], a.iterations[stops])
    around, one = folder.read("around"), balls.summary["decision"]["ball"]
    mine = around["run"].astype(str) == "B"
    np.testing.assert_array_equal(around["y"][mine], b.y[around["step"][mine], one])
    assert bool(around["contact"][mine][around["step"][mine] == made.dates.fork][0])


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

    def screen(system, steps, progress):
        progress(0, 4, "early")
        return rows

    monkeypatch.setattr("mdnum.forks.pair.screen", screen)
    found = mdnum.fork(name, "all", steps=100, out=tmp_path / "x", progress=lambda *given: seen.append(given))
    assert found.result == rows
    assert [row["choice"] for row in found.summary["ranking"]] == ["early", "late", "never"]
    assert found.summary["not_applicable"] == [{"choice": "noise", "reason": "no noise"}]
    assert codes(found) == ["MUST_HOLD_FORKED", "CHOICE_FAILED"] and found.verdict.tone == "error"
    assert seen[0] == (0, 4, {"phase": "early (1 of 4)"})
    page = (found.folder / "report.html").read_text(encoding="utf-8")
    assert "broken" in page and "holds" in page and "no noise" in page


@pytest.mark.parametrize(
    ("system", "vary", "options", "words"),
    [
        ("argon/crystal-108", "noise", {}, "noise"),
        ("argon/crystal-108", "precision", {"steps": 0}, "steps = 0"),
        ("argon/crystal-108", "precision", {"split": -1.0}, "split = -1"),
        ("argon/crystal-108", "precision", {"repeats": -1}, "repeats = -1"),
        ("argon/crystal-108", "precision", {"overrides": {"cutoff.knd": 1}}, "knd"),
        ("argon/crystal-108", "precision", {"pin": "3-108"}, "no pair 3-108"),
        ("argon/crystal-108", "precision", {"repeats": 2}, "repeats = 2; expected 0, or 4 and more"),
        # what would be left undone, and was without a word
        ("argon/crystal-108", "precision", {"repeats": 4, "counterfactual": False}, "repeats = 4"),
        ("argon/crystal-108", "precision", {"back": True, "counterfactual": False}, "A under B's decisions"),
        ("silicon/tersoff-512", "precision", {"repeats": 4}, "many-body"),
        ("ball/drop", "start", {"repeats": 4, "counterfactual": False}, "repeats = 4"),
        ("ball/drop", "all", {"split": 0.1, "repeats": 4}, "split and repeats are options of one comparison"),
        ("argon/crystal-108", "all", {"minimal": True}, "minimal is an option of one comparison"),
    ],
)
def test_what_is_refused_leaves_no_folder(tmp_path, system, vary, options, words):
    with pytest.raises(InputError, match=words):
        mdnum.fork(system, vary, out=tmp_path / "here", **options)
    assert not (tmp_path / "here").exists()


def test_overrides_of_a_loaded_system_and_used_folders_are_refused(tmp_path, file):
    for system in (load("pair/at-cutoff"), load(file)):
        with pytest.raises(InputError, match="while it is loaded"):
            mdnum.fork(system, "precision", overrides={"dynamics.steps": 3})
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(FolderError, match="already holds"):
        mdnum.fork("pair/at-cutoff", "precision", steps=3, out=tmp_path)


def test_a_run_that_stops_leaves_the_folder_free(tmp_path):
    def stop(step, steps, info):
        if info["phase"] == "run":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mdnum.fork("pair/at-cutoff", "start", steps=PAIR_STEPS, out=tmp_path / "here", progress=stop, **BARE)
    RunFolder.create(tmp_path / "here", overwrite=True).close()


def test_a_question_stands_in_the_file_and_is_no_part_of_the_system(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        MODULE,
        "followed",
        lambda system, twin, told, asked, *_: seen.append((told["choice"], asked.steps, asked.split)),
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


@pytest.mark.parametrize(("rate", "chaotic"), [(0.02, True), (1e-4, False), (0.006, False)])
def test_an_exponent_that_is_none_says_why(crystal, monkeypatch, rate, chaotic):
    size = rate * np.arange(401.0)
    lyapunov = Lyapunov(400, 0.004, rate, 1e-5, size, size, 80, chaotic)
    monkeypatch.setattr("mdnum.forks.linearized.lyapunov", lambda *given: lyapunov)
    found = fork_pair._exponent(crystal.result)
    assert (found["lyapunov_reason"] is None) == chaotic
    ratio = crystal.result.growth["B"].rate / rate
    assert found["lyapunov"]["ratio"] == (pytest.approx(ratio) if chaotic else None)
    # an ulp of a coordinate between 4 and 8 has grown to the tolerance: from the size of the tangent
    ulp, split = found["lyapunov"]["ulp"], found["lyapunov"]["ulp_split"]
    assert ulp in (2.0**-50, 2.0**-51)
    expected = np.log(crystal.result.tolerance / ulp) / rate
    assert split == pytest.approx(expected, abs=1) if chaotic else split is None


def test_a_prediction_says_what_it_comes_from(crystal):
    steady = 1e-12 * np.exp(0.02 * np.arange(900.0))
    # a power law is no exponential: the exponent alone can tell
    power = 1e-9 * np.arange(61.0) ** 2

    def predicted(free, split=None, rate=None):
        made = SimpleNamespace(
            dates=Dates(0, 5, split), series={"B": free}, tolerance=0.1, steps=len(free) - 1
        )
        exponent = {"lyapunov": {"rate": rate, "chaotic": True}} if rate else {}
        found: Any = fork_pair._predicted(made, exponent)  # type: ignore[arg-type]
        return found["predicted_split"], found["predicted_by"]

    at, by = predicted(steady, rate=0.5)
    assert by == "growth" and at == pytest.approx(np.log(0.1 / 1e-12) / 0.02, abs=1)
    assert predicted(power) == predicted(steady, split=9) == (None, None)
    assert predicted(power, rate=0.0036) == (round(60 + np.log(0.1 / 3.6e-6) / 0.0036), "exponent")
    # repeats that did not split are kept, and a fit that is none has no line
    delays = (Delay(12, 40, 99, 99), Delay(None, 30, 99, 99))
    made = replace(crystal.result, repeats=delays, growth={"B": Growth(float("nan"), float("nan"), -1, -1)})
    found = fork_pair._numbers(made)
    assert found["repeated"] == [{"free": 12, "imposed": 40}, {"free": None, "imposed": 30}]
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
    with pytest.raises(InputError, match="repeats and back and lyapunov are options of a replay"):
        mdnum.fork_folders(runs / "a", runs / "b", **asked)
    assert call("fork", "compare", str(runs / "a"), str(runs / "b"), "-o", str(runs / "seen")) == 0
    lines = printed(capsys)
    assert any(line.startswith("precision.force float64 float32") for line in lines)
    assert call("fork", "compare", str(runs / "a"), str(runs / "nowhere")) == 2
    assert "no such folder" in capsys.readouterr().err


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
    with pytest.raises(InputError, match="not followed again"):
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
