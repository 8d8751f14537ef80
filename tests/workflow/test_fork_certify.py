"""A ranking of precisions into its folder: tables, page and verdict agree with the certificate."""

from __future__ import annotations

import re

import numpy as np
import pytest
from report.test_html import Tags

import mdnum
from mdnum.forks.exact import POLICIES, installed
from mdnum.report.fork import certify as page
from mdnum.report.fork.question import load
from mdnum.store import RunFolder

# two precisions of a run, the exact one, and a second look at every decision
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not installed(), reason="needs python-flint")]

STEPS = 240


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """The crystal whose shell lies at a hard cutoff, a little further than single precision keeps to it."""
    few = {name: POLICIES[name] for name in ("float32", "float64")}
    out = tmp_path_factory.mktemp("certified") / "crystal"
    return mdnum.fork_certify("argon/crystal-108", steps=STEPS, policies=few, out=out)


def test_the_tables_hold_the_certificate(certified):
    folder = RunFolder.open(certified.folder)
    assert folder.world == "certify" and folder.summary == certified.summary
    table, ranking = folder.read("policies"), certified.certificate.ranking
    assert table["policy"].tolist() == [row.name for row in ranking] == ["float64", "float32"]
    assert table["horizon"].tolist() == [-1 if row.horizon is None else row.horizon for row in ranking]
    assert 0 < table["horizon"][1] < STEPS and table["horizon"][0] == -1
    assert table["force"].tolist() == ["float64", "float32"]
    apart = folder.read("policy_separations")
    for row in ranking:
        mine = apart["policy"] == row.name
        np.testing.assert_array_equal(apart["separation"][mine], row.separation)
        assert apart["step"][mine].tolist() == list(range(len(row.separation)))
    # seven digits and sixteen
    last = [apart["separation"][apart["policy"] == name][20] for name in ("float32", "float64")]
    assert last[0] > 1e4 * last[1] > 0


def test_ambiguous_decisions_are_counted_listed_and_exported(certified):
    table = RunFolder.open(certified.folder).read("ambiguous")
    told = certified.summary["ambiguous"]
    assert set(told) == {"float32", "float64"}
    for name, one in told.items():
        mine = table["policy"] == name
        assert one["total"] == np.count_nonzero(mine) == certified.ambiguous[name].total
        assert one["horizon"] == (table["step"][mine].min() if one["total"] else None)
    assert told["float32"]["total"] > 0
    assert np.all(np.abs(table["margin"]) <= table["bound"]) and np.all(table["i"] < table["j"])
    # exact arithmetic decides by the sign of the exact margin
    np.testing.assert_array_equal(table["wrong"], table["inside"] != (table["exact"] > 0))


def test_the_page_says_what_the_folder_holds(certified):
    text = (certified.folder / "report.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert tags.open == [] and tags.sources == []
    words = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))
    assert sorted(path.stem for path in (certified.folder / "figures").iterdir()) == [
        "ranking",
        "separations",
    ]
    total = certified.summary["ambiguous"]["float32"]["total"]
    assert re.search(rf"float32 state float32, .* {total:,} from step", words)


def test_who_leaves_first_is_the_headline(certified, tmp_path):
    (_, run) = load(certified.folder, "certify")
    rows = run.summary["policies"]

    def told(*horizons):
        changed = [{**row, "horizon": at} for row, at in zip(rows, horizons, strict=True)]
        one = type(run)(run.path, {**run.summary, "policies": changed}, "", {}, run.tables)
        return page.judge(one)

    assert told(None, None).headline.startswith("Every precision keeps") and told(None, None).tone == "good"
    assert "1 of 2 precisions keeps" in told(None, 40).headline
    assert "float32 leaves it first, at step 40" in told(None, 40).headline
    assert told(70, 40).headline.startswith("No precision keeps") and told(70, 40).tone == "info"
