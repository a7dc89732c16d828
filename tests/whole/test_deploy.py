"""Units of systemd in `deploy/`: their commands, and that a vehicle never takes off by itself."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from helpers import ran
from skytether.client.__main__ import ClientOptions
from skytether.server.__main__ import ServerOptions
from skytether.shell.commandline import command

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
CLIENT, SERVER = UNITS / "skytether-client@.service", UNITS / "skytether-server.service"
BINARY = "/opt/skytether/bin/skytether"


def settings(unit: Path) -> dict[str, str]:
    text = re.sub(r"\\\n\s*", "", unit.read_text())
    return dict(re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE))


ONE, TWO = re.findall(r"^# LINKS=(.*)$", CLIENT.read_text(), re.MULTILINE)


def started(unit: Path, name: str, links: str = ONE) -> list[str]:
    """Arguments of the command that a unit starts, with an existing scenario."""
    text = settings(unit)["ExecStart"].replace("%i", "1").replace("$LINKS", links)
    words = shlex.split(text)
    assert words[:3] == [BINARY, name, "/etc/skytether/field.toml"]
    return ["demo", *words[3:]]


def test_the_client_starts_unarmed_and_as_a_flight_that_goes_on() -> None:
    """It is always restarted; only a person arms the vehicle."""
    options = command.parse(ClientOptions(), started(CLIENT, "client"), "client", "")
    assert not options.config.armed
    assert not options.new_flight
    assert options.control == Path("/run/skytether-1/client.sock")
    unit = settings(CLIENT)
    assert unit["Restart"] == "always"
    assert unit["StartLimitIntervalSec"] == "0"
    assert unit["RuntimeDirectory"] == "skytether-%i"
    assert unit["RuntimeDirectoryPreserve"] == "restart"
    assert unit["StateDirectory"] == "skytether"


def test_the_client_takes_several_links_and_a_standby_server() -> None:
    options = command.parse(ClientOptions(), started(CLIENT, "client", TWO), "client", "")
    assert options.path == ("wwan0=lab.example.org:47001", "wwan1=lab.example.org:47001")
    assert options.standby == ("other.example.org:47001",)


def test_the_server_keeps_what_was_set_where_it_outlives_the_computer() -> None:
    options = command.parse(ServerOptions(), started(SERVER, "server"), "server", "")
    assert not options.new_flight
    assert options.control
    assert str(options.control.parent) == f"/var/lib/{settings(SERVER)['StateDirectory']}"
    assert settings(SERVER)["Restart"] == "always"


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="this machine has no systemd")
@pytest.mark.parametrize("unit", [CLIENT, SERVER], ids=lambda unit: unit.name)
def test_systemd_finds_no_fault_with_a_unit(unit: Path, tmp_path: Path) -> None:
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace(BINARY, sys.executable))
    run = ran("systemd-analyze", "verify", "--man=no", copy)
    assert (run.returncode, unit.name in run.stderr) == (0, False), run.stderr
