"""Fleet: many vehicles in one process, each with its own client and socket."""

from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import Any

from skytether.client.endpoint import Client, figures
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Failure
from skytether.shared.scenario.schema import Scenario


class ClientFleet(Endpoint):
    """Clients driven as one endpoint; client n uses socket n. No client may have been woken yet."""

    def __init__(self, clients: Sequence[Client], apart_ns: int = 0) -> None:
        super().__init__()
        self._clients = clients
        self._apart_ns = apart_ns
        """Time from one client's start to the next [ns]; 0 once the starts are scheduled."""
        self.changeable = clients[0].changeable
        self._due_ns = [client.next_wake_ns() for client in clients]
        self._heap = [(due_ns, n) for n, due_ns in enumerate(self._due_ns) if due_ns is not None]
        """Requested wakes: time [ns] and client number. Outdated ones stay until their time."""
        heapify(self._heap)
        self._flying = set(range(len(clients)))

    @property
    def finished(self) -> bool:
        return not self._flying

    @property
    def failure(self) -> Failure | None:
        return next((client.failure for client in self._clients if client.failure), None)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        own = datagram._replace(socket=0)
        self._clients[datagram.socket].receive(own, now_ns=now_ns)
        self._after(datagram.socket)

    def next_wake_ns(self) -> int | None:
        heap, due_ns = self._heap, self._due_ns
        # Outdated wakes stay in the heap until their time: removing one earlier would need a
        # search.
        while heap and due_ns[heap[0][1]] != heap[0][0]:
            heappop(heap)
        return heap[0][0] if heap else None

    def wake(self, *, now_ns: int) -> None:
        """Wake all clients that are due. The first call schedules their starts."""
        if self._apart_ns:
            self._heap = [(now_ns + n * self._apart_ns, n) for n in range(len(self._clients))]
            self._due_ns = [due_ns for due_ns, _ in self._heap]
            self._apart_ns = 0
        while (due_ns := self.next_wake_ns()) is not None and due_ns <= now_ns:
            _, n = heappop(self._heap)
            self._due_ns[n] = None
            self._clients[n].wake(now_ns=now_ns)
            self._after(n)

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:
        for client in self._clients:
            client.learn_time(utc_ns, error_ns, now_ns=now_ns)

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        objections = (client.objection(scenario, keys) for client in self._clients)
        return next(filter(None, objections), "")

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        for client in self._clients:
            client.change(scenario, keys, now_ns=now_ns)

    def leave(self, *, now_ns: int) -> int:
        latest_ns = max(client.leave(now_ns=now_ns) for client in self._clients)
        for n in range(len(self._clients)):
            self._after(n)
        return latest_ns

    def close(self, *, now_ns: int) -> None:
        for n, client in enumerate(self._clients):
            client.close(now_ns=now_ns)
            self._after(n)

    def _after(self, n: int) -> None:
        client = self._clients[n]
        for payload, peer, _ in client.outbox():
            self._out.append(Datagram(payload, peer, n))
        self._events += client.events()
        if client.finished:
            self._flying.discard(n)
        due_ns = client.next_wake_ns()
        if due_ns is not None and due_ns != self._due_ns[n]:
            heappush(self._heap, (due_ns, n))
        self._due_ns[n] = due_ns

    def figures(self) -> dict[str, Any]:
        return figures(self._clients)
