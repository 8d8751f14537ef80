"""Does a program give the same bits every time? Asked by running it again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import jax
import numpy as np

from mdnum.ball.problem import Problem
from mdnum.ball.rollout import BallRun
from mdnum.errors import InputError, NumericalError

#: What of a run is hashed: every state, and every decision.
_PARTS = ("y", "v", "contact", "iterations", "reason")


def fingerprint(run: BallRun) -> str:
    """SHA-256 of every state and decision of a run, bit for bit.

    Equal fingerprints: the same heights, velocities, contacts and iteration counts, to the last bit.
    """
    digest = hashlib.sha256()
    for name in _PARTS:
        array = np.ascontiguousarray(getattr(run, name))
        digest.update(f"{name} {array.dtype.name} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def require_deterministic(problem: Problem, times: int = 2, recompile: bool = True) -> str:
    """Run a problem several times and insist on the same bits.

    A program can pass and be wrong, or fragile: it says that nothing outside the inputs had a say, not that
    the inputs determine the answer well. It is worth running before two versions of a program are compared:
    without it a difference may be nobody's.

    Args:
        problem: world, start and steps.
        times: how often, at least 2.
        recompile: throw compiled programs away in between, so that the compiler is asked again too.

    Returns:
        the fingerprint of the run.

    Raises:
        NumericalError: two runs differ; names the first step and ball.
        InputError: times below 2.
    """
    if times < 2:
        raise InputError(f"times = {times}; expected at least 2", remedy="One run agrees with itself")
    first = problem.run()
    for _ in range(times - 1):
        if recompile:
            jax.clear_caches()
        again = problem.run()
        if fingerprint(again) != fingerprint(first):
            raise NumericalError(
                f"two runs of one problem differ, first {_where([first, again])}",
                remedy="Look for a sum whose order is not fixed, or a seed that is not set",
            )
    return fingerprint(first)


def _where(runs: Sequence[BallRun]) -> str:
    """The first state whose bits differ, in words."""
    one, two = ((run.y.tobytes(), run.v.tobytes()) for run in runs)
    if one == two:
        return "in a decision"
    a, b = runs
    apart = (_bits(a.y) != _bits(b.y)) | (_bits(a.v) != _bits(b.v))
    step = int(apart.any(axis=1).argmax())
    return f"at step {step}, ball {int(apart[step].argmax())}"


def _bits(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x).view(f"u{x.dtype.itemsize}")
