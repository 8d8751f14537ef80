"""A neighbor list under test: how it is called, what it says it cannot do, and what became of a call."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.answer import Answer, Malformed, handed_out, read
from mdnum.references.conformance.case import Case
from mdnum.references.conformance.refusals import meant
from mdnum.references.oracle import widths


@runtime_checkable
class KeptList(Protocol):
    """A list that is kept and brought up to date. Both calls return pairs as `answer.read` takes them.

    `allocate` starts anew and may be called again on the same object; `update` is told where the atoms are
    now. The pairs that are returned must hold every pair within r_cut of the positions of this call; pairs
    somewhat further may be there, as the skin leaves them. A list that keeps a padding of its own, whatever
    skin it is given, says so in an attribute `skin` (length) that is read after each `allocate`.
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
class Limits:
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
        fixed_atoms: a list in use cannot be given other atoms: `allocate` is called again.
        right_handed: no left-handed cell.
        lower: no cell that is not lower triangular.
        whole_cell: no cell that lacks a vector, even along an axis that does not repeat.
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
    fixed_atoms: bool = True
    right_handed: bool = False
    lower: bool = False
    whole_cell: bool = False
    atoms: int = 0
    most_atoms: int | None = None
    least_cutoff: float = 0.0
    roomy: float | None = None

    def refusal(self, case: Case) -> str | None:
        """Why a case is not asked, or None when it is."""
        pbc = np.array(case.pbc)
        reach = case.r_cut + case.skin
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
        first = case.stills[0].cell
        for still in case.stills if case.steps > 1 else case.stills[:1]:
            if (why := self._box(still.cell, pbc, reach)) is not None:
                return why
            if self.fixed_cell and not still.fresh and not np.array_equal(still.cell, first):
                return "no box that changes"
            first = still.cell
            if self.wrapped and not _inside(still.positions, still.cell, pbc):
                return "atoms inside the box only"
        return None

    def _box(self, cell: ndarray, pbc: ndarray, reach: float) -> str | None:
        used = cell[pbc]
        products = used @ used.T
        if self.orthorhombic and np.count_nonzero(products - np.diag(np.diag(products))):
            return "right angles only"
        if self.along_axes and np.count_nonzero(used - np.where(np.eye(3, dtype=bool), cell, 0.0)[pbc]):
            return "cells along x, y and z only"
        if self.along_axes and (np.diag(cell)[pbc] <= 0).any():
            return "cells along x, y and z only"
        if self.right_handed and pbc.all() and np.linalg.det(cell) < 0:
            return "no left-handed cell"
        if self.lower and np.count_nonzero(np.triu(cell, 1)):
            return "lower triangular cells only"
        width = widths(completed(cell, pbc))[pbc]
        if self.minimum_image and reach >= 0.5 * width.min():
            return "minimum image only"
        if self.roomy is not None and np.prod(width / reach) > self.roomy:
            return f"no box of more than {self.roomy:.0e} cells"
        return None


@dataclass(frozen=True)
class PairList:
    """A neighbor list under test.

    Attributes:
        name: as it was asked for.
        make: gives a function of (positions, cell, pbc, r_cut), or a `KeptList`.
        kept: whether it is a `KeptList`.
        package: distribution whose version counts.
        full: every pair from both atoms, or once; None to find out.
        unit: roundoff of its arithmetic; None to find out.
        superset: pairs somewhat beyond the cutoff may be there; None to find out, of a list that is kept.
        limits: what it does not claim to do.
        known: what is known of why it fails, by code of the failure.
        source: lines that define or import it, for a script without mdnum; the last expression is `call`.
        call: what the script calls it by.
        affords: how many of the random cases it is asked, as a share: slow ones take 0.01.
        about: one line.
        word: what `load` finds it by in another process; empty where it cannot.
    """

    name: str
    make: Callable[[], Any]
    kept: bool = False
    package: str | None = None
    full: bool | None = None
    unit: float | None = None
    superset: bool | None = None
    limits: Limits = field(default_factory=Limits)
    source: str = ""
    call: str = "pairs"
    affords: float = 1.0
    known: Mapping[str, str] = field(default_factory=dict)
    about: str = ""
    word: str = ""

    @property
    def version(self) -> str | None:
        """Installed version of its package, or None."""
        if self.package is None:
            return None
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return None

    def with_options(self, **options: Any) -> PairList:
        """The same with other declarations; None leaves one as it is."""
        return replace(self, **{name: value for name, value in options.items() if value is not None})


@dataclass(frozen=True)
class Outcome:
    """What became of one call.

    Attributes:
        answer: the pairs, or None.
        raised: the exception in words, or None.
        refused: the exception says on purpose that this cannot be done (`refusals.meant`).
        malformed: why the answer is none, or None.
        changed: the input that the call wrote to, or None.
        crashed: how the process ended that made the call, or None.
        late: that it did not answer in time, or None.
        aliased: the rows of the answer before this one were other ones after this call.
        skin: the padding that a list that is kept says that it has, length; None where it says nothing.
    """

    answer: Answer | None = None
    raised: str | None = None
    refused: bool = False
    malformed: str | None = None
    changed: str | None = None
    crashed: str | None = None
    late: str | None = None
    aliased: bool = False
    skin: float | None = None


class Session:
    """Calls of one list, a kept one through its life.

    Args:
        tested: the list.
        reuse: ask the same object in all cases, as a program that runs for long does.
    """

    def __init__(self, tested: PairList, reuse: bool = False):
        self.tested, self.reuse = tested, reuse
        self._made: Any = None
        self._handed: list[ndarray] = []

    def ask(self, case: Case) -> list[Outcome]:
        """The outcome at every still, as far as the list goes: it ends at the first that is no answer."""
        return list(self.asked(case))

    def asked(self, case: Case) -> Iterator[Outcome]:
        """The same, one after the other."""
        if self._made is None or (self.tested.kept and not self.reuse):
            try:
                self._made = self.tested.make()
            except SystemExit as error:
                yield _left(error)
                return
            except Exception as error:
                yield _failed(error, case)
                return
        positions, cell = np.zeros((0, 3)), np.zeros((3, 3))
        for step, still in enumerate(case.stills):
            pbc, count, before = np.array(case.pbc), len(still.positions), len(positions)
            fresh = not step or still.fresh or (self.tested.limits.fixed_atoms and count != before)
            if self.tested.kept and not fresh and count == before:
                # a program moves its atoms where they are: a list that kept the array and not its numbers
                # sees no motion
                positions[...], cell[...] = still.positions, still.cell
            else:
                positions, cell = np.array(still.positions), np.array(still.cell)
            skin = case.skin if still.skin is None else still.skin
            outcome = self._one(case, positions, cell, pbc, skin if fresh else None)
            yield outcome
            if outcome.answer is None:
                return

    def close(self) -> None:
        """Lets go of the list."""
        self._made = None
        self._handed = []

    def _one(
        self, case: Case, positions: ndarray, cell: ndarray, pbc: ndarray, skin: float | None
    ) -> Outcome:
        """One call; with a skin, a list that is kept starts anew."""
        before = (positions.copy(), cell.copy(), pbc.copy())
        handed, self._handed = self._handed, []
        held = [part.copy() for part in handed]
        try:
            if not self.tested.kept:
                given = self._made(positions, cell, pbc, case.r_cut)
            elif skin is not None:
                given = self._made.allocate(positions, cell, pbc, case.r_cut, skin)
            else:
                given = self._made.update(positions, cell)
        except SystemExit as error:
            return _left(error)
        except Exception as error:
            return _failed(error, case, self.tested.package)
        try:
            # a copy: a list may hand out the buffer that it fills next time
            answer = read(given)
            self._handed = handed_out(given)
        except Malformed as error:
            return Outcome(malformed=str(error))
        aliased = not all(map(_same, handed, held))
        names = ("positions", "cell", "pbc")
        changed = [
            name
            for name, old, new in zip(names, before, (positions, cell, pbc), strict=True)
            if not np.array_equal(old, new)
        ]
        said = _said(self._made) if self.tested.kept else None
        return Outcome(_copied(answer), changed=changed[0] if changed else None, aliased=aliased, skin=said)


def _said(made: Any) -> float | None:
    """The padding that a list says that it has, length; None where it has no such attribute."""
    try:
        skin = float(made.skin)
    except (AttributeError, TypeError, ValueError):
        return None
    return skin if np.isfinite(skin) and skin >= 0 else None


def _same(one: ndarray, other: ndarray) -> bool:
    """Whether two arrays hold the same bits."""
    return one.shape == other.shape and one.tobytes() == other.tobytes()


def _left(error: SystemExit) -> Outcome:
    """It would have ended the process of whoever called it."""
    return Outcome(crashed=f"it ends the process: SystemExit: {error}")


def _failed(error: Exception, case: Case, package: str | None = None) -> Outcome:
    # what follows the first lines is where it was raised, in some libraries with the frames of compiled code
    said = str(error).partition("Exception raised from ")[0].strip()
    first, frames, rest = said.partition("Traceback of ")
    # TorchScript says what happened in the last line of a traceback
    words = " ".join((f"{first} {rest.splitlines()[-1]}" if frames else said).split())
    # without atoms there is nothing that could not be done
    refused = case.atoms > 0 and meant(error, package)
    return Outcome(raised=f"{type(error).__name__}: {words[:300]}", refused=refused)


def _copied(answer: Answer) -> Answer:
    parts = (answer.i, answer.j, answer.shift, answer.distance, answer.vector)
    return Answer(*(None if part is None else np.array(part) for part in parts))  # type: ignore[arg-type]


def _inside(positions: ndarray, cell: ndarray, pbc: ndarray) -> bool:
    fractional = np.linalg.solve(completed(cell, pbc).T, positions.T).T[:, pbc]
    return bool(((fractional >= 0) & (fractional < 1)).all())


def completed(cell: ndarray, pbc: ndarray) -> ndarray:
    """The cell with unit normals in place of the vectors of axes that do not repeat."""
    if pbc.all():
        return cell
    free = np.flatnonzero(~pbc)
    basis = np.linalg.svd(np.vstack([cell[pbc], np.zeros((1, 3))]), full_matrices=True)[2]
    made = np.array(cell, np.float64)
    made[free] = basis[3 - len(free) :]
    return made


def source_of(made: Any) -> str:
    """The lines that define a function or class, or nothing where they are not to be had."""
    try:
        return inspect.getsource(made)
    except (OSError, TypeError):
        return ""
