"""From a system to something that runs: the one place where the words of a file become objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.md.cell import Cell, displacement, wrap_positions
from mdnum.md.cutoffs import CUTOFFS, Cutoff
from mdnum.md.decide import PairDecider, Tables
from mdnum.md.integrators import INTEGRATORS, Integrator
from mdnum.md.lattice import Lattice, LatticeDecider, LatticeForce, LatticeStep, on_lattice
from mdnum.md.manybody import ManyBody
from mdnum.md.neighbors import BUILDERS, SLOTS, PairTable, RebuildRule, VerletList, check_radius
from mdnum.md.pairforce import ManyBodyForce, PairForce
from mdnum.md.potentials import POTENTIALS, CutPotential, pair_type
from mdnum.numerics import PrecisionPolicy, check_not_forked, unit_roundoff
from mdnum.numerics.reductions import REDUCTIONS
from mdnum.numerics.roles import LATTICE
from mdnum.systems import pairs, schema
from mdnum.systems.load import System, load
from mdnum.units import Units


@dataclass(frozen=True)
class Simulation:
    """A system as objects: what the rollout, the references and the calculator work with.

    Attributes:
        system: where it came from.
        cell: the box.
        positions: shape (atoms, 3), length, as the structure has them (not wrapped).
        velocities: shape (atoms, 3), length per internal time.
        masses: shape (atoms,).
        species: index into system.species, shape (atoms,).
        model: CutPotential, or a many-body potential.
        decider: the pair decision.
        rule: when lists are rebuilt.
        builder: name of the list builder.
        policy: dtype by role.
        reduction: order of the force sum.
        integrator: the dynamics.
        lattice: units of a state in whole numbers; None where it is one of floats.
    """

    system: System
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
    lattice: Lattice | None = None

    @property
    def units(self) -> Units:
        """The unit system of the file."""
        return self.system.units

    @property
    def atoms(self) -> int:
        """Number of atoms."""
        return len(self.masses)

    @property
    def pairwise(self) -> bool:
        """Whether the fast pair path serves it (else the general path does)."""
        return isinstance(self.model, CutPotential)

    @property
    def pbc(self) -> tuple[bool, bool, bool]:
        """Periodicity per axis."""
        return self.cell.pbc

    @property
    def potential(self) -> Any:
        """The bare pair potential, or the many-body potential."""
        return self.model.potential if self.pairwise else self.model

    @property
    def cutoff(self) -> Any:
        """The cutoff of a pair potential; None where the potential carries its own."""
        return self.model.cutoff if self.pairwise else None

    @property
    def r_cut(self) -> float:
        """The longest interaction radius, length."""
        return max(self.decider.r_cut)

    @cached_property
    def force(self) -> PairForce | ManyBodyForce:
        """Forces and decisions over a list, for use in jit."""
        # kept for later calls, so it must hold no tracer even where its first use is inside a jit
        with jax.ensure_compile_time_eval():
            parts = (self.model, self.cell, self.decider, self.policy, self.reduction)
            if self.lattice is not None:
                return LatticeForce.on(self.lattice, *parts)
            if self.pairwise:
                return PairForce.create(*parts)
            return ManyBodyForce.create(self.model, self.cell, self.decider, self.policy)

    @cached_property
    def propagator(self) -> Integrator:
        """The dynamics as the state needs it: the integrator, or its twin in whole numbers.

        Raises:
            InputError: an integrator, or a friction, that a lattice cannot have.
        """
        if self.lattice is None:
            return self.integrator
        with jax.ensure_compile_time_eval():
            return on_lattice(self.integrator, self.lattice)

    @property
    def smooth(self) -> Simulation:
        """The same system in floats: what is linearized, since a whole number has no derivative."""
        return self if self.lattice is None else replace(self, lattice=None)

    def first_frame(self) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
        """Positions and velocities of step 0 as the state holds them; not wrapped, not narrowed."""
        if self.lattice is None:
            return self.positions, self.velocities
        scheme, masses = self.propagator, jnp.asarray(self.masses)
        assert isinstance(scheme, LatticeStep)
        v = scheme.velocity(scheme.momentum(jnp.asarray(self.velocities.T), masses), masses)
        # an integer has no negative zero
        return self.lattice.positions(self.positions) + 0.0, np.asarray(v).T + 0.0

    @property
    def pair_types(self) -> int:
        """How many kinds of pairs there are."""
        return len(self.decider.r_cut)

    def type_of(self, i, j) -> Int[np.ndarray, "..."]:
        """Pair type of atoms i and j."""
        if self.pair_types == 1:
            return np.zeros(np.broadcast(i, j).shape, np.int64)
        return pair_type(self.species[i], self.species[j], len(self.system.species))

    def jumps(self) -> tuple[Float[np.ndarray, "types"], Float[np.ndarray, "types"]]:
        """Energy and radial force that a pair brings when it enters, per pair type."""
        if self.pairwise:
            return self.model.jumps()
        smoothness = self.model.smoothness
        return np.array([smoothness.energy_jump]), np.array([smoothness.force_jump])

    @property
    def lists(self) -> tuple[Any, ...]:
        """What decides which lists a run has and in which order they are: equal here, equal lists."""
        return self.rule, self.builder

    def verlet_list(self, skin: float | None = None) -> VerletList:
        """A new Verlet list for this system, with another skin where one is given."""
        rule = self.rule if skin is None else replace(self.rule, skin=skin)
        return VerletList(BUILDERS.parse(self.builder), rule, self.r_cut, guard=self._guard)

    @property
    def _guard(self) -> float:
        """Room for rounding of the displacements that are compared with the skin, length."""
        coarsest = max(unit_roundoff(self.policy.dtype(role)) for role in ("state", "decision"))
        return 16 * coarsest * float(np.linalg.norm(self.decider.reach.coordinate))

    def tables(self, table: PairTable) -> Tables:
        """A pair table on the device, with pair types."""
        index, order = table.found, table.sorting
        atoms = index.shape[1]
        shape = (-1, SLOTS, atoms)
        types = None
        if self.pair_types > 1:
            own = self.species if isinstance(index, np.ndarray) else jax.device_put(self.species)
            # padding borrows the last atom's species; its decision is no whatever its type
            species = own[index.__array_namespace__().append(order, order[-1:])]
            kinds = pair_type(species[index], species[:atoms], len(self.system.species))
            types = jax.device_put(kinds.astype(np.uint8).reshape(shape))
        # not jnp.asarray, which compiles a program for every shape
        return Tables(jax.device_put(index.reshape(shape)), types, jax.device_put(order))

    def with_cutoff(self, cutoff: str | Cutoff) -> Simulation:
        """The same system with another treatment of its cutoff (its radius and pairs stay the same)."""
        made = CUTOFFS.parse(cutoff) if isinstance(cutoff, str) else cutoff
        return replace(self, model=replace(self.model, cutoff=made))

    @property
    def continuous(self) -> Simulation:
        """The same forces from an energy that does not jump at the cutoff."""
        if not self.pairwise or self.cutoff.continuous is self.cutoff:
            return self
        return self.with_cutoff(self.cutoff.continuous)

    def with_policy(self, policy: PrecisionPolicy = PrecisionPolicy()) -> Simulation:
        """The same system in floats of these roles, by default float64 throughout."""
        decider = replace(self.decider, dtype=policy.decision, state=policy.state)
        return replace(self, policy=policy, decider=decider, lattice=None)

    def with_cell(self, cell: Cell) -> Simulation:
        """The same system in another box."""
        check_radius(cell, self.r_cut, 0.0)
        cell = cell if self.lattice is None else self.lattice.cell(cell)
        return replace(self, cell=cell, decider=replace(self.decider, reach=cell.reach(self.positions)))

    def evaluate(
        self,
        positions: Float[np.ndarray, "atoms 3"] | None = None,
        cell: Float[np.ndarray, "3 3"] | None = None,
        stress: bool = True,
    ) -> Evaluation:
        """`Evaluator.__call__` for one configuration, with a list of its own."""
        return Evaluator(self, skin=0.0)(positions, cell, stress)

    def numbers(self, positions: np.ndarray | None = None) -> tuple[float, dict[str, jax.Array]]:
        """The potential energy of one configuration alone, with a list of its own, and the numbers behind it.

        Args:
            positions: shape (atoms, 3), length; default the structure's.

        Returns:
            energy; by name `force` on the atoms, energy/length, `r2`: smallest squared distance of each pair
            type and largest of all, length², `pair`: bare energies at the smallest; 0 for none.
        """
        _, _, _, tables, x = Evaluator(self, skin=0.0)._sorted(positions, None)
        bare = self.potential if self.pairwise else None
        energy, found = _numbers(self.force, bare, self.cell, self.pair_types, x, tables)
        return float(energy), found

    def inside(self, wrapped, table: PairTable, bits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs i < j whose decision is yes, sorted, with their distances."""
        i, j = table.decided(bits)
        order = np.lexsort((j, i))
        i, j = i[order], j[order]
        dx, dy, dz = displacement(self.cell, wrapped[i], wrapped[j])
        return i, j, np.sqrt(dx * dx + dy * dy + dz * dz)


def _per_type(table: Float[np.ndarray, "species species"]) -> Float[np.ndarray, "types"]:
    """The upper triangle of a symmetric table, row by row: one entry per pair type."""
    return np.asarray(table, np.float64)[np.triu_indices(len(table))]


def _pair_model(system: System) -> CutPotential:
    spec, species = system.spec, system.species
    assert spec.cutoff is not None
    tables = pairs.pair_constants(spec, species)
    constants = {name: jax.device_put(_per_type(table)) for name, table in tables.items()}
    radius, onset = pairs.cutoff_radii(spec, species)
    r_cut = jax.device_put(_per_type(radius))
    return CutPotential(
        POTENTIALS[spec.potential.kind](**constants),
        CUTOFFS.parse(spec.cutoff.kind),
        r_cut,
        r_cut if onset is None else jax.device_put(_per_type(onset)),
    )


def _many_body_model(system: System):
    from mdnum.md import manybody

    potential = system.spec.potential
    a, b, c = (bool(flag) for flag in system.atoms.pbc)
    pbc = (a, b, c)
    if isinstance(potential, schema.EmbeddedAtomTable):
        symbols = system.atoms.get_chemical_symbols()
        return manybody.embedded_atom(system.folder / potential.file, symbols, pbc)
    assert isinstance(potential, schema.TersoffTable | schema.StillingerWeberTable)
    if others := sorted(set(system.species) - {potential.parameters}):
        raise InputError(
            f"the structure holds {', '.join(others)}, and the constants are those of {potential.parameters}",
            where=f"{system.name}: [potential]",
            remedy="Use a structure of that element alone, or a potential for all of them",
        )
    if isinstance(potential, schema.TersoffTable):
        return manybody.tersoff(potential.parameters, pbc)
    return manybody.stillinger_weber(potential.parameters, pbc)


def _velocities(system: System) -> Float[np.ndarray, "atoms 3"]:
    """The structure's velocities, or Maxwell-Boltzmann at the temperature asked for."""
    dynamics, atoms = system.spec.dynamics, system.atoms
    masses = atoms.get_masses()
    velocities = system.velocities
    if velocities is None:
        kT = system.units.k_B * dynamics.temperature
        noise = np.random.default_rng(dynamics.seed).standard_normal((len(masses), 3))
        velocities = noise * np.sqrt(kT / masses)[:, None]
    if dynamics.remove_drift and len(masses) > 1:
        velocities = velocities - masses @ velocities / masses.sum()
    return np.asarray(velocities, np.float64)


def build(system: System | str, overrides: Mapping[str, Any] | None = None) -> Simulation:
    """The objects of a system.

    Args:
        system: a loaded system, or a name or path to load.
        overrides: as for `load`, where a name or path is given.

    Raises:
        InputError: the cutoff and skin do not fit the box, or the file cannot be run.
    """
    check_not_forked()
    if not isinstance(system, System):
        system = load(system, overrides, world="md")
    spec, units = system.spec, system.units
    cell = Cell.create(np.asarray(system.atoms.cell), system.atoms.pbc)
    precision = spec.precision
    policy = PrecisionPolicy(precision.state, precision.force, precision.decision, precision.accumulate)
    reach = cell.reach(np.asarray(system.atoms.positions, np.float64))
    if spec.cutoff is not None:
        model = _pair_model(system)
        radii = tuple(float(r) for r in np.asarray(model.r_cut))
        decider = PairDecider(radii, spec.cutoff.compare, precision.decision, reach, precision.state)
    else:
        if policy != PrecisionPolicy():
            raise InputError(
                "many-body potentials are evaluated in float64 only",
                where="precision",
                remedy="Remove the [precision] table",
            )
        model = _many_body_model(system)
        decider = PairDecider((float(model.r_cut),), "r <", "float64", reach)
    check_radius(cell, max(decider.r_cut), spec.skin)
    rebuild = spec.neighbors.rebuild
    builder = spec.neighbors.builder
    simulation = Simulation(
        system,
        cell,
        np.asarray(system.atoms.positions, np.float64),
        _velocities(system),
        np.asarray(system.atoms.get_masses(), np.float64),
        system.species_index,
        model,
        decider,
        RebuildRule(spec.skin, rebuild.every, rebuild.delay, rebuild.check),
        # a search on the host wins on a CPU; on an accelerator the positions would have to travel
        ("host" if jax.default_backend() == "cpu" else "device") if builder == "auto" else builder,
        policy,
        REDUCTIONS.parse(precision.reduction),
        INTEGRATORS[spec.dynamics.kind].of_file(spec.dynamics.model_dump(), units),
    )
    return _in_whole_numbers(simulation) if precision.state == LATTICE else simulation


def with_potential(simulation: Simulation, potential: ManyBody) -> Simulation:
    """The system with another potential: any energy over a neighbor list, such as one of jax-md's.

    Args:
        simulation: the system as objects; in float64.
        potential: an `EnergyFunction`, or another of `mdnum.md.manybody`.

    Raises:
        InputError: its radius and the skin do not fit the box, or the system is not in float64 throughout.
    """
    if simulation.policy != PrecisionPolicy():
        raise InputError(
            "many-body potentials are evaluated in float64 only", remedy="Remove the [precision] table"
        )
    radius = float(potential.r_cut)  # type: ignore[attr-defined]
    check_radius(simulation.cell, radius, simulation.rule.skin)
    decider = PairDecider((radius,), "r <", "float64", simulation.decider.reach)
    return replace(simulation, model=potential, decider=decider)


def _in_whole_numbers(simulation: Simulation) -> Simulation:
    """The simulation on a lattice, in a box that fits it."""
    spec, masses = simulation.system.spec, simulation.masses
    roles = (spec.precision.force, spec.precision.decision, spec.precision.accumulate)
    if roles != ("float64",) * 3:
        raise InputError(
            'state = "lattice" decides and sums in whole numbers, from forces in float64',
            where="precision",
            remedy="Leave out force, decision and accumulate",
        )
    kT = simulation.units.k_B * spec.dynamics.temperature
    own = masses * np.linalg.norm(simulation.velocities, axis=1)
    lattice = Lattice.create(
        simulation.cell,
        simulation.r_cut + spec.skin,
        simulation.model,
        np.maximum(np.sqrt(masses * kT), own / 4),
        kT,
        float(simulation.integrator.timestep),
    )
    cell, old = lattice.cell(simulation.cell), simulation.decider
    atoms = simulation.system.atoms.copy()
    atoms.set_cell(np.asarray(cell.matrix))
    reach = cell.reach(simulation.positions)
    made = replace(
        simulation,
        system=replace(simulation.system, atoms=atoms),
        cell=cell,
        decider=LatticeDecider(old.r_cut, old.compare, "float64", reach, spacing=lattice.spacing),
        lattice=lattice,
    )
    # made here, so that a friction that a lattice cannot have is refused before the run
    assert made.propagator is not None
    return made


# --- energies and forces of single configurations, with a Verlet list that is kept while it serves ----


@dataclass(frozen=True)
class Evaluation:
    """Energies and forces of one configuration."""

    energy: float  # total energy
    forces: Float[np.ndarray, "atoms 3"]  # shape (atoms, 3), energy/length
    # dE/dstrain / volume (ASE's sign), shape (3, 3), energy/length³; NaN without a volume, and where it was
    # not asked for
    stress: Float[np.ndarray, "3 3"]
    # per atom, shape (atoms,), pair terms split evenly; NaN for many-body potentials
    energies: Float[np.ndarray, "atoms"]
    # finds the pairs inside the (longest) cutoff, i < j, and their distances, once asked for
    find_pairs: Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]

    @cached_property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.find_pairs()

    @property
    def i(self) -> Int[np.ndarray, "pairs"]:
        """First atoms of the pairs inside."""
        return self._pairs[0]

    @property
    def j(self) -> Int[np.ndarray, "pairs"]:
        """Second atoms of the pairs inside."""
        return self._pairs[1]

    @property
    def distance(self) -> Float[np.ndarray, "pairs"]:
        """Distances of the pairs inside, length."""
        return self._pairs[2]


class Evaluator:
    """Evaluates one configuration after another, with a list rebuilt once motion and strain used its skin.

    Args:
        simulation: the system as objects.
        skin: skin of the list, length; default the system's. A box too narrow for it gets what fits.
    """

    def __init__(self, simulation: Simulation, skin: float | None = None):
        self.simulation = simulation
        self.skin = simulation.rule.skin if skin is None else skin
        self.builds = 0
        self._verlet = simulation.verlet_list(self.skin)
        self._kept: tuple[PairTable, Tables, Float[np.ndarray, "atoms 3"], Cell] | None = None

    def __call__(
        self,
        positions: Float[np.ndarray, "atoms 3"] | None = None,
        cell: Float[np.ndarray, "3 3"] | None = None,
        stress: bool = True,
    ) -> Evaluation:
        """Energy, forces, stress and pairs.

        Args:
            positions: length; default the structure's.
            cell: lattice vectors as rows; default the system's.
            stress: whether it is needed; it takes about as long as the forces.

        Raises:
            InputError: the cutoff exceeds half the smallest perpendicular width.
        """
        here, wrapped, table, tables, x = self._sorted(positions, cell)
        result, bits, virial = evaluate_listed(here.force, x, tables, stress)
        forces = np.empty((here.atoms, 3))
        forces[table.order] = np.asarray(result.force, np.float64).T
        energies = np.full(here.atoms, np.nan)
        if here.pairwise:
            energies[table.order] = np.asarray(result.energy, np.float64)
        return Evaluation(
            float(jnp.sum(result.energy, dtype=jnp.float64)),
            forces,
            np.full((3, 3), np.nan) if virial is None else -np.asarray(virial) / here.cell.volume,
            energies,
            lambda: here.inside(wrapped, table, np.asarray(bits)),
        )

    def _sorted(self, positions, cell) -> tuple[Simulation, np.ndarray, PairTable, Tables, jax.Array]:
        """The simulation in this cell, wrapped positions, the list for them, and positions in its order."""
        check_not_forked()
        own = self.simulation
        same_box = cell is None or np.array_equal(cell, np.asarray(own.cell.matrix))
        here = own if same_box else own.with_cell(Cell.create(cell, own.pbc))
        at = np.asarray(own.positions if positions is None else positions, np.float64)
        wrapped, _ = wrap_positions(here.cell, at)
        table, tables = self._list(here, wrapped)
        x = wrapped[table.order].T.astype(here.policy.dtype("state"), order="C")
        return here, wrapped, table, tables, jax.device_put(x)

    def _list(self, here: Simulation, wrapped) -> tuple[PairTable, Tables]:
        """The list in use, rebuilt where it no longer holds every pair inside."""
        if self._kept is not None:
            table, tables, reference, reference_cell = self._kept
            if self._verlet.consumed(wrapped, here.cell, reference, reference_cell) <= 1.0:
                return table, tables
        slots = self._verlet.slots
        self._verlet = here.verlet_list(min(self.skin, float(here.cell.widths.min()) / 2 - here.r_cut))
        # capacity only grows: each new size would be compiled for
        self._verlet.slots = slots
        table = self._verlet.build(wrapped, here.cell)
        self._kept = table, here.tables(table), wrapped, here.cell
        self.builds += 1
        return table, self._kept[1]


@eqx.filter_jit
def evaluate_listed(force: PairForce | ManyBodyForce, x, tables: Tables, stress: bool):
    """Forces, decisions, and the virial tensor sum r_ij ⊗ F_ij where the stress is needed."""
    result = force(x, tables, decisions=True)
    assert result.decisions is not None
    return result, result.decisions.bits, force.virial_tensor(x, tables) if stress else None


@eqx.filter_jit
def _numbers(force: PairForce | ManyBodyForce, bare, cell: Cell, types: int, x, tables: Tables):
    made, cell = force(x, tables, decisions=False), cell.astype(x.dtype)

    def wider(found, group):
        index, kind = group
        d = cell.minimum_image(*(x[:, index] - x[:, None]))
        r2, there = sum(c.astype(jnp.float64) ** 2 for c in d), index < x.shape[1]
        of_type = there & (jnp.arange(types, dtype=jnp.uint8)[:, None, None] == (0 if kind is None else kind))
        least = jnp.min(jnp.where(of_type, r2, jnp.inf), (1, 2))
        return (jnp.minimum(found[0], least), jnp.max(r2, where=there, initial=found[1])), None

    closest, furthest = jax.lax.scan(wider, (jnp.full(types, jnp.inf), jnp.zeros(())), tables.groups())[0]
    pair = jnp.zeros(types) if bare is None else bare.evaluate(closest)[0]
    closest, pair = (jnp.where(jnp.isinf(closest), 0.0, one) for one in (closest, pair))
    found = {"force": made.force, "r2": jnp.append(closest, furthest), "pair": pair}
    return jnp.sum(made.energy, dtype=jnp.float64), found
