"""Entry point of `python -m mdnum`, which is equivalent to the command `mdnum`."""

from __future__ import annotations

import os
import signal
import sys

if __name__ == "__main__" and not sys.flags.safe_path and sys.path[:1] == [os.getcwd()]:
    # Python puts the current folder first; off it goes before a package is looked for there
    del sys.path[0]


def main() -> None:
    """Run the command line and exit.

    Control-C ends the process at once during imports and after the results are saved. An interrupted import
    would otherwise fail in unpredictable ways.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            # closed by who started it: the next file, one of a run folder, would take its number
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, open(number, "r+", encoding="utf-8", closefd=False))  # noqa: SIM115
    catching = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if catching:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from mdnum.cli import main as command

    try:
        command()
    finally:
        if catching:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()
