"""The page of a comparison: whole, true to the folder, and judged by what the folder holds."""

from __future__ import annotations

import json
import re
import subprocess
from typing import Any

import numpy as np
import pytest
from report.synthetic_fork import (
    DECISION,
    FORK,
    NEAR,
    PINNED,
    RATE,
    SIZE,
    STEPS,
    TOLERANCE,
    make_fork,
    make_screen,
    ranked,
)
from report.test_browser import BROWSER

from mdnum.errors import FolderError
from mdnum.report.section import Plot, Table
from mdnum.store import RunFolder
from mdnum.verbs import fork_verdict, frame
from mdnum.verbs.frame import View


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return frame.finish(make_fork(tmp_path_factory.mktemp("forks") / "run"))


def finished(path, **summary):
    """A folder with these entries, judged and shown."""
    return frame.finish(make_fork(path, summary=summary), report=False)


def part(outcome, title, kind) -> Any:
    """The first part of a kind in a section."""
    (section,) = (one for one in outcome.page.sections if one.title == title)
    return next(one for one in section.parts if isinstance(one, kind))


def test_the_page_has_a_figure_for_everything_there_is(outcome):
    names = sorted(path.stem for path in (outcome.folder / "figures").iterdir())
    assert names == ["atoms", "cross", "energy", "furthest", "overridden", "protection", "separation"]
    text = (outcome.folder / "report.html").read_text(encoding="utf-8")
    assert len(text) < 2_000_000 and "0123456789abcdef" in text
    assert [one.title for one in outcome.page.sections] == [
        "Separation", "The decision at the fork", "Whose decisions, whose arithmetic",
        "One decision overridden", "Minimal cause", "How far the decisions are certain", "Growth",
        "After the fork", "Decisions that differ", "What was compared",
    ]  # fmt: skip
    keys = {key.label: key.value for key in outcome.page.keys}
    split = outcome.summary["split"]
    assert keys["Fork"] == "step 400" and keys["Split"] == f"step {split:,}" and keys["First bit"] == "step 5"
    assert keys["The flips were worth"] == "> 3.58" and keys["Decisions that differ"] == "7,000"


def test_the_tables_of_the_page_are_those_of_the_folder(outcome):
    split = outcome.summary["split"]
    runs = part(outcome, "Whose decisions, whose arithmetic", Table)
    assert runs.rows == [
        ("A", "its own", "is A", f"{split:,}"), ("B", "its own", f"{split:,}", "is B"),
        ("B", "A’s", "> 1,500", f"{split - 1:,}"),
    ]  # fmt: skip
    pairs = part(outcome, "Minimal cause", Table)
    assert pairs.rows == [("3–4", "400 to 406, 420, 430 to 459, and 1 time more"), ("3–9", "from 410 on")]
    certain = dict(part(outcome, "How far the decisions are certain", Table).rows)
    assert "step 70 " in certain["Certified, B"] and "2,860 ambiguous decisions" in certain["Certified, B"]
    assert "5–8" in certain["Certified, B"] and "step 389" in certain["Protected"]
    growth = dict(part(outcome, "Growth", Table).rows)
    assert "doubles in 34.7 steps" in growth["A and B, free"]
    assert "1.05 times as fast" in growth["Lyapunov exponent"] and "1,702" in growth["An ulp of the start"]


def test_the_figure_shows_both_separations_and_the_dates(outcome):
    plot = part(outcome, "Separation", Plot)
    by_label = {series.label: series for series in plot.series}
    free, imposed = by_label["A and B, free"], by_label["A and B under A’s decisions"]
    assert np.nanmax(free.y) == 0.5 and np.nanmax(imposed.y) == SIZE
    assert np.isnan(free.y[:5]).all(), "zeros before the first differing bit have no logarithm"
    assert [round(at) for at, _ in plot.verticals] == [5, FORK, outcome.summary["split"]]
    assert plot.horizontals[0][0] == TOLERANCE and plot.y_scale == "log"
    fit = by_label["growth, fitted"]
    assert np.diff(np.log(fit.y)).sum() / (fit.x[-1] - fit.x[0]) == pytest.approx(RATE)
    assert fit.y[0] == pytest.approx(SIZE) and "B and A under B’s decisions" not in by_label
    # a point below the line is where protection ends
    plot = part(outcome, "How far the decisions are certain", Plot)
    near, moved = plot.series
    assert (near.y < np.nan_to_num(moved.y)).argmax() == NEAR and moved.y[FORK - 1] == 2 * SIZE
    assert plot.verticals[0] == (NEAR - 1.0, "protected")


def test_a_poor_fit_is_not_drawn_and_a_predicted_split_is(tmp_path):
    fit = {"rate": 0.01, "r_squared": 0.3, "first": 400, "last": 900, "intercept": -20.0}
    poor = finished(tmp_path / "poor", growth={"B": fit})
    assert "growth, fitted" not in [series.label for series in part(poor, "Separation", Plot).series]
    plot = part(finished(tmp_path / "open", split=None, predicted_split=2000), "Separation", Plot)
    assert (2000.0, "split expected") in plot.verticals
    assert max(series.x.max() for series in plot.series) == 2000


COUNT = {"pairs": 16, "later": 9, "not_later": 7, "most": 16, "threshold": 43.2, "needed": [16, 12]}
NONE = {"first_bit": None, "fork": None, "split": None, "decision": None}


@pytest.mark.parametrize(
    ("entries", "tone", "name"),
    [
        ({}, "info", "cause"),
        ({"effect": "accelerated", "splits": {"B|A": 1400}, "count": COUNT}, "info", "accelerated"),
        ({"effect": "bystander", "count": COUNT}, "info", "bystander"),
        ({"effect": "bystander", "split": 300}, "info", "bystander_before"),
        ({"effect": "undecided"}, "info", "undecided"),
        ({"effect": "open", "split": None}, "info", "open"),
        ({"effect": "open", "split": None, "predicted_split": 9000, "predicted_by": "growth"}, "info",
         "open_growth"),
        ({"effect": "open"}, "info", "open_split"),
        ({"effect": "no fork", "fork": None, "split": None, "decision": None}, "good", "no_fork"),
        ({"effect": "no fork", "fork": None, "decision": None}, "good", "no_fork_split"),
        ({"effect": "same", **NONE}, "good", "same"),
        ({"effect": "same", "first_bit": None, "split": None}, "info", "same_but_decided"),
        ({"failed": {"B": "blow-up"}, "status": "failed"}, "warning", "ended"),
        ({"failed": {"A": "runaway"}, "decision": None}, "warning", "ended_fork"),
        ({"failed": {"A": "runaway", "B": "blow-up"}}, "warning", "ended_both"),
        ({"must_hold": True}, "error", "cause"),
    ],
)  # fmt: skip
def test_every_verdict_has_its_sentence(tmp_path, entries, tone, name):
    found = finished(tmp_path / "one", **entries)
    view = View(RunFolder.open(found.folder), found.summary)
    assert fork_verdict._headline(view)[0] == name
    assert found.verdict.tone == tone and "–" not in found.verdict.headline.replace("3–4", "")
    assert not found.verdict.headline.endswith("..")


def test_repeats_are_in_the_page_as_ranges(tmp_path):
    repeated = [{"free": 1300, "imposed": 1410}, {"free": 1280, "imposed": None}]
    found = finished(tmp_path / "one", repeated=repeated, count=COUNT)
    rows = part(found, "Whose decisions, whose arithmetic", Table).rows[-2:]
    assert [row[2] for row in rows] == ["1,280 to 1,300", "1,410 to 1,410; 1 of 2 not seen to"]
    assert "15 repeats" in dict(part(found, "What was compared", Table).rows)["Chance"]


def test_findings_are_those_that_apply(tmp_path):
    def findings(name, **entries):
        return finished(tmp_path / name, **entries).verdict.findings

    def codes(name, **entries):
        return {finding.code: finding.severity for finding in findings(name, **entries)}

    assert codes("plain") == {}
    ambiguous = DECISION | {"ambiguous_in": ["B"], "margins": {"B": 1e-16}, "bounds": {"B": 2e-15}}
    assert codes("doubt", decision=ambiguous) == {"AMBIGUOUS_FORK": "info"}
    assert codes("short", split=None, effect="open") == {"HORIZON_SHORT": "info"}
    assert codes("guard", imposed_until=900) == {"GUARD": "info"}
    assert codes("failed", imposed_until=900, failed_imposed={"B|A": "runaway"}) == {"GUARD": "info"}
    assert codes("held", must_hold=True) == {"MUST_HOLD_FORKED": "error"}
    kept = {"code": "OF_OTHERS", "severity": "warning", "title": "look", "text": "there"}
    stale = {"code": "GUARD", "severity": "info", "title": "no longer", "text": "so"}
    assert codes("kept", findings=[kept, stale]) == {"OF_OTHERS": "warning"}
    # what the repeats leave open names what would do
    (more,) = findings("alone", effect="undecided", count=COUNT)
    assert (more.code, more.values["more"], more.values["need"]) == ("UNDECIDED", 30, 12)
    one = COUNT | {"pairs": 1, "later": 1, "not_later": 0, "most": 1, "needed": None}
    (none,) = findings("none", effect="undecided", count=one)
    assert none.values["more"] == 15 and none.values["need"] is None


def test_a_decision_that_was_overridden_is_said_and_why_another_could_not_be(tmp_path):
    for name, entries, sentence in (
        ("kept", {}, "pinned_kept"), ("split", {"last": 400, "split": 1333}, "pinned_splits"),
        ("none", {"pairs": None, "reason": "the runs do not fork"}, "pinned_none"),
    ):  # fmt: skip
        pinned = PINNED | entries
        told = part(finished(tmp_path / name, pinned=pinned), "One decision overridden", str)
        values = {**pinned, "pairs": "3–4", "unit": "σ"}
        assert told == fork_verdict.TEXTS(sentence, **values)


def test_bare_folders_have_pages(tmp_path):
    bare = frame.finish(make_fork(tmp_path / "bare", forks=False, imposed=False))
    titles = [section.title for section in bare.page.sections]
    assert not {"The decision at the fork", "Whose decisions, whose arithmetic", "Minimal cause"} & set(
        titles
    )
    names = sorted(path.stem for path in (bare.folder / "figures").iterdir())
    assert names == ["energy", "protection", "separation"]
    same = make_fork(tmp_path / "same", summary={"about": "<script>alert(1)</script>", "choice": "<b>x"})
    text = (frame.finish(same).folder / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text and "<b>x" not in text
    unfinished = RunFolder.create(tmp_path / "unfinished", world="fork")
    unfinished.finalize()
    with pytest.raises(FolderError, match="holds no answer"):
        frame.finish(unfinished)


def test_a_screening_is_a_ranking(tmp_path):
    ranking = frame.finish(make_screen(tmp_path / "all"))
    assert {key.label: key.value for key in ranking.page.keys} == {
        "Choices": "4", "Fork": "1", "Split": "1", "No bit differs": "1", "Must hold": "1 of 1",
    }  # fmt: skip
    rows = part(ranking, "Ranking", Table).rows
    assert rows[0][:4] == ("precision.state", 0, 303, 900) and rows[2][4] == "holds"
    assert ranking.verdict.tone == "info" and (ranking.folder / "figures/ranking.svg").exists()
    broken = make_screen(tmp_path / "no", {"ranking": [ranked("order@exact", must_hold=True, first_bit=3)]})
    found = frame.finish(broken, report=False)
    assert [one.code for one in found.verdict.findings] == ["MUST_HOLD_FORKED"]
    assert part(found, "Ranking", Table).bad == {0}
    calm = frame.finish(make_screen(tmp_path / "calm", {"ranking": [ranked("skin")]}), report=False)
    assert calm.verdict.tone == "good"


SCRIPT = """
<script>
const place = document.querySelector('[data-table="flips"]');
const type = (text) => {
  const search = place.querySelector("input");
  search.value = text;
  search.dispatchEvent(new Event("input"));
  return place.querySelector("output").textContent;
};
const seen = {all: type(""), entered: type("entered"), b: type("B"), pair: type("9-3"),
  differ: type("differ"),
  atom: type("atom 3"), steps: type("step:400..410"), width: document.documentElement.scrollWidth};
const result = document.createElement("pre");
result.id = "result";
result.textContent = JSON.stringify(seen);
document.body.append(result);
</script>
"""


@pytest.mark.skipif(BROWSER is None, reason="no browser installed")
def test_flips_can_be_searched(outcome, tmp_path):
    file = tmp_path / "report.html"
    page = (outcome.folder / "report.html").read_text(encoding="utf-8")
    file.write_text(page.replace("</body>", SCRIPT + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--window-size=390,800",
         f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    seen = json.loads(found[1])
    flips = RunFolder.open(outcome.folder).read("cross_flips", rows=5000)

    def rows(chosen):
        return f"{int(chosen.sum()):,} of 5,000 rows"

    assert seen["all"] == "5,000 of 5,000 rows"
    assert seen["entered"] == rows(flips["entered"]) and seen["b"] == rows(flips["run"] == "B")
    assert seen["differ"] == rows(flips["differs"])
    assert seen["pair"] == rows((flips["i"] == 3) & (flips["j"] == 9))
    assert seen["atom"] == rows((flips["i"] == 3) | (flips["j"] == 3))
    assert seen["steps"] == rows((flips["step"] >= 400) & (flips["step"] <= 410))
    assert seen["width"] <= 500 and STEPS > 410
