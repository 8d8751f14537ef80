"""Reductions by name: every order in which a sum can be made (see `orders` for the contract)."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.precision.compensated import Kahan, Neumaier
from mdnum.precision.orders import Blocked, Pairwise, Permuted, Reduction, Sequential, Sorted, Whole
from mdnum.precision.policy import ALL
from mdnum.precision.superaccumulator import Exact, FixedPoint

__all__ = [
    "BY_NAME",
    "Blocked",
    "Exact",
    "FixedPoint",
    "Kahan",
    "Neumaier",
    "Pairwise",
    "Permuted",
    "Reduction",
    "Sequential",
    "Sorted",
    "Widened",
    "make",
    "parse",
]


def _reversed() -> Sequential:
    return Sequential("reversed")


_MAKERS: Mapping[str, Callable[..., Reduction]] = {
    "sequential": Sequential,
    "reversed": _reversed,
    "permuted": Permuted,
    "pairwise": Pairwise,
    "blocked": Blocked,
    "kahan": Kahan,
    "neumaier": Neumaier,
    "sorted": Sorted,
    "exact": Exact,
    "fixed-point": FixedPoint,
}

BY_NAME: Mapping[str, Reduction] = {name: maker() for name, maker in _MAKERS.items()}


def make(name: str, **options: Any) -> Reduction:
    """A reduction by its name, such as make("blocked", width=8).

    Raises:
        InputError: no reduction has that name, or it has no such option.
    """
    if name not in _MAKERS:
        near = difflib.get_close_matches(name, _MAKERS, n=1)
        raise InputError(
            f"no reduction called {name!r}",
            remedy=(f"Did you mean {near[0]}? " if near else "") + f"There are {', '.join(_MAKERS)}",
        )
    known = [field.name for field in fields(BY_NAME[name]) if field.init] if name != "reversed" else []  # pyright: ignore[reportArgumentType]
    for option in options:
        if option not in known:
            raise InputError(f"{name} has no option {option!r}; it has {', '.join(known) or 'none'}")
    return _MAKERS[name](**options)


#: The option that the number after a colon sets.
_NUMBER = {"permuted": "seed", "blocked": "width", "fixed-point": "bits"}


def parse(text: str) -> Reduction:
    """A reduction as one word, with its number after a colon: "exact", "permuted:3", "blocked:8".

    Raises:
        InputError: no reduction is called that, or it takes no number.
    """
    name, colon, number = text.partition(":")
    if not colon:
        return make(name)
    try:
        value = int(number)
    except ValueError:
        raise InputError(f"{number!r} in {text!r} is not a whole number") from None
    if name in _MAKERS and name not in _NUMBER:
        raise InputError(f"{name} takes no number", remedy=f"Those that do are {', '.join(_NUMBER)}.")
    return make(name, **{_NUMBER.get(name, "seed"): value})


@dataclass(frozen=True)
class Widened(Whole):
    """Store low, accumulate high: terms as they come, sum and result in a wider dtype.

    Attributes:
        inner: the order of the sum.
        dtype: name of the wider dtype.
    """

    inner: Reduction
    dtype: str = "float32"

    def __post_init__(self):
        if self.dtype not in ALL:
            raise InputError(f"unknown dtype {self.dtype!r}; known are {', '.join(ALL)}")

    def __call__(
        self, terms: Float[Array, "n ..."], zero: Int[Array, ""] | None = None
    ) -> Float[Array, "..."]:
        """The sum over the leading axis, in the wider dtype."""
        return self.inner(terms.astype(ALL[self.dtype]), zero)

    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """As the inner reduction: widening the terms is exact."""
        return self.inner.bound(terms.astype(ALL[self.dtype]))
