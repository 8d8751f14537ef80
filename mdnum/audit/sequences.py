"""Sequences of structures that reveal errors in the neighbor list of a calculator."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from ase import Atoms

from mdnum.audit.noise import displaced
from mdnum.audit.structures import Pair, modified
from mdnum.units import LENGTH

#: Initial distance of two atoms from the cutoff (Å). A list with a skin s that allows each atom to move by s
#: misses the pair if this distance is between s and 2 s; with factors below 2 between the values, no skin
#: escapes.
_BEYOND = tuple(0.15 * 1.5**n for n in range(8))
_STEPS = 8
_INSIDE = (0.02, 0.1, 0.25)  # Å inside the cutoff at which they are asked about


class SequenceStep(NamedTuple):
    """A structure in a sequence, a description, and whether the results are checked."""

    what: str
    atoms: Atoms
    compared: bool = True


def all_sequences(atoms: Atoms, rng: np.random.Generator) -> dict[str, list[SequenceStep]]:
    """Return all sequences that can be made from a structure, by name."""
    sequences = {
        "sizes": _sizes(atoms, rng), "a slow drift": _slow_drift(atoms, rng),
        "two atoms head on": _head_on(atoms), "strain": _strain(atoms), "wrapping": _wrapping(atoms, rng),
    }  # fmt: skip
    made = {name: [SequenceStep(*step) for step in sequence] for name, sequence in sequences.items()}
    return {name: sequence for name, sequence in made.items() if sequence}


def _sizes(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Atoms]]:
    """Yield structures with different numbers of atoms, densities, species and periodicity."""
    yield "the structure", atoms
    if len(atoms) <= 64 and atoms.pbc.any():
        yield "the structure grew to its supercell", atoms.repeat(np.where(atoms.pbc, 2, 1))
        yield "it shrank back", atoms
    if len(atoms) > 2:
        yield "its last third was removed", atoms[: max(1, 2 * len(atoms) // 3)]
        yield "all but two atoms were removed", atoms[:2]
        yield "all atoms came back", atoms
    yield "all distances grew by half: fewer neighbors", _scaled(atoms, 1.5)
    yield "they shrank again: more neighbors", atoms
    yield "all distances shrank by 6 %: more neighbors", _scaled(atoms, 0.94)
    yield "they grew again: fewer neighbors", atoms
    if len(atoms) > 1:
        yield "the atoms came in another order", atoms[rng.permutation(len(atoms))]
        yield "they came in the first order", atoms
    if atoms.pbc.any():
        yield "pbc was switched off", modified(atoms, pbc=False)
        yield "the cell was taken away", modified(atoms, pbc=False, cell=np.zeros((3, 3)))
        slab = atoms.pbc & (np.arange(3) != np.flatnonzero(atoms.pbc)[-1])
        yield "all axes but one repeated", modified(atoms, pbc=slab)
        yield "all of them did", atoms
    if len(set(atoms.numbers)) > 1:
        yield "the species changed places", modified(atoms, numbers=np.roll(atoms.numbers, 1))
        yield "they changed back", atoms


def _slow_drift(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Atoms]]:
    """Yield structures whose atoms move in small steps, in total farther than a neighbor-list skin."""
    heading = rng.standard_normal((len(atoms), 3))
    heading /= np.linalg.norm(heading, axis=1)[:, None]
    yield "the structure", atoms
    for number in range(1, 13):
        # there and back, so that atoms do not run into one another
        there = displaced(atoms, 0.04 * min(number, 12 - number) * heading)
        yield f"all atoms moved by 0.04 {LENGTH}, {number} times", there


def _head_on(atoms: Atoms) -> Iterator[tuple[str, Atoms]]:
    """Yield structures in which atoms approach another atom, to test the half-skin criterion."""
    if len(atoms) < 2:
        return
    distances = atoms.get_distances(0, range(1, len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    lengths = np.linalg.norm(distances, axis=1)
    other = int(np.argmax(lengths))
    step = np.zeros((len(atoms), 3))
    step[0] = 0.09 * distances[other] / lengths[other]
    for words in ("one atom", "two atoms"):
        yield "the structure", atoms
        for number in range(1, 6):
            there = displaced(atoms, number * step)
            yield f"{words} moved by 0.09 {LENGTH} toward another, {number} times", there
        step[1 + other] = -step[0]
    yield "the structure", atoms


def _strain(atoms: Atoms) -> Iterator[tuple[str, Atoms]]:
    """Yield structures with a strained cell, with and without scaled atom positions."""
    if not atoms.pbc.any():
        return
    cell = atoms.cell.array
    for scaled, words in ((True, "cell and atoms"), (False, "the cell alone")):
        yield "the structure", atoms
        for number in range(1, 5):
            there = modified(atoms, cell=0.985**number * cell, scaled=scaled)
            yield f"{words} shrank by 1.5 %, {number} times", there
    yield "the structure", atoms
    shear = np.array([[1, 0, 0], [0.05, 1, 0], [0, 0, 1]])
    yield "cell and atoms were sheared by 5 %", modified(atoms, cell=cell @ shear, scaled=True)
    yield "the structure", atoms


def _wrapping(atoms: Atoms, rng: np.random.Generator) -> Iterator[tuple[str, Atoms]]:
    """Yield structures with atoms that jump to other periodic images."""
    if not atoms.pbc.any():
        return
    there = atoms
    yield "the structure", there
    for number in range(4):
        boxes = rng.integers(-1, 2, (len(atoms), 3)) * atoms.pbc
        there = displaced(there, boxes @ atoms.cell.array + 0.02 * rng.uniform(-1, 1, (len(atoms), 3)))
        yield f"atoms moved a little and were put into other boxes, {number + 1} times", there
    folded = there.copy()
    folded.wrap(eps=0)
    yield "all atoms were wrapped", folded


def _scaled(atoms: Atoms, factor: float) -> Atoms:
    return modified(atoms, cell=factor * atoms.cell.array, positions=factor * atoms.positions)


def approaches(pair: Pair, radius: float) -> Iterator[tuple[str, list[SequenceStep]]]:
    """Yield sequences in which two atoms come within the cutoff. Each sequence needs a new calculator object.

    Args:
        radius: cutoff distance, beyond which the particles do not interact, Å.
    """
    apart, count = "the two apart", len(pair.first)
    for beyond in _BEYOND:
        # both move, in small steps: neither further than half of what the distance changes by
        start = pair.at(radius + beyond)
        sequence = [SequenceStep(apart, start, compared=False)]
        for moved in (*np.linspace(0, beyond, _STEPS + 1)[1:], *(beyond + inside for inside in _INSIDE)):
            there = start.copy()
            there.positions[:count, 0] += 0.5 * moved
            there.positions[count:, 0] -= 0.5 * moved
            what = f"each moved by {0.5 * moved:.3g} {LENGTH} toward the other"
            sequence.append(SequenceStep(what, there, compared=bool(moved > beyond)))
        yield f"two atoms from {beyond:.2g} {LENGTH} beyond the cutoff", sequence
    if len(pair.first) == len(pair.second) == 1:
        # atoms stand still while the cell brings an image of one into the other's reach: across the face they
        # are 0.05 Å beyond the cutoff at first
        shrinking = []
        for moved in (0.0, 0.03, 0.06, 0.09, 0.12, 0.16):
            there = modified(pair.at(2.0 * radius - 0.05), cell=[3.0 * radius - moved] * 3, pbc=True)
            what = f"the cell shrank by {moved:.2g} {LENGTH}" if moved else apart
            shrinking.append(SequenceStep(what, there, compared=moved > 0.05))
        yield "a cell that shrinks around two atoms", shrinking
        near = SequenceStep("one atom jumped next to the other", pair.at(0.95 * radius))
        yield "one atom that jumps", [SequenceStep(apart, pair.at(3.0 * radius), compared=False), near]
