"""`mdnum ball`: a bouncing ball, or a demonstration with one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mdnum.cli import output
from mdnum.cli.progress import watched
from mdnum.errors import InputError

if TYPE_CHECKING:
    from mdnum.ball.demos import Demo

_ROWS = 20


def ball(
    system: str | None = typer.Argument(
        None, metavar="SYSTEM", help="A ball's name from `mdnum systems list`, or the path of a TOML file."
    ),
    demo: str | None = typer.Option(
        None, "--demo", metavar="NAME", help="Run a demonstration instead, or all of them: --demo all."
    ),
    out: Path | None = typer.Option(
        None, "-o", "--out", metavar="DIR", help="The run folder; runs/NAME-N by default."
    ),
    steps: int | None = typer.Option(None, min=1, help="Steps to run, instead of the system's own."),
    settings: list[str] | None = output.SET_OPTION,
    against: list[str] | None = typer.Option(
        None, metavar="KEY=VALUE", help="Compare with the system with this key changed; repeatable."
    ),
    no_report: bool = typer.Option(False, "--no-report", help="Do not write report.html."),
    as_json: bool = output.JSON_OPTION,
) -> int:
    """Bounce a ball and record every decision, or run a demonstration."""
    if demo is not None:
        given = {"a system": system, "--steps": steps, "--set": settings, "--against": against}
        foreign = [name for name, value in given.items() if value]
        if foreign:
            raise InputError(
                f"a demonstration has its own balls, so it takes no {foreign[0].removeprefix('a ')}",
                remedy="Leave one of them out",
                where="--demo",
            )
        return _demonstrate(demo, out, no_report, as_json)
    if system is None:
        return _list(as_json)
    overrides = output.parse_overrides(settings)
    from mdnum.store.naming import default_folder
    from mdnum.workflow import bounce

    out = default_folder(system) if out is None else out
    with watched() as progress:
        result = bounce(
            system,
            out=out,
            steps=steps,
            overrides=overrides,
            against=against or (),
            report=not no_report,
            progress=progress,
        )
    return output.answer(result.folder, result.summary, _print_rows, as_json=as_json)


# --- a run --------------------------------------------------------------------------------------------


def _print_rows(summary: Mapping[str, Any]) -> None:
    balls, steps = summary["balls"], summary["steps"]
    rows = [
        ("system", f"{summary['system']}, {_many(balls, 'ball')}, {_many(steps, 'step')}"),
        ("contacts", f"{summary['flips_entered']:,} entered, {summary['flips_left']:,} left"),
        ("first contact", f"step {summary['first_contact']:,}" if summary["first_contact"] else "none"),
        _solver(summary),
        ("ambiguous", summary["ambiguous"]),
        ("loss", f"{summary['loss']:.10g}" if summary["loss"] is not None else None),
    ]
    exact = summary.get("exact")
    if exact:
        rows.append(
            ("against the closed form", f"height at the end off by {output.show(exact['height_error'])} m")
        )
    output.print_table("", ("", ""), rows)
    if summary["gradient"]:
        names = list(dict.fromkeys(name for made in summary["gradient"] for name in made["gradient"]))
        output.print_table(
            "gradient",
            ("method", *(f"d/d{name}" for name in names), "what it is"),
            [
                (made["method"], *(_slope(made, name) for name in names), made["says"])
                for made in summary["gradient"]
            ],
        )
    if summary["variants"]:
        output.print_table(
            "against the variants",
            ("variant", "seed", "fork", "decision", "margins", "apart at the end", "loss", *_slopes(summary)),
            [_variant(made, summary) for made in summary["variants"]],
        )


def _solver(summary: Mapping[str, Any]) -> tuple[str, str]:
    """What was iterated, or located, and how it ended."""
    total, ended = summary["iterations_total"], summary["ended"]
    if summary.get("integrator") == "event-located":
        rest = f"; at rest for {_many(ended['rest'], 'step')}" if ended.get("rest") else ""
        return "impacts", f"{total:,} located{rest}"
    if not ended:
        return "solver", "nothing solved"
    ways = ", ".join(f"{count:,} {reason}" for reason, count in ended.items())
    return "solver", f"{_many(total, 'iteration')}; ended by: {ways}"


def _slope(made: Mapping[str, Any], name: str) -> str | None:
    if made.get("refused") or name not in made["gradient"]:
        return None
    if not made.get("depends", {}).get(name, True):
        return "0 (does not depend)"
    error = made.get("details", {}).get("standard_error", {}).get(name)
    return output.show(made["gradient"][name]) + ("" if error is None else f" ± {error:.2g}")


def _slopes(summary: Mapping[str, Any]) -> list[str]:
    first = summary["gradient"][0]["gradient"] if summary["gradient"] else {}
    return [f"d/d{name}" for name in first]


def _variant(made: Mapping[str, Any], summary: Mapping[str, Any]) -> tuple[Any, ...]:
    ball = "" if made["ball"] is None else f", ball {made['ball']}"
    decision = "none differs" if made["fork"] is None else f"{made['channel']}{ball}"
    margins = (
        None
        if made["fork"] is None
        else f"{output.show(made['margin'])} and {output.show(made['margin_there'])}"
    )
    first = summary["gradient"][0]["gradient"] if summary["gradient"] else {}
    slopes = [_slope({**made, "refused": False}, name) for name in first]
    return (
        made["name"],
        made["seed"],
        made["fork"],
        decision,
        margins,
        made["separation_end"],
        f"{made['loss']:.10g}" if made["loss"] is not None else None,
        *slopes,
    )


def _many(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


# --- demonstrations -----------------------------------------------------------------------------------


def _list(as_json: bool) -> int:
    """What there is to run, for somebody who named nothing."""
    from mdnum import systems
    from mdnum.ball.demos import NAMES

    rows = []
    for name in systems.names("ball"):
        loaded = systems.load(name, world="ball")
        rows.append({"name": name, "balls": loaded.balls, "about": loaded.spec.about})
    if as_json:
        output.print_json(
            {"systems": rows, "demos": [{"name": name, "about": _about(name)} for name in NAMES]}
        )
        return output.EXIT_FINE
    lines = [(row["name"], row["balls"], row["about"].partition(". ")[0]) for row in rows]
    output.print_table("systems: `mdnum ball NAME`", ("name", "balls", "about"), lines)
    output.say("")
    title = "demonstrations: `mdnum ball --demo NAME`, or all"
    output.print_table(title, ("name", "about"), [(name, _about(name)) for name in NAMES])
    return output.EXIT_FINE


def _about(name: str) -> str:
    """The first line of a demonstration's file, read without importing it (and jax)."""
    import ast
    import importlib.util

    found = importlib.util.find_spec(f"mdnum.ball.demos.{name.replace('-', '_')}")
    if found is None or found.origin is None:
        return ""
    said = ast.get_docstring(ast.parse(Path(found.origin).read_text(encoding="utf-8")))
    return (said or "").partition("\n")[0].rstrip(".")


def _demonstrate(name: str, out: Path | None, no_report: bool, as_json: bool) -> int:
    from mdnum.ball import demos

    asked = demos.NAMES if name == "all" else (name,)
    # an unknown name is refused before anything runs
    functions = [(one, demos.find(one)) for one in asked]
    done: list[Demo] = []
    with watched() as progress:
        for number, (one, run) in enumerate(functions):
            progress(number, len(functions), {"phase": f"demonstration {one}"})
            done.append(run())
        page = None
        if not no_report:
            from mdnum.report.ball.demos import write_report
            from mdnum.store.naming import default_folder

            progress(len(functions), len(functions), {"phase": "report"})
            folder = default_folder(f"demo-{name}") if out is None else out
            page = write_report(folder, done)
    ok = all(one.ok for one in done)
    if as_json:
        documents = [_document(one) for one in done]
        extra = {"report": page} if page else {}
        output.print_json(
            {"ok": ok, "demos": documents, **extra} if name == "all" else {**documents[0], **extra}
        )
    else:
        for one in done:
            _print_demo(one, brief=name == "all")
        if page is not None:
            output.say(f"wrote {page}")
    return output.EXIT_FINE if ok else output.EXIT_FINDINGS


def _document(demo: Demo) -> dict[str, Any]:
    from mdnum.report.ball.demos import as_dict

    return as_dict(demo)


def _print_demo(demo: Demo, brief: bool) -> None:
    """A demonstration for people; briefly, without its tables."""
    from rich.text import Text

    out = output.console()
    out.print(Text(f"{demo.name}: {demo.title}", style="bold"))
    out.print(Text(demo.question))
    out.print(Text(demo.answer))
    output.print_table(
        "", ("", ""), [(key.replace("_", " "), _value(value)) for key, value in demo.numbers.items()]
    )
    output.print_table(
        "",
        ("", "check", "seen", "expected"),
        [
            ("ok" if check.ok else "failed", check.what, _value(check.seen), check.expected)
            for check in demo.checks
        ],
    )
    for table in () if brief else demo.tables:
        rows = [[_value(cell) for cell in row] for row in table.rows[:_ROWS]]
        output.print_table(table.title, table.columns, rows)
        if len(table.rows) > _ROWS:
            out.print(Text(f"{len(table.rows) - _ROWS} more rows are in the report"))
    if demo.in_md:
        out.print(Text(f"In molecular dynamics: {demo.in_md}", style="dim"))
    out.print()


def _value(value: Any) -> str:
    from mdnum.report.ball.values import value_text

    return value_text(value)
