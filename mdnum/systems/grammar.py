"""What a pydantic model allows at a dotted key, given the kinds that the data names.

A table whose keys depend on its kind is a union of models told apart by a key such as `kind` or `rule`;
the functions here follow a key through such unions, for messages and for overrides.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel

from mdnum.systems.toml import Key


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
        return of_any - set(self.known_keys(key, data))

    def is_tag(self, key: Key, data: Mapping[str, Any]) -> bool:
        """Whether key is what tells the kinds of its table apart."""
        options = self.options(key[:-1], data)
        return len(options) > 1 and tag_key(options) == key[-1]

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
