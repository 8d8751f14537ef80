"""A run folder is judged and shown: findings where they are planted, a page true to the folder."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from report.synthetic import TOML, make_run

import mdnum
from mdnum.errors import FolderError
from mdnum.report import analysis, drawing
from mdnum.rollout.summary import LineFit
from mdnum.store import RunFolder
from mdnum.store.files import write_text
from mdnum.verbs import frame
from mdnum.verbs.run import judge
from mdnum.verbs.run_page import TABLE_ROWS, TEXTS, RunView, page


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "good", steps=150, candidates=800)


@pytest.fixture(scope="module")
def good(folder):
    return RunView(folder, folder.summary)


@pytest.fixture(scope="module")
def html(folder):
    return report(folder)


def report(folder):
    return (frame.finish(folder).folder / "report.html").read_text(encoding="utf-8")


def changed(view, summary=None, **changes):
    """The view of a folder that says something else."""
    flips = changes.pop("flips", view.flips)
    made = replace(view, summary={**view.summary, **(summary or {})}, _tables={**view._tables, **changes})
    made.__dict__["flips"] = flips
    return made


def epochs(view, **changes):
    columns = {name: values.copy() for name, values in view.epochs.items()}
    for name, value in changes.items():
        columns[name][1] = value
    return columns


def series(view, row, **changes):
    columns = {name: values.copy() for name, values in view.series.items()}
    for name, value in changes.items():
        columns[name][row] = value
    return columns


def found(view):
    return {finding.code: finding for finding in judge(view).findings}


def test_a_good_run(good):
    verdict = judge(good)
    assert (verdict.tone, [each.code for each in verdict.findings]) == ("good", ["HARD_CUTOFF"])
    assert verdict.headline == TEXTS("notes") and len(verdict.evidence) == 4


def test_every_planted_defect_is_found(good):
    run = good
    table = {name: np.delete(values, 40) for name, values in good.folder.read("flips").items()}
    kicks = 1e4 * run.series["energy_jump"]
    kicked = {"energy_jump": kicks + run.series["energy_jump"]}
    kicked |= {name: run.series[name] + np.cumsum(kicks) for name in ("total", "conserved")}
    drifting = {"conserved": run.series["conserved"] + 5 * run.series["time"]}
    planted = {
        "RUN_FAILED": changed(good, {"status": "failed", "error": "a force is NaN"}),
        "NOT_FINISHED": changed(good, {"status": None}),
        "LOST_PAIRS": changed(
            good, epochs=epochs(good, lost_pairs=3, lost_pair_steps=11, first_lost_step=25)
        ),
        "DANGEROUS_BUILDS": changed(good, epochs=epochs(good, dangerous=True)),
        "EVENT_ALGEBRA": changed(good, series=series(good, 77, pairs=1)),
        "LEDGER_INCOMPLETE": changed(good, flips=analysis.scan(table, len(run.series["step"]))),
        "BUDGET_OPEN": changed(good, {"energy_budget_closes": False}),
        "TIE_AT_CUTOFF": changed(good, series=series(good, 0, min_margin=0.0)),
        "AMBIGUOUS_DECISIONS": changed(good, {"ambiguous": 2}),
        "DRIFT": changed(good, series={**run.series, **drifting}),
        "WANDER": changed(good, series={**run.series, **kicked}),
        "LISTS_DISAGREE": changed(good, {"count_mismatches": 2}),
        "ASE_DISAGREES": changed(good, {"ase": {"ok": False, "energy_rel": 1e-3, "force_max": 0.1}}),
        "ASE_NOT_COMPARED": changed(good, {"ase": None}),
        "FORCE_JUMP": changed(good, {"cutoff": {"kind": "shifted", "energy_jump": 0.0, "force_jump": 1e-4}}),
        "HARD_CUTOFF": good,
    }
    assert set(planted) | {"CHATTER", "sentences"} == set(TEXTS.entries)
    for code, view in planted.items():
        assert set(found(view)) == ({code} if code == "FORCE_JUMP" else {code, "HARD_CUTOFF"}), code
        assert page(view, judge(view)).sections, code


def test_lost_pairs_come_with_numbers_and_a_remedy(good):
    lost = epochs(good, lost_pairs=3, lost_pair_steps=1108, first_lost_step=25)
    view = changed(good, epochs=lost)
    view.__dict__["system"] = {**good.system, "neighbors": {"rebuild": {"check": False, "every": 20}}}
    verdict = judge(view)
    finding = verdict.findings[0]
    assert (verdict.tone, finding.code) == ("error", "LOST_PAIRS")
    assert finding.values == {"lost": 3, "pair_steps": 1108, "since": 25, "every": 20}
    assert "blindly every 20 steps" in finding.remedy and verdict.headline.startswith(
        "The neighbor list lost 3"
    )
    assert len(verdict.evidence) == 3


def test_what_follows_from_lost_pairs_does_not_hide_them(good):
    lost = epochs(good, lost_pairs=3, lost_pair_steps=9, first_lost_step=25)
    view = changed(good, {"energy_budget_closes": False}, epochs=lost, series=series(good, 77, pairs=1))
    verdict = judge(view)
    assert [each.code for each in verdict.findings[:3]] == ["LOST_PAIRS", "EVENT_ALGEBRA", "BUDGET_OPEN"]
    assert {each.remedy for each in verdict.findings[1:3]} == {TEXTS.entries["EVENT_ALGEBRA"]["remedy_lost"]}


def test_a_flip_dropped_by_the_recorder_is_noticed(tmp_path):
    folder = make_run(tmp_path / "run", steps=60, candidates=800, drop_flip=True)
    view = RunView(folder, folder.summary)
    errors = {code: each for code, each in found(view).items() if each.severity == "error"}
    assert "BUDGET_OPEN" in errors and set(errors) <= {"BUDGET_OPEN", "LEDGER_INCOMPLETE", "EVENT_ALGEBRA"}
    assert not analysis.algebra_holds(view.series)[30:].any()
    values = errors["BUDGET_OPEN"].values
    assert values["step"] == 30 and values["largest"] == pytest.approx(values["jump"], rel=0.01)


def test_chatter_is_a_matter_of_the_cutoff(good):
    flips = {name: values[:40] for name, values in good.folder.read("flips").items()}
    flips |= {"step": np.arange(1, 41), "i": np.full(40, 3), "j": np.full(40, 8)}
    flips |= {"entered": np.arange(40) % 2 == 0}
    columns = {name: values.copy() for name, values in good.series.items()}
    for name, inside in (("entered", flips["entered"]), ("left", ~flips["entered"])):
        columns[name] = np.bincount(flips["step"][inside], minlength=len(columns["step"]))
    columns["pairs"] = 100 + np.cumsum(columns["entered"] - columns["left"])
    view = changed(good, flips=analysis.scan(flips, len(columns["step"])), series=columns)
    hard = found(view)["CHATTER"]
    assert hard.severity == "warning" and (hard.values["pair"], hard.values["times"]) == ("3–8", 40)
    smooth = changed(view, {"cutoff": {"kind": "quintic", "energy_jump": 0.0, "force_jump": 0.0}})
    assert {code: each.severity for code, each in found(smooth).items()} == {"CHATTER": "info"}


def test_findings_are_stored_and_decided_again(tmp_path):
    folder = make_run(tmp_path / "run", steps=60, candidates=200, summary={"ase": {"ok": False}})
    first = frame.finish(folder, report=False)
    assert [each.code for each in first.verdict.findings] == ["ASE_DISAGREES", "HARD_CUTOFF"]
    stored = json.loads((folder.path / "summary.json").read_text())
    assert stored["verdict"] == first.verdict.text and not (folder.path / "report.html").exists()
    other = {"code": "FINDERS_DISAGREE", "severity": "warning", "title": "finders disagree", "text": "x"}
    folder.write_summary({**stored, "ase": {"ok": True}, "findings": [*stored["findings"], other]})
    second = frame.finish(folder, report=False)
    assert [each.code for each in second.verdict.findings] == ["FINDERS_DISAGREE", "HARD_CUTOFF"]
    assert second.verdict.headline.endswith("Look first: finders disagree.")


def test_a_killed_run_is_judged_up_to_its_checkpoint(tmp_path):
    folder = make_run(tmp_path / "run", steps=60, candidates=200, finish=False)
    outcome = frame.finish(folder)
    assert outcome.verdict.headline == TEXTS("partial")
    assert outcome.verdict.findings[0].values["steps"] == 30
    assert RunFolder.open(folder.path).resume() == {"step": 30}


def test_a_folder_without_a_step_is_an_error(tmp_path):
    folder = RunFolder.create(tmp_path / "run")
    write_text(folder.path / "system.toml", 'units = "lj"')
    with pytest.raises(FolderError, match="holds no step of a run"):
        frame.finish(folder)


# -- the page ----------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """Refuses a document whose elements do not close."""

    VOID = frozenset({"meta", "input", "br", "link", "img"})

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.ids, self.linked, self.labels = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href"):
                self.linked.append(value)
            if tag == "svg" and name == "aria-label":
                self.labels.append(value)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_one_whole_file_that_loads_nothing(html, folder):
    tags = Tags()
    tags.feed(html)
    assert tags.open == [] and len(tags.ids) == len(set(tags.ids))
    assert "@import" not in html and not re.search(r"url\((?!#)", html)
    assert not {"link", "img", "iframe"} & set(tags.seen)
    inside = {link[1:] for link in tags.linked if link.startswith("#")}
    assert inside and inside <= set(tags.ids)
    outside = [link for link in tags.linked if not link.startswith("#")]
    assert "flips.parquet" in outside and all((folder.path / link).exists() for link in outside)
    # what a figure shows, in numbers, for who cannot see it
    assert len(tags.labels) == tags.seen.count("svg") == 5
    assert all(re.search(r"\d", label) for label in tags.labels)
    assert len(html) < 3_000_000 and html == report(folder)


def test_the_page_states_what_the_folder_holds(html, folder, good):
    for text in (TEXTS("notes"), "HARD_CUTOFF", "Liquid argon (Rahman 1964)", "9f1c52d0a7b3e4c8"):
        assert text in html
    rows = json.loads(re.search(r'id="flips-rows">(.*?)</script>', html, re.DOTALL)[1])
    flips = folder.read("flips")
    assert len(rows) == min(TABLE_ROWS, good.flips.total)
    shown = {(step, i, j) for step, i, j, *_ in rows}
    nearest = np.argsort(np.abs(flips["margin"]) / flips["bound"])[:TABLE_ROWS]
    assert shown == {(int(flips["step"][row]), int(flips["i"][row]), int(flips["j"][row])) for row in nearest}
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)


def test_figures_are_files_of_their_own(folder, html):
    names = sorted(path.name for path in (folder.path / "figures").iterdir())
    assert names == ["energy.svg", "flips.svg", "lists.svg", "margins.svg", "residence.svg"]
    for name in names:
        text = (folder.path / "figures" / name).read_text(encoding="utf-8")
        ElementTree.fromstring(text)
        assert set(re.findall(r"var\(--(\w+)\)", text)) <= set(drawing.LIGHT) == set(drawing.DARK)
        # a color that no theme knows would vanish on one of the two backgrounds
        assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= {*drawing.LIGHT.values(), *drawing.DARK.values()}


def test_text_from_a_file_is_no_markup(tmp_path):
    toml = TOML.replace("Liquid argon", "<script>alert(1)</script> </pre>")
    html = report(make_run(tmp_path / "run", steps=20, candidates=50, toml=toml))
    assert "<script>alert" not in html and "&lt;script&gt;alert(1)" in html


def test_bad_numbers_do_not_break_the_page(tmp_path):
    folder = make_run(tmp_path / "run", steps=30, candidates=100, summary={"status": "failed"})
    columns = folder.read("series")
    for name in ("potential", "total", "conserved", "temperature", "pressure"):
        columns[name] = columns[name].copy()
        columns[name][-1] = np.nan
    broken = RunFolder.create(tmp_path / "broken")
    write_text(broken.path / "system.toml", folder.system_toml)
    broken.append("series", columns)
    broken.append("flips", folder.read("flips"))
    broken.finalize()
    broken.write_summary({**folder.summary, "energy_drift": None, "energy_budget_residual": None})
    outcome = frame.finish(broken)
    assert outcome.verdict.findings[0].values["step"] == 30


def test_runs_in_which_nothing_happens_have_pages(tmp_path, good):
    """No flip; atoms at rest; no skin; steps of no length."""
    assert report(make_run(tmp_path / "still", steps=5, candidates=0, summary={"ase": None, "cutoff": None}))
    run = good
    names = ("energy_jump", "temperature", "entered", "left")
    still = {name: np.zeros_like(run.series[name]) for name in names}
    still |= {name: np.full_like(run.series[name], run.series[name][0]) for name in ("conserved", "pairs")}
    none = analysis.scan({name: values[:0] for name, values in good.folder.read("flips").items()}, 151)
    bare = {**run.epochs, "skin_consumed": np.full(len(run.epochs["epoch"]), np.inf)}
    short = {**run.series, "time": run.series["time"] * 1e-300}
    for changes in ({"series": {**run.series, **still}, "flips": none}, {"epochs": bare}, {"series": short}):
        view = changed(good, {"energy_drift_without_jumps": None}, **changes)
        assert page(view, judge(view)).sections


@pytest.mark.parametrize("step", [1e-300, 1e-160, 0.0, 1e160])
def test_a_time_that_has_no_slope(step):
    line = LineFit()
    line.add(step * np.arange(5), np.arange(5.0))
    assert line.slope is None


@pytest.mark.slow
def test_energy_is_set_beside_that_of_float64(tmp_path):
    smooth = {"cutoff.kind": "quintic"}
    whole, floats = (
        mdnum.run("argon/crystal-108", out=tmp_path / state, steps=60, check=state == "lattice", report=False,
                  overrides={**smooth, "precision.state": state})
        for state in ("lattice", "float64")
    )  # fmt: skip
    told = whole.summary["lattice"]
    assert told["energy_steps"] == 60
    for key, run in (("energy_std", whole), ("energy_std_float64", floats)):
        energy = np.asarray(RunFolder.open(run.folder).read("series")["total"])
        assert len(energy) == 61
        # the starts differ by the changed edges of the box
        assert told[key] == pytest.approx(np.std(energy) / 108, rel=1e-4)
