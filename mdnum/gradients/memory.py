"""How much memory a way of differentiating takes, worked out before it starts."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import jax

from mdnum.gradients.program import keep
from mdnum.gradients.steps import Steps
from mdnum.gradients.tape import KEPT

#: Share of the free memory that a method may plan with.
_SHARE = 0.8
#: No reverse function of pair forces was seen to keep more than a third of this for each slot of a list
#: and step, in bytes.
_MOST_PER_SLOT = 1024
#: What the two records of a rollout and its compiled programs take, bytes.
_RUN = 2**28


def free() -> int:
    """Memory that methods may plan with, bytes.

    The kernel's estimate of what can be had without swapping, or the limit of the container where that is
    less.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        amount = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        amount = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:
        limit = used = "max"
    if limit != "max":
        amount = min(amount, int(limit) - int(used))
    return int(_SHARE * max(amount, 0))


def per_chunk(program: Steps) -> int:
    """What the reverse function of one chunk keeps, bytes; nothing is run for it."""
    place, tables = program.told(program.start)
    arguments = (program.inputs, program.start.between, program.fixed, place, tables)
    _, back, _ = jax.eval_shape(lambda *args: keep(*args, rule=program.rule), *arguments)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(back))


def needs(program: Steps) -> dict[str, int]:
    """About how much each method takes, bytes, by its word.

    Lists that end early make chunks that are not full, so that these are lower bounds.
    """
    return _with_chunks_of(program, per_chunk(program))


def _with_chunks_of(program: Steps, chunk: int) -> dict[str, int]:
    steps, state = program.problem.steps + 1, program.start.nbytes
    chunks = -(-steps // program.chunk)
    table = program.list_of(program.start)[0]
    # what a rollout records of a step: positions, velocities, images, decisions
    row = program.simulation.atoms * (2 * 24 + 12 + table.slots // 8)
    return {
        "unrolled": _RUN + chunks * chunk,
        "epochs": _RUN + chunks * state + chunk,
        "recursive": _RUN + chunks.bit_length() * state + chunk,
        "symmetric": _RUN + min(KEPT, steps * row),
    }


def why_not(program: Steps, method: str, room: int | None) -> str | None:
    """Why a method does not fit into memory; None where it does.

    Args:
        program: the rollout.
        method: its word.
        room: bytes; None: what is free.
    """
    room = free() if room is None else room
    if program.simulation.pairwise:
        slots = program.list_of(program.start)[0].slots * program.simulation.atoms
        if _with_chunks_of(program, program.chunk * slots * _MOST_PER_SLOT)[method] <= room:
            # far from it: not worth the seconds that exact numbers take
            return None
    needed = needs(program)
    if needed[method] <= room:
        return None
    return (
        f"{program.problem.steps} steps of {program.simulation.atoms} atoms would need about "
        f"{in_words(needed[method])} and {in_words(room)} are free; {_fitting(needed, room)}"
    )


def _fitting(needed: Mapping[str, int], room: int) -> str:
    others = [f"{word} needs about {in_words(size)}" for word, size in needed.items() if size <= room]
    if not others:
        return "no other method needs as little as that"
    return ", ".join(others)


def in_words(size: float) -> str:
    """Bytes as people say them."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
