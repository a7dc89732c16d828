"""Rate limit of log lines, so that no peer can flood the log."""

from collections.abc import Sequence
from dataclasses import dataclass

from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event, Omitted

KIND_MAX = 5
"""Largest number of events of a kind that are logged in a second; further ones are counted."""


@dataclass(slots=True)
class _Second:
    end_ns: int
    logged: int = 0
    omitted: int = 0


class Limit:
    """Limiter of log events: the first few of each kind in a second are logged.

    The limit is per kind, not per vehicle, because an attacker can use any vehicle's number.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, _Second] = {}

    def admit(self, event: Event, *, now_ns: int) -> Sequence[Event]:
        """Events to log now: `Omitted` counts of past seconds, and this event if still allowed.

        An `Omitted` event is not returned: its count is added to the omitted events of its kind.
        """
        kind = event.kind if isinstance(event, Omitted) else type(event).__name__
        over = self.omitted(kind, now_ns=now_ns)
        second = self._seconds.setdefault(kind, _Second(now_ns + SECOND_NS))
        if isinstance(event, Omitted):
            second.omitted += event.count
        elif second.logged < KIND_MAX:
            second.logged += 1
            return [*over, event]
        else:
            second.omitted += 1
        return over

    def omitted(self, *kinds: str, now_ns: int | None) -> list[Omitted]:
        """Counts of events omitted in past seconds; each count is returned once.

        Args:
            kinds: kinds of events; empty for all.
            now_ns: time now; None also returns the counts of the present second.
        """
        events = []
        for kind in kinds or tuple(self._seconds):
            second = self._seconds.get(kind)
            if second is not None and (now_ns is None or now_ns >= second.end_ns):
                del self._seconds[kind]
                if second.omitted:
                    events.append(Omitted(kind=kind, count=second.omitted))
        return events
