"""Points by their address: none lost, none computed twice, whoever is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mdnum.errors import FolderError
from mdnum.sweeps.engines import computed
from mdnum.sweeps.points import Workspace, address_of, differing, gone, state_point, write_result


def fill(place: Workspace, address: str, value: float = 1.0) -> None:
    with place.filling(address, {"a": value}) as folder:
        write_result(folder, {"status": "complete", "value": value})


def test_the_address_is_that_of_signac():
    # signac.job.calc_id of 2.4.1
    assert address_of({"a": 1, "b": [1.5, None, "x"]}) == "41d1c618ebcf3b19e9da4371dd4b1f13"


def test_a_state_point_is_told_apart_by_field():
    one, other = (
        state_point({"dynamics": {"timestep": dt, "none": None}}, "s", {"steps": 5}) for dt in (1.0, 2.0)
    )
    assert differing(one, other) == ["dynamics.timestep"] and "none" not in one["system"]["dynamics"]
    assert address_of(one) != address_of(other)


def test_one_process_has_a_point_at_a_time(tmp_path):
    place = Workspace(tmp_path)
    address = "0" * 32
    with place.claimed(address) as first, Workspace(tmp_path).claimed(address) as second:
        assert first and not second
    assert not place.claims()
    with ThreadPoolExecutor(8) as pool:

        def claim(_: int) -> bool:
            with place.claimed(address) as mine:
                if mine and place.result(address) is None:
                    fill(place, address)
                    return True
                return False

        assert sum(pool.map(claim, range(64))) == 1
    assert place.result(address) == {"status": "complete", "value": 1.0}
    assert not [one for one in place.place.iterdir() if one.name != address]


CHILD = """
import os, sys, time
from pathlib import Path
from mdnum.sweeps.points import Workspace
place = Workspace(Path(sys.argv[1]))
with place.claimed("1" * 32) as mine, place.filling("1" * 32, {}) as folder:
    (folder / "half").write_text("x")
    print(mine, flush=True)
    time.sleep(60)
"""


def test_a_claim_of_a_killed_process_is_followed_by_another(tmp_path):
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline().strip() == "True"
    place, address = Workspace(tmp_path), "1" * 32
    with place.claimed(address) as mine:
        assert not mine
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert [gone(claim) for claim, _ in place.claims()] == [True]
    assert place.result(address) is None and place.swept() == 1
    with place.claimed(address) as mine:
        assert mine
        fill(place, address)
    assert not place.claims() and place.result(address) is not None


def test_a_claim_is_released_alone(tmp_path):
    """One that came later is of a process that took the first for gone, and stays."""
    place, address = Workspace(tmp_path), "3" * 32
    later = tmp_path / "claims" / f"{address}.1"
    with place.claimed(address) as mine:
        assert mine
        later.write_text(later.with_suffix(".0").read_text())
    assert place.claims() == [(later, 1)]


def test_a_claim_that_found_no_room_is_removed(tmp_path):
    place, resource = Workspace(tmp_path), pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # as on a full disk, a file can be made and nothing be written into it
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        with pytest.raises(FolderError), place.claimed("4" * 32):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list((tmp_path / "claims").iterdir())


def test_another_machine_is_gone_after_a_while(tmp_path):
    claim = tmp_path / "claim"
    claim.write_text(json.dumps({"host": "elsewhere", "boot": "", "pid": 1, "since": ""}))
    assert not gone(claim)
    os.utime(claim, (time.time() - 1000, time.time() - 1000))
    assert gone(claim)
    assert gone(tmp_path / "none")


def test_what_is_half_written_is_no_point(tmp_path):
    place, address = Workspace(tmp_path), "2" * 32
    with pytest.raises(RuntimeError), place.filling(address, {}) as folder:
        write_result(folder, {"status": "complete"})
        raise RuntimeError
    assert place.result(address) is None and not list(place.place.iterdir())
    fill(place, address, 1.0)
    fill(place, address, 2.0)
    assert place.result(address) == {"status": "complete", "value": 2.0}
    (place.folder(address) / "point.json").write_text("{")
    with pytest.raises(FolderError):
        place.result(address)


def killed(task: tuple[str, int]) -> int:
    """A worker that dies of one task, and notes each that it does."""
    folder, k = task
    if k == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    Path(folder, f"{k}-{time.time_ns()}").touch()
    return k * k


@pytest.mark.nightly
def test_a_worker_that_dies_takes_its_own_task_alone(tmp_path):
    tasks = [(str(tmp_path), k) for k in range(8)]
    found = dict(computed(killed, tasks, workers=2, lost=lambda task, why: task[1] == 3))
    assert {task[1]: answer for task, answer in found.items() if task[1] != 3} == {
        k: k * k for k in range(8) if k != 3
    }
    assert isinstance(found[tasks[3]], Exception)


def test_any_executor_computes():
    with ThreadPoolExecutor(2) as pool:
        found = dict(computed(lambda k: k + 1, range(20), on=pool))
    assert found == {k: k + 1 for k in range(20)}
