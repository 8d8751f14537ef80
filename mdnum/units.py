"""Unit systems: conversion between the units of user input and consistent internal units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

from mdnum.errors import InputError

# CODATA 2014 as ase.units uses it, written out so that reading a system file need not import ase.
# tests/test_units.py holds them to ase.units.
_PICOSECOND = 98.22694788464064
_GPA_PER_EV_PER_A3 = 160.21766208
_BOLTZMANN_EV_PER_K = 8.617330337217213e-05


@dataclass(frozen=True)
class Units:
    """Unit labels and conversion factors of a unit system.

    Internally, lengths, energies and masses have the units of the system file. The unit of time is length *
    sqrt(mass / energy). With this unit, acceleration = force / mass.

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

_QUANTITIES = re.compile("length|energy|mass|time|temperature|pressure|decision|loss|parameter")
#: Placeholders in texts, which are replaced by the names of units when the text is written.
ENERGY, LENGTH = "{units.energy}", "{units.length}"
FORCE = f"{ENERGY}/{LENGTH}"


def named(quantity: str, units: Mapping[str, Any]) -> str:
    """Replace quantities ("energy/length") by units ("eV/Å"). Return "" if a name is missing.

    A text without names of quantities, such as "kcal/mol", is returned unchanged.

    >>> named("energy/length", {"energy": "eV", "length": "Å"})
    'eV/Å'
    """
    names = {word: str(units.get(word) or "") for word in _QUANTITIES.findall(quantity)}
    return _QUANTITIES.sub(lambda word: names[word[0]], quantity) if all(names.values()) else ""


@dataclass(frozen=True)
class Measured:
    """A measured number with its unit, its noise level and a reference value."""

    value: float
    unit: str = ""  # of names ("eV/Å") or, until it is written, of quantities ("energy/length")
    floor: float | None = None  # the largest that noise or rounding explains: less is not told from nothing
    scale: float | None = None  # what it is compared with, such as a typical force

    @property
    def found(self) -> bool:
        """True if the magnitude exceeds the noise level, or the number is NaN."""
        return self.floor is None or not abs(self.value) <= self.floor

    @property
    def digits(self) -> str:
        """The number as text, with the digits that are significant at its noise level."""
        if self.floor is None or self.floor < 1e-12:
            return repr(float(self.value))
        return f"{self.value:.{min(max(math.ceil(-math.log10(self.floor)), 1), 15)}f}"

    def to(self, prefix: str, units: Mapping[str, Any] = MappingProxyType({})) -> Measured:
        """Convert the number to a unit with a prefix ("m" for milli). `units` names the units."""
        unit = named(self.unit, units) or self.unit
        size = {"": 1.0, "m": 1e3}[prefix]
        scaled = {name: size * part for name, part in vars(self).items() if isinstance(part, float)}
        return replace(self, unit=prefix + unit, **scaled)


def revived(value: Any) -> Any:
    """Restore a `Measured` from a JSON dictionary. Return other values unchanged."""
    names = {each.name for each in fields(Measured)}
    return Measured(**value) if isinstance(value, dict) and value.keys() == names else value


_ALL = {units.name: units for units in (METAL, LJ, BALL)}


def get(name: str) -> Units:
    """Return the unit system with a given name ("metal", "lj" or "ball").

    Raises:
        InputError: there is no unit system with this name.
    """
    try:
        return _ALL[name]
    except KeyError:
        raise InputError(
            f"unknown units {name!r}; known unit systems are {', '.join(_ALL)}",
            remedy="Choose metal for Å, eV, amu and ps, lj for reduced units, or ball for m and s",
        ) from None
