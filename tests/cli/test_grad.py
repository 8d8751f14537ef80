"""`mdnum grad`, from the command line to the folder, and what is found in folders without a simulation."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call

from mdnum.errors import InputError
from mdnum.gradients import Problem, parameters
from mdnum.gradients.differences import Ensemble, SmoothedDifferences
from mdnum.gradients.losses import parse
from mdnum.store import RunFolder
from mdnum.store.files import write_text
from mdnum.systems import build
from mdnum.verbs import frame

WELL = "pair/leaving-well"
# the package has the function of this name
grad: Any = importlib.import_module("mdnum.verbs.grad")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nope", "--of", "msd"), "nor a file called 'nope'"),
        ((WELL,), "Add --of LOSS. Choose from msd,"),
        ((WELL, "--of", "mds", "--wrt", "sigma"), "Did you mean msd?"),
        ((WELL, "--of", "msd"), "Add --wrt NAME,NAME. The parameters are potential.sigma,"),
        ((WELL, "--of", "msd", "--wrt", "sgima"), "Did you mean sigma?"),
        (
            (WELL, "--of", "msd", "--wrt", "sigma,seed"),
            "dynamics.seed has no derivative",
        ),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--methods", "symetric"), "Did you mean symmetric?"),
        ((WELL, "--of", "pressure", "--wrt", "sigma"), "not defined for"),
        ((WELL, "--of", "potential:first=9", "--wrt", "sigma", "--steps", "8"), "any step from 0 to 8"),
        ((WELL, "--of", "potential:evry=2", "--wrt", "sigma"), "write for example potential:every=10"),
        ((WELL, "--of", "potential:every=x", "--wrt", "sigma"), "expected a whole number"),
        (
            ("silicon/tersoff-512", "--of", "msd", "--wrt", "r_cut"),
            "parameter 'r_cut'. Choose from potential.A,",
        ),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--also", "spektrum"), "from spectrum, edges, scaling"),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--replicas", "1"), "needs at least 2"),
        (("ball/drop", "--replicas", "3"), "--methods randomized"),
        (("ball/drop", "--also", "edges"), "system is a ball"),
        (("ball/drop", "--of", "msd"), "from final-height,"),
        (("ball/drop", "--wrt", "restitution"), "parameters are k, damping,"),
        (("ball/drop", "--methods", "symmetric"), "gradient 'symmetric'"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("grad", *arguments) == 2
    # a machine that is busy takes long enough for lines of progress
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.endswith(" s)")]
    assert len(lines) == 1 and message in lines[0]
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


def test_names_of_losses_take_numbers():
    simulation = build("argon/crystal-108")
    made = parse("temperature: every=10, first=20", simulation, 100)
    assert (made.name, made.every, made.first) == ("temperature", 10, 20)
    curve: Any = parse("rdf:bins=30", simulation, 100)
    # no bin reaches beyond half the box
    assert curve.bins == 30
    Problem(simulation, curve, 100)
    late: Any = parse("diffusion-green-kubo:every=7", simulation, 100)
    assert late.until == 98
    with pytest.raises(InputError, match=r"'bins=3' .*loss msd.*msd:every=10"):
        parse("msd:bins=3", simulation, 100)
    assert grad.words(["a,b", "b, c,"]) == ("a", "b", "c")
    units = {
        name: parameters.unit(simulation, name) for name in ("cutoff.radius", "box.scale", "potential.l1")
    }
    assert list(units.values()) == [simulation.units.length, "", "[l1]"]


def test_what_is_not_run_by_default_is_listed_with_how_to_ask(monkeypatch):
    simulation = build(WELL)
    problem = Problem(simulation, parse("msd", simulation, 50), 50)
    names = ("potential.sigma", "initial.velocities")
    chosen, _ = grad.plan(problem, names, None)
    assert {"event-aware", "symmetric", "finite-differences"} == {one.name for one in chosen}
    # some 22 runs, since velocities have no finite differences: 2 atoms and 50 steps each
    monkeypatch.setattr(grad, "AFFORDABLE", 2199)
    chosen, left = grad.plan(problem, names, None)
    assert "finite-differences" not in {one.name for one in chosen}
    rows = {one["what"]: one for one in left}
    late = rows["finite-differences"]
    assert (
        " 22 " in late["why"] and " 50 steps" in late["why"] and late["how"] == "--methods finite-differences"
    )
    # what is not available is listed too, and not how to ask for it
    assert "thermostat" in rows["reweighting"]["why"] and not rows["reweighting"]["how"]
    assert [one.name for one in grad.plan(problem, names, ("symmetric",))[0]] == ["symmetric"]
    # replicas are those of every average
    assert not any(isinstance(one, Ensemble) for one in chosen)
    chosen, _ = grad.plan(problem, names[:1], None, replicas=5)
    mean = next(one for one in chosen if isinstance(one, Ensemble))
    assert mean.replicas.count == 5 and mean.halvings == 0
    ((smoothed,), _) = grad.plan(problem, names[:1], ("smoothed-differences",), 5)
    assert isinstance(smoothed, SmoothedDifferences) and smoothed.replicas.count == 5


# a golden has such a folder, and test_crossings the closed form
@pytest.mark.nightly
def test_the_folder_holds_the_derivative_of_the_closed_form(tmp_path):
    out = tmp_path / "well"
    options = ("--steps", "2000", "--methods", "event-aware,symmetric", "-o", str(out))
    assert call("grad", WELL, "--of", "msd", "--wrt", "r_cut,initial.velocities", *options) == 0
    folder = RunFolder.open(out)
    summary = folder.summary
    assert folder.kind == "grad" and summary["status"] == "complete"
    made = {one["method"]: one["gradient"] for one in summary["methods"]}
    # a reduced mass of 1 and a relative speed of 1 at 1.8; beyond 2.5 nothing acts
    u, slope = [4 * (r**-12 - r**-6) for r in (1.8, 2.5)], 4 * (-12 * 2.5**-13 + 6 * 2.5**-7)
    moved = np.sqrt(summary["value"])
    exact = moved * (1.8 + 2 * moved - 2.5) / (1 + 2 * (u[0] - u[1])) * -slope
    whole = made["event-aware"]["cutoff.radius"]
    assert whole == pytest.approx(exact, rel=2e-3) and made["symmetric"]["cutoff.radius"] == 0.0
    # one flip, which is all of the derivative by the cutoff; it acts on no horizon that begins after it
    flips, growth = folder.read("flip_contributions"), folder.read("growth")
    assert not flips["entered"][0] and flips["contribution.cutoff.radius"].tolist() == pytest.approx([whole])
    late = growth["step"] > flips["step"][0]
    assert late.any() and not growth["gradient.cutoff.radius"][late].any()
    many = made["event-aware"]["initial.velocities"]
    with np.load(out / "gradients.npz") as arrays:
        stored = arrays["event-aware/initial.velocities"]
    assert many["shape"] == list(stored.shape) and many["norm"] == pytest.approx(np.linalg.norm(stored))
    assert (out / "provenance.json").exists() and "leaving" in folder.system_file.read_text()
    # half the time step leaves three digits of it, and its pairs were examined on both sides of the cutoff
    trust = summary["trust"]
    assert trust["half"]["cutoff.radius"] == pytest.approx(exact, rel=1e-3)
    assert trust["verdict"] == "trusted" and trust["digits"]["cutoff.radius"] >= 2
    assert "gradient of msd" in (out / "report.html").read_text(encoding="utf-8")
    assert call("report", str(out)) == 0


@pytest.mark.slow
def test_plain_alone_at_a_jump_is_done_and_named(tmp_path, capsys):
    options = ("--steps", "40", "--methods", "symmetric", "--no-report", "-o", str(tmp_path / "plain"))
    assert call("grad", WELL, "--of", "msd", "--wrt", "sigma", *options, "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert "MISSING_SALTATION" in {one["code"] for one in document["findings"]}
    # growth is that of the method that was asked for; it has nothing of flips
    assert document["growth"] and document["flips"] is None
    assert "flips" in {one["what"] for one in document["left_out"]}


# -- a folder without a simulation: an exponential, and flips of which one outweighs the others ------

STEPS, RATE = 500, 0.01
EPSILON, RADIUS, START = "potential.epsilon", "cutoff.radius", "initial.velocities"
#: A quarter of the derivative by the cutoff comes from the first of them.
WEIGHTS = np.array([0.5, -0.3, 0.2, 0.1, *np.full(96, 1.5 / 96)])
MANY = {"shape": [100, 3], "norm": 3.0, "largest": -1.0, "at": [7, 2]}


def method(name: str, kind: str, epsilon: float, radius: float, **more: Any) -> dict[str, Any]:
    gradient = {EPSILON: epsilon, RADIUS: radius, START: MANY}
    kept = {"description": f"what {name} gives", "value": 1.5, "error": {}, "notes": {}, "details": {}}
    return {"method": name, "kind": kind, "gradient": gradient, "seconds": 1.0, **kept, **more}


def row(name: str, parameter: str, relative: float | None, meaning: str = "", **more: Any) -> dict[str, Any]:
    base = {"name": parameter, "method": name, "reference": "event-aware", "size": 4.0, "values": {}}
    return {**base, "relative": relative, "difference": 4 * (relative or 0), "meaning": meaning, **more}


PLAIN = method("symmetric", "steps", 3.6, 0.0, notes={RADIUS: "exactly 0"})
DETAILS = {"crossings": 100, "grazing": 0, "guard": 1e-3, "weight applied": 2.6, "weight left out": 0.0}
AWARE = method("event-aware", "flow", 4.0, 2.0, details=DETAILS)
TRUST: dict[str, Any] = {
    "verdict": "limited", "horizon": 300, "limited_by": "near miss", "unknown": [], "tolerance": 0.01,
    "limits": [
        {"what": "near miss", "horizon": 300, "reached": True, "code": "short of", "values": {
            "count": 1, "i": 3, "j": 5, "step": 77, "gap": 3e-5, "reach": 8e-5, "term": 1.9, "share": 0.9,
            "column": RADIUS}},
    ],
    "half": {EPSILON: 4.02, RADIUS: 0.9},
    "digits": {EPSILON: 2, RADIUS: 0},
    "near": {"turns": 9, "within": 1, "heaviest": [
        {"step": 77, "i": 3, "j": 5, "gap": 3e-5, "reach": 8e-5, "term": {EPSILON: 0.1, RADIUS: 1.9}},
    ]},
}  # fmt: skip


def summary(**changes: Any) -> dict[str, Any]:
    """Three methods, of which one misses what the flips add."""
    values = ((EPSILON, "ε", 1.0), (RADIUS, "σ", 2.5), (START, "√(ε/m)", {**MANY, "norm": 17.0}))
    return {
        "system": "argon/synthetic", "about": "Nothing was simulated.", "atoms": 100,
        "steps": STEPS, "timestep": 0.01, "units": "lj", "value": 1.5, "force_jump": 0.04,
        "loss": {"word": "msd", "about": "mean squared displacement at the last step", "unit": "σ²"},
        "parameters": [{"name": name, "unit": unit, "value": value} for name, unit, value in values],
        "reference": "event-aware",
        "methods": [
            PLAIN, AWARE, method("finite-differences", "values", 3.9, 1.9, error={EPSILON: 0.2, RADIUS: 0.1}),
        ],
        "comparisons": [
            row("symmetric", EPSILON, 0.1, "missing saltation"),
            row("symmetric", RADIUS, 1.0, "missing saltation"),
            row("finite-differences", EPSILON, 0.025, "truncation and noise"),
        ],
        "growth": {
            "clock": 0.3, "timestep": 0.01, "rate": RATE, "error": 1e-4, "time": 1.0, "gain": 148.0,
            "word": "forward bounded, gradient not",
        },
        "flips": {
            "flips": len(WEIGHTS), "grazing": 0, "total": {EPSILON: 4.0, RADIUS: 2.0},
            "half": {EPSILON: 4, RADIUS: 4},
            "share": {
                EPSILON: {"smooth": 0.9, "pair enters": 0.04, "pair leaves": 0.06},
                RADIUS: {"smooth": 0.0, "pair enters": 0.4, "pair leaves": 0.6},
            },
        },
        "refused": [], "status": "complete", "seconds": 12.0,
        "left_out": [{"what": "unrolled", "why": "it takes its time", "how": "--methods unrolled"}],
        **changes,
    }  # fmt: skip


def write(path: Path, report: bool = False, **changes: Any) -> frame.Outcome:
    """A finished gradient folder, judged."""
    folder = RunFolder.create(path, frame.layout("grad"))
    write_text(
        folder.path / "system.toml", 'name = "argon/synthetic"\nunits = "lj"\n\n[dynamics]\ntimestep = 0.01\n'
    )
    folder.write_provenance({"command": "mdnum grad"})
    horizon, flips = np.arange(STEPS + 1), np.arange(len(WEIGHTS))
    size = np.exp(RATE * horizon)
    growth = {
        "horizon": horizon, "step": STEPS - horizon, "onto_positions": size, "onto_velocities": size,
        "size": size, "speed": np.ones(STEPS + 1), f"gradient.{EPSILON}": 4 * size / size[-1] - 1,
        f"gradient.{RADIUS}": np.where(horizon > 0, 2 * size / size[-1], 0.0), f"gradient.{START}": size,
    }  # fmt: skip
    terms = {
        "step": 1 + 3 * flips, "i": flips, "j": flips + 1, "entered": flips % 2 == 0,
        "margin": np.full(len(flips), 1e-3), "bound": np.full(len(flips), 1e-12),
        "ambiguous": np.zeros(len(flips), bool), "radial_speed": np.where(flips % 2, 0.5, -0.5),
        "weight": WEIGHTS, "grazing": np.zeros(len(flips), bool),
        f"contribution.{EPSILON}": 0.2 * WEIGHTS, f"contribution.{RADIUS}": WEIGHTS,
    }  # fmt: skip
    frame.store(folder, summary(**changes), {"growth": growth, "flip_contributions": terms})
    return frame.finish(folder, report=report)


def test_the_page_holds_what_the_folder_holds(tmp_path):
    outcome = write(tmp_path / "run", report=True, trust=TRUST)
    page = (outcome.folder / "report.html").read_text(encoding="utf-8")
    names = sorted(path.stem for path in (outcome.folder / "figures").iterdir())
    assert names == ["growth", "ranked", "running", "state"] and "argon/synthetic" in page
    assert all(part in outcome.summary["headline"] for part in ("500 steps", "d msd / d epsilon = 4.0 σ²/ε"))
    keys = {key.label: (key.value, key.note) for key in outcome.page.keys}
    # the digits that half the time step leaves, and no more
    assert keys[f"by {EPSILON}"] == ("4.0", "σ²/ε") and keys[f"by {RADIUS}"][0] == "2"
    # a parameter's value times the derivative, from one step on
    parts = [part for section in outcome.page.sections for part in section.parts]
    shown = {part.name: part.series for part in parts if hasattr(part, "series")}
    growth, state, running = (shown[name] for name in ("growth", "state", "running"))
    by = {series.label: series.y for series in growth}
    np.testing.assert_allclose(by[RADIUS][-1], 2.5 * 2.0)
    np.testing.assert_allclose(by[START], 17.0 * np.exp(RATE * np.arange(1, STEPS + 1)))
    np.testing.assert_allclose(state[1].y, np.exp(RATE * np.arange(STEPS + 1)), rtol=1e-9)
    assert {series.label: series.y[-1] for series in running}[RADIUS] == pytest.approx(WEIGHTS.sum() / 2.0)


PRIMAL = {"first state": 3, "first decision": None}


@pytest.mark.parametrize(
    ("changes", "code", "severity", "values"),
    [
        ({}, "FEW_FLIPS", "info", {"i": 0, "j": 1, "step": 1, "share": 0.25}),
        ({"methods": [PLAIN], "reference": "symmetric", "comparisons": [], "flips": None},
         "MISSING_SALTATION", "warning", {"jump": 0.04}),
        ({"methods": [PLAIN], "reference": "symmetric", "flips": None}, "NO_DEPENDENCE", "warning",
         {"name": RADIUS, "note": "exactly 0"}),
        ({"methods": [{**AWARE, "gradient": {**AWARE["gradient"], EPSILON: float("nan")}}]}, "NOT_FINITE",
         "error", {"names": EPSILON}),
        ({"methods": [{**AWARE, "gradient": {**AWARE["gradient"], EPSILON: None}}],
          "flips": {"flips": 100, "grazing": 0, "total": {EPSILON: None}, "half": {}, "share": {}}},
         "NOT_FINITE", "error", {"names": EPSILON}),
        ({"comparisons": [row("symmetric", EPSILON, 0.1, "unexplained", values={"explained": 1e-9})]},
         "UNEXPLAINED", "warning", {"closeness": "different by 10 %"}),
        ({"function": {"places": [{"order": 0, "pair": "X-X", "distance": 1.3, "jump": 1e-3, "what": "x"}]}},
         "FUNCTION_BREAKS", "warning", {"distance": 1.3}),
        ({"methods": [{**AWARE, "details": {**DETAILS, "grazing": 2, "weight left out": 0.5}}]}, "GRAZING",
         "warning", {"grazing": 2, "share": 0.5 / 3.1}),
        ({"methods": [{**AWARE, "details": {**DETAILS, "loss jumps": True}}]}, "LOSS_JUMPS", "warning", {}),
        ({"methods": [{**AWARE, "details": {"primal": PRIMAL}}]}, "ANOTHER_PRIMAL", "info", {"state": 3}),
        ({"methods": [{**AWARE, "details": {"primal": {**PRIMAL, "first decision": 40}}}]}, "ANOTHER_PRIMAL",
         "warning", {"decision": 40}),
        ({"trust": TRUST}, "BEYOND_TRUST", "warning", {"horizon": 300, "limit": "near miss"}),
        ({"refused": [{"method": "boundary", "why": "it is no average"}]}, "DOES_NOT_APPLY", "info", {}),
        ({"exact": {"y0": 2.0}, "reference": "closed form", "contact_kind": "impact", "flips": None,
          "integrator": "semi-implicit-euler", "growth": None, "force_jump": None,
          "comparisons": [row("event-aware", "y0", 0.1)]}, "NOT_THE_MOTION", "warning",
         {"each": "event-aware (y0 different by 10 %)"}),
    ],
)  # fmt: skip
def test_findings_follow_the_numbers(tmp_path, changes, code, severity, values):
    found = codes(tmp_path / "one", **changes)
    assert found[code].severity == severity
    assert {name: found[code].values[name] for name in values} == pytest.approx(values)


def test_what_is_no_number_is_reported_once(tmp_path):
    methods = [PLAIN, {**AWARE, "gradient": {**AWARE["gradient"], EPSILON: float("nan")}}]
    rows = [row("symmetric", name, 0.1, "unexplained") for name in (EPSILON, RADIUS)]
    rows = [{**one, "reference": "event-aware"} for one in rows]
    outcome = write(tmp_path / "one", methods=methods, comparisons=rows)
    found = [one["values"].get("name") for one in outcome.summary["findings"] if one["code"] == "UNEXPLAINED"]
    assert found == [RADIUS]


def limited(share: float | None) -> dict[str, Any]:
    """A judgment on one parameter: whether flips that were left out weigh in the derivative by it."""
    values = {"count": 2, "first": 41, "share": share}
    weighs = {"what": "flips left out", "horizon": 40, "reached": True, "code": "grazing", "values": values}
    free = {"what": "near miss", "horizon": STEPS, "reached": False, "code": "no jump", "values": {}}
    weigh = share != 0.0
    return {
        "verdict": "limited" if weigh else "trusted", "horizon": 40 if weigh else STEPS, "unknown": [],
        "limited_by": "flips left out" if weigh else "", "limits": [weighs if weigh else free],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("shares", "found"),
    [
        # of all flips' weight those left out have a sixth, of the derivative by one parameter nothing
        ((0.0, 0.3), {RADIUS: 0.3}),
        ((0.04, 0.3), {EPSILON: 0.04, RADIUS: 0.3}),
        # a share of a derivative that is zero
        ((None, 0.0), {EPSILON: None}),
        ((0.0, 0.0), None),
    ],
)
def test_flips_left_out_weigh_by_parameter(tmp_path, shares, found):
    by = {name: limited(share) for name, share in zip((EPSILON, RADIUS), shares, strict=True)}
    aware = {**AWARE, "details": {**DETAILS, "grazing": 2, "weight left out": 0.5}}
    told = codes(tmp_path / "a", methods=[aware], trust={**TRUST, **by[RADIUS], "by": by})
    assert ("GRAZING" in told) == (found is not None)
    if found is not None:
        assert told["GRAZING"].values["shares"] == found
    # of a parameter of many entries, which is not judged, their weight alone is known
    by[START] = {
        **by[RADIUS],
        "verdict": "undecided",
        "unknown": ["parameters of many entries"],
        "limits": [],
    }
    told = codes(tmp_path / "b", methods=[aware], trust={**TRUST, **by[RADIUS], "by": by})
    assert told["GRAZING"].values["share"] == pytest.approx(0.5 / 3.1)


def codes(path: Path, **changes: Any) -> dict[str, Any]:
    """Findings in a folder by their codes."""
    return {one.code: one for one in write(path, **changes).verdict.findings}


def test_what_is_no_defect_is_not_found(tmp_path):
    smooth = {"methods": [PLAIN], "reference": "symmetric", "force_jump": 0.0, "flips": None}
    assert "MISSING_SALTATION" not in codes(tmp_path / "a", **smooth)
    assert list(codes(tmp_path / "b")) == ["FEW_FLIPS"]
    near = {"exact": {"y0": 2.0}, "reference": "closed form", "contact_kind": "impact", "flips": None}
    near |= {"comparisons": [row("event-aware", "y0", 0.009)], "integrator": "x", "growth": None}
    assert "NOT_THE_MOTION" not in codes(tmp_path / "c", **near)
    assert grad.relative(1.98e-5, -4.125e-6) == pytest.approx(5.8)
    assert grad.relative(0.0, 0.0) == 0.0 and grad.relative(1.0, 0.0) == float("inf")


def open_trust(*unseen: str, unknown: tuple[str, ...] = ()) -> dict[str, Any]:
    """Trust that is undecided: half the time step was not made, and these limits were not examined."""
    limits = [
        {"what": what, "horizon": None, "reached": False, "values": {},
         "code": "half-step" if what == "near miss" else "not requested"}
        for what in unseen
    ]  # fmt: skip
    more = {"half": {}, "digits": {}, "near": None, "verdict": "undecided", "limited_by": ""}
    return {**TRUST, **more, "limits": limits, "unknown": unknown or unseen}


@pytest.mark.parametrize(
    ("trust", "tone", "words"),
    [
        (TRUST, "warning", "not trusted … 300 … near miss"),
        (open_trust("time step", unknown=("other starts",)), "warning", "undecided … other starting"),
        ({**TRUST, "verdict": "trusted", "limited_by": ""}, "good", "is trusted."),
        (None, "info", "= 2.000 σ²/σ and"),
    ],
)
def test_trusted_is_the_word_where_all_of_it_was_examined_alone(tmp_path, trust, tone, words):
    verdict = write(tmp_path / "one", trust=trust).verdict
    assert verdict.tone == tone and all(part in verdict.headline for part in words.split(" … "))


def test_every_parameter_has_a_verdict_of_its_own(tmp_path):
    """A near miss that is most of the derivative by the cutoff, and nothing of that by epsilon."""
    near = {name: TRUST[name] for name in ("verdict", "horizon", "limited_by", "unknown", "limits")}
    (limit,) = TRUST["limits"]
    free = {**limit, "horizon": STEPS, "reached": False, "values": {**limit["values"], "share": 0.0014}}
    good = {"verdict": "trusted", "horizon": STEPS, "limited_by": "", "unknown": [], "limits": [free]}
    open_ = {**good, "verdict": "undecided", "unknown": ["parameters of many entries"], "limits": []}
    trust = {**TRUST, "by": {EPSILON: good, RADIUS: near, START: open_}}
    outcome = write(tmp_path / "run", report=True, trust=trust)
    found = {one.code: one for one in outcome.verdict.findings}
    beyond = found["BEYOND_TRUST"]
    assert beyond.values["names"] == [RADIUS] and beyond.values["horizon"] == 300
    assert found["UNDECIDED"].values["names"] == [START]
    words = outcome.verdict.headline.partition("d msd / d epsilon")[2].partition("d msd / d radius")
    assert "(trusted)" in words[0] and "(not trusted: near miss" in words[2]
    assert RADIUS in beyond.title and EPSILON not in beyond.title
    (section,) = (one for one in outcome.page.sections if one.title == "How far it is trusted")
    tables = [part for part in section.parts if hasattr(part, "rows")]
    assert [len(one.rows) for one in tables[:3]] == [1, 1, 0]
    assert "0.1 %" in tables[0].rows[0][3]
    assert "90 %" in tables[1].rows[0][3]
    # where all share a verdict none is named
    shared = codes(tmp_path / "all", trust={**TRUST, "by": dict.fromkeys((EPSILON, RADIUS), near)})
    assert shared["BEYOND_TRUST"].values["names"] == []


def test_two_digits_are_shown_where_nobody_knows_how_many_hold(tmp_path):
    methods = [{**one, "gradient": {**one["gradient"], EPSILON: -0.0086653366}} for one in (PLAIN, AWARE)]
    outcome = write(
        tmp_path / "run", trust=open_trust("time step", "near miss"), methods=methods, report=True
    )
    key = next(key for key in outcome.page.keys if key.label == f"by {EPSILON}")
    assert (key.value, key.note) == ("−0.0087", "σ²/ε, digits not known")
    assert "0.00866" not in (outcome.folder / "report.html").read_text(encoding="utf-8")
    # of a question that is none about trust they are shown in full
    plain = write(tmp_path / "plain", methods=methods)
    assert any(key.value.startswith("−0.008665") for key in plain.page.keys)


@pytest.mark.parametrize(
    ("trust", "left", "remedy"),
    [
        (open_trust("time step", "near miss"), "half the time step", "Remove --no-half-step."),
        (open_trust("time step", "near miss"), "", "--set dynamics.kind=nve"),
        (open_trust("standard error", unknown=("other starts",)), "", "--replicas 8"),
        (open_trust("near miss"), "", "fewer parameters"),
    ],
)
def test_what_is_undecided_comes_with_what_to_do(tmp_path, trust, left, remedy):
    ways = {"left_out": [{"what": left, "why": "", "how": "x"}]} if left else {}
    assert remedy in codes(tmp_path / "one", trust=trust, **ways)["UNDECIDED"].text


def test_no_share_is_shown_of_a_derivative_without_a_digit(tmp_path):
    outcome = write(tmp_path / "run", trust=TRUST)
    few = next(one for one in outcome.verdict.findings if one.code == "FEW_FLIPS")
    assert "25 %" not in few.text
    assert any(EPSILON in line for line in outcome.verdict.evidence)
    flips = next(one for one in outcome.page.sections if one.title == "Flips on the way")
    rows = {line[0]: line[1:4] for line in flips.parts[1].rows}
    assert rows[RADIUS] == [None] * 3 and rows[EPSILON][0] == "+90.0 %"
