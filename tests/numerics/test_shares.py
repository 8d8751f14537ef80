"""Shares of exponentials whose splits are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.numerics.verdicts import Share, shares, table

RATE, TOLERANCE, STEPS = 0.02, 0.1, 3000


def splits_at(step: int) -> np.ndarray:
    """Grows at RATE and is beyond the tolerance from this step on."""
    return TOLERANCE * np.exp(RATE * (np.arange(STEPS) - step + 0.5))


def ended(values: np.ndarray, step: int) -> np.ndarray:
    """With nothing after a step."""
    return np.where(np.arange(len(values)) <= step, values, np.nan)


def of(found: tuple[Share, ...]) -> dict[tuple[str, str], tuple[int, bool]]:
    return {(share.what, share.reference): (share.steps, share.at_least) for share in found}


def test_each_cell_is_what_its_name_says():
    series = {
        "B": splits_at(1000), "B|A": splits_at(1400), "B|A from B": splits_at(1100),
        "A|B from A": splits_at(950), "A|B": ended(splits_at(9000), 2500),
    }  # fmt: skip
    cells = {
        (cell.arithmetic, cell.decisions, cell.reference): (cell.split, cell.until)
        for cell in table(series, TOLERANCE)
    }
    assert cells == {
        ("A", "A", "A"): (None, 2999), ("B", "B", "A"): (1000, 2999), ("B", "A", "A"): (1400, 2999),
        ("A", "B", "A"): (950, 2999), ("A", "A", "B"): (1000, 2999), ("B", "B", "B"): (None, 2999),
        ("B", "A", "B"): (1100, 2999), ("A", "B", "B"): (None, 2500),
    }  # fmt: skip
    assert [cell.same for cell in table(series, TOLERANCE)].count(True) == 2
    found = shares(table(series, TOLERANCE), RATE)
    # B under A's decisions differs from A in its arithmetic alone: what is taken away are the decisions
    assert of(found) == {
        ("decisions", "A"): (400, False), ("decisions", "B"): (1500, True),
        ("arithmetic", "A"): (-50, False), ("arithmetic", "B"): (100, False),
    }  # fmt: skip
    assert [share.e_foldings for share in found] == pytest.approx([8.0, 30.0, -1.0, 2.0])


def test_a_run_that_ended_before_the_split_says_nothing():
    series = {"B": splits_at(1000), "B|A": ended(splits_at(9000), 700), "B|A from B": splits_at(1001)}
    found = shares(table(series, TOLERANCE), float("nan"))
    assert of(found) == {("arithmetic", "B"): (1, False)}
    assert found[0].e_foldings is None


def test_without_a_split_nothing_is_shared():
    series = {"B": splits_at(9000), "B|A": splits_at(9000)}
    assert shares(table(series, TOLERANCE), RATE) == ()


def test_only_what_was_run_is_in_the_table():
    assert len(table({"B": splits_at(1000)}, TOLERANCE)) == 4
    assert shares(table({"B": splits_at(1000)}, TOLERANCE), RATE) == ()
