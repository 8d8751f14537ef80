"""Command line of mdnum: arguments, commands and printing.

The command line does not import jax. The exit code is 0 without findings, 1 with findings and 2 for invalid
input. The exit code is 3 if the time limit ended the command.
"""

from __future__ import annotations

import atexit
import codecs
import contextlib
import gc
import hashlib
import logging
import os
import platform
import sys
from typing import Any, NoReturn

import typer

from mdnum.cli.commands import app
from mdnum.cli.output import EXIT_STOPPED, EXIT_USAGE, is_interrupt, print_error, print_lines, say
from mdnum.errors import InputError, MdnumError, json_escape

# typer carries its own copy of click in some versions and imports click in others; either way
# BadParameter derives from the usage error that its parser raises
_UsageError: Any = typer.BadParameter.__base__


def programs_folder() -> str:
    """Return the name of the cache folder for compiled functions of this kind of processor."""
    features = platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        features = next((line for line in file if line.startswith(("flags", "Features"))), features)
    return f"programs-{hashlib.sha256(features.encode()).hexdigest()[:12]}"


def _keep_programs() -> None:
    """Set up jax's compilation cache, so that later commands reuse compiled functions.

    Machines with different processors may share a home folder or a cache folder.
    """
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":  # which jax sets where nobody has
        # XLA takes its own hints (prefer-no-gather) for what the processor lacks and prints pages of it
        # whenever it loads a program; what ends a process is logged still
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    named = os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = os.path.join(home, "mdnum") if named is None else named
    if "://" not in folder and folder:
        # an empty name turns it off, and an address is none of a folder
        if os.path.basename(folder) != programs_folder():
            folder = os.path.join(folder, programs_folder())
        with contextlib.suppress(OSError):
            os.makedirs(folder, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    if named is None:
        os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(512 * 2**20)
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"


def _set_up() -> None:
    """Change settings of the process, such as garbage collection."""
    # imports and compilers make half a million objects that stay: walking them for garbage takes a sixth of a
    # short command's time, and walking them once more as the process ends half a second
    gc.set_threshold(1_000_000, 20, 20)
    atexit.register(gc.freeze)
    _keep_programs()
    # figures become files, whatever windows are drawn with; matplotlib cannot be imported if it knows no such
    os.environ["MPLBACKEND"] = "agg"
    # where it cannot keep its list of fonts, it says so in two lines
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # what an encoding lacks is written as JSON writes it, which is right in JSON and can be read elsewhere
    escape: Any = lambda bad: (json_escape(bad.object[bad.start : bad.end]), bad.end)  # noqa: E731
    codecs.register_error("mdnum", escape)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):
            stream.reconfigure(errors="mdnum")  # pyright: ignore


def _no_device(error: BaseException) -> str | None:
    """Return a message if JAX_PLATFORMS names a missing device. None for other errors."""
    platforms, trace = os.environ.get("JAX_PLATFORMS"), error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    # for some it has a message, for others an assertion
    raised_by = trace.tb_frame.f_code.co_filename if trace is not None else ""
    if not platforms or not ("backend" in str(error) or os.path.basename(raised_by) == "xla_bridge.py"):
        return None
    return f"jax cannot use JAX_PLATFORMS={platforms!r} ({(str(error) or 'no such device').splitlines()[0]})"


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit.

    Args:
        arguments: command-line arguments after `mdnum`; None for the arguments of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    as_json = "--json" in arguments
    _set_up()
    # rich, which prints what verbs answer, reads the variable itself (https://no-color.org)
    color = False if os.environ.get("NO_COLOR") else None
    try:
        code = app(arguments, standalone_mode=False, prog_name="mdnum", color=color)
    except MdnumError as error:
        asked = error
    except _UsageError as error:
        # no arguments at all is a request for help, which click raises as a usage error
        if type(error).__name__ == "NoArgsIsHelpError":
            say(error.format_message())
            sys.exit(EXIT_USAGE)
        place = error.ctx.command_path if error.ctx else "mdnum"
        asked = InputError(_said(error), remedy=f"See `{place} --help`")
    except typer.Abort:
        sys.exit(EXIT_STOPPED)
    except MemoryError as error:
        needed = f"more memory is needed than there is ({error})"
        asked = InputError(needed, remedy="To save memory, simulate fewer atoms, balls or steps")
    except OSError as error:
        # a full disk, a folder without write permission: the person's to mend, not a bug to trace
        where = str(error.filename) if error.filename else None
        asked = InputError(error.strerror or str(error), where=where)
    except BaseException as error:
        if is_interrupt(error):
            sys.exit(EXIT_STOPPED)
        if (seen := _no_device(error)) is None:
            raise
        asked = InputError(seen, remedy="Set the environment variable JAX_PLATFORMS to cpu, or unset it")
    else:
        compiled = sys.modules.get("mdnum.compiled")
        print_lines([] if compiled is None or compiled.all_kept() else [compiled.NOT_KEPT])
        sys.exit(code or 0)
    print_error(asked, as_json=as_json)
    sys.exit(asked.exit_code)


#: Descriptions of expected values, by the names of types in the option parser.
_EXPECTED = {"int_parsing": "a whole number", "int_from_float": "a whole number", "float_parsing": "a number"}


def _said(error: Any) -> str:
    """Return the message of a usage error. If a number was expected, quote the user's text."""
    details = getattr(error.__cause__, "errors", None)
    if details is None or details()[0]["type"] not in _EXPECTED:
        return error.format_message()
    (detail, *_), name = details(), error.param.opts[0]
    return f"{name} {detail['input']}: expected {_EXPECTED[detail['type']]}"
