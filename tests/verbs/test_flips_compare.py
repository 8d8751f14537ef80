"""Two trajectories: what rounding alone makes differ, what is certain, boxes, and numbers of frames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pytest
from ase.io import write

import mdnum
from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.trajectories import follow
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import Capped, CutoffRule, Nearest, Rule
from mdnum.trajectories.tracker import Tracker
from mdnum.verbs.flips_compare import TEXTS, ComparisonView, judge
from mdnum.verbs.frame import Outcome


def looked(a: Path, b: Path, out: Path, **options: Any) -> Outcome:
    return mdnum.flips(a, b, **{"cutoffs": [4.2], "report": False, "out": out, **options})


def finding(result: Outcome, code: str) -> Any:
    return next((one for one in result.verdict.findings if one.code == code), None)


def codes_of(result: Outcome) -> set[str]:
    """Names of the sentences that make up the evidence, by how they begin and end."""
    told = TEXTS.entries["sentences"]
    ends = {name: re.split(r"{[^}]*}", text) for name, text in told.items()}
    return {
        name
        for name, parts in ends.items()
        if any(one.startswith(parts[0]) and one.endswith(parts[-1]) for one in result.verdict.evidence)
    }


def gas(frames: int = 6, atoms: int = 40, side: float = 9.0, pbc: Any = True) -> list[ase.Atoms]:
    """Atoms that fly straight, unwrapped."""
    rng = np.random.default_rng(8)
    start, speed = rng.uniform(0, side, (atoms, 3)), rng.normal(0, 0.4, (atoms, 3))
    return [
        ase.Atoms(f"Ar{atoms}", start + n * speed, cell=[side] * 3, pbc=pbc, info={"time": float(n)})
        for n in range(frames)
    ]


def pairs_at(distances: list[float], more: int = 0) -> list[ase.Atoms]:
    """Two atoms at these distances and others that only move, on a grid of 0.01."""
    return [
        ase.Atoms(
            f"Ar{4 + 2 * more}",
            [[0.11, 0.23, 0.37], [0.11, 0.23, round(0.37 + r, 2)], [9.01 + 0.01 * n, 47.13, 5.27],
             [20.19, 43.41 + 0.03 * n, 8.93]]
            + [[0.11, 100.13 + 20 * k, z] for k in range(more) for z in (0.37, round(0.37 + r, 2))],
            info={"time": float(n)},
        )
        for n, r in enumerate(distances)
    ]  # fmt: skip


def test_one_run_written_twice_is_not_said_to_differ(tmp_path: Path) -> None:
    frames = gas()
    write(tmp_path / "a.traj", frames)
    write(tmp_path / "digits.extxyz", frames)
    for one in frames:
        one.wrap()
    write(tmp_path / "wrapped.traj", frames)
    for one in frames:
        one.positions = np.round(one.positions, 2)
    write(tmp_path / "coarse.extxyz", frames)
    for name in ("digits.extxyz", "wrapped.traj", "coarse.extxyz"):
        found = looked(tmp_path / "a.traj", tmp_path / name, tmp_path / f"f-{name}")
        summary, rule = found.summary, found.summary["rules"][0]
        assert summary["seed"] == 0 and summary["beyond"] is None and rule["certain"] is None, name
        assert "order_start" not in codes_of(found) and finding(found, "NO_CAUSE_FROM_FILES") is None
        assert found.verdict.tone == "info"
    # on the coarse grid sets do differ, all of it within the resolution
    assert rule["first"] is not None and rule["first"]["ambiguous"] == rule["first"]["pairs"]
    assert finding(found, "WITHIN_RESOLUTION").severity == "info" and "certain_never" in codes_of(found)
    # half a step along each axis, and not one more
    table = RunFolder.open(found.folder).read("apart")
    assert table["bound"].max() == pytest.approx(np.sqrt(3) * 0.005, rel=1e-3)
    assert 0.5 < table["furthest"].max() / table["bound"].max() < 1


def test_positions_beyond_the_resolution_before_any_set(tmp_path: Path) -> None:
    write(tmp_path / "a.extxyz", pairs_at([4.0, 4.0, 4.0, 4.1, 4.3]))
    write(tmp_path / "b.extxyz", pairs_at([4.0, 4.01, 4.05, 4.1, 4.1]))
    found = looked(tmp_path / "a.extxyz", tmp_path / "b.extxyz", tmp_path / "f")
    summary, rule = found.summary, found.summary["rules"][0]
    assert (summary["seed"], summary["beyond"], rule["first"]["frame"], rule["certain"]) == (1, 2, 4, 4)
    assert {"positions_later", "positions_before", "order_positions"} <= codes_of(found)


def test_what_is_certain_is_found_among_pairs_that_stay_different(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # differs within the resolution at frames 1 and 2, and beyond it at frame 3, where no pair is new
    write(tmp_path / "a.extxyz", pairs_at([4.0, 4.19, 4.19, 4.0]))
    write(tmp_path / "b.extxyz", pairs_at([4.0, 4.21, 4.21, 4.6]))
    found = looked(tmp_path / "a.extxyz", tmp_path / "b.extxyz", tmp_path / "f", report=True)
    rule = found.summary["rules"][0]
    assert (rule["first"]["frame"], rule["first"]["ambiguous"], rule["certain"]) == (1, 1, 3)
    said = finding(found, "WITHIN_RESOLUTION")
    assert said.severity == "warning" and said.values["certain"] == "frame 3"
    assert "certain_later" in codes_of(found) and (found.folder / "report.html").exists()
    # with more pairs than the table has room for, each of them is looked at
    monkeypatch.setattr(follow, "ROWS", 2)
    a, b = pairs_at([4.0, 4.0, 4.0], 3), pairs_at([4.0, 4.0, 4.0], 3)
    for one, r in ((a, 4.19), (b, 4.21)):
        one[1].positions[[1, 5, 7, 9], 2] = round(0.37 + r, 2)
    a[1].positions[9, 2], b[1].positions[9, 2] = 4.37, 5.37
    write(tmp_path / "c.extxyz", a)
    write(tmp_path / "d.extxyz", b)
    found = looked(tmp_path / "c.extxyz", tmp_path / "d.extxyz", tmp_path / "g")
    rule = found.summary["rules"][0]
    assert (rule["first"]["pairs"], rule["first"]["ambiguous"], rule["certain"]) == (4, 3, 1)
    assert len(RunFolder.open(found.folder).read("differing")["i"]) == 2


@pytest.mark.parametrize("rule", [Nearest(2), Capped(4.0, 2), CutoffRule(4.0)])
def test_thresholds_of_a_directed_rule_tell_neighbors_from_others(rule: Rule) -> None:
    rng = np.random.default_rng(3)
    box = Box(np.diag([30.0] * 3), np.ones(3, bool))
    tracker = Tracker(rule, np.arange(4, 16))
    tracker.step(Frame(0, 0.0, x := rng.uniform(0, 9, (20, 3)), box))
    stays, enters = tracker.thresholds()
    if isinstance(rule, CutoffRule):
        assert np.isnan(stays).all() and np.isnan(enters).all()
        return
    assert np.isnan(stays[:4]).all() and np.isnan(enters[16:]).all()
    members = tracker.members()
    reach = rule.radius if isinstance(rule, Capped) else np.inf
    for i in range(4, 16):
        r = sorted(float(np.linalg.norm(x[j] - x[i])) for j in range(4, 16) if j != i)
        inside = members.i == i
        assert (members.distance[inside] < stays[i]).all()
        assert stays[i] == pytest.approx(min(r[2], reach)) and enters[i] == pytest.approx(min(r[1], reach))


def test_nearest_neighbors_that_differ_for_certain(tmp_path: Path) -> None:
    for name, far in (("a", 3.5), ("b", 2.5)):
        places = ([[0, 0, 0], [3.0 + 0.01 * n, 0, 0], [0, 0, far if n else 3.2]] for n in range(3))
        write(tmp_path / f"{name}.traj", [ase.Atoms("Ar3", place) for place in places])
    found = looked(tmp_path / "a.traj", tmp_path / "b.traj", tmp_path / "f", cutoffs=(), nearest=[1])
    rule = found.summary["rules"][0]
    assert rule["first"]["frame"] == 1 and rule["certain"] == 1
    margins = {(one["i"], one["j"]): (one["margin_a"], one["margin_b"]) for one in rule["first_pairs"]}
    # 0 has 1 nearest at 3.01 in A (2 at 3.5), and 2 at 2.5 in B
    np.testing.assert_allclose(margins[0, 1], [3.5 - 3.01, 2.5 - 3.01], atol=1e-12)
    np.testing.assert_allclose(margins[0, 2], [3.01 - 3.5, 3.01 - 2.5], atol=1e-12)


def test_other_boxes_are_said(tmp_path: Path) -> None:
    write(tmp_path / "a.traj", gas())
    write(tmp_path / "slab.traj", gas(pbc=(True, True, False)))
    # the same where the file of the other box rounds
    write(tmp_path / "slab.extxyz", gas(pbc=(True, True, False)))
    for name, seed in (("slab.traj", None), ("slab.extxyz", 0)):
        found = looked(tmp_path / "a.traj", tmp_path / name, tmp_path / f"f-{name}", report=True)
        said = finding(found, "OTHER_BOX")
        assert said.severity == "warning" and "different axes" in said.title
        assert said.values["a"].endswith("along a, b and c") and said.values["b"].endswith("along a and b")
        assert found.summary["seed"] == seed and found.summary["rules"][0]["certain"] == 0
        assert "order_boxes" in codes_of(found)
    wider = gas()
    for one in wider[2:]:
        one.set_cell([9.0, 9.0, 9.25])
    write(tmp_path / "wider.traj", wider)
    found = looked(tmp_path / "a.traj", tmp_path / "wider.traj", tmp_path / "g", cutoffs=[1e-3])
    said = finding(found, "OTHER_BOX")
    assert said.values["frame"] == "frame 2" and said.values["b"].startswith("9 × 9 × 9.25 Å")


def test_frames_of_a_slice_are_named_by_their_numbers_in_the_files(tmp_path: Path) -> None:
    frames = gas(12)
    other = [one.copy() for one in frames[::2]]
    for one in other[2:]:
        one.positions[:, 0] += np.random.default_rng(1).normal(0, 0.5, 40)
    write(tmp_path / "a.traj", frames)
    write(tmp_path / "b.traj", other)
    found = looked(Path(f"{tmp_path}/a.traj@::2"), tmp_path / "b.traj", tmp_path / "f")
    assert found.summary["rules"][0]["first"]["frame"] == 2
    assert all(part in found.verdict.headline for part in ("frame 2 (4 in A’s", "2 in B’s)"))
    found = looked(Path(f"{tmp_path}/a.traj@4:"), Path(f"{tmp_path}/a.traj@4:"), tmp_path / "g")
    assert found.summary["seed"] is None and found.summary["frames"] == 8
    assert found.summary["rules"][0]["first"] is None
    # frames of other times, and another number of atoms
    shifted = looked(
        Path(f"{tmp_path}/a.traj@:8"), Path(f"{tmp_path}/a.traj@3:"), tmp_path / "h", report=True
    )
    assert shifted.summary["rules"][0]["first"]["frame"] == 0 and "order_start" in codes_of(shifted)
    assert finding(shifted, "OTHER_TIMES") and finding(shifted, "NO_CAUSE_FROM_FILES")
    write(tmp_path / "fewer.traj", gas(6, atoms=20))
    with pytest.raises(InputError, match="40 atoms and fewer"):
        looked(tmp_path / "a.traj", tmp_path / "fewer.traj", tmp_path / "i")


def test_files_that_do_not_say_it_are_of_no_other_species_or_times(tmp_path: Path) -> None:
    frames = gas(4)
    for one in frames:
        one.symbols[:20] = "Ne"
        one.info.clear()
    write(tmp_path / "a.extxyz", frames)

    def dump(name: str, row: str) -> Path:
        with (tmp_path / name).open("w") as file:
            for n, one in enumerate(frames):
                file.write(
                    f"ITEM: TIMESTEP\n{10 * n}\nITEM: NUMBER OF ATOMS\n40\nITEM: BOX BOUNDS pp pp pp\n"
                )
                file.write("0 9.0\n" * 3 + f"ITEM: ATOMS {row}\n")
                for k, (x, y, z) in enumerate(one.positions):
                    kind = f"{1 + (k < 20)} " if "type" in row else ""
                    file.write(f"{k + 1} {kind}{x:.8f} {y:.8f} {z:.8f}\n")
        return tmp_path / name

    for name, row in (("types.lammpstrj", "id type x y z"), ("bare.lammpstrj", "id x y z")):
        found = looked(tmp_path / "a.extxyz", dump(name, row), tmp_path / f"f-{name}")
        assert {"OTHER_SPECIES", "OTHER_TIMES"}.isdisjoint(one.code for one in found.verdict.findings)
        assert finding(found, "NO_TIMES").severity == "info"
    # in another order than the types are
    for one in frames:
        one.symbols[0] = "Ar"
    write(tmp_path / "a.extxyz", frames)
    found = looked(tmp_path / "a.extxyz", tmp_path / "types.lammpstrj", tmp_path / "f")
    assert finding(found, "OTHER_SPECIES") is not None


def test_several_rules_are_compared_as_each_alone(tmp_path: Path) -> None:
    a, b = gas(8), gas(8)
    for one in b[3:]:
        one.positions[7, 0] += 0.8
    for name, frames in (("a", a), ("b", b)):
        write(tmp_path / f"{name}.traj", frames)
    asked: dict[str, Any] = {"cutoffs": [4.2, 2.0], "nearest": [3], "pairs": ["Ar-Ar=3.1"]}
    both = tmp_path / "a.traj", tmp_path / "b.traj"
    found = looked(*both, tmp_path / "all", **asked, report=True)
    rules = found.summary["rules"]
    assert [one["rule"] for one in rules] == ["r < 4.2", "r < 2", "Ar-Ar < 3.1", "3 nearest"]
    table = RunFolder.open(found.folder).read("differing")
    alone = [{"cutoffs": [4.2]}, {"cutoffs": [2.0]}, {"cutoffs": (), "pairs": ["Ar-Ar=3.1"]},
             {"cutoffs": (), "nearest": [3]}]  # fmt: skip
    for place, options in enumerate(alone):
        single = looked(*both, tmp_path / f"{place}", **options)
        for name in ("rule", "first", "certain", "growth"):
            assert rules[place][name] == single.summary["rules"][0][name], (place, name)
        rows, mine = RunFolder.open(single.folder).read("differing"), table["rule"] == place
        assert mine.any() and not rows["rule"].any()
        for name in set(rows) - {"rule"}:
            np.testing.assert_array_equal(table[name][mine], rows[name])
    # what control-C ended is said, and no other length is
    stopped = {"interrupted": True, "status": "stopped", "in_file": [8, 12]}
    view = ComparisonView(RunFolder.open(found.folder), {**found.summary, **stopped})
    seen = {one.code for one in judge(view).findings}
    assert "INTERRUPTED" in seen and "OTHER_LENGTH" not in seen
    # the first one is what the headline is about, the others are named in a sentence each
    assert sum(line.startswith(("r < 2 Å: ", "Ar-Ar < 3.1 Å: ", "3 nearest: "))
               for line in found.verdict.evidence) == 3  # fmt: skip
    assert [row[0] for row in found.page.sections[0].parts[0].rows][:2] == ["r < 4.2 Å", "r < 2 Å"]
