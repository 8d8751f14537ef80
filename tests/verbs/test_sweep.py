"""Sweeps: what moves what, what is stored, what is computed again."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from time import sleep
from typing import Any

import numpy as np
import pytest
from small_systems import crystal

import mdnum
from mdnum.errors import InputError
from mdnum.sweeps.measures import chosen
from mdnum.sweeps.plan import Question, planned
from mdnum.sweeps.points import gone
from mdnum.verbs import sweep_worker
from mdnum.verbs.sweep_page import TEXTS


@pytest.fixture(scope="module")
def simulation():
    return mdnum.simulation(
        crystal(), mdnum.LennardJones(1.0, 1.0), mdnum.Cut("switched", 2.0), units="lj", timestep=0.004,
        temperature=0.5, skin=0.2, steps=200, seed=1, name="small",
    )  # fmt: skip


@pytest.fixture(scope="module")
def swept(simulation, tmp_path_factory):
    """A sweep of time steps and skins, one of which is no run."""
    folder = tmp_path_factory.mktemp("sweep")
    with ThreadPoolExecutor(1) as pool:
        made = mdnum.sweep(
            simulation, {"dynamics.timestep": [0.002], "cutoff.radius": [9.0], "neighbors.skin": [0.3]},
            seeds=2, steps=100, measure="energy,drift,lost", tolerance=0.5, on=pool, out=folder / "one",
        )  # fmt: skip
    return folder, made


def test_a_sweep_says_what_moves_and_what_failed(swept):
    _, made = swept
    # 8, and those of the recommended values together, which depend on the fastest skin
    assert made.summary["points"] in (8, 10, 12) and made.summary["computed"] == made.summary["points"] - 2
    rows = made.table("differences").to_pandas().set_index(["measure", "choice", "setting"])
    assert ("energy", "dynamics.timestep", "0.002") in rows.index
    assert ("energy", "cutoff.radius", "9") not in rows.index
    (failed,) = made.summary["failed"]
    assert failed["points"] == 2 and "POINTS_FAILED" in [one.code for one in made.findings]
    points = made.table("points").to_pandas()
    assert (points[points.status == "failed"].value.isna()).all()
    skin = rows.loc["energy", "neighbors.skin", "0.3"]
    assert abs(skin.value) < 1e-6 and skin.moves == "no"
    advice = {one["choice"]: one for one in made.summary["advice"]}
    assert advice["cutoff.radius"]["end"] == 2.0  # the largest failed
    assert advice["dynamics.timestep"]["end"] == 0.002 and advice["neighbors.skin"]["best"] in (0.2, 0.3)
    assert (made.folder / "report.html").exists()


@pytest.mark.parametrize("name", ["argon/crystal-108", None])
def test_points_of_further_seeds_have_their_own_addresses(simulation, name):
    """As if each seed were a sweep of its own."""
    over = {"dynamics.timestep": [0.002], "cutoff.radius": [1.9]}

    def addresses(seeds: int | list[int]) -> list[tuple[Any, str]]:
        found = planned(name or simulation, over, Question(seeds=seeds, measure="energy"), None)
        return [(one.point.choices, one.address) for one in found.points]

    together = addresses(3)
    assert together == [one for seed in range(3) for one in addresses([seed])]
    assert len({address for _, address in together}) == 9


def test_runs_take_the_same_time(swept):
    folder, _ = swept
    states = [
        json.loads(file.read_text())
        for file in folder.glob("sweep-points/workspace/*/signac_statepoint.json")
    ]
    steps = {one["system"]["dynamics"]["timestep"]: one["asked"]["steps"] for one in states}
    assert steps == {0.004: 100, 0.002: 200}


def test_means_are_those_of_runs(swept, simulation, tmp_path):
    """Of a point, against the run itself."""
    _, made = swept
    own = mdnum.run(
        mdnum.changed(simulation, {"dynamics.seed": 1}), steps=100, out=tmp_path / "run", check=False
    )
    series = own.table("series").to_pandas()
    points = made.table("points").to_pandas()
    one = points[(points.setting == "0.004, 2, 0.2") & (points.seed == 1) & (points.measure == "energy")]
    # over what is in equilibrium
    tails = series.potential.to_numpy()[::-1].cumsum()[::-1] / np.arange(len(series), 0, -1) / len(crystal())
    assert np.abs(tails - float(one.value.iloc[0])).min() < 1e-12


def test_what_is_new_alone_is_computed(swept, simulation, monkeypatch):
    folder, _ = swept
    asked = {"seeds": 2, "steps": 100, "measure": "energy,drift,lost"}
    over = {"dynamics.timestep": [0.002], "cutoff.radius": [9.0], "neighbors.skin": [0.3]}
    with ThreadPoolExecutor(1) as pool:
        more = mdnum.sweep(
            simulation, {**over, "cutoff.radius": [1.9, 9.0]}, **asked, on=pool, out=folder / "two"
        )
        assert more.summary["computed"] == 2 and more.summary["found"] == 6
        assert more.summary["changed"] == ["cutoff.radius", "cutoff.onset"] or "cutoff" in str(
            more.summary["changed"]
        )

        def no_run(*_):
            raise AssertionError

        monkeypatch.setattr(sweep_worker, "_run", no_run)
        measured = mdnum.sweep(
            simulation, over, seeds=2, steps=100, measure="energy,flips", on=pool, out=folder / "three"
        )
    assert "flips" in set(measured.table("estimates").to_pandas().measure)


@pytest.mark.nightly
def test_a_loaded_system_is_that_of_its_file(tmp_path):
    """With what it was loaded with: the points of both are the same."""
    over, asked = {"dynamics.timestep": [0.002]}, {"seeds": 1, "steps": 20, "measure": "energy"}
    name, changes = "argon/crystal-108", {"cutoff.radius": 1.7}
    with ThreadPoolExecutor(1) as pool:
        first = mdnum.sweep(name, over, overrides=changes, on=pool, out=tmp_path / "a", **asked)
        second = mdnum.sweep(mdnum.load(name, changes), over, on=pool, out=tmp_path / "b", **asked)
    assert first.summary["computed"] == 2 and not second.summary["failed"]
    values = [one.table("points").to_pandas().value.tolist() for one in (first, second)]
    assert values[0] == values[1] and np.isfinite(values[0]).all()


def test_a_ball_is_swept_without_seeds(tmp_path):
    """Against the closed form: without a contact, semi-implicit Euler lags g h t / 2 behind the parabola."""
    ball = mdnum.load("ball/drop", {"variants": {}})
    with ThreadPoolExecutor(1) as pool:
        made = mdnum.sweep(
            ball, ["integrator.timestep=0.0005,0.001,0.002", "precision"], seeds=3, steps=400, on=pool,
            tolerance={"final_height": 0.0015}, out=tmp_path / "one",
        )  # fmt: skip
    assert made.summary["points"] == 4 and not made.summary["failed"]
    heights = {tuple(one["setting"]): one["value"] for one in made.summary["estimates"]
               if one["measure"] == "final_height"}  # fmt: skip
    for h in (0.0005, 0.001, 0.002):
        expected = 1 - 9.81 * 0.4**2 / 2 - 9.81 * h * 0.4 / 2
        assert heights[f"{h:g}", "float64"] == pytest.approx(expected, abs=1e-12)
    advice = {one["choice"]: one["best"] for one in made.summary["advice"]}
    assert advice == {"integrator.timestep": 0.001, "precision": "float32"}
    moved = {row["measure"] for row in made.summary["differences"] if row["moves"] == "yes"}
    assert moved == {"final_height", "energy_kept"}


@pytest.mark.parametrize(("tolerance", "inside"), [(0.0015, True), (0.00125, False)])
def test_recommended_values_are_run_together(tolerance, inside, tmp_path):
    """The lag of semi-implicit Euler, g h t / 2, adds up with what another gravity changes, t² / 2 of it."""
    ball = mdnum.load("ball/drop", {"variants": {}, "integrator.timestep": 0.0005})
    with ThreadPoolExecutor(1) as pool:
        made = mdnum.sweep(
            ball, ["integrator.timestep=0.001", "flight.gravity=9.815"], steps=800, on=pool,
            tolerance={"final_height": tolerance}, converged={"flight.gravity": "9.81"}, out=tmp_path / "one",
        )  # fmt: skip
    joint = made.summary["joint"]
    assert joint["setting"] == ["0.001", "9.815"] and joint["end"] == ["0.0005", "9.81"]
    assert joint["inside"] is inside and made.summary["points"] == 4
    assert ("JOINT_OUTSIDE" in [one.code for one in made.findings]) is not inside


@pytest.mark.nightly
def test_a_sweep_that_control_c_stopped_goes_on(tmp_path):
    """Nothing is computed twice, and the claim of the point that was stopped is gone."""
    options = [
        "--over", "dynamics.timestep=0.002,0.003,0.004,0.006", "--seeds", "4", "--steps", "4000",
        "--measure", "energy", "--workers", "1", "--points-in", str(tmp_path / "points"),
    ]  # fmt: skip
    command = [sys.executable, "-m", "mdnum", "sweep", "argon/crystal-108", *options, "--out"]
    stored, claims = tmp_path / "points" / "workspace", tmp_path / "points" / "claims"
    # as from a terminal, whatever this process does with the signal
    first = subprocess.Popen(
        [*command, str(tmp_path / "one")], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    while not (len([*stored.glob("*/point.json")]) >= 2 and [*claims.glob("*")]):
        assert first.poll() is None
        sleep(0.02)
    first.send_signal(signal.SIGINT)
    _, told = first.communicate(timeout=60)
    assert first.returncode in (130, -signal.SIGINT)
    assert TEXTS.entries["command"]["again"] in " ".join(told.split())
    before = {file: file.stat().st_mtime_ns for file in stored.glob("*/point.json")}
    assert 2 <= len(before) < 16 and not [claim for claim in claims.glob("*") if not gone(claim)]
    subprocess.run([*command, str(tmp_path / "two")], check=True, capture_output=True)
    summary = json.loads((tmp_path / "two" / "summary.json").read_text())
    assert summary["found"] == len(before) and summary["computed"] == 16 - len(before)
    after = {file: file.stat().st_mtime_ns for file in stored.glob("*/point.json")}
    assert len(after) == 16 and before.items() <= after.items() and not [*claims.glob("*")]
    assert not [*stored.glob(".*")]


def test_what_cannot_be_swept_is_refused(simulation):
    refused: Any = (
        ({"cutoff.radios": [1.0]}, {}), ({}, {}), ({"neighbors.skin": [0.1]}, {"measure": "enthalpy"}),
        ({"neighbors.skin": [0.1]}, {"measure": "energy,gradient=potental/sigma"}),
        ({"neighbors.skin": [0.1]}, {"measure": "horizon=potential/sygma"}),
        ({"neighbors.skin": [0.1]}, {"measure": "fork=ordre"}),
        ({"neighbors.skin": [0.1]}, {"on": "nowhere"}), ({"neighbors.skin": [0.1]}, {"seeds": []}),
    )  # fmt: skip
    for over, more in refused:
        with pytest.raises(InputError):
            mdnum.sweep(simulation, over, **more)


@pytest.mark.nightly
def test_a_function_of_a_file_measures_an_outcome(simulation, tmp_path):
    """What it returns is stored with the digest of its file, and measured again when the file is another."""
    file, over = tmp_path / "mine.py", {"dynamics.timestep": [0.004]}
    asked: Any = {"seeds": 1, "steps": 60, "measure": f"energy,{file}:last", "allow_code": True}
    values = []
    for factor in (1, 2, 2):
        text = f"{factor} * float(outcome.table('series')['potential'][-1].as_py()), 0.25"
        file.write_text(f"def last(outcome):\n    return {text}\n")
        with ThreadPoolExecutor(1) as pool:
            made = mdnum.sweep(
                simulation, over, on=pool, out=tmp_path / f"out-{len(values)}", save_every=60, **asked
            )
        (one,) = (row for row in made.summary["estimates"] if row["measure"] != "energy")
        values.append((one["value"], one["error"], made.summary["computed"]))
    own = mdnum.run(
        mdnum.changed(simulation, {"dynamics.seed": 0}), steps=60, out=tmp_path / "run", check=False
    )
    last = own.table("series")["potential"][-1].as_py()
    assert values == [(last, 0.25, 1), (2 * last, 0.25, 1), (2 * last, 0.25, 0)]


@pytest.mark.nightly
def test_forks_and_gradients_are_measures(simulation, tmp_path):
    """Against `fork` and `grad` themselves."""
    forks = ["fork=precision", "split=precision", "separation=precision"]
    slope, horizon = "gradient=potential/sigma", "horizon=potential/sigma"
    with ThreadPoolExecutor(1) as pool:
        made = mdnum.sweep(
            simulation, {"cutoff.radius": [1.9]}, seeds=[3], steps=400, on=pool, out=tmp_path / "sweep",
            measure=",".join(["energy", *forks, slope, horizon]),
        )  # fmt: skip
    assert not made.summary["failed"]
    own = mdnum.changed(simulation, {"dynamics.seed": 3})
    found = {row["measure"]: row["value"] for row in made.summary["estimates"] if row["setting"] == ["2"]}
    missing = {row["measure"] for row in made.summary["missing"] if row["setting"] == "2"}
    assert missing.isdisjoint(found) and {"energy", *forks, slope, horizon} == missing | {*found}

    pair = mdnum.fork(
        own, "precision", steps=400, out=tmp_path / "fork", counterfactual=False, repeats=0
    ).result
    fork, split, separation = forks
    assert found[fork] == pytest.approx(0.004 * pair.dates.fork)
    assert (split in missing) is (pair.dates.split is None)
    assert found[separation] == pytest.approx(pair.growth["B"].rate / 0.004)

    grad = mdnum.grad(own, "potential", "sigma", steps=400, out=tmp_path / "grad").result
    (expected,) = grad.agreement.gradient(grad.agreement.reference).gradient.values()
    assert found[slope] == pytest.approx(float(expected), rel=1e-9)
    limited = grad.trust.verdict == "limited"
    assert (horizon in found) is limited
    if limited:
        assert found[horizon] == pytest.approx(0.004 * grad.trust.horizon)


def test_names_with_arguments():
    (one,) = chosen(["fork=order=3"], "md")
    assert one.name == "fork=order=3" and one.unit == "time" and len(one.digest) == 16
    for word in ("energy=3", "forks"):
        with pytest.raises(InputError):
            chosen([word], "md")
