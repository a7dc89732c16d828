"""Cost of the feed's readers to the server's ticks: none, one and three readers by turns.

The server runs in this process; vehicles and readers are processes of their own. The number of
readers changes every few seconds, in a random order each round, so that disturbances by other
programs affect all numbers alike. Three times are taken of each tick: the CPU time of this thread,
the wall-clock time, and how long after the deadline the last packet was sent.

`python -m skytether.lab.benchmarks.feed` takes three minutes; docs/operating.md has the results.
With `--pages` each reader is a page in a browser: a process that serves it, and a tab of Chromium
on this machine.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from skytether.lab.benchmarks.browser import chromium
from skytether.lab.benchmarks.children import ChildProcess
from skytether.lab.benchmarks.harness import CONSOLE, Durations, TextTable, us
from skytether.lab.benchmarks.problems import derive
from skytether.server.endpoint import Server
from skytether.shared.base import files
from skytether.shared.core.change import Running
from skytether.shared.core.events import address_text
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.feed import Frame
from skytether.shared.telemetry.record import Recorder, plan_columns, server_columns
from skytether.shell.driver import Shell, run
from skytether.shell.feed import Feed, Subscriber
from skytether.shell.process import opened
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import Page

READERS = (0, 1, 3)
"""Numbers of readers that are compared."""
SETTLE_S = 1
"""Time after a change of readers that is not counted [s], in which new readers receive the
backlog."""
WITHIN = 1.1
"""Largest allowed ratio of the p99 of ticks with the most readers to that without readers."""


@dataclass(frozen=True)
class FeedBenchmarkOptions:
    """Options of this benchmark."""

    rounds: int = 12
    """Number of turns of each number of readers."""
    seconds: int = 5
    """Length of a turn [s], of which the first does not count."""
    vehicles: int = 10
    """Number of vehicles, each of which is sent 50 horizons a second."""
    pages: bool = False
    """Whether readers are pages, each open in a browser."""


@dataclass
class Ticks:
    """Times of the ticks with a number of readers [ns]."""

    cpu_ns: list[int] = field(default_factory=list)
    wall_ns: list[int] = field(default_factory=list)
    out_ns: list[int] = field(default_factory=list)
    busy_ns: int = 0
    """Total CPU time of this process, including work between ticks."""
    passed_ns: int = 0
    """Total wall-clock time."""

    def figures(self) -> dict[str, float]:
        """Quantiles [µs], by name."""
        figures = {"ticks": float(len(self.cpu_ns)), "cores": self.busy_ns / self.passed_ns}
        for name in ("cpu", "wall", "out"):
            values: Durations = np.array(getattr(self, f"{name}_ns"))
            for share in (0.5, 0.99):
                figures[f"{name}_p{100 * share:g}_us"] = float(np.quantile(values, share)) / 1000
        return figures


class Timed(Shell):
    """Shell that measures its ticks."""

    ticks: Ticks | None = None
    """Collection of the times; None while they are not counted."""

    def _wake(self) -> None:
        due_ns = self.endpoint.next_wake_ns()
        wall_ns, cpu_ns = time.monotonic_ns(), time.thread_time_ns()
        super()._wake()
        if self.ticks is not None and due_ns is not None and due_ns <= wall_ns:
            now_ns = time.monotonic_ns()
            self.ticks.cpu_ns.append(time.thread_time_ns() - cpu_ns)
            self.ticks.wall_ns.append(now_ns - wall_ns)
            self.ticks.out_ns.append(now_ns - due_ns)


class Looker:
    """Process that reads the feed on command, as a page does.

    Args:
        stack: ends the process.
        does: function of this package, MODULE.NAME, which reads the commands "come" and "go" from
            its standard input.
        at: argument of the function: what to read.
    """

    def __init__(self, stack: ExitStack, does: str, at: str) -> None:
        module, _, name = does.partition(".")
        code = f"from skytether.lab.benchmarks.{module} import {name}; {name}(sys.argv[1])"
        self._process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", f"import sys; {code}", at], stdin=subprocess.PIPE
            )
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin
        stack.callback(self._pipe.close)

    def tell(self, word: bytes) -> None:
        """Send the command "come" or "go"."""
        self._pipe.write(word + b"\n")
        self._pipe.flush()


def look(folder: str) -> None:
    """Read each frame of the server between the commands "come" and "go"."""

    def take(_: str, frame: Frame) -> None:
        assert frame

    subscriber: Subscriber | None = None
    for word in sys.stdin:
        if subscriber is not None:
            subscriber.close()
        feed = Path(folder) / "server.feed"
        subscriber = Subscriber({"server": feed}, take) if word.strip() == "come" else None


def show(folder: str) -> None:
    """Show the flight in a browser between the commands "come" and "go"."""
    os.nice(10)  # a browser usually runs on another machine, so here it yields to the server
    flight = PageFlight()
    feeds = {name: Path(folder) / f"{name}.feed" for name in ("server", "client")}
    with closing(Page("127.0.0.1", 0, [flight])) as page, chromium() as browser, ExitStack() as now:
        for word in sys.stdin:
            now.close()
            if word.strip() == "come":
                now.enter_context(closing(Subscriber(feeds, flight.take)))
                tab = now.enter_context(closing(browser.new_page()))
                tab.goto(f"http://127.0.0.1:{page.port}")


class Turns:
    """Schedule of the readers, second by second.

    Args:
        options: options with the length of a turn.
        shell: shell whose ticks are measured.
        lookers: readers that come and go.
        ticks: collections of times, by the number of readers.
    """

    def __init__(
        self,
        options: FeedBenchmarkOptions,
        shell: Timed,
        lookers: list[Looker],
        ticks: dict[int, Ticks],
    ) -> None:
        rng = np.random.default_rng(1)
        order = [count for _ in range(options.rounds) for count in rng.permutation(list(ticks))]
        self._seconds = [(int(count), i) for count in order for i in range(options.seconds)]
        self._shell, self._lookers, self._ticks = shell, lookers, ticks
        self._began_ns = 0, 0
        """Time, and CPU time of this process, at the beginning of the second."""

    def each_second(self) -> bool:
        """Begin the next second; returns whether there was one left."""
        now_ns = time.monotonic_ns(), time.process_time_ns()
        if self._shell.ticks is not None:
            self._shell.ticks.passed_ns += now_ns[0] - self._began_ns[0]
            self._shell.ticks.busy_ns += now_ns[1] - self._began_ns[1]
        self._began_ns = now_ns
        self._shell.ticks = None
        if not self._seconds:
            return False
        count, second = self._seconds.pop(0)
        if second == 0:
            for number, looker in enumerate(self._lookers):
                looker.tell(b"come" if number < count else b"go")
        if second >= SETTLE_S:
            self._shell.ticks = self._ticks[count]
        return True


def measure(
    options: FeedBenchmarkOptions,
    readers: Sequence[int],
    lookers_at: Callable[[ExitStack, Path], list[Looker]],
) -> dict[str, Any]:
    """Figures of ticks by the number of readers.

    Args:
        options: options of the benchmark.
        readers: numbers of readers that are compared.
        lookers_at: starts the readers of the feeds in a folder.
    """
    scenario = derive("paper-every-step", control={"dt": 0.02, "horizon": 50})
    ticks = {count: Ticks() for count in readers}
    with tempfile.TemporaryDirectory(prefix="skytether-") as name, ExitStack() as stack:
        folder = Path(name)
        feed = stack.enter_context(closing(Feed(folder / "server.feed")))
        server = _server(scenario, options.vehicles, feed)
        shell = Timed(server, ("127.0.0.1", 0), feed=feed)
        lookers = lookers_at(stack, folder)
        files.write(folder / "scenario.toml", to_toml(scenario))
        more: tuple[str, ...] = (
            "--vehicles",
            str(options.vehicles),
            "--server",
            address_text(*shell.address),
        )
        more += ("--feed", str(folder / "client.feed"))
        vehicles = ChildProcess(
            stack, "client", str(folder / "scenario.toml"), "--duration", "86400", *more
        )
        turns = Turns(options, shell, lookers, ticks)

        def each_second() -> None:
            feed.count(server.figures())
            flying = len(server.sessions) == options.vehicles
            gone = vehicles.process.poll() is not None
            if gone or (flying and not turns.each_second()):
                os.kill(os.getpid(), signal.SIGTERM)

        run([shell], on_event=feed.say, on_second=each_second)
        assert vehicles.process.poll() is None, vehicles.words
        dropped = feed.figures()["dropped"]
    figures = {str(count): each.figures() for count, each in ticks.items()}
    return {"readers": figures, "vehicles": options.vehicles, "dropped": dropped}


def _server(scenario: Scenario, vehicles: int, feed: Feed) -> Server:
    """Server as its process creates it, recording only into the feed."""
    axes, planned = scenario.model.axes, scenario.control.horizon
    recorders = {}
    for part, columns in (
        ("server", server_columns(axes, scenario.control.scheme)),
        ("plan", plan_columns(axes, planned)),
    ):
        recorders[part] = Recorder(columns)
        recorders[part].follow(feed.part(part, columns))
    server = Server(
        scenario,
        boot_id=1,
        entropy=os.urandom,
        room=vehicles,
        recorder=recorders["server"],
        plans=recorders["plan"],
        stopwatch=Stopwatch(time.perf_counter_ns),
    )
    feed.open(opened("server", "benchmark", Running(server, scenario), feed))
    return server


def table(results: dict[str, Any]) -> TextTable:
    """Table of ticks' times, and their ratios to those without readers."""
    none, rows = results["readers"]["0"], []
    for count, figures in results["readers"].items():
        row = [count, f"{figures['ticks']:.0f}", f"{100 * figures['cores']:.1f} %"]
        for name in ("cpu", "wall", "out"):
            for share in ("p50", "p99"):
                value = figures[f"{name}_{share}_us"]
                row.append(f"{us(value)} ({value / none[f'{name}_{share}_us']:.2f})")
        rows.append(row)
    times = [f"{what}, {share}" for what in ("CPU", "wall", "out") for share in ("p50", "p99")]
    return TextTable(["readers", "ticks", "of a core", *(f"{each} [µs]" for each in times)], rows)


def main() -> int:
    """Measure as the command line says; the exit code is 1 where readers cost too much."""
    options = tyro.cli(FeedBenchmarkOptions, description=__doc__)

    def lookers_at(stack: ExitStack, folder: Path) -> list[Looker]:
        does = "feed.show" if options.pages else "feed.look"
        return [Looker(stack, does, str(folder)) for _ in range(max(READERS))]

    results = measure(options, READERS, lookers_at)
    title = f"a tick of {options.vehicles} vehicles; in brackets, times that with no reader"
    table(results).show(title)
    return int(ratio(results) > WITHIN or results["dropped"] > 0)


def ratio(results: dict[str, Any]) -> float:
    """Ratio of a tick's CPU time with the most readers to that with none (p99)."""
    none, *_, most = (figures["cpu_p99_us"] for figures in results["readers"].values())
    CONSOLE.print(f"CPU time, p99: {most / none:.3f} times that with none")
    if results["dropped"]:
        CONSOLE.print(f"readers that were too slow, and were dropped: {results['dropped']}")
    return float(most / none)


if __name__ == "__main__":
    sys.exit(main())
