"""What processes of their own compute for forks: histories again, and a system by another program.

`python -m mdnum.forks.child FILE` answers the question in a JSON file: digests, a line each, on standard
output for `digests_elsewhere`; an array of positions for `mdnum.forks.variants`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mdnum.errors import MdnumError
from mdnum.forks.worlds import program_of, varied
from mdnum.safe_path import environment, python
from mdnum.systems import BallSystem, System, load

ProgramName = Literal["scan", "rollout", "vmap", "grad", "eager"]

#: Steps of the eager program: operation by operation, a step takes a hundred times as long.
_EAGER_STEPS = 12
#: Copies in a batch.
_BATCH = 4


def positions_of(system: System, steps: int, program: ProgramName) -> Float[np.ndarray, "steps 3 atoms"]:
    """Wrapped positions at steps 1, 2, ... in the user's order, as one program computes them in this process.

    Ends before an atom has moved by half the skin of the one list.
    """
    from mdnum.md.cell import displacement
    from mdnum.rollout.engine import Engine, first_state
    from mdnum.systems.build import build

    simulation = build(system)
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
    state = MdState(jnp.zeros((), jnp.int64), start.state.x[:, table.order], start.state.v[:, table.order])
    leaves, structure = jax.tree.flatten(dynamics)

    # the dynamics comes in as an argument: its fence is a number that the compiler must not know
    def trajectory(leaves, x, v, count):
        dynamics = jax.tree.unflatten(structure, leaves)

        def body(state, _):
            state = dynamics.step(state, dynamics.decide(state))
            return state, state.x

        return lax.scan(body, MdState(state.step, x, v), None, length=count)[1]

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


# --- histories in a fresh process ---------------------------------------------------------------------


def digests(system: System | BallSystem, key: str, steps: int, values: Sequence[float]) -> list[str]:
    """Digests of the histories at some values of a number, by the program that a user runs."""
    number = program_of(system, steps).number(key)
    return [number.proper(value).history(steps).digest for value in values]


def digests_elsewhere(
    system: System | BallSystem,
    key: str,
    steps: int,
    values: Sequence[float],
    progress: Callable[[int], None] | None = None,
    *,
    processes: int = 1,
) -> list[str]:
    """The same from a fresh process: what a boundary must survive before it is believed.

    The system is written to a folder and read again there, bit for bit, and its program is compiled again,
    under the same environment.

    Args:
        progress: called with how many are known, at the start and after each.
        processes: that share the values; worth it where each value is another compiled program.

    Raises:
        MdnumError: a process failed.
    """
    done, lock = 0, Lock()

    def count(more: int) -> None:
        nonlocal done
        with lock:
            done += more
            if progress is not None:
                progress(done)

    count(0)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        question = {"path": str(system.write(folder / "system")), "key": key, "steps": steps}

        def answered(first: int) -> list[str]:
            part = values[first : first + size]
            file = folder / f"{first}.json"
            file.write_text(json.dumps({**question, "values": [value.hex() for value in part]}))
            # what it prints on stderr may be long, and nobody reads a pipe meanwhile
            with tempfile.TemporaryFile("w+") as errors:
                with subprocess.Popen(
                    python("-m", "mdnum.forks.child", str(file)),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                    env=environment(),
                ) as process:
                    assert process.stdout is not None
                    found = []
                    try:
                        for line in process.stdout:
                            found.append(line.strip())
                            count(1)
                    except BaseException:
                        process.kill()
                        raise
                if process.returncode or len(found) != len(part):
                    errors.seek(0)
                    last = errors.read().strip().splitlines()[-1:] or ["no message"]
                    raise MdnumError(
                        f"the process that was to confirm boundaries failed: {last[0]}",
                        remedy="Run `mdnum doctor`",
                    )
            return found

        size = -(-len(values) // processes)
        with ThreadPoolExecutor(max(1, processes)) as pool:
            return [digest for part in pool.map(answered, range(0, len(values), size)) for digest in part]


def main() -> None:
    """Answer the question in the file that the last argument names."""
    question: dict[str, Any] = json.loads(Path(sys.argv[-1]).read_text())
    system = load(question["path"])
    if "values" in question:
        for value in question["values"]:
            print(*digests(system, question["key"], question["steps"], [float.fromhex(value)]), flush=True)
        return
    if question["reduction"]:
        system = varied(system, {"precision.reduction": question["reduction"]})
    assert isinstance(system, System)
    np.save(question["out"], positions_of(system, question["steps"], question["program"]))


if __name__ == "__main__":
    main()
