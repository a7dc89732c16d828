"""Parallel studies: worker processes fly the cells of a study, and a journal stores the results.

A study is a list of cells and a function that flies and evaluates one cell (`Crew.study`). Stored
results are not flown again, Ctrl-C stops cleanly, and a bar shows the progress. The cells of a
sweep are its tasks; the cells of a search are the points of a generation. The workers are processes
on this machine, or of a Dask cluster.
"""

import signal
import time
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar

import skytether.lab.engine.sweep
from skytether.lab.engine.journal import StudyJournal, name_of
from skytether.lab.engine.search import Point, Search, SearchPoint, Values, best
from skytether.lab.engine.sweep import Results, Runs, Sweep
from skytether.server.schemes import loading
from skytether.shared.base import kernel, machine_code
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command, plugins, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.plugins import Plugin
from skytether.shell.commandline.terminal import Bar
from skytether.shell.host import system
from skytether.shell.processes.pool import processes

UNDER_WAY_MAX = 256
"""Largest number of tasks submitted at a time; larger than the number of cores of any machine."""
POLL_S = 0.2
CONNECT_S = 10.0

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Flags:
    """Options of every command that has a pool."""

    workers: Annotated[int | None, Argument(metavar="N")] = None
    """Number of worker processes; by default one per core."""
    scheduler: Annotated[str | None, Argument(metavar="tcp://HOST:PORT")] = None
    """Address of a Dask scheduler, whose workers fly instead of processes of this machine."""
    plugin: command.Plugins = ()

    def check(self) -> None:
        """Raise CommandError, with the accepted values, if the options are invalid."""
        if self.workers is not None:
            command.check_count("--workers", self.workers, 1024)
            if self.scheduler:
                raise CommandError("--workers: got --scheduler as well, with its own workers", 2)


PoolFlags = Annotated[Flags, Argument(name="")]


class Interrupted(CommandError):
    """Interrupted by Ctrl-C; the same command continues the work."""

    def __init__(self, done: float, total: float, unit: str) -> None:
        message = f"interrupted with {done:.0f} of {total:.0f} {unit} done"
        super().__init__(f"{message}; the same command goes on from here", command.INTERRUPTED)
        self.results: Mapping[Any, Any] = {}
        """Results of the study before the interruption."""


@dataclass(slots=True)
class Crew:
    executor: Executor
    bar: Bar
    total: float
    unit: str
    interrupted: Callable[[], bool]
    done: float = 0.0
    cpu_s: float = 0.0
    runs: int = 0
    """Number of flights that this command has flown for sweeps; stored flights do not count."""
    fresh: list[Any] = field(default_factory=list)
    """Results that this command has computed; stored results are not included."""

    def advance(self, amount: float, text: str = "") -> None:
        self.done += amount
        self.bar(self.done, text)

    def study(
        self,
        fly: Callable[[T], R],
        cells: Mapping[K, T],
        kind: Any = None,
        settings: Mapping[str, Any] = MappingProxyType({}),
        out: Path | None = None,
        *,
        size: Callable[[T], float] = lambda _: 1.0,
        tell: Callable[[Collection[R]], str] = lambda _: "",
    ) -> dict[K, R]:
        """Fly the missing cells of a study; returns the results of all cells, in order.

        Args:
            fly: function that flies a cell and evaluates the flight; called in a worker.
            cells: the cells, by their keys in the journal.
            kind: type of a result, for decoding the journal; only needed with a folder.
            settings: all settings that determine the results, besides the cells.
            out: folder of the journal; None: results are not stored.
            size: amount of work of a cell, in the progress bar's unit.
            tell: function that returns the text of the progress bar from all results so far.

        Raises:
            CommandError: interrupted (with the results so far), or a worker has died.
            ConfigError: the folder has the results of other settings.
            OSError: the folder cannot be written.
        """
        with closing(StudyJournal(out, settings, kind)) as journal:
            names = {key: name_of(key) for key in cells}
            results = {
                k: journal.results[name] for k, name in names.items() if name in journal.results
            }
            self.advance(sum(size(cells[key]) for key in results), tell(results.values()))
            todo = [key for key in cells if key not in results]

            def keep(number: int, result: tuple[R, float]) -> None:
                key = todo[number]
                results[key], cpu_s = result
                journal.add(names[key], results[key])
                self.cpu_s += cpu_s
                self.fresh.append(results[key])
                self.advance(size(cells[key]), tell(results.values()))

            try:
                if todo:
                    self.share(partial(_work, fly), [cells[key] for key in todo], keep)
            except Interrupted as interrupted:
                interrupted.results = results
                raise
        return {key: results[key] for key in cells}

    def map(self, fly: Callable[[T], R], items: Sequence[T]) -> list[R]:
        """Results of a function for all items, in order. The progress bar counts no items."""
        return list(self.study(fly, dict(enumerate(items)), size=lambda _: 0.0).values())

    def sweep(self, plan: Sweep, out: Path, text: str = "") -> Results:
        """Results of all tasks of a sweep; storage and errors are those of `study`."""
        tasks, before = {(task.cell, task.chunk): task for task in plan.tasks()}, len(self.fresh)
        results = self.study(
            skytether.lab.engine.sweep.fly,
            tasks,
            Runs,
            plan.settings(),
            out,
            size=lambda task: len(task.seeds),
            tell=lambda _: text,
        )
        self.runs += sum(map(len, self.fresh[before:]))
        return results

    def search(
        self, search: Search, out: Path, generations: int, text: str = ""
    ) -> Iterator[list[SearchPoint]]:
        """Yield all points so far after each generation of a search; errors as in `study`."""

        def fly_all(cells: Mapping[Point, Scenario]) -> Mapping[Point, Values]:
            kind, settings = dict[str, dict[str, float | None]], search.settings()
            return self.study(search.fly, cells, kind, settings, out, size=lambda _: 0.0)

        for points in search.points(generations, fly_all):
            self.advance(1, f"{text}best {best(points).score:.4f}")
            yield points

    def share(
        self, function: Callable[[T], R], items: Sequence[T], on_done: Callable[[int, R], None]
    ) -> None:
        """Run a function for all items in the workers, in any order.

        Args:
            on_done: called in this process with the number of an item and its result.

        Raises:
            CommandError: interrupted, a worker has died, or the cluster is lost.
        """
        waiting = iter(enumerate(items))
        equipped = partial(_equipped, function, plugins.loaded())
        under_way: dict[Future[R], int] = {}
        while True:
            try:
                with system.blocked(signal.SIGINT):
                    for number, item in islice(waiting, UNDER_WAY_MAX - len(under_way)):
                        under_way[self.executor.submit(equipped, item)] = number
                if not under_way:
                    return
                ready, _ = wait(under_way, POLL_S, FIRST_COMPLETED)
                for future in sorted(ready, key=under_way.__getitem__):
                    on_done(under_way.pop(future), future.result())
            except BrokenExecutor:
                died = "a worker has died; the same command goes on from here"
                raise CommandError(died) from None
            except CancelledError:
                gone = "the scheduler has gone; the same command goes on from here"
                raise CommandError(gone) from None
            if self.interrupted():
                raise Interrupted(self.done, self.total, self.unit)


@contextmanager
def crew(flags: Flags, title: str, total: float, unit: str = "runs") -> Iterator[Crew]:
    """Workers, and a progress bar on stderr that counts up to `total`; Ctrl-C stops the workers
    cleanly.
    """
    if not flags.scheduler:  # Compile now: otherwise every worker would compile all kernels.
        loading.load_all()
        terminal.prepare(machine_code.missing())
    with (
        command.interruptible() as interrupted,
        _executor(flags) as executor,
        terminal.progress(title, total, unit) as bar,
    ):
        yield Crew(executor, bar, total, unit, interrupted)


def study(
    fly: Callable[[T], R],
    cells: Sequence[T],
    kind: type[R],
    settings: Mapping[str, Any],
    out: Path | None,
    flags: Flags,
    title: str = "flying",
    unit: str = "flights",
) -> list[R]:
    """Fly the only study of a command; returns the results in order, see `Crew.study`.

    Args:
        cells: items to fly, which are also the keys in the journal; a later call may add items.

    Raises:
        CommandError: interrupted, a worker has died, or the folder cannot be written.
        ConfigError: the folder has the results of other settings.
    """
    with writing(out), crew(flags, title, len(cells), unit) as flyers:
        return list(flyers.study(fly, {cell: cell for cell in cells}, kind, settings, out).values())


@contextmanager
def writing(out: Path | None) -> Iterator[None]:
    """Replace an OSError of the block by a CommandError that names the file or folder."""
    try:
        yield
    except OSError as error:
        raise CommandError(f"{error.filename or out}: {error.strerror or error}") from None


def _equipped(function: Callable[[T], R], plugged: tuple[Plugin, ...], item: T) -> R:
    """Result of a function for an item; called in a worker, which first loads the plug-ins.

    Plug-ins are passed with their content: a worker may be on another machine or start later, and
    edits of a file after the start must have no effect.
    """
    plugins.use(plugged)
    return function(item)


def _work(fly: Callable[[T], R], item: T) -> tuple[R, float]:
    kernel.load()
    began_s = time.thread_time()
    result = fly(item)
    return result, time.thread_time() - began_s


def _executor(flags: Flags) -> AbstractContextManager[Executor]:
    if flags.scheduler:
        return _cluster(flags.scheduler)
    if flags.workers == 0:
        return _thread()
    return processes(flags.workers or system.cores())


@contextmanager
def _thread() -> Iterator[Executor]:
    """Executor with one thread of this process, which has the user's registered plug-ins."""
    pool = ThreadPoolExecutor(1)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise CommandError(f"--scheduler: {address} cannot be reached: {error}") from None
    with client:
        ours = metadata.version("skytether")
        try:
            theirs = client.run(metadata.version, "skytether")
        except ModuleNotFoundError as error:
            raise CommandError(f"--scheduler: {address}: its workers lack skytether") from error
        for worker, version in theirs.items():
            if version != ours:
                other = f"{worker} has skytether {version}, expected {ours}"
                raise CommandError(f"--scheduler: {address}: {other}")
        yield client.get_executor(pure=False)
