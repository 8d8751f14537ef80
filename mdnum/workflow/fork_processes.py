"""`mdnum fork SYSTEM --processes` as a function: one system in several programs, into a folder."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.workflow.fork_question import OF_A_BALL, Log, Progress, basics, finish, loaded, opened, steps_of

if TYPE_CHECKING:
    from mdnum.forks.variants import Ran, Variant, Variants
    from mdnum.systems.load import System

#: Steps of each program, unless others are asked for: enough for every cause to show.
STEPS = 200


@dataclass(frozen=True)
class ProcessesResult:
    """A finished comparison of programs.

    Attributes:
        folder: the fork folder.
        variants: what became of each, and who agrees with whom.
        summary: what summary.json says, findings included.
    """

    folder: Path
    variants: Variants
    summary: dict[str, Any]


def fork_processes(
    system: System | str | Path,
    *,
    steps: int | None = None,
    which: Sequence[Variant] | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ProcessesResult:
    """Run a system jitted, eagerly, in a batch, in a gradient and under flags of XLA, and tell who agrees.

    Args:
        system: a loaded system, a shipped name or the path of a system file; pair potentials only.
        steps: of each program; default 200, or the system's own where they are fewer.
        which: the variants; default `forks.variants.VARIANTS`.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"precision.force": "float32"}.
        report: write report.html.
        progress: called now and then with variants done, how many there are, and a dictionary of figures.

    Raises:
        InputError: the system cannot be run, or its potential is a many-body one.
        FolderError: the folder cannot be used.
        MdnumError: not one of the variants ran.
    """
    from mdnum.forks.choices.base import is_pairwise
    from mdnum.forks.variants import VARIANTS, variants

    began = time.perf_counter()
    system = loaded(system, overrides, OF_A_BALL["--processes"])
    last = steps_of(system, min(STEPS, system.spec.dynamics.steps) if steps is None else steps)
    if not is_pairwise(system):
        raise InputError(
            "the programs of a many-body potential are not compared",
            where=system.name,
            remedy="Use a system with a pair potential",
        )
    asked = VARIANTS if which is None else tuple(which)
    folder = opened(system, "processes", out)
    try:
        note = Log(folder, progress)

        def told(done: int, count: int, name: str) -> None:
            note(done, count, {"phase": "running in processes of their own", "unit": "variants"})
            if name:
                folder.log(f"  {name} has ended")

        told(0, len(asked), "")
        found = variants(system, last, asked, told)
        _write(folder, found)
        for row in found.rows:
            if row.failed:
                folder.log(f"{row.variant.name} failed: {row.failed}")
        for sentence in found.causes:
            folder.log(sentence)
        folder.finalize()
        summary = {
            **basics(system, "processes", found.steps),
            "steps_asked": last,
            **_summary(found),
            "seconds": time.perf_counter() - began,
        }
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    return ProcessesResult(folder.path, found, finish(folder, report, progress))


def _row(row: Ran) -> dict[str, Any]:
    variant = row.variant
    return {
        "variant": variant.name,
        "program": variant.program,
        "flags": " ".join(variant.flags),
        "reduction": variant.reduction or "",
        "cluster": row.cluster,
        "seed": -1 if row.seed is None else row.seed,
        "steps": len(row.hashes),
        "separation": row.separation,
        "seconds": row.seconds,
        "hash": row.hashes[-1] if row.hashes else "",
        "failed": row.failed,
    }


def _write(folder: RunFolder, found: Variants) -> None:
    """Puts the variants, and how far each is from the reference by step, into the folder's tables."""
    rows = [_row(row) for row in found.rows]
    folder.append("variants", {name: np.array([row[name] for row in rows]) for name in rows[0]})
    for row in found.rows:
        count = len(row.separations)
        if count:
            folder.append(
                "variant_separations",
                {
                    "variant": np.full(count, row.variant.name),
                    "step": np.arange(1, count + 1),
                    "separation": row.separations,
                },
            )


def _summary(found: Variants) -> dict[str, Any]:
    rows = []
    for row in found.rows:
        plain = _row(row)
        plain["seed"] = row.seed
        plain["cluster"] = None if row.failed else row.cluster
        rows.append(plain)
    return {
        "reference": found.reference,
        "clusters": found.clusters,
        "causes": list(found.causes),
        "failed_variants": [row.variant.name for row in found.rows if row.failed],
        "variants": rows,
    }
