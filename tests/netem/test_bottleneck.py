"""`netem.bottleneck`: rates and queues against the fluid limit and queueing theory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.netem.bottleneck import INTERVAL_NS, TARGET_NS, Bottleneck, Codel
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.link import Lane, Link
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.scenario.reading import files_of
from skytether.shared.telemetry.record import UPLINK

Packet = tuple[int, int, int]
"""Time of entry [ns], size [B], flow."""


def linked(text: str) -> tuple[Link, Lane]:
    direction = impairments(text)
    return Link(UPLINK, 1472, None, direction), Lane(0, Fates(direction, 1, "uplink", 0), 0)


def passed(text: str, packets: Sequence[Packet]) -> tuple[dict[int, int], list[int]]:
    """Times at which packets have passed by number [ns], and the numbers of those dropped."""
    queue = impairments(text, files_of("network.uplink", text)).queue
    assert queue is not None
    bottleneck: Bottleneck[int] = Bottleneck(queue)
    out: dict[int, int] = {}
    for number, (entered_ns, size, flow) in enumerate(packets):
        out.update(bottleneck.release(now_ns=entered_ns))
        bottleneck.accept(number, size, flow, now_ns=entered_ns)
        assert bottleneck.waiting_bytes <= queue.room_bytes
    while (due_ns := bottleneck.next_due_ns()) is not None:
        out.update(bottleneck.release(now_ns=due_ns))
    assert (bottleneck.waiting, bottleneck.waiting_bytes) == (0, 0)
    return out, bottleneck.dropped


def test_a_packet_takes_its_size_over_the_rate() -> None:
    out, dropped = passed("rate(1000)", [(0, 100, 0), (0, 50, 0), (SECOND_NS, 100, 0)])
    assert out == {0: SECOND_NS // 10, 1: 15 * SECOND_NS // 100, 2: 11 * SECOND_NS // 10}
    assert dropped == []


@pytest.mark.parametrize("serve", ["first", "fair"])
def test_too_much_passes_at_the_rate(serve: str) -> None:
    every_ns = SECOND_NS * 100 // 20_000  # 100 B at 20 kB/s
    packets = [(number * every_ns, 100, number % 2) for number in range(4000)]
    out, dropped = passed(f"rate(10000, queue=5000, serve={serve})", packets)
    assert len(out) == pytest.approx(2000 + 50, abs=2)
    assert len(out) + len(dropped) == 4000
    waits_ns = [out[number] - number * every_ns for number in sorted(out)[1000:]]
    # 5000 B at the rate, the packet being served, and a turn.
    assert max(waits_ns) <= 0.54 * SECOND_NS
    assert np.mean(waits_ns) == pytest.approx(0.505 * SECOND_NS, rel=0.01)


@pytest.mark.parametrize("load", [0.3, 0.7])
def test_random_arrivals_wait_as_in_m_d_1(load: float) -> None:
    """Mean wait of Pollaczek and Khinchine: load / (2 (1 - load)) times the service."""
    service_ns, count = MILLISECOND_NS, 30_000
    gaps = np.random.default_rng(7).exponential(service_ns / load, count)
    entered = np.cumsum(gaps).astype(int).tolist()
    out, dropped = passed("rate(100000, queue=1000000)", [(at, 100, 0) for at in entered])
    waits_ns = [out[number] - at - service_ns for number, at in enumerate(entered)]
    assert dropped == []
    assert np.mean(waits_ns) == pytest.approx(load / (2 - 2 * load) * service_ns, rel=0.08)


def test_fair_serves_each_flow_alike() -> None:
    loud = [(number * MILLISECOND_NS, 1000, 0) for number in range(5000)]
    quiet = [(number * 20 * MILLISECOND_NS, 100, 1) for number in range(250)]
    packets = sorted(loud + quiet)
    of_quiet = [number for number, packet in enumerate(packets) if packet[2] == 1]

    def served(serve: str) -> tuple[float, float]:
        out, _ = passed(f"rate(20000, queue=20000, serve={serve})", packets)
        came = [number for number in of_quiet if number in out]
        waits_ns = [out[number] - packets[number][0] for number in came]
        return len(came) / len(of_quiet), float(np.mean(waits_ns)) / SECOND_NS

    share, wait_s = served("fair")
    assert share == 1.0
    assert wait_s < 0.16  # a turn of the other flow, and the packet being sent
    share, wait_s = served("first")
    assert wait_s > 0.5


def test_codel_drops_at_the_times_of_rfc_8289() -> None:
    """One interval after waits became too long, then at INTERVAL / √n; not while they are short."""
    codel, began_ns = Codel(), SECOND_NS
    assert not codel.drops(began_ns, is_fine=False)
    assert not codel.drops(began_ns + INTERVAL_NS - 1, is_fine=False)
    first_ns = began_ns + INTERVAL_NS
    assert codel.drops(first_ns, is_fine=False)
    assert not codel.drops(first_ns + INTERVAL_NS - 1, is_fine=False)
    second_ns = first_ns + INTERVAL_NS
    assert codel.drops(second_ns, is_fine=False)
    third_ns = second_ns + round(INTERVAL_NS / 2**0.5)
    assert not codel.drops(third_ns - 1, is_fine=False)
    assert codel.drops(third_ns, is_fine=False)
    assert not codel.drops(third_ns + SECOND_NS, is_fine=True)
    assert not codel.drops(third_ns + SECOND_NS + 1, is_fine=False)


def test_codel_keeps_the_queue_short() -> None:
    every_ns = SECOND_NS * 100 // 12_000
    steady = [(number * every_ns, 100, 0) for number in range(6000)]
    waits = {}
    for drop in ("tail", "codel"):
        out, _ = passed(f"rate(10000, queue=10000, drop={drop})", steady)
        late = [number for number in sorted(out) if number > 3000]
        waits[drop] = np.mean([out[number] - steady[number][0] for number in late])
    assert waits["tail"] > 0.9 * SECOND_NS
    assert waits["codel"] < 2 * INTERVAL_NS
    burst = [(0, 100, 0)] * 8
    assert passed("rate(10000, queue=10000, drop=codel)", burst)[1] == []
    assert TARGET_NS < INTERVAL_NS


def test_times_of_mahimahi_are_kept(tmp_path: Path) -> None:
    """1504 bytes at each time, shared by small packets, repeated; unused ones are lost."""
    (tmp_path / "a.mahi").write_text("10\n10\n30\n40\n")
    text = f'deliveries("{tmp_path}/a.mahi", queue=100000)'
    ms = MILLISECOND_NS
    out, _ = passed(text, [(0, 1504, 0)] * 5)
    assert [out[number] // ms for number in range(5)] == [10, 10, 30, 40, 50]
    out, _ = passed(text, [(0, 752, 0)] * 4 + [(35 * ms, 100, 0), (60 * ms, 1504, 0)])
    assert [out[number] // ms for number in range(6)] == [10, 10, 10, 10, 40, 70]
    queue = impairments(text, files_of("network.uplink", text)).queue
    assert queue is not None
    assert queue.bytes_per_s == 4 * 1504 / 0.04


@given(
    st.lists(
        st.tuples(st.integers(0, 10**9), st.integers(28, 1500), st.integers(0, 4)), max_size=60
    ),
    st.sampled_from(["tail", "codel"]),
    st.sampled_from(["first", "fair"]),
)
def test_every_packet_passes_once_or_is_dropped(
    packets: list[Packet], drop: str, serve: str
) -> None:
    packets = sorted(packets)
    out, dropped = passed(f"rate(20000, queue=6000, drop={drop}, serve={serve})", packets)
    assert sorted([*out, *dropped]) == list(range(len(packets)))
    for flow in range(5):
        of_flow = [number for number in out if packets[number][2] == flow]
        assert of_flow == sorted(of_flow)
    busy_ns = sum(round(packets[number][1] / 20_000 * SECOND_NS) for number in out)
    if out:
        first_ns = min(packets[number][0] for number in out)
        assert max(out.values()) >= first_ns + busy_ns - 1
        assert max(out.values()) <= packets[max(out)][0] + busy_ns


def test_what_is_lost_on_the_way_has_taken_its_time() -> None:
    """A packet lost after the bottleneck has used it; the next packet waits all the same."""
    link, lane = linked("loss(1) & constant(0.1) & rate(12800)")
    for _ in range(3):
        link.accept(Datagram(b"x" * (128 - HEADER_BYTES), ("a", 1)), lane, now_ns=0)
    assert link.next_due_ns() == 10 * MILLISECOND_NS
    assert link.release(now_ns=30 * MILLISECOND_NS) == []
    assert (link.counts.lost, link.counts.queueing.largest_ns) == (3, 30 * MILLISECOND_NS)


def test_what_is_under_way_waits_for_the_rate_or_is_delayed() -> None:
    """Both count, except for the packet being served; queued packets count with headers."""
    (link, lane), size = linked("constant(0.1) & rate(12800)"), 128 - HEADER_BYTES
    for _ in range(5):
        link.accept(Datagram(b"x" * size, ("a", 1)), lane, now_ns=0)
    assert (link.depth(), link.depth_bytes()) == (4, 4 * 128)
    link.release(now_ns=25 * MILLISECOND_NS)  # two have passed, and arrive 0.1 s later
    assert (link.depth(), link.depth_bytes()) == (4, 2 * size + 2 * 128)
    link.release(now_ns=115 * MILLISECOND_NS)
    assert (link.depth(), link.depth_bytes()) == (4, 4 * size)


def test_a_rate_that_changes_serves_those_who_wait() -> None:
    for text, due_ms in (("rate(100000)", 40), ("constant(0)", 20)):
        link, lane = linked("rate(10000)")
        for _ in range(20):
            link.accept(Datagram(b"x" * 72, ("a", 1)), lane, now_ns=0)
        link.release(now_ns=20 * MILLISECOND_NS)
        link.change(impairments(text), now_ns=20 * MILLISECOND_NS)
        left = 0
        while (due_ns := link.next_due_ns()) is not None:
            left += len(link.release(now_ns=due_ns))
            assert due_ns <= due_ms * MILLISECOND_NS
        assert left == 18


def test_ordered_lets_nobody_overtake() -> None:
    for text, reordered in (("uniform(0, 0.1)", True), ("uniform(0, 0.1) & ordered", False)):
        link, lane = linked(text)
        for number in range(200):
            now_ns = number * 5 * MILLISECOND_NS
            link.release(now_ns=now_ns)
            link.accept(Datagram(b"x", ("a", 1)), lane, now_ns=now_ns)
        link.release(now_ns=10 * SECOND_NS)
        assert link.counts.forwarded == 200
        assert (link.counts.reordered > 0) == reordered


def test_copies_and_flipped_bits() -> None:
    link, lane = linked("duplicate(1) & corrupt(1)")
    for number in range(50):
        link.accept(Datagram(bytes(20), ("a", 1)), lane, now_ns=number * MILLISECOND_NS)
    out = [datagram.payload for datagram in link.release(now_ns=SECOND_NS)]
    assert len(out) == 100
    assert out[::2] == out[1::2]
    assert {int.from_bytes(payload).bit_count() for payload in out} == {1}
    assert len(set(out)) > 30
    assert (link.counts.duplicated, link.counts.corrupted) == (50, 50)
