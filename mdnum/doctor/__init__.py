"""`mdnum doctor`: can the numbers that this installation computes be trusted?

Everything is found out by computing on the machine at hand. A version known to be bad is named too,
but a version is not evidence of the contrary.
"""

from __future__ import annotations

import time

from mdnum.doctor.rows import Diagnosis as Diagnosis
from mdnum.doctor.rows import Row as Row


def diagnose(budget: float = 18.0) -> Diagnosis:
    """Test this installation.

    Args:
        budget: seconds after which the tests in other processes are given up; those in this process
            take about six.

    Returns:
        A row per test. `Diagnosis.ok` is false when one is unsafe.
    """
    from mdnum.doctor import arithmetic, crystal, installation, own

    start = time.perf_counter()
    digest = installation.Child.start(installation.DIGEST_CODE)
    imports = installation.Child.start(installation.IMPORTS_CODE)

    def left() -> float:
        return budget - (time.perf_counter() - start)

    rows = [
        installation.jax_version(),
        installation.flags(),
        installation.devices(),
        arithmetic.float64(),
        crystal.trap(),
        arithmetic.elementwise(),
        arithmetic.functions(),
        arithmetic.reassociation(),
        arithmetic.contraction(),
        arithmetic.constant_division(),
        arithmetic.subnormals(),
        installation.numba_works(),
        own.forces(),
        installation.second_process(digest, crystal.digest(), left()),
        installation.imports(imports, left()),
        *installation.versions(),
    ]
    return Diagnosis(tuple(rows), time.perf_counter() - start)
