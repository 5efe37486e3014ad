"""When a run whose goal is a relative error looks at the error, and when it ends."""

from __future__ import annotations

import math
from collections.abc import Callable

__all__ = ["FIRST_LOOK", "StoppingRule"]

FIRST_LOOK = 32
"""Batches at the first look."""

# Photons beyond the number that should reach the goal, since most looks would else come a little too early.
_RESERVE = 1.05
# Errors of few batches may be far too large: at the next look there are at most so many times as many.
_MOST = 8
# A run whose error first reaches the goal goes on by this times the share of the variance that one batch has, at most
# by as many photons again.
_GOING_ON = 4.0


class StoppingRule:
    """The rule of one run.

    It looks for the number of photons at which the error reaches the goal. A run that ended there would end where rare
    bright photons have not come yet: too dark, with an error that is too small. So it goes on by a part of these
    photons that is fixed there and then, and ends whatever the last of them bring. The part is small where many photons
    matter equally, 40 to 80 batches; where few decide it is as many photons again, so that half had no say in it.

    Args:
        goal: Relative error.
    """

    def __init__(self, goal: float) -> None:
        self._goal, self._found = goal, False

    def next_look(self, batches: int, error: float, share: Callable[[], float]) -> int | None:
        """Batches at the next look; None if the run ends.

        Args:
            batches: So far.
            error: Relative error after these, infinite if it is not known.
            share: Gives the part of the variance between batches that one of them has, in [0, 1].
        """
        if self._found:
            return None
        if error <= self._goal:
            self._found = True
            return batches + math.ceil(batches * min(1.0, _GOING_ON * share()))
        most, excess = _MOST * batches, error / self._goal
        wanted = math.ceil(_RESERVE * batches * excess**2) if excess < math.inf else most
        return min(max(wanted, batches + max(1, batches // 16)), most)
