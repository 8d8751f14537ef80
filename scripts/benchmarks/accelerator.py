"""How much data does a recorded run transfer between host and accelerator, and how fast are its steps?

Answer. 112 bytes per flip (at most twice this number) and 8 bytes per atom and list are transferred to the
host, and 25 bytes per step to the device. An H200 makes 490 steps per second with 4,000 atoms and 64 with
256,000 (docs/speed.md). It takes minutes.

The Lennard-Jones liquid of LAMMPS's bench/in.lj, recorded, with lists that are built on the device. After a
warm-up every transfer of the loop is counted: what is read of the device's arrays, and what is put there;
anything that would go there without being put is refused (jax.transfer_guard).

How to read it. A step needs no word of the host. A list needs two numbers of the search, some of the loop
that has ended and the order of its atoms; a flip brings its row. So bytes to the host are those of flips, at
most twice, and 8 for each atom and list; bytes to the device do not depend on the number of atoms. Where jax
finds no accelerator, the second of two forced host devices stands in for one, with XLA's loops in the place
of the compiled one: its bytes are those of an accelerator, its times mean nothing.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import _shared  # noqa: F401  what scripts share is found by it
import jax
import numpy as np
from _liquid import liquid
from _output import parser, say, start, table
from _processes import machine

from mdnum.md import foreign
from mdnum.rollout import Engine, PairRecorder
from mdnum.systems import build


@contextmanager
def counted() -> Iterator[dict[str, int]]:
    """Bytes that cross while this lasts, to the host and to the device."""
    crossed = {"to_host": 0, "to_device": 0}
    put, kind = jax.device_put, type(jax.device_put(np.zeros(1)))
    value: Callable[[Any], np.ndarray] = kind._value.fget

    def reads(array: Any) -> np.ndarray:
        # what was read once is kept
        crossed["to_host"] += array.nbytes if array._npy_value is None else 0
        return value(array)

    def through(function: Callable) -> Callable:
        # numpy would look into the memory of a CPU's array without a word
        return lambda given, *args, **named: function(
            given._value if isinstance(given, kind) else given, *args, **named
        )

    def puts(tree: Any, *args: Any, **named: Any) -> Any:
        leaves = [leaf for leaf in jax.tree.leaves(tree) if not isinstance(leaf, kind)]
        crossed["to_device"] += sum(np.asarray(leaf).nbytes for leaf in leaves)
        return put(tree, *args, **named)

    with (
        mock.patch.object(kind, "_value", property(reads)),
        mock.patch.object(np, "asarray", through(np.asarray)),
        mock.patch.object(np, "array", through(np.array)),
        mock.patch.object(jax, "device_put", puts),
        jax.transfer_guard_host_to_device("disallow"),
    ):
        yield crossed


def measure(atoms: int, steps: int) -> dict[str, Any]:
    """A recorded run: rate, lists, flips and bytes after its first lists."""
    simulation = replace(build(liquid(atoms)), builder="device")
    recorder, seen = PairRecorder(simulation), dict.fromkeys(("steps", "stretches", "lists", "flips"), 0)
    segments = Engine(simulation, 10**9, rows=False).segments()
    for _ in range(4):
        recorder.flips(next(segments))
    with counted() as crossed:
        begun = time.perf_counter()
        while seen["steps"] < steps:
            segment = next(segments)
            recorder.counts(segment)
            recorder.ambiguous(segment)
            seen["flips"] += len(recorder.flips(segment))
            seen["steps"] += segment.rows
            seen["stretches"] += 1
            seen["lists"] += segment.opens
        seconds = time.perf_counter() - begun
    return {"atoms": simulation.atoms, **seen, **crossed, "steps_per_second": seen["steps"] / seconds}


def main() -> None:
    """Measure each size and print."""
    made = parser(__doc__)
    made.add_argument(
        "--sizes", nargs="+", type=int, metavar="N", default=[4_000, 32_000], help="atoms, about"
    )
    made.add_argument("--steps", type=int, default=200, help="that are counted, about")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    chosen = made.parse_args()
    # before jax looks for devices
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    where = jax.default_backend()
    if where == "cpu":
        where = "a CPU in the place of an accelerator"
        jax.config.update("jax_default_device", jax.devices()[1])
        foreign.known = lambda: False  # type: ignore[assignment]
    rows = []
    for atoms in chosen.sizes:
        say(f"N = {atoms:,}")
        rows.append(measure(atoms, chosen.steps))
    if chosen.json:
        print(json.dumps({"where": where, "sizes": rows, "machine": machine()}, indent=2))
        return
    print(f"on {where}: {machine()}")
    columns = (
        "N", "steps", "lists", "flips/step", "bytes/step to host", "of flips", "bytes/step to device",
        "steps/s",
    )  # fmt: skip
    cells = [
        [
            f"{row['atoms']:,}", row["steps"], row["lists"], row["flips"] / row["steps"],
            row["to_host"] / row["steps"], 112 * row["flips"] / row["steps"],
            row["to_device"] / row["steps"], row["steps_per_second"],
        ]
        for row in rows
    ]  # fmt: skip
    table("transfers", columns, cells)


if __name__ == "__main__":
    start(main)
