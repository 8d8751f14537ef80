"""A parameter map into its folder: tables, page and verdict agree with the search and with closed form."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from command_line import call
from small_systems import LENNARD_JONES, make

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.rollout.engine import Engine
from mdnum.store import RunFolder
from mdnum.systems import build
from mdnum.verbs import frame
from mdnum.verbs.fork_map import judge_forecast, judge_map, page_map
from mdnum.verbs.frame import View

APART, RADIUS, SPEED, STEPS = 3.0, 2.5, 1.25, 9


def meeting(timestep: float = 0.07):
    """Two free atoms that fly towards each other and feel nothing before they are inside."""
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [APART, 0, 0]], masses=[1.0, 1.0])
    atoms.set_velocities([[0, 0, 0], [-SPEED, 0, 0]])
    cutoff = {"kind": "hard", "radius": RADIUS, "compare": "r2 <"}
    return make(atoms, LENNARD_JONES, cutoff, dynamics={"kind": "nve", "timestep": timestep, "steps": STEPS})


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    out = tmp_path_factory.mktemp("maps") / "meeting"
    return mdnum.fork_map(meeting(), "timestep", 0.06, 0.105, cells=6, confirm=False, out=out)


def displacement(timestep: float) -> float:
    """Mean squared displacement at the last step, by a run of the system that has this time step."""
    simulation = build(meeting(timestep))
    *_, segment = Engine(simulation, STEPS).segments()
    x = segment.unsorted("x", segment.rows - 1)
    return float(np.mean(np.sum((x - simulation.positions) ** 2, axis=1)))


# searches make hundreds of runs
@pytest.mark.slow
def test_the_folder_holds_the_piecewise_map(mapped):
    folder = RunFolder.open(mapped.folder)
    assert folder.kind == "map" and folder.summary == mapped.summary
    summary = mapped.summary
    assert summary["key"] == "dynamics.timestep"
    assert (summary["low"], summary["high"], summary["value"]) == (0.06, 0.105, 0.07)
    edges, pieces, points = (folder.read(name) for name in ("boundaries", "intervals", "points"))
    # inside from the first step k on with APART - SPEED k dt < RADIUS
    closed = [(APART - RADIUS) / SPEED / k for k in (6, 5, 4)]
    np.testing.assert_allclose(edges["above"], closed, rtol=1e-14)
    assert edges["above"].tolist() == np.nextafter(edges["below"], 1.0).tolist()
    assert edges["step"].tolist() == [6, 5, 4] and set(edges["confirmed"]) == {"not tested"}
    # intervals and boundaries alternate, and between them cover what was asked for
    assert pieces["low"].tolist() == [0.06, *edges["above"]]
    assert pieces["high"].tolist() == [*edges["below"], 0.105]
    assert pieces["history"].tolist() == list(range(4))
    for k in (0, 2):
        for side in ("below", "above"):
            assert edges[f"loss_{side}"][k] == displacement(float(edges[side][k]))
    np.testing.assert_array_equal(edges["jump"], edges["loss_above"] - edges["loss_below"])
    assert len(points["at"]) == summary["evaluations"] == pieces["runs"].sum()
    # a history's runs are those between its ends
    for k, piece in enumerate(pieces["history"]):
        inside = (points["at"] >= pieces["low"][k]) & (points["at"] <= pieces["high"][k])
        assert set(points["history"][inside]) == {piece}


@pytest.mark.slow
def test_the_page_says_what_the_folder_holds(mapped):
    figures = sorted(path.stem for path in (mapped.folder / "figures").iterdir())
    assert figures == ["detail", "jumps", "map"]
    sections = {section.title: section.parts for section in mapped.page.sections}
    rows = sections["Boundaries"][1].rows
    for edge, row in zip(mapped.summary["boundaries"], rows, strict=True):
        assert row[1:6] == (repr(edge["below"]), repr(edge["above"]), edge["step"], "0–1", "in above")
    # in the figure, beside its line
    plot = sections["Along dynamics.timestep"][0]
    assert [text for _, text in plot.verticals] == ["0–1, step 6", "0–1, step 5", "0–1, step 4"]
    at, jumps = plot.series[0].x, plot.series[1]
    assert np.isnan(at).sum() == 3 and jumps.label == "jump" and len(jumps.x) == 9
    text = (mapped.folder / "report.html").read_text(encoding="utf-8")
    frame.finish(mapped.folder)
    assert (mapped.folder / "report.html").read_text(encoding="utf-8") == text


def judged(folder, summary, **changes):
    """The verdict on a map that is said to be another."""
    return judge_map(View(folder, {**summary, **changes}))


@pytest.mark.slow
def test_what_a_person_must_know_is_a_finding(mapped):
    told = RunFolder.open(mapped.folder), mapped.summary
    assert [one.code for one in judged(*told).findings] == ["NOT_CONFIRMED"]
    edges = [{**edge, "confirmed": "yes"} for edge in mapped.summary["boundaries"]]
    sure = {"confirm": True, "confirmed": 3, "boundaries": edges}
    fine = judged(*told, **sure)
    assert fine.findings == () and fine.tone == "info"
    lost = {**edges[0], "confirmed": "no"}
    moved = judged(*told, confirm=True, confirmed=2, boundaries=[lost, *edges[1:]])
    assert (moved.findings[0].code, moved.tone) == ("NOT_REPRODUCED", "warning")
    assert moved.findings[0].values == {"n": 1, "places": repr(edges[0]["above"])}
    left = judged(*told, **sure, unresolved=[[0.08, 0.09]], failed_runs=3)
    assert [one.code for one in left.findings] == ["RUNS_FAILED", "MORE_BOUNDARIES"]


def test_runs_that_all_blow_up_are_no_single_history(tmp_path):
    summary = {
        "system": "x", "key": "potential.sigma", "low": 3.4, "high": 3.41, "value": 1.0, "steps": 500,
        "evaluations": 65, "failed_runs": 65, "boundaries": [], "unresolved": [], "confirm": True,
        "confirmed": 0, "loss": "x", "intervals": [], "histories": 1, "complete": True, "key_unit": "",
        "loss_unit": "", "jump_largest": None, "separation_largest": None, "seconds": 1.0, "timestep": 0.1,
        "atoms": 2,
    }  # fmt: skip
    folder = RunFolder.create(tmp_path / "map", frame.layout("map"))
    folder.finalize()
    far = judged(folder, summary)
    assert page_map(View(folder, summary), far).sections
    assert far.tone == "warning" and far.evidence == ()
    assert "far above" in far.findings[0].values["away"]
    inside = judged(folder, summary, low=0.9, high=1.1)
    assert inside.findings[0].values["away"] == ""
    assert judged(folder, summary, low=0.9, high=1.1, failed_runs=0).tone == "good"


def test_a_map_of_runs_that_all_blow_up_is_written(tmp_path):
    """Its one interval has no loss at either end, which a table holds as no number."""
    found = mdnum.fork_map("argon/crystal-108", "sigma", 3.4, 3.41, steps=40, cells=2, out=tmp_path / "map")
    assert found.summary["failed_runs"] == found.summary["evaluations"] > 0
    assert found.verdict.findings[0].code == "RUNS_FAILED"
    pieces = RunFolder.open(tmp_path / "map").read("intervals")
    assert np.isnan(pieces["loss_low"]).all() and np.isnan(pieces["loss_high"]).all()


@pytest.mark.slow
def test_from_the_command_line(mapped, tmp_path, monkeypatch, capsys):
    path = meeting().write(tmp_path / "system")
    monkeypatch.chdir(tmp_path)
    first, second, third = mapped.result.boundaries
    # a run that fails has no loss, and what has none no jump
    failing = replace(second, below=replace(second.below, loss=np.nan), confirmed=True)
    edges = (replace(first, confirmed=False), failing, replace(third, confirmed=True))
    asked = []

    def search(system, key, low, high, steps, **options):
        asked.append((key, low, high, steps, options["most"], options["confirm"]))
        options["progress"](1, 7, {"phase": "running a grid", "unit": "runs"})
        return replace(mapped.result, boundaries=edges, unresolved=((0.08, 0.09),), failed=2)

    monkeypatch.setattr("mdnum.forks.boundaries.boundaries", search)
    arguments = ["fork", "map", str(path), "timestep=0.06:0.105", "--no-report"]
    assert call(*arguments, "--most", "3", "--json", "-o", "here") == 1
    answer = json.loads(capsys.readouterr().out)
    # the default number of steps, and a boundary that a fresh process does not find is a finding
    assert asked == [("dynamics.timestep", 0.06, 0.105, STEPS, 3, True)]
    assert [one["code"] for one in answer["findings"]] == ["NOT_REPRODUCED", "RUNS_FAILED", "MORE_BOUNDARIES"]
    assert [edge["confirmed"] for edge in answer["boundaries"]] == ["no", "yes", "yes"]
    assert answer["boundaries"][1]["jump"] is None
    assert answer["jump_largest"] == max(abs(edge.jump) for edge in (first, third))
    assert "running a grid: 1 of 7 runs" in (tmp_path / "here/log.txt").read_text()
    call(*arguments)
    printed = capsys.readouterr().out
    assert all(repr(side.at) in printed for edge in edges for side in (edge.below, edge.above))


@pytest.mark.slow
def test_a_ball_has_a_map_too(tmp_path, monkeypatch):
    """Solver iterations along the tolerance: each cuts what is left to 1 - alpha k of it."""
    elsewhere = lambda system, key, steps, values, *_, **__: ["other"] * len(values)  # noqa: E731
    monkeypatch.setattr("mdnum.forks.boundaries.digests_elsewhere", elsewhere)
    found = mdnum.fork_map("ball/batch-on-the-boundary", "stop.tol", 0.0005, 0.002, out=tmp_path / "one")
    answer, edges = found.summary, found.summary["boundaries"]
    assert answer["key"] == "tol" and answer["loss"] == "residual penetration"
    assert [one.code for one in found.verdict.findings] == ["NOT_REPRODUCED"]
    places = [answer["value"] * 0.75**k for k in (2, 1, 0)]
    assert [edge["above"] > at >= edge["below"] for edge, at in zip(edges, places, strict=True)]
    np.testing.assert_allclose([edge["below"] for edge in edges], places, rtol=1e-6)
    for edge in edges:
        assert np.nextafter(np.float32(edge["below"]), np.float32(1)) == np.float32(edge["above"])
        assert edge["channel"] == "stop" and edge["confirmed"] == "no" and edge["jump"] > 0
    assert (edges[-1]["who"], edges[-1]["way"]) == ("solver", "1 → 0")
    pieces = RunFolder.open(tmp_path / "one").read("intervals")
    assert pieces["low"][1:].tolist() == [edge["above"] for edge in edges]
    # the loss is what the solver leaves: the same on a whole interval, a step up at each boundary
    np.testing.assert_array_equal(pieces["loss_low"], pieces["loss_high"])


def test_what_cannot_be_is_refused_before_there_is_a_folder(tmp_path):
    with pytest.raises(InputError, match="at least 1"):
        mdnum.fork_map("argon/crystal-108", "sigma", 1.0, 1.1, steps=0, out=tmp_path / "none")
    with pytest.raises(InputError, match="of a loaded system"):
        mdnum.fork_map(meeting(), "sigma", 1.0, 1.1, overrides={"cutoff.radius": 2.0}, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/notes").write_text("mine")
    with pytest.raises(FolderError, match="not empty"):
        mdnum.fork_map(meeting(), "sigma", 1.0, 1.1, out=tmp_path / "taken")


def test_a_forecast_names_the_flip_that_comes(tmp_path):
    found = mdnum.fork_forecast("argon/crystal-108", 1e-6, steps=60, out=tmp_path / "a")
    first = found.summary["first"][0]
    # the fork of two runs that far apart is at step 5, by this pair
    assert (first["step"], first["i"], first["j"]) == (5, 28, 64)
    assert (tmp_path / "a/report.html").exists()
    reach = RunFolder.open(tmp_path / "a").read("reach")
    # the first step at which the nearest decision is nearer than the displacement is the step forecast
    assert int(np.flatnonzero(reach["positive"] <= 1e-6)[0]) == 5
    assert (reach["i"][5], reach["j"][5]) == (28, 64)
    # what ends a forecast before the run is a finding, but for a flip
    folder, close = RunFolder.open(tmp_path / "a"), ["BELOW_ROUNDING", "FORECAST_ENDS_CLOSE"]
    for changes, codes in (
        ({"ends": "flip", "first": [], "until": 40}, []),
        ({"ends": "size", "first": [], "until": 40}, ["FORECAST_ENDS_SIZE"]),
        ({"ends": "list", "first": [], "until": 40}, ["FORECAST_ENDS_LIST"]),
        ({"ends": "close", "until": -1, "ulp": 1e-6}, close),
    ):
        verdict = judge_forecast(View(folder, {**found.summary, **changes}))
        assert [one.code for one in verdict.findings] == codes
