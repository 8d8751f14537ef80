"""Every example runs as it stands, in a folder of its own, and is short."""

from __future__ import annotations

import os
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest

from mdnum.safe_path import environment, python

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))


#: Their paths through the package are those of other tests: of objects, of the verbs and of terms.
_LONG = ("fork", "graph_network", "jax_md_recorder", "morse", "pair_network", "two_terms")
#: What they need beside mdnum; where it has to be, a skip would be a failure.
_NEEDS = {"ace_potential": ("ace_jax", "ace_jax_coupling"), "mlip_network": ("mlip",)}
_NEEDED = os.environ.get("MDNUM_TEST_LEARNED") == "on"


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.nightly] * (path.stem in (*_LONG, *_NEEDS)))
        for path in EXAMPLES
    ],
)
def test_an_example_runs_and_says_something(path, tmp_path):
    assert len(path.read_text().splitlines()) < 50
    missing = [name for name in _NEEDS.get(path.stem, ()) if find_spec(name) is None]
    if missing and not _NEEDED:
        pytest.skip(f"{missing[0]} is not installed")
    done = subprocess.run(
        python(str(path)), cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    words = done.stdout.split()
    assert len(words) > 3 and list((tmp_path / "runs").iterdir())
    if path.stem in _NEEDS:
        # ASE agrees; a gradient and differences
        assert "True" in words and float(words[-2]) == pytest.approx(float(words[-1]), rel=1e-4)


def test_there_are_examples():
    assert len(EXAMPLES) >= 3
