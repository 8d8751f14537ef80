"""Tables in Markdown, and pages that scripts write parts of."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def markdown(columns: Sequence[object], rows: Iterable[Sequence[object]], *, right: bool = False) -> str:
    """A table in Markdown.

    Args:
        right: whether all columns but the first stand right.
    """
    rule = ["---", *["--:" if right else "---"] * (len(columns) - 1)]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in (columns, rule, *rows))


def between(page: Path, mark: str, *texts: str) -> str:
    """A page with these texts, one between each pair of its marks."""
    parts = page.read_text(encoding="utf-8").split(mark)
    parts[1::2] = [f"\n\n{text}\n\n" for text in texts]
    return mark.join(parts)


def write(files: Mapping[Path, str], check: bool = False) -> None:
    """Write the files that are not current; with `check`, name them and exit with 1."""
    stale = [path for path, text in files.items() if not path.exists() or path.read_text("utf-8") != text]
    if check and stale:
        sys.exit("\n".join(f"{path.relative_to(ROOT)} is not current" for path in stale))
    for path in stale:
        path.write_text(files[path], encoding="utf-8")
        print(path.relative_to(ROOT))
