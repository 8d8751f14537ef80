"""The command line, and its commands that are of no verb: folders, the installation, systems, checks."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from mdnum.cli import output
from mdnum.cli.commands import PLAIN, SET_OPTION, SYSTEM_ARGUMENT, Verbs
from mdnum.cli.output import JSON_OPTION

_GROUP: dict[str, Any] = {**PLAIN, "no_args_is_help": True}

app = typer.Typer(
    cls=Verbs,
    name="mdnum",
    help="Neighbor-set flips in cutoff-based molecular dynamics: which, when, and what they did.",
    epilog="Exit codes: 0 fine, 1 findings, 2 a mistake in what was asked, 3 time (--time) was up before a "
    "verdict, 130 interrupted.",
    pretty_exceptions_enable=False,
    **_GROUP,
)
systems = typer.Typer(help="The systems that come with mdnum, and your own.", **_GROUP)
check = typer.Typer(help="Compare a system with ASE and other codes.", **_GROUP)
app.add_typer(systems, name="systems")
app.add_typer(check, name="check")


def _show_version(wanted: bool) -> None:
    if wanted:
        from mdnum.version import __version__

        typer.echo(f"mdnum {__version__}")
        raise typer.Exit()


@app.callback()
def _top(
    version: bool = typer.Option(
        False, "--version", callback=_show_version, is_eager=True, help="Print the version."
    ),
) -> None:
    pass


# -- folders and the installation


@app.command()
def report(
    folder: Path = typer.Argument(metavar="DIR", help="A run folder."), as_json: bool = JSON_OPTION
) -> int:
    """Write the report of a run folder again."""
    from mdnum.store import RunFolder
    from mdnum.verbs import frame

    written = frame.finish(folder).folder / "report.html"
    output.print_lines(RunFolder.open(folder).noted())
    return output.print_answer({"folder": folder, "report": written}, as_json, lines=[f"wrote {written}"])


@app.command()
def doctor(as_json: bool = JSON_OPTION) -> int:
    """Test the numbers this installation computes."""
    from mdnum.doctor import diagnose

    diagnosis = diagnose()
    rows = [(row.status, row.name, row.seen) for row in diagnosis.rows]
    verdict = "safe" if diagnosis.ok else "UNSAFE: do not trust numbers computed here"
    lines = [f"{row.name}: {row.remedy}" for row in diagnosis.rows if row.remedy]
    lines += [f"this installation is {verdict} ({diagnosis.seconds:.1f} s)"]
    document = {"ok": diagnosis.ok, **vars(diagnosis)}
    output.print_answer(document, as_json, ("", ("status", "test", "seen"), rows), lines=lines)
    return output.EXIT_FINE if diagnosis.ok else output.EXIT_FINDINGS


# -- systems: listed, shown, copied, checked


@systems.command("list")
def list_systems(as_json: bool = JSON_OPTION) -> int:
    """List the systems that come with mdnum."""
    from mdnum import systems

    loaded = [(name, systems.load(name)) for name in systems.names()]
    rows = [{"name": name, **_size(one), "about": one.spec.about} for name, one in loaded]
    lines = [(row["name"], _sized(row), row["about"].partition(". ")[0]) for row in rows]
    return output.print_answer({"systems": rows}, as_json, ("", ("name", "size", "about"), lines))


@systems.command()
def show(
    system: str = SYSTEM_ARGUMENT, settings: list[str] | None = SET_OPTION, as_json: bool = JSON_OPTION
) -> int:
    """Print a system file with every default filled in."""
    text = _load(system, settings).to_toml(beside=False)
    return output.print_answer(tomllib.loads(text), as_json, lines=[text.rstrip()])


@systems.command("check")
def check_system(
    system: str = SYSTEM_ARGUMENT, settings: list[str] | None = SET_OPTION, as_json: bool = JSON_OPTION
) -> int:
    """Read a system file and its structure, and say whether it can be run; a warning exits with 1."""
    loaded = _load(system, settings)
    from mdnum.verbs.check import structure_findings

    found = list(structure_findings(loaded)) if hasattr(loaded, "atoms") else []
    document = {"system": loaded.name, "ok": True, **_size(loaded), "path": loaded.path, "findings": found}
    words = f"{loaded.name}: {'can be run, with a warning' if found else 'fine'}, {_sized(document)}"
    output.print_answer(document, as_json, lines=[words])
    if not as_json:
        output.print_findings(found)
    return output.exit_code(found)


@systems.command()
def copy(
    system: str = SYSTEM_ARGUMENT,
    target: Path = typer.Argument(Path(), metavar="[DIR]", help="Where to; here by default."),
    as_json: bool = JSON_OPTION,
) -> int:
    """Copy a system file and its structure, to change and run."""
    from mdnum import systems

    copied = systems.copy(system, target)
    return output.print_answer({"system": system, "path": copied}, as_json, lines=[f"wrote {copied}"])


def _size(system: Any) -> dict[str, int]:
    """How many there are of what the system is made of."""
    atoms = getattr(system, "atoms", None)
    return {"balls": system.balls} if atoms is None else {"atoms": len(atoms)}


def _sized(row: dict[str, Any]) -> str:
    noun = "atom" if "atoms" in row else "ball"
    number = row[f"{noun}s"]
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _load(system: str, settings: list[str] | None, **world: str) -> Any:
    from mdnum import systems

    return systems.load(system, output.parse_overrides(settings), **world)


def _compared(question: str, title: str, help: str) -> Callable[..., int]:
    """Adds a comparison of a system with other codes."""

    @check.command(question, help=help)
    def compare(
        system: str = SYSTEM_ARGUMENT, settings: list[str] | None = SET_OPTION, as_json: bool = JSON_OPTION
    ) -> int:
        from mdnum.verbs.check import check

        loaded = _load(system, settings, world="md")
        checked, units = check(question, loaded), loaded.units
        if as_json:
            output.print_json(checked.summary)
        else:
            used = f"{units.energy}, {units.length}, {units.time}"
            used = used if question == "dynamics" else f"{units.energy}, {units.energy}/{units.length}"
            shown = "" if question == "pairs" else f" ({used})"
            output.print_records(f"{system}: {title}{shown}", checked.report.rows())
            output.print_findings(checked.verdict.findings)
            output.say(checked.verdict.headline)
        return output.exit_code(checked.verdict.findings, "complete" if checked.report.ok else "failed")

    return compare


_compared("energy", "energy, forces and stress against ASE", "Compare energy, forces and stress with ASE.")
_compared("pairs", "pair sets against brute force", "Compare every neighbor search with brute force.")
_compared("dynamics", "100 NVE steps against ASE", "Compare 100 NVE steps with ASE's VelocityVerlet.")
