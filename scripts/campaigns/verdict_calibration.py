"""How often is a verdict of `mdnum fork` wrong? Two liquids and a crystal, float32 beside float64.

Answer. For none of 76 to 100 starting states in most rows, and for 1 of 100 in one row (upper bounds 3.0 to
4.7 % at 95 % confidence). For half of the starting states of a liquid with a hard cutoff the verdict is
undecided (docs/verdict-calibration.md). It takes hours.

A false verdict needs a truth that is known apart from the verdict:

    switched   a liquid whose cutoff switches off smoothly: a pair that crosses it adds nothing to the
               forces, so flips can neither cause nor accelerate anything. Right: bystander.
    placebo    the hard cutoff, but in place of the run under the other's decisions stands a further free
               run from a perturbed start: the two differ in nothing. Right: not accelerated.
    hard       a hard cutoff at 2 sigma (1.8 in the mixture). The truth is what most of 16 further repeats
               at either displacement do, none of which the verdict saw: split more than one e-folding later
               without the flips, or not.
    violent    the same with a cutoff at 1.5 sigma (1.4 in the mixture), inside the well.
    crystal    argon/crystal-108, whose second shell lies at a hard cutoff: without the flips it does not
               split. Right: cause.

Every start is kept in a file of its own as soon as it is done (--store), as separations and steps of splits,
not as a verdict: the study goes on where it was stopped, and its tables are judged from the files by the
rule that mdnum has now.

    nice python scripts/campaigns/verdict_calibration.py --seeds 100 --only switched hard
    nice python scripts/campaigns/verdict_calibration.py --seeds 30
    python scripts/campaigns/verdict_calibration.py --seeds 100 --tables docs/verdict-calibration.md
    python scripts/campaigns/verdict_calibration.py --seeds 3 --only "Jones hard" --displacements
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill as fill_text
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start
from _pages import between, markdown
from ase import Atoms
from ase.build import bulk
from scipy.stats import beta

from mdnum.forks import SPLIT, displacements, fork
from mdnum.forks.choices import parse, twin_of
from mdnum.numerics.verdicts import Dates, Delay, ForkVerdict, count, growth, judge
from mdnum.rollout import Engine
from mdnum.systems import System, SystemSpec, build, load

STEPS = 4000
#: Repeats that no verdict sees, at either displacement: the truth, and more pairs for a placebo.
UNSEEN = 16
#: Share of false verdicts that is aimed at: below it.
TARGET = 0.05
#: Displacements of repeats over that of the choice, and repeats at each, to see what hangs on it.
SCAN, SCANNED = (100.0, 1.0, 0.1, 0.01, 1e-4, 0.0), 12
SHARES = (0.002 / 1.5874, SPLIT, 0.02, 0.04, 0.1 / 1.5874)
POTENTIAL = {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0}
MIXTURE = {
    "kind": "lennard-jones",
    "pairs": {
        "Ni-Ni": {"sigma": 1.0, "epsilon": 1.0},
        "Ni-P": {"sigma": 0.8, "epsilon": 1.5},
        "P-P": {"sigma": 0.88, "epsilon": 0.5},
    },
}
#: By liquid: density, temperature, time step, skin, potential, cutoffs in sigma of each pair. The skins are
#: as wide as 108 atoms allow: most of the time goes to lists.
LIQUIDS = {
    "Lennard-Jones": (0.8442, 0.72, 0.005, 0.5, POTENTIAL, {"hard": 2.0, "switched": 2.0, "violent": 1.5}),
    "Kob-Andersen": (1.2, 1.0, 0.003, 0.42, MIXTURE, {"hard": 1.8, "switched": 1.8, "violent": 1.4}),
}


# --- systems ------------------------------------------------------------------------------------------


def system(name: str, atoms: Atoms, cutoff: str, seed: int, thermostat: float | None = None) -> System:
    """A liquid with one of its cutoffs; with a Langevin thermostat where a temperature is given."""
    _, temperature, timestep, skin, potential, radii = LIQUIDS[name]
    dynamics = {"kind": "nve", "timestep": timestep, "temperature": temperature, "seed": seed}
    if thermostat is not None:
        dynamics |= {"kind": "langevin", "friction": 2.0, "temperature": thermostat}
    kind = cutoff if cutoff == "switched" else "hard"
    data = {
        "units": "lj",
        "structure": {"file": "made in memory"},
        "potential": potential,
        "cutoff": {"kind": kind, "in_sigma": radii[cutoff]},
        "neighbors": {"skin": skin},
        "dynamics": dynamics,
    }
    return System(f"{name} {cutoff}", SystemSpec.model_validate(data), None, atoms)


def liquid(name: str, seed: int) -> Atoms:
    """108 atoms, melted at 3 times the temperature and cooled to it, 2,000 steps each."""
    density, temperature, *_ = LIQUIDS[name]
    atoms = bulk("Ni", "fcc", a=(4 / density) ** (1 / 3), cubic=True).repeat(3)
    if name == "Kob-Andersen":
        atoms.symbols[::5] = "P"
    atoms.set_array("masses", np.ones(len(atoms)))
    for kelvin in (3 * temperature, temperature):
        simulation = build(system(name, atoms, "switched", seed, kelvin))
        *_, last = Engine(simulation, 2000, record=False).segments()
        atoms = atoms.copy()
        atoms.positions = np.asarray(last.state.x, np.float64).T
        atoms.set_velocities(np.asarray(last.state.v, np.float64).T)
    return atoms


# --- what is run --------------------------------------------------------------------------------------


def gather(made: System, share: float, unseen: int) -> dict[str, np.ndarray]:
    """What a verdict needs, and the truth, of one start.

    Args:
        made: the system.
        share: the split tolerance over the cutoff.
        unseen: repeats for the truth, at either displacement, where the runs split either way.
    """
    twin = twin_of(parse("precision"), made)
    found = fork(twin, STEPS, split=share * twin.a.scale, back=False)
    sizes = displacements(found)
    truth: list[list[Delay]] = [[], []]
    for place in (0, 1) if unseen and found.verdict.count is not None else ():
        programs = twin.b.nudged(sizes[place], unseen, seed=2 + place)
        runs = twin.a.repeats(programs, found.steps, found.tolerance, 3 * found.tolerance)
        truth[place] = [Delay.of(free, under, found.tolerance) for free, under in runs]
    # the separations are stored in full: a verdict must be the same from the file
    kept = {name: found.series[name] for name in ("B", "B|A")}
    for place, end in enumerate(("", "_other")):
        kept |= {f"seen{end}": _rows(found.repeats[place]), f"unseen{end}": _rows(truth[place])}
    dates = [-1 if at is None else at for at in vars(found.dates).values()]
    numbers = {"dates": dates, "tolerance": found.tolerance, "displacements": sizes}
    return kept | {name: np.array(value) for name, value in numbers.items()}


def _rows(delays: Sequence[Delay]) -> np.ndarray:
    """Repeats as rows of free, handed, free_until, handed_until; -1 for no split."""
    rows = [[-1 if at is None else at for at in vars(one).values()] for one in delays]
    return np.array(rows, int).reshape(-1, 4)


def scan(made: System) -> list[tuple[object, ...]]:
    """Displacement of the starts, delayed repeats, repeats, and the median of their free splits."""
    twin = twin_of(parse("precision"), made)
    found = fork(twin, STEPS, back=False, repeats=0)
    fit = found.growth["B"]
    rows: list[tuple[object, ...]] = [("the pair", "–", 1, found.dates.split or -1)]
    for factor in SCAN:
        programs = twin.b.nudged(factor * displacements(found)[0], SCANNED, seed=7)
        runs = twin.a.repeats(programs, found.steps, found.tolerance, 3 * found.tolerance)
        kept = tuple(Delay.of(free, under, found.tolerance) for free, under in runs)
        later = count(kept, 1.0 / fit.rate if fit.plain else 0.0, 1).later
        splits = [one.free for one in kept if one.free is not None]
        rows.append((f"{factor:g}", later, SCANNED, int(np.median(splits)) if splits else -1))
    return rows


def tasks() -> Iterator[tuple[str, Callable[[int], dict[str, np.ndarray]]]]:
    """(name, what gathers a seed) of everything that is run."""
    for name, (*_, radii) in LIQUIDS.items():
        for cutoff in radii:
            unseen = 0 if cutoff == "switched" else UNSEEN
            yield f"{name} {cutoff}", partial(_of_liquid, name, cutoff, unseen)
    for share in SHARES:
        yield f"crystal {share * 1.5874:.4f}", partial(_of_crystal, share)


def _of_liquid(name: str, cutoff: str, unseen: int, seed: int) -> dict[str, np.ndarray]:
    return gather(system(name, liquid(name, seed), cutoff, seed), SPLIT, unseen)


def _of_crystal(share: float, seed: int) -> dict[str, np.ndarray]:
    return gather(load("argon/crystal-108", {"dynamics.seed": seed}, world="md"), share, 0)


def fill(store: Path, seeds: int, only: Sequence[str]) -> None:
    """Run what is not stored yet, every system's first seed before its second."""
    store.mkdir(parents=True, exist_ok=True)
    for seed in range(1, seeds + 1):
        for name, made in tasks():
            path = store / f"{name}-{seed}.npz".replace(" ", "-")
            if path.exists() or not any(word in name for word in only):
                continue
            part = path.with_suffix(".part")
            with part.open("wb") as file:
                arrays: dict[str, Any] = made(seed)
                np.savez_compressed(file, **arrays)
            part.replace(path)
        say(f"seed {seed} of {seeds}")


# --- what is judged -----------------------------------------------------------------------------------


def stored(store: Path, name: str, seeds: int) -> list[dict[str, np.ndarray]]:
    """What is stored of a system, by seed."""
    paths = [store / f"{name}-{seed}.npz".replace(" ", "-") for seed in range(1, seeds + 1)]
    return [dict(np.load(path)) for path in paths if path.exists()]


def delays(rows: np.ndarray) -> list[Delay]:
    """Rows as they were stored."""
    return [
        Delay(None if free < 0 else int(free), None if handed < 0 else int(handed), int(until), int(there))
        for free, handed, until, there in rows
    ]


def verdict(one: dict[str, np.ndarray]) -> ForkVerdict:
    """The verdict of a start, with as many repeats as it wants."""
    dates = Dates(*(None if at < 0 else int(at) for at in one["dates"]))
    repeats, used = [delays(one[name]) for name in ("seen", "seen_other")], [0, 0]
    while True:
        first, other = (rows[:end] for rows, end in zip(repeats, used, strict=True))
        found = judge(dates, one["B"], one["B|A"], float(one["tolerance"]), first, other=other)
        place = int(found.other is not None)
        wanted = min(found.wanted, len(repeats[place]) - used[place])
        if not wanted:
            return found
        used[place] += wanted


def threshold(one: dict[str, np.ndarray]) -> float:
    """One e-folding, steps."""
    fit = growth(one["B"], float(one["tolerance"]))
    return 1.0 / fit.rate if fit.plain else 0.0


def placebo(one: dict[str, np.ndarray]) -> str:
    """The verdict where every run under the other's decisions is a free run instead."""
    said = []
    for end in ("", "_other"):
        free = [*delays(one[f"seen{end}"]), *delays(one[f"unseen{end}"])]
        pairs = tuple(
            Delay(a.free, b.free, a.free_until, b.free_until)
            for a, b in zip(free[::2], free[1::2], strict=False)
        )
        found = count(pairs[:1], threshold(one), len(pairs))
        while wanted := found.wanted_for_majority if end else found.wanted:
            found = count(pairs[: found.pairs + wanted], threshold(one), len(pairs))
        said.append(found.majority if end else found.delayed)
    first, other = said
    return "undecided" if first is None or first != other else "accelerated" if first else "bystander"


def truth(one: dict[str, np.ndarray]) -> list[tuple[int, int]]:
    """Of the repeats that no verdict saw: how many split later without the flips and how many do not, at
    either displacement."""
    found = [count(tuple(delays(one[f"unseen{end}"])), threshold(one), 1) for end in ("", "_other")]
    return [(one.later, one.not_later) for one in found]


WORDS = ("bystander", "undecided", "accelerated", "cause", "open", "no fork")


def below(false: int, of: int) -> float:
    """The share that the true one is below with 95 % confidence: exact, one-sided (Clopper and Pearson,
    Biometrika 26, 404, 1934)."""
    return 1.0 if false == of else float(beta.ppf(0.95, false + 1, of - false))


def summed_up(rows: list[tuple[Any, ...]], wrong: list[tuple[str, str, int, int]]) -> str:
    """What was aimed at, for how many kinds it is shown, and how often the word is undecided."""
    shown = sum(below(*one[2:]) < TARGET for one in wrong)
    fewer, most = min(of for *_, of in wrong), max(of for *_, of in wrong)
    column, target = WORDS.index("undecided"), f"{100 * TARGET:.0f} %"
    open_ = [(name, row[column], of) for name, of, *row in rows if row[column]]
    sentences = (
        f"The target is that each kind of false verdict occurs for fewer than {target} of the starting "
        "states. The target is met with 95 % confidence if the upper bound of the rate of false verdicts is "
        f'below {target}. The upper bounds are given in the column "below (95 %)" of a table below. '
        f"{shown or 'None'} of the {len(wrong)} rates of false verdicts {'have' if shown > 1 else 'has'} an "
        f"upper bound below {target}. Each rate is based on {fewer} to {most} starting states. With more "
        "starting states, the upper bounds would be smaller.",
        'The following table gives the number of starting states for which the verdict is "undecided". In '
        "systems that are not listed, the verdict was never undecided.",
    )
    told = [fill_text(one, 118, break_on_hyphens=False) for one in sentences]
    return "\n\n".join([*told, markdown(("system", "undecided", "starting states"), open_)])


def tables(store: Path, seeds: int) -> tuple[str, str]:
    """What the study says, and every table of it."""
    rows, repeats, wrong = [], [], []
    for name, _ in tasks():
        every = stored(store, name, seeds)
        if not every:
            continue
        found = [verdict(one) for one in every]
        words = Counter(one.word for one in found)
        rows.append((name, len(every), *(words[word] for word in WORDS)))
        counted = [one for one in found if one.count is not None]
        made = [one.count.pairs - 1 + (one.other.pairs if one.other else 0) for one in counted if one.count]
        if made:
            alone = sum(one.count.delayed is None for one in counted if one.count)
            split = sum(one.word == "undecided" and one.other is not None for one in counted)
            repeats.append((name, f"{np.median(made):.0f}", f"{np.mean(made):.1f}", alone, alone + split))
        if name.endswith("switched"):
            wrong.append((name, "cause", words["cause"], len(every)))
            wrong.append((name, "accelerated", words["accelerated"], len(every)))
        elif name.startswith("crystal"):
            if name == f"crystal {SPLIT * 1.5874:.4f}":
                wrong.append((name, "bystander", words["bystander"], len(every)))
        else:
            told = [truth(one) for one in every]
            pairs = list(zip(found, told, strict=True))
            fast = sum(v.word == "accelerated" and any(a <= b for a, b in seen) for v, seen in pairs)
            slow = sum(v.word == "bystander" and any(a > b for a, b in seen) for v, seen in pairs)
            wrong.append((name, "cause", words["cause"], len(every)))
            wrong.append((name, "accelerated", fast, len(every)))
            wrong.append((name, "bystander", slow, len(every)))
            kept = [one for one in every if len(one["unseen"])]
            empty = Counter(placebo(one) for one in kept)
            rows.append((f"{name}, placebo", len(kept), *(empty[word] for word in WORDS)))
            wrong.append((f"{name}, placebo", "accelerated", empty["accelerated"], len(kept)))
    parts = [
        markdown(("system", "starts", *WORDS), rows),
        markdown(
            ("system", "false", "starts", "share", "below (95 %)"),
            [
                (name, f"{word}: {no}", of, f"{100 * no / of:.1f} %", f"{100 * below(no, of):.1f} %")
                for name, word, no, of in wrong
                if of
            ],
        ),
        markdown(("system", "repeats, median", "mean", "undecided at one displacement", "at two"), repeats),
    ]
    return summed_up(rows, [one for one in wrong if one[-1]]), "\n\n".join(parts)


MARK = "<!-- written by scripts/campaigns/verdict_calibration.py -->"


def main() -> None:
    """Parse, run what is missing, judge, print."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, default=100, metavar="N", help="starts of each (default 100)")
    made.add_argument(
        "--only", nargs="+", default=[""], metavar="WORD", help="systems whose name has one of these in it"
    )
    made.add_argument(
        "--store", type=Path, default=Path("verdict-calibration"), metavar="DIR",
        help="where every start is kept (default verdict-calibration)",
    )  # fmt: skip
    made.add_argument(
        "--tables", type=Path, metavar="PAGE",
        help="run nothing: judge what is stored, and put what it says between the marks of this page",
    )  # fmt: skip
    made.add_argument(
        "--displacements", action="store_true",
        help="run liquids again with repeats at six displacements, and store nothing",
    )  # fmt: skip
    chosen = made.parse_args()
    if chosen.displacements:
        for name, (*_, radii) in LIQUIDS.items():
            for cutoff in radii:
                if any(word in f"{name} {cutoff}" for word in chosen.only):
                    for seed in range(1, chosen.seeds + 1):
                        print(f"{name} {cutoff}, start {seed}")
                        rows = scan(system(name, liquid(name, seed), cutoff, seed))
                        print(markdown(("displacement over the choice's", "delayed", "of", "split"), rows))
        return
    if chosen.tables is None:
        fill(chosen.store, chosen.seeds, chosen.only)
        print(*tables(chosen.store, chosen.seeds), sep="\n\n")
        return
    new = between(chosen.tables, MARK, *tables(chosen.store, chosen.seeds))
    chosen.tables.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    start(main)
