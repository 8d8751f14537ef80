"""Numbers that pages quote are those of files that commands wrote; what is older than the code is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from programs import module_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def maker():
    """scripts/makers/measure_documents.py as a module."""
    return module_of("scripts/makers/measure_documents.py")


@pytest.fixture
def measured(maker, tmp_path):
    """A measurement of two settings, of code in a folder of its own."""
    code = tmp_path / "code"
    code.mkdir()
    (code / "a.py").write_text('"""A module."""\n\nX = 1  # one\n')
    folder = tmp_path / "measured"
    folder.mkdir()
    said = {"fork": {"settings": {"a": {}, "b": {}}, "measures": ["code"]}}
    known = {
        "cpu": "Z80",
        "jax": "0",
        "day": "2026-01-01",
        "commit": "abc",
        "digest": maker.digest(["code"], tmp_path),
    }
    rows = [
        {"setting": name, **known, "values": {"step": step}} for name, step in (("a", "1,863"), ("b", "303"))
    ]
    (folder / "fork.json").write_text(json.dumps(rows))
    return said, folder, code


def test_pages_quote_what_was_measured(maker):
    said, quoted = maker.declared(), 0
    for page in maker.pages():
        text = page.read_text(encoding="utf-8")
        quoted += text.count("<!--=-->")
        assert maker.filled(text, said) == text, f"{page.name}: run scripts/makers/measure_documents.py"
        # a line that begins with a comment ends the paragraph, and what follows it is shown as it is written
        assert "\n<!--=" not in text, f"{page.name}: a mark begins a line"
    assert quoted > 5


def test_a_value_and_a_table_are_filled_in(maker, measured):
    said, folder, _ = measured
    text = "At <!--=fork step-->9<!--=-->.\n\n<!--table fork setting step-->\nold\n<!--table-->\n"
    new = maker.filled(text, said, folder)
    assert "At <!--=fork step-->1,863<!--=-->." in new
    assert "| a | 1,863 |\n| b | 303 |" in new and "old" not in new
    assert maker.filled(new, said, folder) == new
    with pytest.raises(KeyError, match="grad was not measured"):
        maker.filled("<!--=grad x--><!--=-->", {"grad": {}}, folder)


def test_a_number_is_old_where_its_code_has_changed_and_not_where_a_comment_has(maker, measured, tmp_path):
    said, folder, code = measured
    assert maker.old(said, folder, tmp_path) == []
    (code / "a.py").write_text('"""Another text."""\n\n# why\nX = 1\n')
    assert maker.old(said, folder, tmp_path) == []
    (code / "a.py").write_text("X = 2\n")
    assert maker.old(said, folder, tmp_path) == [
        "fork (a, Z80): 2026-01-01, abc",
        "fork (b, Z80): 2026-01-01, abc",
    ]


@pytest.mark.nightly
def test_no_number_is_older_than_the_code(maker):
    assert maker.old(maker.declared()) == []
