"""Tables of a system file: their base, what a model allows at a dotted key, messages, and overrides.

A table whose keys depend on its kind is a union of models told apart by a key such as `kind` or `rule`; a
`Grammar` follows a key through such unions. Mistakes become one line: what was seen and expected, and where.
"""

from __future__ import annotations

import importlib
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError, core_schema

from mdnum.errors import InputError
from mdnum.registry import nearest
from mdnum.systems import toml
from mdnum.systems.toml import Key, line_of

NonNegative = Annotated[float, Field(ge=0)]
#: Smallest size of a number but 0; what is computed with it squares it.
_SMALLEST = 1e-150
_LARGEST_INT = 2**62


def _numbers_in(value: Any) -> Iterator[float]:
    """The numbers of a value of a table, those in arrays and in free keys included."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    for item in value if isinstance(value, tuple) else (value,):
        if isinstance(item, int | float) and not isinstance(item, bool):
            yield item


class Named:
    """A name of a registry, perhaps with an argument; checked where a file gives one.

    Args:
        registry: "module:attribute"; imported when a name is checked, because the module may be a slow one.
        others: further words that are allowed.
    """

    def __init__(self, registry: str, *others: str):
        self.registry, self.others = registry, others

    def _check(self, value: Any) -> Any:
        if value in self.others:
            return value
        module, _, attribute = self.registry.partition(":")
        registry = getattr(importlib.import_module(module), attribute)
        if isinstance(value, str) and value.partition(registry.separator)[0] not in registry:
            raise PydanticCustomError("unknown_name", "unknown name", {"known": [*self.others, *registry]})
        if isinstance(value, str):
            try:
                registry.parse(value)
            except InputError as error:
                raise PydanticCustomError("unusable_name", "{said}", {"said": error.message}) from None
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_before_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        module, _, attribute = self.registry.partition(":")
        registry = getattr(importlib.import_module(module), attribute)
        lines = [f"{name}: {registry.description(name)}" for name in registry.shipped]
        # an editor offers those shipped, and lets others pass: packages add theirs
        return {
            "anyOf": [{"enum": [*self.others, *registry.shipped]}, {"type": "string"}],
            "description": "; ".join(lines),
        }


class TomlTable(BaseModel):
    """Base of every table: frozen, strict, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_range(self) -> Any:
        for name in type(self).model_fields:
            for value in _numbers_in(getattr(self, name)):
                if isinstance(value, int) and abs(value) > _LARGEST_INT:
                    raise ValueError(f"{name} = {value}; expected a whole number of at most 2^62")
                # a tolerance is compared and not squared, and what tolerances can be is checked with them
                if value and name != "tol" and not _SMALLEST <= abs(value) <= 1 / _SMALLEST:
                    raise ValueError(
                        f"{name} = {value:g}; expected 0 or a size from {_SMALLEST:g} to {1 / _SMALLEST:g}, "
                        "whose square is a number, too"
                    )
        return self


@dataclass(frozen=True)
class Grammar:
    """The tables of one sort of system file.

    Attributes:
        root: the model of the whole file.
    """

    root: type[BaseModel]

    def model(self, key: Key, data: Mapping[str, Any]) -> type[BaseModel] | None:
        """The model of the table at key, given the kinds the data names; None where a table has free keys."""
        model: type[BaseModel] | None = self.root
        table: Any = data
        for part in key:
            table = table.get(part, {}) if isinstance(table, Mapping) else {}
            if model is None or part not in model.model_fields:
                # pairs."Ni-P": the table of one pair
                continue
            model = _choose(_options(model, part), table)
        return model

    def options(self, key: Key, data: Mapping[str, Any]) -> list[type[BaseModel]]:
        """The models that the table at key may have, whatever its kind; none where it is no such table."""
        owner = self.model(key[:-1], data) if key else None
        return _options(owner, key[-1]) if owner is not None and key[-1] in owner.model_fields else []

    def known_keys(self, key: Key, data: Mapping[str, Any]) -> list[str]:
        """Keys that the table at key may hold, given the kinds the data names."""
        model = self.model(key, data)
        if model is None:
            return []
        tag = tag_key([model])
        return sorted(model.model_fields, key=lambda name: name != tag)

    def kinds(self, key: Key, data: Mapping[str, Any]) -> list[str]:
        """The kinds (or rules) that the table at key may have."""
        options = self.options(key, data)
        tag = tag_key(options)
        return [] if tag is None else [kind for model in options for kind in _literals(model, tag)]

    def foreign_keys(self, key: Key, data: Mapping[str, Any]) -> set[str]:
        """Keys that other kinds of the table at key have and the kind it names has not."""
        of_any = {name for model in self.options(key, data) for name in model.model_fields}
        table: Any = data
        for part in key:
            table = table.get(part) if isinstance(table, Mapping) else None
        own = getattr(self.model(key, data), "foreign_keys", None)
        unused = own(table) if own is not None and isinstance(table, Mapping) else set()
        return of_any - set(self.known_keys(key, data)) | unused

    def is_tag(self, key: Key, data: Mapping[str, Any]) -> bool:
        """Whether key is what tells the kinds of its table apart."""
        options = self.options(key[:-1], data)
        return tag_key(options) == key[-1]

    def is_scalar(self, key: Key, data: Mapping[str, Any]) -> bool:
        """Whether key holds a value rather than a table."""
        return not self.options(key, data)

    def meaning(self, key: Key, data: Mapping[str, Any]) -> str:
        """The description of the key at its place, or nothing."""
        model = self.model(key[:-1], data)
        field = model.model_fields.get(key[-1]) if model else None
        return field.description or "" if field is not None else ""

    def key(self, loc: Sequence[int | str], data: Mapping[str, Any]) -> Key:
        """The key in the file of a place where pydantic found an error.

        Pydantic puts the tag of a union between the table and the key, and the place in an array after it.
        """
        kept: Key = ()
        tag_follows = False
        for part in loc:
            if tag_follows or part == "[key]" or isinstance(part, int):
                tag_follows = False
                continue
            kept = (*kept, part)
            tag_follows = len(self.options(kept, data)) > 1
        return kept


def tag_key(models: Sequence[type[BaseModel]]) -> str | None:
    """The key that tells the models of a union apart, or None."""
    return next(
        (name for name in ("kind", "rule") if any(name in model.model_fields for model in models)), None
    )


def _options(model: type[BaseModel], name: str) -> list[type[BaseModel]]:
    return list(_models_in(model.model_fields[name].rebuild_annotation()))


def _choose(options: list[type[BaseModel]], table: Any) -> type[BaseModel] | None:
    if not options:
        return None
    tag = tag_key(options)
    given = table.get(tag) if tag and isinstance(table, Mapping) else None
    for option in options:
        if tag and given in _literals(option, tag):
            return option
    if isinstance(given, str) and tag and (others := [one for one in options if not _literals(one, tag)]):
        return others[0]
    builder = isinstance(table, Mapping) and "builder" in table
    for option in options:
        if ("builder" in option.model_fields) == builder:
            return option
    return options[0]


def _literals(model: type[BaseModel], name: str) -> tuple[Any, ...]:
    annotation = model.model_fields[name].annotation if name in model.model_fields else None
    return typing.get_args(annotation) if typing.get_origin(annotation) is Literal else ()


def _models_in(annotation: Any) -> Iterable[type[BaseModel]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        if issubclass(annotation, BaseModel):
            yield annotation
        return
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)


# --- messages -----------------------------------------------------------------------------------------

_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": 'text in "quotes"',
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "tuple_type": "an array",
    "finite_number": "a finite number",
}
_BOUNDS = {
    "greater_than": ("gt", "above"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "below"),
    "less_than_equal": ("le", "at most"),
}


def explain(
    error: ValidationError,
    data: Mapping[str, Any],
    text: str,
    where: str | Path,
    overridden: Iterable[Key],
    grammar: Grammar,
) -> InputError:
    """One line for the most telling of pydantic's errors.

    Args:
        error: what pydantic refused.
        data: the tables as read, overrides included.
        text: the file's text, to find line numbers in.
        where: the file.
        overridden: keys that came from overrides rather than from the file.
        grammar: the tables that such a file may hold.
    """
    details = error.errors(include_url=False)
    # a misspelled key is also a missing one: name the misspelling
    details.sort(key=lambda detail: detail["type"] != "extra_forbidden")
    detail = details[0]
    key = grammar.key(detail["loc"], data)
    if detail["type"] == "union_tag_invalid":
        key = (*key, _tag(detail))
    if detail["type"] == "value_error" and not key:
        named = re.search(r"\[(\w+)\]", detail["msg"])
        key = (named[1],) if named and named[1] in data else ()
    message, remedy = _sentence(detail, key, data, grammar)
    if len(details) > 1:
        others = len(details) - 1
        remedy += "" if remedy.endswith((".", "?")) else "."
        remedy = f"{remedy} {others} more {'problem follows' if others == 1 else 'problems follow'}"
    return InputError(message, remedy=remedy, where=place(key, text, where, overridden))


def place(key: Key, text: str, where: str | Path, overridden: Iterable[Key] = ()) -> str:
    """The file with line, or the override, that a key came from."""
    if any(key[: len(given)] == given for given in overridden):
        return f"--set {'.'.join(key)}"
    number = line_of(text, key) if key else None
    if number:
        return f"{where}:{number}"
    # a whole table that only overrides mention
    given = next((given for given in overridden if key and given[: len(key)] == key), None)
    return f"--set {'.'.join(given)}" if given else str(where)


def _tag(detail: Mapping[str, Any]) -> str:
    # pydantic quotes the name of the key that tells kinds apart
    key = str(detail.get("ctx", {}).get("discriminator", "kind")).strip("'")
    return key if key.isidentifier() else "kind"


def _sentence(
    detail: Mapping[str, Any], key: Key, data: Mapping[str, Any], grammar: Grammar
) -> tuple[str, str]:
    kind = str(detail["type"])
    name = ".".join(key)
    last = key[-1] if key else ""
    seen = detail["input"]
    context = detail.get("ctx", {})

    def meaning(form: str) -> str:
        said = grammar.meaning(key, data)
        return form.format(said) if said else ""

    if kind == "extra_forbidden":
        known = grammar.known_keys(key[:-1], data)
        near = nearest(last, known)
        table = f"[{'.'.join(key[:-1])}]" if len(key) > 1 else "a system file"
        remedy = f"Did you mean {near}?" if near else f"Known keys are {', '.join(known)}."
        return f"unknown key {last!r} in {table}", remedy
    if kind == "missing":
        owner = f"[{'.'.join(key[:-1])}]" if len(key) > 1 else "the system file"
        if not grammar.is_scalar(key, data):
            return f"table [{name}] missing", f"Add a [{name}] table."
        return f"key {last!r} missing in {owner}", f"Add `{last} = ...`" + meaning(" ({})")
    if kind == "union_tag_not_found":
        tag = _tag(detail)
        return f"key {tag!r} missing in [{name}]", f"Known {tag}s are {', '.join(grammar.kinds(key, data))}."
    if kind in ("union_tag_invalid", "unknown_name"):
        kinds = context.get("known") or grammar.kinds(key[:-1], data)
        given = str(context.get("tag", seen))
        near = nearest(given, kinds)
        remedy = f"Did you mean {near}? " if near else ""
        return (
            f"unknown {'.'.join(key[:-1])} {last} {given!r}",
            f"{remedy}Known {last}s are {', '.join(kinds)}.",
        )
    if kind == "literal_error":
        options = str(context["expected"]).replace("'", '"')
        return f"{name} = {_show(seen)}; expected {options}", meaning(f"{last}: {{}}")
    if kind in _BOUNDS:
        limit, word = _BOUNDS[kind]
        return f"{name} = {_show(seen)}; expected a number {word} {context[limit]:.15g}", meaning(
            f"{last}: {{}}"
        )
    if kind in ("too_short", "too_long", "missing_positional_only_argument"):
        return f"{name} = {_show(seen)}; expected three values", "Give one for each of x, y and z."
    if kind == "value_error":
        said = str(detail["msg"]).removeprefix("Value error, ")
        return said if "[" in said else f"[{name}]: {said}", ""
    expected = _EXPECTED.get(kind)
    if expected:
        quoted = isinstance(seen, str) and "number" in expected and _is_number(seen)
        return (
            f"{name} = {_show(seen)}; expected {expected}",
            "Leave out the quotes" if quoted else f"Correct {name}",
        )
    return f"{name} = {_show(seen)}: {detail['msg']}", f"Correct {name}."


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    return f'"{value}"' if isinstance(value, str) else repr(value)


# --- overrides ----------------------------------------------------------------------------------------

_RIVALS: dict[toml.Key, tuple[str, ...]] = {
    # what the command line says replaces the file's other way of saying it
    ("cutoff", "radius"): ("in_sigma", "pairs"),
    ("cutoff", "in_sigma"): ("radius", "pairs"),
    ("structure", "file"): ("builder",),
    ("structure", "builder"): ("file",),
    ("start", "height"): ("boundary",),
    ("start", "spread"): ("spread_ulps",),
    ("start", "spread_ulps"): ("spread",),
}


def read_overrides(overrides: Mapping[str, Any] | None) -> dict[toml.Key, Any]:
    """Dotted keys to values; text is read as TOML would read it.

    Raises:
        InputError: a key that is none.
    """
    changes = {toml.dotted(key): value for key, value in (overrides or {}).items()}
    return {key: toml.scalar(value) if isinstance(value, str) else value for key, value in changes.items()}


def apply_overrides(data: dict[str, Any], values: Mapping[toml.Key, Any], grammar: Grammar) -> None:
    """Put values into the tables, and drop the keys of another kind than the one they choose.

    Raises:
        InputError: a key below one that is a value and no table.
    """
    for key, value in values.items():
        _override(data, key, value)
    for key in values:
        _drop_foreign_keys(data, key, values, grammar)


def _override(data: dict[str, Any], key: toml.Key, value: Any) -> None:
    table = data
    for depth, part in enumerate(key[:-1]):
        inner = table.setdefault(part, {})
        if not isinstance(inner, dict):
            raise InputError(
                f"{'.'.join(key[: depth + 1])} is a value and not a table",
                where=f"--set {'.'.join(key)}",
                remedy=f"Set {'.'.join(key[: depth + 1])} itself",
            )
        table = inner
    table[key[-1]] = value


def _drop_foreign_keys(
    data: dict[str, Any], key: toml.Key, values: Mapping[toml.Key, Any], grammar: Grammar
) -> None:
    path = key[:-1]
    table: Any = data
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    if not path or not isinstance(table, dict):
        return
    foreign = set(_RIVALS.get(key, ()))
    if {"radius", "in_sigma"} & foreign & set(table):
        # the onset was in the unit of the radius that goes
        foreign.add("onset")
    if grammar.is_tag(key, data) or key in (("structure", "file"), ("structure", "builder")):
        rest = {
            **data,
            path[0]: {name: value for name, value in data[path[0]].items() if name not in foreign},
        }
        foreign |= grammar.foreign_keys(path, rest)
    for name in foreign & set(table):
        if not any(given[: len(path) + 1] == (*path, name) for given in values):
            del table[name]
