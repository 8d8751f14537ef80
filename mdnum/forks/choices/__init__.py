"""What can be varied, one numerical choice at a time."""

from __future__ import annotations

from mdnum.forks.choices.arithmetic import Precision, Summation
from mdnum.forks.choices.base import Choice
from mdnum.forks.choices.energy import EnergyShift
from mdnum.forks.choices.formats import Format
from mdnum.forks.choices.frames import Images, Relabel, Rotate, Translate
from mdnum.forks.choices.inputs import Noise, StartUlp, Ulps
from mdnum.forks.choices.lists import Builder, Order, Rebuild, Skin
from mdnum.forks.choices.registry import BY_NAME, names, parse
from mdnum.forks.choices.screen import Screened, screen

__all__ = [
    "BY_NAME",
    "Builder",
    "Choice",
    "EnergyShift",
    "Format",
    "Images",
    "Noise",
    "Order",
    "Precision",
    "Rebuild",
    "Relabel",
    "Rotate",
    "Screened",
    "Skin",
    "StartUlp",
    "Summation",
    "Translate",
    "Ulps",
    "names",
    "parse",
    "screen",
]
