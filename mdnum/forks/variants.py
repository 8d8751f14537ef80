"""One system, several programs: compiled or not, in a batch, inside a gradient, for other processors.

They compute the same formulas, and the compiler is free to round them otherwise. XLA's flags belong to a
process, so each variant runs in one of its own and hands back a hash of every step. Variants whose hashes
are equal are one program as far as numbers go; where they are not, the pattern of who agrees with whom
tells the cause.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, MdnumError
from mdnum.forks.child import ProgramName
from mdnum.md.cell import Cell, displacement
from mdnum.safe_path import environment, python
from mdnum.systems.load import System

_PROCESSES = 2
_TIMEOUT = 600
_NO_FMA = ("--xla_cpu_max_isa=AVX",)


@dataclass(frozen=True)
class Variant:
    """A way to run the same steps.

    Attributes:
        name: what to call it.
        program: "scan" (one compiled loop), "rollout" (mdnum's own), "vmap" (the first of a batch of equal
            copies), "grad" (the primal inside value_and_grad) or "eager" (operation by operation).
        flags: of XLA.
        reduction: order of the force sums; None for the system's own.
    """

    name: str
    program: ProgramName = "scan"
    flags: tuple[str, ...] = ()
    reduction: str | None = None


REFERENCE = Variant("scan")
VARIANTS: tuple[Variant, ...] = (
    REFERENCE,
    Variant("rollout", "rollout"),
    Variant("vmap", "vmap"),
    Variant("grad", "grad"),
    Variant("eager", "eager"),
    Variant("AVX", flags=_NO_FMA),
    Variant("SSE4.2", flags=("--xla_cpu_max_isa=SSE4_2",)),
    Variant("unoptimized", flags=("--xla_backend_optimization_level=0",)),
    Variant("rollout, AVX", "rollout", _NO_FMA),
    Variant("vmap, AVX", "vmap", _NO_FMA),
    Variant("grad, AVX", "grad", _NO_FMA),
    Variant("reversed", reduction="reversed"),
)


@dataclass(frozen=True)
class Ran:
    """What became of a variant.

    Attributes:
        variant: which.
        hashes: of the positions at steps 1, 2, ..., hexadecimal; empty where it failed.
        cluster: number of the variants that agree with it, from 0; -1 where it failed.
        first_bit: first step whose positions are not those of the reference; None where all are.
        separation: largest distance from the reference's atoms at the last common step, length.
        seconds: of its process.
        failed: the last line that a failed process said.
        separations: as `separation`, at steps 1, 2, ... as far as both ran.
    """

    variant: Variant
    hashes: tuple[str, ...]
    cluster: int
    first_bit: int | None
    separation: float
    seconds: float
    failed: str = ""
    separations: Float[np.ndarray, "steps"] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Variants:
    """Variants of one system, by what they compute.

    Attributes:
        rows: one a variant, in the order asked for.
        reference: name of the one that the others are compared with: the first that ran.
        steps: that it ran.
        causes: what tells the clusters apart: codes, each with its values.
    """

    rows: tuple[Ran, ...]
    reference: str
    steps: int
    causes: tuple[tuple[str, dict[str, Any]], ...]

    @property
    def clusters(self) -> list[list[str]]:
        """Names of the variants that agree with each other to the last bit, the reference's first."""
        count = max(row.cluster for row in self.rows) + 1
        return [[row.variant.name for row in self.rows if row.cluster == k] for k in range(count)]


def variants(
    system: System,
    steps: int = 200,
    which: Sequence[Variant] = VARIANTS,
    progress: Callable[[int, int, str], None] | None = None,
) -> Variants:
    """Run a system in several programs, two processes at a time, and tell which agree.

    All use one list, as wide as twice the skin where the box has room, and stop before it is used up. On
    another machine the clusters may be others: a processor without fused multiply-add has nothing to fuse.

    Args:
        system: as loaded; pair potentials only.
        steps: of each program; the eager one takes a dozen.
        which: the first one that runs is what the others are compared with; one that fails or takes too long
            says so in its row.
        progress: called with how many have ended, how many there are, and the name of the last.

    Raises:
        InputError: a many-body potential, no steps, or no variant.
        MdnumError: none of them ran.
    """
    if system.spec.cutoff is None:
        raise InputError("variants of a many-body potential are not there", where=system.name)
    if steps < 1 or not which:
        raise InputError("expected at least one step and one variant", where=f"steps = {steps}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        # a system changed in memory is on no disk; what is written loads bit for bit
        system.write(folder / "system")
        done, count = 0, Lock()

        def ran(k: int) -> tuple[Ran, Float[np.ndarray, "steps 3 atoms"] | None]:
            nonlocal done
            got = _process(which[k], folder, k, steps)
            with count:
                done += 1
                if progress is not None:
                    progress(done, len(which), which[k].name)
            return got

        pool = ThreadPoolExecutor(_PROCESSES)
        try:
            found = list(pool.map(ran, range(len(which))))
        finally:
            # after a control-C no further process is started
            pool.shutdown(cancel_futures=True)
    first = next((k for k, (_, x) in enumerate(found) if x is not None), None)
    if first is None:
        row = found[0][0]
        raise MdnumError(f"no variant ran; {row.variant.name!r} said: {row.failed}")
    reference, x = found[first]
    assert x is not None
    cell = Cell.create(np.asarray(system.atoms.cell), system.atoms.pbc)
    rows = _clustered([_dated(row, other, reference, x, cell) for row, other in found], reference)
    return Variants(tuple(rows), reference.variant.name, len(reference.hashes), tuple(_causes(rows)))


def _process(variant: Variant, folder: Path, k: int, steps: int) -> tuple[Ran, np.ndarray | None]:
    question = {
        "path": str(folder / "system"),
        "steps": steps,
        "program": variant.program,
        "reduction": variant.reduction,
        "out": str(folder / f"{k}.npy"),
    }
    flags = " ".join([os.environ.get("XLA_FLAGS", ""), *variant.flags]).strip()
    # a program cached by another variant must not answer for this one; these flags are a CPU's
    settings = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    begin = time.perf_counter()
    file = folder / f"{k}.json"
    file.write_text(json.dumps(question))
    command = python("-m", "mdnum.forks.child", str(file))
    failed = ""
    try:
        # nothing that a child prints may reach the output of the parent
        done = subprocess.run(
            command,
            env=environment(**settings),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            timeout=_TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        failed = f"took longer than {_TIMEOUT} s"
    else:
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            failed = lines[-1].strip() if lines else f"ended with exit code {done.returncode}"
    seconds = time.perf_counter() - begin
    if failed:
        return Ran(variant, (), -1, None, float("nan"), seconds, failed), None
    x = np.load(question["out"])
    hashes = tuple(hashlib.sha256(np.ascontiguousarray(row).tobytes()).hexdigest() for row in x)
    if not hashes:
        return Ran(variant, (), -1, None, float("nan"), seconds, "the skin was used up at once"), None
    return Ran(variant, hashes, -1, None, 0.0, seconds), x


def _dated(row: Ran, x: np.ndarray | None, reference: Ran, x_reference: np.ndarray, cell: Cell) -> Ran:
    if x is None:
        return row
    common = min(len(row.hashes), len(reference.hashes))
    pairs = zip(row.hashes[:common], reference.hashes[:common], strict=True)
    first_bit = next((step for step, (one, other) in enumerate(pairs, 1) if one != other), None)
    separations = np.zeros(common)
    for step in range(common):
        dx, dy, dz = displacement(cell, x_reference[step].T, x[step].T)
        separations[step] = np.sqrt((dx * dx + dy * dy + dz * dz).max())
    return replace(row, first_bit=first_bit, separation=float(separations[-1]), separations=separations)


def _agree(one: Ran, other: Ran) -> bool:
    common = min(len(one.hashes), len(other.hashes))
    return common > 0 and one.hashes[:common] == other.hashes[:common]


def _clustered(rows: list[Ran], reference: Ran | None = None) -> list[Ran]:
    # the longest of each cluster stands for it, so that a short run joins whom it agrees with; the reference
    # comes first, so that its cluster is number 0
    heads: list[Ran] = []
    numbers: dict[str, int] = {}
    name = None if reference is None else reference.variant.name
    for row in sorted(rows, key=lambda row: (row.variant.name != name, -len(row.hashes))):
        if row.failed:
            continue
        at = next((k for k, head in enumerate(heads) if _agree(row, head)), len(heads))
        if at == len(heads):
            heads.append(row)
        numbers[row.variant.name] = at
    return [replace(row, cluster=numbers.get(row.variant.name, -1)) for row in rows]


def _causes(rows: Sequence[Ran]) -> list[tuple[str, dict[str, Any]]]:
    """What the pattern of agreement says; nothing is said of variants that were not run."""
    by_name = {row.variant.name: row for row in rows if not row.failed}
    reference = next(iter(by_name.values()))
    found: list[tuple[str, dict[str, Any]]] = []

    def same(one: str, other: str) -> bool | None:
        if one not in by_name or other not in by_name:
            return None
        return _agree(by_name[one], by_name[other])

    plain = [name for name in ("AVX", "SSE4.2", "unoptimized") if name in by_name]
    fused = [name for name in plain if not _agree(by_name[name], reference)]
    if len(plain) > 1 and fused == plain:
        alike = all(same(plain[0], name) for name in plain[1:])
        step = by_name[plain[0]].first_bit
        found.append(("fused" if alike else "unlike", {"names": ", ".join(plain), "step": step}))
    elif plain and not fused:
        found.append(("not_fused", {"names": ", ".join(plain)}))
    alike, without = same("eager", "scan"), same("eager", "AVX")
    if alike is not None or without:
        short = alike and without and fused
        code = "short" if short else "same" if alike else "plain" if without else "leaves"
        found.append((f"eager_{code}", {"step": by_name["eager"].first_bit}))
    for name in ("rollout", "vmap", "grad"):
        alike, without = same(name, "scan"), same(f"{name}, AVX", "AVX")
        if alike is not None:
            code = "same" if alike else {True: "fuses", False: "ordered", None: "leaves"}[without]
            found.append((code, {"program": name, "step": by_name[name].first_bit}))
    if same("reversed", "scan") is False:
        found.append(("reversed", {"step": by_name["reversed"].first_bit}))
    return found
