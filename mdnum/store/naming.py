"""Where a run goes when nobody says."""

from __future__ import annotations

import re
from pathlib import Path

_RUNS = Path("runs")


def default_folder(system: str, runs: Path = _RUNS) -> Path:
    """runs/NAME-N with the system's name in dashes and the first N past those that exist.

    Args:
        system: a system's name, or the path of its file.
        runs: the folder of run folders.
    """
    path = Path(system)
    word = path.stem if path.suffix == ".toml" else system
    slug = re.sub(r"[^A-Za-z0-9._]+", "-", word).strip("-.") or "run"
    taken = re.compile(re.escape(slug) + r"-(\d+)")
    numbers = [
        int(match[1])
        for entry in (runs.iterdir() if runs.is_dir() else ())
        if (match := taken.fullmatch(entry.name))
    ]
    return runs / f"{slug}-{max(numbers, default=0) + 1}"
