"""Histories by a process of their own: what a boundary must survive before it is believed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

from mdnum.errors import MdnumError
from mdnum.forks.worlds import program_of
from mdnum.safe_path import environment, python
from mdnum.systems import BallSystem, System, load


def digests_elsewhere(
    system: System | BallSystem,
    key: str,
    steps: int,
    values: Sequence[float],
    progress: Callable[[int], None] | None = None,
    *,
    processes: int = 1,
) -> list[str]:
    """Digests of the histories at some values of a number, from a fresh process.

    The system is written to a folder and read again there, bit for bit, and its program is compiled anew,
    under the same environment.

    Args:
        progress: called with how many are known, at the start and after each.
        processes: that share the values; worth it where each value is another compiled program.

    Raises:
        MdnumError: a process failed.
    """
    done, lock = 0, Lock()

    def tell(more: int) -> None:
        nonlocal done
        with lock:
            done += more
            if progress is not None:
                progress(done)

    tell(0)
    with tempfile.TemporaryDirectory() as folder:
        path = system.write(Path(folder) / "system")
        asked = {"path": str(path), "key": key, "steps": steps}
        size = -(-len(values) // processes)
        parts = [values[first : first + size] for first in range(0, len(values), size)]
        with ThreadPoolExecutor(max(1, len(parts))) as pool:
            found = list(pool.map(lambda part: _answered(asked, part, lambda: tell(1)), parts))
    return [digest for part in found for digest in part]


def _answered(asked: dict[str, Any], values: Sequence[float], tell: Callable[[], None]) -> list[str]:
    """What one process says."""
    question = json.dumps({**asked, "values": [value.hex() for value in values]})
    command = python("-m", "mdnum.forks.confirm")
    found: list[str] = []
    # what it says on stderr may be long, and nobody reads a pipe meanwhile
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment(),
        ) as process:
            assert process.stdin is not None and process.stdout is not None
            try:
                # one that died before it read has said why
                with suppress(BrokenPipeError):
                    process.stdin.write(question)
                    process.stdin.close()
                for line in process.stdout:
                    found.append(line.strip())
                    tell()
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


def digests(system: System | BallSystem, key: str, steps: int, values: Sequence[float]) -> Iterator[str]:
    """The same in this process, by the program that a user runs."""
    number = program_of(system, steps).number(key)
    for value in values:
        yield number.proper(value).history(steps).digest


def main() -> None:
    """Answer one question, asked as JSON on standard input, a line for each value."""
    asked = json.load(sys.stdin)
    values = [float.fromhex(value) for value in asked["values"]]
    for found in digests(load(asked["path"]), asked["key"], asked["steps"], values):
        print(found, flush=True)


if __name__ == "__main__":
    main()
