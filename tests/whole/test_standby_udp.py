"""A standby server over real UDP: a server's process dies, or an operator hands over."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from helpers import packaged, until
from skytether.__main__ import main
from skytether.shared.events.flight import Changed, ChangeRefused
from skytether.shared.events.processes import HostMissing, Listening
from skytether.shared.events.standby import LeaderChanged
from skytether.sim.flight import fly
from warm import Process

FLIGHT = ("--network.uplink", "none", "--network.downlink", "none", "--settle", "0")
PATIENT = ("--link.timeout-s", "4")
"""Patience for a busy machine."""


def children(pid: int) -> Iterator[tuple[int, list[str]]]:
    """Children of a process and their command lines."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        for child in (thread / "children").read_text().split():
            yield int(child), Path(f"/proc/{child}/cmdline").read_text().split("\0")


@pytest.mark.long
@pytest.mark.realtime
def test_fly_goes_on_without_the_server_that_was_killed(
    start: Callable[..., Process], tmp_path: Path
) -> None:
    folder, summary = tmp_path / "flying", tmp_path / "summary.json"
    argv = ("fly", "demo", "--standby", "--secure", "--no-page", "--duration", "20", *FLIGHT)
    run = start(*argv, *PATIENT, "--control", str(folder), "--json", str(summary))
    until((folder / "client").exists)
    names = {path.name for path in folder.iterdir() if not path.name.endswith(".feed")}
    assert {"server", "server 2", "netem", "netem 2", "client"} <= names
    for name in ("standby", "server"):  # refused until it is heard
        until(lambda name=name: main(["set", str(folder / "client"), f"link.leader={name}"]) == 0)
    (server,) = [pid for pid, argv in children(run.popen.pid) if f"{folder}/server" in argv]
    os.kill(server, signal.SIGKILL)
    assert run.ended() == 0, run.said
    said = "\n".join(run.said)
    assert "server: ended by a signal: Killed; the flight goes on without server" in said
    assert "leads it now (leadership 3)" in said
    assert json.loads(summary.read_text())["covered"] > 0.0


@pytest.mark.long
@pytest.mark.realtime
def test_a_standby_that_cannot_be_found_costs_nothing(start: Callable[..., Process]) -> None:
    server = start("server", "demo", "--bind", "127.0.0.1:0", *PATIENT)
    client = start(
        *("client", "demo", "--server", server.address(), "--standby", "ground.invalid:1"),
        *("--insecure", "--log", "json", "--duration", "4", "--settle", "0", *PATIENT),
    )
    assert client.ended() == 0, client.said
    events = [each for each in client.events() if isinstance(each, HostMissing)]
    assert [each.host for each in events] == ["ground.invalid"]
    listening = next(each for each in client.events() if isinstance(each, Listening))
    assert listening.waiting_for.endswith(", or the standby server at ground.invalid:1")
    assert server.end() == 0


def test_a_server_is_named_as_leader_and_stays_it() -> None:
    """A standby server speaks rarely; its silence before it was named does not count."""
    changes = [(7.3, {"link.leader": "standby"}), (13.0, {"link.leader": "server"})]
    flight = fly(packaged("demo", duration=20.0), standby=True, secure=True, changes=changes)
    events = [each for each in flight.events if isinstance(each.event, LeaderChanged)]
    assert [(each.time_ns / 1e9, each.event.number) for each in events] == [(7.3, 1), (13.0, 2)]
    assert not [each for each in flight.events if getattr(each.event, "after", None) == "brake"]


@pytest.mark.parametrize(
    ("standby", "reason"),
    [
        (False, "link.leader: got 'standby', expected 'server' without a standby server"),
        (True, "link.leader: got 'standby', but the server at netem 1/2:0 is unreachable"),
    ],
)
def test_a_server_that_is_not_heard_is_not_made_the_leader(standby: bool, reason: str) -> None:
    flown = packaged("demo", duration=8.0)
    lost = [(0.0, lambda world: world.stop("standby"))] if standby else []
    changes = [(6.0, {"link.leader": "standby"})]
    flight = fly(flown, standby=standby, changes=changes, actions=lost)
    (refused,) = [each.event for each in flight.events if isinstance(each.event, ChangeRefused)]
    assert refused.reason == reason
    assert not [each for each in flight.events if isinstance(each.event, Changed | LeaderChanged)]
