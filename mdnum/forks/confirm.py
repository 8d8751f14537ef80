"""Histories by a process of their own: what a boundary must survive before it is believed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mdnum.errors import MdnumError
from mdnum.forks.dials import dial
from mdnum.forks.histories import history
from mdnum.systems.build import build
from mdnum.systems.load import System, load


def digests_elsewhere(
    system: System,
    key: str,
    steps: int,
    values: Sequence[float],
    progress: Callable[[int], None] | None = None,
) -> list[str]:
    """Digests of the histories at some values of a number, from a fresh process.

    The system is written to a folder and read again there, bit for bit, and its program is compiled anew,
    under the same environment.

    Args:
        progress: called with how many are known, at the start and after each.

    Raises:
        MdnumError: the process failed.
    """
    tell = progress if progress is not None else (lambda done: None)
    with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "errors", "w+") as errors:
        path = system.write(Path(folder) / "system")
        asked = {"path": str(path), "key": key, "steps": steps, "values": [value.hex() for value in values]}
        command = [sys.executable, "-m", "mdnum.forks.confirm"]
        found: list[str] = []
        tell(0)
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process:
            assert process.stdin is not None and process.stdout is not None
            try:
                process.stdin.write(json.dumps(asked))
                process.stdin.close()
                for line in process.stdout:
                    found.append(line.strip())
                    tell(len(found))
            except BaseException:
                process.kill()
                raise
        if process.returncode or len(found) != len(values):
            errors.seek(0)
            last = errors.read().strip().splitlines()[-1:] or ["no message"]
            raise MdnumError(
                f"the process that was to confirm boundaries failed: {last[0]}", remedy="Run `mdnum doctor`"
            )
    return found


def digests(system: System, key: str, steps: int, values: Sequence[float]) -> Iterator[str]:
    """The same in this process, by the program that a user runs."""
    simulation = build(system)
    proper = dial(simulation, key).proper
    for value in values:
        yield history(proper(simulation, value), steps).digest


def main() -> None:
    """Answer one question, asked as JSON on standard input, a line for each value."""
    asked = json.load(sys.stdin)
    values = [float.fromhex(value) for value in asked["values"]]
    for found in digests(load(asked["path"], world="md"), asked["key"], asked["steps"], values):
        print(found, flush=True)


if __name__ == "__main__":
    main()
