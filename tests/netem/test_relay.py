"""`netem.relay`: byte streams that are delayed, slowed and cut, and lose nothing."""

from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.netem.relay import RETRY_NS, Relay
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.endpoints.line import CLIENT, PIECE_BYTES, SERVER
from skytether.shared.endpoints.other_directions import RELAY
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario

SERVED = ("192.0.2.9", 80)
NETWORKS = (
    "",
    "uniform(0, 0.3)",
    "loss(0.5) & constant(0.05)",
    "gilbert_elliott(0.5, 0.3) & duplicate(0.5) & corrupt(0.5)",
    "rate(20000, queue=3000, drop=codel) & loss(0.2)",
    "rate(50000, queue=3000, serve=fair)",
    "outage(0.2, 1.5)",
)


def make_relay(network: str, seed: int = 1) -> Relay:
    config = NetworkConfig(uplink=network, downlink=network)
    return Relay(Scenario(seed=seed, network=config), server=SERVED)


def hear(relay: Relay, payload: bytes, number: int = 1, side: str = CLIENT, at: int = 0) -> None:
    relay.receive(Datagram(payload, (side, number), 1), now_ns=at)


def run(relay: Relay, until_ns: int = 10**15) -> list[tuple[int, Datagram]]:
    """Pieces that leave, each with its time [ns]."""
    left = [(0, piece) for piece in relay.outbox()]
    while (due_ns := relay.next_wake_ns()) is not None and due_ns <= until_ns:
        relay.wake(now_ns=due_ns)
        left += [(due_ns, piece) for piece in relay.outbox()]
    return left


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(NETWORKS),
    st.lists(
        st.tuples(
            st.integers(1, 3),
            st.sampled_from((CLIENT, SERVER)),
            st.binary(min_size=1, max_size=PIECE_BYTES),
            st.integers(0, SECOND_NS // 10),
        ),
        max_size=40,
    ),
    st.integers(0, 1000),
)
def test_every_stream_arrives_whole_and_in_order(
    network: str, pieces: list[tuple[int, str, bytes, int]], seed: int
) -> None:
    relay, now_ns = make_relay(network, seed), 0
    left: list[tuple[int, Datagram]] = []
    sent: dict[tuple[str, int], bytes] = {}
    for number, side, piece, later_ns in pieces:
        left += run(relay, now_ns + later_ns)
        now_ns += later_ns
        hear(relay, piece, number, side, now_ns)
        to = SERVER if side == CLIENT else CLIENT
        sent[to, number] = sent.get((to, number), b"") + piece
    for number in {each[0] for each in pieces}:
        for side in (CLIENT, SERVER):
            hear(relay, b"", number, side, now_ns)
    left += run(relay)
    came: dict[tuple[str, int], bytes] = {}
    for _, piece_ in left:
        came[piece_.peer] = came.get(piece_.peer, b"") + piece_.payload
    assert {peer: data for peer, data in came.items() if data} == sent
    figures = relay.figures()
    assert figures["flows"] == 0
    for link in RELAY:
        for lost in ("lost", "dropped", "overflowed", "oversized", "duplicated", "corrupted"):
            assert figures[link][lost] == 0


def test_latency_and_rate_are_those_of_the_network() -> None:
    relay = make_relay("constant(0.1) & rate(14760)")
    for _ in range(3):
        hear(relay, bytes(PIECE_BYTES))
    times_s = [at / SECOND_NS for at, _ in run(relay)]
    assert times_s == [0.2, 0.3, 0.4]  # 1448 and 28 bytes take 0.1 s each


def test_a_cut_stream_goes_on_once_it_is_healed() -> None:
    relay = make_relay("loss(1)")
    hear(relay, b"held")
    assert run(relay, 20 * SECOND_NS) == []
    healed = Scenario(network=NetworkConfig(uplink="constant(0.1)", downlink="constant(0.1)"))
    relay.change(healed, frozenset(), now_ns=20 * SECOND_NS)
    ((at, piece),) = run(relay)
    assert piece == Datagram(b"held", (SERVER, 1), 1)
    assert at == 20 * SECOND_NS + SECOND_NS // 10


def test_a_smaller_queue_takes_nothing_back() -> None:
    relay = make_relay("rate(10000, queue=30000)")
    sent = [bytes([number]) * PIECE_BYTES for number in range(20)]
    for piece in sent:
        hear(relay, piece)
    narrow = NetworkConfig(uplink="rate(20000, queue=2000)", downlink="rate(20000, queue=2000)")
    relay.change(Scenario(network=narrow), frozenset(), now_ns=SECOND_NS)
    assert [piece.payload for _, piece in run(relay)] == sent


def test_a_lost_piece_is_tried_again_as_by_a_retransmission() -> None:
    relay = make_relay("outage(0, 0.5)")
    hear(relay, b"first")
    hear(relay, b"second", at=SECOND_NS // 10)
    assert [(at, piece.payload) for at, piece in run(relay)] == [
        (3 * RETRY_NS, b"first"),
        (3 * RETRY_NS, b"second"),
    ]
    assert relay.figures()["retries"] == 3


def test_a_stream_that_waits_holds_up_no_other() -> None:
    relay = make_relay("loss(0.9)", seed=3)
    for number in range(1, 30):
        hear(relay, b"x", number)
    assert 0 < len(run(relay, 0)) < 29
    assert len(run(relay)) > 20
