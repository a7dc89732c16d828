"""Sealed packets of a channel: each is accepted once, and cannot be forged.

With SKYTETHER_LONG=1 in the environment, 10^7 steps of the window and 10^7 forgeries.
"""

import os
import random
import struct
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.shared.wire import channel as channels
from skytether.shared.wire.channel import (
    DATA,
    FRESH_NS,
    FRESH_PACKETS,
    HEADER,
    LIFE_NS,
    OVERHEAD_BYTES,
    OVERLAP_NS,
    PACKETS_MAX,
    RECENT,
    VERSION,
    WINDOW,
    Channel,
    ReplayWindow,
)
from skytether.shared.wire.drop import ProtocolError

LONG = os.environ.get("SKYTETHER_LONG") == "1"
STEPS = 10**7 if LONG else 4 * 10**4
FORGERIES = 10**7 if LONG else 3 * 10**4

FORTH, BACK = bytes([1]) * 32, bytes([2]) * 32
OTHER_FORTH, OTHER_BACK = bytes([3]) * 32, bytes([4]) * 32


def ends(
    vehicle: int = 1, number: int = 7, forth: bytes = FORTH, back: bytes = BACK
) -> tuple[Channel, Channel]:
    return (
        Channel(vehicle, number, seal=forth, open_=back, born_ns=0),
        Channel(vehicle, number, seal=back, open_=forth, born_ns=0),
    )


def refusal(channel: Channel, packet: bytes, now_ns: int = 0) -> str:
    with pytest.raises(ProtocolError) as error:
        channel.open(packet, now_ns=now_ns)
    return error.value.reason


# -- the window --------------------------------------------------------------------------------


class Oracle:
    """Replay window as a set."""

    def __init__(self) -> None:
        self.seen: set[int] = set()
        self.newest = -1

    def is_new(self, counter: int) -> bool:
        return counter > self.newest - WINDOW and counter not in self.seen

    def add(self, counter: int) -> None:
        self.seen.add(counter)
        self.newest = max(self.newest, counter)
        if len(self.seen) > 4 * WINDOW:
            self.seen = {each for each in self.seen if each > self.newest - WINDOW}


def agree(counters: Iterator[int] | list[int]) -> int:
    """Number of accepted counters; window and oracle must agree on each."""
    window, oracle, taken = ReplayWindow(), Oracle(), 0
    for counter in counters:
        new = window.is_new(counter)
        assert new == oracle.is_new(counter), counter
        if new:
            window.add(counter)
            oracle.add(counter)
            taken += 1
        assert window.newest == oracle.newest
        assert window._seen < 2**WINDOW
    return taken


COUNTERS = st.one_of(
    st.integers(0, 3 * WINDOW), st.integers(WINDOW - 3, WINDOW + 3), st.integers(0, 2**64 - 1)
)


@settings(max_examples=100)
@given(st.lists(COUNTERS, max_size=60))
def test_the_window_is_a_set_of_the_newest_counters(counters: list[int]) -> None:
    agree(counters)


@pytest.mark.timeout(3600 if LONG else 120)
def test_the_window_is_a_set_over_a_long_run() -> None:
    rng = random.Random(1)

    def counters() -> Iterator[int]:
        newest = 0
        for _ in range(STEPS):
            match rng.randrange(100):
                case 0:
                    newest += rng.choice([WINDOW - 1, WINDOW, WINDOW + 1, 10 * WINDOW])
                    yield newest
                case roll if roll < 60:
                    newest += 1 + rng.randrange(3)
                    yield newest
                case _:
                    yield max(0, newest - int(rng.expovariate(1.0 / 400.0)))

    assert agree(counters()) > STEPS // 2


def test_a_window_lets_the_oldest_in_and_nothing_older() -> None:
    assert WINDOW == 2048
    window = ReplayWindow()
    window.add(WINDOW)
    assert [counter for counter in range(WINDOW + 2) if not window.is_new(counter)] == [0, WINDOW]


# -- packets -----------------------------------------------------------------------------------


def test_the_bytes_of_a_packet() -> None:
    vehicle, _ = ends(vehicle=0x0201, number=0x06050403)
    vehicle.seal(b"")
    packet = vehicle.seal(b"message")
    assert packet[:16].hex(" ") == "01 04 01 02 03 04 05 06 01 00 00 00 00 00 00 00"
    assert len(packet) == len(b"message") + OVERHEAD_BYTES
    assert (OVERHEAD_BYTES, VERSION, DATA) == (32, 1, 4)


def test_packets_are_opened_in_any_order_and_once() -> None:
    vehicle, server = ends()
    for sender, receiver in ((vehicle, server), (server, vehicle)):
        packets = [sender.seal(bytes([i])) for i in range(5)]
        opened = [receiver.open(packets[i], now_ns=0) for i in (1, 0, 4, 2, 3)]
        assert [each.payload[0] for each in opened] == [1, 0, 4, 2, 3]
        assert [each.newest for each in opened] == [True, False, True, False, False]
        assert {refusal(receiver, packet) for packet in packets} == {"replayed"}


def test_repeats_of_recent_packets_are_known_but_for_forgeries_and_floods() -> None:
    vehicle, server = ends()
    packets = [vehicle.seal(bytes([i])) for i in range(RECENT + 1)]
    for packet in packets[:3]:
        server.open(packet, now_ns=0)
    assert server.repeats(packets[2])
    assert not server.repeats(packets[1][:-1] + bytes([packets[1][-1] ^ 1]))
    assert not server.repeats(packets[0])  # REPEATS were checked since the newest packet
    server.open(packets[3], now_ns=0)
    assert server.repeats(packets[0])
    assert not server.repeats(packets[4])  # it has not come yet
    server.open(packets[-1], now_ns=0)
    assert not server.repeats(packets[0])


def test_a_forged_counter_does_not_move_the_window() -> None:
    """Otherwise one forged packet would end the channel."""
    vehicle, server = ends()
    packet = vehicle.seal(b"message")
    far = HEADER.pack(VERSION, DATA, 1, 7, PACKETS_MAX - 1) + packet[HEADER.size :]
    assert refusal(server, far) == "forged"
    assert server.open(packet, now_ns=0).payload == b"message"


def test_without_the_window_a_packet_is_opened_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, server = ends()
    packet = vehicle.seal(b"message")
    server.open(packet, now_ns=0)
    monkeypatch.setattr(ReplayWindow, "is_new", lambda *_: True)
    assert server.open(packet, now_ns=0).payload == b"message"


def test_a_channel_is_replaced_and_ends_by_age() -> None:
    vehicle, server = ends()
    packets = [vehicle.seal(b"") for _ in range(3)]
    assert not vehicle.wants_successor(FRESH_NS - 1)
    assert vehicle.wants_successor(FRESH_NS)
    assert server.open(packets[0], now_ns=LIFE_NS).payload == b""
    assert refusal(server, packets[1], LIFE_NS + 1) == "expired"
    assert (FRESH_NS, LIFE_NS) == (300 * 10**9, 600 * 10**9)


def test_a_channel_is_replaced_and_ends_by_packets() -> None:
    vehicle, server = ends()
    vehicle._sent = FRESH_PACKETS - 1
    assert not vehicle.wants_successor(0)
    server.open(vehicle.seal(b""), now_ns=0)
    assert vehicle.wants_successor(0)
    assert server.wants_successor(0)
    vehicle._sent = PACKETS_MAX - 1
    assert server.open(vehicle.seal(b""), now_ns=0).newest
    assert refusal(server, vehicle.seal(b"")) == "expired"
    assert (FRESH_PACKETS, PACKETS_MAX) == (2**22, 2**32)


def test_a_retired_channel_opens_what_is_under_way() -> None:
    vehicle, server = ends()
    packets = [vehicle.seal(b"") for _ in range(4)]
    server.retire(now_ns=10**9)
    server.open(packets[0], now_ns=10**9 + OVERLAP_NS)
    assert refusal(server, packets[1], 10**9 + OVERLAP_NS + 1) == "expired"
    vehicle, server = ends()
    packet = vehicle.seal(b"")
    server.retire(now_ns=LIFE_NS)
    assert refusal(server, packet, LIFE_NS + 1) == "expired"
    assert OVERLAP_NS == 10 * 10**9


def test_without_expiry_an_old_packet_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: without expiry, a packet held back for a day would be believed."""
    monkeypatch.setattr(channels, "LIFE_NS", 2**62)
    vehicle, server = ends()
    assert server.open(vehicle.seal(b"old"), now_ns=86_400 * 10**9).payload == b"old"


def test_an_end_shows_no_key() -> None:
    assert "x01" not in repr(ends()[0])


# -- forgeries ---------------------------------------------------------------------------------

Forger = Callable[[random.Random, bytes, bytes], bytes]
"""Function that forges a packet from two sent ones."""


def flip_bit(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    changed = bytearray(packet)
    changed[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def change_bytes(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    changed = bytearray(packet)
    for _each in range(rng.randrange(1, 5)):
        changed[rng.randrange(len(packet))] = rng.randrange(256)
    return bytes(changed)


def change_header(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    at = HEADER.size - 8
    counter = rng.choice([rng.randrange(64), rng.randrange(2**32), rng.randrange(2**64)])
    return packet[:at] + struct.pack("<Q", counter) + packet[at + 8 :]


def cut(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    return packet[: rng.randrange(len(packet))]


def extend(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    return packet + rng.randbytes(rng.randrange(1, 40))


def splice(rng: random.Random, packet: bytes, other: bytes) -> bytes:
    at = rng.randrange(1, min(len(packet), len(other)))
    return packet[:at] + other[at:]


def invent(rng: random.Random, packet: bytes, _: bytes) -> bytes:
    return packet[: HEADER.size] + rng.randbytes(rng.randrange(80))


FORGERS: list[Forger] = [flip_bit, change_bytes, change_header, cut, extend, splice, invent]
REASONS = {"forged", "replayed", "length", "unknown channel", "expired"}


@pytest.mark.timeout(3600 if LONG else 120)
def test_no_forgery_is_opened() -> None:
    rng = random.Random(2)
    vehicle, server = ends()
    packets = [vehicle.seal(rng.randbytes(rng.randrange(1, 90))) for _ in range(64)]
    accepted, reasons = 0, set()
    made = 0
    while made < FORGERIES:
        packet, other = rng.choice(packets), rng.choice(packets)
        forged = rng.choice(FORGERS)(rng, packet, other)
        if forged in (packet, other):
            continue
        made += 1
        try:
            server.open(forged, now_ns=0)
        except ProtocolError as error:
            reasons.add(error.reason)
        else:
            accepted += 1
    assert (accepted, made) == (0, FORGERIES)
    assert reasons <= REASONS
    # The window has not moved: the genuine packets are still opened.
    assert all(server.open(packet, now_ns=0) for packet in packets)


def test_a_packet_of_another_channel_is_not_opened() -> None:
    """Packets of the other direction, another vehicle, another channel or another handshake.

    Both unchanged, and with the header that this channel expects.
    """
    vehicle, server = ends()
    others = {
        "the other direction": server,
        "another vehicle": ends(vehicle=2)[0],
        "another channel": ends(number=8)[0],
        "another handshake": ends(forth=OTHER_FORTH, back=OTHER_BACK)[0],
    }
    for name, other in others.items():
        for counter in range(500):
            packet = other.seal(b"message")
            header = HEADER.pack(VERSION, DATA, 1, 7, counter)
            assert refusal(server, packet) in REASONS, name
            assert refusal(server, header + packet[HEADER.size :]) == "forged", name
    assert server.open(vehicle.seal(b"message"), now_ns=0).newest
