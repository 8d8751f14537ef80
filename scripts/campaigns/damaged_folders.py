"""How does mdnum treat a damaged folder? Folders are damaged at random and read; a table lists the results.

Answer. Of 280 damaged folders, 160 are rejected with a one-line error, 11 are read with a warning, and 109
give unchanged results; no folder gives other numbers without a warning (docs/hostile-input.md). It takes
minutes.

    python scripts/campaigns/damaged_folders.py                      300 damages, some minutes
    python scripts/campaigns/damaged_folders.py --damages 30 --kinds finished,killed

A folder of each verb is made once, tiny. Every damage is done to a fresh copy; for a quarter of them the
manifest is given the digest of the damaged file, as somebody would who wants it to be read. Then one command
reads the copy.

How to read it. Every damage has to end in one of the first four columns: refused in one line that names the
fault; read, with a line that says so; read with the same result as the whole folder's, to the last digit; or
with another result where the manifest has the digest of the damaged file. A traceback, other numbers without
a word, or anything changed outside of the folder is a mistake of mdnum, and the script ends with 1. What is
drawn depends on the seed alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from _cases import called, counted
from _output import parser, say, start

import mdnum
from mdnum.errors import FolderError
from mdnum.report import drawing
from mdnum.store import RunFolder
from mdnum.store import files as manifest

OUTCOMES = ("one line", "said, rest read", "same result", "another result", "SILENT", "TRACEBACK", "OUTSIDE")
MISTAKES = OUTCOMES[4:]
SYSTEM = "argon/crystal-108"
STEPS = 40
#: What a person's clock has a part in.
_TIMES = re.compile(r'"(seconds|steps_per_second|start_up_seconds|build_ms|report|folder)": [^,\n]+')


class _Stopped(BaseException):
    """In the place of a kill."""


# --- folders ----------------------------------------------------------------------------------------


def _run(path: Path, seed: int = 1, stop: bool = False) -> None:
    """A run of molecular dynamics; stopped half-way, what it leaves is what a killed one leaves."""

    def watch(step: int, steps: int, info: dict) -> None:
        if stop and info["phase"] == "run" and step > STEPS // 2:
            raise _Stopped

    due, RunFolder.checkpoint_due = RunFolder.checkpoint_due, lambda self: True
    try:
        with contextlib.suppress(_Stopped):
            mdnum.run(
                SYSTEM, out=path, steps=STEPS, save_every=10,
                overrides={
                    "dynamics.seed": seed, "neighbors.rebuild.check": False, "neighbors.rebuild.every": 5,
                },
                check=False, report=False, progress=watch,
            )  # fmt: skip
    finally:
        RunFolder.checkpoint_due = due


def _fork(path: Path) -> None:
    mdnum.fork(SYSTEM, vary="reduction", steps=20, repeats=4, out=path, report=False)


def _grad(path: Path) -> None:
    mdnum.grad("pair/leaving-well", of="potential", wrt="potential.epsilon", steps=40, out=path, report=False)


def _ball(path: Path, height: float = 1.0) -> None:
    mdnum.bounce("ball/drop", steps=60, overrides={"start.height": height}, out=path, report=False)


def _flips(path: Path) -> None:
    mdnum.flips(path.parent / "finished" / "trajectory.traj", cutoffs=[4.0], out=path, report=False)


def _audit(path: Path) -> None:
    from ase.build import bulk
    from ase.calculators.emt import EMT

    mdnum.audit_calculator(EMT, bulk("Cu", cubic=True) * 2, checks="invariance", out=path, report=False)


def _conform(path: Path) -> None:
    mdnum.conform("ase", cases=3, large=False, out=path, report=False)


def _killed_audit(path: Path) -> None:
    """An audit that is stopped before its second check."""
    from ase.build import bulk

    def watch(done: int, total: int, info: dict) -> None:
        if info["phase"] == "curl":
            raise _Stopped

    with contextlib.suppress(_Stopped):
        mdnum.audit_calculator(
            "ase.calculators.emt:EMT", bulk("Cu", cubic=True), checks="forces,curl", out=path,
            report=False, progress=watch,
        )  # fmt: skip


def _killed_conform(path: Path) -> None:
    """An examination that is stopped at half of its questions."""

    def watch(done: int, total: int, info: dict) -> None:
        if 2 * done > total:
            raise _Stopped

    with contextlib.suppress(_Stopped):
        mdnum.conform(
            "ase", cases=3, large=False, limits=("minimum-image", "orthorhombic", "all-axes"), out=path,
            report=False, progress=watch,
        )  # fmt: skip


#: What makes a folder, by kind.
KINDS: dict[str, Callable[[Path], None]] = {
    "finished": _run,
    "killed": lambda path: _run(path, stop=True),
    "ball": _ball,
    "fork": _fork,
    "grad": _grad,
    "flips": _flips,
    "audit": _audit,
    "conform": _conform,
    "killed audit": _killed_audit,
    "killed conform": _killed_conform,
}


def readers(kind: str) -> tuple[tuple[str, ...], ...]:
    """The commands that read a folder of a kind; "folder" and "other" stand for it and one like it."""
    report, fork = ("report", "folder"), ("fork", "compare", "folder", "other", "--json")
    resume = ("run", "--resume", "folder", "--no-check", "--no-report")
    return {
        "finished": (
            report, resume, (*resume, "--steps", str(STEPS + 10)), fork,
            ("flips", "folder", "--cutoff", "4.0", "-o", "new", "--no-report"),
        ),
        "killed": (
            report, resume, fork,
        ),
        "ball": (report, fork),
        # resumed twice as often as read
        "killed audit": (report, *2 * (("audit", "--resume", "folder", "--no-report"),)),
        "killed conform": (report, *2 * (("conform", "--resume", "folder", "--no-report"),)),
    }.get(kind, (report,))  # fmt: skip


# --- damages ----------------------------------------------------------------------------------------


def _flip(path: Path, other: Path, rng: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def _cut(path: Path, other: Path, rng: np.random.Generator) -> None:
    path.write_bytes(path.read_bytes()[: int(rng.integers(path.stat().st_size))])


def _zero(path: Path, other: Path, rng: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    first = int(rng.integers(len(data)))
    size = min(len(data) - first, int(rng.integers(1, 513)))
    data[first : first + size] = bytes(size)
    path.write_bytes(data)


def _swap(path: Path, other: Path, rng: np.random.Generator) -> None:
    like = [
        each
        for each in path.parent.iterdir()
        if each.suffix == path.suffix and each != path and each.is_file()
    ]
    if like:
        second = like[rng.integers(len(like))]
        one, two = path.read_bytes(), second.read_bytes()
        path.write_bytes(two)
        second.write_bytes(one)
    else:
        _cut(path, other, rng)


def _exchange(path: Path, other: Path, rng: np.random.Generator) -> None:
    """The file of that name of another run."""
    if other.is_file():
        shutil.copyfile(other, path)
    else:
        _flip(path, other, rng)


def _shape(path: Path, other: Path, rng: np.random.Generator) -> None:
    texts = (
        "[]", "3", "null", '{"findings": 5, "status": [], "world": {}}', "[" * 50_000, "\x00\x1b[31m", "",
        '{"files": {"../../x": ["a"]}}', '{"rows": -1}',
    )  # fmt: skip
    path.write_text(texts[rng.integers(len(texts))])


def _bytes(path: Path, other: Path, rng: np.random.Generator) -> None:
    path.write_bytes(rng.bytes(int(rng.integers(1, 4000))))


def _columns(path: Path, other: Path, rng: np.random.Generator) -> None:
    """A parquet file with other columns, or columns of another type."""
    held = pq.read_table(path)
    which = int(rng.integers(4))
    if which == 0 or not held.num_columns:
        held = pa.table({"foreign": [1, 2, 3]})
    elif which == 1:
        held = held.rename_columns([f"{name}_" for name in held.column_names])
    elif which == 2:
        held = held.set_column(0, held.column_names[0], pa.array([f"{k}" for k in range(held.num_rows)]))
    else:
        held = held.drop_columns([held.column_names[rng.integers(held.num_columns)]])
    pq.write_table(held, path)


def _beside(path: Path) -> Path:
    """A place outside of the folder of a file."""
    folder = path.parents[1 if path.parent.name == "parts" else 0]
    return folder.parent / f"outside-{path.name}"


def _link(path: Path, other: Path, rng: np.random.Generator) -> None:
    shutil.move(path, kept := _beside(path))
    os.symlink(kept, path)


def _second_name(path: Path, other: Path, rng: np.random.Generator) -> None:
    os.link(path, _beside(path))


def _gone(path: Path, other: Path, rng: np.random.Generator) -> None:
    path.unlink()


def _archive(path: Path, other: Path, rng: np.random.Generator) -> None:
    """A checkpoint that names files elsewhere, or unpacks to far more than itself."""
    with np.load(path) as held:
        members: dict[str, Any] = {name: held[name] for name in held.files}
    which = int(rng.integers(3))
    if which == 0:
        store = json.loads(str(members["mdnum store"]))
        store["rows"]["../outside/precious"] = 0
        members["mdnum store"] = np.array(json.dumps(store))
        np.savez(path, allow_pickle=False, **members)
    elif which == 1:
        members["large"] = np.zeros(1 << 24)
        np.savez_compressed(path, allow_pickle=False, **members)
    else:
        with zipfile.ZipFile(path) as held:
            files = {one.filename: held.read(one) for one in held.infolist()}
        name = next(iter(files))
        files[name] = re.sub(rb"\((\d+)", rb"(99999999999999", files[name], count=1)
        with zipfile.ZipFile(path, "w") as made:
            for each, data in files.items():
                made.writestr(each, data)


#: What is done to a file, and the names of files it is for.
DAMAGES: dict[str, tuple[Callable[[Path, Path, np.random.Generator], None], str]] = {
    "bit flipped": (_flip, ""),
    "cut short": (_cut, ""),
    "block zeroed": (_zero, ""),
    "random bytes": (_bytes, ""),
    "swapped": (_swap, ""),
    "another run's": (_exchange, ""),
    "other JSON": (_shape, r"\.json$"),
    "other columns": (_columns, r"\.parquet$"),
    "other archive": (_archive, r"checkpoint\.npz$"),
    "link": (_link, ""),
    "second name": (_second_name, ""),
    "deleted": (_gone, ""),
}


# --- reading ----------------------------------------------------------------------------------------


def result(folder: Path, words: tuple[str, ...], out: str) -> dict[str, object]:
    """What a command made of a folder, without what depends on the clock."""
    made: dict[str, object] = {}
    if words[0] == "report":
        made["page"] = (folder / "report.html").read_text()
        made["summary"] = _TIMES.sub("", (folder / "summary.json").read_text())
    elif "--json" in words:
        made["out"] = _TIMES.sub("", out)
    else:
        where = folder if "--resume" in words else folder.parent / "new"
        if words[0] in ("audit", "conform"):
            made["summary"] = _TIMES.sub("", (folder / "summary.json").read_text())
        for path in sorted(where.glob("*.parquet")):
            held = pq.read_table(path)
            kept = [name for name in held.column_names if name != "build_ms"]
            made[path.name] = held.select(kept).to_pydict().__repr__()
        if words[0] == "run" and (folder / "trajectory.traj").exists():
            made["frames"] = (folder / "trajectory.traj").read_bytes()
    return made


def _outside(place: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in place.glob("outside*") if path.is_file()}


class Campaign:
    """Whole folders, what each command makes of them, and damages done to copies.

    Args:
        root: an empty folder to work in.
        kinds: keys of `KINDS`.
    """

    def __init__(self, root: Path, kinds: tuple[str, ...]):
        self.root, self.kinds = root, kinds
        needed = ("finished", *kinds) if "flips" in kinds else kinds
        for kind in dict.fromkeys(needed):
            say(f"a folder of {kind}")
            KINDS[kind](root / kind)
        if {"finished", "killed"} & set(kinds):
            _run(root / "other-run", seed=2)
        if "ball" in kinds:
            _ball(root / "other-ball", height=1.5)
        self.expected: dict[tuple[str, ...], dict[str, object]] = {}

    def other(self, kind: str) -> Path:
        """A whole folder like one of a kind."""
        return self.root / {"finished": "other-run", "killed": "other-run", "ball": "other-ball"}.get(
            kind, kind
        )

    def read(self, kind: str, words: tuple[str, ...], harm: Callable[[Path], None] | None = None):
        """(exit code, stderr, result, what was outside before and after) of a command on a copy."""
        with tempfile.TemporaryDirectory(dir=self.root) as name:
            place = Path(name)
            folder = place / "folder"
            shutil.copytree(self.root / kind, folder)
            shutil.copytree(self.other(kind), place / "other")
            if harm is not None:
                harm(folder)
            before = _outside(place)
            with contextlib.chdir(place):
                code, out, errors = called(words)
            made = result(folder, words, out) if code in (0, 1) else {}
            return code, errors, made, before == _outside(place)

    def one(self, rng: np.random.Generator) -> dict[str, object]:
        """A damage drawn at random, and what came of it."""
        kind = self.kinds[rng.integers(len(self.kinds))]
        damage = list(DAMAGES)[rng.integers(len(DAMAGES))]
        do, names = DAMAGES[damage]
        root = self.root / kind
        files = [path.relative_to(root) for path in sorted(root.rglob("*")) if path.is_file()]
        files = [path for path in files if re.search(names, str(path)) and (root / path).stat().st_size]
        unread = {".lock", "report.html", "figures"}
        files = [path for path in files if not unread & {path.name, path.parts[0]}]
        if not files:
            return self.one(rng)
        file = files[rng.integers(len(files))]
        words = readers(kind)[rng.integers(len(readers(kind)))]
        listed = not (file.name != "manifest.json" and rng.random() < 0.25)
        seed = int(rng.integers(2**32))

        def harm(folder: Path) -> None:
            do(folder / file, self.other(kind) / file, np.random.default_rng(seed))
            if not listed:
                with contextlib.suppress(FolderError):
                    manifest.update(folder, {str(file): [manifest.digest(folder / file)]})

        key = (kind, *words)
        if key not in self.expected:
            code, errors, made, _ = self.read(kind, words)
            if code not in (0, 1):
                raise RuntimeError(f"{key} on the whole folder: {errors}")
            self.expected[key] = made
        code, errors, made, kept = self.read(kind, words, harm)
        lines = [line for line in errors.splitlines() if line.startswith("mdnum: ")]
        lines = [line for line in lines if not re.search(r"\(\d+ s\)$", line)]
        if not kept:
            outcome = "OUTSIDE"
        elif code is None:
            outcome = "TRACEBACK"
        elif code not in (0, 1):
            outcome = "one line" if len(lines) == 1 else "TRACEBACK"
        elif made == self.expected[key]:
            outcome = "same result"
        elif not listed:
            outcome = "another result"
        elif any(file.name in line or "manifest.json" in line for line in lines):
            outcome = "said, rest read"
        else:
            outcome = "SILENT"
        return {
            "kind": kind, "damage": damage, "file": str(file), "listed": listed, "command": " ".join(words),
            "outcome": outcome, "said": errors[-2000:] if outcome in MISTAKES else " ".join(lines),
        }  # fmt: skip


def campaign(root: Path, kinds: tuple[str, ...], damages: int, seed: int = 0) -> list[dict[str, object]]:
    """A row for each of so many damages to folders of these kinds.

    Args:
        root: an empty folder to work in.
    """
    # figures are drawn, and not written: that takes most of the time, and nothing is read from them
    written, drawing.markup = drawing.markup, lambda figure, name: f'<svg viewBox="0 0 1 1">{name}</svg>'
    try:
        return _rows(Campaign(root, kinds), damages, seed)
    finally:
        drawing.markup = written


def _rows(made: Campaign, damages: int, seed: int) -> list[dict[str, object]]:
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(damages):
        rows.append(made.one(rng))
        if number % 25 == 24:
            say(f"{number + 1} of {damages}")
    return rows


def main() -> None:
    """The campaign from the command line."""
    command_line = parser(__doc__)
    command_line.add_argument("--damages", type=int, default=300, metavar="N", help="how many (default 300)")
    command_line.add_argument("--seed", type=int, default=0, help="what they are drawn with (default 0)")
    command_line.add_argument(
        "--kinds", default=",".join(KINDS), metavar="K,K", help=f"of {', '.join(KINDS)} (default all)"
    )
    command_line.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="every damage as JSON, a line each"
    )
    asked = command_line.parse_args()
    with tempfile.TemporaryDirectory() as root:
        rows = campaign(Path(root), tuple(asked.kinds.split(",")), asked.damages, asked.seed)
    if asked.output is not None:
        asked.output.write_text("".join(json.dumps(row) + "\n" for row in rows))
    for by in ("damage", "kind"):
        print(counted(by, OUTCOMES, [(str(row[by]), str(row["outcome"])) for row in rows]) + "\n")
    for row in rows:
        if row["outcome"] in MISTAKES:
            say(json.dumps(row, indent=1))
    sys.exit(any(row["outcome"] in MISTAKES for row in rows))


if __name__ == "__main__":
    start(main)
