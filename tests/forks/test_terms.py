"""Forks of terms with different radii: a pair has a decision for each, and they are imposed one by one."""

from __future__ import annotations

import shutil
from functools import cache
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from forks.harness import crystal, pair
from rollout.harness import history, moved, nearest

import mdnum
from mdnum import Cut, LennardJones, Term
from mdnum.forks import fork
from mdnum.forks.folders import compare_folders
from mdnum.forks.replays import neighborhood, pinned
from mdnum.forks.worlds import twin
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import Pin, Pins
from mdnum.rollout.flips import PairRecorder
from mdnum.store import files as manifest

STEPS, RADII = 900, {"core": crystal().r_cut, "tail": 1.945}


@cache
def two_terms():
    """The cold crystal whose second shell lies at the cutoff, with a weak tail that ends at its third."""
    plain = crystal()
    terms = {
        "core": Term(LennardJones(sigma=1.0, epsilon=1.0), Cut("hard", RADII["core"])),
        "tail": Term(LennardJones(sigma=1.0, epsilon=0.02), Cut("hard", RADII["tail"])),
    }
    return mdnum.simulation(
        plain.structure, terms, units="lj", timestep=plain.timestep, skin=plain.rule.skin,
        temperature=plain.draw.temperature, seed=plain.draw.seed,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return fork(pair(two_terms(), moved(two_terms(), 1e-7)), STEPS, split=0.03, repeats=0)


def decided(simulation, x):
    """{(channel, i, j)} of distances, at one step."""
    i, j = np.triu_indices(simulation.atoms, 1)
    square = np.sum(nearest(simulation, x[i] - x[j]) ** 2, axis=1)
    return {
        (channel, int(a), int(b))
        for channel, radius in enumerate(RADII.values())
        for a, b in zip(i[square < radius**2], j[square < radius**2], strict=True)
    }


def test_cross_flips_are_those_of_the_distances(found):
    a, b = (two_terms(), moved(two_terms(), 1e-7))
    last = min(found.steps, 500)
    (xa, _), (xb, _) = (history(one, last) for one in (a, b))
    differ = [decided(a, one) ^ decided(b, other) for one, other in zip(xa, xb, strict=True)]
    np.testing.assert_array_equal(found.series["cross"][: last + 1], [len(one) for one in differ])
    changes = {(step, *key) for step in range(1, last + 1) for key in differ[step] ^ differ[step - 1]}
    atoms = a.atoms
    assert changes == {(f.step, *divmod(f.i, atoms), f.j) for f in found.flips if f.step <= last}
    assert {key[1] for key in changes} == {0, 1}


def test_decisions_are_imposed_term_by_term(found):
    # under the decisions of A the runs stay together where they would not
    free, imposed = found.series["B"], found.series["B|A"]
    assert np.nanmax(imposed) < 1e-5 and np.nanmax(free) > 20 * np.nanmax(imposed)
    alone = pinned(found)
    assert alone.pairs == (tuple(found.decision.subject),)
    fork_at = found.dates.fork
    np.testing.assert_array_equal(alone.separation[: fork_at + 1], found.series["B"][: fork_at + 1])
    around = neighborhood(found)
    assert around is not None and around.margins[0] * around.margins[1] < 0


@pytest.mark.parametrize("channel", [0, 1])
def test_a_pin_is_one_of_its_term(channel):
    simulation = two_terms()
    x, _ = history(simulation, 5)
    i, j = sorted(next(key[1:] for key in sorted(decided(simulation, x[0])) if key[0] == channel))
    pins = Pins([Pin(i + channel * simulation.atoms, j, 0, 5, (), False)])
    other, _ = history(simulation, 5, pins=pins)
    force = np.abs(other[-1] - x[-1]).sum(axis=1)
    # without the energy of this pair in one term its atoms move apart from where they would be
    assert set(np.argsort(force)[-2:]) == {i, j}
    # and not as where the other term is pinned
    pins = Pins([Pin(i + (1 - channel) * simulation.atoms, j, 0, 5, (), False)])
    assert not np.array_equal(history(simulation, 5, pins=pins)[0], other)


def test_a_lost_pair_is_lost_in_the_term_that_it_belongs_to():
    """A list that is never rebuilt: what new lists find enters the term whose radius holds it."""
    hot = mdnum.simulation(
        crystal().structure,
        {key: Term(LennardJones(sigma=1.0, epsilon=0.1), Cut("hard", r)) for key, r in RADII.items()},
        units="lj", timestep=0.01, skin=0.05, temperature=1.5, seed=1, rebuild=(20, 0, False),
    )  # fmt: skip
    recorder, flips, missed = PairRecorder(hot), [], 0
    for segment in Engine(hot, 60).segments():
        flips.append(recorder.flips(segment))
        missed += recorder.missed
    assert missed > 0
    members = decided(hot, history(hot, 0)[0][0])
    for ledger in flips:
        for i, j, entered in zip(ledger.i.tolist(), ledger.j.tolist(), ledger.entered.tolist(), strict=True):
            key = (*divmod(i, hot.atoms), j)
            assert (key in members) != entered
            (members.add if entered else members.discard)(key)


def unlisted(folder):
    """A folder that may be edited: its manifest, which would tell, lists no file."""
    manifest.save(folder, manifest.Manifest(mdnum.store.RunFolder.open(folder).layout))


def equal_terms(radius=RADII["core"]):
    """Both ends at one radius, so that a pair has one decision."""
    terms = {
        "core": Term(LennardJones(sigma=1.0, epsilon=1.0), Cut("hard", RADII["core"])),
        "tail": Term(LennardJones(sigma=1.0, epsilon=0.02), Cut("hard", radius)),
    }
    return mdnum.simulation(
        crystal().structure, terms, units="lj", timestep=0.004, temperature=1.2, seed=4, skin=0.3, drawn=True
    )


def test_twins_of_which_one_shares_decisions():
    """Another radius of one of the terms: both programs are followed with a decision for each."""
    made = twin(equal_terms(), {"terms.tail.cutoff.radius": 1.6}, "wider", "")
    assert [one.simulation.channels for one in (made.a, made.b)] == [2, 2]
    found = fork(made, 40, repeats=0, split=0.5)
    assert found.dates.fork is not None and found.decision is not None
    pair_of = made.a.simulation.pair_of(*found.decision.subject)
    assert pair_of["terms"] == "tail" and pair_of["i"] < made.a.simulation.atoms
    # the same decisions apart and together
    together, apart = (history(one, 20)[0] for one in (equal_terms(), equal_terms().apart))
    np.testing.assert_allclose(together, apart, rtol=0, atol=1e-9)


def test_a_map_names_the_term_of_a_boundary(tmp_path):
    made = mdnum.fork_map(
        two_terms(), "terms.tail.potential.epsilon", 0.02, 0.02002, steps=150, confirm=False,
        out=tmp_path / "map",
    )  # fmt: skip
    assert made.summary["boundaries"]
    for edge in made.summary["boundaries"]:
        assert edge["i"] < 108 and edge["terms"] in RADII and f"({edge['terms']})" in edge["who"]


def hot():
    """A liquid, in which pairs cross both radii one after the other."""
    terms = {key: Term(LennardJones(sigma=1.0, epsilon=0.1), Cut("hard", r)) for key, r in RADII.items()}
    return mdnum.simulation(
        crystal().structure, terms, units="lj", timestep=0.005, skin=0.3, temperature=2.5, seed=1, drawn=True
    )


@pytest.fixture(scope="module")
def liquid(tmp_path_factory):
    return mdnum.run(hot(), steps=300, out=tmp_path_factory.mktemp("terms") / "liquid")


def test_flips_of_a_pair_are_followed_term_by_term(liquid):
    flips = mdnum.store.RunFolder(liquid.folder).read("flips")
    keys = list(zip(flips["i"].tolist(), flips["j"].tolist(), strict=True))
    entered = dict.fromkeys(keys, ())
    for key, now in zip(keys, flips["entered"].tolist(), strict=True):
        entered[key] = (*entered[key], now)
    # a pair enters twice in a row
    assert any(first and now for row in entered.values() for first, now in pairwise(row))
    assert "LEDGER_INCOMPLETE" not in {one["code"] for one in liquid.summary["findings"]}
    text = (liquid.folder / "report.html").read_text()
    assert all(f"({name})</td>" in text for name in RADII) and ">term<" in text


def test_folders_compare_decisions_term_by_term(liquid, tmp_path):
    copy = tmp_path / "planted"
    shutil.copytree(liquid.folder, copy)
    unlisted(copy)
    table = pq.ParquetFile(copy / "flips.parquet").read()
    row = len(table) // 2
    # the same flip, said of the other term
    terms = table["terms"].to_pylist()
    terms[row] = "core" if terms[row] == "tail" else "tail"
    at = table.column_names.index("terms")
    pq.write_table(table.set_column(at, "terms", pa.array(terms)), copy / "flips.parquet")
    found = compare_folders(liquid.folder, copy)
    subject = (table["i"][row].as_py(), table["j"][row].as_py())
    assert found.fork == table["step"][row].as_py()
    assert {(one.run, one.subject, one.terms) for one in found.decisions} == {
        ("A", subject, table["terms"][row].as_py()), ("B", subject, terms[row])
    }  # fmt: skip
    with pytest.raises(mdnum.InputError, match=r"objects=\["):
        mdnum.fork_folders(liquid.folder, copy, out=tmp_path / "compared")
    with pytest.raises(mdnum.InputError, match="differs from that"):
        mdnum.fork_folders(liquid.folder, copy, objects=[two_terms()], out=tmp_path / "compared")
    objects = [two_terms(), hot()]
    shown = mdnum.fork_folders(liquid.folder, copy, objects=objects, out=tmp_path / "compared")
    assert f"{subject[0]}–{subject[1]} ({terms[row]})" in (shown.folder / "report.html").read_text()


def test_folders_of_objects_are_replayed(liquid, tmp_path):
    other = mdnum.changed(hot(), {"terms.tail.potential.epsilon": 0.11})
    ran = mdnum.run(other, steps=60, out=tmp_path / "other")
    made = mdnum.fork_folders(
        liquid.folder, ran.folder, replay=True, objects=[other, hot()], steps=60, repeats=0, lyapunov=False,
        out=tmp_path / "replay",
    )  # fmt: skip
    assert made.summary["reproduced"] and made.summary["stored"]["steps"] == 60
    decision = made.summary["decision"]
    assert decision["terms"] in RADII and f"of the term {decision['terms']}" in str(made.verdict)


@pytest.mark.nightly
def test_folders_of_shared_and_separate_decisions(tmp_path):
    """Another radius of one of the terms, which share their decisions in the first run alone."""
    runs = [mdnum.run(equal_terms(*r), steps=20, out=tmp_path / f"{len(r)}").folder for r in ((), (1.62,))]
    found = compare_folders(*runs)
    assert found.fork == 0 and found.causes == ("terms.tail.cutoff.radius",)
    # other terms are another system
    text = (runs[1] / "simulation.json").read_text()
    (runs[1] / "simulation.json").write_text(text.replace('"lennard-jones"', '"morse"', 1))
    unlisted(runs[1])
    with pytest.raises(mdnum.InputError, match=r"terms\.core\.potential\.kind"):
        compare_folders(*runs)
