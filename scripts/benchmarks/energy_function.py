"""How long does a run with an energy function of jax-md take in mdnum, relative to jax-md's own loop?

Answer. With a list of edges, 1.1 times the CPU time at 500 atoms and 0.6 times at 4,000 atoms; with dense
lists 1.7 and 1.4 times. It takes 400 s.

The function is jax-md's switched Lennard-Jones over a Lennard-Jones liquid, with a list of the format that it
asks for. jax-md's loop is that of its documentation, velocity Verlet and an update of the list at each step;
mdnum's records every flip. Both start from the same state and take turns, after compilation. The table holds
CPU time of all cores together, medians over the turns, and their ratio, median of the ratios of the turns.

How to read it. Below 1.1 nobody loses by what is recorded.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import jax
import jax.numpy as jnp
import numpy as np
from _liquid import liquid
from _output import parser, say, start, table
from _peers import float64, jax_md_loop, orthorhombic
from _turns import in_turn, ratios

import mdnum
from mdnum.md.jaxmd import upstream
from mdnum.rollout import Engine
from mdnum.systems import Simulation


def of_jax_md(pairs: Simulation, form: str) -> Simulation:
    """The same system with jax-md's energy function instead of the pair potential."""
    md, box = upstream(), jnp.asarray(orthorhombic(pairs))
    constants = {"sigma": 1.0, "epsilon": 1.0, "r_onset": 0.8 * pairs.r_cut, "r_cutoff": pairs.r_cut}
    made = md.energy.lennard_jones_neighbor_list(
        md.space.periodic(box)[0], box, format=getattr(md.partition, form),
        **{name: float64(value) for name, value in constants.items()},
    )  # fmt: skip
    atoms = pairs.structure.copy()
    atoms.set_velocities(pairs.velocities)
    function = mdnum.energy_function(made, pairs.r_cut)
    return mdnum.simulation(atoms, function, units="lj", timestep=pairs.timestep, skin=pairs.rule.skin)


def measured(atoms: int, form: str, steps: int, turns: int) -> dict[str, Any]:
    """Medians of one size."""
    # the lists of two sizes cannot be compared: jax-md keeps an array where jax expects none
    jax.clear_caches()
    pairs = mdnum.build(liquid(atoms))
    theirs, begin = jax_md_loop(pairs, form), time.process_time()
    simulation = of_jax_md(pairs, form)
    door = time.process_time() - begin
    loops = {"jax-md": lambda: theirs(steps), "mdnum": lambda: list(Engine(simulation, steps).segments())}
    taken = in_turn(loops, turns, f"{pairs.atoms} atoms, {form}")
    each = {f"{name} ms": float(np.median(1e3 * rows[1:, 1] / steps)) for name, rows in taken.items()}
    ratio = float(np.median(ratios(taken, "mdnum", "jax-md")[:, 1]))
    return {"atoms": pairs.atoms, "list": form, "steps": steps, **each, "ratio": ratio, "door s": door}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--atoms", type=int, nargs="+", default=[500, 4000])
    options.add_argument("--steps", type=int, default=200)
    options.add_argument("--turns", type=int, default=3)
    given = options.parse_args()
    forms = ("OrderedSparse", "Dense")
    rows = [measured(n, form, given.steps, given.turns) for n in given.atoms for form in forms]
    table("An energy function, CPU time of a step", list(rows[0]), [list(row.values()) for row in rows])
    Path("energy_function.json").write_text(json.dumps(rows, indent=1))
    say("numbers: energy_function.json")


if __name__ == "__main__":
    start(main)
