"""The graph of causes: every code is in it, and what it says holds of planted mistakes."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from mdnum.audit.base import finding
from mdnum.audit.causes import CAUSES, TESTS
from mdnum.verbs.audit import TEXTS

#: Codes as words in the source of a check.
_WORD = re.compile(r'"([A-Z][A-Z]+(?:_[A-Z]+)*)"')


def in_sources() -> set[str]:
    """Codes of findings in the source of the audit."""
    folders = [files("mdnum") / folder for folder in ("audit", "audit/checks")]
    sources = [one for folder in folders for one in folder.iterdir() if one.name.endswith(".py")]
    sources += [files("mdnum") / "verbs/audit.py"]
    text = "\n".join(one.read_text() for one in sources if one.name != "causes.py")
    made = set(re.findall(r'finding\(\s*"([A-Z_]+)"', text))
    return made | {word for word in _WORD.findall(text) if word in TEXTS.entries}


def test_every_code_is_in_the_graph_and_has_sentences():
    codes = {code for code in TEXTS.entries if code.isupper()}
    assert codes == in_sources() <= set(CAUSES) and len(codes) > 50


def test_the_graph_is_sound():
    order = list(CAUSES)
    for code, row in CAUSES.items():
        assert {*row.brings, *row.rivals} <= set(CAUSES), code
        assert set(row.tests) <= set(TESTS), code
        # what is above is not also below: no circle
        assert all(code not in CAUSES[other].brings for other in row.brings), code
        assert all(order.index(code) < order.index(other) for other in row.brings if CAUSES[other].brings), (
            code
        )


def test_a_cause_is_not_named_without_the_tests_that_separate_it():
    with pytest.raises(ValueError, match="repeat"):
        finding("NOT_REPEATABLE", "error")
    assert finding("NOT_REPEATABLE", "error", tests=("repeat",)).code == "NOT_REPEATABLE"
