"""A run at constant energy in words: drift, its sources, findings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.audit.base import Curve, Part
from mdnum.audit.drift import Drift, ratio
from mdnum.audit.energy_ledger import Result, mean_jumps
from mdnum.references.findings import finding

#: Share of the thermal energy of an atom that may drift away in a ps before a run is not one at constant
#: energy: within 100 ps all of it.
_MUCH = 1e-2
#: Of kT: a sum of jumps that wanders less in a unit of time is not told.
_WANDERS = 1e-4
#: Of kT: energy of an atom that may come and go without a flip or the integrator.
_SWING = 1e-2


def part(result: Result, name: str, period: float, seconds: float, unknown: str) -> Part:
    """What the check says.

    Args:
        result: two runs and where their energy went.
        name: of the check.
        period: of the fastest vibration, internal time.
        seconds: the check took.
        unknown: why there is no threshold.
    """
    words = _Words(result)
    shares = {what: one.times(words.per_atom) for what, one in result.shares().items()}
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


class _Words:
    """A result in words, tables and curves."""

    def __init__(self, result: Result):
        self.result = result
        units = getattr(result.subject, "units", None)
        self.reduced = units is not None and units.name == "lj"
        self.time = units.time if units is not None else "ps"
        self.factor = units.time_factor if units is not None else 98.22694788464064
        self.energy = "ε" if self.reduced else "eV"
        self.unit = f"m{self.energy}/atom/{self.time}"
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
            "hidden_jumps": len(ledger.hidden.jumps),
            "largest_hidden_jump": max((abs(one.energy) for one in ledger.hidden.jumps), default=0.0),
            "rest_swing": float(np.ptp(np.cumsum(ledger.filled))) / self.atoms,
            "stale": self.result.stale[0],
            "mean_kinetic": float(np.mean(one.kinetic)) / self.atoms,
        }

    def says(self, shares: Mapping[str, Drift]) -> str:
        numbers = self.numbers(shares)
        total = shares["total"]
        parts = ", ".join(
            f"{shares[word].slope:+.2g} from {words}" for word, words in _SOURCES.items() if word in shares
        )
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
                "the strain of the cell must fit into the skin.",
            )
        rest = shares["rest"]
        swing = numbers["rest_swing"] / result.subject.kT
        drifts = rest.there and abs(rest.slope) > 1e-2 * max(abs(shares["total"].slope), 1e-2 * much)
        if drifts or swing > _SWING:
            large = (drifts and abs(rest.slope) > 0.1 * much) or swing > 10 * _SWING
            yield finding(
                "NOT_CONSERVED",
                "error" if large or differs > allowed else "warning",
                "the forces do work that the energy does not know of",
                f"{rest.slope:+.3g} ± {rest.error:.1g} {self.unit} of the drift, and changes of the energy "
                "by up "
                f"to {swing:.2g} kT an atom on the way, are neither from flips nor from the integrator: "
                "along the "
                "run, energy gained and work done do not add up.",
                "See forces and curl: a force that is not the derivative of the energy"
                + (", and a list that is out of date." if differs > allowed else "."),
            )
        flips = shares["flips"]
        size = _wander(result.ledger.jumps) / np.sqrt(numbers["time"]) / result.subject.kT
        if numbers["largest_jump"] > 100 * result.noise.energy and size > _WANDERS:
            yield finding(
                "FLIPS_CHANGE_ENERGY",
                "error" if flips.there and abs(flips.slope) > much else "warning",
                "every flip at a threshold changes the energy of a run",
                f"{numbers['crossings']} crossings in {numbers['time']:.3g} {self.time} brought "
                f"{flips.slope:+.3g} ± {flips.error:.1g} {self.unit}, by jumps of up to "
                f"{1e3 * numbers['largest_jump']:.3g} m{self.energy}; their sum wanders by {size:.2g} kT in "
                f"the first {self.time}.",
                "Switch the interaction off smoothly before its cutoff, or shift it to zero there.",
            )
        yield from self._hidden(shares, differs > allowed)
        total, integrator = shares["total"], shares["integrator"]
        if integrator.there and abs(integrator.slope) > much:
            yield finding(
                "TIMESTEP",
                "info",
                "the time step is long for this structure",
                f"{integrator.slope:+.3g} ± {integrator.error:.1g} {self.unit} come from the integrator at "
                f"{numbers['timestep']:.3g} {self.time} ({shares['integrator, by halving'].slope:+.3g} by "
                "halving it).",
                "Use a shorter one: --timestep.",
            )
        sources = [abs(shares[word].slope) for word in _SOURCES if word in shares]
        explained = max(sources) > 0.5 * abs(total.slope)
        if total.there and abs(total.slope) > much and not explained:
            yield finding(
                "DRIFT",
                "warning",
                "the energy drifts",
                f"{total.slope:+.3g} ± {total.error:.1g} {self.unit}, and neither flips nor forces nor the "
                "integrator account for most of it.",
                "Run longer (--steps) to see whether it stays.",
            )

    def _hidden(self, shares: Mapping[str, Drift], stale: bool) -> Iterator[dict[str, str]]:
        """Jumps that no pair threshold explains; those that an old list makes are told as such."""
        hidden, numbers = self.result.ledger.hidden, self.numbers(shares)
        if not hidden.jumps or stale:
            return
        kT = self.result.subject.kT
        size = _wander(self.result.ledger.elsewhere) / np.sqrt(numbers["time"]) / kT
        if size <= _WANDERS:
            return
        looked = len(hidden.steps or {})
        tie = ""
        if hidden.rank is not None and hidden.rank[1] > 0.5 * len(hidden.jumps):
            k, times = hidden.rank
            tie = (
                f" At {times} of the {len(hidden.jumps)} places found, the {k}-th and the next neighbor of "
                "an atom change places."
            )
        one = shares["elsewhere"]
        yield finding(
            "HIDDEN_JUMPS",
            "error" if one.there and abs(one.slope) > 1e3 * _MUCH * kT else "warning",
            "the energy of a run jumps where no pair threshold is",
            f"Of {len(hidden.candidates)} steps whose energy does not add up, {looked} were looked into: "
            f"{100 * hidden.share:.0f} % of what is missing comes at single places of the way, by up to "
            f"{1e3 * numbers['largest_hidden_jump']:.3g} m{self.energy}, and not at a distance at which two "
            f"atoms alone show a jump.{tie} Together they bring {one.slope:+.3g} ± {one.error:.1g} "
            f"{self.unit}; their sum wanders by {size:.2g} kT in the first {self.time}.",
            "Look for a cap on the number of neighbors, a choice of the nearest, or an angle's own cutoff.",
        )

    def tables(self, shares: Mapping[str, Drift], period: float) -> dict[str, list[dict[str, Any]]]:
        numbers = self.numbers(shares)
        energies = [
            {"drift": what, self.unit: one.slope, "standard error": one.error, "told from zero": one.there}
            for what, one in shares.items()
        ]
        means = mean_jumps(self.result.ledger.crossed, self.result.ledger.measured)
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
        lines = {
            "energy": (one.total - one.total[0]) * scale,
            "half the time step": (other.total[::2] - other.total[0]) * scale,
            "jumps of flips": np.cumsum(self.result.ledger.jumps + self.result.ledger.elsewhere) * scale,
            "forces that are no gradient": np.cumsum(self.result.ledger.filled) * scale,
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
        if measured < crossed and any(limit.order == 0 for limit in self.result.limits):
            found.append(
                (
                    f"jumps of {crossed - measured:,} crossings",
                    f"{measured:,} were measured, the others are told by their mean",
                )
            )
        return found


_SOURCES = {
    "integrator": "the integrator",
    "flips": "flips",
    "elsewhere": "jumps where no pair threshold is",
    "rest": "neither",
}


def _answer(value: Any) -> Any:
    # whether a drift is there is no verdict: a table marks what is False as wrong
    return ("yes" if value else "no") if isinstance(value, bool) else value


def _wander(jumps: Float[np.ndarray, "steps"]) -> float:
    return float(np.sqrt(np.sum(jumps**2)))
