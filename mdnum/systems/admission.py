"""What an energy function is, and what is wrong with it, found by calling it before it is simulated.

A signature does not say whether positions are fractional, whether lattice vectors are rows or columns, or
whether the box that is given counts at all. A wrong guess gives energies that look right. So the function is
called at the first configuration, over lists that are the same in other words and in boxes that are nearly
the same, by one compiled program.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
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
from mdnum.md.manybody import Smoothness
from mdnum.numerics.jaxprs import Operation, first_not_finite, narrows, single_numbers
from mdnum.plain import beside
from mdnum.systems.simulation import Simulation

_TEXTS = beside(__file__)
FORMATS: tuple[jaxmd.Format, ...] = ("dense", "sparse", "ordered-sparse")
#: Relative difference of energies that are the same, by whether all arithmetic is in double precision.
_SAME = {True: 1e-9, False: 1e-5}
#: Atoms of a larger structure that are tried.
_ENOUGH = 500
#: Of the box that tells rows from columns: how far it is sheared, not the same way along any two axes.
_SHEAR = 1e-3 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.7, 0.4, 0.0]])


class AdmissionError(InputError):
    """An energy function cannot be simulated as it is; `code` says why, `values` with which numbers."""

    def __init__(self, code: str, name: str, **values: Any):
        entry = _TEXTS[code]
        super().__init__(entry["text"].format(**values), remedy=entry["remedy"].format(**values), where=name)
        self.code, self.values = code, values


def admitted(simulation: Simulation) -> Simulation:
    """The simulation with an energy function that is known: its convention, its smoothness, what was noted.

    Raises:
        AdmissionError: what it does cannot be right, in one of the ways of admission.toml.
    """
    with jaxmd.standard_promotion():
        trial = _of_a_part(simulation)
        if trial is None:
            trial = Trial(simulation, simulation.atoms)
            trial.examine()
    notes = tuple((code, json.dumps(_short(values))) for code, values in trial.notes.items())
    return simulation.with_model(replace(trial.model, notes=notes))


def _of_a_part(simulation: Simulation) -> Trial | None:
    """A few atoms of a large structure examined, and the numbers of all; None where that is not enough."""
    if simulation.atoms <= _ENOUGH or simulation.model.start is not None:
        return None
    try:
        trial = Trial(simulation, _ENOUGH)
        trial.examine()
        whole = Trial(simulation.with_model(replace(trial.model, lists=None)), simulation.atoms)
        whole.keep(trial.call.how.box)
        if "TRUSTS_LIST" in trial.notes:
            trial.notes["TRUSTS_LIST"] = whole.over_both_lists()
    except AdmissionError:
        # what is wrong with a part and its surface may be right in the structure
        return None
    # atoms that are known by their places are others in a part
    return None if trial.model.labeled else trial


def _short(values: Mapping[str, Any]) -> dict[str, Any]:
    """With six digits: another processor computes others."""
    return {key: float(f"{one:.6g}") if isinstance(one, float) else one for key, one in values.items()}


class Trial:
    """An energy function at one configuration, in the order of the structure.

    Args:
        atoms: number of atoms that are tried, those closest to the first one, in the box of all.

    Attributes:
        model: the function as far as it is known.
        notes: what should be known about it, values by code.
    """

    def __init__(self, simulation: Simulation, atoms: int):
        self.model: EnergyFunction = simulation.model
        self.notes: dict[str, dict[str, Any]] = {}
        self.simulation = simulation
        unknown, known = set(simulation.symbols) - set(self.model.species), ", ".join(self.model.species)
        if known and unknown:
            raise self._error("UNKNOWN_SPECIES", unknown=", ".join(sorted(unknown)), known=known)
        self.pbc = np.array(simulation.pbc)
        self.cell = complete(np.asarray(simulation.cell.matrix), self.pbc)
        self.x, _ = wrap_positions(simulation.cell, simulation.positions)
        self.box, width = simulation.cell, float(np.min(simulation.cell.widths))
        skin = min(max(simulation.rule.skin, 0.1 * simulation.r_cut), width / 2 - simulation.r_cut)
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
        self.inside = self.within(self.idx, self.x, self.model.r_cut)
        # those whose nearest image stays the same in a box that is sheared
        self.near = self.within(self.inside, self.x, 0.45 * width)
        # the atom that has most neighbors
        self.central = int(np.argmax((self.inside < len(self.x)).sum(axis=1)))
        self._lists()
        self._compile()

    def _error(self, code: str, **values: Any) -> AdmissionError:
        return AdmissionError(code, self.model.name, **values)

    @property
    def call(self) -> Call:
        """The function with the convention that is known so far."""
        return self.model.call

    def _with(self, **found: Any) -> None:
        self.model = replace(self.model, function=replace(self.call, how=replace(self.call.how, **found)))

    def examine(self) -> None:
        """Find out all of it; raise an AdmissionError where what it does cannot be right."""
        self.resolve()
        self.check()
        self.at_the_cutoff()

    # --- calling it -----------------------------------------------------------------------------------

    def _lists(self) -> None:
        """The format of its own list, whether that lists atoms themselves, and its parameters."""
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
            n, form = len(self.x), own.format.name.replace("dS", "d-S").lower()
            here, other = (np.arange(n)[:, None], own.idx) if form == "dense" else own.idx
            itself = bool(np.any((np.asarray(here) == np.asarray(other)) & (np.asarray(other) < n)))
            # an image of an atom is another one
            model = replace(model, format=form, self_edges=itself and not self.call.how.images)
        self.model = model
        if model.start is not None and not jax.tree.leaves(model.parameters):
            key, x = jax.random.PRNGKey(self.simulation.draw.seed), jnp.asarray(self.x / self.call.length)
            if own is None:
                form = FORMATS[0] if model.format == "any" else model.format
                own = jaxmd.as_neighbor_list(self.idx, x, form)
            self.model = replace(model, parameters=model.start(key, x, own))

    def bare(self, parameters, x, idx, real, cell, box, strain, code):
        """The function's own energy, of positions and a box in its own terms."""
        call, model = self.call, self.model
        neighbor = jaxmd.as_neighbor_list(idx, real, model.format, model.self_edges, code)
        if call.how.images:
            neighbor = jaxmd.multi_image(neighbor, real, cell, box)
        return call.bare(parameters, x, neighbor, {"cell": cell, "box": box, "perturbation": strain})

    def _arguments(self, idx=None, x=None, cell=None, code=0) -> tuple[Any, ...]:
        """Of `bare`, at real positions in a box, by the convention that is known so far."""
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
        """Find a format, keywords and a result that fit, and compile energy and derivatives."""
        formats = FORMATS if self.model.format == "any" else (self.model.format,)
        words, failed = self.call.how.keywords, ""
        # a space of jax-md may raise at a keyword that the function passes on
        sets = [tuple(w for w in words if w != left) for left in ("", "box", "cell", "perturbation")]
        for form, keywords in product(formats, dict.fromkeys([*sets, ()])):
            self.model = replace(self.model, format=form)
            self._with(keywords=keywords, returns="")
            try:
                self._with(returns=self._returned())
                every = jax.jit(jax.value_and_grad(self.bare, argnums=(1, 4, 5, 6)))
                traced = every.trace(*self._arguments())
                self.double, self.program = not narrows(traced.jaxpr), _quick(traced)
                return
            except AdmissionError:
                raise
            except Exception as error:
                failed = failed or in_a_line(error)
        raise self._error("NOT_CALLABLE", error=failed, tried=", ".join(formats))

    def _returned(self) -> str:
        """What it returns, as `Convention.returns`."""
        shape = jax.tree.map(lambda one: one.shape, jax.eval_shape(self.bare, *self._arguments()))
        one = ((), (1,))
        if isinstance(shape, Mapping):
            kind = next((key for key in ("total", "energy") if shape.get(key) in one), "")
        else:
            kind = "number" if shape in one else "atoms" if shape == (len(self.x),) else ""
        if not kind:
            raise self._error("NO_ENERGY", seen=f"{shape!r}")
        return kind

    def there(self, x=None, idx=None, cell=None, code=0) -> tuple[float, Float[np.ndarray, "atoms 3"]]:
        """Energy and forces in the simulation's units; arguments as for `_arguments`."""
        how, call, cell = self.call.how, self.call, self.cell if cell is None else cell
        energy, (slope, *_) = self.program(*self._arguments(idx, x, cell, code))
        honest = how.fractional and not how.real_slope
        by_x = np.linalg.inv(cell).T if honest else np.eye(3) / call.length
        return float(energy) * call.unit, -np.asarray(slope) @ by_x * call.unit

    def same(self, a: float, b: float) -> bool:
        """Whether two energies are the same within rounding."""
        return abs(a - b) <= _SAME[self.double] * self.scale

    def within(self, idx, x, radius: float) -> Int[np.ndarray, "atoms slots"]:
        """Of listed pairs those closer than a radius."""
        n = len(x)
        return np.where((idx < n) & (self.distances(idx, x) < radius), idx, n).astype(np.int32)

    def distances(self, idx, x) -> Float[np.ndarray, "atoms slots"]:
        """Of the listed pairs, some number for padding."""
        d = displacement(self.box, x[:, None], x[np.minimum(idx, len(x) - 1)])
        return np.sqrt(sum(c * c for c in d))

    # --- what it is -----------------------------------------------------------------------------------

    def resolve(self) -> None:
        """Which box it follows, and whether its positions are real or fractional.

        Raises:
            AdmissionError: numbers that are not finite; another box than the simulation's, or one that it
                ignores; no way to strain what it sees.
        """
        how = self.call.how
        words = ("cell",) if how.native else how.keywords
        paired, periodic = ((self.inside < len(self.x)).any(), self.pbc.any())
        if not periodic or not paired:
            self.notes |= {} if paired else {"UNTRIED": {}}
            self.keep("cell" if "cell" in words else "columns" if periodic and "box" in words else "")
            return
        boxes = ("cell",) * ("cell" in words) + ("columns", "rows") * ("box" in words)
        kept = None
        for fractional, box in product((False, True)[: 2 - how.native], (*boxes, "")):
            self._with(fractional=fractional, box=box)
            if self._takes_images():
                kept = kept or (fractional, "")
                if box and self._follows():
                    kept = fractional, box
                    break
        self._with(fractional=kept is not None and kept[0])
        self.keep(kept[1] if kept else "")
        if kept is None:
            here, there = (self.there(x)[0] for x in self._moves(self.cell)[-2:])
            raise self._error("ANOTHER_BOX", here=there, there=here)
        if not self.call.how.strain and not self.call.how.box:
            raise self._error("CELL_IGNORED" if how.native else "NO_STRAIN")

    def keep(self, box: str) -> None:
        """Keep how the box is followed, and the keywords that this takes; energies must be finite then."""
        how = self.call.how
        self._with(box=box)
        energy, forces = self.there()
        by_strain = np.asarray(self.program(*self._arguments(self.inside))[1][3])
        strain = box != "cell" and "perturbation" in how.keywords and bool(np.any(by_strain))
        used = ("cell",) if box == "cell" else ("box",) * bool(box) + ("perturbation",) * strain
        self._with(strain=strain, keywords=used if set(used) <= set(how.keywords) else how.keywords)
        self.scale = max(abs(energy), float(np.abs(forces).max(initial=0.0)) * self.model.r_cut, 1e-12)
        if np.isfinite(energy) and np.isfinite(forces).all():
            return
        n = len(self.x)
        # the same with neighbors, some of them twice, where there is padding
        first = np.where(self.inside[:, :1] < n, self.inside[:, :1], (np.arange(n) == 0)[:, None])
        filled = self.there(idx=np.where(self.inside < n, self.inside, first))
        code = "NAN_BY_PADDING" if all(np.isfinite(one).all() for one in filled) else "NOT_FINITE"
        raise self._error(code, operation=self._culprit(self.inside))

    def _culprit(self, idx) -> str:
        return _named(first_not_finite(jax.value_and_grad(self.bare, 1), *self._arguments(idx)))

    def _moves(self, vectors) -> list[Float[np.ndarray, "atoms 3"]]:
        """Positions with one atom, that has neighbors, moved by each of some vectors; last those unmoved."""
        moved = np.arange(len(self.x)) == self.central
        return [*(self.x + np.outer(moved, vector) for vector in vectors[self.pbc]), self.x]

    def _takes_images(self) -> bool:
        """Whether an atom may move by a lattice vector, and by none of another convention."""
        if not self._unmoved(self.cell):
            return False
        # of a fractional function units are lattice vectors, and perhaps these are whole numbers of units
        return self.call.how.fractional or not self._unmoved(np.eye(3) * self.call.length)

    def _unmoved(self, vectors, cell=None) -> bool:
        """Whether moving an atom by any of some vectors leaves the energy of its pairs as it is."""
        n, rows = len(self.x), np.arange(len(self.x))[:, None]
        own = (self.near == self.central) | (rows == self.central)
        idx = np.where(own, self.near, n).astype(np.int32)
        none = np.nan_to_num(self.there(idx=np.full_like(idx, n))[0])
        *moved, here = (self.there(x, idx, cell) for x in self._moves(vectors))
        size = max(abs(here[0] - none), np.abs(here[1]).max() * self.model.r_cut, 1e-13 * abs(here[0]))
        return all(abs(one[0] - here[0]) <= 10 * _SAME[self.double] * size for one in moved)

    def _follows(self) -> bool:
        """Whether a box that is slightly sheared counts, and counts as what it is."""
        cell, n = self.cell + self.cell @ _SHEAR, len(self.x)
        # pairs that no face of the box is between are where they were
        direct = np.linalg.norm(self.x[:, None] - self.x[np.minimum(self.near, n - 1)], axis=-1)
        whole = np.isclose(direct, self.distances(self.near, self.x), rtol=1e-9)
        whole = np.where(whole, self.near, n).astype(np.int32)
        here, there = self.there(idx=whole), self.there(idx=whole, cell=cell)
        size = max(abs(here[0]), np.abs(here[1]).max() * self.model.r_cut)
        return abs(here[0] - there[0]) <= _SAME[self.double] * size and self._unmoved(cell, cell)

    # --- what may be wrong with it --------------------------------------------------------------------

    def check(self) -> None:
        """Raise where its numbers cannot be right; note what should be known."""
        n, rng = len(self.x), np.random.default_rng(0)
        energy, _ = self.there()
        self._derivatives(rng)
        shuffled = rng.permuted(self.inside, axis=1).astype(np.int32)
        if not self.same(energy, other := self.there(idx=shuffled)[0]):
            raise self._error("DEPENDS_ON_ORDER", here=energy, there=other)
        wide = np.concatenate([self.inside, np.full((n, 8), n, np.int32)], axis=1)
        # its own padding between the neighbors was among what was shuffled
        arguments = self._arguments(wide)
        alone = jax.jit(self.bare).trace(*arguments)
        if not self.same(energy, other := float(_quick(alone)(*arguments)) * self.call.unit):
            raise self._error("DEPENDS_ON_CAPACITY", here=energy, there=other)
        order = rng.permutation(n)
        place = np.append(np.argsort(order), n).astype(np.int32)
        other = self.there(self.x[order], place[self.inside[order]])[0]
        self.model = replace(self.model, labeled=not self.same(energy, other))
        if not self.same(*(both := self.over_both_lists()).values()):
            self.model = replace(self.model, trusts_list=True)
            self.notes["TRUSTS_LIST"] = both
        none = np.full_like(self.inside, n)
        if not all(np.isfinite(one).all() for one in self.there(idx=none)):
            self.notes["NO_EDGES_NAN"] = {"operation": self._culprit(none)}
        found = {
            "NAN_ON_OVERFLOW": not np.isfinite(self.there(code=1)[0]),
            "FIXED_BOX": not self.call.how.box and self.pbc.any(),
            "SINGLE_INSIDE": not self.double,
        }
        self.notes |= {code: {} for code, is_so in found.items() if is_so}
        if self.double and (rounded := single_numbers(alone.jaxpr)):
            self.notes["PARAMETERS_FLOAT32"] = {"numbers": rounded[:4], "count": len(rounded)}

    def over_both_lists(self) -> dict[str, float]:
        """Energies over the pairs inside the cutoff, and with those of the skin."""
        return {"inside": self.there()[0], "skin": self.there(idx=self.idx)[0]}

    def _derivatives(self, rng: np.random.Generator) -> None:
        """Forces, and stress where the box counts, against differences of energies."""
        step, allowed = (1e-5, 1e-4) if self.double else (3e-3, 5e-2)
        step *= self.model.r_cut
        # no pair that crosses the cutoff within the difference
        crossing = np.abs(self.distances(self.inside, self.x) - self.model.r_cut) < 20 * step
        idx = np.where(crossing, len(self.x), self.inside).astype(np.int32)
        noise = (1e-14 if self.double else 1e-6) * self.scale / step
        along = rng.standard_normal(self.x.shape)
        along /= np.linalg.norm(along, axis=1).max()

        def slope(at: Callable[[float], float]) -> float:
            return (at(step) - at(-step)) / (2 * step)

        found = slope(lambda h: self.there(self.x + h * along, idx)[0])
        for real_slope in (False, True)[: 1 + self.call.how.fractional]:
            self._with(real_slope=real_slope)
            terms = -np.sum(self.there(idx=idx)[1] * along, axis=1)
            if abs(found - terms.sum()) <= allowed * np.sqrt(np.sum(terms**2)) + 10 * noise:
                break
        else:
            raise self._error("FORCES_WRONG", found=found, force=float(terms.sum()))
        if (how := self.call.how).real_slope and not how.strain:
            raise self._error("NO_STRAIN")
        if not how.box or not self.pbc.all():
            return
        strain = rng.standard_normal((3, 3))
        strain = 0.05 * (strain + strain.T)
        by_x, by_cell, by_box, by_strain = map(np.asarray, self.program(*self._arguments(idx))[1])
        x, cell = (one / self.call.length @ strain for one in (self.x, self.cell))
        by_cell = {"cell": by_cell, "rows": by_box, "columns": by_box.T}[how.box]
        whole = np.sum(by_cell * cell) + (0.0 if how.fractional else np.sum(by_x * x))
        stress = float(np.sum(by_strain * strain) if how.strain else whole) * self.call.unit
        step /= self.model.r_cut

        def at(h: float) -> float:
            by = np.eye(3) + h * strain
            return self.there(self.x @ by, idx, self.cell @ by)[0]

        if abs((found := slope(at)) - stress) > allowed * self.scale + 10 * noise * self.model.r_cut:
            raise self._error("STRESS_WRONG", found=found, stress=stress)

    def at_the_cutoff(self) -> None:
        """Find what a crossing of its cutoff does, of the pairs that are nearest to it."""
        n, r_cut, size = len(self.x), self.model.r_cut, self.scale
        r = np.where(self.idx < n, self.distances(self.idx, self.x), np.inf)
        found, acts = [], []
        for place in np.argsort(np.abs(r - r_cut), axis=None)[:6].tolist():
            i, slot = divmod(place, r.shape[1])
            j = int(self.idx[i, slot])
            if not i < j < n or abs(r[i, slot] - r_cut) > 0.2 * r_cut:
                continue
            toward = np.concatenate(displacement(self.box, self.x[[i]], self.x[[j]])) / r[i, slot]
            ends = []
            # what is continuous is a hundredth of itself, or less, at the second distance
            for factor in (1 - 1e-5, 1 - 1e-7, 1 + 1e-3):
                x = self.x.copy()
                x[j] += toward * (r_cut * factor - r[i, slot])
                listed = self.within(self.idx, x, r_cut)
                pair = np.zeros_like(listed, bool)
                pair[i], pair[j] = self.idx[i] == j, self.idx[j] == i
                (ahead, f), (behind, g) = (
                    self.there(x, np.where(pair, held, listed).astype(np.int32)) for held in (self.idx, n)
                )
                ends.append((ahead - behind, float(np.abs(f - g).max())))
            wide, near, beyond = ends
            units = ((1, 0), (r_cut, 1))
            real = [abs(near[k]) > max(0.3 * abs(wide[k]), 1e-12 * size / unit) for unit, k in units]
            found.append([near[k] * real[k] for k in (0, 1)])
            acts += [abs(beyond[k] - near[k]) <= 0.1 * abs(near[k]) for k in (0, 1) if real[k]][:1]
        if not found:
            return
        jumps, pushes = zip(*found, strict=True)
        jump, push = max(jumps, key=abs), max(pushes)
        order = -1.0 if jump else 0.0 if push else 1.0
        if order == -1:
            self.notes["ENERGY_JUMPS"] = {"jump": jump, "push": push}
            # the jump of every crossing where all are alike; of others it is not known before
            if len(self.simulation.symbols) > 1 or any(abs(one - jump) > 1e-6 * abs(jump) for one in jumps):
                jump = push = float("nan")
        trusts = all(acts) if acts else self.model.trusts_list
        if acts and not trusts:
            self.notes.pop("TRUSTS_LIST", None)
            self.notes["DECIDES_ITSELF"] = {}
        self.model = replace(self.model, smoothness=Smoothness(order, jump, push), trusts_list=trusts)


def _quick(traced: Any) -> Any:
    """A program compiled for a few calls."""
    return traced.lower().compile(compiler_options={"xla_backend_optimization_level": 0})


def _named(found: Operation | None) -> str:
    """An operation and where it was written."""
    return "one of several" if found is None else f"{found.name} ({found.source or 'in a function of jax'})"


def second_derivative(simulation: Simulation) -> str:
    """The first operation that makes second derivatives of an energy function not finite; empty for none."""
    if not isinstance(simulation.model, EnergyFunction):
        return ""
    with jaxmd.standard_promotion():
        trial = Trial(simulation, simulation.atoms)
        arguments = trial._arguments()

        def along(parameters, x, *rest):
            slope = lambda x: jax.grad(trial.bare, 1)(parameters, x, *rest)  # noqa: E731
            return jax.jvp(slope, (x,), (jnp.ones_like(x),))[1]

        if np.isfinite(np.asarray(jax.jit(along)(*arguments))).all():
            return ""
        return _named(first_not_finite(along, *arguments))
