"""Repeated runs in new processes: are their bits equal, and are equal bits correct?"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mdnum.ball import BallRun, Impact, SemiImplicitEuler, World, simulate
from mdnum.errors import NumericalError
from mdnum.numerics.rounding import neighbor
from mdnum.safe_path import environment, python
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: What of a run is hashed: every state, and every decision.
_PARTS = ("y", "v", "contact", "iterations", "reason")


def fingerprint(run: BallRun) -> str:
    """Return the SHA-256 of all states and decisions of a run, bit for bit.

    Equal fingerprints mean that heights, velocities, contacts and iteration counts are equal to the last bit.
    """
    digest = hashlib.sha256()
    for name in _PARTS:
        array = np.ascontiguousarray(getattr(run, name))
        digest.update(f"{name} {array.dtype.name} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


G, H, RESTITUTION, STEPS = 9.81, 0.01, 0.8, 200
#: Next to the boundary between a first contact in step 48 and one in step 49 (see the demonstration "fork").
START = float.fromhex("0x1.2755ffe6d58c9p+0")
#: Steps that are also made without compiling, one operation at a time: past the first contact.
EAGER = 60
#: An instruction set without fused multiply-add; the option is XLA's, and does nothing on another processor.
OLD_ISA = "--xla_cpu_max_isa=SSE4_2"
_PATIENCE = 120

Answers = dict[str, Any]


def answers() -> Answers:
    """Return fingerprints and first contacts of mdnum's program and of the plain program, in this process."""
    fenced, higher, plain = _fenced(START), _fenced(_next(START)), _plain(STEPS)
    return {
        "fenced": fingerprint(fenced),
        "higher": fingerprint(higher),
        "plain": hashlib.sha256(b"".join(rows.tobytes() for rows in plain)).hexdigest(),
        "fenced_contact": int(fenced.first_contact[0]),
        "plain_contact": int(plain[2].argmax()) + 1,
    }


def run() -> Demo:
    """Start the processes, run the same programs in this process meanwhile, and compare."""
    started = {"another process": _start(""), "an older instruction set": _start(OLD_ISA)}
    here, higher = _fenced(START), _fenced(_next(START))
    plain, _, _ = _plain(STEPS)
    batch = simulate(_world(), _world().start(np.linspace(START - 0.1, START + 0.1, 9)), STEPS)
    with jax.disable_jit():
        eager, eager_plain = _fenced(START, EAGER), _plain(EAGER)[0]
    own = answers()
    found = {"this process": own} | {name: _finish(name, process) for name, process in started.items()}
    same = {
        name: {part: answer[part] == own[part] for part in ("fenced", "higher", "plain")}
        for name, answer in found.items()
    }
    repeats = all(same["another process"].values())
    old, old_same = found["an older instruction set"], same["an older instruction set"]
    # the middle of the batch starts where the ball alone does, if the spacing came out even
    alone = simulate(_world(), _world().start(float(batch.y[0, 4])), STEPS)
    in_batch = bool(np.array_equal(batch.y[:, 4], alone.y[:, 0]))
    uncompiled = bool(np.array_equal(eager.y, here.y[: EAGER + 1]))
    uncompiled_plain = bool(np.array_equal(eager_plain, plain[:EAGER]))
    off = float(np.max(np.abs(plain - here.y[1:, 0])))
    ulp = float(np.max(np.abs(higher.y - here.y)))
    contacts = [own["plain_contact"], old["plain_contact"]]
    return Demo(
        title="Equal bits in every run do not mean correct results",
        question=(
            "Does a rollout give the same bits in a new process, with another compilation, and in a batch?"
        ),
        result=(
            f"{len(found)} processes give the same bits. A run whose initial height is one ulp larger "
            f"ends {ulp:.1g} m away, and is equally reproducible."
        ),
        answer=(
            f"mdnum's program, whose products are rounded before they are added, has one fingerprint in "
            f"{len(found)} processes, under an older instruction set, without a compiler and in a batch: "
            f"first contact in step {own['fenced_contact']}. A plain program with the same formulas is "
            f"also reproducible, {'but' if contacts[0] != contacts[1] else 'and'} its first contact is "
            f"in step {contacts[0]} here and in step {contacts[1]} under the older instruction set. "
            f"Equal bits show that the "
            f"result depends only on the inputs. They do not show that the result is correct or "
            f"insensitive: started one ulp higher, the ball is equally reproducible, and {ulp:.1g} m away."
        ),
        numbers={
            "fingerprints": len({answer["fenced"] for answer in found.values()}),
            "fingerprint": own["fenced"],
            "processes": len(found),
            "first_contact": own["fenced_contact"],
            "plain_fingerprints": len({answer["plain"] for answer in found.values()}),
            "plain_first_contacts": contacts,
            "plain_is_off": off,
            "one_ulp_is_off": ulp,
        },
        checks=[
            Claim("a repeat run in a new process has the same bits", repeats, "yes", repeats),
            Claim(
                "mdnum's program has the same bits under an older instruction set",
                old_same["fenced"],
                "yes",
                old_same["fenced"],
            ),
            Claim(
                f"mdnum's program has the same bits without a compiler ({EAGER} steps)",
                uncompiled,
                "yes",
                uncompiled,
            ),
            Claim(
                "mdnum's program has the same bits for one ball of a batch of nine", in_batch, "yes", in_batch
            ),
            Claim(
                "a ball started one ulp higher is reproducible, too, and has another trajectory",
                ulp,
                "above 0.01 m",
                ulp > 0.01 and all(answer["higher"] for answer in same.values()),
            ),
        ],
        tables=[
            table(
                "where the bits agree with those of this process",
                ("where", "mdnum's program", "first contact", "plainly written", "first contact there"),
                (
                    *(
                        (
                            name,
                            same[name]["fenced"],
                            answer["fenced_contact"],
                            same[name]["plain"],
                            answer["plain_contact"],
                        )
                        for name, answer in found.items()
                    ),
                    (
                        f"without a compiler, {EAGER} steps",
                        uncompiled,
                        int(eager.first_contact[0]),
                        uncompiled_plain,
                        None,
                    ),
                    ("one ball of a batch of nine", in_batch, None, None, None),
                ),
            ),
            table(
                "what equal bits show",
                ("question", "answer"),
                (
                    (
                        "Did anything but the inputs decide?",
                        "no: a difference between two programs is theirs",
                    ),
                    ("Is the answer right?", "not shown: a wrong program repeats itself as well"),
                    ("Is it firm?", f"not shown: one ulp at the start is {ulp:.1g} m later on"),
                    (
                        "On another machine?",
                        "shown only for what was tried: instruction sets, compiled or not",
                    ),
                ),
            ),
        ],
        plots=[
            Plot(
                "trajectories-that",
                title="Reproducible trajectories that differ",
                x_label="time (s)",
                y_label="|difference of heights| (m)",
                y_scale="log",
                series=(
                    _gap("plainly written", here, plain, "second"),
                    _gap("started one ulp higher", here, higher.y[1:, 0], "bad", dashed=True),
                ),
                caption="Difference from mdnum's run. Each trajectory is the same in every process of "
                "this kind, but the trajectories differ.",
            )
        ],
        in_md=(
            "Two runs of one system on one machine agree bit for bit. With another order of the "
            "neighbor list, another instruction set or another number of threads the run is "
            "different, but equally correct."
        ),
        data={"same": same, "found": found},
    )


def _next(y0: float) -> float:
    return float(neighbor(y0, 1))


def _world() -> World:
    return World.create(Impact(RESTITUTION, rest_speed=0.0), SemiImplicitEuler(H), gravity=G)


def _fenced(y0: float, steps: int = STEPS) -> BallRun:
    return simulate(_world(), _world().start(y0), steps)


def _plain(steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate the same ball with plain code, in which the compiler may fuse a product with a sum.

    Returns:
        heights, velocities and contacts of the states 1 to steps.
    """

    def step(state, _):
        y, v = state
        v = v - H * G
        y = y + H * v
        touches = y < 0
        y = jnp.where(touches, 0.0, y)
        v = jnp.where(touches, -RESTITUTION * jnp.minimum(v, 0.0), v)
        return (y, v), (y, v, touches)

    @jax.jit
    def roll(y, v):
        return lax.scan(step, (y, v), None, length=steps)[1]

    y, v, touches = roll(jnp.asarray(START, jnp.float64), jnp.asarray(0.0, jnp.float64))
    return np.asarray(y), np.asarray(v), np.asarray(touches)


def _gap(label: str, here: BallRun, y: np.ndarray, role: Any, dashed: bool = False) -> Series:
    gap = np.abs(y - here.y[1:, 0])
    return Series(label, here.time[1:], np.where(gap > 0, gap, np.nan), role=role, dashed=dashed)


def _start(flags: str) -> subprocess.Popen[str]:
    changed = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()} if flags else {}
    return subprocess.Popen(
        python(__file__),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(**changed),
    )


def _finish(name: str, process: subprocess.Popen[str]) -> Answers:
    """Return the results of a process.

    Raises:
        NumericalError: the process did not finish.
    """
    try:
        out, err = process.communicate(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise NumericalError(f"{name}: no answer in {_PATIENCE} s", where="determinism") from None
    if process.returncode:
        last = err.strip().splitlines()[-1:] or ["no message"]
        raise NumericalError(
            f"{name} ended with {process.returncode}: {last[0]}",
            remedy="Run `mdnum doctor`",
            where="determinism",
        )
    return json.loads(out.strip().splitlines()[-1])


if __name__ == "__main__":
    # each process: the programs, and their answers as JSON
    print(json.dumps(answers()))
