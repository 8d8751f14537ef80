"""Measures by name: numbers that are derived from a run, with unit and statistical error."""

from __future__ import annotations

import ast
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, MdnumError
from mdnum.registry import Registry
from mdnum.sweeps.points import digest
from mdnum.systems.code import function

#: Number of blocks of a run, whose scatter gives the error of quantities that are not time averages.
_BLOCKS = 8
#: Number of bins of g(r), and its range as a share of half the width of the box.
_BINS, _REACH = 200, 0.98
#: Range of S(k) in units of the cube root of the density, which includes its first peak (about 7), and number
#: of reciprocal vectors per shell.
_WAVES, _VECTORS = 10.0, 300


Needs = Literal["series", "simulation", "frames"]


class Value(NamedTuple):
    """Value of a measure for one run."""

    value: float
    error: float = float("nan")  # standard error; nan where one run does not tell
    effective: float = float("nan")  # independent samples behind it


@dataclass(frozen=True)
class Sample:
    """Data of a run from which measures are computed.

    Attributes:
        series: values at each step, as in series.parquet.
        summary: summary of the run.
        atoms: number of atoms.
        k_B: Boltzmann's constant in the units of the run.
        folder: folder of the run, with its frames if a measure needs them.
    """

    series: Mapping[str, np.ndarray]
    summary: Mapping[str, Any]
    atoms: int
    k_B: float
    folder: Path
    volume: float = field(default=float("nan"))  # of a box that does not move, length³
    outcome: Any = None  # of the run; None where only its stored series is there
    opened: Callable[[], Any] | None = None  # makes the simulation

    @cached_property
    def simulation(self) -> Any:
        """The `Simulation` that was run, for measures that run it again."""
        assert self.opened is not None
        return self.opened()

    @cached_property
    def made(self) -> dict[Any, Any]:
        """Intermediate results that several measures of this run share, by name."""
        return {}

    @cached_property
    def frames(
        self,
    ) -> tuple[Float[np.ndarray, "frames atoms 3"], Float[np.ndarray, "frames 3 3"], np.ndarray]:
        """Unwrapped positions, lattice vectors as rows and times of the frames."""
        from ase.io import read

        found: Any = read(self.folder / "trajectory.traj", index=":")
        x = np.array([one.positions + one.info["images"] @ one.cell.array for one in found])
        return x, np.array([one.cell.array for one in found]), np.array([one.info["time"] for one in found])

    @property
    def volumes(self) -> np.ndarray:
        """Volume at each step, length³."""
        return self.series.get("volume", np.full(len(self.series["step"]), self.volume))


@dataclass(frozen=True)
class Measure:
    """A quantity that is derived from a run.

    Attributes:
        name: name that users write.
        unit: unit in terms of quantities, such as "energy" or "length²/time".
        title: description.
        of: function that returns its value.
        needs: "series", the time series of the run; "simulation", if the system must be run again; or
            "frames", the positions along the run and its outcome.
        physical: whether it is a physical result, not a property of the machine or of neighbor lists.
        world: "md" or "ball", the world of runs that have it.
        takes: description of the text after "=" in its name, such as "CHOICE"; `of` then has this text as a
            further argument, "" if it was not given.
        sources: files that it depends on in addition to those of every point, as `points.digest` takes them:
            a stored value is valid as long as these files are unchanged.
        check: function of the simulation, the number of steps and the argument, called before any run;
            raises InputError for an argument that does not exist.
    """

    name: str
    unit: str
    title: str
    of: Callable[..., Value]
    needs: Needs = "series"
    physical: bool = True
    world: Literal["md", "ball"] = "md"
    takes: str = ""
    sources: tuple[str, ...] = ()
    check: Callable[..., Any] | None = None

    @property
    def digest(self) -> str:
        """Digest of its source files; empty if there are none."""
        return digest(self.sources) if self.sources else ""


MEASURES: Registry[Measure] = Registry("measure", "mdnum.measures", kind=Measure)


def _measure(unit: str, title: str, *options: Any, **more: Any) -> Callable[..., Any]:
    def add(of: Callable[..., Value]) -> Callable[..., Value]:
        MEASURES.add(of.__name__, Measure(of.__name__, unit, title, of, *options, **more))
        return of

    return add


def _blocked(of: Callable[[slice], float], rows: int, blocks: int = _BLOCKS) -> Value:
    """Return a number computed from all rows, with its error from the scatter between blocks."""
    edges = np.linspace(0, rows, blocks + 1).astype(int)
    parts = np.array([of(slice(a, b)) for a, b in pairwise(edges) if b > a])
    error = parts.std(ddof=1) / len(parts) ** 0.5 if len(parts) > 1 else np.nan
    return Value(of(slice(0, rows)), float(error), float(len(parts)))


def correlated(series: Float[np.ndarray, "samples"]) -> tuple[float, float, float]:
    """Return the mean of a time series, its standard error, and its number of independent samples.

    Samples before equilibrium are omitted (`pymbar.timeseries.detect_equilibration`, Chodera 2016).
    """
    # its import says on the log that it will use jax in double precision, as mdnum does
    logging.getLogger("pymbar").setLevel(logging.ERROR)
    from pymbar.timeseries import detect_equilibration, statistical_inefficiency

    x = np.asarray(series, float)
    if len(x) < 4 or not np.isfinite(x).all():
        return (float(x.mean()) if len(x) else np.nan), np.nan, np.nan
    if np.ptp(x) <= 1e-14 * np.abs(x).max():
        return float(x[-1]), 0.0, float(len(x))
    # looked for in the first half: what is left of a run that was nearly all left out is an outlier
    begin, _, _ = detect_equilibration(x[: len(x) // 2], nskip=max(1, len(x) // 50))
    kept = x[int(begin) :]
    samples = max(len(kept) / float(statistical_inefficiency(kept)), 1.0)
    return float(kept.mean()), float(kept.std(ddof=1) / samples**0.5) if len(kept) > 1 else np.nan, samples


@_measure("energy", "potential energy per atom")
def energy(run: Sample) -> Value:
    """Time average of the potential energy per atom, energy, with its error from `correlated`."""
    return Value(*correlated(run.series["potential"] / run.atoms))


@_measure("temperature", "temperature")
def temperature(run: Sample) -> Value:
    """Time average of the kinetic temperature, temperature, with its error from `correlated`."""
    return Value(*correlated(run.series["temperature"]))


@_measure("pressure", "pressure")
def pressure(run: Sample) -> Value:
    """Time average of the virial pressure, pressure, with its error from `correlated`."""
    return Value(*correlated(run.series["pressure"]))


@_measure("1/length³", "atoms per volume")
def density(run: Sample) -> Value:
    """Time average of the number of atoms per volume, 1/length³, with its error from `correlated`."""
    return Value(*correlated(run.atoms / run.volumes))


@_measure("1/time", "flips per atom and time")
def flips(run: Sample) -> Value:
    """Time average of the flips per atom and time, 1/time, with its error from `correlated`."""
    each = (run.series["entered"] + run.series["left"])[1:]
    step = np.diff(run.series["time"])[:1]
    return Value(*correlated(each / run.atoms / step)) if len(each) else Value(np.nan)


@_measure("energy/time", "drift of the conserved energy per atom")
def drift(run: Sample) -> Value:
    """Return the slope of a line through the second half of the run; its error is the scatter of blocks."""
    rows = slice(len(run.series["time"]) // 2, None)
    time, kept = run.series["time"][rows], run.series["conserved"][rows] / run.atoms
    if len(time) < 2 * _BLOCKS:
        return Value(np.nan)
    at = np.array([part.mean() for part in np.array_split(time, _BLOCKS)])
    means = np.array([part.mean() for part in np.array_split(kept - kept[0], _BLOCKS)])
    (slope, _), covariance = np.polyfit(at, means, 1, cov=True)
    return Value(float(slope), float(covariance[0, 0] ** 0.5), float(_BLOCKS - 1))


@_measure("", "spread of the conserved energy over that of the kinetic energy")
def fluctuation(run: Sample) -> Value:
    """Standard deviation of the conserved energy over that of the kinetic energy, dimensionless.

    A line is subtracted from the conserved energy of the second half; the error is the scatter of 8 blocks.
    """
    half = slice(len(run.series["time"]) // 2, None)
    kept, kinetic = run.series["conserved"][half], run.series["kinetic"][half]

    def share(rows: slice) -> float:
        here, at = kept[rows], np.arange(len(kept[rows]))
        noise = here - np.polyval(np.polyfit(at, here, 1), at) if len(here) > 2 else here - here.mean()
        return float(noise.std() / kinetic.std()) if kinetic.std() > 0 else np.nan

    return _blocked(share, len(kept))


@_measure("", "heat capacity per atom, in k_B")
def heat_capacity(run: Sample) -> Value:
    """Heat capacity from fluctuations, by the formula for the ensemble of the run.

    At constant energy, fluctuations of the kinetic energy are used (Lebowitz, Percus, Verlet 1967); with a
    thermostat, fluctuations of the total energy.
    """
    half = slice(len(run.series["time"]) // 2, None)
    kinetic, total = run.series["kinetic"][half], run.series["total"][half]
    held = run.summary.get("dynamics") not in ("nve", None)
    free = 3 * run.atoms - 3

    def capacity(rows: slice) -> float:
        k = kinetic[rows]
        heat = 2 * k.mean() / free  # k_B T
        if held:
            return float(total[rows].var(ddof=1) / heat**2 / run.atoms)
        return float(1.5 / (1 - 2 * k.var(ddof=1) / (free * heat**2)))

    return _blocked(capacity, len(kinetic), 5)


@_measure("", "pairs that lists lost", physical=False)
def lost(run: Sample) -> Value:
    """Number of pairs within the cutoff that neighbor lists lacked, dimensionless; without an error."""
    return Value(float(run.summary["lost_pairs"]), 0.0, np.inf)


@_measure("steps/s", "speed of the run", physical=False)
def speed(run: Sample) -> Value:
    """Steps per second, 1/s, the median over neighbor lists; its error comes from the seeds alone."""
    return Value(float(run.summary["steps_per_second"] or np.nan))


def _peak(frames: Float[np.ndarray, "frames places"]) -> Value:
    """Return the height of the peak of an average over frames (over their second half if there are many)."""
    half = frames[len(frames) // 2 :] if len(frames) > 2 * _BLOCKS else frames
    peak = int(np.argmax(half.mean(axis=0)))
    return _blocked(lambda rows: float(half[rows, peak].mean()), len(half), min(_BLOCKS, len(half)))


@_measure("", "height of the first peak of g(r)", "frames")
def rdf(run: Sample) -> Value:
    """Height of the first peak of g(r), dimensionless; its error is the scatter of blocks of frames."""
    return _peak(radial_distribution(run)[0])


def radial_distribution(run: Sample) -> tuple[Float[np.ndarray, "frames bins"], Float[np.ndarray, "bins"]]:
    """Return g(r) of each frame and the centers of its bins, from MDAnalysis's pair search."""
    from MDAnalysis.lib.distances import capped_distance
    from MDAnalysis.lib.mdamath import triclinic_box

    x, cells, _ = run.frames
    widths = [1 / np.linalg.norm(np.linalg.inv(cell), axis=0) for cell in cells]
    edges = np.linspace(0, 0.5 * _REACH * min(map(min, widths)), _BINS + 1)
    shells = 4 / 3 * np.pi * np.diff(edges**3)
    rows = []
    for here, cell in zip(x, cells, strict=True):
        box = triclinic_box(*cell)
        flat = np.asarray(here @ np.linalg.inv(cell) % 1 @ cell, np.float32)
        _, distances = capped_distance(flat, flat, edges[-1], min_cutoff=1e-3, box=box)
        count = np.histogram(distances, edges)[0]
        ideal = run.atoms * (run.atoms - 1) / abs(np.linalg.det(cell)) * shells
        rows.append(count / ideal)
    return np.array(rows), 0.5 * (edges[1:] + edges[:-1])


@_measure("", "height of the highest peak of the structure factor S(k)", "frames")
def structure_factor(run: Sample) -> Value:
    """Height of the highest peak of S(k), dimensionless; its error is the scatter of blocks of frames."""
    return _peak(structure_factors(run)[0])


def structure_factors(run: Sample) -> tuple[Float[np.ndarray, "frames shells"], Float[np.ndarray, "shells"]]:
    """S(k) = |Σ exp(i k·x)|²/N of each frame, averaged over shells of reciprocal vectors, and their mean |k|.

    A shell is as wide as the shortest reciprocal vector of the first cell. In a shell with many vectors only
    some of them, evenly chosen, are used.
    """
    x, cells, _ = run.frames
    reciprocal = 2 * np.pi * np.linalg.inv(cells[0]).T
    largest = _WAVES * (run.atoms / abs(np.linalg.det(cells[0]))) ** (1 / 3)
    reach = np.floor(largest * np.linalg.norm(cells[0], axis=1) / (2 * np.pi)).astype(int)
    whole = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij"), -1).reshape(-1, 3)
    # -k has the same S
    whole = whole[len(whole) // 2 + 1 :]
    length = np.linalg.norm(whole @ reciprocal, axis=1)
    shell = np.rint(length / length.min()).astype(int)
    keep = length <= largest
    for one in np.unique(shell):
        inside = np.flatnonzero(keep & (shell == one))
        few = np.linspace(0, len(inside) - 1, min(len(inside), _VECTORS)).astype(int)
        keep[np.delete(inside, few)] = False
    _, at = np.unique(shell[keep], return_inverse=True)
    count, rows = np.bincount(at), []
    for here, cell in zip(x, cells, strict=True):
        # fractional coordinates: the vectors move with the box
        waves = np.exp(2j * np.pi * (here @ np.linalg.inv(cell)) @ whole[keep].T).sum(axis=0)
        rows.append(np.bincount(at, np.abs(waves) ** 2 / run.atoms) / count)
    return np.array(rows), np.bincount(at, length[keep]) / count


def _mean_square(x: Float[np.ndarray, "frames atoms 3"]) -> Float[np.ndarray, "lags"]:
    """Return the mean squared displacement for each lag, averaged over all atoms and time origins."""
    import MDAnalysis
    from MDAnalysis.analysis.msd import EinsteinMSD

    universe = MDAnalysis.Universe.empty(x.shape[1], trajectory=False)
    universe.load_new(np.asarray(x, np.float32))
    return np.asarray(EinsteinMSD(universe, fft=False).run(verbose=False).results.timeseries)


@_measure("length²", "mean squared displacement over half of the run", "frames")
def msd(run: Sample) -> Value:
    """Mean squared displacement of the atoms over the second half of the run, length².

    The displacement of the center is subtracted; the error is the standard error over atoms.
    """
    x, _, _ = run.frames
    if len(x) < 4:
        return Value(np.nan)
    moved = x[-1] - x[len(x) // 2]
    moved = np.sum((moved - moved.mean(axis=0)) ** 2, axis=1)
    # atoms are nearly independent of each other
    return Value(float(moved.mean()), float(moved.std(ddof=1) / len(moved) ** 0.5), float(len(moved)))


@_measure("length²/time", "self-diffusion coefficient", "frames")
def diffusion(run: Sample) -> Value:
    """Return a sixth of the slope of the mean squared displacement, at lags from 0.1 to 0.5 of each block."""
    x, _, time = run.frames
    x = x[len(x) // 4 :] - x[len(x) // 4 :].mean(axis=1, keepdims=True)
    if len(x) < 40:
        return Value(np.nan)
    pace = float(time[1] - time[0])

    def slope(rows: slice) -> float:
        found = _mean_square(x[rows])
        lags = np.arange(len(found))[max(1, len(found) // 10) : max(3, len(found) // 2)]
        return float(np.polyfit(lags * pace, found[lags], 1)[0] / 6)

    blocks = [slope(slice(k, k + len(x) // 4)) for k in range(0, len(x) - len(x) // 4 + 1, len(x) // 4)]
    return Value(
        float(np.mean(blocks)), float(np.std(blocks, ddof=1) / len(blocks) ** 0.5), float(len(blocks))
    )


# --- the ball: a run is what it is, and has no statistical error ----------------------------------------


@_measure("length", "mean height at the end", world="ball")
def final_height(run: Sample) -> Value:
    """Height at the end of the run, averaged over the balls, length; exact, without an error."""
    return Value(float(run.series["mean_height"][-1]), 0.0, np.inf)


@_measure("", "energy at the end as a share of that at the start", world="ball")
def energy_kept(run: Sample) -> Value:
    """Energy at the end of the run divided by that at its start, dimensionless; without an error."""
    return Value(float(run.series["energy"][-1] / run.series["energy"][0]), 0.0, np.inf)


@_measure("", "contacts that begin, per ball", world="ball")
def bounces(run: Sample) -> Value:
    """Number of contacts that begin during the run, per ball, dimensionless; without an error."""
    return Value(float(run.series["entered"].sum() / run.atoms), 0.0, np.inf)


@_measure("", "solver iterations per step", physical=False, world="ball")
def iterations(run: Sample) -> Value:
    """Mean number of solver iterations per step, dimensionless; without an error."""
    return Value(float(run.series["iterations"][1:].mean()), 0.0, np.inf)


#: Default measures, by world.
USUAL: Mapping[str, tuple[str, ...]] = {
    "md": ("energy", "pressure", "temperature", "drift", "flips"),
    "ball": ("final_height", "energy_kept", "bounces"),
}


def chosen(words: Sequence[str], world: str) -> list[Measure]:
    """Return the measures with the given names.

    Raises:
        InputError: no such measure in this world, or a measure is repeated.
    """
    if twice := [word for word in words if list(words).count(word) > 1]:
        raise InputError(f"the measure {twice[0]} is given twice", remedy="Give each measure once")
    measures = [_named(word) for word in words]
    if other := [measure.name for measure in measures if measure.world != world]:
        known = ", ".join(name for name in MEASURES.shipped if MEASURES[name].world == world)
        raise InputError(f"{other[0]} is not a measure of this system", remedy=f"Choose from {known}")
    return measures


def _named(word: str) -> Measure:
    """Return the measure with a name such as "energy", "fork=order" or "mine.py:height"."""
    if ".py:" in word:
        return _of_file(word)
    name, _, argument = word.partition("=")
    found = MEASURES[name]
    if argument and not found.takes:
        raise InputError(f"--measure {word}: {name} takes no argument", remedy=f"Give {name}")
    if not found.takes:
        return found
    check = found.check and partial(found.check, argument=argument)
    return replace(found, name=word, of=partial(found.of, argument=argument), check=check)


def _of_file(word: str) -> Measure:
    """Return the function in a Python file: from an outcome to value, (value, error) or with samples, too.

    Raises:
        InputError: code is not allowed, the function does not exist, or the file imports other files of its
            folder, whose changes a digest of the file would not detect.
    """
    place, _, name = word.rpartition(":")
    file = Path(place).absolute()
    of = function(f"{file.name}:{name}", file.parent, where="--measure")
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [("." * node.level) + (node.module or "")]
        for one in names:
            top = one.partition(".")[0]
            if not top or any((file.parent / end).exists() for end in (f"{top}.py", f"{top}/__init__.py")):
                raise InputError(
                    f"the file imports {one} from its folder, so changes of {one} would not be noticed",
                    where=str(file), remedy="Put all code that the measure needs into one file",
                )  # fmt: skip

    def value(run: Sample) -> Value:
        found = of(run.outcome)
        if not isinstance(found, tuple):
            return Value(float(found))
        # an error without its number of samples is taken as known
        return Value(*map(float, (*found, 1e6) if len(found) == 2 else found))

    return Measure(f"{file}:{name}", "", f"{name} of {file.name}", value, "frames", sources=(str(file),))


def measured(measures: Sequence[Measure], run: Sample) -> dict[str, dict[str, Any]]:
    """Return the values of measures by name, or the reason if there is no value."""
    found: dict[str, dict[str, Any]] = {}
    for one in measures:
        try:
            value = one.of(run)
        except OSError:
            raise
        except Exception as error:
            why = str(error) if isinstance(error, MdnumError) else f"{type(error).__name__}: {error}"
            found[one.name] = {"value": None, "why": why, "digest": one.digest}
            continue
        if np.isfinite(value.value):
            found[one.name] = {"value": float(value.value), "error": value.error,
                               "effective": value.effective, "digest": one.digest}  # fmt: skip
        else:
            found[one.name] = {"value": None, "why": "too few steps or frames", "digest": one.digest}
    return found
