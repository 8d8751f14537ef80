"""Stiffness: a contact may be stable and the ball look fine while its derivative grows past every bound."""

from __future__ import annotations

import math

import numpy as np

from mdnum.ball import stability
from mdnum.ball.demos.base import Check, Demo, Plot, Region, Series, Table
from mdnum.ball.stability import StabilityMap, bounce_growth, limit, measure, measured_limit

H, STEPS, LONG = 0.01, 2000, 40_000
#: Steps between bounces of a ball dropped from 1 m.
FLIGHT = round(2 * math.sqrt(2 * 9.81) / (9.81 * H))
#: Stable, resonance-free, and far below the limit of 2.
QUIET = 0.6


def run() -> Demo:
    """Drop balls on floors of growing stiffness; follow their energy and their derivative."""
    z = np.geomspace(0.02, 3.0, 48)
    zeta = np.concatenate([[0.0], np.geomspace(0.003, 1.0, 19)])
    wide = measure("semi-implicit-euler", z, zeta, steps=STEPS, times=20, h=H)
    alone = _alone("semi-implicit-euler", [1.97, 2.02])
    explicit = _alone("explicit-euler", [0.03, 0.32, 1.0])
    long = measure("semi-implicit-euler", np.array([QUIET]), steps=LONG, times=80, h=H, starts=(1.0,))
    overflow = int(long.steps[np.argmax(np.isinf(long.gradient[:, 0, 0]))])
    kinds = wide.kind[-1, 0]
    growth = np.array([bounce_growth("semi-implicit-euler", x, flight_steps=FLIGHT) for x in z])
    bounces = STEPS / (FLIGHT + np.pi / z)
    predicted = growth * bounces / math.log(10)
    measured = np.log10(wide.gradient[-1, 0])
    chaotic = (z > 0.3) & (z < 1.6)
    ratio = float(np.median(measured[chaotic] / np.maximum(predicted[chaotic], 1e-9)))
    found = {name: measured_limit(name) for name in stability.SCHEMES}
    narrow = measured_limit("semi-implicit-euler", dtype="float32")
    first = float(z[np.argmax(kinds == 1)])
    at = int(np.argmin(abs(z - QUIET)))
    fine = float(long.energy[np.argmax(long.steps == overflow), 0, 0])
    return Demo(
        name="stiffness",
        title="Stable, and yet not differentiable",
        question="Up to which stiffness can the ball be trusted, and up to which its derivative?",
        answer=(
            "Held in contact, a ball is stable under semi-implicit Euler up to h sqrt(k) = 2 (measured "
            f"{found['semi-implicit-euler']:.4f}). A bouncing ball hardly notices: at 1.97 and 2.02 its "
            f"energy reaches {alone[0]:.1f} and {alone[1]:.1f} times the first. Its derivative does: from "
            f"h sqrt(k) = {first:.2f} on it passes {wide.gradient_bound:.0e} within {STEPS:,} steps, where "
            f"the exact one is at most {wide.exact[-1]:.0f}. At {QUIET} it overflows double precision by "
            f"step {overflow:,} while the energy has stayed below {fine:.1f} times the first."
        ),
        numbers={
            "limit": limit("semi-implicit-euler"),
            "limit_measured": found["semi-implicit-euler"],
            "limit_measured_float32": narrow,
            "energy_semi_implicit": {"1.97": alone[0], "2.02": alone[1]},
            "energy_explicit": {"0.03": explicit[0], "0.32": explicit[1], "1.0": explicit[2]},
            "first_unbounded_gradient": first,
            "gradient_exact": float(wide.exact[-1]),
            "gradient_overflows_at_step": overflow,
            "energy_at_overflow": fine,
            "growth_measured_over_predicted": ratio,
        },
        checks=(
            Check(
                "the measured limit is the eigenvalues'",
                found["semi-implicit-euler"],
                "2 ± 1e-4",
                abs(found["semi-implicit-euler"] - 2) < 1e-4,
            ),
            Check(
                "rounding does not move it: float32 has the same",
                narrow,
                "within 1e-3",
                abs(narrow - found["semi-implicit-euler"]) < 1e-3,
            ),
            Check(
                "the limit leaves no mark on a bouncing ball: E/E(0) just below and just above",
                alone,
                "within a factor of 10 of each other",
                0.1 < alone[0] / alone[1] < 10,
            ),
            Check(
                f"at {QUIET} the derivative overflows and the ball does not",
                [overflow, fine],
                f"before step {LONG:,}, E/E(0) below 10",
                bool(np.isinf(long.gradient[-1, 0, 0])) and fine < 10,
            ),
            Check(
                "all three classes are there",
                sorted(set(wide.kind.ravel().tolist())),
                "[0, 1, 2]",
                set(wide.kind.ravel().tolist()) == {0, 1, 2},
            ),
            Check(
                "the growth of the derivative is the one that the eigenvalues of a bounce predict",
                ratio,
                "median ratio 1 ± 0.25",
                abs(ratio - 1) < 0.25,
            ),
            Check(
                "explicit Euler gains energy at any step",
                explicit,
                "above 1, growing with h sqrt(k)",
                1 < explicit[0] < explicit[1] < explicit[2],
            ),
        ),
        tables=(_limits(found), _energies(alone, explicit), _growth(wide, predicted, z)),
        plots=(
            Plot(
                title="Steps and stiffness: semi-implicit Euler, no damping",
                x_label="h sqrt(k)",
                y_label="steps",
                x_scale="log",
                region=Region(z, wide.steps.astype(float), wide.kind[:, 0], stability.WORDS),
                verticals=((2.0, "limit of the contact"),),
                caption="The derivative is lost far below the limit, and the sooner the stiffer the floor.",
            ),
            Plot(
                title=f"Damping and stiffness, after {STEPS} steps",
                x_label="h sqrt(k)",
                y_label="damping ratio",
                x_scale="log",
                y_scale="log",
                region=Region(z, zeta[1:], wide.kind[-1, 1:], stability.WORDS),
                series=(
                    Series(
                        "limit of the contact",
                        np.array([limit("semi-implicit-euler", float(x)) for x in zeta[1:]]),
                        zeta[1:],
                        "line",
                        "ink",
                    ),
                ),
                caption="Damping takes the bounces away and the growth with them.",
            ),
            Plot(
                title=f"One ball at h sqrt(k) = {QUIET}",
                x_label="steps",
                y_label="largest so far",
                y_scale="log",
                series=(
                    Series(
                        "|dy/dy0|",
                        long.steps.astype(float),
                        np.where(np.isfinite(long.gradient[:, 0, 0]), long.gradient[:, 0, 0], np.nan),
                        "line",
                        "bad",
                    ),
                    Series("E / E(0)", long.steps.astype(float), long.energy[:, 0, 0], "line", "first"),
                    Series(
                        "exact |dy/dy0|", long.steps.astype(float), long.exact, "line", "ink", dashed=True
                    ),
                ),
                verticals=((float(overflow), "overflow"),),
                caption="Three hundred orders of magnitude between a ball that looks fine and its slope.",
            ),
            Plot(
                title=f"Growth of the derivative in {STEPS} steps",
                x_label="h sqrt(k)",
                y_label="log10 of the largest |dy/dy0|",
                x_scale="log",
                series=(
                    Series("measured", z, measured, "points", "first"),
                    Series("eigenvalues of a bounce", z, predicted, "line", "ink", dashed=True),
                ),
                verticals=((z[at], "above"),),
                caption="At h sqrt(k) = 1 three steps are exactly half a turn, and nothing grows.",
            ),
        ),
        in_md="Integrators of molecules are stable up to h omega = 2 of the fastest vibration; the "
        "derivative of a liquid is lost long before, at any step, because collisions separate trajectories.",
        data={"z": z.tolist(), "kind": kinds.tolist()},
    )


def _alone(scheme: str, z: list[float]) -> list[float]:
    """Largest E / E(0) of a ball dropped from 1 m within 600 steps of 0.01 s, undamped."""
    made = measure(scheme, np.array(z), steps=600, times=1, h=H, starts=(1.0,))
    return [float(x) for x in made.energy[-1, 0]]


def _limits(found: dict[str, float]) -> Table:
    rows = [
        (name, limit(name), found[name], limit(name, 0.1), measured_limit(name, 0.1))
        for name in stability.SCHEMES
    ]
    return Table(
        "Largest stable h sqrt(k) of a held contact (searched up to 4; a thousandfold growth in 2,000 steps)",
        ("scheme", "eigenvalues", "measured", "eigenvalues, zeta 0.1", "measured, zeta 0.1"),
        tuple(rows),
    )


def _energies(alone: list[float], explicit: list[float]) -> Table:
    rows = [("semi-implicit-euler", z, e) for z, e in zip((1.97, 2.02), alone, strict=True)]
    rows += [("explicit-euler", z, e) for z, e in zip((0.03, 0.32, 1.0), explicit, strict=True)]
    return Table(
        "Largest E / E(0) within 600 steps, from 1 m, h = 0.01 s",
        ("scheme", "h sqrt(k)", "E / E(0)"),
        tuple(rows),
    )


def _growth(wide: StabilityMap, predicted: np.ndarray, z: np.ndarray) -> Table:
    rows = [
        (
            float(z[i]),
            float(wide.energy[-1, 0, i]),
            float(wide.gradient[-1, 0, i]),
            float(predicted[i]),
            stability.WORDS[wide.kind[-1, 0, i]],
        )
        for i in range(0, len(z), 5)
    ]
    return Table(
        f"Semi-implicit Euler, undamped, {STEPS} steps, largest over four starts",
        ("h sqrt(k)", "E / E(0)", "|dy/dy0|", "predicted log10", "class"),
        tuple(rows),
    )
