"""`mdnum fork certify` and `processes`: runs against exact arithmetic, and programs against each other."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.drawing import FIRST, MUTED
from mdnum.report.finding import Texts, Verdict, conclude
from mdnum.report.section import Figure, Key, Page, Plot, Role, Section, Series, Table, pairs
from mdnum.report.words import count, many, number
from mdnum.verbs import frame
from mdnum.verbs.fork_page import size
from mdnum.verbs.fork_pair import basics, of_any, of_md
from mdnum.verbs.frame import Outcome, Progress, View

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from mdnum.forks.exact.certify import Certificate
    from mdnum.forks.processes import Variant, Variants
    from mdnum.systems import BallSystem, System

TEXTS = Texts(__file__)

#: Steps of each program, unless others are asked for: enough for every cause to show.
PROGRAM_STEPS = 200
_ROLES: tuple[Role, ...] = ("first", "second", "third", "bad", "ink", "muted")
#: A share of what double precision gains that counts as nothing, and bits of error that do.
_NOTHING, _NO_BITS = 0.05, 1.0
_NARROW = ("float16", "bfloat16")


def fork_certify(
    system: System | BallSystem | str | Path,
    *,
    steps: int | None = None,
    policies: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """When runs in each precision leave the history in exact arithmetic.

    Args:
        system: a loaded system, a shipped name or the path of a system file: Lennard-Jones, NVE, at most 108
            atoms; or a ball whose steps are sums and products.
        steps: last step; default the system's own.
        policies: precisions to rank, by name: dtypes by role, such as {"state": "float32"}; default
            `MD_POLICIES` or `BALL_POLICIES` of `mdnum.forks.exact.certify`.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Returns:
        its result is a `mdnum.forks.exact.certify.Certificate`.

    Raises:
        InputError: the system cannot be certified.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.exact.certify import certify
    from mdnum.systems import BallSystem, build

    began = time.perf_counter()
    system = of_any(system, overrides)
    if steps is not None and steps < 1:
        raise InputError(f"steps = {steps}; expected at least 1")
    ball, simulation = None, None
    # what cannot be is refused before there is a folder; a ball takes no time
    if isinstance(system, BallSystem):
        ball = certify(system, steps, policies, progress)
    else:
        from mdnum.forks.exact.program import unsupported

        simulation = build(system)
        if (error := unsupported(simulation)) is not None:
            raise error
    with frame.new_folder("certify", f"fork-{system.name}", out, system=system) as folder:
        note = frame.logged(folder, progress, frame.STEPWISE)
        found = ball or certify(system, steps, policies, note)
        tables: dict[str, Any] = {}
        summary = basics(system, found.steps) | _certified(found, tables)
        if simulation is not None:
            summary |= _exact_md(found)
            summary["ambiguous"] = _ambiguous(simulation, found, note, tables)
        frame.store(folder, summary | {"seconds": time.perf_counter() - began}, tables)
    return frame.finish(folder, report=report, result=found, progress=progress)


def _certified(found: Certificate, tables: dict[str, Any]) -> dict[str, Any]:
    rows, table = [], []
    for row in found.ranking:
        decision, growth, separation = row.decision, row.growth, row.separation
        i, j = [*(decision.subject if decision else ()), -1, -1][:2]
        shared = {
            "horizon": row.horizon, "i": i, "j": j, "margin": plain(row.margin), "gain": plain(row.gain),
            "closer_bits": plain(row.closer), "growth_rate": None if growth is None else plain(growth.rate),
            "failed": row.failed,
        }  # fmt: skip
        rows.append({
            "name": row.name, **row.roles, **shared, "channel": decision.channel if decision else "",
            "subject": decision.subject if decision else None,
            "separation_end": None if separation is None else separation[-1],
            "reason_unavailable": row.reason_unavailable,
        })  # fmt: skip
        missing = {name: np.nan if shared[name] is None else shared[name]
                   for name in ("margin", "gain", "closer_bits", "growth_rate")}  # fmt: skip
        horizon = -1 if row.horizon is None else row.horizon
        table.append({"policy": row.name, "force": "", **row.roles, **shared, **missing, "horizon": horizon})
    tables["policies"] = {name: [row[name] for row in table] for name in table[0]}
    ran = [(row.name, row.separation) for row in found.ranking if row.separation is not None]
    tables["policy_separations"] = {
        "policy": np.concatenate([np.full(len(separation), name) for name, separation in ran]),
        "step": np.concatenate([np.arange(len(separation)) for _, separation in ran]),
        "separation": np.concatenate([separation for _, separation in ran]),
    }  # fmt: skip
    return {"steps_per_bit": plain(found.steps_per_bit), "policies": rows}


def _exact_md(found: Certificate) -> dict[str, Any]:
    exact = found.exact
    return {
        "bits": exact.bits, "restarts": exact.restarts, "flips": exact.tape.flips,
        "smallest_margin": exact.margin.min(), "smallest_margin_step": exact.margin.argmin(),
        "log2_radius_end": exact.radius[-1], "bits_per_step": exact.bits_per_step,
        "ms_per_step": 1000 * exact.seconds / (found.steps + 1),
    }  # fmt: skip


def _ambiguous(simulation: Any, found: Certificate, note: Progress, tables: dict[str, Any]) -> dict[str, Any]:
    """Each policy's decisions against their rounding bounds; the ambiguous ones in exact arithmetic too."""
    from mdnum.forks.certified import certified_horizon
    from mdnum.forks.exact.program import with_policy
    from mdnum.numerics import PrecisionPolicy

    numbers, rows = {}, []
    for k, row in enumerate(found.ranking):
        note(k, len(found.ranking), {"phase": "bounding decisions", "unit": "policies"})
        one = certified_horizon(with_policy(simulation, PrecisionPolicy(**row.roles)), found.steps)
        numbers[row.name] = {"total": one.total, "horizon": one.horizon, "wrong": one.wrong}
        rows += [{"policy": row.name, **vars(decision)} for decision in one.decisions]
    if rows:
        tables["ambiguous"] = {name: [row[name] for row in rows] for name in rows[0]}
    return numbers


def judge_certify(view: View) -> Verdict:
    """Which precisions keep the exact history, and which leave it when."""
    s = view.summary
    rows = [row for row in s["policies"] if row["reason_unavailable"] is None]
    left = [row for row in rows if row["horizon"] is not None]
    values = {"steps": s["steps"], "n": len(rows), "kept": len(rows) - len(left)}
    kind = "all" if not left else "some" if len(left) < len(rows) else "none"
    if left:
        first = min(left, key=lambda row: row["horizon"])
        values |= {"first": first["name"], "step": first["horizon"], "last": rows[0]["name"],
                   "last_step": rows[0]["horizon"]}  # fmt: skip
    found = []
    for row in rows:
        if row["failed"]:
            found.append(TEXTS.finding("RUN_FAILED", section="Ranking", **row))
    for name, one in (s.get("ambiguous") or {}).items():
        if one["wrong"] is not None:
            found.append(TEXTS.finding("WRONG_DECISION", section="Ranking", name=name, step=one["wrong"]))
    return conclude(found, headline=TEXTS(f"certify_{kind}", **values), best="info" if left else "good")


def _gains(s: Mapping[str, Any], roles: Sequence[str]) -> Iterator[str]:
    """What promoting single roles is worth against single precision throughout, or lowering them costs."""
    rows = s["policies"]
    by_dtype = {kind: next((row for row in rows if all(row[role] == kind for role in roles)), None)
                for kind in ("float32", "float64")}  # fmt: skip
    base, wide = by_dtype["float32"], by_dtype["float64"]
    if base is None or base["horizon"] is None:
        return
    for row in rows:
        if row in (base, wide) or row["reason_unavailable"] is not None:
            continue
        horizon, start, closer = row["horizon"], base["horizon"], row["closer_bits"]
        values = {**row, "base": start, "steps": (s["steps"] if horizon is None else horizon) - start}
        gain = row["gain"]
        if row.get("force") in _NARROW:
            kind = "narrow" if horizon is not None and horizon < start else "narrow_free"
            values["lost"] = -values["steps"]
        elif horizon is None:
            kind = "all"
        elif horizon <= start:
            kind = "none"
        elif closer is not None and closer < _NO_BITS:
            # a horizon hangs on one pair; what is not closer to the exact run was lucky, not better
            kind = "nothing" if gain is not None and gain < _NOTHING else "lucky"
        else:
            kind = "some" if gain is not None else "steps"
        text = TEXTS(f"gain_{kind}", **values)
        if closer is not None:
            side = "same" if abs(closer) < 0.05 else "closer" if closer > 0 else "further"
            text += " " + TEXTS(f"positions_{side}", bits=abs(closer))
        yield text


def page_certify(view: View, verdict: Verdict) -> Page:
    """The page of a ranking of precisions."""
    s, ball = view.summary, "balls" in view.summary
    rows, unit = s["policies"], view.units.length
    roles = [role for role in ("state", "force", "arithmetic", "decision", "accumulate") if role in rows[0]]
    kept = sum(row["horizon"] is None and row["reason_unavailable"] is None for row in rows)
    keys = [
        Key("Keep to it", f"{count(kept)} of {count(len(rows))}", f"for {many(s['steps'], 'step')}"),
        Key("One more bit", number(s["steps_per_bit"]), "steps gained, by the growth seen"),
    ]
    if not ball:
        step, per = count(s["smallest_margin_step"]), f"{number(s['ms_per_step'], 2)} ms"
        keys += [
            Key(
                "Closest decision", number(s["smallest_margin"], 2), f"{unit}², in the exact run, step {step}"
            ),
            Key("Exact flips", count(s["flips"]), "in time, all proven"),
            Key("Carried", f"{count(s['bits'])} bits", f"{count(s['restarts'])} restarts with more"),
            Key("Exact step", per, f"{number(s['seconds'], 2)} s in all"),
        ]
    ambiguous = s.get("ambiguous") or {}
    counts = ("ambiguous", "from step") if ambiguous else ()
    columns = ("precision", "leaves the exact history at", "decision", "margin", "bits closer",
               "growth a step", f"separation at the end ({unit})", *counts, "")  # fmt: skip
    lines = []
    for row in rows:
        doubt = ambiguous.get(row["name"]) or {"total": None, "horizon": None}
        reason, subject = row["reason_unavailable"], row["subject"]
        at = (
            "–"
            if reason
            else f"beyond {count(s['steps'])}"
            if row["horizon"] is None
            else count(row["horizon"])
        )
        which = None if subject is None else f"{row['channel']} {'–'.join(map(str, subject))}"
        counted = (doubt["total"], doubt["horizon"]) if ambiguous else ()
        lines.append((row["name"], at, which, row["margin"], row["closer_bits"], row["growth_rate"],
                      row["separation_end"], *counted, reason or row["failed"]))  # fmt: skip
    dtypes = Table(
        ("precision", *roles), [(row["name"], *(row[role] for role in roles)) for row in rows], "Dtypes"
    )
    kept_by = "; ".join(f"{line[0]} {line[1]}" for line in lines)
    figure = Figure(
        "ranking", TEXTS("ranking_caption"), f"Steps kept of {s['steps']}, by precision: {kept_by}.",
        lambda canvas: _bars(s, canvas), 0.8 + 0.34 * len(rows),
    )  # fmt: skip
    table, series = view.table("policy_separations"), []
    for k, row in enumerate(rows):
        mine = table["policy"] == row["name"]
        separation = table["separation"][mine]
        if np.any(separation > 0):
            shown = np.where(separation > 0, separation, np.nan)
            role = _ROLES[k % len(_ROLES)]
            series.append(Series(row["name"], table["step"][mine], shown, role=role, dashed=k >= len(_ROLES)))
    plots = [Plot(
        "separations", "Separation of real runs from the exact one", "step",
        f"largest distance from the exact place ({unit})", tuple(series), y_scale="log",
        caption=TEXTS("separations_caption"),
    )] if series else []  # fmt: skip
    world = "ball" if ball else "md"
    what = [*size(view), ("Exact", TEXTS(f"exact_{world}")), ("Took", f"{number(s['seconds'], 2)} s")]
    sections = [
        Section("Ranking", [Table(columns, lines, shown=100), *_gains(s, roles)], terminal=True),
        Section("Steps kept", [figure, dtypes]),
        Section("Separation from the exact run", plots),
        Section("What was run", [pairs(what), *([TEXTS("ambiguous")] if ambiguous else [])]),
    ]
    return Page(f"{view.name}: precisions", TEXTS("certify_about"), keys,
                [one for one in sections if one.parts], view.system_toml, view.folder.provenance)  # fmt: skip


def _bars(s: Mapping[str, Any], figure: Canvas) -> None:
    """A bar per precision, as long as it keeps to the exact history."""
    axes, rows, last = figure.subplots(), s["policies"], s["steps"]
    place = np.arange(len(rows))[::-1]
    ends = [last if row["horizon"] is None else row["horizon"] for row in rows]
    axes.barh(place, [0 if row["reason_unavailable"] else end for row, end in zip(rows, ends, strict=True)],
              height=0.55, color=FIRST, alpha=0.7, lw=0)  # fmt: skip
    for at, row in zip(place, rows, strict=True):
        doubt = (s.get("ambiguous") or {}).get(row["name"], {}).get("horizon")
        if doubt is not None:
            axes.plot(doubt, at, "o", ms=5, mfc="none", mec=MUTED)
    axes.set_yticks(place, [row["name"] for row in rows], fontsize=8.5)
    axes.set_xlim(0, 1.02 * last)
    axes.set_xlabel("leaves the exact history at step")


# -- programs ------------------------------------------------------------------------------------------


def fork_processes(
    system: System | str | Path,
    *,
    steps: int | None = None,
    which: Sequence[Variant] | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Outcome:
    """Run a system jitted, eagerly, in a batch, in a gradient and under flags of XLA, and find which agree.

    Args:
        system: a loaded system, a shipped name or the path of a system file; pair potentials only.
        steps: of each program; default 200, or the system's own where they are fewer.
        which: the variants; default `mdnum.forks.processes.VARIANTS`.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"precision.force": "float32"}.
        report: write report.html.
        progress: called now and then with variants done, how many there are, and a dictionary of figures.

    Returns:
        its result is a `mdnum.forks.processes.Variants`.

    Raises:
        InputError: the system cannot be run, or its potential is a many-body one.
        FolderError: the folder cannot be used.
        MdnumError: not one of the variants ran.
    """
    from mdnum.forks.choices.base import is_pairwise
    from mdnum.forks.processes import VARIANTS, variants

    began = time.perf_counter()
    loaded = of_md(system, overrides, "processes")
    last = min(PROGRAM_STEPS, loaded.spec.dynamics.steps) if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    if not is_pairwise(loaded):
        raise InputError(
            "the programs of a many-body potential are not compared",
            where=loaded.name,
            remedy="Use a system with a pair potential",
        )
    asked = VARIANTS if which is None else tuple(which)
    with frame.new_folder("processes", f"fork-{loaded.name}", out, system=loaded) as folder:
        note = frame.logged(folder, progress, frame.STEPWISE)

        def ended(done: int, of: int, name: str) -> None:
            note(done, of, {"phase": "running in processes of their own", "unit": "variants"})
            if name:
                folder.log(f"  {name} has ended")

        ended(0, len(asked), "")
        found = variants(loaded, last, asked, ended)
        tables: dict[str, Any] = {}
        summary = basics(loaded, found.steps) | {"steps_asked": last} | _programs(found, tables)
        frame.store(folder, summary | {"seconds": time.perf_counter() - began}, tables)
    return frame.finish(folder, report=report, result=found, progress=progress)


def _programs(found: Variants, tables: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for row in found.rows:
        one = row.variant
        rows.append({
            "variant": one.name, "program": one.program, "flags": " ".join(one.flags),
            "reduction": one.reduction or "", "cluster": None if row.failed else row.cluster,
            "first_bit": row.first_bit, "steps": len(row.hashes), "separation": row.separation,
            "seconds": row.seconds, "hash": row.hashes[-1] if row.hashes else "", "failed": row.failed,
        })  # fmt: skip
    table = [
        {**row, **{key: -1 if row[key] is None else row[key] for key in ("cluster", "first_bit")}}
        for row in rows
    ]
    tables["variants"] = {name: [row[name] for row in table] for name in table[0]}
    sized = [row for row in found.rows if len(row.separations)]
    if sized:
        tables["variant_separations"] = {
            "variant": np.concatenate([np.full(len(row.separations), row.variant.name) for row in sized]),
            "step": np.concatenate([np.arange(1, len(row.separations) + 1) for row in sized]),
            "separation": np.concatenate([row.separations for row in sized]),
        }
    failed = [row.variant.name for row in found.rows if row.failed]
    return {"reference": found.reference, "clusters": found.clusters, "causes": found.causes,
            "failed_variants": failed, "variants": rows}  # fmt: skip


def judge_processes(view: View) -> Verdict:
    """How many different trajectories the programs of one system compute."""
    s = view.summary
    seeds = [row["first_bit"] for row in s["variants"] if row["first_bit"] is not None]
    ran, clusters = len(s["variants"]) - len(s["failed_variants"]), len(s["clusters"])
    values = {"ran": ran, "clusters": clusters, "steps": s["steps"], "reference": s["reference"]}
    kind = "differ" if clusters > 1 else "same" if ran > 1 else "alone"
    found = [
        TEXTS.finding("VARIANT_FAILED", section="Programs", **row) for row in s["variants"] if row["failed"]
    ]
    if s["steps"] < s["steps_asked"]:
        found.append(TEXTS.finding("SKIN_USED_UP", steps=s["steps"], asked=s["steps_asked"]))
    headline = TEXTS(f"programs_{kind}", step=min(seeds, default=None), **values)
    return conclude(found, headline=headline, best="good" if kind == "same" else "info")


def page_processes(view: View, verdict: Verdict) -> Page:
    """The page of a comparison of programs."""
    s, length = view.summary, view.units.length
    ran = [row for row in s["variants"] if not row["failed"]]
    seeds = [row["first_bit"] for row in ran if row["first_bit"] is not None]
    failed = len(s["failed_variants"])
    keys = [
        Key("Programs", count(len(ran)), f"{count(failed)} more did not run" if failed else "all ran"),
        Key("Trajectories", count(len(s["clusters"])), "that differ in a bit"),
        Key("With the reference", count(len(s["clusters"][0])), f"{s['reference']} included"),
        Key(
            "First bit", f"step {count(min(seeds))}" if seeds else "–", "differs" if seeds else "none differs"
        ),
        Key(
            "Separation", number(max(row["separation"] for row in ran)), f"{length}, at the last step at most"
        ),
    ]
    rows = []
    for row in sorted(s["variants"], key=lambda row: (row["cluster"] is None, row["cluster"] or 0)):
        about = TEXTS(f"program_{row['program']}") + (
            f"; force sums {row['reduction']}" * bool(row["reduction"])
        )
        leaves = "reference" if row["variant"] == s["reference"] else row["first_bit"]
        cluster = None if row["cluster"] is None else row["cluster"] + 1
        rows.append((cluster, row["variant"], row["failed"] or about, row["flags"],
                     None if row["failed"] else leaves, row["steps"] or None,
                     row["separation"], row["hash"][:12], row["seconds"]))  # fmt: skip
    columns = (
        "cluster",
        "program",
        "",
        "flags",
        "first differing bit",
        "steps",
        f"separation ({length})",
        "hash",
        "s",
    )
    table, series = view.table("variant_separations"), []
    for k, names in enumerate(s["clusters"]):
        longest = max((table["variant"] == name for name in names), key=np.count_nonzero)
        step, separation = table["step"][longest], table["separation"][longest]
        if k and np.any(separation > 0):
            shown = np.where(separation > 0, separation, np.nan)
            series.append(Series("; ".join(names), step, shown, role=_ROLES[(k - 1) % len(_ROLES)]))
    plots = [Plot(
        "separations", "Separation of programs from the reference", "step",
        f"largest distance from the reference ({length})", tuple(series), y_scale="log",
        caption=TEXTS("programs_caption"),
    )] if series else []  # fmt: skip
    causes = [_cause(**cause) for cause in s["causes"]]
    what = [*size(view), ("Programs", TEXTS("programs")), ("Took", f"{number(s['seconds'], 2)} s")]
    sections = [
        Section("Programs", [*causes, Table(columns, rows)], terminal=True),
        Section("Separation from the reference", plots),
        Section("What was run", [pairs(what)]),
    ]
    return Page(f"{view.name}: programs", TEXTS("programs_about"), keys,
                [one for one in sections if one.parts], view.system_toml, view.folder.provenance)  # fmt: skip


def _cause(code: str, names: Sequence[str] = (), program: str = "", **values: Any) -> str:
    what = TEXTS(f"cause_of_{program}") if program else ""
    return TEXTS(f"cause_{code}", names=", ".join(names), what=what, **values)


VERBS = {
    "certify": frame.Verb(judge_certify, page_certify),
    "processes": frame.Verb(judge_processes, page_processes),
}
