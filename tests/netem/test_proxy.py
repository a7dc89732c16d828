"""`netem.proxy`: an endpoint between clients and a server that does not read payloads."""

import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.netem import link as link_module
from skytether.netem import places as places_module
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.link import Link
from skytether.netem.places import EARNED_NS, EXCHANGES, HOST_FLOWS, IDLE_NS, Flow
from skytether.netem.proxy import FLOWS_MAX, LAPS_MAX, Proxy
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, host_of
from skytether.shared.events.flight import FlowOpened, Returned, TooLong, Unreachable
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario

SERVER = ("192.0.2.9", 47001)
ALICE, BOB, CAROL = (("192.0.2.1", 5000), ("192.0.2.1", 5001), ("192.0.2.2", 5000))

AT_ONCE = ""
IN_20_MS = "constant(0.02)"


def make_proxy(
    uplink: str = AT_ONCE,
    downlink: str | None = None,
    seed: int = 1,
    flows: int = FLOWS_MAX,
    mtu: int = 1472,
) -> Proxy:
    """Proxy with this network, the same in both directions unless given."""
    network = NetworkConfig(
        uplink=uplink, downlink=uplink if downlink is None else downlink, mtu=mtu
    )
    return Proxy(Scenario(seed=seed, network=network), server=SERVER, flows=flows)


def hear(proxy: Proxy, payload: bytes, peer: tuple[str, int], socket: int = 0, at: int = 0) -> None:
    proxy.receive(Datagram(payload, peer, socket), now_ns=at)


def pass_on(proxy: Proxy, payload: bytes, client: tuple[str, int], at: int = 0) -> int:
    """Let a client's packet pass at once; returns the socket towards the server."""
    hear(proxy, payload, client, at=at)
    (sent,) = proxy.outbox()
    assert sent[:2] == (payload, SERVER)
    return sent.socket


def ask(proxy: Proxy, client: tuple[str, int], at: int = 0) -> int:
    """Let a client's packet pass and be answered; returns the socket of its flow."""
    socket = pass_on(proxy, b"?", client, at)
    hear(proxy, b"!", SERVER, socket, at=at)
    assert proxy.outbox() == [Datagram(b"!", client, 0)]
    return socket


def fly(proxy: Proxy, client: tuple[str, int], at: int = 0) -> int:
    """Exchange packets until a client has earned its flow; returns the flow's socket."""
    (socket,) = {ask(proxy, client, at) for _ in range(EXCHANGES)}
    return socket


def test_every_client_address_is_a_flow_with_a_socket_of_its_own() -> None:
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


def test_the_impairments_are_parsed_once_not_for_each_flow(monkeypatch: pytest.MonkeyPatch) -> None:
    proxy, changed = make_proxy(), make_proxy("loss(1)")
    for client in (ALICE, BOB):
        pass_on(proxy, b"?", client)
    parsed: list[str] = []
    impairments_of = Proxy.impairments
    monkeypatch.setattr(
        Proxy, "impairments", lambda self, name: parsed.append(name) or impairments_of(self, name)
    )
    proxy.change(changed._scenario, frozenset({"network.downlink"}), now_ns=0)
    for client in (ALICE, BOB, CAROL):
        hear(proxy, b"?", client)
    assert parsed == ["uplink", "downlink"]
    assert (proxy.outbox(), proxy.downlink.counts.lost) == ([], 3)


def test_the_servers_answers_find_their_client() -> None:
    proxy = make_proxy()
    socket_of = {client: pass_on(proxy, b"?", client) for client in (ALICE, BOB, CAROL)}
    for client in (BOB, ALICE, CAROL):
        hear(proxy, b"!", SERVER, socket_of[client])
        assert proxy.outbox() == [Datagram(b"!", client, 0)]


def test_a_stranger_at_a_flows_socket_is_refused() -> None:
    proxy = make_proxy()
    socket = pass_on(proxy, b"?", ALICE)
    for stranger in (BOB, (SERVER[0], 1), ("192.0.2.8", SERVER[1])):
        hear(proxy, b"!", stranger, socket)
    assert (proxy.outbox(), proxy.refused, proxy.uplink.counts.packets) == ([], 3, 0)


def test_a_packet_at_a_socket_of_no_flow_is_refused() -> None:
    proxy = make_proxy()
    hear(proxy, b"!", SERVER, 1)
    assert (proxy.outbox(), proxy.refused) == ([], 1)


def test_a_client_too_many_is_refused() -> None:
    proxy = make_proxy(flows=2)
    assert [fly(proxy, client) for client in (ALICE, BOB)] == [1, 2]
    hear(proxy, b"?", CAROL)
    assert (proxy.outbox(), proxy.refused) == ([], 1)
    assert pass_on(proxy, b"?", BOB) == 2


def test_a_place_is_earned_for_a_while_and_then_goes_to_a_new_client() -> None:
    """The old client returns where no other client has earned a flow."""
    proxy = make_proxy(flows=2)
    fly(proxy, ALICE, at=0)
    fly(proxy, BOB, at=1)
    hear(proxy, b"?", CAROL, at=EARNED_NS - 1)
    assert (proxy.outbox(), proxy.refused) == ([], 1)
    assert fly(proxy, CAROL, at=EARNED_NS) == 1
    assert pass_on(proxy, b"?", ALICE, at=EARNED_NS + 1) == 2
    hear(proxy, b"?", BOB, at=EARNED_NS + 1)
    assert proxy.outbox() == [Datagram(b"?", SERVER, 2)]


def test_a_vehicle_that_goes_on_flying_keeps_its_place() -> None:
    proxy = make_proxy(flows=1)
    fly(proxy, ALICE)
    for second in (*range(1, 60), *range(62, 120)):
        ask(proxy, ALICE, at=second * SECOND_NS)
        hear(proxy, b"x", BOB, at=second * SECOND_NS)
        assert proxy.outbox() == []


@pytest.mark.parametrize(("asks", "answers"), [(1, 1), (100, 1), (1, 100), (0, 100), (100, 0)])
def test_only_a_conversation_earns_a_place(asks: int, answers: int) -> None:
    proxy = make_proxy(flows=1)
    socket = pass_on(proxy, b"?", ALICE)
    for _ in range(asks):
        hear(proxy, b"?", ALICE)
    for _ in range(answers):
        hear(proxy, b"!", SERVER, socket)
    proxy.outbox()
    assert pass_on(proxy, b"?", BOB) == socket


def test_flows_give_way_in_the_order_of_their_last_use() -> None:
    proxy = make_proxy(flows=3)
    for client in (ALICE, BOB, CAROL):
        ask(proxy, client)
    pass_on(proxy, b"?", ALICE)
    hear(proxy, b"!", SERVER, 2)
    proxy.outbox()
    newcomers = [("192.0.2.3", port) for port in range(3)]
    assert [pass_on(proxy, b"?", client) for client in newcomers] == [3, 1, 2]


def test_a_refusal_looks_at_one_flow_however_many_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Refusing a stranger takes as long with 16 384 flows as with one."""
    proxy = make_proxy(flows=HOST_FLOWS)
    for port in range(HOST_FLOWS):
        fly(proxy, ("192.0.2.1", port))
    looked = []
    earned_ns = property(lambda flow: looked.append(flow.socket) or 0)
    monkeypatch.setattr(Flow, "earned_ns", earned_ns)
    for port in range(100):
        hear(proxy, b"?", ("192.0.2.3", port))
    assert proxy.refused == 100
    assert looked == [1] * 100


def test_strangers_give_way_at_once_the_one_that_is_silent_longest_first() -> None:
    proxy = make_proxy(flows=3)
    assert fly(proxy, ALICE) == 1
    strangers = [("192.0.2.3", port) for port in range(4)]
    assert [pass_on(proxy, b"x", stranger) for stranger in strangers[:2]] == [2, 3]
    assert pass_on(proxy, b"x", strangers[0]) == 2
    assert [pass_on(proxy, b"x", stranger) for stranger in strangers[2:]] == [3, 2]
    assert pass_on(proxy, b"?", ALICE) == 1
    assert (proxy.refused, proxy.figures()["flows"]) == (0, 3)


# -- attacks on the capacity of flows --------------------------------------------------------

ATTACKER = "192.0.2.66"


class Siege:
    """Attack on netem by repeating one packet from many ports, to occupy all its flows.

    Args:
        proxy: the proxy; the server answers each packet at once, in steps of 0.1 s.
        hosts: hosts of the attacker.
        ports: number of ports on each host.
        rate_hz: packets per second, all ports together.
        stays: number of steps in a row with packets from the same ports.
    """

    def __init__(
        self, proxy: Proxy, hosts: list[str], ports: int, rate_hz: int, *, stays: int = 1
    ) -> None:
        self.proxy, self.stays = proxy, stays
        self.addresses = [(host, 1000 + port) for port in range(ports) for host in hosts]
        self.each_step = rate_hz // 10
        self.now_ns = 0
        self._steps = 0

    def step(self, *clients: tuple[str, int]) -> set[tuple[str, int]]:
        """Advance by 0.1 s: attacker and clients send, and the server answers.

        Returns the clients that get an answer.
        """
        self.now_ns += 100 * MILLISECOND_NS
        for client in clients:
            hear(self.proxy, b"?", client, at=self.now_ns)
        first = self._steps // self.stays * self.each_step
        self._steps += 1
        for number in range(first, first + self.each_step):
            at = self.addresses[number % len(self.addresses)]
            hear(self.proxy, b"x", at, at=self.now_ns)
        for _, _, socket in self.proxy.outbox():
            hear(self.proxy, b"!", SERVER, socket, at=self.now_ns)
        return {sent.peer for sent in self.proxy.outbox()} & set(clients)

    def run(self, seconds: int, *clients: tuple[str, int]) -> float:
        """Advance by seconds; returns the share of the clients' packets that were answered."""
        steps = 10 * seconds
        return sum(len(self.step(*clients)) for _ in range(steps)) / (steps * len(clients) or 1)


def spread(count: int) -> list[str]:
    return [f"198.51.{number // 256}.{number % 256}" for number in range(count)]


SIEGES = [
    ([ATTACKER], 128, 300),
    (spread(5_000), 1, 60),
    ([ALICE[0]], 128, 60),
]
"""Attackers that must not evict vehicles: hosts, ports of each, packets per second."""


@pytest.mark.parametrize(("hosts", "ports", "rate_hz"), SIEGES)
def test_who_repeats_a_packet_from_many_ports_shuts_nobody_out(
    hosts: list[str], ports: int, rate_hz: int
) -> None:
    """Neither a vehicle in flight, nor a new one, nor one whose port changes."""
    siege = Siege(make_proxy(flows=128), hosts, ports, rate_hz)
    siege.run(3, ALICE)
    siege.run(15)  # all flows are taken
    siege.run(4, ALICE)
    assert siege.run(3, ALICE) == 1.0
    siege.run(4, ALICE, BOB, CAROL)
    assert siege.run(3, ALICE, BOB, CAROL) == 1.0
    elsewhere = (ALICE[0], 7)
    siege.run(4, elsewhere, BOB, CAROL)
    assert siege.run(3, elsewhere, BOB, CAROL) == 1.0


@pytest.mark.parametrize("hosts", [spread(8), [ALICE[0]]])
@pytest.mark.parametrize(("rate_hz", "expected"), [(90, 1.0), (150, 0.0)])
def test_who_exchanges_packets_in_all_places_shuts_newcomers_out(
    hosts: list[str], rate_hz: int, expected: float
) -> None:
    """With at least eight packets in ten seconds per flow; vehicles in flight are not affected."""
    assert 90 < 128 * EXCHANGES * SECOND_NS / EARNED_NS < 150
    siege = Siege(make_proxy(flows=128), hosts, 128 // len(hosts), 0, stays=EXCHANGES)
    siege.run(2, ALICE)
    siege.each_step = rate_hz // 10
    siege.run(20, ALICE)
    newcomer = (ALICE[0], 7)
    siege.run(4, ALICE, newcomer)
    found = [siege.step(ALICE, newcomer) for _ in range(30)]
    assert all(ALICE in answered for answered in found)
    assert sum(newcomer in answered for answered in found) / 30 == expected


def test_who_opens_flows_fast_enough_shuts_newcomers_out() -> None:
    """As many as netem's flows before an answer arrives; vehicles in flight are not affected."""
    siege = Siege(make_proxy(flows=128), spread(8), 2_000, 0)
    siege.run(2, ALICE)
    siege.each_step = 140
    siege.step(ALICE)
    found = [siege.step(ALICE, (ALICE[0], 7)) for _ in range(20)]
    assert found == [{ALICE}] * 20


def old_rule(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(places_module, "EXCHANGES", 1)
    patch.setattr(places_module, "EARNED_NS", 60 * SECOND_NS)
    patch.setattr(places_module, "HOST_FLOWS", FLOWS_MAX)


def no_bound_for_a_host(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(places_module, "HOST_FLOWS", FLOWS_MAX)


@pytest.mark.parametrize(("ablation", "rate_hz"), [(old_rule, 10), (no_bound_for_a_host, 300)])
def test_if_places_were_earned_otherwise_newcomers_would_be_shut_out(
    monkeypatch: pytest.MonkeyPatch, ablation: Callable[[pytest.MonkeyPatch], None], rate_hz: int
) -> None:
    ablation(monkeypatch)
    siege = Siege(make_proxy(flows=128), [ATTACKER], 128, rate_hz)
    siege.run(13)
    assert siege.run(5, ALICE) == 0.0


def test_what_one_host_holds_against_others_is_bounded() -> None:
    """Also if it exchanges packets in all flows; others may have all flows left."""
    siege = Siege(make_proxy(flows=128), [ATTACKER], 128, 300)
    siege.run(5)
    others = [("192.0.2.1", port) for port in range(128 - HOST_FLOWS)]
    for count in range(8, len(others) + 1, 8):
        siege.run(1, *others[:count])
    siege.run(2, *others)
    assert siege.run(2, *others) > 0.95


def test_a_crowd_gives_way_before_a_single_client_that_came_earlier() -> None:
    proxy = make_proxy(flows=HOST_FLOWS + 2)
    assert pass_on(proxy, b"alone", CAROL) == 1
    for port in range(HOST_FLOWS + 1):
        pass_on(proxy, b"%d" % port, (ATTACKER, port))
    assert pass_on(proxy, b"new", ALICE) == 2


def test_a_fleet_of_one_host_keeps_its_places_from_strangers() -> None:
    fleet = [("192.0.2.1", port) for port in range(HOST_FLOWS)]
    siege = Siege(make_proxy(flows=HOST_FLOWS), spread(5), 5, rate_hz=0)
    siege.run(2, *fleet)
    siege.each_step = 10
    assert siege.run(3, *fleet) == 1.0


def test_a_stale_stranger_gives_way_before_a_crowd_that_begins_to_fly() -> None:
    """A fleet behind one address takes the flows of clients that have gone."""
    proxy = make_proxy(flows=100)
    for number in range(30):
        ask(proxy, (f"198.51.100.{number}", 1))
    fleet = [("192.0.2.1", port) for port in range(100)]
    sockets = [pass_on(proxy, b"?", client, at=IDLE_NS) for client in fleet]
    assert sorted(sockets) == list(range(1, 101))


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("192.0.2.1", "192.0.2.1", True),
        ("192.0.2.1", "192.0.2.2", False),
        ("2001:db8::1", "2001:db8::ffff:1", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("server", "client", False),
    ],
)
def test_a_network_of_ipv6_counts_as_one_host(one: str, other: str, *, same: bool) -> None:
    """Whoever has one address of the network has all of them."""
    assert (host_of((one, 1)) == host_of((other, 2))) is same


# -- forwarding loops ------------------------------------------------------------------------


def circulate(*netems: Proxy, packets: int, limit: int = 5000) -> int:
    """Forwarding loop of netems, each to the next; returns the number of packets forwarded.

    Args:
        netems: the netems; sockets of netem n have the host "netem n".
        packets: packets that a client sends to the first netem, one after the other.
        limit: number of forwarded packets at which a loop counts as endless.
    """
    forwarded = 0
    for number in range(packets):
        hear(netems[0], b"%d" % number, ALICE)
        while any(out := [netem.outbox() for netem in netems]) and forwarded < limit:
            for n, sent in enumerate(out):
                for payload, _, socket in sent:
                    forwarded += 1
                    hear(netems[(n + 1) % len(netems)], payload, (f"netem {n}", socket))
    return forwarded


@pytest.mark.parametrize("count", [1, 3])
def test_a_packet_that_comes_back_ends_after_a_number_of_laps(count: int) -> None:
    """Through a netem that is its own server, or through several in a circle; logged once."""
    netems = [make_proxy() for _ in range(count)]
    assert circulate(*netems, packets=1) == count * (LAPS_MAX + 1)
    assert circulate(*netems, packets=100) <= 101 * count * (LAPS_MAX + 1)
    events = [event for netem in netems for event in netem.events() if isinstance(event, Returned)]
    assert events == [Returned(times=LAPS_MAX + 1)]


def test_if_laps_were_not_counted_a_packet_would_circulate_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("skytether.netem.proxy.LAPS_MAX", 2**62)
    assert circulate(make_proxy(), packets=1) == 5000


def test_clients_that_send_the_same_are_served_once_the_server_answers() -> None:
    proxy = make_proxy()
    clients = [("192.0.2.1", port) for port in range(LAPS_MAX + 2)]
    for client in clients[:-1]:
        pass_on(proxy, b"hello", client)
    hear(proxy, b"hello", clients[-1])
    assert (proxy.outbox(), proxy.refused) == ([], 1)
    pass_on(proxy, b"other", clients[-1])
    ask(proxy, clients[0])
    for port in range(100):
        pass_on(proxy, b"hello", ("192.0.2.2", port))


# -- other properties ------------------------------------------------------------------------


def test_a_packet_under_way_still_reaches_a_client_whose_place_was_given_away() -> None:
    slow = "constant(61.0)"
    proxy = make_proxy(uplink=slow, downlink=AT_ONCE, flows=1)
    socket = pass_on(proxy, b"?", ALICE)
    hear(proxy, b"!", SERVER, socket)
    assert pass_on(proxy, b"?", BOB) == socket
    proxy.wake(now_ns=61 * 1000 * MILLISECOND_NS)
    assert proxy.outbox() == [Datagram(b"!", ALICE, 0)]


@pytest.mark.parametrize("length", [0, 65_507])
def test_payloads_pass_unread(length: int) -> None:
    payload = random.Random(length).randbytes(length)
    proxy = make_proxy(mtu=65_507)
    socket = pass_on(proxy, payload, ALICE)
    hear(proxy, payload, SERVER, socket)
    assert proxy.outbox() == [Datagram(payload, ALICE, 0)]


def test_a_datagram_longer_than_the_mtu_passes_neither_way() -> None:
    proxy = make_proxy(mtu=1300)
    socket = pass_on(proxy, bytes(1300), ALICE)
    hear(proxy, bytes(1301), ALICE)
    hear(proxy, bytes(1301), SERVER, socket)
    assert proxy.outbox() == []
    assert (proxy.downlink.counts.oversized, proxy.uplink.counts.oversized) == (1, 1)
    events = [event for event in proxy.events() if isinstance(event, TooLong)]
    assert events == [TooLong(size=1301, most=1300)]
    assert pass_on(proxy, b"?", ALICE) == socket


def test_a_server_that_is_gone_is_told_each_time_it_goes() -> None:
    proxy = make_proxy()
    socket = ask(proxy, ALICE)
    for _ in range(2):
        for _ in range(3):
            pass_on(proxy, b"?", ALICE)
            proxy.undelivered(socket, "Connection refused")
        ask(proxy, ALICE)
    proxy.undelivered(0, "Connection refused")
    events = [event for event in proxy.events() if isinstance(event, Unreachable)]
    assert events == [Unreachable(host=SERVER[0], port=SERVER[1], reason="Connection refused")] * 2
    links = proxy.downlink.counts, proxy.uplink.counts
    assert [(counts.forwarded, counts.undelivered) for counts in links] == [(3, 6), (2, 1)]


def test_without_delay_packets_are_forwarded_as_they_arrive() -> None:
    proxy = make_proxy()
    pass_on(proxy, b"?", ALICE, at=123)
    assert proxy.next_wake_ns() is None
    assert proxy.downlink.counts.error.largest_ns == 0


def test_a_duplicate_is_a_packet_of_its_own() -> None:
    proxy = make_proxy()
    assert [pass_on(proxy, b"?", ALICE) for _ in range(3)] == [1, 1, 1]
    assert proxy.downlink.counts.packets == 3


def test_it_wants_to_be_woken_for_the_next_packet_of_either_direction() -> None:
    slower = "constant(0.03)"
    proxy, ms = make_proxy(uplink=slower, downlink=IN_20_MS), MILLISECOND_NS
    hear(proxy, b"?", ALICE, at=0)
    hear(proxy, b"!", SERVER, 1, at=0)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([], 20 * ms)
    proxy.wake(now_ns=20 * ms)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([Datagram(b"?", SERVER, 1)], 30 * ms)
    proxy.wake(now_ns=30 * ms)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([Datagram(b"!", ALICE, 0)], None)


def test_being_woken_early_does_no_harm() -> None:
    proxy = make_proxy(IN_20_MS)
    hear(proxy, b"?", ALICE, at=0)
    proxy.wake(now_ns=20 * MILLISECOND_NS - 1)
    assert (proxy.outbox(), proxy.next_wake_ns()) == ([], 20 * MILLISECOND_NS)


def test_each_direction_and_flow_meets_its_own_fates() -> None:
    half = "loss(0.5)"
    proxy = make_proxy(half, seed=7)
    for flow, client in enumerate((ALICE, BOB)):
        for number in range(40):
            hear(proxy, bytes([number]), client)
            hear(proxy, bytes([number]), SERVER, flow + 1)
        sent = proxy.outbox()
        for name, peer in (("downlink", SERVER), ("uplink", client)):
            fates = Fates(impairments(half), 7, name, flow)
            drawn = [fates.at(0, rank).lost for rank in range(40)]
            passed = [datagram.payload[0] for datagram in sent if datagram.peer == peer]
            assert passed == [number for number in range(40) if not drawn[number]]


def test_the_figures_name_every_statistic() -> None:
    proxy, ms = make_proxy(uplink="loss(1)", downlink=IN_20_MS), MILLISECOND_NS
    hear(proxy, b"?", ALICE, at=0)
    hear(proxy, b"?", ALICE, at=2 * ms)
    hear(proxy, b"!", SERVER, 1, at=3 * ms)
    hear(proxy, b"!", BOB, 1, at=3 * ms)
    proxy.wake(now_ns=21 * ms)
    figures = proxy.figures()
    assert (figures["flows"], figures["refused"]) == (1, 1)
    up, down = figures["uplink"], figures["downlink"]
    assert set(up) == set(down)
    assert (up["packets"], up["bytes"], up["lost"], up["queue_max"]) == (1, 1, 1, 0)
    assert (down["packets"], down["bytes"], down["lost"], down["forwarded"]) == (2, 2, 0, 1)
    assert (down["queue"], down["queue_max"], down["overflowed"]) == (1, 2, 0)
    assert (down["delays_ms"], down["delay_ms_p50"], down["error_ms_max"]) == ({"20": 1}, 20.0, 1.0)
    assert (down["delays_within_ms"]["20"], down["delays_within_ms"]["40"]) == (0, 1)


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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(link_module, "QUEUE_MAX", 8)
        proxy, now_ns, sent = (
            make_proxy("paper(0.4, 0.02, 2.0) & loss(0.3)", seed=seed, flows=2),
            0,
            0,
        )
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
    """Whether all packets that entered are accounted for, and the queue is within its bound."""
    counts = link.counts
    gone = counts.forwarded + counts.lost + counts.oversized + counts.overflowed
    return counts.packets == gone + link.depth() and link.depth() <= 8
