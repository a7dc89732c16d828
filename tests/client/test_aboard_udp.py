"""Vehicle with an autopilot over real UDP: four processes, started as a user does."""

import asyncio
import contextlib
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from airborne import FIGURE, SAFE, documented, scenario
from skytether.autopilot.flavours import FlavourName
from skytether.cli.processes import Child, started
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.aboard import AutopilotMode, ParametersSet
from skytether.shared.events.flight import Flying
from skytether.shared.events.flight import address_text as text
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import client_columns
from skytether.shell.processes.log import LogLine

pytestmark = [pytest.mark.long, pytest.mark.realtime]
PAPER = "paper(0.4, 0.02, 2.0) & loss(0.1)"


def figure_eight(autopilot: Address, **table: object) -> Scenario:
    return scenario(
        duration=30.0,
        reference=FIGURE | {"altitude_m": 5.0},
        network={"uplink": PAPER, "downlink": PAPER},
        vehicle={"kind": "mavlink", "address": f"udpout:{text(*autopilot)}"},
        **table,
    )


class Processes:
    def __init__(self, folder: Path, flavour: FlavourName) -> None:
        self.folder, self.flavour = folder, flavour
        self.heard: list[LogLine] = []
        self.last_words = ""
        self.autopilot: list[str] = []
        self.flies = asyncio.Event()

    def _hear(self, line: LogLine) -> None:
        self.heard.append(line)
        if isinstance(line.event, Flying):
            self.flies.set()

    async def run(self, *arguments: str, end: int | None = None) -> int:
        """Fly to the end, or until a signal is sent after 3 s of flight; returns the exit code."""
        ready = ("--bind", "127.0.0.1:0", "--ready", "2", "--flavour", self.flavour)
        anywhere = ("--bind", "127.0.0.1:0")
        async with started(
            "autopilot",
            "demo",
            *ready,
            on_event=lambda line: self.autopilot.append(str(line.event)),
        ) as pilot:
            file = self.folder / "scenario.toml"
            file.write_bytes(to_toml(figure_eight(pilot.address)))
            async with (
                started("server", str(file), *anywhere) as server,
                started("netem", str(file), *anywhere, "--server", text(*server.address)) as netem,
                started(
                    "client",
                    str(file),
                    "--server",
                    text(*netem.address),
                    "--record",
                    str(self.folder / "client"),
                    *arguments,
                    on_event=self._hear,
                ) as client,
            ):
                return await self._watch(client, end)

    async def _watch(self, client: Child, end: int | None) -> int:
        if end is not None:
            await asyncio.wait_for(self.flies.wait(), 180.0)
            await asyncio.sleep(3.0)
            client.process.send_signal(end)
        code = await asyncio.wait_for(client.end(), 300.0)
        self.last_words = client.last_words()
        for _ in range(200):
            if end is None or any(said.startswith("Disarm") for said in self.autopilot):
                break
            await asyncio.sleep(0.2)
        return code

    def events(self, kind: type) -> list[object]:
        return [line.event for line in self.heard if isinstance(line.event, kind)]


async def test_a_figure_eight_over_the_papers_network(tmp_path: Path) -> None:
    """It takes off, flies all of it and lands; how well is judged in virtual time."""
    processes = Processes(tmp_path, "ardupilot")
    assert await processes.run("--set-parameters") == 0
    (changed,) = processes.events(ParametersSet)
    assert isinstance(changed, ParametersSet)
    assert {name for name, _, _ in changed.changes} == set(SAFE["ardupilot"])
    last = processes.events(AutopilotMode)[-1]
    assert isinstance(last, AutopilotMode)
    assert not last.armed
    rows = parse((tmp_path / "client").read_bytes())
    assert rows.dtype == client_columns(3)
    assert np.isfinite(rows["input"]).all()
    assert np.abs(rows["input"]).max() > 0.0


def field_in(folder: Path) -> list[str]:
    """Commands of docs/fly-a-real-one.md, with its scenario `field.toml` written to the folder."""
    document = (Path(__file__).parents[2] / "docs" / "fly-a-real-one.md").read_text()
    (folder / "field.toml").write_text(documented())
    commands: list[str] = re.findall(r"```sh\n(.*?)```", document, re.DOTALL)
    return commands


def test_the_documented_terminals_fly_together(tmp_path: Path) -> None:
    blocks = field_in(tmp_path)
    (block,) = (each for each in blocks if "skytether client field.toml" in each)
    lines = [[sys.executable, "-P", "-m", *shlex.split(line)] for line in block.splitlines()]
    *others, client = lines
    with contextlib.ExitStack() as stack:
        for line in others:
            process = stack.enter_context(subprocess.Popen(line, cwd=tmp_path))
            stack.callback(process.terminate)
        client += ["--duration", "6", "--settle", "0"]
        run = subprocess.run(client, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "GUID_TIMEOUT is 1 from now on, it was 3" in run.stdout
    assert "flies a plan" in run.stdout


def test_fly_has_everything_but_the_autopilot(tmp_path: Path) -> None:
    field_in(tmp_path)
    skytether = [sys.executable, "-P", "-m", "skytether"]
    fly = [*skytether, "fly", "field.toml", "--duration", "4", "--settle", "0"]
    autopilot = [*skytether, "autopilot", "field.toml", "--flavour", "ardupilot", "--ready", "2"]
    with subprocess.Popen(autopilot, cwd=tmp_path) as stands_by:
        try:
            runs = [
                subprocess.run(
                    [*fly, *flags], cwd=tmp_path, capture_output=True, text=True, check=False
                )
                for flags in ((), ("--set-parameters",))
            ]
        finally:
            stands_by.terminate()
    refused, flown = runs
    assert refused.returncode == 1
    assert refused.stderr.splitlines()[-1].endswith("SYSID_MYGCS; --set-parameters sets them")
    assert flown.returncode == 0, flown.stderr


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
async def test_who_ends_in_flight_leaves_it_to_the_autopilot(end: int, tmp_path: Path) -> None:
    """By the client's command or the autopilot's timeouts it has landed half a minute later."""
    processes = Processes(tmp_path, "px4")
    await processes.run("--set-parameters", end=end)
    assert any(said.startswith("Disarm") for said in processes.autopilot)
