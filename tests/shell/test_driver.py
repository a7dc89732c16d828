"""Driver: errors of an endpoint's code are logged, and the endpoint continues."""

from types import SimpleNamespace

import pytest

from helpers import Idle
from skytether.shared.core.events import Event, Fault, Flying
from skytether.shell import driver, timer
from skytether.shell.driver import Shell, run
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
