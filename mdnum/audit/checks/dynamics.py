"""A short run at constant energy: how much of its energy drifts away, and to what it is due."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.audit.base import Chart, CheckResult, Observed, Progress, finding
from mdnum.audit.check import AuditCheck
from mdnum.audit.curve import SMOOTH
from mdnum.audit.energy import Drift, EnergyBalance, balance, crossings, drift, ratio, wandering
from mdnum.audit.noise import FEW, NoiseFloor, along_a_line, roomy
from mdnum.audit.nve import NveRun, at, fitting_timestep, prepared, rigid, run
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.audit.thresholds import PairThreshold, find_thresholds

#: Of a run where nobody says how many. A step takes some six calls: two in the run of half the time step,
#: warming up, work on the way.
_STEPS = 200
_COMPARED = 12
#: Share of the thermal energy of an atom that may drift away in a ps before a run is not one at constant
#: energy: within 100 ps all of it.
_MUCH = 1e-2
#: Of kT: a sum of jumps that wanders less in a unit of time is not reported.
_WANDERS = 1e-4
#: Of kT: energy of an atom that may come and go without a flip or the integrator.
_SWING = 1e-2
_SOURCES = ("integrator", "flips", "elsewhere", "rest")


class DynamicsCheck(AuditCheck):
    """Does a short run at constant energy keep its energy, and if not, why?

    Drift of the energy with a block error, separated into integrator, flips and the rest. What is left of
    the drift when flips and the work of the forces are taken out is the integrator's, and must fall to a
    quarter with half the time step, which a second run tests.
    """

    name, title, order = "dynamics", "Dynamics", 60
    needed_to = ("run",)
    seed = 0

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Two runs and where their energy went."""
        with subject.meter.limited():
            return self._ask(subject, progress)

    def _ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        rng = np.random.default_rng(self.seed)
        limits, unknown = _limits(subject)
        atoms = roomy(subject.atoms, FEW)
        held = rigid(atoms) if _only_molecules(subject) else None
        worker = subject.fresh()
        fitting, period = fitting_timestep(worker, atoms, rng)
        start = prepared(worker, atoms, held, period, rng)
        step = fitting if self.settings.timestep is None else self.settings.timestep
        if not np.isfinite(step):
            why = "no force and no thermal motion: there is nothing to integrate"
            return CheckResult(says=(["dynamics_nothing"], {}), skipped=[("a run", why)])
        count = self.settings.steps or _STEPS
        total = 3 * count + count // 4

        def each(before: int):
            return lambda reached: progress(before + reached, total, {"phase": "dynamics", "unit": "steps"})

        # from where it was given, a structure relaxes; that is no drift
        _, start = run(worker, start, step, count // 4, each(0))
        whole, _ = run(subject.fresh(), start, step, count, each(count // 4))
        if whole.blown_up:
            after = len(whole.potential) - 1
            values = {
                "after": after,
                "timestep": step / subject.units.time_factor,
                "time": subject.units.time,
            }
            return CheckResult(
                says=(["dynamics_blew_up"], values),
                findings=[finding("BLEW_UP", "error", **values)],
                numbers={"steps": after, "blew_up": True, "drift": None},
            )
        half, _ = run(subject.fresh(), start, step / 2, 2 * count, each(count + count // 4))
        probe = subject.fresh()
        noise = along_a_line(probe, at(start, start.positions), rng)
        progress(0, 0, {"phase": "accounting for the energy"})
        found = balance(probe, whole, start, limits, rng, noise.energy)
        # the other run's flips count only where they bring energy
        finer = crossings(half, start, limits) if any(one.order == 0 for one in limits) else []
        # largest difference of the run's energies from those of objects that saw nothing else
        places = np.unique(np.linspace(0, len(whole.potential) - 1, _COMPARED).astype(int))
        stale = max(
            abs(subject.fresh().energy(at(start, whole.positions[n])) - whole.potential[n]) for n in places
        )
        allowed = 40 * max(noise.energy, np.finfo(float).eps * float(np.max(np.abs(whole.potential))))
        runs = TwoRuns(
            subject, whole, half, found, found.by_means(finer, len(half.potential)), limits,
            (float(stale), allowed), noise, period,
        )  # fmt: skip
        return runs.outcome(unknown)


def _limits(subject: CalculatorSubject) -> tuple[list[PairThreshold], str]:
    """Thresholds, or why none are known."""
    try:
        # one at which no more than a third derivative jumps leaves no trace in a run
        found = [one for one in find_thresholds(subject) if one.order < SMOOTH or one.dies]
    except CalculatorError as error:
        return [], f"searching thresholds, the calculator {error.message}"
    return found, "" if found else "no threshold was found"


def _only_molecules(subject: CalculatorSubject) -> bool:
    """Whether the calculator takes whole molecules alone, whose inner distances it does not know."""
    if rigid(subject.atoms) is None:
        return False
    try:
        with only_trying(subject):
            subject.fresh().energy(subject.atoms[:-1])
    except CalculatorError:
        return True
    return False


def _wander(jumps: np.ndarray) -> float:
    return float(np.sqrt(np.sum(jumps**2)))


@dataclass(frozen=True)
class TwoRuns:
    """Two runs and where their energy went.

    Attributes:
        whole, half: the run, and the one with half its time step.
        balance: of the run.
        half_jumps: energy that the flips of the other brought by step, eV.
        limits: thresholds.
        stale: largest difference of the run's energies from those of new objects, and what noise allows, eV.
        period: of the fastest vibration, internal time.
    """

    subject: CalculatorSubject
    whole: NveRun
    half: NveRun
    balance: EnergyBalance
    half_jumps: np.ndarray
    limits: Sequence[PairThreshold]
    stale: tuple[float, float]
    noise: NoiseFloor
    period: float

    def shares(self) -> dict[str, Drift]:
        """Drift of all, of flips, of the rest, and of the integrator by either way, meV/atom/ps."""
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
        """What the check found.

        Args:
            unknown: why there is no threshold.
        """
        shares = self.shares()
        numbers = self._numbers(shares)
        unit = numbers["drift_unit"]
        crossed, measured = len(self.balance.crossed), len(self.balance.measured)
        skipped = [("jumps of flips", unknown)] if unknown else []
        if measured < crossed and any(limit.order == 0 for limit in self.limits):
            why = f"{measured:,} were measured, the others have their mean"
            skipped.append((f"jumps of {crossed - measured:,} crossings", why))
        says = ["dynamics", *(f"dynamics_{name}" for name in _SOURCES if name in shares)]
        values = {name: shares[name].slope for name in _SOURCES if name in shares}
        values |= {
            "time": numbers["time"], "time_unit": self.subject.units.time, "steps": numbers["steps"],
            "drift": numbers["drift"], "error": numbers["drift_error"], "unit": unit,
            "ratio": abs(numbers["drift_ratio"]),
        }  # fmt: skip
        return CheckResult(
            says=(says, values),
            findings=list(self._findings(shares, numbers)),
            tables=self._tables(shares, numbers),
            charts=[self._chart()],
            numbers=numbers,
            skipped=skipped,
            recorded={"energies": self.energy_rows(), "crossings": self.crossing_rows()},
        )

    def _numbers(self, shares: Mapping[str, Drift]) -> dict[str, Any]:
        one, units, atoms = self.whole, self.subject.units, self.whole.positions.shape[1]
        hidden = self.balance.hidden
        return {
            "drift": shares["total"].slope,
            "drift_error": shares["total"].error,
            "drift_unit": f"meV/atom/{units.time}",
            "drift_ratio": ratio(one.time, one.total, one.kinetic),
            "integrator": shares["integrator"].slope,
            "integrator_error": shares["integrator"].error,
            "integrator_by_halving": shares["integrator, by halving"].slope,
            "flips": shares["flips"].slope,
            "flips_error": shares["flips"].error,
            "rest": shares["rest"].slope,
            "rest_error": shares["rest"].error,
            "timestep": one.timestep / units.time_factor,
            "steps": len(one.potential) - 1,
            "time": one.time[-1] / units.time_factor,
            "crossings": len(self.balance.crossed),
            "jumps_measured": len(self.balance.measured),
            "largest_jump": max((abs(jump) for jump in self.balance.measured.values()), default=0.0),
            "hidden_jumps": len(hidden.jumps),
            "largest_hidden_jump": max((abs(jump.energy) for jump in hidden.jumps), default=0.0),
            "rest_swing": float(np.ptp(np.cumsum(self.balance.filled))) / atoms,
            "stale": self.stale[0],
            "mean_kinetic": float(np.mean(one.kinetic)) / atoms,
        }

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
            yield finding("STALE_DYNAMICS", "error", differs=differs, allowed=allowed)
        rest, total, flips = shares["rest"], shares["total"], shares["flips"]
        swing = numbers["rest_swing"] / kT
        drifts = rest.significant and abs(rest.slope) > 1e-2 * max(abs(total.slope), 1e-2 * much)
        if drifts or swing > _SWING:
            large = (drifts and abs(rest.slope) > 0.1 * much) or swing > 10 * _SWING
            severity = "error" if large or old else "warning"
            yield finding("NOT_CONSERVED", severity, "old" if old else None, **values("rest", swing=swing))
        size = _wander(self.balance.jumps) / np.sqrt(numbers["time"]) / kT
        if numbers["largest_jump"] > 100 * self.noise.energy and size > _WANDERS:
            more = {
                "crossings": numbers["crossings"],
                "jump": 1e3 * numbers["largest_jump"],
                "wander": float(size),
            }
            severity = "error" if flips.significant and abs(flips.slope) > much else "warning"
            yield finding("FLIPS_CHANGE_ENERGY", severity, **values("flips", **more))
        hidden = self.balance.hidden
        size = _wander(self.balance.elsewhere) / np.sqrt(numbers["time"]) / kT
        # those that an old list makes are reported as such
        if hidden.jumps and not old and size > _WANDERS:
            one, rank = shares["elsewhere"], hidden.rank
            tie = rank is not None and rank[1] > 0.5 * len(hidden.jumps)
            k, times = rank or (0, 0)
            more = {
                "candidates": len(hidden.candidates), "searched": len(hidden.steps), "share": hidden.share,
                "jump": 1e3 * numbers["largest_hidden_jump"], "wander": float(size), "k": k, "times": times,
                "places": len(hidden.jumps),
            }  # fmt: skip
            severity = "error" if one.significant and abs(one.slope) > much else "warning"
            yield finding("HIDDEN_JUMPS", severity, "tie" if tie else None, **values("elsewhere", **more))
        integrator = shares["integrator"]
        if integrator.significant and abs(integrator.slope) > much:
            more = {"timestep": numbers["timestep"], "halving": numbers["integrator_by_halving"]}
            yield finding("TIMESTEP", "info", **values("integrator", **more))
        explained = max(abs(shares[name].slope) for name in _SOURCES if name in shares)
        if total.significant and abs(total.slope) > much and explained <= 0.5 * abs(total.slope):
            yield finding("DRIFT", "warning", **values("total"))

    def _tables(
        self, shares: Mapping[str, Drift], numbers: Mapping[str, Any]
    ) -> dict[str, list[dict[str, Any]]]:
        means, units = self.balance.means, self.subject.units
        flips = []
        for place, limit in enumerate(self.limits):
            mine = [one for one in self.balance.crossed if one.threshold == place]
            if mine:
                flips.append(
                    {
                        "pair": "-".join(limit.species),
                        "at (Å)": limit.radius,
                        "entered": sum(one.entered for one in mine),
                        "left": sum(not one.entered for one in mine),
                        "jump on entering (meV)": 1e3 * means.get(place, float("nan")),
                    }
                )
        return {
            "Drift, and where it is from": [
                {
                    "drift": name,
                    f"slope ({numbers['drift_unit']})": share.slope,
                    "standard error": share.error,
                    # whether there is a drift is no verdict: a table marks what is False as wrong
                    "significant": "yes" if share.significant else "no",
                }
                for name, share in shares.items()
            ],
            "Flips of the run": flips,
            "The run": [
                {
                    f"time step ({units.time})": numbers["timestep"],
                    "steps": numbers["steps"],
                    f"fastest vibration ({units.time})": self.period / units.time_factor,
                    "kinetic energy of an atom, over 3/2 kT": numbers["mean_kinetic"]
                    / (1.5 * self.subject.kT),
                    "drift over scatter of the kinetic energy": numbers["drift_ratio"],
                }
            ],
        }

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
        return Chart(
            "Change of the energy during a run, and what explains it",
            f"time ({units.time})",
            "change (meV/atom)",
            (one.time / units.time_factor).tolist(),
            {name: (scale * line).tolist() for name, line in lines.items()},
        )

    def energy_rows(self) -> dict[str, list[Any]]:
        """Rows of energies.parquet."""
        jumps, elsewhere = self.balance.jumps, self.balance.elsewhere
        parts: list[dict[str, Any]] = []
        for name, ran, brought, rest in (
            ("run", self.whole, jumps + elsewhere, self.balance.rest - elsewhere),
            ("half", self.half, self.half_jumps, np.full(len(self.half.potential), np.nan)),
        ):
            count = len(ran.potential)
            entered, left = np.zeros((2, count), np.int64)
            for one in self.balance.crossed if name == "run" else ():
                (entered if one.entered else left)[one.step] += 1
            parts.append(
                {
                    "run": np.full(count, name), "step": np.arange(count), "time": ran.time,
                    "potential": ran.potential, "kinetic": ran.kinetic, "total": ran.total,
                    "entered": entered, "left": left, "jumps": brought, "rest": rest,
                }
            )  # fmt: skip
        return {name: np.concatenate([part[name] for part in parts]).tolist() for name in parts[0]}

    def crossing_rows(self) -> dict[str, list[Any]]:
        """Rows of crossings.parquet."""
        crossed, measured = self.balance.crossed, self.balance.measured
        names = ("step", "i", "j", "rank", "entered", "distance", "margin")
        return {
            "run": ["run"] * len(crossed),
            **{name: [getattr(one, name) for one in crossed] for name in names},
            "threshold": [self.limits[one.threshold].radius for one in crossed],
            "energy_jump": [measured.get(n, float("nan")) for n in range(len(crossed))],
        }
