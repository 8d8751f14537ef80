"""Write mdnum/schemas/*.json, the JSON Schemas of the documents of `--json` and summary.json.

Kinds of documents are declared in make_schemas.toml.
`--check` compares instead of writing.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

DECLARED = Path(__file__).with_suffix(".toml")
SCHEMAS = Path(__file__).resolve().parents[2] / "mdnum/schemas"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: The common schema of answers, for kinds of folders whose package has none of its own.
COMMON = "answer"


class Words:
    """Reads the types of make_schemas.toml.

    Args:
        text: words NAME:TYPE, or NAME?:TYPE of a key that may be missing.
        records: types by their names in capitals.
    """

    def __init__(self, text: str, records: dict[str, str]):
        self.tokens = re.findall(r"[\w*-]+\??(?=:)|[A-Za-z_]+|\S", text)
        self.records = records

    def next(self, *expected: str) -> str:
        """The next token, which must be one of those expected where any are."""
        token = self.tokens.pop(0) if self.tokens else ""
        if expected and token not in expected:
            raise ValueError(
                f"{token!r} before {' '.join(self.tokens)[:60]!r}; expected {' or '.join(expected)}"
            )
        return token

    def keys(self, end: str = "") -> dict[str, Any]:
        """An object with these keys; others are allowed, so that keys can be added."""
        made: dict[str, Any] = {"type": "object", "properties": {}, "required": []}
        while self.tokens and self.tokens[0] != end:
            name = self.next()
            self.next(":")
            if name == "*":
                made["additionalProperties"] = self.type()
                continue
            made["properties"][name.rstrip("?")] = self.type()
            made["required"] += [] if name.endswith("?") else [name]
        if end:
            self.next(end)
        return made

    def type(self) -> dict[str, Any]:
        """A value; what is not known or not finite is null."""
        made = self.bare()
        if "anyOf" in made:
            return {"anyOf": [*made["anyOf"], {"type": "null"}]}
        kinds = made.get("type", [])
        return {**made, "type": [*([kinds] if isinstance(kinds, str) else kinds), "null"]} if made else {}

    def bare(self) -> dict[str, Any]:
        """A value of one of several types, which is not null."""
        kinds = [self.one()]
        while self.tokens and self.tokens[0] == "|":
            self.next()
            kinds.append(self.one())
        if len(kinds) == 1:
            return kinds[0]
        plain = all(kind.keys() == {"type"} for kind in kinds)
        return {"type": [kind["type"] for kind in kinds]} if plain else {"anyOf": kinds}

    def one(self) -> dict[str, Any]:
        """A value of one type."""
        token = self.next()
        if token == "{":
            return self.keys("}")
        if token == "[":
            made = {"type": "array", "items": self.type()}
            self.next("]")
            return made
        if token == "<":
            made = {"type": "object", "additionalProperties": self.type()}
            self.next(">")
            return made
        if token in self.records:
            return Words(self.records[token], self.records).bare()
        if token not in ("any", "string", "integer", "number", "boolean"):
            raise ValueError(f"{token!r} is no type")
        return {} if token == "any" else {"type": token}


def schema(kind: str, declared: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
    """The schema of a kind of document."""
    records = shared["records"]
    keys = Words(declared.get("keys", ""), records).keys()
    common = kind == COMMON
    head: dict[str, Any] = {
        "schema": {"type": "string"} if common else {"const": f"mdnum/{kind}/1"},
        "kind": {"type": "string"} if common else {"const": kind},
    }
    if declared.get("answer", True):
        findings = {"type": "array", "items": {"$ref": "#/$defs/finding"}}
        head |= {
            "status": {"enum": shared["status"].split()}, "seconds": {"type": ["number", "null"]},
            "headline": {"type": "string"}, "verdict": {"type": "string"}, "findings": findings,
        }  # fmt: skip
    # where it is printed; what summary.json holds lies in it
    folder = {"folder": {"type": "string"}} if declared.get("folder", True) else {}
    finding = Words(shared["finding"], records).keys()
    measured = {"type": "object", "required": ["value", "unit", "floor"]}
    finding["properties"] |= {
        "severity": {"enum": ["info", "warning", "error"]},
        # a number with a unit and a floor is a "measured"
        "values": {
            "type": "object",
            "additionalProperties": {"if": measured, "then": {"$ref": "#/$defs/measured"}},
        },
    }
    made: dict[str, Any] = {
        "$schema": DIALECT, "$id": f"mdnum/{kind}/1", "title": declared["about"], "type": "object",
        "properties": {**head, **keys["properties"], **folder}, "required": [*head],
    }  # fmt: skip
    if declared.get("open"):
        made["additionalProperties"] = {}
    if "status" not in head:
        return made | {"required": [*head, *keys["required"]]}
    if keys["required"]:
        # a run that was killed is judged as far as it came
        unfinished = {"properties": {"status": {"const": "unfinished"}}}
        made |= {"if": unfinished, "else": {"required": keys["required"]}}
    return made | {"$defs": {"finding": finding, "measured": Words(shared["measured"], records).keys()}}


def made() -> dict[str, str]:
    """Text by name of file."""
    kinds = tomllib.loads(DECLARED.read_text(encoding="utf-8"))
    shared = kinds.pop("shared")
    return {
        f"{kind}.json": json.dumps(schema(kind, declared, shared), indent=1, ensure_ascii=False) + "\n"
        for kind, declared in kinds.items()
    }


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    texts, check = made(), parser.parse_args().check
    there = {path.name: path.read_text(encoding="utf-8") for path in SCHEMAS.glob("*.json")}
    odd = sorted(name for name in texts.keys() | there.keys() if texts.get(name) != there.get(name))
    if not check:
        SCHEMAS.mkdir(exist_ok=True)
        for name in odd:
            (SCHEMAS / name).unlink(missing_ok=True)
            if name in texts:
                (SCHEMAS / name).write_text(texts[name], encoding="utf-8")
    print("\n".join(odd) or "nothing changed")
    return int(check and bool(odd))


if __name__ == "__main__":
    sys.exit(main())
