"""Record of the software and the machine of a run, which helps to explain differences between runs.

Two runs of the same system file and structure should agree bit for bit if their fingerprints agree. The
fingerprint includes versions, instruction sets and devices. XLA's flags, jax's settings and dtypes are also
included.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from mdnum.plain import beside

_RECORDED: dict[str, list[str]] = beside(__file__)  # names of what is recorded


class _System(Protocol):
    """Protocol with the attributes of a system that this module needs."""

    @property
    def name(self) -> str: ...
    @property
    def program(self) -> dict[str, Any]: ...
    @property
    def path(self) -> Path | None: ...


def collect(system: _System) -> dict[str, Any]:
    """Return the software, hardware and settings on which a run depends, and hashes of its input.

    Returns:
        a mapping of plain values, ready for JSON.
    """
    import jax

    import mdnum.numerics  # noqa: F401 (float64 is among the settings recorded)

    around = surroundings()
    versions, processor = around["versions"], around["cpu"]
    devices = [{"platform": device.platform, "kind": device.device_kind} for device in jax.devices()]
    settings = {name: getattr(jax.config, name, None) for name in _RECORDED["jax_settings"]}
    environment = {
        name: value for name, value in sorted(os.environ.items()) if name.startswith(("XLA_", "JAX_"))
    }
    dtypes = system.program.get("precision", {})
    return {
        **{name: around[name] for name in ("started", "command", "folder")},
        "system": system.name,
        "hashes": hashes(system),
        "dtypes": dtypes,
        **{name: around[name] for name in ("versions", "python", "platform", "cpu")},
        "devices": devices,
        "jax_settings": settings,
        "environment": environment,
        "commit": around["commit"],
        "fingerprint": fingerprint(
            {
                "versions": {name: versions.get(name) for name in _RECORDED["arithmetic"]},
                "machine": platform.machine(),
                "flags": processor["flags"],
                "devices": devices,
                "jax_settings": settings,
                "xla_flags": os.environ.get("XLA_FLAGS", ""),
                "dtypes": dtypes,
            }
        ),
    }


def surroundings() -> dict[str, Any]:
    """Return time, command, machine and software versions, for computations without jax."""
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(sys.argv),
        "folder": str(Path.cwd()),
        "versions": package_versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu(),
        "commit": commit(Path(__file__).resolve().parent),
    }


def fingerprint(parts: Mapping[str, Any]) -> str:
    """Return a short hash of the values that determine the arithmetic.

    Args:
        parts: plain values; the order of keys does not matter.
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def package_versions() -> dict[str, str | None]:
    """Return the versions of packages on which results can depend. None means not installed."""
    return {package: version(package) for package in _RECORDED["packages"]}


def version(package: str) -> str | None:
    """Return the installed version of a package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu(cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, Any]:
    """Return the processor's name, number of cores, and instruction sets that affect rounding.

    Args:
        cpuinfo: Linux's description of the processor; other systems use Python's `platform`.

    Returns:
        model, cores, flags; flags is None if unknown.
    """
    fields: dict[str, str] = {}
    if cpuinfo.exists():
        for line in cpuinfo.read_text(errors="replace").splitlines():
            key, colon, value = line.partition(":")
            if colon:
                fields.setdefault(key.strip().lower(), value.strip())
    words = fields.get("flags", fields.get("features", "")).split()
    return {
        "model": fields.get("model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "flags": [flag for flag in _RECORDED["processor_flags"] if flag in words] if words else None,
    }


def hashes(system: _System) -> dict[str, str | None]:
    """Return SHA-256 digests of the system file, of its settings, and of the structure.

    The settings are all parameters except the structure, with defaults and overrides. The hash of the
    settings depends on every value, but not on the system's name. The structure is hashed as numbers
    (species, masses, positions, velocities, cell, periodicity). The same atoms in another file format
    therefore have the same hash.

    Returns:
        digests by name: file (None without a system file), program, and structure (None without atoms).
    """
    file = None
    if system.path is not None and Path(system.path).is_file():
        file = hashlib.sha256(Path(system.path).read_bytes()).hexdigest()
    program = hashlib.sha256(json.dumps(system.program, sort_keys=True).encode()).hexdigest()
    atoms = getattr(system, "structure", None) or getattr(system, "atoms", None)
    if atoms is None:
        return {"file": file, "program": program, "structure": None}
    digest = hashlib.sha256()
    for name, array in (
        ("numbers", atoms.get_atomic_numbers()),
        ("masses", atoms.get_masses()),
        ("positions", atoms.get_positions()),
        ("momenta", atoms.get_momenta()),
        ("cell", atoms.cell.array),
        ("pbc", atoms.pbc),
    ):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return {"file": file, "program": program, "structure": digest.hexdigest()}


def commit(package: Path) -> str | None:
    """Return the git commit of a package's source, with "+" if source files have changed.

    Programs that a git repository can configure (monitors, hooks, filters) are not run.

    Returns:
        None for an installed wheel, without git, or if the folder belongs to another repository.
    """

    settings = ["core.fsmonitor=false", f"core.hooksPath={os.devnull}", "protocol.allow=never"]
    environment = {key: value for key, value in os.environ.items() if key not in _RECORDED["git_elsewhere"]}
    environment |= {"GIT_OPTIONAL_LOCKS": "0", "GIT_NO_LAZY_FETCH": "1"}

    def git(*words: str) -> str | None:
        command = ["git", *(word for one in settings for word in ("-c", one)), "-C", str(package), *words]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=10, check=False, env=environment
            )
        except (OSError, subprocess.TimeoutExpired):
            return None  # no git here: a commit is worth knowing, not worth failing for
        return done.stdout.strip() if done.returncode == 0 else None

    # an environment inside somebody's repository is not mdnum's repository
    if not git("ls-files", "--", "provenance.py"):
        return None
    head = git("rev-parse", "HEAD")
    if head is None:
        return None
    filters = git("config", "--name-only", "--get-regexp", r"^filter\..*") or ""
    if "=" in filters:
        return None  # a name that cannot be set to nothing, and that no repository of mdnum's has
    settings += [f"{one}={'false' if one.endswith('.required') else ''}" for one in filters.splitlines()]
    status = ("status", "--porcelain", "--untracked-files=no", "--ignore-submodules=all", "--", ".")
    return head + ("+" if git(*status) else "")
