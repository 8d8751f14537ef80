"""A table that grows by part files named after their first row, and is merged into one file at the end."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mdnum.errors import FolderError
from mdnum.store import files as manifest
from mdnum.store.files import disk_errors, opened, replacing, subfolder

_FLOAT, _INT, _SHORT, _BOOL, _TEXT = pa.float64(), pa.int64(), pa.int32(), pa.bool_(), pa.string()


def _columns(**columns: pa.DataType) -> Mapping[str, pa.DataType]:
    return MappingProxyType(columns)


#: The columns of each table; a writer may add more.
COLUMNS: Mapping[str, Mapping[str, pa.DataType]] = MappingProxyType(
    {
        "series": _columns(
            step=_INT, time=_FLOAT, potential=_FLOAT, kinetic=_FLOAT, total=_FLOAT, temperature=_FLOAT,
            pressure=_FLOAT, pairs=_INT, entered=_SHORT, left=_SHORT, displacement=_FLOAT,
            energy_jump=_FLOAT, ambiguous=_SHORT, min_margin=_FLOAT, conserved=_FLOAT,
        ),
        "flips": _columns(
            step=_INT, i=_SHORT, j=_SHORT, entered=_BOOL, distance=_FLOAT, margin=_FLOAT,
            radial_speed=_FLOAT, energy_jump=_FLOAT, force_jump=_FLOAT, bound=_FLOAT, ambiguous=_BOOL,
        ),
        "epochs": _columns(
            epoch=_INT, start=_INT, length=_INT, displacement=_FLOAT, skin_consumed=_FLOAT,
            pairs_listed=_INT, capacity=_INT, occupancy=_INT, reason=_TEXT, dangerous=_BOOL,
            lost_pairs=_INT, lost_pair_steps=_INT, first_lost_step=_INT, build_ms=_FLOAT,
            margin=_FLOAT,
        ),
        "steps": _columns(
            step=_INT, time=_FLOAT, contacts=_SHORT, entered=_SHORT, left=_SHORT, iterations=_SHORT,
            reason=_TEXT, residual=_FLOAT, stop_margin=_FLOAT, min_margin=_FLOAT, ambiguous=_SHORT,
            mean_height=_FLOAT, energy=_FLOAT,
        ),
        "contacts": _columns(
            step=_INT, ball=_SHORT, entered=_BOOL, height=_FLOAT, margin=_FLOAT, velocity=_FLOAT,
            bound=_FLOAT, ambiguous=_BOOL,
        ),
        "solver": _columns(
            step=_INT, ball=_SHORT, iteration=_SHORT, residual=_FLOAT, margin=_FLOAT, stopped=_BOOL,
            reason=_TEXT,
        ),
        "heights": _columns(step=_INT, ball=_SHORT, y=_FLOAT, v=_FLOAT),
        "separations": _columns(variant=_TEXT, step=_INT, separation=_FLOAT),
        "separation": _columns(
            step=_INT, time=_FLOAT, free=_FLOAT, imposed=_FLOAT, back=_FLOAT, cross=_INT, overridden=_FLOAT,
            furthest=_FLOAT, energy_a=_FLOAT, energy_b=_FLOAT, energy_imposed=_FLOAT,
        ),
        "cross_flips": _columns(
            step=_INT, i=_SHORT, j=_SHORT, differs=_BOOL, run=_TEXT, entered=_BOOL, margin=_FLOAT,
            bound=_FLOAT,
        ),
        "ambiguous_pairs": _columns(run=_TEXT, step=_INT, i=_SHORT, j=_SHORT, margin=_FLOAT, bound=_FLOAT),
        "around": _columns(step=_INT, run=_TEXT, ball=_SHORT, y=_FLOAT, v=_FLOAT, contact=_BOOL),
        "neighborhood": _columns(
            atom=_SHORT, x=_FLOAT, y=_FLOAT, z=_FLOAT, dx=_FLOAT, dy=_FLOAT, dz=_FLOAT,
        ),
        "boundaries": _columns(
            below=_FLOAT, above=_FLOAT, step=_INT, i=_SHORT, j=_SHORT, inside=_BOOL, also=_INT,
            margin_below=_FLOAT, margin_above=_FLOAT, bound=_FLOAT, loss_below=_FLOAT, loss_above=_FLOAT,
            jump=_FLOAT, energy_below=_FLOAT, energy_above=_FLOAT, separation=_FLOAT, confirmed=_TEXT,
        ),
        "intervals": _columns(
            low=_FLOAT, high=_FLOAT, history=_INT, digest=_TEXT, loss_low=_FLOAT, loss_high=_FLOAT,
            runs=_INT, gap=_FLOAT,
        ),
        "points": _columns(at=_FLOAT, history=_INT, loss=_FLOAT, energy=_FLOAT),
        "variants": _columns(
            variant=_TEXT, program=_TEXT, flags=_TEXT, reduction=_TEXT, cluster=_INT, first_bit=_INT,
            steps=_INT, separation=_FLOAT, seconds=_FLOAT, hash=_TEXT, failed=_TEXT,
        ),
        "variant_separations": _columns(variant=_TEXT, step=_INT, separation=_FLOAT),
        "policies": _columns(
            policy=_TEXT, state=_TEXT, force=_TEXT, decision=_TEXT, accumulate=_TEXT, horizon=_INT, i=_SHORT,
            j=_SHORT, margin=_FLOAT, gain=_FLOAT, closer_bits=_FLOAT, growth_rate=_FLOAT, failed=_TEXT,
        ),
        "policy_separations": _columns(policy=_TEXT, step=_INT, separation=_FLOAT),
        "ambiguous": _columns(
            policy=_TEXT, step=_INT, i=_SHORT, j=_SHORT, inside=_BOOL, margin=_FLOAT, bound=_FLOAT,
            exact=_FLOAT, wrong=_BOOL,
        ),
        "reach": _columns(
            step=_INT, positive=_FLOAT, negative=_FLOAT, i=_SHORT, j=_SHORT, furthest=_FLOAT,
        ),
        "foretold": _columns(
            asked=_TEXT, step=_INT, i=_SHORT, j=_SHORT, amplitude=_FLOAT, margin=_FLOAT, ulps=_FLOAT,
        ),
        "growth": _columns(
            horizon=_INT, step=_INT, onto_positions=_FLOAT, onto_velocities=_FLOAT, size=_FLOAT, speed=_FLOAT,
        ),
        "flip_contributions": _columns(
            step=_INT, i=_SHORT, j=_SHORT, entered=_BOOL, margin=_FLOAT, bound=_FLOAT, ambiguous=_BOOL,
            radial_speed=_FLOAT, weight=_FLOAT, grazing=_BOOL,
        ),
        "trust": _columns(horizon=_INT),
        "scaling": _columns(
            horizon=_INT, overflow=_INT, underflow=_INT, subnormal=_INT, largest=_FLOAT, smallest=_FLOAT,
            scaled_overflow=_INT, scaled_underflow=_INT,
        ),
        "curves": _columns(part=_TEXT, curve=_TEXT, line=_TEXT, x=_FLOAT, y=_FLOAT),
        "energies": _columns(
            run=_TEXT, step=_INT, time=_FLOAT, potential=_FLOAT, kinetic=_FLOAT, total=_FLOAT, entered=_INT,
            left=_INT, jumps=_FLOAT, rest=_FLOAT,
        ),
        "crossings": _columns(
            run=_TEXT, step=_INT, i=_INT, j=_INT, rank=_INT, entered=_BOOL, threshold=_FLOAT,
            distance=_FLOAT, margin=_FLOAT, energy_jump=_FLOAT,
        ),
        "frames": _columns(
            rule=_SHORT, frame=_INT, number=_INT, time=_FLOAT, pairs=_INT, near=_INT, entered=_INT,
            left=_INT, ambiguous=_INT, min_margin=_FLOAT, fewest=_SHORT, neighbors=_FLOAT, most=_SHORT,
        ),
        "members": _columns(rule=_SHORT, i=_SHORT, j=_SHORT, rank=_SHORT, distance=_FLOAT),
        "lifetimes": _columns(
            rule=_SHORT, frames=_INT, time=_FLOAT, at_risk=_INT, survival=_FLOAT, error=_FLOAT,
            intermittent=_FLOAT, residence=_FLOAT, again=_FLOAT,
        ),
        "neighbors": _columns(rule=_SHORT, neighbors=_INT, counted=_INT),
        "residues": _columns(rule=_SHORT, residue=_TEXT, between=_INT, within=_INT),
        "busiest": _columns(
            rule=_SHORT, i=_SHORT, j=_SHORT, rank=_SHORT, flips=_INT, inside=_INT, first=_TEXT, second=_TEXT,
        ),
        "apart": _columns(
            frame=_INT, time=_FLOAT, time_b=_FLOAT, furthest=_FLOAT, typical=_FLOAT, atom=_SHORT,
            pairs_a=_INT, pairs_b=_INT, only_a=_INT, only_b=_INT,
        ),
        "differing": _columns(
            rule=_SHORT, frame=_INT, i=_SHORT, j=_SHORT, rank=_SHORT, inside=_TEXT, distance_a=_FLOAT,
            distance_b=_FLOAT, margin_a=_FLOAT, margin_b=_FLOAT, bound=_FLOAT, ambiguous=_BOOL,
        ),
        "areas": _columns(
            area=_TEXT, asked=_INT, passed=_INT, failed=_INT, refused=_INT, skipped=_INT,
        ),
        "failures": _columns(
            code=_TEXT, area=_TEXT, case=_TEXT, atoms=_INT, steps=_INT, step=_INT, text=_TEXT, script=_TEXT,
        ),
    }
)  # fmt: skip

#: Tables that go by another world's name and have columns of their own, by world and name.
_OWN: Mapping[tuple[str, str], Mapping[str, pa.DataType]] = MappingProxyType(
    {
        ("flips", "flips"): _columns(
            rule=_SHORT, frame=_INT, i=_SHORT, j=_SHORT, rank=_SHORT, entered=_BOOL, distance=_FLOAT,
            before=_FLOAT, margin=_FLOAT, margin_before=_FLOAT, bound=_FLOAT, ambiguous=_BOOL,
        ),
        ("flips", "contacts"): _columns(
            rule=_SHORT, i=_SHORT, j=_SHORT, rank=_SHORT, begin=_INT, end=_INT, began=_BOOL, ended=_BOOL,
        ),
    }
)  # fmt: skip


def columns_of(world: str, table: str) -> Mapping[str, pa.DataType]:
    """The columns of a table in a folder of some world; empty for a table that is not declared."""
    return _OWN.get((world, table)) or COLUMNS.get(table, {})


#: The tables that a folder has, whether they hold a row or not, by the world that was run; folders that
#: answer another question than what a run does or where two part go by that question.
TABLES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "md": ("series", "flips", "epochs"),
        "ball": ("steps", "contacts", "solver", "heights", "separations"),
        "demos": ("curves",),
        "fork": ("separation", "cross_flips"),
        "screen": (),
        "compare": (),
        "benign": (),
        "map": ("boundaries", "intervals", "points"),
        "processes": ("variants", "variant_separations"),
        "certify": ("policies", "ambiguous", "policy_separations"),
        "forecast": ("foretold", "reach"),
        "audit": ("curves", "energies", "crossings"),
        "grad": ("growth", "flip_contributions", "trust", "scaling"),
        "flips": ("flips", "frames", "members", "contacts", "lifetimes", "neighbors", "residues", "busiest"),
        "flips-compare": ("apart", "differing"),
        "conform": ("areas", "failures"),
    }
)

#: The verb of the command line that makes a folder of a world.
VERBS: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(TABLES, "fork"),
        "md": "run", "ball": "ball", "demos": "ball --demo", "audit": "audit", "grad": "grad",
        "conform": "conform", "flips": "flips", "flips-compare": "flips",
    }
)  # fmt: skip

# rows held back before a part is written without waiting for a checkpoint: bounds the memory of a run
_BUFFER_ROWS = 100_000
# fixed, so that the merged file has the same bytes however the run was cut into parts
_GROUP_ROWS = 262_144
# every page carries a checksum, which whoever reads the file can ask for
_WRITTEN: Mapping[str, Any] = MappingProxyType({"compression": "zstd", "write_page_checksum": True})


class TableStream:
    """Rows 0, 1, 2, ... of one table, spread over `<name>.parquet` and `parts/<name>-<first row>.parquet`.

    Which rows a file holds follows from its name, so no step of writing, merging or truncating
    leaves a folder whose rows cannot be told apart, wherever it was killed.
    """

    def __init__(self, root: Path, name: str, world: str = "md", check: Callable[[Path], None] | None = None):
        if not re.fullmatch(r"[a-z][a-z_]*", name):
            raise FolderError(f"no table is called {name!r}", where=str(root))
        self.name = name
        self._root = root
        self._check = check
        #: digests of the part files that were written, by name
        self.written: dict[str, list[str]] = {}
        self._known = columns_of(world, name)
        self.merged_path = root / f"{name}.parquet"
        self.parts_folder = root / "parts"
        self._buffer: list[pa.Table] = []
        self._buffered = 0
        self._schema: pa.Schema | None = None
        files = self.files()
        self.flushed = sum(rows for _, rows in files)
        if files:
            with _parquet(files[0][0]) as file:
                self._schema = file.schema_arrow

    @property
    def rows(self) -> int:
        """Rows appended so far, those still in memory included."""
        return self.flushed + self._buffered

    def parts(self) -> list[tuple[int, Path]]:
        """(first row, path) of the part files, in order."""
        found = self.parts_folder.glob(f"{self.name}-*.parquet")
        named = re.compile(re.escape(self.name) + r"-(\d{12,})\.parquet")
        return sorted((int(match[1]), path) for path in found if (match := named.fullmatch(path.name)))

    def files(self) -> list[tuple[Path, int]]:
        """(path, rows) of the files that make up the table, gap-free; parts already merged are skipped."""
        files: list[tuple[Path, int]] = []
        rows = 0
        if self.merged_path.exists():
            rows = self._row_count(self.merged_path)
            files.append((self.merged_path, rows))
        for start, path in self.parts():
            if start < rows:
                continue
            if start > rows:
                raise FolderError(
                    f"rows {rows} to {start - 1} of table {self.name!r} are missing",
                    remedy="A part file was removed; run again in a new folder",
                    where=str(self.parts_folder),
                )
            count = self._row_count(path)
            files.append((path, count))
            rows += count
        return files

    def append(self, columns: Mapping[str, Any]) -> None:
        """Adds rows, in memory until the next flush.

        Args:
            columns: equally long arrays by column name; at least the table's own columns.
        """
        table = self._table(columns)
        if not table.num_rows:
            return
        self._buffer.append(table)
        self._buffered += table.num_rows
        if self._buffered >= _BUFFER_ROWS:
            self.flush()

    def flush(self) -> None:
        """Writes what is in memory as one part file."""
        if not self._buffered:
            return
        table = pa.concat_tables(self._buffer).combine_chunks()
        subfolder(self._root, "parts")
        self._replace(self.parts_folder / f"{self.name}-{self.flushed:012d}.parquet", [table])
        self.flushed += self._buffered
        self._buffer, self._buffered = [], 0

    def truncate(self, rows: int) -> None:
        """Keeps the first rows of the table, in memory and on disk."""
        self._buffer, self._buffered = [], 0
        files = self.files()
        have = sum(count for _, count in files)
        if have < rows:
            raise FolderError(
                f"table {self.name!r} has {have} rows where its checkpoint counts {rows}",
                remedy="The folder was changed since; run again in a new folder",
                where=str(self.merged_path.parent),
            )
        # parts of a merge that was killed before it removed them: their rows are in the merged file
        used = {path for path, _ in files}
        gone = [path for _, path in self.parts() if path not in used]
        first = 0
        for path, count in files:
            if first >= rows:
                gone.append(path)
            elif rows < first + count:
                with _parquet(path) as file:
                    kept = file.read().slice(0, rows - first)
                self._replace(path, [kept])
            first += count
        manifest.update(self._root, {}, [manifest.place(path)[1] for path in gone])
        for path in gone:
            path.unlink()
        self.flushed = rows

    def merge(self) -> None:
        """Writes all rows into one file and removes the parts; a table without a row gets an empty file."""
        self.flush()
        if not self.parts() and self.merged_path.exists():
            return
        if self._schema is None:
            self._schema = pa.schema(list(self._known.items()))
        self._replace(self.merged_path, _regroup(self.batches(), _GROUP_ROWS))
        parts = [path for _, path in self.parts()]
        merged = self.merged_path.name
        # rows of parts that are in the merged file are not looked at any more
        manifest.update(self._root, {merged: self.written[merged]}, [f"parts/{path.name}" for path in parts])
        with disk_errors(self.parts_folder):
            for path in parts:
                path.unlink()

    def batches(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """The rows on disk in order, a file or row group at a time."""
        for path, _ in self.files():
            with _parquet(path) as file:
                self._refuse_columns(path, file.schema_arrow, columns)
                for group in range(file.num_row_groups):
                    yield file.read_row_group(group, columns=columns)

    def read(self, columns: Sequence[str] | None = None, rows: int | None = None) -> pa.Table:
        """The rows on disk as one table.

        Args:
            columns: only these.
            rows: only the first rows.
        """
        tables: list[pa.Table] = []
        have = 0
        for batch in self.batches(columns):
            if rows is not None and have >= rows:
                break
            tables.append(batch)
            have += batch.num_rows
        if not tables:
            fields = self._known
            names = fields if columns is None else columns
            return pa.schema([(name, fields[name]) for name in names]).empty_table()
        table = pa.concat_tables(tables)
        return table if rows is None else table.slice(0, rows)

    def _row_count(self, path: Path) -> int:
        if self._check is not None:
            self._check(path)
        with _parquet(path) as file:
            return file.metadata.num_rows

    def _replace(self, path: Path, tables: Iterable[pa.Table]) -> None:
        """Writes rows into a file of this table, which the manifest expects before it is there."""
        schema = self._schema
        with replacing(path) as file:
            with pq.ParquetWriter(file, schema, **_WRITTEN) as writer:
                for table in tables:
                    writer.write_table(table, row_group_size=_GROUP_ROWS)
            file.flush()
            found = manifest.digest_of_file(file)
            root, name = manifest.place(path)
            if path == self.merged_path:
                manifest.update(root, {name: [manifest.digest(path), found]})
            elif path.exists():
                manifest.foretell(path, found)
        self.written[name] = [found]

    def _refuse_columns(self, path: Path, schema: pa.Schema, wanted: Sequence[str] | None) -> None:
        """Refuses columns of another type than this table's, and a file without those that are wanted."""
        found = {field.name: field.type for field in schema}
        other = [name for name, kind in self._known.items() if found.get(name, kind) != kind]
        missing = [name for name in wanted or () if name not in found]
        if other or missing:
            seen = f"column {other[0]!r} holds {found[other[0]]}" if other else f"no column {missing[0]!r}"
            raise FolderError(
                f"is not a table of {self.name} ({seen})", remedy="Run again in a new folder", where=str(path)
            )

    def _table(self, columns: Mapping[str, Any]) -> pa.Table:
        schema = self._schema
        if schema is None:
            known = self._known
            extra = {key: pa.array(np.asarray(columns[key])).type for key in columns if key not in known}
            schema = pa.schema([*known.items(), *extra.items()])
        missing = [name for name in schema.names if name not in columns]
        unknown = [name for name in columns if name not in schema.names]
        if missing or unknown:
            raise ValueError(f"table {self.name!r}: columns missing {missing}, not expected {unknown}")
        arrays = [_array(columns[field.name], field.type) for field in schema]
        lengths = {field.name: len(array) for field, array in zip(schema, arrays, strict=True)}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"table {self.name!r}: columns of different length: {lengths}")
        self._schema = schema
        return pa.Table.from_arrays(arrays, schema=schema)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    # by its buffers, since pa.array imports pandas, which takes half a second; and of a private copy: arrow
    # would otherwise share the caller's memory until the flush
    values = np.array(values)
    if pa.types.is_string(kind):
        texts = [text.encode() for text in values.tolist()]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return pa.StringArray.from_buffers(len(texts), pa.py_buffer(offsets), pa.py_buffer(b"".join(texts)))
    held = np.packbits(values, bitorder="little") if values.dtype == bool else np.ascontiguousarray(values)
    given = pa.from_numpy_dtype(values.dtype)
    # a float that is no integer is refused by the cast
    return pa.Array.from_buffers(given, len(values), [None, pa.py_buffer(held)]).cast(kind)


def as_numpy(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """A column without gaps as numpy, by its buffers: `to_numpy` imports pandas."""
    parts = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    if pa.types.is_string(column.type):
        return np.array([text for part in parts for text in part.to_pylist()], object)
    kind = np.dtype(column.type.to_pandas_dtype())
    read = [np.zeros(0, kind)]
    for part in filter(len, parts):
        if pa.types.is_boolean(column.type):
            bits = np.frombuffer(part.buffers()[1], np.uint8)
            values = np.unpackbits(bits, bitorder="little").astype(bool)
        else:
            values = np.frombuffer(part.buffers()[1], kind)
        read.append(values[part.offset :][: len(part)])
    return np.concatenate(read)


@contextmanager
def _parquet(path: Path) -> Iterator[pq.ParquetFile]:
    """A parquet file whose pages are compared with their checksums as they are read."""
    try:
        with opened(path) as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
            yield file
    except (OSError, pa.ArrowException, MemoryError) as error:
        seen = " ".join(str(error).split())[:200]
        raise FolderError(
            f"is damaged: not a readable parquet file ({seen})",
            where=str(path),
            remedy="Restore it from a copy, or run again in a new folder",
        ) from error


def _regroup(tables: Iterator[pa.Table], rows: int) -> Iterator[pa.Table]:
    held: list[pa.Table] = []
    count = 0
    for table in tables:
        held.append(table)
        count += table.num_rows
        while count >= rows:
            whole = pa.concat_tables(held)
            yield whole.slice(0, rows).combine_chunks()
            held = [whole.slice(rows)]
            count -= rows
    if count:
        yield pa.concat_tables(held).combine_chunks()
