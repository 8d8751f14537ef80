"""Trial calls of a user's energy function at one configuration.

One compiled function computes energy and derivatives. Another function computes only the energy, for a list
with more padding. The functions are compiled with few optimizations, because they are rarely called.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError, in_a_line
from mdnum.md import jaxmd
from mdnum.md.cell import complete, displacement, wrap_positions
from mdnum.md.energies import Call, EnergyFunction
from mdnum.numerics.jaxprs import Operation, first_not_finite, narrows
from mdnum.plain import beside
from mdnum.systems.simulation import Simulation

_TEXTS = beside(__file__)
FORMATS: tuple[jaxmd.Format, ...] = ("dense", "sparse", "ordered-sparse")
#: Relative difference below which energies count as equal, by whether all arithmetic is in double precision.
SAME = {True: 1e-9, False: 1e-5}
#: Additional padding slots, which must not change any energy.
_MORE = 8


class AdmissionError(InputError):
    """Error for an energy function that cannot be simulated, with its reason (`code`) and `values`."""

    def __init__(self, code: str, name: str, **values: Any):
        entry = _TEXTS[code]
        super().__init__(entry["text"].format(**values), remedy=entry["remedy"].format(**values), where=name)
        self.code, self.values = code, values


class Trial:
    """Trial calls of an energy function at one configuration.

    Args:
        atoms: number of atoms in the trial: those closest to the first atom, in the box of the whole
            structure.

    Attributes:
        model: the energy function with the properties found so far.
        notes: notes on the function: values by code.
        scale: magnitude of the energy, once known.
        idx, inside: neighbors within cutoff and skin, and within the cutoff; as wide as the fullest row.
    """

    def __init__(self, simulation: Simulation, atoms: int):
        self.model: EnergyFunction = simulation.model
        self.notes: dict[str, dict[str, Any]] = {}
        self.simulation = simulation
        unknown, known = set(simulation.symbols) - set(self.model.species), ", ".join(self.model.species)
        if known and unknown:
            raise self.error("UNKNOWN_SPECIES", unknown=", ".join(sorted(unknown)), known=known)
        self.pbc = np.array(simulation.pbc)
        self.cell = complete(np.asarray(simulation.cell.matrix), self.pbc)
        self.x, _ = wrap_positions(simulation.cell, simulation.positions)
        self.box, self.width = simulation.cell, float(np.min(simulation.cell.widths))
        skin = min(max(simulation.rule.skin, 0.1 * simulation.r_cut), self.width / 2 - simulation.r_cut)
        table = simulation.verlet_list(skin).build(self.x, simulation.cell)
        # the list in the order of the structure; the skin, and slots that hold nothing
        names = np.append(table.order, len(self.x)).astype(np.int32)
        self.idx = np.full((len(self.x), table.slots), len(self.x), np.int32)
        self.idx[table.order] = names[table.index].T
        if atoms < len(self.x):
            d = displacement(self.box, self.x, self.x[:1])
            kept = np.sort(np.argsort(sum(c * c for c in d))[:atoms])
            place = np.full(len(self.x) + 1, atoms, np.int32)
            place[kept] = np.arange(atoms)
            self.x, self.idx = self.x[kept], place[self.idx[kept]]
        self.n, self.scale = len(self.x), 0.0
        # pairs of neighbors go as the square of the padding, and two slots of it are a pair
        self.idx = np.sort(self.within(self.idx, self.x, self.model.r_cut + skin), axis=1)
        self.idx = self.idx[:, : max(2, int((self.idx < self.n).sum(axis=1).max()) + 2)]
        self.inside = self.within(self.idx, self.x, self.model.r_cut)
        self._lists()
        self._compile()

    def error(self, code: str, **values: Any) -> AdmissionError:
        """Create the error that explains why the function cannot be simulated."""
        return AdmissionError(code, self.model.name, **values)

    @property
    def call(self) -> Call:
        """The energy function, with its calling convention as far as it is known."""
        return self.model.call

    def learn(self, **found: Any) -> None:
        """Store newly found properties of the energy function's calling convention."""
        self.model = replace(self.model, function=replace(self.call, how=replace(self.call.how, **found)))

    # --- the programs ---------------------------------------------------------------------------------

    def _lists(self) -> None:
        """Find the list format of the energy function. Initialize the parameters of the function."""
        model, lists, own = self.model, self.model.lists, None
        if lists is not None:
            for x in (self.x / self.call.length, self.x @ np.linalg.inv(self.cell)):
                try:
                    own = lists.allocate(jnp.asarray(x))
                    break
                except Exception as error:
                    self.notes["LIST_FAILED"] = {"error": in_a_line(error)}
        if own is not None:
            self.notes.pop("LIST_FAILED", None)
            form = own.format.name.replace("dS", "d-S").lower()
            here, other = (np.arange(self.n)[:, None], own.idx) if form == "dense" else own.idx
            itself = bool(np.any((np.asarray(here) == np.asarray(other)) & (np.asarray(other) < self.n)))
            # an image of an atom is another one
            model = replace(model, self_edges=itself and not self.call.how.images)
            # what is asked for is given
            model = replace(model, format=form) if model.format == "any" else model
        self.model = model
        if model.start is not None and not jax.tree.leaves(model.parameters):
            key, x = jax.random.PRNGKey(self.simulation.draw.seed), jnp.asarray(self.x / self.call.length)
            if own is None:
                form = FORMATS[0] if model.format == "any" else model.format
                own = jaxmd.as_neighbor_list(self.idx, x, form)
            self.model = replace(model, parameters=model.start(key, x, own))

    def bare(self, parameters, x, idx, real, cell, box, strain, code):
        """Call the energy function in its calling convention. The energy is in the unit of the function."""
        call, model = self.call, self.model
        neighbor = jaxmd.as_neighbor_list(idx, real, model.format, model.self_edges, code)
        if call.how.images:
            neighbor = jaxmd.multi_image(neighbor, real, cell, box)
        return call.bare(parameters, x, neighbor, {"cell": cell, "box": box, "perturbation": strain})

    def arguments(self, idx=None, x=None, cell=None, code=0) -> tuple[Any, ...]:
        """Convert positions and box to arguments of the energy function."""
        call, how = self.call, self.call.how
        idx, x, cell = (
            own if one is None else one for one, own in ((idx, self.inside), (x, self.x), (cell, self.cell))
        )
        real, cell = x / call.length, cell / call.length
        # a function that follows cell= must do so alone
        box = self.cell.T / call.length if how.box == "cell" else cell if how.box == "rows" else cell.T
        x = real @ np.linalg.inv(cell) if how.fractional else real
        given = (x, idx, real, cell, box, np.eye(3), np.uint8(code))
        return (self.model.parameters, *map(jnp.asarray, given))

    def _compile(self) -> None:
        """Find a list format and keywords for the energy function. Compile energy and derivatives."""
        formats = FORMATS if self.model.format == "any" else (self.model.format,)
        words, failed = self.call.how.keywords, ""
        # a space of jax-md may raise at a keyword that the function passes on
        sets = [tuple(w for w in words if w != left) for left in ("", "box", "cell", "perturbation")]
        for form, keywords in product(formats, dict.fromkeys([*sets, ()])):
            self.model = replace(self.model, format=form)
            self.learn(keywords=keywords, returns="")
            try:
                self.learn(returns=self._returned())
                every = jax.jit(jax.value_and_grad(self.bare, argnums=(1, 4, 5, 6)))
                traced = every.trace(*self.arguments())
                self.double, self.slopes = not narrows(traced.jaxpr), _quick(traced)
                return
            except AdmissionError:
                raise
            except Exception as error:
                failed = failed or in_a_line(error)
        raise self.error("NOT_CALLABLE", error=failed, tried=", ".join(formats))

    def _returned(self) -> str:
        """Return the kind of result of the energy function: a value of `Convention.returns`."""
        shape = jax.tree.map(lambda one: one.shape, jax.eval_shape(self.bare, *self.arguments()))
        one = ((), (1,))
        if isinstance(shape, Mapping):
            kind = next((key for key in ("total", "energy") if shape.get(key) in one), "")
        else:
            kind = "number" if shape in one else "atoms" if shape == (self.n,) else ""
        if not kind:
            raise self.error("NO_ENERGY", seen=f"{shape!r}")
        return kind

    @cached_property
    def _alone(self) -> tuple[Any, Any]:
        """The energy function compiled for more padding, and its traced operations."""
        traced = jax.jit(self.bare).trace(*self.arguments(self._padded(self.inside)))
        return _quick(traced), traced.jaxpr

    @property
    def jaxpr(self) -> Any:
        """Traced operations (jaxpr) of the energy function."""
        return self._alone[1]

    def _padded(self, idx) -> Int[np.ndarray, "atoms slots"]:
        return np.concatenate([idx, np.full((self.n, _MORE), self.n, np.int32)], axis=1)

    # --- calling it -----------------------------------------------------------------------------------

    def there(self, x=None, idx=None, cell=None, code=0) -> tuple[float, Float[np.ndarray, "atoms 3"]]:
        """Compute energy and forces in the simulation's units; see `arguments` for the parameters."""
        how, call, cell = self.call.how, self.call, self.cell if cell is None else cell
        energy, (slope, *_) = self.slopes(*self.arguments(idx, x, cell, code))
        honest = how.fractional and not how.real_slope
        by_x = np.linalg.inv(cell).T if honest else np.eye(3) / call.length
        return float(energy) * call.unit, -np.asarray(slope) @ by_x * call.unit

    def energy(self, x=None, idx=None, cell=None) -> float:
        """Compute only the energy, in a quarter of the time of energy and forces."""
        idx = self._padded(self.inside if idx is None else idx)
        return float(self._alone[0](*self.arguments(idx, x, cell))) * self.call.unit

    def without_itself(self) -> float:
        """Compute the energy with a list without self-pairs."""
        model, arguments = self.model, self.arguments()
        self.model = replace(model, self_edges=False)
        # not the method, whose earlier trace would be taken
        made = _quick(jax.jit(lambda *all: self.bare(*all)).trace(*arguments))
        self.model = model
        return float(made(*arguments)) * self.call.unit

    def within(self, idx, x, radius: float) -> Int[np.ndarray, "atoms slots"]:
        """Return the neighbor list without the pairs at distances of `radius` or more."""
        near = (idx < self.n) & (self.distances(idx, x) < radius)
        return np.where(near, idx, self.n).astype(np.int32)

    def distances(self, idx, x) -> Float[np.ndarray, "atoms slots"]:
        """Return the distances of all pairs in a list. Distances of padding entries are arbitrary."""
        d = displacement(self.box, x[:, None], x[np.minimum(idx, self.n - 1)])
        return np.sqrt(sum(c * c for c in d))

    def culprit(self, idx) -> str:
        """Return the first operation with an infinite or NaN result."""
        return named(first_not_finite(jax.value_and_grad(self.bare, 1), *self.arguments(idx)))


def _quick(traced: Any) -> Any:
    """Compile a traced function with few optimizations, for a few calls."""
    return traced.lower().compile(compiler_options={"xla_backend_optimization_level": 0})


def named(found: Operation | None) -> str:
    """Return the name of an operation and its location in the source code."""
    return "one of several" if found is None else f"{found.name} ({found.source or 'in a function of jax'})"
