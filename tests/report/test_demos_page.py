"""The page of the demonstrations: every one listed, what ran told in full, and nothing loaded."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from report.synthetic_demos import make_demos
from report.test_html import Tags

from mdnum.ball.demos import NAMES
from mdnum.report.ball import values
from mdnum.report.ball.demos import TABLE_ROWS, write_report


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_report(tmp_path_factory.mktemp("demos") / "new", make_demos()).parent


@pytest.fixture(scope="module")
def page(folder):
    return (folder / "report.html").read_text(encoding="utf-8")


def test_one_whole_file_that_loads_nothing(page):
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and tags.sources == []
    assert len(tags.ids) == len(set(tags.ids))
    assert tags.seen.count("svg") == 2 * sum(len(demo.plots) for demo in make_demos())
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used <= set(tags.ids)


def test_all_sixteen_are_listed_with_what_became_of_them(page):
    contents = page[page.index("<nav") : page.index("</nav>")]
    items = re.findall(r"<li>(.*?)</li>", contents)
    assert len(items) == len(NAMES) == 16
    for name, item in zip(NAMES, items, strict=True):
        mark = {"sum-order": ">ok<", "stiffness": ">failed<"}.get(name, ">not run<")
        assert name in item and mark in item
    assert "1 of 2 demonstrations did not come out: stiffness." in page
    assert "2 of 3 checks held." in page


def test_a_section_says_what_the_demonstration_returned(page):
    section = page[page.index('id="sum-order"') : page.index('id="stiffness"')]
    for text in ("Can the order of five terms", "0.0009760856628<", "−8.198\u00a0×\u00a010⁻⁸", "Running sum",
                 "16377/16777216", "In molecular dynamics", "[yes, no]", 'href="#stiffness"'):  # fmt: skip
        assert text in section, text
    assert 'title="0.0009760856628417969"' in section
    other = page[page.index('<section class="demo" id="stiffness"') :]
    assert "overflows &lt;b&gt;" in other and "<b>" not in other
    assert f"{75 - TABLE_ROWS} more rows in" in other


def test_figures_and_numbers_are_files(folder):
    names = {path.name for path in (folder / "figures").iterdir()}
    expected = {f"{demo.name}-{n + 1}.svg" for demo in make_demos() for n in range(len(demo.plots))}
    assert names == expected
    first, second = json.loads((folder / "demos.json").read_text(encoding="utf-8"))
    assert first["numbers"]["large_first"] == 0.0009760856628417969
    assert first["numbers"]["phase"] == [1.0, -2.0]
    assert first["data"] == {"history": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], "bad": None}
    assert first["ok"] is True and second["ok"] is False
    assert first["tables"][0]["rows"][2] == [2, 2.0**-23, None, "16378/16777216", None]
    assert len(second["tables"][0]["rows"]) == 75


def test_the_same_demonstrations_give_the_same_page(folder, page):
    assert write_report(folder, make_demos()).read_text(encoding="utf-8") == page


def test_no_demonstration_is_a_page_too(tmp_path):
    page = write_report(tmp_path, []).read_text(encoding="utf-8")
    assert "No demonstration was run." in page


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0009760856628417969, "0.0009760856628"), (np.float16(2.0**-10), "0.0009765625"), (0.1, "0.1"),
        (True, "yes"), (np.False_, "no"), (None, "–"), (-8.198341e-8, "−8.198341\u00a0×\u00a010⁻⁸"),
        (-3, "−3"), (12_345, "12,345"), (float("nan"), "NaN"), (-float("inf"), "−∞"), (2.0, "2"),
        (np.arange(3), "[0, 1, 2]"), (1234.5, "1234.5"), (1e6, "1000000"), (0.99951171875, "0.9995117188"),
        (123456.789, "123456.789"), ("hex 0x1p-3", "hex 0x1p-3"), (1.5 - 2j, "1.5 − 2 i"),
    ],
)  # fmt: skip
def test_values_as_text(value, text):
    assert values.value_text(value) == text


def test_a_column_has_as_many_digits_as_tell_its_numbers_apart():
    assert values.cells([1 / 3, 2 / 3]) == ["0.33333", "0.66667"]
    near = [1.0, 1.0 + 2.0**-52]
    assert values.cells(near) == ["1", "1.0000000000000002"]
    assert values.cells([1, None, 2.0, "x", float("nan")]) == ["1", "–", "2", "x", "NaN"]


def test_narrow_formats_are_numbers():
    import ml_dtypes

    assert values.value_text(ml_dtypes.bfloat16(0.125)) == "0.125"
    assert values.json_value(np.array([1, 2], ml_dtypes.bfloat16)) == [1.0, 2.0]
    assert (
        values.is_number(ml_dtypes.bfloat16(1)) and not values.is_number(True) and not values.is_number("1")
    )
