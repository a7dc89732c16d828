"""Driver: errors of an endpoint's code are logged, and the endpoint continues."""

import signal
from types import SimpleNamespace

import pytest

from helpers import Idle
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Event, Fault, Flying
from skytether.shell.driving import driver
from skytether.shell.driving.driver import Shell, run
from skytether.shell.host import timer
from virtual_loop import VirtualLoop


@pytest.fixture(autouse=True)
def _virtual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "new_event_loop", VirtualLoop)
    monkeypatch.setattr(driver, "make_timer", timer.LoopTimer)
    nothing = SimpleNamespace(collect=lambda: 0, freeze=lambda: None)
    monkeypatch.setattr(driver, "gc", nothing)  # takes half a second among tests


class Faulty(Idle):
    """Endpoint that fails at its first wake, and finishes after its second."""

    def __init__(self) -> None:
        super().__init__()
        self.wakes = 0

    @property
    def finished(self) -> bool:
        return self.wakes == 2

    def wake(self, *, now_ns: int) -> None:  # noqa: ARG002
        self.wakes += 1
        self._events.append(Flying(vehicle=self.wakes))
        if self.wakes == 1:
            raise ZeroDivisionError("by zero")

    def next_wake_ns(self) -> int | None:
        return 0


def test_a_mistake_in_the_code_is_an_event_and_does_not_end_the_flight() -> None:
    events: list[Event] = []
    run([Shell(Faulty(), ("127.0.0.1", 0))], on_event=events.append)
    kinds = [type(event) for event in events]
    assert sorted(kinds, key=lambda kind: kind.__name__) == [Fault, Flying, Flying]
    fault = next(event for event in events if isinstance(event, Fault))
    assert fault.traceback.startswith("Traceback (most recent call last):")
    assert fault.traceback.endswith("ZeroDivisionError: by zero\n")


def test_a_log_that_fails_does_not_stop_the_endpoints_clock() -> None:
    """The timer is armed before anything is logged."""
    endpoint, failed = Faulty(), []

    def fail(event: Event) -> None:
        if not isinstance(event, Fault):
            failed.append(event)
            raise BrokenPipeError

    run([Shell(endpoint, ("127.0.0.1", 0))], on_event=fail)
    assert endpoint.wakes == 2
    assert failed == [Flying(vehicle=1), Flying(vehicle=2)]


class Leaves(Idle):
    """Endpoint that is asked to end at its first wakes, and has finished some wakes later."""

    def __init__(self, asked: int, finishes: int) -> None:
        super().__init__()
        self.wakes, self._asked, self._finishes = 0, asked, finishes
        self.left, self.closed = 0, False

    @property
    def finished(self) -> bool:
        return self.wakes >= self._finishes

    def wake(self, *, now_ns: int) -> None:  # noqa: ARG002
        self.wakes += 1
        if self.wakes <= self._asked:
            signal.raise_signal(signal.SIGTERM)

    def next_wake_ns(self) -> int | None:
        return 0 if self.wakes < min(self._finishes, WAKES) else None

    def leave(self, *, now_ns: int) -> int:
        self.left += 1
        return now_ns + 1000 * SECOND_NS

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002
        self.closed = True


WAKES = 50
"""Number of wakes of an endpoint that never finishes."""


@pytest.mark.parametrize(
    ("asked", "finishes", "wakes"),
    [
        pytest.param(1, 20, (20, 20), id="it has finished"),
        pytest.param(1, WAKES + 1, (WAKES, WAKES), id="its time is up"),
        pytest.param(2, WAKES + 1, (2, WAKES - 1), id="it is asked again"),
    ],
)
def test_a_signal_asks_an_endpoint_to_end_and_a_second_one_ends_it(
    asked: int, finishes: int, wakes: tuple[int, int]
) -> None:
    endpoint = Leaves(asked, finishes)
    run([Shell(endpoint, ("127.0.0.1", 0))])
    assert (endpoint.left, endpoint.closed) == (1, True)
    assert wakes[0] <= endpoint.wakes <= wakes[1]
