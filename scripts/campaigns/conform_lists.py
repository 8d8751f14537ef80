"""Which neighbor lists list the right pairs? Every installed one through the conformance suite, in one table.

Answer. Those of ASE, scipy, freud, mdnum and MDAnalysis's brute force do wherever they answer; vesin 0.6,
jax-md 0.2.29, matscipy 1.3, pymatgen and MDAnalysis's nsgrid each have cases that are wrong, or end them
(docs/conform.md). It takes minutes, with --all --large more.

    python scripts/campaigns/conform_lists.py                      the lists that take seconds
    python scripts/campaigns/conform_lists.py vesin matscipy       these
    python scripts/campaigns/conform_lists.py --all --large        also jax-md's (minutes), and 100,000 atoms

Each list runs in a process of its own, so that one that crashes is a row and not an end. The figure shows the
share of the cases that each answers rightly, by what they are about.
"""

from __future__ import annotations

from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import figure, parser, save, say, start, table

from mdnum.references.conformance import AREAS, Report, examine, installed, load, script

# compiles for every number of atoms
_SLOW = ("jax-md", "jax-md-kept")


def main() -> None:
    """Examine, tabulate, draw."""
    made = parser(__doc__, __file__)
    made.add_argument("lists", nargs="*", metavar="LIST", help="names, or package.module:function")
    made.add_argument("--all", action="store_true", help="the slow ones, too")
    made.add_argument("--large", action="store_true", help="ask about 5,000 and 100,000 atoms, too")
    made.add_argument("--cases", type=int, default=100, help="random cases (default 100)")
    made.add_argument("--scripts", type=Path, metavar="DIR", help="write a script for every failure there")
    asked = made.parse_args()
    words = asked.lists or [one.name for one in installed() if asked.all or one.name not in _SLOW]
    reports = []
    for word in words:
        say(f"{word} ...")
        report = examine(load(word), cases=asked.cases, large=asked.large, apart=True)
        reports.append(report)
        if asked.scripts is not None:
            _write_scripts(asked.scripts, report)
    table(
        "every list against brute force",
        (
            "list",
            "version",
            "speaks",
            "at r = r_cut",
            "precision",
            "asked",
            "right",
            "refused",
            "wrong",
            "how",
        ),
        [_row(report) for report in reports],
        words=5,
    )
    for report in reports:
        for failed in report.failed:
            say(f"{report.tested.name}: {failed.code}, {failed.case.atoms} atoms ({failed.case.name}): ")
            say(f"    {failed.worst.text}")
    _draw(reports, asked.output)


def _row(report: Report) -> tuple[object, ...]:
    refused = sum(tally.refused for tally in report.areas.values())
    counted, not_counted = report.ties
    ties = "both" if counted and not_counted else "inside" if counted else "outside" if not_counted else "-"
    speaks = ("both ways" if report.how.full else "once") + (", shifts" if report.shifts else "")
    codes: dict[str, int] = {}
    for tally in report.areas.values():
        for code, count in tally.codes.items():
            codes[code] = codes.get(code, 0) + count
    return (
        report.tested.name,
        report.tested.version or "-",
        speaks,
        ties,
        "float64" if report.how.unit == 2.0**-53 else "float32",
        report.asked,
        report.asked - refused - report.wrong,
        refused,
        report.wrong,
        ", ".join(f"{code.lower()} {count}" for code, count in sorted(codes.items())) or "-",
    )


def _write_scripts(folder: Path, report: Report) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, failed in enumerate(report.failed, 1):
        name = report.tested.name.replace(":", "-").replace("/", "-")
        path = folder / f"{name}-{number}-{failed.code.lower()}.py"
        path.write_text(script(report.tested, failed, report.how, report.superset), encoding="utf-8")


def _draw(reports: list[Report], path: Path) -> None:
    """A square for each list and area: the share of cases that are right."""
    areas = [area for area in AREAS if any(area in report.areas for report in reports)]
    share = np.full((len(reports), len(areas)), np.nan)
    for row, report in enumerate(reports):
        for column, area in enumerate(areas):
            tally = report.areas.get(area)
            answered = 0 if tally is None else tally.asked - tally.refused
            if tally is not None and answered:
                share[row, column] = 1.0 - tally.failed / answered
    drawn = figure(2.2 + 0.62 * len(areas), 1.4 + 0.33 * len(reports))
    axes = drawn.subplots()
    axes.grid(visible=False)
    picture = axes.imshow(share, vmin=0.0, vmax=1.0, cmap="RdYlBu", aspect="auto")
    for (row, column), value in np.ndenumerate(share):
        tally = reports[row].areas.get(areas[column])
        if tally is not None and tally.failed:
            axes.text(column, row, str(tally.failed), ha="center", va="center", fontsize=8)
        elif np.isnan(value):
            axes.text(column, row, "·", ha="center", va="center", color="0.6")
    axes.set_xticks(range(len(areas)), areas, rotation=40, ha="right")
    axes.set_yticks(range(len(reports)), [report.tested.name for report in reports])
    axes.set_title("share of the answered cases that are right; numbers are cases that are wrong")
    drawn.colorbar(picture, ax=axes, fraction=0.03)
    save(drawn, path)


if __name__ == "__main__":
    start(main)
