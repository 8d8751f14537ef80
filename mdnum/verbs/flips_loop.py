"""Statistics and findings on neighbor lists and energies of a recorded loop."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mdnum.report.finding import Finding, Verdict, conclude
from mdnum.report.section import Section, curves, pairs
from mdnum.store import RunFolder
from mdnum.verbs.flips_shared import TEXTS, FlipsView

# energies whose steps go with flips: the slope over its error, and the share of the steps' variance; and how
# many times less an energy without its jumps varies
_CLEAR, _SHARE, _LESS = 5.0, 0.1, 2.0
_POINTS = 2_000


def loop_told(folder: RunFolder) -> dict[str, Any]:
    """Return statistics of the neighbor lists and energies of a recorded loop. None if not recorded."""
    loop = folder.read("loop")
    return {"lists": _lists_told(loop, folder), "energy": _energy_told(loop, folder)}


def _lists_told(loop: Mapping[str, np.ndarray], folder: RunFolder) -> dict[str, Any] | None:
    known, lost = loop["listed"] >= 0, folder.read("lost")
    frames, flagged = (np.flatnonzero(loop[name]) for name in ("lost", "overflow"))
    if not known.any():
        return None
    # a pair that is missing several times has as many rows
    keys = np.array([lost[name] for name in ("i", "j", "rank")])
    of = np.unique(keys, axis=1, return_inverse=True)[1].ravel()
    told: dict[str, Any] = {
        "lists": int(loop["new_list"].sum()), "frames": int(known.sum()), "lost": len(np.unique(of)),
        "times": len(of), "pair_frames": int(loop["lost"].sum()),
        "listed": float(loop["listed"][known].mean()), "lost_frames": len(frames),
        "first": int(loop["number"][frames[0]]) if len(frames) else None, "worst": None, "overflow": None,
    }  # fmt: skip
    if len(of):
        worst = {name: column[at := np.argmax(lost["deepest"])] for name, column in lost.items()}
        told["worst"] = {**worst, "frames": (lost["end"] - lost["begin"])[of == of[at]].sum()}
    if len(flagged):
        before = np.concatenate([[0], np.cumsum(loop["overflow"])])
        first, last = loop["number"][flagged[[0, -1]]].tolist()
        told["overflow"] = {
            "frames": len(flagged), "first": first, "last": last,
            "lost": len(np.unique(of[before[lost["end"]] > before[lost["begin"]]])),
            "deepest": float(loop["deepest"][flagged].max()),
        }  # fmt: skip
    return told


def _energy_told(loop: Mapping[str, np.ndarray], folder: RunFolder) -> dict[str, Any] | None:
    """Return statistics of the energy in a loop, such as the variance due to flips."""
    energy = loop["energy"]
    if len(energy) < 4 or not np.isfinite(energy).all():
        return None
    frames = folder.read("frames", ["rule", "entered", "left"])
    net = (frames["entered"] - frames["left"])[frames["rule"] == 0][1 - len(energy) :].astype(float)
    steps = np.diff(energy) - np.diff(energy).mean()
    told: dict[str, Any] = {
        "frames": len(energy), "change": float(energy[-1] - energy[0]), "spread": float(energy.std()),
        **dict.fromkeys(("slope", "error", "share", "jumps", "rest")),
    }  # fmt: skip
    if np.ptp(net) > 0 and steps.any():
        slope = float(net @ steps) / (scatter := len(net) * net.var())
        rest = float(((steps - slope * (net - net.mean())) ** 2).sum())
        told |= {
            "slope": slope,
            "error": np.sqrt(rest / (len(net) - 2) / scatter),
            "share": 1 - rest / (steps @ steps),
        }
    if np.isfinite(loop["energy_jump"]).all():
        jumps = np.cumsum(loop["energy_jump"])
        told |= {"jumps": float(jumps[-1]), "rest": float((energy - jumps).std())}
    return told


def findings(
    view: FlipsView, lists: Mapping[str, Any] | None, energy: Mapping[str, Any] | None
) -> Iterator[Finding]:
    """Yield findings on missing pairs, overflows of neighbor lists, and energy jumps."""
    if lists and (worst := lists["worst"]) is not None:
        values = {"pair": f"{worst['i']}–{worst['j']}", "missed": worst["frames"]}
        again, deepest = ["again"] * (lists["times"] > lists["lost"]), view.length(worst["deepest"])
        yield TEXTS.finding("LOST_PAIRS", *again, **{**lists, **values, "deepest": deepest})
    if lists and (overflow := lists["overflow"]) is not None:
        values = {**overflow, "deepest": view.length(overflow["deepest"])}
        yield TEXTS.finding("OVERFLOW", *["harmless"] * (not overflow["lost"]), **values)
    if energy and energy["rest"] is not None and energy["spread"] > _LESS * energy["rest"]:
        yield TEXTS.finding("ENERGY_STEPS", "known", **energy)
    elif energy and energy["rest"] is None and (energy["share"] or 0.0) > _SHARE:
        yield from [TEXTS.finding("ENERGY_STEPS", **energy)] * (
            abs(energy["slope"]) > _CLEAR * energy["error"]
        )


def sections(view: FlipsView) -> Iterator[Section]:
    """Yield sections on recorded neighbor lists and energies."""
    rows, energy = view.table("loop"), view.summary.get("energy")
    some = slice(None, None, -(-len(rows["number"]) // _POINTS) or 1)
    drawn = {"lists": {"pairs lost": rows["lost"].astype(float)}, "energy": {"energy": rows["energy"]}}
    if energy and energy["jumps"] is not None:
        drawn["energy"]["without what flips add"] = rows["energy"] - np.cumsum(rows["energy_jump"])
    for (name, lines), title in zip(drawn.items(), ("Neighbor lists", "Energy"), strict=True):
        if told := view.summary.get(name):
            shown = curves(rows["number"][some], {label: y[some] for label, y in lines.items()}, log=False)
            yield Section(title, [pairs(TEXTS.rows(name, **told)), TEXTS.plot(f"loop_{name}", shown)])


def unfinished(view: FlipsView) -> Verdict:
    """Return the verdict on a loop that ended without closing its recorder."""
    frames, one = view.table("frames"), view.summary["rules"][0]
    number, entered, left = (frames[name][frames["rule"] == 0] for name in ("number", "entered", "left"))
    flips, last = int((entered + left).sum()), int(number[-1])
    values = {"frames": len(number), "flips": flips, "last": last, "rule": view.rule(one)}
    found = [TEXTS.finding("NOT_CLOSED", **values), *findings(view, **loop_told(view.folder))]
    return conclude(found, headline=TEXTS("not_closed", **values))
