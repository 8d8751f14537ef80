"""Schema of a system file of a bouncing ball (`world = "ball"`).

Heights are in m, velocities in m/s, times in s. Stiffness and damping are per mass (1/s², 1/s), so no mass is
needed. The gain of the projection contact has no unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, model_serializer, model_validator
from pydantic_core import PydanticKnownError

from mdnum.ball.limits import largest, rounded, smallest, smallest_tolerance, spacing
from mdnum.systems.schema import ForkTable
from mdnum.systems.toml import Key, Named, NonNegative, Positive, TomlTable, flat, from_array, unusable

FloatName = Literal["float16", "bfloat16", "float32", "float64"]
ParameterName = Literal[
    "k", "damping", "eps", "alpha", "tol", "restitution", "gravity", "h", "y0", "v0"
]  # fmt: skip
MethodName = Literal["unrolled", "implicit", "frozen", "event-aware", "smoothed", "randomized"]


def _numbers(value: Any) -> Any:
    """Validate a number or an array of numbers, with a single error message."""
    for item in value if isinstance(value, list | tuple) else (value,):
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise PydanticKnownError("float_type")
    return tuple(float(item) for item in value) if isinstance(value, list | tuple) else value


Numbers = Annotated[float | tuple[float, ...], BeforeValidator(_numbers)]


# --- start and flight ---------------------------------------------------------------------------------


class BoundaryTable(TomlTable):
    """Balls at rest whose depths below the floor (one large, others tiny) sum to exactly the tolerance."""

    terms: int = Field(
        default=8, ge=1, le=1_000_000, description="how many small penetrations make up the missing ulp"
    )
    format: Literal["float16", "bfloat16", "float32"] = Field(
        default="bfloat16", description="the format whose ulp is meant"
    )


class StartTable(TomlTable):
    """The state of the balls at step 0."""

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

    @model_serializer(mode="wrap")
    def _only_boundary(self, handler: Any) -> Any:
        # the other keys hold their defaults, and would contradict it
        return {"boundary": handler(self)["boundary"]} if self.boundary is not None else handler(self)


class NoControl(TomlTable):
    """No acceleration other than gravity acts in flight."""

    kind: Literal["none"]


class ConstantControl(TomlTable):
    """A constant acceleration acts in flight."""

    kind: Literal["constant"]
    value: float = Field(description="acceleration, up is positive (m/s²)")


class SineControl(TomlTable):
    """The acceleration is amplitude · sin(2π t / period + phase)."""

    kind: Literal["sine"]
    amplitude: float = Field(description="largest acceleration (m/s²)")
    period: Positive = Field(description="period (s)")
    phase: float = Field(default=0.0, description="phase at time 0 (radians)")


class ValuesControl(TomlTable):
    """The acceleration is given for each time step."""

    kind: Literal["values"]
    values: Annotated[tuple[float, ...], from_array] = Field(
        description="acceleration of each step, up is positive (m/s²); as many as integrator.steps"
    )


Control = Annotated[
    NoControl | ConstantControl | SineControl | ValuesControl, Discriminator("kind")
]  # fmt: skip


class Flight(TomlTable):
    """Forces on a ball in flight."""

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
    """A spring that pushes the ball upward below the floor."""

    kind: Literal["penalty"]
    k: Positive = Field(description="stiffness per mass (1/s²)")
    damping: NonNegative = Field(default=0.0, description="damping per mass during contact (1/s)")
    eps: NonNegative = Field(default=0.0, description="softplus width of the contact (m); 0 is the sharp one")


class ProjectionContact(_Contact):
    """The solver iterates y <- y + alpha k max(0, -y) until the stopping rule holds, then y <- max(y, 0)."""

    kind: Literal["projection"]
    k: Positive = Field(description="gain (no unit)")
    alpha: Positive = Field(
        default=0.5, description="step (no unit); an iteration multiplies the height by 1 - alpha k"
    )
    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.8, description="speed after over speed before a contact (no unit, 0 to 1)"
    )


class ImpactContact(_Contact):
    """At the floor, the velocity v is replaced by -e v, where e is the coefficient of restitution."""

    kind: Literal["impact"]
    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.8, description="speed after over speed before an impact (no unit, 0 to 1)"
    )
    rest_speed: NonNegative = Field(
        default=1e-6, description="an impact slower than this leaves the ball at rest (m/s); the Zeno stop"
    )


Contact = Annotated[PenaltyContact | ProjectionContact | ImpactContact, Discriminator("kind")]


#: Largest number of iterations, which are counted in 32 bits.
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
    """The solver stops when the sum of the residuals of all balls is below the tolerance tol."""

    rule: Literal["sum"]


class PerInstanceRule(_Tolerance):
    """The solver stops separately for each ball, when the ball's residual is below the tolerance tol."""

    rule: Literal["per-instance"]


class MaximumRule(_Tolerance):
    """The solver stops when the largest residual of all balls is below the tolerance tol."""

    rule: Literal["maximum"]


class RelativeRule(_Tolerance):
    """The solver stops when the sum of residuals, divided by the initial sum, is below the tolerance tol."""

    rule: Literal["relative"]


class FixedRule(TomlTable):
    """The solver makes a fixed number of iterations. It does not test the residual."""

    rule: Literal["fixed"]
    count: int = Field(ge=1, le=_MOST, description="iterations of every solve")


Stop = Annotated[SumRule | PerInstanceRule | MaximumRule | RelativeRule | FixedRule, Discriminator("rule")]


class IntegratorTable(TomlTable):
    """Integration method, time step, and number of time steps."""

    kind: Literal[
        "explicit-euler", "semi-implicit-euler", "velocity-verlet", "implicit-midpoint", "event-located"
    ] = Field(description="the method; event-located finds the time of an impact inside the step")
    timestep: Positive = Field(description="time step h (s)")
    steps: int = Field(default=1000, ge=1, description="steps of a run")


# --- precision, loss, gradient ------------------------------------------------------------------------


class BallPrecision(TomlTable):
    """Floating-point formats, the order of sums of residuals, and the rounding of the state."""

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
    """The loss function (a scalar quantity) whose gradient is computed."""

    kind: Literal["final-height", "mean-height", "residual-penetration"] = Field(
        default="final-height",
        description="final-height: mean height (m) at the end; mean-height: over all steps (m); "
        "residual-penetration: mean square of what the solver leaves, summed over the steps (m²)",
    )
    target: float | None = Field(
        default=None, description="final-height becomes the mean square distance from this height (m²)"
    )


class GradientTable(TomlTable):
    """The requested derivatives."""

    of: Annotated[tuple[ParameterName, ...], from_array] = Field(
        default=(), description="parameters; y0 and v0 move all balls together"
    )
    methods: Annotated[tuple[MethodName, ...], from_array] = Field(
        default=("unrolled",), description="which derivatives; each says what it is"
    )


def _changes(value: Any) -> Any:
    """Convert nested TOML tables of changed values to flat tables with dotted keys."""
    if not isinstance(value, Mapping):
        return value
    return {name: flat(table) if isinstance(table, Mapping) else table for name, table in value.items()}


Variants = Annotated[dict[str, dict[str, Any]], BeforeValidator(_changes)]


class BallSpec(TomlTable):
    """The contents of a system file of a bouncing ball."""

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
    fork: ForkTable | None = Field(
        default=None, description="a question about this system; not about its runs"
    )
    variants: Variants = Field(
        default_factory=dict,
        description='the same system with some keys changed, such as "precision.state" = "float32"',
    )

    @property
    def balls(self) -> int:
        """Number of balls that the system file describes."""
        start = self.start
        if start.boundary is not None:
            return start.boundary.terms + 1
        lists = [value for value in (start.height, start.velocity) if isinstance(value, tuple)]
        return len(lists[0]) if lists else start.balls

    @model_validator(mode="after")
    def _can_be_run(self) -> BallSpec:
        if problem := next(_problems(self), None):
            raise unusable(*problem)
        return self

    @staticmethod
    def follow(data: dict[str, Any], values: Mapping[Key, Any]) -> None:
        """Remove settings that do not apply to a newly requested contact or integrator."""
        contact, integrator, gradient = (data.get(key) for key in ("contact", "integrator", "gradient"))
        if not {("contact", "kind"), ("integrator", "kind")} & set(values):
            return
        if not isinstance(contact, dict) or not isinstance(integrator, dict):
            return
        kind = str(contact.get("kind"))
        if not solves(kind, integrator.get("kind")) and not any(key[0] == "stop" for key in values):
            data.pop("stop", None)
        if isinstance(gradient, dict) and ("gradient", "of") not in values:
            asked = gradient.get("of", ())
            if isinstance(asked, list | tuple):
                gradient["of"] = [name for name in asked if name in parameters(kind)]


# --- what the tables must say together ----------------------------------------------------------------

#: Parameters with respect to which gradients are available, by contact model.
_PARAMETERS = {
    "penalty": ("k", "damping", "eps"),
    "projection": ("k", "alpha", "restitution", "tol"),
    "impact": ("restitution",),
}
#: Error in a file: the key, the observation, and the remedy.
Problem = tuple[str, str, str]


def parameters(contact: str) -> tuple[str, ...]:
    """Return the parameters for which a kind of contact has gradients."""
    return (*_PARAMETERS.get(contact, ()), "gravity", "h", "y0", "v0")


def solves(contact: str | None, integrator: str | None) -> bool:
    """Return True if a step needs an iterative solver: a projection or an implicit spring."""
    return contact == "projection" or (integrator == "implicit-midpoint" and contact == "penalty")


def _problems(spec: BallSpec) -> Iterator[Problem]:
    yield from _on_boundary(spec) if spec.start.boundary is not None else _starts(spec)
    yield from _combinations(spec)
    yield from _stops(spec)
    yield from _unrepresentable(spec)
    yield from _losses(spec)


def _on_boundary(spec: BallSpec) -> Iterator[Problem]:
    start, boundary = spec.start, spec.start.boundary
    assert boundary is not None
    fields = StartTable.model_fields.items()
    given = [k for k, field in fields if k != "boundary" and getattr(start, k) != field.default]
    if given:
        yield (
            f"start.{given[0]}",
            f"[start] has boundary and {', '.join(given)}, but boundary determines the height of every ball",
            f"Remove {' and '.join(given)}, or boundary",
        )
    if spec.stop is None or isinstance(spec.stop, FixedRule):
        yield (
            "start.boundary",
            "a batch on the boundary needs a tolerance, which defines the boundary",
            'Give a [stop] table with rule = "sum" and tol',
        )
        return
    low = rounded(spec.stop.tol, boundary.format)
    least, most = smallest(boundary.format), largest(boundary.format)
    if not least <= low <= most:
        yield (
            "stop.tol",
            f"stop.tol = {spec.stop.tol:g} is outside the range of {boundary.format}",
            f"The smallest usable tolerance is {least:.3g}, the largest {most:.4g}",
        )
    if low != spec.stop.tol:
        yield (
            "stop.tol",
            f"stop.tol = {spec.stop.tol!r} is not a {boundary.format} number, so no sum equals it",
            f"Set it to the nearest one, tol = {low!r}",
        )
    share = spacing(np.nextafter(low, 0.0), boundary.format) / boundary.terms
    if share < least:
        yield (
            "start.boundary.terms",
            f"an ulp of the tolerance in {boundary.terms} parts gives {share:g}, below the smallest "
            f"{boundary.format}, {least:.3g}",
            "Use fewer terms or a larger stop.tol",
        )


def _starts(spec: BallSpec) -> Iterator[Problem]:
    start = spec.start
    lists = {
        name: value for name in ("height", "velocity") if isinstance(value := getattr(start, name), tuple)
    }
    for name, value in lists.items():
        if not value:
            yield f"start.{name}", f"start.{name} is an empty array", "Give one number per ball"
        if not all(map(np.isfinite, value)):
            yield f"start.{name}", f"start.{name} holds a number that is not finite", f"Correct {name}"
    if len({len(value) for value in lists.values()}) > 1:
        counts = " and ".join(f"{len(value)} in start.{name}" for name, value in lists.items())
        yield "start.velocity", f"arrays of different length: {counts}", "Give one number per ball"
    if lists and start.balls not in (1, spec.balls):
        seen = f"start.balls = {start.balls}, but start.{next(iter(lists))} has {spec.balls} numbers"
        yield "start.balls", seen, "Leave out start.balls"
    spread = "spread" if start.spread else "spread_ulps"
    if not (start.spread or start.spread_ulps):
        return
    if "height" in lists:
        seen = f"start.{spread} has no meaning if start.height gives a height for each ball"
        yield f"start.{spread}", seen, f"Remove {spread}, or give one height and start.balls"
    if start.spread and start.spread_ulps:
        yield "start.spread_ulps", "start.spread and start.spread_ulps both given", "Keep one of them"
    if spec.balls == 1:
        yield f"start.{spread}", f"start.{spread} of a single ball", "Set start.balls to 2 or more"


def _combinations(spec: BallSpec) -> Iterator[Problem]:
    contact, integrator, control = spec.contact.kind, spec.integrator.kind, spec.flight.control
    if integrator == "event-located" and contact != "impact":
        yield (
            "integrator.kind",
            f"event-located finds the time of an impact, but the contact is a {contact}",
            'Set contact.kind to "impact", or integrator.kind to "semi-implicit-euler"',
        )
    if contact != "penalty" and spec.contact.hysteresis is not None:
        yield (
            "contact.hysteresis",
            f"contact.hysteresis has no meaning for {contact}, whose contact ends within the step",
            'Remove it, or set contact.kind to "penalty"; a solver\'s hysteresis is stop.enter',
        )
    if isinstance(control, ValuesControl) and len(control.values) != spec.integrator.steps:
        seen = f"flight.control.values has {len(control.values)} numbers for {spec.integrator.steps} steps"
        yield "flight.control.values", seen, "Give one per step"
    if integrator == "event-located" and control.kind not in ("none", "constant"):
        yield (
            "flight.control.kind",
            f"the flight between impacts is a parabola under constant acceleration, not under {control.kind}",
            'Set flight.control.kind to "none" or "constant", or choose another integrator',
        )


def _stops(spec: BallSpec) -> Iterator[Problem]:
    stop, contact = spec.stop, spec.contact
    needed = solves(contact.kind, spec.integrator.kind)
    if stop is None and needed:
        what = "a projection" if contact.kind == "projection" else "implicit-midpoint"
        yield (
            "stop",
            f"table [stop] missing; {what} iterates until a stopping rule ends it",
            'Add for example [stop] with rule = "sum", tol = 1e-6, max_iter = 100',
        )
    if stop is not None and not needed:
        yield (
            "stop",
            f"[stop] does not apply: {contact.kind} with {spec.integrator.kind} does not iterate",
            'Remove the table, or set contact.kind to "projection"',
        )
    if isinstance(stop, _Tolerance) and stop.enter is not None and stop.enter < stop.tol:
        yield (
            "stop.enter",
            f"stop.enter = {stop.enter:g} is below stop.tol = {stop.tol:g}: a solve could start that "
            "has converged already",
            "Make enter at least tol",
        )
    if isinstance(stop, RelativeRule) and stop.tol >= 1:
        yield (
            "stop.tol",
            f"stop.tol = {stop.tol:g} is relative to the first residual; with 1 or more, nothing is solved",
            "A relative tolerance is below 1",
        )
    if isinstance(contact, ProjectionContact) and (product := contact.alpha * contact.k) >= 2:
        yield (
            "contact.k",
            f"alpha k = {contact.alpha:g} × {contact.k:g} = {product:g}: an iteration multiplies the height "
            f"by 1 - alpha k = {1 - product:g}, so the projection cannot converge",
            f"Make alpha k smaller than 2, with k = {contact.k:g} alpha below {2 / contact.k:.4g}; "
            "below 1 it does not overshoot either",
        )


def _unrepresentable(spec: BallSpec) -> Iterator[Problem]:
    """Find numbers outside the range of their format, and tolerances that only a zero residual meets."""
    precision, stop = spec.precision, spec.stop
    # every number with a role: key, value, role, the smallest that the role can use
    held: list[tuple[str, float, str, float | None]] = []
    if isinstance(stop, _Tolerance):
        gain = spec.contact.alpha * spec.contact.k if isinstance(spec.contact, ProjectionContact) else 1.0
        usable = smallest_tolerance(
            precision, gain, stop.rule if stop.rule in ("sum", "relative") else "term"
        )
        strictest = sorted(usable, key=lambda role: -usable[role])
        given = {"stop.tol": stop.tol, "stop.enter": stop.enter}
        held += [(k, v, role, usable[role]) for k, v in given.items() if v is not None for role in strictest]
    step = {"integrator.timestep": spec.integrator.timestep, "flight.gravity": spec.flight.gravity}
    own = spec.contact.model_dump(exclude={"kind", "hysteresis"})
    step |= {f"contact.{name}": value for name, value in own.items()}
    held += [(key, value, "arithmetic", None) for key, value in step.items()]
    for name, value in (("height", spec.start.height), ("velocity", spec.start.velocity)):
        items = value if isinstance(value, tuple) else (value,)
        held += [(f"start.{name}", item, "state", None) for item in items]
    for key, value, role, least in held:
        name, asks = getattr(precision, role), f"which precision.{role} asks for"
        if abs(value) > largest(name):
            yield (
                key,
                f"{key} = {value:g} is above the largest {name}, {largest(name):.4g}, {asks}",
                f"Make it smaller, or precision.{role} wider",
            )
        if least is None and 0 < abs(value) < smallest(name):
            yield (
                key,
                f"{key} = {value:g} is 0 in {name}, {asks}; the least is {smallest(name):.3g}",
                f"Make it larger, or precision.{role} wider",
            )
        if least is not None and value < least:
            yield (
                key,
                f"{key} = {value:g} is too small for {name}, {asks}: no residual but 0 would be below it",
                f"The smallest usable tolerance is {least:.3g}; or make precision.{role} wider",
            )


def _losses(spec: BallSpec) -> Iterator[Problem]:
    loss, contact = spec.loss, spec.contact
    if loss.kind == "residual-penetration" and contact.kind != "projection":
        yield (
            "loss.kind",
            f"residual-penetration exists only for a projection, but the contact is a {contact.kind}",
            'Set loss.kind to "final-height"',
        )
    if loss.target is not None and loss.kind != "final-height":
        seen = f"loss.target has no meaning for {loss.kind}"
        yield "loss.target", seen, 'Remove it, or use "final-height"'
    known = parameters(contact.kind)
    for name in spec.gradient.of:
        seen = f"gradient.of names {name}, "
        if name not in known:
            yield "gradient.of", f"{seen}which {contact.kind} does not have", f"It has {', '.join(known)}"
        if name == "eps" and isinstance(contact, PenaltyContact) and not contact.eps:
            seen += "but contact.eps = 0 is the sharp contact, which has no width"
            yield "gradient.of", seen, "Set contact.eps above 0"
        if name == "tol" and not isinstance(spec.stop, _Tolerance):
            yield "gradient.of", f"{seen}but the rule is fixed", "Remove it, or use another rule"


def remarks(spec: BallSpec) -> Iterator[tuple[str, dict[str, Any]]]:
    """Find valid settings that are probably unintended. Yield code and values of each finding."""
    stop, contact = spec.stop, spec.contact
    if isinstance(contact, ProjectionContact):
        # a height just below the floor is the difference of two numbers of the size of one step's fall
        start = spec.start.height
        height = max(map(abs, start)) if isinstance(start, tuple) else abs(start)
        fall = float(np.sqrt(2 * spec.flight.gravity * height)) * spec.integrator.timestep
        unit = spacing(fall, spec.precision.state) if fall else 0.0
        absolute = isinstance(stop, SumRule | PerInstanceRule | MaximumRule)
        if absolute and spec.start.boundary is None and stop.tol < unit:
            state = spec.precision.state
            yield "TOLERANCE_BELOW_ROUNDING", {"tol": stop.tol, "fall": fall, "unit": unit, "format": state}
        product = contact.alpha * contact.k
        if product > 1:
            yield "PROJECTION_OVERSHOOTS", {"product": product, "above": product - 1}
    if isinstance(contact, PenaltyContact) and spec.integrator.kind != "implicit-midpoint":
        stiff = spec.integrator.timestep * float(np.sqrt(contact.k))
        if stiff > 2:
            yield "STEP_BEYOND_STABILITY", {"stiff": stiff, "timestep": float(2 / np.sqrt(contact.k))}
