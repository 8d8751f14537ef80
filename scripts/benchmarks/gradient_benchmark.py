"""What does the gradient of a rollout cost, in time and in memory?

Answer. Two to four times the forward run (2.6 for the derivative of the steps, about 3 with what flips
add), in memory that does not grow with the steps of a reversible run (docs/speed.md). It takes many
minutes.

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
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import liquid
from _output import figure, parser, save, say, start, table
from _processes import machine, peak_mb

if TYPE_CHECKING:
    from mdnum.systems import System

NAMES = ("sigma", "epsilon")
FORWARD, SYMMETRIC, AWARE, LATTICE, REVERSIBLE, JAX_GRAD = (
    "forward", "symmetric", "event-aware", "lattice forward", "reversible", "jax.grad",
)  # fmt: skip
NETWORK, BY_WEIGHTS, BY_WEIGHTS_AWARE = "network forward", "network symmetric", "network event-aware"
#: What each is measured against, and the most that it may cost beside it.
_BESIDE = {
    SYMMETRIC: FORWARD, AWARE: FORWARD, REVERSIBLE: LATTICE, BY_WEIGHTS: NETWORK, BY_WEIGHTS_AWARE: NETWORK,
}  # fmt: skip
MOST_RATIO, LEAST_GAIN, MOST_GROWTH, MOST_MB, MOST_BY_WEIGHTS = 3.0, 4.0, 1.1, 2048.0, 5.0
#: Width of both layers of the network, which has 9,996 weights, and steps of its rollout.
WIDTH, FEW = 98, 20


@dataclass(frozen=True)
class Row:
    """A contender's medians at one size.

    Attributes:
        steps: of one turn; those of jax.grad are as many as fit.
        ms, cpu_ms: clock and CPU time of a step.
        ratio, cpu_ratio: over what it stands beside, median over the turns; None where nothing does.
    """

    name: str
    atoms: int
    steps: int
    ms: float
    cpu_ms: float
    ratio: float | None
    cpu_ratio: float | None


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
    from _peers import float64, orthorhombic
    from jax import lax
    from jax_md import energy, partition, simulate, space

    from mdnum.systems import build

    simulation = build(system)
    box = jnp.asarray(orthorhombic(simulation))
    positions = jnp.mod(jnp.asarray(simulation.positions), box)
    velocities = jnp.asarray(simulation.velocities)
    displacement, shift = space.periodic(box)
    pair: Any = energy.lennard_jones_neighbor_list(
        displacement, box, sigma=float64(1.0), epsilon=float64(1.0),
        r_onset=float64(0.8 * simulation.r_cut), r_cutoff=float64(simulation.r_cut),
        dr_threshold=float64(simulation.rule.skin), format=partition.OrderedSparse,
    )  # fmt: skip
    neighbor_fn, energy_fn = pair
    listed = neighbor_fn.allocate(positions)

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


def race(atoms: int, steps: int, turns: int, most_mb: float, without: tuple[str, ...]) -> list[Row]:
    """Let all take turns at one size."""
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
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in loops}
    for turn in range(turns + 1):
        for name, (loop, count) in loops.items():
            say(f"{atoms} atoms: {f'turn {turn} of {turns}' if turn else 'compiling'}, {name}, {count} steps")
            wall, busy = time.perf_counter(), time.process_time()
            loop(count)
            now = (time.perf_counter() - wall) / count, (time.process_time() - busy) / count
            if turn:
                taken[name].append(now)
    rows = []
    for name, (_, count) in loops.items():
        mine = np.array(taken[name])
        beside = _BESIDE.get(name)
        over = None if beside is None else np.median(mine / np.array(taken[beside]), axis=0)
        if name == JAX_GRAD:
            over = np.median(mine / np.array(taken[SYMMETRIC]), axis=0)
        rows.append(
            Row(
                name, len(system.atoms), count, 1e3 * median(mine[:, 0]), 1e3 * median(mine[:, 1]),
                None if over is None else float(over[0]), None if over is None else float(over[1]),
            )
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


def verdicts(result: dict[str, Any]) -> list[tuple[str, float, str, bool]]:
    """What was measured against what it should be: (claim, measured, asked, holds)."""
    rows = []
    for row in (Row(**one) for one in result["rows"]):
        if row.name in _BESIDE:
            assert row.cpu_ratio is not None
            claim = f"{row.name} over {_BESIDE[row.name]}, N = {row.atoms:,}, CPU time"
            most = MOST_BY_WEIGHTS if _BESIDE[row.name] == NETWORK else MOST_RATIO
            rows.append((claim, row.cpu_ratio, f"<= {most:g}", row.cpu_ratio <= most))
        elif row.name == JAX_GRAD:
            assert row.cpu_ratio is not None
            claim = f"jax.grad over symmetric, N = {row.atoms:,}, {row.steps} steps, CPU time"
            rows.append((claim, row.cpu_ratio, f">= {LEAST_GAIN:g}", row.cpu_ratio >= LEAST_GAIN))
    peaks = result["peaks"]
    back = sorted((one for one in peaks if one["method"] == REVERSIBLE), key=lambda one: one["steps"])
    if len(back) > 1:
        growth = back[-1]["peak_mb"] / back[0]["peak_mb"]
        claim = f"reversible, peak memory at {back[-1]['steps']:,} over {back[0]['steps']:,} steps"
        rows.append((claim, growth, f"<= {MOST_GROWTH:g}", growth <= MOST_GROWTH))
    for one in peaks:
        if one["method"] != REVERSIBLE:
            claim = f"{one['method']}, N = {one['atoms']:,}, {one['steps']:,} steps, peak MB"
            rows.append((claim, one["peak_mb"], f"<= {MOST_MB:g}", one["peak_mb"] <= MOST_MB))
    return rows


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    print("on " + result["machine"])
    table(
        "a step of value and gradient (ratio: over the forward run, for jax.grad over symmetric)",
        ("contender", "N", "steps", "ms", "CPU ms", "ratio", "CPU ratio"),
        [
            (row.name, f"{row.atoms:,}", f"{row.steps:,}", row.ms, row.cpu_ms, row.ratio, row.cpu_ratio)
            for row in (Row(**one) for one in result["rows"])
        ],
    )
    if result["peaks"]:
        table(
            "\npeak memory of a process",
            ("method", "N", "steps", "MB"),
            [
                (p["method"], f"{p['atoms']:,}", f"{p['steps']:,}", f"{p['peak_mb']:.0f}")
                for p in result["peaks"]
            ],
        )
    table("\nasked", ("what", "measured", "asked", "holds"), verdicts(result))


def draw(result: dict[str, Any], path: Path) -> None:
    """CPU time of a step, by contender and size."""
    rows = [Row(**one) for one in result["rows"]]
    sizes = sorted({row.atoms for row in rows})
    drawn = figure(3.6 * len(sizes) + 1.4, 3.2)
    for axes, atoms in zip(np.atleast_1d(drawn.subplots(1, len(sizes))), sizes, strict=True):
        mine = [row for row in rows if row.atoms == atoms]
        axes.barh(range(len(mine)), [row.cpu_ms for row in mine])
        axes.set_yticks(range(len(mine)), [row.name for row in mine])
        axes.set_xscale("log")
        axes.invert_yaxis()
        axes.set_xlabel("CPU ms of a step")
        axes.set_title(f"N = {atoms:,}")
    save(drawn, path)


def _options() -> argparse.Namespace:
    made = parser(__file__, __doc__)
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
    """Parse, measure, print and draw."""
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
        rows = race(atoms, steps, turns, chosen.memory, tuple(chosen.without))
        result["rows"] += [asdict(row) for row in rows]
    result["machine"] = machine()
    if chosen.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    draw(result, chosen.output)


if __name__ == "__main__":
    start(main)
