"""Are points of a sweep lost, computed twice or left incomplete if workers, schedulers or sweeps are killed?

Answer. No. Seven workers, 23 dask workers, eleven sweeps and twelve schedulers were killed and the disk was
filled nine times while about 730 of 1,000 points were computed; the other points were computed without
disturbance (seed 1, a mean pause of 3 s). No point was lost, incomplete or computed twice, and 14 points were
started again because their process had been killed or the disk was full. It takes minutes.

    python scripts/campaigns/killed_sweeps.py --pause 3          1,000 points, minutes
    python scripts/campaigns/killed_sweeps.py --points 20 --kills 4 --pause 2
    python scripts/campaigns/killed_sweeps.py --defect rename    has to find what is wrong, and ends with 1

Two sweeps of the same points share one folder, on a disk of 64 MB where this may mount one: one computes
with processes of its own, the other with a dask scheduler and two workers. At times and in an order that the
seed decides a worker of either, the scheduler or a sweep is killed (SIGKILL), or the disk is filled for two
seconds. What has ended is started again until both sweeps end well. The points are runs of mdnum but for the
run itself, in place of which a function here notes that it begins, writes a constant series of the seed and
the time step in two halves, and notes that it ends.

How to read it. An oracle that reads the folder without mdnum's code expects each pair of seed and time step
once, under signac's name of its state point, with a whole series and the value that belongs to it. A point
is computed twice without a reason where it begins although it is there, or although a process that lives is
at work on it. With `--defect` something is broken on purpose: claims without O_EXCL ("claim"), results
written where they will be found ("rename"), or a claim whose process is told by its number alone ("number").
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from _output import parser, say, start, table

SYSTEM = "pair/leaving-well"
TIMESTEPS = (0.001, 0.0011, 0.0012, 0.0013)
STEPS, ATOMS, DISK = 20, 2, "64m"
DEFECTS = ("claim", "rename", "number")


def value(seed: int, timestep: float) -> float:
    """The potential energy that a point's series holds at every step."""
    return seed + 1000 * timestep


# --- in the processes that are killed ----------------------------------------------------------------------


def born(pid: int) -> str:
    """When a process that lives was started; empty where it does not."""
    with contextlib.suppress(OSError):
        state, *rest = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return "" if state in "ZX" else rest[18]
    return ""


def note(journal: Path, address: str, word: str) -> list[list[str]]:
    """Adds a line to what is known of a point, and reads all of it."""
    with (journal / address).open("a+") as file:
        file.write(f"{word} {os.getpid()} {born(os.getpid())} {time.time()}\n")
        file.flush()
        file.seek(0)
        return [line.split() for line in file]


def quick(journal: Path, task: Any, point: Any, folder: Path) -> Any:
    """In place of a run: a constant series, written in two halves."""
    from mdnum.sweeps.measures import Sample

    address = point["address"]
    known = note(journal, address, "begin")[:-1]
    if (Path(task.workspace) / "workspace" / address / "point.json").exists():
        note(journal, address, "THERE")
    ended = {(pid, since) for word, pid, since, _ in known if word == "end"}
    for word, pid, since, _ in known:
        running = word == "begin" and (pid, since) not in ended and born(int(pid)) == since
        if running and int(pid) != os.getpid():
            note(journal, address, "BOTH")
    system = point["state"]["system"]["dynamics"]
    rows, found = STEPS + 1, value(system["seed"], system["timestep"])
    columns = {name: np.full(rows, found) for name in ("potential", "kinetic", "conserved")}
    columns |= {"step": np.arange(rows), "time": np.arange(rows) * system["timestep"]}
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink)
    data = sink.getvalue().to_pybytes()
    with (folder / "series.parquet").open("wb") as file:
        file.write(data[: len(data) // 2])
        file.flush()
        time.sleep(0.02)
        file.write(data[len(data) // 2 :])
    note(journal, address, "end")
    summary = {"atoms": ATOMS, "steps": STEPS, "steps_per_second": 1.0, "lost_pairs": 0, "flips_entered": 0}
    return Sample(columns, summary, ATOMS, 1.0, folder)


def worker(task: Any, journal: str, defect: str) -> Any:
    """Work as mdnum has it, with a quick run, and whatever is to be wrong."""
    from mdnum.sweeps import points
    from mdnum.verbs import sweep_worker

    sweep_worker._run = lambda *asked: quick(Path(journal), *asked)
    if defect == "claim":

        def claimed(self: Any, address: str) -> Path | None:
            held = self.claims(address)
            if held and not points.gone(held[-1][0]):
                return None
            time.sleep(0.02)
            claim = self.root / "claims" / f"{address}.{held[-1][1] + 1 if held else 0}"
            claim.write_text(json.dumps(points.me()))
            return claim

        points.Workspace._claim = claimed
    if defect == "rename":

        @contextlib.contextmanager
        def filling(self: Any, address: str, point: Any) -> Iterator[Path]:
            here = self.folder(address)
            here.mkdir(exist_ok=True)
            (here / points.STATE_POINT).write_text(json.dumps(point))
            energy = {"value": 0.0, "error": 0.0, "effective": 1.0}
            early = {"status": "complete", "measures": {"energy": energy}, "summary": {}, "seconds": 0.0}
            (here / points.RESULT).write_text(json.dumps(early))
            yield here

        points.Workspace.filling = filling
    if defect == "number":
        points.gone = lambda claim: json.loads(claim.read_text())["pid"] != os.getpid()
    return sweep_worker.work(task)


def swept(place: Path, seeds: int, on: Any, defect: str) -> None:
    """One of the two sweeps, in a process of its own."""
    from functools import partial

    import mdnum
    from mdnum.verbs import sweep as verb

    root = place.parents[1]
    verb.work = partial(worker, journal=str(root / "journal"), defect=defect)
    mdnum.sweep(
        SYSTEM, {"dynamics.timestep": TIMESTEPS}, seeds=seeds, measure="energy", steps=STEPS, on=on,
        workers=2, points_in=place, out=root / f"sweep-{os.getpid()}", report=False,
    )  # fmt: skip


# --- who kills ---------------------------------------------------------------------------------------------


class Scene:
    """Two sweeps with what computes for them, and a hand that ends any of it."""

    def __init__(self, root: Path, words: list[str], disk: Path):
        self.root, self.words, self.disk = root, words, disk
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.logs = root / "logs"
        self.logs.mkdir()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.starts: Counter[str] = Counter()
        self.ended: dict[str, int] = {}

    def command(self, name: str) -> list[str]:
        dask = [sys.executable, "-m", "distributed.cli.dask_"]
        if name == "scheduler":
            port = self.address.rpartition(":")[2]
            return [*dask[:2], f"{dask[2]}scheduler", "--port", port, "--host", "127.0.0.1", "--no-dashboard"]
        if name.startswith("dask"):
            own = str(self.root / name)
            more = ["--nthreads", "1", "--no-dashboard", "--local-directory", own, "--death-timeout", "600"]
            return [*dask[:2], f"{dask[2]}worker", self.address, *more]
        on = ["--on", self.address] * (name == "sweep by dask")
        return [sys.executable, __file__, "--sweep", str(self.disk / "points"), *self.words, *on]

    def tend(self) -> None:
        """Starts what does not run, unless it ended well."""
        for name in ("scheduler", "dask 1", "dask 2", "sweep", "sweep by dask"):
            one = self.processes.get(name)
            if name in self.ended or (one is not None and one.poll() is None):
                continue
            if one is not None and one.returncode == 0 and name.startswith("sweep"):
                self.ended[name] = 0
                continue
            self.starts[name] += 1
            with (self.logs / f"{name}.txt").open("ab") as log:
                # a group of its own: what is killed here is a process, not a terminal
                self.processes[name] = subprocess.Popen(
                    self.command(name), stdout=log, stderr=log, cwd=self.root, start_new_session=True
                )

    def over(self) -> bool:
        return len(self.ended) == 2

    def children(self, name: str) -> list[int]:
        """Processes below one of them."""
        above: dict[int, int] = {}
        for entry in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                above[int(entry.parent.name)] = int(
                    entry.read_text(errors="replace").rpartition(")")[2].split()[1]
                )
        own = [self.processes[name].pid]
        for pid in own:
            own += [one for one, parent in above.items() if parent == pid]
        return own[1:]

    def victim(self, what: str, rng: np.random.Generator) -> int | None:
        """A process to kill."""
        if what in ("sweep", "scheduler"):
            names = ["scheduler"] if what == "scheduler" else ["sweep", "sweep by dask"]
            alive = [one.pid for name in names if (one := self.processes[name]).poll() is None]
        else:
            names = ["sweep"] if what == "worker" else ["dask 1", "dask 2"]
            alive = [pid for name in names for pid in self.children(name) if _computes(pid)]
        return int(rng.choice(sorted(alive))) if alive else None

    def close(self) -> None:
        for one in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()


def _computes(pid: int) -> bool:
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes()
        return b"resource_tracker" not in words and b"semaphore_tracker" not in words
    return False


@contextlib.contextmanager
def small_disk(root: Path) -> Iterator[tuple[Path, bool]]:
    """A folder on a disk that can be filled, and whether it is one."""
    place = root / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place)], capture_output=True
    )
    try:
        yield place, done.returncode == 0
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", "-l", str(place)], check=True)


def fill(disk: Path, seconds: float) -> None:
    """Leaves no room for some time."""
    filler = disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    time.sleep(seconds)
    filler.unlink()


# --- the oracle --------------------------------------------------------------------------------------------


def judged(place: Path, journal: Path, seeds: int) -> dict[str, int]:
    """What is wrong with a folder of points, by kind; reads its files and nothing of mdnum."""
    wrong: Counter[str] = Counter()
    found: Counter[tuple[int, float]] = Counter()
    for folder in sorted((place / "workspace").iterdir()):
        if folder.name.startswith("."):
            wrong["left over"] += folder.is_dir()
            continue
        try:
            state = json.loads((folder / "signac_statepoint.json").read_text())
            name = hashlib.md5(json.dumps(state, sort_keys=True).encode(), usedforsecurity=False).hexdigest()
            own = state["system"]["dynamics"]
            result = json.loads((folder / "point.json").read_text())
            if result["status"] == "failed":
                wrong["failed"] += 1
                continue
            series = pq.read_table(folder / "series.parquet")["potential"].to_numpy()
            expected = value(own["seed"], own["timestep"])
            whole = len(series) == STEPS + 1 and bool((series == expected).all())
            right = abs(result["measures"]["energy"]["value"] - expected / ATOMS) < 1e-12
            if not (name == folder.name and whole and right):
                wrong["half"] += 1
            found[own["seed"], own["timestep"]] += 1
        except (OSError, ValueError, KeyError, pa.ArrowInvalid):
            wrong["half"] += 1
    wanted = {(seed, timestep) for seed in range(seeds) for timestep in TIMESTEPS}
    wrong["lost"] = len(wanted - found.keys())
    wrong["stored twice"] = sum(number - 1 for number in found.values()) + len(found.keys() - wanted)
    for file in journal.iterdir():
        words = [line.split()[0] for line in file.read_text().splitlines()]
        wrong["begun though there"] += "THERE" in words
        wrong["begun by two"] += "BOTH" in words
        wrong["begun again"] += max(words.count("begin") - 1, 0)
    return dict(wrong)


def main() -> None:
    """Kill, start again, and judge what is there."""
    arguments = parser(__doc__)
    arguments.add_argument("--points", type=int, default=1000, help="a multiple of 4")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--pause", type=float, default=1.5, help="mean seconds between two kills")
    arguments.add_argument("--kills", type=int, default=10**6, help="the most of them")
    arguments.add_argument("--limit", type=float, default=1500, help="seconds")
    arguments.add_argument("--defect", choices=DEFECTS, default="")
    arguments.add_argument("--store", type=Path, help="a folder that is kept")
    arguments.add_argument("--sweep", type=Path, help="of the processes that this starts")
    arguments.add_argument("--on")
    asked = arguments.parse_args()
    seeds = asked.points // len(TIMESTEPS)
    if asked.sweep:
        swept(asked.sweep, seeds, asked.on, asked.defect)
        return
    rng, kills, began = np.random.default_rng(asked.seed), Counter[str](), time.monotonic()
    root = (asked.store or Path(tempfile.mkdtemp())).absolute()
    root.mkdir(parents=True, exist_ok=True)
    with small_disk(root) as (disk, full):
        journal = root / "journal"
        journal.mkdir()
        words = ["--points", str(asked.points), *(["--defect", asked.defect] if asked.defect else [])]
        scene = Scene(root, words, disk)
        deeds = {"worker": 0.4, "dask worker": 0.25, "sweep": 0.12, "scheduler": 0.1}
        deeds["full disk"] = 0.13 * full
        names, weights = list(deeds), np.array(list(deeds.values()))
        try:
            scene.tend()
            while not scene.over() and time.monotonic() - began < asked.limit:
                # the times come of the seed; what happens to run then does not
                pause, deed = rng.exponential(asked.pause), str(rng.choice(names, p=weights / weights.sum()))
                until = time.monotonic() + pause
                while time.monotonic() < until and not scene.over():
                    time.sleep(min(0.2, max(until - time.monotonic(), 0.001)))
                    scene.tend()
                if sum(kills.values()) >= asked.kills or scene.over():
                    continue
                if deed == "full disk":
                    fill(disk, 2.0)
                    kills[deed] += 1
                elif (pid := scene.victim(deed, rng)) is not None:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                        kills[deed] += 1
        finally:
            scene.close()
        over = scene.over()
        # what a process left that was killed last is taken away by the next sweep
        if over:
            subprocess.run(scene.command("sweep"), cwd=root, capture_output=True, check=True)
        wrong = judged(disk / "points", journal, seeds)
    table(f"seed {asked.seed}", ["killed", "times"], [(name, kills[name]) for name in deeds])
    kinds = (
        "lost", "stored twice", "begun though there", "begun by two", "half", "failed", "left over",
        "begun again",
    )  # fmt: skip
    table("", ["points", str(asked.points)], [(name, wrong.get(name, 0)) for name in kinds])
    say(f"{sum(scene.starts.values())} starts of processes, {time.monotonic() - began:.0f} s")
    if not full:
        say("no disk was filled: this user cannot mount one")
    if asked.store is None:
        shutil.rmtree(root, ignore_errors=True)
    # what was begun again had been killed, or had no room
    if not over or any(wrong.get(name) for name in kinds[:-1]):
        say("both sweeps should have ended" if not over else "something is wrong")
        raise SystemExit(1)


if __name__ == "__main__":
    start(main)
