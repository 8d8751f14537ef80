"""The contract that both worlds meet: decide outside, act inside."""

from __future__ import annotations

from typing import Any, Protocol


class Dynamics(Protocol):
    """A step that receives its decisions instead of making them in passing.

    Then the ledger holds what was used and not a recomputation, a replay can hand one run the decisions of
    another, and a gradient can hold the decisions fixed.
    """

    def margins(self, state: Any) -> Any:
        """Signed distances of the state's quantities to their thresholds; positive means yes."""
        ...

    def step(self, state: Any, decisions: Any) -> Any:
        """The next state, acting on the decisions it is told."""
        ...
