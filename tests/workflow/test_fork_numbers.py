"""What a summary says of splits to come and of repeats."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.events.chance import Delay
from mdnum.events.forks import Dates
from mdnum.workflow import fork_numbers as numbers

OPEN = Dates(0, 5, None)


def test_a_prediction_says_what_it_comes_from():
    steady = 1e-12 * np.exp(0.02 * np.arange(900.0))
    found = numbers.predicted(OPEN, steady, 0.1, 899, exponent=0.5)
    assert found["predicted_by"] == "growth"
    assert found["predicted_split"] == pytest.approx(np.log(0.1 / 1e-12) / 0.02, abs=1)
    # a power law is no exponential: the exponent alone can tell
    first_steps = 1e-9 * np.arange(61.0) ** 2
    assert numbers.predicted(OPEN, first_steps, 0.1, 60)["predicted_split"] is None
    assert numbers.predicted(OPEN, first_steps, 0.1, 60, 0.0036) == {
        "predicted_split": round(60 + np.log(0.1 / 3.6e-6) / 0.0036),
        "predicted_by": "exponent",
    }
    assert numbers.predicted(Dates(0, 5, 9), steady, 0.1, 899)["predicted_split"] is None


def test_repeats_that_did_not_split_are_kept():
    delays = [Delay(12, 40, 99, 99), Delay(None, 30, 99, 99)]
    assert numbers.repeats(delays) == {"repeated": [{"free": 12, "handed": 40}, {"free": None, "handed": 30}]}
