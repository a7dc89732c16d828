"""The scripted autopilot as a process: documented lines, addresses, refusals."""

import json
import re
import shlex
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from helpers import refused
from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from warm import Process

ROOT = Path(__file__).parents[2]
LINES = re.findall(
    r"^skytether (autopilot .*)$", (ROOT / "docs/fly-a-real-one.md").read_text(), re.MULTILINE
)


@contextmanager
def companion() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.settimeout(180.0)
        yield own


def heartbeat(own: socket.socket) -> object:
    codec = Codec(255, 190)
    while True:
        for message in codec.decode(own.recv(2048)):
            if message.get_type() == "HEARTBEAT":
                return message


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize("line", LINES)
def test_a_documented_autopilot_is_one(
    line: str, start: Callable[..., Process], tmp_path: Path
) -> None:
    counted = tmp_path / "counted.json"
    with companion() as own:
        port = own.getsockname()[1]
        argv = shlex.split(re.sub(r"--to \S+", f"--to 127.0.0.1:{port}", line))
        if "--to" not in line:
            argv += ["--bind", "127.0.0.1:0"]
        autopilot = start(*argv, "--log", "json", "--json", str(counted))
        host, _, at = autopilot.address().partition(":")
        if "--to" not in line:
            beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
            own.sendto(Codec(255, 190).encode(beat), (host, int(at)))
        flavour = 12 if "px4" in line else 3
        assert heartbeat(own).autopilot == flavour  # type: ignore[attr-defined]
        assert autopilot.end() == 0
    assert json.loads(counted.read_text())["peers"] == 1


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--bind", "0.0.0.0:0"], "MAVLink has no keys: expected an address of 127.0.0.1"),
        (["--fault", "pilto@3"], "--fault: got 'pilto'; "),
        (["--fault", "pilot"], "--fault: got 'pilot', expected NAME@SECONDS"),
        (["--ready", "-1"], "--ready: got -1, expected 0 to 3600 s"),
        (["--to", "nowhere"], "--to: got 'nowhere', expected HOST:PORT"),
        (["--vehicle.battery", "2"], "battery"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(
    argv: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(["autopilot", *argv], capfd)


@pytest.mark.realtime
def test_an_insecure_one_may_be_reached(start: Callable[..., Process]) -> None:
    autopilot = start("autopilot", "--bind", "0.0.0.0:0", "--insecure", "--log", "json")
    assert autopilot.address().startswith("0.0.0.0:")
    assert autopilot.end() == 0
