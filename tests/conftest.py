"""What every test runs under: strict dtypes, checked shapes, no programs of another run, no deadlines."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest
import typing_rules

from mdnum.cli import programs_folder


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rewrite-goldens", action="store_true", help="write the records of tests/goldens anew")


# further cases of a test that take half a second or more, and tests whose subject another one has too
_NIGHTLY = Path(__file__).with_name("nightly.txt")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the cases that nightly.txt lists as nightly.

    Without workers, a line that names no case of the files given, or no file, is an error; the nightly looks.
    """
    listed = set(_NIGHTLY.read_text().splitlines())
    for item in items:
        if item.nodeid in listed:
            item.add_marker("nightly")
    if hasattr(config, "workerinput"):
        return
    read = {item.nodeid.split("::")[0] for item in items}
    gone = {
        name
        for name in listed - {item.nodeid for item in items}
        if (file := name.split("::")[0]) in read or not (config.rootpath / file).exists()
    }
    if gone and not any("::" in word for word in config.args):
        raise pytest.UsageError(f"{_NIGHTLY.name} lists cases that are not there: {', '.join(sorted(gone))}")


def _share_programs() -> None:
    """Let workers and child processes of one run share what they compile, in a new folder.

    A program compiled by another run must not answer for this one. CI names one folder for its two calls.
    """
    name = "MDNUM_TEST_PROGRAMS"
    if name not in os.environ:
        os.environ[name] = tempfile.mkdtemp(prefix="mdnum-programs-")
        atexit.register(shutil.rmtree, os.environ[name], ignore_errors=True)
    for option, value in (
        # where the command line, too, keeps what it compiles under this name
        ("jax_compilation_cache_dir", os.path.join(os.environ[name], programs_folder())),
        ("jax_persistent_cache_min_compile_time_secs", 0),
        ("jax_persistent_cache_min_entry_size_bytes", -1),
    ):
        jax.config.update(option, value)
        # child processes read the environment
        os.environ[option.upper()] = str(value)


_share_programs()

# Annotations are checked when a function is called. Not those of the command line and the report: they
# import slow packages lazily, so their annotations name what is not imported yet.
_CHECKED = [
    "mdnum.numerics",
    "mdnum.md",
    "mdnum.ball",
    "mdnum.program",
    "mdnum.store",
    "mdnum.systems",
    "mdnum.rollout",
    "mdnum.forks",
    "mdnum.gradients",
    "mdnum.trajectories",
    "mdnum.doctor",
]
# The checks take a quarter of the time, and a user's run has none: a plain pytest has them, and the nightly;
# the gate has not.
if os.environ.get("MDNUM_TEST_TYPES") != "off":
    typing_rules.keep_numba_whole()
    typing_rules.check_lazily()
    jaxtyping.install_import_hook(_CHECKED, "typing_rules.check")

# compiling takes seconds and happens in the first example
hypothesis.settings.register_profile(
    "mdnum",
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
hypothesis.settings.load_profile("mdnum")


def pytest_collection_finish() -> None:
    """Look for cycles rarely, as `mdnum.cli.main` does, from the first test on, and not among modules.

    A tenth of the time of what traces and compiles went into that.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(1_000_000, 20, 20)


#: Every compiled program takes pages of memory of its own; Linux gives a process 65,530 maps and the
#: compiler crashes without a word when they are used up.
_MAPS = 25_000


@pytest.fixture(autouse=True, scope="module")
def room_for_programs() -> Iterator[None]:
    """Let go of the programs of earlier files before there are too many of them."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True)
def strict_dtypes(request: pytest.FixtureRequest) -> Iterator[None]:
    """Mixing dtypes without a cast is an error, except where jax-md's own code runs."""
    promotion = "standard" if request.node.get_closest_marker("jax_md") else "strict"
    with jax.numpy_dtype_promotion(promotion):
        yield


@pytest.fixture
def strangers_folder(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Path]:
    """The current folder, in which files with the names of packages tell that they were run."""
    folder = tmp_path_factory.mktemp("stranger")
    ran = folder / "ran"
    packages = "jax numpy ase pydantic typer typing_extensions vesin matplotlib loky cloudpickle"
    for name in packages.split():
        (folder / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').write('{name} ')\nraise ImportError\n")
    monkeypatch.chdir(folder)
    yield folder
    assert not ran.exists(), f"run beside a stranger's files: {ran.read_text()}"
