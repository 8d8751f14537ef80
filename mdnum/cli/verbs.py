"""The verbs as commands: each parses what was typed, calls its function, and prints the answer."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

import mdnum
from mdnum.cli import output
from mdnum.cli.fork import fork
from mdnum.cli.output import JSON_OPTION, SET_OPTION, SYSTEM_ARGUMENT
from mdnum.errors import InputError

# rich's help formatting and tracebacks cost more than the whole of --help may take
_PLAIN: dict[str, Any] = {"rich_markup_mode": None, "no_args_is_help": True, "add_completion": False}

app = typer.Typer(
    name="mdnum",
    help="Neighbor-set flips in cutoff-based molecular dynamics: which, when, and what they did.",
    epilog="Exit codes: 0 fine, 1 findings, 2 a mistake in what was asked, 3 time (--time) was up before a "
    "verdict, 130 interrupted.",
    pretty_exceptions_enable=False,
    **_PLAIN,
)
systems = typer.Typer(help="The systems that come with mdnum, and your own.", **_PLAIN)
check = typer.Typer(help="Compare a system with ASE and other codes.", **_PLAIN)
app.add_typer(fork, name="fork")
app.add_typer(systems, name="systems")
app.add_typer(check, name="check")

_STEPS = typer.Option(None, min=1)


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


# -- simulations


@app.command()
@output.question(output.changed, noted=["resume"])
def run(
    system: str | None = typer.Argument(None),
    steps: int | None = _STEPS,
    save_every: int | None = typer.Option(None, min=0),
    resume: Path | None = None,
    no_check: bool = False,
    how: Any = None,
) -> Any:
    """Simulate a system and record every flip."""
    if resume is not None:
        given = {
            "SYSTEM": system, "--out": None if how["out"] == resume else how["out"],
            "--save-every": save_every, "--set": how["overrides"] or None,
        }  # fmt: skip
        output.refuse_beside_resume(given, "run")
    elif system is None:
        raise InputError("no system given", remedy="`mdnum systems list` names those that come with mdnum")
    return mdnum.run(system, steps=steps, save_every=save_every, resume=resume, check=not no_check, **how)


@app.command()
@output.question(output.changed)
def ball(
    system: str | None = typer.Argument(None),
    demo: str | None = None,
    steps: int | None = _STEPS,
    against: list[str] | None = None,
    how: Any = None,
) -> Any:
    """Bounce a ball and record every decision, or run a demonstration."""
    if demo is None:
        return _balls if system is None else mdnum.bounce(system, steps=steps, against=against or (), **how)
    given = {"system": system, "--steps": steps, "--set": how.pop("overrides"), "--against": against}
    if foreign := [name for name, value in given.items() if value]:
        raise InputError(
            f"a demonstration has its own balls, so it takes no {foreign[0]}",
            remedy="Leave one of them out",
            where="--demo",
        )
    return mdnum.demonstrate(demo, **how)


def _balls(as_json: bool) -> int:
    """What there is to run, for somebody who named nothing."""
    from mdnum import systems
    from mdnum.verbs import demos

    balls = [systems.load(name, world="ball") for name in systems.names("ball")]
    rows = [{"name": one.name, "balls": one.balls, "about": one.spec.about} for one in balls]
    scripts = [{"name": name, "about": demos.about(name)} for name in demos.names()]
    lines = [(row["name"], row["balls"], row["about"].partition(". ")[0]) for row in rows]
    title = "\ndemonstrations: `mdnum ball --demo NAME`, or all"
    return output.print_lists(
        {"systems": rows, "demos": scripts}, as_json,
        ("systems: `mdnum ball NAME`", ("name", "balls", "about"), lines),
        (title, ("name", "about"), [(row["name"], row["about"]) for row in scripts]),
    )  # fmt: skip


@app.command()
@output.question(output.changed)
def grad(
    system: str = SYSTEM_ARGUMENT,
    of: str | None = None,
    wrt: list[str] | None = None,
    steps: int | None = _STEPS,
    methods: list[str] | None = None,
    replicas: int = typer.Option(0, min=0),
    also: list[str] | None = None,
    no_half_step: bool = False,
    how: Any = None,
) -> Any:
    """Differentiate a loss through a rollout, compare the ways of doing it, and say how far to trust it."""
    return mdnum.grad(
        system, of, wrt or (), steps=steps, methods=methods or None, replicas=replicas, also=also or (),
        half_step=not no_half_step, **how,
    )  # fmt: skip


# -- other people's trajectories, calculators and lists


@app.command()
@output.question()
def flips(
    trajectory: str = typer.Argument(),
    other: str | None = typer.Argument(None),
    topology: Path | None = typer.Option(None, "-s", "--topology"),
    cutoffs: list[float] | None = typer.Option(None, "--cutoff"),
    pairs: list[str] | None = None,
    nearest: list[int] | None = typer.Option(None, min=1),
    most: int | None = typer.Option(None, min=1),
    between: tuple[str, str] | None = None,
    window: int = typer.Option(5, min=1),
    format: str | None = None,
    drop_repeats: bool = False,
    how: Any = None,
) -> Any:
    """Find every pair that entered or left a cutoff between frames, and say what that tells and what not."""
    return mdnum.flips(
        trajectory, other, topology=topology, cutoffs=cutoffs or (), pairs=pairs or (),
        nearest=nearest or (), most=most, between=between, window=window, format=format,
        drop_repeats=drop_repeats, **how,
    )  # fmt: skip


def _checks() -> str:
    from mdnum.audit.checks import CHECKS

    return ", ".join(CHECKS)


@app.command()
@output.question(noted=["resume"])
def audit(
    calculator: str | None = typer.Argument(None),
    structure: Path | None = typer.Option(None, "-s", "--structure"),
    checks: list[str] | None = typer.Option(None, metavar="NAME,NAME", help=f"Only these: {_checks()}."),
    temperature: float | None = typer.Option(None, min=0.0),
    timestep: float | None = typer.Option(None, min=0.0),
    steps: int | None = typer.Option(None, min=16),
    time: float | None = None,
    resume: Path | None = None,
    how: Any = None,
) -> Any:
    """Ask any ASE calculator: is it smooth, invariant, conservative, free of memory, does it keep energy?

    Runs the Python that makes the calculator, with --resume what the folder names. No other verb but
    `conform` runs Python that it is given.
    """
    return mdnum.audit_calculator(
        calculator, structure, checks=checks or None, temperature=temperature, timestep=timestep,
        steps=steps, time=time, resume=resume, **how,
    )  # fmt: skip


@app.command()
@output.question(noted=["resume"])
def conform(
    pairs: str | None = typer.Argument(None),
    cases: int | None = typer.Option(None, min=0),
    seed: int = 0,
    full: bool | None = typer.Option(None, "--full/--half"),
    precision: str | None = None,
    superset: bool = False,
    limits: list[str] | None = None,
    no_large: bool = False,
    time: float | None = None,
    resume: Path | None = None,
    how: Any = None,
) -> Any:
    """Put a neighbor list through a conformance suite: pairs, shifts, distances, and lists that go stale.

    Runs the Python of the list, with --resume of the list that the folder names. No other verb but `audit`
    runs Python that it is given.
    """
    if pairs is None and resume is None:
        return _lists
    if resume is not None:
        given = {
            "LIST": pairs, "--cases": cases, "--seed": seed or None, "--full": full, "--precision": precision,
            "--superset": superset or None, "--limits": limits, "--no-large": no_large or None,
            "--out": how["out"],
        }  # fmt: skip
        output.refuse_beside_resume(given, "examination")
    return mdnum.conform(
        pairs, cases=cases, seed=seed, large=not no_large, full=full, precision=precision,
        superset=superset or None, limits=limits or (), time=time, resume=resume, **how,
    )  # fmt: skip


def _lists(as_json: bool) -> int:
    """The lists that have a name."""
    from mdnum.references.conformance.peers import known

    rows = [
        {
            "list": one.name, "version": one.version, "lacks": one.lacks, "kept": one.kept,
            "what": one.description,
        }
        for one in known()
    ]  # fmt: skip
    if as_json:
        return output.print_json({"lists": rows})
    lines = [
        (row["list"], f"install {' '.join(row['lacks'])}" if row["lacks"] else row["version"], row["what"])
        for row in rows
    ]
    output.print_table("neighbor lists that have a name here", ("list", "version", "what"), lines)
    output.say("\nYour own: mdnum conform package.module:function, or file.py:function.")
    output.say("It takes (positions, cell, pbc, r_cut) and returns (i, j), (i, j, shift), ... or a mapping;")
    output.say("a class with allocate(positions, cell, pbc, r_cut, skin) and update(positions, cell) is a")
    output.say("list that is kept.")
    return output.EXIT_FINE


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
    return output.print_document({"folder": folder, "report": written}, f"wrote {written}", as_json)


@app.command()
def doctor(as_json: bool = JSON_OPTION) -> int:
    """Test the numbers this installation computes."""
    from mdnum.doctor import diagnose

    diagnosis = diagnose()
    if as_json:
        output.print_json({"ok": diagnosis.ok, **vars(diagnosis)})
    else:
        rows = [(row.status, row.name, row.seen) for row in diagnosis.rows]
        output.print_table("", ("status", "test", "seen"), rows)
        for row in diagnosis.rows:
            if row.remedy:
                output.say(f"{row.name}: {row.remedy}")
        verdict = "safe" if diagnosis.ok else "UNSAFE: do not trust numbers computed here"
        output.say(f"this installation is {verdict} ({diagnosis.seconds:.1f} s)")
    return output.EXIT_FINE if diagnosis.ok else output.EXIT_FINDINGS


# -- systems: listed, shown, copied, checked


@systems.command("list")
def list_systems(as_json: bool = JSON_OPTION) -> int:
    """List the systems that come with mdnum."""
    from mdnum import systems

    loaded = [(name, systems.load(name)) for name in systems.names()]
    rows = [{"name": name, **_size(one), "about": one.spec.about} for name, one in loaded]
    lines = [(row["name"], _sized(row), row["about"].partition(". ")[0]) for row in rows]
    return output.print_lists({"systems": rows}, as_json, ("", ("name", "size", "about"), lines))


@systems.command()
def show(
    system: str = SYSTEM_ARGUMENT, settings: list[str] | None = SET_OPTION, as_json: bool = JSON_OPTION
) -> int:
    """Print a system file with every default filled in."""
    text = _load(system, settings).to_toml(beside=False)
    return output.print_document(tomllib.loads(text), text.rstrip(), as_json)


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
    output.print_document(document, words, as_json)
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
    return output.print_document({"system": system, "path": copied}, f"wrote {copied}", as_json)


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
