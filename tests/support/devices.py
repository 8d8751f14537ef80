"""What depends on the device that jax computes on."""

from __future__ import annotations

import jax
import pytest

#: Of tests of what only XLA for CPUs does: the compiled loops, and roundings that fusions leave out.
on_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="about XLA on a CPU")
