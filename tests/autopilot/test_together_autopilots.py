"""Three autopilots on one mission: in virtual time, and over UDP as in docs/together.md."""

import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from airborne import OFFSET_NS, SAFE
from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.flavours import FlavourName
from skytether.client import vehicles
from skytether.client.endpoint import Client
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.events.processes import Counted
from skytether.shared.law.model import Array
from skytether.shared.missions.derived import zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import parts, record
from skytether.shared.telemetry.record import MemoryRecorder, client_columns
from skytether.shared.telemetry.summary import least_separation
from skytether.shell.processes.log import LogLine
from skytether.sim.hosts import Clock
from skytether.sim.world import World

NUMBERS = (1, 2, 3)
DOCUMENT = Path(__file__).parents[2] / "docs" / "together.md"
PX4 = {"tau_s": [0.5], "gain": [0.85], "dead_time_s": [0.1]}
"""Model of PX4 in the scenario `px4`."""


def scenario(flavour: FlavourName, number: int, loss: float) -> Scenario:
    table = reading.to_table(reading.load("swap-autopilot")) | {"duration": 55.0}
    table["vehicle"]["address"] = f"udpout:autopilot{number}:0"
    set_keys({"network.uplink.loss": loss, "network.downlink.loss": loss}, table)
    if flavour == "px4":
        table["model"] |= PX4
    return check(table, "three")


def apart_m(paths: list[Array]) -> float:
    """Smallest distance between two paths [m]; each of shape (n, 3)."""
    steps = min(map(len, paths))
    pairs = combinations((path[:steps] for path in paths), 2)
    return min(float(np.linalg.norm(one - other, axis=1).min()) for one, other in pairs)


class Flown(NamedTuple):
    """What three autopilots have flown."""

    server: Server
    paths: list[Array]
    """True positions of each [m]; shape (n, 3) each."""
    rows: list[record.Rows]
    """Record of each client."""


def fly(flavour: FlavourName, scenarios: Mapping[int, Scenario]) -> Flown:
    world, clients, truths, steps = World(), [], [], []
    for number, flown in scenarios.items():
        truths.append(MemoryRecorder(TRUTH_COLUMNS))
        steps.append(MemoryRecorder(client_columns(3)))
        pilot = Autopilot(flown, flavour, ready_s=1.0, recorder=truths[-1])
        pilot.flight.parameters |= SAFE[flavour]
        world.add(f"autopilot{number}", pilot)
        flies, server_at = vehicles.make(flown, number), ("netem", 0)
        client = Client(
            flown, flies, server=server_at, vehicle=number, boot_id=number, recorder=steps[-1]
        )
        clients.append(client)
        world.add(f"client{number}", client, clock=Clock(number * OFFSET_NS))
    world.add("netem", Proxy(flown, server=("server", 0), flows=len(scenarios)))
    server = Server(flown, boot_id=9, entropy=bytes)
    world.add("server", server, clock=Clock(OFFSET_NS))
    world.run(lambda: all(client.finished for client in clients), limit_ns=300 * 10**9)
    assert [client.failure for client in clients] == [None, None, None]
    paths = [
        # The local frame of each begins at its start.
        truth.rows()["state"][:, :, 0] + flown.start_m(number) * [1.0, 1.0, 0.0]
        for number, truth in zip(scenarios, truths, strict=True)
    ]
    return Flown(server, paths, [each.rows() for each in steps])


@pytest.mark.long
@pytest.mark.parametrize(("flavour", "loss"), [("ardupilot", 0.1), ("px4", 0.4)])
def test_three_swap_places_within_a_fence(flavour: FlavourName, loss: float) -> None:
    scenarios = {number: scenario(flavour, number, loss) for number in NUMBERS}
    server, paths, _ = fly(flavour, scenarios)
    for (number, flown), path in zip(scenarios.items(), paths, strict=True):
        goal = flown.make_reference(number)(np.array(flown.duration))[:, 0]
        assert np.linalg.norm(path[-1, :2] - goal[:2]) < 0.5
        assert path[-1, 2] < 0.1
        assert zones(flown).clearance(path).min() > 0.0
    assert apart_m(paths) > flown.mission.separation_m
    if flavour == "ardupilot":
        assert server.figures()["counts"].get("left_tube", 0) == 0


@pytest.mark.long
def test_three_follow_the_paths_of_a_show(tmp_path: Path) -> None:
    """At 0.84 m/s, one behind the other on a circle; without a lead they lag by their dead time."""
    rows = ["vehicle,t,x,y,z"]
    for number in NUMBERS:
        for t in np.arange(0.0, 45.1, 0.25):
            gone_s = max(t - 9.5, 0.0) if t > 11.0 else max(t - 8.0, 0.0) ** 2 / 6.0
            angle = 2.0 * np.pi * ((number - 1) / 3.0 + gone_s / 30.0)
            rows.append(f"{number},{t},{4 * np.cos(angle):.3f},{4 * np.sin(angle):.3f},3")
    file = tmp_path / "show.csv"
    file.write_text("\n".join(rows))
    scenarios = {}
    for number in NUMBERS:
        table = reading.to_table(scenario("ardupilot", number, 0.1))
        table["reference"] |= {"shape": "show", "file": str(file)}
        scenarios[number] = check(table, "show")
    server, paths, records = fly("ardupilot", scenarios)
    for (number, flown), own in zip(scenarios.items(), records, strict=True):
        times_s = own["step"] * flown.control.dt
        moving = (times_s > 15.0) & (times_s < 44.0)
        desired = flown.make_reference(number)(times_s)[moving][..., 0]
        off_m = np.linalg.norm(own["state"][moving][..., 0] - desired, axis=1)
        assert off_m.mean() < 0.05
    assert apart_m(paths) > 5.0
    assert server.figures()["counts"].get("left_tube", 0) == 0


@pytest.mark.long
@pytest.mark.realtime
def test_the_documented_autopilots_swap_places_over_udp(tmp_path: Path) -> None:
    """Each autopilot, server, netem and client is a process; 45 s over the emulated network.

    All of them arrive, and none comes as near to another as half the separation asked for.
    """
    found = re.findall(r"```sh\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    (block,) = (each for each in found if "skytether autopilot" in each)
    lines = [shlex.split(line)[1:] for line in block.splitlines()]
    behind = [line for line in lines if line[0] != "client"]
    flown = [line for line in lines if line[0] == "client"]
    run = [sys.executable, "-P", "-m", "skytether"]
    there = [subprocess.Popen([*run, *line], stdout=subprocess.DEVNULL) for line in behind]
    try:
        files = [tmp_path / line[line.index("--id") + 1] for line in flown]
        asked = ["--duration", "45", "--log", "json", "--record"]
        flying = [
            subprocess.Popen([*run, *line, *asked, str(file)], stdout=subprocess.PIPE)
            for line, file in zip(flown, files, strict=True)
        ]
        said = [each.communicate(timeout=120)[0] for each in flying]
        assert [each.returncode for each in flying] == [0, 0, 0]
    finally:
        for each in there:
            each.send_signal(signal.SIGTERM)
            each.wait(30)
    scenario = reading.load("swap-autopilot")
    rows = [parts.read(file) for file in files]
    for number, track in zip(NUMBERS, rows, strict=True):
        goal = scenario.make_reference(number)(np.array(scenario.duration))[:, 0]
        start, end = track["state"][0, :, 0], track["state"][-1, :, 0]
        assert np.linalg.norm(end - goal) < np.linalg.norm(start - goal)
    began_s = [
        event.event.figures["by_vehicle"][str(number)]["began_s"]
        for number, lines in zip(NUMBERS, said, strict=True)
        for event in map(msgspec.json.Decoder(LogLine).decode, lines.splitlines())
        if isinstance(event.event, Counted)
    ]
    least_m = least_separation(rows, began_s, scenario.control.dt)
    assert least_m is not None
    assert least_m > 0.5 * scenario.mission.separation_m
