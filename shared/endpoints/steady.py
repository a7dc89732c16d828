"""Steady time for an endpoint whose host's clock jumps.

An endpoint needs a clock that advances at the rate of real time. If the clock is set back or ahead,
scheduled work would be late or early, and time stamps before and after it could not be compared.
`Steady` removes every jump, so that the endpoint's time stands still during the jump, and then
continues:

    steady = clock - (all jumps so far)

If the host stalls, real time passes; a stall is no jump and is passed on unchanged.
"""

from collections.abc import Sequence
from typing import Any

from skytether.shared.base.units import JUMP_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Event
from skytether.shared.scenario.schema import Scenario


class Steady(Endpoint):
    """Wraps an endpoint, and passes steady time to it.

    An endpoint without a due wake may wait for a datagram for any length of time. So for such an
    endpoint only a step of the clock backwards counts as a jump.
    """

    def __init__(self, inner: Endpoint) -> None:
        super().__init__()
        self._inner, self.pending = inner, inner.pending
        self.changeable, self.patience_ns = inner.changeable, inner.patience_ns
        self.keeps, self.directions = inner.keeps, inner.directions
        self._seen_ns: int | None = None
        self._jumps_ns = 0

    def _steady(self, now_ns: int) -> int:
        seen_ns = now_ns if self._seen_ns is None else self._seen_ns
        self._seen_ns = now_ns
        if not 0 <= now_ns - seen_ns <= JUMP_NS and self._is_jump(seen_ns, now_ns):
            # Subtract the whole jump, so that steady time does not advance in it.
            self._jumps_ns += now_ns - seen_ns
        return now_ns - self._jumps_ns

    def _is_jump(self, seen_ns: int, now_ns: int) -> bool:
        if now_ns < seen_ns:
            return True
        # The advance counts from the due wake, because an hour of waiting for a wake is no jump.
        due_ns = self.next_wake_ns()
        return due_ns is not None and now_ns - max(seen_ns, due_ns) > JUMP_NS

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._inner.receive(datagram, now_ns=self._steady(now_ns))

    def wake(self, *, now_ns: int) -> None:
        self._inner.wake(now_ns=self._steady(now_ns))

    def next_wake_ns(self) -> int | None:
        due_ns = self._inner.next_wake_ns()
        return due_ns if due_ns is None else due_ns + self._jumps_ns

    def leave(self, *, now_ns: int) -> int:
        return self._inner.leave(now_ns=self._steady(now_ns)) + self._jumps_ns

    def close(self, *, now_ns: int) -> None:
        self._inner.close(now_ns=self._steady(now_ns))

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        return self._inner.objection(scenario, keys)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        self._inner.change(scenario, keys, now_ns=self._steady(now_ns))

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:
        self._inner.learn_time(utc_ns, error_ns, now_ns=self._steady(now_ns))

    def keep(self, *, now_ns: int) -> bytes | None:
        """State for the next run; its times are relative to the time of writing."""
        return self._inner.keep(now_ns=self._steady(now_ns))

    def kept(self, *, nothing: bool = False) -> None:
        self._inner.kept(nothing=nothing)

    @property
    def waits_for_disk(self) -> bool:  # type: ignore[override]
        return self._inner.waits_for_disk

    def tell(self, event: Event) -> None:
        self._inner.tell(event)

    def undelivered(self, socket: int, reason: str) -> None:
        self._inner.undelivered(socket, reason)

    def figures(self) -> dict[str, Any]:
        return self._inner.figures()

    @property
    def finished(self) -> bool:
        return self._inner.finished

    def outbox(self) -> list[Datagram]:
        return self._inner.outbox()

    def events(self) -> Sequence[Event]:
        return self._inner.events()
