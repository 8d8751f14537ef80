"""The verbs as commands: each parses what was typed, calls its function, and prints the answer."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer

import mdnum
from mdnum.cli import output
from mdnum.cli.fork import fork
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

_STEPS = typer.Option(None, min=1, help="Steps to run, instead of the system's own.")


def _show_version(wanted: bool) -> None:
    if wanted:
        from mdnum import __version__

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


def _resume_run(given: Mapping[str, Any]) -> str | None:
    from mdnum.store.files import resumable

    folder = given["resume"] or given["out"]
    if folder is None or not folder.exists():
        return None
    kept = f"Continue with `mdnum run --resume {folder}`"
    return kept if resumable(folder) else "Nothing of it was kept: give the command again"


@app.command()
@output.question(output.changed, noted=["resume"], remedy=_resume_run)
def run(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A name from `mdnum systems list`, or the path of a TOML file."
    ),
    steps: int | None = _STEPS,
    save_every: int | None = typer.Option(
        None, min=0, metavar="K", help="Write every K-th frame to trajectory.traj; 0 writes none."
    ),
    resume: Path | None = typer.Option(None, metavar="DIR", help="Continue the run in this folder."),
    no_check: bool = typer.Option(False, "--no-check", help="Do not compare with ASE."),
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
    else:
        from mdnum.store.files import default_folder

        how["out"] = how["out"] or default_folder(system)
    return mdnum.run(system, steps=steps, save_every=save_every, resume=resume, check=not no_check, **how)


@app.command()
@output.question(output.changed)
def ball(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A ball's name from `mdnum systems list`, or the path of a TOML file."
    ),
    demo: str | None = typer.Option(
        None, "--demo", metavar="NAME", help="Run a demonstration instead, or all of them: --demo all."
    ),
    steps: int | None = _STEPS,
    against: list[str] | None = typer.Option(
        None, metavar="KEY=VALUE", help="Compare with the system with this key changed; repeatable."
    ),
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
    if as_json:
        return output.print_json({"systems": rows, "demos": scripts})
    lines = [(row["name"], row["balls"], row["about"].partition(". ")[0]) for row in rows]
    output.print_table("systems: `mdnum ball NAME`", ("name", "balls", "about"), lines)
    output.say("")
    title = "demonstrations: `mdnum ball --demo NAME`, or all"
    output.print_table(title, ("name", "about"), [(row["name"], row["about"]) for row in scripts])
    return output.EXIT_FINE


@app.command()
@output.question(output.changed)
def grad(
    system: str = output.SYSTEM_ARGUMENT,
    of: str | None = typer.Option(
        None, metavar="LOSS", help="What to differentiate: msd, vacf, potential, temperature, pressure, ..."
    ),
    wrt: list[str] | None = typer.Option(
        None, metavar="NAME,NAME", help="By which parameters: epsilon, r_cut, initial.velocities, ..."
    ),
    steps: int | None = typer.Option(
        None, min=1, help="The horizon; the system's own steps, but no more than 500, by default."
    ),
    methods: list[str] | None = typer.Option(
        None,
        metavar="WORD,WORD",
        help="Ways to differentiate, or all; by default those that answer within about a minute.",
    ),
    replicas: int = typer.Option(
        0, min=0, metavar="N", help="Other starts, for the standard error of the gradient; none by default."
    ),
    also: list[str] | None = typer.Option(
        None, metavar="WORD,WORD", help="Further parts of the diagnosis: spectrum, edges, scaling, or all."
    ),
    no_half_step: bool = typer.Option(
        False,
        "--no-half-step",
        help="Do not make the gradient at half the time step too; then nothing is called trusted.",
    ),
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
    trajectory: str = typer.Argument(
        metavar="TRAJECTORY",
        help="A file that MDAnalysis or ASE reads, or the folder of a run; frames behind an @: run.xtc@100:",
    ),
    other: str | None = typer.Argument(
        None, metavar="[OTHER]", help="A second trajectory of the same atoms: where do the two diverge?"
    ),
    topology: Path | None = typer.Option(
        None, "-s", "--topology", metavar="FILE", help="What the atoms are, for xtc, trr, dcd, netcdf, ..."
    ),
    cutoffs: list[float] | None = typer.Option(
        None, "--cutoff", metavar="R",
        help="Inside where r < R, in the file's unit (Å, as a rule); repeatable.",
    ),
    pairs: list[str] | None = typer.Option(
        None, "--pairs", metavar="A-B=R,...",
        help='Cutoffs by pair of species, "O-H=2.5,O-O=3.5"; repeatable.',
    ),
    nearest: list[int] | None = typer.Option(
        None, "--nearest", min=1, metavar="K", help="The K nearest of each atom; repeatable."
    ),
    most: int | None = typer.Option(
        None, "--most", min=1, metavar="M", help="Of those inside --cutoff, only the M nearest of each atom."
    ),
    between: tuple[str, str] | None = typer.Option(
        None, "--between", metavar="SEL SEL",
        help='Pairs with one atom in each selection (MDAnalysis\'s language), "name OW" "protein".',
    ),
    window: int = typer.Option(
        5, "--window", min=1, metavar="FRAMES", help="A flip reversed within so many frames is chatter."
    ),
    format: str | None = typer.Option(
        None, "--format", metavar="WORD", help="The file's format, where its name does not tell."
    ),
    drop_repeats: bool = typer.Option(
        False, "--drop-repeats", help="Leave out frames that are earlier ones again, bit for bit."
    ),
    how: Any = None,
) -> Any:  # fmt: skip
    """Find every pair that entered or left a cutoff between frames, and say what that tells and what not."""
    return mdnum.flips(
        trajectory, other, topology=topology, cutoffs=cutoffs or (), pairs=pairs or (),
        nearest=nearest or (), most=most, between=between, window=window, format=format,
        drop_repeats=drop_repeats, **how,
    )  # fmt: skip


def _checks() -> str:
    from mdnum.audit.checks import CHECKS

    return ", ".join(CHECKS)


def _resume_audit(given: Mapping[str, Any]) -> str | None:
    folder = given["resume"] or given["out"]
    begun = folder is not None and (folder / "answers.json").exists()
    return f"Continue with `mdnum audit --resume {folder}`" if begun else None


@app.command()
@output.question(noted=["resume"], remedy=_resume_audit)
def audit(
    calculator: str | None = typer.Argument(
        None, metavar="CALCULATOR",
        help="package.module:Class(argument=value), a Python file that makes a calculator, or a SYSTEM.",
    ),
    structure: Path | None = typer.Option(
        None, "-s", "--structure", metavar="FILE[@N]",
        help="A structure, the N-th of a file's (from 0; the last by default); one is built by default.",
    ),
    checks: list[str] | None = typer.Option(None, metavar="NAME,NAME", help=f"Only these: {_checks()}."),
    temperature: float | None = typer.Option(
        None, min=0.0, metavar="KELVIN", help="For kT and for the run; 300 K by default."
    ),
    timestep: float | None = typer.Option(
        None, min=0.0, metavar="FS", help="Of the run; from the fastest vibration by default."
    ),
    steps: int | None = typer.Option(None, min=16, help="Of the run; 200 by default."),
    time: float | None = typer.Option(
        None, metavar="MINUTES",
        help="Ask nothing more after that; what was not asked is listed. Exit code 3: before a verdict.",
    ),
    resume: Path | None = typer.Option(
        None, metavar="DIR", help="Ask what the audit in this folder has not asked, of the same calculator."
    ),
    how: Any = None,
) -> Any:  # fmt: skip
    """Ask any ASE calculator: is it smooth, invariant, conservative, free of memory, does it keep energy?

    Runs the Python that makes the calculator, with --resume what the folder names. No other verb but
    `conform` runs Python that it is given.
    """
    return mdnum.audit_calculator(
        calculator, structure, checks=checks or None, temperature=temperature, timestep=timestep,
        steps=steps, time=time, resume=resume, **how,
    )  # fmt: skip


def _resume_conform(given: Mapping[str, Any]) -> str:
    name = given["resume"] or given["out"] or "DIR, which is the newest runs/conform-NAME-N"
    return f"What was found is in the folder; resume it with `mdnum conform --resume {name}`"


@app.command()
@output.question(noted=["resume"], remedy=_resume_conform)
def conform(
    pairs: str | None = typer.Argument(
        None, metavar="[LIST]",
        help="A name, package.module:function, or file.py:function; without one, the names are listed.",
    ),
    cases: int | None = typer.Option(
        None, min=0, metavar="N",
        help="Random cases beside those with a name; 500 by default, a share of them for slow lists.",
    ),
    seed: int = typer.Option(0, metavar="N", help="Of the random cases."),
    full: bool | None = typer.Option(
        None, "--full/--half", help="Every pair from both of its atoms, or once; found out by default."
    ),
    precision: str | None = typer.Option(
        None, metavar="WORD", help="Of its arithmetic: float64 or float32; found out by default."
    ),
    superset: bool = typer.Option(False, "--superset", help="Pairs beyond the cutoff may be listed."),
    limits: list[str] | None = typer.Option(
        None, metavar="WORD,WORD",
        help="What it does not claim to do: minimum-image, orthorhombic, along-axes, all-axes, periodic, "
        "free, wrapped, fixed-cell, right-handed, lower-triangular, whole-cell.",
    ),
    no_large: bool = typer.Option(False, "--no-large", help="Leave out 5,000 and 100,000 atoms."),
    time: float | None = typer.Option(
        None, metavar="MINUTES",
        help="End by then; what was not asked is reported. Exit code 3: before there was a verdict.",
    ),
    resume: Path | None = typer.Option(
        None, metavar="DIR", help="Resume the examination in this folder, with its options."
    ),
    how: Any = None,
) -> Any:  # fmt: skip
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
    words = tuple(word.strip() for one in limits or () for word in one.split(",") if word.strip())
    return mdnum.conform(
        pairs, cases=cases, seed=seed, large=not no_large, full=full, precision=precision,
        superset=superset or None, limits=words, time=time, resume=resume, **how,
    )  # fmt: skip


def _lists(as_json: bool) -> int:
    """The lists that have a name."""
    from mdnum.references.conformance.peers import known

    rows = [
        {"list": one.name, "version": one.version, "kept": one.kept, "what": one.description}
        for one in known()
    ]
    if as_json:
        return output.print_json({"lists": rows})
    lines = [(row["list"], row["version"] or "not installed", row["what"]) for row in rows]
    output.print_table("neighbor lists that have a name here", ("list", "version", "what"), lines)
    output.say("\nYour own: mdnum conform package.module:function, or file.py:function.")
    output.say("It takes (positions, cell, pbc, r_cut) and returns (i, j), (i, j, shift), ... or a mapping;")
    output.say("a class with allocate(positions, cell, pbc, r_cut, skin) and update(positions, cell) is a")
    output.say("list that is kept.")
    return output.EXIT_FINE


# -- folders and the installation


@app.command()
def report(
    folder: Path = typer.Argument(metavar="DIR", help="A run folder."), as_json: bool = output.JSON_OPTION
) -> int:
    """Write the report of a run folder again."""
    from mdnum.store import RunFolder
    from mdnum.verbs import frame

    written = frame.finish(folder).folder / "report.html"
    output.print_lines(RunFolder.open(folder).noted())
    return output.print_document({"folder": folder, "report": written}, f"wrote {written}", as_json)


@app.command()
def doctor(as_json: bool = output.JSON_OPTION) -> int:
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
def list_systems(as_json: bool = output.JSON_OPTION) -> int:
    """List the systems that come with mdnum."""
    from mdnum import systems

    loaded = [(name, systems.load(name)) for name in systems.names()]
    rows = [{"name": name, **_size(one), "about": one.spec.about} for name, one in loaded]
    if as_json:
        return output.print_json({"systems": rows})
    lines = [(row["name"], _sized(row), row["about"].partition(". ")[0]) for row in rows]
    output.print_table("", ("name", "size", "about"), lines)
    return output.EXIT_FINE


@systems.command()
def show(
    system: str = output.SYSTEM_ARGUMENT,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Print a system file with every default filled in."""
    text = _load(system, settings).to_toml(beside=False)
    return output.print_document(tomllib.loads(text), text.rstrip(), as_json)


@systems.command("check")
def check_system(
    system: str = output.SYSTEM_ARGUMENT,
    settings: list[str] | None = output.SET_OPTION,
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Read a system file and its structure, and say whether it can be run."""
    loaded = _load(system, settings)
    from mdnum.verbs.check import structure_findings

    found = list(structure_findings(loaded)) if hasattr(loaded, "atoms") else []
    document = {
        "system": loaded.name,
        "ok": True,
        **_size(loaded),
        "path": loaded.path,
        "findings": found,
    }
    words = f"{loaded.name}: {'can be run, with a warning' if found else 'fine'}, {_sized(document)}"
    output.print_document(document, words, as_json)
    if not as_json:
        output.print_findings(found)
    return output.exit_code(found)


@systems.command()
def copy(
    system: str = output.SYSTEM_ARGUMENT,
    target: Path = typer.Argument(Path(), metavar="[DIR]", help="Where to; here by default."),
    as_json: bool = output.JSON_OPTION,
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
        system: str = output.SYSTEM_ARGUMENT,
        settings: list[str] | None = output.SET_OPTION,
        as_json: bool = output.JSON_OPTION,
    ) -> int:
        from mdnum.verbs.check import check

        checked = check(question, _load(system, settings, world="md"))
        if as_json:
            output.print_json(checked.summary)
        else:
            output.print_records(f"{system}: {title}", checked.report.rows())
            output.print_findings(checked.verdict.findings)
            output.say(checked.verdict.headline)
        return output.exit_code(checked.verdict.findings, "complete" if checked.report.ok else "failed")

    return compare


_compared("energy", "energy, forces and stress against ASE", "Compare energy, forces and stress with ASE.")
_compared("pairs", "pair sets against brute force", "Compare every neighbor search with brute force.")
_compared("dynamics", "100 NVE steps against ASE", "Compare 100 NVE steps with ASE's VelocityVerlet.")
