"""Writes mdnum/schemas/*.json, JSON Schemas of what `--json` prints and summary.json holds.

Kinds of documents are declared in make_schemas.toml.
`--check` compares instead of writing.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

DECLARED = Path(__file__).with_suffix(".toml")
SCHEMAS = Path(__file__).resolve().parents[2] / "mdnum/schemas"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: What every document has, and what every answer has besides.
HEAD, ANSWER = ("schema", "kind"), ("status", "seconds", "headline", "verdict", "findings")


def of_word(word: str) -> dict[str, Any]:
    """The schema of a value by the word for its type; what is not known or not finite is null."""
    return {} if word == "any" else {"type": [word, "null"]}


def properties(words: str, rows: dict[str, str]) -> dict[str, Any]:
    """The schemas of keys, from words NAME:TYPE."""
    found: dict[str, Any] = {}
    for name, _, word in (each.partition(":") for each in words.split()):
        if word == "rows":
            found[name] = {"type": ["array", "null"], "items": record(rows[name])}
        elif word == "record":
            found[name] = record(rows[name])
        else:
            found[name] = of_word(word)
    return found


def record(words: str) -> dict[str, Any]:
    """An object with these keys and no others."""
    keys = properties(words, {})
    return {"type": "object", "properties": keys, "required": list(keys), "additionalProperties": False}


def schema(kind: str, declared: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
    """The schema of a kind of document."""
    rows = declared.get("rows", {})
    always, sometimes = (properties(declared.get(name, ""), rows) for name in ("keys", "sometimes"))
    head: dict[str, Any] = {"schema": {"const": f"mdnum/{kind}/1"}, "kind": {"const": kind}}
    if declared.get("answer", True):
        findings = {"type": "array", "items": {"$ref": "#/$defs/finding"}}
        head |= {
            "status": {"enum": shared["status"].split()}, "seconds": {"type": ["number", "null"]},
            "headline": {"type": "string"}, "verdict": {"type": "string"}, "findings": findings,
        }  # fmt: skip
    if declared.get("folder", True):
        # where it is printed; what summary.json holds lies in it
        sometimes = {"folder": {"type": "string"}, **sometimes}
    finding = record(shared["finding"])
    finding["properties"] |= {
        "severity": {"enum": ["info", "warning", "error"]},
        # a number with a unit and a floor is a "measured"
        "values": {"type": "object"},
    }
    made: dict[str, Any] = {
        "$schema": DIALECT, "$id": f"mdnum/{kind}/1", "title": declared["about"], "type": "object",
        "properties": {**head, **always, **sometimes}, "required": [*head],
        "additionalProperties": declared.get("open", False),
    }  # fmt: skip
    if "status" not in head:
        return made | {"required": [*head, *always]}
    # a run that was killed is judged as far as it came
    unfinished = {"properties": {"status": {"const": "unfinished"}}}
    made |= {"if": unfinished, "else": {"required": [*always]}}
    measured = {"type": "object", "required": ["value", "unit", "floor"]}
    with_unit = {"if": measured, "then": {"$ref": "#/$defs/measured"}}
    finding["properties"]["values"]["additionalProperties"] = with_unit
    return made | {"$defs": {"finding": finding, "measured": record(shared["measured"])}}


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
