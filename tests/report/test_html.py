"""The page: whole, self-contained, small, and true to the folder."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from report.synthetic import TOML, make_run

from mdnum.report import analysis, figures, findings, html, svg, words
from mdnum.report.run import TABLE_ROWS, load
from mdnum.rollout.summary import Line
from mdnum.store import RunFolder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "run", steps=700, candidates=1500)


@pytest.fixture(scope="module")
def page(folder):
    return html.write_report(folder).read_text(encoding="utf-8")


class Tags(HTMLParser):
    """Refuses a document whose elements do not close."""

    VOID = frozenset({"meta", "input", "br", "link", "img"})

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.ids, self.sources = [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href") and not value.startswith("#"):
                self.sources.append(value)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_one_whole_file_that_loads_nothing(page):
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.sources == []
    assert len(tags.ids) == len(set(tags.ids))
    assert "@import" not in page and not re.search(r"url\((?!#)", page)
    assert not {"link", "img", "iframe"} & set(tags.seen)
    assert tags.seen.count("svg") == 10
    assert len(page) < 3_000_000


def test_every_reference_of_a_figure_has_its_target(page):
    ids = set(re.findall(r'id="([^"]+)"', page))
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used and used <= ids


def test_the_page_states_what_the_folder_holds(page, folder):
    run = load(folder)
    assert "The record is complete; to be known: every flip kicks the energy." in page
    assert f"All {run.flips_total:,} flips are accounted for" in page
    assert "HARD_CUTOFF" in page and "prefers-color-scheme: dark" in page and "@media print" in page
    assert "Liquid argon (Rahman 1964)" in page and "9f1c52d0a7b3e4c8" in page
    assert "of the force scale" in page


def test_the_table_carries_the_flips_nearest_to_the_cutoff(page, folder):
    run = load(folder)
    rows = json.loads(re.search(r'id="flip-rows">(.*?)</script>', page, re.DOTALL)[1])
    assert len(rows) == TABLE_ROWS < run.flips_total
    flips = folder.read("flips")
    assert f"The 5,000 flips nearest to the cutoff, of {run.flips_total:,}" in page
    shown = {(step, i, j) for step, i, j, *_ in rows}
    ratio = np.abs(flips["margin"]) / flips["bound"]
    nearest = np.argsort(ratio)[:TABLE_ROWS]
    assert shown == {(int(flips["step"][row]), int(flips["i"][row]), int(flips["j"][row])) for row in nearest}
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)


def test_figures_are_files_of_their_own(folder, page):
    names = sorted(path.name for path in (folder.path / "figures").iterdir())
    assert names == ["energy.svg", "flips.svg", "lists.svg", "margins.svg", "residence.svg"]
    for name in names:
        text = (folder.path / "figures" / name).read_text(encoding="utf-8")
        ElementTree.fromstring(text)
        used = set(re.findall(r"var\(--(\w+)\)", text))
        assert used <= set(svg.LIGHT) == set(svg.DARK)
        # a color that no theme knows would vanish on one of the two backgrounds
        assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= {*svg.LIGHT.values(), *svg.DARK.values()}


def test_the_same_folder_gives_the_same_page(folder, page):
    assert html.write_report(folder.path).read_text(encoding="utf-8") == page


def test_text_from_a_file_is_no_markup(tmp_path):
    toml = TOML.replace("Liquid argon", "<script>alert(1)</script> </pre>")
    folder = make_run(tmp_path / "run", steps=20, candidates=50, toml=toml)
    page = html.write_report(folder).read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_a_run_without_flips_and_one_that_was_killed_have_pages(tmp_path):
    still = make_run(tmp_path / "still", steps=5, candidates=0, summary={"ase": None, "cutoff": None})
    page = html.write_report(still).read_text(encoding="utf-8")
    assert "No pair flipped" in page and "<p>None.</p>" in page and "Not compared" in page
    killed = make_run(tmp_path / "killed", steps=60, candidates=100, finish=False)
    page = html.write_report(killed).read_text(encoding="utf-8")
    assert "The run ended early, after 30 steps" in page
    assert RunFolder.open(killed.path).resume() == {"step": 30}


def test_bad_numbers_do_not_break_the_page(tmp_path):
    folder = make_run(tmp_path / "run", steps=30, candidates=100, summary={"status": "failed"})
    columns = folder.read("series")
    for name in ("potential", "total", "conserved", "temperature", "pressure"):
        columns[name] = columns[name].copy()
        columns[name][-1] = np.nan
    broken = RunFolder.create(tmp_path / "broken")
    broken.write_system(folder.system_toml)
    broken.append("series", columns)
    broken.append("flips", folder.read("flips"))
    broken.finalize()
    broken.write_summary({**folder.summary, "energy_drift": None, "energy_budget_residual": None})
    page = html.write_report(broken).read_text(encoding="utf-8")
    assert "Do not rely on this run: the run failed at step 30" in page


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


def test_a_run_in_which_nothing_moves_has_a_page(folder):
    """One atom, atoms at rest, pairs that never meet: the budget's residual does not move by a bit."""
    run = load(folder)
    still = {
        name: np.zeros_like(run.series[name]) for name in ("energy_jump", "temperature", "entered", "left")
    }
    still |= {name: np.full_like(run.series[name], run.series[name][0]) for name in ("conserved", "pairs")}
    none = {name: values[:0] for name, values in folder.read("flips").items()}
    none = analysis.scan(none, len(run.series["step"]))
    quiet = replace(run, series={**run.series, **still}, flips=none)
    assert findings.sharpness(quiet) == (pytest.approx(1e-4, rel=10), 0.0)
    text = html.render(quiet, findings.judge(quiet), dict.fromkeys(figures.FIGURES, ""))
    assert "would be all that moves it" in text
    for name in ("energy", "flips"):
        assert figures.draw(name, quiet).axes


def test_a_run_without_a_skin_has_a_page(folder):
    run = load(folder)
    bare = replace(run, epochs={**run.epochs, "skin_consumed": np.full(len(run.epochs["epoch"]), np.inf)})
    assert "a list serves one step" in html.render(
        bare, findings.judge(bare), dict.fromkeys(figures.FIGURES, "")
    )
    assert np.isfinite(figures.draw("lists", bare).axes[0].get_ylim()).all()


@pytest.mark.parametrize("step", [1e-300, 1e-160, 0.0, 1e160])
def test_a_time_that_has_no_slope(step):
    line = Line()
    line.add(step * np.arange(5), np.arange(5.0))
    assert line.slope is None


def test_a_killed_run_of_vanishing_steps_has_a_verdict(folder):
    run = load(folder)
    killed = {k: v for k, v in run.summary.items() if k != "energy_drift_without_jumps"}
    short = replace(run, summary=killed, series={**run.series, "time": run.series["time"] * 1e-300})
    assert findings.judge(short).headline
