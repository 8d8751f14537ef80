"""LLVM instructions that numba does not generate.

numba recompiles a cached function only if its own file changes. After a change of this file, delete the
caches of callers (`__pycache__`).
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numba.extending
from llvmlite import ir
from numba import types
from numba.core import cgutils

#: numbers of a vector in memory that is turned, copied or selected from; arrays have room for as many behind
#: what they hold
EIGHT = 8
#: float32 numbers of the widest vectors
SIXTEEN = 16
# what a processor does in one go is a known operation of LLVM 19 and later
_COMPRESSES = llvm.llvm_version_info >= (19,) and llvm.get_host_cpu_features().get("avx512f", False)
#: numba's decorator, with type Any because it hides the signature.
intrinsic: Any = numba.extending.intrinsic


@intrinsic
def lowest_bit(typingctx: Any, word: Any) -> Any:
    """Return the position of the lowest set bit of a nonzero uint64."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


@intrinsic
def bits_set(typingctx: Any, word: Any) -> Any:
    """Count the set bits of a 64-bit unsigned integer."""
    return types.uint64(types.uint64), lambda context, builder, signature, args: builder.ctpop(args[0])


class _Vectors:
    """Generator of LLVM instructions for vectors of fixed width and type."""

    def __init__(self, context: Any, builder: Any, number: Any, width: int):
        self.context, self.builder, self.width = context, builder, width
        self.number, self.whole = context.get_value_type(number), context.get_value_type(types.intp)
        self.kind, self.size = ir.VectorType(self.number, width), context.get_abi_sizeof(self.number)

    def of(self, kind: Any, array: Any, place: Any) -> Any:
        """Return the address of an element of an array."""
        return self.builder.gep(
            self.context.make_array(kind)(self.context, self.builder, array).data, [place]
        )

    def at(self, address: Any, place: int) -> Any:
        """Return the address of a number at an offset from an integer address."""
        moved = self.builder.add(address, ir.Constant(self.whole, self.size * place))
        return self.builder.inttoptr(moved, self.number.as_pointer())

    def load(self, address: Any) -> Any:
        """Load the vector that starts at an address."""
        return self.builder.load(self.builder.bitcast(address, self.kind.as_pointer()), align=self.size)

    def store(self, value: Any, address: Any) -> None:
        """Store a vector at an address."""
        self.builder.store(value, self.builder.bitcast(address, self.kind.as_pointer()), align=self.size)

    def spread(self, value: Any) -> Any:
        """Copy one number to all elements of a vector."""
        one = self.builder.insert_element(ir.Constant(self.kind, ir.Undefined), value, ir.IntType(32)(0))
        first = ir.Constant(ir.VectorType(ir.IntType(32), self.width), None)
        return self.builder.shuffle_vector(one, one, first)

    def one(self, address: Any) -> Any:
        """Copy the number at an address to all elements of a vector."""
        return self.spread(self.builder.load(address, align=self.size))

    def larger(self, a: Any, b: Any) -> Any:
        """Return the elementwise maximum of a and b. If one is NaN, return b."""
        return self.builder.select(self.builder.fcmp_ordered(">", a, b), a, b)

    def squares(self, parts: list[Any]) -> Any:
        """Return the elementwise sum of squares of several vectors."""
        name = f"llvm.fmuladd.v{self.width}f32"
        fused = self.builder.module.declare_intrinsic(name, (), ir.FunctionType(self.kind, [self.kind] * 3))
        total = self.builder.fmul(parts[0], parts[0])
        for part in parts[1:]:
            total = self.builder.call(fused, [part, part, total])
        return total

    def bits(self, decisions: Any) -> Any:
        """Pack a vector of decisions into the bits of an integer."""
        return self.builder.zext(self.builder.bitcast(decisions, ir.IntType(self.width)), self.whole)


# --- eight numbers of arrays ------------------------------------------------------------------------------


@intrinsic
def moved(typingctx: Any, source: Any, place: Any, shift: Any, out: Any, at: Any) -> Any:
    """Copy eight numbers of an array, and add a shift to each copy."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        to = _Vectors(context, builder, source.dtype, EIGHT)
        numbers, shift = to.load(to.of(source, *args[:2])), to.spread(args[2])
        add = builder.fadd if isinstance(source.dtype, types.Float) else builder.add
        to.store(add(numbers, shift), to.of(out, *args[3:]))
        return context.get_dummy_value()

    return types.void(source, types.intp, source.dtype, out, types.intp), generate


@intrinsic
def kept(typingctx: Any, mask: Any, place: Any, labels: Any, first: Any, out: Any, at: Any) -> Any:
    """Append the labels that a mask selects. Return the next free position."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits, to = (_Vectors(context, builder, one.dtype, EIGHT) for one in (mask, labels))
        keep, given = bits.load(bits.of(mask, *args[:2])), to.load(to.of(labels, *args[2:4]))
        keep = builder.trunc(keep, ir.VectorType(ir.IntType(1), EIGHT))
        if _COMPRESSES:
            kind = ir.FunctionType(given.type, [given.type, keep.type, given.type])
            name = f"llvm.experimental.vector.compress.v{EIGHT}i32"
            compress = cgutils.get_or_insert_function(builder.module, kind, name)
            given = builder.call(compress, [given, keep, ir.Constant(given.type, ir.Undefined)])
            to.store(given, to.of(out, *args[4:]))
            found = builder.ctpop(builder.bitcast(keep, ir.IntType(EIGHT)))
            return builder.add(args[5], builder.zext(found, args[5].type))
        # one by one, without a branch: over the one before unless that is kept
        data, at = to.of(out, args[4], args[5].type(0)), args[5]
        for k in map(ir.IntType(32), range(EIGHT)):
            builder.store(builder.extract_element(given, k), builder.gep(data, [at]))
            at = builder.add(at, builder.zext(builder.extract_element(keep, k), at.type))
        return at

    return types.intp(mask, types.intp, labels, types.intp, out, types.intp), generate


@intrinsic
def turned(typingctx: Any, rows: Any, place: Any, apart: Any, out: Any, at: Any, across: Any) -> Any:
    """Transpose an 8 × 8 matrix.

    Args:
        place, apart: position of the first row, and distance between rows. at, across: the same for columns.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        to = _Vectors(context, builder, rows.dtype, EIGHT)

        def places(kind: Any, array: Any, first: Any, step: Any) -> list:
            steps = (builder.add(first, builder.mul(step, step.type(k))) for k in range(EIGHT))
            return [to.of(kind, array, one) for one in steps]

        columns = [to.load(one) for one in places(rows, *args[:3])]
        # three times the first half between the second: of rows and columns each three bits change places
        for _ in range(3):
            halves = [[k // 2 + 4 * part + 8 * (k % 2) for k in range(EIGHT)] for part in range(2)]
            which = [ir.Constant(ir.VectorType(ir.IntType(32), EIGHT), half) for half in halves]
            columns = [builder.shuffle_vector(columns[k], columns[k + 4], w) for k in range(4) for w in which]
        for column, one in zip(columns, places(out, *args[3:]), strict=True):
            to.store(column, one)
        return context.get_dummy_value()

    return types.void(rows, types.intp, types.intp, out, types.intp, types.intp), generate


# --- sixteen float32 numbers at an address: a coordinate of each atom of a cluster, x before y before z


@intrinsic
def near_box(typingctx: Any, atoms: Any, shift: Any, box: Any, reach: Any, out: Any) -> Any:
    """Return a bit mask of the shifted atoms within a squared distance `reach` of a box.

    The shifted coordinates are written to `out`.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        atoms, shift, box, reach, out = args
        to, gaps = _Vectors(context, builder, types.float32, SIXTEEN), []
        for c in range(3):
            x = builder.fsub(to.load(to.at(atoms, SIXTEEN * c)), to.one(to.at(shift, c)))
            to.store(x, to.at(out, SIXTEEN * c))
            below, above = to.one(to.at(box, c)), to.one(to.at(box, 3 + c))
            gap = to.larger(builder.fsub(below, x), builder.fsub(x, above))
            gaps.append(to.larger(gap, ir.Constant(to.kind, [0.0] * SIXTEEN)))
        return to.bits(builder.fcmp_ordered("<=", to.squares(gaps), to.spread(reach)))

    return types.uintp(types.uintp, types.uintp, types.uintp, types.float32, types.uintp), generate


@intrinsic
def near_atom(typingctx: Any, atom: Any, atoms: Any, low: Any, high: Any) -> Any:
    """Return bit masks of the atoms with squared distance from `atom` below `low`, and below `high`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        atom, atoms, low, high = args
        to = _Vectors(context, builder, types.float32, SIXTEEN)
        places = range(0, 3 * SIXTEEN, SIXTEEN)
        parts = [builder.fsub(to.load(to.at(atoms, k)), to.one(to.at(atom, k))) for k in places]
        found = to.squares(parts)
        sure, perhaps = (to.bits(builder.fcmp_ordered("<", found, to.spread(one))) for one in (low, high))
        return builder.or_(sure, builder.shl(perhaps, ir.Constant(to.whole, SIXTEEN)))

    return types.uintp(types.uintp, types.uintp, types.float32, types.float32), generate
