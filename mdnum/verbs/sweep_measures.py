"""Measures of a sweep that need further runs: divergence of runs, and gradients.

The measures are defined here, because `mdnum.sweeps` must not import forks and gradients.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.sweeps.measures import MEASURES, Measure, Sample, Value

_FORKS, _GRADIENTS = ("forks/**/*.py",), ("forks/**/*.py", "gradients/**/*.py")
_LOSS = "LOSS/PARAMETER"


def _twin(simulation: Any, steps: int, argument: str) -> Any:
    from mdnum.forks.choices import parse, twin_of

    return twin_of(parse(argument or "start", "md"), simulation)


def _pair(run: Sample, argument: str) -> Any:
    """Run a system twice until the runs diverge. By default, one initial coordinate differs by one ulp."""
    from mdnum.forks import fork

    if ("fork", argument) not in run.made:
        twin = _twin(run.simulation, run.summary["steps"], argument)
        made = fork(twin, run.summary["steps"], counterfactual=False, repeats=0)
        run.made["fork", argument] = made
    return run.made["fork", argument]


def _date(run: Sample, argument: str, name: str) -> Value:
    found = _pair(run, argument)
    step = getattr(found.dates, name)
    if step is None:
        raise InputError(f"the two runs do not {name} within {found.steps} steps", remedy="Use more steps")
    return Value(float(step * found.twin.a.timestep))


def fork(run: Sample, argument: str) -> Value:
    """Time at which two runs first decide differently. Error: scatter between seeds."""
    return _date(run, argument, "fork")


def split(run: Sample, argument: str) -> Value:
    """Time until two runs are 0.01 cutoff radii apart. Error: scatter between seeds."""
    return _date(run, argument, "split")


def separation(run: Sample, argument: str) -> Value:
    """Fitted exponential growth rate (1/time) of the distance between two runs."""
    found = _pair(run, argument)
    grown = found.growth["B"]
    if not grown.plain:
        raise InputError("runs A and B do not diverge exponentially", remedy="Use more steps")
    return Value(float(grown.rate / found.twin.a.timestep))


def _asked(simulation: Any, steps: int, argument: str) -> tuple[Any, str]:
    """Return the loss and the full parameter name that a text LOSS/PARAMETER means."""
    from mdnum.gradients import parameters
    from mdnum.gradients.losses import parse

    word, slash, parameter = argument.rpartition("/")
    if not slash:
        remedy = "Write gradient=potential/sigma"
        raise InputError(f"{argument!r} is not of the form {_LOSS}", remedy=remedy)
    name, *others = parameters.resolve(simulation, [parameter])
    if others or np.ndim(parameters.value(simulation, name)):
        raise InputError(f"{parameter} is not a single number", remedy="Name a scalar parameter")
    return parse(word, simulation, steps), name


def _diagnosis(run: Sample, argument: str) -> tuple[Any, str]:
    """Return the diagnosis of `mdnum grad` (gradient and trust horizon), and the full parameter name."""
    from mdnum.gradients import Problem
    from mdnum.gradients.diagnose import diagnose

    if argument not in run.made:
        steps = int(run.summary["steps"])
        loss, name = _asked(run.simulation, steps, argument)
        parts, methods = ("agreement", "trust"), ("event-aware", "symmetric")
        found = diagnose(Problem(run.simulation, loss, steps), (name,), parts=parts, methods=methods)
        run.made[argument] = found, name
    return run.made[argument]


def gradient(run: Sample, argument: str) -> Value:
    """Derivative of a loss with respect to a parameter, by the reference method of `mdnum grad`."""
    found, name = _diagnosis(run, argument)
    if found.agreement is None:
        raise InputError(found.failed["agreement"])
    reference = found.agreement.gradient(found.agreement.reference)
    return Value(float(np.asarray(reference.gradient[name])))


def horizon(run: Sample, argument: str) -> Value:
    """Time up to which a derivative of a loss can be trusted. Error: scatter between seeds."""
    found, _ = _diagnosis(run, argument)
    if found.trust is None:
        raise InputError(found.failed["trust"])
    if found.trust.verdict == "trusted":
        raise InputError("the trust horizon lies beyond the end of the run", remedy="Use more steps")
    if found.trust.verdict != "limited":
        raise InputError(f"the trust horizon is undecided; missing tests: {', '.join(found.trust.unknown)}")
    return Value(float(found.trust.horizon * run.simulation.integrator.timestep))


for _name, _unit, _title, _of in (
    ("fork", "time", "time until two runs that differ by a rounding error make different decisions", fork),
    ("split", "time", "time until two such runs are a hundredth of the cutoff apart", split),
    ("separation", "1/time", "rate at which the separation of two such runs grows", separation),
    ("gradient", "", "derivative of a loss with respect to a parameter", gradient),
    ("horizon", "time", "time up to which the derivative of a loss is trusted", horizon),
):
    _kind = ("CHOICE", _FORKS, _twin) if _of in (fork, split, separation) else (_LOSS, _GRADIENTS, _asked)
    MEASURES.add(_name, Measure(_name, _unit, _title, _of, "simulation", takes=_kind[0], sources=_kind[1],
                                check=_kind[2]))  # fmt: skip
