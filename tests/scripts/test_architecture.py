"""The picture of the package, the table of its rooms and those of the scripts are those of the source."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = "scripts/makers/draw_architecture.py"


def checked(root: Path, script: str = SCRIPT) -> tuple[int, str]:
    done = subprocess.run([sys.executable, str(root / script), "--check"], capture_output=True, text=True)
    return done.returncode, done.stderr


@pytest.mark.parametrize("script", [SCRIPT, "scripts/makers/list_scripts.py"])
def test_they_are_current(script: str):
    assert checked(ROOT, script) == (0, ""), f"run python {script}"


def test_every_script_says_its_question_its_answer_and_how_long_it_takes(tmp_path: Path):
    copy = tmp_path / "scripts"
    shutil.copytree(ROOT / "scripts", copy, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "scripts.md", tmp_path / "docs")
    study = copy / "studies" / "time_steps.py"
    source = study.read_text()
    for words, other in (("?", "."), ("Answer. ", ""), (" It takes ", " It took ")):
        study.write_text(source.replace(words, other))
        code, said = checked(tmp_path, "scripts/makers/list_scripts.py")
        assert code == 1 and "time_steps.py" in said


def test_another_import_makes_them_stale(tmp_path: Path):
    for name in ("mdnum", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "scripts/_pages.py", "scripts/makers/_shared.py", SCRIPT):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    room = tmp_path / "mdnum" / "report" / "words.py"
    source = room.read_text()
    # for annotations alone, which is none; then inside a function
    room.write_text(f"{source}\nif TYPE_CHECKING:\n    from mdnum.gradients import Problem\n")
    assert checked(tmp_path) == (0, "")
    room.write_text(f"{source}\n\ndef late():\n    from mdnum.gradients import Problem\n")
    code, said = checked(tmp_path)
    assert code == 1
    assert said.split("\n")[:2] == [
        f"{Path('docs', *page)} is not current"
        for page in (("figures", "architecture.svg"), ("architecture.md",))
    ]


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md", "docs/compiled-loop.md"])
def test_every_file_that_a_page_names_is_there(page: str):
    """By its place in the repository or in mdnum; a module by its name alone, beside others of its folder."""
    known = [path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*") if ".git" not in path.parts]
    names = set(
        re.findall(r"`([\w./-]+(?:\.py|/[\w-]+\.(?:toml|json|md)|/))(?:::\w+)?`", (ROOT / page).read_text())
    )
    meant = {name.rstrip("/") for name in names if not re.search(r"NAME|VERB|NN_", name)}
    missing = [name for name in meant if not any(f"/{path}".endswith(f"/{name}") for path in known)]
    assert len(meant) > 8 and missing == []
