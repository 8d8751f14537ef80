"""Words as people read them, from what programs write."""

from __future__ import annotations

import pytest

from mdnum.report import words
from mdnum.report.words import heading, typeset


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("at -8.3e-17 m and 1.4e-16 m", "at −8.3\u00a0×\u00a010⁻¹⁷ m and 1.4\u00a0×\u00a010⁻¹⁶ m"),
        ("below 1e-12", "below 10⁻¹²"),
        ("1.5E+06.", "1.5\u00a0×\u00a010⁶."),
        ("2^15 and 10^-3", "2¹⁵ and 10⁻³"),
        ("from h sqrt(k) = 0.23 on", "from h √k = 0.23 on"),
        ("(-1, -.5)", "(−1, −.5)"),
        ("0x1.03ecfe9b7bf1fp+0", "0x1.03ecfe9b7bf1fp+0"),
        ("2-3 steps of tf32-in-solver", "2-3 steps of tf32-in-solver"),
        ("float32e-3, v1.2e3x", "float32e-3, v1.2e3x"),
        ("−1.5 stays", "−1.5 stays"),
    ],
)
def test_typeset(written, read):
    assert typeset(written) == read
    assert typeset(read) == read


def test_a_heading_has_a_capital_unless_it_begins_with_a_name():
    headings = {
        "the pair": "The pair",
        "a column": "A column",
        "k against y": "k against y",
        "jnp.sum hides it": "jnp.sum hides it",
        "dloss/dk": "dloss/dk",
        "TF32": "TF32",
        "": "",
    }
    assert {text: heading(text) for text in headings} == headings


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (None, "–"), (float("nan"), "–"), (float("-inf"), "−∞"), (123456.0, "123,456"),
        (1234567.0, "1.23\u00a0×\u00a010⁶"), (-1.681e-4, "−1.68\u00a0×\u00a010⁻⁴"), (0.00123, "0.00123"),
        (9.999e-4, "0.00100"), (999.96, "1,000"), (0.5, "0.500"),
    ],
)  # fmt: skip
def test_numbers_as_words(value, text):
    assert words.number(value) == text


def test_shares_never_claim_all_or_nothing():
    shares = {
        0.0: "0 %",
        1.0: "100 %",
        1e-9: "under 0.1 %",
        0.99999: "over 99.9 %",
        0.021: "2.1 %",
        1.08: "108 %",
    }
    assert {share: words.percent(share) for share in shares} == shares
