"""`mdnum grad`, from the command line to the folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call, printed
from mdnum.workflow.grad_words import loss, unit_of_loss, unit_of_parameter, words

from mdnum.errors import InputError
from mdnum.gradients.ensemble import Ensemble, SmoothedDifferences
from mdnum.gradients.problem import Problem
from mdnum.report import write
from mdnum.store import RunFolder
from mdnum.systems import build
from mdnum.workflow import grad_ball, grad_methods

WELL = "pair/leaving-well"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nope", "--of", "msd"), "no system called 'nope'"),
        ((WELL,), "Add --of LOSS. There are msd,"),
        ((WELL, "--of", "mds", "--wrt", "sigma"), "Did you mean msd?"),
        ((WELL, "--of", "msd"), "Add --wrt NAME,NAME. There are potential.sigma,"),
        ((WELL, "--of", "msd", "--wrt", "sgima"), "Did you mean sigma?"),
        ((WELL, "--of", "msd", "--wrt", "sigma,seed"), "nothing is differentiable by dynamics.seed"),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--methods", "symetric"), "Did you mean symmetric?"),
        ((WELL, "--of", "pressure", "--wrt", "sigma"), "has no meaning here"),
        ((WELL, "--of", "potential:first=9", "--wrt", "sigma", "--steps", "8"), "looks at no step up to 8"),
        ((WELL, "--of", "potential:evry=2", "--wrt", "sigma"), "write for example potential:every=10"),
        ((WELL, "--of", "potential:every=x", "--wrt", "sigma"), "not a whole number"),
        (
            ("silicon/tersoff-512", "--of", "msd", "--wrt", "r_cut"),
            "no parameter 'r_cut'. There are potential.A,",
        ),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--also", "spektrum"), "There are spectrum, edges, scaling"),
        ((WELL, "--of", "msd", "--wrt", "sigma", "--replicas", "1"), "takes at least 2"),
        (("ball/drop", "--replicas", "3"), "--methods randomized"),
        (("ball/drop", "--also", "edges"), "this system is a ball"),
        (("ball/drop", "--of", "msd"), "There are final-height,"),
        (("ball/drop", "--wrt", "restitution"), "There are k, damping,"),
        (("ball/drop", "--methods", "symmetric"), "no gradient called 'symmetric'"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("grad", *arguments) == 2
    # a machine that is busy takes long enough to be told what is going on
    told = [line for line in capsys.readouterr().err.splitlines() if not line.endswith(" s)")]
    assert len(told) == 1 and message in told[0]
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


def test_words_of_losses_take_numbers():
    simulation = build("argon/crystal-108")
    word, made = loss("temperature: every=10, first=20", simulation, 100)
    assert (word, made.every, made.first) == ("temperature", 10, 20)
    _, curve = loss("rdf:bins=30", simulation, 100)
    # no bin reaches beyond half the box
    assert curve.bins == 30 and curve.why_not is not None
    Problem(simulation, curve, 100)
    assert loss("diffusion-green-kubo:every=7", simulation, 100)[1].until == 98
    with pytest.raises(InputError, match="no number of the loss msd"):
        loss("msd:bins=3", simulation, 100)
    assert words(["a,b", "b, c,"]) == ("a", "b", "c")
    assert unit_of_loss("vacf", simulation.units) == f"{simulation.units.energy}/{simulation.units.mass}"
    assert unit_of_parameter("cutoff.radius", simulation.units) == simulation.units.length
    assert unit_of_parameter("box.scale", simulation.units) == ""
    assert unit_of_parameter("potential.lambda1", simulation.units) == "[lambda1]"


def test_what_is_not_run_by_default_is_said_with_how_to_ask(monkeypatch):
    simulation = build(WELL)
    problem = Problem(simulation, loss("msd", simulation, 50)[1], 50)
    names = ("potential.sigma", "initial.velocities")
    chosen = grad_methods.plan(problem, names, None)
    assert {"event-aware", "symmetric", "finite-differences"} == {one.name for one in chosen.methods}
    # some 22 runs, since velocities have no finite differences: 2 atoms and 50 steps each
    monkeypatch.setattr(grad_methods, "AFFORDABLE", 2199)
    chosen = grad_methods.plan(problem, names, None)
    assert "finite-differences" not in {one.name for one in chosen.methods}
    left = next(one for one in chosen.left_out if one["what"] == "finite-differences")
    assert left["why"] == "about 22 more runs of 50 steps" and left["how"] == "--methods finite-differences"
    monkeypatch.setattr(grad_methods, "AFFORDABLE", 2200)
    assert "finite-differences" in {one.name for one in grad_methods.plan(problem, names, None).methods}
    # what cannot be had is said too, and not how to ask for it
    reweighting = next(one for one in chosen.left_out if one["what"] == "reweighting")
    assert "thermostat" in reweighting["why"] and not reweighting["how"]
    assert [one.name for one in grad_methods.plan(problem, names, ("symmetric",)).methods] == ["symmetric"]


def test_replicas_are_those_of_every_average():
    simulation = build(WELL)
    problem = Problem(simulation, loss("msd", simulation, 50)[1], 50)
    chosen = grad_methods.plan(problem, ("potential.sigma",), None, replicas=5)
    mean = next(one for one in chosen.methods if isinstance(one, Ensemble))
    assert mean.replicas.count == 5 and mean.halvings == 0
    (smoothed,) = grad_methods.plan(problem, ("potential.sigma",), ("smoothed-differences",), 5).methods
    assert isinstance(smoothed, SmoothedDifferences) and smoothed.replicas.count == 5
    assert not any(
        isinstance(one, Ensemble) for one in grad_methods.plan(problem, ("potential.sigma",), None).methods
    )


@pytest.fixture(scope="module")
def well(tmp_path_factory) -> Path:
    """The folder of a pair that leaves its well."""
    out = tmp_path_factory.mktemp("gradients") / "well"
    options = ("--steps", "2000", "--methods", "event-aware,symmetric", "--no-report", "-o", str(out))
    assert call("grad", WELL, "--of", "msd", "--wrt", "r_cut,initial.velocities", *options) == 0
    return out


@pytest.mark.slow
def test_the_folder_holds_the_derivative_of_the_closed_form(well, capsys):
    folder = RunFolder.open(well)
    summary = folder.summary
    assert folder.world == "grad" and summary["status"] == "complete"
    made = {one["method"]: one for one in summary["methods"]}

    # a reduced mass of 1 and a relative speed of 1 at 1.8; beyond 2.5 nothing acts
    def u(r):
        return 4 * (r**-12 - r**-6)

    slope = 4 * (-12 * 2.5**-13 + 6 * 2.5**-7)
    speed2 = 1 + 2 * (u(1.8) - u(2.5))
    moved = np.sqrt(summary["value"])
    exact = moved * (1.8 + 2 * moved - 2.5) / speed2 * -slope
    assert made["event-aware"]["gradient"]["cutoff.radius"] == pytest.approx(exact, rel=2e-3)
    assert made["symmetric"]["gradient"]["cutoff.radius"] == 0.0
    assert "exactly 0" in made["symmetric"]["notes"]["cutoff.radius"]
    (row,) = [one for one in summary["comparisons"] if one["name"] == "cutoff.radius"]
    assert row["means"] == "missing saltation"

    # one flip, which is all of the derivative by the cutoff
    flips = folder.read("flip_contributions")
    assert len(flips["step"]) == 1 and not flips["entered"][0]
    whole = made["event-aware"]["gradient"]["cutoff.radius"]
    assert flips["weight"][0] == pytest.approx(whole) == flips["contribution.cutoff.radius"][0]
    growth = folder.read("growth")
    assert growth["gradient.cutoff.radius"][-1] == pytest.approx(whole)
    # it acts on no horizon that begins after it
    late = growth["step"] > flips["step"][0]
    assert late.any() and not growth["gradient.cutoff.radius"][late].any()
    many = made["event-aware"]["gradient"]["initial.velocities"]
    with np.load(well / "gradients.npz") as arrays:
        stored = arrays["event-aware/initial.velocities"]
    assert many["shape"] == list(stored.shape) and many["norm"] == pytest.approx(np.linalg.norm(stored))
    assert (well / "provenance.json").exists() and "leaving" in folder.system_toml

    # half the time step leaves three digits of it, and its pairs were looked at on both sides of the cutoff
    trust = summary["trust"]
    assert trust["half"]["cutoff.radius"] == pytest.approx(exact, rel=1e-3)
    assert trust["verdict"] == "trusted" and trust["digits"]["cutoff.radius"] >= 2

    write(well)
    assert "gradient of msd" in (well / "report.html").read_text(encoding="utf-8")
    assert call("report", str(well)) == 0


@pytest.mark.slow
def test_plain_alone_at_a_jump_is_done_and_told(tmp_path, capsys, monkeypatch):
    # trust would be two programs more
    monkeypatch.setattr(grad_methods, "_PARTS", ("agreement", "growth", "flips"))
    options = ("--steps", "40", "--methods", "symmetric", "--no-report", "-o", str(tmp_path / "plain"))
    assert call("grad", WELL, "--of", "msd", "--wrt", "sigma", *options, "--json") == 1
    document = json.loads(capsys.readouterr().out)
    codes = {one["code"] for one in document["findings"]}
    assert "MISSING_SALTATION" in codes
    # growth is that of the method that was asked for; it knows nothing of flips
    assert document["growth"] and document["flips"] is None
    assert "flips" in {one["what"] for one in document["left_out"]}


@pytest.mark.slow
def test_a_ball_is_compared_with_its_closed_form(tmp_path, capsys):
    out = tmp_path / "ball"
    asked = ("ball/zeno", "--wrt", "restitution", "--methods", "event-aware,implicit", "--no-report")
    assert call("grad", *asked, "-o", str(out)) == 0
    lines = printed(capsys)
    assert any(line.startswith("closed form 1.087") for line in lines)
    summary = RunFolder.open(out).summary
    (made,) = summary["methods"]
    assert made["gradient"]["restitution"] == pytest.approx(summary["exact"]["restitution"], rel=1e-9)
    assert [one["method"] for one in summary["refused"]] == ["implicit"]


def test_off_is_relative_to_what_is_right():
    assert grad_ball._relative(1.98e-5, -4.125e-6) == pytest.approx(5.8)
    assert grad_ball._relative(0.0, 0.0) == 0.0 and grad_ball._relative(1.0, 0.0) == float("inf")
