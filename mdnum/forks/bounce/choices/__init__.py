"""What can be varied on a ball, one numerical choice at a time."""

from __future__ import annotations

from mdnum.forks.bounce.choices.arithmetic import Precision, Stopping, Summation
from mdnum.forks.bounce.choices.base import Choice
from mdnum.forks.bounce.choices.decisions import ContactStep, Inverted, Iterations
from mdnum.forks.bounce.choices.inputs import Cap, StartUlp, Ulps
from mdnum.forks.bounce.choices.order import BatchOrder
from mdnum.forks.bounce.choices.registry import BY_NAME, names, parse
from mdnum.forks.bounce.choices.screen import screen

__all__ = [
    "BY_NAME",
    "BatchOrder",
    "Cap",
    "Choice",
    "ContactStep",
    "Inverted",
    "Iterations",
    "Precision",
    "StartUlp",
    "Stopping",
    "Summation",
    "Ulps",
    "names",
    "parse",
    "screen",
]
