"""mdnum: neighbor-set flips, forks and gradients of cutoff-based molecular dynamics.

The names below are imported on first use (PEP 562), because jax takes half a second to import and
jax_md takes six, and `mdnum --help` needs neither.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

__version__ = "0.1.0"

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
    from mdnum.verbs import audit as _audit
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

    audit_calculator = _audit.audit

__getattr__, __dir__, __all__ = on_first_use(
    __name__,
    {
        "doctor": "diagnose",
        "errors": "CapacityError FolderError InputError MdnumError NumericalError",
        "references": "MdnumCalculator",
        "systems": "build load systems",
        "verbs.audit": "audit_calculator=audit",
        "verbs.ball": "bounce",
        "verbs.conform": "conform",
        "verbs.demos": "demonstrate",
        "verbs.flips": "flips",
        "verbs.fork": "fork fork_benign fork_folders fork_screen",
        "verbs.fork_certify": "fork_certify fork_processes",
        "verbs.fork_map": "fork_forecast fork_map",
        "verbs.grad": "grad",
        "verbs.run": "run",
    },
)
__all__ += ["__version__"]
