"""The type checker that the tests put on mdnum's functions."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping
import numba
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep3119Exception

# an int where a float is expected is fine (PEP 484's numeric tower)
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """function with its annotations checked at each call.

    A function that takes a protocol which is not runtime-checkable is left as it is: such a protocol can
    only be checked by a static checker, and pyright does.
    """
    try:
        return _beartype(function)
    except BeartypeDecorHintPep3119Exception:
        return function


def check_lazily() -> None:
    """Let jaxtyping prepare the checks of a function when it is called for the first time.

    Preparing them costs a millisecond, and a test calls few of the functions that it imports. To be called
    before mdnum is imported: the import hook decorates with whatever `jaxtyping.jaxtyped` is then.
    """
    at_once = jaxtyping.jaxtyped

    def when_called(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
        checked = None

        @functools.wraps(function)
        def prepared(*arguments: Any, **options: Any) -> Any:
            nonlocal checked
            if checked is None:
                checked = at_once(function, typechecker=typechecker)
            return checked(*arguments, **options)

        prepared.prepared_when_called = True  # type: ignore[attr-defined]
        return prepared

    def jaxtyped(*, typechecker: Any) -> Callable[..., Any]:
        def decorate(target: Any) -> Any:
            if inspect.isfunction(target):
                return when_called(target, typechecker)
            if inspect.isclass(target):
                start = target.__init__
                if dataclasses.is_dataclass(target) and not hasattr(start, "prepared_when_called"):
                    target.__init__ = when_called(start, typechecker)
                return target
            return at_once(target, typechecker=typechecker)

        return decorate

    jaxtyping.jaxtyped = jaxtyped  # type: ignore[assignment]


def keep_numba_whole() -> None:
    """Let numba compile a function rather than the checking wrapper that the import hook puts around it.

    To be called before mdnum is imported: the hook decorates every function below its other decorators.
    """
    njit = numba.njit

    @functools.wraps(njit)
    def unwrapping(*arguments: Any, **options: Any) -> Any:
        if len(arguments) == 1 and callable(arguments[0]):
            return njit(inspect.unwrap(arguments[0]), **options)
        compiler = njit(*arguments, **options)
        return lambda function: compiler(inspect.unwrap(function))

    numba.njit = unwrapping
    cfunc = numba.cfunc
    numba.cfunc = lambda *kind, **options: lambda function: cfunc(*kind, **options)(inspect.unwrap(function))
