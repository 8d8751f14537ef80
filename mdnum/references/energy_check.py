"""Comparison of mdnum with ASE for single frames and for short runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Int
from numpy import ndarray

from mdnum.md.embedded_atom import EmbeddedAtom
from mdnum.md.integrators import VelocityVerlet as OwnVerlet
from mdnum.md.tetrahedral import Tersoff
from mdnum.numerics.roles import WIDE, carrier
from mdnum.numerics.rounding import unit_roundoff
from mdnum.references import lepton
from mdnum.references.adapted import evaluate
from mdnum.references.ase_models import ITSELF, Reference, independent, reference
from mdnum.references.independent import SLACK, Edges, PairModel, edges_of
from mdnum.references.oracle import rounding_bound
from mdnum.systems import build
from mdnum.systems.evaluate import Evaluation
from mdnum.systems.simulation import Simulation
from mdnum.systems.structures import with_images

#: Tolerances for float64: relative energy of pair and of many-body potentials; forces relative to their
#: scale.
ENERGY_PAIR, FORCE, ENERGY_MANY_BODY = 1e-12, 1e-10, 1e-10
LEPTON = 1e-10  # the same of LAMMPS's, which differentiates symbolically
NUMPY, LAMMPS = "numpy", "LAMMPS"  # labels of third evaluations
SOME_STEPS = 200  # steps to the later of the two frames compared by default
SAMPLED = 10_000  # larger systems are compared by a sample: groups of atoms with all their neighbors
ROUNDINGS = 5.0  # that narrower precision must meet, of those expected of a typical number


@dataclass(frozen=True)
class FrameComparison:
    """Comparison of the results of mdnum and of a reference for one frame."""

    frame: str  # which
    # energy, energy_reference: total energies (eV or ε)
    energy: float
    energy_reference: float
    energy_rel: float  # their difference over the energy (or sum |pair energies| / 1000)
    force_max: float  # largest difference of a force component
    force_scale: float  # largest force on an atom or along a pair, which a perfect crystal has too
    force_rel: float  # force_max / force_scale
    # largest difference of a stress component (energy / length³); None without a volume
    stress_max: float | None
    stress_rel: float | None  # over the largest stress that a single kind of term could have
    # energy_expected, force_expected: differences that rounding in the system's precision lets expect
    energy_expected: float
    force_expected: float
    # energy_third, force_third: relative energy and largest force component of mdnum against a third
    # evaluation, in plain numpy or by LAMMPS; None where there is none
    energy_third: float | None
    force_third: float | None
    ambiguous: int  # pairs within rounding of a cutoff, about which the two may rightly differ
    ok: bool  # within tolerance

    @property
    def energy_roundings(self) -> float:
        """Energy difference between mdnum and the reference, divided by the expected rounding error."""
        return _over(abs(self.energy - self.energy_reference), self.energy_expected)

    @property
    def force_roundings(self) -> float:
        """Largest force difference from the reference, divided by the expected rounding error."""
        return _over(self.force_max, self.force_expected)


@dataclass(frozen=True)
class EnergyReport:
    """Comparison of mdnum's energies, forces and stresses with those of a reference."""

    system: str  # name
    reference: str  # what it was compared with; says so when it is not ASE
    is_ase: bool  # whether the reference is a class of ASE
    conversion: str  # what was done to make the conventions equal
    precision: str  # "float64", or the narrowest type in use
    # one comparison per frame, or per group of atoms in it where a sample was compared
    frames: tuple[FrameComparison, ...]
    ok: bool  # every frame within tolerance
    sampled: int | None = None  # atoms that were compared in one of the frames; None for all
    third: str = ""  # what evaluated a third time; empty where nothing did
    untranslated: str = (
        ""  # the operation for which LAMMPS's lepton has no word; empty where none is in the way
    )

    @property
    def worst(self) -> dict[str, Any]:
        """Largest differences from the reference over all frames. The keys are those of summary.json."""
        stress = [frame.stress_max for frame in self.frames if frame.stress_max is not None]
        names = ("energy_rel", "force_max", "force_scale")
        worst = {name: max(getattr(frame, name) for frame in self.frames) for name in names}
        worst |= {"reference": self.reference, "stress_max": max(stress) if stress else None, "ok": self.ok}
        return worst if self.sampled is None else {**worst, "sampled": self.sampled}

    def rows(self) -> list[dict[str, Any]]:
        """Return table rows with the comparison of each frame."""
        narrow = {"energy, roundings": "energy_roundings", "force, roundings": "force_roundings"}
        columns = {
            "energy": "energy", "energy, relative": "energy_rel", "force, largest": "force_max",
            "force, relative": "force_rel", "stress, largest": "stress_max",
            **(narrow if self.precision != "float64" else {}),
            f"against {self.third or NUMPY}": "energy_third", "ambiguous pairs": "ambiguous", "agrees": "ok",
        }  # fmt: skip
        return [
            {"frame": frame.frame, "reference": self.reference}
            | {title: getattr(frame, name) for title, name in columns.items()}
            for frame in self.frames
        ]


def check_energy(
    subject: Any,
    frames: Mapping[str, Atoms] | Sequence[Atoms] | Iterator[tuple[str, Atoms]] | None = None,
    *,
    judge: Reference | None = None,
    lammps: bool = False,
) -> EnergyReport:
    """Compare energies, forces and stresses with those of an ASE calculator or of plain numpy.

    Args:
        subject: a `Simulation`, or any argument of `mdnum.build`.
        frames: positions and cells to compare, by name or in order, or an iterator of names and frames;
            default the initial frame and a later one, since forces vanish in a perfect crystal.
        judge: reference to use instead of the one chosen by `ase_models.reference`.
        lammps: also evaluate a user's pair function with LAMMPS, if installed; the results must agree.

    For a pair potential with more than `SAMPLED` atoms, only a few hundred atoms are compared. These atoms
    are in clusters at random positions (`neighborhoods`). Each frame has different random positions, so that
    two frames cover twice as many atoms.

    Raises:
        InputError: the system cannot be built.
    """
    simulation = build(subject)
    judge = reference(simulation) if judge is None else judge
    label = untranslated = ""
    calculator, other = judge.make(), None
    if judge.is_ase and not isinstance(simulation.potential, EmbeddedAtom):
        label, other = NUMPY, independent(simulation).make()
    elif lammps and judge.label == ITSELF and lepton.installed():
        try:
            label, other = LAMMPS, lepton.Lepton(simulation)
        except lepton.Untranslated as error:
            label, untranslated = "", str(error)
    named = _named(frames, simulation)
    compared: list[FrameComparison] = []
    sampled: set[int] = set()
    for seed, (name, atoms) in enumerate(named):
        # of some of the atoms nobody knows the weights
        weighted = getattr(simulation.model, "weights", ())
        sample = simulation.pairwise and not weighted and len(atoms) > SAMPLED
        whole, mine = _evaluated(atoms, simulation, stress=not sample)
        if not sample:
            compared.append(_compare(name, whole, mine, simulation, calculator, other))
            continue
        for cluster, chosen in neighborhoods(whole, simulation.r_cut, seed=seed):
            of = f"{name}, around atom {chosen[0]}"
            part = _part(mine, cluster, chosen, simulation.r_cut)
            compared.append(_compare(of, cluster, part, simulation, calculator, other))
            sampled |= set(chosen.tolist())
    of, ok = (judge.label, judge.is_ase, judge.conversion), all(frame.ok for frame in compared)
    return EnergyReport(
        simulation.name, *of, narrowest(simulation), tuple(compared), ok, len(sampled) or None, label,
        untranslated,
    )  # fmt: skip


def narrowest(simulation: Simulation, roles: Sequence[str] = ("state", "force", "accumulate")) -> str:
    """Return the least precise of the float types that a simulation uses for given roles."""
    kinds = (carrier(getattr(simulation.policy, role)) for role in roles)
    return max(map(str, kinds), key=unit_roundoff)


def _places(simulation: Simulation) -> str:
    """Return the least precise float type that affects positions. Forces in 16 bits are ignored."""
    wide = simulation.policy.force in WIDE
    return narrowest(simulation) if wide else narrowest(simulation, ("state", "decision"))


def _named(frames: Any, simulation: Any) -> Iterable[tuple[str, Atoms]]:
    if isinstance(frames, Iterator):
        return frames
    if isinstance(frames, Mapping):
        return frames.items()
    if frames is not None:
        return ((f"frame {number}", atoms) for number, atoms in enumerate(frames))
    steps = min(SOME_STEPS, simulation.steps)
    positions = simulation.positions
    for positions, _, _ in _rollout(simulation, steps):  # noqa: B007 the last one counts
        pass
    first, later = simulation.structure.copy(), simulation.structure.copy()
    first.set_positions(simulation.positions)
    later.set_positions(positions)
    return ("initial", first), (f"step {steps}", later)


def _evaluated(atoms: Atoms, simulation: Any, stress: bool) -> tuple[Atoms, Evaluation]:
    """Round a frame to the precision of the state. Return the rounded frame and its results."""
    positions = atoms.get_positions()
    if simulation.policy.state == "float32":
        positions = positions.astype(np.float32).astype(np.float64)  # both are to see what the state can hold
    stored = Atoms(numbers=atoms.numbers, positions=positions, cell=atoms.cell, pbc=simulation.structure.pbc)
    return stored, simulation.evaluate(positions, np.asarray(atoms.cell), stress)


def _part(mine: Evaluation, cluster: Atoms, chosen: ndarray, r_cut: float) -> Evaluation:
    """Return the results for the atoms and the pairs of a cluster."""
    edges = edges_of(cluster, r_cut)
    once = edges.i < edges.j
    pairs = edges.i[once], edges.j[once], edges.r[once]
    energies = mine.energies[chosen]
    return Evaluation(float(energies.sum()), mine.forces[chosen], mine.stress, energies, lambda: pairs)


def _compare(
    name: str, stored: Atoms, mine: Evaluation, simulation: Simulation, calculator: Any, other: Any
) -> FrameComparison:
    theirs = _of_first(evaluate(calculator, stored), len(mine.forces))
    third = _of_first(evaluate(other, stored), len(mine.forces)) if other is not None else None
    scale = _Scales.of(simulation, stored, mine, theirs)
    energy_rel, force_max = _off(mine, theirs, scale.energy)
    stress_max = stress_rel = None
    if theirs["stress"] is not None:
        stress_max = float(np.abs(np.asarray(mine.stress) - theirs["stress"]).max())
        stress_rel = _over(stress_max, scale.stress)
    force_rel = _over(force_max, scale.force)
    if narrowest(simulation) == "float64":
        tolerance = ENERGY_PAIR if simulation.pairwise else ENERGY_MANY_BODY
        ok = energy_rel <= tolerance and force_rel <= FORCE and (stress_rel is None or stress_rel <= FORCE)
    else:
        close = abs(float(mine.energy) - theirs["energy"]) <= ROUNDINGS * scale.energy_expected
        ok = close and force_max <= ROUNDINGS * scale.force_expected
    expected = scale.energy_expected, scale.force_expected
    thirds: Any = (None, None) if third is None else _off(mine, third, scale.energy)
    if isinstance(other, lepton.Lepton) and narrowest(simulation) == "float64":
        energy, force = thirds
        ok = ok and energy <= LEPTON and _over(force, scale.force) <= LEPTON
    return FrameComparison(
        name, float(mine.energy), theirs["energy"], energy_rel, force_max, scale.force, force_rel, stress_max,
        stress_rel, *expected, thirds[0], thirds[1], scale.ambiguous, ok,
    )  # fmt: skip


def _off(mine: Evaluation, other: Mapping[str, Any], scale: float) -> tuple[float, float]:
    """Return (relative difference of the energies, largest difference of a force component)."""
    energy, force = float(mine.energy), np.abs(np.asarray(mine.forces) - other["forces"])
    relative = _over(abs(energy - other["energy"]), max(abs(other["energy"]), 1e-3 * scale))
    return relative, float(force.max(initial=0.0))


def _of_first(results: dict[str, Any], count: int) -> dict[str, Any]:
    """Return the energy and forces of only the first `count` atoms."""
    if len(results["forces"]) == count:
        return results
    energies = results["energies"][:count]
    forces = results["forces"][:count]
    return {"energy": float(energies.sum()), "energies": energies, "forces": forces, "stress": None}


def _over(difference: float, scale: float) -> float:
    """Return difference / scale. 0 if the difference is 0, even at scale 0."""
    return 0.0 if difference == 0.0 else float(difference / scale) if scale > 0.0 else float("inf")


@dataclass(frozen=True)
class _Scales:
    """Scales by which differences of energy, force and stress are divided.

    The energy scale is the sum of |energies|. The force scale is the largest force on an atom or along a
    pair. The stress scale is the sum of |virial terms| per volume. Fields *_expected are expected rounding
    errors.
    """

    energy: float
    force: float
    stress: float
    energy_expected: float
    force_expected: float
    ambiguous: int

    @classmethod
    def of(cls, simulation: Simulation, atoms: Atoms, mine: Any, theirs: Mapping[str, Any]) -> _Scales:
        """Return energy, force and stress scales: sums over pairs if the potential is a pair potential."""
        unit, places = unit_roundoff(narrowest(simulation)), unit_roundoff(_places(simulation))
        largest_force = float(np.abs(theirs["forces"]).max(initial=0.0))
        volume = atoms.get_volume() if atoms.cell.rank == 3 else float("inf")
        positions, cell = atoms.get_positions(), np.asarray(atoms.cell)
        # a displacement is a difference of coordinates of this size, each rounded once or twice
        shift = rounding_bound(positions, cell, 0.0, unit_roundoff=places) / 8.0
        i, j, r = (np.asarray(array) for array in (mine.i, mine.j, mine.distance))
        if not simulation.pairwise:
            # many-body potentials need not split their energy by atom
            split = theirs["energies"]
            energies = float(np.abs(theirs["energy"] if split is None else split).sum())
            force = max(largest_force, _over(energies / max(len(atoms), 1), float(r.min(initial=np.inf))))
            stress = force * float(r.sum()) / volume
            # many-body terms are steep: a bond's stiffness is about force scale per tenth of its length
            stiff = 10.0 * force / max(float(r.mean()) if len(r) else 1.0, 1e-300)
            energy_expected = 4.0 * unit * energies + shift * largest_force * np.sqrt(len(atoms))
            force_expected = 8.0 * unit * force + 4.0 * shift * stiff
            return cls(energies, force, stress, energy_expected, force_expected, 0)
        if places < unit:
            # the distance itself is rounded, too
            shift = shift + unit * r
        model = PairModel.of(simulation.model, simulation.symbols, simulation.decider.compare)
        edges = Edges(np.array(atoms.get_chemical_symbols()), i, j, np.zeros((len(i), 3)), r)
        energies, forces, stiffness = np.zeros(len(i)), np.zeros(len(i)), np.zeros(len(i))
        for form, rows, factor in model.groups(edges):
            u, du = form(r[rows])
            step, size = 1e-4 * form.r_cut, np.abs(factor)
            energies[rows] += size * np.abs(u)
            forces[rows] += size * np.abs(du)
            bend = np.abs(form(r[rows] + step)[1] - form(r[rows] - step)[1])
            stiffness[rows] += size * bend / (2 * step)
        squares = (stiffness * shift) ** 2 + (12.0 * unit * forces) ** 2
        per_atom = np.bincount(i, squares, len(atoms)) + np.bincount(j, squares, len(atoms))
        # rounding of the terms adds at random, rounding of the running sums with their size
        terms = ((forces * shift) ** 2).sum() + ((12.0 * unit * energies) ** 2).sum()
        energy_expected = float(np.sqrt(terms + (unit * energies.sum()) ** 2))
        force = max(largest_force, float(forces.max(initial=0.0)))
        force_expected = float(np.sqrt(per_atom.max(initial=0.0))) + 4.0 * unit * force
        stress, close = float((forces * r).sum()) / volume, _ambiguous(model, atoms, places)
        return cls(float(energies.sum()), force, stress, energy_expected, force_expected, close)


def _ambiguous(model: PairModel, atoms: Atoms, unit: float) -> int:
    """Return the number of pairs whose distance equals the cutoff within rounding error."""
    bound = rounding_bound(atoms.get_positions(), np.asarray(atoms.cell), model.reach, unit_roundoff=unit)
    # as the judges asked for it, where that has the room: the list is made once
    edges = edges_of(atoms, model.reach + (bound if bound > SLACK / 2 * model.reach else 0.0))
    once = edges.i < edges.j
    close = np.zeros(len(edges.i), bool)
    for (a, b), form in (row for forms, _ in model.terms for row in forms.items()):
        chosen = (edges.symbols[edges.i] == a) & (edges.symbols[edges.j] == b)
        close |= chosen & (np.abs(edges.r - form.r_cut) <= bound)
    return int((once & close).sum())


def _rollout(simulation: Any, steps: int) -> Iterator[tuple[ndarray, ndarray, float]]:
    """Yield unwrapped positions, velocities and potential energy at every step, from step 0."""
    from mdnum.rollout.engine import Engine, unwrapped

    for segment in Engine(simulation, steps).segments():
        potential = segment.rows_of("potential")
        for row in range(segment.rows):
            x = np.asarray(segment.unsorted("x", row), np.float64)
            x = unwrapped(segment.cell_of(row).matrix, x, segment.unsorted("images", row))
            yield x, np.asarray(segment.unsorted("v", row), np.float64), float(potential[row])


#: Largest deviation of a position after 100 steps, in units of r_cut.
#: Rounding starts near 1e-16 (6e-8) and chaos multiplies it, by e³ per LJ time in a liquid; five orders of
#: magnitude are left for that. A wrong force or time step shows at 1e-6 or more within ten steps.
AGREEMENT = {"float64": 1e-9, "float32": 1e-2, "float16": 1e-1, "bfloat16": 1e-1}

_SUDDEN = 100.0  # growth of the deviation within one step that chaos cannot do


@dataclass(frozen=True)
class DynamicsReport:
    """Comparison of two trajectories from the same initial state."""

    system: str  # name
    reference: str  # whose forces ASE's VelocityVerlet used
    is_ase: bool  # whether those were a class of ASE
    precision: str  # narrowest float type of mdnum's run
    steps: int  # steps taken
    position: tuple[float, ...]  # largest deviation of a coordinate at each step (length), from step 0
    # largest deviation of a velocity component at each step (length per internal time)
    velocity: tuple[float, ...]
    energy: tuple[float, ...]  # deviation of the potential energy at each step
    growth: float  # factor by which the position deviation grew per step over the second half
    # first step at which it grew a hundredfold at once, which a decision at a cutoff can do and chaos cannot;
    # None where it did not
    sudden: int | None
    r_cut: float  # unit of the tolerance
    tolerance: float  # of the position at the last step, length
    ok: bool  # within tolerance at the last step

    def rows(self) -> list[dict[str, Any]]:
        """Return table rows for about ten of the compared time steps."""
        shown = np.unique(np.linspace(0, self.steps, 11).round().astype(int)).tolist()
        return [
            {
                "step": step, "position, largest": self.position[step],
                "velocity, largest": self.velocity[step], "energy": self.energy[step],
            }
            for step in shown
        ]  # fmt: skip


def check_dynamics(subject: Any, steps: int = 100, *, judge: Reference | None = None) -> DynamicsReport:
    """Compare a run with a velocity Verlet run of ASE from the same start.

    A thermostat is switched off. A hard cutoff gives the same forces as ASE's shifted potential. The
    trajectories must therefore agree, although the energies differ by constants.

    Args:
        subject: a `Simulation`, or any argument of `mdnum.build`.
        judge: calculator of the forces; default ASE, or plain numpy if ASE has none or takes minutes.
    """
    # its optimizers come with it, and a run that is only compared needs none
    from ase.md.verlet import VelocityVerlet

    simulation = build(subject)
    simulation = replace(simulation, integrator=OwnVerlet(simulation.integrator.timestep))
    judge = _forces(simulation) if judge is None else judge
    narrow = simulation.policy.state == "float32"
    start = simulation.positions.astype(np.float32).astype(np.float64) if narrow else simulation.positions
    given = simulation.structure
    atoms = Atoms(given.numbers, start, cell=given.cell, pbc=given.pbc, masses=simulation.masses)
    atoms.set_velocities(simulation.velocities)
    atoms.calc = judge.make()
    integrator = VelocityVerlet(atoms, timestep=float(simulation.integrator.timestep))

    rows = []
    for step, (x, v, potential) in enumerate(_rollout(simulation, steps)):
        if step:
            integrator.run(1)
        off = np.abs(x - atoms.positions).max(), np.abs(v - atoms.get_velocities()).max()
        rows.append((*map(float, off), abs(potential - float(atoms.get_potential_energy()))))
    position, velocity, energy = zip(*rows, strict=True)
    precision, r_cut = narrowest(simulation), simulation.r_cut
    tolerance = AGREEMENT[precision] * r_cut
    ok = len(position) == steps + 1 and position[-1] <= tolerance
    sudden = _sudden(position, floor=(1e-5 if narrow else 1e-13) * r_cut)
    of = simulation.name, judge.label, judge.is_ase, precision, steps
    return DynamicsReport(*of, position, velocity, energy, _growth(position), sudden, r_cut, tolerance, ok)


def _forces(simulation: Simulation) -> Reference:
    """Return the reference calculator: ASE, or plain numpy where ASE is slow (Tersoff, mixtures)."""
    judge = reference(simulation)
    slow = isinstance(simulation.model, Tersoff) or len(simulation.symbols) > 1
    return independent(simulation) if slow and not isinstance(simulation.potential, EmbeddedAtom) else judge


def _sudden(position: Sequence[float], floor: float) -> int | None:
    steps = range(2, len(position))
    return next((step for step in steps if position[step] > _SUDDEN * max(position[step - 1], floor)), None)


def _growth(position: Sequence[float]) -> float:
    """Fit the factor per step by which differences between two trajectories grow."""
    tail = np.array(position[len(position) // 2 :])
    if len(tail) < 3 or not (tail > 0).all():
        return 1.0
    return float(np.exp(np.polyfit(np.arange(len(tail)), np.log(tail), 1)[0]))


# --- a few atoms of a large system with all their neighbors: small enough to be evaluated by anybody -----

PLACES, ATOMS = 8, 32  # places at random, and atoms nearest to each whose energies and forces are compared


def neighborhoods(
    atoms: Atoms, reach: float, *, places: int = PLACES, count: int = ATOMS, seed: int = 0
) -> Iterator[tuple[Atoms, Int[ndarray, "chosen"]]]:
    """Yield clusters of the structure. A cluster is a group with all atoms within `reach`.

    For a pair potential with range `reach`, the group has the same energies and forces as in the whole
    system. Neighbors are found from distances between atoms and images, without mdnum's cell lists.

    Args:
        atoms: the whole system, with any cell; coordinates may lie outside the cell.
        reach: largest range of an interaction, length.
        places, count: number of groups, and largest number of atoms in each, all within reach of its center.
        seed: random seed for the centers; each center is an atom.

    Yields:
        (a nonperiodic cluster, which begins with the group; indices of the group in the whole system).
    """
    x, origin = with_images(atoms, reach)
    # coordinates as they are after a lattice vector is added carry rounding: a little more does no harm
    limit = (reach * (1 + 1e-9)) ** 2
    rng = np.random.default_rng(seed)
    numbers = atoms.numbers
    for center in rng.choice(len(atoms), size=min(places, len(atoms)), replace=False):
        # the first rows of x are the atoms themselves
        square = ((x - x[center]) ** 2).sum(axis=1)
        near = np.flatnonzero(square <= limit)
        chosen = near[np.argsort(square[near], kind="stable")[:count]]
        there = np.flatnonzero(square <= 4.001 * limit)
        apart = ((x[there][:, None] - x[chosen]) ** 2).sum(axis=2)
        around = there[(apart <= limit).any(axis=1)]
        rows = np.concatenate([chosen, np.setdiff1d(around, chosen)])
        yield Atoms(numbers=numbers[origin[rows]], positions=x[rows]), origin[chosen]
