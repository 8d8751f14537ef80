"""The page of a ball's run: whole, self-contained, and true to the folder."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from report.synthetic import make_run
from report.synthetic_ball import made, make_ball, variant
from report.test_browser import BROWSER
from report.test_html import Tags

from mdnum import report, store
from mdnum.report.ball import figures, html
from mdnum.report.ball.run import load

FORK = {"seed": 3, "fork": 30, "channel": "contact", "ball": 2, "margin": 1e-17, "margin_there": -2e-17}
EXACT = {
    "model": "ExactImpact", "balls": 3, "height_error": 2e-14, "height_error_largest": 3e-14,
    "first_contact_time": 0.2855, "first_contact_step": 29, "rest_time": 4.06,
    "gradient": {"y0": 0.75}, "gradient_error": {"unrolled": {"y0": 0.0}},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_ball(
        tmp_path_factory.mktemp("runs") / "run",
        summary={
            "exact": EXACT,
            "variants": [variant("float32", **FORK, separation_end=0.1), variant("same")],
            "gradient": [
                made("unrolled", "Through the iterations that ran.", {"k": -2.5e-5, "y0": 0.75}),
                made("implicit", "Of the fixed point.", {"k": 0.0, "y0": 0.75}, {"k": False}),
                {
                    "method": "smoothed",
                    "says": "needs a penalty",
                    "value": None,
                    "gradient": {},
                    "refused": True,
                },
            ],
        },
    )
    report.write(folder.path)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    return (folder.path / "report.html").read_text(encoding="utf-8")


def embedded(page, name):
    return json.loads(re.search(rf'id="{name}-rows">(.*?)</script>', page, re.DOTALL)[1])


def test_one_whole_file_that_loads_nothing(page, folder):
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and tags.sources == []
    assert len(tags.ids) == len(set(tags.ids))
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used and used <= set(tags.ids)
    names = sorted(path.stem for path in (folder.path / "figures").iterdir())
    assert names == ["gradient", "heights", "iterations", "margins", "nearest", "stops"]
    assert tags.seen.count("svg") == 2 * len(names)
    assert len(page) < 2_000_000


def test_the_page_states_what_the_folder_holds(page, folder):
    run = load(folder)
    text = re.sub(r"<[^>]+>", "", page)
    for words in (
        "Three balls on a floor", "3 balls, 150 steps, 1.5 s", "projection, k 0.5, alpha 0.5",
        "sum, tol 10⁻⁶ m, max iter 40", "control none", "of k, y0, methods unrolled, implicit",
        "the loss does not depend on k", "does not depend", "exactly the closed form’s", "does not apply",
        "parabolas and impacts with restitution", "0.285500 s", "step 29, 0.290000 s", "bits from 3",
        "precision.state = float32", "contact, ball 2", "0123456789abcdef",
        f"All {run.rows['contacts']} contact flips, as in contacts.parquet",
    ):  # fmt: skip
        assert words in text, words


def test_tables_carry_all_rows_where_they_fit(page, folder):
    run = load(folder)
    rows = embedded(page, "contact")
    assert len(rows) == run.rows["contacts"]
    assert [row[:3] for row in rows] == np.stack(
        [run.contacts[name].astype(int) for name in ("step", "ball", "entered")], axis=1
    ).tolist()
    stops = embedded(page, "stop")
    assert len(stops) == run.rows["solver"] < html.TABLE_ROWS
    ended = [row for row in stops if row[6] == 2]
    assert len(ended) == run.summary["ended"]["tolerance"] and all(row[5] == 1 for row in ended)


def test_only_the_nearest_rows_of_long_tables(page, folder, monkeypatch):
    monkeypatch.setattr(html, "TABLE_ROWS", 10)
    short = report.write(folder).read_text(encoding="utf-8")
    run = load(folder)
    assert f"The 10 contact flips nearest to the floor, of {run.rows['contacts']}" in short
    near = np.sort(np.abs(run.solver["margin"]))[:10]
    assert sorted(abs(row[4]) for row in embedded(short, "stop")) == pytest.approx(near, rel=1e-4)
    monkeypatch.undo()
    assert report.write(folder).read_text(encoding="utf-8") == page


def test_figures_show_the_rows_of_the_tables(folder):
    run = load(folder)
    shown = figures.heights(run)
    assert shown is not None
    marks = shown.series[-1]
    assert marks.label == "a contact begins"
    assert marks.x.tolist() == pytest.approx(0.01 * run.contacts["step"][run.contacts["entered"]])
    solver = figures.stops(run)
    assert solver is not None and solver.y_scale == "symlog"
    stopped, went_on = solver.series
    assert np.all(stopped.y > 0) and np.all(went_on.y <= 0)
    assert len(stopped.y) + len(went_on.y) == run.rows["solver"]
    counts = figures.iterations(run)
    assert counts is not None and [series.label for series in counts.series] == ["ended by tolerance"]


def test_iterations_are_told_apart_by_what_ended_them(tmp_path):
    run = load(make_ball(tmp_path / "run", max_iter=20))
    counts = figures.iterations(run)
    assert counts is not None
    by_label = {series.label: series for series in counts.series}
    assert by_label["gave up at the cap"].role == "bad"
    assert set(by_label["gave up at the cap"].y) == {20}


def test_a_method_that_does_not_depend_is_an_open_circle_at_zero(folder):
    run = load(folder)
    first = figures.gradient(run).axes[0]
    dots = [line for line in first.lines if line.get_marker() == "o"]
    assert [dot.get_xdata().tolist() for dot in dots] == [[-2.5e-5], [0.0]]
    assert [dot.get_markerfacecolor() == "none" for dot in dots] == [False, True]
    assert "0: does not depend" in [text.get_text() for text in first.texts]


def test_separations_are_drawn_with_their_forks(folder):
    run = load(folder)
    assert figures.separation(run) is None
    rows = {"variant": np.array(["float32"] * 3), "step": np.arange(3), "separation": np.array([0, 1e-9, 1])}
    object.__setattr__(run, "separations", rows)
    plot = figures.separation(run)
    assert plot is not None
    assert plot.verticals == ((pytest.approx(0.3), "float32 forks"),)
    assert plot.series[0].x.tolist() == [0, 0.01, 0.02]


def test_sparse_and_broken_folders_have_pages(tmp_path):
    bare = make_ball(
        tmp_path / "bare", tables=False, steps=3,
        summary={"gradient": [], "variants": [], "exact": None, "status": None, "steps_per_second": 1e5},
    )  # fmt: skip
    text = report.write(bare).read_text(encoding="utf-8")
    assert "No contact began or ended" in text and "No derivative was asked for" in text
    assert "The run ended early, after 3 steps" in text and "Stop decisions</h2>" not in text
    broken = make_ball(
        tmp_path / "broken",
        summary={
            "status": "failed", "not_finite": 12, "loss": None, "ended": {"not finite": 3},
            "gradient": [made("unrolled", "x", {"k": None})],
            "variants": [variant("low", loss=None, gradient={"k": None}, separation_end=None)],
        },
    )  # fmt: skip
    text = report.write(broken).read_text(encoding="utf-8")
    assert "Do not rely on this run: the state stops being finite at step 12" in text


def test_text_from_a_file_is_no_markup(tmp_path):
    folder = make_ball(
        tmp_path / "run",
        toml='about = "<script>alert(1)</script>"\n',
        summary={"variants": [variant("<b>low</b>", **FORK)]},
    )
    text = report.write(folder).read_text(encoding="utf-8")
    assert "<script>alert" not in text and "<b>low" not in text


def test_write_takes_the_page_of_the_world(tmp_path):
    assert "Flips per step" in report.write(make_run(tmp_path / "md", steps=20, candidates=50)).read_text()
    assert "Heights and contacts" in report.write(str(make_ball(tmp_path / "ball").path)).read_text()
    report.judge(store.RunFolder.open(tmp_path / "md"))


def test_importing_the_report_imports_neither_jax_nor_matplotlib():
    code = "import sys, mdnum.report; print([m for m in ('jax', 'matplotlib', 'jinja2') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


SCRIPT = """
<script>
const seen = {};
for (const name of ["contacts", "stops"]) {
  const place = document.querySelector(`[data-table="${name}"]`);
  const lines = () => [...place.querySelectorAll("tbody tr")];
  const cells = (column) => lines().map((row) => row.cells[column].textContent);
  const type = (text) => {
    const search = place.querySelector("input");
    search.value = text;
    search.dispatchEvent(new Event("input"));
    return place.querySelector("output").textContent;
  };
  const last = place.querySelectorAll("thead th").length - 1;
  seen[name] = {all: type(""), entered: type("entered"), ball: type("ball:2"), number: type("ball 2"),
    stopped: type("stopped"), steps: type("step:30..60"), first: type("iteration:0"), words: cells(last)};
}
seen.width = document.documentElement.scrollWidth;
const result = document.createElement("pre");
result.id = "result";
result.textContent = JSON.stringify(seen);
document.body.append(result);
</script>
"""


@pytest.mark.skipif(BROWSER is None, reason="no browser installed")
def test_both_tables_can_be_searched(folder, page, tmp_path):
    run = load(folder)
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
    seen = json.loads(found[1].replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&"))

    def rows(table, chosen):
        return f"{int(chosen.sum())} of {run.rows[table]} rows"

    contacts, solver = run.contacts, run.solver
    assert seen["contacts"]["entered"] == rows("contacts", contacts["entered"])
    assert seen["contacts"]["ball"] == seen["contacts"]["number"] == rows("contacts", contacts["ball"] == 2)
    within = (contacts["step"] >= 30) & (contacts["step"] <= 60)
    assert seen["contacts"]["steps"] == rows("contacts", within)
    assert seen["contacts"]["stopped"] == "“stopped” is not understood"
    assert seen["stops"]["stopped"] == rows("solver", solver["stopped"])
    assert seen["stops"]["first"] == rows("solver", solver["iteration"] == 0)
    assert seen["stops"]["entered"] == "“entered” is not understood"
    assert seen["width"] <= 500
    assert set(seen["stops"]["words"]) <= {"", "tolerance"}
