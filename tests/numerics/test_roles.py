"""Which dtype a role has, and what is refused."""

from __future__ import annotations

import ml_dtypes
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.numerics import PrecisionPolicy, RolePrecision


def test_every_role_can_have_its_own_dtype():
    policy = RolePrecision("float16", "bfloat16", "float32", "float64", "float16")
    seen = [policy.dtype(role) for role in ("state", "arithmetic", "decision", "accumulate", "loss")]
    assert seen == [np.float16, ml_dtypes.bfloat16, np.float32, np.float64, np.float16]
    assert RolePrecision().dtype("state") == np.float64
    assert RolePrecision.all("bfloat16").dtype("loss") == ml_dtypes.bfloat16


def test_what_no_float_is_called_is_refused():
    with pytest.raises(InputError, match=r"precision\.decision.*'half'.*known are.*bfloat16"):
        RolePrecision(decision="half")
    with pytest.raises(InputError, match=r"precision\.rounding.*'up'.*nearest, stochastic"):
        RolePrecision(rounding="up")
    with pytest.raises(InputError, match=r"precision\.seed"):
        RolePrecision(seed=-1)


def test_sixteen_bits_are_for_pair_forces_alone():
    assert PrecisionPolicy(state="float32").dtype("state") == np.float32
    short = PrecisionPolicy(decision="float32", force="bfloat16")
    assert short.dtype("force") == ml_dtypes.bfloat16 and short.geometry == np.float32
    assert PrecisionPolicy(decision="float64", force="float32").geometry == np.float32
    for role in ("state", "decision", "accumulate"):
        with pytest.raises(InputError, match=rf"precision\.{role}.*bfloat16 cannot be.*precision.force"):
            PrecisionPolicy(**{role: "bfloat16"})
    with pytest.raises(InputError, match=r"precision\.force.*'half'.*known are.*bfloat16"):
        PrecisionPolicy(force="half")
