"""Many vehicles in one process: each a client of its own, with a socket of its own."""

from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import Any

from client.vehicle import Client
from shared.endpoint import Datagram, Endpoint

TOLD_MAX = 16
"""Vehicles that a report tells of one by one."""


class Fleet(Endpoint):
    """Clients driven as one endpoint; the n-th uses socket n."""

    def __init__(self, clients: Sequence[Client]) -> None:
        super().__init__()
        self._clients = clients
        self._due_ns = [client.next_wake_ns() for client in clients]
        self._heap = [(due_ns, n) for n, due_ns in enumerate(self._due_ns) if due_ns is not None]
        """When each wants to be woken; an entry that is no longer true stays until its time."""
        heapify(self._heap)
        self._flying = set(range(len(clients)))

    @property
    def finished(self) -> bool:
        """All have."""
        return not self._flying

    @property
    def failure(self) -> str | None:
        """Why some vehicle could not fly."""
        return next((client.failure for client in self._clients if client.failure), None)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """For the client whose socket it came to."""
        self._clients[datagram.socket].receive(datagram, now_ns=now_ns)
        self._after(datagram.socket)

    def next_wake_ns(self) -> int | None:
        """When the first of them wants to be woken."""
        heap, due_ns = self._heap, self._due_ns
        while heap and due_ns[heap[0][1]] != heap[0][0]:
            heappop(heap)
        return heap[0][0] if heap else None

    def wake(self, *, now_ns: int) -> None:
        """All whose time has come."""
        while (due_ns := self.next_wake_ns()) is not None and due_ns <= now_ns:
            _, n = heappop(self._heap)
            self._due_ns[n] = None
            self._clients[n].wake(now_ns=now_ns)
            self._after(n)

    def _after(self, n: int) -> None:
        """What a client that was driven wants: to send, to say, to be woken."""
        client = self._clients[n]
        for payload, peer, _ in client.outbox():
            self._out.append(Datagram(payload, peer, n))
        self._news += [f"vehicle {client.vehicle}: {line}" for line in client.news()]
        if client.finished:
            self._flying.discard(n)
        due_ns = client.next_wake_ns()
        if due_ns is not None and due_ns != self._due_ns[n]:
            heappush(self._heap, (due_ns, n))
        self._due_ns[n] = due_ns

    def report(self) -> str:
        """See `Endpoint`."""
        lines = [f"vehicle {client.vehicle}: {client.report()}" for client in self._clients]
        more = [f"and {len(lines) - TOLD_MAX} more"] if len(lines) > TOLD_MAX else []
        return "\n".join(lines[:TOLD_MAX] + more)

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        return {"missed": sum(client.missed for client in self._clients)}
