"""Requirements of the tests on the machine."""

import atexit
import fcntl
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from skytether.shared.base import kernel
from skytether.shared.scenario.registry import TABLES
from skytether.shell import plugins

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's job in the background ignores Ctrl-C, and so would every command that a test starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What is tested is the same each time; `--hypothesis-profile=fresh` draws other examples. No test
# looks at the time, for the machine may be busy.
UNTIMED: dict[str, Any] = {
    "deadline": None,
    "suppress_health_check": [hypothesis.HealthCheck.too_slow],
}
hypothesis.settings.register_profile("same", derandomize=True, **UNTIMED)
hypothesis.settings.register_profile("fresh", derandomize=False, **UNTIMED)
hypothesis.settings.load_profile("same")
# A kernel reads whatever it is handed as the types that it names: here every call is checked.
kernel.check_types()
# No flight of a test serves a page, unless the test asks for one.
os.environ.setdefault("SKYTETHER_PAGE", "none")
# Tests share the cores among themselves; threads for matrices of a hundred rows wait in loops.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests start hundreds of processes; none shall compile anew what another has.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# What a client keeps for its next life is not found by that of another test.
_STATES = tempfile.mkdtemp(prefix="skytether-states-")
atexit.register(shutil.rmtree, _STATES, ignore_errors=True)
os.environ["XDG_STATE_HOME"] = _STATES


FIRST = (
    *("test_observer.py", "test_docs.py", "test_together_autopilots.py", "test_aboard_udp.py"),
    *("test_plugins.py", "test_reproduce.py", "test_packaging.py", "test_environments.py"),
    *("test_command.py", "test_straight.py", "test_margins.py", "test_compare.py", "test_fleet.py"),
    *("test_trajectory.py", "test_kernel.py", "test_slow.py", "test_loopback.py"),
)
"""Files that take longest: they begin first, so that no other worker waits for them at the end."""


COMPILE = """
import skytether.quadrotor.loops, skytether.server.__main__, skytether.sim.flight
from skytether.shared.base import kernel
from skytether.shell import terminal
terminal.prepare(kernel.missing())
"""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what flies before the first test: flights over UDP wait for no compiler."""
    if not hasattr(session.config, "workerinput"):
        subprocess.run([sys.executable, "-P", "-c", COMPILE], check=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first."""
    place = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.name, len(FIRST)))


@cache
def has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
            sock.bind(("::1", 0))
    except OSError:
        return False
    return True


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give each test a state folder of its own, and skip those that this machine cannot run."""
    os.environ["XDG_STATE_HOME"] = str(Path(_STATES) / f"{abs(hash(item.nodeid))}")
    _skip_without_ipv6(item)


def _skip_without_ipv6(item: pytest.Item) -> None:
    if item.get_closest_marker("ipv6") and not has_ipv6():
        pytest.skip("this machine has no IPv6")


class Here(Executor):
    """Does everything in this process, which takes no time to begin."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture(scope="module")
def here() -> Iterator[None]:
    """Flights of the laboratory's commands are flown in this process, not in workers."""
    from skytether.lab.commands import pool

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "_executor", lambda _: nullcontext(Here()))
        yield


@pytest.fixture
def start() -> Iterator[Callable[..., Any]]:
    """Starts processes; what is still running at the end of the test is killed."""
    from warm import Process

    with ExitStack() as stack:
        yield partial(Process, stack)


@pytest.fixture
def documented_ports() -> Iterator[None]:
    """Wait until no other test uses the fixed ports of commands in the documents, and use them."""
    with (Path(tempfile.gettempdir()) / f"skytether-documented-ports-{os.getuid()}").open(
        "a"
    ) as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # ends with the file, whatever becomes of the process
        yield


@pytest.fixture
def plugin_tables() -> Iterator[None]:
    """Leave the tables that plug-ins extend as they were."""
    before = [dict(table) for table in TABLES]
    yield
    plugins._loaded.clear()
    for table, entries in zip(TABLES, before, strict=True):
        table.clear()
        table.update(entries)
