"""Storage of a sweep's points: one folder per point, named by a hash.

    sweep/
      .signac/config                  a signac workspace
      workspace/ADDRESS/
        signac_statepoint.json        every number and choice that defines the point
        point.json                    its results, or the reason why there are none
        series.parquet                values at each step
      claims/ADDRESS.N                the process that is computing it

The address (folder name) of a point is the MD5 hash of its state point, as in signac. A point is computed in
a temporary folder, which is then renamed. A killed process therefore leaves no partial result. To claim a
point, a process creates a file with O_EXCL. Only one process succeeds. If the process ends without a result,
another process creates the next claim file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from mdnum.errors import FolderError
from mdnum.plain import plain
from mdnum.provenance import package_versions
from mdnum.store.files import disk_errors, write_text
from mdnum.systems.toml import flat

STATE_POINT, RESULT = "signac_statepoint.json", "point.json"
#: Seconds between updates of a claim file, and seconds without an update after which a process on another
#: machine is assumed to have ended.
_ALIVE, _GONE = 20.0, 180.0
_CLAIM = re.compile(r"(?P<address>[0-9a-f]{32})\.(?P<number>\d+)")
#: Source files on which the results of points and measures depend; comparison and display do not affect them.
_COMPUTES = (
    "compiled.py", "vectors.py", "bits.py", "numerics/**/*.py", "md/*.py", "ball/*.py", "systems/*.py",
    "rollout/*.py", "sweeps/measures.py",
)  # fmt: skip
#: Packages whose versions affect the results of a point.
_ARITHMETIC = ("jax", "jaxlib", "numpy", "llvmlite")


@cache
def code(everywhere: bool = False) -> str:
    """Return a digest of the source code that computes points, and of the versions of numerical packages.

    Args:
        everywhere: whether to include all source code of mdnum.
    """
    versions = package_versions()
    packages = json.dumps([versions.get(name) for name in _ARITHMETIC])
    return hashlib.sha256(
        (digest(("**/*.py",) if everywhere else _COMPUTES) + packages).encode()
    ).hexdigest()[:16]


def digest(places: Sequence[str]) -> str:
    """Return a digest (hash) of the names and contents of source files.

    Args:
        places: patterns of files of mdnum, or absolute paths.
    """
    found, root = hashlib.sha256(), Path(__file__).parents[1]
    files = [[Path(one)] if Path(one).is_absolute() else root.glob(one) for one in places]
    for file in sorted(chain(*files)):
        name = file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name
        found.update(name.encode() + b"\0" + file.read_bytes())
    return found.hexdigest()[:16]


def state_point(
    program: Mapping[str, Any], structure: str | None, asked: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the state point: the parameters of system, structure and run that define a point.

    Args:
        program: the program of a system (`System.program`); entries that are None are omitted. structure:
            digest of the atoms. asked: further data that determine the results, such as the last step.
    """
    numbers = _given(plain(dict(program)))
    return plain({"system": numbers, "structure": structure, "asked": dict(asked), "code": code()})


def _given(tables: Any) -> Any:
    """Remove entries that are None. Replace dots in keys by "-", as signac allows no dots."""
    if not isinstance(tables, dict):
        return tables
    return {key.replace(".", "-"): _given(one) for key, one in tables.items() if one is not None}


def address_of(point: Mapping[str, Any]) -> str:
    """Return the address of a state point, which is its identifier in signac."""
    return hashlib.md5(json.dumps(point, sort_keys=True).encode(), usedforsecurity=False).hexdigest()


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the names of the fields in which two state points differ."""
    a, b = (flat({**point, **point.get("system", {}), "system": {}}) for point in (one, other))
    return [name for name in {**a, **b} if a.get(name) != b.get(name)]


class Workspace:
    """Folder with the results of the points of one or several sweeps.

    Raises:
        FolderError: the folder cannot be created or read.
    """

    def __init__(self, root: Path):
        self.root, self.place = root, root / "workspace"
        # a folder of their own: one of ten thousand points takes long to list
        self._held = root / "claims"
        with disk_errors(root):
            self.place.mkdir(parents=True, exist_ok=True)
            self._held.mkdir(exist_ok=True)
            (root / ".signac").mkdir(exist_ok=True)
            if not (config := root / ".signac" / "config").exists():
                write_text(config, 'schema_version = "2"\n')

    def folder(self, address: str) -> Path:
        """Return the path of the folder with the results of a point."""
        return self.place / address

    def result(self, address: str) -> dict[str, Any] | None:
        """Return the stored result of a point. None if the point was not computed yet.

        Raises:
            FolderError: the file with the result is damaged.
        """
        file = self.folder(address) / RESULT
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            message = f"the file is not the result of a point: {error}"
            raise FolderError(
                message, where=str(file), remedy="Delete the folder of the file, then repeat the sweep"
            ) from None

    def nearest(self, point: Mapping[str, Any]) -> list[str] | None:
        """Return the fields in which a point differs from the most similar stored point, or None."""
        best: list[str] | None = None
        for file in self.place.glob(f"*/{STATE_POINT}"):
            with suppress(OSError, ValueError):
                fields = differing(json.loads(file.read_text(encoding="utf-8")), point)
                best = fields if best is None or len(fields) < len(best) else best
        return best

    # --- claims -------------------------------------------------------------------------------------------

    def claims(self, address: str = "*") -> list[tuple[Path, int]]:
        """Return the claim files of one point or of all points, in the order of claim numbers."""
        found = [(file, _CLAIM.fullmatch(file.name)) for file in self._held.glob(f"{address}.*")]
        numbered = [(file, int(match["number"])) for file, match in found if match]
        return sorted(numbered, key=lambda one: (one[0].stem, one[1]))

    @contextmanager
    def claimed(self, address: str) -> Iterator[bool]:
        """Context manager: claim a point for this process. Yield whether the claim succeeded.

        After a claim, check again for a result. Another process may have finished the point.
        """
        claim = self._claim(address)
        if claim is None:
            yield False
            return
        ended = threading.Event()

        def alive() -> None:
            while not ended.wait(_ALIVE):
                with suppress(OSError):
                    os.utime(claim)

        threading.Thread(target=alive, daemon=True).start()
        try:
            yield True
        finally:
            ended.set()
            self._release(claim)

    def _claim(self, address: str) -> Path | None:
        held = self.claims(address)
        if held and not gone(held[-1][0]):
            return None
        claim = self._held / f"{address}.{held[-1][1] + 1 if held else 0}"
        with disk_errors(claim):
            try:
                number = os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
            except FileExistsError:
                return None
            try:
                with os.fdopen(number, "w", encoding="utf-8") as opened:
                    json.dump(me(), opened)
            except OSError:
                # a full disk has room for a name and none for what is in the file
                claim.unlink()
                raise
        return claim

    def _release(self, claim: Path) -> None:
        # the own one last: another process that finds none left may begin. A later one is of a process that
        # took this one for gone
        address, number = claim.stem, int(claim.suffix[1:])
        for file, earlier in self.claims(address):
            if earlier <= number:
                file.unlink(missing_ok=True)

    # --- results ------------------------------------------------------------------------------------------

    @contextmanager
    def filling(self, address: str, point: Mapping[str, Any]) -> Iterator[Path]:
        """Yield an empty folder. The folder is kept for the point if the `with` block raises no error."""
        here = self.place / f".{address}.{socket.gethostname()}.{os.getpid()}"
        shutil.rmtree(here, ignore_errors=True)
        with disk_errors(here):
            here.mkdir()
            try:
                yield here
                write_text(here / STATE_POINT, json.dumps(point))
                self._publish(here, self.folder(address))
            finally:
                shutil.rmtree(here, ignore_errors=True)

    def _publish(self, made: Path, target: Path) -> None:
        try:
            made.rename(target)
            return
        except OSError:
            if not target.is_dir():
                raise
        # it is there already: measured again, or by somebody whose claim had been given up; results come last
        for file in sorted(made.iterdir(), key=lambda file: file.name == RESULT):
            if not file.is_dir():
                os.replace(file, target / file.name)

    def swept(self) -> int:
        """Remove unfinished folders of ended processes. Return the number of folders."""
        count = 0
        # folders before claims: whoever makes a folder has claimed its point before
        for folder in [one for one in self.place.glob(".*.*.*") if one.is_dir()]:
            if all(gone(claim) for claim, _ in self.claims(folder.name[1:33])):
                shutil.rmtree(folder, ignore_errors=True)
                count += 1
        return count


def write_result(folder: Path, found: Mapping[str, Any]) -> None:
    """Write the results of a point to the file point.json in its folder."""
    write_text(folder / RESULT, json.dumps(plain(dict(found)), indent=1))


# --- who is alive ------------------------------------------------------------------------------------------


def me() -> dict[str, Any]:
    """Return the data of this process in claim files: host, boot, process ID and start time."""
    pid = os.getpid()
    return {"host": socket.gethostname(), "boot": boot(), "pid": pid, "since": born(pid), "at": time.time()}


@cache
def boot() -> str:
    """Return the identifier of this machine's boot. Empty if there is no identifier."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def born(pid: int) -> str | None:
    """Return the start time of a local process in ticks. None for no process, "" for an unknown time."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:
        pass
    with suppress(OSError, IndexError):
        # the name in parentheses may hold anything
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
        # one that was killed has its number until whoever started it looks
        return None if stat.split()[0] in "ZX" else stat.split()[19]
    return ""


def gone(claim: Path) -> bool:
    """True if the process of a claim has ended, or its machine was restarted.

    A process on another machine counts as ended if its claim is older than three minutes.
    """
    try:
        silent = time.time() - claim.stat().st_mtime
        who = json.loads(claim.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return True
    except (OSError, ValueError):
        # killed between the two lines that make it
        return silent > _GONE
    if who["host"] == socket.gethostname():
        return who["boot"] != boot() or born(who["pid"]) != who["since"]
    return silent > _GONE
