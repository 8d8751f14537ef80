"""The range of a run's numbers, and the step at which a narrower format would not hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ase import Atoms
from rollout.harness import go, liquid, run, write_system
from small_systems import KOB_ANDERSEN, make, mixture

from mdnum.errors import NumericalError
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.build import build
from mdnum.verbs.run import judge
from mdnum.verbs.run_page import RunView, page

# two atoms 1.9 sigma apart approach by 0.1 a step, so fast that the force changes next to nothing
SPEED, DT, STEPS = 1e8, 1e-9, 16
ALONG, MASSES = np.array([2.0, -1.0, 2.0]) / 3, (1.0, 3.0)


def colliding(folder: Path, pbc) -> Path:
    at = [[9, 7, 8], 1.9 * ALONG + [9, 7, 8]]
    atoms = Atoms("Ar2", positions=at, cell=[15, 17, 19], pbc=pbc, masses=MASSES)
    velocities = SPEED * np.outer([0.75, -0.25], ALONG)
    atoms.set_velocities(velocities)
    return write_system(
        folder, atoms, neighbors={"skin": 0.0},
        dynamics={"kind": "nve", "timestep": DT, "temperature": 1.0, "steps": STEPS, "seed": 3},
    )  # fmt: skip


def shown(folder: RunFolder) -> dict[str, tuple]:
    """The rows of the page's table, by the first words of each."""
    view = RunView(folder, folder.summary)
    (section,) = (one for one in page(view, judge(view)).sections if one.title == "Range of numbers")
    return {row[0].split(" (")[0]: row[1:] for row in section.parts[0].rows}


@pytest.mark.parametrize("pbc", [True, False])
def test_two_atoms_come_so_close_that_float16_cannot_hold_their_repulsion(tmp_path, pbc):
    _, folder = go(tmp_path, colliding(tmp_path, pbc), STEPS)
    found, step = folder.read("ranges"), np.arange(STEPS + 1)
    assert found["step"].tolist() == step.tolist()
    r = 1.9 - 0.1 * step
    force = 24 * (2 * r**-13 - r**-7)
    energy = 4 * (r**-12 - r**-6)
    expected = {"r2": (r**2, r**2), "pair": (abs(energy), abs(energy))}
    expected["force"] = abs(force) * 2 / 3, abs(force) / 3
    expected["v"] = SPEED * 0.75 * 2 / 3, SPEED * 0.25 / 3
    for name, (most, least) in expected.items():
        # the force slows them down by less than a part in ten million
        np.testing.assert_allclose(found[f"largest_{name}"], most, rtol=1e-7, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(found[f"smallest_{name}"], least, rtol=1e-7, atol=1e-9, err_msg=name)
    # 24 (2 / 0.5^13 - 1 / 0.5^7) = 390,144, of which two thirds are along x
    assert found["largest_force"][14] == pytest.approx(260_096, rel=1e-5) and r[14] == pytest.approx(0.5)
    rows = shown(folder)
    assert {name: row[2:4] for name, row in rows.items()} == dict.fromkeys(rows, ("held", "held"))
    first = {
        name: int(np.argmax(size >= 65520)) for name, size in (("force", force * 2 / 3), ("energy", energy))
    }
    assert first == {"force": 14, "energy": 15}
    assert rows["component of the force on an atom"][4].startswith("overflows at step 14 (")
    assert rows["energy of the closest pair of each type"][4].startswith("overflows at step 15 (")
    assert rows["potential energy, summed over all terms"][4].startswith("overflows at step 15 (")
    assert rows["kinetic energy, summed over all atoms"][4].startswith("overflows at step 0 (")
    assert rows["squared distance of a pair within the cutoff"][4] == "held"
    assert rows["component of a velocity"][0] == pytest.approx(5e7)
    assert rows["component of a velocity"][4].startswith("over")


def test_sums_are_examined_at_every_step_and_the_others_at_checks(tmp_path):
    """With a skin a list serves several steps: only those at which the budget is checked have a row."""
    result, folder = go(tmp_path, write_system(tmp_path, liquid()), 60)
    found = folder.read("ranges")
    assert len(found["step"]) == result.summary["energy_budget_checks"] < 61
    assert found["step"][0] == 0 and found["step"][-1] == 60 and (np.diff(found["step"]) > 0).all()
    rows, potential = shown(folder), abs(folder.read("series")["potential"])
    assert rows["potential energy, summed over all terms"][:2] == (potential.max(), potential.min())
    forces = build(load(tmp_path / "system.toml")).evaluate(result.frames[1]).forces
    assert found["largest_force"][-1] == pytest.approx(abs(forces).max(), rel=1e-9)
    assert found["largest_x"][-1] == abs(result.frames[1]).max()


def test_a_run_of_no_step_has_one_row(tmp_path):
    _, folder = go(tmp_path, colliding(tmp_path, True), 0)
    assert folder.read("ranges")["step"].tolist() == [0]


def test_a_run_that_blew_up_keeps_what_was_finite(tmp_path):
    """Atoms so fast that no force changes a bit meet at step 6 exactly; a list serves several steps."""
    atoms = Atoms("Ar2", positions=[[4, 7, 8], [5.5, 7, 8]], cell=[15, 17, 19], pbc=True, masses=MASSES)
    atoms.set_velocities([[0.75 * 2**60, 0, 0], [-0.25 * 2**60, 0, 0]])
    path = write_system(tmp_path, atoms, neighbors={"skin": 1.0}, dynamics={"timestep": 2.0**-62})
    with pytest.raises(NumericalError, match="step 6"):
        run(load(path), out=tmp_path / "run", steps=20)
    found = RunFolder.open(tmp_path / "run").read("ranges")
    assert found["step"][0] == 0 and found["step"][-1] == 5
    assert found["largest_v"].tolist() == [0.75 * 2**60] * len(found["step"])
    assert found["smallest_r2"][-1] == 0.0625
    assert found["largest_force"][-1] == pytest.approx(24 * (2 * 4.0**13 - 4.0**7), rel=1e-12)


def test_closest_pairs_are_those_of_a_search_through_all(tmp_path):
    """By type, in a tilted box, with one type's constants in the energy of its closest pair."""
    atoms = mixture()
    shear = np.array([[1, 0, 0], [-0.11, 1, 0], [0.07, -0.13, 1]])
    atoms.set_cell(atoms.cell.array @ shear, scale_atoms=True)
    simulation = build(make(atoms, KOB_ANDERSEN, {"kind": "shifted", "radius": 2.2}))
    energy, numbers = simulation.numbers()
    r = atoms.get_all_distances(mic=True)[np.triu_indices(108, 1)]
    nickel = atoms.symbols == "Ni"
    of_type = np.add.outer(nickel * 1, nickel * 1)[np.triu_indices(108, 1)]
    closest = {kind: r[of_type == kind].min() for kind in (2, 1, 0)}
    constants = {2: (1.0, 1.0), 1: (0.8, 1.5), 0: (0.88, 0.5)}
    u = {
        kind: 4 * constants[kind][1] * ((constants[kind][0] / r) ** 12 - (constants[kind][0] / r) ** 6)
        for kind, r in closest.items()
    }
    np.testing.assert_allclose(
        np.sort(numbers["r2"]), np.sort([*np.square([*closest.values()]), (r[r < 2.2] ** 2).max()])
    )
    np.testing.assert_allclose(np.sort(numbers["pair"]), np.sort([*u.values()]))
    made = simulation.evaluate()
    assert energy == pytest.approx(made.energy, rel=1e-12)
    np.testing.assert_allclose(np.sort(np.ravel(numbers["force"])), np.sort(made.forces.ravel()), atol=1e-9)


def test_no_pair_within_the_cutoff_has_no_number(tmp_path):
    atoms = Atoms("Ar2", positions=[[1, 2, 3], [6, 2, 3]], cell=[15, 17, 19], pbc=True, masses=[1, 3])
    _, folder = go(tmp_path, write_system(tmp_path, atoms), 4)
    found = folder.read("ranges")
    for name in ("force", "r2", "pair"):
        assert not found[f"largest_{name}"].any() and np.isnan(found[f"smallest_{name}"]).all()
    rows = shown(folder)
    assert "component of a velocity" in rows and not {name for name in rows if "pair" in name}
