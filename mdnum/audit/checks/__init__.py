"""Registry of the calculator checks of mdnum and of plugins."""

from __future__ import annotations

import pkgutil
from typing import Any

from mdnum.registry import Registry

#: Each file NAME.py contains the class NameCheck, a `mdnum.audit.base.AuditCheck`; it is imported on first
#: use.
CHECKS: Registry[Any] = Registry("check", "mdnum.checks")
for _file in pkgutil.iter_modules(__path__):
    CHECKS.add(_file.name, f"{__name__}.{_file.name}:{_file.name.capitalize()}Check")
