"""A failing case as a Python script that reproduces it without mdnum: the list, the numbers, brute force."""

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
from mdnum.references.conformance import answer
from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.judge import Conventions, Failed, Report
from mdnum.references.conformance.lists import PairList
from mdnum.safe_path import environment, python

_PRINTED = 60  # atoms whose coordinates are written out

_BRUTE_FORCE = '''
def right_pairs(x, cell, reach):
    """Every pair within reach, each once: {(i, j, shift): distance}, x[j] - x[i] + shift @ cell."""
    box = np.where(PBC[:, None], cell, 0.0)
    if PBC.any():
        # fractions along the axes that repeat; normals stand in for the others
        full = np.array(box)
        if not PBC.all():
            full[~PBC] = np.linalg.svd(np.vstack([box[PBC], np.zeros((1, 3))]))[2][PBC.sum():]
        home = np.where(PBC, -np.floor(np.linalg.solve(full.T, x.T).T), 0).astype(int)
        width = 1 / np.linalg.norm(np.linalg.inv(full), axis=0)
        most = np.where(PBC, (reach / width).astype(int) + 1, 0)
    else:
        home, most = np.zeros(x.shape, int), np.zeros(3, int)
    found = {}
    for vector in itertools.product(*(range(-m, m + 1) for m in most)):
        for i in range(len(x)):
            shift = np.array(vector) + home[i:] - home[i]
            apart = np.sqrt(((x[i:] - x[i] + shift @ box) ** 2).sum(axis=1))
            for k in np.flatnonzero(apart <= reach):
                if k or vector > (0, 0, 0):
                    found[i, i + int(k), tuple(int(s) for s in shift[k])] = float(apart[k])
    return found


def check(step, x, cell, given):
    """Compares what the list gave with brute force; returns whether it is right."""
    try:
        answer = read(given)
    except Malformed as error:
        print(f"step {step}: {error}")
        return False
    scale = np.abs(x).max(initial=0.0) + np.abs(np.where(PBC[:, None], cell, 0.0)).sum() + R_CUT
    close = TOLERANCE * scale
    right = right_pairs(x, cell, REACH + close)
    box = np.where(PBC[:, None], cell, 0.0)
    i, j = answer.i, answer.j
    bad = [f"row {n}: ({a}, {b}) with {len(x)} atoms" for n, (a, b) in enumerate(zip(i, j))
           if not (0 <= a < len(x) and 0 <= b < len(x))]
    shift, told, vector = answer.shift, answer.distance, answer.vector
    if told is None and shift is None and vector is not None:
        told = np.linalg.norm(vector, axis=1)
    lengths = collections.defaultdict(list)
    for (a, b, _), apart in right.items():
        lengths[a, b].append(apart)
    listed = collections.Counter()
    for n, (a, b) in enumerate(zip(i.tolist(), j.tolist()) if not bad else ()):
        s = (0, 0, 0) if shift is None else tuple(int(v) for v in SIGN * shift[n])
        turned = a > b or (a == b and s < (0, 0, 0))
        key = (b, a, tuple(-v for v in s)) if turned else (a, b, s)
        listed[key if shift is not None else key[:2]] += 1
        near = [right[key]] if key in right else [] if shift is not None else lengths[key[:2]]
        if told is not None and near:
            off = min(abs(float(told[n]) - apart) for apart in near)
            if not off <= 2 * close:
                bad.append(f"{a}-{b}: distance off by {off:.3g}")
        if vector is not None and shift is not None:
            off = np.abs(TOWARD * vector[n] - (x[b] - x[a] + np.array(s) @ box)).max()
            if not off <= 2 * close:
                bad.append(f"{a}-{b}: vector off by {off:.3g}")
    times = 2 if FULL else 1
    needed, allowed = collections.Counter(), collections.Counter()
    for key, apart in right.items():
        name = key if shift is not None else key[:2]
        allowed[name] += times
        needed[name] += times if apart < R_CUT - close else 0
    for key in sorted(set(listed) | set(needed)):
        if listed[key] < needed[key]:
            nearest = min(d for k, d in right.items() if k[:len(key)] == key)
            bad.append(f"pair {key}: listed {listed[key]} times, should be {needed[key]}; at {nearest:.9g}")
        elif listed[key] > allowed[key]:
            bad.append(f"pair {key}: listed {listed[key]} times, should be at most {allowed[key]}")
        elif FULL and listed[key] % 2:
            bad.append(f"pair {key}: listed from one of its atoms only")
    for line in bad[:10]:
        print(f"step {step}: {line}")
    return not bad
'''

#: A list is asked at each step; a line of what follows is how, for one made anew and for one that is kept.
_STEPS = """
fine = True{begin}{earlier}
for step, (x, cell, fresh, *skin) in enumerate(STEPS):
    before = x.copy(), cell.copy()
    {given}
    if not (np.array_equal(x, before[0]) and np.array_equal(cell, before[1])):
        print(f"step {{step}}: the call wrote to its input")
        fine = False
    fine = check(step, *before, given) and fine
"""
_ONCE = "given = asked({call}, x, cell, PBC, R_CUT)"
_KEPT = """if not fresh and held is not None and held[0].shape == x.shape:
        held[0][...], held[1][...] = x, cell  # atoms are moved where they are, as a program does it
        x, cell = held
    held = x, cell
    anew = fresh and (PBC, R_CUT, *(skin or [SKIN]))
    given = asked(kept.allocate, x, cell, *anew) if fresh else asked(kept.update, x, cell)"""

#: Calls that come first, whatever they return.
_EARLIER = """
for x, cell, *anew in EARLIER:
    try:
        {given}
    except Exception as error:
        print(f"an earlier call raised {{type(error).__name__}}")"""
_EARLIER_ONCE = "{call}(x, cell, *anew[:2])"
_EARLIER_KEPT = "kept.allocate(x, cell, *anew) if anew else kept.update(x, cell)"

_WAITS = 'print("it waits for an answer; Control-C ends it", flush=True)'

_ASKED = '''
def asked(function, *arguments):
    """What the list returns."""
    try:
        return function(*arguments)
    except SystemExit as error:
        print(f"it ends the process: SystemExit: {error}")
        raise SystemExit("the list is wrong")
'''


def script(
    tested: PairList, failed: Failed, how: Conventions, superset: bool = False, reach: float | None = None
) -> str:
    """Lines that call the list with the numbers of a failing case and compare it with brute force.

    It needs numpy and the list; it prints what is wrong and exits with 1, or with 0 once the list is right.
    An exception of the list is left to be seen.

    Args:
        how: conventions of the list.
        superset: pairs beyond the cutoff may be listed.
        reach: how far they may be, length; `Report.reach`.
    """
    case, worst = failed.case, failed.worst
    usual = case.r_cut + (2 * case.skin if case.skin else 0.5 * case.r_cut)
    reach = (usual if reach is None else reach) if superset else case.r_cut
    title = f"{tested.name}{f' {tested.version}' if tested.version else ''}: {worst.text}"
    case_words = f"Found by: {failed.case.name}, at its step {worst.step}."
    # an exception may quote code, whose strings must not end this one
    title = title.replace("\\", "/").replace('"""', "'''")
    begin = f"\nkept, held = {tested.call}(), None" if tested.kept else ""
    before = _EARLIER_KEPT if tested.kept else _EARLIER_ONCE.format(call=tested.call)
    earlier = _EARLIER.format(given=before) if failed.earlier else ""
    text = inspect.getsource(answer)
    parts = [
        '"""' + "\n".join(textwrap.wrap(title, 100)) + f'\n\n{case_words}\n"""',
        "from __future__ import annotations\n\nimport collections\nimport itertools\n\nimport numpy as np",
        tested.source.strip() or f"# import {tested.call} here: its lines could not be found",
        _numbers(failed, how, reach),
        text[text.index("from collections.abc") :].strip(),
        _ASKED.strip(),
        _BRUTE_FORCE.strip(),
        *([_WAITS] if worst.code == "NO_ANSWER" else []),
        _STEPS.strip().format(
            begin=begin, earlier=earlier, given=_KEPT if tested.kept else _ONCE.format(call=tested.call)
        ),
        'print("the list is right" if fine else "the list is wrong")\nraise SystemExit(not fine)',
    ]
    return "\n\n\n".join(parts) + "\n"


def _numbers(failed: Failed, how: Conventions, reach: float) -> str:
    """The case as constants."""
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
        lines.insert(0, "import base64\nimport io\nimport zlib\n\n" + _UNPACK)
    return "\n".join(lines)


def _calls(case: Case) -> Iterator[tuple[Still, bool, float]]:
    """(still, whether the list starts anew there, its skin) at every step."""
    atoms = None
    for still in case.stills:
        count = len(still.positions)
        fresh = atoms is None or still.fresh or count != atoms
        yield still, fresh, case.skin if still.skin is None else still.skin
        atoms = count


#: What a script is run by: it ends with this process, and has as much memory as when the list was asked.
_RUN = (
    "import runpy, sys; from mdnum.safe_path import guard; guard(int(sys.argv[2])); "
    "runpy.run_path(sys.argv[1], run_name='__main__')"
)
#: Seconds that a script may take.
_SECONDS = 60.0


def reproduces(report: Report, failed: Failed, deadline: Deadline) -> bool | None:
    """Whether the script of a failure shows it when it is run; None where it cannot be run in time."""
    tested, code, text = report.tested, failed.code, failed.worst.text
    if not tested.source.strip() or deadline.passed:
        return None
    seconds = min(_SECONDS, deadline.left)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "reproduce.py"
        path.write_text(
            script(tested, failed, report.how, report.superset, report.reach(failed.case)), encoding="utf-8"
        )
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


_UNPACK = '''
def unpacked(text):
    """An array that would fill pages."""
    return np.load(io.BytesIO(zlib.decompress(base64.b85decode(text))))

'''.lstrip()


def _array(values: np.ndarray) -> str:
    """An array as an expression that gives the same bits."""
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
