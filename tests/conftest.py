"""What every test runs under: strict dtypes, checked shapes, no cached programs, no deadlines."""

from __future__ import annotations

import os
from collections.abc import Iterator

# a program compiled by another run must not answer for this one
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

import hypothesis
import jax
import jaxtyping
import pytest
import typing_rules

# Annotations are checked when a function is called. Not those of the command line and the report: they
# import slow packages lazily, so their annotations name what is not imported yet.
_CHECKED = [
    "mdnum.precision",
    "mdnum.events",
    "mdnum.md",
    "mdnum.ball",
    "mdnum.dynamics",
    "mdnum.store",
    "mdnum.systems",
    "mdnum.rollout",
    "mdnum.forks",
    "mdnum.gradients",
    "mdnum.doctor",
]
typing_rules.keep_numba_whole()
jaxtyping.install_import_hook(_CHECKED, "typing_rules.check")

# compiling takes seconds and happens in the first example
hypothesis.settings.register_profile(
    "mdnum",
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
hypothesis.settings.load_profile("mdnum")


@pytest.fixture(autouse=True)
def strict_dtypes(request: pytest.FixtureRequest) -> Iterator[None]:
    """Mixing dtypes without a cast is an error, except where jax-md's own code runs."""
    promotion = "standard" if request.node.get_closest_marker("jax_md") else "strict"
    with jax.numpy_dtype_promotion(promotion):
        yield
