"""Gradient methods for a simulated bouncing ball, with different treatments of contact decisions.

Unrolled methods differentiate the executed operations. Frozen methods keep all decisions fixed. Randomized
methods average the loss over random parameters. Methods that replace the contact by another model are in
`ball_contacts`.

JAX returns a derivative of 0.0 if the run did not use a parameter. JAX also returns 0.0 if the derivative
underflowed or was clamped. The function `dependence` distinguishes the two cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jax.interpreters import partial_eval

from mdnum.ball.problem import BallLoss, BallProblem, loss_at
from mdnum.ball.rollout import BallRun
from mdnum.ball.step import Projection
from mdnum.errors import InputError, MdnumError
from mdnum.gradients.problem import Gradient, Method
from mdnum.plain import result
from mdnum.registry import Registry


class Use(NamedTuple):
    """Whether the run used a parameter to compute the loss, with an explanation."""

    depends: bool
    note: str


class BallMethod(Method):
    """Base class of gradient methods for a ball. A method is called with a `BallProblem`.

    The parameters y0 and v0 (initial height and velocity) shift all balls of a batch.
    """

    def known(self, problem: BallProblem, names: Sequence[str]) -> tuple[str, ...]:
        """Return the given names of parameters. Raise an error if a name is unknown."""
        problem.values(names)
        return tuple(names)

    def of(
        self, value: float, slopes: dict[str, float], use: dict[str, Use], details: dict[str, Any]
    ) -> Gradient:
        """Create a `Gradient` from derivatives, their details and the use of parameters."""
        gradient = {name: np.asarray(slope, np.float64) for name, slope in slopes.items()}
        made = self.result(value, gradient, {name: one.note for name, one in use.items()}, details)
        return replace(made, depends={name: one.depends for name, one in use.items()})


#: Methods by their names in system files; a name may be followed by options of the class.
BALL_METHODS: Registry[BallMethod] = Registry("gradient", "mdnum.ball_gradient_methods", BallMethod)
for _name, _class in {
    "unrolled": "ball:ThroughIterations", "frozen": "ball:Frozen", "implicit": "ball_contacts:Implicit",
    "event-aware": "ball_contacts:ThroughContacts", "smoothed": "ball_contacts:SoftFloor",
    "randomized": "ball:RandomizedSmoothing",
}.items():  # fmt: skip
    BALL_METHODS.add(_name, f"mdnum.gradients.{_class}")


@result
class BallGradients:
    """Derivatives of one loss by several methods, and why other methods do not apply."""

    gradients: tuple[Gradient, ...]  # of the methods that apply, in the order asked for
    refused: Mapping[str, str]  # why another does not, by its name

    def __iter__(self) -> Iterator[Gradient]:
        return iter(self.gradients)


def compare(
    problem: BallProblem, names: Sequence[str], methods: Sequence[str | BallMethod] | None = None
) -> BallGradients:
    """Differentiate one loss by several methods. Record why other methods do not apply.

    Args:
        names: parameters, which may include "y0" and "v0".
        methods: names or objects; all methods by default.

    Raises:
        InputError: a parameter or method does not exist.
    """
    problem.values(names)
    asked = BALL_METHODS if methods is None else methods
    gradients, refused = [], {}
    for method in [BALL_METHODS.parse(one) if isinstance(one, str) else one for one in asked]:
        try:
            gradients.append(method(problem, names))
        except MdnumError as error:
            refused[method.name] = str(error)
    return BallGradients(tuple(gradients), refused)


# --- whether a loss depends on a parameter ------------------------------------------------------------


class Dependence(NamedTuple):
    """Whether the program uses a parameter for the loss, and whether the run used it."""

    written: bool
    used: bool


def dependence(
    function: Callable[..., jax.Array],
    values: Mapping[str, Any],
    names: Sequence[str] | None = None,
    rest: tuple[Any, ...] = (),
) -> dict[str, Dependence]:
    """Determine which parameters affect a scalar loss, in the branches that ran.

    A parameter is tested by setting its tangent to NaN. A NaN tangent propagates through every operation with
    a derivative, even if the derivative is zero. Other operations stop a NaN tangent.

    Args:
        function: maps a dictionary of parameters, and the rest, to a scalar loss; compiled once, as long as
            it is the same object (or an equal `eqx.Module`).
        values: the parameters, floating point, of any shape. names: parameters to test, all by default.
        rest: further arguments; arrays passed here do not become constants of the compiled program.

    Error: an infinite slope times the zero tangent of another element is NaN, and counts as used.
    """
    given = {name: jnp.asarray(value) for name, value in values.items()}
    names = tuple(given if names is None else names)
    used = np.asarray(_used(function, given, rest, names)).tolist()
    # what the run used is written; the text is read for the others only
    return {
        name: Dependence(mark or _written(function, given, rest, name), mark)
        for name, mark in zip(names, used, strict=True)
    }


@eqx.filter_jit
def _used(function: Any, values: dict[str, jax.Array], rest: tuple, names: tuple[str, ...]):
    program = _plain(jax.make_jaxpr(function)(values, *rest))
    order, others = sorted(values), jax.tree.leaves(rest)
    at = tuple(values[name] for name in order)

    def one(which):
        along = tuple(
            jnp.where(on, jnp.nan, 0.0).astype(leaf.dtype) * jnp.ones_like(leaf)
            for on, leaf in zip(which, at, strict=True)
        )
        return jnp.isnan(jax.jvp(lambda *given: jaxpr_as_fun(program)(*given, *others)[0], at, along)[1])

    return jax.vmap(one)(jnp.array([[key == name for key in order] for name in names]))


def _written(function: Any, values: dict[str, jax.Array], rest: tuple, name: str) -> bool:
    """Return whether any branch or loop of the program uses the parameter, executed or not."""

    def slope(tangent):
        return jax.jvp(lambda q: function(values | {name: q}, *rest), (values[name],), (tangent,))[1]

    program = jax.make_jaxpr(slope)(values[name])
    return partial_eval.dce_jaxpr(program.jaxpr, [True])[1][0]


def _plain(program: ClosedJaxpr) -> ClosedJaxpr:
    """Replace the custom derivative rule of `stopping.elementwise` by plain loops.

    With the custom rule, a loop with zero derivative looks like a loop that did not run.
    """

    def run(*inputs):
        jaxpr = program.jaxpr
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *inputs], strict=True))

        def value(atom: Any) -> Any:
            return atom.val if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            given, params = [value(atom) for atom in equation.invars], equation.params
            if params.get("symbolic_zeros"):
                made = jaxpr_as_fun(_plain(params["call_jaxpr"]))(*given)
            else:
                params = jax.tree.map(
                    lambda part: _plain(part) if isinstance(part, ClosedJaxpr) else part,
                    params, is_leaf=lambda part: not isinstance(part, dict | tuple),
                )  # fmt: skip
                made = equation.primitive.bind(*given, **equation.primitive.get_bind_params(params))
            made = made if equation.primitive.multiple_results else [made]
            known.update(zip(equation.outvars, made, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    shapes = [jax.ShapeDtypeStruct(one.shape, one.dtype, weak_type=one.weak_type) for one in program.in_avals]
    return jax.make_jaxpr(run)(*shapes)


class _Rollout(eqx.Module):
    """The loss after a given number of steps. Equal problems are compiled only once."""

    steps: int = eqx.field(static=True)
    loss: BallLoss

    def __call__(self, values, world, y0, v0):
        return loss_at((self.steps, self.loss), world, y0, v0, values, None)


def used(
    problem: BallProblem,
    names: Sequence[str],
    slopes: Mapping[str, float],
    run: BallRun | None = None,
    *,
    own: bool = True,
) -> dict[str, Use]:
    """Determine whether the run used each parameter to compute the loss.

    Args:
        slopes: derivatives already known.
        run: a run of this problem; None to make one.
        own: whether the slopes are those of the problem's own operations, so that a nonzero slope proves use.
    """
    found = dict.fromkeys(names, Dependence(True, True))
    if not own or any(slopes[name] == 0 or not np.isfinite(slopes[name]) for name in names):
        run = problem.run(keep=False) if run is None else run
        rollout, rest = _Rollout(problem.steps, problem.loss), (problem.world, *problem.start_arrays)
        found = dependence(rollout, problem.origin(names), names, rest)
    return {name: Use(one.used, _note(name, one, slopes[name], problem, run)) for name, one in found.items()}


def _note(name: str, found: Dependence, slope: float, problem: BallProblem, run: BallRun | None) -> str:
    if not found.written:
        return f"the program has no path from {name} to the loss: the loss does not depend on {name}"
    if not found.used:
        why = f"no operation of the run used {name}"
        assert run is not None
        if not run.contact.any():
            why = f"no ball touched the floor, and no other operation used {name}"
        elif isinstance(problem.world.contact, Projection) and not run.iterations.any():
            why = f"the loop ended before {name} was used"
        return f"{why}: the loss does not depend on {name}"
    if slope == 0.0:
        return (
            f"the loss depends on {name}, but its derivative comes out as exactly zero "
            "(a flat piece, a cancellation or an underflow)"
        )
    return f"the loss depends on {name}"


# --- methods ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ThroughIterations(BallMethod):
    """Gradient method: derivative of the operations that ran, with all iterations of the solver."""

    # the reverse pass starts with it instead of 1 (`mdnum.numerics.formats`); a power of two
    loss_scale: float = 1.0

    name = "unrolled"
    description = (
        "the derivative of the iterations that ran; decisions are held, a solver's tolerance is in it"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str], run: BallRun | None = None) -> Gradient:
        """Compute the derivatives by reverse-mode differentiation.

        Args:
            run: a run of this problem, if there already is one.

        Error: rounding errors of the reverse pass in the precision of the run.
        """
        names = self.check(problem, names)
        run = problem.run(keep=False) if run is None else run
        value, slopes = problem.value_and_grad(names, scale=self.loss_scale)
        details = {"iterations": int(run.iterations.sum()), "loss_scale": self.loss_scale}
        return self.of(value, slopes, used(problem, names, slopes, run), details)


@dataclass(frozen=True)
class Frozen(BallMethod):
    """Gradient method: derivative with decisions and iteration counts fixed to a recorded run.

    The program with fixed decisions has no branches. Central differences in float64 check the derivative.
    """

    name = "frozen"
    description = (
        "the derivative of a program without branches, with the decisions and counts of a recorded run"
    )

    def differentiate(self, problem: BallProblem, names: tuple[str, ...], progress: Any) -> Gradient:
        """Compute derivatives by reverse mode. Check them by central differences at fixed decisions.

        Error: rounding of derivatives; relative error of central differences ~u^(2/3) (u: unit roundoff).
        """
        run = problem.run(keep=False)
        decisions = jax.tree.map(jnp.asarray, run.decisions())
        value, slopes = problem.value_and_grad(names, decisions)
        details: dict = {"decisions": int(run.contact.size), "iterations": int(run.iterations.sum())}
        if problem.world.policy.arithmetic == "float64":
            at, difference = problem.values(names), {}
            for name, size in _sizes(problem, names).items():
                width = 6e-6 * size
                high, low = (problem.value({name: at[name] + shift}, decisions) for shift in (width, -width))
                difference[name] = (high - low) / (2 * width)
            details["finite_difference"] = difference
        return self.of(value, slopes, used(problem, names, slopes, run), details)


def _sizes(problem: BallProblem, names: Sequence[str]) -> dict[str, float]:
    """Return the largest absolute value of each parameter array. 1 if all its values are 0."""
    at = problem.values(names)
    return {name: float(np.max(np.abs(np.asarray(value, np.float64)))) or 1.0 for name, value in at.items()}


@dataclass(frozen=True)
class RandomizedSmoothing(BallMethod):
    """Gradient method: derivative of E[loss(parameters + width * noise)], from loss values alone.

    The estimate includes jumps of the loss where iteration counts or contacts change. Each noise sample is
    used with both signs, to reduce the variance. The same random seed gives the same result, bit for bit.
    """

    # standard deviation of the noise, as a share of a parameter's size (of 1 where it is 0)
    width: float = 1e-2
    samples: int = 256  # pairs of mirrored samples
    seed: int = 0  # of the noise

    name = "randomized"
    kind = "average"
    description = (
        "the derivative of the loss averaged over Gaussian noise in the parameters: of a smoother loss, and "
        "with a standard error"
    )

    def differentiate(self, problem: BallProblem, names: tuple[str, ...], progress: Any) -> Gradient:
        """Estimate the derivatives; `details` contains the standard error of each derivative.

        Raises:
            InputError: the width is not positive, or fewer than two samples were requested.

        Error: the standard error, plus a bias of order width² due to the average over noise.

        Source: method of Nesterov and Spokoiny (2017), with antithetic samples.
        """
        if not self.width > 0 or self.samples < 2:
            raise InputError(
                f"no average over noise is defined for width = {self.width} and samples = {self.samples}",
                remedy="Choose a width above 0 and at least 2 samples.",
            )
        at = problem.origin(names)
        widths = {name: self.width * size for name, size in _sizes(problem, names).items()}
        shape = (self.samples, len(names))
        noise = np.asarray(jax.random.normal(jax.random.key(self.seed), shape, jnp.float64))
        values = {}
        for column, name in enumerate(names):
            shift = noise[:, column] * widths[name]
            moved = np.asarray(at[name], np.float64) + np.concatenate([shift, -shift])
            values[name] = jnp.asarray(moved).astype(at[name].dtype)
        losses = np.asarray(_many(values, problem.bare, problem.world, *problem.start_arrays), np.float64)
        half = (losses[: self.samples] - losses[self.samples :]) / 2
        slopes, errors = {}, {}
        for column, name in enumerate(names):
            each = half * noise[:, column] / widths[name]
            slopes[name] = float(np.mean(each))
            errors[name] = float(np.std(each, ddof=1) / np.sqrt(self.samples))
        use = used(problem, names, slopes, own=False)
        for name in names:
            if np.any(half) and not use[name].depends:
                use[name] = Use(True, f"the loss jumps with {name}, which the run itself did not use")
        details = {"standard_error": errors, "width": widths, "samples": self.samples, "seed": self.seed}
        return self.of(float(np.mean(losses)), slopes, use, details)


@eqx.filter_jit
def _many(values, bare, world, y0, v0):
    return jax.vmap(lambda one: loss_at(bare, world, y0, v0, one, None))(values)
