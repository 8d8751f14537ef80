"""Histories by a process of their own: what a boundary must survive before it is believed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from mdnum.errors import MdnumError
from mdnum.forks.dials import dial
from mdnum.forks.histories import history
from mdnum.systems.build import build
from mdnum.systems.load import System, load


def digests_elsewhere(system: System, key: str, steps: int, values: Sequence[float]) -> list[str]:
    """Digests of the histories at some values of a number, from a fresh process.

    The system is written to a folder and read again there, bit for bit, and its program is compiled anew,
    under the same environment.

    Raises:
        MdnumError: the process failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = system.write(Path(folder) / "system")
        asked = {"path": str(path), "key": key, "steps": steps, "values": [value.hex() for value in values]}
        done = subprocess.run(
            [sys.executable, "-m", "mdnum.forks.confirm"],
            input=json.dumps(asked),
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise MdnumError(
            f"the process that was to confirm boundaries failed: {last[0]}",
            remedy="Run `mdnum doctor`",
        )
    return list(json.loads(done.stdout))


def digests(system: System, key: str, steps: int, values: Sequence[float]) -> list[str]:
    """The same in this process, by the program that a user runs."""
    simulation = build(system)
    proper = dial(simulation, key).proper
    return [history(proper(simulation, value), steps).digest for value in values]


def main() -> None:
    """Answer one question, asked as JSON on standard input."""
    asked = json.load(sys.stdin)
    values = [float.fromhex(value) for value in asked["values"]]
    found = digests(load(asked["path"], world="md"), asked["key"], asked["steps"], values)
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
