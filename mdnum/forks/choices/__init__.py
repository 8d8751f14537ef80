"""What can be varied, one numerical choice at a time, of either world."""

from __future__ import annotations

from mdnum.forks.choices.arithmetic import PrecisionChoice, Stopping, Summation
from mdnum.forks.choices.base import CHOICES, Choice, parse, shipped, twin_of, unavailable, world_of
from mdnum.forks.choices.decisions import ContactStep, Inverted, Iterations
from mdnum.forks.choices.frames import Images, Relabel, Rotate, Translate
from mdnum.forks.choices.inputs import Cap, EnergyShift, NoiseChoice, StartUlp, Ulps
from mdnum.forks.choices.lists import Builder, FormatChoice, Order, RebuildChoice, Skin

__all__ = [
    "CHOICES",
    "Builder",
    "Cap",
    "Choice",
    "ContactStep",
    "EnergyShift",
    "FormatChoice",
    "Images",
    "Inverted",
    "Iterations",
    "NoiseChoice",
    "Order",
    "PrecisionChoice",
    "RebuildChoice",
    "Relabel",
    "Rotate",
    "Skin",
    "StartUlp",
    "Stopping",
    "Summation",
    "Translate",
    "Ulps",
    "parse",
    "shipped",
    "twin_of",
    "unavailable",
    "world_of",
]
