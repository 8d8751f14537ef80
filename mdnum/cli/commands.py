"""Command-line commands, created from text files in the format of `mdnum/verbs/__init__.toml`.

The modules of a command are imported only when this command is called.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from mdnum import verbs
from mdnum.cli import output
from mdnum.errors import InputError, MdnumError
from mdnum.plain import beside, shipped_systems
from mdnum.verbs import VERBS, declared

# rich's help formatting costs more than the whole of --help may take
_PLAIN: dict[str, Any] = {"rich_markup_mode": None}
_TYPES = {"text": str, "system": str, "int": int, "float": float, "path": Path, "folder": Path, "flag": bool}
_SHARED: Mapping[str, Mapping[str, Any]] = beside(verbs.__file__)["shared"]


class _Verbs(TyperGroup):
    """Group of all commands of mdnum, including commands of other packages."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(dict.fromkeys([*(name.split()[0] for name in VERBS), *self.commands]))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in self.commands or cmd_name not in self.list_commands(ctx):
            return self.commands.get(cmd_name)
        try:
            return _of_verb(cmd_name)
        except InputError as error:
            # a package that is broken; other verbs can be used
            broken = error

        def refuse() -> None:
            raise broken

        return _made(
            cmd_name, {"help": str(broken)}, refuse, ignore_unknown_options=True, allow_extra_args=True
        )

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands of `--help`, grouped by topic."""
        below: dict[str, list[tuple[str, str]]] = {}
        for name in (names := self.list_commands(ctx)):
            made = self.get_command(ctx, name)
            row = (name.ljust(max(map(len, names))), made.get_short_help_str(limit=200))
            below.setdefault(made.rich_help_panel or "Verbs of other packages", []).append(row)
        for heading, rows in below.items():
            formatter.write(f"\n{heading}\n")
            with formatter.indentation():
                formatter.write_dl(rows)


app = typer.Typer(
    cls=_Verbs,
    name="mdnum",
    help="Neighbor-set flips in cutoff-based molecular dynamics: which, when, and what they did.",
    epilog="Exit codes: 0 no findings, 1 findings, 2 an error in the input, 3 the time limit "
    "(--time) was reached before a verdict, 130 interrupted.",
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    **_PLAIN,
)


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


class _Questions(TyperGroup):
    """Group of subcommands. The default subcommand is called if the first argument is not a subcommand."""

    group: Mapping[str, Any]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        group, first = self.group, args[0] if args else "--json"
        if ctx.resilient_parsing and (not args or "usual" not in group):
            return super().parse_args(ctx, args)  # a shell completes the first word
        if "alone" in group and set(args) <= {"--json"}:
            args = [group["alone"], *args]
        elif "usual" in group and first not in self.commands and first != "--help":
            if "two" in group and len(args) > 1 and not (args[1].startswith("-") or ctx.resilient_parsing):
                both, folders = " ".join(args[:2]), all(map(os.path.isdir, args[:2]))
                remedy = f"Use `mdnum {group['two'][0 if folders else 1]} {both}`"
                raise InputError(f"{both}: expected one system", remedy=remedy)
            args = [group["usual"], *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        found = super().shell_complete(ctx, incomplete)
        if "usual" in self.group:
            usual = self.commands[self.group["usual"]]
            below = usual.make_context(usual.name, [], parent=ctx, resilient_parsing=True)
            for one in (usual, usual.params[0]):
                found += one.shell_complete(below, incomplete)
        return found


def _of_verb(verb: str) -> Any:
    """Create a command-line command, or a group of subcommands."""
    texts = {name: declared(name) for name in verbs.VERBS if name.split()[0] == verb}
    shared = {**_SHARED, **texts[verb].get("shared", {})}
    if "group" not in texts[verb]:
        return _command(verb, verb, texts[verb]["command"], shared)
    commands = {
        question: _command(entry, question, said, shared)
        for entry, text in texts.items()
        for question, said in text.get("commands", {}).items()
    }
    group = texts[verb]["group"]
    made = _Questions(
        name=verb, commands=commands, help=group["help"], no_args_is_help="alone" not in group,
        rich_help_panel=group.get("heading"), **_PLAIN,
    )  # fmt: skip
    made.group = group
    return made


def _command(entry: str, name: str, said: Mapping[str, Any], shared: Mapping[str, Any]) -> Any:
    """Create a command for the parser from the text file of an entry of `VERBS`."""
    parts = [shared[one] for one in said.get("shares", ())]
    # a system comes first among arguments, and a command's own options before those of others
    arguments = {key: one for part in (*parts, said) for key, one in part.get("arguments", {}).items()}
    options = {key: one for part in (said, *parts) for key, one in part.get("options", {}).items()}
    whole = {**said, "entry": entry, "arguments": arguments, "options": options}

    def command(ctx: typer.Context, as_json: bool, **values: Any) -> int:
        sources: dict[str, Any] = {key: ctx.get_parameter_source(key) for key in values}
        return _called(whole, {key: values[key] for key in values if sources[key].name != "DEFAULT"}, as_json)

    words = {key: _parameter(key, one, typer.Argument) for key, one in arguments.items()}
    words |= {key: _parameter(key, one, typer.Option) for key, one in options.items()}
    kinds = {"ctx": (typer.Context, inspect.Parameter.empty), **words, "as_json": (bool, output.JSON_OPTION)}
    function: Any = command
    function.__signature__ = inspect.Signature([
        inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)
        for key, (kind, default) in kinds.items()
    ])  # fmt: skip
    function.__annotations__ = {key: kind for key, (kind, _) in kinds.items()}
    return _made(name, said, function)


def _made(name: str, said: Mapping[str, Any], function: Callable[..., Any], **settings: Any) -> Any:
    maker = typer.Typer(add_completion=False, **_PLAIN)
    panel = said.get("heading")
    maker.command(name, help=said["help"], rich_help_panel=panel, context_settings=settings)(function)
    return typer.main.get_command(maker)


def _parameter(name: str, said: Mapping[str, Any], make: Callable[..., Any]) -> tuple[Any, Any]:
    """Return type and default of an argument or option for typer."""
    types = [_TYPES[word] for word in said.get("type", "text").split()]
    kind: Any = types[0] if len(types) == 1 else tuple[tuple(types)]
    kind = list[kind] if said.get("repeatable") else kind
    flags = [] if make is typer.Argument else _flags(name, said)
    # a flag that has another one to turn it off is neither on nor off by default
    default = said.get("default", False if kind is bool and "/" not in flags[0] else None)
    if make is typer.Argument and not said.get("optional"):
        default = ...
    text, more = said["help"], {key: said[key] for key in ("min", "metavar") if key in said}
    if "of" in said:
        module, _, attribute = said["of"].partition(":")
        text = text.format(of=", ".join(getattr(importlib.import_module(module), attribute)))
    if said.get("type") == "system":
        more["autocompletion"] = shipped_systems
    return kind | None if default is None else kind, make(default, *flags, help=text, **more)


def _flags(name: str, said: Mapping[str, Any]) -> list[str]:
    return said.get("flags", f"--{name.replace('_', '-')}").split()


# -- what is done when one is called


def _called(said: Mapping[str, Any], given: dict[str, Any], as_json: bool) -> int:
    """Call a command's function, print the result, and return the exit code."""
    typed = {**said["arguments"], **said["options"]}
    if given.get("resume") == given.get("out"):
        given.pop("out", None)
    if "missing" in said and not given.keys() & {*said["arguments"], "resume"}:
        raise InputError(said["missing"][0], remedy=said["missing"][1])
    if "resumes" in said and "resume" in given:
        _refuse_new(said, given)
    folders = dict.fromkeys(one for name, one in given.items() if typed[name].get("type") == "folder")
    # looked at before a folder is listed anew, and said where nothing is worse
    wrong = [line for one in folders if one.is_dir() for line in _folder(one).noted()]
    arguments, options = [given.get(name) for name in said["arguments"]], _options(said, given)
    stopped = False

    def again() -> str | None:
        """Return a sentence on how to continue a stopped command."""
        folder = given.get("resume") or progress.folder or given.get("out")
        with suppress(MdnumError):
            if "resume" in typed and folder is not None:
                return _folder(folder).again
        return said.get("again")

    if said.get("on_the_spot"):
        reply = getattr(VERBS[said["entry"]], said["calls"])(*arguments, **options)
        output.print_lines(wrong)
        return output.print_reply(reply, as_json)
    with output.watched(again) as progress:
        try:
            function = getattr(VERBS[said["entry"]], said["calls"])
            answer: Any = function(*arguments, **options, progress=progress)
        except KeyboardInterrupt as stop:
            # what was found until then may be an answer
            if (answer := getattr(stop, "outcome", None)) is None:
                raise
            stopped = True
    if isinstance(answer, verbs.Reply):
        return output.print_reply(answer, as_json)
    output.print_lines(wrong)
    code = output.print_outcome(answer, as_json=as_json)
    return output.EXIT_STOPPED if stopped or answer.summary.get("interrupted") else code


def _folder(path: Path) -> Any:
    from mdnum.store import RunFolder

    return RunFolder.open(path)


def _options(said: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Convert options to function arguments. A Python file named on the command line may be executed."""
    options = {}
    for name in given.keys() & said["options"].keys():
        off = said["options"][name].get("type") == "flag" and name.startswith("no_")
        options |= {name.removeprefix("no_"): False} if off else {name: given[name]}
    if not {"changed", "its keys"} & {*said.get("shares", ())}:
        return options
    overrides = output.parse_overrides(options.pop("settings", ()))
    if (potential := options.pop("potential", None)) is not None:
        file, colon, name = potential.rpartition(":")
        function = json.dumps(f"{Path(file).resolve()}{colon}{name}")
        overrides = {"potential.kind": "python", "potential.function": function, **overrides}
        options["allow_code"] = True
    return {**options, "overrides": overrides} if overrides else options


def _refuse_new(said: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Raise an error for options that cannot be combined with --resume."""
    from mdnum.verbs.frame import refuse

    labels = {name: one["metavar"].strip("[]") for name, one in said["arguments"].items() if "new" in one}
    options = {name: one for name, one in said["options"].items() if "new" in one}
    labels |= {name: _flags(name, one)[-1].partition("/")[0] for name, one in options.items()}
    new = {label: True for name, label in labels.items() if name in given}
    refuse(new, f"of a new {said['resumes']}", "Leave it out beside --resume, or begin in a new folder")
