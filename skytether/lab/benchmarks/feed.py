"""What readers of the server's feed cost its ticks: none, one and three of them by turns.

The server is driven here as its process drives it; vehicles and readers are processes of their own.
Readers come and go every few seconds, in an order that is drawn anew each round, so that whatever
else the machine does hits all alike. Of each tick three times are taken: the CPU time of this
thread, the wall-clock time, and how long after its deadline the last packet was out.

`python -m skytether.lab.benchmarks.feed` takes three minutes; docs/feed.md has what it said. With
`--pages` each reader is a page in a browser: a process that serves it, and a tab of Chromium on
this machine.
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
from skytether.shared.core.change import Running
from skytether.shared.core.events import address_text
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.feed import Frame
from skytether.shared.telemetry.record import Recorder, plan_columns, server_columns
from skytether.shell.command import opened
from skytether.shell.driver import Shell, run
from skytether.shell.feed import Feed, Subscriber
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import Page

READERS = (0, 1, 3)
"""Numbers of readers that are compared."""
SETTLE_S = 1
"""Time after readers have come or gone that does not count [s]: they catch up with the backlog."""
WITHIN = 1.1
"""Largest ratio of the p99 of ticks with the most readers to that with none."""


@dataclass(frozen=True)
class FeedBenchmarkOptions:
    """How much to measure."""

    rounds: int = 12
    """Number of times that each number of readers has its turn."""
    seconds: int = 5
    """Length of a turn [s], of which the first does not count."""
    vehicles: int = 10
    """Number of vehicles, which are sent a horizon at each of 50 steps a second."""
    pages: bool = False
    """Whether readers are pages, each open in a browser."""


@dataclass
class Ticks:
    """Times of the ticks with some number of readers [ns]."""

    cpu_ns: list[int] = field(default_factory=list)
    wall_ns: list[int] = field(default_factory=list)
    out_ns: list[int] = field(default_factory=list)
    busy_ns: int = 0
    """CPU time of this process in all, with what it does between ticks."""
    passed_ns: int = 0
    """Time in all."""

    def figures(self) -> dict[str, float]:
        """Quantiles [µs], by name."""
        figures = {"ticks": float(len(self.cpu_ns)), "cores": self.busy_ns / self.passed_ns}
        for name in ("cpu", "wall", "out"):
            values: Durations = np.array(getattr(self, f"{name}_ns"))
            for share in (0.5, 0.99):
                figures[f"{name}_p{100 * share:g}_us"] = float(np.quantile(values, share)) / 1000
        return figures


class Timed(Shell):
    """Shell that takes the times of its ticks."""

    ticks: Ticks | None = None
    """Where they are kept, while they count."""

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
    """A process that looks on when it is told to, as a page does.

    Args:
        stack: ends it.
        does: function of this package, MODULE.NAME, which is told on the standard input to "come"
            or to "go".
        at: what to look at: the argument of that function.
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
        """Tell it to come or to go."""
        self._pipe.write(word + b"\n")
        self._pipe.flush()


def look(folder: str) -> None:
    """Read each frame of the server, between the words "come" and "go" on the standard input."""

    def take(_: str, frame: Frame) -> None:
        assert frame

    subscriber: Subscriber | None = None
    for word in sys.stdin:
        if subscriber is not None:
            subscriber.close()
        feed = Path(folder) / "server.feed"
        subscriber = Subscriber({"server": feed}, take) if word.strip() == "come" else None


def show(folder: str) -> None:
    """Show the flight in a browser between the words "come" and "go" on the standard input."""
    os.nice(10)  # browsers are on other machines
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
    """Who looks on when, second by second.

    Args:
        options: how long each turn is.
        shell: whose ticks are taken.
        lookers: readers that come and go.
        ticks: where the times are kept, by the number of readers.
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
        """Time, and CPU time of this process, at which the second began."""

    def each_second(self) -> bool:
        """Let a second begin; returns whether there was one left."""
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
        options: how much to measure.
        readers: numbers of readers that are compared.
        lookers_at: the processes that are readers, of the feeds in a folder.
    """
    scenario = derive("paper-every-step", control={"dt": 0.02, "horizon": 50})
    ticks = {count: Ticks() for count in readers}
    with tempfile.TemporaryDirectory(prefix="skytether-") as name, ExitStack() as stack:
        folder = Path(name)
        feed = stack.enter_context(closing(Feed(folder / "server.feed")))
        server = _server(scenario, options.vehicles, feed)
        shell = Timed(server, ("127.0.0.1", 0), feed=feed)
        lookers = lookers_at(stack, folder)
        (folder / "scenario.toml").write_bytes(to_toml(scenario))
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
    """A server as its process makes it, which records for the feed alone."""
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
    """Times of ticks, and how many times as long they are as with nobody looking on."""
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
    """How many times as long a tick's CPU time is with the most readers as with none (p99)."""
    none, *_, most = (figures["cpu_p99_us"] for figures in results["readers"].values())
    CONSOLE.print(f"CPU time, p99: {most / none:.3f} times that with none")
    if results["dropped"]:
        CONSOLE.print(f"readers that were too slow, and were dropped: {results['dropped']}")
    return float(most / none)


if __name__ == "__main__":
    sys.exit(main())
