"""`mdnum conform`: does a neighbor list list the right pairs?"""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched


def conform(
    pairs: str | None = typer.Argument(
        None,
        metavar="[LIST]",
        help="A name, package.module:function, or file.py:function; without one, the names are listed.",
    ),
    cases: int | None = typer.Option(
        None,
        min=0,
        metavar="N",
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
        None,
        metavar="WORD,WORD",
        help="What it does not claim to do: minimum-image, orthorhombic, along-axes, all-axes, periodic, "
        "free, wrapped, fixed-cell, right-handed, lower-triangular, whole-cell.",
    ),
    no_large: bool = typer.Option(False, "--no-large", help="Leave out 5,000 and 100,000 atoms."),
    time: float | None = typer.Option(
        None, metavar="MINUTES", help="Begin no case after that; what was not asked is reported."
    ),
    resume: Path | None = typer.Option(
        None, metavar="DIR", help="Resume the examination in this folder, with its options."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The folder; runs/conform-NAME-N by default."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Put a neighbor list through a conformance suite: pairs, shifts, distances, and lists that go stale.

    Runs the Python of the list, with --resume of the list that the folder names. No other verb but `audit`
    runs Python that it is given.
    """
    if pairs is None and resume is None:
        return _names(as_json)
    if resume is not None:
        from mdnum.verbs import frame

        given = {
            "LIST": pairs, "--cases": cases, "--seed": seed, "--full": full, "--precision": precision,
            "--superset": superset, "--limits": limits, "--no-large": no_large, "--out": out,
        }  # fmt: skip
        asked = {name: value not in (None, False, 0) for name, value in given.items()}
        frame.refuse(asked, "of a new examination", "Leave it out beside --resume, or begin in a new folder")
    from mdnum.verbs.conform import conform as examine

    words = tuple(word.strip() for one in limits or () for word in one.split(",") if word.strip())
    notes = output.noted(resume)
    with watched(lambda: _to_go_on(resume or out)) as progress:
        outcome = examine(
            pairs,
            cases=cases,
            seed=seed,
            large=not no_large,
            full=full,
            precision=precision,
            superset=superset or None,
            limits=words,
            time=time,
            out=out,
            resume=resume,
            report=not no_report,
            progress=progress,
        )
    output.print_lines(notes)
    return output.print_outcome(outcome, as_json=as_json)


def _to_go_on(folder: Path | None) -> str:
    """What to do after control-C."""
    name = folder or "DIR, which is the newest runs/conform-NAME-N"
    return f"What was found is in the folder; resume it with `mdnum conform --resume {name}`"


def _names(as_json: bool) -> int:
    """The lists that have a name."""
    from mdnum.references.conformance.peers import known

    rows = [
        {"list": one.name, "version": one.version, "kept": one.kept, "what": one.description}
        for one in known()
    ]
    if as_json:
        output.print_json({"lists": rows})
        return output.EXIT_FINE
    output.print_table(
        "neighbor lists that have a name here",
        ("list", "version", "what"),
        [(row["list"], row["version"] or "not installed", row["what"]) for row in rows],
    )
    output.say("\nYour own: mdnum conform package.module:function, or file.py:function.")
    output.say("It takes (positions, cell, pbc, r_cut) and returns (i, j), (i, j, shift), ... or a mapping;")
    output.say("a class with allocate(positions, cell, pbc, r_cut, skin) and update(positions, cell) is a")
    output.say("list that is kept.")
    return output.EXIT_FINE
