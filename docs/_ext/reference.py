"""Write the pages of docs/reference from the declarations of the package, each time the site is built.

Commands come from the parser, keys of system files from their schemas, findings from the text files of verbs,
columns from `mdnum/store`, documents from `mdnum/schemas`, names from the registries, Python from docstrings.
The pages therefore always agree with the package.
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

#: Registries in the order of the page: title, module and attribute, and the options that accept its names.
#: The module of measures is the one that adds those of forks and gradients.
REGISTRIES = (
    ("Cutoffs", "mdnum.md.cutoffs:CUTOFFS", "`cutoff.kind`, `mdnum.Cut`"),
    ("Pair potentials", "mdnum.md.potentials:POTENTIALS", "`potential.kind`"),
    ("Integrators", "mdnum.md.integrators:INTEGRATORS", "`dynamics.kind`"),
    ("Neighbor searches", "mdnum.md.neighbors:BUILDERS", "`neighbors.builder`"),
    ("Orders of sums", "mdnum.numerics.reductions:REDUCTIONS", "`precision.reduction`"),
    ("Choices in which two runs differ", "mdnum.forks.choices:CHOICES", "`mdnum fork --vary`"),
    ("Losses", "mdnum.gradients.losses:LOSSES", "`mdnum grad --of`"),
    ("Gradient methods", "mdnum.gradients.problem:METHODS", "`mdnum grad --methods`"),
    ("Measures of a sweep", "mdnum.verbs.sweep_measures:MEASURES", "`mdnum sweep --measure`"),
    ("Neighbor lists", "mdnum.references.conformance.lists:LISTS", "`mdnum conform`"),
)
#: Fields of findings that hold whole sentences: by command, the names of these sentences in its text file.
FILLED = {
    "fork map": {"away": ("above", "below", "far_above", "far_below")},
    "grad": {
        "seen": (
            "rounding_disagree", "time_step_disagree", "standard_error_scatter",
            "near_miss_short_of", "near_miss_beyond", "near_miss_elsewhere", "near_miss_between_two_steps",
            "flips_left_out_steps_alone", "flips_left_out_single_frames", "flips_left_out_grazing",
            "ambiguous_decision_within_rounding",
        ),
    },
    "flips": {"seen": ("stride_seen",)},
    "conform": {"seen": ("failure",), "also": ("answers",)},
    "ball": {"told": ("fork",)},
}  # fmt: skip
#: What such a field holds if it is not made of sentences of a text file.
HELD = {
    "error": "The error message of the run is shown.",
    "note": "The reason why energies were not compared is shown.",
    "notes": "Notes on how the file was read are shown.",
    "each": "Each of these methods is listed, with the reason why it gave no gradient.",
}
_CODE = re.compile(r"[A-Z][A-Z0-9_]+")
_UNIT = re.compile(r"\s*\(([^()]*(?:Å|σ|eV|ps|GPa|1/|τ|ε|amu|\bm\b)[^()]*)\)")


# -- what the package declares


def commands() -> Iterator[tuple[str, Any]]:
    """Yield every command as it is typed, such as "fork map", with its parser object."""
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
    """Yield (command, code, sentences) of every finding, in the order of verbs and text files."""
    from mdnum.verbs import VERBS, declared

    for verb in VERBS:
        for code, entry in declared(verb).items():
            if _CODE.fullmatch(code) and isinstance(entry, dict) and "severity" in entry:
                yield verb, code, entry


def keys(schema: str) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield (definition, path in the file, schema) of every table of a system file, outer tables first."""
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
    """Yield (kind of folder, table, columns with unit and description) for every folder that a verb makes."""
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
    """Yield (kind, schema) of every JSON document."""
    import mdnum

    for path in sorted((Path(mdnum.__file__).parent / "schemas").glob("*.json")):
        yield path.stem, json.loads(path.read_text(encoding="utf-8"))


# -- pages


def _text(words: str) -> str:
    """Escape a text for Markdown, except for code in backticks."""
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
    """Return a sentence of a text file with its fields in italics: "{lost:# pair}" becomes *lost* pairs."""

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


def _filled(verb: str, text: str) -> list[str]:
    """Return a sentence in each of its forms, if one of its fields holds whole sentences."""
    from mdnum.verbs import declared

    if text[1:-1] in HELD:
        return [HELD[text[1:-1]]]
    for field, names in FILLED.get(verb, {}).items():
        if f"{{{field}}}" in text:
            sentences = declared(verb)["sentences"]
            return [text.replace(f"{{{field}}}", sentences[name]) for name in names]
    return [text]


def anchor(verb: str, code: str) -> str:
    """Return the anchor of a finding on its page."""
    return f"{verb} {code}".lower().replace(" ", "-").replace("_", "-")


def _type(parameter: Any) -> str:
    # typer's own parameters since 0.20, click's before
    descriptor = getattr(parameter, "type_descriptor", None)
    kind = descriptor.annotation.__name__ if descriptor else parameter.type.name
    return {"str": "TEXT", "int": "N", "integer": "N", "float": "X", "path": "PATH"}.get(
        kind.lower(), kind.upper()
    )


def commands_page() -> str:
    """Write every command with its arguments and options."""
    lines = ["# Commands and options", "", "`mdnum VERB --help` prints the same list in a terminal. Every "]
    lines[-1] += "command accepts `--json`. [Commands](../commands.md) describes what each command does."
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
    """Write every code with its severity, observation and remedy."""
    causes = _causes()
    listed = list(findings())
    lines = [
        "(findings-page)=", "# Findings", "",
        "Every verb reports its results as findings. A finding has a code, a severity, a sentence with "
        "numbers, and a remedy. `error` means that the numbers of the run should not be used, "
        "`warning` that they should be examined before they are used, and `info` does not change "
        "the exit code. Words in *italics* are placeholders for numbers and names. If a sentence has"
        " several forms or continuations, all of them are listed.", "",
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
                said = [one for text in said if text != "{remedy}." for one in _filled(verb, text)]
                said = list(dict.fromkeys(_sentence(text) for text in said if text))
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
    """Return the consequences of each finding of an audit, and the findings with the same symptoms."""
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
    """Describe the type of a key."""
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
    """Describe the permitted range of a number, for the key or for its only alternative."""
    inner = [value, *(one for one in value.get("anyOf", ()) if one.get("type") != "null")]
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    return ", ".join(f"{sign} {one[key]}" for one in inner[:2] for key, sign in signs.items() if key in one)


def keys_page() -> str:
    """Write every key of a system file with its type, unit and default."""
    lines = [
        "# Keys of a system file", "",
        "This page is generated from the schemas that editors use (`systems/schema.json`, `systems/ball-"
        "schema.json`). [Your own system](../systems.md) explains the keys with examples. If two "
        'units are given, the first applies to `units = "metal"`, the second to `units = "lj"`.', "",
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
    """Write every column of every table of every folder."""
    lines = [
        "# Columns of tables", "",
        "The columns are listed by kind of folder ([the files of a folder](../folders.md)). Units are "
        "composed of quantities such as energy/length; the schema of every parquet file contains the"
        " actual units. *decision* is the quantity that is compared with a threshold: a length, or "
        "its square. Counts, indices and ratios have no unit.", "",
    ]  # fmt: skip
    kind = None
    for of, table, rows in tables():
        lines += [f"## Folder {of}", ""] if of != kind else []
        kind = of
        lines += [f"({anchor('columns', f'{of} {table}')})=", f"### {of}: {table}.parquet", ""]
        lines += _table(("column", "unit", "content"), ([f"`{a}`", _cell(b), _cell(c)] for a, b, c in rows))
    return "\n".join(lines)


def documents_page() -> str:
    """Write every JSON document with its keys."""
    lines = [
        "# JSON documents", "",
        "This page lists the keys of the documents that `--json` prints and `summary.json` contains, by"
        " schema. [JSON documents](../json.md) explains their versions, and the meaning of null. The "
        "schemas contain the keys at every depth; this page lists only the upper levels.", "",
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
        lines += _table(("key", "type", "always present", "nested keys"), rows) if rows else []
    return "\n".join(lines)


def names_page() -> str:
    """Write every name of every registry."""
    lines = [
        "# Names", "",
        "This page lists the names of the available cutoffs, potentials, methods and other components. "
        "Another package can add further names ([extending](../extending.md)).", "",
    ]  # fmt: skip
    for title, place, where in REGISTRIES:
        module, _, attribute = place.partition(":")
        registry = getattr(importlib.import_module(module), attribute)
        lines += [f"## {title}", "", f"These names are used in {where}.", ""]
        rows = [[f"`{name}`", _cell(_about(registry, name))] for name in registry.shipped]
        lines += _table(("name", "description"), rows)
    return "\n".join(lines)


def _about(registry: Any, name: str) -> str:
    # a measure has a title in the place of a description
    return getattr(registry[name], "title", "") or registry.description(name)


def python_page() -> str:
    """Write every name of `mdnum` with its docstring."""
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
        "The names below are used as `mdnum.NAME`. **Stability**: these names, their keyword arguments,"
        " the modules listed in [From Python](../python.md#modules), and codes of findings are stable,"
        " and keys of documents and columns of tables follow [their versions](../json.md). Changes of "
        "any of these are listed in the changelog. Everything else may change without notice.", "",
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


#: Hand-written pages that belong to the reference.
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
    """Write the pages that have changed to a folder."""
    folder.mkdir(exist_ok=True)
    index = [
        "# Reference",
        "",
        "These pages were generated from the program when the site was built.",
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
    """Register the pages with Sphinx."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "reference"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
