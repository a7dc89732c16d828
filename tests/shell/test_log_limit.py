"""Limit of the log: a few events of a kind per second, and the number of omitted ones."""

from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event, Flying, Omitted, SessionEnded
from skytether.shell.host.limit import KIND_MAX, Limit


def told(limit: Limit, events: list[Event], now_ns: int) -> list[Event]:
    """Logged events among these, which occur at the same time."""
    return [one for event in events for one in limit.admit(event, now_ns=now_ns)]


def test_the_first_few_of_a_kind_are_told_and_the_others_counted() -> None:
    """A thousand vehicles that start together give five lines, and one more afterwards."""
    limit, events = Limit(), [Flying(vehicle=n) for n in range(1000)]
    assert told(limit, list(events), 7) == events[:KIND_MAX]
    assert limit.omitted(now_ns=7 + SECOND_NS - 1) == []
    assert limit.omitted(now_ns=7 + SECOND_NS) == [Omitted(kind="Flying", count=995)]
    assert limit.omitted(now_ns=7 + 2 * SECOND_NS) == []


def test_what_was_left_out_is_told_before_the_next_of_its_kind() -> None:
    limit, event = Limit(), Flying(vehicle=1)
    assert told(limit, [event] * 8, 0) == [event] * 5
    assert told(limit, [event] * 7, SECOND_NS) == [
        Omitted(kind="Flying", count=3),
        *[event] * 5,
    ]
    assert limit.omitted(now_ns=2 * SECOND_NS) == [Omitted(kind="Flying", count=2)]


def test_a_flood_of_one_kind_hides_no_other() -> None:
    limit, gone = Limit(), SessionEnded(vehicle=1)
    told(limit, [Flying(vehicle=n) for n in range(100)], 0)
    assert told(limit, [gone], 0) == [gone]


def test_the_end_tells_what_was_left_out_though_its_second_is_not_over() -> None:
    limit = Limit()
    told(limit, [Flying(vehicle=n) for n in range(6)], 0)
    assert limit.omitted(now_ns=None) == [Omitted(kind="Flying", count=1)]


def test_what_an_endpoint_has_left_out_itself_is_added() -> None:
    limit = Limit()
    events = [Omitted(kind="Flying", count=4), *(Flying(vehicle=n) for n in range(7))]
    assert told(limit, events, 0) == events[1 : 1 + KIND_MAX]
    assert limit.omitted(now_ns=None) == [Omitted(kind="Flying", count=6)]
    assert told(limit, [Omitted(kind="Flying", count=4)], SECOND_NS) == []
    assert told(limit, [Flying(vehicle=1)], 3 * SECOND_NS) == [
        Omitted(kind="Flying", count=4),
        Flying(vehicle=1),
    ]
