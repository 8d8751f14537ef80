"""Build the programs of systems, and read and change system parameters.

Modules of molecular dynamics are imported inside functions. Molecular dynamics needs jax_md, a ball does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mdnum.ball.limits import DTYPES, rounded
from mdnum.program import Program, Twin
from mdnum.systems import BallSystem, opened
from mdnum.systems.toml import flat

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: Roles with separate dtypes, by world.
ROLES = {
    "md": ("state", "force", "decision", "accumulate"),
    "ball": ("state", "arithmetic", "decision", "accumulate"),
}
#: Tables of a system file that do not affect a step.
_BALL_ELSEWHERE = ("loss", "gradient", "variants", "precision", "fork")


def program_of(system: Simulation | BallSystem, steps: int | None = None) -> Program:
    """Return the program that runs a molecular-dynamics simulation or a bouncing-ball system.

    Args:
        steps: number of time steps of a ball's run; default the number in its file.
    """
    if isinstance(system, BallSystem):
        from mdnum.ball.program import BallProgram
        from mdnum.systems.build_ball import problem

        return BallProgram(problem(system.spec, steps, where=system.name))
    from mdnum.rollout.program import MdProgram
    from mdnum.systems.build import build

    return MdProgram(build(system))


def packed(system: Simulation | BallSystem, *more: Any) -> bytes:
    """Pickle a system and other objects for another process (see `unpacked`).

    The other process loads a system from its file, because code in the file exists only here.
    """
    import cloudpickle

    own: Any = system if isinstance(system, BallSystem) else system.file or system
    if getattr(own, "path", None):
        own = replace(own, path=own.path.absolute())
    return cloudpickle.dumps((own, *more))


@lru_cache(1)
def unpacked(data: bytes) -> tuple[Any, ...]:
    """Restore objects pickled by `packed`. The last system is kept to compile its programs once."""
    import cloudpickle

    own, *more = cloudpickle.loads(data)
    return opened(own), *more


def varied(system: Any, values: Mapping[str, Any], name: str | None = None) -> Any:
    """Return a copy of a system with other values of some keys. The values are validated.

    Args:
        system: a simulation, or the system of a ball.
        values: new value for each dotted key. For a key of the structure, the atoms are created again.
        name: name of the choice, for error messages about a ball.

    Raises:
        InputError: a value is not allowed for its key.
    """
    if isinstance(system, BallSystem):
        from mdnum.systems.load import vary

        name = name or ", ".join(values)
        return replace(system, spec=vary(name, values, system.spec, f"--vary {name}"), variants={})
    from mdnum.systems.build import build
    from mdnum.systems.parameters import changed

    return changed(build(system), values)


def twin(system: Any, values: Mapping[str, Any], name: str, difference: str) -> Twin:
    """Make a pair of programs: of a system, and of the same system with changed values."""
    other = varied(system, values, name)
    a, b = map(program_of, alike(system, other))
    return Twin(a, b, difference, changes(system, other))


def alike(a: Any, b: Any) -> tuple[Any, Any]:
    """Return two systems whose decisions can be compared. If terms share pair decisions in only one system,
    both systems decide separately for each term.
    """
    if isinstance(a, BallSystem) or not (a.pairwise and b.pairwise):
        return a, b
    groups = [[[row[0] for row in part.rows] for part in one.model.parts] for one in (a, b)]
    if groups[0] == groups[1] or sorted(a.model.terms) != sorted(b.model.terms):
        return a, b
    return a.apart, b.apart


def changes(a: Any, b: Any) -> dict[str, list[Any]]:
    """Return the keys whose values differ between two systems, with both values."""
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
    """Return the floating-point parameters of a time step, by dotted key."""
    if isinstance(system, BallSystem):
        data = system.spec.model_dump(mode="python", exclude_none=True, exclude=set(_BALL_ELSEWHERE))
        return {key: value for key, value in flat(data).items() if isinstance(value, float)}
    from mdnum.systems.parameters import floats

    return floats(system)


def as_used(system: Any, key: str) -> tuple[float, Any]:
    """Return a parameter as stored in the program, and its dtype in computations."""
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
