"""Molecular-dynamics simulation with the interface `Program`, by which two runs are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.md.cell import HostCell
from mdnum.program import Decision, DecisionHistory, Differing, Number, PairRows
from mdnum.rollout.compared import CrossFlip, ReferenceFrame
from mdnum.rollout.counterfactual import Counterfactual
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state, unwrapped
from mdnum.rollout.flips import decided_pairs, fingerprint_of_bits
from mdnum.rollout.lockstep import beside, lockstep
from mdnum.rollout.tracks import Track
from mdnum.systems import parameters
from mdnum.systems.simulation import Simulation

#: Loss of the final state: a function of the simulation, unwrapped positions, and velocities per internal
#: time.
Loss = Callable[[Simulation, Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]], float]


def squared_displacement(simulation: Simulation, x: np.ndarray, v: np.ndarray) -> float:
    """Return the mean squared displacement (length²) from the start, the default loss."""
    return float(np.mean(np.sum((x - simulation.positions) ** 2, axis=1)))


@dataclass(frozen=True)
class MdProgram:
    """A simulation with an initial state. `frame` maps atoms and axes to another simulation."""

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
        """Number of steps that the system specifies for a run."""
        return self.simulation.steps

    @property
    def timestep(self) -> float:
        """Time step in the user's unit of time."""
        return self.simulation.timestep

    @property
    def scale(self) -> float:
        """Longest cutoff radius, the length scale of the system."""
        return self.simulation.r_cut

    @property
    def ulp(self) -> float:
        """Unit in the last place (ulp) of the largest initial coordinate (length)."""
        x = np.asarray(self.start.state.x)
        return float(np.spacing(np.abs(x).max().astype(x.dtype)))

    @property
    def streams(self) -> bool:
        """Whether runs can be continued: always True."""
        return True

    @property
    def imposable(self) -> str | None:
        """Reason why decisions cannot be imposed on this simulation, or None."""
        if self.simulation.imposable:
            return None
        return "a many-body potential decides inside its energy function"

    @cached_property
    def start(self) -> Start:
        """Initial state of the simulation."""
        return self.begin or first_state(self.simulation)

    def check(self, other: MdProgram) -> None:
        """Raise an error if two simulations have different numbers of atoms.

        Raises:
            InputError: the numbers of atoms differ.
        """
        if self.size != other.size:
            raise InputError(
                f"the two runs have {self.size} and {other.size} atoms; expected the same number",
                remedy="Compare two runs of the same structure",
            )

    def lockstep(
        self, other: MdProgram, last: int, *, forward: bool, back: bool, guard: float | None
    ) -> Iterator[PairRows]:
        """Advance two runs and their counterfactual runs by segments (see `Program.lockstep`)."""
        a, b = self.simulation, other.simulation
        frame, imposed = other.frame or ReferenceFrame.same(a.atoms), {}
        if forward:
            imposed["B|A"] = Counterfactual(b, a, other.begin, frame, guard)
        if back:
            imposed["A|B"] = Counterfactual(a, b, self.begin, frame.inverse, guard)
        leader = Track(a, last, self.begin, listener=imposed.get("B|A"))
        return lockstep(leader, Track(b, last, other.begin, frame, listener=imposed.get("A|B")), imposed)

    def repeats(
        self, others: Sequence[MdProgram], last: int, tolerance: float, guard: float
    ) -> list[tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]]:
        """Return distances between one run and runs with perturbed initial states (see `Program.repeats`)."""
        a = self.simulation
        frame = others[0].frame or ReferenceFrame.same(a.atoms)
        imposed = [Counterfactual(b.simulation, a, b.begin, frame, guard) for b in others]

        def listen(segment: Segment) -> None:
            for run in imposed:
                run(segment)

        leader = Track(a, last, self.begin, flips=False, listener=listen)
        free = [Track(b.simulation, last, b.begin, frame, flips=False) for b in others]
        parts: list[list[np.ndarray]] = []
        for stretch in beside(leader, [*free, *imposed]):
            parts.append(stretch)
            if all(any((rows > tolerance).any() for rows in run) for run in zip(*parts, strict=True)):
                break
        whole = [np.concatenate(run) for run in zip(*parts, strict=True)]
        return list(zip(whole[: len(free)], whole[len(free) :], strict=True))

    def nudged(self, size: float, count: int, seed: int) -> list[MdProgram]:
        """Return randomly displaced copies of the simulation. The largest displacement is about `size`.

        The largest displacement is at least one ulp of a coordinate.
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
        """Return the differing cutoff decision of the pair nearest to the cutoff."""
        differing = [flip for flip in flips if flip.differs]
        flip = min(differing, key=lambda flip: abs(flip.margin) if np.isfinite(flip.margin) else np.inf)
        if np.isfinite(flip.margin):
            run, entered, margin, bound = flip.run, flip.entered, flip.margin, flip.bound
            inside = entered == (run == "A")
        else:
            # no flip came before it: the margin is that of A's start
            x, here = np.asarray(self.start.state.x).T, self.simulation.in_row(self.start.state.cells[0])
            run, entered = "start", flip.entered
            margin = pair_margin(here, x, flip.i, flip.j)
            bound, inside = pair_bound(here, x, flip.i, flip.j), margin > 0
        owner = "A" if run == "start" else run
        return Decision(
            channel="pair", step=flip.step, subject=(flip.i, flip.j), run=run, entered=entered,
            a=int(inside), b=int(not inside), margins={owner: margin}, bounds={owner: bound},
            separation=separation, also=len(differing) - 1,
        )  # fmt: skip

    def number(self, key: str) -> Number:
        """Return the numerical parameter at a path (such as "cutoff.radius")."""
        simulation = self.simulation
        name = parameters.resolve(simulation, key, parameters.numbers(simulation))

        def at(value: float) -> MdProgram:
            return replace(self, simulation=parameters.with_number(simulation, name, value))

        here, unit = parameters.number(simulation, name), parameters.unit(simulation, name)
        return Number(name, here, unit, at, parameters.is_positive(simulation, name))

    def history(self, steps: int, loss: Loss | None = None) -> DecisionHistory:
        """Return the loss and all decisions of a run."""
        marks: list[np.uint64] = []
        segment = None
        for segment in Engine(self.simulation, steps, start=self.begin).segments():
            # hashes of the pairs inside at each step, independent of order and neighbor list
            table, rows = segment.table, segment.rows_of("bits")
            marks += [fingerprint_of_bits(bits, table.index, table.order)[1] for bits in rows]
        assert segment is not None
        row = segment.rows - 1
        x, images, v = (segment.unsorted(name, row) for name in ("x", "images", "v"))
        x = unwrapped(np.asarray(segment.cell_of(row).matrix), x, images)
        every = np.array(marks, np.uint64)
        failed = segment.closes if segment.closes in FAILURES else ""
        # a run that failed has no last step for a loss to be of
        value = energy = float("nan")
        if not failed:
            value = float((loss or squared_displacement)(self.simulation, x, v.astype(np.float64)))
            energy = float(segment.rows_of("potential")[row] + segment.rows_of("kinetic")[row])
        digest = hashlib.blake2b(every.tobytes() + failed.encode(), digest_size=16).hexdigest()
        return DecisionHistory(every, digest, x, value, energy, failed)

    def differing(self, other: MdProgram, steps: int, step: int, key: str = "") -> Differing:
        """Return the pair nearest to the cutoff among pairs with different decisions."""
        sides = [one._pairs_at(steps, step) for one in (self, other)]
        keys = np.setxor1d(sides[0][0], sides[1][0], assume_unique=True)
        pairs = [divmod(int(key), self.size) for key in keys]
        margins = [[pair_margin(here, x, i, j) for _, here, x in sides] for i, j in pairs]
        place = min(range(len(pairs)), key=lambda k: max(abs(margin) for margin in margins[k]))
        inside = [bool(np.isin(keys[place], held)) for held, _, _ in sides]
        bounds = [pair_bound(here, x, *pairs[place]) for _, here, x in sides]
        nearest = Decision(
            channel="pair", step=step, subject=pairs[place], run="A" if inside[0] else "B", entered=True,
            a=int(inside[0]), b=int(inside[1]), margins=dict(zip("AB", margins[place], strict=True)),
            bounds=dict(zip("AB", bounds, strict=True)), separation=float("nan"), also=len(pairs) - 1,
        )  # fmt: skip
        return Differing(nearest)

    def _pairs_at(self, steps: int, step: int) -> tuple[Int[np.ndarray, "inside"], Simulation, np.ndarray]:
        """Return pairs inside the cutoff at one step, the simulation with its box, and positions."""
        for segment in Engine(self.simulation, steps, start=self.begin).segments():
            if segment.last >= step:
                row = step - segment.first
                here = self.simulation.in_row(segment.cell_of(row))
                return decided_pairs(self.simulation, segment, row), here, segment.unsorted("x", row)
        raise IndexError(f"the run has no step {step}")

    def state_at(self, step: int, last: int) -> tuple[Simulation, Float[np.ndarray, "atoms 3"]] | None:
        """Return a simulation with one step's box, and wrapped positions. None if the run ended earlier."""
        track = Track(self.simulation, last, self.begin, self.frame, flips=False)
        while track.segment() is not None:
            rows = track.until(track.ready)
            if rows is not None and rows.first + len(rows) > step:
                row = step - rows.first
                cell = rows.cells[row] if rows.cells else self.simulation.cell
                return self.simulation.in_row(cell), np.ascontiguousarray(rows.x[row].T)
        return None


def pair_margin(
    simulation: Simulation, x: Float[np.ndarray, "atoms 3"], i: int, j: int, labels: Simulation | None = None
) -> float:
    """Return the margin (threshold minus r or r²) of a pair, bit for bit as in a run.

    Args:
        x: wrapped positions, length.
        labels: simulation to whose atoms i and j refer; by default this one.
    """
    decider = simulation.decider
    kind = int((labels or simulation).type_of(np.array([i]), np.array([j]))[0])
    d = HostCell(simulation.cell, decider.dtype).displacement(x[[i % len(x)]], x[[j]])
    return decider.thresholds[kind].value - float(decider.host_quantity(*d)[0])


def pair_bound(simulation: Simulation, x: Float[np.ndarray, "atoms 3"], i: int, j: int) -> float:
    """Return a bound on the rounding error of r or r² of a pair."""
    kind = int(simulation.type_of(np.array([i]), np.array([j]))[0])
    return float(simulation.decider.bounds_at(x.T[None])[0, kind])
