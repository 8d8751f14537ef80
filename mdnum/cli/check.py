"""`mdnum check`: a system against ASE and against other pair finders."""

from __future__ import annotations

import importlib
from typing import Any

import typer

from mdnum.cli import output

_SYSTEM = typer.Argument(metavar="SYSTEM", help="A name from `mdnum systems list`, or a TOML file.")


def energy(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare energy, forces and stress with ASE."""
    return _check("check_energy", "energy, forces and stress against ASE", system, settings, as_json)


def pairs(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare every pair finder with brute force."""
    return _check("check_pairs", "pair sets against brute force", system, settings, as_json)


def dynamics(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare 100 NVE steps with ASE's VelocityVerlet."""
    return _check("check_dynamics", "100 NVE steps against ASE", system, settings, as_json)


def _check(function: str, title: str, name: str, settings: list[str] | None, as_json: bool) -> int:
    from mdnum import systems

    system = systems.load(name, output.parse_overrides(settings), world="md")
    report: Any = getattr(importlib.import_module("mdnum.references.check"), function)(system)
    if as_json:
        output.print_json({"ok": report.ok, **report.to_dict()})
    else:
        output.print_records(f"{system.name}: {title}", report.rows())
        output.print_findings(report.findings)
        output.say("agrees" if report.ok else "does not agree")
    return output.exit_code(report.findings, ok=report.ok)
