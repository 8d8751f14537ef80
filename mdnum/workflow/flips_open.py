"""What looking at one trajectory and at two share: opening files, rules, selections, and the folder."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.store.naming import default_folder
from mdnum.workflow.flips_words import cutoff_of_run, rules

if TYPE_CHECKING:
    from mdnum.trajectories.frame import Frame
    from mdnum.trajectories.resolution import Resolution
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.trajectory import Trajectory
    from mdnum.workflow.flips_record import Groups

#: Frames from which the resolution of a file is read.
SAMPLE = 8
# files that hold positions and nothing on what the atoms are
_BARE = frozenset({"xtc", "trr", "dcd", "nc", "ncdf", "netcdf", "trj", "mdcrd", "crdbox", "trz", "h5md"})


@dataclass(frozen=True)
class FlipsResult:
    """A finished look at a trajectory, or at two.

    Attributes:
        folder: with the ledger (flips.parquet) and everything else.
        summary: what summary.json says, findings included.
    """

    folder: Path
    summary: dict[str, Any]


def source(path: str | Path, topology: str | Path | None, format: str | None) -> Trajectory:
    """The trajectory at a path."""
    from mdnum.trajectories.source import open_trajectory

    return open_trajectory(path, topology, format=format)


def default_rules(trajectory: Trajectory) -> tuple[Rule, ...]:
    """The cutoff with which mdnum made the file.

    Raises:
        InputError: it did not.
    """
    radius = cutoff_of_run(trajectory.path)
    if radius is None:
        unit = f" in {trajectory.length}" if trajectory.length else ""
        raise InputError(
            "no rule says which pairs count",
            remedy=f'Add --cutoff R{unit}, --pairs "O-H=2.5,O-O=3.5" or --nearest K',
            where=str(trajectory.path),
        )
    return rules([radius])


def selected(trajectory: Trajectory, between: tuple[str, str] | None) -> Groups:
    """Indices of the atoms on either side."""
    from mdnum.trajectories.source import select

    if between is None:
        return None, None
    return select(trajectory, between[0]), select(trajectory, between[1])


def new_folder(trajectory: Trajectory, world: str, out: str | Path | None) -> RunFolder:
    """An empty folder, with what was computed with."""
    from mdnum.provenance import surroundings

    stem = trajectory.path.name.split(".")[0]
    if stem == "trajectory":
        # the run folder says more than the name that all of its files have
        stem = trajectory.path.resolve().parent.name
    folder = RunFolder.create(default_folder(f"flips-{stem}") if out is None else out, world=world)
    try:
        folder.write_provenance(surroundings())
    except BaseException:
        folder.close()
        raise
    return folder


def leave(folder: RunFolder) -> None:
    """Closes a folder after a mistake, and takes it away where no frame came into it."""
    folder.close()
    if any((folder.path / "parts").glob("*.parquet")):
        return
    with suppress(OSError):
        for name in ("provenance.json", "log.txt", "manifest.json", ".lock"):
            (folder.path / name).unlink(missing_ok=True)
        folder.path.rmdir()
        # `runs` too, where it was made for this
        if folder.path.parent == Path("runs"):
            folder.path.parent.rmdir()


def sample_of(trajectory: Trajectory) -> list[Frame]:
    """The first frames; fewer where one of them cannot be read.

    Raises:
        InputError: not even the first can be read.
    """
    sample = []
    try:
        for frame in trajectory.frames():
            sample.append(frame)
            if len(sample) == SAMPLE:
                break
    except InputError:
        if not sample:
            raise
    if not sample:
        words, count = _slice_words(trajectory.slice), trajectory.in_file
        of = f" of {count:,}" if count is not None else ""
        raise InputError(
            f"@{words} leaves no frame{of}" if words else "the file holds no frame",
            remedy="Ask for others" if words else "Check how it was written",
            where=str(trajectory.path),
        )
    return sample


def name_of(trajectory: Trajectory) -> str:
    """What a file is called on a page; a run's trajectory by its folder, because all have one name."""
    own = trajectory.path.name == "trajectory.traj"
    name = trajectory.path.resolve().parent.name if own else trajectory.name
    frames = _slice_words(trajectory.slice)
    return f"{name}@{frames}" if frames else name


def about(trajectory: Trajectory, question: str) -> dict[str, Any]:
    """What summary.json says of a file."""
    return {
        "world": "flips",
        "question": question,
        "system": name_of(trajectory),
        "file": str(trajectory.path),
        "format": trajectory.format,
        "reader": trajectory.reader,
        "atoms": trajectory.atoms,
        "length": trajectory.length,
        "time": trajectory.time,
        "slice": _slice_words(trajectory.slice),
        "notes": list(trajectory.notes),
    }


def cut_short(error: InputError | None, trajectory: Trajectory) -> bool:
    """Whether reading stopped at a frame that is not whole, the last of the file as far as that is known."""
    from mdnum.trajectories.frame import UnreadableFrame

    if not isinstance(error, UnreadableFrame):
        return False
    if "the file ends" in error.message:
        return True
    return trajectory.in_file is not None and error.frame >= trajectory.in_file - 1


def told_resolution(resolution: Resolution, trajectory: Trajectory) -> dict[str, Any]:
    """What summary.json says of how finely positions are told."""
    return {
        "kind": resolution.kind,
        "step": resolution.step,
        "moved": resolution.moved,
        "words": resolution.words(trajectory.length),
    }


def _slice_words(frames: slice) -> str:
    if frames == slice(None):
        return ""
    ends = [frames.start, frames.stop, *([] if frames.step in (None, 1) else [frames.step])]
    return ":".join("" if end is None else str(end) for end in ends)


def refuse_topology_first(first: str | Path, second: str | Path, topology: str | Path | None) -> None:
    """Refuses "TOPOLOGY TRAJECTORY", the order that other programs have."""
    suffixes = [str(one).rpartition("@")[0] or str(one) for one in (first, second)]
    bare = [Path(one).suffix.lower().lstrip(".") in _BARE for one in suffixes]
    if topology is None and not bare[0] and bare[1]:
        raise InputError(
            f"two paths are two trajectories to compare, and {Path(suffixes[0]).name} looks like the "
            "topology of "
            f"{Path(suffixes[1]).name}",
            remedy=f"Write mdnum flips {second} -s {first}",
        )
