"""A robot, its policy and the network between, in virtual time."""

import heapq
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

from skytether.client.link import ClientLink, PlainLink
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy import values
from skytether.policy.robot import LINE, RobotEnd, RobotOptions, Said
from skytether.policy.serving import PolicyEnd
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.scenario import reading

SERVER: Address = ("192.0.2.1", 47010)
ROBOT: Address = ("192.0.2.2", 5000)
PROGRAM: Address = ("program", 1)
METADATA = values.pack({"name": "scripted"})
MS = MILLISECOND_NS


def way(text: str, seed: int, name: str) -> tuple[Link, Lane]:
    made = impairments(text, reading.files_of("network.uplink", text, "network.uplink"))
    return Link(0, QUEUE_BYTES_MAX, None, made), Lane(0, Fates(made, seed, name, 0), 0)


class Lab:
    """Everything between a call of `infer` and its policy.

    Args:
        policy: from an observation to the reply; what it raises is an error of the policy.
        thinking_ns: time that the policy takes; None never answers.
    """

    def __init__(
        self,
        policy: Callable[[Any], Any],
        *,
        up: str = "none",
        down: str = "none",
        thinking_ns: int | None = 0,
        options: RobotOptions | None = None,
        seed: int = 1,
        link: ClientLink | None = None,
        gate: Gate | None = None,
        compress: Callable[[Any], Any] = lambda each: each,
        unpacked: Callable[[dict[Any, Any]], Any] | None = None,
        gives_rows: bool = False,
        boot_id: int = 7,
        server_boot_id: int = 9,
    ) -> None:
        self.options = options or RobotOptions("absolute", 150 * MS, step_ns=20 * MS)
        self.robot = RobotEnd(
            1, {0: SERVER}, link or PlainLink(), self.options, boot_id=boot_id, compress=compress
        )
        sessions = count(100)
        self.server = PolicyEnd(
            gate or PlainGate(),
            boot_id=server_boot_id,
            draw=lambda: next(sessions),
            gives_rows=gives_rows,
            unpacked=unpacked,
        )
        self.policy, self.thinking_ns = policy, thinking_ns
        self.up, self.down = way(up, seed, "up"), way(down, seed, "down")
        self.now_ns = SECOND_NS
        self.answers: list[tuple[int, bytes]] = []
        """Time of each message to the program, and what it says."""
        self._later: list[tuple[int, int, Callable[[], None]]] = []
        self._count = count()
        self.asked: list[Any] = []
        self.wire: list[tuple[Address, bytes]] = []
        """Datagrams as they leave, with their receiver."""
        self.cut = False
        """Whether nothing passes."""

    def at(self, time_ns: int, then: Callable[[], None]) -> None:
        heapq.heappush(self._later, (time_ns, next(self._count), then))

    def _take(self, endpoint: Endpoint) -> None:
        for payload, peer, socket in endpoint.outbox():
            if socket == LINE:
                self._said(endpoint, payload, peer)
                continue
            self.wire.append((peer, payload))
            if self.cut:
                continue
            link, lane = self.up if peer == SERVER else self.down
            link.accept(Datagram(payload, peer, 0), lane, now_ns=self.now_ns)

    def _said(self, endpoint: Endpoint, payload: bytes, peer: Address) -> None:
        if endpoint is self.robot:
            self.answers.append((self.now_ns, payload))
            return
        match payload[:1]:
            case Said.OPENED:
                self.at(self.now_ns, lambda: self.hear(Said.OPENED.value + METADATA, peer))
            case Said.MESSAGE if self.thinking_ns is not None:
                observation = values.unpack(payload[1:])
                self.asked.append(observation)
                try:
                    said = Said.MESSAGE.value + values.pack(self.policy(observation))
                except RuntimeError as error:
                    said = Said.ERROR.value + str(error).encode()
                self.at(self.now_ns + self.thinking_ns, lambda: self.hear(said, peer))

    def hear(self, said: bytes, peer: Address) -> None:
        self.server.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def program(self, said: bytes, peer: Address = PROGRAM) -> None:
        self.robot.receive(Datagram(said, peer, LINE), now_ns=self.now_ns)

    def run(self, until_ns: int, stop: Callable[[], bool] = lambda: False) -> None:
        """Let time pass until then, or until `stop` is true."""
        while True:
            for endpoint in (self.robot, self.server):
                self._take(endpoint)
            if stop():
                return
            links = [each[0].next_due_ns() for each in (self.up, self.down)]
            ends = [self.robot.next_wake_ns(), self.server.next_wake_ns(), *links]
            due = [each for each in ends if each is not None]
            if self._later:
                due.append(self._later[0][0])
            next_ns = max(min([*due, until_ns]), self.now_ns)
            if next_ns >= until_ns:
                self.now_ns = until_ns
                return
            self.now_ns = next_ns
            while self._later and self._later[0][0] <= next_ns:
                heapq.heappop(self._later)[2]()
            for link, _ in (self.up, self.down):
                for payload, peer, _ in link.release(now_ns=next_ns):
                    if peer == SERVER:
                        self.server.receive(Datagram(payload, ROBOT, 0), now_ns=next_ns)
                    else:
                        self.robot.receive(Datagram(payload, SERVER, 0), now_ns=next_ns)
            for endpoint in (self.robot, self.server):
                wake_ns = endpoint.next_wake_ns()
                if wake_ns is not None and wake_ns <= next_ns:
                    endpoint.wake(now_ns=next_ns)

    def connect(self) -> Any:
        """The program's connection; returns the policy's metadata."""
        self.program(Said.OPENED.value)
        self.run(self.now_ns + 60 * SECOND_NS, lambda: bool(self.answers))
        return values.unpack(self.answers[-1][1][1:])

    def infer(self, observation: Any, wait_ns: int = 70 * SECOND_NS) -> Any:
        """Answer to a call; raises RuntimeError with the text of an error, as openpi's client."""
        before = len(self.answers)
        self.program(Said.MESSAGE.value + values.pack(observation))
        self.run(self.now_ns + wait_ns, lambda: len(self.answers) > before)
        assert len(self.answers) == before + 1
        said = self.answers[-1][1]
        if said[:1] == Said.ERROR:
            raise RuntimeError(said[1:].decode())
        return values.unpack(said[1:])

    def sleep(self, time_ns: int) -> None:
        self.run(self.now_ns + time_ns)


def ramp(observation: Any) -> dict[str, Any]:
    """Ten rows that go on from the position in the observation by 1 a row."""
    at = float(observation["state"][0])
    return {"actions": at + np.arange(10, dtype=np.float32)[:, None], "time": 3}
