"""Reference results from ASE, numpy and neighbor searches; also an ASE calculator that uses mdnum.

Modules are imported at first use. Importing ASE, MDAnalysis or jax takes a second or more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

if TYPE_CHECKING:
    from mdnum.references.calculator import MdnumCalculator as MdnumCalculator
    from mdnum.references.energy_check import check_dynamics as check_dynamics
    from mdnum.references.energy_check import check_energy as check_energy
    from mdnum.references.oracle import all_pairs as all_pairs
    from mdnum.references.pair_check import Search as Search
    from mdnum.references.pair_check import all_searches as all_searches
    from mdnum.references.pair_check import check_pairs as check_pairs
    from mdnum.references.pair_check import effective_cutoff as effective_cutoff

__getattr__, __dir__, __all__ = on_first_use(__name__)
