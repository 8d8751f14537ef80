"""Potentials that are no sum over pairs: Stillinger-Weber, Tersoff, embedded atom, and any of jax-md's."""

from __future__ import annotations

from mdnum.errors import InputError
from mdnum.md.manybody.base import Described, ManyBody, Smoothness
from mdnum.md.manybody.embedded_atom import EmbeddedAtom, embedded_atom
from mdnum.md.manybody.stillinger_weber import StillingerWeber
from mdnum.md.manybody.tersoff import Tersoff, silicon_1989
from mdnum.md.manybody.wrapped import Wrapped, from_jax_md

__all__ = [
    "Described",
    "EmbeddedAtom",
    "ManyBody",
    "Smoothness",
    "StillingerWeber",
    "Tersoff",
    "Wrapped",
    "embedded_atom",
    "from_jax_md",
    "silicon_1989",
    "stillinger_weber",
    "tersoff",
]

_PERIODIC = (True, True, True)


def stillinger_weber(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> StillingerWeber:
    """Stillinger-Weber with a named set of constants (a system file's `parameters`).

    Raises:
        InputError: no such set.
    """
    if parameters != "Si":
        raise InputError(f"no Stillinger-Weber constants called {parameters!r}; known is Si")
    return StillingerWeber(pbc=pbc)


def tersoff(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> Tersoff:
    """Tersoff with a named set of constants: Si (1988, set Si(C), "T3") or Si-1989.

    Raises:
        InputError: no such set.
    """
    if parameters == "Si":
        return Tersoff(pbc=pbc)
    if parameters == "Si-1989":
        return silicon_1989(pbc)
    raise InputError(f"no Tersoff constants called {parameters!r}; known are Si and Si-1989")
