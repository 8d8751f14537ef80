"""Energy functions in the conventions that people have, against numpy, and with one defect each."""

from __future__ import annotations

import json
from collections import namedtuple
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import bulk
from ase.geometry import get_distances

import mdnum
from mdnum.forks import choices, fork
from mdnum.gradients.losses import FinalProjection
from mdnum.md import jaxmd
from mdnum.md.jaxmd import displacement as own_displacement
from mdnum.numerics.jaxprs import first_not_finite, single_numbers
from mdnum.systems.admission import AdmissionError
from mdnum.systems.evaluate import Evaluator

RADIUS, DEPTH = 4.4, 0.3
SHEAR = np.array([[1, 0, 0], [0.11, 1, 0], [-0.07, 0.09, 1]])


def argon(tilted: bool = True) -> Atoms:
    atoms = bulk("Ar", "fcc", a=5.26, cubic=True) * 2
    atoms.rattle(0.15, seed=5)
    if tilted:
        atoms.set_cell(atoms.cell.array @ SHEAR, scale_atoms=True)
    return atoms


def by_hand(atoms: Atoms, depth=DEPTH, power: int = 2) -> tuple[float, np.ndarray, np.ndarray]:
    """Energy, forces and stress of depth (1 - r²/R²)^power, of all pairs."""
    d, r = get_distances(atoms.positions, cell=atoms.cell, pbc=atoms.pbc)
    depth = np.broadcast_to(depth, r.shape)
    near = (r < RADIUS) & (r > 0)
    t = np.where(near, 1 - (r / RADIUS) ** 2, 0.0)
    # of half the pairs' sum, by the square of the distance
    slope = np.where(near, -0.5 * depth * power * t ** (power - 1) / RADIUS**2, 0.0)
    forces = 4 * np.sum(slope[:, :, None] * d, axis=1)
    stress = 2 * np.einsum("ij,ija,ijb->ab", slope, d, d) / atoms.get_volume()
    return 0.5 * np.sum(np.where(near, depth * t**power, 0)), forces, stress


def energies(d, real, depth: Any = DEPTH, power: int = 2):
    """The same of listed vectors; one for each entry."""
    t = 1 - jnp.sum(jnp.where(real[..., None], d, 1.0) ** 2, axis=-1) / RADIUS**2
    return 0.5 * depth * jnp.where(real & (t > 0), t, 0.0) ** power


def entries(neighbor, n: int):
    """Both ends of every entry, and whether it is one."""
    i, j = (jnp.arange(n)[:, None], neighbor.idx) if neighbor.format.name == "Dense" else neighbor.idx
    i, j = jnp.broadcast_arrays(i, j)
    real = (i < n) & (j < n)
    return jnp.where(real, i, 0), jnp.where(real, j, 0), real


def over(space, R, neighbor, depth: Any = DEPTH, each=energies, **kw):
    """Energies of entries, by a displacement function of jax-md."""
    i, j, real = entries(neighbor, len(R))
    flat = jax.vmap(partial(space, **kw))(R[i.ravel()], R[j.ravel()])
    return each(flat.reshape(*i.shape, 3), real, depth)


def general(atoms: Atoms, fractional: bool):
    md = jaxmd.upstream()
    box = jnp.asarray(atoms.cell.array.T)
    return md.space.periodic_general(box, fractional_coordinates=fractional)[0]


def classical(atoms: Atoms, fractional: bool = False):
    space = general(atoms, fractional)
    return lambda R, neighbor, **kw: jnp.sum(over(space, R, neighbor, **kw))


def parameters_first(atoms: Atoms):
    space = general(atoms, False)

    def energy(params, R, neighbor, **kw):
        return jnp.sum(over(space, R, neighbor, params["depths"][0], **kw))

    lists = SimpleNamespace(
        allocate=lambda R: jaxmd.as_neighbor_list(np.full((len(R), 1), len(R)), R, "sparse")
    )
    return lists, lambda key, R, neighbor: {"depths": [jnp.asarray(DEPTH)]}, energy


def keyword_only(atoms: Atoms, rows: bool = False):
    base = atoms.cell.array

    def energy(R, *, box=None, neighbor=None):
        cell = jnp.asarray(base) if box is None else box if rows else box.T
        return jnp.sum(over(own_displacement(cell), R, neighbor))

    return energy


def dictionary(atoms: Atoms):
    space = general(atoms, False)

    def energy(R, nlist, **kw):
        return {"terms": {"bond": jnp.zeros(())}, "total": jnp.sum(over(space, R, nlist, **kw))}

    return energy, SimpleNamespace(allocate=lambda R: jaxmd.as_neighbor_list(np.zeros((len(R), 1)), R)), space


def multi_image(atoms: Atoms):
    from jax_md import custom_partition

    lists = custom_partition.neighbor_list_multi_image(None, jnp.asarray(atoms.cell.array.T), RADIUS, 0.0)

    def energy(R, neighbor, box=None, perturbation=None, **_):
        held = neighbor if box is None else neighbor.__class__(**{**vars(neighbor), "box": box})
        d = custom_partition._compute_displacements(R, held)
        d = d if perturbation is None else d @ perturbation.T
        return jnp.sum(energies(d, custom_partition.neighbor_list_multi_image_mask(held)))

    return lists, energy


def per_atom(atoms: Atoms):
    space = general(atoms, True)
    return lambda R, neighbor, **kw: jnp.sum(over(space, R, neighbor, **kw), axis=1)


def simulation(made, atoms: Atoms, **more: Any):
    function = mdnum.energy_function(made, RADIUS, **more)
    return mdnum.simulation(atoms, function, timestep=0.002, skin=0.2)


def compared(one, atoms: Atoms, depth: Any = DEPTH, power: int = 2) -> None:
    energy, forces, stress = by_hand(atoms, depth, power)
    found = one.evaluate()
    assert found.energy == pytest.approx(energy, rel=1e-13)
    np.testing.assert_allclose(found.forces, forces, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.stress, stress, rtol=0, atol=1e-15)


CONVENTIONS = {
    "classical": (classical, "classical", "columns", False),
    "fractional": (partial(classical, fractional=True), "classical", "columns", True),
    "first": (parameters_first, "parameters first", "columns", False),
    "keyword": (keyword_only, "keyword only", "columns", False),
    "rows": (partial(keyword_only, rows=True), "keyword only", "rows", False),
    "dictionary": (dictionary, "classical, dictionary with total", "columns", False),
    "images": (multi_image, "multi-image list", "columns", True),
    "atoms": (per_atom, "classical", "columns", True),
}


def some(names, fast: tuple[Any, ...]):
    """The fast ones in every run, all of them at night."""
    return [name if name in fast else pytest.param(name, marks=pytest.mark.nightly) for name in names]


@pytest.mark.jax_md
@pytest.mark.parametrize("name", some(CONVENTIONS, ("fractional", "first", "rows")))
def test_each_convention_is_recognized_and_has_the_numbers_of_numpy(name: str):
    make, label, box, fractional = CONVENTIONS[name]
    atoms = argon()
    one = simulation(make(atoms), atoms)
    how = one.model.call.how
    assert (how.label, how.box, how.fractional) == (label, box, fractional)
    compared(one, atoms)


def test_a_function_that_takes_a_graph_is_refused_by_name():
    def network(graph):
        return graph.energy

    with pytest.raises(mdnum.InputError, match="network takes a graph"):
        mdnum.energy_function(network, RADIUS)
    Graph = namedtuple("Graph", "nodes")

    def annotated(g: Graph):
        return g.nodes

    with pytest.raises(mdnum.InputError, match="annotated takes a graph"):
        mdnum.energy_function(annotated, RADIUS)


def native(parameters, R, neighbor, cell, *, each=energies):
    return jnp.sum(over(own_displacement(cell), R, neighbor, parameters, each))


def first_counts_more(d, real, depth):
    return energies(d, real, depth) * jnp.where(jnp.arange(real.shape[1]) == 0, 1.1, 1.0)


def per_slot(d, real, depth):
    return energies(d, real, depth) / real.shape[1]


def masked_late(d, real, depth):
    t = 1 - jnp.linalg.norm(d, axis=-1) / RADIUS
    return 0.5 * depth * jnp.where(real & (t > 0), t, 0.0) ** 2


def of_a_negative_number(d, real, depth):
    return energies(d, real, depth) + jnp.log(depth - 5)


def per_edge(d, real, depth):
    return energies(d, real, depth) / jnp.sum(real)


def in_single(d, real, depth):
    return energies(d.astype(jnp.float32), real, depth)


def on_trust(d, real, depth):
    """Jumps at the cutoff, wherever an entry is."""
    t = 1.2 - jnp.sum(jnp.where(real[..., None], d, 1.0) ** 2, axis=-1) / RADIUS**2
    return 0.5 * depth * jnp.where(real, t, 0.0)


def by_itself(d, real, depth):
    r2 = jnp.sum(jnp.where(real[..., None], d, 1.0) ** 2, axis=-1)
    return jnp.where(r2 < RADIUS**2, on_trust(d, real, depth), 0.0)


def with_constant(d, real, depth):
    # as jax_md.util.maybe_downcast makes them
    return energies(d, real, depth) * jnp.asarray(0.3, jnp.float32) * jnp.asarray(0.5, jnp.float32)


def of_the_whole(d, real, depth):
    made = energies(d, real, depth)
    return made * (1 + 0.1 * jnp.sum(made))


def shorter(d, real, depth):
    return energies(d / 0.85, real, depth)


def longer(d, real, depth):
    return energies(d / 1.1, real, depth)


WEIGHTS = jnp.linspace(0.5, 1.5, 12)


def with_weights(atoms: Atoms):
    space = general(atoms, False)

    def energy(R, neighbor, **kw):
        return jnp.sum(over(space, R, neighbor, **kw)) * jnp.sum(jnp.tanh(WEIGHTS))

    return energy


def held_still(d, real, depth):
    return energies(jax.lax.stop_gradient(d), real, depth) + energies(d, real, depth)


def own(each, depth: Any = DEPTH):
    function = mdnum.md.energies.EnergyFunction(
        jnp.asarray(depth), partial(native, each=each), RADIUS, format="dense", name=each.__name__
    )
    return lambda atoms: mdnum.simulation(atoms, function, timestep=0.002, skin=0.2)


def brought(make, **more: Any):
    return lambda atoms: simulation(make(atoms), atoms, **more)


def another_box(atoms: Atoms):
    larger = atoms.copy()
    larger.set_cell(atoms.cell.array * 1.1)
    held = classical(larger)
    return lambda R, neighbor, perturbation=None: held(R, neighbor, perturbation=perturbation)


def a_matrix(atoms: Atoms, more: float = 0.3):
    space = jaxmd.upstream().space.periodic(jnp.asarray(atoms.cell.array) + more)[0]
    # with a matrix a vector becomes three
    each = jax.vmap(lambda a, b: jnp.sum(space(a, b) ** 2))

    def energy(R, neighbor, **kw):
        i, j, real = entries(neighbor, len(R))
        t = 1 - jnp.where(real, each(R[i.ravel()], R[j.ravel()]).reshape(i.shape), 9.0) / (3 * RADIUS**2)
        return jnp.sum(jnp.where(real & (t > 0), t, 0.0) ** 2)

    return energy


def deaf(atoms: Atoms):
    space = general(atoms, False)
    return lambda R, neighbor: jnp.sum(over(space, R, neighbor))


def ignores_the_cell(atoms: Atoms):
    space = general(atoms, False)
    function = lambda parameters, R, neighbor, cell: jnp.sum(over(space, R, neighbor))  # noqa: E731
    made = mdnum.md.energies.EnergyFunction((), function, RADIUS, format="dense")
    return mdnum.simulation(atoms, made, timestep=0.002, skin=0.2)


def strained_twice(atoms: Atoms):
    space = general(atoms, False)

    def energy(R, neighbor, box=None, perturbation=None):
        return jnp.sum(over(space, R, neighbor, box=box, perturbation=perturbation @ perturbation))

    return energy


def vectors(atoms: Atoms):
    space = general(atoms, False)
    return lambda R, neighbor, **kw: jnp.ones(3) * jnp.sum(over(space, R, neighbor, **kw))


def with_another(atoms: Atoms):
    return lambda R, neighbor, **kw: (jnp.sum(R), {"charges": R[:, 0]})


def raises(R, neighbor, **kw):
    raise KeyError("weights")


DEFECTS = {
    "DEPENDS_ON_ORDER": own(first_counts_more),
    "DEPENDS_ON_CAPACITY": own(per_slot),
    "NAN_BY_PADDING": own(masked_late),
    "NOT_FINITE": own(of_a_negative_number),
    "FORCES_WRONG": own(held_still),
    "ANOTHER_BOX": brought(another_box, format="dense"),
    "ANOTHER_BOX, a matrix": brought(a_matrix, format="dense"),
    "MATRIX_BOX": brought(partial(a_matrix, more=0.0), format="dense"),
    "CELL_IGNORED": ignores_the_cell,
    "NO_STRAIN": brought(deaf, format="dense"),
    "STRESS_WRONG": brought(strained_twice, format="dense"),
    "NO_ENERGY": brought(vectors, format="dense"),
    "NO_ENERGY, with another": brought(with_another, format="dense"),
    "NOT_CALLABLE": brought(lambda atoms: raises),
    "UNKNOWN_SPECIES": brought(classical, species=("Si", "O")),
}


@pytest.mark.jax_md
@pytest.mark.parametrize(
    "name",
    some(
        DEFECTS,
        (
            "DEPENDS_ON_ORDER",
            "DEPENDS_ON_CAPACITY",
            "NAN_BY_PADDING",
            "ANOTHER_BOX",
            "CELL_IGNORED",
            "NO_ENERGY",
        ),
    ),
)
def test_a_defect_closes_the_door(name: str):
    with pytest.raises(AdmissionError) as caught:
        DEFECTS[name](argon())
    assert caught.value.code == name.partition(",")[0] and caught.value.remedy
    operation = {"NAN_BY_PADDING": "div", "NOT_FINITE": "log", "MATRIX_BOX": "rem"}.get(name)
    if operation is not None:
        assert caught.value.values["operation"].startswith(operation)
        # what jax compiles as one has no line of its own
        assert ("test_admission.py" in caught.value.values["operation"]) == (operation == "log")


def overflowing(atoms: Atoms):
    energy = classical(atoms)
    return lambda R, neighbor, **kw: jnp.where(
        neighbor.did_buffer_overflow, jnp.nan, energy(R, neighbor, **kw)
    )


NOTES = {
    "NO_EDGES_NAN": (own(per_edge), {}),
    "SINGLE_INSIDE": (own(in_single), {}),
    "PARAMETERS_FLOAT32": (own(with_constant), {"numbers": ["0.3"], "count": 1}),
    "NAN_ON_OVERFLOW": (brought(overflowing, format="dense"), {}),
    "TRUSTS_LIST": (own(on_trust), {}),
    "DECIDES_ITSELF": (own(by_itself), {}),
    "NOT_ADDITIVE": (own(of_the_whole), {}),
    "R_CUT_LONGER": (own(shorter), {"r_cut": RADIUS}),
    "PARAMETERS_HELD": (brought(with_weights, format="dense"), {"count": 12}),
}


@pytest.mark.jax_md
@pytest.mark.parametrize(
    "code", some(NOTES, ("PARAMETERS_FLOAT32", "TRUSTS_LIST", "NO_EDGES_NAN", "NOT_ADDITIVE", "R_CUT_LONGER"))
)
def test_what_should_be_known_is_noted_and_is_a_finding_of_the_run(code: str):
    from mdnum.verbs.run_page import TEXTS

    make, values = NOTES[code]
    one = make(argon())
    notes = {key: json.loads(text) for key, text in one.model.notes}
    assert code in notes and values.items() <= notes[code].items()
    clean = ("ENERGY_JUMPS",) if code in ("TRUSTS_LIST", "DECIDES_ITSELF") else ()
    # a pair more is a divisor more
    more = ("ENERGY_JUMPS", "TRUSTS_LIST") if code == "NO_EDGES_NAN" else ()
    assert set(notes) == {code, *clean, *more}
    assert TEXTS.finding(code, **notes[code], energy_unit="eV", length_unit="Å").code == code
    assert one.imposable == ("TRUSTS_LIST" in notes)
    if clean:
        # of two ends
        assert one.model.smoothness.energy_jump == pytest.approx(0.2 * DEPTH, rel=1e-5)
        assert one.program["potential"]["notes"] == notes


@pytest.mark.jax_md
@pytest.mark.parametrize(
    ("each", "code", "factor"),
    [(longer, "TRUSTS_LIST", 1.1), pytest.param(shorter, "R_CUT_LONGER", 0.85, marks=pytest.mark.nightly)],
)
def test_the_range_of_a_function_is_measured(each, code: str, factor: float):
    notes = dict(own(each)(argon()).model.notes)
    assert json.loads(notes[code])["reach"] == pytest.approx(factor * RADIUS, rel=5e-3)


def test_weights_of_a_network_in_single_precision_are_not_numbers_that_were_rounded():
    weights = np.random.default_rng(0).normal(size=50).astype(np.float32)
    # some are short by chance
    assert any(len(str(weight)) < 9 for weight in weights)
    held = jnp.asarray(weights, float)
    sigma = jnp.asarray([0.3, 3.405], jnp.float32).astype(float)
    program = jax.make_jaxpr(lambda x: jnp.sum(held * x) * sigma)(1.0)
    assert single_numbers(program) == ["0.3", "3.405"]


@pytest.mark.jax_md
def test_numbers_that_belong_to_atoms_stay_with_them_when_atoms_are_sorted():
    atoms = argon()
    charges = np.random.default_rng(3).uniform(0.5, 1.5, len(atoms))
    held, space = jnp.asarray(charges), general(atoms, False)

    def energy(R, neighbor, **kw):
        i, j, _ = entries(neighbor, len(R))
        return jnp.sum(over(space, R, neighbor, held[i] * held[j], **kw))

    one = simulation(energy, atoms, format="dense")
    assert one.model.labeled
    compared(one, atoms, np.outer(charges, charges))


LARGE = argon(tilted=False) * 3


def plain(R, neighbor, cell):
    return jnp.sum(over(own_displacement(cell), R, neighbor, each=on_trust))


def far_away(R, neighbor, cell):
    """Not finite for one atom in the middle of the box, far from the first one."""
    far = jnp.asarray(LARGE.positions[np.argmin(np.linalg.norm(LARGE.positions - 15.8, axis=1))])
    return plain(R, neighbor, cell) + jnp.sum(jnp.where(jnp.sum((R - far) ** 2, axis=1) < 0.1, jnp.inf, 0.0))


def for_each_atom(R, neighbor, cell):
    return plain(R, neighbor, cell) + jnp.sum(0 * R * jnp.ones((len(LARGE), 1)))


@pytest.mark.jax_md
@pytest.mark.parametrize("function", some((plain, far_away, for_each_atom), (plain, for_each_atom)))
def test_a_part_of_a_large_structure_is_enough_where_it_is_like_the_whole(function):
    sizes = []

    def energy(parameters, R, neighbor, cell):
        sizes.append(len(R))
        return function(R, neighbor, cell)

    def made():
        return simulation(energy, LARGE, format="dense")

    if function is far_away:
        with pytest.raises(AdmissionError) as caught:
            made()
        assert caught.value.code == "NOT_FINITE"
        return
    one = made()
    assert one.model.call.how.box == "cell" and one.imposable
    note = json.loads(dict(one.model.notes)["TRUSTS_LIST"])
    assert note["inside"] == pytest.approx(one.evaluate().energy, rel=1e-5)
    assert set(sizes) == {500, len(LARGE)}


@pytest.mark.jax_md
def test_the_cutoff_of_a_perfect_crystal_is_examined():
    """Many pairs are equally close to the cutoff, and a neighbor list has each of them twice."""
    function = mdnum.energy_function(classical(atoms := bulk("Ar", "fcc", a=3.352, cubic=True) * 3), RADIUS)
    made = mdnum.simulation(atoms, function, timestep=0.002, skin=0.52)
    assert made.model.smoothness == mdnum.md.manybody.Smoothness(1, 0.0, 0.0)


@pytest.mark.nightly
@pytest.mark.jax_md
def test_units_are_those_that_the_function_is_written_in():
    atoms = argon()
    small = atoms.copy()
    small.set_cell(atoms.cell.array / 10, scale_atoms=True)
    space = general(small, False)

    def energy(R, neighbor, **kw):
        # nanometers and kJ/mol
        each = lambda d, real, depth: energies(10 * d, real, depth)  # noqa: E731
        return jnp.sum(over(space, R, neighbor, DEPTH / (units.kJ / units.mol), each, **kw))

    function = mdnum.energy_function(energy, RADIUS / 10, units=("nm", "kJ/mol"), format="dense")
    one = mdnum.simulation(atoms, function, timestep=0.002, skin=0.2)
    assert one.r_cut == pytest.approx(RADIUS) and one.program["potential"]["units"] == "nm, kJ/mol"
    compared(one, atoms)
    with pytest.raises(mdnum.InputError, match="furlong"):
        mdnum.energy_function(energy, 1.0, units=("furlong", "eV"))


@pytest.mark.jax_md
@pytest.mark.parametrize("count", [1, 2])
def test_one_atom_and_no_edges_are_a_simulation(count: int):
    atoms = Atoms(f"Ar{count}", positions=[[0, 0, 0], [7, 0, 0]][:count], cell=np.eye(3) * 14, pbc=True)
    one = own(energies)(atoms)
    found = one.evaluate()
    assert found.energy == 0 and not found.forces.any()


@pytest.mark.jax_md
def test_a_box_that_needs_several_images_is_refused_with_the_repeats_that_do():
    atoms = Atoms("Ar", cell=np.diag([5.0, 7.0, 20.0]), pbc=True)
    with pytest.raises(mdnum.InputError) as caught:
        own(energies)(atoms)
    assert "2 x 2 x 1" in caught.value.remedy


def test_the_operation_that_makes_a_number_that_is_not_finite_is_named():
    inner = jax.jit(lambda x: jnp.sqrt(x) * 2)
    named = first_not_finite(jax.grad(lambda x: inner(x * x)), jnp.zeros(()))
    assert named is not None and named.name == "div" and "test_admission.py" in named.source


@pytest.mark.nightly
@pytest.mark.jax_md
def test_second_derivatives_that_are_not_finite_are_named_where_a_gradient_needs_them():
    @jax.custom_jvp
    def power(t):
        return t**1.5

    # at the distance 0 of padding a first derivative of 0, and a second one of infinity
    power.defjvp(lambda primals, tangents: (power(*primals), 1.5 * jnp.sqrt(primals[0]) * tangents[0]))

    def steep(d, real, depth):
        r2 = jnp.sum(d**2, axis=-1) / RADIUS**2
        return depth * jnp.where(real & (r2 < 1), (1 - r2) ** 2 * power(r2), 0.0)

    one = own(steep)(argon())
    assert not one.model.notes and np.isfinite(one.evaluate().forces).all()
    problem = mdnum.Problem(one, FinalProjection(), 2)
    with pytest.raises(mdnum.NumericalError) as caught:
        mdnum.value_and_grad(problem, ["initial.positions"], "symmetric")({})
    assert "second" in caught.value.message and "test_admission.py" in caught.value.message


@pytest.mark.jax_md
def test_a_decision_that_is_imposed_has_the_energy_without_the_pair():
    atoms = argon()
    one = own(on_trust)(atoms)
    evaluator = Evaluator(one)
    _, _, table, tables, x = evaluator._sorted(None, None)
    bits = one.force.decide(x, tables).bits
    i, j = table.decided(np.asarray(bits))
    atom, other = table.place[i[0]], table.place[j[0]]
    index = np.asarray(tables.index)
    pair = np.zeros(index.shape, bool)
    pair[:, :, atom], pair[:, :, other] = index[:, :, atom] == other, index[:, :, other] == atom
    mask = np.packbits(pair, axis=1, bitorder="little")[:, 0]
    assert mask.sum(dtype=int) > 0
    base, without = (
        one.force(x, tables, decisions=True, given=given, where=where)
        for given, where in ((None, None), (jnp.zeros_like(bits), jnp.asarray(mask)))
    )
    distance = atoms.get_distance(int(i[0]), int(j[0]), mic=True)
    lost = DEPTH * (1.2 - (distance / RADIUS) ** 2)
    assert float(base.energy.sum() - without.energy.sum()) == pytest.approx(lost, rel=1e-12)
    whole = one.force(x, tables, decisions=True, given=bits & ~jnp.asarray(mask))
    np.testing.assert_array_equal(whole.force, without.force)
    # what it would have decided itself is returned all the same
    np.testing.assert_array_equal(whole.decisions.bits, bits)


@pytest.mark.jax_md
def test_single_precision_has_its_own_numbers_and_bounds():
    atoms = argon()
    one = own(energies)(atoms)
    narrow = one.with_policy(mdnum.PrecisionPolicy(*["float32"] * 4))
    energy, forces, stress = by_hand(atoms)
    found = narrow.evaluate()
    assert 1e-9 < abs(found.energy - energy) / energy < 1e-5
    np.testing.assert_allclose(found.forces, forces, rtol=0, atol=3e-6 * np.abs(forces).max())
    np.testing.assert_allclose(found.stress, stress, rtol=0, atol=1e-5 * np.abs(stress).max())
    assert narrow.decider.bounds[0] > 1e7 * one.decider.bounds[0]
    with pytest.raises(mdnum.InputError, match="float32"):
        one.with_policy(mdnum.PrecisionPolicy(force="bfloat16"))


@pytest.mark.jax_md
@pytest.mark.parametrize(("compare", "pairs"), [("r <", 0), ("r2 <=", 1)])
def test_what_inside_means_is_an_option(compare: str, pairs: int):
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [RADIUS, 0, 0]], cell=np.eye(3) * 14, pbc=True)
    function = mdnum.energy_function(
        partial(native, each=energies), RADIUS, compare=compare, parameters=DEPTH
    )
    one = mdnum.simulation(atoms, function, timestep=0.002, skin=0.2)
    assert len(one.evaluate().i) == pairs


@pytest.mark.nightly
@pytest.mark.jax_md
@pytest.mark.parametrize("each", [on_trust, by_itself])
def test_a_fork_has_a_counterfactual_where_the_list_decides(each):
    function = own(each)(argon()).model
    one = mdnum.simulation(argon(), function, timestep=0.005, skin=0.2, temperature=300, seed=2)
    twin = choices.parse("precision").make(one)
    found = fork(twin, 60)
    assert found.series["B"][-1] > 0
    assert ("B|A" in found.series) == (each is on_trust)
