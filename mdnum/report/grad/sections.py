"""Tables of a gradient's page: what differences mean, shares of the flips, and the flips themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mdnum.report.browse import Browse, Column, plain_rows
from mdnum.report.fork.question import Question
from mdnum.report.grad.words import apart, digits_of, one_slope, slope_unit
from mdnum.report.words import count, number, typeset

#: Rows of the table of flips that the page carries.
TABLE_ROWS = 2_000
#: Parameters whose contributions have a column there.
_SHOWN = 3


def differences(run: Question) -> Iterator[dict[str, str]]:
    """A row for each method and parameter that differs from the reference."""
    for row in run.summary["comparisons"]:
        if row["says"]:
            yield {
                "method": row["method"],
                "name": row["name"],
                "apart": apart(row),
                "says": typeset(row["says"]),
            }


def shares(run: Question) -> list[dict[str, object]]:
    """What each channel adds to each derivative."""
    found = run.summary.get("flips") or {}
    rows = []
    for name, parts in found.get("share", {}).items():
        parameter = name.partition("[")[0]
        unit = next(
            (slope_unit(run.summary, one) for one in run.summary["parameters"] if one["name"] == parameter),
            "",
        )
        rows.append(
            {
                "name": name,
                "parts": [
                    # of a derivative without a digit a share is none
                    _percent(None if digits_of(run.summary, parameter) == 0 else parts[key])
                    for key in ("smooth", "pair enters", "pair leaves")
                ],
                "total": f"{one_slope(run.summary, parameter, found['total'][name], 4)} {unit}".rstrip(),
            }
        )
    return rows


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{number(100 * share, 3, signed=True)} %"


def edges(run: Question) -> Iterator[dict[str, Any]]:
    """The nearest boundaries of decisions on either side of each parameter."""
    for one in (run.summary.get("edges") or {}).values():
        for side in (one["below"], one["above"]):
            if not side["found"]:
                yield {
                    "name": one["name"], "side": side["side"], "inside": "none within reach", "beyond": "",
                    "decision": "", "gradients": [],
                }  # fmt: skip
                continue
            yield {
                "name": one["name"],
                "side": side["side"],
                "inside": repr(side["inside"]),
                "beyond": repr(side["beyond"]),
                "decision": f"pair {side['i']}–{side['j']} at step {count(side['step'])}",
                "gradients": [
                    one_slope(run.summary, one["name"], side[where].get("event-aware"), 6)
                    for where in ("gradient_inside", "gradient_beyond")
                ],
            }


def flips(run: Question) -> Browse | None:
    """The heaviest flips; None where there was none."""
    table = {name: values[:TABLE_ROWS] for name, values in run.tables["flip_contributions"].items()}
    if not len(table["step"]):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(table["margin"]) / table["bound"]
    added = [name for name in table if name.startswith("contribution.")][:_SHOWN]
    columns: list[tuple[np.ndarray, int | None]] = [(np.arange(1, len(ratio) + 1), None)]
    columns += [(table[name].astype(int), None) for name in ("step", "i", "j", "entered", "grazing")]
    columns += [(table[name].astype(float), 4) for name in ("radial_speed", "weight", *added)]
    columns.append((ratio.astype(float), 3))
    return Browse(
        name="flips",
        row_id="flip-rows",
        label="Search flips",
        placeholder="3-17, atom 5, step:100..200, entered, grazing",
        columns=(
            Column(0, "rank", kind="count"),
            Column(1, "step", kind="count"),
            Column(2, "pair", kind="pair"),
            Column(4, "decision", kind="word", words=("left", "entered"), colors=("out", "in")),
            Column(6, "radial speed"),
            Column(7, "weight"),
            *(
                Column(8 + place, f"adds to {name.removeprefix('contribution.').rpartition('.')[2]}")
                for place, name in enumerate(added)
            ),
            Column(5, "", kind="word", words=("", "grazing")),
            Column(8 + len(added), "margin", "÷ bound", digits=2, missing="∞"),
        ),
        rows=plain_rows(columns),
        words={"entered": (4, 1), "in": (4, 1), "left": (4, 0), "out": (4, 0), "grazing": (5, 1)},
        ranges={"step": 1},
        subjects=(2, 3),
        nouns=("atom", "pair"),
        ambiguous=8 + len(added),
    )
