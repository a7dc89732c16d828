"""Virtual time: clocks, order of events, computing time."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import Event, Flying
from skytether.sim import world as world_module
from skytether.sim.hosts import Clock
from skytether.sim.world import World

offsets = st.integers(-(10**15), 10**15)
drifts = st.integers(-1_000_000, 1_000_000)
times = st.integers(0, 10**15)


class Probe(Endpoint):
    """Endpoint that logs its calls, answers once, and wakes at given times."""

    def __init__(self, wakes_ns: list[int], answer_to: Address | None = None) -> None:
        super().__init__()
        self.wakes_ns = wakes_ns
        self.answer_to = answer_to
        self.log: list[tuple[str, int]] = []

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        name, socket = datagram.peer
        self.log.append((f"{datagram.payload.decode()} from {name} {socket}", now_ns))

    def wake(self, *, now_ns: int) -> None:
        self.wakes_ns.pop(0)
        self.log.append(("wake", now_ns))
        if self.answer_to is not None:
            self._out.append(Datagram(b"hi", self.answer_to, 2))

    def next_wake_ns(self) -> int | None:
        return self.wakes_ns[0] if self.wakes_ns else None


class Finite(Probe):
    @property
    def finished(self) -> bool:
        return not self.wakes_ns


def run(world: World, limit_ns: int = SECOND_NS) -> None:
    world.run(lambda: False, limit_ns=limit_ns)


def hosted(*wakes_ns: int, **keys: Any) -> tuple[World, Probe]:
    world, probe = World(), Probe(list(wakes_ns))
    world.add("host", probe, **keys)
    return world, probe


def test_what_lies_behind_the_limit_happens_when_time_goes_on() -> None:
    world, probe = hosted(10, 20)
    run(world, 15)
    assert probe.log == [("wake", 10)]
    run(world, 25)
    assert probe.log == [("wake", 10), ("wake", 20)]


@given(offsets, drifts, times)
def test_a_clock_finds_its_own_time_again(offset_ns: int, drift_ppb: int, time_ns: int) -> None:
    """`world()` is the first moment at which the clock shows at least the local time."""
    clock = Clock(offset_ns, drift_ppb)
    local_ns = clock.local(time_ns)
    found = clock.world(local_ns)
    assert found <= time_ns
    assert clock.local(found) >= local_ns
    assert clock.local(found - 1) < local_ns


def test_a_drifting_clock_gains_what_it_should() -> None:
    """100 ppm are 8.64 s a day."""
    day_ns = 86_400 * SECOND_NS
    assert Clock(5, 100_000).local(day_ns) == 5 + day_ns + 8_640_000_000


def test_hosts_wake_in_the_order_of_the_worlds_time() -> None:
    world, ahead, behind = World(), Probe([1000]), Probe([1000])
    world.add("behind", behind, clock=Clock(offset_ns=100))
    world.add("ahead", ahead, clock=Clock(offset_ns=400))
    order: list[int] = []
    world.run(lambda: bool(order.append(world.now_ns)), limit_ns=SECOND_NS)
    assert order[1:] == [600]
    assert (ahead.log, behind.log) == ([("wake", 1000)], [("wake", 1000)])


def test_a_datagram_arrives_at_once_with_the_senders_address() -> None:
    world, receiver = World(), Probe([])
    there = world.add("there", receiver, clock=Clock(offset_ns=7))
    world.add("here", Probe([50], answer_to=there))
    run(world)
    assert receiver.log == [("hi from here 2", 57)]


def test_a_datagram_to_nobody_is_lost() -> None:
    world = World()
    world.add("here", Probe([50], answer_to=("nobody", 0)))
    run(world)
    assert world.now_ns == 50


def test_what_arrives_is_heard_before_anybody_acts_on_that_instant() -> None:
    world = World()
    receiver = Probe([50])
    there = world.add("there", receiver)
    world.add("here", Probe([50], answer_to=there))
    run(world)
    # Both wake at 50; the sender was woken second, but its datagram still arrives at 50.
    assert receiver.log == [("wake", 50), ("hi from here 2", 50)]
    later = Probe([50, 60])
    world = World()
    there = world.add("there", later)
    world.add("here", Probe([60], answer_to=there), clock=Clock())
    run(world)
    assert later.log[0] == ("wake", 50)


def test_a_computing_host_sends_late_and_hears_at_once() -> None:
    """Woken at 50 for 30 ns of computing: sends at 80, but receives a datagram at 60."""
    world, busy, other = World(), Probe([50]), Probe([60])
    busy_address = world.add("busy", busy, compute_ns=30)
    other_address = world.add("other", other)
    busy.answer_to, other.answer_to = other_address, busy_address
    run(world)
    assert other.log == [("wake", 60), ("hi from busy 2", 80)]
    assert busy.log == [("wake", 50), ("hi from other 2", 60)]


def test_a_wake_during_computing_comes_late() -> None:
    world, busy = World(), Probe([50, 60])
    world.add("busy", busy, compute_ns=30)
    run(world)
    assert busy.log == [("wake", 50), ("wake", 80)]


def test_at_one_instant_hosts_are_woken_in_the_order_they_were_added() -> None:
    world, first, second = World(), Probe([70, 90]), Probe([90])
    there = world.add("there", Probe([]))
    for name, probe in (("first", first), ("second", second)):
        probe.answer_to = there
        world.add(name, probe)
    woken: list[int] = []
    world.run(lambda: bool(woken.append(len(first.log) - len(second.log))), limit_ns=SECOND_NS)
    # `second` has been due at 90 since the start, `first` only since 70.
    assert max(woken) == 2


def test_a_host_is_not_woken_before_its_start() -> None:
    world, probe = hosted(0, clock=Clock(offset_ns=1000), start_ns=40)
    run(world)
    assert probe.log == [("wake", 1040)]


def test_the_end_of_an_endpoint_is_told_once_and_at_once() -> None:
    world, told_ns = World(), []
    world.add("host", Finite([50, 60]), on_finished=lambda: told_ns.append(world.now_ns))
    world.add("other", Probe([60, 70]))
    run(world)
    assert told_ns == [60]


def test_every_event_is_told_with_its_time_and_host_before_the_end_of_its_endpoint() -> None:
    class Talker(Finite):
        def wake(self, *, now_ns: int) -> None:
            super().wake(now_ns=now_ns)
            self._events.append(Flying(vehicle=len(self.log)))

    heard: list[tuple[int, str, Event] | str] = []
    world = World(on_event=lambda *event: heard.append(event))
    for name, wakes_ns, offset_ns in (("one", [50, 80], 0), ("two", [1060], 1000)):
        world.add(
            name,
            Talker(wakes_ns),
            clock=Clock(offset_ns),
            on_finished=lambda name=name: heard.append(f"{name} has finished"),
        )
    run(world)
    assert heard == [
        (50, "one", Flying(vehicle=1)),
        (60, "two", Flying(vehicle=1)),
        "two has finished",
        (80, "one", Flying(vehicle=2)),
        "one has finished",
    ]


@pytest.mark.parametrize("limit_ns", [49, 50])
def test_time_stops_at_its_limit(limit_ns: int) -> None:
    world, probe = hosted(50)
    run(world, limit_ns)
    assert len(probe.log) == (limit_ns == 50)


def at(world: World, time_ns: int, action: Callable[..., None], *args: Any, **named: Any) -> None:
    world.at(time_ns, partial(action, *args, **named))


@given(offsets, drifts, times, offsets, drifts)
def test_a_changed_clock_goes_on_from_the_time_it_shows(
    offset_ns: int, drift_ppb: int, time_ns: int, step_ns: int, other_ppb: int
) -> None:
    clock = Clock(offset_ns, drift_ppb)
    changed = world_module.changed(clock, time_ns, step_ns=step_ns, drift_ppb=other_ppb)
    assert changed.local(time_ns) == clock.local(time_ns) + step_ns
    assert changed.drift_ppb == other_ppb
    assert world_module.changed(clock, time_ns, step_ns=step_ns).drift_ppb == drift_ppb


def test_actions_come_first_at_their_instant_and_in_the_order_they_were_asked_for() -> None:
    world, probe, order = World(), Probe([50]), []
    world.add("host", probe)
    for number in (1, 2):
        at(world, 50, lambda number=number: order.append((number, len(probe.log))))
    run(world)
    assert order == [(1, 0), (2, 0)]


def test_a_host_that_is_down_hears_nothing_and_sends_nothing() -> None:
    world, first, second, hearer = World(), Probe([50, 60]), Probe([0, 95]), Probe([])
    there = world.add("there", hearer)
    first.answer_to = second.answer_to = there
    here = world.add("here", first, compute_ns=5)
    world.add("caller", Probe([70, 90], answer_to=here))
    at(world, 62, world.stop, "here")
    at(world, 80, world.restart, "here", second)
    run(world)
    assert first.log == [("wake", 50), ("wake", 60)]
    assert second.log == [("wake", 80), ("hi from caller 2", 90), ("wake", 95)]
    assert hearer.log == [("hi from here 2", 55), ("hi from here 2", 85), ("hi from here 2", 100)]


def test_a_host_at_work_can_be_restarted_at_once() -> None:
    world, second = World(), Probe([0])
    world.add("here", Probe([50]), compute_ns=1000)
    at(world, 60, world.restart, "here", second)
    run(world)
    assert second.log == [("wake", 60)]


def test_the_end_of_a_later_life_is_told() -> None:
    world, told_ns = World(), []
    world.add("host", Finite([90]), on_finished=lambda: told_ns.append(world.now_ns))
    at(world, 50, world.restart, "host", Finite([0, 70]))
    run(world)
    assert told_ns == [70]


def test_datagrams_wait_for_a_frozen_host_and_it_wakes_late() -> None:
    world, probe = World(), Probe([50, 200])
    there = world.add("there", probe)
    world.add("here", Probe([20, 60, 70, 80], answer_to=there))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world_module, "FROZEN_MAX", 2)
        at(world, 40, world.freeze, "there")
        at(world, 45, world.freeze, "there")
        at(world, 100, world.thaw, "there")
        at(world, 110, world.thaw, "there")
        run(world)
    hi = "hi from here 2"
    assert probe.log == [(hi, 20), (hi, 100), (hi, 100), ("wake", 100), ("wake", 200)]


def test_a_frozen_host_can_be_taken_down_and_a_host_that_is_down_not_frozen() -> None:
    world, old, new = World(), Probe([50]), Probe([60])
    world.add("host", old)
    for time_ns, action in ((10, world.freeze), (20, world.stop), (30, world.freeze)):
        at(world, time_ns, action, "host")
    at(world, 40, world.thaw, "host")
    at(world, 55, world.restart, "host", new)
    run(world)
    assert (old.log, new.log) == ([], [("wake", 60)])


@pytest.mark.parametrize("step_ns", [1000, -1000])
def test_a_timer_counts_on_where_the_clock_is_set(step_ns: int) -> None:
    world, probe = hosted(50, 60 + step_ns)
    at(world, 30, world.set_clock, "host", step_ns=step_ns)
    run(world)
    assert probe.log == [("wake", 50 + step_ns), ("wake", 60 + step_ns)]
    assert world.now_ns == 60


def test_a_timer_counts_on_while_its_host_is_frozen() -> None:
    world, probe = hosted(50)
    at(world, 30, world.freeze, "host")
    at(world, 40, world.set_clock, "host", step_ns=-1000)
    at(world, 100, world.thaw, "host")
    run(world)
    assert probe.log == [("wake", -900)]


def test_another_rate_holds_from_now_on() -> None:
    """A clock that runs twice as fast from 50 on shows 300 at 175."""
    world, probe = hosted(100, 300)
    at(world, 50, world.set_clock, "host", drift_ppb=1_000_000_000)
    run(world)
    assert (probe.log, world.now_ns) == ([("wake", 150), ("wake", 300)], 175)


def test_a_host_can_be_given_more_to_compute() -> None:
    world, hearer = World(), Probe([])
    there = world.add("there", hearer)
    world.add("here", Probe([50, 60], answer_to=there))
    at(world, 55, world.set_compute, "here", 30)
    run(world)
    assert hearer.log == [("hi from here 2", 50), ("hi from here 2", 90)]
