"""Every tutorial parses and uses names that exist; the nightly executes it from first cell to last."""

from __future__ import annotations

import ast
import builtins
import re
import sys
from pathlib import Path

import pytest

import mdnum

FOLDER = Path(__file__).parents[2] / "docs" / "tutorials"
PAGES = sorted(path for path in FOLDER.glob("*.md") if path.name != "index.md")


def cells(text: str) -> list[str]:
    """The code of a MyST notebook, cell by cell."""
    return re.findall(r"^```\{code-cell\}[^\n]*\n(.*?)^```", text, re.S | re.M)


def undefined(code: str) -> set[str]:
    """Names that a notebook reads and never binds, and names that `mdnum` does not have."""
    nodes = list(ast.walk(ast.parse(code)))
    bound = {node.id for node in nodes if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)}
    bound |= {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    bound |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {(one.asname or one.name).partition(".")[0] for one in node.names}
    read = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    missing = read - bound - set(dir(builtins))
    of_mdnum = {
        node.attr
        for node in nodes
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mdnum"
    }
    return missing | {f"mdnum.{name}" for name in of_mdnum if name not in dir(mdnum)}


def test_there_are_tutorials():
    assert len(PAGES) >= 2


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_cells_parse_and_their_names_exist(path):
    code = cells(path.read_text())
    assert len(code) >= 3
    for cell in code:
        compile(cell, path.name, "exec")
    assert not undefined("\n".join(code))


def test_what_does_not_exist_is_found():
    code = "import mdnum\nmdnum.runs(there)\nfor x in (1, 2):\n    print(x)"
    assert undefined(code) == {"there", "mdnum.runs"}


def test_linked_pages_exist():
    links = {(path, link) for path in PAGES for link in re.findall(r"\]\(([^)#:]+\.md)", path.read_text())}
    assert links
    assert not [(path.name, link) for path, link in links if not (path.parent / link).exists()]


@pytest.mark.nightly
@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_tutorial_runs(path, tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    # the kernel of this interpreter, whatever others are installed
    (tmp_path / "kernels" / "here").mkdir(parents=True)
    (tmp_path / "kernels" / "here" / "kernel.json").write_text(
        '{"display_name": "here", "language": "python", '
        f'"argv": ["{sys.executable}", "-m", "ipykernel_launcher", "-f", "{{connection_file}}"]}}'
    )
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "3")
    book = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(cell) for cell in cells(path.read_text())]
    )
    where = {"metadata": {"path": tmp_path}}
    NotebookClient(book, kernel_name="here", timeout=600, resources=where).execute()
    outputs = [output for cell in book.cells for output in cell.outputs]
    figures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert figures, "a tutorial has a figure"
