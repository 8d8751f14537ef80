"""Elements of all report pages: templates, style, and figures."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from mdnum.errors import json_escape, printable
from mdnum.report.browse import STATIC_ROWS, Browse
from mdnum.report.section import Figure, Plot, cell
from mdnum.report.words import heading, many, typeset
from mdnum.store.files import subfolder, write_text

if TYPE_CHECKING:
    from mdnum.report.finding import Finding, Verdict
    from mdnum.report.section import Page
    from mdnum.store import RunFolder

_HERE = files("mdnum.report")


def write(folder: RunFolder, page: Page, verdict: Verdict) -> Path:
    """Write report.html and the figures (figures/*.svg) into a folder.

    Returns:
        the path of report.html.

    Raises:
        FolderError: the folder cannot be written.
    """
    # matplotlib takes a third of a second to import, and who only reads a page needs none
    from mdnum.report import drawing

    parts = [part for section in page.sections for part in section.parts]
    pictures, notes = {}, {}
    for part in parts:
        if isinstance(part, Figure | Plot):
            image = printable(page.pictures.get(part.name) or drawing.markup(drawing.draw(part), part.name))
            write_text(subfolder(folder.path, "figures") / f"{part.name}.svg", drawing.standalone(image))
            pictures[part.name] = Markup(drawing.inline(image, typeset(part.alt)))
            notes[part.name] = drawing.notes(part)
    titles = [section.title for section in page.sections]
    anchors = {one: "section-" + re.sub(r"[^a-z0-9]+", "-", one.lower()).strip("-") for one in titles}
    contents = [(each.title, anchors[each.title]) for each in page.sections if each.level == 2]
    names = sorted(each.name for each in folder.path.iterdir() if each.suffix in _LINKED)
    path = folder.path / "report.html"
    text = _render(
        "page.html.j2", page=page, verdict=verdict, findings=_under_causes(verdict.findings),
        pictures=pictures, notes=notes, anchors=anchors,
        contents=[("Findings", "findings")] * bool(verdict.findings) + contents, files=names,
        scripted=any(isinstance(part, Browse) and part.rows for part in parts),
        provenance=list(flat(page.provenance)),
    )  # fmt: skip
    # what came from a file may turn or hide text around it; escaped as in JSON, which is in there too
    write_text(path, printable(text, json_escape))
    return path


def brief(page: Page, verdict: Verdict, path: Path, verb: str) -> str:
    """Return a short report page as HTML for notebooks."""
    from mdnum.report import drawing

    parts = (part for section in page.sections for part in section.parts)
    figure, image = next((part for part in parts if isinstance(part, Figure | Plot)), None), ""
    if figure is not None:
        # ids are those of the whole notebook
        name = f"{figure.name}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
        image = drawing.inline(drawing.markup(drawing.draw(figure), name), typeset(figure.alt))
    text = _render(
        "brief.html.j2", page=page, verdict=verdict, findings=_under_causes(verdict.findings), path=str(path),
        verb=verb, figure=figure, picture=Markup(image),
    )  # fmt: skip
    return printable(text, json_escape)


#: Files in the folder to which a report links.
_LINKED = (".parquet", ".py", ".json", ".toml", ".extxyz", ".npz", ".traj")


def _under_causes(findings: Iterable[Finding]) -> list[tuple[Finding, list[Finding]]]:
    """Return the findings without a cause, each with the findings that it causes."""
    findings = list(findings)
    codes = {finding.code for finding in findings}
    below: dict[str, list[Finding]] = {}
    for finding in findings:
        below.setdefault(finding.cause, []).append(finding)
    # of several with one code the first has them
    return [(head, below.pop(head.code, [])) for head in findings if head.cause not in codes]


def _render(template: str, **content: Any) -> str:
    from mdnum.report import drawing

    environment = Environment(
        loader=FunctionLoader(_text),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # a page may display itself and run only its own script
    digest = base64.b64encode(hashlib.sha256(_text("report.js").encode()).digest()).decode()
    policy = (
        "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'"
    )
    environment.filters |= {"typeset": typeset, "heading": heading, "cell": cell}
    environment.filters |= {"kind": lambda part: type(part).__name__}
    environment.globals |= {
        "many": many, "static": STATIC_ROWS, "style": Markup(_text("report.css")),
        "script": Markup(_text("report.js")), "policy": policy, "light": drawing.LIGHT,
        "dark": drawing.DARK, "font": Markup(drawing.FONT),
    }  # fmt: skip
    return environment.get_template(template).render(**content)


def in_words(table: Mapping[str, Any], units: Mapping[str, str] | None = None) -> str:
    """Describe a table of a system file: its kind, then names and values of other entries."""
    parts = []
    for key, value in table.items():
        if isinstance(value, Mapping):
            inner = (
                f"{name} ({in_words(item)})" if isinstance(item, Mapping) else f"{name} {_value(item)}"
                for name, item in value.items()
            )
            parts.append(f"{key}: {'; '.join(inner)}")
        elif key == "kind":
            parts.insert(0, str(value))
        elif value is not None:
            unit = (units or {}).get(key)
            parts.append(f"{key.replace('_', ' ')} {_value(value)}{f' {unit}' if unit else ''}")
    return ", ".join(parts)


def flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (name, text) for each entry of nested tables. Plain values of a table are joined to one text."""
    for key, item in value.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(item, Mapping):
            scalars = {inner: text for inner, text in item.items() if not isinstance(text, Mapping | list)}
            if scalars:
                yield name, ", ".join(f"{inner} {_short(text)}" for inner, text in scalars.items())
            yield from flat({key: inner for key, inner in item.items() if key not in scalars}, f"{name} ")
        elif isinstance(item, list):
            texts = [in_words(part) if isinstance(part, Mapping) else _short(part) for part in item]
            yield name, ", ".join(texts) or "none"
        else:
            yield name, _short(item)


def _text(name: str) -> str:
    return _HERE.joinpath(*name.split("/")).read_text(encoding="utf-8")


def _value(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _short(value: Any) -> str:
    if value is None:
        return "none"
    text = ("on" if value else "off") if isinstance(value, bool) else str(value)
    if re.fullmatch(r"[0-9a-f]{32,}\+?", text):
        # enough of a hash to tell two apart; provenance.json has the whole
        text = text[:12] + "…"
    return text or "none"
