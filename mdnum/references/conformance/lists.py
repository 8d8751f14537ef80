"""A neighbor list under test: how it is called, and what it does not claim to do."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib import metadata
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case
from mdnum.references.oracle import completed, widths
from mdnum.registry import Registry


@runtime_checkable
class KeptList(Protocol):
    """A list that is kept and brought up to date. Both calls return pairs as `answer.read` takes them.

    `allocate` starts anew and may be called again on the same object; `update` is given where the atoms are
    now. The pairs that are returned must hold every pair within r_cut of the positions of this call; pairs
    somewhat further may be there, as the skin leaves them. A list that keeps a padding of its own, whatever
    skin it is given, has it in an attribute `skin` (length) that is read after each `allocate`.
    """

    def allocate(self, positions: ndarray, cell: ndarray, pbc: ndarray, r_cut: float, skin: float) -> Any:
        """The pairs of a new list."""
        ...

    def update(self, positions: ndarray, cell: ndarray) -> Any:
        """The pairs of the list in use at these positions.

        The arrays may be those of the call before with other numbers in them: keep numbers, not arrays.
        """
        ...


@dataclass(frozen=True)
class ListLimits:
    """What a list does not claim to do; such cases are not asked, and are counted.

    Attributes:
        minimum_image: one image of a pair at most: no cell narrower than two cutoffs (and skins).
        orthorhombic: no cell with other than right angles.
        along_axes: no cell whose vectors point elsewhere than along x, y and z (lengths may be negative: no).
        all_axes: no cell that repeats along some axes only.
        periodic: no free atoms.
        free: no periodic box.
        wrapped: no atoms outside the box.
        fixed_cell: no box that changes during the list's life.
        right_handed: no left-handed cell.
        lower_triangular: no cell that is not lower triangular.
        whole_cell: no cell that lacks a vector, even along an axis that does not repeat.
        fixed_atoms: a list in use cannot be given other atoms: `allocate` is called again.
        atoms: no fewer atoms.
        most_atoms: no more atoms.
        least_cutoff: no shorter cutoff: a library for one unit of length.
        roomy: no box of more cells of r_cut than this along all axes together.
    """

    minimum_image: bool = False
    orthorhombic: bool = False
    along_axes: bool = False
    all_axes: bool = False
    periodic: bool = False
    free: bool = False
    wrapped: bool = False
    fixed_cell: bool = False
    right_handed: bool = False
    lower_triangular: bool = False
    whole_cell: bool = False
    fixed_atoms: bool = True
    atoms: int = 0
    most_atoms: int | None = None
    least_cutoff: float = 0.0
    roomy: float | None = None

    def refusal(self, case: Case) -> str | None:
        """Why a case is not asked, or None when it is."""
        pbc = np.array(case.pbc)
        least = min(len(still.positions) for still in case.stills)
        if least < self.atoms:
            return f"at least {self.atoms} atom{'s' * (self.atoms > 1)}"
        if self.most_atoms is not None and case.atoms > self.most_atoms:
            return f"at most {self.most_atoms} atoms"
        if case.r_cut < self.least_cutoff:
            return f"no cutoff below {self.least_cutoff:g}"
        if self.periodic and not pbc.any():
            return "no free atoms"
        if self.free and pbc.any():
            return "free atoms only"
        if self.whole_cell and any(np.linalg.matrix_rank(still.cell) < 3 for still in case.stills):
            return "no cell that lacks a vector"
        if not pbc.any():
            return None
        if self.all_axes and not pbc.all():
            return "no periodicity axis by axis"
        before = case.stills[0].cell
        for still in case.stills:
            if (why := self._box(still.cell, pbc, case.r_cut + case.skin)) is not None:
                return why
            if self.fixed_cell and not still.fresh and not np.array_equal(still.cell, before):
                return "no box that changes"
            before = still.cell
            if self.wrapped:
                fractional = np.linalg.solve(completed(still.cell, pbc).T, still.positions.T).T[:, pbc]
                if not ((fractional >= 0) & (fractional < 1)).all():
                    return "atoms inside the box only"
        return None

    def _box(self, cell: ndarray, pbc: ndarray, reach: float) -> str | None:
        used = cell[pbc]
        products = used @ used.T
        if self.orthorhombic and np.count_nonzero(products - np.diag(np.diag(products))):
            return "right angles only"
        elsewhere = np.count_nonzero(used - np.where(np.eye(3, dtype=bool), cell, 0.0)[pbc])
        if self.along_axes and (elsewhere or (np.diag(cell)[pbc] <= 0).any()):
            return "cells along x, y and z only"
        if self.right_handed and pbc.all() and np.linalg.det(cell) < 0:
            return "no left-handed cell"
        if self.lower_triangular and np.count_nonzero(np.triu(cell, 1)):
            return "lower triangular cells only"
        width = widths(completed(cell, pbc))[pbc]
        if self.minimum_image and reach >= 0.5 * width.min():
            return "minimum image only"
        if self.roomy is not None and np.prod(width / reach) > self.roomy:
            return f"no box of more than {self.roomy:.0e} cells"
        return None


#: ListLimits that are declared by a word, such as "minimum-image".
LIMITS = {limit.name.replace("_", "-"): limit.name for limit in fields(ListLimits) if limit.default is False}


@dataclass(frozen=True)
class PairList:
    """A neighbor list under test.

    Attributes:
        name: what people write.
        make: gives a function of (positions, cell, pbc, r_cut), or a `KeptList`.
        kept: whether it is a `KeptList`.
        package: distribution whose version counts.
        full: every pair from both atoms, or once; None to find out.
        unit: roundoff of its arithmetic; None to find out.
        superset: pairs somewhat beyond the cutoff may be there; None to find out, of a list that is kept.
        limits: what it does not claim to do.
        known: what is known of why it fails, by code of the failure.
        source: lines that define or import it, for a script without mdnum.
        call: an expression that is the function, or the class of lists that are kept, in that script.
        affords: the share of the random cases that it is asked: slow ones take 0.01.
        description: one line.
        word: what `load` finds it by in another process; empty where it cannot.
    """

    name: str
    make: Callable[[], Any]
    kept: bool = False
    package: str | None = None
    full: bool | None = None
    unit: float | None = None
    superset: bool | None = None
    limits: ListLimits = field(default_factory=ListLimits)
    source: str = ""
    call: str = "pairs"
    affords: float = 1.0
    known: Mapping[str, str] = field(default_factory=dict)
    description: str = ""
    word: str = ""

    @property
    def version(self) -> str | None:
        """Installed version of its package, or None."""
        try:
            return None if self.package is None else metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return None

    def with_options(self, **options: Any) -> PairList:
        """The same with other declarations; None leaves one as it is."""
        return replace(self, **{name: value for name, value in options.items() if value is not None})


#: Lists with a name, installed or not; another package adds a `PairList`, a function or a class of lists that
#: are kept by an entry point "mdnum.neighbor_lists".
LISTS: Registry[PairList] = Registry("neighbor list", "mdnum.neighbor_lists")


def peer(name: str, package: str, *helpers: Any, **declared: Any) -> Callable[[Any], Any]:
    """Decorates a function, or a class of lists that are kept, which `LISTS` then has by this name.

    Args:
        package: distribution whose version counts.
        helpers: what its lines need beside themselves, for a script without mdnum.
        declared: attributes of `PairList`.
    """

    def register(made: Any) -> Any:
        kept = inspect.isclass(made)
        lines = "\n\n".join(source_of(one) for one in (*helpers, made))
        make = made if kept else lambda: made
        about = (inspect.getdoc(made) or "").partition("\n")[0].rstrip(".")
        listed = PairList(
            name,
            make,
            kept,
            package,
            source=lines,
            call=made.__name__,
            description=about,
            word=name,
            **declared,
        )
        LISTS.add(name, listed, description=about)
        return made

    return register


def source_of(made: Any) -> str:
    """The lines that define a function or class, without decorators; nothing where they are not available."""
    try:
        lines = inspect.getsource(made).splitlines(keepends=True)
    except (OSError, TypeError):
        return ""
    first = next((n for n, line in enumerate(lines) if line.lstrip().startswith(("def ", "class "))), 0)
    return "".join(lines[first:])
