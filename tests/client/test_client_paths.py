"""A client with several paths: what it hears on them."""

from helpers import packaged
from skytether.client.endpoint import Client
from skytether.client.several import Several
from skytether.client.simulated.vehicle import simulated
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.wire.framing import Report, split
from skytether.shared.wire.paths import Paths
from skytether.shared.wire.protocol import Heartbeat, Refusal, Welcome, encode

SERVER: Address = ("server", 0)


def test_report_of_an_earlier_session_is_not_taken_for_one_of_this() -> None:
    flown = packaged("paper-every-step")
    client = Client(
        flown, simulated(flown, 1), server=Several((SERVER, ("server", 2))), vehicle=4, boot_id=99
    )
    welcome = Welcome(4, 7, 99, 1, 1234, Refusal.ACCEPTED, flown.terms())
    late, now_ns = Paths((1.0, 1.0), SECOND_NS), 5 * SECOND_NS

    def newest() -> Report:
        """Newest report that the client has sent, after its next step."""
        due_ns = client.next_wake_ns()
        assert due_ns is not None
        client.wake(now_ns=max(now_ns, due_ns))
        reports = [report for each in client.outbox() if (report := split(each.payload)[0])]
        return reports[-1]

    client.wake(now_ns=now_ns)  # says HELLO
    client.receive(Datagram(encode(welcome), SERVER), now_ns=now_ns)
    newest()
    for session, heard in ((6, 0), (7, 2)):
        payload = late.report() + encode(Heartbeat(4, session, 5678, 0, 0))
        client.receive(Datagram(payload, SERVER), now_ns=now_ns)
        assert newest().newest == heard
