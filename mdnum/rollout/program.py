"""Molecular dynamics as a `Program`: run side by side, under imposed decisions, nudged and varied."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt64

from mdnum.errors import InputError
from mdnum.md.cell import HostCell
from mdnum.md.neighbors import check_radius
from mdnum.program import Decision, DecisionHistory, Differing, Number, PairRows
from mdnum.registry import nearest
from mdnum.rollout.compared import Apart, CrossFlip, ReferenceFrame
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state, unwrapped
from mdnum.rollout.flips import decided_pairs, fingerprint_of_bits
from mdnum.rollout.lockstep import Counterfactual, apart, lockstep
from mdnum.rollout.tracks import Handed, Track
from mdnum.systems.build import Simulation

#: A loss of the final state: of the simulation, unwrapped positions and velocities per internal time.
Loss = Callable[[Simulation, Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]], float]


def squared_displacement(simulation: Simulation, x: np.ndarray, v: np.ndarray) -> float:
    """Mean squared displacement from the start, length squared: the loss unless another is asked for."""
    return float(np.mean(np.sum((x - simulation.positions) ** 2, axis=1)))


@dataclass(frozen=True)
class MdProgram:
    """A simulation, where it begins, and how its atoms and axes are those that it is compared in."""

    simulation: Simulation  # the system as objects
    begin: Start | None = None  # its start; None for the system's own
    # how its labels and axes are those of the other program; None where they are the same
    frame: ReferenceFrame | None = None

    @property
    def size(self) -> int:
        """Number of atoms."""
        return self.simulation.atoms

    @property
    def steps(self) -> int:
        """That the system's own run makes."""
        return self.simulation.system.spec.dynamics.steps

    @property
    def timestep(self) -> float:
        """In the user's unit of time."""
        return float(self.simulation.system.spec.dynamics.timestep)

    @property
    def scale(self) -> float:
        """The longest cutoff."""
        return self.simulation.r_cut

    @property
    def ulp(self) -> float:
        """Of the largest coordinate of the start."""
        x = np.asarray(self.start.state.x)
        return float(np.spacing(np.abs(x).max().astype(x.dtype)))

    @property
    def streams(self) -> bool:
        """A run may go on for as long as a verdict needs."""
        return True

    @property
    def imposable(self) -> str | None:
        """Only pair potentials act on decisions that they are given."""
        if self.simulation.pairwise:
            return None
        return "a many-body potential decides inside its energy function"

    @cached_property
    def start(self) -> Start:
        """Where it begins."""
        return self.begin or first_state(self.simulation)

    def check(self, other: MdProgram) -> None:
        """Check that both have the same number of atoms.

        Raises:
            InputError: they do not.
        """
        if self.size != other.size:
            raise InputError(
                f"the runs have {self.size} and {other.size} atoms", remedy="Compare runs of one structure"
            )

    def lockstep(
        self, other: MdProgram, last: int, *, forward: bool, back: bool, guard: float | None
    ) -> Iterator[PairRows]:
        """Both runs, and counterfactuals, a stretch at a time (see `Program.lockstep`)."""
        return lockstep(
            self.simulation,
            other.simulation,
            last,
            start_a=self.begin,
            start_b=other.begin,
            frame=other.frame,
            handed=forward,
            back=back,
            guard=guard,
        )

    def repeats(
        self, others: Sequence[MdProgram], last: int, tolerance: float, guard: float
    ) -> list[tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]]:
        """Separations of perturbed runs, all beside one run of this program (see `Program.repeats`)."""
        a = self.simulation
        frame = others[0].frame or ReferenceFrame.same(a.atoms)
        imposed = [Counterfactual(Handed(b.simulation, a, b.begin, frame), guard) for b in others]

        def listen(segment: Segment) -> None:
            for run in imposed:
                run(segment)

        leader = Track(a, last, self.begin, flips=False, listener=listen)
        free = [Track(b.simulation, last, b.begin, frame, flips=False) for b in others]
        cell = Apart(a.cell)
        parts: list[tuple[list[np.ndarray], list[np.ndarray]]] = [([], []) for _ in others]
        while leader.segment() is not None:
            end = leader.ready
            rows, _ = leader.until(end)
            for (own, under), run, counterfactual in zip(parts, free, imposed, strict=True):
                own.append(apart(cell, rows, run.until(end)[0]))
                under.append(apart(cell, rows, counterfactual.until(end)[0]))
            if all(any((rows > tolerance).any() for rows in each) for pair in parts for each in pair):
                break
        return [(np.concatenate(own), np.concatenate(under)) for own, under in parts]

    def nudged(self, size: float, count: int, seed: int) -> list[MdProgram]:
        """The program with its atoms displaced at random, the furthest by about `size`.

        By an ulp at least: a smaller displacement would be lost in the first addition.
        """
        rng = np.random.default_rng(seed)
        x, ulp = np.asarray(self.start.state.x), self.ulp
        programs = []
        for _ in range(count):
            noise = rng.standard_normal(x.shape)
            noise *= max(size, ulp) / np.sqrt((noise**2).sum(axis=0)).max()
            moved = (x.astype(np.float64) + noise).astype(x.dtype)
            here = jnp.asarray(moved)
            start = replace(self.start, state=self.start.state._replace(x=here, x_before=here), home=here)
            programs.append(replace(self, begin=start))
        return programs

    def decision(self, other: MdProgram, flips: Sequence[CrossFlip], separation: float) -> Decision:
        """The decision at a fork: of the pairs that differ there, the one nearest to its cutoff."""
        differing = [flip for flip in flips if flip.differs]
        flip = min(differing, key=lambda flip: abs(flip.margin) if np.isfinite(flip.margin) else np.inf)
        if np.isfinite(flip.margin):
            run, entered, margin, bound = flip.run, flip.entered, flip.margin, flip.bound
            inside = entered == (run == "A")
        else:
            # no flip came before it: the margin is that of A's start
            x = np.asarray(self.start.state.x).T
            run, entered = "start", flip.entered
            margin = pair_margin(self.simulation, x, flip.i, flip.j)
            bound, inside = pair_bound(self.simulation, x, flip.i, flip.j), margin > 0
        owner = "A" if run == "start" else run
        return Decision(
            channel="pair",
            step=flip.step,
            subject=(flip.i, flip.j),
            run=run,
            entered=entered,
            a=int(inside),
            b=int(not inside),
            margins={owner: margin},
            bounds={owner: bound},
            separation=separation,
            also=len(differing) - 1,
        )

    def number(self, key: str) -> Number:
        """A number of the system, as `dial` names them."""
        found = dial(self.simulation, key)

        def at(value: float) -> MdProgram:
            return replace(self, simulation=found.turn(self.simulation, value))

        return Number(found.key, found.value, unit(self.simulation, found.key), at, found.positive)

    def history(self, steps: int, loss: Loss | None = None) -> DecisionHistory:
        """What a run decides (see `Program.history`); the loss is the squared displacement by default."""
        marks, segment = [], None
        for segment in Engine(self.simulation, steps, start=self.begin).segments():
            marks.append(marks_of(segment))
        assert segment is not None
        row = segment.rows - 1
        x, images, v = (segment.unsorted(name, row) for name in ("x", "images", "v"))
        x = unwrapped(np.asarray(self.simulation.cell.matrix), x, images)
        every = np.concatenate(marks)
        failed = segment.closes if segment.closes in FAILURES else ""
        # a run that failed has no last step for a loss to be of
        value = energy = float("nan")
        if not failed:
            value = float((loss or squared_displacement)(self.simulation, x, v.astype(np.float64)))
            energy = float(segment.rows_of("potential")[row] + segment.rows_of("kinetic")[row])
        digest = hashlib.blake2b(every.tobytes() + failed.encode(), digest_size=16).hexdigest()
        return DecisionHistory(every, digest, x, value, energy, failed)

    def differing(self, other: MdProgram, steps: int, step: int, key: str = "") -> Differing:
        """The pairs that differ at a step, the one nearest to its cutoff in both programs."""
        sides = [one._pairs_at(steps, step) for one in (self, other)]
        keys = np.setxor1d(sides[0][0], sides[1][0], assume_unique=True)
        pairs = [divmod(int(key), self.size) for key in keys]
        margins = [
            [pair_margin(one.simulation, x, i, j) for one, (_, x) in zip((self, other), sides, strict=True)]
            for i, j in pairs
        ]
        place = min(range(len(pairs)), key=lambda k: max(abs(margin) for margin in margins[k]))
        inside = [bool(np.isin(keys[place], held)) for held, _ in sides]
        bounds = [
            pair_bound(one.simulation, x, *pairs[place])
            for one, (_, x) in zip((self, other), sides, strict=True)
        ]
        return Differing(
            Decision(
                channel="pair",
                step=step,
                subject=pairs[place],
                run="A" if inside[0] else "B",
                entered=True,
                a=int(inside[0]),
                b=int(inside[1]),
                margins=dict(zip("AB", margins[place], strict=True)),
                bounds=dict(zip("AB", bounds, strict=True)),
                separation=float("nan"),
                also=len(pairs) - 1,
            )
        )

    def _pairs_at(self, steps: int, step: int) -> tuple[Int[np.ndarray, "inside"], np.ndarray]:
        """Keys of the pairs inside at a step, and the positions; by the program that makes all the steps."""
        for segment in Engine(self.simulation, steps, start=self.begin).segments():
            if segment.last >= step:
                row = step - segment.first
                return decided_pairs(self.simulation, segment, row), segment.unsorted("x", row)
        raise IndexError(f"the run has no step {step}")

    def positions_at(self, step: int, last: int) -> Float[np.ndarray, "atoms 3"] | None:
        """Wrapped positions at a step of a run to a last step, in the frame; None where it ended before."""
        track = Track(self.simulation, last, self.begin, self.frame, flips=False)
        while track.segment() is not None:
            rows, _ = track.until(track.ready)
            if rows is not None and rows.first + len(rows) > step:
                return np.ascontiguousarray(rows.x[step - rows.first].T)
        return None


def marks_of(segment: Segment) -> UInt64[np.ndarray, "rows"]:
    """The marks of the steps of a segment: hashes of the pairs inside, whatever their order and list."""
    table = segment.table
    rows = segment.rows_of("bits")
    return np.array([fingerprint_of_bits(bits, table.index, table.order)[1] for bits in rows], np.uint64)


def pair_margin(
    simulation: Simulation, x: Float[np.ndarray, "atoms 3"], i: int, j: int, labels: Simulation | None = None
) -> float:
    """Threshold minus quantity of a pair, with the bits that the program decides by.

    Args:
        x: wrapped positions.
        labels: whose labels i and j are; default the simulation's own.
    """
    decider = simulation.decider
    kind = int((labels or simulation).type_of(np.array([i]), np.array([j]))[0])
    d = HostCell(simulation.cell, decider.dtype).displacement(x[[i]], x[[j]])
    return decider.thresholds[kind].value - float(decider.host_quantity(*d)[0])


def pair_bound(simulation: Simulation, x: Float[np.ndarray, "atoms 3"], i: int, j: int) -> float:
    """Bound on the rounding error of the margin of a pair at these positions."""
    kind = int(simulation.type_of(np.array([i]), np.array([j]))[0])
    return float(simulation.decider.bounds_at(x.T[None])[0, kind])


# --- numbers of a system that can be turned without compiling anew: arguments of the compiled epochs -----

Turn = Callable[[Simulation, float], Simulation]
_SHORT = {
    "timestep": "dynamics.timestep",
    "temperature": "dynamics.temperature",
    "friction": "dynamics.friction",
    "radius": "cutoff.radius",
    "r_cut": "cutoff.radius",
    "onset": "cutoff.onset",
    "dt": "dynamics.timestep",
}


@dataclass(frozen=True)
class Dial:
    """One number of a system."""

    key: str  # its name, as system files have it where they do
    value: float  # what the system says, in the units of its file
    turn: Turn  # the simulation with another value, without compiling anew
    positive: bool = True  # whether only values above 0 make sense


def dial(simulation: Simulation, key: str) -> Dial:
    """The number that a key names.

    Args:
        simulation: the system as objects.
        key: "dynamics.timestep", "potential.sigma" ("potential.pairs.Ni-P.sigma" for one pair of species),
            "cutoff.radius", "cutoff.onset", "neighbors.skin", "position.17.x", "velocity.17.x",
            "velocity.scale"; of Langevin dynamics also "dynamics.temperature" and "dynamics.friction". The
            last word alone will do where only one number ends so.

    Raises:
        InputError: no such number, or several; the known ones are listed.
    """
    dials = _fixed(simulation)
    word = _SHORT.get(key, key)
    found = [word] if word in dials else [name for name in dials if name.endswith(f".{word}")]
    if len(found) == 1:
        return dials[found[0]]
    if found:
        raise InputError(f"{key!r} could be any of {', '.join(found)}", remedy="Write one of them in full")
    started = _start(simulation, key)
    if started is not None:
        return started
    known = [*dials, "position.ATOM.x", "velocity.ATOM.x"]
    ends = {name.rpartition(".")[2]: name for name in dials}
    meant = nearest(key, [*known, *ends])
    hint = "" if meant is None else f"Did you mean {ends.get(meant, meant)}? "
    raise InputError(
        f"{key!r} is no number that can be turned", remedy=f"{hint}Use one of: {', '.join(known)}"
    )


def unit(simulation: Simulation, key: str) -> str:
    """The unit of a number in the user's words; empty for a pure number and where it is not known."""
    units, last = simulation.units, key.rpartition(".")[2]
    if key.startswith("velocity.") and last != "scale":
        return f"{units.length}/{units.time}"
    if key.startswith(("position.", "cutoff.")) or last in ("sigma", "skin"):
        return units.length
    named = {
        "timestep": units.time,
        "friction": f"1/{units.time}",
        "temperature": units.temperature,
        "epsilon": units.energy,
    }
    return named.get(last, "")


def names(simulation: Simulation) -> tuple[str, ...]:
    """The keys of a system, those of single coordinates aside."""
    return tuple(_fixed(simulation))


def _fixed(simulation: Simulation) -> dict[str, Dial]:
    integrator, units = simulation.integrator, simulation.units
    # velocities that are drawn are drawn at the temperature: then it is more than one number
    drawn = simulation.system.velocities is None
    keys = [key for key in integrator.numbers() if not (drawn and key == "temperature")]
    first, *others = [
        Dial(f"dynamics.{key}", integrator.number(key, units), _integrator(key)) for key in keys
    ]
    dials = [
        first,
        Dial("velocity.scale", 1.0, _scaled),
        Dial("neighbors.skin", simulation.rule.skin, _skin),
        *others,
    ]
    if simulation.pairwise:
        dials += _constants(simulation) + _radii(simulation)
    return {one.key: one for one in dials}


def _integrator(key: str) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        changed = simulation.integrator.with_number(key, value, simulation.units)
        return replace(simulation, integrator=changed)

    return turn


def _skin(simulation: Simulation, value: float) -> Simulation:
    """Another skin: another list, hence another order of the same sums from the first rebuild on."""
    check_radius(simulation.cell, simulation.r_cut, value)
    return replace(simulation, rule=replace(simulation.rule, skin=value))


def _scaled(simulation: Simulation, value: float) -> Simulation:
    return replace(simulation, velocities=simulation.velocities * value)


def _constants(simulation: Simulation) -> list[Dial]:
    """Constants of the potential: one for each, or one for each and pair of species."""
    spec, species = simulation.system.spec, simulation.system.species
    in_sigma = spec.cutoff is not None and getattr(spec.cutoff, "in_sigma", None) is not None
    dials = []
    for name in vars(simulation.potential):
        if name == "sigma" and in_sigma:
            # the radius would move along
            continue
        leaf = np.asarray(getattr(simulation.potential, name))
        for kind, (i, j) in enumerate(zip(*np.triu_indices(len(species)), strict=True)):
            pair = "" if len(leaf) == 1 else f"pairs.{species[i]}-{species[j]}."
            value = float(leaf[kind])
            dials.append(Dial(f"potential.{pair}{name}", value, _constant(name, kind), value > 0))
    return dials


def _constant(name: str, kind: int) -> Turn:
    def turn(simulation: Simulation, value: float) -> Simulation:
        leaf = np.array(getattr(simulation.potential, name), np.float64)
        leaf[kind] = value
        model = eqx.tree_at(lambda m: getattr(m.potential, name), simulation.model, jnp.asarray(leaf))
        return replace(simulation, model=model)

    return turn


def _radii(simulation: Simulation) -> list[Dial]:
    radii = simulation.decider.r_cut
    if len(set(radii)) > 1:
        return []
    dials = [Dial("cutoff.radius", radii[0], _radius)]
    if simulation.cutoff.switches:
        dials.append(Dial("cutoff.onset", float(np.asarray(simulation.model.r_onset)[0]), _onset))
    return dials


def _onset(simulation: Simulation, value: float) -> Simulation:
    if value >= simulation.r_cut:
        raise InputError(f"an onset of {value!r} is not below the cutoff radius {simulation.r_cut!r}")
    leaf = jnp.full_like(simulation.model.r_onset, np.float64(value))
    return replace(simulation, model=eqx.tree_at(lambda m: m.r_onset, simulation.model, leaf))


def _radius(simulation: Simulation, value: float) -> Simulation:
    """Another cutoff radius; the onset of switching stays where it is."""
    check_radius(simulation.cell, value, simulation.rule.skin)
    model = simulation.model
    if simulation.cutoff.switches and value <= float(np.max(model.r_onset)):
        onset = float(np.max(model.r_onset))
        raise InputError(f"a cutoff radius of {value!r} is not above its onset, {onset!r}")
    leaf = jnp.full_like(model.r_cut, np.float64(value))
    model = eqx.tree_at(lambda m: m.r_cut, model, leaf)
    if not simulation.cutoff.switches:
        model = eqx.tree_at(lambda m: m.r_onset, model, leaf)
    decider = replace(simulation.decider, r_cut=(float(value),) * len(simulation.decider.r_cut))
    return replace(simulation, model=model, decider=decider)


def _start(simulation: Simulation, key: str) -> Dial | None:
    parts = key.split(".")
    if len(parts) != 3 or parts[0] not in ("position", "velocity") or parts[2] not in ("x", "y", "z"):
        return None
    if not parts[1].isdigit() or int(parts[1]) >= simulation.atoms:
        raise InputError(
            f"{key!r}: there is no atom {parts[1]}", remedy=f"Use an atom from 0 to {simulation.atoms - 1}"
        )
    place = int(parts[1]), "xyz".index(parts[2])
    name, factor = (
        ("positions", 1.0) if parts[0] == "position" else ("velocities", simulation.units.time_factor)
    )

    def turn(simulation: Simulation, value: float) -> Simulation:
        array = getattr(simulation, name).copy()
        array[place] = value / factor
        return replace(simulation, **{name: array})

    return Dial(key, float(getattr(simulation, name)[place]) * factor, turn, positive=False)
