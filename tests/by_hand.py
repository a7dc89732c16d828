"""Client whose server is played by the test, message by message."""

import numpy as np

from skytether.client.endpoint import Client
from skytether.client.link import PlainLink
from skytether.client.simulated.vehicle import simulated
from skytether.client.vehicle import Vehicle
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, Rows, client_columns
from skytether.shared.wire.protocol import (
    Horizon,
    Message,
    Refusal,
    Terms,
    Welcome,
    decode,
    encode,
)

SERVER: Address = ("server", 0)


class ByHand:
    """Client of vehicle 4, and the time on its clock.

    Args:
        flown: scenario of the client.
        flies: vehicle; the scenario's unless given.
        link: link; plaintext unless given.
    """

    def __init__(
        self, flown: Scenario, flies: Vehicle | None = None, link: PlainLink | None = None
    ) -> None:
        self.scenario, self.terms, self.dt_ns = flown, flown.terms(), flown.dt_ns
        self.flies = flies or simulated(flown, 1)
        self._steps = MemoryRecorder(client_columns(flown.model.axes))
        self.client = Client(
            flown,
            self.flies,
            server=SERVER,
            vehicle=4,
            boot_id=99,
            link=link,
            recorder=self._steps,
        )
        self.now_ns = 5 * SECOND_NS
        self.session = 7

    def wake(self) -> list[Message]:
        """Advance to the client's next wake; returns the messages that it sends."""
        due_ns = self.client.next_wake_ns()
        assert due_ns is not None
        self.now_ns = max(self.now_ns, due_ns)
        self.client.wake(now_ns=self.now_ns)
        said = self.client.outbox()
        assert {datagram.peer for datagram in said} <= {SERVER}
        return [decode(datagram.payload, self.terms) for datagram in said]

    def say(self, message: Message) -> None:
        self.client.receive(Datagram(encode(message), SERVER), now_ns=self.now_ns)

    def welcome(
        self,
        *,
        boot_id: int = 99,
        server_boot_id: int = 1,
        refusal: int = Refusal.ACCEPTED,
        terms: Terms | None = None,
        asked: bool = True,
    ) -> None:
        """Open a session, or refuse it; `asked`: as if the client had sent a HELLO."""
        self.client._session._awaits_welcome |= asked
        session, terms = self.session if refusal == Refusal.ACCEPTED else 0, terms or self.terms
        self.say(Welcome(4, session, boot_id, server_boot_id, 1234, refusal, terms))

    def horizon(self, step: int, value: float, *, observed: int | None = None) -> None:
        """Send a horizon of one constant input, planned from the observation of `step` by
        default.
        """
        age = 0 if observed is None else step - observed
        inputs = np.full((self.terms.axes, self.terms.planned), value, np.float32)
        self.say(Horizon(4, self.session, step, 5678, age, inputs))

    def rows(self) -> Rows:
        return self._steps.rows()
