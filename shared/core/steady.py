"""Steady time for an endpoint whose host's clock jumps.

An endpoint counts on a clock that goes forward, and no faster than life. Where the clock goes back,
or leaps ahead, what it does by its clock would be an hour early or late, and stamps of before and
after would not be of one time. Seen through `Steady` the clock stands still for such a jump and
goes on from there:

    steady = clock - (all jumps so far)

A stall of the host, in which real time passes, is no jump: it is passed on as it is.
"""

from collections.abc import Sequence
from typing import Any

from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Datagram, Endpoint
from skytether.shared.core.events import Event
from skytether.shared.scenario.schema import Scenario

JUMP_NS = 60 * SECOND_NS
"""Time by which a clock may go on between two looks at it, or past a wake that is due [ns]; more is
a jump."""


class Steady(Endpoint):
    """An endpoint around an endpoint, which it shows a steady time.

    An endpoint that waits for datagrams alone may wait for as long as it takes: only a clock that
    goes back jumps then.

    Args:
        inner: the endpoint.
    """

    def __init__(self, inner: Endpoint) -> None:
        super().__init__()
        self._inner = inner
        self.changeable, self.patience_ns = inner.changeable, inner.patience_ns
        self.keeps = inner.keeps
        self._seen_ns: int | None = None
        """Time that the clock showed last."""
        self._jumps_ns = 0
        """Sum of all jumps [ns]."""

    def _steady(self, now_ns: int) -> int:
        """Time to be shown."""
        seen_ns = now_ns if self._seen_ns is None else self._seen_ns
        self._seen_ns = now_ns
        if not 0 <= now_ns - seen_ns <= JUMP_NS and self._is_jump(seen_ns, now_ns):
            # All of it, so that steady time stands still for the jump and goes on from there.
            self._jumps_ns += now_ns - seen_ns
        return now_ns - self._jumps_ns

    def _is_jump(self, seen_ns: int, now_ns: int) -> bool:
        if now_ns < seen_ns:
            return True
        # Counted from when it was to be woken: an endpoint that sleeps for an hour until its wake
        # has not jumped.
        due_ns = self.next_wake_ns()
        return due_ns is not None and now_ns - max(seen_ns, due_ns) > JUMP_NS

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self._inner.receive(datagram, now_ns=self._steady(now_ns))

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self._inner.wake(now_ns=self._steady(now_ns))

    def next_wake_ns(self) -> int | None:
        """See `Endpoint`."""
        due_ns = self._inner.next_wake_ns()
        return due_ns if due_ns is None else due_ns + self._jumps_ns

    def close(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self._inner.close(now_ns=self._steady(now_ns))

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        """See `Endpoint`."""
        return self._inner.objection(scenario, keys)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """See `Endpoint`."""
        self._inner.change(scenario, keys, now_ns=self._steady(now_ns))

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self._inner.learn_time(utc_ns, error_ns, now_ns=self._steady(now_ns))

    def keep(self, *, now_ns: int) -> bytes | None:
        """See `Endpoint`; what is kept names times by how long ago they were."""
        return self._inner.keep(now_ns=self._steady(now_ns))

    def kept(self) -> None:
        """See `Endpoint`."""
        self._inner.kept()

    def tell(self, event: Event) -> None:
        """See `Endpoint`."""
        self._inner.tell(event)

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        return self._inner.figures()

    @property
    def finished(self) -> bool:
        """See `Endpoint`."""
        return self._inner.finished

    def outbox(self) -> list[Datagram]:
        """See `Endpoint`."""
        return self._inner.outbox()

    def events(self) -> Sequence[Event]:
        """See `Endpoint`."""
        return self._inner.events()
