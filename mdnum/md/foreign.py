"""XLA callbacks on a CPU: numba functions for XLA's call frames (xla/ffi/api/c_api.h, version 0.3)."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from mdnum.compiled import njit
from mdnum.vectors import intrinsic

# of the foreign-function interface, whose layout in memory the loop relies on
VERSION = (0, 3)


@cache
def known() -> bool:
    """Return True if the callback interface is supported, and programs run on a CPU."""
    header = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    text = header.read_text() if header.exists() else ""
    found = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    version = tuple(int(one[1]) for one in found if one)
    return version == VERSION and jax.default_backend() == "cpu" and np.intp().itemsize == 8


#: Objects that XLA calls, which must exist as long as any program.
ALIVE: list[Any] = []


def registered(name: str, function: Any, *held: Any) -> str:
    """Register a C function with XLA on the CPU, and return its name."""
    ALIVE.extend([function, *held])
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function), platform="cpu")
    return name


carray: Any = numba.carray  # pyright: ignore


@intrinsic
def pointer(typingctx: Any, address: Any) -> Any:
    """Convert an integer to a memory address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.voidptr(types.intp), generate


@intrinsic
def call(typingctx: Any, address: Any, arguments: Any) -> Any:
    """Call the C function at an address with 64-bit arguments. Return its result."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        whole = context.get_value_type(types.intp)
        kind = ir.FunctionType(whole, [whole] * arguments.count)
        given = cgutils.unpack_tuple(builder, args[1])
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), given)

    return types.intp(types.intp, arguments), generate


@intrinsic
def added(typingctx: Any, address: Any, amount: Any) -> Any:
    """Atomically add to the 64-bit number at an address. Return its previous value."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = builder.inttoptr(args[0], context.get_value_type(types.intp).as_pointer())
        return builder.atomic_rmw("add", at, args[1], "seq_cst")

    return types.intp(types.intp, types.intp), generate


malloc = types.ExternalFunction("malloc", types.intp(types.intp))
free = types.ExternalFunction("free", types.void(types.intp))


def _place(builder: Any, address: Any, k: Any) -> Any:
    """Return the location of the k-th 64-bit number at an address."""
    return builder.gep(builder.inttoptr(address, ir.IntType(64).as_pointer()), [k])


# not arrays and functions of numba's, each of which takes a tenth of a second to compile
@intrinsic
def peek(typingctx: Any, address: Any, k: Any) -> Any:
    """Read the k-th 64-bit number at an address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_place(builder, *args))

    return types.intp(types.intp, types.intp), generate


@intrinsic
def poke(typingctx: Any, address: Any, k: Any, value: Any) -> Any:
    """Write a value to the k-th 64-bit number at an address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _place(builder, *args[:2]))
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp), generate


@intrinsic
def buffer(typingctx: Any, buffers: Any, k: Any) -> Any:
    """Return the address and the first two dimensions of operand or result k."""
    made = types.UniTuple(types.intp, 3)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def read(address: Any, k: int) -> Any:
            return builder.load(_place(builder, address, ir.Constant(ir.IntType(64), k)))

        one = builder.load(_place(builder, *args))
        shape = read(one, 5)
        return context.make_tuple(builder, made, [read(one, 3), read(shape, 0), read(shape, 1)])

    return made(types.intp, types.intp), generate


@njit
def asked_to_run(frame):
    """Return True if XLA requests execution; answer version requests, and ignore other requests."""
    asked = peek(frame, 1)
    if asked != 0 and peek(asked, 1) & 0xFFFFFFFF == 1:
        # for which version of the interface was this written?
        poke(peek(asked, 3), 3, VERSION[0] | (VERSION[1] << 32))
        return False
    return peek(frame, 4) & 0xFFFFFFFF == 3
