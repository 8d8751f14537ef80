"""`mdnum flips`: which pairs entered or left a cutoff between the frames of anybody's trajectory."""

from __future__ import annotations

from pathlib import Path

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched


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
        None,
        "--cutoff",
        metavar="R",
        help="Inside where r < R, in the file's unit (Å, as a rule); repeatable.",
    ),
    pairs: list[str] | None = typer.Option(
        None,
        "--pairs",
        metavar="A-B=R,...",
        help='Cutoffs by pair of species, "O-H=2.5,O-O=3.5"; repeatable.',
    ),
    nearest: list[int] | None = typer.Option(
        None, "--nearest", min=1, metavar="K", help="The K nearest of each atom; repeatable."
    ),
    most: int | None = typer.Option(
        None, "--most", min=1, metavar="M", help="Of those inside --cutoff, only the M nearest of each atom."
    ),
    between: tuple[str, str] | None = typer.Option(
        None,
        "--between",
        metavar="SEL SEL",
        help='Pairs with one atom in each selection (MDAnalysis\'s language), "name OW" "protein".',
    ),
    window: int = typer.Option(
        5, "--window", min=1, metavar="FRAMES", help="A flip reversed within so many frames is chatter."
    ),
    format: str | None = typer.Option(
        None, "--format", metavar="WORD", help="The file's format, where its name does not tell."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The new folder; runs/flips-NAME-N by default."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Find every pair that entered or left a cutoff between frames, and say what that tells and what not."""
    from mdnum.verbs import flips as look

    with watched() as progress:
        result = look(
            trajectory,
            other,
            topology=topology,
            cutoffs=cutoffs or (),
            pairs=pairs or (),
            nearest=nearest or (),
            most=most,
            between=between,
            window=window,
            format=format,
            out=out,
            report=not no_report,
            progress=progress,
        )
    code = output.print_outcome(result, as_json=as_json)
    return output.EXIT_STOPPED if result.summary["interrupted"] else code
