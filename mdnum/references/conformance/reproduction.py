"""Write a failing test case as a Python script with a brute-force search."""

from __future__ import annotations

import base64
import inspect
import io
import os
import subprocess
import tempfile
import textwrap
import zlib
from collections.abc import Iterator
from pathlib import Path
from pprint import pformat

import numpy as np

from mdnum.deadline import Deadline
from mdnum.plain import beside
from mdnum.references.conformance import answer
from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.judge import Conventions, Failed, Report
from mdnum.references.conformance.lists import PairList
from mdnum.safe_path import environment, python

_PRINTED = 60  # atoms whose coordinates are written out
_LINES = beside(__file__)  # parts of a script


def script(
    tested: PairList, failed: Failed, how: Conventions, superset: bool = False, reach: float | None = None
) -> str:
    """Return a script that checks the neighbor list by brute force for a test case.

    The script requires only numpy and the neighbor list. The script prints the error and exits with status 1.
    The status is 0 if the list is correct. The script does not catch the neighbor list's exceptions.

    Args:
        how: conventions of the neighbor list.
        superset: whether pairs beyond the cutoff may be listed.
        reach: largest distance of pairs beyond the cutoff, length; `Report.reach`.
    """
    case, worst = failed.case, failed.worst
    usual = case.r_cut + (2 * case.skin if case.skin else 0.5 * case.r_cut)
    reach = (usual if reach is None else reach) if superset else case.r_cut
    title = f"{tested.name}{f' {tested.version}' if tested.version else ''}: {worst.text}"
    case_words = f"Found by: {failed.case.name}, at its step {worst.step}."
    # an exception may quote code, whose strings must not end this one
    title = title.replace("\\", "/").replace('"""', "'''")
    begin = f"\nkept, held = {tested.call}(), None" if tested.kept else ""
    kind = "kept" if tested.kept else "once"
    before, given = (_LINES[name].format(call=tested.call) for name in (f"earlier_{kind}", kind))
    earlier = "\n" + _LINES["earlier"].format(given=before) if failed.earlier else ""
    text = inspect.getsource(answer)
    parts = [
        '"""' + "\n".join(textwrap.wrap(title, 100)) + f'\n\n{case_words}\n"""',
        "from __future__ import annotations\n\nimport collections\nimport itertools\n\nimport numpy as np",
        tested.source.strip() or f"# import {tested.call} here: its lines could not be found",
        _numbers(failed, how, reach),
        text[text.index("from collections.abc") :].strip(),
        _LINES["asked"].strip(),
        _LINES["brute_force"].strip(),
        *([_LINES["waits"]] if worst.code == "NO_ANSWER" else []),
        _LINES["steps"].strip().format(begin=begin, earlier=earlier, given=given),
        'print("the list is right" if fine else "the list is wrong")\nraise SystemExit(not fine)',
    ]
    return "\n\n\n".join(parts) + "\n"


def _numbers(failed: Failed, how: Conventions, reach: float) -> str:
    """Return the numbers of a test case as Python source code."""
    case, stills = failed.case, []
    several = any(other.skin is not None for other in case.stills)
    for still, fresh, skin in _calls(case):
        anew = f", {skin!r}" if fresh and several else ""
        stills.append(f"    ({_array(still.positions)},\n     {_array(still.cell)}, {fresh}{anew}),")
    lines = [
        f"R_CUT, SKIN, REACH = {case.r_cut!r}, {case.skin!r}, {reach!r}",
        f"PBC = np.array({list(case.pbc)})",
        f"FULL = {how.full}  # every pair from both of its atoms",
        f"SIGN = {how.sign}  # +1: shifts are added to atom j",
        f"TOWARD = {how.toward}  # +1: vectors point from i to j",
        f"TOLERANCE = {16 * how.unit!r}  # a decision this close to the cutoff is rounding",
        "STEPS = [  # positions, cell (vectors as rows), whether the list starts anew (its skin)",
        *stills,
        "]",
    ]
    if failed.earlier:
        lines.append("EARLIER = [  # positions, cell and, of a list that starts anew, pbc, r_cut, skin")
    for other in failed.earlier:
        for still, fresh, skin in _calls(other):
            anew = f",\n     np.array({list(other.pbc)}), {other.r_cut!r}, {skin!r}" if fresh else ""
            lines.append(f"    ({_array(still.positions)},\n     {_array(still.cell)}{anew}),")
    lines += ["]"] if failed.earlier else []
    cases = (case, *failed.earlier)
    if any(len(still.positions) > _PRINTED for other in cases for still in other.stills):
        lines.insert(0, "import base64\nimport io\nimport zlib\n\n" + _LINES["unpack"] + "\n")
    return "\n".join(lines)


def _calls(case: Case) -> Iterator[tuple[Still, bool, float]]:
    """For each call, yield the positions and cell, whether a list is built, and the skin."""
    atoms = None
    for still in case.stills:
        count = len(still.positions)
        fresh = atoms is None or still.fresh or count != atoms
        yield still, fresh, case.skin if still.skin is None else still.skin
        atoms = count


#: Code that runs a script: it ends with this process, and has the same memory limit as the original call.
_RUN = (
    "import runpy, sys; from mdnum.safe_path import guard; guard(int(sys.argv[2])); "
    "runpy.run_path(sys.argv[1], run_name='__main__')"
)
_SECONDS = 60.0  # seconds that a script may take


def reproduces(report: Report, failed: Failed, deadline: Deadline) -> bool | None:
    """Run the script of a failure. Return whether the failure appears. None without a result."""
    tested, code, text = report.tested, failed.code, failed.worst.text
    if not tested.source.strip() or deadline.passed:
        return None
    seconds = min(_SECONDS, deadline.left)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "reproduce.py"
        lines = script(tested, failed, report.how, report.superset, report.reach(failed.case))
        path.write_text(lines, encoding="utf-8")
        command = python("-c", _RUN, str(path), str(os.getpid()))
        try:
            done = subprocess.run(
                command, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return code == "NO_ANSWER" if seconds == _SECONDS else None
    said, errors = done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace")
    if code == "RAISED":
        return done.returncode == 1 and text.partition(":")[0] in errors
    if code == "CRASHED":
        left = "SystemExit" in text and "it ends the process" in said
        return left or done.returncode < 0 or f"exit code {done.returncode}:" in f"{text}:"
    return done.returncode == 1 and said.rstrip().endswith("the list is wrong")


def _array(values: np.ndarray) -> str:
    """Return a Python expression that recreates an array bit for bit."""
    if len(values) > _PRINTED:
        sink = io.BytesIO()
        np.save(sink, np.ascontiguousarray(values))
        return f"unpacked({base64.b85encode(zlib.compress(sink.getvalue(), 9)).decode()!r})"
    if not len(values):
        return "np.zeros((0, 3))"
    if not np.any(values):
        return f"np.zeros({values.shape})"
    text = pformat([[float(number) for number in row] for row in values], width=96)
    return f"np.array({text.replace(chr(10), chr(10) + '              ')})"
