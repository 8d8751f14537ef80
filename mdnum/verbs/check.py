"""`mdnum check`: comparison of energies, pairs or dynamics with other codes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.plain import plain
from mdnum.report.finding import Finding, Texts, Verdict, conclude, fill
from mdnum.report.words import listed
from mdnum.trajectories.frame import Box, Frame, far_out
from mdnum.units import Measured
from mdnum.verbs import Reply

if TYPE_CHECKING:
    from mdnum.references.energy_check import DynamicsReport, EnergyReport
    from mdnum.references.pair_check import PairsReport
    from mdnum.systems import System
    from mdnum.systems.simulation import Simulation
    from mdnum.units import Units

TEXTS, RUN_TEXTS = Texts(__file__), Texts(Path(__file__).with_name("run.py"))
# ratio of temperatures from which on the one of a structure is another than the one requested
_OTHER = 3.0
# thermal motion along an axis in a time step that is too long, over the mean distance between atoms
_FAST = 0.1


@dataclass(frozen=True)
class Checked:
    """Result of a comparison of a system with other codes."""

    report: Any  # what was compared, with `ok` and rows for people
    verdict: Verdict  # its findings
    question: str = "energy"  # or "pairs", "dynamics"
    seconds: float | None = None  # that it took

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of the comparison, for the command's JSON output."""
        worst = {"worst": self.report.worst} if hasattr(self.report, "worst") else {}
        head = {"status": "complete" if self.report.ok else "failed", "seconds": self.seconds}
        found = {**head, "ok": self.report.ok, **vars(self.report), **worst}
        return plain(self.verdict.judged(f"check-{self.question}", found))


def check(question: str, system: Simulation | System | str | Path, *, allow_code: bool = False) -> Checked:
    """Compare the energies, the pairs or the dynamics of a system with other codes.

    Example:
        >>> mdnum.check("energy", "argon/liquid-864").report.ok
        True

    Args:
        question: "energy", "pairs" or "dynamics".
        system: a simulation, a system, a shipped name or the path of a system file.
        allow_code: whether Python code that the system file names may be executed.

    Raises:
        InputError: the system cannot be run.
    """
    from mdnum.references.energy_check import check_dynamics, check_energy
    from mdnum.references.pair_check import check_pairs
    from mdnum.systems import build, code

    with code.allow_code(allow_code):
        simulation = build(system)
    checks: Mapping[str, tuple[Callable[[Any], Any], Callable[[Any], Iterator[Finding]]]] = {
        "energy": (partial(check_energy, lammps=True), energy_findings),
        "pairs": (check_pairs, pair_findings),
        "dynamics": (check_dynamics, dynamics_findings),
    }
    compare, findings = checks[question]
    began = perf_counter()
    report: Any = compare(simulation)
    headline = TEXTS("agrees" if report.ok else "differs", system=simulation.name)
    evidence = would_show(report, simulation.units) if report.ok else ()
    verdict = conclude(findings(report), evidence, headline=headline, best="good", judged=True)
    return Checked(report, verdict, question, perf_counter() - began)


def _replied(
    question: str, system: str, overrides: Mapping[str, str] | None = None, allow_code: bool = False
) -> Reply:
    """Execute `mdnum check` for energy, pairs or dynamics."""
    from mdnum.systems import load

    loaded: Any = load(system, overrides, world="md")
    checked = check(question, loaded, allow_code=allow_code)
    title = fill(TEXTS.entries["titles"][question], {**vars(loaded.units), "system": system})
    shown = [(title, checked.report.rows()), *checked.verdict.findings, checked.verdict.text]
    return Reply(checked.summary, shown, "complete" if checked.report.ok else "failed")


energy, pairs, dynamics = (partial(_replied, question) for question in ("energy", "pairs", "dynamics"))


def structure_findings(system: System) -> Iterator[Finding]:
    """Yield findings on unexpected properties of a structure, such as its temperature."""
    atoms = system.atoms
    frame = Frame(0, 0.0, atoms.positions, Box(np.asarray(atoms.cell), np.asarray(atoms.pbc)))
    if (far := far_out(frame)) is not None:
        yield TEXTS.finding("ATOM_FAR", atom=far[0], why=far[2])
    draw, units, masses = system.draw, system.units, atoms.get_masses()
    temperature = draw.temperature
    if not draw.drawn:
        velocities = draw.velocities(masses, units, atoms.get_velocities())
        twice = float((masses[:, None] * velocities**2).sum())
        temperature = twice / (3 * len(masses) * units.k_B)
        yield from temperature_findings(temperature, draw.temperature, len(masses), units.temperature)
    elif names := system.ignored:
        yield TEXTS.finding("VELOCITIES_IGNORED", names=listed([f"“{name}”" for name in names]))
    if all(atoms.pbc):
        timestep, spacing = system.spec.dynamics.timestep, (atoms.get_volume() / len(atoms)) ** (1 / 3)
        temperature = max(temperature, draw.temperature)
        moved = timestep * units.time_factor * math.sqrt(units.k_B * temperature / masses.min())
        if moved > _FAST * spacing:
            yield TEXTS.finding(
                "TIME_STEP_LONG", timestep=timestep, temperature=temperature, moved=moved, spacing=spacing,
                time=units.time, length=units.length, degree=units.temperature,
            )  # fmt: skip


def temperature_findings(start: float, requested: float, atoms: int, unit: str) -> Iterator[Finding]:
    """Yield a warning if the velocities have a temperature far from the requested one.

    A temperature ratio up to three gives no warning, as an ideal crystal loses half of its kinetic energy.
    For few atoms, a temperature difference within the statistical scatter gives no warning.
    """
    ratio = start / requested if requested > 0 else 1.0
    if 1 / _OTHER <= ratio <= _OTHER or abs(ratio - 1) <= 5 * math.sqrt(2 / (3 * atoms)):
        return
    values = {"start": start, "requested": requested, "unit": unit}
    more, factor = (["factor"], (1 / ratio) ** 0.5) if start > 0 else ([], 0.0)
    yield RUN_TEXTS.finding("OTHER_TEMPERATURE", *more, factor=factor, **values)


def would_show(report: Any, units: Units) -> Iterator[str]:
    """Yield a sentence for each difference from other codes, with its tolerance."""
    from mdnum.references.energy_check import FORCE, ROUNDINGS

    if frames := getattr(report, "frames", ()):
        if not report.conversion.startswith("none"):
            yield TEXTS("converted", **vars(report))
        worst = max(frames, key=lambda frame: frame.force_max)
        narrow = report.precision != "float64"
        floor = ROUNDINGS * worst.force_expected if narrow else FORCE * worst.force_scale
        force = Measured(worst.force_max, f"{units.energy}/{units.length}", floor, worst.force_scale)
        yield TEXTS("force_within", force=force)
    if hasattr(report, "position"):
        off = Measured(report.position[-1], units.length, report.tolerance)
        yield TEXTS("position_within", off=off, steps=len(report.position) - 1)


def energy_findings(report: EnergyReport) -> Iterator[Finding]:
    """Yield findings from a comparison of energies, forces and stresses with a reference."""
    from mdnum.references.ase_models import ENERGY, ITSELF
    from mdnum.references.energy_check import LAMMPS

    wrong = [frame for frame in report.frames if not frame.ok]
    if wrong:
        worst = max(wrong, key=lambda frame: frame.force_rel)
        third = "lammps" if report.third == LAMMPS else "third"
        variants = [third] * (worst.energy_third is not None) + ["ambiguous"] * bool(worst.ambiguous)
        yield TEXTS.finding("ASE_DISAGREES", *variants, reference=report.reference, **vars(worst))
    if not report.is_ase:
        own = {ITSELF: ["own"], ENERGY: ["energy"]}.get(report.reference, [])
        worst = max(report.frames, key=lambda frame: frame.energy_third or 0.0)
        own += ["lammps"] * (report.third == LAMMPS) + ["untranslated"] * bool(report.untranslated)
        energy, force = worst.energy_third, worst.force_third
        yield TEXTS.finding("NOT_ASE", *own, energy=energy, force=force, operation=report.untranslated)
    if report.precision != "float64":
        yield TEXTS.finding(
            "NARROW_PRECISION",
            precision=report.precision,
            energy=max(frame.energy_roundings for frame in report.frames),
            force=max(frame.force_roundings for frame in report.frames),
        )


def dynamics_findings(report: DynamicsReport) -> Iterator[Finding]:
    """Yield findings from a comparison of a trajectory with ASE."""
    if not report.ok:
        yield TEXTS.finding(
            "DYNAMICS_DIFFER", *["sudden"] * (report.sudden is not None), steps=len(report.position) - 1,
            off=report.position[-1], tolerance=report.tolerance, sudden=report.sudden,
        )  # fmt: skip
    if not report.is_ase:
        yield TEXTS.finding("NOT_ASE", "dynamics")


def pair_findings(report: PairsReport) -> Iterator[Finding]:
    """Yield findings from a comparison of the pairs of several neighbor searches."""
    for one in report.results:
        if one.verdict in ("differs", "failed"):
            code = "PAIRS_DIFFER" if one.verdict == "differs" else "SEARCH_FAILED"
            variants = ["ours"] * one.ours
            yield TEXTS.finding(code, *variants, **{**vars(one), "effective": None})
    borderline = [f"{one.name} {one.borderline}" for one in report.results if one.borderline]
    if borderline:
        yield TEXTS.finding("PAIRS_AT_THE_CUTOFF", searches=listed(borderline))
    if report.decided_exactly:
        yield TEXTS.finding("PAIRS_AMBIGUOUS", pairs=report.decided_exactly)
