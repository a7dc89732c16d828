"""Worker of `versions` in one checkout: does one turn per line of stdin, and answers with figures.

Each checkout runs its own worker, so names in the package may change between commits; the names and
arguments of turns must not. A line of stdin is a JSON list of a turn's name and its arguments; the
answer is a line of JSON on stdout. There is no garbage collection during a turn.
"""

import gc
import json
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from bench import solvers, tick
from bench.airspace import Airspace
from bench.harness import HOT, PACED, machine
from bench.problems import derive
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario.whole import Scenario
from skytether.sim.flight import fly

try:
    from skytether.sim.batch import fly_batch
except ModuleNotFoundError:  # an older version
    from skytether.sim.flight import fly_batch  # type: ignore[attr-defined, no-redef]


def where() -> dict[str, Any]:
    return {"folder": str(Path(tick.__file__).parents[1]), **machine()}


def ticks(name: str, vehicles: int, count: int, paced: bool) -> list[float]:
    """CPU time of whole ticks per vehicle [ns]: without pauses, the first tick left out; or each
    tick after a pause.
    """
    space, spent = _space(name, vehicles), []
    for number in range(count):
        space.prepare()
        if paced or number == 0:
            _pause(PACED.pause_s if paced else HOT.pause_s)
        start_ns = time.process_time_ns()
        space.wake()
        spent.append((time.process_time_ns() - start_ns) / vehicles)
    return spent if paced else spent[1:]


def flight(name: str, seconds: float, vehicles: int, seeds: int) -> list[float]:
    """Vehicle-steps per second of CPU time, of one flight in virtual time, or of a batch."""
    scenario = derive(name, duration=seconds, settle=0.0)
    start_ns = time.process_time_ns()
    if seeds == 1:
        flights = [fly(scenario, vehicles=vehicles)]
    else:
        flights = fly_batch(scenario, range(1, seeds + 1))
    took_ns = time.process_time_ns() - start_ns
    return [sum(len(record.client) for record in flights) * SECOND_NS / took_ns]


@cache
def _space(name: str, vehicles: int) -> Airspace:
    """Vehicles after SETTLE ticks, so that they have left the reference where they start."""
    space = Airspace(_scenarios()[name], vehicles)
    for _ in range(tick.SETTLE):
        space.prepare()
        space.wake()
    return space


@cache
def _scenarios() -> dict[str, Scenario]:
    return {**solvers.flights(), **tick.mixes()}


def _pause(pause_s: float) -> None:
    time.sleep(pause_s)
    time.process_time_ns()  # the first call after a pause is slow


TURNS: dict[str, Callable[..., Any]] = {turn.__name__: turn for turn in (where, ticks, flight)}


def main() -> None:
    """Answer line by line until stdin is closed."""
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        gc.collect()
        gc.disable()
        figures = TURNS[name](*arguments)
        gc.enable()
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
