"""Units: mdnum's numbers are ase's, to the bit where time is concerned."""

from __future__ import annotations

import json
import math
import pickle

import ase.units
import pytest

from mdnum import units
from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.finding import fill


def test_metal_is_ase_and_reduced_units_are_all_one():
    metal, lj = units.get("metal"), units.get("lj")
    assert metal.time_factor == 1000 * ase.units.fs and metal.k_B == ase.units.kB
    assert metal.pressure_factor == pytest.approx(1 / ase.units.GPa, rel=1e-15)
    # 1 eV/Å on 1 amu for 1 ps moves it by a t²/2
    a = ase.units._e / 1e-10 / ase.units._amu
    assert 0.5 * metal.time_factor**2 == pytest.approx(0.5 * a * 1e-24 / 1e-10, rel=1e-12)
    assert lj.time_factor == lj.pressure_factor == lj.k_B == 1.0
    with pytest.raises(InputError, match=r"units 'real'; .* metal, lj"):
        units.get("real")


def test_a_measured_number_is_plain_data():
    one = units.Measured(0.0125, "energy/length", 1e-6, 0.5)
    assert pickle.loads(pickle.dumps(one)) == one
    assert units.revived(json.loads(json.dumps(plain(one)))) == one
    # what only looks like one is left alone, and so is a number
    assert units.revived({"value": 1.0}) == {"value": 1.0} and units.revived(1.0) == 1.0
    assert one.found and not units.Measured(1e-7, "eV", 1e-6).found and units.Measured(0.0).found
    assert units.Measured(math.nan, "eV", 1e-6).found


@pytest.mark.parametrize(("system", "unit"), [("metal", "eV/Å"), ("lj", "ε/σ")])
def test_a_measured_number_converts_its_unit_and_what_it_is_compared_with(system, unit):
    given = vars(units.get(system))
    one = units.Measured(0.0125, "energy/length", 1e-6).to("m", given)
    assert (one.value, one.unit, one.floor, one.scale) == (12.5, f"m{unit}", pytest.approx(1e-3), None)
    assert one.to("", given) == one
    # a unit that has its name keeps it
    assert units.Measured(1.0, "amu").to("", given).unit == "amu"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{x:3}", "0.0125 eV/Å"), ("{x:3m}", "12.5 meV/Å"), ("{x:+2}", "+0.013 eV/Å"), ("{x}", "0.0125 eV/Å"),
        ("{x:=}", "0.012500 eV/Å"), ("{exact:=}", "0.1 eV"), ("{x.floor:1}", "2 × 10⁻⁶"),
        ("{x.scale:2} {units.energy}", "0.50 eV"),
        ("{none:3}", "– eV/Å"),
    ],
)  # fmt: skip
def test_sentences_write_a_number_with_its_unit(text, expected):
    values: dict[str, object] = {
        "x": units.Measured(0.0125, "eV/Å", 2e-6, 0.5),
        "exact": units.Measured(0.1, "eV", 0.0),
        "none": units.Measured(math.nan, "eV/Å"),
    }  # fmt: skip
    values["units"] = units.METAL
    assert fill(text, values).replace("\u00a0", " ") == expected
