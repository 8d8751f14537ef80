"""What is recorded about a run is complete, plain, and changes when something that matters changes."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import types
from pathlib import Path

import ase.build
import pytest

import mdnum
from mdnum import provenance, systems


def _system(path: Path | None = None) -> types.SimpleNamespace:
    atoms = ase.build.bulk("Ar", "fcc", 5.26, cubic=True)
    return types.SimpleNamespace(name="argon/cell", program={}, path=path, atoms=atoms)


def test_collect_is_json_and_names_what_decides_bits(monkeypatch: pytest.MonkeyPatch):
    record = provenance.collect(_system())
    assert json.loads(json.dumps(record)) == record
    assert record["system"] == "argon/cell"
    assert record["versions"]["mdnum"] == mdnum.__version__ and record["versions"]["jax"]
    assert record["jax_settings"]["jax_enable_x64"] is True
    assert record["devices"][0]["platform"] and len(record["fingerprint"]) == 16
    again = provenance.collect(_system())
    assert [record[name] for name in ("fingerprint", "hashes")] == [again["fingerprint"], again["hashes"]]
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX")
    other = provenance.collect(_system())
    assert other["fingerprint"] != record["fingerprint"]
    assert other["environment"]["XLA_FLAGS"] == "--xla_cpu_max_isa=AVX"


def test_a_system_without_atoms_has_no_structure():
    ball = systems.load("ball/zeno", {"precision.state": "float32"})
    record = provenance.collect(ball)
    assert record["system"] == "ball/zeno" and record["dtypes"]["state"] == "float32"
    assert ball.path is not None and record["hashes"]["structure"] is None
    assert record["hashes"]["file"] == hashlib.sha256(ball.path.read_bytes()).hexdigest()
    assert record["fingerprint"] != provenance.collect(systems.load("ball/zeno"))["fingerprint"]


def test_hashes_see_a_last_bit_the_bytes_of_a_file_and_no_order_of_keys(tmp_path: Path):
    system = _system()
    before = provenance.hashes(system)
    assert before["file"] is None
    system.atoms.positions[1, 2] *= 1 + 2**-52
    assert provenance.hashes(system)["structure"] != before["structure"]
    path = tmp_path / "a.toml"
    path.write_text("abc")
    # FIPS 180-2, appendix B.1
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert provenance.hashes(_system(path))["file"] == expected
    assert provenance.fingerprint({"a": 1, "b": 2}) == provenance.fingerprint({"b": 2, "a": 1})
    assert provenance.fingerprint({"a": 1}) != provenance.fingerprint({"a": 2})


@pytest.mark.parametrize("name", ["ball/drop", "argon/crystal-108"])
def test_program_hash_changes_with_every_knob_and_with_no_word(name: str):
    knobs = {
        "ball/drop": {"contact.k": "10000.000000000002", "integrator.timestep": "0.002",
                      "flight.gravity": "9.8", "integrator.kind": "velocity-verlet",
                      "precision.reduction": "exact"},
        "argon/crystal-108": {"dynamics.timestep": "0.001", "cutoff.kind": "switched",
                              "neighbors.skin": "0.1"},
    }[name]  # fmt: skip
    before = provenance.hashes(systems.load(name))["program"]
    assert before == provenance.hashes(systems.load(name, {"about": "other words"}))["program"]
    seen = {provenance.hashes(systems.load(name, {key: value}))["program"] for key, value in knobs.items()}
    assert len(seen | {before}) == len(knobs) + 1


@pytest.mark.parametrize(
    ("text", "model", "flags"),
    [
        ("model name\t: X\nflags\t\t: fpu avx fma avx2\nmodel name\t: Y\n", "X", ["avx", "fma", "avx2"]),
        ("Features\t: fp asimd sve\n", None, ["asimd", "sve"]),
        ("nothing here\n", None, None),
    ],
)  # fmt: skip
def test_cpu_is_read_from_either_kind_of_description(
    tmp_path: Path, text: str, model: str | None, flags: list[str] | None
):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(text)
    found = provenance.cpu(cpuinfo)
    assert found["flags"] == flags and found["model"] and found["model"] == (model or found["model"])


def test_commit_belongs_to_mdnum_and_says_when_files_changed(tmp_path: Path):
    def git(*words: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.invalid", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *words], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    if shutil.which("git") is None:
        assert provenance.commit(tmp_path) is None
        return
    git("init", "--quiet")
    assert provenance.commit(tmp_path) is None
    (tmp_path / "other.py").write_text("x = 1\n")
    git("add", ".")
    git("commit", "--quiet", "-m", "somebody else's repository")
    (tmp_path / "provenance.py").write_text("x = 1\n")
    assert provenance.commit(tmp_path) is None, "installed into a folder that git does not track"
    git("add", ".")
    git("commit", "--quiet", "-m", "mdnum's own")
    head = git("rev-parse", "HEAD")
    assert provenance.commit(tmp_path) == head
    (tmp_path / "provenance.py").write_text("x = 2\n")
    assert provenance.commit(tmp_path) == head + "+"


@pytest.mark.skipif(shutil.which("git") is None, reason="no git here")
@pytest.mark.parametrize("driver", ["planted", "a=b"])
def test_no_program_that_a_repository_names_is_run(tmp_path: Path, driver: str):
    def git(*words: str) -> None:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.invalid", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", "-C", str(package), *identity, *words], check=True, capture_output=True)

    package, ran = tmp_path / "package", tmp_path / "ran"
    package.mkdir()
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\necho $0 >> {ran}\ncat\n")
    program.chmod(0o755)
    source = package / "provenance.py"
    source.write_text("x = 1\n")
    (package / ".gitattributes").write_text(f"*.py filter={driver}\n")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "-m", "a package")
    git("config", "core.fsmonitor", str(program))
    for name in ("clean", "smudge", "process"):
        git("config", f"filter.{driver}.{name}", str(program))
    git("config", f"filter.{driver}.required", "true")
    (package / ".git" / "hooks").mkdir(exist_ok=True)
    for hook in ("post-index-change", "fsmonitor-watchman", "post-checkout"):
        shutil.copy(program, package / ".git" / "hooks" / hook)
    # the same text, newer: git reads it through its filters to see whether it changed
    source.write_text("x = 1\n")
    found = provenance.commit(package)
    assert not ran.exists(), ran.read_text()
    if driver == "planted":
        assert found is not None and len(found) == 40
        source.write_text("x = 2\n")
        assert provenance.commit(package) == found + "+" and not ran.exists()
    else:
        assert found is None


@pytest.mark.skipif(shutil.which("git") is None, reason="no git here")
def test_the_commit_is_not_that_of_the_repository_whose_hook_runs_mdnum(tmp_path, monkeypatch):
    subprocess.run(["git", "init", "--quiet", str(tmp_path)], check=True)
    here = provenance.commit(Path(provenance.__file__).parent)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / ".git"))
    assert provenance.commit(Path(provenance.__file__).parent) == here
