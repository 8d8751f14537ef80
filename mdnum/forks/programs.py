"""The programs that a system is run by: compiled or not, in a batch, inside a gradient.

This file is what a process of `mdnum.forks.variants` runs: one program, named on the command line.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mdnum.forks.worlds import varied
from mdnum.md.cell import displacement
from mdnum.systems.load import System, load

ProgramName = Literal["scan", "rollout", "vmap", "grad", "eager"]

#: Steps of the eager program: operation by operation, a step takes a hundred times as long.
_EAGER_STEPS = 12
#: Copies in a batch.
_BATCH = 4


def positions_of(system: System, steps: int, program: ProgramName) -> Float[np.ndarray, "steps 3 atoms"]:
    """Wrapped positions at steps 1, 2, ... in the user's order, as one program computes them in this process.

    Ends before an atom has moved by half the skin of the one list.
    """
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

    from mdnum.md.stepper import MdState, PairDynamics
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


def main() -> None:
    """Run the variant that the last argument describes, and write its positions."""
    task: dict[str, Any] = json.loads(sys.argv[-1])
    system = load(task["system"], world="md")
    if task["reduction"]:
        system = varied(system, {"precision.reduction": task["reduction"]})
    np.save(task["out"], positions_of(system, task["steps"], task["program"]))


if __name__ == "__main__":
    main()
