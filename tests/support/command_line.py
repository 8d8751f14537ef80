"""The command line as a test calls it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from mdnum.cli import main
from mdnum.errors import InputError
from mdnum.report.finding import conclude, restore
from mdnum.report.section import Key, Page, Section, records
from mdnum.verbs.outcome import Outcome

SHOWN = Section("Lists", ["Sound.", records([{"name": "a", "pairs": n} for n in range(30)])], terminal=True)
HIDDEN = Section("Details", ["On the page alone."])


def call(*arguments: str) -> int:
    """The exit code of `mdnum ARGUMENTS`."""
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def printed(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Lines of stdout with single spaces."""
    return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]


@dataclass
class Recorder:
    """A verb that remembers how it was called, and answers or fails as it was told to."""

    summary: dict[str, Any] | None = None
    error: BaseException | None = None
    calls: list[tuple[Any, dict[str, Any]]] = field(default_factory=list)

    def __call__(self, system: Any, **options: Any) -> Outcome:
        self.calls.append((system, options))
        if self.error is not None or self.summary is None:
            raise self.error or InputError("enough")
        options["progress"](1, 200, {"phase": "run", "steps_per_second": 10.0, "flips": 1, "rebuilds": 0})
        verdict = conclude(map(restore, self.summary["findings"]), headline="2,464 flips, none ambiguous.")
        keys = [Key("Flips", "2,464", "1,234 entered, 1,230 left")]
        page = Page("argon/crystal-108", "108 atoms", keys, [SHOWN, HIDDEN])
        folder = options.get("out") or options.get("resume") or "runs/argon-crystal-108-1"
        told = (Path(folder), "md", "run", page.title, self.summary, verdict, tuple(keys))
        return Outcome(*told, _page=page)
