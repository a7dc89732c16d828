"""Processes in virtual time: runs that are killed, closed, ended in order and started again."""

import pytest

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.sim.hosts import Clock
from skytether.sim.process import VirtualProcess
from skytether.sim.world import World


class Run(Endpoint):
    """Endpoint that may take 95 ms to end, and says goodbye when it is closed."""

    def __init__(self, number: int, word: str = "") -> None:
        super().__init__()
        self.made, self.is_over, self.heard = (number, word), False, list[bytes]()

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        self.heard.append(datagram.payload)

    def wake(self, *, now_ns: int) -> None:
        """Never due."""

    def next_wake_ns(self) -> None:
        return None

    def leave(self, *, now_ns: int) -> int:
        return now_ns + 95 * MILLISECOND_NS

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002
        self.send(b"goodbye", ("other", 0))

    @property
    def finished(self) -> bool:
        return self.is_over


class Hosted:
    def __init__(self) -> None:
        self.world, self.other, self.process = World(), Run(0), VirtualProcess("host", Run)
        self.world.add("host", self.process.endpoint, clock=Clock(10**15))
        self.world.add("other", self.other)
        self.ended_ms: list[int] = []

    def end(self) -> None:
        ended = lambda: self.ended_ms.append(self.world.now_ns // MILLISECOND_NS)  # noqa: E731
        self.process.end(self.world, 10 * MILLISECOND_NS, ended)

    def run(self) -> None:
        self.world.run(lambda: False, limit_ns=SECOND_NS)


def test_each_run_is_made_with_its_number_and_what_it_is_started_with() -> None:
    hosted = Hosted()
    made = [hosted.process.endpoint.made]
    for word in ("second", "third"):
        hosted.process.kill(hosted.world)
        hosted.process.start(hosted.world, word)
        made.append(hosted.process.endpoint.made)
    assert made == [(0, ""), (1, "second"), (2, "third")]
    assert hosted.process.is_up


def test_a_run_that_is_closed_sends_its_last_datagrams_and_one_that_is_killed_none() -> None:
    hosted = Hosted()
    hosted.process.kill(hosted.world)
    hosted.process.close(hosted.world)
    hosted.process.start(hosted.world)
    hosted.process.close(hosted.world)
    hosted.run()
    assert hosted.other.heard == [b"goodbye"]
    assert not hosted.process.is_up


@pytest.mark.parametrize(("over_ms", "at_ms"), [(None, 100), (15, 20)])
def test_a_run_ends_in_order_once_it_has_finished_or_its_time_is_up(
    over_ms: int | None, at_ms: int
) -> None:
    hosted = Hosted()
    if over_ms is not None:
        over = lambda: setattr(hosted.process.endpoint, "is_over", True)  # noqa: E731
        hosted.world.at(over_ms * MILLISECOND_NS, over)
    hosted.end()
    hosted.run()
    assert hosted.ended_ms == [at_ms]
    assert hosted.other.heard == [b"goodbye"]
    assert not hosted.process.is_up


def test_a_run_that_is_killed_while_it_ends_ends_no_later_run() -> None:
    hosted = Hosted()
    hosted.end()
    hosted.process.kill(hosted.world)
    hosted.end()
    hosted.process.start(hosted.world)
    hosted.run()
    assert not hosted.ended_ms
    assert hosted.process.is_up
