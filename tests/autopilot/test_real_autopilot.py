"""Real autopilots in simulation, if the environment names their programs.

    ARDUCOPTER=…/build/sitl/bin/arducopter    ArduCopter's own simulator
    PX4=…/build/px4_sitl_default              PX4's folder, with its built-in simulator SIH

Each flies over the paper's network, encrypted, from take-off to landing. `ARDUCOPTER_DEFAULTS` may
name a file of parameters that replaces the tree's own.
"""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest

from skytether.cli.processes import Child, started
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.shared.events.flight import Flying, ModeChanged
from skytether.shared.events.flight import address_text as text
from skytether.shared.scenario.reading import check, to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import Rows
from skytether.shell.processes.log import LogLine

pytestmark = [pytest.mark.autopilot, pytest.mark.timeout(300)]

ARDUCOPTER, PX4 = (os.environ.get(name, "") for name in ("ARDUCOPTER", "PX4"))
needs_arducopter = pytest.mark.skipif(
    not ARDUCOPTER, reason="needs ARDUCOPTER=, the path of ArduCopter's simulator"
)
needs_px4 = pytest.mark.skipif(not PX4, reason="needs PX4=, the folder of PX4's build for SITL")
SETTLE_S = 12.0
PLACE = "GLOBAL_POSITION_INT"


def scenario(line: str, **model: object) -> Scenario:
    return check(
        {
            "duration": 45.0,
            "settle": SETTLE_S,
            "model": {"axes": 3, "u_max": [3.0], **model},
            "control": {"horizon": 80},
            "reference": {
                "shape": "figure-eight",
                "radius_m": 5.0,
                "period_s": 30.0,
                "altitude_m": 5.0,
            },
            "vehicle": {"kind": "mavlink", "address": line},
            "fence": {"low_m": [-8.0, -8.0, 2.0], "high_m": [8.0, 8.0, 9.0], "wind_mps": 0.5},
        },
        "test",
    )


OF_ARDUCOPTER = {"tau_s": [0.47, 0.47, 0.21], "dead_time_s": [0.27, 0.27, 0.24]}


@contextlib.asynccontextmanager
async def arducopter(folder: Path) -> AsyncIterator[None]:
    """ArduCopter's simulator, with a second line at 127.0.0.1:14651 for a listener."""
    tree = Path(ARDUCOPTER).resolve().parents[3]
    usual = tree / "Tools" / "autotest" / "default_params" / "copter.parm"
    defaults = os.environ.get("ARDUCOPTER_DEFAULTS", str(usual))
    argv = [ARDUCOPTER, "--wipe", "--model", "quad", "--speedup", "1", "--defaults", defaults]
    argv += ["--home", "-35.363261,149.165230,584,353", "--serial0", "udpclient:127.0.0.1:14650"]
    argv += ["--serial1", "udpclient:127.0.0.1:14651", "--serial2", "none:x"]
    process = await asyncio.create_subprocess_exec(
        *argv,
        cwd=folder,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


class Heard(asyncio.DatagramProtocol):
    def __init__(self) -> None:
        self._codec = Codec(254, 190)
        self.newest: dict[str, Message] = {}
        self._transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, address: object) -> None:
        if PLACE not in self.newest and self._transport is not None:
            asked = dialect.MAVLink_command_long_message(
                1,
                1,
                dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
                0,
                dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
                200_000,
                0,
                0,
                0,
                0,
                0,
            )
            self._transport.sendto(self._codec.encode(asked), address)
        for message in self._codec.decode(data):
            self.newest[message.get_type()] = message


async def command(*argv: str) -> asyncio.subprocess.Process:
    skytether = (sys.executable, "-P", "-m", "skytether")
    return await asyncio.create_subprocess_exec(
        *skytether, *argv, stdout=asyncio.subprocess.DEVNULL
    )


async def until(so: Callable[[], bool], seconds: float) -> None:
    async with asyncio.timeout(seconds):
        while not so():
            await asyncio.sleep(0.1)


class Flight:
    def __init__(self, folder: Path, flown: Scenario) -> None:
        self.folder, self.flown = folder, flown
        self.said: list[LogLine] = []

    def events(self, kind: type) -> list[object]:
        return [line.event for line in self.said if isinstance(line.event, kind)]

    @contextlib.asynccontextmanager
    async def begun(self) -> AsyncIterator[tuple[Child, Child]]:
        file, keys = self.folder / "scenario.toml", str(self.folder / "keys")
        file.write_bytes(to_toml(self.flown))
        made = await command("keygen", keys)
        assert await made.wait() == 0
        anywhere = ("--bind", "127.0.0.1:0")
        control = ("--control", str(self.folder / "netem.sock"))
        async with (
            started("server", str(file), *anywhere, "--keys", keys) as server,
            started(
                "netem", str(file), *anywhere, *control, "--server", text(*server.address)
            ) as netem,
            started(
                "client",
                str(file),
                "--server",
                text(*netem.address),
                "--keys",
                keys,
                "--set-parameters",
                "--record",
                str(self.folder / "client"),
                on_event=self.said.append,
            ) as client,
        ):
            yield client, netem

    def rows(self) -> Rows:
        return parse((self.folder / "client").read_bytes())

    def rmse_m(self) -> float:
        rows = self.rows()
        times = rows["step"] * self.flown.control.dt
        wanted = self.flown.make_reference()(times)[:, :2, 0]
        error = np.linalg.norm(rows["state"][:, :2, 0] - wanted, axis=1)[times > SETTLE_S]
        return float(np.sqrt(np.mean(error**2)))


@needs_arducopter
async def test_arducopter_flies_a_figure_eight_over_the_papers_network(tmp_path: Path) -> None:
    """With set-points sent directly at 20 Hz by the law `lead` the error is 0.055 m."""
    flight = Flight(tmp_path, scenario("udp:127.0.0.1:14650", **OF_ARDUCOPTER))
    async with arducopter(tmp_path), flight.begun() as (client, _):
        assert await asyncio.wait_for(client.end(), 200.0) == 0
    assert flight.rmse_m() < 0.1


@needs_arducopter
async def test_arducopter_stands_where_its_client_is_killed(tmp_path: Path) -> None:
    """After SIGKILL no velocities are sent, and ArduCopter's own timeout stops the vehicle."""
    heard = Heard()
    loop = asyncio.get_running_loop()
    listening, _ = await loop.create_datagram_endpoint(
        lambda: heard, local_addr=("127.0.0.1", 14651)
    )
    flight = Flight(tmp_path, scenario("udp:127.0.0.1:14650", **OF_ARDUCOPTER))
    try:
        async with arducopter(tmp_path), flight.begun() as (client, _):
            await until(lambda: bool(flight.events(Flying)), 120.0)
            await asyncio.sleep(12.0)
            client.process.send_signal(signal.SIGKILL)
            await asyncio.sleep(6.0)
            position = heard.newest[PLACE]
            assert np.hypot(position.vx, position.vy) < 10.0  # cm/s
            assert position.relative_alt > 2_000  # mm
    finally:
        listening.close()


@needs_arducopter
async def test_arducopter_brakes_and_hovers_while_the_link_is_cut(tmp_path: Path) -> None:
    flight = Flight(tmp_path, scenario("udp:127.0.0.1:14650", **OF_ARDUCOPTER))
    async with arducopter(tmp_path), flight.begun() as (client, _):
        await until(lambda: bool(flight.events(Flying)), 120.0)
        await asyncio.sleep(18.0)
        for loss in ("1", "0.1"):
            losses = (f"network.{way}.loss={loss}" for way in ("uplink", "downlink"))
            cut = await command("set", str(tmp_path / "netem.sock"), *losses)
            assert await cut.wait() == 0
            await asyncio.sleep(5.0)
        assert await asyncio.wait_for(client.end(), 200.0) == 0
    modes = [each.after for each in flight.events(ModeChanged)]
    assert modes.index("brake") < modes.index("hover")
    assert modes[-1] == "track"
    position = flight.rows()["state"][:, :, 0]
    assert np.abs(position[:, :2]).max() < 8.0


@needs_px4
async def test_px4_flies_a_figure_eight_over_the_papers_network(tmp_path: Path) -> None:
    model = {"tau_s": [0.5], "gain": 0.85, "dead_time_s": [0.1]}
    flight = Flight(tmp_path, scenario("udp:127.0.0.1:14540", **model))
    build = Path(PX4).resolve()
    process = await asyncio.create_subprocess_exec(
        str(build / "bin" / "px4"),
        "-d",
        str(build / "etc"),
        cwd=tmp_path,
        env=os.environ | {"PX4_SIM_MODEL": "sihsim_quadx"},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        async with flight.begun() as (client, _):
            assert await asyncio.wait_for(client.end(), 200.0) == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    assert flight.rmse_m() < 0.5
