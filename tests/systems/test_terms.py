"""Terms that add in system files, folders and calculators: the same as from objects."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mdnum
from mdnum import Cut, InputError, LennardJones, Morse, Term
from mdnum.forks.exact.program import unsupported
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.describe import program
from mdnum.systems.parameters import is_positive

FILE = """
name = "two"
units = "lj"
[structure]
builder = "fcc"
symbol = "Ar"
lattice_constant = 1.6
repeat = [4, 4, 4]
rattle = 0.05
[terms.core.potential]
kind = "lennard-jones"
sigma = 1.0
epsilon = 1.0
[terms.core.cutoff]
kind = "switched"
radius = 2.0
[terms.tail.potential]
kind = "morse"
depth = 0.1
alpha = 1.0
r0 = 2.0
[terms.tail.cutoff]
kind = "hard"
radius = 2.4
[terms.tail.weight]
Ar = 0.5
[dynamics]
kind = "nve"
timestep = 0.004
temperature = 0.7
seed = 3
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(FILE)
    return path


def of_objects(atoms, **tail):
    terms = {
        "core": Term(LennardJones(sigma=1.0, epsilon=1.0), Cut("switched", 2.0)),
        "tail": Term(
            **{
                "potential": Morse(depth=0.1, alpha=1.0, r0=2.0),
                "cutoff": Cut("hard", 2.4),
                "weight": {"Ar": 0.5},
                **tail,
            }
        ),
    }
    return mdnum.simulation(
        atoms, terms, units="lj", timestep=0.004, temperature=0.7, seed=3, skin=0.3, name="two"
    )


def test_a_file_is_the_objects(file):
    made = mdnum.build(file)
    assert json.dumps(program(made)) == json.dumps(program(of_objects(made.structure)))


@pytest.mark.nightly
def test_a_run_of_a_file_is_that_of_the_objects(file, tmp_path):
    made = mdnum.build(file)
    objects = of_objects(made.structure)
    for one, out in ((made, "a"), (objects, "b")):
        assert mdnum.run(one, steps=20, out=tmp_path / out).summary["energy_budget_closes"]
    a, b = (RunFolder(tmp_path / out) for out in "ab")
    for table in ("series", "flips"):
        for name, column in a.read(table).items():
            np.testing.assert_array_equal(column, b.read(table)[name])
    assert set(a.read("flips")["terms"].tolist()) <= {"core", "tail"}
    # what the folder holds is the system again
    again = load(tmp_path / "a")
    assert again.program == load(file).program
    text = (tmp_path / "a" / "report.html").read_text()
    assert "core: lennard-jones" in text and "tail: " in text


def test_keys_of_terms(file):
    made = mdnum.build(file, {"terms.core.potential.epsilon": 1.2, "terms.tail.cutoff.radius": 2.0})
    # with the same radius they share a decision
    assert made.channels == 1 and mdnum.build(file).channels == 2
    assert mdnum.parameters(made)["terms.core.potential.epsilon"].value == 1.2
    changed = mdnum.changed(mdnum.build(file), {"terms.core.potential.epsilon": 1.2})
    assert changed.file is not None and changed.file.spec.terms["core"].potential.epsilon == 1.2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[dynamics]",
            '[potential]\nkind = "lennard-jones"\nsigma = 1.0\nepsilon = 1.0\n[dynamics]',
            r"\[terms\.NAME\.potential\]",
        ),
        (
            '[terms.tail.cutoff]\nkind = "hard"',
            '[terms.tail.cutoff]\nkind = "hard"\ncompare = "r <"',
            "compare",
        ),
        ('kind = "morse"\ndepth = 0.1\nalpha = 1.0\nr0 = 2.0', 'kind = "tersoff"', "not a pair potential"),
        ("[terms.tail.weight]\nAr = 0.5", "[terms.tail.weight]\nKr = 0.5", "given for Ar"),
        ('[terms.tail.cutoff]\nkind = "hard"\nradius = 2.4', "", "cutoff"),
    ],
)
def test_files_that_make_no_sense_are_refused(file, old, new, message):
    assert old in FILE
    file.write_text(FILE.replace(old, new))
    with pytest.raises(InputError, match=message):
        mdnum.build(file)


def test_terms_of_objects_are_resumed_by_the_same(file, tmp_path):
    atoms = mdnum.build(file).structure
    whole = mdnum.run(of_objects(atoms), steps=40, out=tmp_path / "whole", check=False)
    mdnum.run(of_objects(atoms), steps=20, out=tmp_path / "half", check=False)
    with pytest.raises(InputError, match=r"terms\.tail\.weight"):
        mdnum.run(of_objects(atoms, weight={"Ar": 0.4}), resume=tmp_path / "half", steps=40)
    mdnum.run(of_objects(atoms), resume=tmp_path / "half", steps=40)
    a, b = (RunFolder(tmp_path / name).read("flips") for name in ("whole", "half"))
    assert len(a["step"]) == whole.summary["flips_entered"] + whole.summary["flips_left"]
    for name, column in a.items():
        np.testing.assert_array_equal(column, b[name])


def test_a_calculator_of_terms(file):
    made = mdnum.build(file)
    for system in (made, str(file)):
        atoms = made.structure.copy()
        atoms.calc = mdnum.MdnumCalculator(system)
        assert atoms.get_potential_energy() == pytest.approx(made.evaluate().energy, rel=1e-13)
    other = made.structure[:200]
    other.calc = mdnum.MdnumCalculator(made)
    with pytest.raises(InputError, match="weights"):
        other.get_potential_energy()


def test_a_certificate_refuses_terms(file):
    assert "'core + tail'" in unsupported(mdnum.build(file)).message


def test_one_of_several_equal_radii(file):
    equal = mdnum.build(file, {"terms.tail.cutoff.radius": 2.0})
    assert equal.channels == 1
    for made in (equal, of_objects(equal.structure, cutoff=Cut("hard", 2.0))):
        found = mdnum.parameters(made)
        # all of them, and each by itself
        for name in ("cutoff.radius", "terms.core.cutoff.radius", "terms.tail.cutoff.radius"):
            assert (found[name].value, found[name].unit) == (2.0, "σ")
        apart = mdnum.changed(made, {"terms.tail.cutoff.radius": 2.1})
        assert apart.channels == 2 and apart.decider.r_cut == (2.0, 2.1)
        assert "cutoff.radius" not in mdnum.parameters(apart)
        # with equal radii they share a decision again, with its bits
        again = mdnum.changed(apart, {"terms.tail.cutoff.radius": 2.0})
        assert again.channels == 1 and again.evaluate().energy == made.evaluate().energy
        assert mdnum.changed(made, {"cutoff.radius": 2.2}).decider.r_cut == (2.2,)
        with pytest.raises(InputError, match="onset"):
            mdnum.changed(made, {"terms.core.cutoff.radius": 1.7})
    wider = of_objects(equal.structure, cutoff=Cut("hard", 2.1))
    np.testing.assert_allclose(
        mdnum.changed(equal, {"terms.tail.cutoff.radius": 2.1}).evaluate().energy, wider.evaluate().energy
    )


def test_weights_are_parameters(file):
    for made in (mdnum.build(file), of_objects(mdnum.build(file).structure)):
        found = mdnum.parameters(made)["terms.tail.weight"]
        assert (found.by, found.unit, found.value.shape) == ("atom", "", (256,))
        assert "terms.core.weight" not in mdnum.parameters(made)
        other = mdnum.changed(made, {"terms.tail.weight": np.full(256, 0.7)})
        expected = of_objects(made.structure, weight={"Ar": 0.7})
        assert other.evaluate().energy == expected.evaluate().energy != made.evaluate().energy
        single = mdnum.changed(made, {"terms.tail.weight.17": 0.7})
        assert np.flatnonzero(mdnum.parameters(single)["terms.tail.weight"].value != 0.5).tolist() == [17]
        # a charge may have either sign
        assert not is_positive(made, "terms.tail.weight.17")
