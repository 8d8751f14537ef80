"""Plots that are awkward in every way."""

from __future__ import annotations

import numpy as np

from mdnum.ball.demos.base import Plot, Region, Series


def awkward() -> dict[str, Plot]:
    """Plots by what is awkward in them."""
    rng = np.random.default_rng(3)
    x = np.linspace(0, 10, 200)
    gaps = np.sin(x)
    gaps[[5, 40, 42]] = np.nan
    gaps[100:140] = np.nan
    decay = np.exp(-3 * x)
    decay[::17] = 0.0
    decay[8::17] *= -1
    long = np.linspace(0, 1, 100_000)
    spike = np.sin(40 * long)
    spike[54_321] = 7.0
    k = 0.5035674359581247 + np.arange(-40, 41) * 2.0**-53
    grid = np.geomspace(0.01, 4, 60)
    region = (np.add.outer(np.log10(grid), 1.5 * np.log10(grid)) > -0.8).astype(int)
    region += (np.add.outer(grid, grid) > 3.2).astype(int)
    return {
        "gaps": Plot("Gaps", "time (s)", "height (m)", (Series("height", x, gaps),)),
        "zeros on a log axis": Plot(
            "Zeros",
            "iteration",
            "residual",
            y_scale="log",
            series=(
                Series("residual", x, decay, mark="line+points"),
                Series("all negative", x, -decay - 1, role="second", mark="points"),
            ),
        ),
        "nothing positive": Plot("None", "k", "gradient", (Series("", x, 0 * x),), y_scale="log"),
        "empty": Plot("Empty", "k", "loss", (Series("none", np.zeros(0), np.zeros(0)),), x_scale="log"),
        "no series": Plot("Nothing", "k", "loss"),
        "all NaN": Plot("NaN", "k", "loss", (Series("none", x, x * np.nan),), y_scale="symlog"),
        "one point": Plot(
            "One", "k", "loss", (Series("one", np.array([3.0]), np.array([1e-30])),), y_scale="log"
        ),
        "one point alone": Plot("One", "k", "loss", (Series("one", np.array([3.0]), np.array([2.0])),)),
        "many points": Plot(
            "Many",
            "k",
            "loss",
            series=(
                Series("line", long, spike),
                Series("cloud", long, rng.normal(size=100_000), mark="points", role="second"),
                Series("steps", long, np.floor(5 * long), mark="steps", role="third", dashed=True),
            ),
        ),
        "infinite": Plot(
            "Infinite",
            "step",
            "gradient",
            y_scale="log",
            series=(
                Series(
                    "unrolled", x, np.where(x > 8, np.inf, 10 ** (38 * np.minimum(x, 8))), mark="line+points"
                ),
            ),
        ),
        "last digits": Plot(
            "Last digits",
            "k",
            "iterations",
            series=(Series("iterations", k, np.where(k < k[40], 30, 29), mark="steps"),),
            verticals=(
                (float(k[40]), "last float with 30 iterations"),
                (float(k[41]), "first float with 29"),
            ),
        ),
        "symlog": Plot(
            "Symmetric",
            "eps",
            "dloss/dk",
            x_scale="log",
            y_scale="symlog",
            series=(
                Series(
                    "gradient", np.geomspace(1e-8, 1, 50), np.linspace(-1, 1, 50) ** 9, mark="line+points"
                ),
                Series("exact", np.geomspace(1e-8, 1, 50), np.full(50, 0.3), role="muted", dashed=True),
            ),
            horizontals=((0.3, "closed form"), (-1e-3, "noise floor of the estimate")),
        ),
        "hidden": Plot(
            "One upon the other",
            "step",
            "iterations",
            series=(
                Series("float32, unsafe sum", np.arange(5), np.array([1, 0, 0, 0, 2]), mark="line+points"),
                Series("bfloat16, safe sum", np.arange(5), np.array([1, 0, 0, 0, 2]), role="second"),
                Series("bfloat16, unsafe sum", np.arange(5), np.zeros(5), role="bad", mark="line+points"),
            ),
        ),
        "map": Plot(
            "Stability",
            "h √k",
            "damping h",
            x_scale="log",
            y_scale="log",
            region=Region(
                grid,
                grid,
                region,
                ("forward and gradient bounded", "forward bounded, gradient overflows", "neither bounded"),
            ),
            verticals=((2.0, "h √k = 2"),),
            horizontals=((0.1, "usual damping"),),
        ),
        "map of one cell": Plot(
            "Cell",
            "x",
            "y",
            region=Region(np.array([0.0]), np.array([1.0]), np.array([[1]]), ("never", "always")),
        ),
        "crowded marks": Plot(
            "Bounces",
            "time (s)",
            "height (m)",
            series=(Series("height", x, np.abs(np.cos(x)) * np.exp(-x / 5)),),
            verticals=tuple((10 - 8 * 0.6**n, f"bounce {n + 1}") for n in range(9)),
        ),
        "long words": Plot(
            "Long",
            "the logarithm of the ratio of the learned stiffness to the one that was asked for (1/s²)",
            "derivative of the loss with respect to stiffness (m s²)",
            series=tuple(
                Series(
                    f"a series whose description is number {n} of several rather long ones",
                    x,
                    x + n,
                    role=role,
                )
                for n, role in enumerate(("first", "second", "third", "bad", "muted", "ink"))
            ),
        ),
        "small numbers": Plot(
            "Small",
            "k",
            "loss",
            (Series("loss", x * 1e-9, x * 1e-12 - 4e-12), Series("other", x * 1e-9, x * 0)),
        ),
    }
