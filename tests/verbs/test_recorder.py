"""Frames of a loop, given one by one: the outcome of `mdnum flips`, lists in use, energies, a kill."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pytest
from ase.io import write
from jsonschema import Draft202012Validator
from schemas import closed

import mdnum
from mdnum.errors import InputError
from mdnum.plain import plain

TABLES = ("members", "flips", "frames", "contacts", "lifetimes", "neighbors", "busiest")
#: A box of jax-md: lattice vectors as columns.
TILTED = np.array([[6.0, 1.5, -1.0], [0.0, 5.5, 0.8], [0.0, 0.0, 6.2]])


def gas(seed: int = 0, frames: int = 24, atoms: int = 24, side: float = 6.0) -> np.ndarray:
    """Atoms that fly straight."""
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(0, side, (atoms, 3)), rng.normal(0, 0.25, (atoms, 3))
    return np.array([start + n * speed for n in range(frames)])


def recorded(path: Path, frames: np.ndarray, r_cut: float = 2.5, **options: Any) -> mdnum.Outcome:
    """What a recorder makes of frames."""
    with mdnum.Recorder(r_cut, out=path, report=False, **options) as one:
        for step, x in enumerate(frames):
            one.see(step, x)
    return one.outcome


def same(a: mdnum.Outcome, b: mdnum.Outcome, tables: tuple[str, ...] = TABLES) -> bool:
    """Whether two folders have the same tables to the last bit, but for steps, which files do not have."""
    made = [{name: one.table(name).to_pydict() for name in tables} for one in (a, b)]
    for one in made:
        one.get("flips", {}).pop("step", None)
    return repr(made[0]) == repr(made[1])


def codes(outcome: mdnum.Outcome) -> set[str]:
    return {one.code for one in outcome.findings}


def images(x: np.ndarray, cell: np.ndarray, radius: float) -> dict[tuple[int, ...], float]:
    """Distance by (i, j, shift) of all pairs inside, i < j or the first of two opposite images of an atom."""
    shifts = np.array(list(np.ndindex(7, 7, 7))) - 3
    between = x[None, None] + (shifts @ cell)[:, None, None] - x[None, :, None]
    r = np.sqrt((between**2).sum(axis=-1))
    found = {}
    for k, i, j in np.argwhere(r < radius).tolist():
        shift = tuple(shifts[k].tolist())
        if i < j or (i == j and shift > (0, 0, 0)):
            found[i, j, *shift] = float(r[k, i, j])
    return dict(sorted(found.items()))


# ---- the same as a file


@pytest.mark.parametrize("cell", [np.diag([6.0] * 3), TILTED.T], ids=["cube", "tilted"])
def test_a_loop_gives_what_a_file_of_its_frames_gives(tmp_path, cell):
    frames, species = gas(), list("OH" * 12)
    atoms = [ase.Atoms(species, x, cell=cell, pbc=True, info={"time": k}) for k, x in enumerate(frames)]
    write(tmp_path / "f.traj", atoms)
    file = mdnum.flips(tmp_path / "f.traj", cutoffs=2.5, out=tmp_path / "file", report=False)
    loop = recorded(tmp_path / "loop", frames, cell=cell, species=species)
    tables = tuple(name for name in TABLES if name != "lifetimes")
    assert same(file, loop, tables) and loop.table("flips").num_rows > 300
    for name in ("pairs_flipped", "entered", "ambiguous", "contacts", "lifetime", "chatter", "images"):
        assert file.summary["rules"][0][name] == loop.summary["rules"][0][name]
    assert loop.summary["frames"] == 24 and loop.summary["time"] == "step"
    flips = loop.table("flips").to_pydict()
    assert flips["step"] == flips["frame"] and set(file.table("flips").to_pydict()["step"]) == {None}
    with mdnum.Recorder([2.5, 1.5], cell=cell, out=tmp_path / "strided", report=False) as strided:
        strided.see_many(frames, first=100, every=5)
    flips = strided.outcome.table("flips").to_pydict()
    assert flips["step"] == [100 + 5 * frame for frame in flips["frame"]] and set(flips["rule"]) == {0, 1}


def test_arrays_give_what_a_file_of_them_gives(tmp_path):
    frames = gas()
    cells = np.array([np.diag([6.0 + 0.01 * k] * 3) for k in range(len(frames))])
    atoms = [ase.Atoms("H24", x, cell=cell, pbc=True) for x, cell in zip(frames, cells, strict=True)]
    write(tmp_path / "f.traj", atoms)
    keep = {"cutoffs": 2.5, "report": False}
    file = mdnum.flips(tmp_path / "f.traj", out=tmp_path / "file", **keep)
    told = mdnum.flips(atoms, out=tmp_path / "atoms", **keep)
    assert same(file, told) and file.summary["rules"] == told.summary["rules"]
    array = mdnum.flips(frames, cell=cells, out=tmp_path / "array", **keep)
    assert same(told, array, ("members", "frames", "contacts"))
    with pytest.raises(InputError, match="cell"):
        mdnum.flips(tmp_path / "f.traj", cell=6.0, **keep)
    with pytest.raises(InputError, match="topology"):
        mdnum.flips(frames, cell=6.0, topology=tmp_path / "f.traj", **keep)


def test_arrays_take_what_a_recorder_takes(tmp_path):
    box, given = TILTED, {"species": list("OH" * 12), "timestep": 0.5, "length": "nm", "time": "fs"}
    frames = gas(frames=12)
    speeds = np.broadcast_to((frames[1] - frames[0]) / 0.5, frames.shape)
    fractions = (frames @ np.linalg.inv(box.T)).astype(np.float32)
    boxes = np.array([(1 + 0.01 * k) * box for k in range(12)])
    with mdnum.Recorder(2.5, fractional=True, out=tmp_path / "r", report=False, **given) as one:
        one.see_many(fractions, box=boxes, velocities=speeds)
    rules = {"cutoffs": 2.5, "fractional": True, "report": False}
    told = mdnum.flips(fractions, box=boxes, velocities=speeds, out=tmp_path / "f", **rules, **given)
    assert same(one.outcome, told) and told.table("flips").num_rows > 50
    for name in ("rules", "length", "time", "interval", "flight", "format", "resolution"):
        assert one.outcome.summary[name] == told.summary[name]
    for options in ({"timestep": 0.5}, {"fractional": True}, {"box": box}, {"species": ["H"]}):
        with pytest.raises(InputError, match=next(iter(options))):
            mdnum.flips(tmp_path / "f.traj", cutoffs=2.5, **options)
    with pytest.raises(InputError, match="fractional"):
        mdnum.flips(fractions[:, :8] % 1, box=box, cutoffs=2.5)


def test_remedies_for_arrays_are_python(tmp_path):
    frames, many = gas(), {"cell": 6.0, "report": False}
    broken = frames.copy()
    broken[15:, 3] = np.nan
    for options, word in (({}, "cutoffs=R"), ({"most": 3}, "cutoffs=R"), ({"pairs": "O"}, "pairs")):
        with pytest.raises(InputError, match=word) as raised:
            mdnum.flips(frames, **options, **many)
        assert "--" not in str(raised.value) and "--" not in raised.value.remedy
    still = np.repeat(frames[:6], 2, axis=0)
    kept = [
        mdnum.flips(x, cutoffs=2.5, nearest=3, out=tmp_path / str(k), **many)
        for k, x in enumerate((broken, still))
    ]
    found = [one for outcome in kept for one in outcome.findings]
    told = [text for one in found for text in (one.text, one.remedy)]
    assert not re.search(r"@[\d:A-Z]|--", " ".join(told)) and "array[:15]" in " ".join(told)
    assert {"STOPPED", "REPEATED_FRAMES"} <= {one.code for one in found}
    assert any("drop_repeats" in one.remedy for one in found)
    assert kept[0].summary["frames"] == 15


def test_rules_velocities_and_units_are_those_of_a_file(tmp_path):
    frames, rng = gas(frames=20), np.random.default_rng(1)
    speeds = np.broadcast_to((frames[1] - frames[0]) / 0.5, frames.shape)
    with mdnum.Recorder(
        2.5, pairs="O-H=2.0", nearest=4, species="OH" * 12 and list("OH" * 12), cell=6.0, out=tmp_path / "r",
        timestep=0.5, length="nm", time="fs", report=False,
    ) as one:  # fmt: skip
        one.see_many(frames, velocities=speeds, energy=rng.normal(size=20), every=10)
    done = one.outcome
    assert [rule["rule"] for rule in done.summary["rules"]] == ["r < 2.5", "O-H < 2", "4 nearest"]
    assert (done.summary["length"], done.summary["time"], done.summary["interval"]) == ("nm", "fs", 5.0)
    # straight flight is a tenth of what frames that are ten steps apart show
    assert done.summary["flight"]["factor"] == pytest.approx(0.1, rel=0.01)
    assert done.table("frames")["number"].to_pylist()[::3] == [10 * k for k in range(20)]
    assert len(done.table("loop")) == 20 and "ENERGY_STEPS" not in codes(done)


# ---- boxes, dtypes and conventions


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_fractions_of_a_box_of_columns_and_its_images(tmp_path, dtype):
    side, box = 3.4, 0.6 * TILTED
    frames = gas(1, 8, 9, side)
    fractions = (frames @ np.linalg.inv(box.T)).astype(dtype)
    boxes = [(1 + 0.02 * k) * box for k in range(len(frames))]
    with mdnum.Recorder(2.9, fractional=True, out=tmp_path / "r", report=False) as one:
        for step, (x, here) in enumerate(zip(fractions, boxes, strict=True)):
            one.see(step, x, box=here)
    flips, rows = (one.outcome.table(name).to_pydict() for name in ("flips", "images"))
    inside = [images(x.astype(float) @ here.T, here.T, 2.9) for x, here in zip(fractions, boxes, strict=True)]
    assert one.outcome.table("frames")["pairs"].to_pylist() == [len(each) for each in inside]
    names = ("frame", "i", "j", "shift_a", "shift_b", "shift_c", "entered")
    wanted = [
        {(k, *key, True) for key in now.keys() - was.keys()}
        for k, (was, now) in enumerate(pairwise(inside), 1)
    ]
    wanted += [
        {(k, *key, False) for key in was.keys() - now.keys()}
        for k, (was, now) in enumerate(pairwise(inside), 1)
    ]
    assert set(zip(*(rows[name] for name in names), strict=True)) == set().union(*wanted)
    assert len(rows["i"]) > len(flips["i"]) > 100
    bound = flips["bound"][0]
    assert (1e-6 < bound < 1e-5) if dtype == np.float32 else bound < 1e-13
    assert one.outcome.summary["resolution"]["kind"] == np.dtype(dtype).name


def test_torch_and_jax_arrays_are_those_of_numpy(tmp_path):
    import jax.numpy as jnp

    frames = gas(frames=6).astype(np.float32)

    class Tensor:
        """What torch's tensors have."""

        def __init__(self, x):
            self.x = x

        def detach(self):
            return self

        cpu = detach

        def numpy(self):
            return self.x

    made = [
        recorded(tmp_path / name, [kind(x) for x in frames], cell=6.0)
        for name, kind in {"n": np.asarray, "j": jnp.asarray, "t": Tensor}.items()
    ]
    assert same(made[0], made[1]) and same(made[0], made[2])


@pytest.mark.parametrize("compare", ["r2 <", "r2 <=", "r <", "r <="])
def test_a_pair_exactly_at_the_cutoff_is_inside_by_the_convention(tmp_path, compare):
    frames = [[[0, 0, 0], [r, 0, 0]] for r in (2.4, 2.5, np.nextafter(2.5, 3) * (1 + 1e-15), 2.5)]
    done = recorded(tmp_path / "r", [np.array(x, float) for x in frames], compare=compare)
    assert done.table("frames")["pairs"].to_pylist() == [1, *([1, 0, 1] if "=" in compare else [0, 0, 0])]
    assert not done.summary["box"]["pbc"][0] and all(done.table("flips")["ambiguous"].to_pylist())


def test_what_cannot_be_meant_is_an_error(tmp_path):
    x, many = gas(frames=1)[0], np.random.default_rng(0).uniform(0, 1, (80, 3))
    plain = mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "plain")
    for positions, options, word in (
        (x[None], {}, "shape"), (x[:, :2], {}, "shape"), (x.astype(np.float16), {}, "float16"),
        (x, {"box": TILTED.T}, "upper"), (x, {"cell": np.ones((2, 2))}, "shape"), (many, {}, "fractional"),
        (x, {"cell": 6.0, "box": 6.0}, "both"), (x, {"neighbors": np.zeros((5, 5), int)}, "neighbors"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=word):
            plain.see(0, positions, **options)
    with plain:
        plain.see(0, x)
    assert plain.outcome.summary["frames"] == 1
    with pytest.raises(InputError, match="fractional"):
        mdnum.Recorder(2.5, cell=6.0, fractional=True).see(0, 20 * x)
    with pytest.raises(InputError, match="fractional"):
        mdnum.Recorder(2.5, fractional=True).see(0, x)
    with pytest.raises(InputError, match="species"):
        mdnum.Recorder(2.5, cell=6.0, species=["H"]).see(0, x)
    with pytest.raises(InputError, match="r_cut"):
        mdnum.Recorder()
    with pytest.raises(InputError, match="compare"):
        mdnum.Recorder(2.5, compare="<")
    with pytest.raises(InputError, match="pair_energy"):
        mdnum.Recorder([2.0, 2.5], pair_energy=lambda r: r)
    with pytest.raises(InputError, match="no frame"):
        _ = mdnum.Recorder(2.5, out=tmp_path / "none").outcome
    with mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "r", report=False) as one:
        one.see(0, x)
        with pytest.raises(InputError, match="float32"):
            one.see(1, x.astype(np.float32))
    with pytest.raises(InputError, match="closed"):
        one.see(1, x)
    # rows in the form of jax-md's columns are noted
    upper = recorded(tmp_path / "u", [x], cell=TILTED)
    assert "READING" in codes(upper) and upper.summary["frames"] == 1


@pytest.mark.parametrize("at", [1, 12])
def test_another_number_of_atoms_keeps_what_came_before(tmp_path, at):
    frames = gas()
    with pytest.raises(InputError, match="18"), mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "r") as one:
        for step in range(at):
            one.see(step, frames[step])
        one.see(at, frames[at][:18])
    assert one.outcome.summary["frames"] == at and one.outcome.summary["status"] == "stopped"
    atoms = [ase.Atoms("H24", x, cell=[6.0] * 3, pbc=True) for x in frames]
    del atoms[at][18:]
    told = mdnum.flips(atoms, cutoffs=2.5, out=tmp_path / "f", report=False)
    assert told.summary["frames"] == at and "STOPPED" in codes(told)


def test_pairs_and_states_are_taken_as_programs_have_them(tmp_path):
    class State:
        """What jax-md's states have."""

        position = gas(frames=1)[0]

    made = [
        recorded(tmp_path / str(k), gas(frames=4), (), pairs=pairs, cell=6.0, species=list("OH" * 12))
        for k, pairs in enumerate(("O-H=2.5,O-O=2", {"O-H": 2.5, "O-O": 2.0}))
    ]
    assert same(made[0], made[1]) and made[0].table("flips").num_rows > 20
    for pairs in ({"OH": 2.5}, {("O",): 2.5}, {"O-H": None}):
        with pytest.raises(InputError, match="A-B"):
            mdnum.Recorder(pairs=pairs)
    with pytest.raises(InputError, match=r"state\.position"):
        mdnum.Recorder(2.5).see(0, State())


def test_fractions_and_lengths_are_not_taken_for_one_another(tmp_path):
    few = np.random.default_rng(0).uniform(0, 1, (8, 3))
    with pytest.raises(InputError, match="fractional"):
        mdnum.Recorder(1.5, cell=6.0).see(0, few)
    # as a small molecule in nm
    for k, (r_cut, x) in enumerate(((0.9, few), (1.5, few[:7]))):
        assert recorded(tmp_path / str(k), [x], r_cut, cell=6.0).summary["frames"] == 1
    assert recorded(tmp_path / "said", [few], 1.5, cell=6.0, fractional=False).summary["frames"] == 1
    for x in (3.5 * few, 3.5 * few - 2.5):
        with pytest.raises(InputError, match="fractional"):
            mdnum.Recorder(1.0, cell=4.0, fractional=True).see(0, x)
    assert recorded(tmp_path / "f", [3 * few - 1], 1.0, cell=4.0, fractional=True).summary["frames"] == 1
    notes = [
        recorded(tmp_path / name, [size * few], 1.5).summary["notes"] for name, size in (("a", 1), ("b", 3))
    ]
    assert "fractional=True" in notes[0][0] and notes[1] == []


def test_an_atom_that_is_wrapped_changes_no_image(tmp_path):
    frames, cell = gas(2, 10, 9, 3.4), 0.6 * TILTED.T
    frames = frames[:1] + 0.2 * (frames - frames[:1])
    wrapped = np.array([(x @ np.linalg.inv(cell) % 1.0) @ cell for x in frames])
    made = [recorded(tmp_path / name, x, 2.9, cell=cell) for name, x in (("a", frames), ("b", wrapped))]
    names = ("frame", "i", "j", "entered", "distance")
    rows = [one.table("images").to_pydict() for one in made]
    several = [
        sorted((*key[:4], round(key[4], 9)) for key in zip(*(one[name] for name in names), strict=True))
        for one in rows
    ]
    assert several[0] == several[1] and len(several[0]) > 30
    assert rows[0]["shift_a"] != rows[1]["shift_a"]


# ---- lists in use


def listed(x: np.ndarray, cell: np.ndarray, reach: float) -> tuple[np.ndarray, ...]:
    """A full list (i, j, S), by brute force."""
    found = list(images(x, cell, reach))
    rows = np.array(found + [(j, i, *(-np.array(s))) for i, j, *s in found])
    return rows[:, 0], rows[:, 1], rows[:, 2:]


def test_planted_pairs_that_a_list_lacks_are_found_with_their_time(tmp_path):
    frames, cell = np.repeat(gas(3, 1), 9, axis=0), np.diag([6.0] * 3)
    inside = images(frames[0], cell, 2.5)
    (a, b, *_), (c, d, *_), (e, f, *_) = list(inside)[5:8]
    i, j, _ = listed(frames[0], cell, 3.0)
    with mdnum.Recorder(2.5, cell=cell, out=tmp_path / "r", report=False) as one:
        for step, x in enumerate(frames):
            both = np.isin(i * 24 + j, [24 * a + b, 24 * b + a]) & (2 <= step < 5)
            half = (i == d) & (j == c) & (step >= 4)
            keep = ~(both | half)
            given = (i[keep], j[keep])
            if step == 7:
                # half of a half list is the whole of it
                given = (i[i < j], j[i < j])
            one.see(10 * step, x, neighbors=given if step != 8 else None)
    assert (e, f) not in ((a, b), (c, d))
    lost = one.outcome.table("lost").to_pylist()
    found = [tuple(row[name] for name in ("i", "j", "missing", "begin", "end", "number")) for row in lost]
    assert found == [(a, b, 2, 2, 5, 20), (c, d, 1, 4, 7, 40)]
    depths = [2.5 - inside[key] for key in list(inside)[5:7]]
    assert [row["deepest"] for row in lost] == pytest.approx(depths, rel=1e-12)
    told = one.outcome.summary["lists"]
    assert (told["lost"], told["lost_frames"], told["first"], told["lists"]) == (2, 5, 20, 5)
    assert "LOST_PAIRS" in codes(one.outcome) and one.outcome.verdict.tone == "error"
    assert one.outcome.plot("loop_lists") is not None


@pytest.mark.parametrize("skin", [0.1, 2.0])
def test_a_skin_that_is_used_up_loses_what_brute_force_finds(tmp_path, skin):
    frames, cell = gas(4, 12), np.diag([6.0] * 3)
    frames = frames[:1] + 0.3 * (frames - frames[:1])
    i, j, _ = listed(frames[0], cell, 2.5 + skin)
    with mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "r", report=False) as one:
        one.see(0, frames[0], neighbors=np.array([i, j]))
        for step, x in enumerate(frames[1:], 1):
            one.see(step, x)
    known = {(a, b) for a, b in zip(i.tolist(), j.tolist(), strict=True)}
    wanted = [sum(key[:2] not in known for key in images(x, cell, 2.5)) for x in frames]
    loop = one.outcome.table("loop").to_pydict()
    assert loop["lost"] == wanted and (max(wanted) > 5) == (skin < 1)
    assert ("LOST_PAIRS" in codes(one.outcome)) == (skin < 1)
    assert loop["new_list"] == [True] + 11 * [False]


def test_a_pair_that_is_missing_again_is_one_pair(tmp_path):
    rng, cell = np.random.default_rng(7), np.diag([6.0] * 3)
    frames = rng.uniform(0, 6, (24, 3)) + np.cumsum(rng.normal(0, 0.15, (30, 24, 3)), axis=0)
    i, j, _ = (part[: len(part) // 2] for part in listed(frames[0], cell, 2.6))
    with mdnum.Recorder(2.5, cell=cell, out=tmp_path / "r", report=False) as one:
        one.see(0, frames[0], neighbors=(i, j))
        for step, x in enumerate(frames[1:], 1):
            one.see(step, x)
    known = set(zip(i.tolist(), j.tolist(), strict=True))
    lost = [{key[:2] for key in images(x, cell, 2.5)} - known for x in frames]
    told, apart = one.outcome.summary["lists"], set().union(*lost)
    assert (told["lost"], told["pair_frames"]) == (len(apart), sum(map(len, lost)))
    starts = sum(len(now - before) for before, now in pairwise([set(), *lost]))
    assert told["times"] == starts > told["lost"] > 10
    found = next(each for each in one.outcome.findings if each.code == "LOST_PAIRS")
    assert str(len(apart)) in found.title and str(starts) in found.text
    worst = told["worst"]["i"], told["worst"]["j"]
    assert told["worst"]["frames"] == sum(worst in now for now in lost)


def test_images_that_a_list_lacks_and_stale_shifts_are_found(tmp_path):
    x, cell = gas(5, 1, 8, 3.4)[0], 0.6 * TILTED.T
    i, j, s = listed(x, cell, 2.9)
    gone = 7
    keep = ~(
        ((i == i[gone]) & (j == j[gone]) & (s == s[gone]).all(1))
        | ((i == j[gone]) & (j == i[gone]) & (s == -s[gone]).all(1))
    )
    nearest = len({(a, b) for a, b in zip(i.tolist(), j.tolist(), strict=True) if a != b}) // 2
    moved = x.copy()
    moved[2] += cell[0]
    with mdnum.Recorder(2.9, cell=cell, out=tmp_path / "r", report=False) as one:
        one.see(0, x, neighbors=(i, j, s))
        one.see(1, x, neighbors=(i[keep], j[keep], s[keep]))
        one.see(2, x, neighbors=(i, j))
        # an atom is put into another cell, and the list is not told
        one.see(3, moved, neighbors=(i, j, s))
        one.see(4, moved, neighbors=listed(moved, cell, 3.5))
    own = sum(2 in key[:2] and key[0] != key[1] for key in images(x, cell, 2.9))
    lost = one.outcome.table("loop")["lost"].to_pylist()
    assert lost[:2] == [0, 1] and lost[2] == len(i) // 2 - nearest and lost[4] == 0
    assert 0 < lost[3] <= own


@pytest.mark.parametrize("kind", ["full", "half", "shifted", "half shifted"])
def test_lists_that_are_made_again_lose_what_brute_force_finds(tmp_path, kind):
    """Atoms are wrapped, entries come in any order and from either side, and some are left out."""
    rng, cell = np.random.default_rng(11), np.diag([6.0] * 3)
    frames = gas(8, 25) % 6.0
    full, shifted, lost, half, known = "half" not in kind, "shifted" in kind, [], [], {}
    with mdnum.Recorder(2.5, cell=cell, out=tmp_path / "r", report=False) as one:
        for step, x in enumerate(frames):
            if step % 3 == 0:
                i, j, s = listed(x, cell, 2.9)
                keep = rng.permutation(len(i))[(0 if step % 2 else 4) :]
                if not full:
                    # of each pair the entry that comes first
                    ends = {(*sorted((i[k], j[k])), *abs(s[k])): k for k in keep[::-1].tolist()}
                    keep = rng.permutation(list(ends.values())[2:])
                i, j, s = i[keep], j[keep], s[keep]
                known = set(zip(i.tolist(), j.tolist(), *(s.T.tolist() if shifted else ()), strict=True))
            one.see(step, x, neighbors=(i, j, s) if shifted else (i, j))
            keys = [(a, b, *shift) if shifted else (a, b) for a, b, *shift in images(x, cell, 2.5)]
            sides = [
                (key in known) + ((b, a, *(-n for n in rest)) in known)
                for key in keys
                for a, b, *rest in [key]
            ]
            lost.append(sum(n < 1 + full for n in sides))
            half.append(full * sum(n == 1 for n in sides))
    loop, rows = (one.outcome.table(name).to_pydict() for name in ("loop", "lost"))
    assert loop["lost"] == lost and min(lost) == 0 < max(lost)
    ends = zip(rows["begin"], rows["end"], rows["missing"], strict=True)
    assert sum(end - begin for begin, end, missing in ends) == sum(lost)


class Dense:
    """What jax-md's dense list has."""

    class format:
        name = "Dense"

    def __init__(self, rows: np.ndarray, overflow: bool):
        self.idx, self.did_buffer_overflow = rows, np.array(overflow)


@pytest.mark.parametrize("capacity", [8, 14])
def test_an_overflow_is_harmful_where_pairs_are_lost(tmp_path, capacity):
    x, cell = gas(6, 1)[0], np.diag([6.0] * 3)
    i, j, _ = listed(x, cell, 3.0)
    rows = np.full((24, capacity), 24)
    near = {key[:2] for key in images(x, cell, 2.5)}
    for atom in range(24):
        # those inside first, so that the skin overflows first
        mine = sorted(j[i == atom].tolist(), key=lambda b: tuple(sorted((atom, b))) not in near)
        rows[atom, : len(mine)] = mine[:capacity]
    wanted = sum(b not in rows[a] or a not in rows[b] for a, b in near)
    assert (wanted > 0) == (capacity == 8)
    with mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "r", report=False) as one:
        for step in range(5):
            one.see(step, x, neighbors=Dense(rows, overflow=step in (2, 3)))
    told = one.outcome.summary["lists"]["overflow"]
    assert (told["frames"], told["first"], told["last"], told["lost"]) == (2, 2, 3, wanted)
    severity = {each.code: each.severity for each in one.outcome.findings}
    assert severity["OVERFLOW"] == ("error" if wanted else "info")


@pytest.fixture
def jax_as_users_have_it():
    import jax

    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.mark.nightly
@pytest.mark.usefixtures("jax_as_users_have_it")
@pytest.mark.parametrize("kind", ["Dense", "Sparse", "OrderedSparse", "images"])
def test_lists_of_jax_md_are_read_as_it_means_them(tmp_path, kind):
    import jax.numpy as jnp
    from jax_md import custom_partition, partition, space

    box = jnp.asarray(0.75 * TILTED if kind == "images" else TILTED, jnp.float32)
    cell, reach = np.asarray(box, float).T, 2.3
    x = np.random.default_rng(0).uniform(0, 1, (20, 3)).astype(np.float32)
    if kind == "images":
        made = custom_partition.neighbor_list_multi_image(
            None, box, reach, 0.1, capacity_multiplier=1.0, fractional_coordinates=True
        )
        neighbors = made.allocate(jnp.asarray(x))
    else:
        displacement, _ = space.periodic_general(box, fractional_coordinates=True)
        made = partition.neighbor_list(
            displacement, box, reach, 0.3, fractional_coordinates=True, disable_cell_list=True,
            capacity_multiplier=1.0, format=getattr(partition, kind),
        )  # fmt: skip
        neighbors = made.allocate(jnp.asarray(x))
    crowded = (0.4 * x).astype(np.float32)
    full = neighbors.update(jnp.asarray(crowded))
    with mdnum.Recorder(reach, box=box, fractional=True, out=tmp_path / "r", report=False) as one:
        one.see(0, x, neighbors=neighbors)
        one.see(1, crowded, neighbors=full)
    inside = images(crowded @ cell, cell, reach)
    # what it has, from the side of each atom
    idx, have = [np.asarray(part).tolist() for part in full.idx], set()
    for k, (i, j) in enumerate(
        [(i, j) for i, row in enumerate(idx) for j in row] if kind == "Dense" else zip(*idx, strict=True)
    ):
        have.add((i, j, *(np.asarray(full.shifts)[k].tolist() if kind == "images" else ())))
    wanted = 0
    for i, j, *shift in inside:
        at = tuple(shift) if kind == "images" else ()
        sides = (i, j, *at) in have, (j, i, *(-s for s in at)) in have
        wanted += not (any(sides) if kind == "OrderedSparse" else all(sides))
    told, loop = one.outcome.summary["lists"], one.outcome.table("loop").to_pydict()
    assert loop["overflow"] == [False, True] and loop["lost"] == [0, wanted]
    assert 0 < wanted == told["overflow"]["lost"] < len(inside)


# ---- energies


@pytest.mark.parametrize("known", [True, False])
def test_an_energy_that_steps_with_flips_is_told_from_one_that_does_not(tmp_path, known):
    frames, cell = gas(frames=40), np.diag([6.0] * 3)
    inside = np.array([len(images(x, cell, 2.5)) for x in frames[:20]])
    quiet = 3.0 + 0.01 * np.sin(np.arange(20))
    law: dict[str, Any] = {"pair_energy": lambda r: -0.25 * (r == 2.5)} if known else {}
    made = {}
    for name, energy in (("steps", quiet - 0.25 * inside), ("smooth", quiet)):
        with mdnum.Recorder(2.5, cell=cell, out=tmp_path / name, report=False, **law) as one:
            one.see_many(frames[:20], energy=energy)
        made[name] = one.outcome
    told = made["steps"].summary["energy"]
    assert told["slope"] == pytest.approx(-0.25, abs=3 * told["error"]) and told["error"] < 1e-3
    assert "ENERGY_STEPS" in codes(made["steps"]) and "ENERGY_STEPS" not in codes(made["smooth"])
    if known:
        assert told["jumps"] == -0.25 * (inside[-1] - inside[0])
        assert told["rest"] == pytest.approx(float(quiet.std()), rel=1e-9)
        flips = made["steps"].table("flips").to_pydict()
        signs = {bool(on): jump for on, jump in zip(flips["entered"], flips["energy_jump"], strict=True)}
        assert signs == {True: -0.25, False: 0.25}
    assert made["steps"].plot("loop_energy") is not None


# ---- loops of others


def test_ase_attaches_a_recorder(tmp_path):
    from ase.build import bulk
    from ase.calculators.lj import LennardJones
    from ase.md.velocitydistribution import MaxwellBoltzmannDistribution
    from ase.md.verlet import VelocityVerlet

    atoms = bulk("Ar", "fcc", a=5.3, cubic=True).repeat(2)
    atoms.calc = LennardJones(sigma=3.4, epsilon=0.0104, rc=5.2)
    MaxwellBoltzmannDistribution(atoms, temperature_K=60, rng=np.random.default_rng(0))
    dynamics = VelocityVerlet(atoms, 5.0)
    kept: list[ase.Atoms] = []
    totals: list[float] = []
    with (
        mdnum.Recorder(3.85, atoms=atoms, out=tmp_path / "a", report=False) as one,
        mdnum.Recorder(3.85, out=tmp_path / "b", report=False) as other,
    ):
        dynamics.attach(one, interval=1)
        dynamics.attach(other, 1, dynamics)
        dynamics.attach(lambda: kept.append(atoms.copy()), interval=1)
        dynamics.attach(lambda: totals.append(atoms.get_total_energy()), interval=1)
        dynamics.run(12)
    write(tmp_path / "f.traj", kept)
    file = mdnum.flips(tmp_path / "f.traj", cutoffs=3.85, out=tmp_path / "c", report=False)
    tables = ("members", "flips", "contacts")
    assert same(file, one.outcome, tables) and same(file, other.outcome, tables)
    assert file.table("flips").num_rows > 10
    assert one.outcome.table("loop")["energy"].to_pylist() == totals and len(totals) == 13
    assert other.outcome.table("frames")["number"].to_pylist() == list(range(13))


def test_a_compiled_loop_calls_the_host_in_order(tmp_path):
    import jax
    import jax.numpy as jnp

    frames = gas(frames=15).astype(np.float32)
    i, j, _ = listed(frames[0].astype(float), np.diag([6.0] * 3), 2.8)
    pairs, speed = jnp.array([i, j]), jnp.asarray(frames[1] - frames[0])
    seen = mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "h", report=False)

    @jax.jit
    def loop(x):
        def body(x, step):
            seen.hook(step, x, neighbors=pairs, energy=x.sum())
            return x + speed, x

        return jax.lax.scan(body, x, jnp.arange(15))[1]

    steps = loop(jnp.asarray(frames[0]))
    plain = mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "p", report=False)
    plain.see_many(steps, neighbors=pairs)
    assert same(seen.outcome, plain.outcome) and seen.outcome.table("flips").num_rows > 100
    made = [one.outcome.table("loop")["lost"].to_pylist() for one in (seen, plain)]
    assert made[0] == made[1] and max(made[0]) > 5


def test_two_loops_are_compared_by_their_decisions(tmp_path):
    frames, other = gas(), gas()
    near = next(k for k in range(10, 20) if len(images(frames[k], np.diag([6.0] * 3), 2.5)) > 70)
    other[near:, 7] += 0.4
    made = [mdnum.Recorder(2.5, cell=6.0, out=tmp_path / name, report=False) for name in "abc"]
    for one, x in zip(made, (frames, other, frames + np.array([0.1, 0, 0])), strict=True):
        one.see_many(x)
    found = made[0].compare(made[1])
    inside = [[set(images(x[k], np.diag([6.0] * 3), 2.5)) for k in range(24)] for x in (frames, other)]
    fork = next(k for k in range(24) if inside[0][k] != inside[1][k])
    alone = {key[:2] for key in inside[0][fork] ^ inside[1][fork]}
    assert found.fork == fork == near and {one.subject[:2] for one in found.decisions} == alone
    assert found.same_structure and found.steps == 23
    assert made[0].compare(made[0]).fork is None and made[0].compare(made[2]).fork is None


@pytest.mark.parametrize("same", [True, False])
def test_folders_of_loops_and_of_arrays_are_compared(tmp_path, same):
    frames, cell = gas(), np.diag([6.0] * 3)
    other = frames.copy()
    other[12:, 7] += 0.0 if same else 0.4
    loop = recorded(tmp_path / "a", frames, pairs={"X-X": 2.0}, cell=6.0, species=["X"] * 24)
    array = mdnum.flips(other, cell=6.0, cutoffs=2.5, pairs={"X-X": 2.0}, out=tmp_path / "b", report=False)
    one = mdnum.fork_folders(tmp_path / "a", tmp_path / "b", out=tmp_path / "c")
    found = {
        r: [[set(images(x[k], cell, r)) for k in range(24)] for x in (frames, other)] for r in (2.5, 2.0)
    }
    fork = next((k for k in range(24) if any(a[k] != b[k] for a, b in found.values())), None)
    assert one.result.fork == one.summary["fork"] == fork == (None if same else 12)
    assert one.result.steps == 23 and one.summary["atoms"] == 24
    assert [row[0] for row in one.result.differences] == ["time"]
    alone = {key[:2] for a, b in found.values() for key in (a[12] ^ b[12])}
    assert {each.subject[:2] for each in one.result.decisions} == alone and bool(alone) != same
    for each in (one, array, loop):
        schema = json.loads((Path(mdnum.__file__).parent / f"schemas/{each.kind}.json").read_text())
        assert Draft202012Validator(closed(schema)).is_valid(plain(each.summary))
    again = mdnum.read(one.path)
    assert again.verdict.tone == ("good" if same else "info") and (one.path / "report.html").exists()
    for options, word in (({"replay": True}, "replay"), ({"steps": 3}, "replay")):
        with pytest.raises(InputError, match=word):
            mdnum.fork_folders(loop.path, array.path, **options)
    less = recorded(tmp_path / "d", frames, cell=6.0)
    with pytest.raises(InputError, match="rule"):
        mdnum.fork_folders(loop.path, less.path)


GROWN = """
import sys
import numpy as np
import mdnum
def resident():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) // 1024
rng = np.random.default_rng(0)
x, v = rng.uniform(0, 6, (12, 3)), rng.normal(0, 0.05, (12, 3))
i, j = np.triu_indices(12, 1)
one = mdnum.Recorder(2.5, cell=6.0, out=sys.argv[1], report=False)
for step in range(60_001):
    one.see(step, x + step * v, neighbors=(i, j) if step % 10 else (j, i), energy=1.0)
    if step in (20_000, 60_000):
        print(resident())
print(one.outcome.summary["frames"])
"""


@pytest.mark.nightly
def test_memory_does_not_grow_with_frames(tmp_path):
    done = subprocess.run([sys.executable, "-c", GROWN, str(tmp_path / "g")], capture_output=True, check=True)
    early, late, frames = map(int, done.stdout.split())
    assert frames == 60_001 and late - early < 30


# ---- loops that end early

KILLED = """
import os, signal, sys
import numpy as np
import mdnum
rng = np.random.default_rng(0)
x, v = rng.uniform(0, 6, (24, 3)), rng.normal(0, 0.25, (24, 3))
one = mdnum.Recorder(2.5, cell=6.0, out=sys.argv[1])
import mdnum.verbs.recorder as recorder
recorder._EVERY = recorder._TIMES = 0.0
for step in range(40):
    one.see(step, x + step * v, neighbors=(np.array([0]), np.array([1])), energy=1.0)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_loop_that_is_killed_leaves_what_was_seen(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "k")], check=False)
    assert done.returncode == -9
    kept = mdnum.read(tmp_path / "k")
    assert [one.code for one in kept.findings] == ["LOST_PAIRS", "NOT_CLOSED"]
    assert kept.summary["status"] == "unfinished" and "39" in kept.verdict.headline
    frames = gas(frames=40)
    whole = recorded(tmp_path / "w", frames, cell=6.0)
    assert same(kept, whole, ("members", "flips", "frames")) and kept.table("loop").num_rows == 40
    with pytest.raises(mdnum.FolderError):
        mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "k").see_many(frames)


@pytest.mark.parametrize("at", [0, 15])
def test_a_loop_is_told_nothing_about_files_and_commands(tmp_path, at):
    frames = gas()
    frames[at, 3] = np.nan
    with (
        pytest.raises(InputError) as raised,
        mdnum.Recorder(2.5, nearest=4, timestep=0.1, out=tmp_path / "n", report=False) as one,
    ):
        for step, x in enumerate(frames, 100):
            one.see(step - 50 * (step < 104), x)
    told = str(raised.value)
    if at:
        found, evidence = one.outcome.findings, one.outcome.verdict.evidence
        assert {"STOPPED", "CENSORED", "READING", "MISSING_FRAMES"} <= codes(one.outcome)
        told += " ".join([*evidence, *(text for x in found for text in (x.title, x.text, x.remedy))])
    assert f"frame {115 if at else 50}" in told
    assert not re.search(r"\bfile|@|--", told)


def test_a_loop_that_raises_early_is_kept_where_it_is_closed(tmp_path):
    frames = gas()
    with pytest.raises(ZeroDivisionError), mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "w") as one:
        one.see_many(frames[:3])
        _ = 1 / 0
    plain = mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "p", report=False)
    plain.see_many(frames[:3])
    assert not (tmp_path / "p").exists() and one.outcome.summary["frames"] == 3
    plain.close(ZeroDivisionError())
    assert plain.outcome.summary["status"] == "stopped" and "INTERRUPTED" in codes(plain.outcome)


def test_an_error_in_the_loop_keeps_what_came_before(tmp_path):
    frames = gas()
    with pytest.raises(ZeroDivisionError), mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "r") as one:
        one.see_many(frames[:12])
        _ = 1 / 0
    assert one.outcome.summary["status"] == "stopped" and one.outcome.summary["frames"] == 12
    assert "INTERRUPTED" in codes(one.outcome) and (tmp_path / "r" / "report.html").exists()
    broken = frames.copy()
    broken[15, 3] = np.nan
    with pytest.raises(InputError, match="15"), mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "n") as one:
        one.see_many(broken)
    assert one.outcome.summary["frames"] == 15 and "STOPPED" in codes(one.outcome)
    with pytest.raises(InputError), mdnum.Recorder(2.5, cell=6.0, out=tmp_path / "no") as one:
        one.see(0, broken[15])
        one.close()
    assert not (tmp_path / "no").exists()
