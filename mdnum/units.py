"""Unit systems: what a person reads and writes, against the ASE-consistent numbers used inside."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.errors import InputError

# CODATA 2014 as ase.units uses it, written out so that reading a system file need not import ase.
# tests/test_units.py holds them to ase.units.
_PICOSECOND = 98.22694788464064
_GPA_PER_EV_PER_A3 = 160.21766208
_BOLTZMANN_EV_PER_K = 8.617330337217213e-05


@dataclass(frozen=True)
class Units:
    """Labels and factors of a unit system.

    Inside mdnum lengths, energies and masses are those of the system file and time is
    length * sqrt(mass / energy), so that acceleration is force / mass without a factor.

    Attributes:
        time_factor: user time * time_factor = internal time.
        pressure_factor: internal energy/length^3 * pressure_factor = user pressure.
        k_B: Boltzmann's constant, energy per temperature.
    """

    name: str
    length: str
    energy: str
    mass: str
    time: str
    temperature: str
    pressure: str
    time_factor: float
    pressure_factor: float
    k_B: float


METAL = Units(
    "metal", "Å", "eV", "amu", "ps", "K", "GPa", _PICOSECOND, _GPA_PER_EV_PER_A3, _BOLTZMANN_EV_PER_K
)
LJ = Units("lj", "σ", "ε", "m", "τ", "ε/k", "ε/σ³", 1.0, 1.0, 1.0)
# energies are per mass; a ball has no temperature
BALL = Units("ball", "m", "m²/s²", "", "s", "", "", 1.0, 1.0, 1.0)

_ALL = {units.name: units for units in (METAL, LJ, BALL)}


def get(name: str) -> Units:
    """The unit system called name ("metal", "lj" or "ball").

    Raises:
        InputError: no such unit system.
    """
    try:
        return _ALL[name]
    except KeyError:
        raise InputError(
            f"unknown units {name!r}; known are {', '.join(_ALL)}",
            remedy="metal means Å, eV, amu and ps; lj means reduced units; ball means m and s",
        ) from None
