"""Findings, sections and figures on flips, made from the output folder alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mdnum.report.browse import Browse
from mdnum.report.finding import Finding, Verdict, conclude
from mdnum.report.section import Page, Plot, Region, Section, Series, Table, curves, pairs, table_of
from mdnum.report.words import count, listed, many, number, percent, plain
from mdnum.verbs import flips_loop
from mdnum.verbs.flips_shared import TEXTS, FlipsView, average, in_python, repeating, resolution

#: Largest number of residues in a map of contacts.
SHOWN = 300
#: Share of flips that are undecided, missed or spurious because of the file, above which a warning is given.
UNDECIDED = 0.02
#: The same share for flips lost between frames, and for flips that are reversed immediately.
LOST, CHATTER = 0.10, 0.15
#: Share of contacts whose beginning or end is not in the file above which this is reported.
CENSORED = 0.5
#: Smallest number of flips for which shares are given.
FEW = 20
# shares of flips hidden and made up that are not worth a number
_HARDLY = 1e-3
# rules with evidence, and with figures of their own; rows of a table; frames from which on flips are averaged
_TOLD, _DRAWN, _ROWS, _DENSE = 3, 4, 15, 400
# frames that do not follow others and are named
_SEAMS = 4
_ORDER = ("error", "warning", "info")

Rule = Mapping[str, Any]
Limit = tuple[str, tuple[str, ...], dict[str, Any]]


# ---- findings


def judge(view: FlipsView) -> Verdict:
    """Return the headline, evidence and findings on the flips of a trajectory."""
    if view.summary["status"] == "unfinished":
        return flips_loop.unfinished(view)
    told = (view.summary.get(name) for name in ("lists", "energy"))
    found = [*_ended(view), *flips_loop.findings(view, *told), *_of_rules(view), *_others(view)]
    if "lists" in view.summary:
        # options of the command are none of a loop's
        found = [replace(one, remedy=one.remedy * (in_python(one.remedy) == one.remedy)) for one in found]
    elif view.summary.get("in_memory"):
        found = [replace(one, remedy=in_python(one.remedy)) for one in found]
    quiet = all(one.severity == "info" for one in found)
    return conclude(found, _evidence(view), headline=_headline(view), best="good" if quiet else "info")


def _headline(view: FlipsView) -> str:
    summary, every = view.summary, view.summary["rules"]
    if summary["frames"] < 2:
        return TEXTS("one_frame", pairs=every[0]["pairs_first"], rule=view.rule(every[0]))
    one = next((one for one in every if one["flips"]), None)
    if one is None:
        code = "no_flips" if any(one["pairs_most"] for one in every) else "no_contact"
        return TEXTS(code, frames=summary["frames"], rule=view.rule(every[0]))
    frames, rule = summary["frames"], view.rule(one)
    values = {"pairs": one["pairs_flipped"], **{name: one[name] for name in ("flips", "entered", "left")}}
    parts = [TEXTS("flips_residue" if view.by_residue else "flips", **values, frames=frames, rule=rule)]
    if one["flips"] >= FEW:
        between = one["stride"]["between"]
        if between and (between["lost"] or 0.0) > LOST:
            low, high = (1 / (1 - between[name]) for name in ("low", "high"))
            parts.append(TEXTS("lost_between", low=low, high=high))
        if one["ambiguous"] > UNDECIDED * one["flips"]:
            parts.append(TEXTS("undecided", share=one["ambiguous"] / one["flips"]))
    return " ".join(parts)


def _evidence(view: FlipsView) -> Iterator[str]:
    yield resolution(view.summary["resolution"], view.unit)
    if view.by_residue:
        kind = "heavy atoms" if "hydrogens" in view.summary["left_out"] else "atoms"
        yield TEXTS("by_residue", kind=kind, without=_left_out(view.summary) or "none")
    if (lists := view.summary.get("lists")) and not lists["lost"]:
        yield TEXTS("none_lost", **lists)
    for place, one in enumerate(view.summary["rules"][:_TOLD]):
        if view.summary["frames"] > 1 and not len(_disagreeing(view, place)):
            yield TEXTS("algebra", **{**one, "rule": view.rule(one)})
        life = one["lifetime"]
        if life["followed"] and life["leaves"]:
            values = {"median": view.life(one), "mean": view.life(one, "mean_by_rate")}
            yield TEXTS("life", rule=view.rule(one), **values)


def _left_out(summary: Mapping[str, Any]) -> str:
    """Return the numbers of atoms that are excluded from contacts of residues, or an empty text."""
    kinds = summary.get("left_out", {}).items()
    return listed([many(count, kind.removesuffix("s")) for kind, count in kinds]) if kinds else ""


def _ended(view: FlipsView) -> Iterator[Finding]:
    summary = view.summary
    values = {"last": int(view.table("frames")["number"][-1]), "frames": summary["frames"]}
    if summary["stopped"]:
        cut = ["cut"] * summary["cut_short"]
        yield TEXTS.finding("STOPPED", *cut, error=summary["stopped"], **values)
    if summary["interrupted"]:
        ended = summary.get("ended_by")
        yield TEXTS.finding("INTERRUPTED", *["loop"] * bool(ended), **values, error=ended)


def _disagreeing(view: FlipsView, place: int) -> np.ndarray:
    """Return frames in which the number of pairs contradicts the previous number and the flips."""
    table = view.table("frames")
    rows = table["rule"] == place
    net = (table["entered"][rows] - table["left"][rows])[1:]
    return np.flatnonzero(np.diff(table["pairs"][rows]) != net)


def _of_rules(view: FlipsView) -> Iterator[Finding]:
    """Yield one finding for each finding code; its sentences cover all neighbor rules."""
    by_code: dict[str, list[Finding]] = {}
    for place, one in enumerate(view.summary["rules"]):
        for code, variants, values in _limits(view, place, one):
            section = _title(TEXTS.entries[code].get("section", ""), view, one)
            made = TEXTS.finding(code, *variants, section=section, rule=view.rule(one), **values)
            by_code.setdefault(code, []).append(made)
    for code, several in by_code.items():
        worst = min(several, key=lambda one: _ORDER.index(one.severity))
        title = worst.title if len(several) == 1 else f"{worst.title} ({worst.values['rule']})"
        why = ["why", *["why_grid"] * any(one["grid"] for one in view.summary["rules"])]
        texts = [*(one.text for one in several), *(TEXTS.entries[code].get(one, "") for one in why)]
        yield replace(worst, title=title, text=" ".join(filter(None, texts)))


def _limits(view: FlipsView, place: int, one: Rule) -> Iterator[Limit]:
    """Yield findings (code, text variants, values) on the limits of an analysis."""
    if len(wrong := _disagreeing(view, place)):
        yield "EVENT_ALGEBRA", (), {"first": int(wrong[0]) + 1, "frames": len(wrong)}
    flips, frames = one["flips"], view.summary["frames"]
    if flips:
        yield from _undecided(one)
        yield from _between(view, one)
        chatter = one["chatter"]
        if flips >= FEW and chatter["share"] >= CHATTER and not _far_apart(one):
            values = {name: chatter[name] for name in ("share", "window", "undone")}
            loose = view.life(one, of="intermittent")
            yield "CHATTER", (), {**values, "flips": flips, "life": view.life(one), "loose": loose}
    total = sum(one["contacts"].values())
    cut = total - one["contacts"]["seen"]
    if total and cut > CENSORED * total and frames > 1:
        yield "CENSORED", (), {**one["contacts"], "share": cut / total}
    if one["images"]:
        yield "IMAGES", (), {"images": one["images"]}


def _undecided(one: Rule) -> Iterator[Limit]:
    missed, invented = (one["grid"][name] if one["grid"] else 0.0 for name in ("missed", "invented"))
    share = one["ambiguous"] / one["flips"]
    # an estimate can exceed what no rounding at all can have made up
    invented = min(invented, share)
    if not one["ambiguous"] and max(missed, invented) <= UNDECIDED:
        return
    grave = one["flips"] >= FEW and max(share, missed, invented) > UNDECIDED
    variants = ["grave"] * grave
    if one["grid"]:
        variants.append("few" if max(missed, invented) < _HARDLY else "some")
    values = {"missed": missed, "invented": invented, "share": share, "near": one["near_mean"]}
    yield "UNDECIDABLE", tuple(variants), {**values, "ambiguous": one["ambiguous"], "flips": one["flips"]}


def _far_apart(one: Rule) -> bool:
    """True if frames are too far apart: the median contact lasts one frame."""
    return one["flips"] >= FEW and one["lifetime"]["median"] == 1


def _between(view: FlipsView, one: Rule) -> Iterator[Limit]:
    between = one["stride"]["between"]
    if _far_apart(one):
        yield "FRAMES_FAR_APART", (), {"interval": view.duration(1), "stays": one["stays_over"]}
    elif one["flips"] < FEW or between is None:
        return
    elif between["lost"] is None:
        reason = TEXTS(f"stride_{between['reason']}", **between)
        minor = () if between["doubled"] > LOST else ("minor",)
        values = {"lost": None, "low": None, "high": None, "reason": reason}
        yield "BETWEEN_FRAMES", ("unknown", *minor), {**values, "seen": TEXTS("stride_seen", **between)}
    elif between["lost"] > LOST:
        yield "BETWEEN_FRAMES", (), {**between, "seen": TEXTS("stride_seen", **between)}


def _others(view: FlipsView) -> Iterator[Finding]:
    summary, leaps = view.summary, view.summary["leaps"]
    # older folders have none of these
    if (other := summary.get("alternative_box")) is not None:
        counts = [
            {"rule": view.rule(one), "ours": one["pairs_first"], "theirs": pairs}
            for one, pairs in zip(summary["rules"], other["pairs"], strict=True)
        ]
        same = ["same"] * all(one["ours"] == one["theirs"] for one in counts)
        values = {"ours": view.box(summary["box"]), "box": view.box(other["box"]), "frame": other["frame"]}
        told = "; ".join(TEXTS("box_pairs", **one) for one in counts)
        yield TEXTS.finding(other["code"], *same, pairs=told, **values)
    yield from view.repeated(summary.get("repeats"))
    if across := summary.get("unwrapping"):
        if seams := across["seams"]:
            kinds = ["moved" if one["moved"] else "wrapped" for one in seams[:_SEAMS]]
            told = [TEXTS(f"seam_{kind}", **one) for kind, one in zip(kinds, seams, strict=False)]
            yield TEXTS.finding("RESTART_SEAM", seams=len(seams), places="; ".join(told))
        if across["not_whole"]:
            yield TEXTS.finding("JUMPS_NOT_WHOLE", **across)
    if summary.get("retyped"):
        yield TEXTS.finding("TYPES_CHANGE", **dict(zip(("frame", "atom"), summary["retyped"], strict=True)))
    if leaps:
        others = leaps["frames"] - 1
        values = {"frame": leaps["frame"], "atom": leaps["atom"], "distance": view.length(leaps["distance"])}
        yield TEXTS.finding("LEAP", *(["others"] * bool(others)), others=others, **values)
    if (flight := summary["flight"]) is not None:
        factor, lower = flight["factor"], flight["at_least"]
        units = () if lower else TEXTS.entries["odd_units"].items()
        known = [word for word, one in units if abs(factor / one - 1) < 0.05]
        code = "at_least" if lower else "large" if factor > 1 else "small"
        values = {"factor": factor, "inverse": 1 / factor, "units": " or ".join(known)}
        yield TEXTS.finding("VELOCITIES_ODD", code, *["known"] * bool(known), **values)
    if summary["frames"] > 1:
        if not summary["has_times"]:
            yield TEXTS.finding("NO_TIMES")
        elif summary["absurd"]:
            swapped = summary["swapped"]
            values = {"interval": view.time(number(summary["interval"])), "swapped": swapped}
            yield TEXTS.finding("TIMES_ODD", *["swapped"] * bool(swapped), **values)
        elif summary["backward"]:
            yield _time_goes_back(view)
        elif missing := summary.get("missing"):
            told = [
                TEXTS("missing_at", **one | {"time": view.time(plain(one["time"], 9))})
                for one in missing["places"]
            ]
            rest = missing["gaps"] - len(told)
            values: dict[str, Any] = {
                "places": listed(told),
                "more": f", and {many(rest, 'other gap')}" if rest else "",
            }
            usual = view.time(plain(missing["usual"], 6))
            yield TEXTS.finding("MISSING_FRAMES", frames=missing["frames"], usual=usual, **values)
        elif not summary["even"]:
            yield TEXTS.finding("UNEVEN_FRAMES", interval=view.duration(1))
    axes = repeating(summary["box"])
    more = ["partial"] * (0 < len(axes) < 3) + ["free"] * (not axes)
    if summary["notes"] or more:
        yield TEXTS.finding("READING", *more, notes=" ".join(summary["notes"]), axes=", ".join(axes))
    if any(one["min_margin"] == 0 for one in summary["rules"]):
        yield TEXTS.finding("TIE", margin=view.length(0.0))


def _time_goes_back(view: FlipsView) -> Finding:
    """Return a finding on frames at which the time decreases or repeats."""
    rows = view.table("frames")
    numbers, times = (rows[name][rows["rule"] == 0] for name in ("number", "time"))
    told = view.again(view.summary["repeats"].get("again", ()))
    for at in np.flatnonzero(np.diff(times) <= 0)[:_ROWS] if not told else ():
        before, now = plain(float(times[at]), 9), view.time(plain(float(times[at + 1]), 9))
        told.append(TEXTS("back_at", number=int(numbers[at + 1]), before=before, now=now))
    return TEXTS.finding("TIME_GOES_BACK", frames=view.summary["backward"], places=listed(told))


# ---- sections


def _title(title: str, view: FlipsView, one: Rule) -> str:
    """Return the title of a section. The title names the rule if the analysis has several rules."""
    return f"{title}, {view.rule(one)}" if len(view.summary["rules"]) > 1 else title


def page(view: FlipsView, verdict: Verdict) -> Page:
    """Return the report page on the flips of a trajectory."""
    summary = view.summary
    size = many(summary["atoms"], "atom")
    if summary["status"] == "unfinished":
        return view.page(f"{view.name}: neighbor-set flips", size, [], [])
    size += f" ({excluded} excluded)" if (excluded := _left_out(summary)) else ""
    size += f", {many(summary['frames'], 'frame')}"
    if view.timed:
        size += f" {view.time(plain(summary['interval']))} apart"
    sections = [Section("Rules", [_rules(view)], terminal=True), *flips_loop.sections(view)]
    for place, one in enumerate(summary["rules"]):
        sections += _rule_sections(view, place, one)
    if across := summary.get("unwrapping"):
        sections.append(_across(view, across))
    if (browsed := _busiest(view)) is not None:
        sections.append(Section("The busiest pairs", [browsed]))
    files = [TEXTS("files"), *([TEXTS("files_residue")] if view.by_residue else [])]
    sections.append(Section("What was read", [pairs(_input(view, size)), *files]))
    about = f"{size}; {summary['format']}, read by {summary['reader']}"
    one = summary["rules"][0]
    keys = TEXTS.keys(**{
        **one, "inside": average(one["pairs_mean"]), "rule": view.rule(one), "median": view.life(one),
        "share": one["ambiguous"] / one["flips"] if one["flips"] else None,
        "rate": view.rate(one["flips_per_frame"]), "mean": view.life(one, "mean_by_rate"),
    })  # fmt: skip
    return view.page(f"{view.name}: neighbor-set flips", about, keys, sections)


def _input(view: FlipsView, size: str) -> list[tuple[str, str]]:
    summary = view.summary
    values = {
        "frames": summary["slice"] or None, "box": view.box(summary["box"]), "size": size,
        "first": None if summary["frames"] < 2 else "the first frame", "between": view.between,
        "resolution": resolution(summary["resolution"], view.unit),
        "seconds": summary["seconds"],
    }  # fmt: skip
    return TEXTS.rows("input", **{**summary, **values})


def _across(view: FlipsView, across: Mapping[str, Any]) -> Section:
    """Return a section on jumps of atoms across cell faces, and on diffusion."""
    diffusion, time = across["diffusion"] or {}, view.summary["time"]
    values = {"raw": None, "undone": None, "error": None, **across, **diffusion}
    values["too_far"] = TEXTS("too_far") if across["too_far"] else None
    values["off"] = across["off"] if across["split"] else None
    parts: list[Any] = [pairs(TEXTS.rows("across", unit=f"{view.unit}²/{time}", **values))]
    if not across["too_far"]:
        rows = view.table("motion")
        label, x = view.axis(rows)
        lines = {"jumps undone": rows["undone"], "as in the file": rows["raw"]}
        parts.append(TEXTS.plot("across", curves(x, lines, log=False), along=label, unit=view.unit))
    return Section("Across the box", parts)


def _rules(view: FlipsView) -> Table:
    return table_of(view.summary["rules"], {
        "rule": view.rule,
        "pairs inside": lambda one: f"{count(one['pairs_least'])} to {count(one['pairs_most'])}",
        "flips": "flips", "per frame": "flips_per_frame", "undecidable": "ambiguous",
        "median life": view.life, "mean life by rate": lambda one: view.life(one, "mean_by_rate"),
        "chatter": lambda one: percent(one["chatter"]["share"]),
    })  # fmt: skip


def _rule_sections(view: FlipsView, place: int, one: Rule) -> Iterator[Section]:
    plots: dict[str, list[Plot]] = {}
    for title, plot in _plots(view, place, one) if place < _DRAWN else ():
        plots.setdefault(title, []).append(plot)

    def section(title: str, *parts: Any, level: Any = 3, terminal: bool = False) -> Section:
        parts = (*parts, *plots.get(title, []))
        return Section(_title(title, view, one), list(parts), level=level, terminal=terminal)

    yield section("Pairs and flips", pairs(_numbers(view, one)), level=2)
    if view.by_residue and (lasting := _lasting(view, place)) is not None:
        total = int((view.table("occupancy")["rule"] == place).sum())
        text = TEXTS("lasting", pairs=total, rule=view.rule(one))
        yield section("Contacts between residues", text, lasting, terminal=True)
    yield section("How long contacts last", pairs(_lifetimes(view, one)))
    lost = list(_lost(view, one))
    yield section("Between the frames", *([pairs(lost)] if lost else []))
    tables = [_classes(view, "residues by name" if view.by_residue else "species", one["by_species"])]
    if one["by_residue_name"]:
        tables.append(_classes(view, "residues by name", one["by_residue_name"]))
    if len(rows := np.flatnonzero(view.table("residues")["rule"] == place)[:_ROWS]):
        table = view.table("residues")
        told = [(str(table["residue"][k]), int(table["between"][k]), int(table["within"][k])) for k in rows]
        heads, kept = ("residue", "flips with others", "within itself"), 2 if view.by_residue else 3
        tables.append(Table(heads[:kept], [row[:kept] for row in told]))
    yield section("Who flips", *tables)
    if "Neighbors" in plots:
        yield section("Neighbors")


def _numbers(view: FlipsView, one: Rule) -> list[tuple[str, str]]:
    closest, around = one["min_margin"], one["neighbors"]
    values = {
        **one, **around, **one["chatter"], "per_frame": number(one["flips_per_frame"], 4),
        "neighbors": average(around["mean"]), "mean": average(one["pairs_mean"]),
        "closest": None if closest is None else view.length(closest),
        "of": view.one,
    }  # fmt: skip
    return TEXTS.rows("numbers", **values)


def _lifetimes(view: FlipsView, one: Rule) -> list[tuple[str, str]]:
    life, begun = one["lifetime"], one["lifetime"]["followed"]

    def shown(known: Any, name: str = "median", of: str = "lifetime") -> str | None:
        return view.life(one, name, of) if begun and known else None

    return TEXTS.rows(
        "lifetimes", **one["contacts"], window=one["chatter"]["window"],
        median=shown(True), mean=shown(life["mean"] is not None, "mean"),
        quarter=shown(life["quarter_gone"] is not None, "quarter_gone"),
        three_quarters=view.life(one, "three_quarters_gone"),
        by_rate=shown(life["leaves"], "mean_by_rate"), error=view.duration(life["mean_by_rate_error"], 2),
        loose=shown(True, of="intermittent"),
        loose_by_rate=shown(one["intermittent"]["leaves"], "mean_by_rate", "intermittent"),
    )  # fmt: skip


def _lost(view: FlipsView, one: Rule) -> Iterator[tuple[str, str]]:
    between, flux = one["stride"]["between"], one["flux"]
    if between is not None:
        none, lost = between["reason"] == "none_lost", between["lost"]
        yield "By leaving frames out", TEXTS("stride_none_lost" if none else "stride_seen", **between)
        how = between["reason"] if lost is None else "range" if between["low"] else "below"
        yield "Lost between frames", TEXTS(f"stride_{how}", **between)
        for name, (odds, _) in between["parts"].items():
            yield TEXTS(f"part_{name}"), percent(1 / (1 + math.exp(-odds)))
    if flux is not None and flux["crossed"]:
        per = f"per {view.summary['time']}"
        yield "Crossings by velocities", f"{number(flux['rate'])} ± {number(flux['error'], 2)} {per}"
        yield "Crossings in the file", f"{number(flux['seen'])} {per}"


def _classes(view: FlipsView, title: str, rows: list[Mapping[str, Any]]) -> Table:
    frames = view.summary["frames"]
    return table_of(rows[:_ROWS], {
        title: lambda one: f"{one['first']}–{one['second']}",
        "pairs inside": lambda one: one["inside"] / frames,
        "flips": lambda one: one["entered"] + one["left"],
        "rate": lambda one: view.rate((one["entered"] + one["left"]) / (frames - 1) if frames > 1 else None),
        "mean stay by rate": lambda one: view.duration(one["stay"], beyond="–"),
    })  # fmt: skip


def _busiest(view: FlipsView) -> Browse | None:
    """Return the pairs with the most flips. None if no pair flipped."""
    table, rules = view.table("busiest"), view.summary["rules"]
    if not len(table["i"]):
        return None
    words = np.array([f"{a} – {b}" for a, b in zip(table["first"], table["second"], strict=True)], object)
    ranks = np.concatenate([np.arange(1, n + 1) for n in np.unique(table["rule"], return_counts=True)[1]])
    rows = {**table, "place": ranks, "of": words, "share": table["inside"] / view.summary["frames"]}
    rows |= {"rank": table["rank"] if table["rank"].any() else None}
    rows |= {"rule": table["rule"] if len(rules) > 1 else None}
    return TEXTS.browse("busiest", rows, {"rule": [one["rule"] for one in rules]})


# ---- figures


def _plots(view: FlipsView, place: int, one: Rule) -> Iterator[tuple[str, Plot]]:
    """Yield the figures of a neighbor rule with section titles. Empty figures are omitted."""

    def rows(table: str) -> dict[str, np.ndarray]:
        whole = view.table(table)
        return {name: values[whole["rule"] == place] for name, values in whole.items()}

    def plot(section: str, name: str, series: Iterable[Series], **values: Any) -> tuple[str, Plot]:
        return section, replace(TEXTS.plot(name, series, **values), name=f"rule{place}-{name}")

    frames, moving = rows("frames"), view.summary["frames"] > 1
    label, x = view.axis(frames)
    if moving:
        inside = Series("pairs inside", x, frames["pairs"].astype(float))
        yield plot("Pairs and flips", "pairs", [inside], along=label)
    if one["flips"]:
        columns = [x[1:], *(frames[name][1:].astype(float) for name in ("entered", "left", "ambiguous"))]
        width = -(-len(columns[0]) // _DENSE)
        whole = len(columns[0]) // width * width
        at, entered, left, unsure = (values[:whole].reshape(-1, width).mean(1) for values in columns)
        series = [Series("entered", at, entered), Series("left", at, left, role="second")]
        series += [Series("undecidable", at, unsure, role="bad")] * bool(unsure.any())
        mean = f", mean over {width}" if width > 1 else ""
        yield plot("Pairs and flips", "flips", series, along=label, mean=mean)
    if view.summary["frames"] > 2:
        table = rows("lifetimes")
        lags = table["frames"] * (view.summary["interval"] if view.timed else 1.0)
        shares: list[tuple[str, str, Any, bool]] = [
            ("lifetime (seen to begin)", "survival", "first", False),
            (f"gaps up to {view.summary['window']} frames ignored", "intermittent", "first", True),
            ("still inside, of those found inside", "residence", "second", False),
            ("inside again or still", "again", "second", True),
        ]
        series = [
            Series(words, lags[1:], table[name][1:], role=role, dashed=dashed)
            for words, name, role, dashed in shares
            if np.isfinite(table[name][1:]).any()
        ]
        if series:
            x_label = f"time ({view.summary['time']})" if view.timed else "frames"
            yield plot("How long contacts last", "lifetimes", series, along=x_label)
    stride = one["stride"]
    of = np.array(stride["of"], float)
    if len(of) > 2 and of.all():
        left = [Series("", np.array(stride["stride"]), np.array(stride["flips"]) / of, mark="line+points")]
        yield plot("Between the frames", "stride", left)
    if one["chatter"]["undone"]:
        after, counts = np.arange(1, one["chatter"]["window"] + 1), one["chatter"]
        back = {"left again": counts["inside"], "entered again": counts["outside"]}
        lines = {label: np.array(values[1:], float) for label, values in back.items()}
        yield plot("Between the frames", "chatter", curves(after, lines, "line+points", log=False))
    if view.by_residue:
        for name, x_names, y_names, region in _maps(view, rows("occupancy"), rows("moments"), x):
            section, made = plot("Contacts between residues", name, (), along=label)
            yield section, replace(made, region=region, x_names=x_names, y_names=y_names)
    if moving and np.any(frames["fewest"] != frames["most"]):
        around = {"mean": "neighbors", "most": "most", "fewest": "fewest"}
        lines = {label: frames[name].astype(float) for label, name in around.items()}
        yield plot("Neighbors", "neighbors", curves(x, lines, log=False), along=label, of=view.one)
    table = rows("neighbors")
    if len(table["neighbors"]) > 1:
        numbers = np.arange(table["neighbors"].min(), table["neighbors"].max() + 1)
        share = np.zeros(len(numbers))
        share[table["neighbors"] - numbers[0]] = table["counted"] / table["counted"].sum()
        distribution = [Series("", numbers, share, mark="line+points")]
        yield plot("Neighbors", "distribution", distribution, of=view.one)


def _lasting(view: FlipsView, place: int) -> Table | None:
    """Return the residue pairs whose contacts change most often. None without contacts."""
    table, frames = view.table("occupancy"), view.summary["frames"]
    rows = np.flatnonzero(table["rule"] == place)
    # those throughout are most often neighbors along a chain
    order = np.lexsort((-table["share"][rows], -(table["formed"] + table["broken"])[rows]))
    picked = [{name: values[k] for name, values in table.items()} for k in rows[order][:_ROWS]]
    return None if not picked else table_of(picked, {
        "residues": lambda one: f"{one['first']} – {one['second']}",
        "in contact": lambda one: percent(one["inside"] / frames),
        "formed": "formed", "broken": "broken",
    })  # fmt: skip


def _maps(
    view: FlipsView, pairs: Mapping[str, np.ndarray], moments: Mapping[str, np.ndarray], x: np.ndarray
) -> Iterator[tuple[str, tuple[str, ...], tuple[str, ...], Region]]:
    """Yield the contact matrix, and contacts of residues over time, with axis labels."""
    index, first = np.unique(moments["index"], return_index=True)
    if not len(index):
        return
    words = moments["residue"][first].astype(str)
    # in large systems those whose contacts change most
    changes = np.zeros(index[-1] + 1, np.int64)
    for end in "ij":
        np.add.at(changes, pairs[end], pairs["formed"] + pairs["broken"])
    kept = np.sort(np.argsort(-changes[index], kind="stable")[:SHOWN])
    place = np.full(index[-1] + 1, -1)
    place[index[kept]] = np.arange(len(kept))
    names = tuple(words[kept].tolist())
    i, j = place[pairs["i"]], place[pairs["j"]]
    both = (i >= 0) & (j >= 0)
    grades = np.zeros((len(kept), len(kept)), np.int64)
    grades[i[both], j[both]] = grades[j[both], i[both]] = np.ceil(4 * pairs["share"][both]).astype(np.int64)
    steps, at = ("never", "up to 25 % of frames", "to 50 %", "to 75 %", "more"), np.arange(len(kept))
    yield "matrix", names, names, Region(at, at, grades, steps, graded=True)
    mine = np.isin(moments["index"], index[kept])
    counts = moments["contacts"][mine].reshape(len(kept), -1)
    if counts.shape[1] < 2:
        return
    top = max(counts.max(), 1.0)
    grades = np.ceil(4 * counts / top).astype(np.int64)
    steps = ("none", *(f"up to {number(top * k / 4, 2)}" for k in range(1, 5)))
    when = x[moments["frame"][mine][: counts.shape[1]]]
    yield "moments", (), names, Region(when, at, grades, steps, graded=True)
