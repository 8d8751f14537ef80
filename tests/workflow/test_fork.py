"""A comparison into its folder: what is written agrees with what was followed, and what is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.forks import Twin, choices
from mdnum.forks.screen import Screened
from mdnum.forks.tangent import Lyapunov
from mdnum.rollout.engine import Engine
from mdnum.store import RunFolder
from mdnum.systems import build, load
from mdnum.workflow import ForkResult, fork, fork_answers

STEPS = 680
#: Free runs only.
BARE: dict[str, Any] = {"counterfactual": False, "repeats": 0}


@dataclass(frozen=True)
class StandIn:
    """A choice that makes what it is told to."""

    twin: Any
    must_hold: bool = False
    name: str = "stand-in"
    about: str = "for a test"

    def why_not(self, system):
        return None

    def make(self, system):
        return self.twin(system)


def use(monkeypatch, choice):
    monkeypatch.setattr(choices, "parse", lambda text: choice)


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> ForkResult:
    """float32 against float64 on the crystal, up to a little after the fork."""
    out = tmp_path_factory.mktemp("forks") / "crystal"
    return mdnum.fork("argon/crystal-108", "precision", steps=STEPS, out=out, minimal=True, pin="fork")


def test_the_summary_says_what_was_followed(compared):
    made, summary = compared.fork, compared.summary
    assert made is not None and made.dates.fork is not None and made.dates.split is None
    assert summary["world"] == "fork" and summary["status"] == "complete"
    assert summary["system"] == "argon/crystal-108" and summary["choice"] == "precision"
    assert (summary["seed"], summary["fork"], summary["split"]) == (1, made.dates.fork, None)
    assert summary["fork_time"] == pytest.approx(0.004 * made.dates.fork)
    assert summary["split_time"] is None
    assert summary["verdict"] == "open" and summary["reasons"] == list(made.verdict.reasons)
    assert summary["growth_rate_time"] == pytest.approx(summary["growth_rate"] / 0.004)
    assert summary["changes"]["precision.force"] == ["float64", "float32"]
    assert summary["cross_flips"] == made.flips_total > 0
    assert set(summary["splits"]) == {"B", "B|A", "A|B"} and summary["repeated"] == []
    assert [(cell["arithmetic"], cell["decisions"], cell["from"]) for cell in summary["table"]] == [
        ("A", "A", "A"), ("B", "B", "A"), ("B", "A", "A"), ("A", "B", "A"),
        ("A", "A", "B"), ("B", "B", "B"), ("B", "A", "B"), ("A", "B", "B"),
    ]  # fmt: skip
    assert summary["shares"] == [] and summary["minimal"]["reason"] == "the runs did not split"
    # float32 decides: its own rounding is what makes it fork, and A is its shadow
    assert summary["certified_horizon"]["A"] == STEPS and summary["ambiguous"]["A"] == 0
    assert summary["certified_horizon"]["B"] < made.dates.fork and summary["ambiguous"]["B"] > 0
    assert summary["protected_until"] < made.dates.fork
    assert (summary["shadow"], summary["shadow_horizon"]) == ("A", made.dates.fork - 1)
    assert summary["pinned"]["pairs"] == [[made.decision.i, made.decision.j]]
    assert summary["pinned"]["first"] == made.dates.fork and summary["pinned"]["split"] is None
    exponent = summary["lyapunov"]
    assert exponent["steps"] == 400 and exponent["rate_time"] == pytest.approx(exponent["rate"] / 0.004)
    assert "HORIZON_SHORT" in [finding["code"] for finding in summary["findings"]]
    assert summary["headline"].startswith(f"The runs fork at step {made.dates.fork}")
    assert json.loads((compared.folder / "summary.json").read_text()) == summary


def test_the_tables_hold_the_series(compared):
    folder = RunFolder.open(compared.folder)
    assert folder.world == "fork"
    table, series = folder.read("separation"), compared.fork.series
    assert table["step"].tolist() == list(range(STEPS + 1))
    np.testing.assert_allclose(table["time"], 0.004 * np.arange(STEPS + 1))
    for column, name in (("free", "B"), ("handed", "B|A"), ("back", "A|B"),
                           ("energy_b", "energy B"), ("overridden", "overridden")):  # fmt: skip
        np.testing.assert_array_equal(table[column], series[name])
    for column, name in (("back_from_a", "A|B from A"), ("nearest_a", "nearest A"),
                         ("ambiguous_b", "ambiguous B")):  # fmt: skip
        np.testing.assert_array_equal(table[column], series[name])
    doubts = folder.read("ambiguous_pairs")
    first = compared.summary["ambiguous_first"]
    assert first["A"] is None and first["B"] == {
        name: doubts[name][0] for name in ("step", "i", "j", "margin", "bound")
    }
    assert set(doubts["run"]) == {"B"} and len(doubts["step"]) == compared.summary["ambiguous"]["B"]
    assert (np.abs(doubts["margin"]) <= doubts["bound"]).all()
    np.testing.assert_array_equal(np.bincount(doubts["step"], minlength=STEPS + 1), table["ambiguous_b"])
    flips = folder.read("cross_flips")
    assert len(flips["step"]) == compared.fork.flips_total
    assert flips["step"][0] == compared.summary["fork"]
    # the pairs that differ are the flips that opened a difference less those that closed one
    change = np.where(flips["differs"], 1, -1)
    held = np.array([change[flips["step"] <= step].sum() for step in table["step"]])
    np.testing.assert_array_equal(held, table["cross"])


def test_the_folder_is_a_system_that_loads_again(compared):
    again = load(compared.folder)
    assert again.name == "argon/crystal-108" and len(again.atoms) == 108
    assert (compared.folder / "report.html").exists() and (compared.folder / "log.txt").exists()
    assert RunFolder.open(compared.folder).provenance["system"] == "argon/crystal-108"


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


def test_the_atoms_at_the_fork_are_those_of_the_runs(compared):
    made, around = compared.summary["decision"], RunFolder.open(compared.folder).read("neighborhood")
    twin = compared.fork.twin
    i, j = made["i"], made["j"]
    assert around["atom"][:2].tolist() == [i, j]
    x_a, x_b = positions(twin.a, made["step"]), positions(twin.b, made["step"])
    cell = np.asarray(twin.a.cell.matrix)
    middle = x_a[i] + nearest(cell, x_a[j] - x_a[i]) / 2
    place = np.stack([around[name] for name in "xyz"], axis=1)
    moved = np.stack([around[f"d{name}"] for name in "xyz"], axis=1)
    np.testing.assert_allclose(place, nearest(cell, x_a[around["atom"]] - middle), atol=1e-12)
    np.testing.assert_allclose(moved, nearest(cell, x_b[around["atom"]] - x_a[around["atom"]]), atol=1e-12)
    # all that are near, and none that is not
    distance = np.sqrt((nearest(cell, x_a - middle) ** 2).sum(axis=1))
    assert set(around["atom"].tolist()) == set(np.flatnonzero(distance <= 1.25 * twin.a.r_cut).tolist())
    assert np.abs(moved).max() == pytest.approx(made["separation_before"], rel=0.5)
    # the flip is a matter of float32's rounding: its margin is within B's bound, and not in A's
    gap = np.linalg.norm(place[1] - place[0])
    assert made["distance"] == pytest.approx(gap, abs=1e-9)
    assert made["margins"]["A"] == pytest.approx(made["cutoffs"]["A"] ** 2 - gap**2, abs=1e-12)
    assert made["margins"]["A"] * made["margins"]["B"] < 0, "the runs decide differently"
    assert made["ambiguous_in"] == ["B"] and not made["ambiguous"]


def test_a_choice_that_changes_nothing_is_said_to(tmp_path):
    result = fork(
        "pair/at-cutoff", "translate=lattice", steps=40, out=tmp_path / "here", report=False, **BARE
    )
    assert result.summary["verdict"] == "same" and result.summary["must_hold"]
    assert result.summary["headline"] == "The same trajectory: no bit differs in 40 steps."
    assert result.summary["findings"] == [] and result.summary["decision"] is None
    assert result.summary["lyapunov"] is None and result.summary["lyapunov_reason"].startswith("no bit")
    assert RunFolder.open(result.folder).rows("neighborhood") == 0
    assert not (result.folder / "report.html").exists()


def test_a_promise_that_is_broken_is_an_error(tmp_path, monkeypatch):
    def other_cutoff(system):
        return Twin(build(system), build("pair/at-cutoff", {"cutoff.radius": 2.4}), "another cutoff")

    use(monkeypatch, StandIn(other_cutoff, must_hold=True))
    result = fork("pair/at-cutoff", "stand-in", steps=400, out=tmp_path / "here", **BARE)
    codes = {finding["code"]: finding["severity"] for finding in result.summary["findings"]}
    assert codes["MUST_HOLD_FORKED"] == "error"
    assert result.summary["fork"] is not None


def test_a_run_that_blows_up_on_one_side_is_reported(tmp_path, monkeypatch):
    def wild(system):
        return Twin(build(system), build("argon/crystal-108", {"dynamics.timestep": 10.0}), "a wild step")

    use(monkeypatch, StandIn(wild))
    result = fork("argon/crystal-108", "stand-in", steps=60, out=tmp_path / "here", report=False, **BARE)
    assert result.summary["status"] == "failed" and list(result.summary["failed"]) == ["B"]
    assert [finding["code"] for finding in result.summary["findings"]] == ["RUN_FAILED"]
    # the comparison ends where B does, not where the stretch of A's steps does
    last = result.summary["steps"]
    assert last < 5 and len(result.fork.series["B"]) == last + 1
    assert np.isfinite(result.fork.series["energy A"]).all() and result.summary["fork"] <= last
    assert result.summary["headline"].startswith(f"Run B ended in a {result.summary['failed']['B']} at step ")
    assert all(flip.step <= last for flip in result.fork.flips)


def test_screening_ranks_what_was_screened(tmp_path, monkeypatch):
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

    monkeypatch.setattr(choices, "screen", screen)
    result = fork(
        "argon/crystal-108", "all", steps=100, out=tmp_path / "here",
        progress=lambda *given: seen.append(given),
    )  # fmt: skip
    summary = result.summary
    assert result.fork is None
    assert [one["choice"] for one in summary["ranking"]] == ["early", "late", "never"]
    assert summary["not_applicable"] == [{"choice": "noise", "why": "no noise"}]
    assert summary["headline"] == "late must not change a bit, and does."
    assert [finding["code"] for finding in summary["findings"]] == ["MUST_HOLD_FORKED", "RUN_FAILED"]
    assert seen[0] == (0, 4, {"phase": "early (1 of 4)"})
    page = (result.folder / "report.html").read_text(encoding="utf-8")
    assert "broken" in page and "holds" in page and "no noise" in page


@pytest.mark.parametrize(
    ("system", "vary", "options", "words"),
    [
        ("ball/drop", "skin", {}, "no choice 'skin' of a ball"),
        ("argon/crystal-108", "precison", {}, "no choice 'precison'"),
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
        ("ball/drop", "start", {"minimal": True}, "minimal is an option of molecular dynamics"),
        ("ball/drop", "start", {"pin": "fork", "back": False}, "pin and back are options of molecular"),
        ("ball/drop", "start", {"lyapunov": True}, "lyapunov is an option of molecular dynamics"),
        ("ball/drop", "all", {"split": 0.1, "repeats": 4}, "split and repeats are options of one comparison"),
        ("argon/crystal-108", "all", {"minimal": True}, "minimal is an option of one comparison"),
        ("argon/crystal-108", "all", {"split": 0.1, "lyapunov": False}, "split and lyapunov are options"),
    ],
)
def test_what_is_refused_leaves_no_folder(tmp_path, system, vary, options, words):
    with pytest.raises(InputError, match=words):
        fork(system, vary, out=tmp_path / "here", **options)
    assert not (tmp_path / "here").exists()


def test_overrides_of_a_loaded_system_and_used_folders_are_refused(tmp_path):
    system = load("pair/at-cutoff")
    with pytest.raises(InputError, match="while it is loaded"):
        fork(system, "precision", overrides={"dynamics.steps": 3})
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(FolderError, match="already holds"):
        fork(system, "precision", steps=3, out=tmp_path)


def test_a_run_that_stops_leaves_the_folder_free(tmp_path, monkeypatch):
    def stop(step, steps, info):
        if info["phase"] == "run":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fork("pair/at-cutoff", "start", steps=3, out=tmp_path / "here", progress=stop, **BARE)
    RunFolder.create(tmp_path / "here", overwrite=True).close()


@pytest.mark.parametrize(
    ("rate", "chaotic", "words"),
    [(0.02, True, None), (1e-4, False, "slower than growth"), (0.006, False, "400 steps do not tell it")],
)
def test_an_exponent_that_is_none_says_why(compared, monkeypatch, rate, chaotic, words):
    size = rate * np.arange(401.0)
    made = Lyapunov(400, 0.004, rate, 1e-5, size, size, 80, chaotic)
    monkeypatch.setattr("mdnum.forks.tangent.lyapunov", lambda *given: made)
    found = fork_answers.exponent(compared.fork)
    reason = found["lyapunov_reason"]
    assert reason is None if words is None else reason.startswith(words)
    assert found["lyapunov"]["ratio"] == (
        pytest.approx(compared.fork.growth["B"].rate / rate) if chaotic else None
    )
    # an ulp of a coordinate between 4 and 8 has grown to the tolerance: from the size of the tangent
    ulp = found["lyapunov"]["ulp"]
    assert ulp == 2.0**-50 or ulp == 2.0**-51
    expected = np.log(compared.fork.tolerance / ulp) / rate if chaotic else None
    split = found["lyapunov"]["ulp_split"]
    assert split is None if expected is None else split == pytest.approx(expected, abs=1)
