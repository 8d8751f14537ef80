"""Contact models: a force, an iterated projection, an impact."""

from __future__ import annotations

from mdnum.ball.contacts.base import Contact, Motion, Moved
from mdnum.ball.contacts.impact import Impact
from mdnum.ball.contacts.penalty import Penalty
from mdnum.ball.contacts.projection import Projection

__all__ = ["Contact", "Impact", "Motion", "Moved", "Penalty", "Projection"]
