"""What a choice is, and how the two programs of one are made from a system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

from pydantic import ValidationError

from mdnum.errors import InputError
from mdnum.forks.twin import Twin
from mdnum.precision import reductions
from mdnum.systems import overrides, structures, toml
from mdnum.systems.build import Simulation, build
from mdnum.systems.load import GRAMMAR, System
from mdnum.systems.schema import LangevinTable, SystemSpec

#: Reductions whose result does not depend on the order of their terms.
ORDERLESS = ("exact", "fixed-point")


@runtime_checkable
class Choice(Protocol):
    """One numerical choice that can be made otherwise.

    Attributes:
        name: the word that `parse` makes it from.
        about: one line for people.
        must_hold: whether it cannot change a bit of the trajectory by design, so that a fork is a finding.
    """

    @property
    def name(self) -> str: ...

    @property
    def about(self) -> str: ...

    @property
    def must_hold(self) -> bool: ...

    def why_not(self, system: System) -> str | None:
        """Why it does not apply to a system; None where it does."""
        ...

    def make(self, system: System) -> Twin:
        """The two programs.

        Raises:
            InputError: it does not apply.
        """
        ...


def check(choice: Choice, system: System) -> None:
    """Refuse a choice that does not apply.

    Raises:
        InputError: with the reason.
    """
    reason = choice.why_not(system)
    if reason is not None:
        raise InputError(
            f"does not apply to {system.name}: {reason}",
            where=choice.name,
            remedy="Choose another: `mdnum fork` lists them",
        )


def varied(system: System, values: Mapping[str, Any]) -> System:
    """The system with other values of some keys of its file, checked as the file is.

    Args:
        system: as loaded.
        values: dotted key to value. A key of the structure makes the atoms anew.

    Raises:
        InputError: a value that the file could not have.
    """
    data = system.spec.model_dump(mode="python", exclude_none=True)
    keys = {toml.dotted(key): value for key, value in values.items()}
    overrides.apply(data, keys, GRAMMAR)
    try:
        spec = SystemSpec.model_validate(data)
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], where=", ".join(values)) from None
    atoms = system.atoms
    if any(key[0] == "structure" for key in keys):
        atoms = structures.make(spec.structure, spec.units, system.folder)
    return replace(system, spec=spec, atoms=atoms)


def summed(simulation: Simulation, word: str) -> Simulation:
    """The same simulation with another order of its force sums, such as "exact" or "permuted:3"."""
    reduction = reductions.parse(word)
    system = simulation.system
    if ":" not in word:
        # the system then says what runs; a file has no words for the number of a reduction
        system = varied(system, {"precision.reduction": word})
    return replace(simulation, system=system, reduction=reduction)


def built(system: System, both: str | None) -> Simulation:
    """A system's simulation, with the reduction that both programs of a twin are given."""
    simulation = build(system)
    return simulation if both is None else summed(simulation, both)


def is_pairwise(system: System) -> bool:
    """Whether a pair potential, whose sums and precision can be chosen, holds the system together."""
    return system.spec.cutoff is not None


def is_langevin(system: System) -> bool:
    """Whether the run has a thermostat, and so noise."""
    return isinstance(system.spec.dynamics, LangevinTable)


def no_sums(system: System, both: str | None) -> str | None:
    """Why both runs cannot have a reduction; None where they can, or where none was asked for."""
    if both is None or is_pairwise(system):
        return None
    return "the sums of a many-body potential have one order"


def suffix(both: str | None) -> str:
    """The end of a choice's name that says how both runs sum."""
    return "" if both is None else f"@{both}"


def summing(both: str | None) -> str:
    """The end of a difference in words."""
    return "" if both is None else f" (both with {both} sums)"


def whole(text: str, what: str) -> int:
    """A whole number from a choice's argument.

    Raises:
        InputError: it is none.
    """
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number", where=what) from None


def real(text: str, what: str) -> float:
    """A number from a choice's argument.

    Raises:
        InputError: it is none.
    """
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} is not a number", where=what) from None
