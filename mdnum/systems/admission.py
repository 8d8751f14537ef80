"""Trial calls that classify a user's energy function before the simulation.

The signature of a function does not show how it uses positions and the box. With a wrong calling convention,
energies can look plausible. The function is therefore called with equivalent neighbor lists and with slightly
different boxes.
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
from jaxtyping import Float

from mdnum.md import jaxmd
from mdnum.md.cell import displacement
from mdnum.md.energies import EnergyFunction
from mdnum.md.manybody import Smoothness
from mdnum.numerics.jaxprs import first_not_finite, held_numbers, single_numbers
from mdnum.systems.simulation import Simulation
from mdnum.systems.trial import SAME, AdmissionError, Trial, named

#: Number of atoms of a larger structure that are used in the trial.
_ENOUGH = 500
#: Shear of the box that distinguishes rows from columns; it differs for each pair of axes.
_SHEAR = 1e-3 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.7, 0.4, 0.0]])
#: Number of pairs nearest to the cutoff that are moved across it.
_CROSSINGS = 4
#: Resolution of the measured range, relative to the cutoff; a smooth function is 0 within rounding slightly
#: before its end.
_RESOLVED, _BEFORE = 2e-3, 0.03


def admitted(simulation: Simulation) -> Simulation:
    """Find the calling convention and the smoothness of a simulation's energy function.

    Raises:
        AdmissionError: the energy function has a defect that is listed in trial.toml.
    """
    with jaxmd.standard_promotion():
        trial = _of_a_part(simulation)
        if trial is None:
            trial = Trial(simulation, simulation.atoms)
            _examine(trial)
    notes = tuple((code, json.dumps(_short(values))) for code, values in trial.notes.items())
    return simulation.with_model(replace(trial.model, notes=notes))


def _of_a_part(simulation: Simulation) -> Trial | None:
    """Classify the energy function on a few atoms of a large structure. None if the function fails."""
    if simulation.atoms <= _ENOUGH or simulation.model.start is not None:
        return None
    try:
        trial = Trial(simulation, _ENOUGH)
        _examine(trial)
        whole = Trial(simulation.with_model(replace(trial.model, lists=None)), simulation.atoms)
        _keep(whole, trial.call.how.box)
        if "TRUSTS_LIST" in trial.notes:
            trial.notes["TRUSTS_LIST"] |= _over_both_lists(whole)
    except AdmissionError:
        # what is wrong with a part and its surface may be right in the structure
        return None
    trial.model = replace(trial.model, noise=trial.model.noise * simulation.atoms / _ENOUGH)
    # atoms that are known by their places are others in a part
    return None if trial.model.labeled else trial


def _short(values: Mapping[str, Any]) -> dict[str, Any]:
    """Round values to six significant digits, because further digits depend on the processor."""
    return {key: float(f"{one:.6g}") if isinstance(one, float) else one for key, one in values.items()}


def _examine(trial: Trial) -> None:
    """Classify the energy function. Raise an AdmissionError if energies or forces are wrong."""
    _resolve(trial)
    _check(trial)
    _at_the_cutoff(trial)


# --- what it is -------------------------------------------------------------------------------------------


def _resolve(trial: Trial) -> None:
    """Find the function's box argument, and whether its positions are fractional."""
    how = trial.call.how
    words = ("cell",) if how.native else how.keywords
    paired, periodic = ((trial.inside < trial.n).any(), trial.pbc.any())
    if not periodic or not paired:
        trial.notes |= {} if paired else {"UNTRIED": {}}
        _keep(trial, "cell" if "cell" in words else "columns" if periodic and "box" in words else "")
        return
    boxes = ("cell",) * ("cell" in words) + ("columns", "rows") * ("box" in words)
    kept = None
    moved = _Moved(trial)
    for fractional, box in product((False, True)[: 2 - how.native], (*boxes, "")):
        trial.learn(fractional=fractional, box=box)
        if moved.takes_images():
            kept = kept or (fractional, "")
            if box and moved.follows():
                kept = fractional, box
                break
    trial.learn(fractional=kept is not None and kept[0])
    _keep(trial, kept[1] if kept else "")
    if kept is None:
        here, there = (trial.energy(x) for x in moved.by(trial.cell)[-2:])
        raise trial.error("ANOTHER_BOX", here=there, there=here)
    if not trial.call.how.strain and not trial.call.how.box:
        raise trial.error("CELL_IGNORED" if how.native else "NO_STRAIN")


def _keep(trial: Trial, box: str) -> None:
    """Store which keywords the energy function needs. Raise an error if energies are not finite."""
    how = trial.call.how
    trial.learn(box=box)
    energy, forces = trial.there()
    by_strain = np.asarray(trial.slopes(*trial.arguments())[1][3])
    strain = box != "cell" and "perturbation" in how.keywords and bool(np.any(by_strain))
    used = ("cell",) if box == "cell" else ("box",) * bool(box) + ("perturbation",) * strain
    trial.learn(strain=strain, keywords=used if set(used) <= set(how.keywords) else how.keywords)
    trial.scale = max(abs(energy), float(np.abs(forces).max(initial=0.0)) * trial.model.r_cut, 1e-12)
    if np.isfinite(energy) and np.isfinite(forces).all():
        return
    # the same with neighbors, some of them twice, where there is padding
    inside, n = trial.inside, trial.n
    first = np.where(inside[:, :1] < n, inside[:, :1], (np.arange(n) == 0)[:, None])
    filled = trial.there(idx=np.where(inside < n, inside, first))
    code, operation = "NOT_FINITE", trial.culprit(inside)
    if all(np.isfinite(one).all() for one in filled):
        code = "NAN_BY_PADDING"
    elif operation.startswith("rem ") and not how.native:
        code = "MATRIX_BOX"
    raise trial.error(code, operation=operation)


class _Moved:
    """Energy changes when the atom with the most neighbors moves by lattice vectors.

    In a sheared box, pairs keep the nearest image of the original box.
    """

    def __init__(self, trial: Trial):
        self.trial, n = trial, trial.n
        self.central = int(np.argmax((trial.inside < n).sum(axis=1)))
        near = trial.within(trial.inside, trial.x, 0.45 * trial.width)
        own = (near == self.central) | (np.arange(n)[:, None] == self.central)
        self.idx = np.where(own, near, n).astype(np.int32)
        # pairs that no face of the box is between are where they were
        direct = np.linalg.norm(trial.x[:, None] - trial.x[np.minimum(near, n - 1)], axis=-1)
        whole = np.isclose(direct, trial.distances(near, trial.x), rtol=1e-9)
        self.whole = np.where(whole, near, n).astype(np.int32)

    def by(self, vectors) -> list[Float[np.ndarray, "atoms 3"]]:
        """Return positions with one atom moved by each vector. The last positions are the original ones."""
        x, moved = self.trial.x, np.arange(self.trial.n) == self.central
        return [*(x + np.outer(moved, vector) for vector in vectors[self.trial.pbc]), x]

    def takes_images(self) -> bool:
        """Return True if moving an atom by a lattice vector does not change the energy."""
        if not self.unchanged(self.trial.cell):
            return False
        # of a fractional function units are lattice vectors, and perhaps these are whole numbers of units
        call = self.trial.call
        return call.how.fractional or not self.unchanged(np.eye(3) * call.length)

    def unchanged(self, vectors, cell=None) -> bool:
        """Return True if moving one atom by any of the vectors does not change the energy."""
        trial, idx = self.trial, self.idx
        none = np.nan_to_num(trial.energy(idx=np.full_like(idx, trial.n)))
        *moved, x = self.by(vectors)
        energy, push = trial.energy(x, idx, cell), np.abs(trial.there(x, idx, cell)[1]).max()
        size = max(abs(energy - none), push * trial.model.r_cut, 1e-13 * abs(energy))
        allowed = 10 * SAME[trial.double] * size
        return all(abs(trial.energy(x, idx, cell) - energy) <= allowed for x in moved)

    def follows(self) -> bool:
        """Return True if the energy is periodic with the lattice vectors of a sheared box."""
        trial = self.trial
        cell = trial.cell + trial.cell @ _SHEAR
        energy, push = trial.energy(idx=self.whole), np.abs(trial.there(idx=self.whole)[1]).max()
        size = max(abs(energy), push * trial.model.r_cut)
        same = abs(energy - trial.energy(idx=self.whole, cell=cell)) <= SAME[trial.double] * size
        return same and self.unchanged(cell, cell)


# --- what may be wrong with it ----------------------------------------------------------------------------


def _check(trial: Trial) -> None:
    """Raise an error if energies or forces are wrong. Store properties of the energy function."""
    n, rng, inside = trial.n, np.random.default_rng(0), trial.inside
    energy, wide = trial.there()[0], trial.energy()

    def same(one: float, other: float) -> bool:
        return abs(one - other) <= SAME[trial.double] * trial.scale

    if not same(energy, wide):
        raise trial.error("DEPENDS_ON_CAPACITY", here=energy, there=wide)
    # its own rounding: the energy where the last bits of all coordinates are others
    ulp = 2.0**-52 if trial.double else 2.0**-23
    nudged = (trial.energy(trial.x * (1 + ulp * rng.choice((-1, 1), trial.x.shape))) for _ in range(4))
    noise = max(abs(one - wide) for one in nudged)
    # a power of ten, so that programs of the same function are the same
    noise = float(10.0 ** np.ceil(np.log10(noise))) if 0 < noise < np.inf else 0.0
    trial.model = replace(trial.model, noise=noise)
    _derivatives(trial, rng)
    shuffled = rng.permuted(inside, axis=1).astype(np.int32)
    if not same(wide, other := trial.energy(idx=shuffled)):
        raise trial.error("DEPENDS_ON_ORDER", here=wide, there=other)
    order = rng.permutation(n)
    place = np.append(np.argsort(order), n).astype(np.int32)
    other = trial.energy(trial.x[order], place[inside[order]])
    trial.model = replace(trial.model, labeled=not same(wide, other))
    if not same(*(both := _over_both_lists(trial)).values()):
        trial.model = replace(trial.model, trusts_list=True)
        trial.notes["TRUSTS_LIST"] = both
    none = np.full_like(inside, n)
    if not all(np.isfinite(one).all() for one in trial.there(idx=none)):
        trial.notes["NO_EDGES_NAN"] = {"operation": trial.culprit(none)}
    found = {
        "NAN_ON_OVERFLOW": not np.isfinite(trial.there(code=1)[0]),
        "FIXED_BOX": not trial.call.how.box and trial.pbc.any(),
        "SINGLE_INSIDE": not trial.double,
        "NOT_ADDITIVE": not _adds(trial),
    }
    trial.notes |= {code: {} for code, is_so in found.items() if is_so}
    if trial.double and (rounded := single_numbers(trial.jaxpr)):
        trial.notes["PARAMETERS_FLOAT32"] = {"numbers": rounded[:4], "count": len(rounded)}
    if trial.model.self_edges and not same(energy, other := trial.without_itself()):
        trial.notes["COUNTS_ITSELF"] = {"with_itself": energy, "without": other}
    if not jax.tree.leaves(trial.model.parameters) and (held := held_numbers(trial.jaxpr)):
        trial.notes["PARAMETERS_HELD"] = {"count": held}


def _over_both_lists(trial: Trial) -> dict[str, float]:
    """Return the energy of the pairs inside the cutoff, and of all listed pairs."""
    return {"inside": trial.energy(), "skin": trial.energy(idx=trial.idx)}


def _derivatives(trial: Trial, rng: np.random.Generator) -> None:
    """Compare forces and stress with finite differences of the energy."""
    step, allowed = (1e-5, 1e-4) if trial.double else (3e-3, 5e-2)
    r_cut = trial.model.r_cut
    step *= r_cut
    # no pair that crosses the cutoff within the difference
    crossing = np.abs(trial.distances(trial.inside, trial.x) - r_cut) < 20 * step
    idx = np.where(crossing, trial.n, trial.inside).astype(np.int32)
    noise = max((1e-14 if trial.double else 1e-6) * trial.scale, trial.model.noise) / step
    along = rng.standard_normal(trial.x.shape)
    along /= np.linalg.norm(along, axis=1).max()

    def slope(at: Callable[[float], float]) -> float:
        return (at(step) - at(-step)) / (2 * step)

    found = slope(lambda h: trial.energy(trial.x + h * along, idx))
    for real_slope in (False, True)[: 1 + trial.call.how.fractional]:
        trial.learn(real_slope=real_slope)
        terms = -np.sum(trial.there(idx=idx)[1] * along, axis=1)
        if abs(found - terms.sum()) <= allowed * np.sqrt(np.sum(terms**2)) + 10 * noise:
            break
    else:
        raise trial.error("FORCES_WRONG", found=found, force=float(terms.sum()))
    how, length = trial.call.how, trial.call.length
    if how.real_slope and not how.strain:
        raise trial.error("NO_STRAIN")
    if not how.box or not trial.pbc.all():
        return
    strain = rng.standard_normal((3, 3))
    strain = 0.05 * (strain + strain.T)
    by_x, by_cell, by_box, by_strain = map(np.asarray, trial.slopes(*trial.arguments(idx))[1])
    x, cell = (one / length @ strain for one in (trial.x, trial.cell))
    by_cell = {"cell": by_cell, "rows": by_box, "columns": by_box.T}[how.box]
    whole = np.sum(by_cell * cell) + (0.0 if how.fractional else np.sum(by_x * x))
    stress = float(np.sum(by_strain * strain) if how.strain else whole) * trial.call.unit
    step /= r_cut

    def strained(h: float) -> float:
        by = np.eye(3) + h * strain
        return trial.energy(trial.x @ by, idx, trial.cell @ by)

    if abs((found := slope(strained)) - stress) > allowed * trial.scale + 10 * noise * r_cut:
        raise trial.error("STRESS_WRONG", found=found, stress=stress)


# --- where it ends ----------------------------------------------------------------------------------------


def _at_the_cutoff(trial: Trial) -> None:
    """Find the range of the forces. Find the jumps of energy and force at the cutoff."""
    n, r_cut, size = trial.n, trial.model.r_cut, trial.scale
    # each pair once; in a crystal many are equally close to the cutoff
    once = (np.arange(n)[:, None] < trial.idx) & (trial.idx < n)
    r = np.where(once, trial.distances(trial.idx, trial.x), np.inf)
    found, acts = [], []
    for place in np.argsort(np.abs(r - r_cut), axis=None, kind="stable")[:_CROSSINGS].tolist():
        i, slot = divmod(place, r.shape[1])
        j = int(trial.idx[i, slot])
        if abs(r[i, slot] - r_cut) > 0.2 * r_cut:
            continue
        toward = np.concatenate(displacement(trial.box, trial.x[[i]], trial.x[[j]])) / r[i, slot]

        def crossing(factor: float, i=i, j=j, toward=toward, r=r[i, slot]) -> tuple[float, float]:
            """Return the energy of a pair, and the largest component of its force."""
            x = trial.x.copy()
            x[j] += toward * (r_cut * factor - r)
            listed = trial.within(trial.idx, x, r_cut)
            pair = np.zeros_like(listed, bool)
            pair[i], pair[j] = trial.idx[i] == j, trial.idx[j] == i
            (ahead, f), (behind, g) = (
                trial.there(x, np.where(pair, held, listed).astype(np.int32)) for held in (trial.idx, n)
            )
            return ahead - behind, float(np.abs(f - g).max())

        # what is continuous is a hundredth of itself, or less, at the second distance
        wide, near = (crossing(factor) for factor in (1 - 1e-5, 1 - 1e-7))
        noise = (max(1e-12 * size, 10 * trial.model.noise), 1e-12 * size / r_cut)
        real = [abs(near[k]) > max(0.3 * abs(wide[k]), noise[k]) for k in (0, 1)]
        found.append([near[k] * real[k] for k in (0, 1)])
        if any(real):
            beyond, k = crossing(1 + 1e-3), real.index(True)
            acts.append(abs(beyond[k] - near[k]) <= 0.1 * abs(near[k]))
    reach, furthest = _reach(trial)
    if reach is not None and reach < (1 - _BEFORE) * r_cut:
        trial.notes["R_CUT_LONGER"] = {"r_cut": r_cut, "reach": reach}
    if not found:
        return
    jumps, pushes = zip(*found, strict=True)
    jump, push = max(jumps, key=abs), max(pushes)
    order = -1.0 if jump else 0.0 if push else 1.0
    if order == -1:
        trial.notes["ENERGY_JUMPS"] = {"jump": jump, "push": push}
        # the jump of every crossing where all are alike; of others it is not known before
        if len(trial.simulation.symbols) > 1 or any(abs(one - jump) > 1e-6 * abs(jump) for one in jumps):
            jump = push = float("nan")
    trusts = all(acts) if acts else trial.model.trusts_list
    if acts and not trusts:
        trial.notes.pop("TRUSTS_LIST", None)
        trial.notes["DECIDES_ITSELF"] = {}
    if trusts and reach is not None and reach > (1 + 2 * _RESOLVED) * r_cut:
        ends = {"r_cut": r_cut, "reach": reach if reach < furthest else None, "furthest": furthest}
        trial.notes["TRUSTS_LIST"] = _over_both_lists(trial) | ends
    trial.model = replace(trial.model, smoothness=Smoothness(order, jump, push), trusts_list=trusts)


def _threes(trial: Trial) -> tuple[Any, Any, np.ndarray]:
    """Return functions that arrange atoms in groups of three, without interactions between groups.

    Returns:
        a function that returns the neighbor list of chosen groups; a function that places the third atom of
        each group at a given distance from the first atom (the second at 0.6 of the cutoff); third atoms.
    """
    n, x = trial.n, trial.x
    first, second, third = np.arange(n - n % 3).reshape(3, -1)
    # a tilted triangle: along axes forces may vanish by symmetry
    sides = np.array([[0.48, 0.6, 0.64], [0.8, -0.36, 0.48]])

    def listed(chosen: slice) -> np.ndarray:
        idx = np.full_like(trial.inside, n)
        one, two, three = first[chosen], second[chosen], third[chosen]
        idx[one, 0], idx[one, 1], idx[two, 0], idx[three, 0] = two, three, one, one
        return idx

    def placed(r: float) -> np.ndarray:
        out = x.copy()
        out[second], out[third] = x[first] + 0.6 * trial.model.r_cut * sides[0], x[first] + r * sides[1]
        return out

    return listed, placed, third


def _adds(trial: Trial) -> bool:
    """Return True if the energies of two separate groups of atoms add up."""
    listed, placed, third = _threes(trial)
    if len(third) < 2:
        return True
    x, chosen = placed(0.7 * trial.model.r_cut), (slice(0, 1), slice(1, 2), slice(0, 2), slice(0, 0))
    one, other, both, none = (trial.energy(x, listed(some)) for some in chosen)
    size = max(abs(one - none), abs(other - none), 1e-9 * abs(none))
    return not abs(one + other - both - none) > 1e3 * SAME[trial.double] * size


def _reach(trial: Trial) -> tuple[float | None, float]:
    """Return the largest distance at which neighbors exert forces, and the largest distance tested.

    The first value is None if no force was found.
    """
    r_cut, (listed, placed, third) = trial.model.r_cut, _threes(trial)
    furthest = min(2 * r_cut, 0.49 * trial.width if trial.pbc.any() else np.inf)
    if not len(third) or furthest < r_cut:
        return None, furthest
    idx = listed(slice(None))

    def acts(r: float) -> bool:
        energy, forces = trial.there(placed(r), idx)
        sizes = np.abs(forces)
        return bool(np.isfinite(energy) and np.any(sizes[third] > 1e-25 * sizes.max()))

    near, far = 0.3 * r_cut, furthest
    if acts(far) or not acts(near):
        return (far if acts(far) else None), furthest
    while far - near > _RESOLVED * r_cut:
        middle = 0.5 * (near + far)
        near, far = (middle, far) if acts(middle) else (near, middle)
    return near, furthest


def second_derivative(simulation: Simulation) -> str:
    """Return the first operation with infinite or NaN second derivatives. "" if there is none."""
    if not isinstance(simulation.model, EnergyFunction):
        return ""
    with jaxmd.standard_promotion():
        trial = Trial(simulation, simulation.atoms)
        arguments = trial.arguments()

        def along(parameters, x, *rest):
            slope = lambda x: jax.grad(trial.bare, 1)(parameters, x, *rest)  # noqa: E731
            return jax.jvp(slope, (x,), (jnp.ones_like(x),))[1]

        if np.isfinite(np.asarray(jax.jit(along)(*arguments))).all():
            return ""
        return named(first_not_finite(along, *arguments))
