"""Which options each question of `mdnum fork` takes: one that would change nothing is refused."""

from __future__ import annotations

from collections.abc import Mapping

from mdnum.errors import InputError

_FOLDER = ("--set", "-o", "--no-report")
_RUNS = ("--steps", *_FOLDER)
_PAIR = (
    "--split", "--repeats", "--no-counterfactual", "--no-back", "--no-lyapunov", "--minimal", "--pin",
)  # fmt: skip

#: Question to the options that it uses; --json is taken by all.
TAKES: Mapping[str, tuple[str, ...]] = {
    "RUN_A RUN_B": (),
    "RUN_A RUN_B --replay": ("--replay", "--steps", *_PAIR, "-o", "--no-report"),
    "--vary": (*_RUNS, *_PAIR),
    "--vary all": _RUNS,
    "--vary CHOICE --benign": ("--benign", "--steps", "--set"),
    "--along": (*_RUNS, "--most"),
    "--processes": _RUNS,
    "--certify": _RUNS,
    "--forecast": _RUNS,
    "--vary of a ball": (*_RUNS, "--split", "--repeats", "--no-counterfactual"),
    "--vary all of a ball": _RUNS,
    "--certify of a ball": ("--steps", "--set"),
}  # fmt: skip


def check(question: str, given: Mapping[str, bool]) -> None:
    """Refuse an option that a question does not use.

    Args:
        question: a key of `TAKES`.
        given: option to whether it was given.

    Raises:
        InputError: names the options that the question takes.
    """
    takes = TAKES[question]
    unused = [option for option, is_given in given.items() if is_given and option not in takes]
    if not unused:
        return
    left = "Leave it out" if len(unused) == 1 else "Leave them out"
    raise InputError(
        f"{' and '.join(unused)} would change nothing of mdnum fork {question}",
        remedy=f"{left}; that question takes {', '.join((*takes, '--json'))}",
    )
