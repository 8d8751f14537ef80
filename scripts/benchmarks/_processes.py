"""What a whole process takes, memory over a run and time to the first step; and what it ran on."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
from _liquid import liquid

from mdnum.provenance import cpu, package_versions


def machine() -> str:
    """What it ran on, in a line."""
    processor, versions = cpu(), package_versions()
    named = ", ".join(
        f"{name} {versions[name]}" for name in ("mdnum", "jax", "jax-md", "numba", "numpy", "vesin")
    )
    load = f", load {os.getloadavg()[0]:.1f} at the end" if hasattr(os, "getloadavg") else ""
    return f"{processor['model']}, {processor['cores']} cores{load}; Python {sys.version.split()[0]}, {named}"


def start_up() -> dict[str, float]:
    """Seconds that a fresh process needs to the first step of argon/liquid-864, and the CPU time of it."""
    with tempfile.TemporaryDirectory() as scratch:
        words = [
            "run",
            "argon/liquid-864",
            "--steps",
            "1",
            "--no-check",
            "--no-report",
            "-o",
            f"{scratch}/run",
        ]
        before, begin = children_seconds(), time.perf_counter()
        subprocess.run([sys.executable, "-m", "mdnum", *words], check=True, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - begin
    return {"seconds": wall, "cpu_seconds": children_seconds() - before}


def children_seconds() -> float:
    """CPU seconds of all processes that this one has started and seen end."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def memory(atoms: int, steps: int) -> list[dict[str, float]]:
    """Peak memory of a process that runs into a folder, after each quarter of the steps."""
    done = subprocess.run(
        [sys.executable, __file__, str(atoms), str(steps)], check=True, stdout=subprocess.PIPE, text=True
    )
    return json.loads(done.stdout)


def _memory_of(atoms: int, steps: int) -> None:
    """The process that memory() looks at."""
    import mdnum

    seen: list[dict[str, float]] = []

    def look(step: int, _: int, info: dict[str, Any]) -> None:
        if info["phase"] == "run" and 4 * step >= (len(seen) + 1) * steps:
            seen.append({"step": step, "flips": info["flips"], "peak_mb": peak_mb()})

    with tempfile.TemporaryDirectory() as scratch:
        mdnum.run(liquid(atoms), out=f"{scratch}/run", steps=steps, progress=look)
    print(json.dumps(seen))


def peak_mb() -> float:
    """Peak memory of this process, MB."""
    status = Path("/proc/self/status")
    if status.is_file():
        # getrusage would answer with the peak of the parent process where that is larger
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmHWM:")]
        return int(line.split()[1]) / 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    _memory_of(int(sys.argv[1]), int(sys.argv[2]))
