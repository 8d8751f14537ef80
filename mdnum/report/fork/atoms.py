"""The two neighborhoods at the fork, projected: what each run saw when it decided."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from mdnum.report.axes import PAGE_WIDTH, drawn
from mdnum.report.fork.run import ForkFolder
from mdnum.report.svg import BAD, FIRST, INK, MUTED, SECOND
from mdnum.report.words import count, number

#: The longest arrow, in cutoffs.
_ARROW = 0.22


def draw(run: ForkFolder, width: float = PAGE_WIDTH) -> Figure:
    """A and B side by side; below one another on a phone."""
    wide = width >= PAGE_WIDTH
    # `drawn` lowers a figure on a phone, whose two panels need as much room each
    return drawn(partial(_compose, run, wide), 4.0 if wide else 8.0 / 0.85, width)


def _compose(run: ForkFolder, wide: bool, figure: Figure) -> None:
    positions, moved = (
        np.stack([run.around[name] for name in names], axis=1)
        for names in (("x", "y", "z"), ("dx", "dy", "dz"))
    )
    made = run.decision or {}
    basis = projection(positions)
    flat, shift = positions @ basis.T, moved @ basis.T
    factor = magnification(shift[:, :2], float(made["cutoffs"]["A"]))
    inside = decided_inside(run)
    panels = figure.subplots(1 if wide else 2, 2 if wide else 1, squeeze=False).ravel()
    for axes, name in zip(panels, "AB", strict=True):
        offset = shift if name == "B" else np.zeros_like(shift)
        cutoff = float(made["cutoffs"][name])
        _panel(axes, run, flat, inside[name], cutoff, gap(run, name), name)
        if name == "B" and factor:
            axes.quiver(
                flat[:, 0], flat[:, 1], factor * offset[:, 0], factor * offset[:, 1], angles="xy",
                scale_units="xy", scale=1.0, color=BAD, width=0.005, zorder=4,
            )  # fmt: skip
            axes.annotate(
                f"arrows × {_round(factor)}", (0.99, 0.01), xycoords="axes fraction", ha="right", va="bottom",
                fontsize=8, color=BAD,
            )  # fmt: skip


def _panel(
    axes: Axes, run: ForkFolder, flat: np.ndarray, inside: bool, r_cut: float, beyond: float, name: str
) -> None:
    depth = np.abs(flat[:, 2]) / max(float(np.abs(flat[:, 2]).max()), 1e-300)
    # an opacity for each atom, which the stubs do not know
    shade: Any = np.clip(1.0 - 0.8 * depth, 0.15, 1.0)
    if len(flat) > 2:
        axes.scatter(flat[2:, 0], flat[2:, 1], s=26, c=MUTED, alpha=shade[2:], lw=0, zorder=2)
    axes.add_patch(Circle(tuple(flat[0, :2]), r_cut, fill=False, ec=SECOND, lw=1.2, zorder=1.5))
    axes.plot(
        flat[:2, 0], flat[:2, 1], color=FIRST if inside else MUTED, lw=2.4 if inside else 1.2,
        ls="-" if inside else (0, (3, 3)), zorder=2.5,
    )  # fmt: skip
    axes.scatter(flat[:2, 0], flat[:2, 1], s=46, c=FIRST, lw=0, zorder=3)
    for k, atom in enumerate(run.around["atom"][:2].tolist()):
        label = axes.annotate(
            str(atom), tuple(flat[k, :2]), (-7 if k == 0 else 7, 6), textcoords="offset points", fontsize=8.5,
            color=INK, ha="right" if k == 0 else "left", zorder=5,
        )  # fmt: skip
        label.set_gid("halo")
    word = "inside" if inside else "outside"
    said = axes.annotate(
        f"{name}: {word}, r − cutoff = {number(beyond, 3, signed=True)} {run.units.length}", (0.01, 0.99),
        xycoords="axes fraction", va="top", fontsize=9, color=INK, zorder=5,
    )  # fmt: skip
    said.set_gid("halo")
    reach = 1.12 * max(float(np.abs(flat[:, :2]).max()), r_cut / 2 + r_cut)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, 1.12 * reach)
    axes.set_aspect("equal")
    axes.set_xlabel(f"along the pair ({run.units.length})", color=INK)


def projection(positions: Float[np.ndarray, "near 3"]) -> Float[np.ndarray, "3 3"]:
    """Axes of the drawing: along the pair, across it where the neighbors spread most, and toward the eye."""
    along = positions[1] - positions[0]
    along = along / np.linalg.norm(along)
    rest = positions - np.outer(positions @ along, along)
    _, _, axes = np.linalg.svd(rest, full_matrices=True)
    across = axes[0] - (axes[0] @ along) * along
    if np.linalg.norm(across) < 1e-6:
        # the pair is alone, or all atoms are on one line
        other = np.eye(3)[int(np.argmin(np.abs(along)))]
        across = other - (other @ along) * along
    across = across / np.linalg.norm(across)
    return np.stack([along, across, np.cross(along, across)])


def magnification(moved: Float[np.ndarray, "near 2"], r_cut: float) -> float:
    """1, 2 or 5 times a power of ten that makes the longest arrow about a fifth of the cutoff; 0 for none."""
    longest = float(np.sqrt((moved**2).sum(axis=1)).max())
    if longest <= 0:
        return 0.0
    factor = _ARROW * r_cut / longest
    if factor <= 1:
        return 1.0
    scale = 10.0 ** np.floor(np.log10(factor))
    return float(scale * max(step for step in (1, 2, 5) if step * scale <= factor))


def decided_inside(run: ForkFolder) -> dict[str, bool]:
    """Whether each run had the pair inside its cutoff; they differ."""
    made = run.decision or {}
    if made["run"] == "start":
        inside = made["margin"] > 0
        return {"A": inside, "B": not inside}
    other = "B" if made["run"] == "A" else "A"
    return {str(made["run"]): bool(made["entered"]), other: not made["entered"]}


def gap(run: ForkFolder, name: str) -> float:
    """How far beyond the cutoff a run found the pair, length: in its own arithmetic, which decided."""
    made = run.decision or {}
    slope = made["margin"] / made["margin_length"] if made["margin_length"] else 1.0
    return -float(made["margins"][name]) / slope


def _round(factor: float) -> str:
    return (
        count(factor)
        if factor < 1e4
        else number(factor, 1).removeprefix("1\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}")
    )
