"""`bounce`: the folder holds what ran, row by row; defects that are planted in one are found, and shown."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mdnum
from mdnum import bounce, run
from mdnum.ball import first_difference
from mdnum.errors import FolderError, InputError
from mdnum.store import TABLES, RunFolder
from mdnum.systems import build_ball, load
from mdnum.verbs import ball_record, frame
from mdnum.verbs.ball import VERBS, differs, judge
from mdnum.verbs.ball_page import TEXTS, BallView, page
from mdnum.verbs.frame import Outcome

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
def three(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    said: list[str] = []
    note = lambda step, steps, info: said.append(info["phase"])  # noqa: E731
    out = tmp_path_factory.mktemp("runs") / "three"
    made = bounce(file, out=out, against=["stop.rule=per-instance"], report=False, progress=note)
    assert said[0] == "compile" and "run" in said
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


def test_the_tables_are_those_of_a_plain_loop(three: Outcome):
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


def test_every_stop_decision_is_a_row(three: Outcome):
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


def test_contact_flips_alternate_and_hold_the_compared_height(three: Outcome):
    contacts = RunFolder.open(three.folder).read("contacts")
    for ball in range(3):
        mine = contacts["ball"] == ball
        entered = contacts["entered"][mine]
        assert entered.tolist() == [n % 2 == 0 for n in range(len(entered))]
    assert np.array_equal(contacts["height"], -contacts["margin"])
    assert np.all((contacts["height"] < 0) == contacts["entered"])
    assert np.all(contacts["velocity"][contacts["entered"]] < 0)


def test_the_summary_counts_what_the_tables_hold(three: Outcome):
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


def test_a_variant_is_compared(three: Outcome):
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


def test_a_folder_of_the_ball_is_complete_and_its_own(three: Outcome):
    names = {path.name for path in three.folder.iterdir()}
    assert {"system.toml", "provenance.json", "summary.json"} <= names
    assert {f"{name}.parquet" for name in TABLES["ball"]} <= names
    assert not {f"{name}.parquet" for name in TABLES["md"]} & names
    again = load(three.folder)
    assert again.spec.model_dump(exclude={"name"}) == load(three.folder).spec.model_dump(exclude={"name"})
    assert list(again.variants) == ["stop.rule=per-instance"]
    with pytest.raises(FolderError, match="already holds a run"):
        bounce("ball/drop", out=three.folder)
    with pytest.raises(InputError, match="is the folder of `mdnum ball`"):
        run(None, resume=three.folder)


def test_a_rule_per_ball_records_each_ball(file: Path, tmp_path: Path):
    made = bounce(
        file, out=tmp_path / "own", overrides={"stop.rule": "per-instance", "gradient.of": []}, report=False
    )
    solver = RunFolder.open(made.folder).read("solver")
    counts = made.result.iterations
    assert counts.shape == (120, 3)
    touched = made.result.contact
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
        depth = -float(made.result.height[step, ball])
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
        return ball_record.exact(built.system, built.problem.run(), [])

    wave = {"flight__control__amplitude": 1.0, "flight__control__period": 1.0}
    assert exact(contact__k=1e4, contact__damping=200.0) is None
    assert exact(contact__eps=0.01) is None
    assert exact(contact__hysteresis=0.01) is None
    assert exact(flight__control__kind="sine", **wave) is None
    assert exact(flight__gravity=0.0) is None
    assert exact(start__height=-0.1) is None
    # a constant push is another gravity
    damped = exact(contact__damping=1.0)
    assert damped is not None and damped["height_error"] < 1e-2
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
    assert np.isfinite(made.result.y[:bad].astype(float)).all()
    assert not np.isfinite(made.result.y[bad].astype(float)).all()
    assert "finite" in made.summary["verdict"]


def test_counts_of_different_things_are_not_compared():
    small = {"gradient.of": [], "variants.other.integrator.kind": "semi-implicit-euler"}
    built = build_ball("ball/zeno", small, steps=60)
    other = built.variants[-1].problem.run()
    run = built.problem.run()
    # one counts the impacts inside a step, the other nothing: both touch once, a step apart
    assert (run.iterations.sum(), other.iterations.sum()) == (1, 0)
    assert first_difference(run, other).iterations_differ == 0
    found = first_difference(run, other)
    assert (found.channel, found.contacts_differ) == ("contact", 2)


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


# --- judged and shown ---------------------------------------------------------------------------------


def made(
    method: str, gradient: dict[str, float | None], depends: dict[str, bool] | None = None
) -> dict[str, Any]:
    """A derivative as summary.json has it."""
    depends = dict.fromkeys(gradient, True) | (depends or {})
    return {"method": method, "says": "So.", "value": 0.1, "gradient": gradient, "depends": depends,
            "details": {}, "refused": False}  # fmt: skip


SAME: dict[str, Any] = {
    "name": "low", "changes": {"precision.state": "float32"}, "seed": None, "fork": None, "channel": None,
    "ball": None, "margin": None, "margin_there": None, "separation_end": 0.0, "iterations_differ": 0,
    "contacts_differ": 0, "loss": 0.1, "gradient": {"k": -2.5e-5}, "depends": {"k": True},
}  # fmt: skip
FORK = {"seed": 3, "fork": 30, "channel": "contact", "ball": 2, "margin": 1e-17, "margin_there": -2e-17}


@pytest.fixture(scope="module")
def good(three: Outcome) -> BallView:
    """A run with nothing to find in it: of the real one what its summary says about derivatives goes."""
    folder = RunFolder.open(three.folder)
    plain = {"gradient": [made("unrolled", {"k": -2.5e-5})], "variants": [], "exact": None, "findings": []}
    quiet = {"ambiguous": 0, "ambiguous_contacts": 0, "ambiguous_stops": 0}
    return BallView(folder, folder.summary | plain | quiet)


def altered(
    view: BallView, tables: dict[str, dict[str, np.ndarray]] | None = None, **summary: Any
) -> BallView:
    return replace(view, summary={**view.summary, **summary}, _tables=tables or {})


def of(view: BallView, system: str, **overrides: Any) -> BallView:
    """The same run, said to be of another system."""
    view = altered(view)
    spec = load(system, {key.replace("__", "."): value for key, value in overrides.items()}).spec
    vars(view)["system"] = spec.model_dump(exclude_none=True)
    return view


def codes(view: BallView) -> dict[str, Any]:
    return {finding.code: finding for finding in judge(view).findings}


def test_every_planted_defect_is_found_and_nothing_else(good: BallView):
    own, exact = good.summary["gradient"][0], {"height_error": 1e-9, "height_error_largest": 1e-9}
    contacts, series = good.table("contacts"), {k: v.copy() for k, v in good.table("steps").items()}
    short = {name: values[1:] for name, values in contacts.items()}
    planted: dict[str, BallView] = {
        "NOT_FINITE": altered(good, not_finite=17, status="failed"),
        "LEDGER_INCOMPLETE": altered(good, {"contacts": short, "steps": series}),
        "GRADIENT_NOT_FINITE": altered(good, gradient=[made("unrolled", {"k": None})]),
        "LOSS_INDEPENDENT": altered(good, gradient=[made("unrolled", {"k": 0.0}, {"k": False})]),
        "ZERO_GRADIENT": altered(good, gradient=[made("unrolled", {"k": 0.0})]),
        "AMBIGUOUS_CONTACTS": altered(good, ambiguous=3, ambiguous_contacts=3),
        "AMBIGUOUS_STOPS": altered(good, ambiguous=1, ambiguous_stops=1),
        "SOLVER_CAP": altered(good, ended={"tolerance": 10, "cap": 2}),
        "METHODS_DISAGREE": altered(good, gradient=[own, made("event-aware", {"k": -2.9e-5})]),
        "OFF_CLOSED_FORM": altered(good, exact={**exact, "gradient": {"k": -2e-5}}),
        "FORKED": altered(good, variants=[SAME | FORK | {"gradient": {"k": -1.0}}]),
        "ITERATIONS_DIFFER": altered(good, variants=[SAME | {"iterations_differ": 4}]),
        "RESTING": altered(good, ended={"rest": 4}),
        "TOLERANCE_BELOW_ROUNDING": of(
            good, "ball/batch-on-the-boundary", start__height=1.0, flight__gravity=9.81, stop__tol=1e-10
        ),
        "PROJECTION_OVERSHOOTS": of(good, "ball/batch-on-the-boundary", contact__k=3.0),
        "STEP_BEYOND_STABILITY": of(good, "ball/drop", contact__k=1e7),
    }
    assert set(planted) == set(TEXTS.entries) - {"sentences"}
    assert codes(good) == {}
    for code, view in planted.items():
        assert set(codes(view)) == {code}, code
    # every ball on the floor from step 81 on, which no flip accounts for
    series["contacts"][81:] = 3
    found = codes(altered(good, {"contacts": contacts, "steps": series}))
    assert set(found) == {"LEDGER_INCOMPLETE", "RESTING"} and found["RESTING"].values == {"step": 81}


def test_a_good_run_rests_on_evidence(good: BallView):
    verdict = judge(good)
    assert (verdict.tone, len(verdict.evidence)) == ("good", 5)
    exact = {"gradient": {"k": -2.5001e-5}, "height_error": 2e-14, "height_error_largest": 3e-14}
    verdict = judge(altered(good, exact=exact))
    assert verdict.findings == ()
    assert verdict.evidence[-1] == TEXTS("met", names="k", methods="unrolled")


def test_variants_of_a_finding(good: BallView):
    own = good.summary["gradient"][0]
    fragile = SAME | {"name": "fragile", "depends": {"k": False}, "gradient": {"k": -2.5e-5}}
    finding = codes(altered(good, variants=[fragile]))["LOSS_INDEPENDENT"]
    assert (finding.values["names"], finding.values["places"]) == ("k", "in variant fragile")
    implicit = made("implicit", {"k": 0.0}, {"k": False})
    finding = codes(altered(good, gradient=[implicit]))["LOSS_INDEPENDENT"]
    assert "fixed point" in finding.text and "branch" not in finding.text
    both = [implicit, made("unrolled", {"k": 0.0}, {"k": False})]
    assert "branch" in codes(altered(good, gradient=both))["LOSS_INDEPENDENT"].text
    exact = {"gradient": {"k": -2.9e-5}, "height_error": 1e-9, "height_error_largest": 1e-9}
    both = [own, made("event-aware", {"k": -2.9e-5})]
    finding = codes(altered(good, gradient=both, exact=exact))["METHODS_DISAGREE"]
    assert finding.values["right"] == "event-aware on k"
    # precision alone: another gradient is another program; another integrator is one anyway
    moved = SAME | FORK | {"gradient": {"k": 1.0}}
    for variant, severity in (
        (SAME | FORK, "info"), (moved, "warning"), (moved | {"changes": {"integrator.kind": "x"}}, "info"),
    ):  # fmt: skip
        assert codes(altered(good, variants=[variant]))["FORKED"].severity == severity
    assert not differs(1.0, 1.005) and differs(1.0, 1.02) and differs(0.0, 1e-30) and differs(None, 1.0)
    assert not differs(0.0, 0.0) and not differs(None, None)


def test_findings_of_the_system_are_kept_and_own_ones_are_decided_again(good: BallView):
    remark = {"code": "STIFF", "severity": "warning", "title": "h √k is 1.95", "text": "Near 2."}
    stale = {**remark, "code": "SOLVER_CAP"}
    assert set(codes(altered(good, findings=[remark, stale]))) == {"STIFF"}


def test_the_page_shows_what_the_folder_holds(
    three: Outcome, good: BallView, monkeypatch: pytest.MonkeyPatch
):
    shown = {section.title: section for section in three.page.sections}
    assert {"Heights and contacts", "Margins of decisions", "Gradient", "Variants", "Contacts"} <= set(shown)
    folder = RunFolder.open(three.folder)
    contacts, solver = folder.read("contacts"), folder.read("solver")
    heights = shown["Heights and contacts"].parts[0]
    marks = heights.series[-1]
    assert marks.x.tolist() == pytest.approx((0.01 * contacts["step"][contacts["entered"]]).tolist())
    stopped, continued = shown["Margins of decisions"].parts[0].series
    assert np.all(stopped.y > 0) and np.all(continued.y <= 0)
    assert len(stopped.y) + len(continued.y) == len(solver["step"])
    table = shown["Contacts"].parts[-1]
    assert [row[:3] for row in table.rows] == np.stack(
        [contacts[name].astype(int) for name in ("step", "ball", "entered")], axis=1
    ).tolist()
    assert len(shown["Stop decisions"].parts[-1].rows) == len(solver["step"])
    # written twice, it is the same page; every part of the grammar is there for the derivatives
    first = frame.finish(folder).folder / "report.html"
    text = first.read_text(encoding="utf-8")
    assert frame.finish(folder).page and first.read_text(encoding="utf-8") == text
    assert json.loads((three.folder / "summary.json").read_text())["headline"]
    both = [made("unrolled", {"k": -2.5e-5}), made("implicit", {"k": 0.0}, {"k": False})]
    view = altered(good, gradient=[*both, {**made("smoothed", {}), "refused": True, "value": None}])
    rows = next(one for one in page(view, judge(view)).sections if one.title == "Gradient").parts[1].rows
    assert [row[0] for row in rows] == ["unrolled", "implicit", "smoothed"]
    assert rows[1][2] == "0 (does not depend)" and rows[2][2] == "does not apply"
    assert VERBS["ball"].judge is judge
