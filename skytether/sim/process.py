"""Processes in virtual time, which can be killed, asked to end, and restarted on their host.

Each run is a new endpoint. The host keeps its address, clock and saved state (`World.memory`).
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from skytether.shared.endpoints.endpoint import Endpoint
from skytether.sim.world import World

Run = TypeVar("Run", bound=Endpoint)


class VirtualProcess(Generic[Run]):
    """Process of a host; `endpoint` is its newest run. The caller adds the first run to the world.

    The world is each method's first argument, so that methods can be `actions` of `sim.flight.fly`.

    Args:
        host: name of the host.
        make: makes a run; gets the number of earlier runs and the arguments of `start`.
    """

    def __init__(self, host: str, make: Callable[..., Run]) -> None:
        self.host, self._make = host, make
        self.endpoint, self.runs, self.is_up = make(0), 1, True

    def start(self, world: World, *args: Any) -> None:
        """Start the next run; if a run is up, it is replaced."""
        self.endpoint = self._make(self.runs, *args)
        self.runs, self.is_up = self.runs + 1, True
        world.restart(self.host, self.endpoint)

    def kill(self, world: World) -> None:
        self.is_up = False
        world.stop(self.host)

    def close(self, world: World) -> None:
        """End the run at once if it is up, as a second SIGTERM does, and send its datagrams."""
        if self.is_up:
            world.act(self.host, self.endpoint.close)
        self.kill(world)

    def end(self, world: World, look_ns: int, ended: Callable[[], None] = lambda: None) -> None:
        """Ask the run to end if it is up, as SIGTERM does.

        Args:
            look_ns: time between two checks whether the run has finished [ns].
            ended: called when the run has ended, unless it is killed before.
        """
        run, latest_ns = self.endpoint, 0

        def leave(*, now_ns: int) -> None:
            nonlocal latest_ns
            latest_ns = world.now_ns + run.leave(now_ns=now_ns) - now_ns

        def look() -> None:
            if not self.is_up or self.endpoint is not run:
                return
            if run.finished or world.now_ns >= latest_ns:
                self.close(world)
                ended()
            else:
                world.at(world.now_ns + look_ns, look)

        if self.is_up:
            world.act(self.host, leave)
            look()
