"""`mdnum doctor`: tests of whether this installation computes correct numbers.

All tests of `mdnum doctor` are computations on the current machine. Package versions with known faults are
also reported. No package version is assumed to be correct.

Error bounds in mdnum assume that +, -, *, / and sqrt are correctly rounded. Sums must not be reordered. On
CPUs, XLA rounds correctly and does not reorder sums. XLA does contract a*b+c and rewrite divisions by
constants. Contractions and rewritten divisions change the last bits of results. Two builds of a program may
therefore decide differently on a pair very close to the cutoff.
"""

from __future__ import annotations

import hashlib
import math
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

import mdnum.numerics  # noqa: F401 (turns on float64)
from mdnum.errors import in_a_line
from mdnum.plain import beside
from mdnum.provenance import version
from mdnum.safe_path import environment, python

Status = Literal["ok", "info", "unsafe"]

#: For each test: its name, the observation by status ("seen" if it is the same for all), and the remedy if
#: unsafe.
_WORDS: dict[str, Any] = beside(__file__)
PACKAGES, PEERS = _WORDS["packages"]["needed"], _WORDS["packages"]["peers"]
DIGEST_CODE, IMPORTS_CODE = _WORDS["digest_code"], _WORDS["imports_code"]
_COUNT = 20_011  # beyond 16,384 elements XLA splits work between threads, by other code paths
_FUNCTION_ULPS = 16
_SIGMA, _EPSILON, _R_CUT, _SKIN = 3.405, 0.0103235, 8.5125, 0.4  # of argon (Å, eV, Å, Å)
_R2_TOLERANCE = 1e-14  # three products and a sum of three: a few units in the last place
_CRYSTAL_TOLERANCE = 1e-12  # 24,000 terms of both signs, summed in any order
_ENERGY_TOLERANCE, _FORCE_TOLERANCE = 1e-12, 1e-10  # the promise of `mdnum check energy`


@dataclass(frozen=True)
class DoctorRow:
    """Result of one test of the installation."""

    name: str  # what was tested
    # "info": changes bits without making them wrong; "unsafe": numbers, or claims about them, may be wrong
    status: Status
    seen: str
    remedy: str | None = None  # what to do, when something should be done


@dataclass(frozen=True)
class Diagnosis:
    """Results of all tests of one installation."""

    rows: tuple[DoctorRow, ...]  # in the order they are worth reading
    seconds: float  # that they took

    @property
    def ok(self) -> bool:
        """True if no test found the installation unsafe."""
        return all(row.status != "unsafe" for row in self.rows)


def diagnose(budget: float = 18.0) -> Diagnosis:
    """Run all tests of this installation.

    Example:
        >>> mdnum.diagnose().ok
        True

    Args:
        budget: seconds after which tests in other processes are abandoned; the tests in this process take
            about six seconds.

    Returns:
        one row per test; `Diagnosis.ok` is False if any test is unsafe.
    """
    start = time.perf_counter()
    other, imported = Child(DIGEST_CODE), Child(IMPORTS_CODE)

    def left() -> float:
        return budget - (time.perf_counter() - start)

    rows = [test() for test in TESTS]
    rows += [second_process(other, digest(), left()), imports(imported, left()), packages()]
    return Diagnosis(tuple(rows), time.perf_counter() - start)


def _row(test: str, status: Status | bool, **values: Any) -> DoctorRow:
    """Return a test result with its text. True stands for "ok", False for "unsafe"."""
    if not isinstance(status, str):
        status = "ok" if status else "unsafe"
    words = _WORDS[test]
    seen = words.get(status, words.get("seen", "")).format(**values)
    return DoctorRow(words["name"], status, seen, words["remedy"] if status == "unsafe" else None)


# --- what is installed ---


def jax_version() -> DoctorRow:
    """Compare the versions of jax and jaxlib with releases known to be faulty."""
    from jaxlib.version import __version__ as library

    # what is imported counts, when metadata and modules differ
    loaded, listed = (jax.__version__, library), (version("jax"), version("jaxlib"))
    seen = f"jax {loaded[0]}, jaxlib {loaded[1]}, Python {platform.python_version()}"
    if loaded != listed:
        seen += f" (pip believes {', '.join(map(str, listed))})"
    known_bad = _WORDS["jax"]["known_bad"]
    bad = [f"{number}: {known_bad[number]}" for number in dict.fromkeys(loaded) if number in known_bad]
    return _row("jax", not bad, seen="; ".join([seen, *bad]))


def flags() -> DoctorRow:
    """Report environment settings that change XLA's results."""
    settings = {
        name: value
        for name, value in sorted(os.environ.items())
        if name == "XLA_FLAGS" or (name.startswith("JAX_") and value)
    }
    if not settings:
        return _row("flags", True)
    seen = ", ".join(f"{name}={value}" for name, value in settings.items())
    fast = re.search(r"xla_cpu_enable_fast_math(=(true|1))?(\s|$)", settings.get("XLA_FLAGS", ""))
    return _row("flags", "unsafe" if fast else "info", seen=seen)


def devices() -> DoctorRow:
    """Report the devices on which jax computes."""
    names = ", ".join(f"{device.platform} ({device.device_kind})" for device in jax.devices())
    return _row("devices", "info", names=names, cores=os.cpu_count())


def packages() -> DoctorRow:
    """Report the versions of all required packages and of installed optional packages."""
    found = {package: version(package) for package in (*PACKAGES, *PEERS)}
    missing = [package for package in PACKAGES if found[package] is None]
    installed = ", ".join(f"{package} {at}" for package, at in found.items() if at)
    return _row("packages", "unsafe" if missing else "info", missing=", ".join(missing), seen=installed)


def numba_works() -> DoctorRow:
    """Test that numba can compile, computes in float64, and does not reorder sums."""
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
        return _row("numba_fails", False, seen=in_a_line(error))
    expected = 0.0
    for value in values.tolist():
        expected += value
    seconds = f"{time.perf_counter() - start:.1f}"
    return _row("numba", got == expected, seconds=seconds, got=repr(got), expected=repr(expected))


# --- is the arithmetic what rounding bounds assume, and which liberties does the compiler take? ---


def _numbers(seed: int, dtype: Any = np.float64) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 20.0, _COUNT).astype(dtype)


def _differing(a: Any, b: Any) -> int:
    return int(np.sum(np.asarray(a) != np.asarray(b)))


def float64() -> DoctorRow:
    """Test that jax uses float64, and keeps float64 numbers unchanged."""
    values = np.array([np.float64(1) / 3, np.pi, 1 + 2**-52, 8.5125, 1e300, -(2.0**-1000)])
    after = np.asarray(jax.jit(lambda x: x)(jnp.asarray(values)))
    kept = after.dtype == np.float64 and after.tobytes() == values.tobytes()
    default, literal = jnp.zeros(()).dtype, jnp.asarray(0.1).dtype
    return _row(
        "float64", kept and default == literal == np.float64, default=default, literal=literal,
        after=after.dtype, kept="unchanged" if kept else "changed",
    )  # fmt: skip


def elementwise() -> DoctorRow:
    """Compare basic operations of jax with numpy, bit for bit, in float64 and float32.

    On accelerators, float32 quotients and square roots may be approximate. Cutoff decisions use other
    operations (`numerics.exact.root`).
    """
    # by name, which numpy and jax share, with the number of arguments
    operations = {
        "add": 2, "subtract": 2, "multiply": 2, "divide": 2, "sqrt": 1, "round": 1, "floor": 1, "less": 2
    }  # fmt: skip
    wrong = []
    for dtype in (np.float64, np.float32):
        for name, arguments in operations.items():
            given = [_numbers(seed, dtype) for seed in (1, 2)][:arguments]
            ours, expected = getattr(jnp, name), getattr(np, name)(*given)
            for mode, function in (("jit", jax.jit(ours)), ("eager", ours)):
                if count := _differing(function(*map(jnp.asarray, given)), expected):
                    wrong.append(f"{name} {np.dtype(dtype).name} {mode}: {count} of {_COUNT}")
    known = all(one.startswith(("divide float32", "sqrt float32")) for one in wrong)
    gpu = bool(wrong) and known and jax.default_backend() != "cpu"
    status: Status | bool = "info" if gpu else not wrong
    return _row("elementwise", status, operations=", ".join(operations), wrong="; ".join(wrong))


def functions() -> DoctorRow:
    """Measure differences between jax and numpy for exp, log, cos and power, in ulp."""
    a, b = _numbers(3), _numbers(4) / 10
    ulps = {}
    for name, given in {"exp": [-a], "log": [a], "cos": [a], "power": [a, b]}.items():
        above = 2.0 if name == "cos" else 0.0  # near a zero of the cosine the last place is a small one
        expected = getattr(np, name)(*given) + above
        ours = jax.jit(lambda *x, function=getattr(jnp, name), above=above: function(*x) + above)
        got = np.asarray(ours(*map(jnp.asarray, given)))
        ulps[name] = float(np.max(np.abs(got - expected) / np.spacing(np.abs(expected))))
    found = ", ".join(f"{name} {value:.3g}" for name, value in ulps.items())
    return _row("functions", all(value <= _FUNCTION_ULPS for value in ulps.values()), found=found)


def reassociation() -> DoctorRow:
    """Test that jax does not reorder sums."""
    x, c = _numbers(5) * 1e-3, np.full(_COUNT, 1e3)

    def two_sum(a: Any, b: Any) -> tuple[Any, Any]:
        s = a + b
        t = s - a
        return s, (a - (s - t)) + (b - t)

    expected = [*two_sum(x, c), (x + c) - c]
    s, e = jax.jit(two_sum)(jnp.asarray(x), jnp.asarray(c))
    folded = jax.jit(lambda a, b: (a + b) - b)(jnp.asarray(x), jnp.asarray(c))
    names = ("sums", "errors", "folded")
    counts = {n: _differing(a, b) for n, a, b in zip(names, (s, e, folded), expected, strict=True)}
    nan = bool(jax.jit(lambda a: jnp.any(a != a))(jnp.asarray([1.0, np.nan])))
    sound, word = not any(counts.values()) and nan, "is" if nan else "is not"
    return _row("reassociation", sound, of=_COUNT, nan=word, **counts)


def contraction() -> DoctorRow:
    """Test whether jit contracts a*b + c to a fused multiply-add."""
    a, b, c = _numbers(6), _numbers(7), -_numbers(8)
    count = _differing(jax.jit(lambda a, b, c: a * b + c)(*map(jnp.asarray, (a, b, c))), a * b + c)
    return _row("contraction", "info" if count else "ok", count=count, of=_COUNT)


def constant_division() -> DoctorRow:
    """Test whether jit replaces x / c by x * (1 / c), and (x*c)*d by x*(c*d)."""
    x = _numbers(9)
    divided = _differing(jax.jit(lambda x: x / 3.0)(jnp.asarray(x)), x / 3.0)
    folded = _differing(jax.jit(lambda x: (x * 0.1) * 0.7)(jnp.asarray(x)), (x * 0.1) * 0.7)
    status: Status = "info" if divided or folded else "ok"
    return _row("constant_division", status, divided=divided, folded=folded, of=_COUNT)


def subnormals() -> DoctorRow:
    """Test whether numpy and jax keep numbers below 2.2e-308, or set them to zero.

    XLA sets subnormal numbers to zero on CPUs. A loaded library can make the processor do this in all
    operations. Arrays that XLA splits among its own threads are tested, too. Results are compared as
    integers, since a comparison of floats may treat subnormal numbers as zero.
    """

    def power(exponent: int, count: int) -> np.ndarray:
        # from its bits, and an argument: nothing here can be folded before it is computed
        bits = 1023 + exponent << 52 if exponent > -1023 else 1 << exponent + 1074
        return np.full(count, bits, np.int64).view(np.float64)

    def word(multiply: Callable[..., Any]) -> str:
        for count in (8, _COUNT):
            # a result that is subnormal, and an argument that is
            for a, b in ((-1000, -60), (-1060, 60)):
                product = np.asarray(multiply(power(a, count), power(b, count)))
                if not np.array_equal(product.view(np.int64), power(a + b, count).view(np.int64)):
                    return "flushed to zero"
        return "kept"

    jitted = jax.jit(lambda a, b: a * b)
    numpy, xla = word(np.multiply), word(lambda a, b: jitted(jnp.asarray(a), jnp.asarray(b)))
    return _row("subnormals", "info", numpy=numpy, xla=xla)


# --- jit against eager against numpy, in the form that jax 0.10.2 gets wrong ---


def _fcc(cells: int) -> np.ndarray:
    """Return the positions of an fcc crystal, shape (4 cells³, 3). The lattice constant is 1."""
    return np.array([place for place in np.ndindex((2 * cells,) * 3) if sum(place) % 2 == 0]) / 2


def tilted_crystal() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a perturbed fcc crystal of 500 argon atoms in a tilted box, and its pairs.

    Returns:
        cell: columns are box vectors (3, 3), Å.
        fractional: positions in units of the cell (500, 3).
        slots: atom indices of the listed pairs (slots, 2), i < j; unused slots contain (500, 500).
    """
    fractional = (_fcc(5) / 5) % 1.0
    fractional = fractional + np.random.default_rng(39103).normal(scale=0.002, size=fractional.shape)
    cell = 5 * 5.26 * np.array([[1.0, 0.12, -0.07], [0.0, 1.0, 0.09], [0.0, 0.0, 1.0]])
    first, second = np.triu_indices(len(fractional), 1)
    separation = fractional[first] - fractional[second]
    r2 = np.sum(((separation - np.round(separation)) @ cell.T) ** 2, axis=1)
    listed = r2 < (_R_CUT + _SKIN) ** 2
    pairs = np.stack([first[listed], second[listed]], axis=1)
    padding = np.full((len(pairs) // 20, 2), len(fractional))
    return cell, fractional, np.concatenate([pairs, padding])


def squared_distances(cell: jax.Array, fractional: jax.Array, slots: jax.Array) -> jax.Array:
    """Compute r² of listed pairs by one matrix-vector product, as in jax-md. Padding gives 0."""
    used = slots[:, 0] < fractional.shape[0]
    index = jnp.where(used[:, None], slots, 0)
    separation = fractional[index[:, 0]] - fractional[index[:, 1]]
    separation = separation - jnp.round(separation)
    r2 = jax.vmap(lambda row: jnp.sum((cell @ row) ** 2))(separation)
    return jnp.where(used, r2, jnp.zeros_like(r2))


def pair_energy(r2: jax.Array) -> jax.Array:
    """Return the Lennard-Jones energy (eV) of the listed pairs inside the cutoff."""
    inside = (r2 > 0) & (r2 < _R_CUT**2)
    inverse = (_SIGMA**2) / jnp.where(inside, r2, jnp.ones_like(r2))
    sixth = inverse * inverse * inverse
    return jnp.sum(jnp.where(inside, 4 * _EPSILON * (sixth * sixth - sixth), jnp.zeros_like(r2)))


def crystal() -> DoctorRow:
    """Compare distances and energy of a tilted crystal in jax with exact sums.

    On CPUs, jax 0.10.2 miscompiles a vmapped matrix-vector product that is followed by a reduction
    (jax-ml/jax#39103). One coordinate of every displacement in a tilted box is then wrong. Only arrays with
    more than 16,384 rows are affected.
    """
    cell, fractional, slots = tilted_crystal()
    used = slots[:, 0] < len(fractional)
    pairs = slots[used]
    separation = fractional[pairs[:, 0]] - fractional[pairs[:, 1]]
    separation -= np.round(separation)
    exact_r2 = np.sum((separation @ cell.T) ** 2, axis=1)
    exact_energy, _ = _lennard_jones(fractional @ cell.T, cell.T, _SIGMA, _EPSILON, _R_CUT)

    arguments = (jnp.asarray(cell), jnp.asarray(fractional), jnp.asarray(slots))
    worst: dict[str, tuple[float, float]] = {}
    for mode, function in (("jit", jax.jit(squared_distances)), ("eager", squared_distances)):
        r2 = np.asarray(function(*arguments))
        energy = jax.jit(pair_energy) if mode == "jit" else pair_energy
        worst[mode] = (
            float(np.max(np.abs(r2[used] - exact_r2) / exact_r2)),
            abs(float(energy(jnp.asarray(r2))) - exact_energy) / abs(exact_energy),
        )
    found = ", ".join(f"{mode}: r² {r2:.1e}, energy {energy:.1e}" for mode, (r2, energy) in worst.items())
    # written so that a NaN is unsafe
    right = all(r2 <= _R2_TOLERANCE and energy <= _CRYSTAL_TOLERANCE for r2, energy in worst.values())
    return _row("crystal", right, atoms=len(fractional), slots=f"{len(slots):,}", found=found)


def digest(steps: int = 50) -> str:
    """Return the SHA-256 digest of a short jitted simulation. All processes must give the same digest.

    Args:
        steps: number of velocity Verlet steps of 32 argon atoms.
    """
    positions = _fcc(2) * 5.26
    positions += np.random.default_rng(7).normal(scale=0.05 * _SIGMA, size=positions.shape)
    box, step = 2 * 5.26, 0.05

    def energy(x: jax.Array) -> jax.Array:
        separation = x[:, None] - x[None, :]
        separation = separation - box * jnp.round(separation / box)
        return 0.5 * pair_energy(jnp.sum(separation * separation, axis=-1))

    def force(x: jax.Array) -> jax.Array:
        return -jax.grad(energy)(x)

    @jax.jit
    def roll(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(_: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, v = state
            half = v + 0.5 * step * force(x)
            x = x + step * half
            return x, half + 0.5 * step * force(x)

        return jax.lax.fori_loop(0, steps, advance, (x, jnp.zeros_like(x)))

    x, v = roll(jnp.asarray(positions))
    return hashlib.sha256(np.asarray(x).tobytes() + np.asarray(v).tobytes()).hexdigest()


# --- mdnum's own energy and forces: system file, neighbor search, decisions, potential and sums ---


def own_forces() -> DoctorRow:
    """Compare mdnum's energy and forces of argon/tilted-500 with a direct sum."""
    try:
        energy, force = worst_errors()
    except Exception as error:  # whatever keeps mdnum from computing forces here is what was asked for
        return _row("own_forces_fail", False, seen=in_a_line(error))
    right = energy <= _ENERGY_TOLERANCE and force <= _FORCE_TOLERANCE
    return _row("own_forces", right, energy=f"{energy:.1e}", force=f"{force:.1e}")


def worst_errors() -> tuple[float, float]:
    """Return the relative energy error, and the largest force error divided by the largest force."""
    from mdnum.systems import build

    simulation = build("argon/tilted-500")
    ours, constants = simulation.evaluate(), simulation.potential.constants(0)
    cell = simulation.structure.cell.array
    energy, forces = _lennard_jones(
        simulation.positions, cell, constants["sigma"], constants["epsilon"], simulation.r_cut
    )
    force = float(np.max(np.abs(ours.forces - forces)) / np.max(np.abs(forces)))
    return abs(ours.energy - energy) / abs(energy), force


def _lennard_jones(
    positions: np.ndarray, cell: np.ndarray, sigma: float, epsilon: float, r_cut: float
) -> tuple[float, np.ndarray]:
    """Compute Lennard-Jones energy and forces by a direct sum over pairs and images."""
    terms: list[np.ndarray] = []
    forces = np.zeros_like(positions)
    fractional = positions @ np.linalg.inv(cell)
    home = positions - np.floor(fractional) @ cell
    for shift in np.ndindex(3, 3, 3):
        away = home[:, None] - home[None, :] + (np.array(shift) - 1) @ cell
        r2 = np.sum(away * away, axis=-1)
        inside = (r2 < r_cut**2) & (r2 > 0)
        sixth = (sigma**2 / r2[inside]) ** 3
        terms.append(2 * epsilon * (sixth * sixth - sixth))
        push = np.zeros_like(r2)
        push[inside] = 24 * epsilon * (2 * sixth * sixth - sixth) / r2[inside]
        forces += np.sum(push[..., None] * away, axis=1)
    return math.fsum(np.concatenate(terms)), forces


# --- other processes ---


class Child:
    """A Python process that runs code in the background and prints one line."""

    def __init__(self, code: str):
        pipe: Any = subprocess.PIPE
        self.process = subprocess.Popen(
            python("-c", code), stdout=pipe, stderr=pipe, text=True, env=environment()
        )

    def answer(self, seconds: float) -> tuple[str | None, str]:
        """Wait at most `seconds`. Return (output, "") or (None, reason for missing output)."""
        try:
            out, err = self.process.communicate(timeout=max(seconds, 0.1))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            return None, _LATE
        if self.process.returncode or not out.strip():
            return None, (err.strip().splitlines() or ["it printed nothing"])[-1]
        return out.strip().splitlines()[-1], ""


_LATE = "no answer in time"


def imports(child: Child, seconds: float) -> DoctorRow:
    """Test whether jax_md can be imported, and measure the time."""
    answer, why = child.answer(seconds)
    status = "info" if why == _LATE else answer is not None
    return _row("imports", status, seen=answer or why)


def second_process(child: Child, here: str, seconds: float) -> DoctorRow:
    """Test that a jitted simulation gives the same bits in another process."""
    answer, why = child.answer(seconds)
    status = "info" if why == _LATE else answer == here
    return _row("second_process", status, here=here[:12], there=answer[:12] if answer else why)


#: Tests of this process, in the order of the report.
TESTS = (
    jax_version, flags, devices, float64, crystal, elementwise, functions, reassociation, contraction,
    constant_division, subnormals, numba_works, own_forces,
)  # fmt: skip
