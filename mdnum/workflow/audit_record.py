"""What an audit folder holds: curves and runs as tables, structures, a script, and summary.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.references.findings import plain
from mdnum.store import RunFolder
from mdnum.store.atomic import subfolder, write_text

if TYPE_CHECKING:
    from ase import Atoms

    from mdnum.audit.base import Part
    from mdnum.audit.verdict import Judgment

#: Where structures are kept that show a finding.
STRUCTURES = "structures"
#: Shows the findings again without mdnum.
SCRIPT = "reproduce.py"


def write_parts(folder: RunFolder, parts: Sequence[Part]) -> None:
    """Puts the curves of all parts into the folder."""
    for part in parts:
        for number, curve in enumerate(part.curves):
            for line, values in curve.lines.items():
                count = len(curve.x)
                folder.append(
                    "curves",
                    {
                        "part": np.full(count, part.name),
                        "curve": np.full(count, curve_name(part.name, number)),
                        "line": np.full(count, line),
                        "x": np.asarray(curve.x, np.float64),
                        "y": np.asarray(values, np.float64),
                    },
                )


def write_structures(folder: Path, structures: Mapping[str, Atoms]) -> None:
    """Puts structures into the folder to the last bit."""
    from mdnum.audit.subject import exact_extxyz

    if structures:
        subfolder(folder, STRUCTURES)
    for name, atoms in structures.items():
        write_text(folder / STRUCTURES / f"{name}.extxyz", exact_extxyz(atoms))


def curve_name(part: str, number: int) -> str:
    """The name of a curve in curves.parquet, and of its figure."""
    return f"{part}-{number + 1}"


def summary_of(part: Part) -> dict[str, Any]:
    """A part as summary.json tells it: all but the points of its curves."""
    return {
        "name": part.name,
        "title": part.title,
        "says": part.says,
        "findings": plain(list(part.findings)),
        "tables": plain(dict(part.tables)),
        "numbers": plain(dict(part.numbers)),
        "skipped": [{"what": what, "why": why} for what, why in part.skipped],
        "curves": [
            {
                "name": curve_name(part.name, number),
                "title": curve.title,
                "x_label": curve.x_label,
                "y_label": curve.y_label,
                "lines": list(curve.lines),
                "marks": plain(dict(curve.marks)),
                "log_y": curve.log_y,
            }
            for number, curve in enumerate(part.curves)
        ],
        "seconds": part.seconds,
    }


def summarize(
    name: str, atoms: Atoms, kT: float, units: tuple[str, str], parts: Sequence[Part], judgment: Judgment
) -> dict[str, Any]:
    """The content of summary.json, without what the report adds."""
    return {
        "world": "audit",
        "question": "audit",
        "system": name,
        "calculator": name,
        "atoms": len(atoms),
        "formula": atoms.get_chemical_formula(),
        "periodic": [bool(one) for one in atoms.pbc],
        "kT": kT,
        "units": {"length": units[0], "energy": units[1]},
        "safe_to_run": judgment.run,
        "safe_to_differentiate": judgment.differentiate,
        "headline": judgment.headline,
        "evidence": list(judgment.evidence),
        "parts": [summary_of(part) for part in parts],
        "left_out": [
            {"what": what, "why": why, "part": part.name} for part in parts for what, why in part.skipped
        ],
        "findings": [plain(dict(one)) for part in parts for one in part.findings],
        "status": "complete",
    }


def stop(summary: dict[str, Any], during: str, wanted: Sequence[str]) -> None:
    """Makes a summary that of an audit which somebody stopped.

    Args:
        summary: of the checks that were done; changed in place.
        during: the check that was not finished.
        wanted: all checks, in their order.
    """
    summary["status"] = "stopped"
    summary["headline"] = f"Stopped during {during}. {summary['headline']}"
    missing = wanted[wanted.index(during) :]
    rest = [{"what": f"the check of {name}", "why": "stopped", "part": name} for name in missing]
    summary["left_out"] = rest + summary["left_out"]


def script(words: str, pairs: Sequence[str]) -> str:
    """A program that shows, with ASE alone, that structures which are the same have different answers.

    Args:
        words: the calculator as it was named.
        pairs: names of structures without "-before" and "-after".
    """
    lines = [
        '"""Two ways of writing down one structure, and what the calculator says to each; run it here."""',
        "",
        "import numpy as np",
        "from ase.io import read",
        "",
        *_making(words),
        "",
        "",
        f"for name in {list(pairs)!r}:",
        "    found = []",
        '    for when in ("before", "after"):',
        f'        atoms = read(f"{STRUCTURES}/{{name}}-{{when}}.extxyz")',
        "        atoms.calc = make()",
        "        found.append((float(atoms.get_potential_energy()), atoms.get_forces()))",
        "    (first, forces), (second, others) = found",
        "    second /= len(others) // len(forces)",
        '    print(f"{name}: {first!r} and {second!r} eV, differ by {second - first:.3g} eV")',
        "    # the largest force has no direction and no order",
        "    largest, other = (np.linalg.norm(one, axis=1).max() for one in (forces, others))",
        '    print(f"    largest force {largest!r} and {other!r} eV/Å, "',
        '          f"differ by {other - largest:.3g} eV/Å")',
        "",
    ]
    return "\n".join(lines)


def _making(words: str) -> list[str]:
    """Lines that define make()."""
    head, separator, after = words.partition(".py:")
    if words.endswith(".py") or separator:
        path = Path(words if not separator else f"{head}.py").resolve()
        found = f"made[{after.partition('(')[0]!r}]" if after else ""
        call = f"    return {found}{after[after.find('('):] if '(' in after else ''}" if after else (
            '    return made.get("calculator") or made.get("calc") or made["make"]()'
        )  # fmt: skip
        return ["import runpy", "", "", "def make():", f"    made = runpy.run_path({str(path)!r})", call]
    if ":" in words:
        module, _, call = words.partition(":")
        call = call.strip() if "(" in call else f"{call.strip()}()"
        return [f"import {module.strip()}", "", "", "def make():", f"    return {module.strip()}.{call}"]
    return ["import mdnum", "", "", "def make():", f"    return mdnum.MdnumCalculator({words!r})"]
