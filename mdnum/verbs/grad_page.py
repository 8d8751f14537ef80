"""Report page of `mdnum grad`: derivatives with their valid digits, and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.report.browse import Browse
from mdnum.report.finding import Texts, Verdict
from mdnum.report.section import ROLES, Code, Key, Page, Section, Series, Table, curves, pairs, table_of
from mdnum.report.words import count, heading, listed, many, number, pair_name, percent

if TYPE_CHECKING:
    from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("grad.py"))
#: Number of digits shown if the number of valid digits is unknown.
_UNKNOWN = 2
#: Largest number of rows of the table of flips in the report, and of parameters with a column in it.
TABLE_ROWS, _SHOWN = 2_000, 3


#: Keys of sentences on growth, by the kind of growth; for other kinds, by whether there is a rate.
_GROWN = {"forward bounded, gradient not": "growing", "forward not bounded": "unbounded"}

# -- derivatives as text -----------------------------------------------------------------------------


def by(summary: Mapping[str, Any], method: str) -> Mapping[str, Any] | None:
    """Return the stored result of a gradient method, or of the closed form."""
    if summary.get("exact") and method == summary["reference"]:
        exact = {"gradient": summary["exact"], "details": {}, "error": {}}
        return {"method": method, "description": TEXTS("exact"), **exact}
    return next((one for one in summary["methods"] if one["method"] == method), None)


def magnitude(value: Any, missing: float | None = None) -> float:
    """Return a derivative as one number: a scalar, or the norm of an array."""
    if isinstance(value, Mapping):
        value = value["norm"]
    if isinstance(value, list):
        return math.nan if None in value else sum(entry * entry for entry in value) ** 0.5
    return missing if value is None else value  # type: ignore[return-value]


def digits_of(summary: Mapping[str, Any], name: str) -> int | None:
    """Return how many digits of a derivative stay the same with half the time step. None if unknown."""
    return ((summary.get("trust") or {}).get("digits") or {}).get(name)


def digits_note(summary: Mapping[str, Any], name: str) -> str:
    """Return a note if no digits of a derivative are valid, or if their number is unknown."""
    known = digits_of(summary, name)
    if summary.get("trust") and known is None:
        return TEXTS("digits_unknown")
    return TEXTS("digits_none") if known == 0 else ""


def resolved(summary: Mapping[str, Any], name: str, value: float | None, most: int) -> str:
    """Format one entry of a derivative with its valid digits, but at most `most` digits.

    Scientific notation is used if trailing zeros could be mistaken for valid digits.
    """
    known = digits_of(summary, name)
    if known is None:
        return number(value, min(_UNKNOWN, most) if summary.get("trust") else most)
    return number(value, max(min(known, most), 1), whole=False)


def slope(summary: Mapping[str, Any], found: Mapping[str, Any] | None, name: str, most: int = 6) -> str:
    """Format a derivative with its valid digits, and with its error if known."""
    if found is None or name not in found["gradient"]:
        return "–"
    value = found["gradient"][name]
    if isinstance(value, Mapping):
        return f"norm {resolved(summary, name, value['norm'], most)}"
    if isinstance(value, list):
        return ", ".join(resolved(summary, name, entry, most) for entry in value)
    error = found["error"].get(name)
    text = resolved(summary, name, value, most)
    return f"{text} ± {number(error, 2)}" if isinstance(error, float) else text


def slope_unit(summary: Mapping[str, Any], parameter: Mapping[str, Any]) -> str:
    """Return the unit of a derivative."""
    above, below = summary["loss"]["unit"], parameter["unit"]
    if above == below:
        return ""
    if not below:
        return above
    above = f"({above})" if "/" in above else above or "1"
    compound = "/" in below and not below.startswith("√")
    return f"{above}/({below})" if compound else f"{above}/{below}"


def closeness(row: Mapping[str, Any]) -> str:
    """Format the relative difference between two derivatives as a phrase."""
    relative = row["relative"]
    if relative is None:
        return "not finite" if row["size"] else "nonzero, but the other is 0"
    if relative == 0:
        return "the same"
    return f"different by {percent(relative) if relative >= 1e-3 else number(relative, 2)}"


# -- sentences ---------------------------------------------------------------------------------------


def limit_sentence(summary: Mapping[str, Any], limit: Mapping[str, Any]) -> str:
    """Return a sentence on a limit of the number of steps with a trusted gradient."""
    code = f"{limit['what']}_{limit['code']}".replace(" ", "_")
    values = {"horizon": limit["horizon"], **limit["values"]}
    first = values.get("first")
    flips = TEXTS("flips_alike") if first is None else TEXTS("flips_differ", first=first)
    return TEXTS(code, **{**values, "flips": flips})


def judgments(summary: Mapping[str, Any]) -> dict[tuple[str, ...], Mapping[str, Any]]:
    """Group parameters whose derivatives have the same judgment. A single group has an empty key."""
    trust = summary.get("trust")
    if not trust:
        return {}
    groups: dict[tuple[Any, ...], list[str]] = {}
    # a folder that was written before derivatives were judged one by one has none of them
    for name, one in (trust.get("by") or {}).items():
        shared = (one["verdict"], one["horizon"], one["limited_by"], *one["unknown"])
        groups.setdefault(shared, []).append(name)
    if len(groups) < 2:
        return {(): trust}
    return {tuple(names): trust["by"][names[0]] for names in groups.values()}


def trust_sentence(summary: Mapping[str, Any], names: tuple[str, ...], one: Mapping[str, Any]) -> str:
    """Return a sentence on whether derivatives with respect to named parameters can be trusted."""
    free = [limit["what"] for limit in one["limits"] if limit["horizon"] is not None and not limit["reached"]]
    values = {"steps": summary["steps"], "horizon": one["horizon"], "limit": one["limited_by"]}
    text = TEXTS(f"trust_{one['verdict']}", free=", ".join(free) or "nothing", **values)
    return TEXTS("trust_by", names=listed(names), text=text) if names else text


def trust_sentences(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on whether derivatives can be trusted, up to which step, and why."""
    for names, one in judgments(summary).items():
        yield trust_sentence(summary, names, one)
        yield from (limit_sentence(summary, limit) for limit in one["limits"] if limit["reached"])
        if one["unknown"]:
            yield TEXTS("not_known", unknown=", ".join(one["unknown"]))


def growth_sentences(view: View) -> list[str]:
    """Return sentences on the growth of the gradient with respect to the state."""
    growth = view.summary.get("growth")
    if not growth:
        return []
    name = _GROWN.get(growth["word"], "steady" if growth["rate"] is not None else "short")
    if not np.any(view.table("growth")["size"] > 0):
        name = "nothing"
    return [TEXTS(f"growth_{name}", steps=view.summary["steps"], unit=view.units.time, **growth)]


# -- the page ----------------------------------------------------------------------------------------


def page(view: View, verdict: Verdict) -> Page:
    """Return the report page of a gradient."""
    summary, loss = view.summary, view.summary["loss"]
    size = many(summary["atoms"], "atom") if "atoms" in summary else many(summary["balls"], "ball")
    about = TEXTS(
        "about", loss=heading(loss["about"]), size=size, steps=summary["steps"],
        timestep=summary["timestep"], unit=view.units.time,
    )  # fmt: skip
    return view.page(f"{view.name}: gradient of {loss['word']}", about, _keys(view), [
        Section("By method", list(_methods(view)), terminal=True),
        Section("Against the horizon", list(_horizons(view)), terminal=True),
        Section("How far it is trusted", list(_trust(view)), terminal=True),
        Section("Flips on the way", list(_flips(view))),
        Section("How changes stretch", list(_spectrum(view))),
        Section("Nearest values with other decisions", list(_edges(view))),
        Section("In a narrow format", list(_scaling(view))),
        Section("Left out", list(_left_out(view)), terminal=True),
        Section("What was differentiated", list(_what(view))),
    ])  # fmt: skip


def _keys(view: View) -> Iterator[Key]:
    summary = view.summary
    reference = by(summary, summary["reference"])
    yield Key(summary["loss"]["word"], number(summary["value"], 4), summary["loss"]["unit"])
    for one in summary["parameters"][:4]:
        note = [slope_unit(summary, one), digits_note(summary, one["name"])]
        value = slope(summary, reference, one["name"], 4)
        yield Key(f"by {one['name']}", value, ", ".join(filter(None, note)))
    details = (reference or {"details": {}})["details"]
    if "crossings" in details:
        yield Key("flips on the way", count(details["crossings"]), f"{count(details['grazing'])} grazing")


def _methods(view: View) -> Iterator[Any]:
    """Yield tables of the derivatives by each method."""
    summary, reference = view.summary, view.summary["reference"]
    rows = sorted(summary["methods"], key=lambda one: one["method"] != reference)
    exact = by(summary, reference)
    if summary.get("exact") and exact is not None:
        rows = [{**exact, "method": "closed form"}, *rows]
    half = (summary.get("trust") or {}).get("half")
    if half:
        shorter = {"method": "at half the time step", "gradient": half, "error": {}}
        rows = [part for one in rows for part in ([one, shorter] if one["method"] == reference else [one])]
    differences = {(row["method"], row["name"]): row for row in summary["comparisons"]}

    def difference(one: Mapping[str, Any], name: str) -> str:
        row = differences.get((one["method"], name))
        if row is None:
            return digits_note(summary, name) if one["method"] == reference else ""
        return ", ".join(filter(None, (closeness(row), row["meaning"])))

    heads, cells = ["method"], [[one["method"]] for one in rows]
    for parameter in summary["parameters"]:
        name, unit = parameter["name"], slope_unit(summary, parameter)
        entries = ", ".join(parameter.get("entries") or ())
        head = f"by {name}" + (f" ({unit})" if unit else "") + (f": {entries}" if entries else "")
        heads += [head, f"from {reference}"]
        for one, line in zip(rows, cells, strict=True):
            line += [slope(summary, one, name), difference(one, name)]
    yield Table(tuple(heads), cells, shown=100)
    for one in rows:
        for name, note in one.get("notes", {}).items():
            yield f"{one['method']} by {name}: {note}."
    described = [one for one in rows if "description" in one]
    yield table_of(described, {"method": "method", "derivative": "description"}, "What each gives")
    meanings = dict.fromkeys(row["meaning"] for row in summary["comparisons"] if row["meaning"])
    if meanings:
        rows = [[word, TEXTS(f"means_{word}".replace(" ", "_"))] for word in meanings]
        yield Table(("difference", "because"), rows, "What the differences mean")


def _horizons(view: View) -> Iterator[Any]:
    summary, growth = view.summary, view.summary.get("growth")
    if not growth:
        return
    yield from growth_sentences(view)
    table, unit = view.table("growth"), summary["loss"]["unit"]
    verticals, horizon, size = tuple(_limits(view)), table["horizon"], table["size"]
    lines = {}
    for one in summary["parameters"]:
        head = f"gradient.{one['name']}"
        parts = [values for key, values in table.items() if key == head or key.startswith(f"{head}.")]
        if parts and one["value"] is not None:
            lines[one["name"]] = np.sqrt(np.sum(np.square(parts), axis=0)) * abs(magnitude(one["value"]))
    # of no steps at all there is no derivative
    series = curves(horizon[1:], {name: values[1:] for name, values in lines.items()})
    if series:
        in_unit = f" ({unit})" if unit else ""
        yield TEXTS.plot("growth", series, verticals, loss=summary["loss"]["word"], in_unit=in_unit)
    if np.any(size > 0):
        series = [Series("by all positions and velocities", horizon, size)]
        rate = growth["rate"]
        if rate and _GROWN.get(growth["word"]) == "growing":
            half = len(horizon) // 2
            fitted = np.exp(np.mean(np.log(size[half:])) + rate * (horizon - np.mean(horizon[half:])))
            shown = np.where(fitted >= size[size > 0].min(), fitted, np.nan)
            text = f"a factor e in {number(1 / rate)} steps"
            series.append(Series(text, horizon, shown, role="bad", dashed=True))
        yield TEXTS.plot("state", series, verticals, unit=f"{unit or '1'}/{view.units.length}")


def _limits(view: View) -> Iterator[tuple[float, str]]:
    """Yield the step from which a derivative cannot be trusted, and the reason."""
    for names, one in judgments(view.summary).items():
        if one["limited_by"]:
            yield one["horizon"], ", ".join([f"limit: {one['limited_by']}", *names])


def _trust(view: View) -> Iterator[Any]:
    trust = view.summary.get("trust")
    if not trust:
        return

    def until(one: Mapping[str, Any]) -> str:
        return "not examined" if one["horizon"] is None else "up to step" if one["reached"] else "not by step"

    for names, judged in judgments(view.summary).items():
        yield trust_sentence(view.summary, names, judged)
        yield table_of(judged["limits"], {
            "limit": "what", "": until, "step": "horizon",
            "what was seen": lambda one: limit_sentence(view.summary, one),
        })  # fmt: skip
    near, unit = (trust.get("near") or {}).get("heaviest"), view.units.length
    if near:
        yield TEXTS("near_table")
        yield table_of([one | {f"by {name}": term for name, term in one["term"].items()} for one in near], {
            "pair": pair_name, "before step": "step", f"gap ({unit})": "gap",
            f"reach ({unit})": "reach", **{f"by {name}": f"by {name}" for name in near[0]["term"]},
        }, "Pairs that nearly flipped, or nearly did not")  # fmt: skip
    table = view.table("trust")
    words = (("relative", "other rounding"), ("step", "half the step"), ("error", "standard error / mean"))
    series = tuple(
        Series(
            f"{word}, {one['name']}", table["horizon"], table[f"{key}.{one['name']}"], role=role,
            dashed=key == "error", mark="line" if key == "step" else "line+points",
        )
        for key, word in words
        for role, one in zip(ROLES, view.summary["parameters"], strict=False)
        if f"{key}.{one['name']}" in table
    )  # fmt: skip
    if series:
        yield TEXTS.plot("trust", series, _limits(view), [(trust["tolerance"], "tolerance")])


def _flips(view: View) -> Iterator[Any]:
    summary, found = view.summary, view.summary.get("flips")
    if not found:
        return
    yield TEXTS("flips_all" if found["flips"] else "flips_none", **found)
    if not found["flips"]:
        return
    units = {one["name"]: slope_unit(summary, one) for one in summary["parameters"]}
    rows = []
    for name, parts in found["share"].items():
        parameter = name.partition("[")[0]
        # of a derivative without a digit a share is none
        none = digits_of(summary, parameter) == 0
        shares = [None if none or part is None else f"{number(100 * part, 3, signed=True)} %"
                  for part in parts.values()]  # fmt: skip
        total = f"{resolved(summary, parameter, found['total'][name], 4)} {units.get(parameter, '')}".rstrip()
        rows.append([name, *shares, total, found["half"][name]])
    columns = ("share of the derivative by", "between the flips", "pairs that enter", "pairs that leave",
               "in all", "flips with half the weight")  # fmt: skip
    yield Table(columns, rows)
    table = view.table("flip_contributions")
    added = {name: table[f"contribution.{name}"] / abs(total) for name, total in found["total"].items()
             if total and np.any(table[f"contribution.{name}"])}  # fmt: skip
    if added:
        order = np.argsort(table["step"], kind="stable")
        running = {name: np.cumsum(values[order]) for name, values in added.items()}
        series = curves(table["step"][order], running, log=False)
        yield TEXTS.plot("running", series, horizontals=[(0.0, "")])
        ranked = {name: np.sort(np.abs(values))[::-1] for name, values in added.items()}
        yield TEXTS.plot("ranked", curves(np.arange(1, len(order) + 1), ranked))
    yield TEXTS("by_weight", shown=min(found["flips"], TABLE_ROWS), flips=found["flips"])
    yield _browse({name: values[:TABLE_ROWS] for name, values in table.items()})


def _browse(table: Mapping[str, np.ndarray]) -> Browse:
    """Return a searchable table of the flips that contribute most to the gradient."""
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = {**table, "ratio": np.abs(table["margin"]) / table["bound"]}
    rows["rank"] = np.arange(1, len(rows["ratio"]) + 1)
    added = [name for name in table if name.startswith("contribution.")][:_SHOWN]
    names = {
        f"name_{k}": name.removeprefix("contribution.").partition(".")[2] for k, name in enumerate(added)
    }
    return TEXTS.browse("flips", rows | {f"added_{k}": table[name] for k, name in enumerate(added)}, **names)


def _spectrum(view: View) -> Iterator[Any]:
    found = view.summary.get("spectrum")
    if not found:
        return
    unit, largest = view.units.time, found["log_singular"][0]
    factor = f"{math.exp(largest):.3g}" if largest < 600 else f"10^{largest / math.log(10):.4g}"
    yield TEXTS("spectrum", factor=factor, exponent=found["exponents_time"][0], unit=unit, **found)
    curve = np.array(found["curve"], float)
    lines = {f"direction {k + 1}": curve[:, k] for k in range(curve.shape[1])}
    yield TEXTS.plot("spectrum", curves(np.array(found["horizon"]), lines, log=False))
    rows = zip(found["log_singular"], found["exponents_time"], found["residual"], strict=True)
    columns = ("", "logarithm of the singular value", f"exponent per {unit}", "residual")
    yield Table(columns, [[k, *row] for k, row in enumerate(rows, 1)])


def _edges(view: View) -> Iterator[Any]:
    rows: list[list[Any]] = []
    for one in (view.summary.get("edges") or {}).values():
        for side in (one["below"], one["above"]):
            rows.append([one["name"], side["side"], "none within reach", *[None] * 4])
            if side["found"]:
                decision = f"pair {pair_name(side)} at step {count(side['step'])}"
                slopes = [resolved(view.summary, one["name"], side[f"gradient_{where}"].get("event-aware"), 6)
                          for where in ("inside", "beyond")]  # fmt: skip
                rows[-1][2:] = [repr(side["inside"]), repr(side["beyond"]), decision, *slopes]
    if rows:
        yield TEXTS("edges")
        yield Table(("parameter", "side", "same decisions up to", "other from", "first decision", "gradient",
                     "beyond"), rows)  # fmt: skip


def _scaling(view: View) -> Iterator[Any]:
    found = view.summary.get("scaling")
    if not found:
        return
    table = view.table("scaling")
    word = "fits" if found["fits"] else "spans" if found["usable"] else "nothing"
    lost = {name: int(np.count_nonzero(table[name])) for name in ("overflow", "underflow")}
    yield TEXTS(f"scaling_{word}", **{**found, **lost})
    sizes = {name: table[name] for name in ("largest", "smallest")}
    series = curves(table["horizon"], sizes)
    if any(lost.values()):
        values = (table["overflow"] + table["underflow"]).astype(float)
        series += (Series(f"lost in {found['format']}", table["horizon"], values, role="bad"),)
    yield TEXTS.plot("scaling", series, format=found["format"])


def _left_out(view: View) -> Iterator[Any]:
    left = [one for one in view.summary["left_out"] if one["how"]]
    never: dict[str, list[str]] = {}
    for one in view.summary["left_out"]:
        if not one["how"]:
            never.setdefault(one["why"], []).append(one["what"])
    if left:
        yield table_of(left, {"what": "what", "it is": "why", "to have it": "how"})
    if never:
        lines = (f"{', '.join(names)}: {why}" for why, names in never.items())
        yield Code("What does not apply", "\n".join(lines))


def _what(view: View) -> Iterator[Any]:
    summary, loss = view.summary, view.summary["loss"]
    unit = f" ({loss['unit']})" if loss["unit"] else ""
    rows = [("System", summary["about"]), ("Loss", f"{loss['about']}{unit}")]
    for one in summary["parameters"]:
        value = one["value"]
        if isinstance(value, Mapping):
            rows.append((heading(one["name"]), " × ".join(f"{n:,}" for n in value["shape"]) + " numbers"))
        elif value is not None:
            text = ", ".join(map(repr, value)) if isinstance(value, list) else repr(value)
            unit = "" if one["unit"].startswith("[") else one["unit"]
            rows.append((heading(one["name"]), f"{text} {unit}".rstrip()))
    yield pairs([*rows, view.took])
