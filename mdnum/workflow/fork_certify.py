"""`mdnum fork SYSTEM --certify` as a function: real runs against exact arithmetic, into a folder."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.workflow.fork import refuse
from mdnum.workflow.fork_numbers import plain
from mdnum.workflow.fork_question import Log, Progress, basics, finish, is_ball, loaded, opened

if TYPE_CHECKING:
    from mdnum.forks.exact.bounds import CertifiedHorizon
    from mdnum.forks.exact.certify import Certificate
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.build import Simulation
    from mdnum.systems.load import System


@dataclass(frozen=True)
class CertifyResult:
    """A finished ranking of precision policies.

    Attributes:
        folder: the fork folder; None of a ball, whose ranking leaves none.
        certificate: the exact history, and when each policy leaves it.
        ambiguous: decisions of each policy's run that are within their rounding bound, by its name; empty of
            a ball.
        summary: what summary.json says, findings included.
    """

    folder: Path | None
    certificate: Certificate
    ambiguous: Mapping[str, CertifiedHorizon]
    summary: dict[str, Any]


def fork_certify(
    system: System | BallSystem | str | Path,
    *,
    steps: int | None = None,
    policies: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool | None = None,
    progress: Progress | None = None,
) -> CertifyResult:
    """When runs under each precision policy leave the history in exact arithmetic.

    Args:
        system: a loaded system, a shipped name or the path of a system file: Lennard-Jones, NVE, at most 108
            atoms; or a ball whose steps are sums and products.
        steps: last step; default the system's own.
        policies: precisions to rank, by name: dtypes by role, such as {"state": "float32"}; default
            `MD_POLICIES` or `BALL_POLICIES` of `forks.exact.certify`.
        out: the new fork folder; default runs/fork-<name>-<n>. That of a ball is printed, and leaves none.
        overrides: dotted keys to values.
        report: write report.html; default yes where there is a folder.
        progress: called now and then with step, steps and a dictionary of figures.

    Raises:
        InputError: the system cannot be certified.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.exact.certify import certify
    from mdnum.forks.exact.program import unsupported
    from mdnum.systems import build
    from mdnum.workflow.fork_words import md_ranking

    if is_ball(system):
        refuse(
            {"out": out is not None, "report": bool(report)},
            "of molecular dynamics: the ranking of a ball leaves no folder",
            "Read it from the result",
        )
        return _of_a_ball(system, steps, policies, overrides, progress)
    began = time.perf_counter()
    system = loaded(system, overrides)
    simulation = build(system)
    error = unsupported(simulation)
    if error is not None:
        raise error
    last = system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    folder = opened(system, "certify", out)
    try:
        note = Log(folder, progress)
        found = certify(system, last, policies, note)
        ambiguous = _ambiguous(simulation, found, note)
        _write(folder, found, ambiguous)
        for sentence in md_ranking(found):
            folder.log(sentence)
        folder.finalize()
        summary = {
            **basics(system, "certify", last),
            **_numbers(found),
            "ambiguous": {
                name: {"total": one.total, "horizon": one.horizon, "wrong": one.wrong}
                for name, one in ambiguous.items()
            },
            "seconds": time.perf_counter() - began,
        }
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    return CertifyResult(folder.path, found, ambiguous, finish(folder, report is not False, progress))


def _of_a_ball(
    system: Any,
    steps: int | None,
    policies: Any,
    overrides: Mapping[str, Any] | None,
    progress: Progress | None,
) -> CertifyResult:
    """The ranking of a ball."""
    from mdnum.forks.exact.certify import certify
    from mdnum.workflow.fork import loaded_of_any
    from mdnum.workflow.fork_words import ball_ranking

    ball: Any = loaded_of_any(system, overrides)
    found = certify(ball, steps, policies, progress=progress)
    rows = [_ball_row(row) for row in found.ranking]
    summary = {"question": "certify", "steps": found.steps, "says": ball_ranking(found), "ranking": rows}
    return CertifyResult(None, found, {}, summary)


def _ball_row(row: Any) -> dict[str, Any]:
    decision = row.decision
    return {
        "policy": row.name,
        "horizon": row.horizon,
        "channel": decision.channel if decision else "",
        "ball": decision.subject[0] if decision else -1,
        "height": -row.margin if decision else None,
        "separation_end": None if row.separation is None else float(row.separation[-1]),
        "why_not": row.reason_unavailable,
    }


def _numbers(found: Certificate) -> dict[str, Any]:
    """Plain numbers for a summary; None is for what is unknown or never happened."""
    from mdnum.workflow.fork_words import md_ranking

    exact = found.exact
    policies = [
        {
            "name": row.name,
            **row.roles,
            "horizon": row.horizon,
            "pair": list(row.decision.subject) if row.decision else None,
            "inside_exact": bool(row.decision.a) if row.decision else None,
            "margin": plain(row.margin),
            "gain": plain(row.gain),
            "closer_bits": plain(row.closer),
            "growth_rate": plain(row.growth.rate),  # type: ignore[union-attr]
            "separation_end": plain(row.separation[-1]),  # type: ignore[index]
            "failed": row.failed or None,
        }
        for row in found.ranking
    ]
    return {
        "steps": found.steps,
        "bits": exact.bits,
        "restarts": exact.restarts,
        "flips": exact.tape.flips,
        "smallest_margin": float(exact.margin.min()),
        "smallest_margin_step": int(exact.margin.argmin()),
        "log2_radius_end": plain(exact.radius[-1]),
        "bits_per_step": plain(exact.bits_per_step),
        "ms_per_step": 1000 * exact.seconds / (found.steps + 1),
        "steps_per_bit": plain(found.steps_per_bit),
        "policies": policies,
        "says": list(md_ranking(found)),
    }


def _ambiguous(simulation: Simulation, found: Certificate, note: Log) -> dict[str, CertifiedHorizon]:
    """Every policy's decisions against their rounding bounds, and the ambiguous ones in exact arithmetic."""
    from mdnum.forks.exact.bounds import certified_horizon
    from mdnum.forks.exact.program import with_policy
    from mdnum.precision import PrecisionPolicy

    done = {}
    for k, row in enumerate(found.ranking):
        note(k, len(found.ranking), {"phase": "bounding decisions", "unit": "policies"})
        done[row.name] = certified_horizon(with_policy(simulation, PrecisionPolicy(**row.roles)), found.steps)
    return done


def _write(folder: RunFolder, found: Certificate, ambiguous: Mapping[str, CertifiedHorizon]) -> None:
    """Puts policies, ambiguous decisions and separations into the folder's tables."""
    rows = _numbers(found)["policies"]
    plain = [
        {
            "policy": row["name"],
            **{role: row[role] for role in ("state", "force", "decision", "accumulate")},
            "horizon": -1 if row["horizon"] is None else row["horizon"],
            "i": -1 if row["pair"] is None else row["pair"][0],
            "j": -1 if row["pair"] is None else row["pair"][1],
            **{
                name: np.nan if row[name] is None else row[name]
                for name in ("margin", "gain", "closer_bits", "growth_rate")
            },
            "failed": row["failed"] or "",
        }
        for row in rows
    ]
    folder.append("policies", {name: np.array([row[name] for row in plain]) for name in plain[0]})
    for row in found.ranking:
        assert row.separation is not None
        count = len(row.separation)
        folder.append(
            "policy_separations",
            {"policy": np.full(count, row.name), "step": np.arange(count), "separation": row.separation},
        )
    names = ("step", "i", "j", "inside", "margin", "bound", "exact", "wrong")
    for policy, one in ambiguous.items():
        if one.decisions:
            columns = {name: np.array([getattr(each, name) for each in one.decisions]) for name in names}
            folder.append("ambiguous", {"policy": np.full(len(one.decisions), policy), **columns})
