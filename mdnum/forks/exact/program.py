"""Run a simulation in exact real arithmetic. Every decision is proven by interval arithmetic (library Arb).

The double-precision numbers of the simulation count as exact: the initial state and all constants.
Positions and velocities are represented by intervals ("balls") in multiple-precision arithmetic. A decision
is proven if the interval of r² excludes the squared cutoff. Otherwise the run is repeated with more bits. The
exact run makes the decisions of the program without rounding.

Source: Johansson, Arb, IEEE Transactions on Computers 66 (2017) 1281.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.tape import DecisionTape
from mdnum.md.cell import complete
from mdnum.md.cutoffs import CUTOFFS, AtCutoff, Undecided
from mdnum.md.integrators import VelocityVerlet
from mdnum.md.potentials import LennardJones, PairPotential, SumPotential
from mdnum.numerics import gamma
from mdnum.numerics.exact import enclosed
from mdnum.rollout.engine import first_state
from mdnum.systems.simulation import Simulation

#: Largest number of atoms, because all pairs are examined in every step.
MOST_ATOMS = 108
#: Approximate loss of bits per step for a Lennard-Jones liquid at the usual time step, and number of bits
#: that must remain at the end.
_BITS_PER_STEP, _BITS_LEFT = 0.35, 60
#: Number of restarts after which a decision counts as undecidable.
_RESTARTS = 5
#: Number of bits that are kept beyond those that the radius of a ball leaves significant.
_GUARD_BITS = 32
_U = 2.0**-53


# --- the exact program --------------------------------------------------------------------------------


def pull_of(
    potential: PairPotential, constants: Mapping[str, float], cutoff: str, r_cut: float, r_onset: float
) -> Callable[[Any], Any]:
    """Return a function that computes 2 du/d(r²) of a pair from an interval of r².

    The force on i is 2 du/d(r²) times x_j - x_i. Constants are exact doubles. Values derived from constants
    are intervals in the current precision of Arb.

    Raises:
        TypeError: the potential uses an operation that ball arithmetic does not support.
    """
    from flint import arb

    of = _lennard_jones if isinstance(potential, LennardJones) else partial(_enclosed, potential)
    bare, energy = of(**{name: arb(value) for name, value in constants.items()})
    rc = arb(r_cut)
    at = AtCutoff(rc, arb(r_onset), energy(rc * rc), rc * bare(rc * rc))
    return CUTOFFS.parse(cutoff).enclose(bare, energy, at)


def _lennard_jones(sigma: Any, epsilon: Any) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return functions for 2 du/d(r²) and u of the Lennard-Jones potential."""
    s2 = sigma * sigma
    s6 = s2 * s2 * s2
    # u = (4 epsilon s6) r⁻⁶ (s6 r⁻⁶ - 1), 2 du/d(r²) = (attract - repel r⁻⁶) r⁻⁸
    depth = 4 * epsilon * s6
    repel, attract = 12 * depth * s6, 6 * depth

    def bare(r2):
        inverse = 1 / r2
        cube = inverse * inverse * inverse
        return (attract - repel * cube) * (cube * inverse)

    def energy(r2):
        inverse = 1 / r2
        cube = inverse * inverse * inverse
        return depth * cube * (s6 * cube - 1)

    return bare, energy


def _enclosed(
    potential: PairPotential, **constants: Any
) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return functions for 2 du/d(r²) and u of any potential."""

    def evaluate(r2, *values):
        leaves = {name: value[None] for name, value in zip(constants, values, strict=True)}
        return potential.with_leaves(leaves).evaluate(r2[None])

    both = enclosed(evaluate, 1 + len(constants))
    return (lambda r2: 2 * both(r2, *constants.values())[1]), lambda r2: both(r2, *constants.values())[0]


@dataclass(frozen=True)
class ExactHistory:
    """The exact history of a run: all its decisions, each one proven."""

    tape: DecisionTape  # every decision, proven
    # smallest |threshold - r²| of any pair at each step, length², shape (steps + 1,); good to about ten
    # digits
    margin: Float[np.ndarray, "rows"]
    # binary logarithm of the largest radius of a coordinate's ball at each step (length), shape (steps + 1,);
    # minus infinity where all are exact
    radius: Float[np.ndarray, "rows"]
    # centers of the coordinates as doubles, not wrapped, length, shape (steps + 1, atoms, 3)
    x: Float[np.ndarray, "rows atoms 3"]
    bits: int  # precision that proved it
    restarts: int  # runs given up because a decision was not proven
    close: int  # decisions that needed the balls; all others were proven by a bound in double precision
    seconds: float  # of the run that succeeded

    @property
    def bits_per_step(self) -> float:
        """Growth of interval widths in the second half of a run, in bits per step. NaN for short runs."""
        rows = np.flatnonzero(np.isfinite(self.radius))
        if len(rows) < 4:
            return float("nan")
        half, end = rows[len(rows) // 2], rows[-1]
        return float((self.radius[end] - self.radius[half]) / (end - half))


def installed() -> bool:
    """Return True if the package for interval arithmetic (python-flint) is installed."""
    from importlib.util import find_spec

    return find_spec("flint") is not None


def unsupported(simulation: Simulation) -> InputError | None:
    """Return an error with a remedy if the decisions of a system cannot be certified."""
    half, atoms = float(np.min(simulation.cell.widths)) / 2, simulation.atoms
    alone = simulation.pairwise and not isinstance(simulation.potential, SumPotential)
    reasons = (
        (
            not alone,
            f"exact arithmetic supports one pair potential, not {simulation.potential.name!r}",
            "Use a system with a single pair potential, such as lennard-jones",
            "potential.kind",
        ),
        (
            simulation.fixed_point is not None,
            "a run in fixed-point integers is exact already: its decisions and sums have no rounding",
            "Use --set precision.state=float64",
            "precision.state",
        ),
        (
            type(simulation.integrator) is not VelocityVerlet,
            f"exact arithmetic supports only NVE dynamics, not {simulation.integrator.name!r}: the noise is "
            "defined by its rounding",
            "Use --set dynamics.kind=nve",
            "dynamics.kind",
        ),
        (
            atoms > MOST_ATOMS,
            f"{atoms} atoms; an exact run follows all pairs, of at most {MOST_ATOMS} atoms",
            "Use a smaller structure, e.g. argon/crystal-108",
            "system",
        ),
        (
            alone and simulation.r_cut > half * (1 - 1e-5),
            f"r_cut = {simulation.r_cut:g} is half the box ({half:g}): the nearest image cannot be proven",
            "Use a slightly smaller cutoff or a larger box",
            "cutoff.radius",
        ),
        (
            not installed(),
            "exact runs need python-flint, which is not installed",
            "Install the extra `exact`: pip install 'mdnum[exact]', or python-flint alone",
            None,
        ),
    )
    errors = (
        InputError(message, remedy=remedy, where=key) for is_so, message, remedy, key in reasons if is_so
    )
    return next(errors, None) or _without_balls(simulation)


def _without_balls(simulation: Simulation) -> InputError | None:
    """Return an error if ball arithmetic lacks an operation of the potential or cutoff."""
    from flint import arb

    try:
        for pull, r_cut in zip(_pulls(simulation), np.asarray(simulation.model.r_cut), strict=True):
            pull(arb(float(r_cut)) ** 2)
    except TypeError as error:
        return InputError(
            f"the potential {simulation.potential.name!r} cannot be evaluated in exact arithmetic: {error}",
            remedy="Use only the operations listed in docs/compiled-loop.md in the potential",
            where="potential.kind",
        )
    return None


def _pulls(simulation: Simulation) -> list[Callable[[Any], Any]]:
    """Return a function for 2 du/d(r²) in ball arithmetic, for each pair type."""
    model, bare = simulation.model, simulation.model.potential
    radii = zip(np.asarray(model.r_cut), np.asarray(model.r_onset), strict=True)
    return [
        pull_of(bare, bare.constants(kind), simulation.cutoff.name, float(r_cut), float(r_onset))
        for kind, (r_cut, r_onset) in enumerate(radii)
    ]


class ExactProgram:
    """Program that runs a simulation in interval (ball) arithmetic.

    Args:
        simulation: the simulation; its constants are in double precision, whatever its precision policy.

    Raises:
        InputError: the system cannot be certified.
    """

    def __init__(self, simulation: Simulation):
        error = unsupported(simulation)
        if error is not None:
            raise error
        begin = first_state(simulation.with_policy())
        self._x = np.asarray(begin.state.x, np.float64).T.copy()
        self._v = np.asarray(begin.state.v, np.float64).T.copy()
        self.simulation = simulation
        self.atoms = atoms = simulation.atoms
        self._timestep = float(simulation.integrator.timestep)
        self._i, self._j = np.triu_indices(atoms, 1)
        self._kind = np.asarray(simulation.type_of(self._i, self._j))
        decider = simulation.with_policy().decider
        self._inclusive, self._space = decider.compare.endswith("<="), decider.space
        self._held = [t.value for t in decider.thresholds]
        squared = [value * value if self._space == "r" else value for value in self._held]
        self._threshold = np.array(squared)[self._kind]
        cell = simulation.cell
        self._matrix = np.where(np.array(cell.pbc)[:, None], np.asarray(cell.matrix, np.float64), 0.0)
        inverse = np.linalg.inv(complete(np.asarray(cell.matrix), np.array(cell.pbc)))
        self._inverse = np.where(np.array(cell.pbc), inverse, 0.0)

    def run(
        self,
        steps: int,
        *,
        bits: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> ExactHistory:
        """Prove every decision up to a step. Failed attempts are repeated with more bits.

        Args:
            steps: last step.
            bits: initial precision; default 0.35 bits per step plus 60.
            progress: called with the step reached and the last step.

        Raises:
            InputError: a pair is so close to its threshold that no number of bits that was tried proves the
                decision.
        """
        expect_at_least(0, steps=steps)
        bits = math.ceil(_BITS_PER_STEP * steps) + _BITS_LEFT if bits is None else bits
        for restarts in range(_RESTARTS + 1):
            run = _Run(self, steps, bits)
            try:
                return run.all(progress, restarts)
            except Undecided:
                more = run.bits_needed()
                failed = run.step
            bits = max(more, bits + bits // 2)
        raise InputError(
            f"at step {failed}, {bits} bits are not enough to decide whether a pair is inside the cutoff; "
            "the distance of the pair may equal the cutoff exactly",
            remedy="Change one initial coordinate by one unit in the last place",
        )


class _Run:
    """One attempt to prove all decisions of a run with a given number of bits."""

    def __init__(self, program: ExactProgram, steps: int, bits: int):
        self.program, self.steps, self.bits, self.step = program, steps, bits, 0
        self._radius = np.full(steps + 1, -np.inf)
        self._margin = np.empty(steps + 1)
        self._x = np.empty((steps + 1, program.atoms, 3))
        self._flips: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._close = 0

    def bits_needed(self) -> int:
        """Estimate how many bits the run needs, from the growth of the intervals so far."""
        grown = self._radius[: self.step + 1]
        known = np.flatnonzero(np.isfinite(grown))
        if len(known) < 50:
            return 2 * self.bits
        rate = (grown[known[-1]] - grown[known[len(known) // 4]]) / (known[-1] - known[len(known) // 4])
        return math.ceil(1.1 * rate * self.steps) + 2 * _BITS_LEFT

    def all(self, progress, restarts: int) -> ExactHistory:
        """Run all steps, prove every decision, and return the decisions."""
        from flint import ctx

        begin, before = time.perf_counter(), ctx.prec
        try:
            ctx.prec = self.bits
            first = self._all(progress)
        finally:
            ctx.prec = before
        program = self.program
        keys = program._i.astype(np.int64) * program.atoms + program._j
        rows = [np.empty(0, np.int64)]
        tape = DecisionTape(
            program.atoms,
            self.steps,
            keys[first],
            np.concatenate(rows + [np.full(len(at), step, np.int64) for step, at, _ in self._flips]),
            np.concatenate(rows + [keys[at] for _, at, _ in self._flips]),
            np.concatenate([np.empty(0, bool)] + [now for _, _, now in self._flips]),
        )
        seconds = time.perf_counter() - begin
        return ExactHistory(
            tape, self._margin, self._radius, self._x, self.bits, restarts, self._close, seconds
        )

    def _all(self, progress) -> Bool[np.ndarray, "all_pairs"]:
        from flint import arb, ctx

        program, atoms = self.program, self.program.atoms
        dt = arb(program._timestep)
        kick = [dt * dt / arb(float(mass)) for mass in program.simulation.masses]
        pulls = _pulls(program.simulation)
        held = [arb(value) for value in program._held]
        thresholds = [value * value if program._space == "r" else value for value in held]
        self._lattice = [[arb(float(c)) for c in row] for row in program._matrix]
        self._shifts: dict[tuple[int, int, int], tuple[Any, Any, Any]] = {}
        # component by component; w is dt * v
        x = [[arb(float(c)) for c in program._x[:, k]] for k in range(3)]
        w = [[dt * arb(float(c)) for c in program._v[:, k]] for k in range(3)]
        kinds, every_i, every_j = program._kind.tolist(), program._i.tolist(), program._j.tolist()
        first = before = None
        for step in range(self.steps + 1):
            self.step = step
            centers = self._x[step]
            for k in range(3):
                centers[:, k] = [float(c) for c in x[k]]
            self._radius[step] = radius = max(_log2_radius(c) for row in x for c in row)
            size = math.log2(max(1e-300, float(np.abs(centers).max())))
            if np.isfinite(radius):
                ctx.prec = max(64, min(self.bits, math.ceil(size - radius) + _GUARD_BITS))
            inside, images, r2 = self._decide(x, centers, radius, thresholds)
            self._margin[step] = np.min(np.abs(program._threshold - r2), initial=np.inf)
            if before is None:
                first = inside
            else:
                changed = np.flatnonzero(inside != before)
                if len(changed):
                    self._flips.append((step, changed, inside[changed]))
            before = inside
            if progress is not None and step % 50 == 0:
                progress(step, self.steps)
            if step == self.steps:
                break
            force = [[arb(0)] * atoms for _ in range(3)]
            fx, fy, fz = force
            xs, ys, zs = x
            chosen = np.flatnonzero(inside)
            for p, n in zip(chosen.tolist(), images[chosen].tolist(), strict=True):
                i, j = every_i[p], every_j[p]
                dx, dy, dz = xs[j] - xs[i], ys[j] - ys[i], zs[j] - zs[i]
                if n != [0, 0, 0]:
                    sx, sy, sz = self._shift(n)
                    dx, dy, dz = dx - sx, dy - sy, dz - sz
                pull = pulls[kinds[p]](dx * dx + dy * dy + dz * dz)
                dx, dy, dz = pull * dx, pull * dy, pull * dz
                fx[i] += dx
                fy[i] += dy
                fz[i] += dz
                fx[j] -= dx
                fy[j] -= dy
                fz[j] -= dz
            # both half kicks in one; only a half one starts the run
            factors = [c / 2 for c in kick] if step == 0 else kick
            for k in range(3):
                w[k] = [a + c * f for a, c, f in zip(w[k], factors, force[k], strict=True)]
                x[k] = [a + b for a, b in zip(x[k], w[k], strict=True)]
        assert first is not None
        return first

    def _shift(self, n: list[int]) -> tuple[Any, Any, Any]:
        """Return n1 a1 + n2 a2 + n3 a3 exactly, for lattice vectors a."""
        key = (n[0], n[1], n[2])
        if key not in self._shifts:
            rows = self._lattice
            x, y, z = (n[0] * rows[0][c] + n[1] * rows[1][c] + n[2] * rows[2][c] for c in range(3))
            self._shifts[key] = x, y, z
        return self._shifts[key]

    def _decide(
        self, x, centers: Float[np.ndarray, "atoms 3"], radius: float, thresholds: list
    ) -> tuple[Bool[np.ndarray, "all_pairs"], Int[np.ndarray, "all_pairs 3"], Float[np.ndarray, "all_pairs"]]:
        """Make all decisions of a step by double-precision bounds or, if necessary, by intervals.

        Double precision and exact arithmetic may choose different nearest images. Half the box exceeds r_cut
        by more than the rounding errors. Different nearest images are then both outside the cutoff.
        """
        program = self.program
        i, j, matrix = program._i, program._j, program._matrix
        d = centers[j] - centers[i]
        n = np.rint(d @ program._inverse)
        d = d - n @ matrix
        r2 = (d * d).sum(axis=1)
        # error of a component: of both centers, their difference and the lattice vectors taken off
        largest = 4 * np.abs(centers).max() + (np.abs(n).max(initial=0.0) + 1) * np.abs(matrix).sum()
        if not np.isfinite(largest):
            raise InputError(f"the exact run blows up at step {self.step}", remedy="Use a smaller time step")
        component = 8 * _U * largest + 4 * 2.0 ** min(max(radius, -1000.0), 500.0)
        r = np.sqrt(r2)
        bound = 4 * (r + component) * component * math.sqrt(3) + 4 * gamma(8) * (r2 + program._threshold)
        inside = r2 < program._threshold
        for p in np.flatnonzero(~(np.abs(r2 - program._threshold) > bound)).tolist():
            self._close += 1
            a, b = int(i[p]), int(j[p])
            shift = self._shift([int(c) for c in n[p]])
            dx, dy, dz = (x[k][b] - x[k][a] - shift[k] for k in range(3))
            ball, threshold = dx * dx + dy * dy + dz * dz, thresholds[program._kind[p]]
            if ball < threshold or (program._inclusive and ball <= threshold):
                inside[p] = True
            elif ball > threshold or (not program._inclusive and ball >= threshold):
                inside[p] = False
            else:
                raise Undecided
            r2[p] = program._threshold[p] - float(threshold - ball)
        return inside, n.astype(np.int64), r2


def _log2_radius(ball) -> float:
    """Return an upper bound on log2 of an interval's radius. The radius may exceed the range of doubles."""
    if ball.is_exact():
        return -math.inf
    mantissa, exponent = ball.rad().man_exp()
    return float(int(exponent) + int(mantissa).bit_length())
