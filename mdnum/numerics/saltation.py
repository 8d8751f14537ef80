"""Saltation: the change of a tangent vector when the trajectory passes an event.

A perturbed trajectory reaches a threshold at a different time than the trajectory itself. In between, only
one of the two trajectories follows the new equation of motion. To first order, the difference in time changes
the tangent vector by a rank-one term. Time steps do not move with the event. Derivatives of a time-stepping
program therefore lack the rank-one term.

The functions accept numpy and jax arrays with leading batch axes, also inside jit.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool, Float

#: Value of |n · F-| / (|n| |F-|) at and below which an event counts as grazing.
GRAZING = 1e-8


def grazing(
    flow: Float[Any, "*batch state"], normal: Float[Any, "*batch state"], limit: float = GRAZING
) -> Bool[Any, "*batch"]:
    """Return whether the trajectory only grazes the threshold. No saltation term exists if n · F- is 0.

    The result is also True if the flow F- or the normal n is zero or not finite.
    """
    xp = normal.__array_namespace__()
    speed = xp.abs((normal * flow).sum(-1))
    scale = xp.sqrt((normal * normal).sum(-1) * (flow * flow).sum(-1))
    return ~(speed > limit * scale)


def time_shift(
    tangent: Float[Any, "*batch state"],
    flow_before: Float[Any, "*batch state"],
    normal: Float[Any, "*batch state"],
    threshold_rate: Any = 0.0,
) -> Float[Any, "*batch"]:
    """Return the change of the event time, -(n · dx + dc) / (n · F-), for a tangent dx.

    Args:
        tangent: dx, the perturbation just before the event.
        flow_before: F-, the time derivative of the state just before the event.
        normal: n, gradient of the event function c(x) that changes sign at the event.
        threshold_rate: dc, derivative of the event function at fixed x (a threshold that is itself the
            parameter: -1 for c = r - r_cut and the parameter r_cut).

    Returns:
        The shift of the event time; 0 if the trajectory grazes the threshold.
    """
    xp = normal.__array_namespace__()
    touch = grazing(flow_before, normal)
    speed = xp.where(touch, xp.ones_like(normal[..., 0]), (normal * flow_before).sum(-1))
    return xp.where(touch, xp.zeros_like(speed), -((normal * tangent).sum(-1) + threshold_rate) / speed)


def carry(
    tangent: Float[Any, "*batch state"],
    reset: Float[Any, "*batch state state"] | None,
    flow_before: Float[Any, "*batch state"],
    flow_after: Float[Any, "*batch state"],
    normal: Float[Any, "*batch state"],
    *,
    reset_rate: Any = 0.0,
    threshold_rate: Any = 0.0,
) -> Float[Any, "*batch state"]:
    """Return the tangent vector after an event: DR dx + dR - (F+ - DR F-) dt.

    The result is Xi dx with the saltation matrix Xi = DR + (F+ - DR F-) n^T / (n^T F-). The time dt is that
    of `time_shift`. The matrix Xi is never formed, so the function can be used for many atoms. For a ball
    with restitution e that hits the floor at velocity v, Xi is [[-e, 0], [-(1 + e) g / v, -e]]. For a force
    that jumps from a to b at crossing speed v, Xi is [[1, 0], [(b - a) / v, 1]].

    Args:
        reset: DR, Jacobian of the reset (state after with respect to state before); None for the identity.
        flow_before, flow_after: F- and F+, time derivatives of the state just before and just after.
        reset_rate: dR, derivative of the reset with respect to a parameter (the restitution) at fixed state.

    Returns:
        The tangent just after the event; no saltation term is added if the trajectory grazes.

        Error: a few ulps of the largest term, multiplied by |n| |F-| / |n · F-|.

    Source: Kong, Payne, Zhu & Johnson, Saltation Matrices: The Essential Tool for Linearizing Hybrid
    Dynamical Systems, Proc. IEEE 112 (2024) 585, arXiv:2306.06862.
    """

    def through(x):
        return x if reset is None else (reset * x[..., None, :]).sum(-1)

    shift = time_shift(tangent, flow_before, normal, threshold_rate)
    return through(tangent) + reset_rate - (flow_after - through(flow_before)) * shift[..., None]
