"""Flights of one scenario with many seeds, which share a server. The records equal the records of
single flights; `sim.flight` explains why.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from skytether.server.endpoint import Server
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram, by_name
from skytether.shared.events.flight import Fault
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.sim.flight import fly_runs

COMPANY_MAX = 100
"""Largest number of runs that share a server. A larger batch is no faster, and vehicle numbers must
fit one byte.
"""


class SharedServer(Server):
    """Server of several runs, which also counts dropped datagrams by run."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.dropped_by_host: defaultdict[str, Counter[str]] = defaultdict(Counter)
        """Number of dropped datagrams, by the sending host and the reason."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        dropped = self._reception.hear(datagram, now_ns=now_ns)
        if dropped is not None:
            self.dropped_by_host[datagram.peer[0]][dropped] += 1

    def dropped_of(self, hosts: Sequence[str]) -> Counter[str]:
        return sum((self.dropped_by_host[host] for host in hosts), Counter[str]())


def _dropped(server: Any, hosts: Sequence[str]) -> Mapping[str, Any]:
    return {"dropped": by_name(server.dropped_of(hosts))}


def fly_batch(
    scenario: Scenario,
    seeds: Sequence[int],
    *,
    changes: Sequence[tuple[float, Mapping[str, Any]]] = (),
    on_second: Callable[[int], None] = lambda _: None,
    stopped: Callable[[], bool] | None = None,
) -> list[Record]:
    """Fly a scenario once for each of these seeds, many times faster than one by one.

    Each flight equals that of `fly` with the same seed, to the last bit, except that the server's
    `figures` only count dropped datagrams. If the server's computing time exceeds a step, the runs
    are flown one by one, because the ticks that the server misses then depend on its start.

    Args:
        seeds: different seeds that replace the scenario's.
        changes, stopped: as in `fly`.
        on_second: as in `fly`; the time restarts at 0 after every COMPANY_MAX runs.

    Raises:
        ConfigError: a plug-in raised an exception.
    """
    in_time = seconds_to_ns(scenario.simulation.compute_s) <= scenario.dt_ns
    # Runs would affect each other if vehicles of one server share its bytes/s, or keep apart.
    alone = not in_time or scenario.keeps_apart or scenario.control.shared_bytes_per_s
    company = 1 if alone else COMPANY_MAX
    shared: dict[str, Any] = {"make_server": SharedServer, "figures_of": _dropped}
    groups = [seeds[first : first + company] for first in range(0, len(seeds), company)]
    flights: list[Record] = []
    for group in groups:
        together = shared if len(group) > 1 else {}
        flights += fly_runs(scenario, group, on_second, stopped, changes=changes, **together)
    for _, _, event in (event for flight in flights for event in flight.events):
        if isinstance(event, Fault):
            raise ConfigError(event.traceback.splitlines()[-1])
    return flights
