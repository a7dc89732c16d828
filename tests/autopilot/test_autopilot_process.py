"""The scripted autopilot as a process: documented lines, addresses, refusals."""

import json
import re
import shlex
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from warm import Command, skytether

ROOT = Path(__file__).parents[2]
LINES = re.findall(
    r"^skytether (autopilot .*)$", (ROOT / "docs/fly-a-real-one.md").read_text(), re.MULTILINE
)


@contextmanager
def companion() -> Iterator[socket.socket]:
    """A socket of a companion computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.settimeout(20.0)
        yield own


def listening(command: Command) -> int:
    """Port at which it listens, once it does."""
    for line in command.stdout:
        said = json.loads(line)["event"]
        if said["type"] == "Listening":
            return int(said["port"])
    raise AssertionError("it has ended")


def heartbeat(own: socket.socket) -> object:
    """The next heartbeat that comes."""
    codec = Codec(255, 190)
    while True:
        for message in codec.decode(own.recv(2048)):
            if message.get_type() == "HEARTBEAT":
                return message


@pytest.mark.parametrize("line", LINES)
def test_a_documented_autopilot_is_one(line: str, tmp_path: Path) -> None:
    counted = tmp_path / "counted.json"
    with companion() as own:
        port = own.getsockname()[1]
        argv = shlex.split(re.sub(r"--to \S+", f"--to 127.0.0.1:{port}", line))
        if "--to" not in line:
            argv += ["--bind", "127.0.0.1:0"]
        with Command(*argv, "--log", "json", "--json", str(counted)) as command:
            at = listening(command)
            if "--to" not in line:
                beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
                own.sendto(Codec(255, 190).encode(beat), ("127.0.0.1", at))
            flavour = 12 if "px4" in line else 3
            assert heartbeat(own).autopilot == flavour  # type: ignore[attr-defined]
            command.send_signal(signal.SIGTERM)
            assert command.wait(20.0) == 0
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
def test_what_cannot_be_is_refused_in_a_line(argv: list[str], said: str) -> None:
    run = skytether("autopilot", *argv)
    assert run.returncode == 2
    assert said in run.stderr
    assert run.stderr.count("\n") == 1 or "--vehicle" in argv[0]


def test_an_insecure_one_may_be_reached() -> None:
    with Command("autopilot", "--bind", "0.0.0.0:0", "--insecure", "--log", "json") as command:
        assert listening(command)
        command.send_signal(signal.SIGTERM)
        assert command.wait(20.0) == 0
