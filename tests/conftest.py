"""Settings of the tests, and requirements on the machine."""

import atexit
import os
import shutil
import signal
import socket
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, nullcontext
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from skytether.shared.base import kernel
from skytether.shared.scenario.registry import PLUGIN_TABLES
from skytether.shell.commandline import plugins

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job ignores SIGINT, and so would every command that a test starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples are the same each time; `--hypothesis-profile=fresh` draws others. No deadlines, because
# the machine may be busy.
UNTIMED: dict[str, Any] = {
    "deadline": None,
    "suppress_health_check": [hypothesis.HealthCheck.too_slow],
}
hypothesis.settings.register_profile("same", derandomize=True, **UNTIMED)
hypothesis.settings.register_profile("fresh", derandomize=False, **UNTIMED)
hypothesis.settings.load_profile("same")
# Kernels do not check the types of their arguments; in tests every call is checked.
kernel.check_types()
# No flight of a test serves a page unless the test asks for one.
os.environ.setdefault("SKYTETHER_PAGE", "none")
# Tests share the cores; threads for matrices of a hundred rows would only spin.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests start hundreds of processes, which share compiled code.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A test must not find the saved state of another test's client.
_STATES = tempfile.mkdtemp(prefix="skytether-states-")
atexit.register(shutil.rmtree, _STATES, ignore_errors=True)
os.environ["XDG_STATE_HOME"] = _STATES


FIRST = (
    *("test_torture.py", "test_compare.py", "test_aboard.py", "test_margins.py"),
    *("test_missions.py", "test_adversary.py", "test_autopilot.py", "test_probe.py"),
    *("test_standby.py", "test_experiment.py", "test_docs.py"),
)
"""Slowest files: they start first, so that no worker waits for them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
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


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """A failure in real time says how late this machine woke a thread that only sleeps."""
    if item.get_closest_marker("realtime") is None:
        return (yield)
    from skytether.cli.fleet import metronome

    with metronome(0.01) as machine:
        try:
            return (yield)
        except BaseException as error:
            load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
            error.add_note(
                f"this machine: a thread that only sleeps was woken {machine.max_s:.3f} s late at "
                f"worst; load {load}"
            )
            raise


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give each test its own state folder, and skip tests that this machine cannot run."""
    os.environ["XDG_STATE_HOME"] = str(Path(_STATES) / f"{abs(hash(item.nodeid))}")
    _skip_without_ipv6(item)


def _skip_without_ipv6(item: pytest.Item) -> None:
    if item.get_closest_marker("ipv6") and not has_ipv6():
        pytest.skip("this machine has no IPv6")


class Here(Executor):
    """Executor that runs everything at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture(scope="module")
def here() -> Iterator[None]:
    from skytether.lab.commands import pool

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "_executor", lambda _: nullcontext(Here()))
        yield


@pytest.fixture
def unpainted() -> Iterator[None]:
    from helpers import without_painting

    with without_painting():
        yield


ALONE = ("realtime", "docker", "browser", "autopilot")
"""Marks of tests that run with nothing beside them."""


@pytest.fixture
def start(request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    """Start processes; those still running at the end of the test are killed."""
    from warm import Process

    marked = any(map(request.node.get_closest_marker, ALONE))
    assert marked, f"{request.node.name} starts processes: expected @pytest.mark.realtime"
    with ExitStack() as stack:
        yield partial(Process, stack)


@pytest.fixture
def plugin_tables() -> Iterator[None]:
    """Restore the tables that plug-ins extend."""
    # Each fills a table when it is first imported, which must not be within a test.
    for name in ("client.vehicles", "server.schemes.table", "server.mpc.plugin_planners"):
        import_module(f"skytether.{name}")
    before = [dict(table) for table in PLUGIN_TABLES]
    yield
    plugins._loaded.clear()
    for table, entries in zip(PLUGIN_TABLES, before, strict=True):
        table.clear()
        table.update(entries)
