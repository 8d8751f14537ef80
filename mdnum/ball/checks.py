"""Numbers out of range and parts that do not go together, refused before anything runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mdnum.ball import limits
from mdnum.ball.contacts import Impact, Penalty, Projection
from mdnum.ball.integrators import EventLocated
from mdnum.ball.stopping import Fixed, GlobalSum, Hysteresis, Relative
from mdnum.errors import InputError
from mdnum.precision.policy import RolePrecision

#: Iterations are counted in 32 bits.
MOST_ITERATIONS = 2**31 - 1


def check(
    contact: Any, integrator: Any, gravity: Any, control: Any, policy: RolePrecision, lift: Any
) -> None:
    """What a world is made of.

    Raises:
        InputError: with the number that was seen and the range that was expected.
    """
    _positive("timestep h", integrator.h)
    _finite("gravity", gravity)
    if lift is not None and not float(lift) >= 0:
        raise InputError(f"hysteresis = {lift}; a contact ends at a height of 0 or more")
    if control is not None and not np.all(np.isfinite(np.asarray(control, np.float64))):
        raise InputError("the control holds a number that is not finite")
    if isinstance(integrator, EventLocated):
        if not isinstance(contact, Impact):
            raise InputError(
                "an event-located step needs an impact",
                remedy="A penalty or a projection has no instant of contact; choose another integrator",
            )
        if not 1 <= integrator.max_impacts <= MOST_ITERATIONS:
            raise InputError(
                f"max_impacts = {integrator.max_impacts}; expected a number from 1 to {MOST_ITERATIONS}"
            )
    if isinstance(contact, Penalty):
        _positive("stiffness k", contact.k)
        _at_least_zero("damping", contact.damping)
        if contact.smooth:
            _positive("softplus width eps", contact.eps)
    else:
        _share("restitution", contact.restitution)  # type: ignore[union-attr]
    if isinstance(contact, Impact):
        _at_least_zero("rest_speed", contact.rest_speed)
    if isinstance(contact, Projection):
        _positive("gain k", contact.k)
        _positive("alpha", contact.alpha)
        gain = float(contact.alpha) * float(contact.k)
        if gain >= 2:
            raise InputError(
                f"alpha * k = {gain:g}: each iteration leaves {abs(1 - gain):g} of the penetration,"
                " so the projection cannot converge",
                remedy="Choose alpha * k below 2; at 1 one iteration is enough",
            )
        check_stop(contact.stop, policy, gain)
    stop = getattr(integrator, "stop", None)
    if stop is not None:
        check_stop(stop, policy, 1.0)


def check_stop(rule: Any, policy: RolePrecision, gain: float) -> None:
    """A stopping rule, and whether the dtypes can meet its tolerance.

    Raises:
        InputError: out of range, or a tolerance that can never be met.
    """
    if not 1 <= rule.max_iter <= MOST_ITERATIONS:
        raise InputError(f"max_iter = {rule.max_iter}; expected a number from 1 to {MOST_ITERATIONS}")
    if isinstance(rule, Fixed):
        return
    if isinstance(rule, Hysteresis):
        check_stop(rule.rule, policy, gain)
        if not float(rule.enter) >= float(rule.rule.tol):
            raise InputError(
                f"enter = {rule.enter} is below tol = {rule.rule.tol}",
                remedy="The solver starts above enter and stops below tol: enter is the larger one",
            )
        return
    tol = float(rule.tol)
    _positive("tolerance tol", tol)
    kind = "relative" if isinstance(rule, Relative) else "sum" if isinstance(rule, GlobalSum) else "term"
    role, smallest = limits.strictest(limits.smallest_tolerance(policy, gain, kind))
    if tol < smallest:
        raise InputError(
            f"tol = {tol:g} cannot be met with {role} in {getattr(policy, role)}",
            remedy=f"The smallest usable tolerance is {smallest:.3g}",
        )
    limit = limits.largest(policy.decision)
    if tol > limit:
        raise InputError(f"tol = {tol:g} is beyond the largest {policy.decision}, {limit:g}")


def _finite(name: str, value: Any) -> None:
    if not math.isfinite(float(value)):
        raise InputError(f"{name} = {value}; expected a finite number")


def _positive(name: str, value: Any) -> None:
    if not (math.isfinite(float(value)) and float(value) > 0):
        raise InputError(f"{name} = {value}; expected a finite number above 0")


def _at_least_zero(name: str, value: Any) -> None:
    if not (math.isfinite(float(value)) and float(value) >= 0):
        raise InputError(f"{name} = {value}; expected a finite number, 0 or more")


def _share(name: str, value: Any) -> None:
    if not 0 <= float(value) <= 1:
        raise InputError(f"{name} = {value}; expected a number from 0 to 1")
