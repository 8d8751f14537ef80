"""Whether two folders are finished runs, before anything is read from them; of either world."""

from __future__ import annotations

from mdnum.errors import InputError
from mdnum.store import RunFolder

#: Of `RunFolder.world`, the worlds whose folders hold a run.
_RUNS = ("md", "ball")


def check_runs(*folders: RunFolder) -> None:
    """Refuse the folder of an answered question, which has two runs in it or none.

    Raises:
        InputError: names the folder. FolderError: its system was changed, or it is damaged.
    """
    for folder in folders:
        folder.check_start()
        if folder.summary.get("world") == "fork" or folder.world not in _RUNS:
            raise InputError(
                "this is a fork folder, the answer of `mdnum fork`, and no run",
                where=str(folder.path),
                remedy="Give two folders of `mdnum run` or of `mdnum ball`; `mdnum report DIR` shows a fork",
            )
