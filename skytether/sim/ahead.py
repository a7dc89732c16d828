"""A client in virtual time that is not woken at steps at which nothing happens.

Most vehicles send far less often than once a step. After each step the vehicle is flown ahead, up
to the next step at which something may happen (`sim.pilot`), and asks to be woken only then. If
something comes before, it goes on to the time of that, and forgets the steps after where that
changes them, as a heartbeat does not. What is sent, told and recorded is the same; only the order
of records is another one, see `Run.flight`.
"""

from collections.abc import Callable
from typing import Any

from skytether.client.endpoint import Client
from skytether.shared.core.endpoint import Datagram
from skytether.shared.scenario.schema import Scenario
from skytether.sim.pilot import AHEAD, CompiledPilot
from skytether.sim.world import Clock


class AheadClient(Client):
    """Client whose pilot flies ahead.

    Args:
        clock: clock of its host, which nobody sets in flight.
        world_ns: returns the time of the world.
        keys: those of `Client`.
    """

    def __init__(
        self, scenario: Scenario, *args: Any, clock: Clock, world_ns: Callable[[], int], **keys: Any
    ) -> None:
        super().__init__(scenario, *args, pilot=CompiledPilot, **keys)
        assert isinstance(self._pilot, CompiledPilot)
        self._ahead: CompiledPilot = self._pilot
        self._clock, self._world_ns = clock, world_ns
        self._span_ns = AHEAD * scenario.dt_ns
        """Longest time that is flown ahead [ns]."""

    def catch_up(self, *, keeps: bool = False) -> None:
        """Go on to the present.

        Args:
            keeps: whether the steps after that stay flown ahead.
        """
        pilot = self._ahead
        if not pilot.steps_ahead:
            return
        now_ns, woken_ns, count = self._world_ns(), 0, 0
        # What arrives at the begin of a step comes before the step.
        while count < pilot.steps_ahead:
            next_ns = self._clock.world(pilot.starts_ns(pilot.flown + count + 1))
            if next_ns >= now_ns:
                break
            woken_ns, count = next_ns, count + 1
        pilot.go_on(count, now_ns=self._clock.local(woken_ns), keeps=keeps)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """See `Endpoint`."""
        if not self._ahead.steps_ahead:
            super().receive(datagram, now_ns=now_ns)
            return
        self.catch_up(keeps=True)
        before = self._situation()
        super().receive(datagram, now_ns=now_ns)
        if before != self._situation():
            self._ahead.forget()

    def _situation(self) -> tuple[object, ...]:
        """Facts that a datagram may change, and that steps were flown ahead by."""
        session, failsafe, compensator = self._session, self._failsafe, self._ahead.compensator
        return (
            session.number,
            session.asked,
            failsafe.mode,
            failsafe.reason,
            compensator.newest,
            compensator.in_force,
            compensator.repeated,
        )

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self.catch_up()
        super().wake(now_ns=now_ns)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """See `Endpoint`."""
        self.catch_up()
        super().change(scenario, keys, now_ns=now_ns)

    def close(self, *, now_ns: int) -> None:
        """See `Endpoint`."""
        self.catch_up()
        super().close(now_ns=now_ns)

    def _due_ns(self) -> int | None:
        """See `Client`."""
        pilot = self._ahead
        if pilot.steps_ahead:
            return pilot.starts_ns(pilot.flown + pilot.steps_ahead + 1)
        return super()._due_ns()

    def _fly(self, now_ns: int) -> None:
        """See `Client`."""
        super()._fly(now_ns)
        session, pilot = self._session, self._ahead
        if not pilot.looks_ahead:
            return
        # Keys that are due make the vehicle say HELLO.
        if session.number is not None and not session.link.wants_hello(now_ns + self._span_ns):
            pilot.look_ahead(session.number, session.asked, now_ns=now_ns)
