"""What was different about two finished runs, and whether they are runs of one system at all.

Two runs are of different systems where no step or pair of one corresponds to one of the other: other atoms,
another box, another potential. Every number and every choice of a program is a difference and may be large.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from ase import Atoms
from ase.io import read

from mdnum.errors import InputError
from mdnum.store import RunFolder

Difference = tuple[str, Any, Any]

#: Of a system file, what does not decide what is computed.
_WORDS = ("about", "name", "record.save_every", "dynamics.steps")
_WORD_TABLES = ("fork", "gradient", "variants")
#: Of the provenance, what bits depend on; its fingerprint is a hash of these and of the dtypes.
_ARITHMETIC = ("versions", "cpu", "devices", "jax_settings", "environment")
#: Of a system file, what makes a run one of another system.
_SYSTEM = ("units", "potential.kind")
#: Dtypes by role are one choice: `--vary precision`.
_ROLES = ("state", "force", "decision", "accumulate")
#: What drawn velocities come from.
_DRAWN = ("dynamics.temperature", "dynamics.seed", "dynamics.remove_drift", "structure.velocities")
#: Boxes and masses are those of one system up to this part; they may differ in their last digits.
_SAME = 1e-6


def of_programs(first: RunFolder, second: RunFolder) -> list[Difference]:
    """Keys of the system files whose values differ, as (key, in A, in B)."""
    one, other = (flat(folder.system) for folder in (first, second))
    found = _different(one, other)
    return [row for row in found if row[0] not in _WORDS and row[0].split(".")[0] not in _WORD_TABLES]


def of_arithmetic(first: RunFolder, second: RunFolder) -> list[Difference]:
    """Versions, flags and machine, where they differ."""
    tables = (
        flat({key: folder.provenance[key] for key in _ARITHMETIC if key in folder.provenance})
        for folder in (first, second)
    )
    return _different(*tables)


def of_starts(first: RunFolder, second: RunFolder, programs: list[Difference]) -> list[Difference]:
    """What differs about the atoms at step 0.

    Raises:
        InputError: the atoms or the box are those of different systems.
    """
    paths = [folder.path / "structure.extxyz" for folder in (first, second)]
    if not all(path.exists() for path in paths):
        return []
    # a single frame each, which ase types as if it were several
    atoms = [each for each in map(read, paths) if isinstance(each, Atoms)]
    one, other = atoms
    where = f"{first.path} and {second.path}"
    for what, is_same, seen in _same_system(one, other):
        if not is_same:
            raise InputError(
                f"the runs are of different systems: {what} differ{seen}",
                where=where,
                remedy="Compare runs of one system",
            )
    rows: list[Difference] = []
    if not np.array_equal(one.cell.array, other.cell.array):
        rows.append(("start: box", "", "other last digits"))
    if not np.array_equal(one.get_masses(), other.get_masses()):
        rows.append(("start: masses", "", "other last digits"))
    if not np.array_equal(one.positions, other.positions):
        moved = other.positions - one.positions
        images = np.round(moved @ np.linalg.pinv(one.cell.array)) * one.pbc
        moved -= images @ one.cell.array
        rows.append(("start: positions", "", f"up to {np.linalg.norm(moved, axis=1).max():.3g} away"))
    momenta = [each.arrays.get("momenta") for each in atoms]
    switched = any(key == "structure.velocities" for key, _, _ in programs)
    if switched or any(each is None for each in momenta):
        # they are drawn when the run begins, from what the file says
        if any(key in _DRAWN for key, _, _ in programs) or any(each is not None for each in momenta):
            rows.append(("start: velocities", "", "drawn otherwise"))
    elif not np.array_equal(one.arrays["momenta"], other.arrays["momenta"]):
        rows.append(("start: velocities", "", "other"))
    return rows


def choices(programs: list[Difference]) -> list[str]:
    """The choices that differing keys amount to: dtypes by role are one, so are a cutoff and its numbers."""
    keys = [key for key, _, _ in programs]
    out: dict[str, None] = {}
    for key, one, other in programs:
        table, _, name = key.partition(".")
        if table == "precision" and name in _ROLES:
            out["precision"] = None
        elif not (table == "cutoff" and "cutoff.kind" in keys and None in (one, other)):
            out[key] = None
    return list(out)


def refuse_other_systems(first: RunFolder, second: RunFolder, programs: list[Difference]) -> None:
    """Refuse runs of different systems.

    Raises:
        InputError: names what is different.
    """
    where = f"{first.path} and {second.path}"
    atoms = [folder.summary.get("atoms") for folder in (first, second)]
    # a run that was killed has no summary; its structure is compared with the other's
    if None not in atoms and atoms[0] != atoms[1]:
        raise InputError(
            f"the runs have {atoms[0]} and {atoms[1]} atoms", where=where, remedy="Compare runs of one system"
        )
    for key, one, other in programs:
        if key in _SYSTEM:
            raise InputError(
                f"the runs are of different systems: {key} is {one} in the first and {other} in the second",
                where=where,
                remedy="Compare runs of one system, which differ in numbers or in choices of the program",
            )


def _same_system(one: Atoms, other: Atoms) -> Iterator[tuple[str, bool, str]]:
    """(what, whether it is the same, what was seen)."""
    yield "numbers of atoms", len(one) == len(other), f", {len(one)} and {len(other)}"
    species = [each.get_chemical_symbols() for each in (one, other)]
    yield "species", species[0] == species[1], " or their order"
    yield "masses", np.allclose(one.get_masses(), other.get_masses(), rtol=_SAME), ""
    yield "periodic directions", bool((one.pbc == other.pbc).all()), ""
    size = float(np.abs(one.cell.array).max())
    yield "boxes", bool(np.allclose(one.cell.array, other.cell.array, atol=_SAME * size, rtol=0)), ""


def flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted key to value."""
    out: dict[str, Any] = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            out |= flat(value, f"{name}.")
        else:
            out[name] = value
    return out


def _different(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Difference]:
    keys = dict.fromkeys([*one, *other])
    return [(key, one.get(key), other.get(key)) for key in keys if one.get(key) != other.get(key)]
