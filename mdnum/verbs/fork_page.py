"""Report page of two runs that differ in one numerical choice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.patches import Circle

from mdnum.report.drawing import BAD, FIRST, MUTED, SECOND
from mdnum.report.finding import Verdict
from mdnum.report.section import (
    Figure,
    Page,
    Plot,
    Role,
    Section,
    Series,
    Table,
    curves,
    pairs,
    positive,
    table_of,
)  # fmt: skip
from mdnum.report.words import count, listed, many, number, pair_name, plain
from mdnum.verbs.fork_verdict import DECISION, TEXTS, TWO_BY_TWO, WHAT, agreeing, decided, sides, subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from mdnum.verbs.frame import View

#: Smallest r² of a fit for which a separation counts as exponential.
FITS = 0.8
#: Largest number of rows of the table of decisions in the report.
TABLE_ROWS = 5_000
SPACES = {"r2": "r²", "r": "r", "height": "minus the height", "residual": "tolerance minus residual"}
#: An extrapolated split is shown up to this multiple of the number of steps.
_BEYOND = 2.0
#: Length of the longest arrow, in cutoffs.
_ARROW = 0.5


def page(view: View, verdict: Verdict) -> Page:
    """Return the report page of two runs that differ in one numerical choice."""
    s = view.summary
    return view.page(f"{view.name}: {s['choice']}", str(s["difference"]), TEXTS.keys(**_numbers(view)), [
        Section("Separation", list(_separation(view))),
        Section(DECISION, [*_decision(view), *_around(view)], terminal=True),
        Section(TWO_BY_TWO, list(_two_by_two(view)), terminal=True),
        Section("One decision overridden", list(_pinned(view)), terminal=True),
        Section("Minimal cause", list(_minimal(s)), terminal=True),
        Section("How far the decisions are certain", list(_certain(view)), terminal=True),
        Section("Growth", list(_growth(view)), terminal=True),
        Section("After the fork", list(_after(view))),
        Section("Decisions that differ", list(_flips(view))),
        Section(WHAT, list(_what(view))),
    ])  # fmt: skip


def _numbers(view: View) -> dict[str, Any]:
    """Return the numbers that are shown at the top of the page."""
    s, fits = view.summary, view.summary["r_squared"]
    worth = number(s["e_foldings"])
    if s["e_foldings"] is None and s["effect"] == "cause":
        # no split in sight: the share is at least what was followed
        shares = (one for one in s["shares"] if one["what"] == "decisions" and one["reference"] == "A")
        least = next(shares, {}).get("e_foldings")
        worth = f"> {number(least)}" if least else "∞"
    return {
        "cross_stops": None, "counted": None, **s, "unit": view.units.time, "worth": worth,
        "poor": "" if fits is not None and fits < FITS else None,
        **{name: s[name] and plain(s[name], 6) for name in ("first_bit_time", "fork_time", "split_time")},
    }  # fmt: skip


def _dates(s: Mapping[str, Any], *names: str) -> tuple[tuple[float, str], ...]:
    return tuple((float(s[name]), name.replace("_", " ")) for name in names if s.get(name) is not None)


def _has(table: Mapping[str, np.ndarray], name: str) -> bool:
    return name in table and bool(np.any(np.nan_to_num(table[name]) > 0))


def _separation(view: View) -> Iterator[Plot | str]:
    """Yield figures of the distance between runs A and B. B uses its own decisions or those of A."""
    s, table = view.summary, view.table("separation")
    if not _has(table, "free"):
        return
    # a repeat is close to the run that it repeats and must not hide it: it comes first
    repeats = [name for name in table if name.startswith("repeat_")]
    named: list[tuple[str, str, Role]] = [
        *((name, "" if k else "B again, start perturbed", "muted") for k, name in enumerate(repeats)),
        ("free", "A and B, free", "first"), ("imposed", "A and B under A’s decisions", "second"),
        ("back", "B and A under B’s decisions", "third"), ("pinned", "A and B, decision overridden", "bad"),
    ]  # fmt: skip
    # before the fork the lines lie upon one another
    dashed = ("imposed", "back", "pinned")
    series = [
        Series(label, table["step"], positive(table[name]), role=role, dashed=name in dashed)
        for name, label, role in named
        if _has(table, name)
    ]
    verticals, guess = _dates(s, "first_bit", "fork", "split"), s["predicted_split"] or 0
    shown = 0 < guess <= _BEYOND * s["steps"]
    if shown:
        verticals += ((float(guess), "split expected"),)
    fit = s["growth"]["B"]
    if fit["rate"] is not None and fit["r_squared"] >= FITS:
        at = np.linspace(fit["first"], guess if shown else fit["last"], 60)
        line = np.exp(fit["intercept"] + fit["rate"] * at)
        series.append(Series("growth, fitted", at, line, role="ink", dashed=True))
    what = "largest difference of heights" if "balls" in s else "largest distance of an atom between runs"
    yield TEXTS.plot(
        "separation", series, verticals, [(float(s["tolerance"]), "split tolerance")], what=what,
        timestep=s["timestep"], time=view.units.time, length=view.units.length,
        caption=TEXTS("separation_caption" if _has(table, "imposed") else "separation_caption_free"),
    )  # fmt: skip
    if boxes := s.get("boxes"):
        yield TEXTS("boxes", **boxes)
        for name, date in (("first_bit", "the first bit"), ("fork", "the fork"), ("split", "the split")):
            if boxes[name]:
                yield TEXTS("boxes_at", date=date, step=s[name], unit=view.units.length, **boxes[name])


def _decision(view: View) -> Iterator[Any]:
    """Yield a table of the first decision that differs between the two runs."""
    s, unit = view.summary, view.units.length
    d = s["decision"]
    if d is None:
        return
    values = {**d, **sides(d), "counted": s.get("counted"), "subject": subject(s)}
    when = f"{count(d['step'])}, {plain(d['step'] * s['timestep'], 6)} {view.units.time}"
    also = f"; {many(d['also'], 'more decision')} at the same step" if d["also"] else ""
    rows = [("Decision", TEXTS(decided(d), **values)), ("Step", when + also)]
    slope = 1.0
    if d["channel"] == "pair":
        cutoffs = d["cutoffs"]
        own = cutoffs["B" if d["run"] == "B" else "A"]
        rows.append(("Distance", f"{number(d['distance'], 11)} {unit}, cutoff {number(own, 11)} {unit}"))
        if cutoffs["A"] != cutoffs["B"]:
            off = number(cutoffs["B"] - cutoffs["A"], 3, signed=True)
            rows.append(("Cutoff", f"differs between the runs: B’s minus A’s is {off} {unit}"))
        slope = d["margin"] / d["margin_length"] if d["margin_length"] else 1.0
    for run, margin in d["margins"].items():
        bound = d["bounds"][run]
        ambiguous = run in d["ambiguous_in"]
        kind = "none" if margin is None else "ambiguous" if ambiguous else "exact" if not bound else "sure"
        sized = {"margin": margin, "bound": bound, "space": SPACES[d["space"]]}
        sized |= {"times": abs(margin) / bound if margin and bound else None}
        text = TEXTS(f"margin_{kind}", **sized)
        if slope != 1.0 and margin is not None:
            text += f" ({number(margin / slope, 3, signed=True)} {unit})"
        rows.append((f"Margin in {run}", text))
    kind = "none" if d["protected"] is None else "kept" if d["protected"] >= d["protects"] else "lost"
    rows.append(("Separation the step before", TEXTS(f"protection_{kind}", **d, unit=unit)))
    yield pairs(rows)


def _around(view: View) -> Iterator[Any]:
    """Yield a figure of the first differing decision."""
    d = view.summary["decision"]
    if d is None:
        return
    if "balls" in view.summary:
        table, series = view.table("around"), []
        named: tuple[tuple[str, Role], ...] = (("A", "first"), ("B", "second"))
        for name, role in named:
            mine = table["run"].astype(str) == name
            step, height, touching = (table[column][mine] for column in ("step", "y", "contact"))
            # B on A: before the fork one line hides the other
            series.append(Series(name, step, height, role=role, dashed=name == "B"))
            if touching.any():
                label = f"{name} in contact"
                series.append(Series(label, step[touching], height[touching], mark="points", role=role))
        ball = int(table["ball"][0])
        yield TEXTS.plot("around", series, [(float(d["step"]), "fork")], [(0.0, "floor")], ball=ball)
    elif len(atoms := view.table("neighborhood")["atom"]) > 1:
        pair = f"{atoms[0]}–{atoms[1]}"
        alt = f"{many(len(atoms) - 2, 'atom')} around the pair {pair} in A and in B, projected."
        yield Figure("atoms", TEXTS("atoms_caption"), alt, lambda figure: _atoms(view, figure), 4.0)


def _atoms(view: View, figure: Canvas) -> None:
    """Draw the atoms of runs A and B in two panels. A circle shows the cutoff."""
    d, table = view.summary["decision"], view.table("neighborhood")
    x, moved = (
        np.stack([table[k] for k in names], axis=1) for names in (("x", "y", "z"), ("dx", "dy", "dz"))
    )
    # along the pair, across it where the neighbors spread most, and toward the eye
    along = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    _, _, axes = np.linalg.svd(x - np.outer(x @ along, along), full_matrices=True)
    across = next(a - (a @ along) * along for a in (*axes, *np.eye(3)) if abs(a @ along) < 0.9)
    across /= np.linalg.norm(across)
    basis = np.stack([along, across, np.cross(along, across)])
    flat, shift = x @ basis.T, moved @ basis.T
    longest = float(np.sqrt((shift[:, :2] ** 2).sum(axis=1)).max())
    factor = 10.0 ** np.floor(np.log10(_ARROW * d["cutoffs"]["A"] / longest)) if longest > 0 else 0.0
    slope = d["margin"] / d["margin_length"] if d["margin_length"] else 1.0
    shade: Any = np.clip(
        1.0 - 0.8 * np.abs(flat[:, 2]) / max(float(np.abs(flat[:, 2]).max()), 1e-300), 0.15, 1
    )
    for panel, name in zip(figure.subplots(1, 2), "AB", strict=True):
        inside, cutoff = bool(d["decided"][name]), float(d["cutoffs"][name])
        panel.scatter(flat[2:, 0], flat[2:, 1], s=26, c=MUTED, alpha=shade[2:], lw=0)
        panel.add_patch(Circle(tuple(flat[0, :2]), cutoff, fill=False, ec=SECOND, lw=1.2))
        panel.plot(flat[:2, 0], flat[:2, 1], "o-" if inside else "o--", color=FIRST, lw=1.6, ms=6)
        for k, atom in enumerate(table["atom"][:2].tolist()):
            side = {"xytext": (-7, 6), "ha": "right"} if k == 0 else {"xytext": (7, 6), "ha": "left"}
            panel.annotate(str(atom), tuple(flat[k, :2]), textcoords="offset points", fontsize=8.5, **side)
        beyond = number(-d["margins"][name] / slope, 3, signed=True)
        word = "inside" if inside else "outside"
        panel.set_title(f"{name}: {word}, r − cutoff = {beyond} {view.units.length}", fontsize=9, loc="left")
        if name == "B" and factor:
            panel.quiver(flat[:, 0], flat[:, 1], factor * shift[:, 0], factor * shift[:, 1], angles="xy",
                         scale_units="xy", scale=1.0, color=BAD, width=0.005)  # fmt: skip
            panel.set_ylabel(f"arrows × {number(factor, 1)}")
        reach = 1.12 * max(float(np.abs(flat[:, :2]).max()), 1.5 * cutoff)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        panel.set_xlabel(f"along the pair ({view.units.length})")


def _two_by_two(view: View) -> Iterator[Any]:
    """Yield a table of divergence steps, for the arithmetic and the decisions of A or B."""
    s, unit = view.summary, view.units.length
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for cell in s["table"]:
        arithmetic, decisions, whose = cell["arithmetic"], cell["decisions"], cell["reference"]
        at = f"> {count(cell['until'])}" if cell["split"] is None else count(cell["split"])
        same = arithmetic == decisions == whose
        key = arithmetic, "its own" if arithmetic == decisions else f"{decisions}’s"
        lines.setdefault(key, {})[whose] = f"is {whose}" if same else at
    if len(lines) < 3 or all(cell["split"] is None for cell in s["table"]):
        return
    for size, name in zip(s.get("displacements") or (), ("repeated", "repeated_other"), strict=False):
        label, ran = TEXTS("start_displaced", displacement=size, unit=unit), len(s[name])
        for whose, run in (("its own", "free"), ("A’s", "imposed")):
            seen = [one[run] for one in s[name] if one[run] is not None]
            unseen = [f"{ran - len(seen)} of {ran} unknown"] * (len(seen) < ran)
            steps = [f"{count(min(seen))} to {count(max(seen))}"] if seen else []
            lines[label, whose] = {"A": "; ".join(steps + unseen)}
    yield TEXTS("two_by_two")
    rows = [(*key, at.get("A"), at.get("B")) for key, at in lines.items()]
    yield Table(("arithmetic", "decisions", "splits from A at", "from B at"), rows)
    worth: dict[str, dict[str, str]] = {}
    for one in s["shares"]:
        more = "> " if one["at_least"] else ""
        text = f"{more}{many(one['steps'], 'step')}"
        if one["e_foldings"] is not None:
            text += f", {more}{number(one['e_foldings'])} e-foldings"
        worth.setdefault(one["what"], {})[one["reference"]] = text
    if worth:
        yield TEXTS("shares")
        rows = [(what, at.get("A"), at.get("B")) for what, at in worth.items()]
        yield Table(("without the difference in", "seen from A", "seen from B"), rows)


def _pinned(view: View) -> Iterator[Any]:
    pinned = view.summary.get("pinned")
    if pinned is None:
        return
    if pinned["pairs"] is None:
        yield TEXTS("pinned_none", **pinned)
        return
    terms = pinned.get("terms") or [""] * len(pinned["pairs"])
    each = zip(pinned["pairs"], terms, strict=True)
    names = listed([pair_name({"i": i, "j": j, "terms": term}) for (i, j), term in each])
    kind = "kept" if pinned["split"] is None else "splits"
    yield TEXTS(f"pinned_{kind}", **{**pinned, "pairs": names}, unit=view.units.length)


def _minimal(s: Mapping[str, Any]) -> Iterator[Any]:
    minimal = s.get("minimal")
    if minimal is None:
        return
    if not minimal["tests"]:
        yield TEXTS("minimal_refused", **minimal)
        return
    yield f"{minimal['reason']} {TEXTS('minimal_tests', **minimal)}"

    def spells(pair: Mapping[str, Any]) -> str:
        spans = [
            f"from {count(first)} on" if end is None
            else count(first) if end == first + 1
            else f"{count(first)} to {count(end - 1)}"
            for first, end in pair["differs"]
        ]  # fmt: skip
        more = f", and {many(len(spans) - 3, 'time')} more" if len(spans) > 3 else ""
        return ", ".join(spans[:3]) + more

    if minimal["pairs"]:
        yield table_of(
            minimal["pairs"],
            {"pair": pair_name, "decided differently, steps": spells},
        )


def _certain(view: View) -> Iterator[Any]:
    """Yield tables of the steps up to which rounding cannot have changed any decision."""
    s, rows = view.summary, []
    for name, step in (s.get("certified_horizon") or {}).items():
        ambiguous, first = s["ambiguous"][name], s["ambiguous_first"][name]
        text = TEXTS("certified" if step >= 0 else "certified_never", step=step)
        if ambiguous:
            text += "; " + TEXTS("certified_after", n=ambiguous, steps=s["ambiguous_steps"][name])
        if first is not None:
            text += "; " + TEXTS("certified_first", **first)
        if not s["lists_complete"][name]:
            text += "; " + TEXTS("certified_listed")
        rows.append((f"Certified, {name}", text))
    until = s.get("protected_until")
    if until is not None:
        kind = "throughout" if until >= s["steps"] else "until" if until >= 0 else "never"
        rows.append(("Protected", TEXTS(f"protected_{kind}", until=until)))
    if wide := s.get("shadow"):
        values = {"step": s["shadow_horizon"], "wide": wide, "other": "B" if wide == "A" else "A"}
        rows.append(("Shadow horizon", TEXTS("shadow", **values)))
    if not rows:
        return
    yield TEXTS("certain")
    yield pairs(rows)
    table = view.table("separation")
    if _has(table, "nearest_a") and _has(table, "free"):
        verticals = _dates(s, "fork", "split")
        if until is not None and 0 <= until < s["steps"]:
            verticals = ((float(until), "protected"), *verticals)
        nearest, moved = positive(table["nearest_a"]), positive(2 * table["free"])
        series = (
            Series("nearest pair of A to its cutoff", table["step"], nearest, mark="points", role="muted"),
            Series("twice the separation of A and B", table["step"], moved, role="first"),
        )
        yield TEXTS.plot("protection", series, verticals, unit=view.units.length)


def _growth(view: View) -> Iterator[Any]:
    s, time, rows = view.summary, view.units.time, []
    for name, fit in s["growth"].items():
        label = "A and B, free" if name == "B" else "Under A’s decisions"
        kind = "none" if fit["rate"] is None else "poor" if fit["r_squared"] < FITS else "fitted"
        rate = fit["rate"] or 0.0
        values = {**fit, "per_time": rate / s["timestep"], "time": time}
        text = TEXTS(f"growth_{kind}", **values)
        if kind == "fitted" and rate > 0:
            text += "; " + TEXTS("growth_doubles", steps=float(np.log(2)) / rate)
        rows.append((label, text))
    found, reason = s.get("lyapunov"), s.get("lyapunov_reason")
    if found is not None:
        text = TEXTS("lyapunov" if found["ratio"] is None else "lyapunov_ratio", **found, time=time)
        rows.append(("Lyapunov exponent", f"{text}; {reason}" if reason else text))
        if found["ulp_split"] is not None:
            rows.append(("An ulp of the start", TEXTS("lyapunov_ulp", **found, unit=view.units.length)))
    elif reason:
        rows.append(("Lyapunov exponent", f"none: {reason}"))
    yield pairs(rows)


def _after(view: View) -> Iterator[Plot]:
    """Yield figures of different decisions, overridden decisions and energy differences from run A."""
    s, table = view.summary, view.table("separation")
    step, dates, length = table["step"], _dates(s, "fork", "split"), view.units.length
    named = [("cross", "decisions that differ"), ("overridden", "decisions overridden")]
    named += [("furthest", f"furthest from it ({length})")] * ("balls" not in s)
    for name, label in named:
        if _has(table, name):
            values, far = positive(table[name]), name == "furthest"
            scale = "log" if far or np.nanmax(values) > 30 else "linear"
            limit = [(float(s["tolerance"]), "split tolerance")] * far
            series = [Series(label, step, values, mark="points")]
            yield TEXTS.plot(name, series, dates, limit, label=label, scale=scale)
    off = {"B, free": table["energy_b"], "B under A’s decisions": table["energy_imposed"]}
    lines = curves(step, {label: np.abs(energy - table["energy_a"]) for label, energy in off.items()})
    if lines:
        yield TEXTS.plot("energy", lines, dates, unit=view.units.energy)


def _flips(view: View) -> Iterator[Any]:
    """Yield a searchable table of decisions that differ between the runs, earliest first."""
    s, total = view.summary, view.summary["cross_flips"]
    if not total:
        yield TEXTS("no_flips")
        return
    ball = "balls" in s
    table = view.folder.read("cross_flips", rows=TABLE_ROWS)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(table["margin"] / table["bound"])
    table |= {"ratio": ratio, "in_b": table["run"].astype(str) == "B"}
    table |= {"stop": table["channel"].astype(str) == "stop"} if ball else {}
    name = "flips_ball" if ball else "flips_md"
    yield TEXTS(name, shown=len(table["step"]), total=total, counted=s.get("counted"))
    yield TEXTS.browse(name, table)


def size(view: View) -> list[tuple[str, str]]:
    """Return table rows on the description and the size of the system."""
    s = view.summary
    rows = [("System", str(s["about"]))] if s.get("about") else []
    parts = many(s["balls"], "ball") if "balls" in s else many(s["atoms"], "atom")
    if s["timestep"] is None:
        return [*rows, ("Size", f"{parts}, {many(s['steps'] + 1, 'frame')}")]
    asked = s.get("steps_asked")
    more = f" ({count(asked)} asked for)" if asked and asked > s["steps"] else ""
    text = f"{parts}, {many(s['steps'], 'step')} of {plain(s['timestep'])} {view.units.time}{more}"
    kind = f", {s['contact_kind']} contact, {s['integrator']}" if "contact_kind" in s else ""
    return [*rows, ("Size", text + kind)]


def _what(view: View) -> Iterator[Any]:
    s = view.summary
    repeats = (s["count"] or {"pairs": 1})["pairs"] - 1
    # what does not hold has no value, and its row is left out
    rows = TEXTS.rows("what", **{
        "reproduced": None, **s, "agreeing": agreeing(view), "unit": view.units.length,
        "ball": "" if "balls" in s else None, "must": "" if s.get("must_hold") else None,
        "free": "" if s["imposed_until"] is None else None,
        "repeats": repeats + (s.get("count_other") or {"pairs": 0})["pairs"] if repeats else None,
    })  # fmt: skip
    yield pairs([*size(view), *rows, view.took])
    changed = s.get("differences") or [(key, *values) for key, values in s["changes"].items()]
    if changed:
        yield differences(changed, "" if s.get("differences") else "What differs in the system file")


def differences(rows: Sequence[Sequence[Any]], title: str = "") -> Table:
    """Return a table of the settings that differ between two runs."""
    return Table(("key", "in A", "in B"), [(key, _value(a), _value(b)) for key, a, b in rows], title)


def _value(value: Any) -> str:
    return repr(value) if isinstance(value, float) else "none" if value is None else str(value)
