"""Commands of mdnum, called verbs. Each verb is a module here and a function of `mdnum`.

A verb is declared in its module (see `mdnum.verbs.frame`) and in the text file of the same name.
`__init__.toml` explains the text files. No other file lists the commands or the kinds of output folders. The
module of a verb is imported when the verb is first used.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mdnum.errors import InputError
from mdnum.plain import beside
from mdnum.registry import Registry


def _check(module: Any) -> None:
    """Raise an error if a verb of another package lacks a declared function."""
    from mdnum.store import Layout

    texts, name = beside(module.__file__), module.__name__
    commands = [*texts.get("commands", {}).values(), *filter(None, [texts.get("command")])]
    calls = [one["calls"] for one in commands]
    if lacking := [one for one in calls if not callable(getattr(module, one, None))]:
        raise TypeError(f"the module {name} has no function {lacking[0]}, which its .toml file names")
    if {*texts.get("kinds", ())} != {*getattr(module, "KINDS", ())}:
        raise TypeError(f"KINDS of {name} are not the kinds of folders that its .toml file lists")
    for kind, said in texts.get("kinds", {}).items():
        Layout(kind, **said)
        if VERBS.place(home(kind)) != name:
            raise ValueError(f"folders of kind {kind!r} are already written by mdnum or another package")


#: Modules by command, with the subcommand if a command has several.
VERBS: Registry[Any] = Registry("verb", "mdnum.verbs", check=_check)
for _name in (
    "run", "systems", "report", "fork", "sweep", "grad", "flips", "audit", "conform", "check", "doctor",
    "ball",
):  # fmt: skip
    VERBS.add(_name, f"mdnum.verbs.{_name}")
VERBS.add("ball demos", "mdnum.verbs.demos")
VERBS.add("flips compare", "mdnum.verbs.flips_compare")
VERBS.add("fork map", "mdnum.verbs.fork_map")
VERBS.add("fork certify", "mdnum.verbs.fork_certify")


#: "status" in summary.json if the time limit was reached: after enough tests for a verdict, or before. Other
#: values are "complete" and the names of other ends ("failed", "stopped").
PARTIAL, UNDECIDED = "partial", "undecided"


@dataclass(frozen=True)
class Reply:
    """Result of a command that prints its result and makes no folder."""

    document: Mapping[str, Any]  # for JSON
    # for people: lines, findings, and tables of a title, columns and rows, or of a title and records
    shown: Sequence[Any]
    status: str = "complete"  # as in summary.json


def assigned(text: str, example: str) -> tuple[str, str]:
    """Split the text "key=value" into key and value.

    Raises:
        InputError: the text is not of the form key=value; the message shows `example`.
    """
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not key:
        seen = f"{example.split()[0]} {text!r} is not of the form key=value"
        raise InputError(seen, remedy=f"Write for example {example}")
    return key, value


def declared(name: str) -> Mapping[str, Any]:
    """Return the content of the text file of a verb.

    Raises:
        InputError: the package that defines the verb has no text file.
    """
    return beside(_file(name))


def home(kind: str) -> str:
    """Return the verb that declares a kind of output folder.

    Raises:
        InputError: no installed verb declares the kind.
    """
    # a text file without that heading need not be parsed
    heading = re.compile(rf"^\[kinds\.{re.escape(kind)}[].]", re.MULTILINE)
    for name in VERBS:
        # a package that is broken is not the one that is looked for
        with contextlib.suppress(InputError):
            if heading.search(Path(_file(name)).with_suffix(".toml").read_text(encoding="utf-8")):
                return name
    raise InputError(
        f"no installed package writes folders of kind {kind!r}",
        remedy="Install the package that wrote the folder",
    )


def schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of document. The default is the schema of answer.json.

    Raises:
        InputError: no installed verb makes such documents.
    """
    shipped = Path(__file__).parents[1] / "schemas"
    file = shipped / f"{kind}.json"
    if not file.exists():
        name = home(kind)
        own = declared(name).get("schemas", {}).get(kind)
        file = Path(_file(name)).with_name(own) if own else shipped / "answer.json"
    return json.loads(file.read_text(encoding="utf-8"))


def _file(name: str) -> str:
    """Return the path of a module's file without importing the module."""
    first, *rest = VERBS.place(name).split(".")
    spec = importlib.util.find_spec(first)
    places = [] if spec is None else spec.submodule_search_locations or [str(Path(str(spec.origin)).parent)]
    parts = rest or [first]
    files = [Path(place, *parts).with_suffix(".py") for place in places]
    found = next((file for file in files if file.with_suffix(".toml").is_file()), None)
    if found is None:
        seen = f"{VERBS.noun} {name!r} of package {VERBS.package(name)} has no text file"
        raise InputError(seen, remedy=f"Add the file {parts[-1]}.toml next to {parts[-1]}.py")
    return str(found)
