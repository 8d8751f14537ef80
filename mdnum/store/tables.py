"""Tables that are written in parts during a run, and merged at the end.

If a folder cannot be resumed, a thread writes the final file of each table directly.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing.pool import ThreadPool
from pathlib import Path
from queue import Full, Queue
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mdnum.errors import FolderError
from mdnum.store import files as manifest
from mdnum.store.files import disk_errors, opened, replacing, subfolder
from mdnum.store.layout import TYPES, Layout

_WORD = pa.dictionary(pa.int32(), pa.string())
_ARROW = {name: _WORD if name == "word" else pa.type_for_alias(name) for name in TYPES}
# rows held back before a part is written without waiting for a checkpoint: bounds the memory of a run
_BUFFER_ROWS = 100_000
# fixed, so that the merged file has the same bytes however the run was cut into parts
_GROUP_ROWS = 262_144
# how many times the bytes of its file a table may hold, and bytes that any may hold: columns of zeros, such
# as the separation of two equal runs, are packed to next to nothing
_MOST_TIMES, _MOST_UNPACKED = 100, 1 << 30
_RESTORE = "Restore it from a copy, or run again in a new folder"
# columns whose least and largest values in a row group help who looks for some rows
_ORDERED = frozenset({"rule", "step", "frame", "time"})
# columns whose values hardly repeat: a dictionary of them is made in vain, and takes as long as all the rest
_DISTINCT = frozenset({"i", "j", "distance", "before", "margin", "margin_before", "radial_speed"})


class TableStream:
    """A growing table, stored in the files `<name>.parquet` and `parts/<name>-<first row>.parquet`.

    The name of a part file tells which rows the file contains. The rows in each file are therefore known,
    even if the process is killed.
    """

    def __init__(
        self, root: Path, name: str, layout: Layout | None, check: Callable[[Path], None] | None = None,
        describe: Callable[[pa.Schema], pa.Schema] = pa.Schema.remove_metadata, in_parts: bool = False,
    ):  # fmt: skip
        if not re.fullmatch(r"[a-z][a-z_]*", name):
            raise FolderError(f"the folder has no table {name!r}", where=str(root))
        self.name = name
        self._root = root
        self._check = check
        # adds what the merged file says of its folder
        self._describe = describe
        #: digests of the part files that were written, by name
        self.written: dict[str, list[str]] = {}
        declared = {} if layout is None else layout.columns(name)
        self._known = {column: _ARROW[kind] for column, (kind, _) in declared.items()}
        usual = {} if layout is None else layout.usual.get(name, {})
        # columns that rows may leave out, and what is in them then: parts that are written, read, packed and
        # removed do not carry what is the same in every row
        free = [column for column, (_, unknown) in declared.items() if unknown]
        self._usual: dict[str, Any] = {**dict.fromkeys(free), **usual}
        self.merged_path = root / f"{name}.parquet"
        self.parts_folder = root / "parts"
        self._buffer: list[Mapping[str, Any]] = []
        self._buffered = 0
        # of what is resumed from the rows that it has, or may be killed at any time
        self._in_parts = in_parts or (layout is not None and layout.resumes_from == "checkpoint.npz")
        self._writing: _Writing | None = None
        self._schema: pa.Schema | None = None
        files = self.files()
        self.flushed = sum(rows for _, rows in files)
        if files:
            with _parquet(files[0][0]) as file:
                self._schema = self._whole(file.schema_arrow.empty_table()).schema

    @property
    def rows(self) -> int:
        """Number of rows appended so far, including rows in memory."""
        return self.flushed + self._buffered

    def parts(self) -> list[tuple[int, Path]]:
        """Return the first row and the path of each part file."""
        found = self.parts_folder.glob(f"{self.name}-*.parquet")
        named = re.compile(re.escape(self.name) + r"-(\d{12,})\.parquet")
        return sorted((int(match[1]), path) for path in found if (match := named.fullmatch(path.name)))

    def files(self) -> list[tuple[Path, int]]:
        """Return the path and number of rows of each file of the table. Merged part files are omitted."""
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
                    f"rows {rows} to {start - 1} of the table {self.name!r} are missing",
                    remedy="Start the run again in a new folder, because a file of the table was removed",
                    where=str(self.parts_folder),
                )
            count = self._row_count(path)
            files.append((path, count))
            rows += count
        return files

    def append(self, columns: Mapping[str, Any]) -> None:
        """Append rows to the table; rows stay in memory until the next flush.

        Args:
            columns: equally long arrays by column name, or a text for all rows; at least the table's own
                columns, except those that may be unknown.
        """
        schema = self._schema
        if schema is None:
            known = self._known
            extra = {key: pa.array(np.asarray(columns[key])).type for key in columns if key not in known}
            schema = pa.schema([*known.items(), *extra.items()])
        missing = [name for name in schema.names if name not in columns and name not in self._usual]
        unknown = [name for name in columns if name not in schema.names]
        if missing or unknown:
            raise ValueError(f"table {self.name!r} has missing columns {missing} and extra columns {unknown}")
        lengths = {name: len(one) for name, one in columns.items() if not isinstance(one, str)}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the columns of the table {self.name!r} have different lengths: {lengths}")
        self._schema, rows = schema, max(lengths.values())
        if not rows:
            return
        # private copies: the caller may change its arrays before the flush
        held = {
            name: one if isinstance(one, str) else np.array(one)
            for name, one in columns.items()
            if not _repeats(one, self._usual.get(name))
        }
        if self._buffer and self._buffer[0].keys() != held.keys():
            self.flush()
        self._buffer.append(held)
        self._buffered += rows
        if self._buffered >= _BUFFER_ROWS:
            self.flush()

    def look_up(self, of: str, columns: Mapping[str, Any]) -> None:
        """Declare columns whose values are looked up when rows are written.

        Args:
            of: name of the column of indices.
            columns: texts or integers for each index, by column name.
        """
        for name, values in columns.items():
            kind = _WORD if isinstance(values[0], str) else pa.int64()
            self._known = {**self._known, name: kind}
            found = as_arrow(values, kind, len(values))
            self._usual[name] = lambda table, found=found: found.take(table[of])

    def flush(self) -> None:
        """Write the rows in memory as a part file, or pass them to the writing thread."""
        if not self._buffered:
            return
        held, schema = together(self._buffer), cast(pa.Schema, self._schema)
        fields = [field for field in schema if field.name in held]
        arrays = [as_arrow(held[field.name], field.type, self._buffered) for field in fields]
        table = pa.Table.from_arrays(arrays, schema=pa.schema(fields))
        if self._in_parts:
            subfolder(self._root, "parts")
            part = self.parts_folder / f"{self.name}-{self.flushed:012d}.parquet"
            self._replace(part, [table], table.schema)
        else:
            if self._writing is None:
                if self.flushed:
                    raise ValueError(f"the table {self.name!r} is complete, so no rows can be appended")
                self._writing = _Writing(self._write_merged)
            self._writing.put(table)
        self.flushed += self._buffered
        self._buffer, self._buffered = [], 0

    def truncate(self, rows: int) -> None:
        """Keep the first `rows` rows of the table, in memory and on disk."""
        self._buffer, self._buffered = [], 0
        files = self.files()
        have = sum(count for _, count in files)
        if have < rows:
            raise FolderError(
                f"the table {self.name!r} has {have} rows, fewer than the {rows} rows at the last checkpoint",
                remedy="Run again in a new folder: the old folder was changed after the checkpoint",
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
                self._replace(path, [kept], kept.schema)
            first += count
        manifest.update(self._root, {}, [manifest.place(path)[1] for path in gone])
        for path in gone:
            path.unlink()
        self.flushed = rows

    def merge(self) -> None:
        """Write all rows into one file, and remove part files. A table without rows becomes an empty file."""
        self.flush()
        if self._writing is not None:
            self._writing.end()
            self._writing = None
        elif not self.parts() and self.merged_path.exists():
            return
        else:
            if self._schema is None:
                self._schema = pa.schema(list(self._known.items()))
            self._write_merged(self._on_disk())
        parts = [path for _, path in self.parts()]
        merged = self.merged_path.name
        # rows of parts that are in the merged file are not read any more
        manifest.update(self._root, {merged: self.written[merged]}, [f"parts/{path.name}" for path in parts])
        with disk_errors(self.parts_folder):
            for path in parts:
                path.unlink()

    def close(self) -> None:
        """Stop the writing thread, and discard the unfinished file of the table."""
        if self._writing is not None:
            self._writing.end(whole=False)
            self._writing = None

    def batches(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Return an iterator over the rows on disk, in blocks."""
        return (self._whole(table, columns) for table in self._on_disk(columns))

    def _on_disk(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        for path, _ in self.files():
            with _parquet(path) as file:
                self._refuse_columns(path, file.schema_arrow, columns)
                for group in range(file.num_row_groups):
                    yield file.read_row_group(group, columns=columns)

    def read(self, columns: Sequence[str] | None = None, rows: int | None = None) -> pa.Table:
        """Return the rows on disk as one table.

        Args:
            columns: names of the columns to read; None for all.
            rows: number of rows to read, beginning with the first; None for all.
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
            if not fields:
                raise FolderError(f"the folder has no table {self.name!r}", where=str(self._root))
            names = fields if columns is None else columns
            # as_arrow: an empty table of pyarrow's own imports pandas
            return pa.table({name: as_arrow([], fields[name]) for name in names})
        table = pa.concat_tables(tables)
        return table if rows is None else table.slice(0, rows)

    def _write_merged(self, tables: Iterator[pa.Table]) -> None:
        groups = map(self._whole, _regroup(tables, _GROUP_ROWS, self._whole))
        self._replace(self.merged_path, groups, self._describe(cast(pa.Schema, self._schema)))

    def _whole(self, table: pa.Table, columns: Sequence[str] | None = None) -> pa.Table:
        """Return rows with the requested (default: all) columns; missing columns get default values."""
        there = table.column_names
        known = [name for name in self._known if name in there or name in self._usual]
        names = columns or [*known, *(name for name in there if name not in self._known)]
        if names == there:
            return table
        rows, made = len(table), {}
        for name in (name for name in names if name not in there):
            value = self._usual[name]
            made[name] = value(table) if callable(value) else as_arrow(value, self._known[name], rows)
        return pa.table({name: made[name] if name in made else table[name] for name in names})

    def _row_count(self, path: Path) -> int:
        if self._check is not None:
            self._check(path)
        with _parquet(path) as file:
            return file.metadata.num_rows

    def _replace(self, path: Path, tables: Iterable[pa.Table], schema: pa.Schema) -> None:
        """Write rows into a file. The manifest lists the digest of the file before the file exists.

        Every page of the file has a checksum that readers can verify.
        """
        # a part is read once more and removed: packing it takes longer than all the rest
        packed = "zstd" if path == self.merged_path else "none"
        with replacing(path) as file:
            repeating: Any = [name for name in schema.names if name not in _DISTINCT]
            ordered: Any = [name for name in schema.names if name in _ORDERED]
            with pq.ParquetWriter(
                file, schema, use_dictionary=repeating, compression=packed, write_page_checksum=True,
                write_statistics=ordered,
            ) as writer:  # fmt: skip
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
        """Raise an error if a file lacks columns, or has columns of the wrong type."""
        found = {field.name: field.type for field in schema}
        other = [name for name, kind in self._known.items() if found.get(name, kind) != kind]
        missing = [name for name in wanted or () if name not in found and name not in self._usual]
        if other or missing:
            seen = f"column {other[0]!r} holds {found[other[0]]}" if other else f"no column {missing[0]!r}"
            raise FolderError(
                f"the file does not contain a valid table {self.name!r} ({seen})",
                remedy="Start the run again in a new folder",
                where=str(path),
            )


class _Writing:
    """A file that a background thread writes, mostly without holding Python's GIL."""

    def __init__(self, write: Callable[[Iterator[pa.Table]], None]):
        # with a limit: where the disk is slower than what makes the rows, that waits
        self._tables: Queue[pa.Table | None] = Queue(4)
        self._whole = True
        # its thread keeps no process alive, as one of concurrent.futures would
        self._pool = ThreadPool(1)
        self._done = self._pool.apply_async(write, [self._given()])

    def _given(self) -> Iterator[pa.Table]:
        while (table := self._tables.get()) is not None:
            yield table
        if not self._whole:
            raise RuntimeError("some rows of the result table were not written to its file")

    def put(self, table: pa.Table | None) -> None:
        """Add a table to the queue when there is room. Raise an error of the writing thread."""
        while not self._done.ready():
            with suppress(Full):
                self._tables.put(table, timeout=1.0)
                return
        self._done.get()

    def end(self, whole: bool = True) -> None:
        """Wait until all tables are written. If not `whole`, discard the file and ignore errors."""
        self._whole = whole
        with nullcontext() if whole else suppress(Exception):
            self.put(None)
            self._done.get()
        self._pool.terminate()


def together(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Concatenate tables with the same columns. A column with equal texts may be given as one text."""
    columns = {name: [part[name] for part in parts] for name in parts[0]}
    return {name: one[0] if isinstance(one[0], str) else np.concatenate(one) for name, one in columns.items()}


def _repeats(values: Any, value: Any) -> bool:
    """Return True if a column stores one repeated value that equals the given value."""
    if isinstance(values, np.ndarray) and values.strides == (0,):
        values = values[0]
    return value is not None and np.ndim(values) == 0 and bool(values == value)


def as_arrow(values: Any, kind: pa.DataType, rows: int = 0) -> pa.Array:
    """Create an arrow column without `pa.array`, which imports pandas (half a second).

    Args:
        values: one value per row; one value for all rows; or None for a column of unknown values.
        rows: number of rows; required unless there is one value per row.
    """
    if values is None:
        return pa.nulls(rows, kind)
    if isinstance(values, int):
        values = np.full(rows, values)
    if kind == _WORD:
        words, codes = np.unique(np.array(values, str), return_inverse=True)
        codes = as_arrow(np.resize(codes, rows), kind.index_type)
        return pa.DictionaryArray.from_arrays(codes, as_arrow(words, kind.value_type))
    values = np.asarray(values)
    if pa.types.is_string(kind):
        texts = [text.encode() for text in values.tolist()]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return pa.StringArray.from_buffers(len(texts), pa.py_buffer(offsets), pa.py_buffer(b"".join(texts)))
    held = np.packbits(values, bitorder="little") if values.dtype == bool else np.ascontiguousarray(values)
    given = pa.from_numpy_dtype(values.dtype)
    # a float that is no integer is refused by the cast
    return pa.Array.from_buffers(given, len(values), [None, pa.py_buffer(held)]).cast(kind)


def as_numpy(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """Return an arrow column without nulls as a numpy array, without importing pandas."""
    parts = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    if pa.types.is_string(column.type):
        return np.array([text for part in parts for text in part.to_pylist()], object)
    if column.type == _WORD:
        words = [as_numpy(part.dictionary)[as_numpy(part.indices)] for part in parts]
        return np.concatenate([np.zeros(0, object), *words])
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
    """Open a parquet file. The checksum of each page is verified when the page is read."""
    try:
        with opened(path) as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
            head, size = file.metadata, os.fstat(raw.fileno()).st_size
            held = 8 * head.num_rows * head.num_columns
            if held > _MOST_UNPACKED + _MOST_TIMES * size:
                said = f"{size:,} bytes claim to unpack to {held:,} bytes, more than any table of mdnum"
                raise FolderError(said, where=str(path), remedy=_RESTORE)
            yield file
    except (OSError, pa.ArrowException, MemoryError) as error:
        seen = " ".join(str(error).split())[:200]
        raise FolderError(
            f"the file is damaged: it cannot be read as a parquet file ({seen})",
            where=str(path),
            remedy=_RESTORE,
        ) from error


def _regroup(
    tables: Iterator[pa.Table], rows: int, whole: Callable[[pa.Table], pa.Table]
) -> Iterator[pa.Table]:
    held: list[pa.Table] = []
    count = 0
    for table in tables:
        if held and held[0].schema != table.schema:
            # one leaves out a column that another has
            held, table = [whole(one) for one in held], whole(table)
        held.append(table)
        count += table.num_rows
        while count >= rows:
            joined = pa.concat_tables(held)
            yield joined.slice(0, rows).combine_chunks()
            held = [joined.slice(rows)]
            count -= rows
    if count:
        yield pa.concat_tables(held).combine_chunks()
