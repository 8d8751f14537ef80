"""How often is the verdict on a gradient wrong? Starting states of several systems, each with a reference
value.

Answer. One of 331 trusted derivatives counts as false, and differs from its reference values by less than 3
%. Of the derivatives that are correct within 1 %, 9 % are not trusted (docs/gradients.md). It takes hours.

`mdnum.gradients.diagnose.trust` calls the derivative of each loss by each parameter trusted, or not. The
truth comes from central differences of free runs, over shifts of the parameter between 1e-5 and 1e-8 of it:

    hard, shifted   of runs in which pairs cross the cutoff at the time at which they do (_located.py, which
                    shares no code with mdnum), at an eighth of the time step
    switched        of mdnum's own runs at an eighth of the time step: no force jumps there

Where differences do not agree within 2 % over the last factor of a hundred in shift, there is no derivative
that anyone could use, and "trusted" is wrong. Starts are the shipped structures with new velocities, run for
a while first. Every start is kept in a file of its own as soon as it is done (--store): the study goes on
where it was stopped. Seeds below 4000 are those that constants were chosen on.

    nice python scripts/campaigns/gradient_trust.py
    python scripts/campaigns/gradient_trust.py --only "crystal-108, hard" --seeds 2 --steps 60
    python scripts/campaigns/gradient_trust.py --page docs/gradients.md

How to read it. "false" must be 0: trusted, and more than 5 % off or without a derivative. "too strict" is the
share of the derivatives right within 1 % (2 %) that are not trusted.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _located import LOSSES, reference
from _output import parser, say, start
from _pages import between, markdown

from mdnum.gradients import Problem, parameters
from mdnum.gradients.diagnose import diagnose
from mdnum.gradients.differences import replica
from mdnum.gradients.losses import parse
from mdnum.systems import Simulation, build

NAMES = ("potential.epsilon", "potential.sigma", "cutoff.radius")
#: Shifts as shares of a parameter; differences over the last three must agree within this.
SHIFTS, AGREE = (1e-5, 1e-6, 1e-7, 1e-8), 0.02
SUBSTEPS = 8
#: Losses of each start.
EACH = 3
#: What counts as wrong, and as right.
WRONG, RIGHT = 0.05, (0.01, 0.02)
#: The first seed of the starts that are reported.
FIRST = 4000
MARK = "<!-- written by scripts/campaigns/gradient_trust.py -->"


class Case(NamedTuple):
    """A system whose starts are drawn."""

    system: str  # shipped
    starts: int  # how many
    settle: int  # steps that each runs before its start
    overrides: dict[str, Any]


WARM = {"dynamics.temperature": 0.3}
# beyond the second shell, which lies at the cutoff of the shipped file
WIDE = {"cutoff.radius": 2.1, "neighbors.skin": 0.25}
HOT = {**WIDE, "dynamics.temperature": 3.0}
CASES = {
    "crystal-108, hard": Case("argon/crystal-108", 13, 50, {}),
    "crystal-108 at T = 0.3, hard": Case("argon/crystal-108", 15, 100, WARM),
    "crystal-108 at T = 0.3, shifted": Case("argon/crystal-108", 12, 100, {**WARM, "cutoff.kind": "shifted"}),
    "crystal-108 at T = 0.3, switched": Case(
        "argon/crystal-108", 12, 100, {**WARM, **WIDE, "cutoff.kind": "quintic"}
    ),
    "fluid of 108, hard": Case("argon/crystal-108", 3, 300, HOT),
    "crystal-500, hard": Case("argon/crystal-500", 2, 50, {}),
    "fluid of 108, switched": Case("argon/crystal-108", 2, 300, {**HOT, "cutoff.kind": "quintic"}),
    "fluid of 108, shifted": Case("argon/crystal-108", 1, 300, {**HOT, "cutoff.kind": "shifted"}),
    "liquid-864, hard": Case("argon/liquid-864", 1, 20, {}),
}


def word(loss: str, steps: int) -> str:
    """A loss as mdnum names it, by its name in the reference."""
    return f"potential:first={steps}" if loss == LOSSES[-1] else loss


def finer(problem: Problem) -> Problem:
    """The same times in shorter steps."""
    timestep = parameters.value(problem.simulation, "dynamics.timestep") / SUBSTEPS
    loss = replace(problem.loss, every=SUBSTEPS * problem.loss.every, first=SUBSTEPS * problem.loss.first)
    simulation = parameters.with_values(problem.simulation, {"dynamics.timestep": timestep})
    return Problem(simulation, loss, SUBSTEPS * problem.steps)


def values_of(
    simulation: Simulation, problems: Sequence[Problem], chosen: list[int]
) -> Callable[[dict[str, float]], np.ndarray]:
    """The chosen losses of a free run, by parameters."""
    here = {name: float(parameters.value(simulation, name)) for name in NAMES}
    if simulation.cutoff.switches:
        fine = [finer(problem) for problem in problems]
        return lambda values: np.array([one.value(values) for one in fine])
    # kinetic energy of an atom to temperature
    scale = np.where(np.array(LOSSES) == "temperature", 2 / (3 * simulation.units.k_B), 1.0)
    steps = problems[0].steps
    return lambda values: (scale * reference(simulation, {**here, **values}, steps, SUBSTEPS))[chosen]


def differences(at: Callable[[dict[str, float]], np.ndarray], name: str, here: float) -> list[np.ndarray]:
    """Central differences of all losses by one parameter, the widest shift first."""
    return [(at({name: here * (1 + h)}) - at({name: here * (1 - h)})) / (2 * h * here) for h in SHIFTS]


def examined(case: Case, steps: int, seed: int) -> list[dict[str, Any]]:
    """Verdicts and differences of one start: a row for each loss and parameter."""
    simulation = replica(build(case.system, case.overrides), seed, case.settle)
    # some of the losses in turn, so that there are more starts
    chosen = sorted((seed + k) % len(LOSSES) for k in range(EACH))
    problems = [Problem(simulation, parse(word(LOSSES[k], steps), simulation, steps), steps) for k in chosen]
    at, rows = values_of(simulation, problems, chosen), []
    slopes = {name: differences(at, name, float(parameters.value(simulation, name))) for name in NAMES}
    for k, (which, problem) in enumerate(zip(chosen, problems, strict=True)):
        made = diagnose(problem, NAMES, parts=("agreement", "trust"), methods=("event-aware",))
        assert made.agreement is not None and made.trust is not None
        own, found = made.agreement.gradient("event-aware"), made.trust
        assert own is not None
        for name in NAMES:
            judged = found.by[name]
            rows.append(
                {
                    "loss": LOSSES[which], "name": name, "gradient": float(own.gradient[name]),
                    "differences": [float(one[k]) for one in slopes[name]], "verdict": judged.verdict,
                    "limited_by": judged.limited_by, "unknown": judged.unknown,
                    "limits": {one.what: one.values for one in judged.limits},
                    "step": found.table[f"step.{name}"][-2:].tolist(),
                }
            )  # fmt: skip
    return rows


def truth(row: dict[str, Any]) -> float | None:
    """The derivative; None where differences do not converge."""
    last = np.array(row["differences"][1:])
    return float(last[-1]) if np.ptp(last) <= AGREE * np.abs(last).max() else None


def off(row: dict[str, Any]) -> float:
    """Relative error of the gradient; infinite where there is no derivative."""
    right = truth(row)
    if right is None:
        return np.inf
    if right == 0:
        return 0.0 if row["gradient"] == 0 else np.inf
    return abs(row["gradient"] - right) / abs(right)


def options(about: str | None, cases: Mapping[str, Any], steps: int, store: str) -> ArgumentParser:
    """The command line of a study of starts."""
    made = parser(about)
    made.add_argument("--only", nargs="+", choices=list(cases), default=list(cases), metavar="CASE")
    made.add_argument("--seeds", type=int, metavar="N", help="starts of each case (default: its own number)")
    made.add_argument("--steps", type=int, default=steps, help=f"of each run (default {steps})")
    made.add_argument("--store", type=Path, default=Path(store), help="folder of what was done")
    return made


def stored(
    store: Path, name: str, seeds: range, examine: Callable[[int], list[dict[str, Any]]] | None
) -> list[list[dict[str, Any]]]:
    """The starts of a case in the store, into which those that are missing are put.

    Args:
        seeds: of the case.
        examine: rows of a start; None to examine nothing.
    """
    store.mkdir(parents=True, exist_ok=True)
    file = f"{name.replace(' ', '-').replace(',', '')}-{{}}.json"
    for seed in seeds:
        path = store / file.format(seed)
        if examine is not None and not path.exists():
            say(f"{name}: seed {seed}")
            path.write_text(json.dumps(examine(seed), default=float), encoding="utf-8")
    # more than these seeds may have been examined before
    paths = [store / file.format(seed) for seed in range(seeds.start, seeds.start + 1000)]
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.exists()]


def counted(label: str, starts: int | str, rows: Sequence[dict[str, Any]]) -> list[Any]:
    """One line of the table."""
    errors = np.array([off(row) for row in rows])
    trusted = np.array([row["verdict"] == "trusted" for row in rows], bool)
    line = [label, starts, len(rows), int(np.isinf(errors).sum()), int(trusted.sum())]
    line += [int((trusted & (errors > WRONG)).sum())]
    worst = errors[trusted].max(initial=0.0)
    line += [f"{100 * worst:.2g} %" if trusted.any() and np.isfinite(worst) else "-"]
    for right in RIGHT:
        of, strict = int((errors <= right).sum()), int((~trusted & (errors <= right)).sum())
        line += [f"{strict} of {of} ({100 * strict / of:.0f} %)" if of else "-"]
    return line


COLUMNS = (
    "", "starts", "derivatives", "without a derivative", "trusted", "false", "worst trusted",
    *(f"too strict ({100 * right:.0f} %)" for right in RIGHT),
)  # fmt: skip


def table(made: Mapping[str, list[list[dict[str, Any]]]], **kinds: Sequence[str]) -> str:
    """The counts by system, and by the values of a key of each row, as Markdown."""
    every = [row for starts in made.values() for rows in starts for row in rows]
    lines = [
        counted(name, len(starts), [row for rows in starts for row in rows])
        for name, starts in made.items() if starts
    ]  # fmt: skip
    for key, values in kinds.items():
        for value in values:
            label = ("d " if key == "loss" else "by ") + value
            lines.append(counted(label, "", [row for row in every if row[key] == value]))
    lines.append(counted("all", sum(map(len, made.values())), every))
    return markdown(COLUMNS, lines, right=True)


def main() -> None:
    """Parse, examine what is missing, count."""
    made = options(__doc__, CASES, 100, "gradient_trust")
    made.add_argument("--first", type=int, default=FIRST, help=f"the first seed (default {FIRST})")
    made.add_argument("--page", type=Path, help="run nothing: put the table between the marks of this page")
    chosen = made.parse_args()
    found = {}
    for name in chosen.only:
        case = CASES[name]
        # hard and shifted cutoffs have the same motion: every case has seeds of its own
        own = chosen.first + 100 * list(CASES).index(name)
        seeds = range(own, own + (chosen.seeds or case.starts))
        examine = None if chosen.page else partial(examined, case, chosen.steps)
        found[name] = stored(chosen.store, name, seeds, examine)
    counts = table(found, loss=LOSSES, name=NAMES)
    if chosen.page is None:
        print(counts)
    else:
        chosen.page.write_text(between(chosen.page, MARK, counts), encoding="utf-8")


if __name__ == "__main__":
    start(main)
