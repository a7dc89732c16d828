"""Recorder of an endpoint's packets (`shared.telemetry.ends`), which is wrapped around the
endpoint. Only processes with a feed use the recorder.
"""

import time
from collections.abc import Callable
from hashlib import blake2b

from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.endpoints.steady import Steady
from skytether.shared.telemetry.ends import End, Happened
from skytether.shared.telemetry.record import Recorder
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.framing import split
from skytether.shared.wire.protocol import kind_of

PEERS_MAX = 1024
"""Largest number of peers with their own number in the record; further peers share a number."""


class Watched(Steady):
    """Endpoint whose wakes and datagrams are recorded.

    Args:
        line: number of the socket that leads to an autopilot or a robot; None if there is none.
        clock_ns: the driver's clock.
    """

    def __init__(
        self,
        inner: Endpoint,
        end: End,
        recorder: Recorder,
        line: int | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(inner)
        self._clock_ns = clock_ns
        self._end, self._recorder, self._line = end, recorder, line
        self._peers: dict[tuple[int, Address], int] = {}

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._note(Happened.RECEIVED, datagram, now_ns)
        super().receive(datagram, now_ns=now_ns)

    def wake(self, *, now_ns: int) -> None:
        due_ns = self.next_wake_ns() or 0
        self._recorder.append_row(self._end, Happened.WOKEN, 0, 0, 0, 0, now_ns, due_ns)
        super().wake(now_ns=now_ns)

    def outbox(self) -> list[Datagram]:
        out, now_ns = super().outbox(), self._clock_ns()
        for datagram in out:
            self._note(Happened.SENT, datagram, now_ns)
        return out

    def _note(self, happened: Happened, datagram: Datagram, now_ns: int) -> None:
        payload, peer, socket = datagram
        if socket == self._line:
            return
        number = self._peers.get((socket, peer), len(self._peers))
        if number < PEERS_MAX:
            self._peers[socket, peer] = number
        try:
            kind = kind_of(split(payload)[1]) or 0
        except ProtocolError:
            kind = 0
        packet = int.from_bytes(blake2b(payload, digest_size=8).digest(), "little", signed=True)
        at = self._end, happened, kind, number, len(payload) & 0xFFFF, packet
        self._recorder.append_row(*at, now_ns, 0)
