"""`mdnum fork certify`: comparison with exact arithmetic. `mdnum fork processes`: program variants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.plain import plain
from mdnum.report.drawing import FIRST, MUTED
from mdnum.report.finding import Texts, Verdict, conclude
from mdnum.report.section import Figure, Page, Section, Series, curves, pairs, table_of
from mdnum.report.words import count
from mdnum.verbs import frame
from mdnum.verbs.fork_page import size
from mdnum.verbs.fork_pair import basics, last_step, of_md
from mdnum.verbs.frame import Answer, Keep, Outcome, View

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from mdnum.forks.processes import Variant
    from mdnum.systems import BallSystem, System
    from mdnum.systems.simulation import Simulation

TEXTS = Texts(__file__)

#: Default number of steps of each program, sufficient to reveal every cause.
PROGRAM_STEPS = 200
#: Share of the gain of double precision that counts as none, and the same for bits of error.
_NOTHING, _NO_BITS = 0.05, 1.0
_NARROW = ("float16", "bfloat16")


@frame.keywords_checked
def fork_certify(
    system: Simulation | System | BallSystem | str | Path,
    *,
    steps: int | None = None,
    policies: Mapping[str, Any] | None = None,
    **keep: Unpack[Keep],
) -> Outcome:
    """Find the first step at which decisions differ from exact arithmetic, for each precision.

    Example:
        >>> mdnum.fork_certify("argon/crystal-108", steps=100)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file: one pair potential, NVE,
            at most 108 atoms; or a ball whose steps consist of sums and products.
        steps: last step; by default the system's own.
        policies: precisions to rank: for each name, the dtypes by role, such as {"state": "float32"}; default
            `MD_POLICIES` or `BALL_POLICIES` of `mdnum.forks.exact.certify`.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.exact.certify.Certificate`.

    Raises:
        InputError: the system cannot be certified.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.exact.certify import certify
    from mdnum.forks.exact.program import unsupported
    from mdnum.systems import BallSystem, opened

    loaded = opened(system, keep.get("overrides"))
    last, ball = last_step(loaded, steps), isinstance(loaded, BallSystem)
    # what cannot be is refused before there is a folder; a ball takes no time
    found: Any = certify(loaded, last, policies, keep.get("progress")) if ball else None
    simulation: Any = None if ball else loaded
    if simulation is not None and (error := unsupported(simulation)) is not None:
        raise error
    with frame.answering("certify", f"fork-{loaded.name}", loaded, **keep) as answer:
        answer.result = found = found or certify(loaded, last, policies, answer.log)
        answer.summary = basics(loaded, last) | {"steps_per_bit": found.steps_per_bit}
        answer.summary["policies"] = _ranking(answer)
        if simulation is not None:
            exact = found.exact
            answer.summary |= {
                "bits": exact.bits, "restarts": exact.restarts, "flips": exact.tape.flips,
                "smallest_margin": exact.margin.min(), "smallest_margin_step": exact.margin.argmin(),
                "log2_radius_end": exact.radius[-1], "bits_per_step": exact.bits_per_step,
                "ms_per_step": 1000 * exact.seconds / (last + 1), "ambiguous": _ambiguous(simulation, answer),
            }  # fmt: skip
    return answer.outcome


def _ranking(answer: Answer) -> list[dict[str, Any]]:
    """Return the ranking of precisions. Store tables of the ranking and of distances from the exact run."""
    ranking, rows, table = answer.result.ranking, [], []
    for row in ranking:
        decision, growth, separation = row.decision, row.growth, row.separation
        i, j = [*(decision.subject if decision else ()), -1, -1][:2]
        shared = {"horizon": row.horizon, "i": i, "j": j, "margin": row.margin, "gain": row.gain,
                  "closer_bits": row.closer, "growth_rate": growth.rate if growth else np.nan,
                  "failed": row.failed}  # fmt: skip
        rows.append({
            "name": row.name, **row.roles, **shared, "channel": decision.channel if decision else "",
            "subject": decision.subject if decision else None,
            "separation_end": None if separation is None else separation[-1],
            "reason_unavailable": row.reason_unavailable,
        })  # fmt: skip
        horizon = -1 if row.horizon is None else row.horizon
        table.append({"policy": row.name, "force": "", **row.roles, **shared, "horizon": horizon})
    ran = {row.name: row.separation for row in ranking if row.separation is not None}
    answer.tables = {"policies": table, "policy_separations": _lines("policy", ran)}
    return plain(rows)


def _lines(name: str, lines: Mapping[str, np.ndarray], first: int = 0) -> dict[str, Any]:
    """Join named series of distances into a table with the columns name, step and separation."""
    return {
        name: np.concatenate([np.full(len(line), key) for key, line in lines.items()]),
        "step": np.concatenate([first + np.arange(len(line)) for line in lines.values()]),
        "separation": np.concatenate(list(lines.values())),
    } if lines else {}  # fmt: skip


def _ambiguous(simulation: Any, answer: Answer) -> dict[str, Any]:
    """Count the decisions with margins below rounding bounds, and evaluate them exactly."""
    from mdnum.forks.certified import certified_horizon
    from mdnum.numerics import PrecisionPolicy

    numbers, rows, ranking = {}, [], answer.result.ranking
    for k, row in enumerate(ranking):
        frame.say(answer.log, "bounding decisions", k, len(ranking), unit="policies")
        sure = certified_horizon(simulation.with_policy(PrecisionPolicy(**row.roles)), answer.result.steps)
        numbers[row.name] = {"total": sure.total, "horizon": sure.horizon, "wrong": sure.wrong}
        rows += [{"policy": row.name, **vars(decision)} for decision in sure.decisions]
    answer.tables["ambiguous"] = rows
    return numbers


def judge_certify(view: View) -> Verdict:
    """Return the verdict: for how many steps the decisions of each precision are exact."""
    s = view.summary
    rows = [row for row in s["policies"] if row["reason_unavailable"] is None]
    left = [row for row in rows if row["horizon"] is not None]
    values = {"steps": s["steps"], "n": len(rows), "kept": len(rows) - len(left)}
    kind = "all" if not left else "some" if len(left) < len(rows) else "none"
    if left:
        first = min(left, key=lambda row: row["horizon"])
        values |= {"first": first["name"], "step": first["horizon"], "last": rows[0]["name"],
                   "last_step": rows[0]["horizon"]}  # fmt: skip
    found = [TEXTS.finding("RUN_FAILED", section="Ranking", **row) for row in rows if row["failed"]]
    found += [
        TEXTS.finding("WRONG_DECISION", section="Ranking", name=name, step=one["wrong"])
        for name, one in (s.get("ambiguous") or {}).items() if one["wrong"] is not None
    ]  # fmt: skip
    return conclude(found, headline=TEXTS(f"certify_{kind}", **values), best="info" if left else "good")


def _gains(s: Mapping[str, Any], roles: Sequence[str]) -> Iterator[str]:
    """Yield sentences on how precision changes the number of steps with exact decisions."""
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
    """Return the report page of a ranking of precisions."""
    s, ball, unit = view.summary, "balls" in view.summary, view.units.length
    rows, ambiguous, steps = s["policies"], s.get("ambiguous") or {}, s["steps"]
    roles = [role for role in ("state", "force", "arithmetic", "decision", "accumulate") if role in rows[0]]
    kept = sum(row["horizon"] is None and row["reason_unavailable"] is None for row in rows)
    of_a_run = dict.fromkeys(("smallest_margin", "flips", "bits", "ms_per_step"))
    keys = TEXTS.keys("keys_certify", **{**of_a_run, **s, "kept": kept, "of": len(rows), "unit": unit})

    def leaves(row: Mapping[str, Any]) -> str:
        if row["reason_unavailable"]:
            return "–"
        return f"beyond {count(steps)}" if row["horizon"] is None else count(row["horizon"])

    def doubt(name: str) -> Any:
        return lambda row: (ambiguous.get(row["name"]) or {}).get(name)

    ranking = table_of(rows, {
        "precision": "name", "first differs from exact at": leaves,
        "decision": lambda row: row["subject"] and f"{row['channel']} {'–'.join(map(str, row['subject']))}",
        "margin": "margin", "bits closer": "closer_bits", "growth a step": "growth_rate",
        f"separation at the end ({unit})": "separation_end",
        **({"ambiguous": doubt("total"), "from step": doubt("horizon")} if ambiguous else {}),
        "": lambda row: row["reason_unavailable"] or row["failed"],
    }, shown=100)  # fmt: skip
    dtypes = table_of(rows, {"precision": "name", **{role: role for role in roles}}, "Dtypes")
    kept_by = "; ".join(f"{row['name']} {leaves(row)}" for row in rows)
    figure = Figure(
        "ranking", TEXTS("ranking_caption"), f"Steps with exact decisions ({steps} in all): {kept_by}.",
        lambda canvas: _bars(s, canvas), 0.8 + 0.34 * len(rows),
    )  # fmt: skip
    series = _drawn(view.table("policy_separations"), {row["name"]: row["name"] for row in rows})
    plots = [TEXTS.plot("separations", series, unit=unit)] * bool(series)
    what = [*size(view), ("Exact", TEXTS("exact_ball" if ball else "exact_md")), view.took]
    return view.page(f"{view.name}: precisions", TEXTS("certify_about"), keys, [
        Section("Ranking", [ranking, *_gains(s, roles)], terminal=True),
        Section("Steps kept", [figure, dtypes]),
        Section("Separation from the exact run", plots),
        Section("What was run", [pairs(what), *[TEXTS("ambiguous")] * bool(ambiguous)]),
    ])  # fmt: skip


def _drawn(table: Mapping[str, np.ndarray], labels: Mapping[str, str]) -> tuple[Series, ...]:
    """Return a plot series for each selected name in a table of `_lines`."""
    names = next(iter(table.values()))
    steps = np.unique(table["step"])
    lines = {label: np.full(len(steps), np.nan) for label in labels.values()}
    for name, label in labels.items():
        mine = names == name
        lines[label][np.searchsorted(steps, table["step"][mine])] = table["separation"][mine]
    return curves(steps, lines)


def _bars(s: Mapping[str, Any], figure: Canvas) -> None:
    """Draw a bar for each precision. The length is the number of steps with exact decisions."""
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
    axes.set_xlabel("first decision that differs from exact, step")


# -- programs ------------------------------------------------------------------------------------------


@frame.keywords_checked
def fork_processes(
    system: Simulation | System | str | Path,
    *,
    steps: int | None = None,
    which: Sequence[Variant] | None = None,
    **keep: Unpack[Keep],
) -> Outcome:
    """Run a system in several ways (jit, eager, batched, differentiated, or with XLA flags). Compare results.

    Example:
        >>> mdnum.fork_processes("argon/crystal-108", steps=100)

    Args:
        system: a simulation, a system, a shipped name or the path of a system file; pair potentials only.
        steps: number of steps of each program; default 200, or the system's own if smaller.
        which: the variants; default `mdnum.forks.processes.VARIANTS`.
        keep: see `mdnum.verbs.frame.Keep`.

    Returns:
        an outcome whose result is a `mdnum.forks.processes.Variants`.

    Raises:
        InputError: the system cannot be run, or its potential is a many-body potential.
        FolderError: the folder cannot be used.
        MdnumError: none of the variants ran.
    """
    from mdnum.forks.processes import VARIANTS, in_a_file, variants

    loaded = of_md(system, keep.get("overrides"), "processes", pairwise=True)
    in_a_file(loaded)
    last, asked = last_step(loaded, steps, PROGRAM_STEPS), VARIANTS if which is None else tuple(which)
    with frame.answering("processes", f"fork-{loaded.name}", loaded, **keep) as answer:

        def ended(done: int, of: int, name: str) -> None:
            frame.say(answer.log, "running in processes of their own", done, of, unit="variants")
            if name:
                answer.folder.log(f"  {name} has ended")

        ended(0, len(asked), "")
        answer.result = found = variants(loaded, last, asked, ended)
        rows = [{
            "variant": row.variant.name, "program": row.variant.program, "flags": " ".join(row.variant.flags),
            "reduction": row.variant.reduction or "", "cluster": None if row.failed else row.cluster,
            "first_bit": row.first_bit, "steps": len(row.hashes), "separation": row.separation,
            "seconds": row.seconds, "hash": row.hashes[-1] if row.hashes else "", "failed": row.failed,
        } for row in found.rows]  # fmt: skip
        answer.summary = basics(loaded, found.steps) | {
            "steps_asked": last, "reference": found.reference, "clusters": found.clusters,
            "causes": [_cause(**cause) for cause in found.causes],
            "failed_variants": [row["variant"] for row in rows if row["failed"]], "variants": rows,
        }  # fmt: skip
        apart = {row.variant.name: row.separations for row in found.rows if len(row.separations)}
        answer.tables = {
            "variants": [
                {**row, **{key: -1 if row[key] is None else row[key] for key in ("cluster", "first_bit")}}
                for row in rows
            ],
            "variant_separations": _lines("variant", apart, first=1),
        }
    return answer.outcome


def _cause(code: str, names: Sequence[str] = (), program: str = "", **values: Any) -> str:
    what = TEXTS(f"cause_of_{program}") if program else ""
    return TEXTS(f"cause_{code}", names=", ".join(names), what=what, **values)


def judge_processes(view: View) -> Verdict:
    """Return the verdict: the number of different trajectories of one program."""
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
    """Return the report page of a comparison of program variants."""
    s, length = view.summary, view.units.length
    ran = [row for row in s["variants"] if not row["failed"]]
    seeds = [row["first_bit"] for row in ran if row["first_bit"] is not None]
    keys = TEXTS.keys(
        "keys_processes", ran=len(ran), failed=len(s["failed_variants"]) or None, clusters=len(s["clusters"]),
        alike=len(s["clusters"][0]), reference=s["reference"], first_bit=min(seeds, default=None),
        furthest=max(row["separation"] for row in ran), length=length,
    )  # fmt: skip

    def program(row: Mapping[str, Any]) -> str:
        sums = f"; force sums {row['reduction']}" * bool(row["reduction"])
        return row["failed"] or TEXTS(f"program_{row['program']}") + sums

    def leaves(row: Mapping[str, Any]) -> Any:
        return "reference" if row["variant"] == s["reference"] else row["first_bit"]

    rows = sorted(s["variants"], key=lambda row: (row["cluster"] is None, row["cluster"] or 0))
    programs = table_of(rows, {
        "cluster": lambda row: None if row["cluster"] is None else row["cluster"] + 1,
        "program": "variant", "": program, "flags": "flags",
        "first differing bit": leaves,
        "steps": lambda row: row["steps"] or None, f"separation ({length})": "separation",
        "hash": lambda row: row["hash"][:12], "s": "seconds",
    })  # fmt: skip
    table = view.table("variant_separations")
    # the longest of each cluster stands for it
    longest = {max(names, key=lambda name: np.count_nonzero(table["variant"] == name)): "; ".join(names)
               for names in s["clusters"][1:]}  # fmt: skip
    series = _drawn(table, longest)
    plots = [TEXTS.plot("programs", series, unit=length)] * bool(series)
    return view.page(f"{view.name}: programs", TEXTS("programs_about"), keys, [
        Section("Programs", [*s["causes"], programs], terminal=True),
        Section("Separation from the reference", plots),
        Section("What was run", [pairs([*size(view), ("Programs", TEXTS("programs")), view.took])]),
    ])  # fmt: skip


KINDS = {
    "certify": frame.Verb(judge_certify, page_certify),
    "processes": frame.Verb(judge_processes, page_processes),
}
