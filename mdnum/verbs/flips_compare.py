"""`mdnum flips A B`: compare the neighbor sets of two trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError
from mdnum.report.finding import Finding, Texts, Verdict, conclude
from mdnum.report.section import Page, Plot, Section, Series, Table, pairs, table_of
from mdnum.report.words import count, many, number
from mdnum.trajectories.follow import ComparedSide, NeighborSets, follow_both, growth_of
from mdnum.trajectories.resolution import infer
from mdnum.trajectories.separation import velocities_of
from mdnum.trajectories.tracker import Tracker, atoms_of
from mdnum.verbs.flips_shared import FlipsView, HeldRows, about, ending, name_of, resolution, selected, stem
from mdnum.verbs.frame import Keep, Outcome, Verb, answering

if TYPE_CHECKING:
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.trajectory import Trajectory

TEXTS = Texts(__file__)

# frames after a flip in which a leap of the separation shows, and how much larger than any before it must be
_WINDOW, _LEAP = 10, 5.0
# rates that differ by less than this factor are alike; r² from which on a separation grows exponentially
_ALIKE, _FITS = 1.5, 0.8


def compare(
    a: Trajectory,
    b: Trajectory,
    asked: tuple[Rule, ...],
    between: tuple[str, str] | None,
    **keep: Unpack[Keep],
) -> Outcome:
    """Find the frame at which two trajectories diverge (see `mdnum.verbs.flips.flips`).

    Raises:
        InputError: the trajectories do not contain the same atoms.
    """
    if a.atoms != b.atoms:
        message = f"{a.path.name} has {a.atoms:,} atoms and {b.path.name} {b.atoms:,}"
        raise InputError(message, remedy="Compare two trajectories of the same atoms in the same order")
    groups = selected(a, between)
    samples = [one.sample() for one in (a, b)]
    resolutions = [infer(some, one.bits, one.format) for some, one in zip(samples, (a, b), strict=True)]
    moving = [[velocities_of(frame) for frame in some if frame.velocities is not None] for some in samples]
    # MDAnalysis has velocities per ps where a file has no times
    clocks = {"ps" if one.time == "frame" else one.time for one in (a, b)}
    comparable = a.length == b.length and len(clocks) == 1
    speeds = [
        infer(moving[k], one.bits) if moving[k] and comparable else None for k, one in enumerate((a, b))
    ]
    sets = [
        NeighborSets(rule, [
            ComparedSide(one, Tracker(rule, *groups, [str(word) for word in one.species]), kept, speed)
            for one, kept, speed in zip((a, b), resolutions, speeds, strict=True)
        ])
        for rule in asked
    ]  # fmt: skip
    rows = HeldRows(a)
    passes = follow_both(sets, atoms_of(groups), rows.add)
    # no folder for files whose first frames cannot be used
    found = next(passes)
    with answering("flips-compare", f"flips-{stem(a)}", **keep) as answer:
        folder, log = answer.folder, answer.log
        total = min((one.count for one in (a, b) if one.count is not None), default=0)
        interrupted = rows.drain(folder, passes, found, total, log)
        table = folder.read("apart")
        told = [
            {
                "rule": one.rule.name, "first": one.first, "certain": one.certain,
                "first_pairs": one.first_pairs, "growth": growth_of(found.frames, one, table),
            }
            for one in sets
        ]  # fmt: skip
        answer.result, answer.summary = found, {
            **about(a, "flips-compare", between),
            "other": name_of(b),
            "other_file": str(b.path),
            "other_format": b.format,
            "same_species": _alike(a, b),
            "rules": told,
            "in_file": [one.count for one in (a, b)],
            "times": [a.time, b.time],
            "timed": a.time != "frame",
            "interval": 1.0,
            "resolution": resolutions[0],
            "other_resolution": resolutions[1],
            **{name: value for name, value in vars(found).items() if name not in ("stopped", "other")},
            "repeats": [one.repeats.plain() for one in (a, b)],
            # steps, units and numbers of frames are not compared with one another
            "times_differ": found.times_differ if a.time == b.time else 0,
            **ending(found.stopped, interrupted),
        }  # fmt: skip
    return answer.outcome


def _alike(a: Trajectory, b: Trajectory) -> bool:
    """True if two files may contain the same atoms, judged by the species."""
    first, second = ([str(one) for one in file.species] for file in (a, b))
    if not (a.table.named and b.table.named) or first == second:
        return True
    # a dump numbers its types: each number stands for one species, and each species has one
    numbered = [all(one.isdigit() for one in words) for words in (first, second)]
    both = set(zip(first, second, strict=True))
    return numbered[0] != numbered[1] and len(both) == len(set(first)) == len(set(second))


# ---- findings


class ComparisonView(FlipsView):
    """Results of a comparison of two trajectories, read from its folder."""

    @property
    def certain(self) -> bool:
        """True if the trajectories differ by more than the resolution of the files."""
        certain = any(one["certain"] is not None for one in self.summary["rules"])
        return certain or any(self.summary[name] is not None for name in ("beyond", "other_box"))

    @property
    def differ(self) -> bool:
        """True if neighbor sets differ, and positions differ by more than the files' resolution."""
        return self.certain and any(one["first"] is not None for one in self.summary["rules"])

    @property
    def largest(self) -> tuple[str, str]:
        """Largest distance between an atom's positions in the two files, and a bound on rounding."""
        table = self.table("apart")
        at = int(np.argmax(table["furthest"]))
        return self.length(float(table["furthest"][at])), self.length(float(table["bound"][at]))

    def frame(self, at: int | None) -> str:
        """Format the index of a frame. Frame numbers in the files are added if they differ."""
        if at is None:
            return "no frame"
        a, b = (int(self.table("apart")[f"number_{one}"][at]) for one in "ab")
        if a == b == at:
            return f"frame {count(at)}"
        if a == b:
            return f"frame {count(at)} ({count(a)} in both files)"
        return f"frame {count(at)} ({count(a)} in A’s file, {count(b)} in B’s)"

    @property
    def shift(self) -> dict[str, Any]:
        """Displacement common to all atoms at one frame, and its range of lengths over frames."""
        table, at = self.table("apart"), self.summary["shift"]
        vectors = np.stack([table[f"shift_{one}"] for one in "xyz"], axis=1)
        sizes = np.sqrt((vectors**2).sum(axis=1))
        low, high = float(sizes[at:].min()), float(sizes.max())
        same = high - low <= 2 * float(table["bound"].max())
        vector = ", ".join(number(float(one)) for one in vectors[at])
        return {
            "first": self.frame(at), "size": self.length(float(sizes[at])), "vector": f"({vector})",
            "same": same, "low": self.length(low), "high": self.length(high),
        }  # fmt: skip

    def by_boxes(self, first: Mapping[str, Any]) -> bool:
        """True if only boxes differ when the neighbor sets first differ."""
        boxes, beyond = self.summary["other_box"], self.summary["beyond"]
        same = beyond is None or beyond > first["frame"]
        return boxes is not None and boxes["frame"] <= first["frame"] and same

    def values(self, one: Mapping[str, Any]) -> dict[str, Any]:
        """Return the results for one neighbor rule, formatted for sentences."""
        first = one["first"] or {}
        return {
            "rule": self.rule(one), "frames": self.summary["frames"], "pairs": first.get("pairs", 0),
            "first": self.frame(first.get("frame")), "certain": self.frame(one["certain"]),
            "seed": self.frame(self.summary["seed"]), "beyond": self.frame(self.summary["beyond"]),
            "furthest": self.length(first.get("furthest")),
            "before": self.length(first.get("furthest_before")),
            "last": self.length(self.summary["last"]["furthest"]),
            "largest": self.largest[0], "explained": self.largest[1],
            "sure": first.get("pairs", 0) - first.get("ambiguous", 0),
        }  # fmt: skip


def judge(view: ComparisonView) -> Verdict:
    """Return the headline, evidence and findings of a comparison of two trajectories."""
    return conclude(_findings(view), _evidence(view), headline=_headline(view))


def _headline(view: ComparisonView) -> str:
    """Return the verdict on the first neighbor rule, and a sentence on each further rule."""
    first, *others = view.summary["rules"]
    text = TEXTS(f"head_{_head(view, first)}", **view.values(first))
    if view.summary["shift"] is not None:
        shift = view.shift
        text += " " + TEXTS("shift_constant" if shift["same"] else "shift_varies", **shift)
    if view.summary["seed"] is None and not any(one["first"] for one in view.summary["rules"]):
        return text
    return " ".join([text, *(_in_short(view, one) for one in others)])


def _head(view: ComparisonView, one: Mapping[str, Any]) -> str:
    summary, first = view.summary, one["first"]
    box = "" if summary["other_box"] is None else "_box"
    if first is None:
        if summary["seed"] is None:
            return f"same{box}"
        if not view.certain:
            return "not_shown"
        return f"same_sets{box}" if summary["beyond"] is None else "positions"
    if not view.certain:
        return "not_shown_sets"
    if first["ambiguous"] == first["pairs"]:
        return "sets_never" if one["certain"] is None else "sets_unsure"
    return "sets_box" if view.by_boxes(first) else "sets"


def _in_short(view: ComparisonView, one: Mapping[str, Any]) -> str:
    return TEXTS("other_same" if one["first"] is None else "other_differ", **view.values(one))


def _evidence(view: ComparisonView) -> Iterator[str]:
    """Yield sentences on differences in positions and in neighbor sets, and on their order."""
    summary, (one, *others) = view.summary, view.summary["rules"]
    seed, beyond, first, values = summary["seed"], summary["beyond"], one["first"], view.values(one)
    if seed is not None:
        code = "explained" if beyond is None else "at_once" if beyond == seed else "later"
        yield TEXTS(f"positions_{code}", **values)
        if seed:
            yield TEXTS("positions_before")
    elif first is not None:
        yield TEXTS("positions_same")
    same = summary["velocities_same"]
    if same is not None and beyond is not None and same == beyond - 1:
        yield TEXTS("velocities_agree", frame=view.frame(same))
    if first is not None:
        yield TEXTS(f"certain_{_certain(one)}", **values)
        yield TEXTS(f"order_{_order(view, one)}", **values)
        yield from _leap(view, first)
        yield from _rates(view, one["growth"])
    elif beyond is not None:
        yield TEXTS("order_none", **values)
        yield from _rates(view, {"whole": one["growth"]["before"]})
    for other in others:
        yield _in_short(view, other)
        if other["first"] is not None:
            yield TEXTS(f"certain_{_certain(other)}", **view.values(other))


def _certain(one: Mapping[str, Any]) -> str:
    """Return when neighbor sets differ by more than rounding explains."""
    if one["first"]["pairs"] > one["first"]["ambiguous"]:
        return "some"
    return "never" if one["certain"] is None else "later"


def _order(view: ComparisonView, one: Mapping[str, Any]) -> str:
    """Return which quantity differed first: positions, boxes or neighbor sets."""
    at, beyond, certain = one["first"]["frame"], view.summary["beyond"], one["certain"]
    if beyond is not None and beyond < at:
        return "positions"
    if view.by_boxes(one["first"]):
        return "boxes"
    if not view.certain:
        return "not_shown"
    if at in (beyond, certain):
        return "together" if at else "start"
    return "unknown"


def _leap(view: ComparisonView, first: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence on whether trajectories diverge faster once neighbor sets differ."""
    table, at = view.table("apart"), int(first["frame"])
    furthest = table["furthest"]
    # a difference that has just begun grows fast, whatever began it
    start = max((view.summary["seed"] or 0) + _WINDOW, at // 2)
    # what resolution explains does not grow
    above = (furthest > table["bound"])[start:].all()
    if at + _WINDOW >= len(furthest) or start + _WINDOW > at or not above:
        return
    grown = furthest[_WINDOW:] / np.maximum(furthest[:-_WINDOW], np.finfo(float).tiny)
    after, before = float(grown[at]), float(grown[start : at - _WINDOW + 1].max())
    if after > 0:
        code = "leap" if after > _LEAP * max(before, 1.0) else "no_leap"
        yield TEXTS(code, window=_WINDOW, after=after, before=before)


def _rates(view: ComparisonView, grown: Mapping[str, Any]) -> Iterator[str]:
    rates = {}
    for name, law in grown.items():
        if law is None or law["rate"] <= 0 or max(law["r2"], law["power_r2"]) < _FITS:
            continue
        text, part = number(1 / law["rate"]), TEXTS(f"part_{name}")
        length = view.time(text) if view.summary["timed"] else f"{text} frames"
        yield TEXTS(f"growth_{law['law']}", part=part, time=length, **law)
        if law["law"] == "exponential":
            rates[name] = law["rate"]
    if len(rates) == 2:
        ratio = rates["after"] / rates["before"]
        code = "faster" if ratio > _ALIKE else "slower" if ratio < 1 / _ALIKE else "alike"
        yield TEXTS(f"growth_{code}", ratio=ratio)


def _findings(view: ComparisonView) -> Iterator[Finding]:
    summary, frames = view.summary, view.summary["frames"]
    if summary["stopped"]:
        yield TEXTS.finding("STOPPED", frames=frames, error=summary["stopped"])
    if summary["interrupted"]:
        yield TEXTS.finding("INTERRUPTED", frames=frames)
    for name, repeats in zip((view.name, summary["other"]), summary.get("repeats", ()), strict=False):
        yield from view.repeated(repeats, name)
    if summary["shift"] is not None:
        shift = view.shift
        yield TEXTS.finding("SHIFT", *["varies"] * (not shift["same"]), **shift)
    if (how := summary["velocities"]) is not None and how["frame"] != summary["beyond"]:
        yield TEXTS.finding("VELOCITIES", how["kind"], **{**how, "frame": view.frame(how["frame"])})
    unsure = [one for one in summary["rules"] if one["first"] and one["certain"] != one["first"]["frame"]]
    if unsure:
        made = []
        for one in unsure:
            variants = ["minor"] * (not view.certain) + ["never"] * (one["certain"] is None)
            made.append(TEXTS.finding("WITHIN_RESOLUTION", *variants, **view.values(one)))
        text = " ".join([*(one.text for one in made), TEXTS.entries["WITHIN_RESOLUTION"]["why"]])
        yield replace(made[0], text=text)
    boxes, beyond = summary["other_box"], summary["beyond"]
    if boxes is not None:
        # two runs at constant pressure have two boxes once they have diverged
        later = not boxes["axes"] and beyond is not None and 0 < beyond <= boxes["frame"]
        variants = ["later"] * later + ["axes"] * boxes["axes"]
        a, b = (view.box(boxes[one]) for one in "ab")
        yield TEXTS.finding("OTHER_BOX", *variants, frame=view.frame(boxes["frame"]), a=a, b=b)
    if view.differ:
        yield TEXTS.finding("NO_CAUSE_FROM_FILES")
    if not summary["same_species"]:
        yield TEXTS.finding("OTHER_SPECIES")
    if summary["times_differ"]:
        yield TEXTS.finding("OTHER_TIMES", frames=summary["times_differ"])
    if summary["times"][0] != summary["times"][1]:
        yield TEXTS.finding("NO_TIMES", a=summary["times"][0], b=summary["times"][1])
    counts = [one for one in summary["in_file"] if one is not None]
    if len(set(counts)) > 1 and summary["status"] == "complete":
        yield TEXTS.finding("OTHER_LENGTH", fewer=min(counts), more=max(counts))


# ---- page


def page(view: ComparisonView, verdict: Verdict) -> Page:
    """Return the page of a comparison of two trajectories."""
    summary = view.summary
    table = view.table("apart")
    size = f"{many(summary['atoms'], 'atom')}, {many(summary['frames'], 'frame')} of both"
    cannot = [*(["cause"] * view.differ), "between", "programs"]
    sections = [
        Section("Rules", [_rules(view), *_first_pairs(view)], terminal=True),
        Section("Separation", list(_separation(view, table))),
        Section("Pairs that differ", list(_differing(view, table))),
        Section("What two trajectories do not show", [TEXTS(f"cannot_{one}") for one in cannot]),
        Section("What was read", [pairs(_input(view, size)), TEXTS("files")]),
    ]
    one, shift = summary["rules"][0], None if summary["shift"] is None else view.shift
    first, seed, end = one["first"], summary["seed"], view.length(summary["last"]["furthest"])
    if first is not None:
        certain = "never" if one["certain"] is None else one["certain"]
        first = {**first, "certain": certain, "length": view.length(first["furthest"])}
    keys = TEXTS.keys(
        beyond=summary["beyond"], seed=None if seed is None else view.frame(seed), first=first,
        rule=view.rule(one), end=end, shift=shift,
    )  # fmt: skip
    return view.page(f"{view.name} and {summary['other']}", f"{size} compared", keys, sections)


def _rules(view: ComparisonView) -> Table:
    never = dict.fromkeys(("frame", "pairs", "ambiguous"))
    rows = [{**one, **(one["first"] or never)} for one in view.summary["rules"]]
    return table_of(rows, {
        "inside": view.rule, "sets differ from frame": "frame", "pairs then": "pairs",
        "undecidable": "ambiguous", "for certain from frame": "certain",
    })  # fmt: skip


def _first_pairs(view: ComparisonView) -> Iterator[Table]:
    unit = f" ({view.unit})" if view.unit else ""
    columns: dict[str, Any] = {
        "pair": lambda row: f"{row['i']}–{row['j']}", "inside in": lambda row: f"{row['inside']} only",
        f"r in A{unit}": lambda row: f"{row['distance_a']:.10g}",
        "r in B": lambda row: f"{row['distance_b']:.10g}",
        "margin in A": "margin_a", "margin in B": "margin_b",
    }  # fmt: skip
    for one in view.summary["rules"]:
        if one["first_pairs"]:
            title = f"{view.rule(one)}: the first pairs to differ, {view.values(one)['first']}"
            yield table_of(one["first_pairs"], columns, title)


def _plot(
    view: ComparisonView, name: str, lines: Mapping[str, tuple[np.ndarray, Any]], unit: str = ""
) -> Plot:
    """Return a figure of quantities versus time or frame number."""
    table, summary = view.table("apart"), view.summary
    timed = summary["timed"] and bool(np.all(np.diff(table["time"]) > 0))
    x = table["time"] if timed else table["frame"]
    beyond, first = summary["beyond"], summary["rules"][0]["first"]
    marks = [(float(x[beyond]), "positions differ")] if beyond else []
    marks += [(float(x[first["frame"]]), "sets differ")] if first is not None else []
    series = [Series(label, x, y, role=role, dashed=role == "muted") for label, (y, role) in lines.items()]
    along = f"time ({summary['time']})" if timed else "frame"
    return TEXTS.plot(name, series, marks, along=along, unit=unit)


def _separation(view: ComparisonView, table: Mapping[str, np.ndarray]) -> Iterator[Plot]:
    if len(table["frame"]) > 1 and table["furthest"].any():
        lines = {
            "furthest atom": (table["furthest"], "first"), "root mean square": (table["typical"], "second"),
            "explained by resolution": (table["bound"], "muted"),
        }  # fmt: skip
        yield _plot(view, "separation", lines, f" ({view.unit})" if view.unit else "")


def _differing(view: ComparisonView, table: Mapping[str, np.ndarray]) -> Iterator[Any]:
    only, inside = (table["only_a"] + table["only_b"]).astype(float), table["pairs_a"].astype(float)
    if len(only) > 1 and only.any():
        lines = {"inside in one only": (only, "bad"), "inside in A": (inside, "muted")}
        yield _plot(view, "differing", lines)
    rows = view.table("differing")
    if not len(rows["i"]):
        return
    rules = [view.rule(one) for one in view.summary["rules"]]
    yield TEXTS("browse_pairs")
    more = {"in_b": rows["inside"] == "B", "rule": rows["rule"] if len(rules) > 1 else None}
    yield TEXTS.browse("pairs", {**rows, **more}, {"rule": rules}, unit=view.unit)


def _input(view: ComparisonView, size: str) -> list[tuple[str, str]]:
    kept = {name: resolution(view.summary[name], view.unit) for name in ("resolution", "other_resolution")}
    return TEXTS.rows("input", **{**view.summary, **kept, "size": size, "between": view.between})


KINDS = {"flips-compare": Verb(judge, page, ComparisonView)}
