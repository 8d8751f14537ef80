"""Report page of a ball's run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.report.analysis import margins_in_bounds, range_table
from mdnum.report.drawing import FIRST, MUTED, SECOND
from mdnum.report.finding import Texts, Verdict
from mdnum.report.section import Figure, Page, Plot, Role, Section, Series, Table, pairs, table_of
from mdnum.report.words import number
from mdnum.verbs.frame import View

TEXTS = Texts(Path(__file__).with_name("ball.toml"))
#: Largest number of rows of a table in the report.
TABLE_ROWS = 5_000
_REASONS = ("", "none", "tolerance", "cap", "fixed", "not finite", "rest")


class BallView(View):
    """Read access to the folder of a ball's run."""

    @property
    def applied(self) -> list[Mapping[str, Any]]:
        """Derivatives of the loss by each applicable gradient method."""
        return [made for made in self.summary["gradient"] if not made["refused"]]

    @property
    def exact(self) -> Mapping[str, Any]:
        """Quantities of the run that are known in closed form."""
        return self.summary["exact"] or {}

    @property
    def parameters(self) -> list[str]:
        """Names of the parameters with respect to which the loss was differentiated."""
        return list(dict.fromkeys(name for made in self.applied for name in made["gradient"]))

    @property
    def ended(self) -> dict[str, int]:
        """Number of times that the solver stopped, by reason."""
        return {word: n for word, n in self.summary["ended"].items() if n and word != "none"}

    @property
    def located(self) -> bool:
        """True if impact times are computed within a step. The solver then counts impacts, not iterations."""
        return self.summary["integrator"] == "event-located"

    def first_step(self, reason: str) -> int:
        """Return the first step at which the solver stopped for the given reason."""
        series = self.table("steps")
        return int(series["step"][np.argmax(series["reason"].astype(str) == reason)])

    def time(self, step: np.ndarray) -> np.ndarray:
        """Return the times of the given steps, in seconds."""
        return np.interp(step, self.table("steps")["step"], self.table("steps")["time"])

    @cached_property
    def ratio(self) -> np.ndarray:
        """Margin of each contact flip, divided by its rounding bound."""
        return margins_in_bounds(self.table("contacts"))


def decision(variant: Mapping[str, Any]) -> str:
    return variant["channel"] + ("" if variant["ball"] is None else f", ball {variant['ball']}")


def page(view: BallView, verdict: Verdict) -> Page:
    """Return the report page of a ball's run."""
    summary = view.summary
    about = TEXTS(
        "about", balls=summary["balls"], steps=summary["steps"], contact=summary["contact_kind"],
        integrator=summary["integrator"].replace("-", " "),
    )  # fmt: skip
    described = [str(view.system["about"])] if view.system.get("about") else []
    sections = [
        Section("Heights and contacts", [*described, *_heights(view), *_nearest(view)]),
        Section("Impacts per step" if view.located else "Iterations per step", list(_solver_plot(view))),
        Section("Margins of decisions", [*_stops(view), *_flips(view)]),
        Section("Range of numbers", list(_ranges(view))),
        Section("Gradient", list(_gradient(view)), terminal=True),
        Section("Against the closed form", list(_exact(view)), terminal=True),
        Section("Variants", list(_variants(view)), terminal=True),
        Section("Contacts", list(_contacts(view))),
        Section("Stop decisions", list(_stop_decisions(view))),
    ]
    first, total = summary["first_contact"], summary["iterations_total"]
    keys = TEXTS.keys(**{
        **summary, "impacts": total if view.located else None, "iterations": None if view.located else total,
        "begun": first if summary["flips_entered"] else None, "held": "" if first is not None else None,
        "most": summary["iterations_max"] if view.ended else None,
        "error": view.exact.get("height_error_largest"),
    })  # fmt: skip
    return view.page(view.name, about, keys, sections)


def _groups(x: np.ndarray, y: np.ndarray, *groups: tuple[np.ndarray, str, Role]) -> tuple[Series, ...]:
    """Split points (x, y) into groups. Return a data series for each group with a finite y."""
    return tuple(
        Series(label, x[mine], y[mine], "points", role)
        for mine, label, role in groups
        if np.any(mine & np.isfinite(y))
    )


def _heights(view: BallView) -> Iterator[Plot]:
    rows, series, contacts = view.table("heights"), view.table("steps"), view.table("contacts")
    balls = np.unique(rows["ball"]).astype(int).tolist()
    roles: tuple[Role, ...] = ("first", "second", "third")
    few = len(balls) <= len(roles)
    lines = []
    if few:
        for n, ball in enumerate(balls):
            mine = rows["ball"] == ball
            at = view.time(rows["step"][mine])
            lines.append(Series(f"ball {ball}", at, rows["y"][mine], "line", roles[n]))
    else:
        # one line with a gap after each ball
        order = np.argsort(rows["ball"], kind="stable")
        ends = np.cumsum(np.bincount(rows["ball"].astype(int)))
        x, y = (np.insert(values[order], ends, np.nan) for values in (view.time(rows["step"]), rows["y"]))
        lines.append(Series("balls", x, y))
    if not balls:
        if not np.isfinite(series["mean_height"]).any():
            return
        lines.append(Series("mean over the balls", series["time"], series["mean_height"]))
    entered = contacts["entered"].astype(bool) & (np.isin(contacts["ball"], balls) | (not balls))
    at = view.time(contacts["step"][entered])
    # on the floor, where they are decided
    marks = [Series("contact begins", at, np.zeros(len(at)), "points", "bad")] if len(at) else []
    yield TEXTS.plot("heights", (*lines, *marks), horizontals=[(0.0, "floor")], balls=len(balls))


def _nearest(view: BallView) -> Iterator[Plot]:
    series = view.table("steps")
    margin = series["min_margin"]
    if not np.isfinite(margin).any():
        return
    doubtful = (series["ambiguous"] > 0, "a decision within rounding", "bad")
    nearest = Series("nearest height", series["time"], margin)
    yield TEXTS.plot("nearest", (nearest, *_groups(series["time"], margin, doubtful)))


def _ranges(view: BallView) -> Iterator[Any]:
    """Yield a table: each quantity's range, and the first step outside the range of narrower formats."""
    table = range_table(lambda name: TEXTS(f"range_{name}"), view.table("steps"))
    if table.rows:
        yield table
        yield TEXTS("ranges")


def _solver_plot(view: BallView) -> Iterator[Plot]:
    series = view.table("steps")
    reason, iterations = series["reason"].astype(str), series["iterations"].astype(float)
    shown = _groups(
        series["time"], iterations, (reason == "tolerance", "ended by tolerance", "first"),
        (reason == "fixed", "a fixed count", "muted"), (reason == "cap", "gave up at the cap", "bad"),
        (reason == "not finite", "not finite", "bad"), (reason == "rest", "held at rest", "third"),
        ((reason == "none") & (iterations > 0), "impacts", "second"),
    )  # fmt: skip
    what = "impacts" if view.located else "iterations"
    if shown:
        yield TEXTS.plot("iterations", shown, what=what, head=what.capitalize())


def _stops(view: BallView) -> Iterator[Plot]:
    rows = view.table("solver")
    stopped, capped = rows["stopped"].astype(bool), rows["reason"].astype(str) == "cap"
    shown = _groups(
        view.time(rows["step"]), rows["margin"].astype(float), (stopped, "stopped", "first"),
        (~stopped & ~capped, "continued", "second"), (~stopped & capped, "gave up", "bad"),
    )  # fmt: skip
    if shown:
        yield TEXTS.plot("stops", shown, horizontals=[(0.0, "tolerance")])


def _flips(view: BallView) -> Iterator[Plot]:
    ratio, contacts = view.ratio, view.table("contacts")
    entered = contacts["entered"].astype(bool)
    shown = _groups(
        view.time(contacts["step"]), ratio, (entered, "contact begins", "first"),
        (~entered, "contact ends", "second"),
    )  # fmt: skip
    if shown:
        yield TEXTS.plot("margins", shown, horizontals=[(1.0, "below: decided by rounding")])


def _gradient(view: BallView) -> Iterator[Any]:
    names, exact = view.parameters, view.exact
    if not names:
        yield TEXTS("no_gradient")
        return
    known = exact.get("gradient") or {}
    yield Figure(
        "gradient", TEXTS("gradient_caption"),
        "; ".join(f"dloss/d{name} by {one['method']}: {number(one['gradient'].get(name))}"
                  for name in names for one in view.applied),
        lambda figure: _dots(view, figure), 0.5 + (0.55 + 0.25 * len(view.applied)) * len(names),
    )  # fmt: skip

    def cell(made: Mapping[str, Any], name: str) -> Any:
        if not (made.get("depends") or {}).get(name, True):
            return "0 (does not depend)"
        error = made.get("details", {}).get("standard_error", {}).get(name)
        text = number(made["gradient"].get(name), 6)
        return text if error is None else f"{text} ± {number(error, 2)}"

    rows = [(one["method"], number(one["value"], 6), *(cell(one, name) for name in names), one["says"])
            for one in view.applied]  # fmt: skip
    if known:
        slopes = [number(known.get(name), 6) for name in names]
        rows.append(("closed form", "–", *slopes, "The derivative of the exact motion."))
    rows += [(one["method"], "–", *["does not apply"] * len(names), one["says"])
             for one in view.summary["gradient"] if one["refused"]]  # fmt: skip
    yield Table(("method", "loss", *(f"dloss/d{name}" for name in names), "which derivative it is"), rows)


def _dots(view: BallView, figure: Any) -> None:
    from mdnum.report import drawing

    made, names = view.applied, view.parameters
    exact = view.exact.get("gradient") or {}
    place = np.arange(len(made))[::-1]
    for axes, name in zip(figure.subplots(len(names), 1, squeeze=False)[:, 0], names, strict=True):
        values = np.array([np.nan if (x := one["gradient"].get(name)) is None else x for one in made], float)
        known = float(exact.get(name, np.nan))
        size = np.abs([x for x in (*values, known) if np.isfinite(x) and x])
        if len(size) > 1 and size.max() > 300 * size.min():
            axes.set_xscale("symlog", linthresh=size.min())
        axes.axvline(0, color=MUTED, lw=0.6)
        if np.isfinite(known):
            axes.axvline(known, color=SECOND, lw=1.2, label="closed form")
        for at, value, one in zip(place, values, made, strict=True):
            used = (one.get("depends") or {}).get(name, True)
            axes.plot(value, at, "o", color=FIRST if used else MUTED, mfc=None if used else "none", ms=6)
        axes.set_yticks(place, [one["method"] for one in made])
        axes.set_ylim(-0.6, len(made) - 0.4)
        axes.set_xlabel(f"dloss/d{name}")
        if name == names[0]:
            drawing.legend(axes)


def _exact(view: BallView) -> Iterator[Any]:
    exact = view.exact
    if not exact:
        return
    rows = TEXTS.rows("exact", **{"rest_time": None, **exact, "motion": TEXTS(f"motion_{exact['model']}")})
    off = [
        (f"dloss/d{name} off by {method}", number(error, 2, signed=True))
        for method, errors in (exact.get("gradient_error") or {}).items()
        for name, error in errors.items()
    ]
    yield pairs([*rows, *off])


def _variants(view: BallView) -> Iterator[Any]:
    variants, rows = view.summary["variants"], view.table("separations")
    if not variants:
        return
    roles: tuple[Role, ...] = ("first", "second", "third", "bad", "muted")
    if np.any(rows["separation"] > 0):
        names = list(dict.fromkeys(rows["variant"].astype(str).tolist()))
        lines = []
        for n, name in enumerate(names):
            mine = rows["variant"].astype(str) == name
            x, y = view.time(rows["step"][mine]), rows["separation"][mine]
            lines.append(Series(name, x, y, "line", roles[n % len(roles)], n >= len(roles)))
        forks = [(float(view.time(np.array(one["fork"]))), f"{one['name']} forks")
                 for one in variants if one["fork"] is not None]  # fmt: skip
        yield TEXTS.plot("separation", lines, verticals=forks)
    slopes = list(variants[0]["gradient"])

    def slope(name: str) -> Callable[[Mapping[str, Any]], str]:
        return lambda one: (
            number(one["gradient"].get(name), 6) if one["depends"].get(name, True) else "0 (does not depend)"
        )

    yield table_of(variants, {
        "variant": "name", "seed": "seed", "fork": "fork",
        "decision": lambda one: "none differs" if one["fork"] is None else decision(one),
        "margin here": "margin", "margin there": "margin_there",
        "separation at the end (m)": "separation_end",
        "steps with other iterations": "iterations_differ", "loss": lambda one: number(one["loss"], 6),
        **{f"dloss/d{name}": slope(name) for name in slopes},
    })  # fmt: skip
    yield TEXTS("variants")


def _contacts(view: BallView) -> Iterator[Any]:
    """Yield a table of the contact flips that rounding could change most easily."""
    rows, ratio = view.table("contacts"), view.ratio
    if not len(ratio):
        yield TEXTS("no_contacts")
        return
    chosen = np.sort(np.argsort(ratio, kind="stable")[:TABLE_ROWS])
    yield TEXTS("contacts", shown=len(chosen), rows=len(ratio))
    near = {name: values[chosen] for name, values in rows.items()}
    yield TEXTS.browse("contacts", near | {"ratio": ratio[chosen]})


def _stop_decisions(view: BallView) -> Iterator[Any]:
    """Yield a table of the solver's stop decisions closest to the threshold."""
    rows = view.table("solver")
    if not len(rows["step"]):
        return
    chosen = np.sort(np.argsort(np.abs(rows["margin"].astype(float)), kind="stable")[:TABLE_ROWS])
    near: dict[str, Any] = {name: values[chosen] for name, values in rows.items()}
    near["code"] = np.array([_REASONS.index(word) for word in near["reason"].astype(str).tolist()])
    near["ball"] = near["ball"] if np.any(rows["ball"] >= 0) else None
    yield TEXTS("stops", shown=len(chosen), rows=len(rows["step"]))
    yield TEXTS.browse("stops", near, {"ended by": _REASONS})
