"""Two programs of a ball that differ in one choice, and decisions that one of them is made to take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from mdnum.ball.problem import Problem
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Decisions
from mdnum.events.ledger import Ledger


@dataclass(frozen=True)
class Pin:
    """One decision that a run is made to take; all others it takes by itself.

    Attributes:
        channel: "contact" or "stop".
        step: from 1.
        ball: whose; -1 for the count that all balls share.
        value: whether it touches (0 or 1), or how many iterations it makes.
    """

    channel: Literal["contact", "stop"]
    step: int
    ball: int
    value: int


@dataclass(frozen=True)
class BallTwin:
    """The two programs of a comparison.

    Attributes:
        a, b: world, start and steps of each.
        difference: what differs, in words.
        changes: keys of the system file whose values differ, with both values.
        order: the balls of B are those of A in this order; None where they are the same.
        pins: decisions that B is made to take.
    """

    a: Problem
    b: Problem
    difference: str
    changes: Mapping[str, list[Any]] = field(default_factory=dict)
    order: tuple[int, ...] | None = None
    pins: tuple[Pin, ...] = ()


def told(pins: tuple[Pin, ...], run: BallRun) -> Decisions | None:
    """Pins as what a rollout is told: -1 wherever it decides by itself; None where there are none.

    Args:
        run: one with as many steps, balls and solves.
    """
    if not pins:
        return None
    contact = np.full(run.contact.shape, -1, np.int8)
    iterations = np.full(run.iterations.shape, -1, np.int32)
    for pin in pins:
        if pin.step > run.steps:
            continue
        if pin.channel == "contact":
            contact[pin.step - 1, pin.ball] = pin.value
        elif iterations.ndim == 1:
            iterations[pin.step - 1] = pin.value
        else:
            iterations[pin.step - 1, pin.ball] = pin.value
    return Decisions(contact, iterations)  # type: ignore[arg-type]


def in_order(decisions: Decisions, order: tuple[int, ...] | None) -> Decisions:
    """Decisions on the balls of A, for a run whose balls are in another order."""
    if order is None:
        return decisions
    index = list(order)
    counts = decisions.iterations
    return Decisions(decisions.contact[:, index], counts[:, index] if counts.ndim == 2 else counts)


def as_in_a(run: BallRun, order: tuple[int, ...] | None) -> BallRun:
    """A run of B with its balls in the order of A."""
    if order is None:
        return run
    place = np.argsort(order)
    columns = ("y", "v", "height", "contact", "iterations", "reason", "residual", "margin", "before")
    arrays = {name: getattr(run, name) for name in columns}
    turned = {
        name: values[:, place] for name, values in arrays.items() if values.ndim == 2 and values.shape[1] > 0
    }
    return replace(run, **turned, contacts=_relabeled(run.contacts, np.asarray(order)))


def _relabeled(flips: Ledger, order: np.ndarray) -> Ledger:
    ball = order[flips.subject[:, 0]]
    rows = np.lexsort((ball, flips.step))
    names = ("step", "entered", "margin", "bound", "jump")
    return replace(
        flips,
        subject=ball[rows, None],
        **{name: getattr(flips, name)[rows] for name in names},
        extra={name: values[rows] for name, values in flips.extra.items()},
    )
