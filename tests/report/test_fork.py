"""The page of a comparison: whole, self-contained, and true to the folder."""

from __future__ import annotations

import json
import re
import subprocess

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
from report.test_html import Tags

from mdnum import report
from mdnum.errors import FolderError
from mdnum.report.fork import atoms, figures, findings, sections
from mdnum.report.fork.run import load
from mdnum.store import RunFolder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_fork(tmp_path_factory.mktemp("forks") / "run")
    report.write(folder.path)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    return (folder.path / "report.html").read_text(encoding="utf-8")


def judged(tmp_path, **summary):
    """The verdict on a folder with these entries."""
    return findings.judge(load(make_fork(tmp_path / "one", summary=summary)))


def test_one_whole_file_that_loads_nothing(page, folder):
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and tags.sources == []
    assert len(tags.ids) == len(set(tags.ids))
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used and used <= set(tags.ids)
    names = sorted(path.stem for path in (folder.path / "figures").iterdir())
    assert names == ["atoms", "cross", "energy", "furthest", "overridden", "protection", "separation"]
    assert tags.seen.count("svg") == 2 * len(names)
    assert len(page) < 2_000_000


def test_the_page_states_what_the_folder_holds(page, folder):
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    split = folder.summary["split"]
    for words in (
        "argon/synthetic: reduction=exact", "The flip at step 400 is the cause", f"split at step {split:,}",
        "under A’s decisions not, and so on.", "The flips were worth &gt; 3.58 e-foldings: growth rate",
        "Nothing but exponentials.",
        "108 atoms, 1,500 steps of 0.01 τ",
        "Pair 3–4 enters its cutoff in run B alone at step 400, 1.0 × 10⁻¹⁰ σ from it",
        "in neither run could rounding alone have decided otherwise", "the margin no longer protected it",
        "precision.reduction", "sequential in A, exact in B", "0123456789abcdef",
        "The first 5,000 of 7,000 flips", "all of them are in cross_flips.parquet",
        "doubles in 34.7 steps",
        f"arithmetic decisions from A from B A its own is A {split:,} B its own {split:,} is B",
        f"B A’s &gt; 1,500 {split - 1:,}",
        "decisions &gt; 179 steps &gt; 3.58 e-foldings –", "arithmetic – −1 step −0.0200 e-foldings",
        "up to step 1,500: no decision is ambiguous",
        "up to step 70; after it 2,860 ambiguous decisions at 1,430 steps, first pair 5–8: "
        "margin +1.5 × 10⁻⁷, bound 6.0 × 10⁻⁶", "all of them are in ambiguous_pairs.parquet",
        "up to step 389; then a pair",
        "step 399: up to there B decides as A", "0.0190 ± 4 × 10⁻⁴ a step, 1.90 per τ",
        "the runs part 1.05 times as fast", "8.9 × 10⁻¹⁶ σ reaches the split tolerance about step 1,702",
        "2 pairs are enough, and none of them can be left out. 23 runs of B told, 77 pairs that differ",
        "3–4 400 to 406, 420, 430 to 459, and 1 time more", "3–9 from 410 on",
        "Told what A decided about 3–4 at steps 400 to 406 and nothing else, B does not split from A by step "
        "1,500: they are 2.0 × 10⁻⁹ σ apart at most; without, at 1,321.",
        f"split {split:,}", "fork 400", "seed 5", "split: beyond 0.100 σ", "A and B under A’s decisions",
    ):  # fmt: skip
        assert words in text, words


def test_the_figure_shows_both_separations_and_the_dates(folder):
    run = load(folder)
    plot = figures.separation(run)
    by_label = {series.label: series for series in plot.series}
    free, handed = by_label["A and B, free"], by_label["A and B under A’s decisions"]
    assert np.nanmax(free.y) == 0.5 and np.nanmax(handed.y) == SIZE
    assert np.isnan(free.y[:5]).all(), "zeros before the seed have no logarithm"
    assert [round(at) for at, _ in plot.verticals] == [5, FORK, run.summary["split"]]
    assert plot.horizontals[0][0] == TOLERANCE and plot.y_scale == "log"
    fit = by_label["growth, fitted"]
    assert np.diff(np.log(fit.y)).sum() / (fit.x[-1] - fit.x[0]) == pytest.approx(RATE)
    assert fit.y[0] == pytest.approx(SIZE)
    assert "B and A under B’s decisions" not in by_label


def test_a_point_below_the_line_is_where_protection_ends(folder):
    plot = figures.protection(load(folder))
    near, moved = plot.series
    below = near.y < np.nan_to_num(moved.y)
    assert below.argmax() == NEAR and moved.y[FORK - 1] == 2 * SIZE
    assert plot.verticals[0] == (NEAR - 1.0, "protected") and plot.y_scale == "log"


def test_without_an_exponent_or_a_minimal_cause_the_page_says_why(tmp_path):
    entries = {
        "lyapunov": None, "lyapunov_reason": "a many-body potential",
        "minimal": {"pairs": None, "tests": 0, "reason": "the runs did not split"},
    }  # fmt: skip
    run = load(make_fork(tmp_path / "run", summary=entries))
    assert dict(sections.growth(run))["Lyapunov exponent"] == "none: a many-body potential"
    assert sections.minimal(run) == {"none": True, "text": "The runs did not split.", "rows": []}


def test_a_decision_that_was_taken_back_is_told(tmp_path):
    def told(name, **entries):
        return str(sections.pinned(load(make_fork(tmp_path / name, summary={"pinned": PINNED | entries}))))

    assert "at step 400 and nothing else, B splits from A at step 1,333" in told("one", last=400, split=1333)
    assert "at steps 400 to 406" in told("free", free=None)
    assert told("free-too", free=None).endswith("; without, they do not split.")
    assert told("none", pairs=None, reason="the runs do not fork") == (
        "No decision could be taken back: the runs do not fork."
    )


def test_a_poor_fit_is_not_drawn_and_a_predicted_split_is(tmp_path):
    poor = make_fork(tmp_path / "poor", summary={"growth": {"B": {"rate": 0.01, "r_squared": 0.3}}})
    assert "growth, fitted" not in [series.label for series in figures.separation(load(poor)).series]
    open_ended = make_fork(tmp_path / "open", summary={"split": None, "predicted_split": 2000})
    plot = figures.separation(load(open_ended))
    assert (2000.0, "split expected 2,000") in plot.verticals
    assert max(series.x.max() for series in plot.series) == 2000


def test_ticks_stand_where_only_one_run_flips(folder):
    run = load(folder)
    *_, draw, _ = next(figures.figures(run))
    lines = draw(7.6).axes[0].collections[-1].get_segments()
    at = sorted({segment[0][0] for segment in lines})
    assert at[0] == FORK and set(at) <= set(run.flips["step"].tolist())
    assert len(at) == len(np.unique(run.flips["step"]))


@pytest.mark.parametrize(
    ("entries", "tone", "words"),
    [
        ({}, "info", "The flip at step 400 is the cause"),
        (
            {"verdict": "accelerated", "splits": {"B": 1300, "B|A": 1400}, "split": 1300},
            "info",
            "100 steps later",
        ),
        # as an older version wrote it
        (
            {"verdict": "hurried", "splits": {"B": 1300, "B|A": None}},
            "info",
            "The flips accelerated the split",
        ),
        ({"verdict": "bystander"}, "info", "The flip at step 400 is a bystander"),
        ({"verdict": "undecided"}, "info", "What the flips did to the split is undecided"),
        ({"verdict": "open", "split": None, "predicted_split": 9000}, "info", "at about step 9,000"),
        ({"verdict": "open"}, "info", "what the flips did to it is open"),
        (
            {"verdict": "no fork", "fork": None, "split": None, "decision": None},
            "good",
            "No fork: bits differ",
        ),
        ({"verdict": "no fork", "fork": None, "decision": None}, "good", "without a single decision"),
        (
            {"verdict": "same", "seed": None, "fork": None, "split": None, "decision": None},
            "good",
            "The same trajectory: no bit differs in 1,500 steps.",
        ),
        (
            {"failed": {"B": "blow-up"}, "status": "failed"},
            "warning",
            "Run B ended in a blow-up at step 1,500 and run A did not; they fork at step 400.",
        ),
        ({"failed": {"A": "runaway"}, "decision": None}, "warning", "run B did not: that is the fork."),
        (
            {"failed": {"A": "runaway", "B": "blow-up"}},
            "warning",
            "Both runs ended at step 1,500, A in a runaway and B in a blow-up.",
        ),
        ({"must_hold": True}, "error", "The flip at step 400"),
    ],
)
def test_every_verdict_has_its_words(tmp_path, entries, tone, words):
    verdict = judged(tmp_path, **entries)
    assert words in verdict.headline and verdict.tone == tone
    assert not verdict.headline.endswith("..")


COUNT = {"pairs": 16, "later": 9, "not_later": 7, "most": 16, "threshold": 43.2, "needed": [16, 12]}


@pytest.mark.parametrize(
    ("handed", "words"),
    [
        (1290, "under A’s decisions 31 steps earlier; 9 of 16 such pairs split more than one e-folding"),
        (1321, "under A’s decisions at the same step; 9 of 16"),
        (1350, "29 steps later; 9 of 16 such pairs split more than one e-folding (43 steps) later"),
        (None, "the runs had split at step 300, before any decision differed."),
    ],
)
def test_a_bystander_is_told_by_its_criterion(tmp_path, handed, words):
    split = 1321 if handed is not None else 300
    splits = {"B": split, "B|A": handed}
    found = judged(tmp_path, verdict="bystander", split=split, splits=splits, count=COUNT)
    assert words in found.headline


def test_repeats_are_in_the_page_as_ranges(tmp_path):
    repeated = [{"free": 1300, "handed": 1410}, {"free": 1280, "handed": None}]
    run = load(make_fork(tmp_path / "one", summary={"repeated": repeated, "count": COUNT}))
    assert [row["A"] for row in sections.runs(run)][-2:] == [
        "1,280 to 1,300",
        "1,410 to 1,410; 1 of 2 not seen to",
    ]
    assert "15 repeats" in str(findings.chance(run))
    assert findings.chance(load(make_fork(tmp_path / "none"))) is None


def test_what_repeats_leave_open_is_said_with_what_would_do(tmp_path):
    def told(name, **count):
        entries = {"splits": {"B": 1321, "B|A": 1700}, "verdict": "undecided", "count": COUNT | count}
        ((finding),) = findings.judge(load(make_fork(tmp_path / name, summary=entries))).findings
        return finding

    assert told("all").code == "UNDECIDED" and "--repeats 30" in told("again").remedy
    none = told("none", pairs=1, later=1, not_later=0, most=1, needed=None)
    assert none.title == "no repeats were run" and "--repeats 15" in none.remedy


def test_findings_are_those_that_apply(tmp_path):
    def codes(name, **entries):
        verdict = findings.judge(load(make_fork(tmp_path / name, summary=entries)))
        return {finding.code: finding.severity for finding in verdict.findings}

    assert codes("plain") == {}
    doubtful = DECISION | {"ambiguous_in": ["B"], "margins": {"B": 1e-16}, "bounds": {"B": 2e-15}}
    assert codes("doubt", decision=doubtful) == {"AMBIGUOUS_FORK": "info"}
    assert codes("short", split=None, verdict="open") == {"HORIZON_SHORT": "info"}
    assert codes("guard", handed_until=900) == {"GUARD": "info"}
    assert codes("told", handed_until=900, failed_told={"B|A": "runaway"}) == {"GUARD": "info"}
    assert codes("alone", verdict="undecided", count=COUNT) == {"UNDECIDED": "info"}
    assert codes("held", must_hold=True) == {"MUST_HOLD_FORKED": "error"}
    kept = {"code": "OF_OTHERS", "severity": "warning", "title": "look", "text": "there"}
    stale = {"code": "GUARD", "severity": "info", "title": "no longer", "text": "so"}
    assert codes("kept", findings=[kept, stale]) == {"OF_OTHERS": "warning"}


def test_headline_and_findings_go_into_the_summary(tmp_path):
    folder = make_fork(tmp_path / "run", summary={"must_hold": True})
    report.judge(folder.path)
    assert folder.summary["headline"].startswith("The flip at step 400")
    assert [finding["code"] for finding in folder.summary["findings"]] == ["MUST_HOLD_FORKED"]
    assert folder.summary["verdict"] == "cause" and not (folder.path / "report.html").exists()


def test_bare_folders_have_pages(tmp_path):
    bare = make_fork(tmp_path / "bare", forks=False, handed=False)
    text = report.write(bare).read_text(encoding="utf-8")
    assert "both runs decided alike at every step" in text and "none was run: nothing is said" in text
    assert "The decision at the fork" not in text
    names = sorted(path.stem for path in (bare.path / "figures").iterdir())
    assert names == ["energy", "protection", "separation"]
    assert "Whose decisions, whose arithmetic" not in text and "Minimal cause" not in text
    same = make_fork(tmp_path / "same", summary={"about": "<script>alert(1)</script>", "choice": "<b>x"})
    text = report.write(same).read_text(encoding="utf-8")
    assert "<script>alert" not in text and "<b>x" not in text
    with pytest.raises(FolderError, match="no finished comparison"):
        unfinished = RunFolder.create(tmp_path / "unfinished", world="fork")
        unfinished.finalize()
        load(unfinished)


def test_the_projection_keeps_lengths_and_puts_the_pair_level():
    rng = np.random.default_rng(1)
    positions = rng.standard_normal((20, 3))
    basis = atoms.projection(positions)
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    across = (positions[1] - positions[0]) @ basis.T
    np.testing.assert_allclose(across, [np.linalg.norm(positions[1] - positions[0]), 0, 0], atol=1e-12)
    # a pair alone, and atoms on one line, have no plane of their own
    for flat in (np.array([[0.0, 0, 0], [0, 0, 2]]), np.outer([0.0, 1, 5], [1, 1, 0])):
        np.testing.assert_allclose(atoms.projection(flat) @ atoms.projection(flat).T, np.eye(3), atol=1e-12)


def test_arrows_are_magnified_by_a_round_number():
    assert atoms.magnification(np.array([[1e-9, 0.0], [0, 3e-9]]), 1.5) == pytest.approx(1e8)
    assert atoms.magnification(np.array([[0.0, 0.06]]), 1.5) == 5.0
    assert atoms.magnification(np.array([[5.0, 0.0]]), 1.5) == 1.0
    assert atoms.magnification(np.zeros((3, 2)), 1.5) == 0.0


@pytest.mark.parametrize(
    ("entries", "inside"),
    [
        ({"run": "A", "entered": True}, {"A": True, "B": False}),
        ({"run": "A", "entered": False}, {"A": False, "B": True}),
        ({"run": "B", "entered": True}, {"A": False, "B": True}),
        ({"run": "start", "entered": False, "margin": 1e-9}, {"A": True, "B": False}),
    ],
)
def test_who_had_the_pair_inside(tmp_path, entries, inside):
    run = load(make_fork(tmp_path / "run", summary={"decision": DECISION | entries}))
    assert atoms.decided_inside(run) == inside


def test_a_screening_is_a_ranking(tmp_path):
    folder = make_screen(tmp_path / "all")
    tags = Tags()
    page = report.write(folder).read_text(encoding="utf-8")
    tags.feed(page)
    assert tags.open == [] and len(tags.ids) == len(set(tags.ids))
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    for words in ("1 of 4 choices fork in 1,000 steps; precision.state first, at step 303.",
                  "constant energy", "holds", "1 of 1", "no bit differs"):  # fmt: skip
        assert words in text, words
    broken = make_screen(tmp_path / "broken", {"ranking": [ranked("order@exact", must_hold=True, seed=3)]})
    text = report.write(broken).read_text(encoding="utf-8")
    assert "order@exact must not change a bit, and does." in text and "first bit that must not differ" in text
    assert broken.summary["findings"][0]["severity"] == "error"
    calm = make_screen(tmp_path / "calm", {"ranking": [ranked("skin")]})
    assert findings.judge(load(calm)).headline == "None of 1 choice forks in 1,000 steps."


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
def test_flips_can_be_searched(folder, page, tmp_path):
    file = tmp_path / "report.html"
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
    flips = {name: values[:5000] for name, values in load(folder).flips.items()}

    def rows(chosen):
        return f"{int(chosen.sum()):,} of 5,000 rows"

    assert seen["all"] == "5,000 of 5,000 rows"
    assert seen["entered"] == rows(flips["entered"])
    assert seen["b"] == rows(flips["run"] == "B")
    assert seen["differ"] == rows(flips["differs"])
    assert seen["pair"] == rows((flips["i"] == 3) & (flips["j"] == 9))
    assert seen["atom"] == rows((flips["i"] == 3) | (flips["j"] == 3))
    assert seen["steps"] == rows((flips["step"] >= 400) & (flips["step"] <= 410))
    assert seen["width"] <= 500
    assert STEPS > 410
