"""Does a loss depend on a parameter? Asked of the program, of the run it made, and of the number.

JAX has no `requires_grad`: a parameter that a run never used has the derivative 0.0, and so has one whose
derivative underflowed or was clamped away. The three are told apart here by marking the parameter and
following the mark through the program, once through every branch (the text) and once through the branches and
loop iterations that ran (the tape). A comparison ends a mark: what only decides has no derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array, Bool

from mdnum.errors import InputError

_ELEMENTWISE_WORDS = (
    "add add_any sub mul div rem max min neg abs sign floor ceil round exp exp2 log log1p expm1 sin cos tan "
    "asin acos atan atan2 sinh cosh tanh asinh acosh atanh logistic sqrt rsqrt cbrt pow integer_pow square "
    "erf erfc erf_inv and or xor not shift_left shift_right_logical shift_right_arithmetic nextafter "
    "convert_element_type bitcast_convert_type reduce_precision copy copy_p real imag conj complex clamp "
    "optimization_barrier pvary"
)
_MOVING_WORDS = "broadcast_in_dim reshape squeeze expand_dims transpose rev slice dynamic_slice concatenate"
# what carries a mark from each element of its operands to the same element of its result
_ELEMENTWISE = frozenset(_ELEMENTWISE_WORDS.split())
# what moves elements about: the mark moves as the element does
_MOVING = frozenset(_MOVING_WORDS.split())
_REDUCING = frozenset(("reduce_sum", "reduce_max", "reduce_min", "reduce_prod"))
_ENDING = frozenset(("stop_gradient",))
# the parameters under which a call keeps the program it calls
_CALLED = ("jaxpr", "call_jaxpr", "fun_jaxpr")


@dataclass(frozen=True)
class Dependence:
    """How a loss depends on one parameter.

    Attributes:
        name: the parameter.
        written: whether any path of the program leads from it to the loss.
        used: whether the branches and iterations that ran do.
        derivative: the derivative of the loss, NaN where it was not asked for.
        message: the answer in words.
    """

    name: str
    written: bool
    used: bool
    derivative: float
    message: str


def dependence(
    function: Callable[..., jax.Array],
    values: Mapping[str, Any],
    names: Sequence[str] | None = None,
    rest: Sequence[Any] = (),
    *,
    gradient: Mapping[str, float] | None = None,
    marks: Any = None,
    why_unused: str = "nothing that ran used {name}",
) -> dict[str, Dependence]:
    """Whether a scalar loss depends on its parameters, by the tape of the run at these values.

    Args:
        function: from a dictionary of parameters, and the rest, to a scalar loss; may loop and branch. It is
            compiled once, as long as it is the same object (or an equal `eqx.Module`).
        values: the parameters, floating point, of any shape.
        names: those asked about, all by default.
        rest: further arguments, pytrees of arrays. What must not become a constant of the compiled program
            (the zero of a fence) is passed here and not closed over.
        gradient: derivatives already known; by default they are taken here in forward mode.
        marks: what `follow` gave for the names, where it was asked already.
        why_unused: begins the sentence about a parameter that the run did not use.

    Returns:
        One answer for each name.

    Raises:
        InputError: a name that is not among the values.

    Error: none in the marks. They follow the branches of this compiled program; one whose decisions lie
    within a rounding of their thresholds may branch otherwise when compiled alone, unless its arithmetic is
    fenced (`mdnum.numerics.exact`).
    """
    names = list(values) if names is None else list(names)
    for name in names:
        if name not in values:
            raise InputError(f"no parameter {name!r}; there are {', '.join(values)}")
    primals = {name: jnp.asarray(value) for name, value in values.items()}
    on = _tape(function, primals, tuple(rest), tuple(names)) if marks is None else marks
    # the order in which a dictionary is flattened
    order = sorted(primals)
    answers = {}
    for name, mark in zip(names, np.asarray(on).tolist(), strict=True):
        if gradient is not None:
            derivative = float(gradient[name])
        else:
            along = {key: jnp.full_like(value, key == name) for key, value in primals.items()}
            derivative = float(_slope(function, primals, tuple(rest), along))
        # what the run used is written; the text is read for the others only
        written = mark or _written(function, primals, tuple(rest), [key == name for key in order])
        answers[name] = Dependence(
            name, written, mark, derivative, _say(name, written, mark, derivative, why_unused)
        )
    return answers


def follow(
    function: Callable[..., jax.Array], primals: Mapping[str, jax.Array], rest: tuple, names: Sequence[str]
) -> Bool[Array, "names"]:
    """Whether the run at these values uses each parameter; to be traced, inside a jit of one's own.

    Args:
        function, rest: as in `dependence`.
        primals: the parameters.
        names: those asked about.
    """
    primals = dict(primals)
    program = jax.make_jaxpr(function)(primals, *rest)
    leaves = jax.tree.leaves((primals, rest))
    never = [None] * (len(leaves) - len(primals))

    def one(which: jax.Array) -> jax.Array:
        seeds = [
            jnp.broadcast_to(which[place], np.shape(primals[key]))
            for place, key in enumerate(sorted(primals))
        ]
        (mark,) = _follow(program.jaxpr, program.consts, leaves, [*seeds, *never])[1]
        return jnp.asarray(False) if mark is None else jnp.any(mark)

    return jax.vmap(one)(jnp.array([[key == name for key in sorted(primals)] for name in names]))


_tape = eqx.filter_jit(follow)


def _written(function: Any, primals: Any, rest: tuple, marked: list[bool]) -> bool:
    program = jax.make_jaxpr(function)(primals, *rest)
    (reached,) = _reach(program.jaxpr, marked + [False] * (len(program.jaxpr.invars) - len(marked)))
    return reached


@eqx.filter_jit
def _slope(function: Any, primals: Any, rest: Any, along: Any) -> jax.Array:
    return jax.jvp(lambda given: function(given, *rest), (primals,), (along,))[1]


def _carries(var: Any) -> bool:
    return var.aval.dtype != np.dtype(bool)


def _say(name: str, written: bool, used: bool, derivative: float, why_unused: str) -> str:
    if not written:
        return f"the program has no path from {name} to the loss: the loss does not depend on {name}"
    if not used:
        return f"{why_unused.format(name=name)}: the loss does not depend on {name}"
    if derivative == 0.0:
        return (
            f"the loss depends on {name}, but its derivative comes out as exactly zero "
            "(a flat piece, a cancellation or an underflow)"
        )
    return f"the loss depends on {name}"


def _called(params: Mapping[str, Any]) -> tuple[Any, list[Any]] | None:
    for key in _CALLED:
        inner = params.get(key)
        if inner is not None and hasattr(inner, "eqns"):
            return (inner.jaxpr, list(inner.consts)) if hasattr(inner, "consts") else (inner, [])
    return None


def _loop_carry(body: Any, before: list[bool], carry: list[bool], after: list[bool]) -> list[bool]:
    """Which parts of a loop's carry can ever be marked: the least fixed point."""
    while True:
        out = _reach(body, before + carry + after)[: len(carry)]
        grown = [a or b for a, b in zip(carry, out, strict=True)]
        if grown == carry:
            return carry
        carry = grown


def _reach(jaxpr: Any, marked: Sequence[bool]) -> list[bool]:
    """Which results the marked inputs can reach, through any branch and any number of iterations."""
    env = dict(zip(jaxpr.invars, marked, strict=True))

    def read(atom: Any) -> bool:
        return not isinstance(atom, core.Literal) and env.get(atom, False)

    for eqn in jaxpr.eqns:
        ins = [read(atom) for atom in eqn.invars]
        if not any(ins) or eqn.primitive.name in _ENDING:
            continue
        kind, params = eqn.primitive.name, eqn.params
        called = _called(params)
        if kind == "while":
            first, second = params["cond_nconsts"], params["body_nconsts"]
            before, carry = ins[first : first + second], ins[first + second :]
            outs = _loop_carry(params["body_jaxpr"].jaxpr, before, carry, [])
        elif kind == "scan":
            body, fixed, count = params["jaxpr"].jaxpr, params["num_consts"], params["num_carry"]
            before, carry, after = ins[:fixed], ins[fixed : fixed + count], ins[fixed + count :]
            carry = _loop_carry(body, before, carry, after)
            outs = carry + _reach(body, before + carry + after)[count:]
        elif kind == "cond":
            branches = [_reach(branch.jaxpr, ins[1:]) for branch in params["branches"]]
            outs = [any(one) for one in zip(*branches, strict=True)]
        elif called is not None:
            outs = _reach(called[0], ins)
        else:
            outs = [True] * len(eqn.outvars)
        env.update((var, out and _carries(var)) for var, out in zip(eqn.outvars, outs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _follow(jaxpr: Any, consts: Any, values: Sequence[Any], marks: Sequence[Any]) -> tuple[list, list]:
    """Run a program and carry a mark (bool, the value's shape; None for never) along with each value."""
    env: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    env.update(zip(jaxpr.invars, values, strict=True))
    on = {var: mark for var, mark in zip(jaxpr.invars, marks, strict=True) if mark is not None}

    def read(atom: Any) -> tuple[Any, Any]:
        return (atom.val, None) if isinstance(atom, core.Literal) else (env[atom], on.get(atom))

    for eqn in jaxpr.eqns:
        pairs = [read(atom) for atom in eqn.invars]
        vals, ins = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        if all(mark is None for mark in ins) or eqn.primitive.name in _ENDING:
            env.update(zip(eqn.outvars, _bind(eqn, vals), strict=True))
            continue
        outs, new = _step(eqn, vals, ins)
        env.update(zip(eqn.outvars, outs, strict=True))
        marked = [pair for pair in zip(eqn.outvars, new, strict=True) if pair[1] is not None]
        on.update((var, mark) for var, mark in marked if _carries(var))
    ends = [read(atom) for atom in jaxpr.outvars]
    return [end[0] for end in ends], [end[1] for end in ends]


def _bind(eqn: Any, vals: Sequence[Any]) -> list:
    outs = eqn.primitive.bind(*vals, **eqn.primitive.get_bind_params(eqn.params))
    return list(outs) if eqn.primitive.multiple_results else [outs]


def _step(eqn: Any, vals: list[Any], marks: list[Any]) -> tuple[list, list]:
    """One marked equation: its values and their marks."""
    kind, params = eqn.primitive.name, eqn.params
    called = _called(params)
    if kind == "while":
        return _follow_while(params, vals, marks)
    if kind == "scan":
        return _follow_scan(params, vals, marks)
    if kind == "cond":
        return _follow_cond(params, vals, marks)
    if called is not None:
        return _follow(*called, vals, marks)
    outs = _bind(eqn, vals)
    shapes = [np.shape(out) for out in outs]
    some = [mark for mark in marks if mark is not None]
    if kind == "select_n":
        full = [_or([mark], np.shape(val)) for mark, val in zip(marks[1:], vals[1:], strict=True)]
        return outs, [jax.lax.select_n(vals[0], *full)]
    if kind in _ELEMENTWISE:
        return outs, [_or(some, shapes[0])]
    if kind in _MOVING:
        # offsets of a dynamic slice stay what they are, data becomes its mark
        data = len(vals) if kind == "concatenate" else 1
        full = [_or([mark], np.shape(val)) for mark, val in zip(marks[:data], vals[:data], strict=True)]
        return outs, [eqn.primitive.bind(*full, *vals[data:], **params)]
    if kind in _REDUCING:
        return outs, [jnp.any(some[0], axis=params["axes"])]
    # not known by element: any mark marks all
    every = jnp.any(jnp.stack([jnp.any(mark) for mark in some]))
    return outs, [jnp.broadcast_to(every, shape) for shape in shapes]


def _or(marks: Sequence[Any], shape: tuple[int, ...]) -> jax.Array:
    total = jnp.zeros(shape, bool)
    for mark in marks:
        if mark is not None:
            total = total | mark
    return total


def _give(marks: Sequence[Any], wanted: Sequence[bool], values: Sequence[Any]) -> list[jax.Array]:
    """The marks of the values that can be marked, as arrays."""
    chosen = zip(marks, wanted, values, strict=True)
    return [_or([mark], np.shape(value)) for mark, want, value in chosen if want]


def _take(flat: Sequence[Any], wanted: Sequence[bool]) -> list[Any]:
    given = iter(flat)
    return [next(given) if want else None for want in wanted]


def _follow_while(params: Any, vals: list[Any], marks: list[Any]) -> tuple[list, list]:
    first, second = params["cond_nconsts"], params["body_nconsts"]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    fixed, fixed_marks = vals[first : first + second], marks[first : first + second]
    start, start_marks = vals[first + second :], marks[first + second :]
    may = _loop_carry(
        body.jaxpr, [m is not None for m in fixed_marks], [m is not None for m in start_marks], []
    )

    def more(carry: tuple[list, list]) -> jax.Array:
        return core.jaxpr_as_fun(test)(*vals[:first], *carry[0])[0]

    def once(carry: tuple[list, list]) -> tuple[list, list]:
        inside = _take(carry[1], may)
        out, new = _follow(body.jaxpr, body.consts, fixed + carry[0], fixed_marks + inside)
        return out, _give(new, may, out)

    out, flat = jax.lax.while_loop(more, once, (start, _give(start_marks, may, start)))
    return out, _take(flat, may)


def _follow_scan(params: Any, vals: list[Any], marks: list[Any]) -> tuple[list, list]:
    body, fixed, count = params["jaxpr"], params["num_consts"], params["num_carry"]
    can = [mark is not None for mark in marks]
    may = _loop_carry(body.jaxpr, can[:fixed], can[fixed : fixed + count], can[fixed + count :])
    each = _reach(body.jaxpr, can[:fixed] + may + can[fixed + count :])[count:]
    xs, xs_can = vals[fixed + count :], can[fixed + count :]

    def once(carry: tuple[list, list], row: tuple[list, list]) -> tuple[tuple[list, list], tuple[list, list]]:
        inside = marks[:fixed] + _take(carry[1], may) + _take(row[1], xs_can)
        out, new = _follow(body.jaxpr, body.consts, vals[:fixed] + carry[0] + row[0], inside)
        return (
            (out[:count], _give(new[:count], may, out[:count])),
            (out[count:], _give(new[count:], each, out[count:])),
        )

    carried = vals[fixed : fixed + count]
    start = (carried, _give(marks[fixed : fixed + count], may, carried))
    rows = (xs, _give(marks[fixed + count :], xs_can, xs))
    (out, flat), (ys, stacked) = jax.lax.scan(
        once, start, rows, length=params["length"], reverse=params["reverse"]
    )
    return out + ys, _take(flat, may) + _take(stacked, each)


def _follow_cond(params: Any, vals: list[Any], marks: list[Any]) -> tuple[list, list]:
    branches, can = params["branches"], [mark is not None for mark in marks[1:]]
    reached = [_reach(branch.jaxpr, can) for branch in branches]
    may = [any(one) for one in zip(*reached, strict=True)]

    def way(branch: Any) -> Callable[..., tuple[list, list]]:
        def run(*operands: Any) -> tuple[list, list]:
            out, new = _follow(branch.jaxpr, branch.consts, operands, marks[1:])
            return out, _give(new, may, out)

        return run

    out, flat = jax.lax.switch(vals[0], [way(branch) for branch in branches], *vals[1:])
    return out, _take(flat, may)
