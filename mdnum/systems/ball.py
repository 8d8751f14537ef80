"""What a system file with `world = "ball"` may say: frozen pydantic models, with the unit of every number.

Heights are in m, velocities in m/s, times in s. Stiffness and damping are per mass (1/s², 1/s), so that no
mass is needed; the gain of a projection has no unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field
from pydantic_core import PydanticKnownError

from mdnum.systems.grammar import Named, NonNegative, TomlTable

Positive = Annotated[float, Field(gt=0)]
FloatName = Literal["float16", "bfloat16", "float32", "float64"]
ParameterName = Literal[
    "k", "damping", "eps", "alpha", "tol", "restitution", "gravity", "h", "y0", "v0"
]  # fmt: skip
MethodName = Literal["unrolled", "implicit", "frozen", "event-aware", "smoothed", "randomized"]


def _numbers(value: Any) -> Any:
    """A number, or an array of numbers as a tuple; a union of the two would report every mistake twice."""
    for item in value if isinstance(value, list | tuple) else (value,):
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise PydanticKnownError("float_type")
    return tuple(float(item) for item in value) if isinstance(value, list | tuple) else value


def _tuple(value: Any) -> Any:
    # TOML has arrays only; strict pydantic would refuse a list where a tuple is declared
    return tuple(value) if isinstance(value, list) else value


Numbers = Annotated[float | tuple[float, ...], BeforeValidator(_numbers)]


# --- start and flight ---------------------------------------------------------------------------------


class BoundaryTable(TomlTable):
    """A batch at rest whose penetrations sum to stop.tol exactly: one an ulp short of it, and many small."""

    terms: int = Field(
        default=8, ge=1, le=1_000_000, description="how many small penetrations make up the missing ulp"
    )
    format: Literal["float16", "bfloat16", "float32"] = Field(
        default="bfloat16", description="the format whose ulp is meant"
    )


class StartTable(TomlTable):
    """Where the balls are at step 0."""

    height: Numbers = Field(default=1.0, description="height above the floor (m), one or one per ball")
    velocity: Numbers = Field(default=0.0, description="velocity, up is positive (m/s), one or one per ball")
    balls: int = Field(
        default=1, ge=1, le=10_000_000, description="how many balls; a list of heights says it, too"
    )
    spread: NonNegative = Field(
        default=0.0, description="heights lie evenly over height ± spread (m); not with a list"
    )
    spread_ulps: int = Field(
        default=0, ge=0, description="heights are adjacent floats, so many ulps apart; not with a list"
    )
    boundary: BoundaryTable | None = Field(
        default=None, description="instead of height: a batch whose penetrations sum to stop.tol exactly"
    )


class NoControl(TomlTable):
    """Nothing but gravity acts in flight."""

    kind: Literal["none"]


class ConstantControl(TomlTable):
    """A constant acceleration."""

    kind: Literal["constant"]
    value: float = Field(description="acceleration, up is positive (m/s²)")


class SineControl(TomlTable):
    """amplitude · sin(2π t / period + phase)."""

    kind: Literal["sine"]
    amplitude: float = Field(description="largest acceleration (m/s²)")
    period: Positive = Field(description="period (s)")
    phase: float = Field(default=0.0, description="phase at time 0 (radians)")


class ValuesControl(TomlTable):
    """An acceleration for each step, held during the step."""

    kind: Literal["values"]
    values: Annotated[tuple[float, ...], BeforeValidator(_tuple)] = Field(
        description="acceleration of each step, up is positive (m/s²); as many as integrator.steps"
    )


Control = Annotated[
    NoControl | ConstantControl | SineControl | ValuesControl, Discriminator("kind")
]  # fmt: skip


class Flight(TomlTable):
    """What acts on a ball in flight."""

    gravity: NonNegative = Field(default=9.81, description="acceleration, downward (m/s²)")
    control: Control = Field(
        default_factory=lambda: NoControl(kind="none"), description="a further acceleration, given by time"
    )


# --- contact, stopping rule, integrator ---------------------------------------------------------------


class _Contact(TomlTable):
    hysteresis: Positive | None = Field(
        default=None, description="a contact ends only above this height (m); default: where it began, at 0"
    )


class PenaltyContact(_Contact):
    """A spring that pushes while the ball is below the floor."""

    kind: Literal["penalty"]
    k: Positive = Field(description="stiffness per mass (1/s²)")
    damping: NonNegative = Field(default=0.0, description="damping per mass during contact (1/s)")
    eps: NonNegative = Field(default=0.0, description="softplus width of the contact (m); 0 is the sharp one")


class ProjectionContact(_Contact):
    """y <- y + alpha k p with p = max(0, -y), until [stop] says enough; then clamped to the floor."""

    kind: Literal["projection"]
    k: Positive = Field(description="gain (no unit)")
    alpha: Positive = Field(
        default=0.5, description="step (no unit); an iteration multiplies the height by 1 - alpha k"
    )
    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.8, description="speed after over speed before a contact (no unit, 0 to 1)"
    )


class ImpactContact(_Contact):
    """v <- -e v at the floor."""

    kind: Literal["impact"]
    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.8, description="speed after over speed before an impact (no unit, 0 to 1)"
    )
    rest_speed: NonNegative = Field(
        default=1e-6, description="an impact slower than this leaves the ball at rest (m/s); the Zeno stop"
    )


Contact = Annotated[PenaltyContact | ProjectionContact | ImpactContact, Discriminator("kind")]


#: Iterations are counted in 32 bits.
_MOST = 2**31 - 1


class _Tolerance(TomlTable):
    tol: Positive = Field(description="the solver stops when its residual is below (m; relative: a share)")
    max_iter: int = Field(
        default=100, ge=1, le=_MOST, description="iterations after which the solver gives up"
    )
    enter: Positive | None = Field(
        default=None, description="a residual below this starts no solve (m), at least tol; default tol"
    )


class SumRule(_Tolerance):
    """The sum of the residuals of all balls, in the order of precision.reduction."""

    rule: Literal["sum"]


class PerInstanceRule(_Tolerance):
    """Each ball by itself."""

    rule: Literal["per-instance"]


class MaximumRule(_Tolerance):
    """The largest residual of the batch."""

    rule: Literal["maximum"]


class RelativeRule(_Tolerance):
    """The sum, as a share of what it was before the first iteration."""

    rule: Literal["relative"]


class FixedRule(TomlTable):
    """So many iterations, whatever the residual."""

    rule: Literal["fixed"]
    count: int = Field(ge=1, le=_MOST, description="iterations of every solve")


ToleranceRule = SumRule | PerInstanceRule | MaximumRule | RelativeRule
Stop = Annotated[SumRule | PerInstanceRule | MaximumRule | RelativeRule | FixedRule, Discriminator("rule")]


class IntegratorTable(TomlTable):
    """From one step to the next."""

    kind: Literal[
        "explicit-euler", "semi-implicit-euler", "velocity-verlet", "implicit-midpoint", "event-located"
    ] = Field(description="the method; event-located finds the time of an impact inside the step")
    timestep: Positive = Field(description="time step h (s)")
    steps: int = Field(default=1000, ge=1, description="steps of a run")


# --- precision, loss, gradient ------------------------------------------------------------------------


class BallPrecision(TomlTable):
    """Which float plays which role, and in which order a sum is made."""

    state: FloatName = Field(default="float64", description="heights and velocities")
    arithmetic: FloatName = Field(default="float64", description="everything a step computes")
    decision: FloatName = Field(default="float64", description="a residual and the tolerance, where compared")
    accumulate: FloatName = Field(default="float64", description="the sum of the residuals")
    loss: FloatName = Field(default="float64", description="the loss")
    reduction: Annotated[str, Named("mdnum.numerics.reductions:REDUCTIONS")] = Field(
        default="sequential",
        description="how the residuals are summed; a number may follow permuted (its seed), blocked (terms "
        'per block) and fixed-point (bits): "permuted:3"',
    )
    seed: int = Field(default=0, ge=0, description="of stochastic rounding")
    rounding: Literal["nearest", "stochastic"] = Field(
        default="nearest", description="how the state is rounded to its dtype"
    )


class LossTable(TomlTable):
    """The number that a gradient is of."""

    kind: Literal["final-height", "mean-height", "residual-penetration"] = Field(
        default="final-height",
        description="final-height: mean height (m) at the end; mean-height: over all steps (m); "
        "residual-penetration: mean square of what the solver leaves, summed over the steps (m²)",
    )
    target: float | None = Field(
        default=None, description="final-height becomes the mean square distance from this height (m²)"
    )


class GradientTable(TomlTable):
    """The derivatives asked for."""

    of: Annotated[tuple[ParameterName, ...], BeforeValidator(_tuple)] = Field(
        default=(), description="parameters; y0 and v0 move all balls together"
    )
    methods: Annotated[tuple[MethodName, ...], BeforeValidator(_tuple)] = Field(
        default=("unrolled",), description="which derivatives; each says what it is"
    )


class BallForkTable(TomlTable):
    """What `mdnum fork` does with this system where the command line does not say."""

    vary: str | None = Field(
        default=None, description='the choice to vary, such as "precision" or "contact=earlier"'
    )
    steps: int | None = Field(default=None, ge=1, description="steps of a run; default integrator.steps")
    split: Positive | None = Field(
        default=None,
        description="separation of heights that counts as split (m); default 1 % of the highest start",
    )


def _flatten(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        here = f"{path}.{key}" if path else str(key)
        if isinstance(value, Mapping):
            yield from _flatten(value, here)
        else:
            yield here, value


def _changes(value: Any) -> Any:
    """Tables of changes with dotted keys, also where TOML made tables of the dots."""
    if not isinstance(value, Mapping):
        return value
    return {
        name: dict(_flatten(table)) if isinstance(table, Mapping) else table for name, table in value.items()
    }


Variants = Annotated[dict[str, dict[str, Any]], BeforeValidator(_changes)]


class BallSpec(TomlTable):
    """A system file of the ball."""

    name: str | None = Field(default=None, description="what to call the system; default the file's name")
    about: str = Field(default="", description="one sentence or more for people, with the source")
    world: Literal["ball"] = Field(description='what the file describes: "ball"')
    start: StartTable = Field(default_factory=lambda: StartTable())
    flight: Flight = Field(default_factory=lambda: Flight())
    contact: Contact
    stop: Stop | None = Field(default=None, description="when an iterative solver stops")
    integrator: IntegratorTable
    precision: BallPrecision = Field(default_factory=lambda: BallPrecision())
    loss: LossTable = Field(default_factory=lambda: LossTable())
    gradient: GradientTable = Field(default_factory=lambda: GradientTable())
    fork: BallForkTable | None = Field(
        default=None, description="a question about this system; not about its runs"
    )
    variants: Variants = Field(
        default_factory=dict,
        description='the same system with some keys changed, such as "precision.state" = "float32"',
    )


def json_schema() -> dict[str, Any]:
    """The JSON schema of a ball's system file, for editors (systems/ball/schema.json)."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **BallSpec.model_json_schema(),
        "title": "mdnum system file of the ball",
    }
