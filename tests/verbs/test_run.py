"""A run folder is judged and shown: findings where they are planted, a page true to the folder.

The folders are made without a rollout: pairs oscillate about the cutoff, and an energy pays for each flip.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import mdnum
from mdnum.errors import FolderError
from mdnum.report import analysis, drawing
from mdnum.rollout.summary import LineFit
from mdnum.safe_path import environment, python
from mdnum.store import RunFolder
from mdnum.store.files import write_text
from mdnum.verbs import frame
from mdnum.verbs.run import COMPILE, judge
from mdnum.verbs.run_page import TABLE_ROWS, TEXTS, RunView, page

TOML = """about = "Liquid argon (Rahman 1964), 864 atoms at 94.4 K, hard cutoff."
units = "metal"
potential = {kind = "lennard-jones", sigma = 3.405, epsilon = 0.0103235}
cutoff = {kind = "hard", radius = 8.5125, compare = "r2 <"}
neighbors = {skin = 1.0, builder = "auto", rebuild = {every = 1, delay = 0, check = true}}
dynamics = {kind = "nve", timestep = 0.002, temperature = 94.4, steps = 2000, seed = 7}
precision = {state = "float64", force = "float64", decision = "float64", accumulate = "float64"}
"""

#: Atoms, cutoff, time step, steps of a list, and the energy of a pair at the cutoff.
ATOMS, RADIUS, DT, LIST, JUMP = 864, 8.5125, 0.002, 15, -1.681e-4


def make_run(
    path: Path,
    *,
    steps: int = 150,
    candidates: int = 800,
    finish: bool = True,
    summary: dict[str, Any] | None = None,
    toml: str = TOML,
) -> RunFolder:
    """Writes a folder as a rollout would.

    Args:
        steps, candidates: steps of the run, pairs that oscillate (some 0.045 flips each and step).
        finish: end as a complete run; else leave it as one that was killed halfway.
        summary: entries that replace the honest ones.
    """
    rng, step, number = np.random.default_rng(1), np.arange(steps + 1), np.arange(candidates)
    pair = np.stack([number % 400, 400 + 401 * number % 464], axis=1)
    frequency, amplitude = rng.gamma(3.0, 0.018, candidates), rng.gamma(2.0, 0.35, candidates) + 0.02
    angle = np.outer(step, frequency) + rng.uniform(0, 2 * np.pi, candidates)
    distance = RADIUS + rng.normal(0, 0.45, candidates) + amplitude * np.sin(angle)
    margin, bound = RADIUS**2 - distance**2, 4.5 * np.finfo(float).eps * distance**2
    inside = margin > 0
    flipped = np.zeros_like(inside)
    flipped[1:] = inside[1:] != inside[:-1]
    at, which = np.nonzero(flipped)
    entered = inside[flipped]
    flips = {
        "step": at, "i": pair[which, 0], "j": pair[which, 1], "entered": entered,
        "distance": distance[flipped], "margin": margin[flipped], "bound": bound[flipped],
        "radial_speed": (amplitude * frequency * np.cos(angle))[flipped] / DT,
        "energy_jump": np.where(entered, JUMP, -JUMP), "force_jump": np.where(entered, 1.18e-4, -1.18e-4),
        "ambiguous": np.zeros(len(at), bool),
    }  # fmt: skip
    came, went = (flipped & inside).sum(axis=1), (flipped & ~inside).sum(axis=1)
    jump = JUMP * (came - went)
    potential = -62.1 + np.cumsum(jump) + 0.9 * np.sin(step * 0.031) + 0.4 * np.sin(step * 0.173)
    total = -51.5312 + np.cumsum(jump + rng.normal(0, 2e-7, steps + 1))
    series = {
        "step": step, "time": step * DT, "potential": potential, "kinetic": total - potential,
        "total": total, "conserved": total, "temperature": (total - potential) / (1.5 * ATOMS * 8.617e-5),
        "pressure": 0.012 + 0.01 * rng.normal(size=steps + 1), "pairs": 23_000 + inside.sum(axis=1),
        "entered": came, "left": went, "displacement": 0.03 * (step % LIST), "energy_jump": jump,
        "ambiguous": np.zeros(steps + 1, int), "min_margin": np.abs(margin).min(axis=1, initial=RADIUS**2),
    }  # fmt: skip
    start = np.arange(0, steps, LIST)
    length = np.minimum(LIST, steps - start)
    epochs = {
        "epoch": np.arange(len(start)), "start": start, "length": length, "displacement": 0.03 * length,
        "skin_consumed": 0.06 * length, "capacity": np.full(len(start), 112),
        "occupancy": rng.integers(88, 104, len(start)), "pairs_listed": rng.integers(6, 7, len(start)),
        "reason": np.where(start + length < steps, "displacement", "end"),
        "dangerous": np.zeros(len(start), bool), "margin": -rng.exponential(0.01, len(start)),
        "build_ms": rng.gamma(30.0, 0.2, len(start)), "first_lost_step": np.full(len(start), -1),
        **{name: np.zeros(len(start), int) for name in ("lost_pairs", "lost_pair_steps")},
    }  # fmt: skip
    folder = RunFolder.create(path, frame.layout("md"))
    write_text(folder.path / "system.toml", toml)
    for last in (steps // 2, steps)[: 1 + finish]:
        begun = 0 if last < steps else steps // 2 + 1
        for name, table, when in (("flips", flips, at), ("series", series, step), ("epochs", epochs, start)):
            rows = (when >= begun) & (when <= last)
            folder.append(name, {column: values[rows] for column, values in table.items()})
        folder.checkpoint({"step": last}, force=True)
    if not finish:
        folder.close()
        return RunFolder.open(path)
    folder.finalize()
    folder.write_summary({
        "system": "argon/liquid-864", "units": "metal", "atoms": ATOMS, "steps": steps, "time": steps * DT,
        "flips_entered": int(came.sum()), "flips_left": int(went.sum()), "rebuilds": len(start) - 1,
        "dangerous_builds": 0, "lost_pairs": 0, "lost_pair_steps": 0, "first_lost_step": -1, "ambiguous": 0,
        "energy_drift": (total[-1] - total[0]) / (ATOMS * steps * DT), "energy_budget_checks": 21,
        "energy_budget_residual": 2.6e-14, "energy_budget_tolerance": abs(JUMP) / 10,
        "energy_budget_closes": True, "steps_per_second": 412.7,
        "cutoff": {"kind": "hard", "radius": RADIUS, "compare": "r2 <", "energy_jump": JUMP,
                   "force_jump": 1.18e-4, "smoothness": -1},
        "ase": {"energy_rel": 3.4e-15, "force_max": 2.2e-16, "stress_max": 1.1e-17, "force_scale": 0.0281,
                "ok": True},
        "status": "complete",
        **(summary or {}),
    })  # fmt: skip
    folder.write_provenance({"command": "mdnum run argon/liquid-864", "fingerprint": "9f1c52d0a7b3e4c8"})
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "good")


@pytest.fixture(scope="module")
def good(folder):
    return RunView(folder, folder.summary)


@pytest.fixture(scope="module")
def html(folder):
    return report(folder)


def report(folder):
    return (frame.finish(folder).folder / "report.html").read_text(encoding="utf-8")


def changed(view, summary=None, **changes):
    """The view of a folder that says something else: whole tables, scanned flips, the system."""
    own = {name: changes.pop(name, getattr(view, name)) for name in ("flips", "system")}
    made = replace(view, summary={**view.summary, **(summary or {})}, _tables={**view._tables, **changes})
    made.__dict__.update(own)
    return made


def with_row(columns, row, **values):
    """A table with other values in a row."""
    changed = {name: column.copy() for name, column in columns.items()}
    for name, value in values.items():
        changed[name][row] = value
    return changed


def found(view):
    return {finding.code: finding for finding in judge(view).findings}


def test_every_planted_defect_is_found(good):
    """And nothing in a good run; each has a page."""
    run, last = good, len(good.series["step"])
    jump = float(run.series["energy_jump"][77])
    table = {name: np.delete(values, 40) for name, values in good.folder.read("flips").items()}
    kicks = 1e4 * run.series["energy_jump"]
    kicked = {"energy_jump": kicks + run.series["energy_jump"]}
    kicked |= {name: run.series[name] + np.cumsum(kicks) for name in ("total", "conserved")}
    drifting = {"conserved": run.series["conserved"] + 5 * run.series["time"]}
    planted = {
        "RUN_FAILED": changed(good, {"status": "failed", "error": "a force is NaN"}),
        "NOT_FINISHED": changed(good, {"status": None}),
        "TIME_STEP": changed(good, {"fastest_period": 0.01}),
        "LOST_PAIRS": changed(
            good, epochs=with_row(run.epochs, 1, lost_pairs=3, lost_pair_steps=11, first_lost_step=25)
        ),
        "DANGEROUS_BUILDS": changed(good, epochs=with_row(run.epochs, 1, dangerous=True)),
        "EVENT_ALGEBRA": changed(good, series=with_row(run.series, 77, pairs=1)),
        "LEDGER_INCOMPLETE": changed(good, flips=analysis.scan(table, last)),
        "BUDGET_OPEN": changed(
            good, {"energy_budget_closes": False}, series=with_row(run.series, 77, energy_jump=jump + JUMP)
        ),
        "TIE_AT_CUTOFF": changed(good, series=with_row(run.series, 0, min_margin=0.0)),
        "AMBIGUOUS_DECISIONS": changed(good, {"ambiguous": 2}),
        "DRIFT": changed(good, series={**run.series, **drifting}),
        "WANDER": changed(good, series={**run.series, **kicked}),
        "LISTS_DISAGREE": changed(good, {"count_mismatches": 2}),
        "ASE_DISAGREES": changed(good, {"ase": {"ok": False, "energy_rel": 1e-3, "force_max": 0.1}}),
        "ASE_NOT_COMPARED": changed(good, {"ase": None}),
        "FORCE_JUMP": changed(good, {"cutoff": {"kind": "shifted", "energy_jump": 0.0, "force_jump": 1e-4}}),
        "OTHER_TEMPERATURE": changed(good, system={**good.system, "dynamics": {"temperature": 1e4}}),
        "HARD_CUTOFF": good,
        "NOT_COMPILED": changed(good, {"not_compiled": "scan"}),
    }
    for code, values in {"FIXED_BOX": {}, "UNTRIED": {}, "LIST_FAILED": {"error": "no list"}}.items():
        planted[code] = changed(good, system={**good.system, "potential": {"notes": {code: values}}})
    # of own functions: planted in tests/audit/test_functions.py and tests/systems
    own = {
        "FUNCTION_SLOPE", "FUNCTION_NOT_FINITE", "FUNCTION_BREAKS", "PARAMETERS_FLOAT32", "SINGLE_INSIDE",
        "TRUSTS_LIST", "DECIDES_ITSELF", "ENERGY_JUMPS", "NO_EDGES_NAN", "NAN_ON_OVERFLOW", "NOT_ADDITIVE",
        "PARAMETERS_HELD", "R_CUT_LONGER", "COUNTS_ITSELF",
    }  # fmt: skip
    assert set(planted) | own | {"CHATTER"} == {code for code in TEXTS.entries if code.isupper()}
    for code, view in planted.items():
        assert set(found(view)) == ({code} if code == "FORCE_JUMP" else {code, "HARD_CUTOFF"}), code
        assert page(view, judge(view)).sections, code
    # a flip that the recorder dropped: the budget is open by its jump at its step
    values = found(planted["BUDGET_OPEN"])["BUDGET_OPEN"].values
    assert values["step"] == 77 and values["largest"] == pytest.approx(values["jump"], rel=0.01)
    verdict = judge(good)
    assert (verdict.tone, verdict.headline, len(verdict.evidence)) == ("good", TEXTS("notes"), 5)


def test_lost_pairs_come_with_numbers_and_a_remedy_and_before_what_follows_from_them(good):
    lost = with_row(good.epochs, 1, lost_pairs=3, lost_pair_steps=1108, first_lost_step=25)
    blind = {**good.system, "neighbors": {"rebuild": {"check": False, "every": 20}}}
    verdict = judge(changed(good, epochs=lost, system=blind))
    finding = verdict.findings[0]
    assert (verdict.tone, finding.code, len(verdict.evidence)) == ("error", "LOST_PAIRS", 4)
    assert finding.values == {"lost": 3, "pair_steps": 1108, "since": 25, "every": 20}
    assert "every 20 steps" in finding.remedy
    assert verdict.headline.startswith(finding.title[0].upper() + finding.title[1:])
    series = with_row(good.series, 77, pairs=1)
    first, *rest = judge(changed(good, {"energy_budget_closes": False}, epochs=lost, series=series)).findings
    assert [first.code, *(each.code for each in rest[:2])] == ["LOST_PAIRS", "EVENT_ALGEBRA", "BUDGET_OPEN"]
    assert {each.remedy for each in rest[:2]} == {TEXTS.entries["EVENT_ALGEBRA"]["remedy_lost"]}


def test_a_time_step_is_judged_by_what_the_energy_does_and_by_the_fastest_vibration(good):
    """A known noise on a known swing; a drift of known size and its error; nothing where nothing is known."""
    rows = 4001
    at, noise = np.arange(rows), np.random.default_rng(3).normal(size=rows)
    series = {name: np.resize(values, rows) for name, values in good.series.items()}
    series |= {"step": at, "time": at * DT, "kinetic": 10 + np.sin(0.3 * at), "energy_jump": np.zeros(rows)}
    sigma = 0.08 / 2**0.5  # 8 % of the swing's standard deviation
    flips = analysis.scan({name: values[:0] for name, values in good.folder.read("flips").items()}, rows)

    def run(conserved, **summary):
        own = {name: np.zeros(rows, int) for name in ("entered", "left")} | {"pairs": np.full(rows, 100)}
        return changed(good, summary, flips=flips, series=series | own | {"conserved": conserved})

    noisy = run(sigma * noise)
    assert noisy.time_step["fluctuation"] == pytest.approx(0.08, rel=0.05)
    assert judge(noisy).headline.endswith(found(noisy)["TIME_STEP"].title + ".")
    calm = run(sigma / 8 * noise, fastest_period=20 * DT)
    assert "TIME_STEP" not in found(calm) and calm.time_step["per_period"] == pytest.approx(20)
    assert "TIME_STEP" in found(run(sigma / 8 * noise, fastest_period=4.5 * DT))
    # a line through it is a drift and no fluctuation
    thermal = ATOMS * good.thermal
    line = 0.03 * thermal * at / rows
    tilted = run(sigma / 8 * noise + line).time_step
    assert tilted["fluctuation"] == pytest.approx(calm.time_step["fluctuation"], rel=1e-6)
    assert tilted["drift"] == pytest.approx(0.03, rel=0.02) and 0 < tilted["drift_error"] < 1e-3
    # a walk that ends away from where it began is not told from none
    walk = np.cumsum(noise)
    assert "DRIFT" in found(run(line)) and "DRIFT" not in found(run(walk * 0.02 * thermal / np.ptp(walk)))
    short = changed(good, series={name: values[:30] for name, values in good.series.items()})
    assert set(short.time_step.values()) == {None}


def test_remedies_name_what_the_system_has(good):
    """A key that its file holds, and no cutoff where the potential has its own end; rounding is no kick."""
    tie = {"series": with_row(good.series, 0, min_margin=0.0)}
    for key in ("radius", "in_sigma", "pairs"):
        view = changed(good, system={**good.system, "cutoff": {"kind": "hard", key: 2.5}}, **tie)
        assert f"cutoff.{key}" in found(view)["TIE_AT_CUTOFF"].remedy
    many_body = {name: value for name, value in good.system.items() if name != "cutoff"}
    for jump in (JUMP, 0.0):
        view = changed(
            good, {"cutoff": {**good.cutoff, "energy_jump": jump, "force_jump": 1e-3}, "ambiguous": 2},
            system=many_body, **tie,
        )  # fmt: skip
        assert not any(re.search(r"cutoff\.\w", each.remedy) for each in judge(view).findings)
        assert ("HARD_CUTOFF" in found(view)) == bool(jump)
    rounding = {"cutoff": {**good.cutoff, "energy_jump": 9e-24, "force_jump": 1e-22}}
    assert not {"HARD_CUTOFF", "FORCE_JUMP"} & set(found(changed(good, rounding)))
    kick = found(good)["HARD_CUTOFF"]
    assert kick.values["share"] == pytest.approx(abs(JUMP) / good.thermal)


def test_of_pair_types_that_differ_the_one_with_the_largest_kick_is_named(good):
    hard = {**good.cutoff, "largest": ["Ni-P", "P-P"]}
    shifted = {**hard, "kind": "shifted", "energy_jump": 0.0, "force_jump": 1e-4}
    for code, cutoff, pair in (("HARD_CUTOFF", hard, "Ni-P"), ("FORCE_JUMP", shifted, "P-P")):
        told = found(changed(good, {"cutoff": cutoff}))[code]
        assert pair in told.title and pair in told.text and "up to" in told.title
        assert "up to" not in found(changed(good, {"cutoff": {**cutoff, "largest": None}}))[code].title


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
    assert other["title"] in second.verdict.headline


def test_a_killed_run_is_judged_up_to_its_checkpoint_and_none_without_a_step(tmp_path):
    folder = make_run(tmp_path / "run", steps=60, candidates=200, finish=False)
    verdict = frame.finish(folder).verdict
    assert (verdict.headline, verdict.findings[0].values["steps"]) == (TEXTS("partial"), 30)
    assert RunFolder.open(folder.path).resume() == {"step": 30}
    empty = RunFolder.create(tmp_path / "empty", frame.layout("md"))
    write_text(empty.path / "system.toml", 'units = "lj"')
    with pytest.raises(FolderError, match=r"empty: .*no step"):
        frame.finish(empty)


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
    assert len(tags.labels) == tags.seen.count("svg") == 6
    assert all(re.search(r"\d", label) for label in tags.labels)
    assert len(html) < 3_000_000 and html == report(folder)
    names = sorted(path.name for path in (folder.path / "figures").iterdir())
    stems = ("energy", "flips", "lengths", "lists", "margins", "residence")
    assert names == [f"{stem}.svg" for stem in stems]
    for name in names:
        text = (folder.path / "figures" / name).read_text(encoding="utf-8")
        ElementTree.fromstring(text)
        assert set(re.findall(r"var\(--(\w+)\)", text)) <= set(drawing.LIGHT) == set(drawing.DARK)
        # a color that no theme knows would vanish on one of the two backgrounds
        assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= {*drawing.LIGHT.values(), *drawing.DARK.values()}


def test_the_page_states_what_the_folder_holds(html, folder, good, tmp_path):
    for text in (TEXTS("notes"), "HARD_CUTOFF", "Liquid argon (Rahman 1964)", "9f1c52d0a7b3e4c8"):
        assert text in html
    rows = json.loads(re.search(r'id="flips-rows">(.*?)</script>', html, re.DOTALL)[1])
    flips = folder.read("flips")
    assert len(rows) == min(TABLE_ROWS, good.flips.total)
    shown = {(step, i, j) for step, i, j, *_ in rows}
    nearest = np.argsort(np.abs(flips["margin"]) / flips["bound"])[:TABLE_ROWS]
    assert shown == {(int(flips["step"][row]), int(flips["i"][row]), int(flips["j"][row])) for row in nearest}
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    # text from a file is no markup
    toml = TOML.replace("Liquid argon", "<script>alert(1)</script> </pre>")
    html = report(make_run(tmp_path / "run", steps=20, candidates=50, toml=toml))
    assert "<script>alert" not in html and "&lt;script&gt;alert(1)" in html


def test_numbers_that_are_bad_or_missing_do_not_break_the_page(tmp_path, good):
    """Of a failed run; no flip; atoms at rest; no skin; steps of no length."""
    names = ("potential", "total", "conserved", "temperature", "pressure")
    broken = with_row(good.series, -1, **dict.fromkeys(names, np.nan))
    failed = {"status": "failed", "energy_drift": None, "energy_budget_residual": None}
    view = changed(good, failed, series=broken)
    assert found(view)["RUN_FAILED"].values["step"] == 150 and page(view, judge(view)).sections
    assert report(make_run(tmp_path / "still", steps=5, candidates=0, summary={"ase": None, "cutoff": None}))
    names = ("energy_jump", "temperature", "entered", "left")
    still = {name: np.zeros_like(good.series[name]) for name in names}
    still |= {name: np.full_like(good.series[name], good.series[name][0]) for name in ("conserved", "pairs")}
    none = analysis.scan({name: values[:0] for name, values in good.folder.read("flips").items()}, 151)
    bare = {**good.epochs, "skin_consumed": np.full(len(good.epochs["epoch"]), np.inf)}
    short = {**good.series, "time": good.series["time"] * 1e-300}
    unlisted = {name: values[:0] for name, values in good.epochs.items()}
    quiet = {"series": {**good.series, **still}, "flips": none}
    for changes in (quiet, {"epochs": bare}, {"epochs": unlisted}, {"series": short}):
        view = changed(good, {"energy_drift_without_jumps": None}, **changes)
        assert page(view, judge(view)).sections


@pytest.mark.parametrize("step", [1e-300, 1e-160, 0.0, 1e160])
def test_a_time_that_has_no_slope(step):
    line = LineFit()
    line.add(step * np.arange(5), np.arange(5.0))
    assert line.slope is None


def test_another_process_compiles_what_the_first_run_calls_and_keeps_it(tmp_path):
    subprocess.run(python("-c", COMPILE), env=environment(NUMBA_CACHE_DIR=str(tmp_path)), check=True)
    kept = {file.name.split("-")[0] for file in tmp_path.rglob("*.nbc")}
    assert {"kernel._over_blocks", "kernel._help", "decide._note"} <= kept


@pytest.mark.nightly
def test_energy_is_set_beside_that_of_float64(tmp_path):
    smooth = {"cutoff.kind": "quintic"}
    whole, floats = (
        mdnum.run("argon/crystal-108", out=tmp_path / state, steps=60, check=state == "lattice", report=False,
                  overrides={**smooth, "precision.state": state})
        for state in ("lattice", "float64")
    )  # fmt: skip
    told = whole.summary["fixed_point"]
    assert told["energy_steps"] == 60
    for key, run in (("energy_std", whole), ("energy_std_float64", floats)):
        energy = np.asarray(RunFolder.open(run.folder).read("series")["total"])
        assert len(energy) == 61
        # the starts differ by the changed edges of the box
        assert told[key] == pytest.approx(np.std(energy) / 108, rel=1e-4)


# -- in a real browser: sorting, searching and paging do what they say --------------------------------

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

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


def hashed(script: str) -> str:
    """How a page's policy names a script."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def shown_by_browser(page: Path, folder: Path) -> str:
    """The elements of a page once a browser has shown it."""
    return subprocess.run(
        [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--window-size=390,800",
         f"--user-data-dir={folder / 'profile'}", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=240,
    ).stdout  # fmt: skip


def test_a_page_may_show_itself_and_run_its_own_script_alone(tmp_path):
    page = frame.finish(make_run(tmp_path / "run", steps=30)).folder / "report.html"
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]+)">', text)
    # before anything that it is to hold for
    assert found is not None and text.index("<style") > found.start() < text.index("<title")
    policy = dict(part.split(maxsplit=1) for part in unescape(found[1]).split(";"))
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert policy.pop("script-src") == f"'{hashed(script)}'"
    assert policy == {
        "default-src": "'none'", "base-uri": "'none'", "form-action": "'none'", "img-src": "data:",
        "style-src": "'unsafe-inline'",
    }  # fmt: skip
    assert not re.search(r"<[^>]+\son\w+\s*=", text), "a handler in an attribute would not be called"
    if BROWSER is None:
        return
    planted = "<p id=planted>as written</p><img src=x onerror=\"planted.textContent = 'run'\">"
    planted += "<script>planted.textContent = 'run'</script>"
    assert "data-needs-script hidden" in text
    page.write_text(text.replace("</main>", planted + "</main>"), encoding="utf-8")
    shown = shown_by_browser(page, tmp_path)
    assert "as written</p>" in shown
    # its own has run: what needs it is there
    assert re.search(r"data-needs-script(?![^>]*hidden)", shown)


@pytest.mark.skipif(BROWSER is None, reason="no browser installed")
def test_sort_search_and_pages(tmp_path):
    folder = make_run(tmp_path / "run", steps=120, candidates=300)
    run = RunView(folder, folder.summary)
    page = frame.finish(folder).folder / "report.html"
    i, j = int(run.flips.nearest["i"][0]), int(run.flips.nearest["j"][0])
    script = SCRIPT.replace("PAIR", f'"{j}-{i}"').replace("ATOM", f'"{i}"')
    text = page.read_text(encoding="utf-8").replace("</body>", script + "</body>")
    # the page's policy runs no script but its own: this one is added to it
    inner = re.search(r"<script>(.*?)</script>", script, re.DOTALL)
    assert inner is not None
    text = text.replace("script-src ", f"script-src '{hashed(inner[1])}' ")
    page.write_text(text, encoding="utf-8")
    shown = shown_by_browser(page, tmp_path)
    found = re.search(r'<pre id="result">(.*?)</pre>', shown, re.DOTALL)
    assert found, shown[-2000:]
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
    assert "“colour”" in seen["unknown"]
    # nothing sticks out of a phone's screen (headless browsers do not go below 500 pixels)
    assert seen["width"] <= 500


def exponent(text: str) -> float:
    mantissa, _, power = text.partition(" × 10")
    return float(mantissa) * 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)
