"""What brings about what: one row for each code that a check may give.

A mistake shows in many checks. A row says which other findings it explains, which mistakes look like it, and
what tells it from them. A cause is named only after the tests that separate it from its rivals have been
made; until then the finding has the code of what was seen, its symptom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

#: What separates causes that look alike, by the name under which a check reports that it has been done.
TESTS = {
    "repeat": "the same question again, of the same object and of a new one",
    "fresh": "the question to an object that has seen nothing else",
    "in range": "the same number of atoms, one of them moved out of reach",
    "place": "atoms in other orders: a mistake that belongs to a place stays there",
    "determinant": "the same lattice from right-handed and from left-handed vectors",
    "rounding": "whether a difference changes at random from place to place, or smoothly",
    "alone": "the same crossing by two atoms without the others",
}


@dataclass(frozen=True)
class Cause:
    """What is known about the finding of one code."""

    brings: tuple[str, ...] = ()  # codes of findings that it explains
    rivals: tuple[str, ...] = ()  # codes of other causes that show the same
    tests: tuple[str, ...] = ()  # names in TESTS, without which it may not be named
    spares: str = ""  # the question ("run", "differentiate") that it does not bear on, whatever its severity


_IMAGES = (
    "IMAGES", "LATTICE", "LEFT_HANDED", "EXTENSIVE", "TRANSLATION", "NARROW_CELL", "FACES", "CELL_ULP",
    "ROTATION",
)  # fmt: skip
_AMONG_MANY = ("CUTOFF_JUMP_AMONG_MANY", "JUMP_AMONG_MANY", "CURVATURE_JUMP_AMONG_MANY")
_FORCES = ("CURL", "NET_FORCE", "NET_TORQUE", "NOT_CONSERVED", "DRIFT")
_RUN = ("FORCES_NOT_GRADIENT", *_FORCES, "HIDDEN_JUMPS")
_REWRITTEN = (*_IMAGES, *_AMONG_MANY, *_RUN)

#: The deepest causes first: a finding goes below the first row that explains it.
CAUSES: dict[str, Cause] = {
    "NOT_REPEATABLE": Cause(
        ("STALE_STATE", "STALE_DYNAMICS", "PLACE_IN_LIST", "NEIGHBOR_CAP_BY_ORDER", "NEIGHBOR_CAP", "ORDER",
         "TOPOLOGY_BY_ORDER", *_REWRITTEN, "MIXED_PERIODICITY", "CHANGE_NOT_SEEN", "MIRROR", "DUMMY_CELL",
         "ENERGY_STEP", "NOISE_FLOOR", "LOW_PRECISION", "QUANTIZED", "NOT_BIT_IDENTICAL", "STEEP_SWITCH",
         "LONELY_FORCE", "LONELY_ENERGY"),
        rivals=("STALE_STATE", "LOW_PRECISION", "ORDER"), tests=("repeat",),
    ),
    "STALE_STATE": Cause(
        ("STALE_DYNAMICS", "CHANGE_NOT_SEEN", "NOT_CONSERVED", "HIDDEN_JUMPS", "DRIFT"),
        rivals=("NOT_REPEATABLE", "KEPT_ANSWER", "CHANGE_NOT_SEEN"), tests=("repeat", "fresh"),
    ),
    "PLACE_IN_LIST": Cause(
        ("ORDER", *_REWRITTEN, "LONELY_FORCE", "LONELY_ENERGY"),
        rivals=("ORDER", "NEIGHBOR_CAP_BY_ORDER", "FORCES_NOT_GRADIENT", "NOT_REPEATABLE"),
        tests=("repeat", "place"),
    ),
    "NEIGHBOR_CAP_BY_ORDER": Cause(
        ("NEIGHBOR_CAP", "ORDER", *_REWRITTEN),
        rivals=("ORDER", "PLACE_IN_LIST", "NOT_REPEATABLE", "LOW_PRECISION"),
        tests=("repeat", "place", "in range"),
    ),
    "NEIGHBOR_CAP": Cause(
        ("ORDER", *_REWRITTEN), rivals=("CUTOFF_JUMP_AMONG_MANY", "JUMP_AMONG_MANY", "NOT_REPEATABLE"),
        tests=("repeat", "in range"),
    ),
    # parameters by order of appearance are others for parts that hold fewer species
    "ORDER": Cause(
        (*_REWRITTEN, "MIXED_PERIODICITY", "LONELY_ENERGY"), rivals=("NOT_REPEATABLE", "LOW_PRECISION")
    ),
    **{
        code: Cause((*_IMAGES[k + 1 :], "MIXED_PERIODICITY", *_AMONG_MANY, *_RUN))
        for k, code in enumerate(_IMAGES)
    },
    # a structure is asked about with the vectors that it has, so that only other vectors show it
    "LEFT_HANDED": Cause(rivals=("LATTICE", "MIRROR"), tests=("determinant",)),
    "MIRROR": Cause(rivals=("LEFT_HANDED", "ROTATION"), tests=("determinant",)),
    "DUMMY_CELL": Cause(("MIXED_PERIODICITY",), rivals=("MIXED_PERIODICITY",)),
    "MIXED_PERIODICITY": Cause(rivals=("DUMMY_CELL", "IMAGES", "EXTENSIVE")),
    "CHANGE_NOT_SEEN": Cause(
        rivals=("STALE_STATE", "KEPT_ANSWER", "NOT_REPEATABLE"), tests=("repeat", "fresh")
    ),
    "REUSED_BUFFER": Cause(rivals=("CHANGED_INPUT",)),
    "RANDOM_SEEDED": Cause(rivals=("NOT_REPEATABLE",)),
    "TOPOLOGY_BY_ORDER": Cause(rivals=("ORDER", "PLACE_IN_LIST")),
    "WHOLE_MOLECULES": Cause(rivals=("IMAGES",)),
    "FORCES_NOT_GRADIENT": Cause(_FORCES, rivals=("PLACE_IN_LIST", "TWO_ENERGIES", "ENERGY_STEP")),
    "CURL": Cause(("NOT_CONSERVED", "DRIFT"), rivals=("FORCES_NOT_GRADIENT",)),
    "ENERGY_JUMP": Cause(("FLIPS_CHANGE_ENERGY", "ENERGY_STEP")),
    "CUTOFF_JUMP_AMONG_MANY": Cause(
        (*_AMONG_MANY[1:], "FLIPS_CHANGE_ENERGY", "HIDDEN_JUMPS", "ENERGY_STEP"),
        rivals=("ENERGY_JUMP", "NEIGHBOR_CAP"), tests=("alone",),
    ),
    "JUMP_AMONG_MANY": Cause(("CURVATURE_JUMP_AMONG_MANY", "HIDDEN_JUMPS")),
    "FORCE_JUMP": Cause(spares="run"),
    "CURVATURE_JUMP": Cause(spares="run"),
    "CURVATURE_JUMP_AMONG_MANY": Cause(spares="run"),
    "DRIFT": Cause(spares="differentiate"),
    "TIMESTEP": Cause(spares="differentiate"),
    "LOW_PRECISION": Cause(
        ("NOISE_FLOOR",), rivals=("ORDER", "NOT_REPEATABLE", "QUANTIZED"), tests=("rounding",)
    ),
    # findings that explain no other
    **dict.fromkeys(
        (
            "NARROW_CELL_REFUSED", "FAILS", "NOT_FINITE", "NO_CUTOFF", "STEEP_SWITCH", "MANY_KINKS",
            "ENERGY_STEP", "NET_FORCE", "NET_TORQUE", "NOISE_FLOOR", "QUANTIZED", "TWO_ENERGIES",
            "NOT_BIT_IDENTICAL", "KEPT_ANSWER", "BROKEN_BY_FAILURE", "CHANGED_INPUT", "LONELY_NOT_FINITE",
            "LONELY_FAILS", "LONELY_FORCE", "LONELY_ENERGY", "BLEW_UP", "STALE_DYNAMICS", "NOT_CONSERVED",
            "FLIPS_CHANGE_ENERGY", "HIDDEN_JUMPS", "CALCULATOR_FAILED", "ABOVE_LIMIT",
        ),
        Cause(),
    ),
}  # fmt: skip

_SEVERITIES = ("info", "warning", "error")


def cause(code: str) -> Cause:
    """The row of a code; of one that another package gives, an empty one."""
    return CAUSES.get(code, Cause())


def heads(findings: Sequence[tuple[str, str]]) -> list[int]:
    """For each finding the place of the one that it goes below, its own where it is listed by itself.

    It goes below the deepest mistake found that brings it about and is no less severe, and below the first
    finding of its own code. That it has the same cause is likely and not known: correct the one above, and
    ask again.

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
            for cause, row in CAUSES.items()
            if cause in first and code in row.brings and ranks[first[cause]] >= max(ranks[place], 1)
        )
        found.append(next(above, first[code]))
    # of what goes below one that goes below another, the top
    for _ in found:
        found = [found[place] for place in found]
    return found
