"""Floods: handling of each kind of packet by the server and the kernel's filter, and a flight."""

import secrets
import socket
import sys
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest

from bench import flood
from bench.flood import FORGED, FloodCounts
from bench.link import NOW_NS, PEER, Ends, messages
from skytether.server.secure import FORMS, SecureGate
from skytether.shared.endpoints.endpoint import Datagram, Form
from skytether.shared.scenario.reading import load
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.protocol import Hello, Observation, Welcome, encode
from skytether.shell.host.udp import admit_only, kernel_drops, open_socket
from skytether.sim.sealed import make_keys

pytestmark = pytest.mark.long

linux = pytest.mark.skipif(sys.platform != "linux", reason="the filter is one of Linux")


class Linked(NamedTuple):
    gate: SecureGate
    ends: Ends
    observation: bytes
    plain: dict[type, bytes]


@pytest.fixture
def linked() -> Linked:
    """Both ends after the handshake."""
    plain = {type(message): encode(message) for message in messages(load("demo").terms())}
    keyring = make_keys(1, 1)
    gate = SecureGate(keyring, entropy=secrets.token_bytes)
    ends = Ends(gate, keyring, 1, plain[Hello], plain[Welcome])
    ends.challenge()
    ends.welcome()
    ends.adopt()
    return Linked(gate, ends, ends.link.seal(plain[Observation]), plain)


def refusals(gate: SecureGate, packets: Iterable[bytes]) -> set[str]:
    """Reasons for which packets are refused; "" for an accepted packet."""
    found = set()
    for packet in packets:
        try:
            gate.open(Datagram(packet, PEER), now_ns=NOW_NS)
        except ProtocolError as error:
            found.add(error.reason)
        else:
            found.add("")
    return found


def test_forgeries_get_as_far_as_they_are_meant_to(linked: Linked) -> None:
    """Forgeries under a good header fail at the AEAD; the vehicle's packet can still be opened."""
    packets = flood.forgeries(linked.observation)
    assert {len(packet) for packet in packets} == {len(linked.observation)}
    assert refusals(linked.gate, packets[::2]) == {"forged"}
    early = {"not sealed", "not for a server", "unknown channel", "length"}
    assert refusals(linked.gate, packets[1::2]) <= early
    assert refusals(linked.gate, [linked.observation]) == {""}
    assert not linked.gate.outbox()


def test_hellos_get_as_far_as_they_are_meant_to(linked: Linked) -> None:
    """Random HELLOs fail at the MAC; a repeated real one is answered by a challenge only."""
    packets = flood.hellos(linked.ends.first)
    assert refusals(linked.gate, packets[::2]) == {"forged"}
    assert refusals(linked.gate, packets[1:20:2]) == {""}
    answers = linked.gate.outbox()
    assert len(answers) == 10
    assert all(len(answer.payload) < len(linked.ends.first) for answer in answers)
    assert refusals(linked.gate, [linked.observation]) == {""}


def passes(forms: Iterable[Form], packets: Iterable[bytes]) -> list[bool]:
    """Whether each packet passes a socket with a filter for some forms, or without a filter."""
    forms, came = tuple(forms), []
    with open_socket(("127.0.0.1", 0)) as sock, socket.socket(type=socket.SOCK_DGRAM) as sender:
        if forms:
            admit_only(sock, forms)
        for packet in packets:
            sender.sendto(packet, sock.getsockname())
            try:
                came.append(sock.recv(2048) == packet)
            except BlockingIOError:
                came.append(False)
        assert kernel_drops(sock) == came.count(False)
    return came


ONE, OTHER = Form(b"\x01\x04", 32, 100), Form(b"\x01\x01", 512, 512)
PACKETS = {
    b"": False,
    b"\x01": False,
    b"\x01\x04" + bytes(29): False,
    b"\x01\x04" + bytes(30): True,
    b"\x01\x04" + bytes(98): True,
    b"\x01\x04" + bytes(99): False,
    b"\x01\x01" + bytes(509): False,
    b"\x01\x01" + bytes(510): True,
    b"\x01\x01" + bytes(511): False,
    b"\x01\x02" + bytes(98): False,
    b"\x02\x04" + bytes(98): False,
}


@linux
def test_only_admitted_forms_come_through() -> None:
    assert passes((ONE, OTHER), PACKETS) == list(PACKETS.values())
    assert passes((), PACKETS) == [True] * len(PACKETS)


@linux
def test_all_that_a_vehicle_sends_comes_through_and_random_bytes_do_not(linked: Linked) -> None:
    """A plaintext HELLO passes too, so that the server can log it; no other plaintext does."""
    ends, plain = linked.ends, linked.plain
    assert passes(FORMS, [ends.first, ends.second, linked.observation, plain[Hello]]) == [True] * 4
    rng = np.random.default_rng(1)
    strange = [rng.bytes(len(linked.observation)) for _ in range(500)]
    assert sum(passes(FORMS, [plain[Observation], plain[Welcome], *strange])) < 10


@pytest.mark.realtime
def test_a_flight_goes_on_beside_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    """With real processes at a small rate; a new vehicle can join.

    A busy machine takes seconds to start the new vehicle's process.
    """
    monkeypatch.setattr(flood, "KINDS", (FORGED,))
    result = flood.measure(FloodCounts(seconds=8, forged=2000, hellos=0, lead_s=0.5))
    (found,) = flood.floods_of(result)
    assert found.sent > 0.0
    assert found.read > 0.0
    assert (found.kept_out > 0.0) == (sys.platform == "linux")
    assert found.good > 0
    assert np.isfinite(found.session_s)
    (table,) = flood.tables(result).values()
    assert [len(row) for row in table.rows] == [2] * len(table.rows)
