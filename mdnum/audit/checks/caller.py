"""Check that a calculator detects in-place changes of its input and modifies no data of its caller."""

from __future__ import annotations

import pickle
import random
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import AuditCheck, CheckResult, Observed, Progress, Severity, Ways, finding
from mdnum.audit.noise import NoiseFloor, displaced, settled
from mdnum.audit.subject import CalculatorSubject, Forces, bits, differences, largest

_SEEDS = (271828, 314159)  # two, to tell numbers that are drawn from a seed that is set
#: Keys of `Atoms.info` that some calculators read.
_INFO = {"charge": 1, "spin": 2, "total_charge": 1, "multiplicity": 2}


class CallerCheck(AuditCheck):
    """Does a calculator detect in-place changes of its input, without modifying its caller's data?

    The check changes an `Atoms` object in place. The returned arrays and the global random number generators
    are tested, too.
    """

    name, title, order, calls = "caller", "Caller", 30, 280
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Run every test of the check, each with a new calculator object."""
        rng = np.random.default_rng(self.seed)
        with subject.meter.limited():
            atoms, noise = settled(subject.fresh(), rng)
        changes = _changes(atoms, np.random.default_rng(self.seed))
        questions: dict[str, Callable[[], Iterator[Observed]]] = {
            **{
                f"{what} changed in place": partial(_edited, subject, atoms, noise, what, change)
                for what, change in changes
            },
            "arrays that were returned": partial(_buffers, subject, atoms),
            "the caller's random numbers": partial(_random, subject, atoms),
            "the caller's atoms": partial(_written, subject, atoms),
        }
        ways = Ways()
        found = ways.each(
            subject, list(questions), str, lambda one: list(questions[one]()), progress, self.name,
            unit="questions", required=True, tolerant=True,
        )  # fmt: skip
        observed = [one for several in found.values() for one in several]
        # one that keeps its answer whatever has changed is reported once
        if unseen := [one for one in observed if one.code == "CHANGE_NOT_SEEN"]:
            worst = max(unseen, key=lambda one: one.values["force"])
            *most, last = (one.values["changed"] for one in unseen)
            worst.values["changed"] = f"{', '.join(most)} and {last}" if most else last
            worst.values["n"] = 2 if most or last.endswith("s") else 1
            observed = [worst, *(one for one in observed if one not in unseen)]
        return CheckResult((["caller_wrong" if observed else "caller_right"], {}), observed, **vars(ways))


def _changes(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Callable[[Atoms], Any]]]:
    """Yield the name of each quantity of an `Atoms` object, and a function that changes it."""
    moves = 0.02 * rng.uniform(-1, 1, (len(atoms), 3))
    yield "positions", lambda there: np.add(there.positions, moves, out=there.positions)
    if len(set(atoms.numbers)) > 1:
        swapped = np.roll(atoms.numbers, 1)
        yield "numbers", lambda there: there.numbers.__setitem__(slice(None), swapped)
    if atoms.pbc.any():
        yield "cell", lambda there: np.multiply(there.cell.array, 1.01, out=there.cell.array)
        yield "pbc", lambda there: there.pbc.__setitem__(slice(None), False)
    yield "tags", lambda there: there.set_tags(np.arange(len(there)) % 3)
    yield "info", lambda there: there.info.update(_INFO)
    yield "initial charges", lambda there: there.set_initial_charges(np.linspace(-0.5, 0.5, len(there)))
    yield "initial magnetic moments", lambda there: there.set_initial_magnetic_moments([1.0] * len(there))


def _edited(
    subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor, what: str, change: Callable[[Atoms], Any]
) -> Iterator[Observed]:
    """Change an `Atoms` object in place, and compare its calculator with a new object."""

    def asked() -> tuple[tuple[float, Forces], tuple[float, Forces]]:
        used, there = subject.used(), atoms.copy()
        used.copies = False
        used.both(there)
        change(there)
        return used.both(there), subject.fresh().both(there.copy())

    with subject.trying():  # it may not take a charge, or a structure without periods
        old, new = asked()
        energy, force = differences(old, new)
        eps = np.finfo(float).eps
        allowed = noise.louder(NoiseFloor(eps * abs(new[0]), eps * max(1.0, largest(new[1])))).allowed
        if energy <= allowed.energy and force <= allowed.force:
            return
        again = zip((old, new), asked(), strict=True)
    # what comes by chance does not come again
    if all(e <= 0.5 * energy and f <= 0.5 * force for e, f in (differences(*two) for two in again)):
        values = {"changed": what, "energy": energy, "force": force}
        yield finding("CHANGE_NOT_SEEN", "error", tests=("repeat", "fresh"), **values)


def _buffers(subject: CalculatorSubject, atoms: Atoms) -> Iterator[Observed]:
    """Test that returned arrays stay unchanged, and that later results do not depend on them."""
    used, there = subject.fresh(), atoms.copy()
    used.copies = False
    used.both(there)
    # what is given back, from the cache of the calculator, and what is kept in it
    first: dict[str, Any] = {"energy": there.get_potential_energy(), "forces": there.get_forces()}
    kept = getattr(used.calculator, "results", None) or {}
    first |= {f"results[{key!r}]": value for key, value in kept.items()}
    before = {name: np.array(value, copy=True) for name, value in first.items()}
    used.both(displaced(atoms, 0.01 * np.arange(3 * len(atoms)).reshape(-1, 3) / len(atoms)))
    changed = [name for name, value in first.items() if np.asarray(value).tobytes() != before[name].tobytes()]
    if own := [name for name in changed if not name.startswith("results")]:
        yield finding("REUSED_BUFFER", "error", what=" and ".join(own))
    elif changed:
        yield finding("REUSED_BUFFER", "info", "kept", what=" and ".join(changed))
    else:
        used.both(there)
        forces = there.get_forces()
        if forces.flags.writeable:
            forces += 1.0
            if largest(used.forces(there) - before["forces"]) > 0.5:
                yield finding("REUSED_BUFFER", "error", "written", what="forces")


def _random(subject: CalculatorSubject, atoms: Atoms) -> Iterator[Observed]:
    """Test whether a calculator uses the global random number generators."""
    generators: dict[str, tuple[Callable[[], Any], Callable[[Any], Any], Callable[[int], Any]]] = {
        "numpy.random": (np.random.get_state, np.random.set_state, np.random.seed),
        "random": (random.getstate, random.setstate, random.seed),
    }
    if torch := sys.modules.get("torch"):
        generators["torch"] = torch.get_rng_state, torch.set_rng_state, torch.manual_seed
    kept = [(put, get()) for get, put, _ in generators.values()]
    # of each generator the states before and after the first call of an object and another, for each seed
    states: dict[tuple[str, str], list[tuple[bytes, bytes]]] = {}
    try:
        for seed in _SEEDS:
            one = subject.fresh()
            for when in ("made", "asked"):
                for _, _, start in generators.values():
                    start(seed)
                before = [pickle.dumps(get()) for get, _, _ in generators.values()]
                one.forget()
                one.both(atoms)
                for (name, (get, _, _)), state in zip(generators.items(), before, strict=True):
                    states.setdefault((when, name), []).append((state, pickle.dumps(get())))
    finally:
        for put, state in kept:
            put(state)
    told: dict[str, Severity] = {"asked": "error", "made": "warning", "drawn": "info"}
    for variant, severity in told.items():
        names = []
        for name in generators:
            (before, after), (_, other) = states["made" if variant == "made" else "asked", name]
            if before != after and (after == other) is (variant != "drawn"):
                names.append(name)
        if names:
            yield finding("RANDOM_SEEDED", severity, variant, which=" and ".join(names))
            return


def _written(subject: CalculatorSubject, atoms: Atoms) -> Iterator[Observed]:
    """Test whether the calculator modifies its `Atoms` argument, for example by wrapping positions."""
    outside = displaced(atoms, np.tile((atoms.pbc * 1.0) @ atoms.cell.array, (len(atoms), 1)))
    for given, what in ((atoms, "the structure"), (outside, "the structure one cell further")):
        other, there = subject.fresh(), given.copy()
        other.copies = False
        if not other.answers(there):
            continue  # reported elsewhere
        both = zip(("positions", "numbers", "cell", "pbc"), bits(given), bits(there), strict=True)
        if changed := [word for word, before, after in both if before.tobytes() != after.tobytes()]:
            yield finding("CHANGED_INPUT", "error", what=what, changed=" and ".join(changed))
            return
