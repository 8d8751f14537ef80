"""Every example runs as it stands, in a folder of its own, and is short."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from mdnum.safe_path import environment, python

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))


#: Their paths through the package are those of other tests: of objects, of the verbs and of terms.
_LONG = ("fork", "graph_network", "jax_md_recorder", "morse", "pair_network", "two_terms")


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.nightly] * (path.stem in _LONG))
        for path in EXAMPLES
    ],
)
def test_an_example_runs_and_says_something(path, tmp_path):
    assert len(path.read_text().splitlines()) < 50
    done = subprocess.run(
        python(str(path)), cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) > 3 and list((tmp_path / "runs").iterdir())


def test_there_are_examples():
    assert len(EXAMPLES) >= 3
