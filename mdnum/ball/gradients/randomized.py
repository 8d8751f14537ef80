"""The derivative of the mean loss over random parameters near the given ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.ball.gradients.base import Gradient, moved_loss, origin, start_of, used
from mdnum.ball.problem import START, Problem
from mdnum.errors import InputError


@dataclass(frozen=True)
class RandomizedSmoothing:
    """The derivative of E[loss(parameters + width * noise)], estimated from values alone.

    It needs no derivative of the program, sees through jumps (of iteration counts, of contacts), and is that
    of a smoother loss; the same seed gives the same bits. Each sample is used with its mirror image, which
    removes the value of the loss from the variance.

    Attributes:
        width: standard deviation of the noise, as a share of a parameter's size (of 1 where it is 0).
        samples: pairs of mirrored samples.
        seed: of the noise.
    """

    width: float = 1e-2
    samples: int = 256
    seed: int = 0

    name = "randomized"
    says = (
        "The derivative of the loss averaged over Gaussian noise in the parameters: of a smoother loss, "
        "and with a standard error."
    )

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The estimate; `details` holds its standard error for each name.

        Raises:
            InputError: width or samples out of range.

        Error: the standard error, and the bias of averaging, of the order of width².

        Source: Nesterov and Spokoiny (2017), with antithetic samples.
        """
        if not self.width > 0 or self.samples < 2:
            raise InputError(
                f"width is {self.width} and samples {self.samples}",
                remedy="Choose a width above 0 and at least 2 samples.",
            )
        at, start = origin(problem, names), start_of(problem)
        sizes = {
            name: float(np.max(np.abs(getattr(problem, name)))) if name in START else abs(float(at[name]))
            for name in names
        }
        widths = {name: self.width * (size or 1.0) for name, size in sizes.items()}
        noise = np.asarray(
            jax.random.normal(jax.random.key(self.seed), (self.samples, len(names)), jnp.float64)
        )
        shifts = {name: noise[:, column] * widths[name] for column, name in enumerate(names)}
        both = {name: np.concatenate([shift, -shift]) for name, shift in shifts.items()}
        values = {name: np.asarray(at[name], np.float64) + both[name] for name in names}
        losses = np.asarray(
            _many(
                {name: jnp.asarray(value).astype(at[name].dtype) for name, value in values.items()},
                problem.world, *start, problem.steps, problem.loss,
            ),
            np.float64,
        )  # fmt: skip
        half = (losses[: self.samples] - losses[self.samples :]) / 2
        slopes, errors = {}, {}
        for column, name in enumerate(names):
            each = half * noise[:, column] / widths[name]
            slopes[name] = float(np.mean(each))
            errors[name] = float(np.std(each, ddof=1) / np.sqrt(self.samples))
        depends, why = used(problem, names, slopes)
        for name in names:
            if np.any(half) and not depends[name]:
                depends[name], why[name] = (
                    True,
                    f"the loss jumps with {name}, which the run itself did not use",
                )
        details = {"standard_error": errors, "width": widths, "samples": self.samples, "seed": self.seed}
        return Gradient(self.name, self.says, float(np.mean(losses)), slopes, depends, why, details)


@eqx.filter_jit
def _many(values, world, y0, v0, steps, loss):
    return jax.vmap(lambda one: moved_loss(one, world, y0, v0, None, steps, loss))(values)
