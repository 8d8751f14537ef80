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

#: Displacements over velocities times time where a file has one of them in another unit than it is read in.
ODD_UNITS = (
    (10.0, "nm/ps for Å/ps"),
    (20.4548, "Å in AMBER’s unit of time (1/20.455 ps) for Å/ps"),
    (98.22695, "ASE’s √(eV/amu) for Å/ps"),
    (1e3, "Å/fs for Å/ps"),
    (1e4, "nm/fs for Å/ps"),
    (21876.9, "velocities in atomic units for Å/ps"),
    (1.889726, "positions in Bohr for Å"),
    (0.1, "positions in nm for Å, or Å/ps for nm/ps"),
    (0.01, "m/s for Å/ps"),
    (1e-3, "times in fs for ps, or Å/ps for Å/fs"),
    (1 / 20.4548, "times in AKMA units (48.9 fs) for ps, or AMBER’s 20.455 applied twice"),
    (1 / 98.22695, "times in ASE’s unit (10.18 fs) for ps"),
    (1 / 41341.37, "times in atomic units (0.0242 fs) for ps"),
)


def odd_units(factor: float) -> list[str]:
    """The units that explain a factor between displacements and velocities times time, within 5 %."""
    return [words for known, words in ODD_UNITS if abs(factor / known - 1) < 0.05]


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
