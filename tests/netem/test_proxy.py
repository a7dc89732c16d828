"""`netem.proxy`: an endpoint between clients and a server that reads none of their payloads."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skytether.netem import link as link_module
from skytether.netem import proxy as proxy_module
from skytether.netem.fate import Fates
from skytether.netem.link import Link
from skytether.netem.proxy import FLOWS_MAX, IDLE_NS, Flow, Proxy
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.core.endpoint import Datagram
from skytether.shared.core.events import FlowOpened
from skytether.shared.scenario.schema import DirectionConfig, NetworkConfig, Scenario

SERVER = ("192.0.2.9", 47001)
ALICE, BOB, CAROL = (("192.0.2.1", 5000), ("192.0.2.1", 5001), ("192.0.2.2", 5000))

AT_ONCE = DirectionConfig(delay="none", loss=0.0)
IN_20_MS = DirectionConfig(delay="constant", minimum_s=0.02, loss=0.0)


def make_proxy(
    uplink: DirectionConfig = AT_ONCE,
    downlink: DirectionConfig | None = None,
    seed: int = 1,
    flows: int = FLOWS_MAX,
    mtu: int = 1472,
) -> Proxy:
    """A proxy with this network, the same both ways unless said."""
    network = NetworkConfig(uplink=uplink, downlink=downlink or uplink, mtu=mtu)
    return Proxy(Scenario(seed=seed, network=network), server=SERVER, flows=flows)


def hear(proxy: Proxy, payload: bytes, peer: tuple[str, int], socket: int = 0, at: int = 0) -> None:
    """A datagram arrives."""
    proxy.receive(Datagram(payload, peer, socket), now_ns=at)


def pass_on(proxy: Proxy, payload: bytes, client: tuple[str, int], at: int = 0) -> int:
    """A client's packet crosses at once; the socket it leaves by."""
    hear(proxy, payload, client, at=at)
    (sent,) = proxy.outbox()
    assert sent[:2] == (payload, SERVER)
    return sent.socket


def fly(proxy: Proxy, client: tuple[str, int], at: int = 0) -> int:
    """A client's packet crosses and is answered; the socket of its flow."""
    socket = pass_on(proxy, b"?", client, at)
    hear(proxy, b"!", SERVER, socket, at=at)
    assert proxy.outbox() == [Datagram(b"!", client, 0)]
    return socket


def test_every_client_address_is_a_flow_with_a_socket_of_its_own() -> None:
    """Another port is another client; the same address keeps its socket."""
    proxy = make_proxy()
    sockets = [pass_on(proxy, b"?", client) for client in (ALICE, BOB, CAROL, ALICE, CAROL)]
    assert sockets == [1, 2, 3, 1, 3]
    events = proxy.events()
    assert events == tuple(
        FlowOpened(flow=flow, host=host, port=port)
        for flow, (host, port) in enumerate((ALICE, BOB, CAROL))
    )
    assert [str(event) for event in events] == [
        "flow 0 for 192.0.2.1:5000",
        "flow 1 for 192.0.2.1:5001",
        "flow 2 for 192.0.2.2:5000",
    ]
    assert proxy.events() == ()


def test_the_servers_answers_find_their_client() -> None:
    """Answers are assigned by the socket that they arrive at, and leave by the bound one."""
    proxy = make_proxy()
    socket_of = {client: pass_on(proxy, b"?", client) for client in (ALICE, BOB, CAROL)}
    for client in (BOB, ALICE, CAROL):
        hear(proxy, b"!", SERVER, socket_of[client])
        assert proxy.outbox() == [Datagram(b"!", client, 0)]


def test_a_stranger_at_a_flows_socket_is_refused() -> None:
    """Only the server may answer, not another host, nor another port of the server's."""
    proxy = make_proxy()
    socket = pass_on(proxy, b"?", ALICE)
    for stranger in (BOB, (SERVER[0], 1), ("192.0.2.8", SERVER[1])):
        hear(proxy, b"!", stranger, socket)
    assert (proxy.outbox(), proxy.refused, proxy.uplink.counts.packets) == ([], 3, 0)


def test_a_packet_at_a_socket_of_no_flow_is_refused() -> None:
    """Such a packet is refused even if the server sent it."""
    proxy = make_proxy()
    hear(proxy, b"!", SERVER, 1)
    assert (proxy.outbox(), proxy.refused) == ([], 1)


def test_a_client_too_many_is_refused() -> None:
    """While those that are there, and were answered, stay served."""
    proxy = make_proxy(flows=2)
    assert [fly(proxy, client) for client in (ALICE, BOB)] == [1, 2]
    hear(proxy, b"?", CAROL)
    assert (proxy.outbox(), proxy.refused) == ([], 1)
    assert pass_on(proxy, b"?", BOB) == 2


def test_the_flow_that_is_idle_longest_gives_its_place_to_a_new_client() -> None:
    """The flow's socket then carries the new client's answers, and the old one has to wait."""
    proxy = make_proxy(flows=2)
    fly(proxy, ALICE, at=0)
    fly(proxy, BOB, at=1)
    hear(proxy, b"?", CAROL, at=IDLE_NS - 1)
    assert (proxy.outbox(), proxy.refused) == ([], 1)
    assert pass_on(proxy, b"?", CAROL, at=IDLE_NS) == 1
    hear(proxy, b"!", SERVER, 1, at=IDLE_NS)
    assert proxy.outbox() == [Datagram(b"!", CAROL, 0)]
    hear(proxy, b"?", ALICE, at=IDLE_NS)
    assert (proxy.outbox(), proxy.refused) == ([], 2)


def test_flows_give_way_in_the_order_of_their_last_use() -> None:
    """Whether that was the client's packet or the server's."""
    proxy = make_proxy(flows=3)
    for client in (ALICE, BOB, CAROL):
        fly(proxy, client)
    pass_on(proxy, b"?", ALICE)
    hear(proxy, b"!", SERVER, 2)
    proxy.outbox()
    newcomers = [("192.0.2.3", port) for port in range(3)]
    assert [pass_on(proxy, b"?", client, at=IDLE_NS) for client in newcomers] == [3, 1, 2]


def test_a_refusal_looks_at_one_flow_however_many_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A flood from strangers takes as long with 16 384 flows as with one."""
    proxy = make_proxy(flows=300)
    for port in range(300):
        fly(proxy, ("192.0.2.1", port))
    looked = []
    monkeypatch.setattr(Flow, "used_ns", property(lambda flow: looked.append(flow.socket) or 0))
    for port in range(100):
        hear(proxy, b"?", ("192.0.2.3", port))
    assert proxy.refused == 100
    assert looked == [1] * 100


def test_strangers_give_way_at_once_the_one_that_is_silent_longest_first() -> None:
    """Nobody has answered them; a flow that was answered keeps its place."""
    proxy = make_proxy(flows=3)
    assert fly(proxy, ALICE) == 1
    strangers = [("192.0.2.3", port) for port in range(4)]
    assert [pass_on(proxy, b"x", stranger) for stranger in strangers[:2]] == [2, 3]
    assert pass_on(proxy, b"x", strangers[0]) == 2
    assert [pass_on(proxy, b"x", stranger) for stranger in strangers[2:]] == [3, 2]
    assert pass_on(proxy, b"?", ALICE) == 1
    assert (proxy.refused, proxy.figures()["flows"]) == (0, 3)


@pytest.mark.parametrize(("begins", "expected"), [("client", 1), ("stranger", 2)])
def test_of_a_stranger_and_a_flow_unused_for_long_the_older_gives_way(
    begins: str, expected: int
) -> None:
    """An answer is worth IDLE_NS, and no more."""
    proxy = make_proxy(flows=2)
    fly(proxy, ALICE)
    pass_on(proxy, b"x", BOB, at=1)
    if begins == "stranger":
        pass_on(proxy, b"?", ALICE, at=2)
    assert pass_on(proxy, b"?", CAROL, at=IDLE_NS + 2) == expected


def served_in_a_flood(proxy: Proxy) -> tuple[int, int]:
    """Number of vehicles that are served beside strangers, each at a port of its own.

    Each vehicle sends one packet, whose answer comes after packets of thirty strangers.

    Returns:
        Number of those of 8 vehicles that flew before the flood, and of 8 others.
    """
    old, new = ([(host, port) for port in range(8)] for host in ("192.0.2.1", "192.0.2.2"))
    for client in old:
        fly(proxy, client)
    strangers, served = (("192.0.2.66", port) for port in range(1000)), [0, 0]
    for _ in range(70):
        hear(proxy, b"x", next(strangers))
    proxy.outbox()
    for client in (*old, *new):
        hear(proxy, b"?", client)
        sockets = [sent.socket for sent in proxy.outbox()]
        for _ in range(30):
            hear(proxy, b"x", next(strangers))
        proxy.outbox()
        for socket in sockets:
            hear(proxy, b"!", SERVER, socket)
        served[client in new] += Datagram(b"!", client, 0) in proxy.outbox()
    return served[0], served[1]


def test_a_flood_of_strangers_shuts_nobody_out() -> None:
    """From 550 ports, with 64 places."""
    assert served_in_a_flood(make_proxy(flows=64)) == (8, 8)


def test_if_no_flow_gave_way_a_flood_would_shut_newcomers_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ablation: strangers' flows are kept like all others, as in an early version."""
    proxy = make_proxy(flows=64)
    monkeypatch.setattr(proxy, "_oldest", lambda _: None)
    assert served_in_a_flood(proxy) == (8, 0)


def test_if_no_flow_were_kept_a_flood_would_take_the_places_of_those_who_fly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their answers, which are on their way, would go to strangers."""
    proxy = make_proxy(flows=64)
    for client in [("192.0.2.1", port) for port in range(8)]:
        fly(proxy, client)
    monkeypatch.setattr(proxy_module, "IDLE_NS", 0)
    for port in range(70):
        hear(proxy, b"x", ("192.0.2.66", port), at=1)
    proxy.outbox()
    for socket in range(1, 9):
        hear(proxy, b"!", SERVER, socket)
    assert {sent.peer[0] for sent in proxy.outbox()} == {"192.0.2.66"}


def test_the_servers_packets_keep_a_flow_in_use() -> None:
    """A client that only listens is not idle."""
    proxy = make_proxy(flows=1)
    socket = fly(proxy, ALICE)
    hear(proxy, b"!", SERVER, socket, at=IDLE_NS - 1)
    proxy.outbox()
    hear(proxy, b"?", BOB, at=IDLE_NS)
    assert (proxy.outbox(), proxy.refused) == ([], 1)


def test_a_packet_under_way_still_reaches_a_client_whose_place_was_given_away() -> None:
    """The client that took the place does not get the packet."""
    slow = DirectionConfig(delay="constant", minimum_s=61.0, loss=0.0)
    proxy = make_proxy(uplink=slow, downlink=AT_ONCE, flows=1)
    socket = pass_on(proxy, b"?", ALICE)
    hear(proxy, b"!", SERVER, socket)
    assert pass_on(proxy, b"?", BOB, at=IDLE_NS) == socket
    proxy.wake(now_ns=61 * 1000 * MILLISECOND_NS)
    assert proxy.outbox() == [Datagram(b"!", ALICE, 0)]


@pytest.mark.parametrize("length", [0, 1, 600, 65_507])
def test_payloads_pass_unread(length: int) -> None:
    """Any bytes, none, and the longest that UDP takes, both ways."""
    payload = random.Random(length).randbytes(length)
    proxy = make_proxy(mtu=65_507)
    socket = pass_on(proxy, payload, ALICE)
    hear(proxy, payload, SERVER, socket)
    assert proxy.outbox() == [Datagram(payload, ALICE, 0)]


def test_a_datagram_longer_than_the_mtu_passes_neither_way() -> None:
    """The path does not fragment datagrams; the flow goes on."""
    proxy = make_proxy(mtu=1300)
    socket = pass_on(proxy, bytes(1300), ALICE)
    hear(proxy, bytes(1301), ALICE)
    hear(proxy, bytes(1301), SERVER, socket)
    assert proxy.outbox() == []
    assert (proxy.downlink.counts.oversized, proxy.uplink.counts.oversized) == (1, 1)
    assert pass_on(proxy, b"?", ALICE) == socket


def test_without_delay_packets_are_forwarded_as_they_arrive() -> None:
    """Nothing is left to be woken for."""
    proxy = make_proxy()
    pass_on(proxy, b"?", ALICE, at=123)
    assert proxy.next_wake_ns() is None
    assert proxy.downlink.counts.error.largest_ns == 0


def test_a_duplicate_is_a_packet_of_its_own() -> None:
    """Copies are not told apart by netem: each has its own number, and its own fate."""
    proxy = make_proxy()
    assert [pass_on(proxy, b"?", ALICE) for _ in range(3)] == [1, 1, 1]
    assert proxy.downlink.counts.packets == 3


def test_it_wants_to_be_woken_for_the_next_packet_of_either_direction() -> None:
    """Once woken it forwards what is due, and no more."""
    slower = replace(IN_20_MS, minimum_s=0.03)
    proxy, ms = make_proxy(uplink=slower, downlink=IN_20_MS), MILLISECOND_NS
    hear(proxy, b"?", ALICE, at=0)
    hear(proxy, b"!", SERVER, 1, at=0)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([], 20 * ms)
    proxy.wake(now_ns=20 * ms)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([Datagram(b"?", SERVER, 1)], 30 * ms)
    proxy.wake(now_ns=30 * ms)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([Datagram(b"!", ALICE, 0)], None)


def test_being_woken_early_does_no_harm() -> None:
    """Drivers may be."""
    proxy = make_proxy(IN_20_MS)
    hear(proxy, b"?", ALICE, at=0)
    proxy.wake(now_ns=20 * MILLISECOND_NS - 1)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([], 20 * MILLISECOND_NS)


def test_each_direction_and_flow_meets_its_own_fates() -> None:
    """Those that netem.fate names, by the rank of the packets in their slot."""
    half = DirectionConfig(delay="none", loss=0.5)
    proxy = make_proxy(half, seed=7)
    for flow, client in enumerate((ALICE, BOB)):
        for number in range(40):
            hear(proxy, bytes([number]), client)
            hear(proxy, bytes([number]), SERVER, flow + 1)
        sent = proxy.outbox()
        for name, peer in (("downlink", SERVER), ("uplink", client)):
            fates = Fates(half, 7, name, flow)
            drawn = [fates.at(0, rank).lost for rank in range(40)]
            passed = [datagram.payload[0] for datagram in sent if datagram.peer == peer]
            assert passed == [number for number in range(40) if not drawn[number]]


def test_what_is_sent_is_handed_out_once() -> None:
    """The driver empties the outbox."""
    proxy = make_proxy()
    hear(proxy, b"?", ALICE)
    assert [len(proxy.outbox()), len(proxy.outbox())] == [1, 0]


def test_the_figures_name_every_statistic() -> None:
    """Flows, refusals, and by direction: forwarded, lost, reordered, queue, delay and its error."""
    proxy, ms = make_proxy(uplink=DirectionConfig(loss=1.0), downlink=IN_20_MS), MILLISECOND_NS
    hear(proxy, b"?", ALICE, at=0)
    hear(proxy, b"?", ALICE, at=2 * ms)
    hear(proxy, b"!", SERVER, 1, at=3 * ms)
    hear(proxy, b"!", BOB, 1, at=3 * ms)
    proxy.wake(now_ns=21 * ms)
    counts = "forwarded", "lost", "reordered", "oversized", "overflowed"
    nothing = dict.fromkeys((*counts, "dropped", "duplicated", "corrupted"), 0)
    nothing |= dict.fromkeys(("queueing_ms_p50", "queueing_ms_p99"), 0.0)
    nothing |= dict.fromkeys(("delay_ms_p50", "delay_ms_p99"), 0.0)
    errors = ("error_ms_p50", "error_ms_p99", "error_ms_max")

    def within(count: int) -> dict[str, int]:
        return dict.fromkeys([f"{edge}" for edge in (*link_module.DELAY_EDGES_MS, "inf")], count)

    assert proxy.figures() == {
        "flows": 1,
        "refused": 1,
        "uplink": {
            **nothing,
            "packets": 1,
            "bytes": 1,
            "lost": 1,
            "queue": 0,
            "queue_max": 0,
            "delays_ms": {},
            "delays_within_ms": within(0),
            **dict.fromkeys(errors, 0.0),
        },
        "downlink": {
            **nothing,
            "packets": 2,
            "bytes": 2,
            "forwarded": 1,
            "queue": 1,
            "queue_max": 2,
            "delays_ms": {"20": 1},
            **dict.fromkeys(("delay_ms_p50", "delay_ms_p99"), 20.0),
            "delays_within_ms": {**within(1), "20": 0},
            **dict.fromkeys(errors, 1.0),
        },
    }


ARRIVALS = st.lists(
    st.tuples(
        st.sampled_from([(ALICE, 0), (BOB, 0), (CAROL, 0), (SERVER, 1), (SERVER, 2), (BOB, 2)]),
        st.integers(0, 200),
    ),
    max_size=80,
)


@given(ARRIVALS, st.integers(0, 2**32 - 1))
def test_no_packet_appears_or_vanishes(
    arrivals: list[tuple[tuple[tuple[str, int], int], int]], seed: int
) -> None:
    """At every moment each one is forwarded, lost, overflowed, refused or still under way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(link_module, "QUEUE_MAX", 8)
        proxy, now_ns, sent = make_proxy(DirectionConfig(loss=0.3), seed=seed, flows=2), 0, 0
        links = (proxy.uplink, proxy.downlink)
        for number, ((peer, socket), gap_ms) in enumerate(arrivals, start=1):
            now_ns += gap_ms * MILLISECOND_NS
            proxy.wake(now_ns=now_ns)
            hear(proxy, b"", peer, socket, at=now_ns)
            sent += len(proxy.outbox())
            assert all(is_balanced(link) for link in links)
            assert sum(link.counts.packets for link in links) + proxy.refused == number
            assert sum(link.counts.forwarded for link in links) == sent


def is_balanced(link: Link) -> bool:
    """Whether what entered is accounted for, and the queue within its bound."""
    counts = link.counts
    gone = counts.forwarded + counts.lost + counts.oversized + counts.overflowed
    return counts.packets == gone + link.depth() and link.depth() <= 8
