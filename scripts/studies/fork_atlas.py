"""Which choice forks which system under which cutoff, when, and did the flips cause the split?

Answer. Of argon/crystal-108 and five choices over 4,000 steps, only precision forks under a hard or shifted
cutoff, and its flips are the cause; under a switched one three choices fork, and no flip is found to be a
cause. It takes 110 s for these 15 cells, hours for the whole map.

Every choice that `mdnum fork` can vary, for every system under every kind of cutoff: one cell each. A
cell follows the run, its twin with the choice made otherwise, the twin's arithmetic under the first run's
decisions, and repeats that tell a delay from chance. The map's color is the step of the fork; its letter
is the verdict:

    =  same        no bit differed            -  no fork    bits differed, no decision did
    ?  open        no split within the steps  b  bystander  the flips only came along
    H  accelerated: later without the flips   C  cause      no split without the flips
    u  undecided   the repeats do not tell    x  failed     the cell could not be run
    an empty cell: the choice does not apply

Finished cells stay in a CSV file beside the figure; started again, the script makes only those that are
missing, and draws all of them. A cell that fails is noted, and tried again at the next start.

How to read it. Down a column: choices are alike in what they do once a bit differs, and differ in how
large that bit is, hence in when. Along a row: hard and shifted cutoffs have the same forces and the same
letters; where a letter changes from C or H under a hard cutoff to b under a switched one, the cutoff is
to blame and not the choice. Choices marked with a star cannot change a bit by design: anything but = or
an empty cell is a finding.
"""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import _shared  # noqa: F401  what scripts share is found by it
import jax
import numpy as np
from _liquid import liquid
from _output import figure, parser, save, say, start, table
from cutoff_sensitivity import variant
from matplotlib.colors import LogNorm

from mdnum.errors import InputError, MdnumError
from mdnum.forks import fork
from mdnum.forks.choices import Choice, parse, shipped, twin_or_reason
from mdnum.forks.worlds import varied
from mdnum.md.cutoffs import CUTOFFS
from mdnum.numerics.verdicts import REPEATS
from mdnum.systems import Simulation, System, load

KINDS = ("hard", "shifted", "force-shifted", "switched")
SYSTEMS = ("argon/crystal-108", "liquid:256", "argon/tilted-500")
QUICK = ("precision", "reduction=exact", "order", "order@exact", "start")
LETTERS = {
    "same": "=", "no fork": "-", "open": "?", "bystander": "b", "accelerated": "H", "undecided": "u",
    "cause": "C", "failed": "x", "does not apply": "",
}  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """What became of one choice under one cutoff of one system; dates in steps, None where there is none."""

    system: str
    cutoff: str
    choice: str
    asked: int
    repeats: int
    verdict: str
    seed: int | None
    fork: int | None
    split: int | None
    told: int | None
    nats: float | None
    steps: int
    seconds: float
    note: str

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """What was asked."""
        return self.system, self.cutoff, self.choice, self.asked, self.repeats


class Book:
    """Finished cells in a CSV file, a line each, written as soon as they are there."""

    def __init__(self, path: Path):
        self.path = path
        self.cells: dict[tuple[str, str, str, int, int], Cell] = {}
        names = [field.name for field in fields(Cell)]
        if path.is_file():
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            for row in rows:
                # a line that a killed process did not finish is made again
                if None not in row.values() and list(row) == names:
                    cell = Cell(**{name: _value(hint, row[name]) for name, hint in _HINTS.items()})
                    self.cells[cell.key] = cell
        # whole lines only: the next one must not go on with half of another
        self._write_all(names)

    def _write_all(self, names: list[str]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_suffix(".tmp")
        with draft.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(asdict(cell) for cell in self.cells.values())
        draft.replace(self.path)

    def add(self, cell: Cell) -> None:
        """Keep a cell."""
        self.cells[cell.key] = cell
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, [field.name for field in fields(Cell)]).writerow(asdict(cell))

    def has(self, key: tuple[str, str, str, int, int]) -> bool:
        """Whether a cell is finished."""
        return key in self.cells and self.cells[key].verdict != "failed"


_HINTS = get_type_hints(Cell)


def _value(hint: Any, text: str) -> Any:
    """A field of a CSV line."""
    if hint is str:
        return text
    if text == "":
        return None
    return int(text) if hint in (int, int | None) else float(text)


def system_of(word: str) -> System:
    """A shipped system by name, or "liquid:256": a Lennard-Jones liquid of so many atoms."""
    head, _, atoms = word.partition(":")
    system = liquid(int(atoms)) if head == "liquid" and atoms.isdigit() else load(word, world="md")
    if system.spec.cutoff is None:
        what = "a sum of terms" if system.spec.potential is None else system.spec.potential.kind
        raise InputError(
            f"{what} carries its own cutoffs, so there is no other kind of them",
            where=system.name,
            remedy="Choose systems with a pair potential",
        )
    return system


def cell_of(system: Simulation, word: str, kind: str, choice: Choice, steps: int, repeats: int) -> Cell:
    """Follow one choice; an error is a cell, too."""
    begun = time.perf_counter()

    def ended(verdict: str, note: str) -> Cell:
        seconds = round(time.perf_counter() - begun, 2)
        return Cell(
            word, kind, choice.name, steps, repeats, verdict, None, None, None, None, None, 0, seconds, note
        )

    try:
        twin = twin_or_reason(choice, system)
        if isinstance(twin, str):
            return ended("does not apply", twin)
        found = fork(twin, steps, repeats=repeats)
    except (MdnumError, ArithmeticError, RuntimeError, ValueError) as error:
        return ended("failed", str(error).splitlines()[0])
    failed = ", ".join(f"{name}: {why}" for name, why in found.failed.items())
    return replace(
        ended(found.verdict.word, failed),
        seed=found.dates.first_bit,
        fork=found.dates.fork,
        split=found.dates.split,
        told=found.splits.get("B|A"),
        nats=found.verdict.e_foldings,
        steps=found.steps,
    )


def fill(
    book: Book,
    systems: dict[str, System],
    kinds: Sequence[str],
    choices: Sequence[Choice],
    steps: int,
    repeats: int,
) -> list[Cell]:
    """Make the cells that are missing; all that were asked for, in order."""
    wanted = [(word, kind, choice) for word in systems for kind in kinds for choice in choices]
    keys = [(word, kind, choice.name, steps, repeats) for word, kind, choice in wanted]
    missing = [one for one, key in zip(wanted, keys, strict=True) if not book.has(key)]
    say(f"{len(wanted)} cells, {len(missing)} to make; kept in {book.path}")
    begun, cut = time.perf_counter(), {}
    for done, (word, kind, choice) in enumerate(missing):
        if (word, kind) not in cut:
            # programs of one cutoff are of no use to the next
            jax.clear_caches()
            cut[word, kind] = varied(systems[word], variant(systems[word], kind, 1.0))
        cell = cell_of(cut[word, kind], word, kind, choice, steps, repeats)
        book.add(cell)
        left = (time.perf_counter() - begun) / (done + 1) * (len(missing) - done - 1) / 60
        say(f"{done + 1}/{len(missing)} {word} {kind} {choice.name}: {cell.verdict}; {left:.0f} min left")
    return [book.cells[key] for key in keys]


def draw(cells: list[Cell], choices: Sequence[Choice], path: Path) -> None:
    """The map: a row for each choice, a column for each cutoff, a block for each system."""
    columns = list(dict.fromkeys((cell.system, cell.cutoff) for cell in cells))
    rows = [choice.name for choice in choices]
    forks = np.full((len(rows), len(columns)), np.nan)
    for cell in cells:
        if cell.fork is not None:
            forks[rows.index(cell.choice), columns.index((cell.system, cell.cutoff))] = max(1, cell.fork)
    drawn = figure(3.6 + 0.55 * len(columns), 2.6 + 0.21 * len(rows))
    axes = drawn.subplots()
    axes.set_facecolor("#f1f3f5")
    low, high = (np.nanmin(forks), np.nanmax(forks)) if np.isfinite(forks).any() else (1, 10)
    norm = LogNorm(low, max(high, 1.01 * low))
    # bright is early: the eye goes where runs part first
    image = axes.imshow(forks, cmap="viridis_r", norm=norm, aspect="auto", interpolation="nearest")
    for cell in cells:
        y, x = rows.index(cell.choice), columns.index((cell.system, cell.cutoff))
        dark = cell.fork is not None and norm(max(1, cell.fork)) > 0.5
        ink = "white" if dark else "black"
        axes.text(x, y, LETTERS[cell.verdict], ha="center", va="center", color=ink, fontsize=8)
    axes.set_yticks(
        range(len(rows)), [f"{choice.name} *" if choice.must_hold else choice.name for choice in choices]
    )
    axes.set_xticks(range(len(columns)), [kind for _, kind in columns], rotation=60, ha="right")
    axes.grid(False)
    axes.tick_params(length=0)
    words = [word for word, _ in columns]
    for word in dict.fromkeys(words):
        first, count = words.index(word), words.count(word)
        axes.text(first + count / 2 - 0.5, -0.8, word, ha="center", va="bottom")
        axes.axvline(first - 0.5, color="white", lw=3)
    drawn.colorbar(image, ax=axes, label="step of the fork", fraction=0.06, pad=0.02)
    legend = "   ".join(f"{letter} {word}" for word, letter in LETTERS.items() if letter)
    drawn.supxlabel(f"{legend}\n* must hold by design; no letter: the choice does not apply", fontsize=8)
    save(drawn, path)


def show(cells: list[Cell]) -> None:
    """Cell by cell, and verdicts counted by column."""
    table(
        "atlas",
        ("system", "cutoff", "choice", "verdict", "seed", "fork", "split", "told", "nats", "steps"),
        (
            (
                cell.system, cell.cutoff, cell.choice, cell.verdict, cell.seed, cell.fork, cell.split,
                cell.told, None if cell.nats is None else f"{cell.nats:.2g}", cell.steps,
            )
            for cell in cells
            if cell.verdict != "does not apply"
        ),
        words=4,
    )  # fmt: skip
    columns = dict.fromkeys((cell.system, cell.cutoff) for cell in cells)
    counts = {
        column: Counter(cell.verdict for cell in cells if (cell.system, cell.cutoff) == column)
        for column in columns
    }
    table(
        "\nverdicts",
        ("system", "cutoff", *LETTERS),
        ((*column, *(counts[column][word] for word in LETTERS)) for column in columns),
        words=2,
    )
    broken = [cell for cell in cells if parse(cell.choice).must_hold and cell.seed is not None]
    for cell in broken:
        print(f"finding: {cell.choice} changed a bit of {cell.system}, {cell.cutoff}, at step {cell.seed}")


def main() -> None:
    """Parse, make what is missing, print and draw."""
    made = parser(__file__, __doc__)
    made.add_argument(
        "--quick", action="store_true", help="a crystal, two cutoffs, few choices: does it work?"
    )
    made.add_argument(
        "--systems", nargs="+", metavar="NAME",
        help=f"names, or liquid:N for a Lennard-Jones liquid (default {' '.join(SYSTEMS)})",
    )  # fmt: skip
    made.add_argument(
        "--kinds", nargs="+", choices=tuple(CUTOFFS), metavar="KIND", help=f"default {' '.join(KINDS)}"
    )
    made.add_argument("--choices", nargs="+", metavar="CHOICE", help="default all that ship")
    made.add_argument("--steps", type=int, metavar="N", help="steps at most (default 4000)")
    made.add_argument("--repeats", type=int, metavar="K", help="repeats that tell a delay (default 15)")
    made.add_argument("--table", type=Path, metavar="FILE", help="finished cells (default beside the figure)")
    chosen = made.parse_args()
    quick = chosen.quick
    words = chosen.systems or (SYSTEMS[:1] if quick else SYSTEMS)
    kinds = chosen.kinds or (("hard", "switched") if quick else KINDS)
    choices = [parse(word) for word in chosen.choices or (QUICK if quick else shipped("md"))]
    steps = chosen.steps or (300 if quick else 4000)
    repeats = chosen.repeats if chosen.repeats is not None else (0 if quick else REPEATS)
    systems = {word: system_of(word) for word in words}
    book = Book(chosen.table or chosen.output.with_suffix(".csv"))
    cells = fill(book, systems, kinds, choices, steps, repeats)
    show(cells)
    draw(cells, choices, chosen.output)


if __name__ == "__main__":
    start(main)
