"""Verdicts on made-up separations whose answers are known; every sequence of coins; and what a split owes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.numerics import verdicts
from mdnum.numerics.verdicts import (
    ERROR,
    FEWEST,
    REPEATS,
    Dates,
    Delay,
    ForkVerdict,
    count,
    expected,
    growth,
    looks,
    shares,
    split_of,
    table,
)
from mdnum.units import Measured
from mdnum.verbs.fork_verdict import TEXTS

RATE, TOLERANCE, STEPS = 0.02, 0.1, 3000


def judge(*given, **options) -> ForkVerdict:
    """The verdict, each of whose reasons has a sentence for its values."""
    verdict = verdicts.judge(*given, **options)
    for code, values in verdict.reasons:
        values = {**values, "separation": Measured(values.get("separation", 0.0), "σ", TOLERANCE)}
        assert TEXTS(f"reason_{code}", **values, unit="σ", displacement=1e-9).endswith(".")
    return verdict


def grown(rate: float, steps: int, start: float = 1e-15, top: float = 3.0) -> np.ndarray:
    return np.minimum(start * np.exp(rate * np.arange(steps)), top)


FREE = grown(RATE, STEPS)
SPLIT = split_of(FREE, TOLERANCE) or 0
#: The same by one e-folding of steps, 50, and by more of them later.
LITTLE, LATE = (np.concatenate([np.full(steps, 1e-15), FREE])[:STEPS] for steps in (40, 300))
DATES = Dates(0, 400, SPLIT)


@given(st.floats(0.01, 0.2), st.floats(-16, -10))
def test_the_rate_of_an_exponential_is_found(rate, start):
    fit = growth(grown(rate, 4000, 10.0**start), TOLERANCE)
    assert fit.rate == pytest.approx(rate, rel=1e-9)
    assert fit.r_squared > 1 - 1e-12


def test_without_growth_there_is_no_prediction():
    fit = growth(np.full(300, 1e-9), TOLERANCE)
    assert abs(fit.rate) < 1e-12
    assert np.isnan(growth(np.zeros(300), TOLERANCE).rate)
    # the first steps are a power law, and predict nothing
    power = 1e-9 * np.arange(61.0) ** 2
    assert expected(power, TOLERANCE) is None
    assert expected(power, TOLERANCE, exponent=0.0036) == pytest.approx(np.log(0.1 / 3.6e-6) / 0.0036)
    assert "no_growth" in dict(judge(Dates(0, 5, None), power, None, TOLERANCE).reasons)
    # an exponential says how long it would take
    left = SPLIT - 899
    reasons = dict(judge(Dates(0, 400, None), FREE[:900], None, TOLERANCE).reasons)
    assert reasons["growing"]["steps"] in (left - 1, left)


@pytest.mark.parametrize(
    ("dates", "free", "imposed", "word", "codes"),
    [
        (Dates(None, None, None), np.zeros(50), None, "same", {"same"}),
        (Dates(0, None, None), FREE[:100], None, "no fork", {"no_fork"}),
        # a split that does not come, one that was not followed for long enough, one within the tolerance
        (DATES, FREE, np.full(STEPS, 1e-9), "cause", {"kept", "rests"}),
        (DATES, FREE[: SPLIT + 20], np.full(SPLIT + 20, 1e-9), "open", {"kept", "short"}),
        (DATES, FREE, np.full(STEPS, 0.05), "open", {"kept", "within"}),
        # before the fork, and under the other's decisions alone
        (Dates(0, 2500, SPLIT), FREE, FREE, "bystander", {"had_split"}),
        (Dates(0, 400, None), FREE[:900], FREE[-900:], "open", {"outlook", "together"}),
    ],
)
def test_words_that_need_no_repeats(dates, free, imposed, word, codes):
    verdict = judge(dates, free, imposed, TOLERANCE)
    assert verdict.word == word and codes <= set(dict(verdict.reasons)) and verdict.wanted == 0
    assert verdict.e_foldings == (float("inf") if word == "cause" else None)


def test_an_end_of_one_run_is_a_fork_by_itself():
    ended = {"run": "B", "word": "runaway", "step": 0, "other": "A"}
    verdict = judge(Dates(0, 0, None), np.zeros(1), None, TOLERANCE, ended=ended)
    assert verdict.word == "open" and verdict.reasons == (("ended", {**ended, "steps": 0}),)


@pytest.mark.parametrize(
    ("delay", "steps", "told"),
    [
        # both splits seen: exactly so many steps later is not more than so many
        (Delay(100, 150, 500, 500), 49, True), (Delay(100, 150, 500, 500), 50, False),
        # the one under the first run's decisions not seen: it comes after the last step that is known
        (Delay(100, None, 500, 149), 49, True), (Delay(100, None, 500, 149), 50, None),
        # the free one not seen: it comes after the last step that is known, so the delay is at most the rest
        (Delay(None, 150, 99, 500), 50, False), (Delay(None, 150, 99, 500), 49, None),
        (Delay(None, None, 99, 149), 0, None),
    ],
)  # fmt: skip
def test_a_delay_is_known_as_far_as_both_runs_were_followed(delay, steps, told):
    assert delay.beyond(steps) is told


def later(*gains: int) -> list[Delay]:
    """Repeats whose flips are worth so many steps."""
    return [Delay(SPLIT - 7, SPLIT - 7 + gain, STEPS - 1, STEPS - 1) for gain in gains]


#: One of six not later: it is looked at again after eleven, and after sixteen.
SIX = (60, 60, 60, 60, 40)
ELEVEN = (*SIX, 40, 60, 60, 60, 60)
#: Four that are alike, either way.
FAST, SLOW = later(*4 * [60]), later(*4 * [40])


@pytest.mark.parametrize(
    ("imposed", "repeats", "other", "most", "word", "wanted"),
    [
        # two tell nothing, however little they scatter
        (LATE, later(300, 301), [], REPEATS, "undecided", 3),
        (LATE, later(300, 301), [], 2, "undecided", 0),
        (LATE, later(*5 * [60]), FAST, REPEATS, "accelerated", 0),
        (LATE, later(*SIX), [], REPEATS, "undecided", 5),
        (LATE, later(*SIX, *5 * [60]), FAST, REPEATS, "accelerated", 0),
        (LATE, later(*ELEVEN), [], REPEATS, "undecided", 5),
        (LATE, later(*ELEVEN, *5 * [40]), [], REPEATS, "undecided", 0),
        *((FREE, later(*5 * [gain]), SLOW, REPEATS, "bystander", 0) for gain in (0, -40, 40)),
        # less than one e-folding, beyond any scatter
        (LITTLE, later(*5 * [40]), SLOW, REPEATS, "bystander", 0),
        (LATE, [], [], 0, "undecided", 0),
        (FREE, [], [], 0, "undecided", 0),
        # what was not seen counts for neither; seen to be later it counts
        (LATE, [Delay(1600, None, 2999, 1640)] * 5, [], REPEATS, "undecided", 5),
        (LATE, [Delay(1600, None, 2999, 1700)] * 5, FAST, REPEATS, "accelerated", 0),
        # clear at one displacement: the other one is looked at, without the pair
        (LATE, later(*5 * [60]), [], REPEATS, "undecided", 4),
        (FREE, later(*5 * [0]), FAST[:3], REPEATS, "undecided", 1),
        # where they are not alike, until nine of sixteen are, which settles it
        (LATE, later(*5 * [60]), later(*SIX[1:]), REPEATS, "undecided", 6),
        (LATE, later(*5 * [60]), later(*SIX[1:], *6 * [60]), REPEATS, "accelerated", 0),
        (LATE, later(*5 * [60]), later(*SIX[1:], *3 * [40, 60]), REPEATS, "undecided", 3),
        (LATE, later(*5 * [60]), later(*SIX[1:], *8 * [40]), REPEATS, "undecided", 0),
        # a majority is enough, a tie is not
        (LATE, later(*5 * [60]), later(*ELEVEN, 60, *5 * [40]), REPEATS, "accelerated", 0),
        (LATE, later(*5 * [60]), later(*ELEVEN, *6 * [40]), REPEATS, "undecided", 0),
        (LATE, later(*5 * [60]), later(*8 * [60, 40]), REPEATS, "undecided", 0),
        # and the other way there: no word, and no more repeats
        (LATE, later(*5 * [60]), SLOW, REPEATS, "undecided", 0),
        (FREE, later(*5 * [0]), FAST, REPEATS, "undecided", 0),
    ],
)
def test_words_that_rest_on_repeats(imposed, repeats, other, most, word, wanted):
    verdict = judge(DATES, FREE, imposed, TOLERANCE, repeats, most, other=other)
    assert (verdict.word, verdict.wanted) == (word, wanted)
    assert verdict.threshold == pytest.approx(50) and verdict.count is not None
    steps = {id(LATE): 300, id(LITTLE): 40, id(FREE): 0}[id(imposed)]
    assert verdict.e_foldings == pytest.approx(steps * RATE, rel=1e-6)
    sure = [(one.imposed or one.imposed_until + 1) - one.free for one in repeats if one.free is not None]
    assert verdict.count.later == sum(gain > 50 for gain in [steps, *sure])
    unseen = sum(one.imposed is None and gain <= 50 for one, gain in zip(repeats, sure, strict=True))
    assert verdict.count.not_later == 1 + len(repeats) - verdict.count.later - unseen
    # the other displacement is looked at where the first one is clear, and named where they disagree
    assert (verdict.other is not None) == (verdict.count.delayed is not None)
    ended = verdict.other is not None and not verdict.other.wanted_for_majority
    assert ("disagree" in dict(verdict.reasons)) == (ended and word == "undecided")


# --- the sequential sign test ---------------------------------------------------------------------------


def words(coins: np.ndarray, most: int) -> list[bool | None]:
    """What the rule says of rows of coins, each True for a pair that is delayed, drawn as it wants them."""
    said = []
    for row in coins:
        pairs = tuple(Delay(100, 160 if heads else 100, 500, 500) for heads in row)
        found = count(pairs[:1], 50.0, most)
        while found.wanted:
            found = count(pairs[: found.pairs + found.wanted], 50.0, most)
        said.append(found.delayed)
    return said


@pytest.mark.parametrize("pairs", [5, 6, 7, 11])
def test_fair_coins_are_taken_for_delayed_in_a_twentieth_of_all_sequences_at_most(pairs):
    """Looked at as often as the rule looks, by going through all of them."""
    every = (np.arange(2**pairs)[:, None] >> np.arange(pairs)) & 1
    said = words(every.astype(bool), pairs)
    for word in (True, False):
        assert 0.015 < said.count(word) / len(said) <= ERROR


def test_at_the_default_the_error_is_nearly_spent_and_a_clear_majority_is_found():
    tosses = np.random.default_rng(0).random((1500, 1 + REPEATS))
    # 0.0487; three standard errors of 1,500 draws
    assert abs(words(tosses < 0.5, 1 + REPEATS).count(True) / len(tosses) - 0.0487) < 0.0167
    said = words(tosses[:300] < 0.9, 1 + REPEATS)
    assert said.count(True) > 285 and said.count(False) == 0
    # five of five by coins: 1/32; four of four: 1/16
    assert FEWEST == 4 and looks(4) == () and looks(5) == ((5, 5),)


def word(first: Sequence[bool], other: Sequence[bool], most: int) -> str:
    """The verdict on a pair and its repeats, each True for one that is delayed, run as it wants them."""
    pair, *repeats = later(*(60 if heads else 40 for heads in first))
    others, used = later(*(60 if heads else 40 for heads in other)), [0, 0]
    while True:
        imposed = LATE if pair.beyond(50) else LITTLE
        given = repeats[: used[0]], most
        found = judge(DATES, FREE, imposed, TOLERANCE, *given, other=others[: used[1]])
        if not found.wanted:
            return found.word
        used[found.other is not None] += found.wanted


@pytest.fixture
def one_fit(monkeypatch):
    """The growth of the free run, fitted once: thousands of verdicts on it follow."""
    fit = growth(FREE, TOLERANCE)
    monkeypatch.setattr(verdicts, "growth", lambda separation, tolerance: fit)


def tosses(coins: int) -> list[tuple[bool, ...]]:
    return list(product((True, False), repeat=coins))


@pytest.mark.usefixtures("one_fit")
@pytest.mark.parametrize("most", [4, 6])
def test_whatever_the_other_displacement_says_no_more_than_a_twentieth_of_coins_gives_a_word(most):
    """All sequences of coins at either displacement."""
    coins = tosses(1 + most)
    for made, sure in (("accelerated", True), ("bystander", False)):
        always, never = (most + 1) * (sure,), (most + 1) * (not sure,)
        assert word(always, always, most) == made and word(always, never, most) == "undecided"
        # half of the pairs are delayed, and the other displacement always says the same, or the opposite
        said = [word(each, always, most) for each in coins]
        assert 0.015 < said.count(made) / len(said) <= ERROR
        assert not any(word(each, never, most) == made for each in coins)
        # certain at the first one, and half of the pairs at the other one: half of the words at most are left
        assert 0.3 < [word(always, each, most) for each in coins].count(made) / len(coins) <= 0.5


@pytest.mark.usefixtures("one_fit")
def test_of_coins_at_both_displacements_one_in_sixty_gives_a_word():
    said = [word(first, other, 4) for first in tosses(5) for other in tosses(5)]
    assert len(said) == 1024 and said.count("accelerated") == said.count("bystander") == 16


UNTIL = st.integers(0, 300)


@given(st.integers(1, 400), st.integers(1, 400), UNTIL, UNTIL, st.floats(0, 100))
def test_what_is_said_of_a_part_holds_of_the_whole(free, imposed, free_until, imposed_until, steps):
    """A split beyond what was followed is not seen; what is said all the same is true of it."""
    one, other = np.where(np.arange(401) < free, 0.0, 1.0), np.where(np.arange(401) < imposed, 0.0, 1.0)
    one[free_until + 1 :], other[imposed_until + 1 :] = np.nan, np.nan
    seen = Delay.of(one, other, TOLERANCE)
    assert (seen.free_until, seen.imposed_until) == (free_until, imposed_until)
    said = seen.beyond(steps)
    assert said is None or said == (imposed - free > steps)
    assert said is not None or seen.free is None or seen.imposed is None


# --- what a split owes to the decisions and what to the arithmetic --------------------------------------


def splits_at(step: int, until: int = STEPS) -> np.ndarray:
    """Grows at RATE and is beyond the tolerance from this step on; nothing after another one."""
    values = TOLERANCE * np.exp(RATE * (np.arange(STEPS) - step + 0.5))
    return np.where(np.arange(STEPS) <= until, values, np.nan)


def test_each_cell_and_each_share_is_what_its_name_says():
    series = {
        "B": splits_at(1000), "B|A": splits_at(1400), "B|A from B": splits_at(1100),
        "A|B from A": splits_at(950), "A|B": splits_at(9000, 2500),
    }  # fmt: skip
    rows = table(series, TOLERANCE)
    cells = {(cell.arithmetic, cell.decisions, cell.reference): (cell.split, cell.until) for cell in rows}
    assert cells == {
        ("A", "A", "A"): (None, 2999), ("B", "B", "A"): (1000, 2999), ("B", "A", "A"): (1400, 2999),
        ("A", "B", "A"): (950, 2999), ("A", "A", "B"): (1000, 2999), ("B", "B", "B"): (None, 2999),
        ("B", "A", "B"): (1100, 2999), ("A", "B", "B"): (None, 2500),
    }  # fmt: skip
    assert [cell.same for cell in rows].count(True) == 2
    # B under A's decisions differs from A in its arithmetic alone: what is taken away are the decisions
    assert [(one.what, one.reference, one.steps, one.at_least) for one in shares(rows, RATE)] == [
        ("decisions", "A", 400, False), ("decisions", "B", 1500, True),
        ("arithmetic", "A", -50, False), ("arithmetic", "B", 100, False),
    ]  # fmt: skip
    assert [one.e_foldings for one in shares(rows, RATE)] == pytest.approx([8.0, 30.0, -1.0, 2.0])


def test_what_was_not_run_or_did_not_split_has_no_share():
    # a run that ended before the split says nothing
    series = {"B": splits_at(1000), "B|A": splits_at(9000, 700), "B|A from B": splits_at(1001)}
    (found,) = shares(table(series, TOLERANCE), float("nan"))
    assert (found.what, found.reference, found.steps, found.e_foldings) == ("arithmetic", "B", 1, None)
    for series, cells in (
        ({"B": splits_at(9000), "B|A": splits_at(9000)}, 5), ({"B": splits_at(1000)}, 4)
    ):  # fmt: skip
        rows = table(series, TOLERANCE)
        assert len(rows) == cells and shares(rows, RATE) == ()
