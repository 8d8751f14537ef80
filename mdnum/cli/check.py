"""`mdnum check`: a system against ASE and against other neighbor searches."""

from __future__ import annotations

import typer

from mdnum.cli import output

_SYSTEM = typer.Argument(metavar="SYSTEM", help="A name from `mdnum systems list`, or a TOML file.")


def energy(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare energy, forces and stress with ASE."""
    return _check("energy", "energy, forces and stress against ASE", system, settings, as_json)


def pairs(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare every neighbor search with brute force."""
    return _check("pairs", "pair sets against brute force", system, settings, as_json)


def dynamics(
    system: str = _SYSTEM,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Compare 100 NVE steps with ASE's VelocityVerlet."""
    return _check("dynamics", "100 NVE steps against ASE", system, settings, as_json)


def _check(question: str, title: str, name: str, settings: list[str] | None, as_json: bool) -> int:
    from mdnum import systems
    from mdnum.verbs.check import check

    checked = check(question, systems.load(name, output.parse_overrides(settings), world="md"))
    if as_json:
        output.print_json(checked.summary)
    else:
        output.print_records(f"{name}: {title}", checked.report.rows())
        output.print_findings(checked.verdict.findings)
        output.say(checked.verdict.headline)
    return output.exit_code(checked.verdict.findings, ok=checked.report.ok)
