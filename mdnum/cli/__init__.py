"""The command line: parse, call, print. No science here, and no import of jax.

Every verb is a function that returns its exit code: 0 fine, 1 findings, 2 a mistake in what was asked.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import sys
from typing import Any, NoReturn

import typer

from mdnum.cli import audit, ball, check, conform, doctor, flips, fork, grad, report, run, systems
from mdnum.cli.output import EXIT_STOPPED, EXIT_USAGE, print_error, say
from mdnum.errors import InputError, MdnumError

# rich's help formatting and tracebacks cost more than the whole of --help may take
_PLAIN: dict[str, Any] = {"rich_markup_mode": None, "no_args_is_help": True, "add_completion": False}

app = typer.Typer(
    name="mdnum",
    help="Neighbor-set flips in cutoff-based molecular dynamics: which, when, and what they did.",
    pretty_exceptions_enable=False,
    **_PLAIN,
)
_systems = typer.Typer(help="The systems that come with mdnum, and your own.", **_PLAIN)
_check = typer.Typer(help="Compare a system with ASE and other codes.", **_PLAIN)

app.command("run")(run.run)
app.command("ball")(ball.ball)
app.add_typer(fork.fork, name="fork")
app.command("grad")(grad.grad)
app.command("flips")(flips.flips)
app.command("audit")(audit.audit)
app.command("conform")(conform.conform)
app.add_typer(_systems, name="systems")
app.add_typer(_check, name="check")
app.command("report")(report.report)
app.command("doctor")(doctor.doctor)
_systems.command("list")(systems.list_systems)
_systems.command("show")(systems.show)
_systems.command("check")(systems.check)
_systems.command("copy")(systems.copy)
_check.command("energy")(check.energy)
_check.command("pairs")(check.pairs)
_check.command("dynamics")(check.dynamics)

# typer carries its own copy of click in some versions and imports click in others; either way
# BadParameter derives from the usage error that its parser raises
_UsageError: Any = typer.BadParameter.__base__


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


def _keep_programs() -> None:
    """Let jax keep what it compiles for the next command, unless the environment says otherwise.

    A program compiled for one kind of processor is not offered to another: home folders are shared.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    features = platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        features = next((line for line in file if line.startswith(("flags", "Features"))), features)
    kind = hashlib.sha256(features.encode()).hexdigest()[:12]
    folder = os.path.join(home, "mdnum", f"programs-{kind}")
    with contextlib.suppress(OSError):
        os.makedirs(folder, exist_ok=True)
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(512 * 2**20)
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit.

    Args:
        arguments: what follows `mdnum`; the process's own when None.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    as_json = "--json" in arguments
    _keep_programs()
    try:
        code = app(arguments, standalone_mode=False, prog_name="mdnum")
    except MdnumError as error:
        print_error(error, as_json=as_json)
        sys.exit(error.exit_code)
    except _UsageError as error:
        place = error.ctx.command_path if error.ctx else "mdnum"
        # no arguments at all is a request for help, which click raises as a usage error
        if type(error).__name__ == "NoArgsIsHelpError":
            say(error.format_message())
            sys.exit(EXIT_USAGE)
        asked = InputError(error.format_message(), remedy=f"See `{place} --help`")
        print_error(asked, as_json=as_json)
        sys.exit(EXIT_USAGE)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(EXIT_STOPPED)
    except MemoryError as error:
        asked = InputError(
            f"more memory is needed than there is ({error})", remedy="Ask for fewer atoms, balls or steps"
        )
        print_error(asked, as_json=as_json)
        sys.exit(EXIT_USAGE)
    except RuntimeError as error:
        platforms = os.environ.get("JAX_PLATFORMS")
        if not platforms or "backend" not in str(error):
            raise
        asked = InputError(
            f"jax cannot use JAX_PLATFORMS={platforms!r} ({str(error).splitlines()[0]})",
            remedy="Set it to cpu, or unset it",
        )
        print_error(asked, as_json=as_json)
        sys.exit(EXIT_USAGE)
    except OSError as error:
        # a full disk, a folder without write permission: the person's to mend, not a bug to trace
        where = str(error.filename) if error.filename else None
        print_error(InputError(error.strerror or str(error), where=where), as_json=as_json)
        sys.exit(EXIT_USAGE)
    sys.exit(code or 0)
