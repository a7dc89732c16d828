"""Processes as children: what is known of one is what it says, as events; and its last words."""

import asyncio
import os
import signal
from typing import cast

import msgspec
import pytest

from shared.events import (
    Counted,
    Event,
    Finished,
    FlowOpened,
    Flying,
    Listening,
    ModeChanged,
    Plaintext,
    RecordIncomplete,
)
from shell.command import CommandError
from shell.log import Line
from skytether.fly import _tell
from skytether.processes import Child, _read, started


async def test_a_child_is_known_by_its_events() -> None:
    """It listens where its first event says, and counts at its end, which is no last word."""
    heard: list[Event] = []
    argv = ("demo", "--bind", "0.0.0.0:0", "--insecure")
    async with started("server", *argv, on_event=heard.append) as server:
        host, port = server.address
        assert (host, port > 0) == ("0.0.0.0", True)
    assert [type(event) for event in heard] == [Listening, Plaintext, Counted]
    assert server.process.returncode == 0
    assert server.last_words().startswith("server: PLAINTEXT, no keys: anybody on the network")


@pytest.mark.ipv6
async def test_a_child_may_listen_on_ipv6() -> None:
    """Its address is a host and a port, as of any other."""
    argv = ("demo", "--bind", "[::1]:0", "--server", "[::1]:9")
    async with started("netem", *argv) as netem:
        assert netem.address[0] == "::1"


async def test_a_child_that_cannot_start_says_why() -> None:
    """In the one line that it would have for a user."""
    with pytest.raises(CommandError, match=r"netem: papr: no such scenario; did you mean paper\?"):
        async with started("netem", "papr"):
            pass


async def test_a_child_that_is_killed_leaves_its_last_event() -> None:
    """Nothing else is known of it."""
    async with started("netem", "demo", "--bind", "127.0.0.1:0") as netem:
        os.kill(netem.process.pid, signal.SIGKILL)
        assert await netem.process.wait() == -signal.SIGKILL
    assert netem.last_words().startswith("netem: listening on 127.0.0.1:")


async def test_a_child_whose_record_is_incomplete_has_told_so() -> None:
    """It is no failure of the child, which goes on and ends with 1."""
    heard: list[Event] = []
    argv = ("demo", "--bind", "127.0.0.1:0", "--record", "/dev/full")
    async with started("netem", *argv, on_event=heard.append) as netem:
        pass
    assert RecordIncomplete(file="/dev/full", reason="No space left on device") in heard
    assert (netem.fell_short, netem.failed, netem.process.returncode) == (True, False, 1)
    assert (
        netem.last_words() == "netem: /dev/full: No space left on device: 0 of 0 rows are recorded"
    )


async def test_a_line_without_end_hides_nothing_that_follows() -> None:
    """Whatever a child prints, what it says later is heard."""
    heard: list[Event] = []
    stream = asyncio.StreamReader(limit=1000)
    event = Flying(vehicle=1)
    line = msgspec.json.encode(Line(process="client", time_ns=5, event=event))
    stream.feed_data(b"x" * 5000 + b"\n" + line + b"\n")
    stream.feed_eof()
    process = cast(asyncio.subprocess.Process, None)
    await _read(Child("client", process), stream, heard.append)
    assert heard == [event]


def test_a_flight_shows_what_happens_to_its_server_and_nothing_else(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """On stderr, where the progress bar is."""
    shown = [
        ModeChanged(vehicle=1, before="track", after="brake", reason="the server is silent"),
        RecordIncomplete(file="netem", reason="No space left on device"),
    ]
    quiet = [
        Flying(vehicle=1),
        FlowOpened(flow=0, host="::1", port=1),
        Counted(figures={}),
        Finished(vehicle=1, steps=1, missed=0),
    ]
    for event in (*shown, *quiet):
        _tell(event)
    said = capfd.readouterr()
    assert said.err.splitlines() == [str(event) for event in shown]
    assert said.out == ""
