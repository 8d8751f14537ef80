"""Atoms without a neighbor: they feel no force, and energies of parts far apart add up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.answer import Answer, Refusal, ask
from mdnum.audit.base import Subject
from mdnum.audit.noise import Noise
from mdnum.audit.probes import molecules, whole
from mdnum.references.findings import finding

#: How many times the noise an energy may be off by.
_ALLOWED = 40.0
#: Å between two parts that cannot feel one another.
_FAR = 60.0
_CLUSTER = 12
#: Å, a cell that does not repeat around two parts far apart: some lists take long over an empty one.
_BOX = 1.25 * _FAR


@dataclass
class Alone:
    """What atoms without neighbors were answered.

    Attributes:
        rows: a row for each structure that was answered for.
        refused: what was not, and why.
        takes_atoms: whether the calculator answers for anything that is no whole molecule.
        structures: on which it failed, by name.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    refused: list[tuple[str, Refusal]] = field(default_factory=list)
    takes_atoms: bool = True
    structures: dict[str, Atoms] = field(default_factory=dict)

    def add(
        self, what: str, found: Answer | Refusal, expected: float | None, noise: Noise, atoms: Atoms
    ) -> None:
        """Takes note of an answer; without an expected energy, only of its force."""
        if isinstance(found, Refusal):
            self.refused.append((what, found))
            if found.not_finite:
                self.structures["alone-failed"] = atoms
            return
        force = float(np.max(np.abs(found.forces), initial=0.0))
        eps = np.finfo(float).eps
        expected = found.energy if expected is None else expected
        self.rows.append(
            {
                "atoms": what,
                "energy (eV)": found.energy,
                "expected": expected,
                "force (eV/Å)": force,
                "adds up": abs(found.energy - expected) <= _ALLOWED * max(noise.energy, eps * abs(expected)),
                "no force": force <= _ALLOWED * max(noise.force, eps),
            }
        )

    @property
    def skipped(self) -> list[tuple[str, str]]:
        """What was not answered, in words."""
        return [(what, refusal.why) for what, refusal in self.refused]

    def findings(self) -> Iterator[dict[str, str]]:
        """What is wrong with atoms alone."""
        empty = [(what, one) for what, one in self.refused if one.not_finite]
        if empty:
            what, one = empty[0]
            yield finding(
                "LONELY_NOT_FINITE",
                "error",
                "an atom without neighbors has no energy",
                f"Asked about {what}, the calculator {one.why}.",
                "Look at empty neighborhoods: the mean over no neighbors, a distance of 0 in padding, the "
                "derivative of a norm at 0.",
            )
        raised = [(what, one) for what, one in self.refused if not one.not_finite]
        if raised and self.takes_atoms:
            what, one = raised[0]
            yield finding(
                "LONELY_FAILS",
                "warning",
                "the calculator fails on an atom without neighbors",
                f"Asked about {what}, it {one.why}.",
                "Let an empty list of neighbors pass: an atom leaves a surface, a gas has atoms alone.",
            )
        pushed = [row for row in self.rows if not row["no force"]]
        if pushed:
            worst = max(pushed, key=lambda row: row["force (eV/Å)"])
            yield finding(
                "LONELY_FORCE",
                "error",
                "an atom without neighbors feels a force",
                f"On {worst['atoms']} acts a force of {worst['force (eV/Å)']:.3g} eV/Å.",
                "Look at empty neighborhoods: a sum over no neighbors, or a normalization by their number.",
            )
        apart = [row for row in self.rows if not row["adds up"]]
        if apart:
            worst = max(apart, key=lambda row: abs(row["energy (eV)"] - row["expected"]))
            yield finding(
                "LONELY_ENERGY",
                "warning",
                "energies of parts that cannot feel one another do not add up",
                f"{worst['atoms'][0].upper()}{worst['atoms'][1:]}: {worst['energy (eV)']:.10g} eV, expected "
                f"{worst['expected']:.10g}.",
                "Look for terms of the whole structure (a mean over atoms, a background charge), or for an "
                f"interaction that reaches beyond {_FAR:g} Å.",
            )


def alone(subject: Subject, atoms: Atoms, noise: Noise) -> Alone:
    """Ask about single atoms, two atoms far apart, and a cluster with an atom far away.

    Args:
        subject: a new object is made for each question.
        atoms: species, and the cluster.
        noise: of the calculator.
    """
    found = Alone()
    species = list(dict.fromkeys(atoms.symbols))
    single: dict[str, float] = {}
    for symbol in species:
        for periodic in (False, True):
            one = Atoms(symbol, positions=[[1.0, 2.0, 3.0]], cell=[2 * _FAR] * 3, pbc=periodic)
            answer = ask(subject.fresh(), one)
            if isinstance(answer, Answer):
                single.setdefault(symbol, answer.energy)
            what = f"one {symbol} atom{' in a large periodic cell' if periodic else ''}"
            found.add(what, answer, single.get(symbol), noise, one)
    pair = Atoms([species[0], species[-1]], positions=[[1.0, 2.0, 3.0], [1.0 + _FAR, 2.0, 3.0]])
    pair.set_cell([_BOX] * 3)
    known = [single[one] for one in (species[0], species[-1]) if one in single]
    what = f"{species[0]} and {species[-1]} {_FAR:g} Å apart"
    found.add(what, ask(subject.fresh(), pair), sum(known) if len(known) == 2 else None, noise, pair)
    cluster = atoms[: min(len(atoms), _CLUSTER)]
    cluster.pbc = False
    cluster.positions += 1.0 - cluster.positions.min(axis=0)
    cluster.set_cell([_BOX + float(np.ptp(cluster.positions, axis=0).max())] * 3)
    near = ask(subject.fresh(), cluster)
    # one that knows whole molecules alone takes nothing of which an atom is gone; one that fails on an atom
    # without neighbors may fail on the cluster, and takes the structure with a vacancy
    fewer = (cluster[:-1], atoms[:-1]) if isinstance(near, Answer) else (atoms[:-1],)
    found.takes_atoms = any(isinstance(ask(subject.fresh(), one), Answer) for one in fewer)
    if isinstance(near, Refusal):
        found.refused.append((f"a cluster of {len(cluster)} atoms", near))
        return found
    if not found.takes_atoms:
        _molecules(found, subject, atoms, noise)
        return found
    symbol = str(atoms.symbols[0])
    far = cluster.copy()
    far += Atoms(symbol, positions=[cluster.positions.max(axis=0) + _FAR])
    both = ask(subject.fresh(), far)
    if isinstance(both, Answer):
        both = Answer(both.energy, both.forces[-1:])
    expected = near.energy + single[symbol] if symbol in single else None
    found.add(f"a {symbol} atom {_FAR:g} Å from a cluster", both, expected, noise, far)
    return found


def _molecules(found: Alone, subject: Subject, atoms: Atoms, noise: Noise) -> None:
    """One molecule alone, and two far apart, for calculators that take nothing less."""
    groups = molecules(atoms)
    one = whole(atoms, groups[0])
    one.positions += [1.0, 2.0, 3.0]
    one.set_cell([_BOX] * 3)
    other = one.copy()
    other.positions[:, 0] += _FAR
    formula, alone_energy = one.get_chemical_formula(), None
    for what, there in ((f"one {formula}", one), (f"two {formula} {_FAR:g} Å apart", one + other)):
        answer = ask(subject.fresh(), there)
        if isinstance(answer, Answer):
            # within a molecule there are forces, on it as a whole there is none
            answer = Answer(answer.energy, answer.forces.reshape(-1, len(one), 3).sum(axis=1))
            alone_energy = answer.energy if alone_energy is None else alone_energy
        expected = None if alone_energy is None else alone_energy * len(there) / len(one)
        found.add(what, answer, expected, noise, there)
