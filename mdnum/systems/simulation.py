"""The simulation object: structure, potential, neighbor-list rule, integrator, precision and units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.md.cell import Cell, displacement
from mdnum.md.cutoffs import CUTOFFS, Cutoff
from mdnum.md.decide import PairDecider, Tables
from mdnum.md.fixed_point import FixedPointForce, FixedPointStep, FixedPointUnits, fixed_point_steps
from mdnum.md.integrators import Integrator
from mdnum.md.neighbors import BUILDERS, SLOTS, PairTable, RebuildRule, VerletList, check_radius
from mdnum.md.pairforce import ChannelForce, ManyBodyForce, PairForce
from mdnum.md.potentials import Channels, CutPotential, each_term, pair_type
from mdnum.numerics import PrecisionPolicy, unit_roundoff
from mdnum.numerics.roles import FIXED_POINT, WIDE
from mdnum.systems import describe
from mdnum.systems.evaluate import Evaluation, Evaluator
from mdnum.systems.schema import ONSET_FRACTION
from mdnum.systems.structures import Draw
from mdnum.units import Units

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.systems.load import System


@dataclass(frozen=True)
class Origin:
    """The origin of a simulation: its name, description and system file."""

    name: str  # what it is called
    about: str = ""  # a sentence for people
    system: System | None = None  # the system file that it was built from
    fork: Mapping[str, Any] = field(default_factory=dict)  # what a question about forks asks by default
    # of one built from a file its fields as they were then; one that differs was changed since
    parts: Mapping[str, Any] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class Simulation:
    """A simulation, which is the input of every command, reference method and calculator.

    `mdnum.simulation` creates a simulation from a structure, `mdnum.build` from a system file.

    Example:
        >>> sim = mdnum.build("argon/liquid-864")
        >>> sim.evaluate().energy

    Attributes:
        origin: source of the simulation.
        structure: atoms as given by the user; step 0 uses the positions and velocities below.
        units: unit system of user input and printed output.
        symbols: chemical symbols present, sorted.
        cell: the box of step 0. If the integrator changes the box, `Segment.cell_of` returns a later box.
        positions: positions of the structure (not wrapped), shape (atoms, 3), length.
        velocities: velocities of step 0, shape (atoms, 3), length per internal time.
        masses: masses of the atoms, shape (atoms,).
        species: index of each atom's species in symbols, shape (atoms,).
        model: a CutPotential, Channels, or a many-body potential.
        decider: the comparison that decides whether a pair is inside the cutoff.
        rule: rule that determines when lists are rebuilt.
        builder: name of the list builder.
        policy: dtype by role.
        reduction: order of the force sum.
        integrator: the dynamics.
        draw: how the velocities of step 0 were created.
        steps, save_every: default last step of a run, and default number of steps between trajectory frames
            (0: no frames).
        fixed_point: units of a fixed-point state; None for a floating-point state.
    """

    origin: Origin
    structure: Atoms
    units: Units
    symbols: tuple[str, ...]
    cell: Cell
    positions: Float[np.ndarray, "atoms 3"]
    velocities: Float[np.ndarray, "atoms 3"]
    masses: Float[np.ndarray, "atoms"]
    species: Int[np.ndarray, "atoms"]
    model: Any
    decider: PairDecider
    rule: RebuildRule
    builder: str
    policy: PrecisionPolicy
    reduction: Any
    integrator: Integrator
    draw: Draw
    steps: int
    save_every: int
    fixed_point: FixedPointUnits | None = None

    def __post_init__(self):
        at_rest = self.draw.remove_drift and self.integrator.keeps_momentum and self.atoms > 1
        if self.integrator.constraints != 3 * at_rest:
            object.__setattr__(self, "integrator", replace(self.integrator, constraints=3 * at_rest))
        short = self.policy.state == FIXED_POINT or self.policy.force not in WIDE
        if not self.pairwise and short:
            message = "many-body potentials are evaluated in float64 and float32 only"
            raise InputError(message, where="precision", remedy="Set state and force to float64 or float32")
        if short and self.pairwise and "" not in self.model.terms:
            seen = f"not with {self.policy.state} state and {self.policy.force} forces"
            remedy = "Leave out state and force, or write the sum as one potential"
            message = f"terms are added in float64 and float32, {seen}"
            raise InputError(message, where="precision", remedy=remedy)

    @property
    def name(self) -> str:
        """Name of the simulation, such as "argon/liquid-864"."""
        return self.origin.name

    @property
    def file(self) -> System | None:
        """System file that describes the simulation exactly, or None."""
        its = self.origin.parts
        same = bool(its) and all(getattr(self, name) is part for name, part in its.items())
        return self.origin.system if same else None

    @property
    def timestep(self) -> float:
        """Time step of the simulation, in the time unit of `units`."""
        step, factor = float(self.integrator.timestep), self.units.time_factor
        # the shortest number that makes this step, which is what a person wrote
        short = float(f"{step / factor:.15g}")
        return short if short * factor == step else step / factor

    @property
    def atoms(self) -> int:
        """Number of atoms."""
        return len(self.masses)

    @property
    def pairwise(self) -> bool:
        """True if the potential is a pair potential or a sum of them."""
        return isinstance(self.model, CutPotential | Channels)

    @property
    def imposable(self) -> bool:
        """Whether cutoff decisions can be imposed. False if the energy function applies its own cutoff."""
        return self.pairwise or self.model.trusts_list

    @property
    def pbc(self) -> tuple[bool, bool, bool]:
        """Whether the box is periodic along each of its three axes."""
        return self.cell.pbc

    @property
    def potential(self) -> Any:
        """The pair potential before truncation, or the many-body potential."""
        return self.model.potential if self.pairwise else self.model

    @property
    def cutoff(self) -> Any:
        """Cutoff of a pair potential. None if the potential contains its own cutoff."""
        return self.model.cutoff if self.pairwise else None

    @property
    def r_cut(self) -> float:
        """Longest interaction radius, in length units."""
        return max(self.decider.r_cut)

    @cached_property
    def force(self) -> PairForce | ManyBodyForce:
        """Function that computes forces and cutoff decisions from a neighbor list."""
        # kept for later calls, so it must hold no tracer even where its first use is inside a jit
        with jax.ensure_compile_time_eval():
            parts = (self.model, self.cell, self.decider, self.policy, self.reduction)
            if self.fixed_point is not None:
                return FixedPointForce.on(self.fixed_point, *parts)
            if self.pairwise:
                return (PairForce if self.channels == 1 else ChannelForce).create(*parts)
            return ManyBodyForce.create(self.model, self.cell, self.decider, self.policy)

    @cached_property
    def propagator(self) -> Integrator:
        """The integrator of the simulation. A fixed-point state uses a fixed-point integrator.

        Raises:
            InputError: the integrator or its friction does not support a fixed-point state.
        """
        if self.fixed_point is None:
            return self.integrator
        with jax.ensure_compile_time_eval():
            return fixed_point_steps(self.integrator, self.fixed_point)

    @property
    def smooth(self) -> Simulation:
        """The same system with a floating-point state, for derivatives."""
        return self if self.fixed_point is None else replace(self, fixed_point=None)

    @property
    def path(self) -> Path | None:
        """Path of the system file, or None for a simulation made from objects."""
        return None if self.file is None else self.file.path

    @property
    def program(self) -> dict[str, Any]:
        """All parameters and settings except the structure, as plain values, for hashing."""
        return self.file.program if self.file is not None else describe.program(self)

    def write(self, folder: str | Path) -> None:
        """Write the system file (or a description of the objects) and the structure to a folder."""
        describe.write(self, Path(folder))

    def first_frame(self) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
        """Return the unwrapped positions and the velocities of step 0."""
        if self.fixed_point is None:
            return self.positions, self.velocities
        scheme, masses = self.propagator, jnp.asarray(self.masses)
        assert isinstance(scheme, FixedPointStep)
        v = scheme.velocity(scheme.momentum(jnp.asarray(self.velocities.T), masses), masses)
        # an integer has no negative zero
        return self.fixed_point.positions(self.positions) + 0.0, np.asarray(v).T + 0.0

    @property
    def channels(self) -> int:
        """Number of cutoff decisions per pair of atoms. Terms with equal cutoff radii share a decision."""
        return len(self.model.parts) if self.pairwise else 1

    @property
    def pair_types(self) -> int:
        """Number of pair types."""
        return len(self.decider.r_cut) // self.channels

    def type_of(self, i, j) -> Int[np.ndarray, "..."]:
        """Return an index for each pair of atoms. The index depends on both species and the channel (cutoff).

        Args:
            i: index of the first atom, plus the number of atoms times the index of the channel.
        """
        channel, i = np.divmod(i, self.atoms)
        if self.pair_types == 1:
            return channel + np.zeros(np.broadcast(i, j).shape, np.int64)
        return channel * self.pair_types + pair_type(self.species[i], self.species[j], len(self.symbols))

    def first_atoms(self, i: Any) -> dict[str, Any]:
        """Return the first atom of each pair, and the term if terms decide separately."""
        if self.channels == 1:
            return {"i": i}
        channel, i = np.divmod(np.asarray(i, np.int64), self.atoms)
        return {"i": i, **self.terms_of(channel * self.pair_types)}

    def terms_of(self, kind: Any) -> dict[str, Any]:
        """Return a table column with the potential term of each decision, if terms decide separately."""
        if self.channels == 1:
            return {}
        names = np.array([part.potential.name for part in self.model.parts])
        return {"terms": names[kind // self.pair_types]}

    def pair_of(self, i: int, j: int) -> dict[str, Any]:
        """Return a table row with both atoms of a pair, and the term if terms decide separately."""
        return {key: np.asarray(one).item() for key, one in self.first_atoms(i).items()} | {"j": int(j)}

    def jumps(self) -> tuple[Float[np.ndarray, "kinds"], Float[np.ndarray, "kinds"]]:
        """Return the jumps of energy and radial force at the cutoff, for each type of decision.

        If atoms have weights, the result is an upper bound on the absolute jumps.
        """
        if not self.pairwise:
            smoothness = self.model.smoothness
            return np.array([smoothness.energy_jump]), np.array([smoothness.force_jump])
        jumps, weights = self.model.jumps(), self._weights
        if weights is not None:
            jumps = np.abs(jumps) * np.max(np.square(weights), axis=1, initial=0.0)[:, None]
        energy, force = (reduce(np.add, one) for one in jumps)
        return energy, force

    @property
    def _weights(self) -> Float[np.ndarray, "terms atoms"] | None:
        """Weight of each atom in each term of the potential. None if there are no weights."""
        if not self.pairwise or not self.model.weights:
            return None
        each = (term.weights for term in self.model.terms.values())
        return np.stack([np.asarray(own[0]) if own else np.ones(self.atoms) for own in each])

    def jumps_of(self, i, j) -> tuple[Float[np.ndarray, "pairs"], Float[np.ndarray, "pairs"]]:
        """Return the jumps of energy and radial force at the cutoff for atoms i (see `type_of`) and j."""
        kind, weights = self.type_of(i, j), self._weights
        if weights is None:
            energy, force = (jump[kind] for jump in self.jumps())
        else:
            energy, force = np.sum(
                self.model.jumps()[:, :, kind] * weights[:, i % self.atoms] * weights[:, j], 1
            )
        return energy, force

    @property
    def lists(self) -> tuple[Any, ...]:
        """Settings that determine the neighbor lists. Equal settings give equal neighbor lists."""
        return self.rule, self.builder

    def verlet_list(self, skin: float | None = None) -> VerletList:
        """Create a Verlet list for this system, optionally with another skin."""
        rule = self.rule if skin is None else replace(self.rule, skin=skin)
        return VerletList(BUILDERS.parse(self.builder), rule, self.r_cut, guard=self._guard)

    @property
    def _guard(self) -> float:
        """Tolerance (a length) for rounding errors when displacements are compared with the skin."""
        coarsest = max(unit_roundoff(self.policy.dtype(role)) for role in ("state", "decision"))
        return 16 * coarsest * float(np.linalg.norm(self.decider.reach.coordinate))

    def tables(self, table: PairTable) -> Tables:
        """Copy a neighbor table to the device. Add the pair type of each entry."""
        index, order = table.found, table.sorting
        atoms = index.shape[1]
        shape = (-1, SLOTS, atoms)
        types = None
        if self.pair_types > 1:
            own = self.species if isinstance(index, np.ndarray) else jax.device_put(self.species)
            # padding borrows the last atom's species; its decision is no whatever its type
            species = own[index.__array_namespace__().append(order, order[-1:])]
            kinds = pair_type(species[index], species[:atoms], len(self.symbols))
            types = jax.device_put(kinds.astype(np.uint8).reshape(shape))
        # not jnp.asarray, which compiles a program for every shape
        edges = None
        if not self.pairwise:
            edges = jax.device_put(_edges(np.asarray(index), self.model.format))
        return Tables(jax.device_put(index.reshape(shape)), types, jax.device_put(order), edges)

    def with_model(self, model: Any) -> Simulation:
        """Return the system with another potential and its cutoff radii.

        Raises:
            InputError: the box is too small for the longest radius and the skin, or the precision of a
                many-body potential is neither float64 nor float32.
        """
        radii = tuple(np.atleast_1d(np.asarray(model.r_cut, np.float64)).tolist())
        check_radius(self.cell, max(radii), self.rule.skin)
        compare = self.decider.compare if isinstance(model, CutPotential | Channels) else model.compare
        return replace(self, model=model, decider=replace(self.decider, r_cut=radii, compare=compare))

    @property
    def apart(self) -> Simulation:
        """The same system with separate decisions for each term of the potential."""
        return self.with_model(Channels.of_terms(self.model.terms, apart=True))

    def with_cutoff(self, cutoff: str | Cutoff) -> Simulation:
        """Return the system with another kind of cutoff, but the same radius.

        The onset of the switching function is kept. Without an onset, 0.9 of the cutoff radius is used.
        """
        made = CUTOFFS.parse(cutoff) if isinstance(cutoff, str) else cutoff
        return self._ended(lambda _: made)

    def _ended(self, change: Callable[[Cutoff], Cutoff]) -> Simulation:
        """Return the system with the cutoffs of all terms changed by a function."""

        def ended(term: CutPotential) -> CutPotential:
            made, onset = change(term.cutoff), term.r_onset
            if made.switches != term.cutoff.switches:
                onset = term.r_cut * (ONSET_FRACTION if made.switches else 1)
            return replace(term, cutoff=made, r_onset=onset)

        return replace(self, model=each_term(self.model, ended))

    @property
    def continuous(self) -> Simulation:
        """The same system with an energy that is continuous at the cutoff. The forces do not change."""
        if not self.pairwise or self.cutoff.smoothness >= 0:
            return self
        return self._ended(lambda end: end.continuous)

    def with_policy(self, policy: PrecisionPolicy = PrecisionPolicy()) -> Simulation:
        """Return the system with a floating-point state in some precision (default: float64)."""
        decider = replace(self.decider, dtype=policy.decision, state=policy.state)
        return replace(self, policy=policy, decider=decider, fixed_point=None)

    def in_row(self, cell: Cell | None) -> Simulation:
        """Return the system with the box of a given step."""
        return self.with_cell(jax.tree.map(np.asarray, cell)) if self.integrator.moves_cell else self

    def with_cell(self, cell: Cell) -> Simulation:
        """Return the same system in another simulation box."""
        check_radius(cell, self.r_cut, 0.0)
        if not self.pairwise and getattr(self.model, "fixed_box", False):
            message = f"{self.model.name} always uses the box with which it was made"
            remedy = "Let the potential take the argument box= (jax_md.space.periodic_general)"
            raise InputError(message, where=self.name, remedy=remedy)
        cell = cell if self.fixed_point is None else self.fixed_point.cell(cell)
        return replace(self, cell=cell, decider=replace(self.decider, reach=cell.reach(self.positions)))

    def evaluate(
        self,
        positions: Float[np.ndarray, "atoms 3"] | None = None,
        cell: Float[np.ndarray, "3 3"] | None = None,
        stress: bool = True,
    ) -> Evaluation:
        """Compute energy and forces of a configuration. `Evaluator.__call__` describes the arguments."""
        return Evaluator(self, skin=0.0, often=False)(positions, cell, stress)

    def numbers(self, positions: np.ndarray | None = None) -> tuple[float, dict[str, jax.Array]]:
        """Compute the potential energy, the forces, and the smallest and largest pair distances.

        Args:
            positions: shape (atoms, 3), length; default those of the structure.

        Returns:
            the energy, and by name: `force` on the atoms, energy/length; `r2`, smallest squared distance of
            each pair type and largest of all, length²; `pair`, bare energies at the smallest distances; 0
            without a pair.
        """
        return Evaluator(self, skin=0.0, often=False).numbers(positions)

    def inside(self, wrapped, table: PairTable, bits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pairs i < j inside the cutoff, sorted by i and j, and their distances."""
        i, j = table.decided(bits)
        if self.channels > 1:
            i, j = np.divmod(np.unique(i % self.atoms * self.atoms + j), self.atoms)
        order = np.lexsort((j, i))
        i, j = i[order], j[order]
        dx, dy, dz = displacement(self.cell, wrapped[i], wrapped[j])
        return i, j, np.sqrt(dx * dx + dy * dy + dz * dz)


def _edges(index: Int[np.ndarray, "slots atoms"], form: str) -> Int[np.ndarray, "first second"]:
    """Return the pairs in a neighbor list, grouped by atom (see `Tables.edges`)."""
    atoms = index.shape[1]
    if form == "dense":
        return np.ascontiguousarray(index.T, np.int32)
    first, slot = np.nonzero((index < (np.arange(atoms) if form == "ordered-sparse" else atoms)).T)
    # every length is compiled for; that of a liquid's lists varies by less than a sixteenth
    step = max(64, 1 << max(0, len(first).bit_length() - 4))
    edges = np.full((3, step * (len(first) // step + 1)), atoms, np.int32)
    edges[:, : len(first)] = index[slot, first], first, slot
    return edges
