"""Measure the numbers that documents quote, and fill them in.

    python scripts/makers/measure_documents.py            fill the pages from docs/measured/*.json
    python scripts/makers/measure_documents.py NAME ...   run these commands first, or `all`
    python scripts/makers/measure_documents.py --check    exit with 1 if a page is not current, 2 if one
                                                          quotes a number older than the code

docs/measured.toml has the commands. A record keeps what was quoted with processor, version of jax, day,
commit and a digest of the code that it measures; those of other processors and settings stay beside it. A
number is old when today's code has another digest; comments and docstrings do not count.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
from _pages import ROOT, markdown

DECLARED = ROOT / "docs" / "measured.toml"
RECORDS = ROOT / "docs" / "measured"
RAW = argparse.RawDescriptionHelpFormatter
_VALUE = re.compile(r"(<!--=([\w-]+) (\w+)-->).*?(<!--=-->)", re.DOTALL)
_TABLE = re.compile(r"(<!--table ([\w-]+) ([\w ]+)-->).*?(<!--table-->)", re.DOTALL)


def declared(path: Path = DECLARED) -> dict[str, dict[str, Any]]:
    """What is measured, by name."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def records(name: str, folder: Path = RECORDS) -> list[dict[str, Any]]:
    """Those of a name, the newest last; none where it was not measured."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []


def digest(places: list[str], root: Path = ROOT) -> str:
    """Of the code in some files and folders, without comments and docstrings."""
    whole = hashlib.sha256()
    for place in places:
        paths = sorted((root / place).rglob("*.py")) if (root / place).is_dir() else [root / place]
        for path in paths:
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".py":
                tree = ast.parse(text)
                for node in ast.walk(tree):
                    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
                    if isinstance(node, kinds) and ast.get_docstring(node, clean=False) is not None:
                        node.body = node.body[1:]
                text = ast.dump(tree)
            whole.update(f"{path.relative_to(root)}\n{text}\n".encode())
    return whole.hexdigest()[:16]


def measure(name: str, said: Mapping[str, Any]) -> None:
    """Run a command in each of its settings, and keep what is quoted of its answer."""
    from mdnum.provenance import surroundings

    around = surroundings()
    head = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(head, cwd=ROOT, capture_output=True, text=True).stdout
    settings = said.get("settings", {"": {}})
    for setting, environment in settings.items():
        words = shlex.split(said["command"])
        done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, **environment})
        # findings are an answer, too
        if done.returncode not in (0, 1) or not done.stdout.startswith("{"):
            sys.exit(f"{said['command']} ended with {done.returncode}:\n{done.stderr[-2000:]}")
        answer = json.loads(done.stdout)
        known = {
            "setting": setting,
            "cpu": around["cpu"]["model"],
            "jax": around["versions"]["jax"],
            "day": f"{datetime.now(UTC):%Y-%m-%d}",
            "commit": commit.strip(),
            "digest": digest(said["measures"]),
            "values": {key: text.format(**answer) for key, text in said["values"].items()},
        }
        for figure, shown in said.get("figures", {}).items() if setting == next(iter(settings)) else ():
            shutil.copy(Path(answer["folder"]) / "figures" / figure, ROOT / "docs" / "figures" / shown)
        same = ("setting", "cpu")
        kept = [one for one in records(name) if any(one[key] != known[key] for key in same)]
        RECORDS.mkdir(exist_ok=True)
        text = json.dumps([*kept, known], indent=1, ensure_ascii=False)
        (RECORDS / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def pages() -> Iterator[Path]:
    """Those that may quote a number."""
    yield ROOT / "README.md"
    yield from (path for path in sorted((ROOT / "docs").rglob("*.md")) if "reference" not in path.parts)


def filled(text: str, said: Mapping[str, Mapping[str, Any]], folder: Path = RECORDS) -> str:
    """A page with its numbers.

    Raises:
        KeyError: it quotes what was not measured.
    """

    def value(match: re.Match[str]) -> str:
        first = next(iter(said[match[2]].get("settings", {"": {}})))
        newest = [one for one in records(match[2], folder) if one["setting"] == first][-1:]
        if not newest:
            raise KeyError(f"{match[2]} was not measured")
        return f"{match[1]}{newest[0]['values'][match[3]]}{match[4]}"

    def table(match: re.Match[str]) -> str:
        columns = match[3].split()
        rows = [[{**one, **one["values"]}[key] for key in columns] for one in records(match[2], folder)]
        if not rows:
            raise KeyError(f"{match[2]} was not measured")
        return f"{match[1]}\n\n{markdown(columns, rows)}\n\n{match[4]}"

    return _TABLE.sub(table, _VALUE.sub(value, text))


def old(said: Mapping[str, Mapping[str, Any]], folder: Path = RECORDS, root: Path = ROOT) -> list[str]:
    """Numbers that are older than the code that they measure, each with its commit and day."""
    return [
        f"{name} ({one['setting'] or 'usual'}, {one['cpu']}): {one['day']}, {one['commit']}"
        for name, entry in said.items()
        for one in records(name, folder)
        if one["digest"] != digest(entry["measures"], root)
    ]


def main() -> None:
    """Measure, fill in, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=RAW)
    parser.add_argument("names", nargs="*", metavar="NAME", help="what to measure, or all")
    parser.add_argument("--check", action="store_true", help="write nothing")
    asked, said = parser.parse_args(), declared()
    for name in said if asked.names == ["all"] else asked.names:
        measure(name, said[name])
    stale = old(said)
    for line in stale:
        print("older than the code that it measures:", line)
    for path in pages():
        text = path.read_text(encoding="utf-8")
        new = filled(text, said)
        if new != text and asked.check:
            sys.exit(f"{path.relative_to(ROOT)} is not current: run scripts/makers/measure_documents.py")
        if new != text:
            path.write_text(new, encoding="utf-8")
    sys.exit(2 if asked.check and stale else 0)


if __name__ == "__main__":
    main()
