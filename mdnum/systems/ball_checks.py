"""What the tables of a ball's system file must say together: combinations and ranges that cannot be run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mdnum.ball.limits import largest, rounded, smallest, smallest_tolerance, spacing
from mdnum.systems import ball
from mdnum.systems.toml import Key

#: Parameters that a gradient can be asked for, by contact.
PARAMETERS = {
    "penalty": ("k", "damping", "eps"),
    "projection": ("k", "alpha", "restitution", "tol"),
    "impact": ("restitution",),
}
ALWAYS = ("gravity", "h", "y0", "v0")


class UnusableBall(Exception):
    """A system that cannot be run, with the key at fault; loading adds the place."""

    def __init__(self, key: str, message: str, remedy: str):
        super().__init__(message)
        self.key: Key = tuple(key.split("."))
        self.message = message
        self.remedy = remedy


@dataclass(frozen=True)
class Remark:
    """Something that runs, and is probably not what was meant.

    Attributes:
        code: a short name of it.
        title: one line.
        text: what was seen.
        remedy: what to do.
        severity: info where the run itself warns of what comes of it.
    """

    code: str
    title: str
    text: str
    remedy: str
    severity: str = "warning"


def check(spec: ball.BallSpec) -> None:
    """Refuse what cannot be run.

    Raises:
        UnusableBall: names the key at fault.
    """
    _start(spec)
    _combination(spec)
    _stop(spec)
    _convergence(spec)
    _representable(spec)
    _loss_and_gradient(spec)


def warnings(spec: ball.BallSpec) -> tuple[Remark, ...]:
    """What runs, and is worth a word."""
    return tuple(_warnings(spec))


def balls(spec: ball.BallSpec) -> int:
    """How many balls the file describes."""
    start = spec.start
    if start.boundary is not None:
        return start.boundary.terms + 1
    lists = [value for value in (start.height, start.velocity) if isinstance(value, tuple)]
    return len(lists[0]) if lists else start.balls


def solves(contact: str | None, integrator: str | None) -> bool:
    """Whether a step of this kind iterates: a projection, and the implicit equation of a spring."""
    return contact == "projection" or (integrator == "implicit-midpoint" and contact == "penalty")


def _start(spec: ball.BallSpec) -> None:
    start = spec.start
    if start.boundary is not None:
        given = [
            name
            for name, field in ball.StartTable.model_fields.items()
            if name != "boundary" and getattr(start, name) != field.default
        ]
        if given:
            raise UnusableBall(
                f"start.{given[0]}",
                f"[start] has boundary and {', '.join(given)}, but boundary says where every ball is",
                f"Remove {' and '.join(given)}, or boundary",
            )
        if spec.stop is None or isinstance(spec.stop, ball.FixedRule):
            raise UnusableBall(
                "start.boundary",
                "a batch on the boundary needs a tolerance to be on the boundary of",
                'Give a [stop] table with rule = "sum" and tol',
            )
        low = rounded(spec.stop.tol, start.boundary.format)
        least, most = smallest(start.boundary.format), largest(start.boundary.format)
        if not least <= low <= most:
            raise UnusableBall(
                "stop.tol",
                f"stop.tol = {spec.stop.tol:g} is outside of what {start.boundary.format} can hold",
                f"The smallest usable tolerance is {least:.3g}, the largest {most:.4g}",
            )
        if low != spec.stop.tol:
            raise UnusableBall(
                "stop.tol",
                f"stop.tol = {spec.stop.tol!r} is no {start.boundary.format}, so no sum of them equals it",
                f"Set it to the nearest one, tol = {low!r}",
            )
        share = spacing(np.nextafter(low, 0.0), start.boundary.format) / start.boundary.terms
        if share < smallest(start.boundary.format):
            raise UnusableBall(
                "start.boundary.terms",
                f"an ulp of the tolerance in {start.boundary.terms} parts gives {share:g}, below the "
                f"smallest {start.boundary.format}, {smallest(start.boundary.format):.3g}",
                "Use fewer terms or a larger stop.tol",
            )
        return
    lists = {
        name: value for name in ("height", "velocity") if isinstance(value := getattr(start, name), tuple)
    }
    for name, value in lists.items():
        if not value:
            raise UnusableBall(f"start.{name}", f"start.{name} is an empty array", "Give one number per ball")
        if not all(map(np.isfinite, value)):
            raise UnusableBall(
                f"start.{name}", f"start.{name} holds a number that is not finite", f"Correct {name}"
            )
    if len({len(value) for value in lists.values()}) > 1:
        counts = " and ".join(f"{len(value)} in start.{name}" for name, value in lists.items())
        raise UnusableBall(
            "start.velocity", f"arrays of different length: {counts}", "Give one number per ball"
        )
    if lists and start.balls not in (1, balls(spec)):
        raise UnusableBall(
            "start.balls",
            f"start.balls = {start.balls}, but start.{next(iter(lists))} has {balls(spec)} numbers",
            "Leave out start.balls",
        )
    if "height" in lists and (start.spread or start.spread_ulps):
        name = "spread" if start.spread else "spread_ulps"
        raise UnusableBall(
            f"start.{name}",
            f"start.{name} has no meaning where start.height gives every ball its own",
            f"Remove {name}, or give one height and start.balls",
        )
    if start.spread and start.spread_ulps:
        raise UnusableBall(
            "start.spread_ulps", "start.spread and start.spread_ulps both given", "Keep one of them"
        )
    if (start.spread or start.spread_ulps) and balls(spec) == 1:
        name = "spread" if start.spread else "spread_ulps"
        raise UnusableBall(f"start.{name}", f"start.{name} of a single ball", "Set start.balls to 2 or more")


def _combination(spec: ball.BallSpec) -> None:
    contact, integrator = spec.contact.kind, spec.integrator.kind
    if integrator == "event-located" and contact != "impact":
        raise UnusableBall(
            "integrator.kind",
            f"event-located finds the time of an impact, but the contact is a {contact}",
            'Set contact.kind to "impact", or integrator.kind to "semi-implicit-euler"',
        )
    if contact != "penalty" and spec.contact.hysteresis is not None:
        raise UnusableBall(
            "contact.hysteresis",
            f"contact.hysteresis has no meaning for {contact}, whose contact ends within the step",
            'Remove it, or set contact.kind to "penalty"; a solver\'s hysteresis is stop.enter',
        )
    control = spec.flight.control
    if isinstance(control, ball.ValuesControl) and len(control.values) != spec.integrator.steps:
        raise UnusableBall(
            "flight.control.values",
            f"flight.control.values has {len(control.values)} numbers for {spec.integrator.steps} steps",
            "Give one per step",
        )
    if integrator == "event-located" and control.kind not in ("none", "constant"):
        raise UnusableBall(
            "flight.control.kind",
            f"the flight between impacts is a parabola under constant acceleration, not under {control.kind}",
            'Set flight.control.kind to "none" or "constant", or choose another integrator',
        )


def _stop(spec: ball.BallSpec) -> None:
    needed = solves(spec.contact.kind, spec.integrator.kind)
    if spec.stop is None:
        if needed:
            what = "a projection" if spec.contact.kind == "projection" else "implicit-midpoint"
            raise UnusableBall(
                "stop",
                f"table [stop] missing; {what} iterates until it is told to stop",
                'Add for example [stop] with rule = "sum", tol = 1e-6, max_iter = 100',
            )
        return
    if not needed:
        raise UnusableBall(
            "stop",
            f"[stop] has no meaning here: {spec.contact.kind} with {spec.integrator.kind} iterates nothing",
            'Remove the table, or set contact.kind to "projection"',
        )
    if isinstance(spec.stop, ball.FixedRule):
        return
    if spec.stop.enter is not None and spec.stop.enter < spec.stop.tol:
        raise UnusableBall(
            "stop.enter",
            f"stop.enter = {spec.stop.enter:g} is below stop.tol = {spec.stop.tol:g}: a solve would start "
            "that is over before it begins",
            "Make enter at least tol",
        )
    if isinstance(spec.stop, ball.RelativeRule) and spec.stop.tol >= 1:
        raise UnusableBall(
            "stop.tol",
            f"stop.tol = {spec.stop.tol:g} of the first residual is above that residual: nothing is solved",
            "A relative tolerance is below 1",
        )


def _convergence(spec: ball.BallSpec) -> None:
    contact = spec.contact
    if not isinstance(contact, ball.ProjectionContact):
        return
    product = contact.alpha * contact.k
    if product >= 2:
        raise UnusableBall(
            "contact.k",
            f"alpha k = {contact.alpha:g} × {contact.k:g} = {product:g}: an iteration multiplies the height "
            f"by 1 - alpha k = {1 - product:g}, so the projection cannot converge",
            f"Make alpha k smaller than 2, with k = {contact.k:g} alpha below {2 / contact.k:.4g}; "
            "below 1 it does not overshoot either",
        )


def _values(spec: ball.BallSpec) -> Iterator[tuple[str, float, str, str]]:
    """Every number with a role: key, value, format, and the key of that format."""
    precision = spec.precision
    arithmetic = (precision.arithmetic, "precision.arithmetic")
    state = (precision.state, "precision.state")
    yield ("integrator.timestep", spec.integrator.timestep, *arithmetic)
    yield ("flight.gravity", spec.flight.gravity, *arithmetic)
    for name, value in spec.contact.model_dump(exclude={"kind", "hysteresis"}).items():
        yield (f"contact.{name}", value, *arithmetic)
    for name in ("height", "velocity"):
        value = getattr(spec.start, name)
        for item in value if isinstance(value, tuple) else (value,):
            yield (f"start.{name}", item, *state)


def _representable(spec: ball.BallSpec) -> None:
    stop = spec.stop
    if stop is not None and not isinstance(stop, ball.FixedRule):
        for key, value in (("stop.tol", stop.tol), ("stop.enter", stop.enter)):
            if value is not None:
                _tolerance(spec, stop, key, value)
    for key, value, name, role in _values(spec):
        if abs(value) > largest(name):
            raise UnusableBall(
                key,
                f"{key} = {value:g} is above the largest {name}, {largest(name):.4g}, which {role} asks for",
                f"Make it smaller, or {role} wider",
            )
        if 0 < abs(value) < smallest(name):
            raise UnusableBall(
                key,
                f"{key} = {value:g} is 0 in {name}, which {role} asks for; the least is {smallest(name):.3g}",
                f"Make it larger, or {role} wider",
            )


def _tolerance(spec: ball.BallSpec, stop: ball.ToleranceRule, key: str, value: float) -> None:
    """Refuse a tolerance that no residual but 0 would be below, or that is no number of a role's format."""
    gain = 1.0
    if isinstance(spec.contact, ball.ProjectionContact):
        gain = spec.contact.alpha * spec.contact.k
    kind = stop.rule if stop.rule in ("sum", "relative") else "term"
    usable = smallest_tolerance(spec.precision, gain, kind)
    for role in sorted(usable, key=lambda role: -usable[role]):
        name, least = getattr(spec.precision, role), usable[role]
        if value > largest(name):
            raise UnusableBall(
                key,
                f"{key} = {value:g} is above the largest {name}, {largest(name):.4g}, which precision.{role} "
                "asks for",
                f"Make it smaller, or precision.{role} wider",
            )
        if value < least:
            raise UnusableBall(
                key,
                f"{key} = {value:g} is too small for {name}, which precision.{role} asks for: no residual "
                "but 0 would be below it",
                f"The smallest usable tolerance is {least:.3g}; or make precision.{role} wider",
            )


def _loss_and_gradient(spec: ball.BallSpec) -> None:
    loss, kind = spec.loss, spec.contact.kind
    if loss.kind == "residual-penetration" and kind != "projection":
        raise UnusableBall(
            "loss.kind",
            f"residual-penetration is what a projection's solver leaves, but the contact is a {kind}",
            'Set loss.kind to "final-height"',
        )
    if loss.target is not None and loss.kind != "final-height":
        raise UnusableBall(
            "loss.target", f"loss.target has no meaning for {loss.kind}", 'Remove it, or use "final-height"'
        )
    known = (*PARAMETERS[kind], *ALWAYS)
    for name in spec.gradient.of:
        if name not in known:
            raise UnusableBall(
                "gradient.of",
                f"gradient.of names {name}, which {kind} does not have",
                f"It has {', '.join(known)}",
            )
        if name == "eps" and isinstance(spec.contact, ball.PenaltyContact) and not spec.contact.eps:
            raise UnusableBall(
                "gradient.of",
                "gradient.of names eps, but contact.eps = 0 is the sharp contact, which no width belongs to",
                "Set contact.eps above 0",
            )
        if name == "tol" and (spec.stop is None or isinstance(spec.stop, ball.FixedRule)):
            raise UnusableBall(
                "gradient.of",
                "gradient.of names tol, but the rule is fixed",
                "Remove it, or use another rule",
            )


def _warnings(spec: ball.BallSpec) -> Iterator[Remark]:
    stop, contact = spec.stop, spec.contact
    if isinstance(contact, ball.ProjectionContact):
        # a height just below the floor is the difference of two numbers of the size of one step's fall
        start = spec.start.height
        height = max(map(abs, start)) if isinstance(start, tuple) else abs(start)
        fall = float(np.sqrt(2 * spec.flight.gravity * height)) * spec.integrator.timestep
        unit = spacing(fall, spec.precision.state) if fall else 0.0
        absolute = isinstance(stop, ball.SumRule | ball.PerInstanceRule | ball.MaximumRule)
        if absolute and spec.start.boundary is None and stop.tol < unit:
            yield Remark(
                "TOLERANCE_BELOW_ROUNDING",
                "the tolerance is below the rounding of the heights",
                f"stop.tol = {stop.tol:g}, but after a fall of {fall:.2g} m in a step a height is known to "
                f"{unit:.2g} m in {spec.precision.state}: iterations past that resolve rounding errors.",
                f"Raise stop.tol to {unit:.1g}, or make precision.state wider",
                # a stop that rounding did decide is a warning of the run's own
                severity="info",
            )
        product = contact.alpha * contact.k
        if product > 1:
            yield Remark(
                "PROJECTION_OVERSHOOTS",
                "the projection overshoots",
                f"alpha k = {product:g} is above 1: one iteration lifts a ball to {product - 1:.3g} times "
                "its penetration above the floor, and the solve ends there.",
                "Make alpha k at most 1",
            )
    if isinstance(contact, ball.PenaltyContact):
        stiff = spec.integrator.timestep * float(np.sqrt(contact.k))
        if stiff > 2 and spec.integrator.kind != "implicit-midpoint":
            yield Remark(
                "STEP_BEYOND_STABILITY",
                "the time step is beyond the stability limit of the contact",
                f"h sqrt(k) = {stiff:.3g}, and no explicit scheme is stable in contact above 2.",
                f"Make the timestep smaller than {2 / np.sqrt(contact.k):.3g} s, or use implicit-midpoint",
            )
