"""A checked system of the ball: what a file says, and its variants."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mdnum.errors import InputError
from mdnum.store.files import disk_errors, write_text
from mdnum.systems import ball_checks, toml
from mdnum.systems.ball import BallSpec, ValuesControl
from mdnum.systems.grammar import Grammar, apply_overrides, explain, place, read_overrides
from mdnum.systems.toml import SYSTEM_FILE

BALL_SCHEMA = "ball-schema.json"
GRAMMAR = Grammar(BallSpec)


@dataclass(frozen=True)
class Source:
    """A system file as it was read.

    Attributes:
        name: what the system was called by.
        path: the file.
        where: the file, as a message names it.
        text: what it holds.
        values: overrides, by key.
    """

    name: str
    path: Path
    where: str
    text: str
    values: Mapping[toml.Key, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class VariantSpec:
    """The same system with some keys changed.

    Attributes:
        name: what to call it.
        changes: dotted keys to values.
        spec: what comes of it.
    """

    name: str
    changes: Mapping[str, Any]
    spec: BallSpec


@dataclass(frozen=True)
class BallSystem:
    """A checked system of the ball.

    Attributes:
        name: such as "ball/drop".
        spec: the file's tables, defaults filled in.
        path: the file, or None.
        variants: each checked like the system itself.
    """

    name: str
    spec: BallSpec
    path: Path | None = None
    variants: tuple[VariantSpec, ...] = ()

    @property
    def balls(self) -> int:
        """How many balls there are."""
        return ball_checks.balls(self.spec)

    @property
    def warnings(self) -> tuple[ball_checks.Remark, ...]:
        """What runs, and is probably not what was meant."""
        return ball_checks.warnings(self.spec)

    def against(self, changes: Mapping[str, Any], name: str | None = None) -> BallSystem:
        """This system with one more variant.

        Args:
            changes: dotted keys to values; text is read as TOML would read it.
            name: what to call the variant; default the changes themselves.

        Raises:
            InputError: the variant cannot be run, or its name is taken.
        """
        name = name or ", ".join(f"{key}={value}" for key, value in changes.items())
        if name in {variant.name for variant in self.variants}:
            raise InputError(f"there is a variant {name!r} already", remedy="Give it once")
        given = {".".join(key): value for key, value in read_overrides(changes).items()}
        variant = vary(name, given, self.spec, f"--against {name}")
        tables = {**self.spec.variants, name: given}
        spec = self.spec.model_copy(update={"variants": tables})
        return BallSystem(self.name, spec, self.path, (*self.variants, variant))

    def for_steps(self, steps: int) -> BallSystem:
        """This system with another number of steps; a control given by values is cut, or keeps its last.

        Args:
            steps: of a run, at least 1.
        """
        update: dict[str, Any] = {
            "integrator": self.spec.integrator.model_copy(update={"steps": steps}),
        }
        control = self.spec.flight.control
        if isinstance(control, ValuesControl):
            values = control.values[:steps]
            values += values[-1:] * (steps - len(values))
            update["flight"] = self.spec.flight.model_copy(
                update={"control": control.model_copy(update={"values": values})}
            )
        return replace(self, spec=self.spec.model_copy(update=update))

    def to_toml(self, *, beside: bool = True) -> str:
        """The system file with every default written out; a ball has no other files to be beside."""
        spec = self.spec.model_dump(mode="python", exclude_none=True)
        if self.spec.start.boundary is not None:
            # the other keys of the table hold their defaults, and would contradict it
            spec["start"] = {"boundary": spec["start"]["boundary"]}
        return toml.dump({"name": self.name, **kind_first(spec)})

    def write(self, folder: str | Path) -> Path:
        """Write system.toml; returns its path."""
        target = Path(folder)
        with disk_errors(target):
            target.mkdir(parents=True, exist_ok=True)
        path = target / SYSTEM_FILE
        write_text(path, self.to_toml())
        return path


def make(source: Source, data: dict[str, Any]) -> BallSystem:
    """The ball's system of the tables of a file, overrides included.

    Raises:
        InputError: anything that cannot be run, in one line.
    """
    apply_overrides(data, source.values, GRAMMAR)
    _drop_meaningless(data, source.values)
    try:
        spec = BallSpec.model_validate(data)
    except ValidationError as error:
        raise explain(error, data, source.text, source.where, source.values, GRAMMAR) from None
    try:
        ball_checks.check(spec)
    except ball_checks.UnusableBall as refusal:
        raise _located(refusal, source) from None
    variants = tuple(
        vary(name, changes, spec, place(("variants", name), source.text, source.where, source.values))
        for name, changes in spec.variants.items()
    )
    return BallSystem(spec.name or source.name, spec, source.path, variants)


def _drop_meaningless(data: dict[str, Any], values: Mapping[toml.Key, Any]) -> None:
    """What the file says of another contact or integrator than the one that is asked for."""
    if not {("contact", "kind"), ("integrator", "kind")} & set(values):
        return
    contact, integrator, gradient = (data.get(key) for key in ("contact", "integrator", "gradient"))
    if not isinstance(contact, dict) or not isinstance(integrator, dict):
        return
    kind = contact.get("kind")
    solves = ball_checks.solves(kind, integrator.get("kind"))
    if not solves and not any(key[0] == "stop" for key in values):
        data.pop("stop", None)
    known = (*ball_checks.PARAMETERS.get(str(kind), ()), *ball_checks.ALWAYS)
    if isinstance(gradient, dict) and ("gradient", "of") not in values:
        asked = gradient.get("of", ())
        gradient["of"] = (
            [name for name in asked if name in known] if isinstance(asked, list | tuple) else asked
        )


def kind_first(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Put kind (or rule) at the head of each table, where readers look for it; name and about at the top."""
    ordered = {key: spec[key] for key in ("name", "about", "world", "units") if key in spec}
    for key, value in spec.items():
        if isinstance(value, Mapping):
            head = {tag: value[tag] for tag in ("kind", "rule") if tag in value}
            ordered[key] = {**head, **{k: v for k, v in value.items() if k not in head}}
        else:
            ordered.setdefault(key, value)
    return ordered


def _located(refusal: ball_checks.UnusableBall, source: Source) -> InputError:
    key = refusal.key
    # a default that cannot be run has no line of its own; the overrides that led there are named
    where = place(key, source.text, source.where, source.values)
    return InputError(refusal.message, remedy=refusal.remedy, where=where)


def vary(name: str, changes: Mapping[str, Any], base: BallSpec, where: str) -> VariantSpec:
    """The system with keys changed, checked.

    Args:
        name: what to call it.
        changes: dotted keys to values.
        base: what is changed.
        where: what to blame.

    Raises:
        InputError: it cannot be run.
    """
    if not changes:
        raise InputError(f"variant {name!r} changes nothing", where=where, remedy="Name a key, or remove it")
    data = copy.deepcopy(base.model_dump(mode="python", exclude_none=True, exclude={"variants", "name"}))
    if base.start.boundary is not None:
        data["start"] = {"boundary": data["start"]["boundary"]}
    values = {toml.dotted(key): value for key, value in changes.items()}
    for key in values:
        if key[0] in ("variants", "name", "about", "world") or key == ("integrator", "steps"):
            raise InputError(
                f"variant {name!r} changes {'.'.join(key)}, which says nothing about the arithmetic of a run",
                where=where,
                remedy="Remove it",
            )
    apply_overrides(data, values, GRAMMAR)
    _drop_meaningless(data, values)
    try:
        spec = BallSpec.model_validate(data)
        ball_checks.check(spec)
    except ValidationError as error:
        said = explain(error, data, "", where, (), GRAMMAR)
        raise InputError(f"variant {name!r}: {said.message}", remedy=said.remedy, where=where) from None
    except ball_checks.UnusableBall as refusal:
        raise InputError(f"variant {name!r}: {refusal.message}", remedy=refusal.remedy, where=where) from None
    if ball_checks.balls(spec) != ball_checks.balls(base):
        raise InputError(
            f"variant {name!r} has {ball_checks.balls(spec)} balls and the system {ball_checks.balls(base)}: "
            "decisions of different balls cannot be compared",
            where=where,
            remedy="Keep the number of balls",
        )
    return VariantSpec(name, dict(changes), spec)
