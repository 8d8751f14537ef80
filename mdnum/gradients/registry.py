"""Methods by their words: one row for each way of differentiating a rollout."""

from __future__ import annotations

import difflib
from collections.abc import Callable

from mdnum.errors import InputError
from mdnum.gradients.base import Method
from mdnum.gradients.boundary import Boundary
from mdnum.gradients.differences import FiniteDifferences
from mdnum.gradients.ensemble import Ensemble
from mdnum.gradients.forward import Forward
from mdnum.gradients.reversible import Reversible
from mdnum.gradients.reweighting import Reweighting
from mdnum.gradients.shadow import ShadowDifferences
from mdnum.gradients.smoothed import SmoothedDifferences
from mdnum.gradients.surrogate import Surrogate
from mdnum.gradients.symmetric import EventAware, Symmetric
from mdnum.gradients.unrolled import Epochs, Recursive, Unrolled

#: A method with its defaults, by word; the order is the one that tables show.
METHODS: dict[str, Callable[[], Method]] = {
    "symmetric": Symmetric,
    "forward": Forward,
    "unrolled": Unrolled,
    "epochs": Epochs,
    "recursive": Recursive,
    "reversible": Reversible,
    "event-aware": EventAware,
    "finite-differences": FiniteDifferences,
    "shadow-differences": ShadowDifferences,
    "smoothed-differences": SmoothedDifferences,
    "surrogate": Surrogate,
    "ensemble": Ensemble,
    "reweighting": Reweighting,
    "boundary": Boundary,
}


def by_word(word: str) -> Method:
    """The method of that name, with its defaults.

    Raises:
        InputError: there is none.
    """
    if word not in METHODS:
        close = difflib.get_close_matches(word, METHODS, n=1)
        hint = f"Did you mean {close[0]}? " if close else ""
        raise InputError(f"no method {word!r}", remedy=f"{hint}There are {', '.join(METHODS)}")
    return METHODS[word]()
