"""Two finished runs followed again: what their folders do not hold, from when they split to what did it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.workflow.fork import Asked, ForkResult, Progress, follow_into_folder, say

if TYPE_CHECKING:
    from mdnum.forks import Fork
    from mdnum.forks.folders import FolderFork


@dataclass(frozen=True)
class _Replay:
    """What stands in place of a choice."""

    about: str = "two finished runs, followed again"
    must_hold: bool = False


def fork_folders(
    a: str | Path,
    b: str | Path,
    *,
    steps: int | None = None,
    split: float | None = None,
    repeats: int | None = None,
    counterfactual: bool = True,
    back: bool | None = None,
    lyapunov: bool | None = None,
    minimal: bool = False,
    pin: str | None = None,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ForkResult:
    """Follow the runs of two run folders again, and judge the flip that parted them.

    The summary says what was different about the runs, and whether the replay met the steps at which the
    stored tables differ: it has their bits where versions and processor are the same.

    Args:
        a, b: run folders of molecular dynamics.
        steps: last step; default the last one that both have.
        split, repeats, counterfactual, back, lyapunov, minimal, pin, out, report, progress: as for
            `mdnum.fork`.

    Raises:
        InputError: the folders hold runs of other systems, or no runs.
        FolderError: a folder holds no run, or the new one cannot be used.
    """
    from mdnum.forks.folders import compare_folders, twin_of

    say(progress, 0, "compare")
    found = compare_folders(a, b)
    last = found.steps if steps is None else min(steps, found.steps)
    options = {
        "steps": last,
        "split": split,
        "repeats": repeats,
        "counterfactual": counterfactual,
        "back": back,
    }

    def further(made: Fork) -> dict[str, Any]:
        return {
            "runs": [str(found.a), str(found.b)],
            "differences": [list(difference) for difference in found.differences],
            "stored": {"steps": found.steps, "seed": found.seed, "fork": found.fork},
            "replayed": _met(found, made),
        }

    say(progress, 0, "compile")
    asked = Asked(lyapunov, minimal, pin)
    return follow_into_folder(
        twin_of(found), "replay", _Replay(), options, asked, further, out, report, progress
    )


def _met(found: FolderFork, made: Fork) -> str:
    """Whether the replay parted where the stored runs did."""
    stored = found.fork if found.fork is not None and found.fork <= made.steps else None
    if stored == made.dates.fork:
        return "the decisions part where the stored ones do"
    return (
        f"the stored decisions part at step {stored}, those of the replay at step {made.dates.fork}: "
        "versions, flags or the processor are not those of the stored runs"
    )
