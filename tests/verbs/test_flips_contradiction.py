"""Files that contradict themselves: displacements against velocities and times, steps, ignored columns."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any

import ase
import MDAnalysis
import numpy as np
import pytest
from ase.io import write

import mdnum
from mdnum.units import METAL
from mdnum.verbs.flips_shared import TEXTS
from mdnum.verbs.frame import Outcome


def nightly(*values: Any) -> Any:
    """A case that the gate leaves out."""
    return pytest.param(*values, marks=pytest.mark.nightly)


def vibrating(
    frames: int = 20,
    dt: float = 0.02,
    omega: float = 2.0,
    drift: float = 3.0,
    atoms: int = 40,
    side: float = 14.0,
    seed: int = 0,
    pbc: Any = True,
    element: str = "Ar",
) -> list[ase.Atoms]:
    """Atoms that vibrate about places that drift, with the velocities of just that motion, Å/ps."""
    rng = np.random.default_rng(seed)
    start, v = rng.uniform(0, side, (atoms, 3)), rng.normal(0, drift, (atoms, 3))
    each = omega * rng.uniform(0.7, 1.3, (atoms, 3))
    phase, size = rng.uniform(0, 6.3, (atoms, 3)), 3.0 / each
    found = []
    for n in range(frames):
        t = n * dt
        one = ase.Atoms(
            f"{element}{atoms}", start + v * t + size * np.sin(each * t + phase), cell=[side] * 3, pbc=pbc,
            info={"time": t},
        )  # fmt: skip
        one.wrap()
        one.set_velocities((v + size * each * np.cos(each * t + phase)) / METAL.time_factor)
        found.append(one)
    return found


def told(tmp_path: Path, frames: list[ase.Atoms], name: str = "a.traj", **options: Any) -> Outcome:
    write(tmp_path / name, frames)
    out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
    return mdnum.flips(tmp_path / name, **{"cutoffs": [4.0], "report": False, "out": out, **options})


def finding(found: Outcome, code: str) -> Any:
    return next((one for one in found.verdict.findings if one.code == code), None)


def scaled(frames: list[ase.Atoms], *, velocities: float = 1.0, times: float = 1.0, lengths: float = 1.0):
    for one in frames:
        one.set_momenta(one.get_momenta() * velocities)
        one.info["time"] *= times
        one.set_cell(one.cell * lengths, scale_atoms=True)
    return frames


CASES = [
    ({"velocities": 0.1}, 10.0, "nm/ps"),
    ({"velocities": 10.0}, 0.1, "nm"),
    ({"times": 1000.0}, 1e-3, "fs"),
    ({"velocities": 1e-3}, 1e3, "Å/fs"),
    ({"lengths": 0.1}, 0.1, "nm"),
    ({"velocities": 1 / 20.4548}, 20.4548, "AMBER"),
    ({"velocities": 20.4548}, 1 / 20.4548, "AMBER"),
    ({"velocities": 1 / METAL.time_factor}, METAL.time_factor, "ASE"),
    ({"velocities": 0.2}, 5.0, ""),
    ({"times": 3.0}, 1 / 3, ""),
]


@pytest.mark.parametrize(("change", "factor", "unit"), CASES)
@pytest.mark.parametrize(
    ("pbc", "element", "atoms"), [(True, "Ar", 40), (False, "H", 3), nightly((True, True, False), "Au", 200)]
)
def test_another_unit_is_found_in_both_directions(
    tmp_path: Path, change: dict[str, float], factor: float, unit: str, pbc: Any, element: str, atoms: int
) -> None:
    frames = scaled(vibrating(pbc=pbc, element=element, atoms=atoms), **change)
    found = told(tmp_path, frames, cutoffs=[4.0 * change.get("lengths", 1.0)])
    said = finding(found, "VELOCITIES_ODD")
    assert said.severity == "warning" and not found.summary["flight"]["at_least"]
    assert found.summary["flight"]["factor"] == pytest.approx(factor, rel=0.05)
    assert unit in said.text and bool(said.values["units"]) == bool(unit)
    assert all(one["flux"] is None for one in found.summary["rules"])


@pytest.mark.parametrize("dt", [nightly(0.002), 0.02, nightly(0.1), 0.5, nightly(3.0), 40.0])
@pytest.mark.parametrize("drift", [nightly(0.0), 0.3, nightly(3.0)])
@pytest.mark.parametrize("omega", [2.0, 30.0])
def test_a_right_file_is_not_accused_at_any_stride(
    tmp_path: Path, dt: float, drift: float, omega: float
) -> None:
    frames = vibrating(dt=dt, drift=drift, omega=omega, side=400.0)
    assert finding(told(tmp_path, frames), "VELOCITIES_ODD") is None
    # nor one that was centered at each frame, or whose digits are few
    for one in frames:
        one.positions -= one.get_center_of_mass()
        one.positions = np.round(one.positions, 2)
    assert finding(told(tmp_path, frames), "VELOCITIES_ODD") is None


def test_frames_far_apart_bound_the_factor_from_one_side(tmp_path: Path) -> None:
    # velocities turn in between, and atoms get further than any flight takes them
    frames = scaled(vibrating(dt=2.0, side=4000.0, drift=0.5), velocities=1e-3)
    found = told(tmp_path, frames)
    flight = found.summary["flight"]
    assert flight["at_least"] and 100 < flight["factor"] < 1000
    assert "even larger" in finding(found, "VELOCITIES_ODD").text


def test_known_factors_are_told_apart() -> None:
    known = TEXTS.entries["odd_units"]
    factors = np.log(np.array(list(known.values())))
    apart = np.abs(factors[:, None] - factors) + np.eye(len(factors))
    # m/s and ASE's unit of time lie closer than a file tells: both are named
    assert np.sort(apart.ravel())[2] > 0.1 and np.abs(factors).min() > 0.1


def dcd(path: Path, step: float) -> None:
    universe = MDAnalysis.Universe.empty(20, trajectory=True)
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with MDAnalysis.Writer(str(path), 20, dt=step) as writer:
            for _ in range(6):
                universe.atoms.positions = rng.uniform(0, 10, (20, 3))
                universe.dimensions = [10, 10, 10, 90, 90, 90]
                writer.write(universe.atoms)
    write(path.with_suffix(".pdb"), ase.Atoms("Ar20", np.eye(20, 3)))


@pytest.mark.parametrize("step", [0.002, 0.5, 100.0])
def test_a_time_step_with_swapped_bytes(tmp_path: Path, step: float) -> None:
    path = tmp_path / "a.dcd"
    dcd(path, step)
    right = mdnum.flips(
        path, topology=path.with_suffix(".pdb"), cutoffs=[3.0], report=False, out=tmp_path / "right"
    )
    assert finding(right, "TIMES_ODD") is None and right.summary["timed"]
    data = bytearray(path.read_bytes())
    data[44:48] = data[44:48][::-1]
    path.write_bytes(data)
    found = mdnum.flips(
        path, topology=path.with_suffix(".pdb"), cutoffs=[3.0], report=False, out=tmp_path / "odd"
    )
    said = finding(found, "TIMES_ODD")
    assert said is not None and said.severity == "warning"
    assert said.values["swapped"] == pytest.approx(step, rel=1e-5)
    assert not found.summary["timed"]


@pytest.mark.parametrize(("times", "odd"), [(1e-12, True), (1e14, True), (1e-3, False), (1e6, False)])
def test_times_that_no_simulation_has(tmp_path: Path, times: float, odd: bool) -> None:
    frames = vibrating()
    for n, one in enumerate(frames):
        one.info["time"] = n * times
        del one.arrays["momenta"]
    found = told(tmp_path, frames)
    assert (finding(found, "TIMES_ODD") is not None) == odd and found.summary["timed"] != odd
    assert struct.calcsize("f") == 4 and found.summary["swapped"] is None


@pytest.mark.parametrize(
    "name",
    ["velo", *map(nightly, ["vel", "velocities", "velocity"]), "v", "Velocities", nightly("momentum"), "mom"],
)
def test_a_velocity_column_of_another_name_is_said_to_be_ignored(tmp_path: Path, name: str) -> None:
    frames = vibrating()
    for one in frames:
        one.arrays[name] = one.arrays.pop("momenta")
    found = told(tmp_path, frames, "a.extxyz")
    said = finding(found, "READING")
    assert said is not None and f"“{name}”" in said.text and "not read" in said.text
    # what is no velocity is not taken for one
    for one in frames:
        one.arrays["forces2"] = one.arrays.pop(name)
    other = finding(told(tmp_path, frames, "b.extxyz"), "READING")
    assert other is None or "not read" not in other.text


def test_frames_without_times_contradict_no_velocities(tmp_path: Path):
    frames = vibrating()
    for one in frames:
        one.info.pop("time")
    # as ASE's dynamics writes them
    write(tmp_path / "run.traj", frames)
    found = mdnum.flips(tmp_path / "run.traj", cutoffs=4.0, report=False, out=tmp_path / "found")
    assert {one.code for one in found.verdict.findings} & {"NO_TIMES", "VELOCITIES_ODD"} == {"NO_TIMES"}
