"""Draw the rooms of mdnum and their imports for docs/architecture.md, and write the page's table of rooms.

    python scripts/makers/draw_architecture.py          write the picture and the table
    python scripts/makers/draw_architecture.py --check  exit with 1 if either is not current

Layers are those of the import contract in pyproject.toml. Imports are read from the source: those inside
functions count, those for annotations alone (under TYPE_CHECKING) do not. It takes seconds and runs nothing
of mdnum.
"""

from __future__ import annotations

import argparse
import ast
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from textwrap import wrap

import _shared  # noqa: F401  what scripts share is found by it
from _pages import ROOT, between, markdown, write

PICTURE, PAGE = ROOT / "docs" / "figures" / "architecture.svg", ROOT / "docs" / "architecture.md"
MARK = "<!-- written by scripts/makers/draw_architecture.py -->"

#: The lowest layer that is drawn with arrows. What is below it may be imported by everything above.
GROUND = "numerics"
#: What a layer is for, by its rooms: its color. A layer without such a room has the color of the layer above.
KINDS = {
    "cli": "door", "verbs": "door", "report": "door", "gradients": "questions", "references": "questions",
    "trajectories": "questions", "rollout": "runs", "systems": "runs", "md": "worlds", "program": "contracts",
    "numerics": "numbers",
}  # fmt: skip
LEGEND = {
    "door": "what a person meets", "questions": "questions", "runs": "from a file to a run",
    "worlds": "the two worlds", "contracts": "what runs leave", "numbers": "decisions and rounding",
}  # fmt: skip
#: Columns: (left, right). A room stands in the column of its name here, or in the first that is free.
COLUMNS = ((26, 314), (344, 632), (694, 974))
COLUMN = {
    "cli": 1, "verbs": 1, "report": 2, "gradients": 0, "audit": 1, "forks": 0, "references": 1, "doctor": 2,
    "trajectories": 2, "rollout": 1, "systems": 1, "ball": 0, "md": 1, "program": 0, "provenance": 1,
    "store": 2, "numerics": 1,
}  # fmt: skip
WIDTH, TOP, HIGH, BAND, CHIP = 1000, 46, 56, 84, 26
#: Pixels between two arrows that run side by side.
APART = 11

STYLE = """
  text { font: 11px system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; fill: var(--ink) }
  .name { font-weight: 650; font-size: 15px } .quiet { fill: var(--quiet) }
  rect { stroke-width: 1.25 } .edge { fill: none; stroke: var(--edge); stroke-width: 1.4; opacity: .75 }
  svg {
    --paper: #ffffff; --band: #f7f8fa; --ink: #1c2330; --quiet: #556070; --edge: #6d7888;
    --ground: #f1f3f6; --line: #c3cad4;
    --door: #e4effa; --door-line: #3f7fbf; --questions: #e4f4ec; --questions-line: #2f8f66;
    --runs: #fdf1dc; --runs-line: #b97a14; --worlds: #fbe7e4; --worlds-line: #c0563f;
    --contracts: #f0eaf8; --contracts-line: #7d5fb0; --numbers: #e6f2f5; --numbers-line: #2f869b;
  }
  @media (prefers-color-scheme: dark) {
    svg {
      --paper: #0f141b; --band: #141a23; --ink: #e8ecf2; --quiet: #a7b2c1; --edge: #8d9aac;
      --ground: #19202a; --line: #3b4656;
      --door: #14283c; --door-line: #5b9fe0; --questions: #12301f; --questions-line: #4fb587;
      --runs: #33270f; --runs-line: #d69b3a; --worlds: #361c17; --worlds-line: #de7a63;
      --contracts: #271f38; --contracts-line: #a688dc; --numbers: #10292f; --numbers-line: #52b2c8;
    }
  }
"""


def layers() -> list[list[str]]:
    """Rooms by layer, highest first, as the import contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (found,) = [one["layers"] for one in contracts if one["type"] == "layers"]
    return [[name.strip().removeprefix("mdnum.") for name in layer.split("|")] for layer in found]


@cache
def source(room: str) -> tuple[Path, list[Path]]:
    """The file with a room's docstring, and all of its files."""
    folder = ROOT / "mdnum" / room
    if folder.is_dir():
        return folder / "__init__.py", sorted(folder.rglob("*.py"))
    return folder.with_suffix(".py"), [folder.with_suffix(".py")]


@cache
def about(room: str) -> str:
    """The first sentence of its docstring, on one line."""
    text = ast.get_docstring(ast.parse(source(room)[0].read_text(encoding="utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split()).rstrip(".")


@cache
def imports(room: str) -> set[str]:
    """Other rooms that its files import, when they are imported or when a function is called."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if isinstance(node, ast.ImportFrom) and node.module == "mdnum":
            found.update(one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mdnum."):
            found.add(str(node.module).split(".")[1])
        elif isinstance(node, ast.Import):
            found.update(one.name.split(".")[1] for one in node.names if one.name.startswith("mdnum."))
        for child in ast.iter_child_nodes(node):
            visit(child)

    for path in source(room)[1]:
        visit(ast.parse(path.read_text(encoding="utf-8")))
    return (found & {name for layer in layers() for name in layer}) - {room}


def reduced(uses: dict[str, set[str]]) -> Iterator[tuple[str, str]]:
    """The imports that no longer way implies, as (who, whom)."""

    def reached(room: str) -> set[str]:
        return uses[room].union(*map(reached, uses[room]))

    for room, used in uses.items():
        implied = set().union(*(reached(other) for other in used))
        yield from ((room, other) for other in sorted(used - implied))


@dataclass(frozen=True)
class Box:
    """Where a room stands, in pixels."""

    row: int
    left: float
    right: float

    @property
    def top(self) -> float:
        return TOP + BAND * self.row

    def near(self, x: float) -> float:
        """The place on its upper or lower edge that is nearest to x."""
        return min(max(x, self.left + 22), self.right - 22)


def placed(upper: list[list[str]]) -> dict[str, Box]:
    """Every room in its layer and column."""
    found = {}
    for row, layer in enumerate(upper):
        free = [k for k in range(len(COLUMNS)) if k not in {COLUMN.get(room) for room in layer}]
        for room in layer:
            column = COLUMN[room] if room in COLUMN else free.pop(0)
            found[room] = Box(row, *COLUMNS[column])
    return found


def drawing() -> str:
    """The picture."""
    order = layers()
    depth = next(k for k, layer in enumerate(order) if GROUND in layer) + 1
    upper, ground = order[:depth], order[depth:]
    boxes = placed(upper)
    shapes: list[str] = []
    kind = "door"
    for layer in upper:
        kind = next((KINDS[room] for room in layer if room in KINDS), kind)
        shapes += [shape for room in layer for shape in drawn(room, boxes[room], kind)]
    bands = [
        f'<rect x="12" y="{TOP + BAND * row - 8}" width="{WIDTH - 24}" height="{HIGH + 16}" rx="10" '
        'style="fill: var(--band)"/>'
        for row in range(depth)
    ]
    edges = arrows(list(reduced({room: imports(room) & boxes.keys() for room in boxes})), boxes)
    top = TOP + BAND * depth
    height = top + 54 + (CHIP + 8) * len(ground)
    shapes.append(
        f'<rect x="12" y="{top}" width="{WIDTH - 24}" height="{height - top - 12}" rx="10" '
        'style="fill: var(--ground); stroke: var(--line)"/>'
        f'<text class="quiet" x="26" y="{top + 21}">ground: modules that every room above may import</text>'
    )
    for row, layer in enumerate(ground):
        widths = [7.6 * len(room) + 22 for room in layer]
        left, y = (WIDTH - sum(widths) - 8 * (len(layer) - 1)) / 2, top + 32 + (CHIP + 8) * row
        for room, width in zip(layer, widths, strict=True):
            shapes.append(
                f'<rect x="{left:.1f}" y="{y}" width="{width:.1f}" height="{CHIP}" rx="6" '
                'style="fill: var(--paper); stroke: var(--line)"/>'
                f'<text x="{left + width / 2:.1f}" y="{y + 17.5}" text-anchor="middle">{room}</text>'
            )
            left += width + 8
    legend, left = [], 26.0
    for name, words in LEGEND.items():
        legend.append(
            f'<rect x="{left:.1f}" y="12" width="13" height="13" rx="3" '
            f'style="fill: var(--{name}); stroke: var(--{name}-line)"/>'
            f'<text class="quiet" x="{left + 19:.1f}" y="23">{words}</text>'
        )
        left += 44 + 6.6 * len(words)
    described = f"The rooms of mdnum in {len(order)} layers; every arrow, an import, leads downward."
    tip = '<path d="M0 0.8 L7.4 4 L0 7.2 z" style="fill: var(--edge)"/>'
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" role="img" '
        f'aria-label="{described}">',
        f"<style>{STYLE}</style>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        f'orient="auto">{tip}</marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" style="fill: var(--paper)"/>',
        *legend, *bands, *edges, *shapes, "</svg>\n",
    ])  # fmt: skip


def drawn(room: str, box: Box, kind: str) -> list[str]:
    """A room: its name, and the first sentence of its docstring on two lines."""
    text, across = about(room).replace("`", ""), int((box.right - box.left - 14) / 5.55)
    # a sentence that is too long ends at a mark where it can
    while (
        len(lines := wrap(text, across)) > 2 and (marks := [text.rfind(mark) for mark in ",;:"]) != [-1] * 3
    ):
        text = text[: max(marks)]
    middle = (box.left + box.right) / 2
    return [
        f'<rect x="{box.left}" y="{box.top}" width="{box.right - box.left}" height="{HIGH}" rx="8" '
        f'style="fill: var(--{kind}); stroke: var(--{kind}-line)"/>',
        f'<text class="name" x="{middle}" y="{box.top + 18}" text-anchor="middle">{room}</text>',
        *(
            f'<text class="quiet" x="{middle}" y="{y}" text-anchor="middle">{escape(line)}</text>'
            for y, line in zip((box.top + 33, box.top + 47), lines, strict=False)
        ),
    ]


def arrows(edges: list[tuple[str, str]], boxes: dict[str, Box]) -> list[str]:
    """A path for each import: straight down between the boxes of the rows that it passes."""
    taken: list[tuple[float, float, float]] = []  # place across, from, to
    ends: dict[tuple[str, bool], list[float]] = {}

    def free(x: float, begin: float, end: float) -> bool:
        return all(abs(x - at) >= APART or end <= top or bottom <= begin for at, top, bottom in taken)

    def passes(x: float, rows: range) -> bool:
        return 8 < x < WIDTH - 8 and not any(
            box.row in rows and box.left - 9 < x < box.right + 9 for box in boxes.values()
        )

    def docked(room: str, lower: bool, x: float) -> float:
        """A place on the edge of a box that no other arrow has."""
        box, used = boxes[room], ends.setdefault((room, lower), [])
        wanted = box.near(x)
        tries = sorted(
            (box.near(wanted + APART * k) for k in range(-20, 21)), key=lambda at: abs(at - wanted)
        )
        found = next((at for at in tries if all(abs(at - other) >= APART for other in used)), wanted)
        used.append(found)
        return found

    paths = []
    for who, whom in sorted(edges, key=lambda one: boxes[one[1]].row - boxes[one[0]].row):
        a, b = boxes[who], boxes[whom]
        begin, end = a.top + HIGH, b.top
        middle = (max(a.left, b.left) + min(a.right, b.right)) / 2
        rows = range(a.row + 1, b.row)
        if not rows:
            x, y = docked(who, True, middle), docked(whom, False, middle)
            half = (begin + end) / 2
            paths.append(f"M{x:.1f} {begin} C{x:.1f} {half}, {y:.1f} {half}, {y:.1f} {end}")
            continue
        lanes = [x for x in range(10, WIDTH, 2) if passes(x, rows) and free(x, begin, end)]
        lane = min(lanes, key=lambda x: abs(x - a.near(x)) + abs(x - b.near(x)) + 0.01 * abs(x - middle))
        taken.append((lane, begin, end))
        x, y, bend = docked(who, True, lane), docked(whom, False, lane), BAND - HIGH
        down, up = begin + bend / 2, end - bend / 2
        paths.append(
            f"M{x:.1f} {begin} C{x:.1f} {down}, {lane} {down}, {lane} {begin + bend} "
            f"L{lane} {end - bend} C{lane} {up}, {y:.1f} {up}, {y:.1f} {end}"
        )
    return [f'<path class="edge" marker-end="url(#tip)" d="{path}"/>' for path in paths]


def table() -> str:
    """What each room is for and which it imports, highest layer first."""
    rows, order = [], [room for layer in layers() for room in layer]
    for room in order:
        used = ", ".join(f"`{other}`" for other in order if other in imports(room)) or "nothing of mdnum"
        rows.append((f"`{room}`", about(room), used))
    return markdown(("room", "what it is for", "imports"), rows)


def main() -> None:
    """Write both, or compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if not current")
    asked = parser.parse_args()
    write({PICTURE: drawing(), PAGE: between(PAGE, MARK, table())}, asked.check)


if __name__ == "__main__":
    main()
