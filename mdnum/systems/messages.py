"""From pydantic's refusals to one line a person understands: what was seen, what was expected, where."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mdnum.errors import InputError
from mdnum.systems.grammar import Grammar
from mdnum.systems.toml import Key, line_of

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
#: Nothing is like a longer word, and to find that out takes minutes.
_LONGEST_WORD = 100
_BOUNDS = {
    "greater_than": ("gt", "above"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "below"),
    "less_than_equal": ("le", "at most"),
}


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word most like this one, or None when none is like it."""
    if len(word) > _LONGEST_WORD:
        return None
    options = list(known)
    folded = {option.lower(): option for option in options}
    close = difflib.get_close_matches(word.lower(), list(folded), n=1, cutoff=0.6)
    return folded[close[0]] if close else None


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
    return str(detail.get("ctx", {}).get("discriminator", "kind")).strip("'")


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
    if kind == "union_tag_invalid":
        kinds = grammar.kinds(key[:-1], data)
        given = str(context.get("tag"))
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
