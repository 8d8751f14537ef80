"""Losses and units by their words: what `mdnum grad --of` names, and what a derivative is measured in."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError

if TYPE_CHECKING:
    from mdnum.gradients.losses import Loss
    from mdnum.systems.build import Simulation
    from mdnum.units import Units

#: Velocities and what is made of them: inside, time is length * sqrt(mass / energy).
_SPEED2 = "{energy}/{mass}"


@dataclass(frozen=True)
class LossWord:
    """A loss that has a word.

    Attributes:
        kind: name of its class in `mdnum.gradients.losses`.
        about: what it is, a few words.
        unit: its unit, with the names of `Units` in braces.
    """

    kind: str
    about: str
    unit: str


#: Losses by word.
LOSSES: Mapping[str, LossWord] = MappingProxyType(
    {
        "msd": LossWord("MeanSquaredDisplacement", "mean squared displacement at the last step", "{length}²"),
        "vacf": LossWord("VelocityAutocorrelation", "mean of v(0) · v(t) at the last step", _SPEED2),
        "diffusion-einstein": LossWord(
            "EinsteinDiffusion", "diffusion constant from the slope of displacements", "{length}²/{time}"
        ),
        "diffusion-green-kubo": LossWord(
            "GreenKuboDiffusion", "diffusion constant from the velocity autocorrelation", "{length}²/{time}"
        ),
        "rdf": LossWord("RadialDistribution", "mean squared difference of g(r) from 1", ""),
        "potential": LossWord(
            "MeanPotential", "potential energy of an atom, averaged over steps", "{energy}"
        ),
        "temperature": LossWord(
            "MeanTemperature", "kinetic temperature, averaged over steps", "{temperature}"
        ),
        "pressure": LossWord("MeanPressure", "pressure, averaged over steps", "{energy}/{length}³"),
        "final-projection": LossWord("FinalProjection", "mean of the last positions along x", "{length}"),
    }
)

#: Units of parameters by the last word of their name.
_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "sigma": "{length}", "epsilon": "{energy}", "depth": "{energy}", "r0": "{length}",
        "radius": "{length}", "onset": "{length}", "timestep": "{time}", "temperature": "{temperature}",
        "friction": "1/{time}", "scale": "", "positions": "{length}", "velocities": "√({energy}/{mass})",
    }
)  # fmt: skip


def loss(text: str, simulation: Simulation, steps: int) -> tuple[str, Loss]:
    """The loss that a word names, and the word without its options.

    Args:
        text: a word of `LOSSES`, with numbers of the loss behind a colon where others than the defaults are
            meant: "potential:every=10,first=500".
        simulation, steps: what it is a loss of.

    Raises:
        InputError: no such loss, or it has no such number.
    """
    word, _, rest = text.partition(":")
    word = word.strip()
    if word not in LOSSES:
        close = difflib.get_close_matches(word, LOSSES, n=1)
        hint = f"Did you mean {close[0]}? " if close else ""
        raise InputError(f"no loss {word!r}", remedy=f"{hint}There are {', '.join(LOSSES)}")
    from mdnum.gradients import losses

    make: Callable[..., Loss] = getattr(losses, LOSSES[word].kind)
    options = _options(word, make, rest)
    if word == "rdf":
        # every pair is looked at, and neighboring steps look alike
        options = {"every": 10, "bins": 60} | options
        # bins reach two widths further, and no further than nearest images do
        half = 0.5 * float(min(simulation.cell.widths))
        options.setdefault("r_max", 0.999 * half / (1 + 2 / options["bins"]))
    elif word == "diffusion-green-kubo":
        every = options.get("every", 1)
        options.setdefault("until", steps // every * every)
    return word, make(**options)


def _options(word: str, make: Any, rest: str) -> dict[str, Any]:
    """The numbers behind the colon."""
    known = {one.name: str(one.type) for one in fields(make) if one.type in ("int", "float")}
    found: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in rest.split(","))):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or key not in known:
            raise InputError(
                f"{part!r} is no number of the loss {word}",
                remedy=f"It has {', '.join(known)}; write for example {word}:every=10",
            )
        try:
            found[key] = int(value) if known[key] == "int" else float(value)
        except ValueError:
            a = "a whole number" if known[key] == "int" else "a number"
            raise InputError(f"{key} = {value!r} of the loss {word} is not {a}") from None
    return found


def unit_of_loss(word: str, units: Units) -> str:
    """The unit of a loss."""
    return _in(LOSSES[word].unit, units)


def unit_of_parameter(name: str, units: Units) -> str:
    """The unit of a parameter by its full name: "" for none, its own name in brackets where nobody says."""
    short = name.rpartition(".")[2]
    return _in(_UNITS.get(short, f"[{short}]"), units)


def _in(unit: str, units: Units) -> str:
    return unit.format(
        length=units.length,
        energy=units.energy,
        mass=units.mass,
        time=units.time,
        temperature=units.temperature,
    )


def words(texts: Sequence[str] | str) -> tuple[str, ...]:
    """Words that were given one by one, or with commas between them."""
    texts = (texts,) if isinstance(texts, str) else texts
    return tuple(dict.fromkeys(word.strip() for text in texts for word in text.split(",") if word.strip()))
