"""The ASE file format "mdnum" for run folders.

The format is not in `ase_plugin`, because ASE imports formats while `ase_plugin` is still empty.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, cast

from ase.utils.plugins import ExternalIOFormat

if TYPE_CHECKING:
    from ase import Atoms

# ASE lists it among its plugins by itself
ioformat = ExternalIOFormat(desc="Run folder of mdnum", code="+S", module="mdnum.references.ase_format")


def read_mdnum(folder: str, index: Any = -1) -> Iterator[Atoms]:
    """Yield frames of a run folder in float64, for `ase.io.read(folder, index, format="mdnum")`.

    Raises:
        FolderError: the folder is not a run folder of mdnum, or the run stored no frames.
    """
    from ase.io.trajectory import read_traj

    from mdnum.errors import FolderError
    from mdnum.store import RunFolder

    path = RunFolder.open(folder).path / "trajectory.traj"
    if not path.exists():
        raise FolderError("the run stored no frames", where=str(folder), remedy="Run it with --save-every K")
    yield from cast("Iterator[Atoms]", read_traj(path, index))
