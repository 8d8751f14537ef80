"""What a choice is, for systems of both worlds, and how the two programs of one are made."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from typing_extensions import dataclass_transform

from mdnum.errors import InputError
from mdnum.forks.worlds import changes, program_of, varied
from mdnum.numerics import reductions
from mdnum.program import Twin
from mdnum.registry import Registry
from mdnum.systems import BallSystem, System

#: Reductions whose result does not depend on the order of their terms.
ORDERLESS = ("exact", "fixed-point")
#: What `mdnum fork processes` varies, and people may look for here.
_PROGRAMS = ("jit", "eager", "vmap", "grad", "xla")
_WORLDS = {"md": "of molecular dynamics", "ball": "of a ball"}


class Choice:
    """One numerical choice that can be made otherwise: its arguments, as a frozen dataclass.

    To add one, write a subclass and decorate it with `choice("family")`, the word before "=". A package
    outside gives its own a `family`, decorates it with `choice(None)` and names it by an entry point of the
    group "mdnum.choices". Its first field but `both` is what is written after "=", and `both`, where there is
    one, what is written after "@".

    Attributes:
        family: the word before "=".
        worlds: "md" and "ball", or one of them.
        must_hold: whether it cannot change a bit of the trajectory by design, so that a fork is a finding.
        shown: whether its argument is a part of its name where it is the default.
    """

    family: ClassVar[str] = ""
    worlds: ClassVar[tuple[str, ...]] = ("md", "ball")
    must_hold: bool = False
    shown: ClassVar[bool] = False

    @classmethod
    def _field(cls) -> Any:
        return next((one for one in fields(cls) if one.name != "both"), None)  # type: ignore[arg-type]

    @property
    def argument(self) -> str:
        """What is written after "="."""
        field = self._field()
        value = None if field is None else getattr(self, field.name)
        if value is None or (field and value == field.default and not self.shown):
            return ""
        return f"{value:g}" if isinstance(value, float) else str(value)

    @property
    def name(self) -> str:
        """The word that `parse` makes it from."""
        both = getattr(self, "both", None)
        return self.family + (f"={self.argument}" if self.argument else "") + (f"@{both}" if both else "")

    def describe(self, world: str = "md") -> str:
        """One line, for a system of a world."""
        text = (self.__doc__ or self.name).partition("\n")[0].rstrip(".")
        return text[:1].lower() + text[1:] + summing(getattr(self, "both", None))

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        """From "family.role=argument@both"; empty where there is none. It has those that it has fields for.

        Raises:
            InputError: an argument that it cannot have.
        """
        field = cls._field()
        if argument and field is None:
            raise InputError(f"{cls.family} has no argument", where=f"{cls.family}={argument}")
        values = {"both": both} if both else {}
        if argument:
            kind = {"int": int, "float": float}.get(str(field.type).partition(" ")[0])
            values[field.name] = number(argument, kind, cls.family) if kind else argument
        return cls(**values)

    @classmethod
    def shipped(cls, world: str) -> Iterable[Choice]:
        """The choices of this family that are screened when all are asked for."""
        return (cls(),)

    def reason_unavailable(self, system: Any) -> str | None:
        """Why it does not apply to a system of its worlds; None where it does."""
        return None

    def make(self, system: Any) -> Twin:
        """The two programs; called where it applies."""
        raise NotImplementedError


CHOICES: Registry[Any] = Registry("choice", "mdnum.choices", Choice)


@dataclass_transform(frozen_default=True)
def choice(family: str | None):
    """Make a subclass of `Choice` a frozen dataclass, and register it under its family where it has one."""

    def add(cls: type[Any]) -> type[Any]:
        made = dataclass(frozen=True)(cls)
        if family is not None:
            made.family = family
            CHOICES.add(family, made)
        return made

    return add


def world_of(system: Any) -> str:
    """ "md" or "ball"."""
    return "ball" if isinstance(system, BallSystem) else "md"


def shipped(world: str) -> dict[str, Choice]:
    """The choices of a world that are screened when all are asked for, by name."""
    families = (CHOICES[family] for family in CHOICES)
    every = (choice for one in families if world in one.worlds for choice in one.shipped(world))
    return {choice.name: choice for choice in every}


def unavailable(choice: Choice, system: Any) -> str | None:
    """Why a choice does not apply to a system; None where it does."""
    world = world_of(system)
    if world not in choice.worlds:
        return f"it is a choice {_WORLDS[choice.worlds[0]]}"
    return choice.reason_unavailable(system)


def twin_of(choice: Choice, system: System | BallSystem) -> Twin:
    """The two programs of a choice.

    Raises:
        InputError: it does not apply to the system.
    """
    reason = unavailable(choice, system)
    if reason is not None:
        raise InputError(
            f"does not apply to {system.name}: {reason}",
            where=choice.name,
            remedy="Choose another: `mdnum fork` lists them",
        )
    return choice.make(system)


def parse(text: str, world: str | None = None) -> Choice:
    """A choice from a word.

    Args:
        text: a family, with an argument where it has one: "precision=bfloat16", "precision.force=float32",
            "reduction=permuted:3", "skin=0.5", "format=sparse", "rebuild=every:10",
            "ulps=cutoff.radius:+1", "start=17:0:+1" (atom, axis, ulps) and "start=3:velocity:+1" (ball, what,
            ulps), "order=3", "translate=0.5", "rotate=-x-yz", "noise=7", "stop=maximum", "max_iter=+2",
            "iterations=+1:57:3" (more, step, ball), "contact=later:2" (of the second contact),
            "contact=57:0" (inverted at a step, for a ball). A last "@exact" gives both runs that reduction,
            where an order is what is chosen; "@alone" stops each ball by itself.
        world: whose choices an error lists, "md" or "ball"; default those of both.

    Raises:
        InputError: no such choice, or an argument that it cannot have.
    """
    text = text.strip()
    word, at, both = text.partition("@")
    family, equals, argument = word.partition("=")
    head, _, role = family.partition(".")
    if family in _PROGRAMS:
        raise InputError(
            f"{text} is another program of one run, and no choice of two",
            remedy="Ask `mdnum fork processes SYSTEM`",
        )
    if head in CHOICES and (argument or not equals) and (both or not at):
        kind: type[Choice] = CHOICES[head]
        takes = {one.name for one in fields(kind)}  # type: ignore[arg-type]
        if (not role or "role" in takes) and (not both or "both" in takes):
            return kind.parse(argument, role, both or None)
    worlds = _WORLDS if world is None else (world,)
    families = [one for one in CHOICES if set(CHOICES[one].worlds) & set(worlds)]
    known = dict.fromkeys([*families, *(name for one in worlds for name in shipped(one))])
    close = difflib.get_close_matches(text, known, n=3)
    near = f"Did you mean {' or '.join(close)}? " if close else ""
    raise InputError(
        f"no choice {text!r}", remedy=f"{near}There are {', '.join(families)}; `mdnum fork` lists all"
    )


# --- for the choices ----------------------------------------------------------------------------------


def number(text: str, kind: type, where: str) -> Any:
    """A number from a choice's argument.

    Raises:
        InputError: it is none.
    """
    try:
        return kind(text)
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise InputError(f"{text!r} is not {what}", where=where) from None


def some_ulps(count: int, where: str) -> None:
    """Refuse 0 ulps or iterations.

    Raises:
        InputError: it is 0.
    """
    if count == 0:
        raise InputError("0 change nothing", where=where, remedy="Write +1 or -1")


def is_pairwise(system: System) -> bool:
    """Whether a pair potential, whose sums and precision can be chosen, holds the system together."""
    return system.spec.cutoff is not None


def is_langevin(system: System) -> bool:
    """Whether the run has a thermostat, and so noise."""
    return system.spec.dynamics.kind == "langevin"


def no_sums(system: System, both: str | None) -> str | None:
    """Why both runs cannot have a reduction; None where they can, or where none was asked for."""
    if both is None or is_pairwise(system):
        return None
    return "the sums of a many-body potential have one order"


def summing(both: str | None) -> str:
    """The end of a sentence that says how both runs sum."""
    return "" if both is None else f" (both with {both} sums)"


def summed(simulation: Any, word: str | None) -> Any:
    """The same simulation with another order of its force sums, such as "exact" or "permuted:3"."""
    if word is None:
        return simulation
    system = simulation.system
    if ":" not in word:
        # the system then says what runs; a file has no words for the number of a reduction
        system = varied(system, {"precision.reduction": word})
    return replace(simulation, system=system, reduction=reductions.parse(word))


def built(system: System, both: str | None = None) -> Any:
    """A system's simulation, with the reduction that both programs of a twin have."""
    program: Any = program_of(system)
    return summed(program.simulation, both)


def simulations(a: Any, b: Any, difference: str, frame: Any = None) -> Twin:
    """The twin of two simulations of molecular dynamics."""
    from mdnum.rollout.program import MdProgram

    return Twin(MdProgram(a), MdProgram(b, frame=frame), difference, changes(a.system, b.system))
