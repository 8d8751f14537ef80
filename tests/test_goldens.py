"""Frozen behavior: every verb on tiny systems, against records of what it said (`tests/goldens`).

`pytest -n 0 tests/test_goldens.py --rewrite-goldens` writes the records again, with -k those of some goldens.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from command_line import call
from goldens.commands import FILES, GOLDENS, Golden

RECORDS = Path(__file__).parent / "goldens"
BY_NAME = {golden.name: golden for golden in GOLDENS}
EXACT = 1e-6
#: what is smaller is rounding error, and another processor's is another
ROUNDING = 1e-12


def walk(document: Any, path: str) -> Any:
    """What stands at a path of `goldens.commands`; "absent" where nothing does."""
    if not path:
        return document
    key, _, rest = path.partition(".")
    if key.endswith("[]"):
        found = walk(document, key[:-2])
        return [walk(one, rest) for one in found] if isinstance(found, list) else "absent"
    if key.endswith("{}"):
        found = walk(document, key[:-2])
        return {name: walk(one, rest) for name, one in found.items()} if isinstance(found, dict) else "absent"
    if not isinstance(document, dict) or key not in document:
        return "absent"
    return walk(document[key], rest)


def numbers(golden: Golden, document: Any) -> dict[str, Any]:
    """The chosen numbers by label; a limit is recorded as whether it is kept."""
    found = {}
    for word in golden.numbers:
        word, _, tolerance = word.partition("~")
        label, _, path = word.rpartition("=")
        value = walk(document, path)
        if tolerance.startswith("<"):
            value = f"within {tolerance[1:]}" if value is not None and abs(value) < float(tolerance[1:]) else value
        found[label or path] = value
    return found


def tolerances(golden: Golden) -> dict[str, float]:
    """Relative tolerance by label, where it is another than the usual one."""
    words = [word.partition("~") for word in golden.numbers]
    return {(a.rpartition("=")[0] or a): float(b) for a, _, b in words if b and not b.startswith("<")}


def table(path: Path) -> dict[str, Any]:
    """Rows, and each column: floats by their range and sum, everything else by a hash of all of it."""
    found = pq.read_table(path)
    columns = {}
    for name in found.column_names:
        column = found[name].combine_chunks()
        if pa.types.is_floating(column.type):
            x = np.asarray(column.drop_null().to_numpy(zero_copy_only=False), np.float64)
            x = x[np.isfinite(x)]
            columns[name] = [float(x.min()), float(x.max()), math.fsum(x)] if len(x) else []
        else:
            text = json.dumps(column.to_pylist(), default=str)
            columns[name] = hashlib.sha256(text.encode()).hexdigest()[:12]
    return {"rows": found.num_rows, "columns": columns}


def alike(recorded: Any, seen: Any, tolerance: float, scale: float = 0.0) -> bool:
    """Equal, floats within a tolerance of the larger of themselves and the scale."""
    if isinstance(recorded, dict) and isinstance(seen, dict):
        return recorded.keys() == seen.keys() and all(
            alike(recorded[key], seen[key], tolerance, scale) for key in recorded
        )
    if isinstance(recorded, list) and isinstance(seen, list):
        finite = [abs(x) for x in recorded if isinstance(x, float)]
        scale = max([scale, *finite])
        return len(recorded) == len(seen) and all(
            alike(a, b, tolerance, scale) for a, b in zip(recorded, seen, strict=True)
        )
    numeric = (int, float)
    if isinstance(recorded, float) and isinstance(seen, numeric) and not isinstance(seen, bool):
        return abs(recorded - seen) <= tolerance * max(abs(recorded), scale) + ROUNDING
    return type(recorded) is type(seen) and recorded == seen


def differences(golden: Golden, recorded: dict[str, Any], seen: dict[str, Any]) -> list[str]:
    """One line for each label that is not as recorded."""
    loose, told = tolerances(golden), []

    def compare(label: str, a: Any, b: Any, tolerance: float = EXACT, scale: float = 0.0) -> None:
        if not alike(a, b, tolerance, scale):
            told.append(f"{label}: recorded {json.dumps(a)}, seen {json.dumps(b)}")

    for part in ("exit", "findings", "verdicts"):
        compare(part, recorded.get(part), seen.get(part))
    for part in ("numbers", "tables"):
        compare(f"names of {part}", sorted(recorded[part]), sorted(seen[part]))
    for label in recorded["numbers"].keys() & seen["numbers"].keys():
        compare(label, recorded["numbers"][label], seen["numbers"][label], loose.get(label, EXACT))
    for name in recorded["tables"].keys() & seen["tables"].keys():
        a, b = recorded["tables"][name], seen["tables"][name]
        compare(f"{name}: rows", a["rows"], b["rows"])
        compare(f"{name}: columns", list(a["columns"]), list(b["columns"]))
        for column in a["columns"].keys() & b["columns"].keys():
            x, y = a["columns"][column], b["columns"][column]
            if isinstance(x, list) and isinstance(y, list) and len(x) == len(y) == 3:
                largest = max(abs(x[0]), abs(x[1]))
                compare(f"{name}.{column}: least and largest", x[:2], y[:2], golden.loose)
                compare(f"{name}.{column}: sum", x[2], y[2], golden.loose, largest * math.sqrt(a["rows"]))
            else:
                compare(f"{name}.{column}", x, y)
    return told


class Seen:
    """Answers of this session by name; a golden runs when it or what needs it is asked for."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.answers: dict[str, dict[str, Any]] = {}
        for name, text in FILES.items():
            (folder / name).write_text(text)

    def of(self, golden: Golden, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
        if golden.name in self.answers:
            return self.answers[golden.name]
        for name in golden.needs.split():
            self.of(BY_NAME[name], capsys)
        words = [*golden.words, "--json", *(("-o", golden.name) if golden.out else ())]
        capsys.readouterr()
        code = call(*words)
        document = json.loads(capsys.readouterr().out)
        if not isinstance(document, dict):
            document = {"rows": document}
        findings = [f"{one['severity']} {one['code']}" for one in document.get("findings") or ()]
        paths = [self.folder / golden.name / f"{name}.parquet" for name in golden.tables.split()]
        self.answers[golden.name] = {
            "exit": code,
            "findings": sorted(findings),
            "numbers": numbers(golden, document),
            "tables": {path.stem: table(path) for path in paths},
        }
        return self.answers[golden.name]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return Seen(tmp_path_factory.mktemp("goldens"))


# as a user calls it: dtypes are not strict
@pytest.mark.jax_md
@pytest.mark.parametrize(
    "name", [pytest.param(one.name, marks=[pytest.mark.slow] * one.slow) for one in GOLDENS]
)
def test_golden(name: str, seen: Seen, request, capsys, monkeypatch):
    monkeypatch.chdir(seen.folder)
    golden = BY_NAME[name]
    answer = json.loads(json.dumps(seen.of(golden, capsys)))
    path = RECORDS / f"{golden.verb}.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if request.config.getoption("--rewrite-goldens"):
        records[name] = answer
        # records of goldens that are no more go
        kept = {one: records[one] for one in sorted(records) if one in BY_NAME}
        path.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return
    assert name in records, f"no record of {name}: write it with --rewrite-goldens"
    told = differences(golden, records[name], answer)
    assert not told, f"mdnum {golden.arguments}\n  " + "\n  ".join(told)
