"""Units: mdnum's numbers are ase's, to the bit where time is concerned."""

from __future__ import annotations

import ase.units
import pytest

from mdnum import units
from mdnum.errors import InputError


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
