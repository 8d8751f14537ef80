"""Sums over the neighbors of every atom. XLA calls one compiled loop on a CPU.

jax traces a function of one pair. The operations are written as LLVM text for vectors of eight atoms. The
data of each atom are contiguous in memory. Loading a neighbor thus takes one or two instructions. The terms
of eight neighbor slots are summed in registers. XLA's own loop gathers neighbor data and computes terms in
separate passes. No operation is contracted or reordered. Equal input thus gives equal output on every
processor. XLA calls the loop through its foreign-function interface (xla/ffi/api/c_api.h, version 0.3).
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cache
from itertools import count
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, UInt8
from numba import types

from mdnum.compiled import cfunc, njit
from mdnum.md.decide import Decisions, Tables
from mdnum.md.foreign import (
    ALIVE,
    added,
    asked_to_run,
    buffer,
    call,
    carray,
    free,
    malloc,
    peek,
    pointer,
    poke,
    registered,
)
from mdnum.numerics import elementary
from mdnum.numerics.exact import bound, inlined, interpreted

# atoms of a block, which is what a thread takes at a time; full vectors
_BLOCK = 2048
# atoms of a vector; a processor with shorter ones takes several
_WIDE = 8
# neighbors ahead in a row of the table that are asked for before they are needed: several rows are read at a
# time, in pieces, which the processor does not foresee (9 % less time at 108,000 atoms, 5 at 32,000)
_AHEAD = 128
# a loop is made once, whichever thread asks
_ONE = Lock()
# by the structure of a potential, which has its function, the operation that kept it out of the loop
_LEFT_OUT: dict[Any, str] = {}
_LOGGER = logging.getLogger(__name__)


class PairSums(NamedTuple):
    """Results of a loop over all pairs of a neighbor list."""

    # of each term over the slots of each atom, first slot first, shape (terms, atoms)
    sums: Float[Array, "terms atoms"]
    # of each further term over all slots, shape (totals,)
    totals: Float[Array, "totals"]
    # None where no margin is asked for. Their nearest margin is that of a listed pair, and inf where there is
    # none.
    decisions: Decisions | None


_Pair = Callable[..., Sequence[Any]]


class Shortcut(NamedTuple):
    """A faster version of a pair function for close atoms (see `far`)."""

    # whether a pair is far, from the arguments of a function of a pair
    far: Callable[..., Any]
    # terms of a pair that is not far, equal to those of the other function but without totals, and its margin
    pair: _Pair


def over_pairs(
    pair: _Pair,
    columns: Float[Array, "columns atoms"],
    tables: Tables,
    *,
    flags: Sequence[UInt8[Array, "words atoms"]] = (),
    margins: str | None = None,
    inverses: bool = False,
    potential: Any = None,
    near: Shortcut | None = None,
    totals: int = 0,
) -> PairSums | None:
    """Sum a pair function over the neighbors of every atom. This function works inside jit and on a CPU.

    Args:
        pair: a function of scalars: the columns of the atom, those of its neighbor, the pair type (None if
            there is only one), and the bit of each flag. It returns the terms to add and, with `margins`, the
            margin. It may close over numbers, and over arrays with one entry per type. In padding slots, for
            which it need not be called, the columns of the neighbor are NaN and the terms must be 0.
        columns: float64 numbers of each atom, in the order of the tables.
        tables: the list.
        flags: bits of every slot, packed like decisions.
        margins: ">" or ">=": comparison of the margin with 0 that holds for pairs inside.
        inverses: whether several quotients by powers of one number are replaced by products with its inverse,
            because divisions are slow.
        potential: name under which an unsupported operation is reported (`left_out`).
        near: a cheaper function that replaces `pair` for vectors without a far pair.
        totals: number of terms that are summed over all slots of all atoms; `pair` returns them after the
            others.

    Returns:
        None if the function has an operation without a vector form.

    Error: one rounding error per operation (with `inverses` one more for each power of the inverse), and the
    bounds of `numerics.elementary` for elementary functions; sums are sequential.
    """
    atoms, words = columns.shape[1], tables.index.shape[0]
    try:
        written = _written(
            pair, near, columns.shape[0], len(flags), margins, tables.types is not None, inverses, totals
        )
    except _NotKnown as unknown:
        if potential is not None and left_out(potential) != str(unknown):
            text = "%s goes through XLA's loop, in twice the time: the compiled one has no counterpart of %s"
            _LOGGER.warning(text, potential.name, unknown)
            _LEFT_OUT[jax.tree.structure(potential)] = str(unknown)
        return None
    shapes = [
        jax.ShapeDtypeStruct((written.terms, atoms), np.float64),
        jax.ShapeDtypeStruct((words if margins else 0, atoms), np.uint8),
        jax.ShapeDtypeStruct((1,), np.float64),
        jax.ShapeDtypeStruct((totals, _WIDE * -(-atoms // _BLOCK)), np.float64),
    ]
    with _ONE:
        name = _registered(written.loop)
    call = jax.ffi.ffi_call(name, shapes, vmap_method="sequential")
    index = tables.index.astype(jnp.int32).reshape(-1, atoms)
    bits = jnp.stack(tuple(flags)) if flags else jnp.zeros((0, words, atoms), jnp.uint8)
    kinds = jnp.zeros((0, 1), jnp.uint8) if tables.types is None else tables.types.reshape(-1, atoms)
    sums, decided, nearest, whole = call(index, columns, bits, written.constants, kinds)
    return PairSums(sums, whole.sum(axis=1), Decisions(decided, nearest[0]) if margins else None)


def left_out(potential: Any) -> str | None:
    """Return jax's name of an operation that the compiled loop does not support, or None."""
    return _LEFT_OUT.get(jax.tree.structure(potential))


# --- the function of a pair, written down ----------------------------------------------------------------


class _NotKnown(Exception):
    """Error for a jax operation without LLVM counterpart. The message is the operation's name."""


class _Value(NamedTuple):
    """Name of an LLVM vector whose values differ between pairs of atoms."""

    name: str
    kind: str = "VEC"


class _Written(NamedTuple):
    """Source of a compiled loop, and its numerical arguments."""

    loop: str
    constants: Array
    terms: int


# VEC, BOOL, BYTE and LONG are vectors of WIDE numbers, decisions, bytes and words of 64 bits: kinds by jax's
# dtype, and what LLVM calls operations on two operands of a kind, and functions of a number
_KINDS = {"float64": "VEC", "bool": "BOOL", "int64": "LONG"}
_OPERATIONS = {
    "VEC": {
        "add": "fadd", "add_any": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "eq": "fcmp oeq",
        "ne": "fcmp une", "gt": "fcmp ogt", "ge": "fcmp oge", "lt": "fcmp olt", "le": "fcmp ole",
    },
    "BOOL": {"and": "and", "or": "or", "xor": "xor", "ne": "xor", "eq": "icmp eq"},
    # of the bits of numbers, in elementary functions
    "LONG": {"add": "add", "and": "and", "or": "or", "shift_left": "shl", "shift_right_logical": "lshr"},
}  # fmt: skip
_INTRINSICS = {
    "abs": "fabs", "sqrt": "sqrt", "rsqrt": "sqrt", "round": "rint", "floor": "floor", "ceil": "ceil"
}  # fmt: skip
# further ones, by the kind of the last operand
_LINES = {
    ("neg", "VEC"): "fneg VEC {}",
    ("not", "BOOL"): "xor BOOL {}, ALL[i1 true]",
    ("bitcast_convert_type", "VEC"): "bitcast VEC {} to LONG",
    ("bitcast_convert_type", "LONG"): "bitcast LONG {} to VEC",
    ("convert_element_type", "BOOL"): "uitofp BOOL {} to VEC",
    **{("select_n", kind): f"select BOOL {{0}}, {kind} {{2}}, {kind} {{1}}" for kind in _OPERATIONS},
    **{
        (name, kind): f"{line} {kind} {{}}, {{}}"
        for kind in _OPERATIONS
        for name, line in _OPERATIONS[kind].items()
    },
    **{(name, "VEC"): f"call VEC @llvm.{of}.vWIDEf64(VEC {{}})" for name, of in _INTRINSICS.items()},
}
_COMPARISONS = {">": "ogt", ">=": "oge"}
#: Operations that do not change an array with one element.
_SHAPES = ("broadcast_in_dim", "reshape", "squeeze", "copy", "stop_gradient")


def _number(value: Any, kind: str = "VEC") -> str:
    """Return LLVM text of a constant vector in which all elements are equal."""
    if kind != "VEC":
        return f"ALL[{'i1' if kind == 'BOOL' else 'i64'} {int(value)}]"
    return f"ALL[double 0x{struct.unpack('>Q', struct.pack('>d', float(value)))[0]:016X}]"


def _whole_power(equation: Any, inputs: list[Any]) -> int:
    """Return the exponent of a power that is computed by products; 0 for other operations."""
    name, y = equation.primitive.name, inputs[-1]
    if name in ("square", "integer_pow"):
        return equation.params.get("y", 2)
    if name != "pow" or isinstance(y, _Value | Tracer | jax.Array):
        return 0
    return int(y) if float(y) in range(-64, 65) else 0


def _written(
    pair: _Pair,
    near: Shortcut | None,
    columns: int,
    flags: int,
    margins: str | None,
    types: bool,
    inverses: bool,
    totals: int,
) -> _Written:
    """Return the source of an LLVM function `word` that processes eight neighbor slots.

    `word` takes the number of atoms, the constants, the stride between slots (in atoms), and an address for
    each array. The arrays are: the columns of the atoms; flags, sums and totals; decisions, types and
    neighbors of the first slot; the smallest |margin| so far; the table of atom data.
    """
    number, truth = jax.ShapeDtypeStruct((), np.float64), jax.ShapeDtypeStruct((), np.bool_)
    kind = jax.ShapeDtypeStruct((), np.uint8) if types else None
    functions = [pair] if near is None else [pair, near.pair, near.far]
    arguments = [number] * columns, [number] * columns, kind, *[truth] * flags
    program, *others = (jax.make_jaxpr(one)(*arguments) for one in functions)
    terms = len(program.out_avals) - bool(margins) - totals
    rows = columns + flags + terms + totals + 5
    constants: dict[int, Any] = {}
    lines: list[str] = []
    names = count()
    # by what a line computes: its result. Of products of one number: that, and how often. Quotients: their
    # line, dividend and divisor
    made: dict[str, _Value] = {}
    powers: dict[str, tuple[str, int]] = {}
    quotients: list[tuple[int, str, str]] = []

    def text(value: Any, kind: str = "VEC") -> str:
        if isinstance(value, _Value):
            if value.kind != kind:
                raise TypeError(
                    "an operation of the potential mixes numbers with booleans in a way that cannot be "
                    "compiled"
                )
            return value.name
        known = not isinstance(value, Tracer | jax.Array)
        if np.size(value) != 1 or kind not in ("VEC", "BOOL", "LONG" if known else ""):
            raise TypeError("a constant of the potential is not a single number of a supported type")
        if known:
            return _number(value, kind)
        constants.setdefault(id(value), value)
        name = f"%c{list(constants).index(id(value))}.WIDE"
        return name if kind == "VEC" else put(f"fcmp une VEC {name}, {_number(0)}", kind).name

    def put(line: str, kind: str = "VEC") -> _Value:
        if line not in made:
            made[line] = _Value(f"%v{next(names)}.WIDE", kind)
            lines.append(f"{made[line].name} = {line}")
        return made[line]

    def product(a: str, b: str) -> _Value:
        value, (base, m), (other, n) = put(f"fmul VEC {a}, {b}"), powers.get(a, (a, 1)), powers.get(b, (b, 1))
        if base == other:
            powers[value.name] = base, m + n
        return value

    def quotient(a: str, b: str) -> _Value:
        before, value = len(lines), put(f"fdiv VEC {a}, {b}")
        if len(lines) > before and b.startswith("%v"):
            quotients.append((before, a, b))
        return value

    def load(row: int, kind: str, single: str, at: str = "%k.WIDE") -> _Value:
        return put(f"load {kind}, ptr {put(f'getelementptr {single}, ptr %r{row}, i64 {at}').name}, align 1")

    def rule(equation: Any, inputs: list[Any]) -> Sequence[Any]:
        try:
            return operation(equation, inputs)
        except TypeError as error:
            raise _NotKnown(equation.primitive.name) from error

    def operation(equation: Any, inputs: list[Any]) -> Sequence[Any]:
        name, result = equation.primitive.name, equation.outvars[0].aval
        if (inner := inlined(equation)) is not None:
            return interpreted(inner, inputs, rule)
        if not any(isinstance(value, _Value) for value in inputs):
            # the same for all pairs: made once, outside; what is known now, such as a zero, is written down
            known = not any(isinstance(value, Tracer | jax.Array) for value in inputs)
            with jax.ensure_compile_time_eval() if known else nullcontext():
                outside = bound(equation, inputs)
            return [np.asarray(value) for value in outside] if known else outside
        if name == "dynamic_slice" and np.ndim(inputs[0]) == 1 and equation.params["slice_sizes"] == (1,):
            # the constant of the pair's type
            of, which = inputs[0], text(inputs[1])
            chosen = text(of[0])
            for k in range(1, len(of)):
                other = put(f"fcmp oeq VEC {which}, {_number(k)}", "BOOL").name
                chosen = put(f"select BOOL {other}, VEC {text(of[k])}, VEC {chosen}").name
            return [_Value(chosen)]
        if power := _whole_power(equation, inputs):
            # by squaring, from the lowest bit, as XLA does
            left, base, whole = abs(power), text(inputs[0]), ""
            while left:
                if left & 1:
                    whole = product(whole, base).name if whole else base
                left >>= 1
                base = product(base, base).name if left else base
            return [quotient(_number(1), whole) if power < 0 else _Value(whole)]
        kind = _KINDS.get(str(result.dtype), "")
        dtypes = [atom.aval.dtype for atom in equation.invars]
        if name in _SHAPES or (name == "convert_element_type" and dtypes == [result.dtype]):
            return [inputs[0]]
        # a pair's type is a number here
        own = [value.kind if isinstance(value, _Value) else "" for value in inputs]
        constant = {np.dtype(np.bool_): "BOOL", np.dtype(np.int64): "LONG" if "LONG" in own else "VEC"}
        given = [one or constant.get(dtype, "VEC") for one, dtype in zip(own, dtypes, strict=True)]
        if name in elementary.FUNCTIONS and "LONG" not in given:
            before, inner = len(quotients), elementary.program(name, *[()] * len(inputs))
            values = interpreted(inner, inputs, rule)
            # its quotients stay what they are, and so does its bound
            del quotients[before:]
            return values
        line = _LINES.get((name, given[-1]))
        unlike = {
            "round": equation.params.get("rounding_method") != 1,
            "convert_element_type": kind != "VEC",
            "select_n": given[0] != "BOOL",
        }
        if line is None or not kind or unlike.get(name):
            raise TypeError("the potential uses an operation that the compiled loop does not support")
        operands = list(map(text, inputs, given))
        if kind == "VEC" and name in ("mul", "div"):
            return [product(*operands) if name == "mul" else quotient(*operands)]
        value = put(line.format(*operands), kind)
        return [quotient(_number(1), value.name) if name == "rsqrt" else value]

    # once for eight slots: what is summed and kept, by kind of vector and of number, row, and start
    own = [load(row, "VEC", "double") for row in range(columns)]
    told = [load(columns + k, "BYTE", "i8").name for k in range(flags)]
    told = [put(f"zext BYTE {byte} to LONG").name for byte in told]
    summed = range(columns + flags, columns + flags + terms)
    kept = [("VEC", "double", row, load(row, "VEC", "double").name) for row in summed]
    if margins:
        kept.append(("VEC", "double", rows - 2, load(rows - 2, "VEC", "double").name))
        # a number of 64 bits for each atom, as its margin is one: the processor has a mask for both
        kept.append(("LONG", "i8", rows - 5, "zeroinitializer"))
    once, lines = lines, []

    # for each of them
    given = [*own, *(_Value(f"%other{k}.WIDE") for k in range(columns))]
    if types:
        given.append(put(f"uitofp BYTE {load(rows - 4, 'BYTE', 'i8', '%from.WIDE').name} to VEC"))
    bits = [put(f"and LONG {byte}, %bit.WIDE").name for byte in told]
    given += [put(f"icmp ne LONG {bit}, zeroinitializer", "BOOL") for bit in bits]
    if near is None:
        each = [*lines, "br label %far.WIDE"]
    else:
        far = text(interpreted(others[1], given, rule)[0], "BOOL")
        each = [*lines, f"%distant.WIDE = call i1 @llvm.vector.reduce.or.vWIDEi1(BOOL {far})"]
        each.append("br i1 %distant.WIDE, label %far.WIDE, label %near.WIDE")

    def body(program: Any, place: str, totals: int) -> list[str]:
        """Write the pair function as a block of LLVM text. Return the names of its sums."""
        nonlocal lines
        before, lines = dict(made), []
        quotients.clear()
        results = list(map(text, interpreted(program, given, rule)))
        if inverses:
            _divide_once(lines, quotients, powers, place)
        after = [put(f"fadd VEC %kept{k}.WIDE, {results[k]}").name for k in range(terms)]
        for k in range(terms, terms + totals):
            row = columns + flags + k
            whole = put(f"fadd VEC {load(row, 'VEC', 'double', '0').name}, {results[k]}").name
            lines.append(f"store VEC {whole}, ptr %r{row}, align 1")
        if margins:
            margin, nearest, byte = results[-1], f"%kept{terms}.WIDE", f"%kept{terms + 1}.WIDE"
            size = put(f"call VEC @llvm.fabs.vWIDEf64(VEC {margin})").name
            # a slot of padding has none
            nearer = put(f"fcmp olt VEC {size}, {nearest}").name
            after.append(put(f"select BOOL {nearer}, VEC {size}, VEC {nearest}").name)
            inside = put(f"fcmp {_COMPARISONS[margins]} VEC {margin}, {_number(0)}").name
            bit = put(f"select BOOL {inside}, LONG %bit.WIDE, LONG zeroinitializer").name
            after.append(put(f"or LONG {byte}, {bit}").name)
        each.extend([f"{place}.WIDE:", *lines, "br label %last.WIDE"])
        made.clear()
        made.update(before)
        return after

    after = {"far": body(program, "far", totals)}
    if near is not None:
        after["near"] = body(others[0], "near", 0)
    held, merged, ends = [], [], []
    for k, (kind, single, row, first) in enumerate(kept):
        ways = ", ".join(f"[{values[k]}, %{place}.WIDE]" for place, values in after.items())
        last = f"%then{k}.WIDE"
        merged.append(f"{last} = phi {kind} {ways}")
        held.append(f"%kept{k}.WIDE = phi {kind} [{first}, %some.WIDE], [{last}, %last.WIDE]")
        ends.append(f"%end{k}.WIDE = getelementptr {single}, ptr %r{row}, i64 %k.WIDE")
        if kind == "LONG":
            ends.append(f"%byte{k}.WIDE = trunc LONG {last} to BYTE")
            kind, last = "BYTE", f"%byte{k}.WIDE"
        ends.append(f"store {kind} {last}, ptr %end{k}.WIDE, align 1")

    starts = []
    for k in range(rows):
        starts += [f"%rp{k} = getelementptr ptr, ptr %r, i64 {k}", f"%r{k} = load ptr, ptr %rp{k}"]
    for k in range(len(constants)):
        starts += [f"%cp{k} = getelementptr double, ptr %c, i64 {k}", f"%c{k} = load double, ptr %cp{k}"]
        starts += [_of_width(_same("double", f"%c{k}", f"%c{k}.WIDE", "VEC"), wide) for wide in (_WIDE, 1)]
    starts += [f"%row{k} = mul i64 %atoms, {k}" for k in range(8)]
    starts.append("%padding = trunc i64 %atoms to i32")
    starts += [
        _of_width(_same("i32", "%padding", "%padding.WIDE", "<WIDE x i32>"), wide) for wide in (_WIDE, 1)
    ]
    loops = [
        _of_width(
            _LOOP.format(
                first=first,
                before=before,
                end=end,
                behind=behind,
                once="\n  ".join(once),
                held="\n  ".join(held),
                listed="\n  ".join(_listed(rows, bool(margins))),
                others="\n  ".join(_others(wide, columns, rows)),
                each="\n  ".join(each),
                merged="\n  ".join(merged),
                ends="\n  ".join(ends),
            ),
            wide,
        )
        for wide, first, before, end, behind in (
            (_WIDE, "0", "start", "%whole", "turn.1"),
            (1, "%whole", f"turn.{_WIDE}", "%n", "done"),
        )
    ]
    declared = [
        _of_width(f"declare VEC @llvm.{name}.vWIDEf64(VEC)", wide)
        for name in dict.fromkeys(_INTRINSICS.values())
        for wide in (_WIDE, 1)
    ]
    for wide in (_WIDE, 1):
        declared += [
            f"declare i1 @llvm.vector.reduce.or.v{wide}i1(<{wide} x i1>)",
            f"declare <{wide} x i32> @llvm.umin.v{wide}i32(<{wide} x i32>, <{wide} x i32>)",
        ]
    declared.append("declare void @llvm.prefetch.p0(ptr, i32, i32, i32)")
    source = _FUNCTION.format(
        starts="\n  ".join(starts), wide=_WIDE, loops="".join(loops), known="\n".join(declared)
    )
    known = [jnp.asarray(value, jnp.float64).reshape(()) for value in constants.values()]
    return _Written(source, jnp.stack(known) if known else jnp.zeros(0), terms)


def _divide_once(
    lines: list[str],
    quotients: Sequence[tuple[int, str, str]],
    powers: dict[str, tuple[str, int]],
    block: str,
) -> None:
    """Replace each division by a power of a number with multiplications by the inverse.

    Args:
        block: name of the block to which the lines belong; names of inverse powers contain it.
    """
    divisors = [powers.get(divisor, (divisor, 1)) for _, _, divisor in quotients]
    uses, known = Counter(base for base, _ in divisors), dict.fromkeys((base for base, _ in divisors), 0)
    for (place, dividend, _), (base, n) in zip(quotients, divisors, strict=True):
        if uses[base] < 2:
            continue
        before = []
        for k in range(known[base] + 1, n + 1):
            line = f"fmul VEC {base}.{block}{k // 2}, {base}.{block}{k - k // 2}"
            before.append(f"{base}.{block}{k} = " + (line if k > 1 else f"fdiv VEC {_number(1)}, {base}"))
        known[base] = max(known[base], n)
        name = lines[place].split(" = ")[0]
        lines[place] = "\n  ".join([*before, f"{name} = fmul VEC {dividend}, {base}.{block}{n}"])


def _same(single: str, value: str, name: str, kind: str) -> str:
    """Return LLVM text of a vector with the same value in every lane."""
    return (
        f"{name}.first = insertelement {kind} poison, {single} {value}, i64 0\n  "
        f"{name} = shufflevector {kind} {name}.first, {kind} poison, <WIDE x i32> zeroinitializer"
    )


def _of_width(text: str, wide: int) -> str:
    """Adapt lines of LLVM text to vectors of the given number of atoms."""
    text = re.sub(r"ALL\[(.+?)\]", lambda one: "<" + ", ".join([one[1]] * wide) + ">", text)
    kinds = {"VEC": "double", "BOOL": "i1", "BYTE": "i8", "LONG": "i64"}
    for name, kind in kinds.items():
        text = text.replace(name, f"<{wide} x {kind}>")
    return text.replace("WIDE", str(wide))


def _listed(rows: int, margins: bool) -> list[str]:
    """Write code that tests which of eight neighbor slots are in use, and clears all eight decisions."""
    lines = []
    for k in range(8):
        lines += [
            f"%at{k}.WIDE = add i64 %k.WIDE, %row{k}",
            f"%first{k}.WIDE = getelementptr i32, ptr %r{rows - 3}, i64 %at{k}.WIDE",
            f"%there{k}.WIDE = load <WIDE x i32>, ptr %first{k}.WIDE, align 1",
        ]
    # padding has the greatest number
    least = "%there0.WIDE"
    for k in range(1, 8):
        both = f"<WIDE x i32> {least}, <WIDE x i32> %there{k}.WIDE"
        lines.append(f"%least{k}.WIDE = call <WIDE x i32> @llvm.umin.vWIDEi32({both})")
        least = f"%least{k}.WIDE"
    lines += [
        f"%real.WIDE = icmp ne <WIDE x i32> {least}, %padding.WIDE",
        "%any.WIDE = call i1 @llvm.vector.reduce.or.vWIDEi1(BOOL %real.WIDE)",
    ]
    if margins:
        lines.append(f"%none.WIDE = getelementptr i8, ptr %r{rows - 5}, i64 %k.WIDE")
        lines.append("store BYTE zeroinitializer, ptr %none.WIDE, align 1")
    return lines


def _others(wide: int, columns: int, rows: int) -> list[str]:
    """Write LLVM code that loads the data of a slot's neighbors, four numbers at a time."""
    parts = -(-columns // 4)
    lines = [
        f"%at.WIDE = getelementptr i32, ptr %r{rows - 3}, i64 %from.WIDE",
        "%index.WIDE = load <WIDE x i32>, ptr %at.WIDE, align 1",
        f"%ahead.WIDE = getelementptr i32, ptr %at.WIDE, i64 {_AHEAD}",
        # to be read, into the second cache, data
        "call void @llvm.prefetch.p0(ptr %ahead.WIDE, i32 0, i32 2, i32 1)",
    ]

    def shuffled(name: str, size: int, a: str, b: str, chosen: Sequence[int]) -> str:
        which = ", ".join(f"i32 {k}" for k in chosen)
        kind = f"<{size} x double>"
        lines.append(f"%{name}.WIDE = shufflevector {kind} {a}, {kind} {b}, <{len(chosen)} x i32> <{which}>")
        return f"%{name}.WIDE"

    for k in range(wide):
        lines += [
            f"%j{k}.WIDE = extractelement <WIDE x i32> %index.WIDE, i64 {k}",
            f"%far{k}.WIDE = zext i32 %j{k}.WIDE to i64",
            f"%atom{k}.WIDE = getelementptr [{4 * parts} x double], ptr %r{rows - 1}, i64 %far{k}.WIDE",
        ]
    for part in range(parts):
        for k in range(wide):
            at = f"%of{part}_{k}.WIDE"
            lines.append(f"{at}p = getelementptr double, ptr %atom{k}.WIDE, i64 {4 * part}")
            lines.append(f"{at} = load <4 x double>, ptr {at}p, align 32")
        loaded = [f"%of{part}_{k}.WIDE" for k in range(wide)]
        here = range(4 * part, min(columns, 4 * part + 4))
        if wide == 1:
            for row in here:
                shuffled(f"other{row}", 4, loaded[0], "poison", [row - 4 * part])
            continue
        # x y z w of two atoms; x x z z and y y w w of two and two; then of all eight. Paired so that whole
        # quarters are moved in the end, which needs no register to say where
        two_by_two = enumerate(((0, 2), (1, 3), (4, 6), (5, 7)))
        pair = [shuffled(f"pair{part}_{k}", 4, loaded[a], loaded[b], range(8)) for k, (a, b) in two_by_two]
        for odd in range(min(2, len(here))):
            two = [odd + k for k in (0, 8, 2, 10, 4, 12, 6, 14)]
            low = shuffled(f"low{part}_{odd}", 8, pair[0], pair[1], two)
            high = shuffled(f"high{part}_{odd}", 8, pair[2], pair[3], two)
            for row in range(4 * part + odd, here.stop, 2):
                shift = row - 4 * part - odd
                shuffled(f"other{row}", 8, low, high, [shift + k for k in (0, 1, 4, 5, 8, 9, 12, 13)])
    return lines


_FUNCTION = """
define i64 @word(i64 %n, ptr %c, ptr %r, i64 %atoms) #0 {{
start:
  {starts}
  %whole = and i64 %n, -{wide}
  br label %turn.{wide}
{loops}
done:
  ret i64 0
}}
{known}
attributes #0 = {{ "prefer-vector-width"="512" }}
"""
_LOOP = """
turn.WIDE:
  %k.WIDE = phi i64 [{first}, %{before}], [%next.WIDE, %behind.WIDE]
  %more.WIDE = icmp slt i64 %k.WIDE, {end}
  br i1 %more.WIDE, label %begin.WIDE, label %{behind}
begin.WIDE:
  {listed}
  br i1 %any.WIDE, label %some.WIDE, label %behind.WIDE
some.WIDE:
  {once}
  br label %slot.WIDE
slot.WIDE:
  %slot.WIDE.k = phi i64 [0, %some.WIDE], [%later.WIDE, %last.WIDE]
  %bit.WIDE = phi LONG [ALL[i64 1], %some.WIDE], [%nextbit.WIDE, %last.WIDE]
  {held}
  %nextbit.WIDE = add LONG %bit.WIDE, %bit.WIDE
  %row.WIDE = mul i64 %slot.WIDE.k, %atoms
  %from.WIDE = add i64 %row.WIDE, %k.WIDE
  {others}
  {each}
last.WIDE:
  {merged}
  %later.WIDE = add nuw nsw i64 %slot.WIDE.k, 1
  %again.WIDE = icmp ult i64 %later.WIDE, 8
  br i1 %again.WIDE, label %slot.WIDE, label %end.WIDE
end.WIDE:
  {ends}
  br label %behind.WIDE
behind.WIDE:
  %next.WIDE = add nuw nsw i64 %k.WIDE, WIDE
  br label %turn.WIDE
"""
# what XLA calls: the loop over the list, which calls the one above
_CALLED = """
define i64 @called(i64 %frame) {{
  %loop = inttoptr i64 {loop} to ptr
  %word = ptrtoint ptr @word to i64
  %done = call i64 %loop(i64 %frame, i64 %word, i64 {task})
  ret i64 %done
}}
"""


@cache
def _registered(source: str, cpu: str = "") -> str:
    """Compile and register a loop for a processor (default: this one). Return its name in XLA."""
    name = f"mdnum_pairs_{cpu}{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    features = "" if cpu else llvm.get_host_cpu_features().flatten()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu or llvm.get_host_cpu_name(), features=features, opt=3
    )
    loop, task = _driver()
    module = llvm.parse_assembly(source + _CALLED.format(loop=loop, task=task))
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(module, builder)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(engine.get_function_address("called"))
    return registered(name, function, engine)


# --- the loop over a list, which calls the other ----------------------------------------------------------


# Loops over n numbers at given addresses: each a function of its own, so that it becomes one of vectors.


@njit
def _filled(out_at, n, value):
    out = carray(pointer(out_at), (n,), np.float64)
    for k in range(n):
        out[k] = value


@njit
def _interleaved(columns_at, columns, atoms, table_at, apart):
    """Write the data of all atoms to a table, atom by atom. Padding becomes a row of NaN."""
    of = carray(pointer(columns_at), (columns * atoms,), np.float64)
    table = carray(pointer(table_at), ((atoms + 1) * apart,), np.float64)
    for k in range(atoms):
        for row in range(columns):
            table[k * apart + row] = of[row * atoms + k]
    for row in range(apart):
        table[atoms * apart + row] = np.nan


@njit
def _least(values_at, n, out_at):
    values = carray(pointer(values_at), (n,), np.float64)
    least = np.inf
    for k in range(n):
        least = min(least, values[k])
    carray(pointer(out_at), (1,), np.float64)[0] = least


# A call is a job: 64-bit words that outlive it, since a thread may look for work when none is left. How many
# use it, the next block, blocks done and blocks; addresses of frame, loop over a word of slots, and table;
# threads that there are, and arguments to XLA; then the nearest margin of each block, and the table.
_USERS, _NEXT, _DONE, _BLOCKS, _FRAME, _WORD, _TABLE, _THREADS, _ASKED, _NEAREST = (*range(9), 16)


@njit
def _work(job):
    """Process the blocks of atoms that no other thread has taken, until none is left."""
    block, blocks = added(job + 8 * _NEXT, 1), peek(job, _BLOCKS)
    if block >= blocks:
        return
    frame = peek(job, _FRAME)
    operands, results = peek(frame, 9), peek(frame, 14)
    index, slots, atoms = buffer(operands, 0)
    own, columns, _ = buffer(operands, 1)
    told, flags, _ = buffer(operands, 2)
    constants, _, _ = buffer(operands, 3)
    types_of, _, _ = buffer(operands, 4)
    sums, terms, _ = buffer(results, 0)
    bits, _, _ = buffer(results, 1)
    whole, totals, _ = buffer(results, 3)

    # where the rows begin that the loop over a word is given, and the nearest margins
    named = columns + flags + terms + totals + 5
    room = malloc(8 * (named + _BLOCK))
    rows = carray(pointer(room), (named,), np.int64)
    closest = room + 8 * named
    rows[named - 2], rows[named - 1] = closest, peek(job, _TABLE)
    while block < blocks:
        start = block * _BLOCK
        n = min(_BLOCK, atoms - start)
        for row in range(columns):
            rows[row] = own + 8 * (row * atoms + start)
        for row in range(terms):
            rows[columns + flags + row] = sums + 8 * (row * atoms + start)
            _filled(sums + 8 * (row * atoms + start), n, 0.0)
        for row in range(totals):
            rows[columns + flags + terms + row] = whole + 8 * _WIDE * (row * blocks + block)
            _filled(whole + 8 * _WIDE * (row * blocks + block), _WIDE, 0.0)
        _filled(closest, n, np.inf)
        for word in range(slots // 8):
            for flag in range(flags):
                rows[columns + flag] = told + (flag * (slots // 8) + word) * atoms + start
            rows[named - 5] = bits + word * atoms + start
            rows[named - 4] = types_of + 8 * word * atoms + start
            rows[named - 3] = index + 4 * (8 * word * atoms + start)
            call(peek(job, _WORD), (n, constants, room, atoms))
        _least(closest, n, job + 8 * (_NEAREST + block))
        added(job + 8 * _DONE, 1)
        block = added(job + 8 * _NEXT, 1)
    free(room)


@njit
def _leave(job):
    """Release a job. The last thread that uses the job frees its memory."""
    if added(job + 8 * _USERS, -1) == 1:
        free(job)


def _help(job):
    """Task of a helper thread: process blocks of a job, then release the job."""
    _work(job)
    _leave(job)
    return 0


@njit
def _helped(job, frame, helpers, task):
    """Schedule helper threads of XLA. Without helpers, the calling thread does all the work."""
    api, asked = peek(frame, 2), job + 8 * _ASKED
    schedule, ask = peek(api, 17), peek(api, 18)
    poke(asked, 0, 32)
    poke(asked, 1, 0)
    poke(asked, 2, peek(frame, 3))
    poke(asked, 3, job + 8 * _THREADS)
    if call(ask, (asked,)) != 0:
        return
    poke(asked, 0, 40)
    poke(asked, 3, task)
    poke(asked, 4, job)
    for _ in range(min(helpers, peek(job, _THREADS) - 1)):
        added(job + 8 * _USERS, 1)
        if call(schedule, (asked,)) != 0:
            added(job + 8 * _USERS, -1)
            return


def _over_blocks(frame, word, task):
    """Process all blocks of atoms for `over_pairs` in a call from XLA. Return 0 (no error).

    Args:
        frame: address of XLA's call frame. word, task: addresses of the loop over a word, and of `_help`.
    """
    if not asked_to_run(frame):
        return 0
    own, columns, atoms = buffer(peek(frame, 9), 1)
    nearest, _, _ = buffer(peek(frame, 14), 2)
    blocks = -(-atoms // _BLOCK)
    apart = 4 * -(-columns // 4)
    job = malloc(8 * (_NEAREST + blocks + (atoms + 1) * apart) + 64)
    # whole lines of the cache
    table = (job + 8 * (_NEAREST + blocks) + 63) // 64 * 64
    poke(job, _USERS, 1)
    poke(job, _NEXT, 0)
    poke(job, _DONE, 0)
    poke(job, _BLOCKS, blocks)
    poke(job, _FRAME, frame)
    poke(job, _WORD, word)
    poke(job, _TABLE, table)
    _interleaved(own, columns, atoms, table, apart)
    if blocks > 1:
        _helped(job, frame, blocks - 1, task)
    _work(job)
    while added(job + 8 * _DONE, 0) < blocks:
        pass
    _least(job + 8 * _NEAREST, blocks, nearest)
    _leave(job)
    return 0


@cache
def _driver() -> tuple[int, int]:
    """Return the addresses of `_over_blocks` and of `_help`, compiled once per installation."""
    made = [
        cfunc(types.intp(*[types.intp] * count), function)
        for function, count in ((_over_blocks, 3), (_help, 1))
    ]
    ALIVE.extend(made)
    loop, task = (int(one.address or 0) for one in made)
    return loop, task
