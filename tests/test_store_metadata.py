"""What parquet files say of themselves, and that other programs read them with the types one expects."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import mdnum
from mdnum import units
from mdnum.plain import beside
from mdnum.store import RunFolder, columns
from mdnum.verbs import VERBS, declared
from mdnum.verbs.frame import layout

pytest.importorskip("MDAnalysis")
CRYSTAL = Path(__file__).parents[1] / "systems/argon/crystal-108.toml"
UNITS = {"length": "Å", "energy": "eV", "time": "ps", "mass": "amu", "decision": "Å²"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Flips of water-like atoms, with names."""
    from ase import Atoms
    from ase.io import write

    path = tmp_path_factory.mktemp("tables")
    rng, images = np.random.default_rng(5), []
    for _ in range(8):
        atoms = Atoms("OHH" * 9, rng.uniform(0, 9, (27, 3)), cell=[9, 9, 9], pbc=True)
        atoms.new_array("resname", np.array(["SOL", "SOL", "SOL"] * 8 + ["ION"] * 3))
        atoms.new_array("resid", np.repeat(np.arange(9), 3) + 1)
        images.append(atoms)
    write(path / "a.extxyz", images)
    return mdnum.flips(path / "a.extxyz", cutoffs=[3.0, 4.0], out=path / "out", report=False).folder


def of(field):
    return {key.decode(): word.decode() for key, word in (field.metadata or {}).items()}


def test_every_declared_column_has_a_description_and_no_other_has_one():
    described = beside(columns.__file__)
    kinds = [layout(kind) for name in VERBS for kind in declared(name).get("kinds", ())]
    tables = {table.rstrip("?") for kind in kinds for table in kind.tables}
    names = {(table, name) for table in tables for kind in kinds for name in kind.columns(table)}
    assert len(names) > 200
    for table, name in names:
        assert columns.meaning(table, name)[1], f"{table}.{name}"
    assert set(described) - {"columns"} <= tables
    for table, rows in described.items():
        for name, row in rows.items():
            assert len(row) == 2 and row[1] and not row[1].endswith("."), f"{table}.{name}"
            # a quantity is one that folders have, or a word that no quantity is made of
            if row[0] not in ("ms", "s", "°"):
                left = units.named(
                    row[0], dict.fromkeys((*UNITS, "temperature", "pressure", "loss", "parameter"), "U")
                )
                assert left.strip("U/³²·√()") == "", f"{table}.{name}: {row[0]}"


@pytest.mark.parametrize(
    ("quantity", "expected"),
    [
        ("length", "Å"), ("energy/length", "eV/Å"), ("length³", "Å³"), ("ms", "ms"), ("", ""),
        ("decision", "Å²"), ("length·√(mass/energy)", "Å·√(amu/eV)"), ("loss", ""), ("loss/length", ""),
        ("kcal/mol", "kcal/mol"), ("kcal/mol/length", "kcal/mol/Å"),
    ],
)  # fmt: skip
def test_units_are_made_of_the_folders_own(quantity, expected):
    assert units.named(quantity, UNITS) == expected


def test_the_schema_names_version_kind_system_and_units(folder):
    schema = pq.read_schema(folder / "flips.parquet")
    kept = of(schema)
    assert (kept["mdnum.version"], kept["mdnum.kind"], kept["mdnum.table"]) == (
        mdnum.__version__, "flips", "flips",
    )  # fmt: skip
    assert kept["mdnum.system"] == "a.extxyz"
    assert json.loads(kept["mdnum.units"])["length"] == "Å"
    assert of(schema.field("distance")) == {"unit": "Å", "description": "distance of the pair"}
    assert "unit" not in of(schema.field("rank"))
    every = json.loads(kept["mdnum.columns"])
    assert every == {field.name: of(field) for field in schema} and len(every) > 15


def test_no_unit_is_claimed_for_a_file_that_names_none(tmp_path):
    head = "ITEM: NUMBER OF ATOMS\n20\nITEM: BOX BOUNDS pp pp pp\n0 9\n0 9\n0 9\nITEM: ATOMS id type x y z\n"
    lines = []
    for step, frame in enumerate(np.random.default_rng(1).uniform(0, 9, (4, 20, 3))):
        rows = [f"{n + 1} 1 {x} {y} {z}\n" for n, (x, y, z) in enumerate(frame)]
        lines.append(f"ITEM: TIMESTEP\n{step}\n{head}{''.join(rows)}")
    (tmp_path / "a.lammpstrj").write_text("".join(lines))
    out = mdnum.flips(tmp_path / "a.lammpstrj", cutoffs=3.0, out=tmp_path / "out", report=False)
    assert not out.summary["length"]
    held = of(pq.read_schema(out.folder / "flips.parquet").field("distance"))
    assert held == {"description": "distance of the pair"}


@pytest.mark.parametrize("cut", [[], [20], [10, 30]])
def test_a_run_says_the_same_however_it_was_cut(cut, tmp_path):
    whole = mdnum.run(CRYSTAL, steps=40, out=tmp_path / "whole", report=False).folder
    folder = tmp_path / "cut"
    mdnum.run(CRYSTAL, steps=cut[0] if cut else 40, out=folder, report=False)
    for steps in [*cut[1:], 40] if cut else []:
        mdnum.run(None, resume=folder, steps=steps, report=False)
    for name in ("flips", "series", "ranges"):
        a, b = (pq.read_schema(each / f"{name}.parquet") for each in (whole, folder))
        assert a.equals(b, check_metadata=True)
    kept = of(pq.read_schema(folder / "flips.parquet"))
    assert len(kept["mdnum.run"]) == 64 and json.loads(kept["mdnum.units"])["decision"] == "σ²"


def test_another_program_is_another_run(tmp_path):
    runs = [
        mdnum.run(CRYSTAL, steps=5, out=tmp_path / f"{dt}", report=False, overrides={"dynamics.timestep": dt})
        for dt in (0.002, 0.004)
    ]
    kept = [of(pq.read_schema(run.folder / "flips.parquet"))["mdnum.run"] for run in runs]
    assert kept[0] != kept[1]


def test_pandas_reads_words_flags_and_numbers(folder):
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(folder / "flips.parquet")
    assert frame["entered"].dtype == bool and frame["i"].dtype == np.int32
    assert frame["distance"].dtype == np.float64
    for name in ("decided_by", "atom_name_i", "residue_name_j"):
        assert isinstance(frame[name].dtype, pandas.CategoricalDtype)
    assert set(frame["residue_name_j"]) == {"SOL", "ION"}
    assert frame["step"].isna().all() and frame.groupby("rule").size().gt(0).all()


def test_integers_with_nulls_stay_integers_with_the_documented_types(folder):
    pd = pytest.importorskip("pandas")
    text = (Path(__file__).parents[1] / "docs/folders.md").read_text(encoding="utf-8")
    code = next(block for block in text.split("```python\n")[1:] if "types_mapper" in block).split("```")[0]
    known = {"pa": pa, "pd": pd, "outcome": mdnum.read(folder)}
    *first, last = code.strip().splitlines()
    exec("\n".join(first), known)
    frame = eval(last, known)
    assert frame["step"].dtype == frame["frame"].dtype == pd.Int64Dtype() and frame["step"].isna().all()
    assert (
        frame["i"].dtype == pd.Int32Dtype()
        and len(frame) == pq.read_metadata(folder / "flips.parquet").num_rows
    )


def test_a_folder_without_a_system_names_its_run(folder, tmp_path):
    kept = of(pq.read_schema(folder / "flips.parquet"))["mdnum.run"]
    assert len(kept) == 64 and kept == of(pq.read_schema(folder / "frames.parquet"))["mdnum.run"]
    again = mdnum.flips(folder.parent / "a.extxyz", cutoffs=3.0, out=tmp_path / "b", report=False).folder
    assert of(pq.read_schema(again / "flips.parquet"))["mdnum.run"] != kept


def test_polars_reads_words_flags_and_numbers(folder):
    polars = pytest.importorskip("polars")
    frame = polars.read_parquet(folder / "flips.parquet")
    kinds = frame.schema
    assert (
        kinds["entered"] == polars.Boolean and kinds["i"] == polars.Int32 and kinds["frame"] == polars.Int64
    )
    assert kinds["distance"] == polars.Float64 and kinds["residue_number_i"] == polars.Int64
    for name in ("decided_by", "atom_name_i", "residue_name_j"):
        assert isinstance(kinds[name], polars.Categorical | polars.Enum)
    seen = frame.filter(polars.col("residue_name_j") == "ION")
    table = pq.read_table(folder / "flips.parquet")
    assert len(seen) == table["residue_name_j"].to_pylist().count("ION") > 0
    assert frame["step"].null_count() == len(frame)


def test_duckdb_reads_words_flags_and_numbers(folder):
    duckdb = pytest.importorskip("duckdb")
    file = str(folder / "flips.parquet")
    kinds = {name: kind for name, kind, *_ in duckdb.sql(f"describe select * from '{file}'").fetchall()}
    assert (kinds["entered"], kinds["i"], kinds["frame"]) == ("BOOLEAN", "INTEGER", "BIGINT")
    assert kinds["distance"] == "DOUBLE" and kinds["residue_name_j"] in ("VARCHAR", "ENUM")
    counted = duckdb.sql(
        f"select residue_name_j, count(*) from '{file}' where entered group by all order by all"
    ).fetchall()
    table = pq.read_table(file).to_pylist()
    assert counted == sorted(
        (name, sum(row["entered"] and row["residue_name_j"] == name for row in table))
        for name in ("SOL", "ION")
    )
    known = dict(duckdb.sql(f"select key, value from parquet_kv_metadata('{file}')").fetchall())
    assert known[b"mdnum.kind"] == b"flips" and b"distance" in known[b"mdnum.columns"]


def test_a_table_without_a_folder_around_it_has_no_metadata(tmp_path):
    from mdnum.store.tables import TableStream

    folder = RunFolder.create(tmp_path / "f", layout("conform"))
    stream = TableStream(tmp_path / "f", "areas", folder.layout)
    stream.merge()
    assert pq.read_schema(tmp_path / "f/areas.parquet").metadata is None
    assert pa.types.is_int64(pq.read_schema(tmp_path / "f/areas.parquet").field("asked").type)
