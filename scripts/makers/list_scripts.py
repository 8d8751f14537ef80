"""Write the tables of docs/scripts.md from the first lines of every script.

    python scripts/makers/list_scripts.py          write them
    python scripts/makers/list_scripts.py --check  exit with 1 if they are not current

A script begins with its question. The paragraph that begins with "Answer." says what was found, and ends with
how long that takes.
"""

from __future__ import annotations

import argparse
import ast
import re
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
from _pages import ROOT, between, markdown, write

PAGE = ROOT / "docs" / "scripts.md"
MARK = "<!-- written by scripts/makers/list_scripts.py -->"
RAW = argparse.RawDescriptionHelpFormatter
TITLES = {
    "studies": "Studies: a question and a table",
    "benchmarks": "Benchmarks: how fast",
    "campaigns": "Campaigns: how often, over hundreds of cases",
    "makers": "Makers of what is shipped",
}


def paragraphs(path: Path) -> list[str]:
    """Those of its docstring, each on one line."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return [" ".join(part.split()) for part in text.split("\n\n")]


def row(path: Path) -> tuple[str, ...]:
    """Its link, question, answer and time; of a maker, its link and what it writes.

    Raises:
        ValueError: it does not begin as it should.
    """
    link, about = f"[{path.name}](../{path.relative_to(ROOT)})", paragraphs(path)
    if path.parent.name == "makers":
        return link, about[0]
    question, mark, _ = about[0].partition("?")
    answers = [part.removeprefix("Answer. ") for part in about if part.startswith("Answer. ")]
    answer, takes, time = (answers or [""])[0].rpartition(" It takes ")
    if not (mark and takes):
        raise ValueError(f"{path}: its first lines have no question, answer and time")
    answer = re.sub(r"docs/([\w-]+\.md)", r"[\1](\1)", answer)
    return link, question + mark, answer, time.rstrip(".")


def tables() -> str:
    """A table for each folder."""
    parts = []
    for folder, title in TITLES.items():
        head = ("script", "what it does") if folder == "makers" else ("script", "question", "answer", "takes")
        rows = [row(path) for path in sorted((ROOT / "scripts" / folder).glob("[a-z]*.py"))]
        parts.append(f"## {title}\n\n{markdown(head, rows)}")
    return "\n\n".join(parts)


def main() -> None:
    """Write, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=RAW)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if not current")
    asked = parser.parse_args()
    write({PAGE: between(PAGE, MARK, tables())}, asked.check)


if __name__ == "__main__":
    main()
