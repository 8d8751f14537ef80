"""A folder of somebody else: nothing is written out of it, and no damage of it goes unsaid."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import re
import runpy
import shutil
import sys
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import planted_lists
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from ase.build import bulk
from pydantic_core import to_json
from test_store import COLUMNS, MD, frame, no_waiting, series_rows, state_at, write_run  # noqa: F401

import mdnum
from mdnum.cli import main
from mdnum.errors import FolderError, InputError
from mdnum.references.conformance.questions import plan
from mdnum.store import RunFolder, checkpoint, tables
from mdnum.store import files as atomic
from mdnum.store import files as manifest
from mdnum.verbs.frame import layout


def called(*words: str) -> tuple[int | None, str, str]:
    """(exit code, stdout, stderr) of a command; None where it ended in a traceback, which stderr then is."""
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            main(list(words))
        except SystemExit as done:
            return int(done.code or 0), out.getvalue(), errors.getvalue()
        except Exception:
            return None, out.getvalue(), traceback.format_exc()


PRECIOUS = b"somebody's only copy"


@pytest.fixture
def killed(tmp_path) -> Path:
    folder = RunFolder.create(tmp_path / "killed", MD)
    atomic.write_text(folder.path / "system.toml", "units = 'lj'\n")
    folder.write_provenance({"versions": {}})
    write_run(folder, 0, 40)
    folder.close()
    return folder.path


@pytest.fixture
def finished(killed) -> Path:
    folder = RunFolder.open(killed)
    folder.resume()
    folder.finalize()
    folder.write_summary({"status": "complete", "atoms": 4})
    folder.close()
    return killed


def led_out(path: Path, link=os.symlink) -> Path:
    """A file elsewhere that path now leads to."""
    target = path.parent / f"../precious-{path.name}"
    target = Path(os.path.normpath(target))
    target.write_bytes(path.read_bytes() if path.exists() else PRECIOUS)
    path.unlink(missing_ok=True)
    link(target, path)
    return target


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("name", [".lock", "log.txt", "trajectory.traj"])
def test_what_is_written_in_place_is_not_written_through_a_link(killed, name, link):
    target = led_out(killed / name, link)
    before = target.read_bytes()
    with pytest.raises(FolderError, match=rf"{name}: .*(link|second name)"):
        RunFolder.open(killed).resume()
    assert target.read_bytes() == before
    # and nothing of the run was dropped for it
    assert len(list((killed / "parts").iterdir())) == 12


@pytest.mark.parametrize("name", ["series.parquet", "checkpoint.npz", "system.toml", "report.html"])
def test_what_is_replaced_is_replaced_and_not_what_it_leads_to(finished, name):
    target = led_out(finished / name)
    before = target.read_bytes()
    if name != "report.html":
        with pytest.raises(FolderError, match="is a link"):
            RunFolder.open(finished).resume()
    (finished / "manifest.json").unlink()
    atomic.write_text(finished / name, "new")
    assert target.read_bytes() == before
    assert not (finished / name).is_symlink() and (finished / name).read_text() == "new"


@pytest.mark.parametrize("name", ["parts", "figures", "structures"])
def test_a_folder_in_the_folder_that_leads_out_is_refused(tmp_path, killed, name):
    outside = tmp_path / "outside"
    outside.mkdir()
    for precious in ("energy.svg", "series-000000000000.parquet", "a.extxyz"):
        (outside / precious).write_bytes(PRECIOUS)
    if (killed / name).exists():
        (killed / name).rename(tmp_path / "moved")
    (killed / name).symlink_to(outside)
    with pytest.raises(FolderError, match=r"is a link|already holds a run"):
        RunFolder.create(killed, MD)
    with pytest.raises(FolderError, match="is a link"):
        atomic.write_text(killed / name / "energy.svg", "new")
    with pytest.raises(FolderError, match="is a link"):
        atomic.subfolder(killed, name)
    assert {path.read_bytes() for path in outside.iterdir()} == {PRECIOUS} and len(
        list(outside.iterdir())
    ) == 3


def test_temporary_names_cannot_be_foreseen(tmp_path, monkeypatch):
    (tmp_path / "precious").write_bytes(PRECIOUS)
    for name in (".report.html.part", ".summary.json.part"):
        (tmp_path / name).symlink_to(tmp_path / "precious")
    names = []
    replace = os.replace
    monkeypatch.setattr(
        atomic.os, "replace", lambda one, other: (names.append(one.name), replace(one, other))
    )
    atomic.write_text(tmp_path / "report.html", "page")
    atomic.write_text(tmp_path / "summary.json", "{}")
    assert (tmp_path / "precious").read_bytes() == PRECIOUS
    assert len(set(names)) == 2 and not {".report.html.part", ".summary.json.part"} & set(names)


@pytest.mark.parametrize("name", ["../precious", "nothing", "series/../../precious"])
def test_a_checkpoint_names_tables_and_no_files(tmp_path, killed, name):
    (tmp_path / "precious.parquet").write_bytes(PRECIOUS)
    state, store = checkpoint.read(killed / "checkpoint.npz")
    # a checkpoint is listed as it is written
    checkpoint.write(killed / "checkpoint.npz", state, {**store, "rows": {**store["rows"], name: 0}}, {})
    with pytest.raises(FolderError, match=r"checkpoint\.npz: .*refers to a table"):
        RunFolder.open(killed).resume()
    assert (tmp_path / "precious.parquet").read_bytes() == PRECIOUS


def test_a_checkpoint_unpacks_to_no_more_than_itself(tmp_path):
    path = tmp_path / "checkpoint.npz"
    np.savez_compressed(path, large=np.zeros(1 << 22))
    assert path.stat().st_size < 1 << 16
    with pytest.raises(FolderError, match="is compressed"):
        checkpoint.read(path)
    np.savez(path, small=np.zeros(7))
    data = path.read_bytes()
    for claim in (b"(99999999999999999,), ", b"(7, 9999999999999999),"):
        path.write_bytes(data.replace(b"(7,), }" + b" " * (len(claim) - 6), claim + b"}"))
        with pytest.raises(FolderError, match="checkpoint cannot be"):
            checkpoint.read(path)


@pytest.mark.parametrize("name", ["series.parquet", "flips.parquet", "summary.json", "checkpoint.npz"])
def test_a_flipped_bit_is_told_with_what_is_left(finished, name):
    data = bytearray((finished / name).read_bytes())
    data[len(data) // 2] ^= 4
    (finished / name).write_bytes(data)
    folder = RunFolder.open(finished)
    assert list(folder.damaged()) == [name]
    with pytest.raises(FolderError, match=rf"{name}: the .*is damaged.*; .*epochs\.parquet.* read"):
        folder.resume() if name == "checkpoint.npz" else folder.summary and folder.read(Path(name).stem)
    assert len(folder.read("epochs")["epoch"]) == 4


def test_a_flipped_bit_of_a_page_is_told_where_there_is_no_manifest(tmp_path):
    folder = RunFolder.create(tmp_path / "run", layout("ball"))
    rng = np.random.default_rng(0)
    values = rng.normal(size=50_000)
    folder.append("separations", {"variant": ["a"] * 50_000, "step": np.arange(50_000), "separation": values})
    folder.finalize()
    (folder.path / "manifest.json").unlink()
    path = folder.path / "separations.parquet"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(FolderError, match=r"separations\.parquet: the file is damaged"):
        RunFolder.open(folder.path).read("separations")


def test_what_is_gone_or_foreign_is_told(finished):
    (finished / "epochs.parquet").unlink()
    with pytest.raises(FolderError, match=r"epochs\.parquet: is missing"):
        RunFolder.open(finished).read("epochs")
    pq.write_table(pa.table({"step": ["a", "b"]}), finished / "series.parquet")
    manifest.update(finished, {"series.parquet": [manifest.digest(finished / "series.parquet")]})
    with pytest.raises(FolderError, match=r"series\.parquet: .* 'series' \(column 'step' .*string\)"):
        RunFolder.open(finished).read("series")
    (finished / "manifest.json").unlink()
    # nobody says what it was to hold
    assert RunFolder.open(finished).read("series")["step"].tolist() == ["a", "b"]
    with pytest.raises(FolderError, match="no table 'epochs'"):
        RunFolder.open(finished).read("epochs")
    for text in ("[]", "3", "[" * 50_000, "\x00"):
        (finished / "summary.json").write_text(text)
        with pytest.raises(FolderError, match=r"summary\.json: the file is damaged"):
            _ = RunFolder.open(finished).summary


def test_the_manifest_is_told_when_it_is_damaged_and_lists_nothing_elsewhere(finished):
    path = finished / "manifest.json"
    text = path.read_text()
    path.write_text(text.replace('"finished": true', '"finished": false'))
    with pytest.raises(FolderError, match=r"manifest\.json: the .* is damaged"):
        RunFolder.open(finished)
    made = manifest.Manifest(MD, True, {"../precious": ["0"]})
    manifest.save(finished, made)
    with pytest.raises(FolderError, match=r"manifest\.json: the .* is damaged"):
        RunFolder.open(finished)
    path.unlink()
    assert "manifest.json" in RunFolder.open(finished).noted()[0]


@pytest.mark.parametrize(
    "odd",
    [
        {"tables": {"../precious": "step"}}, {"tables": {"a" * 50: "step"}},
        {"tables": {"series": "step:object"}},
        {"tables": {"series": "st/ep"}}, {"tables": ["series"]}, {"tables": {"series": ["step"]}},
        {"tables": {f"t{'a' * n}": "x" for n in range(39)} | {f"u{'a' * n}": "x" for n in range(39)}
         | {f"v{'a' * n}": "x" for n in range(39)}},
        {"tables": {"series": " ".join(f"c{n}" for n in range(2_000))}},
        {"usual": {"flips": {"rule": "many"}}}, {"usual": {"flips": {"rule": 10**20}}},
        {"usual": {"flips": {"nothing": 0}}}, {"usual": {"nothing": {"rule": 0}}}, {"usual": 5},
        {"usual": {"flips": {"rule": True}}}, {"usual": {"flips": {"rule": [0]}}},
        {"kind": "\x1b[31mmd"}, {"kind": "../md"}, {"kind": 5}, {"command": "run\n; rm"}, {"command": ""},
        {"resumes_from": "../precious"}, {"resumes_from": 0}, {"tables": None},
    ],
    ids=lambda odd: str(odd)[:40],
)  # fmt: skip
def test_an_odd_layout_with_a_right_digest_is_one_line(finished, odd):
    path = finished / "manifest.json"
    held = json.loads(path.read_text()) | odd
    held.pop("digest")
    text = json.dumps(held, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps({**held, "digest": manifest.digest_of(text.encode())}))
    with pytest.raises(FolderError, match=r"manifest\.json: the .* is damaged"):
        RunFolder.open(finished)
    code, _, err = called("report", str(finished))
    assert code == 2 and err.count("\n") == 1 and "manifest.json" in err


def test_what_is_sound_in_that_form_is_read(finished):
    """The same as above without the odd part: it is the layout that was refused, and not the form."""
    path = finished / "manifest.json"
    held = json.loads(path.read_text())
    held.pop("digest")
    text = json.dumps(held, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps({**held, "digest": manifest.digest_of(text.encode())}))
    assert RunFolder.open(finished).layout.columns("flips") == MD.columns("flips")


def test_a_log_that_somebody_wrote_into_is_said_and_no_reason_to_refuse(finished):
    with open(finished / "log.txt", "a") as log:
        log.write("my note\n")
    folder = RunFolder.open(finished)
    assert [note.startswith(f"{finished / 'log.txt'}: ") for note in folder.noted()] == [True]
    assert folder.resume()["step"] == 40
    folder.append_frame(frame(40))
    folder.finalize()
    assert RunFolder.open(finished).damaged() == {}


def test_an_edited_system_is_said_by_who_reads_and_refused_by_who_goes_on(finished):
    with open(finished / "system.toml", "a") as file:
        file.write("# mine\n")
    folder = RunFolder.open(finished)
    assert folder.system == {"units": "lj"}
    assert list(folder.damaged()) == ["system.toml"]
    with pytest.raises(FolderError, match=r"system\.toml: was changed since"):
        folder.check_start()
    with pytest.raises(FolderError, match=r"system\.toml: was changed since"):
        folder.resume()


@pytest.mark.parametrize("killed_at", range(1, 9))
def test_a_kill_while_a_file_is_replaced_leaves_no_damage(finished, monkeypatch, killed_at):
    class Killed(BaseException):
        pass

    calls = iter(range(1, 100))
    fsync = os.fsync

    def dies(*args):
        if next(calls) == killed_at:
            raise Killed
        return fsync(*args)

    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "fsync", dies)
        with pytest.raises(Killed):
            for atoms in range(4):
                RunFolder.open(finished).write_summary({"status": "complete", "atoms": atoms})
    folder = RunFolder.open(finished)
    assert folder.damaged() == {} and folder.summary["status"] == "complete"


def test_what_came_to_nothing_is_begun_again_and_what_did_not_is_kept(tmp_path, killed):
    started = RunFolder.create(tmp_path / "started", MD)
    atomic.write_text(started.path / "system.toml", "units = 'lj'\n")
    (started.path / "cu.eam.alloy").write_text("a table that belongs to the system")
    started.write_provenance({})
    started.log("compile")
    started.close()
    with pytest.raises(FolderError, match=r"Nothing .*`mdnum run` command again"):
        RunFolder.open(started.path).resume()
    (started.path / "mine.md").write_text("mine")
    with pytest.raises(FolderError, match="already holds a run"):
        RunFolder.create(started.path, MD)
    (started.path / "mine.md").unlink()
    again = RunFolder.create(started.path, MD)
    assert {path.name for path in again.path.iterdir()} == {".lock", "manifest.json"}
    again.close()
    with pytest.raises(FolderError, match="Continue it with `mdnum run --resume"):
        RunFolder.create(killed, MD)
    # what was never mdnum's is not taken for it
    (tmp_path / "own").mkdir()
    (tmp_path / "own/system.toml").write_text("units = 'lj'\n")
    with pytest.raises(FolderError, match="already holds"):
        RunFolder.create(tmp_path / "own", MD)


@pytest.mark.parametrize(
    ("kind", "steps", "advice"),
    [
        ("md", 0, "give the command again"),
        ("grad", 0, "give the command again"),
        ("md", 20, "continue with --res"),
    ],
)
def test_a_full_disk_gives_advice_that_can_be_followed(tmp_path, monkeypatch, kind, steps, advice):
    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = RunFolder.create(tmp_path / "run", layout(kind))
    if steps:
        write_run(folder, 0, steps)
        folder.append("series", series_rows(steps, steps + 10))
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "fsync", full)
        with pytest.raises(FolderError, match=f"disk is full.*, then {advice}"):
            folder.checkpoint(state_at(30), force=True)
    assert not list(folder.path.rglob("*.part"))
    folder.close()
    # and leaves the last checkpoint
    assert not steps or RunFolder.open(folder.path).resume()["step"] == steps


def test_answers_are_listed_as_soon_as_they_are_written(tmp_path):
    folder = RunFolder.create(tmp_path / "run", layout("audit"))
    atomic.subfolder(folder.path, "structures")
    for name in ("answers.json", "summary.json", "structures/failed-1.extxyz", "reproduce-1-missing.py"):
        for text in ("{}", '{"a": 1}', '{"a": 1, "b": 2}'):
            atomic.write_text(folder.path / name, text)
            folder.check(name)
        (folder.path / name).write_text('{"a": 1, "b": 3}')
        with pytest.raises(FolderError, match=rf"{name}: the .*is damaged"):
            folder.check(name)


def _put(told, where: str, value) -> None:
    *way, last = where.split("/")
    for key in way:
        told = told[int(key) if isinstance(told, list) else key]
    told[last] = value


_OPTIONS = {
    "cases": 3, "seed": 0, "large": False, "full": None, "precision": None, "superset": None, "limits": [],
}  # fmt: skip
_CASE = {
    "case": "x", "failures": [{"code": "MISSING", "text": "a", "step": 0}], "refused": None,
    "ties": [0, 0], "aliased": False, "single": None, "seconds": 0.1,
}  # fmt: skip
_STILL = {"positions": [[0.0, 0, 0]], "cell": np.eye(3).tolist(), "fresh": False, "skin": None}
_SMALL = {"name": "x", "area": "few", "pbc": [True] * 3, "r_cut": 1.0, "skin": 0.0, "stills": [_STILL]}
_ANSWERS = {
    "word": "ase", "tested": ["ase", None], "options": _OPTIONS, "seconds": 1.0, "cases": {"0": _CASE},
    "shrunk": {"k": {"case": _SMALL, "failures": _CASE["failures"], "alone": True}},
}  # fmt: skip


def test_more_questions_than_anybody_waits_for_are_refused(tmp_path):
    from mdnum.verbs.conform import conform

    with pytest.raises(InputError, match="1,000,000,000 random test cases"):
        conform("ase", cases=10**9, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def _audit_state() -> dict:
    from mdnum.audit.base import Chart, CheckResult, finding
    from mdnum.audit.record import AuditState, encoded
    from mdnum.audit.thresholds import PairThreshold

    result = CheckResult(
        (["failed"], {}), [finding("CURL", "error")], {}, [Chart("", "", "", [0.0], {"a": [1.0]})], {},
        skipped=[("a", "b")], name="forces",
    )  # fmt: skip
    end = PairThreshold(1.0, ("A", "A"), 0, (0.0,) * 3, 1.0, 1.0, False, 0.0)
    checks = ["forces", "curl"]
    structure = encoded(bulk("Cu"))
    state = AuditState(
        "nosuch:X", True, structure, 1.0, "metal", checks, None, None, None, [result], thresholds=[end]
    )
    return json.loads(to_json(state))


_WRONG_ANSWERS = [
    ("tested", None), ("word", 5), ("options/cases", "x"), ("options/cases", 10**9),
    ("options/limits", 5), ("options/full", "maybe"), ("options", {}), ("seconds", "x"),
    ("cases/0", [1]), ("cases/0", "x"),
    ("cases/0/failures", [[1, 2]]), ("cases/0/failures", "abc"), ("cases/0/ties", [1]), ("cases", []),
    ("shrunk/k", {}), ("shrunk/k/case/stills", [{}]), ("shrunk/k/case/pbc", [1]),
    ("shrunk/k/failures/0/step", 7), ("shrunk/k/failures", []),
    ("shrunk/k/case/stills/0/positions", [[1e999, 0, 0]]),
    ("shrunk/k/case/stills/0/cell", [[1.0, 0, 0]]), ("", "[" * 100_000),
]  # fmt: skip
_WRONG_AUDITS = [
    ("structure", "x"), ("structure", '{"__ase_objtype__": "nosuch"}'), ("name", 5), ("units", "x"),
    ("checks", 5), ("checks", []), ("temperature", "x"), ("results", [{}]), ("results", None),
    ("results/0/says", 5), ("results/0/tables", [5]), ("results/0/skipped", [1]),
    ("results/0/findings", [{"code": 1}]), ("results/0/charts", [{"x": "q"}]),
    ("results/0/charts/0/x", [1.0, 2.0]), ("cut", 5), ("failed", 5), ("failed", ["../x"]),
    ("thresholds", [{}]), ("thresholds/0/species", 5), ("seconds", "x"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "where", "value"),
    [("conform", *one) for one in _WRONG_ANSWERS] + [("audit", *one) for one in _WRONG_AUDITS],
)
def test_answers_of_another_shape_are_told_in_a_line(tmp_path, kind, where, value):
    from mdnum.audit.record import kept
    from mdnum.store.answers import restored
    from mdnum.verbs.conform import Examination, conform

    folder = RunFolder.create(tmp_path / "run", layout(kind))
    told = _audit_state() if kind == "audit" else json.loads(json.dumps(_ANSWERS))
    if where:
        _put(told, where, value)
    atomic.write_text(folder.path / "answers.json", json.dumps(told) if where else value)
    folder.close()
    with pytest.raises(FolderError, match=r"answers\.json: ") as seen:
        kept(folder) if kind == "audit" else conform(resume=folder.path, report=False)
    assert "\n" not in str(seen.value) and "its bytes" not in str(seen.value)
    # as they were, they can be gone on with
    if kind == "audit":
        atomic.write_text(folder.path / "answers.json", json.dumps(_audit_state()))
        assert kept(RunFolder.open(folder.path)).left == ["curl"]
    else:
        atomic.write_text(folder.path / "answers.json", json.dumps(_ANSWERS))
        assert restored(RunFolder.open(folder.path), Examination).word == "ase"


def test_tables_that_are_written_anew_leave_no_rows_of_an_end_that_was_killed(tmp_path):
    from mdnum.verbs.conform import conform

    folder = RunFolder.create(tmp_path / "run", layout("conform"))
    atomic.write_text(folder.path / "answers.json", "{}")
    rows = {"area": ["few"], "asked": [1], "passed": [1], "failed": [0], "refused": [0], "skipped": [0]}
    folder.append("areas", rows)
    folder._stream("areas").flush()
    folder.close()
    (folder.path / "reproduce-1-mine.py").write_text("mine")
    again = RunFolder.open(folder.path)
    again.take(layout("conform"))
    with pytest.raises(FolderError, match="another process"):
        # before anything of its answers is read
        conform(resume=folder.path)
    again.restart()
    again.append("areas", rows)
    again.finalize()
    assert len(RunFolder.open(folder.path).read("areas")["area"]) == 1
    assert RunFolder.open(folder.path).damaged() == {}
    # what is there to go on from is never taken for nothing
    with pytest.raises(FolderError, match="already holds a run"):
        RunFolder.create(folder.path, MD)


def test_scripts_of_a_person_stay(tmp_path, monkeypatch):
    """A script of mdnum that stands for no failure is removed by the examination that goes on."""
    first = lambda *given, **named: plan(*given, **named)[:1]  # noqa: E731
    monkeypatch.setattr("mdnum.references.conformance.suite.plan", first)
    home = str(Path(planted_lists.__file__).parent)
    lines = f"import sys\nsys.path.append({home!r})\nfrom planted_lists import planted\npairs = planted('')\n"
    (tmp_path / "right.py").write_text(lines)
    options: dict[str, Any] = {"cases": 0, "large": False, "report": False}
    folder = mdnum.conform(f"{tmp_path / 'right.py'}:pairs", out=tmp_path / "run", **options).folder
    stale = folder / "reproduce-3-missing.py"
    atomic.write_text(stale, "of mdnum")
    names = ("reproduce-mine.py", "reproduce-1-mine.py", "reproduce-1-extra.py")
    for name in names:
        (folder / name).write_text("mine")
    mdnum.conform(resume=folder, report=False)
    assert not stale.exists() and all((folder / name).read_text() == "mine" for name in names)
    assert RunFolder.open(folder).damaged() == {}


@pytest.mark.parametrize(
    ("kind", "state", "advice"),
    [
        ("fork", None, "Nothing .*`mdnum fork` command again"),
        ("audit", "answers.json", "Continue it with `mdnum audit --resume"),
        ("conform", "answers.json", "Continue it with `mdnum conform --resume"),
    ],
)
def test_advice_on_a_folder_of_another_verb_can_be_followed(tmp_path, kind, state, advice):
    from mdnum import run

    folder = RunFolder.create(tmp_path / "killed", layout(kind))
    folder.write_provenance({})
    folder.close()
    if state is not None:
        (folder.path / state).write_text("{}")
    with pytest.raises(InputError, match=f"folder of `mdnum {kind}`.* {advice}"):
        run(None, resume=folder.path)


@pytest.mark.parametrize("name", ["summary.json", "provenance.json", "system.toml", "manifest.json"])
def test_a_text_larger_than_memory_is_not_read(finished, name):
    if name != "manifest.json":
        # before its digest is made of all of it
        manifest.save(finished, manifest.Manifest(MD, True))
    os.truncate(finished / name, 6 << 30)
    code, _, err = called("report", str(finished))
    assert code == 2 and err.splitlines()[-1].startswith("mdnum: ") and "6,442,450,944 bytes" in err
    assert "Traceback" not in err


def test_a_structure_of_one_endless_line_is_not_read(tmp_path):
    system = tmp_path / "system.toml"
    mdnum.load("argon/crystal-108").write(tmp_path)
    os.truncate(tmp_path / "structure.extxyz", 0)
    os.truncate(tmp_path / "structure.extxyz", 6 << 30)
    code, _, err = called("run", str(system), "-o", str(tmp_path / "run"))
    assert code == 2 and err.count("\n") == 1 and "structure.extxyz" in err
    assert not (tmp_path / "run").exists()


def zeros(folder: Path) -> None:
    """A table of a million rows in a few kilobytes."""
    columns = {name: np.zeros(1_000_000, kind) for name, kind in COLUMNS["series"].items()}
    pq.write_table(pa.table(columns), folder / "series.parquet", compression="zstd")
    (folder / "manifest.json").unlink()
    assert (folder / "series.parquet").stat().st_size < 100_000


def test_a_table_that_unpacks_to_more_than_any_is_refused_from_its_head(finished, monkeypatch):
    zeros(finished)
    monkeypatch.setattr(tables, "_MOST_UNPACKED", 1 << 20)
    monkeypatch.setattr(pq.ParquetFile, "read_row_group", None)
    with pytest.raises(FolderError, match=r"series\.parquet: .*claim to unpack to 120,000,000"):
        RunFolder.open(finished).read("series")


def test_a_table_of_zeros_is_read(finished):
    """Two runs that never differ have such ones."""
    zeros(finished)
    assert RunFolder.open(finished).rows("series") == 1_000_000
    # sixty million in four megabytes are too many for the limits that there are
    assert 60e6 * len(COLUMNS["series"]) * 8 > tables._MOST_UNPACKED + tables._MOST_TIMES * 4e6


def test_what_a_kill_left_is_swept_from_every_folder_when_a_run_is_resumed(killed, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (killed / "structures").mkdir()
    (killed / "figures").symlink_to(tmp_path / "elsewhere")
    left = [killed / one / ".0123456789abcdef.part" for one in (".", "parts", "structures")]
    kept = tmp_path / "elsewhere" / ".0123456789abcdef.part"
    for file in (*left, kept):
        file.write_bytes(PRECIOUS)
    folder = RunFolder.open(killed)
    folder.resume()
    folder.close()
    assert not any(file.exists() for file in left) and kept.read_bytes() == PRECIOUS


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "run"
    mdnum.run("argon/crystal-108", steps=4, out=folder, check=False, report=False)
    return folder


SIGNS = "\x1b[31mred\u202e\u2066 hidden\u200b"


def test_signs_that_turn_or_hide_text_reach_neither_page_nor_terminal(small, tmp_path):
    folder = RunFolder.open(shutil.copytree(small, tmp_path / "a\x1b[31m\u202eb"))
    folder._owner = True
    folder.write_provenance(folder.provenance | {"command": SIGNS, "folder": SIGNS})
    folder.write_summary(folder.summary | {"about": SIGNS, "system": SIGNS})
    with open(folder.path / "log.txt", "a") as log:
        log.write("changed")
    code, out, err = called("report", str(folder.path))
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert code in (0, 1) and "red" in page and "log.txt" in err
    for text in (out, err, page):
        assert not set(text) & set("\x1b\u202e\u2066\u200b")


def one_line(code: int | None, err: str) -> bool:
    """Whether a command answered, or said in one line why not."""
    lines = [line for line in err.splitlines() if not re.search(r"\(\d+ s\)$", line)]
    return code in (0, 1) or (code == 2 and len(lines) == 1 and lines[0].startswith("mdnum: "))


ODD = [
    {"findings": 5}, {"findings": [{}]}, {"verdict": []}, {"potential": "?"}, {"steps": {}}, {"ase": 7},
    {"atoms": None}, {"flips_entered": "many"}, {"system": [1]}, {"cutoff": {"radius": "x"}}, {"time": "x"},
]  # fmt: skip


@pytest.mark.parametrize("words", [("report",), ("run", "--resume")], ids=" ".join)
def test_an_odd_inside_with_right_digests_is_one_line(small, tmp_path, words):
    for number, odd in enumerate(ODD):
        folder = RunFolder.open(shutil.copytree(small, tmp_path / str(number)))
        folder._owner = True
        folder.write_summary(folder.summary | odd)
        code, _, err = called(*words, str(folder.path), "--no-report" if words[0] == "run" else "--json")
        assert one_line(code, err), (odd, err)


@pytest.mark.parametrize("odd", ["nan", "huge", "negative", "empty"])
def test_odd_values_in_tables_with_right_digests_are_no_traceback(small, tmp_path, odd):
    for table in ("series", "flips", "epochs"):
        folder = RunFolder.open(shutil.copytree(small, tmp_path / table))
        held = pq.read_table(folder.path / f"{table}.parquet")
        if odd == "empty":
            held = held.slice(0, 0)
        for at, column in enumerate(held.schema):
            if held.num_rows and (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
                kind = np.dtype(column.type.to_pandas_dtype())
                limits = np.finfo(kind) if kind.kind == "f" else np.iinfo(kind)
                value = {"huge": limits.max, "negative": max(limits.min, -7), "nan": 0}[odd]
                value = np.nan if (odd, kind.kind) == ("nan", "f") else value
                held = held.set_column(at, column, pa.array(np.full(held.num_rows, value, kind)))
        name = f"{table}.parquet"
        pq.write_table(held, folder.path / name)
        manifest.update(folder.path, {name: [manifest.digest(folder.path / name)]})
        code, _, err = called("report", str(folder.path))
        assert one_line(code, err), (table, err)


@pytest.mark.parametrize(
    ("kinds", "damages"),
    [
        (("killed",), 5),
        pytest.param(("killed", "ball"), 30, marks=pytest.mark.nightly),
    ],
)
def test_no_damage_of_a_campaign_is_a_traceback_or_goes_unsaid(tmp_path, monkeypatch, kinds, damages):
    scripts = Path(__file__).resolve().parents[1] / "scripts" / "campaigns"
    monkeypatch.syspath_prepend(str(scripts))
    monkeypatch.setattr(sys, "argv", ["damaged_folders.py"])
    script = runpy.run_path(str(scripts / "damaged_folders.py"), run_name="damaged_folders")
    rows = script["campaign"](tmp_path, kinds, damages, seed=1)
    mistakes = [json.dumps(row) for row in rows if row["outcome"] in script["MISTAKES"]]
    assert not mistakes
    if damages > 20:
        assert {row["outcome"] for row in rows} > {"one line", "same result"}
