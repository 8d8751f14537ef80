"""A run folder: whatever happens to the process or the disk, its rows, frames and state are whole."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from ase import Atoms
from ase.io import read as ase_read

from mdnum.errors import FolderError
from mdnum.safe_path import environment, python
from mdnum.store import Layout, RunFolder, files, tables
from mdnum.store import checkpoint as frames
from mdnum.store import files as manifest
from mdnum.verbs import VERBS, declared
from mdnum.verbs.frame import layout

MD = layout("md")
#: Types of columns by table.
COLUMNS = {name: {key: kind for key, (kind, _) in MD.columns(name).items()} for name in MD.tables}
UNKNOWN = {"frame", "before", "margin_before"}


def series_rows(start: int, stop: int) -> dict[str, np.ndarray]:
    steps = np.arange(start, stop)
    columns = {}
    for name, kind in COLUMNS["series"].items():
        # irrational values: every bit of a float is in use
        columns[name] = np.sin(steps + len(name)) if kind == "float64" else steps * 3
    return columns | {"step": steps}


def flip_rows(start: int, stop: int) -> dict[str, np.ndarray]:
    steps = np.repeat(np.arange(start, stop), 3)
    columns = {}
    for name, kind in COLUMNS["flips"].items():
        columns[name] = np.cos(steps * 0.1 + len(name)) if kind == "float64" else steps % 7
    known = columns | {"step": steps, "entered": steps % 2 == 0, "ambiguous": steps % 5 == 0}
    # what a run does not know, and a word that is that of all rows
    return {name: known[name] for name in known.keys() - UNKNOWN} | {"decided_by": "program"}


def epoch_row(index: int) -> dict[str, object]:
    row = {name: [index] for name in COLUMNS["epochs"]}
    return row | {"reason": ["displacement"], "dangerous": [False], "displacement": [0.5 / (index + 1)]}


def frame(step: int) -> Atoms:
    positions = np.sin(np.arange(12.0) + step).reshape(4, 3)
    atoms = Atoms("Ar4", positions=positions, cell=np.diag([5.0, 6.0, 7.0]), pbc=True)
    atoms.set_momenta(np.cos(positions * 3))
    return atoms


def write_run(folder: RunFolder, start: int, stop: int, chunk: int = 10) -> None:
    """A rollout's calls, a chunk at a time, a forced checkpoint after each."""
    for step in range(start, stop, chunk):
        folder.append("series", series_rows(step, step + chunk))
        folder.append("flips", flip_rows(step, step + chunk))
        folder.append("epochs", epoch_row(step // chunk))
        folder.append_frame(frame(step))
        folder.log(f"{step:8d} {np.sin(step):.12f}")
        folder.checkpoint(state_at(step + chunk), force=True)


def state_at(step: int) -> dict[str, object]:
    return {"step": step, "positions": np.sin(np.arange(12.0) + step), "key": np.uint32([step, 7]),
            "drift": 0.1 + step / 3, "reasons": ["interval", None], "on": True}  # fmt: skip


def content(folder: RunFolder) -> dict[str, bytes]:
    tables = [f"{name}.parquet" for name in ("series", "flips", "epochs")]
    names = (*tables, "trajectory.traj", "log.txt", "checkpoint.npz")
    return {name: (folder.path / name).read_bytes() for name in names}


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    """What a power cut would do is not tested, so nothing waits for the disk."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run, to be read."""
    folder = RunFolder.create(tmp_path_factory.mktemp("store") / "whole", MD)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        write_run(folder, 0, 480)
        folder.finalize()
    return folder


def test_what_is_appended_is_read_back_bit_for_bit(whole):
    for name, expected in (("series", series_rows(0, 480)), ("flips", flip_rows(0, 480))):
        found = RunFolder.open(whole.path).read(name)
        assert list(found) == [key for key in COLUMNS[name] if key in expected]
        for key, values in expected.items():
            np.testing.assert_array_equal(found[key], values, err_msg=key)
    table = pq.read_table(whole.path / "flips.parquet")
    spelled = {"double": "float64", "dictionary<values=string, indices=int32, ordered=0>": "word"}
    types = {field.name: spelled.get(str(field.type), str(field.type)) for field in table.schema}
    assert types == COLUMNS["flips"]
    assert {name for name in table.column_names if table[name].null_count == len(table)} == UNKNOWN
    assert not (whole.path / "parts").exists()
    for step, atoms in enumerate(ase_read(whole.path / "trajectory.traj", index=":")):
        assert atoms.positions.tobytes() == frame(10 * step).positions.tobytes()
        assert atoms.get_momenta().tobytes() == frame(10 * step).get_momenta().tobytes()
    state, expected = whole.load_checkpoint(), state_at(480)
    assert state.keys() == expected.keys() and state["key"].dtype == np.uint32
    for key, value in expected.items():
        assert np.array_equal(state[key], value) if isinstance(value, np.ndarray) else state[key] == value


# ASE moves its offset table at frames 2 and 43
@pytest.mark.parametrize(("kept", "finished"), [(10, False), (430, False), (300, True)])
def test_resumed_run_ends_with_the_same_bytes(tmp_path, whole, kept, finished):
    folder = RunFolder.create(tmp_path / "killed", MD)
    write_run(folder, 0, kept)
    if finished:
        folder.finalize()
    else:
        # what a killed run leaves behind after its checkpoint: parts, frames, log lines, a half-written frame
        folder.append("series", series_rows(kept, kept + 70))
        folder.append("flips", flip_rows(kept, kept + 70))
        for stream in folder._streams.values():
            stream.flush()
        for step in range(3):
            folder.append_frame(frame(9_000 + step))
        folder.log("a line of the part that was lost")
        folder.close()
        with open(folder.path / "trajectory.traj", "ab") as file:
            file.write(b"half a frame")
        (folder.path / "parts" / ".series-000000000999.parquet.part").write_bytes(b"half a part")
    resumed = RunFolder.open(folder.path)
    assert len(resumed.read("series")["step"]) == kept
    assert resumed.resume()["step"] == kept
    write_run(resumed, kept, 480)
    resumed.finalize()
    assert content(resumed) == content(whole)


@pytest.mark.parametrize("when", ["before it is written", "before it is renamed", "after it is renamed"])
def test_a_run_killed_at_any_write_of_a_checkpoint_resumes_from_the_old_or_the_new_one(
    tmp_path, monkeypatch, when
):
    folder = RunFolder.create(tmp_path / "killed", MD)
    write_run(folder, 0, 20)
    folder.append("series", series_rows(20, 30))
    name, replace, renamed = folder.path / "checkpoint.npz", os.replace, []

    def killed(source, target):
        if target != name:
            return replace(source, target)
        renamed.append(target)
        if when == "after it is renamed":
            replace(source, target)
        raise KeyboardInterrupt

    def never(path):
        if path == name:
            raise KeyboardInterrupt
        return replacing(path)

    with monkeypatch.context() as patch:
        replacing = frames.replacing
        if when == "before it is written":
            patch.setattr(frames, "replacing", never)
        else:
            patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            folder.checkpoint(state_at(30), force=True)
    assert bool(renamed) == (when != "before it is written")
    folder.close()
    resumed = RunFolder.open(folder.path)
    step = 30 if when == "after it is renamed" else 20
    assert resumed.resume()["step"] == step and len(resumed.read("series")["step"]) == step
    # whatever is neither is damaged
    resumed.close()
    name.write_bytes(name.read_bytes()[:-1] + b"x")
    with pytest.raises(FolderError, match=r"checkpoint\.npz"):
        RunFolder.open(folder.path).resume()


def test_failed_run_keeps_the_rows_after_its_checkpoint(tmp_path):
    folder = RunFolder.create(tmp_path / "blown-up", MD)
    write_run(folder, 0, 100)
    folder.append("series", series_rows(100, 107))
    folder.finalize()
    assert len(folder.read("series")["step"]) == 107
    resumed = RunFolder.open(folder.path)
    assert resumed.resume()["step"] == 100
    assert len(resumed.read("series")["step"]) == 100


# what is done to the first of three tables, six replacements and removals, and the last of all
@pytest.mark.parametrize(
    "killed_at", [*range(1, 7), 19, *(pytest.param(at, marks=pytest.mark.nightly) for at in range(7, 19))]
)
def test_merge_killed_anywhere_loses_and_doubles_nothing(tmp_path, monkeypatch, killed_at):
    folder = RunFolder.create(tmp_path / "run", MD)
    write_run(folder, 0, 60, chunk=20)

    class Killed(BaseException):
        pass

    calls = iter(range(1, 100))

    def dies(function):
        def wrapper(*args, **kwargs):
            if next(calls) == killed_at:
                raise Killed
            return function(*args, **kwargs)

        return wrapper

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", dies(os.replace))
        patch.setattr(tables.Path, "unlink", dies(tables.Path.unlink))
        with pytest.raises(Killed):
            folder.finalize()
    folder.close()
    reopened = RunFolder.open(folder.path)
    np.testing.assert_array_equal(reopened.read("series")["step"], np.arange(60))
    reopened.resume()
    write_run(reopened, 60, 80, chunk=20)
    reopened.finalize()
    np.testing.assert_array_equal(reopened.read("series")["step"], np.arange(80))
    np.testing.assert_array_equal(reopened.read("flips")["step"], np.repeat(np.arange(80), 3))
    np.testing.assert_array_equal(reopened.read("epochs")["epoch"], np.arange(4))


def test_checkpoints_are_spaced_and_the_last_one_is_made_up_for(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("mdnum.store.folder.time.monotonic", lambda: clock[0])
    folder = RunFolder.create(tmp_path / "run", MD)
    assert folder.checkpoint({"step": 0})
    folder.append("series", series_rows(0, 5))
    assert not folder.checkpoint({"step": 5})
    assert folder.load_checkpoint()["step"] == 0
    clock[0] = 2.5
    assert folder.checkpoint_due()
    # one that takes long comes seldom; making the state counts too
    clock[0] = 3.5
    folder.checkpoint({"step": 5}, force=True)
    for now, due in ((43.0, False), (60.0, True)):
        clock[0] = now
        assert folder.checkpoint_due() == due
    assert folder.checkpoint({"step": 6}) and not folder.checkpoint({"step": 7})
    folder.finalize()
    assert folder.load_checkpoint()["step"] == 7


@pytest.mark.parametrize("then", [RunFolder.finalize, lambda folder: folder.checkpoint({}, force=True)])
def test_what_goes_wrong_beside_a_run_is_raised_by_what_comes_next(tmp_path, monkeypatch, then):
    folder = RunFolder.create(tmp_path / "run", MD)
    write_run(folder, 0, 30, chunk=30)
    folder.append("series", series_rows(30, 40))

    def full(*_: object) -> None:
        raise FolderError("cannot write: the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("mdnum.store.checkpoint.write", full)
        folder.checkpoint_beside(lambda: state_at(40))
        with pytest.raises(FolderError, match="the disk is full"):
            then(folder)
    folder.close()
    assert RunFolder.open(folder.path).resume()["step"] == 30


def test_long_table_is_flushed_without_a_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_BUFFER_ROWS", 100)
    folder = RunFolder.create(tmp_path / "run", MD)
    folder.append("series", series_rows(0, 150))
    assert len(list((folder.path / "parts").iterdir())) == 1
    assert len(RunFolder.open(folder.path).read("series")["step"]) == 150


@pytest.mark.parametrize("ends", ["finished", "closed", "full"])
def test_a_table_that_nobody_resumes_is_written_as_it_grows(tmp_path, monkeypatch, ends):
    """Whole or not at all; of a disk that is full one is told while rows are appended, or at the end."""
    monkeypatch.setattr(tables, "_BUFFER_ROWS", 100)
    monkeypatch.setattr(tables, "_GROUP_ROWS", 64)
    folder = RunFolder.create(tmp_path / "ball", layout("ball"))
    rows = {"step": np.arange(150), "ball": np.zeros(150), "y": np.linspace(0, 1, 150), "v": np.zeros(150)}

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    if ends == "full":
        monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
        with pytest.raises(FolderError, match="the disk is full"):
            for _ in range(9):
                folder.append("heights", rows)
            folder.finalize()
    else:
        for _ in range(9):
            folder.append("heights", rows)
    if ends == "finished":
        folder.merge()
        with pytest.raises(ValueError, match="complete"):
            folder.append("heights", rows)
        np.testing.assert_array_equal(folder.read("heights")["y"], np.tile(rows["y"], 9))
        assert pq.read_metadata(folder.path / "heights.parquet").row_group(0).num_rows == 64
        assert not folder.damaged()
    folder.close()
    # no part, and nothing of a file that did not become whole
    left = [path.name for path in folder.path.rglob("*") if "parquet" in path.name or "part" in path.name]
    assert left == ["heights.parquet"] * (ends == "finished")


def test_what_rows_leave_out_is_in_the_table(tmp_path):
    """Parts, which are read once more and removed, do not hold what every row has."""
    same = {"rule": np.broadcast_to(np.int32(0), 30), "rank": np.broadcast_to(np.int32(0), 30)}
    images = {"rank": np.arange(30) % 2, "decided_by": "positions"}
    folder = RunFolder.create(tmp_path / "run", MD)
    for start, more in ((0, same), (10, same | images), (20, same)):
        # with other columns in one part than in the next
        folder.append("flips", flip_rows(start, start + 10) | more)
    folder.checkpoint(state_at(30), force=True)
    held = [set(pq.read_schema(path).names) for path in sorted(folder.path.glob("parts/flips-*"))]
    constant = {"rule", "rank", "decided_by"}
    assert [constant & names for names in held] == [set(), {"rank", "decided_by"}, set()]
    assert not any(UNKNOWN & names for names in held)
    first = RunFolder.open(folder.path).read("flips")
    folder.finalize()
    rows, written = RunFolder.open(folder.path).read("flips"), pq.read_schema(folder.path / "flips.parquet")
    assert written.names == list(COLUMNS["flips"])
    assert rows["rank"].tolist() == [0] * 30 + images["rank"].tolist() + [0] * 30
    assert rows["decided_by"].tolist() == ["program"] * 30 + ["positions"] * 30 + ["program"] * 30
    for name, values in rows.items():
        np.testing.assert_array_equal(first[name], values, err_msg=name)


def test_a_run_of_an_earlier_version_is_read_and_resumed(tmp_path, whole):
    folder = RunFolder.create(tmp_path / "run", MD)
    write_run(folder, 0, 300)
    folder.finalize()
    file, early = folder.path / "flips.parquet", UNKNOWN | {"rule", "rank", "decided_by"}
    pq.write_table(pq.read_table(file).drop_columns(sorted(early)), file)
    declared = {name: MD.spelled[name] for name in MD.always}
    words = [word for word in declared["flips"].split() if word.partition(":")[0].rstrip("?") not in early]
    then = Layout("md", "run", {**declared, "flips": " ".join(words)}, {}, MD.resumes_from)
    files.update(folder.path, {file.name: [files.digest(file)]}, layout=then)
    before = RunFolder.open(folder.path)
    assert not early & before.read("flips").keys()
    # as whoever knows the columns of today reads it
    before.read_as(MD)
    old = before.read("flips")
    assert not old["rule"].any() and not old["rank"].any() and set(old["decided_by"]) == {"program"}
    again = RunFolder.open(folder.path)
    again.resume(MD)
    write_run(again, 300, 480)
    again.finalize()
    assert RunFolder.open(folder.path).layout.columns("flips") == MD.columns("flips")
    new = RunFolder.open(folder.path).read("flips")
    assert pq.read_schema(file).equals(pq.read_schema(whole.path / "flips.parquet"))
    for name, values in whole.read("flips").items():
        expected = np.where(np.arange(1440) < 900, 0, values) if name in ("rule", "rank") else values
        np.testing.assert_array_equal(new[name], expected, err_msg=name)


def test_row_groups_do_not_depend_on_the_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_GROUP_ROWS", 64)
    for name, chunk in (("a", 10), ("b", 50)):
        folder = RunFolder.create(tmp_path / name, MD)
        write_run(folder, 0, 300, chunk=chunk)
        folder.finalize()
        assert pq.read_metadata(folder.path / "series.parquet").row_group(0).num_rows == 64
    assert (tmp_path / "a/series.parquet").read_bytes() == (tmp_path / "b/series.parquet").read_bytes()


KINDS = [kind for name in VERBS for kind in declared(name).get("kinds", ())]


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_folder_has_the_tables_of_its_kind_with_columns(tmp_path, kind):
    held = layout(kind)
    folder = RunFolder.create(tmp_path / "run", held)
    folder.checkpoint({"step": 0}, force=True)
    folder.finalize()
    assert sorted(path.stem for path in folder.path.glob("*.parquet")) == sorted(held.always)
    for name in held.always:
        assert list(folder.read(name)) == list(held.columns(name))
    again = RunFolder.open(folder.path)
    assert (again.kind, again.layout.command) == (kind, held.command)
    assert all(again.layout.columns(name) == held.columns(name) for name in held.always)
    again.resume()
    again.finalize()
    assert sorted(path.stem for path in folder.path.glob("*.parquet")) == sorted(held.always)


def test_a_table_is_read_back_with_its_signs(tmp_path):
    ball = RunFolder.create(tmp_path / "run", layout("ball"))
    ball.append("heights", {"step": [0, 0], "ball": [0, 1], "y": [1.0, np.pi], "v": [0.0, -0.0]})
    ball.append("solver", {"step": [1], "ball": [-1], "iteration": [2], "residual": [0.5],
                           "margin": [-0.25], "stopped": [False], "reason": [""]})  # fmt: skip
    ball.finalize()
    read = RunFolder.open(tmp_path / "run").read("heights")
    assert read["y"].tolist() == [1.0, np.pi]
    assert np.signbit(read["v"]).tolist() == [False, True]


def test_rows_that_do_not_fit_are_refused(tmp_path):
    folder = RunFolder.create(tmp_path / "run", MD)
    short = series_rows(0, 5)
    with pytest.raises(ValueError, match=r"missing.*kinetic"):
        folder.append("series", {key: value for key, value in short.items() if key != "kinetic"})
    with pytest.raises(ValueError, match="different length"):
        folder.append("series", short | {"kinetic": np.zeros(4)})
    folder.append("series", short | {"extra": np.arange(5)})
    with pytest.raises(ValueError, match=r"missing columns \['extra'\]"):
        folder.append("series", short)
    with pytest.raises(TypeError, match="dtype object"):
        folder.checkpoint({"bad": np.array([object()])}, force=True)


def test_existing_folders_are_not_overwritten(tmp_path):
    whole = RunFolder.create(tmp_path / "whole", MD)
    write_run(whole, 0, 20)
    whole.finalize()
    with pytest.raises(FolderError, match="already holds a run") as caught:
        RunFolder.create(whole.path, MD)
    assert caught.value.exit_code == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(FolderError, match=r"not empty \(it holds 'thesis.tex'\)"):
        RunFolder.create(tmp_path / "mine", MD)
    with pytest.raises(FolderError, match="is a file"):
        RunFolder.create(tmp_path / "mine" / "thesis.tex", MD)
    with pytest.raises(FolderError, match="holds no run"):
        RunFolder.open(tmp_path / "mine")
    with pytest.raises(FolderError, match="does not exist"):
        RunFolder.open(tmp_path / "nowhere")


def test_two_writers_are_refused(tmp_path):
    first = RunFolder.create(tmp_path / "run", MD)
    write_run(first, 0, 10)
    with pytest.raises(FolderError, match="another process is writing"):
        RunFolder.open(first.path).resume()
    first.close()
    assert RunFolder.open(first.path).resume()["step"] == 10


NAMES = """
import sys
from mdnum.store import Layout, RunFolder
from mdnum.store.files import default_folder
print("ready", flush=True)
sys.stdin.readline()
for _ in range(10):
    print(RunFolder.create(default_folder("argon/liquid-864"), Layout("md", "run")).path.name)
"""


def test_processes_that_start_at_once_get_a_folder_each(tmp_path):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    words, env = python("-c", NAMES), environment()
    started = [subprocess.Popen(words, cwd=tmp_path, env=env, **pipes) for _ in range(8)]
    assert [one.stdout.readline() for one in started] == ["ready\n"] * 8
    for one in started:
        one.stdin.write("\n")
        one.stdin.flush()
    names = [name for one in started for name in one.communicate()[0].split()]
    assert not any(one.returncode for one in started)
    assert sorted(names) == sorted(f"argon-liquid-864-{number}" for number in range(1, 81))


def test_a_name_is_not_taken_from_a_file_or_a_link(tmp_path):
    (tmp_path / "x-1").write_text("")
    (tmp_path / "x-2").symlink_to("nowhere")
    assert files.default_folder("x", tmp_path).name == "x-3"
    with pytest.raises(FolderError, match=r"x-1.*file of this name"):
        files.default_folder("x", tmp_path / "x-1")


def test_a_run_that_began_and_ended_meanwhile_is_kept(tmp_path, monkeypatch):
    take, others = RunFolder._take_lock, []

    def late(self):
        if not others:
            others.append(self)
            done = RunFolder.create(tmp_path / "run", MD)
            write_run(done, 0, 10)
            done.finalize()
        take(self)

    monkeypatch.setattr(RunFolder, "_take_lock", late)
    with pytest.raises(FolderError, match="already holds a run"):
        RunFolder.create(tmp_path / "run", MD)
    assert RunFolder.open(tmp_path / "run").rows("series") == 10


def test_changed_folder_is_not_resumed(tmp_path):
    folder = RunFolder.create(tmp_path / "run", MD)
    write_run(folder, 0, 30)
    folder.close()
    (folder.path / "parts" / "series-000000000010.parquet").unlink()
    with pytest.raises(FolderError, match=r"series-000000000010\.parquet: is missing"):
        RunFolder.open(folder.path).resume()
    manifest.update(folder.path, {}, ["parts/series-000000000010.parquet"])
    with pytest.raises(FolderError, match=r"10 to 19 .*'series' are missing"):
        RunFolder.open(folder.path).resume()
    (folder.path / "manifest.json").unlink()
    with pytest.raises(FolderError, match=r"manifest\.json: is missing"):
        RunFolder.open(folder.path).resume()


def test_json_holds_what_json_has_and_broken_files_are_named(tmp_path):
    folder = RunFolder.create(tmp_path / "run", MD)
    held = {"a": np.float64(0.1), "b": np.arange(3), "c": float("nan"), "d": (np.bool_(True), None)}
    folder.write_summary(held)
    assert json.loads((folder.path / "summary.json").read_text()) == {"a": 0.1, "b": [0, 1, 2], "c": None,
                                                                     "d": [True, None]}  # fmt: skip
    assert folder.provenance == {}
    with pytest.raises(FolderError, match="has no checkpoint"):
        folder.load_checkpoint()
    (folder.path / "checkpoint.npz").write_bytes(b"PK nonsense")
    with pytest.raises(FolderError, match=r"checkpoint\.npz"):
        folder.load_checkpoint()
    (folder.path / "summary.json").write_text("{")
    with pytest.raises(FolderError, match=r"summary\.json"):
        _ = folder.summary


def test_full_disk_in_the_middle_of_a_frame_keeps_the_frames_before(tmp_path, monkeypatch):
    from ase.io.trajectory import TrajectoryWriter

    folder = RunFolder.create(tmp_path / "run", MD)
    folder.append_frame(frame(0))
    folder.append_frame(frame(1))

    def full(self, atoms):
        self.backend.write(positions=atoms.positions)
        raise OSError(errno.ENOSPC, "No space left on device")

    path = folder.path / "trajectory.traj"
    with monkeypatch.context() as patch:
        patch.setattr(TrajectoryWriter, "write", full)
        with pytest.raises(FolderError, match="disk is full"):
            folder.append_frame(frame(2))
    assert len(ase_read(path, index=":")) == 2
    folder.append_frame(frame(2))
    for step, image in enumerate(ase_read(path, index=":")):
        assert image.positions.tobytes() == frame(step).positions.tobytes()
    # one that is shorter than its checkpoint is refused
    file = frames.FrameFile(path)
    count, table, size = file.mark()
    with pytest.raises(FolderError, match="shorter than its checkpoint"):
        file.truncate((count, table, size + 100))


def test_store_does_not_import_jax():
    code = "import sys, mdnum.store; assert not {'jax', 'jax_md'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_type_of_a_column_is_declared_with_it_and_does_not_follow_from_its_name():
    """Names that mdnum's tables have, as text, integers and booleans, in the table of another package."""
    layout = Layout("mine", "mine", {"values": "first step ended left entered:bool reason:word"})
    kinds = {name: kind for name, (kind, _) in layout.columns("values").items()}
    floats = dict.fromkeys(("first", "step", "ended", "left"), "float64")
    assert kinds == {**floats, "entered": "bool", "reason": "word"}
