"""`bounce`: the folder holds what ran, row by row; defects that are planted in one are found, and shown."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mdnum import bounce, run
from mdnum.ball import first_difference
from mdnum.errors import FolderError, InputError
from mdnum.store import RunFolder
from mdnum.systems import build_ball, load
from mdnum.verbs import ball_record, frame
from mdnum.verbs.ball import KINDS, differs, judge
from mdnum.verbs.ball_page import TEXTS, BallView, page
from mdnum.verbs.frame import Outcome, layout

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


def test_tables_and_summary_are_those_of_the_run(three: Outcome):
    """Every state, contact flip and stop decision, and what is counted of them."""
    made, summary, folder = three.result, three.summary, RunFolder.open(three.folder)
    steps, heights, solver, contacts = map(folder.read, ("steps", "heights", "solver", "contacts"))
    assert steps["step"].tolist() == list(range(121))
    assert steps["iterations"].tolist() == [0, *made.iterations]
    assert steps["contacts"].tolist() == [0, *made.contact.sum(axis=1)]
    assert np.array_equal(np.diff(steps["contacts"]), steps["entered"][1:] - steps["left"][1:])
    assert np.array_equal(heights["y"].reshape(121, 3), made.y)
    assert heights["ball"].reshape(121, 3)[5].tolist() == [0, 1, 2]
    assert np.array_equal(steps["mean_height"], np.mean(made.y, axis=1))
    for name, values in (("y", made.y), ("v", made.v)):
        assert np.array_equal(steps[f"largest_{name}"], np.abs(values).max(axis=1))
    deepest = np.maximum(-made.height, 0).max(axis=1)
    assert steps["largest_depth"].tolist() == [0, *deepest] and deepest.max() > 0
    rest = [min((size for size in row if size), default=np.nan) for row in np.abs(made.v)]
    np.testing.assert_array_equal(steps["smallest_v"], rest)
    busy = np.flatnonzero(made.contact.any(axis=1)).tolist()
    rows = [(at + 1, n, made.history[at, n]) for at in busy for n in range(made.iterations[at] + 1)]
    assert list(zip(*(solver[name] for name in ("step", "iteration", "residual")), strict=True)) == rows
    assert np.array_equal(solver["margin"], 1e-4 - solver["residual"])
    assert np.array_equal(solver["stopped"], solver["margin"] > 0) and set(solver["ball"]) == {-1}
    assert set(solver["reason"][solver["stopped"]]) == {"tolerance"}
    assert set(solver["reason"][~solver["stopped"]]) == {""}
    for ball in range(3):
        entered = contacts["entered"][contacts["ball"] == ball]
        assert entered.tolist() == [n % 2 == 0 for n in range(len(entered))]
    # the height that was compared
    assert np.array_equal(contacts["height"], -contacts["margin"])
    assert np.all((contacts["height"] < 0) == contacts["entered"])
    assert np.all(contacts["velocity"][contacts["entered"]] < 0)
    assert (summary["balls"], summary["steps"]) == (3, 120)
    assert (summary["system"], summary["status"]) == ("three", "complete") and summary == folder.summary
    assert summary["iterations_total"] == made.iterations.sum()
    assert summary["iterations_max"] == made.iterations.max()
    assert summary["ended"] == {"tolerance": len(busy)} and summary["first_contact"] == busy[0] + 1
    assert summary["flips_entered"] == contacts["entered"].sum()
    assert summary["smallest_stop_margin"] == np.abs(solver["margin"]).min()
    assert summary["loss"] == pytest.approx(np.mean(made.y[-1]), rel=1e-15)
    # alone each ball stops at 1e-4 by itself: a step with two balls in contact differs first
    (variant,) = summary["variants"]
    assert variant["changes"] == {"stop.rule": "per-instance"}
    separations = folder.read("separations")
    assert set(separations["variant"]) == {"stop.rule=per-instance"}
    assert separations["step"].tolist() == list(range(121))
    assert variant["separation_end"] == separations["separation"][-1]
    assert variant["iterations_total"] >= made.iterations.sum()
    change = variant["gradient"]["k"] - summary["gradient"][0]["gradient"]["k"]
    assert variant["gradient_change"]["k"] == change


def test_a_folder_of_the_ball_is_complete_and_its_own(three: Outcome):
    names = {path.name for path in three.folder.iterdir()}
    assert {"system.toml", "provenance.json", "summary.json"} <= names
    assert {f"{name}.parquet" for name in layout("ball").always} <= names
    assert not {f"{name}.parquet" for name in layout("md").always} & names
    assert list(load(three.folder).variants) == ["stop.rule=per-instance"]
    with pytest.raises(FolderError, match="already holds a run"):
        bounce("ball/drop", out=three.folder)
    with pytest.raises(InputError, match="is a folder of `mdnum ball`"):
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


def test_a_closed_form_is_met_and_none_claimed_where_there_is_none():
    def exact(name: str = "ball/drop", gradient: Any = (), steps: int = 20, **changes: Any) -> Any:
        given = {key.replace("__", "."): value for key, value in changes.items()}
        built = build_ball(name, {"gradient.of": [], "variants": {}, **given}, steps=steps)
        return ball_record.exact(built.system, built.problem.run(), gradient)

    wave = {"flight__control__amplitude": 1.0, "flight__control__period": 1.0}
    for changes in (
        {"contact__k": 1e4, "contact__damping": 200.0}, {"contact__eps": 0.01}, {"contact__hysteresis": 0.01},
        {"flight__control__kind": "sine", **wave}, {"flight__gravity": 0.0}, {"start__height": -0.1},
    ):  # fmt: skip
        assert exact(**changes) is None, changes
    assert exact(contact__damping=1.0)["height_error"] < 1e-2
    # a constant push is another gravity
    lifted = exact(flight__control__kind="constant", flight__control__value=4.905)
    assert lifted["model"] == "ExactPenalty"
    assert lifted["first_contact_time"] == pytest.approx(math.sqrt(2 / 4.905), rel=1e-15)
    # t = sqrt(2 y / g)
    slopes = {"method": "made", "gradient": {"y0": 1.0, "gravity": 2.0}}
    located = exact("ball/zeno", [slopes], steps=200, gradient__of=["y0", "gravity"])
    assert located["model"] == "ExactImpact" and located["height_error_largest"] < 1e-12
    assert located["first_contact_time"] == pytest.approx(math.sqrt(2 / 9.81), rel=1e-15)
    assert located["rest_time"] == pytest.approx(math.sqrt(2 / 9.81) * 9, rel=1e-13)
    own, off = located["gradient"], located["gradient_error"]["made"]
    assert own.keys() == off.keys() == {"y0", "gravity"}
    assert all(off[name] == slopes["gradient"][name] - own[name] for name in own)


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
    found = first_difference(run, other)
    assert (found.channel, found.contacts_differ, found.iterations_differ) == ("contact", 2, 0)


def test_systems_that_cannot_be_bounced_or_run(tmp_path: Path):
    """A loaded system takes no overrides; each world has its own verb."""
    drop, crystal, out = load("ball/drop"), load("argon/crystal-108"), tmp_path / "x"
    asked: list[tuple[Any, Any, dict[str, Any], str]] = [
        (bounce, drop, {"overrides": {"contact.k": 1.0}}, "keys of a loaded system cannot be overridden"),
        (bounce, drop, {"against": ["contact.k"]}, "not of the form key=value"),
        *((run, system, {}, "the system is a ball") for system in ("ball/drop", drop)),
        *((bounce, system, {}, "molecular dynamics") for system in ("argon/crystal-108", crystal)),
    ]
    for verb, system, options, message in asked:
        with pytest.raises(InputError, match=message):
            verb(system, out=out, **options)
    assert not out.exists()


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
    assert set(planted) == {code for code in TEXTS.entries if code.isupper()}
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
    assert "fixed point" in finding.text and "loop" not in finding.text
    both = [implicit, made("unrolled", {"k": 0.0}, {"k": False})]
    assert "loop" in codes(altered(good, gradient=both))["LOSS_INDEPENDENT"].text
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
    assert KINDS["ball"].judge is judge


def test_a_page_says_at_which_step_a_narrower_format_would_not_do(tmp_path: Path):
    # the floor pushes with at most v sqrt(k), which is 88,000 at 4.4 m/s, beyond the largest float16
    file = tmp_path / "hard.toml"
    text = PROJECTION.replace(
        'kind = "projection"\nk = 0.5\nalpha = 0.5\nrestitution = 0.8', 'kind = "penalty"\nk = 4e8'
    )
    file.write_text(text.replace('[stop]\nrule = "sum"\ntol = 1e-4\nmax_iter = 100\n', ""))
    made = bounce(
        file, overrides={"integrator.timestep": 2e-5, "integrator.steps": 25_000}, out=tmp_path / "out"
    )
    push = 4e8 * np.maximum(-made.result.y, 0).max(axis=1)
    step = int(np.argmax(push >= 65520))
    assert push[step] >= 65520
    folder = RunFolder.open(made.folder)
    view = BallView(folder, folder.summary)
    (table, _) = next(s for s in page(view, judge(view)).sections if s.title == "Range of numbers").parts
    (row,) = [row for row in table.rows if row[0].startswith("force")]
    assert row[1] == push.max() and row[3:5] == ("held", "held")
    assert row[5].startswith(f"overflows at step {step:,} (")
