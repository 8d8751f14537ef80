"""Check the energy drift of a short NVE run, and find its causes.

Runs use ASE's velocity Verlet. Molecules of rigid models keep their shape.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.md.velocitydistribution import MaxwellBoltzmannDistribution, Stationary
from ase.md.verlet import VelocityVerlet
from jaxtyping import Float, Int

from mdnum.audit.base import AuditCheck, CalculatorError, Chart, CheckResult, Observed, Progress, finding
from mdnum.audit.curve import SMOOTH
from mdnum.audit.energy import Drift, EnergyBalance, NveRun, balance, crossings, drift, ratio, wandering
from mdnum.audit.noise import FEW, NoiseFloor, along_a_line, direction, displaced, roomy, settled
from mdnum.audit.structures import group
from mdnum.audit.subject import CalculatorSubject, largest, rms
from mdnum.audit.thresholds import PairThreshold, find_thresholds
from mdnum.units import ENERGY, LENGTH, Measured, Units

#: Default number of steps of a run. A step takes about six calls: two in the run at half the time step, and
#: those for equilibration and for the work.
_STEPS = 200
_COMPARED = 12
#: Brief version: number of steps, number of structures along the run that are evaluated by new objects, and
#: number of power iterations.
_FEW_STEPS, _FEW_COMPARED, _FEW_ITERATIONS = 16, 2, 3
#: Drift per ps, as a share of the thermal energy of an atom, above which a run is not at constant energy: the
#: whole thermal energy within 100 ps.
_MUCH = 1e-2
_WANDERS = 1e-4  # of kT: a sum of jumps that wanders less in a unit of time is not reported
_SWING = 1e-2  # of kT: energy of an atom that may come and go without a flip or the integrator
_STEPS_A_PERIOD = 40  # steps in the period of the fastest vibration
_FURTHEST = 0.06  # Å that the fastest atom of a thermal run may cover in a step
_POWER_ITERATIONS = 10
_BLOWN_UP = 1e3  # kinetic over initial kinetic energy from which a run has blown up
_RELAXED = 0.2  # of the thermal force of the stiffest spring: below, atoms are in their places
_MOST_SWEEPS = 500
_TOLERANCE = 1e-13  # relative to a squared length, and of a momentum to the largest
_SOURCES = ("integrator", "flips", "elsewhere", "rest")


class DynamicsCheck(AuditCheck):
    """Is the energy conserved in a short run at constant energy?

    The check reports the drift, its standard error, and the drifts due to integrator, flips and other causes.
    Drift that neither flips nor the work of forces explain is due to the integrator. At half the time step,
    the integrator's drift must fall to a quarter.
    """

    name, title, order, basic, calls = "dynamics", "Dynamics", 70, True, 1900
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Run the dynamics with full and half time step. Compute the energy balance."""
        with subject.meter.limited():
            return self._ask(subject, progress)

    def _ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        rng = np.random.default_rng(self.seed)
        limits, unknown = ([], "") if self.brief else _limits(subject)
        atoms = roomy(subject.atoms, FEW)
        held, worker = rigid(atoms), subject.fresh()
        # of molecules that it takes whole alone, a calculator does not know the inner distances
        if held is not None and subject.fresh().answers(subject.atoms[:-1]):
            held = None
        iterations = _FEW_ITERATIONS if self.brief else _POWER_ITERATIONS
        fitting, period = fitting_timestep(worker, atoms, rng, iterations)
        start = prepared(worker, atoms, held, period, rng)
        step = fitting if self.timestep is None else self.timestep
        if not np.isfinite(step):
            why = "no force and no thermal motion: there is nothing to integrate"
            return CheckResult(says=(["dynamics_nothing"], {}), skipped=[("a run", why)])
        count = _FEW_STEPS if self.brief else self.steps or _STEPS
        total = 3 * count + count // 4

        def each(before: int):
            return lambda reached: progress(before + reached, total, {"phase": "dynamics", "unit": "steps"})

        if not self.brief:
            # from where it was given, a structure relaxes; that is no drift
            _, start = run(worker, start, step, count // 4, each(0))
        whole, _ = run(subject.fresh(), start, step, count, each(count // 4))
        if whole.blown_up:
            after = len(whole.potential) - 1
            units = subject.units
            values = {"after": after, "timestep": step / units.time_factor, "time": units.time}
            return CheckResult(
                says=(["dynamics_blew_up"], values),
                findings=[finding("BLEW_UP", "error", **values)],
                numbers={"steps": after, "blew_up": True, "drift": None},
            )
        if self.brief:
            noise = settled(subject.fresh(), np.random.default_rng(self.seed), brief=True)[1]
            return _brief(whole, _aged(subject, whole, _FEW_COMPARED, noise), subject.units)
        half, _ = run(subject.fresh(), start, step / 2, 2 * count, each(count + count // 4))
        probe = subject.fresh()
        noise = along_a_line(probe, whole.at(start.positions), rng)
        progress(0, 0, {"phase": "accounting for the energy"})
        found = balance(probe, whole, limits, rng, noise.allowed.energy)
        # the other run's flips count only where they bring energy
        finer = crossings(half, limits) if any(one.order == 0 for one in limits) else []
        stale = _aged(subject, whole, _COMPARED, noise)
        brought = found.by_means(finer, len(half.potential))
        return TwoRuns(subject, whole, half, found, brought, limits, stale, noise, period).outcome(unknown)


def _aged(subject: CalculatorSubject, ran: NveRun, count: int, noise: NoiseFloor) -> tuple[float, float]:
    """Return the largest energy difference from new calculators, and its limit (eV)."""
    places = np.unique(np.linspace(0, len(ran.potential) - 1, count).astype(int))
    again = [subject.fresh().energy(ran.at(ran.positions[n])) for n in places]
    rounding = NoiseFloor(np.finfo(float).eps * largest(ran.potential), 0.0)
    return largest(np.array(again) - ran.potential[places]), noise.louder(rounding).allowed.energy


def _brief(ran: NveRun, stale: tuple[float, float], units: Units) -> CheckResult:
    """Use a short run to find whether energies depend on earlier steps."""
    (differs, allowed), steps = stale, len(ran.potential) - 1
    change = 1e3 * largest(ran.total - ran.total[0]) / ran.positions.shape[1]
    seen = Measured(differs, "energy", allowed)
    old = [finding("STALE_DYNAMICS", "error", differs=seen)] if differs > allowed else []
    values: dict[str, Any] = {"steps": steps, "change": change, "stale": differs}
    values |= {"timestep": ran.timestep / units.time_factor, "time_unit": units.time}
    return CheckResult(says=(["dynamics_brief"], values), findings=old, numbers=values, possible=2)


def _limits(subject: CalculatorSubject) -> tuple[list[PairThreshold], str]:
    """Return the pair thresholds of the calculator, or why none are known."""
    try:
        # one at which no more than a third derivative jumps leaves no trace in a run
        found = [one for one in find_thresholds(subject) if one.order < SMOOTH or one.dies]
    except CalculatorError as error:
        return [], f"searching thresholds, the calculator {error.message}"
    return found, "" if found else "no threshold was found"


@dataclass(frozen=True)
class TwoRuns:
    """Two runs with full and half time step, and their energy balances."""

    subject: CalculatorSubject
    # whole, half: the run, and the one with half its time step
    whole: NveRun
    half: NveRun
    balance: EnergyBalance  # of the run
    half_jumps: np.ndarray  # energy that the flips of the other brought by step, eV
    limits: Sequence[PairThreshold]  # thresholds
    # largest difference of the run's energies from those of new objects, and what noise allows, eV
    stale: tuple[float, float]
    noise: NoiseFloor
    period: float  # of the fastest vibration, internal time

    def shares(self) -> dict[str, Drift]:
        """Energy drifts (meV/atom/ps): total, flips, integrator and other causes."""
        one, other = self.whole, self.half
        rest, elsewhere = self.balance.filled, self.balance.elsewhere
        flips = wandering(one.time, self.balance.jumps)
        half_flips = wandering(other.time, self.half_jumps)

        def total(ran: NveRun, jumps: Drift) -> Drift:
            # the error knows that the sum of jumps wanders
            fitted = drift(ran.time, ran.total)
            return Drift(fitted.slope, float(np.hypot(fitted.error, jumps.error)))

        # what a run keeps when flips and the rest are taken out of it is the integrator's
        kept = one.total - np.cumsum(self.balance.jumps + elsewhere) - np.cumsum(rest)
        halved = drift(other.time, other.total - np.cumsum(self.half_jumps))
        unflipped = drift(one.time, one.total - np.cumsum(self.balance.jumps))
        found = {
            "total": total(one, flips),
            "total, half the time step": total(other, half_flips),
            "flips": flips,
            **({"elsewhere": wandering(one.time, elsewhere)} if self.balance.hidden.jumps else {}),
            "rest": wandering(one.time, rest),
            "integrator": drift(one.time, kept),
            # second order: three quarters of it go with half the time step
            "integrator, by halving": unflipped.minus(halved).times(4 / 3),
        }
        factor = 1e3 * self.subject.units.time_factor / one.positions.shape[1]
        return {name: share.times(factor) for name, share in found.items()}

    def outcome(self, unknown: str) -> CheckResult:
        """Return the result of the check. `unknown` states why no pair thresholds are known."""
        shares = self.shares()
        numbers = self._numbers(shares)
        crossed, measured = len(self.balance.crossed), len(self.balance.measured)
        skipped = [("jumps of flips", unknown)] if unknown else []
        if measured < crossed and any(limit.order == 0 for limit in self.limits):
            why = f"{measured:,} were measured, the others have their mean"
            skipped.append((f"jumps of {crossed - measured:,} crossings", why))
        says = ["dynamics", *(f"dynamics_{name}" for name in _SOURCES if name in shares)]
        values = numbers | {name: shares[name].slope for name in _SOURCES if name in shares}
        values |= {"time_unit": self.subject.units.time, "ratio": abs(numbers["drift_ratio"])}
        limits = {
            "hidden_wander": (_WANDERS, ("HIDDEN_JUMPS", "STALE_DYNAMICS")),
            "stale": (self.stale[1], ("STALE_DYNAMICS",)),
        }
        recorded = {"energies": self.energy_rows(), "crossings": self.crossing_rows()}
        findings, tables = list(self._findings(shares, numbers)), self._tables(shares, numbers)
        return CheckResult(
            (says, values), findings, tables, [self._chart()], numbers, limits, skipped, recorded=recorded
        )

    def _numbers(self, shares: Mapping[str, Drift]) -> dict[str, Any]:
        one, units, atoms = self.whole, self.subject.units, self.whole.positions.shape[1]
        balance, jumps = self.balance, self.balance.hidden.jumps
        numbers = {
            "drift": shares["total"].slope, "drift_error": shares["total"].error,
            "drift_unit": f"m{units.energy}/atom/{units.time}",
            "drift_ratio": ratio(one.time, one.total, one.kinetic),
            "integrator_by_halving": shares["integrator, by halving"].slope,
            "timestep": one.timestep / units.time_factor, "steps": len(one.potential) - 1,
            "time": one.time[-1] / units.time_factor, "crossings": len(balance.crossed),
            "jumps_measured": len(balance.measured), "hidden_jumps": len(jumps),
            "largest_jump": max((abs(jump) for jump in balance.measured.values()), default=0.0),
            "largest_hidden_jump": max((abs(jump.energy) for jump in jumps), default=0.0),
            "rest_swing": float(np.ptp(np.cumsum(balance.filled))) / atoms, "stale": self.stale[0],
            "mean_kinetic": float(np.mean(one.kinetic)) / atoms,
        }  # fmt: skip
        # of kT, what the sum of jumps wanders by in a unit of time
        for name, brought in (("flips", balance.jumps), ("hidden", balance.elsewhere)):
            wander = np.sqrt(np.sum(brought**2) / numbers["time"]) / self.subject.kT
            numbers[f"{name}_wander"] = float(wander)
        for name in ("integrator", "flips", "rest"):
            numbers |= {name: shares[name].slope, f"{name}_error": shares[name].error}
        return numbers

    def _findings(self, shares: Mapping[str, Drift], numbers: Mapping[str, Any]) -> Iterator[Observed]:
        kT = self.subject.kT
        # what may go in a unit of time: a share of the thermal energy of an atom
        much = 1e3 * _MUCH * kT
        base = {"unit": numbers["drift_unit"], "time_unit": self.subject.units.time, "time": numbers["time"]}

        def values(name: str, **more: Any) -> dict[str, Any]:
            return {**base, "slope": shares[name].slope, "error": shares[name].error, **more}

        differs, allowed = self.stale
        old = differs > allowed
        if old:
            yield finding("STALE_DYNAMICS", "error", differs=Measured(differs, "energy", allowed))
        rest, total, flips = shares["rest"], shares["total"], shares["flips"]
        swing = numbers["rest_swing"] / kT
        drifts = rest.significant and abs(rest.slope) > 1e-2 * max(abs(total.slope), 1e-2 * much)
        if drifts or swing > _SWING:
            large = (drifts and abs(rest.slope) > 0.1 * much) or swing > 10 * _SWING
            severity = "error" if large or old else "warning"
            yield finding("NOT_CONSERVED", severity, "old" if old else None, **values("rest", swing=swing))

        size = numbers["flips_wander"]
        jump = Measured(numbers["largest_jump"], "energy", 2 * self.noise.allowed.energy, kT)
        if jump.found and size > _WANDERS:
            told = values("flips", crossings=numbers["crossings"], jump=jump, wander=size)
            severity = "error" if flips.significant and abs(flips.slope) > much else "warning"
            yield finding("FLIPS_CHANGE_ENERGY", severity, **told)
        hidden, size = self.balance.hidden, numbers["hidden_wander"]
        # those that an old list makes are reported as such
        if hidden.jumps and not old and size > _WANDERS:
            one, (k, times), (radius, passed) = shares["elsewhere"], hidden.rank, hidden.radius
            most = 0.5 * len(hidden.jumps)
            told = values(
                "elsewhere", candidates=len(hidden.candidates), searched=len(hidden.steps), k=k, times=times,
                share=hidden.share, jump=replace(jump, value=numbers["largest_hidden_jump"]), wander=size,
                places=len(hidden.jumps), at=radius, passed=passed,
            )  # fmt: skip
            severity = "error" if one.significant and abs(one.slope) > much else "warning"
            how = "cutoff" if passed > most else "tie" if times > most else None
            yield finding("HIDDEN_JUMPS", severity, how, **told)
        integrator = shares["integrator"]
        if integrator.significant and abs(integrator.slope) > much:
            halving = numbers["integrator_by_halving"]
            told = values("integrator", timestep=numbers["timestep"], halving=halving)
            yield finding("TIMESTEP", "info", **told)
        explained = max(abs(shares[name].slope) for name in _SOURCES if name in shares)
        if total.significant and abs(total.slope) > much and explained <= 0.5 * abs(total.slope):
            yield finding("DRIFT", "warning", **values("total"))

    def _tables(
        self, shares: Mapping[str, Drift], numbers: Mapping[str, Any]
    ) -> dict[str, list[dict[str, Any]]]:
        means, units = self.balance.means, self.subject.units
        flips = []
        for limit in self.limits:
            mine = [one for one in self.balance.crossed if one.threshold == limit]
            entered, jump = sum(one.entered for one in mine), 1e3 * means.get(limit, float("nan"))
            if mine:
                flips.append({
                    "pair": "-".join(limit.species), f"at ({LENGTH})": limit.radius, "entered": entered,
                    "left": len(mine) - entered, f"jump on entering (m{ENERGY})": jump,
                })  # fmt: skip
        drifts = [
            {
                "drift": name, f"slope ({numbers['drift_unit']})": share.slope, "standard error": share.error,
                # whether there is a drift is no verdict: a table marks what is False as wrong
                "significant": "yes" if share.significant else "no",
            }
            for name, share in shares.items()
        ]  # fmt: skip
        runs = {
            f"time step ({units.time})": numbers["timestep"], "steps": numbers["steps"],
            f"fastest vibration ({units.time})": self.period / units.time_factor,
            "kinetic energy of an atom, over 3/2 kT": numbers["mean_kinetic"] / (1.5 * self.subject.kT),
            "drift over scatter of the kinetic energy": numbers["drift_ratio"],
        }  # fmt: skip
        return {"Drift, and where it is from": drifts, "Flips of the run": flips, "The run": [runs]}

    def _chart(self) -> Chart:
        one, other = self.whole, self.half
        scale = 1e3 / one.positions.shape[1]
        lines = {
            "energy": one.total - one.total[0],
            "half the time step": other.total[::2] - other.total[0],
            "jumps of flips": np.cumsum(self.balance.jumps + self.balance.elsewhere),
            "forces that are no gradient": np.cumsum(self.balance.filled),
        }
        units = self.subject.units
        title, time = "Change of the energy during a run, and what explains it", one.time / units.time_factor
        curves = {name: (scale * line).tolist() for name, line in lines.items()}
        return Chart(title, f"time ({units.time})", f"change (m{ENERGY}/atom)", time.tolist(), curves)

    def energy_rows(self) -> dict[str, list[Any]]:
        """Return the columns of the table energies.parquet."""
        jumps, elsewhere = self.balance.jumps, self.balance.elsewhere
        unknown = np.full(len(self.half.potential), np.nan)
        parts: list[dict[str, Any]] = []
        for name, ran, brought, rest in (
            ("run", self.whole, jumps + elsewhere, self.balance.rest - elsewhere),
            ("half", self.half, self.half_jumps, unknown),
        ):
            count = len(ran.potential)
            entered, left = np.zeros((2, count), np.int64)
            for one in self.balance.crossed if name == "run" else ():
                (entered if one.entered else left)[one.step] += 1
            parts.append({
                "run": np.full(count, name), "step": np.arange(count), "time": ran.time,
                "potential": ran.potential, "kinetic": ran.kinetic, "total": ran.total,
                "entered": entered, "left": left, "jumps": brought, "rest": rest,
            })  # fmt: skip
        return {name: np.concatenate([part[name] for part in parts]).tolist() for name in parts[0]}

    def crossing_rows(self) -> dict[str, list[Any]]:
        """Return the columns of the table crossings.parquet."""
        crossed, measured = self.balance.crossed, self.balance.measured
        names = ("step", "i", "j", "rank", "entered", "distance", "margin")
        return {
            "run": ["run"] * len(crossed),
            **{name: [getattr(one, name) for one in crossed] for name in names},
            "threshold": [one.threshold.radius for one in crossed],
            "energy_jump": [measured.get(n, float("nan")) for n in range(len(crossed))],
        }


# -- runs ------------------------------------------------------------------------------------------


class _Bridge(Calculator):
    """An ASE calculator that saves structures on which the audited calculator fails."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, subject: CalculatorSubject):
        super().__init__()
        self.subject = subject

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties or ["energy"], system_changes)
        energy, forces = self.subject.both(cast(Atoms, self.atoms))
        self.results = {"energy": energy, "forces": forces}


def prepared(
    subject: CalculatorSubject,
    atoms: Atoms,
    held: RigidGroups | None,
    period: float,
    rng: np.random.Generator,
) -> Atoms:
    """Return a structure with thermal velocities. `period` is the period of the fastest vibration."""
    from ase import units

    # atoms at rest in their places take half of the kinetic energy into vibrations
    thermal = np.sqrt(subject.kT * float(np.mean(atoms.get_masses()))) * 2 * np.pi / period
    relaxed = rms(subject.forces(atoms)) < _RELAXED * thermal
    there = atoms.copy()
    if held is not None:
        there.set_constraint(held)
    kelvin = (2.0 if relaxed else 1.0) * subject.kT / units.kB
    MaxwellBoltzmannDistribution(there, temperature_K=kelvin, rng=rng)
    if len(there) > 1:
        Stationary(there)
    return there


def fitting_timestep(
    subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator, iterations: int = _POWER_ITERATIONS
) -> tuple[float, float]:
    """Estimate a time step and the shortest vibration period (or inf), in internal units."""
    roots = np.sqrt(atoms.get_masses())[:, None]
    mode = direction(len(atoms), rng)
    mode /= np.linalg.norm(mode)
    square = 0.0
    for _ in range(iterations):
        # mass-weighted second derivative along the mode, by a central difference of forces
        step = mode / roots
        size = 1e-3 / np.max(np.abs(step))
        back, forth = (subject.forces(displaced(atoms, sign * size * step)) for sign in (-1, 1))
        answer = (back - forth) / (2 * size * roots)
        square = float(np.linalg.norm(answer))
        if square == 0.0:
            break
        mode = answer / square
    period = 2 * np.pi / np.sqrt(square) if square > 0 else float("inf")
    fastest = 4 * np.sqrt(subject.kT / float(np.min(atoms.get_masses())))
    return min(period / _STEPS_A_PERIOD, _FURTHEST / fastest if fastest else float("inf")), period


def run(
    subject: CalculatorSubject,
    start: Atoms,
    timestep: float,
    steps: int,
    each: Callable[[int], None] = lambda step: None,
) -> tuple[NveRun, Atoms]:
    """Run molecular dynamics at constant energy with one calculator object.

    Args:
        start: structure with velocities and constraints; not modified.
        timestep: time step, internal time.

    Returns:
        the run, and the final structure with velocities.
    """
    atoms = start.copy()
    atoms.set_constraint(start.constraints)
    atoms.calc = _Bridge(subject)
    dynamics = VelocityVerlet(atoms, timestep=timestep)
    rows: list[tuple[Any, ...]] = []
    limit = _BLOWN_UP * (atoms.get_kinetic_energy() + len(atoms) * subject.kT)
    blown_up = False
    for step in range(steps + 1):
        if step:
            dynamics.step()
        kinetic = atoms.get_kinetic_energy()
        forces = atoms.get_forces(apply_constraint=False)
        rows.append((atoms.get_potential_energy(), kinetic, atoms.get_positions(), forces))
        each(step)
        if kinetic > limit:
            blown_up = True
            break
    potential, kinetics, positions, forces = (
        np.array(column, np.float64) for column in zip(*rows, strict=True)
    )
    atoms.calc = None
    return NveRun(start, timestep, potential, kinetics, positions, forces, blown_up), atoms


@dataclass
class RigidGroups:
    """ASE constraint that fixes all distances within groups, such as molecules.

    ASE's class FixBondLengths treats one bond at a time in Python. For water, RigidGroups is a hundred times
    faster.

    Source:
        H. C. Andersen, Rattle: a velocity version of the Shake algorithm, J. Comput. Phys. 52, 24 (1983).
    """

    # first, second: atoms of each bond, a row for each bond of a group
    first: Int[np.ndarray, "bonds groups"]
    second: Int[np.ndarray, "bonds groups"]
    lengths: Float[np.ndarray, "bonds groups"]  # Å

    def get_removed_dof(self, atoms: Atoms) -> int:
        """Return the number of constrained degrees of freedom."""
        return int(self.first.size)

    def adjust_positions(self, atoms: Atoms, new: Float[np.ndarray, "atoms 3"]) -> None:
        """Move atoms along their bonds until all bond lengths are restored."""
        old, share = atoms.positions, 1 / atoms.get_masses()

        def settled(i: np.ndarray, j: np.ndarray, length: np.ndarray) -> bool:
            before, now = old[i] - old[j], new[i] - new[j]
            off = np.sum(now**2, axis=1) - length**2
            pull = off / (2 * (share[i] + share[j]) * np.sum(before * now, axis=1))
            new[i] -= (pull * share[i])[:, None] * before
            new[j] += (pull * share[j])[:, None] * before
            return bool(np.max(np.abs(off) / length**2) < _TOLERANCE)

        self._sweep(settled)

    def adjust_momenta(self, atoms: Atoms, momenta: Float[np.ndarray, "atoms 3"]) -> None:
        """Remove the components of the momenta that would change a bond length."""
        share = 1 / atoms.get_masses()
        size = float(np.max(np.abs(momenta), initial=0.0)) * float(np.max(share))

        def settled(i: np.ndarray, j: np.ndarray, length: np.ndarray) -> bool:
            bond = atoms.positions[i] - atoms.positions[j]
            apart = momenta[i] * share[i][:, None] - momenta[j] * share[j][:, None]
            along = np.sum(apart * bond, axis=1)
            pull = along / ((share[i] + share[j]) * np.sum(bond**2, axis=1))
            momenta[i] -= pull[:, None] * bond
            momenta[j] += pull[:, None] * bond
            return bool(np.max(np.abs(along) / np.linalg.norm(bond, axis=1)) <= _TOLERANCE * size)

        self._sweep(settled)

    def _sweep(self, settled: Callable[[np.ndarray, np.ndarray, np.ndarray], bool]) -> None:
        for _ in range(_MOST_SWEEPS):
            # every bond, also where one before it was off
            done = [settled(*bond) for bond in zip(self.first, self.second, self.lengths, strict=True)]
            if all(done):
                return

    def adjust_forces(self, atoms: Atoms, forces: Float[np.ndarray, "atoms 3"]) -> None:
        """Leave the forces unchanged. Only the momenta are adjusted in constrained runs."""

    def todict(self) -> dict[str, Any]:
        """Return the constraint as a dictionary in ASE's format for constraints."""
        return {"name": "RigidGroups", "kwargs": {}}


def rigid(atoms: Atoms) -> RigidGroups | None:
    """Return a constraint on all distances within molecules. None without molecules."""
    size = group(atoms)
    if size is None:
        return None
    starts = np.arange(0, len(atoms), size)
    first, second = (members[:, None] + starts for members in np.triu_indices(size, 1))
    lengths = np.linalg.norm(atoms.positions[first] - atoms.positions[second], axis=2)
    return RigidGroups(first, second, lengths)
