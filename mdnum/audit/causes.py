"""Which findings of an audit may be one: what fails only where another fails goes below it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")

_IMAGES = (
    "IMAGES", "LATTICE", "EXTENSIVE", "TRANSLATION", "NARROW_CELL", "FACES", "CELL_ULP", "ROTATION",
)  # fmt: skip
_FORCES = ("FORCES_NOT_GRADIENT", "CURL", "NET_FORCE", "NET_TORQUE")
_RUN = ("NOT_CONSERVED", "HIDDEN_JUMPS", "DRIFT")
_AMONG_MANY = ("JUMP_AMONG_MANY", "CURVATURE_JUMP_AMONG_MANY")

#: What each mistake brings about as well, the deepest first: neighbors that are lost by their place in a list
#: make every other way of writing a structure down another structure; images that are lost have no forces; a
#: force that is no gradient does not keep the energy of a run.
_BRINGS: dict[str, tuple[str, ...]] = {
    "NOT_REPEATABLE": (
        "STALE_STATE",
        "STALE_DYNAMICS",
        "ORDER",
        "TOPOLOGY_BY_ORDER",
        *_IMAGES,
        "MIRROR",
        "DUMMY_CELL",
        *_AMONG_MANY,
        *_FORCES,
        *_RUN,
        "ENERGY_STEP",
        "NOISE_FLOOR",
        "LOW_PRECISION",
        "QUANTIZED",
    ),
    "STALE_STATE": ("STALE_DYNAMICS", *_RUN),
    "NEIGHBOR_CAP_BY_ORDER": ("NEIGHBOR_CAP", "ORDER", *_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    "NEIGHBOR_CAP": ("ORDER", *_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    "ORDER": (*_IMAGES, *_AMONG_MANY, *_FORCES, *_RUN),
    **{code: (*_IMAGES[k + 1 :], *_AMONG_MANY, *_FORCES, *_RUN) for k, code in enumerate(_IMAGES)},
    "FORCES_NOT_GRADIENT": ("CURL", "NET_FORCE", "NET_TORQUE", "NOT_CONSERVED", "DRIFT"),
    "CURL": ("NOT_CONSERVED", "DRIFT"),
    "ENERGY_JUMP": ("FLIPS_CHANGE_ENERGY", "ENERGY_STEP"),
    "JUMP_AMONG_MANY": ("CURVATURE_JUMP_AMONG_MANY", "HIDDEN_JUMPS"),
}
#: Causes that are ones only as errors: answers that differ in a last bit bring nothing about.
_AS_ERRORS = ("NOT_REPEATABLE",)
_SEVERITIES = ("info", "warning", "error")


def heads(findings: Sequence[tuple[str, str]]) -> list[int]:
    """For each finding the place of the one that it goes below, its own where it stands by itself.

    It goes below the deepest mistake found that brings it about and is no less severe, and below the first
    finding of its own code. That it has the same cause is likely and not known: mend the one above, and ask
    again.

    Args:
        findings: code and severity of each, in the order in which they were found.
    """
    ranks = [_SEVERITIES.index(severity) for _, severity in findings]
    first: dict[str, int] = {}
    for place, (code, _) in enumerate(findings):
        if code not in first or ranks[place] > ranks[first[code]]:
            first[code] = place
    found = []
    for place, (code, _) in enumerate(findings):
        above = (
            first[cause]
            for cause, brought in _BRINGS.items()
            if cause in first
            and code in brought
            and ranks[first[cause]] >= max(ranks[place], 2 if cause in _AS_ERRORS else 1)
        )
        found.append(next(above, first[code]))
    # of what goes below one that goes below another, the top
    for _ in found:
        found = [found[place] for place in found]
    return found


def grouped(findings: Sequence[T], codes: Sequence[tuple[str, str]]) -> list[tuple[T, list[T]]]:
    """(finding, those below it) of each that stands by itself, in their order.

    Args:
        findings: of any kind.
        codes: code and severity of each.
    """
    above = heads(codes)
    return [
        (one, [other for k, other in enumerate(findings) if k != place and above[k] == place])
        for place, one in enumerate(findings)
        if above[place] == place
    ]
