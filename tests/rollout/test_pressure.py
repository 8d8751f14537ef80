"""The pressure in parts, and what a cutoff leaves out of it, from frames in numpy."""

from __future__ import annotations

from typing import Any

import ase.io
import numpy as np
import pytest
from rollout.harness import liquid, run
from rollout.test_constant_pressure import pressed

import mdnum
from mdnum.rollout.adequacy import beyond_cutoff
from mdnum.store import RunFolder

CORE, TAIL, WEIGHT = 2.0, 2.3, 0.5


def two_terms(**options: Any):
    terms = {
        "core": mdnum.Term(mdnum.LennardJones(1.0, 1.0), mdnum.Cut("hard", CORE)),
        "tail": mdnum.Term(
            mdnum.Morse(depth=0.4, alpha=1.0, r0=2.0), mdnum.Cut("hard", TAIL), weight={"Ar": WEIGHT}
        ),
    }
    given = {"units": "lj", "timestep": 0.004, "temperature": 1.0, "skin": 0.2, "seed": 3} | options
    return mdnum.simulation(liquid(), terms, **given)


def core(r):
    return 4 * (r**-12 - r**-6), 24 * (2 * r**-12 - r**-6)  # energy, r times the force


def tail(r):
    e = np.exp(-(r - 2.0))
    return WEIGHT**2 * 0.4 * (e * e - 2 * e), WEIGHT**2 * 0.4 * 2 * (e * e - e) * r


def test_parts_are_those_of_frames(tmp_path):
    summary = run(two_terms(), steps=100, save_every=1, out=tmp_path / "run").summary
    parts, folder = summary["pressure"], RunFolder.open(tmp_path / "run")
    frames: Any = ase.io.read(tmp_path / "run" / "trajectory.traj", index=":")
    steps = folder.read("ranges")["step"][1:]
    found: dict[str, list[float]] = {name: [] for name in ("core", "tail", "impulsive", "across")}
    for atoms in (frames[step] for step in steps):
        volume, r = atoms.get_volume(), atoms.get_all_distances(mic=True)[np.triu_indices(108, 1)]
        impulsive = across = 0.0
        for name, term, r_cut in (("core", core, CORE), ("tail", tail, TAIL)):
            found[name].append(term(r[r < r_cut])[1].sum() / (3 * volume))
            width, jump = 0.02 * r_cut, term(np.array(r_cut))[0] * r_cut / (3 * volume)
            one, two = (((r_cut - r) // width == k).sum() for k in (0, 1))
            impulsive += (1.5 * one - 0.5 * two) / width * jump
            across += (np.abs(r - r_cut) < 0.1).sum() / 0.2 * jump
        found["impulsive"].append(impulsive)
        found["across"].append(across)
    assert parts["samples"] == len(steps) >= 15 and set(parts["terms"]) == {"core", "tail"}
    series, count = folder.read("series"), len(steps)
    kinetic = 2 * series["kinetic"][steps] / (3 * frames[0].get_volume())
    virial = np.add(found["core"], found["tail"])
    for made, values in (
        (parts["kinetic"], kinetic), (parts["virial"], virial), (parts["total"], series["pressure"][steps]),
        (parts["terms"]["core"], found["core"]), (parts["terms"]["tail"], found["tail"]),
        (parts["impulsive"], found["impulsive"]),
    ):  # fmt: skip
        assert made["mean"] == pytest.approx(np.mean(values), rel=1e-9)
        assert made["error"] == pytest.approx(np.std(values, ddof=1) / count**0.5, rel=1e-7)
    # pairs on both sides of the cutoff tell the same
    error = np.hypot(parts["impulsive"]["error"], np.std(found["across"]) / count**0.5)
    assert (
        abs(parts["impulsive"]["mean"] - np.mean(found["across"]))
        < 5 * error
        < 0.5 * abs(np.mean(found["across"]))
    )


def test_the_tail_is_that_of_the_mean_volume(tmp_path):
    simulation = pressed("mtk", "isotropic")
    made = run(simulation, steps=60, out=tmp_path / "run").summary
    parts, folder = made["pressure"], RunFolder.open(tmp_path / "run")
    volume = np.mean(folder.read("series")["volume"][folder.read("ranges")["step"][1:]])
    density, cubed = 108 / volume, 2.0**-3
    energy = 8 / 3 * np.pi * density * (cubed**3 / 3 - cubed)
    pressure = 16 / 3 * np.pi * density**2 * (2 * cubed**3 / 3 - cubed)
    assert parts["tail"] == pytest.approx({"energy": energy, "pressure": pressure}, rel=1e-9)
    assert made["beyond_cutoff"] == parts["tail"] != beyond_cutoff(simulation)
    assert parts["impulsive"]["mean"] < -5 * parts["impulsive"]["error"] and parts["terms"] == {}


def test_a_run_without_a_volume_has_no_pressure(tmp_path):
    atoms = liquid()
    atoms.pbc = (True, True, False)
    simulation = mdnum.simulation(
        atoms, mdnum.LennardJones(1.0, 1.0), mdnum.Cut("switched", 2.0), units="lj", timestep=0.002, skin=0.2
    )
    assert run(simulation, steps=3, out=tmp_path / "run").summary["pressure"] is None
