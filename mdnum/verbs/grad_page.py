"""What `mdnum grad` shows: derivatives by method with the digits that hold, sections and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.report.browse import Browse, Column, flipped
from mdnum.report.finding import Texts, Verdict
from mdnum.report.section import Code, Key, Page, Plot, Role, Section, Series, Table, pairs
from mdnum.report.words import MINUS, count, heading, many, number, percent, power

if TYPE_CHECKING:
    from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("grad.py"))
#: Colors of parameters, in order.
ROLES: tuple[Role, ...] = ("first", "second", "third", "ink", "muted", "bad")
#: Digits that are shown where nobody knows how many hold.
_UNKNOWN = 2
#: Rows of the table of flips that the page carries, and parameters that have a column there.
TABLE_ROWS, _SHOWN = 2_000, 3


# -- derivatives as text -----------------------------------------------------------------------------


def by(summary: Mapping[str, Any], method: str) -> Mapping[str, Any] | None:
    """What a method found; the closed form counts as one."""
    if summary.get("exact") and method == summary["reference"]:
        exact = {"gradient": summary["exact"], "details": {}, "error": {}}
        return {"method": method, "description": TEXTS("exact"), **exact}
    return next((one for one in summary["methods"] if one["method"] == method), None)


def magnitude(value: Any, missing: float | None = None) -> float:
    """A derivative as one number: itself, or the norm of several."""
    if isinstance(value, Mapping):
        value = value["norm"]
    if isinstance(value, list):
        return math.nan if None in value else sum(entry * entry for entry in value) ** 0.5
    return missing if value is None else value  # type: ignore[return-value]


def digits_of(summary: Mapping[str, Any], name: str) -> int | None:
    """Digits of a derivative that half the time step leaves; None where that was not examined."""
    return ((summary.get("trust") or {}).get("digits") or {}).get(name)


def digits_note(summary: Mapping[str, Any], name: str) -> str:
    """What must be known beside the digits of a derivative; "" where they hold, or nobody asked."""
    known = digits_of(summary, name)
    if summary.get("trust") and known is None:
        return TEXTS("digits_unknown")
    return TEXTS("digits_none") if known == 0 else ""


def resolved(summary: Mapping[str, Any], name: str, value: float | None, most: int) -> str:
    """One number of a derivative by a parameter, with the digits that hold and no more than `most`.

    In powers of ten where zeros would look like more digits.
    """
    known = digits_of(summary, name)
    if known is None:
        return number(value, min(_UNKNOWN, most) if summary.get("trust") else most)
    digits = max(min(known, most), 1)
    if value is None or not math.isfinite(value) or value == 0:
        return number(value, digits)
    mantissa, exponent = f"{abs(value):.{digits - 1}e}".split("e")
    if int(exponent) < digits:
        return number(value, digits)
    sign = MINUS if value < 0 else ""
    return f"{sign}{mantissa}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{power(int(exponent))}"


def slope(summary: Mapping[str, Any], found: Mapping[str, Any] | None, name: str, most: int = 6) -> str:
    """A derivative as text, with the digits that hold."""
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
    """The unit of a derivative."""
    above, below = summary["loss"]["unit"], parameter["unit"]
    if above == below:
        return ""
    if not below:
        return above
    above = f"({above})" if "/" in above else above or "1"
    compound = "/" in below and not below.startswith("√")
    return f"{above}/({below})" if compound else f"{above}/{below}"


def closeness(row: Mapping[str, Any]) -> str:
    """A relative difference as people put it."""
    relative = row["relative"]
    if relative is None:
        return "not finite" if row["size"] else "where the other is 0"
    if relative == 0:
        return "the same"
    return percent(relative) + " off" if relative >= 1e-3 else f"{number(relative, 2)} off"


# -- sentences ---------------------------------------------------------------------------------------


def limit_sentence(summary: Mapping[str, Any], limit: Mapping[str, Any]) -> str:
    """What was seen of one limit of trust."""
    code = f"{limit['what']}_{limit['code']}".replace(" ", "_")
    values = {"horizon": limit["horizon"], **limit["values"]}
    first = values.get("first")
    flips = TEXTS("flips_alike") if first is None else TEXTS("flips_differ", first=first)
    return TEXTS(code, **{**values, "flips": flips})


def trust_sentences(summary: Mapping[str, Any]) -> list[str]:
    """The verdict on trust, and what it is limited by."""
    trust = summary.get("trust")
    if not trust:
        return []
    verdict, limits = trust["verdict"], trust["limits"]
    free = [one["what"] for one in limits if one["horizon"] is not None and not one["reached"]]
    examined = ", ".join(free) or "nothing"
    values = {
        "steps": summary["steps"],
        "horizon": trust["horizon"],
        "limit": trust["limited_by"],
        "free": examined,
    }
    found = [TEXTS(f"trust_{verdict}", **values)]
    found += [limit_sentence(summary, one) for one in limits if one["reached"]]
    if trust["unknown"]:
        found.append(TEXTS("not_known", unknown=", ".join(trust["unknown"])))
    return found


def growth_sentences(view: View) -> list[str]:
    """How the gradient by the state grew."""
    growth = view.summary.get("growth")
    if not growth:
        return []
    if not np.any(view.table("growth")["size"] > 0):
        return [TEXTS("growth_nothing")]
    grows = growth["word"] == "forward bounded, gradient not"
    name = "growing" if grows else "unbounded" if "not bounded" in growth["word"] else "steady"
    if name == "steady" and growth["rate"] is None:
        name = "short"
    return [
        TEXTS(
            f"growth_{name}", steps=view.summary["steps"], gain=growth["gain"], rate=growth["rate"],
            error=growth["error"], time=growth["time"], unit=view.units.time,
        )
    ]  # fmt: skip


# -- the page ----------------------------------------------------------------------------------------


def page(view: View, verdict: Verdict) -> Page:
    """Everything that is known about a gradient."""
    summary = view.summary
    size = many(summary["atoms"], "atom") if "atoms" in summary else many(summary["balls"], "ball")
    about = TEXTS(
        "about", loss=heading(summary["loss"]["about"]), size=size, steps=summary["steps"],
        timestep=summary["timestep"], unit=view.units.time,
    )  # fmt: skip
    sections = [
        Section("By method", list(_methods(view)), terminal=True),
        Section("Against the horizon", list(_horizons(view)), terminal=True),
        Section("How far it is trusted", list(_trust(view)), terminal=True),
        Section("Flips on the way", list(_flips(view))),
        Section("How changes stretch", list(_spectrum(view))),
        Section("The nearest other histories", list(_edges(view))),
        Section("In a narrow format", list(_scaling(view))),
        Section("Left out", list(_left_out(view)), terminal=True),
        Section("What was differentiated", list(_what(view))),
    ]
    return Page(
        f"{view.name}: gradient of {summary['loss']['word']}", about, list(_keys(view)),
        [one for one in sections if one.parts], view.system_toml, view.folder.provenance,
    )  # fmt: skip


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
    """Derivatives by method, the reference first, each with how far it is from the reference."""
    summary, reference = view.summary, view.summary["reference"]
    heads = []
    for one in summary["parameters"]:
        unit, entries = slope_unit(summary, one), one.get("entries")
        heads.append(
            f"by {one['name']}"
            + (f" ({unit})" if unit else "")
            + (f": {', '.join(entries)}" if entries else "")
        )
    rows = sorted(summary["methods"], key=lambda one: one["method"] != reference)
    exact = by(summary, reference)
    if summary.get("exact") and exact is not None:
        rows = [{**exact, "method": "closed form"}, *rows]
    half = (summary.get("trust") or {}).get("half")
    differences = {(row["method"], row["name"]): row for row in summary["comparisons"]}
    names = [one["name"] for one in summary["parameters"]]
    cells: list[list[Any]] = []
    for one in rows:
        line: list[Any] = [one["method"]]
        for name in names:
            row = differences.get((one["method"], name))
            note = digits_note(summary, name) if one["method"] == reference else ""
            means = f", {row['meaning']}" if row and row["meaning"] else ""
            line += [slope(summary, one, name), note if row is None else f"{closeness(row)}{means}"]
        cells.append(line)
        if half and one["method"] == reference:
            shorter = {"gradient": half, "error": {}}
            cells.append(
                ["at half the time step", *(part for n in names for part in (slope(summary, shorter, n), ""))]
            )
    columns = [part for head in heads for part in (head, f"from {reference}")]
    yield Table(("method", *columns), cells, shown=100)
    for one in rows:
        for name, note in one.get("notes", {}).items():
            yield f"{one['method']} by {name}: {note}."
    yield Table(
        ("method", "derivative"), [[one["method"], one["description"]] for one in rows], "What each gives"
    )
    meanings = dict.fromkeys(row["meaning"] for row in summary["comparisons"] if row["meaning"])
    if meanings:
        rows = [[word, TEXTS(f"means_{word}".replace(" ", "_"))] for word in meanings]
        yield Table(("difference", "because"), rows, "What the differences mean")


def _horizons(view: View) -> Iterator[Any]:
    summary = view.summary
    if not summary.get("growth"):
        return
    yield from growth_sentences(view)
    table, unit = view.table("growth"), summary["loss"]["unit"]
    verticals = tuple(_limits(view))
    series = []
    for role, one in zip(ROLES, summary["parameters"], strict=False):
        name = one["name"]
        parts = [
            values
            for key, values in table.items()
            if key == f"gradient.{name}" or key.startswith(f"gradient.{name}.")
        ]
        values = np.sqrt(np.sum(np.square(parts), axis=0)) if parts else np.zeros(1)
        if values.any() and one["value"] is not None:
            # of no steps at all there is no derivative
            shown = values[1:] * abs(magnitude(one["value"]))
            series.append(Series(name, table["horizon"][1:], shown, role=role))
    if series:
        label = f"|parameter × derivative| ({unit})" if unit else "|parameter × derivative|"
        yield Plot(
            "growth", f"The gradient of {summary['loss']['word']} against the horizon", "horizon (steps)",
            label, tuple(series), y_scale="log", caption=TEXTS("caption_growth"), verticals=verticals,
        )  # fmt: skip
    size, horizon, rate = table["size"], table["horizon"], summary["growth"]["rate"]
    if np.any(size > 0):
        lines = [Series("by all positions and velocities", horizon, size)]
        if rate and summary["growth"]["word"] == "forward bounded, gradient not":
            half = len(horizon) // 2
            fitted = np.exp(np.mean(np.log(size[half:])) + rate * (horizon - np.mean(horizon[half:])))
            shown = np.where(fitted >= size[size > 0].min(), fitted, np.nan)
            lines.append(
                Series(f"a factor e in {number(1 / rate)} steps", horizon, shown, role="bad", dashed=True)
            )
        per = f"{unit or '1'}/{view.units.length}"
        yield Plot(
            "state", "The gradient by the state against the horizon", "horizon (steps)", f"norm ({per})",
            tuple(lines), y_scale="log", caption=TEXTS("caption_state"), verticals=verticals,
        )  # fmt: skip


def _limits(view: View) -> Iterator[tuple[float, str]]:
    """Where trust in the gradient ends."""
    trust = view.summary.get("trust") or {}
    if trust.get("limited_by"):
        yield trust["horizon"], f"limit: {trust['limited_by']}"


def _trust(view: View) -> Iterator[Any]:
    trust = view.summary.get("trust")
    if not trust:
        return
    yield trust_sentences(view.summary)[0]
    rows = []
    for one in trust["limits"]:
        until = (
            "not examined" if one["horizon"] is None else "up to step" if one["reached"] else "not by step"
        )
        rows.append([one["what"], until, one["horizon"], limit_sentence(view.summary, one)])
    yield Table(("limit", "", "step", "what was seen"), rows)
    near = (trust.get("near") or {}).get("heaviest")
    if near:
        yield TEXTS("near_table")
        unit = view.units.length
        columns = (
            "pair",
            "before step",
            f"gap ({unit})",
            f"reach ({unit})",
            *(f"by {name}" for name in near[0]["term"]),
        )
        rows = [
            [f"{one['i']}–{one['j']}", one["step"], one["gap"], one["reach"], *one["term"].values()]
            for one in near
        ]
        yield Table(columns, rows, "Pairs that nearly flipped, or nearly did not")
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
        yield Plot(
            "trust", "What other roundings, time steps and starts make of the gradient", "horizon (steps)",
            "relative difference", series, y_scale="log", caption=TEXTS("caption_trust"),
            verticals=tuple(_limits(view)), horizontals=((trust["tolerance"], "tolerance"),),
        )  # fmt: skip


def _flips(view: View) -> Iterator[Any]:
    found = view.summary.get("flips")
    if not found:
        return
    yield (
        TEXTS("flips_none")
        if not found["flips"]
        else TEXTS("flips_all", flips=found["flips"], grazing=found["grazing"])
    )
    if not found["flips"]:
        return
    rows = []
    for name, parts in found["share"].items():
        parameter = name.partition("[")[0]
        unit = next(
            (slope_unit(view.summary, one) for one in view.summary["parameters"] if one["name"] == parameter),
            "",
        )
        # of a derivative without a digit a share is none
        none = digits_of(view.summary, parameter) == 0
        shares = [
            None if none or part is None else f"{number(100 * part, 3, signed=True)} %"
            for part in parts.values()
        ]
        total = f"{resolved(view.summary, parameter, found['total'][name], 4)} {unit}".rstrip()
        rows.append([name, *shares, total, found["half"][name]])
    columns = (
        "share of the derivative by",
        "between the flips",
        "pairs that enter",
        "pairs that leave",
        "in all",
    )
    yield Table((*columns, "flips with half the weight"), rows)
    table = view.table("flip_contributions")
    added = {name: table[f"contribution.{name}"] for name, total in found["total"].items() if total}
    added = {name: values / abs(found["total"][name]) for name, values in added.items() if np.any(values)}
    order = np.argsort(table["step"], kind="stable")
    running = [
        Series(name, table["step"][order], np.cumsum(values[order]), role=role)
        for role, (name, values) in zip(ROLES, added.items(), strict=False)
    ]
    ranked = [
        Series(name, np.arange(1, len(values) + 1), np.sort(np.abs(values))[::-1], role=role)
        for role, (name, values) in zip(ROLES, added.items(), strict=False)
    ]
    if running:
        yield Plot(
            "running", "What the flips up to a step add", "step", "sum of contributions / |derivative|",
            tuple(running), caption=TEXTS("caption_running"), horizontals=((0.0, ""),),
        )  # fmt: skip
        yield Plot(
            "ranked", "Contributions of single flips, the largest first", "rank",
            "|contribution| / |derivative|", tuple(ranked), x_scale="log", y_scale="log",
            caption=TEXTS("caption_ranked"),
        )  # fmt: skip
    yield TEXTS("by_weight", shown=min(found["flips"], TABLE_ROWS), flips=found["flips"])
    yield _browse({name: values[:TABLE_ROWS] for name, values in table.items()})


def _browse(table: Mapping[str, np.ndarray]) -> Browse:
    """The heaviest flips."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(table["margin"]) / table["bound"]
    added = [name for name in table if name.startswith("contribution.")][:_SHOWN]
    columns = [
        Column("rank", np.arange(1, len(ratio) + 1), "count"),
        Column("step", table["step"], "count"),
        Column("pair", (table["i"], table["j"]), "pair"),
        flipped(table["entered"]),
        Column("radial speed", table["radial_speed"]),
        Column("weight", table["weight"]),
        *(
            Column(f"adds to {one.removeprefix('contribution.').rpartition('.')[2]}", table[one])
            for one in added
        ),
        Column("", table["grazing"], "word", words=("", "grazing")),
        Column("margin", ratio, "ratio", "÷ bound", digits=2),
    ]
    return Browse("flips", "flips", "3-17, atom 5, step:100..200, entered, grazing", columns)


def _spectrum(view: View) -> Iterator[Any]:
    found = view.summary.get("spectrum")
    if not found:
        return
    unit, largest = view.units.time, found["log_singular"][0]
    factor = f"{math.exp(largest):.3g}" if largest < 600 else f"10^{largest / math.log(10):.4g}"
    yield TEXTS(
        "spectrum",
        factor=factor,
        steps=found["steps"],
        exponent=found["exponents_time"][0],
        unit=unit,
        word=found["word"],
    )
    curve = np.array(found["curve"], float)
    series = tuple(
        Series(f"{k + 1}", np.array(found["horizon"]), curve[:, k], role=role)
        for k, role in zip(range(curve.shape[1]), ROLES, strict=False)
    )
    yield Plot(
        "spectrum", "How far the directions that stretch most have stretched", "step",
        "logarithm of the stretch", series, caption=TEXTS("caption_spectrum"),
    )  # fmt: skip
    rows = zip(found["log_singular"], found["exponents_time"], found["residual"], strict=True)
    columns = ("", "logarithm of the singular value", f"exponent per {unit}", "residual")
    yield Table(columns, [[k + 1, *row] for k, row in enumerate(rows)])


def _edges(view: View) -> Iterator[Any]:
    rows = []
    for one in (view.summary.get("edges") or {}).values():
        for side in (one["below"], one["above"]):
            if not side["found"]:
                rows.append([one["name"], side["side"], "none within reach", *[None] * 4])
                continue
            slopes = [
                resolved(view.summary, one["name"], side[where].get("event-aware"), 6)
                for where in ("gradient_inside", "gradient_beyond")
            ]
            decision = f"pair {side['i']}–{side['j']} at step {count(side['step'])}"
            rows.append(
                [one["name"], side["side"], repr(side["inside"]), repr(side["beyond"]), decision, *slopes]
            )
    if rows:
        yield TEXTS("edges")
        columns = (
            "parameter",
            "side",
            "as here up to",
            "otherwise from",
            "first decision",
            "gradient",
            "beyond",
        )
        yield Table(columns, rows)


def _scaling(view: View) -> Iterator[Any]:
    found = view.summary.get("scaling")
    if not found:
        return
    table = view.table("scaling")
    word = "fits" if found["fits"] else "spans" if found["usable"] else "nothing"
    yield TEXTS(
        f"scaling_{word}", format=found["format"], overflow=int(np.count_nonzero(table["overflow"])),
        underflow=int(np.count_nonzero(table["underflow"])), power=found["power"], worst=found["worst"],
    )  # fmt: skip
    series = [
        Series(name, table["horizon"], np.where(np.isfinite(table[name]), table[name], np.nan), role=role)
        for name, role in zip(("largest", "smallest"), ROLES, strict=False)
    ]
    lost = table["overflow"] + table["underflow"]
    if lost.any():
        series.append(Series(f"lost in {found['format']}", table["horizon"], lost.astype(float), role="bad"))
    yield Plot(
        "scaling", f"Numbers of the reverse pass, compared with {found['format']}", "horizon (steps)",
        "magnitude; count", tuple(series), y_scale="log", caption=TEXTS("caption_scaling"),
    )  # fmt: skip


def _left_out(view: View) -> Iterator[Any]:
    left = view.summary["left_out"]
    rows = [[one["what"], one["why"], one["how"]] for one in left if one["how"]]
    if rows:
        yield Table(("what", "it is", "to have it"), rows)
    never = [one for one in left if not one["how"]]
    if never:
        yield Code("What does not apply", "\n".join(f"{one['what']}: {one['why']}" for one in never))


def _what(view: View) -> Iterator[Any]:
    summary, loss = view.summary, view.summary["loss"]
    rows = [
        ("System", summary["about"]),
        ("Loss", f"{loss['about']} ({loss['unit']})" if loss["unit"] else loss["about"]),
    ]
    for one in summary["parameters"]:
        value = one["value"]
        if value is None:
            continue
        if isinstance(value, Mapping):
            text = " × ".join(f"{side:,}" for side in value["shape"]) + " numbers"
        else:
            text = ", ".join(map(repr, value)) if isinstance(value, list) else repr(value)
            text = text if one["unit"].startswith("[") else f"{text} {one['unit']}".rstrip()
        rows.append((heading(one["name"]), text))
    rows.append(("Time it took", f"{number(summary['seconds'])} s"))
    yield pairs(rows)
