"""How much time and memory does the gradient of a run need?

Answer. Two to four times the time of the forward run (2.6 times for the derivative of the steps, about 3
times with the contributions of flips). For a reversible run, the memory does not grow with the number of
steps (docs/speed.md). It takes many minutes.

The Lennard-Jones liquid of LAMMPS's bench/in.lj (r_cut 2.5, float64), loss: velocity autocorrelation at the
last step, by sigma and epsilon. Contenders take turns from the same start, after compilation:

    forward       the run alone, recorded but nothing decoded
    symmetric     value and gradient: the derivative of the steps
    event-aware   the same and what every flip adds
    reversible    the run on the lattice, taken back step by step; beside the lattice's own forward run
    network       the same three with 9,996 weights of a network as the pair potential, by all of them
    jax.grad      through jax-md's own loop (velocity Verlet, list update at each step, in one scan), for as
                  many steps as fit the memory given; its list's length is the best it can be, and its
                  potential is switched, because jax-md has no hard cutoff

Then the peak memory of whole processes: symmetric at 4,000 atoms and 10,000 steps, reversible at 1,000 and
100,000 steps.

How to read it. Ratios travel to other machines, times do not; CPU time is what a busy machine does not
blur. "over jax.grad" compares the cost of one step of value and gradient.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import liquid
from _output import parser, say, start, table
from _processes import peak_mb
from _turns import Claim, claim, finish, in_turn, ratios

if TYPE_CHECKING:
    from mdnum.systems import System

NAMES = ("sigma", "epsilon")
FORWARD, SYMMETRIC, AWARE, LATTICE, REVERSIBLE, JAX_GRAD = (
    "forward", "symmetric", "event-aware", "lattice forward", "reversible", "jax.grad",
)  # fmt: skip
NETWORK, BY_WEIGHTS, BY_WEIGHTS_AWARE = "network forward", "network symmetric", "network event-aware"
#: What each is measured against.
_BESIDE = {
    SYMMETRIC: FORWARD, AWARE: FORWARD, REVERSIBLE: LATTICE, BY_WEIGHTS: NETWORK, BY_WEIGHTS_AWARE: NETWORK,
    JAX_GRAD: SYMMETRIC,
}  # fmt: skip
MOST_RATIO, LEAST_GAIN, MOST_GROWTH, MOST_MB, MOST_BY_WEIGHTS = 3.0, 4.0, 1.1, 2048.0, 5.0
#: Width of both layers of the network, which has 9,996 weights, and steps of its rollout.
WIDTH, FEW = 98, 20


def on_the_lattice(system: System) -> System:
    """The same system with positions and velocities in fixed point."""
    from dataclasses import replace

    precision = system.spec.precision.model_copy(update={"state": "lattice"})
    return replace(system, spec=system.spec.model_copy(update={"precision": precision}))


def forward(system: Any) -> Callable[[int], None]:
    """The run alone."""
    from mdnum.rollout import Engine
    from mdnum.systems import build

    simulation = build(system)

    def run(steps: int) -> None:
        for _ in Engine(simulation, steps).segments():
            pass

    return run


def network(atoms: int) -> Any:
    """The same liquid with two layers of a network as its pair potential, as a simulation."""
    import jax.numpy as jnp

    import mdnum

    def energy(r, layers, out):
        h = r[..., None]
        for weight, bias in layers:
            h = jnp.tanh(h @ weight + bias)
        return h @ out

    rng = np.random.default_rng(0)
    layers = [(rng.normal(size=(one, WIDTH)) / one**0.5, rng.normal(size=WIDTH) * 0.1) for one in (1, WIDTH)]
    potential = mdnum.PairFunction(energy, layers=layers, out=rng.normal(size=WIDTH) / WIDTH**0.5)
    like = mdnum.build(liquid(atoms))
    return mdnum.simulation(
        like.structure, potential, mdnum.Cut("hard", 2.5), units="lj", timestep=0.002, skin=0.3
    )


def gradient(
    system: Any, method: str, names: tuple[str, ...] = NAMES, *, finite: bool = True
) -> Callable[[int], None]:
    """Value and gradient by one of mdnum's methods.

    Args:
        finite: whether to insist on a gradient that is finite. After some ten thousand steps of a liquid none
            is: it has grown past all numbers, at the same cost.
    """
    from mdnum.gradients import METHODS, Problem
    from mdnum.gradients.losses import VelocityAutocorrelation
    from mdnum.systems import build

    simulation, found = build(system), METHODS.parse(method)

    def run(steps: int) -> None:
        answer = found(Problem(simulation, VelocityAutocorrelation(), steps), names)
        if finite and not all(np.isfinite(value).all() for value in answer.gradient.values()):
            raise RuntimeError(f"{method}: a gradient that is not finite measures nothing")

    return run


def jax_grad(system: System, most_mb: float) -> tuple[Callable[[int], None], int]:
    """jax.value_and_grad through jax-md's loop, and how many steps of it fit."""
    import jax
    import jax.numpy as jnp
    from _peers import float64, jax_md_neighbors
    from jax import lax
    from jax_md import simulate

    from mdnum.systems import build

    simulation = build(system)
    energy_fn, shift, listed, positions = jax_md_neighbors(simulation)
    velocities = jnp.asarray(simulation.velocities)

    def compiled(steps: int):
        def loss(parameters):
            sigma, epsilon = parameters

            def of(x, neighbor, **_):
                return epsilon * energy_fn(x, neighbor=neighbor, sigma=sigma)

            init, apply = simulate.nve(of, shift, float(simulation.integrator.timestep))
            state = init(jax.random.key(0), positions, float64(1.0), neighbor=listed)
            state = state.set(momentum=velocities)

            def step(carry, _):
                state, neighbors = carry
                state = apply(state, neighbor=neighbors)
                return (state, neighbors.update(state.position)), None

            (state, after), _ = lax.scan(step, (state, listed), None, length=steps)
            return jnp.mean(jnp.sum(state.momentum * velocities, axis=1)), after.did_buffer_overflow

        return jax.jit(jax.value_and_grad(loss, has_aux=True)).lower((float64(1.0), float64(1.0))).compile()

    def needs_mb(made) -> float:
        return made.memory_analysis().temp_size_in_bytes / 2**20

    few = 4
    slope = (needs_mb(compiled(3 * few)) - needs_mb(compiled(few))) / (2 * few)
    fit = max(1, int(most_mb / max(slope, 1e-6)))
    made: dict[int, Any] = {}

    def run(steps: int) -> None:
        if steps not in made:
            made[steps] = compiled(steps)
        (value, overflow), slopes = made[steps]((float64(1.0), float64(1.0)))
        jax.block_until_ready(slopes)
        if bool(overflow) or not np.isfinite(float(value)):
            raise RuntimeError("jax-md's list overflowed or its loss is not finite: its time means nothing")

    return run, fit


def race(
    atoms: int, steps: int, turns: int, most_mb: float, without: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Let all take turns at one size; medians of a step."""
    system = liquid(atoms)
    loops: dict[str, tuple[Callable[[int], None], int]] = {FORWARD: (forward(system), steps)}
    for name in (SYMMETRIC, AWARE):
        loops[name] = (gradient(system, name), steps)
    if REVERSIBLE not in without:
        grid = on_the_lattice(system)
        loops[LATTICE] = (forward(grid), steps)
        loops[REVERSIBLE] = (gradient(grid, REVERSIBLE), steps)
    if NETWORK not in without:
        made = network(atoms)
        loops[NETWORK] = (forward(made), FEW)
        for name, method in ((BY_WEIGHTS, SYMMETRIC), (BY_WEIGHTS_AWARE, AWARE)):
            loops[name] = (gradient(made, method, ("potential",)), FEW)
    if JAX_GRAD not in without:
        say(f"{atoms} atoms: how many steps of jax.grad fit {most_mb:g} MB")
        run, fit = jax_grad(system, most_mb)
        loops[JAX_GRAD] = (run, min(steps, fit))
    taken = in_turn(
        {name: partial(loop, count) for name, (loop, count) in loops.items()}, turns, f"{atoms} atoms"
    )
    for name, rows in taken.items():
        # of a step: those of jax.grad are as many as fit
        taken[name] = rows / loops[name][1]
    rows = []
    for name, (_, count) in loops.items():
        ms, cpu_ms = (1e3 * np.median(taken[name][1:], axis=0)).tolist()
        over = [None, None]
        if name in _BESIDE:
            over = np.median(ratios(taken, name, _BESIDE[name]), axis=0).tolist()
        rows.append(
            {
                "name": name, "atoms": len(system.atoms), "steps": count, "ms": ms, "cpu_ms": cpu_ms,
                "ratio": over[0], "cpu_ratio": over[1],
            }
        )  # fmt: skip
    return rows


def peak(method: str, atoms: int, steps: int) -> dict[str, Any]:
    """Peak memory of a process that works out one gradient."""
    say(f"peak memory of {method}, {atoms} atoms, {steps:,} steps")
    words = [sys.executable, __file__, "--peak-of", method, str(atoms), str(steps)]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    return {"method": method, "atoms": atoms, "steps": steps, **json.loads(done.stdout.splitlines()[-1])}


def _peak_of(method: str, atoms: int, steps: int) -> None:
    system = liquid(atoms)
    gradient(on_the_lattice(system) if method == REVERSIBLE else system, method, finite=False)(steps)
    print(json.dumps({"peak_mb": peak_mb()}))


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    for row in result["rows"]:
        beside = _BESIDE.get(row["name"])
        if beside is None:
            continue
        what = f"{row['name']} over {beside}, N = {row['atoms']:,}, {row['steps']:,} steps, CPU time"
        if row["name"] == JAX_GRAD:
            yield claim(what, row["cpu_ratio"], ">=", LEAST_GAIN)
        else:
            yield claim(what, row["cpu_ratio"], "<=", MOST_BY_WEIGHTS if beside == NETWORK else MOST_RATIO)
    peaks = result["peaks"]
    back = sorted((one for one in peaks if one["method"] == REVERSIBLE), key=lambda one: one["steps"])
    if len(back) > 1:
        growth = back[-1]["peak_mb"] / back[0]["peak_mb"]
        what = f"reversible, peak memory at {back[-1]['steps']:,} over {back[0]['steps']:,} steps"
        yield claim(what, growth, "<=", MOST_GROWTH)
    for one in peaks:
        if one["method"] != REVERSIBLE:
            what = f"{one['method']}, N = {one['atoms']:,}, {one['steps']:,} steps, peak"
            yield claim(what, one["peak_mb"], "<=", MOST_MB, "MB")


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    table(
        "a step of value and gradient (ratio: over the forward run, for jax.grad over symmetric)",
        ("contender", "N", "steps", "ms", "CPU ms", "ratio", "CPU ratio"),
        ([f"{one:,}" if isinstance(one, int) else one for one in row.values()] for row in result["rows"]),
    )
    if result["peaks"]:
        table(
            "\npeak memory of a process",
            ("method", "N", "steps", "MB"),
            (
                (one["method"], f"{one['atoms']:,}", f"{one['steps']:,}", f"{one['peak_mb']:.0f}")
                for one in result["peaks"]
            ),
        )


def _options() -> argparse.Namespace:
    made = parser(__doc__)
    made.add_argument("--quick", action="store_true", help="256 atoms, a short turn: does it work?")
    made.add_argument("--sizes", type=int, nargs="+", metavar="N", help="atoms (default 500 4000)")
    made.add_argument("--steps", type=int, help="of a rollout (default 1000)")
    made.add_argument("--turns", type=int, help="turns of each (default 3)")
    made.add_argument(
        "--memory", type=float, default=3000.0, metavar="MB", help="for jax.grad (default 3000)"
    )
    made.add_argument(
        "--without",
        nargs="+",
        default=[],
        choices=(REVERSIBLE, JAX_GRAD, NETWORK),
        help="contenders to leave out",
    )
    made.add_argument("--no-peaks", action="store_true", help="no memory of whole processes")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    made.add_argument("--peak-of", nargs=3, help=argparse.SUPPRESS)
    return made.parse_args()


def main() -> None:
    """Parse, measure, and print."""
    chosen = _options()
    if chosen.peak_of:
        method, atoms, steps = chosen.peak_of
        _peak_of(method, int(atoms), int(steps))
        return
    sizes = chosen.sizes or ([256] if chosen.quick else [500, 4000])
    steps = chosen.steps or (40 if chosen.quick else 1000)
    turns = chosen.turns or (1 if chosen.quick else 3)
    result: dict[str, Any] = {"rows": [], "peaks": []}
    if not (chosen.no_peaks or chosen.quick):
        result["peaks"].append(peak(SYMMETRIC, 4000, 10_000))
        if REVERSIBLE not in chosen.without:
            result["peaks"] += [peak(REVERSIBLE, 256, count) for count in (1_000, 100_000)]
    for atoms in sizes:
        result["rows"] += race(atoms, steps, turns, chosen.memory, tuple(chosen.without))
    finish(chosen, result, show, claims)


if __name__ == "__main__":
    start(main)
