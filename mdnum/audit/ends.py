"""Where two particles stop interacting: found, and told how smoothly they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mdnum.audit.curve import Curve, bisect, slope
from mdnum.audit.jumps import SMOOTH, Jump, decay_power, measure
from mdnum.audit.probes import Pair
from mdnum.audit.threshold import SMOOTHEST, Threshold

_LOST = 0.01
"""So near to its end a smooth force may be lost in rounding, length."""

_HAIR = 3e-8
"""Of a distance: a force that would be 0 so little further on is no jump where it ends."""


def end_of(coarse: Float[np.ndarray, "points"], alive: Callable[[float], bool]) -> tuple[float, float] | None:
    """Neighboring distances, the last at which anything is felt and the next; None where nothing ever is.

    A smooth switch may be lost in rounding, here and there, before it ends: whatever is felt beyond what
    was found moves the search outward.
    """
    for k in range(len(coarse) - 2, -1, -1):
        if alive(float(coarse[k])):
            low, high = float(coarse[k]), float(coarse[k + 1])
            break
    else:
        return None
    top = high
    for _ in range(20):
        low, high = bisect(alive, low, high)
        beyond = [low + (top - low) * 0.5**power for power in range(1, 40)]
        felt = [place for place in beyond if place > high and alive(place)]
        if not felt:
            return low, high
        low, high = max(felt), top
    return low, high


def with_end(
    pair: Pair, curve: Curve, edge: tuple[float, float], found: list[Threshold], near: float
) -> list[Threshold]:
    """The thresholds with the one beyond which nothing is left, measured as such."""
    inner = [one.radius for one in found if one.radius < edge[0] - 1e-3]
    room = min(edge[0] - max([near, *inner]), 0.5)
    jump = measure(curve, *edge, room, exact=True)
    if jump.order == 1 and _nearly_gone(curve, jump, room):
        jump = replace(jump, order=2, force=0.0)
    order, radius = jump.order, edge[1]
    power = decay_power(curve, edge[1], room) if order >= 2 else None
    if power is not None:
        order = int(np.clip(round(power) + 1, 2, SMOOTHEST))
        if order > SMOOTH - 1:  # it may have been lost in rounding before its end
            radius = max(_root(curve, edge[1], room, round(power)), edge[1])
    jumps = (jump.energy, jump.force, jump.curvature if order <= SMOOTH - 1 else 0.0)
    located = max(radius - edge[0], edge[1] - edge[0])
    # what the scan took for a threshold of its own there is this one
    same = [one for one in found if abs(one.radius - edge[1]) <= 1e-3]
    third = 0.0
    if order >= SMOOTH:
        # of a third derivative that jumps it knows the place better: the force was lost in rounding before
        better = [one for one in found if one.order == SMOOTH and -1e-3 < one.radius - edge[1] < _LOST]
        same += better
        if better:
            order, third = SMOOTH, better[-1].third
        if better and better[-1].radius - edge[1] > better[-1].located:
            radius, located = better[-1].radius, better[-1].located
    last = Threshold(radius, pair.species, order, jumps, jump.doubt, *edge, True, located, third)
    return [one for one in found if one not in same] + [last]


def _nearly_gone(curve: Curve, jump: Jump, room: float) -> bool:
    """Whether a force that falls to nothing is cut a hair before it would get there.

    Where a switch is left out once it rounds to 0, that is the square root of a rounding before its end.
    """
    steepness, error = slope(curve, jump.low, -1, room, 0.0)
    left = abs(jump.force / steepness) if abs(steepness) > error else np.inf
    return left < _HAIR * max(abs(jump.low), 1.0)


def _root(curve: Curve, edge: float, room: float, power: int) -> float:
    """Where a force that falls with this power of the distance to its end would vanish.

    The edge itself where it is no further off than such an extrapolation can tell: it falls to the power only
    in the limit, while the edge is known to the last bit unless the force was lost in rounding before it.
    """
    places = edge - room * np.array([0.02, 0.01, 0.005])
    far, near, nearer = np.abs(curve.many(places)[1]) ** (1.0 / power)
    if not far > near > nearer:
        return edge
    first = places[1] + near * (places[1] - places[0]) / (far - near)
    root = places[2] + nearer * (places[2] - places[1]) / (near - nearer)
    if abs(root - edge) <= 3 * abs(root - first):
        return edge
    return float(root) if abs(root - edge) < 1e-3 * max(room, 1.0) else edge
