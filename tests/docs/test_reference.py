"""The reference of the site has an entry for everything that the package declares.

What there should be is found here without the code that makes the pages: codes and columns in the text files,
options in what `--help` prints, keys in the system files that are shipped and in the schema as text.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest
from command_line import call
from programs import module_of

import mdnum

ROOT = Path(__file__).parents[2]
VERBS = sorted((ROOT / "mdnum" / "verbs").glob("*.toml"))


@pytest.fixture(scope="module")
def reference():
    """The maker of the pages, an extension of Sphinx that needs none of it."""
    return module_of("docs/_ext/reference.py")


@pytest.fixture(scope="module")
def pages(reference, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site") / "reference"
    reference.write(folder)
    return {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.md")}


def row(page: str, name: str) -> list[str]:
    """Cells of the first row of a table that begins with a name in code."""
    found = re.search(rf"^\| `{re.escape(name)}` \|(.*)\|$", page, re.MULTILINE)
    assert found, name
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", found[1])]


def test_every_finding_has_its_entry_with_a_severity_and_a_sentence(pages):
    page, codes = pages["findings"].replace("\\_", "_"), 0
    for path in VERBS:
        verb = path.stem.replace("_", "-")
        verb = {"demos": "ball-demos"}.get(verb, verb)
        for code, severity in re.findall(
            r'^\[([A-Z][A-Z0-9_]+)\]\n(?:#.*\n)*severity = "(\w+)"', path.read_text(), re.MULTILINE
        ):
            codes += 1
            entry = page.partition(f"({verb}-{code.lower().replace('_', '-')})=\n### {code}\n")[2]
            assert entry.lstrip().startswith(f"**{severity}**:"), f"{path.stem} {code}"
    assert codes > 180
    # a remedy is shown, and what a field holds is a word
    assert "Increase the skin (neighbors.skin)" in page
    assert not re.search(r"\{\w+", page)
    # a field that holds whole sentences shows these
    bare = r"^(?:- |\*[A-Z][a-z ]+\.\* |\*\*[a-z]+\*\*: )?\*[\w ]+\*\.?$"
    assert re.findall(bare, page, re.MULTILINE) == []
    assert not re.search(r"\*(?:seen|also|away|notes)\*", page)
    assert re.search(bare, "*What was seen.* *seen*")


def test_every_command_and_option_has_its_entry(pages, capsys):
    page, seen = pages["commands"], 0
    assert call("--help") == 0
    verbs = re.findall(r"^  ([a-z]+)  ", capsys.readouterr().out.partition("and exit.\n")[2], re.MULTILINE)
    assert {"run", "fork", "sweep", "doctor"} <= {*verbs}
    for verb in verbs:
        assert call(verb, "--help") == 0
        said = capsys.readouterr().out
        questions = re.findall(r"^  ([a-z]+)  ", said.partition("Commands:")[2], re.MULTILINE)
        for name in [verb, *(f"{verb} {question}" for question in questions)]:
            section = re.search(rf"^#+ mdnum {name}$(.*?)(?=^\(command-|\Z)", page, re.MULTILINE | re.DOTALL)
            assert section, name
            if " " in name:
                assert call(*name.split(), "--help") == 0
                said = capsys.readouterr().out
            elif questions:
                continue
            for option in set(re.findall(r"(?<![\w`-])--[a-z][a-z-]*", said.partition("Options:")[2])):
                if option != "--help":
                    assert option in section[1], f"{name} {option}"
                    seen += 1
    assert seen > 150


def test_every_key_of_a_system_file_has_its_entry_with_unit_and_default(pages):
    page, keys = pages["keys"], set()

    def collect(table):
        for key, value in table.items():
            keys.add(key)
            if isinstance(value, dict) and key not in (
                "pairs",
                "masses",
                "weight",
                "parameters",
                "terms",
                "variants",
            ):
                collect(value)

    for path in (ROOT / "systems").rglob("*.toml"):
        collect(tomllib.loads(path.read_text(encoding="utf-8")))
    assert len(keys) > 40
    for schema in ("schema.json", "ball-schema.json"):
        whole = json.loads((ROOT / "systems" / schema).read_text(encoding="utf-8"))
        keys |= {key for table in (whole, *whole["$defs"].values()) for key in table.get("properties", {})}
    for key in keys:
        row(page, key)
    assert row(page, "timestep")[:3] == ["number > 0", "ps or τ", "required"]
    assert row(page, "relaxation")[1] == "ps or τ"
    assert row(page, "compare")[2] == '`"r2 <"`'


def test_every_column_has_its_entry(pages):
    page, columns = pages["columns"], 0
    for path in VERBS:
        for kind, said in tomllib.loads(path.read_text(encoding="utf-8")).get("kinds", {}).items():
            for table, names in said.get("tables", {}).items():
                section = page.partition(f"### {kind}: {table.rstrip('?')}.parquet\n")[2].partition("\n##")[0]
                assert section, f"{kind} {table}"
                for name in names.split() if isinstance(names, str) else names:
                    word = re.split(r"[:=?]", name)[0]
                    if re.fullmatch(r"\w+", word):
                        columns += 1
                        assert row(section, word)[-1], f"{kind} {table} {word}"
    assert columns > 150
    assert row(page.partition("### md: epochs.parquet")[2], "displacement")[0] == "length"


def test_every_document_has_its_entry(pages):
    kinds = [path.stem for path in (ROOT / "mdnum" / "schemas").glob("*.json")]
    assert len(kinds) > 25
    for kind in kinds:
        assert f"\n## mdnum/{kind}/1\n" in pages["documents"]


def test_every_public_name_has_its_entry(pages):
    for name in mdnum.__all__:
        value = getattr(mdnum, name)
        if inspect.isclass(value) or inspect.isroutine(value):
            assert f"### mdnum.{name}\n" in pages["python"]
            assert f":: {value.__module__}.{value.__qualname__}\n" in pages["python"]


def test_every_registry_that_people_write_names_of_is_there(reference, pages):
    for _, place, _ in reference.REGISTRIES:
        module, _, attribute = place.partition(":")
        registry = getattr(sys.modules[module], attribute)
        for name in registry.shipped:
            assert row(pages["names"], name)[0], name
