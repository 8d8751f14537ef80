"""Two files of one run, or of two that separate for a known reason: shifts, velocities, laws of growth."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pytest
from ase import units
from ase.build import bulk
from ase.calculators.lj import LennardJones
from ase.io import write
from ase.md.verlet import VelocityVerlet

import mdnum
from mdnum.store import RunFolder
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.readers import open_trajectory
from mdnum.trajectories.separation import common_shift, displacements, growth
from mdnum.verbs.frame import Outcome

DATA = Path(__file__).parents[1] / "trajectories" / "data"
SHIFT = np.array([3.0, -7.0, 40.0])


def compared(tmp_path: Path, a: Any, b: Any, **options: Any) -> Outcome:
    """What is said of two files, or of the frames that are written into two."""
    paths = []
    for name, one in zip("ab", (a, b), strict=True):
        if not isinstance(one, Path):
            write(tmp_path / f"{name}.traj", one)
            one = tmp_path / f"{name}.traj"
        paths.append(one)
    out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
    return mdnum.flips(*paths, **{"cutoffs": [5.0], "report": False, "out": out, **options})


def codes(found: Outcome) -> dict[str, Any]:
    return {one.code: one for one in found.verdict.findings}


def moved(frames: list[ase.Atoms], by: Any) -> list[ase.Atoms]:
    """Copies of frames with by(n, atoms) added to all positions."""
    copies = [one.copy() for one in frames]
    for n, one in enumerate(copies):
        one.positions = one.positions + by(n, one)
    return copies


class Wrong(LennardJones):
    """Lennard-Jones with a constant added to every component of every force, eV/Å."""

    def __init__(self, error: float):
        super().__init__(sigma=3.405, epsilon=0.01032, rc=6.0, smooth=True)
        self.error = error

    def calculate(self, *args: Any, **options: Any) -> None:
        super().calculate(*args, **options)
        forces = self.results["forces"]
        self.results["forces"] = forces + self.error * np.random.default_rng(5).normal(size=forces.shape)


def run(start: ase.Atoms, frames: int, *, every: int = 10, error: float = 0.0, time: float = 0.0) -> list:
    atoms, kept = start.copy(), []
    atoms.calc = Wrong(error)
    dynamics = VelocityVerlet(atoms, 5.0 * units.fs)

    def keep() -> None:
        one = atoms.copy()
        one.info["time"] = time + dynamics.nsteps * 0.005
        kept.append(one)

    dynamics.attach(keep, interval=every)
    dynamics.run((frames - 1) * every)
    return kept


@cache
def liquid() -> tuple[ase.Atoms, list[ase.Atoms]]:
    """A start and a run of hot argon."""
    atoms = bulk("Ar", "fcc", a=5.9, cubic=True) * (2, 2, 2)
    rng = np.random.default_rng(1)
    atoms.rattle(0.3, rng=rng)
    atoms.set_momenta(rng.normal(0, np.sqrt(atoms.get_masses()[:, None] * units.kB * 250), (32, 3)))
    start = run(atoms, 2, every=300)[-1]
    return start, run(start, 120)


# ---- origins


@pytest.mark.parametrize("order", [1, -1])
def test_lengths_and_fractions_of_one_run_are_the_same_positions(tmp_path: Path, order: int) -> None:
    files = [DATA / f"breathing_box_{one}.lammpstrj" for one in ("lengths", "fractions")][::order]
    for a, b in zip(*(open_trajectory(one).frames() for one in files), strict=True):
        np.testing.assert_allclose(displacements(a, b)[0], 0, atol=2e-8)
        np.testing.assert_allclose(a.box.origin, b.box.origin, atol=0)
    found = compared(tmp_path, *files)
    assert found.summary["beyond"] is None and found.summary["shift"] is None
    assert found.summary["last"]["furthest"] < 2e-8 and found.verdict.tone != "warning"


TILTED = (
    "ITEM: TIMESTEP\n{step}\nITEM: NUMBER OF ATOMS\n30\nITEM: BOX BOUNDS {bounds}\nITEM: ATOMS id {columns}\n"
)


@pytest.mark.parametrize("general", [False, True])
def test_tilted_boxes_have_their_corner(tmp_path: Path, general: bool) -> None:
    rng = np.random.default_rng(4)
    fractions, paths = rng.uniform(0, 1, (30, 3)), []
    for name in ("x y z", "xs ys zs"):
        text = ""
        for step in range(4):
            matrix = np.array([[11.0, 0, 0], [2.5, 12.0, 0], [-3.0, 1.25, 10.0]]) * (1 + 0.01 * step)
            corner, tilt = np.array([-20.0, 7.0, 31.0]) - step, matrix[[1, 2, 2], [0, 0, 1]]
            if general:
                rows = np.column_stack([matrix, corner])
                bounds = "abc origin pp pp pp"
            else:
                xy, xz, yz = tilt
                low = corner + np.minimum([min(xy, xz, xy + xz), yz, 0], 0)
                high = corner + np.diag(matrix) + np.maximum([max(xy, xz, xy + xz), yz, 0], 0)
                rows, bounds = np.column_stack([low, high, tilt]), "xy xz yz pp pp pp"
            bounds += "".join("\n" + " ".join(f"{one:.16e}" for one in row) for row in rows)
            numbers = fractions if "s" in name else corner + fractions @ matrix
            text += TILTED.format(step=step, bounds=bounds, columns=name)
            text += "".join(f"{k + 1} {' '.join(map(repr, row))}\n" for k, row in enumerate(numbers.tolist()))
        paths.append(tmp_path / f"{name[:2].strip()}.lammpstrj")
        paths[-1].write_text(text)
    for a, b in zip(*(open_trajectory(one).frames() for one in paths), strict=True):
        np.testing.assert_allclose(a.positions, b.positions, atol=1e-12)
    assert compared(tmp_path, *paths).summary["beyond"] is None


# ---- common shifts


def centered(n: int, atoms: ase.Atoms) -> np.ndarray:
    return -atoms.get_center_of_mass()


def wrapped(n: int, atoms: ase.Atoms) -> np.ndarray:
    other = atoms.copy()
    other.translate([5.9, 5.9, 5.9])
    other.wrap()
    return other.positions - atoms.positions


@pytest.mark.parametrize(
    ("by", "first", "constant"),
    [
        (lambda n, atoms: SHIFT, 0, True),
        (lambda n, atoms: 0.001 * SHIFT * n, 1, False),
        (lambda n, atoms: SHIFT * (n >= 20), 20, True),
        (centered, 0, None),
        (wrapped, 0, True),
        (lambda n, atoms: atoms.cell.array.sum(axis=0) / 2, 0, True),
    ],
)
@pytest.mark.parametrize("pbc", [True, False, (True, False, True)])
def test_a_shift_of_all_atoms_is_no_difference(
    tmp_path: Path, by: Any, first: int, constant: bool | None, pbc: Any
):
    frames = moved(liquid()[1][:40], lambda n, atoms: 0.0)
    for one in frames:
        one.pbc = pbc
    if by is wrapped and pbc is not True:
        pytest.skip("wrapping moves atoms where the box does not repeat")
    found = compared(tmp_path, frames, moved(frames, by))
    summary = found.summary
    assert summary["beyond"] is None and summary["shift"] == first
    assert all(one["first"] is None for one in summary["rules"])
    assert codes(found)["SHIFT"].severity == "info" and found.verdict.tone != "warning"
    table = RunFolder.open(found.folder).read("apart")
    assert table["furthest"].max() < 1e-10
    if constant is not None:
        values = codes(found)["SHIFT"].values
        assert bool(values["same"]) == constant


def test_what_else_differs_is_measured_without_the_shift(tmp_path: Path) -> None:
    start, frames = liquid()
    start, frames = start.copy(), frames[:40]
    start.positions[3, 0] += 1e-4
    others = run(start, len(frames))
    plain = compared(tmp_path, frames, others).summary
    shifted = compared(tmp_path, frames, moved(others, lambda n, atoms: 0.01 * SHIFT * n)).summary
    assert plain["shift"] is None and shifted["shift"] == 1 and shifted["beyond"] == 0
    assert [one["first"]["frame"] for one in plain["rules"]] == [
        one["first"]["frame"] for one in shifted["rules"]
    ]
    assert shifted["last"]["furthest"] == pytest.approx(plain["last"]["furthest"], rel=0.5)


def test_one_atom_or_half_of_them_is_no_common_shift(tmp_path: Path) -> None:
    frames = liquid()[1][:12]
    for atoms in (1, 10, 16):
        found = compared(
            tmp_path, frames, moved(frames, lambda n, one, k=atoms: np.outer(np.arange(32) < k, SHIFT / 9))
        )
        assert found.summary["shift"] is None and found.summary["beyond"] == 0


def test_a_shift_is_found_on_the_other_side_of_the_box() -> None:
    rng = np.random.default_rng(0)
    box = Box(np.array([[9.0, 0, 0], [4.0, 8.0, 0], [1.0, -3.0, 7.0]]), np.ones(3, bool))
    x = rng.uniform(0, 30, (50, 3))
    for _ in range(20):
        shift = rng.uniform(-30, 30, 3)
        y = x + shift + rng.normal(0, 0.3, x.shape) + rng.integers(-2, 3, (50, 3)) @ box.matrix
        off = common_shift(Frame(0, 0.0, x, box), Frame(0, 0.0, y, box)) - shift
        fractions = np.linalg.solve(box.matrix.T, off)
        assert np.linalg.norm((fractions - np.rint(fractions)) @ box.matrix) < 0.5


# ---- why two runs separate


def test_a_constant_wrong_force_has_no_e_folding_time(tmp_path: Path) -> None:
    start = liquid()[0]
    frames, others = (run(start, 80, every=1, error=one) for one in (0.0, 1e-7))
    found = compared(tmp_path, frames, others, cutoffs=[4.3])
    grown = found.summary["rules"][0]["growth"]["before"]
    assert grown["law"] == "power" and grown["exponent"] == pytest.approx(2.0, abs=0.25)
    # velocities agree at the frame where the two branch: it is not the start that differs
    assert found.summary["velocities"] is None and found.summary["velocities_same"] == 0
    assert any("power of time" in one for one in found.verdict.evidence)
    assert not any("factor of e" in one for one in found.verdict.evidence)


def test_chaos_grows_exponentially(tmp_path: Path) -> None:
    start, frames = liquid()
    start = start.copy()
    start.positions[3, 0] += 1e-9
    grown = compared(tmp_path, frames, run(start, 120), cutoffs=[4.3]).summary["rules"][0]["growth"]
    laws = [one["law"] for one in grown.values() if one is not None and one["r2"] > 0.8]
    assert "exponential" in laws and "power" not in laws


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize(
    ("law", "exponent"), [("power", 1.0), ("power", 2.0), ("power", 3.0), ("exponential", None)]
)
@pytest.mark.parametrize("hidden", [False, True])
def test_laws_of_growth(law: str, exponent: float | None, noise: float, hidden: bool) -> None:
    rng = np.random.default_rng(6)
    time = np.arange(100) * 0.1
    gone = np.maximum(time - 2.05, 0)
    length = 1e-5 * gone**exponent if exponent else 1e-9 * np.exp(1.5 * gone) * (gone > 0)
    length = length * np.exp(noise * rng.normal(size=100))
    if hidden:
        # what a file rounds away is not seen
        length = np.where(length > np.percentile(length, 40), length, 0.0)
    first = float(time[length > 0][0])
    found = growth(time, length, 1.0, (0.0, first))
    # from the end of noisy data alone the two are not distinguished, and neither is claimed
    assert found is not None and found.law in {law, "either" if hidden and noise else law}
    if found.law == "either":
        return
    if exponent:
        assert found.exponent == pytest.approx(exponent, abs=0.5 + noise)
    else:
        assert found.rate == pytest.approx(1.5, abs=0.1)


RESTARTS = [
    (lambda p, rng: 0 * p, "zero", None, None),
    (lambda p, rng: rng.normal(0, p.std(), p.shape), "other", 0.0, 0.0),
    (lambda p, rng: 0.5 * p, "other", 0.5, 1.0),
    (lambda p, rng: -p, "other", -1.0, -1.0),
    (lambda p, rng: p + 0.3 * rng.normal(0, p.std(), p.shape), "other", 1.0, 0.96),
    # a common motion, which is no difference of the runs
    (lambda p, rng: p - 2 * p.mean(axis=0) + 0.3, None, None, None),
]


@pytest.mark.parametrize(
    ("change", "kind", "factor", "correlation", "joined"),
    [
        *((*one, True) for one in RESTARTS),
        # a file that begins with its restart: missing velocities are another matter there, the rest is alike
        (*RESTARTS[0], False),
        *(pytest.param(*one, False, marks=pytest.mark.nightly) for one in RESTARTS[1:]),
    ],
)
def test_a_restart_with_other_velocities_is_named(
    tmp_path: Path,
    change: Any,
    kind: str | None,
    factor: float | None,
    correlation: float | None,
    joined: bool,
) -> None:
    frames, at = liquid()[1][:40], 20
    start = frames[at].copy()
    start.set_momenta(change(start.get_momenta(), np.random.default_rng(2)))
    again = run(start, 20, time=frames[at].info["time"])
    # the whole run in both files, or the restart alone
    a, b = (frames, frames[:at] + again) if joined else (frames[at:], again)
    found = compared(tmp_path, a, b)
    told = found.summary["velocities"]
    assert ("VELOCITIES" in codes(found)) == (kind is not None)
    assert not any("velocities agree too" in one for one in found.verdict.evidence)
    if kind is None:
        assert told is None and found.summary["shift"] is not None
        return
    assert told is not None and told["kind"] == kind and told["frame"] == at * joined
    if kind == "other":
        exact = abs(correlation or 0.0) == 1.0
        assert told["factor"] == pytest.approx(factor, abs=1e-6 if exact else 0.1)
        assert told["correlation"] == pytest.approx(correlation, abs=1e-6 if exact else 0.1)
    if kind == "zero":
        assert told["side"] == "B"
        # and where nothing was written before the first step; what is written less often is not missing
        del b[at * joined].arrays["momenta"]
        told = compared(tmp_path, b, a).summary["velocities"]
        assert (told or {}).get("side") == (None if joined else "A")


def test_velocities_of_one_run_agree_to_the_digits_of_the_files(tmp_path: Path) -> None:
    frames = liquid()[1][:12]
    path = tmp_path / "short.extxyz"
    copies = moved(frames, lambda n, one: 0.0)
    for one in copies:
        one.set_momenta(np.round(one.get_momenta(), 5))
    write(path, copies)
    found = compared(tmp_path, frames, path)
    assert found.summary["velocities"] is None and found.summary["velocities_same"] == len(frames) - 1
