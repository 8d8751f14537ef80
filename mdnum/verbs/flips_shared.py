"""Functions shared by `mdnum flips` of one and of two trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.report.finding import Finding, Texts
from mdnum.report.words import count, listed, number, plain
from mdnum.store import RunFolder
from mdnum.store.tables import together
from mdnum.verbs.frame import Progress, View, asked_to_stop

if TYPE_CHECKING:
    from mdnum.trajectories.tracker import Groups
    from mdnum.trajectories.trajectory import Trajectory

# rows that wait to be handed over together: a call costs more than many rows; and how many a part of a table
# counts for, each of whose columns is an array
_ROWS_HELD, _PART = 100_000, 30
# stretches of repeated frames that are named
_RANGES = 6
# share of the frames without motion that does not matter much
_SHARE = 0.02
TEXTS = Texts(Path(__file__).with_name("flips.py"))


def selected(trajectory: Trajectory, between: tuple[str, str] | None) -> Groups:
    """Return the atom indices of the two selections (None for all atoms)."""
    from mdnum.trajectories.selection import select

    first, second = (None, None) if between is None else (select(trajectory, one) for one in between)
    return first, second


def stem(trajectory: Trajectory) -> str:
    """Return the first part of the default name of an output folder."""
    name = trajectory.path.name.split(".")[0]
    return trajectory.path.resolve().parent.name if name == "trajectory" else name


def name_of(trajectory: Trajectory) -> str:
    """Return the name of a trajectory for a page: the file, or the folder of the mdnum run."""
    own = trajectory.path.name == "trajectory.traj"
    name = trajectory.path.resolve().parent.name if own else trajectory.path.name
    return f"{name}@{trajectory.slice_words}" if trajectory.slice_words else name


def about(trajectory: Trajectory, question: str, between: tuple[str, str] | None) -> dict[str, Any]:
    """Return the entries of summary.json that describe a trajectory file."""
    return {
        "world": "flips", "question": question, "system": name_of(trajectory), "file": str(trajectory.path),
        **{name: getattr(trajectory, name) for name in ("format", "reader", "atoms", "length", "time")},
        "slice": trajectory.slice_words, "between": between, "notes": trajectory.notes,
        **({"in_memory": True} if trajectory.in_memory else {}),
    }  # fmt: skip


def in_python(text: str) -> str:
    """Replace command-line options in a sentence by their Python equivalents: cutoffs=R, array[:9]."""

    def named(option: re.Match[str]) -> str:
        name = {"cutoff": "cutoffs"}.get(option[1], option[1].replace("-", "_"))
        return f"{name}={option[2]}" if option[2] else name

    return re.sub(
        r"@([A-Z0-9]*:[A-Z0-9:]*)", r"array[\1]", re.sub(r'--([a-z-]+)(?: ([A-Z]\b|"\S+"))?', named, text)
    )


@contextmanager
def as_python(in_memory: bool) -> Iterator[None]:
    """In error messages, replace command-line options by Python arguments."""
    try:
        yield
    except InputError as error:
        if in_memory:
            error.args, error.remedy = (in_python(str(error)),), error.remedy and in_python(error.remedy)
        raise


def ending(stopped: InputError | None, interrupted: bool, in_memory: bool = False) -> dict[str, Any]:
    """Return summary entries: whether all frames were read, and the error if not."""
    told = None if stopped is None else str(stopped)
    return {
        "stopped": in_python(told) if told and in_memory else told,
        "interrupted": interrupted,
        "status": "stopped" if stopped is not None or interrupted else "complete",
    }


class HeldRows:
    """Buffer of table rows. The rows of many frames are written together."""

    def __init__(self, trajectory: Trajectory) -> None:
        units = {"length": trajectory.length, "decision": trajectory.length, "time": trajectory.time}
        # what the schemas of the tables say
        self._told = {"system": name_of(trajectory), "units": units}
        #: by table, since they were handed over
        self.held: dict[str, list[dict[str, np.ndarray]]] = {}
        self._count = self.flips = 0

    def add(self, table: str, columns: dict[str, np.ndarray]) -> None:
        """Add rows to a table, given as columns of equal length."""
        self.held.setdefault(table, []).append(columns)
        rows = len(next(iter(columns.values())))
        self._count += rows + _PART
        self.flips += rows * (table == "flips")

    def drain(self, folder: RunFolder, passes: Iterator[Any], found: Any, of: int, log: Progress) -> bool:
        """Read frames until the end or until control-C. Return whether control-C was pressed.

        Args:
            passes: iterator with one item per frame, which adds rows.
            found: the current results, with `frames` read so far, and `stopped` if the rest cannot be read.
            of: number of frames, 0 if unknown.
        """
        with asked_to_stop() as stop:
            while True:
                if self.full:
                    self.hand_over(folder)
                counts = {"flips": self.flips} if self.flips else {}
                log(found.frames, of, {"phase": "run", "unit": "frames", **counts})
                if (asked := stop()) or next(passes, None) is None or found.stopped is not None:
                    self.hand_over(folder)
                    folder.merge()
                    return asked

    @property
    def full(self) -> bool:
        """True if the buffer has enough rows to be written."""
        return self._count > _ROWS_HELD

    def hand_over(self, folder: RunFolder) -> None:
        """Append all buffered rows to the tables of the folder."""
        folder.told = self._told
        for table, parts in self.held.items():
            folder.append(table, together(parts))
        self.held, self._count = {}, 0


class FlipsView(View):
    """Read access to a folder of flips, with times and lengths formatted in their units."""

    @property
    def timed(self) -> bool:
        """True if the frames have usable times."""
        return bool(self.summary["timed"] and self.summary["interval"])

    @property
    def by_residue(self) -> bool:
        """True if the pairs are pairs of residues."""
        return self.summary.get("by") == "residue"

    @property
    def one(self) -> str:
        """The object whose neighbors are counted: "a residue" or "an atom"."""
        return "a residue" if self.by_residue else "an atom"

    @property
    def unit(self) -> str:
        """Unit of length of the trajectory."""
        return self.summary["length"]

    @property
    def between(self) -> str | None:
        """The two selections between which pairs were examined. None for all pairs."""
        return " and ".join(f"“{one}”" for one in self.summary["between"] or ()) or None

    def time(self, text: str) -> str:
        """Append the unit of time to a number."""
        unit = self.summary["time"]
        return f"{text} {unit}{'s' if unit == 'step' and text not in ('1', '1.00', '1.0') else ''}"

    def duration(self, frames: float | None, digits: int = 3, beyond: str = "longer than seen") -> str:
        """Format a number of frames as a time, if the frames have times."""
        if frames is None:
            return beyond
        if self.timed:
            return self.time(number(frames * self.summary["interval"], digits))
        return f"{plain(frames, digits)} frame{'' if frames == 1 else 's'}"

    def life(self, one: Mapping[str, Any], name: str = "median", of: str = "lifetime") -> str:
        """Format a contact lifetime: a value, a bound, or why the lifetime is unknown.

        A median lifetime of one frame is only an upper bound. Pairs with shorter lifetimes crossed the cutoff
        several times between frames.
        """
        life = one[of]
        if not one["pairs_most"]:
            return "no contact"
        if self.summary["frames"] < 2:
            return "one frame"
        if not life["leaves" if "rate" in name else "followed"]:
            return "none seen to end" if "rate" in name else "none seen to begin"
        cut = name == "mean" and not life["mean_is_whole"]
        bound = ("about " if cut else "at most ") if life["median"] == 1 else "at least " if cut else ""
        return bound * (life[name] is not None) + self.duration(life[name])

    def rate(self, per_frame: float | None) -> str:
        """Format a rate per time, or per frame if frames have no times. None becomes a dash."""
        if per_frame is None:
            return "–"
        if self.timed:
            return f"{number(per_frame / self.summary['interval'])} per {self.summary['time']}"
        return f"{number(per_frame)} per frame"

    def length(self, value: float | None) -> str:
        """Format a length with its unit."""
        return f"{number(value)} {self.unit}".rstrip()

    def rule(self, one: Mapping[str, Any]) -> str:
        """Format a neighbor rule, such as "r < 8.5 Å"."""
        name = one["rule"]
        return f"{name} {self.unit}" if self.unit and "<" in name and "most" not in name else name

    def box(self, box: Mapping[str, Any]) -> str:
        """Format a box: its lengths, its angles unless all are 90°, and its periodic axes."""
        matrix, axes = np.array(box["matrix"]), repeating(box)
        if not axes:
            return "no box that repeats"
        sizes = np.linalg.norm(matrix, axis=1)
        text = f"{' × '.join(plain(float(one), 9) for one in sizes)} {self.unit}".rstrip()
        with np.errstate(invalid="ignore", divide="ignore"):
            a, b, c = matrix / sizes[:, None]
        angles = np.degrees(np.arccos(np.clip([b @ c, a @ c, a @ b], -1, 1)))
        if np.isfinite(angles).all() and np.abs(angles - 90).max() > 1e-9:
            text += f" at {', '.join(plain(float(one), 7) for one in angles)}°"
        return f"{text}, repeating along {listed(axes)}"

    def repeated(self, repeats: Mapping[str, Any] | None, file: str = "") -> Iterator[Finding]:
        """Yield findings on frames that repeat earlier frames."""
        again = repeats.get("again", ()) if repeats else ()
        if again and repeats and repeats["dropped"]:
            total = sum(one["frames"] for one in again)
            yield TEXTS.finding("TIME_GOES_BACK", "dropped", frames=total, places=listed(self.again(again)))
        if not repeats or not repeats["frames"]:
            return
        ranges, examined = repeats["ranges"], self.summary["frames"]
        still, told = all(one["still"] for one in ranges), []
        for one in ranges[:_RANGES]:
            kind = "one" if one["first"] == one["last"] else "still" if one["still"] else "copy"
            told.append(TEXTS(f"repeats_{kind}", **one))
        if (more := repeats["stretches"] - len(told)) > 0:
            told.append(TEXTS("repeats_more", stretches=more))
        few = repeats["frames"] < _SHARE * examined or (repeats["to_the_end"] and len(ranges) == 1)
        kept = "dropped" if repeats["dropped"] else "unmoved" if still else "kept"
        variants = ["still"] * still + ["few"] * (still and few) + [kept]
        values = {"frames": repeats["frames"], "file": f"{file}: " if file else ""}
        yield TEXTS.finding("REPEATED_FRAMES", *variants, ranges=listed(told), **values)

    def again(self, again: Sequence[Mapping[str, Any]]) -> list[str]:
        """Return a phrase for each group of frames whose times repeat earlier times."""
        kinds = ["one" if one["first"] == one["last"] else "many" for one in again[:_RANGES]]
        times = [{"time": plain(one["time"], 9), "to": self.time(plain(one["to"], 9))} for one in again]
        return [TEXTS(f"again_{kind}", **{**again[k], **times[k]}) for k, kind in enumerate(kinds)]

    def axis(self, rows: Mapping[str, np.ndarray]) -> tuple[str, np.ndarray]:
        """Return the label and the values of an axis: times or frame numbers."""
        if self.timed:
            return f"time ({self.summary['time']})", rows["time"]
        return "frame", rows["frame"]


def average(mean: float) -> str:
    """Format the mean of a count with four significant digits, from 1000 on as an integer."""
    return count(round(mean)) if mean >= 1000 else number(mean, 4)


def repeating(box: Mapping[str, Any]) -> list[str]:
    """Return the axes along which a box is periodic."""
    return [name for name, yes in zip("abc", box["pbc"], strict=True) if yes]


def resolution(kept: Mapping[str, Any], length: str) -> str:
    """Return a phrase on the rounding of positions in a trajectory file."""
    code = kept["kind"]
    if not kept["told"]:
        code = "usual" if kept["step"] else "unknown"
    elif kept["step"]:
        code = "digits" if kept["digits"] else "grid"
    elif code == "float32" and kept["bits"] == 32:
        code = "narrowed"
    unit = "of the box" if kept["kind"] == "fractions" else length
    text = TEXTS(f"resolution_{code}", step=kept["step"], digits=kept["digits"], unit=unit)
    still = kept["told"] and kept["step"] and not kept["moved"]
    return f"{text} {TEXTS('resolution_still')}" if still else text
