"""Where and how mdnum is started: folders that cannot be written, closed streams, odd environments."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import call

import mdnum
from mdnum.cli import programs_folder
from mdnum.cli.output import CommandBar, is_interrupt
from mdnum.errors import InputError
from mdnum.report.finding import conclude
from mdnum.report.section import Page
from mdnum.safe_path import environment, python
from mdnum.store import RunFolder
from mdnum.verbs.frame import Outcome

COMMAND = python("-m", "mdnum")


def started(*words: str, cwd: Path, **changes: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, its environment changed."""
    env = {**environment(), **changes}
    return subprocess.run([*COMMAND, *words], capture_output=True, text=True, cwd=cwd, env=env, timeout=600)


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Lines on stderr but those of progress, which a slow machine is given."""
    return [line for line in done.stderr.splitlines() if not re.search(r"\(\d+ s\)$", line)]


@pytest.fixture(scope="module")
def read_only(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of an installation in which nobody, root neither, can keep what is compiled."""
    home = tmp_path_factory.mktemp("site")
    package = Path(mdnum.__file__).parent
    shutil.copytree(package, home / "mdnum", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("systems", "demos"):
        shutil.copytree(package.parent / name, home / name, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in (home / "mdnum", *(home / "mdnum").rglob("*/")):
        (folder / "__pycache__").write_text("a file, where a folder would have to be made")
    nowhere = os.path.join(os.devnull, "home")
    return {
        "PYTHONPATH": str(home), "PYTHONDONTWRITEBYTECODE": "1", "HOME": nowhere, "NUMBA_CACHE_DIR": "",
        "XDG_CACHE_HOME": nowhere, "XDG_CONFIG_HOME": nowhere, "JAX_COMPILATION_CACHE_DIR": nowhere,
    }  # fmt: skip


def test_where_nothing_can_be_kept_one_line_says_what_to_set(read_only, tmp_path):
    # programs of XLA are kept in another folder; the nightly has none of either kind
    programs = {"JAX_COMPILATION_CACHE_DIR": os.environ["JAX_COMPILATION_CACHE_DIR"]}
    done = started("ball", "ball/drop", "--steps", "5", cwd=tmp_path, **read_only | programs)
    assert done.returncode in (0, 1), done.stderr
    (line,) = errors(done)
    assert line.startswith("mdnum: ") and "NUMBA_CACHE_DIR" in line and "XDG_CACHE_HOME" in line
    assert (tmp_path / "runs" / "ball-drop-1" / "report.html").exists()


SEARCHED = """
import sys
import mdnum.bits, numpy
from mdnum.compiled import all_kept
# nothing was compiled by then
assert all_kept()
mdnum.bits.digit_order(numpy.zeros((4, 1), numpy.int64), 1, 1)
sys.exit(not all_kept())
"""


def test_nothing_is_said_before_something_is_compiled_or_where_a_folder_takes_it(read_only, tmp_path):
    for cache, missed in ((tmp_path / "cache", 0), (Path(os.devnull), 1)):
        env = environment() | read_only | {"XDG_CACHE_HOME": str(cache)}
        assert subprocess.run(python("-c", SEARCHED), env=env).returncode == missed
    assert list((tmp_path / "cache").rglob("*.nbi"))


# everything is compiled again; a ball and a search, above, are what the gate has of it
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "compiles"),
    [
        ("run argon/crystal-108 --steps 20 --save-every 10", True),
        ("grad pair/leaving-well --of msd --wrt epsilon --methods symmetric --steps 20", True),
        ("fork argon/crystal-108 --vary order --steps 20", True),
        ("audit ase.calculators.lj:LennardJones(sigma=3.405,epsilon=0.0103) --checks forces", False),
        ("conform ase --cases 3 --no-large", False),
    ],
)
def test_every_verb_works_where_nothing_can_be_kept(read_only, tmp_path, words, compiles):
    asked = [words]
    if words.startswith("run"):
        asked.append("flips new --cutoff 1.5")
    for number, one in enumerate(asked):
        out = ("new", "flips")[number]
        done = started(*one.split(), "-o", out, cwd=tmp_path, **read_only)
        assert done.returncode in (0, 1), done.stderr
        assert ["NUMBA_CACHE_DIR" in line for line in errors(done)] == [True] * compiles


NO_ROOM = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
import numba
from mdnum.compiled import all_kept, cfunc, njit

@njit
def twice(x):
    return 2 * x

def same(x):
    return x

assert all_kept()
assert twice(4) == 8 and not all_kept()
made = cfunc(numba.types.intp(numba.types.intp), same)
assert made.ctypes(7) == 7
"""


def test_a_cache_folder_without_room_keeps_nothing_from_being_computed(tmp_path):
    (tmp_path / "program.py").write_text(NO_ROOM)
    done = subprocess.run(
        python("program.py"), cwd=tmp_path, capture_output=True, text=True,
        env=environment(NUMBA_CACHE_DIR=str(tmp_path / "cache"), PYTHONDONTWRITEBYTECODE="1"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_the_package_compiles_through_one_module_alone():
    """A decorator of numba's with a cache fails where none can be written."""
    package = Path(mdnum.__file__).parent
    decorated = re.compile(r"numba\.(njit|jit|cfunc|vectorize|guvectorize)\b.*cache")
    found = [file.name for file in package.rglob("*.py") if decorated.search(file.read_text("utf-8"))]
    assert found == ["compiled.py"]


# -- what is compiled, by kind of processor ------------------------------------------------------------


def test_programs_are_kept_by_kind_of_processor_wherever_they_are_kept(tmp_path, monkeypatch, capsys):
    name, most = "JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE"
    # set here, so that all are put back
    for each in (name, most, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "TF_CPP_MIN_LOG_LEVEL"):
        monkeypatch.setenv(each, "0")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # a person's own folder, and their own limits
    monkeypatch.setenv(name, str(tmp_path / "own"))
    for _ in range(2):
        assert call("systems", "list") == 0
        assert os.environ[name] == str(tmp_path / "own" / programs_folder()) and os.environ[most] == "0"
    assert os.listdir(tmp_path) == ["own"] and os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"
    for turned_off in ("", "gs://bucket/programs"):
        monkeypatch.setenv(name, turned_off)
        assert call("systems", "list") == 0 and os.environ[name] == turned_off
    # without one, beside other caches
    monkeypatch.delenv(name)
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    assert call("systems", "list") == 0
    # XLA prints pages for every program that it loads
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    assert os.environ[name] == str(tmp_path / "mdnum" / programs_folder()) and int(os.environ[most]) > 0
    # where nothing can be kept, nothing is said of it
    (tmp_path / "file").touch()
    for setting, value in ((name, None), (name, str(tmp_path / "file"))):
        monkeypatch.delenv(setting) if value is None else monkeypatch.setenv(setting, value)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        assert call("systems", "list") == 0 and name not in os.environ
    assert not capsys.readouterr().err


# -- streams -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("closed", "words"),
    [
        ("<&-", "systems list"), (">&-", "systems list"), ("2>&-", "systems show nothing"),
        ("<&- >&- 2>&-", "ball ball/drop --steps 5 -o x --no-report"),
    ],
)  # fmt: skip
def test_closed_streams_are_nothing_to_stop_for(tmp_path, closed, words):
    shell = ["sh", "-c", f'exec "$@" {closed}', "sh", *COMMAND, *words.split()]
    done = subprocess.run(shell, capture_output=True, text=True, cwd=tmp_path, env=environment())
    assert done.returncode == (2 if "nothing" in words else 0) and not done.stderr
    if "ball" in words:
        # the number of a closed stream would be that of one of its files
        assert not RunFolder.open(tmp_path / "x").damaged()


@pytest.mark.parametrize(("encoding", "sign"), [("ascii", "\\u03c3"), ("latin-1", "\\u03c3"), ("utf-8", "σ")])
def test_an_encoding_that_lacks_a_sign_is_given_its_number(monkeypatch, encoding, sign):
    def answered(system: str, **how: Any) -> Any:
        summary = {"status": "complete", "findings": [], "unit": "σ, Å"}
        verdict = conclude([], headline="2.5 σ and 3 Å")
        return Outcome(Path("x"), "md", "run", "", summary, verdict, _page=Page(""))

    monkeypatch.setattr("mdnum.verbs.run.run", answered)
    for words in ((), ("--json",)):
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(sys, "stdout", out)
        assert call("run", "x", *words) == 0
        out.flush()
        text = out.buffer.getvalue().decode(encoding)
        assert sign in text and ("Å" in text) == (encoding != "ascii")
    assert json.loads(text)["unit"] == "σ, Å"


# -- settings of other packages ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("JAX_PLATFORMS", "cuda", marks=pytest.mark.nightly),
        ("JAX_PLATFORMS", "nonsense"),
        ("NUMBA_DISABLE_JIT", "1"),
    ],
)
def test_a_setting_that_leaves_nothing_to_compute_with_is_one_line(tmp_path, name, value):
    done = started("ball", "ball/drop", "--steps", "5", "--no-report", cwd=tmp_path, **{name: value})
    if done.returncode in (0, 1) and value == "cuda":
        pytest.skip("there is such a device")
    assert done.returncode == 2 and not done.stdout
    (line,) = errors(done)
    assert name in line and line.startswith("mdnum: ")


def test_figures_are_drawn_whatever_windows_are_drawn_with():
    code = "import contextlib\nfrom mdnum.cli import main\n"
    code += "with contextlib.suppress(SystemExit): main(['--version'])\nimport mdnum.report.drawing"
    subprocess.run(python("-c", code), env=environment(MPLBACKEND="nonsense"), check=True)


# -- control-C -----------------------------------------------------------------------------------------

AT = """
import importlib.abc, os, signal, sys

class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize(
    "name",
    [
        "typer",
        "jax._src.numpy",
        "mdnum.doctor",
        *(pytest.param(name, marks=pytest.mark.nightly) for name in ("mdnum.cli.commands", "jax")),
    ],
)
def test_control_c_during_an_import_ends_without_a_traceback(tmp_path, name):
    (tmp_path / "sitecustomize.py").write_text(AT.format(name=name))
    path = os.pathsep.join([str(tmp_path), environment().get("PYTHONPATH", "")])
    done = started("doctor", cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == -signal.SIGINT and not errors(done) and not done.stdout


def test_control_c_is_caught_once_there_is_something_to_keep():
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        with CommandBar() as bar:
            assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
            bar(0, 10, {"phase": "run"})
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        # who ignores it, as a job in the background does, goes on to do so
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        bar(0, 10, {"phase": "run"})
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_control_c_becomes_inside_of_an_import_is_known():
    def chained(*kinds: type[BaseException]) -> BaseException:
        caught: BaseException | None = None
        for kind in kinds:
            try:
                try:
                    if caught is not None:
                        raise caught
                finally:
                    raise kind("x")
            except BaseException as error:
                caught = error
        assert caught is not None
        return caught

    assert is_interrupt(chained(KeyboardInterrupt)) and is_interrupt(chained(KeyboardInterrupt, ImportError))
    assert is_interrupt(chained(KeyboardInterrupt, SystemError, RuntimeError))
    assert not is_interrupt(chained(ValueError, ImportError)) and not is_interrupt(None)
    # a mistake that was met on the way out is said
    assert not is_interrupt(chained(KeyboardInterrupt, InputError))
