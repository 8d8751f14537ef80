"""Choices of how a run starts: parameters, coordinates, noise, and equivalent states.

Other atom labels, origins, axes and periodic images describe the same physical system.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.forks.choices.base import (
    Choice,
    Summed,
    applies,
    check,
    choice,
    number,
    plural,
    simulations,
    some,
    summed,
    summing,
    world_of,
)
from mdnum.forks.worlds import as_used, floats, program_of, twin, varied
from mdnum.numerics.rounding import neighbor
from mdnum.program import Twin

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

#: Symmetry operations of boxes: exchanges of axes, half turns about one axis, and the inversion, which is a
#: symmetry of every box.
_SYMMETRIES = ("yzx", "yxz", "xzy", "zyx", "-x-yz", "x-y-z", "-xy-z", "-x-y-z")
_AXES = re.compile(r"(?!.*([xyz]).*\1)(-?[xyz]){3}")
#: Parameters that are built-in choices, even if a system does not have them.
OFTEN = {
    "md": (
        "cutoff.radius", "cutoff.in_sigma", "dynamics.timestep", "dynamics.temperature", "potential.sigma",
        "potential.epsilon",
    ),
    "ball": (
        "contact.k", "contact.damping", "contact.eps", "contact.alpha", "contact.restitution",
        "contact.rest_speed", "contact.hysteresis", "stop.tol", "stop.enter", "integrator.timestep",
        "flight.gravity",
    ),
}  # fmt: skip
#: Distance from a face of the box, relative to its edge, within which an ulp could move an atom across.
_NEAR = 1e-6
_NO_NEIGHBOR = "is 0, and the next float is negligible compared with any other number"


def _frame(simulation: Any, **parts: Any) -> Any:
    from mdnum.rollout.compared import ReferenceFrame

    return replace(ReferenceFrame.same(simulation.atoms), **parts)


@choice("relabel")
class Relabel(Summed):
    """The atoms in another order."""

    screened = "relabel relabel@exact"
    seed: int = 1  # of the permutation

    def __post_init__(self):
        super().__post_init__()
        check(self.seed >= 0, f"seed {self.seed} is negative", "relabel")

    def make(self, system: Simulation) -> Twin:
        shared = "atoms" not in system.integrator.noise_belongs_to
        applies(shared, "the thermostat's noise belongs to labels: other atoms would receive it")
        applies(not (system.pairwise and system.model.weights), "the atoms' weights belong to labels")
        a = summed(system, self.both)
        labels = np.random.default_rng(self.seed).permutation(a.atoms)
        b = replace(
            a,
            structure=a.structure[labels],
            masses=a.masses[labels],
            species=a.species[labels],
            # drawn velocities would go by label, and a drift taken out would be rounded in another order
            positions=a.positions[labels],
            velocities=a.velocities[labels],
        )
        return self.twin(a, b, f"atoms in another order, seed {self.seed}", _frame(a, labels=labels))


@choice("rotate")
class Rotate(Summed):
    """Exchanged or reversed axes of the box.

    An exchange of axes is exact. The exchange changes the order of the sum of a squared distance. If an axis
    is reversed, wrapping positions into the box needs one more rounding.
    """

    screened = "rotate rotate@exact"
    must_hold = False  # type: ignore[assignment]
    # what stands in place of xyz: axis k of the second run is the k-th axis named, of the first, with its
    # sign ("yzx", "-x-yz"); None: the first of these that leaves the box as it is, all three in turn where it
    # can be, the inversion "-x-y-z" where nothing else does
    axes: str | None = None

    def __post_init__(self):
        super().__post_init__()
        check(
            self.axes is None or (bool(_AXES.fullmatch(self.axes)) and self.axes != "xyz"),
            f"axes {self.axes!r}; expected another order of xyz, with or without signs (yzx, -x-yz)",
            "rotate",
        )

    def make(self, system: Simulation) -> Twin:
        shared = "axes" not in system.integrator.noise_belongs_to
        applies(shared, "the noise belongs to axes: other directions would receive it")
        known = _SYMMETRIES if self.axes is None else (self.axes,)
        word = next((word for word in known if _is_symmetry(word, system.structure)), "")
        applies(bool(word), f"the box is not the same with axes {self.axes} in place of xyz")
        a = summed(system, self.both)
        axes, signs = (np.array(part) for part in _read(word))
        b = replace(a, positions=a.positions[:, axes] * signs, velocities=a.velocities[:, axes] * signs)
        back = np.argsort(axes)
        return self.twin(a, b, f"axes {word} in place of xyz", _frame(a, axes=back, signs=signs[back]))


def _is_symmetry(word: str, atoms: Any) -> bool:
    """True if the exchange of axes leaves the box unchanged, up to signs."""
    axes, signs = _read(word)
    rows = {tuple(row) for row in np.asarray(atoms.cell)[np.asarray(atoms.pbc)].tolist()}
    turned = {tuple(sign * row[k] for k, sign in zip(axes, signs, strict=True)) for row in rows}
    return turned <= rows | {tuple(-c for c in row) for row in rows}


def _read(word: str) -> tuple[list[int], list[float]]:
    """Parse a symmetry such as "-x-yz" into axes and signs."""
    parts = re.findall("-?[xyz]", word)
    return ["xyz".index(part[-1]) for part in parts], [-1.0 if part[0] == "-" else 1.0 for part in parts]


@choice("translate")
class Translate(Summed):
    """All atoms moved by a fraction of the lattice vectors."""

    screened = "translate=0.25 translate=lattice"
    must_hold = False  # type: ignore[assignment]
    shown = True
    share: float = 0.25  # of each periodic lattice vector

    def __post_init__(self):
        super().__post_init__()
        good = bool(np.isfinite(self.share)) and self.share != 0
        check(good, f"a share of {self.share:g}; expected a number other than 0", "translate")

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if argument == "lattice" and both is None:
            return Images()
        return super().parse(argument, role, both)

    def describe(self, world: str = "md") -> str:
        return f"moved by {self.share:g} of each lattice vector{summing(self.both)}"

    def make(self, system: Simulation) -> Twin:
        applies(any(system.pbc), "no axis is periodic")
        a = summed(system, self.both)
        shift = self.share * np.asarray(a.cell.matrix)[list(a.cell.pbc)].sum(axis=0)
        b, frame = replace(a, positions=a.positions + shift), _frame(a, shift=shift)
        return self.twin(a, b, f"moved by {self.share:g} of each lattice vector", frame)


@choice("unwrapped")
class Images(Choice):
    """Atoms that start in other periodic images.

    Positions are wrapped before the first step. Wrapping an exact image gives the same bits. Usually,
    however, the sum of a position and a lattice vector is rounded. Both runs therefore start from positions
    with exact images. The positions differ from those in the file by at most one ulp of the lattice vector.
    """

    worlds = ("md",)
    screened = "unwrapped"
    must_hold = True
    # of a random image of each atom, one lattice vector away at most; None: every atom one lattice vector
    # further along every periodic axis
    seed: int | None = None

    @property
    def name(self) -> str:
        """The choice as text: "translate=lattice", "unwrapped" or "unwrapped=3"."""
        if self.seed is None:
            return "translate=lattice"
        return self.family if self.seed == 1 else f"{self.family}={self.seed}"

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        return cls(number(argument or "1", int, "unwrapped"))

    def describe(self, world: str = "md") -> str:
        if self.seed is None:
            return "moved by every lattice vector, exactly"
        return "started from unwrapped positions, exactly"

    def make(self, system: Simulation) -> Twin:
        applies(any(system.pbc), "no axis is periodic")
        a = system
        images = np.ones(a.positions.shape, np.int64)
        if self.seed is not None:
            images = np.random.default_rng(self.seed).integers(-1, 2, a.positions.shape)
        wrapped, elsewhere, lost = exact_images(a.cell, a.positions, images * np.array(a.cell.pbc))
        applies(not lost, f"{lost} atoms have no position near theirs whose image is exact in float64")
        return simulations(replace(a, positions=wrapped), replace(a, positions=elsewhere), self.describe())


def exact_images(
    cell: Any, positions: Float[np.ndarray, "atoms 3"], images: Int[np.ndarray, "atoms 3"]
) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"], int]:
    """Move atoms slightly to make images exact. Return positions, images and the number of inexact images.

    Wrapping an exact image restores the wrapped position, bit for bit. In an orthogonal box, wrapping a
    rounded image gives a position with an exact image (Sterbenz's lemma). A second iteration is needed only
    if an atom moved out of the box.
    """
    from mdnum.md.cell import wrap_positions

    wrapped, _ = wrap_positions(cell, positions)
    moved = images @ np.asarray(cell.matrix)
    elsewhere = wrapped + moved
    for _ in range(4):
        wrapped, _ = wrap_positions(cell, elsewhere)
        elsewhere = wrapped + moved
    again, _ = wrap_positions(cell, elsewhere)
    return wrapped, elsewhere, int((again != wrapped).any(axis=1).sum())


# --- numbers --------------------------------------------------------------------------------------------


@choice("ulps")
class Ulps(Choice):
    """A parameter of the system file, changed to a nearby float.

    At constant energy, the temperature in the system file sets only the initial velocities.
    """

    screened: ClassVar = {world: " ".join(f"ulps={key}" for key in keys) for world, keys in OFTEN.items()}
    shown = True
    key: str = ""  # dotted, such as "cutoff.radius", "potential.pairs.A-B.sigma" or "stop.tol"
    ulps: int = 1  # how many floats away, with sign

    def __post_init__(self):
        check(bool(self.key), "no number is named", "ulps", "Write such as ulps=cutoff.radius:+1")
        some(self.ulps, self.name)

    def describe(self, world: str = "md") -> str:
        return f"{self.key} by {self.ulps:+d} {plural(self.ulps, 'ulp')}"

    def make(self, system: Any) -> Twin:
        numbers = floats(system)
        # one that somebody wrote may be a slip of the pen
        known = "" if self.key in OFTEN[world_of(system)] else f"; there are {', '.join(numbers)}"
        applies(self.key in numbers, f"it has no number {self.key}{known}")
        applies(numbers[self.key] != 0, f"{self.key} {_NO_NEIGHBOR}")
        before, dtype = as_used(system, self.key)
        after = float(neighbor(before, self.ulps, np.dtype(dtype)))
        difference = f"{self.key} = {after!r}, not {before!r}"
        bath = world_of(system) == "md" and "temperature" in system.integrator.numbers()
        if self.key == "dynamics.temperature" and not bath and not system.draw.drawn:
            from mdnum.systems.parameters import redrawn

            system = redrawn(system)
            difference += " (both with drawn velocities)"
        return twin(system, {self.key: after}, self.name, difference)


@choice("start")
class StartUlp(Choice):
    """One coordinate of the initial state, changed to a nearby float."""

    screened: ClassVar = {"md": "start", "ball": "start start=velocity:+1"}
    # the atom or the ball; None for that of the largest value. An ulp of a small coordinate would be lost in
    # the first addition
    which: int | None = None
    # 0, 1 or 2 for the axis of an atom's position, "height" or "velocity" of a ball; None for the largest
    # coordinate, or the height
    what: int | str | None = None
    ulps: int = 1  # how many floats of the state's dtype away, with sign

    def __post_init__(self):
        known = "0, 1 or 2 of an atom, height or velocity of a ball"
        good = self.what in (None, 0, 1, 2, "height", "velocity")
        check(good, f"coordinate {self.what!r}; expected {known}", "start")
        some(self.ulps, "start")

    @classmethod
    def parse(cls, argument: str, role: str, both: str | None) -> Choice:
        if not argument:
            return cls()
        parts = argument.split(":")
        which = None if parts[0] in ("height", "velocity") else number(parts.pop(0), int, "start")
        what = parts.pop(0) if parts else "height"
        count = number(parts.pop(0), int, "start") if parts else 1
        check(not parts, f"{argument!r} is not which:what:ulps", "start", "start=17:0:+1")
        return cls(which, what if what in ("height", "velocity") else number(what, int, "start"), count)

    def describe(self, world: str = "md") -> str:
        if world == "md":
            return f"one coordinate of the start by {self.ulps:+d} ulp"
        which = "one ball" if self.which is None else f"ball {self.which}"
        return f"{self.what or 'height'} of {which} at the start by {self.ulps:+d} ulp"

    def make(self, system: Any) -> Twin:
        is_md = world_of(system) == "md"
        count, noun = (system.atoms, "atom") if is_md else (system.balls, "ball")
        there = self.which is None or 0 <= self.which < count
        applies(there, f"there is no {noun} {self.which} among {count}")
        fits = self.what is None or isinstance(self.what, int) == is_md
        applies(fits, f"there is no coordinate {self.what}")
        return self._of_atoms(system) if is_md else self._of_balls(system)

    def _of_atoms(self, a: Simulation) -> Twin:
        from mdnum.md.cell import wrap_positions

        dtype = a.policy.dtype("state")
        x = wrap_positions(a.cell, a.positions)[0].astype(dtype)
        if self.which is None:
            fraction = x.astype(np.float64) @ np.asarray(a.cell.inverse)
            # an ulp must not carry it over a face
            inside = np.all(fraction < 1 - _NEAR, axis=1)
            size = np.abs(x) * inside[:, None]
            atom, axis = (int(k) for k in np.unravel_index(size.argmax(), x.shape))
        else:
            atom, axis = self.which, int(self.what or 0)
        before = x[atom, axis]
        x[atom, axis] = neighbor(before, self.ulps, dtype)
        moved = float(x[atom, axis] - before)
        difference = f"{'xyz'[axis]} of atom {atom} by {self.ulps:+d} ulp, {moved:.2g}"
        return simulations(a, replace(a, positions=x.astype(np.float64)), difference)

    def _of_balls(self, system: Any) -> Twin:
        a: Any = program_of(system)
        problem, what = a.problem, self.what or "height"
        key = "v0" if what == "velocity" else "y0"
        dtype = problem.world.policy.dtype("state")
        values = np.broadcast_to(np.asarray(getattr(problem, key)), np.shape(problem.y0)).astype(dtype)
        which = int(np.abs(values).argmax()) if self.which is None else self.which
        before = values[which]
        applies(float(before) != 0, f"the {what} {_NO_NEIGHBOR}")
        values[which] = neighbor(before, self.ulps, values.dtype)
        moved = float(values[which]) - float(before)
        b = replace(a, problem=replace(problem, **{key: values.astype(np.float64)}))
        return Twin(a, b, f"{what} of ball {which} by {self.ulps:+d} ulp, {moved:.2g}")


@choice("noise")
class NoiseChoice(Choice):
    """Another random key for the thermostat's noise."""

    worlds = ("md",)
    seed: int | None = None  # of the key; None for the next after the system's own

    def __post_init__(self):
        check(self.seed is None or self.seed >= 0, f"seed {self.seed} is negative", "noise")

    def make(self, system: Simulation) -> Twin:
        import equinox as eqx
        import jax

        scheme = system.integrator
        applies(scheme.random is not None, f"there is no noise in {type(scheme).__name__} (dynamics.kind)")
        own = system.draw.seed
        seed = own + 1 if self.seed is None else self.seed
        applies(seed != own, f"the seed is {seed} already")
        a = system
        integrator = eqx.tree_at(lambda one: one.random, a.integrator, jax.random.key(seed))
        return simulations(a, replace(a, integrator=integrator), f"noise of seed {seed}, not {own}")


@choice("energy-shift")
class EnergyShift(Choice):
    """Pair energies shifted to zero at the cutoff, or not shifted.

    The conserved energies of the two runs differ, but their trajectories do not.
    """

    worlds = ("md",)
    must_hold = True

    def make(self, system: Simulation) -> Twin:
        if not system.pairwise:
            raise InputError("the potential of the system includes its own cutoff, which cannot be replaced")
        kind = system.cutoff.name
        applies(kind in ("hard", "shifted"), f"a {kind} cutoff changes the force too")
        other = "shifted" if kind == "hard" else "hard"
        b = varied(system, {"cutoff.kind": other})
        return simulations(system, b, f"cutoff {other}, not {kind}: the same forces")
