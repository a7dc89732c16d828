"""Several paths: reports, copies, what is learned of each path, and which are chosen."""

from collections.abc import Sequence
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.framing import split
from skytether.shared.wire.paths import AGAIN_NS, EVERYWHERE, LOOK_NS, WINDOW, Paths

DELAY_NS, STEP_NS, SILENCE_NS = 50 * MILLISECOND_NS, 100 * MILLISECOND_NS, SECOND_NS // 2
BOTH = (0, 1)


class Ends:
    """Two ends that send in turn, every step; `dead` are paths that lose everything."""

    def __init__(self, prices: Sequence[float] = (1.0, 1.0)) -> None:
        self.near, self.far = Paths(prices, SECOND_NS), Paths(prices, SECOND_NS)
        self.now_ns, self.dead = 0, set[int]()
        self._payloads = count()

    def send(self, worth: float = 1.0, on: Sequence[int] = (), *, back: bool = False) -> list[int]:
        sender, receiver = (self.far, self.near) if back else (self.near, self.far)
        among = range(len(sender.each))
        on = on or sender.choose(worth, self.now_ns, among)
        datagram = sender.report() + b"\x93" + next(self._payloads).to_bytes(4)
        sender.sent(datagram, on, self.now_ns, worth=worth)
        for path in on:
            if path not in self.dead:
                self.arrive(receiver, datagram, path)
        return list(on)

    def arrive(self, receiver: Paths, datagram: bytes, path: int) -> None:
        if not receiver.is_copy(datagram, path):
            report, _ = split(datagram)
            assert report
            receiver.heard(report, datagram, path, self.now_ns + DELAY_NS)

    def exchange(self, steps: int, worth: float = 1.0) -> list[list[int]]:
        chosen = []
        for _ in range(steps):
            self.now_ns += STEP_NS
            chosen.append(self.send(worth))
            self.send(on=BOTH, back=True)
        return chosen


def test_report_is_read_as_it_was_written() -> None:
    ends = Ends()
    ends.exchange(3)
    report, message = split(ends.near.report() + b"\x93abc")
    assert message == b"\x93abc"
    assert report
    assert report.sequence == 4
    assert report.newest == 3
    assert report.arrived == (7, 7)


def test_message_without_a_report_is_as_it_is() -> None:
    assert split(b"\x93abc") == (None, b"\x93abc")
    assert split(b"") == (None, b"")


@given(st.binary(max_size=20).map(lambda tail: b"\xc4" + tail))
def test_any_other_beginning_is_refused_or_read(payload: bytes) -> None:
    try:
        report, message = split(payload)
    except ProtocolError:
        return
    assert report
    assert payload.endswith(message)


def test_report_of_other_paths_is_refused() -> None:
    ends, three = Ends(), Paths((1.0, 1.0, 1.0), SECOND_NS)
    report, _ = split(three.report() + b"x")
    assert report
    with pytest.raises(ProtocolError):
        ends.near.heard(report, b"x", 0, 0)


def test_copies_are_recognised_and_counted_by_path() -> None:
    ends = Ends()
    ends.send(on=BOTH)
    first, second = ends.far.each
    assert (first.first, first.copies) == (1, 0)
    assert (second.first, second.copies) == (0, 1)


def test_paths_of_equal_price_take_turns() -> None:
    chosen = Ends().exchange(40)[10:]
    assert {tuple(each) for each in chosen} == {(0,), (1,)}
    assert abs(sum(each == [0] for each in chosen) - 15) <= 1


def test_dear_path_is_not_used_while_the_cheap_one_is_well() -> None:
    assert Ends((1.0, 10.0)).exchange(40)[10:] == 30 * [[0]]


def test_dear_path_is_used_when_the_cheap_one_is_dead() -> None:
    ends = Ends((1.0, 10.0))
    ends.exchange(20, worth=20.0)
    ends.dead = {0}
    ends.exchange(20, worth=20.0)
    assert ends.exchange(5, worth=20.0) == 5 * [[1]]


def test_valuable_message_goes_over_all_paths() -> None:
    ends = Ends((1.0, 3.0))
    ends.exchange(20)
    assert ends.send(EVERYWHERE) == [0, 1]


def test_dead_path_is_left_within_a_second_and_used_again_when_it_answers() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    ends.exchange(10)
    assert ends.exchange(5) == 5 * [[1]]
    assert ends.near.each[0].failure(ends.now_ns) > 0.8
    ends.dead = set()
    ends.send(on=(0,))
    ends.exchange(3)
    assert ends.near.each[0].failure(ends.now_ns) < 0.2


def test_lost_packet_is_sent_again_once_on_another_path() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    ends.send(on=(0,))
    assert ends.near.again(SILENCE_NS, ends.now_ns + DELAY_NS, BOTH) is None
    later_ns = ends.now_ns + 3 * SECOND_NS
    resent = ends.near.again(SILENCE_NS, later_ns, BOTH)
    assert resent
    assert resent[1] == 1
    assert ends.near.again(SILENCE_NS, later_ns, BOTH) is None


def test_packet_that_has_arrived_is_not_sent_again() -> None:
    ends = Ends()
    ends.exchange(20)
    assert ends.near.again(SILENCE_NS, ends.now_ns + 3 * SECOND_NS, BOTH) is None


def test_losses_one_by_one_are_no_outage() -> None:
    ends = Ends()
    for step in range(200):
        ends.dead = {0} if step % 5 == 0 else set()
        ends.now_ns += STEP_NS
        ends.send(on=BOTH)
        ends.send(on=BOTH, back=True)
    ends.dead = set()
    ends.exchange(5)
    assert ends.near.each[0].loss == pytest.approx(0.2, abs=0.08)
    assert ends.near.each[1].loss < 0.06


def test_late_and_doubled_reports_change_nothing() -> None:
    ends = Ends()
    ends.exchange(20)
    datagram = ends.far.report() + b"\x93old"
    ends.exchange(5)
    before = ends.near.figures(ends.now_ns)
    report, _ = split(datagram)
    assert report
    ends.near.heard(report, datagram, None, ends.now_ns)
    assert ends.near.is_copy(datagram, None)
    assert ends.near.figures(ends.now_ns) == before


def test_sequence_numbers_go_round() -> None:
    ends = Ends()
    ends.exchange(600)
    assert all(path.missing == 0 for path in ends.near.each)
    assert all(path.loss == pytest.approx(0.02) for path in ends.near.each)


def test_silence_of_longer_than_the_window_counts_as_lost() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    ends.send(on=(0,))
    ends.dead = set()
    for _ in range(WINDOW + 2):
        ends.send(on=(1,))
    ends.send(on=(1,), back=True)
    assert ends.near.each[0].missing == 1


def test_unused_path_is_tried_now_and_then_and_a_doubted_one_more_often() -> None:
    ends = Ends((1.0, 4.0))
    ends.exchange(20)
    ends.send(on=BOTH)
    ends.send(on=BOTH, back=True)
    assert ends.near.looks(ends.now_ns) == []
    assert ends.near.looks(ends.now_ns + LOOK_NS) == [0]
    assert ends.near.looks(ends.now_ns + 4 * LOOK_NS) == [0, 1]
    new = Paths((1.0, 1.0), SECOND_NS)
    assert new.looks(0) == [0, 1]
    assert new.looks(AGAIN_NS - 1) == []
    assert new.looks(AGAIN_NS) == [0, 1]


@settings(max_examples=40)
@given(
    st.lists(st.floats(1.0, 100.0), min_size=2, max_size=4),
    st.floats(0.0, 1e9),
    st.data(),
)
def test_some_of_the_allowed_paths_are_always_chosen(
    prices: list[float], worth: float, data: st.DataObject
) -> None:
    among = data.draw(st.sets(st.sampled_from(range(len(prices))), min_size=1))
    chosen = Paths(prices, SECOND_NS).choose(worth, 0, sorted(among))
    assert chosen
    assert {*chosen} <= among


def test_path_that_became_slower_is_known_to_be_well() -> None:
    ends = Ends()
    ends.exchange(20)
    reports = list[tuple[int, bytes]]()
    for _ in range(40):
        ends.now_ns += STEP_NS
        ends.send(on=(0,))
        datagram = ends.far.report() + b"\x93" + len(reports).to_bytes(4)
        reports.append((ends.now_ns + 6 * STEP_NS, datagram))
        for due_ns, each in reports:
            if due_ns == ends.now_ns:
                ends.arrive(ends.near, each, 0)
        ends.near.again(SILENCE_NS, ends.now_ns, BOTH)
    assert ends.near.each[0].failure(ends.now_ns) < 0.2


def test_report_that_a_slow_path_brings_late_does_not_tell_what_was_lost_since() -> None:
    ends = Ends()
    ends.exchange(20)
    late = ends.far.report() + b"\x93late"
    ends.exchange(1)
    ends.now_ns += STEP_NS
    ends.send(on=(0,))
    ends.now_ns += 2 * STEP_NS
    before = ends.near.each[0].failure(ends.now_ns)
    ends.arrive(ends.near, late, 1)
    assert ends.near.each[0].failure(ends.now_ns) == before
    assert ends.near.again(SILENCE_NS, ends.now_ns, BOTH) is None


def test_end_that_begins_its_numbers_anew_is_understood_at_once() -> None:
    ends = Ends()
    ends.exchange(60)
    ends.near = Paths((1.0, 1.0), SECOND_NS)
    ends.far.peer_may_restart = True
    ends.exchange(10)
    assert max(path.failure(ends.now_ns) for path in ends.near.each) < 0.2


@given(st.integers(WINDOW, 1000))
def test_a_message_that_is_late_by_however_much_changes_nothing(late: int) -> None:
    ends = Ends()
    ends.exchange(20)
    datagrams = [sender.report() + b"\x93late" for sender in (ends.near, ends.far)]
    for _ in range(late):
        ends.send(on=BOTH)
        ends.send(on=BOTH, back=True)
    for datagram, receiver in zip(datagrams, (ends.far, ends.near), strict=True):
        before, report = receiver.figures(ends.now_ns), receiver.report()[4:]
        ends.arrive(receiver, datagram, 0)
        assert receiver.figures(ends.now_ns) == before
        assert receiver.report()[4:] == report


@given(st.integers(20, 600))
def test_a_late_message_of_an_earlier_run_is_not_taken_for_a_newer_one(steps: int) -> None:
    ends = Ends()
    ends.exchange(steps)
    late = ends.near.report() + b"\x93late"
    ends.near = Paths((1.0, 1.0), SECOND_NS)
    ends.far.peer_may_restart = True
    ends.exchange(2)
    ends.arrive(ends.far, late, 0)
    ends.exchange(2 * steps)
    assert max(path.failure(ends.now_ns) for path in ends.near.each) < 0.2


def test_clock_set_back_makes_no_message_precious() -> None:
    ends = Ends()
    ends.exchange(20)
    earlier_ns = ends.now_ns - 3600 * SECOND_NS
    assert ends.near.alive_worth(earlier_ns) == 0.0


def test_a_probe_is_not_sent_again_and_displaces_no_message() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    ends.send(on=(0,))
    probe = ends.near.report() + b"\x93probe"
    ends.near.sent(probe, (0,), ends.now_ns, is_probe=True)
    resent = ends.near.again(SILENCE_NS, ends.now_ns + 3 * SECOND_NS, BOTH)
    assert resent
    assert resent[0] != probe


def test_a_sign_of_life_displaces_no_message_that_may_have_to_be_sent_again() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    plan = ends.near.report() + b"\x93plan"
    ends.near.sent(plan, (0,), ends.now_ns, worth=0.8)
    ends.send(worth=0.0, on=(1,))
    resent = ends.near.again(SILENCE_NS, ends.now_ns + 3 * SECOND_NS, BOTH)
    assert resent == (plan, 1)
    for _ in range(WINDOW):
        ends.send(worth=0.0, on=(1,))
    ends.send(worth=0.0, on=(0,))
    resent = ends.near.again(SILENCE_NS, ends.now_ns + 6 * SECOND_NS, BOTH)
    assert resent
    assert resent[0] != plan, "no report could tell any more whether it has arrived"


def test_a_lost_packet_is_noticed_after_the_usual_silence_and_not_the_longest() -> None:
    ends = Ends()
    ends.exchange(40)
    ends.dead = {0}
    ends.send(on=(0,))
    soon_ns = ends.now_ns + 2 * STEP_NS + 2 * ends.near.each[0].quick_ns
    assert ends.near.again(10 * SECOND_NS, soon_ns, BOTH)


def test_messages_do_not_follow_each_other_into_a_path_that_may_be_down() -> None:
    """Path 1 loses a fifth of its packets, so path 0 is preferred as long as reports come."""
    ends = Ends()
    for step in range(100):
        ends.dead = {1} if step % 5 == 0 else set()
        ends.now_ns += STEP_NS
        ends.send(on=BOTH)
        ends.send(on=BOTH, back=True)
    first, second = (path.failure(ends.now_ns) for path in ends.near.each)
    assert second > 2 * first
    ends.dead = {0}
    ends.now_ns += 5 * STEP_NS
    chosen = []
    for _ in range(4):
        ends.now_ns += STEP_NS
        chosen.append(ends.send())
    assert [1] in chosen[:2]
    assert len({*map(tuple, chosen)}) == 2


def test_path_that_was_down_is_tried_as_soon_as_it_brings_a_packet() -> None:
    ends = Ends()
    ends.exchange(20)
    ends.dead = {0}
    for _ in range(20):
        ends.send(on=BOTH)
        ends.exchange(1)
    ends.near.looks(ends.now_ns)
    soon_ns = ends.now_ns + ends.near.each[0].quick_ns
    assert soon_ns < ends.now_ns + AGAIN_NS
    assert ends.near.looks(soon_ns) == []
    ends.dead = set()
    ends.send(on=(0,), back=True)
    assert ends.near.looks(soon_ns) == [0]


def test_path_that_brings_packets_and_takes_none_is_tried_more_and_more_rarely() -> None:
    ends = Ends()
    ends.exchange(20)
    tries = 0
    for step in range(200):
        ends.now_ns += STEP_NS
        ends.dead = {0}
        ends.send(on=(1,))
        for path in ends.near.looks(ends.now_ns):
            tries += path == 0
            ends.send(on=(path,))
        ends.dead = set()
        ends.send(on=BOTH, back=True)
        if step == 60:
            tries_before = tries
    assert tries - tries_before <= 14


def overtaken(ends: Ends) -> bytes:
    """A packet that is sent on path 0, and arrives later than the next one on path 1, or never."""
    late = ends.near.report() + b"\x93late"
    ends.near.sent(late, (0,), ends.now_ns)
    ends.send(on=(1,))
    return late


def test_packet_that_was_overtaken_and_does_not_come_is_reported_soon_and_once() -> None:
    ends = Ends()
    ends.exchange(20)
    overtaken(ends)
    assert ends.far.looks(ends.now_ns + DELAY_NS) == []
    soon_ns = ends.now_ns + 3 * DELAY_NS
    assert ends.far.looks(soon_ns) == [1]
    ends.far.sent(ends.far.report() + b"\x93", (1,), soon_ns, is_probe=True)
    assert ends.far.looks(soon_ns + DELAY_NS) == []


def test_any_other_packet_reports_what_was_overtaken_as_well() -> None:
    ends = Ends()
    ends.exchange(20)
    overtaken(ends)
    ends.now_ns += 3 * DELAY_NS
    ends.send(on=(1,), back=True)
    assert ends.far.looks(ends.now_ns) == []


def test_packets_that_are_always_overtaken_are_soon_awaited_for_longer() -> None:
    ends, late_by_ns = Ends(), SECOND_NS // 2
    judged = []
    for _ in range(30):
        ends.exchange(2)
        late = overtaken(ends)
        ends.now_ns += late_by_ns
        judged.append(bool(ends.far.looks(ends.now_ns)))
        ends.arrive(ends.far, late, 0)
        ends.send(on=BOTH, back=True)
    assert judged[0]
    assert not any(judged[10:])


def test_a_path_that_dies_and_one_that_is_well_again_are_told_once() -> None:
    """One over which nothing has arrived yet is not, nor one that loses single packets."""
    ends = Ends()
    assert ends.near.turned(ends.now_ns) == []
    outages = []

    def go_on(steps: int) -> None:
        for _ in range(steps):
            ends.now_ns += STEP_NS
            ends.send(on=BOTH)
            ends.send(on=BOTH, back=True)
            outages.extend(ends.near.turned(ends.now_ns))

    go_on(40)
    ends.dead = {1}
    go_on(1)
    ends.dead = set()
    go_on(20)
    assert outages == []
    ends.dead = {1}
    go_on(40)
    assert outages == [(1, True)]
    ends.dead = set()
    go_on(40)
    assert outages == [(1, True), (1, False)]
