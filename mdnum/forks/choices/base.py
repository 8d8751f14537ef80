"""The base class of numerical choices, and pairs of programs that differ in one choice."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import dataclass_transform

from mdnum.errors import InputError
from mdnum.forks.worlds import alike, changes, varied
from mdnum.numerics import reductions
from mdnum.program import Twin
from mdnum.registry import Registry, meant
from mdnum.systems import BallSystem, System, opened
from mdnum.systems.load import world_of

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: Reductions whose results do not depend on the order of their terms.
ORDERLESS = ("exact", "fixed-point")
#: Names varied by `mdnum fork processes`, which users may also try here.
_PROGRAMS = ("jit", "eager", "vmap", "grad", "xla")
_WORLDS = {"md": "of molecular dynamics", "ball": "of a ball"}
#: Fields that are printed with their sign.
_SIGNED = ("ulps", "more")


class Choice:
    """One numerical choice, such as the precision. The fields of a choice are its arguments.

    To add a choice, decorate a subclass with `choice("family")`. The family is the word before "=" in the
    choice's text. A choice in another package sets its own `family` and is decorated with `choice(None)`. The
    choice is an entry point of the group "mdnum.choices". The fields of a choice are written after "=",
    separated by ":". The field `both` is written after "@". The first line of the class docstring describes
    the choice for users.
    """

    family: ClassVar[str] = ""  # the word before "="
    worlds: ClassVar[tuple[str, ...]] = ("md", "ball")  # "md" and "ball", or one of them
    # words of the choices that are screened when all are asked for, of each world where they are not the
    # same; the family's own where there are none
    screened: ClassVar[str | Mapping[str, str]] = ""
    shown: ClassVar[bool] = False  # whether arguments are a part of the name where they are the defaults
    # whether it cannot change a bit of the trajectory by design, so that a fork is a finding
    must_hold: bool = False

    @classmethod
    def _fields(cls) -> list[Any]:
        return [one for one in fields(cls) if one.name != "both"]  # type: ignore[arg-type]

    @property
    def argument(self) -> str:
        """Argument of the choice, as the text that is written after "="."""
        values = {one.name: getattr(self, one.name) for one in self._fields()}
        if not self.shown and all(values[one.name] == one.default for one in self._fields()):
            return ""
        return ":".join(_written(name, value) for name, value in values.items() if value is not None)

    @property
    def name(self) -> str:
        """Text from which `parse` can recreate the choice."""
        both = getattr(self, "both", None)
        return self.family + (f"={self.argument}" if self.argument else "") + (f"@{both}" if both else "")

    def describe(self, world: str = "md") -> str:
        """Describe the choice in one line, for molecular dynamics or for a ball."""
        text = (self.__doc__ or self.name).partition("\n")[0].rstrip(".")
        return text[:1].lower() + text[1:] + summing(getattr(self, "both", None))

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        """Create a choice from the parts of the text "family.role=argument@both". Missing parts are empty.

        Raises:
            InputError: the argument is not valid for this choice.
        """
        own = cls._fields()
        if argument and not own:
            raise InputError(f"the choice {cls.family} takes no argument", where=f"{cls.family}={argument}")
        values: dict[str, Any] = {"both": both} if both else {}
        for one, part in zip(own, argument.split(":", len(own) - 1) if argument else (), strict=False):
            kind = {"int": int, "float": float}.get(str(one.type).partition(" ")[0])
            values[one.name] = number(part, kind, cls.family) if kind else part
        return cls(**values)

    def make(self, system: Any) -> Twin:
        """Make two programs that differ in this choice.

        Raises:
            InputError: the choice does not apply to the system; the message gives the reason.
        """
        raise NotImplementedError


def _written(name: str, value: Any) -> str:
    return f"{value:+d}" if name in _SIGNED else f"{value:g}" if isinstance(value, float) else str(value)


CHOICES: Registry[Any] = Registry("choice", "mdnum.choices", Choice)


@dataclass_transform(frozen_default=True)
def choice(family: str | None):
    """Make a subclass of `Choice` a frozen dataclass. Register the subclass if a family is given."""

    def add(cls: type[Any]) -> type[Any]:
        made = dataclass(frozen=True)(cls)
        if family is not None:
            made.family = family
            CHOICES.add(family, made)
        return made

    return add


def shipped(world: str) -> dict[str, Choice]:
    """Return the default choices of molecular dynamics ("md") or of a "ball", by name."""

    def of_family(kind: type[Choice]) -> Iterable[Choice]:
        words = kind.screened if isinstance(kind.screened, str) else kind.screened[world]
        return [parse(word) for word in words.split()] if words else [kind()]

    kinds = [kind for kind in (CHOICES[family] for family in CHOICES) if world in kind.worlds]
    return {choice.name: choice for kind in kinds for choice in of_family(kind)}


def unavailable(choice: Choice, system: Simulation | System | BallSystem) -> str | None:
    """Return why a choice does not apply to a system. None if the choice applies."""
    made = twin_or_reason(choice, system)
    return made if isinstance(made, str) else None


def twin_or_reason(choice: Choice, system: Simulation | System | BallSystem) -> Twin | str:
    """Make two programs that differ in a choice, or return why this is not possible."""
    if world_of(system) not in choice.worlds:
        return f"it is a choice {_WORLDS[choice.worlds[0]]}"
    try:
        return choice.make(opened(system))
    except AttributeError as error:
        if error.name != "spec":
            raise
        message = f"{type(choice).__module__} reads the tables of a system file, but was given a Simulation"
        raise InputError(
            message, where=choice.name, remedy="docs/extending.md explains how to write a numerical choice"
        ) from error
    except InputError as error:
        # the choice is named where this is printed
        return error.message.removeprefix(f"variant {choice.name!r}: ")


def twin_of(choice: Choice, system: Simulation | System | BallSystem) -> Twin:
    """Make two programs that simulate the same system and differ in one choice.

    Raises:
        InputError: the choice does not apply to the system.
    """
    made = twin_or_reason(choice, system)
    if isinstance(made, str):
        raise InputError(
            f"the numerical choice does not apply to the system {system.name}: {made}",
            where=choice.name,
            remedy="Use another choice; `mdnum fork choices` lists all choices",
        )
    return made


def parse(text: str, world: str | None = None) -> Choice:
    """Create a choice from its text.

    Args:
        text: a family, with an argument where it has one: "precision=bfloat16", "precision.force=float32",
            "reduction=permuted:3", "skin=0.5", "format=sparse", "rebuild=every:10", "ulps=cutoff.radius:+1",
            "start=17:0:+1" (atom, axis, ulps) and "start=3:velocity:+1" (ball, what, ulps), "order=3",
            "translate=0.5", "rotate=-x-yz", "noise=7", "stop=maximum", "max_iter=+2", "iterations=+1:57:3"
            (more, step, ball), "contact=later:2" (of the second contact), "contact=57:0" (inverted at a step,
            for a ball). For a choice of summation order, a final "@exact" makes both runs compute exact sums;
            "@alone" stops each ball separately.
        world: "md" or "ball", the kind of system whose choices an error message lists; default both.

    Raises:
        InputError: the choice does not exist, or its argument is not valid.
    """
    text = text.strip()
    word, at, both = text.partition("@")
    family, equals, argument = word.partition("=")
    head, _, role = family.partition(".")
    if family in _PROGRAMS:
        raise InputError(
            f"the choice {text} applies to a whole process, so it cannot differ between runs in one process",
            remedy="Run `mdnum fork processes SYSTEM`, which compares runs in separate processes",
        )
    if head in CHOICES and (argument or not equals) and (both or not at):
        kind: type[Choice] = CHOICES[head]
        takes = {one.name for one in fields(kind)}  # type: ignore[arg-type]
        if (not role or "role" in takes) and (not both or "both" in takes):
            return kind.parse(argument, role, both or None)
    worlds = _WORLDS if world is None else (world,)
    families = [one for one in CHOICES if set(CHOICES[one].worlds) & set(worlds)]
    near = meant(text, [*families, *(name for one in worlds for name in shipped(one))])
    raise InputError(
        f"unknown numerical choice {text!r}",
        remedy=f"{near}Kinds of choices are {', '.join(families)}; `mdnum fork choices` lists all choices",
    )


# --- for the choices ----------------------------------------------------------------------------------


def check(is_good: bool, message: str, where: str, remedy: str | None = None) -> None:
    """Raise an `InputError` if an argument of a choice is not valid."""
    if not is_good:
        raise InputError(message, where=where, remedy=remedy)


def applies(is_so: bool, reason: str) -> None:
    """Raise an `InputError` unless a choice applies to a system."""
    if not is_so:
        raise InputError(reason)


def number(text: str, kind: type, where: str) -> Any:
    """Parse a number in the argument of a choice. Raise an `InputError` for other text."""
    try:
        return kind(text)
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise InputError(f"{text!r} is not {what}", where=where) from None


def some(count: int, where: str) -> None:
    """Raise an `InputError` if the number of ulps or iterations is 0."""
    check(count != 0, "0 change nothing", where, "Write +1 or -1")


def plural(count: int, noun: str) -> str:
    """Return a noun in the singular or plural form (final s), for a count."""
    return noun if abs(count) == 1 else f"{noun}s"


def summing(both: str | None) -> str:
    """Return a phrase that describes how the two runs compute sums."""
    return "" if both is None else f" (both with {both} sums)"


def summed(simulation: Simulation, both: str | None = None) -> Simulation:
    """Return a simulation with another sum of forces, such as "exact" or "permuted:3".

    A many-body potential raises an `InputError`, since its order of sums is fixed.
    """
    if both is None:
        return simulation
    applies(simulation.pairwise, "the sums of a many-body potential have one order")
    if ":" not in both:
        # a file has no words for the number of a reduction
        simulation = varied(simulation, {"precision.reduction": both})
    return replace(simulation, reduction=reductions.parse(both))


def simulations(a: Any, b: Any, difference: str, frame: Any = None) -> Twin:
    """Make a pair of programs from two molecular-dynamics simulations."""
    from mdnum.rollout.program import MdProgram

    one, other = alike(a, b)
    return Twin(MdProgram(one), MdProgram(other, frame=frame), difference, changes(a, b))


@choice(None)
class Summed(Choice):
    """A choice that can set how both runs compute sums."""

    worlds = ("md",)
    both: str | None = None  # reduction of both runs; None for the system's own

    def __post_init__(self):
        if self.both is not None:
            reductions.parse(self.both)

    @property
    def must_hold(self) -> bool:  # type: ignore[override]
        """True if sums of both runs do not depend on the order of terms. The choice then has no effect."""
        return self.both in ORDERLESS

    def twin(self, a: Any, b: Any, difference: str, frame: Any = None) -> Twin:
        """Combine two simulations into a `Twin`, whose label includes the method of summation."""
        return simulations(a, b, difference + summing(self.both), frame)
