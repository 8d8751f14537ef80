"""Report page of `mdnum run`: read access to the run folder, sections and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import FolderError
from mdnum.ranges import columns
from mdnum.report import analysis
from mdnum.report.finding import Texts, Verdict
from mdnum.report.page import in_words
from mdnum.report.section import Figure, Page, Plot, Section, Series, Table, curves, pairs, positive, table_of
from mdnum.report.words import count, many, number, pair_name, plain
from mdnum.store.tables import as_numpy
from mdnum.units import Measured
from mdnum.verbs.frame import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

TEXTS = Texts(Path(__file__).with_name("run.py"))

#: A flip that is reversed within this number of steps counts as chatter.
CHATTER_STEPS = 10
#: Largest number of rows of the flip table in the report: the flips nearest to their thresholds.
TABLE_ROWS = 5_000
_BUSIEST = 10
_COLUMNS = ("step", "i", "j", "entered", "distance", "margin", "radial_speed", "energy_jump", "bound")


class RunView(View):
    """Read access to the folder of a run, finished or not."""

    @cached_property
    def series(self) -> Mapping[str, np.ndarray]:
        """Table with one row of energies, temperature and counts for each step.

        Raises:
            FolderError: the folder contains no step of the run.
        """
        series = self.table("series")
        if not len(series["step"]):
            remedy, where = self.folder.again, str(self.folder.path)
            raise FolderError("no step of the run was stored", remedy=remedy, where=where)
        return series

    @property
    def epochs(self) -> Mapping[str, np.ndarray]:
        """Table with one row for each neighbor list of the run."""
        return self.table("epochs")

    @cached_property
    def flips(self) -> analysis.Scan:
        """Statistics of all flips. The table of flips is read in batches."""
        flips = analysis.Scan(len(self.series["step"]), TABLE_ROWS)
        known = self.folder.table("flips", rows=1).column_names
        columns = [*_COLUMNS, *(name for name in ("terms",) if name in known)]
        for batch in self.folder.batches("flips", columns):
            flips.take({name: as_numpy(batch[name]) for name in columns})
        if not flips.nearest:
            flips.take(self.folder.read("flips", columns, rows=1))
        return flips

    @property
    def steps(self) -> int:
        """Number of steps of the run."""
        return max(0, len(self.series["step"]) - 1)

    @property
    def cutoff(self) -> Mapping[str, Any]:
        """Properties of the cutoff, such as kind, radius and energy jump. Empty without a cutoff."""
        return self.summary.get("cutoff") or {}

    @property
    def cutoff_key(self) -> str:
        """Key of the system file that sets the cutoff. Empty if the potential sets it."""
        given = self.system.get("cutoff") or {}
        return next((f"cutoff.{key}" for key in ("radius", "in_sigma", "pairs") if key in given), "")

    @property
    def own_end(self) -> list[str]:
        """Variant of a remedy's text: ["own"] if the potential sets the cutoff, otherwise an empty list."""
        return [] if self.cutoff_key else ["own"]

    @cached_property
    def thermal(self) -> float:
        """k_B T at the mean temperature of the run, in units of energy."""
        return self.units.k_B * float(np.mean(self.series["temperature"]))

    @property
    def jump(self) -> float:
        """Energy of a pair at the cutoff. 0 if the potential vanishes there."""
        return float(self.cutoff.get("energy_jump") or 0.0)

    @property
    def ase(self) -> Mapping[str, Any]:
        """Results of the comparison with ASE; empty if no comparison was made."""
        return self.summary.get("ase") or {}

    @property
    def conservative(self) -> bool:
        """True if the total energy should be conserved (dynamics of kind "nve")."""
        return (self.system.get("dynamics") or {}).get("kind", "nve") == "nve"

    @cached_property
    def expected_ambiguous(self) -> float:
        """Expected number of flips with a margin within its rounding bound."""
        return analysis.expected_ambiguous(self.flips.ratios)

    @cached_property
    def budget(self) -> dict[str, np.ndarray]:
        """By step: change of the conserved energy, sum of energy jumps at flips, and their difference."""
        conserved = self.series["conserved"]
        change, jumps = conserved - conserved[0], np.cumsum(self.series["energy_jump"])
        return {"change": change, "jumps": jumps, "residual": change - jumps}

    @cached_property
    def time_step(self) -> dict[str, float | None]:
        """Indicators of whether the time step is small enough; unknown indicators are None.

        `per_period` is the number of steps per period of the fastest vibration, in the first and the last
        frame. `fluctuation` is the fluctuation of the conserved energy without jumps, divided by that of the
        kinetic energy. `drift` and `drift_error` are the energy drift over the run and its standard error, in
        k_B T per atom.
        """
        period, step = self.summary.get("fastest_period"), (self.system.get("dynamics") or {}).get("timestep")
        atoms = self.summary.get("atoms") or 0
        thermal = self.thermal * atoms
        # atoms in harmonic wells have 0.87 sqrt(N) k_B T (those that fly freely have none in an isolated run)
        least = thermal / (2 * np.sqrt(atoms)) if atoms else 0.0
        found = analysis.Conservation.of(self.budget["residual"], self.series["kinetic"], least)
        drift = error = None
        if found is not None and thermal > 0:
            drift, error = found.drift / thermal, found.drift_error / thermal
        return {
            "per_period": period / step if period and step else None,
            "fluctuation": None if found is None else found.fluctuation,
            "drift": drift,
            "drift_error": error,
        }

    @property
    def residual(self) -> Measured:
        """Stored residual of the energy budget, or max |E(t) - E(0) - sum of energy jumps|."""
        stated = self.summary.get("energy_budget_residual")
        left = float(np.max(np.abs(self.budget["residual"]))) if stated is None else abs(float(stated))
        return Measured(left, self.units.energy, self.summary.get("energy_budget_tolerance"))

    def total(self, key: str, column: str | None = None) -> int:
        """Return a number of events, such as lost pairs, from the summary or the neighbor lists."""
        return int(self.summary.get(key) or self.epochs[column or key].sum())

    def step(self, row: int | np.integer) -> int:
        """Return the step number of a row of the table of steps."""
        return int(self.series["step"][row])


def page(run: RunView, verdict: Verdict) -> Page:
    """Return the report page of a run."""
    atoms, cutoff, units = run.summary.get("atoms"), run.cutoff, run.units
    about = [many(atoms, "atom")] if atoms else []
    about.append(many(run.steps, "step"))
    if cutoff.get("kind"):
        radius = cutoff.get("radius")
        at = f" at {plain(radius, 6)} {units.length}" if isinstance(radius, int | float) else ""
        about.append(f"{cutoff['kind']} cutoff{at}")
    sections = [
        Section("What was run", [pairs(_what(run))]),
        Section("Energy and its budget", list(_energy(run))),
        Section("Pressure", list(_pressure(run))),
        Section("Flips per step", list(_flips_per_step(run))),
        Section("Margins in units of rounding", list(_margins(run))),
        Section("Chatter and residence", list(_chatter(run))),
        Section("List health", list(_lists(run))),
        Section("Flips", list(_nearest(run))),
        Section("Range of numbers", list(_ranges(run))),
        Section("Agreement with ASE", list(_ase(run))),
    ]
    return run.page(run.name, ", ".join(about), TEXTS.keys(**_numbers(run)), sections)


def draw_first(run: RunView) -> None:
    """Draw the figures that do not need the table of flips, in parallel with other work."""
    from mdnum.report import drawing

    for part in (*_energy(run), next(_flips_per_step(run)), *_lists(run)):
        if isinstance(part, Figure | Plot):
            run.pictures[part.name] = drawing.markup(drawing.draw(part), part.name)


def _numbers(run: RunView) -> dict[str, Any]:
    """Return the numbers that are shown at the top of the page."""
    summary, atoms, epochs = run.summary, run.summary.get("atoms"), run.epochs
    made = {name: int(run.series[name].sum(dtype=np.int64)) for name in ("entered", "left", "ambiguous")}
    known = ("energy_drift", "energy_budget_closes", "steps_per_second")
    return {
        **vars(run.units), **run.time_step, **made, **{name: summary.get(name) for name in known},
        "flips": made["entered"] + made["left"], "lists": len(epochs["epoch"]),
        "residual": run.residual.value,
        "rate": run.flips.total / run.steps / atoms if atoms and run.steps else None,
        "dangerous": run.total("dangerous_builds", "dangerous"), "lost": int(epochs["lost_pairs"].sum()),
        "error": run.ase.get("energy_rel"), "sample": " of a sample" if "sampled" in run.ase else "",
    }  # fmt: skip


def _what(run: RunView) -> list[tuple[str, str]]:
    """Return table rows on the simulated system. Missing settings are omitted."""
    units, system, time = run.units, run.system, run.series["time"]
    lengths: dict[str, str] = dict.fromkeys(("radius", "onset", "skin"), units.length)

    def said(table: Mapping[str, Any] | None) -> str | None:
        if table and (code := table.get("code")):
            table = {key: value for key, value in table.items() if key != "notes"}
            table = {**table, "code": f"sha256 {code['sha256'][:12]}, its text in simulation.json"}
        return in_words(table, lengths) if table else None

    given = {key: said(system.get(key)) for key in ("potential", "cutoff", "neighbors", "precision")}
    parts = (system.get("terms") or {}).items()
    terms = [f"{name}: {said(of['potential'])}, {said(of['cutoff'])}" for name, of in parts]
    given["terms"] = "; ".join(terms) or None
    # how many steps were made is said above; the file says how many were planned
    made = {key: value for key, value in (system.get("dynamics") or {}).items() if key != "steps"}
    function = run.cutoff.get("function") or {}
    atoms, freedom = run.summary.get("atoms") or None, run.summary.get("degrees_of_freedom")
    counted = TEXTS("freedom_all" if freedom == 3 * (atoms or 0) else "freedom_at_rest")
    return TEXTS.rows("what", **{
        **vars(units), **given, "about": system.get("about") or None, "steps": run.steps,
        "atoms": atoms, "span": float(time[-1] - time[0]),
        "mean": float(np.mean(run.series["temperature"])),
        "freedom": freedom, "counted": None if freedom is None else counted,
        **{name: run.cutoff.get(name) for name in ("energy_jump", "force_jump")},
        **{key: function.get(key) for key in ("from", "to")},
        "breaks": sum(row.get("kinks", 1) for row in function.get("places", ())),
        "first": TEXTS(f"jumps_{run.cutoff['smoothness']}") if function else None,
        "dynamics": in_words(made, vars(units) | {"timestep": units.time}) if made else None,
    })  # fmt: skip


def _energy(run: RunView) -> Iterator[Any]:
    budget, units, summary = run.budget, run.units, run.summary
    smooth = not np.any(run.series["energy_jump"])

    def draw(figure: Canvas) -> None:
        from matplotlib.ticker import MaxNLocator

        from mdnum.report.drawing import FIRST, MUTED, SECOND, THIRD, legend, line

        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        time = run.series["time"]
        if smooth:
            line(above, time, budget["change"], FIRST, "E(t) − E(0)")
        else:
            # one upon the other where the budget closes: a broad pale line, and a thin one that runs in it
            line(above, time, budget["change"], FIRST, "E(t) − E(0)", lw=4, alpha=0.4)
            line(above, time, budget["jumps"], SECOND, "sum of the ledger’s jumps", lw=0.9)
        below.axhline(0, color=MUTED, lw=0.6)
        line(below, time, budget["residual"], THIRD)
        above.set_ylabel(f"energy ({units.energy})")
        below.set_ylabel(f"difference ({units.energy})")
        below.set_xlabel(f"time ({units.time})")
        below.yaxis.set_major_locator(MaxNLocator(4))
        legend(above)

    change, left = budget["change"], budget["residual"]
    alt = (
        f"Change of the energy against time: {number(float(change.min()))} to {number(float(change.max()))} "
        f"{units.energy}; what no flip explains: {number(float(left.min()))} to {number(float(left.max()))}."
    )
    caption = TEXTS("energy_caption_smooth" if smooth else "energy_caption")
    if not run.conservative:
        given = {name: summary.get(name) for name in ("heat", "work")}
        kind = "bath_and_box" if given["work"] else "thermostat"
        caption += " " + TEXTS(kind if given["heat"] is not None else "bath", **given, unit=units.energy)
    yield Figure("energy", caption, alt, draw, 3.7)
    if run.jump and run.steps:
        moves = float(np.max(np.abs(np.diff(left))))
        yield TEXTS("one_flip", jump=abs(run.jump), unit=units.energy, moves=moves)
        if checks := summary.get("energy_budget_checks"):
            yield TEXTS("checked_smooth", checks=checks, residual=run.residual)
    if summary.get("energy_drift") is not None:
        yield TEXTS(
            "drift", drift=summary["energy_drift"], without=summary.get("energy_drift_without_jumps"),
            unit=units.energy, time_unit=units.time,
        )  # fmt: skip
    if state := summary.get("fixed_point"):
        yield TEXTS("fixed_point", **state, length_unit=units.length, energy_unit=units.energy)
        if state.get("energy_std_float64") is not None:
            yield TEXTS(
                "fixed_point_energy", steps=state["energy_steps"], ours=state["energy_std"],
                unit=units.energy, float64=state["energy_std_float64"],
            )  # fmt: skip


def _pressure(run: RunView) -> Iterator[Any]:
    """Yield the contributions to the pressure, such as the kinetic contribution."""
    units, parts = run.units, run.summary.get("pressure")
    if not parts:
        return
    rows = TEXTS.rows("pressure", **vars(units), **parts)
    terms = [
        (f"Virial part of {name}", f"{number(one['mean'], 4)} {units.pressure}")
        for name, one in parts["terms"].items()
    ]
    at = [name for name, _ in rows].index("Virial part") + 1
    yield pairs([*rows[:at], *terms, *rows[at:]])
    if jump := parts["impulsive"]:
        whole = parts["total"]["mean"] + jump["mean"]
        barostat = " and by the barostat" * ("volume" in run.series)
        yield TEXTS("impulsive", whole=whole, barostat=barostat, unit=units.pressure)
        if jump["error"]:
            yield TEXTS("impulsive_resolved", errors=abs(jump["mean"]) / jump["error"])
    if parts["tail"] is None:
        yield TEXTS("no_tail")


def _flips_per_step(run: RunView) -> Iterator[Any]:
    series = run.series

    def draw(figure: Canvas) -> None:
        from matplotlib.ticker import MaxNLocator

        from mdnum.report.drawing import FIRST, MUTED, SECOND, THIRD, envelope, legend, line

        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        # no decision came before the first step, so it has no flips
        time = series["time"][1:]
        for name, color, sign in (("entered", FIRST, 1), ("left", SECOND, -1)):
            if len(time):
                low, middle, high, at = envelope(time, series[name][1:].astype(float), 240)
                above.fill_between(at, sign * low, sign * high, color=color, alpha=0.3, lw=0, step="mid")
                above.step(at, sign * middle, color=color, lw=1.1, where="mid", label=name)
        above.axhline(0, color=MUTED, lw=0.6)
        above.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
        above.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        line(below, series["time"], series["pairs"].astype(float), THIRD)
        below.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        below.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        above.set_ylabel("flips per step")
        below.set_ylabel("pairs inside")
        below.set_xlabel(f"time ({run.units.time})")
        legend(above)

    most = max(int(series[name].max(initial=0)) for name in ("entered", "left"))
    inside = f"{count(int(series['pairs'].min()))} to {count(int(series['pairs'].max()))}"
    alt = f"Flips in each step against time: at most {count(most)} enter or leave; pairs inside: {inside}."
    yield Figure("flips", TEXTS("flips_caption"), alt, draw, 3.5)
    if run.flips.total and run.steps:
        yield TEXTS("flip_rate", rate=run.flips.total / run.steps, pairs=run.flips.pairs)
        if "by_box" in series:
            caused = int(series["by_box"].sum(dtype=np.int64))
            yield TEXTS("by_box", flips=caused, share=caused / run.flips.total)
    else:
        yield TEXTS("no_flips")


def _margins(run: RunView) -> Iterator[Any]:
    ratio = run.flips.ratios
    ratio = ratio[np.isfinite(ratio)]
    # without a bound (whole numbers are compared) there is no unit to measure margins in
    if not len(ratio):
        return
    top = np.ceil(np.log10(max(ratio.max(initial=10.0), 10.0)))
    edges = np.arange(-1, top + 0.25, 0.25)
    counts, _ = np.histogram(np.log10(np.maximum(ratio, 0.1001)), edges)
    expected = run.expected_ambiguous
    # a density that is even near zero puts counts in proportion to the width of a bin
    even = expected * np.diff(10.0**edges)
    shown = (even >= 0.5) & (even <= 2 * counts.max())
    centers = 10.0 ** ((edges[1:] + edges[:-1]) / 2)
    seen = Series("flips", 10.0**edges, positive(np.append(counts, counts[-1])), "steps")
    evenly = Series("spread evenly", centers[shown], even[shown], role="muted", dashed=True)
    yield TEXTS.plot("margins", (seen, evenly), verticals=[(1.0, "below: decided by rounding")])
    closest, median = float(ratio.min()), float(np.median(ratio))
    yield TEXTS("margins", closest=closest, median=median, expected=expected)


def _chatter(run: RunView) -> Iterator[Any]:
    busiest, stays = run.flips.busiest, run.flips.stays
    if not len(busiest.i):
        return
    if stays.total > 1:
        steps = np.arange(len(stays.inside))
        longest = max(10, *(np.flatnonzero(one).max(initial=0) for one in (stays.inside, stays.outside)))
        edges = np.unique(np.round(np.geomspace(1, longest + 1, 36)))
        lines = {}
        for name, lengths in (("inside", stays.inside), ("outside", stays.outside)):
            # per step of width: bins of a few steps would otherwise look fuller than they are
            values = np.histogram(steps, edges, weights=lengths)[0] / np.diff(edges)
            lines[f"stays {name}"] = np.append(values, values[-1])
        yield TEXTS.plot("residence", curves(edges, lines, "steps"))
    undone = stays.undone_within(CHATTER_STEPS)
    yield TEXTS(
        "chatter", undone=undone, share=undone / run.flips.total, within=CHATTER_STEPS,
        inside=analysis.median(stays.inside), outside=analysis.median(stays.outside),
    )  # fmt: skip
    yield table_of(busiest.rows(_BUSIEST), {
        "pair (counted from 0)": pair_name, "flips": "flips",
        "one in … steps": lambda one: run.steps / one["flips"],
    }, "Pairs that flip most")  # fmt: skip


def _lists(run: RunView) -> Iterator[Any]:
    epochs = run.epochs
    if not len(epochs["epoch"]):
        return
    step = epochs["start"].astype(float)
    # of no skin nothing can be used up
    skin = np.where(np.isfinite(epochs["skin_consumed"]), epochs["skin_consumed"], np.nan).astype(float)
    bad = epochs["dangerous"].astype(bool) | (epochs["lost_pairs"] > 0)
    for name, values in (("lists", skin), ("lengths", epochs["length"].astype(float))):
        marked = Series("dangerous, or pairs lost", step[bad], values[bad], "points", "bad")
        series = (Series("lists", step, values, "points"), *[marked] * bool(bad.any()))
        yield TEXTS.plot(name, series, horizontals=[(1.0, "skin used up")] * (name == "lists"))
    # the last list was cut off by the end of the run: its length says nothing
    whole = epochs["reason"] != "end"
    lengths = epochs["length"][whole] if whole.any() else epochs["length"]
    reasons, counts = np.unique(epochs["reason"].astype(str), return_counts=True)
    consumed = {"median": float(np.median(skin)), "most": float(np.max(skin))}
    totals = {name: int(epochs[name].sum()) for name in ("dangerous", "lost_pairs", "lost_pair_steps")}
    yield pairs(TEXTS.rows(
        "lists", **totals, lists=len(skin), consumed=consumed if np.isfinite(skin).all() else None,
        ended=", ".join(f"{reason} {count(int(n))}" for reason, n in zip(reasons, counts, strict=True)),
        length=float(np.median(lengths)), shortest=int(lengths.min()), longest=int(lengths.max()),
        listed=float(np.mean(epochs["pairs_listed"])), grown=len(np.unique(epochs["capacity"])) - 1,
        used=float(np.max(epochs["occupancy"] / np.maximum(epochs["capacity"], 1))),
        build=float(np.median(epochs["build_ms"])),
    ))  # fmt: skip


def _nearest(run: RunView) -> Iterator[Any]:
    """Yield a table of the flips with the smallest margins, by step."""
    flips, units = run.flips.nearest, run.units
    if not len(flips["step"]):
        yield TEXTS("no_flips")
        return
    compare = str(run.cutoff.get("compare", "r2 <"))
    yield TEXTS("nearest", shown=len(flips["step"]), flips=run.flips.total, compare=compare)
    yield TEXTS.browse("flips", flips, compare=compare, **vars(units))


def _ranges(run: RunView) -> Iterator[Any]:
    """Yield a table: each quantity's range, and the first step outside the range of narrower formats."""
    examined, series, units = run.table("ranges"), run.series, vars(run.units)
    sums = columns({name: series[name][:, None] for name in ("potential", "kinetic")})
    sums["step"] = series["step"]
    yield analysis.range_table(lambda name: TEXTS(f"range_{name}", **units), examined, sums)
    yield TEXTS("ranges", examined=len(examined["step"]), steps=len(series["step"]))


def _ase(run: RunView) -> Iterator[Any]:
    ase, units = run.ase, run.units
    if ase.get("energy_rel") is None:
        yield TEXTS("not_compared")
        return
    if ase.get("reference"):
        key = "compared_sampled" if "sampled" in ase else "compared"
        yield TEXTS(key, reference=ase["reference"], sampled=ase.get("sampled"), atoms=run.summary["atoms"])
    rows = [("energy", ase["energy_rel"], "relative")]
    if ase.get("force_max") is not None:
        scale = ase.get("force_scale")
        share = f"; {number(ase['force_max'] / scale, 2)} of the force scale" if scale else ""
        rows.append(("forces", ase["force_max"], f"{units.energy}/{units.length}, largest component{share}"))
    if ase.get("stress_max") is not None:
        rows.append(("stress", ase["stress_max"], f"{units.energy}/{units.length}³, largest component"))
    yield Table(("quantity", "difference", ""), rows)
