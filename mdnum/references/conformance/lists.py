"""Conversion of functions and classes to neighbor lists that can be tested."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy import ndarray

from mdnum.errors import InputError
from mdnum.provenance import version
from mdnum.references.conformance.case import Case
from mdnum.references.oracle import completed, widths
from mdnum.registry import Registry


class KeptList(Protocol):
    """A neighbor list that is built and then updated. `answer.read` describes the accepted forms of pairs.

    `allocate` builds a new neighbor list, and may be called again. `update` receives the current positions.
    The pairs must include every pair within r_cut at the current positions. Further pairs may be farther
    apart by less than the skin. A neighbor list with its own padding must store it in the attribute `skin`
    (length). The attribute `skin` is read after each call of `allocate`.
    """

    def allocate(self, positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float, skin: float) -> Any:
        """Build a new neighbor list and return its pairs."""
        ...

    def update(self, positions: ndarray, cell: ndarray) -> Any:
        """Update the neighbor list to new positions and return its pairs.

        The arguments may be the same arrays with new contents: store copies.
        """
        ...


#: Arguments of a function, and of the methods of a list that is kept, in order.
_GIVEN = ("positions", "cell", "pbc", "r_cut")
_GIVEN_TO_KEPT = {"allocate": (*_GIVEN, "skin"), "update": ("positions", "cell")}
_WANTED = f"Give a function of ({', '.join(_GIVEN)}) that returns (i, j)"


@dataclass(frozen=True)
class ListLimits:
    """Limits on the inputs of a neighbor list. Test cases beyond a limit are skipped and counted."""

    minimum_image: bool = False  # one image of a pair at most: no cell narrower than two cutoffs (and skins)
    orthorhombic: bool = False  # no cell with other than right angles
    # no cell whose vectors point elsewhere than along x, y and z (nor backward)
    along_axes: bool = False
    all_axes: bool = False  # no cell that repeats along some axes only
    periodic: bool = False  # no free atoms
    free: bool = False  # no periodic box
    wrapped: bool = False  # no atoms outside the box
    fixed_cell: bool = False  # no box that changes during the list's life
    right_handed: bool = False  # no left-handed cell
    lower_triangular: bool = False  # no cell that is not lower triangular
    whole_cell: bool = False  # no cell that lacks a vector, even along an axis that does not repeat
    fixed_atoms: bool = True  # a list in use cannot be given other atoms: `allocate` is called again
    atoms: int = 0  # no fewer atoms
    most_atoms: float = np.inf  # no more atoms
    least_cutoff: float = 0.0  # no shorter cutoff: a library for one unit of length
    roomy: float = np.inf  # no box of more cells of r_cut than this along all axes together

    def refusal(self, case: Case) -> str | None:
        """Return the limit that a test case exceeds, as text. None if there is none."""
        return next((why for beyond, why in self._beyond(case) if beyond), None)

    def _beyond(self, case: Case) -> Iterator[tuple[bool, str]]:
        """For each limit, yield whether a test case exceeds the limit, and its name."""
        pbc, cells = np.array(case.pbc), [still.cell for still in case.stills]
        least = min(len(still.positions) for still in case.stills)
        yield least < self.atoms, f"at least {self.atoms} atom{'s' * (self.atoms > 1)}"
        yield case.atoms > self.most_atoms, f"at most {self.most_atoms} atoms"
        yield case.r_cut < self.least_cutoff, f"no cutoff below {self.least_cutoff:g}"
        yield self.periodic and not pbc.any(), "no free atoms"
        yield self.free and bool(pbc.any()), "free atoms only"
        lacks = self.whole_cell and any(np.linalg.matrix_rank(cell) < 3 for cell in cells)
        yield lacks, "no cell that lacks a vector"
        if not pbc.any():
            return
        yield self.all_axes and not pbc.all(), "no periodicity axis by axis"
        for still, before in zip(case.stills, [cells[0], *cells], strict=False):
            yield from self._beyond_box(still.cell, pbc, case.r_cut + case.skin)
            changed = self.fixed_cell and not still.fresh and not np.array_equal(still.cell, before)
            yield changed, "no box that changes"
            if self.wrapped:
                fractional = np.linalg.solve(completed(still.cell, pbc).T, still.positions.T).T[:, pbc]
                inside = bool(((fractional >= 0) & (fractional < 1)).all())
                yield not inside, "atoms inside the box only"

    def _beyond_box(self, cell: ndarray, pbc: ndarray, reach: float) -> Iterator[tuple[bool, str]]:
        used = cell[pbc]
        products = used @ used.T
        leans = bool(np.count_nonzero(products - np.diag(np.diag(products))))
        yield self.orthorhombic and leans, "right angles only"
        elsewhere = np.count_nonzero(used - np.where(np.eye(3, dtype=bool), cell, 0.0)[pbc])
        turned = bool(elsewhere or (np.diag(cell)[pbc] <= 0).any())
        yield self.along_axes and turned, "cells along x, y and z only"
        yield self.right_handed and bool(pbc.all()) and np.linalg.det(cell) < 0, "no left-handed cell"
        yield self.lower_triangular and bool(np.triu(cell, 1).any()), "lower triangular cells only"
        width = widths(completed(cell, pbc))[pbc]
        yield self.minimum_image and reach >= 0.5 * width.min(), "minimum image only"
        yield bool(np.prod(width / reach) > self.roomy), f"no box of more than {self.roomy:.0e} cells"


#: Limits that can be declared by a word, such as "minimum-image".
LIMITS = {limit.name.replace("_", "-"): limit.name for limit in fields(ListLimits) if limit.default is False}


@dataclass(frozen=True)
class PairList:
    """A neighbor list under test."""

    name: str  # what people write
    make: Callable[[], Any]  # gives a function of (positions, cell, pbc, r_cut), or a `KeptList`
    kept: bool = False  # whether it is a `KeptList`
    package: str | None = None  # distribution whose version counts
    needs: tuple[str, ...] = ()  # other distributions that calling it takes
    full: bool | None = None  # every pair from both atoms, or once; None to find out
    unit: float | None = None  # roundoff of its arithmetic; None to find out
    # pairs somewhat beyond the cutoff may be there; None to find out, of a list that is kept
    superset: bool | None = None
    limits: ListLimits = field(default_factory=ListLimits)  # what it does not claim to do
    source: str = ""  # lines that define or import it, for a script without mdnum
    # an expression that is the function, or the class of lists that are kept, in that script
    call: str = "pairs"
    affords: float = 1.0  # the share of the random cases that it is asked: slow ones take 0.01
    # what is known of why it fails, by code of the failure
    known: Mapping[str, str] = field(default_factory=dict)
    description: str = ""  # one line
    word: str = ""  # what `load` finds it by in another process; empty where it cannot

    @property
    def version(self) -> str | None:
        """Installed version of the neighbor list's package. None if unknown."""
        return self.package and version(self.package)

    @property
    def lacks(self) -> list[str]:
        """Python distributions that the neighbor list requires but that are not installed."""
        needed = (*((self.package,) if self.package else ()), *self.needs)
        return [name for name in needed if version(name) is None]

    def with_options(self, **options: Any) -> PairList:
        """Return the `PairList` with other declared properties; None leaves a property unchanged."""
        return replace(self, **{name: value for name, value in options.items() if value is not None})


#: Named lists, installed or not. Another package adds a `PairList`, a function, or a class of lists that are
#: kept, by an entry point "mdnum.neighbor_lists".
LISTS: Registry[PairList] = Registry("neighbor list", "mdnum.neighbor_lists")


def source_of(made: Any) -> str:
    """Return the source code of a function or class without decorators. "" if not available."""
    try:
        lines = inspect.getsource(made).splitlines(keepends=True)
    except (OSError, TypeError):
        return ""
    first = next((n for n, line in enumerate(lines) if line.lstrip().startswith(("def ", "class "))), 0)
    return "".join(lines[first:])


def from_object(made: Any, name: str | None = None, source: str | None = None) -> PairList:
    """Return a `PairList` made from a function, a class or an object.

    The optional attributes `full` (bool), `unit` (roundoff), `superset` (bool) and `limits` (`ListLimits`) of
    the object describe the list.

    Raises:
        InputError: the object is neither a function nor a neighbor list.
    """
    if isinstance(made, PairList):
        return made
    name = str(name or getattr(made, "__name__", type(made).__name__))
    lacks = [word for word in _GIVEN_TO_KEPT if not callable(getattr(made, word, None))]
    if lacks and not callable(made):
        message = f"{name} is neither a function nor an object with allocate and update"
        raise InputError(message, remedy=_WANTED)
    if lacks and inspect.isclass(made):
        remedy = "A persistent neighbor list needs allocate and update" if len(lacks) < 2 else _WANTED
        raise InputError(f"the class {name} has no {' and '.join(lacks)}", remedy=remedy)
    _check_signatures(made, name, not lacks)
    declared = {
        word: getattr(made, word)
        for word in ("full", "unit", "superset", "limits")
        if hasattr(made, word) and not callable(getattr(made, word))
    }
    return PairList(
        name,
        made if inspect.isclass(made) else lambda: made,
        not lacks,
        source=source_of(made) if source is None else source,
        call=str(getattr(made, "__name__", None) or name.rpartition(":")[2]),
        **declared,
    )


def _check_signatures(made: Any, name: str, kept: bool) -> None:
    """Raise InputError if a neighbor list does not accept the arguments of the tests."""
    is_class = inspect.isclass(made)
    calls: list[tuple[str, Any, tuple[str, ...]]] = []
    if is_class or not kept:
        calls.append(("", made, () if kept else _GIVEN))
    for word, given in _GIVEN_TO_KEPT.items() if kept else ():
        # of a class this is a function whose first argument is the object
        plain = is_class and inspect.isfunction(inspect.getattr_static(made, word))
        function = getattr(made, word)
        calls.append((f".{word}", functools.partial(function, None) if plain else function, given))
    for word, function, given in calls:
        try:
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            continue
        try:
            signature.bind(*given)
        except TypeError as error:
            order = (
                "Accept these arguments, in order" if given else "Give a class that is made without arguments"
            )
            raise InputError(
                f"{name}{word}{signature} cannot be called with the arguments ({', '.join(given)}): {error}",
                remedy=order if kept else _WANTED,
            ) from error
