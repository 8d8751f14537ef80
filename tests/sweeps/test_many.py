"""What is made of many points: how it is read, compared and shown."""

from __future__ import annotations

from collections import Counter
from cProfile import Profile
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mdnum
from mdnum.plain import plain
from mdnum.report.section import Plot, Table
from mdnum.sweeps.analysis import analyzed
from mdnum.sweeps.design import Axis, Point, label
from mdnum.sweeps.plan import Plan, Question, planned
from mdnum.verbs.frame import View
from mdnum.verbs.sweep_page import judge, page


class Stored:
    """In place of a workspace: each point has a result, whose value is its address."""

    def __init__(self, *names: str) -> None:
        self.read, self.names = Counter[str](), names or ("final_height",)

    def result(self, address: str) -> dict[str, Any]:
        self.read[address] += 1
        value = {"value": float(address), "error": 0.0, "effective": None, "digest": ""}
        return {"status": "complete", "measures": dict.fromkeys(self.names, value), "summary": {}}


def plan_of(settings: int) -> Plan:
    """Of a ball, with as many heights; only the first is resolved."""
    question = Question(measure="final_height", tolerance={"final_height": 0.1},
                        converged={"start.height": "smallest"})  # fmt: skip
    ball = mdnum.load("ball/drop", {"variants": {}})
    plan = planned(ball, {"start.height": [1.0]}, question, None)
    (first,) = plan.points
    heights = [1 + k / settings for k in range(settings)]
    points = [
        replace(first, point=Point({"start.height": one}, None), setting=(label(one),), address=str(one))
        for one in heights
    ]
    return replace(plan, axes=[Axis("start.height", tuple(heights))], points=points)


def shown(plan: Plan, stored: Stored) -> list[Any]:
    """Tables and plots of the page."""
    _, summary = analyzed(stored, plan)  # type: ignore[arg-type]
    more = {"computed": 0, "found": 0, "changed": [], "seconds": 1.0, "workers": 1}
    folder: Any = SimpleNamespace(system_file=None, provenance={}, system={})
    view = View(folder, plain({**summary, **more}))
    return [part for section in page(view, judge(view)).sections for part in section.parts]


def test_the_work_grows_with_the_number_of_settings_and_the_page_does_not():
    calls, parts = [], []
    shown(plan_of(10), Stored())  # what is imported at the first call
    for settings in (300, 600):
        plan, stored, profile = plan_of(settings), Stored(), Profile()
        parts = profile.runcall(shown, plan, stored)
        assert set(stored.read.values()) == {1} and len(stored.read) == settings
        calls.append(sum(entry.callcount for entry in profile.getstats()))
    assert 1.5 < calls[1] / calls[0] < 2.2
    tables = [part for part in parts if isinstance(part, Table)]
    (plot,) = [part for part in parts if isinstance(part, Plot)]
    assert [len(table.rows) for table in tables] == [500] * 3
    assert len(plot.series[0].x) == 300 and plot.series[0].x[-1] == 1 + 599 / 600
    # the whole is named in each place, and a sentence has no list of 600 values
    texts = [part for part in parts if isinstance(part, str)]
    assert sum("600" in text for text in texts) >= 3 and max(map(len, texts)) < 1000


def test_functions_of_one_name_in_two_files_have_figures_of_their_own():
    plan, names = plan_of(5), ("/one/mine.py:height", "/two/mine.py:height")
    (measure,) = plan.measures
    plan = replace(
        plan, measures=[replace(measure, name=name) for name in names], question=Question(measure=names)
    )
    parts = shown(plan, Stored(*names))
    assert len({part.name for part in parts if isinstance(part, Plot)}) == 2
    told = {row[0] for row in parts[1].rows}
    assert told == {"one/mine.py:height (m)", "two/mine.py:height (m)"}
