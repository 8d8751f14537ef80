"""Plan of a sweep, made before any run: settings, points and folders."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mdnum.errors import InputError, MdnumError
from mdnum.plain import plain
from mdnum.provenance import hashes
from mdnum.sweeps.design import Axis, Design, Point, checked, label, parse, points, with_base
from mdnum.sweeps.measures import USUAL, Measure, chosen
from mdnum.sweeps.points import address_of, state_point
from mdnum.systems.toml import flat

#: Number of frames of a run from which positions are measured.
_FRAMES = 200
#: Labels of a setting, one per axis.
Setting = tuple[str, ...]


@dataclass(frozen=True)
class Question:
    """Arguments of a sweep (see `mdnum.sweep`)."""

    seeds: int | Sequence[int] = 4
    measure: Sequence[str] | str = USUAL["md"]
    steps: int | None = None
    design: Design = "one-at-a-time"
    samples: int = 16
    tolerance: Mapping[str, float] | float | None = None
    converged: Mapping[str, str] | None = None
    save_every: int | None = None
    joint: Sequence[Mapping[str, Any]] = ()  # settings that are run beside those of the design


@dataclass(frozen=True)
class Planned:
    """A point of a sweep, with its address on disk."""

    point: Point
    setting: Setting
    settings: Mapping[str, Any]  # keys of the system file
    state: Mapping[str, Any]
    address: str
    wrong: str = ""  # why it cannot be run


@dataclass(frozen=True)
class Plan:
    """Settings, points and measures of a sweep, determined before any run.

    Attributes:
        loaded: the system or simulation with its own values. system, overrides: arguments from which `loaded`
            was made.
        base: the value of each axis that is kept while another axis is varied.
        points: points in the order in which they are run.
        steps: number of steps of a run at the system's own time step.
    """

    loaded: Any
    system: Any
    overrides: Mapping[str, Any]
    axes: Sequence[Axis]
    base: Mapping[str, Any]
    seeds: Sequence[int]
    measures: Sequence[Measure]
    points: Sequence[Planned]
    steps: int
    units: str
    atoms: int
    question: Question

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measures of this sweep."""
        return tuple(measure.name for measure in self.measures)

    @property
    def wanted(self) -> dict[str, str]:
        """Digest of the source files of each measure, as stored with results."""
        return {measure.name: measure.digest for measure in self.measures}

    @property
    def origin(self) -> Setting:
        """The setting in which every choice has the value of the system file."""
        return self.setting(self.base)

    def setting(self, choices: Mapping[str, Any]) -> Setting:
        """Return a setting as a tuple of labels: the formatted values of all varied choices."""
        return tuple(label(choices[axis.key]) for axis in self.axes)

    def along(self, axis: Axis) -> Iterator[tuple[Any, Setting]]:
        """Yield (value, setting) for each value of one choice. Other choices keep their base values."""
        for value in axis.values:
            yield value, self.setting({**self.base, axis.key: value})


def planned(system: Any, over: Any, question: Question, overrides: Mapping[str, Any] | None) -> Plan:
    """Return the plan of a sweep from its arguments.

    Raises:
        InputError: a choice or a measure does not exist, or the system cannot be swept.
    """
    from mdnum.systems import BallSystem, System, load
    from mdnum.systems.build import build
    from mdnum.systems.load import world_of
    from mdnum.systems.simulation import Simulation

    axes = _axes(over)
    seeds = list(range(question.seeds)) if isinstance(question.seeds, int) else list(question.seeds)
    if not seeds:
        raise InputError("no random seed was given", remedy="Give at least one seed")
    overrides = dict(overrides or {})
    if isinstance(system, System):
        # one that was loaded takes no overrides any more, its simulation does
        system, overrides = build(system, overrides), {}
    filed = not isinstance(system, Simulation)
    loaded: Any = load(system, overrides) if filed else system
    world = world_of(loaded)
    if world == "ball":
        # nothing of it is drawn
        seeds = seeds[:1]
    measures = chosen(_words(USUAL[world] if question.measure == USUAL["md"] else question.measure), world)
    own = flat(loaded.spec.model_dump(mode="json") if filed else loaded.program)
    base = {axis.key: _own_value(axis, own, loaded, system, overrides) for axis in axes}
    filling = question.design == "space-filling"
    axes = axes if filling else [with_base(axis, base[axis.key]) for axis in axes]
    table = "integrator" if world == "ball" else "dynamics"
    own_steps = getattr(loaded.spec, table).steps if filed else loaded.steps
    steps = own_steps if question.steps is None else question.steps
    if checks := [measure.check for measure in measures if measure.check is not None]:
        simulation = build(loaded) if filed else loaded
        for check in checks:
            check(simulation, steps)
    framed = any(measure.needs == "frames" for measure in measures)
    every = (question.save_every or max(1, steps // _FRAMES)) if framed else 0
    pace = float(own[f"{table}.timestep"])
    rows: list[Planned] = []
    firsts, seeded = dict[str, Planned](), False
    designed = points(axes, base, seeds, question.design, question.samples)
    own_choices = [one.choices for one in designed]
    joint = [one for one in question.joint if one not in own_choices]
    for point in [*designed, *(Point(choices, seed) for seed in seeds for choices in joint)]:
        settings: dict[str, Any] = {"dynamics.seed": point.seed} if world == "md" else {}
        for axis in axes:
            if point.choices[axis.key] != base[axis.key] or filling:
                settings |= axis.settings(point.choices[axis.key], world)
        key = json.dumps({**settings, "dynamics.seed": None})
        if seeded and key in firsts:
            rows.append(_of_seed(firsts[key], point, settings))
            continue
        # of the same time, whatever the step: results would differ by how long they were waited for
        share = pace / float(settings.get(f"{table}.timestep", pace))
        run = {"steps": round(steps * share), "save_every": max(1, round(every * share)) if every else 0}
        setting = tuple(label(point.choices[axis.key]) for axis in axes)
        try:
            if isinstance(system, Simulation | BallSystem):
                one: Any = resolved(loaded, settings)
            else:
                one = load(loaded.path, {**overrides, **settings})
        except MdnumError as error:
            rows.append(Planned(point, setting, settings, {}, "", str(error)))
            continue
        program = json.loads(json.dumps(one.program))
        # what is asked of a run counts as asked, whatever its file says
        program.get(table, {}).pop("steps", None)
        program.pop("record", None)
        state = state_point(program, hashes(one)["structure"], run)
        rows.append(Planned(point, setting, settings, state, address_of(state)))
        if (first := firsts.setdefault(key, rows[-1])) is not rows[-1]:
            # where the second seed of a setting changes nothing else, no setting is resolved again for one
            seeded = _of_seed(first, point, settings) == rows[-1]
    units = "ball" if world == "ball" else loaded.units.name
    atoms = loaded.balls if world == "ball" else len(loaded.atoms) if filed else loaded.atoms
    return Plan(
        loaded, system, overrides, axes, base, seeds, measures, rows, steps, units, atoms, question
    )  # fmt: skip


def _of_seed(one: Planned, point: Point, settings: Mapping[str, Any]) -> Planned:
    """Return a planned point that differs only in its random seed."""
    system = one.state["system"]
    dynamics = {**system["dynamics"], "seed": settings["dynamics.seed"]}
    state = {**one.state, "system": {**system, "dynamics": dynamics}}
    return replace(one, point=point, settings=settings, state=state, address=address_of(state))


def resolved(simulation: Any, settings: Mapping[str, Any]) -> Any:
    """Return a copy of a simulation or ball system with other values of some keys.

    The seed draws initial velocities, as for a system file.
    """
    from mdnum.systems import BallSystem
    from mdnum.systems.load import vary
    from mdnum.systems.parameters import changed, redrawn

    if isinstance(simulation, BallSystem):
        spec = simulation.spec
        return replace(simulation, spec=vary("setting", settings, spec, "--over") if settings else spec)
    return changed(simulation if simulation.draw.drawn else redrawn(simulation), settings)


def _words(given: Sequence[str] | str) -> list[str]:
    texts = [given] if isinstance(given, str) else given
    return [word.strip() for text in texts for word in text.split(",") if word.strip()]


def _axes(over: Any) -> list[Axis]:
    texts = [over] if isinstance(over, str) else over
    if isinstance(texts, Mapping):
        axes = [checked(Axis(key, tuple(plain(list(values))))) for key, values in texts.items()]
    else:
        axes = [parse(text) for text in texts]
    if not axes:
        raise InputError("no setting is varied", remedy="Give --over KEY=VALUE,VALUE,…")
    return axes


def _own_value(axis: Axis, own: Mapping[str, Any], loaded: Any, system: Any, overrides: Any) -> Any:
    """Return a choice's base value: that of the system file, or else the first in the sweep."""
    from mdnum.systems import BallSystem, load
    from mdnum.systems.parameters import names, number, resolve

    if axis.key == "precision":
        return "float64"
    if own.get(axis.key) is not None:
        return own[axis.key]
    if system is loaded and not isinstance(loaded, BallSystem):
        return number(loaded, resolve(loaded, axis.key, names(loaded)))
    # a key that the file leaves to its default, or one that does not exist, as loading it says
    (resolved if isinstance(system, BallSystem) else load)(
        system, {**overrides, **axis.settings(axis.values[0])}
    )
    return axis.values[0]
