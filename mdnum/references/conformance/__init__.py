"""A conformance suite that compares any neighbor list with an exact brute-force search.

`examine` runs all test cases. `load` finds a neighbor list by name. `NeighborListConformance` is a class to
subclass in the tests of a library. `cases` and `boxes` are hypothesis strategies for further tests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

if TYPE_CHECKING:
    from mdnum.references.conformance.adoption import NeighborListConformance as NeighborListConformance
    from mdnum.references.conformance.case import AREAS as AREAS
    from mdnum.references.conformance.case import Case as Case
    from mdnum.references.conformance.case import Still as Still
    from mdnum.references.conformance.judge import Report as Report
    from mdnum.references.conformance.lists import LISTS as LISTS
    from mdnum.references.conformance.lists import KeptList as KeptList
    from mdnum.references.conformance.lists import ListLimits as ListLimits
    from mdnum.references.conformance.lists import PairList as PairList
    from mdnum.references.conformance.lists import from_object as from_object
    from mdnum.references.conformance.peers import installed as installed
    from mdnum.references.conformance.peers import known as known
    from mdnum.references.conformance.peers import load as load
    from mdnum.references.conformance.questions import boxes as boxes
    from mdnum.references.conformance.questions import cases as cases
    from mdnum.references.conformance.reproduction import script as script
    from mdnum.references.conformance.suite import examine as examine

# no module here has the name of what is exported: importing it would put the module in its place
__getattr__, __dir__, __all__ = on_first_use(__name__)
