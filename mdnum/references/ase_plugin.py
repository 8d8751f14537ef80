"""Module that registers mdnum as a plugin of ASE, without an import of other modules."""

from __future__ import annotations

from typing import Any

__ase_plugins__: set[Any] = set()
try:
    # experimental there, and not in versions before 3.29
    from ase._4.plugins.plugin import CalculatorPlugin

    __ase_plugins__ = {CalculatorPlugin("mdnum", implementation="mdnum.references.MdnumCalculator")}
except ImportError:
    pass
