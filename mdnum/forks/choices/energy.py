"""A constant in the energy of each pair: what the forces, and so the trajectory, must not notice."""

from __future__ import annotations

from dataclasses import dataclass

from mdnum.forks.choices.base import check, varied
from mdnum.forks.twin import Twin
from mdnum.systems.build import build
from mdnum.systems.load import System

_OTHER = {"hard": "shifted", "shifted": "hard"}


@dataclass(frozen=True)
class EnergyShift:
    """The energy of each pair shifted to zero at its cutoff, or no longer.

    The two differ in the energy they conserve, and in nothing that moves.
    """

    @property
    def name(self) -> str:
        """The only one."""
        return "energy-shift"

    @property
    def about(self) -> str:
        """One line."""
        return "pair energies shifted to zero at the cutoff, or not"

    @property
    def must_hold(self) -> bool:
        """A constant has no derivative."""
        return True

    def why_not(self, system: System) -> str | None:
        """Other cutoffs change the force too."""
        cutoff = system.spec.cutoff
        if cutoff is None:
            return "the potential carries its own cutoff"
        if cutoff.kind not in _OTHER:
            return f"a {cutoff.kind} cutoff changes the force too"
        return None

    def make(self, system: System) -> Twin:
        """The system, and with its cutoff hard instead of shifted or the other way round."""
        check(self, system)
        assert system.spec.cutoff is not None
        kind = system.spec.cutoff.kind
        other = varied(system, {"cutoff.kind": _OTHER[kind]})
        return Twin(build(system), build(other), f"cutoff {_OTHER[kind]}, not {kind}: the same forces")
