"""`bounce`: the folder it leaves holds what ran, row by row, and the numbers of exact answers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mdnum
from mdnum.ball import first_difference
from mdnum.errors import FolderError, InputError
from mdnum.store import TABLES, RunFolder
from mdnum.systems import build_ball, load
from mdnum.workflow import BallResult, ball_exact, ball_record, bounce, run

PROJECTION = """\
world = "ball"
[start]
height = [1.0, 2.0, 1.5]
[contact]
kind = "projection"
k = 0.5
alpha = 0.5
restitution = 0.8
[stop]
rule = "sum"
tol = 1e-4
max_iter = 100
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 120
[gradient]
of = ["k"]
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("systems") / "three.toml"
    path.write_text(PROJECTION)
    return path


@pytest.fixture(scope="module")
def three(file: Path, tmp_path_factory: pytest.TempPathFactory) -> BallResult:
    said: list[str] = []
    made = bounce(
        file,
        out=tmp_path_factory.mktemp("runs") / "three",
        against=["stop.rule=per-instance"],
        report=False,
        progress=lambda step, steps, info: said.append(info["phase"]),
    )
    assert said[0] == "compile"
    assert "run" in said
    return made


def plain(steps: int, tol: float = 1e-4) -> dict[str, Any]:
    """The three balls an operation at a time, with every stop decision."""
    y, v, h, a = [1.0, 2.0, 1.5], [0.0] * 3, 0.01, -9.81
    rows = {"y": [list(y)], "iterations": [], "contact": [], "stops": []}
    for _ in range(steps):
        v = [one + h * a for one in v]
        y = [one + h * up for one, up in zip(y, v, strict=True)]
        contact = [one < 0 for one in y]

        def residual(y: list[float]) -> float:
            total = 0.0
            for one in y:
                total = total + max(-one, 0.0)
            return total

        decisions = [residual(y)]
        while decisions[-1] >= tol and len(decisions) <= 100:
            y = [one + 0.25 * max(-one, 0.0) for one in y]
            decisions.append(residual(y))
        v = [-0.8 * min(up, 0.0) if hit else up for up, hit in zip(v, contact, strict=True)]
        y = [max(one, 0.0) for one in y]
        rows["y"].append(list(y))
        rows["iterations"].append(len(decisions) - 1)
        rows["contact"].append(contact)
        rows["stops"].append(decisions if any(contact) else [])
    return rows


def test_the_tables_are_those_of_a_plain_loop(three: BallResult):
    folder = RunFolder.open(three.folder)
    right = plain(120)
    steps = folder.read("steps")
    assert steps["step"].tolist() == list(range(121))
    assert steps["iterations"].tolist() == [0, *right["iterations"]]
    contact = np.array(right["contact"])
    assert steps["contacts"].tolist() == [0, *contact.sum(axis=1).tolist()]
    assert (steps["contacts"][1:] - steps["contacts"][:-1]).tolist() == (
        steps["entered"][1:] - steps["left"][1:]
    ).tolist()
    heights = folder.read("heights")
    assert heights["y"].reshape(121, 3).tolist() == right["y"]
    assert heights["ball"].reshape(121, 3)[5].tolist() == [0, 1, 2]
    assert np.array_equal(steps["mean_height"], np.mean(np.array(right["y"]), axis=1))


def test_every_stop_decision_is_a_row(three: BallResult):
    solver = RunFolder.open(three.folder).read("solver")
    right = plain(120)["stops"]
    rows = [(step + 1, n, value) for step, stops in enumerate(right) for n, value in enumerate(stops)]
    seen = zip(
        solver["step"].tolist(), solver["iteration"].tolist(), solver["residual"].tolist(), strict=True
    )
    assert list(seen) == rows
    assert np.array_equal(solver["margin"], 1e-4 - solver["residual"])
    assert np.array_equal(solver["stopped"], solver["margin"] > 0)
    assert set(solver["ball"]) == {-1}
    assert set(solver["reason"][solver["stopped"]]) == {"tolerance"}
    assert set(solver["reason"][~solver["stopped"]]) == {""}


def test_contact_flips_alternate_and_hold_the_compared_height(three: BallResult):
    contacts = RunFolder.open(three.folder).read("contacts")
    for ball in range(3):
        mine = contacts["ball"] == ball
        entered = contacts["entered"][mine]
        assert entered.tolist() == [n % 2 == 0 for n in range(len(entered))]
    assert np.array_equal(contacts["height"], -contacts["margin"])
    assert np.all((contacts["height"] < 0) == contacts["entered"])
    assert np.all(contacts["velocity"][contacts["entered"]] < 0)


def test_the_summary_counts_what_the_tables_hold(three: BallResult):
    summary, folder = three.summary, RunFolder.open(three.folder)
    right = plain(120)
    solves = [stops for stops in right["stops"] if stops]
    assert (summary["world"], summary["balls"], summary["steps"]) == ("ball", 3, 120)
    assert summary["system"] == "three"
    assert summary["iterations_total"] == sum(right["iterations"])
    assert summary["iterations_max"] == max(right["iterations"])
    assert summary["ended"] == {"tolerance": len(solves)}
    assert summary["flips_entered"] == int(folder.read("contacts")["entered"].sum())
    assert summary["first_contact"] == next(n for n, row in enumerate(right["contact"], 1) if any(row))
    near = min(abs(1e-4 - value) for stops in solves for value in stops[-2:])
    assert summary["smallest_stop_margin"] == near
    assert summary["status"] == "complete"
    assert summary["loss"] == pytest.approx(np.mean(right["y"][-1]), rel=1e-15)
    assert summary["verdict"]
    assert summary == folder.summary


def test_a_variant_is_told_where_it_parts(three: BallResult):
    (found,) = three.summary["variants"]
    right = plain(120)
    # alone each ball stops at 1e-4 by itself: a step with two balls in contact differs first
    assert found["changes"] == {"stop.rule": "per-instance"}
    separations = RunFolder.open(three.folder).read("separations")
    assert set(separations["variant"]) == {"stop.rule=per-instance"}
    assert separations["step"].tolist() == list(range(121))
    assert found["separation_end"] == separations["separation"][-1]
    assert found["iterations_total"] >= sum(right["iterations"])
    change = found["gradient_change"]["k"]
    assert change == found["gradient"]["k"] - three.summary["gradient"][0]["gradient"]["k"]


def test_a_folder_of_the_ball_is_complete_and_its_own(three: BallResult):
    names = {path.name for path in three.folder.iterdir()}
    assert {"system.toml", "provenance.json", "summary.json"} <= names
    assert {f"{name}.parquet" for name in TABLES["ball"]} <= names
    assert not {f"{name}.parquet" for name in TABLES["md"]} & names
    again = load(three.folder)
    assert again.spec.model_dump(exclude={"name"}) == load(three.folder).spec.model_dump(exclude={"name"})
    assert [variant.name for variant in again.variants] == ["stop.rule=per-instance"]
    with pytest.raises(FolderError, match="already holds a run"):
        bounce("ball/drop", out=three.folder)
    with pytest.raises(InputError, match=r"run of the ball.*Run it again with `mdnum ball"):
        run(None, resume=three.folder)


def test_a_rule_per_ball_records_each_ball(file: Path, tmp_path: Path):
    made = bounce(
        file,
        out=tmp_path / "own",
        overrides={"stop.rule": "per-instance", "gradient.of": []},
        report=False,
    )
    solver = RunFolder.open(made.folder).read("solver")
    counts = made.run.iterations
    assert counts.shape == (120, 3)
    touched = made.run.contact
    assert len(solver["step"]) == touched.sum() + (counts > 0).sum()
    stopped = solver["stopped"]
    where = solver["step"][stopped] - 1, solver["ball"][stopped]
    assert np.array_equal(counts[where], solver["iteration"][stopped])
    before = solver["step"][~stopped] - 1, solver["ball"][~stopped]
    assert np.array_equal(counts[before] - 1, solver["iteration"][~stopped])
    last = {
        (step, ball): residual
        for step, ball, residual in zip(*where, solver["residual"][stopped], strict=True)
    }
    for step, ball, residual in zip(*before, solver["residual"][~stopped], strict=True):
        assert residual * 0.75 == pytest.approx(last[step, ball], rel=1e-9)
    # 1 - alpha k = 3/4 of the penetration is left by an iteration
    for step, ball in np.argwhere(touched):
        depth = -float(made.run.height[step, ball])
        needed = math.ceil(math.log(1e-4 / depth) / math.log(0.75)) if depth >= 1e-4 else 0
        assert counts[step, ball] == needed


def test_a_located_impact_meets_the_closed_form(tmp_path: Path):
    made = bounce("ball/zeno", out=tmp_path / "zeno", overrides={"variants": {}}, steps=200, report=False)
    exact = made.summary["exact"]
    assert exact["model"] == "ExactImpact"
    assert exact["height_error_largest"] < 1e-12
    # t = sqrt(2 y / g)
    assert exact["first_contact_time"] == pytest.approx(math.sqrt(2 / 9.81), rel=1e-15)
    assert exact["rest_time"] == pytest.approx(math.sqrt(2 / 9.81) * 9, rel=1e-13)
    assert set(exact["gradient"]) == {"y0", "restitution", "gravity"}
    for errors in exact["gradient_error"].values():
        for name, error in errors.items():
            assert abs(error) < 1e-9 * abs(exact["gradient"][name])
    # impacts at 0.4515 s (1 + 2 (0.8 + 0.64 + ...)): three in 2 s, and the fourth at 2.21 s
    assert made.summary["ended"] == {}
    assert made.summary["iterations_total"] == 3


def test_where_there_is_no_closed_form_none_is_claimed():
    def exact(**changes: Any) -> dict[str, Any] | None:
        given = {key.replace("__", "."): value for key, value in changes.items()}
        built = build_ball("ball/drop", {"gradient.of": [], "variants": {}, **given}, steps=20)
        return ball_exact.exact(built.system, built.problem.run(), [])

    wave = {"flight__control__amplitude": 1.0, "flight__control__period": 1.0}
    assert exact(contact__damping=1.0) is None
    assert exact(contact__eps=0.01) is None
    assert exact(contact__hysteresis=0.01) is None
    assert exact(flight__control__kind="sine", **wave) is None
    assert exact(flight__gravity=0.0) is None
    assert exact(start__height=-0.1) is None
    # a constant push is another gravity
    lifted = exact(flight__control__kind="constant", flight__control__value=4.905)
    assert lifted is not None
    assert lifted["model"] == "ExactPenalty"
    assert lifted["first_contact_time"] == pytest.approx(math.sqrt(2 / 4.905), rel=1e-15)


def test_a_state_that_stops_being_finite_is_a_failed_run(tmp_path: Path):
    # one step on the spring, and the ball flies past the largest float16
    wild = {
        "integrator.kind": "explicit-euler", "integrator.timestep": 0.1, "contact.k": 6e4, "variants": {},
        "gradient.of": [], "precision.state": "float16", "precision.arithmetic": "float16",
    }  # fmt: skip
    made = bounce("ball/drop", out=tmp_path / "wild", steps=100, overrides=wild, report=False)
    assert made.summary["status"] == "failed"
    bad = made.summary["not_finite"]
    assert 10 < bad < 100
    assert np.isfinite(made.run.y[:bad].astype(float)).all()
    assert not np.isfinite(made.run.y[bad].astype(float)).all()
    assert "finite" in made.summary["verdict"]


def test_counts_of_different_things_are_not_compared():
    small = {"gradient.of": [], "variants.other.integrator.kind": "semi-implicit-euler"}
    built = build_ball("ball/zeno", small, steps=60)
    other = built.variants[-1].problem.run()
    run = built.problem.run()
    # one counts the impacts inside a step, the other nothing: both touch once, a step apart
    assert (run.iterations.sum(), other.iterations.sum()) == (1, 0)
    assert first_difference(run, other).iterations_differ == 0
    found = ball_record.parted(run, other)
    assert (found.iterations_differ, found.channel, found.contacts_differ) == (0, "contact", 2)
    assert ball_record.parted(run, run).fork is None


def test_a_loaded_system_takes_no_overrides(tmp_path: Path):
    system = load("ball/drop")
    with pytest.raises(InputError, match="overrides change a system while it is loaded"):
        bounce(system, out=tmp_path / "x", overrides={"contact.k": 1.0})
    for given in ("ball/drop", system):
        with pytest.raises(InputError, match="this system is a ball"):
            mdnum.run(given, out=tmp_path / "x")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="molecular dynamics"):
        mdnum.bounce("argon/crystal-108", out=tmp_path / "x")
    with pytest.raises(InputError, match="molecular dynamics"):
        bounce(load("argon/crystal-108"), out=tmp_path / "x")
    with pytest.raises(InputError, match="not of the form key=value"):
        bounce(system, out=tmp_path / "x", against=["contact.k"])
    assert not (tmp_path / "x").exists()
