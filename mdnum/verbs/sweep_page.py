"""Verdict and report page of `mdnum sweep`: significant changes, detection limits, recommendations."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Code, Page, Plot, Section, Series, table_of
from mdnum.report.words import listed, number
from mdnum.sweeps.advice import FREE
from mdnum.sweeps.design import label
from mdnum.units import named
from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("sweep.py"))
#: Most rows of a table, points of a plot, and values of a choice in a sentence: 10,000 settings have a page.
_ROWS, _POINTS, _VALUES = 500, 300, 20
#: Whether a value is within its tolerances, in a table.
_INSIDE = {True: "yes", False: "no", None: "not decided"}


def _shown(view: View, name: str) -> str:
    """Shorten the path in a measure's name as far as the name stays unique."""
    parts, others = Path(name).parts, [one["name"] for one in view.summary["measures"] if one["name"] != name]
    ends = ["/".join(parts[-k:]) for k in range(1, len(parts))] if ".py:" in name else []
    return next((end for end in ends if not any(one.endswith(f"/{end}") for one in others)), name)


def _unit(view: View, name: str) -> str:
    own = next((one["unit"] for one in view.summary["measures"] if one["name"] == name), "")
    return named(own, vars(view.units)) or own if own else ""


def _moved(view: View) -> dict[str, list[str]]:
    """Return for each varied choice the physical measures that it changes significantly."""
    found: dict[str, list[str]] = {axis["key"]: [] for axis in view.summary["axes"]}
    physical = {one["name"] for one in view.summary["measures"] if one["physical"]}
    for row in view.summary["differences"]:
        measures, shown = found[row["choice"]], _shown(view, row["measure"])
        if row["moves"] == "yes" and row["measure"] in physical and shown not in measures:
            measures.append(shown)
    return found


def judge(view: View) -> Verdict:
    """Return the verdict on a sweep: choices that change results, and recommended values."""
    s = view.summary
    moved = _moved(view)
    said = [TEXTS("moves", key=key, measures=listed(names)) for key, names in moved.items() if names]
    still = [key for key, names in moved.items() if not names]
    physical = {one["name"] for one in s["measures"] if one["physical"]}
    rows = [row for row in s["differences"] if row["moves"] != "undecided" and row["measure"] in physical]
    found: list[Finding] = list(_findings(view, moved))
    if not rows:
        headline = TEXTS("nothing_known", points=s["points"])
    elif said:
        headline = " ".join(said) + (" " + TEXTS("still", keys=listed(still)) if still else "")
    else:
        headline = TEXTS("nothing_moves", keys=listed(list(moved)))
    evidence = [
        TEXTS("runs", points=s["points"], settings=s["settings"], seeds=len(s["seeds"]), steps=s["steps"])
    ]
    if s["changed"]:
        fields = listed(
            [TEXTS("code") if name == "code" else name.removeprefix("asked.") for name in s["changed"]]
        )
        evidence.append(TEXTS("not_stored", computed=s["computed"], fields=fields))
    evidence += [TEXTS("compared", n=len(rows))] if rows else []
    evidence += [text for advice in s["advice"] if (text := _advised(view, advice))]
    evidence += _together(view)
    return conclude(found, evidence, headline=headline, best="info")


def _findings(view: View, moved: Mapping[str, list[str]]) -> Iterator[Finding]:
    s = view.summary
    for one in s["failed"]:
        values = {**one, "all": s["points"], "settings": listed(one["settings"][:5]), "why": one["why"][:400]}
        yield TEXTS.finding("POINTS_FAILED", section="Points that failed", **values)
    for name in dict.fromkeys(one["measure"] for one in s["missing"]):
        mine = [one for one in s["missing"] if one["measure"] == name]
        values = {"settings": len(mine), "all": s["settings"], "why": mine[0]["why"][:400]}
        yield TEXTS.finding("MEASURE_MISSING", measure=_shown(view, name), **values)
    for key in FREE:
        if moved.get(key):
            yield TEXTS.finding("FREE_CHOICE_MOVES", key=key, measures=listed(moved[key]))
    for advice in s["advice"]:
        if advice["converged"] is False and advice["choice"] not in FREE:
            worst = _shown(view, advice["settings"][1]["worst"])
            end, near = label(advice["end"]), label(advice["settings"][1]["value"])
            values = {"key": advice["choice"], "end": end, "next": near}
            yield TEXTS.finding("NOT_CONVERGED", section="What to use", measure=worst, **values)
    if (joint := s["joint"]) is not None and joint["inside"] is False:
        values: Any = {name: _keyed(view, joint[name]) for name in ("setting", "end")}
        yield TEXTS.finding(
            "JOINT_OUTSIDE", section="What to use", measure=_shown(view, joint["worst"]), **values
        )
    unknown = sorted(
        {_shown(view, row["measure"]) for row in s["differences"] if row["moves"] == "undecided"}
    )
    if unknown:
        yield TEXTS.finding("NO_ERROR", measures=listed(unknown))


def _advised(view: View, advice: Mapping[str, Any]) -> str:
    """Return a sentence on the recommended value of one varied choice."""
    key, end, best = advice["choice"], label(advice["end"]), label(advice["best"])
    if key in FREE:
        return "" if advice["best"] is None else TEXTS("use_fastest", key=key, best=best)
    undecided = next((one for one in advice["settings"] if one["value"] == advice["undecided"]), None)
    if undecided is not None and undecided["more"]:
        more = max(1, _further_seeds(view, undecided["more"]))
        return TEXTS("use_undecided", key=key, best=best, value=label(undecided["value"]), more=more,
                     measure=_shown(view, undecided["worst"]))  # fmt: skip
    if best == end:
        return TEXTS("use_end", key=key, end=end)
    return TEXTS("use", key=key, best=best, end=end)


def _further_seeds(view: View, factor: float) -> int:
    """Return how many seeds to add so that their number grows by the given factor."""
    return int(np.ceil(len(view.summary["seeds"]) * (factor - 1)))


def _together(view: View) -> list[str]:
    """Return a sentence on the runs that use all recommended values together."""
    joint = view.summary["joint"]
    if joint is None or joint["inside"] is False:
        return []
    values = {name: _keyed(view, joint[name]) for name in ("setting", "end")}
    if joint["inside"]:
        return [TEXTS("together", **values)]
    more = _further_seeds(view, joint["more"]) if joint["more"] else 0
    name = "together_undecided" if more > 0 else "together_unknown"
    return [TEXTS(name, measure=_shown(view, joint["worst"]), more=max(1, more), **values)]


def _keyed(view: View, setting: Sequence[str]) -> str:
    """Format a setting as a list of KEY = VALUE."""
    keys = [axis["key"] for axis in view.summary["axes"]]
    return listed([f"{key} = {value}" for key, value in zip(keys, setting, strict=True)])


def page(view: View, verdict: Verdict) -> Page:
    """Return the report page of a sweep."""
    s = view.summary
    keys = TEXTS.keys(
        points=s["points"], settings=s["settings"], computed=s["computed"], found=s["found"],
        seeds=len(s["seeds"]), failed=sum(one["points"] for one in s["failed"]), seconds=s["seconds"],
        workers=s["workers"], n=len(s["differences"]),
        moving=sum(row["moves"] == "yes" for row in s["differences"]),
    )  # fmt: skip
    return view.page(TEXTS("title", name=view.name), TEXTS("about"), keys, _sections(view))


def _sections(view: View) -> Iterator[Section]:
    s = view.summary
    yield Section("What moves what", [TEXTS("differences"), *_differences(view)], terminal=True)
    if s["advice"]:
        sizes = [f"{key} {number(one, 2)} {_unit(view, key)}".strip() for key, one in s["tolerances"].items()]
        told = TEXTS("settings", tolerances=listed(sizes)) if sizes else TEXTS("settings_none")
        yield Section("What to use", [told, *_settings(view)], terminal=True)
    for axis in s["axes"]:
        yield Section(axis["key"], list(_plots(view, axis)))
    yield Section("Every setting", [TEXTS("estimates"), *_estimates(view)])
    if s["failed"]:
        rows = [{**one, "settings": _several(one["settings"], "; ")} for one in s["failed"]]
        columns = {"points": "points", "settings": "settings", "why": "why"}
        yield Section("Points that failed", _most(rows, columns, "points.parquet"))
    yield Section(
        "Methods", [_methods(view), Code("methods.bib", TEXTS.entries["references"]["bib"].strip())]
    )


def _most(
    rows: Sequence[Any], columns: Mapping[str, str], stored: str, bad: Callable[[Any], Any] | None = None
) -> list[Any]:
    """Return a table of the first rows. If there are more rows, a note names the file with all rows."""
    more = [TEXTS("more_rows", shown=_ROWS, all=len(rows), stored=stored)] if len(rows) > _ROWS else []
    return [*more, table_of(rows[:_ROWS], columns, bad=bad)]


def _several(words: Sequence[str], separator: str = ", ") -> str:
    """Join words. Of many words, show the first three, the last, and the number of words."""
    if len(words) <= _VALUES:
        return separator.join(words)
    return TEXTS("many_values", first=separator.join(words[:3]), last=words[-1], n=len(words))


def _differences(view: View) -> list[Any]:
    rows = []
    ranked = sorted(view.summary["differences"], key=lambda row: -abs(row["sigmas"] or 0.0))
    for row in ranked:
        unit, shown = _unit(view, row["measure"]), _shown(view, row["measure"])
        rows.append({
            "measure": f"{shown} ({unit})" if unit else shown,
            "choice": f"{row['choice']} = {row['setting']}",
            "difference ± error": _with_error(row), "in errors": row["sigmas"], "chance": row["chance"],
            "moves": row["moves"], "detectable": row["detectable"],
        })  # fmt: skip
    names = ("measure", "choice", "difference ± error", "in errors", "chance", "moves", "detectable")
    columns = {name: name for name in names}
    return _most(rows, columns, "differences.parquet", lambda row: row["moves"] == "yes")


def _with_error(row: Mapping[str, Any]) -> str:
    """Format a value and its error. The error determines the number of digits."""
    value, error = row["value"], row["error"]
    if not error:
        return number(value, 5)
    digits = 2 + int(np.floor(np.log10(abs(value))) - np.floor(np.log10(error))) if value else 2
    return f"{number(value, min(max(digits, 2), 12))} ± {number(error, 2)}"


def _settings(view: View) -> list[Any]:
    rows = []
    for advice in view.summary["advice"]:
        for one in advice["settings"]:
            inside = _INSIDE[one["inside"]]
            if advice["choice"] in FREE:
                inside = f"{number(one['speed'], 3)} steps/s" if one["inside"] else "no"
            elif one["value"] == advice["end"]:
                inside = "taken as converged"
            use = "use" * (one["value"] == advice["best"])
            rows.append({"choice": advice["choice"], "value": str(one["value"]), "within": inside,
                         "by": _shown(view, one["worst"] or ""), "": use})  # fmt: skip
    if (joint := view.summary["joint"]) is not None:
        rows.append({"choice": "together", "value": _keyed(view, joint["setting"]),
                     "within": _INSIDE[joint["inside"]],
                     "by": _shown(view, joint["worst"] or ""), "": ""})  # fmt: skip
    columns = {"choice": "choice", "value": "value", "within its tolerance": "within", "kept out by": "by"}
    columns[""] = ""
    return _most(rows, columns, "summary.json")


def _plots(view: View, axis: Mapping[str, Any]) -> Iterator[Plot]:
    """Yield figures of each measure versus one choice. Other choices keep their base values."""
    s, values = view.summary, axis["values"]
    if not all(isinstance(one, int | float) for one in values):
        return
    place = [one["key"] for one in s["axes"]].index(axis["key"])
    base = [label(one["base"]) for one in s["axes"]]

    def at_base(setting: list[str]) -> bool:
        return all(k == place or text == base[k] for k, text in enumerate(setting))

    for measure in s["measures"]:
        mine = [
            one for one in s["estimates"] if one["measure"] == measure["name"] and at_base(one["setting"])
        ]
        rows = {one["setting"][place]: one for one in mine}
        x = [value for value in values if label(value) in rows]
        if len(x) < 2:
            continue
        x = [x[k] for k in np.unique(np.linspace(0, len(x) - 1, min(len(x), _POINTS)).astype(int))]
        y = np.array([rows[label(value)]["value"] for value in x], float)
        error = np.array([rows[label(value)]["error"] or np.nan for value in x], float)
        at = np.array(x, float)
        series = [
            Series("mean over seeds", at, y, "line+points"),
            Series("one standard error", at, y - error, "line", "muted", dashed=True),
            Series("", at, y + error, "line", "muted", dashed=True),
        ]
        unit, shown = _unit(view, measure["name"]), _shown(view, measure["name"])
        # the name of a file: that of a measure may have "=" and "/"
        name = re.sub(r"[^A-Za-z0-9_]+", "-", f"{axis['key']}-{shown}")
        yield Plot(
            name, series=tuple(series), title=measure["title"], x_label=axis["key"],
            y_label=f"{shown} ({unit})" if unit else shown, caption=TEXTS("along"),
            verticals=((float(axis["base"]), "system file"),) * (x[0] <= axis["base"] <= x[-1]),
        )  # fmt: skip


def _estimates(view: View) -> list[Any]:
    keys = [axis["key"] for axis in view.summary["axes"]]
    rows = [
        {**dict(zip(keys, one["setting"], strict=True)), "measure": _shown(view, one["measure"]),
         "mean ± error": _with_error(one), "runs": one["runs"], "effective samples": one["effective"]}
        for one in view.summary["estimates"]
    ]  # fmt: skip
    names = [*keys, "measure", "mean ± error", "runs", "effective samples"]
    return _most(rows, {name: name for name in names}, "estimates.parquet")


def _methods(view: View) -> str:
    s = view.summary
    axes = "; ".join(f"{axis['key']}: {_several([*map(label, axis['values'])])}" for axis in s["axes"])
    return TEXTS(
        "methods", name=view.name, axes=axes, seeds=len(s["seeds"]), steps=s["steps"], design=s["design"]
    )
