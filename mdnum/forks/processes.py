"""Separate processes that run one system in several differently compiled programs.

Programs of one system may be compiled, batched or differentiated. All programs compute the same formulas but
may round differently. Each variant of a program runs in its own process, because XLA flags apply to a whole
process. Variants with equal positions at every step are numerically the same program. If hashes of positions
differ, the groups of variants with equal hashes indicate the cause.

`python -m mdnum.forks.processes FILE` executes the task in a JSON file and writes an array of positions.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, MdnumError
from mdnum.forks.worlds import varied
from mdnum.plain import result
from mdnum.safe_path import environment, python
from mdnum.systems import BallSystem, System, opened
from mdnum.systems.code import allow_code, is_allowed

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

ProgramName = Literal["scan", "rollout", "vmap", "grad", "eager"]

#: Largest number of steps of the eager program, whose steps take a hundred times as long.
_EAGER_STEPS = 12
#: Number of copies in a batch.
_BATCH = 4
#: Number of simultaneous variants, and time limit of one variant, s.
_PROCESSES, _TIMEOUT = 2, 600
_NO_FMA = ("--xla_cpu_max_isa=AVX",)


# --- variants of one system -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """One of several differently compiled programs that run the same steps."""

    name: str  # what to call it
    # "scan" (one compiled loop), "rollout" (mdnum's own), "vmap" (the first of a batch of equal copies),
    # "grad" (the primal inside value_and_grad) or "eager" (operation by operation)
    program: ProgramName = "scan"
    flags: tuple[str, ...] = ()  # of XLA
    reduction: str | None = None  # order of the force sums; None for the system's own


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
    """Result of a run with one variant of a program."""

    variant: Variant  # which
    hashes: tuple[str, ...]  # of the positions at steps 1, 2, ..., hexadecimal; empty where it failed
    failed: str = ""  # the last line that a failed process said
    seconds: float = 0.0  # of its process
    cluster: int = -1  # number of the variants that agree with it, from 0; -1 where it failed
    # first step whose positions are not those of the reference; None where all are
    first_bit: int | None = None
    # largest distance from the reference's atoms at steps 1, 2, ..., as far as both ran, length
    separations: Float[np.ndarray, "steps"] = field(default_factory=lambda: np.zeros(0))

    @property
    def separation(self) -> float:
        """Largest displacement of an atom from the reference run at the last step. NaN on failure."""
        return float(self.separations[-1]) if len(self.separations) else float("nan")

    def agrees(self, other: Ran) -> bool:
        """Return True if two variants have the same positions at all common steps."""
        common = min(len(self.hashes), len(other.hashes))
        return common > 0 and self.hashes[:common] == other.hashes[:common]


@result
class Variants:
    """Variants of the program of one system, grouped by equal results."""

    rows: tuple[Ran, ...]  # one a variant, in the order asked for
    reference: str  # name of the one that the others are compared with: the first that ran
    steps: int  # that it ran
    # what tells the clusters apart: codes and their values (see `causes_of`)
    causes: tuple[dict[str, Any], ...]

    @property
    def clusters(self) -> list[list[str]]:
        """Names of variants, in groups with bit-identical results. The reference's group comes first."""
        count = max(row.cluster for row in self.rows) + 1
        return [[row.variant.name for row in self.rows if row.cluster == k] for k in range(count)]


def variants(
    system: Simulation,
    steps: int = 200,
    which: Sequence[Variant] = VARIANTS,
    progress: Callable[[int, int, str], None] | None = None,
) -> Variants:
    """Run a system in several variants of its program. Find which results agree.

    All variants use one neighbor list. The skin is doubled if the box is large enough. Variants stop before
    an atom moves half the skin. Groups may differ between machines: some processors lack fused multiply-add.

    Args:
        system: a system that was loaded from a file and has a pair potential.
        steps: steps of each variant; the variant without compiler runs only twelve.
        which: variants; the first variant that succeeds is the reference for the others. The row of a variant
            that fails or takes too long contains the reason.
        progress: called with the number of finished variants, their total, and the name of the last variant.

    Raises:
        InputError: the potential is a many-body potential, or there are no steps or no variants.
        MdnumError: all variants failed.
    """
    from mdnum.md.cell import Cell, displacement
    from mdnum.md.integrators import check_one_box

    check_one_box(system.integrator, "variants in processes of their own")
    if not system.pairwise:
        raise InputError("numerical variants of many-body potentials cannot be compared", where=system.name)
    if steps < 1 or not which:
        raise InputError("give at least one step and one variant to compare", where=f"steps = {steps}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        question = _question(system, steps, folder)
        done, count = 0, Lock()

        def ran(k: int) -> tuple[Ran, np.ndarray | None]:
            nonlocal done
            found = _ran(which[k], question, folder / str(k))
            with count:
                done += 1
                if progress is not None:
                    progress(done, len(which), which[k].name)
            return found

        pool = ThreadPoolExecutor(_PROCESSES)
        try:
            found = list(pool.map(ran, range(len(which))))
        finally:
            # after a control-C no further process is started
            pool.shutdown(cancel_futures=True)
    reference, own = next(((row, x) for row, x in found if x is not None), (None, None))
    if reference is None or own is None:
        row = found[0][0]
        raise MdnumError(f"the runs of all variants failed; {row.variant.name!r} failed with: {row.failed}")
    cell = Cell.create(np.asarray(system.cell.matrix), system.pbc)

    def furthest(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.sqrt(np.max(sum(c * c for c in displacement(cell, one.T, other.T)))))

    rows = []
    for row, x in found:
        if x is not None:
            hashes = enumerate(zip(row.hashes, reference.hashes, strict=False), 1)
            first = next((step for step, (one, other) in hashes if one != other), None)
            separations = [furthest(*places) for places in zip(own, x, strict=False)]
            row = replace(row, first_bit=first, separations=np.array(separations))
        rows.append(row)
    rows = clustered(rows)
    return Variants(tuple(rows), reference.variant.name, len(reference.hashes), tuple(causes_of(rows)))


def _ran(variant: Variant, question: Mapping[str, Any], file: Path) -> tuple[Ran, np.ndarray | None]:
    out = str(file.with_suffix(".npy"))
    asked = {**question, "program": variant.program, "reduction": variant.reduction, "out": out}
    flags = " ".join([os.environ.get("XLA_FLAGS", ""), *variant.flags]).strip()
    # a program cached by another variant must not answer for this one; these flags are a CPU's
    settings = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    begin = time.perf_counter()
    failed = _ask(asked, file.with_suffix(".json"), settings)
    seconds = time.perf_counter() - begin
    x = np.zeros(0) if failed else np.load(out)
    if not len(x):
        return Ran(variant, (), failed or "the first step used up the whole skin", seconds), None
    hashes = tuple(hashlib.sha256(np.ascontiguousarray(row).tobytes()).hexdigest() for row in x)
    return Ran(variant, hashes, "", seconds), x


def clustered(rows: Sequence[Ran]) -> list[Ran]:
    """Assign each variant to a cluster of equal results. Cluster 0 has the first successful variant."""
    reference = next((row for row in rows if not row.failed), None)
    # the longest of each cluster stands for it, so that a short run joins whom it agrees with
    heads: list[Ran] = []
    numbers: dict[str, int] = {}
    for row in sorted(rows, key=lambda row: (row is not reference, -len(row.hashes))):
        if not row.failed:
            at = next((k for k, head in enumerate(heads) if row.agrees(head)), len(heads))
            heads += [row] if at == len(heads) else []
            numbers[row.variant.name] = at
    return [replace(row, cluster=numbers.get(row.variant.name, -1)) for row in rows]


def causes_of(rows: Sequence[Ran]) -> Iterator[dict[str, Any]]:
    """Return codes for the causes of differences between variants. Failed variants are ignored.

    The codes "fused", "others" and "not_fused" concern fused operations. The codes "eager_..." concern the
    uncompiled program. "reversed" concerns reversed sums. Other codes concern the program named by "program".
    "step" is the first step at which a variant differs from the reference.
    """
    by_name = {row.variant.name: row for row in rows if not row.failed}
    reference = next(iter(by_name.values()))

    def same(one: str, other: str) -> bool | None:
        if one not in by_name or other not in by_name:
            return None
        return by_name[one].agrees(by_name[other])

    def cause(code: str, name: str | None = None, **values: Any) -> dict[str, Any]:
        return {"code": code, **({} if name is None else {"step": by_name[name].first_bit}), **values}

    plain = [name for name in ("AVX", "SSE4.2", "unoptimized") if name in by_name]
    fused = [name for name in plain if not by_name[name].agrees(reference)]
    if len(plain) > 1 and fused == plain:
        alike = all(same(plain[0], name) for name in plain[1:])
        yield cause("fused", plain[0], names=plain) if alike else cause("others", names=plain)
    elif plain and not fused:
        yield cause("not_fused", names=plain)
    alike, without = same("eager", "scan"), same("eager", "AVX")
    if alike:
        yield cause("eager_short" if without and fused else "eager_same")
    elif without:
        yield cause("eager_plain")
    elif alike is False:
        yield cause("eager_leaves", "eager")
    for name in ("rollout", "vmap", "grad"):
        alike, without = same(name, "scan"), same(f"{name}, AVX", "AVX")
        if alike:
            yield cause("same", program=name)
        elif alike is False:
            code = {True: "fuses", False: "orders", None: "leaves"}[without]
            yield cause(code, name, program=name)
    if same("reversed", "scan") is False:
        yield cause("reversed", "reversed")


def positions_of(
    simulation: Simulation, steps: int, program: ProgramName
) -> Float[np.ndarray, "steps 3 atoms"]:
    """Compute wrapped positions at steps 1, 2, ... with one program. Atoms are in the user's order.

    The run ends before an atom moves by half the skin, because only one neighbor list is built.
    """
    from mdnum.md.cell import displacement
    from mdnum.rollout.engine import Engine, first_state

    room = float(np.min(simulation.cell.widths)) / 2 - simulation.r_cut
    skin = min(2 * simulation.rule.skin, room)
    simulation = replace(simulation, rule=replace(simulation.rule, skin=skin, check=True))
    home = first_state(simulation).reference
    if program == "rollout":
        parts = []
        for segment in Engine(simulation, steps).segments():
            parts += [segment.unsorted("x", row).T for row in range(segment.rows)]
        x = np.array(parts[1:])
    else:
        x = _stepped(simulation, steps, program)
    moved = [np.max(sum(c * c for c in displacement(simulation.cell, home, row.T))) for row in x]
    used = np.flatnonzero(np.sqrt(moved) > skin / 2)
    return x[: used[0]] if len(used) else x


def _stepped(simulation: Any, steps: int, program: ProgramName) -> np.ndarray:
    import jax
    import jax.numpy as jnp
    from jax import lax

    from mdnum.md.integrators import by_atom
    from mdnum.md.pairforce import MdState, PairDynamics
    from mdnum.rollout.engine import first_state

    start = first_state(simulation)
    table = simulation.verlet_list().build(start.reference, simulation.cell)
    dynamics = PairDynamics(
        simulation.force,
        simulation.propagator,
        jnp.asarray(simulation.masses[table.order]),
        simulation.tables(table),
    )
    x, v = start.state.x[:, table.order], start.state.v[:, table.order]
    extra = by_atom(lambda a: a[..., table.order], start.state.extra)
    state = MdState(jnp.zeros((), jnp.int64), x, v, extra)
    leaves, structure = jax.tree.flatten(dynamics)

    # the dynamics comes in as an argument: its fence is a number that the compiler must not know
    def trajectory(leaves, x, v, count):
        dynamics = jax.tree.unflatten(structure, leaves)

        def body(state, _):
            state = dynamics.step(state, dynamics.decide(state))
            return state, state.x

        return lax.scan(body, state._replace(x=x, v=v), None, length=count)[1]

    def loss(x, v, leaves):
        path = trajectory(leaves, x, v, steps)
        return jnp.mean(jnp.square(path[-1])), path

    if program == "eager":
        with jax.disable_jit():
            x = trajectory(leaves, state.x, state.v, min(steps, _EAGER_STEPS))
    elif program == "vmap":
        copies = (jnp.stack([q] * _BATCH) for q in (state.x, state.v))
        batched = jax.jit(jax.vmap(lambda leaves, x, v: trajectory(leaves, x, v, steps), (None, 0, 0)))
        x = batched(leaves, *copies)[0]
    elif program == "grad":
        (_, x), _ = jax.jit(jax.value_and_grad(loss, has_aux=True))(state.x, state.v, leaves)
    else:
        x = jax.jit(trajectory, static_argnums=3)(leaves, state.x, state.v, steps)
    ours = np.empty(x.shape, np.asarray(x).dtype)
    ours[:, :, table.order] = np.asarray(x)
    return ours


def in_a_file(system: Simulation | BallSystem) -> System | BallSystem:
    """Return a system in a form that another process can restore, bit for bit.

    Raises:
        InputError: the system was made from objects, which exist only in this process.
    """
    own = system if isinstance(system, BallSystem) else system.file
    if own is None:
        raise InputError(
            "a system made of Python objects cannot be recreated in another process",
            where=system.name,
            remedy="Give the system as a system file",
        )
    return own


# --- asking and answering -----------------------------------------------------------------------------


def _question(system: Simulation | BallSystem, steps: int, folder: Path) -> dict[str, Any]:
    """Return the input of a process: the saved system and the last step."""
    path = in_a_file(system).write(folder / "system")
    return {"path": str(path), "steps": steps, "code": is_allowed()}


def _ask(question: Mapping[str, Any], file: Path, settings: Mapping[str, str]) -> str:
    """Run a process that executes a task. Return why it failed, or "" if it succeeded.

    `settings` are environment variables of the new process.
    """
    file.write_text(json.dumps(question))
    try:
        done = subprocess.run(
            python("-m", "mdnum.forks.processes", str(file)), stdin=subprocess.DEVNULL, capture_output=True,
            text=True, errors="replace", env=environment(**settings), timeout=_TIMEOUT,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"took longer than {_TIMEOUT:g} s"
    if not done.returncode:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"ended with exit code {done.returncode}"


def main() -> None:
    """Execute the task described in the file named by the last command-line argument."""
    question: dict[str, Any] = json.loads(Path(sys.argv[-1]).read_text())
    with allow_code(question["code"]):
        system = opened(question["path"])
    if question["reduction"]:
        system = varied(system, {"precision.reduction": question["reduction"]})
    assert not isinstance(system, BallSystem)
    np.save(question["out"], positions_of(system, question["steps"], question["program"]))


if __name__ == "__main__":
    main()
