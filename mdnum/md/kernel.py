"""Sums over the neighbors of every atom in one compiled loop, for CPUs: what XLA calls instead of its own.

A function of one pair is traced by jax and its operations are written down again as a loop of LLVM's
language. The neighbors of a block of atoms are copied side by side, slot after slot, and then each operation
is one of vectors over the block; XLA's loop over the same list gathers and computes in passes of their own
and takes about twice the time. Nothing is contracted or reordered: of the same numbers the sums have the
same bits on every processor. XLA reaches the loop through its foreign-function interface
(xla/ffi/api/c_api.h, version 0.3).
"""

from __future__ import annotations

import ctypes
import hashlib
import re
import struct
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numba
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, UInt8
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mdnum.md.decide import Decisions, Tables
from mdnum.numerics.exact import bound, interpreted

# of the foreign-function interface, whose layout in memory the loop relies on
_VERSION = (0, 3)
# atoms of a block, whose copies stay in the cache: between 1,024 and 4,096 nothing changes
_BLOCK = 2048


class PairSums(NamedTuple):
    """What a loop over a list gives.

    Attributes:
        sums: of each term over the slots of each atom, first slot first, shape (terms, atoms).
        decisions: None where no margin is asked for. Their nearest margin is that of a listed pair, and inf
            where there is none.
    """

    sums: Float[Array, "terms atoms"]
    decisions: Decisions | None


def over_pairs(
    pair: Callable[..., Sequence[Any]],
    columns: Float[Array, "columns atoms"],
    tables: Tables,
    *,
    flags: Sequence[UInt8[Array, "words atoms"]] = (),
    margins: str | None = None,
) -> PairSums | None:
    """Sum a function of pairs over the slots of every atom; inside jit, on a CPU.

    Args:
        pair: of scalars: the atom's columns, its neighbor's, the pair's type (None where there is only one),
            and the bit of each of the flags. Returns the terms to add and, with `margins`, the margin. May
            close over numbers, and arrays with one for each type. In a slot of padding the neighbor's
            columns are NaN.
        columns: float64 numbers of each atom, in the order of the tables.
        tables: the list.
        flags: bits of every slot, packed as decisions.
        margins: ">" or ">=": how the margin of a pair that is decided to be inside compares with 0.

    Returns:
        None where the function has an operation that does not become one of vectors, as an exponential.

    Error: a rounding error for each operation; sums one after the other.
    """
    atoms, words = columns.shape[1], tables.index.shape[0]
    try:
        written = _written(pair, columns.shape[0], len(flags), margins is not None, tables.types is not None)
    except _NotKnown:
        return None
    shapes = [
        jax.ShapeDtypeStruct((written.terms, atoms), np.float64),
        jax.ShapeDtypeStruct((words if margins else 0, atoms), np.uint8),
        jax.ShapeDtypeStruct((1,), np.float64),
    ]
    call = jax.ffi.ffi_call(_registered(written.loop), shapes, vmap_method="sequential")
    index = tables.index.astype(jnp.int32).reshape(-1, atoms)
    bits = jnp.stack(tuple(flags)) if flags else jnp.zeros((0, words, atoms), jnp.uint8)
    equal = jnp.full(1, margins == ">=", jnp.int64)
    kinds = jnp.zeros((0, 1), jnp.uint8) if tables.types is None else tables.types.reshape(-1, atoms)
    sums, decided, nearest = call(index, columns, bits, written.constants, equal, kinds)
    return PairSums(sums, Decisions(decided, nearest[0]) if margins else None)


@cache
def known() -> bool:
    """Whether XLA's interface is the one that the loop was written for, and programs run on a CPU."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text() if header.exists() else ""
    found = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    version = tuple(int(one[1]) for one in found if one)
    return version == _VERSION and jax.default_backend() == "cpu" and np.intp().itemsize == 8


# --- the function of a pair, written down ----------------------------------------------------------------


class _NotKnown(Exception):
    """An operation without a counterpart."""


class _Value(NamedTuple):
    """What differs from pair to pair, by its name in the loop; a number, or a decision."""

    name: str
    kind: str = "double"


class _Written(NamedTuple):
    """A loop's source, the numbers it is given, and how many terms it adds."""

    loop: str
    constants: Array
    terms: int


_OPERATIONS = {
    "add": "fadd double {}, {}",
    "add_any": "fadd double {}, {}",
    "sub": "fsub double {}, {}",
    "mul": "fmul double {}, {}",
    "div": "fdiv double {}, {}",
    "neg": "fneg double {}",
    "square": "fmul double {0}, {0}",
    "abs": "call double @llvm.fabs.f64(double {})",
    "sqrt": "call double @llvm.sqrt.f64(double {})",
    "round": "call double @llvm.rint.f64(double {})",
    "select_n": "select i1 {0}, {kind} {2}, {kind} {1}",
    "eq": "fcmp oeq double {}, {}",
    "gt": "fcmp ogt double {}, {}",
    "ge": "fcmp oge double {}, {}",
    "lt": "fcmp olt double {}, {}",
    "le": "fcmp ole double {}, {}",
    "and": "and i1 {}, {}",
    "or": "or i1 {}, {}",
    "xor": "xor i1 {}, {}",
    "not": "xor i1 {}, true",
}
#: Of an array of one number they change nothing.
_SHAPES = ("broadcast_in_dim", "reshape", "squeeze", "copy", "stop_gradient")


def _number(value: Any) -> str:
    """A constant in LLVM's language."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', float(value)))[0]:016X}"


def _written(
    pair: Callable[..., Sequence[Any]], columns: int, flags: int, margins: bool, types: bool
) -> _Written:
    """The loop over a slot of the atoms of a block, as a function `rows`.

    It is given how many atoms there are, the constants, and where rows of numbers of the atoms begin: their
    own columns, the neighbor's columns, types, flags, room for the margin, and the sums.
    """
    number, truth = jax.ShapeDtypeStruct((), np.float64), jax.ShapeDtypeStruct((), np.bool_)
    kind = jax.ShapeDtypeStruct((), np.uint8) if types else None
    program = jax.make_jaxpr(pair)([number] * columns, [number] * columns, kind, *[truth] * flags)
    terms = len(program.out_avals) - margins
    numbers = columns + columns + types
    rows = numbers + flags + margins + terms
    constants: dict[int, Any] = {}
    lines: list[str] = []

    def text(value: Any, kind: str = "double") -> str:
        if isinstance(value, _Value):
            if value.kind != kind:
                raise _NotKnown("a number where a decision is expected, or the other way round")
            return value.name
        if np.size(value) != 1 or kind != "double" or jnp.result_type(value) == np.bool_:
            raise _NotKnown("an array, or a decision that is the same for all pairs")
        if not isinstance(value, Tracer | jax.Array):
            return _number(value)
        constants.setdefault(id(value), value)
        return f"%c{list(constants).index(id(value))}"

    def put(line: str, kind: str = "double") -> _Value:
        lines.append(f"%v{len(lines)} = {line}")
        return _Value(f"%v{len(lines) - 1}", kind)

    def load(row: int) -> _Value:
        return put(f"load double, ptr {put(f'getelementptr double, ptr %r{row}, i64 %k').name}{_ACCESS}")

    def store(value: str, row: int) -> None:
        at = put(f"getelementptr double, ptr %r{row}, i64 %k").name
        lines.append(f"store double {value}, ptr {at}{_ACCESS}")

    def rule(equation: Any, inputs: list[Any]) -> Sequence[Any]:
        name, made = equation.primitive.name, equation.outvars[0].aval
        if not any(isinstance(value, _Value) for value in inputs):
            # the same for all pairs: made once, outside
            try:
                return bound(equation, inputs)
            except TypeError as error:
                raise _NotKnown(str(error)) from None
        if name == "dynamic_slice" and np.ndim(inputs[0]) == 1 and equation.params["slice_sizes"] == (1,):
            # the constant of the pair's type
            of, which = inputs[0], text(inputs[1])
            chosen = text(of[0])
            for k in range(1, len(of)):
                other = put(f"fcmp oeq double {which}, {_number(k)}", "i1").name
                chosen = put(f"select i1 {other}, double {text(of[k])}, double {chosen}").name
            return [_Value(chosen)]
        if name == "integer_pow":
            power, base = equation.params["y"], text(inputs[0])
            product = base
            for _ in range(abs(power) - 1):
                product = put(f"fmul double {product}, {base}").name
            return [put(f"fdiv double {_number(1)}, {product}") if power < 0 else _Value(product)]
        same = name == "convert_element_type" and made.dtype == equation.invars[0].aval.dtype
        if same or name in _SHAPES:
            return [inputs[0]]
        halves_to_even = name != "round" or equation.params["rounding_method"] == 1
        if name not in _OPERATIONS or not halves_to_even:
            raise _NotKnown(name)
        kind = "i1" if made.dtype == np.bool_ else "double"
        decisions = len(inputs) if name in ("and", "or", "xor", "not") else int(name == "select_n")
        kinds = ["i1"] * decisions + [kind if name == "select_n" else "double"] * (len(inputs) - decisions)
        return [put(_OPERATIONS[name].format(*map(text, inputs, kinds), kind=kind), kind)]

    given = [load(row) for row in range(numbers)]
    given += [put(f"fcmp une double {load(numbers + k).name}, {_number(0)}", "i1") for k in range(flags)]
    results = list(map(text, interpreted(program, given, rule)))
    if margins:
        store(results.pop(), rows - terms - 1)
    for row, term in enumerate(results, rows - terms):
        store(put(f"fadd double {load(row).name}, {term}").name, row)
    starts = [
        line
        for k in range(len(constants))
        for line in (f"%cp{k} = getelementptr double, ptr %c, i64 {k}", f"%c{k} = load double, ptr %cp{k}")
    ]
    starts += [
        line
        for k in range(rows)
        for line in (f"%rp{k} = getelementptr ptr, ptr %r, i64 {k}", f"%r{k} = load ptr, ptr %rp{k}")
    ]
    loop = _LOOP.format(starts="\n  ".join(starts), body="\n  ".join(lines))
    known = [jnp.asarray(value, jnp.float64).reshape(()) for value in constants.values()]
    return _Written(loop, jnp.stack(known) if known else jnp.zeros(0), terms)


_ACCESS = ", !llvm.access.group !0"
# what is read and written in one turn has nothing to do with another: the loop may be one of vectors
_LOOP = """
define i64 @rows(i64 %n, ptr %c, ptr %r) #0 {{
start:
  {starts}
  br label %turn
turn:
  %k = phi i64 [0, %start], [%next, %turn]
  {body}
  %next = add nuw nsw i64 %k, 1
  %more = icmp slt i64 %next, %n
  br i1 %more, label %turn, label %end, !llvm.loop !1
end:
  ret i64 0
}}
declare double @llvm.fabs.f64(double)
declare double @llvm.sqrt.f64(double)
declare double @llvm.rint.f64(double)
attributes #0 = {{ "prefer-vector-width"="512" }}
!0 = distinct !{{}}
!1 = distinct !{{!1, !2, !3}}
!2 = !{{!"llvm.loop.parallel_accesses", !0}}
!3 = !{{!"llvm.loop.vectorize.enable", i1 true}}
"""
# what XLA calls: the loop over the list, which calls the one above
_CALLED = """
define i64 @called(i64 %frame) {{
  %loop = inttoptr i64 {loop} to ptr
  %rows = ptrtoint ptr @rows to i64
  %done = call i64 %loop(i64 %frame, i64 %rows, i64 {task})
  ret i64 %done
}}
"""


@cache
def _registered(source: str) -> str:
    """The name by which XLA knows the loop of a source."""
    name = f"mdnum_pairs_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )
    loop, task = _driver()
    module = llvm.parse_assembly(source + _CALLED.format(loop=loop, task=task))
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(module, builder)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(engine.get_function_address("called"))
    _ALIVE.append((engine, function))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")
    return name


#: What XLA calls must outlive every program.
_ALIVE: list[Any] = []


# --- the loop over a list, which calls the other ----------------------------------------------------------


_carray: Any = numba.carray  # pyright: ignore
_intrinsic: Any = intrinsic


@_intrinsic
def _pointer(typingctx: Any, address: Any) -> Any:
    """A number as the address of memory."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.voidptr(types.intp), generate


@_intrinsic
def _call(typingctx: Any, address: Any, arguments: Any) -> Any:
    """What a C function at an address makes of a tuple of 64-bit arguments."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        whole = context.get_value_type(types.intp)
        kind = ir.FunctionType(whole, [whole] * arguments.count)
        given = cgutils.unpack_tuple(builder, args[1])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), given)

    return types.intp(types.intp, arguments), generate


@_intrinsic
def _added(typingctx: Any, address: Any, amount: Any) -> Any:
    """Add to the 64-bit number at an address, in one step for all threads; the number before."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = builder.inttoptr(args[0], context.get_value_type(types.intp).as_pointer())
        return builder.atomic_rmw("add", at, args[1], "seq_cst")

    return types.intp(types.intp, types.intp), generate


_malloc = types.ExternalFunction("malloc", types.intp(types.intp))
_free = types.ExternalFunction("free", types.void(types.intp))


@numba.njit(cache=True, nogil=True)
def _words(address):
    """Memory as 64-bit words, as many as a frame has or fewer."""
    return _carray(_pointer(address), (32,), np.int64)


@numba.njit(cache=True, nogil=True)
def _buffer(buffers, k):
    """Where the data of a frame's k-th operand or result begin, and its first two dimensions."""
    words = _words(buffers[k])
    size = _words(words[5])
    return words[3], size[0], size[1]


# Loops over n numbers at given addresses: each a function of its own, so that it becomes one of vectors.


@numba.njit(cache=True, nogil=True)
def _filled(out_at, n, value):
    out = _carray(_pointer(out_at), (n,), np.float64)
    for k in range(n):
        out[k] = value


@numba.njit(cache=True, nogil=True)
def _copied(values_at, out_at, n):
    values = _carray(_pointer(values_at), (n,), np.float64)
    out = _carray(_pointer(out_at), (n,), np.float64)
    for k in range(n):
        out[k] = values[k]


@numba.njit(cache=True, nogil=True)
def _least(values_at, n):
    values = _carray(_pointer(values_at), (n,), np.float64)
    least = np.inf
    for k in range(n):
        least = min(least, values[k])
    return least


@numba.njit(cache=True, nogil=True)
def _gathered(index_at, column_at, out_at, n):
    index = _carray(_pointer(index_at), (n,), np.int32)
    column = _carray(_pointer(column_at), (n,), np.float64)
    out = _carray(_pointer(out_at), (n,), np.float64)
    for k in range(n):
        out[k] = column[index[k]]


@numba.njit(cache=True, nogil=True)
def _unpacked(bytes_at, shift, mask, out_at, n):
    values = _carray(_pointer(bytes_at), (n,), np.uint8)
    out = _carray(_pointer(out_at), (n,), np.float64)
    for k in range(n):
        out[k] = (values[k] >> np.uint8(shift)) & np.uint8(mask)


@numba.njit(cache=True, nogil=True)
def _packed(margin_at, equal, shift, bytes_at, n):
    margin = _carray(_pointer(margin_at), (n,), np.float64)
    values = _carray(_pointer(bytes_at), (n,), np.uint8)
    if equal:
        for k in range(n):
            values[k] |= np.uint8(margin[k] >= 0) << np.uint8(shift)
    else:
        for k in range(n):
            values[k] |= np.uint8(margin[k] > 0) << np.uint8(shift)


@numba.njit(cache=True, nogil=True)
def _nearer(margin_at, nearest_at, n):
    margin = _carray(_pointer(margin_at), (n,), np.float64)
    nearest = _carray(_pointer(nearest_at), (n,), np.float64)
    for k in range(n):
        size = abs(margin[k])
        nearest[k] = size if size < nearest[k] else nearest[k]


# A call is a job: 64-bit words that outlive it, since a thread may look for work when none is left. How many
# use it, the next block, blocks done and blocks; addresses of frame, loop over a slot, and padded columns;
# threads that there are, and arguments to XLA; then the nearest margin of each block, and the columns.
_USERS, _NEXT, _DONE, _BLOCKS, _FRAME, _ROWS, _PADDED, _THREADS, _ASKED, _NEAREST = (*range(9), 16)


@numba.njit(cache=True, nogil=True)
def _work(job):
    """Take one block of a job after the other, until none is left."""
    words = _words(job)
    block, blocks = _added(job + 8 * _NEXT, 1), words[_BLOCKS]
    if block >= blocks:
        return
    frame = _words(words[_FRAME])
    operands, results = _words(frame[9]), _words(frame[14])
    index, slots, atoms = _buffer(operands, 0)
    own, columns, _ = _buffer(operands, 1)
    told, flags, _ = _buffer(operands, 2)
    constants, _, _ = _buffer(operands, 3)
    at, _, _ = _buffer(operands, 4)
    equal = _words(at)[0]
    types_of, typed, _ = _buffer(operands, 5)
    typed = min(typed, 1)
    sums, terms, _ = _buffer(results, 0)
    bits, margins, _ = _buffer(results, 1)
    margins = min(margins, 1)

    # addresses of the rows that the loop over a slot is given, then those rows that are a thread's own
    copied = columns + typed + flags + margins
    room = _malloc(8 * (columns + copied + terms + (copied + 1) * _BLOCK))
    near = room + 8 * (columns + copied + terms)
    margin, closest = near + 8 * (copied - 1) * _BLOCK, near + 8 * copied * _BLOCK
    rows = _carray(_pointer(room), (columns + copied + terms,), np.int64)
    for row in range(copied):
        rows[columns + row] = near + 8 * row * _BLOCK
    while block < blocks:
        start = block * _BLOCK
        n = min(_BLOCK, atoms - start)
        for row in range(columns):
            rows[row] = own + 8 * (row * atoms + start)
        for row in range(terms):
            rows[columns + copied + row] = sums + 8 * (row * atoms + start)
            _filled(sums + 8 * (row * atoms + start), n, 0.0)
        _filled(closest, n, np.inf)
        for slot in range(slots):
            word, shift = slot // 8, slot % 8
            out = near
            for row in range(columns):
                padded = words[_PADDED] + 8 * row * (atoms + 1)
                _gathered(index + 4 * (slot * atoms + start), padded, out, n)
                out += 8 * _BLOCK
            if typed:
                _unpacked(types_of + slot * atoms + start, 0, 255, out, n)
                out += 8 * _BLOCK
            for flag in range(flags):
                _unpacked(told + (flag * (slots // 8) + word) * atoms + start, shift, 1, out, n)
                out += 8 * _BLOCK
            _call(words[_ROWS], (n, constants, room))
            if margins:
                _packed(margin, equal, shift, bits + word * atoms + start, n)
                _nearer(margin, closest, n)
        _filled(job + 8 * (_NEAREST + block), 1, _least(closest, n))
        _added(job + 8 * _DONE, 1)
        block = _added(job + 8 * _NEXT, 1)
    _free(room)


@numba.njit(cache=True, nogil=True)
def _leave(job):
    """The last one to use a job clears it away."""
    if _added(job + 8 * _USERS, -1) == 1:
        _free(job)


def _help(job):
    """What another thread does."""
    _work(job)
    _leave(job)
    return 0


@numba.njit(cache=True, nogil=True)
def _helped(job, frame, helpers, task):
    """Ask XLA's threads for help; without any the work is done all the same."""
    words, api = _words(job), _words(frame[2])
    schedule, ask, asked = api[17], api[18], job + 8 * _ASKED
    words[_ASKED], words[_ASKED + 1], words[_ASKED + 2] = 32, 0, frame[3]
    words[_ASKED + 3] = job + 8 * _THREADS
    if _call(ask, (asked,)) != 0:
        return
    words[_ASKED], words[_ASKED + 3], words[_ASKED + 4] = 40, task, job
    for _ in range(min(helpers, words[_THREADS] - 1)):
        _added(job + 8 * _USERS, 1)
        if _call(schedule, (asked,)) != 0:
            _added(job + 8 * _USERS, -1)
            return


def _over_blocks(frame, rows, task):
    """Every block of atoms, as `over_pairs` asks for it; 0 for no error.

    Args:
        frame: address of XLA's frame of the call. rows: address of the loop over a slot. task: of `_help`.
    """
    words = _words(frame)
    if words[1] != 0 and _words(words[1])[1] & 0xFFFFFFFF == 1:
        # a question: for which version of the interface was this written?
        _words(_words(words[1])[3])[3] = _VERSION[0] | (_VERSION[1] << 32)
        return 0
    if words[4] & 0xFFFFFFFF != 3:
        # one of the stages before execution
        return 0
    own, columns, atoms = _buffer(_words(words[9]), 1)
    bits, margins, _ = _buffer(_words(words[14]), 1)
    nearest, _, _ = _buffer(_words(words[14]), 2)
    blocks = -(-atoms // _BLOCK)
    job = _malloc(8 * (_NEAREST + blocks + columns * (atoms + 1)))
    mine = _words(job)
    mine[_USERS], mine[_NEXT], mine[_DONE], mine[_BLOCKS] = 1, 0, 0, blocks
    mine[_FRAME], mine[_ROWS], mine[_PADDED] = frame, rows, job + 8 * (_NEAREST + blocks)
    for row in range(columns):
        out = mine[_PADDED] + 8 * row * (atoms + 1)
        _copied(own + 8 * row * atoms, out, atoms)
        # padding names an atom behind the last
        _filled(out + 8 * atoms, 1, np.nan)
    cleared = _carray(_pointer(bits), (margins * atoms,), np.uint8)
    for k in range(margins * atoms):
        cleared[k] = 0
    if blocks > 1:
        _helped(job, words, blocks - 1, task)
    _work(job)
    while _added(job + 8 * _DONE, 0) < blocks:
        pass
    _filled(nearest, 1, _least(job + 8 * _NEAREST, blocks))
    _leave(job)
    return 0


@cache
def _driver() -> tuple[int, int]:
    """Addresses of the loop over a list and of what helps it; compiled once after an installation."""
    made = [
        numba.cfunc(types.intp(*[types.intp] * count), cache=True)(function)
        for function, count in ((_over_blocks, 3), (_help, 1))
    ]
    _ALIVE.extend(made)
    loop, task = (int(one.address or 0) for one in made)
    return loop, task
