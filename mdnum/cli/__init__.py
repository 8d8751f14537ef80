"""The command line: parse, call, print. No science here, and no import of jax.

Every verb is a function that returns its exit code: 0 fine, 1 findings, 2 a mistake in what was asked, 3 time
was up before a verdict.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import hashlib
import os
import platform
import sys
from typing import Any, NoReturn

import typer

from mdnum.cli.output import EXIT_STOPPED, EXIT_USAGE, print_error, say
from mdnum.cli.verbs import app
from mdnum.errors import InputError, MdnumError

# typer carries its own copy of click in some versions and imports click in others; either way
# BadParameter derives from the usage error that its parser raises
_UsageError: Any = typer.BadParameter.__base__


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
        # XLA takes its own hints (prefer-no-gather) for what the processor lacks and prints pages of it
        # whenever it loads a program; what ends a process is logged still
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit.

    Args:
        arguments: what follows `mdnum`; the process's own when None.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    as_json = "--json" in arguments
    # imports and compilers make half a million objects that stay: walking them for garbage takes a sixth of a
    # short command's time, and walking them once more as the process ends half a second
    gc.set_threshold(1_000_000, 20, 20)
    atexit.register(gc.freeze)
    _keep_programs()
    try:
        code = app(arguments, standalone_mode=False, prog_name="mdnum")
    except MdnumError as error:
        asked = error
    except _UsageError as error:
        # no arguments at all is a request for help, which click raises as a usage error
        if type(error).__name__ == "NoArgsIsHelpError":
            say(error.format_message())
            sys.exit(EXIT_USAGE)
        place = error.ctx.command_path if error.ctx else "mdnum"
        asked = InputError(_said(error), remedy=f"See `{place} --help`")
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(EXIT_STOPPED)
    except MemoryError as error:
        needed = f"more memory is needed than there is ({error})"
        asked = InputError(needed, remedy="Ask for fewer atoms, balls or steps")
    except RuntimeError as error:
        platforms = os.environ.get("JAX_PLATFORMS")
        if not platforms or "backend" not in str(error):
            raise
        why = f"jax cannot use JAX_PLATFORMS={platforms!r} ({str(error).splitlines()[0]})"
        asked = InputError(why, remedy="Set it to cpu, or unset it")
    except OSError as error:
        # a full disk, a folder without write permission: the person's to mend, not a bug to trace
        where = str(error.filename) if error.filename else None
        asked = InputError(error.strerror or str(error), where=where)
    else:
        sys.exit(code or 0)
    print_error(asked, as_json=as_json)
    sys.exit(asked.exit_code)


#: What was expected, by the name that the parser of options has for it.
_EXPECTED = {"int_parsing": "a whole number", "int_from_float": "a whole number", "float_parsing": "a number"}


def _said(error: Any) -> str:
    """What is wrong with the words of a command, with the word itself where it is a number's."""
    details = getattr(error.__cause__, "errors", None)
    if details is None or details()[0]["type"] not in _EXPECTED:
        return error.format_message()
    (detail, *_), name = details(), error.param.opts[0]
    return f"{name} {detail['input']}: expected {_EXPECTED[detail['type']]}"
