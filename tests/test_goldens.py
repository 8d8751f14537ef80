"""Frozen behavior: every verb on tiny systems, against records of what it said (`tests/goldens`).

`pytest -n 0 tests/test_goldens.py --rewrite-goldens` writes the records again, with -k those of some goldens.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import call
from jsonschema import Draft202012Validator
from schemas import closed

import mdnum

SCHEMAS = Path(mdnum.__file__).parent / "schemas"
RECORDS = Path(__file__).parent / "goldens"
COMMANDS = tomllib.loads((RECORDS / "commands.toml").read_text(encoding="utf-8"))
EXACT = 1e-6
#: what is smaller is rounding error, and another processor's is another
ROUNDING = 1e-12
#: columns that say how long something took
TIMINGS = ("_ms", "seconds")


@dataclass(frozen=True)
class Golden:
    """One command of `commands.toml`, which says what its keys mean."""

    name: str
    call: str
    numbers: str = ""
    tables: str = ""
    needs: str = ""
    out: bool = True
    slow: bool = False
    nightly: bool = False
    loose: float = EXACT

    def chosen(self) -> list[tuple[str, str, str]]:
        """Label, path and tolerance of each number."""
        words = [word for one in self.numbers.split() for word in COMMANDS["numbers"].get(one, one).split()]
        parts = [word.partition("~") for word in words]
        return [(a.rpartition("=")[0] or a, a.rpartition("=")[2], tolerance) for a, _, tolerance in parts]

    @property
    def parameter(self) -> Any:
        """The test's parameter, in its call of pytest."""
        return pytest.param(
            self.name, marks=[pytest.mark.slow] * self.slow + [pytest.mark.nightly] * self.nightly
        )


BY_NAME = {name: Golden(name, **told) for name, told in COMMANDS["golden"].items()}


def walk(document: Any, path: str) -> Any:
    """What stands at a path of `goldens.commands`; None where nothing does."""
    if not path:
        return document
    key, _, rest = path.partition(".")
    if key.endswith("[]"):
        found = walk(document, key[:-2])
        return [walk(one, rest) for one in found] if isinstance(found, list) else found
    if key.endswith("{}"):
        found = walk(document, key[:-2])
        return {name: walk(one, rest) for name, one in found.items()} if isinstance(found, dict) else found
    if isinstance(document, list) and key.isdecimal():
        return walk(document[int(key)], rest)
    return walk(document[key], rest) if isinstance(document, dict) and key in document else None


def numbers(golden: Golden, document: Any) -> dict[str, Any]:
    """The chosen numbers by label; a limit is recorded as whether it is kept."""
    found = {}
    for label, path, tolerance in golden.chosen():
        value = walk(document, path)
        if tolerance.startswith("<") and isinstance(value, float) and abs(value) < float(tolerance[1:]):
            value = f"within {tolerance[1:]}"
        # a list of what no row has is as if it were not asked for
        if value is not None and value != [None] * len(value if isinstance(value, list) else "x"):
            found[label] = value
    return found


def table(path: Path) -> dict[str, Any]:
    """Rows, and each column: floats by their range and sum, everything else by a hash of all of it."""
    found = pq.read_table(path)
    columns = {}
    for name in found.column_names:
        if name.endswith(TIMINGS):
            continue
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
    loose = {label: float(word) for label, _, word in golden.chosen() if word and word[0] != "<"}
    told = []

    def compare(label: str, a: Any, b: Any, tolerance: float = EXACT, scale: float = 0.0) -> None:
        if not alike(a, b, tolerance, scale):
            told.append(f"{label}: recorded {json.dumps(a)}, seen {json.dumps(b)}")

    for part in ("exit", "findings"):
        compare(part, recorded.get(part), seen.get(part))
    for part in ("numbers", "tables"):
        compare(f"names of {part}", sorted(recorded[part]), sorted(seen[part]))
    for label in recorded["numbers"].keys() & seen["numbers"].keys():
        compare(label, recorded["numbers"][label], seen["numbers"][label], loose.get(label, golden.loose))
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


def written(value: Any, depth: int = 0) -> str:
    """JSON with a line for each label: name, part, label."""
    if depth == 3 or not isinstance(value, dict) or not value:
        return json.dumps(value, ensure_ascii=False)
    inner = ",\n".join(
        f"{' ' * (depth + 1)}{json.dumps(key)}: {written(one, depth + 1)}" for key, one in value.items()
    )
    return f"{{\n{inner}\n{' ' * depth}}}" + "\n" * (depth == 0)


def conforms(document: dict[str, Any]) -> None:
    """Its schema allows a document, names all of its keys, and allows none of them to have another name."""
    kind = document["kind"]
    schema = json.loads((SCHEMAS / f"{kind}.json").read_text(encoding="utf-8"))
    validator = Draft202012Validator(closed(schema))
    wrong = [
        f"{'.'.join(map(str, each.absolute_path))}: {each.message[:300]}"
        for each in (*validator.iter_errors(document), *Draft202012Validator(schema).iter_errors(document))
    ]
    assert not wrong, kind
    assert document["schema"] == f"mdnum/{kind}/1" and list(document)[:2] == ["schema", "kind"]
    for name in document if kind != "systems-show" else ():
        assert not validator.is_valid(
            {f"{key}_" * (key == name) or key: value for key, value in document.items()}
        ), name


class Seen:
    """Answers of this session by name; a golden runs when it or what needs it is asked for."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.answers: dict[str, dict[str, Any]] = {}
        for name, text in COMMANDS["files"].items():
            support = repr(str(RECORDS.parent / "support"))
            (folder / f"{name}.py").write_text(text.replace("{support!r}", support))

    def of(self, golden: Golden, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
        if golden.name in self.answers:
            return self.answers[golden.name]
        for name in golden.needs.split():
            self.of(BY_NAME[name], capsys)
        words = [*shlex.split(golden.call), "--json", *(("-o", golden.name) if golden.out else ())]
        capsys.readouterr()
        code = call(*words)
        # the path of the checkout is no behavior
        document = json.loads(capsys.readouterr().out.replace(f"{RECORDS.parents[1]}/", ""))
        conforms(document)
        if not isinstance(document, dict):
            document = {"rows": document}
        findings = [f"{one['severity']} {one['code']}" for one in document.get("findings") or ()]
        # whatever is good to know is no reason to fail
        complete = document.get("status", "complete") == "complete" and document.get("ok", True)
        worst = {text.partition(" ")[0] for text in findings} & {"warning", "error"}
        assert code == (1 if worst or not complete else 0), golden.name
        paths = [self.folder / golden.name / f"{name}.parquet" for name in golden.tables.split()]
        # whoever opens a table learns what a column holds, an extra one too
        bare = [
            (p.stem, f.name)
            for p in paths
            for f in pq.read_schema(p)
            if not (f.metadata or {}).get(b"description")
        ]
        assert not bare, golden.name
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
@pytest.mark.parametrize("name", [one.parameter for one in BY_NAME.values()])
def test_golden(name: str, seen: Seen, request, capsys, monkeypatch):
    monkeypatch.chdir(seen.folder)
    golden = BY_NAME[name]
    answer = json.loads(json.dumps(seen.of(golden, capsys)))
    path = RECORDS / f"{name.partition('-')[0]}.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if request.config.getoption("--rewrite-goldens"):
        records[name] = answer
        # records of goldens that are no more go
        kept = {one: records[one] for one in sorted(records) if one in BY_NAME}
        path.write_text(written(kept), encoding="utf-8")
        return
    assert name in records, f"no record of {name}: write it with --rewrite-goldens"
    told = differences(golden, records[name], answer)
    assert not told, f"mdnum {golden.call}\n  " + "\n  ".join(told)
