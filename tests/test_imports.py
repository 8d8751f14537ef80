"""Imports go downward, and nobody pays for what they do not use."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tokenize
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import jaxtyping
import numpy as np
import pytest
from importlinter.application import use_cases
from importlinter.configuration import configure

import mdnum

ROOT = Path(__file__).parents[1]
# each costs tenths of a second to seconds
HEAVY = {
    "MDAnalysis", "ase", "equinox", "jax", "jax_md", "jaxlib", "jinja2", "matplotlib", "numba", "numpy",
    "pandas", "pyarrow", "pydantic", "rich", "scipy", "vesin",
}  # fmt: skip


def _modules_after(code: str, *arguments: str) -> set[str]:
    """Top-level names in sys.modules at the exit of a fresh process that ran code."""
    program = (
        "import atexit, sys\n"
        "atexit.register(lambda: print('\\nMODULES', *{m.split('.')[0] for m in sys.modules}))\n" + code
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True, timeout=60
    )
    line = done.stdout.strip().splitlines()[-1]
    assert line.startswith("MODULES ")
    return set(line.split()[1:])


def test_import_contracts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """The layers of pyproject.toml, jax_md in one file alone, an event core that knows neither world."""
    monkeypatch.chdir(ROOT)
    configure()
    kept = use_cases.lint_imports(cache_dir=None, no_logo=True)
    assert kept, capsys.readouterr().out


def test_no_module_imports_itself_through_others():
    """Those inside functions count, those for type checkers do not. Only commands import the package."""
    graph = grimp.build_graph("mdnum", exclude_type_checking_imports=True, cache_dir=None)

    def in_order() -> list[str]:
        imports = {one: graph.find_modules_directly_imported_by(one) - {one} for one in graph.modules}
        return list(TopologicalSorter(imports).static_order())

    assert in_order().index("mdnum.errors") < in_order().index("mdnum.store.files")
    above = {one for one in graph.find_modules_that_directly_import("mdnum") if one.startswith("mdnum.cli.")}
    assert above == graph.find_modules_that_directly_import("mdnum")
    graph.add_import(importer="mdnum.errors", imported="mdnum.store.files")
    with pytest.raises(CycleError):
        in_order()


def test_importing_brings_in_neither_jax_nor_jax_md():
    loaded = _modules_after("import mdnum, mdnum.cli, mdnum.systems, mdnum.__main__")
    assert not {"jax", "jaxlib", "jax_md", "ase", "matplotlib"} & loaded


def test_a_fork_of_a_ball_brings_in_no_molecular_dynamics():
    """Every module that it runs, those that are imported late included."""
    loaded = _modules_after(
        "import mdnum.cli, mdnum.verbs.fork_map, mdnum.verbs.fork_certify, mdnum.forks.choices\n"
        "import mdnum.forks.boundaries, mdnum.forks.exact.certify, mdnum.forks.pair\n"
        "assert not [name for name in sys.modules if name.startswith(('mdnum.md', 'mdnum.rollout'))]\n"
    )
    assert "jax" in loaded and "jax_md" not in loaded


VERBS = ("run", "audit", "ball", "fork", "check pairs", "conform", "systems", "report", "doctor")


# typer itself imports pydantic to read the options of a verb, in some versions
@pytest.mark.parametrize(
    ("verbs", "allowed"), [(("", "--version"), set()), (VERBS, {"pydantic"})], ids=["all", "verbs"]
)
def test_help_imports_nothing_heavy(verbs: tuple[str, ...], allowed: set[str]):
    """What makes help fast is what it does not import; a wall clock would measure the machine."""
    loaded = _modules_after(
        "import contextlib\nfrom mdnum.cli import main\n"
        "for verb in sys.argv[1:]:\n"
        "    with contextlib.suppress(SystemExit):\n"
        "        main([*verb.split(), '--help' if verb != '--version' else verb])\n",
        *verbs,
    )
    assert "typer" in loaded and not (HEAVY - allowed) & loaded


def test_a_list_of_systems_loads_none_of_them():
    loaded = _modules_after("from mdnum.cli import main\nmain(sys.argv[1:])\n", "systems", "list")
    assert "rich" in loaded and not {"jax", "MDAnalysis", "ase", "matplotlib", "numba", "scipy"} & loaded


def test_a_shell_completes_without_anything_heavy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COMP_WORDS", "mdnum fork arg")
    monkeypatch.setenv("COMP_CWORD", "2")
    monkeypatch.setenv("_MDNUM_COMPLETE", "complete_bash")
    # typer itself imports pydantic to read the options of a verb, in some versions
    loaded = _modules_after("from mdnum.cli import main\nmain([])\n")
    assert "typer" in loaded and not (HEAVY - {"pydantic"}) & loaded


def test_help_imports_few_modules():
    """Counted, because what a module costs in time depends on what else a machine is doing."""
    program = "import atexit, sys\natexit.register(lambda: print('MODULES', len(sys.modules)))\n"
    words = [sys.executable, "-c", program + "from mdnum.cli import main\nmain(['--help'])"]
    done = subprocess.run(words, check=True, capture_output=True, text=True, timeout=60)
    # 223 where this was written, which take 0.1 to 0.3 s; jax alone brings in a thousand
    assert 100 < int(done.stdout.split("MODULES ")[1]) < 300


def test_public_names_resolve():
    for name in mdnum.__all__:
        assert getattr(mdnum, name) is not None
    assert set(mdnum.__all__) <= set(dir(mdnum))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        mdnum.nonsense  # noqa: B018


def _undefined_names(*paths: str) -> list[str]:
    """Names that are nowhere defined, by place: ruff's, less the words of strings.

    ruff takes the axes of jaxtyping's annotations for names, so pyproject.toml switches the rule off.
    """
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--no-cache", "--exit-zero"]
    options = ["--select", "F821", "--target-version", "py311", "--output-format", "json"]
    done = subprocess.run([*command, *options, *paths], cwd=ROOT, capture_output=True, text=True, check=True)
    found: dict[str, list[tuple[int, int, str]]] = {}
    for item in json.loads(done.stdout):
        place, name = item["location"], item["message"].split("`")[1]
        found.setdefault(item["filename"], []).append((place["row"], place["column"] - 1, name))
    undefined = []
    for file, places in found.items():
        with tokenize.open(file) as source:
            strings = [
                (token.start, token.end)
                for token in tokenize.generate_tokens(source.readline)
                # before Python 3.12 an f-string is one token, with names in it
                if token.type == tokenize.STRING
                and "f" not in token.string.split(token.string[-1])[0].lower()
            ]
        for row, column, name in places:
            if not any(start <= (row, column) < end for start, end in strings):
                undefined.append(f"{Path(file).name}:{row} {name}")
    return undefined


def test_every_name_is_defined(tmp_path: Path):
    planted = tmp_path / "planted.py"
    planted.write_text('def f(x: Float[int, "atoms 3"], y: "axes"):\n    return nmae, f"{othr} {x}"\n')
    assert _undefined_names(str(planted)) == ["planted.py:1 Float", "planted.py:2 nmae", "planted.py:2 othr"]
    assert _undefined_names("mdnum", "demos", "scripts", "tests") == []


@pytest.mark.skipif(os.environ.get("MDNUM_TEST_TYPES") == "off", reason="annotations are not checked")
def test_annotations_are_checked():
    """Of functions, of results of functions and of the fields of a dataclass."""
    from mdnum.md.cell import Cell, wrap_positions
    from mdnum.md.neighbors import RebuildRule

    cell = Cell.create(np.eye(3), (True, True, True))
    for wrong in (np.zeros((4, 2)), np.zeros((4, 3), np.int32)):
        with pytest.raises(jaxtyping.TypeCheckError, match="wrap_positions"):
            wrap_positions(cell, wrong)
    with pytest.raises(jaxtyping.TypeCheckError, match="RebuildRule"):
        RebuildRule("0.3")  # type: ignore[arg-type]
