"""Delta debugging: the smallest set of units that suffices (ddmin: Zeller and Hildebrandt, 2002).

Units are left out, first many at a time and finally one by one, until none can be left out any
more. The result suffices, and no single unit of it can be left out; another such set may be
smaller. Neighbouring units are left out together, so related units should be neighbours.
"""

from collections.abc import Callable, Sequence
from itertools import islice
from typing import TypeVar

U = TypeVar("U")


def smallest(
    units: Sequence[U],
    suffice: Callable[[Sequence[tuple[U, ...]]], Sequence[bool]],
    at_once: int = 1,
) -> tuple[U, ...]:
    """Smallest set of units that suffices, in order; the complete set is assumed to suffice.

    Args:
        suffice: returns whether each of several sets suffices; called often, never with all units.
        at_once: number of sets that are tried at once, for example in as many processes. The
            result does not depend on it.
    """
    kept = tuple(units)
    size, dropped = len(kept), True
    while size > 1 or dropped:
        size, first, dropped = max(1, size // 2), 0, False
        while first < len(kept):
            firsts = list(islice(range(first, len(kept), size), at_once))
            tried = [kept[:each] + kept[each + size :] for each in firsts]
            good = next((i for i, holds in enumerate(suffice(tried)) if holds), None)
            if good is None:
                first = firsts[-1] + size
            else:
                kept, first, dropped = tried[good], firsts[good], True
    return kept
