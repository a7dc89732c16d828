"""Virtual time: any number of endpoints on one clock that jumps from instant to instant.

Between endpoints a datagram takes no time (delays are netem's business, and netem is an endpoint
here as well). Every host has a clock of its own, with offset and drift, and may take time to
compute when it is woken: what it then sends leaves, and it can be woken again, only once it is
done. It hears all along, so that its computing for one peer does not delay another that only talks
to it. A host can be stopped and begin another life, be frozen for a while, and have its clock set:
what happens to hosts is done by actions that the world is given with their time (`World.at`). Time
is integer nanoseconds, and whatever happens at one instant happens in a fixed order:
the same inputs give the same outcome everywhere, and hosts that never meet do not change each
other's.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import Protocol

from skytether.shared.core.endpoint import Address, Datagram, Endpoint
from skytether.shared.core.events import Event

BILLION = 1_000_000_000
FROZEN_MAX = 6_500
"""Most datagrams that wait for a frozen host: as many of 600 B as the buffer of a socket holds."""


@dataclass(frozen=True, slots=True)
class Clock:
    """A host's monotonic clock, as a function of the world's time."""

    offset_ns: int = 0
    """Time that it shows at time 0 of the world [ns]."""
    drift_ppb: int = 0
    """Rate by which it runs faster than the world's [10⁻⁹]."""

    def local(self, time_ns: int) -> int:
        """Time that it shows at a time of the world."""
        shown_ns = self.offset_ns + time_ns
        return shown_ns + time_ns * self.drift_ppb // BILLION if self.drift_ppb else shown_ns

    def world(self, local_ns: int) -> int:
        """First time of the world at which it shows at least this time."""
        passed_ns = local_ns - self.offset_ns
        if not self.drift_ppb:
            return passed_ns
        return passed_ns - passed_ns * self.drift_ppb // (BILLION + self.drift_ppb)

    def changed(self, time_ns: int, *, step_ns: int = 0, drift_ppb: int | None = None) -> "Clock":
        """Clock that goes on from this one.

        Args:
            time_ns: time of the world from which it is read [ns].
            step_ns: how much later it shows then than this one [ns].
            drift_ppb: its own rate; None keeps this one's.
        """
        drift_ppb = self.drift_ppb if drift_ppb is None else drift_ppb
        offset_ns = self.local(time_ns) + step_ns - Clock(0, drift_ppb).local(time_ns)
        return Clock(offset_ns, drift_ppb)


class _Still(Endpoint):
    """What stands in for the endpoint of a host that is down or frozen: it does nothing.

    Args:
        inner: the endpoint.
        room: most datagrams that wait for it; none do for a host that is down.
        armed_ns: time of the world at which its timer ends, or None.
    """

    def __init__(self, inner: Endpoint, room: int, armed_ns: int | None = None) -> None:
        super().__init__()
        self.armed_ns = armed_ns
        self.inner = inner
        self.room = room
        self.waiting: deque[Datagram] = deque()
        """Datagrams that wait, in the order in which they came; there is no room for later ones."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        """Keep the datagram where there is room."""
        if len(self.waiting) < self.room:
            self.waiting.append(datagram)

    def wake(self, *, now_ns: int) -> None:
        """Nothing happens: it has never asked for it."""

    def next_wake_ns(self) -> None:
        """None: it is never woken."""


@dataclass(slots=True)
class Host:
    """One endpoint in the world; its socket s has the address (name, s)."""

    name: str
    endpoint: Endpoint
    clock: Clock
    turn: int
    """Place in the order in which hosts are woken at one instant, from 1: that of being added."""
    compute_ns: int
    """Time that it works whenever it is woken [ns]."""
    busy_until_ns: int
    """Time of the world until which it works, and cannot be woken."""
    on_finished: Callable[[], None] | None
    """Callback for the end of the endpoint, until it has been called."""
    armed_ns: int | None = None
    """Time of the world at which it is to be woken, or None."""
    due_ns: int | None = None
    """Time of its clock that `armed_ns` was found from; None where it is to be found anew."""


ACTION, ARRIVAL = -1, 0
"""Turns of an action and of a datagram: what happens to hosts comes first, and what has arrived is
heard before anybody acts on the time."""


class Act(Protocol):
    """Something that is done to an endpoint, by its own clock."""

    def __call__(self, *, now_ns: int) -> object:
        """Do it."""


class World:
    """Hosts, and what happens to them.

    Args:
        on_event: called with the time of the world, the host's name and the event, for each event
            of every endpoint, before the end of that endpoint is told.
    """

    def __init__(self, on_event: Callable[[int, str, Event], None] = lambda *_: None) -> None:
        self.now_ns = 0
        """Time of the world [ns]."""
        self._on_event = on_event
        self._hosts: dict[str, Host] = {}
        self._agenda: list[
            tuple[int, int, int, Host, Datagram | None]
            | tuple[int, int, int, None, Callable[[], None]]
        ] = []
        """Heap of what will happen: time, turn, order of entry, host, and the datagram that arrives
        there, or None for a wake; of an action no host and the action."""
        self._scheduled = 0
        """Number of entries so far."""
        self._arriving: deque[tuple[Host, Datagram]] = deque()
        """Datagrams that arrive at the present time, in the order in which they were sent."""

    def add(
        self,
        name: str,
        endpoint: Endpoint,
        *,
        clock: Clock = Clock(),
        start_ns: int = 0,
        compute_ns: int = 0,
        on_finished: Callable[[], None] | None = None,
    ) -> Address:
        """Add a host.

        Args:
            name: name of the host, unlike any other's.
            endpoint: what runs on it.
            clock: its clock.
            start_ns: time of the world before which it is not woken.
            compute_ns: time that it works whenever it is woken [ns].
            on_finished: called once, when the endpoint has just finished.

        Returns:
            Address of the host.
        """
        assert name not in self._hosts
        turn = len(self._hosts) + 1
        host = Host(name, endpoint, clock, turn, compute_ns, start_ns, on_finished)
        self._hosts[name] = host
        self._arm(host)
        return (name, 0)

    def at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Have an action done at a time of the world that has not passed."""
        assert time_ns >= self.now_ns
        self._scheduled += 1
        heappush(self._agenda, (time_ns, ACTION, self._scheduled, None, action))

    def stop(self, name: str) -> None:
        """Take a host down: it hears nothing and sends nothing, nor what it has just computed."""
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
        """Let a host begin another life, at its address and with its clock, from now on.

        Args:
            name: name of the host, which may be down, frozen, or at work until now.
            endpoint: what runs on it from now on; its end is told unless one was told before.
        """
        self.stop(name)
        host = self._hosts[name]
        host.endpoint, host.busy_until_ns = endpoint, self.now_ns
        self._arm(host)

    def freeze(self, name: str) -> None:
        """Stop a host's time: datagrams wait for it, as many as there is room for.

        One that is down or frozen already stays as it is.
        """
        host = self._hosts[name]
        if not isinstance(host.endpoint, _Still):
            host.endpoint = _Still(host.endpoint, FROZEN_MAX, host.armed_ns)
            host.armed_ns = None

    def thaw(self, name: str) -> None:
        """Let a frozen host go on: it hears what has waited, and then is woken, if it wants to.

        One that is not frozen stays as it is.
        """
        host = self._hosts[name]
        still = host.endpoint
        if isinstance(still, _Still) and still.room:
            host.endpoint = still.inner
            for datagram in still.waiting:
                self._receive(host, datagram)
            if not still.waiting and still.armed_ns is not None:
                host.armed_ns, host.due_ns = max(self.now_ns, still.armed_ns), None
                self._at(host.armed_ns, host.turn, host, None)

    def set_clock(self, name: str, *, step_ns: int = 0, drift_ppb: int | None = None) -> None:
        """Step a host's clock now, or change its rate from now on.

        The host is not told. What it waits for is on a timer, which counts on: it comes when it
        would have come.

        Args:
            name: name of the host.
            step_ns: time by which the clock goes ahead, or back [ns].
            drift_ppb: rate by which it runs faster than the world's [10⁻⁹]; None leaves it.
        """
        host = self._hosts[name]
        host.clock = host.clock.changed(self.now_ns, step_ns=step_ns, drift_ppb=drift_ppb)
        host.due_ns = None

    def set_compute(self, name: str, compute_ns: int) -> None:
        """Change the time that a host works whenever it is woken [ns]."""
        self._hosts[name].compute_ns = compute_ns

    def rearm(self, name: str) -> None:
        """Ask a host when it wants to be woken, after an action has given it something to do."""
        self._arm(self._hosts[name])

    def act(self, name: str, act: Act) -> None:
        """Do something to a host's endpoint now, and let it say what it has to say of that.

        Args:
            name: name of the host.
            act: called with the time that the host's clock shows.
        """
        host = self._hosts[name]
        try:
            act(now_ns=host.clock.local(self.now_ns))
        finally:
            self._after(host, self.now_ns)

    def run(self, until: Callable[[], bool], *, limit_ns: int) -> None:
        """Let time pass until a condition holds, or until a time of the world."""
        agenda, arriving, receive = self._agenda, self._arriving, self._receive
        while (agenda or arriving) and not until():
            # What was sent at an earlier time waits on the agenda, and arrives first.
            if arriving and not (agenda and agenda[0][:2] <= (self.now_ns, ARRIVAL)):
                receive(*arriving.popleft())
                continue
            if agenda[0][0] > limit_ns:
                return
            entry = heappop(agenda)
            self.now_ns = entry[0]
            if entry[3] is None:
                entry[4]()
            elif entry[4] is None:
                self._wake(entry[3])
            else:
                receive(entry[3], entry[4])

    def _at(self, time_ns: int, turn: int, host: Host, datagram: Datagram | None) -> None:
        self._scheduled += 1
        heappush(self._agenda, (time_ns, turn, self._scheduled, host, datagram))

    def _arm(self, host: Host) -> None:
        due_ns = host.endpoint.next_wake_ns()
        if due_ns is None:
            host.armed_ns = None
            return
        if due_ns == host.due_ns and host.armed_ns is not None:
            return  # it is armed for that already
        host.due_ns = due_ns
        time_ns = host.clock.world(due_ns)
        time_ns = max(time_ns, host.busy_until_ns)
        time_ns = max(time_ns, self.now_ns)
        if time_ns != host.armed_ns:
            host.armed_ns = time_ns
            self._at(time_ns, host.turn, host, None)

    def _wake(self, host: Host) -> None:
        now_ns = self.now_ns
        if host.armed_ns != now_ns:
            return  # it has changed its mind since
        host.armed_ns = None
        host.endpoint.wake(now_ns=host.clock.local(now_ns))
        host.busy_until_ns = now_ns + host.compute_ns
        self._after(host, host.busy_until_ns)

    def _receive(self, host: Host, datagram: Datagram) -> None:
        host.endpoint.receive(datagram, now_ns=host.clock.local(self.now_ns))
        self._after(host, self.now_ns)

    def _after(self, host: Host, leaves_ns: int) -> None:
        """Let its datagrams leave, hand on its events, and arm its next wake."""
        endpoint = host.endpoint
        for payload, (name, socket), source in endpoint.outbox():
            receiver = self._hosts.get(name)
            if receiver is None:
                continue
            arrived = Datagram(payload, (host.name, source), socket)
            if leaves_ns == self.now_ns:
                self._arriving.append((receiver, arrived))
            else:
                self._at(leaves_ns, ARRIVAL, receiver, arrived)
        for event in endpoint.events():
            self._on_event(self.now_ns, host.name, event)
        self._arm(host)
        if host.on_finished is not None and endpoint.finished:
            host.on_finished()
            host.on_finished = None
