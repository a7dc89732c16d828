"""World: hosts in virtual time that can be stopped, restarted and frozen, and whose clocks can be
set.

The state that an endpoint saves survives a restart of its host. `sim.hosts` has the clocks and the
queue of future events.
"""

from collections import deque
from collections.abc import Callable
from heapq import heapify

from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Event
from skytether.sim.hosts import Clock, Host, Hosts

FROZEN_MAX = 6_500
"""Capacity of a frozen host's queue: a socket's buffer holds 6500 datagrams of 600 B."""


def changed(clock: Clock, time_ns: int, *, step_ns: int = 0, drift_ppb: int | None = None) -> Clock:
    """Clock after a step of `step_ns` or a change of rate at `time_ns`, a time of the world [ns].

    If `drift_ppb` is None, the rate stays the same.
    """
    drift_ppb = clock.drift_ppb if drift_ppb is None else drift_ppb
    offset_ns = clock.local(time_ns) + step_ns - Clock(0, drift_ppb).local(time_ns)
    return Clock(offset_ns, drift_ppb)


class _Still(Endpoint):
    """Stand-in for the endpoint of a host that is down or frozen.

    Args:
        capacity: largest number of queued datagrams; 0 for a host that is down.
        armed_ns: time of the world at which the host's timer ends, or None.
    """

    def __init__(self, inner: Endpoint, capacity: int, armed_ns: int | None = None) -> None:
        super().__init__()
        self.armed_ns = armed_ns
        self.inner = inner
        self.capacity = capacity
        self.waiting: deque[Datagram] = deque()
        """Queued datagrams in order of arrival; later ones are dropped when the queue is full."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        if len(self.waiting) < self.capacity:
            self.waiting.append(datagram)

    def wake(self, *, now_ns: int) -> None:
        """Do nothing: the stand-in never asks to be woken."""

    def next_wake_ns(self) -> None:
        """Return None: the stand-in is never woken."""


class World(Hosts):
    """Hosts that can be stopped, restarted and frozen, and the queue of their future events.

    Args:
        on_event: called for each event of an endpoint with the time of the world, the host's name
            and the event, before `on_finished` of that host.
    """

    def __init__(self, on_event: Callable[[int, str, Event], None] = lambda *_: None) -> None:
        super().__init__(on_event)
        self._memories: dict[str, tuple[bytes, int]] = {}
        """Newest state that an endpoint of each host has saved, and its time [ns; host's clock]."""

    def endpoint(self, name: str) -> Endpoint:
        """Endpoint of a host, also while it is down or frozen."""
        endpoint = self._hosts[name].endpoint
        return endpoint.inner if isinstance(endpoint, _Still) else endpoint

    def stop(self, name: str) -> None:
        """Take a host down: it receives nothing, and datagrams not yet sent are lost."""
        host = self._hosts[name]
        host.endpoint, host.armed_ns = _Still(host.endpoint, 0), None
        self._agenda[:] = [
            entry
            for entry in self._agenda
            if not (isinstance(entry[4], Datagram) and entry[4].peer[0] == name)
            or entry[0] == self.now_ns
        ]
        heapify(self._agenda)

    def restart(self, name: str, endpoint: Endpoint) -> None:
        """Start a new endpoint on a host, which may be up, down or frozen; address and clock stay.

        `on_finished` is called when the new endpoint finishes, unless it was called already.
        """
        self.stop(name)
        host = self._hosts[name]
        host.endpoint, host.busy_until_ns = endpoint, self.now_ns
        self._arm(host)

    def memory(self, name: str) -> tuple[bytes, int] | None:
        """Newest state that an endpoint of a host saved, and its time [ns; host's clock]."""
        return self._memories.get(name)

    def freeze(self, name: str) -> None:
        """Freeze a host: datagrams for it are queued, at most FROZEN_MAX.

        No effect on a host that is down or already frozen.
        """
        host = self._hosts[name]
        if not isinstance(host.endpoint, _Still):
            host.endpoint = _Still(host.endpoint, FROZEN_MAX, host.armed_ns)
            host.armed_ns = None

    def thaw(self, name: str) -> None:
        """Let a frozen host run again: it receives the queued datagrams, and then a wake that is
        due.

        No effect on a host that is not frozen.
        """
        host = self._hosts[name]
        still = host.endpoint
        if isinstance(still, _Still) and still.capacity:
            host.endpoint = still.inner
            for datagram in still.waiting:
                self._receive(host, datagram)
            if not still.waiting and still.armed_ns is not None:
                host.armed_ns, host.due_ns = max(self.now_ns, still.armed_ns), None
                self._at(host.armed_ns, host.turn, host, None)

    def set_clock(self, name: str, *, step_ns: int = 0, drift_ppb: int | None = None) -> None:
        """Step a host's clock, or change its rate from now on.

        The host is not informed. The time of its pending wake does not change, because timers are
        independent of the clock.

        Args:
            step_ns: step of the clock, forward or back [ns].
            drift_ppb: rate by which the clock gains on the world's time [10⁻⁹]; None: no change.
        """
        host = self._hosts[name]
        host.clock = changed(host.clock, self.now_ns, step_ns=step_ns, drift_ppb=drift_ppb)
        host.due_ns = None

    def set_compute(self, name: str, compute_ns: int) -> None:
        self._hosts[name].compute_ns = compute_ns

    def rearm(self, name: str) -> None:
        """Recompute a host's next wake after an action has changed its state."""
        self._arm(self._hosts[name])

    def _after(self, host: Host, leaves_ns: int) -> None:
        if host.endpoint.keeps:
            now_ns = host.clock.local(self.now_ns)
            if (content := host.endpoint.keep(now_ns=now_ns)) is not None:
                self._memories[host.name] = content, now_ns
                host.endpoint.kept()
        super()._after(host, leaves_ns)
