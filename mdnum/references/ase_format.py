"""Run folders as a format of ASE, which imports this module with its own formats.

It is no part of `ase_plugin`: ASE's plugins import its formats, and that module would be empty then.
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
    """Frames of a run folder, for `ase.io.read(folder, index, format="mdnum")`; in float64 as they were kept.

    Raises:
        FolderError: it is no folder of mdnum's, or its run kept no frames.
    """
    from ase.io.trajectory import read_traj

    from mdnum.errors import FolderError
    from mdnum.store import RunFolder

    path = RunFolder.open(folder).path / "trajectory.traj"
    if not path.exists():
        raise FolderError("holds no frames", where=str(folder), remedy="Run it with --save-every K")
    yield from cast("Iterator[Atoms]", read_traj(path, index))
