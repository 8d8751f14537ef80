"""Structures whose velocities are not those that a system requests: another temperature, another column."""

from __future__ import annotations

import json
from pathlib import Path

import ase.build
import ase.io
import numpy as np
import pytest
from command_line import call

import mdnum
from mdnum import systems
from mdnum.verbs.check import structure_findings, temperature_findings

SYSTEM = """
units = "{units}"
[structure]
file = "s.extxyz"
velocities = "{velocities}"
[potential]
kind = "lennard-jones"
sigma = {sigma}
epsilon = {epsilon}
[cutoff]
kind = "hard"
radius = {radius}
[neighbors]
skin = 0.3
[dynamics]
kind = "{kind}"
timestep = 0.002
steps = 3
temperature = {temperature}
{friction}
"""


def made(
    folder: Path, *, units: str = "metal", kind: str = "nve", temperature: float = 94.4,
    actual: float | None = None, column: str = "momenta", velocities: str = "file", cells: int = 3,
) -> Path:  # fmt: skip
    """A system of argon whose structure has velocities of a temperature."""
    metal = units == "metal"
    edge = 5.4 if metal else 1.6
    atoms = ase.build.bulk("Ar", "fcc", a=edge, cubic=True) * (cells, cells, cells)
    if not metal:
        atoms.set_masses(np.ones(len(atoms)))
    if actual is not None:
        kT = actual * (8.617330337217213e-05 if metal else 1.0)
        noise = np.random.default_rng(3).standard_normal((len(atoms), 3))
        noise *= np.sqrt(3 * len(atoms) / (noise**2).sum())
        atoms.arrays[column] = noise * np.sqrt(kT * atoms.get_masses())[:, None]
    ase.io.write(
        folder / "s.extxyz", atoms, columns=["symbols", "positions", *([column] * (actual is not None))]
    )
    values = (
        {"sigma": 3.4, "epsilon": 0.0103, "radius": 7.0}
        if metal
        else {"sigma": 1.0, "epsilon": 1.0, "radius": 2.0}
    )
    (folder / "s.toml").write_text(SYSTEM.format(
        units=units, kind=kind, temperature=temperature, velocities=velocities,
        friction="friction = 1.0" if kind == "langevin" else "", **values,
    ))  # fmt: skip
    return folder / "s.toml"


@pytest.mark.parametrize(("units", "requested"), [("metal", 94.4), ("lj", 1.5)])
@pytest.mark.parametrize("kind", ["nve", "langevin"])
@pytest.mark.parametrize(
    ("ratio", "odd"), [(0.0068, True), (0.2, True), (0.5, False), (1.0, False), (2.0, False), (418.0, True)]
)
def test_another_temperature_is_a_warning(
    tmp_path: Path, units: str, requested: float, kind: str, ratio: float, odd: bool
):
    path = made(tmp_path, units=units, temperature=requested, kind=kind, actual=ratio * requested)
    found = list(structure_findings(systems.load(path)))
    assert [one.code for one in found] == ["OTHER_TEMPERATURE"] * odd
    if odd:
        assert found[0].severity == "warning"
        assert found[0].values["start"] == pytest.approx(ratio * requested, rel=0.02)
        assert found[0].values["factor"] == pytest.approx(ratio**-0.5, rel=0.02)


def test_what_was_not_requested_or_is_chance_is_none(tmp_path: Path) -> None:
    # no temperature, drawn velocities, no velocities at all, and few atoms
    for options in ({"temperature": 0.0, "actual": 50.0}, {"velocities": "drawn", "actual": 1.0}, {}):
        assert not list(structure_findings(systems.load(made(tmp_path, **options))))
    assert not list(temperature_findings(5.0, 1.0, 1, "K")) and list(temperature_findings(5.0, 1.0, 100, "K"))
    # at rest
    (zero,) = temperature_findings(0.0, 94.4, 100, "K")
    assert "times as large" not in zero.text


@pytest.mark.parametrize(("units", "limit"), [("metal", 0.1 * 3.4 / 1.4), ("lj", 0.1 * 1.01)])
def test_a_time_step_in_which_atoms_fly_too_far_is_a_warning(
    tmp_path: Path, units: str, limit: float
) -> None:
    """Argon at 94.4 K, 1.4 Å/ps along an axis and 3.4 Å apart; at a temperature of one, 1 σ/τ and 1.01 σ."""
    path = made(tmp_path, units=units, temperature=94.4 if units == "metal" else 1.0)
    for factor, odd in ((0.7, False), (1.4, True)):
        found = structure_findings(systems.load(path, {"dynamics.timestep": str(factor * limit)}))
        assert [one.code for one in found] == ["TIME_STEP_LONG"] * odd
    for name in systems.names("md") if units == "lj" else ():
        assert "TIME_STEP_LONG" not in [one.code for one in structure_findings(systems.load(name))]


@pytest.mark.parametrize("column", ["velo", "vel", "velocities", "Velocity"])
def test_velocities_of_another_name_are_said_to_be_ignored(tmp_path: Path, column: str) -> None:
    path = made(tmp_path, actual=94.4, column=column)
    (found,) = structure_findings(systems.load(path))
    assert found.code == "VELOCITIES_IGNORED" and column in found.title
    assert not list(
        structure_findings(systems.load(made(tmp_path, actual=94.4, column=column, velocities="drawn")))
    )


@pytest.mark.parametrize("unit", ["metal", "lj"])
def test_an_atom_out_of_the_world_is_a_warning(tmp_path: Path, unit: str, capsys) -> None:
    path = made(tmp_path, units=unit)
    assert call("systems", "check", str(path)) == 0
    for far, odd in ((2**31 / 100, True), (-(2**31) / 100, True), (500.0, False)):
        atoms = ase.io.read(tmp_path / "s.extxyz")
        # to an image of its own, which overlaps with nothing
        atoms.positions[7, 1] += round(far / atoms.cell[1, 1]) * atoms.cell[1, 1]
        ase.io.write(tmp_path / "s.extxyz", atoms)
        capsys.readouterr()
        assert call("systems", "check", str(path)) == odd
        text = capsys.readouterr().out
        assert ("atom 7 is" in text) == odd and ("fine" in text) != odd
        made(tmp_path, units=unit)


@pytest.mark.slow
def test_the_command_line_and_a_run_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = made(tmp_path, actual=0.64)
    code = call("systems", "check", str(path))
    text = capsys.readouterr().out
    assert code == 1
    assert "0.639 K" in text and " 94.40 K " in text and "fine" not in text
    code = call("systems", "check", str(path), "--json")
    text = capsys.readouterr().out
    document = json.loads(text)
    assert code == 1
    assert document["ok"] and [one["code"] for one in document["findings"]] == ["OTHER_TEMPERATURE"]
    ran = mdnum.run(path, out=tmp_path / "run", report=False, check=False)
    assert "OTHER_TEMPERATURE" in {one.code for one in ran.verdict.findings}
    fine = made(tmp_path, actual=94.4)
    code = call("systems", "check", str(fine))
    text = capsys.readouterr().out
    assert code == 0 and "fine" in text
