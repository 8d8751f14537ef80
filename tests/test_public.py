"""What programs outside of the package import is documented, and documented modules exist."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import mdnum

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "python.md").read_text()
DOCUMENTED = set(re.findall(r"`(mdnum(?:\.[a-z]+)+)`", PAGE))
#: Scripts that look into the package itself: its files, its pages, its processes.
INSIDE = {
    "accelerator.py": {"mdnum.md"},
    "_processes.py": {"mdnum.provenance"},
    "killed_sweeps.py": {"mdnum.sweeps", "mdnum.sweeps.measures", "mdnum.verbs"},
    "learned_gradients.py": {"mdnum.md"},
    "lost_flips.py": {"mdnum.plain"},
    "measure_documents.py": {"mdnum.provenance"},
    "make_systems.py": {"mdnum.systems.load", "mdnum.systems.structures"},
    "scaling.py": {"mdnum.safe_path"},
    "sweep_overhead.py": {"mdnum.sweeps.measures", "mdnum.verbs"},
}
PROGRAMS = sorted([*(ROOT / "scripts").rglob("*.py"), *(ROOT / "examples").glob("*.py")])


def imported(path: Path) -> set[str]:
    """Modules of the package that a program imports from."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mdnum."):
            found.add(str(node.module))
        elif isinstance(node, ast.ImportFrom) and node.module == "mdnum":
            found |= {f"mdnum.{one.name}" for one in node.names if f"mdnum.{one.name}" in DOCUMENTED}
    return found


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.name)
def test_a_program_imports_documented_modules(path):
    assert imported(path) - DOCUMENTED == INSIDE.get(path.name, set())


def test_documented_modules_are_attributes_and_say_what_they_are():
    assert len(DOCUMENTED) > 30
    assert all(importlib.import_module(name).__doc__ for name in DOCUMENTED)
    # in a process that has imported nothing else
    names = [name for name in DOCUMENTED if name.count(".") == 1]
    program = f"import mdnum, types; assert all(isinstance(eval(n), types.ModuleType) for n in {names})"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_every_name_has_an_example_that_can_be_read():
    for name in mdnum.__all__:
        thing = getattr(mdnum, name)
        if name == "__version__" or isinstance(thing, ModuleType) or name.endswith("Error"):
            continue
        examples = doctest.DocTestParser().get_examples(inspect.getdoc(thing) or "")
        assert examples, name
        for one in examples:
            ast.parse(one.source)


@pytest.mark.usefixtures("strangers_folder")
def test_the_programs_of_the_page_run():
    seen: dict[str, Any] = {}
    for program in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(program, seen)
    assert seen["again"] == seen["outcome"] and Path("heights.png").stat().st_size > 5_000
    assert set(seen["slopes"]) == {"sigma", "cutoff.radius"} and all(
        map(np.isfinite, seen["slopes"].values())
    )
