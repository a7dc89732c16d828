"""Who flies the flights of a sweep: processes of this machine, or a Dask cluster."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Annotated, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import lab.sweep
from lab.journal import Journal
from lab.sweep import Done, Sweep, Task
from shell import command
from shell.command import CommandError
from shell.workers import die_with_parent

UNDER_WAY_MAX = 256
"""Tasks handed out at once: more than any machine has cores, and no more than need be."""
POLL_S = 0.2
"""How soon Ctrl-C is noticed."""
CONNECT_S = 10.0
"""How long a scheduler may take to answer."""

Workers = Annotated[int | None, tyro.conf.arg(metavar="N")]
Scheduler = Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")]
"""Two options of every command that has a pool."""

T = TypeVar("T")
R = TypeVar("R")


def check(workers: int | None, scheduler: str | None) -> None:
    """Refuse options that cannot be.

    Raises:
        CommandError: with what would do.
    """
    if workers is not None:
        command.check_count("--workers", workers, 1024)
        if scheduler:
            raise CommandError("--workers: got --scheduler as well, which has its own", 2)


@dataclass(slots=True)
class Spent:
    """What was flown by this command."""

    cpu_s: float = 0.0
    steps: int = 0
    """Of all vehicles."""
    runs: int = 0


@dataclass(slots=True)
class Crew:
    """Workers, and a bar that shows how far they are."""

    executor: Executor
    bar: Progress
    interrupted: Callable[[], bool]
    spent: Spent = field(default_factory=Spent)

    def fly(self, plan: Sweep, journal: Journal, title: str | None = None) -> None:
        """Fly what is not done of a sweep.

        Args:
            title: what is being done, for the bar.

        Raises:
            CommandError: interrupted, or a worker has died.
        """
        (row,) = self.bar.tasks
        todo = plan.todo(journal.done)
        before = len(plan.cells) * plan.runs - sum(len(task.seeds) for task in todo)
        self.bar.update(row.id, completed=row.completed + before, description=title)

        def on_done(_: Task, result: tuple[Done, float]) -> None:
            done, cpu_s = result
            journal.append(done)
            self.spent.cpu_s += cpu_s
            self.spent.steps += sum(run.steps for run in done.runs)
            self.spent.runs += len(done.runs)
            self.bar.update(row.id, advance=len(done.runs))

        if not share(self.executor, work, todo, on_done, self.interrupted):
            raise CommandError(
                f"interrupted with {row.completed:.0f} of {row.total:.0f} runs done; "
                "the same command goes on from here",
                128 + signal.SIGINT,
            )

    def flown(self, plan: Sweep, folder: Path, title: str) -> Mapping[tuple[int, int], Done]:
        """What is done of a sweep, and that is all of it; see `fly`.

        Args:
            folder: of its journal.
        """
        with closing(Journal(folder, plan, metadata.version("skytether"))) as journal:
            self.fly(plan, journal, title)
            return journal.done


@contextmanager
def crew(workers: int | None, scheduler: str | None, title: str, total: int) -> Iterator[Crew]:
    """A crew, with a bar on stderr; Ctrl-C ends its work in order.

    Args:
        total: runs that there are, done ones with them.
    """
    with (
        command.interruptible() as interrupted,
        executors(workers, scheduler) as executor,
        Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("runs"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            speed_estimate_period=600.0,
            disable=not sys.stderr.isatty(),
        ) as bar,
    ):
        bar.add_task(title, total=total)
        yield Crew(executor, bar, interrupted)


def share(
    executor: Executor,
    function: Callable[[T], R],
    items: Iterable[T],
    on_done: Callable[[T, R], None],
    stopped: Callable[[], bool],
) -> bool:
    """Have a function done for all items, in any order; False where it was told to stop.

    Raises:
        CommandError: a worker has died, or the cluster has gone.
    """
    waiting = iter(items)
    under_way: dict[Future[R], T] = {}
    while True:
        try:
            with _deaf():
                for item in islice(waiting, UNDER_WAY_MAX - len(under_way)):
                    under_way[executor.submit(function, item)] = item
            if not under_way:
                return True
            ready, _ = wait(under_way, POLL_S, FIRST_COMPLETED)
            for future in ready:
                on_done(under_way.pop(future), future.result())
        except BrokenExecutor:
            raise CommandError("a worker has died; the same command goes on from here") from None
        except CancelledError:
            raise CommandError("the scheduler has gone; the same command goes on") from None
        if stopped():
            return False


@contextmanager
def _deaf() -> Iterator[None]:
    """A worker that is started within it never hears Ctrl-C, which is for the command alone."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def work(task: Task) -> tuple[Done, float]:
    """Runs in a worker: its flights, and the CPU time they took [s]."""
    began_s = time.thread_time()
    return lab.sweep.fly(task), time.thread_time() - began_s


def executors(workers: int | None, scheduler: str | None) -> AbstractContextManager[Executor]:
    """Processes, one a core unless it is said how many, or a scheduler's workers."""
    if scheduler:
        return _cluster(scheduler)
    return _processes(workers or len(os.sched_getaffinity(0)))


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    """Processes of this machine, a core each; at the end nothing of them goes on."""
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
    """Runs in a worker, first."""
    die_with_parent()
    if os.getppid() != parent:  # it was gone before
        os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        message = "--scheduler: needs Dask: install skytether[cluster], here and on the workers"
        raise CommandError(message, command.CONFIGURATION) from None
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
