"""The table in a real browser: sorting, searching and paging do what they say."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest
from report.synthetic import make_run

from mdnum.verbs import frame
from mdnum.verbs.run_page import TABLE_ROWS, RunView

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser installed")

SCRIPT = """
<script>
const lines = () => [...document.querySelectorAll("#flips tbody tr")];
const cells = (column) => lines().map((row) => row.cells[column].textContent);
const type = (text) => {
  const search = document.querySelector(".browse input");
  search.value = text;
  search.dispatchEvent(new Event("input"));
  return document.querySelector(".browse output").textContent;
};
const head = (column) => document.querySelector(`#flips th[data-column="${column}"] button`).click();
const seen = {};
seen.start = cells(0);
head(8); seen.ratio = cells(7); seen.sorted = document.querySelector('#flips th[data-column="8"]').ariaSort;
head(8); seen.ratio_down = cells(7);
head(0);
document.querySelectorAll(".browse .pager button")[1].click(); seen.second_page = cells(0);
seen.pages = document.querySelector(".browse .pager span").textContent;
seen.entered = type("entered"); seen.entered_words = cells(2);
seen.pair = type(PAIR); seen.pairs = cells(1);
seen.atom = type("atom " + ATOM); seen.atoms = cells(1);
seen.steps = type("step:10..12"); seen.step_cells = cells(0);
seen.none = type("step:10 left entered");
seen.unknown = type("colour");
seen.width = document.documentElement.scrollWidth;
const result = document.createElement("pre");
result.id = "result";
result.textContent = JSON.stringify(seen);
document.body.append(result);
</script>
"""


def test_sort_search_and_pages(tmp_path):
    folder = make_run(tmp_path / "run", steps=120, candidates=300)
    run = RunView(folder, folder.summary)
    page = frame.finish(folder).folder / "report.html"
    i, j = int(run.flips.nearest["i"][0]), int(run.flips.nearest["j"][0])
    script = SCRIPT.replace("PAIR", f'"{j}-{i}"').replace("ATOM", f'"{i}"')
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", script + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--window-size=390,800",
         f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    seen = json.loads(found[1].replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&"))

    total = run.flips.total
    assert 25 < total < TABLE_ROWS
    assert seen["start"] == [str(step) for step in run.flips.nearest["step"][:25]]
    assert seen["sorted"] == "ascending"
    assert seen["ratio"] != seen["ratio_down"]
    assert [exponent(text) for text in seen["ratio"]] == sorted(exponent(text) for text in seen["ratio"])
    assert exponent(seen["ratio_down"][0]) >= exponent(seen["ratio"][-1])
    assert seen["second_page"] == [str(step) for step in run.flips.nearest["step"][25:50]]
    assert seen["pages"] == f"page 2 of {-(-total // 25)}"
    assert seen["entered"] == f"{int(run.flips.nearest['entered'].sum()):,} of {total:,} rows"
    assert set(seen["entered_words"]) == {"entered"}
    assert set(seen["pairs"]) == {f"{i}–{j}"}
    assert all(str(i) in pair.split("–") for pair in seen["atoms"])
    within = (run.flips.nearest["step"] >= 10) & (run.flips.nearest["step"] <= 12)
    assert seen["steps"] == f"{int(within.sum()):,} of {total:,} rows"
    assert set(seen["step_cells"]) <= {"10", "11", "12"}
    assert seen["none"] == f"0 of {total:,} rows"
    assert seen["unknown"] == "“colour” is not understood"
    # nothing sticks out of a phone's screen (headless browsers do not go below 500 pixels)
    assert seen["width"] <= 500


def exponent(text: str) -> float:
    mantissa, _, power = text.partition(" × 10")
    return float(mantissa) * 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)
