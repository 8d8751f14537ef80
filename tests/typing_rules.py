"""The type checker that the tests put on mdnum's functions."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# an int where a float is expected is fine (PEP 484's numeric tower)
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
