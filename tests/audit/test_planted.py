"""Every planted mistake gives its code; what is right gives none."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk, fcc111
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.calculators.tip3p import TIP3P, angleHOH, rOH
from ase.calculators.tip4p import TIP4P
from ase.neighborlist import neighbor_list
from audit import planted
from audit.planted import Good, Single, asked, but, chain, codes, crystal, decimals, subject, values

from mdnum.audit.building import water
from mdnum.audit.checks import CHECKS, invariance
from mdnum.audit.checks.alone import AloneCheck
from mdnum.audit.checks.smoothness import SmoothnessCheck
from mdnum.audit.noise import NoiseFloor
from mdnum.audit.sequences import all_sequences
from mdnum.audit.subject import CalculatorError
from mdnum.units import ENERGY, FORCE, LENGTH

ROWS = "One object, asked again and again, beside new ones"
LJ = lambda: LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)  # noqa: E731


def mixed(atoms: Atoms, *krypton: int) -> Atoms:
    atoms.numbers[list(krypton)] = 36
    return atoms


class Wide(Good):
    """Takes no cell in which a search for the nearest images would be wrong."""

    def answer(self, atoms):
        if atoms.pbc.any() and atoms.cell.lengths().min() < 2 * planted.R_CUT:
            raise ValueError("the cell is narrower than two cutoffs")
        return super().answer(atoms)


class Breaks(Good):
    """Takes no structure without periods, and nothing any more after it was asked about one."""

    broken = False

    def answer(self, atoms):
        self.broken = self.broken or not atoms.pbc.any()
        if self.broken:
            raise RuntimeError("Lost atoms")
        return super().answer(atoms)


class Periodic(Good):
    """Takes no structure without periods, however often it is asked about one, and all others after it."""

    def answer(self, atoms):
        if not atoms.pbc.any():
            raise RuntimeError("no periods")
        return super().answer(atoms)


class Once(Good):
    """Has no room for fewer atoms than it has seen."""

    seen = 0

    def answer(self, atoms):
        self.seen = max(self.seen, len(atoms))
        if len(atoms) < self.seen - 3:
            raise IndexError("index 12 is out of bounds")
        return super().answer(atoms)


class KeepsCell(Good):
    """Keeps the cell of the last structure for a molecule, which has none."""

    cell = None

    def answer(self, atoms):
        if atoms.cell.rank == 3 and atoms.pbc.all():
            self.cell = atoms.cell.array.copy()
        if self.cell is not None and not atoms.cell.array.any():
            atoms = Atoms(atoms.numbers, atoms.positions, cell=self.cell, pbc=True)
        return super().answer(atoms)


def slab() -> Atoms:
    """Two layers that repeat along two axes, with a gap that is wider than the cutoff on both sides."""
    atoms = fcc111("Ar", (2, 2, 2), a=3.9, vacuum=6.0)
    atoms.pbc = (True, True, False)
    return atoms


class Bonds(Good):
    """Bonds between each third atom and the two after it, whatever they are and wherever."""

    def answer(self, atoms):
        head = np.repeat(np.arange(0, len(atoms), 3), 2)
        tail = head + np.tile([1, 2], len(atoms) // 3)
        vectors = atoms.positions[tail] - atoms.positions[head]
        if atoms.pbc.any():
            vectors -= np.rint(vectors @ np.linalg.inv(atoms.cell.array)) @ atoms.cell.array
        forces = np.zeros((len(atoms), 3))
        np.add.at(forces, head, vectors)
        np.add.at(forces, tail, -vectors)
        return 0.5 * float(np.sum(vectors**2)), forces


WATER = Atoms("OH2", [(0, 0, 0), (0.96, 0, 0), (-0.24, 0.93, 0)], cell=[4.0] * 3, pbc=True)


def grid_of_water() -> Atoms:
    half = np.radians(angleHOH) / 2
    arm = rOH * np.array([[0, 0, 0], [0, np.cos(half), np.sin(half)], [0, np.cos(half), -np.sin(half)]])
    return Atoms("OH2", positions=arm + 1.0, cell=[3.1] * 3, pbc=True).repeat((3, 3, 3))


def case(name: str, make, atoms: Atoms | None = None, *, night: bool = False, **expected: str | None):
    """What a check is asked about, and the severity of its codes; of None, that it is not taken for that."""
    marks = [pytest.mark.nightly] if night else []
    return pytest.param(name, make, crystal() if atoms is None else atoms, expected, marks=marks)


SevenDecimals = decimals(7)
#: What a finding tells beside its code.
TOLD = {
    SevenDecimals: ("QUANTIZED", {"forces_step": 1e-7}),
    planted.Entropy: ("TWO_ENERGIES", {"variants": ["free"]}),
    planted.OrderedEnergy: ("TWO_ENERGIES", {"variants": ["free", "wrong"]}),
    planted.SwappedEnergies: ("TWO_ENERGIES", {"variants": ["energy"]}),
    planted.WrapsGiven: ("CHANGED_INPUT", {"changed": "positions"}),
    Once: ("STALE_STATE", {"variants": ["refused"]}),
}
#: (in the name of a sequence, of a step) that finds a memory: the one that is meant for it.
WHERE = {
    # one atom alone may use up the whole skin
    planted.FullSkin: ("beyond the cutoff", ""),
    planted.OldTail: ("", "fewer neighbors"),
}


def found_by(check, make, atoms: Atoms, order: int | None = 4) -> dict[str, str]:
    """Severities of what a check finds by code, once what it tells about a calculator was looked at."""
    result = check(subject(make, atoms, order))
    code, expected = TOLD.get(make, ("", {}))
    if code in codes(result):
        told = values(result, code)
        assert {key: told[key] for key in expected} == expected
    wrong = [row for row in result.tables.get(ROWS, ()) if not row["same"]]
    if "STALE_STATE" in codes(result):
        told, worst = (
            values(result, "STALE_STATE"),
            max(wrong, key=lambda row: row[f"energy differs by ({ENERGY})"]),
        )
        assert (
            told["energy"].value == worst[f"energy differs by ({ENERGY})"]
            and told["step"] == worst["what happened"]
        )
        assert (
            told["force"] == worst[f"forces differ by ({FORCE})"] and told["energy"].floor == worst["allowed"]
        )
        assert told["sequences"] == ", ".join(sorted({row["sequence"] for row in wrong}))
        assert told["questions"] == result.numbers["remembered"] == len(wrong)
        # who answers again after a failure is not broken by it
        assert make is Once or "BROKEN_BY_FAILURE" not in codes(result)
    if make in WHERE:
        where, what = WHERE[make]
        assert any(where in row["sequence"] and what in row["what happened"] for row in wrong)
    return codes(result)


@pytest.mark.parametrize("name", ["invariance", "periodicity", "forces", "curl", "state", "alone", "caller"])
@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
def test_what_is_right_passes(name: str, atoms: Atoms):
    result = asked(name, Good, atoms)
    assert not result.findings and result.asked == result.possible > 3
    expected = {"invariance": ["invariance_right"], "state": ["state_none", "state_repeated"]}
    assert result.says[0] == expected.get(name, result.says[0])
    assert name != "state" or result.numbers["bit_identical"]


@pytest.mark.parametrize(
    ("name", "make", "atoms", "expected"),
    [
        # right, or no mistake: nothing else is said
        case("invariance", Single),
        case("invariance", Single, chain(), night=True),
        case("invariance", planted.HalfSkin),
        case("invariance", LJ, bulk("Ar", "fcc", a=5.26)),  # one atom in a cell needs images of images
        case("invariance", EMT, bulk("Cu")),
        case("invariance", planted.OnlyRectangles),
        case(
            "invariance",
            lambda: TIP3P(rc=4.5),
            grid_of_water(),
            TOPOLOGY_BY_ORDER="info",
            WHOLE_MOLECULES="warning",
        ),
        case("forces", Single, LOW_PRECISION="info", night=True),
        case("forces", Single, chain(), LOW_PRECISION="info"),
        case("forces", EMT, bulk("Cu"), night=True),
        case("curl", Single, chain()),
        case("curl", EMT, bulk("Cu"), night=True),
        # it is the derivative of another energy: a force along the line between two atoms that depends on
        # their distance alone has one
        case("curl", planted.NoSwitchInForce),
        case("state", planted.HalfSkin, night=True),
        case("state", planted.HalfSkin, chain()),
        case("caller", planted.WrapsGiven, chain()),
        # answers that go in steps are found whatever they look like; from an energy alone no force comes
        case("forces", planted.HalfPrecision, QUANTIZED="error", night=True),
        case("forces", planted.HalfInOtherUnits, QUANTIZED="error"),
        case("forces", planted.BrainFloat, QUANTIZED="error"),
        case("forces", decimals(4), QUANTIZED="error", night=True),
        case("forces", SevenDecimals, QUANTIZED="warning"),
        case("forces", planted.HalfEnergy, QUANTIZED="warning"),
        # another order of sums is no memory
        case("state", planted.Restless, NOT_BIT_IDENTICAL="warning"),
        case("state", planted.Keeps, KEPT_ANSWER="error"),
        case("state", planted.KeepsClose, KEPT_ANSWER="error"),
        case("state", planted.KeepsCell, KEPT_ANSWER="error"),
        case("state", planted.KeepsByRounding, KEPT_ANSWER="error"),
        case("state", planted.KeepsByAse, KEPT_ANSWER="error"),
    ],
)
def test_what_is_said_and_nothing_else(name: str, make, atoms: Atoms, expected: dict[str, str]):
    assert found_by(CHECKS[name](), make, atoms) == expected


@pytest.mark.parametrize(
    ("name", "make", "atoms", "expected"),
    [
        case("invariance", planted.OneImage, IMAGES="error"),
        case("invariance", planted.FaceDropped, FACES="error"),
        case("invariance", planted.FirstSix, ORDER="error"),
        case("invariance", planted.NearestImage, EXTENSIVE="error"),
        case("invariance", planted.ByLengths, LATTICE="error"),
        case("invariance", planted.Tilted, ROTATION="error"),
        case("invariance", planted.Handed, chain(), MIRROR="error"),
        case("invariance", planted.WrapsAlways, chain(), DUMMY_CELL="error"),
        # a topology by order that takes any order is warned of, and one by appearance is none: in an
        # alternating crystal, a salt, and where one atom in many is of another species
        case("invariance", Bonds, WATER.repeat(2), TOPOLOGY_BY_ORDER="warning", ORDER=None),
        *(
            case(
                "invariance", planted.ByAppearance, atoms, ORDER="error", TOPOLOGY_BY_ORDER=None, night=night
            )
            for atoms, night in (
                (mixed(crystal(), 1, 3, 5, 7), False),
                (bulk("NaCl", "rocksalt", a=4.4, cubic=True), True),
                (mixed(bulk("Ar", "fcc", a=3.9, cubic=True).repeat((2, 2, 1)), 7), False),
            )
        ),
        case("forces", planted.NoSwitchInForce, FORCES_NOT_GRADIENT="error"),
        case("forces", planted.OneSided, NET_FORCE="error"),
        case("forces", planted.Whirl, chain(), FORCES_NOT_GRADIENT="error", NET_TORQUE="error"),
        # two energies are both read, and are one where they differ by a constant
        case("forces", planted.TwoEnergies, TWO_ENERGIES=None, FORCES_NOT_GRADIENT=None),
        case("forces", planted.Entropy, TWO_ENERGIES="warning", FORCES_NOT_GRADIENT=None),
        case("forces", planted.OrderedEnergy, TWO_ENERGIES="error", FORCES_NOT_GRADIENT=None),
        case("forces", planted.SwappedEnergies, TWO_ENERGIES="warning", FORCES_NOT_GRADIENT="error"),
        # 6 % of the forces, over many answers, and all of them
        case("forces", planted.drops(0.3), NOISE_FLOOR="warning"),
        case("forces", planted.hits(0.3), NOISE_FLOOR="error"),
        case("curl", planted.Whirl, chain(), CURL="error"),
        case("state", planted.OldPairs, STALE_STATE="error"),
        case("state", planted.FullSkin, STALE_STATE="error"),
        case("state", planted.OldTail, STALE_STATE="error"),
        # whatever the skin is, one of the approaches is between it and twice as much
        *(
            case(
                "state", but(planted.FullSkin, skin=skin), chain(), STALE_STATE="error", night=0.1 < skin < 2
            )
            for skin in (0.1, 0.3, 0.47, 1.3, 2.0)
        ),
        case("state", Once, STALE_STATE="error"),
        case("state", Breaks, BROKEN_BY_FAILURE="info", STALE_STATE=None),
        # what nobody answers is no memory
        *(
            case("state", make, STALE_STATE=None, BROKEN_BY_FAILURE=None)
            for make in (planted.OnlyRectangles, Periodic)
        ),
        case("alone", planted.MeanNeighbor, LONELY_NOT_FINITE="error"),
        case("alone", planted.EmptyList, LONELY_FAILS="warning"),
        case("alone", planted.Background, LONELY_ENERGY="warning"),
        case("alone", planted.Whirl, LONELY_FORCE="error"),
        case("caller", planted.WrapsGiven, CHANGED_INPUT="error"),
        # one flag for all axes, whichever axis it is taken from
        *(
            case("periodicity", make, atoms, MIXED_PERIODICITY="error")
            for make in (planted.AnyForAll, planted.AllOrNone, planted.flagged(lambda pbc: pbc[0]))
            for atoms in (crystal(), slab())
        ),
        case("periodicity", planted.AnyForAll, chain(), MIXED_PERIODICITY="error"),
        case("periodicity", planted.flagged(lambda pbc: pbc[2]), MIXED_PERIODICITY="error"),
        *(
            case("periodicity", make, atoms, MIXED_PERIODICITY="error")
            for make in (planted.CompletesCell, planted.WrapsFreeAxes)
            for atoms in (crystal(), chain(), slab())
        ),
        case("state", KeepsCell, STALE_STATE="error"),
        case("alone", planted.ByPresence, mixed(crystal(), 1, 3, 5, 7), LONELY_ENERGY="warning"),
        *(
            case("caller", make, atoms, **{code: severity})
            for atoms in (crystal(), chain())
            for make, code, severity in (
                (planted.ByIdentity, "CHANGE_NOT_SEEN", "error"),
                (planted.ReadsTags, "CHANGE_NOT_SEEN", "error"),
                (planted.ReadsCharge, "CHANGE_NOT_SEEN", "error"),
                (planted.ReadsSpin, "CHANGE_NOT_SEEN", "error"),
                (planted.OneBuffer, "REUSED_BUFFER", "error"),
                (planted.GivesResults, "REUSED_BUFFER", "error"),
                (planted.SeedsNumpy, "RANDOM_SEEDED", "error"),
                (planted.SeedsPython, "RANDOM_SEEDED", "error"),
                (planted.SeedsAtFirst, "RANDOM_SEEDED", "warning"),
                (planted.DrawsNumpy, "RANDOM_SEEDED", "info"),
            )
        ),
        # what comes by chance is no change that was not seen
        case("caller", planted.drops(0.3, 7), CHANGE_NOT_SEEN=None),
        *(
            case("forces", planted.pairs_in(dtype), LOW_PRECISION=severity, FORCES_NOT_GRADIENT=None)
            for dtype, severity in ((np.float32, "warning"), (np.float16, "error"))
        ),
        # one call in fifty is chance and no memory
        *(
            case(
                "state",
                planted.drops(share, seed),
                NOT_REPEATABLE="error",
                STALE_STATE=None,
                night=seed in (1, 2),
            )
            for share, seed in ((0.3, 7), (0.02, 0), (0.02, 1), (0.02, 2))
        ),
    ],
)
def test_a_planted_mistake_is_found(name: str, make, atoms: Atoms, expected: dict[str, str | None]):
    check = CHECKS[name]()
    found = found_by(check, make, atoms, None if make is Breaks else 4)
    assert {code: found.get(code) for code in expected} == expected
    shown = [code for code in expected if found.get(code) == "error"] if name == "invariance" else []
    slugs = [code.lower().replace("_", "-") for code in shown] + ["stale"] * ("STALE_STATE" in found)
    assert {f"{slug}-{when}" for slug in slugs for when in ("before", "after")} <= set(check.structures)
    if make is planted.NearestImage:  # only what is wrong is named
        assert not {"TRANSLATION", "IMAGES", "FACES", "ORDER", "CELL_ULP"} & set(found)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (planted.CutEnergy, {"TWO_ENERGIES": "error"}),
        # the difference changes, and not at once
        (planted.Entropy, {}),
        (planted.TwoEnergies, {}),
    ],
)
def test_an_energy_that_alone_is_cut_is_seen_where_thresholds_are_known(make, expected):
    """Forces are asked before, and know of no threshold."""
    check = SmoothnessCheck()
    check.neighbors, check.routes = 8, 0
    result = check(subject(make))
    assert codes(result) == expected
    if expected:
        told = values(result, "TWO_ENERGIES")
        assert told["variants"] == ["wrong"]
        assert all(part in told["places"] for part in ("Ar-Ar", f"3.4 {LENGTH}", f"0.01 {ENERGY}"))


@pytest.mark.parametrize(("name", "what"), [("invariance", "lattice"), ("state", "sheared")])
def test_what_is_not_supported_is_left_out(name: str, what: str):
    result = asked(name, planted.OnlyRectangles)
    assert any(what in skipped for skipped, _ in result.skipped)
    assert name == "state" or result.says[0] == ["invariance_right", "invariance_refused"]


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("invariance", planted.Attached),
        ("state", planted.Attached),
        ("forces", planted.ThroughAtoms),
        ("state", planted.ThroughAtoms),
    ],
)
def test_who_answers_through_atoms_alone_is_asked_through_atoms(make, name: str):
    result = asked(name, make)
    assert not result.findings and not result.skipped


# -- how a structure is written down --------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "expected"),
    [(planted.NearestImage, {"NARROW_CELL": "warning"}), (Good, {}), (Wide, {"NARROW_CELL_REFUSED": "info"})],
)
def test_a_structure_with_room_does_not_hide_the_nearest_image(make, expected, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(invariance, "all_of", lambda atoms, *_: invariance.narrow(atoms, rng))
    wide = bulk("Ar", "fcc", a=3.9, cubic=True).repeat(2)
    for atoms in (wide, mixed(wide.copy(), *range(0, 32, 2))):
        assert codes(asked("invariance", make, atoms)) == expected


def test_a_shell_on_the_cutoff_is_shown_by_an_ulp_of_the_cell():
    """As given, a whole shell is at the cutoff to the last bit; moved a little it is not."""
    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((2, 2, 2))
    found = [set(codes(asked("invariance", make, atoms))) for make in (planted.HardEdge, Good)]
    assert found == [{"CELL_ULP"}, set()]


@pytest.mark.parametrize(
    ("far", "code"), [(np.nan, "NOT_FINITE"), (IndexError("cell 17 of 16"), "FAILS")], ids=["nan", "raises"]
)
def test_failing_on_another_image_is_a_finding(far, code: str, tmp_path):
    def extra(atoms, energy, forces):
        if not np.any(np.abs(atoms.positions) > 60):
            return energy, forces
        if isinstance(far, Exception):
            raise far
        return far, forces

    found = subject(planted.adding(extra))
    found.folder = tmp_path
    assert codes(CHECKS["invariance"]()(found))[code] == "error"
    assert list(tmp_path.glob("failed-*.extxyz"))


def test_every_way_is_the_same_structure():
    """The transformations are right by themselves: all distances stay, found by ASE's own search."""
    rng = np.random.default_rng(5)
    atoms = crystal()
    atoms.positions += rng.uniform(-0.05, 0.05, (len(atoms), 3))
    ways = list(invariance.all_of(atoms, atoms, rng))
    # of each kind at least one
    kinds = "TRANSLATION IMAGES FACES ORDER CELL_ULP EXTENSIVE LATTICE LEFT_HANDED ROTATION MIRROR DUMMY_CELL"
    assert {same.code for same in ways} == {*kinds.split(), "NARROW_CELL"} and len(ways) > 40
    for same in ways:
        base = atoms if same.before is None else same.before
        before, after = (np.sort(neighbor_list("d", one, 4.3)) for one in (base, same.atoms))
        expected = np.sort(np.tile(before, same.copies))
        np.testing.assert_allclose(after, expected, rtol=0, atol=1e-12, err_msg=same.what)
        np.testing.assert_array_equal(same.atoms.numbers, base.numbers[same.order])


# -- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "atoms"),
    [
        pytest.param(EMT, bulk("Cu", cubic=True), marks=pytest.mark.nightly),
        pytest.param(LJ, bulk("Ar", "fcc", a=5.26, cubic=True), marks=pytest.mark.slow),
    ],
)
def test_ases_own_remember_nothing(make, atoms: Atoms):
    assert not asked("state", make, atoms).findings


@pytest.mark.parametrize("make", [TIP3P, TIP4P])
def test_who_knows_whole_molecules_alone_is_asked_about_molecules_alone(make):
    found = AloneCheck()
    found.look(subject(make), water(4), NoiseFloor(1e-13, 1e-13))
    assert not list(found.findings()) and not found.takes_atoms
    assert [row["atoms"] for row in found.rows] == ["one H2O", f"two H2O 60 {LENGTH} apart"]


def test_failing_on_an_atom_without_neighbors_is_found_where_the_cluster_has_one_too():
    """A bond order divides by the number of neighbors; the structure with a vacancy is answered."""
    # the first twelve of them have holes between them
    atoms = crystal().repeat(2)[np.random.default_rng(1).permutation(64)]
    assert isinstance(atoms, Atoms)
    found = AloneCheck()
    found.look(subject(planted.EmptyList), atoms, NoiseFloor(1e-13, 1e-13))
    assert "cluster" in found.refused[-1][0] and codes(found.findings()) == {"LONELY_FAILS": "warning"}


def test_after_a_failure_a_new_object_is_asked():
    found = subject(Breaks)
    with pytest.raises(CalculatorError, match="Lost atoms"):
        found.energy(chain())
    assert np.isfinite(found.energy(crystal()))


def test_sequences_do_what_they_say():
    found = all_sequences(crystal(), np.random.default_rng(0))
    sizes = [len(step.atoms) for step in found["sizes"]]
    assert max(sizes) > len(crystal()) > min(sizes) and 2 in sizes
    moved = [step.atoms.positions for step in found["a slow drift"]]
    np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0), axis=2), 0.04, rtol=1e-9)
    assert np.ptp(found["wrapping"][1].atoms.get_scaled_positions(wrap=False)) > 1


@pytest.mark.parametrize(("power", "severity"), [(-8, "warning"), (-4, "error")])
def test_the_tolerance_is_measured(power: int, severity: str):
    result = asked("state", but(planted.Keeps, tolerance=3 * 10.0**power))
    assert result.numbers["kept_within"] == pytest.approx(10.0**power)
    assert codes(result)["KEPT_ANSWER"] == severity


def test_positions_in_single_precision_are_no_kept_answer():
    """Far from the origin a coordinate of single precision has steps of 4e-6 Å."""

    def positions(self, atoms):
        return Good.positions(self, atoms).astype(np.float32).astype(float)

    atoms = Atoms("Ar8", crystal().positions + 50.0)
    assert "KEPT_ANSWER" not in codes(asked("state", but(Single, positions=positions), atoms))


@pytest.mark.parametrize("make", [planted.ReadsTags, planted.ReadsCharge, planted.ReadsSpin])
@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
def test_questions_that_differ_in_charges_tags_or_moments_are_not_one(make, atoms: Atoms):
    """New objects that answer them otherwise are repeatable: what is wrong is that a change is not seen."""
    asked_about = subject(make, atoms)
    assert codes(CHECKS["caller"]()(asked_about)) == {"CHANGE_NOT_SEEN": "error"}
    assert asked_about.repeats.new.times and not asked_about.repeats.findings(asked_about.kT)


def test_no_element_has_a_wrong_article():
    rows = planted.asked("alone", Good, crystal()).tables["Atoms alone"]
    assert any("one Ar atom" in row["atoms"] for row in rows)
    assert not any("a Ar" in row["atoms"] for row in rows)
