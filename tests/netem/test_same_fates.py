"""Programs that send alike meet the same fates in each run, whenever they send."""

import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether
from helpers import PATIENCE_S, echo, until
from skytether.__main__ import main
from skytether.netem.emulator import Emulator
from skytether.netem.proxy import Proxy
from skytether.netem.relay import Relay
from skytether.netem.tunnel import Tunnel
from skytether.shared.base.packets import PROGRAM
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.endpoints.line import CLIENT
from skytether.shared.endpoints.other_directions import RELAY
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, PACKET_COLUMNS, MemoryRecorder, Recorder
from skytether.shell.processes.process import Process

AIR = "gamma(0.01, 0.1, 0.05) & loss(0.3) & duplicate(0.2) & corrupt(0.2)"
FAR = ("192.0.2.9", 5000)
ALICE, BOB = ("192.0.2.1", 5000), ("192.0.2.1", 5001)
COUNT = 40

TIMES = st.lists(st.integers(0, SECOND_NS // 10), min_size=COUNT, max_size=COUNT)
"""Times from each packet to the next [ns]."""


def heard_by_a_proxy(flow: int, number: int) -> Datagram:
    return Datagram(bytes([number]) * 20, (ALICE, BOB)[flow])


def heard_by_a_tunnel(flow: int, number: int) -> Datagram:
    """Datagram of IPv4 from the program's port 5000, or 5001, to port 53 outside."""
    head = struct.pack(">BBHHHBBH", 0x45, 0, 29, 0, 0x4000, 64, socket.IPPROTO_UDP, 0)
    ends = bytes((10, 0, 2, 100, 192, 0, 2, 1)) + struct.pack(">HHHH", 5000 + flow, 53, 9, 0)
    return Datagram(head + ends + bytes([number]), PROGRAM)


def heard_by_a_relay(flow: int, number: int) -> Datagram:
    return Datagram(bytes([number]) * 20, (CLIENT, flow + 1), 1)


def made(kind: Callable[..., Emulator], text: str, recorder: Recorder | None = None) -> Emulator:
    network = NetworkConfig(uplink=text, downlink=text)
    return kind(Scenario(seed=7, network=network), recorder=recorder)


KINDS = {
    "proxy": (partial(Proxy, server=FAR, directions=RELAY), heard_by_a_proxy),
    "tunnel": (partial(Tunnel, mtu=1500), heard_by_a_tunnel),
    "relay": (partial(Relay, server=FAR), heard_by_a_relay),
}


def fates(name: str, gaps_ns: list[int]) -> tuple[list[Any], list[bytes], Any]:
    """Flow, number, loss and delay of each packet of two flows; what arrives; and retries."""
    recorder = MemoryRecorder(PACKET_COLUMNS)
    kind, heard = KINDS[name]
    netem, now_ns = made(kind, AIR, recorder), SECOND_NS
    for number, gap_ns in enumerate(gaps_ns):
        now_ns += gap_ns
        for flow in (0, 1):
            netem.wake(now_ns=now_ns)
            netem.receive(heard(flow, number), now_ns=now_ns)
    while (due_ns := netem.next_wake_ns()) is not None:
        netem.wake(now_ns=due_ns)
    rows = recorder.rows()
    rows = rows[rows["direction"] == DOWNLINK]
    columns = (
        ("flow", "number", "lost") if name == "relay" else ("flow", "number", "lost", "delay_ns")
    )
    met = sorted(tuple(row[each].item() for each in columns) for row in rows)
    return met, sorted(each.payload for each in netem.outbox()), netem.figures().get("retries")


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=25, deadline=None)
@given(one=TIMES, other=TIMES)
def test_the_same_packets_meet_the_same_fates_whenever_they_come(
    name: str, one: list[int], other: list[int]
) -> None:
    first = fates(name, one)
    assert len(first[0]) == 2 * COUNT
    assert fates(name, other) == first


def test_the_flows_of_a_relay_have_fates_of_their_own() -> None:
    met, *_ = fates("proxy", [0] * COUNT)
    lost = [[is_lost for flow, _, is_lost, _ in met if flow == which] for which in (0, 1)]
    assert lost[0] != lost[1]


@pytest.mark.parametrize("name", ["proxy", "relay"])
def test_an_outage_of_a_relay_counts_from_the_first_packet_of_each_flow(name: str) -> None:
    kind, heard = KINDS[name]
    netem = made(kind, "outage(1, 2)")

    def passes(flow: int, at_ms: int) -> bool:
        netem.receive(heard(flow, 0), now_ns=at_ms * MILLISECOND_NS)
        return bool(netem.outbox())

    assert passes(0, 10_000)
    assert not passes(0, 11_500)
    assert passes(1, 11_600)
    assert not passes(1, 13_000)


def test_packets_of_a_flight_have_fates_by_their_time() -> None:
    """Two controllers send at times of their own, and meet the same network at each time."""

    def delays(times_ms: range) -> dict[int, int]:
        recorder = MemoryRecorder(PACKET_COLUMNS)
        netem = made(partial(Proxy, server=FAR), "gamma(0.01, 0.1, 0.05)", recorder)
        for at_ms in times_ms:
            netem.receive(heard_by_a_proxy(0, at_ms), now_ns=at_ms * MILLISECOND_NS)
        netem.wake(now_ns=10 * SECOND_NS)
        rows = recorder.rows()
        return dict(zip(rows["arrived_ns"].tolist(), rows["delay_ns"].tolist(), strict=True))

    often, seldom = delays(range(0, 200, 1)), delays(range(0, 200, 10))
    assert seldom.items() <= often.items()


@pytest.mark.parametrize(
    ("scenario", "by_number"), [([], True), (["transparent"], True), (["demo"], False)]
)
def test_a_relay_without_the_scenario_of_a_flight_repeats_fates_by_number(
    scenario: list[str], by_number: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: list[Any] = []
    monkeypatch.setattr(Process, "drive", lambda _, endpoint, **__: driven.append(endpoint))
    assert main(["netem", *scenario, "--bind", "127.0.0.1:0", "--to-server", "loss(20%)"]) == 0
    (proxy,) = driven
    assert proxy.fates("downlink", 0).by_number is by_number


@pytest.mark.realtime
def test_the_same_datagrams_are_lost_in_each_run(
    bad_network: Callable[..., skytether.bad_network],
) -> None:
    def answered(batch: int) -> set[bytes]:
        with (
            echo() as port,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        ):
            client.settimeout(PATIENCE_S)
            net = bad_network(to_server="loss(20%)", to=("127.0.0.1", port), seed=7)
            got = set()
            for begin in range(0, 50, batch):
                for number in range(begin, min(begin + batch, 50)):
                    client.sendto(bytes([number]), net.address)
                until(lambda end=begin: net.counts["to_server"]["packets"] >= min(end + batch, 50))
            for _ in range(50 - net.counts["to_server"]["lost"]):
                got.add(client.recv(100))
            return got

    first = answered(50)
    assert 30 <= len(first) < 50
    assert answered(7) == answered(1) == first
