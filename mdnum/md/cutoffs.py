"""Cutoffs: formulas that truncate, shift or switch a pair potential u(r) at r_cut.

A cutoff maps the value u and slope w = du/d(r²) of the bare potential to those of the cut potential, for
pairs inside the cutoff. The module `decide` determines which pairs are inside the cutoff.

A cutoff is a class with a formula `cut`, a name and a smoothness. The rest of the package finds a cutoff by
its name in `CUTOFFS`. A class may also define the independent implementation `reference` and the interval
arithmetic `enclose`. By default, `reference` and `enclose` are derived from `cut`.

All formulas work with numpy and jax arrays. This module does not import jax.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from mdnum.registry import Registry


class AtCutoff(NamedTuple):
    """Constants of the bare potential at its cutoff radius, one value per pair type (or one per pair)."""

    # r_cut, r_onset: cutoff and onset of switching, length
    r_cut: Float[Any, "..."]
    r_onset: Float[Any, "..."]
    energy: Float[Any, "..."]  # u(r_cut)
    slope: Float[Any, "..."]  # du/dr at r_cut


class Undecided(Exception):
    """Error raised if an interval contains a threshold, so that the decision cannot be proven."""


class Cutoff(ABC):
    """Base class of cutoffs. The first line of the docstring of a subclass is its description in reports."""

    name: ClassVar[str]  # the word of system files
    # the cut energy is C^k at r_cut (and at the onset); -1 where the energy itself jumps
    smoothness: ClassVar[int]
    switches: ClassVar[bool] = False  # has an onset radius below which the potential is untouched

    @abstractmethod
    def cut(self, r2, u, w, at: AtCutoff) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
        """Return energy and slope of the cut potential, for pairs inside r_cut.

        Args:
            r2: squared distances, length².
            u, w: bare energy and du/d(r²) at r2.
            at: constants at the cutoff, broadcast against r2.

        Returns:
            (energy, denergy/d(r²)).
        """

    def energy_jump(self, at: AtCutoff):
        """Return the energy jump when a pair enters the cutoff: its energy just inside r_cut."""
        return self._limits(at)[0] if self.smoothness < 0 else 0 * at.energy

    def force_jump(self, at: AtCutoff):
        """Return the radial force jump (energy/length) of a pair that enters. Positive if repulsive."""
        return -2 * at.r_cut * self._limits(at)[1] if self.smoothness < 1 else 0 * at.slope

    def jumps(self, at: AtCutoff):
        """Return (energy jump, force jump) of each term of the potential."""
        return [(self.energy_jump(at), self.force_jump(at))]

    def _limits(self, at: AtCutoff):
        return self.cut(at.r_cut * at.r_cut, at.energy, at.slope / (at.r_cut + at.r_cut), at)

    @property
    def continuous(self) -> Cutoff:
        """A cutoff with the same forces and an energy that is continuous at r_cut."""
        return self if self.smoothness >= 0 else Level(self)

    def reference(
        self, r: Float[np.ndarray, "pairs"], u: Float[np.ndarray, "pairs"], du: Any, at: AtCutoff
    ) -> tuple[Float[np.ndarray, "pairs"], Float[np.ndarray, "pairs"]]:
        """Return energy and derivative du/dr in float64 on the host, as a reference for `cut`.

        The default method differentiates the energy of `cut` with jax. The slope returned by `cut` is not
        used.

        Args:
            r, u, du: distances, bare energy and its derivative with respect to r.
            at: constants at the cutoff, numbers.
        """
        import jax
        import jax.numpy as jnp

        given, along = (r * r, u), (2 * r, du)
        energy, slope = jax.jvp(
            lambda r2, u: self.cut(r2, u, jnp.zeros_like(u), at)[0],
            tuple(map(jnp.asarray, given)),
            tuple(map(jnp.asarray, along)),
        )
        return np.asarray(energy), np.asarray(slope)

    def enclose(
        self, pull: Callable[[Any], Any], energy: Callable[[Any], Any], at: AtCutoff
    ) -> Callable[[Any], Any]:
        """Return a function that computes 2 du/d(r²) of the cut potential in ball arithmetic.

        The default executes the operations of `cut` in ball arithmetic.

        Args:
            pull, energy: 2 du/d(r²) and u of the bare potential, as functions of the ball r².
            at: constants at the cutoff, balls.

        Raises:
            Undecided: raised by the returned function if the ball contains the onset.
        """
        from mdnum.numerics.exact import enclosed

        cut = enclosed(lambda r2, u, w, *at: self.cut(r2, u, w, AtCutoff(*at))[1], 7)
        return lambda r2: 2 * cut(r2, energy(r2), pull(r2) / 2, *at)[0]

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash((type(self), *vars(self).values()))


#: Derivatives of the energy with respect to r² that `check` examines, by order.
_DERIVATIVES = ("energy", "slope", *(f"derivative {order} by r²" for order in range(2, 7)))
_ORDERS = len(_DERIVATIVES) - 1


def check(cutoff: type[Cutoff] | Cutoff) -> None:
    """Check a cutoff's slope against its energy, and its smoothness against its declaration.

    The test potentials are u = 1/r² and u = 1/r⁶ with r_cut = 2 and onset 1.6. Energy and derivatives (nested
    jvp in r²) are evaluated within 2⁻⁴⁶ of the onset and of r_cut. The derivative one order above the
    declared smoothness must jump for at least one potential. An energy difference above 1e-9 u(r_cut) counts
    as a jump. A difference of derivative k is a jump if it exceeds 1e-5 u(r_cut) k! / (r_cut² - r_onset²)^k.
    Jumps elsewhere and derivatives beyond the sixth are not tested.

    Raises:
        ValueError: the test fails; the message contains the quantity and the distance.
    """
    import jax

    made = cutoff if isinstance(cutoff, Cutoff) else cutoff()
    if not isinstance(getattr(made, "name", None), str):
        raise ValueError("the cutoff has no name")
    with jax.enable_x64(True):
        ends = [_ends(made, power) for power in (1, 3)]
    if made.smoothness < _ORDERS and not any(ends):
        after = _DERIVATIVES[max(made.smoothness + 1, 0)]
        raise ValueError(f"smoothness {made.smoothness} is too low: even the cutoff’s {after} is continuous")


def _ends(made: Cutoff, power: int) -> bool:
    """Check a cutoff of u = r^(-2 power). Return True if derivative smoothness + 1 jumps."""
    import jax
    import jax.numpy as jnp

    at = AtCutoff(*map(np.float64, (2.0, 1.6, 4.0**-power, -power * 4.0**-power)))
    claimed, ends = made.smoothness, False

    def cut(x):
        return made.cut(x, x**-power, -power / x ** (power + 1), at)

    def derivative_of(function):
        return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]

    r = np.linspace(1.0, 2.0, 41)[:-1]
    energy, slope = cut(r**2)
    derivatives = [lambda x: cut(x)[0]]
    for _ in range(min(max(claimed, 0) + 1, _ORDERS)):
        derivatives.append(derivative_of(derivatives[-1]))
    off = ~(np.abs(2 * r * (slope - derivatives[1](jnp.asarray(r**2)))) <= 1e-9)
    if off.any():
        raise ValueError(
            f"if r_cut = 2, the cutoff's slope at r = {r[off.argmax()]:g} is not the derivative of its energy"
        )
    if made.switches and not np.allclose(energy[r < 1.6], r[r < 1.6] ** (-2 * power), rtol=1e-12):
        raise ValueError("the switching function changes the energy at distances below the switching onset")

    edges = np.array([1.6**2 * (1 - 2**-46), 1.6**2 * (1 + 2**-46), 4 * (1 - 2**-46)])
    for order in range(min(claimed + 1, _ORDERS) + 1):
        below, above, last = map(float, derivatives[order](jnp.asarray(edges)))
        least = (1e-5 if order else 1e-9) * at.energy * math.factorial(order) / (2.0**2 - 1.6**2) ** order
        for place, jump in (("the onset", above - below), ("r_cut", -last)):
            if abs(jump) <= least:
                continue
            # no event tells of a jump of the energy at the onset, whatever is claimed
            if order <= claimed or (order == 0 and place == "the onset"):
                raise ValueError(
                    f"the {_DERIVATIVES[order]} jumps by {jump:g} at {place}, which contradicts the "
                    f"declared smoothness {claimed} of the cutoff"
                )
            ends = True
    inside, steep = (float(value[2]) for value in cut(edges))
    for name, limit, least in (("energy", inside, 1e-9 * at.energy), ("force", -4 * steep, -1e-5 * at.slope)):
        told = float(getattr(made, f"{name}_jump")(at))
        if not abs(told - limit) <= least:
            raise ValueError(f"{name}_jump is {told:g}; expected {limit:g}, the {name} just below r_cut")
    return ends


#: All cutoffs by name; a package can add one by an entry point of this group.
CUTOFFS: Registry[Cutoff] = Registry("cutoff", "mdnum.cutoffs", kind=Cutoff, check=check)


def _shipped(cutoff: type[Cutoff]) -> type[Cutoff]:
    return CUTOFFS.add(cutoff.name, cutoff)


class _Truncated(Cutoff):
    """Base class of cutoffs that leave the force unchanged up to r_cut."""

    def force_jump(self, at):
        return -at.slope

    def enclose(self, pull, energy, at):
        return pull


@_shipped
class Hard(_Truncated):
    """Truncated without a shift: the energy jumps by u(r_cut) at every crossing."""

    name = "hard"
    smoothness = -1

    def cut(self, r2, u, w, at):
        return u, w

    @property
    def continuous(self):
        return Shifted()

    def reference(self, r, u, du, at):
        return u, du


@_shipped
class Shifted(_Truncated):
    """Energy shifted to zero at r_cut; forces and trajectory are the same as for `hard`."""

    name = "shifted"
    smoothness = 0

    def cut(self, r2, u, w, at):
        return u - at.energy, w

    def reference(self, r, u, du, at):
        return u - at.energy, du


@_shipped
class ForceShifted(Cutoff):
    """Energy and force shifted to zero at r_cut: u(r) - u(r_cut) - (r - r_cut) u'(r_cut)."""

    name = "force-shifted"
    smoothness = 1

    def cut(self, r2, u, w, at):
        r = r2.__array_namespace__().sqrt(r2)
        return u - at.energy - (r - at.r_cut) * at.slope, w - at.slope / (r + r)

    def reference(self, r, u, du, at):
        return u - at.energy - (r - at.r_cut) * at.slope, du - at.slope

    def enclose(self, pull, energy, at):
        return lambda r2: pull(r2) - at.slope / r2.sqrt()


class _Switching(Cutoff):
    """Base class of cutoffs with a switching factor s(r), decreasing from 1 at the onset to 0 at r_cut."""

    switches = True

    def factor(self, r, at: AtCutoff):
        """Return the switching factor s(r) and ds/dr beyond the onset, in numpy."""
        raise NotImplementedError

    def factor_of_ball(self, r2, at: AtCutoff):
        """Return the switching factor s and 2 ds/d(r²) beyond the onset, in ball arithmetic."""
        raise NotImplementedError

    def reference(self, r, u, du, at):
        s, ds = self.factor(r, at)
        beyond = r > at.r_onset
        s, ds = np.where(beyond, s, 1.0), np.where(beyond, ds, 0.0)
        return s * u, s * du + ds * u

    def enclose(self, pull, energy, at):
        onset = at.r_onset * at.r_onset

        def switched(r2):
            # the switch starts smoothly, but the side of the onset must be proven too
            if r2 > onset:
                s, ds = self.factor_of_ball(r2, at)
                return pull(r2) * s + energy(r2) * ds
            if r2 <= onset:
                return pull(r2)
            raise Undecided

        return switched


@_shipped
class Switched(_Switching):
    """C1 switching function of r², from onset to r_cut, as in jax-md, HOOMD-blue and ASE (smooth=True).

    Beyond the onset ro, S = (rc² - r²)² (rc² + 2 r² - 3 ro²) / (rc² - ro²)³.
    """

    name = "switched"
    smoothness = 1

    def cut(self, r2, u, w, at):
        b, a = at.r_cut * at.r_cut, at.r_onset * at.r_onset
        cube = (b - a) * (b - a) * (b - a)
        s = (b - r2) * (b - r2) * (b + (r2 + r2) - (a + a + a)) / cube
        ds = 6 * (b - r2) * (a - r2) / cube
        beyond = r2 > a
        where = r2.__array_namespace__().where
        return where(beyond, u * s, u), where(beyond, w * s + u * ds, w)

    def factor(self, r, at):
        x, a, b = r * r, at.r_onset**2, at.r_cut**2
        width = (b - a) ** 3
        return (b - x) ** 2 * (b + 2.0 * x - 3.0 * a) / width, 12.0 * r * (b - x) * (a - x) / width

    def factor_of_ball(self, r2, at):
        b, a = at.r_cut * at.r_cut, at.r_onset * at.r_onset
        cube = (b - a) * (b - a) * (b - a)
        return (b - r2) * (b - r2) * (b + 2 * r2 - 3 * a) / cube, 12 * (b - r2) * (a - r2) / cube


class _SwitchedInDistance(_Switching):
    """Base class of switching functions of t, which increases from 0 at the onset to 1 at r_cut."""

    @abstractmethod
    def switch(self, t) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
        """Return the switching function of t in [0, 1], and its derivative."""

    def switch_of_ball(self, t):
        """Return the switching function of t and its derivative, in ball arithmetic."""
        return self.switch(t)

    def cut(self, r2, u, w, at):
        xp = r2.__array_namespace__()
        r = xp.sqrt(r2)
        width = at.r_cut - at.r_onset
        t = (r - at.r_onset) / width
        s, ds = self.switch(t)
        beyond = t > 0
        return xp.where(beyond, u * s, u), xp.where(beyond, w * s + u * ds / (width * (r + r)), w)

    def factor_of_ball(self, r2, at):
        r, width = r2.sqrt(), at.r_cut - at.r_onset
        s, ds = self.switch_of_ball((r - at.r_onset) / width)
        return s, ds / (width * r)


@_shipped
class Quintic(_SwitchedInDistance):
    """C2 quintic switch 1 - 10 t³ + 15 t⁴ - 6 t⁵, with t from 0 at the onset to 1 at r_cut."""

    name = "quintic"
    smoothness = 2

    def switch(self, t):
        rest = 1 - t
        return 1 - t * t * t * (10 - t * (15 - 6 * t)), -30 * t * t * rest * rest

    def factor(self, r, at):
        width = at.r_cut - at.r_onset
        x = (r - at.r_onset) / width
        return 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x * x), -30.0 * x * x * (1.0 - x) ** 2 / width


@_shipped
class Cosine(_SwitchedInDistance):
    """C1 cosine switch (1 + cos(pi t)) / 2, t from 0 at the onset to 1 at r_cut, as in neural networks."""

    name = "cosine"
    smoothness = 1

    def switch(self, t):
        xp = t.__array_namespace__()
        return (1 + xp.cos(math.pi * t)) / 2, -(math.pi / 2) * xp.sin(math.pi * t)

    def switch_of_ball(self, t):
        return (1 + t.cos_pi()) / 2, -(type(t).pi() / 2) * t.sin_pi()

    def factor(self, r, at):
        phase = np.pi * (r - at.r_onset) / (at.r_cut - at.r_onset)
        return 0.5 * (1.0 + np.cos(phase)), -0.5 * np.pi / (at.r_cut - at.r_onset) * np.sin(phase)


class Level(Cutoff):
    """Cutoff that shifts the energy of another cutoff to zero at r_cut; the forces are unchanged."""

    name = "level"
    smoothness = 0

    def __init__(self, inner: Cutoff):
        self.inner = inner

    @property
    def switches(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True if the underlying cutoff has an onset."""
        return self.inner.switches

    def cut(self, r2, u, w, at):
        energy, slope = self.inner.cut(r2, u, w, at)
        return energy - self.inner.energy_jump(at), slope
