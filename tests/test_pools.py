"""Pools of worker processes: a line where a worker would wait for ever, and errors that reach the parent."""

from __future__ import annotations

import os
import pickle
import subprocess

import pytest

from mdnum import errors, reading
from mdnum.errors import MdnumError
from mdnum.safe_path import environment, python

PROGRAM = """
import multiprocessing, os, sys
import numpy as np
import mdnum
from mdnum.errors import MdnumError

KEPT = {}

def work(name):
    # which each begins at another door
    try:
        if name == "simulation":
            return KEPT["simulation"].evaluate().energy
        if name == "calculator":
            atoms = KEPT["atoms"].copy()
            atoms.calc = KEPT["calculator"]
            atoms.rattle(0.01, seed=os.getpid())
            return atoms.get_potential_energy()
        if name == "engine":
            from mdnum.rollout.engine import Engine
            return sum(segment.rows for segment in Engine(KEPT["simulation"], 5).segments())
        if name == "ball":
            return mdnum.bounce("ball/drop", steps=5, out="ball", report=False).summary["status"]
        if name == "raises":
            raise mdnum.errors.CapacityError("full", remedy="Wait", where="here")
        return mdnum.build("argon/crystal-108").evaluate().energy
    except MdnumError as error:
        if name == "raises":
            raise
        return str(error)

def prepare():
    system = mdnum.load("argon/crystal-108")
    KEPT["atoms"] = system.atoms
    KEPT["calculator"] = mdnum.MdnumCalculator(system)
    KEPT["simulation"] = mdnum.build(system)
    work("simulation"), work("calculator")

if __name__ == "__main__":
    start, prepared, *names = sys.argv[1:]
    if prepared == "used":
        prepare()
    with multiprocessing.get_context(start).Pool(1) as pool:
        for name in names:
            try:
                print(pool.apply_async(work, (name,)).get(timeout=240))
            except MdnumError as error:
                print("raised", error)
"""


def answers(folder, start: str, prepared: str, *names: str) -> list[str]:
    """What a worker answers, a line for each."""
    (folder / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        python("program.py", start, prepared, *names), cwd=folder, env=environment(), capture_output=True,
        text=True, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_worker_forked_after_jax_was_used_says_so_instead_of_waiting(tmp_path):
    names = ("build", "simulation", "calculator", "engine", "ball")
    lines = answers(tmp_path, "fork", "used", *names)
    assert len(lines) == len(names) and len(set(lines)) == 1
    assert "forked" in lines[0] and "spawn" in lines[0] and "docs/pools.md" in lines[0]


@pytest.mark.parametrize(("start", "prepared"), [("fork", "unused"), ("spawn", "used")])
def test_a_worker_of_its_own_computes_and_its_errors_arrive(tmp_path, start, prepared):
    if start == "fork" and not hasattr(os, "fork"):
        pytest.skip("no fork on this system")
    energy, error = answers(tmp_path, start, prepared, "build", "raises")
    assert float(energy) < 0
    assert error == "raised here: full. Wait."


KINDS = [errors.InputError, errors.FolderError, errors.CapacityError, errors.NumericalError]


@pytest.mark.parametrize("kind", [*KINDS, reading.FrameError, reading.UnreadableFrame])
def test_an_error_arrives_from_another_process_with_all_that_it_says(kind: type[MdnumError]):
    more = {"frame": 7} if issubclass(kind, reading.FrameError) else {}
    error = kind("seen", remedy="Do this", where="x.toml", **more)
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind and str(again) == str(error) and vars(again) == vars(error)
