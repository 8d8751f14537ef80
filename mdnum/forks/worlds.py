"""What forks do with a system file of either world: its program, its numbers, its variations.

The world's own modules are imported by the functions: those of molecular dynamics bring jax_md, which a ball
does not need.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mdnum.ball.limits import DTYPES, rounded
from mdnum.program import Program, Twin
from mdnum.systems import BallSystem
from mdnum.systems.toml import flat

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: What has a dtype of its own, by world.
ROLES = {
    "md": ("state", "force", "decision", "accumulate"),
    "ball": ("state", "arithmetic", "decision", "accumulate"),
}
#: Of a system file, tables that do not enter a step.
_BALL_ELSEWHERE = ("loss", "gradient", "variants", "precision", "fork")


def program_of(system: Simulation | BallSystem, steps: int | None = None) -> Program:
    """The program of a simulation, or of a ball's system.

    Args:
        steps: of a ball, instead of the file's.
    """
    if isinstance(system, BallSystem):
        from mdnum.ball.program import BallProgram
        from mdnum.systems.build_ball import problem

        return BallProgram(problem(system.spec, steps, where=system.name))
    from mdnum.rollout.program import MdProgram
    from mdnum.systems.build import build

    return MdProgram(build(system))


def varied(system: Any, values: Mapping[str, Any], name: str | None = None) -> Any:
    """The simulation with other values of some keys, checked as those of a system file are.

    Args:
        system: a simulation, or the system of a ball.
        values: dotted key to value. A key of the structure makes the atoms of a file again.
        name: of the choice, for messages about a ball.

    Raises:
        InputError: a value that it could not have.
    """
    if isinstance(system, BallSystem):
        from mdnum.systems.load import vary

        name = name or ", ".join(values)
        return replace(system, spec=vary(name, values, system.spec, f"--vary {name}"), variants={})
    from mdnum.systems.build import build
    from mdnum.systems.parameters import changed

    return changed(build(system), values)


def twin(system: Any, values: Mapping[str, Any], name: str, difference: str) -> Twin:
    """The system, and with other values of some keys of its file."""
    other = varied(system, values, name)
    a, b = map(program_of, alike(system, other))
    return Twin(a, b, difference, changes(system, other))


def alike(a: Any, b: Any) -> tuple[Any, Any]:
    """Two systems whose pairs have the same decisions: one for each term where only one shares them."""
    if isinstance(a, BallSystem) or not (a.pairwise and b.pairwise):
        return a, b
    groups = [[[row[0] for row in part.rows] for part in one.model.parts] for one in (a, b)]
    if groups[0] == groups[1] or sorted(a.model.terms) != sorted(b.model.terms):
        return a, b
    return a.apart, b.apart


def changes(a: Any, b: Any) -> dict[str, list[Any]]:
    """Keys whose values differ, with both values."""
    if isinstance(a, BallSystem):
        tables = tuple(one.spec.model_dump(mode="json", exclude={"variants"}) for one in (a, b))
    else:
        from mdnum.systems.describe import keys_of

        tables = keys_of(a, b)
    first, second = map(flat, tables)
    return {
        key: [first.get(key), second.get(key)]
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    }


def floats(system: Any) -> dict[str, float]:
    """The numbers that are floats and enter a step, by their dotted keys."""
    if isinstance(system, BallSystem):
        data = system.spec.model_dump(mode="python", exclude_none=True, exclude=set(_BALL_ELSEWHERE))
        return {key: value for key, value in flat(data).items() if isinstance(value, float)}
    from mdnum.systems.parameters import floats

    return floats(system)


def as_used(system: Any, key: str) -> tuple[float, Any]:
    """A number of the file as the program holds it, and the dtype that it is used in."""
    value = floats(system)[key]
    if not isinstance(system, BallSystem):
        return value, "float64"
    precision = system.spec.precision
    if key in ("start.height", "start.velocity"):
        dtype = precision.state
    elif key.startswith("stop."):
        dtype = precision.decision
    else:
        # a spread is laid out, and a control drawn up, in double precision
        dtype = "float64" if key.startswith(("start.", "flight.control.")) else precision.arithmetic
    return rounded(value, dtype), DTYPES[dtype]
