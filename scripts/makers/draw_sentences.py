"""Draw forty sentences of mdnum with a random seed from all kinds of text, for readers who do not know mdnum.

    python scripts/makers/draw_sentences.py --seed 3

Eight sentences each of findings (pages and terminal), help texts, errors, docstrings and documents. A reader
marks each as clear at first reading or not, with the words that stopped them. `sentences.toml` next to
this file lists sentences that were drawn, with the marks of a reader.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
#: Sentences of each kind, and letters that a sentence has at least: shorter ones are labels.
EACH, SHORTEST = 8, 30
#: End of a sentence; not of the initial of a name, or of a shortened word of a journal's name.
_END = re.compile(
    r"(?<=[.?!:])(?<!\b[A-Z]\.)(?<!Phys\.)(?<!Chem\.)(?<!Comput\.)(?<!Lett\.)(?<!Rev\.)(?<!Sci\.)\s+(?=[A-Z`\[*-])"
)
#: Sections of a docstring that describe arguments and results one by one.
_SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises):", re.M)
_FIELD = re.compile(r"\{[a-z_]*:\? \w+ (\w+)\}|\{([\w.\[\]]+)(?::#? ?([^}]*))?\}")
#: Keys whose texts are no sentences of a finding.
_NO_SENTENCE = (
    "severity", "section", "help", "metavar", "type", "of", "kind", "unit", "calls", "name", "shares",
    "kinds", "further", "placeholder", "bib", "script", "digest_code", "imports_code",
)  # fmt: skip


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description="Forty sentences of mdnum, drawn with a seed.")
    parser.add_argument("--seed", type=int, default=1)
    draw = random.Random(parser.parse_args().seed)
    kinds = {
        "finding": findings,
        "help": helps,
        "error": errors,
        "docstring": docstrings,
        "document": documents,
    }
    for kind, of in kinds.items():
        found = sorted({one for one in of() if len(one[1]) >= SHORTEST})
        for place, sentence in draw.sample(found, EACH):
            print(f"[[sentence]]\nkind = {kind!r}\nplace = {place!r}\ntext = '''{sentence}'''\n")


def findings() -> Iterator[tuple[str, str]]:
    """Sentences of the text files, fields by an example: a count as 3, another number as its name."""
    for file in sorted({*(ROOT / "mdnum").rglob("*.toml")} - {*(ROOT / "mdnum").rglob("reproduction.toml")}):
        for text in _texts(tomllib.loads(file.read_text())):
            yield from _split(file, _FIELD.sub(_example, text))


def helps() -> Iterator[tuple[str, str]]:
    """Help texts of commands and options."""
    for file in sorted((ROOT / "mdnum").rglob("*.toml")):
        for text in _texts(tomllib.loads(file.read_text()), only="help"):
            yield from _split(file, text)


def errors() -> Iterator[tuple[str, str]]:
    """Messages and remedies of exceptions."""
    for file in sorted((ROOT / "mdnum").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "").endswith("Error"):
                parts = [
                    _literal(one)
                    for one in [*node.args[:1], *(k.value for k in node.keywords if k.arg != "where")]
                ]
                yield from _split(file, ". ".join(part for part in parts if part), whole=True)


def docstrings() -> Iterator[tuple[str, str]]:
    """Sentences of docstrings in the package, with what they describe, as `help()` shows them."""
    for file in sorted((ROOT / "mdnum").rglob("*.py")):
        for of, text in _described(ast.parse(file.read_text()), ""):
            for part in re.split(r"\n\s*\n", _SECTION.split(text)[0]):
                if not part.startswith((" ", "Example", ">>>")):
                    yield from ((f"{place}{of}", sentence) for place, sentence in _split(file, part))


def documents() -> Iterator[tuple[str, str]]:
    """Sentences of README and docs/, without tables, code and headings."""
    for file in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        # code, formulas, marks that are not shown, and the lines of a notebook before its title
        hidden = r"^(```|~~~|\$\$).*?^(```|~~~|\$\$)|<!--.*?-->|\A---\n.*?^---$"
        text = re.sub(hidden, "", file.read_text(), flags=re.S | re.M)
        text = re.sub(r"^(\||#|---|\s*:::).*$|\*\*", "", text, flags=re.M)
        # paragraphs, and items of lists
        for part in re.split(r"\n\s*\n|\n\s*(?=(?:\d+\.|[-*]) )", text):
            yield from _split(file, part.lstrip("-*>0123456789. "))


def _described(node: ast.AST, of: str) -> Iterator[tuple[str, str]]:
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        arguments = f"({ast.unparse(node.args)})" if isinstance(node, ast.FunctionDef) else ""
        of = f"{of or ': '}{'.' * (len(of) > 2)}{node.name}{arguments}"
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
        yield of, text
    for one in ast.iter_child_nodes(node):
        yield from _described(one, of)


def _texts(tables: Any, only: str = "") -> Iterator[str]:
    for key, value in tables.items() if isinstance(tables, dict) else enumerate(tables):
        if isinstance(value, dict | list):
            yield from _texts(value, only) if only or key not in _NO_SENTENCE else ()
        elif isinstance(value, str) and (key == only if only else key not in _NO_SENTENCE):
            yield value


def _example(field: re.Match[str]) -> str:
    word, name, form = field.groups()
    if word:
        return word.replace("_", " ")
    if form and form[0].isalpha() and ":#" in field[0]:
        one, *several = (part.replace("_", " ") for part in form.split())
        return f"3 {several[0] if several else one + 's'}"
    return f"<{name.replace('[', ' ').rstrip(']')}>"


def _literal(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(one.value if isinstance(one, ast.Constant) else "…" for one in node.values)  # type: ignore[misc]
    return ""


def _split(file: Path, text: str, whole: bool = False) -> Iterator[tuple[str, str]]:
    flat = " ".join(text.split())
    for sentence in [flat] if whole else _END.split(flat):
        yield str(file.relative_to(ROOT)), sentence.replace("'''", '"')


if __name__ == "__main__":
    main()
