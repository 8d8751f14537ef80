"""What forks do with a system file of either world: its program, its numbers, its variations.

The world's own modules are imported by the functions: those of molecular dynamics bring jax_md, which a ball
does not need.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from mdnum.ball.limits import DTYPES, rounded
from mdnum.errors import InputError
from mdnum.program import Program, Twin
from mdnum.systems import BallSystem, System
from mdnum.systems.toml import flat

#: What has a dtype of its own, by world.
ROLES = {
    "md": ("state", "force", "decision", "accumulate"),
    "ball": ("state", "arithmetic", "decision", "accumulate"),
}
#: Of a system file, tables that do not enter a step.
_BALL_ELSEWHERE = ("loss", "gradient", "variants", "precision", "fork")


def program_of(system: System | BallSystem, steps: int | None = None) -> Program:
    """The program of a loaded system.

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
    """The system with other values of some keys of its file, checked as the file is.

    Args:
        system: as loaded, of either world.
        values: dotted key to value. A key of the structure makes the atoms again.
        name: of the choice, for messages about a ball.

    Raises:
        InputError: a value that the file could not have.
    """
    if isinstance(system, BallSystem):
        from mdnum.systems.load import vary

        name = name or ", ".join(values)
        return replace(system, spec=vary(name, values, system.spec, f"--vary {name}"), variants={})
    from mdnum.systems import structures, toml
    from mdnum.systems.schema import SystemSpec

    data = system.spec.model_dump(mode="python", exclude_none=True)
    keys = {toml.dotted(key): value for key, value in values.items()}
    toml.apply_overrides(data, keys, SystemSpec)
    try:
        spec = SystemSpec.model_validate(data)
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], where=", ".join(values)) from None
    atoms = system.atoms
    if any(key[0] == "structure" for key in keys):
        atoms = structures.make(spec.structure, spec.units, system.folder)
    return replace(system, spec=spec, atoms=atoms)


def twin(system: Any, values: Mapping[str, Any], name: str, difference: str) -> Twin:
    """The system, and with other values of some keys of its file."""
    other = varied(system, values, name)
    return Twin(program_of(system), program_of(other), difference, changes(system, other))


def changes(a: Any, b: Any) -> dict[str, list[Any]]:
    """Keys of the system files whose values differ, with both values."""
    first, second = (flat(one.spec.model_dump(mode="json", exclude={"variants"})) for one in (a, b))
    return {
        key: [first.get(key), second.get(key)]
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    }


def floats(system: Any) -> dict[str, float]:
    """The numbers of a system file that are floats and enter a step, by their dotted keys."""
    if isinstance(system, BallSystem):
        data = system.spec.model_dump(mode="python", exclude_none=True, exclude=set(_BALL_ELSEWHERE))
    else:
        data = system.spec.model_dump(mode="python", exclude_none=True, exclude={"fork"})
    return {key: value for key, value in flat(data).items() if isinstance(value, float)}


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
