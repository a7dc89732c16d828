"""How much is said of a kind: whatever peers cause, a log stays short enough to be read."""

from collections.abc import Sequence
from dataclasses import dataclass

from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.events import Event, Omitted

KIND_MAX = 5
"""Events of a kind that are told in a second; the others are counted."""


@dataclass(slots=True)
class _Second:
    """Events of a kind in one second, which begins with the first of them."""

    end_ns: int
    told: int = 0
    """Number of events told."""
    omitted: int = 0
    """Number of events left out."""


class Limit:
    """Chooses the events that are told: of each class the first few in a second.

    A class is a kind, and not a vehicle's events of a class: a stranger may call himself by any
    number.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, _Second] = {}

    def admit(self, event: Event, *, now_ns: int) -> Sequence[Event]:
        """Events to tell now: what was left out of a second that is over, and this one if it may.

        An `Omitted` is added to what is left out of its kind.
        """
        kind = event.kind if isinstance(event, Omitted) else type(event).__name__
        over = self.omitted(kind, now_ns=now_ns)
        second = self._seconds.setdefault(kind, _Second(now_ns + SECOND_NS))
        if isinstance(event, Omitted):
            second.omitted += event.count
        elif second.told < KIND_MAX:
            second.told += 1
            return [*over, event]
        else:
            second.omitted += 1
        return over

    def omitted(self, *kinds: str, now_ns: int | None) -> list[Omitted]:
        """What was left out of the seconds that are over, each told once.

        Args:
            kinds: kinds to look at; all, if there are none.
            now_ns: time at which a second is over or not; None ends every second.
        """
        told = []
        for kind in kinds or tuple(self._seconds):
            second = self._seconds.get(kind)
            if second is not None and (now_ns is None or now_ns >= second.end_ns):
                del self._seconds[kind]
                if second.omitted:
                    told.append(Omitted(kind=kind, count=second.omitted))
        return told
