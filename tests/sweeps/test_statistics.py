"""Errors of means, differences and what could have been seen, against series whose errors are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, ttest_ind

from mdnum.sweeps.measures import correlated
from mdnum.sweeps.statistics import corrected, difference, estimates, paired, within


def series(rng: np.random.Generator, phi: float, length: int) -> np.ndarray:
    """An autoregressive process, in equilibrium from the start."""
    return np.asarray(lfilter([1], [1, -phi], rng.standard_normal(length + 400)))[400:]


def differences(pairs: dict[tuple[str, ...], Any]) -> Any:
    return corrected({name: difference(one, base) for name, (one, base) in pairs.items()})


def test_the_error_of_a_correlated_mean():
    rng, phi, length = np.random.default_rng(1), 0.8, 600
    found = np.array([correlated(series(rng, phi, length)) for _ in range(60)])
    true = np.sqrt((1 + phi) / (1 - phi) / (1 - phi**2) / length)
    assert np.sqrt(np.mean(found[:, 1] ** 2)) == pytest.approx(true, rel=0.25)
    assert np.median(found[:, 2]) == pytest.approx(length * (1 - phi) / (1 + phi), rel=0.4)
    begun = series(rng, phi, length) + 30 * np.exp(-np.arange(length) / 30)
    value, error, _ = correlated(begun)
    assert abs(value) < 4 * error < 1.2 < begun.mean()
    assert correlated(np.full(50, 2.0)) == (2.0, 0.0, 50.0)


def test_without_errors_of_runs_a_difference_is_that_of_welch():
    rng = np.random.default_rng(2)
    a, b = rng.normal(0, 1, 6), rng.normal(1, 3, 9)
    made = estimates({"a": [(x, np.nan, np.nan) for x in a], "b": [(x, np.nan, np.nan) for x in b]})
    (one,) = differences({("b",): (made["b"], made["a"])}).values()
    expected: Any = ttest_ind(b, a, equal_var=False)
    assert one.sigmas == pytest.approx(expected.statistic)
    assert one.chance == pytest.approx(min(1, expected.pvalue / 0.8))


def test_slow_modes_that_runs_do_not_see_scale_their_errors():
    """Runs whose means scatter three times as far as they know."""
    rng = np.random.default_rng(3)
    rows = {k: [(rng.normal(0, 3), 1.0, 100.0) for _ in range(6)] for k in range(8)}
    made = estimates(rows)
    assert all(one.error == pytest.approx(3 / 6**0.5, rel=0.3) for one in made.values())
    assert all(30 < one.freedom < 41 for one in made.values())
    alone = estimates({0: [(1.0, 0.5, 50.0)], 1: [(2.0, np.nan, np.nan)]})
    assert alone[0].error == 0.5 and not alone[1].known


def test_chances_are_corrected_and_what_cannot_be_told_is_not_counted():
    made = estimates(
        {0: [(0.0, 1.0, 1e6)], 1: [(3.0, 1.0, 1e6)], 2: [(0.1, 1.0, 1e6)], 3: [(9.0, np.nan, np.nan)]}
    )
    found = differences({(str(k),): (made[k], made[0]) for k in (1, 2, 3)})
    assert found["1",].chance == pytest.approx(2 * 0.0338949 / 0.8, rel=1e-3)
    assert found["3",].moves is None and found["1",].moves is False
    # nine times of ten, at half of four fifths of the chance of a mistake
    assert found["1",].detectable == pytest.approx(2**0.5 * (2.3263 + 1.2816), rel=1e-3)


def test_equivalence():
    assert within(0.1, 0.1, np.inf, 1.0).inside is True
    assert within(2.0, 0.1, np.inf, 1.0).inside is False
    undecided = within(0.5, 0.5, np.inf, 1.0)
    assert undecided.inside is None
    assert undecided.more == pytest.approx((0.5 * 1.6449 / 0.5) ** 2, rel=1e-3)
    assert within(np.nan, 1.0, 3.0, 1.0).inside is None


def test_correlated_seeds_are_compared_by_seed():
    """Where runs of one seed have much in common, the scatter of their differences is the error."""
    rng = np.random.default_rng(6)
    start = rng.normal(0, 10, 8)
    runs = {k: [(x, 1.0, 50.0) for x in start + rng.normal(0.5 * k, 1, 8)] for k in range(3)}
    made = estimates(runs)
    raw = {k: difference(made[k], made[0]) for k in (1, 2)}
    by_seed = {k: np.array([a[0] - b[0] for a, b in zip(runs[k], runs[0], strict=True)]) for k in raw}
    found = paired(raw, by_seed)
    for k, one in by_seed.items():
        assert found[k] == pytest.approx((one.mean(), one.std(ddof=1) / 8**0.5, 7.0))
        assert found[k][1] < 0.3 * raw[k][1]
    # in another order of the seeds they have nothing in common
    mixed = {k: np.array([a[0] - b[0] for a, b in zip(runs[k], runs[0][::-1], strict=True)]) for k in raw}
    assert paired(raw, mixed) == raw
    assert paired(raw, {k: one[:2] for k, one in by_seed.items()}) == raw
    # of equal differences the rounding of the values remains
    same = paired(raw, {k: np.full(8, 0.5) for k in raw})
    assert 0 < same[1][1] < 1e-11


@pytest.mark.nightly
@pytest.mark.parametrize(("common", "sweeps"), [(0.0, 1200), (7.0, 600)])
def test_false_alarms_and_power(common, sweeps):
    """Sweeps of two values, four measures and eight seeds; one value moves one measure by 4.5 errors.

    Args:
        common: scatter of what all runs of a seed have in common, in errors of a run.
    """
    rng, seeds, settings = np.random.default_rng(4), 8, 3
    phis = (0.0, 0.5, 0.8, 0.9)
    errors = [np.std([correlated(series(rng, phi, 400))[0] for _ in range(400)]) for phi in phis]
    false, seen, unpaired = 0, 0, 0
    for _ in range(sweeps):
        raw, made = {}, {}
        for m, (phi, error) in enumerate(zip(phis, errors, strict=True)):
            shift = 4.5 * error * (2 / seeds) ** 0.5 * (m == 2)
            starts = common * error * rng.standard_normal(seeds)
            rows = {
                s: [correlated(series(rng, phi, 400) + shift * (s == 2) + start) for start in starts]
                for s in range(settings)
            }
            means = estimates(rows)
            alone = {(str(m), str(s)): difference(means[s], means[0]) for s in range(1, settings)}
            by_seed = {
                (str(m), str(s)): np.array([a[0] - b[0] for a, b in zip(rows[s], rows[0], strict=True)])
                for s in range(1, settings)
            }
            raw |= alone
            made |= paired(alone, by_seed)
        found = corrected(made)
        false += any(one.moves for key, one in found.items() if key != ("2", "2"))
        seen += found["2", "2"].moves is True
        unpaired += corrected(raw)["2", "2"].moves is True
    assert false <= binom.ppf(0.95, sweeps, 0.05)
    if common:
        assert seen > 0.5 * sweeps > 10 * unpaired
    else:
        assert seen >= binom.ppf(0.05, sweeps, 0.9)
