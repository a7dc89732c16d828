"""`policy.parts`, `policy.exchange`, `policy.pace`: parts, reassembly, send rate and loss."""

from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy_lab import Lab, state
from skytether.policy import form, parts
from skytether.policy.exchange import Exchange
from skytether.policy.messages import OBSERVATION, Part, Report, decode, encode
from skytether.policy.pace import Tally
from skytether.policy.parts import HELD_MAX, Reassembly
from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import NoActionError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX

MS = MILLISECOND_NS
SIZES = st.integers(1, 6000) | st.sampled_from([1120, 1121, 215_040, 215_041, 500_000])


def cut(message: bytes, number: int = 0, parity: int = 3) -> list[Part]:
    return parts.split(message, 1, OBSERVATION, number, parity)


def put(whole: Reassembly, each: Part) -> bytes | None:
    arrived = whole.accept(each)
    return arrived.message if arrived else None


@given(SIZES, st.integers(0, 5), st.randoms(use_true_random=False))
def test_any_k_parts_of_each_block_are_enough(size: int, parity: int, random: Random) -> None:
    message = random.randbytes(size)
    made = cut(message, parity=parity)
    lost = {
        (block, place)
        for block in range(made[0].blocks)
        for place in random.sample(sorted(p.place for p in made if p.block == block), parity)
    }
    left = [each for each in made if (each.block, each.place) not in lost]
    random.shuffle(left)
    whole = Reassembly()
    came = [put(whole, each) for each in left]
    assert came[-1] == message
    assert came[:-1] == [None] * (len(left) - 1)


def test_with_one_part_less_nothing_arrives() -> None:
    whole = Reassembly()
    made = cut(bytes(5000))
    count, _ = form.block_parts(5000, 1)
    assert [put(whole, each) for each in made[: count - 1]] == [None] * (count - 1)


def test_a_newer_message_replaces_older_ones() -> None:
    whole, old, new = Reassembly(), cut(bytes(3000), 4), cut(b"\1" * 3000, 5)
    whole.accept(old[0])
    assert [put(whole, each) for each in new[:3]][-1] == b"\1" * 3000
    assert whole.given_up == 1
    with pytest.raises(ProtocolError, match=str(Drop.OVERTAKEN)):
        whole.accept(old[1])


def test_of_many_messages_that_are_not_whole_the_newest_are_held() -> None:
    whole = Reassembly()
    for number in range(50):
        whole.accept(cut(bytes(3000), number)[0])
    assert whole.given_up == 50 - HELD_MAX
    with pytest.raises(ProtocolError):
        whole.accept(cut(bytes(3000), 3)[1])


@given(
    st.builds(
        Part,
        st.just(1),
        st.integers(0, 2),
        st.integers(0, 3),
        st.integers(0, 10_000_000),
        st.integers(0, 255),
        st.integers(0, 64),
        st.integers(0, 255),
        st.integers(0, 255),
        st.just(0),
        st.binary(min_size=1, max_size=1120),
    )
)
def test_a_part_that_cannot_be_takes_no_memory(part: Part) -> None:
    whole = Reassembly()
    try:
        whole.accept(part)
    except ProtocolError:
        assert not whole._partial


def test_parts_that_disagree_are_refused() -> None:
    whole = Reassembly()
    whole.accept(cut(bytes(3000), 1)[0])
    with pytest.raises(ProtocolError, match=str(Drop.FIELD)):
        whole.accept(cut(bytes(3000), 1, parity=9)[1])
    with pytest.raises(ProtocolError, match=str(Drop.COPY)):
        whole.accept(cut(bytes(3000), 1)[0])


def test_parity_follows_the_loss() -> None:
    """Values for a Reed-Solomon code with 18 data parts, from the binomial distribution."""
    assert [form.parity_for(18, loss) for loss in (0.0, 0.01, 0.05, 0.1)] == [0, 2, 4, 7]


@given(st.binary(max_size=80))
def test_a_datagram_is_a_message_or_refused(payload: bytes) -> None:
    try:
        decode(payload)
    except ProtocolError:
        return
    assert encode(decode(payload))


def test_every_datagram_is_below_the_limit() -> None:
    ends = Exchange(2**32 - 1), Exchange(2**32 - 1)
    ends[0].send(OBSERVATION, bytes(100_000))
    sent = pump(ends, lambda _: True, 5 * SECOND_NS)
    assert max(map(len, sent)) <= PAYLOAD_BYTES_MAX - 32  # encryption adds 32 B


def pump(
    ends: tuple[Exchange, Exchange], passes: object, until_ns: int, delay_ns: int = 20 * MS
) -> list[bytes]:
    """Exchange datagrams between two ends until `until_ns`; returns the datagrams sent."""
    now_ns, sent = 0, []
    under_way: list[tuple[int, int, bytes]] = []
    while now_ns < until_ns:
        for number, end in enumerate(ends):
            for payload in end.outbox(now_ns=now_ns):
                sent.append(payload)
                if passes(payload):  # type: ignore[operator]
                    under_way.append((now_ns + delay_ns, 1 - number, payload))
        due = [each.due_ns() for each in ends] + [each[0] for each in under_way]
        times = [each for each in due if each is not None]
        if not times:
            break
        now_ns = max(min(times), now_ns + 1)
        for each in [each for each in under_way if each[0] <= now_ns]:
            under_way.remove(each)
            message, end = decode(each[2]), ends[each[1]]
            if isinstance(message, Part):
                end.accept(message, now_ns=now_ns)
            elif isinstance(message, Report):
                end.learn(message, now_ns=now_ns)
    return sent


def test_the_sender_learns_round_trip_and_loss() -> None:
    ends, random = (Exchange(1), Exchange(1)), Random(5)

    def passes(payload: bytes) -> bool:
        return not isinstance(decode(payload), Part) or random.random() > 0.2

    for _ in range(60):
        ends[0].send(OBSERVATION, bytes(20_000))
        pump(ends, passes, SECOND_NS)
        ends[0].pace._free_ns = 0
    assert ends[0].pace.loss == pytest.approx(0.2, abs=0.1)
    assert ends[0].pace.round_trip_ns == pytest.approx(40 * MS, rel=0.01)
    assert ends[1].repaired


def test_the_loss_of_messages_of_one_part_is_measured() -> None:
    """Of a lost message no part arrives, and the receiver has nothing to report on."""
    ends, random = (Exchange(1), Exchange(1)), Random(5)
    loss, whole = 0.0, 0

    def passes(payload: bytes) -> bool:
        return not isinstance(decode(payload), Part) or random.random() >= loss

    for number in range(300):
        loss = 0.0 if number < 100 else 0.3
        ends[0].send(OBSERVATION, bytes(100))
        pump(ends, passes, SECOND_NS)
        ends[0].pace._free_ns = 0
        if number == 99:
            assert ends[0].pace.loss < 0.001
        whole += number >= 120 and ends[1]._whole[OBSERVATION].newest == number
    assert 0.2 < ends[0].pace.loss <= 0.4
    assert whole >= 174  # of 180


def test_a_message_that_was_overtaken_is_not_lost() -> None:
    tally = Tally()
    numbers = (0, 2, 1, 3, 6, 5, 9, 9, 8, 12, 12, 2**62)
    counted = [tally.add(number, 4, (0, 1)) for number in numbers]
    assert counted == [
        *([(0, 0)] * 4),
        (3 * 4, 3),  # 0, 1 and 2
        (0, 0),
        (3 * 4, 2),  # 4 has not arrived
        *([(0, 0)] * 2),
        (3 * 4, 2),  # nor has 7
        (0, 0),
        ((2**62 - 12) * 4, 2),
    ]


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_jitter_is_no_loss(loss: float) -> None:
    """Parts overtake those of the next messages, at intervals shorter than the jitter."""
    jitter = f"gamma(50ms, 100ms, 20ms) & loss({loss})"
    options = RobotOptions("absolute", MS, step_ns=50 * MS, plays_on=True)
    lab, losses = Lab(options=options, to_policy=jitter, to_robot=jitter), list[float]()
    lab.connect()
    for number in range(200):
        with suppress(NoActionError):
            lab.infer(state(0.0))
        lab.sleep(0.049)
        if number >= 100:
            losses.append(lab.robot.figures()["link"]["loss"])
    assert loss <= sum(losses) / 100 <= 0.02 + 2.5 * loss


def test_a_message_that_has_begun_is_sent_to_its_end_and_of_those_that_wait_the_newest() -> None:
    end = Exchange(1, rate_max=20_000.0)
    for size in (30_000, 20, 10):
        end.send(OBSERVATION, bytes(size))
    first = end.outbox(now_ns=0)
    assert 0 < len(first) < 10  # the send rate delays the others
    assert end.dropped == 1
    later = first + [
        each for at in range(0, 3 * SECOND_NS, 10 * MS) for each in end.outbox(now_ns=at)
    ]
    sent = [message for message in map(decode, later) if isinstance(message, Part)]
    assert list(dict.fromkeys(message.size for message in sent)) == [30_000, 10]


def test_under_a_low_rate_observations_go_on_and_no_loss_is_measured() -> None:
    """Sending takes longer than the message period: each message sent arrives complete."""
    ends, now_ns, whole = (Exchange(1, rate_max=12_500.0), Exchange(1)), 0, 0
    for now_ns in range(0, 20 * SECOND_NS, 10 * MS):
        if now_ns % (100 * MS) == 0:
            ends[0].send(OBSERVATION, bytes(8000))
        for end, other in (ends, ends[::-1]):
            for message in map(decode, end.outbox(now_ns=now_ns)):
                if isinstance(message, Part):
                    whole += other.accept(message, now_ns=now_ns + 50 * MS) is not None
                elif isinstance(message, Report):
                    other.learn(message, now_ns=now_ns + 100 * MS)
    assert whole >= 24
    assert ends[0].pace.loss < 0.01
