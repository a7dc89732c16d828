"""The network of a program, in virtual time."""

import struct
from ipaddress import ip_address

import numpy as np
import pytest

from skytether.netem import tunnel as tunnel_module
from skytether.netem.tunnel import Tunnel
from skytether.shared.base.packets import OUTSIDE, PROGRAM
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, PACKET_COLUMNS, MemoryRecorder, Recorder

UDP = 17


def make_tunnel(
    uplink: str = "",
    downlink: str = "",
    *,
    seed: int = 1,
    mtu: int = 1500,
    recorder: Recorder | None = None,
) -> Tunnel:
    network = NetworkConfig(uplink=uplink, downlink=downlink)
    return Tunnel(Scenario(seed=seed, network=network), mtu=mtu, recorder=recorder)


def packet(port: int = 5000, size: int = 100, *, is_outward: bool = True) -> bytes:
    """Datagram of IPv4 between the program's port and port 53 outside, `size` bytes in all."""
    here, there = ip_address("10.0.2.100").packed, ip_address("192.0.2.1").packed
    ports = struct.pack(">HH", port, 53)
    if not is_outward:
        here, there, ports = there, here, ports[2:] + ports[:2]
    head = struct.pack(">BBHHHBBH", 0x45, 0, size, 0, 0x4000, 64, UDP, 0)
    return (head + here + there + ports).ljust(size, b"\0")


def send(tunnel: Tunnel, data: bytes, peer: Address = PROGRAM, *, at_ns: int = 0) -> list[Datagram]:
    tunnel.receive(Datagram(data, peer, 1), now_ns=at_ns)
    return tunnel.outbox()


def test_packets_pass_each_way_unchanged() -> None:
    tunnel, out, back = make_tunnel(), packet(), packet(is_outward=False)
    assert send(tunnel, out) == [Datagram(out, OUTSIDE, 1)]
    assert send(tunnel, back, OUTSIDE) == [Datagram(back, PROGRAM, 1)]
    assert tunnel.figures()["flows"] == 1


def test_each_direction_has_a_delay_of_its_own() -> None:
    tunnel = make_tunnel("constant(0.03)", "constant(0.01)")
    assert not send(tunnel, packet())
    assert tunnel.next_wake_ns() == 10 * MILLISECOND_NS
    tunnel.wake(now_ns=10 * MILLISECOND_NS)
    assert len(tunnel.outbox()) == 1
    assert not send(tunnel, packet(is_outward=False), OUTSIDE, at_ns=SECOND_NS)
    assert tunnel.next_wake_ns() == SECOND_NS + 30 * MILLISECOND_NS


def test_a_rate_counts_the_bytes_of_packets_and_no_more() -> None:
    tunnel = make_tunnel(downlink="rate(1500000, queue=100000)")
    for _ in range(11):
        send(tunnel, packet(size=1500))
    passed = 0
    while (due_ns := tunnel.next_wake_ns()) is not None:
        tunnel.wake(now_ns=due_ns)
        passed += len(tunnel.outbox())
        last_ns = due_ns
    assert passed == 11
    assert last_ns == 11 * MILLISECOND_NS


def fates(
    seed: int, jitter_ns: int, *, concurrent: bool = False
) -> list[tuple[int, int, bool, int]]:
    """Flow, number, loss and delay of each packet of a program that sends 300, every 7 ms or so."""
    recorder = MemoryRecorder(PACKET_COLUMNS)
    air = "uniform(0.01, 0.2) & loss(0.3)"
    tunnel = make_tunnel(air, air, seed=seed, recorder=recorder)
    rng = np.random.default_rng(jitter_ns)
    for number in range(300):
        at_ns = number * 7 * MILLISECOND_NS + int(rng.integers(jitter_ns + 1))
        send(tunnel, packet(5000), at_ns=at_ns)
        if concurrent and rng.random() < 0.5:
            send(tunnel, packet(6000), at_ns=at_ns)
    tunnel.wake(now_ns=10 * SECOND_NS)
    rows = recorder.rows()
    ours = rows[(rows["direction"] == DOWNLINK) & (rows["flow"] == 0)]
    columns = ("flow", "number", "lost", "delay_ns")
    return sorted(tuple(row[name].item() for name in columns) for row in ours)


def test_a_program_that_sends_alike_meets_the_same_fates_whenever_it_sends() -> None:
    first = fates(1, 0)
    assert len(first) == 300
    assert fates(1, 6 * MILLISECOND_NS) == first
    assert fates(2, 0) != first


def test_the_fates_of_a_flow_do_not_depend_on_other_flows() -> None:
    assert fates(1, 6 * MILLISECOND_NS, concurrent=True) == fates(1, 0)


def test_packets_of_different_flows_have_different_fates() -> None:
    tunnel = make_tunnel(downlink="loss(0.5)")
    lost = [not send(tunnel, packet(port)) for port in range(1, 201)]
    assert 70 <= sum(lost) <= 130


def test_an_outage_is_common_to_all_flows_and_counts_from_the_first_packet() -> None:
    tunnel = make_tunnel(downlink="outage(1, 1)")
    begin_ns = 100 * SECOND_NS
    assert send(tunnel, packet(1), at_ns=begin_ns)
    during = begin_ns + 3 * SECOND_NS // 2
    assert not send(tunnel, packet(1), at_ns=during)
    assert not send(tunnel, packet(2), at_ns=during)
    assert send(tunnel, packet(3), at_ns=begin_ns + 5 * SECOND_NS // 2)


def test_bursts_of_loss_are_common_to_all_flows() -> None:
    tunnel = make_tunnel(downlink="gilbert_elliott(0.5, 1)")
    pairs = [
        [bool(send(tunnel, packet(port), at_ns=step * 100 * MILLISECOND_NS)) for port in (1, 2)]
        for step in range(300)
    ]
    assert all(one == other for one, other in pairs)
    assert {one for one, _ in pairs} == {True, False}


def test_a_packet_longer_than_the_path_is_dropped_and_answered() -> None:
    tunnel = make_tunnel(mtu=1300)
    (answer,) = send(tunnel, packet(size=1301))
    assert answer.peer == PROGRAM
    assert answer.payload[20:22] == bytes([3, 4])
    assert send(tunnel, packet(size=1300))[0].peer == OUTSIDE
    assert tunnel.downlink.counts.oversized == 1


def test_what_is_no_packet_is_counted_and_dropped() -> None:
    tunnel = make_tunnel()
    assert not send(tunnel, b"\0" * 40)
    assert tunnel.figures()["refused"] == 1


def test_flows_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tunnel_module, "FLOWS_MAX", 10)
    tunnel = make_tunnel()
    for port in range(1, 101):
        assert send(tunnel, packet(port))
        assert send(tunnel, packet(1))  # the busy flow stays
    assert tunnel.figures()["flows"] == 10


def test_a_thousand_flows() -> None:
    tunnel = make_tunnel(downlink="constant(0.01)")
    for port in range(1000):
        send(tunnel, packet(port))
    tunnel.wake(now_ns=SECOND_NS)
    assert len(tunnel.outbox()) == 1000
    assert tunnel.figures()["flows"] == 1000


def test_the_last_packets_of_a_program_go_out_before_the_end() -> None:
    tunnel = make_tunnel(downlink="constant(0.5)")
    send(tunnel, packet())
    send(tunnel, b"")
    assert not tunnel.finished
    tunnel.wake(now_ns=SECOND_NS)
    assert len(tunnel.outbox()) == 1
    assert tunnel.finished


def test_without_a_way_out_it_ends_at_once() -> None:
    tunnel = make_tunnel(downlink="constant(0.5)")
    send(tunnel, packet())
    send(tunnel, b"", OUTSIDE)
    assert tunnel.finished


def test_a_change_applies_to_all_flows() -> None:
    tunnel = make_tunnel()
    assert send(tunnel, packet(1))
    network = NetworkConfig(downlink="loss(1)")
    changed = Scenario(seed=1, network=network)
    tunnel.change(changed, frozenset({"network.downlink"}), now_ns=0)
    assert not send(tunnel, packet(1))
    assert not send(tunnel, packet(2))
