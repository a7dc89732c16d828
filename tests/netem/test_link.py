"""`netem.link`: one direction of the network, and its counters."""

from collections.abc import Iterable
from heapq import heappop, heappush

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.netem import link as link_module
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.impairments.draws import SLOT_NS, Fate
from skytether.netem.link import QUEUE_BYTES_MAX, SLICE_BITS, Lane, Link, QueuedPacket
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.telemetry.record import (
    DOWNLINK,
    PACKET_COLUMNS,
    UPLINK,
    MemoryRecorder,
    Rows,
)

PEER = ("192.0.2.1", 5000)


def make_link(mtu: int = 1472) -> Link:
    return Link(UPLINK, mtu, None)


class Listed(Fates):
    """Given fates in order, at any times."""

    def __init__(self, fates: Iterable[Fate]) -> None:
        self._listed = iter(fates)

    def at(self, slot: int, rank: int = 0) -> Fate:  # noqa: ARG002
        return next(self._listed)


def make_lane(*delays_ns: int, flow: int = 0, lost: Iterable[int] = ()) -> Lane:
    """Flow whose packets have these delays; those with the numbers in `lost` are lost."""
    lost = set(lost)
    listed = Listed(Fate(delay_ns=delay, lost=i in lost) for i, delay in enumerate(delays_ns))
    return Lane(flow, listed, began_ns=0)


def packet(name: str) -> Datagram:
    return Datagram(name.encode(), PEER)


def take(link: Link, lane: Lane, names: str, *, now_ns: int = 0) -> None:
    """Let a packet enter for each letter."""
    for name in names:
        link.accept(packet(name), lane, now_ns=now_ns)


def give(link: Link, *, now_ns: int) -> str:
    """Letters of the packets that leave."""
    return "".join(datagram.payload.decode() for datagram in link.release(now_ns=now_ns))


def test_packets_due_at_once_leave_in_the_order_in_which_they_came() -> None:
    link, near, far = make_link(), make_lane(50, 0, flow=1), make_lane(50, 40, flow=0)
    take(link, near, "a", now_ns=0)
    take(link, far, "b", now_ns=0)
    take(link, far, "c", now_ns=10)
    take(link, near, "d", now_ns=50)
    assert give(link, now_ns=50) == "abcd"


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 9), st.booleans()), max_size=60),
    st.integers(0, 30),
)
def test_what_leaves_is_what_a_sorted_list_would_give(
    packets: list[tuple[int, int, bool]], now_ns: int
) -> None:
    """Oracle of the heap: stable sort by due time, then cut."""
    link = make_link()
    delays = [delay for _, delay, _ in packets]
    lane = make_lane(*delays, lost=[i for i, (_, _, lost) in enumerate(packets) if lost])
    arrived, dues = 0, []
    for number, (gap, delay, lost) in enumerate(packets):
        arrived += gap
        link.accept(Datagram(bytes([number]), PEER), lane, now_ns=arrived)
        dues += [] if lost else [(arrived + delay, number)]
    left = [datagram.payload[0] for datagram in link.release(now_ns=now_ns)]
    assert left == [number for due, number in sorted(dues) if due <= now_ns]
    assert link.depth() == len(dues) - len(left)


def test_a_packet_leaves_as_it_came() -> None:
    link, datagram = make_link(), Datagram(b"\x00\xff", PEER, 7)
    link.accept(datagram, make_lane(5), now_ns=0)
    assert link.release(now_ns=5) == [datagram]


def test_the_next_due_time_is_that_of_the_earliest_packet() -> None:
    link = make_link()
    assert link.next_due_ns() is None
    take(link, make_lane(30, 10), "ab", now_ns=100)
    assert link.next_due_ns() == 110
    give(link, now_ns=110)
    assert link.next_due_ns() == 130
    give(link, now_ns=130)
    assert link.next_due_ns() is None


def test_lost_packets_never_leave_and_are_counted() -> None:
    link = make_link()
    take(link, make_lane(0, 0, 0, lost=[0, 2]), "abc")
    assert (link.counts.packets, link.counts.lost, link.depth()) == (3, 2, 1)
    assert give(link, now_ns=0) == "b"
    assert link.counts.forwarded == 1


def test_a_full_queue_drops_what_comes_and_counts_it_apart_from_losses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(link_module, "QUEUE_MAX", 2)
    link, lane = make_link(), make_lane(9, 8, 1, 1)
    take(link, lane, "abc")
    assert (link.counts.overflowed, link.counts.lost, link.depth()) == (1, 0, 2)
    assert give(link, now_ns=8) == "b"
    take(link, lane, "d", now_ns=8)
    assert give(link, now_ns=9) == "ad"
    assert (link.counts.packets, link.counts.forwarded) == (4, 3)


def test_a_packet_that_overflows_uses_up_its_fate(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dropped packet counts among those of its slot, so fates of later ones stay the same."""
    monkeypatch.setattr(link_module, "QUEUE_MAX", 1)
    link, lane = make_link(), make_lane(1, 100, 7)
    take(link, lane, "ab")
    assert give(link, now_ns=1) == "a"
    take(link, lane, "c", now_ns=1)
    assert link.next_due_ns() == 8


def test_what_is_longer_than_the_mtu_is_dropped_and_counted_apart() -> None:
    link, lane = make_link(mtu=1200), make_lane(0, 0, 7)
    for size in (1200, 1201, 1):
        link.accept(Datagram(bytes(size), PEER), lane, now_ns=0)
    assert [len(datagram.payload) for datagram in link.release(now_ns=6)] == [1200]
    assert link.next_due_ns() == 7
    counts = link.counts
    assert (counts.oversized, counts.lost, counts.overflowed, counts.packets) == (1, 0, 0, 3)


def test_what_is_under_way_is_bounded_in_bytes_too() -> None:
    """Worst case: packets of UDP's largest size; 64 MiB are kept, from whatever sender."""
    link, size = make_link(mtu=65_507), 65_507
    lane = make_lane(*range(1, 2001))
    payload = bytes(size)
    for _ in range(2000):
        link.accept(Datagram(payload, PEER), lane, now_ns=0)
    most = QUEUE_BYTES_MAX // size
    assert (link.depth(), link.counts.overflowed) == (most, 2000 - most)
    assert link.depth_bytes() == most * size <= QUEUE_BYTES_MAX
    assert len(link.release(now_ns=most)) == most
    assert link.depth_bytes() == 0


def test_what_leaves_makes_room_for_as_many_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "QUEUE_BYTES_MAX", 100)
    link, lane = make_link(), make_lane(5, 5, 5, 5)
    for size in (90, 20, 10):
        link.accept(Datagram(bytes(size), PEER), lane, now_ns=0)
    assert [len(datagram.payload) for datagram in link.release(now_ns=5)] == [90, 10]
    link.accept(Datagram(bytes(100), PEER), lane, now_ns=5)
    assert (link.depth(), link.counts.overflowed) == (1, 1)


def test_figures_tell_delays_between_edges_and_how_late_packets_have_left() -> None:
    link, late_ms = make_link(), (0, 1, 1, 10)
    lane = make_lane(*[150 * MILLISECOND_NS] * 4)
    for number, late in enumerate(late_ms):
        entered_ns = number * 1000 * MILLISECOND_NS
        take(link, lane, "a", now_ns=entered_ns)
        assert give(link, now_ns=entered_ns + (150 + late) * MILLISECOND_NS) == "a"
    figures = link.figures()
    assert figures["error_ms_p50"] == pytest.approx(1.0, abs=0.03)
    assert figures["error_ms_p99"] == pytest.approx(10.0, abs=0.03)
    assert figures["error_ms_max"] == 10.0
    edges = [20, 40, 60, 80, 100, 140, 200, 300, 400, 500, 600, 800, 1000, 2000]
    assert list(figures["delays_within_ms"]) == [*map(str, edges), "inf"]


def test_the_greatest_depth_is_remembered() -> None:
    link = make_link()
    take(link, make_lane(1, 1, 1), "abc")
    give(link, now_ns=1)
    assert (link.depth(), link.counts.depth_max) == (0, 3)


def test_overtaken_packets_are_counted_as_reordered() -> None:
    link = make_link()
    take(link, make_lane(30, 20, 10, 40), "abcd")
    assert give(link, now_ns=40) == "cbad"
    assert link.counts.reordered == 2


def test_flows_do_not_overtake_each_other() -> None:
    link = make_link()
    take(link, make_lane(20, flow=0), "a")
    take(link, make_lane(5, 10, flow=1), "bc")
    assert give(link, now_ns=20) == "bca"
    assert link.counts.reordered == 0


def test_a_lost_packet_overtakes_nobody() -> None:
    link = make_link()
    take(link, make_lane(20, 0, lost=[1]), "ab")
    assert give(link, now_ns=20) == "a"
    assert link.counts.reordered == 0


def test_the_bytes_of_all_packets_are_counted() -> None:
    link, lane = make_link(), make_lane(0, 0, lost=[0])
    link.accept(Datagram(bytes(600), PEER), lane, now_ns=0)
    link.accept(Datagram(b"", PEER), lane, now_ns=0)
    assert link.counts.bytes == 600


def test_the_added_delay_error_is_how_late_packets_left() -> None:
    link = make_link()
    take(link, make_lane(MILLISECOND_NS, 3 * MILLISECOND_NS), "ab")
    give(link, now_ns=MILLISECOND_NS)
    give(link, now_ns=5 * MILLISECOND_NS)
    error = link.counts.error
    assert error.largest_ns == 2 * MILLISECOND_NS
    assert (error.quantile_ms(0.5), error.quantile_ms(0.99)) == (0.02, 2.0)


def test_the_delay_histogram_is_of_delays_as_drawn() -> None:
    link, ms = make_link(), MILLISECOND_NS
    take(link, make_lane(400 * ms, 440 * ms, 440 * ms, 500 * ms, lost=[3]), "abcd")
    give(link, now_ns=900 * ms)
    assert link.counts.delay.by_bin() == {"400": 1, "440": 2}


def recorded(direction: int, lane: Lane, names: str) -> Rows:
    """Rows of a link for packets 1 µs apart that all leave in the end."""
    recorder = MemoryRecorder(PACKET_COLUMNS)
    link = Link(direction, 1472, recorder)
    for index, name in enumerate(names):
        link.accept(packet(name), lane, now_ns=1000 * index)
    link.release(now_ns=10**9)
    return recorder.rows()


def test_the_fate_of_every_packet_is_written_down() -> None:
    rows = recorded(DOWNLINK, make_lane(9000, 500, 70, flow=4, lost=[2]), "abc")
    assert rows["number"].tolist() == [2, 1, 0]
    assert rows["direction"].tolist() == [DOWNLINK] * 3
    assert rows["flow"].tolist() == [4] * 3
    assert rows["bytes"].tolist() == [1] * 3
    assert rows["arrived_ns"].tolist() == [2000, 1000, 0]
    assert rows["delay_ns"].tolist() == [70, 500, 9000]
    assert rows["lost"].tolist() == [True, False, False]
    assert rows["overtaken"].tolist() == [False, False, True]


def test_a_packet_meets_the_fate_of_when_it_enters() -> None:
    fates, began_ns = Fates(impairments("paper(0.4, 0.02, 2.0)"), 1, "uplink", 0), 500
    for before in ([], [0, 1, 2], [59] * 3, [60, 90]):  # the last: a clock set back
        link, lane = make_link(), Lane(0, fates, began_ns)
        for slot in (*before, 60, 60):
            link.accept(packet("a"), lane, now_ns=began_ns + slot * SLOT_NS)
        assert (lane.slot, lane.rank) == (60, 1)
    seen = []
    for late_ns in (0, SLOT_NS - 1, SLOT_NS):
        link, now_ns = make_link(), began_ns + 60 * SLOT_NS + late_ns
        link.accept(packet("a"), Lane(0, fates, began_ns), now_ns=now_ns)
        seen.append((link.next_due_ns() or 0) - now_ns)
    assert seen == [fates.at(slot).delay_ns for slot in (60, 60, 61)]
    assert seen[0] != seen[2]


@given(
    st.lists(
        st.tuples(st.integers(0, 3 << SLICE_BITS), st.integers(0, 2 << SLICE_BITS)),
        max_size=60,
    )
)
def test_slices_of_time_give_packets_in_the_order_of_one_heap(
    steps: list[tuple[int, int]],
) -> None:
    queue, now_ns = link_module.Queue(), 0
    heap: list[QueuedPacket] = []
    lane = make_lane()
    for entered, (delay_ns, pause_ns) in enumerate(steps):
        held = (now_ns + delay_ns, entered, packet(""), 0, lane, entered, delay_ns, False)
        queue.push(held)
        heappush(heap, held)
        now_ns += pause_ns
        due = [heappop(heap) for _ in range(sum(held[0] <= now_ns for held in heap))]
        assert queue.take_due(now_ns) == due
        assert queue.size == len(heap)
        assert queue.front[:1] == heap[:1]
    assert queue.take_due(1 << 62) == sorted(heap)
    assert (queue.size, queue.front, queue._later, queue._slices) == (0, [], {}, [])
