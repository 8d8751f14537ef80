"""A parameter map into its folder: tables, page and verdict agree with the search and with closed form."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from report.test_html import Tags
from small_systems import LENNARD_JONES, make

import mdnum
from mdnum import report
from mdnum.cli import main
from mdnum.errors import FolderError, InputError
from mdnum.forks.boundaries import MOST
from mdnum.report.fork import map as page
from mdnum.report.fork.question import Question, load
from mdnum.rollout.engine import Engine
from mdnum.store import RunFolder
from mdnum.systems import build

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
    assert folder.world == "along" and folder.summary == mapped.summary
    summary = mapped.summary
    assert (summary["world"], summary["question"], summary["key"]) == ("fork", "along", "dynamics.timestep")
    assert (summary["low"], summary["high"], summary["value"]) == (0.06, 0.105, 0.07)
    edges, pieces, points = (folder.read(name) for name in ("boundaries", "intervals", "points"))
    # inside from the first step k on with APART - SPEED k dt < RADIUS
    closed = [(APART - RADIUS) / SPEED / k for k in (6, 5, 4)]
    np.testing.assert_allclose(edges["above"], closed, rtol=1e-14)
    assert edges["above"].tolist() == np.nextafter(edges["below"], 1.0).tolist()
    assert edges["step"].tolist() == [6, 5, 4] and set(edges["confirmed"]) == {"not asked"}
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
    text = (mapped.folder / "report.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert tags.open == [] and tags.sources == []
    assert sorted(path.stem for path in (mapped.folder / "figures").iterdir()) == ["detail", "jumps", "map"]
    words = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))
    for edge in mapped.summary["boundaries"]:
        assert f"{edge['below']!r} {edge['above']!r} {edge['step']} 0–1 in above" in words
        # in the figure, beside its line
        assert f"0–1, step {edge['step']}" in words
    assert "change at 3 places between dynamics.timestep = 0.06 and 0.105" in words
    (mapped.folder / "report.html").unlink()
    report.write(mapped.folder)
    assert (mapped.folder / "report.html").read_text(encoding="utf-8") == text


def judged(mapped, tmp_path, **changes):
    folder = RunFolder.create(tmp_path / "one", world="along")
    source = RunFolder.open(mapped.folder)
    for name in ("boundaries", "intervals", "points"):
        folder.append(name, source.read(name))
    folder.finalize()
    folder.write_summary({**mapped.summary, **changes})
    return page.judge(load(folder, "along")[1])


@pytest.mark.slow
def test_what_a_person_must_know_is_a_finding(mapped, tmp_path):
    assert [one.code for one in judged(mapped, tmp_path / "a").findings] == ["NOT_CONFIRMED"]
    edges = [{**edge, "confirmed": "yes"} for edge in mapped.summary["boundaries"]]
    sure = {"confirm": True, "confirmed": 3, "boundaries": edges}
    verdict = judged(mapped, tmp_path / "b", **sure)
    assert verdict.findings == () and verdict.tone == "info"
    assert any("a fresh process finds the same" in sentence for sentence in verdict.evidence)
    moved = [{**edges[0], "confirmed": "no"}, *edges[1:]]
    verdict = judged(mapped, tmp_path / "c", confirm=True, confirmed=2, boundaries=moved)
    (finding,) = verdict.findings
    assert (finding.code, verdict.tone) == ("NOT_REPRODUCED", "warning")
    assert repr(edges[0]["above"]) in finding.text and "1 boundary" in finding.title
    verdict = judged(mapped, tmp_path / "d", **sure, unresolved=[[0.08, 0.09]], failed_runs=3)
    assert [one.code for one in verdict.findings] == ["RUNS_FAILED", "MORE_BOUNDARIES"]
    quiet = judged(
        mapped, tmp_path / "e", boundaries=[], confirm=True, confirmed=0, jump_largest=None,
        apart_largest=None, intervals=mapped.summary["intervals"][:1],
    )  # fmt: skip
    assert quiet.tone == "good" and quiet.headline.startswith("One history")


@pytest.mark.slow
def test_from_the_command_line(mapped, tmp_path, monkeypatch, capsys):
    path = meeting().write(tmp_path / "system")
    monkeypatch.chdir(tmp_path)
    first, second, third = mapped.map.boundaries
    # a run that fails has no loss, and what has none no jump
    failing = replace(second, below=replace(second.below, loss=np.nan), confirmed=True)
    edges = (replace(first, confirmed=False), failing, replace(third, confirmed=True))
    asked = []

    def search(system, key, low, high, steps, **options):
        asked.append((key, low, high, steps, options["most"], options["confirm"]))
        options["progress"](1, 7, {"phase": "running a grid", "unit": "runs"})
        return replace(mapped.map, boundaries=edges, unresolved=((0.08, 0.09),), failed=2)

    monkeypatch.setattr("mdnum.forks.boundaries.boundaries", search)
    arguments = ["fork", str(path), "--along", "timestep=0.06:0.105", "--no-report"]
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--most", "3", "--json", "-o", "here"])
    answer = json.loads(capsys.readouterr().out)
    # the default number of steps, and a boundary that a fresh process does not find is a finding
    assert asked == [("dynamics.timestep", 0.06, 0.105, STEPS, 3, True)] and stopped.value.code == 1
    assert [one["code"] for one in answer["findings"]] == ["NOT_REPRODUCED", "RUNS_FAILED", "MORE_BOUNDARIES"]
    assert answer["boundaries"][1]["jump"] is None
    assert answer["jump_largest"] == max(abs(edge.jump) for edge in (first, third))
    assert answer["folder"] == "here" and answer["boundaries"][0]["confirmed"] == "no"
    assert "running a grid: 1 of 7 runs" in (tmp_path / "here/log.txt").read_text()
    assert not (tmp_path / "here/report.html").exists()
    with pytest.raises(SystemExit):
        main(["report", "here"])
    assert (tmp_path / "here/report.html").exists()
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(arguments)
    said = capsys.readouterr().out
    assert all(repr(side.at) in said for edge in edges for side in (edge.below, edge.above))
    assert "wrote runs/fork-" in said and asked[1][4] == MOST


@pytest.mark.slow
def test_a_ball_has_a_map_too(tmp_path, capsys):
    """Solver iterations along the tolerance: each cuts what is left to 1 - alpha k of it."""
    asked = [
        "fork",
        "ball/batch-on-the-boundary",
        "--along",
        "stop.tol=0.0005:0.002",
        "-o",
        str(tmp_path / "one"),
    ]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:
        patch.setattr("mdnum.forks.confirm._answered", lambda asked, values, tell: ["other"] * len(values))
        main([*asked, "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert stopped.value.code == 1 and answer["key"] == "tol" and answer["loss"] == "residual penetration"
    whole = answer["value"]
    edges = answer["boundaries"]
    assert [
        edge["above"] > whole * 0.75**k >= edge["below"] for k, edge in zip((2, 1, 0), edges, strict=True)
    ]
    np.testing.assert_allclose(
        [edge["below"] for edge in edges], [whole * 0.75**k for k in (2, 1, 0)], rtol=1e-6
    )
    for edge in edges:
        assert np.nextafter(np.float32(edge["below"]), np.float32(1)) == np.float32(edge["above"])
        assert edge["channel"] == "stop" and edge["confirmed"] == "no" and edge["jump"] > 0
    assert edges[-1]["says"] == "the solver makes 0 iterations instead of 1"
    pieces = RunFolder.open(tmp_path / "one").read("intervals")
    assert pieces["low"][1:].tolist() == [edge["above"] for edge in edges]
    # the loss is what the solver leaves: the same on a whole interval, a step up at each boundary
    np.testing.assert_array_equal(pieces["loss_low"], pieces["loss_high"])
    page = (tmp_path / "one/report.html").read_text(encoding="utf-8")
    assert "solver<br>1 → 0" in page


def test_what_cannot_be_is_refused_before_there_is_a_folder(tmp_path):
    for key, low, high, message in (
        ("sigma", 2.0, 1.0, "nothing between"),
        ("radius", 1.0, 40.0, "half the smallest"),
        ("timestep", 0.0, 1.0, "above 0"),
    ):
        with pytest.raises(InputError, match=message):
            mdnum.fork_map("argon/crystal-108", key, low, high, steps=5, out=tmp_path / "none")
    with pytest.raises(InputError, match="at least 1"):
        mdnum.fork_map("argon/crystal-108", "sigma", 1.0, 1.1, steps=0, out=tmp_path / "none")
    with pytest.raises(InputError, match="while it is loaded"):
        mdnum.fork_map(meeting(), "sigma", 1.0, 1.1, overrides={"cutoff.radius": 2.0}, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/notes").write_text("mine")
    with pytest.raises(FolderError, match="not empty"):
        mdnum.fork_map(meeting(), "sigma", 1.0, 1.1, out=tmp_path / "taken")


def test_runs_that_all_blow_up_are_no_single_history(tmp_path):
    summary = {
        "key": "potential.sigma", "low": 3.4, "high": 3.41, "value": 1.0, "steps": 500, "evaluations": 65,
        "failed_runs": 65, "boundaries": [], "unresolved": [], "confirm": True, "confirmed": 0,
    }  # fmt: skip
    verdict = page.judge(Question(tmp_path, summary, "", {}, {}))
    assert verdict.headline.startswith("All 65 runs between potential.sigma = 3.4 and 3.41 blew up")
    assert verdict.evidence == ("The interval is far above the system's own value, 1.0.",)
    assert verdict.tone == "warning" and "far above" in verdict.findings[0].remedy
    inside = {**summary, "low": 0.9, "high": 1.1}
    assert page.judge(Question(tmp_path, inside, "", {}, {})).evidence == ()
