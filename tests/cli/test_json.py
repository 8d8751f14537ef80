"""What `--json` prints: a document that says what it is, as one of the schemas that come with mdnum."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import call
from jsonschema import Draft202012Validator
from schemas import closed, records, renamed

import mdnum
from mdnum.plain import HEAD, headed, plain
from mdnum.report.finding import Finding
from mdnum.store import RunFolder, files
from mdnum.units import Measured
from mdnum.verbs import frame
from mdnum.verbs.frame import VERBS

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = {
    path.stem: json.loads(path.read_text()) for path in (Path(mdnum.__file__).parent / "schemas").iterdir()
}


def valid(document) -> bool:
    return Draft202012Validator(SCHEMAS[document["kind"]]).is_valid(document)


def test_schemas_are_those_that_the_script_makes():
    script = ROOT / "scripts/makers/make_schemas.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(SCHEMAS) > 25
    for kind, schema in SCHEMAS.items():
        Draft202012Validator.check_schema(schema)
        assert schema["$id"] == f"mdnum/{kind}/1" and schema["title"]


def test_every_kind_of_folder_has_a_schema_with_the_same_head():
    kinds = {kind for home in VERBS for kind in getattr(VERBS[home], "KINDS", ())}
    assert len(kinds) > 12 and kinds <= set(SCHEMAS)
    for kind in kinds:
        properties = SCHEMAS[kind]["properties"]
        assert {"schema", "kind", *HEAD} <= set(SCHEMAS[kind]["required"])
        assert [properties[name] for name in HEAD] == [SCHEMAS["md"]["properties"][name] for name in HEAD]


def test_the_documents_are_listed():
    text = (ROOT / "docs/json.md").read_text()
    listed = re.findall(r"^\| `mdnum/([a-z-]+)/1` \|", text, re.MULTILINE)
    assert sorted(listed) == sorted(SCHEMAS)


#: objects whose keys are names of parameters, runs and checks, or a case's own numbers
OPEN = """
audit:parts[].numbers audit:parts[].tables<>[] ball:gradient[].details ball:variants[].changes
conform:known demos:data demos:demos[].data demos:demos[].numbers demos:numbers fork:reasons[]
grad:comparisons[].values grad:edges grad:function grad:methods[].details grad:trust.by<>.limits[].values
grad:trust.limits[].values systems-show:
"""


def test_nested_objects_name_their_keys():
    found = [
        f"{kind}:{path}"
        for kind, schema in SCHEMAS.items()
        for path, each in records(schema)
        if "properties" not in each or "additionalProperties" in each
        if not each.get("additionalProperties")
    ]
    assert sorted(found) == sorted(OPEN.split())


def test_a_nested_key_of_another_name_is_wrong_and_one_that_was_added_is_not(tmp_path):
    system = ROOT / "systems/argon/crystal-108.toml"
    run = mdnum.run(system, steps=4, out=tmp_path / "run", report=False)
    screened = mdnum.fork_screen("ball/drop", steps=5, out=tmp_path / "screen", report=False)
    for outcome, paths in (
        (run, ("energy_drift", "cutoff.radius", "ase.force_max", "time_step.drift", "findings.0.code")),
        (screened, ("ranking.0.fork", "not_applicable.0.reason")),
    ):
        document = plain(outcome.summary)
        assert valid(document) and Draft202012Validator(closed(SCHEMAS[outcome.kind])).is_valid(document)
        for path in paths:
            assert not valid(renamed(document, path)), path
    document = plain(run.summary)
    assert valid({**document, "more": 1, "cutoff": {**document["cutoff"], "more": 1}})


def test_an_error_is_a_document(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", "nowhere.toml", "--json") == 2
    document = json.loads(capsys.readouterr().out)
    assert list(document) == ["schema", "kind", "error"] and valid(document)
    assert document["error"]["exit_code"] == 2
    document["error"]["reason"] = document["error"].pop("message")
    assert not valid(document)


def test_a_run_that_was_killed_has_a_document_with_a_status(tmp_path):
    system = ROOT / "systems/argon/crystal-108.toml"
    outcome = mdnum.run(system, steps=4, out=tmp_path / "run", check=False, report=False)
    whole = plain(outcome.summary)
    assert valid(whole) and whole["status"] == "complete" and whole["seconds"] > 0
    # as a kill leaves it: no summary yet
    (tmp_path / "run/summary.json").unlink()
    folder = RunFolder.open(tmp_path / "run")
    files.update(folder.path, {}, ["summary.json"], finished=False)
    document = plain(frame.finish(tmp_path / "run", report=False).summary)
    assert document["status"] == "unfinished" and valid(document)
    # what has its numbers has all of them
    assert not valid({**document, "status": "complete"})


@pytest.mark.parametrize(
    ("values", "fine"),
    [
        ({}, True),
        ({"size": Measured(1.0, "eV/Å", 1e-6, None), "steps": 3, "name": "x", "row": {"a": 1}}, True),
        ({"size": {"value": 1.0, "unit": "eV", "floor": 0.1}}, False),
        ({"size": {"value": 1.0, "unit": "eV", "floor": 0.1, "scale": None, "digits": 3}}, True),
        ({"size": {"value": "1", "unit": "eV", "floor": 0.1, "scale": None}}, False),
    ],
)
def test_numbers_of_a_finding_with_a_unit_have_a_floor(values, fine):
    finding = plain(Finding("A", "error", "a", "b", values=values))
    answer = {"status": "complete", "seconds": 1.0, "headline": "h", "verdict": "v", "findings": [finding]}
    document = headed("systems-check", {**answer, "system": "a", "ok": True, "path": None})
    assert valid(document) == fine
    assert not valid({**document, "findings": [{**finding, "severity": "grave"}]})
    assert valid({**document, "findings": [{**finding, "hint": ""}]}) == fine
    assert not valid({**document, "findings": [{key: one for key, one in finding.items() if key != "title"}]})


def test_what_is_judged_again_says_this_version(tmp_path):
    system = ROOT / "systems/argon/crystal-108.toml"
    folder = mdnum.run(system, steps=4, out=tmp_path / "run", check=False, report=False).folder
    kept = json.loads((folder / "summary.json").read_text())
    RunFolder.open(folder).write_summary({**kept, "schema": "mdnum/md/0", "kind": "other"})
    files.update(folder, {"summary.json": [files.digest(folder / "summary.json")]})
    assert frame.finish(folder, report=False).summary["schema"] == "mdnum/md/1"
    assert valid(json.loads((folder / "summary.json").read_text()))
