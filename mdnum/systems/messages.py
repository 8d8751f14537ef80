"""From pydantic's refusals to one line a person understands: what was seen, what was expected, where."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from mdnum.errors import InputError
from mdnum.systems import schema
from mdnum.systems.toml import Key, line_of

TAGGED = ("structure", "potential", "cutoff", "dynamics")

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


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word most like this one, or None when none is like it."""
    options = list(known)
    folded = {option.lower(): option for option in options}
    close = difflib.get_close_matches(word.lower(), list(folded), n=1, cutoff=0.6)
    return folded[close[0]] if close else None


def explain(
    error: ValidationError, data: Mapping[str, Any], text: str, where: str | Path, overridden: Iterable[Key]
) -> InputError:
    """One line for the most telling of pydantic's errors.

    Args:
        error: what pydantic refused.
        data: the tables as read, overrides included.
        text: the file's text, to find line numbers in.
        where: the file.
        overridden: keys that came from overrides rather than from the file.
    """
    details = error.errors(include_url=False)
    # a misspelled key is also a missing one: name the misspelling
    details.sort(key=lambda detail: detail["type"] != "extra_forbidden")
    detail = details[0]
    key = _key(detail["loc"], data)
    if detail["type"] == "union_tag_invalid":
        key = (*key, "kind")
    if detail["type"] == "value_error" and not key and "[cutoff]" in detail["msg"]:
        key = ("cutoff",)
    message, remedy = _sentence(detail, key, data)
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


def _key(loc: tuple[int | str, ...], data: Mapping[str, Any]) -> Key:
    # pydantic puts the tag of a union between the table and the key
    parts = [part for part in loc if part != "[key]"]
    if len(parts) > 1 and parts[0] in TAGGED:
        del parts[1]
    return tuple(str(part) for part in parts)


def _sentence(detail: Mapping[str, Any], key: Key, data: Mapping[str, Any]) -> tuple[str, str]:
    kind = str(detail["type"])
    name = ".".join(key)
    last = key[-1] if key else ""
    seen = detail["input"]
    context = detail.get("ctx", {})
    if kind == "extra_forbidden":
        known = known_keys(key[:-1], data)
        near = nearest(last, known)
        table = f"[{'.'.join(key[:-1])}]" if len(key) > 1 else "a system file"
        remedy = f"Did you mean {near}?" if near else f"Known keys are {', '.join(known)}."
        return f"unknown key {last!r} in {table}", remedy
    if kind == "missing":
        owner = f"[{'.'.join(key[:-1])}]" if len(key) > 1 else "the system file"
        if not _is_scalar(key, data):
            return f"table [{name}] missing", f"Add a [{name}] table."
        return f"key {last!r} missing in {owner}", f"Add `{last} = ...`" + _meaning(key, data, " ({})")
    if kind == "union_tag_not_found":
        kinds = _kinds(key[0])
        return f"key 'kind' missing in [{name}]", f"Known kinds are {', '.join(kinds)}."
    if kind == "union_tag_invalid":
        kinds = _kinds(key[0])
        given = str(context.get("tag"))
        near = nearest(given, kinds)
        remedy = f"Did you mean {near}? " if near else ""
        return f"unknown {key[0]} kind {given!r}", f"{remedy}Known kinds are {', '.join(kinds)}."
    if kind == "literal_error":
        options = str(context["expected"]).replace("'", '"')
        return f"{name} = {_show(seen)}; expected {options}", _meaning(key, data, f"{last}: {{}}")
    if kind in ("greater_than", "greater_than_equal"):
        bound = f"above {context['gt']:g}" if kind == "greater_than" else f"at least {context['ge']:g}"
        return f"{name} = {_show(seen)}; expected a number {bound}", _meaning(key, data, f"{last}: {{}}")
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


def _model(key: Key, data: Mapping[str, Any]) -> type[BaseModel] | None:
    """The model of the table at key, given the kinds the data names; None where a table has free keys."""
    model: type[BaseModel] | None = schema.SystemSpec
    table: Any = data
    for part in key:
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
        if model is None or part not in model.model_fields:
            # pairs."Ni-P": the table of one pair
            continue
        options = list(_models_in(model.model_fields[part].rebuild_annotation()))
        model = _choose(options, table)
    return model


def _choose(options: list[type[BaseModel]], table: Any) -> type[BaseModel] | None:
    if not options:
        return None
    given = table.get("kind") if isinstance(table, Mapping) else None
    for option in options:
        if "kind" in option.model_fields and given in typing.get_args(option.model_fields["kind"].annotation):
            return option
    builder = isinstance(table, Mapping) and "builder" in table
    for option in options:
        if ("builder" in option.model_fields) == builder:
            return option
    return options[0]


def _models_in(annotation: Any) -> Iterable[type[BaseModel]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        if issubclass(annotation, BaseModel):
            yield annotation
        return
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)


def known_keys(key: Key, data: Mapping[str, Any]) -> list[str]:
    """Keys that the table at key may hold, given the kinds the data names."""
    model = _model(key, data)
    return sorted(model.model_fields, key=lambda name: name != "kind") if model else []


def keys_of_any_kind(table: str) -> set[str]:
    """Keys that some kind of this table has."""
    field = schema.SystemSpec.model_fields[table]
    return {key for model in _models_in(field.rebuild_annotation()) for key in model.model_fields}


def _kinds(table: str) -> list[str]:
    field = schema.SystemSpec.model_fields[table]
    return [
        kind
        for model in _models_in(field.rebuild_annotation())
        for kind in typing.get_args(model.model_fields["kind"].annotation)
    ]


def _is_scalar(key: Key, data: Mapping[str, Any]) -> bool:
    model = _model(key[:-1], data)
    field = model.model_fields.get(key[-1]) if model else None
    return field is None or not list(_models_in(field.rebuild_annotation()))


def _meaning(key: Key, data: Mapping[str, Any], form: str) -> str:
    model = _model(key[:-1], data)
    field = model.model_fields.get(key[-1]) if model else None
    return form.format(field.description) if field is not None and field.description else ""
