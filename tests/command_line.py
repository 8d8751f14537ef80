"""The command line as a test calls it."""

from __future__ import annotations

import pytest

from mdnum.cli import main


def call(*arguments: str) -> int:
    """The exit code of `mdnum ARGUMENTS`."""
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def printed(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Lines of stdout with single spaces."""
    return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
