"""The words of choices, for somebody who wrote one that there is not."""

from __future__ import annotations

from collections.abc import Iterable


def families(names: Iterable[str]) -> str:
    """Choices without their arguments, each once, in order: "precision, reduction, order"."""
    heads = (name.partition("=")[0].partition("@")[0].partition(".")[0] for name in names)
    return ", ".join(dict.fromkeys(heads))
