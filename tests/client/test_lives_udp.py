"""Client that is killed in flight and restarted by its service, over real UDP."""

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from airborne import scenario
from skytether.cli.processes import Child, started
from skytether.shared.events.aboard import ArmingAwaited, AutopilotMode
from skytether.shared.events.flight import Flying
from skytether.shared.events.flight import address_text as text
from skytether.shared.events.processes import Recalled
from skytether.shared.scenario.reading import to_toml
from skytether.shell.driving.control import Caller

pytestmark = [pytest.mark.long, pytest.mark.realtime]


class Service:
    """Client that is started repeatedly, and the events of its runs.

    Args:
        stack: ends the client.
        arguments: command line of the client.
    """

    def __init__(self, stack: AsyncExitStack, arguments: list[str]) -> None:
        self._stack, self._arguments = stack, arguments
        self.events: list[Any] = []

    async def start(self) -> Child:
        self.events = events = list[Any]()
        child = started("client", *self._arguments, on_event=lambda line: events.append(line.event))
        return await self._stack.enter_async_context(child)

    def of(self, kind: type) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]


async def until(so: Callable[[], object]) -> None:
    async with asyncio.timeout(120.0):
        while not so():
            await asyncio.sleep(0.1)


async def test_killed_in_flight_and_started_again_it_arms_nothing_before_a_person_says_so(
    tmp_path: Path,
) -> None:
    told: list[str] = []
    anywhere = ("--bind", "127.0.0.1:0")
    socket = tmp_path / "client.sock"

    def arm() -> None:
        with closing(Caller(socket)) as caller:
            caller.ask({"armed": True})

    async with AsyncExitStack() as stack:
        autopilot = await stack.enter_async_context(
            started(
                "autopilot",
                "demo",
                *anywhere,
                "--ready",
                "2",
                on_event=lambda line: told.append(str(line.event)),
            )
        )
        address = f"udpout:{text(*autopilot.address)}"
        vehicle = {"kind": "mavlink", "address": address, "memory": str(tmp_path / "state")}
        file = tmp_path / "scenario.toml"
        file.write_bytes(to_toml(scenario(duration=300.0, vehicle=vehicle)))
        server = await stack.enter_async_context(started("server", str(file), *anywhere))
        to_server = ["--server", text(*server.address), "--control", str(socket)]
        service = Service(stack, [str(file), *to_server, "--no-armed", "--set-parameters"])
        first = await service.start()
        await until(socket.exists)
        await asyncio.to_thread(arm)
        await until(lambda: service.of(Flying))
        first.process.kill()
        await first.process.wait()
        assert (tmp_path / "client.sock.set").exists()
        await until(lambda: any(said.startswith("Disarm") for said in told))
        await service.start()
        await until(lambda: service.of(ArmingAwaited))
        assert service.of(Recalled)
        await asyncio.sleep(3.0)
        assert not any(mode.armed for mode in service.of(AutopilotMode))
        await asyncio.to_thread(arm)
        await until(lambda: any(mode.armed for mode in service.of(AutopilotMode)))
