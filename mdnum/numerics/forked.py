"""Detection of forked processes, in which jax hangs."""

from __future__ import annotations

import os
from typing import Any

from jax._src import xla_bridge

from mdnum.errors import InputError

_forked = False


def check_not_forked() -> None:
    """Raise an error if this process cannot use jax. Call this function before the first use of jax.

    Raises:
        InputError: this process is a fork of a process that has used jax.
    """
    if _forked:
        raise InputError(
            "this process was forked from a process that had used jax, so jax would deadlock here",
            remedy="Start workers with multiprocessing.get_context('spawn'), or use mdnum only in "
            "the workers (docs/pools.md)",
        )


def _in_child() -> None:
    global _forked
    # looked at as it is: the lock of jax's own question may be held by a thread that is not there any more
    started: Any = getattr(xla_bridge, "_backends", True)
    _forked = _forked or bool(started)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
