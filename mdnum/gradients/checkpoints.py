"""What reverse mode keeps of its forward pass: everything, states here and there, or a handful of them."""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import Any

from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.program import Between, Inputs, Passed
from mdnum.gradients.steps import Leg, Snapshot, Steps

#: Called with a chunk that was linearized, what it told and its list.
Watch = Callable[[Leg, Passed, Any], None]
#: Called with steps done, all steps, and a phase in words.
Told = Callable[[int, int, str], None]


def keep_everything(
    program: Steps, watch: Watch, told: Told, room: Callable[[int, int], None]
) -> tuple[float, Cotangents]:
    """Every chunk's own tape is kept until the reverse pass has been there.

    Args:
        program: the rollout.
        watch: told of every chunk.
        told: progress.
        room: called with the bytes kept so far and the steps that they are for; raises where there is no
            room left.
    """
    last = program.problem.steps
    at, backs, held = program.start, [], 0
    while at.step <= last:
        tables = program.list_of(at)[1]
        at, leg, passed, back = program.keep(at)
        watch(leg, passed, tables)
        backs.append(back)
        held += program.bytes_of(back)
        room(held, at.step)
        told(at.step - 1, last, "run")
    onto, inputs = program.onto_end(at), program.nothing()
    value = program.value(at)
    while backs:
        onto, inputs = program.pull(backs.pop(), onto, inputs)
    told(last, last, "reverse pass")
    return value, program.cotangents(onto, inputs)


def keep_states(program: Steps, watch: Watch, told: Told) -> tuple[float, Cotangents]:
    """The state before every chunk is kept; its tape is made when the reverse pass gets there."""
    last = program.problem.steps
    before, legs = [program.start], []
    for at, leg, _ in program.ahead():
        before.append(at)
        legs.append(leg)
        told(at.step - 1, last, "run")
    end = before.pop()
    onto, inputs = program.onto_end(end), program.nothing()
    while legs:
        onto, inputs = _back(program, before.pop(), legs.pop(), onto, inputs, watch)
        told(last - (before[-1].step if before else 0), last, "reverse pass")
    return program.value(end), program.cotangents(onto, inputs)


def keep_few(
    program: Steps, watch: Watch, told: Told, snapshots: int | None
) -> tuple[float, Cotangents, int]:
    """A handful of states is kept, and what lies between is run again: binomial checkpoints.

    Args:
        program: the rollout.
        watch: told of every chunk.
        told: progress.
        snapshots: how many states; None: about the logarithm of the number of chunks.

    Returns:
        the loss, its derivatives, and how many chunks were run in all, for each chunk that there is.

    Source: Griewank & Walther, Revolve, ACM Trans. Math. Softw. 26 (2000) 19.
    """
    last = program.problem.steps
    legs, end = [], program.start
    for end, leg, _ in program.ahead():
        legs.append(leg)
        told(end.step - 1, last, "run")
    count = len(legs)
    room = max(1, count.bit_length() if snapshots is None else snapshots)
    made = count
    state = (program.onto_end(end), program.nothing())
    value = program.value(end)

    def reverse(low: int, high: int, at: Snapshot, room: int) -> None:
        nonlocal made, state
        while high - low > 1:
            middle = low + _split(high - low, room)
            there = at
            for k in range(low, middle):
                there, _, _ = program.forward(there, legs[k].rows)
            made += middle - low
            reverse(middle, high, there, room - 1)
            high = middle
        state = _back(program, at, legs[low], *state, watch)
        made += 1
        told(last - legs[low].first, last, "reverse pass")

    reverse(0, count, program.start, room)
    return value, program.cotangents(state[0], state[1]), made


def _split(length: int, room: int) -> int:
    """How far ahead the next state is kept, so that the fewest chunks are run again."""
    if room < 1:
        return length - 1
    # with the state at the start there is one more
    states, repeats = room + 1, 1
    while comb(states + repeats, states) < length:
        repeats += 1
    # as far ahead as can be done with as many repeats, and no nearer to the end than one state less allows
    near, far = comb(states + repeats - 2, states - 1), comb(states + repeats - 1, states)
    return max(1, min(far, length - near))


def _back(
    program: Steps, at: Snapshot, leg: Leg, onto: Between, inputs: Inputs, watch: Watch
) -> tuple[Between, Inputs]:
    tables = program.list_of(at)[1]
    _, again, passed, back = program.keep(at, leg.rows)
    watch(again, passed, tables)
    return program.pull(back, onto, inputs)
