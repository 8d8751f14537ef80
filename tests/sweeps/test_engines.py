"""Engines: what comes back from a worker, and what ends with whom."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import mdnum
from mdnum.errors import InputError
from mdnum.sweeps.engines import computed, in_order, requested
from mdnum.systems.code import is_allowed


class Twice(Exception):
    """Is pickled, and cannot be read again."""

    def __init__(self, one: str, other: str):
        super().__init__(one + other)


def wrong(task: int) -> int:
    if task == 1:
        raise KeyError("of the work")
    if task == 2:
        raise Twice("read by ", "nobody")
    return task


def test_an_exception_of_the_work_is_an_answer():
    """The task is not begun again, nor does it count as lost."""
    lost: list[object] = []
    with ThreadPoolExecutor(1) as pool:
        found = dict(computed(wrong, range(4), on=pool, lost=lambda task, why: bool(lost.append(task))))
    assert (found[0], found[3], lost) == (0, 3, [])
    assert isinstance(found[1], KeyError) and found[1].args == ("of the work",)
    assert isinstance(found[2], RuntimeError) and str(found[2]) == "Twice: read by nobody"


def test_a_worker_of_other_code_computes_nothing(tmp_path, monkeypatch):
    versions = iter(["of this process", "of the worker"])
    monkeypatch.setattr("mdnum.sweeps.engines.code", lambda **_: next(versions))
    with ThreadPoolExecutor(1) as pool:
        ((_, error),) = computed(noted, [str(tmp_path)], on=pool)
    assert isinstance(error, InputError) and "different version of mdnum" in str(error)
    assert not list(tmp_path.iterdir())


def allowed(task: int) -> bool:
    return is_allowed()


def test_code_of_files_is_executed_elsewhere_where_the_caller_allows_it():
    with ThreadPoolExecutor(1) as pool, requested(pool, 1) as engine:
        with mdnum.allow_code():
            assert [*in_order(allowed, [0], engine)] == [True]
        assert [*in_order(allowed, [0], engine)] == [False]


@pytest.mark.nightly
def test_files_of_the_current_folder_are_no_modules_of_workers(strangers_folder):
    with requested(None, 1) as engine:
        assert [*in_order(doubled, [1, 2], engine)] == [2, 4]


def doubled(task: int) -> int:
    if task == 3:
        raise InputError("three")
    return 2 * task


def test_results_come_in_the_order_of_tasks_and_here_no_sooner_than_requested():
    taken: list[int] = []

    def tasks():
        for task in (2, 1, 3, 4):
            taken.append(task)
            yield task

    here = in_order(doubled, tasks(), None)
    assert (next(here), taken) == (4, [2])
    assert [str(one) for one in in_order(doubled, [1, 3, 2], None, keep=True)] == ["2", "three.", "4"]
    with ThreadPoolExecutor(2) as pool, requested(pool, 2) as engine, requested(None, None) as none:
        assert none is None and engine is not None
        kept = [*in_order(doubled, tasks(), engine, keep=True)]
        assert [one for one in kept if isinstance(one, int)] == [4, 2, 8] and str(kept[2]) == "three."
        # the engine serves several calls
        with pytest.raises(InputError, match="three"):
            list(in_order(doubled, tasks(), engine))


SWEEP = """
import os, sys, time
from mdnum.sweeps.engines import computed

def asleep(file):
    with open(file, "w") as opened:
        opened.write(str(os.getpid()) + "\\n")
    time.sleep(60)

list(computed(asleep, [sys.argv[1]], workers=1))
"""


@pytest.mark.nightly
def test_a_worker_ends_with_its_killed_sweep(tmp_path):
    file = tmp_path / "worker"
    sweep = subprocess.Popen([sys.executable, "-c", SWEEP, str(file)])
    try:
        _until(lambda: file.exists() and file.read_text().endswith("\n"))
        worker = int(file.read_text())
        assert worker != sweep.pid and _lives(worker)
    finally:
        sweep.send_signal(signal.SIGKILL)
        sweep.wait()
    _until(lambda: not _lives(worker))


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        # one that has ended has its number until somebody looks
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def _until(true: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def noted(folder: str) -> None:
    Path(folder, str(time.time_ns())).touch()


@pytest.mark.nightly
def test_equal_tasks_are_two_to_dask(tmp_path):
    """To dask alone they are one, of which the second finds the answer of the first."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        1, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=":0"
    ) as cluster:
        tasks = [str(tmp_path)] * 2
        assert len(list(computed(noted, tasks, on=cluster.scheduler_address))) == 2
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_that_is_no_executor_is_refused(tmp_path):
    pytest.importorskip("executorlib")
    file = tmp_path / "jobs.toml"
    for text in ('executor = "Nothing"', 'executor = "SingleNodeExecutor"\nwaiters = 2'):
        file.write_text(text)
        with pytest.raises(InputError):
            list(computed(noted, [str(tmp_path)], on=str(file)))


def often(task: tuple[str, int]) -> int:
    """One task kills its worker, and is noted before it does."""
    folder, k = task
    noted(folder)
    if k == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def once(task: tuple[str, int]) -> int:
    """One task kills its worker when it is begun for the first time."""
    folder, k = task
    first = not list(Path(folder).glob(f"{k}-*"))
    Path(folder, f"{k}-{time.time_ns()}").touch()
    if k == 3 and first:
        os.kill(os.getpid(), signal.SIGKILL)
    return k


@pytest.mark.nightly
def test_what_a_killed_worker_had_is_computed_again_and_what_had_ended_is_not(tmp_path):
    with requested(None, 2) as engine:
        assert list(in_order(once, [(str(tmp_path), k) for k in range(8)], engine)) == [*range(8)]
    begun = [int(file.name.partition("-")[0]) for file in tmp_path.iterdir()]
    assert begun.count(3) >= 2 and set(begun) == {*range(8)} and begun.count(0) == 1


@pytest.mark.nightly
def test_workers_of_executorlib_live_over_tasks_and_are_replaced(tmp_path):
    pytest.importorskip("executorlib")
    file, notes = tmp_path / "jobs.toml", tmp_path / "notes"
    notes.mkdir()
    file.write_text('executor = "SingleNodeExecutor"\nmax_workers = 2\nhostname_localhost = true')
    tasks = [(str(notes), k) for k in range(8)]
    found = dict(computed(often, tasks, on=str(file), lost=lambda task, why: task[1] == 3))
    answers = {task[1]: answer for task, answer in found.items()}
    assert isinstance(answers.pop(3), Exception) and len(answers) == 7
    assert len({*answers.values()}) < 7 and os.getpid() not in answers.values()
    _until(lambda: not any(_lives(pid) for pid in answers.values()))


SLURM = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=1000 State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A cluster of this machine alone; its daemons end with the test."""
    pytest.importorskip("executorlib")
    programs = ("munged", "slurmctld", "slurmd", "sbatch", "scancel")
    path = os.pathsep.join([os.environ["PATH"], "/usr/sbin"])
    lacking = [name for name in programs if shutil.which(name, path=path) is None]
    if lacking or os.getuid() != 0:
        pytest.skip(f"no {lacking[0]} is installed" if lacking else "daemons of SLURM start only as root")
    monkeypatch.setenv("PATH", path)
    folder = tmp_path / "slurm"
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    host = socket.gethostname().partition(".")[0]
    (folder / "slurm.conf").write_text(SLURM.format(host=host, folder=folder, cores=os.cpu_count()))
    monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
    munge = not Path("/run/munge/munge.socket.2").exists()
    words = [["munged", "--foreground", "--force"]] * munge + [
        ["slurmctld", "-D"],
        ["slurmd", "-D", "-N", host],
    ]
    daemons = []
    with (folder / "output").open("w") as output:
        for one in words:
            daemons.append(subprocess.Popen(one, stdout=output, stderr=output))
        try:
            idle = ["sinfo", "--noheader", "--format=%T"]
            _until(lambda: subprocess.run(idle, capture_output=True, text=True).stdout.strip() == "idle", 60)
            yield
        finally:
            for one in reversed(daemons):
                one.terminate()
            for one in daemons:
                one.wait(20)


@pytest.mark.nightly
def test_a_job_of_slurm_that_is_canceled_loses_no_point(slurm, tmp_path):
    """Of four points, one is computed again by another job."""
    file = tmp_path / "jobs.toml"
    jobs = min(2, os.cpu_count() or 1)
    file.write_text(f"max_workers = {jobs}\n[resource_dict]\npartition = 'main'\nrun_time_max = 600")
    system = mdnum.load("argon/crystal-108")
    over, points = {"neighbors.skin": [0.2, 0.25, 0.35]}, tmp_path / "points"
    with ThreadPoolExecutor(1) as thread:
        sweep = thread.submit(
            mdnum.sweep, system, over, seeds=1, steps=4000, measure="energy", on=str(file), points_in=points,
            out=tmp_path / "sweep", report=False,
        )  # fmt: skip
        _until(lambda: sweep.done() or len([*(points / "claims").glob("*")]) == jobs, 240)
        running = subprocess.run(
            ["squeue", "--noheader", "--states=R", "--format=%i"], capture_output=True, text=True
        )
        first, *_ = running.stdout.split()
        subprocess.run(["scancel", "--signal=KILL", first], check=True)
        made = sweep.result()
    assert made.summary["points"] == made.summary["computed"] == 4 and not made.summary["failed"]
    # the job that was killed left the unfinished folder of its point
    names = [one.name for one in (points / "workspace").iterdir()]
    assert sorted(name.startswith(".") for name in names) == [False] * 4 + [True]
