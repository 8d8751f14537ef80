"""A cubic spline on an even grid, with the coefficients of scipy and the evaluation of jax."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Spline(eqx.Module):
    """Piecewise cubic through a table, twice continuously differentiable ("not-a-knot" ends).

    The same interpolant as scipy's InterpolatedUnivariateSpline(k=3), hence as ASE's EAM. Outside the table
    the first and last cubic are carried on; whoever must not leave the table asks `inside`.

    Attributes:
        coefficients: of 1, t, t², t³ per interval, t the distance from its left end, shape (4, intervals).
        start, step: of the grid.
        intervals: how many.
    """

    coefficients: Float[Array, "4 intervals"]
    start: float = eqx.field(static=True)
    step: float = eqx.field(static=True)
    intervals: int = eqx.field(static=True)

    @classmethod
    def through(cls, values: Float[np.ndarray, "points"], step: float, start: float = 0.0) -> Spline:
        """The spline through values at start, start + step, ..."""
        from scipy.interpolate import CubicSpline

        # fitted on the whole numbers: knots like i * step are rounded, and their differences more so
        fitted = CubicSpline(np.arange(len(values), dtype=np.float64), values, bc_type="not-a-knot")
        powers = np.asarray(step, np.float64) ** np.arange(4)[:, None]
        return cls(jnp.asarray(fitted.c[::-1] / powers), float(start), float(step), len(values) - 1)

    @property
    def end(self) -> float:
        """The last point of the table."""
        return self.start + self.intervals * self.step

    def __call__(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Value at x; differentiable."""
        offset = x - self.start
        which = jnp.clip(jnp.floor(offset / self.step), 0, self.intervals - 1)
        t = offset - which * self.step
        c0, c1, c2, c3 = self.coefficients.astype(x.dtype)[:, which.astype(jnp.int32)]
        return c0 + t * (c1 + t * (c2 + t * c3))

    def inside(self, x: Float[Array, "..."]) -> Array:
        """Whether x lies on the table, a rounding's breadth included."""
        slack = 1e-9 * self.step
        return (x >= self.start - slack) & (x <= self.end + slack)
