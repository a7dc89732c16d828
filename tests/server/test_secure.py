"""Both ends of an encrypted link, back to back: over good and bad networks, and under attack."""

import random
from collections import Counter
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from skytether.client.link import AGAIN_NS
from skytether.client.secure import ATTEMPT_NS, SecureLink
from skytether.server import secure as server_secure
from skytether.server.gate import GateCall
from skytether.server.secure import COOKIE_NS, FORMS, HANDSHAKES, OUT_MAX, PENDING_MAX
from skytether.server.secure import SecureGate as Gate
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.scenario import reading
from skytether.shared.wire import channel as channels
from skytether.shared.wire import handshake, noise_nnpsk0
from skytether.shared.wire.channel import DATA, FRESH_NS, OVERLAP_NS, VERSION
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.handshake import (
    CHALLENGE,
    CHALLENGE_BYTES,
    HELLO_BYTES_MAX,
    INITIATION,
    INITIATION_BYTES,
    RESPONSE,
    RESPONSE_BYTES_MIN,
    WELCOME_BYTES_MAX,
    check_place,
    read_response,
    write_response,
)
from skytether.shared.wire.keys import Keyring, VehicleKey
from skytether.shared.wire.noise_nnpsk0 import MESSAGE_BYTES
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX, Hello, encode

HERE, ELSEWHERE = ("vehicle", 1), ("elsewhere", 2)
SECRETS = {1: bytes([1]) * 32, 2: bytes([2]) * 32}
KEYS = {(vehicle, 5): VehicleKey.of(vehicle, 5, secret) for vehicle, secret in SECRETS.items()}
HELLO, WELCOME = b"\x95\x04\x01" + b"hello" * 60, b"\x98\x04\x02" + b"welcome" * 48
OBSERVATION, HORIZON = b"\x9b\x04\x03observation", b"\x99\x04\x04horizon"
"""Messages whose first bytes are as on the wire."""


def gate(seed: int = 1) -> Gate:
    return Gate(Keyring("keys", KEYS), entropy=random.Random(seed).randbytes)


def link(seed: int = 2, key: VehicleKey = KEYS[1, 5]) -> SecureLink:
    return SecureLink(key, entropy=random.Random(seed).randbytes)


def called(server: Gate, datagram: bytes, now_ns: int = 0, peer: Address = HERE) -> GateCall:
    call = server.open(Datagram(datagram, peer), now_ns=now_ns)
    assert call is not None
    return call


def refusal(end: Gate | SecureLink, datagram: bytes, now_ns: int = 0, peer: Address = HERE) -> str:
    given = Datagram(datagram, peer) if isinstance(end, Gate) else datagram
    with pytest.raises(ProtocolError) as error:
        end.open(given, now_ns=now_ns)  # type: ignore[arg-type]
    return error.value.reason


def challenged(client: SecureLink, server: Gate, now_ns: int = 0, *, hello: bytes = HELLO) -> None:
    asked = Datagram(client.hello(hello, now_ns=now_ns), HERE)
    assert server.open(asked, now_ns=now_ns) is None
    (challenge,) = server.outbox()
    assert client.open(challenge.payload, now_ns=now_ns) is None


def apart() -> tuple[SecureLink, Gate]:
    client, server = link(), gate()
    challenged(client, server)
    return client, server


def welcomed(client: SecureLink, server: Gate, now_ns: int = 0) -> bytes:
    call = called(server, client.hello(HELLO, now_ns=now_ns), now_ns)
    assert (call.payload, call.vehicle, call.moves) == (HELLO, 1, False)
    response = call.line.seal(WELCOME)
    server.admit(call, now_ns=now_ns)
    assert client.open(response, now_ns=now_ns) == WELCOME
    return response


def keyed(client: SecureLink, server: Gate, now_ns: int = 0) -> None:
    challenged(client, server, now_ns)
    welcomed(client, server, now_ns)
    client.adopt(now_ns=now_ns)


def joined() -> tuple[SecureLink, Gate]:
    """Both ends of an open link, before the first packet in the channel."""
    client, server = link(), gate()
    keyed(client, server)
    return client, server


def live(server: Gate, vehicle: int = 1) -> int | None:
    channel = server._vehicles[vehicle].live
    return None if channel is None else channel.number


# -- the handshake -----------------------------------------------------------------------------


def test_a_handshake_takes_two_round_trips_and_opens_a_channel() -> None:
    client, server = joined()
    call = called(server, client.seal(OBSERVATION))
    assert (call.payload, call.vehicle, call.moves) == (OBSERVATION, 1, True)
    assert client.open(call.line.seal(HORIZON), now_ns=0) == HORIZON
    assert client.secure


def test_the_bytes_of_a_handshake() -> None:
    client, server = link(), gate()
    first = client.hello(HELLO, now_ns=0)
    assert first[:5].hex() == "0101010005"
    assert first[5:21] == bytes(16)
    server.open(Datagram(first, HERE), now_ns=0)
    (challenge,) = server.outbox()
    assert challenge.peer == HERE
    assert challenge.payload[:5].hex() == "0102010005"
    client.open(challenge.payload, now_ns=0)
    second = client.hello(HELLO, now_ns=0)
    assert second[5:21] == challenge.payload[5:21]
    assert second[21:-16] == first[21:-16]  # the same attempt
    call = called(server, second)
    response = call.line.seal(WELCOME)
    assert response[:5].hex() == "0103010005"
    assert len(response) == 5 + 4 + 32 + len(WELCOME) + 16 + 16
    assert (len(first), len(challenge.payload)) == (INITIATION_BYTES, CHALLENGE_BYTES) == (512, 37)
    assert (INITIATION, CHALLENGE, RESPONSE, DATA) == (1, 2, 3, 4)
    # No message in plaintext begins like a sealed packet: msgpack's arrays begin with 0x90 or more.
    assert VERSION < 0x90


def test_the_forms_that_are_admitted_are_those_on_the_wire() -> None:
    client, _ = joined()
    plain = encode(Hello(1, 5, reading.load("demo").terms()))
    sent = [client.seal(OBSERVATION), link().hello(HELLO, now_ns=0), plain]
    for form, packet in zip(FORMS, sent, strict=True):
        assert packet.startswith(form.head)
        assert form.least <= len(packet) <= form.most
    longest = client.seal(bytes(PAYLOAD_BYTES_MAX))
    assert len(longest) == 1200 + 32
    assert [form.most for form in FORMS] == [len(longest), INITIATION_BYTES, PAYLOAD_BYTES_MAX]
    assert [form.least for form in FORMS] == [len(client.seal(b"")), INITIATION_BYTES, 1]


def test_no_answer_is_longer_than_what_draws_it() -> None:
    room, head = HELLO_BYTES_MAX - 3, HELLO[:3]
    for hello in (head, head + b"\0" * room, head + b"\x80" * room, head + b"\x80\0"):
        client, server = link(), gate()
        challenged(client, server, hello=hello)
        call = called(server, client.hello(hello, now_ns=0))
        assert call.payload == hello
    assert len(call.line.seal(bytes(WELCOME_BYTES_MAX))) == INITIATION_BYTES
    with pytest.raises(AssertionError):
        call.line.seal(bytes(WELCOME_BYTES_MAX + 1))
    with pytest.raises(AssertionError):
        client.hello(bytes(HELLO_BYTES_MAX + 1), now_ns=0)


def test_a_refused_client_goes_on_with_its_attempt() -> None:
    client, server = apart()
    before = client.hello(HELLO, now_ns=0)
    call = called(server, before)
    assert client.open(call.line.seal(WELCOME), now_ns=0) == WELCOME
    assert client.hello(HELLO, now_ns=SECOND_NS) == before
    assert server._vehicles[1].pending == {}
    welcomed(client, server, SECOND_NS)
    client.adopt(now_ns=SECOND_NS)
    assert called(server, client.seal(OBSERVATION), SECOND_NS).payload == OBSERVATION


def test_an_attempt_has_one_ephemeral_key() -> None:
    client, _ = apart()
    first = client.hello(HELLO, now_ns=0)
    assert client.hello(HELLO, now_ns=ATTEMPT_NS) == first
    later = client.hello(HELLO, now_ns=ATTEMPT_NS + 1)
    other = client.hello(HELLO + b"x", now_ns=ATTEMPT_NS + 1)
    assert len({first[21:53], later[21:53], other[21:53]}) == 3
    assert first[5:21] == later[5:21] == other[5:21] != bytes(16)
    assert ATTEMPT_NS == 60 * SECOND_NS


def test_a_repeated_hello_is_answered_with_other_keys() -> None:
    """No key seals two different answers; the vehicle may adopt either."""
    client, server = apart()
    hello = client.hello(HELLO, now_ns=0)
    answers = []
    for i in range(3):
        call = called(server, hello)
        answers.append(call.line.seal(WELCOME + b"%d" % i))
        server.admit(call, now_ns=0)
    assert len({answer[5:9] for answer in answers}) == 3  # channel
    assert len({answer[9:41] for answer in answers}) == 3  # ephemeral key
    assert client.open(answers[2], now_ns=0) == WELCOME + b"2"
    assert client.open(answers[1], now_ns=0) == WELCOME + b"1"
    client.adopt(now_ns=0)
    assert called(server, client.seal(OBSERVATION)).payload == OBSERVATION
    assert live(server) == int.from_bytes(answers[1][5:9], "little")
    # The earlier pending channel has been replaced.
    assert [*server._vehicles[1].pending] == [int.from_bytes(answers[2][5:9], "little")]


def test_an_adopted_response_opens_no_channel_again() -> None:
    """Otherwise its counters would restart, and recorded packets be accepted again."""
    client, server = apart()
    response = welcomed(client, server)
    client.adopt(now_ns=0)
    sent = called(server, client.seal(OBSERVATION)).line.seal(HORIZON)
    assert client.open(sent, now_ns=0) == HORIZON
    assert refusal(client, response) == "unasked"
    client.hello(HELLO, now_ns=0)  # also during the next attempt
    assert refusal(client, response) == "unasked"
    assert refusal(client, sent) == "replayed"


def test_where_adopting_leaves_the_attempt_open_a_command_is_flown_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client, server = apart()
    response = welcomed(client, server)
    adopt = SecureLink.adopt

    def without_end(self: SecureLink, *, now_ns: int) -> None:
        attempt = self._attempt
        adopt(self, now_ns=now_ns)
        self._attempt = attempt

    monkeypatch.setattr(SecureLink, "adopt", without_end)
    client.adopt(now_ns=0)
    sent = called(server, client.seal(OBSERVATION)).line.seal(HORIZON)
    assert client.open(sent, now_ns=0) == HORIZON
    assert client.open(response, now_ns=0) == WELCOME
    client.adopt(now_ns=0)
    assert client.open(sent, now_ns=0) == HORIZON


# -- authentication ----------------------------------------------------------------------------


def test_who_has_no_key_is_met_with_silence() -> None:
    server = gate()
    strangers = {
        "forged": VehicleKey.of(1, 5, b"x" * 32),
        "unknown key": VehicleKey.of(3, 5, SECRETS[1]),
    }
    for reason, key in strangers.items():
        assert refusal(server, link(key=key).hello(HELLO, now_ns=0)) == reason
    assert (
        refusal(server, link(key=VehicleKey.of(1, 6, SECRETS[1])).hello(b"", now_ns=0))
        == "unknown key"
    )
    for end in (server, link()):
        assert refusal(end, b"") == refusal(end, b"\x95\x04\x01") == "not sealed"
        assert refusal(end, bytes([VERSION])) == "not sealed"
        assert refusal(end, bytes([VERSION, DATA])) == "length"
        assert refusal(end, bytes([VERSION, DATA]) + bytes(40)) == "unknown channel"
    assert refusal(server, bytes([VERSION, RESPONSE]) + bytes(100)) == "not for a server"
    assert refusal(link(), bytes([VERSION, INITIATION]) + bytes(510)) == "not for a client"
    assert refusal(server, bytes([VERSION, INITIATION])) == "length"
    assert server.outbox() == []
    assert server._vehicles == {}


def test_the_key_of_another_vehicle_opens_nothing() -> None:
    server = gate()
    renamed = link(key=VehicleKey.of(1, 5, SECRETS[2]))
    assert refusal(server, renamed.hello(HELLO, now_ns=0)) == "forged"
    client, server = joined()
    packet = bytearray(client.seal(OBSERVATION))
    packet[2] = 2
    assert refusal(server, bytes(packet)) == "unknown channel"


def changed(datagram: bytes, at: int) -> bytes:
    found = bytearray(datagram)
    found[at] ^= 1
    return bytes(found)


def exchanges(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    exchange, found = noise_nnpsk0._exchange, []

    def counted(private: X25519PrivateKey, public: bytes) -> bytes:
        found.append(1)
        return exchange(private, public)

    monkeypatch.setattr(noise_nnpsk0, "_exchange", counted)
    return found


def test_the_mac_comes_before_any_costly_mathematics(monkeypatch: pytest.MonkeyPatch) -> None:
    """A forged INITIATION draws no answer, and a forged RESPONSE costs no elliptic curve."""
    client, server = apart()
    initiation = client.hello(HELLO, now_ns=0)
    response = called(server, initiation).line.seal(WELCOME)
    costs = exchanges(monkeypatch)
    for i in range(5, len(initiation)):
        assert refusal(server, changed(initiation, i)) == "forged"
    for i in range(4, len(response)):
        assert refusal(client, changed(response, i)) == "unasked"
    assert (server.outbox(), costs) == ([], [])


def test_without_the_mac_strangers_cost_mathematics_and_draw_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client, server = apart()
    initiation = client.hello(HELLO, now_ns=0)
    response = called(server, initiation).line.seal(WELCOME)
    costs = exchanges(monkeypatch)
    monkeypatch.setattr(handshake, "is_authentic", lambda *_: True)
    assert refusal(client, changed(response, 60)) == "forged"
    assert len(costs) == 1
    assert server.open(Datagram(changed(initiation, 10), HERE), now_ns=0) is None
    assert len(server.outbox()) == 1


# -- cookies -----------------------------------------------------------------------------------


def test_a_cookie_is_good_for_its_address_and_up_to_two_minutes() -> None:
    """From elsewhere or later it draws a CHALLENGE; so it does in another life of the server."""
    client, server = apart()
    hello = client.hello(HELLO, now_ns=0)
    assert server.open(Datagram(hello, ELSEWHERE), now_ns=0) is None
    assert server.open(Datagram(hello, ("vehicle", 2)), now_ns=0) is None
    assert server.open(Datagram(hello, HERE), now_ns=2 * COOKIE_NS) is None
    assert [each.peer for each in server.outbox()] == [ELSEWHERE, ("vehicle", 2), HERE]
    assert called(server, hello, 2 * COOKIE_NS - 1).payload == HELLO
    assert gate(seed=9).open(Datagram(hello, HERE), now_ns=0) is None
    assert COOKIE_NS == 60 * SECOND_NS


def test_a_challenge_answers_one_attempt_once() -> None:
    """Repeated, changed or of another attempt it draws no HELLO, which prevents floods."""
    client, server = link(), gate()
    server.open(Datagram(client.hello(HELLO, now_ns=0), HERE), now_ns=0)
    challenge = server.outbox()[0].payload
    other = link(seed=3)
    assert refusal(other, challenge) == "unasked"
    other.hello(HELLO, now_ns=0)
    assert refusal(other, challenge) == "unasked"
    assert {refusal(client, changed(challenge, i)) for i in range(4, 37)} == {"unasked"}
    assert client.open(challenge, now_ns=0) is None
    assert refusal(client, challenge) == "replayed"
    assert refusal(client, challenge[:-1]) == "length"


OBSERVER = [("observer", port) for port in range(50)]


def asked(client: SecureLink, server: Gate, now_ns: int, *, foreign_first: bool) -> list[bytes]:
    """Answers to a HELLO that an observer has copied, and the challenges sent to the observer.

    `foreign_first`: whether the observer's challenges reach the vehicle before its own.
    """
    hello = client.hello(HELLO, now_ns=now_ns)
    senders = [*OBSERVER, HERE] if foreign_first else [HERE, *OBSERVER]
    for sender in senders:
        assert server.open(Datagram(hello, sender), now_ns=now_ns) is None
    for challenge in server.outbox():
        assert client.open(challenge.payload, now_ns=now_ns) is None
    return client.outbox()


@pytest.mark.parametrize("foreign_first", [False, True])
def test_foreign_challenges_keep_no_vehicle_from_its_own(*, foreign_first: bool) -> None:
    """For any number of forwarded challenges, before or after: the vehicle is answered at once."""
    client, server = link(), gate()
    drawn = asked(client, server, 0, foreign_first=foreign_first)
    calls = [server.open(Datagram(each, HERE), now_ns=0) for each in drawn]
    (call,) = (each for each in calls if each is not None)
    response = call.line.seal(WELCOME)
    server.admit(call, now_ns=0)
    assert client.open(response, now_ns=0) == WELCOME
    # Every other attempt has drawn the vehicle's own challenge again, which was just tried.
    again = [each.payload for each in server.outbox()]
    assert len(again) == len(OBSERVER)
    assert {refusal(client, each) for each in again} == {"replayed"}


def test_of_the_cookies_that_were_tried_the_newest_64_are_remembered() -> None:
    client, server = link(), gate()
    hello = client.hello(HELLO, now_ns=0)
    for port in range(65):
        assert server.open(Datagram(hello, ("observer", port)), now_ns=0) is None
    first, *others, last = (each.payload for each in server.outbox())
    for challenge in (first, *others):
        assert client.open(challenge, now_ns=0) is None
    assert refusal(client, first) == "replayed"
    assert client.open(last, now_ns=0) is None
    assert client.open(first, now_ns=0) is None


def test_a_cookie_that_is_tried_again_is_the_newest_of_those_tried() -> None:
    client, server = link(), gate()
    hello = client.hello(HELLO, now_ns=0)
    for port in range(65):
        assert server.open(Datagram(hello, ("observer", port)), now_ns=0) is None
    first, second, *others, last = (each.payload for each in server.outbox())
    for challenge in (first, second, *others):
        assert client.open(challenge, now_ns=0) is None
    assert client.open(first, now_ns=AGAIN_NS) is None
    assert client.open(last, now_ns=AGAIN_NS) is None
    assert refusal(client, first, AGAIN_NS) == "replayed"


def test_a_genuine_challenge_is_tried_again_with_the_next_hello() -> None:
    """The answer is sent again after a loss; foreign challenges in between have no effect."""
    client, server = link(), gate()
    asked(client, server, 0, foreign_first=False)  # all answers are lost
    hello = client.hello(HELLO, now_ns=AGAIN_NS)
    assert server.open(Datagram(hello, HERE), now_ns=AGAIN_NS) is None
    (challenge,) = server.outbox()
    assert client.open(challenge.payload, now_ns=AGAIN_NS) is None
    (answer,) = client.outbox()
    assert called(server, answer, AGAIN_NS).payload == HELLO


def test_who_repeats_an_attempt_uses_up_no_answers() -> None:
    """A vehicle whose answers are used up gets the same answer again."""
    client, server = apart()
    hello = client.hello(HELLO, now_ns=0)
    for _ in range(1 + HANDSHAKES):
        call = called(server, hello)
        response = call.line.seal(WELCOME)
        server.admit(call, now_ns=0)
    assert server.open(Datagram(hello, HERE), now_ns=0) is None
    assert server.outbox() == [Datagram(response, HERE)]
    assert client.open(response, now_ns=0) == WELCOME
    client.adopt(now_ns=0)
    assert called(server, client.seal(OBSERVATION)).payload == OBSERVATION
    restarted = link(seed=3)  # another attempt
    challenged(restarted, server)
    assert called(server, restarted.hello(HELLO, now_ns=0)).payload == HELLO


def test_attempts_that_brought_a_channel_are_answered_no_more() -> None:
    server, recorded = gate(), []
    for seed in range(10, 27):
        client, now_ns = link(seed=seed), seed * SECOND_NS
        challenged(client, server, now_ns)
        recorded.append(client.hello(HELLO, now_ns=now_ns))
        welcomed(client, server, now_ns)
        client.adopt(now_ns=now_ns)
        called(server, client.seal(OBSERVATION), now_ns)
    assert {refusal(server, each, 27 * SECOND_NS) for each in recorded[1:]} == {"replayed"}
    assert called(server, recorded[0], 27 * SECOND_NS).payload == HELLO


def test_without_cookies_a_recorded_hello_draws_handshakes_from_anywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the cookie check off, each replayed HELLO costs the server memory and a key exchange."""
    client, server = link(), gate()
    hello = client.hello(HELLO, now_ns=0)
    monkeypatch.setattr(Gate, "_is_valid", lambda *_: True)
    assert called(server, hello, peer=ELSEWHERE).payload == HELLO
    assert len(server._vehicles) == 1


def test_a_vehicle_gets_five_handshakes_a_second() -> None:
    client, server = apart()
    hello = client.hello(HELLO, now_ns=0)
    for start_ns in (0, 10 * SECOND_NS):
        for _ in range(HANDSHAKES):
            called(server, hello, start_ns)
        assert refusal(server, hello, start_ns) == "too many handshakes"
        assert refusal(server, hello, start_ns + SECOND_NS // 5 - 1) == "too many handshakes"
        called(server, hello, start_ns + SECOND_NS // 5)
    other = link(key=KEYS[2, 5])
    challenged(other, server)
    called(server, other.hello(HELLO, now_ns=0))


# -- change of keys ----------------------------------------------------------------------------


def test_an_address_moves_with_the_highest_counter_only() -> None:
    """A late packet, or one of the previous channel, does not show the present address."""
    client, server = joined()
    packets = [client.seal(OBSERVATION) for _ in range(4)]
    assert [called(server, packets[i]).moves for i in (0, 2, 1, 3)] == [True, True, False, True]
    late = [client.seal(OBSERVATION) for _ in range(2)]
    later_ns = 200 * SECOND_NS  # the cookie has expired
    keyed(client, server, later_ns)
    assert called(server, late[0], later_ns).moves
    assert called(server, client.seal(OBSERVATION), later_ns).moves
    assert not called(server, late[1], later_ns).moves


def test_without_the_order_of_counters_a_late_packet_moves_the_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise an attacker who delays a packet and resends it gets the next answers."""
    client, server = joined()
    held, newer = client.seal(OBSERVATION), client.seal(OBSERVATION)
    called(server, newer)
    monkeypatch.setattr(channels, "OpenedPacket", lambda payload, _: (payload, True))
    assert called(server, held, peer=ELSEWHERE).moves


def test_keys_are_exchanged_under_way_without_a_lost_packet() -> None:
    client, server = joined()
    line = called(server, client.seal(OBSERVATION)).line
    assert not client.wants_hello(FRESH_NS - 1)
    assert client.wants_hello(FRESH_NS)
    up = [client.seal(OBSERVATION) for _ in range(4)]
    down = [line.seal(OBSERVATION) for _ in range(4)]
    keyed(client, server, FRESH_NS)
    assert not client.wants_hello(FRESH_NS)
    assert called(server, up[0], FRESH_NS).moves  # the new channel is pending until it is used
    assert client.open(down[0], now_ns=FRESH_NS) == OBSERVATION
    new = called(server, client.seal(HORIZON), FRESH_NS)
    assert client.open(new.line.seal(HORIZON), now_ns=FRESH_NS) == HORIZON
    end_ns = FRESH_NS + OVERLAP_NS
    assert called(server, up[1], end_ns).payload == OBSERVATION
    assert client.open(down[1], now_ns=end_ns) == OBSERVATION
    assert refusal(server, up[2], end_ns + 1) == "expired"
    assert refusal(client, down[2], end_ns + 1) == "expired"
    keyed(client, server, 2 * FRESH_NS)
    called(server, client.seal(OBSERVATION), 2 * FRESH_NS)
    assert refusal(server, up[3], 2 * FRESH_NS) == "unknown channel"
    assert refusal(client, down[3], 2 * FRESH_NS) == "unknown channel"


def test_a_hello_that_is_repeated_ends_no_flight() -> None:
    client, server = joined()
    called(server, client.seal(OBSERVATION))
    before = live(server)
    other = link(seed=7)
    challenged(other, server)
    hello = other.hello(HELLO, now_ns=0)
    for time in range(1, 3 * PENDING_MAX):
        now_ns = time * SECOND_NS // 2
        call = server.open(Datagram(hello, HERE), now_ns=now_ns)
        assert call is not None
        call.line.seal(WELCOME)
        server.admit(call, now_ns=now_ns)
        called(server, client.seal(OBSERVATION), now_ns)
    assert live(server) == before
    assert len(server._vehicles[1].pending) == PENDING_MAX


# -- bad networks ------------------------------------------------------------------------------

TICK_NS = SECOND_NS // 10
HELLO_TICKS, SILENCE_TICKS = 10, 80
"""Ticks between two HELLOs, and ticks of silence after which the client sends HELLO again."""


class Flight:
    """Vehicle that sends HELLO until welcomed, then a packet at every tick, over a bad network."""

    def __init__(self, seed: int, loss: float, delay_s: Callable[[random.Random], float]) -> None:
        self.rng = random.Random(seed)
        self.loss, self.delay_s = loss, delay_s
        self.client, self.server = link(seed + 10**6), gate(seed + 2 * 10**6)
        self.under_way: list[tuple[int, int, bool, bytes]] = []
        self.numbers = count()
        self.sent: list[tuple[bool, bytes]] = []
        """Every datagram sent, and whether to the server."""
        self.heard = Counter[bytes]()
        self.dropped = Counter[str]()
        self.flies = False
        self.silent = 0
        self.hello_due = 0
        self.now_ns = 0

    def send(self, to_server: bool, datagram: bytes) -> None:
        self.sent.append((to_server, datagram))
        for _ in range(1 + (self.rng.random() < 0.2)):
            if self.rng.random() >= self.loss:
                due_ns = self.now_ns + seconds_to_ns(self.delay_s(self.rng))
                heappush(self.under_way, (due_ns, next(self.numbers), to_server, datagram))

    def hello(self) -> None:
        self.send(True, self.client.hello(HELLO, now_ns=self.now_ns))

    def deliver(self, to_server: bool, datagram: bytes) -> None:
        try:
            if to_server:
                self.at_server(datagram)
            else:
                self.at_client(datagram)
        except ProtocolError as error:
            self.dropped[error.reason] += 1

    def at_server(self, datagram: bytes) -> None:
        call = self.server.open(Datagram(datagram, HERE), now_ns=self.now_ns)
        for challenge in self.server.outbox():
            self.send(False, challenge.payload)
        if call is None:
            return
        self.heard[call.payload] += 1
        if call.payload == HELLO:
            self.send(False, call.line.seal(WELCOME))
            self.server.admit(call, now_ns=self.now_ns)
        else:
            self.send(False, call.line.seal(HORIZON))

    def at_client(self, datagram: bytes) -> None:
        payload = self.client.open(datagram, now_ns=self.now_ns)
        if payload is None:
            self.hello()
            return
        self.heard[payload] += 1
        self.silent = 0
        if payload == WELCOME:
            self.client.adopt(now_ns=self.now_ns)
            self.flies = True

    def tick(self) -> None:
        self.now_ns += TICK_NS
        while self.under_way and self.under_way[0][0] <= self.now_ns:
            _, _, to_server, datagram = heappop(self.under_way)
            self.deliver(to_server, datagram)
        self.silent += 1
        self.hello_due -= 1
        if (not self.flies or self.silent > SILENCE_TICKS) and self.hello_due <= 0:
            self.hello()
            self.hello_due = HELLO_TICKS
        if self.flies:
            self.send(True, self.client.seal(OBSERVATION))

    def until(self, horizons: int) -> None:
        for _ in range(1800):
            if self.heard[HORIZON] >= horizons:
                return
            self.tick()
        raise AssertionError(f"{self.heard} {self.dropped}")


def test_a_handshake_succeeds_over_a_terrible_network() -> None:
    """Half of all packets lost, a fifth duplicated, delays of 0 to 3 s, hence reordering."""
    for seed in range(25):
        flight = Flight(seed, 0.5, lambda rng: rng.uniform(0.0, 3.0))
        flight.until(horizons=30)
        assert flight.client._current.number == live(flight.server)
        assert set(flight.dropped) <= {"replayed", "unasked", "unknown channel"}


def test_a_handshake_succeeds_where_a_round_trip_takes_seven_hellos() -> None:
    """The vehicle uses the first channel that it receives, which must still be pending."""
    flight = Flight(1, 0.0, lambda _: 3.5)
    flight.until(horizons=30)


def test_with_fewer_pending_channels_it_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_secure, "PENDING_MAX", 4)
    flight = Flight(1, 0.0, lambda _: 3.5)
    with pytest.raises(AssertionError, match="unknown channel"):
        flight.until(horizons=30)


# -- replays -----------------------------------------------------------------------------------


def replayed(flight: Flight, peer: Address) -> tuple[Counter[bytes], list[int]]:
    """Accepted packets among all ever sent, and how much longer answers are than requests."""
    accepted = Counter[bytes]()
    excess = []
    for to_server, datagram in flight.sent:
        try:
            if to_server:
                call = flight.server.open(Datagram(datagram, peer), now_ns=flight.now_ns)
                if call is not None:
                    accepted[call.payload] += 1
            else:
                payload = flight.client.open(datagram, now_ns=flight.now_ns)
                accepted[payload or b"cookie"] += 1
        except ProtocolError:
            pass
        answers = flight.server.outbox()
        assert len(answers) <= 1
        excess += [len(answer.payload) - len(datagram) for answer in answers]
    return accepted, excess


def recorded(seed: int) -> Flight:
    """Flight with a change of keys, all of whose packets have arrived."""
    flight = Flight(seed, 0.0, lambda rng: rng.uniform(0.0, 0.3))
    flight.until(horizons=200)
    flight.now_ns += FRESH_NS
    flight.hello()
    flight.until(horizons=400)
    flight.flies, flight.silent, flight.hello_due = False, 0, 10**9
    for _ in range(20):
        flight.tick()
    assert not flight.under_way
    return flight


@pytest.mark.parametrize(("later_ns", "peer"), [(0, ELSEWHERE), (3 * COOKIE_NS, HERE)])
def test_nothing_of_a_recorded_session_is_accepted_again(peer: Address, later_ns: int) -> None:
    """By either end, from any address; replays draw challenges at most, each shorter."""
    flight = recorded(1)
    before = live(flight.server)
    flight.now_ns += later_ns
    accepted, excess = replayed(flight, peer)
    assert accepted == {}
    assert set(excess) == {CHALLENGE_BYTES - INITIATION_BYTES}
    assert len(excess) <= sum(to_server and len(d) == 512 for to_server, d in flight.sent)
    assert live(flight.server) == before
    assert not flight.server._vehicles[1].pending


@pytest.mark.parametrize("restarted", ["client", "server", "both"])
def test_nothing_is_accepted_after_a_restart(restarted: str) -> None:
    flight = recorded(2)
    if restarted != "server":
        flight.client = link(seed=5)
        flight.client.hello(HELLO, now_ns=flight.now_ns)
    if restarted != "client":
        flight.server = gate(seed=6)
    accepted, excess = replayed(flight, HERE)
    assert accepted == {}
    assert all(each < 0 for each in excess)


# -- attackers with a key ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "message", [OBSERVATION, WELCOME[:2] + b"\xcc\x01", b"\xdc\x00\x05\x04\x01", b"", b"\x95"]
)
def test_only_a_hello_travels_in_an_initiation(message: bytes) -> None:
    server, client = gate(), link()
    challenged(client, server, hello=message)
    assert refusal(server, client.hello(message, now_ns=0)) == "out of place"


@pytest.mark.parametrize(
    "message", [HELLO, WELCOME, b"\x95\xcc\x04\x01", b"\xdc\x00\x05\x04\x01", b""]
)
def test_no_greeting_travels_in_a_channel(message: bytes) -> None:
    client, server = joined()
    line = called(server, client.seal(OBSERVATION)).line
    assert refusal(server, client.seal(message)) == "out of place"
    assert refusal(client, line.seal(message)) == "out of place"


@pytest.mark.parametrize("in_handshake", [True, False])
def test_what_does_not_begin_as_a_message_of_msgpack_travels_nowhere(*, in_handshake: bool) -> None:
    """An array of up to 15, version and type, each in its shortest form."""
    type_ = b"\x01" if in_handshake else b"\x03"
    other = b"\x03" if in_handshake else b"\x01"
    for good in (b"\x90\x00", b"\x9f\x7f", b"\x95\x04"):
        check_place(good + type_, in_handshake=in_handshake)
        check_place(good + type_ + b"more", in_handshake=in_handshake)
    odd = [b"\x8f\x04" + type_, b"\xa0\x04" + type_, b"\x95\x80" + type_, b"\x95\x04\x80"]
    short = [b"", b"\x95", b"\x95\x04"]
    for bad in (*odd, *short, b"\x95\x04" + other):
        with pytest.raises(ProtocolError, match=r"^out of place$"):
            check_place(bad, in_handshake=in_handshake)


def test_the_shortest_and_the_longest_response_are_read() -> None:
    key, public = KEYS[1, 5], bytes(32)
    for welcome, packet_bytes in (
        (b"", RESPONSE_BYTES_MIN),
        (bytes(WELCOME_BYTES_MAX), INITIATION_BYTES),
    ):
        message = bytes(range(MESSAGE_BYTES)) + welcome
        packet = write_response(key, 7, message, public)
        assert len(packet) == packet_bytes
        assert read_response(key, packet, public) == (7, message)
    for size in (RESPONSE_BYTES_MIN - 1, INITIATION_BYTES + 1):
        with pytest.raises(ProtocolError, match=r"^length$"):
            read_response(key, bytes(size), public)


def test_a_response_with_another_message_opens_no_channel() -> None:
    client, server = apart()
    call = called(server, client.hello(HELLO, now_ns=0))
    assert refusal(client, call.line.seal(HORIZON)) == "out of place"
    assert client._candidate is None
    welcomed(client, server)


# -- floods ------------------------------------------------------------------------------------


def test_a_flood_of_initiations_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forged, foreign and repeated ones: the memory is bounded by the number of keys."""
    assert OUT_MAX == 1024
    monkeypatch.setattr(server_secure, "OUT_MAX", 64)
    rng, server = random.Random(3), gate()
    clients = [link(seed, key) for seed in range(20) for key in KEYS.values()]
    good = []
    for client in clients:
        challenged(client, server)
        good.append(client.hello(HELLO, now_ns=0))
    reasons = Counter[str]()
    for i in range(4000):
        now_ns = i * 5 * 10**6
        datagram = rng.choice(good)
        peer = HERE if rng.random() < 0.5 else (f"stranger {i}", i % 65_536)
        if i % 4:
            datagram = changed(datagram, rng.randrange(2, 512))
        try:
            call = server.open(Datagram(datagram, peer), now_ns=now_ns)
        except ProtocolError as error:
            reasons[error.reason] += 1
            continue
        if call is not None:
            call.line.seal(WELCOME)
            server.admit(call, now_ns=now_ns)
    assert set(reasons) == {"forged", "unknown key", "too many handshakes"}
    assert len(server._vehicles) == len(KEYS)
    assert all(len(each.pending) == PENDING_MAX for each in server._vehicles.values())
    assert len(server.outbox()) == 64
    assert server.outbox() == []


def test_hostile_datagrams_give_protocol_errors_alone() -> None:
    flight, rng = recorded(3), random.Random(4)
    flight.client.hello(HELLO, now_ns=flight.now_ns)
    reasons, accepted = Counter[str](), 0
    datagrams = [datagram for _, datagram in flight.sent]
    for _ in range(4000):
        if rng.random() < 0.3:
            datagram = bytes([VERSION, rng.randrange(6)]) + rng.randbytes(rng.randrange(600))
        else:
            datagram = rng.choice(datagrams)
            at = rng.randrange(len(datagram))
            datagram = rng.choice(
                [changed(datagram, at), datagram[:at], datagram + b"x", datagram[at:]]
            )
        for open_ in (
            lambda d: flight.server.open(Datagram(d, HERE), now_ns=flight.now_ns),
            lambda d: flight.client.open(d, now_ns=flight.now_ns),
        ):
            try:
                accepted += open_(datagram) is not None
            except ProtocolError as error:
                reasons[error.reason] += 1
    assert accepted == 0
    assert set(reasons) <= {
        "expired", "forged", "length", "not for a client", "not for a server", "not sealed",
        "replayed", "too many handshakes", "unasked", "unknown channel", "unknown key",
    }  # fmt: skip


def test_no_secret_is_shown_by_an_end() -> None:
    client, server = joined()
    call = called(server, client.seal(OBSERVATION))
    shown = repr((client, server, call.line, server._vehicles, client._current))
    for key in KEYS.values():
        for secret in (key.psk, key.mac, SECRETS[1]):
            assert secret.hex() not in shown
            assert repr(secret)[2:-1] not in shown


def test_a_hello_whose_ephemeral_key_is_none_is_dropped() -> None:
    key, server = KEYS[1, 5], gate()
    public = bytes(32)
    state = noise_nnpsk0._begin(key.psk, handshake.prologue(key)).mix_ephemeral(public)
    message = public + state.seal(handshake.pad(HELLO))[1]
    datagram = handshake.write_initiation(key, server._cookie(HERE, 0), message)
    with pytest.raises(ProtocolError, match="forged"):
        called(server, datagram).line.seal(WELCOME)
