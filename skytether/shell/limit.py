"""Rate limit of log lines: the log stays readable whatever peers cause."""

from collections.abc import Sequence
from dataclasses import dataclass

from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.events import Event, Omitted

KIND_MAX = 5
"""Most events of a kind that are logged in a second; the others are counted."""


@dataclass(slots=True)
class _Second:
    """Events of a kind in one second, which begins with the first of them."""

    end_ns: int
    told: int = 0
    """Number of logged events."""
    omitted: int = 0
    """Number of events left out."""


class Limit:
    """Limiter of log events: the first few of each kind in a second are logged.

    The limit is per kind, not per kind and vehicle: a stranger may claim any vehicle's number.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, _Second] = {}

    def admit(self, event: Event, *, now_ns: int) -> Sequence[Event]:
        """Events to log now: counts of those omitted in past seconds, and this one if within the
        limit.

        An `Omitted` event itself adds to the count of its kind.
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
        """Counts of events omitted in the seconds that are over, each returned once.

        Args:
            kinds: kinds to look at; if empty, all.
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
