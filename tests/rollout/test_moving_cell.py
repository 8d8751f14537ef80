"""The box belongs to the state of a row: an integrator that moves it, against all pairs in numpy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import ase.io
import jax
import numpy as np
import pytest
from ase.stress import full_3x3_to_voigt_6_stress
from gradient_problems import everything
from moving_box import Drifting, Flat, Forgetful, Pressed, Resting, Strained
from rollout.harness import liquid, run
from rollout.test_resume import assert_goes_on, assert_same
from small_systems import LENNARD_JONES, crystal, make

import mdnum
from mdnum.errors import FolderError, InputError, NumericalError
from mdnum.forks.exact.program import unsupported
from mdnum.forks.linearized import tangents
from mdnum.forks.processes import variants
from mdnum.gradients import Problem, method
from mdnum.md import cell as cells
from mdnum.md.cell import Cell
from mdnum.numerics import PrecisionPolicy
from mdnum.rollout.engine import NARROW, Engine, Start, first_state, resume_point, unwrapped
from mdnum.rollout.flips import PairRecorder, decided_pairs, true_pairs
from mdnum.rollout.program import MdProgram
from mdnum.store import RunFolder
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation

R_CUT, TIMESTEP, STEPS = 2.0, 0.004, 100


def moving(
    integrator: type = Strained, atoms=None, *, cutoff: str = "hard", steps: int = STEPS, **options: Any
) -> Simulation:
    """A dense fluid of 108 atoms whose box moves."""
    dynamics = {
        Strained: {"stretch": -0.25, "shear": 0.4},
        Forgetful: {"stretch": -0.25, "shear": 0.4},
        Flat: {"stretch": 0.1, "shear": 0.3},
        Pressed: {"pressure": 8.0, "stiffness": 0.02},
        Drifting: {},
    }.get(integrator, {})
    dynamics |= options.pop("dynamics", {})
    given = {"timestep": TIMESTEP, "temperature": 1.0, "skin": 0.3, "seed": 3, "save_every": 10} | options
    return mdnum.simulation(
        liquid() if atoms is None else atoms,
        mdnum.LennardJones(1.0, 1.0),
        mdnum.Cut(cutoff, R_CUT),
        units="lj",
        integrator=integrator,
        dynamics=dynamics,
        name=integrator.__name__.lower(),
        steps=steps,
        **given,
    )


def deformation(simulation: Simulation, step: int, volume: float, virial: float, v: np.ndarray):
    """What the integrators of `moving_box` do, written again: the deformation, and velocities after it."""
    own: Any = simulation.integrator
    if isinstance(own, Pressed):
        kinetic = 0.5 * float(np.sum(v**2))
        excess = (2 * kinetic + virial) / (3 * volume) - float(own.pressure)
        growth = 1 + TIMESTEP * float(own.stiffness) * excess
        return growth * np.eye(3), v / growth
    if type(own) is Drifting:
        return np.eye(3), v
    a, b = TIMESTEP * float(own.stretch), TIMESTEP * float(own.shear)
    if isinstance(own, Flat):
        return np.array([[1 + a, b, 0], [0, 1 + a, 0], [0, 0, 1]]), v
    if step % 100 >= 50:
        a, b = -a, -b
    return np.array([[1 + a, b, 0], [0, 1 + a, -0.5 * b], [0.5 * b, 0, 1 + a]]), v


class AllPairs:
    """The same dynamics from all pairs and all images near, without a list and without wrapping."""

    def __init__(self, simulation: Simulation):
        self.simulation = simulation
        self.x, self.v = simulation.positions.copy(), simulation.velocities.copy()
        self.matrix, self.step = np.asarray(simulation.cell.matrix).copy(), 0
        axes = [(-1, 0, 1) if flag else (0,) for flag in simulation.pbc]
        self.images = np.array(list(product(*axes)))
        self.i, self.j = np.triu_indices(len(self.x), 1)

    def forces(self):
        """Pairs inside as keys, forces, energy and virial."""
        fractional = self.x @ np.linalg.pinv(self.matrix) * np.array(self.simulation.pbc)
        x = self.x - np.floor(fractional) @ self.matrix
        shifts = self.images @ self.matrix
        d = (x[self.j] - x[self.i])[:, None, :] + shifts
        r2 = np.sum(d * d, axis=2)
        k, image = np.nonzero(r2 < R_CUT**2)
        d, r2 = d[k, image], r2[k, image]
        six = 1 / r2**3
        energy, pull = 4 * (six**2 - six), 24 * (2 * six**2 - six) / r2
        force = np.zeros_like(x)
        np.add.at(force, self.i[k], -pull[:, None] * d)
        np.add.at(force, self.j[k], pull[:, None] * d)
        keys = self.i[k] * len(x) + self.j[k]
        assert len(np.unique(keys)) == len(keys), "a pair is inside by two of its images"
        return set(keys.tolist()), force, float(energy.sum()), float(np.sum(pull * r2))

    def row(self) -> dict[str, Any]:
        """The row of the next step, and on to the one after it."""
        inside, force, potential, virial = self.forces()
        if self.step:
            self.v = self.v + 0.5 * TIMESTEP * force
        made = {
            "x": self.x, "v": self.v, "cell": self.matrix, "inside": inside, "potential": potential,
            "virial": virial, "kinetic": 0.5 * float(np.sum(self.v**2)),
        }  # fmt: skip
        v = self.v + 0.5 * TIMESTEP * force
        volume = abs(np.linalg.det(self.matrix))
        by, after = deformation(self.simulation, self.step, volume, virial, v)
        self.x, self.v, self.matrix = (self.x + TIMESTEP * v) @ by, after, self.matrix @ by
        self.step += 1
        return made


def slab():
    """A fluid with a free axis, whose box has no lattice vector there."""
    atoms = liquid()
    matrix = atoms.cell.array
    matrix[2] = 0.0
    atoms.set_cell(matrix)
    atoms.pbc = (True, True, False)
    return atoms


CASES = {
    "shrinks and shears": lambda: moving(),
    "grows and shears": lambda: moving(dynamics={"stretch": 0.3, "shear": -0.3}),
    "from a tilted box": lambda: moving(atoms=liquid(tilt=True), skin=0.2),
    "a free axis": lambda: moving(Flat, slab()),
    "follows the pressure": lambda: moving(Pressed),
    "a blind rule, every step": lambda: moving(rebuild=(1, 0, False)),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.nightly] * (k not in (0, 4))) for k, name in enumerate(CASES)],
)
def test_every_step_is_that_of_all_pairs_in_its_own_box(name):
    simulation = CASES[name]()
    judge, recorder, inside, builds = AllPairs(simulation), PairRecorder(simulation), None, 0
    first = np.asarray(simulation.cell.matrix)
    for segment in Engine(simulation, STEPS, rows=False).segments():
        ledger, pairs = recorder.flips(segment), recorder.counts(segment)
        builds += segment.opens
        for row in range(segment.rows):
            step, expected = segment.first + row, judge.row()
            box = segment.cell_of(row)
            assert np.allclose(box.matrix, expected["cell"], rtol=1e-12, atol=1e-14), step
            for column in ("potential", "kinetic", "virial"):
                seen = segment.rows_of(column)[row]
                assert seen == pytest.approx(expected[column], rel=1e-8, abs=1e-8), (step, column)
            assert len(expected["inside"]) == pairs[row]
            x = unwrapped(box.matrix, segment.unsorted("x", row), segment.unsorted("images", row))
            start = unwrapped(first, *(np.asarray(a).T for a in first_state(simulation).state[1:4:2]))
            offset = (start - simulation.positions) @ np.linalg.pinv(first) @ box.matrix
            assert np.abs(x - offset - expected["x"]).max() < 1e-8, step
            assert set(decided_pairs(simulation, segment, row).tolist()) == expected["inside"], step
            at = ledger.step == step
            keys = ledger.i[at] * simulation.atoms + ledger.j[at]
            flipped = set() if inside is None else inside ^ expected["inside"]
            assert sorted(keys.tolist()) == sorted(flipped), step
            assert {k for k, now in zip(keys.tolist(), ledger.entered[at], strict=True) if now} == (
                flipped & expected["inside"]
            )
            for k, distance in zip(keys.tolist(), ledger.distance[at], strict=True):
                d = expected["x"][k % simulation.atoms] - expected["x"][k // simulation.atoms]
                shifts = judge.images @ expected["cell"]
                d -= (
                    np.rint(d @ np.linalg.pinv(expected["cell"]))
                    * np.array(simulation.pbc)
                    @ expected["cell"]
                )
                assert distance == pytest.approx(np.linalg.norm(d + shifts, axis=1).min(), rel=1e-8)
            inside = expected["inside"]
    assert judge.step == STEPS + 1 and builds >= 3
    assert not np.allclose(box.matrix, first, rtol=1e-3)


@pytest.mark.parametrize(
    "policy",
    [
        PrecisionPolicy(),
        pytest.param(PrecisionPolicy(state="float32", force="float32"), marks=pytest.mark.nightly),
    ],
)
def test_a_list_that_is_kept_gives_the_bits_of_one_rebuilt_at_every_step(policy):
    """With sums that do not depend on their order; and the list serves for several steps."""
    options: dict[str, Any] = {"reduction": "exact", "precision": policy}
    kept, fresh = moving(**options), moving(rebuild=(1, 0, False), **options)
    runs = []
    for simulation in (kept, fresh):
        rows, builds, recorder = [], 0, PairRecorder(simulation)
        for segment in Engine(simulation, STEPS).segments():
            builds += segment.opens
            ledger = recorder.flips(segment)
            assert not recorder.missed
            doubtful = recorder.doubtful(segment)
            for row in range(segment.rows):
                numbers = [segment.rows_of(name)[row] for name in ("potential", "kinetic", "virial")]
                now = ledger.step == segment.first + row
                flips = np.stack([ledger.i[now], ledger.j[now]], axis=1).tolist()
                x = segment.unsorted("x", row)
                rows.append((x.tobytes(), segment.rows_of("cell")[row].tobytes(), numbers[1:], flips))
                close = doubtful.step == segment.first + row
                assert (np.abs(doubtful.margin[close]) <= doubtful.bound[close]).all()
                true = true_pairs(simulation.in_row(segment.cell_of(row)), x)
                assert np.array_equal(decided_pairs(simulation, segment, row), true)
        runs.append((rows, builds))
    assert runs[0][0] == runs[1][0]
    assert runs[1][1] == STEPS + 1 and 3 < runs[0][1] < STEPS / 3


def test_a_rule_that_forgets_the_strain_loses_a_pair_and_the_look_back_says_so(tmp_path, monkeypatch):
    atoms, shrinking = liquid(density=0.5, rattle=0.02), {"stretch": -1.0, "shear": 0.0}
    options: dict[str, Any] = {"temperature": 0.3, "atoms": atoms, "dynamics": shrinking}
    sound = run(moving(**options), out=tmp_path / "sound").summary
    monkeypatch.setattr(cells, "strain_loss", lambda reference, now, r_list: 0.0)
    planted = run(moving(Forgetful, **options), out=tmp_path / "planted").summary
    assert sound["count_mismatches"] == sound["lost_pairs"] == 0 and sound["algebra_residual"] == 0
    assert planted["rebuilds"] < sound["rebuilds"] and planted["count_mismatches"] > 0


def test_the_skin_used_counts_strain_and_motion(tmp_path):
    """Atoms at rest in a box that shrinks: the list lives until the strain alone has used its skin."""
    shrinking = {"stretch": -0.5, "shear": 0.0}
    simulation = moving(atoms=crystal(rattle=0.0), temperature=0.0, dynamics=shrinking, skin=0.2)
    by, r_list = 1 - 0.5 * TIMESTEP, R_CUT + 0.2
    (life,) = (step for step in range(50) if (1 - by**step) * r_list > 0.2 >= (1 - by ** (step - 1)) * r_list)
    seen = {}
    for segment in Engine(simulation, 49).segments():
        seen |= {(segment.built, segment.first + k): one for k, one in enumerate(segment.rows_of("moved"))}
    assert {built for built, _ in seen} == {0, life}
    for (built, step), moved in seen.items():
        assert moved == pytest.approx(0.5 * (1 - by ** (step - built)) * r_list, abs=1e-9)


def test_a_run_that_was_stopped_goes_on_in_its_box(tmp_path, monkeypatch):
    """To the bit; in the box of step 0 it is another run."""
    simulation = moving(steps=120)
    whole = run(simulation, out=tmp_path / "whole"), RunFolder.open(tmp_path / "whole")
    assert_goes_on(whole, simulation, simulation, "cells", tmp_path, monkeypatch)


_KILLED = """
import os, signal
from rollout.test_moving_cell import moving
from rollout.harness import run
from mdnum.store import RunFolder
RunFolder.checkpoint_due = lambda self: True
def progress(step, steps, info):
    if step >= 60:
        os.kill(os.getpid(), signal.SIGKILL)
run(moving(), out={out!r}, progress=progress)
"""


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_in_its_box(tmp_path):
    whole = run(moving(), out=tmp_path / "whole"), RunFolder.open(tmp_path / "whole")
    tests = Path(__file__).parents[1]
    here = {**os.environ, "PYTHONPATH": f"{tests}{os.pathsep}{tests / 'support'}"}
    code = _KILLED.format(out=str(tmp_path / "run"))
    killed = subprocess.run([sys.executable, "-c", code], env=here, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert_same(whole, (run(moving(), resume=tmp_path / "run"), RunFolder.open(tmp_path / "run")))


def test_a_folder_has_the_box_of_every_frame_and_the_volume_of_every_step(tmp_path):
    """As a user runs it: frames, series, and ASE's energies and stresses in the boxes of the frames."""
    simulation = moving(cutoff="switched")
    made: Any = mdnum.run(simulation, out=tmp_path / "run")  # type: ignore[arg-type]
    assert made.summary["ase"]["ok"] and made.summary["energy_budget_closes"]
    assert made.summary["pressure"]["impulsive"] is None
    segments = Engine(simulation, STEPS).segments()
    boxes = [segment.cell_of(row) for segment in segments for row in range(segment.rows)]
    series = RunFolder.open(tmp_path / "run").read("series")
    assert np.allclose(series["volume"], [box.volume for box in boxes], rtol=1e-12)
    assert np.ptp(series["volume"]) > 1
    frames: Any = ase.io.read(tmp_path / "run" / "trajectory.traj", index=":")
    assert len(frames) == 11
    for atoms in frames:
        step = atoms.info["step"]
        assert np.array_equal(atoms.cell.array, boxes[step].matrix)
        here = simulation.evaluate(atoms.positions, atoms.cell.array)
        assert atoms.get_potential_energy() == pytest.approx(here.energy, rel=1e-12)
        assert np.allclose(atoms.get_stress(), full_3x3_to_voigt_6_stress(here.stress), rtol=1e-10)
        volume = float(atoms.get_volume())
        both = 2 * series["kinetic"][step] - np.trace(here.stress) * volume
        assert series["pressure"][step] == pytest.approx(both / (3 * volume), rel=1e-9)


def test_flips_are_split_into_what_the_box_and_what_motion_in_it_did(tmp_path):
    """From frames of every step alone: positions relative to the box, put into that of the step before."""
    summary = run(moving(steps=60, save_every=1), out=tmp_path / "run").summary
    folder = RunFolder.open(tmp_path / "run")
    flips, series = folder.read("flips"), folder.read("series")
    frames: Any = ase.io.read(tmp_path / "run" / "trajectory.traj", index=":")
    caused = np.zeros(61, int)
    for step, i, j, entered, distance, by_box in zip(
        *(flips[name] for name in ("step", "i", "j", "entered", "distance", "by_box")), strict=True
    ):
        now, then = frames[step], frames[step - 1]
        relative = now.get_scaled_positions()[j] - now.get_scaled_positions()[i]
        relative -= np.rint(relative)
        moved = np.linalg.norm(relative @ then.cell.array)  # after motion in the box, before its deformation
        assert distance == pytest.approx(np.linalg.norm(relative @ now.cell.array), rel=1e-12)
        assert by_box == pytest.approx(distance - moved, abs=1e-12)
        assert (then.get_distance(i, j, mic=True) < R_CUT) != entered == (distance < R_CUT)
        caused[step] += (moved < R_CUT) != entered
    assert np.array_equal(series["by_box"], caused) and summary["flips_by_box"] == caused.sum()
    assert 20 < caused.sum() < 0.5 * len(flips["step"])


def test_a_box_that_does_not_move_is_recorded_nowhere(tmp_path):
    simulation = moving(Drifting)
    run(simulation, out=tmp_path / "run")
    folder = RunFolder.open(tmp_path / "run")
    assert not {"volume", "by_box"} & {*folder.read("series"), *folder.read("flips")}
    (segment, *_) = Engine(simulation, 10).segments()
    assert segment.record.cell.nbytes == 0 and len(segment.start.cells) == 1
    assert segment.cell_of(0) is segment.cell_of(3)
    assert np.array_equal(segment.cell_of(0).matrix, simulation.cell.matrix)


def test_a_checkpoint_without_a_box_has_that_of_the_simulation(tmp_path):
    """Folders that were written before a state had its box."""
    simulation = moving(Drifting)
    (first, *_) = Engine(simulation, 40).segments()
    arrays = resume_point(first).to_arrays()
    assert "state_cells" in arrays
    assert np.array_equal(arrays["state_cells"], [simulation.cell.matrix, simulation.cell.inverse])
    old = {name: array for name, array in arrays.items() if "cell" not in name}
    ends = []
    for given in (arrays, old):
        *_, last = Engine(simulation, 40, start=Start.from_arrays(given, simulation)).segments()
        ends.append(np.asarray(last.state.x).tobytes())
    assert ends[0] == ends[1]


@pytest.mark.nightly
def test_two_runs_are_forked_in_their_boxes(tmp_path):
    """Separations against positions unwrapped in the boxes of their rows; own decisions change no bit."""
    a = moving(cutoff="switched", steps=60)
    b = replace(a, positions=a.positions + 1e-7 * np.random.default_rng(1).standard_normal((108, 3)))
    free = [
        [
            unwrapped(
                segment.cell_of(row).matrix, segment.unsorted("x", row), segment.unsorted("images", row)
            )
            for segment in Engine(one, 60).segments()
            for row in range(segment.rows)
        ]
        for one in (a, b)
    ]
    apart = [np.sqrt(np.max(np.sum((one - other) ** 2, axis=1))) for one, other in zip(*free, strict=True)]
    found: dict[str, list[float]] = {"B": [], "B|A": []}
    programs = MdProgram(a), MdProgram(b)
    for rows in programs[0].lockstep(programs[1], 60, forward=True, back=True, guard=None):
        for name, kept in found.items():
            kept.extend(rows.separation[name])
    assert np.allclose(found["B"], apart, rtol=1e-6) and np.allclose(found["B|A"][0], apart[0], rtol=1e-6)
    assert max(apart) < 1e-4
    for rows in programs[0].lockstep(programs[0], 60, forward=True, back=False, guard=None):
        assert not np.any(rows.separation["B"]) and not np.any(rows.separation["B|A"])
        assert not np.any(rows.overridden["B|A"])
    made = mdnum.fork(a, "precision", steps=400, repeats=0, report=False, out=tmp_path / "fork")
    assert made.summary["first_bit"] is not None
    assert "strained is another" in made.summary["lyapunov_reason"]


@pytest.mark.nightly
def test_many_bodies_feel_the_box_of_their_row():
    plain = build("silicon/stillinger-weber-512")
    numbers = {name: jax.numpy.float64(value) for name, value in {"stretch": 0.5, "shear": 0.5}.items()}
    simulation = replace(plain, integrator=Strained(plain.integrator.timestep, **numbers))
    seen = 0
    for segment in Engine(simulation, 20).segments():
        for row in range(0, segment.rows, 5):
            here = simulation.evaluate(segment.unsorted("x", row), np.asarray(segment.cell_of(row).matrix))
            assert segment.rows_of("potential")[row] == pytest.approx(here.energy, rel=1e-10)
            seen += 1
    assert seen >= 4 and not np.allclose(segment.cell_of(row).matrix, plain.cell.matrix, rtol=1e-5)


def test_what_has_one_box_alone_refuses_another_by_name():
    simulation = moving()
    with pytest.raises(InputError, match=r"strained is another.*unrolled"):
        method("forward")(Problem(simulation, everything(108), 10), ["potential.sigma"])
    with pytest.raises(InputError, match=r"processes.*strained"):
        variants(simulation, 3)
    assert "strained" in str(unsupported(simulation))
    with pytest.raises(InputError, match="strained is another"):
        next(tangents(simulation, 5, np.ones((108, 3)), np.ones((108, 3))))
    whole = build(
        make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": 2.0}, precision={"state": "lattice"})
    )
    with pytest.raises(InputError, match="not strained"):
        first_state(replace(whole, integrator=simulation.integrator))


def test_a_box_that_becomes_too_narrow_ends_the_run_with_everything_recorded(tmp_path):
    shrinking = {"dynamics": {"stretch": -1.0, "shear": 0.0}, "steps": 49}
    with pytest.raises(NumericalError, match="perpendicular"):
        run(moving(**shrinking), out=tmp_path / "run")
    folder = RunFolder.open(tmp_path / "run")
    summary, series = folder.summary, folder.read("series")
    assert (summary["status"], summary["reason"]) == ("failed", NARROW)
    last, width = summary["steps"], float(moving().cell.widths.min())
    # at the next rebuild the box is below twice the cutoff and skin, and its list had skin left until there
    assert (1 - TIMESTEP) ** (last + 1) * width < 2 * (R_CUT + 0.3) < (1 - TIMESTEP) ** (last - 20) * width
    assert summary["algebra_residual"] == summary["lost_pairs"] == 0 and summary["energy_budget_closes"]
    assert len(series["step"]) == last + 1 and int(series["entered"].sum() + series["left"].sum()) == len(
        folder.read("flips")["step"]
    )
    frames: Any = ase.io.read(tmp_path / "run" / "trajectory.traj", index=":")
    assert [atoms.info["step"] for atoms in frames] == list(range(0, last + 1, 10))
    assert folder.has_checkpoint() and folder.read("epochs")["reason"][-1] == NARROW
    with pytest.raises(FolderError, match=r"perpendicular.*at most"):
        run(moving(**shrinking), resume=tmp_path / "run")


@pytest.mark.nightly
def test_a_list_that_is_rebuilt_blindly_serves_until_the_box_is_below_twice_the_cutoff():
    blind = moving(rebuild=(1000, 0, False), dynamics={"stretch": -1.5, "shear": 0.0})
    for segment in Engine(blind, 49).segments():
        assert min(float(np.min(cell.widths)) for cell in segment.cells) >= 2 * R_CUT
    assert segment.closes == NARROW and segment.state.cells[0].is_narrow(R_CUT)


def test_a_run_that_has_ended_does_not_go_on_in_a_box_that_is_too_narrow(tmp_path):
    simulation = moving(dynamics={"stretch": -1.0, "shear": 0.0}, steps=25)
    run(simulation, out=tmp_path / "run")
    with pytest.raises(InputError, match="perpendicular"):
        run(simulation, resume=tmp_path / "run", steps=49)
    assert RunFolder.open(tmp_path / "run").summary["status"] == "complete"


def _planted(rule: str, first: Cell):
    """`Cell.spent` with a rule that forgets a part of the strain."""

    def spent(self, x, reference, home, r_list):
        by = reference.deformation(self)
        moved = x - (home if rule == "motion without the box" else cells.transformed(home, by))
        if rule == "strain by volume":
            loss = r_list * jax.numpy.maximum(0, 1 - jax.numpy.abs(jax.numpy.linalg.det(by)) ** (1 / 3))
        else:
            loss = cells.strain_loss(first, self, r_list) if rule == "strain since the first box" else 0.0
        return self.astype(x.dtype).farthest(moved) + 0.5 * loss

    return spent


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("rule", "kind", "stretch", "shear"),
    [
        ("motion in the box alone", Strained, -1.0, 0.0),
        ("motion without the box", Resting, -3.5, 0.0),
        ("strain by volume", Strained, 0.0, 2.2),
        ("strain since the first box", Strained, 1.0, 0.0),
    ],
)
def test_a_rule_that_forgets_a_part_of_the_strain_is_found_in_the_loop(
    rule, kind, stretch, shear, tmp_path, monkeypatch
):
    """By all pairs in numpy at every step, and by the look back at the next rebuild."""
    options: dict[str, Any] = {
        "temperature": 0.3,
        "atoms": liquid(density=0.5, rattle=0.1 if shear else 0.02),
    }
    if kind is Resting:
        # atoms nearly at rest, in rows that are that far apart, come nearer through the faces alone
        options |= {"atoms": liquid(density=0.3, rattle=0.02), "timestep": 0.1 * TIMESTEP}
    options["dynamics"] = {"stretch": stretch, "shear": shear}
    for planted in (False, True):
        # of a class of its own, so that it is compiled on its own
        own = type(f"{kind.__name__}{planted}", (kind,), {"name": f"{kind.name}-{planted}"})
        simulation = moving(own, **options)
        if planted:
            monkeypatch.setattr(Cell, "spent", _planted(rule, simulation.cell))
        judge, lost, looked_back, recorder = AllPairs(simulation), 0, 0, PairRecorder(simulation)
        for segment in Engine(simulation, 99).segments():
            recorder.flips(segment)
            looked_back += recorder.missed
            for row in range(segment.rows):
                judge.x, judge.matrix = segment.unsorted("x", row), np.asarray(segment.cell_of(row).matrix)
                lost += len(judge.forces()[0] - set(decided_pairs(simulation, segment, row).tolist()))
        # a rebuild comes too late to see the pairs of atoms at rest
        assert bool(lost) == planted and bool(looked_back) == (planted and kind is Strained)


@pytest.mark.parametrize("pbc", list(product((True, False), repeat=3)))
def test_a_deformed_cell_is_the_one_made_of_its_vectors(pbc):
    rng = np.random.default_rng(7)
    before = Cell.create(5 * np.eye(3) + rng.uniform(-1, 1, (3, 3)), pbc)
    by = np.eye(3) + rng.uniform(-0.1, 0.1, (3, 3))
    made, anew = before.astype(np.float64).deformed(by), Cell.create(before.matrix @ by, pbc)
    assert np.allclose(made.matrix, anew.matrix, atol=1e-14)
    assert np.allclose(made.inverse, anew.inverse, atol=1e-13)
    between = before.deformation(anew)
    flags = np.array(pbc)
    assert np.allclose((before.matrix @ between)[flags], anew.matrix[flags], atol=1e-13)
    assert np.array_equal(before.deformation(before), np.eye(3))
