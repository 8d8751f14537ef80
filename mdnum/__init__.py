"""mdnum: neighbor-set flips, forks and gradients of cutoff-based molecular dynamics.

The names below are imported on first use (PEP 562), because jax takes half a second to import and
jax_md takes six, and `mdnum --help` needs neither.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# where each public name lives; a value without ":" is the module itself
_HOMES = {
    "CapacityError": "mdnum.errors:CapacityError",
    "FolderError": "mdnum.errors:FolderError",
    "InputError": "mdnum.errors:InputError",
    "MdnumCalculator": "mdnum.references:MdnumCalculator",
    "MdnumError": "mdnum.errors:MdnumError",
    "NumericalError": "mdnum.errors:NumericalError",
    "audit_calculator": "mdnum.verbs.audit:audit",
    "bounce": "mdnum.verbs.ball:bounce",
    "build": "mdnum.systems:build",
    "conform": "mdnum.verbs.conform:conform",
    "demonstrate": "mdnum.verbs.demos:demonstrate",
    "diagnose": "mdnum.doctor:diagnose",
    "flips": "mdnum.verbs.flips:flips",
    "fork": "mdnum.verbs.fork:fork",
    "fork_benign": "mdnum.verbs.fork:fork_benign",
    "fork_certify": "mdnum.verbs.fork_certify:fork_certify",
    "fork_folders": "mdnum.verbs.fork:fork_folders",
    "fork_forecast": "mdnum.verbs.fork_map:fork_forecast",
    "fork_map": "mdnum.verbs.fork_map:fork_map",
    "fork_processes": "mdnum.verbs.fork_certify:fork_processes",
    "fork_screen": "mdnum.verbs.fork:fork_screen",
    "grad": "mdnum.verbs.grad:grad",
    "load": "mdnum.systems:load",
    "run": "mdnum.verbs.run:run",
    "systems": "mdnum.systems",
}

if TYPE_CHECKING:
    from mdnum import systems as systems
    from mdnum.doctor import diagnose as diagnose
    from mdnum.errors import CapacityError as CapacityError
    from mdnum.errors import FolderError as FolderError
    from mdnum.errors import InputError as InputError
    from mdnum.errors import MdnumError as MdnumError
    from mdnum.errors import NumericalError as NumericalError
    from mdnum.references import MdnumCalculator as MdnumCalculator
    from mdnum.systems import build as build
    from mdnum.systems import load as load
    from mdnum.verbs.audit import audit as audit_calculator
    from mdnum.verbs.ball import bounce as bounce
    from mdnum.verbs.conform import conform as conform
    from mdnum.verbs.demos import demonstrate as demonstrate
    from mdnum.verbs.flips import flips as flips
    from mdnum.verbs.fork import fork as fork
    from mdnum.verbs.fork import fork_benign as fork_benign
    from mdnum.verbs.fork import fork_folders as fork_folders
    from mdnum.verbs.fork import fork_screen as fork_screen
    from mdnum.verbs.fork_certify import fork_certify as fork_certify
    from mdnum.verbs.fork_certify import fork_processes as fork_processes
    from mdnum.verbs.fork_map import fork_forecast as fork_forecast
    from mdnum.verbs.fork_map import fork_map as fork_map
    from mdnum.verbs.grad import grad as grad
    from mdnum.verbs.run import run as run

__all__ = [
    "CapacityError",
    "FolderError",
    "InputError",
    "MdnumCalculator",
    "MdnumError",
    "NumericalError",
    "__version__",
    "audit_calculator",
    "bounce",
    "build",
    "conform",
    "demonstrate",
    "diagnose",
    "flips",
    "fork",
    "fork_benign",
    "fork_certify",
    "fork_folders",
    "fork_forecast",
    "fork_map",
    "fork_processes",
    "fork_screen",
    "grad",
    "load",
    "run",
    "systems",
]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'mdnum' has no attribute {name!r}")
    module_name, _, attribute = home.partition(":")
    module = importlib.import_module(module_name)
    value = getattr(module, attribute) if attribute else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
