"""Construction of simulations from Python objects, such as ASE structures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from mdnum import units as unit_systems
from mdnum.errors import InputError, in_a_line
from mdnum.md.cell import Cell
from mdnum.md.cutoffs import CUTOFFS
from mdnum.md.decide import PairDecider
from mdnum.md.energies import EnergyFunction
from mdnum.md.fixed_point import FixedPointDecider, FixedPointUnits
from mdnum.md.integrators import INTEGRATORS, Integrator, Langevin, VelocityVerlet
from mdnum.md.manybody import ManyBody, leaves_by_path
from mdnum.md.neighbors import RebuildRule, check_radius
from mdnum.md.potentials import Channels, CutPotential, PairFunction, PairPotential, each_term, pair_type
from mdnum.numerics import PrecisionPolicy, check_not_forked
from mdnum.numerics.reductions import REDUCTIONS
from mdnum.numerics.roles import FIXED_POINT
from mdnum.systems.schema import DEFAULT_SKIN, ONSET_FRACTION, DynamicsAlone, pair_key, pair_names
from mdnum.systems.simulation import Origin, Simulation
from mdnum.systems.structures import Draw, check, smallest_distance, species_of
from mdnum.systems.toml import Source, checked
from mdnum.units import Units

if TYPE_CHECKING:
    from ase import Atoms


#: Relative difference above which the energies of a pair in both orders count as different.
_SYMMETRIC = 1e-12
#: Distance from the cutoff at which the energy is compared with that at the cutoff, and the largest slope
#: there, both relative to the cutoff.
_INSIDE, _STEEP = 1e-7, 1e4


@dataclass(frozen=True)
class Cut:
    """The cutoff of a pair potential: its kind and its radius.

    Example:
        >>> Cut("switched", 8.5, onset=7.0)
        >>> Cut("hard", {"Ni-Ni": 2.5, "Ni-P": 2.0, "P-P": 2.2})

    Args:
        kind: a name from `mdnum.md.cutoffs.CUTOFFS`, such as "hard", "shifted" or "switched".
        radius: cutoff radius, length; one for all pairs, or one for each pair of species.
        onset: distance at which switching begins, length, in the form of the radius; default 0.9 of the
            radius.
        compare: comparison that defines the inside, one of "r2 <", "r2 <=", "r <", "r <=".
    """

    kind: str
    radius: float | Mapping[str, float]
    onset: float | Mapping[str, float] | None = None
    compare: str = "r2 <"


@dataclass(frozen=True)
class Term:
    """A pair potential with its own cutoff, for a sum of potentials.

    Example:
        >>> Term(LennardJones(sigma=2.3, epsilon=0.01), Cut("switched", 8.5))
        >>> Term(PairFunction(coulomb), Cut("shifted", 8.5), weight={"Na": 1.0, "Cl": -1.0})

    Args:
        potential: potential of a pair whose atoms both have weight 1.
        cutoff: cutoff of the term. Terms with the same radii share the decision of each pair.
        weight: a number for each species, or an array with one number for each atom; the energy of a pair is
            multiplied by the weights of both atoms. Default 1.
    """

    potential: PairPotential
    cutoff: Cut
    weight: Mapping[str, float] | Float[np.ndarray, "atoms"] | None = None


def simulation(
    atoms: Atoms,
    potential: PairPotential | ManyBody | Mapping[str, Term],
    cutoff: Cut | None = None,
    *,
    timestep: float | None = None,
    units: str = "metal",
    temperature: float = 0.0,
    friction: float | None = None,
    pressure: float | None = None,
    integrator: Integrator | type[Integrator] | str | None = None,
    dynamics: Mapping[str, Any] | None = None,
    seed: int = 0,
    remove_drift: bool = True,
    drawn: bool | None = None,
    steps: int = 1000,
    save_every: int = 0,
    skin: float | None = None,
    rebuild: tuple[int, int, bool] = (1, 0, True),
    builder: str = "auto",
    precision: PrecisionPolicy = PrecisionPolicy(),
    reduction: str = "sequential",
    name: str = "simulation",
    about: str = "",
) -> Simulation:
    """Create a simulation from a structure and a potential.

    Example:
        >>> atoms = ase.build.bulk("Ar", "fcc", a=5.26, cubic=True).repeat(4)
        >>> argon = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235)
        >>> sim = mdnum.simulation(atoms, argon, mdnum.Cut("switched", 8.5), timestep=0.002, temperature=90)
        >>> mdnum.run(sim, steps=500)

    Args:
        atoms: positions, cell and periodicity; masses default to those of ASE, or to 1 in reduced units.
        potential: a pair potential, whose parameters are numbers or {"Ni-P": number, ...}; a dictionary of
            `Term`s that are added; or a potential from `mdnum.md.manybody` or `mdnum.md.tetrahedral`.
        cutoff: cutoff of a pair potential; terms and many-body potentials have their own cutoffs.
        timestep: time step in ps or reduced time; omit it if the integrator has a time step.
        units: "metal" (Å, eV, amu, ps, K) or "lj" (reduced).
        temperature: temperature of drawn velocities and of a thermostat.
        friction: friction coefficient of Langevin dynamics, 1/time; default constant energy.
        pressure: pressure of a barostat, in GPa or reduced units.
        integrator: name ("nose-hoover", "csvr", "mtk", "cell-rescaling") or class of another integrator, or
            an integrator object, which has its own numbers, in internal units (time is length * sqrt(mass /
            energy)).
        dynamics: further options of the integrator, by the keys and in the units of a system file.
        seed: random seed of drawn velocities and of a thermostat's noise.
        remove_drift: whether the velocity of the center of mass is removed at the start.
        drawn: whether velocities are drawn; default: only if the atoms have no momenta.
        steps, save_every: last step of a run, and number of steps between frames (0 for no frames).
        skin: skin of the Verlet list, length; default that of the units.
        rebuild: `every`, `delay` and `check` of the list's rebuild rule.
        builder: name of the neighbor search.
        precision: dtype by role.
        reduction: order of the force sums.
        name, about: name and description for people.

    Raises:
        InputError: the structure cannot be simulated, the parameters do not fit its species, the box is too
            small for cutoff and skin, the cutoff is missing or not applicable, or the integrator has a number
            that a system file could not have.
    """
    system = unit_systems.get(units)
    atoms = atoms.copy()
    atoms.calc = None
    if units == "lj" and not atoms.has("masses"):
        atoms.set_array("masses", np.ones(len(atoms)), float, ())
    symbols = species_of(atoms)[0]
    pairwise = isinstance(potential, PairPotential)
    if pairwise != (cutoff is not None):
        message = "has no cutoff" if pairwise else "carries its own cutoff"
        remedy = "Add cutoff=mdnum.Cut(kind, radius)" if pairwise else "Omit the cutoff"
        raise InputError(f"the potential {message}", where=name, remedy=remedy)
    model: Any = potential
    if isinstance(potential, PairPotential) and cutoff is not None:
        model = cut(potential, cutoff.kind, symbols, cutoff.radius, cutoff.onset)
    elif isinstance(potential, Mapping):
        cutoff = common(potential)
        model = Channels.of_terms(
            {
                key: cut(
                    term.potential, term.cutoff.kind, symbols, term.cutoff.radius, term.cutoff.onset,
                    weights(term.weight, atoms, key), where=f"terms.{key}.",
                )
                for key, term in potential.items()
            }
        )  # fmt: skip
    r_cut = float(np.max(model.r_cut))
    skin = DEFAULT_SKIN[units] if skin is None else float(skin)
    check(atoms, r_cut, skin, closest(model, units), system.length)
    optional = {"friction": friction, "pressure": pressure}
    given = {key: one for key, one in optional.items() if one is not None} | dict(dynamics or {})
    if isinstance(integrator, Integrator):
        if also := [*given, *(["timestep"] if timestep is not None else [])]:
            message = f"the integrator is an object, but {', '.join(also)} was given as well"
            raise InputError(message, where=name, remedy="Give only the integrator, or its name and values")
        _check_instance(integrator, system, name)
    else:
        if timestep is None:
            raise InputError("no time step was given", where=name, remedy="Add timestep=...")
        kind = integrator or (VelocityVerlet if friction is None else Langevin)
        numbers = {"timestep": timestep, "temperature": temperature, "seed": seed} | given
        integrator = _integrator(kind, numbers, system, name)
    drawn = not atoms.has("momenta") if drawn is None else drawn
    made = assembled(
        Origin(name, about), atoms, system, model, model.compare if cutoff is None else cutoff.compare,
        RebuildRule(skin, *rebuild), builder, precision, REDUCTIONS.parse(reduction), integrator,
        Draw(float(temperature), seed, remove_drift, drawn), steps, save_every,
    )  # fmt: skip
    if isinstance(model, EnergyFunction) and model.notes is None:
        from mdnum.systems.admission import admitted

        return admitted(made)
    return made


def _integrator(
    kind: str | type[Integrator], numbers: Mapping[str, Any], units: Units, where: str
) -> Integrator:
    """Create an integrator from its name or class. Options of built-in integrators are validated."""
    made = INTEGRATORS[kind] if isinstance(kind, str) else kind
    return made.of_file(_validated(made, numbers, where), units)


def _validated(kind: type[Integrator], numbers: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return an integrator's options, in system-file units. Options of built-in integrators are validated."""
    if kind not in (INTEGRATORS[one] for one in INTEGRATORS.shipped):
        return numbers
    table = {key: one.item() if hasattr(one, "item") else one for key, one in numbers.items()}
    data = {"dynamics": {"kind": kind.name, **table}}
    return checked(DynamicsAlone, data, Source(where, Path(), where)).dynamics.model_dump()


def _check_instance(integrator: Integrator, units: Units, where: str) -> None:
    """Check that the numbers of an integrator are valid in a system file.

    Raises:
        InputError: a number is not a finite float64 scalar, or is out of range.
    """
    keys, numbers = integrator.keys(), {}
    for key in integrator.numbers():
        value = getattr(integrator, keys[key].name)
        if np.shape(value) or getattr(value, "dtype", None) != np.float64 or not np.isfinite(value):
            seen = (
                f"{value!r} in {type(integrator).__name__}; expected a finite number, jax.numpy.float64(...)"
            )
            raise InputError(seen, where=f"dynamics.{key}")
        numbers[key] = integrator.number(key, units)
    if numbers["timestep"] <= 0:
        message = f"a time step of {numbers['timestep']:.6g} {units.time}; expected a number above 0"
        raise InputError(message, where="dynamics.timestep")
    words = {key: getattr(integrator, one.name) for key, one in keys.items() if one.metadata.get("static")}
    _validated(type(integrator), numbers | words, where)


def of_atoms(atoms: Atoms, model: Any, compare: str = "r <", units: str = "metal") -> Simulation:
    """Create a simulation of atoms for single-point evaluations by a calculator, without dynamics."""
    return assembled(
        Origin("calculator"), atoms, unit_systems.get(units), model, compare, RebuildRule(0.0), "auto",
        PrecisionPolicy(), REDUCTIONS.parse("sequential"), VelocityVerlet(jax.device_put(np.float64(1.0))),
        Draw(0.0), 0, 0,
    )  # fmt: skip


def cut(
    potential: PairPotential,
    kind: str,
    symbols: Sequence[str],
    radius: Any,
    onset: Any = None,
    weights: tuple[Any, ...] = (),
    *,
    where: str = "",
) -> CutPotential:
    """Truncate a pair potential at a cutoff radius per pair type. `Cut` describes the arguments.

    Args:
        weights: weights of the atoms, if any. where: prefix of parameter names in messages.
    """

    def table(value: Any, what: str):
        return jax.device_put(by_type(value, symbols, f"{where}{what}"))

    cutoff, r_cut = CUTOFFS.parse(kind), table(radius, "cutoff.radius")
    r_onset = r_cut
    if cutoff.switches:
        r_onset = ONSET_FRACTION * r_cut if onset is None else table(onset, "cutoff.onset")
    leaves = {key: table(value, f"potential.{key}") for key, value in potential.leaves.items()}
    leaves |= {
        key: jax.device_put(by_species(value, symbols, f"{where}potential.{key}"))
        for key, value in dict(potential.by_species).items()
    }
    tree = jax.tree.map(
        lambda one: np.array(one) if _is_array(one) else one, potential.shared, is_leaf=_is_array
    )
    shared = (_finite(leaf, f"{where}potential.{path}") for path, leaf in leaves_by_path(tree).items())
    leaves |= jax.device_put(dict(jax.tree.unflatten(jax.tree.structure(tree), shared)))
    potential = potential.with_leaves(leaves)
    if isinstance(potential, PairFunction):
        _check_function(potential, np.asarray(r_cut), symbols)
    return CutPotential(potential, cutoff, r_cut, r_onset, weights)


def _check_function(potential: PairFunction, r_cut: np.ndarray, symbols: Sequence[str]) -> None:
    """Check a user's pair function: callable, not truncated, symmetric in both atoms."""
    here = potential.typed
    is_pair = lambda leaf: isinstance(leaf, tuple)  # noqa: E731
    other = here.with_leaves(
        jax.tree.map(lambda leaf: leaf[::-1] if is_pair(leaf) else leaf, dict(here.leaves), is_leaf=is_pair)
    )
    r = r_cut * np.append(np.linspace(0.3, 1, 15), 1 - _INSIDE)[:, None]
    try:
        u, swapped = np.asarray(jax.jit(lambda r2: [one.evaluate(r2)[0] for one in (here, other)])(r * r))
        wrong = "" if u.shape == r.shape else f"it returns shape {u.shape} for distances of shape {r.shape}"
    except (TypeError, ValueError) as error:
        wrong = f"it takes no array of distances: {in_a_line(error)}"
    if wrong:
        remedy = "Use jax.numpy, not numpy or math, jnp.where, not if; return one energy for each distance"
        raise InputError(wrong, where=potential.name, remedy=remedy)
    scale = np.max(np.abs(u), initial=0, where=np.isfinite(u))
    pairs_of = pair_names(symbols)
    if not (ends := np.abs(u[-1] - u[-2]) <= _STEEP * _INSIDE * np.max(np.abs(u[-4:]), axis=0)).all():
        kind = int(np.argmin(ends))
        raise InputError(
            f"the pair energy of {pairs_of[kind]} jumps from {u[-1, kind]:.6g} to {u[-2, kind]:.6g} at the "
            f"cutoff {r_cut[kind]:g}; expected an energy that is smooth across the cutoff",
            where=potential.name,
            remedy="Remove the truncation from the function; mdnum truncates the energy at the cutoff",
        )
    differs = ~np.isclose(u, swapped, rtol=_SYMMETRIC, atol=_SYMMETRIC * scale, equal_nan=True)
    if differs.any():
        k, kind = np.unravel_index(np.argmax(differs), u.shape)
        first, second = pairs_of[kind].split("-")
        raise InputError(
            f"at distance {r[k, kind]:.6g}, the pair energy of {first}-{second} is {u[k, kind]:.12g}, but "
            f"that of {second}-{first} is {swapped[k, kind]:.12g}; expected equal energies",
            where=potential.name,
            remedy="Combine the parameters of the two species symmetrically, for example as (a + b) / 2",
        )


def common(terms: Mapping[str, Term]) -> Cut:
    """Return the cutoff of the first term. All terms must have the same comparison (such as r < r_cut).

    Raises:
        InputError: there are no terms, or the terms have different comparisons.
    """
    compared = {name: term.cutoff.compare for name, term in terms.items()}
    if len(set(compared.values())) != 1:
        seen = ", ".join(f"{name} {compare!r}" for name, compare in compared.items()) or "no term"
        message = f"all terms must use the same comparison; found {seen}"
        raise InputError(message, where="cutoff.compare", remedy="Set the same cutoff.compare in all terms")
    return next(iter(terms.values())).cutoff


def weights(weight: Any, atoms: Atoms, term: str) -> tuple[Any, ...]:
    """Return the weight of each atom for `CutPotential`. Empty if the term has no weights.

    Raises:
        InputError: a species or an atom has no weight.
    """
    if weight is None:
        return ()
    what = f"terms.{term}.weight"
    symbols = atoms.get_chemical_symbols()
    if isinstance(weight, Mapping):
        weight = by_species(weight, symbols, what)
    numbers = np.array(weight, np.float64)
    if numbers.shape != (len(atoms),) or not np.isfinite(numbers).all():
        seen = f"an array of shape {numbers.shape}"
        raise InputError(f"{seen}; expected a finite number for each of {len(atoms)} atoms", where=what)
    return (jax.device_put(numbers),)


def closest(model: Any, units: str) -> float:
    """Return the smallest allowed distance (a length) between two atoms of a structure."""
    if not isinstance(model, CutPotential | Channels):
        return smallest_distance(model.name, units)
    each = [term.potential for term in model.terms.values()]
    sigmas = [np.asarray(one.leaves.get("sigma", ())).tolist() for one in each]
    return max(smallest_distance(one.name, units, own) for one, own in zip(each, sigmas, strict=True))


def _is_array(value: Any) -> bool:
    """Return True if a list is an array: numbers, or lists of numbers of equal length."""
    numbers = all(isinstance(leaf, int | float) for leaf in jax.tree.leaves(value))
    try:
        return type(value) in (list, tuple) and numbers and np.array(value).dtype.kind in "iuf"
    except ValueError:
        return False


def by_type(value: Any, symbols: Sequence[str], what: str) -> Float[np.ndarray, "types"]:
    """Return one number per pair type, from one number or one per pair of species.

    Raises:
        InputError: the number of a pair is missing or not finite.
    """
    names = pair_names(symbols)
    if isinstance(value, Mapping):
        given = {}
        for key, number in value.items():
            if given.setdefault(pair_key(*key.split("-")), number) != number:
                message = f"{key} is given in both orders, with different numbers"
                raise InputError(message, where=what, remedy="Give one number for each pair")
        missing = [one for one in names if pair_key(*one.split("-")) not in given]
        if missing:
            remedy = "Give a number for every pair of species, or one number for all pairs"
            raise InputError(f"no value was given for {', '.join(missing)}", where=what, remedy=remedy)
        value = [given[pair_key(*one.split("-"))] for one in names]
    return np.broadcast_to(_finite(value, what), (len(names),)).copy()


def by_species(value: Mapping[str, Any], symbols: Sequence[str], what: str) -> Float[np.ndarray, "species"]:
    """Return one number per species, in the order of the symbols.

    Raises:
        InputError: the number of a species is missing or not finite.
    """
    if missing := [symbol for symbol in symbols if symbol not in value]:
        remedy = "Give a number for every species"
        raise InputError(f"no value was given for {', '.join(missing)}", where=what, remedy=remedy)
    return _finite([value[symbol] for symbol in symbols], what)


def _finite(value: Any, what: str) -> Float[np.ndarray, "..."]:
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise InputError(f"{value!r}; expected finite numbers", where=what)
    return numbers


def assembled(
    origin: Origin,
    atoms: Atoms,
    units: Units,
    model: CutPotential | Any,
    compare: str,
    rule: RebuildRule,
    builder: str,
    policy: PrecisionPolicy,
    reduction: Any,
    integrator: Integrator,
    draw: Draw,
    steps: int,
    save_every: int,
) -> Simulation:
    """Create a simulation from components; `Simulation` describes the arguments not listed here.

    Args:
        atoms: the structure, with momenta unless velocities are drawn.
        compare: comparison that defines the inside of a cutoff.
        builder: name of the neighbor search; "auto" for the fastest one on this device.

    Raises:
        InputError: the box is too small for cutoff and skin, or a fixed-point state is not possible.
    """
    check_not_forked()
    cell = Cell.create(np.asarray(atoms.cell), atoms.pbc)
    positions = np.asarray(atoms.positions, np.float64)
    masses = np.asarray(atoms.get_masses(), np.float64)
    symbols, species = species_of(atoms)
    pairwise = isinstance(model, CutPotential | Channels)
    if not pairwise:
        # its energy function takes lattice vectors off along these axes
        model = replace(model, pbc=cell.pbc)
    radii = tuple(float(r) for r in np.asarray(model.r_cut)) if pairwise else (float(model.r_cut),)
    decider = PairDecider(radii, compare, policy.decision, cell.reach(positions), policy.state)
    check_radius(cell, max(radii), rule.skin)
    if builder == "auto":
        # a search on the host wins on a CPU; on an accelerator the positions would have to travel
        builder = "host" if jax.default_backend() == "cpu" else "device"
    integrator.check(cell)
    if integrator.moves_cell and not pairwise and getattr(model, "fixed_box", False):
        message = f"{origin.name} has a potential with a fixed box, but {integrator.name} changes the box"
        remedy = "Let the potential take the argument box= (jax_md.space.periodic_general)"
        raise InputError(message, where="dynamics.kind", remedy=remedy)
    velocities = draw.velocities(masses, units, None if draw.drawn else atoms.get_velocities())
    made = Simulation(
        origin, atoms, units, symbols, cell, positions, velocities, masses, species, model, decider, rule,
        builder, policy, reduction, integrator, draw, steps, save_every,
    )  # fmt: skip
    made = in_fixed_point(made) if policy.state == FIXED_POINT else made
    if origin.system is None:
        return made
    # from now on another part is a change
    parts = {one.name: getattr(made, one.name) for one in fields(made) if one.name != "origin"}
    return replace(made, origin=replace(made.origin, parts=parts))


def with_atoms(simulation: Simulation, atoms: Atoms, skin: float) -> Simulation:
    """Create a simulation of other atoms of the same species. Potential and settings stay the same.

    Args:
        skin: skin of the Verlet list, length.

    Raises:
        InputError: the atoms contain another species, or the box is too small.
    """
    symbols, old = species_of(atoms)[0], simulation.symbols
    if unknown := [one for one in symbols if one not in old]:
        raise InputError(
            f"the potential has no parameters for {', '.join(unknown)}, only for {', '.join(old)}",
            where=simulation.name,
            remedy="Give a potential with parameters for all species of the structure",
        )
    model = simulation.model
    if simulation.pairwise:
        places = np.array([old.index(one) for one in symbols])
        first, second = np.triu_indices(len(places))
        kinds = jax.device_put(pair_type(places[first], places[second], len(old)))

        def of_kinds(one: CutPotential) -> CutPotential:
            leaves = {key: leaf[kinds] for key, leaf in one.potential.leaves.items()}
            leaves |= {key: leaf[places] for key, leaf in dict(one.potential.by_species).items()}
            ends = one.r_cut[kinds], one.r_onset[kinds]
            return CutPotential(one.potential.with_leaves(leaves), one.cutoff, *ends, one.weights)

        model = each_term(model, of_kinds)
        if model.weights and not np.array_equal(atoms.numbers, simulation.structure.numbers):
            remedy = "Give atoms of the same species in the same order"
            message = "the potential has weights of single atoms, but the species of these atoms differ"
            raise InputError(message, where=simulation.name, remedy=remedy)
    return assembled(
        Origin(simulation.name, simulation.origin.about), atoms, simulation.units, model,
        simulation.decider.compare, replace(simulation.rule, skin=skin), simulation.builder,
        simulation.policy, simulation.reduction, simulation.integrator,
        replace(simulation.draw, drawn=not atoms.has("momenta")), simulation.steps, simulation.save_every,
    )  # fmt: skip


def in_fixed_point(simulation: Simulation) -> Simulation:
    """Return the simulation in fixed-point numbers. Box edges are rounded to the spacing of positions."""
    masses, policy, units = simulation.masses, simulation.policy, simulation.units
    if (policy.force, policy.decision, policy.accumulate) != ("float64",) * 3:
        raise InputError(
            'with state = "lattice", forces are always computed in float64, and decisions and sums in '
            "fixed-point arithmetic",
            where="precision",
            remedy="Omit the keys `force`, `decision` and `accumulate` of the table [precision]",
        )
    kT = units.k_B * simulation.draw.temperature
    own = masses * np.linalg.norm(simulation.velocities, axis=1)
    fixed_point = FixedPointUnits.create(
        simulation.cell,
        simulation.r_cut + simulation.rule.skin,
        simulation.model,
        np.maximum(np.sqrt(masses * kT), own / 4),
        kT,
        float(simulation.integrator.timestep),
    )
    cell, old = fixed_point.cell(simulation.cell), simulation.decider
    atoms, origin = simulation.structure.copy(), simulation.origin
    atoms.set_cell(np.asarray(cell.matrix))
    if origin.system is not None:
        origin = replace(origin, system=replace(origin.system, atoms=atoms))
    made = replace(
        simulation,
        origin=origin,
        structure=atoms,
        cell=cell,
        decider=FixedPointDecider(
            old.r_cut, old.compare, "float64", cell.reach(simulation.positions), spacing=fixed_point.spacing
        ),
        fixed_point=fixed_point,
    )
    # made here, so that a friction that no fixed-point step can have is refused before the run
    assert made.propagator is not None
    return made
