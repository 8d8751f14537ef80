"""Reading and writing of system files (TOML), with line numbers in errors.

The standard library only reads TOML, without line numbers. This module also writes TOML and finds the line of
a key. If the keys depend on `kind` or `rule`, a table is a union of pydantic models; `models` selects one. An
error message states the value, the expected value and the line of the file.
"""

from __future__ import annotations

import importlib
import json
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError, core_schema

from mdnum.errors import InputError
from mdnum.registry import meant

Key = tuple[str, ...]
#: Name of the system file in a folder.

#: Largest nesting depth of tables and arrays.
_DEEPEST = 20
# what is valid in TOML and acted on by a terminal, or reorders what is read
_UNPRINTED = re.compile("[\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\U000e0000-\U000e007f]")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_PART = re.compile(r"""\s*(?:"((?:[^"\\]|\\.)*)"|'([^']*)'|([A-Za-z0-9_-]+))\s*""")


def parse(text: str, where: str | Path) -> dict[str, Any]:
    """Parse a TOML text into tables.

    Raises:
        InputError: the text is not valid TOML; the message quotes the line.
    """
    try:
        tables = tomllib.loads(text)
        if _is_deep(tables):
            raise RecursionError
        return tables
    except RecursionError:
        raise InputError(
            f"tables or arrays are nested more than {_DEEPEST} deep",
            where=str(where),
            remedy="Nest tables at most three levels deep",
        ) from None
    except ValueError as error:
        seen = str(error)
        match = re.search(r"\(at line (\d+), column (\d+)\)", seen)
        lines = text.splitlines()
        number = int(match.group(1)) if match else max(1, len(lines))
        what = re.sub(r"\s*\(at .*\)$", "", seen)
        line = lines[number - 1].strip() if 0 < number <= len(lines) else ""
        shown = f" in `{line}`" if line else ""
        raise InputError(
            f"this is not valid TOML: {what}{shown}",
            where=f"{where}:{number}",
            remedy='Write text in "double quotes", table names in [brackets] and arrays as [1, 2, 3]',
        ) from None


def scalar(text: str) -> Any:
    """Parse a command-line value as TOML. Invalid TOML is a string.

    `switched` and `"switched"` are equal. `0.5` is a number, `true` a Boolean, `[2, 2]` an array.
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if set(parsed) == {"value"} and not _is_deep(parsed) else text


def _is_deep(value: Any) -> bool:
    """Return True if tables and arrays are nested too deeply."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            item
            for outer in level
            for item in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(item, dict | list)
        ]
        if not level:
            return False
    return True


def dotted(text: str) -> Key:
    """Split a dotted key such as `potential.pairs.Ni-P.sigma` into its parts.

    Raises:
        InputError: the text is not a valid dotted key.
    """
    parts, end = _dotted_prefix(text)
    if not parts or end != len(text):
        raise InputError(
            f"{text!r} is not a key",
            remedy="Write the setting as table.key=value, such as cutoff.radius=8.5",
            where="--set",
        )
    return parts


def _dotted_prefix(text: str) -> tuple[Key, int]:
    parts: list[str] = []
    position = 0
    while match := _PART.match(text, position):
        parts.append(next(group for group in match.groups() if group is not None))
        position = match.end()
        if position >= len(text) or text[position] != ".":
            return tuple(parts), position
        position += 1
    return (), 0


def line_of(text: str, key: Key) -> int | None:
    """Return the line number that sets a key or starts its table. None if there is none."""
    best: tuple[int, int] | None = None
    table: Key = ()
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("["):
            table, _ = _dotted_prefix(stripped.strip("[").split("]")[0])
            found = table
        else:
            parts, end = _dotted_prefix(stripped)
            if not parts or not stripped[end:].startswith("="):
                continue
            found = table + parts
        depth = len(found)
        if depth and key[:depth] == found and (best is None or depth > best[0]):
            best = depth, number
    return best[1] if best else None


def dump(tables: Mapping[str, Any]) -> str:
    """Return the TOML text of nested tables. None is omitted, and floats keep every bit.

    Each table starts with `kind` or `rule`. Scalars come before tables.
    """
    lines: list[str] = []
    _dump_table((), tables, lines)
    return "\n".join(lines).strip() + "\n"


def _dump_table(path: Key, table: Mapping[str, Any], lines: list[str]) -> None:
    ordered = sorted(table.items(), key=lambda item: item[0] not in ("kind", "rule"))
    simple = {k: v for k, v in ordered if v is not None and not isinstance(v, Mapping)}
    nested = {k: v for k, v in ordered if isinstance(v, Mapping)}
    if path and simple:
        lines += ["", f"[{'.'.join(_key(part) for part in path)}]"]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in simple.items()]
    for key, value in nested.items():
        _dump_table((*path, key), value, lines)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # TOML knows the escapes of JSON, and \U for what JSON writes as two halves
    escaped = json.dumps(text, ensure_ascii=False)
    return _UNPRINTED.sub(lambda found: f"\\U{ord(found[0]):08X}", escaped)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + "}"
    raise TypeError(f"{type(value).__name__} cannot be written as TOML")


# --- tables -------------------------------------------------------------------------------------------

Positive, NonNegative = Annotated[float, Field(gt=0)], Annotated[float, Field(ge=0)]
#: TOML has only arrays; strict pydantic would reject a list if a tuple is declared.
from_array = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
#: Smallest magnitude of a nonzero number, because computations square it.
_SMALLEST = 1e-150
_LARGEST_INT = 2**62


def loaded(registry: str) -> Any:
    """Import and return the registry that "module:attribute" refers to."""
    module, _, attribute = registry.partition(":")
    return getattr(importlib.import_module(module), attribute)


class Named:
    """Type annotation for a key whose value must be a name in a registry.

    Args:
        registry: "module:attribute"; imported for the first validation, because the module may be slow to
            import.
        others: further allowed values.
    """

    def __init__(self, registry: str, *others: str):
        self.registry, self.others = registry, others

    def _check(self, value: Any) -> Any:
        if value in self.others or not isinstance(value, str):
            return value
        registry = loaded(self.registry)
        if value.partition(registry.separator)[0] not in registry:
            raise PydanticCustomError("unknown_name", "unknown name", {"known": [*self.others, *registry]})
        try:
            registry.parse(value)
        except InputError as error:
            raise PydanticCustomError("unusable_name", "{said}", {"said": error.message}) from None
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_before_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        registry = loaded(self.registry)
        # an editor offers those shipped, and lets others pass: packages add theirs
        return {
            "anyOf": [{"enum": [*self.others, *registry.shipped]}, {"type": "string"}],
            "description": "; ".join(f"{name}: {registry.description(name)}" for name in registry.shipped),
        }


class TomlTable(BaseModel):
    """Base class of system-file tables: immutable, strictly typed, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_range(self) -> Any:
        for name in type(self).model_fields:
            value = getattr(self, name)
            held = tuple(value.values()) if isinstance(value, Mapping) else value
            for number in held if isinstance(held, tuple) else (held,):
                if not isinstance(number, int | float) or isinstance(number, bool):
                    continue
                if isinstance(number, int) and abs(number) > _LARGEST_INT:
                    raise ValueError(f"{name} = {number}; expected an integer of magnitude at most 2^62")
                # a tolerance is compared and not squared, and what tolerances can be is checked with them
                if number and name != "tol" and not _SMALLEST <= abs(number) <= 1 / _SMALLEST:
                    raise ValueError(
                        f"{name} = {number:g}; expected 0 or a magnitude from {_SMALLEST:g} to "
                        f"{1 / _SMALLEST:g}, so that its square can be represented"
                    )
        return self

    @staticmethod
    def foreign_keys(table: Mapping[str, Any]) -> set[str]:
        """Return the keys of a table that do not apply to its kind."""
        return set()


def unusable(key: str, message: str, remedy: str) -> PydanticCustomError:
    """Create the validation error for a value, with its dotted key."""
    return PydanticCustomError("unusable", "{said}", {"said": message, "remedy": remedy, "key": key})


def models(root: type[TomlTable], key: Key, data: Mapping[str, Any]) -> list[type[TomlTable]]:
    """Return the pydantic models for the table at a key, best match first. Empty if there is no table."""
    found, table = [root], data
    for part in key:
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
        # pairs."Ni-P" is the table of one pair: its key is free
        if found and part in found[0].model_fields:
            found = list(_models_in(found[0].model_fields[part].rebuild_annotation()))
            found.sort(key=lambda model, own=_chosen(found, table): model is not own)
    return found


def _models_in(annotation: Any) -> Iterator[type[TomlTable]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        if issubclass(annotation, TomlTable):
            yield annotation
        return
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)


def _chosen(options: Sequence[type[TomlTable]], table: Any) -> type[TomlTable] | None:
    """Return the pydantic model in a union that fits a table."""
    tag = _tag_of(options)
    given = table.get(tag) if tag and isinstance(table, Mapping) else None
    if tag and isinstance(given, str):
        kinds = {model: _literals(model, tag) for model in options}
        # a model without a list of kinds takes those of other packages
        named = [model for model in options if given in kinds[model]] or [m for m in options if not kinds[m]]
        if named:
            return named[0]
    builder = isinstance(table, Mapping) and "builder" in table
    return next((m for m in options if ("builder" in m.model_fields) == builder), next(iter(options), None))


def _tag_of(options: Sequence[type[TomlTable]]) -> str | None:
    """Return the key ("kind" or "rule") that distinguishes the models, or None."""
    keys = {name for model in options for name in model.model_fields}
    return next((name for name in ("kind", "rule") if name in keys), None)


def _literals(model: type[TomlTable], name: str) -> tuple[Any, ...]:
    annotation = model.model_fields[name].annotation if name in model.model_fields else None
    return typing.get_args(annotation) if typing.get_origin(annotation) is Literal else ()


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables into one table with dotted keys."""
    rows: dict[str, Any] = {}
    for key, value in table.items():
        rows |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return rows


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


@dataclass(frozen=True)
class Source:
    """Text and location of a system file, with the overrides of its keys."""

    name: str  # what the system was called by
    path: Path  # the file
    where: str  # the file, as a message names it
    text: str = ""  # what it holds
    values: Mapping[Key, Any] = field(default_factory=dict)  # overrides, by key

    def place(self, key: Key) -> str:
        """Return the file and line, or the override, that set a key."""
        if any(key[: len(given)] == given for given in self.values):
            return f"--set {'.'.join(key)}"
        number = line_of(self.text, key) if key else None
        if number:
            return f"{self.where}:{number}"
        # a whole table that only overrides mention
        given = next((given for given in self.values if key and given[: len(key)] == key), None)
        return f"--set {'.'.join(given)}" if given else self.where


Root = TypeVar("Root", bound=TomlTable)


def checked(root: type[Root], data: Mapping[str, Any], source: Source) -> Root:
    """Validate the tables of a system file and return its model.

    Raises:
        InputError: the tables are not valid; the message describes the most informative error in one line.
    """
    try:
        return root.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
    # a misspelled key is also a missing one: name the misspelling
    detail = min(details, key=lambda each: each["type"] != "extra_forbidden")
    context = detail.get("ctx", {})
    if detail["type"] == "unusable":
        raise InputError(
            context["said"], remedy=context["remedy"], where=source.place(tuple(context["key"].split(".")))
        )
    key = _place(detail, root, data)
    if detail["type"] == "union_tag_invalid":
        key = (*key, _tag(context))
    if detail["type"] == "value_error" and not key:
        named = re.search(r"\[(\w+)\]", detail["msg"])
        key = (named[1],) if named and named[1] in data else ()
    message, remedy = _sentence(detail, key, root, data)
    others = dict.fromkeys(".".join(_place(one, root, data)) for one in details)
    if others := [one for one in others if one and one != ".".join(key)]:
        remedy += "" if remedy.endswith((".", "?")) else "."
        remedy = f"{remedy} There are also errors in {', '.join(others[:3])}"
    raise InputError(message, remedy=remedy, where=source.place(key))


def _place(detail: Any, root: type[TomlTable], data: Mapping[str, Any]) -> Key:
    """Return the dotted key that a validation error refers to."""
    key: Key = ()
    tag_follows = False
    for part in detail["loc"]:
        # pydantic puts the tag of a union between the table and the key, and the place in an array after it
        if not (tag_follows or part == "[key]" or isinstance(part, int)):
            key = (*key, part)
        tag_follows = not tag_follows and isinstance(part, str) and len(models(root, key, data)) > 1
    return key


def _tag(context: Mapping[str, Any]) -> str:
    # pydantic quotes the name of the key that tells kinds apart
    key = str(context.get("discriminator", "kind")).strip("'")
    return key if key.isidentifier() else "kind"


def _sentence(
    detail: Mapping[str, Any], key: Key, root: type[TomlTable], data: Mapping[str, Any]
) -> tuple[str, str]:
    kind, seen, context = str(detail["type"]), detail["input"], detail.get("ctx", {})
    name, outer, last = ".".join(key), ".".join(key[:-1]), key[-1] if key else ""
    fields = next((model.model_fields for model in models(root, key[:-1], data)), {})
    meaning = (fields[last].description or "") if last in fields else ""

    def kinds(key: Key, tag: str) -> list[str]:
        return [word for model in models(root, key, data) for word in _literals(model, tag)]

    if kind == "extra_forbidden":
        known = sorted(fields, key=lambda name: name not in ("kind", "rule"))
        remedy = meant(last, known).rstrip() or f"Known keys are {', '.join(known)}."
        return f"unknown key {last!r} in {f'[{outer}]' if outer else 'a system file'}", remedy
    if kind == "missing":
        if models(root, key, data):
            return f"table [{name}] missing", f"Add a [{name}] table."
        owner = f"[{outer}]" if outer else "the system file"
        return f"key {last!r} missing in {owner}", f"Add `{last} = ...`" + (meaning and f" ({meaning})")
    if kind == "union_tag_not_found":
        tag = _tag(context)
        return f"key {tag!r} missing in [{name}]", f"Known {tag}s are {', '.join(kinds(key, tag))}."
    if kind in ("union_tag_invalid", "unknown_name"):
        known = context.get("known") or kinds(key[:-1], last)
        given = str(context.get("tag", seen))
        remedy = f"{meant(given, known)}Known {last}s are {', '.join(known)}."
        return f"unknown {outer} {last} {given!r}", remedy
    if kind == "literal_error":
        options = str(context["expected"]).replace("'", '"')
        return f"{name} = {_show(seen)}; expected {options}", meaning and f"{last}: {meaning}"
    if kind in _BOUNDS:
        limit, word = _BOUNDS[kind]
        bound = f"{word} {context[limit]:.15g}"
        return f"{name} = {_show(seen)}; expected a number {bound}", meaning and f"{last}: {meaning}"
    if kind in ("too_short", "too_long", "missing_positional_only_argument"):
        return f"{name} = {_show(seen)}; expected three values", "Give one for each of x, y and z."
    if kind == "value_error":
        said = str(detail["msg"]).removeprefix("Value error, ")
        return said if "[" in said else f"[{name}]: {said}", ""
    if expected := _EXPECTED.get(kind):
        quoted = isinstance(seen, str) and "number" in expected and type(scalar(seen)) in (int, float)
        remedy = "Leave out the quotes" if quoted else f"Correct {name}"
        return f"{name} = {_show(seen)}; expected {expected}", remedy
    return f"{name} = {_show(seen)}: {detail['msg']}", f"Correct {name}."


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    return f'"{value}"' if isinstance(value, str) else repr(value)


# --- overrides ----------------------------------------------------------------------------------------

_RIVALS: dict[Key, tuple[str, ...]] = {
    # what the command line says replaces the file's other way of saying it
    ("cutoff", "radius"): ("in_sigma", "pairs"),
    ("cutoff", "in_sigma"): ("radius", "pairs"),
    ("structure", "file"): ("builder",),
    ("structure", "builder"): ("file",),
    ("start", "height"): ("boundary",),
    ("start", "spread"): ("spread_ulps",),
    ("start", "spread_ulps"): ("spread",),
}


def read_overrides(overrides: Mapping[str, Any] | None) -> dict[Key, Any]:
    """Parse overrides by dotted key. Text is parsed as TOML.

    Raises:
        InputError: a key is not a valid dotted key.
    """
    changes = {dotted(key): value for key, value in (overrides or {}).items()}
    return {key: scalar(value) if isinstance(value, str) else value for key, value in changes.items()}


def apply_overrides(data: dict[str, Any], values: Mapping[Key, Any], root: type[TomlTable]) -> None:
    """Set overrides in the tables. Remove keys that do not apply to an overridden kind.

    Raises:
        InputError: an enclosing key has a value that is not a table.
    """
    for key, value in values.items():
        table = data
        for depth, part in enumerate(key[:-1], 1):
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise InputError(
                    f"{'.'.join(key[:depth])} is a single value, not a table with keys",
                    where=f"--set {'.'.join(key)}",
                    remedy=f"Set the value of {'.'.join(key[:depth])}",
                )
        table[key[-1]] = value
    for key in values:
        _drop_foreign_keys(data, key, values, root)


def _drop_foreign_keys(
    data: dict[str, Any], key: Key, values: Mapping[Key, Any], root: type[TomlTable]
) -> None:
    *path, last = key
    table: Any = data
    for part in path:
        table = table.get(part) if isinstance(table, dict) else None
    if not path or not isinstance(table, dict):
        return

    def drop(names: set[str]) -> None:
        for name in names & set(table):
            if not any(given[: len(key)] == (*path, name) for given in values):
                del table[name]

    rivals = set(_RIVALS.get(key, ()))
    # the onset was in the unit of the radius that goes
    drop(rivals | ({"onset"} if {"radius", "in_sigma"} & rivals & set(table) else set()))
    options = models(root, key[:-1], data)
    if options and (last == _tag_of(options) or (path == ["structure"] and last in ("file", "builder"))):
        known = {name for model in options for name in model.model_fields}
        drop(known - set(options[0].model_fields) | options[0].foreign_keys(table))
