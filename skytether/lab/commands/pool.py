"""Core of every study: flights in workers, kept in a journal, with a bar, Ctrl-C and resuming.

A study of numbered cells is `study`: cells and a function that flies and judges one. Sweeps and
searches (`Crew.fly`, `Crew.search`) pin their files besides. The workers are processes of this
machine, or a Dask cluster.
"""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

import skytether.lab.sweep
from skytether.lab.journal import Journal
from skytether.lab.search import Generation, Search, SearchPoint, best
from skytether.lab.sweep import Done, FlightTask, Results, Sweep
from skytether.shared.base import kernel
from skytether.shell import command, plugins, temporary, terminal
from skytether.shell.command import CommandError
from skytether.shell.plugins import Plugin
from skytether.shell.terminal import Bar
from skytether.shell.workers import die_with_parent

UNDER_WAY_MAX = 256
"""Most tasks handed out at once: more than any machine has cores."""
POLL_S = 0.2
"""Interval at which Ctrl-C is checked [s]."""
CONNECT_S = 10.0
"""Time that a scheduler may take to answer [s]."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Flags:
    """Options of every command that has a pool."""

    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Number of worker processes; one per core unless given."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Address of a Dask scheduler, whose workers fly instead of processes of this machine."""
    plugin: Annotated[
        command.Plugins,
        tyro.conf.arg(
            metavar="FILE",
            help="Python file with triggers or references of one's own; may come several times.",
        ),
        tyro.conf.UseAppendAction,  # `read` tells tyro of the outermost record's annotations alone
    ] = ()

    def check(self) -> None:
        """Refuse impossible options.

        Raises:
            CommandError: with the values that are accepted.
        """
        if self.workers is not None:
            command.check_count("--workers", self.workers, 1024)
            if self.scheduler:
                raise CommandError("--workers: got --scheduler as well, which has its own", 2)


PoolFlags = Annotated[Flags, tyro.conf.arg(name="")]


class Interrupted(CommandError):
    """Error: interrupted by Ctrl-C; the same command continues the work."""

    def __init__(self, done: float, total: float, unit: str) -> None:
        said = f"interrupted with {done:.0f} of {total:.0f} {unit} done"
        super().__init__(f"{said}; the same command goes on from here", command.INTERRUPTED)


@dataclass(slots=True)
class Spent:
    """Resources used by this command."""

    cpu_s: float = 0.0
    """CPU time of the workers [s]."""
    steps: int = 0
    """Number of steps flown, of all vehicles."""
    runs: int = 0
    """Number of flights."""


@dataclass(slots=True)
class Crew:
    """Workers, with a progress bar."""

    executor: Executor
    bar: Bar
    total: float
    """Amount of work in total, in the unit."""
    unit: str
    """Unit of the work."""
    interrupted: Callable[[], bool]
    done: float = 0.0
    """Amount of finished work."""
    spent: Spent = field(default_factory=Spent)

    def advance(self, amount: float, text: str = "") -> None:
        """Count finished work, and show it."""
        self.done += amount
        self.bar(self.done, text)

    def fly(self, plan: Sweep, journal: Journal[Done], text: str = "") -> None:
        """Fly the missing tasks of a sweep.

        Args:
            text: text of the bar.

        Raises:
            CommandError: interrupted, or a worker has died.
        """
        todo = plan.todo(skytether.lab.sweep.results(journal.entries))
        before = plan.flights - sum(len(task.seeds) for task in todo)
        self.advance(before, text)

        def keep(_: int, result: tuple[Done, float]) -> None:
            done, cpu_s = result
            journal.append(done)
            self.spent.cpu_s += cpu_s
            self.spent.steps += sum(run.steps for run in done.runs)
            self.spent.runs += len(done.runs)
            self.advance(len(done.runs), text)

        self.share(work, todo, keep)

    def flown(self, plan: Sweep, folder: Path, text: str) -> Results:
        """All results of a sweep, after flying the missing tasks; see `fly`.

        Args:
            folder: folder of the sweep's journal.
        """
        with closing(Journal(folder, plan.settings(), Done)) as journal:
            self.fly(plan, journal, text)
            return skytether.lab.sweep.results(journal.entries)

    def search(
        self, search: Search, journal: Journal[Generation], generations: int, text: str = ""
    ) -> list[SearchPoint]:
        """All points of a search, after flying the missing ones.

        Args:
            text: text of the bar, before the best score.

        Raises:
            CommandError: interrupted, or a worker has died.
            ConfigError: the journal is another search's.
        """
        points: list[SearchPoint] = []
        for points in search.points(journal, generations, self.map):
            self.advance(1, f"{text}best {best(points).score:.4f}")
        return points

    def map(self, function: Callable[[T], R], items: Sequence[T], amount: float = 0.0) -> list[R]:
        """Results of a function for all items, in order; see `share`.

        Args:
            amount: amount of work that an item is, in the unit.
        """
        results: dict[int, R] = {}

        def keep(number: int, result: R) -> None:
            results[number] = result
            self.advance(amount)

        self.share(function, items, keep)
        return [results[number] for number in range(len(items))]

    def share(
        self, function: Callable[[T], R], items: Sequence[T], on_done: Callable[[int, R], None]
    ) -> None:
        """Run a function for all items in the workers, in any order.

        Args:
            on_done: called with the number of an item and its result.

        Raises:
            CommandError: interrupted, a worker has died, or the cluster is lost.
        """
        waiting = iter(enumerate(items))
        equipped = partial(_equipped, function, plugins.loaded())
        under_way: dict[Future[R], int] = {}
        while True:
            try:
                with _deaf():
                    for number, item in islice(waiting, UNDER_WAY_MAX - len(under_way)):
                        under_way[self.executor.submit(equipped, item)] = number
                if not under_way:
                    return
                ready, _ = wait(under_way, POLL_S, FIRST_COMPLETED)
                for future in ready:
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
    """Workers with a bar on stderr; Ctrl-C ends their work in order.

    Args:
        total: amount of work in total, including finished work, in the unit.
    """
    if not flags.scheduler:  # compile now: otherwise each worker would compile all kernels
        terminal.prepare(kernel.missing())
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
    """Results of all cells of a study, in order, after flying the missing ones.

    Args:
        fly: flies a cell, and judges the flight; called in a worker.
        cells: what is flown; the same folder may be given more cells later, at the end.
        kind: type of a result.
        settings: all that the results follow from, but for the number of a cell.
        out: folder of the journal; None: nothing is kept.
        title, unit: for the bar.

    Raises:
        CommandError: interrupted, a worker has died, or the folder cannot be written.
        ConfigError: the folder has the results of other settings.
    """
    with temporary.folder() as folder:
        place = out or folder / "study"
        with writing(place), closing(Journal(place, settings, tuple[int, kind])) as journal:  # type: ignore[valid-type]
            done = {number for number, _ in journal.entries}
            todo = [number for number in range(len(cells)) if number not in done]
            with crew(flags, title, len(cells), unit) as flyers:
                flyers.advance(len(cells) - len(todo))

                def keep(index: int, result: R) -> None:
                    journal.append((todo[index], result))
                    flyers.advance(1)

                flyers.share(fly, [cells[number] for number in todo], keep)
            results = dict(journal.entries)
            return [results[number] for number in range(len(cells))]


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn an OSError within the block into one line that names the file or folder.

    Raises:
        CommandError: the block raised an OSError.
    """
    try:
        yield
    except OSError as error:
        raise CommandError(f"{error.filename or out}: {error.strerror or error}") from None


@contextmanager
def _deaf() -> Iterator[None]:
    """Start workers with SIGINT ignored: Ctrl-C is for the command alone."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _equipped(function: Callable[[T], R], plugged: tuple[Plugin, ...], item: T) -> R:
    """Result of a function for an item; called in a worker, which first loads the plug-ins.

    Plug-ins are passed with their content: a worker may be on another machine, or be started later,
    and edits of a file after the start must have no effect.
    """
    plugins.use(plugged)
    return function(item)


def work(task: FlightTask) -> tuple[Done, float]:
    """Result of a task, and its CPU time [s]; called in a worker."""
    kernel.load()
    began_s = time.thread_time()
    done = skytether.lab.sweep.fly(task)
    return done, time.thread_time() - began_s


def _executor(flags: Flags) -> AbstractContextManager[Executor]:
    if flags.scheduler:
        return _cluster(flags.scheduler)
    return _processes(flags.workers or len(os.sched_getaffinity(0)))


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    """Worker processes on this machine, one per core; all have ended at the end of the block."""
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _start, (os.getpid(),))
    before = set(multiprocessing.active_children())
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _start(parent: int) -> None:
    """Initialise a worker, which ends with the command."""
    die_with_parent()
    if os.getppid() != parent:  # the command had ended before
        os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """Workers of a Dask scheduler."""
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
            raise CommandError(f"--scheduler: {address}: its workers have no skytether") from error
        for worker, version in theirs.items():
            if version != ours:
                other = f"{worker} has skytether {version}, expected {ours}"
                raise CommandError(f"--scheduler: {address}: {other}")
        yield client.get_executor(pure=False)
