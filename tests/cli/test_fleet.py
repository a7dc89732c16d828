"""Many vehicles: in one process, on one server, on several workers, and their traffic."""

import json
import os
import signal
import time
from pathlib import Path
from socket import SOCK_DGRAM, socket

import numpy as np
import pytest
from PIL import Image

from helpers import SKYTETHER, ran, refused
from skytether.__main__ import main
from skytether.cli.fleet import STAGES
from skytether.client.endpoint import Client
from skytether.client.fleet import ClientFleet
from skytether.client.simulated.vehicle import simulated
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import VEHICLES_SHOWN_MAX, Address, Datagram
from skytether.shared.events.ground import NoAnswer
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.drops import drops
from skytether.shared.telemetry.record import MemoryRecorder, Rows, client_columns
from skytether.shell.processes import workers
from skytether.sim.hosts import Clock
from skytether.sim.world import World
from warm import skytether

GUSTY = reading.check(
    reading.to_table(reading.load("fleet"))
    | {"duration": 4.0, "settle": 0.0, "vehicle": {"wind": 0.1, "gust_mps2": 0.5}},
    "test",
)


def clients(scenario: Scenario, count: int, server: Address) -> tuple[list[Client], MemoryRecorder]:
    recorder = MemoryRecorder(client_columns(scenario.model.axes))
    made = [
        Client(
            scenario,
            simulated(scenario, number),
            server=server,
            vehicle=number,
            boot_id=number,
            recorder=recorder,
        )
        for number in range(1, count + 1)
    ]
    return made, recorder


def flown(count: int, *, together: bool) -> Rows:
    """Rows of a number of vehicles in virtual time, in one process or in one process each."""
    world = World()
    # Ticks 7 ms into the vehicles' steps, so that no horizon arrives exactly at the start of a
    # step.
    server = world.add(
        "server",
        Server(GUSTY, boot_id=1, entropy=stream(1, "entropy").bytes, capacity=count),
        clock=Clock(13_000_000),
    )
    netem = world.add("netem", Proxy(GUSTY, server=server))
    vehicles, recorder = clients(GUSTY, count, netem)
    fleet = ClientFleet(vehicles)
    if together:
        world.add("fleet", fleet)
    else:
        for client in vehicles:
            world.add(f"client {client.vehicle}", client)
    world.run(
        lambda: fleet.finished if together else all(client.finished for client in vehicles),
        limit_ns=60 * SECOND_NS,
    )
    rows = recorder.rows()
    return rows[np.lexsort((rows["step"], rows["vehicle"]))]


def test_a_fleet_flies_as_its_vehicles_would_alone() -> None:
    together, alone = flown(5, together=True), flown(5, together=False)
    assert len(together) == 5 * 200
    np.testing.assert_array_equal(together, alone)
    assert len({rows["input"].tobytes() for rows in np.split(together, 5)}) == 5


def test_a_fleet_is_driven_by_its_first_wake_and_ends_with_its_last_vehicle() -> None:
    vehicles, _ = clients(GUSTY, 3, ("nowhere", 1))
    fleet = ClientFleet(vehicles)
    assert fleet.next_wake_ns() == 0
    fleet.wake(now_ns=SECOND_NS)
    assert [datagram.socket for datagram in fleet.outbox()] == [0, 1, 2]
    fleet.wake(now_ns=SECOND_NS)
    assert fleet.outbox() == []
    assert fleet.next_wake_ns() == 2 * SECOND_NS
    assert not fleet.finished
    assert fleet.failure is None
    fleet.wake(now_ns=140 * SECOND_NS)
    assert fleet.finished
    failures = [
        NoAnswer(vehicle=number, host="nowhere", port=1, waited_s=139.0) for number in (1, 2, 3)
    ]
    assert fleet.failure == failures[0]
    assert fleet.events() == tuple(failures)
    assert fleet.next_wake_ns() is None


def test_drops_of_vehicles_without_figures_of_their_own_are_added_up() -> None:
    vehicles, _ = clients(GUSTY, VEHICLES_SHOWN_MAX + 2, ("server", 1))
    fleet = ClientFleet(vehicles)
    for number in range(len(vehicles)):
        fleet.receive(Datagram(b"?", ("server", 1), number), now_ns=0)
    assert fleet.figures()["others_dropped"] == {"not a message": 2}
    assert drops({"client": fleet.figures()}) == {"client": {"not a message": len(vehicles)}}


def test_a_datagram_reaches_the_vehicle_whose_socket_it_came_to_and_no_other() -> None:
    vehicles, _ = clients(GUSTY, 2, ("server", 1))
    fleet = ClientFleet(vehicles)
    fleet.receive(Datagram(b"?", ("server", 1), 1), now_ns=0)
    assert [client.dropped.total() for client in vehicles] == [0, 1]
    assert fleet.figures()["by_vehicle"]["2"] == {
        "mode": "init",
        "step": 0,
        "steps": 200,
        "missed": 0,
        "late_ms": 0.0,
        "began_s": 0.0,
        "horizons": 0,
        "dropped": {"not a message": 1},
    }


# -- the command ---------------------------------------------------------------------------------


def fleet_command(tmp_path: Path, *argv: str) -> dict[str, object]:
    file = tmp_path / "fleet.json"
    if "--virtual" in argv:
        assert main(["fleet", *argv, "--json", str(file)]) == 0
    else:
        done = skytether("fleet", *argv, "--json", str(file), timeout_s=250.0)
        assert done.returncode == 0, done.stderr
    summary: dict[str, object] = json.loads(file.read_bytes())
    return summary


def test_a_virtual_fleet_is_summed_up(tmp_path: Path) -> None:
    argv = ("--virtual", "--vehicles", "3", "--duration", "8")
    summary = fleet_command(tmp_path, *argv, "--network.downlink", "loss(0.1) & corrupt(0.1)")
    assert (summary["vehicles"], summary["workers"], summary["steps"]) == (3, 1, 1200)
    assert (summary["event_ratio"], summary["server_missed"]) == (1.0, 0)
    assert (summary["uplink_above"], summary["uplink_due"]) == (0, summary["server_steps"])
    smallest, median, largest = summary["rmse_xy"]
    assert 0.05 < smallest <= median <= largest < 0.8
    assert set(summary["server_cpu_us"]) == set(STAGES) - {"receive", "send"}
    assert summary["machine_missed"] is None
    assert summary["client_late_ms_max"] == 0.0
    assert summary["vehicle_steps_per_core_s"] > 0
    dropped = summary["drops"]
    assert sum(dropped["netem"].values()) == summary["lost"]
    assert sum(dropped["server"].values()) > 20


@pytest.mark.long
def test_a_mission_is_flown_by_its_name_and_from_a_table(tmp_path: Path) -> None:
    flown = ("--virtual", "--reference.shape", "swap(4)", "--duration", "30")
    swap = fleet_command(
        tmp_path, "--mission", "swap", *flown, "--figure", str(tmp_path / "swap.png")
    )
    assert (tmp_path / "swap.png").stat().st_size > 10_000
    assert (swap["vehicles"], swap["separation_m"]) == (4, 0.5)
    assert swap["least_separation_m"] > 0.5
    assert swap["left_tube"] == 0
    show = tmp_path / "show.csv"
    show.write_text("vehicle,t,x,y,z\n1,0,0,0,2\n1,5,0,0,4\n2,0,3,0,2\n")
    film = tmp_path / "show.gif"
    drawn = ("--virtual", "--duration", "6", "--figure", str(film))
    shown = fleet_command(tmp_path, "--mission", str(show), *drawn)
    with Image.open(film) as frames:
        # Four times as fast as flown, in 12 frames a second.
        assert frames.n_frames == pytest.approx(shown["duration_s"] / 4 * 12, abs=2)
    assert 6.0 <= shown["duration_s"] < 14.0  # to the ends of the motions under way
    assert shown["vehicles"] == 2
    assert shown["least_separation_m"] == pytest.approx(3.0, abs=0.3)


@pytest.mark.long
def test_a_show_is_flown_from_a_folder_of_skybrush(tmp_path: Path) -> None:
    folder = tmp_path / "show"
    folder.mkdir()
    for n, y in ((1, 0.0), (2, 3.0)):
        rows = [f"{t * 1000},{max(t - 6, 0)},{y},2,255,0,0" for t in range(15)]
        rows = ["Time [msec],x [m],y [m],z [m],Red,Green,Blue", *rows]
        (folder / f"Drone {n}.csv").write_text("\n".join(rows))
    shown = fleet_command(tmp_path, "--show", str(folder), "--virtual")
    assert (shown["vehicles"], shown["duration_s"]) == (2, 44.0)
    assert shown["rmse_xy"][2] < 0.2
    assert shown["least_separation_m"] == pytest.approx(3.0, abs=0.3)


def test_a_plan_is_flown_within_its_geofence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def plan(east: float) -> str:
        item = {
            "type": "SimpleItem",
            "command": 16,
            "frame": 3,
            "params": [0, 0, 0, 0, 47, east, 2],
        }
        corners = [[46.9999, 7.9999], [46.9999, 8.0002], [47.0001, 8.0002], [47.0001, 7.9999]]
        mission = {"plannedHomePosition": [47, 8, 0], "hoverSpeed": 1, "items": [item]}
        fence = {"polygons": [{"inclusion": True, "polygon": corners}]}
        file = tmp_path / "site.plan"
        file.write_text(json.dumps({"fileType": "Plan", "mission": mission, "geoFence": fence}))
        return str(file)

    flown = fleet_command(tmp_path, "--mission", plan(8.0001), "--virtual", "--duration", "20")
    assert flown["vehicles"] == 1
    line = refused(["fleet", "--mission", plan(8.0003), "--virtual"], capfd)
    assert "mission.zones: got site.plan: polygon 1 of the geofence, expected a fence" in line


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--show", "it.csv", "--mission", "swap"], "--show: got swap as well"),
        (["demo", "--show", "it.csv"], "--show: got demo as well"),
        (["--show"], "--show: expected a name or a file"),
        (["--show", "it.csv"], "--show: got 'it.csv', expected a file that can be read"),
    ],
)
def test_a_show_beside_something_else_is_refused(
    argv: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert refused(["fleet", *argv], capfd).startswith(f"fleet: {said}")


def test_a_mission_that_cannot_be_read_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    show = tmp_path / "show.csv"
    show.write_text("vehicle,t,x,y\n1,3,0,0\n")
    line = refused(["fleet", "--mission", str(show)], capfd)
    assert line.startswith(
        f"fleet: --mission: {show}: line 2: expected t = 0 as the first time, got"
    )


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize("count", [1, 2])
def test_a_fleet_over_udp_is_summed_up(tmp_path: Path, count: int) -> None:
    argv = ("--vehicles", "6", "--duration", "6", "--workers", str(count))
    summary = fleet_command(tmp_path, *argv)
    assert (summary["vehicles"], summary["workers"]) == (6, count)
    assert summary["steps"] + summary["client_missed"] == 6 * 300
    assert summary["server_steps"] > 0
    assert set(summary["server_cpu_us"]) == {*STAGES, "total"}
    assert summary["downlink_packets_per_s"] > 0


@pytest.mark.long
@pytest.mark.realtime
def test_a_fleet_has_a_page_where_one_is_asked_for() -> None:
    argv = ["fleet", "--vehicles", "3", "--duration", "6", "--page", "127.0.0.1:0"]
    done = ran(*SKYTETHER, *argv, timeout=250)
    assert done.returncode == 0
    assert "http://127.0.0.1:" in done.stderr
    assert "without a page" not in done.stderr


# -- workers -------------------------------------------------------------------------------------


def supervise(work: object) -> int:
    """Exit code of two supervised workers, in a process of its own; 250 if it hangs."""
    pid = os.fork()
    if pid == 0:
        signal.alarm(180)
        os._exit(workers.run(2, ("127.0.0.1", 0), work))
    _, status = os.waitpid(pid, 0)
    return os.waitstatus_to_exitcode(status)


@pytest.mark.realtime
def test_the_end_of_one_worker_is_the_end_of_all() -> None:
    """A dead worker's vehicles have lost their sessions, so all workers end and restart."""

    def work(number: int, _: socket) -> None:
        if number == 2:
            os._exit(3)
        time.sleep(60)

    assert supervise(work) == 3


@pytest.mark.realtime
def test_workers_share_one_address_and_every_peer_keeps_its_worker() -> None:
    """Each of forty peers is always served by the same worker, and both workers serve some."""

    def work(number: int, sock: socket) -> None:
        sock.setblocking(True)
        while True:
            payload, peer = sock.recvfrom(100)
            if payload == b"end":
                return
            sock.sendto(b"%d" % number, peer)

    ready, announce = os.pipe()
    pid = os.fork()
    if pid == 0:
        signal.alarm(180)

        def announced(number: int, sock: socket) -> None:
            os.write(announce, b"%5d" % sock.getsockname()[1])
            work(number, sock)

        os._exit(workers.run(2, ("127.0.0.1", 0), announced))
    ports = {int(os.read(ready, 5)) for _ in range(2)}
    assert len(ports) == 1
    (port,) = ports
    heard = []
    for _ in range(40):
        with socket(type=SOCK_DGRAM) as peer:
            peer.settimeout(180)
            answers = []
            for _ in range(3):
                peer.sendto(b"?", ("127.0.0.1", port))
                answers.append(peer.recv(100))
            assert len(set(answers)) == 1
            heard.append(answers[0])
    assert set(heard) == {b"1", b"2"}
    os.kill(pid, signal.SIGTERM)
    assert os.WIFEXITED(os.waitpid(pid, 0)[1])
