"""The pages of docs/reference, made from what the package declares each time the site is built.

Commands come from the parser, keys of system files from their schemas, findings from the text files of verbs,
columns from `mdnum/store`, documents from `mdnum/schemas`, names from the registries, Python from docstrings.
So a page cannot miss what the package has, nor keep what it no longer has.
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

#: Registries in the order of the page: title, where it is, what is written where a name of it stands.
REGISTRIES = (
    ("Cutoffs", "mdnum.md.cutoffs:CUTOFFS", "`cutoff.kind`, `mdnum.Cut`"),
    ("Pair potentials", "mdnum.md.potentials:POTENTIALS", "`potential.kind`"),
    ("Integrators", "mdnum.md.integrators:INTEGRATORS", "`dynamics.kind`"),
    ("Neighbor searches", "mdnum.md.neighbors:BUILDERS", "`neighbors.builder`"),
    ("Orders of sums", "mdnum.numerics.reductions:REDUCTIONS", "`precision.reduction`"),
    ("Choices in which two runs differ", "mdnum.forks.choices:CHOICES", "`mdnum fork --vary`"),
    ("Losses", "mdnum.gradients.losses:LOSSES", "`mdnum grad --of`"),
    ("Gradient methods", "mdnum.gradients.problem:METHODS", "`mdnum grad --methods`"),
    ("Measures of a sweep", "mdnum.sweeps.measures:MEASURES", "`mdnum sweep --measure`"),
    ("Neighbor lists", "mdnum.references.conformance.lists:LISTS", "`mdnum conform`"),
)
_CODE = re.compile(r"[A-Z][A-Z0-9_]+")
_UNIT = re.compile(r"\s*\(([^()]*(?:Å|σ|eV|ps|GPa|1/|τ|ε|amu|\bm\b)[^()]*)\)")


# -- what the package declares


def commands() -> Iterator[tuple[str, Any]]:
    """Every command as it is typed, "fork map", with the parser's object of it."""
    import typer

    from mdnum.cli.commands import app

    top: Any = typer.main.get_command(app)
    context = top.make_context("mdnum", [], resilient_parsing=True)
    for verb in top.list_commands(context):
        command = top.get_command(context, verb)
        yield verb, command
        for name, one in sorted(getattr(command, "commands", {}).items()):
            yield f"{verb} {name}", one


def findings() -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(command, code, sentences) of every finding, by the order of the verbs and of their text files."""
    from mdnum.verbs import VERBS, declared

    for verb in VERBS:
        for code, entry in declared(verb).items():
            if _CODE.fullmatch(code) and isinstance(entry, dict) and "severity" in entry:
                yield verb, code, entry


def keys(schema: str) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(definition, place in the file, schema) of every table of a system file, as a reader meets them."""
    from mdnum.systems.load import json_schema

    whole = json_schema(schema)
    waiting, seen = [("", "", whole)], {""}
    while waiting:
        name, place, table = waiting.pop(0)
        told = [
            f'{key} = "{one["const"]}"' for key, one in table.get("properties", {}).items() if "const" in one
        ]
        yield name, f"[{place}]" + "".join(f" with {one}" for one in told[:1]) if place else "", table
        inner = []
        for key, value in table.get("properties", {}).items():
            for found in re.findall(r'"#/\$defs/(\w+)"', json.dumps(value)):
                if found not in seen:
                    seen.add(found)
                    many = "additionalProperties" in json.dumps(value).split(found)[0]
                    below = ".".join(filter(None, [place, key, "NAME" if many else ""]))
                    inner.append((found, below, whole["$defs"][found]))
        waiting = inner + waiting


def tables() -> Iterator[tuple[str, str, list[tuple[str, str, str]]]]:
    """(kind of folder, table, columns with unit and description) of every folder that a verb makes."""
    from mdnum.store import columns
    from mdnum.verbs import VERBS, declared
    from mdnum.verbs.frame import layout

    for verb in VERBS:
        for kind in declared(verb).get("kinds", ()):
            made = layout(kind)
            for table in sorted(made.tables):
                plain = table.rstrip("?")
                yield kind, plain, [(one, *columns.meaning(plain, one)) for one in made.columns(plain)]


def documents() -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(kind, schema) of every JSON document."""
    import mdnum

    for path in sorted((Path(mdnum.__file__).parent / "schemas").glob("*.json")):
        yield path.stem, json.loads(path.read_text(encoding="utf-8"))


# -- pages


def _text(words: str) -> str:
    """Words of the package as Markdown that shows them as they are, code in backticks kept."""
    pieces = re.split(r"(`[^`]*`)", words)
    return "".join(
        one if one.startswith("`") else re.sub(r"([\\*_<>$\[\]|~#{}])", r"\\\1", one) for one in pieces
    )


def _cell(words: object) -> str:
    return _text(" ".join(str(words).split())).replace("`|`", "`\\|`")


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def _sentence(text: str) -> str:
    """A sentence of a text file, its fields as words in italics: "{lost:# pair}" is *lost* pairs."""

    def field(match: re.Match[str]) -> str:
        name, form = match[1], match[2] or ""
        if name == "of":
            return ""
        shown = f"\x00{name.replace('units.', '').replace('_', ' ').replace('.', ' ')}\x00"
        words = [word.replace("_", " ") for word in form[1:].split()]
        if form.startswith("?"):
            return words[-1]
        if form.startswith("#"):
            return f"{shown} {words[1] if len(words) > 1 else words[0] + 's'}"
        return shown

    # {of} is a further clause, " of B's run"
    filled = re.sub(r"\{([A-Za-z_][\w.\[\]]*)(?::([^{}]*))?\}", field, text)
    return _text(filled).replace("\x00", "*").replace("**", "* *")


def anchor(verb: str, code: str) -> str:
    """Where on the page a finding is."""
    return f"{verb} {code}".lower().replace(" ", "-").replace("_", "-")


def _type(parameter: Any) -> str:
    # typer's own parameters since 0.20, click's before
    descriptor = getattr(parameter, "type_descriptor", None)
    kind = descriptor.annotation.__name__ if descriptor else parameter.type.name
    return {"str": "TEXT", "int": "N", "integer": "N", "float": "X", "path": "PATH"}.get(
        kind.lower(), kind.upper()
    )


def commands_page() -> str:
    """Every command with its arguments and options."""
    lines = ["# Commands and options", "", "`mdnum VERB --help` shows the same in a terminal. Every command "]
    lines[-1] += "takes `--json`. What the commands are for: [the commands](../commands.md)."
    for name, command in commands():
        level = "##" if " " not in name else "###"
        lines += [
            "",
            f"({anchor('command', name)})=",
            f"{level} mdnum {name}",
            "",
            _text(command.help or ""),
            "",
        ]
        rows = []
        for one in command.params:
            if one.name == "help" or getattr(one, "hidden", False):
                continue
            flags = [*one.opts, *one.secondary_opts]
            word = one.metavar or ("" if getattr(one, "is_flag", False) else _type(one))
            shown = word or one.name.upper() if one.param_type_name == "argument" else ", ".join(flags)
            more = f" {word}" if word and one.param_type_name == "option" else ""
            default = (
                "" if one.default is None or one.default is False or callable(one.default) else one.default
            )
            usual = (
                f" Default {default}." if default not in ("", (), []) and "..." not in str(default) else ""
            )
            rows.append([f"`{shown}{more}`", _cell(getattr(one, "help", "") or "") + _cell(usual)])
        lines += _table(("argument, option", "meaning"), rows) if rows else []
    return "\n".join(lines)


def findings_page() -> str:
    """Every code with its severity, what it reports and what to do."""
    causes = _causes()
    listed = list(findings())
    lines = [
        "(findings-page)=", "# Findings", "",
        "Every verb reports what a person should know as findings: a code, a severity, a sentence "
        "with numbers, and what to do. `error`: do not use the numbers. `warning`: look before you "
        "do. `info`: good to know; it does not change the exit code. Words in *italics* stand for "
        "the numbers and names of a case. Where a sentence has several forms, or goes on where more"
        " is known, these are listed.", "",
    ]  # fmt: skip
    verbs = list(dict.fromkeys(verb for verb, _, _ in listed))
    for verb in verbs:
        named = " · ".join(
            f"[{_text(code)}](#{anchor(verb, code)})" for other, code, _ in listed if other == verb
        )
        lines += [f"`mdnum {verb}`: {named}", ""]
    for verb in verbs:
        lines += [f"## Of mdnum {verb}", ""]
        for code, entry in ((code, entry) for other, code, entry in listed if other == verb):
            lines += [f"({anchor(verb, code)})=", f"### {_text(code)}", ""]
            for part, title in (("title", ""), ("text", "What was seen"), ("remedy", "What to do")):
                said = [text for name, text in entry.items() if name == part or name.startswith(f"{part}_")]
                said += [text for name, text in entry.items() if part == "text" and name.startswith("more_")]
                said = list(dict.fromkeys(_sentence(text) for text in said if text and text != "{remedy}."))
                begin = f"**{entry['severity']}**: " if part == "title" else f"*{title}.* "
                if len(said) > 1:
                    lines += [begin.rstrip(), "", *(f"- {text}" for text in said), ""]
                elif said:
                    lines += [begin + said[0], ""]
            for title, others in causes.get(code, {}).items() if verb == "audit" else ():
                links = ", ".join(f"[{_text(one)}](#{anchor(verb, one)})" for one in others)
                lines += [f"*{title}.* {links}.", ""]
    return "\n".join(lines)


def _causes() -> dict[str, dict[str, list[str]]]:
    """What a finding of an audit explains, and what else shows the same."""
    import mdnum.audit
    from mdnum.plain import beside

    said = beside(str(Path(mdnum.audit.__file__).parent / "causes.py"))
    known = {code for verb, code, _ in findings() if verb == "audit"}
    groups = said["groups"]
    made: dict[str, dict[str, list[str]]] = {}
    for code, entry in said.items():
        if code in known:
            brings = [one for word in entry.get("brings", ()) for one in groups.get(word, [word])]
            shown = {"It may bring about": brings, "It can be confused with": entry.get("rivals", ())}
            chosen = {
                title: [one for one in dict.fromkeys(them) if one in known] for title, them in shown.items()
            }
            made[code] = {title: them for title, them in chosen.items() if them}
    return made


def _kind(value: Mapping[str, Any]) -> str:
    """The type of a key in words."""
    if "const" in value:
        return f"`{json.dumps(value['const'], ensure_ascii=False)}`"
    if "enum" in value:
        return ", ".join(f"`{json.dumps(one, ensure_ascii=False)}`" for one in value["enum"])
    if "$ref" in value:
        name = value["$ref"].split("/")[-1]
        return f"[{name.removesuffix('Table')}](#table-{name.lower()})"
    for several in ("anyOf", "oneOf"):
        if several in value:
            kinds = [_kind(one) for one in value[several] if one.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    if value.get("type") == "array" and (value.get("prefixItems") or value.get("items")):
        inner = value.get("prefixItems") or [value["items"]]
        return f"array of {_kind(inner[0])}"
    if value.get("type") == "object" and isinstance(value.get("additionalProperties"), dict):
        return f"table of {_kind(value['additionalProperties'])}"
    types = value.get("type", "any")
    return types if isinstance(types, str) else ", ".join(one for one in types if one != "null")


def _range(value: Mapping[str, Any]) -> str:
    """What a number has to be, of the key or of its only alternative."""
    inner = [value, *(one for one in value.get("anyOf", ()) if one.get("type") != "null")]
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    return ", ".join(f"{sign} {one[key]}" for one in inner[:2] for key, sign in signs.items() if key in one)


def keys_page() -> str:
    """Every key of a system file with its type, unit and default."""
    lines = [
        "# Keys of a system file", "",
        "Written from the schemas that an editor uses (`systems/schema.json`, `systems/ball-"
        "schema.json`). [Your own system](../systems.md) explains them with examples; where two "
        'units are given, the first is that of `units = "metal"`, the second of `units = "lj"`.', "",
    ]  # fmt: skip
    for title, schema in (("Molecular dynamics", "schema.json"), ("The ball", "ball-schema.json")):
        lines += [f"## {title}", ""]
        ball = "ball-" if schema.startswith("ball") else ""
        for table, place, made in keys(schema):
            properties, needed = made.get("properties", {}), made.get("required", ())
            shown = _text(place) if place else "The file"
            lines += [f"(table-{ball}{(table or 'file').lower()})=", f"### {shown}", ""]
            lines += [_text(made.get("description", "")), ""]
            rows = []
            for key, value in properties.items():
                text = value.get("description", "")
                unit = _UNIT.search(text)
                default = value.get("default", "")
                usual = (
                    "required"
                    if key in needed
                    else ""
                    if default in ("", None)
                    else f"`{json.dumps(default)}`"
                )
                kind = " ".join(filter(None, [_kind(value), _range(value)])).replace(
                    "(#table-", f"(#table-{ball}"
                )
                rest = _UNIT.sub("", text, count=1) if unit else text
                rows.append([f"`{key}`", kind, _cell(unit[1]) if unit else "", usual, _cell(rest)])
            lines += _table(("key", "type", "unit", "default", "meaning"), rows) if rows else []
    return "\n".join(lines)


def columns_page() -> str:
    """Every column of every table of every folder."""
    lines = [
        "# Columns of tables", "",
        "By kind of folder ([what lies in a folder](../folders.md)). A unit is made of quantities, "
        "for which the units of the folder stand; every parquet file has it, written out, in its "
        "own schema. *decision* is the quantity that is compared with a threshold: a length, or its"
        " square. An empty unit is that of counts, numbers and ratios.", "",
    ]  # fmt: skip
    kind = None
    for of, table, rows in tables():
        lines += [f"## Folder {of}", ""] if of != kind else []
        kind = of
        lines += [f"({anchor('columns', f'{of} {table}')})=", f"### {of}: {table}.parquet", ""]
        lines += _table(("column", "unit", "holds"), ([f"`{a}`", _cell(b), _cell(c)] for a, b, c in rows))
    return "\n".join(lines)


def documents_page() -> str:
    """Every JSON document with its keys."""
    lines = [
        "# JSON documents", "",
        "What `--json` prints and `summary.json` holds, by schema. [Rules of the "
        "documents](../json.md): what versions promise, and what null means. The schemas have every"
        " key at every depth; here are those at the top.", "",
    ]  # fmt: skip
    for kind, schema in documents():
        lines += [
            f"({anchor('document', kind)})=",
            f"## {schema.get('$id', kind)}",
            "",
            _text(schema.get("title", "")),
            "",
        ]
        needed = set(schema.get("required", ()))
        rows = []
        for key, value in schema.get("properties", {}).items():
            inner = value.get("items", value).get("properties", {})
            shown = ", ".join(f"`{one}`" for one in inner)
            kinds = re.sub(r"\[(\w+)\]\(#[^)]*\)", r"\1", _kind(value))
            rows.append([f"`{key}`", kinds, "yes" if key in needed else "", shown])
        lines += _table(("key", "type", "always there", "keys below it"), rows) if rows else []
    return "\n".join(lines)


def names_page() -> str:
    """Every name of every registry."""
    lines = [
        "# Names", "",
        "What can be written where a cutoff, a potential, a method or a measure is named. Another "
        "package can add names to each of these ([extending](../extending.md)).", "",
    ]  # fmt: skip
    for title, place, where in REGISTRIES:
        module, _, attribute = place.partition(":")
        registry = getattr(importlib.import_module(module), attribute)
        lines += [f"## {title}", "", f"Written in {where}.", ""]
        rows = [[f"`{name}`", _cell(_about(registry, name))] for name in registry.shipped]
        lines += _table(("name", "what it is"), rows)
    return "\n".join(lines)


def _about(registry: Any, name: str) -> str:
    # a measure has a title in the place of a description
    return getattr(registry[name], "title", "") or registry.description(name)


def python_page() -> str:
    """Every name of `mdnum`, from its docstring."""
    import mdnum

    kinds: dict[str, list[str]] = {"Verbs and functions": [], "Classes": [], "Errors": []}
    for name in mdnum.__all__:
        value = getattr(mdnum, name)
        if inspect.isclass(value):
            kinds["Errors" if issubclass(value, Exception) else "Classes"].append(name)
        elif inspect.isroutine(value):
            kinds["Verbs and functions"].append(name)
    lines = [
        "# Python", "",
        "The names below are `mdnum.NAME`. **What is stable**: these names, their arguments by "
        "keyword, the modules that [From Python](../python.md#modules) lists, codes of findings, "
        "keys of documents and columns of tables by the rule of [their versions](../json.md). A "
        "change to any of these is in the changelog. Everything else may change without notice.", "",
    ]  # fmt: skip
    for title, names in kinds.items():
        lines += [f"## {title}", ""]
        for name in names:
            value = getattr(mdnum, name)
            place = f"{value.__module__}.{value.__qualname__}"
            directive = "autoclass" if inspect.isclass(value) else "autofunction"
            lines += [f"(python-{directive[4:]}-{name.lower()})=", f"### mdnum.{name}", ""]
            lines += ["```{eval-rst}", f".. {directive}:: {place}", "   :no-index-entry:"]
            public = (
                [n for n, m in vars(value).items() if not n.startswith("_") and _shown(m)]
                if inspect.isclass(value)
                else []
            )
            lines += [f"   :members: {', '.join(public)}"] if public and title == "Classes" else []
            lines += ["```", ""]
    return "\n".join(lines)


def _shown(member: object) -> bool:
    function = member.fget if isinstance(member, property) else member
    return (inspect.isfunction(function) or isinstance(member, property)) and bool(inspect.getdoc(member))


#: Pages that are written by hand, and belong to the reference.
WRITTEN = ("commands", "folders", "json", "extending", "scripts")
PAGES = {
    "commands": commands_page,
    "keys": keys_page,
    "findings": findings_page,
    "columns": columns_page,
    "documents": documents_page,
    "names": names_page,
    "python": python_page,
}


def write(folder: Path) -> None:
    """Writes the pages that have changed into a folder."""
    folder.mkdir(exist_ok=True)
    index = [
        "# Reference",
        "",
        "Made from the program itself when this site was built.",
        "",
        "```{toctree}",
        ":maxdepth: 1",
        "",
    ]
    pages = {name: page() for name, page in PAGES.items()}
    pages["index"] = "\n".join([*index, *PAGES, *(f"../{one}" for one in WRITTEN), "```", ""])
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    """Sphinx calls it."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "reference"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
