"""Energies, forces and stress in plain numpy, on ASE's neighbor list.

The numpy code is independent of the code used in a run. Each class of cutoffs has a method `reference` in
numpy. This code is the only reference if ASE has no class for a potential or a cutoff.

A model takes directed edges (i -> j, displacement d). A model returns the energy of each atom and the
gradient of the total energy with respect to every d. Forces and stress follow from this gradient g: F_i += g,
F_j -= g, stress = sum(g outer d) / volume.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise, product
from typing import Any, cast

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.geometry.cell import complete_cell
from ase.neighborlist import PrimitiveNeighborList
from ase.stress import full_3x3_to_voigt_6_stress
from jaxtyping import Bool, Float
from numpy import ndarray

from mdnum.md.cutoffs import CUTOFFS, AtCutoff
from mdnum.md.potentials import Channels, CutPotential, LennardJones, Morse, PairPotential, SoftSphere


@dataclass(frozen=True)
class Edges:
    """A full neighbor list, which contains each pair in both directions."""

    symbols: ndarray  # chemical symbol of each atom
    i: ndarray  # atom an edge starts from, ascending
    j: ndarray  # atom it leads to
    d: ndarray  # displacement x_j - x_i with the lattice vector added, (edges, 3)
    r: ndarray  # its length


SLACK = 1e-12  # what `edges_of` adds to the length it is asked for, relative


def edges_of(atoms: Atoms, reach: float) -> Edges:
    """Return the pairs within slightly more than `reach`, in both directions.

    ASE's PrimitiveNeighborList is 30 times faster than its neighbor_list for 500 atoms. ASE omits pairs with
    r = reach, but the model must receive them. The list therefore contains pairs up to reach + SLACK.
    """
    arrays = (atoms.positions, atoms.numbers, atoms.cell.array, atoms.pbc)
    key = (*(array.tobytes() for array in arrays), reach)
    if key not in _LAST:
        _LAST.clear()
        _LAST[key] = _edges(atoms, reach)
    return _LAST[key]


#: Edges of the last request: the two reference calculations of a frame request the same edges one after the
#: other.
_LAST: dict[tuple[bytes | float, ...], Edges] = {}


def _edges(atoms: Atoms, reach: float) -> Edges:
    n = len(atoms)
    ranges = [0.5 * reach * (1 + SLACK)] * n
    listed = PrimitiveNeighborList(ranges, skin=0.0, self_interaction=False, bothways=False)
    vectors = complete_cell(np.where(atoms.pbc[:, None], atoms.cell, 0.0))
    listed.build(atoms.pbc, vectors, atoms.positions)
    i = np.repeat(np.arange(n), [len(row) for row in listed.neighbors])
    j = np.concatenate([np.asarray(row, int) for row in listed.neighbors])
    shift = np.concatenate([np.asarray(row, float).reshape(-1, 3) for row in listed.displacements])
    d = atoms.positions[j] + shift @ vectors - atoms.positions[i]
    r = np.sqrt((d * d).sum(axis=1))
    i, j, d, r = np.append(i, j), np.append(j, i), np.concatenate([d, -d]), np.append(r, r)
    order = np.argsort(i, kind="stable")
    return Edges(np.array(atoms.get_chemical_symbols()), i[order], j[order], d[order], r[order])


class Model(ABC):
    """Interaction model that `OnNeighborList` can evaluate."""

    @property
    @abstractmethod
    def reach(self) -> float:
        """Distance beyond which a directed pair does not contribute to the energy."""

    @abstractmethod
    def __call__(self, edges: Edges) -> tuple[ndarray, ndarray]:
        """Return (energy of each atom, gradient of the total energy with respect to displacements)."""


class ClassicalCalculator(Calculator):
    """An ASE calculator for energy, forces and stress. Energy and free energy are equal."""

    implemented_properties = ["energy", "energies", "free_energy", "forces", "stress"]  # noqa: RUF012
    nolabel = True

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        """Evaluate a structure; the arguments are those of ase.calculators.calculator.Calculator."""
        super().calculate(atoms, properties or ["energy"], system_changes)
        results = self.evaluated(cast(Atoms, self.atoms), system_changes)
        self.results = {"free_energy": results["energy"], **results}

    def evaluated(self, atoms: Atoms, changes: Sequence[str]) -> dict[str, Any]:
        """Return energy, forces and stress. `changes` are the changes since the last call."""
        raise NotImplementedError


class OnNeighborList(ClassicalCalculator):
    """ASE calculator for a `Model`, on ASE's neighbor list."""

    def __init__(self, model: Model, **kwargs: Any):
        super().__init__(**kwargs)
        self.model = model

    def evaluated(self, atoms, changes):
        edges = edges_of(atoms, self.model.reach)
        energies, gradient = self.model(edges)
        i, j, d, n = edges.i, edges.j, edges.d, len(atoms)
        forces = np.stack(
            [np.bincount(i, gradient[:, k], n) - np.bincount(j, gradient[:, k], n) for k in range(3)], axis=1
        )
        results = {"energy": float(energies.sum()), "energies": energies, "forces": forces}
        if atoms.cell.rank == 3:
            results["stress"] = full_3x3_to_voigt_6_stress(gradient.T @ d / atoms.get_volume())
        return results


@dataclass(frozen=True)
class PairForm:
    """Interaction between two species."""

    species: tuple[str, str]  # the two symbols
    potential: PairPotential  # of all pairs
    constants: Mapping[str, float]  # its constants by name, in the units of the system file
    cutoff: str  # cutoff kind
    r_cut: float  # cutoff radius
    r_onset: float  # where switching starts; r_cut for cutoffs that do not switch
    compare: str  # what inside means: "r2 <", "r2 <=", "r <" or "r <="

    def inside(self, distance: Float[ndarray, "pairs"]) -> Bool[ndarray, "pairs"]:
        """Return True for each distance inside the cutoff. The system file selects `<` or `<=`."""
        space, comparison = self.compare.split()
        quantity, threshold = (distance**2, self.r_cut**2) if space == "r2" else (distance, self.r_cut)
        return quantity <= threshold if comparison == "<=" else quantity < threshold

    def bare(self, r: Float[ndarray, "pairs"]) -> tuple[Float[ndarray, "pairs"], Float[ndarray, "pairs"]]:
        """Return the pair energy u(r) without a cutoff, and its derivative u'(r)."""
        # by class: a function of somebody's own may be called like one of them
        return _BARE.get(type(self.potential), self.potential.reference)(r, **self.constants)

    def __call__(self, r: Float[ndarray, "pairs"]) -> tuple[Float[ndarray, "pairs"], Float[ndarray, "pairs"]]:
        """Return the energies of pairs with the cutoff, and their derivatives with respect to r."""
        at = AtCutoff(self.r_cut, self.r_onset, *self.at_cutoff)
        return CUTOFFS.parse(self.cutoff).reference(r, *self.bare(r), at)

    @property
    def at_cutoff(self) -> tuple[float, float]:
        """Energy u and derivative u' of the bare potential at the cutoff distance."""
        u, du = self.bare(np.array([self.r_cut]))
        return float(u[0]), float(du[0])


def pair_forms(model: CutPotential, symbols: Sequence[str], compare: str) -> dict[tuple[str, str], PairForm]:
    """Return the interaction of every two species, in both orders of the species.

    Args:
        symbols: symbols of the species, sorted.
        compare: comparison (< or <=) that defines which pairs are inside, as in a system file.
    """
    forms = {}
    for kind, (a, b) in enumerate(combinations_with_replacement(symbols, 2)):
        forms[a, b] = forms[b, a] = PairForm(
            (a, b),
            model.potential,
            model.potential.constants(kind),
            model.cutoff.name,
            float(model.r_cut[kind]),
            float(model.r_onset[kind]),
            compare,
        )
    return forms


def _lennard_jones(r: ndarray, sigma: float, epsilon: float) -> tuple[ndarray, ndarray]:
    sixth = (sigma / r) ** 6
    return 4.0 * epsilon * sixth * (sixth - 1.0), -24.0 * epsilon * sixth * (2.0 * sixth - 1.0) / r


def _morse(r: ndarray, depth: float, alpha: float, r0: float) -> tuple[ndarray, ndarray]:
    decay = np.exp(-alpha * (r - r0))
    return depth * decay * (decay - 2.0), -2.0 * depth * alpha * decay * (decay - 1.0)


def _soft_sphere(r: ndarray, sigma: float, epsilon: float, alpha: float) -> tuple[ndarray, ndarray]:
    overlap = np.maximum(1.0 - r / sigma, 0.0)
    slope = np.where(overlap > 0, overlap ** (alpha - 1.0), 0.0)
    return epsilon / alpha * overlap**alpha, -epsilon / sigma * slope


_BARE: dict[type, Callable[..., tuple[ndarray, ndarray]]] = {
    LennardJones: _lennard_jones,
    Morse: _morse,
    SoftSphere: _soft_sphere,
}


@dataclass(frozen=True)
class PairModel(Model):
    """A pair potential with a cutoff for each pair of species, or a sum of such potentials."""

    #: for each term, its forms (see `pair_forms`) and the weights of the atoms, None for 1
    terms: Sequence[tuple[Mapping[tuple[str, str], PairForm], Any]]

    @classmethod
    def of(cls, model: CutPotential | Channels, symbols: Sequence[str], compare: str) -> PairModel:
        """Return the model of a potential with cutoff. The arguments are those of `pair_forms`."""
        parts = model.terms.values()
        weights = [np.asarray(part.weights[0]) if part.weights else None for part in parts]
        forms = [pair_forms(part, symbols, compare) for part in parts]
        return cls(tuple(zip(forms, weights, strict=True)))

    @property
    def reach(self) -> float:
        return max(form.r_cut for forms, _ in self.terms for form in forms.values())

    def groups(self, edges: Edges) -> Iterator[tuple[PairForm, ndarray, Any]]:
        """Yield (interaction, edge indices, weights) of the edges inside each cutoff."""
        first, second = edges.symbols[edges.i], edges.symbols[edges.j]
        for forms, weights in self.terms:
            for a, b in product(sorted(set(edges.symbols.tolist())), repeat=2):
                chosen = np.flatnonzero((first == a) & (second == b))
                if len(chosen):
                    form = forms[a, b]
                    rows = chosen[form.inside(edges.r[chosen])]
                    factor = 1.0 if weights is None else weights[edges.i[rows]] * weights[edges.j[rows]]
                    yield form, rows, factor

    def __call__(self, edges: Edges) -> tuple[ndarray, ndarray]:
        energies, gradient = np.zeros(len(edges.symbols)), np.zeros_like(edges.d)
        for form, rows, factor in self.groups(edges):
            u, du = form(edges.r[rows])
            energies += np.bincount(edges.i[rows], 0.5 * u * factor, len(edges.symbols))
            gradient[rows] += (0.5 * du * factor / edges.r[rows])[:, None] * edges.d[rows]
        return energies, gradient


def _triplets(edges: Edges) -> tuple[ndarray, ndarray]:
    """Return ordered pairs (e, f), e != f, of edges from the same atom."""
    starts = np.searchsorted(edges.i, np.arange(len(edges.symbols) + 1))
    first, second = [], []
    for begin, end in pairwise(starts):
        e, f = np.meshgrid(np.arange(begin, end), np.arange(begin, end), indexing="ij")
        keep = e != f
        first.append(e[keep])
        second.append(f[keep])
    return np.concatenate(first).astype(int), np.concatenate(second).astype(int)


def _cosines(edges: Edges, e: ndarray, f: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Return cosines of the angles between edges e and f, with gradients with respect to d_e and d_f."""
    re, rf = edges.r[e], edges.r[f]
    ne, nf = edges.d[e] / re[:, None], edges.d[f] / rf[:, None]
    cosine = np.einsum("ta,ta->t", ne, nf)
    return cosine, (nf - cosine[:, None] * ne) / re[:, None], (ne - cosine[:, None] * nf) / rf[:, None]


def _add_rows(target: ndarray, rows: ndarray, values: ndarray) -> None:
    for axis in range(values.shape[1]):
        target[:, axis] += np.bincount(rows, values[:, axis], len(target))


@dataclass(frozen=True)
class _OneSpecies(Model):
    """A model in which all edges inside the cutoff interact, for any species."""

    constants: Any  # the potential of `mdnum.md.tetrahedral` whose constants it has

    @property
    def reach(self) -> float:
        return float(self.constants.r_cut)

    @abstractmethod
    def within(self, edges: Edges, unit: ndarray) -> tuple[ndarray, ndarray]:
        """Return the energy of each atom and the gradient with respect to each d, for edges within reach."""

    def __call__(self, edges: Edges) -> tuple[ndarray, ndarray]:
        gradient, inside = np.zeros_like(edges.d), edges.r < self.reach
        near = Edges(edges.symbols, edges.i[inside], edges.j[inside], edges.d[inside], edges.r[inside])
        energies, gradient[inside] = self.within(near, near.d / near.r[:, None])
        return energies, gradient


class StillingerWeberModel(_OneSpecies):
    """Stillinger-Weber potential for one species (Physical Review B 31, 5262, 1985, equations 2.1 to 2.5)."""

    def within(self, edges, unit):
        own = self.constants
        x = edges.r / own.sigma
        tail = np.exp(1.0 / (x - own.a))
        dtail = -tail / (x - own.a) ** 2
        core = own.B * x**-4.0 - 1.0
        dcore = -4.0 * own.B * x**-5.0
        pair = 0.5 * own.epsilon * own.A * core * tail
        slope = 0.5 * own.epsilon * own.A * (dcore * tail + core * dtail) / own.sigma
        inner = slope[:, None] * unit

        e, f = _triplets(edges)
        e, f = e[e < f], f[e < f]  # each angle once
        cosine, dce, dcf = _cosines(edges, e, f)
        arm = np.exp(own.gamma / (x - own.a))
        darm = -own.gamma / (x - own.a) ** 2 * arm / own.sigma
        excess = cosine + 1.0 / 3.0
        strength = own.epsilon * own.strength
        angle = strength * arm[e] * arm[f] * excess**2
        twist = 2.0 * strength * arm[e] * arm[f] * excess
        bend = strength * excess**2
        _add_rows(inner, e, twist[:, None] * dce + (bend * darm[e] * arm[f])[:, None] * unit[e])
        _add_rows(inner, f, twist[:, None] * dcf + (bend * arm[e] * darm[f])[:, None] * unit[f])
        n = len(edges.symbols)
        return np.bincount(edges.i, pair, n) + np.bincount(edges.i[e], angle, n), inner


class TersoffModel(_OneSpecies):
    """Tersoff potential for one species (Physical Review B 38, 9902, 1988), in LAMMPS notation."""

    def within(self, edges, unit):
        own, r = self.constants, edges.r
        phase, tapered = 0.5 * np.pi * (r - own.R) / own.D, r > own.R - own.D
        taper = np.where(tapered, 0.5 * (1.0 - np.sin(phase)), 1.0)
        dtaper = np.where(tapered, -0.25 * np.pi / own.D * np.cos(phase), 0.0)

        # zeta of edge e: a sum over the other edges f of the same atom
        e, f = _triplets(edges)
        cosine, dce, dcf = _cosines(edges, e, f)
        c2, d2, away = own.c**2, own.d**2, own.h - cosine
        g = own.gamma * (1.0 + c2 / d2 - c2 / (d2 + away**2))
        dg = -2.0 * own.gamma * c2 * away / (d2 + away**2) ** 2
        stretch = r[e] - r[f]
        grow = np.exp((own.lambda3 * stretch) ** own.m)
        dgrow = own.m * own.lambda3**own.m * stretch ** (own.m - 1.0) * grow
        zeta = np.bincount(e, taper[f] * g * grow, len(r))

        x = (own.beta * zeta) ** own.n
        order = (1.0 + x) ** (-0.5 / own.n)
        with np.errstate(divide="ignore", invalid="ignore"):
            dorder = np.where(zeta > 0, -0.5 * (1.0 + x) ** (-0.5 / own.n - 1.0) * x / zeta, 0.0)
        repulsion, attraction = own.A * np.exp(-own.lambda1 * r), -own.B * np.exp(-own.lambda2 * r)
        bond = 0.5 * taper * (repulsion + order * attraction)
        slope = 0.5 * dtaper * (repulsion + order * attraction)
        slope -= 0.5 * taper * (own.lambda1 * repulsion + own.lambda2 * order * attraction)
        inner = slope[:, None] * unit

        weight = (0.5 * taper * attraction * dorder)[e]
        along_e = (taper[f] * g * dgrow)[:, None] * unit[e] + (taper[f] * grow * dg)[:, None] * dce
        along_f = (dtaper[f] * g * grow - taper[f] * g * dgrow)[:, None] * unit[f]
        along_f = along_f + (taper[f] * grow * dg)[:, None] * dcf
        _add_rows(inner, e, weight[:, None] * along_e)
        _add_rows(inner, f, weight[:, None] * along_f)
        return np.bincount(edges.i, bond, len(edges.symbols)), inner
