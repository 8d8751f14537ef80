"""The picture of the package and the table of its rooms are those of the source."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPT = "scripts/makers/draw_architecture.py"


def checked(root: Path) -> tuple[int, str]:
    done = subprocess.run([sys.executable, str(root / SCRIPT), "--check"], capture_output=True, text=True)
    return done.returncode, done.stderr


def test_they_are_current():
    assert checked(ROOT) == (0, ""), f"run python {SCRIPT}"


def test_another_import_makes_them_stale(tmp_path: Path):
    for name in ("mdnum", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", SCRIPT):
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
