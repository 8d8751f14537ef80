"""A short run at constant energy: how much of its energy drifts away, and to what it is due."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Curve, Part, Progress, Subject
from mdnum.audit.crossings import SMOOTH_ENOUGH, Crossing, Threshold, account, crossings
from mdnum.audit.drift import Drift, drift, ratio, wandering
from mdnum.audit.noise import FEW, Noise, along_a_line, roomy
from mdnum.audit.nve import Run, at, fitting_timestep, prepared, rigid_bonds, run
from mdnum.audit.subject import CalculatorError, only_trying
from mdnum.references.findings import finding

_MOST_STEPS, _FEWEST_STEPS = 400, 64
#: Seconds that a run may take where nobody says how many steps.
_SECONDS = 40.0
#: Calls of the calculator for a step: two in the run of half the time step, warming up, work on the way.
_CALLS = 6.0
#: Flips whose jumps are measured; the others are told by the mean of these.
_MEASURED = 240
_COMPARED = 12
#: Share of the thermal energy of an atom that may drift away in a ps before a run is not one at constant
#: energy: within 100 ps all of it.
_MUCH = 1e-2


@dataclass(frozen=True)
class Ledger:
    """Where the energy of a run went, step by step.

    Attributes:
        crossed: flips at thresholds.
        jumps: energy that the flips of each step brought, measured or by the mean of those measured, eV.
        measured: crossings whose jump was measured, by place in `crossed`, and their jumps, eV.
        rest: what neither flips nor the work of the forces explains; nan at steps not looked at, eV.
    """

    crossed: Sequence[Crossing]
    jumps: Float[np.ndarray, "steps"]
    measured: Mapping[int, float]
    rest: Float[np.ndarray, "steps"]


@dataclass
class Dynamics:
    """Drift of the energy with a block error, separated into integrator, flips and the rest.

    The energy of every step is accounted for: ΔU plus the work that the forces do on the straight way
    between two steps vanishes for a force that has this energy, whatever the integrator does. At a threshold
    it is the jump of a flip; anywhere else it is a force that is not the energy's derivative, or an answer
    that depends on what was asked before. What is left of the drift is the integrator's, and must fall to a
    quarter with half the time step, which a second run tests.

    Args:
        thresholds: finds where flips happen; see `mdnum.audit.thresholds.find_thresholds`.
        timestep: internal time; a fraction of the fastest vibration if None.
        steps: of the run; as many as take half a minute if None.
        seed: of the velocities.
    """

    thresholds: Callable[[Subject], Sequence[Threshold]] | None = None
    timestep: float | None = None
    steps: int | None = None
    seed: int = 0
    name: str = "dynamics"
    recorded: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        began = time.perf_counter()
        told = progress or (lambda done, total, info: None)
        rng = np.random.default_rng(self.seed)
        limits, unknown = self._limits(subject)
        atoms = roomy(subject.atoms, FEW)
        bonds = rigid_bonds(atoms) if _only_molecules(subject) else np.zeros((0, 2), np.int64)
        worker = subject.fresh()
        fitting, period = fitting_timestep(worker, atoms, rng)
        start = prepared(worker, atoms, bonds, period, rng)
        step = self.timestep if self.timestep is not None else fitting
        if not np.isfinite(step):
            return _nothing_moves(self.name, began)
        count = self.steps or _affordable(worker, start)
        total = 3 * count + count // 4

        def each(before: int) -> Callable[[int], None]:
            return lambda at_step: told(before + at_step, total, {"phase": "dynamics", "unit": "steps"})

        # from where it was given, a structure relaxes; that is no drift
        _, start = run(worker, start, step, count // 4, each(0))
        whole, _ = run(subject.fresh(), start, step, count, each(count // 4))
        if whole.blown_up:
            return _blew_up(self.name, whole, step, subject, began)
        half, _ = run(subject.fresh(), start, step / 2, 2 * count, each(count + count // 4))
        probe = subject.fresh()
        noise = along_a_line(probe, at(start, start.positions), rng)
        told(0, 0, {"phase": "accounting for the energy"})
        ledger = balance(probe, whole, start, limits, rng)
        finer = crossings(half, start, limits)
        stale = _stale(subject, whole, start, noise)
        result = Result(
            subject, whole, half, ledger, _told(finer, ledger, len(half.potential)), limits, stale, noise
        )
        self.recorded = {"energies": _energies(result), "crossings": _crossings(result)}
        return result.part(self.name, period, time.perf_counter() - began, unknown)

    def _limits(self, subject: Subject) -> tuple[list[Threshold], str]:
        """Thresholds, or why none are known."""
        if self.thresholds is None:
            return [], "no thresholds were looked for"
        try:
            found = list(self.thresholds(subject))
        except CalculatorError as error:
            return [], f"looking for thresholds, the calculator {error.message}"
        return found, "" if found else "no threshold was found"


def balance(
    probe: Subject, whole: Run, like: Atoms, limits: Sequence[Threshold], rng: np.random.Generator
) -> Ledger:
    """Account for the energy of a run.

    Args:
        probe: another object than the run's.
        whole: the run.
        like: species and cell.
        limits: where flips happen.
        rng: picks the steps whose flips are measured where there are too many.
    """
    crossed = crossings(whole, like, limits)
    by_step: dict[int, list[int]] = {}
    for place, one in enumerate(crossed):
        by_step.setdefault(one.step, []).append(place)
    # a step without a crossing that needs care costs one call; of the others a sample must do
    careful = {
        step: count
        for step, places in by_step.items()
        if (count := sum(limits[crossed[place].threshold].order < SMOOTH_ENOUGH for place in places))
    }
    chosen: set[int] = set()
    afforded = 0
    for step in rng.permutation(sorted(careful)):
        if afforded < _MEASURED:
            chosen.add(int(step))
            afforded += careful[int(step)]
    rest = np.full(len(whole.potential), np.nan)
    rest[0] = 0.0
    measured: dict[int, float] = {}
    for step in range(1, len(whole.potential)):
        places = by_step.get(step, [])
        if step in careful and step not in chosen:
            continue
        found = account(probe, whole, like, step, [crossed[place] for place in places], limits)
        rest[step] = found.rest
        measured |= dict(zip(places, found.jumps, strict=True))
    jumps = np.zeros(len(whole.potential))
    means = _means(crossed, measured)
    for place, one in enumerate(crossed):
        jumps[one.step] += measured.get(place, _sign(one) * means.get(one.threshold, 0.0))
    return Ledger(crossed, jumps, measured, rest)


def _means(crossed: Sequence[Crossing], measured: Mapping[int, float]) -> dict[int, float]:
    """Jump of a pair that enters, by threshold, eV."""
    found: dict[int, list[float]] = {}
    for place, jump in measured.items():
        found.setdefault(crossed[place].threshold, []).append(_sign(crossed[place]) * jump)
    return {threshold: float(np.mean(jumps)) for threshold, jumps in found.items()}


def _sign(one: Crossing) -> float:
    return 1.0 if one.entered else -1.0


def _told(finer: Sequence[Crossing], ledger: Ledger, steps: int) -> Float[np.ndarray, "steps"]:
    """Energy that the flips of another run brought, by the mean jumps of this one, eV."""
    means = _means(ledger.crossed, ledger.measured)
    jumps = np.zeros(steps)
    for one in finer:
        jumps[one.step] += _sign(one) * means.get(one.threshold, 0.0)
    return jumps


@dataclass(frozen=True)
class Result:
    """Two runs and where their energy went.

    Attributes:
        subject: the calculator.
        whole, half: the run, and the one with half its time step.
        ledger: of the run.
        half_jumps: energy that the flips of the other brought by step, eV.
        limits: thresholds.
        stale: largest difference of the run's energies from those of new objects, and what noise allows, eV.
        noise: of the calculator.
    """

    subject: Subject
    whole: Run
    half: Run
    ledger: Ledger
    half_jumps: Float[np.ndarray, "steps"]
    limits: Sequence[Threshold]
    stale: tuple[float, float]
    noise: Noise

    def shares(self) -> dict[str, Drift]:
        """Drift of all, of flips, of the rest, and of the integrator by either way, eV per internal time."""
        one, other = self.whole, self.half
        rest = np.where(np.isnan(self.ledger.rest), np.nanmean(self.ledger.rest), self.ledger.rest)
        flips = wandering(one.time, self.ledger.jumps)
        left = wandering(one.time, rest)
        half_flips = wandering(other.time, self.half_jumps)
        total = _with(drift(one.time, one.total), flips)
        half = _with(drift(other.time, other.total), half_flips)
        # what a run keeps when flips and the rest are taken out of it is the integrator's
        kept = one.total - np.cumsum(self.ledger.jumps) - np.cumsum(rest)
        halved = other.total - np.cumsum(self.half_jumps)
        unflipped = drift(one.time, one.total - np.cumsum(self.ledger.jumps))
        return {
            "total": total,
            "total, half the time step": half,
            "flips": flips,
            "rest": left,
            "integrator": drift(one.time, kept),
            # second order: three quarters of it go with half the time step
            "integrator, by halving": unflipped.minus(drift(other.time, halved)).times(4 / 3),
        }

    def part(self, name: str, period: float, seconds: float, unknown: str) -> Part:
        """What the check says.

        Args:
            name: of the check.
            period: of the fastest vibration, internal time.
            seconds: the check took.
            unknown: why there is no threshold.
        """
        words = _Words(self)
        shares = {what: one.times(words.per_atom) for what, one in self.shares().items()}
        return Part(
            name=name,
            title="Dynamics",
            says=words.says(shares),
            findings=list(words.findings(shares)),
            tables=words.tables(shares, period),
            curves=words.curves(),
            numbers=words.numbers(shares),
            skipped=words.skipped(unknown),
            seconds=seconds,
        )


def _with(fitted: Drift, flips: Drift) -> Drift:
    """A drift whose error knows that the sum of jumps wanders."""
    return Drift(fitted.slope, float(np.hypot(fitted.error, flips.error)))


class _Words:
    """A result in words, tables and curves."""

    def __init__(self, result: Result):
        self.result = result
        units = getattr(result.subject, "units", None)
        self.reduced = units is not None and units.name == "lj"
        self.time = units.time if units is not None else "ps"
        self.factor = units.time_factor if units is not None else 98.22694788464064
        self.energy = "ε" if self.reduced else "eV"
        self.unit = f"1e-3 {self.energy}/atom/{self.time}" if self.reduced else "meV/atom/ps"
        self.atoms = result.whole.positions.shape[1]
        self.per_atom = 1e3 * self.factor / self.atoms

    def numbers(self, shares: Mapping[str, Drift]) -> dict[str, Any]:
        one = self.result.whole
        ledger = self.result.ledger
        whole = one.time[-1] / self.factor
        return {
            "drift": shares["total"].slope,
            "drift_error": shares["total"].error,
            "drift_unit": self.unit,
            "drift_ratio": ratio(one.time, one.total, one.kinetic),
            "integrator": shares["integrator"].slope,
            "integrator_error": shares["integrator"].error,
            "integrator_by_halving": shares["integrator, by halving"].slope,
            "flips": shares["flips"].slope,
            "flips_error": shares["flips"].error,
            "rest": shares["rest"].slope,
            "rest_error": shares["rest"].error,
            "timestep": one.timestep / self.factor,
            "steps": len(one.potential) - 1,
            "time": whole,
            "crossings": len(ledger.crossed),
            "jumps_measured": len(ledger.measured),
            "largest_jump": max((abs(jump) for jump in ledger.measured.values()), default=0.0),
            "stale": self.result.stale[0],
            "mean_kinetic": float(np.mean(one.kinetic)) / self.atoms,
        }

    def says(self, shares: Mapping[str, Drift]) -> str:
        numbers = self.numbers(shares)
        total = shares["total"]
        parts = ", ".join(f"{shares[word].slope:+.2g} from {words}" for word, words in _SOURCES.items())
        return (
            f"In {numbers['time']:.3g} {self.time} at constant energy ({numbers['steps']} steps) the energy "
            f"drifted by {total.slope:+.2g} ± {total.error:.1g} {self.unit}, "
            f"{abs(numbers['drift_ratio']):.2g} of "
            f"the scatter of the kinetic energy: {parts}."
        )

    def findings(self, shares: Mapping[str, Drift]) -> Iterator[dict[str, str]]:
        result, numbers = self.result, self.numbers(shares)
        # what may go in a unit of time: a share of the thermal energy of an atom
        much = 1e3 * _MUCH * result.subject.kT
        differs, allowed = result.stale
        if differs > allowed:
            yield finding(
                "STALE_DYNAMICS",
                "error",
                "a run has other energies than its structures",
                f"Energies of the run differ by up to {differs:.3g} {self.energy} from those that new "
                "objects give "
                f"for the same positions, where noise explains {allowed:.1g}.",
                "Look at when the neighbor list is rebuilt: all displacements since, twice the largest, and "
                "the "
                "strain of the cell must fit into the skin.",
            )
        rest = shares["rest"]
        if rest.there and abs(rest.slope) > 1e-2 * max(abs(shares["total"].slope), 1e-2 * much):
            yield finding(
                "NOT_CONSERVED",
                "error" if abs(rest.slope) > 0.1 * much or differs > allowed else "warning",
                "the forces do work that the energy does not know of",
                f"{rest.slope:+.3g} ± {rest.error:.1g} {self.unit} of the drift are neither from flips nor "
                "from the "
                "integrator: along the run, energy gained and work done do not add up.",
                "See forces and curl: a force that is not the derivative of the energy"
                + (", and a list that is out of date." if differs > allowed else "."),
            )
        flips = shares["flips"]
        size = _wander(result.ledger.jumps) / np.sqrt(numbers["time"]) / result.subject.kT
        if numbers["largest_jump"] > 100 * result.noise.energy and size > 1e-4:
            yield finding(
                "FLIPS_CHANGE_ENERGY",
                "error" if flips.there and abs(flips.slope) > much else "warning",
                "every flip at a threshold changes the energy of a run",
                f"{numbers['crossings']} crossings in {numbers['time']:.3g} {self.time} brought "
                f"{flips.slope:+.3g} ± {flips.error:.1g} {self.unit}, by jumps of up to "
                f"{1e3 * numbers['largest_jump']:.3g} m{self.energy}; their sum wanders by {size:.2g} kT in "
                "the "
                f"first {self.time}.",
                "Switch the interaction off smoothly before its cutoff, or shift it to zero there.",
            )
        total, integrator = shares["total"], shares["integrator"]
        if integrator.there and abs(integrator.slope) > much:
            yield finding(
                "TIMESTEP",
                "info",
                "the time step is long for this structure",
                f"{integrator.slope:+.3g} ± {integrator.error:.1g} {self.unit} come from the integrator at "
                f"{numbers['timestep']:.3g} {self.time} ({shares['integrator, by halving'].slope:+.3g} by "
                "halving "
                "it).",
                "Use a shorter one: --timestep.",
            )
        explained = abs(integrator.slope) > 0.5 * abs(total.slope) or rest.there or flips.there
        if total.there and abs(total.slope) > much and not explained:
            yield finding(
                "DRIFT",
                "warning",
                "the energy drifts",
                f"{total.slope:+.3g} ± {total.error:.1g} {self.unit}, and neither flips nor forces nor the "
                "integrator account for most of it.",
                "Run longer (--steps) to see whether it stays.",
            )

    def tables(self, shares: Mapping[str, Drift], period: float) -> dict[str, list[dict[str, Any]]]:
        numbers = self.numbers(shares)
        energies = [
            {"drift": what, self.unit: one.slope, "standard error": one.error, "told from zero": one.there}
            for what, one in shares.items()
        ]
        means = _means(self.result.ledger.crossed, self.result.ledger.measured)
        flips = []
        for place, limit in enumerate(self.result.limits):
            mine = [one for one in self.result.ledger.crossed if one.threshold == place]
            if mine:
                flips.append(
                    {
                        "pair": "-".join(limit.species),
                        "at (Å)": limit.radius,
                        "entered": sum(one.entered for one in mine),
                        "left": sum(not one.entered for one in mine),
                        f"jump on entering (m{self.energy})": 1e3 * means.get(place, float("nan")),
                    }
                )
        return {
            "Drift, and where it is from": [{k: _answer(v) for k, v in row.items()} for row in energies],
            "Flips of the run": flips,
            "The run": [
                {
                    f"time step ({self.time})": numbers["timestep"],
                    "steps": numbers["steps"],
                    f"fastest vibration ({self.time})": period / self.factor,
                    "kinetic energy of an atom, over 3/2 kT": numbers["mean_kinetic"]
                    / (1.5 * self.result.subject.kT),
                    "drift over scatter of the kinetic energy": numbers["drift_ratio"],
                }
            ],
        }

    def curves(self) -> list[Curve]:
        one, other = self.result.whole, self.result.half
        scale = 1e3 / self.atoms
        rest = np.nan_to_num(self.result.ledger.rest)
        lines = {
            "energy": (one.total - one.total[0]) * scale,
            "half the time step": (other.total[::2] - other.total[0]) * scale,
            "jumps of flips": np.cumsum(self.result.ledger.jumps) * scale,
            "forces that are no gradient": np.cumsum(rest) * scale,
        }
        return [
            Curve(
                "Change of the energy during a run, and what explains it",
                f"time ({self.time})",
                f"change (m{self.energy}/atom)",
                one.time / self.factor,
                lines,
            )
        ]

    def skipped(self, unknown: str) -> list[tuple[str, str]]:
        found = [("jumps of flips", unknown)] if unknown else []
        crossed, measured = len(self.result.ledger.crossed), len(self.result.ledger.measured)
        if measured < crossed:
            found.append(
                (
                    f"jumps of {crossed - measured:,} crossings",
                    f"{measured:,} were measured, the others are told by their mean",
                )
            )
        return found


_SOURCES = {"integrator": "the integrator", "flips": "flips", "rest": "neither"}


def _answer(value: Any) -> Any:
    # whether a drift is there is no verdict: a table marks what is False as wrong
    return ("yes" if value else "no") if isinstance(value, bool) else value


def _wander(jumps: Float[np.ndarray, "steps"]) -> float:
    return float(np.sqrt(np.sum(jumps**2)))


def _only_molecules(subject: Subject) -> bool:
    """Whether the calculator takes whole molecules alone, whose inner distances it does not know."""
    if rigid_bonds(subject.atoms).size == 0:
        return False
    try:
        with only_trying(subject):
            subject.fresh().energy(
                Atoms(str(subject.atoms.symbols[0]), [(0, 0, 0)], cell=[50.0] * 3, pbc=True)
            )
    except CalculatorError:
        return True
    return False


def _affordable(subject: Subject, start: Atoms) -> int:
    """Steps that take no longer than they may."""
    began = time.perf_counter()
    for _ in range(3):
        start.positions[0, 0] += 1e-6
        subject.energy(at(start, start.positions))
        subject.forces(at(start, start.positions))
    took = (time.perf_counter() - began) / 3
    return int(np.clip(_SECONDS / (_CALLS * took), _FEWEST_STEPS, _MOST_STEPS))


def _stale(subject: Subject, whole: Run, like: Atoms, noise: Noise) -> tuple[float, float]:
    """Largest difference of the run's energies from those of objects that saw nothing else, and its limit."""
    places = np.unique(np.linspace(0, len(whole.potential) - 1, _COMPARED).astype(int))
    found = [
        abs(subject.fresh().energy(at(like, whole.positions[place])) - whole.potential[place])
        for place in places
    ]
    return float(max(found)), 40 * max(
        noise.energy, np.finfo(float).eps * float(np.max(np.abs(whole.potential)))
    )


def _nothing_moves(name: str, began: float) -> Part:
    why = "no force and no thermal motion: there is nothing to integrate"
    return Part(
        name,
        "Dynamics",
        why.capitalize() + ".",
        skipped=[("a run", why)],
        seconds=time.perf_counter() - began,
    )


def _blew_up(name: str, whole: Run, step: float, subject: Subject, began: float) -> Part:
    units = getattr(subject, "units", None)
    factor, unit = (units.time_factor, units.time) if units is not None else (98.22694788464064, "ps")
    after = len(whole.potential) - 1
    return Part(
        name,
        "Dynamics",
        f"The run flew apart after {after} steps.",
        findings=[
            finding(
                "BLEW_UP",
                "error",
                "a run at constant energy flies apart",
                f"After {after} steps of {step / factor:.3g} {unit} the kinetic energy had grown a "
                "thousandfold.",
                "Look at the other findings first; then try a shorter time step (--timestep) and a "
                "structure that "
                "is relaxed.",
            )
        ],
        numbers={"steps": after, "blew_up": True, "drift": None},
        seconds=time.perf_counter() - began,
    )


def _energies(result: Result) -> dict[str, Any]:
    """Rows of energies.parquet."""
    parts: list[dict[str, Any]] = []
    for word, run_, jumps, rest in (
        ("run", result.whole, result.ledger.jumps, result.ledger.rest),
        ("half", result.half, result.half_jumps, np.full(len(result.half.potential), np.nan)),
    ):
        count = len(run_.potential)
        entered, left = np.zeros((2, count), np.int64)
        if word == "run":
            for one in result.ledger.crossed:
                (entered if one.entered else left)[one.step] += 1
        parts.append(
            {
                "run": np.full(count, word), "step": np.arange(count), "time": run_.time,
                "potential": run_.potential, "kinetic": run_.kinetic, "total": run_.total,
                "entered": entered, "left": left, "jumps": jumps, "rest": rest,
            }
        )  # fmt: skip
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _crossings(result: Result) -> dict[str, Any]:
    """Rows of crossings.parquet."""
    crossed, count = result.ledger.crossed, len(result.ledger.crossed)
    return {
        "run": np.full(count, "run"),
        "step": np.array([one.step for one in crossed], np.int64),
        "i": np.array([one.i for one in crossed], np.int64),
        "j": np.array([one.j for one in crossed], np.int64),
        "rank": np.array([one.rank for one in crossed], np.int64),
        "entered": np.array([one.entered for one in crossed], bool),
        "threshold": np.array([result.limits[one.threshold].radius for one in crossed], np.float64),
        "distance": np.array([one.distance for one in crossed], np.float64),
        "margin": np.array([one.margin for one in crossed], np.float64),
        "energy_jump": np.array([result.ledger.measured.get(n, np.nan) for n in range(count)], np.float64),
    }
