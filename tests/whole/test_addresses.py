"""Addresses of a session: a server at several of them, and a client with a local one."""

from collections.abc import Callable

import pytest

import warm
from skytether.shared.events.flight import SessionOpened
from warm import Process

QUICK = ("--settle", "0", "--duration", "2")


@pytest.mark.realtime
def test_a_server_listens_at_two_addresses(start: Callable[..., Process]) -> None:
    server = start("server", "demo", "--bind", "127.0.0.1:0", "--bind", "127.0.0.2:0", *QUICK)
    hosts = [server.address().partition(":")[0] for _ in range(2)]
    assert hosts == ["127.0.0.1", "127.0.0.2"]
    assert server.end() == 0


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize("local", ["127.0.0.2", "lo", ""])
def test_a_client_flies_over_the_path_that_it_is_given(
    local: str, start: Callable[..., Process]
) -> None:
    server = start("server", "demo", "--bind", "127.0.0.1:0", *QUICK, "--log", "json")
    run = warm.skytether("client", "demo", "--path", f"{local}={server.address()}", *QUICK)
    assert run.returncode == 0, run.stderr
    assert server.end() == 0
    (opened,) = [event for event in server.events() if isinstance(event, SessionOpened)]
    assert opened.host == (local if local.startswith("127") else "127.0.0.1")


@pytest.mark.long
@pytest.mark.realtime
def test_a_client_flies_over_two_paths_to_two_addresses(start: Callable[..., Process]) -> None:
    """One of the paths is absent: nobody has its interface."""
    server = start("server", "demo", "--bind", "127.0.0.1:0", "--bind", "127.0.0.2:0", *QUICK)
    one, two = server.address(), server.address()
    for paths in (("none-here=" + one, "=" + two), ("=" + one, "none-here=" + two)):
        flags = [word for path in paths for word in ("--path", path)]
        run = warm.skytether("client", "demo", *flags, *QUICK)
        assert run.returncode == 0, run.stderr
    assert server.end() == 0
