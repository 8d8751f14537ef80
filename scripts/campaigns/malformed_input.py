"""How does mdnum treat damaged system files and invalid options?

Answer. Of 345 cases, 298 are rejected with a one-line error, 46 run, and 1 run ends with a one-line error; no
case ends in another way (docs/hostile-input.md). It takes minutes.

    python scripts/campaigns/malformed_input.py [--cases 300] [--seed 1]

Each case is a system file or structure file with flipped bits, invalid numbers, deep nesting, control
characters, long lines, wrong types, or impossible boxes and coordinates. `mdnum systems check` reads each
case; if it accepts the case, the system is shown and run for two steps. A case passes if it is rejected in
one printable line with exit code 2, or if the run ends with exit code 0 or 1, or with such a line. All other
outcomes are counted by name and must not occur. Cases run in separate processes, so that a crash is counted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from _cases import answers, called, counted, serve
from _output import parser, say

OUTCOMES = ("refused", "ran", "stopped", "TRACEBACK", "RAW", "LONG", "WRONG EXIT", "CRASH", "HANG")
FINE = OUTCOMES[:3]
#: Characters of one line on a terminal, and seconds that a case may take.
LONGEST, PATIENCE = 1000, 120
_RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")

ATOMS = """\
name = "argon"
about = "A gas."
units = "metal"

[structure]
file = "atoms.extxyz"

[potential]
kind = "lennard-jones"
sigma = 3.405
epsilon = 0.0103235

[cutoff]
kind = "hard"
radius = 8.5
compare = "r2 <"

[neighbors]
skin = 1.0

[dynamics]
kind = "nve"
timestep = 0.002
temperature = 40.0
steps = 4
seed = 7
"""
STRUCTURE = """\
4
Lattice="22.0 0.0 0.0 0.0 22.0 0.0 0.0 0.0 22.0" Properties=species:S:1:pos:R:3 pbc="T T T"
Ar 1.0 1.0 1.0
Ar 5.1 1.0 1.0
Ar 1.0 9.4 1.0
Ar 21.5 6.0 12.0
"""
BALL = """\
world = "ball"

[start]
height = 1.0

[contact]
kind = "penalty"
k = 5000.0

[integrator]
kind = "semi-implicit-euler"
timestep = 0.001
steps = 20

[loss]
kind = "final-height"
"""

BUILT = 'builder = "fcc"\nsymbol = "Ar"\nlattice_constant = 5.3\n'

NUMBERS = (
    "0", "-0.0", "-1", "1e-300", "5e-324", "1e-12", "1e30", "1e200", "1e300", "1.7976931348623157e308",
    "nan", "inf", "-inf", "1e400", "9" * 30, "9" * 5000, "0x7fffffffffffffff", "18446744073709551616",
    "true", '"1.0"', "[1.0]", "{}", "1979-05-27", "''",
)  # fmt: skip
COORDINATES = (
    "nan", "inf", "-inf", "1e200", "1e300", "-1e16", "1e9", "1e400", "x", "1,0", "0x1p3", "\u0661", "",
)  # fmt: skip
TEXTS = (
    "\x1b[31mred\x1b[0m",
    "\x1b]0;title\x07",
    "\x9b2J",
    "a\x08\x08b",
    "\x07" * 5,
    "\u202egnp.exe",
    "\ufeffargon",
    "a\u200bb",
    "\u2028",
    "\u00e9" * 3000,
    "x" * 200_000,
    "../../../etc/passwd",
    "/dev/zero",
    "%s%n{0}{{}}",
    "<script>alert(1)</script>",
    "[bold]rich[/bold]",
    "\\\\?\\C:",
    "\uff21r",
    "\U000e0041",
    "-",
    "postgresql://x",
    "atoms.extxyz@0",
    "line\\nline",
)

Files = dict[str, bytes]


def _files(toml: str = ATOMS, structure: str = STRUCTURE) -> Files:
    encode = lambda text: text.encode("utf-8", "surrogatepass")  # noqa: E731
    return {"system.toml": encode(toml), "atoms.extxyz": encode(structure)}


def _base(rng: random.Random) -> str:
    return rng.choice((ATOMS, ATOMS, BALL))


def _line(rng: random.Random, text: str, what: str = r"^(\w+) = (.+)$") -> re.Match[str]:
    return rng.choice(list(re.finditer(what, text, re.MULTILINE)))


def bits(rng: random.Random) -> Files:
    """Some bits of one of the files are flipped."""
    files = _files(_base(rng))
    name = rng.choice(sorted(files))
    data = bytearray(files[name])
    for _ in range(rng.choice((1, 1, 3, 30))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return {**files, name: bytes(data)}


def numbers(rng: random.Random) -> Files:
    """A value of the file is a number that is extreme, or none."""
    text = _base(rng)
    found = _line(rng, text)
    return _files(text[: found.start(2)] + rng.choice(NUMBERS) + text[found.end(2) :])


def words(rng: random.Random) -> Files:
    """A key, a value or a table is called something that a terminal, or a reader, would act on."""
    text, word = _base(rng), rng.choice(TEXTS)
    quoted = json.dumps(word, ensure_ascii=rng.random() < 0.5).replace("\x7f", "\\u007f")
    kind = rng.randrange(6)
    if kind > 3:
        # a name that is printed where the file is fine
        found = _line(rng, ATOMS, r"^(name|about) = (.+)$")
        return _files(ATOMS[: found.start(2)] + quoted + ATOMS[found.end(2) :])
    found = _line(rng, text)
    if kind == 0:
        return _files(text[: found.start(2)] + quoted + text[found.end(2) :])
    if kind == 1:
        return _files(text[: found.start()] + f"{quoted} = 1\n" + text[found.start() :])
    if kind == 2:
        return _files(text + f"\n[{quoted}]\nx = 1\n")
    return _files(text[: found.start(2)] + word + text[found.end(2) :])


def nesting(rng: random.Random) -> Files:
    """Tables or arrays in one another, deeply."""
    text, depth = _base(rng), rng.choice((3, 30, 300, 3000, 30_000))
    found = _line(rng, text)
    value = rng.choice(("[" * depth + "]" * depth, "{a=" * depth + "1" + "}" * depth, "[" * depth))
    if rng.random() < 0.3:
        return _files(text + "\n[" + ".".join(["a"] * depth) + "]\nx = 1\n")
    return _files(text[: found.start(2)] + value + text[found.end(2) :])


def lines(rng: random.Random) -> Files:
    """Lines that are long, doubled, left out, cut or in another order."""
    text = _base(rng)
    rows = text.splitlines(keepends=True)
    kind, at = rng.randrange(5), rng.randrange(len(rows))
    if kind == 0:
        rows.insert(at, "x" * rng.choice((10_000, 1_000_000)) + rng.choice((" = 1\n", "\n", " = \x1b\n")))
    elif kind == 1:
        rows.insert(at, rows[at])
    elif kind == 2:
        del rows[at]
    elif kind == 3:
        return _files("".join(rows)[: rng.randrange(len(text))])
    else:
        rng.shuffle(rows)
    return _files("".join(rows))


def coordinates(rng: random.Random) -> Files:
    """A coordinate that is no place."""
    found = _line(rng, STRUCTURE, r"^(Ar) (.+)$")
    values = found[2].split()
    values[rng.randrange(3)] = rng.choice(COORDINATES)
    damaged = STRUCTURE[: found.start(2)] + " ".join(values) + STRUCTURE[found.end(2) :]
    if rng.random() < 0.4:
        damaged = damaged.replace('pbc="T T T"', rng.choice(('pbc="F F F"', 'pbc="F T T"', 'pbc="T F F"')))
    return _files(structure=damaged)


def boxes(rng: random.Random) -> Files:
    """A cell that is vast, flat, inside out, skewed or none."""
    cell = ["22.0", "0.0", "0.0", "0.0", "22.0", "0.0", "0.0", "0.0", "22.0"]
    for _ in range(rng.choice((1, 1, 2, 9))):
        cell[rng.randrange(9)] = rng.choice(
            ("0.0", "-22.0", "9.0", "-30", *COORDINATES[:9], "1e-300", "40", "3e8")
        )
    if rng.random() < 0.1:
        cell = cell[: rng.choice((1, 3, 8))]
    return _files(structure=re.sub('Lattice="[^"]*"', f'Lattice="{" ".join(cell)}"', STRUCTURE))


def structures(rng: random.Random) -> Files:
    """A structure file whose own frame is wrong, or that is no structure at all."""
    texts: tuple[str | bytes, ...] = (
        "",
        "\n",
        "4\n",
        "-4\n\n",
        "9" * 40 + "\n\n",
        STRUCTURE.replace("Ar", "\x1b[2J"),
        STRUCTURE.replace("Ar", "Xx"),
        STRUCTURE.replace("pos:R:3", "pos:R:30"),
        STRUCTURE.replace("pos:R:3", "pos:S:3"),
        STRUCTURE[:-30],
        STRUCTURE.replace("Properties", "\x1b]0;x\x07Properties"),
        STRUCTURE.replace("4\n", "5\n", 1),
        STRUCTURE.replace("Ar", "A" * 100_000),
        STRUCTURE + STRUCTURE.replace("1.0", "\x9b"),
        b"\x80\x04\x95\x00.",
        b"\x1f\x8b\x08\x00\x00",
        b"\xff\xfe" + STRUCTURE.encode("utf-16-le"),
        b"\x00" * 10_000,
        STRUCTURE.replace("pbc=", "momenta="),
        STRUCTURE.replace('pbc="T T T"', "pbc=[maybe]"),
        STRUCTURE.replace("5.1", "1.0"),
        STRUCTURE.replace("4\n", "1\n", 1),
        STRUCTURE.replace("4\n", "0\n", 1),
    )
    text = rng.choice(texts)
    return {**_files(), "atoms.extxyz": text if isinstance(text, bytes) else text.encode()}


def tables(rng: random.Random) -> Files:
    """A table of another kind, or with the keys of another kind."""
    swaps = (
        ("[potential]", "[[potential]]"),
        ('kind = "lennard-jones"', 'kind = ["lennard-jones"]'),
        ('kind = "lennard-jones"', 'kind = "eam"\nfile = "atoms.extxyz"'),
        ("[cutoff]", "[cutoff.pairs]"),
        ('file = "atoms.extxyz"', 'file = "system.toml"'),
        ('file = "atoms.extxyz"', 'file = "."'),
        ('file = "atoms.extxyz"', 'file = ""'),
        ('file = "atoms.extxyz"', 'file = "/dev/null"'),
        ('file = "atoms.extxyz"', 'file = "' + "a" * 5000 + '"'),
        ('file = "atoms.extxyz"', 'file = "a\\u0000b"'),
        ('file = "atoms.extxyz"', 'file = "atoms.extxyz"\nindex = 99999999999999999999'),
        ('file = "atoms.extxyz"', 'file = "atoms.extxyz"\nmasses = { Ar = 1e300 }'),
        ('file = "atoms.extxyz"', 'file = "atoms.extxyz"\nmasses = { "\\u001b[31m" = 1.0 }'),
        ('file = "atoms.extxyz"', BUILT + "repeat = [9999, 9999, 9999]"),
        ('file = "atoms.extxyz"', BUILT + "repeat = [4,4,4]\nrattle = 1e32"),
        (
            'file = "atoms.extxyz"',
            'builder = "fcc"\nsymbol = "Ar"\nlattice_constant = 1e300\nrepeat = [2, 2, 2]',
        ),
        ('file = "atoms.extxyz"', 'builder = "fcc"\nsymbol = "\\u001b[31m"\nlattice_constant = 5.3'),
        ('file = "atoms.extxyz"', BUILT + "repeat = [4,4,4]\ntilt = [1e200,0,0]"),
        ('kind = "nve"', 'kind = "langevin"\nfriction = 1e300'),
        ('kind = "nve"', 'kind = "langevin"\nfriction = 1e-300'),
        ("[neighbors]", "[neighbors]\nrebuild = { every = 9223372036854775808 }"),
        ("skin = 1.0", "skin = 0.0"),
        ("[neighbors]", "[neighbors]\nrebuild = { every = 1000000, check = false }"),
        ("[dynamics]", '[precision]\nstate = "lattice"\n\n[dynamics]'),
        ("timestep = 0.002", "timestep = 1e-300"),
        ("[dynamics]", '[precision]\nforce = "float16"\n\n[dynamics]'),
        ("sigma = 3.405", "sigma = 1e-12"),
    )
    old, new = rng.choice(swaps)
    return _files(ATOMS.replace(old, new, 1))


KINDS: tuple[Callable[[random.Random], Files], ...] = (
    bits,
    numbers,
    words,
    nesting,
    lines,
    coordinates,
    boxes,
    structures,
    tables,
)
#: Words on the command line that are no system, no option and no value.
COMMANDS = (
    ["systems", "check", "\x1b[31mred.toml"],
    ["systems", "check", "x" * 50_000],
    ["systems", "show", "a\nb"],
    ["systems", "check", "."],
    ["systems", "check", "/dev/null"],
    ["systems", "check", ""],
    ["\x9b2J"],
    ["systems", "check", "pair/at-cutoff", "--set", "cutoff.radius=\x1b[2J"],
    ["run", "--steps", "9" * 100, "x"],
    ["systems", "check", "pair/at-cutoff", "--set", "a" * 50_000 + "=1"],
    ["run", "--nothing\x07"],
    ["systems", "check", "pair/at-cutoff", "--set", "cutoff.radius=" + "[" * 5000],
    ["run", "pair/at-cutoff", "-o", "\0"],
    ["systems", "check", "pair/at-cutoff", "--set", "\x1b]0;x\x07=1"],
    ["fork", "pair/at-cutoff", "--vary", "\x1b[31m"],
    ["fork", "map", "pair/at-cutoff", "cutoff.radius=\x1b:2"],
    ["grad", "pair/at-cutoff", "--of", "\x1b[31m"],
    ["flips", "\x1b[31m.xtc"],
    ["flips", "x" * 5000],
    ["audit", "\x1b[31m:X"],
    ["audit", "a" * 9999],
    ["audit", "ase:\x1b"],
    ["conform", "\x1b[31m"],
    ["conform", "a" * 9999],
    ["ball", "--demo", "\x1b[31m"],
    ["report", "\x1b[31m"],
    ["ball", "ball/drop", "--against", "\x1b=1"],
    ["check", "energy", "\x1b[31m"],
    ["run", "--resume", "\x1b[31m"],
    ["systems", "show", "pair/at-cutoff", "--set", 'about="\x9b\u202e"'],
)


def cases(count: int, seed: int) -> Iterator[tuple[str, Files]]:
    """(kind, files), the kinds in turn."""
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        yield kind.__name__, kind(random.Random(f"{seed} {number}"))


def call(words: list[str]) -> tuple[str, str]:
    """(outcome, what was printed) of one command in this process."""
    code, out, err = called(words)
    told = err.splitlines()
    last = told[-1] if told else ""
    if code is None:
        return "TRACEBACK", last[:300]
    if _RAW.search(out + err):
        return "RAW", repr((out + err)[:300])
    if max(map(len, told), default=0) > LONGEST:
        return "LONG", (out + err)[:100]
    if code == 2:
        # a run that stopped at a number that is not finite says so in the same way
        return ("refused" if last.startswith("mdnum: ") else "WRONG EXIT"), last
    return ("ran" if code in (0, 1) else "WRONG EXIT"), last


def examine(files: Files, folder: Path) -> tuple[str, str]:
    """What becomes of a system file: checked, and run for two steps where it is accepted."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    path = str(folder / "system.toml")
    outcome, said = call(["systems", "check", path])
    if outcome != "ran":
        return outcome, said
    outcome, shown = call(["systems", "show", path])
    if outcome != "ran":
        return outcome, shown
    ball = b'world = "ball"' in files["system.toml"]
    outcome, said = call(["ball" if ball else "run", path, "--steps", "2", "-o", str(folder / "run")])
    return ("stopped" if outcome == "refused" else outcome), said


def campaign(count: int, seed: int) -> Iterator[tuple[str, str]]:
    """(kind, outcome) of every case and every command."""
    words = ("--cases", str(count), "--seed", str(seed))
    found = answers(__file__, range(count), PATIENCE, *words)
    for number, ((kind, _), (outcome, said)) in enumerate(zip(cases(count, seed), found, strict=True)):
        if outcome not in FINE:
            say(f"  case {number} ({kind}): {outcome} {said}")
        yield kind, outcome
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for words in COMMANDS:
            outcome, said = call(words)
            if outcome not in FINE:
                say(f"  {words!r:.60}: {outcome} {said}")
            yield "command line", outcome


def main() -> int:
    """Runs the campaign and prints its table; 1 where an outcome was not fine."""
    made = parser(__doc__)
    made.add_argument("--cases", type=int, default=300)
    made.add_argument("--seed", type=int, default=1)
    made.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    asked = made.parse_args()
    if asked.serve:
        every = [files for _, files in cases(asked.cases, asked.seed)]

        def one(number: int) -> tuple[str, str]:
            with tempfile.TemporaryDirectory() as folder:
                return examine(every[number], Path(folder))

        serve(one)
        return 0
    found = list(campaign(asked.cases, asked.seed))
    print(counted("damage", OUTCOMES, found))
    return int(any(outcome not in FINE for _, outcome in found))


if __name__ == "__main__":
    sys.exit(main())
