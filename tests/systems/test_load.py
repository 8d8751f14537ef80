"""Loading: names and paths, overrides, species tables, systems written and read again, and the schema."""

from __future__ import annotations

import importlib
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from ase.build import bulk
from ase.io import read
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from mdnum import systems
from mdnum.errors import InputError
from mdnum.systems import System, load, pairs, schema, shipped_folder, structures
from mdnum.systems.load import BALL_SCHEMA, json_schema
from mdnum.systems.structures import species_of

ARGON = "argon/liquid-864"
MIXTURE = "binary/kob-andersen-1000"


def same_bits(a: System, b: System) -> bool:
    return (
        a.spec.potential.kind == b.spec.potential.kind
        and a.atoms.get_chemical_symbols() == b.atoms.get_chemical_symbols()
        and np.array_equal(a.atoms.positions, b.atoms.positions)
        and np.array_equal(np.asarray(a.atoms.cell), np.asarray(b.atoms.cell))
        and np.array_equal(a.atoms.pbc, b.atoms.pbc)
        and np.array_equal(a.atoms.get_masses(), b.atoms.get_masses())
        and a.atoms.has("momenta") == b.atoms.has("momenta")
        and np.array_equal(a.atoms.get_momenta(), b.atoms.get_momenta())
    )


@pytest.mark.parametrize(("file", "root"), [("schema.json", "SystemSpec"), (BALL_SCHEMA, "BallSpec")])
def test_the_shipped_json_schema_is_current_and_describes_every_key(file, root):
    """Kinds, defaults and ranges of every key."""
    shipped = json.loads((shipped_folder() / file).read_text(encoding="utf-8"))
    made = json_schema(file)
    assert shipped == made, "run scripts/makers/make_systems.py --schema"
    tables = {"structure", "potential", "cutoff", "neighbors", "dynamics", "precision", "record", "rebuild"}
    tables |= {"start", "flight", "contact", "integrator", "loss", "gradient", "control"}
    silent = [
        f"{name}.{key}"
        for name, table in {**made["$defs"], root: made}.items()
        for key, value in table.get("properties", {}).items()
        if "description" not in value and key not in {"kind", "rule", "units", *tables}
    ]
    assert silent == []


@pytest.mark.parametrize("table", ["potential", "dynamics"])
def test_an_editor_takes_a_shipped_kind_for_one_table_alone(table):
    made = json_schema("schema.json")
    options = [made["$defs"][one["$ref"].rpartition("/")[2]] for one in made["properties"][table]["oneOf"]]
    *own, other = (option["properties"]["kind"] for option in options)
    assert other["not"]["enum"] == [kind["const"] for kind in own]


def test_a_skin_of_its_units_and_a_spec_that_is_frozen():
    argon, crystal = (load(name).spec.model_copy(update={"neighbors": schema.NeighborsTable()})
                      for name in (ARGON, "argon/crystal-108"))  # fmt: skip
    assert (argon.skin, crystal.skin) == (1.0, 0.3)
    with pytest.raises(ValidationError, match="frozen"):
        argon.units = "lj"  # type: ignore[misc]


def test_a_name_and_a_path_mean_the_same():
    by_name, by_path = load(ARGON), load(shipped_folder() / f"{ARGON}.toml")
    assert (by_name.name, by_path.name) == (ARGON, "liquid-864") and same_bits(by_name, by_path)


def test_species_and_tables_of_a_mixture():
    system = load(MIXTURE)
    assert system.species == ("Ni", "P")
    _, species = species_of(system.atoms)
    assert np.bincount(species).tolist() == [800, 200]
    assert np.array_equal(species == 1, system.atoms.symbols == "P")
    tables = pairs.pair_constants(system.spec, system.species)
    assert tables["sigma"].tolist() == [1.0, 0.8, 0.88]
    assert tables["epsilon"].tolist() == [1.0, 1.5, 0.5]
    radius, onset = pairs.cutoff_radii(system.spec, system.species)
    assert np.allclose(radius, 2.5 * tables["sigma"], rtol=1e-15)
    assert onset is None and system.r_cut == 2.5


def test_onsets_are_kept_to_the_bit_and_those_of_single_pairs_scaled():
    def tables(name: str, **cutoff: str):
        system = load(name, {f"cutoff.{key}": value for key, value in cutoff.items()})
        radius, onset = pairs.cutoff_radii(system.spec, system.species)
        assert onset is not None
        return system, radius, onset

    _, radius, onset = tables(MIXTURE, kind="switched", onset="2.0", **{"pairs.P-Ni": "1.9"})
    assert np.allclose(radius, [2.5, 1.9, 2.2], rtol=1e-15)
    assert np.allclose(onset, 0.8 * radius, rtol=1e-15)
    _, radius, onset = tables(ARGON, kind="quintic", onset="7.1")
    assert (onset.tolist(), radius.tolist()) == ([7.1], [8.5125])
    system, _, onset = tables(ARGON, kind="switched")
    assert onset.tolist() == [0.9 * 8.5125] and "onset = " in system.to_toml()


def test_a_pair_without_a_radius_is_named():
    with pytest.raises(InputError, match="no radius for Ni-Ni"):
        load(MIXTURE, {"cutoff": {"kind": "hard", "pairs": {"Ni-P": 2.0}}})


def test_overrides_are_read_as_toml():
    system = load(ARGON, {"neighbors.skin": "0.5", "dynamics.steps": "1_000", "cutoff.compare": "r <="})
    assert (system.spec.skin, system.spec.dynamics.steps) == (0.5, 1000)
    assert system.spec.cutoff.compare == "r <="
    assert load(ARGON, {"neighbors.skin": 0.5, "neighbors.rebuild.check": False}).spec.skin == 0.5


@pytest.mark.parametrize("key", ["potential.kind", "dynamics.kind"])
def test_a_kind_that_is_no_word_is_unknown(key):
    with pytest.raises(InputError, match=r"unknown .* kind"):
        load(ARGON, {key: ["nve", "hard"]})


def test_another_kind_drops_the_keys_it_does_not_have():
    switched = load(ARGON, {"cutoff.kind": "switched", "cutoff.onset": "7.0"})
    assert switched.spec.cutoff.onset == 7.0
    constant = {"potential.depth": "0.01", "potential.alpha": "1.7", "potential.r0": "3.8"}
    morse = load(ARGON, {"potential.kind": "morse", **constant})
    assert not hasattr(morse.spec.potential, "sigma")
    nve = load("argon/langevin-500", {"dynamics.kind": "nve"})
    assert not hasattr(nve.spec.dynamics, "friction")
    # a radius replaces multiples of sigma
    system = load(MIXTURE, {"cutoff.radius": "2.0"})
    assert system.spec.cutoff.in_sigma is None and system.r_cut == 2.0


@pytest.mark.parametrize(
    ("name", "changes", "stored"),
    [
        (ARGON, {}, True),
        (ARGON, {"dynamics.steps": "10"}, True),
        (ARGON, {"dynamics.temperature": "200"}, False),
        (ARGON, {"dynamics.seed": "8"}, False),
        (ARGON, {"dynamics.seed": "8", "structure.velocities": "file"}, True),
        # there it seeds the noise
        ("argon/langevin-500", {"dynamics.seed": "8"}, True),
    ],
)
def test_a_temperature_asked_for_is_not_ignored(name: str, changes: dict[str, str], stored: bool):
    assert load(name, changes).atoms.has("momenta") == stored


@pytest.mark.parametrize("name", [ARGON, MIXTURE, "pair/leaving-well", "silicon/tersoff-512"])
def test_a_written_system_is_the_same_system(name: str, tmp_path: Path):
    system = load(name)
    path = system.write(tmp_path / "run")
    again = load(path.parent)
    assert again.name == name
    assert same_bits(system, again)
    assert again.to_toml() == system.to_toml() == path.read_text(encoding="utf-8")
    ignored = {"structure", "name"}
    assert again.spec.model_dump(exclude=ignored) == system.spec.model_dump(exclude=ignored)


def test_overrides_are_part_of_what_is_written(tmp_path: Path):
    changed = load(ARGON, {"cutoff.kind": "switched", "neighbors.skin": "0.7", "dynamics.temperature": "50"})
    again = load(changed.write(tmp_path))
    assert again.spec.cutoff == changed.spec.cutoff
    assert again.spec.skin == 0.7
    assert not again.atoms.has("momenta")
    assert tomllib.loads(changed.to_toml())["structure"]["velocities"] == "drawn"


def test_a_system_with_a_table_takes_it_along(tmp_path: Path):
    source = tmp_path / "source"
    source.mkdir()
    zeros = "0.0\n" * 300
    (source / "cu.eam.alloy").write_text(f"a\nb\nc\n1 Cu\n100 0.1 100 0.05 5.0\n29 63.5 3.6 fcc\n{zeros}")
    (source / "cu.toml").write_text(
        'units = "metal"\n[structure]\nbuilder = "fcc"\nsymbol = "Cu"\nlattice_constant = 3.6\n'
        "repeat = [4, 4, 4]\n"
        '[potential]\nkind = "eam"\nfile = "cu.eam.alloy"\n[dynamics]\nkind = "nve"\ntimestep = 0.001\n'
    )
    system = load(source / "cu.toml")
    assert system.r_cut == 5.0
    again = load(system.write(tmp_path / "run"))
    assert (tmp_path / "run" / "cu.eam.alloy").is_file()
    assert again.r_cut == 5.0
    copied = systems.copy(source / "cu.toml", tmp_path / "copy")
    assert load(copied).r_cut == 5.0


@settings(max_examples=30, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.floats(-1e3, 1e3)),
    arrays(np.float64, (3, 3), elements=st.floats(-1e-3, 1e-3)),
)
def test_extxyz_keeps_every_bit(
    tmp_path_factory: pytest.TempPathFactory, positions: np.ndarray, momenta: np.ndarray
):
    atoms = bulk("Ar", a=np.pi).repeat((3, 1, 1))
    atoms.positions = positions
    atoms.set_momenta(momenta)
    atoms.set_masses([1 / 3, np.e, 40.0])
    atoms.pbc = (True, False, True)
    path = tmp_path_factory.mktemp("extxyz") / "atoms.extxyz"
    path.write_text(structures.to_extxyz(atoms))
    again = read(path)
    for name in ("positions", "momenta", "masses"):
        assert np.array_equal(again.arrays[name], atoms.arrays[name])
    assert np.array_equal(np.asarray(again.cell), np.asarray(atoms.cell))
    assert np.array_equal(again.pbc, atoms.pbc)


def test_masses(tmp_path: Path):
    assert set(load("argon/crystal-108").atoms.get_masses()) == {1.0}, "reduced units"
    assert set(load("pair/leaving-well").atoms.get_masses()) == {2.0}, "as given"
    assert set(load("silicon/tersoff-512").atoms.get_masses()) == {28.085}, "ase's"
    heavy = load("silicon/tersoff-512", {"structure.masses.Si": "30.0"})
    assert set(load(heavy.write(tmp_path)).atoms.get_masses()) == {30.0}


def test_a_builder_with_tilt_shears_cell_and_atoms_alike():
    plain = load("silicon/tersoff-512", {"structure.rattle": "0.0"})
    tilted = load("silicon/tersoff-512", {"structure.rattle": "0.0", "structure.tilt": "[0.1, -0.05, 0.2]"})
    sheared = plain.atoms.cell[0, 0] * np.array([[1, 0, 0], [0.1, 1, 0], [-0.05, 0.2, 1]])
    assert np.allclose(np.asarray(tilted.atoms.cell), sheared)
    scaled, same = (system.atoms.get_scaled_positions(wrap=False) for system in (tilted, plain))
    assert np.allclose(scaled, same)


def test_copy_gives_a_system_that_loads_and_overwrites_nothing(tmp_path: Path):
    copied = systems.copy(ARGON, tmp_path)
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {"liquid-864.extxyz", "liquid-864.toml", "schema.json"}
    assert same_bits(load(copied), load(ARGON))
    assert copied.read_text(encoding="utf-8").startswith("#:schema schema.json")
    with pytest.raises(InputError, match="already exists"):
        systems.copy(ARGON, tmp_path)
    systems.copy("argon/crystal-108", tmp_path)


@pytest.mark.nightly
def test_a_hundred_thousand_atoms_are_checked(tmp_path: Path):
    text = (shipped_folder() / f"{ARGON}.toml").read_text(encoding="utf-8")
    built = 'builder = "fcc"\nsymbol = "Ar"\nlattice_constant = 5.3\nrepeat = [30, 30, 30]\nrattle = 0.1\n'
    (tmp_path / "large.toml").write_text(text.replace('file = "liquid-864.extxyz"', built), encoding="utf-8")
    assert len(load(tmp_path / "large.toml").atoms) == 108_000


def test_build_is_the_function_whoever_imports_its_file_first():
    for name in ("build", "build_ball"):
        module = importlib.import_module(f"mdnum.systems.{name}")
        # what Python does with a submodule that is imported for the first time
        setattr(systems, name, module)
        assert getattr(systems, name) is getattr(module, name)


def test_the_packaged_copy_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    packaged = tmp_path / "mdnum" / "_systems" / "argon"
    packaged.mkdir(parents=True)
    (packaged / "other.toml").write_text("")
    assert ARGON in systems.names(), "the repository's, without a packaged copy"
    monkeypatch.setattr("mdnum.plain.__file__", str(tmp_path / "mdnum" / "plain.py"))
    assert systems.names() == ["argon/other"]
